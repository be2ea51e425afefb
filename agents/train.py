"""Train learners on environments, several seeds side by side, here or on a Ray cluster.

``python -m agents.train --help`` tells more.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import queue
import shlex
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import groupby, product
from pathlib import Path
from typing import Any

from agents.learners import ALGORITHMS, EPISODES, TESTS, hyperparameters, train
from agents.run import CHECKPOINT, MODEL, NORMALISATION, RESULT, Run, UserError, check_name, own_env
from lag_envs import TASKS
from lag_envs.leaderboard.spread import SpreadError, check_address
from lag_envs.own_files import is_file
from lag_envs.store import write
from lag_envs.tables import columns

EPILOG = f"""what is left in FOLDER/ENV/ALGO/seed<K>:
  result.json          returns on 100 fresh episodes, score, learning curve, hyperparameters, versions, times
  model.zip            the policy: stable_baselines3's load reads it, agents.learners.load_policy plays it
  tensorboard/         for `tensorboard --logdir FOLDER`
  {CHECKPOINT}       while the run is not finished: all that is needed to go on ({TESTS} times a run)

The same command goes on where a run was broken off, by Ctrl-C or by a kill; seeds that are finished are left
as they are. A run that goes on from its checkpoint gives the numbers that it would have given uninterrupted.
Hyperparameters are in the form of the RL Zoo, which takes them unchanged:
  lag-envs hyperparams ppo > ppo.yml
  python -m rl_zoo3.train --algo ppo --env PivotedBar-v0 --gym-packages lag_envs --conf-file ppo.yml

examples:
  python -m agents.train PivotedBar-v0                          one seed of PPO, in less than a minute
  python -m agents.train PivotedBar-v0 --seeds 10               ten seeds, as many at once as there are cores
  python -m agents.train PivotedBar-v0 --algo sac td3 --seeds 5
  python -m agents.train examples/ball_on_beam.py               a task of your own; this runs the file
  python -m agents.train all --seeds 5                          what docs/agents.md is made from
  python -m agents.train PivotedBar-v0 --seeds 100 --ray auto   the same, spread over a Ray cluster
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = argparse.ArgumentParser(
        prog="python -m agents.train",
        description="Train a learner on an environment and evaluate it over fresh episodes.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "env", nargs="+", metavar="ENV",
        help="ids, module:ID, or FILE or FILE:Class of your own, whose code is run; all: the package's",
    )  # fmt: skip
    p.add_argument(
        "--algo", nargs="+", default=["ppo"], metavar="ALGO", help=f"{', '.join(ALGORITHMS)} (default ppo)"
    )
    p.add_argument("--seeds", type=int, default=1, metavar="N", help="number of seeds (default %(default)s)")
    p.add_argument(
        "--first-seed", type=int, default=0, metavar="K", help="the first one (default %(default)s)"
    )
    p.add_argument("--steps", type=int, help="environment steps per seed, in place of the file's n_timesteps")
    p.add_argument(
        "--jobs", type=int, metavar="N", help="seeds trained at once (default: the number of cores)"
    )
    p.add_argument(
        "--config", type=Path, metavar="FILE", help="other hyperparameters, a YAML file of the Zoo"
    )
    p.add_argument("--output", type=Path, default=Path("runs"), metavar="FOLDER", help="default %(default)s")
    p.add_argument("--new", action="store_true", help="start anew, overwriting what these seeds have left")
    p.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="train on a Ray cluster: its address, auto for a running one, local for one on this machine",
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where a seed failed, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    try:
        runs = plan(args)
        todo = [run for run in runs if run.load_result() is None]
        for run in runs:
            if run not in todo:
                print(f"{run.name}: finished before")
        spread = partial(on_ray, address=args.ray) if args.ray else partial(processes, jobs=args.jobs)
        failed, stopped = follow(todo, spread) if todo else ({}, False)
        summarise([run for run in runs if run.name not in failed])
    except UserError as error:
        print(f"agents.train: error: {error}", file=sys.stderr)
        return 2
    for name, reason in failed.items():
        print(f"{name} failed: {reason}", file=sys.stderr)
    if stopped or failed:
        print(f"To go on:  {command('agents.train', arguments)}")
    return 130 if stopped else 1 if failed else 0


