"""Learners side by side on one environment: scores against the time that training takes.

``python -m agents.race --help`` has the options.
"""

from __future__ import annotations

import argparse
import io
import multiprocessing
import queue
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from agents import learners, train
from agents.analysis import LEVELS, first_reached
from agents.learners import LEARNERS, check_suits, learner_label, zoo_hyperparameters
from agents.run import (
    Run,
    UserError,
    check_env,
    check_numbers,
    check_writable,
    known_name,
    reports_errors,
    training_seeds,
)
from lag_envs import store, workers
from lag_envs.evaluation.statistics import median_time
from lag_envs.host import machine
from lag_envs.options import module_parser, new_file, new_picture
from lag_envs.scores import known_returns, score
from lag_envs.tables import aligned

ENV = "PivotedBar-v0"
#: Tests of a training, and episodes of each.
TESTS, EPISODES = 24, 100
#: Heights of a small curve's characters, for scores from 0 to 1, and how many characters it has.
HEIGHTS, WIDTH = "▁▂▃▄▅▆▇█", 16
EPILOG = f"""Trainings run one after the other, each in its own process on one core: every learner with one
seed, then every learner with the next, so that other load disturbs all learners alike. There are
two clocks. One counts only training; it stops during the {TESTS} tests on {EPISODES} episodes. The other
counts the whole process: imports, compiling, training, and one evaluation. Processor time leaves out what
other programs do.

On a terminal a table shows each training while it runs. A training that fails is named, and does not count.

The time to a score is the time of the first test that reaches it, or infinite if no test does.
The last rows of the table have the median and the range of the scores in the evaluation at the end.
A training that has ended is not started again. Tests do not influence training.

examples:
  python -m agents.race                                            our PPO and Stable-Baselines3's, five seeds
  python -m agents.race --learners fast_ppo --seeds 20 --first-seed 100
  python -m agents.race PivotedBar-v0 --output race.jsonl --picture race.png
"""


