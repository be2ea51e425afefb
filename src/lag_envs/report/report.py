"""The whole report: settings, jobs of all sections, and the files; for the command ``lag-envs report``."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lag_envs import store
from lag_envs.errors import UserError
from lag_envs.host import machine
from lag_envs.report.content import Content
from lag_envs.report.runner import JobResult, module, run_jobs, versions
from lag_envs.stepping.machine import registers
from lag_envs.tables import aligned

#: Modules of this package, in the order of the page.
SECTIONS = ("environments", "work_precision", "general", "bound", "stability", "conservation", "leave_out")
FILE = "report.json"


@dataclass
class ReportSettings:
    """Extent and destination of a report."""

    folder: str = "report"
    quick: bool = False
    sections: tuple[str, ...] = SECTIONS
    processes: int = 2
    date: str = ""
    file: str = ""  #: a user's own file, measured in place of the package


class NotAReport(UserError):
    """Raised if the folder holds something else."""


def make_report(settings: ReportSettings) -> bool:
    """Measure everything that the folder lacks and write all results; return False if interrupted.

    Raises
    ------
    NotAReport
        If the folder holds other things, which stay untouched.
    OSError
        If the folder cannot be written to.
    """
    folder = prepare(Path(settings.folder))
    given = (settings.quick, settings.file) if settings.file else (settings.quick,)
    jobs = [job for name in settings.sections for job in module(name).jobs(*given)]
    begin = time.monotonic()
    results, complete = run_jobs(jobs, folder, settings.processes, lambda text: print(text, file=sys.stderr))
    found = collect_rows(settings, results, complete, time.monotonic() - begin)
    store.write_file(folder / FILE, json.dumps(found, indent=1, allow_nan=False) + "\n")
    from lag_envs.report import page

    contents = content_of(found)
    page.write_report(found, contents, folder)
    print("\n".join(claim_lines(contents)))
    missing = len(jobs) - len(results)
    if missing:
        print(f"\ninterrupted: {missing} of {len(jobs)} jobs are missing; re-run the command to resume")
    print(f"\nwritten to {folder / 'index.html'}")
    return complete


def prepare(folder: Path) -> Path:
    """Return the folder, which must be new, empty or already a report's."""
    if folder.exists() and not folder.is_dir():
        raise NotAReport(f"{folder} is not a folder; name a new or an empty one")
    folder.mkdir(parents=True, exist_ok=True)
    names = {path.name for path in folder.iterdir()}
    if names and "results.jsonl" not in names:
        raise NotAReport(f"{folder} holds other things, such as {min(names)}; name a new or an empty folder")
    (folder / "results.jsonl").touch()
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written to")
    return folder


def collect_rows(
    settings: ReportSettings, results: Sequence[JobResult], complete: bool, seconds: float
) -> dict[str, Any]:
    """Return all measurements, by section."""
    return {
        "complete": complete,
        "machine": machine() | {"vector": registers().doubles},
        "versions": versions(),
        "settings": asdict(settings) | {"sections": list(settings.sections)},
        "seconds": round(seconds, 1),
        "job_seconds": round(sum(result.seconds for result in results), 1),
        "sections": {
            name: {
                "rows": [row for r in results if r.section == name for row in r.rows],
                "problems": [vars(r) | {"rows": []} for r in results if r.section == name and r.problem],
            }
            for name in settings.sections
        },
    }


def content_of(found: dict[str, Any]) -> dict[str, Content]:
    """Return each section's content."""
    return {
        name: module(name).content(part["rows"], [JobResult(**problem) for problem in part["problems"]])
        for name, part in found["sections"].items()
    }


def claim_lines(contents: dict[str, Content]) -> list[str]:
    """Return a line per claim."""
    words = {True: "holds", False: "DOES NOT HOLD", None: "not measured"}
    rows = [
        (words[claim.holds], f"{claim.text} ({claim.evidence})")
        for content in contents.values()
        for claim in content.claims
    ]
    return aligned(rows) if rows else ["nothing was measured"]