def plan(args: argparse.Namespace) -> list[Run]:
    """Return the runs that are asked for, or raise a UserError."""
    if "all" in args.env and len(args.env) > 1:
        raise UserError(f"all stands alone, got {' '.join(args.env)}")
    given = list(TASKS) if args.env == ["all"] else list(dict.fromkeys(args.env))
    sources = {own_env(name): "" if name in TASKS else name for name in given}
    if args.ray and any(map(is_file, given)):
        raise UserError("--ray takes ids and module:ID; a file is not on the other machines")
    algos = [check_name("algorithm", name, ALGORITHMS) for name in dict.fromkeys(args.algo)]
    for name, least in (("seeds", 1), ("first_seed", 0), ("steps", 1), ("jobs", 1)):
        value = getattr(args, name)
        if value is not None and not least <= value < 2**31:
            option = "--" + name.replace("_", "-")
            raise UserError(f"{option} must lie between {least} and 2147483647, got {value}")
    if args.output.exists() and not args.output.is_dir():
        raise UserError(f"--output must be a folder, {args.output} is not")
    runs = []
    for (env, source), algo in product(sources.items(), algos):
        hyper = hyperparameters(algo, env, args.config)
        try:
            steps = args.steps or int(float(hyper["n_timesteps"]))
        except (KeyError, ValueError, TypeError):
            steps = 0
        if steps < 1:
            raise UserError(f"n_timesteps must be a number of steps, got {hyper.get('n_timesteps')!r}")
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            folder = args.output / env / algo / f"seed{seed}"
            runs.append(Run(folder, env, algo, seed, steps, hyper, source))
    if args.ray:  # before anything is removed
        try:
            check_address(args.ray)
        except SpreadError as error:
            raise UserError(str(error)) from error
    for run in runs:
        if args.new:
            run.remove()
        run.load_result()
        run.load_checkpoint()
    return runs


# --- one seed, in a process or on another machine -----------------------------------------------------------


def work(run: Run, tell: Callable[[tuple], None], stop: Callable[[], bool], ship: bool = False) -> None:
    """Train one run and tell how it goes.

    Parameters
    ----------
    run : Run
        The run.
    tell : callable
        Given ("steps", name, steps), ("tested", name, curve), ("file", name, file, bytes) and last ("end",
        name, reason), with an empty reason where all went well.
    stop : callable
        Tells whether to end early.
    ship : bool
        Whether to tell the files too, for a run whose folder nobody else sees.
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
        if run.source:  # in this process it may not be registered yet
            own_env(run.source)
        finished = train(run, show=show, tested=tested, stop=stop)
        if finished:
            send(MODEL, NORMALISATION, RESULT)
        tell(("end", run.name, "" if finished else "stopped"))
    except UserError as error:
        tell(("end", run.name, str(error)))
    except OSError as error:
        tell(("end", run.name, f"{error}; what was saved before is kept"))
    except Exception:
        tell(("end", run.name, traceback.format_exc()))


def _in_process(run: Run, events: Any, stopped: Any) -> None:
    """Work in a process of its own; the one that started it passes Ctrl-C on."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    parent = multiprocessing.parent_process()

    def stop() -> bool:
        return stopped.is_set() or (parent is not None and not parent.is_alive())

    work(run, events.put, stop)


@contextmanager
def processes(runs: Sequence[Run], jobs: int | None = None) -> Iterator[tuple[Callable, Callable]]:
    """Train runs in processes; give a function that returns the next event or None, and one that stops."""
    context = multiprocessing.get_context("spawn")
    events, stopped = context.Queue(), context.Event()
    waiting = list(reversed(runs))
    running: dict[str, Any] = {}
    at_once = jobs or os.cpu_count() or 1

    def poll() -> tuple | None:
        while waiting and len(running) < at_once and not stopped.is_set():
            run = waiting.pop()
            running[run.name] = context.Process(target=_in_process, args=(run, events, stopped), daemon=True)
            running[run.name].start()
        try:
            event = events.get(timeout=0.2)
        except queue.Empty:
            for name, process in running.items():
                if process.exitcode is not None:  # without a word: it was killed
                    del running[name]
                    return "end", name, f"its process ended with status {process.exitcode}"
            if stopped.is_set() and not running and waiting:
                return "end", waiting.pop().name, "stopped"
            return None
        if event[0] == "end":
            running.pop(event[1]).join()
        return event

    try:
        yield poll, stopped.set
    finally:
        stopped.set()
        for process in running.values():
            process.join(10)
            process.kill()


# --- on Ray -------------------------------------------------------------------------------------------------


