"""Files that survive a full disk and a kill at any moment: written whole or not at all, or line by line."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def write_file(path: Path, data: bytes | str, sync: bool = False) -> None:
    """Write a file whole or not at all; with `sync`, a power cut cannot lose it either."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(data.encode() if isinstance(data, str) else data)
        if sync:
            to_disk(part)
        os.replace(part, path)
        if sync:
            to_disk(path.parent)
    finally:
        part.unlink(missing_ok=True)


def to_disk(path: Path) -> None:
    """Flush a file, or a folder's entries, to the disk."""
    if path.is_dir() and sys.platform == "win32":
        return
    file = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def append(path: Path, row: dict[str, Any]) -> None:
    """Append a row of JSON to a file, on a new line even after one that was cut off."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as out:
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
