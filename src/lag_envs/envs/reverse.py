"""A task's step backwards: from gradients by its results to gradients by what it depends on.

A step is control, motion, reward and observation. The motion's part is `Scene.vjp`; those of the formulas
before and after it are recorded from the formulas themselves (`lag_envs.stepping.adjoint`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.envs.program import constants_of
from lag_envs.stepping.adjoint import compile_lanes
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]


class Reverse:
    """What a task computes before and after the motion, and its derivatives, for many rows.

    All arrays have a row per quantity: states (n_state, n), actions (n_actions, n), controls (n_controls, n),
    targets (n_targets, n), observations (n_observations, n).

    Parameters
    ----------
    task : Task
        The task.
    parameters : tuple of str
        Names of the scene's parameters by which derivatives are wanted.

    Raises
    ------
    ValueError
        For a task whose actions are choices, or whose kick depends on the state.
    """

    def __init__(self, task: Task, parameters: tuple[str, ...] = ()) -> None:
        formulas = self._formulas = task.formulas
        if formulas.choices:
            raise ValueError(
                f"{type(task).__name__} has a list of actions to choose from, by which no step has "
                "derivatives"
            )
        constants = constants_of(task)
        self._names = [f"k_{name}" for name in constants]
        self._numbers = np.array([*constants.values()])
        self._absent = {f"k_{name}" for name, value in constants.items() if value == 0.0}
        self._by = [f"k_self_{name}" for name in parameters]
        rows = {"y": len(formulas.state), "a": formulas.actions, "g": formulas.targets}
        rows |= {"z": rows["y"], "u": formulas.controls, "e": rows["y"], "o": len(formulas.observation)}
        self._rows = {letter: [f"{letter}{i}" for i in range(n)] for letter, n in rows.items()} | {"r": ["r"]}
        form = task.scene._form
        self._angle = None if form is None else form.angle

    def controls(self, states: Array, actions: Array, targets: Array) -> Array:
        """Return the controls that are applied."""
        return self._run(self._control, states, actions, targets)

    def observations(self, states: Array, targets: Array) -> Array:
        """Return the observations of states."""
        return self._run(self._observe, states, targets)

    def outcome(self, states: Array, ends: Array, controls: Array, targets: Array) -> tuple[Array, Any]:
        """Return rewards, and whether episodes terminate."""
        rewards, ended = self._run(self._outcome, states, ends, controls, targets)
        return rewards, ended > 0.0

    def after(self, *given: Array) -> list[Array]:
        """Return gradients by states, ends, controls, targets and parameters from those by what follows.

        Given are states before and after the motion, controls, targets and states after the kick; then the
        gradients by the last ones, by the observations and by the reward.
        """
        return self._split(self._run(self._after, *given), "yzug")

    def before(self, *given: Array) -> list[Array]:
        """Return gradients by controls as gradients by states, actions, targets and parameters.

        Given are states, actions, targets and the gradients.
        """
        return self._split(self._run(self._before, *given), "yag")

    # --- formulas ------------------------------------------------------------------------------------------

    def _run(self, compiled: tuple[Callable, int], *given: Array) -> Array:
        function, outputs = compiled
        both = np.concatenate(given)
        found = np.empty((outputs, both.shape[1]))
        function(both, found, self._numbers)
        return found

    def _split(self, found: Array, letters: str) -> list[Array]:
        ends = np.cumsum([len(self._rows[letter]) for letter in letters])
        return np.split(found, ends)

    def _compile(self, name: str, letters: str, formula: Callable, outputs: int) -> tuple[Callable, int]:
        inputs = [row for letter in letters for row in self._rows[letter]]
        return compile_lanes(name, formula, inputs, self._names, self._absent, outputs), outputs

    def _count(self, letters: str) -> int:
        return sum(len(self._rows[letter]) for letter in letters)

    def _of(self, numbers: Mapping[str, Any], letter: str) -> list:
        return [numbers[row] for row in self._rows[letter]]

    def _lifted(self, xp: Any, numbers: Mapping[str, Any], letter: str) -> list:
        y = self._of(numbers, letter)
        return y if self._angle is None else [*y, xp.cos(y[self._angle]), xp.sin(y[self._angle])]

    def _constants(self, numbers: Mapping[str, Any]) -> SimpleNamespace:
        return SimpleNamespace(**{name.removeprefix("k_"): numbers[name] for name in self._names})

    def _control_of(self, xp: Any, numbers: Mapping[str, Any]) -> list:
        top = self._formulas.largest
        a = [clip(x, -top, top, xp) for x in self._of(numbers, "a")]
        y, k = self._lifted(xp, numbers, "y"), self._constants(numbers)
        return self._formulas.control(xp, a, y, self._of(numbers, "g"), k)

    def _outcome_of(self, xp: Any, numbers: Mapping[str, Any]) -> tuple[Any, Any]:
        y, z = (self._lifted(xp, numbers, letter) for letter in "yz")
        u, g, k = self._of(numbers, "u"), self._of(numbers, "g"), self._constants(numbers)
        reward, ended = self._formulas.outcome(xp, y, z, u, g, k)
        if self._formulas.has_last:
            reward = xp.where(ended, self._formulas.last(xp, y, z, u, g, k), reward)
        return reward, ended

    def _observe_of(self, xp: Any, numbers: Mapping[str, Any], letter: str) -> list:
        y, g = self._lifted(xp, numbers, letter), self._of(numbers, "g")
        return self._formulas.observe(xp, y, g, self._constants(numbers))

    @cached_property
    def _control(self) -> tuple[Callable, int]:
        return self._compile("control", "yag", self._control_of, self._count("u"))

    @cached_property
    def _observe(self) -> tuple[Callable, int]:
        return self._compile(
            "observe", "yg", lambda xp, numbers: self._observe_of(xp, numbers, "y"), self._count("o")
        )

    @cached_property
    def _outcome(self) -> tuple[Callable, int]:
        def outcome(xp: Any, numbers: Mapping[str, Any]) -> list:
            reward, ended = self._outcome_of(xp, numbers)
            return [reward, xp.where(ended, 1.0, 0.0)]

        return self._compile("outcome", "yzug", outcome, 2)

    @cached_property
    def _after(self) -> tuple[Callable, int]:
        seeds = {"o": [f"seed_{row}" for row in self._rows["o"]], "e": [f"seed_{r}" for r in self._rows["e"]]}

        def after(xp: Any, numbers: Mapping[str, Any]) -> list:
            reward, _ = self._outcome_of(xp, numbers)
            seen = self._observe_of(xp, numbers, "e")
            by = [numbers[row] for letter in "yzug" for row in self._rows[letter]]
            kicked = self._of(numbers, "e")
            outputs = [reward, *seen]
            given = [numbers["seed_r"], *(numbers[name] for name in seeds["o"])]
            found = xp.adjoint(outputs, given, [*by, *kicked, *(numbers[name] for name in self._by)])
            first = self._count("y")
            ends = found[len(by) : len(by) + len(kicked)]
            for i, (own, seed) in enumerate(zip(ends, seeds["e"], strict=True)):
                found[first + i] = found[first + i] + own + numbers[seed]
            return found[: len(by)] + found[len(by) + len(kicked) :]

        self._rows["s"] = [*seeds["e"], *seeds["o"], "seed_r"]
        return self._compile("after", "yzuges", after, self._count("yzug") + len(self._by))

    @cached_property
    def _before(self) -> tuple[Callable, int]:
        self._rows["c"] = [f"seed_{row}" for row in self._rows["u"]]

        def before(xp: Any, numbers: Mapping[str, Any]) -> list:
            by = [numbers[row] for letter in "yag" for row in self._rows[letter]]
            seeds = self._of(numbers, "c")
            return xp.adjoint(
                self._control_of(xp, numbers), seeds, [*by, *(numbers[name] for name in self._by)]
            )

        return self._compile("before", "yagc", before, self._count("yag") + len(self._by))
