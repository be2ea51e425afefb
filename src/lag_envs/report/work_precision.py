"""Error against time: ours at every order and tolerance, the usual steppers, other libraries.

Errors of all compiled methods, and the time of one of their steps, are measured apart and joined afterwards:
a comparison stepper with n substeps takes n times as long as with one.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lag_envs.report import peers, reference
from lag_envs.report.cases import VARIANTS, Case, ensemble, scales
from lag_envs.report.content import Claim, Content, Picture, Table
from lag_envs.report.runner import Job, Result, Row, describe
from lag_envs.report.steppers import METHODS, comparison, plain_series
from lag_envs.report.timing import BLOCK, Array, Kernels, Sample, at_once, interleaved, one_by_one
from lag_envs.scenes.base import Scene
from lag_envs.stepping import pendulum
from lag_envs.stepping.flows import Flow, pendulum_flow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SECTION = "work_precision"
OURS = "lag_envs"
SERIES = "plain series"
CERTIFIED = "certified series"
ONE_CALL = "lag_envs, one call"
ROUNDING = 2.0**-53
#: An error below this many roundings, or amplified roundings, counts as no error at all.
ROUNDINGS = 4
ORDERS = tuple(range(4, 21, 2))
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)


class Horizon(NamedTuple):
    """How long the control is held, and what is measured over that time."""

    seconds: float | None  #: None: one control step
    members: int  #: problems
    substeps: Sequence[int]  #: of the comparison steppers
    ours: Sequence[int]  #: of plain series
    foreign: int  #: problems that other libraries are given

    def steps(self, dt: float) -> int:
        """Return the number of control steps."""
        return 1 if self.seconds is None else round(self.seconds / dt)


def control_step(variant: str) -> float:
    """Return the control step [s] with 36 bits behind the point: products with whole numbers are exact."""
    return round(VARIANTS[variant].dt * 2**36) / 2**36


HORIZONS = {
    "one step": Horizon(None, 48, (1, 2, 4, 8, 16, 32, 64, 128, 256), (1, 2, 4, 8), 8),
    "10 s": Horizon(10.0, 8, (1, 2, 4, 8, 16, 32, 64), (1, 2, 4, 8), 2),
    "1,000 s": Horizon(1000.0, 3, (1, 4, 16, 64), (1, 2, 4), 1),
}
QUICK = {
    "one step": Horizon(None, 8, (1, 4, 16, 64, 256), (1, 2), 2),
    "10 s": Horizon(10.0, 1, (1, 4, 16), (1, 2), 1),
}
QUICK_METHODS = ("Verlet", "RK4")
QUICK_VARIANTS = ("PivotedBar",)
#: Libraries that are slow to compile or to run are measured on one variant per kind of equation.
COVERED = {
    "diffrax": ("PivotedBar", "Incline, moving", "CylinderInCylinder, tilt"),
    "torchdiffeq": ("PivotedBar", "Incline, moving", "CylinderInCylinder, tilt"),
    "mujoco": ("PivotedBar",),
}
BATCH = 1024
#: Seconds that one point of a library may take; what would take longer is not run.
LIMIT = 1.0


def jobs(quick: bool) -> list[Job]:
    """Return the jobs: errors per variant and horizon, then times, then libraries."""
    names = QUICK_VARIANTS if quick else tuple(VARIANTS)
    horizons = QUICK if quick else HORIZONS
    # A quick report has all that needs no quiet in one job, which compiles once.
    together = [list(horizons)] if quick else [[horizon] for horizon in horizons]
    made = [
        Job(
            SECTION,
            f"errors: {name}, {', '.join(part)}",
            f"{SECTION}:errors",
            {"variant": name, "horizons": part, "quick": quick},
            timeout=300.0,
        )
        for part in together
        for name in names
    ]
    if not quick:
        made += [
            Job(SECTION, f"batches: {name}", f"{SECTION}:batches", {"variant": name, "quick": False}, 300.0)
            for name in names
        ]
        made.append(Job(SECTION, "orders", f"{SECTION}:orders", {"variant": "PivotedBar", "quick": False}))
    made += [
        Job(SECTION, f"times: {name}", f"{SECTION}:times", {"variant": name, "quick": quick}, alone=True)
        for name in names
    ]
    made += [
        Job(
            SECTION,
            f"{package}: {name}",
            f"{SECTION}:library",
            {"variant": name, "package": package, "quick": quick},
            timeout=120.0,
            alone=True,
        )
        for name in names
        for package in peers.PEERS
        if name in COVERED.get(package, names) and (not quick or package == "scipy")
    ]
    return made


# --- what is measured ---


class Contestant(NamedTuple):
    """A method that our machinery compiles."""

    family: str
    method: str
    flow: Flow
    order: int
    adaptive: bool  #: chooses its substeps itself


def contestants(scene: Scene, quick: bool = False) -> list[Contestant]:
    """Return ours first, then the comparison steppers."""
    found = [Contestant("ours", OURS, scene.flow, scene.flow.order, True)]
    if scene.flow.coefficients is pendulum.Drive:
        orders = (4, 8) if quick else ORDERS
        found += [Contestant("ours", f"{SERIES} {n}", plain_series(n), n, False) for n in orders]
        if not quick:
            found += [
                Contestant("ours", f"{CERTIFIED} {n}, {tol:g}", pendulum_flow(n, tol), n, True)
                for n, tol in zip((6, 8, 10, 12), TOLERANCES, strict=True)
            ]
    found += [
        Contestant("comparison", name, comparison(name, scene.flow), method.order, False)
        for name, method in METHODS.items()
        if not quick or name in QUICK_METHODS
    ]
    return found


def problems(variant: str, horizon: str, members: int) -> list[Case]:
    """Return the problems of a horizon; over 1,000 s without control, and a pendulum's without damping."""
    cases = ensemble(variant, members)
    if horizon != "1,000 s":
        return cases
    return [Case(_undamped(case.scene), case.state, 0.0) for case in cases]


