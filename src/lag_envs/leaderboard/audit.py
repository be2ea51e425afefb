"""Check a board as a whole: everything on it must be as it was logged, and reproducible.

After the cheap checks (`lag_envs.leaderboard.checks`), `audit` makes the slow ones: each nonce against its
public source, and results against the submissions, by playing episodes again.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lag_envs.errors import UserError
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.board import Board, others
from lag_envs.leaderboard.checks import CheapChecks, cheap
from lag_envs.leaderboard.fields import ascii_text, shown_ascii
from lag_envs.leaderboard.history import Finding, NoHistory, git, log_at
from lag_envs.leaderboard.log import COMMIT, LOG, REMEDY, Added, BoardEntry, Opened, Protocol
from lag_envs.leaderboard.parallel import shared
from lag_envs.leaderboard.pending import Neighbours, shown_episodes
from lag_envs.leaderboard.results import VerificationComparison, apart, code_digest, compare_results
from lag_envs.workers import died

#: Episodes of each policy that `audit` plays again.
SAMPLE = 4
#: Episodes of each reference that `audit` plays, and by how many standard errors their mean may be off.
REFERENCE_EPISODES, SIGMAS = 8192, 5.0


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
            where = f"{board.log}, line {found.verified_at(entry)}: {board.result_file(entry)}"
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
        line = found.verified_at(entry)
        noted = {like.id: like for like in entry.alike}
        for other in others(found.state, entry):
            if found.verified_at(other) > line:
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