class Row(BaseModel):
    """What the table and the picture need of a training stored in a file."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    #: Steps, seconds, seconds on the processor and score of each test.
    curve: list[Annotated[list[float], Field(min_length=4, max_length=4)]] = Field(min_length=1)
    score: float
    seconds: float
    process_seconds: float


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser(
        "agents.race", "Train learners side by side, and report when each reaches which score.", EPILOG
    )
    p.add_argument(
        "env", nargs="?", default=ENV, metavar="ENV",
        help="an id of the package, as scores need a scale (default %(default)s)",
    )  # fmt: skip
    p.add_argument(
        "--learners", nargs="+", default=["fast_ppo", "ppo"], metavar="NAME",
        help=f"of {', '.join(LEARNERS)} (default fast_ppo ppo)",
    )  # fmt: skip
    p.add_argument("--seeds", type=int, default=5, metavar="N", help="number of seeds (default %(default)s)")
    p.add_argument("--first-seed", type=int, default=0, metavar="K", help="first seed (default %(default)s)")
    p.add_argument("--steps", type=int, metavar="N", help="steps of each training (default: the task's own)")
    p.add_argument("--output", type=new_file, metavar="FILE", help="keep trainings as lines of JSON; resumes")
    p.add_argument("--picture", type=new_picture, metavar="FILE", help="draw scores against time and steps")
    return p


@reports_errors("agents.race")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where a training failed, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    check_env(args.env)
    if known_returns(args.env) is None:
        raise UserError(f"{args.env} has no scale of scores yet; python -m agents.scale measures one")
    names = [known_name("learner", name, LEARNERS) for name in dict.fromkeys(args.learners)]
    for name in names:
        check_suits(name, args.env)
    check_numbers(args, seeds=1, first_seed=0, steps=1)
    seeds = training_seeds(args.first_seed, args.seeds)
    files = [file for file in (args.output, args.picture) if file]
    if len({file.resolve() for file in files}) < len(files):
        raise UserError(f"--output and --picture are both {args.picture}; give each its own file")
    for file in files:
        check_writable(file)
    before = earlier_rows(args.output) if args.output else []
    print("  ".join(f"{name}: {value}" for name, value in machine().items()), flush=True)
    rows: list[dict[str, Any]] = []
    try:
        with live_view() as show:
            for settings in trainings(args, names, seeds):
                row = next((row for row in before if settings.items() <= row.items()), None)
                if row is None:
                    row = raced(settings, lambda now: show([*rows, now]))
                    if args.output and "failed" not in row:
                        store.append(args.output, row)
                rows.append(row)
                show(rows)
                print(f"{learner_label(row['algo'])}, seed {row['seed']}: {told(row)}", flush=True)
    except KeyboardInterrupt:
        some = args.output and any("failed" not in row for row in rows)
        kept = " What was finished is kept; re-run the command to resume." if some else ""
        print(f"\nStopped.{kept}", file=sys.stderr)
        return 130
    finally:
        done = [row for row in rows if "failed" not in row]
        print("".join(f"\n{line}" for line in table_lines(done)), flush=True)
    if args.picture and done:
        draw_scores(done, args.picture)
    return 0 if len(done) == len(rows) else 1


def trainings(args: argparse.Namespace, names: Sequence[str], seeds: range) -> Iterator[dict[str, Any]]:
    """Yield the settings of each training."""
    for seed in seeds:
        for name in names:
            hyper = zoo_hyperparameters(name, args.env)
            steps = args.steps or int(hyper["n_timesteps"])
            yield {"env": args.env, "algo": name, "seed": seed, "steps": steps, "hyperparameters": hyper}


def earlier_rows(file: Path) -> list[dict[str, Any]]:
    """Return the trainings that a file holds, or raise a UserError if it is of another race.

    Lines that are not rows, such as one that was cut off, are named and left out.
    """
    found = list(store.rows(file))
    refuse = f"{file} is not a file of a race ({{}}); choose another --output, or remove it"
    if not found and file.exists() and file.read_bytes().strip():
        raise UserError(refuse.format("no line of it is JSON"))
    for number, row in enumerate(found, 1):
        try:
            Row.model_validate(row)
        except ValidationError as error:
            first = error.errors()[0]
            what = " ".join(map(str, (*first["loc"], first["msg"])))
            raise UserError(refuse.format(f"row {number}: {what}")) from error
    lines = sum(bool(line.strip()) for line in file.read_bytes().splitlines()) if file.exists() else 0
    if left := lines - len(found):
        what = "1 line that is not JSON was" if left == 1 else f"{left} lines that are not JSON were"
        print(f"{file}: {what} left out; a row that was cut off is trained again", file=sys.stderr)
    return found


# --- one training -------------------------------------------------------------------------------------------


def raced(settings: dict[str, Any], show: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Train in a new process, and show its progress; return the curve and both clocks, or why it failed."""
    started = time.perf_counter()
    now = settings | {"trained": 0, "seconds": 0.0, "curve": []}
    show(now)
    events = multiprocessing.get_context("spawn").Queue()
    # The folder belongs to this process, so it is removed even if the other process is killed.
    with tempfile.TemporaryDirectory() as folder, workers.processes(1, train.begin, events) as submit:
        future = submit(train_seed, settings, Path(folder))
        while not future.done():
            with suppress(queue.Empty):
                now = settings | events.get(timeout=0.02)
                show(now)
        error = future.exception()
    if error is not None:
        return now | {"failed": str(error) if isinstance(error, UserError) else workers.died(error)}
    found = future.result()
    whole = time.perf_counter() - started - found.pop("tests_seconds")
    return settings | found | {"process_seconds": round(whole, 3)}


