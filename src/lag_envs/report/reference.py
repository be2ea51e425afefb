"""High precision: the exact flow of any scene to 25 digits and more, by methods that stepping does not use.

Coefficients come from the scene's own formulas, run on mpmath numbers from the exact values of its float64
parameters; tests hold the formulas against the Lagrangian, and against equations typed in by hand. Everything
is computed twice, with different digits, orders and step sizes; a result is returned only where the two
agree. One method per kind of problem:

==============================================  ====================================================
linear (incline; no gravity and no drive)       exponential integrals, matrix exponential
pendulum in a constant field, no damping        Jacobi elliptic functions
pendulum with damping or drive                  Taylor series in fixed-point integers
the same, stiff                                 Taylor through the boundary layer, then collocation
==============================================  ====================================================
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from functools import lru_cache
from math import ceil, log10
from operator import mul
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from mpmath import mp, mpf

from lag_envs.mechanics.algebra import evaluate
from lag_envs.mechanics.recording import parameter
from lag_envs.scenes.base import Scene
from lag_envs.stepping import pendulum as pendulum_stepping
from lag_envs.stepping import slope as slope_stepping
from lag_envs.store import write

MAX_STEPS = 20_000


class Unresolved(ArithmeticError):
    """The reference cannot vouch for its own result."""


class Pendulum(NamedTuple):
    """theta'' = -alpha sin(theta) - beta cos(theta) - gamma theta' + delta + slope t.

    Units: alpha, beta, delta [rad/s^2], gamma [1/s], slope [rad/s^3]; t runs from the step's start.
    """

    alpha: mpf
    beta: mpf
    gamma: mpf
    delta: mpf
    slope: mpf

    def force(self, theta, t):
        """Return theta'' + gamma theta' [rad/s^2]."""
        cos, sin = mp.cos_sin(theta)
        return self.delta + self.slope * t - self.alpha * sin - self.beta * cos

    def rests(self, theta, rate, digits):
        """Tell whether the state is a stable equilibrium up to 10**-digits."""
        if self.slope or abs(rate) > mpf(10) ** -digits:
            return False
        cos, sin = mp.cos_sin(theta)
        stiffness = self.alpha * cos - self.beta * sin
        return stiffness > 0 and abs(self.force(theta, 0)) < stiffness * mpf(10) ** -digits


# --- linear problems ---------------------------------------------------------------------------


def linear(gamma, delta, slope, x, v, dt):
    """Return (x, v) after dt under x'' = -gamma x' + delta + slope t.

    Written with phi_k(-z) = sum_j (-z)^j / (j + k)! = 1F1(1; k + 1; -z) / k!, which has no
    singular case at z = gamma dt = 0.
    """

    def phi(k):
        return mp.hyp1f1(1, k + 1, -gamma * dt) / mp.factorial(k)

    lag = delta - gamma * v
    return (
        x + v * dt + lag * dt**2 * phi(2) + slope * dt**3 * phi(3),
        v + lag * dt * phi(1) + slope * dt**2 * phi(2),
    )


def turning(turn, variables, dt):
    """Return (x, x') after dt on a plane that turns at a constant rate; variables are (x, x', cos, sin).

    x'' = weight sin(phi) + carry rate^2 x - drag x' is linear in (x, x', cos, sin).
    """
    carry, weight, drag, rate = (mpf(value) for value in turn)
    rows = [
        [0, 1, 0, 0],
        [carry * rate**2, -drag, 0, weight],
        [0, 0, 0, -rate],
        [0, 0, rate, 0],
    ]
    end = mp.expm(mp.matrix(rows) * dt) * mp.matrix(list(variables))
    return end[0], end[1]


# --- pendulum ----------------------------------------------------------------------------------


