"""Trajectory optimisation on the exact model: the iterative linear-quadratic regulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.controllers.basic import Agent, Array, ObservationDecoder, beginning, check_continuous
from lag_envs.envs.model import REACH, Model
from lag_envs.scenes.derivation import form_of
from lag_envs.tasks.base import Task

#: Step sizes of the line search, tried in parallel.
SHARES = 0.5 ** np.arange(0, 10, 1.5)
#: Largest number of sweeps in the search for the best actions within their bounds.
SWEEPS = 20
#: Smallest trusted curvature with respect to an action [reward/action²], in a step of the task's interval.
FLAT = 1e-4
#: States (..., n_state), targets and the step of a roll-out to actions (..., n_actions).
Feedback = Callable[[Array, Array, int], Array]


class Plan(NamedTuple):
    """The plan being played: for each episode its step, and for each of its steps state, action and gain."""

    step: NDArray[np.intp]  # (n,)
    states: Array  # (n, steps, n_state)
    actions: Array  # (n, steps, n_actions)
    gains: Array  # (n, steps, n_actions, n_state)
    memory: Any  # of the controller that continues after the plan


def put(plans: Any, rows: NDArray, others: Any, those: Any = slice(None)) -> None:
    """Replace states, actions and gains of some plans by those of others."""
    for name in ("states", "actions", "gains"):
        getattr(plans, name)[rows] = getattr(others, name)[those]


class ILQR(Agent):
    """Plan each episode at its start with the exact model, and follow the plan by time-varying feedback.

    Planning starts from the actions of another controller. Each iteration expands the model along the
    trajectory, the dynamics to first order and the reward to second, and solves the linear-quadratic problem
    within the bounds of the action [1]_. The best of several step sizes is kept. So a plan is never worse
    than its initial guess.

    Parameters
    ----------
    task : Task
        The task with its parameters, ``env.unwrapped.task``; with continuous actions, without random kicks.
    guesses : sequence of controllers
        Initial guesses; each is improved, and the best plan is played. Only the method `improve` needs none.
    after : controller, optional
        Takes over if the plan ends before the episode; by default the first guess.
    tail : callable, optional
        Takes states (n, n_state) at the plan's end; returns the loss from then on (n,).
    steps : int, optional
        Steps to plan ahead; by default the whole episode, but at most 1000.
    iterations : int
        Largest number of iterations.
    tolerance : float
        The iteration ends if the return improves by less than this.
    gains : callable, optional
        Takes states (n, steps, n_state) and actions of finished plans, returns their feedback (n, steps,
        n_actions, n_state). By default it is the feedback of the last iteration, which is optimal near an
        optimal plan; but an action whose Newton step leads beyond its bounds gets no feedback.

    References
    ----------
    .. [1] Y. Tassa, N. Mansard and E. Todorov, "Control-limited differential dynamic programming", ICRA 2014,
       1168-1175.
    """

    plans_at_start = True

    def __init__(
        self,
        task: Task,
        guesses: Sequence[Any],
        *,
        after: Any = None,
        tail: Callable[[Array], Array] | None = None,
        steps: int | None = None,
        iterations: int = 100,
        tolerance: float = 1e-3,
        gains: Callable[[Array, Array], Array] | None = None,
    ) -> None:
        check_continuous("iLQR", task)
        if task.draws:
            raise ValueError(f"{type(task).__name__} has random kicks, which a plan does not foresee")
        self.task, self.guesses, self.tail = task, guesses, tail
        self.after = guesses[0] if after is None and guesses else after
        self.steps = int(min(task.limit, 1000 if steps is None else steps))
        self.iterations, self.tolerance, self.gains = iterations, tolerance, gains
        self.flat = FLAT * task.dt / task.interval
        self.largest, self.count = task.formulas.largest, task.formulas.actions
        self.model, self.read = Model(task), ObservationDecoder(task, complete=True)
        self._k = SimpleNamespace(**task.formulas.constants())

    def predict(
        self,
        observation: NDArray,
        state: Plan | None = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Plan]:
        """Return the action for each observation; the state holds the plans."""
        if not self.guesses:
            raise ValueError("iLQR needs `guesses`, controllers whose actions it improves")
        values = np.asarray(observation)
        x, target = (v.reshape(-1, *v.shape[values.ndim - 1 :]) for v in self.read(values))
        n = len(x)
        fresh = beginning(n, state, episode_start)
        plan = self._blank(n) if state is None else state
        if fresh.any():
            new, _ = self.plan(x[fresh], target[fresh])
            plan = plan._replace(**{name: getattr(plan, name).copy() for name in plan._fields[:4]})
            put(plan, fresh, new)
            plan.step[fresh] = 0
        rows, now = np.arange(n), np.minimum(plan.step, self.steps - 1)
        off = self.read.difference(x, plan.states[rows, now])  # a plan's angles may exceed ±π
        action = plan.actions[rows, now] + np.einsum("iaj,ij->ia", plan.gains[rows, now], off)
        memory = plan.memory
        if (plan.step >= self.steps).any():
            beyond, memory = self.after.predict(values.reshape(n, -1), memory, plan.step <= self.steps)
            action = np.where((plan.step >= self.steps)[:, None], beyond, action)
        plan = plan._replace(step=plan.step + 1, memory=memory)
        action = np.clip(action, -self.largest, self.largest).astype(np.float32)
        return action.reshape(*values.shape[:-1], self.count), plan

    def _blank(self, n: int) -> Plan:
        many, width = (n, self.steps), len(self.task.scene.state_names)
        acting = np.zeros((*many, self.count)), np.zeros((*many, self.count, width))
        return Plan(np.zeros(n, np.intp), np.zeros((*many, width)), *acting, None)

    # --- planning ------------------------------------------------------------------------------------------

    def plan(self, starts: Array, targets: Array) -> tuple[Plan, Array]:
        """Return the best plan for each start (n, n_state) and target, and its return from `improve`.

        Targets have the shape (n,), even if the task has none, or (n, n_targets) if there are several.
        """
        best: Plan | None = None
        most = np.full(len(starts), -math.inf)
        for guess in self.guesses:
            plan, returns = self.improve(starts, targets, self._acting(guess))
            if best is None:
                best, most = plan, returns
                continue
            better = returns > most
            put(best, better, plan, better)
            most = np.maximum(most, returns)
        assert best is not None
        return best, most

    def advance(self, x: Array, actions: Array, targets: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Step the model from states (..., n_state) with actions (..., n_actions)."""
        shape = x.shape[:-1]
        flat = x.reshape(-1, x.shape[-1]), self._flat(actions), self._goals(targets, shape)
        z, reward, ended = self.model(*flat)
        return z.reshape(x.shape), reward.reshape(shape), ended.reshape(shape)

    def _flat(self, actions: Array) -> Array:
        """Return actions (..., n_actions) as `Model` takes them."""
        return actions.ravel() if self.count == 1 else actions.reshape(-1, self.count)

    def _goals(self, targets: Array, shape: tuple[int, ...]) -> Array | None:
        """Return targets for steps of this shape, as `Model` takes them; None if the task has none."""
        if self.task.target_range is None:
            return None
        each = np.shape(self.task.target_range)
        return np.broadcast_to(targets, (*shape, *each)).reshape(-1, *each)

    def _acting(self, guess: Any) -> Feedback:
        """Return a controller as feedback for one roll-out."""
        memory, form, formulas = None, form_of(self.task.scene), self.task.formulas

        def act(x: Array, targets: Array, step: int) -> Array:
            nonlocal memory
            lifted = form.lift(x) if form else tuple(x.T)
            goals = [*np.reshape(targets, (len(x), -1)).T][: formulas.targets]
            seen = formulas.observe(np, lifted, goals, self._k)
            actions, memory = guess.predict(np.stack(np.broadcast_arrays(*seen), axis=-1), memory)
            return np.asarray(actions)

        return act

    def improve(self, starts: Array, targets: Array, guess: Array | Feedback) -> tuple[Plan, Array]:
        """Return plans improved from a guess, and their returns less the final cost.

        The guess is actions (n, steps, n_actions), or feedback: a function of states (n, n_state), targets
        and the step that returns actions (n, n_actions).
        """
        n = len(starts)
        plan = self._blank(n)
        act = guess if callable(guess) else lambda x, targets, step: guess[:, step]
        states, actions, returns = self._roll_out(starts, targets, act)
        plan = plan._replace(states=states, actions=actions)
        damping = np.full(n, 10.0 * self.flat)
        going = np.arange(n)
        for iteration in range(self.iterations + (self.gains is None)):
            slopes = self._expand(plan.states[going], plan.actions[going], targets[going])
            with np.errstate(over="ignore", invalid="ignore"):
                change, gains = self._solve(plan.actions[going], damping[going], *slopes)
            # If the value overflows, nothing is changed, and the next iteration has more damping.
            lost = ~(np.isfinite(change) & np.isfinite(gains).all(axis=3)).all(axis=(1, 2))
            change[lost], gains[lost] = 0.0, 0.0
            plan.gains[going] = gains
            if iteration == self.iterations:
                break
            states, actions, tried = self._play(
                starts[going], targets[going], plan.states[going], plan.actions[going], gains, change
            )
            gain = tried - returns[going]
            better = gain > 0.0
            won = going[better]
            plan.states[won], plan.actions[won], returns[won] = states[better], actions[better], tried[better]
            damping[going] = np.clip(damping[going] * np.where(better, 0.3, 10.0), 1e-6, 1e3)
            # An episode is done when its gain is small, or when even the smallest step sizes gain nothing.
            done = np.where(better, gain < self.tolerance, damping[going] >= 1e3)
            going = going[~done]
            if not len(going):
                break
        if self.gains is not None:
            plan.gains[:] = self.gains(plan.states, plan.actions)
        return plan, returns

    def _play(
        self, starts: Array, targets: Array, states: Array, actions: Array, gains: Array, change: Array
    ) -> tuple[Array, Array, Array]:
        """Return states, actions and returns of the plans changed by the best of several step sizes."""

        def act(x: Array, targets: Array, t: int) -> Array:
            feedback = np.einsum("iaj,ikj->ika", gains[:, t], x - states[:, None, t])
            return actions[:, t, None] + SHARES[:, None] * change[:, t, None] + feedback

        x = np.repeat(starts[:, None], len(SHARES), axis=1)
        xs, us, total = self._roll_out(x, targets[:, None], act)
        rows, best = np.arange(len(starts)), total.argmax(axis=1)
        return xs[rows, best], us[rows, best], total[rows, best]

    def _roll_out(self, x: Array, targets: Array, act: Feedback) -> tuple[Array, Array, Array]:
        """Return states, actions and returns of feedback from states (..., n_state)."""
        shape = x.shape[:-1]
        states = np.empty((*shape, self.steps, x.shape[-1]))
        actions = np.empty((*shape, self.steps, self.count))
        total, alive = np.zeros(shape), np.ones(shape, np.bool_)
        for t in range(self.steps):
            u = np.clip(act(x, targets, t), -self.largest, self.largest)
            states[..., t, :], actions[..., t, :] = x, u
            x, reward, ended = self.advance(x, u, targets)
            total += np.where(alive, reward, 0.0)
            alive &= ~ended
        if self.tail is not None:
            total -= self.tail(x.reshape(-1, x.shape[-1])).reshape(shape)
        return states, actions, total

    def _expand(self, states: Array, actions: Array, targets: Array) -> tuple[Array, ...]:
        """Return the model's slopes (n, T, m, n_state), the reward's (n, T, m) and curvature (n, T, m, m).

        The m variables are the state's entries and the actions. The last two results are the gradient (n,
        n_state) and the curvature (n, n_state, n_state) of the value at the plan's end.
        """
        n, steps, width = states.shape
        m = width + self.count
        slopes = np.empty((n, steps, m, width))
        gradient, curvature = np.empty((n, steps, m)), np.empty((n, steps, m, m))
        # Actions are moved inward from their bounds, beyond which they have no effect.
        inner = np.clip(actions, REACH - self.largest, self.largest - REACH)
        size = max(1, 4_000 // steps)  # fits into the cache
        for first in range(0, n, size):
            part = slice(first, first + size)
            x, u = states[part].reshape(-1, width), self._flat(inner[part])
            found = self.model.expand(x, u, self._goals(targets[part, None], states[part].shape[:-1]))
            slopes[part] = found.slopes.transpose(0, 2, 1).reshape(slopes[part].shape)
            gradient[part] = found.gradient.reshape(gradient[part].shape)
            curvature[part] = found.curvature.reshape(curvature[part].shape)
        # At a bound the reward has the same slope as just inside, except for the curvature.
        bend = curvature[..., width:, width:]
        gradient[..., width:] += np.einsum("...ab,...b->...a", bend, actions - inner)
        curvature = concave(curvature)
        if self.tail is None:
            return slopes, gradient, curvature, np.zeros((n, width)), np.zeros((n, width, width))
        return slopes, gradient, curvature, *self._expand_tail(states, actions, targets)

    def _expand_tail(self, states: Array, actions: Array, targets: Array) -> tuple[Array, Array]:
        """Return gradient and curvature of minus the final cost at the plan's end."""
        assert self.tail is not None
        ends = self.advance(states[:, -1], actions[:, -1], targets)[0]
        n, width = ends.shape
        one = REACH * np.eye(width)
        a, b = one[:, None], one[None]
        corners = np.reshape([a + b, a - b, -a - b, b - a], (-1, width))
        moves = np.concatenate([one, -one, corners])
        values = np.ascontiguousarray(-self.tail((ends + moves[:, None]).reshape(-1, width)).reshape(-1, n).T)
        slope = (values[:, :width] - values[:, width : 2 * width]) / (2.0 * REACH)
        both, first, neither, second = np.moveaxis(values[:, 2 * width :].reshape(n, 4, width, width), 1, 0)
        return slope, concave(((both - first) + (neither - second)) / (4.0 * REACH**2))

    def _solve(
        self, actions: Array, damping: Array, slopes: Array, gradient: Array, curvature: Array,
        value_x: Array, value_xx: Array,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the change of the actions (n, T, n_actions) and the gains, by dynamic programming."""
        n, steps, _, width = slopes.shape
        change, gains = np.empty((n, steps, self.count)), np.empty((n, steps, self.count, width))
        for t in range(steps - 1, -1, -1):
            f = slopes[:, t]
            q = gradient[:, t] + np.einsum("nmi,ni->nm", f, value_x)
            h = curvature[:, t] + f @ value_xx @ f.transpose(0, 2, 1)
            q_x, q_u = q[:, :width], q[:, width:]
            h_xx, h_ux, h_uu = h[:, :width, :width], h[:, width:, :width], h[:, width:, width:]
            bend = convex(-h_uu, self.flat) + damping[:, None, None] * np.eye(self.count)
            step, gain = within(actions[:, t], q_u, bend, h_ux, self.largest)
            change[:, t], gains[:, t] = step, gain
            slope = q_u + np.einsum("nab,nb->na", h_uu, step)
            value_x = q_x + np.einsum("nai,na->ni", gain, slope) + np.einsum("nai,na->ni", h_ux, step)
            cross = np.einsum("nai,naj->nij", gain, h_ux)
            outer = np.einsum("nai,nbj,nab->nij", gain, gain, h_uu)
            value_xx = h_xx + outer + cross + cross.transpose(0, 2, 1)
            # Asymmetry from rounding grows along unstable plans. With a single action it is not removed,
            # because that would change stored results.
            if self.count > 1:
                value_xx = 0.5 * (value_xx + value_xx.transpose(0, 2, 1))
        return change, gains


class Opening(Agent):
    """A guess with a different beginning: one action for a while, then another controller.

    Parameters
    ----------
    action : float or sequence of float
        The action to begin with.
    steps : int
        Number of steps for which it is kept.
    then : controller
        The controller that takes over.
    """

    def __init__(self, action: ArrayLike, steps: int, then: Any) -> None:
        self.action, self.steps, self.then = np.asarray(action, np.float32), steps, then

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action for each observation; the state holds the step and the memory of `then`."""
        shape = np.shape(observation)[:-1]
        step, memory = (np.zeros(shape, np.intp), None) if state is None else state
        if episode_start is not None:
            step = np.where(np.reshape(episode_start, shape), 0, step)
        actions, memory = self.then.predict(observation, memory, episode_start, deterministic)
        opening = (step < self.steps)[..., None]
        return np.where(opening, self.action, actions), (step + 1, memory)


def concave(matrices: Array) -> Array:
    """Return symmetric matrices (..., m, m) without their positive curvature."""
    values, vectors = np.linalg.eigh(matrices)
    return (vectors * np.minimum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def convex(matrices: Array, least: float) -> Array:
    """Return symmetric matrices (..., m, m), never singular, with eigenvalues of at least a given number."""
    if matrices.shape[-1] == 1:
        return np.maximum(matrices, least)
    values, vectors = np.linalg.eigh(matrices)
    values = np.maximum(values, np.maximum(least, 1e-9 * values[..., -1:]))
    return (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def within(actions: Array, slope: Array, bend: Array, mixed: Array, largest: float) -> tuple[Array, Array]:
    """Return the best step d of actions within their bounds, and its feedback on the state.

    The step maximises slope'd - d'bend d/2 by projected Newton. In each sweep, one action after the other
    takes its best value, which shows which actions are at a bound; then the others take a Newton step, up to
    the next bound. Actions at a bound get no feedback.

    Parameters
    ----------
    actions, slope : ndarray, shape (n, m)
        The actions, and the slope of the value.
    bend : ndarray, shape (n, m, m)
        The value's negative curvature, positive definite.
    mixed : ndarray, shape (n, m, n_state)
        Its second derivatives with respect to action and state.
    largest : float
        The largest action.

    Returns
    -------
    step : ndarray, shape (n, m)
    gains : ndarray, shape (n, m, n_state)
    """
    if actions.shape[1] == 1:  # closed form
        wanted = actions + slope / bend[:, 0]
        free = (np.abs(wanted) < largest)[..., None]
        return np.clip(wanted, -largest, largest) - actions, np.where(free, mixed / bend, 0.0)
    u, own = actions.copy(), np.einsum("naa->na", bend)
    going = np.ones((len(actions), 1), np.bool_)
    for _ in range(SWEEPS):
        tried = u.copy()
        for a, column in enumerate(own.T):
            left = slope[:, a] - np.einsum("nb,nb->n", bend[:, a], tried - actions)
            tried[:, a] = np.clip(tried[:, a] + left / column, -largest, largest)
        free, face = inside(tried, bend, largest)
        left = slope - np.einsum("nab,nb->na", bend, tried - actions)
        newton = np.linalg.solve(face, np.where(free, left, 0.0)[..., None])[..., 0]
        room = np.where(newton < 0.0, -largest, largest) - tried
        share = np.divide(room, newton, out=np.ones_like(newton), where=np.abs(newton) > np.abs(room))
        tried = np.clip(tried + share.min(axis=1, keepdims=True) * newton, -largest, largest)
        u = np.where(going, tried, u)
        left = slope - np.einsum("nab,nb->na", bend, u - actions)
        done = np.where(np.abs(u) < largest, np.abs(left) <= 1e-9 * largest * own, left * u >= 0.0)
        going = ~done.all(axis=1, keepdims=True)
        if not going.any():
            break
    free, face = inside(u, bend, largest)
    gains = np.asarray(np.linalg.solve(face, np.where(free[..., None], mixed, 0.0)), np.float64)
    return u - actions, gains


def inside(actions: Array, bend: Array, largest: float) -> tuple[NDArray[np.bool_], Array]:
    """Return which actions are within their bounds, and the curvature, with 1 in its place for the others."""
    free = np.abs(actions) < largest
    return free, np.where(free[:, :, None] & free[:, None], bend, np.eye(actions.shape[1]))
