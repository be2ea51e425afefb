"""The steppers that people would otherwise use, as flows: any scene can be stepped by them.

Each is written once, on generic numbers, for q'' = a(q, v, t), and compiled by the machinery that compiles
ours, so that times compare methods and not compilers. A comparison stepper takes one step per control step;
`n` substeps are `n` control steps of a length n times smaller.

Examples
--------
>>> from lag_envs.scenes import PivotedBar
>>> bar = with_flow(PivotedBar(track=None), comparison("RK4", PivotedBar(track=None).flow))
>>> bar.simulate([2.0, 0.0], [0.0] * 4, 0.005)[-1].round(6).tolist()
[1.995538, -0.446313]
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeVar

from lag_envs.scenes.base import Scene
from lag_envs.stepping import pendulum, slope
from lag_envs.stepping.compiling import compile_function, compile_traced
from lag_envs.stepping.flows import Flow, pendulum_flow
from lag_envs.stepping.tracing import polynomial

S = TypeVar("S", bound=Scene)

#: π/2 in three parts, of which the first two have zeros to spare (Cody and Waite).
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SIN = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(9)]
_COS = [(-1.0) ** k / math.factorial(2 * k) for k in range(10)]


def cosine_sine(angle: Any, xp: Any) -> tuple[Any, Any]:
    """Return cosine and sine to rounding, for angles up to some 1e5 rad.

    Arithmetic only, so that a compiled loop over a batch becomes vector instructions as ours does; with calls
    of the C library the comparison steppers would be ten times slower.
    """
    quarter = xp.floor(angle * (2.0 / math.pi) + 0.5)
    r = angle - quarter * _HALF_PI[0] - quarter * _HALF_PI[1] - quarter * _HALF_PI[2]
    z = r * r
    sine, cosine = r * polynomial(_SIN, z), polynomial(_COS, z)
    odd = quarter - 2.0 * xp.floor(0.5 * quarter) > 0.5
    back = quarter - 4.0 * xp.floor(0.25 * quarter)  # 0, 1, 2, 3
    c, s = xp.where(odd, sine, cosine), xp.where(odd, cosine, sine)
    return xp.where((back > 0.5) & (back < 2.5), -c, c), xp.where(back > 1.5, -s, s)


class Problem(NamedTuple):
    """One step's equation of motion, q'' = force(q, t) - drag q'."""

    force: Callable[[Any, Any], Any]
    gradient: Callable[[Any, Any], Any]  # of the force by q
    drag: Any

    def acceleration(self, q: Any, v: Any, t: Any) -> Any:
        """Return q''."""
        return self.force(q, t) - self.drag * v


def problem(coefficients: Any, variables: Sequence, xp: Any) -> Problem:
    """Return the equation of motion of a flow with these coefficients, from its variables at the start."""
    if isinstance(coefficients, pendulum.Drive):
        push = coefficients._replace(gamma=0.0)
        turn = pendulum.Drive(coefficients.alpha, coefficients.beta)

        def force(q: Any, t: Any) -> Any:
            c, s = variables[2:] if q is variables[0] else cosine_sine(q, xp)
            return pendulum.acceleration(0.0, c, s, push) + coefficients.ramp * t

        def gradient(q: Any, t: Any) -> Any:
            c, s = cosine_sine(q, xp)
            return pendulum.acceleration(0.0, -s, c, turn)

        return Problem(force, gradient, coefficients.gamma)
    if isinstance(coefficients, slope.Pull):
        pull = coefficients.pull
        return Problem(lambda q, t: pull, lambda q, t: 0.0 * q, coefficients.drag)
    plane = coefficients._replace(drag=0.0)

    def carried(q: Any, t: Any) -> Any:
        c, s = cosine_sine(plane.rate * t, xp)
        return slope.rolling(q, 0.0, variables[3] * c + variables[2] * s, plane)

    return Problem(carried, lambda q, t: plane.rolling * plane.rate * plane.rate, coefficients.drag)


# --- methods: (q, v) after one step of length h ---


def euler(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Explicit Euler, as in Gymnasium's CartPole."""
    return q + h * v, v + h * p.acceleration(q, v, 0.0)


