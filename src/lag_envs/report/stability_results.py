"""Results on stiff and extreme cases: tables, claims, maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lag_envs.report import extremes
from lag_envs.report.cases import MAIN, VARIANTS
from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.extremes import EXACT
from lag_envs.report.points import LAG_ENVS
from lag_envs.report.runner import JobResult, Row
from lag_envs.report.stability_maps import MAPS

PEERS = ("ETD4RK", "implicit midpoint", "RK4", "Verlet", "explicit Euler")
#: Contents of a cell other than an error.
REFUSED, DIVERGED, NO_REFERENCE, TOO_LONG = "refused", "diverged", "no reference", "not run"
#: An error above this many times the state's size counts as divergence, like a result that is not finite.
FAR_OFF = 100.0
#: Largest number of substeps for the formulas alone, without the jump along the slow manifold.
MOST_SUBSTEPS = 1000
#: Colours of cells without an error; errors go from pale yellow to dark blue.
SPECIAL = {DIVERGED: "black", REFUSED: "#d55e00", TOO_LONG: "#d0d0d0", NO_REFERENCE: "#8c8c8c"}
LOWEST, HIGHEST = -17, 2
#: What is measured of a named case.
MEASURED = ("error", "amplification", "roundings", "substeps")


def content(rows: list[Row], problems: list[JobResult]) -> Content:
    """Return the section's content."""
    cells = [row for row in rows if row["kind"] == "cell"]
    found = [row for row in rows if row["kind"] == "case"]
    maps: dict[tuple[str, str], list[Row]] = {}
    for row in cells:
        maps.setdefault((row["map"], row["name"]), []).append(row)
    verdicts = _verdicts(found)
    shares = _shares(maps, "stability-maps", "Every map: one step with dt from 1e-6 to 1 s.")
    return Content(
        "Stiff and extreme cases",
        [
            "Each cell of a map is one control step from one start with the control held, once with our "
            "step and once with each comparison integrator, which covers it in one step (or in 16, if "
            "stated). The error is the largest over the state's entries, each relative to its scale: "
            "max(1, |q|, |q'| dt) for places and angles, max(1, |q'|, (α² + β²)^¼) for rates. Diverged "
            f"means a result that is not finite or an error above {FAR_OFF:g} times the scale. The "
            "reference has 30 digits; if that is not enough, the cell says so.",
            "Maps in float32 run the same formulas on float32 numbers. lag_envs then takes the substeps "
            f"that the bound requires, up to {MOST_SUBSTEPS:,}. The jump along the slow manifold, which "
            "avoids most substeps under heavy damping, exists only in float64.",
            "A named case should have full accuracy, be accurate up to the rounding floor, or be refused "
            f"with an error. Full accuracy means an error of at most {EXACT:g} times the scale in every "
            "entry. If the system itself amplifies a rounding of its start so much that no method can reach "
            f"that, {extremes.ROUNDINGS:g} times the effect of such a rounding is allowed in "
            "addition. That effect is measured: every entry of the start is moved by 2^-53 of its size in "
            "the reference. A case is met if its outcome is as expected, or more accurate.",
            "When a step is divided, substeps are computed with twice the digits, so that rounding does "
            "not add up over hundreds of thousands of them. A step that would need more than a million is "
            "refused.",
        ],
        tables=[t for t in (verdicts, shares, _amplified(cells), _problem_table(problems, rows)) if t],
        pictures=_pictures(maps, found),
        claims=_claims(cells, found),
        summary=_summary(maps),
        details=[_map_table(maps), _cell_table(cells)] if cells else [],
    )


