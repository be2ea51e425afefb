"""Train learners on environments, several seeds side by side, here or on a Ray cluster.

``python -m agents.train --help`` has the options.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import queue
import shlex
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import groupby, product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from agents.learners import EPISODES, LEARNERS, TESTS, check_trainable, suits, train_rest, zoo_hyperparameters
from agents.run import (
    CHECKPOINT,
    MODEL,
    NORMALISATION,
    RESULT,
    Run,
    UserError,
    check_numbers,
    known_name,
    own_env,
    reports_errors,
    source_digest,
    training_seeds,
)
from lag_envs import TASKS, workers
from lag_envs.evaluation.statistics import mean_and_error
from lag_envs.options import module_parser, new_folder
from lag_envs.own_files import is_file
from lag_envs.scores import known_returns, normalised, score
from lag_envs.store import write_file
from lag_envs.tables import aligned, mean_with_error
from lag_envs.workers import check_address, died

EPILOG = f"""files in FOLDER/ENV/ALGO/seed<K>:
  result.json          returns on 100 fresh episodes, score, learning curve, hyperparameters, versions, times
  model.zip            the policy; agents.learners.load_policy takes the folder, and the file is for `load` of
                       Stable-Baselines3, if it is one of its learners
  vecnormalize.pkl     statistics of the observations, if Stable-Baselines3 normalises them
  tensorboard/         for `tensorboard --logdir FOLDER`; only for Stable-Baselines3's learners
  {CHECKPOINT}       while the run is not finished: everything needed to resume; written {TESTS} times per run

Re-run a command that was interrupted, by Ctrl-C or by a kill, to resume it; finished seeds stay as they are.
A run resumes from its last checkpoint. The result of fast_ppo, shac and cloning is the same as without the
interruption; other learners see different episodes.
Policies of SAC, TD3, TQC and DQN get better and worse while they learn: the one that did best in a test, on
separate episodes, is kept. PPO keeps the last policy. Tests and results are of the environment with its own
parameters; a TimeLimit among the hyperparameters shortens only the episodes of training.

Hyperparameters are in the form of the RL Zoo, which takes them unchanged:
  lag-envs hyperparams ppo > ppo.yml
  python -m rl_zoo3.train --algo ppo --env PivotedBar-v0 --gym-packages lag_envs --conf-file ppo.yml -f logs

examples:
  python -m agents.train PivotedBar-v0                          one seed of PPO, in less than a minute
  python -m agents.train PivotedBar-v0 --seeds 10               ten seeds, as many at once as there are cores
  python -m agents.train PivotedBar-v0 --algo sac td3 --seeds 5
  python -m agents.train examples/ball_on_beam.py               a task of your own; this runs the file
  python -m agents.train all --algo ppo fast_ppo sac td3 tqc dqn --seeds 5   the runs behind docs/agents.md
  python -m agents.train PivotedBar-v0 --seeds 100 --ray auto   a hundred seeds, on a Ray cluster
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser(
        "agents.train", "Train a learner on an environment and evaluate it over fresh episodes.", EPILOG
    )
    p.add_argument(
        "env", nargs="+", metavar="ENV",
        help="ids, module:ID, or your own FILE or FILE:Class, whose code is run; "
        "all: the package's environments whose actions suit the learner",
    )  # fmt: skip
    p.add_argument(
        "--algo", nargs="+", default=["ppo"], metavar="ALGO", help=f"{', '.join(LEARNERS)} (default ppo)"
    )
    add_run_options(p)
    p.add_argument(
        "--jobs", type=int, metavar="N", help="seeds trained at once (default: the number of cores)"
    )
    p.add_argument(
        "--config", type=Path, metavar="FILE", help="other hyperparameters, a YAML file of the Zoo"
    )
    p.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="train on a Ray cluster: its address, auto for a running one, local for one on this machine",
    )
    return p