def semi_implicit_euler(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Semi-implicit (symplectic) Euler, as in Gymnasium's Pendulum."""
    v = v + h * p.acceleration(q, v, 0.0)
    return q + h * v, v


def verlet(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Velocity Verlet; drag is treated explicitly before and implicitly after the drift."""
    half = v + 0.5 * h * p.acceleration(q, v, 0.0)
    q = q + h * half
    return q, (half + 0.5 * h * p.force(q, h)) / (1.0 + 0.5 * h * p.drag)


def rk4(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Runge and Kutta's classical method of order 4, as in Gymnasium's Acrobot."""
    half = 0.5 * h
    a1 = p.acceleration(q, v, 0.0)
    v2 = v + half * a1
    a2 = p.acceleration(q + half * v, v2, half)
    v3 = v + half * a2
    a3 = p.acceleration(q + half * v2, v3, half)
    v4 = v + h * a3
    a4 = p.acceleration(q + h * v3, v4, h)
    sixth = h * (1.0 / 6.0)
    return q + sixth * (v + 2.0 * (v2 + v3) + v4), v + sixth * (a1 + 2.0 * (a2 + a3) + a4)


def implicit_midpoint(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Implicit midpoint rule, symplectic and A-stable, with four iterations of Newton's method."""
    half = 0.5 * h
    middle = v
    for _ in range(4):
        place = q + half * middle
        residual = middle - v - half * p.acceleration(place, middle, half)
        middle = middle - residual / (1.0 + half * p.drag - half * half * p.gradient(place, half))
    return q + h * middle, 2.0 * middle - v


def etd4rk(p: Problem, q: Any, v: Any, h: Any, xp: Any) -> tuple[Any, Any]:
    """Exponential Runge-Kutta method of order 4 (Cox, Matthews 2002): the drag is solved exactly."""
    one, half = phis(p.drag * h, xp), phis(0.5 * (p.drag * h), xp)
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


class Method(NamedTuple):
    """A comparison stepper and its order of convergence."""

    step: Callable
    order: int


METHODS = {
    "explicit Euler": Method(euler, 1),
    "semi-implicit Euler": Method(semi_implicit_euler, 1),
    "Verlet": Method(verlet, 2),
    "implicit midpoint": Method(implicit_midpoint, 2),
    "RK4": Method(rk4, 4),
    "ETD4RK": Method(etd4rk, 4),
}


# --- as flows ---


@cache
def comparison(name: str, flow: Flow) -> Flow:
    """Return the comparison stepper of that name for the equation of a flow."""
    method = METHODS[name].step

    def fast(variables: Sequence, coefficients: Any, dt: Any, xp: Any) -> tuple:
        p = problem(coefficients, variables, xp)
        q, v = method(p, variables[0], variables[1], dt, xp)
        if isinstance(coefficients, pendulum.Drive):
            return q, v, *cosine_sine(q, xp)
        if isinstance(coefficients, slope.Turn):
            return q, v, *slope.rotate(variables[2], variables[3], coefficients.rate * dt)
        return q, v

    return _always(flow, fast, METHODS[name].order)


@cache
def plain_series(order: int) -> Flow:
    """Return one Taylor series per step, of a fixed order, certified or not."""
    flow = pendulum_flow(order)
    return _always(flow, flow.fast, order)


def _always(flow: Flow, fast: Callable, order: int) -> Flow:
    """Return a flow that takes every step by `fast`."""
    fields = flow.coefficients._fields
    variables = [f"y{i}" for i in range(flow.size)]
    arguments = ", ".join([*variables, *fields, "dt"])

    def compile(present: tuple[bool, ...]) -> Callable:
        step = compile_traced(
            "step",
            arguments,
            lambda xp, *a: fast(a[: flow.size], flow.coefficients(*a[flow.size : -1]), a[-1], xp),
            frozenset(name for name, there in zip(fields, present, strict=True) if not there),
        )
        ends = ", ".join(variables)
        source = f"def flow({arguments}, x):\n    {ends} = step({arguments})\n    return {ends}, 1\n"
        return compile_function("flow", source, step)

    return flow._replace(order=order, fast=fast, within=lambda *args: True, compile=compile)


def with_flow(scene: S, flow: Flow) -> S:
    """Return the scene stepped by another flow."""
    kind = _variant(type(scene), flow)
    values = {f.name: getattr(scene, f.name) for f in dataclasses.fields(scene)}
    return kind(**values)


@cache
def _variant(kind: type[S], flow: Flow) -> type[S]:
    return type(kind.__name__, (kind,), {"flow": flow})
