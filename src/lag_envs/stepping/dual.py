"""Derivatives of a step: the same algorithm on numbers that carry derivatives along.

A dual number is a value with one derivative per column; None stands for derivatives that are all zero.
`DualTarget` makes a target of such numbers from two targets: one of plain numbers, and one whose numbers are
vectors with an entry per column. Therefore each recurrence is written once, and all columns share its
operations. `DualTarget` supports what `Series.expand` and `Series.advance` need, but not the certificate,
because comparisons have no derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from lag_envs.mechanics.evaluation import RATES, Numeric
from lag_envs.stepping.lowering import SeriesRecord
from lag_envs.stepping.series import slope_of_tanh


class DualNumber(NamedTuple):
    """A value and its derivatives."""

    value: Any
    slopes: Any = None


class DualTarget:
    """Dual numbers on a target of plain ones.

    Parameters
    ----------
    target : Target
        The values.
    wide : Target
        The derivatives, vectors with an entry per column.
    broadcast : callable
        Makes a vector whose entries all equal a value.
    tangents : mapping
        For each input that has a derivative, the vector that is 1 in its column.
    """

    def __init__(self, target: Any, wide: Any, broadcast: Callable, tangents: Mapping[str, Any]) -> None:
        self._t, self._wide, self._broadcast, self._tangents = target, wide, broadcast, tangents
        self.group = wide.group

    def __getattr__(self, name: str) -> Any:
        """Leave indices and conditions to the target of values."""
        return getattr(self._t, name)

    def number(self, value: float) -> DualNumber:
        return DualNumber(self._t.number(value))

    def add(self, a: DualNumber, b: DualNumber) -> DualNumber:
        both = a.slopes is not None and b.slopes is not None
        slopes = self._wide.add(a.slopes, b.slopes) if both else b.slopes if a.slopes is None else a.slopes
        return DualNumber(self._t.add(a.value, b.value), slopes)

    def neg(self, a: DualNumber) -> DualNumber:
        return DualNumber(self._t.neg(a.value), None if a.slopes is None else self._wide.neg(a.slopes))

    def abs(self, a: DualNumber) -> DualNumber:
        t = self._t
        sign = t.select(t.less(a.value, t.number(0.0)), t.number(-1.0), t.number(1.0))
        return DualNumber(t.abs(a.value), self._times(a.slopes, sign))

    def sub(self, a: DualNumber, b: DualNumber) -> DualNumber:
        p, q, w = a.slopes, b.slopes, self._wide
        slopes = p if q is None else w.neg(q) if p is None else w.sub(p, q)
        return DualNumber(self._t.sub(a.value, b.value), slopes)

    def _times(self, slopes: Any, factor: Any, total: Any = None) -> Any:
        """Return slopes times a value, plus a total; None stands for zero."""
        if slopes is None:
            return total
        w, every = self._wide, self._broadcast(factor)
        return w.mul(slopes, every) if total is None else w.fma(slopes, every, total)

    def mul(self, a: DualNumber, b: DualNumber) -> DualNumber:
        slopes = self._times(a.slopes, b.value, self._times(b.slopes, a.value))
        return DualNumber(self._t.mul(a.value, b.value), slopes)

    def fma(self, a: DualNumber, b: DualNumber, c: DualNumber) -> DualNumber:
        slopes = self._times(a.slopes, b.value, self._times(b.slopes, a.value, c.slopes))
        return DualNumber(self._t.fma(a.value, b.value, c.value), slopes)

    def div(self, a: DualNumber, b: DualNumber) -> DualNumber:
        value = self._t.div(a.value, b.value)
        slopes = self._times(b.slopes, self._t.neg(value), a.slopes)
        if slopes is not None:
            slopes = self._wide.div(slopes, self._broadcast(b.value))
        return DualNumber(value, slopes)

    def sqrt(self, a: DualNumber) -> DualNumber:
        t = self._t
        root = t.sqrt(a.value)
        return DualNumber(root, self._times(a.slopes, t.div(t.number(0.5), root)))

    def less(self, a: DualNumber, b: DualNumber) -> Any:
        return self._t.less(a.value, b.value)

    def real(self, k: Any) -> DualNumber:
        return DualNumber(self._t.real(k))

    def reciprocal(self, k: Any) -> DualNumber:
        return DualNumber(self._t.reciprocal(k))

    def _slopes(self, number: DualNumber) -> Any:
        return self._wide.number(0.0) if number.slopes is None else number.slopes

    def load(self, slot: int, k: Any) -> DualNumber:
        return DualNumber(self._t.load(slot, k), self._wide.load(slot, k))

    def store(self, slot: int, k: Any, value: DualNumber) -> None:
        self._t.store(slot, k, value.value)
        self._wide.store(slot, k, self._slopes(value))

    def loop(
        self, first: Any, end: Any, carried: Sequence[DualNumber], body: Callable, step: int = 1
    ) -> list[DualNumber]:
        def flat(numbers: Sequence[DualNumber]) -> list:
            return [part for number in numbers for part in (number.value, self._slopes(number))]

        def paired(parts: Sequence) -> list[DualNumber]:
            return [DualNumber(*pair) for pair in zip(parts[::2], parts[1::2], strict=True)]

        return paired(
            self._t.loop(first, end, flat(carried), lambda k, parts: flat(body(k, paired(parts))), step)
        )

    def elementary(self, name: str, x: DualNumber) -> DualNumber:
        t = self._t
        value = t.elementary(name, x.value)
        one = t.number(1.0)
        rate = {
            "sin": lambda: t.elementary("cos", x.value),
            "cos": lambda: t.neg(t.elementary("sin", x.value)),
            "exp": lambda: value,
            "log": lambda: t.div(one, x.value),
            "atan": lambda: t.div(one, t.fma(x.value, x.value, one)),
            "tanh": lambda: slope_of_tanh(t, x.value),
        }[name]()
        return DualNumber(value, self._times(x.slopes, rate))

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, DualNumber]:
        known = self._t.scalars(record, {name: number.value for name, number in inputs.items()})
        found = {}
        for name, value in known.items():
            slopes = None
            for source, weight in record.tangents.get(name, {}).items():
                if source in self._tangents and weight != 0.0:
                    factor = known[weight] if isinstance(weight, str) else self._t.number(weight)
                    slopes = self._times(self._tangents[source], factor, slopes)
            found[name] = DualNumber(value, slopes)
        return found


class Variable:
    """Dual numbers of arrays, for formulas: a value of shape (...) and its slopes of shape (columns, ...)."""

    __array_ufunc__ = None  # NumPy's numbers leave the arithmetic to this class

    def __init__(self, value: Any, slopes: Any) -> None:
        self.value, self.slopes = value, slopes

    @classmethod
    def of_column(cls, columns: Sequence[str], name: str, value: Any) -> Variable:
        """Return the variable of the column with this name, or a constant if there is no such column."""
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


def variables_of(*arrays: Any) -> list[list[Variable]]:
    """Return the columns of each array of shape (n, ...) as variables, each with a derivative."""
    columns = [x for array in arrays for x in array.T]
    unit = np.eye(len(columns))[:, :, None]
    given = iter([Variable(x, unit[i]) for i, x in enumerate(columns)])
    return [list(islice(given, array.shape[1])) for array in arrays]


def stacked(numbers: Sequence[Variable], count: int) -> Any:
    """Return the slopes of numbers as an array of shape (count, len(numbers), columns)."""
    found = np.empty((count, len(numbers), len(numbers[0].slopes)))
    for i, number in enumerate(numbers):
        found[:, i] = number.slopes.T
    return found


class VariableFunctions:
    """The functions of `Variable`.

    Parameters
    ----------
    xp : namespace
        The functions of its values.
    """

    def __init__(self, xp: Any = Numeric) -> None:
        self._xp = xp
        for name in RATES:
            setattr(self, name, partial(self._call, name))

    def _call(self, name: str, x: Any) -> Any:
        function = getattr(self._xp, name)
        if not isinstance(x, Variable):
            return function(x)
        value = function(x.value)
        return Variable(value, x.slopes * RATES[name](x.value, value, self._xp))
