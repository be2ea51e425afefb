"""A board's log compared with what others have of it: a release's pin, and earlier commits.

One thing cannot be detected: a history rewritten as a whole, commits and all, when nobody has an older copy,
a release or its pin to compare with.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Annotated

from pydantic import Field

from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.fields import Strict, checked, shown_ascii
from lag_envs.leaderboard.files import read_plain
from lag_envs.leaderboard.log import LOG, MOST, REMEDY, BoardError, Hash, load_json, read_log

#: The release's record of the repository's board.
PIN = Path(__file__).with_name("pin.json")


@dataclass
class Finding:
    """What a check found: a summary if all is well, and everything that is wrong."""

    name: str
    told: str = ""
    wrong: list[str] = field(default_factory=list)
    #: Why the check could not be made, and who could make it.
    open: str = ""


class Pin(Strict):
    """The head of a log's chain: its number of lines, the hash of the first line, and that of all of them."""

    board: Hash
    lines: Annotated[int, Field(ge=1)]
    head: Hash


def pin_of(log: bytes) -> Pin:
    """Return a release's pin of a log."""
    first = hashlib.sha256(log[: log.index(b"\n") + 1]).hexdigest()
    return Pin(board=first, lines=log.count(b"\n"), head=hashlib.sha256(log).hexdigest())


def pinned(board: Board, log: bytes, file: Path | None) -> Finding:
    """Compare the log with a pin; with the release's own only if it is of the same board."""
    found = Finding("pin")
    path = file or PIN
    try:
        pin = checked(Pin, load_json(read_plain(path, MOST)))
    except FileNotFoundError:
        if file is not None:
            found.wrong.append(f"{path} is missing")
        found.open = "there is none"
        return found
    except (OSError, ValueError) as error:
        told = error.strerror if isinstance(error, OSError) else error
        found.wrong.append(f"{path} is not a pin: {told}; {REMEDY}")
        return found
    lines = log.split(b"\n")
    if file is None and hashlib.sha256(lines[0] + b"\n").hexdigest() != pin.board:
        found.open = "this is not the board that this release knows: the log begins with another line"
        return found
    begun = b"\n".join(lines[: pin.lines]) + b"\n"
    if len(lines) <= pin.lines:
        found.wrong.append(
            f"{board.log} has {len(lines) - 1} lines, but {path} pins {pin.lines}: some were removed;"
            f" {REMEDY}"
        )
    elif hashlib.sha256(begun).hexdigest() != pin.head:
        found.wrong.append(
            f"{board.log} is not what {path} pins: one of the first {pin.lines} lines was changed; {REMEDY}"
        )
    else:
        found.told = f"the first {pin.lines} lines are those that {path.name} pins"
    return found


class NoHistory(Exception):
    """There is no history to look at; the text says why."""


def git(folder: Path, *arguments: str) -> bytes:
    """Return git's output in a folder; raise NoHistory if it fails or is missing."""
    # Ignore the caller's repository settings and replaced objects.
    env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    env |= {"GIT_NO_REPLACE_OBJECTS": "1", "GIT_OPTIONAL_LOCKS": "0", "LC_ALL": "C"}
    try:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, check=True, capture_output=True, env=env, timeout=60).stdout
    except FileNotFoundError:
        raise NoHistory("git is not installed") from None
    except subprocess.TimeoutExpired:
        raise NoHistory("git takes more than a minute") from None
    except subprocess.CalledProcessError as error:
        said = error.stderr.decode(errors="replace").strip().split("\n")[0]
        raise NoHistory(f"git says {shown_ascii(said)}") from None


def log_at(folder: Path, commit: str) -> bytes:
    """Return the log in a commit; empty if it has none."""
    name = f"{commit}:./{LOG}"
    try:
        return git(folder, "cat-file", "blob", name)
    except NoHistory:
        git(folder, "cat-file", "-e", f"{commit}^{{commit}}")  # otherwise the commit itself is missing
        return b""


def history(board: Board, log: bytes) -> Finding:
    """Compare the log with its versions in earlier commits: each must be the beginning of today's."""
    found = Finding("history")
    folder = board.folder
    try:
        listed = ["log", "--full-history", "--format=%H"]
        local = git(folder, *listed, "HEAD", "--", f"./{LOG}").decode().split()
        tagged = git(folder, *listed, "HEAD", "--tags", "--", f"./{LOG}").decode().split()
        if not tagged:
            raise NoHistory("no commit holds the board")
        before = 0
        for commit in tagged:
            then = log_at(folder, commit)
            # A tagged release may be newer than the checkout.
            if log.startswith(then) or (commit not in local and then.startswith(log)):
                continue
            if b'"prev"' not in then:
                before += 1  # a board that was begun again, before there was a chain
                continue
            pairs = zip_longest(then.split(b"\n")[:-1], log.split(b"\n")[:-1])
            odd = next(i for i, (a, b) in enumerate(pairs, 1) if a != b)
            found.wrong.append(
                f"{board.log}, line {odd} is not what it was in commit {commit[:10]}: a log only"
                f" ever grows; `git checkout {commit[:10]} -- {board.log}` restores it"
            )
        found.told = f"{len(tagged) - before} earlier versions are the beginning of this one"
        if before:
            found.told += f"; {before} belong to boards that were started over before logs had a chain"
        if git(folder, "rev-parse", "--is-shallow-repository").strip() == b"true":
            found.told += "; the clone is shallow, so there may be more"
    except NoHistory as error:
        found.open = str(error)
    return found


def head_of(board: Board) -> str:
    """Return the commit that is checked out, which must contain the log as it is.

    Raises
    ------
    BoardError
        If it does not, or there is none.
    """
    try:
        commit = git(board.folder, "rev-parse", "--verify", "HEAD^{commit}").decode().strip()
        then = log_at(board.folder, commit)
    except NoHistory as error:
        raise BoardError(
            f"no commit holds the board ({error}); name a nonce and, with --source, where anybody can find it"
        ) from None
    if then != read_log(board.log):
        raise BoardError("the board has changed since the last commit; commit and push first")
    return commit
