"""Reverse mode through a task's step: from gradients of its results to gradients of its arguments.

A step is control, motion, reward and observation. Each part's derivatives are recorded from its formulas
(`lag_envs.stepping.adjoint`). If the motion has a flow of its own, the whole step is one record. Otherwise,
and for steps of the flow that are not ordinary, there are three parts: the formulas after the motion,
`Scene.vjp`, and the formulas before it. Few steps end an episode, so a task's last reward, which may be a
long formula, has a record of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes.derivation import code_of, form_of
from lag_envs.scenes.steps import check_turns, derivatives_of, vjp_of_rows
from lag_envs.stepping.adjoint import Differentiable, LaneFormula
from lag_envs.stepping.compiling import split_lengths
from lag_envs.stepping.normal_forms import lifted
from lag_envs.stepping.tracing import Trace, clip
from lag_envs.tasks.base import Task
from lag_envs.tasks.formulas import NUMBERS

Array = NDArray[np.float64]

#: Number of rows that go through the parts of a step together: few enough that intermediate results stay in a
#: cache.
ROWS = 4096


class Reverse:
    """A task's formulas before and after the motion, and their derivatives, for many rows.

    Parameters
    ----------
    task : Task
        The task.
    parameters : tuple of str
        Names of the scene's parameters with respect to which derivatives are wanted.

    Raises
    ------
    ValueError
        For a task whose actions are choices.
    """

    def __init__(self, task: Task, parameters: tuple[str, ...] = ()) -> None:
        formulas = self._formulas = task.formulas
        self._task, self._parameters = task, parameters
        if formulas.choices:
            raise ValueError(
                f"{type(task).__name__} has a list of actions to choose from; choices have no derivatives"
            )
        constants = task.formulas.constants()
        # Formulas may use the normal form's constants (`Task.coefficients`), which depend on parameters too.
        rates = derivatives_of(task.scene, parameters).rates if parameters else {}
        self._moving = [name for name in rates if name in constants]
        _check_parameters(task, parameters)
        constants |= {
            f"rate_{name}_{p}": x
            for name in self._moving
            for p, x in zip(parameters, rates[name], strict=True)
        }
        self._constants = [f"k_{name}" for name in constants]
        self._numbers = np.array([*constants.values()])
        self._absent = {f"k_{name}" for name, value in constants.items() if value == 0.0}
        sizes = {"y": len(formulas.state), "a": formulas.actions, "g": formulas.targets}
        sizes |= {"z": sizes["y"], "u": formulas.controls, "e": sizes["y"]}
        sizes |= {"by_e": sizes["y"], "by_o": len(formulas.observation), "by_r": 1, "by_u": sizes["u"]}
        sizes |= {"own_y": sizes["y"], "own_u": sizes["u"], "own_g": sizes["g"]}
        sizes["own_p"] = len(parameters) + len(self._moving)
        sizes |= {"moved": sizes["y"] + sizes["u"] + len(parameters)}
        self._names = {array: [f"{array}{i}" for i in range(n)] for array, n in sizes.items()}
        self._form = form_of(task.scene)
        self._compiled: dict[str, LaneFormula] = {}

    def observations(self, states: Array, targets: Array) -> Array:
        """Return the observations of states (n, n_state) with targets (n, n_targets)."""
        return self._lanes("observe", self._observe_of, "y", "g")(self._numbers, states, targets)[0]

    def vjp(
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
        """Pull a gradient of a step's results back to states, actions, targets and parameters.

        Parameters
        ----------
        states, actions, targets : ndarray, shape (n, ...)
            The arguments of the steps, all with two axes; they are not checked.
        ends, after : ndarray, shape (n, n_state)
            The states after the motion, and after the kick too; the same array if there was no kick.
        by_states, by_observations, by_rewards : ndarray, shape (n, n_state), (n, n_observations), (n,)
            The gradient with respect to `after`, its observations, and the rewards.

        Returns
        -------
        list of ndarray, shape (n, ...)
            Not finite in rows whose given gradient is not finite or is too large; these rows do not affect
            the other rows.
        """
        check_turns(self._task.scene, states)
        check_turns(self._task.scene, ends)
        given = states, actions, targets, ends, after, by_states, by_observations, by_rewards[:, None]
        kicked = after is not ends
        count = len(states)
        if self._form is None or self._parameters:
            sizes = [x.shape[1] for x in given[:3]] + [len(self._parameters)]
            found, others = [np.empty((size, count)).T for size in sizes], np.arange(count)
        else:
            *found, ordinary = self._whole(kicked)(self._numbers, *given)
            (others,) = np.nonzero(ordinary[:, 0] != 1.0)
        for first in range(0, len(others), ROWS):
            rows = others[first : first + ROWS]
            at: Any = slice(first, first + ROWS) if len(others) == count else rows
            out = [x[at] for x in found]  # no copies where `at` is a slice
            self._in_parts(out, kicked, rows, *(x[at] for x in given))
            if at is rows:
                for x, some in zip(found, out, strict=True):
                    x[at] = some
        return found

    def _in_parts(
        self, out: list[Array], kicked: bool, rows: Any, y: Array, a: Array, g: Array, z: Array, *rest: Array
    ) -> None:
        """Do the same as `vjp`, into `out`, with the motion as a part of its own; errors name `rows`."""
        results = self._after(kicked)(self._numbers, y, a, g, z, *rest)
        last = np.flatnonzero(results[-1][:, 0] != 0.0)
        if len(last):
            given = (x[last] for x in (y, a, g, z, *rest))
            for x, some in zip(results, self._after(kicked, last=True)(self._numbers, *given), strict=True):
                x[last] = some
        u, own_y, own_z, *own, _ = results
        moved = vjp_of_rows(self._task.scene, y, u, self._task.dt, own_z, self._parameters, rows)
        before = self._lanes(
            "before", self._before_of, "y", "a", "g", "own_y", "own_u", "own_g", "own_p", "moved"
        )
        before(self._numbers, y, a, g, own_y, *own, moved, out=out)

    # --- formulas ------------------------------------------------------------------------------------------

    def _lanes(self, name: str, formula: Callable, *arrays: str) -> LaneFormula:
        """Return a formula, compiled on first use; `arrays` are its arguments."""

        def of_numbers(xp: Differentiable, numbers: dict[str, Any]) -> list[list]:
            given = {array: [numbers[name] for name in self._names[array]] for array in arrays}
            k = SimpleNamespace(**{name.removeprefix("k_"): numbers[name] for name in self._constants})
            return formula(xp, k, **given)

        if name not in self._compiled:
            names = [self._names[array] for array in arrays]
            self._compiled[name] = LaneFormula(name, of_numbers, names, self._constants, self._absent)
        return self._compiled[name]

    def _whole(self, kicked: bool) -> LaneFormula:
        name = "whole_kicked" if kicked else "whole"
        formula = partial(self._whole_of, kicked)
        return self._lanes(name, formula, "y", "a", "g", "z", "e", "by_e", "by_o", "by_r")

    def _after(self, kicked: bool, last: bool = False) -> LaneFormula:
        name = ("last" if last else "after") + ("_kicked" if kicked else "")
        formula = partial(self._after_of, kicked, last)
        return self._lanes(name, formula, "y", "a", "g", "z", "e", "by_e", "by_o", "by_r")

    def _parameters_of(self, k: Any) -> list:
        """Return the parameters, and the constants that depend on them."""
        return [getattr(k, f"self_{name}") for name in self._parameters] + [
            getattr(k, name) for name in self._moving
        ]

    def _control_of(self, xp: Any, k: Any, y: list, a: list, g: list) -> list:
        top = self._formulas.largest
        return self._formulas.control(
            xp, [clip(x, -top, top, xp) for x in a], lifted(self._form, y, xp), g, k
        )

    def _reward_of(self, last: bool, xp: Any, k: Any, y: list, u: list, g: list, z: list) -> tuple[Any, Any]:
        """Return the reward of an ordinary step, and 1 if the step ends the episode, else 0.

        With `last`, return the reward of a step that ends the episode, and 0.
        """
        given = lifted(self._form, y, xp), lifted(self._form, z, xp), u, g, k
        if last:
            return self._formulas.last(xp, *given), 0.0
        if not self._formulas.has_last:
            return self._formulas.reward(xp, *given), 0.0
        reward, ended = self._formulas.outcome(xp, *given)
        return reward, xp.where(ended, 1.0, 0.0)

    def _observe_of(self, xp: Any, k: Any, y: list, g: list) -> list[list]:
        return [self._formulas.observe(xp, lifted(self._form, y, xp), g, k)]

    def _after_of(
        self,
        kicked: bool,
        last: bool,
        xp: Any,
        k: Any,
        y: list,
        a: list,
        g: list,
        z: list,
        e: list,
        **seeds: list,
    ) -> list[list]:
        """Record the controls, and the way back to the motion's end and past it.

        The results are u, the cotangents of y, z, u, g and parameters, and the second result of `_reward_of`.
        """
        u, e = self._control_of(xp, k, y, a, g), e if kicked else z
        reward, ended = self._reward_of(last, xp, k, y, u, g, z)
        outputs = [reward, *self._observe_of(xp, k, e, g)[0], *e]
        by = [y, z, u, g, self._parameters_of(k), e if kicked else []]
        bars = [x for name in ("by_r", "by_o", "by_e") for x in seeds[name]]
        found = xp.adjoint(outputs, bars, [x for numbers in by for x in numbers])
        own_y, own_z, *rest, own_e = split_lengths(found, *map(len, by[:-1]))
        return [u, own_y, _sums(own_z, own_e) if kicked else own_z, *rest, [ended]]

    def _before_of(self, xp: Any, k: Any, y: list, a: list, g: list, **found: list) -> list[list]:
        """Record the way back from the controls, and all sums: cotangents of y, a, g and parameters."""
        by_y, by_u, by_p = split_lengths(found["moved"], len(y), len(found["own_u"]))
        by = [y, a, g, self._parameters_of(k)]
        bars = _sums(found["own_u"], by_u)
        own = xp.adjoint(self._control_of(xp, k, y, a, g), bars, [x for numbers in by for x in numbers])
        last_y, last_a, last_g, last_p = split_lengths(own, *map(len, by[:-1]))
        (own_p, own_c), (last_p, last_c) = (split_lengths(x, len(by_p)) for x in (found["own_p"], last_p))
        by_y, by_p = _sums(found["own_y"], by_y, last_y), _sums(own_p, by_p, last_p)
        for name, bar in zip(self._moving, _sums(own_c, last_c), strict=True):
            by_p = _sums(by_p, [bar * getattr(k, f"rate_{name}_{p}") for p in self._parameters])
        return [by_y, last_a, _sums(found["own_g"], last_g), by_p]

    def _whole_of(self, kicked: bool, xp: Any, k: Any, y: list, a: list, g: list, **rest: list) -> list[list]:
        """Record the way back through the whole step: cotangents of y, a, g, no parameters.

        The last result is 1 where the whole record is valid: the step is ordinary, and the episode goes on.
        """
        code: Any = code_of(self._task.scene, self._task.dt)
        after = self._after_of(kicked, False, xp, k, y=y, a=a, g=g, **rest)
        u, own_y, own_z, own_u, own_g, _, (ended,) = after
        moved, ordinary = code.record_vjp(xp, y, u, k, own_z, [*y, *u])
        own = {"own_y": own_y, "own_u": own_u, "own_g": own_g, "own_p": []}
        by = self._before_of(xp, k, y, a, g, moved=moved, **own)
        return [*by, [xp.where(ordinary, 1.0, 0.0) - ended]]


def kick_depends_on_state(task: Task) -> bool:
    """Return whether what a task's random kick adds to the state depends on the state."""
    formulas, xp = task.formulas, Trace()
    z = xp.inputs(*(f"z{i}" for i in range(len(formulas.state))))
    draws = xp.inputs(*(f"draw{i}" for i in range(task.draws)))
    k = SimpleNamespace(**formulas.constants())
    added = formulas.added(xp, draws, lifted(form_of(task.scene), z, xp), k)
    operations, results = xp.operations(added.values())
    used = {*results, *(arg for operation in operations for arg in operation.args)}
    return any(x.name in used for x in z)


