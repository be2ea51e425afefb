"""A task's step as a function, for planners: any state, any action, no random kick, no time limit."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.envs.lines import draw_lines, indented
from lag_envs.envs.program import program_for
from lag_envs.envs.reverse import Reverse
from lag_envs.scenes.checks import check_parameters, real_array
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping.compiling import absent_from, compile_lines
from lag_envs.stepping.normal_forms import lifted
from lag_envs.tasks.base import Task, check_task

Array = NDArray[np.float64]


#: How far states and actions are moved to expand guard and reward.
REACH = 5e-3


class Expansion(NamedTuple):
    """Derivatives of a step with respect to the m entries of state and action.

    Attributes
    ----------
    slopes : ndarray, shape (n, n_state, m)
        Derivatives of the state after the step.
    gradient : ndarray, shape (n, m)
        Derivatives of the reward.
    curvature : ndarray, shape (n, m, m)
        Second derivatives of the reward, without the contribution of the motion's second derivatives.
    """

    slopes: Array
    gradient: Array
    curvature: Array


class Gradient(NamedTuple):
    """A gradient with respect to the arguments of a step.

    Attributes
    ----------
    states : ndarray, shape (n, n_state)
        With respect to the states before the step.
    actions : ndarray, shape (n,), or (n, n_actions) where there are several
        With respect to the actions.
    targets : ndarray, shape (n, n_targets)
        With respect to the targets.
    parameters : ndarray, shape (n, n_parameters)
        With respect to the named parameters of the scene, separately for each row.
    """

    states: Array
    actions: Array
    targets: Array
    parameters: Array


class Model:
    """One step as a function: control, motion, reward and ending, from the environments' own formulas.

    It agrees with the environment's step to rounding, not bit for bit, because an environment carries cosθ
    and sinθ along whereas the model computes them from θ. The model applies no random kicks; use `kicked` for
    these.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.

    Examples
    --------
    >>> import gymnasium as gym, lag_envs
    >>> from lag_envs.envs.model import Model
    >>> model = Model(gym.make("PivotedBar-v0").unwrapped.task)
    >>> states, rewards, ended = model([[0.0, 0.0, 0.0, 0.0], [0.1, 0.0, 3.0, 0.1]], [1.0, 0.0])
    >>> states.shape, ended
    ((2, 4), array([False, False]))
    """

    def __init__(self, task: Task) -> None:
        check_task("Model", task)
        self.task = task
        constants = task.formulas.constants()
        program = program_for(task, absent_from(constants))
        self._constants = SimpleNamespace(**constants)
        self._numbers = np.array([constants[name] for name in program.uniform])
        self._step = program.model
        self._n_state = program.n_state
        self._reversed: dict[tuple[str, ...], Reverse] = {}

    def __reduce__(self) -> tuple[type[Model], tuple[Task]]:
        return Model, (self.task,)  # compiled functions are made again

    def __call__(
        self, states: ArrayLike, actions: ArrayLike, targets: ArrayLike | None = None
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Take one step from each state.

        Parameters
        ----------
        states : array_like, shape (n, n_state)
            States in the order of ``task.scene.state_names``. It does not matter whether an episode would
            have ended in these states.
        actions : array_like, shape (n,), or (n, n_actions) where there are several
            Actions; finite values outside their space are clipped.
        targets : array_like, shape (n,) or (), or (n, n_targets) or (n_targets,) where there are several
            Targets, for a task whose targets are random.

        Returns
        -------
        states : ndarray, shape (n, n_state)
            The states after the step.
        rewards : ndarray, shape (n,)
            The rewards.
        ended : ndarray of bool, shape (n,)
            Whether the episode terminates.

        Raises
        ------
        ValueError
            For values that are not finite or have another shape, and for a missing or superfluous target.
        StepRefused
            If a step cannot be taken to full accuracy.
        """
        states, actions, targets = self._checked(states, actions, targets)
        n = len(states)
        ends, rewards, ended = np.empty_like(states), np.empty(n), np.empty(n, np.bool_)
        refused = self._step(states, actions, targets, self._numbers, ends, rewards, ended)
        if refused:
            i = refused - 1
            held = self._control(states[i], actions[i], targets[i])
            raise self.task.formulas.refusal(states[i], held, self.task.dt, f"the step of row {i}")
        return ends, rewards, ended

    @np.errstate(all="ignore")
    def _control(self, state: Array, action: Array, target: Array) -> list[float]:
        """Return the controls that one action applies in a state."""
        formulas = self.task.formulas
        if not formulas.choices:
            action = np.clip(action, -formulas.largest, formulas.largest)
        y = lifted(form_of(self.task.scene), state, np)
        return [float(u) for u in formulas.control(np, [*action], y, [*target], self._constants)]

    def _checked(
        self, states: ArrayLike, actions: ArrayLike, targets: ArrayLike | None
    ) -> tuple[Array, Array, Array]:
        """Return states, actions and targets as arrays of two axes, or raise a ValueError."""
        states = self._checked_states(states)
        n = len(states)
        targets = self._targets(targets, n)
        actions = np.ascontiguousarray(real_array("actions", actions), np.float64)
        count = self.task.formulas.actions
        wanted = (n,) if count == 1 else (n, count)
        if actions.shape != wanted:
            raise ValueError(f"actions must have shape {wanted}, got {actions.shape}")
        actions = _finite("actions", actions).reshape(n, count)
        if choices := self.task.formulas.choices:
            bad = (actions != np.floor(actions)) | (actions < 0.0) | (actions >= np.array(choices))
            if bad.any():
                ranges = ", ".join(f"0 to {count - 1}" for count in choices)
                raise ValueError(f"actions must be numbers of choices, {ranges}; got {actions[bad][0]:g}")
        return states, actions, targets

    def _checked_states(self, states: ArrayLike) -> Array:
        """Return states as an array of shape (n, n_state), or raise a ValueError."""
        array = np.ascontiguousarray(real_array("states", states))
        if array.ndim != 2 or array.shape[1] != self._n_state:
            raise ValueError(f"states must have shape (n, {self._n_state}), got {np.shape(states)}")
        return _finite("states", array)

    def observe(self, states: ArrayLike, targets: ArrayLike | None = None) -> Array:
        """Return the observations of states, shape (n, n_observations).

        Parameters
        ----------
        states, targets : array_like
            As for a step.

        Raises
        ------
        ValueError
            As for a step.
        """
        states = self._checked_states(states)
        return self.reverse().observations(states, self._targets(targets, len(states)))

    def vjp(
        self,
        states: ArrayLike,
        actions: ArrayLike,
        targets: ArrayLike | None = None,
        *,
        by_states: ArrayLike = 0.0,
        by_observations: ArrayLike = 0.0,
        by_rewards: ArrayLike = 0.0,
        parameters: Sequence[str] = (),
        ends: ArrayLike | None = None,
        kicks: ArrayLike = 0.0,
    ) -> Gradient:
        """Pull a gradient back through a step (vector-Jacobian product).

        This is reverse mode through clipping, guard, motion, reward and observation. docs/derivatives.md
        explains what the gradient means at kinks and at the ends of episodes.

        Parameters
        ----------
        states, actions, targets : array_like
            As for a step.
        by_states : array_like, shape (n, n_state)
            The gradient with respect to the states after the step.
        by_observations : array_like, shape (n, n_observations)
            The gradient with respect to their observations.
        by_rewards : array_like, shape (n,)
            The gradient with respect to the rewards.
        parameters : sequence of str
            Parameters of the scene with respect to which the gradient is wanted.
        ends : array_like, shape (n, n_state), optional
            The states after the step, before kicks, if known.
        kicks : array_like, shape (n, n_state)
            What kicks added to these states, as constants.

        Returns
        -------
        Gradient

        Raises
        ------
        ValueError, StepRefused
            As a step does; ValueError also for a task whose actions are choices, for unknown parameters, and
            for a gradient that is not finite, with its row.
        """
        reverse = self.reverse(check_parameters(self.task.scene, parameters))
        shape = np.shape(actions)
        if ends is None:
            ends, _, _ = self(states, actions, targets)
        states, actions, targets = self._checked(states, actions, targets)
        n, observations = len(states), len(self.task.formulas.observation)
        ends = _rows("ends", ends, states.shape, single=False)
        kicked = (
            ends if isinstance(kicks, float) and kicks == 0.0 else ends + _rows("kicks", kicks, ends.shape)
        )
        seeds = {
            "by_states": _rows("by_states", by_states, (n, self._n_state)),
            "by_observations": _rows("by_observations", by_observations, (n, observations)),
            "by_rewards": _rows("by_rewards", by_rewards, (n,)),
        }
        slopes = reverse.vjp(states, actions, targets, ends, kicked, *seeds.values())
        if not all(np.isfinite(x).all() for x in slopes):
            row = int(np.argmin(np.isfinite(np.concatenate(slopes, axis=1)).all(axis=1)))
            given = ", ".join(f"{name}={x[row].tolist()}" for name, x in seeds.items())
            raise ValueError(
                f"the gradient of row {row} is not finite, with {given}: if these values are large, scale "
                "them down; otherwise a formula has an infinite slope in this row"
            )
        slopes[1] = slopes[1].reshape(shape)
        return Gradient(*slopes)

    def reverse(self, parameters: tuple[str, ...] = ()) -> Reverse:
        """Return the reverse mode of the step, with respect to these parameters too."""
        if parameters not in self._reversed:
            self._reversed[parameters] = Reverse(self.task, parameters)
        return self._reversed[parameters]

    def expand(self, states: ArrayLike, actions: ArrayLike, targets: ArrayLike | None = None) -> Expansion:
        """Expand one step about each state and action: the motion to first order, the reward to second order.

        The motion's derivatives are those of the scene's control step. Guard and reward have kinks, which a
        planner should see if they lie within reach: their formulas are expanded by central differences of
        `REACH`, along the linearised motion. The clipping of actions is ignored.

        Parameters
        ----------
        states, actions, targets : array_like
            As for a step.

        Returns
        -------
        Expansion
            The derivatives with respect to the state's entries and the actions.

        Raises
        ------
        ValueError, StepRefused
            As a step does; ValueError also for a task whose actions are choices.
        """
        formulas, form, k = self.task.formulas, form_of(self.task.scene), self._constants
        if formulas.choices:
            raise ValueError(
                f"{type(self.task).__name__} has a list of actions to choose from; "
                "choices have no derivatives"
            )
        ends, _, _ = self(states, actions, targets)
        states = real_array("states", states)
        n, width = states.shape
        acting = real_array("actions", actions).reshape(n, -1)
        goals = list(self._targets(targets, n).T)
        m = width + acting.shape[1]
        moves = _moves(m)
        given = np.concatenate([states, acting], axis=-1).T + moves[..., None]  # (moves, m, n)

        with np.errstate(all="ignore"):
            y = lifted(form, np.moveaxis(given[:, :width], -2, 0), np)
            applied = formulas.control(np, list(np.moveaxis(given[:, width:], 1, 0)), y, goals, k)
            u = np.zeros((len(moves), len(applied), n))
            for i, values in enumerate(applied):
                u[:, i] = values
            by_state, by_control = self.task.scene.jacobian(states, u[0].T, self.task.dt)
            by_both = np.concatenate([by_state, by_control], axis=-1)
            inner = np.concatenate([given[:, :width] - states.T, u - u[0]], axis=1)
            after = ends.T + np.einsum("nij,pjn->pin", by_both, inner)
            z = lifted(form, np.moveaxis(after, -2, 0), np)
            reward, ended = formulas.outcome(np, y, z, list(np.moveaxis(u, 1, 0)), goals, k)
            if formulas.has_last:
                last = formulas.last(np, y, z, list(np.moveaxis(u, 1, 0)), goals, k)
                reward = np.where(ended, last, reward)
        slopes = (after[1 : m + 1] - after[m + 1 : 2 * m + 1]) / (2.0 * REACH)
        return Expansion(
            np.moveaxis(slopes, (0, 2), (2, 0)), *_differences(np.broadcast_to(reward, (len(moves), n)), m)
        )

    def kicked(self, states: ArrayLike, draws: ArrayLike) -> Array:
        """Return the states after the task's random kick.

        Parameters
        ----------
        states : array_like, shape (n, n_state)
            States at a step's end.
        draws : array_like, shape (task.draws, n)
            The random numbers in [0, 1) of the kick.

        Raises
        ------
        ValueError
            For values that are not finite or have another shape.
        """
        array = self._checked_states(states)
        rows = lifted(form_of(self.task.scene), array.T, np)
        numbers = _rows("draws", draws, (self.task.draws, len(array)), single=False)
        kicked = self.task.formulas.kick(np, list(numbers), rows, self._constants)
        return np.stack(np.broadcast_arrays(*kicked[: self._n_state]), axis=-1)

    def kicks(self, episodes: NDArray[np.uint64], steps: NDArray[np.uint64]) -> Array:
        """Return what random kicks add to the states, for a task whose kicks do not depend on the state.

        Parameters
        ----------
        episodes : ndarray, shape (n,)
            The keys of the episodes' random numbers.
        steps : ndarray, shape (n,)
            The numbers of the steps, from 1.

        Returns
        -------
        ndarray, shape (n, n_state)
        """
        draws = np.empty((self.task.draws, len(episodes)))
        lines = ["key = episodes[i]", *draw_lines([f"draws[{j}, i]" for j in range(len(draws))], "steps[i]")]
        body = indented("for i in range(draws.shape[1]):", lines)
        compile_lines("draw_all", "draws, episodes, steps", body)(draws, episodes, steps)
        formulas, found = self.task.formulas, np.zeros((len(episodes), self._n_state))
        still = lifted(form_of(self.task.scene), np.zeros(self._n_state), np)
        for name, values in formulas.added(np, list(draws), still, self._constants).items():
            found[:, formulas.state.index(name)] = values
        return found

    def _targets(self, targets: ArrayLike | None, n: int) -> Array:
        """Return targets of shape (n, n_targets)."""
        count, fixed = self.task.formulas.targets, self.task.fixed_target
        if targets is not None and not count:
            raise ValueError("this task has no target; leave targets out")
        if targets is None and count and fixed is None:
            raise ValueError("the task's target is random, so targets must be given")
        if targets is None:
            given = np.empty(0) if fixed is None else fixed
            return np.ascontiguousarray(np.broadcast_to(given, (n, count)))
        array = real_array("targets", targets)
        if array.shape not in ([(), (n,)] if count == 1 else [(count,), (n, count)]):
            wanted = f"({n},) or ()" if count == 1 else f"({n}, {count}) or ({count},)"
            raise ValueError(f"targets must have shape {wanted}, got {array.shape}")
        rows = np.broadcast_to(array.reshape(-1, count), (n, count))
        return np.ascontiguousarray(_finite("targets", rows))


