"""Results on scenes defined by energies: errors and times as tables, claims, pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from statistics import median
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.diagrams import labelled_lines
from lag_envs.report.linkages import SYSTEMS
from lag_envs.report.motions import CertifiedSeries
from lag_envs.report.points import LIBRARIES, MODES, TARGETS
from lag_envs.report.runner import JobResult, Row
from lag_envs.stepping.general import usual_order
from lag_envs.stepping.series import LARGEST_ORDER, LEAST_ORDER, TOLERANCE

#: Length of the control step [s], and the number of start states.
DT, MEMBERS = 0.02, 200
#: Orders at which the certificate is tried.
CERTIFIED_ORDERS = (12, 14, 16, 18, 20, 22)
#: Largest difference of equal models, and largest loss of energy, relative.
EQUAL, DRIFT = 1e-12, 1e-9


class BestSetting(NamedTuple):
    """A method's fastest setting that reaches an error."""

    ns: float
    label: str


def setting_label(row: Row) -> str:
    """Return a setting in words."""
    if row["family"] in ("lag_envs", "heyoka"):
        return f"{row['method'].removeprefix('lag_envs, ')}, {row['setting']:g}"
    return f"{row['method']}, {row['setting']:g} substep{'s' if row['setting'] > 1 else ''}"


def column_name(row: Row) -> str:
    """Return a point's column; each compiled method has one."""
    if row["family"] == "lag_envs":
        return "lag_envs"
    if row["family"] == "compiled":
        return f"{row['method']}, compiled"
    return LIBRARIES[row["family"]]


#: The rivals to compare with, and their columns.
OTHERS = (
    ("other libraries", ("heyoka", "MuJoCo", "Pinocchio")),
    (
        "fixed-step methods without a bound, compiled like lag_envs",
        ("RK4, compiled", "DOP853, compiled", "Radau IIA, compiled"),
    ),
)
COLUMNS = (*OTHERS[0][1], *OTHERS[1][1])


def best_settings(rows: Sequence[Row]) -> dict[tuple[str, str, float], dict[str, BestSetting]]:
    """Return, by system, mode and error, the quickest setting of each column.

    Times are in units of lag_envs's in one job, by the clock of every job. A method without a batch counts
    there as it does alone.
    """
    points = [r for r in rows if r["kind"] == "point" and "ns" in r and r["error"] is not None]
    clocks: dict[tuple[str, str], float] = {}
    for r in points:
        if r["family"] == "lag_envs":
            clocks.setdefault((r["system"], r["mode"]), r["clock"])
    found: dict[tuple[str, str, float], dict[str, BestSetting]] = {}
    for r in points:
        ns = r["ns"] * clocks.get((r["system"], r["mode"]), r["clock"]) / r["clock"]
        for mode in MODES:
            if mode != r["mode"] and r["batched"]:
                continue
            for target in TARGETS:
                here = found.setdefault((r["system"], mode, target), {})
                if r["error"] <= target and not (column_name(r) in here and here[column_name(r)].ns <= ns):
                    here[column_name(r)] = BestSetting(ns, setting_label(r))
    return found


