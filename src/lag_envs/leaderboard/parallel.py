"""Work on many submissions at once: in processes, or on the machines of a Ray cluster."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lag_envs.leaderboard.protocol import FOLDER_BYTES
from lag_envs.workers import cluster, outcomes, processes

Work = Callable[[Path], Any]


def map_submissions(
    function: Work, folders: Sequence[Path], jobs: int = 1, ray: str | None = None
) -> Iterator[tuple[Path, Any]]:
    """Call a function on every folder and yield (folder, what it returned or raised), as they are finished.

    Parameters
    ----------
    function : callable
        Takes the folder of a submission. With several jobs or Ray it must be picklable, as a function at the
        top of a module is, and so must be what it returns.
    folders : sequence of Path
        The submissions.
    jobs : int
        Processes side by side; 1 for none besides this one.
    ray : str, optional
        Address of a Ray cluster, "auto" for a running one, "local" for one on this machine. Its machines get
        this package and the submissions' files from here, and need its dependencies.

    Yields
    ------
    (Path, object)
        A folder, and what came of it. An exception is yielded, not raised, so that one submission does not
        cost the others theirs.

    Raises
    ------
    SpreadError
        Of `lag_envs.workers`, where Ray is missing, or its cluster.
    """
    if ray is not None:
        with cluster(ray) as submit:
            futures = {}
            for folder in folders:
                files = packed(folder)
                if files is None:  # it will be refused, for which nobody else is needed
                    yield folder, _caught(function, folder)
                else:
                    futures[submit(_unpacked, function, folder.name, files)] = folder
            yield from outcomes(futures)
    elif jobs > 1 and len(folders) > 1:
        with processes(min(jobs, len(folders))) as submit:
            yield from outcomes({submit(function, folder): folder for folder in folders})
    else:
        for folder in folders:
            yield folder, _caught(function, folder)


def _caught(function: Work, folder: Path) -> Any:
    try:
        return function(folder)
    except Exception as error:
        return error


def packed(folder: Path) -> dict[str, bytes] | None:
    """Return a folder's files by name; None where it is none of plain files within the limit of size."""
    files: dict[str, bytes] = {}
    try:
        with os.scandir(folder) as found:
            entries = list(found)
        sizes = [entry.stat(follow_symlinks=False) for entry in entries]
        if not all(stat.S_ISREG(s.st_mode) for s in sizes) or sum(s.st_size for s in sizes) > FOLDER_BYTES:
            return None
        for entry in entries:
            files[entry.name] = Path(entry.path).read_bytes()
    except OSError:
        return None
    return files


def _unpacked(function: Work, name: str, files: dict[str, bytes]) -> Any:
    """Call a function on a folder on a machine that does not see it."""
    with tempfile.TemporaryDirectory() as above:
        folder = Path(above) / name
        folder.mkdir()
        for file, content in files.items():
            (folder / file).write_bytes(content)
        return _caught(function, folder)
