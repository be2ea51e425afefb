"""Numbers with twice the digits: a value and its rounding error.

A sum over many substeps is as exact as a single step only if each substep is more exact than a float. The
series' formulas run on these numbers as they do on floats, and are recorded in the same way. Each operation
consists of error-free transformations [1]_, which compute the rounded result and the rounding error from
additions and one fused multiply-add.

References
----------
.. [1] T. Ogita, S. M. Rump, S. Oishi, "Accurate sum and dot product", SIAM J. Sci. Comput. 26 (2005),
   1955-1988.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from lag_envs.stepping.tracing import TracedNumber, polynomial


class Twofold:
    """The number ``high + low``; `low` is about as large as the rounding error of `high`.

    A float operand stands for the simplest fraction that rounds to it, such as 1/3, or else for itself.

    Examples
    --------
    >>> third = Twofold(1.0) * (1.0 / 3.0)
    >>> third.high, third.low
    (0.3333333333333333, 1.850371707708594e-17)
    """

    __slots__ = ("high", "low")

    def __init__(self, high: Any, low: Any = 0.0) -> None:
        self.high, self.low = high, low

    def __add__(self, other: Any) -> Twofold:
        if isinstance(other, float) and other == 0.0:
            return self
        other = _twofold(other)
        high, rest = two_sum(self.high, other.high)
        return Twofold(high, rest + (self.low + other.low))

    def __sub__(self, other: Any) -> Twofold:
        return self + -_twofold(other)

    def __rsub__(self, other: Any) -> Twofold:
        return -self + other

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, float) and other == 0.0:
            return 0.0
        other = _twofold(other)
        high, rest = two_product(self.high, other.high)
        return Twofold(high, rest + self.high * other.low + self.low * other.high)

    def __neg__(self) -> Twofold:
        return Twofold(-self.high, -self.low)

    __radd__, __rmul__ = __add__, __mul__

    def parts(self) -> tuple[Any, Any]:
        """Return the float nearest to the number, and the rest."""
        high = self.high + self.low
        return high, self.low - (high - self.high)


def two_sum(a: Any, b: Any) -> tuple[Any, Any]:
    """Return a + b as a float, and its rounding error."""
    total = a + b
    b_part = total - a
    return total, (a - (total - b_part)) + (b - b_part)


def two_product(a: Any, b: Any) -> tuple[Any, Any]:
    """Return a * b as a float, and its rounding error."""
    product = a * b
    for factor in (a, b):
        if isinstance(factor, TracedNumber):
            return product, factor.trace.record("a*b-c", a, b, product)
    return product, float(Fraction(a) * Fraction(b) - Fraction(product))


def mixed_polynomial(coefficients: Sequence[float], x: Twofold, *, twofold: int) -> Any:
    """Evaluate a polynomial whose terms from ``x**twofold`` on are small enough for plain floats."""
    value: Any = Twofold(polynomial(coefficients[twofold:], x.high))
    for c in reversed(coefficients[:twofold]):
        value = value * x + c
    return value


def twofold_parts(*numbers: Twofold) -> tuple:
    """Return the parts of several numbers, one after the other."""
    return tuple(part for number in numbers for part in number.parts())


def _twofold(value: Any) -> Twofold:
    if isinstance(value, Twofold):
        return value
    if isinstance(value, TracedNumber):
        return Twofold(value)
    fraction = Fraction(value).limit_denominator(1000)
    return Twofold(value, float(fraction - Fraction(value)) if float(fraction) == value else 0.0)
