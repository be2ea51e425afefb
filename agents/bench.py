"""The adapter's speed-up over Stable-Baselines3's own `DummyVecEnv`: in stepping alone, and in training.

``python -m agents.bench`` measures both in turn, on one core, and prints medians and ratios.
"""

from __future__ import annotations

import argparse
import datetime
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from agents.report import rate_cells
from agents.run import check_numbers, reports_errors
from lag_envs.benchmark.actions import random_actions
from lag_envs.benchmark.environments import batch
from lag_envs.benchmark.results import quartiles, ratios
from lag_envs.benchmark.rounds import Contestant, Run, measure_rates
from lag_envs.evaluation.statistics import rounded_data
from lag_envs.host import ONE_THREAD, machine
from lag_envs.options import module_parser, new_file
from lag_envs.store import readable_json, write_file
from lag_envs.tables import aligned

ENV = "PivotedBar-v0"
SIZES = (1, 16, 64, 256)
TRAINED = 64  #: environments of the learner


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser(
        "agents.bench",
        f"Compare our vector environment for Stable-Baselines3 with DummyVecEnv, on {ENV}.",
        "examples:\n  python -m agents.bench\n  python -m agents.bench --output adapter.json",
    )
    p.add_argument("--rounds", type=int, default=15, help="samples per measurement (default %(default)s)")
    p.add_argument("--output", type=new_file, metavar="FILE", help="keep all samples as JSON")
    return p


@reports_errors("agents.bench")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    args = parser().parse_args(arguments)
    check_numbers(args, rounds=1)
    os.environ.update(ONE_THREAD)
    kinds = {"adapter": make_adapter, "DummyVecEnv": dummy}
    steps = [
        Contestant(k, ENV, "step", n, partial(prepared_steps, f, n)) for n in SIZES for k, f in kinds.items()
    ]
    learn = [Contestant(k, ENV, "PPO", TRAINED, partial(training, f)) for k, f in kinds.items()]
    # However short a sample is requested, a sample of training has at least one roll-out with its updates.
    complete = measure_rates(steps, args.rounds, 0.1) and measure_rates(learn, args.rounds, 0.1)
    rows = [
        rates_and_ratio(adapter, dummy) for adapter, dummy in zip(*[iter(steps + learn)] * 2, strict=True)
    ]
    head = ("", "environments", "adapter", "DummyVecEnv", "ratio")
    print("\n".join(aligned([head, *map(rate_cells, rows)])))
    if args.output:
        about = {"date": datetime.date.today().isoformat(), "machine": machine(), "rounds": args.rounds}
        write_file(args.output, readable_json(about | {"env": ENV, "rows": rounded_data(rows)}))
    return 0 if complete and not any(row["problem"] for row in rows) else 1


def make_adapter(n: int) -> Any:
    """Make our vector environment."""
    from lag_envs.sb3 import make_vec_env

    return make_vec_env(ENV, n)


def dummy(n: int) -> Any:
    """Make Stable-Baselines3's vector environment over single environments."""
    import gymnasium as gym
    from stable_baselines3.common.vec_env import DummyVecEnv

    import lag_envs  # noqa: F401  (registers the environments)

    return DummyVecEnv([lambda: gym.make(ENV)] * n)


def prepared_steps(make: Any, n: int) -> Run:
    """Prepare steps with actions made beforehand."""
    envs = make(n)
    envs.reset()
    return batch(envs.step, random_actions(n))


def training(make: Any) -> Run:
    """Prepare PPO with the hyperparameters that `agents.train` uses."""
    from agents.learners import make_model, zoo_hyperparameters
    from agents.run import Run as TrainingRun

    hyper = zoo_hyperparameters("ppo", ENV)
    folder = Path(tempfile.gettempdir())
    model = make_model(TrainingRun(folder, ENV, "ppo", 0, 1, hyper), make(TRAINED))
    model.tensorboard_log = None

    def run(steps: int) -> int:
        rollouts = -(-steps // model.n_steps)
        model.learn(rollouts * model.n_steps * TRAINED, reset_num_timesteps=False)
        return rollouts * model.n_steps

    return run


def rates_and_ratio(adapter: Contestant, dummy: Contestant) -> dict[str, Any]:
    """Return both rates [steps/s] and their ratio: lower quartile, median and upper quartile."""
    row: dict[str, Any] = {
        "kind": adapter.kind, "num_envs": adapter.num_envs, "problem": adapter.problem or dummy.problem,
        "adapter": adapter.rates, "dummy": dummy.rates,
    }  # fmt: skip
    pairs = ratios(adapter.rates, dummy.rates)
    return row | ({"ratio": quartiles(pairs)} if pairs else {})


if __name__ == "__main__":
    sys.exit(main())
