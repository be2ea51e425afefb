"""Scenes defined by energies alone, compared with Gymnasium's CartPole."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from lag_envs.benchmark.environments import stepped
from lag_envs.benchmark.rounds import ENERGIES, Contestant, Run
from lag_envs.envs.vector import LagrangianVectorEnv

#: Bars of the longest chain.
LONGEST = 6


def of_energies(sizes: Sequence[int]) -> list[Contestant]:
    """Return the exact CartPole and the double pendulum at all sizes, and chains of bars at one size."""
    # Batches of thousands of long chains would take minutes until their episodes are staggered.
    middle = max((n for n in sizes if n <= 1024), default=min(sizes))
    some: list[tuple[str, str, dict[str, Any], int]]
    some = [("CartPole, exact", "lag_envs.tasks.cart_pole:CartPoleExact", {}, n) for n in sizes]
    some += [("Chain(2)", "lag_envs.benchmark.chain_swing:ChainSwing", {"bars": 2}, n) for n in sizes]
    some += [
        (f"Chain({i})", "lag_envs.benchmark.chain_swing:ChainSwing", {"bars": i}, middle)
        for i in (1, *range(3, LONGEST + 1))
    ]
    return [
        Contestant(ENERGIES, id, "vector", n, partial(energies, task, given, n))
        for id, task, given, n in some
    ]


def energies(task: str, given: dict[str, Any], n: int) -> Run:
    """Prepare a vector environment of a task, "module:Class"."""
    return stepped(LagrangianVectorEnv(task, n, **given))


def chains(rows: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the time of a step by the number of bars [ns], and the exponent of the best power-law fit.

    Examples
    --------
    >>> about = {"library": ENERGIES, "num_envs": 8}
    >>> rows = [
    ...     {**about, "id": f"Chain({n})", "steps_per_second": [0.0, 1e9 / n**2, 0.0]} for n in (1, 2, 4)
    ... ]
    >>> chains(rows)
    {'bars': [1, 2, 4], 'ns': [1.0, 4.0, 16.0], 'exponent': 2.0}
    """
    found = [
        r
        for r in rows
        if r["library"] == ENERGIES and r["id"].startswith("Chain") and "steps_per_second" in r
    ]
    counts = [r["num_envs"] for r in found]
    size = max(counts, key=counts.count, default=0)
    times = {int(r["id"][6:-1]): 1e9 / r["steps_per_second"][1] for r in found if r["num_envs"] == size}
    if len(times) < 2:
        return None
    bars = sorted(times)
    slope = np.polyfit(np.log(bars), np.log([times[n] for n in bars]), 1)[0]
    return {"bars": bars, "ns": [round(times[n], 1) for n in bars], "exponent": round(float(slope), 2)}
