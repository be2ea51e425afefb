"""Energy pumps that bring a system near an equilibrium, where a linear regulator takes over."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.controllers.basic import Agent, Array, actions_for
from lag_envs.controllers.linear import Regulator
from lag_envs.scenes.derivation import layout_of
from lag_envs.tasks.base import Task


def in_charge(
    cost: Array, before: ArrayLike | None, episode_start: ArrayLike | None, catch: float, lose: float
) -> NDArray[np.bool_]:
    """Return where a regulator acts: at a cost to go below `catch`, or below `lose` if it acted before."""
    acted = np.zeros(cost.shape, np.bool_) if before is None else np.array(before, np.bool_)
    if episode_start is not None:
        acted &= ~np.asarray(episode_start, np.bool_).reshape(acted.shape)
    return cost < np.where(acted, lose, catch)


class Pumped(Regulator):
    """Base of the regulators that pump energy while they are far from rest.

    Distance is measured by the regulator's cost to go; the thresholds for taking over and giving up differ.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``, with one control.
    catch, lose : float
        Cost to go below which the regulator takes over, and above which it gives up.
    **regulator
        Arguments of `Regulator`.
    """

    def __init__(self, task: Task, *, catch: float, lose: float, **regulator: Any) -> None:
        super().__init__(task, **regulator)
        self.catch, self.lose = catch, lose

    @abstractmethod
    def swing(self, state: Array) -> Array:
        """Return the control far from rest."""

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, NDArray[np.bool_]]:
        """Return the action for each observation; the state tells where the regulator is in charge."""
        x, target = self.read(observation)
        holds = in_charge(self.cost_to_go(x), state, episode_start, self.catch, self.lose)
        return actions_for(self.task, np.where(holds, self.control(x, target), self.swing(x))), holds

    law = Agent.law  # not pure feedback, as the regulator is


class PivotEnergyLQR(Pumped):
    """Swing a pendulum up by accelerating its pivot, then hold it.

    The pivot is accelerated in the direction that does work on the pendulum, in proportion to the missing
    energy [1]_, and is softly drawn back to its middle. The energy is that of the pendulum alone, with the
    pivot at rest. The force for the wanted acceleration follows from the equations of motion, which are
    linear in the acceleration.

    Parameters
    ----------
    task : Task
        A task whose only control acts on the pivot.
    pivot, angle : str
        Coordinates of pivot and pendulum.
    pump : float
        The pivot's acceleration per missing energy, relative to the energy difference between the two rests.
    centring : float
        Stiffness with which the pivot is drawn to its middle [1/s²].
    **regulator
        Arguments of `Pumped`.

    References
    ----------
    .. [1] K. J. Åström and K. Furuta, "Swinging up a pendulum by energy control", Automatica 36 (2000),
       287-295.
    """

    def __init__(
        self, task: Task, *, pivot: str, angle: str, pump: float, centring: float, **regulator: Any
    ) -> None:
        super().__init__(task, **regulator)
        names = task.scene.state_names
        self.coordinates = [list(layout_of(task.scene).free).index(name) for name in (pivot, angle)]
        self.pivot, self.places = pivot, [names.index(n) for n in (pivot, f"{pivot}_dot", f"{angle}_dot")]
        self.pump, self.centring = pump, centring
        below = self.rest.copy()
        below[names.index(angle)] += np.pi
        self.enough, least = (float(task.scene.energy(x)["total"]) for x in (self.rest, below))
        self.between = self.enough - least

    def swing(self, state: Array) -> Array:
        """Return the force or torque on the pivot."""
        scene, (place, speed, rate) = self.task.scene, self.places
        alone = state.copy()
        alone[..., speed] = 0.0
        missing = (self.enough - scene.energy(alone)["total"]) / self.between
        i, j = self.coordinates
        work = scene.mass_matrix(state)[..., i, j] * state[..., rate]
        wanted = -self.pump * missing * np.where(work < 0.0, -1.0, 1.0)
        wanted = wanted - self.centring * state[..., place] - 2.0 * self.centring**0.5 * state[..., speed]
        still, pushed = (
            scene.acceleration(state, np.full((*state.shape[:-1], 1), u))[self.pivot] for u in (0.0, 1.0)
        )
        return (wanted - still) / (pushed - still)
