"""Shared parts of the environments' tests: ids, actions, and an episode's contents bit for bit."""

from __future__ import annotations

from importlib.util import find_spec

import gymnasium as gym
import numpy as np

from lag_envs.tasks import TASKS
from lag_envs.tasks.pivoted_bar import SwingUpFree

IDS = list(TASKS)


def _plain(task):
    formulas = task.formulas
    return (
        formulas.actions == 1 and formulas.targets <= 1 and not formulas.choices and formulas.largest == 1.0
    )


#: Those with one action in [-1, 1] and at most one target: hand-written tests know the meaning of an action.
SINGLE = [i for i, t in TASKS.items() if _plain(t())]
RENDERS = find_spec("pygame") is not None and find_spec("lag_envs.envs.rendering") is not None


class AnyBar(SwingUpFree):
    """A bar with any parameters that its scene accepts, so that steps can be refused."""

    def check_usable(self):
        pass


#: Keyword that makes an environment of `AnyBar`.
ANY_BAR = {"task": "rollouts:AnyBar"}


def make(env_id, **options):
    """Return the environment itself, without Gymnasium's wrappers."""
    return gym.make(env_id, disable_env_checker=True, **options).unwrapped


def actions(steps, *shape, seed=0):
    """Return actions of three kinds: noise, long full swings, and some beyond the limits.

    Given a space instead of a shape, they match its range or its choices.
    """
    space = shape[0] if shape and isinstance(shape[0], gym.Space) else None
    if space is not None:
        shape = space.shape
    rng = np.random.default_rng(seed)
    noise = rng.uniform(-1.0, 1.0, (steps, *shape))
    swings = np.repeat(rng.choice([-1.0, 0.0, 1.0], (steps // 20 + 1, *shape)), 20, axis=0)[:steps]
    temper = np.repeat(rng.integers(3, size=(steps // 50 + 1, *shape)), 50, axis=0)[:steps]
    found = np.select([temper == 0, temper == 1], [noise, swings], 2.0 * noise).astype(np.float32)
    if space is None:
        return found
    if space.dtype == np.float32:
        return found * space.high
    choices = numbers_of_choices(space)
    return np.minimum((0.5 * np.clip(found, -1.0, 1.0) + 0.5) * choices, choices - 1).astype(np.int64)


def numbers_of_choices(space):
    """Return how many choices each entry of an action has; those of a batch are boxes of whole numbers."""
    if isinstance(space, gym.spaces.Box):
        return space.high + 1
    return space.n if isinstance(space, gym.spaces.Discrete) else space.nvec


def nothing(env):
    """Return the action 0, with the type of an environment's action space."""
    return np.zeros(env.action_space.shape, env.action_space.dtype)


def one_by_one(env_id, agent, seeds, **options):
    """Return an agent's returns in single environments, one episode after the other."""
    with gym.make(env_id, **options) as env:
        return np.array([episode(env, agent, seed=seed)[0] for seed in seeds])


def episode(env, agent, **begin):
    """Play an episode from `env.reset(**begin)`; return its return, and whether it was terminated."""
    observation, _ = env.reset(**begin)
    memory, over, total, start = None, False, 0.0, np.ones(1, np.bool_)
    while not over:
        action, memory = agent.predict(observation, memory, start, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, over, start = total + reward, terminated or truncated, np.zeros(1, np.bool_)
    return total, terminated


class Noisy:
    """An agent, with noise on its actions."""

    def __init__(self, agent, size):
        self.agent, self.size, self.rng = agent, size, np.random.default_rng(0)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        action, state = self.agent.predict(observation, state)
        return (action + self.size * self.rng.normal(size=action.shape)).astype(np.float32), state


def trace(env, given):
    """Return the results of steps, arrays as bytes; each episode is followed by the next."""
    out = []
    for action in given:
        observation, reward, terminated, truncated, _ = env.step(action)
        out.append((observation.tobytes(), reward, terminated, truncated))
        if terminated or truncated:
            out.append(env.reset()[0].tobytes())
    return out
