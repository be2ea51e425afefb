"""The base of subcommands, and helpers that several of them need."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from contextlib import suppress
from datetime import date
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym

from lag_envs import TASKS
from lag_envs.errors import UserError, hint
from lag_envs.own_files import imported

#: Alternative to ids in `report`.
OWN = "a Python file of your own (FILE or FILE:Class), whose code is run"
#: Alternatives to ids in `info`, `bench`, `order`, `play` and `watch`.
OWN_OR_MODULE = f"module:ID, which imports the module, or {OWN}"


class Command(NamedTuple):
    """A subcommand: its name, its arguments, its function."""

    name: str
    help: str
    description: str
    declare: Callable[[argparse.ArgumentParser], Any]
    run: Callable[[argparse.Namespace], int]


def known_id(id: str) -> str:
    """Return the id for ID or module:ID, or raise a UserError that names similar ones."""
    if id in TASKS:
        return id
    if ":" in id:
        found = imported(id)
        if "task" not in gym.spec(found).kwargs:
            raise UserError(
                f"{id} is not a task of lag_envs; lag_envs.register(Task) makes an environment of a task"
            )
        return found
    raise UserError(
        f"there is no environment {id!r}; {hint(id, TASKS, '`lag-envs list` names all')} "
        "(the name of your own file must end with .py)"
    )


def needs(extra: str, *packages: str) -> None:
    """Raise a UserError that names missing packages and how to install them."""
    for package in packages:
        if find_spec(package) is None:
            raise UserError(f'{package} is missing: pip install "lag-envs[{extra}]"')


def check_checkout(option: str, folder: str) -> None:
    """Raise a UserError unless the folder of an option is a checkout that can be written to."""
    for name in ("README.md", "docs/speed.json", "docs/speed.md"):
        if not os.access(Path(folder, name), os.W_OK):
            raise UserError(f"{option}: {Path(folder, name)} is missing, or cannot be written to")


def declare_date(parser: argparse.ArgumentParser, where: str) -> None:
    """Declare the option for the date that a result is given."""
    parser.add_argument(
        "--date",
        metavar="YYYY-MM-DD",
        type=_date,
        default=date.today().isoformat(),
        help=f"date to write {where} (default: today)",
    )


def _date(text: str) -> str:
    with suppress(ValueError):
        if date.fromisoformat(text).isoformat() == text:
            return text
    raise argparse.ArgumentTypeError(f"a date is needed, such as 2026-01-31, got {text!r}")


def seconds(text: str) -> float:
    """Return an argument as a time [s]."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"a number above 0 is needed, got {text!r}")
    return value
