"""Spaces of actions, and actions in the form that compiled code takes."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.checks import is_masked, shown
from lag_envs.tasks.formulas import TaskFormulas

#: Types of actions that compiled steps take without conversion.
AS_THEY_ARE = np.dtype(np.float32), np.dtype(np.float64)


class Actions:
    """The actions of one task.

    Parameters
    ----------
    formulas : TaskFormulas
        The task's formulas.

    Attributes
    ----------
    count : int
        How many numbers an action has.
    values : tuple of int
        For actions chosen from lists, the length of each list; empty if actions lie in a box.
    """

    def __init__(self, formulas: TaskFormulas) -> None:
        self.count, self.values = count, values = formulas.actions, formulas.choices
        self.space: gym.Space[Any]
        if len(values) == 1:
            self.space = gym.spaces.Discrete(values[0])
        elif values:
            self.space = gym.spaces.MultiDiscrete(list(values))
        else:
            self.space = gym.spaces.Box(-formulas.largest, formulas.largest, (count,), np.float32)
        #: Shape of one action.
        self.shape = () if len(values) == 1 else (count,)

    def one(self, action: Any) -> Any:
        """Return an action as a float, or as an array if it has several numbers; or raise a ValueError."""
        array = self._array(action, "the action", self.shape)
        if self.values:
            self._check_choices(array, "the action")
        elif not np.isfinite(array).all():
            raise ValueError(f"the action must be finite, got {shown(action)}")
        numbers = np.ascontiguousarray(array, np.float64).reshape(-1)
        return float(numbers[0]) if self.count == 1 else numbers

    def many(self, actions: Any, n: int) -> NDArray[np.floating]:
        """Return the actions of n environments, one after the other; or raise a ValueError."""
        array = self._array(actions, "actions", (n, *self.shape))
        if self.values:
            self._check_choices(array, "actions")
        if array.dtype not in AS_THEY_ARE or not array.flags.carray:
            array = array.astype(np.float64, order="C")
        return array.ravel()

    def _array(self, given: Any, what: str, shape: tuple[int, ...]) -> NDArray:
        """Return real or whole numbers of this shape as an array, or raise a ValueError."""
        try:
            array = np.asarray(given)
        except ValueError as error:  # rows of different lengths
            raise ValueError(f"{what} must have shape {shape}, got {shown(given)}") from error
        if array.shape != shape:
            raise ValueError(f"{what} must have shape {shape}, got shape {array.shape}: {shown(given)}")
        if array.dtype.kind not in ("iu" if self.values else "fiub") or is_masked(given):
            one = what.startswith("the")
            kind = ("whole" if self.values else "real") + (" number" if one else " numbers")
            raise ValueError(
                f"{what} must be {'a ' if one else ''}{kind}, got {shown(given)} of type {array.dtype}"
            )
        return array

    def _check_choices(self, array: NDArray, what: str) -> None:
        bad = (array < 0) | (array >= np.array(self.values).reshape(self.shape))
        if bad.any():
            choices = ", ".join(f"0 to {n - 1}" for n in self.values)
            raise ValueError(f"{what} must be {choices}, got {array[bad].flat[0]}")


def single_number(values: NDArray[np.float64]) -> Any:
    """Return a copy of an array, or its only number if the last axis has length 1."""
    if values.shape[-1] != 1:
        return values.copy()
    return float(values[0]) if values.ndim == 1 else values[..., 0].copy()
