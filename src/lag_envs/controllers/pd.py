"""A proportional-derivative controller with feed-forward from the equation of motion."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from lag_envs.controllers.basic import Array, FeedbackController
from lag_envs.tasks.base import Task


class PD(FeedbackController):
    """Bring a place or an angle to its target like a critically damped spring.

    The wanted acceleration is ω² (q* - q) - 2ω q'. The equation of motion gives the tilt of the plane, or the
    rate of the shell, that produces this acceleration. The control brings tilt or rate to that value.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    frequency : float
        The spring's ω [rad/s].
    lag : float
        Time constant with which the control brings tilt or shell rate to the wanted value [s]; at least a
        step.
    """

    def __init__(self, task: Task, *, frequency: float, lag: float) -> None:
        super().__init__(task)
        self.frequency, self.lag = frequency, max(lag, task.dt)
        self.rest = task.coefficients([0.0] * len(task.scene.state_names), [0.0], np)
        strength = self.find_strength()
        if not strength > 0.0:
            raise ValueError(f"nothing that the control moves accelerates the cylinder: {task.scene}")
        self.strength = float(strength)

    @abstractmethod
    def find_strength(self) -> float:
        """Return the acceleration for each unit of what the control moves."""

    def wanted(self, state: Array, target: Array) -> Array:
        """Return the wanted acceleration."""
        place, speed = state[..., 0], state[..., 1]
        return self.frequency**2 * (target - place) - 2.0 * self.frequency * speed
