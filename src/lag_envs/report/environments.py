"""The error of whole episodes, in every environment of lag_envs and its counterparts in Gymnasium.

An episode is recorded as it comes out of ``gym.make``: its float64 states, and the controls that were
applied. `episodes` compares it with the exact episode, `gymnasium_peers` has Gymnasium's equations, and
`environment_results` presents the errors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from mpmath import mpf

from lag_envs import TASKS
from lag_envs.report.environment_results import COMPARED, LONG, RELEASED, content
from lag_envs.report.episodes import (
    DIGITS,
    RecordedEpisode,
    chained,
    endless_actions,
    episode_errors,
    exact_stepping,
    moved_start,
    record_episode,
)
from lag_envs.report.gymnasium_peers import PEERS, measure_peer, random_episode, record_peer
from lag_envs.report.runner import ReportJob, Row
from lag_envs.scenes.derivation import order_of
from lag_envs.tasks.base import Task
from lag_envs.tasks.pivoted_bar import SwingUpFree

__all__ = ["content", "jobs", "own_episode", "peer_episode", "undriven"]

#: Longest episode in control steps, as each is followed several times to more than 30 digits.
MOST_STEPS = 1_000


def jobs(quick: bool) -> list[ReportJob]:
    """Return the jobs: one per environment and seed. Quick: one seed, the first second of each episode."""
    seeds = range(1 if quick else 5)
    seconds = 1.0 if quick else None
    made = [
        ReportJob(
            own_episode,
            f"{id}, seed {seed}",
            {"id": id, "seed": seed, "duration": 1.0 if quick else longest(kind())},
            timeout=600.0,
        )
        for id, kind in TASKS.items()
        if not kind.imperfections  # the motion is the same as that of another id
        for seed in seeds
    ]
    made += [
        ReportJob(peer_episode, f"{id}, seed {seed}", {"id": id, "seed": seed, "seconds": seconds})
        for id, peer in PEERS.items()
        for seed in seeds[: peer.seeds]
    ]
    free: dict[str, dict[str, Any]] = {"lag_envs, undriven": {"id": ""}}
    if not quick:
        free["lag_envs, undriven, dt 0.02 s"] = {"id": "", "dt": 0.02}
    free |= {f"{id}, undriven": {"id": id} for id, peer in PEERS.items() if peer.undriven}
    return made + [ReportJob(undriven, name, given) for name, given in free.items()]


def longest(task: Task) -> float | None:
    """Return how long an episode is followed [s], or None for the whole episode."""
    return MOST_STEPS * task.dt if task.limit > MOST_STEPS else None


# --- what is measured ---


def own_episode(id: str, seed: int, duration: float | None = None) -> Iterator[Row]:
    """Yield one row: an episode of our environment against the exact episode."""
    options: dict[str, Any] = {} if duration is None else {"duration": duration}
    env = gym.make(id, disable_env_checker=True, **options)
    env.reset(seed=seed)
    episode = record_episode(env, endless_actions(env, seed))
    row = against_exact(env.unwrapped.task, episode, seed, vouch=seed == 0)  # type: ignore[attr-defined]
    yield row | {"case": id, "seed": seed}


def against_exact(task: Task, episode: RecordedEpisode, seed: int, vouch: bool = False) -> Row:
    """Return the row of an episode of lag_envs; `vouch` adds how far two exact computations differ."""

    def exact(start: Sequence[Any], digits: int = DIGITS) -> list[list[mpf]]:
        return chained(exact_stepping(task, seed, digits), [mpf(x) for x in start], episode.controls)

    path, shifted = exact(episode.states[0]), exact(moved_start(episode.states), DIGITS - 10)
    entries = list(zip(task.scene.state_names, task.scene.state_units, strict=True))
    row = episode_errors(episode, exact_stepping(task, seed, DIGITS), path, shifted, task.dt, entries)
    order = order_of(task.scene, task.dt)
    row |= {"own": True, "integrator": f"Taylor series, order {order}" if order else "exact flow"}
    if vouch:
        row["disagreement"] = float(
            max(
                abs(a - b)
                for x, y in zip(path, exact(episode.states[0], DIGITS + 12), strict=True)
                for a, b in zip(x, y, strict=True)
            )
        )
    return row


def peer_episode(id: str, seed: int, seconds: float | None = None) -> Iterator[Row]:
    """Yield rows of one of Gymnasium's environments under random actions, as `GymnasiumPeer` describes."""
    peer = PEERS[id]
    steps = round((seconds or peer.seconds) / peer.step(gym.make(id, disable_env_checker=True).unwrapped))
    cases = {id: True} | ({f"{id}, past its end": False} if peer.continued else {})
    for case, to_the_end in cases.items():
        env, episode, used = random_episode(id, seed, steps, to_the_end)
        yield measure_peer(env, peer, episode) | {"case": case, "seed": used}


# --- the undriven pendulum ---

#: Makes an environment of lag_envs with Pendulum-v1's equation of motion: a rod of 1 m and 1 kg.
TWIN: dict[str, Any] = {
    "mass": 1.0,
    "com_distance": 0.5,
    "damping": 0.0,
    "gravity": 10.0,
    "duration": LONG,
}


def undriven(id: str = "", dt: float = 0.05) -> Iterator[Row]:
    """Yield a row of an undriven pendulum, released at rest: Gymnasium's, or one with the same equation.

    ``dt`` is the control step of lag_envs [s], by default that of Pendulum-v1.

    ``gain`` is the relative growth of energy above rest in 100 s.
    """
    if not id:
        env: Any = gym.make(SwingUpFree.id, disable_env_checker=True, **TWIN, dt=dt)
        env.reset(seed=0, options={"state": [RELEASED, 0.0]})
        episode = record_episode(env, itertools.repeat(np.zeros(1, np.float32)))
        scene = env.unwrapped.scene
        row = against_exact(env.unwrapped.task, compared_part(episode, dt), seed=0)
        energy = scene.energy(episode.states)["total"] - scene.energy([0.0, 0.0])["total"]
        case = f"{SwingUpFree.id} with Pendulum-v1's equation, undriven"
    else:
        peer = PEERS[id]
        assert peer.undriven
        changes, action = peer.undriven
        env = gym.make(id, disable_env_checker=True).unwrapped
        env.reset(seed=0)
        vars(env).update(changes)
        env.state = np.array([*[0.0] * (len(peer.order) - 2), math.pi - RELEASED, 0.0])
        dt = peer.step(env)
        episode = record_peer(env, peer, itertools.repeat(action), round(LONG / dt), to_the_end=False)
        row = measure_peer(env, peer, compared_part(episode, dt))
        hanging = [*[0.0] * (len(peer.order) - 2), math.pi, 0.0]
        scene = peer.scene(env)
        energy = scene.energy(episode.states)["total"] - scene.energy(hanging)["total"]
        case = f"{id}, undriven"
    yield row | {"case": case, "seed": None, "gain": float(energy[-1] / energy[0] - 1.0)}


def compared_part(episode: RecordedEpisode, dt: float) -> RecordedEpisode:
    """Return the part of an undriven episode that is compared."""
    steps = round(COMPARED / dt)
    return RecordedEpisode(episode.states[: steps + 1], episode.controls[:steps], False)
