"""Parsers of modules that are run, and types of arguments."""

from __future__ import annotations

import argparse
import contextlib
import os
from pathlib import Path
from typing import Any

PICTURES = (".png", ".svg", ".pdf")


def module_parser(module: str, about: str | None, examples: str, **options: Any) -> argparse.ArgumentParser:
    """Return the parser of ``python -m MODULE``, whose help keeps the line breaks of its texts."""
    return argparse.ArgumentParser(
        prog=f"python -m {module}",
        allow_abbrev=False,  # so that a misspelt option cannot pass for another
        description=about,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **options,
    )


def count(text: str) -> int:
    """Return an argument as a positive integer."""
    if not text.strip().isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"a whole number of at least 1 is needed, got {text!r}")
    return int(text)


def new_file(text: str) -> Path:
    """Return the file of an option, checked before hours of work are spent on output for it.

    Raises
    ------
    argparse.ArgumentTypeError
        If no such file can be written. Missing folders are made when the file is written.
    """
    path = Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is a folder")
    if path.exists() and not path.is_file():  # a device or a pipe
        if not os.access(path, os.W_OK):
            raise argparse.ArgumentTypeError(f"{text} cannot be written to")
        return path
    _check_folder(text, Path(os.path.realpath(path)).parent)
    with contextlib.suppress(OSError):  # no such file yet, or no output
        if os.path.samestat(path.stat(), os.fstat(1)):
            raise argparse.ArgumentTypeError(f"{text} is the file that this command prints to; name another")
    return path


def new_folder(text: str) -> Path:
    """Return the folder of an option, checked before hours of work are spent on output for it.

    Raises
    ------
    argparse.ArgumentTypeError
        If the path is not a folder, or cannot be written to. Missing folders are made when files are written.
    """
    path = Path(text)
    if path.exists() and not path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is not a folder")
    _check_folder(text, Path(os.path.realpath(path)))
    return path


def _check_folder(text: str, folder: Path) -> None:
    """Raise an error for an argument if its folder, or the nearest parent that exists, is not writable."""
    import tempfile

    there = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        # Permissions do not tell everything: nobody can create a file in /proc.
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise argparse.ArgumentTypeError(
            f"{text} cannot be written: {there} is not a writable folder"
        ) from error


def new_picture(text: str) -> Path:
    """Return the file of an option for a picture, like `new_file`."""
    if Path(text).suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(f"a picture's name ends with {', '.join(PICTURES)}, got {text!r}")
    return new_file(text)
