"""Drive an environment with keys or a gamepad; the command ``lag-envs play``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from lag_envs.envs.screen import check_display
from lag_envs.scenes import StepRefused
from lag_envs.scores import in_words

#: Keys of the controls, in order: towards the lower and the upper end.
PAIRS = (("left", "right"), ("down", "up"), ("a", "d"), ("s", "w"))
#: The gamepad's sticks for the same controls.
STICKS = ("left stick sideways", "left stick up and down", "right stick sideways", "right stick up and down")
#: A stick that is pushed less than this counts as at rest.
DEAD = 0.12


def keys_by_number(space: gym.Space) -> list[tuple[str, str]]:
    """Return the keys for each number of an action; controls beyond the pairs of keys stay at rest."""
    return list(PAIRS[: math.prod(space.shape or ())])


def pressed_action(
    space: gym.Space,
    pressed: Callable[[str], bool],
    rest: Sequence[float],
    sticks: Sequence[float] = (),
) -> Any:
    """Return the action for the pressed keys, or else the sticks.

    Parameters
    ----------
    space : gym.Space
        The environment's actions: a Box, Discrete or MultiDiscrete.
    pressed : callable
        Takes the name of a key and tells whether it is pressed.
    rest : sequence of float
        Each number of the action when no key is pressed; for a discrete action, its index.
    sticks : sequence of float, optional
        Displacements of a gamepad's sticks, in [-1, 1], in the order of the pairs of keys.
    """
    numbers = list(rest)
    sizes = [int(space.n)] if isinstance(space, gym.spaces.Discrete) else getattr(space, "nvec", None)
    for i, (down, up) in enumerate(keys_by_number(space)):
        top = float(space.high[i]) if isinstance(space, gym.spaces.Box) else 0.0
        low, high = (-top, top) if sizes is None else (0.0, float(sizes[i]) - 1.0)
        push = float(sticks[i]) if i < len(sticks) else 0.0
        if pressed(down) != pressed(up):
            push = -1.0 if pressed(down) else 1.0
        if abs(push) > DEAD:
            # From the rest value all the way to either end.
            end = low if push < 0.0 else high
            numbers[i] = numbers[i] + abs(push) * (end - numbers[i])
            numbers[i] = numbers[i] if sizes is None else float(round(numbers[i]))
    if isinstance(space, gym.spaces.Discrete):
        return int(numbers[0])
    return np.array(numbers, space.dtype).reshape(space.shape or (0,))


class Gamepad:
    """The first gamepad, if there is one; it may be plugged in or unplugged at any time."""

    def __init__(self) -> None:
        import pygame

        self._pygame = pygame
        self._pad: Any = None
        pygame.joystick.init()

    def sticks(self) -> list[float]:
        """Return the displacements of the sticks, right and up positive; nothing without a gamepad."""
        pygame = self._pygame
        # Only events about gamepads, of the joystick module, are taken; keys are left to the program.
        kinds = (pygame.JOYDEVICEADDED, pygame.JOYDEVICEREMOVED)
        changed = pygame.display.get_init() and bool(pygame.event.get(kinds))
        if changed or (self._pad is None and pygame.joystick.get_count()):
            self._find()
        if self._pad is None:
            return []
        try:
            axes = [self._pad.get_axis(i) for i in range(min(4, self._pad.get_numaxes()))]
        except pygame.error:
            # The gamepad was unplugged before its event arrived.
            self._find()
            return []
        return [axis if i % 2 == 0 else -axis for i, axis in enumerate(axes)]

    def _find(self) -> None:
        """Take the first gamepad, and say so if it is not the same as before."""
        joystick, before = self._pygame.joystick, self._pad
        try:
            self._pad = joystick.Joystick(0) if joystick.get_count() else None
        except self._pygame.error:
            self._pad = None
        if self._pad is not None and before is None:
            print(f"gamepad: {self._pad.get_name()}", flush=True)
        elif self._pad is None and before is not None:
            print("gamepad unplugged; the keys still work", flush=True)

    def close(self) -> None:
        """Release the gamepad."""
        self._pygame.joystick.quit()


def resting(task: Any) -> list[float]:
    """Return the action closest to controls of 0."""
    return np.atleast_1d(task.rest_action).astype(float).tolist()


def help_of(task: Any, space: gym.Space) -> list[str]:
    """Return the instructions for the driver."""
    names = [acting.control for acting in getattr(task.formulas, "acting", ())] or ["control"]
    ways = zip(names, keys_by_number(space), STICKS, strict=False)
    lines = [f"{name}: {_keys(down, up)}, or the {stick}" for name, (down, up), stick in ways]
    return [
        *([] if any(task.bodies().values()) else ["the scene has no bodies, so the window stays empty"]),
        *(lines or ["there is nothing to control: just watch"]),
        "r: start over",
        "q, or close the window: end",
    ]


def _keys(down: str, up: str) -> str:
    return f"keys {down} and {up}" if len(down) == 1 else f"{down} and {up} arrow keys"


def play(id: str, *, steps: int | None = None, seed: int | None = None, **options: Any) -> list[float]:
    """Drive an environment until its window is closed, or for some steps; return the episodes' returns.

    Parameters
    ----------
    id : str
        The environment.
    steps : int, optional
        End after this many steps.
    seed : int, optional
        Seed of the initial states.
    **options
        Keywords of the environment.
    """
    import pygame

    env = gym.make(id, render_mode="human", **options)
    check_display()
    own: Any = env.unwrapped
    rest = resting(own.task)
    print("\n".join(help_of(own.task, env.action_space)), flush=True)
    env.reset(seed=seed)
    pad = Gamepad()
    returns, total, taken = [], 0.0, 0

    def pressed(name: str) -> bool:
        # Closing the window ends pygame's display; after that there are no keys.
        return pygame.display.get_init() and bool(pygame.key.get_pressed()[pygame.key.key_code(name)])

    def tell(ending: str, whole: bool) -> None:
        returns.append(total)
        print(f"{ending}: {in_words(id, total, whole)}", flush=True)

    begun = 0
    try:
        while pygame.display.get_init() and not pressed("q") and (steps is None or taken < steps):
            action = pressed_action(env.action_space, pressed, rest, pad.sticks())
            refused = False
            try:
                _, reward, terminated, truncated, _ = env.step(action)
            except StepRefused as error:
                print(error)
                refused, reward, terminated, truncated = True, 0.0, True, False
            total, taken, begun = total + float(reward), taken + 1, begun + 1
            if terminated or truncated or pressed("r"):
                over = (terminated or truncated) and not refused
                tell("terminated" if terminated else "time is up" if truncated else "interrupted", over)
                total, begun = 0.0, 0
                if terminated and steps is None:
                    time.sleep(0.5)
                env.reset()
        if begun:
            tell(f"after {steps} steps" if taken == steps else "interrupted", whole=False)
    finally:
        pad.close()
        env.close()
    return returns
