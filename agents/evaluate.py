"""Returns and scores of agents over fresh episodes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

#: Mean returns of the random policy (4,096 episodes; `tests/test_docs.py` measures them again) and of the
#: best one known: the optimum as estimated by value iteration, or a feedback law's return where that is more.
KNOWN_RETURNS = {
    "PivotedBar-v0": (-0.78, 421.0),
    "PivotedBarFree-v0": (-2.43, 421.0),
    "InclineBrake-v0": (-4.32, -1.72),
    "CylinderInCylinderDamping-v0": (294.3, 363.8),
}


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


def evaluate_batch(env_id: str, agent: Any, seed: int, episodes: int, **options: Any) -> NDArray[np.float64]:
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
    **options
        Parameters of the environment.
    """
    envs = gym.make_vec(env_id, episodes, autoreset_mode="SameStep", **options)
    observation, _ = envs.reset(seed=seed)
    state, returns, running = None, np.zeros(episodes), np.ones(episodes, np.bool_)
    start = running.copy()
    while running.any():
        action, state = agent.predict(observation, state, start, deterministic=True)
        observation, reward, terminated, truncated, _ = envs.step(action)
        returns += np.where(running, reward, 0.0)
        start = terminated | truncated
        running &= ~start
    envs.close()
    return returns


def score(env_id: str, mean_return: float) -> float | None:
    """Return how far a mean return lies on the way from the random policy (0) to the best known one (1)."""
    if env_id not in KNOWN_RETURNS:
        return None
    random, best = KNOWN_RETURNS[env_id]
    return (mean_return - random) / (best - random)
