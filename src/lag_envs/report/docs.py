"""The report in the form that this project commits: ``python -m lag_envs.report.docs REPORT PROJECT``.

From a report's folder it writes into a checkout: ``docs/accuracy.json`` (tables, claims, machine, versions),
the figures, and the pages that depend on that file alone: ``docs/accuracy.md``, a page to read, and
``docs/accuracy-details.md`` with all texts, tables and figures. A report of some sections replaces these and
leaves the others as they are. Without a report's folder it writes the pages and the first figure again from
``docs/accuracy.json``. A test makes the texts again and compares.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from lag_envs.benchmark import gpu
from lag_envs.benchmark.docs import other_processor
from lag_envs.benchmark.docs import texts as speed_texts
from lag_envs.generated import replaced
from lag_envs.options import module_parser
from lag_envs.report import overview, page
from lag_envs.report.content import ReportFigure
from lag_envs.report.report import FILE, content_of
from lag_envs.store import write_file
from lag_envs.tables import markdown_table

FIGURES = "images/accuracy"
LARGEST_SVG = 200_000  #: bytes
#: What is said about a measurement.
ABOUT = ("machine", "versions", "settings", "job_seconds")
DETAILS = "accuracy-details.md"
OVERVIEW = ReportFigure(
    "overview",
    "Error against run time. The shortest time of one control step in which each method reaches an error, "
    "for a single state, not a batch. Rivals are in their fastest form.",
    lambda: overview.draw_overview({}),
    raster=True,
)


class PagePart(NamedTuple):
    """A section of the report as a part of docs/accuracy.md, with words that hold for any measurement."""

    section: str
    title: str
    text: str
    pictures: tuple[str, ...]  #: beginnings of their file names


PARTS = (
    PagePart(
        "work_precision",
        "One step of the package's scenes",
        "Bar, incline and shell have dedicated steps. lag_envs is measured as shipped, at rounding error. "
        "A rival gets the scene's own equation, and is in its fastest form, with the setting that just "
        "reaches an error; *carried* means that it takes cosine and sine along as unknowns, which is faster "
        "than computing them at every stage. Only lag_envs has a bound before the step. The table names the "
        "fastest rival for each error, with its time as a multiple of that of lag_envs: below 1 the rival is "
        "faster.",
        (),
    ),
    PagePart(
        "general",
        "One step of scenes defined by energies alone",
        "Here the equations are derived from the energies and stepped by the general Taylor series, which "
        "certifies each step. Environments step at the tightest tolerance, by code for any order; looser "
        "tolerances, and code for one low order, serve these comparisons only. The other methods give no "
        "bound, so only a comparison with exact solutions shows which of their settings reach an error.",
        ("general-double",),
    ),
    PagePart(
        "environments",
        "Whole episodes",
        "Episodes of random actions, compared with the exact motion under the same controls. Gymnasium's "
        "environments are measured against their own equations. No method that starts from float64 "
        "numbers can do better than about one rounding of the start, amplified by the system itself; "
        "the last column has the error as a multiple of that.",
        ("environment-errors.png",),
    ),
    PagePart(
        "stability",
        "Stiffness and extremes",
        "Each cell of a map is one control step, for increasing damping and step length. Heavy damping "
        "breaks explicit methods and degrades implicit ones. In addition to the maps there are named "
        "cases, from a bar of 1e-8 m to drives of 1e6: each step is either accurate or refused with an "
        "error.",
        ("stability-damping-pivotedbar.png", "extreme-cases-map"),
    ),
    PagePart(
        "conservation",
        "Conservation",
        "Without drag and drive, energy must not change. The table shows the largest drift of energy over "
        "a very long run.",
        ("conservation-energy",),
    ),
    PagePart(
        "bound",
        "The bound",
        "The bound on a step's truncation error is proved ([numerics](numerics.md), [engine](engine.md)). "
        "Here it is compared with the actual truncation errors: every point must lie left of the line.",
        ("bound-scatter",),
    ),
    PagePart(
        "leave_out",
        "What is left out",
        "A constant that is zero costs no operation, and the state holds only what an environment needs. "
        "The table shows the parts of each environment's step, and the figure how much time is saved by "
        "leaving something out.",
        ("leave-out",),
    ),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write a report's compact form into a checkout."""
    parser = module_parser(
        "lag_envs.report.docs",
        "Write a report's compact form into a checkout.",
        "examples:\n"
        "  python -m lag_envs.report.docs report    what `lag-envs report` left in the folder report\n"
        "  python -m lag_envs.report.docs           the pages again, from the stored numbers",
    )
    parser.add_argument(
        "report", type=Path, nargs="?", help="the report's folder; without one the pages are written again"
    )
    parser.add_argument("project", type=Path, nargs="?", default=Path(), help="the checkout (default: here)")
    args = parser.parse_args(arguments)
    if args.report is None:
        stored = args.project / "docs" / "accuracy.json"
        if not stored.is_file():
            print(f"{stored} is not there; name a report's folder", file=sys.stderr)
            return 2
        update(args.project)
        return 0
    if not (args.report / FILE).is_file():
        print(f"{args.report} holds no {FILE}; name a folder that `lag-envs report` wrote", file=sys.stderr)
        return 2
    found = json.loads((args.report / FILE).read_text(encoding="utf-8"))
    if not found["complete"]:
        print(f"{args.report} is not complete; `lag-envs report {args.report}` resumes it", file=sys.stderr)
        return 2
    docs = args.project / "docs"
    stored, figures = docs / "accuracy.json", docs / FIGURES
    old = json.loads(stored.read_text(encoding="utf-8")) if stored.is_file() else {"sections": []}
    kept = [section for section in old["sections"] if section["name"] not in found["sections"]]
    figures.mkdir(parents=True, exist_ok=True)
    shown = {picture["file"] for section in kept for picture in section["pictures"]}
    for path in figures.iterdir():
        if path.name not in shown:
            path.unlink()
    contents = content_of(found)
    files = {p.name: drawn_figure(p, figures).name for content in contents.values() for p in content.pictures}
    new = compact(found, files)
    if kept:
        new = combined(old, new)
    write_file(stored, json.dumps(new, indent=1, allow_nan=False) + "\n")
    update(args.project)
    return 0


