"""Samples of all contestants, taken in turn, round after round."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from lag_envs.errors import one_line
from lag_envs.progress import progress
from lag_envs.workers import stopping_point

#: Takes at least this many steps of every environment, and returns how many it took.
Run = Callable[[int], int]
Clock = Callable[[], float]
CLOCKS: dict[str, Clock] = {"wall": time.perf_counter, "cpu": time.process_time}


@dataclass
class Contestant:
    """One row of the table.

    ``rates`` holds the env-steps per second of each round; ``problem`` says why there are no rates, or no
    more.
    """

    library: str
    id: str
    kind: str  #: "made", "unwrapped" or "vector"
    num_envs: int
    prepare: Callable[[], Run]
    rates: list[float] = field(default_factory=list)
    problem: str | None = None


#: What replaces the library's name in rows of scenes defined by energies, of environments with other
#: keywords, of several threads, and of the core's peak.
ENERGIES, VARIED, THREADED = "lag_envs, energies", "lag_envs, varied", "lag_envs, threads"
CORE = "this core"


def measure_rates(
    rows: Sequence[Contestant], rounds: int, seconds: float, clock: Clock = time.perf_counter
) -> bool:
    """Fill in the contestants' rates; if the user interrupts, keep the rates so far and return False."""
    runs: dict[int, tuple[Run, int]] = {}
    with progress(len(rows) * (rounds + 1)) as advance:
        try:
            for i, row in enumerate(rows):
                advance(f"{row.library} {row.id} {row.kind} {row.num_envs}")
                stopping_point()
                with excused(row):
                    run = row.prepare()
                    runs[i] = run, calibrate(run, seconds, clock)
            for _ in range(rounds):
                for i, row in enumerate(rows):
                    advance("measuring")
                    stopping_point()
                    if row.problem is None:
                        with excused(row):
                            row.rates.append(rate(*runs[i], clock) * row.num_envs)
        except KeyboardInterrupt:
            return False
    return True


@contextmanager
def excused(row: Contestant) -> Iterator[None]:
    """Record a contestant's error in its row, so that the other contestants can continue."""
    try:
        yield
    except Exception as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == row.library
        row.problem = "not installed" if missing else f"failed: {one_line(error)}"


def calibrate(run: Run, seconds: float, clock: Clock) -> int:
    """Return the number of steps that take about the given time."""
    run(1)  # compiles
    steps = 1
    while True:
        start = clock()
        taken = run(steps)
        elapsed = clock() - start
        if elapsed >= 0.25 * seconds:
            return max(1, round(taken * seconds / elapsed))
        steps *= 2


def rate(run: Run, steps: int, clock: Clock) -> float:
    """Return steps per second."""
    run(1)  # refills the caches after the other contestants
    start = clock()
    taken = run(steps)
    return taken / (clock() - start)
