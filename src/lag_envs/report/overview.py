"""The first picture of docs/accuracy.md: a work-precision diagram of lag_envs and its rivals.

It is drawn from ``docs/accuracy.json`` alone, so it can be redrawn without measuring.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lag_envs.report.diagrams import DARK, STYLES, labelled_lines
from lag_envs.report.points import LAG_ENVS

#: A scene with a dedicated step, a system for the general series, and the methods that step both.
SCENE, SYSTEM, MODE = "PivotedBar", "double pendulum, driven", "alone"
#: The tables of times on systems for the general series, of single states and in batches.
MODES = ("general-times-single", "general-times-batch")
#: The names of rivals in the picture.
RIVALS = ("heyoka", "MuJoCo", "Pinocchio", "RK4, compiled", "DOP853, compiled", "Radau IIA, compiled")
Points = list[tuple[float, float]]


def draw_overview(accuracy: dict[str, Any]) -> Figure:
    """Draw the picture.

    Parameters
    ----------
    accuracy : dict
        The contents of ``docs/accuracy.json``.
    """
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _panel(left, "A bar on a moving support: a dedicated step", *own_step(accuracy))
    _panel(right, "A driven double pendulum: the general series", *general(accuracy))
    left.set_ylabel("largest error of one control step, relative")
    shown = labelled_lines((left, right))
    first = f"{LAG_ENVS}, with a proved bound"
    names = [first, *sorted(set(shown) - {first})]
    figure.legend([shown[name] for name in names], names, loc="outside lower center", ncols=5, fontsize=8)
    place = {"xycoords": "axes fraction", "horizontalalignment": "right"}
    left.annotate("lower left is better", (0.98, 0.03), **place, fontsize=8, color="#555555")
    return figure


def own_step(accuracy: dict[str, Any]) -> tuple[Points, dict[str, Points]]:
    """Return (time [ns], error) of lag_envs and of the rivals that take less than 10 times as long."""
    (row,) = _rows(accuracy, "work_precision", "work_precision", scene=SCENE, mode=MODE)
    own_points = [(row["ns"], float(row["error"]))]
    rivals: dict[str, Points] = {}
    for near in _rows(accuracy, "work_precision", "work_precision_near", scene=SCENE, mode=MODE):
        name = near["rival"].removesuffix(", carried").removesuffix(" Taylor")
        for column, ratio in near.items():
            if column.startswith("to ") and ratio is not None:
                rivals.setdefault(name, []).append((ratio * row["ns"], float(column[3:])))
    # The faster form of each method.
    best = {name: _fastest(points) for name, points in rivals.items()}
    return own_points, {name: points for name, points in best.items() if len(points) > 1}


def general(accuracy: dict[str, Any]) -> tuple[Points, dict[str, Points]]:
    """Return the same results for a system that is stepped by the general series."""
    own_points: Points = []
    rivals: dict[str, Points] = {}
    for row in _rows(accuracy, "general", MODES[0], system=SYSTEM):
        own_points.append((row[LAG_ENVS], float(row["error"])))
        for name in RIVALS:
            if row[name] is not None:
                rivals.setdefault(name.removesuffix(", compiled"), []).append(
                    (row[name], float(row["error"]))
                )
    return own_points, rivals


def faster_rivals(accuracy: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return for each error how often a rival is faster: on the package's scenes, and on others."""
    own = list(_rows(accuracy, "work_precision", "work_precision_targets", horizon="one step"))
    systems = [row for name in MODES for row in _rows(accuracy, "general", name)]

    def often(rows: list[dict[str, Any]], ratio: str, error: float) -> str:
        ratios = [row[ratio] for row in rows if float(row["error"]) == error]
        return f"{sum(x is not None and x < 1.0 for x in ratios)} of {len(ratios)}"

    return [
        (_power(x), often(own, "other / lag_envs", x), often(systems, "quickest other / lag_envs", x))
        for x in dict.fromkeys(float(row["error"]) for row in systems)
    ]


def overview_sentences(accuracy: dict[str, Any]) -> list[str]:
    """Return a sentence about the time of a general simulator, if one was measured."""
    row = list(_rows(accuracy, "general", MODES[0], system=SYSTEM))[-1]
    if row["MuJoCo"] is None:
        return []
    return [
        f"A general simulator pays for its generality: at {_power(row['error'])} MuJoCo takes "
        f"{row['MuJoCo'] / row[LAG_ENVS]:,.0f} times as long as lag_envs in the right panel."
    ]


def _power(error: float | str) -> str:
    return f"1e{round(math.log10(float(error)))}"


def _fastest(points: Points) -> Points:
    best: dict[float, float] = {}
    for time, error in points:
        best[error] = min(time, best.get(error, time))
    return [(time, error) for error, time in sorted(best.items(), reverse=True)]


def _rows(accuracy: dict[str, Any], section: str, table: str, **wanted: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table as dicts by column, if they have the given entries."""
    parts = next(part for part in accuracy["sections"] if part["name"] == section)
    found = next(one for one in parts["tables"] if one["name"] == table)
    for cells in found["rows"]:
        row = dict(zip(found["columns"], cells, strict=True))
        if all(row[key] == value for key, value in wanted.items()):
            yield row


def _panel(ax: Axes, title: str, own_points: Points, rivals: dict[str, Points]) -> None:
    for name, points in rivals.items():
        known = STYLES.get(name) or STYLES.get(f"{name} Taylor") or STYLES.get(f"{name} RK4")
        colour, marker, line = known or ("#666666", "h", "--")
        marker = marker.replace("*", "<")  # the star is lag_envs'
        ax.plot(*zip(*points, strict=True), marker + line, color=colour, markersize=5, label=name)
    ax.plot(
        *zip(*own_points, strict=True),
        "*-",
        color=DARK,
        markersize=13,
        label=f"{LAG_ENVS}, with a proved bound",
    )
    ax.set(xscale="log", yscale="log", xlabel="time of a control step [ns]", ylim=(2e-17, 3e-3))
    ax.set_title(title, fontsize=10)
    ax.grid(color="#e5e5e5")
    ax.set_axisbelow(True)