def _undamped(scene: Scene) -> Scene:
    if scene.flow.coefficients is not pendulum.Drive:
        return scene
    return dataclasses.replace(scene, damping=0.0)  # type: ignore[call-arg]


class Truth(NamedTuple):
    """The exact end of a problem."""

    case: Case
    end: Sequence[Any]
    scale: Sequence[float]

    def error(self, state: Array) -> float:
        """Return the largest error of a state's entries, each relative to its scale; infinite for NaN."""
        if not np.isfinite(state).all():
            return math.inf
        return max(
            abs(e) / s for e, s in zip(reference.errors(state.tolist(), self.end), self.scale, strict=True)
        )


def truth(case: Case, dt: float, steps: int) -> Truth:
    """Return the exact end; errors of one step are relative to the start's size, later ones to the end's."""
    end = reference.remembered(case.scene, case.state, case.control, dt * steps)
    at = case if steps == 1 else case._replace(state=tuple(map(float, end)))
    return Truth(case, end, scales(at, dt))


def amplified(truths: Sequence[Truth], dt: float, steps: int) -> float:
    """Return what the system makes of one rounding of its start: the median, relative to the scales."""
    from mpmath import mp, mpf

    found = []
    for case, end, scale in truths:
        with mp.workdps(40):
            state = [mpf(x) * (1 + mpf(ROUNDING)) for x in case.state]
            moved = reference.flow(case.scene, state, case.control, dt * steps, digits=20)
            found.append(max(float(abs(a - b)) / s for a, b, s in zip(moved, end, scale, strict=True)))
    return median(found)


def summed_up(truths: Sequence[Truth], ends: Sequence[Array]) -> Row:
    """Return errors, the largest and median of those below 1, and how many members are lost."""
    found = [t.error(end) for t, end in zip(truths, ends, strict=True)]
    kept = [error for error in found if error < 1.0]
    return {
        "errors": [float(f"{error:.3g}") if error < 1.0 else None for error in found],
        "error": max(kept, default=None),
        "median": median(kept) if kept else None,
        "members": len(found),
        "diverged": len(found) - len(kept),
    }


def errors(variant: str, horizons: Sequence[str], quick: bool) -> Iterator[Row]:
    """Yield the errors of ours and of the comparison steppers on one variant."""
    for horizon in horizons:
        plan = (QUICK if quick else HORIZONS)[horizon]
        dt = control_step(variant)
        steps = plan.steps(dt)
        truths = [truth(case, dt, steps) for case in problems(variant, horizon, plan.members)]
        about = {"variant": variant, "horizon": horizon}
        yield about | {"kind": "rounding", "amplified": amplified(truths[:4], dt, steps)}
        for found in contestants(truths[0].case.scene, quick):
            for row in errors_of(found, truths, plan, dt, steps):
                yield about | row
    if quick:
        yield from batches(variant, quick)
        yield from orders(variant, quick)


def errors_of(
    found: Contestant, truths: Sequence[Truth], plan: Horizon, dt: float, steps: int
) -> Iterator[Row]:
    """Yield the errors of one method, by number of substeps."""
    kernels = Kernels(truths[0].case.scene, found.flow)
    counts = (1,) if found.adaptive else plan.ours if found.family == "ours" else plan.substeps
    calls = [(found.method, n, dt / n, n * steps) for n in counts]
    if found.method == OURS and plan.seconds == 1000.0:
        calls.append((ONE_CALL, 1, dt * steps, 1))
    for method, n, length, times in calls:
        row = {
            "kind": "error", "family": found.family, "method": method, "order": found.order, "substeps": n,
        }  # fmt: skip
        try:
            ends = [kernels.end(t.case, length, times) for t in truths]
            yield row | summed_up(truths, ends)
        except Exception as error:
            yield row | {"problem": describe(error)}


