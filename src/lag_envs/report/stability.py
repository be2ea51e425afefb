"""Where a step is accurate, where it is not, and where it is refused: maps and a table of named cases."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lag_envs.report import extremes, reference
from lag_envs.report.cases import VARIANTS, Case, scales
from lag_envs.report.content import Claim, Content, Picture, Table
from lag_envs.report.extremes import EXACT
from lag_envs.report.runner import Job, Result, Row, describe
from lag_envs.report.stepped import Stepped
from lag_envs.report.steppers import comparison
from lag_envs.scenes.base import Scene
from lag_envs.scenes.checks import StepRefused
from lag_envs.stepping import pendulum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECTION = "stability"
PEERS = ("ETD4RK", "implicit midpoint", "RK4", "Verlet", "explicit Euler")
OURS = "ours"
PRECISIONS: dict[str, type[np.floating]] = {"float64": np.float64, "float32": np.float32}

#: What a cell can hold in place of an error.
REFUSED, DIVERGED, NO_REFERENCE, TOO_LONG = "refused", "diverged", "no reference", "not run"
#: An error of so many times the state's own size counts as divergence, as a result that is not finite does.
FAR_OFF = 100.0
#: The formulas alone, without the jump along the slow manifold, are run for so many substeps at most.
MOST_SUBSTEPS = 1000

#: Start (entries that float32 holds exactly) and control of the maps.
STARTS: dict[str, tuple[tuple[float, ...], float]] = {
    "PivotedBar": ((2.0, 3.0), 3.0),
    "Incline, drag": ((0.5, 2.0), 0.0),
    "Incline, moving": ((0.25, 1.0, 0.125), 0.25),
    "CylinderInCylinder, drag": ((1.0, 3.0), 0.0),
    "CylinderInCylinder, tilt": ((1.0, 3.0, 1.0), 3.0),
}


class Map(NamedTuple):
    """A quantity that is varied beside the step."""

    label: str
    scenes: Sequence[str]
    exponents: tuple[int, int]  #: of 10, from and to
    case: Callable[[str, float, float], Case]  #: of scene, value and dt


def _damped(name: str, decay: float, dt: float) -> Case:
    variant = VARIANTS[name]
    per_drag = _drag(variant.scene(damping=1.0))
    return Case(variant.scene(damping=decay / dt / per_drag), *STARTS[name])


def _drag(scene: Scene) -> float:
    """Return the rate at which drag alone would slow the motion down, without control [1/s]."""
    stepped = Stepped(scene)
    found = stepped.drive(stepped.lift(np.zeros(len(scene.state_names))), 0.0, stepped.numbers(), np)
    return float(found.gamma if isinstance(found, pendulum.Drive) else found.drag)


def _undamped(name: str, *, speed: float | None = None, control: float | None = None, **changes: Any) -> Case:
    """Return a case whose reference is in closed form, however far it goes: shells have no drive."""
    state, u = STARTS[name]
    if speed is not None:
        state = (state[0], speed, *state[2:])
    if control is None:
        control = u if name == "PivotedBar" else 0.0
    return Case(VARIANTS[name].scene(damping=0.0, **changes), state, control)


_BAR, _SHELL = ["PivotedBar"], ["CylinderInCylinder, drag"]
_SHELL_RADIUS = 0.5

MAPS = {
    "damping": Map("γ dt", list(VARIANTS), (-3, 6), _damped),
    "speed": Map("θ' [rad/s]", _BAR + _SHELL, (-2, 7), lambda name, v, dt: _undamped(name, speed=v)),
    "drive": Map("drive [m/s²]", _BAR, (0, 6), lambda name, u, dt: _undamped(name, control=u)),
    "gravity": Map("gravity [m/s²]", _BAR, (-3, 3), lambda name, g, dt: _undamped(name, gravity=g)),
    "length": Map("length [m]", _BAR, (-8, 0), lambda name, length, dt: _undamped(name, com_distance=length)),
    "arm": Map(
        "1 - r/R",
        _SHELL,
        (-9, -1),
        lambda name, x, dt: _undamped(name, shell_radius=_SHELL_RADIUS, radius=_SHELL_RADIUS * (1.0 - x)),
    ),
}


def jobs(quick: bool) -> list[Job]:
    """Return the section's jobs: one for every row of a map, and the named cases."""
    found: list[Job] = []
    for title, map in MAPS.items():
        low, high = map.exponents
        values = _decades(low, high, 7 if quick else 2 * (high - low) + 1)
        for name in map.scenes:
            if quick and (title, name) != ("damping", "PivotedBar"):
                continue
            for dt in _decades(-6, 0, 5 if quick else 13):
                arguments = {"map": title, "name": name, "dt": dt, "values": values}
                found.append(Job(SECTION, f"{name}, {title}, step {dt:.2g} s", "stability:cells", arguments))
    cases = list(extremes.QUICK if quick else extremes.EXTREMES)
    parts = 2 if quick else 6
    return found + [
        Job(SECTION, f"extreme cases {i + 1}", "stability:cases", {"names": cases[i::parts]})
        for i in range(parts)
    ]


