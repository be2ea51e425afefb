"""The free parameters of a fit: their scale, their bounds, and what follows from them."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.declaring import ORDER

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

Array = NDArray[np.float64]

#: Starting value of a parameter that is 0: at 0 the motion would have no terms with this parameter.
NEARLY_ZERO = 1e-6
#: A parameter may have run away at this many times its first value, or at this many units if that value is 0.
ENDLESS = 1e3


class FreeParameters:
    """Free parameters of a scene, on the scale of the search: the logarithm of positive ones.

    A parameter that is not free and has the default value computed from others keeps following those, as a
    bar's inertia follows its mass.

    Attributes
    ----------
    names : tuple of str
        The free parameters.
    logs : ndarray of bool, shape (p,)
        Whether the logarithm of each is sought.
    start, low, high : ndarray, shape (p,)
        The scene's values and their bounds, on that scale.
    """

    def __init__(self, scene: Scene, names: tuple[str, ...]) -> None:
        fields = {f.name: f for f in dataclasses.fields(scene)}  # type: ignore[arg-type]
        ranges = [fields[name].metadata for name in names]
        self.names, self._scene = names, scene
        self.logs = np.array([r["above"] == 0.0 for r in ranges])
        self.start = self.scaled([getattr(scene, name) or NEARLY_ZERO for name in names])
        self.low = self.scaled([_limit(r, "above", "least", -np.inf) for r in ranges])
        self.high = self.scaled([_limit(r, "below", "most", np.inf) for r in ranges])
        made = [n for n, f in fields.items() if f.metadata.get("made") and n not in names]
        self._fixed = {n: getattr(scene, n) for n in fields if n not in made}
        again = type(scene)(**self._fixed)
        self._followers = tuple(n for n in made if getattr(again, n) == getattr(scene, n) is not None)
        self._fixed |= {n: getattr(scene, n) for n in made if n not in self._followers}

    def scaled(self, values: Any) -> Array:
        """Return values on the scale of the search."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.logs, np.log(values), values)

    def values(self, scaled: Array) -> Array:
        """Return the values of scaled parameters."""
        with np.errstate(over="ignore"):  # the interval of a poorly determined parameter ends at infinity
            return np.where(self.logs, np.exp(np.where(self.logs, scaled, 0.0)), scaled)

    def slopes(self, scaled: Array) -> Array:
        """Return the derivatives of the values with respect to the scaled ones."""
        return np.where(self.logs, self.values(scaled), 1.0)

    def growth(self, scaled: Array) -> Array:
        """Return the size of each value as a multiple of its first one, or in units if that is 0."""
        first = [abs(getattr(self._scene, name)) or 1.0 for name in self.names]
        return np.abs(self.values(scaled)) / first

    def scene(self, scaled: Array) -> Scene:
        """Return the scene with these values of its free parameters."""
        free = dict(zip(self.names, self.values(scaled).tolist(), strict=True))
        made = type(self._scene)(**self._fixed | free)
        if ORDER in vars(self._scene):
            vars(made)[ORDER] = vars(self._scene)[ORDER]
        return made

    def chain(self, scaled: Array) -> tuple[list[str], Array]:
        """Return names of all parameters that depend on the scaled ones, and their derivatives.

        Returns
        -------
        names : list of str
            The free parameters, and those that follow them.
        derivatives : ndarray, shape (number of names, p)
            Those of followers are finite differences: a default may be any function of the scene.
        """
        steps = 1e-5 * np.diag(np.where(self.logs, 1.0, scaled))
        rows = np.zeros((len(self._followers), len(scaled)))
        for i, step in enumerate(steps if self._followers else ()):
            ends = [self.scene(scaled + sign * step) for sign in (1.0, -1.0)]
            above, below = ([getattr(end, name) for name in self._followers] for end in ends)
            rows[:, i] = (np.array(above) - below) / (2.0 * step[i])
        moving = np.flatnonzero(rows.any(axis=1)).tolist()
        names = [*self.names, *(self._followers[i] for i in moving)]
        return names, np.concatenate([np.diag(self.slopes(scaled)), rows[moving]])


def _limit(ranges: Any, strict: str, weak: str, otherwise: float) -> float:
    found = [ranges[key] for key in (strict, weak) if ranges[key] is not None]
    return found[0] if found else otherwise
