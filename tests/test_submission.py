"""Submissions: what is accepted, and that everything else is refused with a reason."""

import io
import json
import os
import pickle
import re
import shutil
import struct
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from covering import slow
from safetensors.numpy import save

from agents import measure
from lag_envs import sb3_policies
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.kernels import affine
from lag_envs.leaderboard.networks import bin_centres
from lag_envs.leaderboard.submission import Refused, load, write
from lag_envs.tasks import TASKS, cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.record import Goal

ENV = incline.Tilt.id
ABOUT = {"env": ENV, "name": "An agent", "authors": ["A. Nobody"], "license": "MIT"}
SLOW = pytest.mark.slow
TRAINING = {"env_steps": 1000, "seconds": 2.5, "hardware": "abacus"}
NET = {"architecture": "mlp", "hidden": [3], "activation": "tanh", "squash": "clip"}
LINEAR = {"gain": np.array([-1.0, -1.0, -3.0, 1.0]), "offset": np.zeros(1)}


def net(seed, widths=(4, 3, 1)):
    rng = np.random.default_rng(seed)
    arrays = {}
    for k, (columns, rows) in enumerate(pairwise(widths)):
        arrays[f"weight_{k}"] = rng.normal(size=(rows, columns)).astype(np.float32)
        arrays[f"bias_{k}"] = rng.normal(size=rows).astype(np.float32)
    return arrays


def learned(folder, **changed):
    arrays = {seed: net(seed) for seed in range(5)}
    given = ABOUT | {"policy": NET, "training": TRAINING, "arrays": arrays}
    return write(folder, **(given | changed))


def linear(folder, **changed):
    given = ABOUT | {"policy": {"architecture": "linear"}, "arrays": {0: LINEAR}}
    return write(folder, **(given | changed))


def network(folder, policy, arrays, **changed):
    """Write five networks, of which the first has these arrays, and the others do nearly the same."""
    last = max(name for name in arrays if name.startswith("bias_"))
    others = {seed: arrays | {last: arrays[last] + np.float32(1e-3 * seed)} for seed in range(5)}
    return learned(folder, policy=policy, arrays=others, **changed)


def built_in(folder, **policy):
    table = {"architecture": "controller", "name": "PD"} | policy
    return write(folder, policy=table, **ABOUT)


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


# --- what is accepted ---------------------------------------------------------------------------------------


def test_what_is_written_is_read(tmp_path):
    curve = {"seed": 1, "steps": [0, 500, 1000], "returns": [0.5, 1.5, 1e-3]}
    code = "https://example.org/a?b=1"
    made = learned(tmp_path / "a", code=code, description="Größe ±1", training=TRAINING | {"curves": [curve]})
    assert made.digest == load(tmp_path / "a").digest
    assert (made.env, made.name, made.authors, made.license) == (ENV, "An agent", ("A. Nobody",), "MIT")
    assert (made.kind, made.code, made.description) == ("learned", code, "Größe ±1")
    assert made.training == TRAINING | {"curves": [curve]}
    assert [seed for seed, _ in made.policies] == [0, 1, 2, 3, 4]
    for seed, policy in made.policies:
        for name, array in net(seed).items():
            assert np.array_equal(policy.arrays[name], array)
            assert not policy.arrays[name].flags.writeable


def test_digest_is_of_the_bytes(tmp_path):
    first, again = learned(tmp_path / "a"), learned(tmp_path / "b")
    assert first.digest == again.digest
    assert learned(tmp_path / "c", name="Another").digest != first.digest
    arrays = {s: net(s + 1) for s in range(5)}
    assert learned(tmp_path / "d", arrays=arrays).digest != first.digest


def test_policies_may_have_any_seeds_in_any_order(tmp_path):
    made = learned(tmp_path / "a", arrays={s: net(s) for s in (999_999_999, 7, 3, 5, 10)})
    assert [seed for seed, _ in made.policies] == [3, 5, 7, 10, 999_999_999]


