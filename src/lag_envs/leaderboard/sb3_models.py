"""Trained models of Stable-Baselines3 as policies of the environments themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.leaderboard.networks import bin_centres, stacked
from lag_envs.tasks.base import Task


class ModelPolicy:
    """A model that takes the environment's own observations and returns its actions.

    Parameters
    ----------
    model : BaseAlgorithm
        The model.
    task : Task
        The task. If only the model's actions are listed, they stand for parts of [-1, 1].
    normalise : VecNormalize, optional
        The normalisation of its observations.
    frames : int
        The number of observations that it sees at once, as with `VecFrameStack`: the last ones of each
        episode, with zeros before the first.
    """

    def __init__(self, model: Any, task: Task, normalise: Any = None, frames: int = 1) -> None:
        self.model, self.normalise, self.frames = model, normalise, frames
        bins = None if task.formulas.choices else getattr(model.action_space, "n", None)
        self.centres = None if bins is None else bin_centres(int(bins)).astype(np.float32)

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray, Any]:
        """Return actions and the memory: earlier observations, or a recurrent model's own."""
        if self.frames == 1:
            return self.actions(observation, state, episode_start, deterministic)
        state = stacked(observation, self.frames, state, episode_start)
        return self.actions(state, None, episode_start, deterministic)[0], state

    def actions(
        self, seen: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray, Any]:
        """Return the action for whatever the model sees, and a recurrent model's memory."""
        if self.normalise is not None:
            seen = self.normalise.normalize_obs(seen)
        action, state = self.model.predict(seen, state, episode_start, deterministic)
        return action if self.centres is None else self.centres[np.asarray(action)][..., None], state
