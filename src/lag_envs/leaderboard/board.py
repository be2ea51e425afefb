"""The board: which submissions there are, what was verified of them, and what became of each.

A folder, meant to lie in a git repository::

    board.jsonl              the log: a line of JSON for every event, only ever appended to
    submissions/ID/          the submissions' files
    results/ID.json.gz       what was verified, and some recorded episodes
    values/ENV.json          a coarse value function for the page, where there is one (optional)

The state of everything follows from the log. A file is complete before the event that speaks of it is
written, and an event is one write under a lock, followed by fsync. So a kill at any moment loses nothing that
was acknowledged, and leaves a board that can be read; at worst a last line is torn off, which readers pass
over and the next writer removes.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import shutil
import sys
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lag_envs.leaderboard.log import (
    LOG,
    BoardError,
    Entry,
    State,
    fold,
    lock,
    locked,
    parse,
    read_all,
    write_event,
)
from lag_envs.leaderboard.protocol import PROTOCOL
from lag_envs.tasks import TASKS

if TYPE_CHECKING:
    from lag_envs.leaderboard.submission import Submission


def closed(env_id: str, protocol: int) -> str:
    """Return why the board of an environment and protocol is frozen; empty for one that is open.

    Examples
    --------
    >>> closed("PivotedBar-v0", PROTOCOL)
    ''
    >>> closed("Gone-v0", PROTOCOL)
    'there is no environment Gone-v0'
    """
    if protocol != PROTOCOL:
        return f"protocol {protocol} has ended, the current one is {PROTOCOL}"
    if env_id not in TASKS:
        return f"there is no environment {env_id}"
    name, number = _version(env_id)
    newer = max(version for other, version in map(_version, TASKS) if other == name)
    return f"{name}-v{newer} has taken its place" if newer > number else ""


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

    def read(self) -> State:
        """Return what follows from the log, which others may be writing."""
        try:
            return fold(parse(self.log.read_bytes())[0])
        except FileNotFoundError:
            return State()

    def submission(self, id: str) -> Path:
        """Return the folder of a submission's files."""
        return self.folder / "submissions" / id

    def result(self, entry: Entry) -> dict[str, Any]:
        """Return what was verified, or raise a BoardError where it is not what was written then."""
        path = self._result(entry.id)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            raise BoardError(f"{path} is missing; restore it from version control") from None
        if hashlib.sha256(content).hexdigest() != entry.sha256:
            raise BoardError(f"{path} is not the file that was verified; restore it from version control")
        return json.loads(gzip.decompress(content))

    def _result(self, id: str) -> Path:
        return self.folder / "results" / f"{id}.json.gz"

    @contextmanager
    def change(self) -> Iterator[tuple[State, Callable[..., None]]]:
        """Hold the board's lock; give its state and a function that appends an event to the log.

        What others do meanwhile waits. Temporary files that a kill has left are removed.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.log) as log:
            for left in ("submissions/.new", "results/.new"):
                _remove(self.folder / left)
            state = fold(parse(read_all(log))[0])

            def append(event: str, **told: Any) -> None:
                # Later than all that is there, even where the clock was set back.
                now = datetime.now(UTC)
                if state.last:
                    now = max(now, datetime.fromisoformat(state.last) + timedelta(microseconds=1))
                state.last = now.isoformat(timespec="microseconds")
                write_event(log, {"at": state.last, "event": event, **told})

            yield state, append

    def add(self, submission: Submission) -> Entry:
        """Take a submission in, unless it is there already, and return its entry.

        Parameters
        ----------
        submission : Submission
            A submission, as `load` gives it; so it has been checked.

        Raises
        ------
        BoardError
            Where its board is frozen, or its files change while they are copied.
        """
        if reason := closed(submission.env, PROTOCOL):
            raise BoardError(f"the board of {submission.env} is frozen: {reason}")
        id = id_of(submission)
        with self.change() as (state, append):
            known = state.entries.get(id)
            if known and known.digest != submission.digest:
                raise BoardError(f"{id} is taken by other files; change something, such as the description")
            if known is None or known.state in ("rejected", "withdrawn"):
                self._copy(submission, self.submission(id))
                append(
                    "added", id=id, env=submission.env, protocol=PROTOCOL, name=submission.name,
                    authors=list(submission.authors), kind=submission.kind, digest=submission.digest,
                )  # fmt: skip
        return self.read().entry(id)

    def _copy(self, submission: Submission, place: Path) -> None:
        """Copy the files; whole or not at all, and only those bytes that were checked."""
        from lag_envs.leaderboard.submission import load

        new = place.parent / ".new"
        new.mkdir(parents=True)
        for path in sorted(submission.folder.iterdir()):
            shutil.copyfile(path, new / path.name, follow_symlinks=False)
        if load(new).digest != submission.digest:
            raise BoardError(f"{submission.folder} changes while it is read; try again when it is finished")
        for path in new.iterdir():
            _sync(path)
        _sync(new)
        _remove(place)  # of no entry: its adding was broken off, or it was turned away
        os.rename(new, place)
        _sync(place.parent)

    def publish(self, nonce: str) -> None:
        """Publish a nonce, with which all that was added before can be verified.

        Raises
        ------
        BoardError
            Where the nonce is empty, not plain text, or was published before: then it was known.
        """
        if not re.fullmatch(r"[!-~]{1,200}", nonce):
            raise BoardError(
                f"a nonce is 1 to 200 printable ASCII characters without spaces, got {nonce[:80]!r}"
            )
        with self.change() as (state, append):
            if any(nonce == value for _, value in state.nonces):
                raise BoardError(
                    f"the nonce {nonce[:80]!r} was published before, so it was known; take another"
                )
            append("nonce", value=nonce)

    def verified(self, id: str, result: Mapping[str, Any]) -> None:
        """Keep a result, unless the submission is no longer pending.

        It takes the place of what the same authors have under the same name on the same board.
        """
        content = gzip.compress(json.dumps(result, separators=(",", ":")).encode(), mtime=0)
        with self.change() as (state, append):
            entry = state.entry(id)
            if entry.state != "pending":
                return
            path = self._result(id)
            new = path.parent / ".new"
            new.parent.mkdir(exist_ok=True)
            new.write_bytes(content)
            _sync(new)
            os.replace(new, path)
            _sync(path.parent)
            same = [
                old.id
                for old in state.entries.values()
                if old.state == "verified" and _author(old) == _author(entry)
            ]
            digest = hashlib.sha256(content).hexdigest()
            append("verified", id=id, nonce=result["nonce"], sha256=digest, supersedes=same)

    def rejected(self, id: str, reason: str) -> None:
        """Turn a pending submission away."""
        with self.change() as (state, append):
            if state.entry(id).state == "pending":
                append("rejected", id=id, reason=reason)

    def withdraw(self, id: str, reason: str) -> None:
        """Take a submission off the board, whatever its state; its files stay."""
        with self.change() as (state, append):
            if state.entry(id).state == "withdrawn":
                raise BoardError(f"{id} was withdrawn before")
            append("withdrawn", id=id, reason=reason)

    @contextmanager
    def claimed(self, id: str) -> Iterator[bool]:
        """Tell whether nobody else is verifying a submission, and keep others from it meanwhile."""
        with ExitStack() as stack:
            try:
                file = stack.enter_context((self.submission(id) / "submission.toml").open("rb"))
                free = lock(file.fileno(), wait=False)
            except FileNotFoundError:
                free = True  # verifying it will tell
            yield free


def id_of(submission: Submission) -> str:
    """Return a submission's id on the board: environment, name, and the beginning of its digest."""
    name = unicodedata.normalize("NFKD", submission.name).encode("ascii", "ignore").decode().lower()
    slug = re.sub(r"[^a-z0-9]+", "-", name)[:40].strip("-") or "unnamed"
    return f"{submission.env}-{slug}-{submission.digest[:8]}"


