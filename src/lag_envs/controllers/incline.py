"""Controllers of the cylinder that rolls on a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lag_envs.controllers.basic import Array, FeedbackController
from lag_envs.controllers.linear import regulator
from lag_envs.controllers.pd import PD
from lag_envs.envs.model import Model
from lag_envs.stepping.slope import FixedSlope, crossing_time
from lag_envs.tasks.incline import Brake, Tilt

#: Points of the curve along which a cylinder is braked.
POINTS = 20_000


class TiltPD(PD):
    """Hold a cylinder at a mark by the tilt of its plane; see `PD`. Defaults are from `agents.tune`."""

    task: Tilt

    def __init__(self, task: Tilt, *, frequency: float = 2.5, lag: float = 0.07) -> None:
        super().__init__(task, frequency=frequency, lag=lag)

    def find_strength(self) -> float:
        """Return the acceleration for each unit of the tilt's sine."""
        task = self.task
        if not task.quasi_static:
            return self.rest.gravity
        steepest = task.coefficients([0.0] * len(task.scene.state_names), [task.largest_tilt], np)
        return steepest.acceleration / np.sin(task.largest_tilt)

    def control(self, state: Array, target: Array) -> Array:
        """Return the tilt's rate, or the tilt; the wanted acceleration is strength sin(tilt) - drag speed."""
        limit = np.sin(self.task.largest_tilt)
        sine = (self.wanted(state, target) + self.rest.damping_rate * state[..., 1]) / self.strength
        tilt = np.arcsin(np.clip(sine, -limit, limit))
        return tilt if self.task.quasi_static else (tilt - state[..., 2]) / self.lag


class TiltCascade(FeedbackController):
    """Hold a cylinder at a mark: a linear-quadratic regulator, written as a cascade.

    The regulator's u = -K (x - x*, w, φ) is the same as two loops in series: control of the place, φ_wanted =
    -(K_x (x - x*) + K_w w)/K_φ, then control of the tilt, u = K_φ (φ_wanted - φ). In this form, the wanted
    tilt can be limited to the plane's range. Far from the mark, the place loop asks for no more speed than
    can be braked, because there the error enters by its square root.

    Parameters
    ----------
    task : Tilt
        The task, ``env.unwrapped.task``; with either control.
    braking : float
        Share of the largest acceleration that is planned for braking.
    effort : float
        Weight of (u/U)² that is added to the reward's 0.02.
    """

    task: Tilt

    def __init__(self, task: Tilt, *, braking: float = 0.53, effort: float = 0.058) -> None:
        super().__init__(task)
        extra = {"u": effort / task.limit_control**2}
        self.gain, _ = regulator(task, [0.0] * len(task.scene.state_names), extra=extra)
        if task.quasi_static:
            steepest = task.coefficients([0.0, 0.0], [task.largest_tilt], np).acceleration
        else:
            steepest = task.coefficients([0.0] * 3, [0.0], np).gravity * np.sin(task.largest_tilt)
        self.acceleration = braking * steepest

    def control(self, state: Array, target: Array) -> Array:
        """Return the tilt's rate, or the tilt."""
        gain = np.append(self.gain, 1.0) if self.task.quasi_static else self.gain
        off, w = state[..., 0] - target, state[..., 1]
        # The wanted speed is proportional to the error near the mark, and to its square root farther away.
        slope = gain[0] / gain[1]
        near = self.acceleration / slope**2
        size = np.abs(off)
        wanted = slope * np.where(size < near, size, np.sqrt(np.maximum(2.0 * near * size - near**2, 0.0)))
        wanted = -np.sign(off) * wanted
        limit = self.task.largest_tilt
        tilt = np.clip(gain[1] / gain[2] * (wanted - w), -limit, limit)
        return tilt if self.task.quasi_static else gain[2] * (tilt - state[..., 2])


