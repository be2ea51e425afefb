"""``lag-envs list`` and ``lag-envs info``."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lag_envs import TASKS
from lag_envs.commands.base import OWN_OR_MODULE, Command, known_id
from lag_envs.own_files import is_file
from lag_envs.tables import aligned
from lag_envs.tasks.registration import make_task

if TYPE_CHECKING:
    from lag_envs.tasks.base import Task


def run_list(args: argparse.Namespace) -> int:
    """Print a line for every environment."""
    head, *rows = aligned([("id", "control", "dt", "steps", "length"), *(_line(id) for id in TASKS)])
    print(head)
    for id, row in zip(TASKS, rows, strict=True):
        print(f"{row}\n  {(inspect.getdoc(TASKS[id]) or '').partition(chr(10))[0]}")
    print(
        "\n`lag-envs info ID` describes one, `lag-envs play ID` lets you drive, "
        "`lag-envs watch ID` shows how it is done."
    )
    return 0


def _line(id: str) -> tuple[str, ...]:
    task = TASKS[id]()
    return (
        id,
        ", ".join(_range(acting) for acting in task.formulas.acting),
        f"{task.dt:g} s",
        f"{task.limit:g}",
        f"{task.duration:g} s",
    )


def _range(acting: Any) -> str:
    """Return a control's name, its range or choices, and its unit."""
    *others, last = (f"{value:g}" for value in acting.values or (acting.low, acting.high))
    given = f"{', '.join(others)} {'or' if acting.values else 'to'} {last}"
    return f"{acting.control} {given} {acting.unit}".rstrip()


def declare_info(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``info``."""
    parser.add_argument(
        "id", metavar="ID|FILE", help=f"an environment, such as PivotedBar-v0, or {OWN_OR_MODULE}"
    )


def run_info(args: argparse.Namespace) -> int:
    """Print a description of an environment."""
    from lag_envs.facts import facts

    if is_file(args.id):
        from lag_envs import own_files

        task = own_files.made_with_defaults(own_files.one(args.id), args.id)
        name, formulas = task.id or type(task).__name__, f"see {args.id}"
    else:
        name = known_id(args.id)
        task = make_task(name)
        formulas = f"python -m pydoc {type(task).__module__}.{type(task).__name__}"
    print("\n".join(facts(task, name, formulas)))
    print("\n".join(_agents(task, name, args.id)))
    return 0


def _agents(task: Task, name: str, given: str) -> list[str]:
    """Return a description of an environment's picture and agents."""
    from lag_envs.scores import known_returns
    from lag_envs.watch import named_agents

    lines = ["", "Agents by name, and how to watch them", *_rows(named_agents(task, name))]
    lines += [f"  lag-envs watch {given} --agent NAME, or drive yourself: lag-envs play {given}"]
    if scale := known_returns(name):
        lines += [
            "",
            f"Returns: random actions {scale.random:.4g}, the best known {scale.best:.4g} ({scale.policy})",
        ]
    return lines


def _rows(rows: Sequence[tuple[str, ...]]) -> list[str]:
    return [f"  {line}" for line in aligned(rows)]


LIST = Command(
    "list",
    "list the environments",
    """List the environments: objective, control, control interval, steps and length of an episode.

examples:
  lag-envs list
  lag-envs list | grep Incline""",
    lambda parser: None,
    run_list,
)
INFO = Command(
    "info",
    "describe one environment",
    """Describe one environment: state, control, observation bounds, start, parameters, accuracy.

examples:
  lag-envs info PivotedBar-v0
  lag-envs info ball_on_beam.py              a task of your own; this runs the file
  lag-envs info mine.py:Balance              one of several tasks""",
    declare_info,
    run_info,
)
