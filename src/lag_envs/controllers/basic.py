"""Shared parts of controllers, and a few controllers that do not know the equations of motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.envs.actions import Actions
from lag_envs.errors import hint
from lag_envs.scenes.checks import shown
from lag_envs.scenes.derivation import form_of, layout_of
from lag_envs.tasks.base import Task, check_task
from lag_envs.tasks.formulas import Lifted, TaskFormulas

Array = NDArray[np.float64]


class FeedbackLaw(NamedTuple):
    """A controller that is pure feedback: actions a - K (x - x₀), step by step.

    After the last step, the last entries are used. The action is the clipped numbers or, if actions are
    choices, the index of the largest number.
    """

    states: Array  #: x₀, shape (steps, n)
    actions: Array  #: a, shape (steps, numbers)
    gains: Array  #: K, shape (steps, numbers, n)
    read: ObservationDecoder | None  #: computes x from the observation; None if x is the observation


class Agent(ABC):
    """Base of our agents. Agents of other libraries need only `predict`, see `trait`.

    Attributes
    ----------
    random : bool
        Whether it draws random numbers, for all episodes together.
    of_one_interval : bool
        Whether its memory is valid only for steps of one length.
    plans_at_start : bool
        Whether all planning is done at the start of an episode.
    pace : float or None
        By how much each call advances its clock, which an evaluation sets; None if it counts no steps.
    """

    random = False
    of_one_interval = False
    plans_at_start = False
    pace: float | None = None

    @abstractmethod
    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, Any]:
        """Return the action for each observation, and the state to pass to the next call."""

    def law(self, task: Task) -> FeedbackLaw | None:
        """Return the agent as feedback; None if it is not pure feedback."""
        return None


def trait(agent: Any, name: str) -> Any:
    """Return an attribute of `Agent`; an agent of another library that lacks it has the default."""
    return getattr(agent, name, getattr(Agent, name))


class Stateless(Agent):
    """Base of the agents without memory; a subclass defines `answer`."""

    @abstractmethod
    def answer(self, observation: NDArray) -> NDArray:
        """Return the action for each observation."""

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, Any]:
        """Return the action for each observation; the state is passed on."""
        return self.answer(observation), state


class Constant(Stateless):
    """Always the same action.

    Parameters
    ----------
    action : float or sequence of float
        The action: in [-1, 1], for each control.
    """

    def __init__(self, action: Any) -> None:
        self.action = action

    def answer(self, observation: NDArray) -> NDArray:
        """Return the action, for each observation."""
        own: NDArray = np.atleast_1d(np.asarray(self.action, np.float32))
        return np.tile(own, (*np.shape(observation)[:-1], 1))

    def law(self, task: Task) -> FeedbackLaw:
        """Return the controller as feedback."""
        actions, n = np.full((1, task.formulas.actions), self.action, np.float64), len(task.observation)
        return FeedbackLaw(np.zeros((1, n)), actions, np.zeros((1, actions.size, n)), None)


def constant(task: Task, *, action: Any) -> Constant | Choice:
    """Return the agent that always takes one action; among listed actions, the action with this index."""
    if not task.formulas.choices:
        return Constant(action)
    Actions(task.formulas).one(action)  # a ValueError if there is no such choice
    return Choice(task, choice=action)


class Feedback(Stateless):
    """Actions that are linear in the observation, clipped.

    Parameters
    ----------
    task : Task
        The task.
    gain : array_like, shape (n_actions, n_observation)
        Factor of each entry of the observation.
    """

    def __init__(self, task: Task, *, gain: ArrayLike) -> None:
        self.task, self.largest = task, task.formulas.largest
        self.gain = np.atleast_2d(np.asarray(gain, np.float64))
        if self.gain.shape != (wanted := (task.formulas.actions, len(task.observation))):
            raise ValueError(f"gain must have shape {wanted}, got {self.gain.shape}")

    def answer(self, observation: NDArray) -> NDArray[np.float32]:
        """Return the action, for each observation."""
        values = check_observation(self.task, observation)
        return np.clip(values @ self.gain.T, -self.largest, self.largest).astype(np.float32)

    def law(self, task: Task) -> FeedbackLaw:
        """Return the controller as feedback."""
        m, n = self.gain.shape
        return FeedbackLaw(np.zeros((1, n)), np.zeros((1, m)), -self.gain[None], None)


def feedback(task: Task, **gains: float) -> Feedback:
    """Return linear feedback for a task with one control; keywords are entries of the observation."""
    check_single_control("feedback", task)
    for name in gains:
        if name not in task.observation:
            raise ValueError(f"there is no observation {name!r}, only {', '.join(task.observation)}")
    return Feedback(task, gain=[[gains.get(name, 0.0) for name in task.observation]])


class Switch(Stateless):
    """The largest control, in the direction given by the sign of a weighted sum of observations.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``, with one control.
    weights : mapping
        Weight of each entry of the observation in the sum.
    """

    def __init__(self, task: Task, *, weights: Mapping[str, float]) -> None:
        check_acts("Switch", task)
        if task.formulas.actions > 1:
            raise ValueError(f"Switch takes one control; {type(task).__name__} has several")
        check_names("weights", weights, list(task.observation))
        self.task = task
        self.weights = np.array([weights.get(name, 0.0) for name in task.observation])

    def answer(self, observation: NDArray) -> NDArray:
        """Return the action for each observation."""
        side = np.where(check_observation(self.task, observation) @ self.weights < 0.0, -1.0, 1.0)
        return actions_for(self.task, side * self.task.limit_control)


def do_nothing(of: gym.Env | Task) -> Constant | Choice:
    """Return the agent of zero control; if the control is a brake, its action is -1."""
    task = of if isinstance(of, Task) else of.unwrapped.task  # type: ignore[attr-defined]
    return Choice(task) if task.formulas.choices else Constant(task.rest_action)


class Choice(Stateless):
    """In tasks whose actions are choices, always the same choice, or a random one.

    Parameters
    ----------
    task : Task
        The task.
    choice : int or sequence of int, optional
        The choice, or one for each control; by default the choice of the smallest control.
    rng : Generator, optional
        If given, choices are random, drawn from this generator.
    """

    def __init__(
        self, task: Task, *, choice: ArrayLike | None = None, rng: np.random.Generator | None = None
    ) -> None:
        self.task, self.rng, self.random = task, rng, rng is not None
        self.choice = np.asarray(task.rest_action if choice is None else choice, np.int64)
        self.shape = Actions(task.formulas).shape

    def answer(self, observation: NDArray) -> NDArray:
        """Return the choice, for each observation."""
        shape = (*np.shape(observation)[:-1], *self.shape)
        if self.rng is None:
            return np.broadcast_to(self.choice, shape).copy()
        choices = self.task.formulas.choices
        return self.rng.integers(choices if self.shape else choices[0], size=shape)


class Random(Stateless):
    """Uniformly random actions.

    Parameters
    ----------
    seed : int
        Seed of the actions.
    count : int
        Number of controls of an action.
    largest : float
        The largest action.
    """

    random = True

    def __init__(self, seed: int, count: int = 1, largest: float = 1.0) -> None:
        self.rng, self.count, self.largest = np.random.default_rng(seed), count, largest

    def answer(self, observation: NDArray) -> NDArray[np.float32]:
        """Return an action for each observation."""
        shape = (*np.shape(observation)[:-1], self.count)
        return self.rng.uniform(-self.largest, self.largest, shape).astype(np.float32)


def at_random(task: Task, seed: int = 0) -> Random | Choice:
    """Return the agent of random actions."""
    if task.formulas.choices:
        return Choice(task, rng=np.random.default_rng(seed))
    return Random(seed, task.formulas.actions, task.formulas.largest)


class FeedbackController(Stateless):
    """Base of the controllers without memory, whose control depends on the state alone.

    A subclass defines `control`. Controls beyond the task's limit are clipped.

    Parameters
    ----------
    task : Task
        The task with its parameters, ``env.unwrapped.task``.
    complete : bool
        Whether the observation has to determine the whole state.
    """

    def __init__(self, task: Task, *, complete: bool = False) -> None:
        self.task = task
        self.read = ObservationDecoder(task, complete=complete)

    @abstractmethod
    def control(self, state: Array, target: Array) -> Array:
        """Return controls [SI units] for states (..., n_state) and targets (...): see `actions_for`."""

    def answer(self, observation: NDArray) -> NDArray:
        """Return the action for each observation."""
        return actions_for(self.task, self.control(*self.read(observation)))


def actions_for(task: Task, controls: Array) -> NDArray:
    """Return the actions for controls, or for the nearest possible controls.

    Parameters
    ----------
    task : Task
        The task.
    controls : ndarray, shape (...) or (..., n_actions)
        The controls to set [SI units]; without the last axis if there is only one control.
    """
    formulas = task.formulas
    if formulas.choices:
        each = [controls] if formulas.actions == 1 else np.moveaxis(controls, -1, 0)
        nearest = [
            np.abs(u[..., None] - np.array(a.values)).argmin(axis=-1)
            for u, a in zip(each, formulas.acting, strict=True)
        ]
        return nearest[0] if formulas.actions == 1 else np.stack(nearest, axis=-1)
    if formulas.actions == 1:
        return as_actions(formulas.action(controls), formulas.largest)
    low, high = (np.array([getattr(a, end) for a in formulas.acting]) for end in ("low", "high"))
    shares = 2.0 * (controls - low) / (high - low) - 1.0
    return (formulas.largest * np.clip(shares, -1.0, 1.0)).astype(np.float32)


def per_control(formulas: TaskFormulas) -> tuple[Array, Array]:
    """Return (scale, offset) that turn controls into the numbers of actions, as in `actions_for`.

    Among listed controls c, the one nearest to u has the largest 2 c u - c².
    """
    if formulas.choices:
        (acting,) = formulas.acting
        values = np.array(acting.values)
        return 2.0 * values, -(values**2)
    low, high = (np.array([getattr(a, end) for a in formulas.acting]) for end in ("low", "high"))
    scale = 2.0 * formulas.largest / (high - low)
    return scale, -0.5 * scale * (high + low)


def check_observation(task: Task, observation: ArrayLike) -> Array:
    """Return observations (..., n) as float64; raise a ValueError for a wrong shape or non-finite numbers."""
    names = list(task.observation)
    try:
        values = np.asarray(observation, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the observation must be numbers, got {shown(observation)}") from error
    if values.shape[-1:] != (len(names),):
        raise ValueError(
            f"observations of {type(task).__name__} must have shape (..., {len(names)}) for "
            f"{', '.join(names)}; got {values.shape}"
        )
    if not np.isfinite(values).all():
        place = np.argwhere(~np.isfinite(values))[0]
        row = f" in row {', '.join(map(str, place[:-1]))}" if len(place) > 1 else ""
        raise ValueError(f"the observation {names[place[-1]]!r} must be finite, got {values[*place]}{row}")
    return values


def check_counts(least: int = 1, /, **numbers: Any) -> None:
    """Raise a ValueError for a number that is not whole or is too small."""
    for name, number in numbers.items():
        if not isinstance(number, (int, np.integer)) or number < least:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {number}")


def check_names(what: str, given: Iterable[str], known: Sequence[str]) -> None:
    """Raise a ValueError for a name that is not among the known names."""
    for name in given:
        if name not in known:
            raise ValueError(f"{what}: there is no {name!r}; {hint(name, known)}")


def check_continuous(what: str, task: Task) -> None:
    """Raise a ValueError for a task without actions, or whose actions are listed."""
    check_acts(what, task)
    if task.formulas.choices:
        raise ValueError(f"{what} takes continuous actions; {type(task).__name__} has listed actions")


def check_acts(what: str, task: Task) -> None:
    """Raise a ValueError for a task without actions, and a TypeError for anything but a task."""
    check_task(what, task)
    if not task.formulas.actions:
        raise ValueError(f"{what} has nothing to do: {type(task).__name__} has no control to act with")


def check_single_control(what: str, task: Task) -> None:
    """Raise a ValueError for a task that does not have one control with continuous actions."""
    if task.formulas.choices or task.formulas.actions != 1:
        has = "listed actions" if task.formulas.choices else f"{task.formulas.actions} controls"
        raise ValueError(f"{what} takes one control with continuous actions; {type(task).__name__} has {has}")


def beginning(n: int, state: Any, episode_start: ArrayLike | None) -> NDArray[np.bool_]:
    """Return which of n episodes begin: all without a memory, otherwise those with a set `episode_start`."""
    fresh = np.full(n, state is None)
    return fresh if episode_start is None else fresh | np.asarray(episode_start, np.bool_).reshape(n)


def hold_law(task: Task, rest: Array, gain: Array, read: ObservationDecoder) -> FeedbackLaw:
    """Return the feedback with controls -K (x - rest), K of shape (n_state,) or (n_actions, n_state)."""
    scale, offset = per_control(task.formulas)
    return FeedbackLaw(rest[None], offset[None], (scale[:, None] * np.atleast_2d(gain))[None], read)


def as_actions(values: Array, largest: float = 1.0) -> NDArray[np.float32]:
    """Return numbers (...) as actions (..., 1), clipped to the largest."""
    return np.clip(values, -largest, largest)[..., None].astype(np.float32)


class ObservationDecoder:
    """A decoder, which computes states and targets from observations.

    A task's observation has to be linear in the state, in the cosine and sine of its angles (coordinates with
    the unit rad), and in the target. Its values at zero and at the unit vectors, or at shorter vectors if an
    entry is clipped, then suffice to invert it.

    Parameters
    ----------
    task : Task
        The task.
    complete : bool
        Whether the observation has to determine the whole state, and the target if it is random.

    Raises
    ------
    ValueError
        For other observations; the message names the entries that cannot be determined.
    """

    def __init__(self, task: Task, *, complete: bool = False) -> None:
        check_task("a controller", task)
        formulas, form = task.formulas, form_of(task.scene)
        k = SimpleNamespace(**formulas.constants())
        self.task, self._n = task, len(task.scene.state_names)
        entries = enumerate(layout_of(task.scene).state)
        angles = [i for i, entry in entries if entry.kind == "place" and entry.unit == "rad"]
        self._width = self._n + 2 * len(angles)

        def seen(row: NDArray[np.float64]) -> list:
            """Return the observation for a state, the cosines and sines of its angles, and a target."""
            state = list(row[: self._n])
            circles = row[self._n : self._width].reshape(-1, 2)
            known = [(state[i], *circle) for i, circle in zip(angles, circles, strict=True)]
            if form is not None and form.angle is not None:
                state += circles[angles.index(form.angle)].tolist()
            return formulas.observe(Lifted(np, known), state, list(row[self._width :][: formulas.targets]), k)

        width = self._width + max(formulas.targets, 1)
        with np.errstate(all="ignore"):
            slopes, bad = self._linear(seen, width)
            if bad.any():
                raise ValueError(self._unreadable("observation", np.array(list(task.observation))[bad]))
        self._slopes, self._angles = slopes, angles
        self._inverse = np.linalg.pinv(slopes)
        #: The angles that are observed only by cosine and sine, and so lie in [-π, π], with their indices.
        pairs = [(i, self._n + 2 * j) for j, i in enumerate(angles) if not slopes[i].any()]
        self._pairs = [(i, j) for i, j in pairs if slopes[j].any() and slopes[j + 1].any()]
        self.wrapped = [i for i, _ in self._pairs]
        told = np.abs(slopes @ self._inverse - np.eye(width)).max(axis=1) < 1e-6
        told[self.wrapped] = [told[[j, j + 1]].all() for _, j in self._pairs]
        if complete and not told[: self._n].all():
            raise ValueError(self._unreadable("state", np.array(task.scene.state_names)[~told[: self._n]]))
        if complete and formulas.targets and task.fixed_target is None and not told[self._width :].all():
            raise ValueError(
                f"this controller reads the target from the observation, but {type(task).__name__} does not "
                "tell it: observe every target, linearly, or fix it"
            )

    def _linear(
        self, seen: Callable[[NDArray[np.float64]], list], width: int
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the observation's slopes (width, n), and which of its entries are not linear."""
        self._zero = np.array(seen(np.zeros(width)), np.float64)

        def risen(rows: Array) -> Array:
            return np.array([seen(row) for row in rows], np.float64) - self._zero

        def differs(one: Array, other: Array) -> NDArray[np.bool_]:
            near = np.isclose(one, other, rtol=1e-9, atol=1e-11 * np.maximum(1.0, np.abs(self._zero)))
            return np.asarray(~near.all(axis=0))

        size, axes = 1.0, np.eye(width)
        while (bad := differs(risen(size * axes), 2.0 * risen(0.5 * size * axes))).any():
            size *= 0.5
            if size < 1e-3:  # short enough that no entry is clipped
                break
        slopes = risen(size * axes) / size
        rows = np.random.default_rng(0).uniform(-size / width, size / width, (4, width))
        return slopes, bad | differs(risen(rows), rows @ slopes)

    def _unreadable(self, what: str, names: Iterable[str]) -> str:
        """Return the message for entries that cannot be determined."""
        return (
            f"this controller reads the state from the observation, but not {', '.join(names)} in the {what} "
            f"of {type(self.task).__name__}: observe every entry of the state, linearly; of an angle, whose "
            "unit is rad, cosine and sine are enough"
        )

    def __call__(self, observation: NDArray) -> tuple[Array, Array]:
        """Return states (..., n_state) and targets for observations (..., n).

        Targets have the shape (...), with zeros if the task has no target, or (..., n_targets) if it has
        several.
        """
        lifted = (check_observation(self.task, observation) - self._zero) @ self._inverse
        state = lifted[..., : self._n].copy()
        for i, j in self._pairs:
            state[..., i] = np.arctan2(lifted[..., j + 1], lifted[..., j])
        targets = lifted[..., self._width :]
        return state, targets[..., 0] if targets.shape[-1] == 1 else targets

    def numbers(self) -> dict[str, Any]:
        """Return the data of the decoder, in JSON types."""
        return {
            "zero": self._zero.tolist(),
            "inverse": self._inverse.tolist(),
            "states": self._n,
            "width": self._width,
            "pairs": self._pairs,
        }

    def expected(self, states: Array) -> tuple[Array, Array]:
        """Return observations of states (n, n_state) without targets, and the Jacobian matrices."""
        turned = states[:, self._angles]
        circles = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
        lifted = np.concatenate([states, circles.reshape(len(states), -1)], axis=1)
        slopes = np.tile(self._slopes[: self._n].T, (len(states), 1, 1))
        for j, i in enumerate(self._angles):
            by_cos, by_sin = self._slopes[self._n + 2 * j : self._n + 2 * j + 2]
            slopes[:, :, i] += np.outer(-circles[:, j, 1], by_cos) + np.outer(circles[:, j, 0], by_sin)
        return self._zero + lifted @ self._slopes[: self._width], slopes

    def difference(self, states: Array, others: Array) -> Array:
        """Return differences of states (..., n_state); angles seen only by cos and sin: the shorter way."""
        off = states - others
        for i in self.wrapped:
            off[..., i] -= 2.0 * np.pi * np.rint(off[..., i] / (2.0 * np.pi))
        return off
