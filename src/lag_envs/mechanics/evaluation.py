"""Numbers of a derived motion: accelerations, forces, powers and derivatives, for one state or many.

The same code runs on arrays and on `DualArray` numbers, which carry derivatives along.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from lag_envs.mechanics.algebra import Atom, Expr, evaluate
from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.motion import Mechanics
from lag_envs.mechanics.recording import control, parameter


class Numeric:
    """The namespace ``xp`` of a formula on arrays: the functions that recorded formulas have."""

    pi = math.pi
    sin, cos, tan, exp, log, sqrt, tanh = np.sin, np.cos, np.tan, np.exp, np.log, np.sqrt, np.tanh
    atan = arctan = np.arctan


class Exact:
    """Functions of rational numbers; sums and products are exact, so cancellation loses nothing."""

    Rational, mpf, pi = Fraction, None, Fraction(math.pi)

    def __init__(self, functions: Any = math) -> None:
        self._functions = functions

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._functions, "atan" if name == "arctan" else name)
        return lambda x: Fraction(found(float(x)))


def exactly(parameters: Mapping[str, float]) -> dict[Atom, Any]:
    """Return the parameters' values by symbol, as fractions, so that `evaluate` rounds results once."""
    return {
        parameter(name): Fraction(value) if math.isfinite(value) else np.float64(value)
        for name, value in parameters.items()
    }


def _bare(x: Any) -> Any:
    return x.value if isinstance(x, LaneArray) else x


def _binary(f: Any) -> tuple[Any, Any]:
    return lambda a, b: LaneArray(f(_bare(a), _bare(b))), lambda a, b: LaneArray(f(_bare(b), _bare(a)))


def _on_lanes(f: Any) -> Any:
    return staticmethod(lambda x: LaneArray(f(_bare(x))))


class LaneArray:
    """An array that a formula takes for a single number, even if it builds arrays of its numbers."""

    __slots__ = ("value",)
    __array_ufunc__ = None  # NumPy's numbers leave arithmetic to this class

    def __init__(self, value: Any) -> None:
        self.value = np.asarray(value, dtype=np.float64)

    __add__, __radd__ = _binary(operator.add)
    __sub__, __rsub__ = _binary(operator.sub)
    __mul__, __rmul__ = _binary(operator.mul)
    __truediv__, __rtruediv__ = _binary(operator.truediv)
    __pow__, __rpow__ = _binary(operator.pow)

    def __neg__(self) -> LaneArray:
        return LaneArray(-self.value)

    def __pos__(self) -> LaneArray:
        return self


class LaneArrayFunctions:
    """The functions of `Numeric` on `LaneArray`."""

    pi = math.pi
    sin, cos, tan = (_on_lanes(f) for f in (np.sin, np.cos, np.tan))
    exp, log, sqrt, tanh = (_on_lanes(f) for f in (np.exp, np.log, np.sqrt, np.tanh))
    atan = arctan = _on_lanes(np.arctan)


class DualArray:
    """A number with its derivatives: ``value`` of shape (...), ``slope`` of shape (..., n)."""

    __slots__ = ("slope", "value")
    __array_ufunc__ = None  # NumPy's numbers leave arithmetic to this class

    def __init__(self, value: Any, slope: Any) -> None:
        self.value, self.slope = np.asarray(value, dtype=np.float64), slope

    def __add__(self, other: Any) -> DualArray:
        if isinstance(other, DualArray):
            return DualArray(self.value + other.value, self.slope + other.slope)
        return DualArray(self.value + other, self.slope)

    __radd__ = __add__

    def __mul__(self, other: Any) -> DualArray:
        if isinstance(other, DualArray):
            slope = self.value[..., None] * other.slope + other.value[..., None] * self.slope
            return DualArray(self.value * other.value, slope)
        factor = np.asarray(other, dtype=np.float64)  # larger whole numbers would make objects
        return DualArray(self.value * factor, factor[..., None] * self.slope)

    __rmul__ = __mul__

    def __sub__(self, other: Any) -> DualArray:
        return self + -1.0 * other

    def __rsub__(self, other: Any) -> DualArray:
        return -1.0 * self + other

    def __truediv__(self, other: Any) -> DualArray:
        value, divisor = _parts(self), _parts(other)
        quotient = value[0] / divisor[0]
        return DualArray(quotient, (value[1] - quotient[..., None] * divisor[1]) / divisor[0][..., None])

    def __rtruediv__(self, other: Any) -> DualArray:
        quotient = _parts(other)[0] / self.value
        return DualArray(quotient, -(quotient / self.value)[..., None] * self.slope)


