"""The scale on which agents are compared: 0 for the random policy, 1 for the best policy known.

The numbers belong to a version of an environment: with ``-v1`` come new ones, and these stay as they are.
"""

from __future__ import annotations

from typing import NamedTuple


class Known(NamedTuple):
    """Mean returns that are known of an environment with its default parameters.

    Parameters
    ----------
    random : float
        Of uniformly random actions, over 4,096 episodes.
    best : float
        Of the best policy known.
    policy : str
        Which one that is.
    estimate : float
        The optimum, or what it is at most, as value iteration estimates it: extrapolated, not proved.
    """

    random: float
    best: float
    policy: str
    estimate: float


KNOWN_RETURNS = {
    "PivotedBar-v0": Known(-0.78, 421.0, "iLQR", 422.96),
    "PivotedBarFree-v0": Known(-2.43, 422.35, "optimal", 422.96),
    "PivotedBarBalance-v0": Known(21.3, 445.7, "LQR", 498.0),
    "InclineTilt-v0": Known(9.5, 180.9, "PPO", 182.0),
    "InclineBrake-v0": Known(-4.32, -1.7385, "optimal", -1.7396),
    "CylinderInCylinderTilt-v0": Known(42.3, 197.6, "optimal", 198.0),
    "CylinderInCylinderPump-v0": Known(6.25, 145.70, "optimal", 145.54),
    "CylinderInCylinderDamping-v0": Known(294.3, 366.7, "optimal", 367.03),
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
    >>> score("PivotedBarFree-v0", 422.35)
    1.0
    """
    known = KNOWN_RETURNS.get(env_id)
    return None if known is None else (mean_return - known.random) / (known.best - known.random)
