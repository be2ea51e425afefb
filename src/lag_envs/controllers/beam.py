"""Beam search on the exact model, for tasks whose actions are listed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import Agent, Array, ObservationDecoder, beginning, check_counts
from lag_envs.controllers.mpc import without_kicks
from lag_envs.controllers.swing_up import away
from lag_envs.envs.model import Model
from lag_envs.tasks.base import Task

#: Standard deviation of an angle that is spread evenly over a turn [rad].
_EVEN = math.pi / math.sqrt(3.0)


class Trajectory(NamedTuple):
    """A sequence of actions from a state.

    Attributes
    ----------
    states : ndarray, shape (steps, n_state)
        The states before the steps.
    choices : ndarray of int, shape (steps,)
        Indices into the planner's `actions`.
    rewards : ndarray, shape (steps,)
        The rewards.
    ended : bool
        Whether the last step terminates the episode.
    """

    states: Array
    choices: NDArray[np.intp]
    rewards: Array
    ended: bool


class Followed(NamedTuple):
    """The plan that each episode follows; `left` is the return of its steps from here on."""

    step: NDArray[np.intp]  # (n,)
    length: NDArray[np.intp]  # (n,)
    wait: NDArray[np.intp]  # (n,), steps until a surprise may cause the next search
    ended: NDArray[np.bool_]  # (n,)
    states: Array  # (n, horizon, n_state)
    choices: NDArray[np.intp]  # (n, horizon)
    left: Array  # (n, horizon)


class BeamSearch(Agent):
    """Search for the best sequence of listed actions on the exact model, and follow it.

    All states of a level are stepped with all actions. The resulting states are divided into cells, and only
    the best state of each cell is kept; the best `width` of these form the next level. States are ranked by
    their return so far minus their final cost. The edges of a cell are a share of the states' standard
    deviations, so `cell` has no unit, and cells grow with the level's spread.

    A search ends once a sequence that terminates pays at least as much as any other sequence can. The other
    sequences are credited with the largest reward seen so far for each remaining step, or with nothing if all
    rewards are negative.

    The model agrees with an environment only to rounding. If an observed state differs from the plan, the
    rest of the plan is tried from that state. If it then pays less than before, a new search is made. The
    chance of future kicks is ignored.

    Parameters
    ----------
    task : Task
        The task, with listed actions.
    tail : callable, optional
        Final cost, from states (n, n_state) to numbers (n,).
    horizon : int
        Steps to plan ahead.
    width : int
        Largest number of states of a level.
    cell : float
        Edge of a cell, as a share of the standard deviation.
    every : int, optional
        Steps after which a plan is renewed; by default it is followed to its end.
    pause : int
        Smallest number of steps from a search to the next one that a surprise causes.
    surprise : float
        Deviation of an entry of the state from the plan that counts as a surprise.

    Attributes
    ----------
    actions : ndarray of int, shape (n_choices,), or (n_choices, n_actions) where there are several
        All possible actions.
    """

    def __init__(
        self,
        task: Task,
        tail: Callable[[Array], Array] | None = None,
        *,
        horizon: int = 100,
        width: int = 1000,
        cell: float = 0.2,
        every: int | None = None,
        pause: int = 10,
        surprise: float = 1e-3,
    ) -> None:
        if not task.formulas.choices:
            raise ValueError(
                f"beam search takes listed actions; those of {type(task).__name__} lie in a range: "
                "use MPC or ILQR"
            )
        every = horizon if every is None else every
        check_counts(horizon=horizon, width=width, every=every, pause=pause)
        for name, size in (("cell", cell), ("surprise", surprise)):
            if not size > 0.0:
                raise ValueError(f"{name} must be above 0, got {size}")
        self.task, self.tail, self.horizon, self.width = task, tail, horizon, width
        self.cell, self.every, self.pause, self.surprise = cell, min(every, horizon), pause, surprise
        self.model, self.read = Model(without_kicks(task)), ObservationDecoder(task, complete=True)
        each = np.indices(task.formulas.choices).reshape(task.formulas.actions, -1).T
        self.actions = each[:, 0] if task.formulas.actions == 1 else each
        self._aims = task.target_range is not None
        self._turns = np.array([unit == "rad" for unit in task.scene.state_units])
        # Odd factors, so that the weighted sum of a cell's numbers identifies the cell.
        drawn = np.random.default_rng(0).integers(2**63, size=len(self._turns), dtype=np.uint64)
        self._factors = 2 * drawn + 1

    def predict(
        self,
        observation: NDArray,
        state: Followed | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.int64], Followed]:
        """Return the action for each observation; the state holds the plans."""
        values = np.asarray(observation)
        x, targets = self.read(values.reshape(-1, values.shape[-1]))
        n, entries = x.shape
        fresh = beginning(n, state, episode_start)
        if state is None:
            count, shape = np.zeros(n, np.intp), (n, self.horizon)
            state = Followed(
                count,
                count,
                count,
                fresh,
                np.zeros((*shape, entries)),
                np.zeros(shape, np.intp),
                np.zeros(shape),
            )
        plan = state._replace(**{name: getattr(state, name).copy() for name in state._fields})
        plan.wait[:] = np.maximum(plan.wait - 1, 0)
        now = np.minimum(plan.step, self.horizon - 1)
        off = np.abs(self.read.difference(x, plan.states[np.arange(n), now])).max(axis=1) > self.surprise
        search = fresh | (plan.step >= np.minimum(plan.length, self.every))
        for row in np.flatnonzero(search | (off & (plan.wait == 0))).tolist():
            target = targets[row] if self._aims else None
            if search[row] or not self._still(plan, row, x[row], target):
                self._keep(plan, row, self.search(x[row], target))
                plan.step[row], plan.wait[row] = 0, self.pause
        chosen = self.actions[plan.choices[np.arange(n), plan.step]]
        plan.step[:] += 1
        return chosen.reshape((*values.shape[:-1], *self.actions.shape[1:])).astype(np.int64), plan

    def search(self, start: Array, target: Any = None) -> Trajectory:
        """Return the best sequence of actions found from a state.

        Parameters
        ----------
        start : ndarray, shape (n_state,)
            The state.
        target : float or ndarray, shape (n_targets,), optional
            The target, for a task that has them.

        Returns
        -------
        Trajectory
            At most `horizon` steps.

        Raises
        ------
        StepRefused
            If a step of the model cannot be taken to full accuracy.
        """
        states, total = np.asarray(start, np.float64)[None], np.zeros(1)
        levels: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []  # before, choice
        best, most, largest = None, -math.inf, 0.0
        count = len(self.actions)
        for level in range(1, self.horizon + 1):
            before, choice = np.divmod(np.arange(len(states) * count), count)
            states, rewards, ended = self._step(states[before], choice, target)
            total, largest = total[before] + rewards, max(largest, rewards.max())
            if ended.any():
                first = int(np.where(ended, total, -math.inf).argmax())
                if total[first] > most:
                    best, most = (level, before[first], choice[first]), total[first]
            alive = np.flatnonzero(~ended)
            if not len(alive) or most >= total[alive].max() + (self.horizon + 1 - level) * largest:
                break
            value = total[alive] if self.tail is None else total[alive] - self.tail(states[alive])
            kept = alive[self._select(states[alive], value)]
            states, total = states[kept], total[kept]
            levels.append((before[kept], choice[kept]))
        else:
            best = self.horizon, levels[-1][0][0], levels[-1][1][0]
        assert best is not None
        level, row, last = best
        found = [last]
        for before, choice in reversed(levels[: level - 1]):
            found.append(choice[row])
            row = before[row]
        return self._along(np.asarray(start, np.float64), np.array(found[::-1]), target)

    def _step(self, states: Array, choices: NDArray[np.intp], target: Any) -> tuple[Array, Array, Any]:
        """Step the model."""
        goals = None if target is None else np.broadcast_to(target, (len(states), *np.shape(target)))
        return self.model(states, self.actions[choices], goals)

    def _select(self, states: Array, value: Array) -> NDArray[np.intp]:
        """Return the rows of the next level, one from each cell, the best first."""
        spread = states.std(axis=0)
        edge = self.cell * np.where(self._turns, np.minimum(spread, _EVEN), spread)
        place = np.where(self._turns, states - 2.0 * np.pi * np.rint(states / (2.0 * np.pi)), states)
        place = (place - place.min(axis=0)) / np.where(edge > 0.0, edge, 1.0)
        key = (np.floor(place).astype(np.uint64) * self._factors).sum(axis=1, dtype=np.uint64)
        order = np.lexsort((key, -value))  # among equal values the order of keys is as good as a random one
        _, first = np.unique(key[order], return_index=True)
        return order[np.sort(first)[: self.width]]

    def _along(self, state: Array, choices: NDArray[np.intp], target: Any) -> Trajectory:
        """Return the trajectory of these choices from a state, up to its end."""
        states, rewards, ended = [], [], False
        for choice in choices:
            states.append(state)
            after, reward, over = self._step(state[None], choice[None], target)
            state, ended = after[0], bool(over[0])
            rewards.append(reward[0])
            if ended:
                break
        return Trajectory(np.array(states), choices[: len(states)], np.array(rewards), ended)

    def _still(self, plan: Followed, row: int, x: Array, target: Any) -> bool:
        """Try the rest of a plan from another state, and keep it if it pays no less."""
        step, length = plan.step[row], plan.length[row]
        found = self._along(x, plan.choices[row, step:length].copy(), target)
        if found.ended != plan.ended[row] or found.rewards.sum() < plan.left[row, step] - 1e-9:
            return False
        self._keep(plan, row, found, step)
        return True

    def _keep(self, plan: Followed, row: int, found: Trajectory, step: int = 0) -> None:
        """Store a sequence as a plan, or as the rest of a plan from a step on."""
        end = step + len(found.choices)
        plan.states[row, step:end], plan.choices[row, step:end] = found.states, found.choices
        plan.left[row, step:end] = np.cumsum(found.rewards[::-1])[::-1]
        plan.length[row], plan.ended[row] = end, found.ended


def beam(
    task: Task,
    *,
    weights: Mapping[str, float] | None = None,
    rest: Mapping[str, float] | None = None,
    energy: float = 0.0,
    **numbers: Any,
) -> BeamSearch:
    """Return a beam search whose final cost is a distance from rest, minus a multiple of the energy.

    Parameters
    ----------
    task : Task
        The task, with listed actions.
    weights, rest : mapping, optional
        By entry of the state: see `lag_envs.controllers.swing_up.away`.
    energy : float
        Factor of the scene's total energy [1/J].
    **numbers
        Keywords of `BeamSearch`.
    """
    lost = away(task, weights or {}, rest or {})
    if not weights and not energy:
        return BeamSearch(task, **numbers)

    def tail(states: Array) -> Array:
        gained = energy * task.scene.energy(states)["total"] if energy else 0.0
        return lost(states) - gained

    return BeamSearch(task, tail, **numbers)
