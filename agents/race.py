"""Learners side by side on one environment: their scores against the time that training takes.

``python -m agents.race --help`` has the options.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents import learners
from agents.analysis import LEVELS, first_reached
from agents.learners import LEARNERS, learner_label, zoo_hyperparameters
from agents.run import Run, UserError, check_env, known_name, reports_errors, terminable
from lag_envs import store, workers
from lag_envs.evaluation.statistics import median_time
from lag_envs.host import machine
from lag_envs.options import module_parser, new_file, new_picture
from lag_envs.scores import known_returns, score
from lag_envs.tables import aligned

ENV = "PivotedBar-v0"
#: Tests of a training, and episodes of each.
TESTS, EPISODES = 24, 100
EPILOG = f"""Each training runs in a process of its own on one core, one after the other: with one seed every
learner, then with the next. So whatever else the machine does disturbs all alike. There are two clocks. That
of training counts nothing else; tests on {EPISODES} episodes stop it, {TESTS} times. The other is that of the
whole process: imports, compiling, training, and one evaluation. Times on the processor do not count what
others do on it.

A level's time is that of the first test that reaches it; a training that never does counts as never. No
training is started again, and tests decide nothing.

examples:
  python -m agents.race                                            our PPO and Stable-Baselines3's, five seeds
  python -m agents.race --learners fast_ppo --seeds 20 --first-seed 100
  python -m agents.race PivotedBar-v0 --output race.jsonl --picture race.png
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser(
        "agents.race", "Train learners side by side, and report when each reaches which score.", EPILOG
    )
    p.add_argument("env", nargs="?", default=ENV, metavar="ENV", help="default %(default)s")
    p.add_argument(
        "--learners", nargs="+", default=["fast_ppo", "ppo"], metavar="NAME",
        help=f"of {', '.join(LEARNERS)} (default fast_ppo ppo)",
    )  # fmt: skip
    p.add_argument("--seeds", type=int, default=5, metavar="N", help="default %(default)s")
    p.add_argument("--first-seed", type=int, default=0, metavar="K", help="default %(default)s")
    p.add_argument("--steps", type=int, metavar="N", help="steps of each training (default: the task's own)")
    p.add_argument(
        "--output", type=new_file, metavar="FILE", help="keep each training as a line of JSON; resumes"
    )
    p.add_argument("--picture", type=new_picture, metavar="FILE", help="draw scores against seconds")
    return p


@reports_errors("agents.race")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    check_env(args.env)
    if known_returns(args.env) is None:
        raise UserError(f"{args.env} has no scale of scores yet; python -m agents.scale measures one")
    names = [known_name("learner", name, LEARNERS) for name in dict.fromkeys(args.learners)]
    for name, least in (("seeds", 1), ("first_seed", 0), ("steps", 1)):
        if (value := getattr(args, name)) is not None and value < least:
            raise UserError(f"--{name.replace('_', '-')} must be at least {least}, got {value}")
    before = list(store.rows(args.output)) if args.output else []
    rows: list[dict[str, Any]] = []
    print("  ".join(f"{name}: {value}" for name, value in machine().items()))
    try:
        with terminable():
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                for name in names:
                    hyper = zoo_hyperparameters(name, args.env)
                    settings = {
                        "env": args.env, "algo": name, "seed": seed,
                        "steps": args.steps or int(hyper["n_timesteps"]), "hyperparameters": hyper,
                    }  # fmt: skip
                    row = next((r for r in before if settings.items() <= r.items()), None)
                    if row is None:
                        row = settings | raced(settings)
                        if args.output:
                            store.append(args.output, row)
                    rows.append(row)
                    print(f"{learner_label(name)}, seed {seed}: {told(row)}", flush=True)
    except KeyboardInterrupt:
        return 130
    print("\n" + "\n".join(aligned(score_cells(rows))))
    if args.picture:
        draw_scores(rows, args.picture)
    return 0


