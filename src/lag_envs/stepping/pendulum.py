"""The driven, damped pendulum: Taylor series without trigonometry, with a bound known before the step.

The bar on its pivot and the cylinder in its shell are the same equation while a control is held::

    theta'' = -alpha sin(theta) - beta cos(theta) - gamma theta' + delta + ramp t

Let h be the step, t = h tau, and A = alpha h², B = beta h², Γ = gamma h, D = delta h², R = ramp h³,
W = h theta', P = A sin + B cos, Q = A cos - B sin. The Taylor coefficients in tau follow from
W' = -P - ΓW + D + R tau, P' = QW, and from the energy identity Q' = WW' + ΓW² - DW - R tau W, which spares a
second convolution: with H = W²/2 it reads Q' = H' + 2ΓH - (D + R tau) W. No sine and no cosine is
called; the pair (cos, sin) is turned by the step's angle with two short polynomials.

**Bound** (method of majorants). E = Q + iP obeys E' = iWE, so |E_0| = G = √(A² + B²). Suppose that for some x

    |W_0| <= x,   x²/2 >= |Γ|x + G + |D|,   x (x²/2 - |Γ|x/2 - G) >= |R|.

With κ = x/2 the series x/(1-κτ) and G/(1-κτ)² then satisfy the same recurrences with >= in place of =, so
|W_k| <= xκ^k for every k. A series cut off after W_N leaves out at most xκ^(N+1)/(1-κ) of hθ', and
at most xκ^(N+1)/((1-κ)(N+2)) of θ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from lag_envs.stepping.compiling import compile_python, compile_traced
from lag_envs.stepping.tracing import pairwise_sum, polynomial, sum_of_products

ORDER = 16
TOLERANCE = 1e-12
MAX_SUBSTEPS = 1_000_000

_SIN = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(8)]
_COS = [(-1.0) ** k / math.factorial(2 * k) for k in range(9)]


class Drive(NamedTuple):
    """Coefficients of the normal form while a control is held; a literal 0.0 drops the term."""

    alpha: Any  # [1/s²]
    beta: Any = 0.0  # [1/s²]
    gamma: Any = 0.0  # [1/s]
    delta: Any = 0.0  # [rad/s²]
    ramp: Any = 0.0  # [rad/s³]


def acceleration(theta_dot: Any, c: Any, s: Any, drive: Drive) -> Any:
    """Return theta'' at the start of the step, where t = 0."""
    return drive.delta - drive.alpha * s - drive.beta * c - drive.gamma * theta_dot


def scaled(drive: Drive, h: Any) -> Drive:
    """Return the coefficients with time measured in steps: A, B, Γ, D, R."""
    hh = h * h
    return Drive(drive.alpha * hh, drive.beta * hh, drive.gamma * h, drive.delta * hh, drive.ramp * (hh * h))


def taylor_coefficients(w: Any, c: Any, s: Any, drive: Drive, order: int) -> tuple[list, list]:
    """Return the Taylor coefficients W_0 ... W_order of hθ', and H_0 ... of (hθ')²/2 up to order - 1.

    Parameters
    ----------
    w, c, s : number
        hθ', cosθ and sinθ at the start.
    drive : Drive
        Scaled coefficients.
    order : int
        The highest coefficient of W.
    """
    a, b, gamma, d, r = drive
    W, Q, H = [w], [a * c - b * s], [0.5 * (w * w)]
    W.append(d - (a * s + b * c) - gamma * w)
    for k in range(1, order):
        # The convolution of W with itself is symmetric, so half of its products are enough.
        pairs = [(W[j], W[k - j]) for j in reversed(range((k + 1) // 2))]
        H.append(sum_of_products(pairs if k % 2 else [(0.5 * W[k // 2], W[k // 2]), *pairs]))
        work = H[k - 1] * (gamma * (2.0 / k)) - d * W[k - 1] * (1.0 / k)
        if k > 1:
            work = work - r * W[k - 2] * (1.0 / k)
        Q.append(H[k] + work)
        # P_k itself is not needed: it goes straight into W. What is known last enters last.
        early = sorted(range(k), key=lambda j: (max(j, k - 1 - j), j))
        torque = sum_of_products((Q[j], W[k - 1 - j]) for j in early)
        change = W[k] * (gamma * (-1.0 / (k + 1))) + torque * (-1.0 / (k * (k + 1)))
        W.append(change + 0.5 * r if k == 1 else change)
    return W, H


def rotate(c: Any, s: Any, angle: Any) -> tuple[Any, Any]:
    """Turn the pair (cos, sin) by an angle of at most 0.6 rad and restore its length to rounding."""
    z = angle * angle
    sine = angle * polynomial(_SIN, z)
    # One Newton step towards c² + s² = 1 goes into the same sum, so that what is added to c and s is small
    # and is rounded once, to either side. Scaling afterwards favours one side, and energy drifts.
    less = z * polynomial(_COS[1:], z) - 0.5 * ((c * c - 1.0) + s * s)
    return c + (c * less - s * sine), s + (s * less + c * sine)


def step_change(omega: Any, c: Any, s: Any, drive: Drive, h: Any, order: int = ORDER) -> tuple:
    """Return by how much θ and hθ' change in one step of the series, and (cosθ, sinθ) after it."""
    W, _ = taylor_coefficients(omega * h, c, s, scaled(drive, h), order)
    change = pairwise_sum(W[1:])
    angle = pairwise_sum([w * (1.0 / (k + 1)) for k, w in enumerate(W)])
    return angle, change, *rotate(c, s, angle)


