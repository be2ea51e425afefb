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
from lag_envs.leaderboard.protocol import REFERENCES, Reference
from lag_envs.leaderboard.ranking import corrected
from lag_envs.scores import KNOWN_RETURNS

#: Seeds of nobody else, of the references' mean by themselves; episodes that are played together, and those
#: of policies that take long.
FIRST_SEED, REFERENCE_SEED, BATCH, FEW = 4_000_000_000, 5_000_000_000, 65_536, 1_000
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
        reference = REFERENCES.get(env_id)
        show(env_id, "random", many(env_id, "random", args.batches), known.random)
        if reference is not None:
            returns = many(env_id, reference.controller, args.batches, REFERENCE_SEED)
            show(env_id, f"{reference.controller} (reference)", returns, reference.mean)
        if known.policy in SLOW and not args.quick:
            show(env_id, known.policy, few(env_id, known.policy, reference), known.best)
        elif known.policy not in SLOW:
            show(env_id, known.policy, many(env_id, known.policy, args.batches), known.best)
    return 0


def many(env_id: str, name: str, batches: int, first: int = FIRST_SEED) -> np.ndarray:
    """Return a quick controller's returns."""
    agent = make_controller(env_id, name)
    firsts = (first + k * BATCH for k in range(batches))
    return np.concatenate([evaluate_batch(env_id, agent, first, BATCH) for first in firsts])


def few(env_id: str, name: str, reference: Reference | None) -> np.ndarray:
    """Return a slow policy's returns, without its luck."""
    agent = Optimal(env_id) if name == "optimal" else make_controller(env_id, name)
    played = {"returns": evaluate_batch(env_id, agent, FIRST_SEED, FEW)}
    if reference is not None:
        quick = make_controller(env_id, reference.controller)
        played["reference"] = evaluate_batch(env_id, quick, FIRST_SEED, FEW)
    return corrected(reference, [played])[0]


def show(env_id: str, name: str, returns: np.ndarray, used: float | None) -> None:
    """Print a line."""
    error = returns.std() / math.sqrt(len(returns))
    print(f"{env_id:28} {name:20} {returns.mean():10.4f} ± {error:.4f}   in use: {used}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
