"""Submissions with anything wrong are refused with a reason, and nothing in them is run."""

import io
import json
import os
import pickle
import re
import shutil
import struct
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save
from small_submissions import (
    ABOUT,
    ENV,
    FEEDBACK,
    GRID,
    LINEAR,
    NET,
    TABLE,
    TRAINING,
    built_in,
    learned,
    linear,
    net,
    network,
)

from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.kernels import affine
from lag_envs.leaderboard.submission import Refused, load, write
from lag_envs.tasks import incline


@pytest.fixture
def folder(tmp_path):
    """A linear feedback, to be spoilt."""
    linear(tmp_path / "it")
    return tmp_path / "it"


@pytest.fixture
def nets(tmp_path):
    """Five networks with a training, to be spoilt."""
    learned(tmp_path / "it")
    return tmp_path / "it"


def replace(folder, old, new):
    file = folder / "submission.toml"
    # Lists on one line.
    text = re.sub(
        r"\[\n([^\[\]]*?),\n\]",
        lambda found: f"[{' '.join(found[1].split())}]",
        file.read_text(encoding="utf-8"),
    )
    assert old in text, text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")


def refused(folder, reason):
    with pytest.raises(Refused, match=reason) as caught:
        load(folder)
    text = str(caught.value)
    assert text.isprintable() and len(text) < 400


# --- hostile: files ---


def test_no_folder(tmp_path):
    refused(tmp_path / "nothing", "cannot be read")
    (tmp_path / "file").write_text("x")
    refused(tmp_path / "file", "not a folder")


def test_linked_folder(folder, tmp_path):
    (tmp_path / "link").symlink_to(folder)
    refused(tmp_path / "link", "links are not followed")


@pytest.mark.parametrize(
    "name",
    ["README.md", "model.pkl", "model.zip", "policy_0.pt", "policy_00.safetensors", "policy_-1.safetensors",
     "Policy_1.safetensors", "policy_1.safetensors.py", "policy_1\n.safetensors", "\x1b[31mred",
     "policy_9999999999.safetensors", "submission.toml~", ".hidden", "policy_¹.safetensors"],
)  # fmt: skip
def test_unknown_file(folder, name):
    (folder / name).write_bytes(b"")
    refused(folder, "unknown file")


def test_no_toml(folder):
    (folder / "submission.toml").unlink()
    refused(folder, r"there is no submission\.toml")


@pytest.mark.parametrize("name", ["submission.toml", "policy_0.safetensors"])
def test_linked_file(folder, tmp_path, name):
    (folder / name).rename(tmp_path / name)
    (folder / name).symlink_to(tmp_path / name)
    refused(folder, f"{name} is not a plain file")


@pytest.mark.parametrize("target", ["../../../../etc/passwd", "/dev/zero", "nowhere"])
def test_link_to_elsewhere(folder, target):
    (folder / "policy_1.safetensors").symlink_to(target)
    refused(folder, "not a plain file")


def test_folder_and_pipe_for_a_file(folder):
    (folder / "policy_1.safetensors").mkdir()
    refused(folder, "not a plain file")
    (folder / "policy_1.safetensors").rmdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "policy_1.safetensors")
        refused(folder, "not a plain file")


@pytest.mark.parametrize(
    ("name", "most"),
    [("submission.toml", protocol.TOML_BYTES), ("policy_0.safetensors", protocol.POLICY_BYTES)],
)
def test_file_too_large(folder, name, most):
    os.truncate(folder / name, most + 1)
    refused(folder, f"{name} has {most + 1} bytes")
    os.truncate(folder / name, 2**40)  # sparse: to read it would take for ever
    refused(folder, "bytes; at most")


