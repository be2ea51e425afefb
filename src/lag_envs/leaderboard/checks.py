"""The cheap checks of a board against its own log; they run wherever the board is shown.

They cover the log's chain, the release's pin, the log in earlier commits, each submission against its digest
and the log, and each result against its hash and its own statements.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lag_envs.leaderboard import history, protocol
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.fields import shown_ascii
from lag_envs.leaderboard.history import Finding
from lag_envs.leaderboard.log import (
    REMEDY,
    BoardEntry,
    BoardError,
    BoardState,
    LogLine,
    fold,
    parse,
    read_log,
)
from lag_envs.leaderboard.pending import claimed, shown_episodes
from lag_envs.store import write_file

if TYPE_CHECKING:
    from lag_envs.leaderboard.submission import About

Results = dict[tuple[int, str], dict[str, Any]]


@dataclass
class CheapChecks:
    """What the cheap checks found, and what they read."""

    findings: list[Finding]
    log: bytes = b""
    lines: list[LogLine] = field(default_factory=list)
    state: BoardState = field(default_factory=BoardState)
    results: Results = field(default_factory=dict)
    #: What each submission says about itself, by id.
    abouts: dict[str, About] = field(default_factory=dict)

    def chained(self, number: int) -> bool:
        """Return whether a line of the log holds the hash of the lines before it."""
        return any(line.number == number and line.event.prev is not None for line in self.lines)

    def verified_at(self, entry: BoardEntry) -> int:
        """Return the line that says that an entry was verified."""
        return next(
            line.number
            for line in self.lines
            if line.event.event == "verified" and line.event.id == entry.id and line.number > entry.since
        )


def sound(board: Board) -> tuple[BoardState, Results]:
    """Return a board's state and its results, by protocol and id, if all cheap checks pass.

    Raises
    ------
    BoardError
        For the first check that fails; the text names the line and the remedy.
    """
    found = cheap(board)
    # History names the line that was changed; the chain only the next line that does not follow.
    findings = sorted(found.findings, key=lambda finding: finding.name != "history")
    wrong = [text for finding in findings for text in finding.wrong]
    if wrong:
        more = f" ({len(wrong) - 1} more: `lag-envs leaderboard audit` lists them all)" if wrong[1:] else ""
        raise BoardError(wrong[0] + more)
    return found.state, found.results


def cheap(board: Board, pin: Path | None = None) -> CheapChecks:
    """Run all cheap checks."""
    chain = Finding("log")
    found = CheapChecks([chain])
    try:
        found.log = read_log(board.log)
        found.lines, torn = parse(found.log)
        found.state = fold(found.lines)
    except BoardError as error:
        chain.wrong.append(f"{board.folder}: {error}")
        found.findings.append(history.history(board, found.log))
        return found
    whole = found.log[: len(found.log) - len(torn)]
    chained = [line.number for line in found.lines if line.event.prev is not None]
    chain.told = f"{len(found.lines)} events" + (f", a chain from line {chained[0]} on" if chained else "")
    if whole:
        chain.told += f", head {hashlib.sha256(whole).hexdigest()}"
    if torn:
        chain.told += "; the last line is torn off and will be removed by the next write"
    found.findings += [
        history.pinned(board, whole, pin),
        history.history(board, whole),
        _submissions(board, found),
    ]
    found.findings.append(_results(board, found))
    return found


def write_pin(board: Board, file: Path | None = None) -> history.Pin:
    """Write a file that pins a board's log as it is; raise a BoardError unless the board is sound.

    Without a file, the package's own pin is written, if the log continues what it pins.
    """
    sound(board)
    log = read_log(board.log)
    if file is None and history.PIN.exists():
        found = history.pinned(board, log, None)
        if told := [*filter(None, [*found.wrong, found.open])]:
            raise BoardError(f"{history.PIN} stays as it is: {'; '.join(told)}; name another FILE")
    log = log[: log.rfind(b"\n") + 1]
    if not log:
        raise BoardError(f"{board.log} is empty; there is nothing to pin")
    pin = history.pin_of(log)
    write_file(file or history.PIN, json.dumps(pin.model_dump(), indent=2) + "\n")
    return pin


def _submissions(board: Board, found: CheapChecks) -> Finding:
    """Compare each submission's files with the log."""
    from lag_envs.leaderboard.submission import Refused, about, digest_of, read_files

    finding = Finding("submissions")
    entries = {entry.id: entry for entry in found.state.all}
    for entry in entries.values():
        folder = board.submission(entry.id)
        where = f"{board.log}, line {entry.line}: {folder}"
        try:
            files = read_files(folder)
        except Refused as error:
            finding.wrong.append(f"{where} is not what was added: {error}; {REMEDY}")
            continue
        if (digest := digest_of(files)) != entry.digest:
            finding.wrong.append(
                f"{where} is not what was added: its digest is {digest[:8]}..., not {entry.digest[:8]}...;"
                f" {REMEDY}"
            )
            continue
        try:
            told = found.abouts[entry.id] = about(files)
        except Refused:
            continue  # it was accepted once; since then, its environment may have been removed
        for name in ("env", "name", "authors", "kind"):
            if (noted := getattr(entry, name)) != (said := getattr(told, name)):
                finding.wrong.append(
                    f"{where} says {name} {shown_ascii(said)}, but the log {shown_ascii(noted)}; {REMEDY}"
                )
    finding.told = f"{len(entries)} are what was added"
    return finding


