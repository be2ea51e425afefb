"""Numbers that carry first and second derivatives along, for the formulas of tasks.

Formulas of tasks may have kinks, by `abs`, `minimum`, `maximum` and `where`. They are expanded as what moving the variables
by `WIDTH` makes of them: a secant and a second difference. Away from the kink both are exact; near it a
planner sees how the slope changes, not only on which side it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

#: How far variables are moved where a kink is expanded.
WIDTH = 5e-3


class Quadratic:
    """A number to second order: ``value`` (...), ``slope`` (..., m) and ``curvature`` (..., m, m).

    Examples
    --------
    >>> x = Quadratic.variable(np.array(3.0), 0, 1)
    >>> y = x * x + 1.0 / x
    >>> y.value.item(), y.slope.round(3).item(), y.curvature.round(3).item()
    (9.333333333333334, 5.889, 2.074)
    """

    __slots__ = ("curvature", "slope", "value")
    __array_ufunc__ = None  # NumPy's numbers leave arithmetic to this class

    def __init__(self, value: Any, slope: Any, curvature: Any) -> None:
        self.value, self.slope, self.curvature = np.asarray(value), slope, curvature

    @classmethod
    def variable(cls, value: Any, i: int, m: int) -> Quadratic:
        """Return the variable i of m."""
        return cls(value, np.eye(m)[i], np.zeros((m, m)))

    def _lifted(self, other: Any) -> Quadratic:
        if isinstance(other, Quadratic):
            return other
        m = self.slope.shape[-1]
        return Quadratic(np.asarray(other, dtype=np.float64), np.zeros(m), np.zeros((m, m)))

    def __add__(self, other: Any) -> Quadratic:
        b = self._lifted(other)
        return Quadratic(self.value + b.value, self.slope + b.slope, self.curvature + b.curvature)

    __radd__ = __add__

    def __neg__(self) -> Quadratic:
        return Quadratic(-self.value, -self.slope, -self.curvature)

    def __pos__(self) -> Quadratic:
        return self

    def __sub__(self, other: Any) -> Quadratic:
        return self + -1.0 * other

    def __rsub__(self, other: Any) -> Quadratic:
        return -self + other

    def __mul__(self, other: Any) -> Quadratic:
        if not isinstance(other, Quadratic):
            b = np.asarray(other, dtype=np.float64)
            return Quadratic(
                self.value * b, self.slope * b[..., None], self.curvature * b[..., None, None]
            )
        a, b = self.value[..., None], other.value[..., None]
        cross = self.slope[..., :, None] * other.slope[..., None, :]
        curvature = a[..., None] * other.curvature + b[..., None] * self.curvature
        return Quadratic(
            self.value * other.value,
            a * other.slope + b * self.slope,
            curvature + cross + np.swapaxes(cross, -1, -2),
        )

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Quadratic:
        return self * (1.0 / other if isinstance(other, Quadratic) else 1.0 / np.asarray(other))

    def __rtruediv__(self, other: Any) -> Quadratic:
        y = 1.0 / self.value
        return self.through(y, -y * y, 2.0 * y * y * y) * other

    def __pow__(self, n: Any) -> Quadratic:
        x = self.value
        return self.through(x**n, n * x ** (n - 1.0), n * (n - 1.0) * x ** (n - 2.0))

    def __abs__(self) -> Quadratic:
        x = self.value
        w = self._reach()
        up, down = np.abs(x + w), np.abs(x - w)
        return self.through(np.abs(x), (up - down) / (2.0 * w), (up + down - 2.0 * np.abs(x)) / (w * w))

    def __lt__(self, other: Any) -> Condition:
        return (other - self)._positive(strictly=True)

    def __gt__(self, other: Any) -> Condition:
        return (self - other)._positive(strictly=True)

    def __le__(self, other: Any) -> Condition:
        return (other - self)._positive(strictly=False)

    def __ge__(self, other: Any) -> Condition:
        return (self - other)._positive(strictly=False)

    def _positive(self, *, strictly: bool) -> Condition:
        return Condition(self.value > 0.0 if strictly else self.value >= 0.0, np.abs(self.value) < self._reach())

    def _reach(self) -> Any:
        """Return how far the value comes where the variables are moved."""
        return np.maximum(WIDTH * np.sqrt(np.sum(self.slope * self.slope, axis=-1)), 1e-150)

    def through(self, value: Any, first: Any, second: Any) -> Quadratic:
        """Return a function of this number, from its value and two derivatives."""
        square = self.slope[..., :, None] * self.slope[..., None, :]
        first, second = np.asarray(first), np.asarray(second)
        curvature = first[..., None, None] * self.curvature + second[..., None, None] * square
        return Quadratic(value, first[..., None] * self.slope, curvature)


def differences(formula: Callable, variables: Sequence[Quadratic]) -> list[Quadratic]:
    """Expand what a formula returns about its variables by central differences of `WIDTH`.

    So much of a kink is seen as within that reach, and of slopes that change as fast only their mean.

    Parameters
    ----------
    formula : callable
        Takes an array per variable, with any number of axes in front, and returns a list of such arrays.
    variables : sequence of Quadratic
        All of the variables, in order.
    """
    m = len(variables)
    i, j = np.triu_indices(m, 1)
    moves = np.zeros((1 + 2 * m + 2 * len(i), m))
    moves[1 : m + 1], moves[m + 1 : 2 * m + 1] = WIDTH * np.eye(m), -WIDTH * np.eye(m)
    moves[2 * m + 1 :: 2] = moves[1 + i] + moves[1 + j]
    moves[2 * m + 2 :: 2] = -moves[2 * m + 1 :: 2]
    found = []
    for values in formula(*(x.value + moves[:, column, None] for column, x in enumerate(variables))):
        values = np.moveaxis(np.broadcast_to(values, (len(moves), *variables[0].value.shape)), 0, -1)
        middle, plus, minus = values[..., :1], values[..., 1 : m + 1], values[..., m + 1 : 2 * m + 1]
        own = plus + minus - 2.0 * middle
        both = values[..., 2 * m + 1 :: 2] + values[..., 2 * m + 2 :: 2] - 2.0 * middle
        curvature = np.empty((*own.shape, m))
        curvature[..., range(m), range(m)] = own
        curvature[..., i, j] = curvature[..., j, i] = 0.5 * (both - own[..., i] - own[..., j])
        found.append(Quadratic(middle[..., 0], (plus - minus) / (2.0 * WIDTH), curvature / WIDTH**2))
    return found


class Condition:
    """Whether a comparison holds, and whether moving the variables may change that."""

    def __init__(self, holds: Any, near: Any = False) -> None:
        self.holds, self.near = np.asarray(holds), np.asarray(near)

    def _joined(self, other: Any, how: Callable) -> Condition:
        b = other if isinstance(other, Condition) else Condition(other)
        return Condition(how(self.holds, b.holds), self.near | b.near)

    def __or__(self, other: Any) -> Condition:
        return self._joined(other, np.logical_or)

    def __and__(self, other: Any) -> Condition:
        return self._joined(other, np.logical_and)

    __ror__, __rand__ = __or__, __and__

    def __invert__(self) -> Condition:
        return Condition(~self.holds, self.near)


def _function(value: Callable, first: Callable, second: Callable) -> Any:
    """Return a function of numbers of both kinds; its derivatives are given by x and by its value y."""

    def of(x: Any) -> Any:
        if not isinstance(x, Quadratic):
            return value(x)
        y = value(x.value)
        return x.through(y, first(x.value, y), second(x.value, y))

    return staticmethod(of)


class QuadraticFunctions:
    """The namespace ``xp`` of a task's formula on `Quadratic` numbers."""

    pi = math.pi
    sin = _function(np.sin, lambda x, y: np.cos(x), lambda x, y: -y)
    cos = _function(np.cos, lambda x, y: -np.sin(x), lambda x, y: -y)
    tan = _function(np.tan, lambda x, y: 1.0 + y * y, lambda x, y: 2.0 * y * (1.0 + y * y))
    exp = _function(np.exp, lambda x, y: y, lambda x, y: y)
    log = _function(np.log, lambda x, y: 1.0 / x, lambda x, y: -1.0 / (x * x))
    # At 0 as to the left of it, where formulas keep the argument from falling below.
    sqrt = _function(
        np.sqrt,
        lambda x, y: np.divide(0.5, y, out=np.zeros_like(y), where=y > 0.0),
        lambda x, y: np.divide(-0.25, x * y, out=np.zeros_like(y), where=x * y > 0.0),
    )
    atan = arctan = _function(
        np.arctan, lambda x, y: 1.0 / (1.0 + x * x), lambda x, y: -2.0 * x / (1.0 + x * x) ** 2
    )
    tanh = _function(np.tanh, lambda x, y: 1.0 - y * y, lambda x, y: -2.0 * y * (1.0 - y * y))
    abs = staticmethod(abs)

    @staticmethod
    def minimum(a: Any, b: Any) -> Any:
        """Return the smaller one."""
        return 0.5 * (a + b - abs(a - b))

    @staticmethod
    def maximum(a: Any, b: Any) -> Any:
        """Return the larger one."""
        return 0.5 * (a + b + abs(a - b))

    @staticmethod
    def where(condition: Any, a: Any, b: Any) -> Any:
        """Select elementwise; near the border as (a + b ± |a - b|)/2, which sees a kink there."""
        given = condition if isinstance(condition, Condition) else Condition(condition)
        known = a if isinstance(a, Quadratic) else b
        if not isinstance(known, Quadratic):
            return np.where(given.holds, a, b)
        a, b = known._lifted(a), known._lifted(b)
        chosen = _select(given.holds, a, b)
        if not given.near.any():
            return chosen
        off = a - b
        sign = np.sign(off.value) * np.where(given.holds, 1.0, -1.0)
        return _select(given.near, 0.5 * (a + b + sign * abs(off)), chosen)


def _select(condition: Any, a: Quadratic, b: Quadratic) -> Quadratic:
    return Quadratic(
        np.where(condition, a.value, b.value),
        np.where(condition[..., None], a.slope, b.slope),
        np.where(condition[..., None, None], a.curvature, b.curvature),
    )
