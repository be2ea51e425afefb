"""Checks on what is given, and the error for a step that is refused."""

from __future__ import annotations

import math
import numbers
import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Masses and lengths below this, and any parameter above its inverse, are refused: a product of five must not
#: vanish or overflow.
SMALLEST = 1e-60


class StepRefused(ArithmeticError):
    """A step that cannot be taken to full accuracy, or that has no finite result.

    Attributes
    ----------
    trajectory : array of shape (steps + 1, n_state), or None
        What `Scene.simulate` had computed before the step.
    results : tuple, or None
        What a vector environment's step would have returned for the others.
    """

    trajectory: Array | None = None
    results: tuple | None = None


def shown(value: Any) -> str:
    """Return a value as an error shows it, long ones cut short."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:150]}... ({len(text)} characters)"


def check_number(name: str, value: Any, unit: str = "", *, endless: bool = False) -> float:
    """Return the value as a finite float, infinity too where it may be `endless`; else raise a ValueError."""
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
    """Return values as a new float64 array, or raise a ValueError that names them."""
    try:
        array = np.array(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} must be real numbers, got {shown(values)}") from error
    if array.dtype.kind not in "fiu" or is_masked(values):
        raise ValueError(f"{name} must be real numbers, got {shown(values)}")
    return array.astype(np.float64)


def is_masked(values: Any) -> bool:
    """Tell whether values are or hold a masked array, whose masked numbers NumPy would take for valid."""
    if isinstance(values, list | tuple):
        return any(map(is_masked, values))
    return isinstance(values, np.ndarray) and hasattr(values, "mask")


def check_step(dt: Any) -> float:
    """Return the step as float, or raise a ValueError."""
    dt = check_number("dt", dt, "s")
    if not dt >= sys.float_info.min:  # what lies between has no inverse
        raise ValueError(f"dt must be above 0 s, got {dt:g} s")
    return dt
