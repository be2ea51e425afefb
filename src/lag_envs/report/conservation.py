"""Conserved quantities: energy, the power balance, cos² + sin²; and how errors grow in time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lag_envs.report import reference
from lag_envs.report.cases import MAIN, VARIANTS
from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.integrators import METHODS, comparison
from lag_envs.report.points import LAG_ENVS, ROUNDING
from lag_envs.report.runner import JobResult, ReportJob, Row
from lag_envs.report.stepped import Stepped
from lag_envs.scenes import CylinderInCylinder, Incline, PivotedBar
from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import motion_constants_of
from lag_envs.stepping.compiling import compile_lines

COLOURS = {
    LAG_ENVS: "#000000",
    "RK4": "#0072b2",
    "implicit midpoint": "#009e73",
    "Verlet": "#56b4e9",
    "semi-implicit Euler": "#e69f00",
    "explicit Euler": "#d55e00",
}


class FreeMotion(NamedTuple):
    """A scene without drag and drive, and a start."""

    scene: Scene
    state: tuple[float, ...]
    #: Control step [s], a multiple of 2^-28, so that 1e7 steps are an exact number too.
    dt: float = round(0.02 * 2**28) / 2**28


_BAR = PivotedBar(track=None)
_SHELL = CylinderInCylinder(control="damping")
#: Speed at the bottom that reaches the top [rad/s].
_TOP = 2.0 * math.sqrt(motion_constants_of(_BAR)["alpha"])

FREE = {
    "bar, 0.1 rad": FreeMotion(_BAR, (0.1, 0.0)),
    "bar, 1.6 rad": FreeMotion(_BAR, (1.6, 0.0)),
    "bar, 2 rad": FreeMotion(_BAR, (2.0, 0.0)),
    "bar, 3.1 rad": FreeMotion(_BAR, (3.1, 0.0)),
    "bar, turning over": FreeMotion(_BAR, (0.0, 1.2 * _TOP)),
    "shell, 1 rad": FreeMotion(_SHELL, (1.0, 0.0)),
    "incline": FreeMotion(Incline(tilt=math.pi / 12), (0.0, 1.0)),
}
QUICK = ("bar, 2 rad", "bar, turning over")
#: Times [s] over which positions are compared; each is a whole number of steps.
STEPS, QUICK_STEPS = 10**7, 10**5


def jobs(quick: bool) -> list[ReportJob]:
    """Return the jobs: long free runs, and balances of driven, damped ones."""
    steps = QUICK_STEPS if quick else STEPS
    names = QUICK if quick else tuple(FREE)
    runs = [
        ReportJob(free, f"{name}, {method}", {"name": name, "method": method, "steps": steps})
        for name in names
        for method in (LAG_ENVS, *(m for m in METHODS if m in COLOURS))
    ]
    count = 50 if quick else 500
    return runs + [
        ReportJob(energy_imbalance, f"balance, {name}", {"variant": name, "steps": count})
        for name in ([MAIN] if quick else VARIANTS)
    ]


# --- what is measured ---


def marks(steps: int) -> NDArray[np.int64]:
    """Return the numbers of steps after which a run is recorded: eight per decade.

    Examples
    --------
    >>> marks(10).tolist()
    [1, 2, 3, 4, 6, 7, 10]
    """
    count = round(8 * math.log10(steps)) + 1
    return np.unique(np.round(np.geomspace(1, steps, count)).astype(np.int64))


def compile_march(scene: Stepped) -> Callable:
    """Compile ``march(out, marks, dt, x, constants...)`` for a scene without control.

    Row j of `out` is the lifted state after ``marks[j]`` steps, and row -1 the start. The function returns
    the number of filled rows.
    """
    code = scene.code()
    width = len(code.start)
    lines = [
        f"{', '.join(code.start)}, = {', '.join(f'out[-1, {i}]' for i in range(width))},",
        "u0 = 0.0",
        "done = 0",
        "for j in range(marks.shape[0]):",
        "    for i in range(marks[j] - done):",
        f"        {', '.join(code.start)}, status = advance({code.arguments})",
        "        if status < 0:",
        "            return j",
        "    done = marks[j]",
        *(f"    out[j, {i}] = {name}" for i, name in enumerate(code.start)),
        "return marks.shape[0]",
    ]
    arguments = ", ".join(["out, marks, dt, x", *code.constants])
    return compile_lines("march", arguments, lines, code.compile())


def lifted_run(problem: FreeMotion, method: str, at: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the lifted states after these numbers of steps; fewer rows if a step was refused."""
    stepped = Stepped(problem.scene, dt=problem.dt)
    largest = stepped.largest_majorant(problem.dt)
    if method != LAG_ENVS:
        stepped = Stepped(problem.scene, comparison(method, stepped.flow))
    out = np.empty((len(at) + 1, stepped.form.width))
    out[-1] = stepped.form.lift(np.array(problem.state))
    filled = compile_march(stepped)(out, at, problem.dt, largest, *stepped.present())
    return out[:filled]