def _parts(x: Any) -> tuple[Any, Any]:
    """Return value and slope of any number."""
    return (x.value, x.slope) if isinstance(x, DualArray) else (np.asarray(x, dtype=np.float64), 0.0)


#: The derivative of each function, from its argument, its value, and the functions.
RATES: Mapping[str, Callable[[Any, Any, Any], Any]] = {
    "sin": lambda x, y, xp: xp.cos(x),
    "cos": lambda x, y, xp: -xp.sin(x),
    "exp": lambda x, y, xp: y,
    "log": lambda x, y, xp: 1.0 / x,
    "sqrt": lambda x, y, xp: 0.5 / y,
    "atan": lambda x, y, xp: 1.0 / (1.0 + x * x),
    "tanh": lambda x, y, xp: _slope_of_tanh(x, xp),
}


def _slope_of_tanh(x: Any, xp: Any) -> Any:
    """Return 1 - tanh², with all digits even where tanh is nearly 1."""
    fading = xp.exp(-2.0 * abs(x))
    grown = 1.0 + fading
    return 4.0 * fading / (grown * grown)


def _carried(name: str) -> Any:
    function, rate = getattr(Numeric, name), RATES[name]

    def of(x: Any) -> Any:
        if not isinstance(x, DualArray):
            return function(x)
        y = function(x.value)
        return DualArray(y, rate(x.value, y, Numeric)[..., None] * x.slope)

    return staticmethod(of)


class DualArrayFunctions:
    """The functions of `Numeric` on `DualArray` numbers."""

    sin, cos, exp, log, sqrt, atan, tanh = map(_carried, RATES)
    arctan = atan


def eliminated(matrix: Sequence[Sequence], right: Sequence) -> list:
    """Solve a small linear system by elimination without pivoting, on numbers of any kind."""
    n = range(len(right))
    a, b = [list(row) for row in matrix], list(right)
    for i in n:
        for j in range(i + 1, len(n)):
            factor = a[j][i] / a[i][i]
            a[j] = [x - factor * y for x, y in zip(a[j], a[i], strict=True)]
            b[j] = b[j] - factor * b[i]
    for i in reversed(n):
        for j in range(i + 1, len(n)):
            b[i] = b[i] - a[i][j] * b[j]
        b[i] = b[i] / a[i][i]
    return b


