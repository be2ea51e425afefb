"""Jobs in separate processes, so that a job that hangs or crashes loses only its own rows.

Every finished job is written at once, so that an interrupted report resumes where it was.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lag_envs
from lag_envs import store
from lag_envs.errors import one_line
from lag_envs.host import installed_versions, machine
from lag_envs.progress import progress
from lag_envs.workers import as_they_finish, died, processes

Row = dict[str, Any]
#: Packages whose versions are recorded.
LIBRARIES = (
    "gymnasium", "numpy", "numba", "llvmlite", "scipy", "mpmath", "sympy", "matplotlib",
    "python-flint", "heyoka", "diffrax", "jax", "torchdiffeq", "torch", "mujoco", "pin",
)  # fmt: skip


@dataclass(frozen=True)
class ReportJob:
    """A piece of work that takes seconds.

    Its function, at the top of its section's module, is called with the arguments and yields rows of JSON
    types. If it raises an error, earlier rows are kept and the error is noted.
    """

    function: Callable[..., Iterator[Row]]
    name: str  #: describes the work; unique within the section
    arguments: dict[str, Any] = field(default_factory=dict)
    timeout: float = 120.0  #: seconds until the job counts as hanging
    alone: bool = False  #: whether it measures time, so that nothing else may run at the same time

    @property
    def section(self) -> str:
        """The name of the section, as `module` takes it."""
        return self.function.__module__.removeprefix(f"{__package__}.")

    @property
    def key(self) -> str:
        """The key under which rows are stored; it depends on arguments, code and machine."""
        parts = [self.section, self.name, self.function.__name__, self.arguments, fingerprint()]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


@dataclass
class JobResult:
    """A job's outcome."""

    section: str
    name: str
    key: str
    rows: list[Row] = field(default_factory=list)
    problem: str | None = None
    seconds: float = 0.0


@cache
def fingerprint() -> str:
    """Return a digest of code, libraries and machine; rows with another digest are not reused."""
    digest = hashlib.sha256(json.dumps([machine(), versions()], sort_keys=True).encode())
    for path in sorted(Path(lag_envs.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Return the versions of Python and packages."""
    absent = dict.fromkeys(LIBRARIES, "not installed")
    return {"lag_envs": lag_envs.__version__} | absent | installed_versions(LIBRARIES)


def run_jobs(
    jobs: Sequence[ReportJob], folder: Path, processes: int, tell: Callable[[str], None] = lambda text: None
) -> tuple[list[JobResult], bool]:
    """Run the jobs that have no result in the folder yet.

    Parameters
    ----------
    jobs : sequence of ReportJob
        The jobs; those that measure time run after the others, one by one.
    folder : Path
        Results are appended to ``results.jsonl`` in it; references are kept there too.
    processes : int
        Number of jobs that may run in parallel.
    tell : callable, optional
        Called with a line about each job that failed.

    Returns
    -------
    results : list of JobResult
        Of all finished jobs, in the order of the jobs.
    complete : bool
        False if the user interrupted it.
    """
    file = folder / "results.jsonl"
    known = {result.key: result for result in load_results(file) if result.problem is None}
    todo = [job for job in jobs if job.key not in known]
    if len(todo) < len(jobs):
        tell(f"{len(jobs) - len(todo)} of {len(jobs)} jobs are reused from before")
    complete = True
    with progress(len(todo)) as advance:
        try:
            for alone in (False, True):
                part = [job for job in todo if job.alone is alone]
                for result in _in_processes(part, folder, 1 if alone else processes):
                    known[result.key] = result
                    store.append(file, vars(result))
                    advance(f"{result.section}: {result.name}")
                    if result.problem:
                        tell(f"{result.section}: {result.name}: {result.problem}")
        except KeyboardInterrupt:
            complete = False
    return [known[job.key] for job in jobs if job.key in known], complete


def load_results(file: Path) -> list[JobResult]:
    """Return the results in a file; a line that was cut off by a kill is skipped."""
    results = []
    for row in store.rows(file):
        with suppress(TypeError):
            results.append(JobResult(**row))
    return results


def _in_processes(jobs: Sequence[ReportJob], folder: Path, count: int) -> Iterator[JobResult]:
    with (
        TemporaryDirectory() as rows,
        processes(count, _begin, str(folder)) as submit,
    ):
        futures = {}
        for job in jobs:
            arguments = (job.function, job.arguments, Path(rows) / job.key)
            futures[submit(_work, *arguments, timeout=job.timeout)] = job
        for job, outcome in as_they_finish(futures):
            if isinstance(outcome, TimeoutError):
                outcome = f"stopped after {job.timeout:.0f} s", job.timeout
            elif isinstance(outcome, BaseException):
                outcome = died(outcome), 0.0
            # The rows from before the process died are included.
            yield JobResult(job.section, job.name, job.key, list(store.rows(Path(rows) / job.key)), *outcome)


def _begin(folder: str) -> None:
    """Prepare a process."""
    warnings.simplefilter("ignore")
    sys.stdout = sys.stderr = open(os.devnull, "w", encoding="utf-8")
    from lag_envs.report import reference

    reference.store = Path(folder) / "references"
    reference.store.mkdir(exist_ok=True)


def _work(
    function: Callable[..., Iterator[Row]], arguments: dict[str, Any], rows: Path
) -> tuple[str | None, float]:
    """Do a job, write its rows, and return its problem, if any, and its time in seconds."""
    start, problem = time.monotonic(), None
    try:
        for row in function(**arguments):
            store.append(rows, row)
    except Exception as error:
        problem = error_line(error)
    return problem, round(time.monotonic() - start, 3)


def module(name: str) -> Any:
    """Return a module of this package or, if the name has a dot, of another package."""
    return import_module(name if "." in name else f"{__package__}.{name}")


def error_line(error: BaseException) -> str:
    """Return an error as one line; for a missing package, the line says that it is not installed.

    Examples
    --------
    >>> error_line(ModuleNotFoundError("No module named 'heyoka'", name="heyoka"))
    'heyoka is not installed'
    """
    if isinstance(error, ModuleNotFoundError) and error.name:
        return f"{error.name.partition('.')[0]} is not installed"
    return one_line(error, 300)
