"""Staggered episodes: environments whose episodes end at different times."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv


def stagger(envs: VectorEnv, steps: int, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
    """Restart environments one after the other, so that from then on their episodes end one after the other.

    Without this, if all episodes have the same length, a learner's roll-out sees only one phase of them.

    Parameters
    ----------
    envs : VectorEnv
        Environments that have been reset, and that support ``"reset_mask"``.
    steps : int
        Steps over which the restarts are spread; the length of an episode is a good choice. The function
        takes this many steps with random actions.
    seed : int, optional
        Seed of the actions.

    Returns
    -------
    observations, infos
        Those after the last step.
    """
    last = np.arange(envs.num_envs) * steps // envs.num_envs
    envs.action_space.seed(seed)
    for t in range(steps):
        if t and (last == t).any():
            envs.reset(options={"reset_mask": last == t})
        observations, *_, infos = envs.step(envs.action_space.sample())
    return observations, infos
