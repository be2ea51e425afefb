"""Tune numbers of controllers and settings of our PPO, in episodes that no evaluation uses.

Trainings have seeds that no reported result has. Files without a ``first_seed`` are of earlier searches,
whose training seeds start at 0. Reported results have the same seeds, so choosing settings by these searches
may flatter the reported scores.

``python -m agents.tune --help`` has the options.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution

from agents import learners
from agents.learners import load_policy, zoo_hyperparameters
from agents.results import ROOT
from agents.run import (
    Run,
    UserError,
    check_env,
    check_numbers,
    check_writable,
    reports_errors,
    training_seeds,
)
from lag_envs import workers
from lag_envs.controllers import build
from lag_envs.errors import hint
from lag_envs.evaluation.rollout import play
from lag_envs.evaluation.statistics import rounded_data
from lag_envs.host import machine
from lag_envs.options import module_parser, new_file
from lag_envs.scores import score
from lag_envs.store import readable_json, write_file
from lag_envs.tables import aligned
from lag_envs.tasks import TASKS

#: Evaluation uses seeds from 1,000,000,000 on, learning curves use seeds from 2,000,000,000 on.
FIRST_TUNING_SEED = 3_000_000_000
#: The first seed of the trainings; reported results have lower ones.
FIRST_TRAINING_SEED = 500
LEARNER = "fast_ppo"
#: Values to try for each setting. In a random draw, a setting keeps its value with probability 1/2.
CHOICES: Mapping[str, Sequence[Any]] = {
    "learning_rate": (1e-3, 2e-3, 3e-3, 5e-3, 8e-3),
    "n_envs": (64, 128, 256),
    "n_steps": (32, 64, 128, 256),
    "n_epochs": (2, 3, 5, 8),
    "batch_size": (512, 1024, 2048),
    "gamma": (0.97, 0.98, 0.985, 0.99, 0.995, 0.998),
    "gae_lambda": (0.8, 0.9, 0.95, 0.98),
    "clip_range": (0.1, 0.2, 0.3),
    "ent_coef": (0.0, 1e-3, 3e-3, 1e-2),
    "max_grad_norm": (0.5, 1.0, 3.0),
    "reward_scale": (0.03, 0.1, 0.3, 1.0),
    "episode_share": (0.5, 1.0),
    "state_noise": (True, False),
    "noise_steps": (1, 2, 4, 8),
    "log_std_init": (-1.0, -0.5, 0.0, 0.5),
    "actor": ([32, 32], [64, 64]),
    "critic": ([64, 32], [64, 64], [128, 128]),
    "first_layer_scale": (1.0, 2.0, 3.0),
}
RESULTS = ROOT / "agents" / "results" / "tuning"
EPILOG = f"""By default the numbers of the environment's controllers are tuned by differential evolution,
and printed. The controllers' defaults were found in this way.

With --settings, settings of {LEARNER} are tried: first the task's own, then others drawn at random,
each with some training seeds, from {FIRST_TRAINING_SEED} on, which no reported result has (a file of an
earlier version keeps its own seeds). FILE stores every training, so that the command can be interrupted
and run again, also with more --settings or --seeds. Copy the best settings by hand into the task's
`hyperparameters`.

examples:
  python -m agents.tune PivotedBar-v0 --only "energy shaping + LQR"
  python -m agents.tune PivotedBar-v0 --settings 20 --steps 300000 --seeds 2 --jobs 2