@contextmanager
def on_ray(runs: Sequence[Run], address: str) -> Iterator[tuple[Callable, Callable]]:
    """Train runs on a Ray cluster; otherwise like `processes`."""
    try:
        import ray
        from ray.util.queue import Empty, Queue
    except ImportError as error:
        raise UserError("--ray needs Ray: pip install 'lag-envs[ray]'") from error

    # The machines get our code from here; the libraries that it needs have to be installed there.
    root = Path(__file__).parents[1]
    modules = [str(root / "agents"), str(root / "src" / "lag_envs")]
    options: dict[str, Any] = {"runtime_env": {"py_modules": modules}, "log_to_driver": False}
    try:
        ray.init(None if address == "local" else address, logging_level="error", **options)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UserError(f"no Ray cluster at {address!r}: {error}") from error
    events = Queue()
    events.size()  # is there
    task = ray.remote(num_cpus=1, max_retries=0)(_on_ray)
    handles = {task.remote(_packed(run), events): run for run in runs}
    by_name = {run.name: run for run in runs}
    stopped = threading.Event()

    def poll() -> tuple | None:
        if stopped.is_set() and handles:
            handle, run = handles.popitem()
            ray.cancel(handle, force=True)
            return "end", run.name, "stopped"
        try:
            event = events.get(timeout=0.2)
        except Empty:
            for handle in ray.wait(list(handles), num_returns=len(handles), timeout=0)[0]:
                run = handles.pop(handle)
                try:
                    ray.get(handle)
                except Exception as error:  # the worker, or its machine, is gone
                    return "end", run.name, f"{type(error).__name__}: {str(error).splitlines()[0]}"
            return None
        if event[0] == "file":
            write(by_name[event[1]].path(event[2]), event[3])
            return None
        if event[0] == "end":
            handles.pop(next(h for h, run in handles.items() if run.name == event[1]), None)
            if not event[2]:
                by_name[event[1]].path(CHECKPOINT).unlink(missing_ok=True)
        return event

    try:
        yield poll, stopped.set
    finally:
        ray.shutdown()


def _packed(run: Run) -> tuple[dict[str, Any], bytes | None]:
    checkpoint = run.path(CHECKPOINT)
    return vars(run) | {"folder": None}, checkpoint.read_bytes() if checkpoint.exists() else None


def _on_ray(packed: tuple[dict[str, Any], bytes | None], events: Any) -> None:
    """Work on a machine that does not see the run's folder."""
    settings, checkpoint = packed
    with tempfile.TemporaryDirectory() as folder:
        run = Run(**settings | {"folder": Path(folder)})
        if checkpoint is not None:
            write(run.path(CHECKPOINT), checkpoint)
        work(run, events.put, lambda: False, ship=True)


# --- progress -----------------------------------------------------------------------------------------------


def follow(runs: Sequence[Run], spread: Callable) -> tuple[dict[str, str], bool]:
    """Train the runs and show how they go; return why which failed, and whether it was stopped."""
    from tqdm import tqdm

    failed: dict[str, str] = {}
    left = {run.name: run for run in runs}
    interrupted = 0
    steps = dict.fromkeys(left, 0)
    with ExitStack() as stack:
        poll, stop = stack.enter_context(spread(runs))

        def handle(number: int, frame: Any) -> None:
            nonlocal interrupted
            if interrupted:
                raise KeyboardInterrupt
            interrupted = number
            stop()

        for number in (signal.SIGINT, signal.SIGTERM):
            if threading.current_thread() is threading.main_thread():
                stack.callback(signal.signal, number, signal.signal(number, handle))
        bar = stack.enter_context(
            tqdm(
                total=sum(run.steps for run in runs), unit=" steps", unit_scale=True, disable=None,
                dynamic_ncols=True, initial=sum(run.trained for run in runs),
            )
        )  # fmt: skip
        for run in runs:
            steps[run.name] = run.trained
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
                _say(bar, f"{run.name}: {trained:>9,} steps, {seconds:4.0f} s, return {mean:.2f}")
            else:
                del left[name]
                if what and what != "stopped":
                    failed[name] = what
                elif not what:
                    steps[name] = run.steps
                    result = run.load_result() or {}
                    tail = "" if result.get("score") is None else f", score {result['score']:.3f}"
                    _say(bar, f"{run.name}: finished, return {result['mean_return']:.2f}{tail}")
    return failed, bool(interrupted)


def _say(bar: Any, line: str) -> None:
    """Print a line beside the bar; in a log there is no bar."""
    bar.write(line)
    sys.stdout.flush()


def summarise(runs: Sequence[Run]) -> None:
    """Print the runs' returns."""
    for (env, algo), some in groupby(runs, key=lambda run: (run.env, run.algo)):
        results = [(run, result) for run in some if (result := run.load_result()) is not None]
        if not results:
            continue
        print(f"\n{env}, {algo}, {EPISODES} fresh episodes each")
        rows = [("seed", "steps", "seconds", "return", "score")]
        for run, result in results:
            tail = "" if result["score"] is None else f"{result['score']:.3f}"
            trained, seconds, mean = result["trained"], result["wall_seconds"], result["mean_return"]
            rows.append((str(run.seed), f"{trained:,}", f"{seconds:.1f}", f"{mean:.2f}", tail))
        print("\n".join(columns(rows)))
        print(f"Written to {results[0][0].folder.parent}/")


def command(module: str, arguments: Sequence[str] | None) -> str:
    """Return the command that is running, without what would start it anew."""
    python = Path(sys.executable)
    if python.is_relative_to(Path.cwd()):
        python = python.relative_to(Path.cwd())
    given = [a for a in (sys.argv[1:] if arguments is None else arguments) if a != "--new"]
    return shlex.join([str(python), "-m", module, *given])


if __name__ == "__main__":
    sys.exit(main())
