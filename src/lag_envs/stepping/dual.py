"""Derivatives of a step: the same algorithm on numbers that carry derivatives along.

A dual number is a value with one derivative per column; None stands for a derivative that is zero. `Dual`
makes a target of such numbers from a target of plain ones, so that every recurrence stands once. It takes
what `Series.expand` and `Series.advance` need, not what the certificate does: comparisons have no derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lag_envs.stepping.lowering import SeriesRecord


class Number(NamedTuple):
    """A value and its derivatives."""

    value: Any
    slopes: tuple[Any, ...]


class Dual:
    """Dual numbers on a target of plain ones.

    Parameters
    ----------
    target : Target
        The plain numbers; its memory has `columns` + 1 slots for each slot here.
    columns : int
        Number of derivatives.
    tangents : mapping
        For each input that has a derivative its column.
    """

    def __init__(self, target: Any, columns: int, tangents: Mapping[str, int]) -> None:
        self._t, self._columns, self._tangents = target, columns, tangents
        self._flat = (None,) * columns

    def number(self, value: float) -> Number:
        return Number(self._t.number(value), self._flat)

    def plain(self, value: Any) -> Number:
        """Return a plain number as one without derivatives."""
        return Number(value, self._flat)

    def _map(self, change: Callable, *slopes: Sequence) -> tuple:
        return tuple(change(*column) for column in zip(*slopes, strict=True))

    def _sum(self, a: Any, b: Any) -> Any:
        return b if a is None else a if b is None else self._t.add(a, b)

    def add(self, a: Number, b: Number) -> Number:
        return Number(self._t.add(a.value, b.value), self._map(self._sum, a.slopes, b.slopes))

    def neg(self, a: Number) -> Number:
        return Number(
            self._t.neg(a.value), self._map(lambda s: None if s is None else self._t.neg(s), a.slopes)
        )

    def sub(self, a: Number, b: Number) -> Number:
        t = self._t

        def less(p: Any, q: Any) -> Any:
            return p if q is None else t.neg(q) if p is None else t.sub(p, q)

        return Number(t.sub(a.value, b.value), self._map(less, a.slopes, b.slopes))

    def _times(self, p: Any, y: Any, total: Any) -> Any:
        """Return p y + total, where p and total may be zero."""
        if p is None:
            return total
        return self._t.mul(p, y) if total is None else self._t.fma(p, y, total)

    def mul(self, a: Number, b: Number) -> Number:
        slopes = self._map(
            lambda p, q: self._times(p, b.value, self._times(q, a.value, None)), a.slopes, b.slopes
        )
        return Number(self._t.mul(a.value, b.value), slopes)

    def fma(self, a: Number, b: Number, c: Number) -> Number:
        slopes = self._map(
            lambda p, q, r: self._times(p, b.value, self._times(q, a.value, r)), a.slopes, b.slopes, c.slopes
        )
        return Number(self._t.fma(a.value, b.value, c.value), slopes)

    def div(self, a: Number, b: Number) -> Number:
        t = self._t
        value = t.div(a.value, b.value)

        def slope(p: Any, q: Any) -> Any:
            rest = self._times(q, t.neg(value), p)
            return None if rest is None else t.div(rest, b.value)

        return Number(value, self._map(slope, a.slopes, b.slopes))

    def _chain(self, value: Any, rate: Any, a: Number) -> Number:
        return Number(value, self._map(lambda p: self._times(p, rate, None), a.slopes))

    def sqrt(self, a: Number) -> Number:
        t = self._t
        root = t.sqrt(a.value)
        return self._chain(root, t.div(t.number(0.5), root), a)

    def less(self, a: Number, b: Number) -> Any:
        return self._t.less(a.value, b.value)

    def both(self, a: Any, b: Any) -> Any:
        return self._t.both(a, b)

    def real(self, k: Any) -> Number:
        return self.plain(self._t.real(k))

    def reciprocal(self, k: Any) -> Number:
        return self.plain(self._t.reciprocal(k))

    def index(self, k: int) -> Any:
        return self._t.index(k)

    def half(self, k: Any) -> Any:
        return self._t.half(k)

    def plus(self, k: Any, n: int) -> Any:
        return self._t.plus(k, n)

    def minus(self, a: Any, b: Any) -> Any:
        return self._t.minus(a, b)

    def load(self, slot: int, k: Any) -> Number:
        first = slot * (self._columns + 1)
        value, *slopes = (self._t.load(first + i, k) for i in range(self._columns + 1))
        return Number(value, tuple(slopes))

    def store(self, slot: int, k: Any, value: Number) -> None:
        first = slot * (self._columns + 1)
        for i, number in enumerate((value.value, *value.slopes)):
            self._t.store(first + i, k, self._t.number(0.0) if number is None else number)

    def loop(
        self, first: Any, end: Any, carried: Sequence[Number], body: Callable, step: int = 1
    ) -> list[Number]:
        width = self._columns + 1

        def flatten(values: Sequence[Number]) -> list:
            zero = self._t.number(0.0)
            return [zero if x is None else x for v in values for x in (v.value, *v.slopes)]

        def gather(flat: Sequence) -> list[Number]:
            return [Number(flat[i], tuple(flat[i + 1 : i + width])) for i in range(0, len(flat), width)]

        return gather(
            self._t.loop(first, end, flatten(carried), lambda k, flat: flatten(body(k, gather(flat))), step)
        )

    def elementary(self, name: str, x: Number) -> Number:
        t = self._t
        value = t.elementary(name, x.value)
        one = t.number(1.0)
        rate = {
            "sin": lambda: t.elementary("cos", x.value),
            "cos": lambda: t.neg(t.elementary("sin", x.value)),
            "exp": lambda: value,
            "log": lambda: t.div(one, x.value),
            "atan": lambda: t.div(one, t.fma(x.value, x.value, one)),
            "tanh": lambda: t.sub(one, t.mul(value, value)),
        }[name]()
        return self._chain(value, rate, x)

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Number]:
        known = self._t.scalars(record, {name: number.value for name, number in inputs.items()})
        found = {}
        for name, value in known.items():
            slopes: list[Any] = [None] * self._columns
            for source, weight in record.tangents.get(name, {}).items():
                column = self._tangents.get(source)
                if column is not None and weight != 0.0:
                    slopes[column] = known[weight] if isinstance(weight, str) else self._t.number(weight)
            found[name] = Number(value, tuple(slopes))
        return found


class Variable:
    """Dual numbers of arrays, for formulas: a value of shape (...) and its slopes of shape (columns, ...)."""

    __array_ufunc__ = None  # NumPy's numbers leave the arithmetic to this class

    def __init__(self, value: Any, slopes: Any) -> None:
        self.value, self.slopes = value, slopes

    @classmethod
    def of_column(cls, columns: Sequence[str], name: str, value: Any) -> Variable:
        """Return the number of that name among those by which derivatives are taken, or a constant."""
        return cls(value, np.array([float(name == column) for column in columns], dtype=object))

    def _other(self, other: Any) -> Variable:
        return other if isinstance(other, Variable) else Variable(other, 0.0)

    def __add__(self, other: Any) -> Variable:
        b = self._other(other)
        return Variable(self.value + b.value, self.slopes + b.slopes)

    __radd__ = __add__

    def __neg__(self) -> Variable:
        return Variable(-self.value, -self.slopes)

    def __sub__(self, other: Any) -> Variable:
        return self + -self._other(other)

    def __rsub__(self, other: Any) -> Variable:
        return -self + other

    def __mul__(self, other: Any) -> Variable:
        b = self._other(other)
        return Variable(self.value * b.value, self.slopes * b.value + b.slopes * self.value)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Variable:
        b = self._other(other)
        value = self.value / b.value
        return Variable(value, (self.slopes - b.slopes * value) / b.value)

    def __rtruediv__(self, other: Any) -> Variable:
        return self._other(other) / self


def variables_of(states: Any, controls: Any) -> tuple[list[Variable], list[Variable]]:
    """Return the columns of states (n, n_state) and of controls (n, n_controls), each a column of its own."""
    columns = [*states.T, *controls.T]
    unit = np.eye(len(columns))[:, :, None]
    given = [Variable(x, unit[i]) for i, x in enumerate(columns)]
    return given[: states.shape[1]], given[states.shape[1] :]


def stacked(numbers: Sequence[Variable], count: int) -> Any:
    """Return the slopes of numbers as an array of shape (count, len(numbers), columns)."""
    found = np.empty((count, len(numbers), len(numbers[0].slopes)))
    for i, number in enumerate(numbers):
        found[:, i] = number.slopes.T
    return found


class VariableFunctions:
    """The functions of `Variable`."""

    def _of(self, x: Any, value: Any, rate: Any) -> Any:
        return Variable(value, x.slopes * rate) if isinstance(x, Variable) else value

    def sin(self, x: Any) -> Any:
        """Return the sine."""
        a = getattr(x, "value", x)
        return self._of(x, np.sin(a), np.cos(a))

    def cos(self, x: Any) -> Any:
        """Return the cosine."""
        a = getattr(x, "value", x)
        return self._of(x, np.cos(a), -np.sin(a))

    def exp(self, x: Any) -> Any:
        """Return the exponential."""
        value = np.exp(getattr(x, "value", x))
        return self._of(x, value, value)

    def log(self, x: Any) -> Any:
        """Return the natural logarithm."""
        a = getattr(x, "value", x)
        return self._of(x, np.log(a), 1.0 / a)

    def sqrt(self, x: Any) -> Any:
        """Return the square root."""
        value = np.sqrt(getattr(x, "value", x))
        return self._of(x, value, 0.5 / value)

    def atan(self, x: Any) -> Any:
        """Return the arc tangent."""
        a = getattr(x, "value", x)
        return self._of(x, np.arctan(a), 1.0 / (1.0 + a * a))

    def tanh(self, x: Any) -> Any:
        """Return the hyperbolic tangent."""
        value = np.tanh(getattr(x, "value", x))
        return self._of(x, value, 1.0 - value * value)
