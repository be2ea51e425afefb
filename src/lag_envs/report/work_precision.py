"""Error against time: the shipped stepping, the usual integrators, other libraries.

Every rival runs in its fastest form (`variant_rivals`, `peers`), alone and in a batch, and the errors are
those of the timed calls. `work_precision_results` compares and reports the measurements, `diagrams` draws
them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from lag_envs.report import peers, reference
from lag_envs.report.cases import MAIN, VARIANTS, Case, ensemble, scales
from lag_envs.report.equations import Array, Problems
from lag_envs.report.integrators import METHODS, comparison, plain_series
from lag_envs.report.points import MODES, ROUNDING
from lag_envs.report.rivals import CompiledMethod, Rival, ShippedStepping
from lag_envs.report.runner import ReportJob, Row, error_line
from lag_envs.report.stepped import Stepped
from lag_envs.report.timing import FlowSteps, Sample, interleaved
from lag_envs.report.work_precision_results import content
from lag_envs.scenes.base import Scene
from lag_envs.stepping.flows import Flow

__all__ = ["content", "jobs", "orders", "state_errors", "variant_points"]

#: Orders of the series whose convergence is measured; those that are not shipped are used only for this.
ORDERS = tuple(range(4, 21, 2))


class Horizon(NamedTuple):
    """A time for which the control is held, and the measurements over that time."""

    seconds: float | None  #: None: one control step
    members: int  #: problems
    substeps: Sequence[float]  #: of the integrators that we compile, per control step
    batch: int  #: states of a batch

    def steps(self, dt: float) -> int:
        """Return the number of control steps."""
        return 1 if self.seconds is None else round(self.seconds / dt)


HORIZONS = {
    "one step": Horizon(None, 48, (1, 2, 4, 8, 16, 32, 64, 128, 256), 1024),
    "10 s": Horizon(10.0, 8, (1 / 4, 1 / 2, 1, 2, 4, 8, 16, 32, 64), 128),
    "1,000 s": Horizon(1000.0, 3, (1 / 4, 1 / 2, 1, 2, 4, 8, 16, 32), 128),
}
QUICK = {
    "one step": Horizon(None, 8, (1, 4, 16, 64), 1024),
    "10 s": Horizon(10.0, 1, (1 / 4, 1, 4), 128),
}
QUICK_METHODS = ("Verlet", "RK4", "RK4, carried", "DOP853, carried")
#: Longest time for the errors of one point [s]; slower points are not run.
LIMIT = 2.0
#: Approximate seconds for one sample of its time.
SAMPLE = 0.02


def control_step(variant: str) -> float:
    """Return the control step [s], rounded to a multiple of 2^-36: products with integers are exact."""
    return round(VARIANTS[variant].dt * 2**36) / 2**36


def jobs(quick: bool) -> list[ReportJob]:
    """Return the jobs: references, then points of lag_envs and the usual integrators, then of libraries."""
    names = (MAIN,) if quick else tuple(VARIANTS)
    horizons = QUICK if quick else HORIZONS
    made = [
        ReportJob(
            references,
            f"references: {name}, {horizon}",
            {"variant": name, "horizon": horizon, "quick": quick},
            timeout=300.0,
        )
        for horizon in horizons
        for name in names
    ]
    made.append(ReportJob(orders, "orders", {"variant": MAIN, "quick": quick}))
    for name in names:
        variant = VARIANTS[name]
        kinds = [
            package
            for package, peer in peers.PEERS.items()
            if (variant.typical or not peer.slow) and issubclass(variant.kind, peer.scenes)
        ]
        made += [
            ReportJob(
                variant_points,
                f"{family}: {name}",
                {"variant": name, "family": family, "quick": quick},
                timeout=600.0,
                alone=True,
            )
            for family in ["compiled", *(["scipy"] if quick else kinds)]
        ]
    return made


# --- exact ends ---


def problems(horizon: str, cases: Sequence[Case]) -> list[Case]:
    """Return the cases of a horizon; over 1,000 s there is no control, and pendulums have no damping."""
    if horizon != "1,000 s":
        return list(cases)
    return [Case(_undamped(case.scene), case.state, 0.0) for case in cases]


def _undamped(scene: Scene) -> Scene:
    """Return a scene whose motion has a closed form; a scene stepped by series loses its damping."""
    if not Stepped(scene).flow.order:
        return scene
    return dataclasses.replace(scene, damping=0.0)  # type: ignore[type-var]


class ExactEnd(NamedTuple):
    """The exact end of a problem."""

    case: Case
    end: Sequence[Any]
    scale: Sequence[float]

    def error(self, state: Array) -> float:
        """Return the largest error of a state's entries, each relative to its scale; infinite for NaN."""
        if not np.isfinite(state).all():
            return math.inf
        return max(
            abs(e) / s
            for e, s in zip(reference.state_differences(state.tolist(), self.end), self.scale, strict=True)
        )


