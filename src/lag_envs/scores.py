"""The scale on which agents are compared: 0 for the random policy, 1 for the best policy known.

The numbers belong to a version of an environment: ``-v1`` gets new ones, and these stay as they are.
"""

from __future__ import annotations

from typing import NamedTuple

from lag_envs.tasks.measured import measured


class KnownReturns(NamedTuple):
    """Known mean returns of an environment with its default parameters.

    `random` and `best` are the scale. They are set once; later, more precise measurements do not change them.
    In a clone, ``python -m agents.scale`` measures all of them again; ``lag_envs/tasks/measured.json`` has
    both.

    Parameters
    ----------
    random : float
        Of uniformly random actions.
    best : float
        Of the best policy known.
    error : float
        Standard error of `best` over its episodes.
    policy : str
        Name of the best policy.
    optimum : float, optional
        The optimum, in the same episodes as `best`, where it is known. ``docs/agents.md`` has estimates where
        it is not.
    """

    random: float
    best: float
    error: float
    policy: str
    optimum: float | None = None


def known_returns(env_id: str) -> KnownReturns | None:
    """Return the known returns of an environment; None if nothing was measured."""
    scale = measured(env_id).get("scale")
    return scale and KnownReturns(**scale)


def score(env_id: str, mean_return: float) -> float | None:
    """Return a mean return on the scale from 0, the random policy, to 1, the best policy known.

    Parameters
    ----------
    env_id : str
        Id of an environment.
    mean_return : float
        Mean return of an agent, over episodes with the environment's default parameters.

    Returns
    -------
    float or None
        The score, not clipped: below 0 is worse than random, above 1 better than the best known. None for an
        environment without known returns.

    Examples
    --------
    >>> score("PivotedBar-v0", 419.01)
    1.0
    """
    known = known_returns(env_id)
    return None if known is None else (mean_return - known.random) / (known.best - known.random)
