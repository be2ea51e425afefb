"""A progress bar on a terminal, and nothing where output goes to a file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module


@contextmanager
def progress(total: int) -> Iterator[Callable[[str], None]]:
    """Show a progress bar on a terminal, tqdm's if it is installed; yields a function that advances it."""
    if not sys.stderr.isatty() or not total:
        yield lambda text: None
        return
    try:
        tqdm = import_module("tqdm").tqdm
    except ImportError:
        done = 0

        def advance(text: str) -> None:
            nonlocal done
            done += 1
            print(f"\r{100 * done // total:3d} % {text:60.60}", end="", file=sys.stderr, flush=True)

        yield advance
        print(f"\r{'':66}\r", end="", file=sys.stderr, flush=True)
        return
    with tqdm(total=total, leave=False, unit="", dynamic_ncols=True) as bar:

        def advance(text: str) -> None:
            bar.set_description_str(f"{text:40.40}", refresh=False)
            bar.update()

        yield advance
