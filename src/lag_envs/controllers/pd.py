"""A proportional-derivative controller with feed-forward from the equation of motion."""

from __future__ import annotations

import numpy as np

from lag_envs.controllers.basic import Array, FeedbackController
from lag_envs.tasks.cylinder_in_cylinder import Tilt as ShellTilt
from lag_envs.tasks.incline import Tilt as InclineTilt

#: Frequency [rad/s] and time constant of the moved part [s], as found by `tune`.
TUNED = {InclineTilt: (2.5, 0.07), ShellTilt: (17.0, 0.49)}


class PD(FeedbackController):
    """Bring a place or an angle to its target like a critically damped spring.

    The wanted acceleration is ω² (q* - q) - 2ω q'. The tilt of the plane or the rate of the shell that gives
    it follows from the equation of motion, and the control brings it there.

    Parameters
    ----------
    task : lag_envs.tasks.incline.Tilt or lag_envs.tasks.cylinder_in_cylinder.Tilt
        The task, ``env.unwrapped.task``.
    frequency : float, optional
        The spring's ω [rad/s].
    lag : float, optional
        Time constant with which the control brings tilt or shell rate to the wanted value [s]; at least a
        step.
    """

    task: InclineTilt | ShellTilt

    def __init__(
        self, task: InclineTilt | ShellTilt, *, frequency: float | None = None, lag: float | None = None
    ) -> None:
        super().__init__(task)
        if type(task) not in TUNED:
            raise ValueError(f"PD is for the tasks with a target to hold, got {type(task).__name__}")
        tuned = TUNED[type(task)]
        self.frequency = tuned[0] if frequency is None else frequency
        self.lag = max(tuned[1] if lag is None else lag, task.dt)
        rest = task.coefficients([0.0] * len(task.scene.state_names), [0.0], np)
        if isinstance(task, InclineTilt):
            steepest = task.coefficients([0.0] * len(task.scene.state_names), [task.largest_tilt], np)
            strength = (
                steepest.acceleration / np.sin(task.largest_tilt) if task.quasi_static else rest.gravity
            )
        else:
            strength = rest.gamma
        if not strength > 0.0:
            raise ValueError(f"nothing that the control moves accelerates the cylinder: {task.scene}")
        self.rest, self.strength = rest, float(strength)

    def control(self, state: Array, target: Array) -> Array:
        """Return the control."""
        place, speed = state[..., 0], state[..., 1]
        wanted = self.frequency**2 * (target - place) - 2.0 * self.frequency * speed
        if isinstance(self.task, InclineTilt):  # wanted = strength sin(tilt) - drag speed
            limit = np.sin(self.task.largest_tilt)
            sine = (wanted + self.rest.damping_rate * speed) / self.strength
            moved = np.arcsin(np.clip(sine, -limit, limit))
            if self.task.quasi_static:
                return moved
        else:  # wanted = -alpha sin(place) - gamma (speed - the shell's rate)
            moved = (wanted + self.rest.alpha * np.sin(place)) / self.strength + speed
        return (moved - state[..., 2]) / self.lag