def test_files_too_large_together(folder):
    for seed in range(protocol.FOLDER_BYTES // protocol.POLICY_BYTES + 1):
        with (folder / f"policy_{seed}.safetensors").open("wb") as file:
            file.truncate(protocol.POLICY_BYTES)
    refused(folder, "the files have")


@pytest.mark.parametrize("many", [protocol.MOST_POLICIES + 1, 1000])
def test_too_many_policies(folder, many):
    for seed in range(many):
        (folder / f"policy_{seed}.safetensors").write_bytes(b"")
    refused(folder, "more than 20 policies")


def test_file_exchanged_while_it_is_read(folder, tmp_path, monkeypatch):
    file = folder / "policy_0.safetensors"
    real = os.open

    def exchange(path, *args, **kwargs):
        if Path(path) == file and not file.is_symlink():
            file.rename(tmp_path / "elsewhere")
            file.symlink_to(tmp_path / "elsewhere")
        return real(path, *args, **kwargs)

    monkeypatch.setattr(os, "open", exchange)
    refused(folder, r"policy_0.safetensors changed while it was read: it is not a plain file")


def test_file_that_grows_while_it_is_read(folder, monkeypatch):
    real = os.open

    def grow(path, *args, **kwargs):
        with Path(path).open("ab") as file:
            file.write(b"# more")
        return real(path, *args, **kwargs)

    monkeypatch.setattr(os, "open", grow)
    refused(folder, "changed while it was read")


# --- hostile: text ---


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\xff\xfe", "not UTF-8"),
        (b"\x80\x04\x95", "not UTF-8"),
        (b"a = ", "not valid TOML"),
        (b"a = 1\na = 2", "not valid TOML"),
        (b"a = 1979-13-45", "not valid TOML"),
        (b"a = " + b"1" * 5000, "more than 1000 characters"),
        (b"a = " + b"[" * 990, "nested too deeply"),
        (b"a = " + b"[\n" * 30_000, "nested too deeply"),
        (b"a = " + b"{a = " * 190, "not valid TOML|nested too deeply"),
        (b".".join([b"a"] * 30_000) + b" = 1", "more than 1000 characters"),
        (b"\n".join(b"[[a.b]]" for _ in range(8_000)), "schema is missing"),
        (b"\n".join(b".".join([b"a"] * 400) + b".b%d = 1" % i for i in range(70)), "schema is missing"),
        (b"\x00" * 1000, "not valid TOML"),
        (b"", "schema is missing"),
    ],
    ids=range(14),
)
def test_text_that_is_no_toml_or_a_bomb(folder, content, reason):
    (folder / "submission.toml").write_bytes(content)
    refused(folder, reason)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("schema = 1", "schema = 3", "schema: Input should be "),
        ("schema = 1", "schema = true", "schema: Input should be "),
        ("schema = 1", "schema = 1.0", "schema: Input should be "),
        ("schema = 1", "schema = 1979-05-27", "schema: Input should be "),
        ("schema = 1", "schema = 1\nprotocol = 0", "protocol: Input should be "),
        ("schema = 1", 'schema = 1\nprotocol = "1"', "protocol: Input should be "),
        ("schema = 1", "schema = 1\nschema = 1", "not valid TOML"),
        ("schema = 1", "schema = 1\nprotocol = 9999-12-31", "protocol: Input should be "),
        ("schema = 1", f"schema = 0x{'f' * 900}", "schema: "),
        (f'env = "{ENV}"', 'env = "Nothing-v0"', "env: (there is no such board|Input should be a valid str)"),
        (f'env = "{ENV}"', f'env = ["{ENV}"]', "env: (there is no such board|Input should be a valid str)"),
        (f'env = "{ENV}"', f'env = "{incline.Brake.id}"', "must have the shape"),
        ("schema = 1", "schema = 1\nscore = 1e9", "score is an unknown key"),
        ("schema = 1", 'schema = 1\n"\\u001b[31m" = 1', "unknown key"),
        ('name = "An agent"', "name = 5", "name: "),
        ('name = "An agent"', "", "name is missing"),
        ('name = "An agent"', 'name = ""', "name: must have 1 to 60 characters"),
        ('name = "An agent"', 'name = "…"', "name: there must be a letter from A to Z or a digit"),
        ('name = "An agent"', 'name = "王"', "name: there must be a letter from A to Z or a digit"),
        ('name = "An agent"', 'name = "a\\u001b[2J"', "name: "),
        ('name = "An agent"', 'name = "a\\u202eb"', "name: "),
        ('name = "An agent"', 'name = "a\\nb"', "name: "),
        ('name = "An agent"', 'name = "a\\u200bb"', r"name: it holds the invisible U\+200B"),
        ('name = "An agent"', 'name = "a\\u3164b"', r"name: it holds the invisible U\+3164"),
        ('name = "An agent"', 'name = "a\\u2800"', r"name: it holds the invisible U\+2800"),
        ('name = "An agent"', 'name = "a\\u00a0b"', r"name: it holds the invisible U\+00A0"),
        ('name = "An agent"', 'name = "a\\ufe0f"', r"name: it holds the invisible U\+FE0F"),
        ('name = "An agent"', 'name = "a\\U000e0041"', r"name: it holds the invisible U\+E0041"),
        ('name = "An agent"', 'name = "a\\u0301\\u0301\\u0301"', "more than 2 marks"),
        ('name = "An agent"', 'name = "\\u0301a"', "begins with a mark"),
        ('name = "An agent"', f'name = "{"a" * 61}"', "name: must have 1 to 60 characters"),
        ('authors = ["A. Nobody"]', "authors = []", "authors: List should have at least 1 item"),
        ('authors = ["A. Nobody"]', 'authors = "me"', "authors: .* list|authors: List "),
        ('authors = ["A. Nobody"]', 'authors = [" "]', "authors.*: there must be a letter or a digit"),
        ('authors = ["A. Nobody"]', 'authors = ["A", "..."]', "authors.*: there must be a letter or a digit"),
        ('authors = ["A. Nobody"]', 'authors = [""]', "authors.*: must have 1 to 80 characters"),
        ('authors = ["A. Nobody"]', 'authors = ["\\u3164"]', r"invisible U\+3164"),
        ('authors = ["A. Nobody"]', 'authors = ["A\\u00adB"]', r"invisible U\+00AD"),
        ('authors = ["A. Nobody"]', "authors = [1]", "authors.0: Input should be a valid string"),
        ('authors = ["A. Nobody"]', "authors = [" + '"a", ' * 21 + "]", "authors: .* list|authors: List "),
        ('license = "MIT"', 'license = ""', "license: an SPDX expression is needed"),
        ('license = "MIT"', 'license = "<b>"', "license: an SPDX expression is needed"),
        ('license = "MIT"', 'license = "MTI"', "license: an SPDX expression is needed, .* got 'MTI'"),
        ('license = "MIT"', 'license = "MIT"\ncode = "https://a.org@evil.org/"', "code: there must be no @"),
        ('license = "MIT"', 'license = "MIT"\ncode = "javascript:alert(1)"', "code: String should match"),
        ('license = "MIT"', 'license = "MIT"\ncode = "http://a.org"', "code: String should match"),
        ('license = "MIT"', """license = "MIT"\ncode = 'https://a.org/"x"'""", "code: String should match"),
        ('license = "MIT"', f'license = "MIT"\ndescription = "{"a" * 501}"', "at most 500 characters"),
        ('license = "MIT"', 'license = "MIT"\ndescription = "a\\tb"', "description: "),
        ('license = "MIT"', 'license = "MIT"\ndescription = 1979-05-27', "description: "),
        ("schema = 1", 'schema = 1\nkind = "best"', 'kind must be "controller"'),
        ("schema = 1", "schema = 1\nkind = [1]", 'kind must be "controller"'),
        ("schema = 1", 'schema = 1\nkind = "<b>learned</b>"', 'kind must be "controller"'),
        ("schema = 1", 'schema = 1\nkind = "learned"', 'kind must be "controller" .* without .training'),
        ("[policy]", "[[policy]]", "Input should be a valid dict"),
        ("[policy]", "[policie]", r"policy is missing"),
        ('architecture = "linear"', 'architecture = "pickle"', "architecture must be one of"),
        ('architecture = "linear"', 'architecture = "torchscript"', "architecture must be one of"),
        ('architecture = "linear"', 'architecture = "linear"\nfile = "../x"', "file is an unknown key"),
        ('architecture = "linear"', 'architecture = "mlp"', "hidden is missing"),
    ],
)  # fmt: skip
def test_text_with_something_wrong(folder, old, new, reason):
    replace(folder, old, new)
    refused(folder, reason)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("seeds = [0, 1, 2, 3, 4]", "seeds = [0, 1, 2, 3]", "seeds must be those of the policy files"),
        ("seeds = [0, 1, 2, 3, 4]", "seeds = [0, 1, 2, 3, 3]", "training.seeds must be those"),
        ("seeds = [0, 1, 2, 3, 4]", "seeds = [0, 1, 2, 3, true]", "seeds.4: Input should be"),
        ("seeds = [0, 1, 2, 3, 4]", f"seeds = [0, 1, 2, 3, {10**22}]", "seeds.4: Input should be"),
        ("env_steps = 1000", "env_steps = -1", "env_steps: Input should be "),
        ("env_steps = 1000", "env_steps = 1e3", "env_steps: Input should be "),
        ("env_steps = 1000", "", "env_steps is missing"),
        ("seconds = 2.5", "seconds = nan", "seconds: Input should be "),
        ("seconds = 2.5", "seconds = inf", "seconds: Input should be "),
        ("seconds = 2.5", "seconds = 1e999", "seconds: Input should be "),
        ("seconds = 2.5", "seconds = " + "9" * 900, "seconds: Input should be "),
        ('hardware = "abacus"', "", "hardware is missing"),
        ('hardware = "abacus"', 'hardware = "a"\nscore = 1', "score is an unknown key"),
        ('hardware = "abacus"', 'hardware = "a"\ncurves = 5', "curves: .* valid list"),
        ('hardware = "abacus"', 'hardware = "a"\ncurves = [5]', "Input should be a valid dict"),
        ('hardware = "abacus"', 'hardware = "a"\n[[training.curves]]', "seed is missing"),
        ("hidden = [3]", "hidden = [true]", "hidden.0: Input should be "),
        ("hidden = [3]", "hidden = [0]", "hidden.0: Input should be "),
        ("hidden = [3]", "hidden = [-3]", "hidden.0: Input should be "),
        ("hidden = [3]", "hidden = 3", "hidden: (Input should be a valid list|List should have at most)"),
        ("hidden = [3]", "hidden = [100000]", "hidden.0: Input should be "),
        ("hidden = [3]", f"hidden = [{'3, ' * 9}]", "hidden: List should have at most 8 items"),
        ("hidden = [3]", "hidden = [1024, 1024]", "at most 131072"),
        ("hidden = [3]", "hidden = [4]", r"weight_0 must have the shape \(4, 4\)"),
        ("hidden = [3]", "hidden = [3, 3]", "array 'bias_2' is missing"),
        ("hidden = [3]", "hidden = []", "array 'bias_1' is not known"),
        ('activation = "tanh"', 'activation = "eval"', "activation: Input should be '"),
        ('squash = "clip"', "", "squash or bins is missing"),
        ('squash = "clip"', 'squash = "no"', "squash: Input should be '"),
        ('squash = "clip"', "bins = 1", "bins: Input should be greater than or equal to 2"),
        ('squash = "clip"', "bins = 1000000", "bins: Input should be "),
        ('squash = "clip"', 'squash = "clip"\nbins = 3', "squash has no effect with bins; leave it out"),
        ('squash = "clip"', 'squash = "clip"\nmean_limit = nan', "mean_limit: Input should be "),
        ('squash = "clip"', 'squash = "clip"\nnormalise = {clip = 0}', "clip: Input should be "),
        ('squash = "clip"', 'squash = "clip"\nnormalise = {mean = 0}', "mean is an unknown key"),
        ('squash = "clip"', 'squash = "clip"\nnormalise = 1', "Input should be a valid dict"),
        ('squash = "clip"', 'squash = "clip"\nnormalise = {}', "'obs_mean' is missing"),
    ],
)  # fmt: skip
def test_training_and_network_with_something_wrong(nets, old, new, reason):
    replace(nets, old, new)
    refused(nets, reason)


