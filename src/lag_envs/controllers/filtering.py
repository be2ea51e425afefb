"""Estimate the state from noisy observations by an extended Kalman filter, and act on the estimate."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import (
    Agent,
    Array,
    ObservationDecoder,
    beginning,
    check_observation,
    check_single_control,
)
from lag_envs.controllers.mpc import renewed
from lag_envs.controllers.tracking import follow, recorded
from lag_envs.envs.model import Model
from lag_envs.scenes.derivation import form_of
from lag_envs.tasks.base import Task


class Belief(NamedTuple):
    """The belief about each episode: the state before the last action, its uncertainty, and the action."""

    state: Array  # (n, n_state)
    covariance: Array  # (n, n_state, n_state)
    action: Array  # (n,)
    memory: Any  # of the controller


class Filtered(Agent):
    """Act on a state estimate from an extended Kalman filter on the exact model [1]_.

    Between observations the estimate follows the model, and its covariance follows the model's exact
    derivatives. How a guard's effect depends on the state is neglected. The first estimate is the centre of
    the task's start distribution, with its spread as uncertainty.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``, with one control, no targets and noise on every observation; actions
        and observations must not be late, nor controls slowed down.
    controller : controller
        Acts on observations computed from the estimate.
    drift : float
        Standard deviation that is added to the estimate in each step, as a share of the state's spread at the
        start. It stands for everything that disturbs the motion, such as kicks, pushes and action noise.
        Without drift, the filter would be overconfident and ignore observations.

    Raises
    ------
    ValueError
        For other tasks, and if the motion is disturbed although `drift` is 0.

    References
    ----------
    .. [1] R. F. Stengel, "Optimal control and estimation", Dover 1994, section 4.7.
    """

    of_one_interval = True  # as the belief holds for steps of one length

    def __init__(self, task: Task, controller: Any, *, drift: float = 0.0) -> None:
        check_single_control("Filtered", task)
        if task.formulas.targets:
            raise ValueError(f"Filtered estimates states without targets; {type(task).__name__} has targets")
        found = task.imperfections
        if found is None or not all(found.observation_noise or [0.0]):
            raise ValueError("a Kalman filter needs a task with noise on every entry of the observation")
        if found.observation_delay or any(found.action_delay) or found.drawn or found.observation_every > 1:
            raise ValueError("this filter needs known parameters, and every observation on time")
        if found.slew or any(found.lag):
            raise ValueError("this filter needs controls that act at once: no `lag`, no `slew`")
        if drift == 0.0 and (task.draws or any(found.action_noise) or any(found.push)):
            raise ValueError(
                "without drift this filter takes the motion for certain; kicks, pushes and action noise need "
                "drift > 0"
            )
        self.task, self.controller = task, controller
        self.read, self.model = ObservationDecoder(task), Model(task)
        self.noise = np.diag(np.square(found.observation_noise))
        self.prior = np.diag(np.square(task.half_widths) / 3.0)
        self.drift = drift**2 * self.prior
        self._k = SimpleNamespace(**task.formulas.constants())

    def predict(
        self, observation: NDArray, state: Belief | None = None, episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Belief]:  # fmt: skip
        """Return the action for each observation, and the belief after it."""
        values = check_observation(self.task, observation)
        batch = values.reshape(-1, values.shape[-1])
        x = np.tile(np.asarray(self.task.centre, np.float64), (len(batch), 1))
        covariance = np.tile(self.prior, (len(batch), 1, 1))
        fresh, memory = beginning(len(batch), state, episode_start), None
        if state is not None:
            moved, uncertain = self._move(state)
            x, covariance = (
                np.where(fresh[:, None], x, moved),
                np.where(fresh[:, None, None], covariance, uncertain),
            )
            memory = state.memory
        x, covariance = self._see(x, covariance, batch)
        clean = self.read.expected(x)[0].astype(np.float32)
        actions, memory = self.controller.predict(clean, memory, fresh)
        known = Belief(x, covariance, actions[:, 0].astype(np.float64), memory)
        return actions.reshape((*values.shape[:-1], 1)), known

    def _move(self, known: Belief) -> tuple[Array, Array]:
        """Return estimate and covariance one step later."""
        form, x = form_of(self.task.scene), known.state
        lifted = list(form.lift(x) if form else x.T)
        applied = self.task.formulas.control(np, [known.action], lifted, [], self._k)
        controls = np.stack(np.broadcast_arrays(*applied), axis=-1)
        slopes, _ = self.task.scene.jacobian(x, controls, self.task.dt)
        covariance = slopes @ known.covariance @ slopes.transpose(0, 2, 1) + self.drift
        return self.model(x, known.action)[0], covariance

    def _see(self, x: Array, covariance: Array, observation: Array) -> tuple[Array, Array]:
        """Return estimate and covariance after an observation."""
        expected, slopes = self.read.expected(x)
        across = slopes @ covariance
        gain = np.linalg.solve(across @ slopes.transpose(0, 2, 1) + self.noise, across).transpose(0, 2, 1)
        # Joseph's form keeps the covariance symmetric and positive definite despite rounding.
        left = np.eye(x.shape[1]) - gain @ slopes
        covariance = left @ covariance @ left.transpose(0, 2, 1) + gain @ self.noise @ gain.transpose(0, 2, 1)
        return x + np.einsum("nij,nj->ni", gain, observation - expected), covariance


def follow_filtered(task: Task, *, effort: float, drift: float) -> Filtered:
    """Return a controller that follows a task's recorded plan, acting on the estimate.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    effort : float
        Weight of the squared deviation of an action; with noisy observations, plans should be followed
        gently.
    drift : float
        As in `Filtered`.
    """
    plan, plans = recorded(task), dataclasses.replace(task.plans, effort=effort)
    return Filtered(task, follow(task, plan.states, plan.actions, plans), drift=drift)


def renewed_filtered(task: Task, *, drift: float, **numbers: Any) -> Filtered:
    """Return a controller that renews a task's recorded plan from the estimate.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    drift : float
        As in `Filtered`.
    **numbers
        Arguments of `lag_envs.controllers.mpc.renewed`.
    """
    return Filtered(task, renewed(task, **numbers), drift=drift)