def exact_end(case: Case, dt: float, steps: int) -> ExactEnd:
    """Return the exact end; errors of one step are relative to the start's size, others to the end's."""
    end = reference.remembered(case.scene, case.state, case.control, dt * steps)
    at = case if steps == 1 else case._replace(state=tuple(map(float, end)))
    return ExactEnd(case, end, scales(at, dt))


def truths(variant: str, horizon: str, plan: Horizon) -> list[ExactEnd]:
    """Return the exact ends of a horizon's members."""
    dt = control_step(variant)
    return [
        exact_end(case, dt, plan.steps(dt)) for case in problems(horizon, ensemble(variant, plan.members))
    ]


def amplified(some: Sequence[ExactEnd], dt: float, steps: int) -> float:
    """Return the median effect of one rounding of the start, relative to the scales."""
    from mpmath import mp, mpf

    found = []
    for case, end, scale in some:
        with mp.workdps(40):
            state = [mpf(x) * (1 + mpf(ROUNDING)) for x in case.state]
            moved = reference.exact_flow(case.scene, state, case.control, dt * steps, digits=20)
            found.append(max(float(abs(a - b)) / s for a, b, s in zip(moved, end, scale, strict=True)))
    return median(found)


def references(variant: str, horizon: str, quick: bool) -> Iterator[Row]:
    """Compute the exact ends and keep them for the other jobs; yield amplified roundings."""
    plan = (QUICK if quick else HORIZONS)[horizon]
    dt = control_step(variant)
    found = truths(variant, horizon, plan)
    yield {
        "kind": "rounding", "variant": variant, "horizon": horizon,
        "amplified": amplified(found[:4], dt, plan.steps(dt)),
    }  # fmt: skip


def state_errors(some: Sequence[ExactEnd], ends: Array) -> Row:
    """Return errors of states, the largest and median of those below 1, and the number of lost members."""
    found = [t.error(end) for t, end in zip(some, ends, strict=True)]
    kept = [error for error in found if error < 1.0]
    return {
        "errors": [float(f"{error:.3g}") if error < 1.0 else None for error in found],
        "error": max(kept, default=None),
        "median": median(kept) if kept else None,
        "members": len(found),
        "diverged": len(found) - len(kept),
    }


# --- points ---


def variant_rivals(variant: str, horizon: str, family: str, quick: bool) -> list[Rival]:
    """Return a family's methods at all settings; lag_envs is among the compiled ones."""
    plan = (QUICK if quick else HORIZONS)[horizon]
    if family == "compiled":
        equation = Problems(problems(horizon, ensemble(variant, 1))).equation
        methods = [m for m in CompiledMethod.methods(equation) if not quick or m in QUICK_METHODS]
        shipped = [ShippedStepping()]
        if plan.seconds is not None:  # a constant control may be stepped with any dt
            shipped += [ShippedStepping(n) for n in (1 / 8, 1 / 4, 1 / 2, 2)]
            shipped += [ShippedStepping(one_call=True)]
        return [*shipped, *(CompiledMethod(method, n) for method in methods for n in plan.substeps)]
    kind = peers.PEERS[family]
    some = slice(1, None, 3) if quick else slice(None)
    return [kind(method, setting) for method, found in kind.settings.items() for setting in found[some]]


