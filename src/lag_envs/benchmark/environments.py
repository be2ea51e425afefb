"""Environments with Gymnasium's interface, single or in a batch, made ready to be stepped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle, islice
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from lag_envs.benchmark.actions import actions_of
from lag_envs.benchmark.rounds import Run


def as_users_make_it(id: str) -> Run:
    """Prepare one environment as users make it, in Gymnasium's default wrappers."""
    return own_single(gym.make(id))


def unwrapped(id: str, **keywords: Any) -> Run:
    """Prepare one environment without wrappers."""
    return own_single(gym.make(id, **keywords).unwrapped)


def own_single(env: gym.Env) -> Run:
    """Prepare one environment with Gymnasium's interface."""
    # A choice is a Python int, as users give it.
    endless = cycle([a[0].item() if a.ndim == 1 else a[0] for a in actions_of(env.action_space, 1)])
    env.reset(seed=0)

    def run(steps: int) -> int:
        for action in islice(endless, steps):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return steps

    return run


def own_vector(id: str, n: int, **keywords: Any) -> Run:
    """Prepare a native vector environment, with one thread unless stated otherwise."""
    return stepped(gym.make_vec(id, num_envs=n, **{"num_threads": 1} | keywords))


def stepped(envs: VectorEnv) -> Run:
    """Prepare a vector environment of this package."""
    actions = actions_of(envs.single_action_space, envs.num_envs)
    envs.reset(seed=0)
    stagger_episodes(envs, actions)
    return batch(envs.step, actions)


def stagger_episodes(envs: VectorEnv, actions: Sequence[Any]) -> None:
    """Stagger the episodes, so that every sample contains its share of endings."""
    limit = envs.spec.max_episode_steps if envs.spec else None
    length = limit or round(envs.task.limit)  # type: ignore[attr-defined]
    turn = np.arange(envs.num_envs) * length // envs.num_envs
    for i, action in enumerate(islice(cycle(actions), length)):
        if (turn == i).any():
            envs.reset(options={"reset_mask": turn == i})
        envs.step(action)


def batch(step: Callable[[Any], Any], actions: Sequence[Any]) -> Run:
    """Prepare a batch that resets its environments itself."""
    endless = cycle(actions)

    def run(steps: int) -> int:
        for action in islice(endless, steps):
            step(action)
        return steps

    return run
