"""How agents act: arrival times, final errors, speeds at a line.

``python -m agents.behaviour`` plays the episodes of `docs/agents.md` with the quick controllers and with
those of our learned policies that are verified on the board. It writes ``agents/results/behaviour.json``,
from which ``python -m agents.results --redraw`` makes that page's tables.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from agents.learners import LEARNERS, learner_label
from agents.report import stored
from agents.results import ROOT, write_envs
from agents.run import FIRST_FRESH_SEED, check_env, fresh_seeds, reports_errors
from lag_envs import TASKS
from lag_envs.controllers import Constant, build
from lag_envs.evaluation.rollout import Episodes, Rollout, record_rollout
from lag_envs.evaluation.statistics import rounded_data
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.standings import OURS
from lag_envs.leaderboard.submission import load
from lag_envs.options import module_parser

BOARD, OUTPUT = ROOT / "leaderboard", ROOT / "agents" / "results" / "behaviour.json"
EPISODES = 1_000


# --- what is measured ---------------------------------------------------------------------------------------


def arrival(what: str, played: Episodes) -> dict[str, float | None]:
    """Measure when the board's goal is reached for good, and how much reward is lost before and after.

    The loss of a step is 1 minus its reward. Means are taken over the episodes in which the goal holds at the
    end (None if there are no such episodes); the other episodes are counted.
    """
    seconds = played.settled()
    well = np.isfinite(seconds)
    before = np.arange(len(played.rewards))[:, None] * played.task.dt < seconds - 1e-9
    lost = 1.0 - played.rewards
    sums = {
        f"{what} after [s]": seconds,
        "lost by then": np.where(before, lost, 0.0).sum(axis=0),
        "lost afterwards": np.where(before, 0.0, lost).sum(axis=0),
    }
    means = {name: float(values[well].mean()) if well.any() else None for name, values in sums.items()}
    return means | {"episodes without": float((~well).sum())}


def measures(played: Episodes) -> dict[str, float | None]:
    """Return what is measured in episodes: the arrival at the goal, and the task's own measures."""
    task = played.task
    found = arrival(task.goal.arrival, played) if task.goal and task.goal.arrival else {}
    return found | dict(task.behaviour(played))


def agents(env_id: str) -> Iterator[tuple[str, list[Any]]]:
    """Yield our quick agents of an environment: name, and policies, one for each training seed."""
    task = TASKS[env_id]()
    for name, found in task.controllers.items():
        agent = None if found.plans else build(task, name)  # planning takes long
        if agent is not None and not isinstance(agent, Constant):  # a constant action shows nothing
            yield name, [agent]
    board, names = Board(BOARD), {learner_label(algo): algo for algo in LEARNERS}
    for entry in sorted(board.read().entries.values(), key=lambda entry: entry.id):
        own = entry.env == env_id and entry.kind == "learned" and tuple(entry.authors) == OURS
        if own and entry.state == "verified":
            yield (
                names[entry.name],
                [policy.agent() for _, policy in load(board.submission(entry.id)).policies],
            )


def behaviour_of(env_id: str) -> dict[str, dict[str, list[float | None]]]:
    """Return the measures of an environment's agents: for each agent and measure, a number per policy."""
    found: dict[str, dict[str, list[float | None]]] = {}
    for name, policies in agents(env_id):
        rows = [
            measures(record_rollout(Rollout(env_id, policy, fresh_seeds(EPISODES)))) for policy in policies
        ]
        found[name] = {key: [row[key] for row in rows] for key in rows[0]}
    return found


@reports_errors("agents.behaviour")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for a user's mistake."""
    p = module_parser(
        "agents.behaviour",
        __doc__,
        "examples:\n  python -m agents.behaviour\n  python -m agents.behaviour PivotedBar-v0",
    )
    p.add_argument(
        "env",
        nargs="*",
        metavar="ID",
        help="environments (default: all); the others keep their numbers",
    )
    args = p.parse_args(arguments)
    envs = [check_env(name) for name in args.env] or [env_id for env_id, task in TASKS.items() if task.goal]
    found = stored(OUTPUT).get("envs", {}) if args.env else {}
    about = {"episodes": EPISODES, "first_seed": FIRST_FRESH_SEED}
    for env_id in envs:
        found[env_id] = rounded_data(behaviour_of(env_id))
        for name, measures in found[env_id].items():
            lines = (f"{key}: {values}" for key, values in measures.items())
            print(env_id, name, *lines, sep="\n  ", flush=True)
        write_envs(OUTPUT, about, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