def _claims(cells: Sequence[Row], found: Sequence[Row]) -> list[Claim]:
    own = [row["errors"][LAG_ENVS] for row in cells]
    numbers = [e for e in own if isinstance(e, float)]
    good = sum(e <= EXACT for e in numbers)
    amplified = [row["roundings"] for row in cells if row.get("roundings")]
    allowed = sum(share <= extremes.ROUNDINGS for share in amplified)
    unknown, refused = own.count(NO_REFERENCE), own.count(REFUSED)
    missed = [row["name"] for row in found if not row.get("met", False)]
    return [
        Claim(
            f"In every cell of the maps our step is accurate to {EXACT:g} of the scale or to amplified "
            "rounding, or it is refused with an error.",
            good + allowed + refused + unknown == len(own) if numbers else None,
            f"{len(own)} cells: {good} accurate, {allowed} to amplified rounding (at most "
            f"{max(amplified, default=0.0):.1f} roundings), {refused} refused, {unknown} without a "
            f"reference, {len(own) - good - allowed - refused - unknown} missed",
        ),
        Claim(
            "Every stiff or extreme case is accurate as expected or refused as expected.",
            not missed if found else None,
            f"{len(found) - len(missed)} of {len(found)} met"
            + (f"; missed: {', '.join(missed)}" if missed else ""),
        ),
    ]


def _verdicts(found: Sequence[Row]) -> Table | None:
    if not found:
        return None
    order = list(extremes.EXTREMES)
    lines = []
    for row in sorted(found, key=lambda r: order.index(r["name"]) if r["name"] in order else len(order)):
        outcome = row.get("outcome") or f"not measured: {row.get('problem', '')}"
        verdict = "unknown" if row.get("problem") else "met" if row.get("met") else "missed"
        cells = [row["name"], row.get("scene"), row.get("dt"), row.get("expected"), outcome]
        lines.append([*cells, *(row.get(key) for key in MEASURED), verdict])
    return Table(
        "extreme-cases",
        "Every stiff and extreme case. Error: relative to the scale. Amplification: the effect at the end "
        "of one rounding of the start, divided by 2^-53 times the scale. Roundings: the error divided by "
        "the effect of one rounding of the start, or of the end if that is larger.",
        ["case", "scene", "dt [s]", "expected", "came out", *MEASURED, "verdict"],
        lines,
    )


def _counts(rows: Sequence[Row], method: str) -> list[Any]:
    """Return the number of cells, the largest error, and the numbers of good cells and of special states."""
    values = [row["errors"].get(method, NO_REFERENCE) for row in rows]
    numbers = [v for v in values if isinstance(v, float)]
    special = [values.count(name) for name in SPECIAL]
    return [len(values), max(numbers, default=None), sum(v <= EXACT for v in numbers), *special]


def _map_table(maps: dict[tuple[str, str], list[Row]]) -> Table:
    lines = [
        [name, map, method, *_counts(rows, method)]
        for (map, name), rows in maps.items()
        for method in rows[0]["errors"]
    ]
    columns = ["scene", "map", "method", "cells", "largest error", f"cells within {EXACT:g}", *SPECIAL]
    caption = "Cells of every map by method. The largest error is among those that did not diverge."
    return Table("stability-methods", caption, columns, lines)


def _shares(maps: dict[tuple[str, str], list[Row]], name: str, caption: str) -> Table | None:
    """Return a table with a line for each map, with our results and each method's share of exact cells."""
    lines: list[list[Any]] = []
    for (map, scene), rows in maps.items():
        _, largest, *_ = _counts(rows, LAG_ENVS)
        _, single, *_ = _counts(rows, f"{LAG_ENVS}, float32")
        shares = [f"{100 * _counts(rows, method)[2] / len(rows):.0f} %" for method in (LAG_ENVS, *PEERS)]
        roundings = max((row["roundings"] for row in rows if row.get("roundings")), default=None)
        refused = _counts(rows, LAG_ENVS)[3 + list(SPECIAL).index(REFUSED)]
        lines.append([scene, map, len(rows), *shares, largest, roundings, refused, single])
    caption += (
        f" Shares of cells in which one step is accurate to {EXACT:g} of the scale; then our largest error, "
        "our error over the effect of a rounding of the start where it is above that, how often our step is "
        "refused, and the largest error of its formula in float32."
    )
    columns = ["scene", "map", "cells", LAG_ENVS, *PEERS]
    columns += ["largest error of lag_envs", "in roundings", "refused", "largest error, float32"]
    return Table(name, caption, columns, lines) if lines else None


