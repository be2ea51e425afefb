"""Returns of agents over fresh episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.controllers.basic import at_random


def evaluate(env: gym.Env, agent: Any, seeds: Iterable[int]) -> NDArray[np.float64]:
    """Return an agent's return in one episode for each seed.

    Parameters
    ----------
    env : Env
        A single environment.
    agent : object
        Anything with the `predict` of Stable-Baselines3; it is asked for its deterministic action.
    seeds : iterable of int
        What the episodes are reset with.
    """
    returns = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        state, over, total = None, False, 0.0
        start = np.ones(1, np.bool_)
        while not over:
            action, state = agent.predict(observation, state, start, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total += float(reward)
            over, start = terminated or truncated, np.zeros(1, np.bool_)
        returns.append(total)
    return np.array(returns)


def evaluate_batch(
    env_id: str,
    agent: Any,
    seed: int,
    episodes: int,
    *,
    observe: Callable[[NDArray, NDArray[np.bool_]], NDArray] | None = None,
    **options: Any,
) -> NDArray[np.float64]:
    """Return an agent's returns in episodes that are stepped together, which is a good deal quicker.

    Parameters
    ----------
    env_id : str
        Id of an environment.
    agent : object
        As for `evaluate`, taking batches.
    seed : int
        Seed of the first episode; the others' follow it.
    episodes : int
        Number of episodes.
    observe : callable, optional
        Stands between environments and agent, see `Sensor`. Given the observations (episodes, n) and which
        of them begin an episode (episodes,), it returns what the agent gets to see.
    **options
        Parameters of the environment.
    """
    envs = gym.make_vec(env_id, episodes, autoreset_mode="SameStep", **options)
    observation, _ = envs.reset(seed=seed)
    state, returns, running = None, np.zeros(episodes), np.ones(episodes, np.bool_)
    start = running.copy()
    while running.any():
        seen = observation if observe is None else observe(observation, start)
        action, state = agent.predict(seen, state, start, deterministic=True)
        observation, reward, terminated, truncated, _ = envs.step(action)
        returns += np.where(running, reward, 0.0)
        start = terminated | truncated
        running &= ~start
    envs.close()
    return returns


class Sensor:
    """What an agent gets to see of a batch: with noise, or late. An `observe` of `evaluate_batch`.

    Parameters
    ----------
    noise : array_like, shape (n_observation,)
        Standard deviation of Gaussian noise, drawn anew for each entry at each step.
    late : bool
        Whether the agent sees the observation before; at an episode's start there is only the first.
    seed : int
        Seed of the noise.
    """

    def __init__(self, noise: ArrayLike = 0.0, late: bool = False, seed: int = 0) -> None:
        self.noise, self.late = np.asarray(noise, np.float64), late
        self.rng = np.random.default_rng(seed)
        self.before: NDArray | None = None

    def __call__(self, observation: NDArray, start: NDArray[np.bool_]) -> NDArray:
        """Return what is seen of observations (episodes, n), some of which begin an episode (episodes,)."""
        seen = observation
        if self.late:
            if self.before is not None:
                seen = np.where(start[:, None], observation, self.before)
            self.before = observation.copy()
        if self.noise.any():
            seen = seen + self.noise * self.rng.standard_normal(seen.shape)
        return seen.astype(observation.dtype)


def observation_std(env_id: str, seed: int, episodes: int = 100) -> NDArray[np.float64]:
    """Return each observation entry's standard deviation under random actions, shape (n_observation,).

    Parameters
    ----------
    env_id : str
        Id of an environment.
    seed : int
        Seed of the first episode; the others' follow it.
    episodes : int
        Number of episodes; their first ones count, to their end.
    """
    envs = gym.make_vec(env_id, episodes, autoreset_mode="SameStep")
    agent = at_random(envs.unwrapped.task, seed)  # type: ignore[attr-defined]
    observation, _ = envs.reset(seed=seed)
    running, seen = np.ones(episodes, np.bool_), []
    while running.any():
        seen.append(observation[running])
        action, _ = agent.predict(observation)
        observation, _, terminated, truncated, _ = envs.step(action)
        running &= ~(terminated | truncated)
    envs.close()
    return np.concatenate(seen).std(axis=0, dtype=np.float64)