def step(theta: Any, omega: Any, c: Any, s: Any, drive: Drive, h: Any, order: int = ORDER) -> tuple:
    """Advance (θ, θ', cosθ, sinθ) by one step of the series."""
    angle, change, c, s = step_change(omega, c, s, drive, h, order)
    return theta + angle, omega + change * (1.0 / h), c, s


def certified(omega: Any, drive: Drive, h: Any, x: Any, xp: Any) -> Any:
    """Tell whether the three conditions of the bound hold for this x; written without a root."""
    a, b, gamma, d, r = scaled(drive, h)
    half, loss = 0.5 * (x * x), xp.abs(gamma) * x
    room = half - loss - xp.abs(d)
    if not (isinstance(r, float) and r == 0.0):
        room = xp.minimum(room, half - 0.5 * loss - xp.abs(r) * (1.0 / x))
    return (xp.abs(omega * h) <= x) & (room >= 0.0) & (a * a + b * b <= room * room)


def largest_x(dt: float, order: int = ORDER, tolerance: float = TOLERANCE) -> float:
    """Return the largest x for which one step of length dt is exact to the tolerance in θ' [rad/s].

    Solves xκ^(N+1)/(1-κ) = tolerance·dt with κ = x/2.

    Examples
    --------
    >>> round(largest_x(0.02) / 2, 3)
    0.165
    """
    x = 0.3
    for _ in range(60):
        x = 2.0 * (tolerance * dt * (1.0 - x / 2.0) / x) ** (1.0 / (order + 1))
        x = min(x, 0.5)  # the polynomials of `rotate` are exact to 0.6 rad
    return x


class Bound(NamedTuple):
    """What is known before a step is taken."""

    substeps: int
    order: int
    theta: float  # bound on the truncation error of θ, summed over the substeps [rad]
    theta_dot: float  # the same for θ' [rad/s]


