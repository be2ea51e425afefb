"""Check a board against its own log: everything on it must be as it was logged.

The cheap checks (`sound`) run wherever the board is shown: the log's chain, the release's pin, the log in
earlier commits, each submission against its digest and the log, each result against its hash and its own
statements. `audit` adds the slow ones: each nonce against its public source, and results against the
submissions, by playing episodes again.

One thing cannot be detected: a history rewritten as a whole, commits and all, when nobody has an older copy,
a release or its pin to compare with.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from lag_envs.errors import UserError
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.board import Board, others
from lag_envs.leaderboard.fields import Strict, ascii_text, checked, shown_ascii
from lag_envs.leaderboard.files import read_plain
from lag_envs.leaderboard.log import (
    COMMIT,
    LOG,
    MOST,
    REMEDY,
    Added,
    BoardEntry,
    BoardError,
    BoardState,
    Hash,
    LogLine,
    Opened,
    Protocol,
    fold,
    load_json,
    parse,
    read_log,
)
from lag_envs.leaderboard.parallel import shared
from lag_envs.leaderboard.pending import Neighbours, claimed, shown_episodes
from lag_envs.leaderboard.results import VerificationComparison, apart, code_digest, compare_results
from lag_envs.store import write_file
from lag_envs.workers import died

if TYPE_CHECKING:
    from lag_envs.leaderboard.submission import About

#: The release's record of the repository's board.
PIN = Path(__file__).with_name("pin.json")
#: Episodes of each policy that `audit` plays again.
SAMPLE = 4
#: Episodes of each reference that `audit` plays, and by how many standard errors their mean may be off.
REFERENCE_EPISODES, SIGMAS = 8192, 5.0

Results = dict[tuple[int, str], dict[str, Any]]


class Pin(Strict):
    """The head of a log's chain: its number of lines, the hash of the first line, and that of all of them."""

    board: Hash
    lines: Annotated[int, Field(ge=1)]
    head: Hash


@dataclass
class Finding:
    """What a check found: a summary if all is well, and everything that is wrong."""

    name: str
    told: str = ""
    wrong: list[str] = field(default_factory=list)
    #: Why the check could not be made, and who could make it.
    open: str = ""


# --- the cheap checks ---------------------------------------------------------------------------------------


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
        found.findings.append(_history(board, found.log))
        return found
    whole = found.log[: len(found.log) - len(torn)]
    chained = [line.number for line in found.lines if line.event.prev is not None]
    chain.told = f"{len(found.lines)} events" + (f", a chain from line {chained[0]} on" if chained else "")
    if whole:
        chain.told += f", head {hashlib.sha256(whole).hexdigest()}"
    if torn:
        chain.told += "; the last line is torn off and will be removed by the next write"
    found.findings += [
        _pinned(board, whole, pin),
        _history(board, whole),
        _submissions(board, found),
    ]
    found.findings.append(_results(board, found))
    return found


def pin_of(log: bytes) -> Pin:
    """Return a release's pin of a log."""
    first = hashlib.sha256(log[: log.index(b"\n") + 1]).hexdigest()
    return Pin(board=first, lines=log.count(b"\n"), head=hashlib.sha256(log).hexdigest())


def write_pin(board: Board, file: Path | None = None) -> Pin:
    """Write a file that pins a board's log as it is; raise a BoardError unless the board is sound.

    Without a file, the package's own pin is written, if the log continues what it pins.
    """
    sound(board)
    log = read_log(board.log)
    if file is None and PIN.exists():
        found = _pinned(board, log, None)
        if told := [*filter(None, [*found.wrong, found.open])]:
            raise BoardError(f"{PIN} stays as it is: {'; '.join(told)}; name another FILE")
    log = log[: log.rfind(b"\n") + 1]
    if not log:
        raise BoardError(f"{board.log} is empty; there is nothing to pin")
    pin = pin_of(log)
    write_file(file or PIN, json.dumps(pin.model_dump(), indent=2) + "\n")
    return pin


