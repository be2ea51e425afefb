"""The board: its submissions, their verified results, and the state of each.

A folder, meant to lie in a git repository::

    board.jsonl                    the log: a line of JSON for every event, only ever appended to
    submissions/ID/                the submissions' files
    results/ID.json.gz             the verified result under protocol 1, and some recorded episodes
    results/protocol-N/ID.json.gz  the same under later protocols
    values/ENV.json                a coarse value function for the page, where there is one (optional)

All state follows from the log. A file is complete before the event about it is written, and an event is one
write under a lock, followed by fsync. So a kill at any moment loses nothing that was acknowledged, and leaves
a readable board; at worst the last line is torn off. Readers skip such a line, and the next writer removes
it.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import shlex
import shutil
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lag_envs import store
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.fields import shown_ascii
from lag_envs.leaderboard.files import read_plain
from lag_envs.leaderboard.log import (
    LOG,
    REMEDY,
    Alike,
    BoardEntry,
    BoardError,
    BoardState,
    Protocol,
    fold,
    lock,
    locked,
    parse,
    read_all,
    read_log,
    same_agent,
    write_event,
)
from lag_envs.leaderboard.results import PACKED, unpacked
from lag_envs.tasks import TASKS

if TYPE_CHECKING:
    from lag_envs.leaderboard.submission import About, Submission


#: The folder of the board unless another is named.
DEFAULT = Path("leaderboard")


def closed(env_id: str, number: int, current: int) -> str:
    """Return why the board of an environment and protocol is frozen; empty if it is open.

    Examples
    --------
    >>> closed("PivotedBar-v0", 2, 2)
    ''
    >>> closed("PivotedBar-v0", 1, 2), closed("Gone-v0", 2, 2)
    ('protocol 1 has ended, the current one is 2', 'there is no environment Gone-v0')
    """
    if number != current:
        return f"protocol {number} has ended, the current one is {current}"
    if env_id not in TASKS:
        return f"there is no environment {env_id}"
    name, version = _version(env_id)
    newer = max(other for base, other in map(_version, TASKS) if base == name)
    return f"{name}-v{newer} has taken its place" if newer > version else ""


def _version(env_id: str) -> tuple[str, int]:
    name, _, number = env_id.rpartition("-v")
    return name, int(number)


# --- the folder ---------------------------------------------------------------------------------------------


class Board:
    """A board in a folder.

    Parameters
    ----------
    folder : Path
        The folder; made when something is added.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self.log = self.folder / LOG

    @property
    def option(self) -> str:
        """The option that names the folder to a command, after a space; empty where it is the default."""
        return "" if self.folder == DEFAULT else f" --board {shlex.quote(str(self.folder))}"

    def exists(self) -> bool:
        """Return whether the folder holds a board; raise a BoardError if it is a file."""
        if self.folder.is_file():
            raise BoardError(f"{self.folder} is a file; a board is a folder")
        return os.path.lexists(self.log)

    def require(self) -> None:
        """Raise a BoardError if there is no board."""
        if not self.exists():
            raise BoardError(
                f"there is no board in {self.folder}. Give a board's folder with --board, or start one with "
                f"`lag-envs leaderboard add FOLDER{self.option}`"
            )

    def read(self) -> BoardState:
        """Return the state that follows from the log; other processes may be writing to it.

        Raises
        ------
        BoardError
            If there is no board, or its log is damaged.
        """
        self.require()
        # In this order: a process that adds the first submission writes to the log before it copies files.
        begun = self._has_submissions()
        return self._state(read_log(self.log), begun)

    def _has_submissions(self) -> bool:
        return any((self.folder / "submissions").glob("[!.]*"))

    def _state(self, content: bytes, begun: bool) -> BoardState:
        """Return the state that follows from the log's content; `begun` if there are submissions."""
        if begun and not content:
            raise BoardError(f"{self.log} is empty, though there are submissions; {REMEDY}")
        return fold(parse(content)[0])

    def submission(self, id: str) -> Path:
        """Return the folder of a submission's files."""
        return self.folder / "submissions" / id

    def result(self, entry: BoardEntry) -> dict[str, Any]:
        """Return a verified result; raise a BoardError if the file is not the one that was written then."""
        path = self.result_file(entry)
        try:
            content = read_plain(path, PACKED)
        except FileNotFoundError:
            raise BoardError(f"{path} is missing; {REMEDY}") from None
        except OSError as error:
            raise BoardError(f"{path} cannot be read: {error.strerror}; {REMEDY}") from None
        if hashlib.sha256(content).hexdigest() != entry.sha256:
            raise BoardError(f"{path} is not the file that was verified; {REMEDY}")
        try:
            return unpacked(content)
        except ValueError as error:
            raise BoardError(f"{path} is not a result: {error}; verify {entry.id} again") from None

    def result_file(self, entry: BoardEntry) -> Path:
        """Return the path of a submission's result under a protocol."""
        folder = self.folder / "results"
        if entry.protocol > 1:
            folder /= f"protocol-{entry.protocol}"
        return folder / f"{entry.id}.json.gz"

    @contextmanager
    def change(self) -> Iterator[tuple[BoardState, Callable[..., None]]]:
        """Hold the board's lock; give its state and a function that appends an event to the log.

        Other processes wait meanwhile. Temporary files left by a kill are removed.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with store.named(self.log), locked(self.log) as log:
            _remove(self.folder / "submissions" / ".new")
            for left in (self.folder / "results").glob("**/.*.part"):
                _remove(left)
            state = self._state(read_all(log), self._has_submissions())
            last = state.last

            def append(event: str, **told: Any) -> None:
                # Later than all logged times, even if the clock was set back.
                nonlocal last
                now = datetime.now(UTC)
                if last:
                    now = max(now, datetime.fromisoformat(last) + timedelta(microseconds=1))
                last = now.isoformat(timespec="microseconds")
                write_event(log, {"at": last, "event": event, **told})

            yield state, append

    def open(self) -> int:
        """Open the missing boards, or begin the next protocol; return the protocol's number.

        Environments without a board under the current protocol join it, with today's scale, and nothing else
        changes. If all have a board, or if the rules of existing boards have changed, the next protocol
        begins: it freezes today's scale, and all that is verified or pending has to be verified under it. If
        the log does not state the scale of its current protocol, that scale is added instead.
        """
        with self.change() as (state, append):
            return self._open(state, append)

    def _open(self, state: BoardState, append: Callable[..., None]) -> int:
        from lag_envs.scores import known_returns

        known = state.protocols.get(state.number)
        number = state.number + 1 if known or not state.number else state.number
        rules = protocol.rules()
        scales = {
            env_id: {name: getattr(scale, name) for name in ("random", "best", "policy")}
            for env_id in protocol.boards()
            if (scale := known_returns(env_id)) and not closed(env_id, number, number)
        }
        found = {env_id: protocol.reference(env_id) for env_id in protocol.boards()}
        references = {env_id: reference._asdict() for env_id, reference in found.items() if reference}
        if known and not different(known):
            missing = [env_id for env_id in rules["success"] if env_id not in known.scales]
            if new := {env_id: scales[env_id] for env_id in missing if env_id in scales}:
                success = {env_id: rules["success"][env_id] for env_id in new}
                references = {env_id: references[env_id] for env_id in new if env_id in references}
                append("opened", number=state.number, success=success, scales=new, references=references)
                return state.number
            if missing := [env_id for env_id in missing if known_returns(env_id) is None]:
                raise BoardError(
                    f"{', '.join(missing)}: no scale has been measured, so no board can be opened; run "
                    "`python -m agents.scale` first"
                )
        append("protocol", number=number, rules=rules, scales=scales, references=references)
        return number

    def add(self, submission: Submission) -> BoardEntry:
        """Add a submission, unless it is there already, and return its entry.

        A board without a protocol begins the first one.

        Parameters
        ----------
        submission : Submission
            A submission, as `load` returns it, so it has been checked.

        Raises
        ------
        BoardError
            If its board is frozen, or if its files change while they are copied.
        """
        id = id_of(submission)
        with self.change() as (state, append):
            number = state.number or self._open(state, append)
            if state.number and submission.env not in current(state, "add to").scales:
                raise BoardError(f"{submission.env} has no board yet; `lag-envs leaderboard open` opens one")
            if reason := closed(submission.env, number, number):
                raise BoardError(f"the board of {submission.env} is frozen: {reason}")
            known = state.entries.get(id)
            if known and known.digest != submission.digest:
                raise BoardError(
                    f"the id {id} is taken by other files; change something, such as the description"
                )
            if known is None or known.state in ("rejected", "withdrawn"):
                self._copy(submission, self.submission(id))
                append(
                    "added", id=id, env=submission.env, protocol=number, name=submission.name,
                    authors=list(submission.authors), kind=submission.kind, digest=submission.digest,
                )  # fmt: skip
        return self.read().entry(id)

    def _copy(self, submission: Submission, place: Path) -> None:
        """Copy the files, all or none, and only the bytes that were checked."""
        from lag_envs.leaderboard.submission import load

        new = place.parent / ".new"
        new.mkdir(parents=True)
        for path in sorted(submission.folder.iterdir()):
            (new / path.name).write_bytes(read_plain(path, protocol.FOLDER_BYTES))
        if load(new).digest != submission.digest:
            raise BoardError(f"{submission.folder} changed while it was read; try again when it is finished")
        for path in new.iterdir():
            store.to_disk(path)
        store.to_disk(new)
        _remove(place)  # without an entry: adding was interrupted, or the submission was rejected
        os.rename(new, place)
        store.to_disk(place.parent)

    def publish(self, nonce: str, source: str = "") -> None:
        """Publish a nonce, which decides the episodes of all that was added before.

        Parameters
        ----------
        nonce : str
            The nonce.
        source : str
            Where anybody can find it: "commit" for the hash of a commit of the repository that contains the
            board, or an address.

        Raises
        ------
        BoardError
            If the nonce is empty, not plain text, or was published before, and so is already known.
        """
        if not re.fullmatch(r"[!-~]{1,200}", nonce):
            raise BoardError(
                f"a nonce is 1 to 200 printable ASCII characters without spaces, got {shown_ascii(nonce)}"
            )
        with self.change() as (state, append):
            if any(nonce == value for _, value, _ in state.nonces):
                raise BoardError(
                    f"the nonce {shown_ascii(nonce)} was published before, so it was known; take another"
                )
            append("nonce", value=nonce, source=source)

    def verified(
        self, id: str, result: Mapping[str, Any], alike: Mapping[str, Alike | None] | None = None
    ) -> list[BoardEntry]:
        """Keep a result, unless the submission is no longer pending.

        It replaces the result of the same authors under the same name on the same board, unless the
        submission acts like an earlier one: submitting the same policies again brings no second chance.

        Parameters
        ----------
        id : str
            The submission.
        result : mapping
            What was verified.
        alike : mapping of str to Alike or None
            The submissions it was compared with, by id, and how close they are; None if not alike.

        Returns
        -------
        list of BoardEntry
            Submissions that it still has to be compared with. If there are any, nothing is kept.
        """
        alike = alike or {}
        content = gzip.compress(json.dumps(result, separators=(",", ":")).encode(), mtime=0)
        with self.change() as (state, append):
            entry = state.entry(id)
            if entry.state != "pending":
                return []
            if left := [other for other in others(state, entry) if other.id not in alike]:
                return left
            path = self.result_file(entry)
            store.write_file(path, content, sync=True)
            near = [found for found in alike.values() if found is not None]
            same = [
                old.id for old in state.entries.values() if old.state == "verified" and same_agent(old, entry)
            ]
            if any(state.entries[found.id].line < entry.line for found in near):
                same = []
            append(
                "verified", id=id, nonce=result["nonce"], sha256=hashlib.sha256(content).hexdigest(),
                supersedes=same, alike=[found.model_dump() for found in near],
            )  # fmt: skip
        return []

    def rejected(self, id: str, reason: str) -> None:
        """Reject a pending submission."""
        with self.change() as (state, append):
            if state.entry(id).state == "pending":
                append("rejected", id=id, reason=reason[:1000])

    def withdraw(self, id: str, reason: str) -> None:
        """Take a submission off the board, whatever its state; its files stay.

        Raises
        ------
        BoardError
            If there is no such submission, it was withdrawn before, or the reason is blank: it is logged for
            good.
        """
        if not reason.strip():
            raise BoardError("give a reason, such as 'asked for'; the page shows it for good")
        with self.change() as (state, append):
            if state.entry(id).state == "withdrawn":
                raise BoardError(f"{id} was withdrawn before")
            append("withdrawn", id=id, reason=reason)

    @contextmanager
    def reserved(self, id: str) -> Iterator[bool]:
        """Yield whether a submission is free to verify, and lock it if so."""
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)
        with ExitStack() as stack:
            try:
                file = os.open(self.submission(id) / "submission.toml", flags)
                stack.callback(os.close, file)
                free = lock(file, wait=False)
            except OSError:
                free = True  # the verification will report the error
            yield free


def current(state: BoardState, what: str) -> Protocol:
    """Return the current protocol; raise a BoardError if this package has other rules."""
    found = state.protocols.get(state.number)
    if found is None:
        raise BoardError(
            f"the log does not state the scale of protocol {state.number}; "
            "`lag-envs leaderboard open` adds it"
        )
    if odd := different(found):
        raise BoardError(
            f"this version of lag_envs cannot {what} a board of protocol {state.number}, whose {odd[0]} "
            "differ; "
            "`lag-envs leaderboard open` begins the next protocol, under which everything is verified again"
        )
    return found


def different(frozen: Protocol) -> list[str]:
    """Return the names of rules that are no longer those of a protocol.

    Goals of environments that have no board under it do not count.
    """
    then, now = frozen.rules.model_dump(), protocol.rules()
    now["success"] = {env_id: text for env_id, text in now["success"].items() if env_id in then["success"]}
    return [name for name, rule in now.items() if rule != then[name]]


def others(state: BoardState, entry: BoardEntry) -> list[BoardEntry]:
    """Return all submissions verified on the same board, including those withdrawn or replaced since."""
    return [
        other
        for other in state.boards[entry.protocol].values()
        if other.env == entry.env and other.sha256 and other.id != entry.id
    ]


def id_of(submission: About) -> str:
    """Return a submission's id on the board: environment, name, and the beginning of its digest."""
    name = unicodedata.normalize("NFKD", submission.name).encode("ascii", "ignore").decode().lower()
    slug = re.sub(r"[^a-z0-9]+", "-", name)[:40].strip("-") or "unnamed"
    return f"{submission.env}-{slug}-{submission.digest[:8]}"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