def raced(settings: dict[str, Any]) -> dict[str, Any]:
    """Train in a new process; return the curve and both clocks."""
    started = time.perf_counter()
    with workers.processes(1) as submit:
        found = submit(train_seed, settings).result()
    return found | {"process_seconds": round(time.perf_counter() - started - found.pop("tests_seconds"), 3)}


def train_seed(settings: dict[str, Any]) -> dict[str, Any]:
    """Train one seed, and note each test: (steps, seconds, seconds on the processor, score)."""
    learners.TESTS, learners.TEST_EPISODES = TESTS, EPISODES
    curve: list[tuple[int, float, float, float]] = []
    started, trained = time.perf_counter(), 0.0

    def tested(run: Run) -> None:
        nonlocal trained
        trained = time.perf_counter() - started
        steps, seconds, mean = run.curve[-1]
        value = score(run.env, mean) or 0.0
        curve.append((steps, seconds, round(run.processor_seconds, 3), round(value, 4)))

    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder), **settings)
        learners.train_rest(run, show=lambda run: None, tested=tested)
        result = run.load_result() or {}
    return {
        "score": result["score"], "seconds": run.seconds, "processor_seconds": run.processor_seconds,
        "tests_seconds": trained - run.seconds, "curve": curve,
    }  # fmt: skip


def told(row: dict[str, Any]) -> str:
    """Return a one-line summary of a training."""
    when = ", ".join(
        f"{level:g} never"
        if (time := first_reached(row["curve"], level)) is None
        else f"{level:g} in {time:.1f} s"
        for level in LEVELS
    )
    return f"{when}; {row['score']:.3f} after {row['seconds']:.1f} s, process {row['process_seconds']:.1f} s"


def score_cells(rows: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Return the cells of the table: for each learner and level, how many seeds reached it, and when."""
    names = list(dict.fromkeys(row["algo"] for row in rows))
    last = f"of {learner_label(names[-1])}'s"
    cells: list[tuple[str, ...]] = [("", "level", "reached", "steps", "s", "s on the processor", last)]
    for level in LEVELS:
        slowest = _median([row for row in rows if row["algo"] == names[-1]], level, 2)
        for name in names:
            own = [row for row in rows if row["algo"] == name]
            count = sum(first_reached(row["curve"], level) is not None for row in own)
            steps, seconds, processor = (_median(own, level, clock) for clock in range(3))
            part = "" if processor is None or not slowest else f"{processor / slowest:.2f}"
            cells.append(
                (learner_label(name), f"{level:g}", f"{count} of {len(own)}", _text(steps, ",.0f"),
                 _text(seconds, ".2f"), _text(processor, ".2f"), part)
            )  # fmt: skip
    for name in names:
        own = [row for row in rows if row["algo"] == name]
        ends = np.array([row["score"] for row in own])
        whole = float(np.median([row["process_seconds"] for row in own]))
        spread = f"{ends.min():.3f} to {ends.max():.3f}"
        cells.append(
            (
                learner_label(name),
                "end",
                f"{np.median(ends):.4f}",
                spread,
                "whole process",
                f"{whole:.1f}",
                "",
            )
        )
    return cells


def _median(rows: Sequence[dict[str, Any]], level: float, clock: int) -> float | None:
    return median_time([first_reached(row["curve"], level, clock) for row in rows])


def _text(value: float | None, form: str) -> str:
    return "never" if value is None else format(value, form)


def draw_scores(rows: Sequence[dict[str, Any]], file: Path) -> None:
    """Draw scores against seconds of training."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    names = list(dict.fromkeys(row["algo"] for row in rows))
    for row in rows:
        _, seconds, _, scores = zip(*row["curve"], strict=True)
        first = row["seed"] == rows[0]["seed"]
        colour = f"C{names.index(row['algo'])}"
        axes.plot(
            seconds, scores, color=colour, alpha=0.7, label=learner_label(row["algo"]) if first else None
        )
    axes.set(xlabel="seconds of training, on one core", ylabel="score", ylim=(-0.05, 1.05))
    axes.set_title(rows[0]["env"])
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)


if __name__ == "__main__":
    sys.exit(main())
