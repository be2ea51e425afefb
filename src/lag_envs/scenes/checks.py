"""Checks on arguments, and the error for a refused step."""

from __future__ import annotations

import inspect
import math
import numbers
import sys
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.mechanics.algebra import FormulaError
from lag_envs.mechanics.recording import parameter_names

Array = NDArray[np.float64]

#: Masses and lengths below this, and any parameter above its inverse, are refused: the product of five such
#: numbers must neither vanish nor overflow.
SMALLEST = 1e-60


class StepRefused(ArithmeticError):
    """A step that cannot be taken to full accuracy, or has no finite result.

    Attributes
    ----------
    trajectory : array of shape (steps + 1, n_state), or None
        What `Scene.simulate` computed before that step.
    results : tuple, or None
        What a vector environment's step would have returned. Its infos have ``"refused"``, a mask of the
        environments whose steps were refused; these have a reward of 0.
    """

    trajectory: Array | None = None
    results: tuple | None = None


def shown(value: Any) -> str:
    """Return a value as text for an error message, shortened if it is long."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:150]}... ({len(text)} characters)"


def not_a_method(name: str, value: Any, base: type) -> str:
    """Return what is wrong with an attribute that replaces a method of `base`; empty if nothing is."""
    is_property = isinstance(value, property | cached_property)
    if not is_property and (callable(value) or hasattr(value, "__get__")):
        return ""
    wanted = ", ".join(inspect.signature(getattr(base, name)).parameters)
    got = "a property" if is_property else f"{value!r:.60}"
    return f"must be a method, {name}({wanted}), got {got}"


def run_check(of: Any) -> None:
    """Run the own `check` of a scene or a task."""
    returned = of.check()
    if returned is not None:
        raise FormulaError(
            f"{type(of).__name__}.check must raise a ValueError or return nothing, got {shown(returned)}"
        )


def check_number(name: str, value: Any, unit: str = "", *, endless: bool = False) -> float:
    """Return the value as a finite float, or infinite if `endless`; else raise a ValueError."""
    if type(value) is np.ndarray and value.ndim == 0:
        value = value[()]
    if isinstance(value, bool | np.bool_ | np.timedelta64) or not isinstance(value, numbers.Real):
        raise ValueError(f"{name} must be a real number, got {shown(value)}")
    try:
        number = float(value)
    except OverflowError:  # an integer may be too large
        number = math.nan
    if not math.isfinite(number) and not (endless and value == math.inf):
        raise ValueError(f"{name} must be finite, got {value!s:.40}{unit and ' ' + unit}")
    return number


def real_array(name: str, values: ArrayLike) -> Array:
    """Return values as a new float64 array, or raise a ValueError with their name."""
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as error:  # rows of different lengths, sparse tensors
        raise ValueError(f"{name} must be real numbers, got {shown(values)}: {error}") from error
    if array.dtype.kind not in "fiu" or is_masked(values):
        raise ValueError(f"{name} must be real numbers, got {shown(values)}")
    return array.astype(np.float64)


def is_masked(values: Any) -> bool:
    """Return whether values are or contain a masked array; NumPy would take masked numbers for valid ones."""
    if isinstance(values, list | tuple):
        return any(map(is_masked, values))
    return isinstance(values, np.ndarray) and hasattr(values, "mask")


def check_step(dt: Any) -> float:
    """Return the step as float, or raise a ValueError."""
    dt = check_number("dt", dt, "s")
    if not dt >= sys.float_info.min:  # a subnormal number may have no finite inverse
        raise ValueError(f"dt must be above 0 s, got {dt:g} s")
    return dt


# --- states and controls ------------------------------------------------------------------------------------


def check_state(scene: Any, state: ArrayLike) -> Array:
    """Return the state as a float64 array of shape (n_state,), or raise a ValueError."""
    array = check_states(scene, state)
    if array.ndim != 1:
        raise ValueError(
            f"state must be ({', '.join(scene.state_names)}), got shape {array.shape}: {shown(state)}"
        )
    return array


def check_states(scene: Any, states: ArrayLike) -> Array:
    """Return states as a float64 array of shape (..., n_state), or raise a ValueError."""
    names = scene.state_names
    if isinstance(states, Mapping):
        raise ValueError(f"state must be ({', '.join(names)}), without names, got {shown(states)}")
    array = real_array("state", states)
    if array.shape[-1:] != (len(names),):
        raise ValueError(f"state must be ({', '.join(names)}), got shape {array.shape}: {shown(states)}")
    bad = ~np.isfinite(array)
    if bad.any():
        row = array[tuple(np.argwhere(bad)[0][:-1])]
        raise ValueError(f"state must be finite, got {dict(zip(names, row.tolist(), strict=True))}")
    return array


def check_controls(scene: Any, control: ArrayLike, ndim: int) -> Array:
    """Return controls as a float64 array of shape (..., n_controls), or raise a ValueError.

    A single control may be given without its axis; `ndim`, the number of axes of the states, shows whether it
    was.
    """
    array, names = real_array("the control", control), scene.control_names
    bad = ~np.isfinite(array)
    if bad.any():
        place = f" at {np.argwhere(bad)[0].tolist()}" if array.ndim else ""
        raise ValueError(f"the control must be finite, got {array[bad].flat[0]}{place}")
    if array.shape == (0,) and ndim == 1 and names:  # a forgotten control, not a batch without rows
        raise ValueError(f"the control must be ({', '.join(names)}), {len(names)} in all; got an empty array")
    if array.ndim == 0 and (len(names) == 1 or array == 0.0):
        return np.full(len(names), float(array))
    if len(names) == 1 and not (array.shape[-1] == 1 and array.ndim >= ndim):
        return array[..., None]
    if array.shape[-1:] != (len(names),):
        wanted = f"({', '.join(names)})" if names else "left out, since the scene has none"
        raise ValueError(f"the control must be {wanted}, got an array of shape {array.shape}")
    return array


def check_control(scene: Any, control: ArrayLike) -> Array:
    """Return one set of controls as a float64 array of shape (n_controls,), or raise a ValueError."""
    array = check_controls(scene, control, 1)
    if array.ndim != 1:
        raise ValueError(f"the control must be one set of controls, got shape {array.shape}")
    return array


def check_both(scene: Any, state: ArrayLike, control: ArrayLike) -> tuple[Array, Array, tuple[int, ...]]:
    """Return states and controls with their last axes, and their common shape without the last axes."""
    states = check_states(scene, state)
    controls = check_controls(scene, control, states.ndim)
    try:
        return states, controls, np.broadcast_shapes(states.shape[:-1], controls.shape[:-1])
    except ValueError:
        raise ValueError(
            f"states of shape {states.shape} and controls of shape {controls.shape} do not fit together"
        ) from None


def check_sequence(scene: Any, controls: ArrayLike | int) -> Array:
    """Return controls as an array of shape (T, n_controls), or raise a ValueError."""
    n = len(scene.control_names)
    if n == 0:
        if isinstance(controls, bool) or not isinstance(controls, int | np.integer) or controls < 0:
            raise ValueError(
                "this scene has no control: give the number of steps in place of controls, "
                f"got {controls!r:.60}"
            )
        return np.empty((int(controls), 0))
    array = real_array("controls", controls)
    if array.ndim == 1 and n == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != n:
        wanted = "(T,)" if n == 1 else f"(T, {n})"
        raise ValueError(
            f"controls must have shape {wanted}, with {', '.join(scene.control_names)} for each step, "
            f"got {array.shape}"
        )
    bad = ~np.isfinite(array)
    if bad.any():
        raise ValueError(f"controls must be finite, got {array[bad][0]} in row {int(np.argwhere(bad)[0, 0])}")
    return array


def check_parameters(scene: Any, parameters: Sequence[str]) -> tuple[str, ...]:
    """Return names of parameters as a tuple, or raise a ValueError for one that the scene lacks."""
    names = parameter_names(scene)
    if isinstance(parameters, str):
        raise ValueError(f"parameters must be a sequence of names, such as [{parameters!r}]; got a string")
    found = tuple(parameters)
    for i, name in enumerate(found):
        if name not in names:
            raise ValueError(
                f"{type(scene).__name__} has no parameter {shown(name)}, only {', '.join(names) or 'none'}"
            )
        if name in found[:i]:
            raise ValueError(f"the parameter {name!r} is named twice")
        if not math.isfinite(getattr(scene, name)):
            raise ValueError(
                f"{name}={getattr(scene, name)} is infinite, and has no derivatives; leave it out"
            )
    return found


# --- lags ---------------------------------------------------------------------------------------------------

#: A lag is at least this part of the step, or 0: a shorter one would be no different from none.
SMALLEST_LAG = 1e-6


def check_lags(names: tuple[str, ...], lag: Any, dt: float) -> Array:
    """Return 1/τ for these controls [1/s], 0 for no lag; or raise a ValueError.

    Parameters
    ----------
    names : tuple of str
        The controls.
    lag : float or mapping from str to float
        τ [s], one for all or by the control's name.
    dt : float
        Length of a control step [s].
    """
    by_name = lag if isinstance(lag, Mapping) else dict.fromkeys(names, lag)
    if not names:
        raise ValueError(f"lag={shown(lag)}: this scene has no control that could lag; leave it out")
    decays = dict.fromkeys(names, 0.0)
    for name, value in by_name.items():
        what = f"lag[{name!r}]" if by_name is lag else "lag"
        if name not in decays:
            raise ValueError(f"{what}: there is no such control, only {', '.join(names)}")
        seconds = check_number(what, value, "s")
        if seconds != 0.0 and not seconds >= SMALLEST_LAG * dt:
            raise ValueError(
                f"{what} must be 0 or at least {SMALLEST_LAG:g} times the step of {dt:g} s, "
                f"got {seconds:g} s; 0 means no lag"
            )
        decays[name] = 1.0 / seconds if seconds else 0.0
    return np.array([decays[name] for name in names])


def check_applied(names: tuple[str, ...], applied: ArrayLike, decays: Array) -> Array:
    """Return the starting values of lagged controls, shape (n_controls,), or raise a ValueError."""
    array = real_array("applied", applied)
    if array.ndim == 0 and len(names) == 1:
        array = array[None]
    if array.shape != (len(names),):
        raise ValueError(f"applied must be ({', '.join(names)}), got an array of shape {array.shape}")
    for name, value, decay in zip(names, array.tolist(), decays.tolist(), strict=True):
        if not math.isfinite(value):
            raise ValueError(f"applied must be finite, got {value} for {name}")
        if value != 0.0 and decay == 0.0:
            raise ValueError(f"applied: {name} does not lag, so it cannot start at {value:g}; give 0")
    return array


def check_count(name: str, value: Any) -> int:
    """Return an integer of at least 1 as int, or raise a ValueError."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)
    if not whole or not 1 <= value < 2**63:
        most = " and below 2**63" if whole and value > 0 else ""
        raise ValueError(f"{name} must be a whole number of at least 1{most}, got {shown(value)}")
    return int(value)