def free(name: str, method: str, steps: int) -> Iterator[Row]:
    """Yield the drifts of a run without drag and drive; for lag_envs also error and amplified rounding."""
    problem = FREE[name]
    scene, angle = problem.scene, Stepped(problem.scene).form.angle
    at = marks(steps)
    states = lifted_run(problem, method, at)
    at = at[: len(states)]
    row: Row = {"kind": "drift", "name": name, "method": method, "steps": at.tolist(), "dt": problem.dt}
    start = scene.energy(problem.state, 0.0)
    where = states[:, : len(scene.state_names)].copy()
    if angle is not None:
        c, s = states[:, -2], states[:, -1]
        row["length"] = finite(c * c + s * s - 1.0)
        # A large angle itself has large roundings; the cosine and sine are stepped.
        where[:, angle] = np.arctan2(s, c)
        turns = states[:, angle] - where[:, angle]
        row["pair"] = finite(turns - 2.0 * math.pi * np.round(turns / (2.0 * math.pi)))
    energy = scene.energy(where, np.zeros(len(where)))
    size = np.maximum(abs(start["kinetic"]) + abs(start["potential"]), np.abs(energy["kinetic"]))
    row["energy"] = finite((energy["total"] - start["total"]) / size)
    yield row
    if method == LAG_ENVS:
        yield growth(name, at.tolist(), states)


def finite(values: NDArray[np.float64]) -> list[float | None]:
    """Return numbers that JSON can represent."""
    return [float(v) if math.isfinite(v) else None for v in values]


def growth(name: str, at: Sequence[int], states: NDArray[np.float64]) -> Row:
    """Return the error of the first coordinate, and how far the scene amplifies one rounding of the start."""
    from mpmath import mp, mpf

    scene, start, dt = FREE[name]
    errors, amplified = [], []
    for n, state in zip(at, states, strict=True):
        exact = reference.remembered(scene, start, 0.0, float(n) * dt)
        errors.append(abs(reference.state_differences(state[:1], exact[:1])[0]))
        with mp.workdps(60):
            total = mpf(0)
            for j, value in enumerate(start):
                moved = [mpf(x) for x in start]
                moved[j] += ROUNDING * mpf(max(abs(value), 1.0))
                total += abs(reference.exact_flow(scene, moved, 0.0, float(n) * dt)[0] - exact[0])
        amplified.append(float(total))
    return {
        "kind": "growth", "name": name, "seconds": [float(n) * dt for n in at],
        "error": errors, "amplified": amplified,
    }  # fmt: skip


