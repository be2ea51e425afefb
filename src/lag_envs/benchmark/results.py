"""Statistics of samples: quartiles, and ratios within a round."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lag_envs.benchmark.rounds import THREADED, Contestant


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return lower quartile, median and upper quartile.

    Examples
    --------
    >>> quartiles([4.0, 1.0, 3.0, 2.0, 5.0])
    (2.0, 3.0, 4.0)
    """
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    return low, middle, high


def ratios(rates: Sequence[float], others: Sequence[float]) -> list[float]:
    """Return the ratio within each round, for the rounds that both lists have.

    Examples
    --------
    >>> ratios([4.0, 9.0], [2.0, 3.0, 5.0])
    [2.0, 3.0]
    """
    return [a / b for a, b in zip(rates, others, strict=False)]


def row_summary(row: Contestant, rows: Sequence[Contestant]) -> dict[str, Any]:
    """Return a row with its statistics, and its ratio to CartPole-v1 at the same size."""
    kind = "vector" if row.kind == "vector" else "made"
    rival = [
        r.rates
        for r in rows
        if (r.library, r.id, r.kind, r.num_envs) == ("gymnasium", "CartPole-v1", kind, row.num_envs)
    ]
    result = {name: getattr(row, name) for name in ("library", "id", "kind", "num_envs", "problem", "rates")}
    if row.rates:
        result["steps_per_second"] = quartiles(row.rates)
    if rival and (pairs := ratios(row.rates, rival[0])):
        result["ratio"] = quartiles(pairs)
    return result


def speedups(rows: Sequence[Contestant]) -> list[dict[str, Any]]:
    """Return, for each batch stepped by several threads, the quartiles of the ratio to one thread."""
    rates = {(row.library, row.id, row.num_envs): row.rates for row in rows if row.kind == "vector"}
    return [
        {"id": id, "num_envs": n, "ratio": quartiles(pairs)}
        for (library, id, n), threaded in rates.items()
        if library == THREADED and (pairs := ratios(threaded, rates["lag_envs", id, n]))
    ]


def times_of(report: dict[str, Any]) -> dict[str, float]:
    """Return the time of a step of each environment [ns], in the largest batch."""
    found = [r for r in report["rows"] if r["library"] == "lag_envs" and "steps_per_second" in r]
    most = max((r["num_envs"] for r in found), default=0)
    return {r["id"]: 1e9 / r["steps_per_second"][1] for r in found if r["num_envs"] == most}
