"""Networks and linear maps from observations to actions."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.architecture import (
    POLICY,
    Architecture,
    Array,
    Head,
    Memoryless,
    PageData,
    PolicyTable,
    Remembering,
)
from lag_envs.leaderboard.fields import Strict, between, length_between
from lag_envs.leaderboard.protocol import Refused
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task


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
    """Return the centres of equal parts of [-1, 1], the actions of Gymnasium's ``DiscretizeAction``."""
    return (2.0 * np.arange(bins) + 1.0) / bins - 1.0


def stacked(observation: NDArray, frames: int, before: NDArray | None = None, start: Any = None) -> NDArray:
    """Return an episode's last observations side by side, oldest first; zeros stand for any before its start.

    Parameters
    ----------
    observation : ndarray, shape (..., n_observation)
        The newest observation.
    frames : int
        The number of observations to return.
    before : ndarray, shape (..., frames * n_observation), optional
        The result of the step before; without it, all episodes begin.
    start : array_like of bool, shape (...), optional
        Which episodes begin.
    """
    if frames == 1:
        return observation
    wide = observation.shape[-1]
    if before is None:
        before = np.zeros((*observation.shape[:-1], frames * wide), observation.dtype)
    elif start is not None:
        begins = np.resize(start, (*observation.shape[:-1], 1))
        before = np.where(begins, before.dtype.type(0), before)
    return np.concatenate([before[..., wide:], observation], axis=-1)


class Normalise(Strict):
    """How a network's observations are normalised."""

    epsilon: Annotated[float, between(1e-12, 1.0)] = 1e-8
    clip: Annotated[float, between(1e-3, 1e9)] = 10.0


class NetworkTable(PolicyTable):
    """The fields that all networks' tables share."""

    hidden: Annotated[list[Annotated[int, between(1, protocol.WIDTH)]], length_between(0, protocol.LAYERS)]
    activation: Literal["tanh", "relu", "elu", "leaky_relu", "silu", "sigmoid"] = "tanh"
    bins: Annotated[int, between(2, 1_001)] | None = None
    squash: Literal["clip", "tanh"] | None = None
    mean_limit: Annotated[float, between(0.0, 1e6)] = 0.0
    normalise: Normalise | None = None

    @model_validator(mode="after")
    def _fit(self) -> Self:
        given = self.model_fields_set & {"squash", "mean_limit"}
        if self.bins and given:
            raise ValueError(f"{min(given)} has no effect with bins; leave it out")
        return self


class MLPTable(NetworkTable):
    """The table of a network of fully connected layers."""

    frames: Annotated[int, between(1, protocol.FRAMES)] = 1
    padding: Literal["zero", "first"] = "zero"

    @model_validator(mode="after")
    def _framed(self) -> Self:
        if self.frames == 1 and "padding" in self.model_fields_set:
            raise ValueError("padding has no meaning without frames; leave it out")
        return self


class GRUTable(NetworkTable):
    """The table of a network with a gated recurrent unit."""

    memory: Annotated[int, between(1, protocol.MEMORY)]
    hidden: Annotated[
        list[Annotated[int, between(1, protocol.WIDTH)]], length_between(0, protocol.LAYERS)
    ] = Field(default=[])


class Network(Architecture):
    """Base of the networks: fully connected layers, the last of which decides the action."""

    counts_as = "learned"

    def _layers(self, task: Task, table: NetworkTable, wide: int, features: int) -> None:
        """Read the table and set the arrays of layers that take this many `features`.

        Observations to normalise have length `wide`.
        """
        self.head, self.controls = Head(task), task.formulas.actions
        self.activation, self.bins, self.squash = table.activation, table.bins, table.squash
        self.mean_limit, self.normalise = table.mean_limit, table.normalise
        given = table.model_fields_set & {"bins", "squash", "mean_limit"}
        if self.head.choices:
            self.schema = 2
            if given:
                raise Refused(f"{POLICY}: {min(given)} has no meaning where actions are listed; leave it out")
        elif not self.bins and self.squash is None:
            raise Refused(f"{POLICY}: squash or bins is missing")
        widths = [features, *table.hidden, self.head.size * (self.bins or 1)]
        for k, (rows, columns) in enumerate(zip(widths[1:], widths[:-1], strict=True)):
            self.arrays |= {f"weight_{k}": (rows, columns), f"bias_{k}": (rows,)}
        self.layers = len(widths) - 1
        numbers = sum(math.prod(map(int, shape)) for shape in self.arrays.values())
        if numbers > protocol.NUMBERS:
            raise Refused(f"the network has {numbers} numbers; at most {protocol.NUMBERS} are accepted")
        if self.normalise:
            self.arrays |= {"obs_mean": (wide,), "obs_var": (wide,)}

    def agent(self, arrays: Mapping[str, Array]) -> Memoryless | Remembering:
        """Return the network."""
        if self.normalise and (arrays["obs_var"] < 0.0).any():
            raise Refused("obs_var must not be below 0")
        return self._made(arrays)

    @abstractmethod
    def _made(self, arrays: Mapping[str, Array]) -> Memoryless | Remembering: ...

    @property
    @abstractmethod
    def _kind(self) -> dict[str, Any]:
        """The kind of network, and the numbers of this kind, for a page."""

    def page_data(self, arrays: Mapping[str, Array]) -> PageData:
        """Return the network's data."""
        about = {
            "layers": self.layers,
            "activation": self.activation,
            "bins": self.bins,
            "controls": self.controls,
            "squash": self.squash,
            "mean_limit": self.mean_limit,
            "normalise": self.normalise and self.normalise.model_dump(),
        }
        return PageData(about | self._kind, arrays, self.head)