def orders(variant: str, quick: bool) -> Iterator[Row]:
    """Yield the orders of convergence of all methods that have one."""
    cases = ensemble(variant, 6 if quick else 24)
    truths = single_steps(variant, cases)
    for found in contestants(cases[0].scene, quick):
        if not found.adaptive:
            yield {
                "kind": "order", "variant": variant, "method": found.method, "order": found.order,
                "slope": measured_order(found, truths),
            }  # fmt: skip


def single_steps(variant: str, cases: Sequence[Case]) -> dict[float, list[Truth]]:
    """Return the exact ends of single steps of several lengths, each √2 times longer than the one before."""
    lengths = [round(VARIANTS[variant].dt * 2 ** (k / 2) * 2**36) / 2**36 for k in range(-4, 9)]
    return {h: [truth(case, h, 1) for case in cases] for h in lengths}


def measured_order(found: Contestant, truths: Mapping[float, Sequence[Truth]]) -> float | None:
    """Return how the error of one step grows with its length, less one; None where there is none."""
    kernels = Kernels(next(iter(truths.values()))[0].case.scene, found.flow)
    return slope({h: [t.error(kernels.end(t.case, h, 1)) for t in ends] for h, ends in truths.items()})


def slope(found: Mapping[float, Sequence[float]]) -> float | None:
    """Return the order seen in the errors of steps of several lengths, as median over members.

    The shortest steps h and 2h are compared whose errors are well above rounding in half of the members.

    Examples
    --------
    >>> slope({h: [h**5, 3 * h**5] for h in (0.1, 0.2)})
    4.0
    """
    lengths = sorted(found)
    for h in lengths:
        twice = [k for k in lengths if abs(k / h - 2.0) < 1e-6]
        if not twice:
            break
        pairs = zip(found[h], found[twice[0]], strict=True)
        seen = [math.log2(b / a) for a, b in pairs if a > 1e-14 and b < 1e-2]
        if 2 * len(seen) > len(found[h]):
            return median(seen) - 1.0
    return None


def batches(variant: str, quick: bool) -> Iterator[Row]:
    """Yield whether each method's batch has the bits of its single trajectories."""
    scene = VARIANTS[variant].scene()
    for found in contestants(scene, quick):
        equal = same_bits(Kernels(scene, found.flow), variant)
        yield {"kind": "bits", "variant": variant, "method": found.method, "equal": equal}


def same_bits(kernels: Kernels, variant: str, count: int = 96, steps: int = 3) -> bool:
    """Tell whether a batch ends where its states do one by one, bit for bit."""
    cases = ensemble(variant, count, vary=False)
    dt, scene = control_step(variant), cases[0].scene
    rows = kernels.fill(cases)
    kernels.batch(rows, count, steps, *kernels.arguments(scene, dt))
    ends = np.array([kernels.end(case, dt, steps) for case in cases])
    return bool(np.array_equal(kernels.states(rows, count), ends))


def alternating(variant: str, lines: int, steps: int) -> Array:
    """Return random controls, each followed by its mirror image in the range, so that no drive builds up."""
    low, high = VARIANTS[variant].controls
    controls = np.random.default_rng(0).uniform(low, high, (lines, steps))
    controls[:, 1::2] = low + high - controls[:, ::2]
    return controls


def times(variant: str, quick: bool) -> Iterator[Row]:
    """Yield the time of a step of each compiled method, alone and in a batch; all of them in turn."""
    dt = control_step(variant)
    cases = ensemble(variant, BATCH, vary=False)
    scene = cases[0].scene
    single: dict[tuple, Sample] = {}
    batch: dict[tuple, Sample] = {}
    for found in contestants(scene, quick):
        kernels = Kernels(scene, found.flow)
        single[found.method, "one step"] = one_by_one(kernels, cases[:8], alternating(variant, 8, 512), dt)
        # Few steps where their cost depends on states, which a held control drives afar; else many.
        few = found.adaptive and scene.flow.coefficients is pendulum.Drive
        batch[found.method, "one step"] = at_once(kernels, cases, 4 if few else 32, dt)
        if found.adaptive:
            steps = HORIZONS["10 s"].steps(dt)
            held = np.repeat([[case.control] for case in cases[:8]], steps, axis=1)
            single[found.method, "10 s"] = one_by_one(kernels, cases[:8], held, dt)
            batch[found.method, "10 s"] = at_once(kernels, cases[:128], steps, dt)
            calm = [case._replace(control=0.0) for case in cases]
            single[found.method, "1,000 s"] = one_by_one(kernels, calm[:8], 0.0 * held, dt)
            batch[found.method, "1,000 s"] = at_once(kernels, calm[:128], steps, dt)
    check = Kernels(scene, comparison("RK4", scene.flow))
    controls = np.repeat(alternating(variant, 8, 512), 8, axis=1)
    single["RK4, 8 substeps", "one step"] = one_by_one(check, cases[:8], controls, dt / 8)
    batch["RK4, 8 substeps", "one step"] = at_once(check, cases, 256, dt / 8)
    rounds = 5 if quick else 15
    alone, together = interleaved(single, rounds), interleaved(batch, rounds)
    if not quick:
        key = (ONE_CALL, "1,000 s")
        one = one_call(variant)
        alone |= interleaved({key: one[0]}, 3)
        together |= interleaved({key: one[1]}, 3)
    for method, horizon in alone:
        key = (method, horizon)
        yield {
            "kind": "time", "variant": variant, "method": method, "horizon": horizon,
            "single": alone[key], "batch": together[key],
        }  # fmt: skip


