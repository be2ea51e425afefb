"""Controllers of chains of bars on a moving support."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import Array
from lag_envs.controllers.ilqr import ILQR
from lag_envs.controllers.linear import BalanceLQR
from lag_envs.controllers.mpc import MPC, held, loss, without_kicks
from lag_envs.controllers.tracking import Tracking, hold, recorded
from lag_envs.envs.model import Model
from lag_envs.tasks.base import Task
from lag_envs.tasks.chain import Balance, SwingUp


def easier(
    task: SwingUp, *, effort: float, share: float = 0.9, edge: float = 0.9
) -> tuple[Task, Callable[[Array], Array]]:
    """Return a task that is easier to plan for, and the final cost of a plan.

    In place of the guard, which has kinks, the task has a penalty that begins before the track's end. Its
    reward is the squared height, whose slope leads upward from anywhere and which hardly matters compared
    with the final cost. The support is weaker than in the original task, so that the feedback has a reserve
    for correcting the plan.

    Parameters
    ----------
    task : SwingUp
        The task.
    effort : float
        Cost of a step with the largest acceleration.
    share : float
        Largest acceleration, as a share of the task's.
    edge : float
        A support that could not stop within this share of the track, braking fully, is penalised.
    """
    kind: Any = type(task)

    class Easier(kind):
        id = ""
        draws, kick = 0, Task.kick
        largest = share * task.largest

        def guard(self, wanted: Any, before: Any, dt: Any, xp: Any) -> Any:
            return wanted

        def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
            a = control.s_ddot * (1.0 / task.largest)
            stop = after.s + after.s_dot * xp.abs(after.s_dot) * (0.5 / task.largest)
            over = xp.maximum(xp.abs(stop) * (1.0 / self.length) - edge, 0.0)
            height = self.height(after, xp)
            return 0.1 * (height * height) - effort * (a * a) - 300.0 * (over * over)

    def end(states: Array) -> Array:
        s, s_dot, angles, rates = states[:, 0], states[:, 1], states[:, 2::2], states[:, 3::2]
        away = 2.0 * (1.0 + np.cos(angles)).sum(axis=1) + 0.01 * (rates**2).sum(axis=1)
        return 10.0 * (away + 0.3 * (s / task.length) ** 2 + 0.1 * s_dot**2)

    return task.varied(Easier), end


def replan(task: SwingUp, *, guesses: Sequence[Tracking] = (), beyond: float = 1.6) -> ILQR:
    """Return an iLQR that plans each episode anew, starting from recorded plans.

    Parameters
    ----------
    task : SwingUp
        The task, ``env.unwrapped.task``.
    guesses : sequence of Tracking, optional
        Initial guesses; by default a plan that was recorded with the full control, its mirror image, and the
        plan that is followed from any start.
    beyond : float
        How far to plan, as a multiple of the longest guess.
    """
    if not guesses:
        quick = recorded(task, "quick")
        guesses = [quick, quick.mirrored(), recorded(task)]
    ahead = round(beyond * max(len(plan.actions) for plan in guesses))
    return ILQR(task, guesses, after=hold(task), tail=loss(task), steps=ahead)


def anywhere(task: SwingUp, *, horizon: int = 90, good: float = 3.0, **numbers: Any) -> MPC:
    """Return an MPC that plans at the start and after each kick, and leaves holding to a regulator.

    Parameters
    ----------
    task : SwingUp
        The task, ``env.unwrapped.task``.
    horizon : int
        Steps to plan ahead.
    good : float
        A plan counts as good if the loss after its end is below this.
    **numbers
        Other arguments of `MPC`, and of `held`.
    """
    easy = easier(task, effort=0.05, share=1.0, edge=0.95)
    return held(
        task, horizon=horizon, good=good, easier=easy, **({"every": horizon, "iterations": 6} | numbers)
    )


def rescued(task: Balance, *, weights: Mapping[str, float], trial: int = 60, **numbers: Any) -> MPC:
    """Return a regulator that hands over to an MPC in states from which it would lose the bars.

    Parameters
    ----------
    task : Balance
        The task, ``env.unwrapped.task``.
    weights : mapping
        Weights of the regulator, see `BalanceLQR`.
    trial : int
        Number of steps without kicks for which the regulator must keep the bars upright.
    **numbers
        Other arguments of `MPC`.
    """
    lqr, model = BalanceLQR(task, **weights), Model(without_kicks(task))
    holding = Tracking(
        task, states=[lqr.rest], actions=[], gains=np.empty((0, len(lqr.rest))), rest=lqr.rest,
        hold=lqr.gain / task.limit_control,
    )  # fmt: skip

    def survives(states: Array) -> NDArray[np.bool_]:
        alive, forever = np.ones(len(states), np.bool_), np.full(len(states), np.inf)
        for _ in range(trial):
            states, _, ended = model(states, holding.act(states, forever, forever))
            alive &= ~ended
        return alive

    def lost(states: Array) -> Array:
        off = states - lqr.rest
        return np.minimum(np.einsum("ni,ij,nj->n", off, lqr.cost, off), 1e4)

    return MPC(task, lost, hold=holding, holds=survives, **numbers)