def _summary(maps: dict[tuple[str, str], list[Row]]) -> Table | None:
    """Return a summary of the damping maps."""
    long = _shares({key: rows for key, rows in maps.items() if key[0] == "damping"}, "", "")
    caption = (
        "One step with γ dt from 1e-3 to 1e6 and dt from 1e-6 to 1 s: the share of cases in which each is "
        f"accurate to {EXACT:g} of the scale, and our largest error."
    )
    columns = ["scene", LAG_ENVS, *PEERS, "largest error of lag_envs"]
    return long and long.part("stability", caption, columns)


def _amplified(cells: Sequence[Row]) -> Table | None:
    lines = []
    for row in cells:
        if "substeps" in row:
            roundings = row.get("roundings")
            met = roundings is not None and roundings <= extremes.ROUNDINGS
            place = [row["name"], row["map"], row["x"], row["dt"], row["substeps"]]
            lines.append([*place, row["errors"][LAG_ENVS], roundings, "met" if met else "missed"])
    columns = ["scene", "map", "value", "dt [s]", "substeps", "error", "roundings", "verdict"]
    caption = (
        f"Cells of the maps in which our error is above {EXACT:g} of the scale: the error, and the error "
        "over the effect of one rounding of the start."
    )
    return Table("stability-amplified", caption, columns, lines) if lines else None


def _problem_table(problems: Sequence[JobResult], rows: Sequence[Row]) -> Table | None:
    lines = [[p.name, p.problem] for p in problems]
    lines += [
        [f"{row['name']}, {row['map']} {row['x']:.2g}, step {row['dt']:.2g} s", row["problem"]]
        for row in rows
        if row["kind"] == "cell" and row.get("problem")
    ]
    lines += [[row["name"], row["problem"]] for row in rows if row["kind"] == "case" and row.get("problem")]
    return Table("stability-problems", "Problems: not measured.", ["what", "why"], lines) if lines else None


def _cell_table(cells: Sequence[Row]) -> Table:
    lines = [
        [row["name"], row["map"], row["x"], row["dt"], method, value]
        for row in cells
        for method, value in row["errors"].items()
    ]
    columns = ["scene", "map", "gamma dt or speed", "dt [s]", "method", "error"]
    return Table("stability-cells", "Every cell of every map.", columns, lines)


def _pictures(maps: dict[tuple[str, str], list[Row]], found: Sequence[Row]) -> list[ReportFigure]:
    pictures = []
    for (map, name), rows in maps.items():
        for n, times in (("", "in one step"), (", 16", "in 16 steps")):
            if n and (map, name) != ("damping", MAIN):
                continue
            pictures.append(
                ReportFigure(
                    f"stability-{map}-{_slug(name)}{n.replace(', ', '-')}",
                    f"{name}: error of one control step over {MAPS[map].label} and the step; comparison "
                    f"integrators {times}. Each map is shown next to the same map in float32. Start "
                    f"{VARIANTS[name].start}. Reference: 30 digits.",
                    partial(_draw_map, rows, MAPS[map].label, n),
                    raster=True,
                )
            )
    measured = [row for row in found if row.get("peers")]
    if measured:
        pictures.append(
            ReportFigure(
                "extreme-cases-map",
                "The named cases: log10 of the error of one control step, lag_envs and the comparison "
                "integrators, the latter in one step and in 16. Cases that should be refused are in the "
                "table only.",
                lambda: _draw_cases(measured),
                raster=True,
            )
        )
    return pictures


def _slug(name: str) -> str:
    return name.lower().replace(", ", "-").replace(" ", "-")


