"""Random numbers for imperfections: a key for each purpose, uniform numbers, normal noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.envs.lines import recorded_lines
from lag_envs.envs.program import DRAWS
from lag_envs.stepping.tracing import Trace
from lag_envs.tasks.imperfections import normals

#: Purposes that have draws of their own, with the numbers from which their keys are made.
PURPOSES = {"parameters": 1, "observation": 2, "action": 3, "delay": 4, "push": 5, "age": 6}


def purpose_key(purpose: str) -> str:
    """Return the key of an episode's draws for a purpose."""
    return f"episode_key(key, np.uint64({PURPOSES[purpose]}))"


def noise(
    values: Sequence[str],
    purpose: str,
    sigmas: Mapping[str, float],
    constants: Mapping[str, Any],
    trace: type[Trace],
) -> list[str]:
    """Return the lines that add normal draws to values; every two of them share a pair of uniform draws.

    Parameters
    ----------
    values : sequence of str
        The values that get noise.
    purpose : str
        One of `PURPOSES`.
    sigmas : mapping of str to float
        For each value, the name of its standard deviation among the constants, and its size, which decides
        whether there is noise; empty for no noise at all.
    constants : mapping
        Name, or zero, of each constant.
    trace : type of Trace
        The kind of recording for formulas.
    """
    if not sigmas:
        return []

    def two(xp: Any, first: Any, second: Any) -> list:
        return normals(first, second, xp)

    lines = [f"key_{purpose} = {purpose_key(purpose)}"]
    per_step = -(-(len(values) + len(values) % 2) // DRAWS)  # each step reserves this many times `DRAWS`
    names = list(sigmas)
    for i in range(0, len(values), 2):
        pair = [j for j in (i, i + 1) if j < len(values) and sigmas[names[j]] > 0.0]
        if pair:
            lines += [
                f"{x} = uniform(key_{purpose}, np.uint64(n) * np.uint64({per_step}), np.uint64({j}))"
                for x, j in zip(("draw0", "draw1"), (i, i + 1), strict=True)
            ]
            lines += recorded_lines(two, ["draw0", "draw1"], ["normal0", "normal1"], trace)
            lines += [f"{values[j]} += {constants[names[j]]} * normal{j - i}" for j in pair]
    return lines
