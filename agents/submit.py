"""Make leaderboard submissions of all our agents: learners, controllers and optimal policies.

``python -m agents.submit --help`` tells more.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.optimum import DEFAULT_FOLDER, PROBLEMS, Solution
from agents.run import MODEL, UserError, check_env
from agents.value_iteration import CacheError
from lag_envs import TASKS
from lag_envs.controllers import CONTROLLERS
from lag_envs.leaderboard.export import ALGORITHMS, ExportError, export, find
from lag_envs.leaderboard.protocol import LEARNED_POLICIES
from lag_envs.leaderboard.submission import Refused, Submission, load, write

Array = NDArray[np.float64]
AUTHORS, LICENSE = ["the lag_envs authors"], "MIT"

HELP = """what is made, a folder each, in OUT:
  ENV-ALGO              from RUNS/ENV/ALGO/seed*/, where five seeds or more are finished
  ENV-CONTROLLER        every one of lag_envs.controllers
  ENV-optimal           the value functions of `python -m agents.optimum`, coarsened to a table

A folder that is there is kept, so that the same command goes on; --new makes it anew."""


# --- optimal ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Coarse:
    """How a value function is coarsened to a table.

    Parameters
    ----------
    axes : tuple of str
        What the grid's axes are in the submission; behind them come the target and the time where there are.
    levels : tuple of float
        For each axis the level of the grid (`agents.optimum.Axis.nodes`) whose nodes it takes.
    times : tuple of float
        Shares of the episode at which values are kept; one alone for a table without time.
    targets : tuple of float
        Targets, from 0 on, at which values are kept.
    mirror : str
        On whose sign to mirror; empty: not.
    """

    axes: tuple[str, ...]
    levels: tuple[float, ...]
    times: tuple[float, ...] = (0.0,)
    targets: tuple[float, ...] = ()
    mirror: str = ""


COARSE = {
    "PivotedBarFree-v0": Coarse(("theta", "theta_dot"), (4, 4), mirror="theta"),
    "InclineBrake-v0": Coarse(("x", "x_dot"), (4, 4)),
    "CylinderInCylinderDamping-v0": Coarse(("theta", "theta_dot"), (4, 4), mirror="theta"),
    "CylinderInCylinderPump-v0": Coarse(("theta", "theta_dot", "psi_dot"), (2, 2, 2), mirror="theta"),
    "InclineTilt-v0": Coarse(
        ("x - target", "w", "phi"), (2, 1, 1), targets=(0.0, 0.1, 0.2, 0.3), mirror="target"
    ),
    "CylinderInCylinderTilt-v0": Coarse(
        ("theta - target", "theta_dot", "psi_dot"), (1, 1, 1), targets=(0.0, 0.15, 0.3), mirror="target"
    ),
}


def tabulate(solution: Solution, coarse: Coarse) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return a solution as the table ``[policy]`` of a submission and its arrays.

    The values are those after a step and before the random kick that may follow, whose mean is taken.

    Parameters
    ----------
    solution : Solution
        The value functions.
    coarse : Coarse
        Where to take them.
    """
    problem = solution.problem
    nodes = []
    for axis, level, name in zip(problem.axes, coarse.levels, coarse.axes, strict=True):
        if name.endswith(" - target"):  # so far the target's mirror image may be away
            axis = replace(axis, low=axis.low - max(coarse.targets), centre=0.0)
        found = axis.nodes(level, None)
        if axis.periodic:  # an angle that is observed by cosine and sine lies within half a turn
            found = found - 0.5 * (found[0] + found[-1])
        nodes.append(found[found >= -1e-12] if name == coarse.mirror else found)
    axes, names = [*nodes], [*coarse.axes]
    if coarse.targets:
        axes.append(np.array(coarse.targets))
        names.append("target")
    times = np.unique(np.rint(np.array(coarse.times) * solution.steps).astype(np.int64))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    targets = points[:, -1] if coarse.targets else None
    states = points[:, : len(nodes)].copy()
    for j, name in enumerate(coarse.axes):
        if name.endswith(" - target"):
            states[:, j] += points[:, -1]
    # At the start of an episode there is no value after a step.
    values = np.stack([solution.expected(max(int(t), 1), states, targets) for t in times], axis=-1)
    shape = tuple(len(axis) for axis in axes)
    if len(times) > 1:
        axes.append(times * solution.task.dt)
        names.append("time")
        shape += (len(times),)
    policy: dict[str, Any] = {"architecture": "table", "kind": "value", "axes": names}
    policy |= {"actions": problem.actions} | ({"mirror": coarse.mirror} if coarse.mirror else {})
    arrays = {f"axis_{j}": axis for j, axis in enumerate(axes)}
    return policy, arrays | {"table": values.reshape(shape).astype(np.float32)}