def _author(entry: Entry) -> tuple[str, int, str, tuple[str, ...]]:
    return entry.env, entry.protocol, entry.name, tuple(sorted(entry.authors))


def _sync(path: Path) -> None:
    """See a file, or a folder's names, to the disk."""
    if path.is_dir() and sys.platform == "win32":
        return
    file = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# --- verifying what is pending ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Check:
    """What is done to a pending submission, here or on another machine.

    Parameters
    ----------
    entries : dict of str to (digest, nonce)
        By the name of the submission's folder.
    """

    entries: Mapping[str, tuple[str, str]]

    def __call__(self, folder: Path, progress: Callable[[int, int], Any] | None = None) -> dict[str, Any]:
        """Return the result, with some recorded episodes; raise `Refused` for what is not acceptable."""
        from lag_envs.leaderboard.submission import Refused, load
        from lag_envs.leaderboard.verify import verify

        digest, nonce = self.entries[folder.name]
        submission = load(folder)
        if submission.digest != digest:
            raise Refused("its files are not those that were added")
        result = verify(submission, nonce, progress=progress)
        result = result | {"claimed": claimed(submission), "replays": replays(submission, result)}
        json.dumps(result, allow_nan=False)  # what the board cannot keep fails here, and costs nobody else
        return result


def claimed(submission: Submission) -> dict[str, Any]:
    """Return what a submission says of itself, which nobody verified."""
    training = submission.training
    return {
        "code": submission.code or None,
        "license": submission.license,
        "description": submission.description,
        "env_steps": training.get("env_steps"),
        "seconds": training.get("seconds"),
        "hardware": training.get("hardware"),
        "curves": [
            {"seed": c["seed"], "steps": list(c["steps"]), "returns": list(c["returns"])}
            for c in training.get("curves", ())
        ],
    }