def add_run_options(p: argparse.ArgumentParser) -> None:
    """Add the options that this command shares with the commands of single learners."""
    p.add_argument("--seeds", type=int, default=1, metavar="N", help="number of seeds (default %(default)s)")
    p.add_argument("--first-seed", type=int, default=0, metavar="K", help="first seed (default %(default)s)")
    p.add_argument(
        "--steps", type=int,
        help="environment steps per seed, in place of n_timesteps; rounded up to whole updates",
    )  # fmt: skip
    p.add_argument(
        "--output",
        type=new_folder,
        default="runs",
        metavar="FOLDER",
        help="where to write (default %(default)s)",
    )
    p.add_argument("--new", action="store_true", help="start over, overwriting earlier runs of these seeds")


@reports_errors("agents.train")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where a seed failed, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    runs = planned_runs(args)
    parallel_map = (
        partial(on_ray, address=args.ray) if args.ray else partial(train_in_processes, jobs=args.jobs)
    )
    return train_all(runs, parallel_map, "agents.train", arguments)


def train_all(
    runs: Sequence[Run], parallel_map: Callable, module: str, arguments: Sequence[str] | None
) -> int:
    """Train the runs that are not finished, print all returns, and return the command's exit status."""
    todo = [run for run in runs if run.load_result() is None]
    for run in runs:
        if run not in todo:
            print(f"{run.name}: finished before")
    failed, stopped = show_progress(todo, parallel_map) if todo else ({}, False)
    print_returns([run for run in runs if run.name not in failed])
    return report_failures(failed, stopped, module, arguments)


def planned_runs(args: argparse.Namespace, changed: Mapping[str, Any] = MappingProxyType({})) -> list[Run]:
    """Return the requested runs, with some hyperparameters changed, or raise a UserError."""
    if "all" in args.env and len(args.env) > 1:
        raise UserError(f"all must stand alone, got {' '.join(args.env)}")
    given = list(TASKS) if args.env == ["all"] else list(dict.fromkeys(args.env))
    sources = {own_env(name): "" if name in TASKS else name for name in given}
    if args.ray and any(map(is_file, given)):
        raise UserError("--ray takes ids and module:ID, as a file does not exist on the other machines")
    algos = [known_name("algorithm", name, LEARNERS) for name in dict.fromkeys(args.algo)]
    check_numbers(args, seeds=1, first_seed=0, steps=1, jobs=1)
    digests = {env: source and source_digest(source, env) for env, source in sources.items()}
    runs = []
    for (env, source), algo in product(sources.items(), algos):
        if args.env == ["all"] and not suits(algo, TASKS[env]()):
            continue
        check_trainable(algo, env)
        hyper = {**zoo_hyperparameters(algo, env, args.config), **changed}
        try:
            steps = args.steps or int(float(hyper["n_timesteps"]))
        except (KeyError, ValueError, TypeError, OverflowError):
            steps = 0
        if steps < 1:
            raise UserError(f"n_timesteps must be a number of steps, got {hyper.get('n_timesteps')!r}")
        for seed in training_seeds(args.first_seed, args.seeds):
            folder = args.output / env / algo / f"seed{seed}"
            runs.append(Run(folder, env, algo, seed, steps, hyper, source, digests[env]))
    if args.ray:  # checked before anything is removed
        check_address(args.ray)
    for run in runs:
        if args.new:
            run.remove()
        run.load_result()
        run.load_checkpoint()
    return runs


# --- one seed, in a process or on another machine -----------------------------------------------------------


class Failure(NamedTuple):
    """A run's failure.

    Attributes
    ----------
    reason : str
        The message for the user.
    passing : bool
        Whether the same command may succeed later, as after a full disk.
    """

    reason: str
    passing: bool = False