def test_network_is_what_the_arrays_say(tmp_path):
    rng = np.random.default_rng(0)
    arrays = net(0, (4, 6, 5, 1)) | {"obs_mean": rng.normal(size=4), "obs_var": rng.uniform(0.5, 2.0, 4)}
    policy = NET | {"hidden": [6, 5], "activation": "relu", "squash": "tanh", "mean_limit": 0.4}
    policy["normalise"] = {"epsilon": 1e-4, "clip": 1.5}
    made = network(tmp_path / "a", policy, arrays)
    agent = made.policies[0][1].agent()
    observations = rng.normal(size=(100, 4)).astype(np.float32)
    x = np.clip((observations - arrays["obs_mean"]) / np.sqrt(arrays["obs_var"] + 1e-4), -1.5, 1.5)
    for k in (0, 1):
        x = np.maximum(x @ arrays[f"weight_{k}"].T + arrays[f"bias_{k}"], 0.0)
    x = x @ arrays["weight_2"].T + arrays["bias_2"]
    wanted = np.tanh(np.clip(x, -0.4, 0.4))
    found, state = agent.predict(observations)
    assert state is None and found.dtype == np.float32
    assert np.abs(wanted).max() > 0.37 and np.abs(found - wanted).max() < 1e-6
    # Each row for itself, to the bit.
    assert np.array_equal(np.array([agent.predict(o)[0] for o in observations]), found)


@pytest.mark.parametrize("name", ["tanh", "relu", "elu", "leaky_relu", "silu", "sigmoid"])
def test_activations_are_those_of_torch(name):
    torch = pytest.importorskip("torch")
    from lag_envs.leaderboard.networks import ACTIVATIONS

    x = np.linspace(-30.0, 30.0, 1001)
    module = {"tanh": "Tanh", "relu": "ReLU", "elu": "ELU", "leaky_relu": "LeakyReLU", "silu": "SiLU"}
    wanted = getattr(torch.nn, module.get(name, "Sigmoid"))()(torch.from_numpy(x)).numpy()
    assert np.abs(ACTIVATIONS[name](x) - wanted).max() < 1e-13


def test_bins_are_those_of_gymnasium(tmp_path):
    import gymnasium as gym

    env = gym.wrappers.DiscretizeAction(gym.make(ENV), bins=7)
    assert np.abs(env.bin_centers[0] - bin_centres(7)).max() < 1e-6
    policy = {"architecture": "mlp", "hidden": [], "bins": 7}
    arrays = {"weight_0": np.zeros((7, 4)), "bias_0": np.arange(7.0) % 5}
    made = network(tmp_path / "a", policy, arrays)
    assert made.policies[0][1].agent().predict(np.zeros(4))[0] == np.float32(bin_centres(7)[4])


def test_linear_feedback(tmp_path):
    agent = linear(tmp_path / "a").policies[0][1].agent()
    observations = np.array([[0.1, 0.2, 0.05, 0.3], [9.0, 0.0, 0.0, 0.0]], np.float32)
    assert np.allclose(agent.predict(observations)[0], [[-0.15], [-1.0]], atol=1e-7)