class MotionPoint:
    """A motion at given states under given controls.

    Attributes
    ----------
    values : dict from Atom to number
        Numbers for all symbols of the derived expressions.
    acceleration : dict from str to number
        Accelerations of all coordinates.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        parameters: Mapping[Atom, float],
        state: Sequence,
        controls: Sequence,
        xp: Any,
    ) -> None:
        """Compute velocities and accelerations.

        Parameters
        ----------
        mechanics : Mechanics
            The derived motion.
        parameters : mapping from Atom to float
            The parameters' values.
        state, controls : sequence of numbers
            The entries: numbers, arrays that broadcast, or `DualArray` numbers.
        xp : namespace
            Functions for these numbers.
        """
        self.mechanics, self.xp = mechanics, xp
        layout = mechanics.layout
        self.values: dict[Atom, Any] = dict(parameters)
        self.values |= {control(name): x for name, x in zip(layout.controls, controls, strict=True)}
        for name, level, by in layout.prescribed:
            moves = self.values.get(control(by), 0.0)
            rest = mechanics.record.rests.get(name, Expr({})) if level == "rest" else Expr({})
            self.values[place(name)] = moves if level == "place" else self.of([rest])[0]
            self.values[velocity(name)] = moves if level == "rate" else 0.0
        for name in layout.free:
            self.values[place(name)] = self.values[velocity(name)] = 0.0
        carried = {}
        for entry, x in zip(layout.state, state, strict=True):
            if entry.kind == "momentum":
                carried[entry.coordinate] = x
            else:
                self.values[(place if entry.kind == "place" else velocity)(entry.coordinate)] = x
        self.mass = self.of(mechanics.entries())
        if carried:
            self.shift = self.solve(self._drive(mechanics.coupling))
            for name, k in zip(layout.free, self.shift, strict=True):
                self.values[velocity(name)] = carried[name] - k
        free = self.solve(self.of(mechanics.force))
        self.acceleration = dict(zip(layout.free, free, strict=True))
        for name, level, by in layout.prescribed:
            self.acceleration[name] = self.values[control(by)] if level == "acceleration" else 0.0

    def of(self, exprs: Sequence[Expr]) -> list:
        """Evaluate expressions."""
        return evaluate(exprs, self.values, self.xp)

    def _drive(self, coupling: Mapping[tuple[int, str], Expr]) -> list:
        """Return Σ_m coupling[i, m] ṡ_m for each free coordinate i."""
        total: list[Any] = [0.0] * len(self.mechanics.free)
        for (i, m), value in zip(coupling, self.of(list(coupling.values())), strict=True):
            total[i] = total[i] + value * self.values[velocity(m)]
        return total

    def solve(self, right: Sequence) -> list:
        """Return M⁻¹ times a column; only states with a singular M get numbers that are not finite."""
        n = len(right)
        return eliminated([self.mass[n * i : n * (i + 1)] for i in range(n)], right)

    # --- results -------------------------------------------------------------------------------------------

    def rates(self) -> list:
        """Return the time derivatives of the state's entries."""
        drift: dict[str, Any] = {}
        layout = self.mechanics.layout
        if any(entry.kind == "momentum" for entry in layout.state):
            # M k = Σ G ṡ with ṡ held, so M k' = Σ G' ṡ - M' k.
            turned = self.of(self.mechanics.mass_rate)
            n = range(len(layout.free))
            right = self._drive(self.mechanics.coupling_rate)
            right = [
                r - sum(turned[len(n) * i + j] * self.shift[j] for j in n)
                for i, r in zip(n, right, strict=True)
            ]
            drift = dict(zip(layout.free, self.solve(right), strict=True))
        rates = []
        for entry in layout.state:
            name = entry.coordinate
            if entry.kind == "place":
                rates.append(self.values[velocity(name)])
            else:
                rates.append(self.acceleration[name] + drift.get(name, 0.0))
        return rates

    def force(self, names: Sequence[str]) -> list:
        """Return the forces that move or hold prescribed coordinates."""
        full = self.mechanics.full
        rows = [full.coordinates.index(name) for name in names]
        columns = range(len(full.coordinates))
        entries = self.of([full.entry(i, j) for i in rows for j in columns])
        forces = []
        for r, right in enumerate(self.of([full.force[i] for i in rows])):
            total = -1.0 * right
            for j, name in enumerate(full.coordinates):
                total = total + entries[r * len(columns) + j] * self.acceleration[name]
            forces.append(total)
        return forces

    def power(self) -> dict[str, Any]:
        """Return the powers of drive and applied forces, and the power lost to drag [W]."""
        layout = self.mechanics.layout
        carried = [
            p.name for p in layout.at("acceleration", "rate") if f"{p.name}_dot" not in layout.left_out
        ]
        moving = [*layout.free, *carried]
        speeds = [self.values[velocity(name)] for name in moving]
        drive = sum(f * self.values[velocity(m)] for m, f in zip(carried, self.force(carried), strict=True))
        for m in (p.name for p in layout.at("acceleration") if p.name not in carried):
            # If the rate of a coordinate is left out, its acceleration acts as a field in the coordinate's
            # frame.
            full = self.mechanics.full
            row = full.coordinates.index(m)
            fields = self.of([full.entry(full.coordinates.index(name), row) for name in moving])
            drive = drive - self.acceleration[m] * sum(g * v for g, v in zip(fields, speeds, strict=True))
        applied = self.of([self.mechanics.applied.get(name, Expr({})) for name in moving])
        drag = self.of([self.mechanics.drag[name] for name in moving])
        return {
            "drive": drive,
            "applied": sum(f * v for f, v in zip(applied, speeds, strict=True)),
            "drag": sum(f * v for f, v in zip(drag, speeds, strict=True)),
        }

    def weight(self, name: str) -> Any:
        """Return the largest size of the potential's force on a coordinate over all angles."""
        return sum(abs(x) for x in self.of(self.mechanics.weight(name)))