def energy_imbalance(variant: str, steps: int) -> Iterator[Row]:
    """Yield the imbalance of energy, work and loss over a run with random controls."""
    about = VARIANTS[variant]
    scene = about.scene()
    rng = np.random.default_rng(1)
    state = np.array([0.5 * s for s in about.state_range])
    total, absolute, largest, size, turnover = 0.0, 0.0, 0.0, 0.0, 0.0
    for control in rng.uniform(*about.controls, steps):
        found = scene.energy_balance(state, float(control), about.dt)
        energy = scene.energy(state, float(control))
        size = max(size, abs(energy["kinetic"]) + abs(energy["potential"]))
        total += found["residual"]
        absolute += abs(found["residual"])
        largest = max(largest, abs(found["residual"]))
        turnover += abs(found["work"]) + found["loss"]
        state = scene.simulate(state, [control], about.dt)[1]
    yield {
        "kind": "balance", "name": variant, "steps": steps, "sum": total, "largest": largest,
        "mean": absolute / steps, "turnover": turnover, "energy": float(size),
    }  # fmt: skip


# --- what is shown ---


def exponent(steps: Sequence[float], values: Sequence[float | None]) -> float | None:
    """Return the exponent with which the largest value so far grows over the last two decades.

    Examples
    --------
    >>> round(exponent([1, 10, 100, 1000], [1.0, 10.0, 100.0, 1000.0]), 2)
    1.0
    """
    sizes = np.maximum.accumulate([abs(v) if v is not None else 0.0 for v in values])
    keep = [(n, v) for n, v in zip(steps, sizes, strict=True) if n >= 0.01 * steps[-1] and v > 0.0]
    if len(keep) < 3:
        return None
    n, v = np.log(np.array(keep)).T
    return float(np.polyfit(n, v, 1)[0])


def worst(values: Sequence[float | None]) -> float | None:
    """Return the largest size, or None if a value is not finite."""
    return None if None in values or not values else max(abs(v) for v in values if v is not None)


TEXT = (
    "Runs without drag and drive, of {steps:,} control steps of 0.02 s. Energy is computed from the cosine "
    "and sine that are stepped. Its drift is relative to kinetic plus potential energy at the start, or to "
    "the kinetic energy if that has become larger. The comparison integrators take one step per control "
    "step.",
    "The growth of our error is checked against the closed form, Jacobi's elliptic functions or a "
    "parabola, in 30 digits. The rounding floor is a one-ulp perturbation, propagated exactly: the start "
    "is moved by 2^-53 of its size, at least 1 rad or rad/s, in both entries. A step rounds its result at "
    "least once, and n random roundings add up to about √n times a single rounding, so the error is "
    "compared with √n times the floor.",
    "Two effects can be larger than √n roundings. If energy drifts steadily (growth 1), because the same "
    "roundings recur in every period, the error grows with the square of the time. On the incline place "
    "and speed grow without end, and equal increments round to the same side for long stretches.",
    "The angle θ is not wrapped. If a bar turns over many times, the angle is a large number with large "
    "roundings, but these do not affect the cosine and sine that are stepped.",
    "With drag and random controls the change of energy is compared with the work of the drive minus the "
    "loss to drag, both by Gauss quadrature with 16 nodes within each step.",
)
DRIFT = (
    "Largest relative drift of energy, of c² + s² from 1, and of θ from the angle of (c, s) [rad]. Growth:"
    " the exponent of the largest energy drift so far over the last two decades; 0.5 is a random walk, 1 is"
    " steady. Empty cell: not finite, refused, or not applicable."
)
GROWTH = (
    "Error of θ or x at the end of a run, one rounding as amplified by the scene, the largest ratio of the "
    "error to √n amplified roundings, and the exponents with which error and rounding grow."
)
BALANCE = (
    "Change of energy minus work plus loss [J]: the largest in a step, and the sum over the run; for "
    "comparison the largest energy and the total of work and loss."
)


def content(rows: list[Row], problems: list[JobResult]) -> Content:
    """Return the section's content."""
    drifts, grown, balances = (
        [row for row in rows if row["kind"] == kind] for kind in ("drift", "growth", "balance")
    )
    steps = max((row["steps"][-1] for row in drifts if row["steps"]), default=0)
    return Content(
        title="What is conserved",
        text=[*([TEXT[0].format(steps=steps)] if steps else []), *TEXT[1:]],
        tables=_tables(drifts, grown, balances),
        pictures=list(_pictures(drifts, grown)),
        claims=_claims([row for row in drifts if row["method"] == LAG_ENVS], grown, balances, steps),
        summary=_summary(drifts, steps),
        details=[_all(drifts)],
    )


