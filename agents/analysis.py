"""Statistics of what was measured of agents; their outcome is all that figures and page need."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import bootstrap

from lag_envs.leaderboard import ranking
from lag_envs.leaderboard.ranking import iqm

Array = NDArray[np.float64]
Data = dict[str, Any]

#: Bootstrap samples of an interval, as many as rliable draws, and how likely the interval is to cover.
RESAMPLES, LEVEL = 2000, 0.95
NOMINAL, OFTEN = "nominal", "ten times as often"
#: Points of a learning curve.
POINTS = 33


# --- statistics ---------------------------------------------------------------------------------------------


def interval(statistic: Callable[..., Any], *strata: ArrayLike) -> list[float] | None:
    """Return the percentile bootstrap interval of a statistic, each stratum resampled by itself.

    That is rliable's stratified bootstrap [1]_, with an environment as stratum and a seed as element.

    Parameters
    ----------
    statistic : callable
        Takes the strata and ``axis``; works on arrays of any number of dimensions.
    *strata : array_like, shape (n_i,)
        The samples.

    Returns
    -------
    list of float, or None
        Lower and upper end; None where a stratum has a single element, which tells nothing of the spread.

    References
    ----------
    .. [1] R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
       NeurIPS 2021.
    """
    if any(np.size(s) < 2 for s in strata):
        return None
    found = bootstrap(
        strata, statistic, n_resamples=RESAMPLES, confidence_level=LEVEL, method="percentile",
        vectorized=True, axis=-1, rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return [float(found.low), float(found.high)]


def iqm_of_all(*strata: ArrayLike, axis: int = -1) -> Any:
    """Return the interquartile mean of all strata together."""
    return iqm(np.concatenate(strata, axis=axis), axis=axis)


def improvement(x: ArrayLike, y: ArrayLike, axis: int = -1) -> Any:
    """Return `ranking.improvement`, as SciPy's bootstrap calls it: with the axis, which is the last."""
    return ranking.improvement(x, y)


def estimate(groups: Sequence[ArrayLike]) -> Data:
    """Return what several policies of one agent reach, from each one's results.

    Parameters
    ----------
    groups : sequence of array_like, shape (episodes,)
        One for each training seed; one only for an agent that was not trained.

    Returns
    -------
    dict
        ``value`` and the ends of its interval ``low`` and ``high``: the interquartile mean over seeds with a
        bootstrap over them, or for a single policy the mean with 1.96 standard errors over episodes. ``mean``
        and its standard ``error``, over seeds or else over episodes; ``each`` policy's mean.
    """
    means = np.array([np.mean(g) for g in groups], np.float64)
    sample = means if len(means) > 1 else np.asarray(groups[0], np.float64)
    error = float(sample.std(ddof=1) / math.sqrt(len(sample))) if len(sample) > 1 else 0.0
    mean = float(means.mean())
    if len(means) > 1:
        value, (low, high) = float(iqm(means)), interval(iqm, means)
    else:
        value, low, high = mean, mean - 1.96 * error, mean + 1.96 * error
    return {"value": value, "low": low, "high": high, "mean": mean, "error": error, "each": means.tolist()}


def learning_curve(curves: Sequence[Sequence[Sequence[float]]], column: int) -> Data | None:
    """Return the interquartile mean of seeds' learning curves and its interval.

    Parameters
    ----------
    curves : sequence, each of shape (n, 3)
        Steps, seconds and result for each seed; read between the points as if straight.
    column : int
        What the curves run over: 0 steps, 1 seconds.

    Returns
    -------
    dict or None
        ``x``, ``value``, ``low`` and ``high``, over the part that all curves have in common; without an
        interval for a single seed. None where there is no such part.
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


# --- the numbers that are kept ------------------------------------------------------------------------------


def summarise_env(agents: Iterable[Data], known: tuple[float, float] | None) -> Data:
    """Return all that figures and page need of one environment.

    Parameters
    ----------
    agents : iterable of dict
        For each agent its ``name``, ``kind``, ``conditions`` (by name, the returns of each of its policies),
        and for learners ``seeds``, ``steps``, ``seconds`` and ``curves`` (one for each seed), ``trained_on``.
    known : tuple of float, optional
        Mean return of the random and of the best known policy. Results are scores then, else returns.
    """

    def scored(returns: ArrayLike) -> Array:
        values = np.asarray(returns, np.float64)
        return values if known is None else (values - known[0]) / (known[1] - known[0])

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
        found[agent["name"]] = entry
    return {"known": list(known) if known else None, "agents": ranked(found), "improvement": compare(found)}


def level(conditions: Mapping[str, Sequence[ArrayLike]]) -> dict[str, list[Array]]:
    """Return returns of conditions that were measured in fewer episodes, comparable with those in all.

    Some episodes are easier than others. So the returns are moved by as much as the same policy's return in
    the same episodes differs from its return in all of them, both without the condition.
    """
    nominal = [np.asarray(g, np.float64) for g in conditions[NOMINAL]]
    found = {}
    for name, groups in conditions.items():
        moved = [np.asarray(g, np.float64) for g in groups]
        if len(moved) == len(nominal):
            moved = [g + n.mean() - n[: len(g)].mean() for g, n in zip(moved, nominal, strict=True)]
        found[name] = moved
    return found


def ranked(agents: Mapping[str, Data]) -> dict[str, Data]:
    """Return the agents, the best first."""
    return dict(sorted(agents.items(), key=lambda item: (-item[1]["conditions"][NOMINAL]["value"], item[0])))


def compare(agents: Mapping[str, Data]) -> Data:
    """Return for each learner the probability that a run of it is better than a policy of another agent."""
    found: dict[str, Data] = {}
    each = {name: np.array(agent["conditions"][NOMINAL]["each"]) for name, agent in ranked(agents).items()}
    for one in (name for name in each if agents[name]["kind"] == "learned"):
        for other in (name for name in each if name != one):
            x, y = each[one], each[other]
            if len(y) > 1:
                ends = interval(improvement, x, y)
            else:  # against one policy only the runs can be drawn anew

                def against(a: Array, axis: int = -1, y: Array = y) -> Any:
                    return improvement(a, y, axis)

                ends = interval(against, x)
            found.setdefault(one, {})[other] = {"value": float(improvement(x, y)), "interval": ends}
    return found


def summarise_learners(envs: Mapping[str, Data]) -> Data:
    """Return each learner's interquartile mean over the environments with a score, which are the strata."""
    scores: dict[str, dict[str, list[float]]] = {}
    for env_id, env in envs.items():
        for name, agent in env["agents"].items() if env["known"] else ():
            if agent["kind"] == "learned":
                scores.setdefault(name, {})[env_id] = agent["conditions"][NOMINAL]["each"]
    return {
        name: {
            "value": float(iqm_of_all(*per_env.values())),
            "interval": interval(iqm_of_all, *per_env.values()),
            "envs": sorted(per_env),
            "runs": sum(map(len, per_env.values())),
        }
        for name, per_env in sorted(scores.items())
    }


def rounded(value: Any) -> Any:
    """Return JSON-like data with numbers of 6 digits; what is beyond is noise and makes files large."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
