"""The driven, damped pendulum: Taylor series without trigonometry, with a bound known before the step.

The bar on its pivot and the cylinder in its shell obey the same equation while a control is held::

    theta'' = -alpha sin(theta) - beta cos(theta) - gamma theta' + delta + ramp t

Let h be the step, t = h tau, and A = alpha h², B = beta h², Γ = gamma h, D = delta h², R = ramp h³,
W = h theta', P = A sin + B cos, Q = A cos - B sin. The Taylor coefficients in tau follow from
W' = -P - ΓW + D + R tau, P' = QW, and from the energy identity Q' = WW' + ΓW² - DW - R tau W, which saves a
second convolution: with H = W²/2 it reads Q' = H' + 2ΓH - (D + R tau) W. No sine or cosine is called; the
pair (cos, sin) is rotated by the step's angle with two short polynomials.

**Bound of one series** (method of majorants). E = Q + iP obeys E' = iWE, so |E_0| = G = √(A² + B²). With
a = |W_0| + |Γ| and b = G + |D| + |Γ W_0|, suppose that some x and y, x/5 <= y <= x, fulfil

    a <= y,   b <= z = x (x - y/2),   a b + |R| <= y z.

Then the solution of V'' = V V' with V(0) = y, V'(0) = z has coefficients V_k >= |W_k| for k >= 1. It is a
tangent, and its pole nearest to 0 is at least 2/x away. With κ = x/2, its expansion in poles gives |W_k| <=
(5/4) xκ^k for k >= 7. For a series cut off after W_N, the truncation error is at most (5/4) xκ^(N+1)/(1-κ) in
hθ', and that divided by N + 2 in θ.

**Bound of substeps.** If x²/2 >= |Γ|x + G + |D| and x (x²/2 - |Γ|x/2 - G) >= |R| too, for an x >= |W|, then
xκ^k >= |W_k| by induction, without the factor 5/4. docs/numerics.md has the proofs.

If one series is not enough, the step is divided. Sums over many substeps are computed with twice the digits
(`substep`); under heavy damping most substeps are saved by following the slow manifold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from lag_envs.stepping.compiling import compile_lines, compile_python, compile_traced, record_block
from lag_envs.stepping.dual import Variable
from lag_envs.stepping.tracing import Trace, pairwise_sum, polynomial, sum_of_products
from lag_envs.stepping.twofold import Twofold, mixed_polynomial, twofold_parts

ORDER = 16
TOLERANCE = 1e-12
#: Factor of the bound of one series of order 6 or more, for the tangent's other poles: 1.2426, rounded up.
LOSS = 1.25
MAX_SUBSTEPS = 1_000_000
#: Substeps compute the coefficients up to this order with twice the digits. Rounding errors of later
#: coefficients are below 1e-20, because each coefficient is at least five times smaller than the one before.
TWOFOLD = 5
#: From this order on, a convolution is computed as two sums.
TWO_SUMS = 8

_SIN = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(8)]
_COS = [(-1.0) ** k / math.factorial(2 * k) for k in range(9)]


class Coefficients(NamedTuple):
    """Coefficients of the normal form while a control is held; a literal 0.0 drops the term."""

    alpha: Any  # [1/s²]
    beta: Any = 0.0  # [1/s²]
    gamma: Any = 0.0  # [1/s]
    delta: Any = 0.0  # [rad/s²]
    ramp: Any = 0.0  # [rad/s³]

    @property
    def damping_rate(self) -> Any:
        """The rate at which drag alone slows the motion [1/s]; every flow's coefficients have one."""
        return self.gamma


def acceleration(theta_dot: Any, c: Any, s: Any, coeffs: Coefficients) -> Any:
    """Return theta'' at the start of the step, where t = 0."""
    return coeffs.delta - coeffs.alpha * s - coeffs.beta * c - coeffs.gamma * theta_dot


def scaled(coeffs: Coefficients, h: Any) -> Coefficients:
    """Return the coefficients with time measured in steps: A, B, Γ, D, R."""
    hh = h * h
    return Coefficients(
        coeffs.alpha * hh, coeffs.beta * hh, coeffs.gamma * h, coeffs.delta * hh, coeffs.ramp * (hh * h)
    )


