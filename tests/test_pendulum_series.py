"""The pendulum's series: coefficients, order and bound."""

import math

import numpy as np
import pytest
from covering import slow
from mpmath import mp, mpf

from lag_envs.stepping import pendulum
from lag_envs.stepping.pendulum import Coefficients


@pytest.fixture(autouse=True)
def precise():
    with mp.workdps(60):
        yield


def random_drive(rng, ramp=True):
    """Return W_0, cos, sin and scaled coefficients as mpmath numbers, from calm to violent."""
    angle = mpf(rng.uniform(-4, 4))
    size = 10.0 ** rng.uniform(-3, 0, 5) * rng.choice([0.0, 1.0], 5, p=[0.2, 0.8])
    a, b, gamma, d, r = (mpf(v) for v in size * rng.uniform(-1, 1, 5) * [0.3, 0.3, 1, 0.3, 1])
    w = mpf(rng.uniform(-1, 1) * 10.0 ** rng.uniform(-3, 0))
    return w, mp.cos(angle), mp.sin(angle), Coefficients(a, b, gamma, d, r if ramp else 0.0)


@pytest.mark.slow
def test_coefficients_are_derivatives():
    """W_k k! is the k-th derivative of W, by repeated differentiation of polynomials in W, cos, sin, t."""
    import sympy

    w, c, s, tau = symbols = sympy.symbols("w c s tau")
    a, b, gamma, d, r = numbers = [sympy.Rational(n, 7) for n in (3, -2, 4, 5, 6)]
    point = {w: sympy.Rational(2, 3), c: sympy.Rational(3, 5), s: sympy.Rational(-4, 5), tau: 0}
    rates = (-(a * s + b * c) - gamma * w + d + r * tau, -s * w, c * w, 1)
    derivative, expected = w, []
    for k in range(9):
        expected.append(float(derivative.subs(point)) / math.factorial(k))
        derivative = sympy.expand(
            sum(derivative.diff(z) * rate for z, rate in zip(symbols, rates, strict=True))
        )
    floats = (float(point[z]) for z in (w, c, s))
    W, _ = pendulum.taylor_coefficients(*floats, Coefficients(*map(float, numbers)), 8)
    assert pytest.approx(expected, rel=1e-13) == W


def test_energy_identity():
    """H = W²/2 holds for every coefficient, and 2/h sum H_k/(k+1) is the integral of theta'²."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        w, c, s, drive = random_drive(rng, ramp=False)
        W, H = pendulum.taylor_coefficients(w, c, s, drive, 40)
        for k, h in enumerate(H):
            product = mp.fsum(W[j] * W[k - j] for j in range(k + 1)) / 2
            assert abs(h - product) < 1e-15 * max(abs(x) for x in W) ** 2
        a, b, gamma, d, _ = drive
        angle = mp.fsum(x / (k + 1) for k, x in enumerate(W))
        c1, s1 = c * mp.cos(angle) - s * mp.sin(angle), s * mp.cos(angle) + c * mp.sin(angle)
        gained = mp.fsum(W) ** 2 / 2 - w**2 / 2 + a * (c - c1) + b * (s1 - s)
        work = d * angle - gamma * 2 * mp.fsum(h / (k + 1) for k, h in enumerate(H))
        assert abs(gained - work) < 1e-15


@pytest.mark.parametrize("order", [3, 6, 10, 16, 20])
def test_order(order):
    """The error of one step of theta' falls as h^(N+1), that of theta as h^(N+2)."""
    drive = Coefficients(mpf(20), mpf(-7), mpf(3), mpf(5), mpf(40))
    start = mpf(0.3), mpf(2.5), mp.cos(0.3), mp.sin(0.3)

    def errors(h):
        rough, fine = (pendulum.step(*start, drive, h, n) for n in (order, order + 30))
        return [abs(a - b) for a, b in zip(rough, fine, strict=True)][:2]

    big, small = errors(mpf(2) ** -8), errors(mpf(2) ** -9)
    slopes = [float(mp.log(a / b, 2)) for a, b in zip(big, small, strict=True)]
    assert slopes == pytest.approx([order + 2, order + 1], abs=0.2)


def least_x(w, drive):
    """Return the smallest x for which the bound is proved."""
    low, high = 0.0, 64.0
    for _ in range(60):
        x = 0.5 * (low + high)
        good = pendulum.certified(float(w), Coefficients(*map(float, drive)), 1.0, x, np)
        low, high = (low, x) if good else (x, high)
    return high


@pytest.mark.parametrize("order", [slow(14), 20])
def test_bound_is_never_broken(order):
    """Truncation against a longer series in 200 random cases: at least a factor of 20 below the bound."""
    rng = np.random.default_rng(order)
    closest = [0.0, 0.0]
    tested = 0
    while tested < 200:
        w, c, s, drive = random_drive(rng)
        x = mpf(least_x(w, drive))
        if not 0 < x < 1:
            continue
        tested += 1
        W, _ = pendulum.taylor_coefficients(w, c, s, drive, order + 24)
        kappa = x / 2
        assert abs(W[0]) <= x
        for k, coefficient in enumerate(W[7:], 7):
            assert abs(coefficient) <= pendulum.LOSS * x * kappa**k
        tail = mpf(pendulum.tail(float(x), order))
        left_out = (
            abs(mp.fsum(W[order + 1 :])),
            abs(mp.fsum(v / (k + 1) for k, v in enumerate(W) if k > order)),
        )
        for i, bound in enumerate((tail, tail / (order + 2))):
            closest[i] = max(closest[i], float(left_out[i] / bound))
    assert 1e-6 < min(closest) and max(closest) < 0.05


def test_bound_is_not_far_off():
    """How loose the bound is: less than a factor of 3 per power if drive and field pull together."""
    w, drive = mpf(0.0), Coefficients(mpf(0.02), 0.0, 0.0, mpf(0.02), 0.0)
    W, _ = pendulum.taylor_coefficients(w, mpf(0), mpf(-1), drive, 25)
    x = least_x(w, drive)
    assert (abs(W[25]) / x) ** (1 / 25) > x / 2 / 3
