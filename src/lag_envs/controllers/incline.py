"""Controllers of the cylinder that rolls on a plane."""

from __future__ import annotations

import numpy as np

from lag_envs.controllers.basic import Array, Law
from lag_envs.controllers.linear import regulator
from lag_envs.envs.model import Model
from lag_envs.tasks.incline import Brake, Tilt

#: Points of the curve along which a cylinder is braked.
POINTS = 20_000


class TiltCascade(Law):
    """Hold a cylinder at a mark: a linear-quadratic regulator, written as a cascade.

    The regulator's u = -K (x - x*, w, φ) is the same as a control of the tilt, u = K_φ (φ_wanted - φ), behind
    one of the place, φ_wanted = -(K_x (x - x*) + K_w w)/K_φ. Written so, the wanted tilt can be kept
    within what the plane can do. Far from the mark the place's part asks for no more speed than can be
    braked: its error counts by its square root there.

    Parameters
    ----------
    task : Tilt
        The task, ``env.unwrapped.task``; with either control.
    braking : float
        Share of the largest acceleration that braking is planned with.
    effort : float
        Weight of (u/U)² that is added to the reward's 0.02.
    """

    task: Tilt

    def __init__(self, task: Tilt, *, braking: float = 0.53, effort: float = 0.058) -> None:
        super().__init__(task)
        extra = {"u": effort / task.limit_control**2}
        self.gain, _ = regulator(task, [0.0] * len(task.scene.state_names), extra=extra)
        k = task.scene.constants()
        pull = k["pull"] if task.quasi_static else k["rolling"] * k["field"]
        self.acceleration = braking * pull * np.sin(task.largest_tilt)

    def control(self, state: Array, target: Array) -> Array:
        """Return the tilt's rate, or the tilt."""
        gain = np.append(self.gain, 1.0) if self.task.quasi_static else self.gain
        off, w = state[..., 0] - target, state[..., 1]
        # The speed wanted is proportional near the mark; where it could not be braked, a square root.
        slope = gain[0] / gain[1]
        near = self.acceleration / slope**2
        size = np.abs(off)
        wanted = slope * np.where(size < near, size, np.sqrt(np.maximum(2.0 * near * size - near**2, 0.0)))
        wanted = -np.sign(off) * wanted
        limit = self.task.largest_tilt
        tilt = np.clip(gain[1] / gain[2] * (wanted - w), -limit, limit)
        return tilt if self.task.quasi_static else gain[2] * (tilt - state[..., 2])


class SwitchingLine(Law):
    """Let a cylinder roll freely, then brake fully, along the curve that ends at the line at a wanted speed.

    The curve is one run of the scene under full brake: its equation does not depend on the place. In the
    step in which the curve is met, the brake is such that the step ends on it.

    Parameters
    ----------
    task : Brake
        The task, ``env.unwrapped.task``.
    speed : float, optional
        Speed wanted at the line [m/s]; the task's by default.
    fastest : float
        Highest speed that the curve is made for [m/s].
    """

    def __init__(self, task: Brake, *, speed: float | None = None, fastest: float = 20.0) -> None:
        super().__init__(task)
        self.speed = task.gentle if speed is None else speed
        self.model = Model(task)
        k = task.constants()
        # No brake gets below the speed at which a full one settles.
        rate = k["drag"] + k["brake"] * task.limit_control
        settled = k["pull"] / rate
        self.speed, fastest = max(self.speed, 1.02 * settled), max(fastest, 3.0 * settled)
        # In ten times 1/rate the excess of speed falls to 5e-5 of what it was.
        run = task.scene.simulate([0.0, fastest], [task.limit_control] * POINTS, 10.0 / rate / POINTS)
        run = run[: np.searchsorted(-run[:, 1], -self.speed)]
        #: Rising speeds, and the way that braking down from them takes.
        self.curve = run[::-1, 1], run[-1, 0] - run[::-1, 0]

    def margin(self, x: Array, v: Array) -> Array:
        """Return the way that is left when braked fully from now on; below 0 the line is crossed too fast."""
        return -x - np.interp(v, *self.curve, left=0.0)

    def control(self, state: Array, target: Array) -> Array:
        """Return the brake's drag coefficient."""
        flat = state.reshape(-1, 2)
        left = []
        for action in (-1.0, 1.0):
            ends = self.model(flat, np.full(len(flat), action))[0]
            left.append(self.margin(*ends.T))
        free, braked = left
        # Between the two, the brake that ends the step on the curve, as if all were linear.
        between = free / np.minimum(free - braked, -1e-300)
        share = np.where(free >= 0.0, 0.0, np.where(braked <= 0.0, 1.0, between))
        return (self.task.limit_control * share).reshape(state.shape[:-1])
