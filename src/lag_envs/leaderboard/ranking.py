"""Statistics of verified results: scores with intervals, ranks, and the other columns of a board.

What is drawn anew
------------------
A row holds the scores of its policies in their episodes, shape (policies, episodes), without the luck of the
episodes (`corrected`). A policy's result is its
mean over the episodes, and the row's score is the interquartile mean (IQM) over the policies, as rliable has
it for one task [1]_. Intervals are percentile bootstrap intervals of 95 %:

- A row of several policies is a sample of training seeds: these are drawn anew, within the row (the stratum),
  each with its mean as it is.
- A row of one policy, such as a deterministic controller, has no spread of training: its episodes are drawn
  anew. The interval tells how well the mean is known, and nothing about training.

Each row draws from a generator seeded by its id, so a row's numbers do not depend on which others are there.

References
----------
.. [1] R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
   NeurIPS 2021.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, trim_mean

from lag_envs.leaderboard.protocol import DISTURBED_EPISODES, REFERENCES, make_task
from lag_envs.scores import score

Array = NDArray[np.float64]

#: Bootstrap samples, and how likely an interval is to cover.
RESAMPLES, LEVEL = 2000, 0.95
#: Scores at which performance profiles are given.
THRESHOLDS: Array = np.linspace(-0.25, 1.25, 61)


class Chance(NamedTuple):
    """Probability that a policy of one row does better than one of another, and its interval."""

    value: float
    low: float
    high: float

    @property
    def undecided(self) -> bool:
        """Whether the interval contains one half."""
        return self.low <= 0.5 <= self.high


class Place(NamedTuple):
    """A row's place on its board.

    Attributes
    ----------
    id : str
        The row.
    rank : int
        From 1; rows between which nothing is decided share one, and the next rank counts them all.
    above : Chance or None
        Of the row above to do better than this one; None for the first.
    """

    id: str
    rank: int
    above: Chance | None


def normalised(env_id: str, returns: ArrayLike) -> Array:
    """Return the scores of returns: 0 for the random policy's mean, 1 for that of the best policy known.

    Raises
    ------
    ValueError
        Where nothing is known of the environment.

    Examples
    --------
    >>> from lag_envs.scores import KNOWN_RETURNS
    >>> known = KNOWN_RETURNS["PivotedBarFree-v0"]
    >>> normalised("PivotedBarFree-v0", [known.random, known.best]).tolist()
    [0.0, 1.0]
    """
    found = score(env_id, cast(Any, np.asarray(returns, np.float64)))
    if found is None:
        raise ValueError(f"{env_id} has no scale: it needs an entry in lag_envs.scores.KNOWN_RETURNS")
    return cast(Array, found)


def corrected(env_id: str, policies: Sequence[Mapping[str, Any]]) -> Array:
    """Return the returns of verified policies without the luck of their episodes, shape (policies, episodes).

    Every submission has episodes of its own, and in some environments they differ more than agents do. So the
    environment's reference, whose mean return is known, has played the same ones: what it got above that is
    taken off, times the slope of the agent's returns over the reference's (a control variate; the mean stays
    what it is in the long run, and an agent that has nothing in common with the reference keeps its returns).

    Parameters
    ----------
    env_id : str
        The environment.
    policies : sequence of mapping
        What was verified of each policy: ``returns`` and, where the environment has one, ``reference``.
    """
    returns = np.array([p["returns"] for p in policies], np.float64)
    if env_id not in REFERENCES or not all("reference" in p for p in policies):
        return returns
    luck = np.array([p["reference"] for p in policies], np.float64) - REFERENCES[env_id][1]
    apart = luck - luck.mean(axis=1, keepdims=True)
    spread = np.sum(apart * apart)
    return returns - (np.sum(apart * returns) / spread if spread > 0.0 else 0.0) * luck


def iqm(values: ArrayLike, axis: int | None = -1) -> Any:
    """Return the interquartile mean: of the values without the lowest and the highest quarter.

    Of five values that is the mean of the middle three, of fewer than four the mean of all.

    Examples
    --------
    >>> float(iqm([0.0, 1.0, 2.0, 3.0, 100.0]))
    2.0
    """
    return trim_mean(values, 0.25, axis=axis)


def optimality_gap(means: ArrayLike) -> float:
    """Return how much policies lack to a score of 1 on average; what is above 1 makes up for nothing.

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


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return Wilson's interval of a probability, of 95 %; every trial counts as independent.

    Examples
    --------
    >>> [round(end, 3) for end in wilson(0, 10)]
    [0.0, 0.278]
    """
    ends = binomtest(successes, trials).proportion_ci(LEVEL, method="wilson")
    return float(ends.low), float(ends.high)


def median_time(times: Sequence[float | None]) -> float | None:
    """Return the median of times, None standing for never; None where half or more are never.

    Examples
    --------
    >>> median_time([1.0, None, 2.0]), median_time([1.0, None])
    (2.0, None)
    """
    found = float(np.median([np.inf if time is None else time for time in times]))
    return found if np.isfinite(found) else None


def redrawn(id: str, scores: ArrayLike) -> Array:
    """Return bootstrap samples of the policies' means, shape (RESAMPLES, policies).

    Parameters
    ----------
    id : str
        The row; seeds the generator.
    scores : array_like, shape (policies, episodes)
        Its scores.
    """
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(id.encode()).digest()[:16], "big"))
    table = np.asarray(scores, np.float64)
    sample = table.mean(axis=1) if len(table) > 1 else table[0]
    drawn = sample[rng.integers(sample.size, size=(RESAMPLES, sample.size))]
    return drawn if len(table) > 1 else drawn.mean(axis=1, keepdims=True)


def ends(samples: ArrayLike) -> tuple[float, float]:
    """Return the ends of the interval that bootstrap samples of a number give."""
    low, high = np.quantile(np.asarray(samples), [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(low), float(high)


def improvement(x: ArrayLike, y: ArrayLike) -> Any:
    """Return the probability that one of the elements of x is above one of y; equal ones count half.

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