def one_call(variant: str) -> tuple[Sample, Sample]:
    """Return samples of ours, alone and in a batch, that take 1,000 s as one control step; no control."""
    dt = control_step(variant)
    steps = HORIZONS["1,000 s"].steps(dt)
    cases = [Case(_undamped(c.scene), c.state, 0.0) for c in ensemble(variant, BLOCK, vary=False)]
    kernels = Kernels(cases[0].scene, cases[0].scene.flow)
    alone = one_by_one(kernels, cases[:2], np.zeros((2, 1)), dt * steps)
    together = at_once(kernels, cases, 1, dt * steps)
    return alone._replace(steps=2 * steps), together._replace(steps=BLOCK * steps)


def library(variant: str, package: str, quick: bool) -> Iterator[Row]:
    """Yield errors and times of one library on one variant."""
    horizons = QUICK if quick else HORIZONS
    dt = control_step(variant)
    for horizon, plan in horizons.items():
        steps = plan.steps(dt)
        truths = [truth(case, dt, steps) for case in problems(variant, horizon, plan.foreign)]
        known = peers.PEERS[package].settings
        for setting in known if horizon == "one step" and not quick else known[::2]:
            about = {
                "kind": "library", "variant": variant, "horizon": horizon, "family": package,
                "method": setting[0], "setting": setting[1],
            }  # fmt: skip
            try:
                yield about | library_point(package, setting, variant, horizon, truths, dt, steps)
            except TimeoutError as error:
                yield about | {"problem": str(error)}
            except Exception as error:
                yield about | {"problem": describe(error)}
                if isinstance(error, ImportError):
                    return


def library_point(
    package: str, setting: tuple, variant: str, horizon: str, truths: Sequence[Truth], dt: float, steps: int
) -> Row:
    """Return errors and times of one setting of a library; over 1,000 s it makes one call."""
    make = peers.PEERS[package]
    # One long call lets an adaptive method take the steps that it likes; a fixed one goes on as it does.
    span, calls = (dt * steps, 1) if horizon == "1,000 s" and not make.fixed else (dt, steps)
    members = [make([t.case], setting) for t in truths]
    _guard(members[0], truths[0].case, span, calls, len(truths))
    ends, spent = [], 0.0
    for member, t in zip(members, truths, strict=True):
        member.seconds = 0.0
        ends.append(member.move(np.array([t.case.state]), span, calls)[0])
        spent += member.seconds
    row = summed_up(truths, ends) | {"single": 1e9 * spent / (len(truths) * steps), "batch": None}
    return row | {"batch": _together(make, setting, variant, horizon, dt) if make.batched else None}