@pytest.mark.parametrize(
    ("curve", "reason"),
    [
        ("seed = 9\nsteps = [1]\nreturns = [1.0]", "seed must be one of"),
        ("seed = 0\nsteps = [1, 1]\nreturns = [1.0, 2.0]", "steps must increase"),
        ("seed = 0\nsteps = [1, 2]\nreturns = [1.0]", "one for each return"),
        ("seed = 0\nsteps = [1]\nreturns = [nan]", "returns.0: Input should be "),
        ('seed = 0\nsteps = [1]\nreturns = ["a"]', "returns.0: Input should be "),
        ("seed = 0\nsteps = []\nreturns = []", "steps: List should have at least 1 item"),
        ("seed = 0\nsteps = [1]\nreturns = [1]\nx = 1", "unknown key"),
        ("seed = 0\nsteps = [1]\nreturns = [1]\n[[training.curves]]\nseed = 0\nsteps = [1]\nreturns = [1]",
         "at most once"),
    ],
)  # fmt: skip
def test_learning_curve_with_something_wrong(nets, curve, reason):
    replace(nets, "[policy]", f"[[training.curves]]\n{curve}\n[policy]")
    refused(nets, reason)


def test_too_few_policies(nets):
    (nets / "policy_4.safetensors").unlink()
    replace(nets, "[0, 1, 2, 3, 4]", "[0, 1, 2, 3]")
    refused(nets, "at least 5 policies")
    for seed in range(4):
        (nets / f"policy_{seed}.safetensors").unlink()
    replace(nets, "[0, 1, 2, 3]", "[]")
    refused(nets, "at least 5 policies")


