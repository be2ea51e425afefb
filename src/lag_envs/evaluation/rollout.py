"""The episode loop: an agent in episodes that are stepped together, and observers of what happens."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import at_random, trait
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class PolicyError(Exception):
    """An agent fails or returns an invalid action; the text says how, and is safe to print."""


class RolloutStep(NamedTuple):
    """The events of one step in a batch of episodes.

    Attributes
    ----------
    observation : ndarray, shape (episodes, n_observation)
        The agent's observation.
    action : ndarray, shape (episodes, ...)
        Its action.
    reward : ndarray, shape (episodes,)
        Its reward.
    terminated, truncated : ndarray of bool, shape (episodes,)
        Which episodes ended.
    running : ndarray of bool, shape (episodes,)
        Which episodes had not ended before; the others do not count.
    """

    observation: NDArray
    action: NDArray
    reward: Array
    terminated: Mask
    truncated: Mask
    running: Mask


class Rollout:
    """One episode for each seed, all stepped together.

    Iterating takes one step at a time; `state` then holds the state after it. `run` takes all steps.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    agent : object
        Anything with the `predict` of Stable-Baselines3 for batches; its deterministic action is used. If an
        agent counts steps, its `pace` is set: the advance of its clock per step.
    seeds : sequence of int
        Reset seeds of the episodes.
    sensor : callable, optional
        Takes the observations and returns the agent's view of them, see `conditions.Sensor`.
    **options
        Parameters of the environment.
    """

    def __init__(
        self,
        env_id: str,
        agent: Any,
        seeds: Sequence[int],
        sensor: Callable[[NDArray], NDArray] | None = None,
        **options: Any,
    ) -> None:
        # An environment keeps its last state for one step before it restarts; later states do not count.
        envs: Any = gym.make_vec(env_id, len(seeds), autoreset_mode="NextStep", **options)
        self.envs = envs.unwrapped
        self.task: Task = self.envs.task
        self.agent, self.sensor, self.memory = agent, sensor, None
        if trait(agent, "pace") is not None:
            agent.pace = self.task.dt / self.task.interval
        self.observation, _ = self.envs.reset(seed=list(seeds))
        self.target: NDArray | None = None if self.envs.target is None else self.envs.target.copy()
        self.returns: Array = np.zeros(len(seeds))
        self.running: Mask = np.ones(len(seeds), np.bool_)

    @property
    def state(self) -> Array:
        """The states of the episodes, shape (episodes, n_state)."""
        return self.envs.state

    @property
    def control(self) -> Array:
        """The control of the last step."""
        return self.envs.control

    def __iter__(self) -> Iterator[RolloutStep]:
        """Take the steps, until all episodes have ended."""
        start = self.running.copy()
        while self.running.any():
            seen = self.observation if self.sensor is None else self.sensor(self.observation)
            action, self.memory = act(self.agent, seen, self.memory, start, self.envs.action_space.shape)
            self.observation, reward, terminated, truncated, _ = self.envs.step(action)
            self.returns += np.where(self.running, reward, 0.0)
            yield RolloutStep(seen, action, reward, terminated, truncated, self.running)
            self.running = self.running & ~(terminated | truncated)
            start = np.zeros_like(start)
        self.envs.close()

    def run(self, *watchers: Callable[[RolloutStep], Any]) -> Array:
        """Take all steps, show each to the watchers, and return the episodes' returns."""
        for step in self:
            for watch in watchers:
                watch(step)
        return self.returns


def play(env_id: str, agent: Any, seeds: Sequence[int], **options: Any) -> Array:
    """Return an agent's returns in one episode for each seed; arguments as for `Rollout`."""
    return Rollout(env_id, agent, seeds, **options).run()


class Meter:
    """Watches successive roll-outs and reports their progress.

    Parameters
    ----------
    total : int
        Upper limit of the steps of all roll-outs together.
    show : callable
        Called now and then with the steps taken so far, and the total.
    """

    def __init__(self, total: int, show: Callable[[int, int], Any]) -> None:
        self.total, self.show, self.done, self.taken = total, show, 0, 0

    def __call__(self, step: RolloutStep) -> None:
        """Count a step of every episode."""
        self.taken += len(step.running)
        self.show(self.done + self.taken, self.total)

    def close(self, size: int) -> None:
        """Count a roll-out that ended early, or was left out, as one of this many steps."""
        self.done, self.taken = self.done + size, 0
        self.show(self.done, self.total)


def act(agent: Any, observation: Any, memory: Any, start: Mask, shape: tuple[int, ...]) -> tuple[Any, Any]:
    """Return actions of a shape and the agent's memory; raise PolicyError if there are none."""
    try:
        with np.errstate(all="ignore"):
            action, memory = agent.predict(observation, memory, start, deterministic=True)
        found, good = np.shape(action), bool(np.isfinite(action).all())
    except Exception as error:  # nonsensical numbers may raise anything
        raise PolicyError(f"it fails with {ascii(f'{type(error).__name__}: {error}')[:200]}") from error
    if not good:
        raise PolicyError("it returned an action that is not a finite number")
    if found != shape:
        raise PolicyError(f"it returned actions of shape {found}, not {shape}")
    return action, memory


