"""Statistics of verified results: scores with intervals, ranks, and a board's other columns.

What is resampled
-----------------
A row holds the scores of its policies in their episodes, shape (policies, episodes), corrected for the luck
of the episodes (`corrected`). A policy's result is its mean over the episodes, and the row's score is the
interquartile mean (IQM) over the policies, as in rliable for one task [1]_. Intervals are percentile
bootstrap intervals of 95 %:

- Several policies in a row are a sample of training seeds: they are resampled within the row (the
  stratum), each with its mean fixed.
- A row of one policy, such as a deterministic controller, has no spread of training: its episodes are
  resampled. The interval says how well the mean is known, and nothing about training.
- The reference that measures luck has a mean that is itself uncertain. Each bootstrap sample therefore draws
  another mean from a normal distribution. The same one is used for all rows, since an error moves them all
  together, each as far as it was corrected (`luck_of`). The reference's own row is moved all the way: after
  the correction, only that mean is left of it, which comes from other episodes, with its standard error.

Each row's generator is seeded by its id, so a row's numbers do not depend on the other rows.

References
----------
.. [1] R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
   NeurIPS 2021.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lag_envs.evaluation.statistics import (
    RESAMPLES,
    THRESHOLDS,
    ends,
    improvement,
    iqm,
    luck_of,
    median_time,
    optimality_gap,
    profile,
    redraw,
    wilson,
)
from lag_envs.scores import Scale, normalised
from lag_envs.tasks import TASKS

Array = NDArray[np.float64]


class Reference(Protocol):
    """The mean return of the controller that plays the same episodes, and its standard error."""

    @property
    def mean(self) -> float:
        """Its mean return in other episodes."""

    @property
    def error(self) -> float:
        """Standard error of that mean."""


class Chance(NamedTuple):
    """Probability that a policy of one row does better than one of another row, with its interval."""

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
        From 1; rows share a rank if none of them is clearly better. The next rank counts all of them.
    above : Chance or None
        Probability that the row above does better than this one; None for the first.
    """

    id: str
    rank: int
    above: Chance | None


def corrected(reference: Reference | None, policies: Sequence[Mapping[str, Any]]) -> Array:
    """Return verified policies' returns without the luck of their episodes, shape (policies, episodes).

    Every submission has its own episodes, and in some environments episodes differ more than agents do. So
    the environment's reference, whose mean return is known, has played the same ones. Its excess over that
    mean, times the slope of the agent's returns over the reference's, is subtracted (a control variate: the
    agent's expected return stays the same, and an agent uncorrelated with the reference keeps its returns).
    Returns are left alone where that would not make their mean more certain, see `luck_of`.

    Parameters
    ----------
    reference : Reference or None
        The environment's reference; None if it has none.
    policies : sequence of mapping
        The verified data of each policy: ``returns`` and, if the environment has one, ``reference``.
    """
    return _corrected(reference, policies)[0]


def _corrected(reference: Reference | None, policies: Sequence[Mapping[str, Any]]) -> tuple[Array, float]:
    """Return `corrected`, and the standard error that the correction brings into all of it."""
    returns = np.array([p["returns"] for p in policies], np.float64)
    if reference is None or any(p.get("reference") is None for p in policies):
        return returns, 0.0
    others = np.array([p["reference"] for p in policies], np.float64)
    luck = luck_of(returns, others, reference.mean)
    error = math.hypot(luck.slope * reference.error, luck.error)
    return returns - luck.slope * (others - reference.mean), error


class Scores(NamedTuple):
    """The scores that rank a row.

    Attributes
    ----------
    table : ndarray, shape (policies, episodes)
        Scores corrected for luck.
    error : float
        Standard error of the correction for luck, the same for all of the row's scores.
    """

    table: Array
    error: float = 0.0

    @property
    def own(self) -> bool:
        """Whether the row is the reference itself, or acts like it: its own episodes cancel out."""
        return self.error > 0.0 and float(self.table.std()) < 1e-9


def scored(scale: Scale, reference: Reference | None, policies: Sequence[Mapping[str, Any]]) -> Scores:
    """Return the scores of verified policies, see `corrected`."""
    table, error = _corrected(reference, policies)
    return Scores(normalised(scale, table), error / abs(scale.best - scale.random))


