"""The cache of compiled code: whatever happens to its files, functions keep working correctly."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
from covering import every
from numba.core import codegen

from lag_envs.cli import main
from lag_envs.stepping import cache, machine
from lag_envs.tasks import incline

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


def double(x):
    return x + x


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """Give each test a cache of its own, and let each process warn once."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "compiled"))
    monkeypatch.setattr(cache, "_warned", False)
    return cache.folder()


def hits(key="some source", value=1.5):
    """Call the function through a new dispatcher; return how often it was found in the cache."""
    function = cache.jit(double, key)
    assert function(value) == 2 * value
    return sum(function.stats.cache_hits.values())


def files(place):
    return [entry.path for entry in cache.cache_files(place)]


def flipped(at):
    def flip(path):
        data = bytearray(path.read_bytes())
        data[at if at >= 0 else len(data) + at] ^= 1 << random.Random(at).randrange(8)
        path.write_bytes(data)

    return flip


def replaced(make):
    def replace(path):
        path.unlink()
        make(path)

    return replace


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "one byte": lambda path: path.write_bytes(b"l"),
    "cut in the head": lambda path: path.write_bytes(path.read_bytes()[:20]),
    "cut in the digest": lambda path: path.write_bytes(path.read_bytes()[:60]),
    "nothing but a head": lambda path: path.write_bytes(path.read_bytes()[:74]),
    "cut in half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "last byte lost": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "a byte more": lambda path: path.write_bytes(path.read_bytes() + b"\0"),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "garbage": lambda path: path.write_bytes(random.Random(0).randbytes(5000)),
    "text": lambda path: path.write_text("not compiled"),
    **{f"byte {at} flipped": flipped(at) for at in (0, 9, 10, 41, 42, 73, 74, 500, 5000, -1)},
    "an empty folder": replaced(Path.mkdir),
    "too long": lambda path: os.truncate(path, cache.LIMIT + 1),
}
if hasattr(os, "mkfifo"):
    DAMAGE["a pipe"] = replaced(os.mkfifo)


@pytest.mark.parametrize("how", every(3, DAMAGE))
def test_a_damaged_file_is_dropped_with_one_warning(place, how):
    assert (hits(), hits()) == (0, 1)
    assert (hits("other source"), hits("other source")) == (0, 1)
    for path in files(place):
        DAMAGE[how](path)
        assert cache.damage(path)
    with pytest.warns(RuntimeWarning, match="damaged: .*compiled again") as told:
        assert (hits(), hits("other source")) == (0, 0)
    assert len(told) == 1
    assert (hits(), hits("other source")) == (1, 1)
    assert not any(map(cache.damage, files(place)))


def test_a_whole_file_of_something_else_is_not_believed(place):
    hits()
    (mine,) = files(place)
    hits("other source")
    (other,) = set(files(place)) - {mine}
    os.replace(other, mine)
    with pytest.warns(RuntimeWarning, match="belongs to another function"):
        assert hits() == 0


def test_a_file_that_numba_cannot_read_is_dropped(place):
    # As another build of Numba with the same version might leave it.
    hits()
    (path,) = files(place)
    key = path.read_bytes()[len(cache._MAGIC) : len(cache._MAGIC) + 32]
    cache._write(path, key, b"no pickle")
    with pytest.warns(RuntimeWarning, match="UnpicklingError"):
        assert hits() == 0
    assert hits() == 1


def test_what_decides_the_code_decides_the_file(place, monkeypatch):
    assert hits() == 0
    assert hits(value=3) == 0  # another type
    assert hits("changed source") == 0
    monkeypatch.setattr(sys, "version", "4.0")
    assert hits() == 0
    assert len(files(place)) == 4


def test_a_numba_that_is_not_known_is_made_ready_in_full(place, monkeypatch):
    monkeypatch.setattr(cache, "_KNOWN", (0, 0))
    assert (hits(), hits()) == (0, 1)