def train_run(run: Run, tell: Callable[[tuple], None], ship: bool = False) -> Failure | None:
    """Train one run and report its progress; return why it failed, or None on success.

    Parameters
    ----------
    run : Run
        The run.
    tell : callable
        Called with ("steps", name, steps), ("tested", name, curve) or ("file", name, file, bytes).
    ship : bool
        Whether to send the files too, for a run whose folder is not shared.
    """
    last = 0.0

    def send(*files: str) -> None:
        for file in files:
            if ship and run.path(file).exists():
                tell(("file", run.name, file, run.path(file).read_bytes()))

    def show(run: Run) -> None:
        nonlocal last
        if time.monotonic() - last > 0.2:
            last = time.monotonic()
            tell(("steps", run.name, run.trained))

    def tested(run: Run) -> None:
        send(CHECKPOINT)
        tell(("tested", run.name, run.curve))

    try:
        if run.source:  # its environment may not be registered in this process yet
            own_env(run.source)
        train_rest(run, show=show, tested=tested)
        send(MODEL, NORMALISATION, RESULT)
    except UserError as error:
        return Failure(str(error))
    except OSError as error:
        kept = "; what was saved before is kept" if run.path(CHECKPOINT).exists() else ""
        return Failure(f"{error}{kept}", passing=True)
    except Exception:
        return Failure(traceback.format_exc())
    return None


#: The queue to the process that started this one.
_events: Any = None


def begin(events: Any) -> None:
    """Take the queue for `tell`; for the start of a process."""
    global _events
    _events = events


def tell(event: Any) -> None:
    """Send an event to the process that started this one."""
    _events.put(event)


def _here(run: Run) -> Failure | None:
    """Train the run that this process was started for."""
    return train_run(run, tell)


def _there(settings: dict[str, Any], checkpoint: bytes | None, events: Any) -> Failure | None:
    """Train a run on a machine that does not see the run's folder."""
    with tempfile.TemporaryDirectory() as folder:
        run = Run(**settings | {"folder": Path(folder)})
        if checkpoint is not None:
            write_file(run.path(CHECKPOINT), checkpoint)
        return train_run(run, events.put, ship=True)


@contextmanager
def train_in_processes(runs: Sequence[Run], jobs: int | None = None) -> Iterator[Callable]:
    """Train runs in processes; give a function that returns the next event, or None."""
    events = multiprocessing.get_context("spawn").Queue()
    with workers.processes(jobs or os.cpu_count() or 1, begin, events) as submit:
        yield partial(poll, events, {submit(_here, run): run for run in runs})


@contextmanager
def here(runs: Sequence[Run]) -> Iterator[Callable]:
    """Train runs in this process, one after the other; otherwise like `train_in_processes`."""
    events: queue.Queue = queue.Queue()
    stopped = threading.Event()

    def tell(event: tuple) -> None:
        if stopped.is_set():
            raise SystemExit
        events.put(event)

    with ThreadPoolExecutor(1) as pool:
        try:
            yield partial(poll, events, {pool.submit(train_run, run, tell): run for run in runs})
        finally:
            stopped.set()
            pool.shutdown(cancel_futures=True)


@contextmanager
def on_ray(runs: Sequence[Run], address: str) -> Iterator[Callable]:
    """Train runs on a Ray cluster; otherwise like `train_in_processes`."""
    with workers.cluster(address, [Path(__file__).parent]) as submit:
        from ray.util.queue import Queue

        events, futures = Queue(), {}
        for run in runs:
            file = run.path(CHECKPOINT)
            checkpoint = file.read_bytes() if file.exists() else None
            futures[submit(_there, vars(run) | {"folder": None}, checkpoint, events)] = run
        yield partial(poll, events, futures)


def poll(events: Any, futures: dict[Any, Run]) -> tuple | None:
    """Return the next event, or ("end", name, failure), or None; write the files that events bring."""
    ended = next((future for future in futures if future.done()), None)
    try:
        event = events.get(timeout=0.05 if ended else 0.2)
    except queue.Empty:
        if ended is None:
            return None
        run, error = futures.pop(ended), ended.exception()
        return "end", run.name, ended.result() if error is None else Failure(died(error), passing=True)
    if event[0] == "file":
        write_file(next(run for run in futures.values() if run.name == event[1]).path(event[2]), event[3])
        return None
    return event


# --- progress -----------------------------------------------------------------------------------------------


