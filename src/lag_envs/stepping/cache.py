"""Compiled functions on disk, one file each, checked before they are used.

Numba's own cache trusts its files. A file that lost a byte to a full disk, a killed process or an editor
causes an error deep inside pickle or LLVM, or runs although it is damaged. Here a file begins with a key of
what it was compiled from and a digest of its content. A file that does not match is dropped, and its function
is compiled again. If the cache cannot be written to, nothing is kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
import re
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

#: Maximum size of the cache in bytes; the least recently used files are removed first.
LIMIT = 256 * 2**20

_MAGIC = b"lag_envs 1"
_SUFFIX = ".compiled"
_DAY = 86400.0
#: The latest Numba known to run loaded code.
_KNOWN = (0, 68)
_warned = False


class Damaged(Exception):
    """A file whose content differs from what was written."""


class CacheFile(NamedTuple):
    """A file of the cache: its path, its size in bytes, and when it was used last (to a day)."""

    path: Path
    size: int
    used: float


def folder() -> Path | None:
    """Return the folder of compiled functions, or None if there is no such folder.

    It is ``lag_envs`` in the folder named by the environment variable ``NUMBA_CACHE_DIR``, or else in the
    system's cache folder of the user.
    """
    named = os.environ.get("NUMBA_CACHE_DIR") or (
        os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else os.environ.get("XDG_CACHE_HOME")
    )
    try:
        parent = (
            Path(named).expanduser()
            if named
            else Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
        )
        return parent.absolute() / "lag_envs"
    except (OSError, RuntimeError):  # no home
        return None


def cache_files(place: Path) -> list[CacheFile]:
    """Return the files in a cache's folder, most recently used first, with leftovers of killed processes."""
    found = []
    with contextlib.suppress(OSError):
        for item in os.scandir(place):
            if item.name.endswith(_SUFFIX):
                with contextlib.suppress(OSError):
                    status = item.stat(follow_symlinks=False)
                    found.append(CacheFile(Path(item.path), status.st_size, status.st_mtime))
    return sorted(found, key=lambda entry: entry.used, reverse=True)


def clear(place: Path) -> int:
    """Remove all files, and return how many there were."""
    return sum(_remove(entry.path) for entry in cache_files(place))


def trim(place: Path, limit: int) -> None:
    """Remove the least recently used files until the rest has at most `limit` bytes."""
    total = 0
    for entry in cache_files(place):
        total += entry.size
        if total > limit:
            _remove(entry.path)


def damage(path: Path) -> str:
    """Return what is wrong with a file of the cache, or an empty string if the file is intact."""
    try:
        return "" if _read(path, None) is not None else "it cannot be read"
    except Damaged as error:
        return str(error)


def writable(place: Path) -> bool:
    """Return whether files can be kept in a folder, which need not exist yet."""
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False


def jit(function: Callable, key: str | None = None, inner: bool = False) -> Any:
    """Compile a function on its first call for each combination of types, or take it from the cache.

    Parameters
    ----------
    function : callable
        A function that Numba can compile.
    key : str, optional
        What the result depends on: its own source, and all functions and numbers that it uses. The default is
        the file that defines the function, and the numbers that the function uses. Types, machine, and the
        versions of Python and Numba are added.
    inner : bool, default False
        Whether only compiled code calls the function; it is then compiled without the code that takes
        Python's objects.

    Returns
    -------
    callable
        Numba's dispatcher.
    """
    import numba

    without = {"no_cfunc_wrapper": True, "no_cpython_wrapper": inner}
    dispatcher = numba.njit(function, error_model="numpy", nogil=True, **without)
    if key is None:
        with contextlib.suppress(OSError, TypeError):  # typed in, not in a file
            source = inspect.getsource(inspect.getmodule(function))  # type: ignore[arg-type]
            known = ((name, function.__globals__.get(name)) for name in function.__code__.co_names)
            key = repr((source, [(name, value) for name, value in known if isinstance(value, int | float)]))
    if key is not None and not numba.config.DISABLE_JIT:
        dispatcher._cache = _DispatcherCache(function.__name__, key)
    return dispatcher


class _DispatcherCache:
    """The cache that a Numba dispatcher queries before compiling, and fills after; see numba.core.caching."""

    def __init__(self, name: str, key: str) -> None:
        self._name, self._key = re.sub(r"\W", "", name), key

    @property
    def cache_path(self) -> str | None:
        place = folder()
        return None if place is None else str(place)

    def flush(self) -> None:
        """Forget everything compiled from this function."""
        for entry in cache_files(folder() or Path()):
            if entry.path.name.startswith(f"{self._name}-"):
                _remove(entry.path)

    def load_overload(self, types: Any, target: Any) -> Any:
        """Return the compiled function for these types of arguments, or None."""
        place = folder()
        if place is None:
            return None
        path, key = self._entry(place, types, target.codegen())
        return _load(path, key, lambda content: _rebuild(content, target))

    def save_overload(self, types: Any, result: Any) -> None:
        """Keep a compiled function; do nothing if that is impossible."""
        place = folder()
        if place is None or result.lifted or result.library.has_dynamic_globals:
            return
        path, key = self._entry(place, types, result.codegen)
        try:
            content = _reduce(result)
        except RuntimeError as error:  # there is no compiled object
            # LLVM hands it over in a callback, where an exception is lost: as a rule, that of Ctrl-C.
            raise KeyboardInterrupt from error
        with contextlib.suppress(OSError):
            _save(path, key, content)

    def _entry(self, place: Path, types: Any, codegen: Any) -> tuple[Path, bytes]:
        """Return the file for these types on this machine, and the digest of everything it depends on."""
        import llvmlite
        from numba import __version__, config

        settings = (config.OPT, config.BOUNDSCHECK, config.DEBUGINFO_DEFAULT)
        machine = (sys.version, __version__, llvmlite.__version__, settings, codegen.magic_tuple())
        parts = repr((self._name, self._key, str(types), machine))
        return _place(place, self._name, parts)