def truncation_bound(omega: float, drive: Drive, dt: float, order: int = ORDER) -> Bound:
    """Return the number of substeps of a step and the proved bound on what they leave out.

    Each substep's bound is proved; they are added up without the amplification, by the system itself, of what
    earlier substeps left out. Where `flow` jumps along the slow manifold (heavy damping) the count is that
    of plain substeps, which the jump replaces.
    """
    largest = largest_x(dt, order)
    one = certified(omega, drive, dt, largest, np)
    n = 1 if one else min(_substeps(omega, *drive, dt, order), 1e15)
    h = dt / n
    # One step needs the bound at its start only, several need it all the way.
    x = _rate(omega, *drive, dt if n > 1 else 0.0) * h
    if one:
        x = min(x, largest)
    tail = x * (x / 2.0) ** (order + 1) / (1.0 - x / 2.0) if x < 2.0 else math.inf
    return Bound(int(n), order, n * tail / (order + 2), n * tail / h)


def _rate(omega, alpha, beta, gamma, delta, ramp, dt):  # type: ignore[no-untyped-def]
    """Return x/h such that the bound holds anywhere in the interval, for small h."""
    field = math.sqrt(alpha * alpha + beta * beta)
    push = abs(delta) + abs(ramp) * dt
    # What the field adds to the speed is limited by its acceleration and, from top to bottom, by its energy,
    # 2 field.
    speed = min(abs(omega) + field * dt, math.sqrt(omega * omega + 4.0 * field)) + push * dt
    if gamma * speed > field + push:
        speed = max(abs(omega), (field + push) / gamma)
    elif gamma < 0.0:
        speed *= math.exp(min(-gamma * dt, 700.0))
    root = abs(gamma) + math.sqrt(gamma * gamma + 2.0 * (field + push)) + (2.0 * abs(ramp)) ** (1.0 / 3.0)
    return max(speed, root)


def _substeps(omega, alpha, beta, gamma, delta, ramp, dt, order):  # type: ignore[no-untyped-def]
    """Return the number of substeps for TOLERANCE, as a float that may be huge.

    From n · xκ^(N+1)/(1-κ)/h <= TOLERANCE · scale with x = rate h, κ = x/2 <= 0.2, h = dt/n.
    """
    rate = _rate(omega, alpha, beta, gamma, delta, ramp, dt)
    scale = max(1.0, max(abs(omega), (alpha * alpha + beta * beta) ** 0.25))
    half = 0.5 * rate * dt
    n = (rate / (0.8 * TOLERANCE * scale)) ** (1.0 / order) * half ** (1.0 + 1.0 / order)
    return np.ceil(max(1.0, max(n, 5.0 * half)))


def _slow_substep(theta, c, s, alpha, beta, gamma, delta, ramp, h):  # type: ignore[no-untyped-def]
    """Advance along the slow manifold; return (θ, θ', cos, sin) at the end.

    There W = -(P - D - R tau + W')/Γ holds with a series of its own. Solved by sweeps,
    each of which gains a factor of about (|field| + |delta|)/gamma².
    """
    a, b, g = alpha * h * h, beta * h * h, gamma * h
    d, r = delta * h * h, ramp * h * h * h
    W = np.zeros(order + 2)
    P = np.zeros(order + 1)
    Q = np.zeros(order + 1)
    P[0] = a * s + b * c
    Q[0] = a * c - b * s
    for _ in range(8):
        for k in range(order + 1):
            force = P[k] + (k + 1) * W[k + 1]
            if k == 0:
                force -= d
            elif k == 1:
                force -= r
            W[k] = -force / g
            if k < order:
                p = 0.0
                q = 0.0
                for j in range(k + 1):
                    p += Q[j] * W[k - j]
                    q += P[j] * W[k - j]
                P[k + 1] = p / (k + 1)
                Q[k + 1] = -q / (k + 1)
    w = 0.0
    angle = 0.0
    for k in range(order, -1, -1):
        w += W[k]
        angle += W[k] / (k + 1)
    c1, s1 = turn(c, s, angle)
    return theta + angle, w / h, c1, s1