def compare(x: ArrayLike, y: ArrayLike, x_drawn: Array, y_drawn: Array) -> Chance:
    """Return the probability that a policy of one row does better than one of another.

    Parameters
    ----------
    x, y : array_like, shapes (policies, episodes)
        Scores of the two rows.
    x_drawn, y_drawn : ndarray, shapes (RESAMPLES, policies)
        What `redrawn` made of them.
    """
    value = improvement(np.asarray(x).mean(axis=1), np.asarray(y).mean(axis=1))
    return Chance(float(value), *ends(improvement(x_drawn, y_drawn)))


def ranked(scores: Mapping[str, ArrayLike], drawn: Mapping[str, Array]) -> list[Place]:
    """Return the rows in the order of their scores, with their ranks.

    A row shares the rank of the row above where the interval of the probability that the one above does
    better contains one half. Sharing goes on from row to row: the first and the last of those who share a
    rank may well be apart.

    Parameters
    ----------
    scores : mapping of str to array_like, shape (policies, episodes)
        Scores of each row, by its id.
    drawn : mapping of str to ndarray, shape (RESAMPLES, policies)
        What `redrawn` made of them.
    """
    tables = {id: np.asarray(table, np.float64) for id, table in scores.items()}
    order = sorted(tables, key=lambda id: (-float(iqm(tables[id].mean(axis=1))), id))
    places: list[Place] = []
    for number, id in enumerate(order, 1):
        above = None
        rank = number
        if places:
            best = places[-1].id
            above = compare(tables[best], tables[id], drawn[best], drawn[id])
            rank = places[-1].rank if above.undecided else number
        places.append(Place(id, rank, above))
    return places


def columns(env_id: str, result: Mapping[str, Any], drawn: Array) -> dict[str, Any]:
    """Return the numbers of a row that need no other row.

    Parameters
    ----------
    env_id : str
        The environment.
    result : mapping
        What was verified.
    drawn : ndarray, shape (RESAMPLES, policies)
        What `redrawn` made of its scores.

    Returns
    -------
    dict
        ``score`` and its ``interval``, mean ``return``, optimality ``gap``, ``success`` with Wilson's
        interval over all episodes of all policies, ``settle``: the median time [s], ``effort``: the mean,
        ``robustness``: the score under each changed condition, ``often``: the score when acting ten times as
        often, ``profile``: pairs of a score and the share of episodes above it. None for what was not
        measured.
    """
    policies = result["policies"]
    returns = corrected(env_id, policies)
    scores = normalised(env_id, returns)
    means = scores.mean(axis=1)
    settle, effort = (pooled(policies, name) for name in ("settle", "effort"))
    success = pooled(policies, "success")
    counted = None
    if success:
        low, high = wilson(sum(success), len(success))
        counted = {"rate": sum(success) / len(success), "low": low, "high": high}
    # Disturbed are the first episodes only: what sets these apart from all is not the disturbance's doing.
    few = [np.mean(p["returns"][:DISTURBED_EPISODES]) for p in policies]
    moved = returns.mean(axis=1) - few
    robustness = {
        name: _score(env_id, each, moved) for name, each in (result.get("robustness") or {}).items()
    }
    return {
        "score": float(iqm(means)),
        "interval": list(ends(iqm(drawn))),
        "return": float(returns.mean()),
        "gap": optimality_gap(means),
        "success": counted,
        "settle": median_time(settle) if settle else None,
        "effort": float(np.mean(effort)) if effort else None,
        "robustness": {name: value for name, value in robustness.items() if value is not None},
        "often": _score(env_id, result.get("often"), 0.0 * moved if make_task(env_id).draws else moved),
        "profile": np.column_stack([THRESHOLDS, profile(scores)]).round(5).tolist(),
    }


def pooled(policies: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    """Return what was noted of every episode of every policy; nothing where it is not defined."""
    return [value for p in policies for value in (p.get(name) or [])]


def _score(env_id: str, returns: Sequence[float | None] | None, moved: Array) -> float | None:
    """Return the score of policies' mean returns, moved; None where one could not take part."""
    if not returns or None in returns:
        return None
    return float(iqm(normalised(env_id, np.array(returns, np.float64) + moved)))