def replays(submission: Submission, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the median, the best and the worst episode of the policy in the middle, recorded."""
    import numpy as np

    from lag_envs.leaderboard.protocol import first_seed
    from lag_envs.leaderboard.verify import episode

    returns = np.array([policy["returns"] for policy in result["policies"]])
    policy = int(np.argsort(returns.mean(axis=1), kind="stable")[(len(returns) - 1) // 2])
    order = np.argsort(returns[policy], kind="stable")
    chosen = {"median": order[(len(order) - 1) // 2], "best": order[-1], "worst": order[0]}
    first = first_seed(result["digest"], result["nonce"], policy)
    return [{"label": label} | episode(submission, policy, first + int(i)) for label, i in chosen.items()]


def finish(
    board: Board,
    only: Sequence[str] | None = None,
    spread: Callable[..., Iterator[tuple[Path, Any]]] | None = None,
    tell: Callable[[Entry, str], Any] = lambda entry, what: None,
) -> int:
    """Verify what is pending and has a nonce.

    Parameters
    ----------
    board : Board
        The board.
    only : sequence of str, optional
        The ids that may be verified; by default all.
    spread : callable, optional
        Like `map_submissions`, with all but its first two arguments given; by default one after the other.
    tell : callable
        Told each entry and what became of it.

    Returns
    -------
    int
        How many could not be verified for a reason that is not their own; they stay pending.
    """
    from lag_envs.leaderboard.spread import map_submissions
    from lag_envs.leaderboard.submission import Refused

    failed = 0
    with ExitStack() as claims:
        ours: dict[str, tuple[Entry, str]] = {}
        for entry in board.read().waiting():
            if only is not None and entry.id not in only:
                continue
            if closed(entry.env, entry.protocol):
                board.rejected(
                    entry.id, f"its board closed before it was verified: {closed(entry.env, entry.protocol)}"
                )
            elif not claims.enter_context(board.claimed(entry.id)):
                tell(entry, "another process is at it")
                continue
            else:
                state = board.read()  # another process may just have finished it
                nonce = state.nonce(entry)
                if state.entry(entry.id).state == "pending" and nonce is not None:
                    ours[entry.id] = entry, nonce
                    continue
            tell(entry, _outcome(board, entry))
        check = Check({id: (entry.digest, nonce) for id, (entry, nonce) in ours.items()})
        folders = [board.submission(id) for id in ours]
        for folder, result in (spread or partial(map_submissions, jobs=1))(check, folders):
            entry = ours[folder.name][0]
            if isinstance(result, Refused):
                board.rejected(entry.id, str(result))
            elif isinstance(result, BaseException):
                failed += 1
                tell(entry, f"could not be verified ({type(result).__name__}: {result}); it stays pending")
                continue
            else:
                board.verified(entry.id, result)
            tell(entry, _outcome(board, entry))
    return failed


def _outcome(board: Board, entry: Entry) -> str:
    now = board.read().entry(entry.id)
    if now.state == "pending":
        return "pending, until a nonce is published: `lag-envs leaderboard nonce`"
    return f"{now.state}: {now.reason}" if now.reason else now.state


# --- what the page shows ------------------------------------------------------------------------------------


def board_data(board: Board, made: str | None = None) -> dict[str, Any]:
    """Return all that page and tables show.

    Parameters
    ----------
    board : Board
        The board.
    made : str, optional
        The date to note; by default today's.

    Returns
    -------
    dict
        JSON types. ``environments`` has every environment, with its ``rows`` in order, and after them the
        frozen boards.
    """
    state = board.read()
    keys = {(env_id, PROTOCOL): None for env_id in TASKS if not closed(env_id, PROTOCOL)}
    frozen = sorted({(e.env, e.protocol) for e in state.entries.values()} - set(keys))
    return {
        "protocol": PROTOCOL,
        "made": made or datetime.now(UTC).date().isoformat(),
        "environments": [_environment(board, state, *key) for key in (*keys, *frozen)],
    }


def _environment(board: Board, state: State, env_id: str, protocol: int) -> dict[str, Any]:
    from lag_envs.leaderboard.protocol import GOALS
    from lag_envs.leaderboard.ranking import columns, corrected, normalised, ranked, redrawn
    from lag_envs.leaderboard.site.scenery import describe
    from lag_envs.scores import KNOWN_RETURNS

    entries = {e.id: e for e in state.entries.values() if (e.env, e.protocol) == (env_id, protocol)}
    results = {id: board.result(e) for id, e in entries.items() if e.state == "verified"}
    scores = {id: normalised(env_id, corrected(env_id, result["policies"])) for id, result in results.items()}
    drawn = {id: redrawn(id, table) for id, table in scores.items()}
    rows = []
    for place in ranked(scores, drawn):
        entry, result = entries[place.id], results[place.id]
        above = place.above and [place.above.value, place.above.low, place.above.high]
        own = {"id": place.id, "rank": place.rank, "above": above, "name": entry.name, "kind": entry.kind}
        row = own | {"authors": list(entry.authors), "state": entry.state, "added": entry.added[:10]}
        row |= result["claimed"]
        row["curves"] = [
            {"seed": c["seed"], "steps": c["steps"], "scores": normalised(env_id, c["returns"]).tolist()}
            for c in result["claimed"]["curves"]
        ]
        row |= columns(env_id, result, drawn[place.id])
        row["replays"] = [
            replay | {"t0": 0.0, "score": float(normalised(env_id, replay["return"]))}
            for replay in result.get("replays", [])
        ]
        rows.append(_rounded(row))
    return {
        "id": env_id,
        "protocol": protocol,
        "frozen": bool(closed(env_id, protocol)),
        "known": KNOWN_RETURNS[env_id]._asdict() if env_id in KNOWN_RETURNS else None,
        "goal": GOALS[env_id].text if env_id in GOALS else None,
        "value": _value(board.folder / "values" / f"{env_id}.json"),
        "rows": rows,
        "other": [
            {"id": e.id, "name": e.name, "state": e.state, "reason": e.reason}
            for e in entries.values()
            if e.state != "verified"
        ],
    } | describe(env_id)


def _value(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _rounded(value: Any) -> Any:
    """Return JSON types with numbers of 6 digits; more would only make the page large."""
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
