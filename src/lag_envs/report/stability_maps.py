"""The quantities that the stability maps vary, and the cases of their cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from lag_envs.report.cases import MAIN, VARIANTS, Case
from lag_envs.report.stepped import Stepped
from lag_envs.scenes.base import Scene


class StabilityMap(NamedTuple):
    """A quantity that is varied along with the step."""

    label: str
    scenes: Sequence[str]
    exponents: tuple[int, int]  #: of 10, first and last
    case: Callable[[str, float, float], Case]  #: of scene, value and dt


def _damped(name: str, decay: float, dt: float) -> Case:
    variant = VARIANTS[name]
    per_drag = _drag(variant.scene(damping=1.0))
    return Case(variant.scene(damping=decay / dt / per_drag), variant.start, variant.control)


def _drag(scene: Scene) -> float:
    """Return the rate at which drag alone would slow down the motion, without control [1/s]."""
    _, coefficients = Stepped(scene).at([0.0] * len(scene.state_names), 0.0)
    return float(coefficients.damping_rate)


def _undamped(name: str, *, speed: float | None = None, control: float | None = None, **changes: Any) -> Case:
    """Return a case that has a closed-form reference however far it moves."""
    variant = VARIANTS[name]
    state = variant.start if speed is None else (variant.start[0], speed, *variant.start[2:])
    return Case(variant.scene(damping=0.0, **changes), state, variant.control if control is None else control)


_BAR, _SHELL = [MAIN], ["CylinderInCylinder, drag"]
_SHELL_RADIUS = 0.5

MAPS = {
    "damping": StabilityMap("γ dt", list(VARIANTS), (-3, 6), _damped),
    "speed": StabilityMap("θ' [rad/s]", _BAR + _SHELL, (-2, 7), lambda name, v, dt: _undamped(name, speed=v)),
    "drive": StabilityMap("drive [m/s²]", _BAR, (0, 6), lambda name, u, dt: _undamped(name, control=u)),
    "gravity": StabilityMap("gravity [m/s²]", _BAR, (-3, 3), lambda name, g, dt: _undamped(name, gravity=g)),
    "length": StabilityMap(
        "length [m]", _BAR, (-8, 0), lambda name, length, dt: _undamped(name, com_distance=length)
    ),
    "arm": StabilityMap(
        "1 - r/R",
        _SHELL,
        (-9, -1),
        lambda name, x, dt: _undamped(name, shell_radius=_SHELL_RADIUS, radius=_SHELL_RADIUS * (1.0 - x)),
    ),
}
