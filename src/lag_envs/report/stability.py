"""Where a step is accurate, inaccurate or refused, shown by maps and a table of named cases."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from lag_envs.report import extremes, reference
from lag_envs.report.cases import MAIN, Case, scales
from lag_envs.report.extremes import EXACT
from lag_envs.report.integrators import comparison
from lag_envs.report.points import LAG_ENVS, ROUNDING
from lag_envs.report.runner import ReportJob, Row, error_line
from lag_envs.report.stability_maps import MAPS
from lag_envs.report.stability_results import (
    DIVERGED,
    FAR_OFF,
    MOST_SUBSTEPS,
    NO_REFERENCE,
    PEERS,
    REFUSED,
    TOO_LONG,
    content,
)
from lag_envs.report.stepped import Stepped
from lag_envs.scenes.checks import StepRefused
from lag_envs.scenes.derivation import motion_constants_of

__all__ = ["content", "extreme_errors", "jobs", "largest_errors", "map_errors", "methods", "step_cases"]

#: Precisions of the comparison integrators, and the endings of their names.
PRECISIONS: dict[str, type[np.floating]] = {"": np.float64, ", float32": np.float32}


def jobs(quick: bool) -> list[ReportJob]:
    """Return the section's jobs: one for every row of a map, and the named cases."""
    found: list[ReportJob] = []
    for title, map in MAPS.items():
        low, high = map.exponents
        values = _decades(low, high, 7 if quick else 2 * (high - low) + 1)
        for name in map.scenes:
            if quick and (title, name) != ("damping", MAIN):
                continue
            for dt in _decades(-6, 0, 5 if quick else 13):
                arguments = {"map": title, "name": name, "dt": dt, "values": values}
                found.append(ReportJob(map_errors, f"{name}, {title}, step {dt:.2g} s", arguments))
    cases = list(extremes.QUICK if quick else extremes.EXTREMES)
    parts = 2 if quick else 6
    return found + [
        ReportJob(extreme_errors, f"extreme cases {i + 1}", {"names": cases[i::parts]}) for i in range(parts)
    ]


def _decades(low: int, high: int, n: int) -> list[float]:
    return [float(x) for x in np.logspace(low, high, n)]


# --- measuring ---


def map_errors(map: str, name: str, dt: float, values: Sequence[float]) -> Iterator[Row]:
    """Yield the errors of one step of dt for each value of the map's varied quantity.

    If our error exceeds the limit for exactness, the row also has ``roundings``, its error over the effect of
    one rounding of the start, and ``substeps``.
    """
    found = [MAPS[map].case(name, x, dt) for x in values]
    ends = methods(found, dt)
    for i, (x, case) in enumerate(zip(values, found, strict=True)):
        row: Row = {"kind": "cell", "map": map, "name": name, "dt": dt, "x": x}
        row |= largest_errors(case, dt, {key: end[i] for key, end in ends.items()})
        error = row["errors"][LAG_ENVS]
        if error == DIVERGED or (isinstance(error, float) and error > EXACT):
            row["substeps"] = extremes.substeps(case, dt)
            try:
                row["roundings"] = _roundings(case, dt, ends[LAG_ENVS][i])
            except ArithmeticError as problem:
                row["problem"] = error_line(problem)
        yield row


def _roundings(case: Case, dt: float, end: Sequence[float]) -> float | None:
    """Return the largest error of an entry over the effect of one rounding of the start."""
    exact = reference.remembered(case.scene, case.state, case.control, dt)
    errors, gains = reference.state_differences(end, exact), extremes.amplification(case, dt)
    shares = [abs(e) / (ROUNDING * g) for e, g in zip(errors, gains, strict=True) if g]
    return max(shares, default=None)


def extreme_errors(names: Sequence[str]) -> Iterator[Row]:
    """Yield the outcomes of the named stiff and extreme cases, and those of the comparison integrators."""
    for name in names:
        row: Row = {"kind": "case", "name": name, "peers": {}}
        try:
            row |= extremes.measure_extreme(name)
            if row["error"] is not None:
                dt = extremes.EXTREMES[name].dt
                case = extremes.built_case(extremes.EXTREMES[name])
                ends = methods([case], dt)
                row["peers"] = largest_errors(case, dt, {key: end[0] for key, end in ends.items()})["errors"]
        except Exception as error:
            row |= {"problem": error_line(error)}
        yield row


