"""Linear regulators about a rest, energy pumps that bring a system near it, and what they share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_are, solve_discrete_are

from lag_envs.controllers.basic import Array, FeedbackController, actions_for
from lag_envs.mechanics.recording import Values
from lag_envs.tasks.base import Task
from lag_envs.tasks.pendulum import PendulumRegret


class Regulator(FeedbackController):
    """Hold a rest by a linear-quadratic regulator of the exact control step.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    at : mapping, optional
        Entries of the state at the rest that are not 0.
    weights : mapping
        What the square of an entry of the state costs in a step.
    effort : float
        What the square of a control costs, as a share of the largest.
    """

    def __init__(
        self,
        task: Task,
        *,
        weights: Mapping[str, float],
        effort: float,
        at: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(task)
        scene = task.scene
        self.rest = np.array([(at or {}).get(name, 0.0) for name in scene.state_names])
        columns = [scene.control_names.index(a.control) for a in task.formulas.acting]
        a, b = scene.jacobian(self.rest, np.zeros(len(scene.control_names)), task.dt)
        b = b[:, columns]
        q = np.diag([weights.get(name, 0.0) for name in scene.state_names])
        r = effort * np.diag(1.0 / np.atleast_1d(task.limit_control) ** 2)
        self.cost = solve_discrete_are(a, b, q, r)
        self.gain = np.linalg.solve(r + b.T @ self.cost @ b, b.T @ self.cost @ a)

    def off(self, state: Array) -> Array:
        """Return states relative to the rest, by the shorter way around."""
        return self.read.difference(state, self.rest)

    def cost_to_go(self, state: Array) -> Array:
        """Return what the regulator expects to pay from states on."""
        off = self.off(state)
        return np.einsum("...i,ij,...j->...", off, self.cost, off)

    def control(self, state: Array, target: Array) -> Array:
        """Return -K times the distance from the rest."""
        u = -self.off(state) @ self.gain.T
        return u[..., 0] if self.gain.shape[0] == 1 else u


class Pumped(Regulator):
    """Base of the regulators that pump energy while they are far from their rest.

    Nearness is the regulator's own cost to go; the thresholds at which it takes over and gives up differ.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``, with one control.
    catch, lose : float
        Cost to go below which the regulator takes over, and above which it gives up.
    **regulator
        Those of `Regulator`.
    """

    def __init__(self, task: Task, *, catch: float, lose: float, **regulator: Any) -> None:
        super().__init__(task, **regulator)
        self.catch, self.lose = catch, lose

    @abstractmethod
    def swing(self, state: Array) -> Array:
        """Return the control far from the rest."""

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, NDArray[np.bool_]]:
        """Return the action for each observation; the state tells where the regulator is in charge."""
        x, target = self.read(observation)
        holds = np.zeros(x.shape[:-1], np.bool_) if state is None else np.array(state, np.bool_)
        if episode_start is not None:
            holds &= ~np.asarray(episode_start, np.bool_).reshape(holds.shape)
        holds = self.cost_to_go(x) < np.where(holds, self.lose, self.catch)
        return actions_for(self.task, np.where(holds, self.control(x, target), self.swing(x))), holds


class PendulumEnergyLQR(Pumped):
    """Turn a rod the way it turns until its energy is that of the upright rest, then hold it.

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


class PivotEnergyLQR(Pumped):
    """Swing a pendulum up by accelerating its pivot, then hold it.

    The pivot is accelerated in the direction in which that does work on the pendulum, in proportion to the
    missing energy [1]_, and softly back to its middle. Pendulum alone means: with the pivot at rest. Which
    force accelerates the pivot as wanted follows from the equations of motion, in which it is linear.

    Parameters
    ----------
    task : Task
        A task whose one control acts on the pivot.
    pivot, angle : str
        Coordinates of pivot and pendulum.
    pump : float
        The pivot's acceleration per missing energy, divided by the energy between both rests.
    centring : float
        Stiffness with which the pivot is drawn to its middle [1/s²].
    catch, lose, at, weights, effort
        See `Pumped`.

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
        self.coordinates = [list(task.scene._layout.free).index(name) for name in (pivot, angle)]
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


class Switch:
    """The largest control to one side or the other, by the sign of a sum of observations.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``, with one control.
    weights : mapping
        What each entry of the observation counts in the sum.
    """

    def __init__(self, task: Task, *, weights: Mapping[str, float]) -> None:
        self.task = task
        self.weights = np.array([weights.get(name, 0.0) for name in task.observation])

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, Any]:
        """Return the action for each observation."""
        side = np.where(observation @ self.weights < 0.0, -1.0, 1.0)
        return actions_for(self.task, side * self.task.limit_control), state


class PublishedLQR(FeedbackController):
    """The LQR of the double pendulum's project, about upright: its weights, on the frictionless model.

    It acts where its cost to go is below a threshold, and leaves the motor off elsewhere; what friction takes
    in the driven joint is added, as on the project's machine.

    Parameters
    ----------
    task : AcrobotReal or PendubotReal
        The task, ``env.unwrapped.task``.
    weights : sequence of float
        Costs of the squares of both angles, then of both rates.
    effort : float
        Cost of the torque's square.
    most : float
        Largest cost to go at which the regulator acts.
    friction : bool
        Whether friction is compensated.

    References
    ----------
    F. Wiebe et al., github.com/dfki-ric-underactuated-lab/double_pendulum: ``examples/ideal/lqr.py`` and
    ``leaderboard/*/simulation_v1/con_pflcol_lqr.py`` have the weights.
    """

    def __init__(
        self,
        task: Task,
        *,
        weights: Sequence[float],
        effort: float,
        most: float = 15.0,
        friction: bool = True,
    ) -> None:
        super().__init__(task)
        scene = task.scene
        ((self.joint,),) = ([i for i, name in enumerate(("shoulder", "elbow")) if scene.control == name],)
        numbers = {name: getattr(scene, name) for name in scene._numbers()}
        frictions = ("damping", "damping_2", "dry_friction", "dry_friction_2", "rotor_inertia")
        ideal = type(scene)(control=scene.control, **(numbers | dict.fromkeys(frictions, 0.0)))
        self.rest, self.most = np.array([np.pi, 0.0, 0.0, 0.0]), most
        a, b = ideal.linearise(self.rest, [0.0])
        q = np.diag([weights[0], weights[2], weights[1], weights[3]])
        self.cost = solve_continuous_are(a, b, q, [[effort]])
        self.gain = (b.T @ self.cost)[0] / effort
        end = ("", "_2")[self.joint]
        self.friction = [
            float(friction) * getattr(scene, f"{kind}{end}") for kind in ("damping", "dry_friction")
        ]

    def control(self, state: Array, target: Array) -> Array:
        """Return the torque."""
        off = self.read.difference(state, self.rest)
        cost = np.einsum("...i,ij,...j->...", off, self.cost, off)
        v = state[..., 1 + 2 * self.joint]
        lost = self.friction[0] * v + self.friction[1] * np.arctan(100.0 * v)
        return np.where(cost < self.most, lost - off @ self.gain, 0.0)


class OwnLaw(FeedbackController):
    """Act by the law that a task has itself.

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
    """Return V of states, given by their entries (n,): what no policy exceeds."""
    return task.value(_named(task, np.stack(state, axis=-1)), np)


def _named(task: Task, states: Array) -> Values:
    """Return states as formulas have them."""
    columns = np.moveaxis(np.asarray(states, np.float64), -1, 0)
    return Values("entry of the state", dict(zip(task.scene.state_names, columns, strict=True)))
