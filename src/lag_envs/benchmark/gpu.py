"""A GPU's measurement as text: for the terminal, and in this project's documentation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lag_envs.generated import replaced
from lag_envs.store import readable_json, write_file
from lag_envs.tables import aligned, markdown_table, rate_text

GYMNAX = "https://github.com/RobertTLange/gymnax"
#: The head of the table that compares with gymnax.
PEER = ("id", "at once", "in a CUDA graph", "gymnax", "ratio")


def console_lines(report: dict[str, Any]) -> list[str]:
    """Return the report as lines of text."""
    head = (
        "environment",
        "precision",
        "environments",
        "steps/s",
        "of bandwidth",
        "in a CUDA graph",
        "of bandwidth",
    )
    rows = [(row["id"], row["precision"], f"{row['num_envs']:,}", *_cells(row)) for row in report["rows"]]
    lines = [_about(report), "", *aligned([head, *rows])]
    if compared := _compared(report):
        lines += ["", *aligned([PEER, *compared])]
    return lines if report["complete"] else [*lines, "", "interrupted: these are the results so far"]


def gpu_markdown(report: dict[str, Any]) -> str:
    """Return the table of docs/speed.md: the smallest and the largest number of environments."""
    rows = {(row["id"], row["precision"], row["num_envs"]): row for row in report["rows"]}
    few, many = (f(report["settings"]["sizes"]) for f in (min, max))

    def cells(id: str) -> list[str]:
        cases = ("float32", few), ("float32", many), ("float64", many)
        small, single, double = (_cells(rows[id, *case]) for case in cases)
        return [id, *small[::2], *single[2:], *double[2:]]

    head = (
        "id",
        f"float32, {few:,} at once, called",
        "in a CUDA graph",
        f"float32, {many:,} at once, in a CUDA graph",
        "of bandwidth",
        f"float64, {many:,} at once, in a CUDA graph",
        "of bandwidth",
    )
    ids = dict.fromkeys(row["id"] for row in report["rows"])
    text = f"Steps per second. {_about(report)}.\n\n{markdown_table(head, map(cells, ids))}"
    if compared := _compared(report):
        gymnax, jax = (report["versions"][name] for name in ("gymnax", "jax"))
        text += (
            f"\n\nThe environments of [gymnax]({GYMNAX}) {gymnax} (JAX {jax}) with the same tasks, in the "
            f"same run, in float32:\n\n{markdown_table(PEER, compared)}"
        )
    return text


def take_over(report: dict[str, Any], checkout: Path) -> None:
    """Write a report into a checkout: ``docs/gpu.json``, and the table of docs/speed.md."""
    page = checkout / "docs" / "speed.md"
    text = with_table(page.read_text(encoding="utf-8"), report)
    write_file(checkout / "docs" / "gpu.json", readable_json(report))
    write_file(page, text)


def with_table(page: str, report: dict[str, Any]) -> str:
    """Return the text of docs/speed.md with a report's table."""
    return replaced(page, "gpu", gpu_markdown(report))


def _compared(report: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the lines of `PEER`: steps in a CUDA graph beside those of gymnax."""
    return [
        (
            row["id"],
            f"{row['num_envs']:,}",
            rate_text(row["replayed"]),
            rate_text(row["gymnax"]),
            f"{row['replayed'] / row['gymnax']:.2g}",
        )
        for row in report["rows"]
        if "gymnax" in row
    ]


def _cells(row: dict[str, Any]) -> list[str]:
    """Return rates and shares of the bandwidth, for steps that are called and for steps in a CUDA graph."""
    if "problem" in row:
        return [row["problem"], "", "", ""]
    return [
        cell
        for rate, share in (("steps", "share"), ("replayed", "replayed_share"))
        for cell in (rate_text(row[rate]), f"{100 * row[share]:.0f} %")
    ]


def _about(report: dict[str, Any]) -> str:
    """Return one line about the machine and the measurement."""
    settings = report["settings"]
    return (
        f"{report['gpu']}, bandwidth {report['bandwidth'] / 1e12:.2f} TB/s (read and written); "
        f"PyTorch {report['versions']['torch']}; medians of {settings['rounds']} samples of "
        f"{settings['seconds']:g} s (`lag-envs bench --device cuda`, {report['date']})"
    )
