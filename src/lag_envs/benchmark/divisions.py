"""How often the certificate divides steps, and what that costs: a section of ``lag-envs bench``.

A step is divided where one series would leave out too much, as when a chain whips. `Scene.step_bound` tells
into how many parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from lag_envs.tables import markdown_table
from lag_envs.tasks import TASKS

#: Environments of a batch under random actions, and of how many steps one is looked at.
BATCH, EVERY = 16, 5


def divisions(ids: Sequence[str]) -> list[dict[str, Any]]:
    """Return how steps are divided in an episode of random actions.

    Parameters
    ----------
    ids : sequence of str
        Environments of the package; those with imperfections are left out, for their steps are divided where
        commands change too.

    Returns
    -------
    list of dict
        For each one ``id``; ``mean`` and ``most`` substeps of a step, ``divided``, the share of steps with
        more than one, and ``fastest``, the largest velocity that was seen [SI].
    """
    return [_divided(env_id) for env_id in ids if env_id in TASKS and not TASKS[env_id].imperfections]


def _divided(env_id: str) -> dict[str, Any]:
    envs: Any = gym.make_vec(env_id, BATCH, autoreset_mode="SameStep").unwrapped
    scene, dt, limit = envs.scene, envs.task.dt, int(envs.task.limit)
    fast = [i for i, entry in enumerate(scene._layout.state) if entry.kind != "place"]
    envs.reset(seed=0)
    envs.action_space.seed(0)
    parts: list[int] = []
    fastest = 0.0
    for step in range(limit):
        before = envs.state
        _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
        fastest = max(fastest, float(np.abs(before[:, fast]).max()))
        if step % EVERY == 0:
            going = ~(terminated | truncated)  # of the others the control is gone
            held = zip(before[going], envs.control[going], strict=True)
            parts += [int(scene.step_bound(state, control, dt).substeps) for state, control in held]
    envs.close()
    return {
        "id": env_id,
        "mean": round(float(np.mean(parts)), 3),
        "most": max(parts),
        "divided": round(float(np.mean(np.array(parts) > 1)), 3),
        "fastest": round(fastest, 1),
    }


HEAD = ("id", "series a step", "most", "steps that are divided", "fastest [1/s]", "time of a series")


def cells(row: Mapping[str, Any], nanoseconds: float | None) -> tuple[str, ...]:
    """Return a line of the table; `nanoseconds` is the time of a step, where it was measured."""
    each = "" if nanoseconds is None else f"{nanoseconds / row['mean']:,.0f} ns"
    share = f"{100.0 * row['divided']:.0f} %"
    return row["id"], f"{row['mean']:.2f}", str(row["most"]), share, f"{row['fastest']:.1f}", each


def markdown(rows: Sequence[Mapping[str, Any]], times: Mapping[str, float]) -> str:
    """Return the table of those whose steps are divided at times, with the times of their steps [ns]."""
    lines = [cells(row, times.get(row["id"])) for row in rows if row["most"] > 1]
    return markdown_table(list(HEAD), [list(line) for line in lines])