def _results(board: Board, found: CheapChecks) -> Finding:
    """Compare each result with the log, with the submission, and with itself."""
    finding = Finding("results")
    for entry in found.state.all:
        if not entry.sha256:
            continue
        try:
            result = board.result(entry)
        except BoardError as error:
            finding.wrong.append(f"{board.log}, line {found.verified_at(entry)}: {error}")
            continue
        where = f"{board.log}, line {found.verified_at(entry)}: {board.result_file(entry)}"
        odd = [f"{where} {what}; {REMEDY}" for what in _odd(found, entry, result)]
        # Results without a build are from before the log had a chain.
        if result.get("build") is None and found.chained(found.verified_at(entry)):
            odd.append(f"{where} does not say with which build it was made; {REMEDY}")
        finding.wrong += odd
        if not odd:
            found.results[entry.protocol, entry.id] = result
    finding.told = f"{len(found.results)} are what was verified"
    return finding


def _odd(found: CheapChecks, entry: BoardEntry, result: Mapping[str, Any]) -> Iterator[str]:
    """Yield statements of a result that cannot be true."""
    for name in ("env", "digest", "nonce"):
        if result[name] != getattr(entry, name):
            yield f"is of {name} {shown_ascii(result[name])}, not {shown_ascii(getattr(entry, name))}"
    if (told := found.state.protocols.get(entry.protocol)) is not None:
        if result["episodes"] != told.rules.episodes:
            yield f"has {result['episodes']} episodes, not {told.rules.episodes}"
        wanted = entry.env in told.references
        if any((policy.get("reference") is not None) != wanted for policy in result["policies"]):
            yield f"{'lacks' if wanted else 'has'} the returns of a reference"
    if (submission := found.abouts.get(entry.id)) is not None:  # otherwise already reported
        if tuple(policy["seed"] for policy in result["policies"]) != submission.seeds:
            yield "has other policies than the submission"
        if result.get("claimed") != claimed(submission):
            yield "does not repeat what the submission says about itself"
    middle, chosen = shown_episodes(result)
    first = protocol.first_seed(entry.digest, entry.nonce, middle)
    returns = result["policies"][middle]["returns"]
    recorded = {replay["label"]: replay for replay in result["replays"]}
    seeds = {label: replay["reset_seed"] - first for label, replay in recorded.items()}
    if seeds != chosen or len(result["replays"]) > len(seeds):
        yield "has recorded other episodes than the median, the best and the worst"
    elif result.get("build") is not None:  # before, those of random actions were redrawn
        for label, i in chosen.items():
            if abs(recorded[label]["return"] - returns[i]) > 1e-3 * max(1.0, abs(returns[i])):
                yield f"has recorded another {label} episode than was verified"
