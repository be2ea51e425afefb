"""Find the few numbers of the controllers that are not derived, on seeds that no evaluation uses.

``python -m agents.tune ENV`` prints what it found for each controller of the environment; those
that are the controllers' defaults were found in this way.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence

from scipy.optimize import differential_evolution

from agents.run import UserError, check_env, reports_errors
from lag_envs.controllers import build
from lag_envs.errors import hint
from lag_envs.evaluation.rollout import play
from lag_envs.tasks import TASKS

#: Evaluation has seeds from 1,000,000,000 on, learning curves from 2,000,000,000 on.
FIRST_TUNING_SEED = 3_000_000_000


def tunable(env_id: str) -> dict[str, Mapping[str, tuple[float, float]]]:
    """Return what can be tuned: by controller between which values each number is looked for."""
    return {name: found.tune for name, found in TASKS[env_id].controllers.items() if found.tune}


def tune(env_id: str, name: str, episodes: int, generations: int) -> tuple[dict[str, float], float]:
    """Return the numbers that differential evolution finds best, and the mean return with them."""
    ranges, task = tunable(env_id)[name], TASKS[env_id]()

    def loss(values: Sequence[float]) -> float:
        agent = build(task, name, **dict(zip(ranges, values, strict=True)))
        return -float(play(env_id, agent, range(FIRST_TUNING_SEED, FIRST_TUNING_SEED + episodes)).mean())

    found = differential_evolution(
        loss, list(ranges.values()), maxiter=generations, popsize=12, seed=0, polish=False
    )
    return {n: float(f"{v:.3g}") for n, v in zip(ranges, found.x, strict=True)}, -float(found.fun)


@reports_errors("agents.tune")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for a user's mistake."""
    p = argparse.ArgumentParser(prog="python -m agents.tune", description=__doc__)
    p.add_argument("env", metavar="ENV", help="id of an environment")
    p.add_argument("--only", metavar="NAME", help="tune this controller only")
    p.add_argument("--episodes", type=int, default=2000, help="episodes per trial (default %(default)s)")
    p.add_argument("--generations", type=int, default=15, help="default %(default)s")
    args = p.parse_args(arguments)
    known = tunable(check_env(args.env))
    if args.only not in (None, *known):
        there = hint(args.only, known, "" if known else "there is nothing to tune")
        raise UserError(f"nothing of {args.only!r} can be tuned; {there}")
    for name in ("episodes", "generations"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name} must be at least 1, got {getattr(args, name)}")
    for name in known:
        if args.only in (None, name):
            numbers, mean = tune(args.env, name, args.episodes, args.generations)
            print(f"{args.env}, {name}: {numbers}, return {mean:.3f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
