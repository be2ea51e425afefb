"""Batches of other libraries, made ready to be stepped."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from itertools import cycle, islice
from typing import Any

import gymnasium as gym
import numpy as np

from lag_envs.benchmark.actions import random_actions
from lag_envs.benchmark.environments import batch
from lag_envs.benchmark.rounds import Run


def cartpole(n: int) -> Run:
    """Prepare Gymnasium's own vector environment of CartPole, whose episodes soon end at different times."""
    envs = gym.make_vec("CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")
    envs.reset(seed=0)
    run = batch(envs.step, [(a[:, 0] > 0.0).astype(np.int64) for a in random_actions(n)])
    run(100)
    return run


def envpool(n: int) -> Run:
    """Prepare EnvPool on one thread."""
    pool = import_module("envpool")
    envs = pool.make_gymnasium("Pendulum-v1", num_envs=n, num_threads=1, seed=0)
    envs.reset()
    return batch(envs.step, random_actions(n, 2.0))


def gymnax(n: int, env_id: str = "Pendulum-v1", together: int = 8, unroll: int = 1) -> Run:
    """Prepare an environment of gymnax, several steps in one compiled call, as intended by its authors."""
    jax = import_module("jax")
    env, params = import_module("gymnax").make(env_id)
    reset = jax.vmap(env.reset, in_axes=(0, None))
    step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
    key = jax.random.PRNGKey(0)
    sample = jax.vmap(jax.vmap(env.action_space(params).sample))
    actions = sample(jax.random.split(key, (together, n)))

    def one(state: Any, inputs: tuple) -> tuple:
        key, action = inputs
        observation, state, *others = step(jax.random.split(key, n), state, action, params)
        return state, (observation, others[:-1])  # all but info

    @jax.jit
    def several(key: Any, state: Any) -> tuple:
        key, now = jax.random.split(key)
        keys = jax.random.split(now, together)
        return key, *jax.lax.scan(one, state, (keys, actions), unroll=unroll)

    _, state = jax.jit(reset)(jax.random.split(key, n), params)

    def run(steps: int) -> int:
        nonlocal key, state
        calls = -(-steps // together)
        for _ in range(calls):
            key, state, seen = several(key, state)
        jax.block_until_ready(seen)
        return calls * together

    return run


def torchrl(n: int) -> Run:
    """Prepare TorchRL's pendulum, whose episodes have no end."""
    torch = import_module("torch")
    torch.set_num_threads(1)
    env = import_module("torchrl.envs").PendulumEnv()
    actions = cycle([torch.from_numpy(a) for a in random_actions(n, 2.0)])
    now = env.reset(env.gen_params(batch_size=[n]))

    @torch.no_grad()
    def run(steps: int) -> int:
        nonlocal now
        for action in islice(actions, steps):
            now["action"] = action
            now = env.step(now)["next"]
        return steps

    return run


#: Peers with batches: library, environment, function that prepares it.
PEERS: list[tuple[str, str, Callable[[int], Run]]] = [
    ("gymnasium", "CartPole-v1", cartpole),
    ("envpool", "Pendulum-v1", envpool),
    ("gymnax", "Pendulum-v1", gymnax),
    ("torchrl", "PendulumEnv", torchrl),
]
