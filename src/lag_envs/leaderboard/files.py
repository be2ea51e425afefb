"""Digests of files, and reading of untrusted files: only plain files, and only up to a given size."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from collections.abc import Mapping
from pathlib import Path


def digest_of(files: Mapping[str, bytes]) -> str:
    """Return the SHA-256 of files' names and contents."""
    total = hashlib.sha256()
    for name in sorted(files):
        total.update(f"{name}\n{len(files[name])}\n".encode() + files[name])
    return total.hexdigest()


def read_plain(path: Path, most: int) -> bytes:
    """Return a file's content.

    Only plain files are read: a pipe would block for ever, a device would never end, and a link may lead
    anywhere.

    Parameters
    ----------
    path : Path
        The file.
    most : int
        The largest size accepted.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OSError
        If it is not a plain file, is larger, or cannot be read.
    """
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        file = os.open(path, flags | getattr(os, "O_BINARY", 0))
    except OSError as error:
        # O_NOFOLLOW's error for a link, and Linux's for a socket.
        if error.errno in (errno.ELOOP, errno.ENXIO):
            raise _not_plain() from None
        raise
    with os.fdopen(file, "rb") as opened:
        if not stat.S_ISREG(os.fstat(opened.fileno()).st_mode):
            raise _not_plain()
        content = opened.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it has more than the {most:,} bytes that are accepted")
    return content


def _not_plain() -> OSError:
    return OSError(errno.EINVAL, "it is not a plain file; links, pipes, folders and devices are not read")
