"""Gymnasium's counterparts of this package's environments: scenes with the same equations, and episodes.

A test checks on Gymnasium's own steps that the scenes have the equations of its source.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from mpmath import mpf

from lag_envs.report.episodes import (
    DIGITS,
    ExactStep,
    RecordedEpisode,
    chained,
    endless_actions,
    episode_errors,
    moved_start,
)
from lag_envs.report.oracle import oracle_of
from lag_envs.report.runner import Row
from lag_envs.scenes import Acrobot, CartPole, Pendulum
from lag_envs.scenes.base import Scene


class GymnasiumPeer(NamedTuple):
    """One of Gymnasium's environments: its equations, and the meaning of its actions."""

    scene: Callable[[Any], Scene]  #: from an instance
    order: Sequence[int]  #: places of the scene's state entries in its own state
    integrator: str
    step: Callable[[Any], float]  #: the control step [s] from an instance
    control: Callable[[Any, Any], float]  #: from an instance and an action, like the environment's own code
    colour: str  #: one of Okabe and Ito's
    seconds: float = 10.0  #: length of the episodes [s]
    seeds: int | None = None  #: how many episodes at most
    continued: bool = False  #: whether episodes are also continued past their end, by its own update
    undriven: tuple[dict[str, float], Any] | None = None  #: changes that remove the force; the action to take
    wraps: Sequence[int] = ()
    limits: Callable[[Any], Sequence[float]] = lambda env: ()  #: at these speeds it clips the last entries

    def entries(self, env: Any) -> list[tuple[str, str]]:
        """Return names and units of its state."""
        scene = self.scene(env)
        return [(scene.state_names[i], scene.state_units[i]) for i in np.argsort(self.order)]


PEERS = {
    "Pendulum-v1": GymnasiumPeer(
        lambda env: Pendulum(mass=env.m, length=env.l, gravity=env.g),
        (0, 1),
        "semi-implicit Euler",
        lambda env: env.dt,
        lambda env, action: float(np.clip(action, -env.max_torque, env.max_torque)[0]),
        "#d55e00",
        undriven=({}, np.zeros(1, np.float32)),
        limits=lambda env: [env.max_speed],
    ),
    "CartPole-v1": GymnasiumPeer(
        lambda env: CartPole(
            cart_mass=env.masscart, pole_mass=env.masspole, half_length=env.length, gravity=env.gravity
        ),
        (0, 1, 2, 3),
        "explicit Euler",
        lambda env: env.tau,
        lambda env, action: env.force_mag if action == 1 else -env.force_mag,
        "#cc79a7",
        continued=True,  # it falls within half a second
        undriven=({"force_mag": 0.0}, 0),
    ),
    "Acrobot-v1": GymnasiumPeer(
        lambda env: Acrobot(
            mass_1=env.LINK_MASS_1, mass_2=env.LINK_MASS_2, length_1=env.LINK_LENGTH_1,
            length_2=env.LINK_LENGTH_2, com_distance_1=env.LINK_COM_POS_1, com_distance_2=env.LINK_COM_POS_2,
            inertia_1=env.LINK_MOI, inertia_2=env.LINK_MOI, gravity=9.8,
        ),
        (0, 2, 1, 3),
        "RK4",
        lambda env: env.dt,
        lambda env, action: float(env.AVAIL_TORQUE[action]),
        "#009e73",
        seconds=100.0,
        seeds=3,
        wraps=(0, 1),
        limits=lambda env: [env.MAX_VEL_1, env.MAX_VEL_2],
    ),
}  # fmt: skip


def record_peer(
    env: Any, peer: GymnasiumPeer, actions: Iterator[Any], steps: int, to_the_end: bool
) -> RecordedEpisode:
    """Record at most `steps` steps of a peer that has been reset, until its termination or past it."""
    states, controls, terminated = [np.array(env.state, np.float64)], [], False
    for action in itertools.islice(actions, steps):
        controls.append(peer.control(env, action))
        _, _, over, _, _ = env.step(action)
        states.append(np.array(env.state, np.float64))
        terminated = terminated or bool(over)
        if terminated and to_the_end:
            break
    return RecordedEpisode(np.array(states), controls, terminated)


def random_episode(id: str, seed: int, steps: int, to_the_end: bool) -> tuple[Any, RecordedEpisode, int]:
    """Return a peer, one of its episodes, and the seed: a later seed if a speed was clipped."""
    peer = PEERS[id]
    env: Any = gym.make(id, disable_env_checker=True).unwrapped
    while True:
        env.reset(seed=seed)
        episode = record_peer(env, peer, endless_actions(env, seed), steps, to_the_end)
        limits = peer.limits(env)
        if not limits or (np.abs(episode.states[:, -len(limits) :]) < limits).all():
            return env, episode, seed
        seed += 1000


def measure_peer(env: Any, peer: GymnasiumPeer, episode: RecordedEpisode) -> Row:
    """Return the row of a peer's episode against the exact one."""
    step = exact_peer_step(env, peer)
    path, shifted = (
        chained(step, start, episode.controls) for start in (episode.states[0], moved_start(episode.states))
    )
    row = episode_errors(episode, step, path, shifted, peer.step(env), peer.entries(env), peer.wraps)
    return row | {"own": False, "integrator": peer.integrator}


def exact_peer_step(env: Any, peer: GymnasiumPeer) -> ExactStep:
    """Return the exact step of a peer's equations of motion."""
    oracle, own, dt = oracle_of(peer.scene(env)), np.argsort(peer.order), peer.step(env)

    def step(state: Sequence[Any], number: int, control: float) -> list[mpf]:
        end = oracle.once([state[i] for i in peer.order], control, dt, DIGITS)
        return [end[i] for i in own]

    return step
