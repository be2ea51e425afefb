"""The measured peak rate of multiply-adds of a core: a section of ``lag-envs bench``.

A product takes as long as a multiply-add, so it counts as one. Sums without a product are left out, since
many processors do them in parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np

from lag_envs.benchmark.results import quartiles, ratios
from lag_envs.benchmark.rounds import CORE, Contestant
from lag_envs.envs.imperfect.constants import constants_of
from lag_envs.envs.imperfect.programs import program_of
from lag_envs.envs.program import Program
from lag_envs.envs.vector import on_a_line
from lag_envs.stepping.compiling import compile_lines, count_operations

#: How many numbers (few enough for the nearest cache) and how many multiply-adds on each (enough to make
#: loads negligible).
NUMBERS, TIMES = 1024, 12
PRODUCTS = frozenset({"*", "a*b+c", "a*b-c", "c-a*b"})


@cache
def _compiled() -> Callable:
    lines = [
        "wide_vectors()",
        "for _ in range(n):",
        f"    for i in range({NUMBERS}):",
        "        x = numbers[i]",
        *["        x = fma(x, 0.5, 1.0)"] * TIMES,
        "        numbers[i] = x",
    ]
    return compile_lines("multiply_adds", "numbers, n", lines)


def peak() -> Callable[[int], int]:
    """Return a function that does at least this many multiply-adds on each number, and counts them."""
    multiply_adds, numbers = _compiled(), on_a_line(np.ones(NUMBERS))

    def run(count: int) -> int:
        turns = -(-count // TIMES)
        multiply_adds(numbers, turns)
        return turns * TIMES

    return run


def products(program: Program) -> int | None:
    """Return how many products an ordinary step of one environment computes; None if the step has a loop."""
    if program.general:
        return None
    lines = [*program.control, *program.fast, *program.outcome, *program.kick, *program.observe]
    return count_operations(lines, PRODUCTS)


def arithmetic(rows: Sequence[Contestant]) -> list[dict[str, Any]]:
    """Return, for our largest batch of each id, its products per step and its share of the core's peak.

    The share is products per second over multiply-adds per second, as quartiles over the rounds.
    """
    limits = next((row.rates for row in rows if row.library == CORE), [])
    batches = [r for r in rows if r.library == "lag_envs" and r.kind == "vector"]
    largest = {r.id: r for r in sorted(batches, key=lambda r: r.num_envs)}
    found = []
    for id, row in largest.items():
        count = None
        if row.rates:
            task: Any = gym.make_vec(id, num_envs=1).unwrapped.task  # type: ignore[attr-defined]
            count = products(program_of(task, [constants_of(task)]))
        if count and (pairs := ratios(row.rates, limits)):
            share = quartiles([count * pair for pair in pairs])
            found.append({"id": id, "num_envs": row.num_envs, "products": count, "share": share})
    return found