def taylor_coefficients(w: Any, c: Any, s: Any, coeffs: Coefficients, order: int) -> tuple[list, list]:
    """Return the Taylor coefficients W_0 ... W_order of hθ', and H_0 ... of (hθ')²/2 up to order - 1.

    Parameters
    ----------
    w, c, s : number
        hθ', cosθ and sinθ at the start.
    coeffs : Coefficients
        Scaled coefficients.
    order : int
        The highest coefficient of W.
    """
    a, b, gamma, d, r = coeffs
    W, Q, H = [w], [a * c - b * s], [0.5 * (w * w)]
    W.append(d - (a * s + b * c) - gamma * w)
    for k in range(1, order):
        # The convolution of W with itself is symmetric, so half of its products are enough.
        pairs = [(W[j], W[k - j]) for j in reversed(range((k + 1) // 2))]
        H.append(sum_of_products(pairs if k % 2 else [(0.5 * W[k // 2], W[k // 2]), *pairs]))
        work = (2.0 * gamma) * H[k - 1] - d * W[k - 1] - (r * W[k - 2] if k > 1 else 0.0)
        Q.append(H[k] + work * (1.0 / k))
        # P_k itself is not needed, as it goes straight into W. The terms that are known last are added last.
        # A processor computes two short sums at once, which takes less time than a long one.
        early = sorted(range(k), key=lambda j: (max(j, k - 1 - j), j))
        terms = [(Q[j], W[k - 1 - j]) for j in early]
        half = k // 2 if k >= TWO_SUMS else 0
        torque = pairwise_sum([sum_of_products(part) for part in (terms[:half], terms[half:]) if part])
        change = torque * (-1.0 / (k * (k + 1))) + W[k] * (gamma * (-1.0 / (k + 1)))
        W.append(change + 0.5 * r if k == 1 else change)
    return W, H


def rotate(c: Any, s: Any, angle: Any, polynomial: Callable = polynomial) -> tuple[Any, Any]:
    """Turn the pair (cos, sin) by an angle of at most 0.6 rad and restore its length to rounding."""
    z = angle * angle
    sine = angle * polynomial(_SIN, z)
    # One Newton step towards c² + s² = 1 goes into the same sum. Therefore the change of c and s is small and
    # is rounded once, without bias. Scaling afterwards would be biased, and the energy would drift.
    less = z * polynomial(_COS[1:], z) - 0.5 * ((c * c - 1.0) + s * s)
    return c + (c * less - s * sine), s + (s * less + c * sine)


def step_change(omega: Any, c: Any, s: Any, coeffs: Coefficients, h: Any, order: int) -> tuple:
    """Return the changes of θ and hθ' in one step of the series, and (cosθ, sinθ) after it."""
    W, _ = taylor_coefficients(omega * h, c, s, scaled(coeffs, h), order)
    change = pairwise_sum(W[1:])
    angle = pairwise_sum([w * (1.0 / (k + 1)) for k, w in enumerate(W)])
    return angle, change, *rotate(c, s, angle)


def substep(w: Twofold, c: Twofold, s: Twofold, coeffs: Coefficients, order: int = ORDER) -> tuple:
    """Return hθ', cosθ and sinθ after one of many steps, and the change of θ, with twice the digits.

    Errors of many steps add up, at best like a random walk. They change a pendulum's energy and therefore its
    frequency, so its phase error grows with time. Each step therefore has to be more exact than a float.

    Parameters
    ----------
    w, c, s : Twofold
        hθ', cosθ and sinθ at the start.
    coeffs : Coefficients
        Scaled coefficients, each a `Twofold`.
    order : int
        The highest coefficient of the series.
    """
    large, _ = taylor_coefficients(w, c, s, coeffs, min(TWOFOLD, order))
    W, _ = taylor_coefficients(w.high, c.high, s.high, Coefficients(*(x.high for x in coeffs)), order)
    W[: len(large)] = large
    angle = pairwise_sum([x * (1.0 / (k + 1)) for k, x in enumerate(W)])
    c, s = rotate(c, s, angle, partial(mixed_polynomial, twofold=3))
    return pairwise_sum(W), c, s, angle


def step(theta: Any, omega: Any, c: Any, s: Any, coeffs: Coefficients, h: Any, order: int = ORDER) -> tuple:
    """Advance (θ, θ', cosθ, sinθ) by one step of the series."""
    angle, change, c, s = step_change(omega, c, s, coeffs, h, order)
    return theta + angle, omega + change * (1.0 / h), c, s


def vjp(variables: Sequence, coeffs: Coefficients, h: Any, bars: Sequence, order: int = ORDER) -> list:
    """Return cotangents of θ, θ', cosθ, sinθ and the coefficients before a step from those of θ, θ' after it.

    The cotangents of cosθ and sinθ are included in that of θ. Changes obey the linearised equation: with S, C
    the series of sine and cosine, dW_k = (k+1) dθ_{k+1}, and dD for k = 0, dR for k = 1 on the right-hand
    side,

        (k+1) dW_{k+1} = -Σ_j Q_j dθ_{k-j} - Γ dW_k - S_k dA - C_k dB - W_k dΓ.

    Backwards, this takes one sum of products per order; reverse mode through `taylor_coefficients` would take
    three.

    Parameters
    ----------
    variables : sequence of number
        θ, θ', cosθ and sinθ at the start.
    coeffs : Coefficients
        Coefficients.
    h : number
        The step.
    bars : sequence of number
        Cotangents of θ and θ' after the step.
    order : int
        The highest coefficient of W.
    """
    _, omega, c, s = variables
    a, b, gamma, d, r = scaled(coeffs, h)
    W, C, S = [omega * h], [c], [s]
    for k in range(order):
        drive = d if k == 0 else r if k == 1 else 0.0
        W.append((drive - (a * S[k] + b * C[k]) - gamma * W[k]) * (1.0 / (k + 1)))
        C.append(sum_of_products((S[j], W[k - j]) for j in range(k + 1)) * (-1.0 / (k + 1)))
        S.append(sum_of_products((C[j], W[k - j]) for j in range(k + 1)) * (1.0 / (k + 1)))
    Q = [a * x - b * y for x, y in zip(C, S, strict=True)]
    angle, change = bars[0], bars[1] * (1.0 / h)
    # Cotangents of dW_{k+1}, divided by k + 1, and of -dθ_{k+1}.
    right: list[Any] = [0.0] * (order + 1)
    turned: list[Any] = [0.0] * (order + 2)
    for k in reversed(range(order)):
        bar = angle * (1.0 / (k + 2)) + change - gamma * right[k + 1] - turned[k + 2] * (1.0 / (k + 2))
        right[k] = bar * (1.0 / (k + 1))
        turned[k] = sum_of_products((Q[j - k], right[j]) for j in reversed(range(k, order)))
    hh = h * h

    def total(series: Sequence) -> Any:
        return -sum_of_products(zip(series, right[:order], strict=False))

    return [
        bars[0] - turned[0],
        bars[1] + h * (angle - gamma * right[0] - turned[1]),
        0.0,
        0.0,
        hh * total(S),
        hh * total(C),
        h * total(W),
        hh * right[0],
        hh * h * right[1],
    ]


def step_slopes(
    omega: Any, c: Any, s: Any, coeffs: Coefficients, h: Any, elapsed: Any, columns: Sequence[str], order: int
) -> list:
    """Return the derivatives of the changes of θ, then of θ', in one step of the series.

    Parameters
    ----------
    omega, c, s : number
        θ', cosθ and sinθ at the start.
    coeffs : Coefficients
        Coefficients at time 0.
    h, elapsed : number
        The step, and the time at which it begins.
    columns : sequence of str
        Variables of the derivatives: ``theta``, ``omega`` and names of coefficients.
    order : int
        The highest coefficient of W.
    """
    number = partial(Variable.of_column, columns)
    a, b, gamma, delta, ramp = (
        number(name, value) for name, value in zip(Coefficients._fields, coeffs, strict=True)
    )
    theta = number("theta", 0.0).slopes
    W, _ = taylor_coefficients(
        number("omega", omega) * h,
        Variable(c, -(theta * s)),
        Variable(s, theta * c),
        scaled(Coefficients(a, b, gamma, delta + ramp * elapsed, ramp), h),
        order,
    )
    turned = [w.slopes for w in W]
    angle = pairwise_sum([w * (1.0 / (k + 1)) for k, w in enumerate(turned)])
    return [*angle, *(pairwise_sum(turned[1:]) * (1.0 / h))]


def _absent(coefficient: Any) -> bool:
    return isinstance(coefficient, float) and coefficient == 0.0


def certified(omega: Any, coeffs: Coefficients, h: Any, x: Any, xp: Any) -> Any:
    """Return whether the conditions of the bound of one series hold for this x."""
    a, b, gamma, d, r = scaled(coeffs, h)
    speed, drag = xp.abs(omega * h), xp.abs(gamma)
    first, forced = speed + drag, xp.abs(d) + drag * speed
    # Without a ramp, the smallest y is best, and no root is needed.
    room = x * (x - 0.5 * xp.maximum(first, 0.2 * x)) - forced
    field = a * a + b * b
    fits = (first <= x) & (room >= 0.0) & (field <= room * room)
    if _absent(r):
        return fits
    second, most = (xp.abs(a) if _absent(b) else xp.sqrt(field)) + forced, x * x
    # With a ramp, the largest y is best: the smaller of x and 2 (x - b/x).
    product = xp.minimum(most, 2.0 * (most - second)) * xp.maximum(0.5 * most, second)  # x y z
    return fits & ((first * second + xp.abs(r)) * x <= product)


def largest_majorant(dt: float, order: int = ORDER) -> float:
    """Return the largest x for which one step of length dt is exact to `TOLERANCE` in θ' [rad/s].

    Solves (5/4) xκ^(N+1)/(1-κ) = `TOLERANCE`·dt with κ = x/2, minus a margin larger than rounding.

    Examples
    --------
    >>> round(largest_majorant(0.02) / 2, 3)
    0.163
    """
    x = 0.3
    for _ in range(60):
        x = 2.0 * (TOLERANCE * dt * (1.0 - x / 2.0) / (LOSS * x)) ** (1.0 / (order + 1))
        x = min(x, 0.5)  # the polynomials of `rotate` are exact to 0.6 rad
    return x * (1.0 - 1e-14)


def least_majorant(omega: float, coeffs: Coefficients, h: float) -> float:
    """Return an x, small though not the smallest, for which the conditions of `certified` hold."""
    a, b, gamma, d, r = scaled(coeffs, h)
    speed, more = abs(omega * h), abs(r) ** (1.0 / 3.0)
    # With `more` added to one factor and its square to the other, their product grows by at least |R|.
    first = speed + abs(gamma) + more
    second = math.hypot(a, b) + abs(d) + abs(gamma) * speed + more * more
    return max(first, 0.25 * (first + math.sqrt(first * first + 16.0 * second)), math.sqrt(second / 0.9))


def certified_speed(coeffs: Coefficients, dt: float, order: int = ORDER) -> float:
    """Return the largest |θ'| for which one series is enough [rad/s]; negative if it never is."""
    x = largest_majorant(dt, order)
    if not certified(0.0, coeffs, dt, x, np):
        return -1.0
    low, high = 0.0, 2.0 * x / dt
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if certified(middle, coeffs, dt, x, np) else (low, middle)
    return low


class Bound(NamedTuple):
    """Bounds on a step, known before it is taken."""

    substeps: int
    order: int
    theta: float  # bound on the truncation error of θ, summed over the substeps [rad]
    theta_dot: float  # the same for θ' [rad/s]


def truncation_bound(omega: float, coeffs: Coefficients, dt: float, order: int = ORDER) -> Bound:
    """Return the number of substeps of a step and the proved bound on their truncation error.

    A single series is used only if its truncation error of θ' is proved to be at most `TOLERANCE` [rad/s].
    If not, the step is divided, and the truncation errors of all substeps together are at most `TOLERANCE`
    times the size of θ', max(1, |θ'|, (alpha² + beta²)^¼).

    Each substep's bound is proved; their sum does not account for the system's own amplification of earlier
    truncation errors. If `flow` jumps along the slow manifold (heavy damping), the count is that of the plain
    substeps that the jump replaces.
    """
    largest = largest_majorant(dt, order)
    with np.errstate(all="ignore"):  # too fast for floats: not certified
        one = certified(omega, coeffs, dt, largest, np)
    n = 1.0 if one else min(float(_substeps(omega, *coeffs, dt, order)), 1e15)
    h = dt / n
    # A single step needs the bound only at its start; several steps need it throughout.
    x = min(least_majorant(omega, coeffs, dt), largest) if one else _rate(omega, *coeffs, dt) * h
    left_out = tail(x, order) * (1.0 if one else n / LOSS)  # the bound of substeps has no such factor
    return Bound(int(n), order, left_out / (order + 2), left_out / h)


def tail(x: float, order: int = ORDER) -> float:
    """Return the bound on what one series leaves out of hθ'."""
    return LOSS * x * (x / 2.0) ** (order + 1) / (1.0 - x / 2.0) if x < 2.0 else math.inf


def _rate(omega, alpha, beta, gamma, delta, ramp, dt):  # type: ignore[no-untyped-def]
    """Return x/h such that, for small h, the bound holds anywhere in the interval."""
    field = math.sqrt(alpha * alpha + beta * beta)
    drive = abs(delta) + abs(ramp) * dt
    # The speed that the field can add is limited by the field's acceleration, and by its energy between top
    # and bottom, 2 field.
    speed = min(abs(omega) + field * dt, math.sqrt(omega * omega + 4.0 * field)) + drive * dt
    if gamma * speed > field + drive:
        speed = max(abs(omega), (field + drive) / gamma)
    elif gamma < 0.0:
        speed *= math.exp(min(-gamma * dt, 700.0))
    root = abs(gamma) + math.sqrt(gamma * gamma + 2.0 * (field + drive)) + (2.0 * abs(ramp)) ** (1.0 / 3.0)
    return max(speed, root)


def _substeps(omega, alpha, beta, gamma, delta, ramp, dt, order):  # type: ignore[no-untyped-def]
    """Return the number of substeps of a step that needs several, as a float, which may be huge.

    From n · xκ^(N+1)/(1-κ)/h <= TOLERANCE · size with x = rate h, κ = x/2 <= 0.2, h = dt/n.
    """
    rate = _rate(omega, alpha, beta, gamma, delta, ramp, dt)
    size = max(1.0, max(abs(omega), (alpha * alpha + beta * beta) ** 0.25))
    half = 0.5 * rate * dt
    n = (rate / (0.8 * TOLERANCE * size)) ** (1.0 / order) * half ** (1.0 + 1.0 / order)
    return np.ceil(max(2.0, max(n, 5.0 * half)))


def _divided(theta, omega, c, s, alpha, beta, gamma, delta, ramp, dt, n):  # type: ignore[no-untyped-def]
    """Advance by dt in n equal substeps; return θ, θ', cosθ, sinθ."""
    h = dt / n
    h_low = fma(-h, n, dt) / n
    scaled = scale(omega, alpha, beta, gamma, delta, ramp, h, h_low)
    w, w_low = scaled[0], scaled[1]
    c_low = s_low = turned = turned_low = 0.0
    for i in range(int(n)):
        w, w_low, c, c_low, s, s_low, turned, turned_low = substep(
            w, w_low, c, c_low, s, s_low, turned, turned_low, *scaled[2:], float(i)
        )
    omega = w / h
    return theta + turned, omega + (fma(-omega, h, w) + (w_low - omega * h_low)) / h, c, s


def _slow_motion(theta, c, s, alpha, beta, gamma, delta, ramp, dt, n, order, slopes):  # type: ignore[no-untyped-def]
    """Advance by dt along the slow manifold in n equal substeps; return θ, θ', cosθ, sinθ.

    A column of `slopes` holds the derivatives of θ, θ', cosθ, sinθ and the coefficients at the start, with
    respect to anything; those of θ and θ' are replaced.

    On the manifold θ' is the drift due to drive and drag alone, known in closed form, plus a part V due to
    the field. In a substep V = -(P + V')/Γ has a series of its own. It is found by sweeps, each of which
    gains a factor of about |θ'|/gamma.
    """
    h = dt / n
    a, b, g = alpha * h * h, beta * h * h, gamma * h
    V, P, Q = np.zeros(order + 2), np.zeros(order + 1), np.zeros(order + 1)
    drift = slope = w = 0.0
    start_c, start_s = c, s
    # The sum's rounding error is carried forward (Kahan): equal terms would all round in the same direction.
    turned = lost = 0.0
    for i in range(int(n)):
        # The drift's rate at the substep's start, and the growth of this rate, in units of the substep.
        drift = (delta + ramp * (i * h) - ramp / gamma) / gamma * h
        slope = ramp / gamma * h * h
        P[0] = a * s + b * c
        Q[0] = a * c - b * s
        for k in range(order + 1):
            V[k] = 0.0
        for _ in range(8):
            for k in range(order + 1):
                V[k] = -(P[k] + (k + 1) * V[k + 1]) / g
                if k < order:
                    p = Q[k] * (drift + V[0]) + (Q[k - 1] * slope if k > 0 else 0.0)
                    q = P[k] * (drift + V[0]) + (P[k - 1] * slope if k > 0 else 0.0)
                    for j in range(k):
                        p += Q[j] * V[k - j]
                        q += P[j] * V[k - j]
                    P[k + 1] = p / (k + 1)
                    Q[k + 1] = -q / (k + 1)
        if slopes.shape[1] > 0:
            slow_slopes(slopes, V, P, Q, c, s, g, h, i * h, gamma, delta, ramp, order)
        w = angle = 0.0
        for k in range(order, -1, -1):
            w += V[k]
            angle += V[k] / (k + 1)
        angle = angle + (drift + 0.5 * slope) - lost
        end = turned + angle
        lost = (end - turned) - angle
        turned = end
        # This is computed from the start of the whole step, so that errors do not add up.
        p, q = math.cos(turned), math.sin(turned)
        p, q = p + lost * q, q - lost * p
        c, s = start_c * p - start_s * q, start_s * p + start_c * q
    return theta + turned, (w + (drift + slope)) / h, c, s


def _slow_slopes(slopes, V, P, Q, c, s, g, h, elapsed, gamma, delta, ramp, order):  # type: ignore[no-untyped-def]
    """Carry derivatives over a substep along the slow manifold: the derivative of `_slow_motion`."""
    drift = (delta + ramp * elapsed - ramp / gamma) / gamma * h
    slope = ramp / gamma * h * h
    U = V.copy()
    U[0] += drift
    U[1] += slope
    dU, dV, dP, dQ = np.zeros(order + 2), np.zeros(order + 2), np.zeros(order + 2), np.zeros(order + 2)
    for column in range(slopes.shape[1]):
        turn, _, _, _, d_alpha, d_beta, d_gamma, d_delta, d_ramp = slopes[:, column]
        rate = (delta + ramp * elapsed - 2.0 * ramp / gamma) / gamma * d_gamma
        d_drift = (d_delta + d_ramp * (elapsed - 1.0 / gamma) - rate) / gamma * h
        d_slope = (d_ramp - ramp / gamma * d_gamma) / gamma * h * h
        dP[0] = (d_alpha * s + d_beta * c) * h * h + Q[0] * turn
        dQ[0] = (d_alpha * c - d_beta * s) * h * h - P[0] * turn
        for k in range(order + 2):
            dV[k] = 0.0
        for _ in range(8):
            for k in range(order + 1):
                dV[k] = -(dP[k] + (k + 1) * dV[k + 1] + V[k] * d_gamma * h) / g
                dU[k] = dV[k] + (d_drift if k == 0 else d_slope if k == 1 else 0.0)
                if k < order:
                    p = q = 0.0
                    for j in range(k + 1):
                        p += dQ[j] * U[k - j] + Q[j] * dU[k - j]
                        q += dP[j] * U[k - j] + P[j] * dU[k - j]
                    dP[k + 1] = p / (k + 1)
                    dQ[k + 1] = -q / (k + 1)
        speed = angle = 0.0
        for k in range(order, -1, -1):
            speed += dU[k]
            angle += dU[k] / (k + 1)
        slopes[0, column] += angle
        slopes[1, column] = speed / h


def _no_slopes(slopes, V, P, Q, c, s, g, h, elapsed, gamma, delta, ramp, order):  # type: ignore[no-untyped-def]
    """Carry no derivatives; a plain step compiles this in place of `_slow_slopes`."""


def _plan(omega, alpha, beta, gamma, delta, ramp, dt, order, field_counts):  # type: ignore[no-untyped-def]
    """Return how a step is divided: until when, into how many substeps, and how many along the slow manifold.

    The last result tells whether drive and drag alone determine the motion there; it is false if derivatives
    with respect to the field are wanted (`field_counts`). The second result is negative if there would be
    too many substeps.
    """
    field = math.sqrt(alpha * alpha + beta * beta)
    drive = abs(delta) + abs(ramp) * dt
    # Heavy damping: resolve the boundary layer, which decays like exp(-gamma t), then follow the slow
    # manifold. Tested against 40 digits for field/gamma² up to 1e-3 and drive/gamma² up to 1e-2. If the field
    # is negligible compared with the drive, the drift is the whole motion.
    drift = field <= 1e-18 * drive and not field_counts
    layer = dt
    if gamma > 0.0 and field <= 1e-3 * gamma * gamma and (drift or drive <= 1e-2 * gamma * gamma):
        layer = (40.0 + math.log(max(1.0, abs(omega) + (field + drive) / gamma))) / gamma
    slow = layer < 0.5 * dt
    if not slow:
        layer = dt
    n = _substeps(omega, alpha, beta, gamma, delta, ramp, layer, order)
    m = 0.0
    if slow:
        m = 1.0
        if not drift:
            m = np.ceil(max(1.0, (12.0 * field + 4.0 * drive) / gamma * (dt - layer)))
    # A substep along the slow manifold costs as much as 50 plain substeps.
    if not n + 50.0 * m <= MAX_SUBSTEPS:
        n = -1.0
    return layer, n, m, drift


def _flow(theta, omega, c, s, alpha, beta, gamma, delta, ramp, dt, x):  # type: ignore[no-untyped-def]
    """Advance by dt with as many substeps as the bound requires; return the state and their number.

    The number is negative if the step is refused: too many substeps, or no finite result.
    """
    if holds(omega, alpha, beta, gamma, delta, ramp, dt, x):
        angle, change, c, s = series(omega, c, s, alpha, beta, gamma, delta, ramp, dt)
        return theta + angle, fma(change, 1.0 / dt, omega), c, s, 1
    layer, n, m, drift = plan(omega, alpha, beta, gamma, delta, ramp, dt, order, False)
    if n < 0.0:
        return theta, omega, c, s, -1
    theta, omega, c, s = divided(theta, omega, c, s, alpha, beta, gamma, delta, ramp, layer, n)
    if m > 0.0:
        if drift:
            alpha = beta = 0.0
        delta += ramp * layer
        theta, omega, c, s = slow_motion(
            theta, c, s, alpha, beta, gamma, delta, ramp, dt - layer, m, order, np.empty((9, 0))
        )
    if not (abs(theta) < math.inf and abs(omega) < math.inf):
        return theta, omega, c, s, -2
    return theta, omega, c, s, int(n + m)


@cache
def compile_flow(absent: frozenset[str] = frozenset(), order: int = ORDER) -> Callable:
    """Compile `_flow` for a pendulum that has only some of the terms.

    Parameters
    ----------
    absent : frozenset of str
        Coefficients that are zero: they leave no code.
    order : int, default 16
        Order of the series.

    Returns
    -------
    callable
        ``flow(theta, omega, c, s, alpha, beta, gamma, delta, ramp, dt, x)`` to
        ``(theta, omega, c, s, substeps)``; `substeps` is negative if the step is refused.
    """
    holds, series = _compile_parts(absent, order)
    divided = compile_python("divided", _divided, *_divided_parts(order))
    plan, slow = _compile_plan(), _compile_slow_motion(_no_slopes)
    return compile_python("flow", _flow, holds, series, plan, divided, slow, order=order)


@cache
def _compile_parts(absent: frozenset[str], order: int) -> tuple[Callable, Callable]:
    """Compile the condition of the bound, and one step of the series."""
    coefficients = "alpha, beta, gamma, delta, ramp"
    series = compile_traced(
        "series",
        f"omega, c, s, {coefficients}, h",
        lambda xp, omega, c, s, *rest: step_change(omega, c, s, Coefficients(*rest[:5]), rest[5], order),
        absent,
    )
    holds = compile_traced(
        "holds",
        f"omega, {coefficients}, h, x",
        lambda xp, omega, *rest: (certified(omega, Coefficients(*rest[:5]), rest[5], rest[6], xp),),
        absent,
    )
    return holds, series


@cache
def _compile_plan() -> Callable:
    count = compile_python("_substeps", _substeps, compile_python("_rate", _rate), TOLERANCE=TOLERANCE)
    return compile_python("plan", _plan, count, MAX_SUBSTEPS=MAX_SUBSTEPS)


@cache
def _compile_slow_motion(slopes: Callable) -> Callable:
    return compile_python("slow_motion", _slow_motion, compile_python("slow_slopes", slopes))


@cache
def _divided_parts(order: int) -> tuple[Callable, Callable]:
    """Compile the helpers of `_divided`, once for all pendulums; zero coefficients add nothing."""
    coefficients = ", ".join(Coefficients._fields)
    pairs = ", ".join(f"{name}, {name}_low" for name in ("w", "c", "s", "turned", *Coefficients._fields))

    def scale(xp: Any, omega: Any, *numbers: Any) -> tuple:
        *coeffs, h, h_low = numbers
        step = Twofold(h, h_low)
        return twofold_parts(step * omega, *scaled(Coefficients(*map(Twofold, coeffs)), step))

    def one(xp: Any, *numbers: Any) -> tuple:
        *halves, i = numbers
        w, c, s, turned, *coeffs = map(Twofold, halves[::2], halves[1::2])
        a, b, gamma, d, r = coeffs
        w, c, s, angle = substep(w, c, s, Coefficients(a, b, gamma, d + r * i, r), order)
        return twofold_parts(w, c, s, turned + angle)

    return (
        compile_traced("scale", f"omega, {coefficients}, h, h_low", scale),
        compile_traced("substep", f"{pairs}, i", one),
    )


# --- derivatives --------------------------------------------------------------------------------------------


def _carry(slopes, lost, change):  # type: ignore[no-untyped-def]
    """Carry derivatives of θ and θ' over a substep; `change` holds its own, by the variables in `ROWS`.

    Rounding errors are carried forward in `lost` (Kahan), since many substeps add up.
    """
    for column in range(slopes.shape[1]):
        before = slopes[0, column], slopes[1, column]
        for row in range(2):
            added = change[row, 0] * before[0] + change[row, 1] * before[1] - lost[row, column]
            for i in range(2, len(ROWS)):
                added += change[row, i] * slopes[ROWS[i], column]
            slopes[row, column] = before[row] + added
            lost[row, column] = (slopes[row, column] - before[row]) - added


def _tangent(values, slopes, scratch, dt, x):  # type: ignore[no-untyped-def]
    """Differentiate a step; return 0, or -1 if it is refused.

    `values` are θ, θ', cosθ, sinθ and the coefficients. `slopes` are their derivatives at the step's start
    with respect to anything, of shape (9, columns). Those of θ and θ' are replaced by those at the end.
    """
    theta, omega, c, s, alpha, beta, gamma, delta, ramp = values
    change, lost = scratch[:2], scratch[2:]
    lost[:] = 0.0
    if holds(omega, alpha, beta, gamma, delta, ramp, dt, x):
        local(change, omega, c, s, alpha, beta, gamma, delta, ramp, dt, 0.0)
        carry(slopes, lost, change)
        return 0
    layer, n, m, drift = plan(omega, alpha, beta, gamma, delta, ramp, dt, order, FIELD_COUNTS)
    if n < 0.0:
        return -1
    h = layer / n
    scaled = scale(omega, alpha, beta, gamma, delta, ramp, h, fma(-h, n, layer) / n)
    w, w_low = scaled[0], scaled[1]
    c_low = s_low = turned = turned_low = 0.0
    for j in range(int(n)):
        local(change, w / h, c, s, alpha, beta, gamma, delta, ramp, h, j * h)
        carry(slopes, lost, change)
        w, w_low, c, c_low, s, s_low, turned, turned_low = substep(
            w, w_low, c, c_low, s, s_low, turned, turned_low, *scaled[2:], float(j)
        )
    if m > 0.0:
        if drift:
            alpha = beta = 0.0
        delta += ramp * layer
        for column in range(slopes.shape[1]):  # a sum of rows would take Numba a second longer
            slopes[7, column] += slopes[8, column] * layer
        slow_motion(theta, c, s, alpha, beta, gamma, delta, ramp, dt - layer, m, order, slopes)
    return 0


@cache
def compile_tangent(absent: frozenset[str], by: tuple[str, ...], order: int = ORDER) -> Callable:
    """Compile ``tangent(values, slopes, scratch, dt, x)``, see `_tangent`; `scratch` has four rows.

    Parameters
    ----------
    absent : frozenset of str
        Coefficients that are zero.
    by : tuple of str
        Coefficients that have derivatives.
    order : int, default 16
        Order of the series.
    """
    columns, n = ("theta", "omega", *by), len(by) + 2
    numbers = ("omega", "c", "s", *Coefficients._fields, "h", "elapsed")
    trace = Trace()
    omega, c, s, *rest, h, elapsed = (
        trace.zero() if name in absent else trace.inputs(name)[0] for name in numbers
    )
    found = step_slopes(omega, c, s, Coefficients(*rest), h, elapsed, columns, order)
    lines, entries = record_block(trace, {f"out{i}": x for i, x in enumerate(found)})
    body = [
        *lines,
        *(f"change[{i // n}, {i % n}] = {x}" for i, x in enumerate(entries)),
    ]
    rows = (0, 1, *(4 + Coefficients._fields.index(name) for name in by))
    holds, _ = _compile_parts(absent, order)
    return compile_python(
        "tangent",
        _tangent,
        holds,
        compile_lines("local", f"change, {', '.join(numbers)}", body),
        compile_python("carry", _carry, ROWS=rows),
        _compile_plan(),
        _compile_slow_motion(_slow_slopes),
        *_divided_parts(order),
        order=order,
        ROWS=rows,
        FIELD_COUNTS=bool({"alpha", "beta"} & set(by)),
    )
