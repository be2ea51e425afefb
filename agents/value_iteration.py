"""Finite-horizon value iteration on a grid: one dynamic programme for every task of two or three dimensions.

V_t(x), the largest return that is still attainable from state x after t steps, is stored at the nodes of a
grid and interpolated linearly between them. A step does not depend on t, so the successor and the reward of
each action at each node are computed once (`transitions`); the backward recursion then only looks them up:

    V_t(x) = max over a of  reward(x, a) + E V_{t+1}(kicked(next(x, a))),    V_T = 0.

All V_t are stored in a file. A policy is read from it, and a run that was killed resumes from it.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.errors import UserError
from lag_envs.stepping.cache import jit
from lag_envs.store import write_file

Array = NDArray[np.float64]
#: (points (n, d), actions (n,)) to (coordinates (n, d), rewards (n,), ended (n,)).
Step = Callable[[Array, Array], tuple[Array, Array, NDArray[np.bool_]]]
#: points (n, d) to (coordinates (m, n, d), weights (m,)): the m outcomes of a random kick.
Kick = Callable[[Array], tuple[Array, Array]]

VALUES, PROGRESS = "values.npy", "progress.json"
#: Rows that are stepped together when the transitions are computed; bounds the memory.
CHUNK = 1_000_000
#: Seconds between two records of the progress.
RECORD = 1.0


class CacheError(UserError):
    """Raised if a cached value function cannot be used; the message says what to do."""


# --- the grid -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """A grid of nodes, and linear interpolation between them.

    Parameters
    ----------
    axes : tuple of ndarray
        The nodes of 2 or 3 axes, in increasing order; their spacing may vary.
    periods : tuple of float or None
        For each axis the period, or None. A periodic axis ends with its first node, one period later.
    """

    axes: tuple[Array, ...]
    periods: tuple[float | None, ...]

    def __post_init__(self) -> None:
        """Refuse grids that the compiled functions do not support."""
        if len(self.axes) not in (2, 3) or len(self.periods) != len(self.axes):
            raise ValueError(
                f"a grid has 2 or 3 axes and a period (or None) for each, got {len(self.axes)} axes and "
                f"{len(self.periods)} periods"
            )
        for j, (axis, period) in enumerate(zip(self.axes, self.periods, strict=True)):
            if len(axis) < 2 or not (np.diff(axis) > 0.0).all():
                raise ValueError(f"axis {j} needs at least two nodes, in increasing order, got {axis}")
            if period is not None and not np.isclose(axis[-1] - axis[0], period, rtol=1e-12):
                raise ValueError(
                    f"axis {j} has the period {period:g}: its last node must lie that far from its first, "
                    f"got {axis[0]:g} to {axis[-1]:g}"
                )

    @property
    def shape(self) -> tuple[int, ...]:
        """Nodes along each axis."""
        return tuple(len(axis) for axis in self.axes)

    @property
    def size(self) -> int:
        """Nodes in all."""
        return int(np.prod(self.shape))

    def points(self) -> Array:
        """Return the nodes, shape (size, d)."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1).reshape(self.size, -1)

    def locate(self, coordinates: Array) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the flat index of the cell's first node, (n,), and the place in the cell, (n, d), 0 to 1.

        Points outside are moved to the grid's edge.
        """
        cells, places = np.zeros(len(coordinates), np.int32), np.empty(coordinates.shape, np.float32)
        for j, (axis, period) in enumerate(zip(self.axes, self.periods, strict=True)):
            x = coordinates[:, j]
            if period is not None:
                x = axis[0] + np.mod(x - axis[0], period)
            cell = np.clip(np.searchsorted(axis, x, side="right") - 1, 0, len(axis) - 2)
            places[:, j] = np.clip((x - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)
            cells = cells * np.int32(len(axis)) + cell.astype(np.int32)
        return cells, places

    @property
    def strides(self) -> NDArray[np.int64]:
        """Strides: the distance of neighbours along each axis in the flat array."""
        return np.array([int(np.prod(self.shape[j + 1 :])) for j in range(len(self.shape))])


def stretched(low: float, centre: float, high: float, cells: int, scale: float) -> Array:
    """Return nodes that are dense around a centre: evenly spaced within `scale`, and ever wider beyond it.

    Half of the cells lie on either side of the centre, which is a node; if the centre is an end, all cells
    lie on one side. Doubling the number of cells halves each.
    """
    half = cells // 2
    numbers = (0, cells) if centre <= low else (cells, 0) if centre >= high else (half, cells - half)
    left, right = (
        scale * np.sinh(np.linspace(0.0, np.arcsinh(width / scale), number + 1))
        for width, number in zip((centre - low, high - centre), numbers, strict=True)
    )
    nodes = np.concatenate([centre - left[:0:-1], [centre], centre + right[1:]])
    nodes[0], nodes[-1] = low, high
    return nodes


@jit
def _interpolated(values: Any, cell: int, place: Any, strides: Any) -> float:
    """Return the value at a place in a cell; `values` is flat."""
    p, q = place[0], place[1]
    a, b = strides[0], strides[1]
    if len(place) == 2:
        low = values[cell] + q * (values[cell + b] - values[cell])
        high = values[cell + a] + q * (values[cell + a + b] - values[cell + a])
        return low + p * (high - low)
    r = place[2]
    v00 = values[cell] + r * (values[cell + 1] - values[cell])
    i = cell + b
    v01 = values[i] + r * (values[i + 1] - values[i])
    i = cell + a
    v10 = values[i] + r * (values[i + 1] - values[i])
    i = cell + a + b
    v11 = values[i] + r * (values[i + 1] - values[i])
    low, high = v00 + q * (v01 - v00), v10 + q * (v11 - v10)
    return low + p * (high - low)


@jit
def interpolate_rows(values: Any, times: Any, cells: Any, places: Any, strides: Any) -> Any:
    """Return for each row the value at its place in ``values[times[i]]``; a cell below 0 is worth 0."""
    out = np.zeros(len(cells))
    for i in range(len(cells)):
        if cells[i] >= 0:
            out[i] = _interpolated(values[times[i]], cells[i], places[i], strides)
    return out


@jit
def regridded(x: Any, nodes: Any, own: Any, others: Any) -> Any:
    """Map each x from its own axis, ``nodes[own[i]]``, to the same place among the nodes `others`."""
    out = np.empty(len(x))
    for i in range(len(x)):
        axis = nodes[own[i]]
        j = min(max(np.searchsorted(axis, x[i], side="right") - 1, 0), len(axis) - 2)
        place = min(max((x[i] - axis[j]) / (axis[j + 1] - axis[j]), 0.0), 1.0)
        out[i] = others[j] + place * (others[j + 1] - others[j])
    return out


# --- the dynamic programme ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Transitions:
    """The successor and the reward of every action at every node.

    Parameters
    ----------
    cells : ndarray of int32, shape (nodes, actions)
        Cell of the next state; -1 if the episode has ended.
    places : ndarray of float32, shape (nodes, actions, d)
        Place in that cell.
    rewards : ndarray of float32, shape (nodes, actions)
        The rewards.
    """

    cells: NDArray[np.int32]
    places: NDArray[np.float32]
    rewards: NDArray[np.float32]


def transitions(grid: Grid, actions: Array, step: Step) -> Transitions:
    """Compute all transitions."""
    n, m, d = grid.size, len(actions), len(grid.axes)
    result = Transitions(
        np.empty((n, m), np.int32), np.empty((n, m, d), np.float32), np.empty((n, m), np.float32)
    )
    points = grid.points()
    rows = max(1, CHUNK // m)
    for first in range(0, n, rows):
        part = slice(first, first + rows)
        here = np.repeat(points[part], m, axis=0)
        coordinates, rewards, ended = step(here, np.tile(actions, len(here) // m))
        if not (np.isfinite(rewards).all() and np.isfinite(coordinates).all()):
            row = int(np.argmin(np.isfinite(rewards) & np.isfinite(coordinates).all(axis=1)))
            raise ValueError(f"the step from {here[row]} is not finite; leave that node out of the grid")
        cells, places = grid.locate(coordinates)
        result.cells[part] = np.where(ended, np.int32(-1), cells).reshape(-1, m)
        result.places[part] = places.reshape(-1, m, d)
        result.rewards[part] = rewards.reshape(-1, m)
    return result


@jit
def _sweep(cells: Any, places: Any, rewards: Any, strides: Any, after: Any, values: Any, best: Any) -> None:
    """Write the value before a step, and the number of the best action, given the value after it."""
    for i in range(cells.shape[0]):
        top, arg = -np.inf, 0
        for j in range(cells.shape[1]):
            value = float(rewards[i, j])
            if cells[i, j] >= 0:
                value += _interpolated(after, cells[i, j], places[i, j], strides)
            if value > top:
                top, arg = value, j
        values[i] = top
        best[i] = arg


@jit
def _expect(weights: Any, cells: Any, places: Any, strides: Any, values: Any, expected: Any) -> None:
    """Write the expectation over the outcomes of a kick at each node."""
    for i in range(cells.shape[1]):
        total = 0.0
        for j in range(cells.shape[0]):
            total += weights[j] * _interpolated(values, cells[j, i], places[j, i], strides)
        expected[i] = total


class DynamicProgramme:
    """A dynamic programme: its grid and its steps.

    Parameters
    ----------
    grid : Grid
        The grid.
    actions : array_like, shape (m,)
        The actions to choose from.
    step : callable
        The deterministic part of a step, see `Step`.
    steps : int
        Steps T of an episode.
    kick : callable, optional
        The random part of a step, see `Kick`.
    parameters : dict, optional
        Everything the step depends on, in JSON types. It determines the cache's name and is stored in the
        cache.
    """

    def __init__(
        self,
        grid: Grid,
        actions: Sequence[float] | Array,
        step: Step,
        steps: int,
        kick: Kick | None = None,
        parameters: dict[str, Any] | None = None,
    ) -> None:
        if steps < 1:
            raise ValueError(f"an episode has at least one step, got steps={steps}")
        self.grid, self.actions, self.step, self.steps, self.kick = (
            grid, np.asarray(actions, np.float64), step, int(steps), kick,
        )  # fmt: skip
        self.parameters = (parameters or {}) | {
            "steps": self.steps,
            "nodes": list(grid.shape),
            "ranges": [[float(axis[0]), float(axis[-1])] for axis in grid.axes],
            "actions": len(self.actions),
            "fingerprint": self._fingerprint(),
        }
        #: CPU time of the solution so far [s].
        self.seconds = 0.0

    @property
    def name(self) -> str:
        """Name of the cache's folder, which changes with everything that affects the result."""
        text = json.dumps(self.parameters, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def bytes(self) -> int:
        """Size of the cached values."""
        return 4 * (self.steps + 1) * self.grid.size

    def _fingerprint(self) -> str:
        """Return a hash of nodes, actions and sampled steps, and so of the step's code too."""
        rng = np.random.default_rng(0)
        points = np.stack([rng.uniform(axis[0], axis[-1], 200) for axis in self.grid.axes], axis=1)
        results: list[Any] = list(self.step(points, rng.choice(self.actions, 200)))
        results += self.kick(points) if self.kick else []
        text = hashlib.sha256()
        for array in (*self.grid.axes, self.actions, *results):
            # Rounded, so that another machine's last digit does not matter.
            text.update((np.round(np.asarray(array, np.float64), 7) + 0.0).tobytes())
        text.update(repr(self.grid.periods).encode())
        return text.hexdigest()[:16]

    def solve(
        self, folder: Path | None = None, *, new: bool = False, label: str = "", quiet: bool = False
    ) -> NDArray[np.float32]:
        """Return V_t at all nodes for t = 0 ... T, shape (T + 1, *grid.shape); see `ValueCache`.

        Parameters
        ----------
        folder : Path, optional
            Parent of the cache's folder; without it nothing is stored on disk.
        new : bool
            Whether to discard the cache.
        label : str
            Label of the progress bar.
        quiet : bool
            Whether to hide the progress bar.
        """
        cache = None if folder is None else ValueCache(folder / self.name, self, new)
        values = np.zeros((self.steps + 1, self.grid.size), np.float32) if cache is None else cache.values
        done = self.steps if cache is None else cache.done
        self.seconds = 0.0 if cache is None else cache.seconds
        if done > 0:
            self._sweep_back(values, done, cache, label, quiet)
        return values.reshape(-1, *self.grid.shape)

    def _sweep_back(
        self, values: NDArray[np.float32], done: int, cache: ValueCache | None, label: str, quiet: bool
    ) -> None:
        from tqdm import tqdm

        before, started = self.seconds, time.process_time()
        table = transitions(self.grid, self.actions, self.step)
        expect = self.expectation()
        best = np.empty(self.grid.size, np.int32)
        bar = tqdm(
            total=self.steps, initial=self.steps - done, desc=label, unit="step", dynamic_ncols=True,
            disable=True if quiet else None, leave=False,
        )  # fmt: skip
        recorded = time.perf_counter()
        with bar:
            for t in range(done - 1, -1, -1):
                after = expect(values[t + 1])
                _sweep(table.cells, table.places, table.rewards, self.grid.strides, after, values[t], best)
                bar.update()
                now = time.perf_counter()
                self.seconds = before + time.process_time() - started
                if cache is not None and (t == 0 or now > recorded + RECORD):
                    cache.record(t, self.seconds)
                    recorded = now

    def expectation(self) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        """Return the function from flat values after a kick to those before it."""
        if self.kick is None:
            return lambda values: values
        coordinates, weights = self.kick(self.grid.points())
        located = [self.grid.locate(c) for c in coordinates]
        cells, places = np.stack([c for c, _ in located]), np.stack([p for _, p in located])

        def expected(values: NDArray[np.float32]) -> NDArray[np.float32]:
            result = np.empty_like(values)
            _expect(weights, cells, places, self.grid.strides, values, result)
            return result

        return expected

    def greedy(self, after: NDArray[np.float32]) -> Array:
        """Return the best action at every node, shape ``grid.shape``, given the values after the step."""
        table = transitions(self.grid, self.actions, self.step)
        values, best = np.empty(self.grid.size, np.float32), np.empty(self.grid.size, np.int32)
        flat = np.ascontiguousarray(after, np.float32).reshape(-1)
        strides = self.grid.strides
        _sweep(table.cells, table.places, table.rewards, strides, self.expectation()(flat), values, best)
        return self.actions[best].reshape(self.grid.shape)


# --- the cache ----------------------------------------------------------------------------------------------


class ValueCache:
    """The values in a folder: ``values.npy``, a memory-mapped array, and ``progress.json``, its progress.

    The progress file is replaced as a whole, and only after its values are written. So after a kill at any
    moment the next run resumes from the recorded progress, with the same result.

    Raises
    ------
    CacheError
        If the files are damaged or belong to another problem, or if the disk has no room for them.
    """

    def __init__(self, folder: Path, problem: DynamicProgramme, new: bool = False) -> None:
        self.folder, self.parameters = folder, problem.parameters
        self.done, self.seconds = problem.steps, 0.0
        shape = (problem.steps + 1, problem.grid.size)
        if new:
            (folder / PROGRESS).unlink(missing_ok=True)
        if (folder / PROGRESS).exists():
            self._open(shape)
        else:
            self._create(shape, problem.bytes)

    def _create(self, shape: tuple[int, int], size: int) -> None:
        file = self.folder / VALUES
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.values = np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=shape)
            if hasattr(os, "posix_fallocate"):  # otherwise a full disk would crash the run midway
                with file.open("r+b") as opened:
                    os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)
        except OSError as error:
            file.unlink(missing_ok=True)
            raise CacheError(
                f"{file} cannot be written: it takes {size / 1e6:,.0f} MB ({error}); make room, or choose "
                "another --folder"
            ) from error
        self.record(self.done, 0.0)

    def _open(self, shape: tuple[int, int]) -> None:
        try:
            progress = json.loads((self.folder / PROGRESS).read_text())
            found, self.done, check = progress["parameters"], progress["done"], progress["check"]
            self.seconds = float(progress["seconds"])
            if found != self.parameters:
                raise ValueError("it belongs to another problem")
            if not isinstance(self.done, int) or not 0 <= self.done < shape[0]:
                raise ValueError(f"done={self.done!r} is not a step of the episode")
            # Opening for writing would extend a file that is too short.
            kept = np.lib.format.open_memmap(self.folder / VALUES, mode="r")
            if kept.shape != shape or kept.dtype != np.float32:
                raise ValueError(f"{VALUES} holds {kept.dtype} of shape {kept.shape}")
            self.values = np.lib.format.open_memmap(self.folder / VALUES, mode="r+")
            if zlib.crc32(self.values[self.done]) != check:
                raise ValueError(f"the checksum of step {self.done} is wrong")
        except (OSError, ValueError, KeyError, TypeError, EOFError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise CacheError(
                f"the cache {self.folder} cannot be used ({reason}); delete it, or use --new"
            ) from error

    def record(self, done: int, seconds: float) -> None:
        """Record that V_t is known from t = done on."""
        self.values.flush()
        self.done, self.seconds = done, seconds
        progress = {
            "parameters": self.parameters, "done": done, "seconds": round(seconds, 3),
            "check": zlib.crc32(self.values[done]),
        }  # fmt: skip
        write_file(self.folder / PROGRESS, json.dumps(progress, indent=1) + "\n")
