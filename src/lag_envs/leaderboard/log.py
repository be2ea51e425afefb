"""The board's log: a file with one line of JSON for each event, only ever appended to.

Each event holds, as ``prev``, the SHA-256 of all that precedes its line. So nothing in the log can be changed
without changing every later line, and the log's own SHA-256 (``sha256sum board.jsonl``), its head, stands for
all of it. The lines of protocol 1 are older than this; the first line with a hash covers them.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, TypeAdapter, model_validator

from lag_envs.errors import UserError
from lag_envs.leaderboard import fields
from lag_envs.leaderboard.fields import Strict, between, checked, shown_ascii
from lag_envs.leaderboard.files import read_plain

LOG = "board.jsonl"
#: Largest log [bytes].
MOST = 2**26
STATES = ("pending", "verified", "rejected", "superseded", "withdrawn")
REMEDY = "restore it from version control"
#: Times all have one length and are in UTC, so that they sort as text; none is too far ahead for any clock.
TIME = r"(19|20|21)[0-9]{2}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}\.[0-9]{6}\+00:00"


class BoardError(UserError):
    """A request that the board cannot fulfil; the text says why, and what to do."""


# --- events -------------------------------------------------------------------------------------------------


def _timestamp(text: str) -> str:
    if not re.fullmatch(TIME, text):
        raise ValueError("a time before the year 2200 is needed, such as 2026-01-31T12:00:00.000000+00:00")
    datetime.fromisoformat(text)
    return text


Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9]+(-[A-Za-z0-9]+)*$", max_length=200)]
EnvId = Annotated[str, Field(pattern=r"^[A-Za-z0-9]+-v(0|[1-9][0-9]{0,3})$", max_length=80)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Name = Annotated[str, fields.line(80, least=1)]
Text = Annotated[str, fields.line(1_000)]
#: Sums of such numbers cannot overflow.
Number = Annotated[float, between(-1e15, 1e15)]
Positive = Annotated[float, between(0.0, 1e15)]
Timestamp = Annotated[str, AfterValidator(_timestamp)]
#: A nonce's source if it is a commit of the repository that contains the board.
COMMIT = "commit"


class Event(Strict):
    """The fields of all events: the time (UTC), and the hash of the log before it."""

    at: Timestamp
    prev: Hash | None = None


class LoggedScale(Strict):
    """The mean returns with scores 0 and 1, frozen when a protocol begins."""

    random: Number
    best: Number
    policy: Name

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if self.best - self.random < 1e-9:
            raise ValueError("the best return must be above that of random actions")
        return self


class LoggedReference(Strict):
    """The controller that plays the same episodes as the submissions, its mean return and its error."""

    controller: Name
    mean: Number
    error: Positive
    episodes: Annotated[int, between(1, 10**9)]


class Rules(Strict):
    """The rules of a verification: episodes, policies of a learner, and what counts as success."""

    episodes: Annotated[int, between(1, 10**6)]
    disturbed_episodes: Annotated[int, between(1, 10**6)]
    learned_policies: Annotated[int, between(1, 1000)]
    success: dict[EnvId, Text]


class Protocol(Event):
    """A protocol begins: the meaning of a score from here on. All that counts must be verified again."""

    event: Literal["protocol"]
    number: Annotated[int, between(1, 10**6)]
    rules: Rules
    scales: dict[EnvId, LoggedScale]
    references: dict[EnvId, LoggedReference]


class Opened(Event):
    """New boards join the current protocol; results on the others stay."""

    event: Literal["opened"]
    number: Annotated[int, between(1, 10**6)]
    success: dict[EnvId, Text]
    scales: dict[EnvId, LoggedScale]
    references: dict[EnvId, LoggedReference]


class Added(Event):
    """A submission was added, perhaps again after it was rejected or withdrawn."""

    event: Literal["added"]
    id: Id
    env: EnvId
    protocol: Annotated[int, between(1, 10**6)]
    name: Name
    authors: Annotated[list[Name], Field(min_length=1, max_length=20)]
    kind: Literal["learned", "controller", "optimal"]
    digest: Hash


class Nonce(Event):
    """A nonce was published; its source is `COMMIT`, an address, or empty."""

    event: Literal["nonce"]
    value: Annotated[str, Field(pattern=r"^[!-~]{1,200}$")]
    source: Annotated[str, Field(pattern=r"^(commit|https://[!-~]{1,300})?$")] = ""


class Alike(Strict):
    """Another submission that acts alike: root mean squares of the differences, see `alike`."""

    id: Id
    actions: Positive
    returns: Positive


class Verified(Event):
    """A submission was verified and its result kept; it replaces the same authors' others of that name."""

    event: Literal["verified"]
    id: Id
    nonce: Annotated[str, Field(pattern=r"^[!-~]{1,200}$")]
    sha256: Hash
    supersedes: list[Id]
    alike: list[Alike] = Field(default_factory=list)


