"""Estimate the state from noisy observations by an extended Kalman filter, and act by the estimate."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import Array, ObservationDecoder
from lag_envs.controllers.tracking import follow, recorded
from lag_envs.envs.model import Model
from lag_envs.tasks.base import Task


class Belief(NamedTuple):
    """What is believed of each episode: its state before the last action, how surely, and that action."""

    state: Array  # (n, n_state)
    covariance: Array  # (n, n_state, n_state)
    action: Array  # (n,)
    memory: Any  # that of the controller


class Filtered:
    """Act by an estimate of the state, which an extended Kalman filter on the exact model makes [1]_.

    Between observations the estimate moves as the model does, and its covariance by the model's exact
    derivatives; that what a guard does depends on the state is left out. In the beginning the estimate is the
    middle of the task's starts, as unsure as they are wide.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``, with one control, no targets and noise on every observation; actions
        and observations must not be late.
    controller : controller
        Who acts on observations made of the estimate.
    drift : float
        Standard deviation that the estimate is given anew in each step, as a share of the state's spread at
        the start: a filter that is too sure of itself stops listening.

    Raises
    ------
    ValueError
        For a task whose imperfections it does not reckon with.

    References
    ----------
    .. [1] R. F. Stengel, "Optimal control and estimation", Dover 1994, section 4.7.
    """

    #: What it believes is of steps of one length.
    of_one_interval = True

    def __init__(self, task: Task, controller: Any, *, drift: float = 0.0) -> None:
        found = task.imperfections
        if found is None or not all(found.observation_noise or [0.0]):
            raise ValueError("a Kalman filter needs a task with noise on every entry of the observation")
        if found.observation_delay or any(found.action_delay) or found.drawn or found.observation_every > 1:
            raise ValueError("this filter needs known parameters, and every observation on time")
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
        """Return the action for each observation, and what is believed then."""
        values = np.asarray(observation, np.float64)
        batch = values.reshape(-1, values.shape[-1])
        x = np.tile(np.asarray(self.task.centre, np.float64), (len(batch), 1))
        covariance = np.tile(self.prior, (len(batch), 1, 1))
        fresh, memory = np.ones(len(batch), np.bool_), None
        if state is not None:
            fresh = np.broadcast_to(False if episode_start is None else episode_start, len(batch))
            moved, spread = self._move(state)
            x, covariance = (
                np.where(fresh[:, None], x, moved),
                np.where(fresh[:, None, None], covariance, spread),
            )
            memory = state.memory
        x, covariance = self._see(x, covariance, batch)
        clean = self.read.expected(x)[0].astype(np.float32)
        actions, memory = self.controller.predict(clean, memory, fresh)
        known = Belief(x, covariance, actions[:, 0].astype(np.float64), memory)
        return actions.reshape((*values.shape[:-1], 1)), known

    def _move(self, known: Belief) -> tuple[Array, Array]:
        """Return estimate and covariance a step later."""
        form, x = self.task.scene._form, known.state
        lifted = list(form.lift(x) if form else x.T)
        applied = self.task.formulas.control(np, [known.action], lifted, [], self._k)
        controls = np.stack(np.broadcast_arrays(*applied), axis=-1)
        slopes, _ = self.task.scene.jacobian(x, controls, self.task.dt)
        spread = slopes @ known.covariance @ slopes.transpose(0, 2, 1) + self.drift
        return self.model(x, known.action)[0], spread

    def _see(self, x: Array, covariance: Array, observation: Array) -> tuple[Array, Array]:
        """Return estimate and covariance when that has been observed."""
        expected, slopes = self.read.expected(x)
        across = slopes @ covariance
        gain = np.linalg.solve(across @ slopes.transpose(0, 2, 1) + self.noise, across).transpose(0, 2, 1)
        # Joseph's form keeps the covariance symmetric and positive in spite of rounding.
        left = np.eye(x.shape[1]) - gain @ slopes
        covariance = left @ covariance @ left.transpose(0, 2, 1) + gain @ self.noise @ gain.transpose(0, 2, 1)
        return x + np.einsum("nij,nj->ni", gain, observation - expected), covariance


def follow_filtered(task: Task, *, effort: float, drift: float) -> Filtered:
    """Return what follows a task's recorded plan by the estimate.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    effort : float
        Weight of the square of an action's deviation: what is seen dimly is followed gently.
    drift : float
        As `Filtered` has it.
    """
    plan, plans = recorded(task), dataclasses.replace(task.plans, effort=effort)
    return Filtered(task, follow(task, plan.states, plan.actions, plans), drift=drift)
