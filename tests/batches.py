"""Batches of environments beside single ones: they must give the same bits."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from rollouts import actions


def pair(env_id, n, mode="NextStep", **options):
    """Return the native vector environment and Gymnasium's of the single one."""
    sync = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": AutoresetMode(mode)}}
    return (
        gym.make_vec(env_id, num_envs=n, autoreset_mode=mode, **options),
        gym.make_vec(env_id, num_envs=n, disable_env_checker=True, **sync, **options),
    )


def assert_same(a, b):
    """Compare infos, observations, rewards, flags: the same keys, types of numbers and bits."""
    if isinstance(a, dict):
        assert isinstance(b, dict) and a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, tuple):
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray) and a.dtype != object:
        assert a.dtype == b.dtype and a.shape == b.shape
        assert a.tobytes() == b.tobytes(), np.argwhere(a != b)
    elif isinstance(a, np.ndarray):
        assert b.dtype == object
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a is b is None


def assert_alike(native, sync, steps, seed=0):
    """Step both alike, return the number of ended episodes.

    With autoreset disabled, finished episodes are reset, and now and then others too: rarely enough that half
    of the episodes reach their end.
    """
    n, disabled = native.num_envs, native.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    stray = 0.5 / native.task.limit
    rng = np.random.default_rng(seed)
    given = actions(steps, native.action_space, seed=seed)
    ends = 0
    for action in given:
        mine, synced = native.step(action), sync.step(action)
        assert_same(mine, synced)
        over = mine[2] | mine[3]
        ends += over.sum()
        mask = over | (rng.random(n) < stray)
        if disabled and mask.any():
            seeds = [int(rng.integers(1000)) if rng.random() < 0.2 else None for _ in range(n)]
            # Gymnasium's removes the mask from the dict.
            assert_same(*(e.reset(seed=seeds, options={"reset_mask": mask.copy()}) for e in (native, sync)))
    return ends


ID = "PivotedBar-v0"

#: Every keyword, with a range and a size of its own.
ALL = {
    "randomize": {"damping": (0.1, 10, "log"), "com_distance": (0.15, 0.6, "absolute")},
    "observation_noise": {"s/S": 0.01, "cos(theta)": 0.02, "sin(theta)": 0.02, "theta_dot/8": 0.05},
    "observation_delay": 0.03,
    "observation_every": 2,
    "action_noise": 0.1,
    "action_delay": (0.0, 0.05),
    "slew": 100.0,
    "lag": 0.01,
    "push": (4.0, 0.7),
}


def played(env_id: str, n: int, steps: int, mode: str = "NextStep", **keywords):
    """Assert that a batch equals single environments, bit for bit; return the observations."""
    envs, sync = pair(env_id, n, mode, **keywords)
    own, alone, seen = envs.unwrapped, [env.unwrapped for env in sync.envs], []
    assert_same(envs.reset(seed=5), sync.reset(seed=5))
    for _ in range(steps):
        actions = envs.action_space.sample()
        if not own.task.formulas.choices:
            actions *= np.float32(1.5)  # some are clipped
        found = envs.step(actions)
        assert_same(found, sync.step(actions))
        assert all(envs.single_observation_space.contains(one) for one in found[0])
        assert np.array_equal(own.state, [env.state for env in alone])
        assert np.array_equal(own.control, [env.control for env in alone])
        for name, values in own.parameters.items():
            assert np.array_equal(values, [env.parameters[name] for env in alone])
        seen.append(found[0])
    return np.array(seen), envs
