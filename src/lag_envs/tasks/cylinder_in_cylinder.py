"""Hold, pump or calm a cylinder that rolls inside another one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes import CylinderInCylinder
from lag_envs.scenes.shapes import Circle, Line, Moment, Reading, Shape
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import FASTEST_START, Task, finite, kick_chance


class _Shell(Task):
    """What the two tasks that turn the shell have in common."""

    scene_type = CylinderInCylinder
    interval, steps = 0.05, 200
    limit_control: float
    fastest_shell: float
    largest_angle: float

    def check(self) -> None:
        """Refuse the damping control."""
        if self.scene.control != "tilt":
            raise ValueError(f"this task is controlled by 'tilt', got control={self.scene.control!r}")

    @property
    def start(self) -> Sequence[float]:
        """Near the bottom, the shell at rest."""
        return [0.1, 0.2, 0.0]

    def numbers(self) -> dict[str, float]:
        """Return the limits of the shell's acceleration and rate."""
        return {"limit_control": self.limit_control, "fastest_shell": self.fastest_shell}

    def control(self, a: Any, y: Sequence, k: Any, dt: Any, xp: Any) -> Any:
        """Return U·a, cut back so that the shell's rate stays within its limit at the step's end."""
        wanted = k.limit_control * a
        return clip(wanted, (-k.fastest_shell - y[2]) * (1.0 / dt), (k.fastest_shell - y[2]) * (1.0 / dt), xp)

    def terminated(self, z: Sequence, k: Any, xp: Any) -> Any:
        """Tell whether the cylinder has been carried too high."""
        return xp.abs(z[0]) > self.largest_angle

    def bounds(self) -> Sequence[float]:
        """Return bounds on θ, θ' and ψ'; |θ'| grows by at most (weight + push U + drag ψ') a second."""
        k = self.scene.constants()
        pull = k["weight"] + k["push"] * self.limit_control + k["drag"] * self.fastest_shell
        swing = FASTEST_START + pull * self.duration
        return [finite(b) for b in (self.largest_angle + swing * self.dt, swing, self.fastest_shell * (1.0 + 1e-6))]

    def shapes(self, now: Moment) -> list[Shape]:
        """Add how far the cylinder may go."""
        scene, limits = self.scene, (-self.largest_angle, self.largest_angle)
        inner = scene.shell_radius - scene.radius
        lines = [Line([scene.place(a, inner), scene.place(a, scene.shell_radius)], "limit") for a in limits]
        return [*super().shapes(now), *lines]

    def check_safe(self, state: NDArray[np.float64]) -> None:
        """Refuse a start at which the episode would be over, or with the shell too fast."""
        if abs(state[0]) > self.largest_angle:
            raise ValueError(
                f"the episode would be over at theta={state[0]:g} rad: |theta| must be at most {self.largest_angle} rad"
            )
        if abs(state[2]) > self.fastest_shell:
            raise ValueError(f"psi_dot must lie within ±{self.fastest_shell} rad/s, got {state[2]:g} rad/s")


class Tilt(_Shell):
    """Hold a cylinder at an angle inside a shell by turning the shell."""

    defaults = {"mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "damping": 0.24, "control": "tilt"}
    observation = ("theta", "theta_dot", "psi_dot", "target")
    target_range = 0.3
    limit_control, fastest_shell, largest_angle = 15.0, 6.0, 1.05

    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-((θ - θ*)/0.1)²) - 0.02 (u/U)²."""
        off = 10.0 * (z[0] - g)
        effort = u * (1.0 / k.limit_control)
        return k.scale * (xp.exp(-(off * off)) - 0.02 * (effort * effort))

    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return θ, θ', ψ' and the target."""
        return [*z[:3], g]

    def bounds(self) -> Sequence[float]:
        """Return bounds on the observation."""
        return [*super().bounds(), self.largest_angle]

    def shapes(self, now: Moment) -> list[Shape]:
        """Add the target."""
        mark = Circle(self.scene.place(now.target or 0.0), self.scene.radius, "target")
        return [*super().shapes(now), mark]

    def check_target(self, target: Any) -> float:
        """Refuse a target at which the episode would be over."""
        target = super().check_target(target)
        if abs(target) > self.largest_angle:
            raise ValueError(f"target must lie within ±{self.largest_angle} rad, got {target:g} rad")
        return target