def kept(name: str, parts: str, make: Callable[[], bytes]) -> bytes:
    """Return bytes from the cache, or make and keep them.

    Parameters
    ----------
    name : str
        Their name in the cache.
    parts : str
        Everything that the bytes depend on.
    make : callable
        Makes them if they are not in the cache.
    """
    folder_now = folder()
    if folder_now is None:
        return make()
    path, key = _place(folder_now, name, parts)
    if (found := _load(path, key, bytes)) is None:
        found = make()
        with contextlib.suppress(OSError):
            _save(path, key, found)
    return found


def _place(place: Path, name: str, parts: str) -> tuple[Path, bytes]:
    """Return the file for a result that depends on these parts, and their digest."""
    key = hashlib.sha256(parts.encode()).digest()
    return place / f"{name}-{key[:8].hex()}{_SUFFIX}", key


def _load(path: Path, key: bytes, rebuild: Callable[[bytes], Any]) -> Any:
    """Return a file's content; None if it is missing, or is damaged and therefore dropped."""
    try:
        content = _read(path, key)
        return None if content is None else rebuild(content)
    except Damaged as error:
        _remove(path)
        _warn(path, error)
        return None


def _save(path: Path, key: bytes, content: bytes) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    _write(path, key, content)
    trim(path.parent, LIMIT)


def _reduce(result: Any) -> bytes:
    from numba.core.serialize import dumps

    return dumps(result._reduce())


def _rebuild(content: bytes, target: Any) -> Any:
    import pickle

    from numba import __version__
    from numba.core.compiler import CompileResult
    from numba.core.runtime import rtsys

    # Loaded code needs Numba's memory system but no compiler. Preparing the compiler too would take longer
    # than all the rest. The needs of newer versions of Numba are not known.
    if tuple(map(int, __version__.split(".")[:2])) <= _KNOWN:
        rtsys.initialize(target)
    else:
        target.refresh()
    try:
        return CompileResult._rebuild(target, *pickle.loads(content))
    except Exception as error:  # intact, but in a format that this Numba does not read
        raise Damaged(f"{type(error).__name__}: {error}") from error


def _read(path: Path, key: bytes | None) -> bytes | None:
    """Return the content written for a key; None if it cannot be read, `Damaged` if it does not match."""
    try:
        with open(path, "rb", opener=_open_now) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise Damaged("it is not a regular file")
            if status.st_size > LIMIT:
                raise Damaged("it is too long")
            data = file.read()
    except IsADirectoryError as error:
        raise Damaged("it is a folder") from error
    except OSError:
        return None
    head, digest, content = data[: len(_MAGIC) + 32], data[len(_MAGIC) + 32 :][:32], data[len(_MAGIC) + 64 :]
    if not head.startswith(_MAGIC) or hashlib.sha256(head + content).digest() != digest:
        raise Damaged("its digest does not match its content")
    if key is not None and head != _MAGIC + key:
        raise Damaged("it belongs to another function")
    if time.time() - status.st_mtime > _DAY:
        with contextlib.suppress(OSError):
            os.utime(path)
    return content


def _open_now(path: str, flags: int) -> int:
    """Open a file without waiting, so that a pipe in its place cannot block."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _write(path: Path, key: bytes, content: bytes) -> None:
    """Write a file atomically: readers find all of it or nothing."""
    head = _MAGIC + key
    descriptor, name = tempfile.mkstemp(_SUFFIX, "new-", path.parent)
    try:
        with open(descriptor, "wb") as file:
            file.write(head + hashlib.sha256(head + content).digest() + content)
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def _remove(path: Path) -> bool:
    """Remove a file, or an empty folder in its place, and return whether that succeeded."""
    for remove in (os.unlink, os.rmdir):
        with contextlib.suppress(OSError):
            remove(path)
            return True
    return False


def _warn(path: Path, error: Damaged) -> None:
    """Warn of the first damaged file."""
    global _warned
    if not _warned:
        _warned = True
        warnings.warn(
            f"compiled code in {path} is damaged: {error}; the file is dropped and compiled again. "
            "`lag-envs cache` checks all files, `lag-envs cache --clear` deletes them",
            RuntimeWarning,
            stacklevel=2,
        )