def elliptic(p, theta, rate, dt):
    """Return (theta, theta') after dt for gamma = delta = slope = 0, by Jacobi elliptic functions.

    With psi = theta + atan2(beta, alpha), omega^2 = hypot(alpha, beta) and
    m = (psi'/(2 omega))^2 + sin(psi/2)^2 = k^2:

    * m < 1 swings: sin(psi/2) = k sn(u | m), psi' = 2 k omega cn(u | m), u' = omega;
    * m > 1 turns: psi/2 = +-am(u | 1/m), psi' = +-2 k omega dn(u | 1/m), u' = k omega;
    * m = 1: the common limit, sn = tanh, cn = dn = sech.

    References: DLMF 22.19(i).
    """
    omega = mp.sqrt(mp.hypot(p.alpha, p.beta))
    offset = mp.atan2(p.beta, p.alpha)
    psi = theta + offset
    turns = mp.nint(psi / (2 * mp.pi))
    half = psi / 2 - turns * mp.pi
    m = (rate / (2 * omega)) ** 2 + mp.sin(half) ** 2
    if m == 0:
        return theta, rate
    k = mp.sqrt(m)
    sign = -1 if rate < 0 else 1
    if m < 1:
        start = mp.atan2(mp.sin(half) / k, rate / (2 * k * omega))
        u = mp.ellipf(start, m) + omega * dt
        sn, cn, dn = (mp.ellipfun(kind, u, m=m) for kind in ("sn", "cn", "dn"))
        half, rate = mp.atan2(k * sn, dn), 2 * k * omega * cn
    elif m > 1:
        u = mp.ellipf(sign * half, 1 / m) + k * omega * dt
        period = 2 * mp.ellipk(1 / m)
        halves = mp.nint(u / period)
        sn, cn, dn = (mp.ellipfun(kind, u - halves * period, m=1 / m) for kind in ("sn", "cn", "dn"))
        half, rate = sign * (halves * mp.pi + mp.atan2(sn, cn)), sign * 2 * k * omega * dn
    else:
        u = mp.atanh(mp.sin(half)) + sign * omega * dt
        half, rate = mp.atan2(mp.tanh(u), mp.sech(u)), sign * 2 * omega * mp.sech(u)
    return 2 * (half + turns * mp.pi) - offset, rate


