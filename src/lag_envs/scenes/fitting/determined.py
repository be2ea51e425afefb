"""Which parameters the data determine, and how well, from derivatives of the residuals at the solution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.fitting.parameters import ENDLESS
from lag_envs.scenes.fitting.shooting import Shooting

Array = NDArray[np.float64]

#: Derivatives, scaled to unit length, count as dependent if they have a singular value below this.
DEPENDENT = 1e-7
#: A parameter has no effect if doubling it, or adding one unit, moves no state by more than this part of its
#: range.
NO_EFFECT = 1e-10
#: What may be wrong if a parameter runs away.
SUSPECTS = "a held parameter, a control, or a measurement (its zero, its sign, single values)"


class Determined:
    """The derivatives with respect to the parameters, after projecting out those of the unknown starts.

    Parameters
    ----------
    shooting : Shooting
        The problem.
    z : ndarray
        Its solution.
    ranges : ndarray, shape (n_state,)
        Size of the motion.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Covariance of the scaled parameters.
    leverage : ndarray, shape (number of residuals,)
        The part of each residual that the unknowns absorb.
    freedom : int
        Number of residuals minus number of unknowns.

    Raises
    ------
    ValueError
        For parameters that are not determined.
    """

    def __init__(self, shooting: Shooting, z: Array, ranges: Array) -> None:
        from scipy.linalg import orth

        self._parameters = shooting.parameters
        p, of = len(self._parameters.names), shooting.states_of_residuals()
        values = self._parameters.values(z[:p])
        growth = self._parameters.growth(z[:p])
        self._astray = np.any((growth > ENDLESS) | (self._parameters.logs & (growth < 1.0 / ENDLESS)))
        self._whole = np.where(self._parameters.logs, 1.0, values)  # a change by 100 %, scaled
        derivatives = shooting.jacobian(z)
        by_parameters, by_starts = derivatives[:, :p], derivatives[:, p:]
        moved = by_parameters * (shooting.noise / ranges)[of][:, None] * np.maximum(np.abs(self._whole), 1.0)
        lengths = np.linalg.norm(by_starts, axis=0)
        starts = orth(by_starts / np.where(lengths > 0.0, lengths, 1.0), rcond=1e-10)
        rest = by_parameters - starts @ (starts.T @ by_parameters)
        rest -= starts @ (starts.T @ rest)  # projected once more, to remove rounding errors
        left = np.linalg.norm(rest, axis=0)
        none = np.abs(moved[of >= 0]).max(axis=0) < NO_EFFECT
        none |= left <= DEPENDENT * np.linalg.norm(by_parameters, axis=0)
        self._refuse([np.eye(p)[i] for i in np.flatnonzero(none)], values)
        basis, sizes, directions = np.linalg.svd(rest / left, full_matrices=False)
        self._refuse(
            [v / left for v, size in zip(directions, sizes, strict=True) if size < DEPENDENT], values
        )
        root = directions.T / sizes / left[:, None]
        self.covariance = root @ root.T
        self.leverage = np.sum(basis**2, axis=1) + np.sum(starts**2, axis=1)
        self.freedom = len(derivatives) - starts.shape[1] - p

    def _refuse(self, directions: list[Array], values: Array) -> None:
        """Raise an error for directions in which the scaled parameters can change without any effect."""
        texts: list[str] = []
        alone: list[str] = []  # parameters that have no effect of their own
        for direction in directions:
            change = direction / self._whole
            change = change / change[np.argmax(np.abs(change))]
            parts = {
                name: f"{name} by {part:+.3g} %"
                for name, part in zip(self._parameters.names, change, strict=True)
                if abs(part) > 1e-3
            }
            if len(parts) == 1:
                alone += parts
                texts.append(f"{alone[-1]}, which has no effect of its own on what was measured")
            else:
                texts.append(
                    f"{' and '.join(parts)} apart: changing {', '.join(parts.values())} together changes "
                    "nothing that was measured"
                )
        if texts:
            names, count = self._parameters.names, len(texts)
            ended = ", ".join(f"{name}={value:.3g}" for name, value in zip(names, values, strict=True))
            it, held, has = ("it", "is held", "has") if count == 1 else ("they", "are held", "have")
            some = " and ".join(alone) if len(alone) == count else f"{'one' if count == 1 else count} of them"
            others = len(alone) < len(names)
            remedy = f"Leave {some} out of free, so that {it} {held}, or add" if others else "Add"
            far_off = (
                f"such values may mean that nothing moved, or that {SUSPECTS} is wrong"
                if self._astray
                else "if these values are far off, begin closer to the truth"
            )
            raise ValueError(
                f"the data do not determine {'; nor '.join(texts)}. {remedy} recordings in which {it} {has} "
                f"an effect, such as recordings under known controls. The search ended at {ended}; {far_off}"
            )
