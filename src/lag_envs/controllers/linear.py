"""Linear-quadratic regulators for any scene, from the exact derivatives of its control step.

A task's cost is its own reward to second order, from the environment's own formula, evaluated with SymPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace

import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from lag_envs.controllers.basic import (
    FeedbackController,
    FeedbackLaw,
    check_acts,
    check_continuous,
    check_names,
    check_single_control,
    hold_law,
)
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes.derivation import form_of, layout_of
from lag_envs.scenes.symbolic import Symbolic
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]


def quadratic_cost(task: Task, state: Sequence[float] | Array) -> Array:
    """Return the matrix C of a step's loss (x, u)' C (x, u), the reward's to second order about a state.

    Parameters
    ----------
    task : Task
        The task; its target is taken as 0.
    state : sequence of float, shape (n,)
        The equilibrium without control about which to expand.
    """
    scene, (acting,) = task.scene, task.formulas.acting
    names, form = scene.state_names, form_of(scene)

    def lifted(x: list) -> list:
        angle = [] if form is None or form.angle is None else [x[form.angle]]
        return [*x, *map(sympy.cos, angle), *map(sympy.sin, angle)]

    x = [sympy.Symbol(name, real=True) for name in (*names, "u")]
    before = [sympy.Symbol(f"{name} before", real=True) for name in names]
    u = [x[-1] if name == acting.control else 0.0 for name in scene.control_names]
    states, targets = (lifted(before), lifted(x[:-1])), [0.0] * task.formulas.targets
    k = SimpleNamespace(**task.formulas.constants())
    try:
        reward = sympy.sympify(task.formulas.reward(Symbolic, *states, u, targets, k))
        curvature = sympy.hessian(reward, x).subs(dict(zip(x, (*state, 0.0), strict=True)))
        found = -0.5 * np.array(curvature.tolist(), np.float64)
    except (FormulaError, TypeError) as error:
        raise ValueError(
            f"the regulator needs a smooth reward, without branches; that of {type(task).__name__} is not "
            "(Regulator takes weights instead)"
        ) from error
    if reward.free_symbols & set(before) or found[:-1, -1].any():
        raise ValueError(
            "the regulator needs a reward with separate terms of the state after the step and of the "
            f"control; that of {type(task).__name__} is not (Regulator takes weights instead)"
        )
    return found


def regulator(
    task: Task, state: Sequence[float] | Array, *, extra: Mapping[str, float] | None = None
) -> tuple[Array, Array]:
    """Return K of δu = -K δx, shape (n,), and P of the cost δx'Pδx from here on, near an equilibrium.

    That cost includes the cost of the present state, which the task's reward has paid already.

    Parameters
    ----------
    task : Task
        The task; the regulator optimises its reward to second order.
    state : sequence of float, shape (n,)
        The equilibrium without control and with target 0.
    extra : mapping of str to float, optional
        Additional costs of a step of the task's own interval: weights of the squares of states, by name, and
        of "u".
    """
    check_single_control("regulator", task)
    c = quadratic_cost(task, state)
    names = [*task.scene.state_names, "u"]
    check_names("extra", extra or {}, names)
    for name, weight in (extra or {}).items():
        c[names.index(name), names.index(name)] += weight * task.dt / task.interval
    controls = list(task.scene.control_names)
    a, b = task.scene.jacobian(state, np.zeros(len(controls)), task.dt)
    b = b[:, [controls.index(task.formulas.acting[0].control)]]
    q, r = c[:-1, :-1], c[-1:, -1:]
    p = _cost(a, b, q, r)
    return _gain(a, b, p, r)[0], p


def _cost(a: Array, b: Array, q: Array, r: Array) -> Array:
    """Return P of the least cost x'Px of steps Ax + Bu, each of which costs x'Qx + u'Ru."""
    try:
        return np.asarray(solve_discrete_are(a, b, q, r), np.float64)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            "no regulator: give a weight to every entry of the state that does not come to rest by itself, "
            "and check that the controls can bring it there"
        ) from error


def _gain(a: Array, b: Array, p: Array, r: Array) -> Array:
    """Return K of the best u = -K x, if x'Px is the cost after the step Ax + Bu and u'Ru the cost of u."""
    return np.asarray(np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a), np.float64)


def time_varying(
    task: Task,
    states: Array,
    actions: Array,
    rest: Sequence[float],
    weights: Mapping[str, float],
    effort: float,
) -> tuple[Array, Array]:
    """Return the feedback that keeps a task on a plan, and the feedback that holds it at rest.

    Both minimise the weighted sum of squared deviations. The first is computed backwards from the plan's end,
    where the second takes over.

    Parameters
    ----------
    task : Task
        The task, with continuous actions.
    states : ndarray, shape (steps + 1, n_state)
        The plan's states.
    actions : ndarray, shape (steps,), or (steps, n_actions) where there are several
        Its actions.
    rest : sequence of float, shape (n_state,)
        The equilibrium at the plan's end.
    weights : mapping of str to float
        Weights of squares of deviations, by entry of the state.
    effort : float
        Weight of the square of an action's deviation.

    Returns
    -------
    gains : ndarray, shape (steps, n_state) or (steps, n_actions, n_state)
        K_t of δa = -K_t δx.
    hold : ndarray, shape (n_state,) or (n_actions, n_state)
        The feedback K at rest.
    """
    check_continuous("time_varying", task)
    scene, m = task.scene, task.formulas.actions
    check_names("weights", weights, scene.state_names)
    q, r = np.diag([weights.get(name, 0.0) for name in scene.state_names]), effort * np.eye(m)
    by_action = (task.wanted(np.eye(m)) - task.wanted(np.zeros((m, m)))).T
    a, b = scene.jacobian(rest, task.wanted(np.atleast_2d(task.rest_action))[0], task.dt)
    b = b @ by_action
    p = _cost(a, b, q, r)
    hold = _gain(a, b, p, r)
    gains = np.empty((len(actions), m, len(rest)))
    if len(actions):
        along, by = scene.jacobian(states[:-1], task.wanted(actions), task.dt)
    for t in range(len(actions) - 1, -1, -1):
        a, b = along[t], by[t] @ by_action
        gains[t] = k = _gain(a, b, p, r)
        closed = a - b @ k
        p = q + k.T @ r @ k + closed.T @ p @ closed
    return (gains[:, 0], hold[0]) if m == 1 else (gains, hold)


