"""The named stiff and extreme cases, the expected outcome of each, and how one of them is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from mpmath import mp, mpf

from lag_envs import scenes
from lag_envs.report import reference
from lag_envs.report.cases import Case, scales
from lag_envs.report.points import ROUNDING
from lag_envs.report.runner import Row
from lag_envs.report.stepped import Stepped
from lag_envs.scenes.base import Scene
from lag_envs.scenes.checks import StepRefused

#: The accuracy that docs/accuracy.md promises, relative to the scales, and the number of roundings of the
#: state that are allowed in addition.
EXACT, ROUNDINGS = 1e-12, 10.0

FULL, AMPLIFIED, REFUSED = "full accuracy", "amplified rounding", "refused with an error"


class Extreme(NamedTuple):
    """A demanding step; its scene is made only when measured, since making it may already be refused."""

    scene: str
    parameters: dict[str, Any]
    state: Sequence[float]
    control: float
    dt: float
    expected: str = FULL


_BAR = {"mass": 1.0, "com_distance": 0.5, "inertia": 0.0, "track": None}
_SHELL = {"mass": 1.0, "shell_radius": 0.5, "damping": 0.02}
_SOLID = {**_SHELL, "radius": 0.1}
_SLOPE = {"mass": 1.0, "radius": 0.05}
_TOP = 2.0 * math.sqrt(9.81 / 0.5)  # speed at the bottom that just reaches the top


def _bar(state: Sequence[float], u: float, dt: float, expected: str = FULL, **changes: Any) -> Extreme:
    return Extreme("PivotedBar", _BAR | changes, state, u, dt, expected)


def _shell(state: Sequence[float], u: float, dt: float, expected: str = FULL, **changes: Any) -> Extreme:
    return Extreme("CylinderInCylinder", _SOLID | changes, state, u, dt, expected)


def _slope(state: Sequence[float], u: float, dt: float, expected: str = FULL, **changes: Any) -> Extreme:
    return Extreme("Incline", _SLOPE | changes, state, u, dt, expected)


#: Bars are point masses at 0.5 m, so that their rate of damping is 4 times the coefficient of drag.
EXTREMES = {
    # stiff
    "damping, gamma dt = 100": _bar((2.0, 3.0), 3.0, 0.02, damping=1250.0),
    "damping, gamma dt = 1e4": _bar((2.0, 3.0), 3.0, 0.02, damping=1.25e5),
    "damping, gamma dt = 1e6": _bar((2.0, 3.0), 3.0, 0.02, damping=1.25e7),
    "damping, gamma dt = 1e6, 1e4 rad/s": _bar((2.0, 1e4), 3.0, 1.0, damping=2.5e5),
    "damping and drive of 1e6": _bar((1.0, 0.0), 1e6, 0.01, damping=1.0),
    "just too little damping to be stiff": _bar((2.0, 3.0), 500.0, 1.0, damping=250.0),
    "shell, damping, gamma dt = 1e6": _shell((1.0, 3.0, 2.0), 10.0, 0.05, damping=4.8e6),
    "shell, drag as control, gamma dt = 1e4": _shell((1.0, 3.0), 1.2e5, 0.02, control="damping", damping=0.0),
    "slope, gamma dt = 1e6": _slope((0.5, 2.0), 0.0, 0.02, damping=7.5e7, control="damping"),
    "moving slope, gamma dt = 1e6": _slope((0.3, 1.0, 0.1), 0.3, 0.05, damping=3e7, control="tilt_rate"),
    # gravity
    "no gravity": _bar((1.0, 2.0), 0.0, 1.0, gravity=0.0),
    "gravity of 1e3": _bar((2.0, 0.0), 0.0, 0.02, gravity=1e3),
    "gravity of 1e3, upright, half a second": _bar((math.pi, 0.0), 0.0, 0.5, AMPLIFIED, gravity=1e3),
    "shell, no gravity": _shell((1.0, 0.0, 2.0), 3.0, 0.5, gravity=0.0),
    # bodies
    "bar of 1e-8 m": _bar((1.0, 3.0), 1.0, 0.01, com_distance=1e-8),
    "bar of 1e-8 m, 1 s": _bar((1.0, 3.0), 1.0, 1.0, AMPLIFIED, com_distance=1e-8),
    "r near R": _shell((1.0, 0.0, 2.0), 3.0, 1e-3, radius=0.5 - 1e-9),
    "r near R, 1 s": _shell(
        (1.0, 3.0), 0.0, 1.0, AMPLIFIED, control="damping", damping=0.0, radius=0.5 * (1.0 - 1e-9)
    ),
    "r near 0": _shell((1.0, 0.0, 2.0), 3.0, 0.5, radius=1e-9),
    "point mass in the shell": _shell((1.0, -4.0, 6.0), 15.0, 1.0, inertia=0.0),
    "hoop in the shell": _shell((1.0, -4.0, 6.0), 15.0, 0.05, inertia=0.01),
    "hoop, drive of 1e6": _shell((1.0, 0.0, 2.0), 1e6, 0.01, inertia=0.01),
    "point mass on the slope": _slope((0.5, 2.0), 0.2, 1.0, control="tilt", inertia=0.0),
    # speed and drive
    "1e4 rad/s": _bar((1.0, 1e4), 3.0, 0.02),
    "1e4 rad/s for a second": _bar((1.0, 1e4), 3.0, 1.0),
    "1e4 rad/s against a drive of 1e6": _bar((-math.pi, -1e4), 1e6, 0.1),
    "drive of 1e6, 1 ms": _bar((1.0, 0.0), 1e6, 1e-3),
    "drive of 1e6, 1 s": _bar((1.0, 0.0), 1e6, 1.0, AMPLIFIED),
    "drive of 1e6, from its unstable rest": _bar(
        (math.pi - math.atan2(2e6, 19.62), 0.0), 1e6, 0.01, AMPLIFIED
    ),
    # places
    "upright": _bar((math.pi, 0.0), 0.0, 0.02),
    "upright, 1 s": _bar((math.pi, 0.0), 0.0, 1.0),
    "separatrix, 1e-15 above": _bar((0.0, _TOP * (1 + 1e-15)), 0.0, 1.0),
    "separatrix, 1e-15 below": _bar((0.0, _TOP * (1 - 1e-15)), 0.0, 1.0),
    "separatrix, 1e-15 above, 3 s": _bar((0.0, _TOP * (1 + 1e-15)), 0.0, 3.0, AMPLIFIED),
    "far angle, 1e9 rad": _bar((1e9, 3.0), 1.0, 0.02),
    # steps
    "step of 1e-6 s": _bar((2.0, 3.0), 5.0, 1e-6),
    "step of 1e-6 s, drive of 1e6": _bar((math.pi, 1.0), 1e6, 1e-6),
    "step of 1 s": _bar((2.0, 3.0), 5.0, 1.0),
    "moving slope, step of 1 s": _slope((0.3, 1.0, 0.1), 0.3, 1.0, control="tilt_rate"),
    # too much
    "1e7 rad/s for a second": _bar((1.0, 1e7), 0.0, 1.0, REFUSED),
    "drive of 1e300": _bar((1.0, 0.0), 1e300, 0.02, REFUSED),
    "step of 1e300 s": _bar((1.0, 0.0), 0.0, 1e300, REFUSED),
    "slope that turns by 1e6 rad/s": _slope((1.0, 0.0, 0.0), 1e6, 1.0, REFUSED, control="tilt_rate"),
    "state beyond float64": _slope((1e308, 1e308), 0.0, 10.0, REFUSED),
    "drag of -1e8": _shell((0.5, 0.2), -1e8, 0.02, REFUSED, control="damping"),
    "r = R": _shell((1.0, 0.0, 2.0), 0.0, 0.02, REFUSED, radius=0.5),
    "step of 0 s": _bar((1.0, 0.0), 0.0, 0.0, REFUSED),
}

#: The cases of `lag-envs report --quick` and the tests.
QUICK = (
    "damping, gamma dt = 1e4",
    "damping, gamma dt = 1e6",
    "no gravity",
    "gravity of 1e3, upright, half a second",
    "bar of 1e-8 m",
    "1e4 rad/s",
    "drive of 1e6, 1 ms",
    "upright, 1 s",
    "separatrix, 1e-15 above",
    "separatrix, 1e-15 below",
    "step of 1e-6 s",
    "1e7 rad/s for a second",
    "r = R",
)


def amplification(case: Case, dt: float) -> list[float]:
    """Return how much a step amplifies one rounding of its start, whatever the method.

    Every entry of the state is moved up and down by 2**-53 times its size; for angles the size is at least
    1 rad, since cosine and sine are stored to absolute precision, for a pendulum's rate at least
    (α² + β²)^¼. The moves are of finite size, so that they show what a rounding really does next to the
    unstable equilibrium, where a derivative would give too much or too little.

    Returns
    -------
    list of float
        For each entry at the end, the sum over the moved entries of its change, divided by 2**-53.
    """
    scene, state, control = case
    base = reference.remembered(scene, state, control, dt)
    total = [0.0] * len(base)
    with mp.workdps(60):
        for j, value in enumerate(state):
            size = max(abs(value), _floor(case, j))
            if not size:
                continue
            moved = []
            for sign in (1, -1):
                start = [mpf(x) for x in state]
                start[j] += sign * ROUNDING * mpf(size)
                end = reference.exact_flow(scene, start, control, dt)
                moved.append([abs(a - b) for a, b in zip(end, base, strict=True)])
            for i, changes in enumerate(zip(*moved, strict=True)):
                total[i] += float(max(changes)) / ROUNDING
    return total


def _floor(case: Case, entry: int) -> float:
    scene, state, control = case
    if scene.state_units[entry] == "rad":
        return 1.0
    if scene.state_names[entry] == "theta_dot":
        _, coeffs = Stepped(scene).at(state, control)
        return math.sqrt(math.hypot(coeffs[0], coeffs[1]))
    return 0.0


def substeps(case: Case, dt: float) -> int:
    """Return how many substeps the step takes; negative if it is refused."""
    scene, state, control = case
    stepped = Stepped(scene, dt=dt)
    y = map(float, stepped.form.lift(np.asarray(state, dtype=np.float64)))
    advance = stepped.code().compile()
    *_, status = advance(*y, control, dt, stepped.largest_majorant(dt), *stepped.present())
    return int(status)


def built_case(extreme: Extreme) -> Case:
    """Return the case; the scene's own errors are raised."""
    scene: Scene = getattr(scenes, extreme.scene)(**extreme.parameters)
    return Case(scene, tuple(map(float, extreme.state)), extreme.control)


