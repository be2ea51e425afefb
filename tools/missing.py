"""List the generated data and pictures that environments lack: ``python -m tools.missing``.

A new environment works before anything is generated for it: pages say "not measured yet", and tests that
compare with stored results use the environments that have results. Missing items are listed with the commands
that make them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from lag_envs.options import module_parser
from lag_envs.tables import aligned
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import measured_ids

ROOT = Path(__file__).parents[1]
#: Everything that can be generated, with its command; ID stands for the environment.
COMMANDS = {
    "returns": "python -m agents.scale ID --output src/lag_envs/tasks/measured.json",
    "rollouts": "python tests/golden_rollouts.py ID",
    "plan": "python -m agents.optimum ID",
    "value iteration": "python -m agents.optimum ID",
    "agents": "python -m agents.results --envs ID",
    "behaviour": "python -m agents.behaviour ID",
    "real time": "python -m agents.real_time ID",
    "board": "lag-envs leaderboard open",
    "speed": "make bench-docs",
    "accuracy": "make report ARGS='--docs .'",
    "picture": "python -m tools.docs --pictures ID",
}
#: Items that only some environments have.
SOME = ("plan", "value iteration", "behaviour", "real time", "board", "accuracy", "picture")


def have(what: str) -> list[str]:
    """Return the ids that have an item, one of the keys of `COMMANDS`."""
    there = _there(what)
    return [env_id for env_id in TASKS if env_id in there]


def missing(env_id: str) -> dict[str, str]:
    """Return the missing items of an environment, with their commands."""
    task = TASKS[env_id]
    for_all = [what for what in COMMANDS if what not in SOME]
    if task.value_iteration:
        for_all.append("value iteration")
    if task.plans is not None:
        for_all.append("plan")
    if task.goal:
        for_all += ["behaviour", "board", "picture"]  # of the agents on the board, and of the best one
    if any(found.real_time for found in task.controllers.values()):
        for_all.append("real time")
    if not task.imperfections:
        for_all.append("accuracy")
    return {what: COMMANDS[what].replace("ID", env_id) for what in for_all if env_id not in _there(what)}


@cache
def _there(what: str) -> frozenset[str]:
    results, images = ROOT / "agents" / "results", ROOT / "docs" / "images"
    found: Iterable[str]
    match what:
        case "returns":
            found = measured_ids()
        case "rollouts":
            found = (name.partition("/")[0] for name in _json(ROOT / "tests" / "golden" / "runs.json"))
        case "plan":
            found = (env_id for env_id, task in TASKS.items() if task.plans is not None and _planned(task))
        case "value iteration":
            found = (file.stem for file in (results / "optimum").glob("*.json"))
        case "agents":
            found = _json(results / "summary.json")["envs"]
        case "behaviour":
            found = _json(results / "behaviour.json")["envs"]
        case "real time":
            found = _json(results / "real_time.json")["envs"]
        case "board":
            found = _scales()
        case "speed":
            found = (row["id"] for row in _json(ROOT / "docs" / "speed.json")["rows"])
        case "accuracy":
            found = _measured_errors()
        case "picture":
            found = (file.stem for file in (images / "moving").glob("*.webp"))
        case _:
            raise ValueError(f"there is no {what!r}, only {', '.join(COMMANDS)}")
    return frozenset(found)


def _json(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"envs": {}, "rows": []}


def _planned(task: type[Task]) -> bool:
    from lag_envs.controllers import build

    try:
        return all(build(task(), name) is not None for name in task.controllers)
    except ValueError:
        return False


def _scales() -> Iterable[str]:
    from lag_envs.leaderboard.board import Board

    state = Board(ROOT / "leaderboard").read()
    return state.protocols[state.number].scales if state.number else ()


def _measured_errors() -> Iterable[str]:
    (part,) = (s for s in _json(ROOT / "docs" / "accuracy.json")["sections"] if s["name"] == "environments")
    where = part["summary"]["columns"].index("environment")
    return (row[where] for row in part["summary"]["rows"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the missing items; return 1 if anything is missing."""
    module_parser("tools.missing", __doc__, "examples:\n  python -m tools.missing").parse_args(arguments)
    rows = [[env_id, what, command] for env_id in TASKS for what, command in missing(env_id).items()]
    print(
        "\n".join(aligned([["environment", "missing", "command"], *rows])) if rows else "Nothing is missing."
    )
    return 1 if rows else 0


if __name__ == "__main__":
    sys.exit(main())
