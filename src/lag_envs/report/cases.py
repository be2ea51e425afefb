"""The scenes that the report measures, and random problems on them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from lag_envs.scenes import CylinderInCylinder, Incline, PivotedBar
from lag_envs.scenes.base import Scene


def _smaller_than_its_shell(drawn: dict[str, float]) -> None:
    if drawn["radius"] >= drawn["shell_radius"]:
        drawn["radius"] = 0.5 * drawn["shell_radius"]


class Variant(NamedTuple):
    """A scene with one kind of control, and the ranges that problems on it are drawn from."""

    name: str
    kind: type[Scene]
    parameters: dict[str, Any]
    dt: float  #: control step [s]
    state_range: Sequence[float]  #: bounds of the states, in the scene's units
    controls: tuple[float, float]
    start: tuple[float, ...]  #: of the stability maps; float32 holds its entries exactly
    control: float  #: of the stability maps
    typical: bool = False  #: whether libraries that are slow to compile or to run are measured on it too
    adjust: Callable[[dict[str, float]], None] = lambda drawn: None  #: makes drawn parameters fit together

    def scene(self, **changes: Any) -> Scene:
        """Return the scene, with other parameters if given."""
        return self.kind(**(self.parameters | changes))


#: With the tasks' damping, and wider ranges of states than tasks start from.
VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("PivotedBar", PivotedBar, {"damping": 0.001, "track": None}, 0.02,
                (math.pi, 12), (-5, 5), (2.0, 3.0), 3.0, typical=True),
        Variant("Incline, drag", Incline, {"tilt": math.pi / 12}, 0.02, (3, 3), (0, 6), (0.5, 2.0), 0.0),
        Variant("Incline, moving", Incline, {"damping": 0.03, "control": "tilt_rate"}, 0.05,
                (0.5, 1, 0.1), (-0.3, 0.3), (0.25, 1.0, 0.125), 0.25, typical=True),
        Variant("CylinderInCylinder, drag", CylinderInCylinder, {"control": "damping"}, 0.02,
                (1.3, 5), (0, 2.4), (1.0, 3.0), 0.0, adjust=_smaller_than_its_shell),
        Variant("CylinderInCylinder, tilt", CylinderInCylinder, {"damping": 0.024}, 0.05,
                (1.3, 5, 6), (-15, 15), (1.0, 3.0, 1.0), 3.0, typical=True, adjust=_smaller_than_its_shell),
    )
}  # fmt: skip
#: The variant of quick reports, and of measurements that are made on a single one.
MAIN = "PivotedBar"


class Case(NamedTuple):
    """A start on a scene, and a constant control."""

    scene: Scene
    state: tuple[float, ...]
    control: float


def ensemble(name: str, n: int, seed: int = 0, *, vary: bool = True) -> list[Case]:
    """Return n random problems on a variant: states and controls uniform in its ranges.

    Parameters
    ----------
    name : str
        Name of the variant.
    n, seed : int
        Number of problems, and the seed of their sequence; a longer ensemble begins with the shorter one.
    vary : bool, default True
        Multiply every parameter that is not zero by a factor between 1/2 and 2, log-uniform.

    Examples
    --------
    >>> [case.state for case in ensemble("PivotedBar", 2, seed=1)] == [
    ...     case.state for case in ensemble("PivotedBar", 3, seed=1)[:2]
    ... ]
    True
    """
    variant = VARIANTS[name]
    base = variant.scene()
    cases = []
    for i in range(n):
        rng = np.random.default_rng([seed, i])
        state = tuple(float(rng.uniform(-s, s)) for s in variant.state_range)
        control = float(rng.uniform(*variant.controls))
        changes = {}
        for field in dataclasses.fields(base):  # type: ignore[arg-type]
            value = getattr(base, field.name)
            if vary and "unit" in field.metadata and value and field.name != "inertia":
                changes[field.name] = value * 2.0 ** float(rng.uniform(-1, 1))
        if changes:
            variant.adjust(changes)
        cases.append(Case(variant.scene(**changes), state, control))
    return cases


def scales(case: Case, dt: float) -> list[float]:
    """Return the size by which each state entry's error is divided, as docs/numerics.md defines accuracy.

    The size is max(1, |q|, |q'| dt) for angles and lengths, and max(1, |q'|, the field's contribution) for
    their rates.
    """
    from lag_envs.report.flow_equations import EQUATIONS
    from lag_envs.report.stepped import Stepped

    scene, state, u = case
    variables, coefficients = Stepped(scene).at(state, u)
    q, v = map(float, variables[:2])
    gain = EQUATIONS[type(coefficients)].field(coefficients, scene, dt)
    place, rate = max(1.0, abs(q), abs(v) * dt), max(1.0, abs(v), gain)
    return [rate if unit.endswith("/s") else place for unit in scene.state_units]
