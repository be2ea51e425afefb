"""The board: which submissions there are, what was verified of them, and what became of each.

A folder, meant to lie in a git repository::

    board.jsonl                    the log: a line of JSON for every event, only ever appended to
    submissions/ID/                the submissions' files
    results/ID.json.gz             what was verified under protocol 1, and some recorded episodes
    results/protocol-N/ID.json.gz  the same under later ones
    values/ENV.json                a coarse value function for the page, where there is one (optional)

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
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lag_envs import store
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.fields import shown
from lag_envs.leaderboard.files import read_plain
from lag_envs.leaderboard.log import (
    LOG,
    REMEDY,
    Alike,
    BoardError,
    Entry,
    Protocol,
    State,
    fold,
    lock,
    locked,
    parse,
    read_all,
    read_log,
    same_agent,
    write_event,
)
from lag_envs.leaderboard.results import PACKED, check, checked_value, unpacked
from lag_envs.tasks import TASKS

if TYPE_CHECKING:
    from lag_envs.leaderboard.submission import About, Submission


def closed(env_id: str, number: int, current: int) -> str:
    """Return why the board of an environment and protocol is frozen; empty for one that is open.

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

    def read(self) -> State:
        """Return what follows from the log, which others may be writing."""
        return fold(parse(read_log(self.log))[0])

    def submission(self, id: str) -> Path:
        """Return the folder of a submission's files."""
        return self.folder / "submissions" / id

    def result(self, entry: Entry) -> dict[str, Any]:
        """Return what was verified, or raise a BoardError where it is not what was written then."""
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
            raise BoardError(f"{path} is no result: {error}; verify {entry.id} anew") from None

    def result_file(self, entry: Entry) -> Path:
        """Return the place of a submission's result under a protocol."""
        folder = self.folder / "results"
        if entry.protocol > 1:
            folder /= f"protocol-{entry.protocol}"
        return folder / f"{entry.id}.json.gz"

    @contextmanager
    def change(self) -> Iterator[tuple[State, Callable[..., None]]]:
        """Hold the board's lock; give its state and a function that appends an event to the log.

        What others do meanwhile waits. Temporary files that a kill has left are removed.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.log) as log:
            _remove(self.folder / "submissions" / ".new")
            for left in (self.folder / "results").glob("**/.*.part"):
                _remove(left)
            state = fold(parse(read_all(log))[0])
            last = state.last

            def append(event: str, **told: Any) -> None:
                # Later than all that is there, even where the clock was set back.
                nonlocal last
                now = datetime.now(UTC)
                if last:
                    now = max(now, datetime.fromisoformat(last) + timedelta(microseconds=1))
                last = now.isoformat(timespec="microseconds")
                write_event(log, {"at": last, "event": event, **told})

            yield state, append

    def open(self) -> int:
        """Begin the next protocol, which freezes the scale of now, and return its number.

        All that is verified or pending goes over to it, to be verified anew. In a log in which nothing tells
        the scale of its current protocol, that is told instead.
        """
        with self.change() as (state, append):
            return self._open(state, append)

    def _open(self, state: State, append: Callable[..., None]) -> int:
        from lag_envs.scores import known_returns

        known = state.number in state.protocols
        number = state.number + 1 if known or not state.number else state.number
        scales = {
            env_id: {name: getattr(scale, name) for name in ("random", "best", "policy")}
            for env_id in protocol.boards()
            if (scale := known_returns(env_id)) and not closed(env_id, number, number)
        }
        found = {env_id: protocol.reference(env_id) for env_id in protocol.boards()}
        references = {env_id: reference._asdict() for env_id, reference in found.items() if reference}
        append("protocol", number=number, rules=protocol.rules(), scales=scales, references=references)
        return number

    def add(self, submission: Submission) -> Entry:
        """Take a submission in, unless it is there already, and return its entry.

        On a board without a protocol, the first begins with it.

        Parameters
        ----------
        submission : Submission
            A submission, as `load` gives it; so it has been checked.

        Raises
        ------
        BoardError
            Where its board is frozen, or its files change while they are copied.
        """
        id = id_of(submission)
        with self.change() as (state, append):
            number = state.number or self._open(state, append)
            if state.number:
                current(state, "add to")
            if reason := closed(submission.env, number, number):
                raise BoardError(f"the board of {submission.env} is frozen: {reason}")
            known = state.entries.get(id)
            if known and known.digest != submission.digest:
                raise BoardError(f"{id} is taken by other files; change something, such as the description")
            if known is None or known.state in ("rejected", "withdrawn"):
                self._copy(submission, self.submission(id))
                append(
                    "added", id=id, env=submission.env, protocol=number, name=submission.name,
                    authors=list(submission.authors), kind=submission.kind, digest=submission.digest,
                )  # fmt: skip
        return self.read().entry(id)

    def _copy(self, submission: Submission, place: Path) -> None:
        """Copy the files; whole or not at all, and only those bytes that were checked."""
        from lag_envs.leaderboard.submission import load

        new = place.parent / ".new"
        new.mkdir(parents=True)
        for path in sorted(submission.folder.iterdir()):
            (new / path.name).write_bytes(read_plain(path, protocol.FOLDER_BYTES))
        if load(new).digest != submission.digest:
            raise BoardError(f"{submission.folder} changes while it is read; try again when it is finished")
        for path in new.iterdir():
            store.to_disk(path)
        store.to_disk(new)
        _remove(place)  # of no entry: its adding was broken off, or it was turned away
        os.rename(new, place)
        store.to_disk(place.parent)

    def publish(self, nonce: str, source: str = "") -> None:
        """Publish a nonce, with which all that was added before can be verified.

        Parameters
        ----------
        nonce : str
            The nonce.
        source : str
            Where anybody finds it: "commit" for the hash of a commit of the repository in which the board
            lies, or an address.

        Raises
        ------
        BoardError
            Where the nonce is empty, not plain text, or was published before: then it was known.
        """
        if not re.fullmatch(r"[!-~]{1,200}", nonce):
            raise BoardError(
                f"a nonce is 1 to 200 printable ASCII characters without spaces, got {shown(nonce)}"
            )
        with self.change() as (state, append):
            if any(nonce == value for _, value, _ in state.nonces):
                raise BoardError(
                    f"the nonce {shown(nonce)} was published before, so it was known; take another"
                )
            append("nonce", value=nonce, source=source)

    def verified(
        self, id: str, result: Mapping[str, Any], alike: Mapping[str, Alike | None] | None = None
    ) -> list[Entry]:
        """Keep a result, unless the submission is no longer pending.

        It takes the place of what the same authors have under the same name on the same board, unless it acts
        like an earlier one: nobody gets other luck by submitting the same again.

        Parameters
        ----------
        id : str
            The submission.
        result : mapping
            What was verified.
        alike : mapping of str to Alike or None
            The others with which it was compared, by id, and how near they are, None for not alike.

        Returns
        -------
        list of Entry
            Those with which it still has to be compared; nothing is kept then.
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
            store.write(path, content, sync=True)
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
        """Turn a pending submission away."""
        with self.change() as (state, append):
            if state.entry(id).state == "pending":
                append("rejected", id=id, reason=reason[:1000])

    def withdraw(self, id: str, reason: str) -> None:
        """Take a submission off the board, whatever its state; its files stay."""
        with self.change() as (state, append):
            if state.entry(id).state == "withdrawn":
                raise BoardError(f"{id} was withdrawn before")
            append("withdrawn", id=id, reason=reason)

    @contextmanager
    def claimed(self, id: str) -> Iterator[bool]:
        """Tell whether nobody else is verifying a submission, and keep others from it meanwhile."""
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)
        with ExitStack() as stack:
            try:
                file = os.open(self.submission(id) / "submission.toml", flags)
                stack.callback(os.close, file)
                free = lock(file, wait=False)
            except OSError:
                free = True  # verifying it will tell
            yield free


