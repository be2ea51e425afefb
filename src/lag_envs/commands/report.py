"""``lag-envs report``."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from lag_envs.commands.base import OWN, Command, check_checkout, declare_date, needs
from lag_envs.errors import UserError, hint
from lag_envs.options import count
from lag_envs.own_files import is_file
from lag_envs.tasks import TASKS


def declare_report(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``report``."""
    parser.add_argument(
        "places", metavar="[FILE] [FOLDER]", nargs="*",
        help=f"FILE: {OWN}, to be measured; FOLDER: where to write "
        "(default: report, or report-NAME)",
    )  # fmt: skip
    parser.add_argument(
        "--quick",
        action="store_true",
        help="fewer cases and methods, the pivoted bar first; takes under a minute",
    )
    parser.add_argument(
        "--sections",
        metavar="NAME,...",
        help="only these sections: environments, work_precision, general, bound, stability, conservation, "
        "leave_out",
    )
    parser.add_argument(
        "--processes", metavar="N", type=count, default=os.cpu_count() or 1,
        help="parallel jobs (default: one per core); timings always run alone",
    )  # fmt: skip
    declare_date(parser, "on the page")
    parser.add_argument(
        "--docs", metavar="PROJECT", help="afterwards, update the accuracy pages of this checkout's docs"
    )


def run_report(args: argparse.Namespace) -> int:
    """Measure errors and write the page."""
    needs("report", "flint", "jinja2", "matplotlib", "mpmath", "scipy", "sympy")
    from lag_envs.report.report import SECTIONS, ReportSettings, make_report

    file, folder = _places(args.places)
    if file:
        from lag_envs.report import own

        for option in ("sections", "docs"):
            if getattr(args, option):
                raise UserError(
                    f"--{option} is for the report about this package: leave out --{option} or {file}"
                )
        # Errors in the file are reported before anything is measured.
        own.subjects(file, lambda text: print(text, file=sys.stderr))
        names: tuple[str, ...] = ("own",)
    else:
        names = tuple(dict.fromkeys(args.sections.split(","))) if args.sections is not None else SECTIONS
        for name in names:
            if name not in SECTIONS:
                raise UserError(f"there is no section {name!r}; {hint(name, SECTIONS)}")
    if args.docs:
        if args.quick:
            raise UserError("--docs needs a full report: leave out --quick")
        check_checkout("--docs", args.docs)
    if not make_report(ReportSettings(folder, args.quick, names, args.processes, args.date, file)):
        return 130
    if args.docs:
        from lag_envs.report import docs

        return docs.main([folder, args.docs])
    return 0


def _places(places: Sequence[str]) -> tuple[str, str]:
    """Return the user's file, empty if there is none, and the report's folder."""
    files = [place for place in places if is_file(place) and not Path(place).is_dir() and ".py" in place]
    folders = [place for place in places if place not in files]
    if ids := [place for place in folders if place in TASKS]:
        raise UserError(
            f"{ids[0]} is an id, and the report measures all environments at once; name a FILE with a scene "
            "of your own, or the FOLDER to write"
        )
    for place in folders:
        if not Path(place).is_dir() and re.search(r":|-v\d+$", place):
            raise UserError(
                f"{place} is not a FILE, and looks like an id; for scenes of your own, name their file, "
                "as in mine.py; a FOLDER of this name must exist already"
            )
    if len(files) > 1 or len(folders) > 1:
        raise UserError(f"at most one FILE and one FOLDER, got {' '.join(places)}")
    if files:
        from lag_envs.own_files import split_path

        return files[0], folders[0] if folders else f"report-{Path(split_path(files[0])[0]).stem}"
    return "", folders[0] if folders else "report"


REPORT = Command(
    "report",
    "measure errors, and write a page about them",
    """Measure the error of every environment and scene against high-precision results, and compare
it with common integrators and other libraries: work-precision diagrams, the bound, stability on
stiff and extreme cases, conservation. Writes a folder with index.html, figures, tables as CSV and
everything as JSON. Finished jobs are kept, so run it again to resume after Ctrl-C. heyoka,
diffrax, torchdiffeq, MuJoCo and Pinocchio take part if they are installed.

examples:
  lag-envs report --quick                            a first look, in under a minute
  lag-envs report                                    everything, in about half an hour on two cores
  lag-envs report --docs .                           the same, and update this checkout's docs
  lag-envs report --sections bound,stability maps    two parts, into the folder maps; with --docs, only
                                                     these parts of the docs are updated
  lag-envs report ball_on_beam.py                    scenes of your own, into report-ball_on_beam;
                                                     this runs the file""",
    declare_report,
    run_report,
)
