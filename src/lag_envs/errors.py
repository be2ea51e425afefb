"""Errors that commands show without a traceback, and hints for names that do not exist."""

import difflib
import inspect
import io
import os
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import CodeType, MappingProxyType
from typing import Any


class UserError(Exception):
    """A user's mistake; only its text is shown, without a traceback."""


def run_shown(program: str, run: Callable[[], int]) -> int:
    """Run a command, show its errors in a line, and treat SIGTERM like Ctrl-C; return its exit status.

    The status is 2 for a `UserError`, 1 if the system refuses something, as when a disk is full, and 130 if
    the command is interrupted. Characters that the output's encoding lacks are written as question marks.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    with terminable():
        try:
            status = run()
            sys.stdout.flush()  # if that fails, it is reported below, not by Python at exit
            return status
        except UserError as error:
            print(f"{program}: error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            return 130
        except OSError as error:
            if isinstance(error, BrokenPipeError) and error.filename is None:
                _drop_output()  # the reader, such as `head`, has left
                return 0
            try:
                sys.stdout.flush()
            except OSError:
                _drop_output()
            print(f"{program}: error: {reason(error)}", file=sys.stderr)
            return 1


def _drop_output() -> None:
    """Discard all further standard output, even that written at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def reason(error: OSError) -> str:
    """Return what the operating system refused, and for which file.

    Examples
    --------
    >>> reason(FileNotFoundError(2, "No such file or directory", "speed.json"))
    'speed.json: No such file or directory'
    >>> reason(OSError(28, "No space left on device")), reason(OSError("no luck"))
    ('No space left on device', 'no luck')
    """
    if error.strerror is None:
        return str(error)
    return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"


def fault(path: str, file: str, error: Exception) -> str:
    """Describe in one line what went wrong when a file was run, and in which line of the file.

    Parameters
    ----------
    path : str
        The file's name for the message.
    file : str
        The file's name in Python's traceback.
    error : Exception
        The exception that was raised.
    """
    if isinstance(error, SyntaxError) and error.filename == file:
        return f"{path}, line {error.lineno}: {type(error).__name__}: {error.msg}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    where = f"{path}, line {lines[-1]}" if lines else path
    return f"{where}: {type(error).__name__}: {error}"


def one_line(error: BaseException, most: int = 200) -> str:
    """Return an error's kind and text as one line of at most the given number of characters."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:most]


@contextmanager
def terminable() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second SIGTERM must not interrupt the saving
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def hint(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return the known names that might be meant, or a text that says where to find them.

    Parameters
    ----------
    name : str
        The unknown name.
    known : iterable of str
        The names that exist.
    otherwise : str, optional
        The text if no name is close; by default all known names.

    Examples
    --------
    >>> hint("PivotedBra-v0", ["PivotedBar-v0", "Acrobot-v1"])
    'did you mean PivotedBar-v0?'
    >>> hint("bat", ["bar", "ball", "cat"])
    'did you mean cat, bar or ball?'
    >>> hint("Nope-v0", ["PivotedBar-v0", "Acrobot-v1"], "see the list")
    'see the list'
    """
    # Without this, the version at the end of ids would make any two of them similar.
    known = list(known)
    names = {_without_version(k): k for k in known}
    close = [names[c] for c in difflib.get_close_matches(_without_version(name), names, n=3, cutoff=0.5)]
    if close:
        *others, last = close
        return f"did you mean {', '.join(others) + ' or ' if others else ''}{last}?"
    return otherwise or f"available: {', '.join(known)}"


def _without_version(name: str) -> str:
    return re.sub(r"-v\d+$", "", name.lower())


def warn_of_misspelt(kind: type, base: type, instead: Mapping[str, str] = MappingProxyType({})) -> None:
    """Warn of names in a class that resemble names of its base and that no method of the class uses.

    Such a name would be ignored without a word: with ``disipation`` there would be no dissipation. A method
    that takes ``xp``, as formulas do, is named whatever it is called. Base classes from this package are not
    searched.

    Parameters
    ----------
    kind, base : type
        The class, and the class that it is derived from.
    instead : mapping, optional
        Further names that are ignored, with what to write in their place.
    """
    classes = kind.__mro__[: kind.__mro__.index(base)]
    theirs = [c for c in classes if not c.__module__.startswith("lag_envs.")]
    if not theirs:
        return
    known = [name for name in dir(base) if not name.startswith("_")]
    used = {name for c in classes for value in vars(c).values() for name in _names_in(value)}
    for c in theirs:
        for name in vars(c):
            if name.startswith("_") or name in known or name in used:
                continue
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.8)
            if name in instead or close:
                meant = f"write {instead[name]}" if name in instead else f"did you mean {close[0]}?"
                warnings.warn(f"nothing uses {c.__name__}.{name}; {meant}", UserWarning, stacklevel=2)
            elif inspect.isfunction(vars(c)[name]) and "xp" in inspect.signature(vars(c)[name]).parameters:
                like = f"though it takes xp as the formulas of a {base.__name__} do; is its name right?"
                warnings.warn(f"nothing uses {c.__name__}.{name}, {like}", UserWarning, stacklevel=2)


def _names_in(value: Any) -> Iterator[str]:
    """Return the names that a method's or property's code refers to."""
    function = getattr(value, "fget", None) or getattr(value, "func", None) or value
    codes = [getattr(getattr(function, "__func__", function), "__code__", None)]
    while codes:
        code = codes.pop()
        if isinstance(code, CodeType):
            yield from code.co_names
            codes += code.co_consts
