"""Scenes defined by energies alone, compared with Gymnasium's CartPole."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from lag_envs.benchmark.chain_swing import ChainSwing
from lag_envs.benchmark.environments import stepped
from lag_envs.benchmark.rounds import ENERGIES, Contestant, Run
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task

#: Number of bars of the longest chain.
LONGEST = 6


def of_energies(sizes: Sequence[int]) -> list[Contestant]:
    """Return the exact CartPole and the double pendulum at all sizes, and chains of bars at one size."""
    # Batches of thousands of long chains would take minutes until their episodes are staggered.
    middle = max((n for n in sizes if n <= 1024), default=min(sizes))
    exact = next(task for task in TASKS.values() if task.peer == "CartPole-v1")
    chains = [(2, n) for n in sizes] + [(bars, middle) for bars in (1, *range(3, LONGEST + 1))]
    some = [("CartPole, exact", n, partial(energies, exact, {}, n)) for n in sizes]
    some += [(f"Chain({bars})", n, partial(energies, ChainSwing, {"bars": bars}, n)) for bars, n in chains]
    return [Contestant(ENERGIES, id, "vector", n, prepare) for id, n, prepare in some]


def energies(task: type[Task], given: dict[str, Any], n: int) -> Run:
    """Prepare a vector environment of a task."""
    return stepped(LagrangianVectorEnv(task, n, **given))