def test_no_policy(folder):
    (folder / "policy_0.safetensors").unlink()
    refused(folder, "at least 1 policies")


@pytest.mark.parametrize(
    ("policy", "reason"),
    [
        ({"name": "os.system"}, "name must be one of"),
        ({"name": "__import__"}, "name must be one of"),
        ({"name": ["PD"]}, "name: Input should be a valid string"),
        ({"numbers": {"task": 1.0}}, "task is an unknown key"),
        ({"numbers": {"frequency": "1"}}, "frequency: Input should be "),
        ({"numbers": {"frequency": True}}, "frequency: Input should be "),
        ({"numbers": {"frequency": [1.0]}}, "frequency: Input should be "),
        ({"numbers": {"frequency": float("nan")}}, "frequency: Input should be "),
        ({"numbers": {"frequency": 1e300}}, "frequency: Input should be "),
        ({"numbers": {"__class__": 1.0}}, "__class__ is an unknown key"),
        ({"numbers": 5}, "Input should be a valid dict"),
        ({"name": "zero", "numbers": {"action": 1.0}}, "action is an unknown key"),
        ({"name": "iLQR", "numbers": {"iterations": 1e6}}, "iterations is an unknown key"),
        ({"name": "cascade", "numbers": {"effort": -1.0}}, "cannot be made with these numbers"),
    ],
)
def test_controller_with_something_wrong(tmp_path, policy, reason):
    with pytest.raises(Refused, match=reason):
        built_in(tmp_path / "a", **policy)


