"""The closed form of the undamped pendulum's motion, by elliptic functions.

It checks the oracle, and replaces it if a pendulum turns so far that the oracle, which takes a step per
radian, would need minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import sympy
from mpmath import mp, mpf

from lag_envs.report.formulas import reduced
from lag_envs.report.oracle import Oracle


def elliptic(alpha: mpf, beta: mpf, theta: mpf, rate: mpf, dt: mpf) -> tuple[mpf, mpf]:
    """Return (theta, theta') after dt under theta'' = -alpha sin(theta) - beta cos(theta).

    With psi = theta + atan2(beta, alpha), omega^2 = hypot(alpha, beta) and
    m = (psi'/(2 omega))^2 + sin(psi/2)^2 = k^2:

    * m < 1 swings: sin(psi/2) = k sn(u | m), psi' = 2 k omega cn(u | m), u' = omega;
    * m > 1 turns: psi/2 = +-am(u | 1/m), psi' = +-2 k omega dn(u | 1/m), u' = k omega;
    * m = 1: the common limit, sn = tanh, cn = dn = sech.

    References: DLMF 22.19(i).
    """
    omega = mp.sqrt(mp.hypot(alpha, beta))
    offset = mp.atan2(beta, alpha)
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


@lru_cache(maxsize=256)
def pendulum(oracle: Oracle, controls: tuple[float, ...]) -> tuple[sympy.Rational, sympy.Rational] | None:
    """Return (alpha, beta) if the only free coordinate moves as in `elliptic`, else None."""
    names, equations = oracle.names, oracle.equations
    if len(names.free) != 1 or any(kind == "momentum" for _, kind in names.state):
        return None
    q = equations.q[names.free[0]]
    given = dict(zip(equations.u.values(), map(sympy.Rational, controls), strict=True))
    mass, force = (
        reduced(oracle.exactly(e).xreplace(given)) for e in (equations.mass[0], equations.force[0])
    )
    if mass.free_symbols or not force.free_symbols <= {q}:
        return None
    alpha, beta = (-force.coeff(f(q)) / mass for f in (sympy.sin, sympy.cos))
    rest = sympy.expand(force / mass + alpha * sympy.sin(q) + beta * sympy.cos(q))
    turns = alpha.is_Rational and beta.is_Rational and rest == 0 and (alpha, beta) != (0, 0)
    return (alpha, beta) if turns else None


def closed_form_flow(
    oracle: Oracle, coefficients: Sequence[Any], state: Sequence, controls: Sequence, dt: Any, digits: int
) -> list[mpf]:
    """Return the state after a time dt, for coefficients that `pendulum` has found."""
    with mp.workdps(digits + 40):
        t = mpf(dt)
        q, v = oracle.start([mpf(x) for x in state], [mpf(u) for u in controls], mpf)
        for name, (_, _, acceleration) in oracle.driven(q, v, [mpf(u) for u in controls], mpf(0)).items():
            q[name], v[name] = q[name] + t * (v[name] + t * acceleration / 2), v[name] + t * acceleration
        (free,), (alpha, beta) = oracle.names.free, (mpf(int(x.p)) / int(x.q) for x in coefficients)
        q[free], v[free] = elliptic(alpha, beta, q[free], v[free], t)
        return [(q if kind == "place" else v)[name] for name, kind in oracle.names.state]