def test_links_are_not_followed_when_dropped(place, tmp_path):
    hits()
    (path,) = files(place)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("precious")
    path.unlink()
    path.symlink_to(elsewhere)
    with pytest.warns(RuntimeWarning):
        assert hits() == 0
    assert elsewhere.read_text() == "precious"
    path.unlink()
    path.symlink_to(tmp_path / "nowhere")
    assert (hits(), hits()) == (0, 1)


@pytest.mark.parametrize("kind", ["a file", "below a file", "no permission"])
def test_without_a_folder_that_can_be_written_to(kind, tmp_path, monkeypatch, capsys):
    parent = tmp_path / "parent"
    if kind == "no permission":
        parent.mkdir(mode=0o500)
        if os.access(parent, os.W_OK):
            parent = Path("/proc/self")  # not even the administrator may write here
            if not parent.is_dir():
                pytest.skip("an administrator may write everywhere here")
    else:
        parent.write_text("a file")
        parent = parent / "deeper" if kind == "below a file" else parent
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(parent))
    assert (hits(), hits()) == (0, 0)
    assert main(["cache"]) == 0
    assert "compiles" in capsys.readouterr().out
    assert main(["cache", "--clear"]) == 0


def test_what_cannot_be_removed_is_told(place, monkeypatch, capsys):
    hits()
    monkeypatch.setattr(cache, "_remove", lambda path: False)  # as in a folder that may only be read
    assert main(["cache", "--clear"]) == 1
    told = capsys.readouterr()
    assert "0 files removed" in told.out and f"1 could not be removed, such as {place}" in told.err


def test_a_file_that_may_not_be_read(place):
    hits()
    (path,) = files(place)
    path.chmod(0)
    expected = int(os.access(path, os.R_OK))  # an administrator may
    assert hits() == expected
    assert hits() == 1


def test_ctrl_c_while_llvm_hands_over_the_code(place, monkeypatch):
    # The exception is lost in LLVM's callback, and then there is no code to keep.
    function = cache.jit(double, "some source")
    with monkeypatch.context() as interrupted:
        lost = property(lambda library: None, lambda library, code: None)
        interrupted.setattr(codegen.CPUCodeLibrary, "_compiled_object", lost, raising=False)
        with pytest.raises(KeyboardInterrupt):
            function(1.5)
    assert function(1.5) == 3.0
    assert not files(place)
    assert (hits(), hits()) == (0, 1)


@pytest.mark.skipif(resource is None, reason="this system has no limit on the size of files")
def test_a_full_disk(place):
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        found = hits(), hits()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert found == (0, 0)
    assert not files(place)
    assert (hits(), hits()) == (0, 1)


