"""A task that ``lag-envs bench`` compares with Gymnasium's CartPole."""

from __future__ import annotations

import math
from typing import Any, ClassVar

from lag_envs.scenes import Chain
from lag_envs.tasks import Task


class ChainSwing(Task):
    """Bars hanging from a support that is pushed to and fro; they start at any angles, turning fast."""

    scene: Any = Chain
    interval, steps = 0.02, 500
    action: ClassVar = {"s_ddot": 5.0}
    order = 18  # since the bars turn fast; 16 takes a little longer

    @property
    def start(self) -> dict[str, float]:
        """Return a box around hanging at rest."""
        names = self.scene.coordinates
        return dict.fromkeys(names, math.pi) | {f"{name}_dot": 3.0 for name in names}

    def observe(self, after: Any, target: Any, xp: Any) -> dict[str, Any]:
        """Return cosine, sine and rate of each angle, and the support's place and rate."""
        found = {"s": after.s, "s_dot": after.s_dot}
        for name in self.scene.coordinates:
            found |= {f"cos({name})": xp.cos(after[name]), f"sin({name})": xp.sin(after[name])}
            found[f"{name}_dot"] = after[f"{name}_dot"]
        return found

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return the height of the chain's end minus a cost for distance from the middle."""
        height = sum(-xp.cos(after[name]) for name in self.scene.coordinates)
        return height - 0.1 * after.s**2

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the support has left its track."""
        return xp.abs(after.s) > 2.4
