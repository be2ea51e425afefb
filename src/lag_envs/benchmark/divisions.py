"""How often the certificate divides steps, and the cost of this: a section of ``lag-envs bench``.

A step is divided if a single series would have too large a truncation error, for example when a chain whips.
`Scene.step_bound` gives the number of parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from lag_envs.scenes.derivation import layout_of
from lag_envs.tables import markdown_table
from lag_envs.tasks import TASKS
from lag_envs.workers import stopping_point

#: Number of environments in a batch under random actions, and every how many steps one is examined.
BATCH, EVERY = 16, 5


def divisions(ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return how steps are divided in an episode of random actions.

    Parameters
    ----------
    ids : sequence of str
        Environments of the package. Environments with imperfections are left out, since their steps are also
        divided when commands change.

    Returns
    -------
    list of dict
        For each environment its ``id``; ``mean`` and ``most``, the mean and largest number of substeps of a
        step; ``divided``, the share of steps with more than one; and ``fastest``, the largest velocity that
        occurred [SI].
    """
    return [
        {"id": env_id} | divided(gym.make_vec(env_id, BATCH, autoreset_mode="SameStep").unwrapped)
        for env_id in ids
        if env_id in TASKS and not TASKS[env_id].imperfections
    ]


def divided(envs: Any) -> dict[str, Any]:
    """Return how a vector environment's steps are divided: a row of `divisions` without its ``id``."""
    scene, dt, limit = envs.scene, envs.task.dt, int(envs.task.limit)
    fast = [i for i, entry in enumerate(layout_of(scene).state) if entry.kind != "place"]
    envs.reset(seed=0)
    envs.action_space.seed(0)
    parts: list[int] = []
    fastest = 0.0
    for step in range(limit):
        stopping_point()
        before = envs.state
        _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
        fastest = max(fastest, float(np.abs(before[:, fast]).max()))
        if step % EVERY == 0:
            going = ~(terminated | truncated)  # the other environments have lost their control
            held = zip(before[going], envs.control[going], strict=True)
            parts += [int(scene.step_bound(state, control, dt).substeps) for state, control in held]
    envs.close()
    return {
        "mean": round(float(np.mean(parts)), 3),
        "most": max(parts),
        "divided": round(float(np.mean(np.array(parts) > 1)), 3),
        "fastest": round(fastest, 1),
    }


HEAD = ("id", "series a step", "most", "steps that are divided", "fastest [1/s]", "time of a series")


def table_row(row: Mapping[str, Any], nanoseconds: float | None) -> tuple[str, ...]:
    """Return a line of the table; `nanoseconds` is the time of a step, if it was measured."""
    each = "" if nanoseconds is None else f"{nanoseconds / row['mean']:,.0f} ns"
    share = f"{100.0 * row['divided']:.0f} %"
    return row["id"], f"{row['mean']:.2f}", str(row["most"]), share, f"{row['fastest']:.1f}", each


def divisions_markdown(rows: Sequence[Mapping[str, Any]], times: Mapping[str, float]) -> str:
    """Return the table of environments with divided steps, with the times of their steps [ns]."""
    lines = [table_row(row, times.get(row["id"])) for row in rows if row["most"] > 1]
    return markdown_table(list(HEAD), [list(line) for line in lines])
