"""Coarse value functions for the leaderboard's page: ``python -m agents.board_values [ID ...]``.

Writes ``leaderboard/values/ID.json``: the largest attainable return at the start of an episode, as a function
of two entries of the state, with the other entries and the target at 0. Coarse grids are enough for a
picture.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.run import check_env, reports_errors
from agents.solution import DEFAULT_FOLDER, Solution, solved_for
from lag_envs import TASKS
from lag_envs.options import module_parser
from lag_envs.store import write_file

POINTS = 61  #: along each axis


def coarse(env_id: str, folder: Path | None = DEFAULT_FOLDER) -> dict[str, Any]:
    """Return an environment's value function in the page's format.

    Parameters
    ----------
    env_id : str
        Id of an environment.
    folder : Path, optional
        Where value functions are kept; None keeps them in memory.

    Returns
    -------
    dict
        ``axes``: two dicts with the state's name as ``label``, and ``low``, ``high``, ``n``; ``values``: n
        rows of n numbers, by the first axis. The lowest values are made equal, so that the other values can
        be told apart in the picture.
    """
    source, problem = solved_for(env_id)
    solution = Solution(source, problem.levels[0], folder, quiet=True)
    names = solution.task.scene.state_names
    axes = [
        {"label": names[solution.keep[i]], "low": axis.low, "high": axis.high, "n": POINTS}
        for i, axis in enumerate(problem.axes[:2])
    ]
    mesh = np.meshgrid(*(np.linspace(a["low"], a["high"], POINTS) for a in axes), indexing="ij")
    points = np.zeros((POINTS * POINTS, len(problem.axes)))
    points[:, 0], points[:, 1] = (m.ravel() for m in mesh)
    targets = np.zeros(len(points)) if problem.targets else None
    values = solution.value(0, points, targets)
    values = np.maximum(values, np.quantile(values, problem.lost)).reshape(POINTS, POINTS)
    rounded = [[float(f"{x:.4g}") for x in row] for row in values]
    return {"axes": axes, "values": rounded}


@reports_errors("agents.board_values")
def main(arguments: Sequence[str] | None = None) -> int:
    """Write the files."""
    parser = module_parser(
        "agents.board_values",
        __doc__,
        "examples:\n  python -m agents.board_values\n  python -m agents.board_values PivotedBar-v0",
    )
    parser.add_argument("env", nargs="*", metavar="ID", help="ids of environments (default: all)")
    parser.add_argument(
        "--board",
        type=Path,
        default=Path("leaderboard"),
        help="folder of the leaderboard (default %(default)s)",
    )
    args = parser.parse_args(arguments)
    solved = [env_id for env_id, task in TASKS.items() if task.value_iteration]
    envs = [check_env(name) for name in args.env] or solved
    for env_id in envs:
        path = args.board / "values" / f"{env_id}.json"
        write_file(path, json.dumps(coarse(env_id), separators=(",", ":")) + "\n")
        print(path, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
