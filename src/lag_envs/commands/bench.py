"""``lag-envs bench``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from lag_envs import TASKS, __version__
from lag_envs.commands.base import (
    OWN_OR_MODULE,
    Command,
    check_checkout,
    declare_date,
    known_id,
    needs,
    seconds,
)
from lag_envs.errors import UserError
from lag_envs.host import installed_versions, machine, usable_cores
from lag_envs.options import count, new_file
from lag_envs.own_files import is_file
from lag_envs.store import readable_json, write_file


def declare_bench(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``bench``."""
    parser.add_argument(
        "ids",
        metavar="ID",
        nargs="*",
        help=f"environments to measure (default: all; PivotedBar-v0 with --quick), or {OWN_OR_MODULE}",
    )
    parser.add_argument(
        "--quick", action="store_true", help="fewer and shorter samples, no cold start; takes under a minute"
    )
    parser.add_argument(
        "--cold", action="store_true", help="only the cold start: import, make, reset, first step"
    )
    parser.add_argument(
        "--output",
        type=new_file,
        metavar="FILE",
        help="write everything, raw samples included, to this JSON file; with --device, only the medians",
    )
    parser.add_argument(
        "--checkout",
        metavar="FOLDER",
        help="write everything into docs/speed.json, docs/speed.md and README.md of this checkout; with "
        "--device, into docs/gpu.json and docs/speed.md",
    )
    parser.add_argument(
        "--with",
        dest="keywords",
        metavar="KEYWORDS",
        action="append",
        type=_keywords,
        help="measure with these keywords too, as in --with 'action_delay=0.013'; repeatable",
    )
    parser.add_argument(
        "--sizes", metavar="N,N,...", type=_sizes, help="sizes of the batches (default: 1,64,1024,16384)"
    )
    parser.add_argument(
        "--threads",
        metavar="N",
        type=count,
        default=1,
        help="also measure how much faster N threads step a batch, on N cores",
    )
    parser.add_argument(
        "--device",
        metavar="DEVICE",
        help="measure on a GPU, cuda, instead of the processor (default sizes: 4096,1048576)",
    )
    parser.add_argument(
        "--rounds",
        metavar="N",
        type=count,
        help="samples of each row (default: 31, or 9 with --quick or --device)",
    )
    parser.add_argument(
        "--seconds",
        metavar="S",
        type=seconds,
        help="length of a sample (default: 0.05, or 0.02 with --quick, without --device)",
    )
    parser.add_argument(
        "--clock",
        choices=["wall", "cpu"],
        default="wall",
        help="cpu leaves out the time of other programs (default: wall)",
    )
    declare_date(parser, "in the file")


def run_bench(args: argparse.Namespace) -> int:
    """Compare speeds."""
    from lag_envs.benchmark.measurement import BenchmarkSettings
    from lag_envs.benchmark.process import in_own_process

    ids, files = _measured(args.ids)
    ids = ids or (("PivotedBar-v0",) if args.quick or args.cold else tuple(TASKS))
    if args.device:
        return _on_device(args, ids)
    if args.checkout is not None:
        if args.threads > 1 or any(getattr(args, o) for o in ("ids", "quick", "cold", "sizes", "keywords")):
            raise UserError(
                "--checkout writes a whole measurement into a checkout: leave out IDs, --quick, --cold, "
                "--sizes, --with, --threads"
            )
        check_checkout("--checkout", args.checkout)
    if args.threads > (cores := usable_cores()):
        raise UserError(f"--threads {args.threads} needs {args.threads} cores; this process may use {cores}")
    if args.threads > 1 and args.clock == "cpu":
        raise UserError("--threads needs --clock wall, because cpu adds up the time of all threads")
    for text in args.keywords or ():
        _check_keywords(text, ids)
    quick = {"rounds": 9, "seconds": 0.02, "cold_starts": 3 if args.cold else 0} if args.quick else {}
    given = {
        name: getattr(args, name)
        for name in ("sizes", "rounds", "seconds")
        if getattr(args, name) is not None
    }
    plain = {
        "ids": ids,
        "files": files,
        "keywords": tuple(args.keywords or ()),
        "energies": not (args.quick or args.ids),
        "jacobians": not (args.quick or args.ids or args.cold),
        "divisions": not (args.quick or args.cold),
        "speed": not args.cold,
        "threads": args.threads,
        "clock": args.clock,
        "date": args.date,
        "output": args.output and str(args.output),
        "checkout": args.checkout,
    }
    return in_own_process(BenchmarkSettings(**(quick | given | plain)))


