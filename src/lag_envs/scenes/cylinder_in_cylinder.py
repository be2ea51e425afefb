r"""A cylinder that rolls without slipping inside a hollow cylinder, the shell.

::

        . - - - .        theta   place of the small cylinder's axis, 0 at the bottom,
      /     |     \              positive counter-clockwise
     |      |_a    |     psi     angle of the shell, positive counter-clockwise
      \      \    /      a = R - r, from axis to axis
        ' - -(o)'

With K = I/(m r²) and k = 1/(1 + K), the rolling cylinder turns at Omega = (R psi' - a theta')/r::

    T = m a² theta'²/2 + I Omega²/2,   V = -m g a cos(theta)

    theta'' = -(k g/a) sin(theta) + k K (R/a) psi'' - (c k/(m a²)) (theta' - psi')

A round shell has no orientation: a static tilt does nothing, its acceleration drives. Drag acts at the small
cylinder's axis, as of a medium that turns with the shell. The shell's own inertia is not part of the scene.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lag_envs.scenes.base import Motion, Scene, friction_ratio, parameter, shown
from lag_envs.scenes.shapes import (
    Arrow,
    Circle,
    Line,
    Moment,
    Point,
    Polygon,
    Shape,
    Window,
    arc,
    polar,
    roller,
)
from lag_envs.stepping import pendulum
from lag_envs.stepping.flows import Flow, pendulum_flow

CONTROLS = {"damping": "c [N m s]", "tilt": "psi'' [rad/s²]"}


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
        Moment of inertia I of the small cylinder about its axis; by default solid, mr²/2.
    damping : float [N m s]
        Coefficient c of the drag -c(θ' - ψ'). It adds to a drag that is the control.
    gravity : float [m/s²]
        Field g, downward.
    control : {"damping", "tilt"}
        What the control is: a drag coefficient [N m s] in a fixed shell, or the shell's acceleration ψ''
        [rad/s²].

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
    inertia: float = parameter(None, "kg m²", least=0.0, usable=(0.0, 1e27))
    damping: float = parameter(0.0, "N m s", least=0.0, usable=(0.0, 1e9))
    gravity: float = parameter(9.81, "m/s²", least=0.0, usable=(0.0, 1e6))
    control: str = "tilt"

    def check(self) -> None:
        """Fill in the solid cylinder's inertia; check the radii and the control."""
        if not isinstance(self.control, str) or self.control not in CONTROLS:
            raise ValueError(f"control must be one of {', '.join(CONTROLS)}, got {shown(self.control)}")
        if not self.radius < self.shell_radius:
            raise ValueError(
                f"radius must be below shell_radius={self.shell_radius:g} m, got {self.radius:g} m"
            )
        if self.inertia is None:
            object.__setattr__(self, "inertia", 0.5 * self.mass * self.radius * self.radius)

    @property
    def arm(self) -> Any:
        """Distance a = R - r from axis to axis [m]."""
        return self.shell_radius - self.radius

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries."""
        return ("theta", "theta_dot", "psi_dot") if self.control == "tilt" else ("theta", "theta_dot")

    @property
    def state_units(self) -> tuple[str, ...]:
        """Their units."""
        return ("rad", "rad/s", "rad/s")[: len(self.state_names)]

    @property
    def control_unit(self) -> str:
        """The control and its unit."""
        return CONTROLS[self.control]

    @property
    def coordinates(self) -> tuple[str, ...]:
        """The small cylinder's place is free, the shell is moved."""
        return ("theta", "psi")

    @property
    def flow(self) -> Flow:
        """The driven pendulum; at order 20 one step of 0.05 s is certified where 16 would take two."""
        return pendulum_flow(20)

    @property
    def angle(self) -> int:
        """Index of theta."""
        return 0

    def constants(self) -> dict[str, Any]:
        """Return the numbers that the chosen control needs."""
        ratio = self.inertia / (self.mass * self.radius * self.radius)
        rolling = 1.0 / (1.0 + ratio)
        per_damping = rolling / (self.mass * self.arm * self.arm)
        k = {"weight": rolling * self.gravity / self.arm, "drag": self.damping * per_damping}
        if self.control == "damping":
            return k | {"brake": per_damping}
        return k | {"push": rolling * ratio * self.shell_radius / self.arm}

    def drive(self, y: Sequence, u: Any, k: Any, xp: Any) -> pendulum.Drive:
        """Return the pendulum's coefficients; in a turning shell the drag makes the drive linear in time."""
        if self.control == "damping":
            return pendulum.Drive(alpha=k.weight, gamma=k.drag + k.brake * u)
        return pendulum.Drive(alpha=k.weight, gamma=k.drag, delta=k.push * u + k.drag * y[2], ramp=k.drag * u)

    def unpack(self, y: Sequence, u: Any, k: Any) -> Sequence:
        """Return the pendulum's part of the state."""
        return (*y[:2], *y[-2:])

    def pack(self, moved: Sequence, y: Sequence, u: Any, dt: Any, k: Any) -> Sequence:
        """Return the state; the shell's rate is linear in time."""
        if self.control == "damping":
            return moved
        return (*moved[:2], y[2] + dt * u, *moved[2:])

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        swing = self.arm * v.theta
        spin = (self.shell_radius * v.psi - swing) / self.radius
        return 0.5 * self.mass * swing * swing + 0.5 * self.inertia * spin * spin

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return -self.mass * self.gravity * self.arm * xp.cos(q.theta)

    def dissipation(self, v: Any, u: Any) -> Any:
        """Return half of the drag's loss [W]."""
        c = self.damping + u if self.control == "damping" else self.damping
        return 0.5 * c * (v.theta - v.psi) * (v.theta - v.psi)

    def motion(self, state: ArrayLike, control: ArrayLike) -> Motion:
        """Return theta, psi (0: a round shell has no orientation) and their derivatives."""
        u = np.asarray(control, dtype=np.float64)
        y = self.lift(state)
        coefficients = self.drive(y, u, SimpleNamespace(**self.constants()), np)
        psi_dot, psi_ddot = (y[2], u) if self.control == "tilt" else (0.0, 0.0)
        theta_ddot = pendulum.acceleration(y[1], y[-2], y[-1], coefficients)
        return Motion(
            SimpleNamespace(theta=y[0], psi=0.0),
            SimpleNamespace(theta=y[1], psi=psi_dot),
            SimpleNamespace(theta=theta_ddot, psi=psi_ddot),
        )

    def reactions(self, m: Motion, u: Any) -> dict[str, Any]:
        """Return normal force (contact is lost below 0), friction, needed μ and the torque on the shell."""
        normal = self.mass * (self.arm * m.v.theta * m.v.theta + self.gravity * np.cos(m.q.theta))
        friction = (
            self.inertia * (self.shell_radius * m.a.psi - self.arm * m.a.theta) / (self.radius * self.radius)
        )
        needed = friction_ratio(friction, normal, self.mass * self.gravity)
        forces = {"normal": normal, "friction": friction, "needed_friction": needed}
        if self.control == "tilt":
            forces["drive_torque"] = friction * self.shell_radius + self.damping * (m.v.psi - m.v.theta)
        return forces

    def drive_power(self, m: Motion, u: Any) -> Any:
        """Return the power of the torque that turns the shell [W]."""
        if self.control == "damping":
            return 0.0 * m.v.theta
        return self.reactions(m, u)["drive_torque"] * m.v.psi

    def turning(self, state: Sequence[float]) -> float:
        """Return the shell's rate [rad/s]; its angle is not in the state."""
        return state[2] if self.control == "tilt" else 0.0

    def place(self, theta: float, distance: float | None = None) -> Point:
        """Return the point at an angle, and at a distance [m] from the shell's axis: by default R - r."""
        return polar((0.0, 0.0), self.arm if distance is None else distance, theta - 0.5 * math.pi)

    def shapes(self, now: Moment) -> list[Shape]:
        """Return shell, cylinder and angle; what has turned is the shell."""
        theta, psi, big, small, origin = now.state[0], now.turned, self.shell_radius, self.radius, (0.0, 0.0)
        up, centre, rim, part = 0.5 * math.pi, self.place(theta), 1.1 * self.shell_radius, math.pi / 12
        first, last = up + psi - part, up + psi + part
        joints = [up + psi + part * i for i in range(3, 22, 2)]
        angle, ratio = up + (big * psi - self.arm * theta) / small, self.inertia / (self.mass * small * small)
        if self.control == "tilt":
            action = arc(origin, 1.19 * big, up, up + now.share * math.pi / 3)
        else:
            back = -math.copysign(0.6 * big * now.share, now.state[1])
            action = [centre, polar(centre, back, theta)]
        return [
            Circle(origin, rim, "ground"),
            *(Line([polar(origin, big, a), polar(origin, rim, a)], "ground") for a in joints),
            Polygon([*arc(origin, rim, first, last), *arc(origin, big, last, first)], "frame"),
            Circle(origin, big, "hole"),
            Line([origin, (0.0, -big)], "guide"),
            Line([origin, centre], "guide"),
            Line(arc(origin, 0.4 * self.arm, -up, math.remainder(theta, 2.0 * math.pi) - up), "guide"),
            *roller(centre, small, angle, ratio),
            Arrow(action),
        ]

    def window(self, now: Moment) -> Window:
        """Return a window on the whole shell."""
        size = 1.28 * self.shell_radius
        return Window(-size, -size, size, size)
