"""The report in compact form, as this project commits it: ``python -m lag_envs.report.docs REPORT PROJECT``.

From a report's folder it writes, into a checkout, ``docs/accuracy.json`` (tables, claims, machine, versions),
the figures, ``docs/accuracy.md``, and the generated parts of README.md. The texts are made from the JSON
files alone, so a test can make them again and compare.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lag_envs import benchmark
from lag_envs.generated import replaced
from lag_envs.report import page
from lag_envs.report.content import Picture, Table
from lag_envs.report.report import FILE, content_of
from lag_envs.store import write
from lag_envs.tables import markdown_table

FIGURES = "images/accuracy"
#: Sections whose summaries README shows.
SHOWN = ("environments", "work_precision", "general", "stability")
LARGEST_SVG = 200_000  #: bytes


def main(arguments: Sequence[str] | None = None) -> int:
    """Write a report's compact form into a checkout."""
    parser = argparse.ArgumentParser(description="Write a report's compact form into a checkout.")
    parser.add_argument("report", type=Path, help="the report's folder")
    parser.add_argument("project", type=Path, nargs="?", default=Path(), help="the checkout (default: here)")
    args = parser.parse_args(arguments)
    found = json.loads((args.report / FILE).read_text(encoding="utf-8"))
    if not found["complete"]:
        print(f"{args.report} is not complete; `lag-envs report {args.report}` goes on", file=sys.stderr)
        return 2
    docs = args.project / "docs"
    figures = docs / FIGURES
    figures.mkdir(parents=True, exist_ok=True)
    for old in figures.iterdir():
        old.unlink()
    contents = content_of(found)
    files = {p.name: drawn(p, figures).name for content in contents.values() for p in content.pictures}
    write(docs / "accuracy.json", json.dumps(compact(found, files), indent=1, allow_nan=False) + "\n")
    update(args.project)
    return 0


def update(project: Path) -> None:
    """Write the texts that follow from ``docs/accuracy.json`` and ``docs/speed.json``."""
    for path, text in generated(project).items():
        write(path, text)


def generated(project: Path) -> dict[Path, str]:
    """Return the generated files, as they ought to be."""
    accuracy, speed = (
        json.loads((project / "docs" / name).read_text(encoding="utf-8"))
        for name in ("accuracy.json", "speed.json")
    )
    readme = (project / "README.md").read_text(encoding="utf-8")
    readme = replaced(readme, "accuracy", summary(accuracy))
    readme = replaced(readme, "bench", benchmark.markdown(speed))
    readme = replaced(readme, "fast", benchmark.claim(speed))
    return {project / "docs" / "accuracy.md": markdown(accuracy), project / "README.md": readme}


def drawn(picture: Picture, folder: Path) -> Path:
    """Draw a figure; one that is large as SVG becomes PNG."""
    path = page.draw(picture, folder)
    if picture.raster or path.stat().st_size <= LARGEST_SVG:
        return path
    path.unlink()
    return page.draw(replace(picture, raster=True), folder)


def compact(found: dict[str, Any], files: dict[str, str]) -> dict[str, Any]:
    """Return what the texts need of a report."""
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
    about = {key: found[key] for key in ("machine", "versions", "settings", "job_seconds")}
    about["settings"] = {key: about["settings"][key] for key in ("quick", "date")}
    return about | {"sections": sections}


# --- texts ---


def markdown(accuracy: dict[str, Any]) -> str:
    """Return docs/accuracy.md."""
    machine = accuracy["machine"]
    lines = [
        "# Error against run time, and stability",
        "",
        "Made by `lag-envs report`, which also writes an HTML page and all rows as CSV and JSON; this is its"
        " compact form.",
        f"{machine['processor']}, {machine['cores']} cores, {machine['system']}, Python {machine['python']};"
        f" {accuracy['settings']['date']}; {page.cell(accuracy['job_seconds'])} s of work.",
        "",
        ", ".join(f"{name} {number}" for name, number in accuracy["versions"].items()) + ".",
    ]
    for section in accuracy["sections"]:
        lines += ["", f"## {section['title']}"]
        for paragraph in section["text"]:
            lines += ["", paragraph]
        if section["claims"]:
            rows = [
                (claim["text"], f"**{page.VERDICTS[claim['holds']]}**", claim["evidence"])
                for claim in section["claims"]
            ]
            lines += ["", markdown_table(["claim", "verdict", "measured"], rows)]
        for table in section["tables"]:
            lines += ["", f"*{table['caption']}*", "", _table(table)]
        for picture in section["pictures"]:
            alt = picture["caption"].partition(". ")[0]
            lines += ["", f"![{alt}]({FIGURES}/{picture['file']})", "", f"*{picture['caption']}*"]
        if section["problems"]:
            lines += ["", "Did not work:", "", *(f"- {problem}" for problem in section["problems"])]
    return "\n".join(lines) + "\n"


def summary(accuracy: dict[str, Any]) -> str:
    """Return the README's part on accuracy: some summary tables, and which claims do not hold."""
    lines: list[str] = []
    for section in accuracy["sections"]:
        if section["summary"] and section["name"] in SHOWN:
            lines += [f"{section['summary']['caption']}", "", _table(section["summary"]), ""]
    claims = [claim for section in accuracy["sections"] for claim in section["claims"]]
    broken = [claim for claim in claims if claim["holds"] is False]
    lines += [
        f"{sum(claim['holds'] is True for claim in claims)} of {len(claims)} claims hold"
        + (". These do not:" if broken else ".")
    ]
    if broken:
        lines += ["", *(f"- {claim['text']} ({claim['evidence']})" for claim in broken)]
    return "\n".join(lines)


def _table(table: dict[str, Any] | Table) -> str:
    parts = vars(table) if isinstance(table, Table) else table
    return markdown_table(parts["columns"], [[page.cell(value) for value in row] for row in parts["rows"]])


if __name__ == "__main__":
    sys.exit(main())