class SwitchingLine(FeedbackController):
    """Let a cylinder roll freely, then brake fully, along the curve that ends at the line at a wanted speed.

    The curve is one run of the scene under full brake; one suffices, as the equation of motion does not
    depend on the place. In the step that reaches the curve, the brake is chosen such that the step ends on
    it.

    Parameters
    ----------
    task : Brake
        The task, ``env.unwrapped.task``.
    speed : float, optional
        Wanted speed at the line [m/s]; the task's by default.
    fastest : float
        Highest speed covered by the curve [m/s].
    """

    def __init__(self, task: Brake, *, speed: float | None = None, fastest: float = 20.0) -> None:
        super().__init__(task)
        self.speed = task.gentle if speed is None else speed
        self.model = Model(task)
        # No brake gets below the terminal speed under full brake.
        acceleration, rate = task.coefficients([0.0, 0.0], [task.limit_control], np)
        settled = acceleration / rate
        self.speed, fastest = max(self.speed, 1.02 * settled), max(fastest, 3.0 * settled)
        # In ten times 1/rate the excess of speed falls to 5e-5 of its initial value.
        run = task.scene.simulate([0.0, fastest], [task.limit_control] * POINTS, 10.0 / rate / POINTS)
        run = run[: np.searchsorted(-run[:, 1], -self.speed)]
        #: Increasing speeds, and the distances needed to brake from them to the wanted speed.
        self.curve = run[::-1, 1], run[-1, 0] - run[::-1, 0]

    def margin(self, x: Array, v: Array) -> Array:
        """Return the distance left after full braking from now on; below 0, the line is crossed too fast."""
        return -x - np.interp(v, *self.curve, left=0.0)

    def control(self, state: Array, target: Array) -> Array:
        """Return the brake's drag coefficient."""
        flat = state.reshape(-1, 2)
        left = []
        for action in (-1.0, 1.0):
            ends = self.model(flat, np.full(len(flat), action))[0]
            left.append(self.margin(*ends.T))
        free, braked = left
        # In between, the brake that ends the step on the curve, in linear approximation.
        between = free / np.minimum(free - braked, -1e-300)
        share = np.where(free >= 0.0, 0.0, np.where(braked <= 0.0, 1.0, between))
        return (self.task.limit_control * share).reshape(state.shape[:-1])


def optimal_return(task: Brake, x: ArrayLike, v: ArrayLike) -> Array:
    """Return the largest return of the braking task; no policy exceeds it, however often it acts.

    Of all motions that cross the line at a given speed, rolling freely and then braking fully is the fastest
    at every place: before the switch nothing is faster, and after it nothing faster can still slow down to
    that speed. So only the place of the switch has to be found. A later switch leaves more speed at the line,
    where each further m/s saves less time at the same cost, so there is one best place. A policy that holds
    its brake for a step at a time comes close, by braking partly in the step of the switch.

    Parameters
    ----------
    task : Brake
        The task; its slope must not be level.
    x : array_like [m]
        Places, before the line at 0.
    v : array_like [m/s]
        Speeds, not uphill.

    Returns
    -------
    ndarray
        The returns; minus the episode's seconds if it is better not to reach the line in time.

    Raises
    ------
    ValueError
        If nothing pulls the cylinder to the line.

    Examples
    --------
    >>> from lag_envs.tasks.incline import Brake
    >>> round(float(optimal_return(Brake(), x=-2.0, v=0.5)), 4)
    -1.7373
    """
    free, full = (task.coefficients([0.0, 0.0], [c], np) for c in (0.0, task.limit_control))
    if not free.acceleration > 0.0:
        raise ValueError(
            f"nothing is pulled to the line by tilt={task.scene.tilt:g} rad and "
            f"gravity={task.scene.gravity:g} m/s²; give both above 0"
        )
    x, v = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(v, np.float64))

    def crossing(place: Array, speed: Array, force: FixedSlope) -> tuple[Array, Array]:
        """Return time and speed at 0, by integrating x'' = acceleration - damping_rate x'."""
        time = crossing_time(place, speed, force, np.inf, np)
        return time, speed + force.acceleration * time + force.damping_rate * place

    early, late = x, np.zeros_like(x)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # in branches that are not taken
        for _ in range(50):  # until both differ only by rounding
            switch = 0.5 * (early + late)
            _, fast = crossing(x - switch, v, free)
            time, slow = crossing(switch, fast, full)
            # Seconds saved per additional m/s at the line, if braking starts later.
            saved = (slow / fast * np.exp(full.damping_rate * time) - 1.0) / full.acceleration
            later = (slow <= task.gentle) | (saved > task.price)
            early, late = np.where(later, switch, early), np.where(later, late, switch)
        first, fast = crossing(x - late, v, free)
        second, slow = crossing(late, fast, full)
        longest, _ = crossing(x, v, full)
    crossed = -(first + second + task.price * np.maximum(slow - task.gentle, 0.0))
    return np.where(longest > task.duration, np.maximum(crossed, -task.duration), crossed)