def taylor(p, theta, rate, dt, digits):
    """Return (theta, theta') after dt by Taylor series, theta and h theta' good to 10**-digits.

    Time is scaled by h, about the radius of convergence, so that the coefficients of
    W = h theta', P = h^2 (alpha sin + beta cos), Q = h^2 (alpha cos - beta sin),

        P' = Q W,   Q' = -P W,   W' = -P - h gamma W + h^2 (delta + slope t),

    are of order one and can be integers in units of 2**-bits. The step is chosen afterwards, such
    that the last eight coefficients drop below the tolerance.

    Raises
    ------
    Unresolved
        If MAX_STEPS steps do not suffice.
    """
    order = int(1.15 * digits) + 8
    tolerance = int(3.33 * digits) + 16
    bits = tolerance + 64

    def fixed(x):
        return int(mp.ldexp(x, bits))

    t, dt = mpf(0), mpf(dt)
    drive = abs(p.delta) + abs(p.slope) * dt
    h = min(dt, 2 / (abs(rate) + p.gamma + mp.sqrt(mp.hypot(p.alpha, p.beta) + drive)))
    for _ in range(MAX_STEPS):
        cos, sin = mp.cos_sin(theta)
        P = [fixed(h**2 * (p.alpha * sin + p.beta * cos))]
        Q = [fixed(h**2 * (p.alpha * cos - p.beta * sin))]
        W = [fixed(h * rate)]
        gamma = fixed(h * p.gamma)
        push = {0: fixed(h**2 * (p.delta + p.slope * t)), 1: fixed(h**3 * p.slope)}
        for k in range(order):
            W.append((push.get(k, 0) - P[k] - (gamma * W[k] >> bits)) // (k + 1))
            back = W[k::-1]
            P.append((sum(map(mul, Q, back)) >> bits) // (k + 1))
            Q.append(-(sum(map(mul, P, back)) >> bits) // (k + 1))

        exponent = min((bits - tolerance - abs(W[k]).bit_length()) / k for k in range(order - 7, order + 1))
        part = min(mpf(1), mp.mpf(2) ** exponent, (dt - t) / h)
        last = part * h >= dt - t
        x = fixed(part)
        angle = speed = 0
        for k in range(order, -1, -1):
            angle = (angle * x >> bits) + W[k] // (k + 1)
            speed = (speed * x >> bits) + W[k]
        theta += mp.ldexp(angle * x, -2 * bits)
        rate = mp.ldexp(speed, -bits) / h
        if last or p.rests(theta, rate, digits):
            return theta, rate
        t += mp.ldexp(x, -bits) * h
        h = min(dt - t, h * min(mpf(8), mp.mpf(2) ** (exponent + tolerance / order)))
    raise Unresolved(f"{MAX_STEPS} Taylor steps reach t = {mp.nstr(t, 5)} of {mp.nstr(dt, 5)} s")


@lru_cache(maxsize=64)
def _chebyshev(nodes, digits):
    """Return nodes in [0, 1], rows of powers there, and rows of the interpolation's inverse."""
    with mp.workdps(digits):
        x = [(1 - mp.cos(mp.pi * (2 * i + 1) / (2 * nodes))) / 2 for i in range(nodes)]
        powers = [[xi**j for j in range(nodes)] for xi in x]
        return x, powers, (mp.matrix(powers) ** -1).tolist()


def slow_manifold(p, theta, rate, start, stop, digits):
    """Return (theta, theta') at stop, from a state at start that has left the boundary layer.

    Collocation at Chebyshev nodes: on each piece of length h the polynomial theta' = sum p_j x^j,
    x in [0, 1], satisfies theta'' + gamma theta' = force at the nodes. It needs no initial rate,
    since only the solution without boundary layer is smooth. The fixed point
    force -> theta' -> theta -> force contracts like that of Picard in slow time.

    Raises
    ------
    Unresolved
        If the collocation polynomial's rate at a piece's start is not the rate that came in: then
        the layer has not died out, or the manifold is not smooth enough.
    """
    span = stop - start
    speed = slow_rate(p, stop)
    pieces = ceil(2 * speed * span)
    if pieces > MAX_STEPS // 20:
        raise Unresolved(f"{pieces} slow pieces")
    h = span / pieces
    nodes = 8 * ceil((digits / log10(12 / min(0.5, float(speed * h))) + 4) / 8)
    with mp.workdps(mp.dps + nodes):
        x, powers, inverse = _chebyshev(nodes, mp.dps)
        for piece in range(pieces):
            t0 = start + piece * h
            angles = [theta + rate * h * xi for xi in x]
            for _ in range(200):
                force = [p.force(a, t0 + h * xi) / p.gamma for a, xi in zip(angles, x, strict=True)]
                rates = [mp.fdot(row, force) for row in inverse]
                for j in range(nodes - 2, -1, -1):
                    rates[j] -= (j + 1) * rates[j + 1] / (p.gamma * h)
                steps = [h * r / (j + 1) for j, r in enumerate(rates)]
                new = [theta + xi * mp.fdot(row, steps) for row, xi in zip(powers, x, strict=True)]
                change = max(abs(a - b) for a, b in zip(new, angles, strict=True))
                angles = new
                if change < mpf(10) ** -(digits + 2):
                    break
            else:
                raise Unresolved(f"collocation does not contract, change {mp.nstr(change, 3)}")
            jump = abs(rates[0] - rate)
            if jump > mpf(10) ** (12 - digits) * max(1, abs(rate)):
                raise Unresolved(f"slow rate misses the incoming one by {mp.nstr(jump, 3)} rad/s")
            theta, rate = theta + mp.fsum(steps), mp.fsum(rates)
            if p.rests(theta, rate, digits):
                break
    return theta, rate


def slow_rate(p, dt):
    """Return a bound of theta' and of its relative change, on the slow manifold [1/s]."""
    return (mp.hypot(p.alpha, p.beta) + abs(p.delta) + abs(p.slope) * dt) / p.gamma


@lru_cache(maxsize=4096)
def pendulum(p, theta, rate, dt, digits):
    """Return (theta, theta') after dt by the method that fits; digits is the working tolerance."""
    if not (p.alpha or p.beta):
        return linear(p.gamma, p.delta, p.slope, theta, rate, dt)
    if not (p.gamma or p.delta or p.slope):
        return elliptic(p, theta, rate, dt)
    # Below a ratio of some 100 the slow manifold is no longer smooth enough; below 3000 Taylor is
    # quicker, since next to the manifold its steps grow to about 25 / gamma.
    if p.gamma and slow_rate(p, dt) * 3000 < p.gamma:
        layer = (mp.log(10) * digits + mp.log(1 + abs(rate)) + 5) / p.gamma
        if dt > 2 * layer:
            theta, rate = taylor(p, theta, rate, layer, digits)
            return slow_manifold(p, theta, rate, layer, dt, digits)
    return taylor(p, theta, rate, dt, digits)


# --- scenes ------------------------------------------------------------------------------------


def constants(scene: Scene) -> SimpleNamespace:
    """Return the constants of a scene's normal form as mpmath numbers, from its parameters taken as exact."""
    form = scene._form
    assert form is not None
    values = {parameter(name): mpf(getattr(scene, name)) for name in scene._numbers()}
    inertia, *numbers = evaluate([form.inertia, *form.expressions.values()], values, mp)
    return SimpleNamespace(
        **{name: mpf(x) / inertia for name, x in zip(form.expressions, numbers, strict=True)}
    )


def flow(scene: Scene, state: Sequence[Any], control: Any, dt: Any, digits: int = 30) -> list[mpf]:
    """Return the state after a time dt with the control held.

    Parameters
    ----------
    scene : Scene
        The scene.
    state : sequence of float or mpf
        Start; numbers are taken as exact.
    control, dt : float or mpf
        The control and the time [s], which may be much longer than a control step.
    digits : int, default 30
        Decimal digits asked for.

    Returns
    -------
    list of mpf
        Entries on which two computations agree to 10**-digits times max(1, abs(entry)).

    Raises
    ------
    Unresolved
        If they do not, even with four times the digits, or where the case needs too many steps.

    Examples
    --------
    >>> from lag_envs.scenes import PivotedBar
    >>> bar = PivotedBar(gravity=0.0, track=None)
    >>> [float(x) for x in flow(bar, (2.0, 3.0), 0.0, 0.5)]
    [3.5, 3.0]
    """
    working = digits + 22
    error = mpf(0)
    while working <= 4 * digits + 22:
        coarse, fine = (_once(scene, state, control, dt, d) for d in (working, working + 9))
        error = max(abs(a - b) / max(1, abs(b)) for a, b in zip(coarse, fine, strict=True))
        if error <= mpf(10) ** -digits:
            return fine
        working *= 2
    raise Unresolved(f"two precisions differ by {mp.nstr(error, 3)}")


#: Folder in which `remembered` keeps what it has computed; None keeps nothing.
store: Path | None = None


def remembered(scene: Scene, state: Sequence[float], control: float, dt: float) -> list[mpf]:
    """Return what `flow` returns with 30 digits; the processes of a report share the results in `store`."""
    problem = repr((scene, *(float(x).hex() for x in (*state, control, dt))))
    file = store and store / f"{hashlib.sha256(problem.encode()).hexdigest()[:24]}.json"
    with mp.workdps(40):
        if file and file.exists():
            return [mpf(text) for text in json.loads(file.read_text(encoding="utf-8"))]
        end = flow(scene, state, control, dt)
        if file:
            write(file, json.dumps([mp.nstr(x, 40) for x in end]))
        return end


def errors(states: Sequence[float], exact: Sequence[mpf]) -> list[float]:
    """Return the differences of a float64 state from the exact one."""
    with mp.workdps(40):
        return [float(mpf(float(a)) - b) for a, b in zip(states, exact, strict=True)]


def _once(scene: Scene, state: Sequence[Any], control: Any, dt: Any, digits: int) -> list[mpf]:
    with mp.workdps(digits + 30):
        form, k = scene._form, constants(scene)
        assert form is not None
        y = [mpf(value) for value in state]
        u, dt = [mpf(control)], mpf(dt)
        if form.angle is not None:
            y += [mp.cos(y[form.angle]), mp.sin(y[form.angle])]
        coefficients = form.drive(y, u, k, mp)
        moved = _moved(coefficients, form.unpack(y, u, k), dt, digits)
        return list(form.pack(moved, y, u, dt, k))[: len(scene.state_names)]


def _moved(coefficients: Any, variables: Sequence[mpf], dt: mpf, digits: int) -> list[mpf]:
    """Return the flow's variables after dt; cosine and sine, which follow from them, are left at 0."""
    q, v = variables[:2]
    if isinstance(coefficients, pendulum_stepping.Drive):
        return [*pendulum(Pendulum(*map(mpf, coefficients)), q, v, dt, digits), mpf(0), mpf(0)]
    if isinstance(coefficients, slope_stepping.Pull):
        return list(linear(mpf(coefficients.drag), mpf(coefficients.pull), mpf(0), q, v, dt))
    return [*turning(coefficients, variables, dt), mpf(0), mpf(0)]
