"""Measure the mean returns that `lag_envs.scores` and the leaderboard's `REFERENCES` are set to.

``python -m agents.scale`` prints, for each environment, what random actions, the reference and the best
policy known return, beside the numbers in use. A policy that takes long plays 1,000 episodes, less its luck
in them as far as the reference tells (`ranking.corrected`).
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

import numpy as np

from agents.evaluate import evaluate_batch
from agents.optimum import Optimal
from agents.run import UserError, check_env
from lag_envs import TASKS
from lag_envs.controllers import make_controller
from lag_envs.leaderboard.protocol import REFERENCES
from lag_envs.leaderboard.ranking import corrected
from lag_envs.scores import KNOWN_RETURNS

#: Seeds of nobody else; episodes that are played together, and of policies that take long.
FIRST_SEED, BATCH, FEW = 4_000_000_000, 65_536, 1_000
SLOW = ("iLQR", "optimal")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for an environment that does not exist."""
    p = argparse.ArgumentParser(prog="python -m agents.scale", description=__doc__)
    p.add_argument("env", nargs="*", metavar="ID", help="ids of environments (default: all)")
    p.add_argument("--batches", type=int, default=1, help=f"of {BATCH:,} episodes (default %(default)s)")
    p.add_argument("--quick", action="store_true", help="leave out policies that take long")
    args = p.parse_args(arguments)
    try:
        envs = [check_env(name) for name in args.env] or list(TASKS)
        if args.batches < 1:
            raise UserError(f"--batches must be at least 1, got {args.batches}")
    except UserError as error:
        print(f"agents.scale: error: {error}", file=sys.stderr)
        return 2
    for env_id in envs:
        known = KNOWN_RETURNS[env_id]
        reference, mean = REFERENCES.get(env_id, (None, None))[:2]
        show(env_id, "random", many(env_id, "random", args.batches), known.random)
        if reference is not None:
            show(env_id, reference, many(env_id, reference, args.batches), mean)
        if known.policy in SLOW and not args.quick:
            show(env_id, known.policy, few(env_id, known.policy, reference), known.best)
        elif known.policy not in (*SLOW, reference):
            show(env_id, known.policy, many(env_id, known.policy, args.batches), known.best)
    return 0


def many(env_id: str, name: str, batches: int) -> np.ndarray:
    """Return a quick controller's returns."""
    agent = make_controller(env_id, name)
    firsts = (FIRST_SEED + k * BATCH for k in range(batches))
    return np.concatenate([evaluate_batch(env_id, agent, first, BATCH) for first in firsts])


def few(env_id: str, name: str, reference: str | None) -> np.ndarray:
    """Return a slow policy's returns, without its luck."""
    agent = Optimal(env_id) if name == "optimal" else make_controller(env_id, name)
    played = {"returns": evaluate_batch(env_id, agent, FIRST_SEED, FEW)}
    if reference is not None:
        played["reference"] = evaluate_batch(env_id, make_controller(env_id, reference), FIRST_SEED, FEW)
    return corrected(REFERENCES.get(env_id), [played])[0]


def show(env_id: str, name: str, returns: np.ndarray, used: float | None) -> None:
    """Print a line."""
    error = returns.std() / math.sqrt(len(returns))
    print(f"{env_id:28} {name:20} {returns.mean():10.4f} ± {error:.4f}   in use: {used}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