def test_its_size_is_bounded_and_what_is_used_stays(place, monkeypatch):
    hits("0")
    size = cache.cache_files(place)[0].size
    monkeypatch.setattr(cache, "LIMIT", 3 * size + size // 2)
    for name in "12":
        hits(name)
    for entry in cache.cache_files(place):  # all a year old; using one makes it young
        os.utime(entry.path, (0, time.time() - 3e7))
    assert hits("0") == 1
    for name in "34":
        hits(name)
    assert sum(entry.size for entry in cache.cache_files(place)) <= cache.LIMIT
    assert [hits(name) for name in "0341"] == [1, 1, 1, 0]
    # Left-overs of a killed process count, and are removed like the rest.
    left = place / f"new-12345{cache._SUFFIX}"
    left.write_bytes(bytes(size))
    os.utime(left, (0, 0))
    hits("5")
    assert not left.exists()


@pytest.mark.slow
def test_processes_that_race(place):
    # All compile and write the same file, read it repeatedly, and damage it in between.
    code = """
import os, random, sys, warnings
warnings.simplefilter("ignore")
from lag_envs.stepping import cache
from lag_envs.tasks import incline
def double(x):
    return x + x
rng = random.Random(int(sys.argv[1]))
for i in range(8):
    assert cache.jit(double, "some source")(1.5) == 3.0
    for entry in cache.cache_files(cache.folder()):
        what = rng.randrange(4)
        try:
            if what == 0:
                os.unlink(entry.path)
            elif what == 1:
                os.truncate(entry.path, rng.randrange(entry.size))
        except (OSError, ValueError):
            pass
"""
    run = [sys.executable, "-c", code]
    processes = [
        subprocess.Popen([*run, str(i)], env=environment(), stderr=subprocess.PIPE) for i in range(3)
    ]
    errors = [process.communicate()[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], errors


def environment():
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


STEP = """
import hashlib, sys, gymnasium as gym, numpy as np, lag_envs
env = gym.make(sys.argv[1]).unwrapped
envs = gym.make_vec(sys.argv[1], num_envs=3)
digest = hashlib.sha256(env.reset(seed=1)[0])
envs.reset(seed=1)
for i in range(50):
    action = np.float32(np.sin(i))
    for part in (*env.step(np.array([action]))[:2], *envs.step(np.full((3, 1), action))[:2]):
        digest.update(np.asarray(part).tobytes())
print(digest.hexdigest(), "numba.np.arraymath" in sys.modules)
"""


@pytest.mark.slow
def test_environments_step_on_whatever_is_left_of_their_code(place):
    def step():
        command = [sys.executable, "-c", STEP, incline.Brake.id]  # the quickest to compile
        run = subprocess.run(command, env=environment(), capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
        return *run.stdout.split(), run.stderr

    bits, compiled, silence = step()
    assert (compiled, silence) == ("True", "")
    assert len(files(place)) >= 4
    # A warm start need not initialise the compiler, which would take most of its time.
    assert step() == (bits, "False", "")
    rng = random.Random(1)
    for path in files(place):
        if not path.name.startswith("flow"):  # entries that are read whole are linked with new code
            flipped(rng.randrange(path.stat().st_size))(path)
    again, compiled, told = step()
    assert (again, compiled) == (bits, "True")
    assert told.count("RuntimeWarning") == 1
    assert "Traceback" not in told
    assert step() == (bits, "False", "")


def test_the_command(place, capsys):
    def call(*arguments):
        assert main(["cache", *arguments]) == 0
        return capsys.readouterr().out

    assert "functions  0" in call()
    hits()
    hits("other source")
    out = call()
    assert str(place) in out
    assert "functions  2" in out
    assert "damaged    0" in out
    assert "writable   yes" in out
    bad = files(place)[0]
    bad.write_bytes(b"")
    out = call()
    assert "damaged    1" in out
    assert str(bad) in out
    assert "2 files removed" in call("--clear")
    assert not files(place)
    assert hits() == 0


def test_where_it_lies(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    assert cache.folder() == tmp_path / "lag_envs"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache.folder() == tmp_path / ".cache" / "lag_envs"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert cache.folder() == tmp_path / "Library" / "Caches" / "lag_envs"

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    assert cache.folder() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (hits(), hits()) == (0, 0)


NAMED = 1.0


def test_other_machine_code_is_kept_too(place):
    made = []

    def code(parts, what=b"code"):
        return cache.kept("kernels", parts, lambda: (made.append(parts), what)[1])

    assert code("a") == code("a") == b"code" and made == ["a"]
    assert code("b", b"other") == b"other" and made == ["a", "b"]
    flipped(-1)(next(path for path in files(place) if b"other" in path.read_bytes()))
    with pytest.warns(RuntimeWarning, match="is damaged: its digest does not match"):
        assert code("b", b"other") == b"other"
    assert made == ["a", "b", "b"] and len(files(place)) == 2


def test_numbers_that_a_function_names_decide_too(monkeypatch):
    def found():
        function = cache.jit(add_named)
        return function(1.0), sum(function.stats.cache_hits.values())

    assert [found(), found()] == [(2.0, 0), (2.0, 1)]
    monkeypatch.setitem(globals(), "NAMED", 2.0)
    assert found() == (3.0, 0)


def add_named(x):
    return x + NAMED


def test_the_length_of_rows_decides_the_printed_steps(monkeypatch):
    before = machine._version()
    monkeypatch.setattr(machine, "BLOCK", machine.BLOCK // 2)
    assert machine._version.__wrapped__() != before
