"""Sine, cosine, exponential, logarithm, arc tangent and hyperbolic tangent from plain arithmetic.

These functions differ in their last bits between the libraries of C, Python and JavaScript. The formulas here
consist of ``+ - * /``, comparisons, selections and the few exact operations of `Trace` (`pow2`, `exponent`,
`copysign`), without branches. Recorded and written unfused, they give the same bits on every machine and in
every language whose numbers are IEEE doubles; each lane of a vector gives the same bits as a single number.

Errors against exact values, fused and unfused, in units in the last place: at most 1.5, except `tanh` 2.5 and
`tan` 3 (`tests/test_elementary.py`). NaN, and arguments outside a function's domain, give NaN.

Each function first reduces its argument, then evaluates a polynomial. The coefficients are minimax
approximations of relative error (Remez's algorithm in 45 digits, then rounded). A multiple of a constant is
subtracted in parts, all but the last so short that their multiples are exact, with or without fused
operations [1]_. The nearest integer is found by adding `MAGIC` and subtracting it again.

References
----------
.. [1] W. J. Cody, W. Waite, "Software Manual for the Elementary Functions", Prentice-Hall 1980.
"""

from __future__ import annotations

import math
from typing import Any

from lag_envs.stepping.tracing import MAGIC, Trace, polynomial

#: `sincos` is accurate up to this angle [rad]; beyond this angle it gives NaN.
LARGEST_ANGLE = 2.6e7

# pi/2 in parts: three of 29 bits, whose multiples by integers up to 2^24 are exact; then the rest.
_HALF_PI = (1.570796325802803, 9.920935774287987e-10, 2.2517417706346578e-18, 3.5215598651832e-27)
# log 2 in two parts, the first of 32 bits.
_LOG2 = (0.6931471803691238, 1.9082149292705877e-10)

# (sin r - r)/r³ and (cos r - 1)/r² in r², |r| <= pi/4; signs as `sincos` needs them.
_SIN = (
    0.1666666666666663,
    -0.008333333333322118,
    0.00019841269829588446,
    -2.755731362097073e-06,
    2.505074769410517e-08,
    -1.5896225997008026e-10,
)
_COS = (
    -0.5,
    0.041666666666666595,
    -0.0013888888888873056,
    2.4801587288850816e-05,
    -2.755731417901754e-07,
    2.087570080122465e-09,
    -1.1358534276562641e-11,
)
# (exp(r) - 1 - r)/r² in r, -log(2)/4 <= r <= 3 log(2)/4.
_EXP = (
    0.5,
    0.1666666666666668,
    0.04166666666666607,
    0.00833333333331312,
    0.0013888888889907992,
    0.0001984126991780986,
    2.4801581625794516e-05,
    2.755732100621516e-06,
    2.756588697165766e-07,
    2.4774262983310336e-08,
    2.4449611904138396e-09,
)
# (2 atanh(s) - 2 s)/s³ in s², |s| <= 3 - 2√2.
_LOG = (
    0.6666666666666734,
    0.3999999999941601,
    0.28571428742101157,
    0.222221986014315,
    0.18183562920518825,
    0.15314084909211073,
    0.14795621775093284,
)
# (atan(t) - t)/t³ in t², |t| <= 0.55.
_ATAN = (
    -0.3333333333333315,
    0.19999999999950377,
    -0.14285714281114825,
    0.11111110895867075,
    -0.0909090313043647,
    0.07692201165678889,
    -0.0666537267250725,
    0.0587133363197168,
    -0.05196264347142975,
    0.04470787309703418,
    -0.03442819659008434,
    0.020101696639889047,
    -0.006288527189559517,
)
# φ₂ of `fading` in x, 0 <= x <= 1; the truncation error is below 1/20! = 4e-19.
_PHI2 = tuple((-1.0) ** k / math.factorial(k + 2) for k in range(18))


def sincos(x: Any, xp: Any) -> tuple[Any, Any]:
    """Return sine and cosine of an angle [rad] up to `LARGEST_ANGLE`."""
    x = xp.where(xp.abs(x) <= LARGEST_ANGLE, x, math.nan)
    # x = n pi/2 + r - rest. The first difference is exact; the rounding errors of the others are kept. The
    # signs of the small terms are chosen so that a negative zero stays negative.
    shifted = x * (2.0 / math.pi) + MAGIC
    n = shifted - MAGIC
    a = x - n * _HALF_PI[0]
    step = n * _HALF_PI[1]
    b = a - step
    lost = (a - b) - step
    step = n * _HALF_PI[2]
    c = b - step
    low = n * _HALF_PI[3] - (lost + ((b - c) - step))
    r = c - low
    rest = low - (c - r)
    z = r * r
    sin_r = r - (r * z * polynomial(_SIN, z) + rest)
    cos_r = 1.0 + (z * polynomial(_COS, z) + r * rest)
    # Cosine and minus sine of n pi/2, which are 0, 1 or -1: halves round to the even neighbour.
    m = shifted - (MAGIC - 1.0)  # n + 1
    cos_n = m - 2.0 * _nearest(0.5 * m)
    sin_n = 2.0 * _nearest(0.5 * n) - n
    return sin_r * cos_n - cos_r * sin_n, cos_r * cos_n + sin_r * sin_n


