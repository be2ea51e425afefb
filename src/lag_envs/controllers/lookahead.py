"""Agents that count steps, and the greedy policy of a value function, which looks one step ahead."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.controllers.basic import Agent, ObservationDecoder
from lag_envs.envs.model import Model
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]


class Clocked(Agent):
    """Base of the agents whose action depends on state, target and time; a subclass defines `act`.

    Their memory is the number of steps taken in each episode.

    Parameters
    ----------
    task : Task
        The task, with at most one target.
    complete : bool
        Whether the observation has to tell the whole state, and the target if it is random.
    """

    def __init__(self, task: Task, *, complete: bool = False) -> None:
        self.read = ObservationDecoder(task, complete=complete)
        self._chooses = bool(task.formulas.choices)
        self.largest = task.formulas.largest
        self.pace: float = 1.0  # less if the agent acts more often

    @abstractmethod
    def act(self, states: Array, targets: Array, taken: Array) -> Array:
        """Return actions, not clipped yet, for states (n, n_state), targets and steps taken (n,).

        Their shape is (n,) if an action has one number, and (n, n_actions) otherwise.
        """

    def finish(self, values: Array) -> NDArray:
        """Return the result of `act` in the form that the environment takes."""
        if self._chooses:
            return values.astype(np.int64)
        clipped = np.clip(values, -self.largest, self.largest).astype(np.float32)
        return clipped if clipped.ndim > 1 else clipped[:, None]

    def predict(
        self,
        observation: ArrayLike,
        state: ArrayLike | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray, Array]:
        """Return the action for each observation, and the number of steps taken by then."""
        values = np.asarray(observation, np.float64)
        batch = np.atleast_2d(values)
        taken = np.broadcast_to(np.asarray(0.0 if state is None else state, np.float64), len(batch))
        if episode_start is not None:
            taken = np.where(np.broadcast_to(episode_start, len(batch)), 0.0, taken)
        with np.errstate(all="ignore"):
            actions = self.finish(self.act(*self.read(batch), taken))
        return actions.reshape((*values.shape[:-1], *actions.shape[1:])), taken + self.pace


class LookAhead(Clocked):
    """Takes the action with the largest reward + value after one step of the exact, undisturbed model.

    The agent tries a set of actions and, unless the actions are listed, finer ones around the best.

    Parameters
    ----------
    task : Task
        The task, with one control.
    value : callable
        Takes the ends of steps (n, n_state), targets (n,) and the steps taken before them (n,); returns the
        mean return still to come (n,).
    actions : ndarray
        The number of evenly spaced actions to try first; if actions are listed, all are tried.
    """

    def __init__(self, task: Task, value: Callable[[Array, Array, Array], Array], actions: Array) -> None:
        super().__init__(task)
        self.model, self.value, self.actions = Model(task), value, actions
        self._aims = task.target_range is not None

    def act(self, states: Array, targets: Array, taken: Array) -> Array:
        """Return the best actions."""
        best = self._best(states, targets, taken, np.tile(self.actions, (len(states), 1)))
        if self._chooses:
            return best
        around = best[:, None] + (self.actions[1] - self.actions[0]) * np.linspace(-1.0, 1.0, 17)
        return self._best(states, targets, taken, np.clip(around, -self.largest, self.largest))

    def _best(self, states: Array, targets: Array, taken: Array, actions: Array) -> Array:
        """Return the best of each row's actions."""
        n, m = actions.shape
        goals, before = np.repeat(targets, m), np.repeat(taken, m)
        ends, rewards, ended = self.model(
            np.repeat(states, m, axis=0), actions.ravel(), goals if self._aims else None
        )
        later: Any = np.where(ended, 0.0, self.value(ends, goals, before))
        gains = (rewards + later).reshape(n, m)
        return np.take_along_axis(actions, gains.argmax(axis=1)[:, None], axis=1)[:, 0]
