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
from lag_envs.scenes.steps import pulled
from lag_envs.stepping.adjoint import compile_lanes
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]


class Reverse:
    """What a task computes before and after the motion, and its derivatives, for many rows.

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
        self._task, self._parameters = task, parameters
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

    def observations(self, states: Array, targets: Array) -> Array:
        """Return the observations of states (n, n_state) with targets (n, n_targets)."""
        return self._run(self._observe, states.T, targets.T).T

    def pull(
        self,
        states: Array,
        actions: Array,
        targets: Array,
        ends: Array,
        after: Array,
        by_states: Array,
        by_observations: Array,
        by_rewards: Array,
    ) -> list[Array]:
        """Return a gradient by states, actions, targets and parameters from one by a step's results.

        Parameters
        ----------
        states, actions, targets : ndarray, shape (n, ...)
            Where steps begin, all with two axes. What is given here is not checked.
        ends, after : ndarray, shape (n, n_state)
            The states after the motion, and after the kick too.
        by_states, by_observations, by_rewards : ndarray, shape (n, n_state), (n, n_observations), (n,)
            The gradient by `after`, by its observations, and by the rewards.
        """
        y, a, g, z = states.T, actions.T, targets.T, ends.T
        u = self._run(self._control, y, a, g)
        seeds = by_states.T, by_observations.T, by_rewards[None]
        own_y, own_z, own_u, own_g, own_p = self._split(
            self._run(self._after, y, z, u, g, after.T, *seeds), "yzug"
        )
        dt, scene = self._task.dt, self._task.scene
        moved = pulled(scene, np.ascontiguousarray(states), u.T.copy(), dt, own_z.T, self._parameters)
        by_y, by_u, by_p = np.split(moved.T, [len(y), len(y) + len(u)])
        last_y, last_a, last_g, last_p = self._split(self._run(self._before, y, a, g, own_u + by_u), "yag")
        return [(own_y + by_y + last_y).T, last_a.T, (own_g + last_g).T, (own_p + by_p + last_p).T]

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

    def _reward_of(self, xp: Any, numbers: Mapping[str, Any]) -> Any:
        y, z = (self._lifted(xp, numbers, letter) for letter in "yz")
        given: tuple[Any, ...] = (
            y,
            z,
            self._of(numbers, "u"),
            self._of(numbers, "g"),
            self._constants(numbers),
        )
        if not self._formulas.has_last:
            return self._formulas.reward(xp, *given)
        reward, ended = self._formulas.outcome(xp, *given)
        return xp.where(ended, self._formulas.last(xp, *given), reward)

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
    def _after(self) -> tuple[Callable, int]:
        seeds = {"o": [f"seed_{row}" for row in self._rows["o"]], "e": [f"seed_{r}" for r in self._rows["e"]]}

        def after(xp: Any, numbers: Mapping[str, Any]) -> list:
            reward = self._reward_of(xp, numbers)
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
            by += [numbers[name] for name in self._by]
            return xp.adjoint(self._control_of(xp, numbers), self._of(numbers, "c"), by)

        return self._compile("before", "yagc", before, self._count("yag") + len(self._by))