def policy_error(reference: Reference | None, policies: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the standard error of a policy's corrected mean return, averaged over the policies.

    It is None for a single episode, which says nothing about the spread.
    """
    table, error = _corrected(reference, policies)
    if table.shape[1] < 2:
        return None
    own = table.std(axis=1, ddof=1).mean() / math.sqrt(table.shape[1])
    return math.hypot(own, error)


def redrawn(id: str, scores: Scores) -> Array:
    """Return bootstrap samples of the policies' means, shape (RESAMPLES, policies).

    Parameters
    ----------
    id : str
        The row; seeds the generator.
    scores : Scores
        Its scores.
    """
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(id.encode()).digest()[:16], "big"))
    table = scores.table
    sample = table.mean(axis=1) if len(table) > 1 else table[0]
    drawn = redraw(rng, sample)
    drawn = drawn if len(table) > 1 else drawn.mean(axis=1, keepdims=True)
    # All rows share the k-th sample's error of the reference's mean.
    return drawn + scores.error * np.random.default_rng(0).normal(size=(RESAMPLES, 1))


def compare(x: Scores, y: Scores, x_drawn: Array, y_drawn: Array) -> Chance:
    """Return the probability that a policy of one row does better than one of another row.

    Parameters
    ----------
    x, y : Scores
        Scores of the two rows.
    x_drawn, y_drawn : ndarray, shapes (RESAMPLES, policies)
        Their samples from `redrawn`.
    """
    value = improvement(x.table.mean(axis=1), y.table.mean(axis=1))
    return Chance(float(value), *ends(improvement(x_drawn, y_drawn)))


def ranked(scores: Mapping[str, Scores], drawn: Mapping[str, Array]) -> list[Place]:
    """Return the rows sorted by score, with their ranks.

    A row shares the rank of the row above unless some row of that rank is clearly better, which means that
    the interval of the probability that it does better excludes one half.

    Parameters
    ----------
    scores : mapping of str to Scores
        Scores of each row, by its id.
    drawn : mapping of str to ndarray, shape (RESAMPLES, policies)
        Their samples from `redrawn`.
    """
    order = sorted(scores, key=lambda id: (-float(iqm(scores[id].table.mean(axis=1))), id))
    places: list[Place] = []
    for number, id in enumerate(order, 1):
        rank = places[-1].rank if places else 1
        peers = [compare(scores[p.id], scores[id], drawn[p.id], drawn[id]) for p in places[rank - 1 :]]
        if not all(chance.undecided for chance in peers):
            rank = number
        places.append(Place(id, rank, peers[-1] if peers else None))
    return places


def columns(env_id: str, result: Mapping[str, Any], few: int, scale: Scale, scores: Scores) -> dict[str, Any]:
    """Return a row's columns that need no other row, except the interval of its score.

    Parameters
    ----------
    env_id : str
        The environment.
    result : mapping
        The verified result.
    few : int
        Number of episodes that are also played under changed conditions; they are the first ones.
    scale : Scale
        The environment's.
    scores : Scores
        The result's scores, from `scored`.

    Returns
    -------
    dict
        ``score``, mean ``return``, optimality ``gap``, ``success`` with Wilson's interval over all episodes
        of all policies, ``settle``: the median time [s], ``effort``: the mean, ``robustness``: the score
        under each changed condition, ``often``: the score when acting ten times as often, ``profile``: pairs
        of a score and the share of episodes above it, not corrected for luck. None for anything not measured.
    """
    policies = result["policies"]
    bare = np.array([p["returns"] for p in policies], np.float64)
    means = scores.table.mean(axis=1)
    settle, effort, success = (
        [value for p in policies for value in p[name]] for name in ("settle", "effort", "success")
    )
    goal = TASKS[env_id].goal if env_id in TASKS else None
    counted = None
    if goal is None or goal.counted:
        low, high = wilson(sum(success), len(success))
        counted = {"rate": sum(success) / len(success), "low": low, "high": high}
    # Only the first episodes are disturbed: subtract how they differ from all even if undisturbed.
    moved = means - normalised(scale, bare[:, :few].mean(axis=1))
    # With random kicks, acting more often draws different ones.
    often = 0.0 * moved if env_id in TASKS and TASKS[env_id]().draws else moved
    return {
        "score": float(iqm(means)),
        "return": scale.random + float(means.mean()) * (scale.best - scale.random),
        "gap": optimality_gap(means),
        "success": counted,
        "settle": median_time(settle),
        "effort": float(np.mean(effort)),
        "robustness": _scores(scale, result["robustness"], moved),
        "often": _scores(scale, {"often": result["often"]}, often).get("often"),
        "profile": np.column_stack([THRESHOLDS, profile(normalised(scale, bare))]).round(5).tolist(),
    }


def _scores(scale: Scale, returns: Mapping[str, Sequence[float | None]], moved: Array) -> dict[str, float]:
    """Return the score under each condition, shifted; conditions that a policy did not play are left out."""
    full = {name: each for name, each in returns.items() if None not in each}
    if not full:
        return {}
    means = normalised(scale, np.array([*full.values()], np.float64)) + moved
    return dict(zip(full, iqm(means).tolist(), strict=True))
