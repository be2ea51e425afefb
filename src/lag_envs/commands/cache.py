"""``lag-envs cache``."""

from __future__ import annotations

import argparse
import sys

from lag_envs.commands.base import Command
from lag_envs.tables import aligned


def declare_cache(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``cache``."""
    parser.add_argument("--clear", action="store_true", help="remove all compiled code")


def run_cache(args: argparse.Namespace) -> int:
    """Show and check the compiled code on disk, or remove it."""
    from lag_envs.stepping import cache

    place = cache.folder()
    if place is None:
        print("There is no folder for caches: each process compiles what it uses.")
        return 0
    if args.clear:
        found = cache.cache_files(place)
        print(f"{place}: {cache.clear(place)} files removed", flush=True)
        if left := [entry.path for entry in found if entry.path.exists()]:
            print(f"lag-envs: error: {len(left)} could not be removed, such as {left[0]}", file=sys.stderr)
        return 1 if left else 0
    kept = cache.cache_files(place)
    size = sum(entry.size for entry in kept)
    rows = [
        ("folder", str(place)),
        ("functions", str(len(kept))),
        ("size", f"{size / 2**20:.1f} MiB of at most {cache.LIMIT / 2**20:.0f}"),
        ("writable", "yes" if cache.writable(place) else "no: each process compiles what is missing here"),
    ]
    damaged = [(str(entry.path), why) for entry in kept if (why := cache.damage(entry.path))]
    rows += [("damaged", str(len(damaged)) + (", compiled again when used next:" if damaged else ""))]
    print("\n".join(aligned(rows) + aligned([("  " + path, why) for path, why in damaged])))
    return 0


CACHE = Command(
    "cache",
    "show or clear the compiled code",
    """Show where compiled code is kept, how much of it there is, and whether it is intact. It is kept in
the user's cache folder, or in the folder named by the environment variable NUMBA_CACHE_DIR.

examples:
  lag-envs cache            show it
  lag-envs cache --clear    remove it; code is compiled again when needed""",
    declare_cache,
    run_cache,
)
