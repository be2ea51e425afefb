"""The integrators that people would otherwise use, as flows that can step any scene.

Each integrator is written once, on generic numbers, for q'' = a(q, v, t). It is compiled by the same
machinery as lag_envs's flows, so that times compare methods and not compilers. A comparison integrator takes
one step per control step; `n` substeps are `n` control steps that are n times shorter.

Cosine and sine are either computed at every stage or *carried*: an explicit Runge-Kutta method has them as
two more unknowns, c' = -s q' and s' = c q', and calls no function at all; other methods rotate the step's
initial pair by two short polynomials. Carrying is faster and its errors differ slightly, so the report has
both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

from lag_envs.report.flow_equations import EQUATIONS, FlowEquation, Problem
from lag_envs.stepping.compiling import compile_function, compile_traced
from lag_envs.stepping.flows import Flow, pendulum_flow
from lag_envs.stepping.tracing import polynomial, sum_of_products

# --- methods: (q, v) after one step of length h ---


def semi_implicit_euler(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Semi-implicit (symplectic) Euler, as in Gymnasium's Pendulum."""
    v = v + h * p.acceleration(q, v, 0.0)
    return q + h * v, v


def verlet(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Velocity Verlet; drag is treated explicitly before and implicitly after the drift."""
    half = v + 0.5 * h * p.acceleration(q, v, 0.0)
    q = q + h * half
    return q, (half + 0.5 * h * p.force(q, h)) / (1.0 + 0.5 * h * p.damping_rate)


def implicit_midpoint(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Implicit midpoint rule, symplectic and A-stable, with four iterations of Newton's method."""
    half = 0.5 * h
    middle = v
    for _ in range(1 if p.linear else 4):
        place = q + half * middle
        residual = middle - v - half * p.acceleration(place, middle, half)
        middle = middle - residual / (1.0 + half * p.damping_rate - half * half * p.gradient(place, half))
    return q + h * middle, 2.0 * middle - v


def etd4rk(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Exponential Runge-Kutta method of order 4 (Cox, Matthews 2002): the drag is solved exactly."""
    one, half = phis(p.damping_rate * h, xp), phis(0.5 * (p.damping_rate * h), xp)
    k = 0.5 * h

    def free(start: tuple[Any, Any], h: Any, phi: Sequence) -> tuple[Any, Any]:
        return start[0] + h * phi[1] * start[1], phi[0] * start[1]

    def stage(start: tuple[Any, Any], force: Any) -> tuple[Any, Any]:
        x, w = free(start, k, half)
        return x + k * k * half[2] * force, w + k * half[1] * force

    n0 = p.force(q, 0.0)
    a = stage((q, v), n0)
    na = p.force(a[0], k)
    b = stage((q, v), na)
    nb = p.force(b[0], k)
    c = stage(a, 2.0 * nb - n0)
    nc = p.force(c[0], h)
    x, w = free((q, v), h, one)
    weights = [
        (one[i + 1] - 3.0 * one[i + 2] + 4.0 * one[i + 3]) * n0
        + (2.0 * one[i + 2] - 4.0 * one[i + 3]) * (na + nb)
        + (4.0 * one[i + 3] - one[i + 2]) * nc
        for i in (0, 1)
    ]
    return x + h * h * weights[1], w + h * weights[0]


def phis(z: Any, xp: Any) -> list:
    """Return φ_0(-z) ... φ_4(-z); φ_k(-z) = Σ (-z)^j/(j + k)!."""
    small = xp.minimum(z, 2.0)
    large = xp.maximum(z, 2.0)
    series = polynomial([(-1.0) ** j / math.factorial(j + 4) for j in range(24)], small)
    phi = [series]
    for k in (3, 2, 1, 0):
        phi.insert(0, 1.0 / math.factorial(k) - small * phi[0])
    far = [xp.exp(-large)]
    for k in range(4):
        far.append((1.0 / math.factorial(k) - far[k]) / large)
    return [xp.where(z <= 2.0, near, there) for near, there in zip(phi, far, strict=True)]


_ROOT = math.sqrt(6.0)
#: Radau IIA's matrix (Hairer, Wanner, "Solving Ordinary Differential Equations II", table IV.5.6).
RADAU = [
    [(88.0 - 7.0 * _ROOT) / 360.0, (296.0 - 169.0 * _ROOT) / 1800.0, (-2.0 + 3.0 * _ROOT) / 225.0],
    [(296.0 + 169.0 * _ROOT) / 1800.0, (88.0 + 7.0 * _ROOT) / 360.0, (-2.0 - 3.0 * _ROOT) / 225.0],
    [(16.0 - _ROOT) / 36.0, (16.0 + _ROOT) / 36.0, 1.0 / 9.0],
]


def radau(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Radau IIA of order 5, stiffly accurate, by Newton's method on the accelerations of its three stages."""
    a = RADAU
    twice = [[sum(a[i][k] * a[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
    c = [sum(row) for row in a]
    hh = h * h
    accelerations = [p.acceleration(q, v, 0.0)] * 3

    def speed(row: Sequence[float]) -> Any:
        return v + h * sum_of_products(list(zip(row, accelerations, strict=True)))

    def place(i: int) -> Any:
        return q + (h * c[i]) * v + hh * sum_of_products(list(zip(twice[i], accelerations, strict=True)))

    for _ in range(1 if p.linear else 4):
        places = [place(i) for i in range(3)]
        rows = []
        for i in range(3):
            slope_at = p.gradient(places[i], h * c[i])
            wrong = p.force(places[i], h * c[i]) - p.damping_rate * speed(a[i]) - accelerations[i]
            matrix = [p.damping_rate * (h * a[i][j]) - slope_at * (hh * twice[i][j]) for j in range(3)]
            matrix[i] = 1.0 + matrix[i]
            rows.append([*matrix, wrong])
        accelerations = [x + dx for x, dx in zip(accelerations, _solve(rows), strict=True)]
    return place(2), speed(a[2])


def _solve(rows: list[list[Any]]) -> list[Any]:
    """Solve a small linear system with a matrix close to the identity; right-hand side last in each row."""
    n = len(rows)
    for k in range(n):
        inverse = 1.0 / rows[k][k]
        rows[k] = [x * inverse for x in rows[k]]
        for i in range(n):
            if i != k:
                rows[i] = [x - rows[i][k] * y for x, y in zip(rows[i], rows[k], strict=True)]
    return [row[n] for row in rows]


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method."""

    a: Sequence[Sequence[float]]  #: of each stage, the weights of the earlier ones
    b: Sequence[float]
    c: Sequence[float]


def explicit(tableau: Tableau, rate: Callable, y: Sequence, h: Any) -> list:
    """Return the unknowns after one step of ``rate(t, y)``, with t measured from the step's start."""
    found: list[Sequence] = []
    for weights, at in zip(tableau.a, tableau.c, strict=True):
        found.append(rate(at * h, _moved(y, weights, found, h)))
    return _moved(y, tableau.b, found, h)


def _moved(y: Sequence, weights: Sequence[float], rates: Sequence[Sequence], h: Any) -> list:
    terms = [(w, k) for w, k in zip(weights, rates, strict=False) if w != 0.0]
    if not terms:
        return list(y)
    return [x + h * sum_of_products([(w, k[i]) for w, k in terms]) for i, x in enumerate(y)]


def euler() -> Tableau:
    """Explicit Euler, as in Gymnasium's CartPole."""
    return Tableau([[]], [1.0], [0.0])


def rk4() -> Tableau:
    """Runge and Kutta's classical method of order 4, as in Gymnasium's Acrobot."""
    return Tableau(
        [[], [0.5], [0.0, 0.5], [0.0, 0.0, 1.0]],
        [1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0],
        [0.0, 0.5, 0.5, 1.0],
    )


@cache
def dop853() -> Tableau:
    """Dormand and Prince's method of order 8, twelve stages, as in SciPy."""
    from scipy.integrate import DOP853

    a = [[float(x) for x in row[:i]] for i, row in enumerate(DOP853.A)]
    return Tableau(a, [float(x) for x in DOP853.B], [float(x) for x in DOP853.C])


class Method(NamedTuple):
    """A comparison integrator, and its order of convergence."""

    step: Callable | None  #: of a `Problem`; None if the tableau is all there is
    order: int
    tableau: Callable[[], Tableau] | None = None


METHODS = {
    "explicit Euler": Method(None, 1, euler),
    "semi-implicit Euler": Method(semi_implicit_euler, 1),
    "Verlet": Method(verlet, 2),
    "implicit midpoint": Method(implicit_midpoint, 2),
    "RK4": Method(None, 4, rk4),
    "ETD4RK": Method(etd4rk, 4),
    "Radau IIA": Method(radau, 5),
    "DOP853": Method(None, 8, dop853),
}


# --- as flows ---


@cache
def comparison(name: str, flow: Flow, carried: bool = False) -> Flow:
    """Return the comparison integrator of that name for the equation of a flow."""
    method, equation = METHODS[name], EQUATIONS[flow.coefficients]

    def fast(variables: Sequence, coefficients: Any, dt: Any, xp: Any) -> tuple:
        if method.tableau and carried and equation.lifted > 2:
            return _lifted(method.tableau(), equation, variables, coefficients, dt)
        p = equation.problem(coefficients, variables, xp, carried)
        start = variables[:2]
        if method.tableau:
            q, v = explicit(method.tableau(), lambda t, y: (y[1], p.acceleration(y[0], y[1], t)), start, dt)
        else:
            assert method.step
            q, v = method.step(p, *start, dt, xp)
        return q, v, *equation.turned(coefficients, variables, q, dt, xp, carried)

    return _always(flow, fast, method.order)


def _lifted(
    tableau: Tableau, equation: FlowEquation, variables: Sequence, coefficients: Any, dt: Any
) -> tuple:
    """Step a flow's variables, including the cosine-sine pair, and restore the pair's length."""
    q, v, c, s = explicit(tableau, lambda t, y: equation.rate(coefficients, t, y, None), variables, dt)
    longer = 1.5 - 0.5 * (c * c + s * s)
    return q, v, c * longer, s * longer


@cache
def plain_series(order: int) -> Flow:
    """Return a flow of one Taylor series per step, of a fixed order, certified or not."""
    flow = pendulum_flow(order)
    return _always(flow, flow.fast, order)


def _always(flow: Flow, fast: Callable, order: int) -> Flow:
    """Return a flow that takes every step by `fast`."""
    fields = flow.coefficients._fields
    variables = [f"y{i}" for i in range(flow.size)]
    arguments = ", ".join([*variables, *fields, "dt"])

    def compile(absent: frozenset[str]) -> Callable:
        step = compile_traced(
            "step",
            arguments,
            lambda xp, *a: fast(a[: flow.size], flow.coefficients(*a[flow.size : -1]), a[-1], xp),
            absent,
        )
        ends = ", ".join(variables)
        source = f"def flow({arguments}, x):\n    {ends} = step({arguments})\n    return {ends}, 1\n"
        return compile_function("flow", source, step)

    return flow._replace(order=order, fast=fast, within=lambda *args: True, compile=compile)