class Regulator(FeedbackController):
    """Hold a rest by a linear-quadratic regulator of the exact control step.

    The rest does not depend on the task's target.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``; its actions must include zero control.
    at : mapping, optional
        Nonzero entries of the state at rest.
    weights : mapping
        Cost of the square of each state entry, per step.
    effort : float
        Cost of the squared control, as a share of the largest control.
    """

    def __init__(
        self,
        task: Task,
        *,
        weights: Mapping[str, float],
        effort: float,
        at: Mapping[str, float] | None = None,
    ) -> None:
        check_acts("Regulator", task)
        super().__init__(task, complete=True)
        scene, at = task.scene, at or {}
        check_names("at", at, scene.state_names)
        check_names("weights", weights, scene.state_names)
        for name, weight in weights.items():
            if not 0.0 <= weight < np.inf:
                raise ValueError(f"weights: that of {name} must be finite and at least 0, got {weight}")
        if not 0.0 < effort < np.inf:
            raise ValueError(f"effort must be finite and above 0, got {effort}")
        self.rest = np.array([at.get(name, 0.0) for name in scene.state_names])
        self._check_rest(task)
        columns = [scene.control_names.index(a.control) for a in task.formulas.acting]
        a, b = scene.jacobian(self.rest, np.zeros(len(scene.control_names)), task.dt)
        b = b[:, columns]
        q = np.diag([weights.get(name, 0.0) for name in scene.state_names])
        r = effort * np.diag(1.0 / np.atleast_1d(task.limit_control) ** 2)
        self.cost = _cost(a, b, q, r)
        self.gain = _gain(a, b, self.cost, r)

    def _check_rest(self, task: Task) -> None:
        """Raise a ValueError if the state does not stay at rest without control."""
        scene = task.scene
        for acting in task.formulas.acting:
            if not acting.low <= 0.0 <= acting.high:
                raise ValueError(
                    f"the regulator holds a rest without control, but {acting.control} of "
                    f"{type(task).__name__} goes from {acting.low:g} to {acting.high:g}"
                )
        (after,) = scene.simulate(self.rest, np.zeros((1, len(scene.control_names))), task.dt)[1:]
        moved = np.abs(self.read.difference(after, self.rest))
        if moved.max() > 1e-6 * max(1.0, np.abs(self.rest).max()):
            raise ValueError(
                f"at: the regulator holds a rest without control, but within a step from there "
                f"{scene.state_names[moved.argmax()]} changes by {moved.max():.3g}"
            )

    def off(self, state: Array) -> Array:
        """Return states relative to rest, by the shorter way around."""
        return self.read.difference(state, self.rest)

    def cost_to_go(self, state: Array) -> Array:
        """Return the regulator's expected cost from given states."""
        off = self.off(state)
        return np.einsum("...i,ij,...j->...", off, self.cost, off)

    def control(self, state: Array, target: Array) -> Array:
        """Return -K times the distance from rest."""
        u = -self.off(state) @ self.gain.T
        return u[..., 0] if self.gain.shape[0] == 1 else u

    def law(self, task: Task) -> FeedbackLaw | None:
        """Return the controller as feedback; None if there are several lists of actions."""
        if task.formulas.choices and task.formulas.actions > 1:
            return None
        return hold_law(task, self.rest, self.gain, self.read)


class BalanceLQR(FeedbackController):
    """Keep bodies on a moving support upright by a linear-quadratic regulator, despite kicks.

    The reward alone would make the regulator react as hard as possible; the added weights keep it ready for
    the next kick. They were found by ``python -m agents.tune``.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``; the upright rest is taken from its examples.
    effort : float
        Weight of (u/U)².
    slide, turn : float
        Weights of s'² [s²/m²] and of the angles' rates squared [s²].
    """

    def __init__(self, task: Task, *, effort: float = 0.03, slide: float = 0.67, turn: float = 1.04) -> None:
        super().__init__(task)
        self.rest = np.array(task.examples.rest)
        rates = {f"{name}_dot": turn for name in layout_of(task.scene).free}
        extra = {"u": effort / task.limit_control**2, "s_dot": slide, **rates}
        self.gain, self.cost = regulator(task, self.rest, extra=extra)

    def control(self, state: Array, target: Array) -> Array:
        """Return the support's acceleration."""
        return -(state - self.rest) @ self.gain

    def law(self, task: Task) -> FeedbackLaw:
        """Return the controller as feedback."""
        return hold_law(task, self.rest, self.gain, self.read)
