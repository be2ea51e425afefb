"""The board's log: a file of events, a line of JSON for each, only ever appended to."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

LOG = "board.jsonl"
STATES = ("pending", "verified", "rejected", "superseded", "withdrawn")
#: What an event must say besides when and what it is.
EVENTS: dict[str, dict[str, type]] = {
    "added": {
        "id": str, "env": str, "protocol": int, "name": str, "authors": list, "kind": str, "digest": str,
    },
    "nonce": {"value": str},
    "verified": {"id": str, "nonce": str, "sha256": str, "supersedes": list},
    "rejected": {"id": str, "reason": str},
    "withdrawn": {"id": str, "reason": str},
}  # fmt: skip
ID = re.compile(r"[A-Za-z0-9]+(-[A-Za-z0-9]+)*")
#: All of one length and in UTC, so that they sort as text.
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}\+00:00")

Event = dict[str, Any]


class BoardError(Exception):
    """What is asked of the board cannot be done; the text says why, and what to do."""


# --- what the log says --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entry:
    """A submission on the board.

    Parameters
    ----------
    id, env, name, kind, digest : str
        Its id on the board, and what its files say.
    protocol : int
        Version of the protocol under which it was added.
    authors : tuple of str
        Who submitted it.
    added : str
        When it was added, in UTC.
    state : str
        One of `STATES`.
    reason : str
        Why it was rejected, superseded or withdrawn.
    nonce, sha256 : str
        With which nonce it was verified, and the SHA-256 of the result's file.
    """

    id: str
    env: str
    protocol: int
    name: str
    authors: tuple[str, ...]
    kind: str
    digest: str
    added: str
    state: str = "pending"
    reason: str = ""
    nonce: str = ""
    sha256: str = ""


@dataclass
class State:
    """What follows from the log."""

    entries: dict[str, Entry] = field(default_factory=dict)
    #: When each nonce was published, and its value.
    nonces: list[tuple[str, str]] = field(default_factory=list)
    last: str = ""

    def entry(self, id: str) -> Entry:
        """Return an entry, or raise a BoardError."""
        if id not in self.entries:
            raise BoardError(f"there is no {id!r} on the board; `lag-envs leaderboard list` names all")
        return self.entries[id]

    def nonce(self, entry: Entry) -> str | None:
        """Return the first nonce that was published after a submission was added."""
        return next((value for at, value in self.nonces if at > entry.added), None)

    def waiting(self) -> list[Entry]:
        """Return what is pending, the oldest first."""
        return [entry for entry in self.entries.values() if entry.state == "pending"]


def parse(log: bytes) -> tuple[list[Event], bytes]:
    """Return the events of a log, and the end that was torn off by a kill.

    Raises
    ------
    BoardError
        Where another line than the last is no event: no kill does that.
    """
    *lines, tail = log.split(b"\n")
    events = [_event(line, number) for number, line in enumerate(lines, 1) if line.strip()]
    try:
        if tail:  # a whole event of which only the line's end is missing
            events.append(_event(tail, len(lines) + 1))
            tail = b""
    except BoardError:
        pass
    return events, tail


def _event(line: bytes, number: int) -> Event:
    try:
        event = json.loads(line)
        wanted = {"at": str} | EVENTS[event["event"]]
        for key, kind in wanted.items():
            if not isinstance(event[key], kind):
                raise TypeError(f"{key} is {event[key]!r}")
        if "id" in wanted and not ID.fullmatch(event["id"]):
            raise ValueError(f"id is {event['id']!r}")
        if not TIME.fullmatch(event["at"]):
            raise ValueError(f"at is {event['at']!r}")
        datetime.fromisoformat(event["at"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        shown = line[:60].decode(errors="replace")
        raise BoardError(
            f"{LOG}, line {number} is no event ({type(error).__name__}: {error}): {shown!r}; restore it from"
            " version control, or remove what a merge left there"
        ) from None
    return event


def fold(events: Sequence[Event]) -> State:
    """Return what follows from events.

    A merge of two logs may shuffle their lines, so the times count, not the order.

    Raises
    ------
    BoardError
        Where an event speaks of a submission that was never added.
    """
    state = State()
    for event in sorted(events, key=lambda e: (e["at"], e["event"] != "added")):
        kind, state.last = event["event"], event["at"]
        if kind == "nonce":
            state.nonces.append((event["at"], event["value"]))
            continue
        id = event["id"]
        known = state.entries.get(id)
        if kind == "added":
            # Two people may have added the same; what was turned away may be added once more.
            if known is None or known.state in ("rejected", "withdrawn"):
                told = {key: event[key] for key in ("env", "protocol", "name", "kind", "digest")}
                state.entries[id] = Entry(id, **told, authors=tuple(event["authors"]), added=event["at"])
            continue
        if known is None:
            raise BoardError(f"{LOG}: {id} is {kind}, and was never added; restore the line that adds it")
        if kind == "withdrawn":
            state.entries[id] = replace(known, state=kind, reason=event["reason"])
        elif known.state == "pending" and kind == "rejected":
            state.entries[id] = replace(known, state=kind, reason=event["reason"])
        elif known.state == "pending":
            state.entries[id] = replace(known, state=kind, nonce=event["nonce"], sha256=event["sha256"])
            for old in event["supersedes"]:
                if old != id and old in state.entries and state.entries[old].state == "verified":
                    state.entries[old] = replace(state.entries[old], state="superseded", reason=f"by {id}")
    return state


# --- files and locks ----------------------------------------------------------------------------------------


@contextmanager
def locked(path: Path) -> Iterator[int]:
    """Open a file for reading and appending, and hold its lock, which ends with the process at the latest."""
    while True:
        log = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
        try:
            lock(log)
            # Version control may have put another file there while we waited.
            try:
                same = os.path.samestat(os.fstat(log), os.stat(path))
            except FileNotFoundError:
                same = False
            if same:
                yield log
                return
        finally:
            os.close(log)


def lock(file: int, wait: bool = True) -> bool:
    """Lock an open file until it is closed; return whether it could be had."""
    try:
        if sys.platform == "win32":
            import msvcrt

            # There a lock keeps others from reading what it covers, so it covers a byte far beyond the end.
            os.lseek(file, 2**62, os.SEEK_SET)
            mode = msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK
            msvcrt.locking(file, mode, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        if wait:
            raise
        return False
    return True


def read_all(file: int) -> bytes:
    """Return the content of an open file."""
    os.lseek(file, 0, os.SEEK_SET)
    parts = []
    while part := os.read(file, 1 << 20):
        parts.append(part)
    return b"".join(parts)


def write_event(log: int, event: Event) -> None:
    """Append an event as a line, and see it to the disk; all of it or nothing."""
    content = read_all(log)
    _, torn = parse(content)
    if torn:
        os.ftruncate(log, len(content) - len(torn))
        content = content[: -len(torn)]
    line = json.dumps(event, ensure_ascii=False).encode() + b"\n"
    if content and not content.endswith(b"\n"):
        line = b"\n" + line
    try:
        if os.write(log, line) < len(line):
            raise OSError("the disk is full")
    except OSError:
        os.ftruncate(log, len(content))
        raise
    os.fsync(log)
