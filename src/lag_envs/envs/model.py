"""A task's step as a function, for those who plan: any state, any action, no random kick, no time limit."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.envs.program import constants_of, program_for
from lag_envs.envs.single import absent
from lag_envs.scenes.checks import real_array
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]


class Model:
    """What one step does: control, motion, reward and ending, from the formulas that the environments step.

    It agrees with the environment's step to rounding, not bit for bit: from step to step an environment
    carries cosθ and sinθ along, the model takes them from θ. Random kicks are left to `kicked`.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.

    Examples
    --------
    >>> import gymnasium as gym, lag_envs
    >>> from lag_envs.envs.model import Model
    >>> model = Model(gym.make("PivotedBar-v0").unwrapped.task)
    >>> states, rewards, ended = model([[0.0, 0.0, 0.0, 0.0], [0.1, 0.0, 3.0, 0.1]], [1.0, 0.0])
    >>> states.shape, ended
    ((2, 4), array([False, False]))
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        constants = constants_of(task)
        program = program_for(task, absent([constants]))
        self._constants = SimpleNamespace(**constants)
        self._numbers = np.array([constants[name] for name in program.uniform])
        self._step = program.model
        self._n_state = program.n_state

    def __call__(
        self, states: ArrayLike, actions: ArrayLike, targets: ArrayLike | None = None
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Take one step from each state.

        Parameters
        ----------
        states : array_like, shape (n, n_state)
            States in the order of ``task.scene.state_names``; whether an episode would have ended there does
            not matter.
        actions : array_like, shape (n,), or (n, n_actions) where there are several
            Actions; finite values outside [-1, 1] are clipped.
        targets : array_like, shape (n,) or (), or (n, n_targets) or (n_targets,) where there are several
            Targets, for a task that has them and does not fix them.

        Returns
        -------
        states : ndarray, shape (n, n_state)
            The states at the step's end.
        rewards : ndarray, shape (n,)
            The rewards.
        ended : ndarray of bool, shape (n,)
            Whether the episode terminates.

        Raises
        ------
        ValueError
            For values that are not finite or of another shape, and for a target that is missing or too much.
        StepRefused
            Where a step cannot be taken to full accuracy.
        """
        states = np.ascontiguousarray(real_array("states", states))
        n = len(states) if states.ndim else 0
        if states.shape != (n, self._n_state):
            raise ValueError(f"states must have shape (n, {self._n_state}), got {states.shape}")
        targets = self._targets(targets, n)
        actions = np.ascontiguousarray(real_array("actions", actions), np.float64)
        count = self.task.formulas.actions
        wanted = (n,) if count == 1 else (n, count)
        if actions.shape != wanted:
            raise ValueError(f"actions must have shape {wanted}, got {actions.shape}")
        for name, values in (("states", states), ("actions", actions), ("targets", targets)):
            if not np.isfinite(values).all():
                row = int(np.argwhere(~np.isfinite(values))[0, 0])
                raise ValueError(f"{name} must be finite, got {values[row]} in row {row}")
        ends, rewards, ended = np.empty_like(states), np.empty(n), np.empty(n, np.bool_)
        refused = self._step(states, actions.reshape(n, count), targets, self._numbers, ends, rewards, ended)
        if refused:
            state, action = states[refused - 1], actions[refused - 1]
            raise self.task.formulas.refusal(
                state, action, self.task.dt, None, f"the step of row {refused - 1}"
            )
        return ends, rewards, ended

    def kicked(self, states: ArrayLike, draws: ArrayLike) -> Array:
        """Return the states after the task's random kick.

        Parameters
        ----------
        states : array_like, shape (n, n_state)
            States at a step's end.
        draws : array_like, shape (task.draws, n)
            The random numbers in [0, 1) on which the kick depends.
        """
        array, form = real_array("states", states), self.task.scene._form
        rows = form.lift(array) if form else tuple(array.T)
        kicked = self.task.formulas.kick(np, list(real_array("draws", draws)), rows, self._constants)
        return np.stack(np.broadcast_arrays(*kicked[: self._n_state]), axis=-1)

    def _targets(self, targets: ArrayLike | None, n: int) -> Array:
        """Return targets of shape (n, n_targets)."""
        count, fixed = self.task.formulas.targets, self.task.fixed_target
        if targets is not None and not count:
            raise ValueError("this task has no target, got targets")
        if targets is None and count and fixed is None:
            raise ValueError("the task's target is random: targets must be given")
        if targets is None:
            given = np.empty(0) if fixed is None else fixed
            return np.ascontiguousarray(np.broadcast_to(given, (n, count)))
        array = np.asarray(targets, np.float64)
        if array.shape not in ([(), (n,)] if count == 1 else [(count,), (n, count)]):
            wanted = f"({n},) or ()" if count == 1 else f"({n}, {count}) or ({count},)"
            raise ValueError(f"targets must have shape {wanted}, got {array.shape}")
        return np.ascontiguousarray(np.broadcast_to(array.reshape(-1, count), (n, count)))
