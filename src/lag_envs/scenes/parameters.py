"""How a scene declares its parameters, the check of their ranges, and what their units say."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from lag_envs.mechanics.algebra import FormulaError
from lag_envs.mechanics.recording import formula, parameter_values
from lag_envs.scenes.checks import SMALLEST, check_number, shown

#: Units as powers of kilogram, metre and second.
UNITS = {
    "kg": (1, 0, 0), "m": (0, 1, 0), "s": (0, 0, 1), "N": (1, 1, -2), "J": (1, 2, -2), "W": (1, 2, -3),
    "rad": (0, 0, 0), "1": (0, 0, 0),
}  # fmt: skip


def parameter(
    default: float | Callable[[Any], float | None] | None,
    unit: str,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    usable: tuple[float, float] = (-math.inf, math.inf),
    optional: bool = False,
    endless: bool = False,
) -> Any:
    """Declare a physical parameter.

    Parameters
    ----------
    default : float, None, or function of the scene
        The default value. A function computes it from the other parameters:
        ``lambda bar: bar.mass * bar.com_distance**2 / 3``.
    unit : str
        Its unit, for tables and error messages.
    above, least, below, most : float, optional
        Its range: a value must be above `above`, at least `least`, below `below` and at most `most`.
    usable : (float, float)
        The range in which an environment is usable, whatever its other parameters; see `Task.usable`. The
        scene alone may be stepped beyond it.
    optional : bool
        Whether None is allowed; a default of None implies it.
    endless : bool
        Whether infinity is allowed.
    """
    if not isinstance(unit, str):
        raise FormulaError(
            'the unit of a parameter must be text, as in parameter(1.0, "kg"), or "1" for a pure number, got '
            f"{unit!r:.60}"
        )
    for name, limit in {"above": above, "least": least, "below": below, "most": most}.items():
        if not (limit is None or isinstance(limit, int | float | np.number)):
            raise FormulaError(f"{name} of a parameter must be a number, as in {name}=0.0, got {limit!r:.60}")
    lows, highs = {"above": above, "at least": least}, {"below": below, "at most": most}
    for (low, bottom), (high, top) in itertools.product(lows.items(), highs.items()):
        strict = low == "above" or high == "below"
        if bottom is not None and top is not None and (bottom > top or (strict and bottom == top)):
            raise FormulaError(
                f"the range of a parameter is empty: no value is {low} {bottom:g} and {high} {top:g}"
            )
    if usable[0] > usable[1]:
        raise FormulaError(f"usable must be (lowest, highest), in this order, got {usable!r}")
    made = callable(default)
    return dataclasses.field(
        default=None if made else default,
        metadata={
            "unit": unit,
            "above": above,
            "least": least,
            "below": below,
            "most": most,
            "made": default if made else None,
            "optional": optional or (default is None),
            "endless": endless,
            "usable": usable,
        },
    )


def fill_in(scene: Any) -> None:
    """Check that the parameters of a new scene are in range, and compute those that follow from others."""
    fields = {f.name: f for f in dataclasses.fields(scene) if "unit" in f.metadata}
    made = [f for f in fields.values() if f.metadata["made"] and getattr(scene, f.name) is None]
    for field in (*(f for f in fields.values() if f not in made), *made):
        value = getattr(scene, field.name)
        if field in made:
            others = [f.name for f in dataclasses.fields(scene) if f is not field]
            waiting = [f.name for f in made[made.index(field) :]]
            with formula(scene, field.name, others):
                value = field.metadata["made"](_Known(scene, waiting))
            value = None if value is None else _check_made(field, value)
        elif value is not None or not field.metadata["optional"]:
            value = _check_range(field, value)
        object.__setattr__(scene, field.name, value)
    for other in dataclasses.fields(scene):
        value = getattr(scene, other.name)
        if type(other.default) is bool and not isinstance(value, bool | np.bool_):
            raise ValueError(f"{other.name} must be True or False, got {shown(value)}")


class _Known:
    """A scene some of whose parameters have no value yet."""

    def __init__(self, scene: Any, waiting: list[str]) -> None:
        self._scene, self._waiting = scene, waiting

    def __getattr__(self, name: str) -> Any:
        if name in self._waiting:
            raise FormulaError(f"it uses {name}, which is computed later; declare {name} first")
        return getattr(self._scene, name)


def _check_range(field: dataclasses.Field, value: Any) -> float:
    unit = field.metadata["unit"]
    shown = _shown_unit(field)
    number = check_number(field.name, value, unit, endless=field.metadata["endless"])
    above = field.metadata["above"]
    for rule, limit, broken in (
        *_rules(field, number),
        ("at least", SMALLEST, above == 0.0 and number < SMALLEST),
        ("at most", 1.0 / SMALLEST, math.isfinite(number) and number > 1.0 / SMALLEST),
    ):
        if broken:
            raise ValueError(f"{field.name} must be {rule} {limit:g}{shown}, got {number:g}{shown}")
    return number


def _check_made(field: dataclasses.Field, value: Any) -> float:
    """Return a value computed from other parameters; it may be smaller or larger than a given one may be."""
    shown, number = _shown_unit(field), check_number(field.name, value)
    for rule, limit, broken in _rules(field, number):
        if broken:
            raise ValueError(
                f"{field.name} must be {rule} {limit:g}{shown}, but follows as {number:g}{shown} from the "
                "other parameters"
            )
    return number


def _shown_unit(field: dataclasses.Field) -> str:
    """Return a parameter's unit as it is written after a number."""
    unit = field.metadata["unit"]
    return "" if unit in ("", "1") else f" {unit}"


