"""Lines of Python that make up the compiled functions of an environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from lag_envs.stepping.compiling import indent, section
from lag_envs.stepping.tracing import Trace

#: The loop over the lanes of a block, which go on side by side.
EACH_LANE = "for i in range(size):"


def recorded_lines(
    formula: Callable, inputs: Sequence[Any], outputs: Sequence[str], trace: type[Trace]
) -> list[str]:
    """Record a formula; outputs that turned out constant are assigned as well."""
    lines, values = section(formula, inputs, outputs, trace)
    return lines + [f"{name} = {value}" for name, value in zip(outputs, values, strict=True) if value != name]


def draw_lines(names: Sequence[str], step: str) -> list[str]:
    """Draw uniform numbers of a step."""
    return [f"{name} = uniform(key, {step}, np.uint64({i}))" for i, name in enumerate(names)]


def next_episode(key: str, episode: str, episode_key: str) -> list[str]:
    """Count the episode and make its key, in ``ids`` at these places."""
    return [
        f"ids[{episode}] += np.uint64(1)",
        f"key = episode_key(ids[{key}], ids[{episode}])",
        f"ids[{episode_key}] = key",
    ]


def indented(head: str, body: Sequence[str]) -> list[str]:
    """Put lines under a header."""
    return [head, *indent(body)]