def combined(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return the old report with the new one's sections, each with what is said about its measurement."""
    about = {key: new[key] for key in ABOUT}
    found = {section["name"]: section | {"about": about} for section in new["sections"]}
    sections = [found.pop(section["name"], section) for section in old["sections"]]
    return old | {"sections": [*sections, *found.values()]}


def update(project: Path) -> None:
    """Write the files that depend on the JSON files in docs: pages, first figure."""
    for path, text in generated(project).items():
        write_file(path, text)
    accuracy = json.loads((project / "docs" / "accuracy.json").read_text(encoding="utf-8"))
    page.write_figure(
        replace(OVERVIEW, draw=lambda: overview.draw_overview(accuracy)), project / "docs" / FIGURES
    )


def generated(project: Path) -> dict[Path, str]:
    """Return what the generated files should contain."""
    docs = project / "docs"
    accuracy, speed, other, on_gpu = (
        json.loads((docs / name).read_text(encoding="utf-8"))
        for name in ("accuracy.json", "speed.json", "speed-other.json", "gpu.json")
    )
    found = {docs / "accuracy.md": accuracy_markdown(accuracy), docs / DETAILS: details(accuracy)}
    found |= speed_texts(speed, project)
    page = replaced(found[docs / "speed.md"], "other", other_processor(other))
    found[docs / "speed.md"] = gpu.with_table(page, on_gpu)
    return found


def drawn_figure(picture: ReportFigure, folder: Path) -> Path:
    """Draw a figure; one that is too large as SVG becomes PNG."""
    path = page.write_figure(picture, folder)
    if picture.raster or path.stat().st_size <= LARGEST_SVG:
        return path
    path.unlink()
    return page.write_figure(replace(picture, raster=True), folder)


def compact(found: dict[str, Any], files: dict[str, str]) -> dict[str, Any]:
    """Return the parts of a report that the pages need."""
    sections = []
    for name, content in content_of(found).items():
        sections.append(
            {
                "name": name,
                "title": content.title,
                "text": list(content.text),
                "claims": [vars(claim) for claim in content.claims],
                "summary": vars(content.summary) if content.summary else None,
                "tables": [vars(table) for table in page.tables(content)],
                "pictures": [
                    {"file": files[picture.name], "caption": picture.caption} for picture in content.pictures
                ],
                "problems": [f"{p['name']}: {p['problem']}" for p in found["sections"][name]["problems"]],
            }
        )
    about = {key: found[key] for key in ABOUT}
    about["settings"] = {key: about["settings"][key] for key in ("quick", "date")}
    return about | {"sections": sections}


# --- texts ---


def accuracy_markdown(accuracy: dict[str, Any]) -> str:
    """Return docs/accuracy.md, the page to read first."""
    sections = {section["name"]: section for section in accuracy["sections"]}
    claims = [claim for section in accuracy["sections"] for claim in section["claims"]]
    broken = [claim for claim in claims if claim["holds"] is False]
    parts = [
        "# Accuracy",
        "This page shows what was measured, how other methods compare, and where they are better. It is "
        "generated from the measurements of `lag-envs report`.",
        "## Error against run time",
        *_picture({"file": f"{OVERVIEW.name}.png", "caption": OVERVIEW.caption}),
        "The main results:",
        _bullets([*FIRST, *overview.overview_sentences(accuracy)]),
        "How often a rival is faster, in comparisons of single states and of batches:",
        markdown_table(
            ["error", "on the package's scenes", "on scenes defined by energies alone"],
            overview.faster_rivals(accuracy),
        ),
        _command("work_precision,general"),
        "## What is promised",
        INTRODUCTION,
    ]
    for part in PARTS:
        if part.section not in sections:
            continue
        section = sections[part.section]
        parts += [f"## {part.title}", part.text]
        for picture in section["pictures"]:
            if picture["file"].startswith(part.pictures or ("-",)):
                parts += _picture(picture)
        if section["summary"]:
            parts.append(_table(section["summary"]))
        parts += _own_machine(section)
        parts += [f"{_holding(section['claims'])}.", _command(part.section)]
        parts.append(f"[Method, all tables and figures]({DETAILS}#{_anchor(section['title'])})")
    parts += ["## What does not hold", _holding(claims) + (". These do not:" if broken else ".")]
    if broken:
        parts.append(_bullets(f"{claim['text']} ({claim['evidence']})" for claim in broken))
    parts += ["## Machine and versions", *_about(accuracy)]
    return _page(parts)


INTRODUCTION = """\
One control step, with its control held, is accurate to 1e-12: |error of θ| ≤ 1e-12 max(1, |θ|, |θ̇| dt) and
|error of θ̇| ≤ 1e-12 max(1, |θ̇|, (α² + β²)^¼), where θ̈ = -α sinθ - β cosθ - γθ̇ + …. The same holds for lengths
([numerics](numerics.md)). This covers all environments that have a specialised integrator (driven pendulums
and slopes), over the ordinary ranges of their parameters, with damping γ dt up to 1e6. In extreme cases, the
system itself amplifies a rounding of its state or parameters; the error then stays within ten times that
amplification. A step that would need more than a million substeps, or has no finite result, raises
`StepRefused` and leaves the state as it was.

Over many steps, errors grow as the system amplifies them. The default bar, upright and without control,
doubles an error every 0.14 s, whatever the method.

`lag-envs report` measures all results below (extras `report`, `peers`, `pinocchio`; `--quick` for a first
look). It also writes a page with all rows as CSV and JSON."""

FIRST = (
    "Only lag_envs proves a bound on its truncation error, before the step or along with it. The errors of "
    "the other methods were found afterwards, by comparison with exact solutions.",
    "In the left panel lag_envs is a single point, at rounding error: a coarser setting would not be faster.",
)


def details(accuracy: dict[str, Any]) -> str:
    """Return docs/accuracy-details.md: every section with its texts, claims, tables and figures."""
    parts = ["# Accuracy: details", "This is the full report; read [Accuracy](accuracy.md) first."]
    parts += _about(accuracy)
    for section in accuracy["sections"]:
        parts += [f"## {section['title']}", *_own_machine(section), *section["text"]]
        if section["claims"]:
            rows = [
                (claim["text"], f"**{page.VERDICTS[claim['holds']]}**", claim["evidence"])
                for claim in section["claims"]
            ]
            parts.append(markdown_table(["claim", "verdict", "measured"], rows))
        for table in section["tables"]:
            parts += [f"*{table['caption']}*", _table(table)]
        for picture in section["pictures"]:
            parts += _picture(picture)
        if section["problems"]:
            parts += ["Did not work:", _bullets(section["problems"])]
    return _page(parts)


def _page(parts: Iterable[str]) -> str:
    """Return a page of paragraphs, with exponents as people write them: 1e-6 for 1e-06, 4e13 for 4e+13."""
    return re.sub(r"(?<=\de)(-?)\+?0?(?=[1-9])", r"\1", "\n\n".join(parts)) + "\n"


def _bullets(texts: Iterable[str]) -> str:
    return "\n".join(f"- {text}" for text in texts)


def _holding(claims: Sequence[dict[str, Any]]) -> str:
    return f"{sum(claim['holds'] is True for claim in claims)} of {len(claims)} claims hold"


def _picture(picture: dict[str, str]) -> list[str]:
    alt = picture["caption"].partition(". ")[0]
    return [f"![{alt}]({FIGURES}/{picture['file']})", f"*{picture['caption']}*"]


def _command(sections: str) -> str:
    return f"Measure it: `lag-envs report --sections {sections}`."


def _about(accuracy: dict[str, Any]) -> list[str]:
    versions = ", ".join(f"{name} {number}" for name, number in accuracy["versions"].items())
    return [_machine(accuracy), f"{versions}."]


def _own_machine(section: dict[str, Any]) -> list[str]:
    """Return where and when a section was measured, if apart from the others."""
    if "about" not in section:
        return []
    return [f"*Measured apart from the other sections: {_machine(section['about'])}*"]


def _machine(about: dict[str, Any]) -> str:
    machine = about["machine"]
    vectors = f", vectors of {machine['vector']} doubles" if "vector" in machine else ""
    return (
        f"{machine['processor']}{vectors}, {machine['cores']} cores, {machine['system']}, Python "
        f"{machine['python']}; {about['settings']['date']}; {page.cell_text(about['job_seconds'])} s of work."
    )


def _anchor(title: str) -> str:
    """Return the anchor that Markdown gives a heading."""
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def _table(table: dict[str, Any]) -> str:
    return markdown_table(table["columns"], [list(map(page.cell_text, row)) for row in table["rows"]])


if __name__ == "__main__":
    sys.exit(main())
