"""Work on many submissions at once: in processes, or on the machines of a Ray cluster."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from lag_envs.leaderboard.fields import ascii_text
from lag_envs.workers import as_they_finish, cluster, processes

Work = Callable[[Path], Any]
Key = TypeVar("Key")


def map_submissions(
    function: Work, folders: Sequence[Path], jobs: int = 1, ray: str | None = None
) -> Iterator[tuple[Path, Any]]:
    """Call a function on every folder; yield (folder, what it returned or raised) as each one finishes.

    Parameters
    ----------
    function : callable
        Takes the folder of a submission. With several jobs or Ray, it and its results must be picklable, so
        it must be at the top of a module.
    folders : sequence of Path
        The submissions.
    jobs : int
        Number of parallel processes; 1 stands for this process alone.
    ray : str, optional
        Address of a Ray cluster, "auto" for a running one, "local" for one on this machine. This package and
        the submissions' files are sent to its machines, which need the package's dependencies.

    Yields
    ------
    (Path, object)
        A folder and its outcome. An exception is yielded, not raised, so that one bad submission does not
        stop the others.

    Raises
    ------
    ClusterError
        From `lag_envs.workers`, if Ray or its cluster is missing.
    """
    if ray is not None:
        from lag_envs.leaderboard.submission import Refused, read_files

        with cluster(ray) as submit:
            futures = {}
            for folder in folders:
                try:
                    files = read_files(folder)
                except Refused:  # the function will refuse it too, which needs no other machine
                    yield folder, _caught(function, folder)
                else:
                    futures[submit(_unpacked, function, folder.name, files)] = folder
            yield from as_they_finish(futures)
    else:
        yield from shared([(folder, (folder,)) for folder in folders], function, jobs)


def shared(
    work: Sequence[tuple[Key, tuple]], function: Callable[..., Any], jobs: int = 1
) -> Iterator[tuple[Key, Any]]:
    """Share calls of a function among processes; yield (key, what it returned or raised) as each finishes.

    Parameters
    ----------
    work : sequence of (key, arguments)
        The calls.
    function, jobs
        As for `map_submissions`.
    """
    if jobs > 1 and len(work) > 1:
        with processes(min(jobs, len(work))) as submit:
            yield from as_they_finish({submit(function, *arguments): key for key, arguments in work})
    else:
        for key, arguments in work:
            yield key, _caught(function, *arguments)


def with_bar(function: Callable[..., Any], folder: Path) -> Any:
    """Call a function with a folder and a callback for its progress, which a bar shows on a terminal."""
    from tqdm import tqdm

    with tqdm(
        desc=ascii_text(folder.name), unit=" steps", unit_scale=True, disable=None, leave=False, delay=0.5
    ) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return function(folder, progress=show)


def _caught(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except Exception as error:
        return error


def _unpacked(function: Work, name: str, files: dict[str, bytes]) -> Any:
    """Call a function on a folder, on a machine that does not have it."""
    with tempfile.TemporaryDirectory() as above:
        folder = Path(above) / name
        folder.mkdir()
        for file, content in files.items():
            (folder / file).write_bytes(content)
        return _caught(function, folder)