class MLP(Network):
    """A network of fully connected layers, evaluated in float64.

    In the table: `hidden`, the layers' widths, none for a linear map; `activation`; `squash`, "clip" or
    "tanh"; `mean_limit`, optional, to which the last layer's output is clipped before squashing (the mean
    under SAC's gSDE); `bins`, instead of squashing: [-1, 1] is cut into this many equal parts, the network
    has an output for each, and the largest output chooses the centre of its part; and the table ``normalise``
    with `epsilon` and `clip`: then the network sees (o - obs_mean)/√(obs_var + epsilon), clipped. If actions
    are listed, the network has an output for each value of each list, the largest of which chooses, and there
    is no `squash`, `mean_limit` or `bins`.

    With `frames`, optional, it sees that many observations, the oldest first. Those before the first are
    zeros, or copies of the first with `padding` "first".

    Arrays: ``weight_0`` (out, in), ``bias_0`` (out,) and so on; with ``normalise`` also ``obs_mean`` and
    ``obs_var``.
    """

    table = MLPTable

    def __init__(self, env_id: str, table: MLPTable, task: Task | None = None) -> None:
        task = TASKS[env_id]() if task is None else task
        self.frames, self.padding = table.frames, table.padding
        if "frames" in table.model_fields_set:
            self.schema = 2
        wide = len(task.observation) * self.frames
        self.arrays = {}
        self._layers(task, table, wide, wide)

    def _made(self, arrays: Mapping[str, Array]) -> Memoryless | Remembering:
        layers = _Layers(self, arrays)
        return _Feedforward(layers) if self.frames == 1 else _Stacked(layers, self.frames, self.padding)

    @property
    def _kind(self) -> dict[str, Any]:
        return {"kind": "mlp", "frames": self.frames, "padding": self.padding}


class GRU(Network):
    """A gated recurrent unit, followed by fully connected layers, evaluated in float64.

    In the table: `memory`, the size m of the unit, and everything that ``mlp`` has except `frames`; `hidden`
    lists the layers after the unit, none if left out. The unit is PyTorch's: with the logistic function σ and
    the observation o, normalised if the table says so, the memory h, zero at first, becomes

        r, z = σ(W_r o + b_r + V_r h + c_r), σ(W_z o + b_z + V_z h + c_z)
        h = (1 - z) tanh(W_n o + b_n + r (V_n h + c_n)) + z h

    Arrays: ``weight_ih`` (3m, n_observation) and ``bias_ih`` (3m,), which hold W and b of r, z and n, one
    below the other; ``weight_hh`` (3m, m) and ``bias_hh`` (3m,), which hold V and c; and those of the layers.
    """

    table = GRUTable
    schema = 2

    def __init__(self, env_id: str, table: GRUTable) -> None:
        task = TASKS[env_id]()
        wide, self.memory = len(task.observation), table.memory
        tall = 3 * self.memory
        self.arrays = {"weight_ih": (tall, wide), "bias_ih": (tall,)}
        self.arrays |= {"weight_hh": (tall, self.memory), "bias_hh": (tall,)}
        self._layers(task, table, wide, self.memory)

    def _made(self, arrays: Mapping[str, Array]) -> Memoryless | Remembering:
        return _Recurrent(_Layers(self, arrays), arrays)

    @property
    def _kind(self) -> dict[str, Any]:
        return {"kind": "gru", "memory": self.memory}


