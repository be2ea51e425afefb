"""Model-predictive control: plan on the exact model, and plan again whenever the outcome differs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import (
    Agent,
    Array,
    ObservationDecoder,
    beginning,
    check_continuous,
    check_counts,
)
from lag_envs.controllers.ilqr import ILQR, SHARES, Feedback, Plan, put
from lag_envs.controllers.linear import regulator, time_varying
from lag_envs.controllers.swing_up import away
from lag_envs.controllers.tracking import Tracking, hold, plans_of, recorded, smoothed, waves
from lag_envs.tasks.base import Task
from lag_envs.tasks.record import Plans
from lag_envs.workers import Elsewhere

Tail = Callable[[Array], Array]


class Coming(NamedTuple):
    """Plans that are being made."""

    left: int  # calls of `predict` until the plans are followed
    rows: NDArray[np.intp]  # their episodes
    wanted: NDArray[np.bool_]  # which of the episodes have not ended in the meantime
    made: Future  # an `Ahead` of these rows


class Ahead(NamedTuple):
    """The plan of each episode: its step, and for each of its steps state, action and gain."""

    step: NDArray[np.intp]  # (n,), in calls of `predict`
    wait: NDArray[np.intp]  # (n,), steps until the next search is allowed
    states: Array  # (n, horizon, n_state)
    actions: Array  # (n, horizon, n_actions)
    gains: Array  # (n, horizon, n_actions, n_state)
    coming: tuple[Coming, ...] = ()


class MPC(Agent):
    """Plan ahead on the exact model, follow the plan, and plan again every few steps or after a surprise.

    A new plan starts from the rest of the old one, followed with its feedback and improved by a few
    iterations of iLQR. An episode's first plan starts from the best of the recorded plans, improved in the
    same way. If there are no recorded plans, or if a plan ends badly, as it may after hard kicks, a plan is
    searched for from random guesses. The chance of future kicks is ignored.

    Parameters
    ----------
    task : Task
        The task to control, with continuous actions.
    tail : callable, optional
        Final cost of a plan, from states (n, n_state) to numbers (n,).
    horizon : int
        Steps to plan ahead, but at most those of an episode.
    first : sequence of Tracking
        Recorded plans of the task, from which each episode's first plan is made. If they are given, there is
        no search at the start, and all plans are followed with the feedback that `Task.plans` specifies.
    every : int
        Steps after which a plan is renewed.
    ahead : int
        Steps that a renewal may take, including searches. The new plan starts from the state predicted for
        the end of these steps, and the old plan is followed until then. The episode waits for its first plan.
    background : bool
        Whether a separate process makes the plans. Then `predict` returns at once, as real time demands, and
        waits only for a plan that is not ready after `ahead` steps. The actions are the same.
    iterations : int
        Iterations of iLQR for a renewal.
    budget : int
        Steps of the model for a search.
    guesses : int
        Number of guesses that a search improves.
    good : float
        Final cost below which a plan counts as good. By default every plan does, and only the first plan is
        searched for.
    pause : int
        Smallest number of steps between searches.
    surprise : float
        Deviation of an entry of the state from the plan that counts as a surprise.
    easier : (Task, callable), optional
        A task for searches, and its final cost: see `Plans.place`.
    finer : int
        Calls of `predict` in a step of the task: between a plan's steps its action is held, but the feedback
        acts at each call.
    reserve : float
        Share of the largest action that plans leave to their feedback.
    plans : Plans, optional
        Specifies the feedback along plans made from `first`; by default `Task.plans`.
    hold : Tracking, optional
        Feedback that continues a plan beyond its end, and that acts where `holds`.
    holds : callable, optional
        Takes states (n, n_state) and returns booleans (n,), true where no plan is needed.
    seed : int
        Seed of the guesses. All episodes share the random numbers, so a plan may depend on the plans made
        before; a new agent starts over.
    """

    random = True  # it draws guesses

    def __init__(
        self,
        task: Task,
        tail: Tail | None = None,
        *,
        horizon: int = 50,
        first: Sequence[Tracking] = (),
        every: int = 1,
        ahead: int = 0,
        background: bool = False,
        iterations: int = 2,
        budget: int = 200_000,
        guesses: int = 16,
        good: float = np.inf,
        pause: int = 10,
        surprise: float = 1e-3,
        easier: tuple[Task, Tail | None] | None = None,
        finer: int = 1,
        reserve: float = 0.0,
        plans: Plans | None = None,
        hold: Any = None,
        holds: Callable[[Array], NDArray[np.bool_]] | None = None,
        seed: int = 0,
    ) -> None:
        check_counts(horizon=horizon, every=every, guesses=guesses, finer=finer, budget=budget)
        check_counts(0, ahead=ahead)
        if background and not ahead:
            raise ValueError("background=True needs `ahead`, the number of steps that a renewal may take")
        check_continuous("MPC", task)
        if not 0.0 <= reserve < 1.0:
            raise ValueError(f"reserve must be at least 0 and less than 1, got {reserve}")
        if first:
            plans_of(task)
        for guess in first:
            if guess.task.scene != task.scene or type(guess.task) is not type(task):
                raise ValueError(
                    f"first: a plan for {guess.task.scene} cannot guide {type(task).__name__} with "
                    f"{task.scene}; take plans that were made for this task, as `recorded(task)` is"
                )
        horizon = int(min(horizon, task.limit))
        self.task, self.horizon, self.finer = task, horizon, finer
        self.every, self.over = min(every, horizon) * finer, horizon * finer
        self.ahead = ahead
        self.first, self.plans = first, plans or task.plans
        self.model = smoothed(task) if first else task
        self.guesses, self.good, self.pause, self.surprise = guesses, good, pause, surprise
        self.hold, self.holds, self.tail = hold, holds, tail
        self.largest, self.count = task.formulas.largest, task.formulas.actions
        self.rng, self.read = np.random.default_rng(seed), ObservationDecoder(task, complete=True)
        calm = without_kicks(task)
        gains = None if not first else self._gains
        self.planner = ILQR(calm, [], tail=tail, steps=horizon, iterations=iterations, gains=gains)
        self.idle = np.atleast_1d(task.rest_action) + 0.0  # no -0.0
        self.polisher = ILQR(calm, [], tail=tail, steps=horizon, iterations=5 * iterations)
        searched, end = easier or (calm, tail)
        rounds = max(budget // (guesses * horizon * len(SHARES)), 1)
        self.searcher = ILQR(searched, [], tail=end, steps=horizon, iterations=rounds, tolerance=1e-2)
        for method in (self.planner, self.polisher, self.searcher):
            method.largest *= 1.0 - reserve
        self.share = np.asarray(searched.limit_control / task.limit_control)
        self._elsewhere = None
        if background:
            self._elsewhere = Elsewhere(self)
            self._elsewhere.call("_warm_up").result()

    def predict(
        self,
        observation: NDArray,
        state: Ahead | None = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Ahead]:
        """Return the action for each observation; the state holds the plans."""
        values = np.asarray(observation)
        x, targets = self.read(values.reshape(-1, values.shape[-1]))
        n = len(x)
        fresh = beginning(n, state, episode_start)
        if state is None:
            state = self._blank(x)
        plan = _part(state, np.arange(n))
        plan.wait[:] = np.where(fresh, 0, np.maximum(plan.wait - 1, 0))
        plan.actions[fresh], plan.gains[fresh], plan.states[fresh] = self.idle, 0.0, x[fresh, None]
        coming, busy = self._arrive(plan, state.coming, fresh)
        rows, held = np.arange(n), np.zeros(n, np.bool_) if self.holds is None else self.holds(x)
        off = np.abs(self._followed(plan, rows, plan.step, x)[0]).max(axis=1)
        renewed = ~held & ~fresh & ~busy & ((plan.step >= self.every) | (off > self.surprise))
        for chosen, first in ((fresh & ~held, True), (renewed, False)):
            if (those := np.flatnonzero(chosen)).size:
                made = self._made(_part(plan, those), x[those], targets[those], first)
                if first or not self.ahead:
                    self._keep(plan, those, made.result())
                else:
                    coming.append(Coming(self.ahead * self.finer, those, np.ones(len(those), np.bool_), made))
        action = self._following(plan)(x, targets, 0)
        if held.any():
            action = np.where(held[:, None], self._holding(x, targets), action)
        plan.step[:] = np.where(held, self.over, plan.step + 1)
        actions = self._clipped(action).reshape(*values.shape[:-1], self.count)
        return actions, plan._replace(coming=tuple(coming))

    def _blank(self, x: Array) -> Ahead:
        """Return no plans."""
        (n, width), none = x.shape, np.zeros(len(x), np.intp)
        actions, gains = ((n, self.horizon, self.count, *more) for more in ((), (width,)))
        return Ahead(none, none, np.zeros((n, self.horizon, width)), np.zeros(actions), np.zeros(gains))

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_elsewhere": None}

    def _clipped(self, action: Array) -> NDArray[np.float32]:
        """Return actions in the form that the environment takes."""
        return np.clip(action, -self.largest, self.largest).astype(np.float32)

    def _arrive(
        self, plan: Ahead, made: Sequence[Coming], fresh: NDArray[np.bool_]
    ) -> tuple[list[Coming], NDArray[np.bool_]]:
        """Store plans whose time has come; return the others, and which episodes wait for a plan."""
        coming, busy = [], np.zeros(len(fresh), np.bool_)
        for one in made:
            wanted = one.wanted & ~fresh[one.rows]
            if one.left > 1:
                coming.append(one._replace(left=one.left - 1, wanted=wanted))
                busy[one.rows[wanted]] = True
            elif wanted.any():
                self._keep(plan, one.rows[wanted], _part(one.made.result(), wanted))
        return coming, busy

    @staticmethod
    def _keep(plan: Ahead, rows: NDArray[np.intp], found: Ahead) -> None:
        """Store new plans."""
        put(plan, rows, found)
        plan.step[rows], plan.wait[rows] = 0, np.maximum(plan.wait[rows], found.wait)

    def _made(self, *arguments: Any) -> Future:
        """Return the result of `_make`, which another process may still be computing."""
        if self._elsewhere:
            return self._elsewhere.call("_make", *arguments)
        made: Future = Future()
        made.set_result(self._make(*arguments))
        return made

    def _make(self, old: Ahead, x: Array, targets: Array, first: bool) -> Ahead:
        """Return plans that begin `ahead` steps after these states, or there if they are episodes' first."""
        none = np.zeros(len(x), np.intp)
        if first and self.first:
            begun = self._begin(x, targets)
            return Ahead(none, none, begun.states, begun.actions, begun.gains)
        if not first:
            old, x = self._later(old, x, targets)
        found, value = self.planner.improve(x, targets, self._following(old))
        bad = (old.wait == 0) & (first | self._ends_badly(found.states, found.actions, targets))
        if bad.any():
            other, gain = self._search(x[bad], targets[bad])
            better = gain > value[bad]
            put(found, np.flatnonzero(bad)[better], other, better)
        return Ahead(none, np.where(bad, self.pause, 0), found.states, found.actions, found.gains)

    def _warm_up(self) -> None:
        """Make a plan of each kind, which compiles everything."""
        x, targets = np.array([self.task.centre]), np.zeros((1, *np.shape(self.task.target_range)))
        rng, self.rng = self.rng, np.random.default_rng(0)
        for first in (True, False):
            self._make(self._blank(x), x, targets, first)
        self.rng = rng

    def _later(self, old: Ahead, x: Array, targets: Array) -> tuple[Ahead, Array]:
        """Return plans and states after `ahead` steps."""
        act = self._following(old)
        for t in range(self.ahead):
            actions = self._clipped(act(x, targets, t)).astype(np.float64)
            x, _, _ = self.planner.advance(x, actions, targets)
        return old._replace(step=old.step + self.ahead * self.finer), x

    def _followed(self, plan: Ahead, rows: Any, step: NDArray[np.intp], x: Array) -> tuple[Array, Array]:
        """Return how far states (n, n_state) are from plans at given steps, and the actions."""
        now, part = np.divmod(np.minimum(step, self.over - self.finer), self.finer)
        planned, after = (plan.states[rows, i] for i in (now, np.minimum(now + 1, self.horizon - 1)))
        off = self.read.difference(x, planned + (part / self.finer)[:, None] * (after - planned))
        return off, plan.actions[rows, now] + np.einsum("iaj,ij->ia", plan.gains[rows, now], off)

    def _following(self, plan: Ahead) -> Feedback:
        """Return the feedback that follows plans to their ends, and holds the state there."""
        rows = np.arange(len(plan.step))

        def act(x: Array, targets: Array, t: int) -> Array:
            step = plan.step + t * self.finer
            _, action = self._followed(plan, rows, step, x)
            over = (step >= self.over)[:, None]
            if not over.any():
                return action
            return np.where(over, self.idle if self.hold is None else self._holding(x, targets), action)

        return act

    def _holding(self, x: Array, targets: Array) -> Array:
        """Return the actions (n, n_actions) of the feedback at rest."""
        return self._tracking(self.hold, x, targets, np.inf)

    def _tracking(self, law: Tracking, x: Array, targets: Array, taken: float) -> Array:
        """Return the actions (n, n_actions) of a recorded plan after some of its steps."""
        return np.reshape(law.act(x, targets, np.full(len(x), taken)), (len(x), self.count))

    def _begin(self, x: Array, targets: Array) -> Plan:
        """Return the best of the plans made from recorded plans."""
        m, pace = len(self.first), self.task.dt / self.task.interval

        def act(x: Array, targets: Array, t: int) -> Array:
            actions = np.empty((len(x), self.count))
            for i, law in enumerate(self.first):
                actions[i::m] = self._tracking(law, x[i::m], targets[i::m], t * pace)
            return actions

        return self._best(self.planner, x, targets, m, act)

    def _gains(self, states: Array, actions: Array) -> Array:
        """Return the feedback (n, horizon, n_actions, n_state) along plans, made as for recorded plans."""
        n, width = len(states), states.shape[-1]
        plans, gains = self.plans, np.empty((n, self.horizon, self.count, width))
        for i in range(n):
            acted = actions[i, :, 0] if self.count == 1 else actions[i]
            ended = np.append(states[i], [plans.rest], axis=0)  # the end itself does not matter
            found, _ = time_varying(self.model, ended, acted, plans.rest, plans.weights, plans.effort)
            gains[i] = -found.reshape(gains.shape[1:])
        return gains

    def _ends_badly(self, states: Array, actions: Array, targets: Array) -> NDArray[np.bool_]:
        """Return which plans end badly."""
        if self.tail is None:
            return np.zeros(len(states), np.bool_)
        return self.tail(self.planner.advance(states[:, -1], actions[:, -1], targets)[0]) > self.good

    def _search(self, x: Array, targets: Array) -> tuple[Any, Array]:
        """Return the best of plans from random guesses, and its value."""
        guesses = waves(self.rng, len(x) * self.guesses, self.horizon, self.task.dt, self.count)
        found = self._best(self.searcher, x, targets, self.guesses, self.largest * guesses)
        return self.polisher.improve(x, targets, self.share * found.actions)

    @staticmethod
    def _best(method: ILQR, x: Array, targets: Array, m: int, guesses: Array | Feedback) -> Plan:
        """Return for each state the best of the plans that are improved from m guesses for it."""
        found, values = method.improve(np.repeat(x, m, axis=0), np.repeat(targets, m, axis=0), guesses)
        best = values.reshape(-1, m).argmax(axis=1) + m * np.arange(len(x))
        return found._replace(**{name: getattr(found, name)[best] for name in ("states", "actions", "gains")})


