"""The closed list of architectures of a submission: data in, actions out, with Stable-Baselines3's `predict`.

=============  ===================================================================================
architecture   what it is
=============  ===================================================================================
``mlp``        a network of fully connected layers
``linear``     action = gain · observation + offset, clipped
``table``      actions over a grid, or values over a grid that are looked up one step ahead
``controller`` one of `lag_envs.controllers`, with numbers
=============  ===================================================================================

An architecture is made from the table ``[policy]`` of ``submission.toml``. It tells which arrays it needs,
and makes a policy from them.
"""

from __future__ import annotations

import inspect
import math
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.fields import Fields, shown
from lag_envs.leaderboard.protocol import Refused
from lag_envs.tasks import resolve

Array = NDArray[np.float64]
#: Lengths of an array's axes; a name stands for any length of at least 2, the same wherever it occurs.
Shape = tuple[int | str, ...]


@dataclass(frozen=True)
class Policy:
    """An architecture with its arrays.

    Parameters
    ----------
    architecture : Architecture
        The architecture.
    arrays : mapping of str to ndarray of float64
        Its arrays.
    """

    architecture: Architecture
    arrays: Mapping[str, Array]

    def agent(self) -> Any:
        """Return what acts, with the `predict` of Stable-Baselines3, and nothing yet to remember or draw.

        Raises
        ------
        Refused
            Where the arrays' values do not fit.
        """
        return self.architecture.agent(self.arrays)


class Architecture(ABC):
    """One entry of the list, checked.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    table : Fields
        The table ``[policy]``, without ``architecture``.

    Raises
    ------
    Refused
        For anything wrong in the table.
    """

    #: Names and shapes of the arrays in each policy's file; nothing where there are no files.
    arrays: dict[str, Shape]
    #: Whether it searches for a plan in each episode, see `protocol.PLANNED`.
    plans = False

    @abstractmethod
    def __init__(self, env_id: str, table: Fields) -> None: ...

    @abstractmethod
    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return what acts; raise Refused where values do not fit."""


def architecture(env_id: str, table: Fields) -> Architecture:
    """Return the architecture that the table ``[policy]`` describes."""
    made = ARCHITECTURES[table.choice("architecture", ARCHITECTURES)](env_id, table)
    table.done()
    return made


class Agent(ABC):
    """Base of the agents without memory; a subclass defines `act`."""

    @abstractmethod
    def act(self, observations: Array) -> Array:
        """Return actions (n, n_actions), not clipped yet, for observations (n, n_observation)."""

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action for each observation."""
        values = np.asarray(observation, np.float64)
        # Whatever overflows ends in an action that is no number, which the verification refuses.
        with np.errstate(all="ignore"):
            actions = np.clip(self.act(np.atleast_2d(values)), -1.0, 1.0)
        return actions.astype(np.float32).reshape(*values.shape[:-1], -1), state


# --- networks -----------------------------------------------------------------------------------------------


def _sigmoid(x: Array) -> Array:
    return 0.5 + 0.5 * np.tanh(0.5 * x)


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "leaky_relu": lambda x: np.where(x > 0.0, x, 0.01 * x),
    "silu": lambda x: x * _sigmoid(x),
    "sigmoid": _sigmoid,
}


def bin_centres(bins: int) -> Array:
    """Return the middles of equal parts of [-1, 1], the actions of Gymnasium's ``DiscretizeAction``."""
    return (2.0 * np.arange(bins) + 1.0) / bins - 1.0