def tan(x: Any, xp: Any) -> Any:
    """Return the tangent of an angle [rad] up to `LARGEST_ANGLE`."""
    sin, cos = sincos(x, xp)
    return sin / cos


def exp(x: Any, xp: Any) -> Any:
    """Return e**x; overflow gives infinity, small results go through subnormal numbers to 0."""
    n, rest = _exp_parts(xp.minimum(xp.maximum(x, -746.0), 710.0))
    half = _nearest(0.5 * n)  # 2**n itself may be too large or too small
    return (1.0 + rest) * xp.pow2(half) * xp.pow2(n - half)


def tanh(x: Any, xp: Any) -> Any:
    """Return the hyperbolic tangent."""
    # 1 beyond 20. Using exp(2 x) - 1 instead of exp(2 x) keeps small arguments accurate.
    n, rest = _exp_parts(2.0 * xp.minimum(xp.abs(x), 20.0))
    scale = xp.pow2(n)
    grown = scale * rest + (scale - 1.0)
    return xp.copysign(grown / (grown + 2.0), x)


def log(x: Any, xp: Any) -> Any:
    """Return the natural logarithm."""
    # Numbers are scaled away from both ends of the range; then x = 2**k m with √½ <= m < √2.
    below = x < 1.0
    y = x * xp.where(below, 2.0**60, 2.0**-60)
    n = xp.exponent(y * math.sqrt(0.5))
    k = n + xp.where(below, -59.0, 61.0)
    f = y * xp.pow2(-1.0 - n) - 1.0
    # log m = 2 atanh(s), arranged so that f itself is the leading term.
    s = f / (2.0 + f)
    z = s * s
    half = 0.5 * f * f
    value = k * _LOG2[0] - ((half - (s * (half + z * polynomial(_LOG, z)) + k * _LOG2[1])) - f)
    beyond = xp.where(x < 0.0, math.nan, x - math.inf)  # of 0: -inf
    return xp.where(0.0 < x, xp.where(x < math.inf, value, x), beyond)


def atan(x: Any, xp: Any) -> Any:
    """Return the arc tangent, in [-pi/2, pi/2]."""
    # atan(a) = atan(t) + 0, pi/4 or pi/2; t is exact where its error would show.
    a = xp.abs(x)
    near, far = a <= 0.55, 2.4 < a
    t = xp.where(near, a, xp.where(far, -1.0, a - 1.0)) / xp.where(near, 1.0, xp.where(far, a, a + 1.0))
    base = xp.where(near, 0.0, xp.where(far, 0.5 * math.pi, 0.25 * math.pi))
    z = t * t
    rest = t * z * polynomial(_ATAN, z) + base * 3.8981718325193755e-17  # the rounding error of base
    return xp.copysign(base + (t + rest), x)


def fading(x: Any, xp: Any) -> tuple[Any, Any, Any]:
    """Return e^-x and its integrals φ₁ = (1 - e^-x)/x and φ₂ = (1 - φ₁)/x, for x >= 0."""
    fade = xp.exp(-x)
    early = x < 1.0  # where the differences would cancel
    small = polynomial(_PHI2, xp.where(early, x, 0.0))
    divisor = xp.where(early, 1.0, x)
    once = xp.where(early, 1.0 - x * small, (1.0 - fade) / divisor)
    return fade, once, xp.where(early, small, (1.0 - once) / divisor)


class ElementaryTrace(Trace):
    """A recording in which function calls are replaced by the arithmetic above."""

    def sin(self, a: Any) -> Any:
        """Return the sine."""
        return sincos(a, self)[0]

    def cos(self, a: Any) -> Any:
        """Return the cosine."""
        return sincos(a, self)[1]

    def tan(self, a: Any) -> Any:
        """Return the tangent."""
        return tan(a, self)

    def exp(self, a: Any) -> Any:
        """Return the exponential."""
        return exp(a, self)

    def log(self, a: Any) -> Any:
        """Return the natural logarithm."""
        return log(a, self)

    def atan(self, a: Any) -> Any:
        """Return the arc tangent."""
        return atan(a, self)

    arctan = atan

    def tanh(self, a: Any) -> Any:
        """Return the hyperbolic tangent."""
        return tanh(a, self)


def _nearest(x: Any) -> Any:
    """Return the nearest integer, ties to even; |x| < 2^51."""
    return (x + MAGIC) - MAGIC


def _exp_parts(x: Any) -> tuple[Any, Any]:
    """Return an integer n and ``rest`` with exp(x) = 2**n (1 + rest).

    The range of r reaches further up than down, so that `tanh` needs n only where little cancels.
    """
    n = _nearest(x * (1.0 / math.log(2.0)) - 0.25)
    r = (x - n * _LOG2[0]) - n * _LOG2[1]
    return n, r + r * r * polynomial(_EXP, r)
