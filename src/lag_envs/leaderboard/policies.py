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
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model, model_validator

from lag_envs.controllers.basic import ObservationDecoder
from lag_envs.controllers.lookahead import Clocked, LookAhead
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.fields import Strict, accepted, between, line, many, shown
from lag_envs.leaderboard.protocol import Refused
from lag_envs.tasks import TASKS, resolve
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]
#: Lengths of an array's axes; a name stands for any length of at least 2, the same wherever it occurs.
Shape = tuple[int | str, ...]


#: How messages call the table.
POLICY = "[policy]"


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


class PolicyTable(Strict):
    """The table ``[policy]``."""

    architecture: str


class Architecture(ABC):
    """One entry of the list, checked.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    table : Strict
        The table ``[policy]``, as `table` describes it.

    Raises
    ------
    Refused
        For anything wrong in the table.
    """

    #: What the table ``[policy]`` must be.
    table: type[Strict] = PolicyTable
    #: Names and shapes of the arrays in each policy's file; nothing where there are no files.
    arrays: dict[str, Shape]
    #: Whether it searches for a plan in each episode, see `protocol.PLANNED`.
    plans = False

    @abstractmethod
    def __init__(self, env_id: str, table: Any) -> None: ...

    @abstractmethod
    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return what acts; raise Refused where values do not fit."""


def architecture(env_id: str, table: Mapping[str, Any]) -> Architecture:
    """Return the architecture that the table ``[policy]`` describes."""
    name = table.get("architecture")
    if not isinstance(name, str) or name not in ARCHITECTURES:
        known = ", ".join(sorted(ARCHITECTURES))
        raise Refused(f"{POLICY}: architecture must be one of {known}, got {shown(name)}")
    kind = ARCHITECTURES[name]
    return kind(env_id, accepted(kind.table, dict(table), POLICY))


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


class Normalise(Strict):
    """How a network's observations are normalised."""

    epsilon: Annotated[float, between(1e-12, 1.0)] = 1e-8
    clip: Annotated[float, between(1e-3, 1e9)] = 10.0


class MLPTable(PolicyTable):
    """The table of a network."""

    hidden: Annotated[list[Annotated[int, between(1, protocol.WIDTH)]], many(0, protocol.LAYERS)]
    activation: Literal["tanh", "relu", "elu", "leaky_relu", "silu", "sigmoid"] = "tanh"
    bins: Annotated[int, between(2, 1_001)] | None = None
    squash: Literal["clip", "tanh"] | None = None
    mean_limit: Annotated[float, between(0.0, 1e6)] = 0.0
    normalise: Normalise | None = None

    @model_validator(mode="after")
    def _fit(self) -> Self:
        given = self.model_fields_set & {"squash", "mean_limit"}
        if self.bins and given:
            raise ValueError(f"{min(given)} means nothing beside bins; leave it out")
        if not self.bins and self.squash is None:
            raise ValueError("squash or bins is missing")
        return self


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

    table = MLPTable

    def __init__(self, env_id: str, table: MLPTable) -> None:
        wide = len(TASKS[env_id]().observation)
        self.activation, self.bins, self.squash = table.activation, table.bins, table.squash
        self.mean_limit, self.normalise = table.mean_limit, table.normalise
        self.controls = TASKS[env_id]().formulas.actions
        widths = [wide, *table.hidden, self.controls * (self.bins or 1)]
        self.arrays = {}
        for k, (rows, columns) in enumerate(zip(widths[1:], widths[:-1], strict=True)):
            self.arrays |= {f"weight_{k}": (rows, columns), f"bias_{k}": (rows,)}
        numbers = sum((columns + 1) * rows for rows, columns in zip(widths[1:], widths[:-1], strict=True))
        if numbers > protocol.NUMBERS:
            raise Refused(f"the network has {numbers} numbers, at most {protocol.NUMBERS} are accepted")
        if self.normalise:
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
            self.clip, self.mean = mlp.normalise.clip, arrays["obs_mean"]
            self.deviation = np.sqrt(arrays["obs_var"] + mlp.normalise.epsilon)

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

    Arrays: ``gain`` (n_observation,) and ``offset`` (1,), each with an axis for the numbers of an action
    where these are several. `lag-envs info ID` lists the observation.
    """

    def __init__(self, env_id: str, table: PolicyTable) -> None:
        task = TASKS[env_id]()
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


class GridTable(PolicyTable):
    """The table of numbers on a grid."""

    axes: Annotated[list[Annotated[str, line(40)]], many(1, 5)]
    kind: Literal["action", "value"]
    actions: Annotated[int, between(3, 21)] = 11
    mirror: str = ""

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if len(set(self.axes)) < len(self.axes):
            raise ValueError("axes must differ")
        if self.kind == "action" and "actions" in self.model_fields_set:
            raise ValueError("actions means nothing in a table of actions; leave it out")
        if self.mirror not in ("", *(set(self.axes) - {"time"})):
            raise ValueError(f"mirror must be one of the axes and not time, not {shown(self.mirror)}")
        return self


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

    table = GridTable

    def __init__(self, env_id: str, table: GridTable) -> None:
        self.task = TASKS[env_id]()
        if self.task.formulas.actions != 1 or self.task.formulas.targets > 1:
            raise Refused(f"{POLICY}: tables are for tasks with one control and at most one target")
        names = list(self.task.scene.state_names)
        has_target = self.task.target_range is not None
        known = [*names, "time"]
        if has_target:
            known += ["target", *(f"{name} - target" for name in names)]
        self.axes = tuple(table.axes)
        for axis in self.axes:
            if axis not in known:
                raise Refused(f"{POLICY}: axes must be of {', '.join(known)}; got {shown(axis)}")
        self.kind, self.actions, mirror = table.kind, table.actions, table.mirror
        #: For each axis the signs of (*states, target, time) of which it is the sum.
        self.sums = np.zeros((len(self.axes), len(names) + 2))
        for row, axis in zip(self.sums, self.axes, strict=True):
            first, _, minus = axis.partition(" - ")
            row[[*names, "target", "time"].index(first)] = 1.0
            if minus:
                row[-2] = -1.0
        self.mirror = self.axes.index(mirror) if mirror else None
        #: Of an action in the mirror image; a control that is zero at an end of its range has no sign.
        self.sign = 1.0 if abs(self.task.rest_action) == 1.0 else -1.0
        self.arrays = {f"axis_{j}": (f"n{j}",) for j in range(len(self.axes))}
        self.arrays["table"] = tuple(f"n{j}" for j in range(len(self.axes)))

    def agent(self, arrays: Mapping[str, Array]) -> Clocked:
        """Return what acts by the numbers."""
        axes = [arrays[f"axis_{j}"] for j in range(len(self.axes))]
        for j, axis in enumerate(axes):
            if not (axis[1:] > axis[:-1]).all():
                raise Refused(f"the nodes of axis_{j} must grow")
        grid = _Grid(self, axes, arrays["table"])
        if self.kind == "action":
            return _LookUp(self.task, grid)
        return LookAhead(self.task, grid.value, np.linspace(-1.0, 1.0, self.actions))


class _Grid:
    """Numbers over a grid."""

    def __init__(self, about: Table, axes: list[Array], values: Array) -> None:
        self.about, self.axes, self.wrapped = about, axes, ObservationDecoder(about.task).wrapped
        self.strides = np.array([math.prod(values.shape[j + 1 :]) for j in range(values.ndim)])
        self.values = np.ascontiguousarray(values).reshape(-1)

    def value(self, states: Array, targets: Array, taken: Array) -> Array:
        """Return the numbers (n,) where steps end that began with so many taken."""
        return self.look_up(states, targets, taken + 1.0)[0]

    def look_up(self, states: Array, targets: Array, taken: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the numbers (n,), and where they are those of the mirror image."""
        from lag_envs.leaderboard.kernels import interpolate

        time = taken * self.about.task.interval
        if self.wrapped:
            states = states.copy()
        for angle in self.wrapped:
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