def variant_points(variant: str, family: str, quick: bool) -> Iterator[Row]:
    """Yield errors and times of a family on a variant, alone and in a batch.

    Every row has as its `clock` our time of a control step, measured in turn with the row in the same job.
    """
    dt = control_step(variant)
    for horizon, plan in (QUICK if quick else HORIZONS).items():
        some, steps = truths(variant, horizon, plan), plan.steps(dt)
        batch = problems(horizon, ensemble(variant, plan.batch, vary=False))
        for mode in MODES:
            together = mode == "batch"
            base = batch if together or steps > 1 else mirrored(batch, *VARIANTS[variant].controls)
            found: list[Row] = []
            samples: list[Sample] = []
            done: dict[str, float] = {}  # error so far of methods; -1 if finer settings are not run
            for rival in variant_rivals(variant, horizon, family, quick):
                if done.get(rival.method) == -1.0 or (together and not rival.batched):
                    continue
                about = {
                    "kind": "point", "variant": variant, "horizon": horizon, "mode": mode,
                    "family": rival.family, "method": rival.method, "setting": rival.setting,
                    "batched": rival.batched,
                }  # fmt: skip
                try:
                    row, sample = point(rival, some, base, dt, steps, together)
                except TimeoutError as error:
                    yield about | {"problem": str(error)}
                    done[rival.method] = -1.0
                except Exception as error:
                    yield about | {"problem": error_line(error)}
                    if isinstance(error, ImportError):
                        return
                else:
                    found.append(about | row)
                    samples.append(sample)
                    if rival.family == "compiled" and not row["diverged"]:
                        at_rounding = row["error"] < 4.0 * ROUNDING
                        no_better = row["error"] > 0.7 * done.get(rival.method, math.inf)
                        done[rival.method] = -1.0 if at_rounding or no_better else row["error"]
            clock = timed(ShippedStepping(), base, dt, steps, together)
            own, *times = interleaved([clock, *samples], 5 if quick else 9)
            for row, ns in zip(found, times, strict=True):
                yield row | {"ns": ns, "clock": own}


def point(
    rival: Rival, some: Sequence[ExactEnd], base: Sequence[Case], dt: float, steps: int, together: bool
) -> tuple[Row, Sample]:
    """Return the errors of a rival, and the sample for timing it.

    Raises
    ------
    TimeoutError
        If the measurement would take too long.
    """
    members = [t.case for t in some]
    # If states share their steps, errors are from a batch as large as the timed one.
    cases = [*members, *base[len(members) :]] if together and rival.shared else members
    if rival.family != "lag_envs":
        few = cases if together else cases[:1]
        expected = _seconds(rival, few, dt, steps, together) * len(cases) / len(few)
        if expected > LIMIT:
            raise TimeoutError(f"not run: it would take {expected:.0f} s")
    ends = rival.build(Problems(cases), dt, steps, together).end()[: len(some)]
    known = np.where(np.isnan(ends), np.nan, ends)  # NaN has many bit patterns
    row = state_errors(some, ends) | {"digest": hashlib.sha256(known.tobytes()).hexdigest()[:16]}
    return row, timed(rival, base, dt, steps, together)


