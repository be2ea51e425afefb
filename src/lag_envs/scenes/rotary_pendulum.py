r"""Furuta's pendulum: an arm that a motor turns about the vertical, with a pendulum at its end.

::

         |               phi     angle of the arm, positive counter-clockwise seen from above
         |    r    A
        (|)--------o     theta   angle of the pendulum in the vertical plane across the arm;
         |          \            0 hangs straight down, positive towards growing phi
         |           \ L
                      G

With J the arm's inertia about the vertical, m the pendulum's mass and I its inertia about any axis
perpendicular to it through its centre of mass G::

    T = (J + m r²) phi'²/2 + m r L phi' theta' cos(theta) + (m L² + I)(theta'² + phi'² sin(theta)²)/2
    V = -m g L cos(theta)
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Bodies, Circle, Polygon, torque


@dataclasses.dataclass(frozen=True, kw_only=True)
class RotaryPendulum(Scene):
    """A pendulum at the end of a turning arm; the control is the torque on the arm.

    Parameters
    ----------
    arm_length : float [m]
        Distance r from the vertical axis to the pendulum's hinge.
    arm_inertia : float [kg m²]
        Inertia J of arm and motor about the vertical axis.
    mass : float [kg]
        Mass m of the pendulum.
    com_distance : float [m]
        Distance L from the hinge to the pendulum's centre of mass.
    inertia : float [kg m²], optional
        Inertia I of the pendulum about its centre of mass; by default that of a uniform rod, mL²/3.
    arm_damping, damping : float [N m s]
        Coefficients b of the viscous torques at the arm's axis and at the hinge.
    gravity : float [m/s²]
        Field g, downward.

    Notes
    -----
    State (phi, phi_dot, theta, theta_dot). Control: torque [N m]. The zero of the potential energy lies at
    the hinge. The default sizes are those of a desktop apparatus. Pictures show two views side by side: on
    the left the arm, seen from above; on the right the pendulum, seen along the arm that carries it.
    """

    arm_length: float = parameter(0.2, "m", above=0.0)
    arm_inertia: float = parameter(1e-3, "kg m²", above=0.0)
    mass: float = parameter(0.1, "kg", above=0.0)
    com_distance: float = parameter(0.15, "m", above=0.0)
    inertia: float = parameter(lambda rod: rod.mass * rod.com_distance**2 / 3, "kg m²", least=0.0)
    arm_damping: float = parameter(0.0, "N m s", least=0.0)
    damping: float = parameter(0.0, "N m s", least=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)

    coordinates = {"phi": "rad", "theta": "rad"}
    controls = {"torque": "N m"}

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        arm = self.arm_inertia + self.mass * self.arm_length**2
        coupling = self.mass * self.arm_length * self.com_distance * xp.cos(q.theta)
        pendulum = self.mass * self.com_distance**2 + self.inertia
        swing = 0.5 * pendulum * (v.theta**2 + (v.phi * xp.sin(q.theta)) ** 2)
        return 0.5 * arm * v.phi**2 + coupling * v.phi * v.theta + swing

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return -self.mass * self.gravity * self.com_distance * xp.cos(q.theta)

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost in both axes [W]."""
        return 0.5 * self.arm_damping * v.phi**2 + 0.5 * self.damping * v.theta**2

    def applied(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return the torque on the arm [N m]."""
        return {"phi": u.torque}

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the arm, seen from above, and beside it the pendulum, seen along the arm."""
        return {"arm": (0.0, 0.0, q.phi), "pendulum": (1.5 * self.arm_length, 0.0, q.theta)}

    def bodies(self) -> Bodies:
        """Return the arm, the pendulum hanging down, and an arrow for the torque."""
        wide = 0.05 * self.arm_length
        r, long = self.arm_length, 2.0 * self.com_distance
        return {
            "arm": [
                Polygon([(-wide, -wide), (r + wide, -wide), (r + wide, wide), (-wide, wide)], "frame"),
                Circle((0.0, 0.0), 0.5 * wide, "hole"),
            ],
            "pendulum": [
                Polygon([(-wide, wide), (-wide, -long), (wide, -long), (wide, wide)]),
                Circle((0.0, 0.0), 0.5 * wide, "hole"),
            ],
            "push": torque(0.5 * r),
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the pose of the arrow."""
        return {"push": (0.0, 0.0, -0.5 * math.pi, now.share.torque)}
