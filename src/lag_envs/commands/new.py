"""``lag-envs new``."""

from __future__ import annotations

import argparse
from pathlib import Path

from lag_envs.commands.base import Command


def declare_new(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``new``."""
    parser.add_argument("file", metavar="FILE", help="the file to write, such as my_scene.py")


def run_new(args: argparse.Namespace) -> int:
    """Write a scene and a task to start from."""
    from lag_envs.starter import start

    path = start(Path(args.file))
    print(
        f"{path} is written: a pendulum, its energies and a task. Change them, then:\n"
        f"  lag-envs info {path}       what follows from the energies\n"
        f"  lag-envs play {path}       drive it\n"
        f"  lag-envs report {path}     measure its errors"
    )
    return 0


NEW = Command(
    "new",
    "write a scene and a task to start from",
    """Write a file with a scene and a task of your own to start from, with comments. An existing file
is left as it is.

examples:
  lag-envs new my_scene.py
  lag-envs info my_scene.py""",
    declare_new,
    run_new,
)
