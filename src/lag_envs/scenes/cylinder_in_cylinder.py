r"""A cylinder that rolls without slipping inside a hollow cylinder, the shell.

::

        . - - - .        theta   place of the small cylinder's axis, 0 at the bottom,
      /     |     \              positive counter-clockwise
     |      |_a    |     psi     angle of the shell, positive counter-clockwise
      \      \    /      a = R - r, from axis to axis
        ' - -(o)'        gap     distance of the small cylinder from the shell
                         slip    displacement of its rim along the shell

If it rolls, the cylinder turns at Omega = (R psi' - a theta' + slip')/r::

    T = m ((a - gap)² theta'² + gap'²)/2 + I Omega²/2,   V = -m g (a - gap) cos(theta)

`gap` and `slip` rest at 0; they exist so that the contact's forces can be derived. A round shell has no
orientation, so a static tilt has no effect; the shell's acceleration drives the cylinder. Drag acts at the
small cylinder's axis, as if a medium turned with the shell. The shell's own inertia is not part of the scene.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import (
    Arrow,
    Bodies,
    Circle,
    Line,
    Polygon,
    Window,
    arc,
    half_turn,
    polar,
    roller,
    share_of_half_turn,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CylinderInCylinder(Scene):
    """A cylinder rolling inside a hollow one; the control is the drag or the shell's angular acceleration.

    Parameters
    ----------
    mass : float [kg]
        Mass m of the small cylinder.
    shell_radius : float [m]
        Inner radius R of the shell.
    radius : float [m]
        Radius r of the small cylinder, below `shell_radius`.
    inertia : float [kg m²], optional
        Moment of inertia I of the small cylinder about its axis; by default that of a solid cylinder, mr²/2.
    damping : float [N m s]
        Coefficient c of the drag -c(θ' - ψ'). It is added to the drag that the control sets.
    gravity : float [m/s²]
        Field g, downward.
    control : {"damping", "tilt"}
        The control: a drag coefficient [N m s] in a fixed shell, or the shell's acceleration ψ'' [rad/s²].

    Notes
    -----
    State (theta, theta_dot); for the control "tilt" (theta, theta_dot, psi_dot). The zero of the potential
    energy lies at the height of the shell's axis.

    Examples
    --------
    >>> shell = CylinderInCylinder()
    >>> shell.forces([0.0, 0.0, 0.0])["normal"].round(2).item()
    9.81
    """

    mass: float = parameter(1.0, "kg", above=0.0, usable=(1e-6, 1e6))
    shell_radius: float = parameter(0.5, "m", above=0.0, usable=(1e-9, 1e9))
    radius: float = parameter(0.1, "m", above=0.0, usable=(1e-9, 1e9))
    inertia: float = parameter(
        lambda shell: 0.5 * shell.mass * shell.radius * shell.radius, "kg m²", least=0.0, usable=(0.0, 1e27)
    )
    damping: float = parameter(0.0, "N m s", least=0.0, usable=(0.0, 1e9))
    gravity: float = parameter(9.81, "m/s²", least=0.0, usable=(0.0, 1e6))
    control: str = "tilt"

    coordinates = {"theta": "rad"}
    prescribed = {"psi": "rad", "gap": "m", "slip": "m"}
    modes = {"damping": {"drag": "N m s"}, "tilt": {"psi_ddot": "rad/s²"}}
    ratios = {"needed_friction": ("friction", "normal")}

    @property
    def state(self) -> tuple[str, ...]:
        """The small cylinder's entries, then the shell's rate."""
        return ("theta", "theta_dot", "psi_dot") if self.control == "tilt" else ()

    @property
    def left_out(self) -> tuple[str, ...]:
        """The shell's angle, on which nothing depends."""
        return ("psi",) if self.control == "tilt" else ()

    @property
    def reactions(self) -> dict[str, str]:
        """The contact's forces, and the torque on a turning shell."""
        contact = {"normal": "gap", "friction": "slip"}
        return contact | {"drive_torque": "psi"} if self.control == "tilt" else contact

    def check(self) -> None:
        """Check the radii."""
        if not self.radius < self.shell_radius:
            raise ValueError(
                f"radius must be below shell_radius={self.shell_radius:g} m, got {self.radius:g} m"
            )

    @property
    def arm(self) -> Any:
        """Distance a = R - r from axis to axis [m]."""
        return self.shell_radius - self.radius

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        swing = (self.arm - q.gap) * v.theta
        spin = (self.shell_radius * v.psi - self.arm * v.theta + v.slip) / self.radius
        return 0.5 * self.mass * (swing * swing + v.gap * v.gap) + 0.5 * self.inertia * spin * spin

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return -self.mass * self.gravity * (self.arm - q.gap) * xp.cos(q.theta)

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost to drag [W]."""
        return 0.5 * (self.damping + u.drag) * (v.theta - v.psi) * (v.theta - v.psi)

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the poses of shell and cylinder."""
        spin = (self.shell_radius * q.psi - self.arm * q.theta + q.slip) / self.radius
        return {
            "shell": (0.0, 0.0, q.psi),
            "cylinder": (*self.place(q.theta, self.arm - q.gap, xp), spin),
        }

    def bodies(self) -> Bodies:
        """Return the shell with its joints, the angle, the cylinder, and an arrow for the control."""
        big, rim, up, part = self.shell_radius, 1.1 * self.shell_radius, 0.5 * math.pi, math.pi / 12
        origin, joints = (0.0, 0.0), [up + part * i for i in range(3, 22, 2)]
        mark = [*arc(origin, rim, up - part, up + part), *arc(origin, big, up + part, up - part)]
        drag, push = [origin, (0.0, 0.6 * big)], arc(origin, 1.19 * big, 0.0, math.pi / 3)
        return {
            "shell": [
                Circle(origin, rim, "ground"),
                *(Line([polar(origin, big, a), polar(origin, rim, a)], "ground") for a in joints),
                Polygon(mark, "frame"),
                Circle(origin, big, "hole"),
            ],
            "ground": [Line([origin, (0.0, -big)], "guide")],
            "arm": [Line([origin, (0.0, -self.arm)], "guide")],
            "angle": [half_turn(0.4 * self.arm)],
            "cylinder": roller(self.radius, self.inertia / (self.mass * self.radius * self.radius)),
            "push": [Arrow(push if self.control == "tilt" else drag)],
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the poses of angle and arrow: the shell's acceleration beside it, drag at the cylinder."""
        theta, share, quarter = now.q.theta, now.share[0], 0.5 * math.pi
        found = {
            "arm": (0.0, 0.0, theta),
            "angle": (0.0, 0.0, -quarter, share_of_half_turn(theta, xp)),
        }
        if self.control == "tilt":
            return found | {"push": (0.0, 0.0, quarter, share)}
        back = xp.where(now.state[1] < 0.0, share, -share)
        return found | {"push": (*self.place(theta, xp=xp), theta - quarter, back)}

    def place(self, theta: Any, distance: Any = None, xp: Any = math) -> tuple[Any, Any]:
        """Return the point at an angle, and at a distance [m] from the shell's axis: by default R - r."""
        far = self.arm if distance is None else distance
        return far * xp.sin(theta), -far * xp.cos(theta)

    def window(self) -> Window:
        """Return a window on the whole shell."""
        size = 1.28 * self.shell_radius
        return Window(-size, -size, size, size)