def train_seed(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Train one seed, and note each test: (steps, seconds, seconds on the processor, score)."""
    learners.TESTS, learners.TEST_EPISODES = TESTS, EPISODES
    curve: list[tuple[int, float, float, float]] = []
    started, trained, last = time.perf_counter(), 0.0, 0.0

    def show(run: Run) -> None:
        nonlocal last
        if time.monotonic() - last > 0.2:
            last = time.monotonic()
            train.tell({"trained": run.trained, "seconds": run.seconds, "curve": list(curve)})

    def tested(run: Run) -> None:
        nonlocal trained
        trained = time.perf_counter() - started
        steps, seconds, mean = run.curve[-1]
        value = score(run.env, mean) or 0.0
        curve.append((steps, seconds, round(run.processor_seconds, 3), round(value, 4)))
        show(run)

    run = Run(folder, **settings)
    learners.train_rest(run, show=show, tested=tested)
    result = run.load_result() or {}
    return {
        "score": result["score"], "seconds": run.seconds, "processor_seconds": run.processor_seconds,
        "tests_seconds": trained - run.seconds, "curve": curve,
        "machine": result["machine"], "versions": result["versions"],
    }  # fmt: skip


# --- what is shown ------------------------------------------------------------------------------------------


@contextmanager
def live_view() -> Iterator[Callable[[Sequence[dict[str, Any]]], None]]:
    """Show a table of trainings below what is printed; no table is shown in a pipe."""
    if not sys.stdout.isatty():
        yield lambda rows: None
        return
    from rich.live import Live

    with Live(auto_refresh=False) as live:
        # Only the last ones, as the table must fit on the screen.
        yield lambda rows: live.update(live_table(rows[3 - live.console.height :]), refresh=True)


def live_table(rows: Sequence[dict[str, Any]]) -> Any:
    """Return a table of trainings, with their scores over seconds and steps, on common axes."""
    from rich.table import Column, Table

    points = [point for row in rows for point in row["curve"]]
    steps, seconds = (max((point[clock] for point in points), default=0) for clock in (0, 1))
    numbers = [Column(name, justify="right", no_wrap=True) for name in ("seed", "steps", "s", "score")]
    curves = [Column(name, no_wrap=True) for name in (f"to {seconds:.1f} s", f"to {steps:,} steps")]
    table = Table("", *numbers, *curves, box=None, pad_edge=False)
    for row in rows:
        curve, running = row["curve"], "trained" in row
        trained = row["trained"] if running else curve[-1][0]
        value = row.get("score", curve[-1][-1] if curve else None)
        table.add_row(
            learner_label(row["algo"]), str(row["seed"]), f"{trained:,}", f"{row['seconds']:.1f}",
            "failed" if "failed" in row else "" if value is None else f"{value:.3f}",
            small_curve(curve, 1, seconds), small_curve(curve, 0, steps),
            style="bold" if running and "failed" not in row else "",
        )  # fmt: skip
    return table


def small_curve(curve: Sequence[Sequence[float]], clock: int, end: float) -> str:
    """Draw scores from 0 to 1 in a line, over steps (clock 0) or seconds (1) from 0 to an end.

    Examples
    --------
    >>> small_curve([(0, 0.0, 0.0, 0.0), (50, 1.0, 1.0, 0.5), (100, 2.0, 2.0, 1.0)], 0, 200)
    '▁▁▁▄▄▄▄█'
    """
    if not curve or not end:
        return ""
    times = np.array([point[clock] for point in curve])
    ticks = end * np.arange(1, WIDTH + 1) / WIDTH
    before = np.searchsorted(times, ticks[ticks <= times[-1]], side="right") - 1
    return "".join(HEIGHTS[int(7.99 * min(max(curve[k][-1], 0.0), 1.0))] for k in before)


def told(row: dict[str, Any]) -> str:
    """Return a one-line summary of a training."""
    if "failed" in row:
        return f"failed: {row['failed']}"
    when = ", ".join(
        f"{level:g} never"
        if (time := first_reached(row["curve"], level)) is None
        else f"{level:g} in {time:.1f} s"
        for level in LEVELS
    )
    times = f"trained for {row['seconds']:.1f} s, process {row['process_seconds']:.1f} s"
    return f"{when}; {times}; evaluation at the end: {row['score']:.3f}"


def table_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the lines of the table, with a warning if it mixes machines; no lines without trainings."""
    places = sorted({row.get("machine", "an unknown machine") for row in rows})
    mixed = [f"Times are from several machines: {'; '.join(places)}"] if len(places) > 1 else []
    return aligned(score_cells(rows)) + mixed if rows else []


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
                "evaluation",
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
    """Draw scores against seconds of training, and against steps."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    names = list(dict.fromkeys(row["algo"] for row in rows))
    axes = figure.subplots(1, 2, sharey=True)
    for clock, ax, label in ((1, axes[0], "seconds of training, on one core"), (0, axes[1], "steps")):
        for number, name in enumerate(names):
            for curve in (row["curve"] for row in rows if row["algo"] == name):
                times = [point[clock] for point in curve]
                ax.plot(times, [point[-1] for point in curve], color=f"C{number}", alpha=0.7)
            ax.plot([], [], color=f"C{number}", label=learner_label(name))
        ax.set_xlabel(label)
        ax.grid(alpha=0.3)
    axes[0].set(ylabel="score", ylim=(-0.05, 1.05))
    axes[0].legend(loc="best")
    axes[1].xaxis.set_major_formatter(EngFormatter(sep=""))
    figure.suptitle(rows[0]["env"])
    drawn = io.BytesIO()
    figure.savefig(drawn, format=file.suffix.lower()[1:], dpi=120)
    store.write_file(file, drawn.getvalue())


if __name__ == "__main__":
    sys.exit(main())
