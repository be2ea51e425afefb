"""Swing a bar up by moving its support, and keep it up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes import PivotedBar
from lag_envs.scenes.shapes import Line, Moment, Polygon, Shape, Window, polar
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import FASTEST_START, Task, finite, kick_chance


def _speed_bound(task: Task, limit: float) -> float:
    """Return a bound on |theta'| over an episode: start + (|field| + |drive|) times its length; damping only helps."""
    k = task.scene.constants()
    return FASTEST_START + (k["weight"] + k["pull"] * limit) * task.duration


class SwingUp(Task):
    """Swing a bar up by moving its support, and hold it upright."""

    scene_type = PivotedBar
    defaults = {"mass": 0.2, "com_distance": 0.3, "damping": 0.001}
    limit_control = 5.0

    @property
    def has_track(self) -> bool:
        """Whether the support's place is part of the task."""
        return self.scene.track is not None

    @property
    def variant(self) -> tuple:
        """Add whether there is an end of the track to guard."""
        return *super().variant, self.scene.track == math.inf

    @property
    def observation(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the observation's entries."""
        return (*(("s/S", "s_dot/2") if self.has_track else ()), "cos(theta)", "sin(theta)", "theta_dot/8")

    @property
    def start(self) -> Sequence[float]:
        """Hanging, nearly at rest, near the middle of the track."""
        return [*([0.1 * self.numbers()["track"], 0.02] if self.has_track else []), 0.1, 0.1]

    def numbers(self) -> dict[str, float]:
        """Return the limit U of the control and the track's half length S."""
        track = {"track": self.scene.track if math.isfinite(self.scene.track) else 0.5} if self.has_track else {}
        return {"limit_control": self.limit_control, **track}

    def control(self, a: Any, y: Sequence, k: Any, dt: Any, xp: Any) -> Any:
        """Return the acceleration nearest to U·a from which the support can still stop inside the track."""
        wanted = k.limit_control * a
        if not self.has_track or math.isinf(self.scene.track):
            return wanted
        s, s_dot = y[:2]
        v = s_dot + dt * wanted
        right, left = _too_far(s, s_dot, v, k, dt), _too_far(-s, -s_dot, -v, k, dt)
        # Both ends at once would leave nothing to choose from, which inside the safe set does not happen.
        side = xp.where(right, 1.0, xp.where(left, -1.0, 0.0))
        nearest = side * xp.minimum(side * wanted, _hardest(side * s, side * s_dot, k, dt, xp))
        return xp.where(right | left, nearest, wanted)

    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return h² - 0.02 (u/U)² with the height h = (1 - cosθ)/2."""
        height = 0.5 - 0.5 * z[-2]
        effort = u * (1.0 / k.limit_control)
        return k.scale * (height * height - 0.02 * (effort * effort))

    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return (s/S, s'/2,) cosθ, sinθ, θ'/8."""
        support = [z[0] * (1.0 / k.track), 0.5 * z[1]] if self.has_track else []
        return [*support, z[-2], z[-1], 0.125 * z[-3]]

    def bounds(self) -> Sequence[float]:
        """Return bounds on the observation."""
        u, support = self.limit_control, []
        if self.has_track:
            fastest = FASTEST_START + u * self.duration
            track = self.scene.track
            if math.isfinite(track):
                support = [1.0 + 1e-6, 0.5 * (math.sqrt(2.0 * u * track) * (1.0 + 1e-6))]
            else:
                support = [finite((1e3 + fastest * self.duration) / 0.5), finite(0.5 * fastest)]
        return [*support, 1.0, 1.0, finite(0.125 * _speed_bound(self, u))]

    def shapes(self, now: Moment) -> list[Shape]:
        """Add the upright bar."""
        s = now.state[0] if self.has_track else 0.0
        return [Polygon(self.scene.outline(s, math.pi), "target"), *super().shapes(now)]

    def check_safe(self, state: NDArray[np.float64]) -> None:
        """Refuse a start from which the support cannot stop inside the track."""
        if self.has_track:
            s, s_dot = state[:2]
            if math.isinf(self.scene.track):
                if abs(s) > 1e3:
                    raise ValueError(f"s must lie within ±1000 m at the start, got {s:g} m")
            elif abs(s) + s_dot * s_dot / (2.0 * self.limit_control) > self.scene.track:
                raise ValueError(
                    f"from s={s:g} m with s_dot={s_dot:g} m/s the support cannot stop inside the track: "
                    f"|s| + s_dot²/(2U) must be at most {self.scene.track:g} m with U={self.limit_control:g} m/s²"
                )


def _too_far(s: Any, s_dot: Any, v: Any, k: Any, dt: Any) -> Any:
    """Tell whether braking at -U from speed v at the step's end would pass S.

    The condition v²/(2U) + s + s' dt + u dt²/2 <= S with v = s' + u dt, multiplied by 2U. Below v = -U dt/2 its left
    side, a parabola in v, falls with v: there a move away from S, at most as fast as U allows, meets equality, and
    rounding must not call that too far.
    """
    top = k.limit_control
    return (v > -0.5 * (top * dt)) & (v * v + (top * dt) * v > top * (2.0 * (k.track - s) - s_dot * dt))


def _hardest(s: Any, s_dot: Any, k: Any, dt: Any, xp: Any) -> Any:
    """Return the largest u in [-U, U] that is not too far: the condition's root, solved for v."""
    top = k.limit_control
    half = 0.5 * (top * dt)
    v = xp.sqrt(xp.maximum(half * half + top * (2.0 * (k.track - s) - s_dot * dt), 0.0)) - half
    return clip((v - s_dot) * (1.0 / dt), -top, top, xp)


class Balance(SwingUp):
    """Keep a bar upright against kicks by moving its support."""

    limit_control = 3.0
    draws = 2
    observation = ("s", "s_dot", "e", "theta_dot")  # type: ignore[assignment]
    largest_angle = 0.35

    def check(self) -> None:
        """Ask for a track: the task ends at its ends."""
        if self.scene.track is None or math.isinf(self.scene.track):
            raise ValueError(f"balancing needs a track of finite length, got track={self.scene.track}")

    @property
    def start(self) -> Sequence[float]:
        """Nearly upright."""
        return [0.4 * self.scene.track, 0.2, 0.15, 0.3]

    @property
    def centre(self) -> Sequence[float]:
        """Upright."""
        return [0.0, 0.0, math.pi, 0.0]

    def numbers(self) -> dict[str, float]:
        """Return limits, track and the chance of a kick."""
        return {"limit_control": self.limit_control, "track": self.scene.track, "chance": kick_chance(self, 0.01)}

    def control(self, a: Any, y: Sequence, k: Any, dt: Any, xp: Any) -> Any:
        """Return U·a; running off the track ends the episode, so nothing guards it."""
        return k.limit_control * a

    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return 1 - (e/0.35)²/2 - (s/S)²/2."""
        e = (z[2] - math.pi) * (1.0 / self.largest_angle)
        s = z[0] * (1.0 / k.track)
        return k.scale * (1.0 - 0.5 * (e * e) - 0.5 * (s * s))

    def terminated(self, z: Sequence, k: Any, xp: Any) -> Any:
        """Tell whether the bar has fallen or the support has left the track."""
        return (xp.abs(z[2] - math.pi) > self.largest_angle) | (xp.abs(z[0]) > k.track)

    def kick(self, z: Sequence, draws: Sequence, k: Any, xp: Any) -> Sequence:
        """Change θ' by up to 1 rad/s to either side, now and then."""
        push = xp.where(draws[0] < k.chance, 2.0 * draws[1] - 1.0, 0.0)
        return (*z[:3], z[3] + push, *z[4:])

    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return s, s', e = θ - π, θ'."""
        return [z[0], z[1], z[2] - math.pi, z[3]]

    def bounds(self) -> Sequence[float]:
        """Return bounds on the observation."""
        u = self.limit_control
        kicks = self.limit if math.isfinite(self.limit) else math.inf
        slide = FASTEST_START + u * self.duration
        swing = _speed_bound(self, u) + kicks
        return [
            finite(self.scene.track + slide * self.dt),
            finite(slide),
            finite(self.largest_angle + swing * self.dt),
            finite(swing),
        ]

    def shapes(self, now: Moment) -> list[Shape]:
        """Add how far the bar may lean."""
        pivot, up, reach = (now.state[0], 0.0), 0.5 * math.pi, self.scene.reach
        limits = [up - self.largest_angle, up + self.largest_angle]
        lines = [Line([polar(pivot, r * reach, a) for r in (0.9, 1.05)], "limit") for a in limits]
        return [*super().shapes(now), *lines]

    def window(self, now: Moment) -> Window:
        """Look at the upper half."""
        reach, side = self.scene.reach, self.scene.track + 0.5 * self.scene.reach
        return Window(-side, -0.3 * reach, side, 1.15 * reach)

    def check_safe(self, state: NDArray[np.float64]) -> None:
        """Refuse a start at which the episode would be over."""
        s, _, theta, _ = state
        if abs(theta - math.pi) > self.largest_angle or abs(s) > self.scene.track:
            raise ValueError(
                f"the episode would be over at s={s:g} m, theta={theta:g} rad: |theta - pi| must be at most "
                f"{self.largest_angle} rad and |s| at most {self.scene.track:g} m"
            )
