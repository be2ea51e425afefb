"""The policies that come with the package: the board's best networks and tables that are small enough.

``python -m lag_envs.leaderboard.shipped`` chooses them from a clone's board and writes them beside this file.
Together they have at most `MOST` bytes; if the best ones are larger, some are replaced by smaller ones,
chosen so that the least score per byte is lost. Controllers are in the package anyway.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lag_envs.errors import UserError, run_shown
from lag_envs.options import module_parser
from lag_envs.store import write_file

FOLDER = Path(__file__).parent / "best"
INDEX = "policies.json"
#: Bytes of all arrays together; the index has a few kB more.
MOST = 1_000_000


class Shipped(NamedTuple):
    """A policy that comes with the package.

    Attributes
    ----------
    name : str
        Its name on the board.
    score : float
        Its verified score on the board.
    submission : str
        The submission's id.
    seed : int
        The policy's training seed.
    policy : mapping
        The table ``[policy]`` of its ``submission.toml``.
    """

    name: str
    score: float
    submission: str
    seed: int
    policy: Mapping[str, Any]


def shipped() -> dict[str, Shipped]:
    """Return the shipped policies, by environment."""
    found = json.loads((FOLDER / INDEX).read_text(encoding="utf-8"))
    return {env_id: Shipped(**entry) for env_id, entry in found.items()}


def load(env_id: str) -> Any:
    """Return an environment's policy, with the `predict` of Stable-Baselines3."""
    from lag_envs.leaderboard.policies import SubmittedPolicy, architecture
    from lag_envs.leaderboard.submission import read_arrays

    made = architecture(env_id, shipped()[env_id].policy)
    file = FOLDER / f"{env_id}.safetensors"
    return SubmittedPolicy(made, read_arrays(file.name, file.read_bytes(), made)).agent()


# --- choosing them ------------------------------------------------------------------------------------------


class Candidate(NamedTuple):
    """A policy of the board."""

    env: str
    score: float
    size: int
    submission: str
    seed: int
    name: str


def board_candidates(board: Any) -> list[Candidate]:
    """Return the verified policies of a board that have arrays."""
    from lag_envs.leaderboard.protocol import reference
    from lag_envs.leaderboard.ranking import corrected
    from lag_envs.scores import known_returns, normalised
    from lag_envs.tasks import TASKS

    found = []
    for entry in board.read().entries.values():
        scale = known_returns(entry.env) if entry.env in TASKS else None
        if entry.state != "verified" or entry.kind == "controller" or scale is None:
            continue
        policies = board.result(entry)["policies"]
        scores = normalised(scale, corrected(reference(entry.env), policies)).mean(axis=1)
        for policy, score in zip(policies, scores.tolist(), strict=True):
            file = board.submission(entry.id) / f"policy_{policy['seed']}.safetensors"
            found.append(
                Candidate(entry.env, score, file.stat().st_size, entry.id, policy["seed"], entry.name)
            )
    return found


def chosen_candidates(of: Iterable[Candidate], most: int = MOST) -> dict[str, Candidate]:
    """Return the best for each environment; if they are too large together, replace where that costs least.

    Examples
    --------
    >>> large, small = Candidate("A", 1.0, 90, "a", 0, "table"), Candidate("A", 0.9, 10, "b", 0, "network")
    >>> other = Candidate("B", 1.0, 50, "c", 0, "table")
    >>> sorted(c.name for c in chosen_candidates([large, small, other], 140).values())
    ['table', 'table']
    >>> sorted(c.name for c in chosen_candidates([large, small, other], 139).values())
    ['network', 'table']
    """
    ranked = sorted(of, key=lambda c: (-c.score, c.size, c.submission, c.seed))
    best: dict[str, Candidate] = {}
    for candidate in ranked:
        best.setdefault(candidate.env, candidate)
    while sum(c.size for c in best.values()) > most:
        smaller = [c for c in ranked if c.size < best[c.env].size]
        if not smaller:
            raise UserError(f"no choice of policies has at most {most:,} bytes in total")
        least = min(smaller, key=lambda c: (best[c.env].score - c.score) / (best[c.env].size - c.size))
        best[least.env] = least
    return best


def ship(board: Any, folder: Path = FOLDER) -> dict[str, Shipped]:
    """Write a board's policies to ship with the package; return them."""
    import tomllib

    from lag_envs.tasks import TASKS

    best, index = chosen_candidates(board_candidates(board)), {}
    if not best:
        raise UserError(f"{board.folder} has no verified policies; name the board's folder with --board")
    for left in folder.glob("*.safetensors"):
        left.unlink()
    for env_id in filter(best.__contains__, TASKS):
        found = best[env_id]
        place = board.submission(found.submission)
        table = tomllib.loads((place / "submission.toml").read_text(encoding="utf-8"))["policy"]
        write_file(
            folder / f"{env_id}.safetensors", (place / f"policy_{found.seed}.safetensors").read_bytes()
        )
        index[env_id] = Shipped(found.name, round(found.score, 4), found.submission, found.seed, table)
    text = json.dumps({env_id: entry._asdict() for env_id, entry in index.items()}, indent=1)
    write_file(folder / INDEX, text + "\n")
    return index


def main(arguments: Sequence[str] | None = None) -> int:
    """Choose and write the policies; return the exit status, see `run_shown`."""
    from lag_envs.leaderboard.board import Board

    parser = module_parser(
        "lag_envs.leaderboard.shipped",
        "Write the policies that come with the package: the best on the board, as data.",
        "examples:\n  python -m lag_envs.leaderboard.shipped",
    )
    parser.add_argument(
        "--board", metavar="FOLDER", type=Path, default=Path("leaderboard"), help="default: leaderboard"
    )
    board = Board(parser.parse_args(arguments).board)

    def choose() -> int:
        for env_id, entry in ship(board).items():
            size = (FOLDER / f"{env_id}.safetensors").stat().st_size
            print(f"{env_id}: {entry.name}, seed {entry.seed}, score {entry.score:.4f}, {size:,} bytes")
        return 0

    return run_shown(parser.prog, choose)


if __name__ == "__main__":
    sys.exit(main())