def content(rows: Sequence[Row], problems: Sequence[JobResult]) -> Content:
    """Return the content: times at equal errors, equality of models, certificates, first steps, energy."""
    found = best_settings(rows)
    absent = missing(rows)
    fastest = [_fastest(found, mode, *others) for others in OTHERS for mode in MODES]
    claims = [_equal(rows), _accurate(rows), *fastest, _conserved(rows)]
    pictures = [
        ReportFigure(
            f"general-{file_part(name)}",
            f"Error against time, {name}. One control step of {DT:g} s from {MEMBERS} harsh states: worst "
            "error, and CPU time of a state's step; reference: Lagrange's equations by SymPy, Taylor "
            "series in python-flint's balls.",
            partial(draw_times, name, [r for r in rows if r["kind"] == "point" and r["system"] == name]),
        )
        for name in SYSTEMS
        if any(r["kind"] == "point" and r["system"] == name for r in rows)
    ]
    tables = [best_times("general", found, mode) for mode in MODES]
    tables += [_models(rows), _shares(rows), _first(rows), _energy(rows)]
    return Content(
        "Any Lagrangian",
        [
            "Scenes that state nothing but their energies are stepped by the general series, which "
            f"certifies each step. Here they take one control step of {DT:g} s from {MEMBERS} harsh "
            "states, in which each joint turns at up to 6 to 12 rad/s. The error is that of the worst "
            "entry of the worst state, relative to max(1, |entry|), against Taylor series of Lagrange's "
            "equations by SymPy in python-flint's ball arithmetic.",
            "All run in compiled loops, many states in one call, on one core. The overhead of a call counts, "
            "compilation does not. Samples are taken in turn, and times are medians of processor time. The "
            "errors are those of the timed calls, at the fastest setting that reaches the given "
            "error.",
            "lag_envs certifies each step, at a tolerance and an order, by the code of a task that chooses "
            f"this order; tasks may choose {LEAST_ORDER} to {LARGEST_ORDER}. Environments always step at a "
            f"tolerance of {TOLERANCE:g}. The others give no bound: which setting reaches an error is known "
            "here only from the exact ends. heyoka runs with fast_math, without compact mode (loops written "
            "out), its compiled step in a compiled loop, in a batch in blocks of two widths. "
            "MuJoCo runs its own model in compiled rollouts, by Euler, implicitfast and RK4; Pinocchio its "
            "articulated-body algorithm in RK4 steps in a C++ loop. For both, a moving support is modelled "
            "by an inertial force in its own frame. RK4, DOP853 and Radau IIA take fixed steps and are "
            "compiled like lag_envs.",
            *([f"Not compared: {absent}."] if absent else []),
            *(verdict(found, mode) for mode in MODES if found),
        ],
        [t for t in tables if t.rows],
        pictures,
        claims,
        summary=_summary(found),
        details=[all_points("general-points", rows)],
    )


def missing(rows: Sequence[Row]) -> str:
    """Return the libraries that are not installed."""
    return ", ".join(sorted({r["problem"] for r in rows if "not installed" in r.get("problem", "")}))


def file_part(name: str) -> str:
    """Return a system's name as part of a file's."""
    return name.replace(",", "").replace(" ", "-")


def verdict(found: Mapping[tuple, Mapping[str, BestSetting]], mode: str) -> str:
    """Summarise for each column how it compares at equal error."""
    parts = []
    for name in COLUMNS:
        ratios = [here[name].ns / here["lag_envs"].ns for _, _, here in _cases(found, mode) if name in here]
        if not ratios:
            continue
        worst, wins = min(ratios), sum(r < 1.0 for r in ratios)
        text = f"{name} takes {worst:.2g} to {max(ratios):.3g} times our time"
        parts.append(text + (f", and is faster in {wins} of {len(ratios)} cases" if wins else ""))
    return (
        f"At equal error, {MODES[mode]}: {'; '.join(parts)}."
        if parts
        else f"Nothing to compare {MODES[mode]}."
    )


def _cases(
    found: Mapping[tuple, Mapping[str, BestSetting]], mode: str
) -> list[tuple[str, float, Mapping[str, BestSetting]]]:
    """Return system, error and quickest settings where lag_envs is among them."""
    return [
        (name, error, here) for (name, of, error), here in found.items() if of == mode and "lag_envs" in here
    ]


def _cell(here: Mapping[str, BestSetting], name: str) -> float | None:
    return round(here[name].ns, 1) if name in here else None


def _others(here: Mapping[str, BestSetting]) -> list[str]:
    """Return the columns of others, the quickest first."""
    return sorted((name for name in here if name != "lag_envs"), key=lambda name: (here[name].ns, name))


def best_times(section: str, found: Mapping[tuple, Mapping[str, BestSetting]], mode: str) -> Table:
    """Return the quickest setting of each column, by system and error."""
    rows = []
    for system, target, here in _cases(found, mode):
        own, quickest = here["lag_envs"], next(iter(_others(here)), None)
        rows.append((
            system, f"{target:g}", round(own.ns, 1), own.label, *(_cell(here, name) for name in COLUMNS),
            quickest and here[quickest].ns / own.ns, quickest and f"{quickest}: {here[quickest].label}",
        ))  # fmt: skip
    return Table(
        f"{section}-times-{mode}",
        f"CPU time of a control step [ns] {MODES[mode]}, each at its quickest setting whose worst error is "
        "below the one given; the ratio is that of the quickest other to lag_envs, below 1 where the other "
        "is faster",
        (
            "system",
            "error",
            "lag_envs",
            "order, tolerance",
            *COLUMNS,
            "quickest other / lag_envs",
            "quickest other",
        ),
        rows,
    )


