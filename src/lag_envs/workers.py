"""Run functions in other processes or on a Ray cluster, where a crash or hang costs only that work.

The context managers yield a function ``submit(function, *args, timeout=None)``, which returns a
`concurrent.futures.Future`; `as_they_finish` waits for several futures.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar, cast

from lag_envs.errors import UserError

Submit = Callable[..., Future]
Key = TypeVar("Key")


class ClusterError(UserError):
    """There is no cluster to work on; the text says why, and what to do."""


def as_they_finish(futures: Mapping[Future, Key]) -> Iterator[tuple[Key, Any]]:
    """Yield what each future returned or raised, in the order in which they finish."""
    for future in as_completed(futures):
        error = future.exception()
        yield futures[future], future.result() if error is None else error


def died(error: BaseException) -> str:
    """Describe in one line how work ended that raised no exception itself."""
    if (status := getattr(error, "exitcode", None)) is not None:  # Pebble's ProcessExpired
        return f"the process died, exit status {status}"
    return f"{type(error).__name__}: {error}".splitlines()[0]


@contextmanager
def processes(count: int, begin: Callable | None = None, *args: Any) -> Iterator[Submit]:
    """Yield a function that submits work to single-threaded processes, which cannot outlive this one.

    Parameters
    ----------
    count : int
        Number of processes.
    begin : callable, optional
        Called with `args` in each process before any work. Work still running when the block is left is
        killed.
    """
    from lag_envs.host import ONE_THREAD

    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # processes inherit it when they start
    pool = _pool(count, begin, args)

    def submit(function: Callable, *args: Any, timeout: float | None = None) -> Future:
        return pool.schedule(function, args=args, timeout=timeout)

    try:
        yield submit
    finally:
        pool.stop()
        pool.join()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _pool(count: int, begin: Callable | None, args: Sequence[Any]) -> Any:
    """Return a Pebble pool that reads a dead process's last message before it looks for the process's work.

    That message may say which work the process had taken. Pebble 5.2 does not wait for it: on a busy machine,
    work that dies at once then never finishes, or all work is given up.
    """
    from pebble.pool.process import PoolManager, ProcessPool

    class Manager(PoolManager):
        rounds = 0

        def process_next_message(self, timeout: float) -> None:  # called repeatedly, in a separate thread
            super().process_next_message(timeout)
            self.rounds += 1

        def handle_worker_expiration(self, expiration: tuple) -> None:
            while self.context.alive and self.worker_manager.pool_channel.poll(0.0):  # type: ignore[union-attr]
                time.sleep(0.01)
            # One message may have been taken from the channel already; the next round comes after it.
            begun = self.rounds
            while self.context.alive and self.rounds < begun + 2:
                time.sleep(0.01)
            super().handle_worker_expiration(expiration)

    context: Any = multiprocessing.get_context("spawn")
    pool = ProcessPool(count, context=context, initializer=_begin, initargs=(begin, args))
    pool._pool_manager = Manager(pool._pool_manager.context, context)
    return pool


class Elsewhere:
    """A copy of an object in a separate process, which ends with this one.

    Parameters
    ----------
    thing : object
        The object, which is copied with cloudpickle.
    """

    def __init__(self, thing: Any) -> None:
        import cloudpickle  # a dependency of Gymnasium

        context = multiprocessing.get_context("spawn")
        begin = (_receive, [cloudpickle.dumps(thing)])
        self._pool = ProcessPoolExecutor(1, context, _begin, begin)
        try:
            self._pool.submit(int).result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                "no process could be started: save the script as a file, and put its commands under "
                'if __name__ == "__main__":'
            ) from error

    def call(self, method: str, *args: Any) -> Future:
        """Call a method of the copy; calls are handled one after the other."""
        return self._pool.submit(_call, method, args)


_copy: Any = None


def _receive(thing: bytes) -> None:
    global _copy
    _copy = pickle.loads(thing)


def _call(method: str, args: Sequence[Any]) -> Any:
    return getattr(_copy, method)(*args)


def _begin(begin: Callable | None, args: Sequence[Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets Ctrl-C too, and ends its processes
    if (parent := multiprocessing.parent_process()) is not None:
        _end_after(parent.join)
    if begin is not None:
        begin(*args)


def _end_after(wait: Callable[[], Any]) -> None:
    """End this process, whatever it does, when a function returns."""

    def end() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


@contextmanager
def cluster(address: str, modules: Sequence[Path] = ()) -> Iterator[Submit]:
    """Yield a function that submits work to a Ray cluster; work still running at the end is killed.

    Parameters
    ----------
    address : str
        "auto" for a running cluster, "local" for one on this machine.
    modules : sequence of Path
        Folders of modules that are sent to the machines, besides this package; the packages that those
        modules import must be installed on the machines.

    Raises
    ------
    ClusterError
        If Ray or its cluster is missing.
    """
    try:
        import ray
    except ImportError as error:
        raise ClusterError("--ray needs Ray: pip install 'lag-envs[ray]'") from error

    check_address(address)
    packages = {"py_modules": [str(folder) for folder in (Path(__file__).parent, *modules)]}
    try:
        ray.init(
            None if address == "local" else address, runtime_env=packages, logging_level=logging.ERROR,
            log_to_driver=False,
        )  # fmt: skip
    except Exception as error:  # raised as such if a busy machine's node does not start in time
        raise ClusterError(f"no Ray cluster at {address!r}: {error}") from error

    def submit(function: Callable, *args: Any) -> Future:
        return ray.remote(num_cpus=1, max_retries=1)(function).remote(*args).future()

    try:
        yield submit
    finally:
        ray.shutdown()


def check_address(address: str) -> None:
    """Raise ClusterError if nothing listens at the address: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host:
        try:
            socket.create_connection((host, int(port)), timeout=10.0).close()
        except (OSError, ValueError, OverflowError) as error:
            raise ClusterError(f"no Ray cluster at {address!r}: {error}") from error