def _decades(low: int, high: int, n: int) -> list[float]:
    return [float(x) for x in np.logspace(low, high, n)]


# --- measuring ---


def cells(map: str, name: str, dt: float, values: Sequence[float]) -> Iterator[Row]:
    """Yield the errors of one step of dt for each value of what the map varies.

    Where the error of ours is above what is called exact, the row also has ``roundings``, its error over the
    effect of one rounding of the start, and ``substeps``.
    """
    found = [MAPS[map].case(name, x, dt) for x in values]
    ends = methods(found, dt)
    for i, (x, case) in enumerate(zip(values, found, strict=True)):
        row: Row = {"kind": "cell", "map": map, "name": name, "dt": dt, "x": x}
        row |= judge(case, dt, {key: end[i] for key, end in ends.items()})
        error = row["errors"][OURS]
        if error == DIVERGED or (isinstance(error, float) and error > EXACT):
            row["substeps"] = extremes.substeps(case, dt)
            try:
                row["roundings"] = _roundings(case, dt, ends[OURS][i])
            except ArithmeticError as problem:
                row["problem"] = describe(problem)
        yield row


def _roundings(case: Case, dt: float, end: Sequence[float]) -> float | None:
    """Return the largest error of an entry over what one rounding of the start makes of it."""
    exact = reference.remembered(case.scene, case.state, case.control, dt)
    errors, gains = reference.errors(end, exact), extremes.amplification(case, dt)
    shares = [abs(e) / (extremes.EPS * g) for e, g in zip(errors, gains, strict=True) if g]
    return max(shares, default=None)


def cases(names: Sequence[str]) -> Iterator[Row]:
    """Yield what comes of the named stiff and extreme cases, beside the comparison steppers."""
    for name in names:
        row: Row = {"kind": "case", "name": name, "peers": {}}
        try:
            row |= extremes.measure(name)
            if row["error"] is not None:
                dt = extremes.EXTREMES[name].dt
                case = extremes.build(extremes.EXTREMES[name])
                ends = methods([case], dt)
                row["peers"] = judge(case, dt, {key: end[0] for key, end in ends.items()})["errors"]
        except Exception as error:
            row |= {"problem": describe(error)}
        yield row


def judge(case: Case, dt: float, ends: dict[str, Any]) -> Row:
    """Return the largest error of each end relative to the scales; where there is none, why."""
    try:
        exact = reference.remembered(case.scene, case.state, case.control, dt)
    except ArithmeticError as error:  # such as oracle.Unresolved
        kept = {key: end if isinstance(end, str) else NO_REFERENCE for key, end in ends.items()}
        return {"errors": kept, "problem": describe(error)}
    sizes = scales(case, dt)

    def relative(end: Any) -> float | str:
        if isinstance(end, str):
            return end
        if not np.isfinite(end).all():
            return DIVERGED
        error = max(abs(e) / s for e, s in zip(reference.errors(end, exact), sizes, strict=True))
        return error if error < FAR_OFF else DIVERGED

    return {"errors": {key: relative(end) for key, end in ends.items()}}


def methods(found: Sequence[Case], dt: float) -> dict[str, list[Any]]:
    """Return where every method ends from each case, or in place of that why it does not.

    Keys are names; ", 16" is added for 16 steps in place of one, ", float32" for that arithmetic. "ours" is
    the product; "ours, float32" the formula of its series, with the substeps that the bound asks for.
    """
    ends: dict[str, list[Any]] = {OURS: [_ours(case, dt) for case in found]}
    flow = Stepped(found[0].scene, dt=dt).flow
    with np.errstate(all="ignore"):
        for precision, dtype in PRECISIONS.items():
            more = "" if precision == "float64" else f", {precision}"
            for name in PEERS:
                for n, times in ((1, ""), (16, ", 16")):
                    counts = np.full(len(found), n)
                    ends[f"{name}{times}{more}"] = march(
                        comparison(name, flow).fast, found, dt, counts, dtype
                    )
        counts = np.array([_count(case, dt) for case in found])
        short = np.minimum(counts, MOST_SUBSTEPS)
        rows = march(flow.fast, found, dt, np.where(counts > MOST_SUBSTEPS, 1, short), np.float32)
    ends[f"{OURS}, float32"] = [
        TOO_LONG if n > MOST_SUBSTEPS else row for n, row in zip(counts, rows, strict=True)
    ]
    return ends