class Pump(_Shell):
    """Pump the swing of a cylinder inside a shell to an energy by turning the shell, and keep it there."""

    defaults = {"mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "damping": 0.024, "control": "tilt"}
    observation = ("theta", "theta_dot", "psi_dot")
    limit_control, fastest_shell, largest_angle = 4.0, 3.0, 1.3
    amplitude = 0.9

    def check(self) -> None:
        """Ask for a field: without one no energy belongs to the amplitude."""
        super().check()
        if self.scene.gravity == 0.0:
            raise ValueError("gravity must be above 0 m/s²: the energy to pump to is that of an amplitude of 0.9 rad")

    def numbers(self) -> dict[str, float]:
        """Return the limits and E* of the amplitude 0.9 rad, per inertia [1/s²]."""
        weight = self.scene.constants()["weight"]
        return super().numbers() | {"wanted_energy": weight * (1.0 - math.cos(self.amplitude))}

    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-|E - E*|/(0.3 E*)) - 0.02 (u/U)² with E = θ'²/2 + ω₀² (1 - cosθ)."""
        energy = 0.5 * (z[1] * z[1]) + k.weight * (1.0 - z[-2])
        effort = u * (1.0 / k.limit_control)
        off = xp.abs(energy - k.wanted_energy) * (1.0 / (0.3 * k.wanted_energy))
        return k.scale * (xp.exp(-off) - 0.02 * (effort * effort))

    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return θ, θ', ψ'."""
        return list(z[:3])

    def shapes(self, now: Moment) -> list[Shape]:
        """Add the turning points of a swing of the wanted energy."""
        places = [self.scene.place(a) for a in (-self.amplitude, self.amplitude)]
        marks = [Circle(place, self.scene.radius, "target") for place in places]
        return [*super().shapes(now), *marks]

    def readings(self, now: Moment) -> list[Reading]:
        """Tell the energy per inertia, and the wanted one."""
        theta, theta_dot = now.state[:2]
        energy = 0.5 * theta_dot * theta_dot + self.scene.constants()["weight"] * (1.0 - math.cos(theta))
        wanted = self.numbers()["wanted_energy"]
        return [Reading("E", energy, "1/s²"), Reading("E*", wanted, "1/s²", "target")]


class Damping(Task):
    """Calm a kicked cylinder inside a fixed shell by braking it."""

    scene_type = CylinderInCylinder
    defaults = {"mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "control": "damping"}
    observation = ("theta", "theta_dot")
    draws = 2
    limit_control = 2.4

    def check(self) -> None:
        """Refuse the other control, and a scene without a field."""
        if self.scene.control != "damping":
            raise ValueError(f"this task is controlled by 'damping', got control={self.scene.control!r}")
        if self.scene.gravity == 0.0:
            raise ValueError("gravity must be above 0 m/s²: without it nothing holds the cylinder in the shell")

    @property
    def start(self) -> Sequence[float]:
        """Well up the wall, moving."""
        return [0.8, 1.0]

    def numbers(self) -> dict[str, float]:
        """Return the strongest brake, g/a for the contact, and the chance of a kick."""
        scene = self.scene
        return {
            "limit_control": self.limit_control,
            "hold": scene.gravity / scene.arm,
            "chance": kick_chance(self, 0.01),
        }

    def control(self, a: Any, y: Sequence, k: Any, dt: Any, xp: Any) -> Any:
        """Return the drag coefficient, from 0 (a = -1) to its largest (a = 1)."""
        return k.limit_control * (0.5 + 0.5 * a)

    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-√(θ² + θ'²/ω₀²)/0.1)."""
        return k.scale * xp.exp(-10.0 * xp.sqrt(z[0] * z[0] + (z[1] * z[1]) * (1.0 / k.weight)))

    def terminated(self, z: Sequence, k: Any, xp: Any) -> Any:
        """Tell whether the contact is lost: aθ'² + g cosθ < 0."""
        return z[1] * z[1] + k.hold * z[2] < 0.0

    def kick(self, z: Sequence, draws: Sequence, k: Any, xp: Any) -> Sequence:
        """Change θ' by ±1.5 or ±3 rad/s, now and then."""
        size = xp.where(draws[1] < 0.5, 1.5, 3.0)
        push = xp.where((draws[1] < 0.25) | (draws[1] >= 0.75), -size, size)
        return (z[0], z[1] + xp.where(draws[0] < k.chance, push, 0.0), *z[2:])

    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return θ and θ'."""
        return list(z[:2])

    def bounds(self) -> Sequence[float]:
        """Return bounds: θ' grows by at most ω₀² a second and 3 rad/s a kick."""
        swing = FASTEST_START + self.scene.constants()["weight"] * self.duration + 3.0 * self.limit
        return [finite(1e3 + swing * self.duration), finite(swing)]

    def shapes(self, now: Moment) -> list[Shape]:
        """Add the place of rest."""
        mark = Circle(self.scene.place(0.0), self.scene.radius, "target")
        return [*super().shapes(now), mark]

    def check_safe(self, state: NDArray[np.float64]) -> None:
        """Refuse a start without contact."""
        theta, theta_dot = state
        normal = self.scene.forces(state)["normal"]
        if normal < 0.0:
            raise ValueError(f"there is no contact at theta={theta:g} rad, theta_dot={theta_dot:g} rad/s: N={normal:g} N")
        if abs(theta) > 1e3:
            raise ValueError(f"theta must lie within ±1000 rad at the start, got {theta:g} rad")