def largest_errors(case: Case, dt: float, ends: dict[str, Any]) -> Row:
    """Return the largest error of each end relative to the scales, or the reason why there is none."""
    try:
        exact = reference.remembered(case.scene, case.state, case.control, dt)
    except ArithmeticError as error:  # such as oracle.Unresolved
        kept = {key: end if isinstance(end, str) else NO_REFERENCE for key, end in ends.items()}
        return {"errors": kept, "problem": error_line(error)}
    sizes = scales(case, dt)

    def relative(end: Any) -> float | str:
        if isinstance(end, str):
            return end
        if not np.isfinite(end).all():
            return DIVERGED
        error = max(abs(e) / s for e, s in zip(reference.state_differences(end, exact), sizes, strict=True))
        return error if error < FAR_OFF else DIVERGED

    return {"errors": {key: relative(end) for key, end in ends.items()}}


def methods(found: Sequence[Case], dt: float) -> dict[str, list[Any]]:
    """Return each method's end state for each case, or the reason why there is none.

    Keys are names; ", 16" is added for 16 steps in place of one, ", float32" for that arithmetic. "lag_envs"
    is the shipped step; "lag_envs, float32" is the formula of its series, with the substeps that the bound
    requires.
    """
    ends: dict[str, list[Any]] = {LAG_ENVS: [_shipped(case, dt) for case in found]}
    flow = Stepped(found[0].scene, dt=dt).flow
    with np.errstate(all="ignore"):
        for more, dtype in PRECISIONS.items():
            for name in PEERS:
                for n, times in ((1, ""), (16, ", 16")):
                    counts = np.full(len(found), n)
                    ends[f"{name}{times}{more}"] = step_cases(
                        comparison(name, flow).fast, found, dt, counts, dtype
                    )
        counts = np.array([_count(case, dt) for case in found])
        short = np.minimum(counts, MOST_SUBSTEPS)
        rows = step_cases(flow.fast, found, dt, np.where(counts > MOST_SUBSTEPS, 1, short), np.float32)
    ends[f"{LAG_ENVS}, float32"] = [
        TOO_LONG if n > MOST_SUBSTEPS else row for n, row in zip(counts, rows, strict=True)
    ]
    return ends


def _shipped(case: Case, dt: float) -> Any:
    try:
        return case.scene.simulate(case.state, [case.control], dt)[-1].tolist()
    except (StepRefused, ValueError):
        return REFUSED


def _count(case: Case, dt: float) -> float:
    """Return the number of plain substeps needed for accuracy, by the bound or by `within`."""
    scene, state, control = case
    bound = scene.step_bound(state, control, dt)
    if bound.order:
        return float(bound.substeps)
    stepped = Stepped(scene, dt=dt)
    variables, coefficients = stepped.at(state, control)
    n = 1.0
    while n <= MOST_SUBSTEPS and not stepped.flow.within(variables, coefficients, dt / n, 0.0, np):
        n *= 2.0
    return n


def step_cases(
    fast: Callable, found: Sequence[Case], dt: float, counts: np.ndarray, dtype: type[np.floating]
) -> list[list[float]]:
    """Step cases of one scene by a step's formula, on NumPy arrays of one precision.

    Parameters
    ----------
    fast : callable
        As in `Flow`.
    found : sequence of Case
        From one class of scene, with one kind of control.
    dt : float
        Time [s].
    counts : ndarray of int, shape (len(found),)
        Each case takes this many steps of length dt / count.
    dtype : type
        Precision of everything: constants, state, arithmetic.
    """
    form = Stepped(found[0].scene).form
    constants = [motion_constants_of(case.scene) for case in found]
    k = SimpleNamespace(**{key: np.array([c[key] for c in constants], dtype) for key in constants[0]})
    u = [np.array([case.control for case in found], dtype)]
    h = (dt / counts).astype(dtype)
    y: Sequence[Any] = [np.array(column, dtype) for column in zip(*(c.state for c in found), strict=True)]
    if form.angle is not None:
        y = [*y, np.cos(y[form.angle]), np.sin(y[form.angle])]
    for i in range(int(counts.max())):
        moved = fast(form.unpack(y, u, k), form.coefficients_at(y, u, k, np), h, np)
        new = form.pack(moved, y, u, h, k)
        y = [np.where(i < counts, a, b) for a, b in zip(new, y, strict=True)]
        if any(a.dtype != dtype for a in y):
            raise TypeError(f"{[str(a.dtype) for a in y]} is not {dtype.__name__}")
    return np.transpose(y[: len(form.state_names)]).astype(float).tolist()
