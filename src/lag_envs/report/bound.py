"""The bound on a step's truncation error, known before the step, against the actual truncation error.

Only truncation is compared, without rounding: the actual error is the sum of the exact motion's coefficients
beyond the series' order, from the oracle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import numpy as np
from matplotlib.figure import Figure
from mpmath import mp, mpf

from lag_envs.report import reference
from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.oracle import oracle_of
from lag_envs.report.runner import JobResult, ReportJob, Row
from lag_envs.scenes.base import Scene, parameter
from lag_envs.stepping import pendulum
from lag_envs.stepping.pendulum import Coefficients

ORDERS = (8, 12, 14, 16, 20)
DIGITS = 100
MORE = 80  # number of coefficients beyond the order that are summed as the truncation error
MOST_SUBSTEPS = 100  # of the steps whose cost is measured, which run as plain Python
TOLERANCE = pendulum.TOLERANCE


def jobs(quick: bool) -> list[ReportJob]:
    """Return the section's jobs."""
    from lag_envs.tasks import TASKS

    parts, size = (2, 6) if quick else (6, 30)
    drives = [ReportJob(bound_points, f"random drives {i + 1}", {"n": size, "seed": i}) for i in range(parts)]
    costs = [
        ReportJob(substeps_needed, f"substeps {i + 1}", {"n": 12 if quick else 50, "seed": i})
        for i in range(1 if quick else 6)
    ]
    names = [name for name, task in TASKS.items() if task().certified_speed() is not None]
    ranges = [
        ReportJob(environment, name, {"id": name, "n": 6 if quick else 40})
        for name in (names[:1] if quick else names)
    ]
    return drives + costs + ranges


# --- measuring ---


class Driven(Scene):
    """The driven pendulum of `pendulum.Coefficients`, with its coefficients as parameters."""

    alpha: float = parameter(0.0, "rad/s²")
    beta: float = parameter(0.0, "rad/s²")
    gamma: float = parameter(0.0, "1/s", least=0.0)
    delta: float = parameter(0.0, "rad/s²")

    coordinates: ClassVar = {"theta": "rad"}
    prescribed: ClassVar = {"turn": "rad"}  # its rate is the growing part of the drive
    controls: ClassVar = {"turn_ddot": "rad/s²"}

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T."""
        return 0.5 * v.theta**2

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V."""
        return self.beta * xp.sin(q.theta) - self.alpha * xp.cos(q.theta)

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return Rayleigh's function."""
        return 0.5 * self.gamma * v.theta**2

    def applied(self, q: Any, v: Any, u: Any, xp: Any) -> dict[str, Any]:
        """Return the drive."""
        return {"theta": self.delta + v.turn}


def driven(coeffs: Coefficients) -> tuple[Scene, list[float]]:
    """Return a scene with these coefficients, and its control."""
    alpha, beta, gamma, delta, ramp = map(float, coeffs)
    return Driven(alpha=alpha, beta=beta, gamma=gamma, delta=delta), [ramp]


def truncation(
    theta: float, omega: float, coeffs: Coefficients, h: float, order: int, digits: int = DIGITS
) -> tuple[float, float]:
    """Return the truncation errors of a step of the series in θ [rad], θ' [rad/s]; infinite if it diverges.

    The errors are the sums of the oracle's next `MORE` coefficients beyond the order.
    """
    scene, control = driven(coeffs)
    state = [0.0, 0.0, theta, omega]
    found = oracle_of(scene).coefficients(state, control, h, order + 2 + MORE, digits)
    with mp.workdps(digits):
        sums = []
        for kept, series in zip((order + 2, order + 1), found, strict=True):
            rest = series["theta"][kept:]
            left = abs(mp.fsum(rest))
            sums.append(float(left) if max(map(abs, rest[-4:])) <= mpf(10) ** -10 * left else math.inf)
        return sums[0], sums[1]


def random_problem(rng: np.random.Generator) -> tuple[float, float, Coefficients]:
    """Return θ, θ' and coefficients, from calm to violent; each term is present with probability 4/5."""
    exponents = rng.uniform([-1, -1, -2, -1, -1], [3, 3, 2, 3, 4])
    sizes = 10.0**exponents * rng.uniform(-1, 1, 5) * (rng.random(5) < 0.8)
    sizes[2] = abs(sizes[2])
    omega = rng.uniform(-1, 1) * 10.0 ** rng.uniform(-1, 1.5)
    return float(rng.uniform(-4, 4)), float(omega), Coefficients(*map(float, sizes))


def step_at(omega: float, coeffs: Coefficients, x: float) -> float:
    """Return the longest step [s] that is certified with this x."""
    low, high = -40.0, 5.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        good = pendulum.certified(omega, coeffs, math.exp(middle), x, np)
        low, high = (middle, high) if good else (low, middle)
    return math.exp(low)


