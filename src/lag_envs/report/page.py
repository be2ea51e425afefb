"""The report as a folder that a browser opens: HTML, figures, and a CSV file per table."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined

from lag_envs import store
from lag_envs.report.content import Content, ReportFigure, Table

VERDICTS = {True: "holds", False: "does not hold", None: "not measured"}


def write_report(found: dict[str, Any], contents: dict[str, Content], folder: Path) -> None:
    """Write ``index.html``, ``figures/`` and ``tables/``.

    Parameters
    ----------
    found : dict
        The result of `report.collect_rows`: machine, versions, settings, seconds.
    contents : dict
        Each section's content, by name.
    folder : Path
        The report's folder.
    """
    for name in ("figures", "tables"):
        (folder / name).mkdir(exist_ok=True)
    for content in contents.values():
        for table in tables(content, details=True):
            write_csv(table, folder / "tables" / f"{table.name}.csv")
        for picture in content.pictures:
            write_figure(picture, folder / "figures")
    environment = Environment(
        loader=PackageLoader("lag_envs.report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"cell": cell_text, "is_number": lambda x: isinstance(x, int | float)}
    text = environment.get_template("page.html").render(
        found=found, contents=contents, verdicts=VERDICTS, tables=tables, file_of=figure_file,
        problems=[p for part in found["sections"].values() for p in part["problems"]],
    )  # fmt: skip
    store.write_file(folder / "index.html", text)


def tables(content: Content, details: bool = False) -> list[Table]:
    """Return a section's tables, the summary first."""
    found = [*([content.summary] if content.summary else []), *content.tables]
    unique = {table.name: table for table in ([*found, *content.details] if details else found)}
    return list(unique.values())


def figure_file(picture: ReportFigure) -> str:
    """Return the name of a figure's file."""
    return f"{picture.name}.{'png' if picture.raster else 'svg'}"


def write_figure(picture: ReportFigure, folder: Path) -> Path:
    """Write a figure; the file depends only on the drawing."""
    path = folder / figure_file(picture)
    with matplotlib.rc_context({"svg.hashsalt": "lag_envs", "svg.fonttype": "none", "font.size": 9}):
        picture.draw().savefig(
            path, dpi=120, bbox_inches="tight", facecolor="white",
            metadata={} if picture.raster else {"Date": None, "Creator": None},
        )  # fmt: skip
    return path


def write_csv(table: Table, path: Path) -> None:
    """Write a table with all digits of its numbers."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table.columns)
        writer.writerows(table.rows)


def cell_text(value: Any) -> str:
    """Return a table's entry as text.

    Examples
    --------
    >>> [cell_text(x) for x in (None, True, 12345, 0.125, 1234.5, 1.5e-13, 0.0, "a")]
    ['', 'yes', '12,345', '0.125', '1,234', '1.5e-13', '0', 'a']
    """
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if not isinstance(value, float):
        return str(value)
    size = abs(value)
    if size and (size < 1e-3 or size >= 1e6):
        return f"{value:.1e}"
    return f"{value:,.0f}" if size >= 1000 else f"{value:.3g}"
