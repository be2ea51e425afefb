"""``lag-envs order``."""

from __future__ import annotations

import argparse

from lag_envs.commands.base import OWN_OR_MODULE, Command, known_id
from lag_envs.options import count
from lag_envs.own_files import is_file
from lag_envs.scenes.derivation import order_of
from lag_envs.tasks.registration import make_task


def declare_order(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``order``."""
    parser.add_argument("id", metavar="ID|FILE", help=f"an environment, or {OWN_OR_MODULE}")
    parser.add_argument(
        "--num-envs", metavar="N", type=count, default=1024, help="size of the batch (default: 1024)"
    )
    parser.add_argument("--rounds", metavar="N", type=count, default=9, help="samples (default: 9)")


def run_order(args: argparse.Namespace) -> int:
    """Print the cost of each order of the series, and the best choice."""
    from lag_envs import own_files
    from lag_envs.orders import ORDERS, lines, measure_orders
    from lag_envs.progress import progress

    if is_file(args.id):
        kind = own_files.one(args.id)
        own_files.made_with_defaults(kind, args.id)
    else:
        kind = type(make_task(known_id(args.id)))
    with progress(args.rounds * len(ORDERS)) as advance:
        times = measure_orders(kind, args.num_envs, args.rounds, advance=lambda: advance(kind.__name__))
    print("\n".join(lines(kind, times, order_of(kind().scene, kind().dt))))
    return 0


ORDER = Command(
    "order",
    "find the order of the series that steps a task fastest",
    """Measure the time of a step at each order of the series, under random actions in a task's own
episodes, and report which order to write into the task. Every order meets the same tolerance. An
agent may move faster than random actions do; with a higher order, fewer of its steps are divided.

examples:
  lag-envs order ball_on_beam.py             a task of your own; this runs the file
  lag-envs order mine.py:Balance             one of several tasks""",
    declare_order,
    run_order,
)
