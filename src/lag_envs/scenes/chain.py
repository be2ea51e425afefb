r"""A chain of equal bars hanging from a moving support.

::

              s ->
        ------A------   support, moved with acceleration s''
               \
                \  l    theta_1, theta_2, ...   angles of the bars from straight down,
                 o                              positive counter-clockwise
                 |
                 |      the support is at (s, rise); `rise` rests at 0 and serves to derive the vertical force

With the joints J₁ = (s, rise) and J_{i+1} = J_i + l (sin(theta_i), -cos(theta_i)), and centres of mass at the
distance c along each bar from its upper joint::

    T = Σ m |G_i'|²/2 + I theta_i'²/2,   V = Σ m g y(G_i)

A chain of one bar is a `PivotedBar`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes import shapes
from lag_envs.scenes.acrobot import link
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Arrow, Bodies, Polygon, Window


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chain(Scene):
    """A chain of equal bars on a moving support; the support's acceleration is the control.

    Parameters
    ----------
    bars : int
        Number of bars.
    mass : float [kg]
        Mass m of each bar.
    length : float [m]
        Distance l from joint to joint.
    com_distance : float [m], optional
        Distance c from a bar's upper joint to its centre of mass; by default half its length.
    inertia : float [kg m²], optional
        Moment of inertia I of each bar about its centre of mass; by default that of a uniform bar, ml²/12.
    damping : float [N m s]
        Coefficient b of the viscous torque in each joint.
    gravity : float [m/s²]
        Field g, downward.
    track : float [m]
        Travel S of the support to either side, for tasks with a track. `simulate` does not enforce it.

    Notes
    -----
    State (s, s_dot, theta_1, theta_1_dot, theta_2, ...). Control s'' [m/s²]. The zero of the potential energy
    lies at the support.
    """

    bars: int = 2
    mass: float = parameter(0.2, "kg", above=0.0)
    length: float = parameter(0.6, "m", above=0.0)
    com_distance: float = parameter(lambda chain: 0.5 * chain.length, "m", above=0.0)
    inertia: float = parameter(lambda chain: chain.mass * chain.length**2 / 12, "kg m²", least=0.0)
    damping: float = parameter(0.0, "N m s", least=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    track: float = parameter(math.inf, "m", above=0.0, endless=True)

    prescribed = {"s": "m", "rise": "m"}
    controls = {"s_ddot": "m/s²"}
    reactions = {"support_horizontal": "s", "support_vertical": "rise"}

    @property
    def coordinates(self) -> dict[str, str]:
        """One angle for each bar."""
        return {f"theta_{i + 1}": "rad" for i in range(self.bars)}

    def check(self) -> None:
        """Check the number of bars."""
        if isinstance(self.bars, bool) or not isinstance(self.bars, int) or self.bars < 1:
            raise ValueError(f"bars must be a whole number above 0, got {self.bars!r}")

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        total, x, y = 0.0, v.s, v.rise
        for i in range(self.bars):
            along, up = v[i] * xp.cos(q[i]), v[i] * xp.sin(q[i])
            speed = (x + self.com_distance * along) ** 2 + (y + self.com_distance * up) ** 2
            total += 0.5 * self.mass * speed + 0.5 * self.inertia * v[i] ** 2
            x, y = x + self.length * along, y + self.length * up
        return total

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        total, y = 0.0, q.rise
        for i in range(self.bars):
            total += self.mass * self.gravity * (y - self.com_distance * xp.cos(q[i]))
            y = y - self.length * xp.cos(q[i])
        return total

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost in the joints [W]."""
        bends = [v[0], *(v[i] - v[i - 1] for i in range(1, self.bars))]
        return 0.5 * self.damping * sum(bend**2 for bend in bends)

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the poses of support and bars."""
        x, y = q.s, q.rise
        poses = {"support": (x, y, 0.0)}
        for i in range(self.bars):
            poses[f"bar_{i + 1}"] = (x, y, q[i])
            x, y = x + self.length * xp.sin(q[i]), y - self.length * xp.cos(q[i])
        return poses

    def bodies(self) -> Bodies:
        """Return the rail, the support, the bars hanging down, and an arrow for the acceleration."""
        wide, high = 0.2 * self.length, 0.08 * self.length
        return {
            "ground": shapes.rail(self.track, self.reach),
            "line": shapes.rail_without_end(self.track, self.reach),
            "support": [Polygon([(-wide, -high), (wide, -high), (wide, high), (-wide, high)], "frame")],
            **{f"bar_{i + 1}": link(self.length) for i in range(self.bars)},
            "push": [Arrow([(0.0, wide), (0.0, wide + 0.45 * self.reach)])],
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the poses of the rail without ends and of the arrow."""
        return {"line": (now.q.s, 0.0), "push": (now.q.s, 0.0, -0.5 * math.pi, now.share[0])}

    @property
    def reach(self) -> float:
        """Length of the chain [m]."""
        return self.bars * self.length

    def window(self) -> Window:
        """Return a window on the whole track, or one that follows the support."""
        return shapes.window_on_rail(self.track, 1.08 * self.reach)
