"""Planning in real time: how long calls of a controller take, compared with the interval between them.

``python -m agents.real_time`` plays episodes by the clock with every controller that plans during an episode.
If planning takes longer than a step, the controller plans ahead in a separate process, as the task's record
says (`lag_envs.tasks.record.Controller.real_time`). The cost is the difference between the returns with and
without planning ahead, in other episodes that are the same for both. `docs/agents.md` shows times and costs.
"""

from __future__ import annotations

import datetime
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from agents.report import stored
from agents.results import ROOT, write_envs
from agents.run import FIRST_FRESH_SEED, check_env, check_numbers, fresh_seeds, reports_errors
from lag_envs import TASKS
from lag_envs.controllers import build
from lag_envs.evaluation.rollout import play
from lag_envs.evaluation.statistics import mean_and_error, rounded_data
from lag_envs.host import machine
from lag_envs.options import module_parser

OUTPUT = ROOT / "agents" / "results" / "real_time.json"
CLOCKED, EPISODES = 3, 64


def planning(env_id: str) -> Iterator[str]:
    """Yield the controllers of an environment that plan during an episode."""
    task = TASKS[env_id]()
    for name, found in task.controllers.items():
        if found.plans and not build(task, name).plans_at_start:
            yield name


def clocked(env_id: str, name: str, episodes: int) -> NDArray[np.float64]:
    """Return the seconds that each call except an episode's first takes, in episodes played by the clock."""
    env: Any = gym.make(env_id)
    task = env.unwrapped.task
    agent = build(task, name, real_time=True)
    seconds = []
    for seed in fresh_seeds(episodes):
        observation, _ = env.reset(seed=seed)
        action, memory = agent.predict(observation, None, np.True_, deterministic=True)
        due, over = time.perf_counter(), False
        while not over:
            due += task.dt
            observation, _, ended, stopped, _ = env.step(action)
            over = ended or stopped
            time.sleep(max(0.0, due - time.perf_counter()))
            began = time.perf_counter()
            action, memory = agent.predict(observation, memory, np.False_, deterministic=True)
            seconds.append(time.perf_counter() - began)
            due = max(due, began)  # a late call delays those after it
    return np.array(seconds)


def measured(env_id: str, name: str, clocked_episodes: int, episodes: int) -> dict[str, Any]:
    """Return a controller's times [s] and, if it plans ahead, its return and what planning ahead costs."""
    task = TASKS[env_id]()
    hurry = task.controllers[name].real_time
    seconds = clocked(env_id, name, clocked_episodes)
    found: dict[str, Any] = {
        "interval": task.dt,
        "allowed": hurry["ahead"] * task.dt * task.controllers[name].numbers.get("finer", 1)
        if hurry
        else None,
        "median": float(np.median(seconds)),
        "p99": float(np.percentile(seconds, 99.0)),
        "longest": float(seconds.max()),
        "late": float((seconds > task.dt).mean()),
        "calls": len(seconds),
    }
    if hurry:
        ways = [build(task, name), build(task, name, real_time=True, background=False)]
        before, after = (play(env_id, agent, fresh_seeds(episodes)) for agent in ways)
        found["loss"] = mean_and_error(before - after)
        found["return"] = mean_and_error(after)
    return found


def line(env_id: str, name: str, row: dict[str, Any]) -> str:
    """Return a row's line."""
    times = ", ".join(f"{what} {1e3 * row[what]:.2f} ms" for what in ("median", "p99", "longest"))
    text = f"{env_id} {name}: interval {1e3 * row['interval']:g} ms, {times}, late {row['late']:.2%}"
    if row["allowed"] is not None:
        text += ", ahead {:g} ms, loss {:.2f} ± {:.2f}".format(1e3 * row["allowed"], *row["loss"])
    return text


@reports_errors("agents.real_time")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for a user's mistake."""
    p = module_parser(
        "agents.real_time",
        __doc__,
        "examples:\n  python -m agents.real_time\n  python -m agents.real_time TripleBar-v0",
    )
    p.add_argument(
        "env", nargs="*", metavar="ID", help="environments (default: all); the others keep their numbers"
    )
    p.add_argument(
        "--clocked",
        type=int,
        default=CLOCKED,
        metavar="N",
        help="episodes by the clock (default %(default)s)",
    )
    p.add_argument(
        "--episodes",
        type=int,
        default=EPISODES,
        metavar="N",
        help="episodes for returns (default %(default)s)",
    )
    p.add_argument(
        "--output",
        type=Path,
        default=OUTPUT,
        metavar="FILE",
        help="results as JSON (default agents/results/real_time.json)",
    )
    args = p.parse_args(arguments)
    check_numbers(args, clocked=1, episodes=2)
    envs = [check_env(name) for name in args.env] or list(TASKS)
    found = stored(args.output).get("envs", {}) if args.env else {}
    about = {"date": datetime.date.today().isoformat(), "machine": machine(), "clocked": args.clocked}
    about |= {"episodes": args.episodes, "first_seed": FIRST_FRESH_SEED}
    for env_id in envs:
        rows = {}
        for name in planning(env_id):
            rows[name] = rounded_data(measured(env_id, name, args.clocked, args.episodes))
            print(line(env_id, name, rows[name]), flush=True)
        if rows:
            found[env_id] = rows
        write_envs(args.output, about, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
