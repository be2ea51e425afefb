"""Statistics of returns: scores, means with errors, correction for luck, bootstrap intervals.

Several training seeds are summarised by their interquartile mean (IQM), with percentile bootstrap intervals
that resample each stratum by itself, as in rliable [1]_.

References
----------
.. [1] R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
   NeurIPS 2021.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, trim_mean

Array = NDArray[np.float64]

#: Bootstrap samples of an interval, as in rliable, and the interval's coverage probability.
RESAMPLES, LEVEL = 2000, 0.95
#: Half the width of such an interval, in standard errors of a mean.
SIGMAS = 1.96
#: Scores at which performance profiles are given.
THRESHOLDS: Array = np.linspace(-0.25, 1.25, 61)


# --- scores -------------------------------------------------------------------------------------------------


def optimality_gap(means: ArrayLike) -> float:
    """Return the mean shortfall of policies from a score of 1; scores above 1 do not compensate.

    Examples
    --------
    >>> optimality_gap([0.5, 1.5])
    0.25
    """
    return float(1.0 - np.minimum(means, 1.0).mean())


def profile(scores: ArrayLike) -> Array:
    """Return the share of all episodes whose score is above each of the `THRESHOLDS`."""
    ordered = np.sort(np.ravel(scores))
    return 1.0 - np.searchsorted(ordered, THRESHOLDS, side="right") / ordered.size


# --- summaries ----------------------------------------------------------------------------------------------


def iqm(values: ArrayLike, axis: int | None = -1) -> Any:
    """Return the interquartile mean: the mean without the lowest and the highest quarter of the values.

    For five values, that is the mean of the middle three; for fewer than four, the mean of all.

    Examples
    --------
    >>> float(iqm([0.0, 1.0, 2.0, 3.0, 100.0]))
    2.0
    """
    return trim_mean(values, 0.25, axis=axis)


def pooled_iqm(*strata: ArrayLike) -> Any:
    """Return the interquartile mean of all strata together."""
    return iqm(np.concatenate(strata, axis=-1))


def improvement(x: ArrayLike, y: ArrayLike) -> Any:
    """Return the probability that an element of x is above one of y; equal ones count half.

    Parameters
    ----------
    x, y : array_like, shapes (..., n) and (..., m)
        Means of policies.

    Examples
    --------
    >>> float(improvement([1.0, 3.0], [0.0, 1.0]))
    0.875
    """
    a, b = np.asarray(x)[..., :, None], np.asarray(y)[..., None, :]
    return 0.5 * ((a > b).mean(axis=(-2, -1)) + (a >= b).mean(axis=(-2, -1)))


def median_time(times: Sequence[float | None]) -> float | None:
    """Return the median of times, None meaning never; None if half or more are never.

    Examples
    --------
    >>> median_time([1.0, None, 2.0]), median_time([1.0, None])
    (2.0, None)
    """
    found = float(np.median([np.inf if time is None else time for time in times]))
    return found if np.isfinite(found) else None


# --- luck ---------------------------------------------------------------------------------------------------


class Luck(NamedTuple):
    """How returns follow another agent's in the same episodes.

    Attributes
    ----------
    slope : float
        Slope of the returns over the other agent's; 0 if the returns are better left as they are.
    error : float
        What the slope's own standard error adds to the standard error of the corrected mean.
    """

    slope: float = 0.0
    error: float = 0.0


def luck_of(returns: ArrayLike, luck: ArrayLike, mean: float) -> Luck:
    """Return how far luck accounts for returns, by linear regression on another agent's returns.

    The returns' mean can be corrected to what it would be if the other agent had had its true mean in these
    episodes. The slope is 0 where that would not make the mean more certain: the slope of a few episodes, in
    which the other agent always does nearly the same, says nothing about episodes in which it does not.

    Parameters
    ----------
    returns, luck : array_like, shape (policies, episodes)
        Returns of an agent's policies, and of the other agent in their episodes.
    mean : float
        The other agent's true mean.
    """
    values, others = np.asarray(returns, np.float64), np.asarray(luck, np.float64)
    apart = others - others.mean(axis=1, keepdims=True)
    own = values - values.mean(axis=1, keepdims=True)
    square, free = float(np.sum(apart * apart)), own.size - len(own)
    if square <= 0.0 or free < 10:  # fewer say too little about their own spread
        return Luck()
    slope = float(np.sum(apart * values)) / square
    variance = float(np.sum((own - slope * apart) ** 2)) / (free - 1)
    error = abs(mean - float(others.mean())) * math.sqrt(variance / square)
    if variance / own.size + error**2 < float(np.sum(own * own)) / free / own.size:
        return Luck(slope, error)
    return Luck()


def without_luck(returns: ArrayLike, reference: ArrayLike | None) -> tuple[float, float]:
    """Return mean and standard error of returns in the first episodes that a reference played.

    The reference's excess in these episodes over its mean in all of them is subtracted, times the slope of
    `luck_of` (a control variate).

    Parameters
    ----------
    returns : array_like, shape (n,)
        An agent's returns.
    reference : array_like, shape (m,), optional
        The reference's returns in the same episodes, followed by more.

    Examples
    --------
    >>> import numpy as np
    >>> luck = np.random.default_rng(0).normal(size=10_000)
    >>> mean, error = without_luck(5.0 + 2.0 * luck[:100], luck)
    >>> abs(mean - 5.0) < 0.05, error < 0.03
    (True, True)
    """
    values = np.asarray(returns, np.float64)
    if reference is None:
        return mean_and_error(values)
    same = np.asarray(reference, np.float64)[: len(values)]
    mean, its_error = mean_and_error(reference)
    luck = luck_of(values[None], same[None], mean)
    rest, error = mean_and_error(values - luck.slope * same)
    return rest + luck.slope * mean, math.hypot(error, luck.error, luck.slope * its_error)


# --- errors and intervals -----------------------------------------------------------------------------------


def mean_and_error(sample: ArrayLike) -> tuple[float, float]:
    """Return the mean and its standard error, 0 for a single number."""
    values = np.asarray(sample, np.float64)
    error = values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else 0.0
    return float(values.mean()), float(error)


def redraw(rng: np.random.Generator, sample: ArrayLike) -> Array:
    """Return bootstrap samples: numbers drawn from a sample with replacement, shape (RESAMPLES, n)."""
    values = np.asarray(sample, np.float64)
    return values[rng.integers(values.size, size=(RESAMPLES, values.size))]


def ends(samples: ArrayLike) -> tuple[float, float]:
    """Return the ends of the interval from bootstrap samples of a number."""
    low, high = np.quantile(np.asarray(samples), [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(low), float(high)


def interval(statistic: Callable[..., Any], *strata: ArrayLike) -> list[float] | None:
    """Return the percentile bootstrap interval of a statistic, each stratum resampled by itself.

    Parameters
    ----------
    statistic : callable
        Takes the strata; reduces along the last axis.
    *strata : array_like, shape (n_i,)
        The samples.

    Returns
    -------
    list of float, or None
        Lower and upper end; None if a stratum has a single element, which says nothing about the spread.
    """
    if any(np.size(s) < 2 for s in strata):
        return None
    rng = np.random.default_rng(0)
    return list(ends(statistic(*[redraw(rng, s) for s in strata])))


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a probability; every trial counts as independent.

    Examples
    --------
    >>> [round(end, 3) for end in wilson(0, 10)]
    [0.0, 0.278]
    """
    found = binomtest(successes, trials).proportion_ci(LEVEL, method="wilson")
    return float(found.low), float(found.high)


def estimate(groups: Sequence[ArrayLike]) -> dict[str, Any]:
    """Return a summary of several policies of one agent, from the results of each.

    Parameters
    ----------
    groups : sequence of array_like, shape (episodes,)
        One array for each training seed; a single one for an agent that was not trained.

    Returns
    -------
    dict
        ``value`` and the ends of its interval ``low`` and ``high``: the interquartile mean over seeds with a
        bootstrap over them, or for a single policy the mean with 1.96 standard errors over episodes. ``mean``
        and its standard ``error``, over seeds or otherwise over episodes; ``each`` policy's mean.
    """
    means = np.array([np.asarray(g, np.float64).mean() for g in groups])
    several = len(means) > 1
    mean, error = mean_and_error(means if several else groups[0])
    low, high = (interval(iqm, means) if several else None) or (mean - SIGMAS * error, mean + SIGMAS * error)
    value = float(iqm(means)) if several else mean
    return {"value": value, "low": low, "high": high, "mean": mean, "error": error, "each": means.tolist()}


def rounded_data(value: Any) -> Any:
    """Return JSON-like data with numbers rounded to 6 digits; more would be noise and make files large."""
    if isinstance(value, dict):
        return {k: rounded_data(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded_data(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