def test_table_of_actions(tmp_path):
    policy = {"architecture": "table", "kind": "action", "axes": ["x - target", "w", "time"]}
    axes = [np.array([-0.5, -0.1, 0.2]), np.array([-1.0, 1.0]), np.array([0.0, 0.05, 0.1])]
    x, w, t = np.meshgrid(*axes, indexing="ij")
    arrays = {f"axis_{j}": axis for j, axis in enumerate(axes)} | {"table": -x - 0.5 * w + 4.0 * t}
    agent = linear(tmp_path / "a", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    # (x, w, phi, target): inside, and far outside of two axes.
    observations = np.array([[0.2, 0.4, 0.0, 0.3], [-3.0, 5.0, 0.0, 0.0]], np.float32)
    action, state = agent.predict(observations)
    assert np.allclose(action[:, 0], [0.1 - 0.2, 0.5 - 0.5], atol=1e-6)
    action, state = agent.predict(observations, state)
    assert np.allclose(action[:, 0], [-0.1 + 0.2, 0.2], atol=1e-6)
    action, state = agent.predict(observations, state, np.array([True, False]))
    assert np.allclose(action[:, 0], [-0.1, 0.4], atol=1e-6)
    assert state.tolist() == [1.0, 3.0]


def test_mirrored_table(tmp_path):
    policy = {"architecture": "table", "kind": "action", "axes": ["x", "target"], "mirror": "target"}
    arrays = {"axis_0": np.array([-0.5, 0.5]), "axis_1": np.array([0.0, 0.3]), "table": np.zeros((2, 2))}
    arrays["table"][:] = [[0.1, 0.2], [0.3, 0.4]]
    agent = linear(tmp_path / "a", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    up = agent.predict(np.array([-0.5, 0.0, 0.0, 0.3]))[0]
    down = agent.predict(np.array([0.5, 0.0, 0.0, -0.3]))[0]
    assert up == pytest.approx(0.2) and down == -up


def test_table_of_values_looks_one_step_ahead(tmp_path):
    """With a value that only asks for x to grow, the plane is tilted as hard as can be."""
    policy = {"architecture": "table", "kind": "value", "axes": ["x"]}
    arrays = {"axis_0": np.array([-1.0, 1.0]), "table": np.array([-1e6, 1e6])}
    agent = linear(tmp_path / "a", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    observation = np.array([[0.0, 0.1, 0.0, 0.2]] * 2)
    first = agent.predict(observation)[0]
    arrays["table"] *= -1.0
    agent = linear(tmp_path / "b", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    assert (agent.predict(observation)[0] == -first).all() and (np.abs(first) == 1.0).all()


@pytest.mark.parametrize("numbers", [{}, {"frequency": 3.0, "lag": 1}])
def test_controller_is_the_built_in_one(tmp_path, numbers):
    from lag_envs.controllers import TiltPD

    made = built_in(tmp_path / "a", numbers=numbers)
    observations = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 4))
    wanted = TiltPD(TASKS[ENV](), **numbers).predict(observations)[0]
    assert np.array_equal(made.policies[0][1].agent().predict(observations)[0], wanted)
    assert os.listdir(tmp_path / "a") == ["submission.toml"]


def test_every_controller_of_every_environment_can_be_submitted(tmp_path):
    from lag_envs.controllers import controllers

    policy = {"architecture": "controller"}
    for env in ("PivotedBar-v0", incline.Brake.id):
        for i, name in enumerate(controllers(TASKS[env])):
            about = ABOUT | {"env": env, "policy": policy | {"name": name}}
            write(tmp_path / f"{env}{i}", **about)


def test_writing_refuses_and_leaves_nothing(tmp_path):
    with pytest.raises(Refused, match="0 to 60 characters"):
        linear(tmp_path / "a", name="x" * 61)
    assert os.listdir(tmp_path) == []
    linear(tmp_path / "a")
    with pytest.raises(FileExistsError):
        linear(tmp_path / "a")
    assert os.listdir(tmp_path) == ["a"]


# --- hostile: files -----------------------------------------------------------------------------------------


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
    refused(folder, "bytes, at most")


def test_files_too_large_together(folder):
    for seed in range(protocol.FOLDER_BYTES // protocol.POLICY_BYTES + 1):
        with (folder / f"policy_{seed}.safetensors").open("wb") as file:
            file.truncate(protocol.POLICY_BYTES)
    refused(folder, "the files have")


def test_too_many_policies(folder):
    for seed in range(protocol.MOST_POLICIES + 1):
        (folder / f"policy_{seed}.safetensors").write_bytes(b"")
    refused(folder, "more than 20 policies")


def test_very_many_files(folder):
    for i in range(1000):
        (folder / f"policy_{i}.safetensors").write_bytes(b"")
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


# --- hostile: text ------------------------------------------------------------------------------------------


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
        ('name = "An agent"', 'name = ""', "name: String should match"),
        ('name = "An agent"', 'name = "…"', "name: String should match"),
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
        ('name = "An agent"', f'name = "{"a" * 61}"', "0 to 60 characters"),
        ('authors = ["A. Nobody"]', "authors = []", "authors: List should have at least 1 item"),
        ('authors = ["A. Nobody"]', 'authors = "me"', "authors: .* list|authors: List "),
        ('authors = ["A. Nobody"]', 'authors = [" "]', "authors.*: there must be a letter or a digit"),
        ('authors = ["A. Nobody"]', 'authors = ["A", "..."]', "authors.*: there must be a letter or a digit"),
        ('authors = ["A. Nobody"]', 'authors = [""]', "authors.*: there must be a letter or a digit"),
        ('authors = ["A. Nobody"]', 'authors = ["\\u3164"]', r"invisible U\+3164"),
        ('authors = ["A. Nobody"]', 'authors = ["A\\u00adB"]', r"invisible U\+00AD"),
        ('authors = ["A. Nobody"]', "authors = [1]", "authors.0: Input should be a valid string"),
        ('authors = ["A. Nobody"]', "authors = [" + '"a", ' * 21 + "]", "authors: .* list|authors: List "),
        ('license = "MIT"', 'license = ""', "license: String should match"),
        ('license = "MIT"', 'license = "<b>"', "license: String should match"),
        ('license = "MIT"', 'license = "MIT"\ncode = "javascript:alert(1)"', "code: String should match"),
        ('license = "MIT"', 'license = "MIT"\ncode = "http://a.org"', "code: String should match"),
        ('license = "MIT"', """license = "MIT"\ncode = 'https://a.org/"x"'""", "code: String should match"),
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


def test_one_policy_under_several_seeds(nets):
    (nets / "policy_3.safetensors").write_bytes((nets / "policy_1.safetensors").read_bytes())
    refused(nets, "seeds 1 and 3 are the same")


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


FEEDBACK = {"architecture": "linear"}
FEEDBACKS = {s: LINEAR | {"offset": np.full(1, 0.1 * s)} for s in range(5)}
GRID = {"axis_0": np.array([-1.0, 1.0]), "axis_1": np.array([0.0, 1.0, 2.0]), "table": np.zeros((2, 3))}
TABLE = {"architecture": "table", "kind": "action", "axes": ["x", "w"]}


@pytest.mark.parametrize(
    ("policy", "arrays", "reason"),
    [
        ({"axes": []}, {}, "axes: List should have at least 1 item"),
        ({"axes": ["x"] * 6}, {}, "axes: List should have at most 5 items"),
        ({"axes": ["x", "x"]}, {}, "axes must differ"),
        ({"axes": ["x", "theta"]}, {}, "axes must be of x, w, phi"),
        ({"axes": ["x", "x - w"]}, {}, "axes must be of x, w, phi"),
        ({"axes": ["x", 1]}, {}, "axes.1: Input should be a valid string"),
        ({"axes": ["x", "w", "phi"]}, {}, "'axis_2' is missing"),
        ({"kind": "code"}, {}, "kind: Input should be '"),
        ({"kind": "value", "actions": 1000}, {}, "actions: Input should be "),
        ({"actions": 5}, {}, "actions means nothing in a table of actions; leave it out"),
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


# --- hostile: arrays ----------------------------------------------------------------------------------------


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
        (header(BOTH, size=10_000), "not JSON"),
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
    ids=range(37),
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
            try:
                assert load(folder).digest != first
            except Refused:
                pass


# --- export -------------------------------------------------------------------------------------------------


def model(algo, seed=0, bins=0, normalise=False, env_id=ENV, **options):
    """Return an untrained model with steep layers, and its normalisation, as a training would leave them."""
    sb3 = pytest.importorskip("stable_baselines3")
    import gymnasium as gym
    import torch
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    import lag_envs  # noqa: F401  (registers the environments)

    def make():
        env = gym.make(env_id)
        return gym.wrappers.DiscretizeAction(env, bins=bins) if bins else env

    torch.set_num_threads(1)
    env = DummyVecEnv([make])
    if normalise:
        env = VecNormalize(env)
        env.seed(seed)
        env.reset()
        for _ in range(20):
            env.step(np.array([env.action_space.sample()]))
    place = pytest.importorskip("sb3_contrib") if algo == "TQC" else sb3
    if algo in ("SAC", "TD3", "TQC", "DQN", "DDPG"):
        options["buffer_size"] = 10
    kind = options.pop("kind", "MlpPolicy")
    made = getattr(place, algo)(kind, env, seed=seed, device="cpu", **options)
    for parameter in made.policy.parameters():
        parameter.data *= 2.0
    return made, env if normalise else None


@pytest.mark.parametrize(
    ("algo", "options"),
    [
        ("PPO", {"use_sde": True, "normalise": True}),
        ("PPO", {"use_sde": True, "policy_kwargs": {"squash_output": True, "net_arch": [8, 5]}}),
        ("PPO", {"bins": 5, "policy_kwargs": {"net_arch": []}}),
        pytest.param("A2C", {}, marks=SLOW),
        ("SAC", {"use_sde": True, "policy_kwargs": {"net_arch": [16, 16]}}),
        pytest.param("SAC", {"normalise": True, "policy_kwargs": {"net_arch": [16]}}, marks=SLOW),
        ("TD3", {"policy_kwargs": {"net_arch": [16, 16]}}),
        ("TQC", {"kind": sb3_policies.TQC, "policy_kwargs": {"net_arch": [16, 16]}}),
        pytest.param("DDPG", {"policy_kwargs": {"net_arch": [16, 16]}}, marks=SLOW),
        slow("TQC", {"use_sde": True, "policy_kwargs": {"net_arch": [16, 16]}}),
        ("DQN", {"bins": 9, "normalise": True, "policy_kwargs": {"net_arch": [16, 16]}}),
    ],
)
def test_export_acts_as_the_model(algo, options, tmp_path):
    from lag_envs.leaderboard.export import Source, algorithm_of, convert, difference

    made, normalise = model(algo, **options)
    made.save(tmp_path / "model.zip")
    # A policy of our own does not tell what it was trained by; its training's result does.
    result = {"algo": algo.lower()} if "kind" in options else None
    found = algorithm_of(Source(tmp_path / "model.zip", result=result))
    assert found == {"DDPG": "td3"}.get(algo, algo.lower())
    table, arrays = convert(made, normalise)
    agent = network(tmp_path / "a", table, arrays).policies[0][1].agent()
    off, count = difference(made, normalise, agent, ENV)
    assert off <= 1e-5 and count == 16_384
    if algo == "SAC" and "use_sde" in options:
        assert table["mean_limit"] == 2.0
    # A change that can be felt is noticed.
    arrays["weight_0"] = -arrays["weight_0"]
    agent = network(tmp_path / "b", table, arrays).policies[0][1].agent()
    assert difference(made, normalise, agent, ENV)[0] > 1e-3


@pytest.mark.parametrize("algo", ["PPO", "DQN"])
def test_export_of_a_model_that_chooses_what_the_environment_lists(algo, tmp_path, monkeypatch):
    from lag_envs.leaderboard.export import convert, difference

    env = next(env_id for env_id, task in TASKS.items() if len(task().formulas.choices) == 1)
    monkeypatch.setattr(TASKS[env], "goal", Goal("success: none is asked for", hold=None))  # gives it a board
    made, _ = model(algo, env_id=env, policy_kwargs={"net_arch": [8]})
    table, arrays = convert(made, listed=True)
    assert not {"bins", "squash"} & set(table)
    agent = network(tmp_path / "a", table, arrays, env=env).policies[0][1].agent()
    assert difference(made, None, agent, env) == (0.0, 16_384)
    arrays["weight_0"] = -arrays["weight_0"]
    agent = network(tmp_path / "b", table, arrays, env=env).policies[0][1].agent()
    assert difference(made, None, agent, env)[0] == 1.0


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Five finished runs, as `agents.train` leaves them."""
    above = tmp_path_factory.mktemp("runs") / ENV / "ppo"
    for seed in range(5):
        made, normalise = model("PPO", seed, normalise=True)
        folder = above / f"seed{seed}"
        folder.mkdir(parents=True)
        made.save(folder / "model.zip")
        normalise.save(folder / "vecnormalize.pkl")
        result = {
            "env": ENV, "seed": seed, "trained": 500, "wall_seconds": 2.0 + seed, "machine": "abacus",
            "curve": [[0, 0.0, 1.0], [500, 1.0, 2.0], [500, 1.1, 3.0]],
        }  # fmt: skip
        (folder / "result.json").write_text(json.dumps(result))
    return above


def export_command(*arguments):
    import argparse

    from lag_envs.leaderboard.export import declare_export, run_export

    parser = argparse.ArgumentParser()
    declare_export(parser)
    return run_export(parser.parse_args([str(a) for a in arguments]))


def test_command_exports_the_runs_of_a_folder(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert export_command(runs, "--author", "A", "--author", "B", "--license", "MIT") == 0
    assert "largest difference" in capsys.readouterr().out
    made = load(tmp_path / f"{ENV}-PPO")
    assert (made.env, made.name, made.authors, made.kind) == (ENV, "PPO", ("A", "B"), "learned")
    curves = [{"seed": s, "steps": [0, 500], "returns": [1.0, 3.0]} for s in range(5)]
    assert made.training == {"env_steps": 500, "seconds": 4.0, "hardware": "abacus", "curves": curves}
    assert made.policies[0][1].architecture.normalise.model_dump() == {"epsilon": 1e-8, "clip": 10.0}
    # So they are measured, to the bit: in chaotic motion a rounding makes other episodes.
    seen = np.random.default_rng(0).normal(size=(100, len(TASKS[ENV]().observation))).astype(np.float32)
    for seed, policy in made.policies:
        measured = measure._policy(ENV, runs / f"seed{seed}").predict(seen)[0]
        assert measured.tobytes() == policy.agent().predict(seen)[0].tobytes()


def test_command_exports_files(runs, tmp_path):
    from lag_envs.errors import UserError

    files = [runs / f"seed{s}" / "model.zip" for s in range(5)]
    norms = [file.with_name("vecnormalize.pkl") for file in files]
    given = [*files, "--author", "A", "--license", "MIT", "--output", tmp_path / "out"]
    with pytest.raises(UserError, match="give --env"):
        export_command(*given, "--normalise", *norms)
    given += ["--env", ENV]
    with pytest.raises(UserError, match="give --seconds"):
        export_command(*given, "--normalise", *norms)
    given += ["--seconds", 5]
    with pytest.raises(UserError, match="one file for each path"):
        export_command(*given, "--normalise", norms[0])
    with pytest.raises(UserError, match=f"do not fit {incline.Brake.id}"):
        export_command(*given, "--env", incline.Brake.id)
    with pytest.raises(UserError, match="there is no environment 'x'"):
        export_command(*given, "--env", "x")
    assert not (tmp_path / "out").exists()
    export_command(*given, "--normalise", *norms, "--name", "Mine")
    assert load(tmp_path / "out").name == "Mine"
    with pytest.raises(UserError, match="already exists"):
        export_command(*given)


def test_models_that_cannot_be_exported(runs, tmp_path):
    torch = pytest.importorskip("torch")
    from lag_envs.leaderboard.export import ExportError, Source, convert, export, find

    made, _ = model("PPO", policy_kwargs={"activation_fn": torch.nn.Hardswish})
    with pytest.raises(ExportError, match="all activations must be one of"):
        convert(made)
    with pytest.raises(ExportError, match="is neither a model nor a folder"):
        find([tmp_path])
    (tmp_path / "x.zip").write_bytes(b"no zip")
    with pytest.raises(ExportError, match="not a model of Stable-Baselines3"):
        export([Source(tmp_path / "x.zip")], tmp_path / "a", authors=["A"], license="MIT", env=ENV, seconds=1)
    with pytest.raises(ExportError, match="at least 5 policies"):
        export(find([runs / "seed0"]), tmp_path / "a", authors=["A"], license="MIT")
    made, _ = model("PPO", policy_kwargs={"net_arch": [7]})
    made.save(tmp_path / "other.zip")
    sources = [*find([runs / "seed0"]), Source(tmp_path / "other.zip")]
    with pytest.raises(ExportError, match="networks differ"):
        export(sources, tmp_path / "a", authors=["A"], license="MIT", seconds=1.0)


# --- our own agents -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("env", [pivoted_bar.SwingUpFree.id, cylinder_in_cylinder.Pump.id, incline.Tilt.id])
def test_optimal_table_is_the_value_function(env, tmp_path):
    pytest.importorskip("tqdm")
    from dataclasses import replace as replaced

    from agents.optimum import GreedyPolicy, Solution
    from agents.submit import tabulate

    problem = TASKS[env].value_iteration
    axes = tuple(replaced(axis, level=0.25) for axis in problem.axes)
    problem = replaced(problem, axes=axes, targets=(0.0, 0.3)[: len(problem.targets)])
    solution = Solution(env, 0.25, folder=None, quiet=True, problem=problem)
    policy, arrays = tabulate(solution)
    about = ABOUT | {"env": env, "policy": policy, "arrays": {0: arrays}}
    agent = write(tmp_path / "a", **about).policies[0][1].agent()
    rng = np.random.default_rng(0)
    nodes = np.stack([rng.choice(axis, 200) for axis in solution.programs[0].grid.axes], axis=1)
    targets = rng.choice([-0.3, 0.0, 0.3], 200) if problem.targets else np.zeros(200)
    if problem.targets:
        nodes[:, 0] += targets
    wanted = solution.expected(1, nodes, targets if problem.targets else None)
    found = agent.value(nodes, targets, np.zeros(200))
    inside = np.abs(nodes[:, 0]) < 0.4 if problem.targets else np.ones(200, np.bool_)
    most = (0.05 if problem.targets else 1e-5) * (wanted.max() - wanted.min())
    assert (nodes < 0.0).any() and inside.sum() > 50
    assert np.abs(found - wanted)[inside].max() < most
    if env == pivoted_bar.SwingUpFree.id:
        theta, theta_dot = rng.uniform(-3.0, 3.0, (2, 200))
        seen = np.stack([np.cos(theta), np.sin(theta), theta_dot / 8.0], axis=1)
        acting, best = agent.predict(seen)[0], GreedyPolicy(env, solution=solution).predict(seen)[0]
        assert (np.abs(acting - best) < 1e-6).mean() > 0.9


def test_all_agents_are_submitted(runs, tmp_path, monkeypatch, capsys):
    pytest.importorskip("tqdm")
    from agents.submit import main
    from lag_envs.controllers import controllers

    shutil.copytree(runs, tmp_path / "runs" / ENV / "ppo")
    (tmp_path / "runs" / ENV / "sac" / "seed0").mkdir(parents=True)
    (tmp_path / "runs" / ENV / "sac" / "seed0" / "model.zip").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    assert main(["out", "--envs", ENV]) == 0
    assert "left out, it has 1 finished" in capsys.readouterr().out
    found = {load(folder).name for folder in (tmp_path / "out").iterdir()}
    assert found == {*controllers(TASKS[ENV]), "PPO"}
    assert main(["out", "--envs", ENV]) == 0
    assert main(["out", "--envs", "Nothing"]) == 2


# --- the page about the format ------------------------------------------------------------------------------


def test_page_shows_submissions_that_are_accepted(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "submissions.md").read_text(encoding="utf-8")
    first, ahead, named = (part.split("```")[0] for part in text.split("```toml\n")[1:])
    start = first.replace('"learned"', '"controller"').split("[training]")[0]
    whole, planned, built = (tmp_path / name for name in ("whole", "planned", "built-in"))
    for folder, about in (
        (whole, first),
        (planned, start.replace("schema = 1", "schema = 2") + ahead),
        (built, start + named),
    ):
        folder.mkdir()
        (folder / "submission.toml").write_text(about, encoding="utf-8")
    for seed in range(5):
        (whole / f"policy_{seed}.safetensors").write_bytes(save(net(seed, (3, 32, 32, 1))))
    assert len(load(whole).policies) == 5
    assert load(planned).architecture.plans
    assert load(built).policies[0][1].agent().catch == 5.0


def test_page_tells_the_limits():
    text = (Path(__file__).parents[1] / "docs" / "submissions.md").read_text(encoding="utf-8")
    p = protocol
    for told in (
        f"{p.TOML_BYTES // 1024} KiB, lines of {p.LINE:,} characters",
        f"{p.POLICY_BYTES // 2**20} MiB, {p.FOLDER_BYTES // 2**20} MiB",
        f"{p.MOST_POLICIES}; of kind `learned` at least {p.LEARNED_POLICIES}",
        f"{p.LAYERS} hidden layers of width {p.WIDTH:,}, {p.NUMBERS:,} numbers",
        f"{p.FRAMES} frames, a memory of {p.MEMORY}",
        f"{p.CURVE} points",
    ):
        assert told in text
    from lag_envs.leaderboard.networks import ACTIVATIONS
    from lag_envs.leaderboard.policies import ARCHITECTURES

    assert all(f"`{name}`" in text for name in (*ACTIVATIONS, *ARCHITECTURES))


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


def test_copies_of_one_policy_are_refused(tmp_path, nets):
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
    with pytest.raises(Refused, match="have 95 numbers together, at most 90 are accepted"):
        learned(tmp_path / "it")


def test_plans_have_a_limit(tmp_path):
    with pytest.raises(Refused, match=r"opening.*10"):
        write(
            tmp_path / "it", **(ABOUT | {"env": "PivotedBar-v0"}),
            policy={"architecture": "controller", "name": "iLQR", "numbers": {"opening": 1e6}},
        )  # fmt: skip
