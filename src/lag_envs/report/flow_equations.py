"""The equations of motion that the fast flows solve, as the comparison integrators need them.

Each flow has a class, and `EQUATIONS` maps the type of the flow's coefficients to it. No other part of the
report depends on which flow it is.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from lag_envs.report.arithmetic import cosine_sine
from lag_envs.scenes.base import Scene
from lag_envs.stepping import pendulum, slope
from lag_envs.stepping.flows import SLIDE, TURN, Flow, pendulum_flow


class Problem(NamedTuple):
    """One step's equation of motion, q'' = force(q, t) - damping_rate q'."""

    force: Callable[[Any, Any], Any]
    gradient: Callable[[Any, Any], Any]  # of the force by q
    damping_rate: Any
    linear: bool  # whether the gradient is constant, so that Newton's method needs one iteration

    def acceleration(self, q: Any, v: Any, t: Any) -> Any:
        """Return q''."""
        return self.force(q, t) - self.damping_rate * v


class FlowEquation(ABC):
    """A flow's equation, whose methods take the flow's coefficients `k` at t = 0."""

    flow: Flow
    lifted = 4  #: number of the flow's variables: q, v, and cosine and sine where it has them
    turns = False  #: whether the plane turns, so that its angle at the start is needed

    @abstractmethod
    def rate(self, k: Any, t: Any, y: Sequence, xp: Any, angle: Any = 0.0) -> tuple:
        """Return (q', v'), and (c', s') if cosine and sine are among the unknowns.

        Parameters
        ----------
        k : NamedTuple
            The flow's coefficients.
        t : number
            The time [s].
        y : sequence
            q, v, and the flow's cosine and sine if they are unknowns.
        xp : namespace
            Namespace for cosine and sine if they are not unknowns.
        angle : number
            The turning plane's angle at t = 0, if its cosine and sine are not unknowns [rad].
        """

    @abstractmethod
    def problem(self, k: Any, variables: Sequence, xp: Any, carried: bool) -> Problem:
        """Return the equation of motion from the flow's variables at the start.

        If carried, cosines and sines are rotated from those at the start: exact to rounding up to 0.6 rad.
        """

    @abstractmethod
    def turned(self, k: Any, variables: Sequence, q: Any, dt: Any, xp: Any, carried: bool) -> Sequence:
        """Return the flow's cosine and sine after a step, from its variables at the start and the last q."""

    def later(self, k: Any, t: Any) -> Any:
        """Return the coefficients at a later time."""
        return k

    def field(self, k: Any, scene: Scene, dt: float) -> float:
        """Return the field's contribution to the speed in a step, or per time scale [1/s or m/s]."""
        return getattr(scene, "gravity", 0.0) * dt


class PendulumEquation(FlowEquation):
    """The driven pendulum."""

    flow = pendulum_flow()

    def rate(self, k: Any, t: Any, y: Sequence, xp: Any, angle: Any = 0.0) -> tuple:
        """Return the rates."""
        q, v, *pair = y
        c, s = pair or (xp.cos(q), xp.sin(q))
        acceleration = pendulum.acceleration(v, c, s, k) + k.ramp * t
        return (v, acceleration, -(v * s), v * c) if pair else (v, acceleration)

    def problem(self, k: Any, variables: Sequence, xp: Any, carried: bool) -> Problem:
        """Return the equation of motion."""
        undamped = k._replace(gamma=0.0)
        turn = pendulum.Coefficients(k.alpha, k.beta)
        start, *pair = variables[0], *variables[2:]

        def cos_sin(q: Any) -> Sequence:
            if q is start:
                return pair
            return pendulum.rotate(pair[0], pair[1], q - start) if carried else cosine_sine(q, xp)

        def force(q: Any, t: Any) -> Any:
            c, s = cos_sin(q)
            return pendulum.acceleration(0.0, c, s, undamped) + k.ramp * t

        def gradient(q: Any, t: Any) -> Any:
            c, s = cos_sin(q)
            return pendulum.acceleration(0.0, -s, c, turn)

        return Problem(force, gradient, k.gamma, False)

    def turned(self, k: Any, variables: Sequence, q: Any, dt: Any, xp: Any, carried: bool) -> Sequence:
        """Return the angle's cosine and sine."""
        if carried:
            return pendulum.rotate(variables[2], variables[3], q - variables[0])
        return cosine_sine(q, xp)

    def later(self, k: Any, t: Any) -> Any:
        """Return the coefficients with the ramp's part in the drive."""
        return k._replace(delta=k.delta + k.ramp * t)

    def field(self, k: Any, scene: Scene, dt: float) -> float:
        """Return the frequency of small oscillations."""
        return math.sqrt(math.hypot(k.alpha, k.beta))


class FixedSlopeEquation(FlowEquation):
    """Sliding on a fixed slope."""

    flow = SLIDE
    lifted = 2

    def rate(self, k: Any, t: Any, y: Sequence, xp: Any, angle: Any = 0.0) -> tuple:
        """Return the rates."""
        q, v, *_ = y
        return v, slope.sliding(v, k) + 0.0 * q

    def problem(self, k: Any, variables: Sequence, xp: Any, carried: bool) -> Problem:
        """Return the equation of motion."""
        return Problem(lambda q, t: k.acceleration, lambda q, t: 0.0, k.damping_rate, True)

    def turned(self, k: Any, variables: Sequence, q: Any, dt: Any, xp: Any, carried: bool) -> Sequence:
        """Return nothing: the flow has no cosine and sine."""
        return ()


class TurningSlopeEquation(FlowEquation):
    """Sliding on a plane that turns."""

    flow = TURN
    turns = True

    def rate(self, k: Any, t: Any, y: Sequence, xp: Any, angle: Any = 0.0) -> tuple:
        """Return the rates."""
        q, v, *pair = y
        if pair:
            return v, slope.turning(q, v, pair[1], k), -(k.rate * pair[1]), k.rate * pair[0]
        return v, slope.turning(q, v, xp.sin(angle + k.rate * t), k)

    def problem(self, k: Any, variables: Sequence, xp: Any, carried: bool) -> Problem:
        """Return the equation of motion."""
        plane = k._replace(damping_rate=0.0)

        def rolling(q: Any, t: Any) -> Any:
            if carried:
                s = slope.rotate(variables[2], variables[3], plane.rate * t)[1]
            else:
                c, s = cosine_sine(plane.rate * t, xp)
                s = variables[3] * c + variables[2] * s
            return slope.turning(q, 0.0, s, plane)

        return Problem(
            rolling, lambda q, t: plane.centrifugal * plane.rate * plane.rate, k.damping_rate, True
        )

    def turned(self, k: Any, variables: Sequence, q: Any, dt: Any, xp: Any, carried: bool) -> Sequence:
        """Return the plane's cosine and sine."""
        return slope.rotate(variables[2], variables[3], k.rate * dt)


#: The equations, by the type of their flow's coefficients.
EQUATIONS: Mapping[type, FlowEquation] = MappingProxyType(
    {kind.flow.coefficients: kind() for kind in (PendulumEquation, FixedSlopeEquation, TurningSlopeEquation)}
)
