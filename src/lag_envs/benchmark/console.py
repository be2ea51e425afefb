"""A report as lines of text, for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from lag_envs.benchmark import divisions, jacobians
from lag_envs.benchmark.chain_costs import cost_table, growth
from lag_envs.benchmark.results import quartiles, times_of
from lag_envs.tables import aligned, rate_text


def report_lines(report: dict[str, Any]) -> list[str]:
    """Return the report as lines of text."""
    about, settings = report["machine"], report["settings"]
    lines = [
        f"{about['processor']}, {about['cores']} cores, {about['system']}, Python {about['python']}",
        f"{'a core for each thread' if report.get('speedups') else 'one core'}, {settings['clock']} time, "
        f"{settings['rounds']} samples of {settings['seconds']:g} s each",
        ", ".join(f"{name} {number}" for name, number in report["versions"].items()),
        "",
    ]
    if report["rows"]:
        head = (
            "library",
            "environment",
            "kind",
            "envs",
            "steps/s",
            "(quartiles)",
            "ns/step",
            "x CartPole",
            "(quartiles)",
        )
        lines += aligned([head, *map(_cells, report["rows"])])
        lines += [
            "",
            "x CartPole: median over the rounds of the ratio to Gymnasium's CartPole-v1 of the same size",
            "",
        ]
    if found := report.get("speedups"):
        names = ("environment", "envs", f"{settings['threads']} threads : 1", "(quartiles)")
        lines += [*aligned([names, *map(_compared, found)]), ""]
    if found := report.get("arithmetic"):
        titles = ("environment", "envs", "products a step", "of the core's peak", "(quartiles)")
        lines += [*aligned([titles, *map(_share, found)]), ""]
    if found := report.get("chains"):
        lines += [*aligned(cost_table(found)), growth(found), ""]
    if costs := report.get("jacobians"):
        lines += [*aligned(jacobians.jacobian_table(costs)), ""]
    if costs := report.get("backwards"):
        lines += [*aligned(jacobians.backwards_table(costs)), ""]
    if found := report.get("divisions"):
        rows = [divisions.table_row(row, times_of(report).get(row["id"])) for row in found]
        lines += [*aligned([divisions.HEAD, *rows]), ""]
    for name, cold in report["cold_start"].items():
        low, middle, high = quartiles(cold["seconds"])
        spread = f"({low:.2f} - {high:.2f}), {len(cold['seconds'])} processes"
        lines += [f"cold start, cache {name}: {middle:.2f} s {spread}; median of each stage, ms:"]
        rows = [(f"  {stage}", f"{1e3 * seconds:.1f}") for stage, seconds in cold["stages"].items()]
        lines += [*aligned(rows), ""]
    words = {True: "met", False: "missed", None: "not measured"}
    lines += aligned([(words[t["met"]], t["target"], _worst(t)) for t in report["targets"]])
    if not report["complete"]:
        lines += ["", "interrupted: these are the samples so far"]
    return lines


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    name = (row["library"], row["id"], row["kind"], f"{row['num_envs']:,}")
    if "steps_per_second" not in row:
        return (*name, row["problem"] or "not measured")
    rates = row["steps_per_second"]
    cells: tuple[str, ...] = (*name, *_quartiles(rates, rate_text), f"{1e9 / rates[1]:,.1f}")
    if "ratio" in row:
        cells += _quartiles(row["ratio"], "{:.2f}".format)
    return (*cells, row["problem"]) if row["problem"] else cells


def _quartiles(quartiles: Sequence[float], text: Callable[[float], str]) -> tuple[str, str]:
    """Return the median and, in brackets, the other quartiles."""
    low, middle, high = map(text, quartiles)
    return middle, f"({low} - {high})"


def _compared(row: dict[str, Any]) -> tuple[str, ...]:
    return row["id"], f"{row['num_envs']:,}", *_quartiles(row["ratio"], "{:.2f}".format)


def _share(row: dict[str, Any]) -> tuple[str, ...]:
    numbers = f"{row['num_envs']:,}", f"{row['products']:,}"
    return row["id"], *numbers, *_quartiles(row["share"], "{:.0%}".format)


def _worst(target: dict[str, Any]) -> str:
    measured = target["measured"]
    if not measured:
        return ""
    if "seconds" in measured:
        return f"{measured['seconds']:.2f} s"
    worst = min(measured, key=measured.get)
    missed = sum(value < target["limit"] for value in measured.values())
    return f"{measured[worst]:.2f} by {worst}" + (
        f", missed by {missed} of {len(measured)}" if missed and len(measured) > 1 else ""
    )