class MLP(Architecture):
    """A network of fully connected layers, evaluated in float64.

    In the table: `hidden`, the layers' widths, none for a linear map; `activation`; `squash` is "clip" or
    "tanh"; `mean_limit`, to which the last layer's output is clipped before squashing (the mean under SAC's
    gSDE), optional; `bins`, with which the network has so many outputs, the largest of which chooses the
    middle of one of so many equal parts of [-1, 1], instead of squashing; and the table ``normalise`` with
    `epsilon` and `clip`, with which the network sees (o - obs_mean)/√(obs_var + epsilon), clipped.

    Arrays: ``weight_0`` (out, in), ``bias_0`` (out,) and so on; with ``normalise`` also ``obs_mean`` and
    ``obs_var``.
    """

    def __init__(self, env_id: str, table: Fields) -> None:
        wide = len(protocol.make_task(env_id).observation)
        hidden = table.wholes("hidden", 0, protocol.LAYERS, 1, protocol.WIDTH)
        self.activation = table.choice("activation", ACTIVATIONS, "tanh")
        self.bins = table.whole("bins", 0, 1_001, 0)
        if self.bins == 1:
            raise Refused(f"{table.where}: bins must be at least 2, or left out, got 1")
        self.squash = "clip" if self.bins else table.choice("squash", ("clip", "tanh"))
        self.mean_limit = 0.0 if self.bins else table.number("mean_limit", 0.0, 1e6, 0.0)
        self.normalise = None
        self.controls = protocol.make_task(env_id).formulas.actions
        widths = [wide, *hidden, self.controls * (self.bins or 1)]
        self.arrays = {}
        for k, (rows, columns) in enumerate(zip(widths[1:], widths[:-1], strict=True)):
            self.arrays |= {f"weight_{k}": (rows, columns), f"bias_{k}": (rows,)}
        numbers = sum((columns + 1) * rows for rows, columns in zip(widths[1:], widths[:-1], strict=True))
        if numbers > protocol.NUMBERS:
            raise Refused(f"the network has {numbers} numbers, at most {protocol.NUMBERS} are accepted")
        if (part := table.any("normalise", None)) is not None:
            sub = Fields(f"{table.where}.normalise", part)
            self.normalise = sub.number("epsilon", 1e-12, 1.0, 1e-8), sub.number("clip", 1e-3, 1e9, 10.0)
            sub.done()
            self.arrays |= {"obs_mean": (wide,), "obs_var": (wide,)}
        self.layers = len(widths) - 1

    def agent(self, arrays: Mapping[str, Array]) -> _Network:
        """Return the network."""
        if self.normalise and (arrays["obs_var"] < 0.0).any():
            raise Refused("obs_var must not be below 0")
        return _Network(self, arrays)


class _Network(Agent):
    def __init__(self, mlp: MLP, arrays: Mapping[str, Array]) -> None:
        self.mlp, self.f = mlp, ACTIVATIONS[mlp.activation]
        self.layers = [
            (np.ascontiguousarray(arrays[f"weight_{k}"].T), np.ascontiguousarray(arrays[f"bias_{k}"]))
            for k in range(mlp.layers)
        ]
        self.centres = bin_centres(mlp.bins) if mlp.bins else None
        if mlp.normalise:
            epsilon, self.clip = mlp.normalise
            self.mean, self.deviation = arrays["obs_mean"], np.sqrt(arrays["obs_var"] + epsilon)

    def outputs(self, observations: Array) -> Array:
        """Return what the last layer puts out, shape (n, 1) or (n, bins)."""
        from lag_envs.leaderboard.kernels import affine

        x = observations
        if self.mlp.normalise:
            x = np.clip((x - self.mean) / self.deviation, -self.clip, self.clip)
        for k, (weight, bias) in enumerate(self.layers):
            x = affine(np.ascontiguousarray(x), weight, bias)
            if k + 1 < len(self.layers):
                x = self.f(x)
        return x

    def act(self, observations: Array) -> Array:
        x = self.outputs(observations)
        if self.centres is not None:
            worth = x.reshape(len(x), self.mlp.controls, -1)
            return np.where(np.isfinite(worth).all(axis=2), self.centres[worth.argmax(axis=2)], math.nan)
        if self.mlp.mean_limit:
            x = np.clip(x, -self.mlp.mean_limit, self.mlp.mean_limit)
        return np.tanh(x) if self.mlp.squash == "tanh" else x


class Linear(Architecture):
    """Action = gain · observation + offset, clipped to [-1, 1].

    Arrays: ``gain`` (n_observation,) and ``offset`` (1,), or (n_observation, n_actions)
    and (n_actions,) where an action has several numbers. `lag-envs info ID` lists the observation.
    """

    def __init__(self, env_id: str, table: Fields) -> None:
        task = protocol.make_task(env_id)
        wide, count = len(task.observation), task.formulas.actions
        self.arrays = {"gain": (wide,) if count == 1 else (wide, count), "offset": (count,)}

    def agent(self, arrays: Mapping[str, Array]) -> _Feedback:
        """Return the feedback."""
        return _Feedback(arrays["gain"], arrays["offset"])


class _Feedback(Agent):
    def __init__(self, gain: Array, offset: Array) -> None:
        self.gain = np.ascontiguousarray(gain.reshape(len(gain), -1))
        self.offset = np.ascontiguousarray(offset)

    def act(self, observations: Array) -> Array:
        from lag_envs.leaderboard.kernels import affine

        return affine(np.ascontiguousarray(observations), self.gain, self.offset)


