"""Arithmetic with twice the digits, for computing constants from drawn parameters."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

from lag_envs.stepping.tracing import TracedNumber
from lag_envs.stepping.twofold import two_product, two_sum


class Twice:
    """A number with twice the digits, for the operations of `evaluate` on parameters."""

    __slots__ = ("high", "low")

    def __init__(self, high: Any, low: Any = 0.0) -> None:
        self.high, self.low = high, low

    def __add__(self, other: Any) -> Twice:
        other = _twice(other)
        high, rest = two_sum(self.high, other.high)
        return Twice(*two_sum(high, rest + (self.low + other.low)))

    def __mul__(self, other: Any) -> Twice:
        other = _twice(other)
        high, rest = two_product(self.high, other.high)
        return Twice(*two_sum(high, rest + (self.high * other.low + self.low * other.high)))

    def __neg__(self) -> Twice:
        return Twice(-self.high, -self.low)

    def __sub__(self, other: Any) -> Twice:
        return self + -_twice(other)

    def __truediv__(self, other: Any) -> Twice:
        other = _twice(other)
        first = self.high / other.high
        rest = self - other * Twice(first)
        return Twice(*two_sum(first, (rest.high + rest.low) / other.high))

    def __rtruediv__(self, other: Any) -> Twice:
        return _twice(other) / self

    __radd__, __rmul__ = __add__, __mul__


def _twice(value: Any) -> Twice:
    if isinstance(value, Twice):
        return value
    if isinstance(value, TracedNumber):
        return Twice(value)
    exact = Fraction(value)
    return Twice(float(exact), float(exact - Fraction(float(exact))))


def nearest_float(value: Any) -> Any:
    """Return the nearest float."""
    return value.high + value.low if isinstance(value, Twice) else float(value)


class TwiceFunctions:
    """Functions of numbers with twice the digits, evaluated at the nearest floats."""

    Rational, mpf, pi = Fraction, None, Fraction(math.pi)

    def __init__(self, trace: Any) -> None:
        self._trace = trace

    def __getattr__(self, name: str) -> Any:
        return lambda x: Twice(getattr(self._trace, name)(nearest_float(x)))