def _summary(found: Mapping[tuple, Mapping[str, BestSetting]]) -> Table | None:
    rows = []
    for system, target, here in _cases(found, "single"):
        if target in (1e-6, 1e-12):
            together = found.get((system, "batch", target), {})
            cells = [_cell(here, name) for name in COLUMNS[:5]]
            rows.append((system, f"{target:g}", _cell(here, "lag_envs"), _cell(together, "lag_envs"), *cells,
                         _cell(together, "heyoka")))  # fmt: skip
    if not rows:
        return None
    return Table(
        "general-summary",
        f"Scenes defined by energies alone: CPU time of a control step of {DT:g} s [ns], each at its "
        f"quickest setting whose worst error from {MEMBERS} harsh states is below the one given; lag_envs is "
        "certified, the others give no bound (`lag-envs report`)",
        ("system", "error", "lag_envs", "in a batch", *COLUMNS[:5], "heyoka in a batch"),
        rows,
    )


def _equal(rows: Sequence[Row]) -> Claim:
    found = [r for r in rows if r["kind"] == "model" and "mass" in r]
    worst = max((max(r["mass"], r["acceleration"]) for r in found), default=0.0)
    return Claim(
        f"Other engines have the same models: mass matrices and accelerations to {EQUAL:g}.",
        worst <= EQUAL if found else None,
        f"{worst:.1e} at most in {len(found)} models" if found else "",
    )


def _accurate(rows: Sequence[Row]) -> Claim:
    shipped = CertifiedSeries(usual_order(DT), TOLERANCE)
    key = shipped.method, shipped.setting
    found = [r for r in rows if r["kind"] == "point" and (r["method"], r["setting"]) == key]
    worst = max((math.inf if r["error"] is None else r["error"] for r in found), default=0.0)
    return Claim(
        "At the shipped tolerance and order, a step from a harsh state errs by less than 1e-12.",
        worst < 1e-12 if found else None,
        f"{worst:.1e} at most" if found else "",
    )


def _fastest(
    found: Mapping[tuple, Mapping[str, BestSetting]], mode: str, who: str, names: Sequence[str]
) -> Claim:
    lost, cases = [], 0
    for system, target, here in _cases(found, mode):
        name = next((name for name in _others(here) if name in names), None)
        if name is None:
            continue
        cases += 1
        own, ns = here["lag_envs"].ns, here[name].ns
        if ns < own:
            lost.append(f"{name} by {own / ns:.2f} ({system}, {target:g})")
    told = f"{cases - len(lost)} of {cases} cases" + (f"; faster: {', '.join(lost)}" if lost else "")
    return Claim(
        f"lag_envs reaches each error in less time than {who}, {MODES[mode]}.",
        not lost if cases else None,
        told if cases else "",
    )


def _conserved(rows: Sequence[Row]) -> Claim:
    found = [r for r in rows if r["kind"] == "energy" and r["method"] == "lag_envs, as shipped"]
    return Claim(
        f"The energy of an undamped double pendulum stays within {DRIFT:g} of its range.",
        all(r["drift"] <= DRIFT for r in found) if found else None,
        f"{max(r['drift'] for r in found):.1e} over {found[0]['seconds']:,.0f} s" if found else "",
    )


def _models(rows: Sequence[Row]) -> Table:
    return Table.of(
        "general-models",
        "Other engines' models against Lagrange's equations by SymPy, at 50 random states: largest "
        "differences, relative",
        {
            "system": "system",
            "engine": lambda r: LIBRARIES[r["engine"]],
            "mass matrix": lambda r: r.get("mass", r.get("problem")),
            "acceleration": lambda r: r.get("acceleration"),
        },
        [r for r in rows if r["kind"] == "model"],
    )


