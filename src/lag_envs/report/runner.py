"""Jobs in processes of their own: one that hangs or crashes costs its own rows only.

Every finished job is written at once, so that a report that was broken off goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import lag_envs
from lag_envs.benchmark import ONE_THREAD, machine, progress

Row = dict[str, Any]
#: Whose versions matter.
LIBRARIES = (
    "gymnasium", "numpy", "numba", "llvmlite", "scipy", "mpmath", "sympy", "matplotlib",
    "python-flint", "heyoka", "diffrax", "jax", "torchdiffeq", "torch", "mujoco", "pin",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """A piece of work, of some seconds.

    ``function``, as "module:name" within this package or "package.module:name", is called with the arguments
    and yields rows that JSON can hold. It may raise: the rows before that are kept and the problem is noted.
    """

    section: str
    name: str  #: tells what is done; unique within the section
    function: str
    arguments: dict[str, Any] = field(default_factory=dict)
    timeout: float = 120.0  #: seconds until it counts as hanging
    alone: bool = False  #: measures time, so nothing else may run beside it

    @property
    def key(self) -> str:
        """What the rows are found by again; other arguments, code or another machine make another key."""
        parts = [self.section, self.name, self.function, self.arguments, fingerprint()]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


@dataclass
class Result:
    """What came of a job."""

    section: str
    name: str
    key: str
    rows: list[Row] = field(default_factory=list)
    problem: str | None = None
    seconds: float = 0.0


@cache
def fingerprint() -> str:
    """Return a digest of code, libraries and machine: rows of others are not taken over."""
    digest = hashlib.sha256(json.dumps([machine(), versions()], sort_keys=True).encode())
    for path in sorted(Path(lag_envs.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Return the versions of what took part."""
    found = {"lag_envs": lag_envs.__version__}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def run_jobs(
    jobs: Sequence[Job], folder: Path, processes: int, tell: Callable[[str], None] = lambda text: None
) -> tuple[list[Result], bool]:
    """Run the jobs that the folder has no result of yet.

    Parameters
    ----------
    jobs : sequence of Job
        Those that measure time run after the others, one by one.
    folder : Path
        Results are appended to ``results.jsonl`` in it; references are kept there too.
    processes : int
        How many may run side by side.
    tell : callable, optional
        Called with a line about each job that failed.

    Returns
    -------
    results : list of Result
        Of all jobs that are finished, in the order of the jobs.
    complete : bool
        False where the user broke it off.
    """
    file = folder / "results.jsonl"
    known = {result.key: result for result in load(file) if result.problem is None}
    todo = [job for job in jobs if job.key not in known]
    if len(todo) < len(jobs):
        tell(f"{len(jobs) - len(todo)} of {len(jobs)} jobs are taken over from before")
    complete = True
    with progress(len(todo)) as advance, file.open("a", encoding="utf-8") as out:
        if out.tell() and not file.read_bytes().endswith(b"\n"):
            out.write("\n")  # what a kill has cut off

        def keep(result: Result) -> None:
            known[result.key] = result
            out.write(json.dumps(vars(result), allow_nan=False) + "\n")
            out.flush()
            advance(f"{result.section}: {result.name}")
            if result.problem:
                tell(f"{result.section}: {result.name}: {result.problem}")

        pools = [([job for job in todo if not job.alone], processes), ([job for job in todo if job.alone], 1)]
        try:
            for part, count in pools:
                for result in _in_processes(part, folder, count):
                    keep(result)
        except KeyboardInterrupt:
            complete = False
    return [known[job.key] for job in jobs if job.key in known], complete


def load(file: Path) -> list[Result]:
    """Return the results in a file; lines that a kill has cut off are passed over."""
    results = []
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else []:
        try:
            results.append(Result(**json.loads(line)))
        except (ValueError, TypeError):
            continue
    return results


class _Worker:
    """A process that takes one job at a time."""

    def __init__(self, folder: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=_work, args=(other, str(folder)), daemon=True)
        self.process.start()
        other.close()
        self.result: Result | None = None
        self.start = self.deadline = 0.0

    def give(self, job: Job) -> None:
        self.result = Result(job.section, job.name, job.key)
        self.start = time.monotonic()
        self.deadline = self.start + job.timeout
        try:
            self.connection.send((job.function, job.arguments))
        except OSError:  # it has died; `take` finds out how
            pass

    def take(self) -> bool:
        """Take what the process has sent; return whether the job is finished."""
        assert self.result is not None
        try:
            kind, value = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            return self.end(f"the process died, exit status {self.process.exitcode}")
        if kind == "row":
            self.result.rows.append(value)
            return False
        return self.end(value)

    def end(self, problem: str | None) -> bool:
        assert self.result is not None
        self.result.problem = problem
        self.result.seconds = round(time.monotonic() - self.start, 3)
        return True

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()


def _in_processes(jobs: Sequence[Job], folder: Path, count: int) -> Iterable[Result]:
    waiting = list(reversed(jobs))
    idle: list[_Worker] = []
    busy: list[_Worker] = []
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # a process inherits it
    try:
        while waiting or busy:
            while waiting and len(busy) < count:
                worker = idle.pop() if idle else _Worker(folder)
                worker.give(waiting.pop())
                busy.append(worker)
            soonest = min(worker.deadline for worker in busy)
            ready = wait([w.connection for w in busy], timeout=max(0.0, min(1.0, soonest - time.monotonic())))
            for worker in list(busy):
                late = time.monotonic() > worker.deadline
                if worker.connection in ready:
                    finished = worker.take()
                elif late:
                    finished = worker.end(f"stopped after {worker.deadline - worker.start:.0f} s")
                else:
                    continue
                if finished:
                    assert worker.result is not None
                    busy.remove(worker)
                    if late or not worker.process.is_alive():
                        worker.stop()
                    else:
                        idle.append(worker)
                    yield worker.result
    finally:
        for worker in idle + busy:
            worker.stop()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _work(connection: Connection, folder: str) -> None:
    """Do jobs until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that hands out the jobs
    warnings.simplefilter("ignore")
    sys.stdout = sys.stderr = open(os.devnull, "w", encoding="utf-8")
    from lag_envs.report import reference

    reference.store = Path(folder) / "references"
    reference.store.mkdir(exist_ok=True)
    while True:
        try:
            function, arguments = connection.recv()
        except EOFError:
            return
        problem = None
        try:
            place, _, name = function.partition(":")
            for row in getattr(module(place), name)(**arguments):
                json.dumps(row, allow_nan=False)  # what could not be written costs this job only
                connection.send(("row", row))
        except Exception as error:
            problem = describe(error)
        connection.send(("end", problem))


def module(name: str) -> Any:
    """Return a module of this package, or, where the name has a dot, another one."""
    return import_module(name if "." in name else f"lag_envs.report.{name}")


def describe(error: BaseException) -> str:
    """Return an error in one line; a missing package is said to be one.

    Examples
    --------
    >>> describe(ModuleNotFoundError("No module named 'heyoka'", name="heyoka"))
    'heyoka is not installed'
    """
    if isinstance(error, ModuleNotFoundError) and error.name:
        return f"{error.name.partition('.')[0]} is not installed"
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