def test_controller_with_arrays(tmp_path):
    built_in(tmp_path / "a")
    (tmp_path / "a" / "policy_0.safetensors").write_bytes(save(LINEAR))
    refused(tmp_path / "a", "such a policy has no arrays")


def test_kind_follows_from_the_architecture(tmp_path):
    table = linear(tmp_path / "table", policy=TABLE, arrays={0: GRID})
    plain, trained = linear(tmp_path / "a"), learned(tmp_path / "b", policy=FEEDBACK, arrays=FEEDBACKS)
    kinds = [
        made.kind for made in (learned(tmp_path / "net"), table, built_in(tmp_path / "it"), plain, trained)
    ]
    assert kinds == ["learned", "optimal", "controller", "controller", "learned"]
    for i, folder in enumerate(("net", "table", "it", "a", "b")):  # may be stated, as it once had to be
        for kind in ("learned", "optimal", "controller"):
            shutil.copytree(tmp_path / folder, tmp_path / f"{folder}-{kind}")
            replace(tmp_path / f"{folder}-{kind}", "schema = 1", f'schema = 1\nprotocol = 1\nkind = "{kind}"')
            if kind == kinds[i]:
                assert load(tmp_path / f"{folder}-{kind}").kind == kind
            else:
                refused(tmp_path / f"{folder}-{kind}", f'kind must be "{kinds[i]}" for this architecture')


