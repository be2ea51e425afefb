"""An environment on plain Python, stepped by the script of `lag_envs.envs.scripted`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lag_envs.envs.actions import Actions
from lag_envs.envs.imperfect.draws import PURPOSES
from lag_envs.envs.interface import seed_key
from lag_envs.envs.program import DRAWS
from lag_envs.envs.scripted import UnfusedImperfectProgram, UnfusedProgram
from lag_envs.tasks.base import Task


class Unfused:
    """An environment that is stepped by a task's script: the same bits everywhere, on plain Python.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    program : UnfusedProgram, optional
        The task's program, if there is one already.

    Attributes
    ----------
    steps : int
        Steps taken in this episode.

    Examples
    --------
    >>> import gymnasium as gym, lag_envs
    >>> from lag_envs.envs.unfused import Unfused
    >>> env = Unfused(gym.make("PivotedBar-v0").unwrapped.task)
    >>> observation = env.reset(7)
    >>> observation, reward, terminated, truncated = env.step([0.5])
    >>> reward.hex()
    '-0x1.47ae13112c92dp-8'
    """

    def __init__(self, task: Task, program: UnfusedProgram | None = None) -> None:
        self.task = task
        kind = UnfusedImperfectProgram if task.imperfections else UnfusedProgram
        self.program = program = program or kind(task)
        self._functions = program.functions
        self.numbers = [0.0] * program.size
        self.constants = program.constants
        self._actions = Actions(task.formulas)
        self._key: Any = None
        self._waiting: list[list[float]] = []
        self.steps = 0

    def reset(self, seed: int) -> list[float]:
        """Begin the episode that a new environment would begin with this seed; return the observation."""
        from lag_envs.stepping.primitives import episode_key

        self._key = episode_key(np.uint64(seed_key(seed)), np.uint64(1))
        self.steps = 0
        program, rest = self.program, np.atleast_1d(self.task.formulas.rest_action).tolist()
        self._waiting = [rest] * program.delay
        if program.drawn:
            self._functions["draw"](self.constants, self._draws(program.drawn, "parameters"))
            self._functions["derive"](self.constants)
        self._functions["start"](
            self.numbers, self._draws(self.program.states + self.task.formulas.targets), self.constants
        )
        return self.observe()

    def set_parameter(self, name: str, value: float) -> None:
        """Change a parameter of the scene, and everything computed from it."""
        self.constants[list(self.program.given).index(f"self_{name}")] = float(value)
        self._functions["derive"](self.constants)

    def _draws(self, count: int, purpose: str = "") -> list[float]:
        """Return this step's draws, from the episode's own key or from the key of a purpose."""
        from lag_envs.stepping.primitives import episode_key, uniform

        key, step = np.uint64(self._key), np.uint64(self.steps)
        if purpose:
            key, step = episode_key(key, np.uint64(PURPOSES[purpose])), step * np.uint64(-(-count // DRAWS))
        return [float(uniform(np.uint64(key), step, np.uint64(i))) for i in range(count)]

    def step(self, action: Any) -> tuple[list[float], float, bool, bool]:
        """Hold one control for one control interval.

        Parameters
        ----------
        action : array_like
            The action, as for the environment.

        Returns
        -------
        observation : list of float
            The observation, before it is rounded to float32.
        reward : float
            The reward.
        terminated, truncated : bool
            Whether the episode is over.

        Raises
        ------
        StepRefused
            If the step cannot be taken to full accuracy; then nothing is changed.
        """
        found = self._actions.one(action)
        before = list(self.numbers)
        f, k, rows = self.numbers, self.constants, self.program.rows
        self._waiting.append(np.atleast_1d(found).tolist())
        self._functions["move"](f, self._waiting.pop(0), k)
        if f[rows.refused]:
            held = f[rows.u]
            self.numbers[:] = before
            raise self.task.formulas.refusal(self.state, held, self.task.dt, "the step")
        self.steps += 1
        reward, ended = f[rows.reward], f[rows.ended] > 0.0
        if self.task.draws:
            self._functions["kick"](f, self._draws(self.task.draws), k)
        return self.observe(), reward, ended, self.steps >= self.task.limit

    def observe(self) -> list[float]:
        """Return the observation."""
        self._functions["observe"](self.numbers, self.constants)
        if "sense" in self._functions:
            draws = self._draws(self.program.noise, "observation")
            self._functions["sense"](self.numbers, draws, self.constants)
        return self.numbers[self.program.rows.o]

    @property
    def state(self) -> list[float]:
        """The state, in the order of ``scene.state_names``."""
        return self.numbers[: self.program.states]

    @state.setter
    def state(self, state: Sequence[float]) -> None:
        self.numbers[: self.program.states] = map(float, state)
        self._functions["lift"](self.numbers, self.constants)

    @property
    def target(self) -> list[float]:
        """The targets."""
        return self.numbers[self.program.rows.g]

    @target.setter
    def target(self, target: Sequence[float]) -> None:
        self.numbers[self.program.rows.g] = map(float, target)

    @property
    def control(self) -> list[float]:
        """The controls applied last."""
        return self.numbers[self.program.rows.u]

    def poses(self) -> list[list[float]]:
        """Return x, y, angle and part of each of the picture's frames; empty if there is no picture."""
        found = [0.0] * (4 * len(self.program.frames))
        self._functions["poses"](self.numbers, found, self.constants)
        return [found[i : i + 4] for i in range(0, len(found), 4)]
