r"""A cylinder that rolls without slipping on an incline.

::

      \   x ->  down the slope is positive, and so is the angular velocity of rolling down
       \ O
        \_____)  phi   tilt; the plane turns about the point x = 0 of its surface

The cylinder's centre is at x along the surface and h = R + lift above it, its rim may slip along::

    T = m ((x' + h phi')² + (lift' - x phi')²)/2 + I ((x' + slip')/R + phi')²/2
    V = m g (h cos(phi) - x sin(phi))

`lift` and `slip` rest at 0; they are there so that the contact's forces follow.

While the rate phi' is held, the state carries w = x' + R phi' in place of x': it stays continuous when the
rate is switched, whereas x' jumps by -R times the switch.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes import shapes
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Arrow, Line, Moment, Point, Polygon, Shape, Window


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
        Coefficient c of the drag -cx' at the axis. It adds to a drag that is the control.
    tilt : float [rad], optional
        Fixed tilt, at most π/2 to either side, where the plane is vertical; 0.26 by default. Only for the
        control "damping".
    gravity : float [m/s²]
        Field g, downward.
    control : {"damping", "tilt", "tilt_rate"}
        What the control is: a drag coefficient [N s/m] on the fixed tilt; the tilt φ [rad], quasi-static
        (each step is one of a fixed plane); or the rate φ' [rad/s] of a moving plane, held over the step.

    Notes
    -----
    State (x, x_dot); for the control "tilt_rate" (x, w, phi) with w = x' + Rφ'. The zero of the potential
    energy lies at the height of the point x = 0 of the surface. Friction is positive where it speeds up the
    turning down the slope and slows the way down.

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
        """The cylinder's, then the tilt."""
        return ("x", "w", "phi") if self.control == "tilt_rate" else ()

    @property
    def reactions(self) -> dict[str, str]:
        """The contact's forces, and the torque on a plane that turns."""
        contact = {"normal": "lift", "friction": "slip"}
        return contact | {"drive_torque": "phi"} if self.control == "tilt_rate" else contact

    def rests(self) -> dict[str, Any]:
        """Return the fixed tilt."""
        return {"phi": self.tilt} if self.control == "damping" else {}

    def check(self) -> None:
        """Check that the tilt is not given where it is controlled."""
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
        """Return half of the drag's loss [W]."""
        return 0.5 * (self.damping + u.drag) * v.x * v.x

    def poses(self, q: Any, xp: Any) -> Any:
        """Return place and angle of the cylinder; rolling ties its own angle to its place."""
        c, s = xp.cos(q.phi), xp.sin(q.phi)
        return {
            "cylinder": (q.x * c + self.radius * s, self.radius * c - q.x * s, -q.x / self.radius - q.phi)
        }

    def bodies(self) -> dict[str, list[Shape]]:
        """Return the cylinder."""
        ratio = self.inertia / (self.mass * self.radius * self.radius)
        return {"cylinder": shapes.roller((0.0, 0.0), self.radius, 0.5 * math.pi, ratio)}

    def tilted(self, now: Moment) -> float:
        """Return the tilt [rad]."""
        if self.tilt is not None:
            return self.tilt
        return now.control if self.control == "tilt" else now.state[-1]

    def place(self, x: float, height: float, phi: float) -> Point:
        """Return the point at x along the surface and at a height above it [m]."""
        c, s = math.cos(phi), math.sin(phi)
        return x * c + height * s, height * c - x * s

    def shapes(self, now: Moment, ends: tuple[float, float] | None = None) -> list[Shape]:
        """Return plane, cylinder and tilt; the surface reaches from end to end [m]."""
        x, radius, phi = now.state[0], self.radius, self.tilted(now)
        ends = (x - 20.0 * radius, x + 20.0 * radius) if ends is None else ends
        cylinder = super().shapes(now)
        if self.control == "damping":
            return [*self._slope(*ends, phi), *cylinder, self._drag(now, phi)]
        far = max(-ends[0], ends[1])
        start, sweep = (-phi, -0.3 * now.share) if self.control == "tilt_rate" else (0.0, -phi)
        turn = Arrow(shapes.arc((0.0, 0.0), 1.15 * far, start, start + sweep))
        return [*self._plank(*ends, phi), *cylinder, turn]

    def _slope(self, low: float, high: float, phi: float) -> list[Shape]:
        radius = self.radius
        left, right = self.place(low, 0.0, phi), self.place(high, 0.0, phi)
        depth = min(left[1], right[1]) - (high - low)
        behind = [(right[0], depth), (left[0], depth)]
        if abs(phi) > 0.25 * math.pi:  # rather a wall than a hill
            behind = [self.place(x, low - high, phi) for x in (high, low)]
        marks = shapes.ticks(low, high, shapes.round_length((high - low) / 15.0))
        return [
            Polygon([left, right, *behind], "ground"),
            *(Line([self.place(x, 0.0, phi), self.place(x, -0.6 * radius, phi)], "ground") for x in marks),
            Line([(0.0, 0.0), (-24.0 * radius, 0.0)], "guide"),
            Line(shapes.arc((0.0, 0.0), 20.0 * radius, math.pi - phi, math.pi), "guide"),
        ]

    def _drag(self, now: Moment, phi: float) -> Arrow:
        x, v = now.state
        tip = x - math.copysign(8.0 * self.radius * now.share, v)
        return Arrow([self.place(x, self.radius, phi), self.place(tip, self.radius, phi)])

    def _plank(self, low: float, high: float, phi: float) -> list[Shape]:
        far, thick = max(-low, high), 0.02 * (high - low)
        floor, side = -9.0 * thick, 2.0 * far
        corners = [(low, 0.0), (high, 0.0), (high, -thick), (low, -thick)]
        return [
            Polygon([(-4.0 * thick, floor), (0.0, -0.5 * thick), (4.0 * thick, floor)], "ground"),
            Polygon([(-side, floor), (side, floor), (side, -side), (-side, -side)], "ground"),
            Line([(-1.3 * far, 0.0), (1.3 * far, 0.0)], "guide"),
            Polygon([self.place(a, b, phi) for a, b in corners], "frame"),
        ]

    def window(self, now: Moment) -> Window:
        """Return a window that follows the cylinder."""
        x, y = self.place(now.state[0], self.radius, self.tilted(now))
        size = 12.0 * self.radius
        return Window(x - size, y - size, x + size, y + size)
