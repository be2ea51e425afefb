"""``lag-envs hyperparams``."""

from __future__ import annotations

import argparse

from lag_envs import TASKS
from lag_envs.commands.base import Command
from lag_envs.errors import UserError, hint


def declare_hyperparams(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``hyperparams``."""
    parser.add_argument(
        "learner", metavar="LEARNER", help="ppo, sac, td3, tqc, dqn, fast_ppo, shac or cloning"
    )


def run_hyperparams(args: argparse.Namespace) -> int:
    """Print the hyperparameters of a learner."""
    from lag_envs.hyperparams import as_yaml, learners

    if args.learner not in learners():
        raise UserError(f"there is no learner {args.learner!r}; {hint(args.learner, learners())}")
    print(as_yaml(args.learner, {id: task() for id, task in TASKS.items()}), end="")
    return 0


HYPERPARAMS = Command(
    "hyperparams",
    "print hyperparameters for the RL Zoo",
    """Print the hyperparameters of a learner of Stable-Baselines3 for all environments, in the format of
the RL Zoo (extra `zoo`). The agents of docs/agents.md were trained with them. The
hyperparameters of fast_ppo, shac and cloning are for `python -m agents.train`, in a clone.

examples:
  lag-envs hyperparams ppo > ppo.yml
  python -m rl_zoo3.train --algo ppo --env PivotedBar-v0 --gym-packages lag_envs --conf-file ppo.yml -f logs
  python -m rl_zoo3.enjoy --algo ppo --env PivotedBar-v0 --gym-packages lag_envs -f logs
  python -m lag_envs.zoo record_video --algo ppo --env PivotedBar-v0 --gym-packages lag_envs -f logs""",
    declare_hyperparams,
    run_hyperparams,
)
