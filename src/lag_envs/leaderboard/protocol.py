"""The meaning of a score on the leaderboard: episodes, seeds, the reference, and limits of a submission.

A board freezes all this, with the scale, when a protocol begins (`rules`); if any of it changes, the board
has to begin the next protocol.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

from lag_envs.errors import UserError
from lag_envs.tasks import TASKS
from lag_envs.tasks.measured import measured_entry

#: Newest version of ``submission.toml``. Each version keeps the meaning of the older ones.
SCHEMA = 2
#: Episodes of each policy, without and with each disturbance.
EPISODES, DISTURBED_EPISODES = 1000, 100
#: Policies: the fewest that a learner must submit, one per training seed; the most that anyone may submit.
LEARNED_POLICIES, MOST_POLICIES = 5, 20
#: How far returns may differ between two builds, relative to the distance from random to best known.
#: Libraries round the last digit of tanh differently, and the difference may grow in the course of an
#: episode.
TOLERANCE = 1e-3
#: The same for a planner: if rounding decides between two steps of its search, it follows another plan from
#: there, nearly as good, and so each of its episodes may differ.
PLANNED = 1e-2
#: Share of episodes that may differ by more than that: if rounding decides, all that follows may differ.
APART = 0.01


class Refused(UserError):
    """A submission was refused; the text says why, and is safe to print."""


# --- limits of a submission ---------------------------------------------------------------------------------

#: Bytes of ``submission.toml``, of one policy's arrays, of all together; characters of a line of the TOML.
TOML_BYTES, POLICY_BYTES, FOLDER_BYTES, LINE = 65_536, 4_194_304, 16_777_216, 1_000
#: Bytes of the header of a safetensors file.
HEADER_BYTES = 16_384
#: Hidden layers, their width, and parameters of a network.
LAYERS, WIDTH, NUMBERS = 8, 1_024, 131_072
#: Observations that a network sees at once, and the size of a recurrent one's memory.
FRAMES, MEMORY = 64, 256
#: Parameters of all networks of a submission, and CPU time of a verification [s].
ALL_NUMBERS, CPU_SECONDS = 1_048_576, 3_600.0
#: Numbers nearer to 0 count as 0: arithmetic with subnormal numbers is fifty times slower.
TINY = 1e-150
#: Steps that a planner looks ahead, and model steps that it may take: per step of the environment, without
#: searches, and per search.
HORIZON, MODEL_STEPS, SEARCH_STEPS = 250, 10_000, 1_000_000
#: Points of a learning curve.
CURVE = 200


# --- seeds --------------------------------------------------------------------------------------------------


def first_seed(digest: str, nonce: str, policy: int) -> int:
    """Return the reset seed of a policy's first episode; the others count on from it.

    Nobody can train on these seeds: they follow from the submission's own bytes and from a nonce that is
    published later.

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


class ReferenceController(NamedTuple):
    """A quick controller that plays a verification's episodes too, see `ranking.corrected`.

    Parameters
    ----------
    controller : str
        Name of the task's controller.
    mean, error : float
        Its mean return in other episodes, and that mean's standard error.
    episodes : int
        The number of those episodes.
    """

    controller: str
    mean: float
    error: float
    episodes: int


def reference(env_id: str) -> ReferenceController | None:
    """Return an environment's reference; None if its episodes differ little, or if it was not measured."""
    name, found = TASKS[env_id].reference, measured_entry(env_id).get("reference")
    return ReferenceController(name, **found) if name and found else None


def boards() -> list[str]:
    """Return the ids that have a board: those whose task has a goal."""
    return [env_id for env_id, task in TASKS.items() if task.goal is not None]


# --- what a board freezes -----------------------------------------------------------------------------------


def rules() -> dict[str, Any]:
    """Return the current rules of a verification, in JSON types."""
    return {
        "episodes": EPISODES,
        "disturbed_episodes": DISTURBED_EPISODES,
        "learned_policies": LEARNED_POLICIES,
        "success": {env_id: TASKS[env_id].goal.text for env_id in boards()},
    }