def test_a_network_needs_its_training(tmp_path):
    with pytest.raises(Refused, match=r"\[training\] is missing"):
        learned(tmp_path / "a", training=None)
    with pytest.raises(Refused, match="at least 5 policies"):
        learned(tmp_path / "a", arrays={0: net(0)})
    with pytest.raises(Refused, match="at least 5 policies"):  # one who trained says so, five times
        linear(tmp_path / "a", training=TRAINING)


FEEDBACKS = {s: LINEAR | {"offset": np.full(1, 0.1 * s)} for s in range(5)}


@pytest.mark.parametrize(
    ("policy", "arrays", "reason"),
    [
        ({"axes": []}, {}, "axes: List should have at least 1 item"),
        ({"axes": ["x"] * 6}, {}, "axes: List should have at most 5 items"),
        ({"axes": ["x", "x"]}, {}, "axes must differ"),
        ({"axes": ["x", "theta"]}, {}, "axes must be among x, w, phi"),
        ({"axes": ["x", "x - w"]}, {}, "axes must be among x, w, phi"),
        ({"axes": ["x", 1]}, {}, "axes.1: Input should be a valid string"),
        ({"axes": ["x", "w", "phi"]}, {}, "'axis_2' is missing"),
        ({"kind": "code"}, {}, "kind: Input should be '"),
        ({"kind": "value", "actions": 1000}, {}, "actions: Input should be "),
        ({"actions": 5}, {}, "actions has no meaning in a table of actions; leave it out"),
        ({"mirror": "time"}, {}, "mirror must be one of the axes"),
        ({"mirror": "phi"}, {}, "mirror must be one of the axes"),
        ({"mirror": [1]}, {}, "mirror: Input should be a valid string"),
        ({}, {"axis_0": np.array([1.0, -1.0])}, "nodes of axis_0 must increase"),
        ({}, {"axis_0": np.array([1.0, 1.0])}, "nodes of axis_0 must increase"),
        ({}, {"axis_0": np.array([1.0])}, r"axis_0 must have the shape \(2\)"),
        ({}, {"axis_0": np.array([1.0, 2.0, 3.0])}, r"table must have the shape \(3, 3\)"),
        ({}, {"table": np.zeros((2, 3, 1))}, "table must have 2 axes"),
        ({}, {"table": np.zeros(6)}, "table must have 2 axes"),
        ({}, {"table": np.array(1.0)}, "table must have 2 axes"),
        ({}, {"table": np.full((2, 3), np.nan)}, "table has entries that are not finite"),
    ],
)
def test_table_with_something_wrong(tmp_path, policy, arrays, reason):
    linear(tmp_path / "good", policy=TABLE, arrays={0: GRID})
    with pytest.raises(Refused, match=reason):
        linear(tmp_path / "a", policy=TABLE | policy, arrays={0: GRID | arrays})


class Payload:
    """Runs code when unpickled."""

    def __reduce__(self):
        return (open, ("ran-code", "w"))