def _tables(drifts: list[Row], grown: list[Row], balances: list[Row]) -> list[Table]:
    return [
        Table.of(
            "conservation-drift",
            DRIFT,
            {
                "start": "name",
                "method": "method",
                "steps": lambda row: row["steps"][-1] if row["steps"] else 0,
                "energy": lambda row: worst(row["energy"]),
                "growth": lambda row: exponent(row["steps"], row["energy"]) if row["steps"] else None,
                "c² + s² - 1": lambda row: worst(row.get("length", [])),
                "θ - angle of (c, s)": lambda row: worst(row.get("pair", [])),
            },
            drifts,
        ),
        Table.of(
            "conservation-growth",
            GROWTH,
            {
                "start": "name",
                "time [s]": lambda row: row["seconds"][-1],
                "error": lambda row: row["error"][-1],
                "amplified rounding": lambda row: row["amplified"][-1],
                "largest ratio": lambda row: max(_ratios(row)),
                "growth of error": lambda row: exponent(row["seconds"], row["error"]),
                "growth of rounding": lambda row: exponent(row["seconds"], row["amplified"]),
            },
            grown,
        ),
        Table.of(
            "conservation-balance",
            BALANCE,
            {
                "scene": "name",
                "steps": "steps",
                "largest of a step [J]": "largest",
                "sum [J]": "sum",
                "energy [J]": "energy",
                "work and loss [J]": "turnover",
            },
            balances,
        ),
    ]


def _all(drifts: list[Row]) -> Table:
    rows = [
        (row["name"], row["method"], n, energy, length)
        for row in drifts
        for n, energy, length in zip(
            row["steps"], row["energy"], row.get("length", [None] * len(row["steps"])), strict=True
        )
    ]
    return Table(
        "conservation-runs", "All drifts", ("start", "method", "steps", "energy", "c² + s² - 1"), rows
    )


def _ratios(row: Row) -> list[float]:
    """Return the errors in units of √n amplified roundings, n being the number of steps so far."""
    steps = np.array(row["seconds"]) / row["seconds"][0]
    return (np.array(row["error"]) / (np.sqrt(steps) * np.array(row["amplified"]))).tolist()


def _claims(own: list[Row], grown: list[Row], balances: list[Row], steps: int) -> list[Claim]:
    def claim(text: str, found: list[tuple[float | None, str]], limit: float) -> Claim:
        if not found:
            return Claim(text, None, "")
        value, name = max(found, key=lambda pair: math.inf if pair[0] is None else pair[0])
        holds = value is not None and value < limit
        return Claim(
            text, holds, f"at most {value:.1e}, {name}" if value is not None else f"not finite, {name}"
        )

    claims = [
        claim(
            f"On bar and shell energy drifts by less than {1e-17 * steps:.0e} of its size in {steps:,} steps,"
            " less than a tenth of a rounding per step.",
            [(worst(row["energy"]), row["name"]) for row in own if "length" in row],
            1e-17 * steps,
        ),
        claim(
            f"On the incline it drifts by less than {1e-16 * steps:.0e}, a rounding per step.",
            [(worst(row["energy"]), row["name"]) for row in own if "length" not in row],
            1e-16 * steps,
        ),
        claim(
            "c² + s² stays within 1e-15 of 1.",
            [(worst(row["length"]), row["name"]) for row in own if "length" in row],
            1e-15,
        ),
        claim(
            "On bar and shell the error stays below 100 √n times one rounding as the scene amplifies it.",
            [(max(_ratios(row)), row["name"]) for row in grown if row["name"] != "incline"],
            100.0,
        ),
        claim(
            "With drag and drive, energy, work and loss balance in every step to 1e-13 of their size.",
            [
                (row["largest"] / max(row["energy"], row["turnover"] / row["steps"]), row["name"])
                for row in balances
            ],
            1e-13,
        ),
    ]
    return claims if steps else claims[2:]  # the first two are of the drift over these steps


