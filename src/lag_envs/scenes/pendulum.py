r"""A rod on a hinge, with a torque.

::

        \  A       theta   0 is upright, positive counter-clockwise
         \ |
          \|
          (O)      torque

The rod is uniform, of mass m and length l, and hinged at its end::

    T = m l² theta'²/6,   V = m g l cos(theta)/2

This is the model of Gymnasium's `Pendulum-v1`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Bodies, Circle, Polygon, torque


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pendulum(Scene):
    """A rod on a hinge; the control is the torque about it.

    Parameters
    ----------
    mass : float [kg]
        Mass m of the rod.
    length : float [m]
        Length l of the rod.
    damping : float [N m s]
        Coefficient b of the viscous torque at the hinge.
    gravity : float [m/s²]
        Field g, downward.

    Notes
    -----
    State (theta, theta_dot). The zero of the potential energy lies at the hinge.

    Examples
    --------
    >>> Pendulum(gravity=10.0).acceleration([0.0, 0.0], 2.0)["theta"].item()
    6.0
    """

    mass: float = parameter(1.0, "kg", above=0.0)
    length: float = parameter(1.0, "m", above=0.0)
    damping: float = parameter(0.0, "N m s", least=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)

    coordinates = {"theta": "rad"}
    controls = {"torque": "N m"}

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        return self.mass * self.length**2 * v.theta**2 / 6

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return 0.5 * self.mass * self.gravity * self.length * xp.cos(q.theta)

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost in the hinge [W]."""
        return 0.5 * self.damping * v.theta**2

    def applied(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return the torque [N m]."""
        return {"theta": u.torque}

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the rod's pose."""
        return {"rod": (0.0, 0.0, q.theta)}

    def bodies(self) -> Bodies:
        """Return the upright rod, and an arrow for the torque."""
        half, long = 0.06 * self.length, self.length
        return {
            "rod": [
                Polygon([(-half, -half), (half, -half), (half, long + half), (-half, long + half)]),
                Circle((0.0, 0.0), 0.5 * half, "hole"),
            ],
            "push": torque(0.3 * long),
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the pose of the arrow."""
        return {"push": (0.0, 0.0, -0.5 * math.pi, now.share.torque)}