"""


def tunable(env_id: str) -> dict[str, Mapping[str, tuple[float, float]]]:
    """Return the search ranges of the numbers that can be tuned, by controller."""
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


# --- settings of a learner ----------------------------------------------------------------------------------


def drawn_changes(number: int) -> dict[str, Any]:
    """Return the changes of a numbered setting; number 0 changes nothing."""
    rng = np.random.default_rng(number)
    changed = {}
    for name, values in CHOICES.items():
        keep, which = rng.random() < 0.5, int(rng.integers(len(values)))
        if number and not keep:
            changed[name] = values[which]
    return changed


def trial(
    folder: Path, env_id: str, changed: Mapping[str, Any], seed: int, steps: int, episodes: int
) -> dict[str, Any]:
    """Train one seed with changed settings, in a folder; return its final return and its time."""
    learners.TESTS, learners.EPISODES = 8, 1
    hyper = {**zoo_hyperparameters(LEARNER, env_id), **changed}
    run = Run(folder, env_id, LEARNER, seed, steps, hyper)
    learners.train_rest(run, show=lambda run: None, tested=lambda run: None)
    seeds = range(FIRST_TUNING_SEED, FIRST_TUNING_SEED + episodes)
    mean = float(play(env_id, load_policy(run.folder), seeds).mean())
    return {
        "seed": seed, "trained": run.trained, "return": mean, "score": score(env_id, mean),
        "seconds": run.seconds, "processor_seconds": run.processor_seconds,
        "curve": [[steps, mean] for steps, _, mean in run.curve],
    }  # fmt: skip


def search_settings(
    env_id: str, count: int, seeds: int, steps: int, episodes: int, jobs: int, file: Path
) -> tuple[dict[str, Any], int]:
    """Try untried settings, side by side; return everything tried so far, and how many trainings failed."""
    own = zoo_hyperparameters(LEARNER, env_id)
    about: dict[str, Any] = {"env": env_id, "learner": LEARNER, "steps": steps, "episodes": episodes}
    about["changed_from"] = own
    new = about | {"machine": machine(), "first_seed": FIRST_TRAINING_SEED, "settings": []}
    data = read(file, about) or new
    first = data.get("first_seed", 0)  # earlier searches did not store it
    for number in range(len(data["settings"]), count):
        changed = {name: value for name, value in drawn_changes(number).items() if own[name] != value}
        data["settings"].append({"number": number, "changed": changed, "runs": []})
    failed = 0
    # The folder belongs to this process, so it is removed even if another process is killed.
    with tempfile.TemporaryDirectory() as folder, workers.processes(jobs) as submit:
        futures = {}
        for setting in data["settings"][:count]:
            number, changed = setting["number"], setting["changed"]
            done = {run["seed"] for run in setting["runs"]}
            for seed in sorted(set(range(first, first + seeds)) - done):
                place = Path(folder, f"{number}-{seed}")
                futures[submit(trial, place, env_id, changed, seed, steps, episodes)] = setting, seed
        for (setting, seed), found in workers.as_they_finish(futures):
            if isinstance(found, BaseException):
                failed += 1
                how = f"failed: {workers.died(found)}"
            else:
                setting["runs"] = sorted([*setting["runs"], rounded_data(found)], key=lambda run: run["seed"])
                write_file(file, readable_json(data))
                shutil.rmtree(Path(folder, f"{setting['number']}-{seed}"), ignore_errors=True)
                how = f"return {found['return']:.2f} in {found['seconds']:.0f} s"
            print(f"setting {setting['number']}, seed {seed}: {how}", flush=True)
    return data, failed


def read(file: Path, about: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the results of an earlier search, or None; raise a UserError for another search's file."""
    if not file.exists():
        return None
    try:
        data = json.loads(file.read_text())
        different = [name for name, value in about.items() if data[name] != value]
        for s in data["settings"]:
            s["runs"] = [run for run in s["runs"] if "failed" not in run]  # earlier versions stored them
            s["number"], s["changed"], [(run["seed"], run["return"], run["trained"]) for run in s["runs"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{file} cannot be read ({error!r}); remove it, or choose another --output"
        ) from error
    if different:
        own = "other settings of the task"
        what = ", ".join(own if name == "changed_from" else f"{name} {data[name]!r}" for name in different)
        raise UserError(f"{file} belongs to a search with {what}; choose another --output")
    return data


def ranked_cells(data: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the cells of a table; the setting with the best mean return over its seeds comes first."""
    rows = []
    for setting in data["settings"]:
        returns = [run["return"] for run in setting["runs"]]
        if returns:
            rows.append((float(np.mean(returns)), min(returns), setting))
    cells: list[tuple[str, ...]] = [("setting", "mean return", "lowest", "score", "changed")]
    for mean, lowest, setting in sorted(rows, key=lambda row: -row[0]):
        value = score(data["env"], mean)
        changed = ", ".join(f"{name} {value}" for name, value in setting["changed"].items())
        tail = "" if value is None else f"{value:.3f}"
        cells.append((str(setting["number"]), f"{mean:.2f}", f"{lowest:.2f}", tail, changed or "nothing"))
    return cells


def pace(data: Mapping[str, Any]) -> float:
    """Return the median over all runs of the steps trained per second of processor time."""
    runs = [run for setting in data["settings"] for run in setting["runs"]]
    return float(np.median([run["trained"] / run["processor_seconds"] for run in runs]))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser(
        "agents.tune",
        "Tune numbers of controllers or settings of a learner, in episodes that no evaluation uses.",
        EPILOG,
    )
    p.add_argument("env", metavar="ENV", help="id of an environment")
    p.add_argument("--only", metavar="NAME", help="tune this controller only")
    p.add_argument("--episodes", type=int, help="episodes per trial (default 2000, with --settings 200)")
    p.add_argument("--generations", type=int, help="generations of differential evolution (default 15)")
    p.add_argument("--settings", type=int, metavar="N", help=f"try this many settings of {LEARNER} instead")
    p.add_argument("--steps", type=int, help="steps of each training (default: the task's own)")
    p.add_argument("--seeds", type=int, help="trainings with each setting (default 2)")
    p.add_argument("--jobs", type=int, help="trainings at once (default 1)")
    p.add_argument(
        "--output",
        type=new_file,
        metavar="FILE",
        help="where to write (default agents/results/tuning/ENV.json)",
    )
    return p


@reports_errors("agents.tune")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where a training failed, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    known = tunable(check_env(args.env))
    check_numbers(args, episodes=1, generations=1, settings=1, steps=1, seeds=1, jobs=1)
    training_seeds(FIRST_TRAINING_SEED, args.seeds or 2)
    other = ("only", "generations") if args.settings else ("steps", "seeds", "jobs", "output")
    if given := [name for name in other if getattr(args, name) is not None]:
        raise UserError(f"--{given[0]} has no effect {'with' if args.settings else 'without'} --settings")
    if args.settings:
        steps = args.steps or int(zoo_hyperparameters(LEARNER, args.env)["n_timesteps"])
        file = args.output or RESULTS / f"{args.env}.json"
        check_writable(file)
        try:
            counts = args.settings, args.seeds or 2, steps, args.episodes or 200, args.jobs or 1
            data, failed = search_settings(args.env, *counts, file)
        except KeyboardInterrupt:
            kept = " What was tried is kept; re-run the command to resume." if file.exists() else ""
            print(f"\nStopped.{kept}", file=sys.stderr)
            return 130
        if failed:
            print(f"{failed} of the trainings failed; re-run the command to try them again", file=sys.stderr)
        if not any(setting["runs"] for setting in data["settings"]):
            return 1
        print("\n" + "\n".join(aligned(ranked_cells(data))))
        hours = 5 * 5e6 / pace(data) / 3600.0
        print(
            f"{pace(data):,.0f} steps per second of processor time, {hours:.2f} h for five seeds of 5M steps"
        )
        print(f"Written to {file}")
        return 1 if failed else 0
    if args.only not in (None, *known):
        there = hint(args.only, known, "" if known else "there is nothing to tune")
        raise UserError(f"{args.only!r} has no numbers to tune; {there}")
    for name in known:
        if args.only in (None, name):
            numbers, mean = tune(args.env, name, args.episodes or 2000, args.generations or 15)
            print(f"{args.env}, {name}: {numbers}, return {mean:.3f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
