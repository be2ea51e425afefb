"""Fit a scene's parameters to recordings of its motion."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.errors import hint
from lag_envs.scenes.checks import StepRefused, check_number, check_parameters, shown
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.fitting.determined import SUSPECTS, Determined
from lag_envs.scenes.fitting.parameters import ENDLESS, FreeParameters
from lag_envs.scenes.fitting.recordings import (
    Recording,
    doubtful_interval,
    doubtful_rates,
    doubtful_units,
    guess,
    recordings_of,
)
from lag_envs.scenes.fitting.result import Fit, FitWarning
from lag_envs.scenes.fitting.shooting import LONGEST, LONGEST_SLOW, Shooting, cut

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

Array = NDArray[np.float64]

#: Lengths of pieces [measured samples] in the first searches, which start from the smoothed data.
SHORT = (3, 10)
#: The largest number of unknowns for starts, unless there are more recordings: the time of a step grows as
#: its square.
MOST_STARTS = 200
#: Gaps between pieces may first be as large as the noise, then only these parts of the noise; finally no gaps
#: remain.
CLOSING = (0.03, 1e-3)
#: Relative changes of sum of squares and unknowns at which intermediate searches and the last one end.
COARSE, FINE = 1e-4, 1e-12
#: Noise is at least this part of a state's range, to allow for rounding and for errors of simulated data.
LEAST_NOISE = 1e-9
#: A range below this, or below the above part of the values, is taken for rounding: nothing moves.
LEAST_RANGE = 1e-12
#: A standard error above this part of the estimate, or a correlation above this, causes a warning.
WIDE, CORRELATED = 0.5, 0.999
#: Residuals this many times the noise are a misfit; residuals below this part of the range do not matter.
MISFIT, INVISIBLE = 2.0, 1e-6
#: A residual this many times the spread of its state's residuals (that of a normal distribution with the same
#: median of sizes) is an outlier, if there are at least so many.
OUTLYING, LEAST_COUNT = 6.0, 20
#: How many times at most the noise is estimated and the fit repeated with the estimate.
WEIGHINGS = 8


def fit(
    scene: Scene,
    recordings: Any,
    free: Sequence[str],
    noise: Mapping[str, float] | None = None,
    level: float = 0.95,
) -> Fit:
    """See `Scene.fit`."""
    if importlib.util.find_spec("scipy") is None:
        raise ModuleNotFoundError('fitting needs SciPy: pip install "lag-envs[fit]"', name="scipy")
    try:
        names = check_parameters(scene, free)
    except ValueError as error:
        raise ValueError(f"free: {error}") from None
    if not names:
        raise ValueError("free must name at least one parameter")
    level = check_number("level", level)
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be between 0 and 1, got {level:g}")
    data = recordings_of(scene, recordings)
    sizes, parameters = _Sizes(scene, data, noise), FreeParameters(scene, names)
    slow = doubtful_interval(parameters.scene(parameters.start), data, sizes.guesses)
    doubts = doubtful_units(scene, data) + doubtful_rates(scene, data) + slow
    for text in doubts:  # now, for the search would be long and may fail
        warnings.warn(text, FitWarning, stacklevel=3)
    unknowns = len(names) + len(data) * len(scene.state_names)
    if sizes.count <= unknowns:
        raise ValueError(
            f"{sizes.count} measured values are too few for {len(names)} parameters and the "
            f"{unknowns - len(names)} entries of the starts of {len(data)} recordings; record longer"
        )
    try:
        shooting, z = _approach(parameters, data, sizes, LONGEST_SLOW if slow else LONGEST)
        relaxed = sizes.noise.copy()
        for part in CLOSING:
            shooting = shooting.weighed(sizes.noise, part * sizes.gap)
            z = shooting.solve(z, COARSE).x
        for _ in range(WEIGHINGS):
            shooting = shooting.weighed(sizes.noise, CLOSING[-1] * sizes.gap)
            found = shooting.solve(z, FINE)
            z, known = found.x, _determined(shooting, found.x, sizes.range)
            sizes.estimate(shooting, z, known.leverage)
            if np.allclose(sizes.noise, shooting.noise, rtol=1e-3, atol=0.0):
                break
            if not found.success:
                shooting.longest = 1  # another search would take as long; only the noise is estimated
    except StepRefused as error:
        raise _explained(error, scene, data, sizes) from error
    return _result(shooting, found, known, sizes, relaxed, level, doubts)


class _Sizes:
    """The sizes of residuals, of gaps and of the motion, by state.

    Attributes
    ----------
    range : ndarray, shape (n_state,)
        Largest minus smallest value; for a state that was not measured, that of the guess.
    noise : ndarray, shape (n_state,)
        Standard deviation of the residuals.
    given : bool
        Whether the noise was given.
    """

    def __init__(self, scene: Scene, data: Sequence[Recording], noise: Mapping[str, float] | None) -> None:
        self.seen = np.any([r.measured.any(axis=0) for r in data], axis=0)
        self.count = int(sum(r.measured.sum() for r in data))
        self.guesses = [guess(scene, recording) for recording in data]
        values = np.concatenate(self.guesses)
        self.range = np.ptp(values, axis=0)
        self.range[self.range <= np.maximum(LEAST_RANGE, LEAST_NOISE * np.abs(values).max(axis=0))] = 1.0
        self.noise, self.given = self.range.copy(), noise is not None
        if self.given and not isinstance(noise, Mapping):
            first = scene.state_names[int(np.argmax(self.seen))]
            raise ValueError(
                f"noise must give the standard deviation of each measured state by its name, as in "
                f"{{{first!r}: 0.01}}, got {shown(noise)}"
            )
        for name, value in (noise or {}).items():
            if name not in scene.state_names:
                raise ValueError(
                    f"noise: there is no state {shown(name)}; {hint(str(name), scene.state_names)}"
                )
            value = check_number(f"noise[{name!r}]", value)
            if value <= 0.0:
                raise ValueError(
                    f"noise[{name!r}] must be above 0, got {value:g}; leave noise out to have it estimated"
                )
            self.noise[scene.state_names.index(name)] = value
        missing = [
            n for n, seen in zip(scene.state_names, self.seen, strict=True) if seen and n not in (noise or {})
        ]
        if self.given and missing:
            raise ValueError(
                f"noise lacks {', '.join(missing)}; give it for every measured state, or for none"
            )

    @property
    def gap(self) -> Array:
        """Noise of measured states; for the others, the same part of their range."""
        part = np.median((self.noise / self.range)[self.seen])
        return np.where(self.seen, self.noise, part * self.range)

    def estimate(self, shooting: Shooting, z: Array, leverage: Array | float = 0.0) -> None:
        """Estimate the noise from residuals; `leverage` is the part of each that the unknowns absorb."""
        if self.given:
            return
        residuals, of = shooting.residuals(z), shooting.states_of_residuals()
        for i in np.flatnonzero(self.seen):
            own = of == i
            left = np.sum(1.0 - np.broadcast_to(leverage, own.shape)[own])
            sigma = shooting.noise[i] * math.sqrt(np.sum(residuals[own] ** 2) / max(left, 1.0))
            self.noise[i] = max(sigma, LEAST_NOISE * self.range[i])


def _approach(
    parameters: FreeParameters, data: list[Recording], sizes: _Sizes, longest: int
) -> tuple[Shooting, Array]:
    """Return a problem of short pieces and its solution: first for parameters alone, then with starts."""
    n, p = len(sizes.noise), len(parameters.names)
    samples = sum(len(r.states) for r in data)
    spacing = samples // sum(int(r.measured.any(axis=1).sum()) for r in data)
    short = [spacing * length for length in SHORT]
    long = max(short[-1], math.ceil(samples * n / MOST_STARTS))
    z = parameters.start
    for length in sorted({*short, long}):
        pieces = cut(data, length)
        starts = [sizes.guesses[piece.recording][piece.first] for piece in pieces]
        shooting = Shooting(parameters, data, pieces, sizes.noise, sizes.gap, longest)
        z = np.concatenate([z[:p], *starts])
        shooting.simulate(z)  # a first guess may be refused
        z[:p] = shooting.solve(z, COARSE, starts=False).x
        sizes.estimate(shooting, z)
    shooting = shooting.weighed(sizes.noise, sizes.gap)
    z = shooting.solve(z, COARSE).x
    sizes.estimate(shooting, z, len(z) / shooting.count)
    return shooting, z


def _explained(error: StepRefused, scene: Scene, data: list[Recording], sizes: _Sizes) -> StepRefused:
    """Return the error of a simulation, with coordinates that were guessed to be 0, or other suspects."""
    guessed = [
        entry.name
        for i, entry in enumerate(layout_of(scene).state)
        if entry.kind == "place"
        and any(
            not r.measured[:, i].any() and x[0, i] == 0.0 for r, x in zip(data, sizes.guesses, strict=True)
        )
    ]
    if not guessed:
        return StepRefused(
            "the search met a motion that cannot be simulated, or not differentiated. Check the units of the "
            f"data (angles in radians, dt in seconds) and the scene's own values ({error})"
        )
    return StepRefused(
        f"the first guess cannot be simulated: {' and '.join(guessed)}, not measured, was guessed to be 0 at "
        f"the start; measure it too ({error})"
    )


def _determined(shooting: Shooting, z: Array, ranges: Array) -> Determined:
    """Return what the data determine; raise a ValueError, with the reason, if a parameter has no effect."""
    try:
        return Determined(shooting, z, ranges)
    except ValueError as error:
        parameters, p = shooting.parameters, len(shooting.parameters.names)
        grown = parameters.growth(z[:p]) > ENDLESS
        if not grown.any():
            raise
        try:  # at the first values
            Determined(shooting, np.concatenate([parameters.start, z[p:]]), ranges)
        except (StepRefused, ValueError):
            raise error from None
        named = zip(parameters.names, parameters.values(z[:p]), grown, strict=True)
        raise ValueError(_endless(", ".join(f"{n}={v:.3g}" for n, v, far in named if far))) from error


def _endless(named: str) -> str:
    return f"{named} grew without bound: nowhere does the model follow the data; {SUSPECTS} may be wrong"


def _result(
    shooting: Shooting,
    found: Any,
    known: Determined,
    sizes: _Sizes,
    relaxed: Array,
    level: float,
    doubts: list[str],
) -> Fit:
    from scipy.stats import norm, t

    parameters = shooting.parameters
    scene, motions = shooting.simulate(found.x)
    names, best = parameters.names, found.x[: len(parameters.names)]
    errors = np.sqrt(np.diag(known.covariance))
    share = 0.5 + 0.5 * level
    reach = errors * (norm.ppf(share) if sizes.given else t.ppf(share, known.freedom))
    low, high = (
        parameters.values(np.clip(best + s * reach, parameters.low, parameters.high)) for s in (-1, 1)
    )
    simulated = [np.empty_like(r.states) for r in shooting.recordings]
    for piece, motion in zip(shooting.pieces, motions, strict=True):
        rows = simulated[piece.recording][piece.own]
        rows[:] = motion[: len(rows)]
    measured = zip(scene.state_names, sizes.noise.tolist(), sizes.seen, strict=True)
    fitted = Fit(
        scene=scene,
        estimates={name: getattr(scene, name) for name in names},
        errors=dict(zip(names, (errors * parameters.slopes(best)).tolist(), strict=True)),
        intervals=dict(zip(names, zip(low.tolist(), high.tolist(), strict=True), strict=True)),
        level=level,
        correlation=known.covariance / np.outer(errors, errors),
        noise={name: sigma for name, sigma, seen in measured if seen},
        recordings=list(shooting.recordings),
        simulated=simulated,
    )
    texts = misread = _misread(fitted, sizes)
    if not found.success:
        remedy = "" if misread or doubts else "; begin closer to the truth"
        texts = [*texts, f"the search ended before it converged{remedy}"]
    texts = [
        *texts,
        *_doubts_of_parameters(fitted, parameters, best, errors, found.success),
        *_doubt_of_motion(fitted, sizes),
        *_doubts_of_model(fitted, sizes, relaxed),
    ]
    for text in texts:
        warnings.warn(text, FitWarning, stacklevel=4)
    return dataclasses.replace(fitted, warnings=(*doubts, *texts))


def _doubts_of_parameters(
    fitted: Fit, parameters: FreeParameters, best: Array, errors: Array, converged: bool
) -> list[str]:
    """Return warnings about the estimates of the parameters."""
    texts, names, grown = [], list(fitted.estimates), parameters.growth(best) > ENDLESS
    for i, (name, value) in enumerate(fitted.estimates.items()):
        wide = fitted.errors[name] > WIDE * abs(value)
        end = min(parameters.low[i], parameters.high[i], key=lambda end: abs(best[i] - end))
        # With a wide enough error every value is near the end; then only one that is nearly at the end
        # counts.
        reach = min(errors[i], abs(parameters.start[i] - end)) if wide else errors[i]
        if wide and not converged and grown[i]:
            texts.append(_endless(f"{name}={value:.3g}"))
        elif abs(best[i] - end) < 0.01 * reach:
            texts.append(f"{name}={value:.3g} lies at the end of its range, so its interval is too short")
        elif wide:
            texts.append(
                f"the data hardly determine {name}: {value:.3g} with a standard error of "
                f"{fitted.errors[name]:.2g}"
            )
        for j in range(i):
            if abs(fitted.correlation[i, j]) > CORRELATED:
                texts.append(
                    f"{names[j]} and {name} can hardly be told apart: their correlation is "
                    f"{fitted.correlation[i, j]:.5f}; leave one of them out of free, or add other recordings"
                )
    return texts


def _doubt_of_motion(fitted: Fit, sizes: _Sizes) -> list[str]:
    """Return a warning if the fitted motion is no larger than one that would be found in noise alone.

    In N random numbers, the size of each of N/2 oscillations is distributed as chi-squared with two degrees
    of freedom, so the largest one exceeds 2 log N + 10 in one case of three hundred.
    """
    strength = 0.0
    for i in np.flatnonzero(sizes.seen):
        columns = zip(fitted.residuals, fitted.simulated, strict=True)
        pairs = np.concatenate([np.stack([r[:, i], s[:, i]], axis=1) for r, s in columns])
        residuals, motion = pairs[np.isfinite(pairs).all(axis=1)].T
        strength += len(motion) * motion.var() / max(np.mean(residuals**2), np.finfo(np.float64).tiny)
    if strength >= 2.0 * math.log(sizes.count) + 10.0:
        return []
    return [
        "the motion hardly stands out from the noise, so the estimates may follow the noise: measure a "
        "larger motion"
    ]


def _doubts_of_model(fitted: Fit, sizes: _Sizes, relaxed: Array) -> list[str]:
    """Return warnings about the residuals.

    `relaxed` is the noise that remains if the motion may have gaps.
    """
    texts = []
    for i, columns, known in _visible(fitted, sizes):
        name, unit = fitted.scene.state_names[i], fitted.scene.state_units[i]
        size = math.sqrt(np.mean(known**2))
        least = sizes.noise[i] if sizes.given else relaxed[i]
        if size > MISFIT * least:
            there = "where the noise was given as" if sizes.given else "where short pieces of it are off by"
            texts.append(
                f"the model does not follow {name}: it is off by {size:.2g} {unit}, {there} "
                f"{least:.2g} {unit}; a fixed parameter may be wrong, or a force is missing in the energies"
            )
        pairs = np.concatenate([c[1:] * c[:-1] for c in columns])
        pairs = pairs[np.isfinite(pairs)]
        likeness = pairs.mean() / np.mean(known**2) if len(pairs) else 0.0
        if abs(likeness) > 4.0 / math.sqrt(max(len(pairs), 1)):
            texts.append(
                f"the residuals of {name} are not independent: their correlation from sample to sample is "
                f"{likeness:.2f}, so the intervals are too short; look at the residuals with plot()"
            )
    return texts


def _misread(fitted: Fit, sizes: _Sizes) -> list[str]:
    """Return warnings about residuals that are far larger than the others of the same state."""
    texts = []
    for i, columns, known in _visible(fitted, sizes):
        name, unit = fitted.scene.state_names[i], fitted.scene.state_units[i]
        far = OUTLYING * 1.4826 * float(np.median(np.abs(known)))
        count = int(np.sum(np.abs(known) > far))
        if len(known) < LEAST_COUNT or not count:
            continue
        absolute = [np.nan_to_num(np.abs(c)) for c in columns]
        which = int(np.argmax([c.max() for c in absolute]))
        row = int(np.argmax(absolute[which]))
        where = f" of recording {which}" if len(columns) > 1 else ""
        texts.append(
            f"{count} value{'s' * (count > 1)} of {name} may be misread: off by more than {far:.2g} {unit}, "
            f"{OUTLYING:g} times the spread of the others; the largest, {absolute[which][row]:.2g} {unit}, "
            f"at {row * fitted.recordings[which].dt:.4g} s{where}. If so, give NaN there; with misread "
            "values, estimates and intervals do not hold"
        )
    return texts


def _visible(fitted: Fit, sizes: _Sizes) -> Iterator[tuple[int, list[Array], Array]]:
    """Yield each measured state whose residuals matter, its residuals by recording, and all finite ones."""
    for i in np.flatnonzero(sizes.seen).tolist():
        columns = [residual[:, i] for residual in fitted.residuals]
        known = np.concatenate([c[np.isfinite(c)] for c in columns])
        if math.sqrt(np.mean(known**2)) >= INVISIBLE * sizes.range[i]:
            yield i, columns, known