def current(state: State, what: str) -> Protocol:
    """Return the current protocol, or raise a BoardError where this package has other rules than it."""
    found = state.protocols.get(state.number)
    if found is None:
        raise BoardError(
            f"the log does not tell the scale of protocol {state.number}; `lag-envs leaderboard open` adds it"
        )
    ours, theirs = protocol.rules(), found.rules.model_dump()
    if odd := [name for name in ours if ours[name] != theirs[name]]:
        raise BoardError(
            f"this version of lag_envs cannot {what} a board of protocol {state.number}: {odd[0]} differ; "
            "`lag-envs leaderboard open` begins the next protocol, under which all is verified anew"
        )
    return found


def others(state: State, entry: Entry) -> list[Entry]:
    """Return what has been verified beside a submission on its board, whatever became of it."""
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
        from lag_envs.leaderboard.alike import check_twins
        from lag_envs.leaderboard.submission import Refused, load
        from lag_envs.leaderboard.verify import verify

        digest, nonce = self.entries[folder.name]
        submission = load(folder)
        if submission.digest != digest:
            raise Refused("its files are not those that were added")
        check_twins(submission, nonce)
        result = verify(submission, nonce, protocol.EPISODES, progress)
        # What the board cannot keep fails here, and costs nobody else.
        return check(result | {"claimed": claimed(submission), "replays": replays(submission, result)})


