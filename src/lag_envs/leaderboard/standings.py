"""The data of page and tables: a board's rows with scores and ranks, and facts about the environment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lag_envs.leaderboard.board import Board, closed
from lag_envs.leaderboard.files import read_plain
from lag_envs.leaderboard.log import REMEDY, BoardEntry, BoardError, BoardState, LoggedScale, Protocol
from lag_envs.leaderboard.pending import shown_episodes
from lag_envs.leaderboard.results import PACKED, checked_value
from lag_envs.scores import KnownReturns, known_returns, normalised
from lag_envs.tasks import TASKS

if TYPE_CHECKING:
    from lag_envs.leaderboard.checks import Results
    from lag_envs.leaderboard.combined import AgentIdentity, AgentScore

#: The authors of the project's own agents; some of their frozen submissions name no code.
OURS = ("the lag_envs authors",)
#: The modules of such agents, by how their descriptions begin.
ORIGINS = {
    "agents.ppo, ": "agents.ppo",
    "Stable-Baselines3, ": "agents.learners",
    "value iteration on ": "agents.optimum",
}


def page_data(board: Board) -> dict[str, Any]:
    """Return `board_data` and what only the page needs: agents that run on the page, and human drives."""
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
            submission = load(board.submission(row["id"]))
            row["agent"] = agent(submission.policies[middle][1])
            row["module"] = submission.architecture.module or origin(
                submission.authors, submission.description
            )
    return data


def origin(authors: Sequence[str], description: str) -> str:
    """Return the module of one of the project's own agents, empty for another's.

    Examples
    --------
    >>> origin(OURS, "agents.ppo, five seeds"), origin(["somebody"], "agents.ppo, five seeds")
    ('agents.ppo', '')
    """
    found = (module for start, module in ORIGINS.items() if description.startswith(start))
    return next(found, "") if tuple(authors) == OURS else ""


def board_data(board: Board, made: str | None = None) -> dict[str, Any]:
    """Return all data that page and tables show.

    Parameters
    ----------
    board : Board
        The board.
    made : str, optional
        The date to state; by default today's.

    Returns
    -------
    dict
        JSON types. ``environments`` has every environment, with its ``rows`` in order, followed by the frozen
        boards; ``combined`` has the result of `combined.combined` for the open ones.

    Raises
    ------
    BoardError
        If something on the board is not as it was logged, see `checks.sound`.
    """
    from lag_envs.evaluation.statistics import rounded_data
    from lag_envs.leaderboard.checks import sound
    from lag_envs.leaderboard.combined import combined

    state, results = sound(board)
    current = state.number or 1
    keys = {(env_id, current): None for env_id in TASKS if not closed(env_id, current, current)}
    frozen = sorted({(e.env, e.protocol) for e in state.all} - set(keys))
    found: dict[str, dict[AgentIdentity, AgentScore]] = {}
    return {
        "protocol": current,
        "made": made or datetime.now(UTC).date().isoformat(),
        "environments": [
            *(_environment(board, state, results, *key, found.setdefault(key[0], {})) for key in keys),
            *(_environment(board, state, results, *key, {}) for key in frozen),
        ],
        "combined": rounded_data(combined(found)),
    }


def _environment(
    board: Board, state: BoardState, results: Results, env_id: str, number: int,
    reached: dict[AgentIdentity, AgentScore],
) -> dict[str, Any]:  # fmt: skip
    """Return a board, and note the results of its ranked agents."""
    entries = {e.id: e for e in state.boards.get(number, {}).values() if e.env == env_id}
    told = state.protocols.get(number)
    scale = told.scales.get(env_id) if told else None
    rows = []
    if told is not None and scale is not None:
        found = {id: results[number, id] for id, e in entries.items() if e.state == "verified"}
        rows = _rows(env_id, told, state, entries, found, reached)
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
    }


def _rows(
    env_id: str, told: Protocol, state: BoardState, entries: Mapping[str, BoardEntry],
    found: Mapping[str, dict[str, Any]], reached: dict[AgentIdentity, AgentScore],
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the rows of verified entries, in order, and note the results of those that are ranked."""
    from lag_envs.evaluation.statistics import ends, iqm, rounded_data
    from lag_envs.leaderboard import ranking
    from lag_envs.leaderboard.combined import AgentIdentity, AgentScore

    scale, reference = told.scales[env_id], told.references.get(env_id)
    scores = {id: ranking.scored(scale, reference, r["policies"]) for id, r in found.items()}
    drawn = {id: ranking.redrawn(id, each) for id, each in scores.items()}
    first = {id: state.first(entries[id]) for id in found}
    # Rows that act like an earlier one are shown, but are not ranked, and no row is compared with them.
    places = ranking.ranked({id: each for id, each in scores.items() if first[id] is None}, drawn)
    ranks = {place.id: place for place in places}
    rows = []
    for id in sorted(scores, key=lambda id: -float(iqm(scores[id].table.mean(axis=1)))):
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
            {"seed": c["seed"], "steps": c["steps"], "scores": normalised(scale, c["returns"]).tolist()}
            for c in result["claimed"]["curves"]
        ]
        row |= ranking.columns(env_id, result, told.rules.disturbed_episodes, scale, scores[id])
        samples = iqm(drawn[id])
        row["interval"] = list(ends(samples))
        if place is not None:
            agent = AgentIdentity(entry.name, tuple(entry.authors))
            reached[agent] = AgentScore(row["score"], samples, entry.kind)
        rows.append(rounded_data(row) | {"replays": _replays(result, scale)})
    return rows


def _replays(result: Mapping[str, Any], scale: LoggedScale) -> list[dict[str, Any]]:
    """Return the recorded episodes of a result, with their scores."""
    from lag_envs.evaluation.statistics import rounded_data

    middle, chosen = shown_episodes(result)
    verified = {label: result["policies"][middle]["returns"][i] for label, i in chosen.items()}
    # States, actions and rewards are stored rounded.
    return [
        replay
        | rounded_data({"return": replay["return"], "score": normalised(scale, replay["return"])})
        | {"t0": 0.0}
        for replay in result["replays"]
        # Under protocol 1, the episodes of random actions were different ones.
        if abs(replay["return"] - verified[replay["label"]]) <= 1e-3 * (scale.best - scale.random)
    ]


def _known(env_id: str, scale: Any) -> dict[str, Any] | None:
    """Return the known returns of an environment: those frozen with the protocol, if there is one."""
    found = known_returns(env_id)
    known = found and found._asdict()
    if scale is None:
        return known
    return (known or dict.fromkeys(KnownReturns._fields)) | scale.model_dump()


def _looks_like(entry: BoardEntry, entries: Iterable[BoardEntry]) -> str:
    """Return another's earlier author or name that looks like this entry's; empty if there is none."""
    from lag_envs.leaderboard.names import lookalike

    earlier = [e for e in entries if e.line < entry.line and set(e.authors).isdisjoint(entry.authors)]
    authors = list(dict.fromkeys(author for e in earlier for author in e.authors))
    for author in entry.authors:
        if found := lookalike(author, authors):
            return found
    return lookalike(entry.name, dict.fromkeys([*authors, *(e.name for e in earlier)]))


def _value(path: Path) -> dict[str, Any] | None:
    """Return a value function for the page; None if there is none."""
    try:
        return checked_value(read_plain(path, PACKED))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        told = error.strerror if isinstance(error, OSError) else error
        raise BoardError(f"{path} cannot be read: {told}; {REMEDY}, or remove it") from None