def majorant(x: float, h: float, order: int) -> tuple[float, float]:
    """Return the bounds on one step's truncation errors in θ and θ'."""
    tail = pendulum.tail(x, order)
    return tail / (order + 2), tail / h


def bound_points(n: int, seed: int) -> Iterator[Row]:
    """Yield the bound and the truncation error of one step, at every order, for n random drives."""
    for i in range(n):
        rng = np.random.default_rng([seed, i])
        theta, omega, coeffs = random_problem(rng)
        x = float(0.02 * 25.0 ** rng.uniform())
        h = step_at(omega, coeffs, x)
        for order in ORDERS:
            bounds, actual = majorant(x, h, order), truncation(theta, omega, coeffs, h, order)
            row = {"kind": "point", "order": order, "x": x, "h": h, "theta_0": theta, "omega_0": omega}
            row |= {"drive": list(coeffs), "theta_bound": bounds[0], "theta": actual[0]}
            yield row | {"theta_dot_bound": bounds[1], "theta_dot": actual[1]}


def substeps_needed(n: int, seed: int) -> Iterator[Row]:
    """Yield, for steps of any length, the substeps that the bound requires and the fewest that suffice."""
    for i in range(n):
        rng = np.random.default_rng([9, seed, i])
        theta, omega, coeffs = random_problem(rng)
        h = step_at(omega, coeffs, float(0.1 * 40.0 ** rng.uniform()))
        while (chosen := pendulum.truncation_bound(omega, coeffs, h).substeps) > MOST_SUBSTEPS:
            h /= 2.0
        scene, control = driven(coeffs)
        exact = reference.exact_flow(scene, [0.0, 0.0, theta, omega], control, h)[2:]
        field = math.sqrt(math.hypot(coeffs.alpha, coeffs.beta))
        limits = (
            TOLERANCE * max(1.0, abs(theta), abs(omega) * h),
            TOLERANCE * max(1.0, abs(omega), field),
        )
        low, needed = 0, chosen if _enough(theta, omega, coeffs, h, chosen, exact, limits) else None
        while needed and needed - low > 1:
            middle = (low + needed) // 2
            if _enough(theta, omega, coeffs, h, middle, exact, limits):
                needed = middle
            else:
                low = middle
        yield {"kind": "cost", "h": h, "chosen": chosen, "needed": needed, "drive": list(coeffs)}


def _enough(
    theta: float,
    omega: float,
    coeffs: Coefficients,
    dt: float,
    n: int,
    exact: Sequence[mpf],
    limits: Sequence[float],
) -> bool:
    """Return whether n substeps, in float64, reach the required accuracy."""
    h = dt / n
    y: Any = theta, omega, math.cos(theta), math.sin(theta)
    for i in range(n):
        theta, omega, c, s = y
        y = pendulum.step(theta, omega, c, s, coeffs._replace(delta=coeffs.delta + coeffs.ramp * (i * h)), h)
    return all(abs(e) <= m for e, m in zip(reference.state_differences(y[:2], exact), limits, strict=True))


