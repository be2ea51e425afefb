"""Work in other processes: one that dies or hangs loses only its own, and none outlives its parent."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import pytest
from covering import slow
from pebble.pool.process import WorkerManager

from lag_envs import workers
from lag_envs.workers import ClusterError, as_they_finish, check_address, died, processes

HERE = Path(__file__).parents[1]
greeting = ""


def begin(text):
    global greeting
    greeting = text


def work(what):
    if what == "dies":
        os._exit(3)
    if what == "is killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "hangs":
        time.sleep(1000)
    if what == "raises":
        raise ValueError("no\nsuch")
    if what == "returns what cannot be sent":
        return lambda: None
    return greeting, os.environ["OMP_NUM_THREADS"]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_whatever_becomes_of_one_the_others_go_on():
    given = ["dies", "is killed", "hangs", "raises", "returns what cannot be sent", "works", "works too"]
    threads = os.environ.get("OMP_NUM_THREADS")
    with processes(2, begin, "hello") as submit:
        limits = {"hangs": 3.0}
        found = dict(as_they_finish({submit(work, what, timeout=limits.get(what)): what for what in given}))
    assert found["works"] == found["works too"] == ("hello", "1")
    assert died(found["dies"]) == "the process died, exit status 3"
    assert died(found["is killed"]) == "the process died, exit status -9"
    assert isinstance(found["hangs"], TimeoutError)
    assert died(found["raises"]) == "ValueError: no"
    assert isinstance(found["returns what cannot be sent"], Exception)
    assert os.environ.get("OMP_NUM_THREADS") == threads


@pytest.mark.parametrize("given", [["dies", "works"], slow(["hangs", "dies", "works"])])
def test_a_death_belongs_to_its_work_though_its_message_is_late(given, monkeypatch):
    """On a busy machine, a process may be found dead before it was read that it had taken the work."""
    receive = WorkerManager.receive

    def late(self, timeout):
        time.sleep(0.3)
        return receive(self, timeout)

    monkeypatch.setattr(WorkerManager, "receive", late)
    with processes(2, begin, "hello") as submit:
        limits = {"hangs": 3.0}
        futures = {what: submit(work, what, timeout=limits.get(what)) for what in given}
        assert died(futures["dies"].exception(timeout=60.0)) == "the process died, exit status 3"
        assert futures["works"].result(timeout=60.0) == ("hello", "1")


def test_an_error_counts_though_it_is_falsy():
    future = Future()
    future.set_exception(error := type("Empty", (Exception,), {"__len__": lambda _: 0})())
    assert list(as_they_finish({future: "work"})) == [("work", error)]


def test_who_leaves_early_does_not_wait():
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), processes(1) as submit:
        submit(work, "hangs")
        raise KeyboardInterrupt
    assert time.monotonic() - started < 60.0


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os, test_workers\n"
        "from lag_envs.workers import processes\n"
        "if __name__ == '__main__':\n"
        "    with processes(1) as submit:\n"
        "        print(submit(os.getpid).result(), flush=True)\n"
        "        submit(test_workers.work, 'hangs').result()\n"
    )
    path = os.pathsep.join([str(HERE / "src"), str(HERE / "tests"), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment
    )
    child = int(parent.stdout.readline())
    time.sleep(1.0)
    parent.kill()
    parent.communicate()
    end = time.monotonic() + 60.0
    while Path(f"/proc/{child}").exists() and "Z" not in Path(f"/proc/{child}/stat").read_text().split():
        assert time.monotonic() < end
        time.sleep(0.05)


STOPPABLE = """
import sys, time
from lag_envs.workers import obey_parent, stopping_point
obey_parent()
print("begins", flush=True)
try:
    for _ in range(600):
        time.sleep(0.1)
        if sys.argv[1] == "obeys":
            stopping_point()
except KeyboardInterrupt:
    print("keeps it", flush=True)
    sys.exit(5)
"""


@pytest.mark.skipif(os.name != "posix", reason="sends signals to a process group")
@pytest.mark.parametrize(
    ("child", "signals", "pause", "told", "status"),
    [
        ("obeys", ["SIGINT"], 0.0, "keeps it\n", 5),
        ("obeys", ["SIGTERM", "SIGTERM"], 0.0, "keeps it\n", 5),  # as `timeout` does
        ("does not", ["SIGINT", "SIGINT"], 1.5 * workers.AT_ONCE, "", 130),
        ("does not", ["SIGKILL"], 0.0, "", -9),
    ],
)
def test_a_process_stops_when_asked_and_is_killed_when_asked_again(child, signals, pause, told, status):
    """Ctrl-C in a terminal reaches both, a kill of the parent only that; in no case does the other go on."""
    script = "import os, sys; from lag_envs.workers import run_stoppable\n"
    script += f"sys.exit(run_stoppable([sys.executable, '-c', {STOPPABLE!r}, {child!r}], os.environ))"
    parent = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    assert parent.stdout.readline() == "begins\n"
    for name in signals:
        (os.killpg if name == "SIGINT" else os.kill)(parent.pid, getattr(signal, name))
        if pause:
            while "stopping" not in (line := parent.stderr.readline()):
                assert line
            time.sleep(pause)
            pause = 0.0
    out, _ = parent.communicate(timeout=60.0)  # ends with the last process that holds the pipe
    assert (out, parent.returncode) == (told, status)


def test_a_cluster_that_does_not_start(monkeypatch):
    def init(*args, **kwargs):
        raise Exception("The current node timed out during startup.")  # like Ray

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init))
    with (
        pytest.raises(ClusterError, match="no Ray cluster at 'local': The current node"),
        workers.cluster("local"),
    ):
        pass


def test_a_missing_cluster_is_named(monkeypatch):
    for address in ("127.0.0.1:1", "ray://127.0.0.1:1", "host:port"):
        with pytest.raises(ClusterError, match="no Ray cluster at"):
            check_address(address)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ClusterError, match=r"pip install 'lag-envs\[ray\]'"), workers.cluster("local"):
        pass
