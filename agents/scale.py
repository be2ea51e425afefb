"""Measure the mean returns that define scores and the leaderboard's references.

``python -m agents.scale`` plays, for each environment, random actions, no control, the best known policy, the
controllers that plan or were measured before, and the board's reference, and prints means and standard errors
beside the numbers in use. A slow policy plays only the first episodes. Its luck in them is corrected by the
difference between the reference's returns in these and in all episodes (a control variate). The reference's
own number comes from other, independent episodes. ``--output src/lag_envs/tasks/measured.json`` stores the
numbers. Numbers in use stay until their entry is deleted from the file; an environment without numbers gets
new ones. The best known policy of such an environment is the best among its controllers and learners. A
learner plays with its best seed; if that run is missing, the policy that ships with the package is played.
"""

from __future__ import annotations

import datetime
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learners import learner_label
from agents.measure import Entrant, learned_policy
from agents.results import ROOT, write_envs
from agents.run import RESULT, UserError, check_env, check_numbers, read_result, reports_errors
from agents.solution import GreedyPolicy, played
from lag_envs import TASKS
from lag_envs.controllers import build, controllers, make_controller
from lag_envs.evaluation.rollout import Rollout, play
from lag_envs.evaluation.statistics import mean_and_error, without_luck
from lag_envs.host import machine
from lag_envs.leaderboard.shipped import load, shipped
from lag_envs.options import module_parser, new_file
from lag_envs.tasks import resolve
from lag_envs.tasks.measured import measured_entry as of_package

Array = NDArray[np.float64]

#: Seeds that nothing else uses, seeds of the references' own means, and episodes that are played together.
FIRST_SEED, REFERENCE_SEED, BATCH = 4_000_000_000, 5_000_000_000, 65_536
#: Episodes of slow policies: those that plan, and those that look ahead by value iteration.
PLANNED, OPTIMAL = 1_000, 4_096


EPILOG = """examples:
  python -m agents.scale PivotedBar-v0 --quick     a quick look at one environment; writes nothing
  python -m agents.scale PivotedBar-v0 --output src/lag_envs/tasks/measured.json"""


@reports_errors("agents.scale")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for a user's mistake."""
    p = module_parser("agents.scale", __doc__, EPILOG)
    p.add_argument("env", nargs="*", metavar="ID", help="ids of environments (default: all)")
    p.add_argument("--batches", type=int, default=8, help="batches of episodes (default %(default)s)")
    p.add_argument(
        "--size", type=int, default=BATCH, metavar="N", help="episodes of a batch (default %(default)s)"
    )
    p.add_argument(
        "--planned",
        type=int,
        default=PLANNED,
        metavar="N",
        help="episodes of a policy that plans (default %(default)s)",
    )
    p.add_argument("--quick", action="store_true", help="leave out slow policies")
    p.add_argument(
        "--runs", type=Path, default=ROOT / "runs", metavar="FOLDER", help="learners' runs (default runs/)"
    )
    p.add_argument("--output", type=new_file, metavar="FILE", help="add the numbers to this JSON file")
    args = p.parse_args(arguments)
    envs = [check_env(name) for name in args.env] or list(TASKS)
    check_numbers(args, batches=1, planned=1)
    if not 1 <= args.size <= BATCH:
        raise UserError(f"--size must lie between 1 and {BATCH}, got {args.size}")
    kept: dict[str, Any] = {}
    if args.output and args.output.exists():
        try:
            kept = json.loads(args.output.read_text(encoding="utf-8"))["envs"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{args.output} cannot be read ({error!r}); remove it, or choose another --output"
            ) from error
    for env_id in envs:
        before = kept.get(env_id, of_package(env_id))
        kept[env_id] = measure_environment(
            env_id, args.batches, args.quick, before, args.size, args.planned, args.runs
        )
        if args.output:
            about = {"command": "python -m agents.scale", "date": datetime.date.today().isoformat()}
            seeds = {"first_seed": FIRST_SEED, "first_seed_of_references": REFERENCE_SEED}
            write_envs(args.output, about | {"machine": machine()} | seeds, kept)
    return 0


