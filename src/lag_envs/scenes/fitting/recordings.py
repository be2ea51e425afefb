"""Recordings of a motion: which are accepted, and a first guess of the missing values."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import numbers
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.checks import StepRefused, check_sequence, check_step, is_masked, real_array
from lag_envs.scenes.derivation import layout_of
from lag_envs.stepping.pendulum import MAX_SUBSTEPS

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

Array = NDArray[np.float64]

#: Largest numbers for angles of which only the rates were measured: starts that are tried for each angle,
#: starts that are tried for all of them together, and samples that are compared.
TRIED, MOST_TRIED, COMPARED = 16, 4096, 64
#: An angle may be in degrees if it spans more turns, or moves over half a turn in more than this part of
#: its steps.
MANY_TURNS, OFTEN = 100.0, 0.1
#: 2π, with a margin for rounding.
ONE_TURN = 2.0 * np.pi * (1.0 + 1e-9)
#: A place's changes over so many samples are compared with the integral of its rate. They are alike if they
#: correlate by this much; then neither should be more than this many times the other.
SPAN, ALIKE, AS_LARGE = 4, 0.9, 3.0
#: A step of more substeps than this is long: the steps of well-sampled motions need a few.
LONG = 40


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """States at equal intervals, and the controls held between them.

    Attributes
    ----------
    states : ndarray, shape (N, n_state)
        The measurements, NaN where missing.
    controls : ndarray, shape (N - 1, n_controls)
        Row i is held from state i to state i + 1.
    dt : float
        The interval [s].
    """

    states: Array
    controls: Array
    dt: float

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Whether each value was measured."""
        return np.isfinite(self.states)


def recordings_of(scene: Scene, given: Any) -> list[Recording]:
    """Return the recordings, checked, angles unwrapped; raise a ValueError that names what is wrong."""
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise ValueError(
            f"recordings must be a list of at least one (states, controls, dt), got {_kind(given)}"
        )
    if isinstance(given[-1], numbers.Real):
        raise ValueError(
            "recordings must be a list of (states, controls, dt), got a single recording; put it into a list"
        )
    found = []
    for i, one in enumerate(given):
        if not isinstance(one, tuple | list) or len(one) != 3:
            raise ValueError(f"recording {i} must be (states, controls, dt), got {_kind(one)}")
        try:
            found.append(_recording(scene, *one))
        except ValueError as error:
            raise ValueError(f"recording {i}: {error}") from None
    return found


def _recording(scene: Scene, states: Any, controls: Any, dt: Any) -> Recording:
    if np.ndim(dt):
        raise ValueError(
            "dt must be one number [s]; if the times are not evenly spaced, put the samples on a finer even "
            "grid, with NaN between them"
        )
    names, array = scene.state_names, _numbers(states)
    if array.ndim != 2 or array.shape[1] != len(names):
        raise ValueError(
            f"states must have shape (N, {len(names)}), with {', '.join(names)} in each row and NaN for "
            f"values that were not measured, got {array.shape}"
        )
    if np.isinf(array).any():
        raise ValueError(
            f"states must be finite, or NaN where not measured; row {_row(np.isinf(array))} is not"
        )
    if len(array) < 2:
        raise ValueError(f"there must be at least two states, got {len(array)}")
    if not np.isfinite(array).any():
        raise ValueError("nothing was measured: all states are NaN")
    return Recording(_unwrapped(scene, array), _controls(scene, controls, len(array)), check_step(dt))


def _numbers(states: Any) -> Array:
    """Return states as float64 array, or raise a ValueError with the remedy."""
    try:
        return real_array("states", states)
    except ValueError as error:
        kind, remedy = _kind(states), "; np.array(states, float) makes NaN of None"
        if is_masked(states):
            kind, remedy = "a masked array", "; call filled(np.nan)"
        elif error.__cause__:
            remedy = f": {error.__cause__}"
        elif isinstance(states, np.ndarray):
            kind, remedy = f"an array of type {states.dtype}", remedy if states.dtype == object else ""
        raise ValueError(
            f"states must be real numbers, with NaN for what was not measured, got {kind}{remedy}"
        ) from None