def _summary(drifts: list[Row], steps: int) -> Table | None:
    names = [name for name in FREE if any(row["name"] == name for row in drifts)]
    methods = [m for m in COLOURS if any(row["method"] == m for row in drifts)]
    found = {(row["name"], row["method"]): worst(row["energy"]) for row in drifts}
    if not found:
        return None
    rows = [
        (name, *("diverged" if found.get((name, m)) is None else found[name, m] for m in methods))
        for name in names
    ]
    caption = f"Largest drift of energy in {steps:,} steps of 0.02 s without drag and drive, relative:"
    return Table("conservation", caption, ("start", *methods), rows)


def _pictures(drifts: list[Row], grown: list[Row]) -> Iterator[ReportFigure]:
    if drifts:
        yield ReportFigure(
            "conservation-energy",
            "Relative drift of energy over the number of control steps, the largest so far, without drag"
            " and drive.",
            lambda: _curves(drifts),
        )
    if any("length" in row for row in drifts):
        yield ReportFigure(
            "conservation-length",
            "c² + s² - 1 of the cosine and sine that lag_envs carries along, at the marks of each run.",
            lambda: _lengths([row for row in drifts if row["method"] == LAG_ENVS and "length" in row]),
        )
    if grown:
        yield ReportFigure(
            "conservation-growth",
            "Error of θ (incline: x) of our runs against the closed form in 30 digits. Dotted: one "
            "rounding of the start, propagated by that closed form.",
            lambda: _growths(grown),
        )


def _panels(
    rows: Sequence[Row], draw: Callable[[Axes, Row], object], x: str, y: str, legend_columns: int
) -> Figure:
    """Draw each row in the panel of its start; the first panel has all labels of the legend."""
    names = sorted({row["name"] for row in rows}, key=list(FREE).index)
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.6 * lines + 0.4), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True).ravel()
    for axis in grid[len(names) :]:
        axis.remove()
    axes = dict(zip(names, grid, strict=False))
    for row in rows:
        draw(axes[row["name"]], row)
        axes[row["name"]].set_title(row["name"], fontsize=9)
        axes[row["name"]].grid(alpha=0.3)
    figure.supxlabel(x, fontsize=9)
    figure.supylabel(y, fontsize=9)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=legend_columns, fontsize=8)
    return figure


def _curves(rows: list[Row]) -> Figure:
    def draw(axis: Axes, row: Row) -> None:
        values = np.array([np.nan if v is None else abs(v) for v in row["energy"]])
        values = np.fmax.accumulate(np.maximum(values, 1e-17)) if len(values) else values
        own = row["method"] == LAG_ENVS
        axis.loglog(
            row["steps"], values, color=COLOURS[row["method"]], lw=2.2 if own else 1.1, label=row["method"],
            zorder=3 if own else 2,
        )  # fmt: skip
        axis.set_ylim(1e-17, 1e3)

    ordered = sorted(rows, key=lambda row: row["method"] == LAG_ENVS)
    return _panels(ordered, draw, "control steps", "relative drift of energy", 3)


def _lengths(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(6.4, 2.8), layout="constrained")
    axis = figure.subplots()
    for row, marker in zip(rows, "osD^vP", strict=False):
        axis.semilogx(row["steps"], row["length"], marker, ms=4, label=row["name"])
    axis.set(xlabel="control steps", ylabel="c² + s² - 1", ylim=(-1e-15, 1e-15))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncols=2)
    return figure


def _growths(rows: list[Row]) -> Figure:
    def draw(axis: Axes, row: Row) -> None:
        axis.loglog(
            row["seconds"], np.maximum(row["error"], 1e-18), color="black", lw=1.8, label="error of lag_envs"
        )
        axis.loglog(
            row["seconds"], row["amplified"], ":", color="#d55e00", lw=1.8, label="amplified rounding"
        )

    return _panels(rows, draw, "time [s]", "error [rad or m]", 2)
