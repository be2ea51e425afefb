"""A support on a track: the base of tasks whose control is the support's acceleration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import FASTEST_START, Task


class Support(Task):
    """Tasks with one control, the acceleration of a support.

    Attributes
    ----------
    largest : float
        The largest acceleration U of the support [m/s²].
    """

    scene: Any
    largest: float

    @property
    def action(self) -> Mapping[str, float]:
        """The support's acceleration."""
        return {"s_ddot": self.largest}


class GuardedTrack(Support):
    """Tasks whose support must be able to stop inside its track, braking at U.

    The track is ``scene.track``: a half length S, infinity for an endless track, or None if the
    support's place and speed are not part of the task.
    """

    def check(self) -> None:
        """Store whether the support's place is part of the task, and whether its track ends."""
        self.has_track = self.scene.track is not None
        self.ends = self.has_track and math.isfinite(self.scene.track)

    @property
    def variant(self) -> tuple:
        """Add whether the track has an end to guard."""
        return *super().variant, self.ends

    @property
    def length(self) -> Any:
        """The track's half length S; 0.5 m for an endless one."""
        return self.scene.track if self.ends else 0.5

    def start_of_support(self) -> dict[str, float]:
        """Return the half widths of the support's start: near the middle of the track, nearly at rest."""
        return {"s": 0.1 * self.length, "s_dot": 0.02} if self.has_track else {}

    def guard(self, wanted: Any, before: Any, dt: Any, xp: Any) -> Any:
        """Return the acceleration nearest to U·a from which the support can still stop inside the track."""
        if not self.ends:
            return wanted
        # With v the speed at the step's end, and braking from there at U, the support stops at
        # ±v²/(2U) + s + (s' + v) dt/2. Multiplied by 2U, this says that the support passes S or -S if v² +
        # |reach| > 2US.
        s, s_dot, held = before.s, before.s_dot, wanted.s_ddot
        top, per_step = self.largest, self.largest * dt
        ends, start = 2.0 * (top * self.length), (2.0 * top) * s + per_step * s_dot
        v = s_dot + dt * held
        reach = start + per_step * v
        side = xp.where(reach < 0.0, -1.0, 1.0)
        # The root of v² + U dt v + start = 2US, seen from that side, is the highest speed allowed.
        half = 0.5 * per_step
        highest = xp.sqrt(xp.maximum(half * half + ends - side * start, 0.0)) - half
        hardest = clip((highest - side * s_dot) * (1.0 / dt), -top, top, xp)
        return xp.where(v * v + xp.abs(reach) > ends, side * xp.minimum(side * held, hardest), held)

    def observe_support(self, after: Any) -> dict[str, Any]:
        """Return s/S and s'/2, or nothing without a track."""
        return {"s/S": after.s * (1.0 / self.length), "s_dot/2": 0.5 * after.s_dot} if self.has_track else {}

    def bounds_of_support(self) -> dict[str, float]:
        """Return bounds on s/S, s'/2."""
        if not self.has_track:
            return {}
        if self.ends:
            fastest = math.sqrt(2.0 * self.largest * self.length) * (1.0 + 1e-6)
            return {"s/S": 1.0 + 1e-6, "s_dot/2": 0.5 * fastest}
        fastest = FASTEST_START + self.largest * self.duration
        return {"s/S": (1e3 + fastest * self.duration) / self.length, "s_dot/2": 0.5 * fastest}

    def check_start(self, state: Any) -> None:
        """Refuse a start from which the support cannot stop inside the track."""
        if not self.has_track:
            return
        s, s_dot = state.s, state.s_dot
        if not self.ends:
            if abs(s) > 1e3:
                raise ValueError(f"s must lie within ±1000 m at the start, got {s:g} m")
        elif abs(s) + s_dot * s_dot / (2.0 * self.largest) > self.length:
            raise ValueError(
                f"from s={s:g} m with s_dot={s_dot:g} m/s the support cannot stop inside the track: "
                f"|s| + s_dot²/(2U) must be at most {self.length:g} m with U={self.largest:g} m/s²"
            )
