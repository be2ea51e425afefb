"""The scale for comparing agents: 0 for the random policy, 1 for the best policy known.

The numbers belong to a version of an environment: ``-v1`` would get new ones, and these would stay.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.errors import hint
from lag_envs.scenes.checks import check_number
from lag_envs.tasks import TASKS
from lag_envs.tasks.measured import measured_entry


class Scale(Protocol):
    """The mean returns with scores 0 and 1."""

    @property
    def random(self) -> float:
        """Mean return of uniformly random actions."""

    @property
    def best(self) -> float:
        """Mean return of the best policy known."""


def normalised(scale: Scale, returns: ArrayLike) -> NDArray[np.float64]:
    """Return the scores of returns: 0 for the random policy's mean, 1 for the best known policy's mean.

    Examples
    --------
    >>> known = known_returns("PivotedBar-v0")
    >>> normalised(known, [known.random, known.best]).tolist()
    [0.0, 1.0]
    """
    return (np.asarray(returns, np.float64) - scale.random) / (scale.best - scale.random)


class KnownReturns(NamedTuple):
    """Known mean returns of an environment with its default parameters.

    `random` and `best` define the scale. They are set once; later, more precise measurements do not change
    them. In a clone, ``python -m agents.scale`` measures all of them again; ``lag_envs/tasks/measured.json``
    contains both.

    Parameters
    ----------
    random : float
        Mean return of uniformly random actions.
    best : float
        Mean return of the best policy known.
    error : float
        Standard error of `best` over its episodes.
    policy : str
        Name of the best policy.
    optimum : float, optional
        The optimum in the same episodes as `best`, if known. Otherwise ``docs/agents.md`` has estimates.
    """

    random: float
    best: float
    error: float
    policy: str
    optimum: float | None = None


def known_returns(env_id: str) -> KnownReturns | None:
    """Return the known returns of an environment; None if none were measured."""
    scale = measured_entry(env_id).get("scale")
    return scale and KnownReturns(**scale)


def score(env_id: str, mean_return: float) -> float | None:
    """Return the score of a mean return: 0 for the random policy, 1 for the best policy known.

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

    Raises
    ------
    ValueError
        For an unknown id, or a return that is not a finite number.

    Examples
    --------
    >>> score("PivotedBar-v0", 419.01)
    1.0
    """
    known = known_returns(env_id)
    if known is None:
        if env_id not in gym.registry:
            raise ValueError(f"there is no environment {env_id!r}; {hint(env_id, TASKS)}")
        return None
    return float(normalised(known, check_number("mean_return", mean_return)))


def share_of_privileged(env_id: str) -> float | None:
    """Return the best attempt's mean return as a share of the reference's, which has privileged information.

    None if the environment is not open (`lag_envs.tasks.record.Open`), or was not measured.

    Examples
    --------
    >>> share_of_privileged("PivotedBar-v0") is None
    True
    """
    found = measured_entry(env_id).get("measured", {})
    if "privileged" not in found:
        return None
    best = max(found[name]["mean"] for name in TASKS[env_id].open.tried if name in found)
    return float(best / found["privileged"]["mean"])


def in_words(env_id: str, total: float, whole: bool = True) -> str:
    """Describe an episode's return in words.

    Parameters
    ----------
    env_id : str
        Id of an environment, with its default parameters.
    total : float
        The sum of the rewards.
    whole : bool, default True
        Whether the episode ran to its end; otherwise there is no score.

    Examples
    --------
    >>> in_words("PivotedBar-v0", 209.6)
    'return 209.6, score 0.501 (0 is random, 1 the best known)'
    >>> in_words("PivotedBar-v0", -0.8)
    'return -0.8, score 0.000 (0 is random, 1 the best known)'
    >>> in_words("PivotedBar-v0", 209.6, whole=False)
    'return 209.6'
    """
    value = score(env_id, total) if whole else None
    about = "" if value is None else f", score {value:z.3f} (0 is random, 1 the best known)"
    return f"return {total:.4g}{about}"
