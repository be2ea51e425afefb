"""The scale on which agents are compared: 0 for the random policy, 1 for the best policy known.

The numbers belong to a version of an environment: with ``-v1`` come new ones, and these stay as they are.
"""

from __future__ import annotations

from typing import NamedTuple


class Known(NamedTuple):
    """Mean returns that are known of an environment with its default parameters.

    In a clone, ``python -m agents.scale`` measures `random` and `best` anew.

    Parameters
    ----------
    random : float
        Of uniformly random actions, over 65,536 episodes.
    best : float
        Of the best policy known: over 65,536 episodes or more, or where it takes long, over 1,000 and
        corrected by how lucky a quick controller was in the same ones.
    policy : str
        Which one that is.
    estimate : float
        What the optimum is at most, as value iteration estimates it: extrapolated to a grid without width,
        not proved. It too is corrected for luck: what ``agents/results/optimum`` tells is of 1,000 episodes.
        Where a relaxed task was solved, the optimum is lower.
    """

    random: float
    best: float
    policy: str
    estimate: float


# Standard errors of the best: .01 to .03, but for Brake .001, Balance .14 and Damping .2.
KNOWN_RETURNS = {
    "PivotedBar-v0": Known(-0.72, 419.01, "iLQR", 423.1),
    "PivotedBarFree-v0": Known(-2.41, 422.49, "iLQR", 423.2),
    "PivotedBarBalance-v0": Known(21.4, 452.7, "LQR", 498.0),
    "InclineTilt-v0": Known(9.41, 181.57, "iLQR", 181.9),
    "InclineBrake-v0": Known(-4.325, -1.724, "switching line", -1.724),
    "CylinderInCylinderTilt-v0": Known(41.9, 197.67, "iLQR", 197.7),
    "CylinderInCylinderPump-v0": Known(6.25, 145.70, "optimal", 147.4),
    "CylinderInCylinderDamping-v0": Known(293.3, 367.1, "optimal", 367.6),
}


def score(env_id: str, mean_return: float) -> float | None:
    """Return how far a mean return lies on the way from the random policy's to the best one known.

    Parameters
    ----------
    env_id : str
        Id of an environment.
    mean_return : float
        Mean return of an agent, over episodes with the environment's default parameters.

    Returns
    -------
    float or None
        The score, not clipped: below 0 is worse than random, above 1 better than what was known. None for an
        environment of which nothing is known.

    Examples
    --------
    >>> score("PivotedBarFree-v0", 422.49)
    1.0
    """
    known = KNOWN_RETURNS.get(env_id)
    return None if known is None else (mean_return - known.random) / (known.best - known.random)
