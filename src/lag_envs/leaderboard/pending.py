"""Process pending submissions: verify, record, and compare with those already there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.board import Board, closed, current
from lag_envs.leaderboard.log import REMEDY, Alike, BoardEntry, BoardError
from lag_envs.leaderboard.results import checked_result

if TYPE_CHECKING:
    from lag_envs.leaderboard.submission import About, Submission


def check_pending(
    entries: Mapping[str, tuple[str, str]], folder: Path, progress: Callable[[int, int], Any] | None = None
) -> dict[str, Any]:
    """Process a pending submission, here or on another machine; return the result for the board.

    Parameters
    ----------
    entries : mapping of str to (digest, nonce)
        The digest and nonce of each submission, by the name of its folder.
    folder : Path
        The submission.
    progress : callable, optional
        As for `verify`.

    Raises
    ------
    Refused
        If it is not acceptable.
    """
    from lag_envs.leaderboard.alike import check_twins
    from lag_envs.leaderboard.submission import Refused, load
    from lag_envs.leaderboard.verify import verify

    digest, nonce = entries[folder.name]
    submission = load(folder)
    if submission.digest != digest:
        raise Refused("its files are not those that were added")
    check_twins(submission, nonce)
    result = verify(submission, nonce, protocol.EPISODES, progress)
    # A result that the board cannot keep fails here, without harm to the others.
    return checked_result(result | {"claimed": claimed(submission), "replays": replays(submission, result)})


def claimed(submission: About) -> dict[str, Any]:
    """Return a submission's unverified statements about itself."""
    training = submission.training
    return {
        "code": submission.code or None,
        "license": submission.license,
        "description": submission.description,
        "env_steps": training.get("env_steps"),
        "seconds": training.get("seconds"),
        "hardware": training.get("hardware"),
        "curves": training.get("curves", []),
    }


def replays(submission: Submission, result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return recordings of the median policy's median, best and worst episode."""
    from lag_envs.leaderboard.verify import record_again

    policy, chosen = shown_episodes(result)
    _, found = record_again(submission, result, policy, list(chosen.values()))
    return [{"label": label} | episode for label, episode in zip(chosen, found, strict=True)]


def shown_episodes(result: Mapping[str, Any]) -> tuple[int, dict[str, int]]:
    """Return the number of the median policy, and those of its median, best and worst episode."""
    import numpy as np

    returns = np.array([policy["returns"] for policy in result["policies"]])
    policy = int(np.argsort(returns.mean(axis=1), kind="stable")[(len(returns) - 1) // 2])
    order = np.argsort(returns[policy], kind="stable")
    chosen = {"median": order[(len(order) - 1) // 2], "best": order[-1], "worst": order[0]}
    return policy, {label: int(i) for label, i in chosen.items()}


def finish(
    board: Board,
    parallel_map: Callable[..., Iterable[tuple[Path, Any]]] | None = None,
    tell: Callable[[BoardEntry, str], Any] = lambda entry, what: None,
) -> int:
    """Verify all pending submissions that have a nonce.

    Parameters
    ----------
    board : Board
        The board.
    parallel_map : callable, optional
        Like `map_submissions`, with only its first two arguments; by default, one after the other.
    tell : callable
        Called with each entry and its outcome.

    Returns
    -------
    int
        How many could not be verified through no fault of their own; they stay pending.
    """
    from lag_envs.leaderboard.parallel import map_submissions
    from lag_envs.leaderboard.submission import Refused

    failed = 0
    state = board.read()
    if state.waiting():
        current(state, "verify submissions of")
    with ExitStack() as reserved:
        reserved_here: dict[str, tuple[BoardEntry, str]] = {}
        for entry in state.waiting():
            if reason := closed(entry.env, entry.protocol, state.number):
                board.rejected(entry.id, f"its board closed before it was verified: {reason}")
            elif not reserved.enter_context(board.reserved(entry.id)):
                tell(entry, "another process is verifying it")
                continue
            else:
                state = board.read()  # another process may just have finished it
                nonce = state.nonce(entry)
                if state.entry(entry.id).state == "pending" and nonce is not None:
                    reserved_here[entry.id] = entry, nonce
                    continue
            tell(entry, _outcome(board, entry))
        entries = {id: (entry.digest, nonce) for id, (entry, nonce) in reserved_here.items()}
        folders = [board.submission(id) for id in reserved_here]
        neighbours = Neighbours(board)
        for folder, result in (parallel_map or map_submissions)(partial(check_pending, entries), folders):
            entry = reserved_here[folder.name][0]
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

    def alike(self, entry: BoardEntry, result: Mapping[str, Any], other: BoardEntry) -> Alike | None:
        """Return how close another submission is to one just verified; None if they are not alike."""
        from lag_envs.leaderboard.alike import Likeness
        from lag_envs.leaderboard.ranking import policy_error

        reference = self._protocols[entry.protocol].references.get(entry.env)
        results = (result, self.board.result(other))
        error = max(policy_error(reference, each["policies"]) or 0.0 for each in results)
        likeness = self._likeness.setdefault(
            (entry.env, result["nonce"]), Likeness(entry.env, result["nonce"])
        )
        older, newer = sorted((entry, other), key=lambda each: each.line)
        found = likeness(self._load(newer), self._load(older), error)
        if found.closeness >= 1.0:
            return None
        return Alike(id=other.id, actions=found.actions, returns=found.returns)

    def _load(self, entry: BoardEntry) -> Submission:
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


def _outcome(board: Board, entry: BoardEntry) -> str:
    now = board.read().entry(entry.id)
    if now.state == "pending":
        return f"pending, until a nonce is published: `lag-envs leaderboard nonce{board.option}`"
    return f"{now.state}: {now.reason}" if now.reason else now.state
