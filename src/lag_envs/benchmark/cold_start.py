"""Time from the start of a process to its first step, with and without compiled code in the cache."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

from lag_envs.benchmark.results import quartiles
from lag_envs.progress import progress
from lag_envs.workers import stopping_point

#: The stages of a cold start after the start of the process; prints the seconds of each.
COLD_START = """
from time import perf_counter
times = [perf_counter()]
import numpy
times.append(perf_counter())
import gymnasium
times.append(perf_counter())
import numba
times.append(perf_counter())
import lag_envs
{load}env = gymnasium.make({id!r})
times.append(perf_counter())
env.reset(seed=1)
times.append(perf_counter())
env.step(env.action_space.sample())
times.append(perf_counter())
gymnasium.make({id!r})
times.append(perf_counter())
print(*(b - a for a, b in zip(times, times[1:])))
"""
STAGES = (
    "Python's own start and end", "import numpy", "import gymnasium", "import numba",
    "import lag_envs, gym.make", "reset", "step", "gym.make again",
)  # fmt: skip


def cold_starts(id: str, count: int, times: dict[str, list[list[float]]], files: Sequence[str] = ()) -> bool:
    """Time the stages of whole processes into `times`; return False if the user interrupted it."""
    with tempfile.TemporaryDirectory() as folder:
        caches = [("empty", f"{folder}/{i}") for i in range((count + 1) // 2)]
        caches += [("filled", f"{folder}/0")] * count
        with progress(len(caches)) as advance:
            try:
                for state, cache in caches:
                    advance(f"cold start, cache {state}")
                    stopping_point()
                    stages = cold_start(id, cache, files)
                    times.setdefault(state, []).append(stages)
            except KeyboardInterrupt:
                return False
    return True


def cold_start(id: str, cache: str, files: Sequence[str] = ()) -> list[float]:
    """Return the seconds of each of `STAGES` in a process that takes one step."""
    load = "".join(f"from lag_envs.own_files import registered; registered({name!r})\n" for name in files)
    command = [sys.executable, "-P", "-c", COLD_START.format(id=id, load=load)]
    # As in installed packages, imported modules have their bytecode; missing bytecode is written first.
    given = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    given["NUMBA_CACHE_DIR"] = cache
    start = time.perf_counter()
    done = subprocess.run(command, env=given, check=True, capture_output=True, text=True)
    total = time.perf_counter() - start
    stages = list(map(float, done.stdout.split()))
    return [total - sum(stages), *stages]


def start_summary(times: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Return the seconds of each process, their median, and the median of each of `STAGES`."""
    seconds = [sum(stages) for stages in times]
    parts = zip(STAGES, zip(*times, strict=True), strict=True)
    return {
        "seconds": seconds,
        "median": quartiles(seconds)[1],
        "stages": {stage: quartiles(part)[1] for stage, part in parts},
    }