def _guard(peer: peers.Peer, case: Case, span: float, calls: int, members: int) -> None:
    """Raise TimeoutError where a hundredth of the work tells that the whole would take too long."""
    state = np.array([case.state])
    peer.move(state, min(span, 0.01), 1)  # warms up
    begin = time.perf_counter()
    if calls > 1:
        peer.move(state, span, max(1, calls // 100))
        share = max(1, calls // 100) / calls
    elif span > 1.0:
        peer.move(state, span / 100.0, 1)
        share = 0.01
    else:
        return
    expected = (time.perf_counter() - begin) / share * members
    if expected > LIMIT * (1 if calls > 1 else 2):
        raise TimeoutError(f"not run, it would take {expected:.0f} s")


def _together(make: type[peers.Peer], setting: tuple, variant: str, horizon: str, dt: float) -> float | None:
    """Return the time per control step and state [ns] in a batch: one call for a step, or for 10 s."""
    count = 128 if horizon == "1,000 s" else BATCH
    cases = ensemble(variant, count, vary=False)
    steps = 1
    if horizon == "1,000 s":
        scene = _undamped(cases[0].scene)
        cases = [Case(scene, case.state, 0.0) for case in cases]
        steps = HORIZONS["10 s"].steps(dt)
    peer = make(cases, setting)
    states = np.array([case.state for case in cases])
    samples = []
    for _ in range(3):
        peer.seconds = 0.0
        peer.move(states, dt * steps, 1)
        samples.append(peer.seconds)
    return 1e9 * min(samples) / (count * steps)


# --- what is shown ---

MODES = {"single": "one trajectory", "batch": f"{BATCH:,} states at once"}
TARGETS = (1e-6, 1e-10)


class Point(NamedTuple):
    """One method at one setting: its errors and its time."""

    variant: str
    horizon: str
    mode: str
    family: str
    method: str
    setting: float  #: substeps, or a library's tolerance
    error: float | None
    median: float | None
    errors: Sequence[float | None]
    ns: float

    @property
    def diverged(self) -> int:
        """Number of members that were lost."""
        return sum(error is None for error in self.errors)

    def worst(self, members: int) -> float:
        """Return the largest error of the first members, infinite where one is lost."""
        return max(math.inf if error is None else error for error in self.errors[:members])

    @property
    def name(self) -> str:
        """The method, with its library."""
        return f"{LIBRARIES.get(self.family, '')} {self.method}".strip()

    @property
    def label(self) -> str:
        """The method and its setting in words."""
        if self.method.startswith((OURS, CERTIFIED)):
            return self.method
        if self.family in ("ours", "comparison", "mujoco"):
            return f"{self.name}, {self.setting:g} substep{'s' if self.setting > 1 else ''}"
        return f"{self.name}, {self.setting:g}"


LIBRARIES = {
    "scipy": "SciPy",
    "heyoka": "heyoka",
    "diffrax": "diffrax",
    "torchdiffeq": "torchdiffeq",
    "mujoco": "MuJoCo",
}


def gathered(rows: Sequence[Row]) -> list[Point]:
    """Return the points: errors joined with the times of their methods."""
    clock = {(r["variant"], r["method"], r["horizon"]): r for r in rows if r["kind"] == "time"}
    points = []
    for row in rows:
        if "problem" in row or row["kind"] not in ("error", "library"):
            continue
        variant, horizon, method = row["variant"], row["horizon"], row["method"]
        if row["kind"] == "library":
            # Without a batch mode: one state after the other.
            ns, setting = {"single": row["single"], "batch": row["batch"] or row["single"]}, row["setting"]
        else:
            setting = row["substeps"]
            took = clock.get((variant, method, horizon)) or clock.get((variant, method, "one step"))
            ns = {mode: took[mode] * setting for mode in MODES} if took else {}
        points += [
            Point(
                variant, horizon, mode, row["family"], method, setting,
                row["error"], row["median"], row["errors"], time,
            )
            for mode, time in ns.items()
        ]  # fmt: skip
    return points


def floors(rows: Sequence[Row]) -> dict[tuple, float]:
    """Return, by variant and horizon, what the system makes of one rounding."""
    return {
        (r["variant"], r["horizon"]): max(r["amplified"], ROUNDING) for r in rows if r["kind"] == "rounding"
    }


def matched(point: Point, ours: Sequence[Point], floor: float) -> bool:
    """Tell whether a point of ours is as exact and takes no longer.

    Compared on the members that both have; below `ROUNDINGS` amplified roundings errors count as equal.
    """
    members = len(point.errors)
    limit = max(point.worst(members), ROUNDINGS * floor)
    return any(o.ns <= point.ns and o.worst(members) <= limit for o in ours)


class Comparison(NamedTuple):
    """All points of one variant, horizon and mode, and those of others that none of ours matches."""

    variant: str
    horizon: str
    mode: str
    ours: list[Point]
    others: list[Point]  #: with an error of 1e-6 at most
    exceptions: list[Point]


def compared(rows: Sequence[Row], points: Sequence[Point]) -> list[Comparison]:
    """Compare the points of others with ours."""
    floor, found = floors(rows), []
    for variant in VARIANTS:
        for horizon in HORIZONS:
            for mode in MODES:
                here = [p for p in points if (p.variant, p.horizon, p.mode) == (variant, horizon, mode)]
                ours = [p for p in here if p.family == "ours"]
                others = [p for p in here if p.family != "ours" and p.worst(len(p.errors)) <= TARGETS[0]]
                one = floor.get((variant, horizon), ROUNDING)
                missed = [p for p in others if not matched(p, ours, one)]
                if here:
                    found.append(Comparison(variant, horizon, mode, ours, others, missed))
    return found


def content(rows: list[Row], problems: list[Result]) -> Content:
    """Return the section."""
    points = gathered(rows)
    comparisons = compared(rows, points)
    variants = [name for name in VARIANTS if any(p.variant == name for p in points)]
    return Content(
        title="Error against time",
        text=_text(rows),
        tables=[
            _targets(comparisons),
            _exceptions(comparisons),
            _orders(rows),
            _problems(rows, problems),
        ],
        pictures=[
            Picture(_file(name), _caption(name), partial(draw, name, points, floors(rows)))
            for name in variants
        ],
        claims=_claims(rows, comparisons),
        summary=_summary(comparisons),
        details=[_all(points)],
    )


def _text(rows: Sequence[Row]) -> list[str]:
    checks = [
        100.0 * (ratio - 1.0)
        for ratio in (_substep_ratio(rows, name, mode) for name in VARIANTS for mode in MODES)
        if ratio
    ]
    seen = (
        f"measured with 8 substeps of RK4, {min(checks):+.0f} to {max(checks):+.0f} %"
        if checks
        else "not measured"
    )
    return [
        "Errors are the largest over an ensemble of random states, controls and parameters, and over the "
        "entries of the state, each relative to its size as the README defines accuracy; over 10 s and "
        "1,000 s to its size at the end. The reference is exact to 30 digits: closed forms where there is "
        "one (linear scenes; Jacobi's elliptic functions for a pendulum without damping and drive), else "
        "Taylor series in fixed-point arithmetic. The control is held over the whole time. Over 1,000 s "
        "there is no control, and pendulums have no damping.",
        "Times are those of one control step, with the variant's own parameters; its damping is timed even "
        "where the error is measured without. One step and 10 s are taken control step by control step. Ours "
        "and the comparison steppers are compiled by the same compiler at the same vector width, alone as "
        "one compiled loop, in a batch as one compiled call on 1,024 states. The test whether a step is "
        "certified is part of ours. All are timed in turn in one run, and the median is taken. The time of "
        f"n substeps is n times that of one ({seen}).",
        "Libraries are given the scene's own equation, and every advantage: only their own calls count; a "
        "batch goes into one call where they have one; over 1,000 s they make a single call, with steps of "
        "their own choice, and so does the point 'lag_envs, one call' of ours. heyoka steps 64 states at "
        "once in a batch. SciPy and MuJoCo have no batch, so that theirs is one state after the other. "
        "SciPy's right-hand side is Python. A setting that would take longer than some seconds is not run.",
    ]


def _substep_ratio(rows: Sequence[Row], variant: str, mode: str) -> float | None:
    found = {r["method"]: r[mode] for r in rows if r["kind"] == "time" and r["variant"] == variant}
    if "RK4" not in found or "RK4, 8 substeps" not in found:
        return None
    return found["RK4, 8 substeps"] / found["RK4"]


def _cheapest(points: Sequence[Point], target: float) -> Point | None:
    reached = [p for p in points if p.worst(len(p.errors)) <= target]
    return min(reached, key=lambda p: p.ns, default=None)


def _default(comparison: Comparison) -> Point | None:
    return next((p for p in comparison.ours if p.method == OURS), None)


def _targets(comparisons: Sequence[Comparison]) -> Table:
    rows = []
    for c in comparisons:
        default = _default(c)
        for target in TARGETS:
            ours, other = _cheapest(c.ours, target), _cheapest(c.others, target)
            rows.append([
                c.variant, c.horizon, c.mode,
                default and default.error, default and default.ns, target,
                ours and ours.label, ours and ours.ns,
                other and other.label, other and other.ns,
                other.ns / ours.ns if other and ours else None,
                other.ns / default.ns if other and default else None,
            ])  # fmt: skip
    return Table(
        "work_precision_targets",
        "The cheapest way to an error of 1e-6 and of 1e-10: ours at any order, and anybody else's. An "
        "empty cell: nobody else reached it.",
        [
            "scene", "horizon", "mode", "lag_envs: error", "lag_envs: ns", "target", "cheapest of ours", "ns",
            "cheapest other", "other: ns", "other / ours", "other / lag_envs",
        ],
        rows,
    )  # fmt: skip


def _exceptions(comparisons: Sequence[Comparison]) -> Table:
    rows = []
    for c in comparisons:
        for p in c.exceptions:
            limit = p.worst(len(p.errors))
            quickest = _cheapest([o for o in c.ours if o.worst(len(p.errors)) <= limit], math.inf)
            rows.append([
                c.variant, c.horizon, c.mode, p.label, limit, p.ns,
                quickest and quickest.label, quickest and quickest.ns / p.ns,
                min((o.worst(len(p.errors)) for o in c.ours if o.ns <= p.ns), default=None),
            ])  # fmt: skip
    return Table(
        "work_precision_exceptions",
        "Exceptions: points of others, with an error of 1e-6 at most, that no point of ours matches in "
        f"both error and time. Up to {ROUNDINGS} times an amplified rounding, errors count as equal.",
        [
            "scene", "horizon", "mode", "method", "error", "ns", "ours, as exact", "ours / other, time",
            "error of ours in that time",
        ],
        [[_finite(value) for value in row] for row in rows],
    )  # fmt: skip


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _orders(rows: Sequence[Row]) -> Table:
    found = [r for r in rows if r["kind"] == "order"]
    return Table(
        "work_precision_orders",
        "Order of convergence, from the slope of the error of one step over its length, less one: the "
        "median over 24 problems on PivotedBar, with the shortest pair of steps h and 2h whose errors lie "
        "well above rounding.",
        ["method", "order", "measured", "difference"],
        [
            [r["method"], r["order"], r["slope"], r["slope"] - r["order"] if r["slope"] is not None else None]
            for r in found
        ],
    )


def _problems(rows: Sequence[Row], problems: Sequence[Result]) -> Table:
    found: dict[tuple, list[tuple[str, str]]] = {}
    for row in rows:
        lost = row.get("diverged")
        problem = row.get("problem") or (f"diverged, {lost} of {row['members']}" if lost else None)
        if problem:
            key = (
                row["variant"],
                row["horizon"],
                f"{LIBRARIES.get(row['family'], '')} {row['method']}".strip(),
            )
            setting = row.get("setting", row.get("substeps"))
            found.setdefault((*key, problem.partition(",")[0]), []).append((f"{setting:g}", problem))
    return Table(
        "work_precision_problems",
        "What was not measured, and what diverged: members that ended without a number or further away than "
        "their own size. They are drawn at the upper edge. Settings are numbers of substeps or tolerances; "
        "the problem is that of the last.",
        ["scene or job", "horizon", "method", "settings", "problem"],
        [
            *([result.name, "", "", "", result.problem] for result in problems),
            *([*key[:3], ", ".join(s for s, _ in seen), seen[-1][1]] for key, seen in found.items()),
        ],
    )


#: Claims are made apart for scenes with a pendulum's equation and for linear ones.
KINDS = {
    "The bar and the cylinder in its shell": ("PivotedBar", "CylinderInCylinder"),
    "The incline": ("Incline",),
}


def _claims(rows: Sequence[Row], comparisons: Sequence[Comparison]) -> list[Claim]:
    claims = []
    for words, kinds in KINDS.items():
        for horizon in HORIZONS:
            here = [c for c in comparisons if c.variant.startswith(kinds) and c.horizon == horizon]
            count, missed = sum(len(c.others) for c in here), [p for c in here for p in c.exceptions]
            by = Counter(f"{p.variant}, {MODES[p.mode]}: {p.name}" for p in missed)
            named = ", ".join(f"{name} ({n})" for name, n in by.items())
            claims.append(
                Claim(
                    f"{words}, {horizon}: where others are exact to 1e-6 or better, "
                    "ours is as exact in no more time",
                    not missed if count else None,
                    f"{count - len(missed)} of {count} points" + (f"; exceptions: {named}" if by else "")
                    if count
                    else "not measured",
                )
            )
    steps = [(c, p) for c in comparisons if c.horizon == "one step" if (p := _default(c))]
    words, kinds = next(iter(KINDS.items()))
    ratios = [
        q.ns / p.ns
        for c, p in steps
        if c.variant.startswith(kinds) and (q := _cheapest(c.others, TARGETS[1]))
    ]
    claims.append(
        Claim(
            f"{words}, one step: nobody else reaches an error of 1e-10 in less time than lag_envs as shipped",
            min(ratios) >= 1.0 if ratios else None,
            f"others take {min(ratios):.2g} to {max(ratios):.2g} times as long" if ratios else "not measured",
        )
    )
    slopes = [
        (r["method"], abs(r["slope"] - r["order"])) for r in rows if r["kind"] == "order" and r["slope"]
    ]
    method, worst = max(slopes, key=lambda x: x[1], default=("", 0.0))
    claims.append(
        Claim(
            "Every method converges with its order, within 0.2",
            worst <= 0.2 if slopes else None,
            f"largest difference {worst:.2f}, {method}" if slopes else "not measured",
        )
    )
    largest = max((p.worst(len(p.errors)) for _, p in steps), default=math.nan)
    claims.append(
        Claim(
            "The error of one control step stays below 1e-15 on every scene",
            largest < 1e-15 if steps else None,
            f"largest {largest:.1e}, scenes measured: {len(steps) // 2}" if steps else "not measured",
        )
    )
    same = [r["equal"] for r in rows if r["kind"] == "bits"]
    claims.append(
        Claim(
            "The batch that is timed ends where single trajectories do, bit for bit",
            all(same) if same else None,
            f"{sum(same)} of {len(same)} methods and scenes" if same else "not measured",
        )
    )
    return claims


def _summary(comparisons: Sequence[Comparison]) -> Table:
    found = {(c.variant, c.horizon, c.mode): c for c in comparisons}
    rows = []
    for name in VARIANTS:
        both = [found[key] for mode in MODES if (key := (name, "one step", mode)) in found]
        defaults = [p for c in both if (p := _default(c))]
        if len(defaults) < len(MODES):
            continue
        rows.append([
            name, f"{defaults[0].error:.0e}", *(round(p.ns, 1) for p in defaults),
            *(_other(c, p, target) for target in TARGETS for c, p in zip(both, defaults, strict=True)),
        ])  # fmt: skip
    return Table(
        "work_precision",
        "One control step of each scene: largest error, time alone and in a batch of 1,024; and the "
        "cheapest method of anybody else that reaches an error of 1e-6 and 1e-10, with its time as a "
        "multiple of ours.",
        [
            "scene", "error", "ns, alone", "ns, batch", "others to 1e-6, alone", "in a batch",
            "to 1e-10, alone", "in a batch",
        ],
        rows,
    )  # fmt: skip


def _other(c: Comparison, default: Point, target: float) -> str:
    other = _cheapest(c.others, target)
    return f"{other.label}: {other.ns / default.ns:.2g} ×" if other else "none"


def _all(points: Sequence[Point]) -> Table:
    return Table(
        "work_precision_points",
        "All points: largest and median error, members lost, time of a control step.",
        [
            "scene",
            "horizon",
            "mode",
            "family",
            "method",
            "setting",
            "error",
            "median",
            "members",
            "diverged",
            "ns",
        ],
        [[*p[:6], p.error, p.median, len(p.errors), p.diverged, p.ns] for p in points],
    )


def _file(variant: str) -> str:
    return "work_precision_" + variant.lower().replace(", ", "_")


def _caption(variant: str) -> str:
    return (
        f"{variant}: largest error against the time of a control step. Lower left is better. Columns: one "
        "control step, 10 s, 1,000 s; rows: one trajectory, and a batch. Thin bars reach down to the "
        "median error. Dotted: what the system itself makes of one rounding of its start. Libraries are "
        "measured on the first few members only; over 1,000 s they make one call, the others go on step by "
        "step. Reference: 30 digits, by closed forms where there is one, else by Taylor series."
    )


#: Colours after Okabe and Ito; comparison steppers are drawn in full, libraries dashed.
STYLES = {
    "explicit Euler": ("#999999", "o", "-"),
    "semi-implicit Euler": ("#999999", "s", "-"),
    "Verlet": ("#56B4E9", "v", "-"),
    "implicit midpoint": ("#CC79A7", "^", "-"),
    "RK4": ("#E69F00", "D", "-"),
    "ETD4RK": ("#009E73", "P", "-"),
    "SciPy RK45": ("#D55E00", "o", "--"),
    "SciPy DOP853": ("#D55E00", "s", "--"),
    "SciPy Radau": ("#D55E00", "^", "--"),
    "SciPy LSODA": ("#D55E00", "v", "--"),
    "heyoka Taylor": ("#000000", "X", "--"),
    "diffrax Tsit5": ("#8C6D31", "o", "--"),
    "diffrax Dopri8": ("#8C6D31", "s", "--"),
    "torchdiffeq dopri5": ("#7F3C8D", "o", "--"),
    "torchdiffeq dopri8": ("#7F3C8D", "s", "--"),
    "MuJoCo Euler": ("#B8860B", "o", ":"),
    "MuJoCo implicit": ("#B8860B", "^", ":"),
    "MuJoCo RK4": ("#B8860B", "D", ":"),
}
BLUE, DARK = "#0072B2", "#003B5C"
LOWEST = 1e-17


def draw(variant: str, points: Sequence[Point], floor: Mapping[tuple, float]) -> Figure:
    """Draw one variant: horizons side by side, one trajectory above, a batch below."""
    from matplotlib.figure import Figure

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
    known = {
        label: handle
        for ax in axes.flat
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    names = [
        name
        for name in (OURS, ONE_CALL, "ours, order 4 to 20", "ours, other settings", *STYLES)
        if name in known
    ]
    names += ["amplified rounding"] if "amplified rounding" in known else []
    figure.legend(
        [known[n] for n in names], names, loc="outside lower center", ncols=6, fontsize=8.5, frameon=False
    )
    return figure


def panel(ax: Axes, points: Sequence[Point], floor: float | None) -> None:
    """Draw all curves of one horizon and mode."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_ylim(LOWEST, 1.5)
    ax.grid(True, which="major", color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    if floor:
        ax.axhline(floor, color="0.3", linestyle=":", linewidth=1.2, label="amplified rounding")
    curves: dict[str, list[Point]] = {}
    for p in points:
        if p.family != "ours":
            curves.setdefault(p.name, []).append(p)
    for name, curve in curves.items():
        colour, marker, line = STYLES.get(name, ("0.5", ".", "-"))
        _curve(
            ax, curve, label=name, color=colour, marker=marker, linestyle=line, linewidth=1.0, markersize=3.5
        )
    ours = [p for p in points if p.family == "ours"]
    series = [p for p in ours if p.method.startswith(SERIES) and p.setting == 1]
    default = [p for p in ours if p.method == OURS]
    once = [p for p in ours if p.method == ONE_CALL]
    rest = [p for p in ours if p not in [*series, *default, *once]]
    _curve(
        ax, rest, label="ours, other settings", color=BLUE, marker=".", linestyle="", markersize=4, alpha=0.55
    )
    _curve(
        ax, series, label="ours, order 4 to 20", color=BLUE, marker="o", linewidth=2.6, markersize=5, zorder=5
    )
    for p in series:
        order = p.method.rpartition(" ")[2]
        if order in ("4", "8", "12"):
            ax.annotate(
                order,
                (p.ns, _height(p)),
                (-6, -3),
                textcoords="offset points",
                ha="right",
                fontsize=8,
                color=BLUE,
            )
    best = {"color": DARK, "linestyle": "", "markeredgecolor": "white", "zorder": 6}
    _curve(ax, default, label=OURS, marker="*", markersize=15, **best)
    _curve(ax, once, label=ONE_CALL, marker="p", markersize=11, **best)


def _height(p: Point) -> float:
    return 1.0 if p.diverged or p.error is None else max(p.error, 1.3 * LOWEST)


def _curve(ax: Axes, points: Sequence[Point], **style: Any) -> None:
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
