"""Command lines of tools that take no options."""

from __future__ import annotations

import argparse
from collections.abc import Sequence


def take_none(command: str, about: str | None, arguments: Sequence[str] | None) -> None:
    """Answer ``--help``, and refuse everything else.

    Parameters
    ----------
    command : str
        How the tool is called, which is also the example.
    about : str
        What it does.
    arguments : sequence of str
        Its arguments, by default those of the process.
    """
    argparse.ArgumentParser(
        prog=command,
        description=about,
        epilog=f"examples:\n  {command}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).parse_args(arguments)