def _part(plan: Ahead, rows: NDArray) -> Ahead:
    """Return copies of the plans of some episodes, without plans that are being made."""
    return Ahead(*(values[rows] for values in plan[:-1]))


def planner(
    task: Task,
    *,
    weights: Mapping[str, float] | None = None,
    rest: Mapping[str, float] | None = None,
    **numbers: Any,
) -> MPC:
    """Return an MPC whose final cost is the distance from a rest; without weights there is no final cost.

    Parameters
    ----------
    task : Task
        The task to control, with continuous actions.
    weights : mapping, optional
        Final cost, by entry of the state: the weight of the squared distance from rest or, for angles
        (entries with the unit rad), of twice 1 minus its cosine.
    rest : mapping, optional
        Nonzero entries of the state at rest.
    **numbers
        Other arguments of `MPC`.

    Raises
    ------
    ValueError
        For names that are not entries of the state, and for a task with listed actions.
    """
    lost = away(task, weights or {}, rest or {})
    return MPC(task, lost if weights else None, **numbers)


def loss(task: Task) -> Callable[[Array], Array]:
    """Return the best regulator's loss of reward from states near upright; farther away, a larger loss."""
    plans = plans_of(task)
    read, rest = ObservationDecoder(task), np.array(plans.rest)
    _, cost = regulator(smoothed(task), rest, extra=plans.extra)

    def lost(states: Array) -> Array:
        off = read.difference(states, rest)
        loss = np.einsum("...i,ij,...j->...", off, cost, off)
        return loss + loss**2  # since the control is limited, a large loss means that all is lost

    return lost


