"""Linear-quadratic regulators of any scene: linearised from the Lagrangian, discretised exactly.

A task's cost is its own reward, to second order. Both come from the formulas that the environment is made of,
passed through SymPy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from lag_envs.lagrange import acceleration, coordinates, t
from lag_envs.scenes.base import Scene
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]


class Equations(NamedTuple):
    """``states``' = ``rates``, in symbols; while the control is held."""

    states: tuple[sympy.Symbol, ...]
    control: sympy.Symbol
    rates: tuple[sympy.Expr, ...]


@cache
def equations(scene: Scene) -> Equations:
    """Return the equations of motion in terms of state and control, with the scene's numbers.

    The control, `Scene.control_unit`, is a derivative of the moved coordinate (as many as it has primes), or
    else the coefficient of the drag.
    """
    name = scene.control_unit.split()[0]
    moved, primes = name.rstrip("'"), name.count("'")
    u = sympy.Symbol("u", real=True)
    states = {n: sympy.Symbol(n, real=True) for n in scene.state_names}
    q, v = (vars(c) for c in coordinates(scene))
    free = scene.coordinates[0]
    drag = moved not in q
    formula = acceleration(scene, u if drag else 0)

    def moves(order: int) -> Any:
        """Return a derivative of the moved coordinate."""
        if drag:
            return getattr(scene, "tilt", 0.0) if order == 0 else 0.0
        if order >= primes:
            return u if order == primes else 0.0
        return states.get(f"{moved}{'_dot' * order}", 0.0)

    # A rolling cylinder's speed on a turning plane hides in w = x' + R phi'.
    speed = states.get(f"{free}_dot")
    if speed is None:
        speed = states["w"] - scene.radius * moves(1)  # type: ignore[attr-defined]
    pairs = [(q[c].diff(t, 2), moves(2)) for c in scene.coordinates[1:]]
    pairs += [(v[c], moves(1)) for c in scene.coordinates[1:]] + [(v[free], speed)]
    pairs += [(q[c], moves(0)) for c in scene.coordinates[1:]] + [(q[free], states[free])]
    for old, new in pairs:
        formula = formula.subs(old, new)
    formula = formula.subs(
        {
            sympy.Symbol(f.name, positive=True): getattr(scene, f.name)
            for f in dataclasses.fields(scene)
            if "unit" in f.metadata and getattr(scene, f.name) is not None
        }
    )

    def rate(state: str) -> Any:
        if state == free:
            return speed
        if state in (f"{free}_dot", "w"):
            return formula
        return moves(1 + state.endswith("_dot"))

    return Equations(tuple(states.values()), u, tuple(sympy.sympify(rate(n)) for n in states))


def linearise(scene: Scene, state: Sequence[float], control: float = 0.0) -> tuple[Array, Array]:
    """Return A and B of δx' = A δx + B δu near a state and control, shapes (n, n) and (n, 1).

    Parameters
    ----------
    scene : Scene
        The scene.
    state : sequence of float, shape (n,)
        An equilibrium, in the order of ``scene.state_names``.
    control : float
        The control that is held there.
    """
    eqs = equations(scene)
    at = dict(zip((*eqs.states, eqs.control), (*state, control), strict=True))
    slopes = sympy.Matrix(eqs.rates).jacobian([*eqs.states, eqs.control]).subs(at)
    slopes = np.array(slopes.tolist(), np.float64)
    return slopes[:, :-1], slopes[:, -1:]


def discretise(a: Array, b: Array, dt: float) -> tuple[Array, Array]:
    """Return A and B of a step of length dt with the control held; exact, by a matrix exponential."""
    n = len(a)
    held = expm(dt * np.block([[a, b], [np.zeros((1, n + 1))]]))
    return held[:n, :n], held[:n, n:]


def cost(task: Task, state: Sequence[float], control: float = 0.0, target: float = 0.0) -> Array:
    """Return the matrix C of a step's loss (x, u)' C (x, u), the reward's to second order.

    Parameters
    ----------
    task : Task
        The task.
    state : sequence of float, shape (n,)
        The equilibrium about which to expand.
    control, target : float
        The control there, and the target.
    """
    scene = task.scene
    x = [sympy.Symbol(name, real=True) for name in (*scene.state_names, "u")]
    lifted = list(x[:-1])
    if scene.angle is not None:
        lifted += [sympy.cos(x[scene.angle]), sympy.sin(x[scene.angle])]
    k = SimpleNamespace(**task.constants())
    reward = task.reward(lifted, lifted, x[-1], target, k, task.dt, sympy)
    curvature = sympy.hessian(reward, x).subs(dict(zip(x, (*state, control), strict=True)))
    return -0.5 * np.array(curvature.tolist(), np.float64)


def regulator(
    task: Task,
    state: Sequence[float],
    control: float = 0.0,
    target: float = 0.0,
    extra: Mapping[str, float] | None = None,
) -> tuple[Array, Array]:
    """Return K of δu = -K δx, shape (n,), and P of the cost to go δx'Pδx, near an equilibrium.

    Parameters
    ----------
    task : Task
        The task; its reward to second order is what the regulator optimises.
    state, control, target : sequence of float, float, float
        The equilibrium.
    extra : mapping of str to float, optional
        What a step of the task's own interval is to cost besides: weights of the squares of states, by name,
        and of "u".
    """
    c = cost(task, state, control, target)
    names = [*task.scene.state_names, "u"]
    for name, weight in (extra or {}).items():
        c[names.index(name), names.index(name)] += weight * task.dt / task.interval
    a, b = discretise(*linearise(task.scene, state, control), task.dt)
    q, r = c[:-1, :-1], c[-1:, -1:]
    p = solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)[0], p
