"""One number for an agent over all boards: the mean of its scores, 0 for boards it is not on.

A score counts from 0 (random actions) to 1 (the best policy known), so a record or a disaster on one board
weighs no more than that board. A board without the agent counts 0, as if it had acted at random there, so
nobody gains by leaving out the hard ones. Two more results are shown beside the score: the number of the
agent's boards, and its profile, which is the share of the boards on which it reaches each score.

A board counts once somebody is ranked on it. An agent is identified by name and authors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.evaluation.statistics import ends

Array = NDArray[np.float64]
#: Scores of the profile.
LEVELS = (0.5, 0.9, 0.99)


class AgentIdentity(NamedTuple):
    """An agent: its name and authors."""

    name: str
    authors: tuple[str, ...]


class AgentScore(NamedTuple):
    """An agent's result on a board: the score, bootstrap samples of it, and the row's kind."""

    score: float
    drawn: Array
    kind: str


def combined(boards: Mapping[str, Mapping[AgentIdentity, AgentScore]]) -> list[dict[str, Any]]:
    """Return the agents in the order of their combined scores, in JSON types.

    Parameters
    ----------
    boards : mapping of str to mapping of AgentIdentity to AgentScore
        For each board the ranked agents.

    Returns
    -------
    list of dict
        ``name``, ``authors``, ``kind``; ``score`` and its bootstrap ``interval`` of 95 %; ``boards``, the
        number it is on, ``of`` the number there are; ``there``, its mean score on the boards it is on;
        ``profile``, pairs of a score and the share of all boards on which it has at least that.
    """
    counted = {env_id: found for env_id, found in boards.items() if found}
    rows = []
    for agent in dict.fromkeys(agent for found in counted.values() for agent in found):
        results = [found[agent] for found in counted.values() if agent in found]
        scores = np.clip([result.score for result in results], 0.0, 1.0)
        drawn = np.sum([np.clip(result.drawn, 0.0, 1.0) for result in results], axis=0) / len(counted)
        kinds = dict.fromkeys(result.kind for result in results)
        rows.append(
            {
                "name": agent.name,
                "authors": list(agent.authors),
                "kind": next(iter(kinds)) if len(kinds) == 1 else "several",
                "score": float(scores.sum() / len(counted)),
                "interval": list(ends(drawn)),
                "boards": len(results),
                "of": len(counted),
                "there": float(scores.mean()),
                "profile": [[level, float((scores >= level).sum() / len(counted))] for level in LEVELS],
            }
        )
    return sorted(rows, key=lambda row: -row["score"])
