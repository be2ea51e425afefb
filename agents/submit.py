"""Make leaderboard submissions of all our agents: learners, controllers and optimal policies.

``python -m agents.submit --help`` has the options.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learners import OWN, learner_label
from agents.run import MODEL, check_env, reports_errors
from agents.solution import DEFAULT_FOLDER, Solution, nodes, played, solvable
from agents.value_iteration import CacheError
from lag_envs import TASKS
from lag_envs.controllers import controllers
from lag_envs.leaderboard.export import ExportError, export, find
from lag_envs.leaderboard.protocol import LEARNED_POLICIES, boards
from lag_envs.leaderboard.standings import OURS
from lag_envs.leaderboard.submission import Refused, Submission, load, write
from lag_envs.options import module_parser

Array = NDArray[np.float64]
LICENSE = "MIT"
#: The public address of this file's folder.
CODE = "https://github.com/lag-envs/lag-envs/blob/main/agents/"

HELP = """submissions, each a folder in OUT:
  ENV-ALGO              from RUNS/ENV/ALGO/seed*/, if at least five seeds are finished
  ENV-CONTROLLER        from every controller in lag_envs.controllers
  ENV-optimal           from the value functions of `python -m agents.optimum`, coarsened to a table

Existing folders are kept, so that re-running resumes; --new makes them again.

examples:
  python -m agents.submit runs/submissions
  python -m agents.submit runs/submissions --envs PivotedBar-v0 --new"""


# --- optimal ------------------------------------------------------------------------------------------------


def tabulate(solution: Solution) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return a solution as the table ``[policy]`` of a submission and its arrays.

    The values are those after the first step and before the random kick that may follow, averaged over the
    kick. Each axis has the nodes of its own `level`.

    Parameters
    ----------
    solution : Solution
        The value functions.
    """
    problem, states = solution.problem, solution.task.scene.state_names
    axes, names = [], []
    for axis, name in zip(problem.axes, states, strict=True):
        if axis.centre == "target":  # the largest distance of a target from its mirror image
            axis = replace(axis, low=axis.low - max(problem.targets), centre=0.0)
            name += " - target"
        found = nodes(axis, axis.level, None)
        if axis.periodic:  # an angle observed by its cosine and sine lies within half a turn
            found = found - 0.5 * (found[0] + found[-1])
        axes.append(found[found >= -1e-12] if name == problem.mirror else found)
        names.append(name)
    if problem.targets:
        axes.append(np.array(problem.targets))
        names.append("target")
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    targets = points[:, -1] if problem.targets else None
    at = points[:, : len(states)].copy()
    for j, name in enumerate(names):
        if name.endswith(" - target"):
            at[:, j] += points[:, -1]
    # At the start of an episode there is no value after a step.
    values = solution.expected(1, at, targets).reshape([len(axis) for axis in axes])
    policy: dict[str, Any] = {"architecture": "table", "kind": "value", "axes": names}
    policy |= {"actions": problem.actions} | ({"mirror": problem.mirror} if problem.mirror else {})
    arrays = {f"axis_{j}": axis for j, axis in enumerate(axes)}
    return policy, arrays | {"table": values.astype(np.float32)}


def optimal(env_id: str, folder: Path, cache: Path | None = DEFAULT_FOLDER) -> Submission:
    """Write the optimal policy of an environment as a submission.

    Parameters
    ----------
    env_id : str
        Id of an environment for which value iteration gives a policy.
    folder : Path
        Destination; must not exist.
    cache : Path, optional
        Cache of `agents.optimum`; missing values are computed.
    """
    solution = Solution(env_id, solvable()[env_id].levels[-1], cache)
    policy, arrays = tabulate(solution)
    sizes = " x ".join(map(str, solution.programs[0].grid.shape))
    return write(
        folder, env=env_id, name="optimal", authors=OURS, license=LICENSE, policy=policy,
        arrays={0: arrays},
        description=f"value iteration on {sizes} nodes, coarsened to a table; greedy one step ahead",
    )  # fmt: skip


# --- all ----------------------------------------------------------------------------------------------------


def submit_learned(env_id: str, runs: Path, folder: Path) -> Submission:
    """Write the finished runs of a learner as a submission, with a folder for each seed."""
    algo = runs.name
    name = learner_label(algo)
    origin = OWN[algo].module if algo in OWN else "Stable-Baselines3"
    module = OWN[algo].module.removeprefix("agents.") if algo in OWN else "learners"
    made, off, count = export(
        find([runs]), folder, env=env_id, name=name, authors=OURS, license=LICENSE,
        description=f"{origin}, with the hyperparameters that `lag-envs hyperparams` prints",
        code=f"{CODE}{module}.py",
    )  # fmt: skip
    if count:
        print(
            f"  acts as the models do: actions differ by {off:.1e} at most, over {count} observations of each"
        )
    return made


def controller(env_id: str, name: str, folder: Path) -> Submission:
    """Write a built-in controller as a submission."""
    return write(
        folder, env=env_id, name=name, authors=OURS, license=LICENSE,
        policy={"architecture": "controller", "name": name},
        description="built in, with its own numbers",
    )  # fmt: skip


def entrants(env_id: str, runs: Path, cache: Path) -> Iterator[tuple[str, Callable[[Path], Submission]]]:
    """Yield, for each agent of an environment, its name and a function that writes its submission."""
    for name in controllers(TASKS[env_id]):
        yield name, partial(controller, env_id, name)
    if env_id in played() and (cache / env_id).is_dir():
        yield "optimal", partial(optimal, env_id, cache=cache)
    for folder in sorted(f for f in (runs / env_id).glob("*") if f.is_dir()):
        finished = len(list(folder.glob(f"seed*/{MODEL}")))
        if finished >= LEARNED_POLICIES:
            yield folder.name, partial(submit_learned, env_id, folder)
        elif finished:
            print(f"{folder}: left out: it has {finished} finished runs, but {LEARNED_POLICIES} are needed")


def folder_part(name: str) -> str:
    """Return a name in the form that folder names use."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser("agents.submit", "Make leaderboard submissions of all our agents.", HELP)
    p.add_argument("out", metavar="OUT", type=Path, help="folder for the submissions")
    p.add_argument("--envs", nargs="+", metavar="ENV", help="environments (default: all)")
    p.add_argument(
        "--runs",
        type=Path,
        default=Path("runs"),
        metavar="FOLDER",
        help="folder of learners' runs (default runs/)",
    )
    p.add_argument(
        "--optimum",
        type=Path,
        default=DEFAULT_FOLDER,
        metavar="FOLDER",
        help="folder of value functions (default %(default)s)",
    )
    p.add_argument("--new", action="store_true", help="make existing submissions again")
    return p


@reports_errors("agents.submit")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where something could not be submitted, 2 for a mistake of the user's."""
    args = parser().parse_args(arguments)
    failed = 0
    envs = [check_env(name) for name in args.envs] if args.envs else boards()
    for env_id in dict.fromkeys(envs):
        for name, make in entrants(env_id, args.runs, args.optimum):
            folder = args.out / f"{env_id}-{folder_part(name)}"
            print(folder, flush=True)
            try:
                if folder.exists():
                    if not args.new:
                        load(folder)
                        continue
                    shutil.rmtree(folder)
                make(folder)
            except (Refused, ExportError, CacheError) as error:
                print(f"  cannot be submitted: {error}", file=sys.stderr)
                failed += 1
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
