"""The ratios and times that ours are to reach, and whether they do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from lag_envs.benchmark.results import quartiles


class Target(NamedTuple):
    """A ratio that ours is to reach, against Gymnasium's CartPole-v1 of the same kind and size."""

    kind: str
    num_envs: int
    ratio: float

    def __str__(self) -> str:
        """Return what is compared."""
        return f"{self.kind}, {self.num_envs:,}" if self.kind == "vector" else f"single, {self.kind}"


TARGETS = (
    Target("made", 1, 2.0),
    Target("vector", 64, 6.0),
    Target("vector", 1024, 3.0),
    Target("vector", 16384, 3.0),
)
#: Seconds from the start of a process to its end after one step, by state of the cache of compiled code.
COLD_TARGETS = {"empty": 2.5, "filled": 0.5}


def reached(rows: Sequence[dict[str, Any]], target: Target) -> dict[str, float]:
    """Return the median ratio of each environment of ours for which there is this target."""
    return {
        row["id"]: row["ratio"][1]
        for row in rows
        if row["library"] == "lag_envs" and (row["kind"], row["num_envs"]) == target[:2] and "ratio" in row
    }


def verdicts(rows: Sequence[dict[str, Any]], cold: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Hold what was measured against the targets; ``met`` is None where nothing was measured."""
    results = []
    for target in TARGETS:
        measured = reached(rows, target)
        met = all(value >= target.ratio for value in measured.values()) if measured else None
        goal = f"{target}: at least {target.ratio:g} x CartPole-v1"
        results.append({"target": goal, "limit": target.ratio, "met": met, "measured": measured})
    for name, limit in COLD_TARGETS.items():
        measured = {"seconds": quartiles(cold[name])[1]} if cold.get(name) else {}
        met = measured["seconds"] < limit if measured else None
        goal = f"cold start, cache {name}: below {limit:g} s"
        results.append({"target": goal, "limit": limit, "met": met, "measured": measured})
    return results