def environment(id: str, n: int) -> Iterator[Row]:
    """Yield the certified range of an environment, and n random steps within it."""
    from lag_envs.report.stepped import Stepped
    from lag_envs.tasks import TASKS

    task = TASKS[id]()
    scene, dt = task.scene, task.dt
    stepped = Stepped(scene, dt=dt)
    low, high = (float(u[0]) for u in task.control_range)
    reach = task.certified_speed()
    assert reach is not None and stepped.form.angle is not None
    angle, rng = stepped.form.angle, np.random.default_rng(1)

    def state(theta: float, speed: float) -> list[float]:
        """Return a state with its other entries at the edge of the range of the task's starts."""
        entries = [c + h for c, h in zip(task.centre, task.half_widths, strict=True)]
        entries[angle : angle + 2] = theta, speed
        return entries

    def left_out(theta: float, speed: float, u: float, digits: int = DIGITS) -> tuple[float, float]:
        coeffs = Coefficients(*map(float, stepped.at(state(theta, speed), u)[1]))
        return truncation(theta, speed, coeffs, dt, stepped.flow.order, digits)

    for _ in range(n):
        theta, speed, u = (float(v) for v in rng.uniform([-math.pi, -reach, low], [math.pi, reach, high]))
        known, actual = scene.step_bound(state(theta, speed), u, dt), left_out(theta, speed, u)
        row = {"kind": "environment", "id": id, "order": known.order, "dt": dt, "reach": reach}
        row |= {"theta_bound": known.bounds["theta"], "theta": actual[0]}
        row |= {"theta_dot_bound": known.bounds["theta_dot"]}
        yield row | {"theta_dot": actual[1], "speed": speed, "substeps": known.substeps}
    places = [float(v) for v in rng.uniform(-math.pi, math.pi, max(4, n // 5))]
    slow, fast = 0.0, 1e4  # the largest speed within the tolerance, by bisection
    for _ in range(10):
        speed = math.sqrt(max(slow, 1e-2) * fast)
        good = all(left_out(theta, speed, u, 30)[1] <= TOLERANCE for theta in places for u in (low, high))
        slow, fast = (speed, fast) if good else (slow, speed)
    about = {"kind": "reach", "id": id, "order": stepped.flow.order, "dt": dt}
    yield about | {"certified": reach, "actual": slow}


# --- showing ---

COLOURS = {8: "#cc79a7", 12: "#56b4e9", 14: "#e69f00", 16: "#0072b2", 20: "#009e73"}
QUANTITIES = (("theta", "θ", "rad"), ("theta_dot", "θ'", "rad/s"))


def content(rows: list[Row], problems: list[JobResult]) -> Content:
    """Return the section's content."""
    kinds = {
        kind: [r for r in rows if r["kind"] == kind] for kind in ("point", "environment", "cost", "reach")
    }
    measured = kinds["point"] + kinds["environment"]
    broken = [r for r in measured for name, _, _ in QUANTITIES if r[name] > r[f"{name}_bound"]]
    closest = min((m for name, _, _ in QUANTITIES for m in _margins(measured, name)), default=None)
    tight = _tightness_table(kinds["point"])
    scenes = _reach_table(kinds["environment"], kinds["reach"])
    counted = [r for r in kinds["cost"] if r["needed"]]
    claims = [
        Claim(
            "The bound is never broken.",
            not broken if measured else None,
            f"{len(broken)} of {2 * len(measured)} comparisons broken"
            + (f"; the closest is a factor of {closest:.3g}" if closest else ""),
        ),
        Claim(
            "The substeps that the bound requires are enough for 1e-12.",
            len(counted) == len(kinds["cost"]) if kinds["cost"] else None,
            f"{len(counted)} of {len(kinds['cost'])} random steps",
        ),
    ]
    pictures = []
    if kinds["point"]:
        pictures.append(
            ReportFigure(
                "bound-scatter",
                "Proved bound against actual truncation error, for random drives and steps such that x, "
                "the size that the bound follows from, lies between 0.02 and 0.5. Every point must lie "
                f"left of the line. The truncation error is summed with {DIGITS} digits.",
                lambda: _draw_scatter(kinds["point"]),
            )
        )
    if counted:
        pictures.append(
            ReportFigure(
                "bound-cost",
                "What the bound costs: the substeps that it requires against the fewest that reach 1e-12, "
                "order 16, random drives and steps. Circles grow with the number of cases. On the line no "
                "substep is wasted.",
                lambda: _draw_cost(counted),
            )
        )
    return Content(
        "A bound known before the step",
        [
            "A bound on the truncation error of the Taylor series is known before the step is taken. Here "
            "it is compared with the true truncation error: the sum of the exact motion's Taylor "
            f"coefficients beyond the order, which the oracle computes with {DIGITS} digits. Rounding "
            "plays no part.",
            "The bound holds for every field, drag and drive of a given size, whatever the angle, so it is "
            "far above the truncation error of most steps. That costs little, because a series of order N "
            "compensates such a factor by a step that is shorter by the factor's (N + 1)th root.",
            _cost_text(kinds["cost"]),
        ],
        tables=[table for table in (tight, scenes, _problem_table(problems)) if table],
        pictures=pictures,
        claims=claims,
        summary=scenes,
        details=[_details(measured)] if measured else [],
    )


def _margins(rows: Sequence[Row], name: str) -> list[float]:
    """Return bound over truncation error of a quantity, where that error is not zero."""
    return [r[f"{name}_bound"] / r[name] for r in rows if r[name]]


def _quantiles(rows: Sequence[Row], name: str) -> list[float | None]:
    ratios = _margins(rows, name)
    if not ratios:
        return [None] * 4
    return [float(v) for v in np.quantile(ratios, [0.0, 0.1, 0.5, 0.9])]


def _tightness_table(rows: Sequence[Row]) -> Table | None:
    lines: list[list[Any]] = []
    for order in sorted({r["order"] for r in rows}):
        found = [r for r in rows if r["order"] == order]
        angle, speed = _quantiles(found, "theta"), _quantiles(found, "theta_dot")
        per_power = speed[2] and speed[2] ** (1.0 / (order + 1))
        lines.append([f"order {order}", len(found), *angle, *speed, per_power])
    parts = [f"{sign}: {q}" for _, sign, _ in QUANTITIES for q in ("least", "10 %", "50 %", "90 %")]
    caption = (
        "Ratio of bound to truncation error of one step, both in exact arithmetic, for random drives. The "
        "ratio is never below 1 if the bound is never broken; 50 % is the median. Per power: the (order + "
        "1)th root of the median for θ', the factor by which the bound overestimates the step's length."
    )
    columns = ["series", "steps", *parts, "per power"]
    return Table("bound-tightness", caption, columns, lines) if lines else None


def _reach_table(steps: Sequence[Row], reaches: Sequence[Row]) -> Table | None:
    if not steps and not reaches:
        return None
    known = {r["id"]: r for r in reaches}
    lines = []
    for id in dict.fromkeys(r["id"] for r in [*steps, *reaches]):
        found = [r for r in steps if r["id"] == id]
        about = known.get(id) or found[0] | {"certified": found[0]["reach"], "actual": None}
        least, _, median, _ = _quantiles(found, "theta_dot")
        worst = max((r["theta_dot"] for r in found), default=None)
        certified = math.floor(10.0 * about["certified"]) / 10.0  # as in README and the pages
        lines.append([id, about["dt"], about["order"], certified, about["actual"], worst, least, median])
    return Table(
        "bound-environments",
        "Each environment with a pendulum: the speed up to which one series per step is certified to have "
        "a truncation error of at most 1e-12 rad/s under its largest controls, and the speed up to which "
        "the error really is that small at all angles tried; the largest truncation error found within the "
        "certified speeds, and the ratio of bound to truncation error (smallest, median).",
        [
            "id",
            "dt [s]",
            "order",
            "certified to [rad/s]",
            "really to [rad/s]",
            "largest truncation [rad/s]",
            "bound/truncation, least",
            "median",
        ],
        lines,
    )


def _cost_text(rows: Sequence[Row]) -> str:
    counted = [r for r in rows if r["needed"]]
    if not counted:
        return "The cost of the bound was not measured."
    ratios = [r["chosen"] / r["needed"] for r in counted]
    text = (
        f"Over {len(counted)} random steps of 1 to {max(r['chosen'] for r in counted)} substeps the bound "
        f"requires {float(np.median(ratios)):.2g} times the fewest that reach 1e-12 (median; at most "
        f"{max(ratios):.2g} times)."
    )
    missed = len(rows) - len(counted)
    return text + (f" In {missed} cases the number asked for was not enough." if missed else "")


def _problem_table(problems: Sequence[JobResult]) -> Table | None:
    lines = [[p.name, p.problem] for p in problems]
    return Table("bound-problems", "Problems: not measured.", ["job", "problem"], lines) if lines else None


def _details(rows: Sequence[Row]) -> Table:
    columns = ["id", "order", "x", "h", "theta_0", "omega_0", "drive", "theta_bound", "theta"]
    columns += ["theta_dot_bound", "theta_dot"]
    lines = [[_cell(r.get(c)) for c in columns] for r in rows]
    return Table("bound-steps", "Every step whose bound was compared.", columns, lines)


def _cell(value: Any) -> Any:
    return " ".join(map(repr, value)) if isinstance(value, list) else value


def _draw_scatter(rows: Sequence[Row]) -> Figure:
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    for axes, (name, sign, unit) in zip(figure.subplots(1, 2), QUANTITIES, strict=True):
        found = [(r[name], r[f"{name}_bound"], r["order"]) for r in rows if r[name]]
        ends = [min(min(a, b) for a, b, _ in found) / 10, max(b for _, b, _ in found) * 10]
        axes.plot(ends, ends, color="black", linewidth=1.5, label="bound = truncation")
        for order in sorted({o for _, _, o in found}):
            mine = [(a, b) for a, b, o in found if o == order]
            x, y = zip(*mine, strict=True)
            axes.scatter(x, y, s=12, color=COLOURS.get(order, "grey"), label=f"order {order}")
        axes.set(xscale="log", yscale="log", xlim=ends, ylim=(min(b for _, b, _ in found) / 1e6, ends[1]))
        axes.set(xlabel=f"truncation of {sign} [{unit}]", ylabel=f"bound [{unit}]")
        axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")
    return figure


def _draw_cost(rows: Sequence[Row]) -> Figure:
    figure = Figure(figsize=(6, 4.6), layout="constrained")
    axes = figure.subplots()
    places, counts = np.unique([(r["needed"], r["chosen"]) for r in rows], axis=0, return_counts=True)
    end = max(r["chosen"] for r in rows) * 1.3
    axes.plot([0.8, end], [0.8, end], color="black", linewidth=1.5)
    axes.scatter(places[:, 0], places[:, 1], s=25.0 * np.sqrt(counts), color=COLOURS[16], alpha=0.7)
    axes.set(xscale="log", yscale="log", xlim=(0.8, end), ylim=(0.8, end))
    axes.set(xlabel="fewest substeps that reach 1e-12", ylabel="substeps that the bound requires")
    axes.grid(alpha=0.3)
    return figure