def _kind(value: Any) -> str:
    """Return what a value is, for a message; its data would not help."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    name = f"a {type(value).__name__}"
    return f"{name} of {len(value)}" if isinstance(value, tuple | list) else name


def _controls(scene: Scene, controls: Any, count: int) -> Array:
    """Return the controls of this many steps; None means that all are 0."""
    steps, n = count - 1, len(scene.control_names)
    if controls is None:
        return np.zeros((steps, n))
    if n:  # controls sampled together with the last state act only after it, and need not be finite
        array = real_array("controls", controls)
        controls = array[:steps] if array.shape[:1] == (count,) else array
    given = check_sequence(scene, controls)
    if len(given) not in ((steps,) if n else (steps, count)):
        raise ValueError(
            f"{count} states need controls for the {steps} steps between them, or controls for each state, "
            f"of which the last are not used; got {len(given)}"
        )
    return given[:steps]


def _unwrapped(scene: Scene, states: Array) -> Array:
    """Return the states, with angles that were measured within one turn made continuous."""
    for i, entry in enumerate(layout_of(scene).state):
        seen = np.isfinite(states[:, i])
        angles = states[seen, i]
        angle = entry.kind == "place" and entry.unit == "rad"
        if angle and len(angles) and np.ptp(angles) <= ONE_TURN:
            states[seen, i] = np.unwrap(angles)
    return states


def doubtful_units(scene: Scene, data: Sequence[Recording]) -> list[str]:
    """Return warnings about angles of many turns, or many of more than half a turn: they may be degrees."""
    texts = []
    for i, entry in enumerate(layout_of(scene).state):
        columns = [r.states[:, i] for r in data if r.measured[:, i].any()]
        if not columns or entry.kind != "place" or entry.unit != "rad":
            continue
        turns = max(np.nanmax(c) - np.nanmin(c) for c in columns) / (2.0 * np.pi)
        steps = np.concatenate([np.abs(np.diff(c)) for c in columns])
        steps = steps[np.isfinite(steps)]
        if turns > MANY_TURNS or (len(steps) and np.mean(steps > np.pi) > OFTEN):
            texts.append(
                f"{entry.name} spans {turns:.3g} turns in a recording; if it was measured in degrees, use "
                "np.radians"
            )
    return texts


def doubtful_rates(scene: Scene, data: Sequence[Recording]) -> list[str]:
    """Return warnings about rates that are not those of their places: unit, sign or dt may be wrong."""
    texts, names, entries = [], scene.state_names, layout_of(scene).state
    for i, place in enumerate(entries):
        rates = [j for j, e in enumerate(entries) if (e.coordinate, e.kind) == (place.coordinate, "velocity")]
        if place.kind != "place" or not rates:
            continue
        pairs = np.concatenate([_changes(r.states[:, i], r.states[:, rates[0]], r.dt) for r in data])
        squares, product = np.sum(pairs**2, axis=0), pairs[:, 0] @ pairs[:, 1]
        if not product or abs(product) < ALIKE * math.sqrt(squares[0] * squares[1]):
            continue
        factor = squares[1] / product
        if not 1.0 / AS_LARGE < factor < AS_LARGE:
            texts.append(
                f"{names[rates[0]]} is {factor:.3g} times the rate at which {names[i]} changes: check units "
                "(radians or degrees), signs, the order of the columns and dt"
            )
    return texts


def _changes(places: Array, rates: Array, dt: float) -> Array:
    """Return changes of a place over `SPAN` samples, and the integrals of its rate, shape (n, 2)."""
    ahead = places[SPAN:] - places[:-SPAN]
    steps = 0.5 * dt * (rates[1:] + rates[:-1])
    sums = sum((steps[k : len(steps) - SPAN + 1 + k] for k in range(SPAN)), start=np.zeros(len(ahead)))
    pairs = np.stack([ahead, sums], axis=1)
    return pairs[np.isfinite(pairs).all(axis=1)]


def doubtful_interval(scene: Scene, data: Sequence[Recording], guesses: Sequence[Array]) -> list[str]:
    """Return a warning if steps need many substeps, since the interval may not be in seconds."""
    counts = []
    for recording, states in zip(data, guesses, strict=True):
        at = len(recording.controls) // 2
        with contextlib.suppress(StepRefused):
            counts.append(scene.step_bound(states[at], recording.controls[at], recording.dt).substeps)
    if len(counts) < len(data) or not LONG < max(counts) <= MAX_SUBSTEPS:  # beyond this, steps are refused
        return []
    i = int(np.argmax(counts))
    return [
        f"a step of recording {i} lasts {data[i].dt:g} s and needs {counts[i]} substeps, so the search will "
        "take long; if the interval is not in seconds, convert it"
    ]


def _row(bad: NDArray[np.bool_]) -> int:
    return int(np.argwhere(bad)[0, 0])


def guess(scene: Scene, recording: Recording) -> Array:
    """Return states near those of a recording, shape (N, n_state), with a value for each entry.

    Measurements are smoothed lightly, and gaps are bridged. A rate that was not measured is the slope of the
    place; a place that was not measured is the integral of the rate from 0, or for an angle from where the
    scene's accelerations are most like the data's.
    """
    dt, count = recording.dt, len(recording.states)
    entries = layout_of(scene).state
    known: dict[tuple[str, bool], tuple[Array, Array]] = {}
    for i, entry in enumerate(entries):
        seen = np.flatnonzero(recording.measured[:, i])
        if len(seen):
            values = np.interp(np.arange(count), seen, recording.states[seen, i])
            known[entry.coordinate, entry.kind == "place"] = _parabolas(values, dt)
    found, turned = np.zeros((count, len(entries))), []
    for i, entry in enumerate(entries):
        place = entry.kind == "place"
        if (entry.coordinate, place) in known:
            found[:, i] = known[entry.coordinate, place][0]
        elif not place and (entry.coordinate, True) in known:
            found[:, i] = known[entry.coordinate, True][1]
        elif place and (entry.coordinate, False) in known:
            rate = known[entry.coordinate, False][0]
            found[1:, i] = np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))
            if entry.unit == "rad" and entry.coordinate in layout_of(scene).free:
                turned.append(i)
    if turned:
        slopes = {entries[i].coordinate: known[entries[i].coordinate, False][1] for i in turned}
        found[:, turned] += _turns(scene, recording, found, turned, slopes)
    return found


def _turns(
    scene: Scene, recording: Recording, states: Array, turned: list[int], slopes: dict[str, Array]
) -> Array:
    """Return by how much to turn entries so that accelerations are most like the slopes of their rates.

    Accelerations and slopes are compared up to a factor, since the parameters are still wrong.
    """
    count = min(TRIED, int(MOST_TRIED ** (1.0 / len(turned))))
    angles = np.indices((count,) * len(turned)).reshape(len(turned), -1).T * (2.0 * np.pi / count)
    steps = len(states) - 1
    some = np.arange(0, steps, -(-steps // COMPARED))
    tried = np.repeat(states[None, some], len(angles), axis=0)
    tried[:, :, turned] += angles[:, None]
    controls = np.broadcast_to(recording.controls[some], (*tried.shape[:2], recording.controls.shape[1]))
    found = scene.acceleration(tried, controls if scene.control_names else 0.0)
    accelerations = np.concatenate([found[name] for name in slopes], axis=1)
    size = np.maximum(np.linalg.norm(accelerations, axis=1), np.finfo(float).tiny)
    likeness = accelerations @ np.concatenate([slope[some] for slope in slopes.values()]) / size
    return angles[np.argmax(np.where(np.isfinite(likeness), likeness, -np.inf))]


def _parabolas(values: Array, dt: float) -> tuple[Array, Array]:
    """Return values and slopes of the parabola through each sample and up to three to either side."""
    half = min(3, (len(values) - 1) // 2)
    if not half:
        return values, np.gradient(values, dt)
    k = np.arange(-half, half + 1)
    fitted = np.linalg.pinv(np.vander(k, 3, increasing=True))  # rows: value, slope, half the curvature
    windows = np.lib.stride_tricks.sliding_window_view(values, len(k))
    value, slope, curvature = fitted @ windows.T
    at = np.arange(len(values))
    centre = np.clip(at, half, len(values) - 1 - half)  # at the ends, use the last full window
    off, centre = at - centre, centre - half
    smooth = value[centre] + off * (slope[centre] + off * curvature[centre])
    return smooth, (slope[centre] + 2.0 * off * curvature[centre]) / dt
