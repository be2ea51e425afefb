"""The rolling cylinder on a slope: both of its equations are linear, so both are stepped by their exact flow.

Fixed slope
    ``x'' = a - Γx'``: acceleration minus damping rate times speed. It is solved by φ-functions, with
    φ₁(z) = (e^z - 1)/z and φ₂(z) = (e^z - 1 - z)/z² [1]_::

        x₁ = x + vT φ₁(-ΓT) + aT² φ₂(-ΓT),   v₁ = v e^(-ΓT) + aT φ₁(-ΓT)

    The sum has no cancellation for any Γ >= 0; without damping it is the quadratic.
Turning slope
    ``x'' = kg sin(φ) + kΩ²x - Γx'`` with φ' = Ω held: linear in (x, x', sin φ, cos φ). Its Taylor series has
    the factorial bound |V_k| <= M σ^k/k! with σ = h (2Γ + 2 √k |Ω| + |Ω|). If σ is large, short steps are
    taken one after the other; if it is large because of the damping, the matrix of a short step is squared
    until it spans the whole step ("scaling and squaring").

References
----------
.. [1] M. Hochbruck, A. Ostermann, "Exponential integrators", Acta Numerica 19 (2010), 209-286.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial, reduce
from typing import Any, NamedTuple

import numpy as np

from lag_envs.stepping.compiling import compile_python, compile_traced
from lag_envs.stepping.dual import Variable
from lag_envs.stepping.pendulum import TWOFOLD, rotate
from lag_envs.stepping.tracing import clip, pairwise_sum, polynomial
from lag_envs.stepping.twofold import Twofold, mixed_polynomial, twofold_parts

SMALL_DECAY = 0.25  # up to this value, the series of φ₂ below is exact to rounding: .25^12/14! = 7e-19
_PHI2 = [(-1.0) ** k / math.factorial(k + 2) for k in range(12)]
TURN_ORDER = 12
SMALL_TURN = 0.25  # .25^13/13! = 2e-18


class FixedSlope(NamedTuple):
    """Coefficients of the fixed slope while a control is held; a literal 0.0 drops the term."""

    acceleration: Any  # [m/s²]
    damping_rate: Any = 0.0  # [1/s]


def sliding(v: Any, force: FixedSlope) -> Any:
    """Return x'' on a fixed slope."""
    return force.acceleration - force.damping_rate * v


def slide(x: Any, v: Any, force: FixedSlope, dt: Any) -> tuple:
    """Advance (x, x') by dt for a damping rate times dt up to `SMALL_DECAY` in size."""
    decay = force.damping_rate * dt
    phi2 = polynomial(_PHI2, decay) if not (isinstance(decay, float) and decay == 0.0) else 0.5
    phi1 = 1.0 - decay * phi2
    gained = force.acceleration * dt
    return x + dt * (v * phi1 + gained * phi2), v * (1.0 - decay * phi1) + gained * phi1


def slides(force: FixedSlope, dt: Any) -> Any:
    """Return whether `slide` is exact to rounding."""
    decay = force.damping_rate * dt
    return (decay <= SMALL_DECAY) & (decay >= -SMALL_DECAY)


def _slide_any(x, v, acceleration, damping_rate, dt, _):  # type: ignore[no-untyped-def]
    """Advance by dt at any damping; return the state and 1, or -2 if there is no finite result."""
    if not holds(acceleration, damping_rate, dt):
        z = damping_rate * dt
        if abs(z) < 1.5:  # where 1 - phi1 would cancel
            phi2 = 0.5
            term = 0.5
            for k in range(3, 26):
                term *= -z / k
                phi2 += term
            phi1 = 1.0 - z * phi2
        else:
            phi1 = -math.expm1(-z) / z
            phi2 = (1.0 - phi1) / z
        x, v = x + dt * (v * phi1 + acceleration * dt * phi2), v * math.exp(-z) + acceleration * dt * phi1
    else:
        x, v = slide(x, v, acceleration, damping_rate, dt)
    return x, v, 1 if abs(x) < math.inf and abs(v) < math.inf else -2


def crossing_time(x: Any, v: Any, force: FixedSlope, dt: Any, xp: Any) -> Any:
    """Return the time at which a cylinder rolling down from x < 0 passes 0, if that happens within dt.

    Parameters
    ----------
    x, v : number
        Place (below 0) and speed (not below 0) at the step's start.
    force : FixedSlope
        The coefficients.
    dt : number
        The step.
    xp : namespace
        The functions.

    Notes
    -----
    Newton's method on the closed form, from below. It starts from the time of the motion without damping, or
    from the line that x(t) approaches if it slows down. A cylinder that speeds up is never far from the
    former. For a cylinder that slows down, Newton's method is monotone but may advance by no more than 1/Γ at
    a time. In this case it is therefore also applied to the logarithm of the boundary layer, e^-z = m(z),
    which is monotone too, and the later of the two times is taken.
    """
    acceleration, damping_rate = force
    excess = damping_rate * v - acceleration
    slower = excess > 0.0
    free = -2.0 * x / (v + xp.sqrt(v * v - 2.0 * acceleration * x))
    line = -(damping_rate * damping_rate * x + excess) / (damping_rate * xp.maximum(acceleration, 1e-300))
    time = xp.minimum(xp.where(slower, xp.maximum(free, line), free), dt)
    for _ in range(7):
        z = damping_rate * time
        small = z <= SMALL_DECAY
        phi1 = xp.where(small, 1.0 - z * polynomial(_PHI2, z), (1.0 - xp.exp(-z)) / z)
        phi2 = xp.where(small, polynomial(_PHI2, z), (1.0 - phi1) / z)
        place = x + time * (v * phi1 + acceleration * time * phi2)
        speed = v * (1.0 - z * phi1) + acceleration * time * phi1
        layer = 1.0 + damping_rate * (damping_rate * x + acceleration * time) / excess
        valid = slower & (z > SMALL_DECAY) & (layer > 0.0)
        layer = xp.where(valid, layer, 1.0)
        later = (z - (z + xp.log(layer)) / (1.0 + acceleration / (excess * layer))) / damping_rate
        later = xp.where(valid, later, 0.0)
        time = clip(xp.maximum(time - place / speed, later), 0.0, dt, xp)
    return time


@cache
def compile_slide(absent: frozenset[str] = frozenset()) -> Callable:
    """Compile ``flow(x, v, acceleration, damping_rate, dt, _)`` to ``(x, v, 1)``, negative if refused."""
    fast = compile_traced(
        "slide",
        "x, v, acceleration, damping_rate, dt",
        lambda xp, x, v, p, d, dt: slide(x, v, FixedSlope(p, d), dt),
        absent,
    )
    holds = compile_traced(
        "holds",
        "acceleration, damping_rate, dt",
        lambda xp, p, d, dt: (slides(FixedSlope(p, d), dt),),
        absent,
    )
    return compile_python("flow", _slide_any, fast, holds)


def _slide_tangent(values, slopes, scratch, dt, _):  # type: ignore[no-untyped-def]
    """Differentiate a step; see `pendulum._tangent`. The values are x, x', acceleration and damping_rate."""
    _x, v, acceleration, damping_rate = values
    z = damping_rate * dt
    if abs(z) <= SMALL_DECAY:
        phi2, slope2 = short(z)
    else:
        phi2, slope2, term = 0.5, 0.0, 0.5
        for k in range(1, 24):
            slope2 += term * -k / (k + 2)
            term *= -z / (k + 2)
            phi2 += term
    phi1 = 1.0 - z * phi2
    slope1 = -(phi2 + z * slope2)
    decay = 1.0 - z * phi1
    if not abs(z) < 1.5:  # where the sums below would cancel
        decay = math.exp(-z)
        phi1 = -math.expm1(-z) / z
        phi2 = (1.0 - phi1) / z
        slope1 = (decay - phi1) / z
        slope2 = -(slope1 + phi2) / z
    far, fast = (
        dt * dt * (v * slope1 + acceleration * dt * slope2),
        dt * (acceleration * dt * slope1 - v * decay),
    )
    for j in range(slopes.shape[1]):
        dv, d_acceleration, d_damping = slopes[1, j], slopes[2, j], slopes[3, j]
        slopes[0, j] += dt * (dv * phi1 + d_acceleration * dt * phi2) + far * d_damping
        slopes[1, j] = dv * decay + d_acceleration * dt * phi1 + fast * d_damping
    return 0


@cache
def compile_slide_tangent(absent: frozenset[str], by: tuple[str, ...]) -> Callable:
    """Compile ``tangent(values, slopes, scratch, dt, _)``, see `_slide_tangent`; all terms are allowed."""

    def short(xp: Any, z: Any) -> tuple:
        phi2 = polynomial(_PHI2, Variable.of_column(["z"], "z", z))
        return phi2.value, *phi2.slopes

    helper = compile_traced("short", "z", short)
    return compile_python("tangent", _slide_tangent, helper, SMALL_DECAY=SMALL_DECAY)


class TurningSlope(NamedTuple):
    """Coefficients of the turning slope while a control is held."""

    centrifugal: Any  # k
    gravity: Any  # k g [m/s²]
    damping_rate: Any  # [1/s]
    rate: Any  # Ω [rad/s]


def turning(x: Any, v: Any, s: Any, turn: TurningSlope) -> Any:
    """Return x'' on a turning slope; s is sinφ."""
    return turn.gravity * s + turn.centrifugal * (turn.rate * turn.rate) * x - turn.damping_rate * v


def turn_coefficients(
    x: Any, w: Any, c: Any, s: Any, turn: TurningSlope, h: Any, order: int = TURN_ORDER
) -> tuple[list, list]:
    """Return the Taylor coefficients of x and hx'; w is hx' at the start, (c, s) are cosφ and sinφ there."""
    rate = turn.rate * h
    centrifugal = turn.centrifugal * (rate * rate)
    gravity = turn.gravity * (h * h)
    damping_rate = turn.damping_rate * h
    X, V, S, C = [x], [w], [gravity * s], [gravity * c]
    for k in range(order):
        V.append((centrifugal * X[k] + S[k] - damping_rate * V[k]) * (1.0 / (k + 1)))
        X.append(V[k] * (1.0 / (k + 1)))
        S.append(rate * C[k] * (1.0 / (k + 1)))
        C.append(rate * S[k] * (-1.0 / (k + 1)))
    return X, V


def turn_change(x: Any, v: Any, c: Any, s: Any, turn: TurningSlope, h: Any) -> tuple[Any, Any]:
    """Return the changes of (x, x') by the Taylor series; (c, s) are cosφ and sinφ at the start."""
    X, V = turn_coefficients(x, h * v, c, s, turn, h)
    return _sum(X[1:]), _sum(V[1:]) * (1.0 / h)


def _sum(terms: list) -> Any:
    """Add up from the last to the first."""
    return reduce(lambda total, term: total + term, reversed(terms))


def turn_series(x: Any, v: Any, c: Any, s: Any, turn: TurningSlope, h: Any) -> tuple[Any, Any]:
    """Advance (x, x') by `turn_change`."""
    dx, dv = turn_change(x, v, c, s, turn, h)
    return x + dx, v + dv


def turn_substep(x: Twofold, w: Twofold, c: Twofold, s: Twofold, turn: TurningSlope, h: Twofold) -> tuple:
    """Advance (x, hx', cosφ, sinφ) by one of many steps, with twice the digits (see `pendulum.substep`)."""
    ends = []
    plain = TurningSlope(*(number.high for number in turn))
    for large, W in zip(
        turn_coefficients(x, w, c, s, turn, h, TWOFOLD),
        turn_coefficients(x.high, w.high, c.high, s.high, plain, h.high),
        strict=True,
    ):
        W[: len(large)] = large
        ends.append(pairwise_sum(W))
    return *ends, *rotate(c, s, turn.rate * h, partial(mixed_polynomial, twofold=3))


def turns(turn: TurningSlope, h: Any, xp: Any) -> Any:
    """Return whether one step of the series is exact to rounding."""
    return h * (2.0 * turn.damping_rate + rate_factor(turn.centrifugal, xp) * xp.abs(turn.rate)) <= SMALL_TURN


def rate_factor(centrifugal: Any, xp: Any) -> Any:
    """Return 2 √k + 1, at least 3: a rolling cylinder's k lies below 1."""
    return 1.0 + 2.0 * xp.sqrt(xp.maximum(xp.abs(centrifugal), 1.0))


def _halved(growth, dt):  # type: ignore[no-untyped-def]
    """Return how often a step is halved until one series suffices, and its length; -1 if too often."""
    for halvings in range(61):
        if growth <= SMALL_TURN:
            return halvings, dt
        growth *= 0.5
        dt *= 0.5
    return -1, dt


def _turn_any(x, v, c, s, centrifugal, gravity, damping_rate, rate, dt, _):  # type: ignore[no-untyped-def]
    """Advance by dt for any coefficients; return x, x', cosφ, sinφ, and 1, or -1 or -2 if refused."""
    growth = dt * (2.0 * damping_rate + (1.0 + 2.0 * math.sqrt(max(abs(centrifugal), 1.0))) * abs(rate))
    n = np.ceil(max(1.0, growth / SMALL_TURN))
    if n == 1.0 or (damping_rate <= abs(rate) and n <= 1e5):
        if n == 1.0:
            x, v = series(x, v, c, s, centrifugal, gravity, damping_rate, rate, dt)
            c, s = turn_pair(c, s, rate * dt)
        else:
            h = dt / n
            h_low = fma(-h, n, dt) / n
            w, w_low = start(v, h, h_low)
            x_low = c_low = s_low = 0.0
            for _i in range(int(n)):
                x, x_low, w, w_low, c, c_low, s, s_low = substep(
                    x, x_low, w, w_low, c, c_low, s, s_low, centrifugal, gravity, damping_rate, rate, h, h_low
                )
            v = w / h
            v += (fma(-v, h, w) + (w_low - v * h_low)) / h
        return x, v, c, s, 1 if abs(x) < math.inf and abs(v) < math.inf else -2
    doublings, h = halved(growth, dt)
    if doublings < 0:
        return x, v, c, s, -1
    # Rows (x, x'), columns (x, x', cos, sin): the change in a short step, from its effect on unit vectors.
    # The unit matrix is left out: (1 + M)² = 1 + 2M + M² keeps the digits of a small M, whereas 1 + M would
    # lose a bit with each squaring.
    m = np.empty((2, 4))
    m[0, 0], m[1, 0] = change(1.0, 0.0, 0.0, 0.0, centrifugal, gravity, damping_rate, rate, h)
    m[0, 1], m[1, 1] = change(0.0, 1.0, 0.0, 0.0, centrifugal, gravity, damping_rate, rate, h)
    m[0, 2], m[1, 2] = change(0.0, 0.0, 1.0, 0.0, centrifugal, gravity, damping_rate, rate, h)
    m[0, 3], m[1, 3] = change(0.0, 0.0, 0.0, 1.0, centrifugal, gravity, damping_rate, rate, h)
    for i in range(doublings):
        angle = rate * (dt * 0.5 ** (doublings - i))
        p, q = math.cos(angle), math.sin(angle)
        a = m.copy()
        for r in range(2):
            for j in range(4):
                m[r, j] += a[r, 0] * a[0, j] + a[r, 1] * a[1, j]
            m[r, 0] += a[r, 0]
            m[r, 1] += a[r, 1]
            m[r, 2] += a[r, 2] * p + a[r, 3] * q
            m[r, 3] += a[r, 3] * p - a[r, 2] * q
    dx = m[0, 0] * x + m[0, 1] * v + (m[0, 2] * c + m[0, 3] * s)
    dv = m[1, 0] * x + m[1, 1] * v + (m[1, 2] * c + m[1, 3] * s)
    x, v = x + dx, v + dv
    p, q = math.cos(rate * dt), math.sin(rate * dt)
    c, s = c * p - s * q, s * p + c * q
    r = 1.5 - 0.5 * (c * c + s * s)
    return x, v, c * r, s * r, 1 if abs(x) < math.inf and abs(v) < math.inf else -2


@cache
def compile_turn(absent: frozenset[str] = frozenset()) -> Callable:
    """Compile ``flow(x, v, c, s, *TurningSlope, dt, _)`` to ``(x, v, c, s, 1)``."""
    arguments = "x, v, c, s, centrifugal, gravity, damping_rate, rate, h"
    series, change = (
        compile_traced(
            name,
            arguments,
            lambda xp, x, v, c, s, *rest, f=f: f(x, v, c, s, TurningSlope(*rest[:4]), rest[4]),
            absent,
        )
        for name, f in (("series", turn_series), ("change", turn_change))
    )
    pair = compile_traced("turn_pair", "c, s, angle", lambda xp, c, s, angle: rotate(c, s, angle))

    def substep(xp: Any, *numbers: Any) -> tuple:
        *halves, h, h_low = numbers
        x, w, c, s = map(Twofold, halves[:8:2], halves[1:8:2])
        return twofold_parts(
            *turn_substep(x, w, c, s, TurningSlope(*map(Twofold, halves[8:])), Twofold(h, h_low))
        )

    names = ", ".join(f"{name}, {name}_low" for name in "xwcs")
    return compile_python(
        "flow",
        _turn_any,
        series,
        change,
        pair,
        compile_python("halved", _halved, SMALL_TURN=SMALL_TURN),
        compile_traced("start", "v, h, h_low", lambda xp, v, *h: twofold_parts(Twofold(*h) * v)),
        compile_traced(
            "substep", f"{names}, centrifugal, gravity, damping_rate, rate, h, h_low", substep, absent
        ),
        SMALL_TURN=SMALL_TURN,
    )


# --- derivatives of the turning slope -----------------------------------------------------------------------


def _turn_tangent(values, slopes, scratch, dt, _):  # type: ignore[no-untyped-def]
    """Differentiate a step; see `pendulum._tangent`.

    The values are x, x', cosφ, sinφ, centrifugal, gravity, damping_rate and rate; `ROWS` holds the rows of
    those among the last four that have derivatives. A long step is made from a short one by squaring, as in
    `_turn_any`.
    """
    x, v, c, s, centrifugal, gravity, damping_rate, rate = values
    m, by = np.empty((2, 4)), np.empty((len(ROWS), 2, 4))
    growth = dt * (2.0 * damping_rate + (1.0 + 2.0 * math.sqrt(max(abs(centrifugal), 1.0))) * abs(rate))
    doublings, h = halved(growth, dt)
    if doublings < 0:
        return -1
    for j in range(4):
        one = 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0, 1.0 if j == 3 else 0.0
        found = change(*one, centrifugal, gravity, damping_rate, rate, h)
        for i in range(2 * len(ROWS) + 2):
            if i < 2:
                m[i, j] = found[i]
            else:
                by[(i - 2) // 2, i % 2, j] = found[i]
    for _d in range(doublings):
        p, q = math.cos(rate * h), math.sin(rate * h)
        a, before = m.copy(), by.copy()
        for r in range(2):
            for j in range(4):
                m[r, j] += a[r, 0] * a[0, j] + a[r, 1] * a[1, j]
            for j in range(2):
                m[r, j] += a[r, j]
            m[r, 2] += a[r, 2] * p + a[r, 3] * q
            m[r, 3] += a[r, 3] * p - a[r, 2] * q
            for i in range(len(ROWS)):
                b, change_of_angle = before[i], h if ROWS[i] == RATE else 0.0
                for j in range(4):
                    by[i, r, j] += b[r, 0] * a[0, j] + b[r, 1] * a[1, j]
                    by[i, r, j] += a[r, 0] * b[0, j] + a[r, 1] * b[1, j]
                for j in range(2):
                    by[i, r, j] += b[r, j]
                by[i, r, 2] += b[r, 2] * p + b[r, 3] * q + (a[r, 3] * p - a[r, 2] * q) * change_of_angle
                by[i, r, 3] += b[r, 3] * p - b[r, 2] * q - (a[r, 2] * p + a[r, 3] * q) * change_of_angle
        h *= 2.0
    for j in range(slopes.shape[1]):
        dx, dv, dc, ds = slopes[0, j], slopes[1, j], slopes[2, j], slopes[3, j]
        for r in range(2):
            moved = m[r, 0] * dx + m[r, 1] * dv + (m[r, 2] * dc + m[r, 3] * ds)
            for i in range(len(ROWS)):
                b = by[i]
                turned = b[r, 0] * x + b[r, 1] * v + (b[r, 2] * c + b[r, 3] * s)
                moved += turned * slopes[ROWS[i], j]
            slopes[r, j] += moved
    return 0


@cache
def compile_turn_tangent(absent: frozenset[str], by: tuple[str, ...]) -> Callable:
    """Compile ``tangent(values, slopes, scratch, dt, _)``, see `_turn_tangent`; all terms are allowed."""
    names = ("x", "v", "c", "s", *TurningSlope._fields, "h")
    columns = tuple(name for name in TurningSlope._fields if name == "rate" or name in by)

    def change(xp: Any, *numbers: Any) -> tuple:
        x, v, c, s, *rest, h = (
            Variable.of_column(columns, name, number) for name, number in zip(names, numbers, strict=True)
        )
        dx, dv = turn_change(x, v, c, s, TurningSlope(*rest), h)
        return (
            dx.value,
            dv.value,
            *(slope for pair in zip(dx.slopes, dv.slopes, strict=True) for slope in pair),
        )

    rows = tuple(4 + TurningSlope._fields.index(name) for name in columns)
    return compile_python(
        "tangent",
        _turn_tangent,
        compile_traced("change", ", ".join(names), change),
        compile_python("halved", _halved, SMALL_TURN=SMALL_TURN),
        ROWS=rows,
        RATE=7,
    )
