"""Drive an environment by keys; the command ``lag-envs play``."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from lag_envs.scenes import StepRefused

#: Keys of the controls, in order: towards the lower and towards the upper end.
PAIRS = (("left", "right"), ("down", "up"), ("a", "d"), ("s", "w"))


def keys_of(space: gym.Space) -> list[tuple[str, str]]:
    """Return the keys that drive each number of an action; controls beyond the pairs of keys rest."""
    if isinstance(space, gym.spaces.Discrete):
        count = 1
    else:
        count = int(np.prod(space.shape or (0,)))
    return list(PAIRS[:count])


def action_of(space: gym.Space, pressed: Callable[[str], bool], rest: Sequence[float]) -> Any:
    """Return the action that the pressed keys mean.

    Parameters
    ----------
    space : gym.Space
        The environment's actions: Box in [-1, 1], Discrete or MultiDiscrete.
    pressed : callable
        Tells whether the key of a name is pressed.
    rest : sequence of float
        What each number of the action is without a key: in [-1, 1], or for a choice its index.
    """
    numbers = list(rest)
    sizes = [int(space.n)] if isinstance(space, gym.spaces.Discrete) else getattr(space, "nvec", None)
    for i, (down, up) in enumerate(keys_of(space)):
        low, high = (-1.0, 1.0) if sizes is None else (0.0, float(sizes[i]) - 1.0)
        if pressed(down) != pressed(up):
            numbers[i] = low if pressed(down) else high
    if isinstance(space, gym.spaces.Discrete):
        return int(numbers[0])
    return np.array(numbers, space.dtype).reshape(space.shape or (0,))


def resting(task: Any) -> list[float]:
    """Return the action that comes nearest to controls of 0."""
    if not hasattr(task.formulas, "acting"):
        return [float(task.rest_action)]
    found = []
    for acting in task.formulas.acting:
        if acting.values:
            found.append(float(np.argmin(np.abs(acting.values))))
        else:
            middle, half = 0.5 * (acting.low + acting.high), 0.5 * (acting.high - acting.low)
            found.append(float(np.clip(-middle / half, -1.0, 1.0)))
    return found


def help_of(task: Any, space: gym.Space) -> list[str]:
    """Return what to tell whoever drives."""
    names = [acting.control for acting in getattr(task.formulas, "acting", ())] or ["control"]
    lines = [f"{name}: {down} and {up}" for name, (down, up) in zip(names, keys_of(space), strict=False)]
    return [*(lines or ["nothing acts here: look on"]), "r: start anew", "q, or close the window: end"]


def play(id: str, *, steps: int | None = None, seed: int | None = None) -> int:
    """Drive an environment until its window is closed, or for some steps; return how many were taken.

    Parameters
    ----------
    id : str
        The environment.
    steps : int, optional
        End after so many steps.
    seed : int, optional
        Seed of the starts.
    """
    import pygame

    env = gym.make(id, render_mode="human")
    own: Any = env.unwrapped
    rest = resting(own.task)
    print("\n".join(help_of(own.task, env.action_space)))
    env.reset(seed=seed)
    total, taken = 0.0, 0

    def pressed(name: str) -> bool:
        # Whoever closes the window ends pygame's display, and there are no keys any more.
        return pygame.display.get_init() and bool(pygame.key.get_pressed()[pygame.key.key_code(name)])

    try:
        while pygame.display.get_init() and not pressed("q") and (steps is None or taken < steps):
            try:
                _, reward, terminated, truncated, _ = env.step(action_of(env.action_space, pressed, rest))
            except StepRefused as error:
                print(error)
                reward, terminated, truncated = 0.0, True, False
            total, taken = total + float(reward), taken + 1
            if terminated or truncated or pressed("r"):
                ending = "terminated" if terminated else "time is up" if truncated else "interrupted"
                print(f"{ending}, sum of rewards {total:.4g}", flush=True)
                total = 0.0
                if terminated and steps is None:
                    time.sleep(0.5)
                env.reset()
    finally:
        env.close()
    return taken
