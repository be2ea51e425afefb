"""Work-precision diagrams: error against time, one figure for each scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lag_envs.report.points import HORIZONS, MODES, WorkPrecisionPoint

#: Colours after Okabe and Ito; methods compiled by our machinery have solid lines, libraries dashed ones.
STYLES = {
    "explicit Euler": ("#999999", "o", "-"),
    "semi-implicit Euler": ("#999999", "s", "-"),
    "Verlet": ("#56B4E9", "v", "-"),
    "implicit midpoint": ("#CC79A7", "^", "-"),
    "RK4": ("#E69F00", "D", "-"),
    "ETD4RK": ("#009E73", "P", "-"),
    "Radau IIA": ("#CC79A7", "s", "-"),
    "DOP853": ("#D55E00", "*", "-"),
    "SciPy dopri5": ("#D55E00", "o", "--"),
    "SciPy dop853": ("#D55E00", "s", "--"),
    "SciPy Radau": ("#D55E00", "^", "--"),
    "SciPy lsoda": ("#D55E00", "v", "--"),
    "heyoka Taylor": ("#000000", "X", "--"),
    "diffrax Tsit5": ("#8C6D31", "o", "--"),
    "diffrax Dopri8": ("#8C6D31", "s", "--"),
    "torchdiffeq dopri5": ("#7F3C8D", "o", "--"),
    "torchdiffeq dopri8": ("#7F3C8D", "s", "--"),
    "torchdiffeq rk4": ("#7F3C8D", "D", "--"),
    "MuJoCo Euler": ("#B8860B", "o", ":"),
    "MuJoCo implicitfast": ("#B8860B", "^", ":"),
    "MuJoCo RK4": ("#B8860B", "D", ":"),
}
OWN_STYLES = {"lag_envs": ("*", 15), "lag_envs, one call": ("p", 11)}
DARK = "#003B5C"
ROUNDED = "amplified rounding"
LOWEST = 1e-17


def draw_variant(variant: str, points: Sequence[WorkPrecisionPoint], floor: Mapping[tuple, float]) -> Figure:
    """Draw one variant: horizons side by side, single states above, batches below."""
    figure = Figure(figsize=(10.5, 7.6), layout="constrained")
    here = [p for p in points if p.variant == variant]
    horizons = [h for h in HORIZONS if any(p.horizon == h for p in here)]
    axes = figure.subplots(len(MODES), len(horizons), sharey=True, squeeze=False)
    for row, (mode, words) in zip(axes, MODES.items(), strict=True):
        for ax, horizon in zip(row, horizons, strict=True):
            panel(
                ax, [p for p in here if (p.horizon, p.mode) == (horizon, mode)], floor.get((variant, horizon))
            )
            ax.set_title(f"{horizon}, {words}", fontsize=10)
        row[0].set_ylabel("largest error, relative")
    for ax in axes[-1]:
        ax.set_xlabel("time of a control step [ns]")
    known = labelled_lines(axes.flat)
    names = [name for name in (*OWN_STYLES, *STYLES, ROUNDED) if name in known]
    figure.legend(
        [known[n] for n in names], names, loc="outside lower center", ncols=6, fontsize=8.5, frameon=False
    )
    return figure


def labelled_lines(panels: Iterable[Axes]) -> dict[str, Any]:
    """Return a line for each label in the panels."""
    return {label: line for ax in panels for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}


def panel(ax: Axes, points: Sequence[WorkPrecisionPoint], floor: float | None) -> None:
    """Draw all curves of one horizon and mode."""
    ax.set(xscale="log", yscale="log", ylim=(LOWEST, 1.5))
    ax.grid(True, which="major", color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    if floor:
        ax.axhline(floor, color="0.3", linestyle=":", linewidth=1.2, label=ROUNDED)
    for name, curve in curves(points).items():
        colour, marker, line = STYLES.get(name, ("0.5", ".", "-"))
        _curve(
            ax, curve, label=name, color=colour, marker=marker, linestyle=line, linewidth=1.0, markersize=3.5
        )
    for method, (marker, size) in OWN_STYLES.items():
        _curve(
            ax, [p for p in points if p.own and p.method == method], label=method, marker=marker,
            markersize=size, color=DARK, linestyle="", markeredgecolor="white", zorder=6,
        )  # fmt: skip


def curves(points: Sequence[WorkPrecisionPoint]) -> dict[str, list[WorkPrecisionPoint]]:
    """Return a curve for each rival: the points, from all forms of a method, that no other form beats."""
    found: dict[str, list[WorkPrecisionPoint]] = {}
    for p in points:
        if not p.own:
            found.setdefault(p.name.partition(",")[0], []).append(p)
    return {
        name: sorted(
            (p for p in some if not any(q.ns < p.ns and q.worst <= p.worst for q in some)), key=lambda p: p.ns
        )
        for name, some in found.items()
    }


def _height(p: WorkPrecisionPoint) -> float:
    return 1.0 if p.diverged or p.error is None else max(p.error, 1.3 * LOWEST)


def _curve(ax: Axes, points: Sequence[WorkPrecisionPoint], **style: Any) -> None:
    if not points:
        return
    ax.plot([p.ns for p in points], [_height(p) for p in points], **style)
    bars = [p for p in points if not p.diverged and p.median is not None]
    ax.vlines(
        [p.ns for p in bars],
        [max(p.median or 0.0, 1.3 * LOWEST) for p in bars],
        [_height(p) for p in bars],
        color=style["color"], linewidth=0.6, alpha=0.35,
    )  # fmt: skip
