"""Networks of our own learners, and the policy that acts with them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from lag_envs.leaderboard.kernels import affine
from lag_envs.leaderboard.networks import stacked
from lag_envs.store import write_file

Array = NDArray[np.float32]


def network(widths: Sequence[int], scale: float) -> nn.Sequential:
    """Return linear layers with tanh between them, the first one's weights multiplied by `scale`."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.Tanh()]
    with torch.no_grad():
        layers[0].weight.mul_(scale)
    return nn.Sequential(*layers[:-1])


def shared_weights(layers: nn.Sequential) -> list[tuple[Array, Array]]:
    """Return each layer's weights and biases as NumPy sees them; they change as the network learns."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    return [(x.weight.detach().numpy(), x.bias.detach().numpy()) for x in linear]


class Policy:
    """The acting policy: a network's weights as NumPy arrays, faster than PyTorch for small batches.

    Parameters
    ----------
    layers : sequence of (weight, bias)
        Arrays (out, in) and (out,) of each layer.
    choices : tuple of int
        The number of values to choose from, for each action; empty for continuous actions.
    largest : float
        The largest continuous action; the lowest is minus this.
    frames : int
        How many observations the network sees, side by side.
    """

    def __init__(
        self,
        layers: Sequence[tuple[Array, Array]],
        choices: tuple[int, ...],
        largest: float = 1.0,
        frames: int = 1,
    ) -> None:
        self.layers, self.choices, self.largest, self.frames = layers, choices, largest, frames

    def outputs(self, seen: NDArray) -> tuple[Array, Array]:
        """Return the last hidden layer (n, width) and the last layer (n, outputs) for what is seen."""
        hidden = seen
        for weight, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weight.T + bias)
        weight, bias = self.layers[-1]
        return hidden, hidden @ weight.T + bias

    def chosen(self, preferences: NDArray) -> NDArray[np.int64]:
        """Return the index of the preferred value of each action, (n, actions), or (n,) for a single one."""
        parts = np.split(preferences, np.cumsum(self.choices)[:-1], axis=-1)
        values = [part.argmax(axis=-1) for part in parts]
        return values[0] if len(values) == 1 else np.stack(values, axis=-1)

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray, Any]:
        """Return the best action for each observation, as the leaderboard does: in float64, row by row.

        `outputs` is faster, but its last bits depend on how many rows there are, and in chaotic motion that
        decides where an episode ends up. With several frames, the memory holds the last observations.
        """
        seen = np.asarray(observation, np.float64)
        if self.frames > 1:
            seen = state = stacked(seen, self.frames, state, episode_start)
        x = np.ascontiguousarray(seen.reshape(-1, seen.shape[-1]))
        for k, (weight, bias) in enumerate(self.layers):
            x = np.tanh(x) if k else x
            x = affine(x, np.ascontiguousarray(weight.T, np.float64), bias.astype(np.float64))
        last = x.reshape(*seen.shape[:-1], -1)
        if self.choices:
            return self.chosen(last), state
        return np.clip(last, -self.largest, self.largest).astype(np.float32), state

    def save(self, path: Path) -> None:
        """Write the weights as the leaderboard has them, in a zip that `numpy.load` reads."""
        file = io.BytesIO()
        layers = [{f"weight_{k}": w, f"bias_{k}": b} for k, (w, b) in enumerate(self.layers)]
        arrays = {name: array for layer in layers for name, array in layer.items()}
        arrays |= {"choices": np.array(self.choices, np.int64), "largest": np.array(self.largest)}
        arrays |= {"frames": np.array(self.frames)} if self.frames > 1 else {}
        np.savez(file, allow_pickle=False, **arrays)
        write_file(path, file.getvalue())

    @classmethod
    def load(cls, path: Path) -> Policy:
        """Return the policy that `save` wrote."""
        with np.load(path, allow_pickle=False) as found:
            count = sum(name.startswith("weight_") for name in found)
            layers = [(found[f"weight_{k}"], found[f"bias_{k}"]) for k in range(count)]
            frames = int(found.get("frames", 1))
            return cls(layers, tuple(found["choices"].tolist()), float(found["largest"]), frames)
