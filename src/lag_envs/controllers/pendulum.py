"""Controllers of the rod on a hinge."""

from __future__ import annotations

import numpy as np

from lag_envs.controllers.basic import Array, FeedbackController
from lag_envs.controllers.energy import Pumped
from lag_envs.mechanics.recording import Values
from lag_envs.tasks.base import Task
from lag_envs.tasks.pendulum import PendulumRegret


class PendulumEnergyLQR(Pumped):
    """Turn a rod the way it already turns until it has the energy of the upright rest, then hold it.

    Parameters
    ----------
    task : Task
        A task with `lag_envs.scenes.Pendulum`.
    pump : float
        Torque per missing energy [N m/J].
    catch, lose : float
        See `Pumped`.
    """

    def __init__(self, task: Task, *, pump: float = 2.0, catch: float = 10.0, lose: float = 30.0) -> None:
        super().__init__(task, catch=catch, lose=lose, weights={"theta": 1.0, "theta_dot": 0.1}, effort=0.004)
        self.pump, self.enough = pump, float(task.scene.energy(self.rest)["total"])

    def swing(self, state: Array) -> Array:
        """Return the torque."""
        missing = self.enough - self.task.scene.energy(state)["total"]
        return self.pump * missing * np.where(state[..., 1] < 0.0, -1.0, 1.0)


class OwnLaw(FeedbackController):
    """Act by the task's own optimal law.

    Parameters
    ----------
    task : PendulumRegret
        The task, ``env.unwrapped.task``.
    """

    task: PendulumRegret

    def control(self, state: Array, target: Array) -> Array:
        """Return the torque."""
        return self.task.law(_named(self.task, state), np)


def value_at_start(task: PendulumRegret, *state: Array) -> Array:
    """Return V for states, given by their entries (n,); no policy exceeds it."""
    return task.value(_named(task, np.stack(state, axis=-1)), np)


def _named(task: Task, states: Array) -> Values:
    """Return states in the form that the task's formulas take."""
    columns = np.moveaxis(np.asarray(states, np.float64), -1, 0)
    return Values("entry of the state", dict(zip(task.scene.state_names, columns, strict=True)))