# --- tables -------------------------------------------------------------------------------------------------


class Table(Architecture):
    """Numbers at the nodes of a grid, interpolated linearly along every axis; outside, as at the edge.

    In the table: `axes`, a list of what the axes are: a state by its name (`lag-envs info ID`), ``target``,
    a state relative to the target as ``"x - target"``, or ``time`` [s] since the episode's start. An angle
    that is observed by its cosine and sine lies in [-π, π].

    `kind` is "action" or "value". A table of actions is read off. One of values tells what is still to be had
    from where a step's motion ends (the mean over the random kick that may follow): the action is the one
    with the largest reward + value one step ahead, by the exact model of the undisturbed environment; of
    `actions` evenly spaced ones, and then of finer ones around the best.

    `mirror`, optional, names an axis; where it is negative, the mirror image is looked up: all signs but that
    of time changed, and that of the action, unless the control is a drag, which has no sign.

    Arrays: ``axis_0`` (n0,), ``axis_1`` (n1,) and so on, growing, and ``table`` (n0, n1, ...).
    """

    MOST_AXES = 5

    def __init__(self, env_id: str, table: Fields) -> None:
        self.task = protocol.make_task(env_id)
        if self.task.formulas.actions != 1 or self.task.formulas.targets > 1:
            raise Refused(f"{table.where}: tables are for tasks with one control and at most one target")
        names = list(self.task.scene.state_names)
        has_target = self.task.target_range is not None
        known = [*names, "time"]
        if has_target:
            known += ["target", *(f"{name} - target" for name in names)]
        self.axes = table.texts("axes", 1, self.MOST_AXES, 40)
        for axis in self.axes:
            if axis not in known:
                raise Refused(f"{table.where}: axes must be of {', '.join(known)}; got {shown(axis)}")
        if len(set(self.axes)) < len(self.axes):
            raise Refused(f"{table.where}: axes must differ")
        self.kind = table.choice("kind", ("action", "value"))
        self.actions = table.whole("actions", 3, 21, 11) if self.kind == "value" else 0
        mirror = table.any("mirror", "")
        if mirror not in ("", *(set(self.axes) - {"time"})):
            raise Refused(f"{table.where}: mirror must be one of the axes and not time, got {shown(mirror)}")
        #: For each axis the signs of (*states, target, time) of which it is the sum.
        self.sums = np.zeros((len(self.axes), len(names) + 2))
        for row, axis in zip(self.sums, self.axes, strict=True):
            first, _, minus = axis.partition(" - ")
            row[[*names, "target", "time"].index(first)] = 1.0
            if minus:
                row[-2] = -1.0
        self.mirror = self.axes.index(mirror) if mirror else None
        self.arrays = {f"axis_{j}": (f"n{j}",) for j in range(len(self.axes))}
        self.arrays["table"] = tuple(f"n{j}" for j in range(len(self.axes)))

    def agent(self, arrays: Mapping[str, Array]) -> _LookUp:
        """Return what looks up."""
        axes = [arrays[f"axis_{j}"] for j in range(len(self.axes))]
        for j, axis in enumerate(axes):
            if not (axis[1:] > axis[:-1]).all():
                raise Refused(f"the nodes of axis_{j} must grow")
        return _LookUp(self, axes, arrays["table"])


