"""Plans for tasks that no grid can solve, found from random guesses and selected by their returns.

``python -m agents.optimum`` calls this for tasks that have `Task.plans`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lag_envs import TASKS
from lag_envs.controllers.chain import replan
from lag_envs.controllers.tracking import Tracking, plan_file, search
from lag_envs.evaluation.rollout import Rollout, play
from lag_envs.evaluation.statistics import mean_and_error

#: Seeds of the guesses, and the number of the most promising plans tried from each.
SEEDS, PROMISING = range(3), 6
#: Seeds of episodes that nothing else uses, and the number of episodes that decide which plan is kept.
FIRST_SEED, EPISODES = 3_500_000_000, 200
#: Starts that decide which plan is the best initial guess.
STARTS = 8


def promising_controllers(env_id: str, seeds: Iterable[int], **changes: Any) -> Iterable[Tracking]:
    """Yield controllers that follow the most promising plans of each seed."""
    for seed in seeds:
        yield from islice(search(TASKS[env_id](), seed, **changes), PROMISING)


def find_plans(env_id: str, folder: Path | None, seeds: Iterable[int]) -> None:
    """Find an environment's plans, and write them to where controllers read them, or into a folder.

    One plan is followed from any start: the one with the best mean return over fresh starts. The other is the
    best initial guess if each episode is replanned. A task that follows another's plans has none of its
    own.
    """
    task, began = TASKS[env_id](), time.monotonic()
    if task.plans.of:
        return
    found = []
    for agent in promising_controllers(env_id, seeds):
        mean, error = mean_and_error(play(env_id, agent, range(FIRST_SEED, FIRST_SEED + EPISODES)))
        found.append((mean, error, agent))
    mean, error, best = max(found, key=lambda entry: entry[0])
    best.save(plan_file(task, folder=folder))
    seconds = time.monotonic() - began
    print(f"{env_id}: followed, {mean:.2f} ± {error:.2f} in {EPISODES} episodes, {seconds:.0f} s", flush=True)

    if not task.plans.quick:
        return
    starts = Rollout(env_id, None, range(FIRST_SEED, FIRST_SEED + STARTS)).state
    guesses = [best, *promising_controllers(env_id, seeds, **task.plans.quick)]
    gains = []
    for agent in guesses:
        planner = replan(task, guesses=[agent])
        # Each step beyond the plan's end pays 1; the cost of the tail is subtracted.
        gains.append(planner.plan(starts, np.zeros(STARTS))[1].mean() + task.limit - planner.steps)
    guesses[int(np.argmax(gains))].save(plan_file(task, "quick", folder))
    seconds = time.monotonic() - began
    print(f"{env_id}: best of {len(guesses)} plans to begin planning from, {seconds:.0f} s", flush=True)