def _rows(name: str, values: ArrayLike, shape: tuple[int, ...], single: bool = True) -> Array:
    """Return finite values of a shape (or one number, if `single`), or raise a ValueError."""
    array = real_array(name, values)
    if array.shape != shape and not (single and array.ndim == 0):
        wanted = f"be one number or have shape {shape}" if single else f"have shape {shape}"
        raise ValueError(f"{name} must {wanted}, got {array.shape}")
    return np.broadcast_to(_finite(name, array), shape)


def _finite(name: str, values: Array) -> Array:
    """Return the values, or raise a ValueError that names the first row that is not finite."""
    bad = ~np.isfinite(values)
    if not bad.any():
        return values
    if not values.ndim:
        raise ValueError(f"{name} must be finite, got {values}")
    row = int(np.argwhere(bad)[0, 0])
    raise ValueError(f"{name} must be finite, got {values[row]} in row {row}")


def _moves(m: int) -> Array:
    """Return the displacements of m variables for differences: none, ± each, ± each pair."""
    i, j = np.triu_indices(m, 1)
    single = REACH * np.eye(m)
    pairs = single[i] + single[j]
    return np.concatenate([np.zeros((1, m)), single, -single, pairs, -pairs])


def _differences(values: Array, m: int) -> tuple[Array, Array]:
    """Return gradient (n, m) and second derivatives (n, m, m) from values (moves, n)."""
    i, j = np.triu_indices(m, 1)
    middle, plus, minus = values[0], values[1 : m + 1], values[m + 1 : 2 * m + 1]
    own = plus + minus - 2.0 * middle
    both = values[2 * m + 1 : 2 * m + 1 + len(i)] + values[2 * m + 1 + len(i) :] - 2.0 * middle
    curvature = np.empty((values.shape[1], m, m))
    curvature[:, range(m), range(m)] = own.T
    curvature[:, i, j] = curvature[:, j, i] = 0.5 * (both - own[i] - own[j]).T
    return (plus - minus).T / (2.0 * REACH), curvature / REACH**2