def _pinned(board: Board, log: bytes, file: Path | None) -> Finding:
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
            finding.wrong.append(f"{board.log}, line {_verified_at(found, entry)}: {error}")
            continue
        where = f"{board.log}, line {_verified_at(found, entry)}: {board.result_file(entry)}"
        odd = [f"{where} {what}; {REMEDY}" for what in _odd(found, entry, result)]
        # Results without a build are from before the log had a chain.
        if result.get("build") is None and found.chained(_verified_at(found, entry)):
            odd.append(f"{where} does not say with which build it was made; {REMEDY}")
        finding.wrong += odd
        if not odd:
            found.results[entry.protocol, entry.id] = result
    finding.told = f"{len(found.results)} are what was verified"
    return finding


def _verified_at(found: CheapChecks, entry: BoardEntry) -> int:
    """Return the line that says that an entry was verified."""
    return next(
        line.number
        for line in found.lines
        if line.event.event == "verified" and line.event.id == entry.id and line.number > entry.since
    )


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


# --- the repository -----------------------------------------------------------------------------------------


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


def _history(board: Board, log: bytes) -> Finding:
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


def _nonces(board: Board, found: CheapChecks) -> Finding:
    """Check each nonce's source: its commit must hold everything the nonce decides, and be in the history."""
    finding = Finding("nonces")
    held, elsewhere = 0, []
    for number, value, source in found.state.nonces:
        where = f"{board.log}, line {number}: the nonce {shown_ascii(value)}"
        if source not in ("", COMMIT):
            elsewhere.append(f"line {number}: {value} by {source}")
            continue
        if not re.fullmatch(r"[0-9a-f]{40}([0-9a-f]{24})?", value):
            finding.wrong.append(
                f"{where} names no public source, so it may have been chosen; withdraw what was verified"
                " with it"
            )
            continue
        try:
            if git(board.folder, "rev-parse", "--is-shallow-repository").strip() == b"true":
                raise NoHistory("the clone is shallow")
        except NoHistory as error:
            finding.open = str(error)
            continue
        try:
            git(board.folder, "merge-base", "--is-ancestor", value, "HEAD")
            then = log_at(board.folder, value)
        except NoHistory:
            finding.wrong.append(
                f"{where} is not a commit in the history of the checkout; fetch the whole history, or"
                " withdraw what was verified with it"
            )
            continue
        lines = then.count(b"\n")
        decided = [
            line.number
            for line in found.lines
            if lines < line.number < number and isinstance(line.event, Added | Opened | Protocol)
        ]
        if lines >= number or not found.log.startswith(then):
            finding.wrong.append(f"{where} is the hash of a commit that held another log; {REMEDY}")
        elif decided:
            finding.wrong.append(
                f"{where} is the hash of a commit made before line {decided[0]}, which it decides, so"
                " it was known; withdraw what was added by then"
            )
        else:
            held += 1
    finding.told = f"{held} are commits that held all they decide"
    if elsewhere:
        finding.told += "; to be checked against their sources: " + ", ".join(elsewhere)
    return finding


# --- the slow checks ----------------------------------------------------------------------------------------


def audit(
    board: Board,
    pin: Path | None = None,
    everything: bool = False,
    tell: Callable[[Finding], Any] = lambda finding: None,
    progress: Callable[[BoardEntry], Any] = lambda entry: None,
    jobs: int = 1,
) -> bool:
    """Run all checks; return True if nothing is wrong.

    Parameters
    ----------
    board : Board
        The board.
    pin : Path, optional
        Pin to compare the log with; by default the release's own, if it is of this board.
    everything : bool
        Whether to verify every result again, as a whole, and to compare all submissions with each other. By
        default, `SAMPLE` episodes of each policy and the recorded ones are played again.
    tell : callable
        Called with each finding.
    progress : callable
        Called with each entry when its result is checked.
    jobs : int
        Number of processes that play the episodes.
    """
    found = cheap(board, pin)
    findings = list(found.findings)
    for finding in findings:
        tell(finding)
    if not found.findings[0].wrong:
        scores = partial(_all if everything else _sample, board, found, progress, jobs)
        for check in (partial(_nonces, board, found), scores):
            finding = check()
            findings.append(finding)
            tell(finding)
    return not any(finding.wrong for finding in findings)


