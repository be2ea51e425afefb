r"""A robot's arm of two links in a vertical plane, with a motor in each joint and a load in its hand.

::

               C   hand, with the load
              /
        A----B     theta_1   angle of the upper arm from the horizontal,
                   theta_2   angle of the forearm from the upper arm,
                             both positive counter-clockwise

With l the lengths of the uniform links, m their masses and p the load's mass, G the links' centres at half
length, and w = theta_1' or theta_1' + theta_2' their rates::

    T = Σ (m |G'|² + m l² w²/12)/2 + p |C'|²/2,   V = g (Σ m y(G) + p y(C))

With ``gravity=0`` the arm moves in a horizontal plane.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Bodies, Circle, Polygon, Shape, torque


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoLinkArm(Scene):
    """An arm of two links; the controls are the torques in shoulder and elbow.

    Parameters
    ----------
    mass_1, mass_2 : float [kg]
        Masses m of upper arm and forearm, uniform bars.
    length_1, length_2 : float [m]
        Lengths l of upper arm and forearm.
    load : float [kg]
        Mass p of a point mass in the hand.
    damping : float [N m s]
        Coefficient b of the viscous torque in both joints.
    gravity : float [m/s²]
        Field g, downward.

    Notes
    -----
    State (theta_1, theta_1_dot, theta_2, theta_2_dot). Controls `shoulder` and `elbow` [N m]; the elbow's
    torque acts on the forearm, with its reaction on the upper arm. The zero of the potential energy lies at
    the shoulder.
    """

    mass_1: float = parameter(2.0, "kg", above=0.0)
    mass_2: float = parameter(1.0, "kg", above=0.0)
    length_1: float = parameter(0.4, "m", above=0.0)
    length_2: float = parameter(0.3, "m", above=0.0)
    load: float = parameter(0.0, "kg", least=0.0)
    damping: float = parameter(0.0, "N m s", least=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)

    coordinates = {"theta_1": "rad", "theta_2": "rad"}
    controls = {"shoulder": "N m", "elbow": "N m"}

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        first, second = v.theta_1, v.theta_1 + v.theta_2

        def point(mass: Any, upper: Any, fore: Any) -> Any:
            """Return twice the energy of a mass at these distances along upper arm and forearm."""
            a, b = upper * first, fore * second
            return mass * (a**2 + b**2 + 2 * a * b * xp.cos(q.theta_2))

        turning = (
            self.mass_1 * (self.length_1 * first) ** 2 / 12 + self.mass_2 * (self.length_2 * second) ** 2 / 12
        )
        return 0.5 * (
            point(self.mass_1, self.length_1 / 2, 0)
            + point(self.mass_2, self.length_1, self.length_2 / 2)
            + point(self.load, self.length_1, self.length_2)
            + turning
        )

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        upper, fore = self.length_1 * xp.sin(q.theta_1), self.length_2 * xp.sin(q.theta_1 + q.theta_2)
        links = self.mass_1 * upper / 2 + self.mass_2 * (upper + fore / 2)
        return self.gravity * (links + self.load * (upper + fore))

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost in the joints [W]."""
        return 0.5 * self.damping * (v.theta_1**2 + v.theta_2**2)

    def applied(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return the torques [N m]."""
        return {"theta_1": u.shoulder, "theta_2": u.elbow}

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the poses of the links."""
        elbow = self.length_1 * xp.cos(q.theta_1), self.length_1 * xp.sin(q.theta_1)
        return {"upper_arm": (0.0, 0.0, q.theta_1), "forearm": (*elbow, q.theta_1 + q.theta_2)}

    def bodies(self) -> Bodies:
        """Return the links along the horizontal, the forearm with its hand, and arrows for the torques."""
        upper, fore = (self._link(length) for length in (self.length_1, self.length_2))
        return {
            "upper_arm": upper,
            "forearm": [*fore, Circle((self.length_2, 0.0), 0.07 * self.length_2, "mark")],
            "shoulder": torque(0.3 * self.length_1),
            "elbow": torque(0.3 * self.length_2),
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the poses of the arrows."""
        x, y, _ = self.poses(now.q, xp)["forearm"]
        return {"shoulder": (0.0, 0.0, 0.0, now.share.shoulder), "elbow": (x, y, 0.0, now.share.elbow)}

    @staticmethod
    def _link(length: float) -> list[Shape]:
        half = 0.05 * length
        outline = [(-half, -half), (length + half, -half), (length + half, half), (-half, half)]
        return [Polygon(outline), Circle((0.0, 0.0), 0.5 * half, "hole")]
