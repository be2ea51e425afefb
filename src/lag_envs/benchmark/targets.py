"""The ratios and times that this package should reach, and whether it reaches them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

from lag_envs.benchmark.results import quartiles
from lag_envs.benchmark.rounds import ENERGIES
from lag_envs.scenes.derivation import form_of
from lag_envs.tasks import TASKS


class SpeedTarget(NamedTuple):
    """A target ratio against Gymnasium's CartPole-v1 of the same kind and size.

    Without an id, it applies to all environments whose scene has a dedicated flow, such as a driven
    pendulum's. The general series does more work, so its targets name their environments.
    """

    kind: str
    num_envs: int
    ratio: float
    id: str | None = None

    def __str__(self) -> str:
        """Return a description of the comparison."""
        size = f"{self.kind}, {self.num_envs:,}" if self.kind == "vector" else f"single, {self.kind}"
        return size if self.id is None else f"{self.id}, {size}"

    def meant_for(self, row: dict[str, Any]) -> bool:
        """Return whether the target applies to a row of a report."""
        if (row["kind"], row["num_envs"]) != (self.kind, self.num_envs):
            return False
        if self.id is not None:
            return (row["library"], row["id"]) == (ENERGIES, self.id)
        return row["library"] == "lag_envs" and has_own_flow(row["id"])


#: Targets for environments with a dedicated flow, one for each column of the table.
TARGETS = (
    SpeedTarget("made", 1, 2.0),
    SpeedTarget("vector", 64, 6.0),
    SpeedTarget("vector", 1024, 3.0),
    SpeedTarget("vector", 16384, 3.0),
)
#: Targets for the general series.
SERIES_TARGETS = (
    SpeedTarget("vector", 16384, 1.0, "CartPole, exact"),
    SpeedTarget("vector", 16384, 0.25, "Chain(2)"),
)
#: Seconds from the start of a process to its end after one step, by state of the cache of compiled code.
COLD_TARGETS = {"empty": 2.5, "filled": 0.5}


@cache
def has_own_flow(env_id: str) -> bool:
    """Return whether an environment is stepped only by its scene's dedicated flow."""
    return env_id in TASKS and not TASKS[env_id].imperfections and form_of(TASKS[env_id]().scene) is not None


def reached_targets(rows: Sequence[dict[str, Any]], target: SpeedTarget) -> dict[str, float]:
    """Return the median ratio of each row that should reach a target."""
    return {row["id"]: row["ratio"][1] for row in rows if "ratio" in row and target.meant_for(row)}


def verdicts(rows: Sequence[dict[str, Any]], cold: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Compare the measurements with the targets; ``met`` is None if nothing was measured."""
    results = []
    for target in (*TARGETS, *SERIES_TARGETS):
        measured = reached_targets(rows, target)
        met = all(value >= target.ratio for value in measured.values()) if measured else None
        goal = f"{target}: at least {target.ratio:g} x CartPole-v1"
        results.append({"target": goal, "limit": target.ratio, "met": met, "measured": measured})
    for name, limit in COLD_TARGETS.items():
        measured = {"seconds": quartiles(cold[name])[1]} if cold.get(name) else {}
        met = measured["seconds"] < limit if measured else None
        goal = f"cold start, cache {name}: below {limit:g} s"
        results.append({"target": goal, "limit": limit, "met": met, "measured": measured})
    return results
