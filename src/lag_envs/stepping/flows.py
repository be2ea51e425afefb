"""The three exact flows: how each is stepped, bounded, differentiated and compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

from lag_envs.stepping import pendulum, slope
from lag_envs.stepping.adjoint import Differentiable


class Flow(NamedTuple):
    """An exact flow and the ways to run it.

    ``fast(variables, coefficients, dt, xp)`` is the formula of an ordinary step,
    ``within(variables, coefficients, dt, x, xp)`` tells whether a step is ordinary, and ``compile(absent)``
    makes the scalar function for any step; `absent` names the coefficients that are zero.
    ``vjp(variables, coefficients, dt, bars, xp)`` records an ordinary step backwards, from cotangents of the
    first two variables to those of variables and coefficients. ``compile_tangent(absent, by)`` makes the
    function that differentiates any step with respect to the variables and the coefficients in `by`.
    ``order`` is the order of the certified series, 0 if there is none. ``method`` describes how a step is
    taken.
    """

    size: int
    coefficients: type[pendulum.Coefficients | slope.FixedSlope | slope.TurningSlope]
    order: int
    fast: Callable
    within: Callable
    vjp: Callable
    compile: Callable
    compile_tangent: Callable
    method: str


@cache
def pendulum_flow(order: int = pendulum.ORDER) -> Flow:
    """Return the flow of (θ, θ', cosθ, sinθ) by Taylor series of the given order."""

    def fast(variables: Sequence, coeffs: pendulum.Coefficients, dt: Any, xp: Any) -> tuple:
        theta, omega, c, s = variables
        return pendulum.step(theta, omega, c, s, coeffs, dt, order)

    return Flow(
        4,
        pendulum.Coefficients,
        order,
        fast,
        lambda variables, coeffs, dt, x, xp: pendulum.certified(variables[1], coeffs, dt, x, xp),
        lambda variables, coeffs, dt, bars, xp: pendulum.vjp(variables, coeffs, dt, bars, order),
        lambda absent: pendulum.compile_flow(absent, order),
        lambda absent, by: pendulum.compile_tangent(absent, by, order),
        f"one Taylor series of order {order}, no trigonometry",
    )


def _backwards(fast: Callable) -> Callable:
    """Return a flow's `vjp`: reverse mode on its recorded fast formula."""

    def vjp(variables: Sequence, coefficients: Any, dt: Any, bars: Sequence, xp: Differentiable) -> list:
        ends = fast(variables, coefficients, dt, xp)[:2]
        return xp.adjoint(ends, bars, [*variables, *coefficients])

    return vjp


def _slide(variables: Sequence, force: slope.FixedSlope, dt: Any, xp: Any) -> tuple:
    return slope.slide(variables[0], variables[1], force, dt)


def _turn(variables: Sequence, turn: slope.TurningSlope, dt: Any, xp: Any) -> tuple:
    x, v, c, s = variables
    return *slope.turn_series(x, v, c, s, turn, dt), *slope.rotate(c, s, turn.rate * dt)


SLIDE = Flow(
    2,
    slope.FixedSlope,
    0,
    _slide,
    lambda variables, force, dt, x, xp: slope.slides(force, dt),
    _backwards(_slide),
    slope.compile_slide,
    slope.compile_slide_tangent,
    "closed form",
)
TURN = Flow(
    4,
    slope.TurningSlope,
    0,
    _turn,
    lambda variables, turn, dt, x, xp: slope.turns(turn, dt, xp),
    _backwards(_turn),
    slope.compile_turn,
    slope.compile_turn_tangent,
    f"series of order {slope.TURN_ORDER}, summed to rounding",
)
