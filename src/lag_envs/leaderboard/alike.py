"""Find policies that act alike, however different their numbers are.

Two policies play the same episodes, which follow from the nonce. Each is also asked what it would do in the
states on the other's path. The two are alike if their clipped actions at the states on both paths differ by
less than `ACTIONS` (root mean square), or if their episodes' returns differ by less than `RETURNS` standard
errors of a mean return (root mean square). Where all episodes of both pay the same, as with two perfect
policies, returns tell nothing, and only actions count.

Noise of 1e-4 on all numbers of our networks moves their actions by up to 4e-3; the closest two of our
separately trained policies are 1.4e-2 apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.evaluation.rollout import Episodes, PolicyError, Rollout, act, record_rollout
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.policies import SubmittedPolicy
from lag_envs.leaderboard.submission import Refused, Submission

Array = NDArray[Any]

#: Episodes that both play, and states per path at which a policy without memory is asked.
EPISODES, STATES = 16, 1024
#: Two policies are alike below these differences: of actions in [-1, 1], of returns in standard errors.
ACTIONS, RETURNS = 7e-3, 0.1
#: Two policies of one learner count as the same training below this difference of actions.
TWINS = 1e-3


class Distance(NamedTuple):
    """How far apart two policies are: in actions (rms), and in returns (rms, in standard errors)."""

    actions: float
    returns: float

    @property
    def closeness(self) -> float:
        """Below 1 for policies that are alike."""
        return min(self.actions / ACTIONS, self.returns / RETURNS)


#: Distance to a policy that fails; JSON has no infinity.
FAR = Distance(2.0, 1e9)


@dataclass
class PlayedPolicy:
    """A policy's states, actions and returns in the common episodes.

    Parameters
    ----------
    policy : Policy
        The policy.
    played : Episodes
        The episodes.
    returns : ndarray, shape (episodes,)
        Its return in each episode.
    quick : bool
        Whether it has no memory, so that it can be asked at many states at once.
    """

    policy: SubmittedPolicy
    played: Episodes
    returns: Array
    quick: bool

    def asked(self, other: PlayedPolicy) -> float:
        """Return the mean square difference of another policy's actions on this path; `FAR`'s if it fails."""
        agent, seen, did = other.policy.agent(), self.played.observations, self.played.actions
        start = np.ones(len(self.returns), np.bool_)
        try:
            if other.quick:
                return self._asked_at_once(agent)
            memory, total = None, 0.0
            for observation, own, running in zip(seen, did, self.played.running, strict=True):
                action, memory = act(agent, observation, memory, start, own.shape)
                off = np.where(running[:, None], self._off(action, own), 0.0)
                total += float(np.sum(off * off))
                start = np.zeros_like(start)
        except PolicyError:
            return FAR.actions**2
        return total / float(self.played.steps.sum()) / off.shape[-1]

    def _off(self, action: Array, own: Array) -> Array:
        """Return how far actions are from `own`, shape (n, numbers): 1 for another choice from a list."""
        off = np.asarray(action, np.float64) - own
        if self.played.task.formulas.choices:
            off = np.sign(np.abs(off))
        return off.reshape(len(off), -1)

    def _asked_at_once(self, agent: Any) -> float:
        where = np.flatnonzero(self.played.running.ravel())
        # Spread evenly over all times and episodes. The nonce decides which episodes these are.
        where = where[np.linspace(0, len(where) - 1, min(STATES, len(where))).astype(np.int64)]
        arrays = self.played.observations, self.played.actions
        seen, did = (array.reshape(-1, *array.shape[2:])[where] for array in arrays)
        action, _ = act(agent, seen, None, np.ones(len(seen), np.bool_), did.shape)
        off = self._off(action, did)
        return float(np.mean(off * off))


def track(env_id: str, policy: SubmittedPolicy, nonce: str) -> PlayedPolicy:
    """Let a policy play the episodes that follow from a nonce; raise Refused if it fails."""
    first = protocol.first_seed(f"alike {env_id}", nonce, 0)
    rollout = Rollout(env_id, policy.agent(), range(first, first + EPISODES))
    try:
        played = record_rollout(rollout)
    except PolicyError as error:
        raise Refused(str(error)) from error
    return PlayedPolicy(policy, played, rollout.returns, rollout.memory is None)


def distance(a: PlayedPolicy, b: PlayedPolicy, error: float) -> Distance:
    """Return how far apart two policies are; for actions that are clearly apart, only a lower bound.

    Parameters
    ----------
    a, b : PlayedPolicy
        Their tracks in the same episodes.
    error : float
        Standard error of a mean return on their board.
    """
    off = float(np.sqrt(np.mean((a.returns - b.returns) ** 2)))
    returns = min(off / error, FAR.returns) if error > 0.0 else FAR.returns * (off > 0.0)
    if np.ptp([a.returns, b.returns]) == 0.0:
        returns = FAR.returns
    # First ask the policy that can be asked at all states at once: the other may be slow.
    first, second = (a, b) if b.quick else (b, a)
    actions = 0.5 * first.asked(second)
    if actions < ACTIONS**2:
        actions += 0.5 * second.asked(first)
    return Distance(math.sqrt(actions), returns)


class Likeness:
    """Compares submissions to one environment in the episodes that follow from one nonce.

    Parameters
    ----------
    env_id : str
        The environment.
    nonce : str
        The nonce.
    """

    def __init__(self, env_id: str, nonce: str) -> None:
        self.env_id, self.nonce = env_id, nonce
        self._tracks: dict[str, list[PlayedPolicy | None]] = {}

    def tracks(self, submission: Submission) -> list[PlayedPolicy | None]:
        """Return the tracks of a submission's policies, None for one that fails."""
        if submission.digest not in self._tracks:
            found: list[PlayedPolicy | None] = []
            for _, policy in submission.policies:
                try:
                    found.append(track(self.env_id, policy, self.nonce))
                except Refused:
                    found.append(None)
            self._tracks[submission.digest] = found
        return self._tracks[submission.digest]

    def __call__(self, newer: Submission, older: Submission, error: float) -> Distance:
        """Return the distance of a submission from an older one, within which half of its policies lie.

        Parameters
        ----------
        newer, older : Submission
            The submissions.
        error : float
            Standard error of a policy's mean return on their board.
        """
        those = self.tracks(older)
        nearest = [
            min(
                (distance(a, b, error) if a and b else FAR for b in those),
                key=lambda found: found.closeness,
            )
            for a in self.tracks(newer)
        ]
        return sorted(nearest, key=lambda found: found.closeness)[(len(nearest) - 1) // 2]


def check_twins(submission: Submission, nonce: str) -> None:
    """Raise Refused if two policies of a learner act the same, so that one was made from the other."""
    if submission.kind != "learned":
        return
    tracks = [track(submission.env, policy, nonce) for _, policy in submission.policies]
    seeds = [seed for seed, _ in submission.policies]
    for i, one in enumerate(tracks):
        for j in range(i):
            off = math.sqrt(0.5 * (one.asked(tracks[j]) + tracks[j].asked(one)))
            if off < TWINS:
                raise Refused(
                    f"the policies of seeds {seeds[j]} and {seeds[i]} act the same: their actions differ by"
                    f" {off:.1e}; each needs its own training"
                )
