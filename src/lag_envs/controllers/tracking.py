"""Follow recorded plans by time-varying linear feedback, and find plans to record."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.controllers.basic import FeedbackLaw, check_continuous
from lag_envs.controllers.ilqr import ILQR
from lag_envs.controllers.linear import time_varying
from lag_envs.controllers.lookahead import Clocked
from lag_envs.tasks import resolve
from lag_envs.tasks.base import Task
from lag_envs.tasks.record import Plans

Array = NDArray[np.float64]

#: Folder of recorded plans: a file per environment, written by ``python -m agents.optimum``.
FOLDER = Path(__file__).with_name("plans")


class Tracking(Clocked):
    """Follow a plan by time-varying linear feedback, and hold its end by constant feedback.

    Along the plan's states x_t the action is a_t - K_t (x - x_t); after the plan's end it is -K (x - rest).
    Angles that are observed only by cosine and sine are compared the shorter way around. The controller
    consists of data only.

    Parameters
    ----------
    task : Task
        The task.
    states : array_like, shape (steps + 1, n_state)
        The plan's states. Without any step, there is only the feedback at rest.
    actions : array_like, shape (steps,) or (steps, n_actions)
        The plan's actions, without the last axis if each has one number.
    gains : array_like, shape (steps, n_state) or (steps, n_actions, n_state)
        The feedback K_t, actions per deviation.
    rest : array_like, shape (n_state,)
        The equilibrium to hold, with no control.
    hold : array_like, shape (n_state,) or (n_actions, n_state)
        The feedback K there.
    """

    #: The controller's numbers, by name.
    DATA = ("states", "actions", "gains", "rest", "hold")

    def __init__(
        self,
        task: Task,
        *,
        states: ArrayLike,
        actions: ArrayLike,
        gains: ArrayLike,
        rest: ArrayLike,
        hold: ArrayLike,
    ) -> None:
        check_continuous("Tracking", task)
        super().__init__(task, complete=True)
        self.task = task
        self.states, self.actions, self.gains, self.rest, self.hold = (
            np.asarray(values, np.float64) for values in (states, actions, gains, rest, hold)
        )
        self.idle = np.reshape(task.rest_action, self.actions.shape[1:]) + 0.0  # + 0.0: no -0.0
        steps = len(self.actions)
        for name, shape in self.shapes(task).items():
            wanted = tuple({"steps": steps, "steps + 1": steps + 1}.get(n, n) for n in shape)
            if getattr(self, name).shape != wanted:
                raise ValueError(f"{name} must have shape {wanted}, got {getattr(self, name).shape}")

    @staticmethod
    def shapes(task: Task) -> dict[str, tuple[Any, ...]]:
        """Return the shapes of its numbers by name; "steps" and "steps + 1" depend on the plan."""
        n, m = len(task.scene.state_names), task.formulas.actions
        each = () if m == 1 else (m,)
        return {
            "states": ("steps + 1", n), "actions": ("steps", *each), "gains": ("steps", *each, n),
            "rest": (n,), "hold": (*each, n),
        }  # fmt: skip

    @classmethod
    def load(cls, task: Task, file: Path) -> Tracking:
        """Read a plan from a file.

        Raises
        ------
        ValueError
            If the file does not exist, or if its plan is for a task with another state.
        """
        if not file.is_file():
            raise ValueError(f"there is no plan {file}; python -m agents.optimum {task.id} makes one")
        with np.load(file, allow_pickle=False) as data:
            return cls(task, **{name: data[name] for name in cls.DATA})

    def save(self, file: Path) -> None:
        """Write the plan to a file, in single precision."""
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            file,
            allow_pickle=False,
            **{name: getattr(self, name).astype(np.float32) for name in self.DATA},
        )

    def mirrored(self) -> Tracking:
        """Return the plan's mirror image, for a task that is symmetric under reflection."""
        return Tracking(
            self.task, states=-self.states, actions=2.0 * self.idle - self.actions, gains=self.gains,
            rest=-self.rest, hold=self.hold,
        )  # fmt: skip

    def act(self, states: Array, targets: Array, taken: Array) -> Array:
        """Return the actions."""
        steps = len(self.actions)
        step = np.minimum(taken + 1e-6, steps).astype(np.int64)  # the margin: see `Clocked.pace`
        share = np.clip(taken - step, 0.0, 1.0)[:, None]
        following = np.minimum(step + 1, steps)
        planned = self.states[step] + share * (self.states[following] - self.states[step])
        planned = np.where((step < steps)[:, None], planned, self.rest)
        gains = np.concatenate([self.gains, self.hold[None]])[step]
        off = self.read.difference(states, planned)
        actions = np.concatenate([self.actions, self.idle[None]])[step]
        return actions - np.einsum("i...j,ij->i...", gains, off)

    def law(self, task: Task) -> FeedbackLaw:
        """Return the controller as feedback, for steps of the task's own length."""
        m, n = task.formulas.actions, len(self.rest)
        return FeedbackLaw(
            np.append(self.states[:-1], self.rest[None], axis=0),
            np.append(self.actions.reshape(-1, m), self.idle.reshape(1, m), axis=0),
            np.append(self.gains.reshape(-1, m, n), self.hold.reshape(1, m, n), axis=0),
            self.read,
        )