def _work(board: Board, found: CheapChecks) -> list[tuple[tuple[BoardEntry, str], tuple]]:
    """Return all that can be verified again: entry and place for messages; folder, result, way and nonce.

    The way is the best return minus random. Submissions that plan come first, because they take longest.
    """
    from lag_envs.leaderboard.submission import Refused, load

    work: list[tuple[tuple[BoardEntry, str], tuple]] = []
    for (number, id), result in found.results.items():
        entry = found.state.boards[number][id]
        told = found.state.protocols.get(number)
        scale = told.scales.get(entry.env) if told else None
        if told is None or scale is None or told.rules.model_dump() != protocol.rules():
            continue
        folder = board.submission(entry.id)
        try:
            submission = load(folder)
        except Refused:
            continue
        if submission.digest == entry.digest:  # otherwise already reported
            where = f"{board.log}, line {_verified_at(found, entry)}: {board.result_file(entry)}"
            one = (entry, where), (folder, result, scale.best - scale.random, entry.nonce)
            work.insert(0 if submission.architecture.plans else len(work), one)
    return work


def _sample(board: Board, found: CheapChecks, progress: Callable[[BoardEntry], Any], jobs: int) -> Finding:
    """Play the recorded episodes of each policy again, and some more that cannot be foreseen."""
    finding, played, wrong = Finding("scores"), 0, {}
    work = _work(board, found)
    for (entry, where), outcome in shared(work, _played_again, jobs):
        progress(entry)
        if isinstance(outcome, BaseException):
            outcome = 0, [f"policies that cannot be played: {died(outcome)}"]
        played += outcome[0]
        wrong[where] = [f"{where} has {ascii_text(what)}; verify {entry.id} again" for what in outcome[1]]
    finding.wrong += [text for (_, where), _ in work for text in wrong[where]]
    finding.told = f"{played} episodes of {len(work)} results were played again"
    return finding


def _played_again(folder: Path, result: dict[str, Any], way: float, _: str) -> tuple[int, list[str]]:
    """Play some episodes of a submission again; return how many, and in what they differ from its result."""
    from lag_envs.evaluation.rollout import PolicyError
    from lag_envs.leaderboard.submission import Refused, load
    from lag_envs.leaderboard.verify import record_again

    submission, draw, played = load(folder), random.SystemRandom(), 0
    middle, recorded = shown_episodes(result)
    odd: list[str] = []
    # On another build, one of these few episodes may be a different one altogether.
    tolerated = int(result.get("build") != code_digest())
    plans = submission.architecture.plans
    for number, policy in enumerate(result["policies"]):
        chosen = draw.sample(range(result["episodes"]), min(SAMPLE, result["episodes"]))
        if number == middle:
            chosen += [i for i in recorded.values() if i not in chosen]
        try:
            again, episodes = record_again(submission, dict(result), number, chosen)
        except (PolicyError, Refused) as error:
            odd.append(f"a policy that cannot be played: {error}")
            continue
        played += len(chosen)
        kept = {
            name: [values[i] for i in chosen] if isinstance(values, list) else values
            for name, values in policy.items()
        }
        odd += [
            f"other {name} than episodes {chosen} of seed {policy['seed']} have"
            for name, share in apart(kept, again, way, plans).items()
            if round(share * len(chosen)) > tolerated
        ]
        if number == middle and result.get("build") is not None and not plans:
            made = {episode["reset_seed"]: episode for episode in episodes}
            odd += [
                f"another recorded episode ({told['label']}) than is played"
                for told in result["replays"]
                if not _same_episode(told, made[told["reset_seed"]])
            ][tolerated:]
    return played, odd


