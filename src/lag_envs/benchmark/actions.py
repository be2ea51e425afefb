"""Random actions, made before a sample is taken."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


def random_actions(n: int, scale: float = 1.0) -> list[NDArray[np.float32]]:
    """Return batches of shape (n, 1), uniform in [-scale, scale], so many that they do not repeat too soon.

    A few batches repeated over and over would act as a periodic force, which drives pendulums into resonance,
    to speeds at which steps are divided.
    """
    count = max(64, min(1024, 2**17 // n))
    return list(np.random.default_rng(0).uniform(-scale, scale, (count, n, 1)).astype(np.float32))


def actions_of(space: gym.Space, n: int) -> list[NDArray]:
    """Return batches of n random actions from a space: uniform numbers, or choices."""
    some = random_actions(n)
    if isinstance(space, gym.spaces.Discrete):
        return [((a[:, 0] + 1.0) * 0.5 * int(space.n)).astype(np.int64).clip(0, space.n - 1) for a in some]
    if isinstance(space, gym.spaces.Box) and space.shape == (1,):
        return [float(space.high[0]) * a for a in some]
    space.seed(0)
    return [np.array([space.sample() for _ in range(n)]).reshape(n, *(space.shape or ())) for _ in some[:64]]