class _LookUp(Clocked):
    """Reads actions off a grid."""

    def __init__(self, task: Task, grid: _Grid) -> None:
        super().__init__(task)
        self.grid = grid

    def act(self, states: Array, targets: Array, taken: Array) -> Array:
        found, mirrored = self.grid.look_up(states, targets, taken)
        return np.where(mirrored, self.grid.about.sign * found, found)


# --- controllers --------------------------------------------------------------------------------------------


#: Numbers of controllers that plan by which the planning gets longer.
PLANS = ("opening", "periods")


class ControllerTable(PolicyTable):
    """The table of a built-in controller."""

    name: str
    numbers: dict[str, Any] = Field(default={})


class Controller(Architecture):
    """A controller of `lag_envs.controllers`, made for the undisturbed environment.

    In the table: `name`, one of the controllers of the task, and the table ``numbers`` of its
    keyword arguments that are numbers, optional. There are no arrays.
    """

    table = ControllerTable

    def __init__(self, env_id: str, table: ControllerTable) -> None:
        from lag_envs.controllers import build, controllers

        self.task = TASKS[env_id]()
        known = controllers(self.task)
        if table.name not in known:
            raise Refused(f"{POLICY}: name must be one of {', '.join(known)}, got {shown(table.name)}")
        found = known[table.name]
        self.build, self.plans = partial(build, self.task, table.name), found.plans
        own: dict[str, Any] = {
            name: (Annotated[float, between(-1e6, 10.0 if name in PLANS else 1e6)], 0.0)
            for name, parameter in inspect.signature(resolve(found.place)).parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
            and name not in found.numbers
            and re.fullmatch(r"float( \| None)?", str(parameter.annotation))
        }
        numbers = accepted(create_model("Numbers", __base__=Strict, **own), table.numbers, "[policy.numbers]")
        self.numbers = numbers.model_dump(exclude_unset=True)
        self.arrays = {}

    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return a new controller."""
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return self.build(**self.numbers)
        except Exception as error:  # whatever nonsensical numbers cause
            reason = shown(f"{type(error).__name__}: {error}")
            raise Refused(f"the controller cannot be made with these numbers: {reason}") from error


ARCHITECTURES: dict[str, type[Architecture]] = {
    "mlp": MLP,
    "linear": Linear,
    "table": Table,
    "controller": Controller,
}