def zipped():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data.pkl", pickle.dumps(Payload()))
        archive.writestr("zeros", b"\0" * 10_000_000)
    return file.getvalue()


def numpy_file():
    file = io.BytesIO()
    np.save(file, np.array([Payload()], object), allow_pickle=True)
    return file.getvalue()


# --- hostile: arrays ---


@pytest.mark.parametrize(
    "content", [pickle.dumps(Payload()), zipped(), numpy_file(), b"", b"PK\x03\x04"], ids=range(5)
)
def test_what_runs_code_is_not_even_looked_at(folder, tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    (folder / "policy_0.safetensors").write_bytes(content)
    refused(folder, "not a safetensors file")
    assert not (tmp_path / "ran-code").exists()


def header(entries, data=b"\0" * 40, size=None):
    """Return a file with a header and data; the array gain is (4,) and offset (1,), both of F64."""
    text = entries if isinstance(entries, bytes) else json.dumps(entries).encode()
    return struct.pack("<Q", len(text) if size is None else size) + text + data


GAIN = {"dtype": "F64", "shape": [4], "data_offsets": [0, 32]}
OFFSET = {"dtype": "F64", "shape": [1], "data_offsets": [32, 40]}
BOTH = {"gain": GAIN, "offset": OFFSET}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (header(BOTH, size=2**63), "at most 16384 bytes"),
        (header(BOTH, size=10_000), "it is cut off"),
        (b"", "it is cut off after 0 bytes"),
        (header(BOTH)[:5], "it is cut off after 5 bytes"),
        (header(b" " * 20_000, size=20_000), "at most 16384 bytes"),
        (header(b"{" * 100), "not JSON"),
        (header(b"[" * 16_000), "not JSON"),
        (header(b'{"a":' * 3_000), "not JSON"),
        (header(b'{"gain": ' + b"9" * 9_000 + b"}"), "not JSON"),
        (header(b"\xff\xff"), "not JSON"),
        (header([]), "invalid type: sequence"),
        (header({}), "not fully covered"),
        (header(b'{"gain": {}, "gain": {}}'), "occurs twice"),
        (header(BOTH | {"__metadata__": {"a": "b"}}), "__metadata__ must have dtype"),
        (header(BOTH | {"gain": 5}), "must have dtype"),
        (header(BOTH | {"gain": GAIN | {"more": 1}}), "must have dtype"),
        (header(BOTH | {"gain": GAIN | {"dtype": "I64"}}), "of F32 or F64"),
        (header(BOTH | {"gain": GAIN | {"dtype": ["F64"]}}), "of F32 or F64"),
        (header(BOTH | {"gain": GAIN | {"dtype": "F16", "shape": [16]}}), "of F32 or F64"),
        (header(BOTH | {"gain": GAIN | {"shape": [-4]}}), "invalid JSON in header"),
        (header(BOTH | {"gain": GAIN | {"shape": [4.0]}}), "invalid JSON in header"),
        (header(BOTH | {"gain": GAIN | {"shape": [True] * 4}}), "invalid JSON in header"),
        (header(BOTH | {"gain": GAIN | {"shape": [2**62]}}), "overflow"),
        (header(BOTH | {"gain": GAIN | {"shape": [1] * 1000}}), "invalid (shape|offset)"),
        (header(BOTH | {"gain": GAIN | {"shape": [40] * 8}}), "invalid (shape|offset)"),
        (header(BOTH | {"gain": GAIN | {"shape": "4"}}), "invalid JSON in header"),
        (header(BOTH | {"gain": GAIN | {"data_offsets": [32, 0]}}), "invalid (shape|offset)"),
        (header(BOTH | {"gain": GAIN | {"data_offsets": [0]}}), "invalid length 1"),
        (header(BOTH | {"gain": GAIN | {"data_offsets": [0, 2**60]}}), "invalid (shape|offset)"),
        (header(BOTH | {"gain": GAIN | {"data_offsets": [8, 40]}}), "invalid offset for tensor `gain`"),
        (header(BOTH | {"offset": OFFSET | {"data_offsets": [0, 8]}}), "invalid offset for tensor `gain`"),
        (header(BOTH, data=b"\0" * 48), "not fully covered"),
        (header(BOTH, data=b"\0" * 39), "not fully covered"),
        (header({"gain": GAIN}, data=b"\0" * 32), "array 'offset' is missing"),
        (header(BOTH | {"../x": {"dtype": "F64", "shape": [0], "data_offsets": [40, 40]}}), "is not known"),
        (header(BOTH | {"gain": GAIN | {"shape": [2, 2]}}), "gain must have 1 axes"),
        (header(BOTH | {"gain": GAIN | {"dtype": "F32", "shape": [8]}}), r"the shape \(4\), got \(8,\)"),
        (header(BOTH, data=struct.pack("<5d", 0.0, float("nan"), 0.0, 0.0, 0.0)), "not finite"),
        (header(BOTH, data=struct.pack("<5d", 0.0, 0.0, 0.0, 0.0, float("-inf"))), "not finite"),
    ],
    ids=range(39),
)  # fmt: skip
def test_arrays_with_something_wrong(folder, content, reason):
    (folder / "policy_0.safetensors").write_bytes(header(BOTH))
    load(folder)
    (folder / "policy_0.safetensors").write_bytes(content)
    refused(folder, reason)


