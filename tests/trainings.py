"""Trainings for tests, which can be interrupted at a chosen step."""

import os
import signal
import subprocess
import sys
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path

import pytest

from agents import learners

ROOT = Path(__file__).parents[1]
#: Settings of a short training, for learners with other settings than PPO.
OTHERS = {
    "shac": {"n_envs": 8, "n_steps": 16, "critic": [8]},
    "cloning": {"n_envs": 8, "n_steps": 16, "n_updates": 2, "batch_size": 8},
}


def short_evaluations(episodes):
    """Return a fixture for a module whose trainings have few tests, and evaluations of so many episodes."""

    @pytest.fixture(autouse=True)
    def short(monkeypatch):
        for name, number in {"EPISODES": episodes, "TEST_EPISODES": 2, "TESTS": 3}.items():
            monkeypatch.setattr(learners, name, number)

    return short


def go(run, until=10**9):
    """Train until this many steps are done; return whether the run is finished."""

    def show(run):
        if until <= run.trained < run.steps:
            raise KeyboardInterrupt

    try:
        learners.train_rest(run, show=show, tested=lambda run: None)
    except KeyboardInterrupt:
        return False
    return True


def kill_and_interrupt(*arguments):
    """Kill a training script, start it again, interrupt it; return its output then."""
    path = os.pathsep.join(filter(None, [str(ROOT / "src"), os.getenv("PYTHONPATH")]))
    for number in (signal.SIGKILL, signal.SIGINT):
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": path},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        for line in process.stdout:
            if " steps, " in line and ":         0 steps" not in line:
                break
        process.send_signal(number)
        output = process.communicate(timeout=300)[0]
    assert process.returncode == 130, output
    assert "To resume:" in output
    return output


@contextmanager
def here(count, begin=None, *given):
    """Work in this process instead of others."""
    if begin:
        begin(*given)

    def submit(function, *arguments):
        future = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    yield submit
