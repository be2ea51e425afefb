"""Recordings of a motion: which are accepted, and a first guess of the missing values."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.checks import check_sequence, check_step, real_array, shown
from lag_envs.scenes.derivation import layout_of

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

Array = NDArray[np.float64]

#: Starts that are tried for an angle whose rate alone was measured, spread over a turn.
TRIED = 16
#: 2π, with a margin for rounding.
ONE_TURN = 2.0 * np.pi * (1.0 + 1e-9)


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
            f"recordings must be a list of (states, controls, dt), at least one, got {shown(given)}"
        )
    found = []
    for i, one in enumerate(given):
        if not isinstance(one, tuple | list) or len(one) != 3:
            raise ValueError(f"recording {i} must be (states, controls, dt), got {shown(one)}")
        try:
            found.append(_recording(scene, *one))
        except ValueError as error:
            raise ValueError(f"recording {i}: {error}") from None
    return found


def _recording(scene: Scene, states: Any, controls: Any, dt: Any) -> Recording:
    if np.ndim(dt):
        raise ValueError(
            "dt must be one number [s]; where the times are not evenly spaced, put the samples on a finer "
            "even grid and NaN between them"
        )
    names, array = scene.state_names, real_array("states", states)
    if array.ndim != 2 or array.shape[1] != len(names):
        raise ValueError(
            f"states must have shape (N, {len(names)}), in each row {', '.join(names)} with NaN for what was "
            f"not measured, got {array.shape}"
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


def _controls(scene: Scene, controls: Any, count: int) -> Array:
    """Return the controls of this many steps; None means that all are 0."""
    steps, n = count - 1, len(scene.control_names)
    if controls is None:
        return np.zeros((steps, n))
    given = check_sequence(scene, controls)
    if len(given) == count:  # sampled together with the states: the last one acts only after the last state
        given = given[:steps]
    if len(given) != steps:
        raise ValueError(
            f"{count} states need controls for the {steps} steps between them, or one for each state, of "
            f"which the last is not used; got {len(given)}"
        )
    return given


def _unwrapped(scene: Scene, states: Array) -> Array:
    """Return the states, with angles that were measured within one turn made continuous."""
    for i, entry in enumerate(layout_of(scene).state):
        seen = np.isfinite(states[:, i])
        angles = states[seen, i]
        angle = entry.kind == "place" and entry.unit == "rad"
        if angle and len(angles) and np.ptp(angles) <= ONE_TURN:
            states[seen, i] = np.unwrap(angles)
    return states


def _row(bad: NDArray[np.bool_]) -> int:
    return int(np.argwhere(bad)[0, 0])


def guess(scene: Scene, recording: Recording) -> Array:
    """Return states near those of a recording, shape (N, n_state), with a value for each entry.

    Measurements are smoothed lightly, and gaps are bridged. A rate that was not measured is the slope of the
    place; a place that was not measured is the integral of the rate from 0, or for an angle from where the
    scene would accelerate most alike.
    """
    dt, count = recording.dt, len(recording.states)
    entries = layout_of(scene).state
    known: dict[tuple[str, bool], tuple[Array, Array]] = {}
    for i, entry in enumerate(entries):
        seen = np.flatnonzero(recording.measured[:, i])
        if len(seen):
            values = np.interp(np.arange(count), seen, recording.states[seen, i])
            known[entry.coordinate, entry.kind == "place"] = _parabolas(values, dt)
    found, turns = np.zeros((count, len(entries))), []
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
                turns.append((i, entry.coordinate))
    for i, coordinate in turns:
        found[:, i] += _turn(scene, recording, found, i, coordinate, known[coordinate, False][1])
    return found


def _turn(scene: Scene, recording: Recording, states: Array, i: int, coordinate: str, slope: Array) -> float:
    """Return the angle by which to turn entry i so that accelerations are most like the slopes of its rate.

    They are compared up to a factor, since the parameters are still wrong.
    """
    controls = recording.controls if scene.control_names else 0.0

    def likeness(angle: float) -> float:
        turned = states[:-1].copy()
        turned[:, i] += angle
        found = scene.acceleration(turned, controls)[coordinate]
        return float(slope[:-1] @ found) / max(float(np.linalg.norm(found)), np.finfo(float).tiny)

    return max((2.0 * np.pi * k / TRIED for k in range(TRIED)), key=likeness)


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