def _same_episode(kept: Mapping[str, Any], made: Mapping[str, Any]) -> bool:
    """Return whether two episodes are the same, to the digits that are recorded."""
    if any(len(kept[name]) != len(made[name]) for name in ("states", "actions", "rewards")):
        return False
    if any(kept[name] != made[name] for name in ("seed", "reset_seed", "dt", "target")):
        return False
    rows = [*zip(kept["states"], made["states"], strict=True)]
    rows += [(kept[name], made[name]) for name in ("actions", "rewards", "return")]
    pairs = [(np.array(a, np.float64), np.array(b, np.float64)) for a, b in rows]
    return all(
        a.shape == b.shape and bool((np.abs(a - b) <= 1e-3 * np.maximum(1.0, np.abs(b))).all())
        for a, b in pairs
    )


def _all(board: Board, found: CheapChecks, progress: Callable[[BoardEntry], Any], jobs: int) -> Finding:
    """Verify every result again, compare all submissions, and play the references."""
    finding, same, bits, wrong = Finding("scores"), 0, 0, {}
    work = _work(board, found)
    for (entry, where), outcome in shared(work, _verified_again, jobs):
        progress(entry)
        if isinstance(outcome, BaseException):
            why = str(outcome) if isinstance(outcome, UserError | ValueError) else died(outcome)
            wrong[where] = [f"{where} cannot be verified again: {ascii_text(why)}; withdraw {entry.id}"]
            continue
        wrong[where] = [f"{where} differs in {what}; verify {entry.id} again" for what in outcome.far]
        same, bits = same + (not outcome.far), bits + outcome.same
    finding.wrong += [text for (_, where), _ in work for text in wrong[where]]
    finding.told = f"{same} results were reproduced, {bits} of them to the bit"
    for what in (*_links(board, found), *_references(found)):
        finding.wrong.append(what)
    return finding


def _verified_again(folder: Path, result: dict[str, Any], way: float, nonce: str) -> VerificationComparison:
    """Verify a submission again, and compare with its result."""
    from lag_envs.leaderboard.submission import load
    from lag_envs.leaderboard.verify import verify

    submission = load(folder)
    again = verify(submission, nonce, result["episodes"])
    return compare_results(result, again, way, submission.architecture.plans)


def _links(board: Board, found: CheapChecks) -> Iterator[str]:
    """Yield policies that act alike but are not noted as alike, and those noted that do not act alike."""
    neighbours = Neighbours(board)
    for entry in found.state.entries.values():
        if (entry.protocol, entry.id) not in found.results:
            continue
        # The entry was compared with all that had been verified by then.
        line = _verified_at(found, entry)
        noted = {like.id: like for like in entry.alike}
        for other in others(found.state, entry):
            if _verified_at(found, other) > line:
                continue
            near = neighbours.alike(entry, found.results[entry.protocol, entry.id], other)
            if (near is None) != (other.id not in noted):
                how = "unlike" if near is None else "alike"
                yield (
                    f"{board.log}, line {line}: {entry.id} and {other.id} act {how}, which is not what is"
                    f" noted; {REMEDY}"
                )


def _references(found: CheapChecks) -> Iterator[str]:
    """Yield references whose mean return is not the one that the log states."""
    from lag_envs.controllers import make_controller
    from lag_envs.evaluation.rollout import play

    told = found.state.protocols.get(found.state.number)
    for env_id, reference in (told.references if told else {}).items():
        first = 2**50 + random.SystemRandom().randrange(2**40)
        returns = play(
            env_id, make_controller(env_id, reference.controller), range(first, first + REFERENCE_EPISODES)
        )
        # Rare falls may be missing from these episodes: use at least the spread of all those in the log.
        spread = max(returns.std(), reference.error * reference.episodes**0.5)
        error = (spread**2 / len(returns) + reference.error**2) ** 0.5
        if abs(returns.mean() - reference.mean) > SIGMAS * error:
            yield (
                f"{LOG}: {reference.controller} gets {returns.mean():.6g} ± {error:.2g} in {env_id}, not"
                f" {reference.mean:.6g}; `lag-envs leaderboard open` begins a protocol with the right mean"
            )
