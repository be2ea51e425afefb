r"""Two links hanging from a pivot, with a torque at the elbow, at the shoulder, or at both.

::

        A          theta_1   angle of the first link, 0 hangs straight down
         \
          \        theta_2   angle of the second link from the first, 0 is straight
           B---
               C   both positive counter-clockwise

With l₁ from shoulder to elbow, centres of mass at c₁ and c₂ along the links, and w = theta_1' + theta_2'::

    T = (m₁ c₁² + I₁ + m₂ l₁²) theta_1'²/2 + (m₂ c₂² + I₂) w²/2 + m₂ l₁ c₂ theta_1' w cos(theta_2)
    V = -(m₁ c₁ + m₂ l₁) g cos(theta_1) - m₂ c₂ g cos(theta_1 + theta_2)

Friction in each joint is b v + f atan(100 v): viscous friction, plus a rounded step for dry friction. Motors
with rotors of inertia J behind gears of ratio n, the elbow's motor being carried by the first link, add
J (n theta_1')²/2 + J (n theta_2' - theta_1')²/2 to T.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Bodies, Circle, Polygon, Shape, torque


@dataclasses.dataclass(frozen=True, kw_only=True)
class Acrobot(Scene):
    """Two links on a pivot; the control is a torque at one joint or at both.

    Parameters
    ----------
    mass_1, mass_2 : float [kg]
        Masses m of the links.
    length_1, length_2 : float [m]
        Lengths l of the links; that of the second link only matters for pictures.
    com_distance_1, com_distance_2 : float [m], optional
        Distances c from a link's upper joint to its centre of mass; by default half its length.
    inertia_1, inertia_2 : float [kg m²], optional
        Moments of inertia I about the centres of mass; by default those of uniform bars, ml²/12.
    damping, damping_2 : float [N m s]
        Coefficients b of the viscous friction in shoulder and elbow; the second defaults to the first.
    dry_friction, dry_friction_2 : float [N m]
        Coefficients f of the friction f atan(100 v) in shoulder and elbow, which reaches fπ/2; the second
        defaults to the first.
    rotor_inertia : float [kg m²]
        Inertia J of each motor's rotor.
    gear_ratio : float
        Ratio n of the rotors' speed to the joints'.
    gravity : float [m/s²]
        Field g, downward.
    control : {"elbow", "shoulder", "both"}
        Where torques act.

    Notes
    -----
    State (theta_1, theta_1_dot, theta_2, theta_2_dot). The controls are the torques `shoulder_torque`, on the
    first link, and `elbow_torque`, on the second with its reaction on the first. The zero of the potential
    energy lies at the shoulder. With ``inertia_1=inertia_2=1`` and ``gravity=9.8`` this is the model of
    Gymnasium's `Acrobot-v1`, as in Sutton and Barto's book.
    """

    mass_1: float = parameter(1.0, "kg", above=0.0)
    mass_2: float = parameter(1.0, "kg", above=0.0)
    length_1: float = parameter(1.0, "m", above=0.0)
    length_2: float = parameter(1.0, "m", above=0.0)
    com_distance_1: float = parameter(lambda arm: 0.5 * arm.length_1, "m", above=0.0)
    com_distance_2: float = parameter(lambda arm: 0.5 * arm.length_2, "m", above=0.0)
    inertia_1: float = parameter(lambda arm: arm.mass_1 * arm.length_1**2 / 12, "kg m²", least=0.0)
    inertia_2: float = parameter(lambda arm: arm.mass_2 * arm.length_2**2 / 12, "kg m²", least=0.0)
    damping: float = parameter(0.0, "N m s", least=0.0)
    damping_2: float = parameter(lambda arm: arm.damping, "N m s", least=0.0)
    dry_friction: float = parameter(0.0, "N m", least=0.0)
    dry_friction_2: float = parameter(lambda arm: arm.dry_friction, "N m", least=0.0)
    rotor_inertia: float = parameter(0.0, "kg m²", least=0.0)
    gear_ratio: float = parameter(6.0, "1", above=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    control: str = "elbow"

    coordinates = {"theta_1": "rad", "theta_2": "rad"}
    modes = {
        "elbow": {"elbow_torque": "N m"},
        "shoulder": {"shoulder_torque": "N m"},
        "both": {"shoulder_torque": "N m", "elbow_torque": "N m"},
    }

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        first, second = v.theta_1, v.theta_1 + v.theta_2
        elbow = self.length_1 * first
        about_shoulder = self.mass_1 * self.com_distance_1**2 + self.inertia_1
        about_elbow = self.mass_2 * self.com_distance_2**2 + self.inertia_2
        coupled = self.mass_2 * elbow * (0.5 * elbow + self.com_distance_2 * second * xp.cos(q.theta_2))
        rotors = (self.gear_ratio * first) ** 2 + (self.gear_ratio * v.theta_2 - first) ** 2
        links = 0.5 * about_shoulder * first**2 + 0.5 * about_elbow * second**2 + coupled
        return links + 0.5 * self.rotor_inertia * rotors

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        first = -self.com_distance_1 * xp.cos(q.theta_1)
        second = -self.length_1 * xp.cos(q.theta_1) - self.com_distance_2 * xp.cos(q.theta_1 + q.theta_2)
        return self.gravity * (self.mass_1 * first + self.mass_2 * second)

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return Rayleigh's function of the friction [W], whose derivative is b v + f atan(100 v)."""

        def joint(w: Any, damping: Any, dry_friction: Any) -> Any:
            rounded = w * xp.atan(100 * w) - xp.log(1 + (100 * w) ** 2) / 200
            return 0.5 * damping * w**2 + dry_friction * rounded

        shoulder = joint(v.theta_1, self.damping, self.dry_friction)
        return shoulder + joint(v.theta_2, self.damping_2, self.dry_friction_2)

    def applied(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return the torques [N m]."""
        return {"theta_1": u.shoulder_torque, "theta_2": u.elbow_torque}

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the poses of the links."""
        elbow = self.length_1 * xp.sin(q.theta_1), -self.length_1 * xp.cos(q.theta_1)
        return {"first": (0.0, 0.0, q.theta_1), "second": (*elbow, q.theta_1 + q.theta_2)}

    def bodies(self) -> Bodies:
        """Return the links hanging down, and arrows for the torques."""
        size = 0.2 * (self.length_1 + self.length_2)
        arrows = {name: torque(size) for name in self.control_names}
        return {"first": link(self.length_1), "second": link(self.length_2), **arrows}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the poses of the arrows."""
        places = {"shoulder_torque": "first", "elbow_torque": "second"}
        joints, down = self.poses(now.q, xp), -0.5 * math.pi
        return {name: (*joints[places[name]][:2], down, now.share[name]) for name in self.control_names}


def link(length: float) -> list[Shape]:
    """Return a link hanging down from its joint [m]."""
    half = 0.05 * length
    outline = [(-half, half), (-half, -length - half), (half, -length - half), (half, half)]
    return [
        Polygon(outline),
        Circle((0.0, 0.0), 0.5 * half, "hole"),
        Circle((0.0, -length), 0.5 * half, "mark"),
    ]
