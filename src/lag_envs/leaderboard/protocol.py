"""What a score on the leaderboard means: how many episodes, seeds, the reference, and limits of a submission.

A board freezes this, with the scale, when a protocol begins (`rules`); where something of it changes, the
board has to begin the next one.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

from lag_envs.tasks import TASKS
from lag_envs.tasks.measured import measured

#: Newest version of ``submission.toml``. What an older one says, it says in every later one too.
SCHEMA = 2
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
#: Observations that a network sees at once, and numbers that a recurrent one remembers.
FRAMES, MEMORY = 64, 256
#: Numbers of all networks of a submission, and CPU time of a verification [s].
ALL_NUMBERS, CPU_SECONDS = 1_048_576, 3_600.0
#: Numbers nearer to 0 count as 0: arithmetic with subnormal ones takes fifty times as long.
TINY = 1e-150
#: Steps that one who plans looks ahead, and steps of the model that it may take: for one of the environment,
#: searches left out, and for a search.
HORIZON, MODEL_STEPS, SEARCH_STEPS = 250, 10_000, 1_000_000
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
        Name of the task's controller.
    mean, error : float
        Its mean return in other episodes, and the standard error of that.
    episodes : int
        How many these were.
    """

    controller: str
    mean: float
    error: float
    episodes: int


def reference(env_id: str) -> Reference | None:
    """Return an environment's reference; None where episodes differ little, or nobody measured it."""
    name, found = TASKS[env_id].reference, measured(env_id).get("reference")
    return Reference(name, **found) if name and found else None


def boards() -> list[str]:
    """Return the ids that have a board: those whose task has a goal."""
    return [env_id for env_id, task in TASKS.items() if task.goal is not None]


# --- what a board freezes -----------------------------------------------------------------------------------


def rules() -> dict[str, Any]:
    """Return what a verification is here and now, in JSON types."""
    return {
        "episodes": EPISODES,
        "disturbed_episodes": DISTURBED_EPISODES,
        "learned_policies": LEARNED_POLICIES,
        "success": {env_id: TASKS[env_id].goal.text for env_id in boards()},
    }