def _edges(values: Sequence[float]) -> np.ndarray:
    """Return the borders of cells around values, halfway between their logarithms."""
    logs = np.log(values)
    gap = np.diff(logs) if len(logs) > 1 else np.array([1.0])
    middle = logs[:-1] + 0.5 * gap[: len(logs) - 1]
    return np.exp([logs[0] - 0.5 * gap[0], *middle, logs[-1] + 0.5 * gap[-1]])


def _paint(axes: Any, x: Any, y: Any, values: Sequence[Sequence[Any]]) -> Any:
    """Draw cells that hold errors or a special state; return the mappable for the colour bar."""
    shades = ListedColormap(colormaps["YlGnBu"](np.linspace(0.0, 0.9, 190)))
    logs = [
        [math.log10(max(v, 1e-17)) if isinstance(v, float) else math.nan for v in line] for line in values
    ]
    mesh = axes.pcolormesh(x, y, np.ma.masked_invalid(logs), cmap=shades, vmin=LOWEST, vmax=HIGHEST)
    for name, colour in SPECIAL.items():
        here = np.array([[v == name for v in line] for line in values])
        if here.any():
            axes.pcolormesh(x, y, np.ma.masked_where(~here, here * 1.0), cmap=ListedColormap([colour]))
    return mesh


def _finish(figure: Figure, mesh: Any, panels: Any) -> None:
    ticks = range(LOWEST + 1, HIGHEST + 1, 2)
    label = "log10 of the error relative to its scale"
    figure.colorbar(mesh, ax=panels, label=label, fraction=0.03, ticks=ticks)
    patches = [Patch(facecolor=c, edgecolor="black", label=name) for name, c in SPECIAL.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=8)


def _draw_map(rows: Sequence[Row], label: str, n: str) -> Figure:
    xs, ys = (sorted({row[key] for row in rows}) for key in ("x", "dt"))
    known = {(row["x"], row["dt"]): row["errors"] for row in rows}
    figure = Figure(figsize=(9, 7), layout="constrained")
    panels = figure.subplots(3, 4, sharex=True, sharey=True)
    shown = [
        (name if name == LAG_ENVS else name + n) + more
        for name in (LAG_ENVS, *PEERS)
        for more in ("", ", float32")
    ]
    for axes, method in zip(panels.flat, shown, strict=True):
        values = [[known.get((x, y), {}).get(method, NO_REFERENCE) for x in xs] for y in ys]
        mesh = _paint(axes, _edges(xs), _edges(ys), values)
        axes.set(xscale="log", yscale="log")
        axes.set_title(method, fontsize=9, fontweight="bold" if method == LAG_ENVS else "normal")
        axes.tick_params(labelsize=8)
    for axes in panels[-1]:
        axes.set_xlabel(label, fontsize=9)
    for axes in panels[:, 0]:
        axes.set_ylabel("step dt [s]", fontsize=9)
    for spine in panels[0, 0].spines.values():
        spine.set_linewidth(2.5)
    _finish(figure, mesh, panels)
    return figure


def _draw_cases(rows: Sequence[Row]) -> Figure:
    order = list(extremes.EXTREMES)
    rows = sorted(rows, key=lambda row: -order.index(row["name"]))
    methods = [LAG_ENVS, f"{LAG_ENVS}, float32", *(name + n for n in ("", ", 16") for name in PEERS)]
    values = [[row["peers"].get(method, NO_REFERENCE) for method in methods] for row in rows]
    figure = Figure(figsize=(9, 2.2 + 0.2 * len(rows)), layout="constrained")
    axes = figure.subplots()
    mesh = _paint(axes, np.arange(len(methods) + 1), np.arange(len(rows) + 1), values)
    axes.set_xticks(np.arange(len(methods)) + 0.5, methods, rotation=40, ha="right", fontsize=8)
    axes.set_yticks(np.arange(len(rows)) + 0.5, [row["name"] for row in rows], fontsize=8)
    axes.set(xlabel="method", ylabel="case")
    _finish(figure, mesh, [axes])
    return figure
