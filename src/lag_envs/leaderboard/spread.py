"""Work on many submissions at once: in processes, or on the machines of a Ray cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import socket
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lag_envs.leaderboard.protocol import FOLDER_BYTES

Work = Callable[[Path], Any]


class SpreadError(Exception):
    """The work cannot be spread; the text says why, and what to do."""


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
        Where Ray is missing, or its cluster.
    """
    if not folders:
        return
    if ray is not None:
        yield from _on_ray(function, folders, ray)
    elif jobs > 1 and len(folders) > 1:
        yield from _in_processes(function, folders, jobs)
    else:
        for folder in folders:
            yield folder, _caught(function, folder)


def _caught(function: Work, folder: Path) -> Any:
    try:
        return function(folder)
    except Exception as error:
        return error


# --- processes ----------------------------------------------------------------------------------------------


def _in_processes(function: Work, folders: Sequence[Path], jobs: int) -> Iterator[tuple[Path, Any]]:
    """Work side by side; whom a dying process takes down with it gets a second try in one of its own."""
    again: list[Path] = []
    for folder, outcome in _in_pool(function, folders, jobs):
        if isinstance(outcome, BrokenProcessPool):
            again.append(folder)
        else:
            yield folder, outcome
    for folder in again:
        yield from _in_pool(function, [folder], 1)


def _in_pool(function: Work, folders: Sequence[Path], jobs: int) -> Iterator[tuple[Path, Any]]:
    with _pool(min(jobs, len(folders))) as pool:
        futures: dict[Future, Path] = {pool.submit(_caught, function, f): f for f in folders}
        for future in as_completed(futures):
            try:
                yield futures[future], future.result()
            except Exception as error:  # it died, or what came of it cannot be pickled
                yield futures[future], error


@contextmanager
def _pool(size: int) -> Iterator[ProcessPoolExecutor]:
    """Give processes of one thread each, which end with this one even if it is killed."""
    from lag_envs.benchmark import ONE_THREAD

    before = {name: os.environ.get(name) for name in ONE_THREAD}
    others = multiprocessing.active_children()
    os.environ.update(ONE_THREAD)  # a process inherits it when it starts
    pool = ProcessPoolExecutor(size, multiprocessing.get_context("spawn"), _end_with_parent)
    try:
        yield pool
    except BaseException:  # such as Ctrl-C: what they do would not be waited for
        for child in multiprocessing.active_children():
            if child not in others:
                child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets Ctrl-C too, and ends its processes
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# --- Ray ----------------------------------------------------------------------------------------------------


def _on_ray(function: Work, folders: Sequence[Path], address: str) -> Iterator[tuple[Path, Any]]:
    try:
        import ray
    except ImportError as error:
        raise SpreadError("--ray needs Ray: pip install 'lag-envs[leaderboard,ray]'") from error

    import lag_envs

    check_address(address)
    packages = {"py_modules": [str(Path(lag_envs.__file__).parent)]}
    try:
        ray.init(
            None if address == "local" else address, runtime_env=packages, logging_level=logging.ERROR,
            log_to_driver=False,
        )  # fmt: skip
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise SpreadError(f"no Ray cluster at {address!r}: {error}") from error
    try:
        task = ray.remote(num_cpus=1, max_retries=1)(_unpacked)
        running: dict[Any, Path] = {}
        for folder in folders:
            files = packed(folder)
            if files is None:  # it will be refused, for which nobody else is needed
                yield folder, _caught(function, folder)
            else:
                running[task.remote(function, folder.name, files)] = folder
        while running:
            for handle in ray.wait(list(running))[0]:
                folder = running.pop(handle)
                try:
                    yield folder, ray.get(handle)
                except Exception as error:  # the worker, or its machine, is gone
                    yield folder, error
    finally:
        ray.shutdown()


def check_address(address: str) -> None:
    """Raise SpreadError where nobody listens: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host:
        try:
            socket.create_connection((host, int(port)), timeout=10.0).close()
        except (OSError, ValueError, OverflowError) as error:
            raise SpreadError(f"no Ray cluster at {address!r}: {error}") from error


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