def _seconds(rival: Rival, cases: Sequence[Case], dt: float, steps: int, together: bool) -> float:
    """Estimate the time of a call from a call for a hundredth of the span, which also compiles."""
    part = max(1, steps // 100)
    sample = rival.build(Problems(cases), dt, part, together)
    sample.end()
    begin = time.process_time()  # not affected by the machine's other work
    sample.end()
    return max(time.process_time() - begin, 1e-7) * steps / part


def timed(rival: Rival, base: Sequence[Case], dt: float, steps: int, together: bool) -> Sample:
    """Return a sample of some milliseconds, in one call, all in compiled loops if the rival has them.

    A step costs the same over a long time as over a short time, so a slow rival is timed over a part only.
    """
    if steps == 1 and rival.changing:
        each = rival.substeps(1) if rival.fixed else 1
        if together:  # only few, since a constant control drives states far away
            return rival.build(Problems(base), dt, 1, True, max(1, 4 // each))
        return rival.build(Problems(base[:8]), dt, 1, False, max(8, 512 // each))
    some = base if together else base[:1]
    if rival.fixed:
        steps = min(steps, max(16, 512 // rival.substeps(1)))
    spent = _seconds(rival, some, dt, steps, together)
    if spent > SAMPLE:
        steps = max(1, steps // 100, int(steps * SAMPLE / spent))
    elif not together:
        some = base[: min(64 if steps == 1 else 4, max(1, int(SAMPLE / spent)))]
    sample = rival.build(Problems(some), dt, steps, together)
    return repeated(sample, 8) if steps == 1 and together and 8.0 * spent < SAMPLE else sample


def mirrored(cases: Sequence[Case], low: float, high: float) -> list[Case]:
    """Return cases in which every second control is the one before, mirrored within its range.

    In this way no drive builds up over successive controls.
    """
    return [
        case._replace(control=low + high - cases[i - 1].control) if i % 2 else case
        for i, case in enumerate(cases)
    ]


def repeated(sample: Sample, times: int) -> Sample:
    """Return the sample of several calls, each continuing from the last end state or starting afresh."""

    def run() -> None:
        for _ in range(times):
            sample.run()

    return sample._replace(run=run, steps=sample.steps * times)


# --- orders of convergence ---


class OrderedMethod(NamedTuple):
    """A method whose order is measured."""

    method: str
    flow: Flow
    order: int


def series(scene: Scene, quick: bool = False) -> list[OrderedMethod]:
    """Return all methods that have an order: lag_envs at several orders, and the usual integrators."""
    found, flow = [], Stepped(scene).flow
    if flow.order:
        found = [
            OrderedMethod(f"plain series {n}", plain_series(n), n) for n in ((4, 8) if quick else ORDERS)
        ]
    forms = {"": False, CompiledMethod.CARRIED: True}
    found += [
        OrderedMethod(name + form, comparison(name, flow, carried), method.order)
        for name, method in METHODS.items()
        for form, carried in forms.items()
        if not quick or name + form in QUICK_METHODS
    ]
    return found


def orders(variant: str, quick: bool) -> Iterator[Row]:
    """Yield the orders of convergence of all methods that have one."""
    cases = ensemble(variant, 6 if quick else 24)
    ends = single_steps(variant, cases)
    for found in series(cases[0].scene, quick):
        yield {
            "kind": "order", "variant": variant, "method": found.method, "order": found.order,
            "slope": measured_order(found, ends),
        }  # fmt: skip


def single_steps(variant: str, cases: Sequence[Case]) -> dict[float, list[ExactEnd]]:
    """Return the exact ends of single steps of several lengths, each √2 times the previous one."""
    lengths = [round(VARIANTS[variant].dt * 2 ** (k / 2) * 2**36) / 2**36 for k in range(-4, 9)]
    return {h: [exact_end(case, h, 1) for case in cases] for h in lengths}


def measured_order(found: OrderedMethod, ends: Mapping[float, Sequence[ExactEnd]]) -> float | None:
    """Return the slope of the error of one step over its length, minus one; None if it has no slope."""
    kernels = FlowSteps(next(iter(ends.values()))[0].case.scene, found.flow)
    return observed_order({h: [t.error(kernels.end(t.case, h, 1)) for t in some] for h, some in ends.items()})


def observed_order(found: Mapping[float, Sequence[float]]) -> float | None:
    """Return the observed order from the errors of steps of several lengths, as the median over members.

    The comparison uses the shortest steps h and 2h whose errors are well above rounding in half of the
    members.

    Examples
    --------
    >>> observed_order({h: [h**5, 3 * h**5] for h in (0.1, 0.2)})
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
