"""Train a learner on an environment, compare it with controllers, and leave model, learning curve and video.

``python -m agents.demo --help`` has the options. The training is that of `agents.train`.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.learners import LEARNERS, check_trainable, learner_label, load_policy, zoo_hyperparameters
from agents.run import (
    RESULT,
    Run,
    UserError,
    check_numbers,
    fresh_seeds,
    known_name,
    own_env,
    reports_errors,
    source_digest,
    training_seeds,
)
from agents.train import here, report_failures, show_progress, with_errors
from lag_envs.evaluation.rollout import play
from lag_envs.options import module_parser, new_folder
from lag_envs.scores import known_returns, score
from lag_envs.store import write_file
from lag_envs.tables import aligned
from lag_envs.tasks.registration import make_task
from lag_envs.watch import watch

EPISODES = 20
EPILOG = """files in the output folder:
  model.zip            the policy; agents.learners.load_policy takes the folder
  vecnormalize.pkl     statistics of the observations, if Stable-Baselines3 normalises them
  learning_curve.png   returns during training, with those of the controllers and the random policy
  episode.mp4          one fresh episode of the trained policy
  comparison.json      returns and scores of all agents on the same fresh episodes
  result.json          the training: returns, learning curve, hyperparameters, versions and times
  tensorboard/         for `tensorboard --logdir FOLDER`; only for learners of Stable-Baselines3

Re-run an interrupted command to resume it; a finished run is only evaluated again.

examples:
  python -m agents.demo                                  train on PivotedBar-v0, in seconds
  python -m agents.demo --algo ppo --output runs/sb3     the same with Stable-Baselines3, in about a minute
  python -m agents.demo --new --seed 7                   again, with other random numbers
  python -m agents.demo --env ball_on_beam.py --output runs/ball"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser(
        "agents.demo",
        "Train a learner on an environment and compare it with other agents over 20 fresh episodes.",
        EPILOG,
    )
    p.add_argument(
        "--env", default="PivotedBar-v0", metavar="ENV",
        help="id, module:ID or FILE; code in it is run (default %(default)s)",
    )  # fmt: skip
    p.add_argument("--algo", default="fast_ppo", help=f"{', '.join(LEARNERS)} (default %(default)s)")
    p.add_argument("--seed", type=int, default=0, help="seed of training (default %(default)s)")
    p.add_argument("--steps", type=int, help="environment steps to train for, in total")
    p.add_argument(
        "--output",
        type=new_folder,
        default="runs/demo",
        metavar="FOLDER",
        help="where to write (default %(default)s)",
    )
    p.add_argument("--new", action="store_true", help="start over, overwriting the run in the output folder")
    p.add_argument("--no-video", action="store_true", help="make no video")
    return p


@reports_errors("agents.demo")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where training failed, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    run = open_run(args)
    finished = run.load_result()
    done = "finished before" if finished else f"{run.trained:,} of {run.steps:,} steps trained"
    print(f"{run.env}, {run.algo}, seed {run.seed}: {done}")
    if not finished:
        print("Loading PyTorch and compiling the environment (kept for the next time) ...", flush=True)
        failed, stopped = show_progress([run], here)
        if stopped or failed:
            return report_failures(failed, stopped, "agents.demo", arguments)
    report(run, video=not args.no_video)
    return 0


def open_run(args: argparse.Namespace) -> Run:
    """Return the run that the arguments ask for, or raise a UserError."""
    env = own_env(args.env)
    known_name("algorithm", args.algo, LEARNERS)
    check_numbers(args, seed=0, steps=1)
    training_seeds(args.seed, 1)
    check_trainable(args.algo, env)
    hyper = zoo_hyperparameters(args.algo, env)
    steps = args.steps or int(hyper["n_timesteps"])
    source = "" if env == args.env else args.env
    digest = source and source_digest(source, env)
    run = Run(args.output, env, args.algo, args.seed, steps, hyper, source, digest)
    if args.new:
        run.remove()
    elif run.load_result() is None and run.load_checkpoint() is None and run.foreign():
        raise UserError(
            f"{args.output} holds files but no run; choose another --output, or add --new to use this folder"
        )
    return run


def report(run: Run, video: bool) -> None:
    """Compare the policy with other agents; write results, picture and video, print a table."""
    from lag_envs.controllers import build, controllers

    policy = load_policy(run.folder)
    result = json.loads(run.path(RESULT).read_text())
    learner = learner_label(run.algo)
    seeds = fresh_seeds(EPISODES)
    started = time.perf_counter()
    task = make_task(run.env)
    quick = [name for name, found in controllers(task).items() if not found.plans]
    agents = {learner: policy} | {name: build(task, name) for name in quick}
    returns = {name: play(run.env, agent, seeds) for name, agent in agents.items()}
    seconds = time.perf_counter() - started
    comparison = {
        "env": run.env,
        "evaluation_seeds": list(seeds),
        "agents": {
            name: {"score": score(run.env, r.mean()), "mean_return": r.mean(), "returns": r.tolist()}
            for name, r in returns.items()
        },
    }
    write_file(run.path("comparison.json"), json.dumps(comparison, indent=1) + "\n")

    print(f"\nReturns over {EPISODES} fresh episodes of {run.env}, with standard errors over episodes")
    rows = [("", "mean ± error", "lowest", "highest", "score ± error")]
    for name, r in sorted(returns.items(), key=lambda item: -item[1].mean()):
        mean, value = with_errors(run.env, r)
        rows.append((name, mean, f"{r.min():.2f}", f"{r.max():.2f}", value))
    print("\n".join(aligned(rows)))
    if known := known_returns(run.env):
        ends = f"0 for the random policy ({known.random:g}), 1 for the best known ({known.best:g})"
        print(f"The score is {ends}.")
    print(
        f"\n{result['trained']:,} steps in {result['wall_seconds']:.1f} s of training, "
        f"{seconds:.1f} s of evaluation.",
        flush=True,
    )
    draw_curve(run, learner, result, returns)
    if video:
        watch(run.env, policy, seed=seeds[0], video=run.path("episode.mp4"))
    print(f"In {run.folder}: " + ", ".join(sorted(p.name for p in run.folder.iterdir())))


def draw_curve(run: Run, learner: str, result: dict[str, Any], returns: dict[str, np.ndarray]) -> None:
    """Draw the returns over the steps of training, together with the other agents' means."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    steps, _, means = zip(*result["curve"], strict=True)
    trained = result["trained"]
    axes.plot(steps, means, color="tab:blue", label=f"{learner} while training")
    axes.plot(trained, returns[learner].mean(), "o", color="tab:blue", clip_on=False, label="trained")
    others = sorted((r.mean(), name) for name, r in returns.items() if name != learner)
    for number, (mean, name) in enumerate(reversed(others)):
        axes.axhline(mean, color=f"C{number + 1}", linestyle=":", label=f"{name} ({mean:.1f})")
    if known := known_returns(run.env):
        label = f"best known ({known.best:g})"
        axes.axhline(known.best, color="black", linestyle="--", linewidth=1.0, label=label)
    axes.set(xlabel="environment steps", ylabel="return of an episode", xlim=(0, trained), title=run.env)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    pace = result["wall_seconds"] / trained
    time_axis = axes.secondary_xaxis("top", functions=(lambda x: x * pace, lambda x: x / max(pace, 1e-12)))
    time_axis.set_xlabel("seconds of training")
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=120)
    write_file(run.path("learning_curve.png"), drawn.getvalue())


if __name__ == "__main__":
    sys.exit(main())
