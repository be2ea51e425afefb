r"""A bar on a pivot whose support moves.

::

              s ->
        ------A------   support, moved with acceleration s''
               \
                \  L    theta = 0 hangs straight down,
                 G      positive counter-clockwise; y points up

The support A is at (s, rise), the centre of mass G at distance L from it, I is the inertia about G::

    T = m |G'|²/2 + I theta'²/2,   G' = (s' + L theta' cos(theta), rise' + L theta' sin(theta))
    V = m g (rise - L cos(theta))

`rise` rests at 0; it exists so that the support's vertical force can be derived.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes import shapes
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Arrow, Bodies, Circle, Line, Polygon, Role, Window


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
        Travel S of the support to either side, for tasks with a track. None leaves s and s' out of the
        state; infinity keeps them without a limit. `simulate` does not enforce it.

    Notes
    -----
    State (s, s_dot, theta, theta_dot); without a track (theta, theta_dot). Control s'' [m/s²]. The zero of
    the potential energy lies at the pivot. Without a track, the energy is that in the support's frame.

    Examples
    --------
    >>> bar = PivotedBar(mass=0.2, com_distance=0.3, damping=0.0, track=None)
    >>> bar.acceleration([0.0, 0.0], control=2.0)["theta"].round(3).item()
    -5.0
    """

    mass: float = parameter(0.2, "kg", above=0.0, usable=(1e-6, 1e6))
    com_distance: float = parameter(0.3, "m", above=0.0, usable=(1e-9, 1e9))
    inertia: float = parameter(
        lambda bar: bar.mass * bar.com_distance * bar.com_distance / 3.0,
        "kg m²",
        least=0.0,
        usable=(0.0, 1e27),
    )
    damping: float = parameter(0.0, "N m s", least=0.0, usable=(0.0, 1e9))
    gravity: float = parameter(9.81, "m/s²", least=0.0, usable=(0.0, 1e6))
    track: float | None = parameter(0.5, "m", above=0.0, endless=True, optional=True)

    coordinates = {"theta": "rad"}
    prescribed = {"s": "m", "rise": "m"}
    controls = {"s_ddot": "m/s²"}
    reactions = {"support_horizontal": "s", "support_vertical": "rise"}

    @property
    def left_out(self) -> tuple[str, ...]:
        """Without track, the support's place and rate."""
        return ("s", "s_dot") if self.track is None else ()

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        along = v.s + self.com_distance * v.theta * xp.cos(q.theta)
        up = v.rise + self.com_distance * v.theta * xp.sin(q.theta)
        return 0.5 * self.mass * (along * along + up * up) + 0.5 * self.inertia * v.theta * v.theta

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return self.mass * self.gravity * (q.rise - self.com_distance * xp.cos(q.theta))

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost in the pivot [W]."""
        return 0.5 * self.damping * v.theta * v.theta

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the poses of support and bar."""
        return {"support": (q.s, q.rise, 0.0), "bar": (q.s, q.rise, q.theta)}

    def bodies(self) -> Bodies:
        """Return rail, support and bar, the angle, and an arrow for the acceleration."""
        wide, high = 0.11 * self.reach, 0.05 * self.reach
        com = (0.0, -self.com_distance)
        return {
            "ground": shapes.rail(self.track, self.reach),
            "line": shapes.rail_without_end(self.track, self.reach),
            "support": [
                Line([(0.0, 0.0), (0.0, -0.4 * self.reach)], "guide"),
                Polygon([(-wide, -high), (wide, -high), (wide, high), (-wide, high)], "frame"),
            ],
            "angle": [shapes.half_turn(0.25 * self.reach)],
            "bar": [
                Line([(0.0, 0.0), com], "body"),
                self.outline(),
                Circle((0.0, 0.0), 0.02 * self.reach, "hole"),
                Circle(com, 0.022 * self.reach, "mark"),
            ],
            "push": [Arrow([(0.0, wide), (0.0, wide + 0.45 * self.reach)])],
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the poses of rail, angle and arrow."""
        s, down = now.q.s, -0.5 * math.pi
        return {
            "line": (s, 0.0),
            "angle": (s, 0.0, down, shapes.share_of_half_turn(now.q.theta, xp)),
            "push": (s, 0.0, down, now.share[0]),
        }

    def outline(self, role: Role = "body") -> Polygon:
        """Return the bar hanging down."""
        half = 0.035 * self.reach
        near, far = 2.0 * self.com_distance - self.reach - half, self.reach
        return Polygon([(-half, -near), (-half, -far), (half, -far), (half, -near)], role)

    @property
    def reach(self) -> float:
        """Distance from the pivot to the far end of a uniform bar with this mass, centre and inertia [m]."""
        return self.com_distance + 0.5 * math.sqrt(12.0 * self.inertia / self.mass)

    def window(self) -> Window:
        """Return a window on the whole track, or one that follows the support."""
        return shapes.window_on_rail(self.track, 1.08 * self.reach)