def observation_std(env_id: str, seeds: Sequence[int]) -> Array:
    """Return each observation entry's standard deviation under random actions, shape (n_observation,)."""
    rollout = Rollout(env_id, None, seeds)
    rollout.agent = at_random(rollout.task, seeds[0])
    seen = [step.observation[step.running] for step in rollout]
    return np.concatenate(seen).std(axis=0, dtype=np.float64)


# --- what is recorded ---------------------------------------------------------------------------------------


def arrivals(inside: Mask, steps: NDArray) -> tuple[Array, NDArray[np.int64]]:
    """Return the step after which something first holds, and the step from which it holds for good.

    Parameters
    ----------
    inside : ndarray of bool, shape (n + 1, episodes)
        Whether it holds at the start, and after each step.
    steps : ndarray, shape (episodes,)
        Steps of each episode.

    Returns
    -------
    first : ndarray
        Infinite if it never holds.
    last : ndarray of int
        Above `steps` if it does not hold at the end.
    """
    counts = np.arange(len(inside))[:, None] <= steps
    yes, no = inside & counts, ~inside & counts
    first = np.where(yes.any(axis=0), yes.argmax(axis=0), math.inf)
    return first, np.where(no.any(axis=0), len(no) - no[::-1].argmax(axis=0), 0)


class Outcome:
    """Records when a task's goal is reached, the effort, and a hash of everything that happens in episodes.

    Parameters
    ----------
    rollout : Rollout
        The episodes, before their first step.
    """

    def __init__(self, rollout: Rollout) -> None:
        self.rollout, self.task, self.hash = rollout, rollout.task, hashlib.sha256()
        self.effort, self.steps = np.zeros_like(rollout.returns), np.zeros_like(rollout.returns)
        self.ended = np.zeros_like(rollout.running)
        self.inside = [self._holds()]

    def _holds(self) -> Mask:
        return self.task.goal_holds(self.rollout.state, self.rollout.target)

    def __call__(self, step: RolloutStep) -> None:
        """Note a step."""
        self.steps += step.running
        self.effort += np.where(step.running, self.task.effort(self.rollout.control), 0.0)
        self.ended |= step.running & step.terminated
        self.inside.append(self._holds())
        given = np.asarray(step.action, "<f4"), np.asarray(step.reward, "<f8")
        for array in (*given, step.terminated, step.truncated):
            rows = step.running.reshape(-1, *(1 for _ in array.shape[1:]))  # one for each environment
            self.hash.update(np.where(rows, array, array.dtype.type(0)).tobytes())

    def result(self) -> dict[str, Any]:
        """Return each episode's success, time [s] and effort, and the hash."""
        goal, dt = self.task.goal, self.task.dt
        assert goal is not None
        first, last = arrivals(np.array(self.inside), self.steps)
        if goal.hold is None:
            reached = np.where(np.isfinite(first), first * dt, math.nan)
        else:
            holds = (last + goal.hold / dt <= self.steps + 1e-6) & (self.ended == bool(goal.terminated))
            reached = np.where(holds, last * dt, math.nan)
        if goal.terminated is None:
            success = ~self.ended
        else:
            success = np.isfinite(reached) & (self.ended == goal.terminated)
        return {
            "success": success.tolist(),
            "settle": [None if math.isnan(t) else round(t, 9) for t in reached],
            "effort": (self.effort / self.steps).tolist(),
            "trajectory": self.hash.hexdigest(),
        }


@dataclass(frozen=True)
class Episodes:
    """A record of episodes that were stepped together.

    Parameters
    ----------
    task : Task
        Their task.
    observations : ndarray, shape (steps, episodes, n_observation)
        The agent's observations.
    states : ndarray, shape (steps + 1, episodes, n_state)
        States at the start of each step, and at the end of the last; after an episode's end, its last state.
    actions : ndarray, shape (steps, episodes, ...)
        The agent's actions.
    rewards : ndarray, shape (steps, episodes)
        The rewards; 0 after an episode's end.
    steps : ndarray of int, shape (episodes,)
        Steps of each episode.
    targets : ndarray, shape (episodes,) or (episodes, n_targets), optional
        Targets, if the task has them.
    """

    task: Task
    observations: Array
    states: Array
    actions: Array
    rewards: Array
    steps: NDArray[np.int64]
    targets: Array | None

    @property
    def running(self) -> Mask:
        """Which episodes had not ended before each step, shape (steps, episodes)."""
        return np.arange(len(self.rewards))[:, None] < self.steps

    def settled(self) -> Array:
        """Return the seconds after which the task's goal holds for good; inf if it does not at the end."""
        inside = np.array([self.task.goal_holds(state, self.targets) for state in self.states])
        _, last = arrivals(inside, self.steps)
        return np.where(last > self.steps, np.inf, last * self.task.dt)


def record_rollout(rollout: Rollout, *watchers: Callable[[RolloutStep], Any]) -> Episodes:
    """Take all steps of a roll-out, show each to the watchers, and return a record of it."""
    states, steps = [rollout.state.copy()], []
    for step in rollout:
        for watch in watchers:
            watch(step)
        states.append(np.where(step.running[:, None], rollout.state, states[-1]))
        steps.append(step._replace(observation=np.array(step.observation), action=np.array(step.action)))
    return Episodes(
        rollout.task,
        np.array([step.observation for step in steps]),
        np.array(states),
        np.array([step.action for step in steps], np.float64),
        np.array([np.where(step.running, step.reward, 0.0) for step in steps]),
        np.sum([step.running for step in steps], axis=0),
        rollout.target,
    )
