"""What a score on the leaderboard means: episodes, seeds, success, disturbances, and limits of a submission.

A board freezes this, with the scale, when a protocol begins (`rules`); where something of it changes, the
board has to begin the next one.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.tasks import TASKS, load_task
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]

#: Version of ``submission.toml``.
SCHEMA = 1
#: Episodes of each policy, and those under each disturbance.
EPISODES, DISTURBED_EPISODES = 1000, 100
#: Policies that a learner submits at least, one per training seed; and that anyone submits at most.
LEARNED_POLICIES, MOST_POLICIES = 5, 20
#: How far returns may lie apart on two builds, relative to the way from random to best known. Libraries round
#: the last digit of tanh differently, and that may grow in the course of an episode.
TOLERANCE = 1e-3
#: The same for one who plans: where a rounding decides between two steps of its search, all that follows is
#: another plan, nearly as good, and so each of its episodes may be another one.
PLANNED = 1e-2
#: Share of episodes that may lie further apart than that: where a rounding decides, all else may follow.
APART = 0.01


class Refused(Exception):
    """A submission that is not accepted; the text says why, and is safe to print."""


# --- limits of a submission ---------------------------------------------------------------------------------

#: Bytes of ``submission.toml``, of one policy's arrays, of all together; characters of a line of the TOML.
TOML_BYTES, POLICY_BYTES, FOLDER_BYTES, LINE = 65_536, 4_194_304, 16_777_216, 1_000
#: Bytes of the header of a safetensors file.
HEADER_BYTES = 16_384
#: Hidden layers, their width, and numbers of a network.
LAYERS, WIDTH, NUMBERS = 8, 1_024, 131_072
#: Numbers of all networks of a submission, and CPU time of a verification [s].
ALL_NUMBERS, CPU_SECONDS = 1_048_576, 3_600.0
#: Numbers nearer to 0 count as 0: arithmetic with subnormal ones takes fifty times as long.
TINY = 1e-150
#: Points of a learning curve.
CURVE = 200


# --- seeds --------------------------------------------------------------------------------------------------


def first_seed(digest: str, nonce: str, policy: int) -> int:
    """Return the reset seed of a policy's first episode; episode i has the i-th after it.

    Nobody can train on them: they follow from the submission's own bytes and from a nonce that is published
    later.

    Parameters
    ----------
    digest : str
        The submission's digest.
    nonce : str
        The nonce.
    policy : int
        Number of the policy in the submission, from 0.
    """
    text = hashlib.sha256(f"{digest}\n{nonce}\n{policy}\n".encode()).digest()
    # Far beyond the seeds that people train with.
    return 2**40 + int.from_bytes(text[:8], "big") % 2**62


# --- luck ---------------------------------------------------------------------------------------------------


class Reference(NamedTuple):
    """A quick controller that plays the episodes of a verification too, see `ranking.corrected`.

    Parameters
    ----------
    controller : str
        One of ``lag_envs.controllers.CONTROLLERS``.
    mean, error : float
        Its mean return in other episodes, and the standard error of that.
    episodes : int
        How many these were.
    """

    controller: str
    mean: float
    error: float
    episodes: int


#: For each environment in which episodes differ much. ``python -m agents.scale`` measures them anew.
REFERENCES: dict[str, Reference] = {
    "PivotedBarBalance-v0": Reference("LQR", 452.49, 0.139, 524_288),
    "InclineTilt-v0": Reference("cascade", 181.307, 0.025, 524_288),
    "CylinderInCylinderDamping-v0": Reference("switching line", 366.76, 0.063, 524_288),
    "InclineBrake-v0": Reference("switching line", -1.72433, 0.00043, 524_288),
    "CylinderInCylinderTilt-v0": Reference("LQR", 197.634, 0.0025, 524_288),
    "CylinderInCylinderPump-v0": Reference("energy pump", 141.934, 0.0041, 524_288),
}

# --- success ------------------------------------------------------------------------------------------------


class Goal(NamedTuple):
    """When an episode counts as a success, and when its goal is reached.

    Parameters
    ----------
    text : str
        Both, in words.
    inside : callable
        From the task, states (n, n_state) at a step's end and targets (n,) to whether the goal holds, (n,).
    hold : float or None
        Seconds before the episode's end from which on the goal must hold without a break. None: it need not.
    terminated : bool or None
        Whether the episode must have terminated. None: must not, and reaching the goal does not matter.
    """

    text: str
    inside: Callable[[Task, Array, Array], NDArray[np.bool_]]
    hold: float | None = 1.0
    terminated: bool | None = False


def _upright(task: Task, states: Array, targets: Array) -> NDArray[np.bool_]:
    off = np.remainder(states[:, -2], 2.0 * math.pi) - math.pi
    return np.abs(off) <= 0.2


def _near(distance: float) -> Callable[[Task, Array, Array], NDArray[np.bool_]]:
    return lambda task, states, targets: np.abs(states[:, 0] - targets) <= distance


def _gently_across(task: Task, states: Array, targets: Array) -> NDArray[np.bool_]:
    return (states[:, 0] >= 0.0) & (states[:, 1] <= 0.55)


def _swinging(task: Any, states: Array, targets: Array) -> NDArray[np.bool_]:
    energy, wanted = task.energies(states.T, np)
    return np.abs(energy - wanted) <= 0.2 * wanted


def _at_rest(task: Any, states: Array, targets: Array) -> NDArray[np.bool_]:
    return states[:, 0] ** 2 + states[:, 1] ** 2 / task.weight() <= 0.1**2


_SWING_UP = Goal(
    "success: within 0.2 rad of upright throughout the last second; time: until it is so for good", _upright
)
#: The environments that have a board.
GOALS: dict[str, Goal] = {
    "PivotedBar-v0": _SWING_UP,
    "PivotedBarFree-v0": _SWING_UP,
    "PivotedBarBalance-v0": Goal(
        "success: neither the bar nor the support leaves its limits in 10 s; there is no time",
        lambda task, states, targets: np.zeros(len(states), np.bool_), None, None,
    ),
    "InclineTilt-v0": Goal(
        "success: within 5 cm of the mark throughout the last second; time: until it is so for good",
        _near(0.05),
    ),
    "InclineBrake-v0": Goal(
        "success: across the line, at 0.55 m/s at most at the end of that step; time: until then",
        _gently_across, None, True,
    ),
    "CylinderInCylinderTilt-v0": Goal(
        "success: within 0.05 rad of the target throughout the last second; time: until it is so for good",
        _near(0.05),
    ),
    "CylinderInCylinderPump-v0": Goal(
        "success: energy within 20 % of the wanted one throughout the last second; time: until it is so for "
        "good",
        _swinging,
    ),
    "CylinderInCylinderDamping-v0": Goal(
        "success: never loses contact in 10 s; time: until it comes to rest first, √(θ² + θ'²/ω₀²) <= 0.1",
        _at_rest, None, None,
    ),
}  # fmt: skip


# --- disturbances -------------------------------------------------------------------------------------------


def make_task(env_id: str, **options: Any) -> Task:
    """Return the task of an environment, with parameters that differ from its own."""
    place, fixed = TASKS[env_id]
    return load_task(place)(**(fixed | options))


def often(env_id: str) -> dict[str, Any]:
    """Return the environment's arguments for acting ten times as often; a second is worth the same."""
    return {"dt": make_task(env_id).interval / 10.0}


def disturbances(env_id: str) -> dict[str, dict[str, Any]]:
    """Return the environment's arguments for each of its numbers off by 20 %; policies don't know of it."""
    scene, found = make_task(env_id).scene, {}
    for parameter in dataclasses.fields(scene):
        value = getattr(scene, parameter.name)
        if isinstance(value, float) and 0.0 < value < math.inf:
            for share, sign in ((0.8, "-"), (1.2, "+")):
                found[f"{parameter.name} {sign}20 %"] = {parameter.name: share * value}
    return found


# --- what a board freezes -----------------------------------------------------------------------------------


def rules() -> dict[str, Any]:
    """Return what a verification is here and now, in JSON types."""
    return {
        "episodes": EPISODES,
        "disturbed_episodes": DISTURBED_EPISODES,
        "learned_policies": LEARNED_POLICIES,
        "success": {env_id: goal.text for env_id, goal in GOALS.items()},
    }
