"""Actions for episodes of the unfused step."""

import math

import numpy as np
from own_tasks import Switched

from lag_envs.controllers import build as make
from lag_envs.controllers import controllers
from lag_envs.envs.actions import Actions


class Six(Switched):
    """A chain so long that its script is split into several functions."""

    id = "OwnSix-v0"
    defaults = {"bars": 6, "mass": 0.1, "length": 0.2}
    steps = 20
    start = {f"theta_{i}": (math.pi, 0.3) for i in range(1, 7)}


def at_random(task, seed):
    """Return random actions, including some beyond their limits."""
    rng, formulas = np.random.default_rng(seed), task.formulas
    if formulas.choices:
        space = Actions(formulas).space
        space.seed(seed)
        return lambda env, i: space.sample()
    return lambda env, i: rng.uniform(-1.2, 1.2, formulas.actions).astype(np.float32)


def by_agent(task):
    """Return the actions of a task's own controller that does not plan; without one, random actions."""
    names = [n for n, found in controllers(task).items() if not found.plans and n not in ("zero", "random")]
    if not names:
        return at_random(task, 99)
    made = make(task, names[-1])
    memory = {}

    def act(env, i):
        start = np.array([i == 0])
        action, memory["state"] = made.predict(
            np.array([env.observe()], np.float32), None if i == 0 else memory["state"], start
        )
        return action[0]

    return act