def _check_parameters(task: Task, parameters: tuple[str, ...]) -> None:
    """Raise a ValueError if the task computes a number from one of the parameters outside of its formulas.

    Such a number is a constant in the formulas, so a gradient would lack what it contributes.
    """
    for name in parameters:
        near = _neighbours(task, name)
        if len({each.formulas.recorded() for each in near}) < 2:
            continue
        one, other = near
        kept = [
            f"self.{key}"
            for key, value in vars(one).items()
            if key not in NUMBERS and repr(value) != repr(vars(other).get(key))
        ]
        if one.formulas.acting != other.formulas.acting or one.formulas.largest != other.formulas.largest:
            kept.append("the limits of its actions")
        raise ValueError(
            f"{type(task).__name__} computes {' and '.join(kept) or 'a number'} from {name} outside of its "
            f"formulas, so a gradient by {name} would lack that part; use self.scene.{name} in a formula "
            f"instead, or leave {name} out"
        )


def _neighbours(task: Task, name: str) -> list[Task]:
    """Return two tasks with other values of a parameter, not 0; nothing if it cannot be changed."""
    scene = task.scene
    value, held = getattr(scene, name), {n: getattr(scene, n) for n in parameter_names(scene)}
    for way in (1e-3, -1e-3):
        step = way * (abs(value) or 1.0)
        with suppress(ValueError, TypeError, ArithmeticError):
            return [task.varied(**held | {name: value + step * i}) for i in (1, 2)]
    return []


def _sums(*lists: list) -> list:
    return [sum(numbers) for numbers in zip(*lists, strict=True)]