def measure_environment(
    env_id: str,
    batches: int,
    quick: bool,
    kept: dict[str, Any] | None = None,
    size: int = BATCH,
    planned: int = PLANNED,
    runs: Path = ROOT / "runs",
) -> dict[str, Any]:
    """Measure an environment's policies, and print a line for each.

    Parameters
    ----------
    env_id : str
        The environment.
    batches : int
        Number of batches of `size` episodes.
    quick : bool
        Whether to leave out slow policies.
    kept : dict, optional
        The environment's entry in `lag_envs.tasks.measured`.
    size : int
        Episodes of a batch, `BATCH` at most.
    planned : int
        Episodes of a policy that plans.
    runs : Path
        Folder of the learners' runs.

    Returns
    -------
    dict
        The updated entry: ``scale`` and ``reference`` unchanged, or from this measurement if they are
        missing; ``measured`` holds for each policy its ``mean``, standard ``error`` and number of
        ``episodes``. "reference" is the board's, "optimum", if it is known, the largest possible return, and
        "privileged" the reference of an open task.
    """
    kept, task = dict(kept or {}), TASKS[env_id]()
    scale, used = kept.get("scale"), kept.get("reference", {}).get("mean")
    known, learners = controllers(task), trained(env_id, runs)
    slow = {name: planned for name, found in known.items() if found.plans} | {"optimal": OPTIMAL}
    names = ["random", "zero", *([scale["policy"]] if scale else [])]
    if not scale or task.open:
        names += [*task.controllers, *learners]
    names += [name for name, found in known.items() if found.plans or name in kept.get("measured", {})]
    if not scale and env_id in played():
        names.append("optimal")
    found: dict[str, Any] = {}

    def show(name: str, mean: float, error: float, episodes: int, used: float | None = None) -> None:
        found[name] = {"mean": round(mean, 6), "error": round(error, 6), "episodes": episodes}
        tail = "" if used is None else f"   in use: {used}"
        print(f"{env_id:28} {name:20} {mean:10.4f} ± {error:.4f}{tail}", flush=True)

    def show_mean(name: str, returns: Array, used: float | None = None) -> None:
        show(name, *mean_and_error(returns), len(returns), used)

    best = shipped().get(env_id)  # played if runs are missing
    in_use = {"random": scale["random"], scale["policy"]: scale["best"]} if scale else {}
    for name in dict.fromkeys(names):
        if name not in {*known, *learners, "optimal"}:
            if best and name == best.name:
                show_mean(name, fast_returns(env_id, load(env_id), batches, size), in_use.get(name))
                continue
            print(f"{env_id:28} {name:20} is not in {runs}; its earlier measurements stay", flush=True)
            found[name] = kept["measured"][name]
        elif name not in slow:
            agent = learners[name].make() if name in learners else make_controller(env_id, name)
            show_mean(name, fast_returns(env_id, agent, batches, size), in_use.get(name))
        elif not quick:
            agent = GreedyPolicy(env_id) if name == "optimal" else build(task, name)
            returns = play(env_id, agent, range(FIRST_SEED, FIRST_SEED + slow[name]))
            same = None
            if task.reference:
                same = fast_returns(env_id, make_controller(env_id, task.reference), batches, size)
            show(name, *without_luck(returns, same), len(returns), in_use.get(name))
    if task.reference:
        reference = make_controller(env_id, task.reference)
        show_mean("reference", fast_returns(env_id, reference, batches, size, REFERENCE_SEED), used)
        kept.setdefault("reference", found["reference"])
    if task.optimum:
        largest = np.concatenate([optima(env_id, FIRST_SEED + k * BATCH, size) for k in range(batches)])
        show_mean("optimum", largest, (scale or {}).get("optimum"))
    if task.open:
        agent = make_controller(env_id, task.open.controller, **task.open.options)
        show_mean("privileged", fast_returns(env_id, agent, batches, size, **task.open.options))
    if not scale:
        first = max((name for name in names if name in found), key=lambda name: found[name]["mean"])
        if not found[first]["mean"] > found["random"]["mean"]:
            raise UserError(
                f"{env_id}: nothing is better than random actions, so there is no scale; train a learner "
                "first (python -m agents.train), or give the task a controller"
            )
        scale = {"random": found["random"]["mean"], "best": found[first]["mean"]}
        scale |= {"error": found[first]["error"], "policy": first}
        scale |= {"optimum": found["optimum"]["mean"]} if task.optimum else {}
    return {"scale": scale} | kept | {"measured": found}


def trained(env_id: str, runs: Path) -> dict[str, Entrant]:
    """Return for each learner, by its label, the seed with the best mean return at the end of training."""
    found: dict[str, Entrant] = {}
    best: dict[str, float] = {}
    for file in sorted(runs.glob(f"{env_id}/*/seed*/{RESULT}")):
        entrant, mean = learned_policy(env_id, file.parent), read_result(file)["mean_return"]
        name = learner_label(entrant.name)
        if mean > best.get(name, -np.inf):
            found[name], best[name] = entrant, mean
    return found


def fast_returns(
    env_id: str, agent: Any, batches: int, size: int, first: int = FIRST_SEED, **options: Any
) -> Array:
    """Return a fast policy's returns, in the environment with these keywords."""
    firsts = (first + k * BATCH for k in range(batches))
    return np.concatenate([play(env_id, agent, range(first, first + size), **options) for first in firsts])


def optima(env_id: str, first: int, size: int) -> Array:
    """Return the largest returns of a batch of episodes."""
    rollout = Rollout(env_id, None, range(first, first + size))
    return resolve(rollout.task.optimum.place)(rollout.task, *rollout.state.T)


if __name__ == "__main__":
    sys.exit(main())