def _flow(theta, omega, c, s, alpha, beta, gamma, delta, ramp, dt, x):  # type: ignore[no-untyped-def]
    """Advance by dt with as many substeps as the bound asks for; return the state and their number.

    The number is negative where the step is refused: too many substeps, or no finite result.
    """
    if holds(omega, alpha, beta, gamma, delta, ramp, dt, x):
        angle, change, c, s = series(omega, c, s, alpha, beta, gamma, delta, ramp, dt)
        return theta + angle, fma(change, 1.0 / dt, omega), c, s, 1
    field = math.sqrt(alpha * alpha + beta * beta) + abs(delta) + abs(ramp) * dt
    # Heavy damping: resolve the boundary layer, which decays like exp(-gamma t), then jump along the
    # slow manifold. Tested against 40 digits for field/gamma² up to 1e-3, with and without drive.
    layer = dt
    if gamma > 0.0 and field <= 1e-3 * gamma * gamma:
        layer = (40.0 + math.log(max(1.0, abs(omega) + field / gamma))) / gamma
    slow = layer < 0.5 * dt
    if not slow:
        layer = dt
    n = _substeps(omega, alpha, beta, gamma, delta, ramp, layer, order)
    m = 0.0
    if slow:
        m = np.ceil(max(1.0, 12.0 * field / gamma * (dt - layer)))
    # A substep along the slow manifold costs as much as 50 others.
    if not n + 50.0 * m <= MAX_SUBSTEPS:
        return theta, omega, c, s, -1
    h = layer / n
    # What rounding takes from the two sums is handed on (Kahan): equal terms would all round to one side.
    turned = lost_angle = lost_speed = 0.0
    for i in range(int(n)):
        angle, change, c, s = series(omega, c, s, alpha, beta, gamma, delta + ramp * (i * h), ramp, h)
        angle, speed = angle - lost_angle, change / h - lost_speed
        turned_end, omega_end = turned + angle, omega + speed
        lost_angle, lost_speed = (turned_end - turned) - angle, (omega_end - omega) - speed
        turned, omega = turned_end, omega_end
    theta += turned
    if slow:
        h = (dt - layer) / m
        for i in range(int(m)):
            push = delta + ramp * (layer + i * h)
            theta, omega, c, s = _slow_substep(theta, c, s, alpha, beta, gamma, push, ramp, h)
    if not (abs(theta) < math.inf and abs(omega) < math.inf):
        return theta, omega, c, s, -2
    return theta, omega, c, s, int(n + m)


@cache
def compile_flow(present: tuple[bool, ...], order: int = ORDER, tolerance: float = TOLERANCE) -> Callable:
    """Compile `_flow` for a pendulum that has only some of the terms.

    Parameters
    ----------
    present : tuple of bool
        For each coefficient of `Drive`, whether it is there; the others leave no code behind.
    order : int, default 16
        Order of the series.
    tolerance : float, default 1e-12
        What substeps are chosen for [rad/s].

    Returns
    -------
    callable
        ``flow(theta, omega, c, s, alpha, beta, gamma, delta, ramp, dt, x)`` to
        ``(theta, omega, c, s, substeps)``; `substeps` is negative where the step is refused.
    """
    absent = frozenset(name for name, there in zip(Drive._fields, present, strict=True) if not there)
    coefficients = "alpha, beta, gamma, delta, ramp"
    series = compile_traced(
        "series",
        f"omega, c, s, {coefficients}, h",
        lambda xp, omega, c, s, *rest: step_change(omega, c, s, Drive(*rest[:5]), rest[5], order),
        absent,
    )
    holds = compile_traced(
        "holds",
        f"omega, {coefficients}, h, x",
        lambda xp, omega, *rest: (certified(omega, Drive(*rest[:5]), rest[5], rest[6], xp),),
        absent,
    )
    turn = compile_traced("turn", "c, s, angle", lambda xp, c, s, angle: rotate(c, s, angle))
    rate = compile_python("_rate", _rate)
    count = compile_python("_substeps", _substeps, rate, TOLERANCE=tolerance)
    slow = compile_python("_slow_substep", _slow_substep, turn, order=order)
    return compile_python("flow", _flow, holds, series, count, slow, order=order, MAX_SUBSTEPS=MAX_SUBSTEPS)