def _ours(case: Case, dt: float) -> Any:
    try:
        return case.scene.simulate(case.state, [case.control], dt)[-1].tolist()
    except (StepRefused, ValueError):
        return REFUSED


def _count(case: Case, dt: float) -> float:
    """Return the number of plain substeps that are accurate: what the bound says, or what `within` says."""
    scene, state, control = case
    bound = scene.step_bound(state, control, dt)
    if bound.order:
        return float(bound.substeps)
    stepped = Stepped(scene, dt=dt)
    y, k = stepped.lift(np.array(state)), stepped.numbers()
    coefficients, variables = stepped.drive(y, control, k, np), stepped.unpack(y, control, k)
    n = 1.0
    while n <= MOST_SUBSTEPS and not stepped.flow.within(variables, coefficients, dt / n, 0.0, np):
        n *= 2.0
    return n


def march(
    fast: Callable, found: Sequence[Case], dt: float, counts: np.ndarray, dtype: type[np.floating]
) -> list[list[float]]:
    """Step cases of one scene by a formula of a step, as NumPy arrays of one precision.

    Parameters
    ----------
    fast : callable
        As in `Flow`.
    found : sequence of Case
        Of one class of scene, with one kind of control.
    dt : float
        Time [s].
    counts : ndarray of int, shape (len(found),)
        Each takes as many steps of a length dt / count.
    dtype : type
        Precision of everything: constants, state, arithmetic.
    """
    scene = Stepped(found[0].scene)
    constants = [case.scene._constants() for case in found]
    k = SimpleNamespace(**{key: np.array([c[key] for c in constants], dtype) for key in constants[0]})
    u = np.array([case.control for case in found], dtype)
    h = (dt / counts).astype(dtype)
    y: Sequence[Any] = [np.array(column, dtype) for column in zip(*(c.state for c in found), strict=True)]
    if scene.angle is not None:
        y = [*y, np.cos(y[scene.angle]), np.sin(y[scene.angle])]
    for i in range(int(counts.max())):
        moved = fast(scene.unpack(y, u, k), scene.drive(y, u, k, np), h, np)
        new = scene.pack(moved, y, u, h, k)
        y = [np.where(i < counts, a, b) for a, b in zip(new, y, strict=True)]
        if any(a.dtype != dtype for a in y):
            raise TypeError(f"{[str(a.dtype) for a in y]} is not {dtype.__name__}")
    return np.transpose(y[: len(scene.form.state_names)]).astype(float).tolist()


# --- showing ---

#: Colours of what is not an error; errors go from pale yellow to dark blue.
SPECIAL = {DIVERGED: "black", REFUSED: "#d55e00", TOO_LONG: "#d0d0d0", NO_REFERENCE: "#8c8c8c"}
LOWEST, HIGHEST = -17, 2


def content(rows: list[Row], problems: list[Result]) -> Content:
    """Return what the section shows."""
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
            "Each cell of a map is one control step from one start with the control held, once with our step "
            "and once with each comparison stepper, which takes the step at once (or in 16 parts, where that "
            "is said). The error is the largest of the state's entries, each relative to its scale: max(1, "
            "|q|, |q'| dt) for places and angles, max(1, |q'|, (α² + β²)^¼) for rates. Diverged means a "
            f"result that is not finite or an error above {FAR_OFF:g} times the scale. The reference has 30 "
            "digits; where it cannot vouch for itself, the cell says so.",
            "Maps in float32 run the same formulas on float32 numbers. Ours then takes the substeps that the "
            f"bound asks for, up to {MOST_SUBSTEPS:,}; the jump along the slow manifold, which spares most "
            "of them where damping is heavy, exists in float64 only.",
            "A named case is expected to have full accuracy, to be accurate up to amplified rounding, or to "
            f"be refused with an error. Full accuracy means an error of at most {EXACT:g} times the scale in "
            "every entry. Where the system itself makes so much of a rounding of its start that no method "
            f"can have that, {extremes.ROUNDINGS:g} times the effect of such a rounding is allowed on top. "
            "That effect is measured, by moving every entry of the start by 2^-53 of its size in the "
            "reference. A case is met if it does what was expected, or is more accurate.",
            "Where a step is divided, substeps are computed with twice the digits, so that nothing adds up "
            "over hundreds of thousands of them. A step that would need more than a million is refused.",
        ],
        tables=[t for t in (verdicts, shares, _amplified(cells), _problem_table(problems, rows)) if t],
        pictures=_pictures(maps, found),
        claims=_claims(cells, found),
        summary=_summary(maps),
        details=[_map_table(maps), _cell_table(cells)] if cells else [],
    )


