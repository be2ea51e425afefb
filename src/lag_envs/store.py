"""Files that survive a full disk and a kill at any moment: written whole or not at all, or line by line."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def write_file(path: Path, data: bytes | str, sync: bool = False) -> None:
    """Write a file whole or not at all; with `sync`, a power cut cannot lose it either.

    Links are kept, and the files they lead to are written. Devices and pipes are written to, not replaced.
    """
    content = data.encode() if isinstance(data, str) else data
    if path.exists() and not path.is_file():
        with named(path):
            path.write_bytes(content)
        return
    place = Path(os.path.realpath(path))
    part = place.with_name(f".{place.name}.{os.getpid()}.part")
    with named(path, part):
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(content)
            if sync:
                to_disk(part)
            os.replace(part, place)
            if sync:
                to_disk(place.parent)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def named(path: Path, part: Path | None = None) -> Iterator[None]:
    """Name the file in errors that name no file, as on a full disk, or only its unfinished copy `part`."""
    try:
        yield
    except OSError as error:
        if error.filename not in (None, str(part)):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def to_disk(path: Path) -> None:
    """Flush a file, or a folder's entries, to the disk."""
    if path.is_dir() and sys.platform == "win32":
        return
    file = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def readable_json(data: Any) -> str:
    """Return data as JSON, with each list of numbers on one line."""
    text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
    return re.sub(r"\[[^\[\]{}\"]*\]", lambda found: " ".join(found[0].split()), text) + "\n"


def append(path: Path, row: dict[str, Any]) -> None:
    """Append a row of JSON to a file, on a new line even after one that was cut off."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with named(path), path.open("ab+") as out:
        if out.tell():
            out.seek(-1, os.SEEK_END)
            out.write(b"\n" * (out.read(1) != b"\n"))
        out.write(json.dumps(row, allow_nan=False).encode() + b"\n")


def rows(path: Path) -> Iterator[Any]:
    """Yield the rows of a file; lines that are cut off or damaged are skipped."""
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            yield json.loads(line)
        except ValueError:
            continue
