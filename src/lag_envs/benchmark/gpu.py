"""A GPU's measurement as text: for the terminal, and in this project's documentation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lag_envs.generated import replaced
from lag_envs.store import readable_json, write_file
from lag_envs.tables import aligned, markdown_table, rate_text


def console_lines(report: dict[str, Any]) -> list[str]:
    """Return the report as lines of text."""
    head = (
        "environment",
        "precision",
        "environments",
        "steps/s",
        "in a CUDA graph",
        "share of the memory's rate",
    )
    rows = [
        (
            row["id"],
            row["precision"],
            f"{row['num_envs']:,}",
            rate_text(row["steps"]),
            rate_text(row["replayed"]),
            share(row),
        )
        for row in report["rows"]
    ]
    return [_about(report), "", *aligned([head, *rows])]


def gpu_markdown(report: dict[str, Any]) -> str:
    """Return the table of docs/speed.md: the smallest and the largest number of environments."""
    rows = {(row["id"], row["precision"], row["num_envs"]): row for row in report["rows"]}
    few, many = (f(row["num_envs"] for row in report["rows"]) for f in (min, max))
    ids = dict.fromkeys(row["id"] for row in report["rows"])

    def cells(id: str) -> list[str]:
        alone, *both = (rows[id, p, n] for p, n in (("float32", few), ("float32", many), ("float64", many)))
        large = [cell for row in both for cell in (rate_text(row["steps"]), share(row))]
        return [id, rate_text(alone["steps"]), rate_text(alone["replayed"]), *large]

    head = (
        "id",
        f"float32, {few:,} at once",
        "replayed",
        f"float32, {many:,} at once",
        "of the memory's rate",
        f"float64, {many:,} at once",
        "of the memory's rate",
    )
    return f"Steps per second. {_about(report)}.\n\n{markdown_table(head, map(cells, ids))}"


def take_over(report: dict[str, Any], checkout: Path) -> None:
    """Write a report into a checkout: ``docs/gpu.json``, and the table of docs/speed.md."""
    page = checkout / "docs" / "speed.md"
    write_file(checkout / "docs" / "gpu.json", readable_json(report))
    write_file(page, with_table(page.read_text(encoding="utf-8"), report))


def with_table(page: str, report: dict[str, Any]) -> str:
    """Return the text of docs/speed.md with a report's table."""
    return replaced(page, "gpu", gpu_markdown(report))


def share(row: dict[str, Any]) -> str:
    """Return a share of the memory's rate as text."""
    return f"{100 * row['share']:.0f} %"


def _about(report: dict[str, Any]) -> str:
    """Return one line on the machine and the measurement."""
    settings = report["settings"]
    return (
        f"{report['gpu']}, whose memory copies {report['bandwidth'] / 1e12:.2f} TB/s (read and written); "
        f"PyTorch {report['versions']['torch']}; medians of {settings['rounds']} samples of "
        f"{settings['seconds']:g} s (`lag-envs bench --device cuda`, {report['date']})"
    )