def optimal(
    env_id: str, folder: Path, cache: Path | None = DEFAULT_FOLDER, solution: Solution | None = None
) -> Submission:
    """Write the optimal policy of an environment as a submission.

    Parameters
    ----------
    env_id : str
        One of `COARSE`.
    folder : Path
        Where to; must not exist.
    cache : Path, optional
        Where `agents.optimum` keeps values; what is not there is computed.
    solution : Solution, optional
        One at hand, instead.
    """
    problem = PROBLEMS[env_id]
    solution = solution or Solution(problem, problem.levels[-1], cache)
    policy, arrays = tabulate(solution, COARSE[env_id])
    sizes = " x ".join(map(str, solution.programs[0].grid.shape))
    return write(
        folder, env=env_id, name="optimal", authors=AUTHORS, license=LICENSE, policy=policy,
        arrays={0: arrays},
        description=f"value iteration on {sizes} nodes, coarsened to a table; greedy one step ahead",
    )  # fmt: skip


# --- all ----------------------------------------------------------------------------------------------------


def learned(env_id: str, runs: Path, folder: Path) -> Submission:
    """Write the finished runs of a learner, in a folder for each seed, as a submission."""
    algo = runs.name
    name = ALGORITHMS[algo][1] if algo in ALGORITHMS else algo
    made, off, count = export(
        find([runs]), folder, env=env_id, name=name, authors=AUTHORS, license=LICENSE,
        description="Stable-Baselines3, hyperparameters as `lag-envs hyperparams` prints them",
    )  # fmt: skip
    print(f"  acts as the models do: actions differ by {off:.1e} at most, over {count} observations of each")
    return made


def controller(env_id: str, name: str, folder: Path) -> Submission:
    """Write a built-in controller as a submission."""
    return write(
        folder, env=env_id, name=name, authors=AUTHORS, license=LICENSE,
        policy={"architecture": "controller", "name": name},
    )  # fmt: skip


def entrants(env_id: str, runs: Path, cache: Path) -> Iterator[tuple[str, Callable[[Path], Submission]]]:
    """Yield for all agents of an environment the name, and what writes its submission to a folder."""
    for name in CONTROLLERS[env_id]:
        yield name, partial(controller, env_id, name)
    if env_id in COARSE and (cache / env_id).is_dir():
        yield "optimal", partial(optimal, env_id, cache=cache)
    for folder in sorted(f for f in (runs / env_id).glob("*") if f.is_dir()):
        finished = len(list(folder.glob(f"seed*/{MODEL}")))
        if finished >= LEARNED_POLICIES:
            yield folder.name, partial(learned, env_id, folder)
        elif finished:
            print(f"{folder}: left out, it has {finished} finished runs, {LEARNED_POLICIES} are needed")


def slug(name: str) -> str:
    """Return a name as part of a folder's."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = argparse.ArgumentParser(
        prog="python -m agents.submit",
        description="Make leaderboard submissions of all our agents.",
        epilog=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("out", metavar="OUT", type=Path, help="where to")
    p.add_argument("--envs", nargs="+", metavar="ENV", help="environments (default: all)")
    p.add_argument("--runs", type=Path, default=Path("runs"), metavar="FOLDER", help="default runs/")
    p.add_argument(
        "--optimum", type=Path, default=DEFAULT_FOLDER, metavar="FOLDER", help="default %(default)s"
    )
    p.add_argument("--new", action="store_true", help="make anew what is there")
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where something could not be submitted, 2 for a mistake of the user's."""
    args = parser().parse_args(arguments)
    failed = 0
    try:
        envs = [check_env(name) for name in args.envs] if args.envs else list(TASKS)
        for env_id in dict.fromkeys(envs):
            for name, make in entrants(env_id, args.runs, args.optimum):
                folder = args.out / f"{env_id}-{slug(name)}"
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
    except (UserError, OSError) as error:
        print(f"agents.submit: error: {error}", file=sys.stderr)
        return 2
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