# --- one process that keeps its results when it is stopped --------------------------------------------------

#: Signals that follow the first one within this time [s] count as the same: `timeout` sends two.
AT_ONCE = 0.5
_asked = threading.Event()


def run_stoppable(command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Run a command that calls `obey_parent`, and return its exit status.

    The first Ctrl-C or SIGTERM asks the command to stop. The second one kills it, unless it comes within
    `AT_ONCE`. The command cannot outlive this process.
    """
    signals = (signal.SIGINT, signal.SIGTERM)
    # On POSIX, the command keeps ignoring the terminal's Ctrl-C: only this process passes it on.
    before = {number: signal.signal(number, signal.SIG_IGN) for number in signals}
    asked = killed = 0.0

    def stop(*_: Any) -> None:
        nonlocal asked, killed
        now = time.monotonic()
        if not asked:
            asked = now
            with suppress(OSError, ValueError):  # it has just ended, or nobody reads this
                os.write(pipe.fileno(), b".")
                told = "\nstopping after this measurement; interrupt again to stop at once, without results"
                print(told, file=sys.stderr, flush=True)
        elif now - asked > AT_ONCE:
            killed = now
            child.kill()

    try:
        with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE) as child:
            pipe = cast(IO[bytes], child.stdin)
            for number in signals:
                signal.signal(number, stop)
            while (status := child.poll()) is None:
                with suppress(subprocess.TimeoutExpired):
                    # On Windows, no handler runs during a wait without a time limit.
                    child.wait(0.2 if os.name == "nt" else None)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return 130 if killed else status


def obey_parent() -> None:
    """Let the parent stop this process, which also ends with the parent; see `run_stoppable`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: _asked.set())

    def listen() -> None:
        while os.read(0, 1):
            _asked.set()

    _end_after(listen)


def stopping_point() -> None:
    """Raise KeyboardInterrupt if the parent asked this process to stop.

    A signal could interrupt any code, and some code, such as JAX's, would continue as if nothing had
    happened.
    """
    if _asked.is_set():
        raise KeyboardInterrupt