def _rules(field: dataclasses.Field, number: float) -> list[tuple[str, Any, bool]]:
    """Return for each end of the declared range its rule and limit, and whether the number breaks it."""
    above, least, below, most = (field.metadata[key] for key in ("above", "least", "below", "most"))
    return [
        ("above", above, above is not None and not number > above),
        ("at least", least, least is not None and not number >= least),
        ("below", below, below is not None and not number < below),
        ("at most", most, most is not None and not number <= most),
    ]


def natural_size(scene: Any, name: str) -> float:
    """Return the size that a parameter's unit suggests in a scene; 0 if it suggests none.

    The scene's largest mass, its largest length, and the time √(length / gravity), or a second without
    gravity, take the place of kilogram, metre and second.

    Examples
    --------
    >>> from lag_envs.scenes import Pendulum
    >>> natural_size(Pendulum(mass=2.0, length=3.0, gravity=12.0), "damping")  # 2 kg (3 m)² / 0.5 s
    36.0
    """
    fields, largest = type(scene).__dataclass_fields__, {"kg": 0.0, "m": 0.0, "m/s²": 0.0}
    for other, value in parameter_values(scene).items():
        unit = fields[other].metadata["unit"]
        if unit in largest and math.isfinite(value):
            largest[unit] = max(largest[unit], value)
    mass, length, gravity = largest.values()
    powers = _powers(fields[name].metadata["unit"])
    time = math.sqrt(length / gravity) if gravity else 1.0
    if powers is None or any(n and not x for x, n in zip((mass, length, time), powers, strict=True)):
        return 0.0
    return mass ** powers[0] * length ** powers[1] * time ** powers[2]


def _powers(unit: str) -> list[int] | None:
    """Return a unit as powers of kilogram, metre and second; None for an unknown one."""
    total, (above, *below) = [0, 0, 0], unit.split("/")
    for text, sign in ((above, 1), *((text, -1) for text in below)):
        for word in text.split():
            power = {"²": 2, "³": 3}.get(word[-1], 1)
            if (known := UNITS.get(word.rstrip("²³"))) is None:
                return None
            total = [n + sign * power * m for n, m in zip(total, known, strict=True)]
    return total