def test_negative_variance(tmp_path):
    arrays = net(0) | {"obs_mean": np.zeros(4), "obs_var": np.array([1.0, 1.0, -1e-9, 1.0])}
    with pytest.raises(Refused, match="obs_var must not be below 0"):
        network(tmp_path / "a", NET | {"normalise": {}}, arrays)


def test_every_single_bit_flip_is_refused_or_harmless(folder):
    """Whatever is changed in the arrays' file, the answer is a submission or a refusal."""
    file = folder / "policy_0.safetensors"
    content, first = file.read_bytes(), load(folder).digest
    for i in range(0, len(content), 3):
        for bit in (1, 128):
            changed = bytearray(content)
            changed[i] ^= bit
            file.write_bytes(changed)
            with suppress(Refused):
                assert load(folder).digest != first


# --- what costs time ---


def test_subnormal_numbers_are_zero(tmp_path):
    """Arithmetic with them takes fifty times as long."""
    arrays = {seed: net(seed) for seed in range(5)}
    for seed in arrays:
        arrays[seed] = {name: array.astype(np.float64) for name, array in arrays[seed].items()}
        arrays[seed]["weight_0"][0] = 1e-310
    made = learned(tmp_path / "it", arrays=arrays)
    assert (made.policies[0][1].arrays["weight_0"][0] == 0.0).all()
    x = np.array([[1e-310, 1.0]])
    assert affine(x, np.array([[1e300], [2.0]]), np.zeros(1)).item() == 2.0


def test_copies_of_one_policy_are_refused(nets):
    """However their files are padded."""
    content = (nets / "policy_0.safetensors").read_bytes()
    size = int.from_bytes(content[:8], "little")
    for seed in range(5):
        padding = b" " * (8 * seed)
        header = (size + len(padding)).to_bytes(8, "little") + content[8 : 8 + size] + padding
        (nets / f"policy_{seed}.safetensors").write_bytes(header + content[8 + size :])
    with pytest.raises(Refused, match="the policies of seeds 0 and 1 are the same"):
        load(nets)


def test_networks_have_a_limit_together(tmp_path, monkeypatch):
    monkeypatch.setattr(protocol, "ALL_NUMBERS", 90)
    with pytest.raises(Refused, match="have 95 numbers together; at most 90 are accepted"):
        learned(tmp_path / "it")


def test_plans_have_a_limit(tmp_path):
    with pytest.raises(Refused, match=r"opening.*10"):
        write(
            tmp_path / "it", **(ABOUT | {"env": "PivotedBar-v0"}),
            policy={"architecture": "controller", "name": "iLQR", "numbers": {"opening": 1e6}},
        )  # fmt: skip
