r"""A cylinder that rolls without slipping on an incline.

::

      \   x ->  down the slope is positive, and so is the angular velocity of rolling down
       \ O
        \_____)  phi   tilt; the plane turns about the point x = 0 of its surface

With K = I/(m R²) and k = 1/(1 + K), centre at x along and R above the surface::

    T = m ((x' + R phi')² + x² phi'²)/2 + I (x'/R + phi')²/2,   V = m g (R cos(phi) - x sin(phi))

Fixed tilt:    x'' = k g sin(phi) - (c k/m) x'
Turning tilt:  (1 + K)(x'' + R phi'') = g sin(phi) + x phi'² - (c/m) x'

While the rate phi' is held, w = x' + R phi' obeys an equation without phi'', and stays continuous when the
rate is switched, whereas x' jumps by -R times the switch. So w is the state.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lag_envs.scenes import shapes
from lag_envs.scenes.base import Motion, Scene, friction_ratio, parameter, shown
from lag_envs.scenes.shapes import Arrow, Line, Moment, Point, Polygon, Shape, Window
from lag_envs.stepping import slope
from lag_envs.stepping.flows import SLIDE, TURN, Flow

CONTROLS = {"damping": "c [N s/m]", "tilt": "phi [rad]", "tilt_rate": "phi' [rad/s]"}


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
    energy lies at the height of the point x = 0 of the surface.

    Examples
    --------
    >>> Incline(tilt=0.1, damping=0.0).simulate([0.0, 0.0], [0.0], dt=1.0)[1].round(3).tolist()
    [0.326, 0.653]
    """

    mass: float = parameter(1.0, "kg", above=0.0, usable=(1e-6, 1e6))
    radius: float = parameter(0.05, "m", above=0.0, usable=(1e-9, 1e9))
    inertia: float = parameter(None, "kg m²", least=0.0, usable=(0.0, 1e27))
    damping: float = parameter(0.0, "N s/m", least=0.0, usable=(0.0, 1e9))
    tilt: float = parameter(None, "rad", least=-math.pi / 2, most=math.pi / 2)
    gravity: float = parameter(9.81, "m/s²", least=0.0, usable=(0.0, 1e6))
    control: str = "damping"

    def check(self) -> None:
        """Fill in the solid cylinder's inertia and the tilt, and check the control."""
        if not isinstance(self.control, str) or self.control not in CONTROLS:
            raise ValueError(f"control must be one of {', '.join(CONTROLS)}, got {shown(self.control)}")
        if self.control != "damping" and self.tilt is not None:
            raise ValueError(
                f"tilt={self.tilt:g} rad would be ignored: "
                f"with control={self.control!r} the tilt is controlled"
            )
        if self.control == "damping" and self.tilt is None:
            object.__setattr__(self, "tilt", 0.26)
        if self.inertia is None:
            object.__setattr__(self, "inertia", 0.5 * self.mass * self.radius * self.radius)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries."""
        return ("x", "w", "phi") if self.control == "tilt_rate" else ("x", "x_dot")

    @property
    def state_units(self) -> tuple[str, ...]:
        """Their units."""
        return ("m", "m/s", "rad") if self.control == "tilt_rate" else ("m", "m/s")

    @property
    def control_unit(self) -> str:
        """The control and its unit."""
        return CONTROLS[self.control]

    @property
    def coordinates(self) -> tuple[str, ...]:
        """The cylinder's place is free, the tilt is moved."""
        return ("x", "phi")

    @property
    def flow(self) -> Flow:
        """The closed form of the fixed slope, or the linear flow of the turning one."""
        return TURN if self.control == "tilt_rate" else SLIDE

    @property
    def angle(self) -> int | None:
        """Index of phi, where it is a state."""
        return 2 if self.control == "tilt_rate" else None

    def constants(self) -> dict[str, Any]:
        """Return the numbers that the chosen control needs."""
        rolling = 1.0 / (1.0 + self.inertia / (self.mass * self.radius * self.radius))
        drag = self.damping * rolling / self.mass
        if self.control == "tilt":
            return {"pull": rolling * self.gravity, "drag": drag}
        if self.control == "tilt_rate":
            return {"rolling": rolling, "field": self.gravity, "radius": self.radius, "drag": drag}
        sine = _sine(self.tilt)
        return {"pull": rolling * self.gravity * sine, "drag": drag, "brake": rolling / self.mass}

    def drive(self, y: Sequence, u: Any, k: Any, xp: Any) -> slope.Pull | slope.Turn:
        """Return the flow's coefficients."""
        if self.control == "tilt_rate":
            return slope.Turn(k.rolling, k.field, k.drag, u)
        if self.control == "tilt":
            return slope.Pull(k.pull * xp.sin(u), k.drag)
        return slope.Pull(k.pull, k.drag + k.brake * u)

    def unpack(self, y: Sequence, u: Any, k: Any) -> Sequence:
        """Return (x, x'), with cosφ and sinφ where the plane turns."""
        if self.control != "tilt_rate":
            return y
        x, w, _, c, s = y
        return x, w - k.radius * u, c, s

    def pack(self, moved: Sequence, y: Sequence, u: Any, dt: Any, k: Any) -> Sequence:
        """Return the state, with w and φ where the plane turns."""
        if self.control != "tilt_rate":
            return moved
        x, v, c, s = moved
        return x, v + k.radius * u, y[2] + dt * u, c, s

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        along, across, spin = v.x + self.radius * v.phi, q.x * v.phi, v.x / self.radius + v.phi
        return 0.5 * self.mass * (along * along + across * across) + 0.5 * self.inertia * spin * spin

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return self.mass * self.gravity * (self.radius * xp.cos(q.phi) - q.x * xp.sin(q.phi))

    def dissipation(self, v: Any, u: Any) -> Any:
        """Return half of the drag's loss [W]."""
        c = self.damping + u if self.control == "damping" else self.damping
        return 0.5 * c * v.x * v.x

    def motion(self, state: ArrayLike, control: ArrayLike) -> Motion:
        """Return x, phi and their derivatives."""
        u = np.asarray(control, dtype=np.float64)
        y = self.lift(state)
        k = SimpleNamespace(**self.constants())
        coefficients = self.drive(y, u, k, np)
        x, v = self.unpack(y, u, k)[:2]
        phi, rate = {
            "damping": (self.tilt, 0.0),
            "tilt": (u, 0.0),
            "tilt_rate": (y[-1] if self.angle is None else y[2], u),
        }[self.control]
        if isinstance(coefficients, slope.Turn):
            acceleration = slope.rolling(x, v, y[4], coefficients)
        else:
            acceleration = slope.sliding(v, coefficients)
        return Motion(
            SimpleNamespace(x=x, phi=phi),
            SimpleNamespace(x=v, phi=rate),
            SimpleNamespace(x=acceleration, phi=0.0),
        )

    def reactions(self, m: Motion, u: Any) -> dict[str, Any]:
        """Return normal force, friction, needed μ.

        Friction is positive where it speeds up the turning down the slope and slows the way down.
        """
        rolling = m.a.x + self.radius * m.a.phi
        turn = m.v.phi * m.v.phi
        normal = self.mass * (
            self.gravity * np.cos(m.q.phi) - 2.0 * m.v.x * m.v.phi - self.radius * turn - m.q.x * m.a.phi
        )
        friction = self.inertia * rolling / (self.radius * self.radius)
        needed = friction_ratio(friction, normal, self.mass * self.gravity)
        forces = {"normal": normal, "friction": friction, "needed_friction": needed}
        if self.control == "tilt_rate":
            forces["drive_torque"] = (
                (self.mass * self.radius + self.inertia / self.radius) * rolling
                + self.mass * m.q.x * m.q.x * m.a.phi
                + 2.0 * self.mass * m.q.x * m.v.x * m.v.phi
                - self.mass * self.gravity * (m.q.x * np.cos(m.q.phi) + self.radius * np.sin(m.q.phi))
            )
        return forces

    def drive_power(self, m: Motion, u: Any) -> Any:
        """Return the power of the torque that turns the plane [W]."""
        if self.control != "tilt_rate":
            return 0.0 * m.v.x
        return self.reactions(m, u)["drive_torque"] * m.v.phi

    def tilted(self, now: Moment) -> float:
        """Return the tilt [rad]."""
        return {"damping": self.tilt, "tilt": now.control, "tilt_rate": now.state[-1]}[self.control]

    def place(self, x: float, height: float, phi: float) -> Point:
        """Return the point at x along the surface and at a height above it [m]."""
        c, s = math.cos(phi), math.sin(phi)
        return x * c + height * s, height * c - x * s

    def shapes(self, now: Moment, ends: tuple[float, float] | None = None) -> list[Shape]:
        """Return plane, cylinder and tilt; the surface reaches from end to end [m]."""
        x, radius, phi = now.state[0], self.radius, self.tilted(now)
        ends = (x - 20.0 * radius, x + 20.0 * radius) if ends is None else ends
        # Rolling ties the cylinder's own angle to its place: it turns at x'/R + phi', clockwise.
        angle, ratio = 0.5 * math.pi - x / radius - phi, self.inertia / (self.mass * radius * radius)
        cylinder = shapes.roller(self.place(x, radius, phi), radius, angle, ratio)
        if self.control == "damping":
            return [*self._slope(*ends), *cylinder, self._drag(now)]
        far = max(-ends[0], ends[1])
        start, sweep = (-phi, -0.3 * now.share) if self.control == "tilt_rate" else (0.0, -phi)
        turn = Arrow(shapes.arc((0.0, 0.0), 1.15 * far, start, start + sweep))
        return [*self._plank(*ends, phi), *cylinder, turn]

    def _slope(self, low: float, high: float) -> list[Shape]:
        phi, radius = self.tilt, self.radius
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

    def _drag(self, now: Moment) -> Arrow:
        x, v = now.state
        tip = x - math.copysign(8.0 * self.radius * now.share, v)
        return Arrow([self.place(x, self.radius, self.tilt), self.place(tip, self.radius, self.tilt)])

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


def _sine(angle: Any) -> Any:
    """Return the sine of a float, or of a number of SymPy or mpmath by their own function."""
    if isinstance(angle, float):
        return math.sin(angle)
    return import_module(type(angle).__module__.partition(".")[0]).sin(angle)