def plans_of(task: Task) -> Plans:
    """Return `Task.plans`, or raise a ValueError."""
    if task.plans is None:
        raise ValueError(
            f"{type(task).__name__} has no `plans`, which say how its plans are made and followed"
        )
    return task.plans


def plan_file(task: Task, kind: str = "followed", folder: Path | None = None) -> Path:
    """Return the file of a task's plan: the plan to follow, or the "quick" plan as an initial guess."""
    return (folder or FOLDER) / f"{plans_of(task).of or task.id}-{kind}.npz"


def recorded(task: Task, kind: str = "followed") -> Tracking:
    """Return the controller that follows the plan recorded for a task's id."""
    return Tracking.load(task, plan_file(task, kind))


def hold(task: Task, plans: Plans | None = None) -> Tracking:
    """Return the regulator that holds the end of plans, as `Task.plans` or the given plans specify."""
    plans = plans or plans_of(task)
    return follow(task, [plans.rest], np.empty(0), plans)


def follow(task: Task, states: ArrayLike, actions: ArrayLike, plans: Plans) -> Tracking:
    """Return the controller that follows states and actions, with the shapes that `Tracking` takes."""
    states, actions = np.asarray(states, np.float64), np.asarray(actions, np.float64)
    gains, last = time_varying(smoothed(task), states, actions, plans.rest, plans.weights, plans.effort)
    return Tracking(task, states=states, actions=actions, gains=gains, rest=plans.rest, hold=last)


def smoothed(task: Task) -> Task:
    """Return the model from which the feedback along a task's plans comes, see `Plans.smooth`."""
    return task.varied(**task.plans.smooth) if task.plans.smooth else task


def waves(rng: np.random.Generator, n: int, steps: int, dt: float, count: int) -> Array:
    """Return random actions (n, steps, count): sums of three sines of 0.5 to 3 Hz, clipped."""
    size, phase = rng.uniform(0.0, 1.0, (3, n, 1, count)), rng.uniform(0.0, 2.0 * np.pi, (3, n, 1, count))
    turn = 2.0 * np.pi * rng.uniform(0.5, 3.0, (3, n, 1, count)) * dt * np.arange(steps)[:, None]
    return np.clip(np.sum(size * np.sin(turn + phase), axis=0), -1.0, 1.0)


def search(task: Task, seed: int = 0, **changes: Any) -> Iterator[Tracking]:
    """Plan from many random guesses at once, by iLQR on an easier task; yield a controller for each plan.

    The most promising plan comes first.

    Parameters
    ----------
    task : Task
        The task; its `plans` specify how.
    seed : int
        Seed of the guesses.
    **changes
        Changes to the numbers, see `Plans.quick`.
    """
    plans: Plans = task.plans
    size = {name: changes.pop(name, getattr(plans, name)) for name in ("steps", "batch", "iterations")}
    easier, tail = resolve(plans.place)(task, **(dict(plans.numbers) | changes))
    planner = ILQR(easier, [], tail=tail, steps=size["steps"], iterations=size["iterations"])
    count, rng = easier.formulas.actions, np.random.default_rng(seed)
    guesses = easier.formulas.largest * waves(rng, size["batch"], size["steps"], easier.dt, count)
    every = round(easier.dt / task.dt)
    starts = np.tile(np.asarray(task.centre, np.float64), (len(guesses), 1))
    found, values = planner.improve(starts, np.zeros(len(guesses)), guesses)
    shares: Any = easier.limit_control / task.limit_control
    for i in np.argsort(-values):
        actions = np.repeat(found.actions[i], every, axis=0)
        states = task.scene.simulate(starts[i], easier.wanted(actions), task.dt)
        actions = shares * actions
        yield follow(task, states, actions[:, 0] if count == 1 else actions, plans)
