"""Cosine and sine by arithmetic alone, for the comparison integrators."""

from __future__ import annotations

import math
from typing import Any

from lag_envs.stepping.tracing import polynomial

#: π/2 in three parts, the first two with trailing zero bits (Cody and Waite).
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SIN = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(9)]
_COS = [(-1.0) ** k / math.factorial(2 * k) for k in range(10)]


def cosine_sine(angle: Any, xp: Any) -> tuple[Any, Any]:
    """Return cosine and sine to rounding, for angles up to some 1e5 rad.

    The function uses only arithmetic, so that a compiled loop over a batch is vectorised like lag_envs's.
    With calls of the C library, the comparison integrators would be ten times slower.
    """
    quarter = xp.floor(angle * (2.0 / math.pi) + 0.5)
    r = angle - quarter * _HALF_PI[0] - quarter * _HALF_PI[1] - quarter * _HALF_PI[2]
    z = r * r
    sine, cosine = r * polynomial(_SIN, z), polynomial(_COS, z)
    odd = quarter - 2.0 * xp.floor(0.5 * quarter) > 0.5
    back = quarter - 4.0 * xp.floor(0.25 * quarter)  # 0, 1, 2, 3
    c, s = xp.where(odd, sine, cosine), xp.where(odd, cosine, sine)
    return xp.where((back > 0.5) & (back < 2.5), -c, c), xp.where(back > 1.5, -s, s)


class Arithmetic:
    """A namespace with the functions of another, but with `cosine_sine` for cosine and sine."""

    def __init__(self, xp: Any) -> None:
        self._xp = xp

    def __getattr__(self, name: str) -> Any:
        return getattr(self._xp, name)

    def cos(self, angle: Any) -> Any:
        """Return the cosine."""
        return cosine_sine(angle, self._xp)[0]

    def sin(self, angle: Any) -> Any:
        """Return the sine."""
        return cosine_sine(angle, self._xp)[1]
