"""Multiple shooting: a recording is cut into pieces, and each piece is simulated from its own start.

The unknowns are the free parameters and the pieces' starts. The residuals are the differences between
measurements and simulation, and the gaps between the end of each piece and the start of the next, all divided
by their expected sizes. The pieces make the search robust: a motion of a few steps is never far off, whatever
the parameters are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.checks import StepRefused
from lag_envs.scenes.fitting.parameters import FreeParameters
from lag_envs.scenes.fitting.recordings import Recording

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

Array = NDArray[np.float64]

#: The largest factor by which one search may change a parameter that is sought by its logarithm: parameters
#: that short pieces do not determine must not run away.
FARTHEST = np.log(1e3)
#: The largest number of evaluations of a search, and of one whose steps need many substeps; nearly all
#: searches that succeed take less than a tenth of the former.
LONGEST, LONGEST_SLOW = 500, 50


class Piece(NamedTuple):
    """Samples ``first`` to ``last`` of a recording; the next piece begins at ``last``."""

    recording: int
    first: int
    last: int
    continues: bool

    @property
    def own(self) -> slice:
        """The samples to compare with this piece's motion."""
        return slice(self.first, self.last + (not self.continues))


def cut(recordings: Sequence[Recording], length: int) -> list[Piece]:
    """Cut all recordings into pieces of this many steps; the last ones may be shorter."""
    found = []
    for i, recording in enumerate(recordings):
        end = len(recording.states) - 1
        for first in range(0, end, length):
            last = min(first + length, end)
            found.append(Piece(i, first, last, last < end))
    return found


class Shooting:
    """The least-squares problem of pieces.

    The vector of unknowns z is the free parameters, scaled, followed by the pieces' starts.

    Parameters
    ----------
    parameters : FreeParameters
        The free parameters.
    recordings : sequence of Recording
        The data.
    pieces : sequence of Piece
        The pieces of the recordings.
    noise : ndarray, shape (n_state,)
        Expected size of the residuals of each state.
    gap : ndarray, shape (n_state,)
        Expected size of the gaps between pieces.
    longest : int
        Largest number of evaluations of a search.
    """

    def __init__(
        self,
        parameters: FreeParameters,
        recordings: Sequence[Recording],
        pieces: Sequence[Piece],
        noise: Array,
        gap: Array,
        longest: int = LONGEST,
    ) -> None:
        self.parameters, self.recordings, self.pieces = parameters, recordings, pieces
        self.noise, self.gap, self.longest = noise.copy(), gap.copy(), longest
        self._known: tuple[bytes, Any] = b"", None

    def weighed(self, noise: Array, gap: Array) -> Shooting:
        """Return the problem with other expected sizes."""
        return Shooting(self.parameters, self.recordings, self.pieces, noise, gap, self.longest)

    def simulate(self, z: Array) -> tuple[Scene, list[Array]]:
        """Return the scene, and each piece's motion; raise StepRefused, or ValueError for the parameters."""
        if self._known[0] != z.tobytes():
            p, n = len(self.parameters.names), len(self.noise)
            scene = self.parameters.scene(z[:p])
            motions = []
            for start, piece in zip(z[p:].reshape(-1, n), self.pieces, strict=True):
                recording = self.recordings[piece.recording]
                steps = piece.last - piece.first
                given = recording.controls[piece.first : piece.last] if scene.control_names else steps
                motions.append(scene.simulate(start, given, recording.dt))
            self._known = z.tobytes(), (scene, motions)
        return self._known[1]

    def residuals(self, z: Array) -> Array:
        """Return the residuals divided by their expected sizes; infinite if the simulation fails."""
        try:
            _, motions = self.simulate(z)
        except (StepRefused, ValueError):
            return np.full(self.count, np.inf)
        parts = []
        for j, (piece, motion) in enumerate(zip(self.pieces, motions, strict=True)):
            data = self.recordings[piece.recording].states[piece.own]
            errors = (data - motion[: len(data)]) / self.noise
            parts.append(errors[np.isfinite(data)])
            if piece.continues:
                parts.append((motions[j + 1][0] - motion[-1]) / self.gap)
        return np.concatenate(parts)

    @property
    def count(self) -> int:
        """Number of residuals."""
        return len(self.states_of_residuals())

    def states_of_residuals(self) -> NDArray[np.int_]:
        """Return which entry of the state each residual belongs to, and -1 for gaps."""
        n, parts = len(self.noise), []
        for piece in self.pieces:
            measured = self.recordings[piece.recording].measured[piece.own]
            parts.append(np.nonzero(measured)[1])
            if piece.continues:
                parts.append(np.full(n, -1))
        return np.concatenate(parts)

    def sensitivities(self, z: Array) -> list[Array]:
        """Return the derivatives of each piece's motion, shape (steps + 1, n_state, n_state + p).

        The derivatives with respect to its start come first, then those with respect to the scaled
        parameters.
        """
        scene, motions = self.simulate(z)
        p, n = len(self.parameters.names), len(self.noise)
        names, chain = self.parameters.chain(z[:p])
        found = []
        for i, recording in enumerate(self.recordings):
            own = [motion for piece, motion in zip(self.pieces, motions, strict=True) if piece.recording == i]
            before = np.concatenate([motion[:-1] for motion in own])
            by_state, _, by_named = scene.jacobian(before, recording.controls, recording.dt, parameters=names)
            new = np.concatenate([np.zeros_like(by_state), by_named @ chain], axis=-1)
            step = 0
            for motion in own:
                total = np.empty((len(motion), n, n + p))
                total[0] = np.eye(n, n + p)
                for k in range(1, len(motion)):
                    total[k] = by_state[step] @ total[k - 1] + new[step]
                    step += 1
                found.append(total)
        return found

    def jacobian(self, z: Array) -> Array:
        """Return the derivatives of the residuals with respect to z."""
        p, n = len(self.parameters.names), len(self.noise)
        found, row = np.zeros((self.count, len(z))), 0
        for j, (piece, total) in enumerate(zip(self.pieces, self.sensitivities(z), strict=True)):
            start = slice(p + j * n, p + (j + 1) * n)
            measured = self.recordings[piece.recording].measured[piece.own]
            rows = (-total[: len(measured)] / self.noise[:, None])[measured]
            own = slice(row, row + len(rows))
            found[own, start], found[own, :p] = rows[:, :n], rows[:, n:]
            row += len(rows)
            if piece.continues:
                own, gap = slice(row, row + n), self.gap[:, None]
                found[own, start], found[own, :p] = -total[-1][:, :n] / gap, -total[-1][:, n:] / gap
                found[own, start.stop : start.stop + n] = np.eye(n) / gap
                row += n
        return found

    def solve(self, z: Array, tolerance: float, *, starts: bool = True) -> Any:
        """Return SciPy's result of a minimisation from z on; starts are held unless `starts` is true."""
        from scipy.optimize import least_squares

        p, parameters = len(self.parameters.names), self.parameters
        free, rest = (z, z[:0]) if starts else (z[:p], z[p:])
        reach = np.where(parameters.logs, FARTHEST, np.inf)
        low, high = np.full((2, len(free)), [[-np.inf], [np.inf]])
        low[:p] = np.maximum(parameters.low, z[:p] - reach)
        high[:p] = np.minimum(parameters.high, z[:p] + reach)
        return least_squares(
            lambda x: self.residuals(np.concatenate([x, rest])),
            free,
            lambda x: self.jacobian(np.concatenate([x, rest]))[:, : len(x)],
            bounds=(low, high),
            x_scale="jac",
            ftol=tolerance,
            xtol=tolerance,
            max_nfev=self.longest,
        )