class _Layers:
    """The layers of a network."""

    def __init__(self, made: Network, arrays: Mapping[str, Array]) -> None:
        self.made, self.head, self.f = made, made.head, ACTIVATIONS[made.activation]
        self.weights = [
            (np.ascontiguousarray(arrays[f"weight_{k}"].T), np.ascontiguousarray(arrays[f"bias_{k}"]))
            for k in range(made.layers)
        ]
        self.centres = bin_centres(made.bins) if made.bins else None
        if made.normalise:
            self.clip, self.mean = made.normalise.clip, arrays["obs_mean"]
            self.deviation = np.sqrt(arrays["obs_var"] + made.normalise.epsilon)

    def normalised(self, observations: Array) -> Array:
        """Return the observations as the network's input."""
        if not self.made.normalise:
            return observations
        return np.clip((observations - self.mean) / self.deviation, -self.clip, self.clip)

    def outputs(self, features: Array) -> Array:
        """Return the last layer's output."""
        from lag_envs.leaderboard.kernels import affine

        x = features
        for k, (weight, bias) in enumerate(self.weights):
            x = affine(x, weight, bias)
            if k + 1 < len(self.weights):
                x = self.f(x)
        return x

    def numbers(self, features: Array) -> Array:
        """Return numbers for the head."""
        x = self.outputs(features)
        if self.head.choices:
            return x
        if self.centres is not None:
            worth = x.reshape(len(x), self.made.controls, -1)
            chosen = np.where(np.isfinite(worth).all(axis=2), self.centres[worth.argmax(axis=2)], math.nan)
            return self.head.largest * chosen
        if self.made.mean_limit:
            x = np.clip(x, -self.made.mean_limit, self.made.mean_limit)
        return self.head.largest * np.tanh(x) if self.made.squash == "tanh" else x

    def decide(self, observations: Array) -> Array:
        """Return numbers for the head, for observations that are not yet normalised."""
        return self.numbers(self.normalised(observations))


class _Feedforward(Memoryless):
    def __init__(self, layers: _Layers) -> None:
        super().__init__(layers.head, layers.decide)
        self.layers = layers


class _Stacked(Remembering):
    """Its memory is the last observations, shape (n, frames, n_observation)."""

    def __init__(self, layers: _Layers, frames: int, padding: str) -> None:
        super().__init__(layers.head)
        self.layers, self.frames, self.padding = layers, frames, padding

    def begin(self, observations: Array) -> Array:
        filled = np.repeat(observations[:, None], self.frames, axis=1)
        return filled if self.padding == "first" else np.zeros_like(filled)

    def act(self, observations: Array, memories: Array) -> tuple[Array, Array]:
        seen = np.concatenate([memories[:, 1:], observations[:, None]], axis=1)
        return self.layers.decide(seen.reshape(len(seen), -1)), seen


class _Recurrent(Remembering):
    """Its memory is the unit's hidden state, shape (n, memory)."""

    def __init__(self, layers: _Layers, arrays: Mapping[str, Array]) -> None:
        super().__init__(layers.head)
        self.layers, self.size = layers, arrays["weight_hh"].shape[1]
        self.seen, self.kept = (
            (np.ascontiguousarray(arrays[f"weight_{part}"].T), np.ascontiguousarray(arrays[f"bias_{part}"]))
            for part in ("ih", "hh")
        )

    def begin(self, observations: Array) -> Array:
        return np.zeros((len(observations), self.size))

    def act(self, observations: Array, memories: Array) -> tuple[Array, Array]:
        from lag_envs.leaderboard.kernels import affine

        seen = affine(self.layers.normalised(observations), *self.seen)
        kept = affine(memories, *self.kept)
        (r_o, z_o, n_o), (r_h, z_h, n_h) = (np.split(part, 3, axis=1) for part in (seen, kept))
        z = _sigmoid(z_o + z_h)
        memories = (1.0 - z) * np.tanh(n_o + _sigmoid(r_o + r_h) * n_h) + z * memories
        return self.layers.numbers(memories), memories


class Linear(Architecture):
    """Action = gain · observation + offset, clipped to [-1, 1].

    Arrays: ``gain`` (n_observation,) and ``offset`` (1,), each with one more axis if an action has several
    numbers. If actions are listed, there is a number for each value of each list, the largest of which
    chooses. `lag-envs info ID` lists the observation.
    """

    def __init__(self, env_id: str, table: PolicyTable) -> None:
        task = TASKS[env_id]()
        self.head, wide = Head(task), len(task.observation)
        if self.head.choices:
            self.schema = 2
        count = self.head.size
        self.arrays = {"gain": (wide,) if count == 1 else (wide, count), "offset": (count,)}

    def agent(self, arrays: Mapping[str, Array]) -> Memoryless:
        """Return the feedback."""
        gain, offset = (np.ascontiguousarray(arrays[name]) for name in ("gain", "offset"))
        return Memoryless(self.head, partial(_linear, gain.reshape(len(gain), -1), offset))

    def page_data(self, arrays: Mapping[str, Array]) -> PageData:
        """Return the arrays, which say everything."""
        return PageData({"kind": "linear"}, arrays, self.head)


def _linear(gain: Array, offset: Array, observations: Array) -> Array:
    from lag_envs.leaderboard.kernels import affine

    return affine(observations, gain, offset)