class _LookUp:
    """Acts by a table; its state is the number of steps taken."""

    def __init__(self, about: Table, axes: list[Array], values: Array) -> None:
        from lag_envs.controllers.basic import Reader
        from lag_envs.envs.model import Model

        self.about, self.axes = about, axes
        self.strides = np.array([math.prod(values.shape[j + 1 :]) for j in range(values.ndim)])
        self.values = np.ascontiguousarray(values).reshape(-1)
        self.read = Reader(about.task)
        self.model = Model(about.task) if about.kind == "value" else None
        #: What the clock goes on by at each `predict`: less than 1 for one who acts more often.
        self.pace = 1.0
        self.sign = 1.0 if getattr(about.task.scene, "control", None) == "damping" else -1.0

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Array]:
        """Return the action for each observation, and the steps taken then."""
        values = np.asarray(observation, np.float64)
        batch = np.atleast_2d(values)
        taken = np.zeros(len(batch)) if state is None else np.asarray(state, np.float64)
        if episode_start is not None:
            taken = np.where(np.broadcast_to(episode_start, len(batch)), 0.0, taken)
        states, targets = self.read(batch)
        with np.errstate(all="ignore"):
            if self.model is None:
                found, mirrored = self.look_up(states, targets, taken)
                actions = np.where(mirrored, self.sign * found, found)
            else:
                actions = self._greedy(states, targets, taken)
            actions = np.clip(actions, -1.0, 1.0)
        return actions.astype(np.float32).reshape(*values.shape[:-1], 1), taken + self.pace

    def look_up(self, states: Array, targets: Array, taken: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the table's numbers (n,), and where they are those of the mirror image."""
        from lag_envs.leaderboard.kernels import interpolate

        time = taken * self.about.task.interval
        if (angle := self.read.wrapped) is not None:
            states = states.copy()
            states[:, angle] = np.remainder(states[:, angle] + math.pi, 2.0 * math.pi) - math.pi
        given = [*states.T, targets, time]
        # Sums by hand: a matrix product's bits may depend on the number of rows.
        points = [sum(s * g for s, g in zip(row, given, strict=True) if s) for row in self.about.sums]
        mirrored = np.zeros(len(states), np.bool_)
        if self.about.mirror is not None:
            mirrored = points[self.about.mirror] < 0.0
            points = [
                p if name == "time" else np.where(mirrored, -p, p)
                for p, name in zip(points, self.about.axes, strict=True)
            ]
        cells, places = np.empty((len(states), len(points)), np.int64), np.empty((len(states), len(points)))
        for j, (axis, x) in enumerate(zip(self.axes, points, strict=True)):
            cell = np.clip(np.searchsorted(axis, x, side="right") - 1, 0, len(axis) - 2)
            cells[:, j] = cell
            places[:, j] = np.clip((x - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)
        return interpolate(self.values, self.strides, cells, places), mirrored

    def _greedy(self, states: Array, targets: Array, taken: Array) -> Array:
        coarse = np.linspace(-1.0, 1.0, self.about.actions)
        best = self._best(states, targets, taken, np.tile(coarse, (len(states), 1)))
        around = best[:, None] + (coarse[1] - coarse[0]) * np.linspace(-1.0, 1.0, 17)
        return self._best(states, targets, taken, np.clip(around, -1.0, 1.0))

    def _best(self, states: Array, targets: Array, taken: Array, actions: Array) -> Array:
        assert self.model is not None
        n, m = actions.shape
        goals = np.repeat(targets, m)
        wants = self.about.task.target_range is not None
        ends, rewards, ended = self.model(
            np.repeat(states, m, axis=0), actions.ravel(), goals if wants else None
        )
        later = self.look_up(ends, goals, np.repeat(taken, m) + 1.0)[0]
        gains = (rewards + np.where(ended, 0.0, later)).reshape(n, m)
        return np.take_along_axis(actions, gains.argmax(axis=1)[:, None], axis=1)[:, 0]


# --- controllers --------------------------------------------------------------------------------------------


#: Numbers of controllers that plan by which the planning gets longer.
PLANS = ("opening", "periods")


class Controller(Architecture):
    """A controller of `lag_envs.controllers`, made for the undisturbed environment.

    In the table: `name`, one of the controllers of the task, and the table ``numbers`` of its
    keyword arguments that are numbers, optional. There are no arrays.
    """

    def __init__(self, env_id: str, table: Fields) -> None:
        from lag_envs.controllers import build, controllers

        self.task = protocol.make_task(env_id)
        known = controllers(self.task)
        chosen = table.choice("name", known)
        found = known[chosen]
        self.build, self.plans = partial(build, self.task, chosen), found.plans
        numbers = table.table("numbers", {})
        self.numbers = {
            name: numbers.number(name, -1e6, 10.0 if name in PLANS else 1e6)
            for name, parameter in inspect.signature(resolve(found.place)).parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
            and name not in found.numbers
            and re.fullmatch(r"float( \| None)?", str(parameter.annotation))
            and name in numbers
        }
        numbers.done()
        self.arrays = {}

    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return a new controller."""
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return self.build(**self.numbers)
        except Exception as error:  # whatever senseless numbers lead to
            reason = shown(f"{type(error).__name__}: {error}")
            raise Refused(f"the controller cannot be made with these numbers: {reason}") from error


ARCHITECTURES: dict[str, type[Architecture]] = {
    "mlp": MLP,
    "linear": Linear,
    "table": Table,
    "controller": Controller,
}
