r"""A bar on a pivot whose support moves.

::

              s ->
        ------A------   support, moved with acceleration u = s''
               \
                \  L    theta = 0 hangs straight down,
                 G      positive counter-clockwise; y points up

Lagrangian (A at (s, 0), centre of mass G at distance L from it, I about G)::

    T - V = m s'²/2 + m L s' theta' cos(theta) + (m L² + I) theta'²/2 + m g L cos(theta)

The support is moved from outside, so the equation of motion is that of theta alone::

    theta'' = -(m L (u cos(theta) + g sin(theta)) + b theta') / (m L² + I)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lag_envs.scenes import shapes
from lag_envs.scenes.base import Motion, Scene, check_number, parameter
from lag_envs.scenes.shapes import Arrow, Circle, Line, Moment, Point, Polygon, Shape, Window
from lag_envs.stepping import pendulum
from lag_envs.stepping.flows import Flow, pendulum_flow


@dataclasses.dataclass(frozen=True, kw_only=True)
class PivotedBar(Scene):
    """A bar on a pivot whose support moves; the support's acceleration is the control.

    Parameters
    ----------
    mass : float [kg]
        Mass m of the bar.
    com_distance : float [m]
        Distance L from the pivot to the centre of mass; half of the length of a uniform bar.
    inertia : float [kg m²], optional
        Moment of inertia I about the centre of mass; by default that of a uniform bar, mL²/3.
    damping : float [N m s]
        Coefficient b of the pivot's viscous torque -bθ'.
    gravity : float [m/s²]
        Field g, downward.
    track : float [m] or None
        The support's travel to either side, for tasks that have a track. None leaves s and s' out
        of the state; infinity keeps them without a limit. `simulate` does not enforce it.

    Notes
    -----
    State (s, s_dot, theta, theta_dot), without track (theta, theta_dot). Control s'' [m/s²]. The zero of the
    potential energy lies at the pivot. Without track the energy is that in the support's frame.

    Examples
    --------
    >>> bar = PivotedBar(mass=0.2, com_distance=0.3, damping=0.0, track=None)
    >>> bar.simulate([3.14159, 0.0], [0.0] * 50, dt=0.02).shape
    (51, 2)
    """

    mass: float = parameter(0.2, "kg", above=0.0, usable=(1e-6, 1e6))
    com_distance: float = parameter(0.3, "m", above=0.0, usable=(1e-9, 1e9))
    inertia: float = parameter(None, "kg m²", least=0.0, usable=(0.0, 1e27))
    damping: float = parameter(0.0, "N m s", least=0.0, usable=(0.0, 1e9))
    gravity: float = parameter(9.81, "m/s²", least=0.0, usable=(0.0, 1e6))
    track: float | None = 0.5

    def check(self) -> None:
        """Fill in the uniform bar's inertia and check the track."""
        if self.inertia is None:
            object.__setattr__(self, "inertia", self.mass * self.com_distance * self.com_distance / 3.0)
        if self.track is not None:
            track = check_number("track", self.track, "m", endless=True)
            if not track > 0.0:
                raise ValueError(f"track must be above 0 m, infinity or None, got {track:g} m")
            object.__setattr__(self, "track", track)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries."""
        return ("theta", "theta_dot") if self.track is None else ("s", "s_dot", "theta", "theta_dot")

    @property
    def state_units(self) -> tuple[str, ...]:
        """Their units."""
        return ("rad", "rad/s") if self.track is None else ("m", "m/s", "rad", "rad/s")

    @property
    def control_unit(self) -> str:
        """The support's acceleration."""
        return "s'' [m/s²]"

    @property
    def coordinates(self) -> tuple[str, ...]:
        """The bar's angle is free, the support is moved."""
        return ("theta", "s")

    @property
    def flow(self) -> Flow:
        """The driven pendulum; at order 14 one step of 0.02 s is certified for all that the tasks reach."""
        return pendulum_flow(14)

    @property
    def angle(self) -> int:
        """Index of theta."""
        return len(self.state_names) - 2

    def constants(self) -> dict[str, Any]:
        """Return mL/J, mgL/J and b/J with J = mL² + I."""
        arm = self.mass * self.com_distance
        about_pivot = arm * self.com_distance + self.inertia
        return {
            "pull": arm / about_pivot,
            "weight": arm * self.gravity / about_pivot,
            "drag": self.damping / about_pivot,
        }

    def drive(self, y: Sequence, u: Any, k: Any, xp: Any) -> pendulum.Drive:
        """Return the pendulum's coefficients under the support's acceleration u."""
        return pendulum.Drive(alpha=k.weight, beta=k.pull * u, gamma=k.drag)

    def unpack(self, y: Sequence, u: Any, k: Any) -> Sequence:
        """Return the pendulum's part of the state."""
        return y[-4:]

    def pack(self, moved: Sequence, y: Sequence, u: Any, dt: Any, k: Any) -> Sequence:
        """Move the support, exactly: its acceleration is held."""
        if self.track is None:
            return moved
        s, s_dot = y[:2]
        return (s + dt * (s_dot + 0.5 * dt * u), s_dot + dt * u, *moved)

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        arm = self.mass * self.com_distance
        about_pivot = arm * self.com_distance + self.inertia
        return (
            0.5 * self.mass * v.s * v.s
            + arm * v.s * v.theta * xp.cos(q.theta)
            + 0.5 * about_pivot * v.theta * v.theta
        )

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return -self.mass * self.gravity * self.com_distance * xp.cos(q.theta)

    def dissipation(self, v: Any, u: Any) -> Any:
        """Return half of the pivot's loss [W]."""
        return 0.5 * self.damping * v.theta * v.theta

    def motion(self, state: ArrayLike, control: ArrayLike) -> Motion:
        """Return s, theta and their derivatives."""
        u = np.asarray(control, dtype=np.float64)
        y = self.lift(state)
        s, s_dot = (0.0, 0.0) if self.track is None else y[:2]
        theta, omega, c, sine = y[-4:]
        coefficients = self.drive(y, u, SimpleNamespace(**self.constants()), np)
        return Motion(
            SimpleNamespace(s=s, theta=theta),
            SimpleNamespace(s=s_dot, theta=omega),
            SimpleNamespace(s=u, theta=pendulum.acceleration(omega, c, sine, coefficients)),
        )

    def reactions(self, m: Motion, u: Any) -> dict[str, Any]:
        """Return the force of the support on the bar, horizontal and vertical [N]."""
        c, s = np.cos(m.q.theta), np.sin(m.q.theta)
        turn = m.v.theta * m.v.theta
        return {
            "support_horizontal": self.mass * (m.a.s + self.com_distance * (m.a.theta * c - turn * s)),
            "support_vertical": self.mass * (self.gravity + self.com_distance * (m.a.theta * s + turn * c)),
        }

    def drive_power(self, m: Motion, u: Any) -> Any:
        """Return the power of the support's force [W]; without track that of its frame's inertial force."""
        if self.track is None:
            return -self.mass * self.com_distance * u * m.v.theta * np.cos(m.q.theta)
        return self.reactions(m, u)["support_horizontal"] * m.v.s

    @property
    def reach(self) -> float:
        """Distance from the pivot to the far end of a uniform bar with this mass, centre and inertia [m]."""
        return self.com_distance + 0.5 * self._length

    @property
    def _length(self) -> float:
        return math.sqrt(12.0 * self.inertia / self.mass)

    def outline(self, s: float, theta: float) -> list[Point]:
        """Return the corners of the bar [m]."""
        half = 0.035 * self.reach
        near, far = self.com_distance - 0.5 * self._length - half, self.reach
        along, across = (math.sin(theta), -math.cos(theta)), (math.cos(theta), math.sin(theta))
        corners = [(near, -half), (far, -half), (far, half), (near, half)]
        return [(s + a * along[0] + b * across[0], a * along[1] + b * across[1]) for a, b in corners]

    def shapes(self, now: Moment) -> list[Shape]:
        """Return track, support and bar, and the angle."""
        s, theta, reach = (0.0 if self.track is None else now.state[0]), now.state[-2], self.reach
        wide, high = 0.11 * reach, 0.05 * reach
        slider = [(s - wide, -high), (s + wide, -high), (s + wide, high), (s - wide, high)]
        com = (s + self.com_distance * math.sin(theta), -self.com_distance * math.cos(theta))
        turn = math.remainder(theta, 2.0 * math.pi)
        edge = s + math.copysign(wide, now.share)
        return [
            *self._rail(s),
            Line([(s, 0.0), (s, -0.4 * reach)], "guide"),
            Line(shapes.arc((s, 0.0), 0.25 * reach, -0.5 * math.pi, turn - 0.5 * math.pi), "guide"),
            Polygon(slider, "frame"),
            Line([(s, 0.0), com], "body"),
            Polygon(self.outline(s, theta)),
            Circle((s, 0.0), 0.02 * reach, "hole"),
            Circle(com, 0.022 * reach, "mark"),
            Arrow([(edge, 0.0), (edge + 0.45 * reach * now.share, 0.0)]),
        ]

    def _rail(self, s: float) -> list[Shape]:
        if self.track is None:
            return [Line([(-2.0 * self.reach, 0.0), (2.0 * self.reach, 0.0)], "guide")]
        endless, size = math.isinf(self.track), 0.035 * self.reach
        low, high = (s - 3.0 * self.reach, s + 3.0 * self.reach) if endless else (-self.track, self.track)
        step = shapes.round_length(0.1 * (high - low))
        rail: list[Shape] = [Line([(x, 0.0), (x, -size)], "ground") for x in shapes.ticks(low, high, step)]
        rail.append(Line([(low, 0.0), (high, 0.0)], "frame"))
        if not endless:
            rail += [Line([(end, -2.0 * size), (end, 2.0 * size)], "limit") for end in (low, high)]
        return rail

    def window(self, now: Moment) -> Window:
        """Return a window on the whole track, or one that follows the support."""
        tall = 1.08 * self.reach
        if self.track is None or math.isinf(self.track):
            s = 0.0 if self.track is None else now.state[0]
            return Window(s - tall, -tall, s + tall, tall)
        return Window(-self.track - tall, -tall, self.track + tall, tall)