class Rejected(Event):
    """Verification found a reason to reject a submission."""

    event: Literal["rejected"]
    id: Id
    reason: Text


class Withdrawn(Event):
    """A submission was taken off the board."""

    event: Literal["withdrawn"]
    id: Id
    reason: Text


AnyEvent = Annotated[
    Protocol | Opened | Added | Nonce | Verified | Rejected | Withdrawn, Field(discriminator="event")
]
_EVENTS: TypeAdapter[Any] = TypeAdapter(AnyEvent)


def load_json(content: bytes) -> Any:
    """Return the data in JSON text (UTF-8); refuse repeated keys, NaN and infinity.

    Raises
    ------
    ValueError
        If it is not JSON, or nested too deeply.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError("a key occurs twice")
        return found

    def constant(name: str) -> Any:
        raise ValueError(f"{name} is not a number in JSON")

    try:
        return json.loads(content.decode(), object_pairs_hook=once, parse_constant=constant)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


@dataclass(frozen=True)
class LogLine:
    """An event and the number of its line, from 1."""

    number: int
    event: Any


def parse(log: bytes) -> tuple[list[LogLine], bytes]:
    """Return the events of a log, and the torn end that a kill may have left.

    Raises
    ------
    BoardError
        If any line but the last is not an event, which no kill causes, or does not hold the hash of the lines
        before it.
    """
    *whole, tail = log.split(b"\n")
    before, chained = hashlib.sha256(), False
    lines: list[LogLine] = []
    for number, line in enumerate([*whole, tail], 1):
        last = number > len(whole)
        if line.strip():
            try:
                event = checked(_EVENTS, load_json(line))
            except ValueError as error:
                if last:
                    return lines, tail
                told = shown_ascii(line[:60].decode(errors="replace"))
                raise _damaged(number, f"is not an event ({error}): {told}") from None
            if chained and event.prev is None:
                raise _damaged(number, "holds no hash of the lines before it")
            if event.prev is not None and event.prev != before.hexdigest():
                raise _damaged(number, "does not follow the lines before it: one of those was changed")
            chained = event.prev is not None
            lines.append(LogLine(number, event))
        before.update(line if last else line + b"\n")
    return lines, b""


def _damaged(number: int, what: str) -> BoardError:
    return BoardError(f"{LOG}, line {number} {what}; {REMEDY}, or remove what a merge left there")


# --- the state that follows ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class BoardEntry:
    """A submission on the board of a protocol.

    Parameters
    ----------
    id, env, name, kind, digest : str
        Its id on the board, and statements of its files.
    protocol : int
        The protocol's number.
    authors : tuple of str
        Who submitted it.
    added : str
        When it was first added, in UTC.
    line : int
        The line of the log that first added it.
    since : int
        Nonces after this line count for it: the line that added it, or the one that began the protocol.
    state : str
        One of `STATES`.
    reason : str
        Why it was rejected, superseded or withdrawn.
    nonce, sha256 : str
        The nonce of its first verification, and the SHA-256 of the result's file.
    alike : tuple of Alike
        Submissions that act alike, as found when it was verified.
    """

    id: str
    env: str
    protocol: int
    name: str
    authors: tuple[str, ...]
    kind: str
    digest: str
    added: str
    line: int
    since: int
    state: str = "pending"
    reason: str = ""
    nonce: str = ""
    sha256: str = ""
    alike: tuple[Alike, ...] = ()


@dataclass
class BoardState:
    """The state that follows from the log."""

    #: The current protocol; 0 where there is none yet.
    number: int = 0
    #: What each protocol fixed, with the boards that joined it. In an old log, protocol 1 states it late or
    #: not yet.
    protocols: dict[int, Protocol] = field(default_factory=dict)
    #: The submissions under each protocol, by id.
    boards: dict[int, dict[str, BoardEntry]] = field(default_factory=dict)
    #: Line, value and source of each nonce.
    nonces: list[tuple[int, str, str]] = field(default_factory=list)
    last: str = ""

    @property
    def entries(self) -> dict[str, BoardEntry]:
        """The submissions under the current protocol, by id."""
        return self.boards.setdefault(self.number, {})

    @property
    def all(self) -> list[BoardEntry]:
        """All entries, those under earlier protocols first."""
        return [entry for number in sorted(self.boards) for entry in self.boards[number].values()]

    def entry(self, id: str) -> BoardEntry:
        """Return an entry under the current protocol, or raise a BoardError."""
        if id not in self.entries:
            raise BoardError(
                f"there is no {shown_ascii(id)} on the board; `lag-envs leaderboard list` names all"
            )
        return self.entries[id]

    def nonce(self, entry: BoardEntry) -> str | None:
        """Return the first nonce that was published after a submission was added."""
        return next((value for line, value, _ in self.nonces if line > entry.since), None)

    def waiting(self) -> list[BoardEntry]:
        """Return what is pending, the oldest first."""
        return [entry for entry in self.entries.values() if entry.state == "pending"]

    def first(self, entry: BoardEntry) -> BoardEntry | None:
        """Return the first submission that acts like this one; None if it is the first itself.

        Likeness is noted in the entry that was verified later, but links lead from the submission that was
        added later to the earlier one. Links are followed to their end.
        """
        board = self.boards[entry.protocol]
        others = {like.id for like in entry.alike}
        others |= {other.id for other in board.values() if any(a.id == entry.id for a in other.alike)}
        older = [board[id] for id in others if id in board and board[id].line < entry.line]
        if not older:
            return None
        oldest = min(older, key=lambda other: other.line)
        return self.first(oldest) or oldest


def fold(lines: Sequence[LogLine]) -> BoardState:
    """Return the state that follows from events.

    Raises
    ------
    BoardError
        If an event contradicts those before it; the text names its line.
    """
    state = BoardState()
    for line in lines:
        try:
            _apply(state, line.event, line.number)
        except ValueError as error:
            raise BoardError(f"{LOG}, line {line.number}: {error}; {REMEDY}") from None
    return state


def _apply(state: BoardState, event: Any, line: int) -> None:
    """Apply one event to the state; raise a ValueError if it cannot follow."""
    if event.at < state.last:
        raise ValueError(f"{event.at} is earlier than the line before it")
    state.last = event.at
    if isinstance(event, Protocol):
        _begin(state, event, line)
    elif isinstance(event, Opened):
        _join(state, event)
    elif isinstance(event, Nonce):
        if any(event.value == value for _, value, _ in state.nonces):
            raise ValueError(f"the nonce {shown_ascii(event.value)} was published before, so it was known")
        state.nonces.append((line, event.value, event.source))
    elif isinstance(event, Added):
        _add(state, event, line)
    else:
        _change(state, event)


def _begin(state: BoardState, event: Protocol, line: int) -> None:
    known = state.number in state.protocols
    wanted = state.number + 1 if known or not state.number else state.number
    if event.number != wanted:
        raise ValueError(f"protocol {event.number} begins, but the next would be {wanted}")
    state.protocols[event.number] = event
    if not known:  # the first protocol, or one that began before its line was written
        state.number = event.number
        return
    carried = {}
    for id, entry in list(state.entries.items()):
        if entry.env in event.scales and entry.state in ("verified", "pending"):
            carried[id] = replace(
                entry, protocol=event.number, since=line, state="pending", reason="", nonce="", sha256="",
                alike=(),
            )  # fmt: skip
            if entry.state == "pending":
                del state.entries[id]
    state.number = event.number
    state.boards[event.number] = carried


def _join(state: BoardState, event: Opened) -> None:
    known = state.protocols.get(state.number)
    if known is None or event.number != state.number:
        raise ValueError(f"boards join protocol {event.number}, but the current one is {state.number}")
    if there := sorted(set(event.scales) & set(known.scales)):
        raise ValueError(f"{there[0]} joins protocol {event.number}, but already has a board there")
    rules = known.rules.model_copy(update={"success": event.success | known.rules.success})
    scales, references = known.scales | event.scales, event.references | known.references
    state.protocols[state.number] = known.model_copy(
        update={"rules": rules, "scales": scales, "references": references}
    )


def _add(state: BoardState, event: Added, line: int) -> None:
    if not state.number:  # a log from before protocols had lines
        state.number = 1
    if event.protocol != state.number:
        raise ValueError(
            f"{event.id} is added under protocol {event.protocol}, but the current one is {state.number}"
        )
    known = state.entries.get(event.id)
    told = {key: getattr(event, key) for key in ("env", "protocol", "name", "kind", "digest")}
    if known is None:
        state.entries[event.id] = BoardEntry(
            event.id, **told, authors=tuple(event.authors), added=event.at, line=line, since=line
        )
        return
    if known.state not in ("rejected", "withdrawn"):
        raise ValueError(f"{event.id} is added, but is already on the board, {known.state}")
    if any(getattr(known, key) != value for key, value in told.items()):
        raise ValueError(f"{event.id} is added again with other data")
    # Adding it again changes neither the episodes nor the result, if there is one.
    back = replace(known, state="verified" if known.sha256 else "pending", reason="")
    newer = [
        other.id
        for other in state.entries.values()
        if other.state == "verified" and other.line > known.line and same_agent(other, known)
    ]
    if known.sha256 and newer:
        back = replace(back, state="superseded", reason=f"by {newer[-1]}")
    state.entries[event.id] = back


def _change(state: BoardState, event: Verified | Rejected | Withdrawn) -> None:
    known = state.entries.get(event.id)
    if known is None:
        raise ValueError(f"{event.id} is {event.event}, but was never added; restore the line that adds it")
    if isinstance(event, Withdrawn):
        if known.state == "withdrawn":
            raise ValueError(f"{event.id} is withdrawn, but was withdrawn already")
        state.entries[event.id] = replace(known, state="withdrawn", reason=event.reason)
        return
    if known.state != "pending":
        raise ValueError(f"{event.id} is {event.event}, but was {known.state} already")
    if isinstance(event, Rejected):
        state.entries[event.id] = replace(known, state="rejected", reason=event.reason)
        return
    if event.nonce != state.nonce(known):
        raise ValueError(
            f"{event.id} is verified with the nonce {shown_ascii(event.nonce)}, which is not its own"
        )
    for old in [*event.supersedes, *(like.id for like in event.alike)]:
        other = state.entries.get(old)
        if other is None or old == event.id or not other.sha256 or other.env != known.env:
            raise ValueError(
                f"{event.id} is verified in place of {old}, which is not another result of its board"
            )
    state.entries[event.id] = replace(
        known, state="verified", nonce=event.nonce, sha256=event.sha256, alike=tuple(event.alike)
    )
    for old in event.supersedes:
        other = state.entries[old]
        if other.state != "verified" or not same_agent(other, known):
            raise ValueError(f"{event.id} supersedes {old}, which has another name or other authors")
        state.entries[old] = replace(other, state="superseded", reason=f"by {event.id}")


def same_agent(entry: BoardEntry, other: BoardEntry) -> bool:
    """Return whether two entries have the same authors and name, on the same board."""
    return (entry.env, entry.name, sorted(entry.authors)) == (other.env, other.name, sorted(other.authors))


# --- files and locks ----------------------------------------------------------------------------------------


def read_log(path: Path) -> bytes:
    """Return a log's content; empty if there is none.

    Raises
    ------
    BoardError
        If it is not a plain file.
    """
    try:
        return read_plain(path, MOST)
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise BoardError(f"{path} cannot be read: {error.strerror}; {REMEDY}") from None


@contextmanager
def locked(path: Path) -> Iterator[int]:
    """Open a file for reading and appending, and hold its lock, which ends with the process at the latest."""
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0)
    while True:
        read_log(path)  # refuses anything but a plain file before it is opened for writing
        log = os.open(path, flags, 0o644)
        try:
            lock(log)
            # Version control may have replaced the file while we waited.
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
    """Lock an open file until it is closed; return whether that worked."""
    try:
        if sys.platform == "win32":
            import msvcrt

            # A lock on Windows also blocks reading the locked bytes, so lock one far beyond the end.
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


def write_event(log: int, told: dict[str, Any]) -> None:
    """Append an event as a line and flush it to the disk, all or nothing.

    Raises
    ------
    BoardError
        For an event that could not be read back.
    """
    content = read_all(log)
    _, torn = parse(content)
    if torn:
        os.ftruncate(log, len(content) - len(torn))
        content = content[: -len(torn)]
    line = b"\n" if content and not content.endswith(b"\n") else b""
    told = told | {"prev": hashlib.sha256(content + line).hexdigest()}
    try:
        checked(_EVENTS, told)
    except ValueError as error:
        raise BoardError(f"this cannot be logged: {error}") from None
    line += json.dumps(told, ensure_ascii=False).encode() + b"\n"
    try:
        if os.write(log, line) < len(line):
            raise OSError(errno.ENOSPC, "the disk is full")
    except OSError:
        os.ftruncate(log, len(content))
        raise
    os.fsync(log)