def measure_extreme(name: str) -> Row:
    """Take a case's step and return a row with its outcome.

    ``error`` is the largest error of an entry relative to its scale; ``amplification`` is the largest effect
    of a rounding relative to that scale; ``roundings`` is the largest error of an entry over the effect of
    one rounding of the start, or of the end itself. All three are None if the step was refused.
    """
    extreme = EXTREMES[name]
    row: Row = {"name": name, "scene": extreme.scene, "expected": extreme.expected, "dt": extreme.dt}
    row |= dict.fromkeys(("error", "amplification", "roundings", "substeps"))
    try:
        case = built_case(extreme)
        end = case.scene.simulate(case.state, [case.control], extreme.dt)[-1]
    except (StepRefused, ValueError) as error:
        outcome = REFUSED
        return row | {"outcome": outcome, "met": extreme.expected == outcome, "message": str(error)}
    row["substeps"] = substeps(case, extreme.dt)
    if extreme.expected == REFUSED:
        return row | {"outcome": "taken", "met": False, "message": ""}
    exact = reference.remembered(case.scene, case.state, case.control, extreme.dt)
    errors = [abs(e) for e in reference.state_differences(end, exact)]
    sizes, gains = scales(case, extreme.dt), amplification(case, extreme.dt)
    limits = [(EXACT * s, ROUNDINGS * ROUNDING * g) for s, g in zip(sizes, gains, strict=True)]
    row["error"] = max(e / s for e, s in zip(errors, sizes, strict=True))
    row["amplification"] = max(g / s for g, s in zip(gains, sizes, strict=True))
    ends = [max(g, float(abs(x))) for g, x in zip(gains, exact, strict=True)]
    row["roundings"] = max(e / (ROUNDING * size) if e else 0.0 for e, size in zip(errors, ends, strict=True))
    full = all(e <= plain for e, (plain, _) in zip(errors, limits, strict=True))
    allowed = all(e <= plain + more for e, (plain, more) in zip(errors, limits, strict=True))
    outcome = FULL if full else AMPLIFIED if allowed else "less accurate"
    met = full or (allowed and extreme.expected == AMPLIFIED)
    return row | {"outcome": outcome, "met": met, "message": ""}
