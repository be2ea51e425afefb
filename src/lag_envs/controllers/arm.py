"""Controllers of the arm that reaches for a point."""

from __future__ import annotations

import numpy as np

from lag_envs.controllers.basic import Array, FeedbackController
from lag_envs.tasks.arm import Reach


class Springs(FeedbackController):
    """Pull each joint towards its angle in a posture that reaches the point, like a damped spring.

    Parameters
    ----------
    task : Reach
        The task, ``env.unwrapped.task``.
    stiffness : tuple of float
        Stiffness for shoulder and elbow [N m/rad].
    damping : tuple of float
        Damping for shoulder and elbow [N m s/rad].
    """

    def __init__(
        self,
        task: Reach,
        *,
        stiffness: tuple[float, float] = (40.0, 10.0),
        damping: tuple[float, float] = (4.0, 1.0),
    ) -> None:
        super().__init__(task)
        self.stiffness, self.damping = np.array(stiffness), np.array(damping)

    def control(self, state: Array, target: Array) -> Array:
        """Return the torques."""
        return self.stiffness * self.missing(state, target) - self.damping * state[..., 1::2]

    def missing(self, state: Array, target: Array) -> Array:
        """Return the rotations of the joints to the posture that takes less effort to hold."""
        postures = self.postures(target)
        holding = [self.holding(posture) for posture in postures]
        best = np.where((holding[0] <= holding[1])[..., None], *postures)
        off = best - state[..., ::2]
        return off - 2.0 * np.pi * np.rint(off / (2.0 * np.pi))

    def postures(self, target: Array) -> list[Array]:
        """Return the angles of both postures that reach a point (..., 2), or come closest to it."""
        upper, fore = self.task.scene.length_1, self.task.scene.length_2
        x, y = target[..., 0], target[..., 1]
        cosine = (x * x + y * y - upper**2 - fore**2) / (2.0 * upper * fore)
        bend = np.arccos(np.clip(cosine, -1.0, 1.0))
        return [
            np.stack([np.arctan2(y, x) - np.arctan2(fore * np.sin(b), upper + fore * np.cos(b)), b], axis=-1)
            for b in (bend, -bend)
        ]

    def holding(self, posture: Array) -> Array:
        """Return the larger of the torques that hold a posture, each relative to its limit."""
        still = np.zeros((*posture.shape[:-1], 4))
        still[..., ::2] = posture
        return np.abs(self.torques(still, np.zeros(posture.shape)) / self.task.limit_control).max(axis=-1)

    def torques(self, state: Array, wanted: Array) -> Array:
        """Return the torques for wanted joint accelerations [rad/s²], by the equations of motion."""
        scene = self.task.scene
        free = scene.acceleration(state, np.zeros(wanted.shape))
        more = wanted - np.stack([free[name] for name in scene.coordinates], axis=-1)
        return np.einsum("...ij,...j->...i", scene.mass_matrix(state), more)


class ComputedTorque(Springs):
    """Make each joint an independent damped spring, with gravity and the links' coupling compensated.

    Parameters
    ----------
    task : Reach
        The task, ``env.unwrapped.task``.
    frequency : float
        The springs' frequencies [rad/s].
    damping : float
        Their damping ratio.
    """

    def __init__(self, task: Reach, *, frequency: float = 16.0, damping: float = 1.0) -> None:
        super().__init__(task)
        self.frequency, self.ratio = frequency, damping

    def control(self, state: Array, target: Array) -> Array:
        """Return the torques."""
        wanted = self.frequency**2 * self.missing(state, target)
        return self.torques(state, wanted - 2.0 * self.ratio * self.frequency * state[..., 1::2])
