"""Plans for swing-ups, on a task that is easier to plan for than if it rewards the height's fourth power."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from lag_envs.controllers.basic import Array, check_names, check_single_control
from lag_envs.tasks.base import Task


def easier(
    task: Task,
    *,
    end: Mapping[str, float],
    effort: float,
    share: float = 0.9,
    walls: Mapping[str, float] | None = None,
    every: int = 1,
) -> tuple[Task, Callable[[Array], Array]]:
    """Return a task that is easier to plan for, and the final cost of a plan.

    This task weighs a plan's end most and its course only a little. The control is weaker, so that the
    feedback has a reserve for correcting the plan.

    Parameters
    ----------
    task : Task
        The task; its `plans` give the rest at which a plan should end.
    end : mapping
        Final cost for each state entry: the weight of its squared distance from rest or, for angles, of twice
        1 minus its cosine.
    effort : float
        Cost of a step with the largest control.
    share : float
        Largest control, as a share of the task's.
    walls : mapping, optional
        Limits of the sizes of state entries; steps beyond nine tenths of a limit are penalised.
    every : int
        Number of the task's steps for which each control is held.
    """
    kind: Any = type(task)
    check_single_control("easier", task)
    (acting,) = task.formulas.acting
    if acting.low != -acting.high:
        raise ValueError(
            f"plans for an easier task need a control as strong in both directions; that of {kind.__name__} "
            f"goes from {acting.low:g} to {acting.high:g}"
        )
    (name,) = kind.action
    most = share * float(task.limit_control)

    class Easier(kind):
        id = ""
        action: ClassVar = {name: most}
        last_reward = Task.last_reward

        def terminated(self, after: Any, target: Any, xp: Any) -> Any:
            return False

        def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
            a = control[name] * (1.0 / most)
            cost = effort * a * a
            for entry, size in (walls or {}).items():
                over = xp.maximum(xp.abs(after[entry]) * (1.0 / size) - 0.9, 0.0)
                cost = cost + 300.0 * over * over
            return -cost

    rest = dict(zip(task.scene.state_names, task.plans.rest, strict=True))
    return task.varied(Easier, dt=every * task.dt), away(task, end, rest)


def away(task: Task, weights: Mapping[str, float], rest: Mapping[str, float]) -> Callable[[Array], Array]:
    """Return the cost of states (n, n_state) by their distance from rest.

    Parameters
    ----------
    task : Task
        The task.
    weights : mapping
        For state entries, the weight of the squared distance; for angles, which have the unit rad, of twice 1
        minus its cosine.
    rest : mapping
        The entries at rest; 0 if not given.

    Raises
    ------
    ValueError
        For names that are not entries of the state.
    """
    names, units = task.scene.state_names, task.scene.state_units
    check_names("weights", weights, names)
    check_names("rest", rest, names)

    def lost(states: Array) -> Array:
        total = np.zeros(len(states))
        for i, (entry, unit) in enumerate(zip(names, units, strict=True)):
            off = states[:, i] - rest.get(entry, 0.0)
            total += weights.get(entry, 0.0) * (2.0 * (1.0 - np.cos(off)) if unit == "rad" else off * off)
        return total

    return lost
