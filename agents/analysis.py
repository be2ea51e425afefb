"""Statistics of the agents' measurements: everything that the figures and the page need."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.evaluation.conditions import NOMINAL
from lag_envs.evaluation.statistics import estimate, improvement, interval, iqm, median_time, pooled_iqm
from lag_envs.scores import Scale, normalised

Array = NDArray[np.float64]
Data = dict[str, Any]

#: Points of a learning curve.
POINTS = 33
#: Scores whose first arrival is reported.
LEVELS = (0.9, 0.97, 0.99)


# --- statistics ---------------------------------------------------------------------------------------------


def learning_curve(curves: Sequence[Sequence[Sequence[float]]], column: int) -> Data | None:
    """Return the interquartile mean of seeds' learning curves and its interval.

    Parameters
    ----------
    curves : sequence, each of shape (n, 3)
        For each seed its points: steps, seconds and result. Curves are linear between the points.
    column : int
        The abscissa: 0 steps, 1 seconds.

    Returns
    -------
    dict or None
        ``x``, ``value``, ``low`` and ``high``, over the part that all curves have in common; a single seed
        has no interval. None if the curves have no common part.
    """
    tables = [np.array(c, np.float64).reshape(-1, 3) for c in curves]
    if not tables or any(len(t) < 2 for t in tables):
        return None
    first, last = max(t[0, column] for t in tables), min(t[-1, column] for t in tables)
    if not first < last:
        return None
    x = np.linspace(first, last, POINTS)
    lines = np.array([np.interp(x, t[:, column], t[:, 2]) for t in tables])
    found: Data = {"x": x.tolist(), "value": iqm(lines, axis=0).tolist(), "low": None, "high": None}
    if len(lines) > 1:
        ends = np.array([interval(iqm, line) for line in lines.T])
        found["low"], found["high"] = ends.T.tolist()
    return found


def first_reached(curve: Iterable[Sequence[float]], level: float, clock: int = 1) -> float | None:
    """Return when a curve first reached a level; None if it never did.

    The last number of each point is its score; `clock` selects the result: 0 steps, 1 seconds.
    """
    return next((point[clock] for point in curve if point[-1] >= level), None)


def times_to_levels(curves: Sequence[Sequence[Sequence[float]]]) -> Data:
    """Return for each level how many seeds reached it, and the medians of steps and seconds.

    Examples
    --------
    >>> late, never = [(10, 1.0, 0.5), (20, 2.0, 0.95)], [(10, 1.0, 0.5)]
    >>> times_to_levels([late])["0.9"], times_to_levels([never])["0.9"]
    ({'seeds': 1, 'steps': 20.0, 'seconds': 2.0}, {'seeds': 0, 'steps': None, 'seconds': None})
    """
    found = {}
    for level in LEVELS:
        steps, seconds = ([first_reached(curve, level, clock) for curve in curves] for clock in (0, 1))
        seeds = sum(value is not None for value in steps)
        found[str(level)] = {"seeds": seeds, "steps": median_time(steps), "seconds": median_time(seconds)}
    return found


# --- the numbers that are kept ------------------------------------------------------------------------------


def summarise_env(agents: Iterable[Data], scale: Scale | None) -> Data:
    """Return everything that the figures and the page need for one environment.

    Parameters
    ----------
    agents : iterable of dict
        For each agent its ``name``, ``kind``, ``conditions`` (by name, the returns of each of its policies),
        and for learners ``seeds``, ``steps``, ``seconds`` and ``curves`` (one for each seed), ``trained_on``.
    scale : Scale, optional
        Mean returns of the random and of the best known policy. With a scale, results are scores; without
        one, returns.
    """

    def scored(returns: ArrayLike) -> Array:
        return np.asarray(returns, np.float64) if scale is None else normalised(scale, returns)

    found: dict[str, Data] = {}
    for agent in agents:
        conditions = {}
        for name, groups in level(agent["conditions"]).items():
            returns = estimate(groups)
            conditions[name] = estimate([scored(g) for g in groups]) | {
                "return": returns["mean"],
                "return_error": returns["error"],
                "episodes": len(groups[0]),
            }
        entry: Data = {"kind": agent["kind"], "conditions": conditions}
        if agent["kind"] == "learned":
            curves = [[(s, t, float(scored(r))) for s, t, r in curve] for curve in agent["curves"]]
            entry |= {
                "seeds": agent["seeds"],
                "trained_on": agent["trained_on"],
                "steps": float(np.mean(agent["steps"])),
                "seconds": float(np.mean(agent["seconds"])),
                "curves": {"steps": learning_curve(curves, 0), "seconds": learning_curve(curves, 1)},
            }
            if scale is not None:
                entry["reached"] = times_to_levels(curves)
        found[agent["name"]] = entry
    known = None if scale is None else [scale.random, scale.best]
    return {"known": known, "agents": best_first(found), "improvement": chances_of_improvement(found)}


def level(conditions: Mapping[str, Sequence[ArrayLike]]) -> dict[str, list[Array]]:
    """Make returns from fewer episodes comparable with those from all episodes.

    Some episodes are easier than others, so the returns are corrected: by the difference between the policy's
    mean return in these episodes and in all episodes, both without the condition.
    """
    nominal = [np.asarray(g, np.float64) for g in conditions[NOMINAL]]
    found = {}
    for name, groups in conditions.items():
        moved = [np.asarray(g, np.float64) for g in groups]
        if len(moved) == len(nominal):
            moved = [g + n.mean() - n[: len(g)].mean() for g, n in zip(moved, nominal, strict=True)]
        found[name] = moved
    return found


def best_first(agents: Mapping[str, Data]) -> dict[str, Data]:
    """Return the agents, the best first."""
    return dict(sorted(agents.items(), key=lambda item: (-item[1]["conditions"][NOMINAL]["value"], item[0])))


def chances_of_improvement(agents: Mapping[str, Data]) -> Data:
    """Return for each learner the probability that one of its runs is better than another agent's policy."""
    found: dict[str, Data] = {}
    each = {
        name: np.array(agent["conditions"][NOMINAL]["each"]) for name, agent in best_first(agents).items()
    }
    for one in (name for name in each if agents[name]["kind"] == "learned"):
        for other in (name for name in each if name != one):
            x, y = each[one], each[other]
            if len(y) > 1:
                ends = interval(improvement, x, y)
            else:  # against a single policy, only the runs can be resampled
                ends = interval(partial(improvement, y=y), x)
            found.setdefault(one, {})[other] = {"value": float(improvement(x, y)), "interval": ends}
    return found


def summarise_learners(envs: Mapping[str, Data]) -> Data:
    """Return each learner's interquartile mean over all environments with a score; they are the strata."""
    scores: dict[str, dict[str, list[float]]] = {}
    for env_id, env in envs.items():
        for name, agent in env["agents"].items() if env["known"] else ():
            if agent["kind"] == "learned":
                scores.setdefault(name, {})[env_id] = agent["conditions"][NOMINAL]["each"]
    return {
        name: {
            "value": float(pooled_iqm(*per_env.values())),
            "interval": interval(pooled_iqm, *per_env.values()),
            "envs": sorted(per_env),
            "runs": sum(map(len, per_env.values())),
        }
        for name, per_env in sorted(scores.items())
    }