def renewed(
    task: Task,
    *,
    beyond: float = 1.1,
    iterations: int = 1,
    finer: int = 1,
    effort: float | None = None,
    **numbers: Any,
) -> MPC:
    """Return an MPC that starts with a recorded plan, renews it in time, and leaves holding to a regulator.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``. Each episode starts with one of its recorded plans, or a mirror
        image.
    beyond : float
        How far to plan, as a multiple of the longest recorded plan.
    iterations : int
        Iterations of iLQR for a renewal.
    finer : int
        Steps of the task in a step of the plan, see `MPC`.
    effort : float, optional
        Weight of an action's deviation from the plan or from rest; by default that of `Task.plans`.
    **numbers
        Other arguments of `MPC`, and of `held`.
    """
    plans = plans_of(task) if effort is None else dataclasses.replace(plans_of(task), effort=effort)
    laws = [recorded(task, kind) for kind in (["followed", "quick"] if plans.quick else ["followed"])]
    first = [*laws, *(law.mirrored() for law in laws)]
    if finer > 1:
        task = task.varied(dt=finer * task.dt)
    horizon = round(beyond * max(len(law.actions) for law in laws) * task.interval / task.dt)
    return held(
        task, plans=plans, first=first, horizon=horizon, iterations=iterations, finer=finer, **numbers
    )


def held(task: Task, *, near: float = 0.5, plans: Plans | None = None, **numbers: Any) -> MPC:
    """Return an MPC whose final cost is a regulator's loss, and which leaves holding to a regulator.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    near : float
        Loss below which the regulator is in charge.
    plans : Plans, optional
        Specifies the regulator, and the feedback along plans; by default `Task.plans`.
    **numbers
        Other arguments of `MPC`.
    """
    lost, holding = loss(task), hold(task, plans)
    return MPC(task, lost, plans=plans, hold=holding, holds=lambda states: lost(states) < near, **numbers)


def without_kicks(task: Task) -> Task:
    """Return the same task without random kicks."""
    if not task.draws:
        return task
    kind: Any = type(type(task).__name__, (type(task),), {"id": "", "draws": 0, "kick": Task.kick})
    calm: Task = object.__new__(kind)
    vars(calm).update({name: value for name, value in vars(task).items() if name != "formulas"})
    return calm
