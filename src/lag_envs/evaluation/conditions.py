"""The conditions of an evaluation: other parameters, another control interval, noise, delay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.controllers.basic import trait
from lag_envs.mechanics.recording import parameter_values
from lag_envs.scenes.derivation import layout_of
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import MOST_DRAWN

#: Names of two conditions: the unchanged environment, and acting ten times as often.
NOMINAL, OFTEN = "nominal", "ten times as often"


@dataclass(frozen=True)
class Condition:
    """Changes to an environment.

    Parameters
    ----------
    name : str
        Its name in tables.
    options : mapping
        The environment's keyword arguments.
    noise : float
        Standard deviation of the observation noise, relative to the observation's own under random actions.
    late : bool
        Whether the agent sees the previous observation.
    """

    name: str = NOMINAL
    options: Mapping[str, Any] = field(default_factory=dict)
    noise: float = 0.0
    late: bool = False

    def steps(self, env_id: str) -> int:
        """Return the largest number of steps of an environment's episode."""
        return int(TASKS[env_id](**self.options).limit)

    def suits(self, agent: Any, plans: bool) -> bool:
        """Return whether an agent can act under the condition; plans and some memories need one interval.

        Parameters
        ----------
        agent : object
            The agent. An agent with a `pace` counts steps and can be given their length.
        plans : bool
            Whether the agent plans.
        """
        of_one = plans or trait(agent, "of_one_interval")
        return "dt" not in self.options or trait(agent, "pace") is not None or not of_one


def often(env_id: str) -> Condition:
    """Return the condition of acting ten times as often; the reward per second stays the same."""
    return Condition(OFTEN, {"dt": TASKS[env_id]().interval / 10.0})


def disturbances(env_id: str) -> list[Condition]:
    """Return conditions in which one of the environment's numbers is off by 20 %, unknown to policies.

    Values that the environment refuses, such as a friction beyond its range, are left out.
    """
    kind: Any = TASKS[env_id]
    return [
        Condition(f"{name} {sign}20 %", {name: share * value})
        for name, value in _positive(env_id).items()
        for share, sign in ((0.8, "-"), (1.2, "+"))
        if _takes(kind, name, share * value)
    ]


@cache
def _takes(kind: type[Task], name: str, value: float) -> bool:
    """Return whether a task can be made with another number."""
    try:
        kind(**{name: value})
    except ValueError:
        return False
    return True


def _positive(env_id: str) -> dict[str, float]:
    """Return the environment's positive, finite numbers."""
    values = parameter_values(TASKS[env_id]().scene)
    return {k: x for k, x in values.items() if isinstance(x, float) and 0.0 < x < math.inf}


def imperfections(env_id: str) -> list[Condition]:
    """Return conditions of imperfect sensors and actuators, and of hidden parameters.

    They are observation noise of 0.01 (tasks scale entries to about 1), actions that are one control
    interval late, actuators with a lag of two intervals, occasional pushes of 2 % of the largest rate, and
    the first `MOST_DRAWN` of the environment's numbers, drawn within 20 % in each episode. Imperfections
    that the environment already has stay as they are.
    """
    kind: Any = TASKS[env_id]
    task = kind()
    layout = layout_of(task.scene)
    turning = {
        entry.name: 0.02 * task.examples.reach
        for entry in layout.state
        if entry.unit == "rad/s" and entry.coordinate in layout.free
    }
    hidden = [
        name
        for name, value in _positive(env_id).items()
        if all(_takes(kind, name, share * value) for share in (0.8, 1.2))
    ][:MOST_DRAWN]
    found = {
        "noise": {"observation_noise": 0.01},
        "late by a step": {"action_delay": task.interval},
        "lag of two steps": {"lag": 2.0 * task.interval},
        "pushes": {"push": (0.5, turning)},
        "hidden, within 20 %": {"randomize": dict.fromkeys(hidden, (0.8, 1.2))},
    }
    if not (turning and task.examples.reach):
        del found["pushes"]
    on = kind.imperfections.keys()
    return [Condition(name, options) for name, options in found.items() if not options.keys() & on]


def on_board(env_id: str) -> list[Condition]:
    """Return the conditions by which an environment's board measures robustness, see `record.Goal.rules`."""
    goal = TASKS[env_id].goal
    more = imperfections(env_id) if goal is not None and goal.rules >= 2 else []
    return disturbances(env_id) + more


def conditions(env_id: str) -> list[Condition]:
    """Return all conditions: boards use the first few kinds; the agents' results use noise and delay too."""
    noise = [Condition(f"noise {level} %", noise=0.01 * level) for level in (1, 5)]
    return [Condition(), often(env_id), *disturbances(env_id), *noise, Condition("late", late=True)]


class Sensor:
    """The agent's view of a batch of episodes: with noise, or late.

    Parameters
    ----------
    noise : array_like, shape (n_observation,)
        Standard deviation of Gaussian noise, drawn independently for each entry at each step.
    late : bool
        Whether the agent sees the previous observation; at the start it sees the first.
    """

    def __init__(self, noise: ArrayLike = 0.0, late: bool = False) -> None:
        self.noise, self.late = np.asarray(noise, np.float64), late
        self.rng = np.random.default_rng(0)  # the same for all agents
        self.before: NDArray | None = None

    def __call__(self, observation: NDArray) -> NDArray:
        """Return the agent's view of observations (episodes, n)."""
        seen = observation if self.before is None else self.before
        if self.late:
            self.before = observation.copy()
        if self.noise.any():
            seen = seen + self.noise * self.rng.standard_normal(seen.shape)
        return seen.astype(observation.dtype)
