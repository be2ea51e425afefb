r"""A cylinder that rolls without slipping on an incline.

::

      \   x ->  down the slope is positive, and so is the angular velocity of rolling down
       \ O
        \_____)  phi   tilt; the plane turns about the point x = 0 of its surface

The cylinder's centre is at x along the surface and h = R + lift above it; its rim may slip along it::

    T = m ((x' + h phi')² + (lift' - x phi')²)/2 + I ((x' + slip')/R + phi')²/2
    V = m g (h cos(phi) - x sin(phi))

`lift` and `slip` rest at 0; they exist so that the contact's forces can be derived.

While the rate phi' is held, the state holds w = x' + R phi' in place of x': w stays continuous when the rate
is switched, whereas x' jumps by -R times the switch.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes import shapes
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Arrow, Bodies, Line, Polygon, Ruler, Window


@dataclasses.dataclass(frozen=True, kw_only=True)
class Incline(Scene):
    """A cylinder rolling on an incline; the control is the drag, the tilt or the tilt's rate.

    Parameters
    ----------
    mass : float [kg]
        Mass m.
    radius : float [m]
        Rolling radius R.
    inertia : float [kg m²], optional
        Moment of inertia I about the axis; by default that of a solid cylinder, mR²/2.
    damping : float [N s/m]
        Coefficient c of the drag -cx' at the axis. It is added to the drag that the control sets.
    tilt : float [rad], optional
        Fixed tilt φ, at most π/2 to either side, at which the plane is vertical; 0.26 by default. It is only
        for the control "damping".
    gravity : float [m/s²]
        Field g, downward.
    control : {"damping", "tilt", "tilt_rate"}
        The control: a drag coefficient [N s/m] on the fixed tilt; the tilt φ [rad], quasi-static (in each
        step the plane is fixed); or the rate φ' [rad/s] of a moving plane, held over the step.

    Notes
    -----
    State (x, x_dot); for the control "tilt_rate" (x, w, phi) with w = x' + Rφ'. The zero of the potential
    energy lies at the height of the point x = 0 of the surface. Friction is positive if it slows the motion
    down the slope and speeds up the rotation of a cylinder that rolls down.

    Examples
    --------
    >>> Incline(tilt=0.1, damping=0.0).acceleration([0.0, 0.0])["x"].round(3).item()
    0.653
    """

    mass: float = parameter(1.0, "kg", above=0.0, usable=(1e-6, 1e6))
    radius: float = parameter(0.05, "m", above=0.0, usable=(1e-9, 1e9))
    inertia: float = parameter(
        lambda incline: 0.5 * incline.mass * incline.radius * incline.radius,
        "kg m²",
        least=0.0,
        usable=(0.0, 1e27),
    )
    damping: float = parameter(0.0, "N s/m", least=0.0, usable=(0.0, 1e9))
    tilt: float | None = parameter(
        lambda incline: 0.26 if incline.control == "damping" else None,
        "rad",
        least=-math.pi / 2,
        most=math.pi / 2,
    )
    gravity: float = parameter(9.81, "m/s²", least=0.0, usable=(0.0, 1e6))
    control: str = "damping"

    coordinates = {"x": "m"}
    prescribed = {"phi": "rad", "lift": "m", "slip": "m"}
    modes = {"damping": {"drag": "N s/m"}, "tilt": {"phi": "rad"}, "tilt_rate": {"phi_dot": "rad/s"}}
    ratios = {"needed_friction": ("friction", "normal")}

    @property
    def state(self) -> tuple[str, ...]:
        """The cylinder's entries, then the tilt."""
        return ("x", "w", "phi") if self.control == "tilt_rate" else ()

    @property
    def reactions(self) -> dict[str, str]:
        """The contact's forces, and the torque on a turning plane."""
        contact = {"normal": "lift", "friction": "slip"}
        return contact | {"drive_torque": "phi"} if self.control == "tilt_rate" else contact

    def rests(self) -> dict[str, Any]:
        """Return the fixed tilt."""
        return {"phi": self.tilt} if self.control == "damping" else {}

    def check(self) -> None:
        """Check that no tilt is given if the tilt is controlled."""
        if self.control != "damping" and self.tilt is not None:
            raise ValueError(
                f"tilt={self.tilt:g} rad would be ignored: "
                f"with control={self.control!r} the tilt is controlled"
            )

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        along, across = v.x + (self.radius + q.lift) * v.phi, v.lift - q.x * v.phi
        spin = (v.x + v.slip) / self.radius + v.phi
        return 0.5 * self.mass * (along * along + across * across) + 0.5 * self.inertia * spin * spin

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return self.mass * self.gravity * ((self.radius + q.lift) * xp.cos(q.phi) - q.x * xp.sin(q.phi))

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost to drag [W]."""
        return 0.5 * (self.damping + u.drag) * v.x * v.x

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the cylinder's pose; rolling determines its angle from its place."""
        turned = -(q.x + q.slip) / self.radius - q.phi
        return {"cylinder": (*self.place(q.x, self.radius + q.lift, q.phi, xp), turned)}

    def bodies(self, low: float | None = None, high: float | None = None) -> Bodies:
        """Return the ground from low to high [m], cylinder and tilt, and an arrow for the drag."""
        radius = self.radius
        low, high = (-20.0 * radius, 20.0 * radius) if low is None or high is None else (low, high)
        deep, angle = low - high, self.tilt or 0.0
        level = [
            Line([(0.0, 0.0), (-24.0 * radius, 0.0)], "guide"),
            Line(shapes.arc((0.0, 0.0), 20.0 * radius, math.pi - angle, math.pi), "guide"),
        ]
        return {
            "hill": [Polygon([(low, 0.0), (high, 0.0), (high, deep), (low, deep)], "ground")],
            "plane": [Ruler(shapes.round_length((high - low) / 15.0), 0.6 * radius)],
            "ground": [] if self.tilt is None else level,
            "cylinder": shapes.roller(radius, self.inertia / (self.mass * radius * radius)),
            "drag": [Arrow([(0.0, 0.0), (0.0, 8.0 * radius)])] if self.control == "damping" else [],
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the poses of plane, ground and arrow."""
        x, phi = now.q.x, now.q.phi
        back = xp.where(now.state[1] < 0.0, now.share[0], -now.share[0])
        return {
            "plane": (0.0, 0.0, -phi),
            "hill": (*self.place(x, 0.0, phi, xp), -phi),
            "drag": (*self.place(x, self.radius, phi, xp), -phi - 0.5 * math.pi, back),
        }

    def place(self, x: Any, height: Any, phi: Any, xp: Any = math) -> tuple[Any, Any]:
        """Return the point at x along the surface and at a height above it [m]."""
        c, s = xp.cos(phi), xp.sin(phi)
        return x * c + height * s, height * c - x * s

    def window(self) -> Window:
        """Return a window that follows the cylinder."""
        size = 12.0 * self.radius
        return Window(-size, -size, size, size, "cylinder")