def claimed(submission: About) -> dict[str, Any]:
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


def replays(submission: Submission, result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the median, the best and the worst episode of the policy in the middle, recorded."""
    from lag_envs.leaderboard.verify import replay

    policy, chosen = shown_episodes(result)
    _, found = replay(submission, result, policy, list(chosen.values()))
    return [{"label": label} | episode for label, episode in zip(chosen, found, strict=True)]


def shown_episodes(result: Mapping[str, Any]) -> tuple[int, dict[str, int]]:
    """Return the number of the policy in the middle, and those of its median, best and worst episode."""
    import numpy as np

    returns = np.array([policy["returns"] for policy in result["policies"]])
    policy = int(np.argsort(returns.mean(axis=1), kind="stable")[(len(returns) - 1) // 2])
    order = np.argsort(returns[policy], kind="stable")
    chosen = {"median": order[(len(order) - 1) // 2], "best": order[-1], "worst": order[0]}
    return policy, {label: int(i) for label, i in chosen.items()}


def finish(
    board: Board,
    only: Sequence[str] | None = None,
    parallel_map: Callable[..., Iterator[tuple[Path, Any]]] | None = None,
    tell: Callable[[Entry, str], Any] = lambda entry, what: None,
) -> int:
    """Verify what is pending and has a nonce.

    Parameters
    ----------
    board : Board
        The board.
    only : sequence of str, optional
        The ids that may be verified; by default all.
    parallel_map : callable, optional
        Like `map_submissions`, with all but its first two arguments given; by default one after the other.
    tell : callable
        Told each entry and what became of it.

    Returns
    -------
    int
        How many could not be verified for a reason that is not their own; they stay pending.
    """
    from lag_envs.leaderboard.parallel import map_submissions
    from lag_envs.leaderboard.submission import Refused

    failed = 0
    state = board.read()
    if state.waiting():
        current(state, "verify submissions of")
    with ExitStack() as claims:
        ours: dict[str, tuple[Entry, str]] = {}
        for entry in state.waiting():
            if only is not None and entry.id not in only:
                continue
            if reason := closed(entry.env, entry.protocol, state.number):
                board.rejected(entry.id, f"its board closed before it was verified: {reason}")
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
        work = Check({id: (entry.digest, nonce) for id, (entry, nonce) in ours.items()})
        folders = [board.submission(id) for id in ours]
        neighbours = Neighbours(board)
        for folder, result in (parallel_map or partial(map_submissions, jobs=1))(work, folders):
            entry = ours[folder.name][0]
            if isinstance(result, Refused):
                board.rejected(entry.id, str(result))
            elif isinstance(result, BaseException):
                failed += 1
                tell(entry, f"could not be verified ({type(result).__name__}: {result}); it stays pending")
                continue
            else:
                found: dict[str, Alike | None] = {}
                while left := board.verified(entry.id, result, found):
                    found |= {other.id: neighbours.alike(entry, result, other) for other in left}
            tell(entry, _outcome(board, entry))
    return failed


class Neighbours:
    """Compares submissions of a board, see `lag_envs.leaderboard.alike`.

    Parameters
    ----------
    board : Board
        The board.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self._protocols = board.read().protocols
        self._loaded: dict[str, Submission] = {}
        self._likeness: dict[tuple[str, str], Any] = {}

    def alike(self, entry: Entry, result: Mapping[str, Any], other: Entry) -> Alike | None:
        """Return how near another submission is to one that was just verified; None where they are apart."""
        from lag_envs.leaderboard.alike import Likeness
        from lag_envs.leaderboard.ranking import policy_error

        reference = self._protocols[entry.protocol].references.get(entry.env)
        results = (result, self.board.result(other))
        error = max(policy_error(reference, each["policies"]) for each in results)
        likeness = self._likeness.setdefault(
            (entry.env, result["nonce"]), Likeness(entry.env, result["nonce"])
        )
        older, newer = sorted((entry, other), key=lambda each: each.line)
        found = likeness(self._load(newer), self._load(older), error)
        if found.closeness >= 1.0:
            return None
        return Alike(id=other.id, actions=found.actions, returns=found.returns)

    def _load(self, entry: Entry) -> Submission:
        from lag_envs.leaderboard.submission import Refused, load

        if entry.id not in self._loaded:
            try:
                submission = load(self.board.submission(entry.id))
            except Refused as error:
                raise BoardError(f"{self.board.submission(entry.id)}: {error}; {REMEDY}") from None
            if submission.digest != entry.digest:
                raise BoardError(f"{self.board.submission(entry.id)} is not what was added; {REMEDY}")
            self._loaded[entry.id] = submission
        return self._loaded[entry.id]


def _outcome(board: Board, entry: Entry) -> str:
    now = board.read().entry(entry.id)
    if now.state == "pending":
        return "pending, until a nonce is published: `lag-envs leaderboard nonce`"
    return f"{now.state}: {now.reason}" if now.reason else now.state


# --- what the page shows ------------------------------------------------------------------------------------


def page_data(board: Board) -> dict[str, Any]:
    """Return what `board_data` does, with what only the page needs: agents that run there, drives by hand."""
    from lag_envs.leaderboard.drives import best_drives
    from lag_envs.leaderboard.site.driving import agent
    from lag_envs.leaderboard.submission import load

    data, state, drives = board_data(board), board.read(), best_drives(board.folder)
    results = {entry.id: entry for entry in state.boards.get(data["protocol"], {}).values()}
    for env in data["environments"]:
        if env["frozen"]:
            continue
        env["drives"] = drives.get(env["id"], [])
        for row in env["rows"]:
            middle, _ = shown_episodes(board.result(results[row["id"]]))
            row["agent"] = agent(load(board.submission(row["id"])).policies[middle][1])
    return data


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

    Raises
    ------
    BoardError
        Where something on the board is not as it was noted, see `audit.sound`.
    """
    from lag_envs.leaderboard.audit import sound

    state, results = sound(board)
    current = state.number or 1
    keys = {(env_id, current): None for env_id in TASKS if not closed(env_id, current, current)}
    frozen = sorted({(e.env, e.protocol) for e in state.all} - set(keys))
    return {
        "protocol": current,
        "made": made or datetime.now(UTC).date().isoformat(),
        "environments": [_environment(board, state, results, *key) for key in (*keys, *frozen)],
    }


def _environment(
    board: Board, state: State, results: Mapping[tuple[int, str], dict[str, Any]], env_id: str, number: int
) -> dict[str, Any]:
    from lag_envs.leaderboard import ranking
    from lag_envs.leaderboard.site.scenery import describe

    entries = {e.id: e for e in state.boards.get(number, {}).values() if e.env == env_id}
    told = state.protocols.get(number)
    scale = told.scales.get(env_id) if told else None
    reference = told.references.get(env_id) if told else None
    rows = []
    if told is not None and scale is not None:
        found = {id: results[number, id] for id, e in entries.items() if e.state == "verified"}
        scores = {id: ranking.scored(scale, reference, r["policies"]) for id, r in found.items()}
        drawn = {id: ranking.redrawn(id, each) for id, each in scores.items()}
        first = {id: state.first(entries[id]) for id in found}
        # Who acts like an earlier one is shown, but neither ranked nor anybody's neighbour.
        places = ranking.ranked({id: each for id, each in scores.items() if first[id] is None}, drawn)
        ranks = {place.id: place for place in places}
        for id in sorted(scores, key=lambda id: -float(ranking.iqm(scores[id].table.mean(axis=1)))):
            entry, result, place = entries[id], found[id], ranks.get(id)
            like = first[id]
            row: dict[str, Any] = {
                "id": id,
                "rank": place and place.rank,
                "above": place and place.above and list(place.above),
                "alike": like and {"id": like.id, "name": like.name, "state": like.state},
                "reference": scores[id].own,
                "looks_like": _looks_like(entry, entries.values()),
                "name": entry.name,
                "kind": entry.kind,
                "authors": list(entry.authors),
                "state": entry.state,
                "added": entry.added[:10],
            }
            row |= result["claimed"]
            row["curves"] = [
                {
                    "seed": c["seed"], "steps": c["steps"],
                    "scores": ranking.normalised(scale, c["returns"]).tolist(),
                }
                for c in result["claimed"]["curves"]
            ]  # fmt: skip
            row |= ranking.columns(env_id, result, told.rules.disturbed_episodes, scale, scores[id])
            row["interval"] = list(ranking.ends(ranking.iqm(drawn[id])))
            middle, chosen = shown_episodes(result)
            verified = {label: result["policies"][middle]["returns"][i] for label, i in chosen.items()}
            row["replays"] = [
                replay | {"t0": 0.0, "score": float(ranking.normalised(scale, replay["return"]))}
                for replay in result["replays"]
                # Under protocol 1 those of random actions were other ones.
                if abs(replay["return"] - verified[replay["label"]]) <= 1e-3 * (scale.best - scale.random)
            ]
            rows.append(_rounded(row))
    return {
        "id": env_id,
        "protocol": number,
        "frozen": bool(closed(env_id, number, state.number or 1)),
        "known": _known(env_id, scale),
        "goal": told.rules.success.get(env_id) if told else None,
        "value": _value(board.folder / "values" / f"{env_id}.json"),
        "rows": rows,
        "other": [
            {"id": e.id, "name": e.name, "state": e.state, "reason": e.reason}
            for e in entries.values()
            if e.state != "verified"
        ],
    } | describe(env_id)


def _known(env_id: str, scale: Any) -> dict[str, Any] | None:
    """Return what is known of an environment's returns: frozen with the protocol, where there is one."""
    from lag_envs.scores import KnownReturns, known_returns

    found = known_returns(env_id)
    known = found and found._asdict()
    if scale is None:
        return known
    return (known or dict.fromkeys(KnownReturns._fields)) | scale.model_dump()


def _looks_like(entry: Entry, entries: Iterable[Entry]) -> str:
    """Return the earlier author or name, of others, that an entry's can be taken for; empty for none."""
    from lag_envs.leaderboard.names import lookalike

    earlier = [e for e in entries if e.line < entry.line and set(e.authors).isdisjoint(entry.authors)]
    authors = list(dict.fromkeys(author for e in earlier for author in e.authors))
    for author in entry.authors:
        if found := lookalike(author, authors):
            return found
    return lookalike(entry.name, dict.fromkeys([*authors, *(e.name for e in earlier)]))


def _value(path: Path) -> dict[str, Any] | None:
    """Return a value function for the page; None where there is none."""
    try:
        return checked_value(read_plain(path, PACKED))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        told = error.strerror if isinstance(error, OSError) else error
        raise BoardError(f"{path} cannot be read: {told}; {REMEDY}, or remove it") from None


def _rounded(value: Any) -> Any:
    """Return JSON types with numbers of 6 digits; more would only make the page large."""
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