def _claims(cells: Sequence[Row], found: Sequence[Row]) -> list[Claim]:
    ours = [row["errors"][OURS] for row in cells]
    numbers = [e for e in ours if isinstance(e, float)]
    good = sum(e <= EXACT for e in numbers)
    amplified = [row["roundings"] for row in cells if row.get("roundings")]
    allowed = sum(share <= extremes.ROUNDINGS for share in amplified)
    unknown, refused = ours.count(NO_REFERENCE), ours.count(REFUSED)
    missed = [row["name"] for row in found if not row.get("met", False)]
    return [
        Claim(
            f"In every cell of the maps our step is accurate to {EXACT:g} of the scale or to amplified "
            "rounding, or it is refused with an error.",
            good + allowed + refused + unknown == len(ours) if numbers else None,
            f"{len(ours)} cells: {good} accurate, {allowed} to amplified rounding (at most "
            f"{max(amplified, default=0.0):.1f} roundings), {refused} refused, {unknown} without a "
            f"reference, {len(ours) - good - allowed - refused - unknown} missed",
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
        verdict = "missed" if not row.get("met") else "met"
        if row.get("problem"):
            verdict = "unknown"
        keys = ("error", "amplification", "roundings", "substeps")
        cells = [row["name"], row.get("scene"), row.get("dt"), row.get("expected"), outcome]
        lines.append([*cells, *(row.get(key) for key in keys), verdict])
    return Table(
        "extreme-cases",
        "Every stiff and extreme case. Error: relative to the scale. Amplification: what one rounding of the "
        "start makes at the end, over 2^-53 times the scale. Roundings: the error over the effect of one "
        "rounding of the start, or of the end where that is more.",
        [
            "case",
            "scene",
            "dt [s]",
            "expected",
            "came out",
            "error",
            "amplification",
            "roundings",
            "substeps",
            "verdict",
        ],
        lines,
    )


def _counts(rows: Sequence[Row], method: str) -> list[Any]:
    """Return how many cells, the largest error, and how many cells are good, and in each special state."""
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
    """Return a table with a line for each map: how ours does, and in which share of cells each is exact."""
    lines: list[list[Any]] = []
    for (map, scene), rows in maps.items():
        _, largest, *_ = _counts(rows, OURS)
        _, single, *_ = _counts(rows, f"{OURS}, float32")
        shares = [f"{100 * _counts(rows, method)[2] / len(rows):.0f} %" for method in (OURS, *PEERS)]
        roundings = max((row["roundings"] for row in rows if row.get("roundings")), default=None)
        refused = _counts(rows, OURS)[3 + list(SPECIAL).index(REFUSED)]
        lines.append([scene, map, len(rows), *shares, largest, roundings, refused, single])
    caption += (
        f" Shares of cells in which one step is accurate to {EXACT:g} of the scale; then the largest error "
        "of ours, over the effect of a rounding of the start where it is above that, how often ours is "
        "refused, and the largest error of its formula in float32."
    )
    columns = ["scene", "map", "cells", OURS, *PEERS]
    columns += ["largest error of ours", "in roundings", "refused", "largest error, float32"]
    return Table(name, caption, columns, lines) if lines else None


def _summary(maps: dict[tuple[str, str], list[Row]]) -> Table | None:
    """Return the maps of damping in brief."""
    damped = {key: rows for key, rows in maps.items() if key[0] == "damping"}
    long = _shares(damped, "", "")
    if long is None:
        return None
    columns = ["scene", OURS, *PEERS, "largest error of ours"]
    places = [list(long.columns).index(name) for name in columns]
    caption = (
        "One step with γ dt from 1e-3 to 1e6 and dt from 1e-6 to 1 s: in which share of the cases each is "
        f"accurate to {EXACT:g} of the scale, and the largest error of ours."
    )
    return Table("stability", caption, columns, [[row[i] for i in places] for row in long.rows])


def _amplified(cells: Sequence[Row]) -> Table | None:
    lines = []
    for row in cells:
        if "substeps" in row:
            roundings = row.get("roundings")
            met = roundings is not None and roundings <= extremes.ROUNDINGS
            place = [row["name"], row["map"], row["x"], row["dt"], row["substeps"]]
            lines.append([*place, row["errors"][OURS], roundings, "met" if met else "missed"])
    columns = ["scene", "map", "value", "dt [s]", "substeps", "error", "roundings", "verdict"]
    caption = (
        f"Cells of the maps in which the error of ours is above {EXACT:g} of the scale: the error, and how "
        "many times the effect of one rounding of the start it is."
    )
    return Table("stability-amplified", caption, columns, lines) if lines else None


def _problem_table(problems: Sequence[Result], rows: Sequence[Row]) -> Table | None:
    lines = [[p.name, p.problem] for p in problems]
    lines += [
        [f"{row['name']}, {row['map']} {row['x']:.2g}, step {row['dt']:.2g} s", row["problem"]]
        for row in rows
        if row["kind"] == "cell" and row.get("problem")
    ]
    lines += [[row["name"], row["problem"]] for row in rows if row["kind"] == "case" and row.get("problem")]
    return (
        Table("stability-problems", "What could not be measured.", ["what", "why"], lines) if lines else None
    )


def _cell_table(cells: Sequence[Row]) -> Table:
    lines = [
        [row["name"], row["map"], row["x"], row["dt"], method, value]
        for row in cells
        for method, value in row["errors"].items()
    ]
    columns = ["scene", "map", "gamma dt or speed", "dt [s]", "method", "error"]
    return Table("stability-cells", "Every cell of every map.", columns, lines)


def _pictures(maps: dict[tuple[str, str], list[Row]], found: Sequence[Row]) -> list[Picture]:
    pictures = []
    for (map, name), rows in maps.items():
        for n, times in (("", "in one step"), (", 16", "in 16 steps")):
            if n and (map, name) != ("damping", "PivotedBar"):
                continue
            pictures.append(
                Picture(
                    f"stability-{map}-{_slug(name)}{n.replace(', ', '-')}",
                    f"{name}: error of one control step over {MAPS[map].label} and the step; comparison "
                    f"steppers {times}. Beside each map the same in float32. Start {STARTS[name][0]}. "
                    "Reference: 30 digits.",
                    partial(_draw_map, rows, MAPS[map].label, n),
                    raster=True,
                )
            )
    measured = [row for row in found if row.get("peers")]
    if measured:
        pictures.append(
            Picture(
                "extreme-cases-map",
                "The named cases: log10 of the error of one control step, ours beside the comparison "
                "steppers in one step and in 16. Cases that are to be refused are in the table only.",
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
    """Draw cells that hold errors or a special state; return what the colour bar needs."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

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
    from matplotlib.patches import Patch

    ticks = range(LOWEST + 1, HIGHEST + 1, 2)
    label = "log10 of the error relative to its scale"
    figure.colorbar(mesh, ax=panels, label=label, fraction=0.03, ticks=ticks)
    patches = [Patch(facecolor=c, edgecolor="black", label=name) for name, c in SPECIAL.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=8)


def _draw_map(rows: Sequence[Row], label: str, n: str) -> Figure:
    from matplotlib.figure import Figure

    xs, ys = (sorted({row[key] for row in rows}) for key in ("x", "dt"))
    known = {(row["x"], row["dt"]): row["errors"] for row in rows}
    figure = Figure(figsize=(9, 7), layout="constrained")
    panels = figure.subplots(3, 4, sharex=True, sharey=True)
    shown = [
        (name if name == OURS else name + n) + more for name in (OURS, *PEERS) for more in ("", ", float32")
    ]
    for axes, method in zip(panels.flat, shown, strict=True):
        values = [[known.get((x, y), {}).get(method, NO_REFERENCE) for x in xs] for y in ys]
        mesh = _paint(axes, _edges(xs), _edges(ys), values)
        axes.set(xscale="log", yscale="log")
        axes.set_title(method, fontsize=9, fontweight="bold" if method == OURS else "normal")
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
    from matplotlib.figure import Figure

    order = list(extremes.EXTREMES)
    rows = sorted(rows, key=lambda row: -order.index(row["name"]))
    methods = [OURS, f"{OURS}, float32", *(name + n for n in ("", ", 16") for name in PEERS)]
    values = [[row["peers"].get(method, NO_REFERENCE) for method in methods] for row in rows]
    figure = Figure(figsize=(9, 2.2 + 0.2 * len(rows)), layout="constrained")
    axes = figure.subplots()
    mesh = _paint(axes, np.arange(len(methods) + 1), np.arange(len(rows) + 1), values)
    axes.set_xticks(np.arange(len(methods)) + 0.5, methods, rotation=40, ha="right", fontsize=8)
    axes.set_yticks(np.arange(len(rows)) + 0.5, [row["name"] for row in rows], fontsize=8)
    axes.set(xlabel="method", ylabel="case")
    _finish(figure, mesh, [axes])
    return figure