def _on_device(args: argparse.Namespace, ids: Sequence[str]) -> int:
    """Measure on a GPU."""
    if args.threads > 1 or args.clock == "cpu" or args.cold or args.keywords:
        raise UserError(
            "--device cannot be combined with --cold, --with, --threads or --clock cpu; leave them out"
        )
    if args.checkout is not None:
        if args.ids or args.quick or args.sizes:
            raise UserError(
                "--checkout writes a whole measurement into a checkout: leave out IDs, --quick, --sizes"
            )
        check_checkout("--checkout", args.checkout)
    needs("torch", "torch")
    from lag_envs.benchmark import gpu
    from lag_envs.benchmark.device import measured
    from lag_envs.device import checked_device

    if not args.device.startswith("cuda"):
        raise UserError(
            f"--device must be cuda or cuda:N, got {args.device!r}; leave it out for the processor"
        )
    try:
        device = checked_device(args.device)
    except ValueError as error:
        raise UserError(f"--device: {error}") from error
    perfect = [env_id for env_id in ids if not (env_id in TASKS and TASKS[env_id].imperfections)]
    if args.ids and (others := [env_id for env_id in ids if env_id not in perfect]):
        raise UserError(
            f"--device: {', '.join(others)} cannot run on a GPU, because of imperfect sensors or "
            "actuators, or hidden parameters"
        )
    about = {
        "date": args.date,
        "machine": machine(),
        "versions": {"lag_envs": __version__} | installed_versions(["torch", "gymnax", "jax"]),
    }
    report = about | measured(
        perfect, args.sizes or (4096, 2**20), device, args.seconds or 0.05, args.rounds or 9
    )
    print("\n".join(gpu.console_lines(report)))
    if args.output:
        write_file(args.output, readable_json(report))
        print(f"written to {args.output}")
    if args.checkout is not None and report["complete"]:
        gpu.take_over(report, Path(args.checkout))
        print(f"written to docs/gpu.json and docs/speed.md in {args.checkout}")
    return 0 if report["complete"] else 130


def _measured(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the requested ids, and the names whose code has to be run first."""
    from lag_envs import own_files

    files = tuple(dict.fromkeys(name for name in names if is_file(name) or ":" in name))
    ids: list[str] = []
    for name in names:
        ids += own_files.registered(name) if is_file(name) else [known_id(name)]
    return tuple(dict.fromkeys(ids)), files


def _check_keywords(text: str, ids: Sequence[str]) -> None:
    """Refuse keywords that none of the environments takes."""
    import gymnasium as gym

    from lag_envs.benchmark.contestants import keywords_of

    for env_id in ids:
        try:
            gym.make(env_id, **keywords_of(text)).close()
        except (TypeError, ValueError) as error:
            refused = error
        else:
            return
    raise UserError(f"--with {text}: {refused}") from refused


def _keywords(text: str) -> str:
    from lag_envs.benchmark.contestants import keywords_of

    try:
        keywords_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _sizes(text: str) -> tuple[int, ...]:
    return tuple(map(count, text.split(",")))


BENCH = Command(
    "bench",
    "compare the speed with other libraries",
    """Compare steps per second with Gymnasium and, if installed, EnvPool, gymnax and TorchRL, in one
run on one core: each round takes a sample of every row, and ratios are taken within a round.
Then time the cold start of whole processes. Ctrl-C ends the measurement and keeps the results so
far; a second Ctrl-C ends it at once, without results.

examples:
  lag-envs bench --quick                             one environment, in under a minute
  lag-envs bench --output speed.json                 everything, in a few minutes
  lag-envs bench --checkout .                        the same, into the documentation of a clone
  lag-envs bench PivotedBar-v0 --sizes 64,16384
  lag-envs bench --quick ball_on_beam.py             tasks of your own; this runs the file
  lag-envs bench --quick --with action_delay=0.013   the cost of keywords
  lag-envs bench --quick --threads 2                 the gain from a second thread
  lag-envs bench --device cuda                       on a GPU, in both precisions
  lag-envs bench --cold                              only the cold start
  lag-envs bench --quick --clock cpu                 on a machine that is busy with other work""",
    declare_bench,
    run_bench,
)