def show_progress(runs: Sequence[Run], parallel_map: Callable) -> tuple[dict[str, Failure], bool]:
    """Train the runs and show their progress; return the failures, and whether training was stopped."""
    from tqdm import tqdm

    failed: dict[str, Failure] = {}
    left = {run.name: run for run in runs}
    steps = {run.name: run.trained for run in runs}
    bar = tqdm(
        total=sum(run.steps for run in runs), unit=" steps", unit_scale=True, disable=None,
        dynamic_ncols=True, initial=sum(steps.values()),
    )  # fmt: skip
    try:
        with parallel_map(runs) as poll, bar:
            while left:
                event = poll()
                if event is None:
                    continue
                kind, name, what = event
                run = left[name]
                if kind == "steps":
                    steps[name] = min(what, run.steps)
                    bar.update(sum(steps.values()) - bar.n)
                elif kind == "tested":
                    run.curve = what
                    trained, seconds, mean = what[-1]
                    value = score(run.env, mean)
                    tail = "" if value is None else f", score {value:.2f}"
                    about = f"{trained:>9,} steps, {seconds:5.1f} s, return {mean:.2f}{tail}"
                    _say(bar, f"{run.name}: {about}")
                else:
                    del left[name]
                    if what:
                        failed[name] = what
                        continue
                    run.path(CHECKPOINT).unlink(missing_ok=True)
                    steps[name] = run.steps
                    result = run.load_result() or {}
                    mean, value = with_errors(run.env, result["evaluation"]["returns"])
                    _say(bar, f"{run.name}: finished, return {mean}" + f", score {value}" * bool(value))
    except KeyboardInterrupt:
        return failed, True
    return failed, False


def with_errors(env_id: str, returns: Sequence[float]) -> tuple[str, str]:
    """Return the mean return and its score, with standard errors over episodes; no score without a scale."""
    known, mean = known_returns(env_id), mean_with_error(*mean_and_error(returns), exact=2)
    if known is None:
        return mean, ""
    return mean, mean_with_error(*mean_and_error(normalised(known, returns)), exact=3)


def _say(bar: Any, line: str) -> None:
    """Print a line above the progress bar; a log has no bar."""
    bar.write(line)
    sys.stdout.flush()


def print_returns(runs: Sequence[Run]) -> None:
    """Print the runs' returns."""
    for (env, algo), some in groupby(runs, key=lambda run: (run.env, run.algo)):
        results = [(run, result) for run in some if (result := run.load_result()) is not None]
        if not results:
            continue
        print(f"\n{env}, {algo}, {EPISODES} fresh episodes each: mean ± standard error over episodes")
        rows = [("seed", "steps", "seconds", "return", "score")]
        for run, result in results:
            trained, seconds = result["trained"], result["wall_seconds"]
            both = with_errors(env, result["evaluation"]["returns"])
            rows.append((str(run.seed), f"{trained:,}", f"{seconds:.1f}", *both))
        print("\n".join(aligned(rows)))
        print(f"Written to {results[0][0].folder.parent}/")


def report_failures(
    failed: Mapping[str, Failure], stopped: bool, module: str, arguments: Sequence[str] | None
) -> int:
    """Print why runs failed, and how to resume if that may help; return the command's exit status."""
    for name, failure in failed.items():
        print(f"{name} failed: {failure.reason}", file=sys.stderr)
    if stopped or any(failure.passing for failure in failed.values()):
        print(f"To resume: {command(module, arguments)}")
    return 130 if stopped else 1 if failed else 0


def command(module: str, arguments: Sequence[str] | None) -> str:
    """Return the running command, without options that would start it over."""
    python = Path(sys.executable)
    if python.is_relative_to(Path.cwd()):
        python = python.relative_to(Path.cwd())
    given = [a for a in (sys.argv[1:] if arguments is None else arguments) if a != "--new"]
    return shlex.join([str(python), "-m", module, *given])


if __name__ == "__main__":
    sys.exit(main())