def _shares(rows: Sequence[Row]) -> Table:
    found: dict[tuple[str, float], dict[int, Row]] = {}
    for r in rows:
        if r["kind"] == "certificate":
            found.setdefault((r["system"], r["dt"]), {})[r["order"]] = r
    return Table(
        "general-certificate",
        "Share of harsh states from which a step of a length is certified as a whole at the shipped "
        f"tolerance, by order, and attempts per step at order {CERTIFIED_ORDERS[-1]}",
        ("system", "step [s]", *(f"order {n}" for n in CERTIFIED_ORDERS), "attempts", "refused"),
        [
            (system, dt, *(f"{100.0 * here[n]['share']:.1f} %" for n in CERTIFIED_ORDERS),
             here[CERTIFIED_ORDERS[-1]]["attempts"], sum(r["refused"] for r in here.values()))
            for (system, dt), here in found.items()
            if len(here) == len(CERTIFIED_ORDERS)
        ],
    )  # fmt: skip


def _first(rows: Sequence[Row]) -> Table:
    found: dict[str, dict[str, list[float]]] = {}
    for r in rows:
        if r["kind"] == "first" and "seconds" in r:
            found.setdefault(r["system"], {}).setdefault(r["what"], []).append(r["seconds"])
    kinds = ("cold", "cached", "heyoka, single", "heyoka, batch")
    return Table(
        "general-first",
        "CPU seconds until the first step, without imports: lag_envs from energies to a step, with an empty "
        "and with a filled cache of compiled code; heyoka's compilation at tolerance 1e-15",
        ("system", "lag_envs, cold", "lag_envs, cached", "heyoka", "heyoka, batch"),
        [(name, *(median(of[k]) if k in of else None for k in kinds)) for name, of in found.items()],
    )


def _energy(rows: Sequence[Row]) -> Table:
    return Table.of(
        "general-energy",
        "Energy of undamped double pendulums: largest drift, relative to its height above the lowest "
        "energy; lag_envs over the whole time, the others at the end",
        {
            "method": "method",
            "seconds": "seconds",
            "drift": lambda r: "lost" if r["drift"] is None else r["drift"],
        },
        [r for r in rows if r["kind"] == "energy"],
    )


def all_points(name: str, rows: Sequence[Row]) -> Table:
    """Return every setting of every method."""
    names = ("system", "mode", "family", "method", "setting", "error", "median", "ns", "clock", "problem")
    points = [r for r in rows if r["kind"] == "point"]
    return Table(name, "All points", names, [[r.get(entry) for entry in names] for r in points])


#: Colours after Okabe and Ito.
STYLES = {
    "lag_envs": ("#003B5C", "*"),
    "heyoka": ("#000000", "X"),
    "MuJoCo": ("#B8860B", "D"),
    "Pinocchio": ("#7F3C8D", "o"),
    "RK4, compiled": ("#E69F00", "D"),
    "DOP853, compiled": ("#D55E00", "s"),
    "Radau IIA, compiled": ("#CC79A7", "^"),
}


def draw_times(name: str, rows: Sequence[Row]) -> Figure:
    """Draw worst errors against times; of each column, the settings that no other setting beats."""
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    for ax, (mode, words) in zip(figure.subplots(1, 2, sharey=True), MODES.items(), strict=True):
        ax.set(xscale="log", yscale="log", ylim=(1e-16, 1.0), xlabel="time of a control step [ns]")
        ax.grid(True, which="major", color="0.9", linewidth=0.6)
        ax.set_title(f"{name}, {words}", fontsize=10)
        for title, (colour, marker) in STYLES.items():
            some = [
                (r["ns"], r["error"])
                for r in rows
                if column_name(r) == title
                and (r["mode"] == mode or not r["batched"])
                and r.get("error") is not None
            ]
            front = sorted(p for p in some if not any(o[0] < p[0] and o[1] <= p[1] for o in some))
            if front:
                x, y = zip(*front, strict=True)
                ax.plot(
                    x,
                    np.maximum(y, 1e-16),
                    color=colour,
                    marker=marker,
                    linewidth=1.0,
                    markersize=4,
                    label=title,
                )
    figure.axes[0].set_ylabel("worst error, relative")
    lines = labelled_lines(figure.axes)
    figure.legend(
        list(lines.values()), list(lines), loc="outside lower center", ncols=7, fontsize=8, frameon=False
    )
    return figure
