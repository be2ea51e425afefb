"""Recorded episodes, and their errors against exact episodes.

The exact states, from the same start and under the same controls, are computed to more than 30 digits by
chaining control steps without rounding the states in between. For the error of one step, every step of the
episode is repeated separately, from the recorded state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from mpmath import mp, mpf
from numpy.typing import NDArray

from lag_envs.report import reference
from lag_envs.report.oracle import oracle_of
from lag_envs.report.points import ROUNDING
from lag_envs.report.runner import Row
from lag_envs.stepping.primitives import episode_key, uniform
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]
#: Takes an exact step from a state, with a number from 1 and a control.
ExactStep = Callable[[Sequence[Any], int, float], list[mpf]]

DIGITS = 34
#: Errors are given up to these times [s], and up to the end.
TIMES = (1.0, 5.0, 10.0)
POINTS = 120  #: of a curve in the picture


class RecordedEpisode(NamedTuple):
    """A recorded episode: ``controls[i]`` was held from ``states[i]`` to ``states[i + 1]``."""

    states: Array
    controls: list[float]
    terminated: bool


def record_episode(env: gym.Env, actions: Iterator[Any]) -> RecordedEpisode:
    """Record an episode of one of our environments, which has just been reset."""
    inner: Any = env.unwrapped
    states, controls, terminated, truncated = [inner.state], [], False, False
    while not (terminated or truncated):
        _, _, terminated, truncated, _ = env.step(next(actions))
        states.append(inner.state)
        controls.append(inner.control)
    return RecordedEpisode(np.array(states), controls, terminated)


def endless_actions(env: gym.Env, seed: int) -> Iterator[Any]:
    """Return an endless sequence of actions."""
    env.action_space.seed(seed)
    while True:
        yield env.action_space.sample()


def exact_stepping(task: Task, seed: int, digits: int) -> ExactStep:
    """Return the exact step of our environment.

    Kicks are those of the first episode after a reset with that seed. They follow from the task's formula and
    the environment's random numbers, which are a function of seed, episode and step. The random numbers are
    multiples of 2**-52, so they are exact.
    """
    k = SimpleNamespace(**task.formulas.constants())
    choose = SimpleNamespace(where=lambda c, a, b: a if c else b)
    oracle = oracle_of(task.scene)
    key = np.uint64(episode_key(np.uint64(seed), np.uint64(1)))  # a plain integer would be taken as signed

    def step(state: Sequence[Any], number: int, control: float) -> list[mpf]:
        # One computation; whole episodes are checked by a second computation with more digits.
        state = oracle.once(state, control, task.dt, digits)
        with mp.workdps(digits + 30):
            draws = [float(uniform(key, np.uint64(number), np.uint64(i))) for i in range(task.draws)]
            return list(task.formulas.kick(choose, draws, state, k))

    return step


def chained(step: ExactStep, start: Sequence[Any], controls: Sequence[float]) -> list[list[mpf]]:
    """Return the states from a start under controls, without rounding in between."""
    path = [list(start)]
    for number, control in enumerate(controls, start=1):
        path.append(step(path[-1], number, control))
    return path


# --- errors ---


def sizes(states: Array) -> Array:
    """Return the size of each state entry: its largest in the episode, at least 1."""
    return np.maximum(1.0, np.abs(states).max(axis=0))


def moved_start(states: Array) -> list[mpf]:
    """Return the start with every entry moved by one rounding of its size."""
    with mp.workdps(60):
        return [mpf(x) + ROUNDING * mpf(size) for x, size in zip(states[0], sizes(states), strict=True)]


def episode_errors(
    episode: RecordedEpisode,
    step: ExactStep,
    path: list[list[mpf]],
    shifted: list[list[mpf]],
    dt: float,
    entries: Sequence[tuple[str, str]],
    wraps: Sequence[int] = (),
) -> Row:
    """Return errors and amplified rounding, each the largest up to a time.

    Errors of the "entries" are in their units, all others are relative to the states' sizes. "one step" is
    the largest error of any single step of the episode.

    Parameters
    ----------
    episode : RecordedEpisode
        The recorded episode.
    step : callable
        Repeats every step separately, from the recorded state.
    path, shifted : list of list of mpf
        The exact states from the same start, and from the start moved by a rounding.
    dt : float
        Control step [s].
    entries : sequence of (str, str)
        Names and units of the state's entries.
    wraps : sequence of int
        Entries that the environment wraps into [-π, π].
    """
    states, scale = episode.states, sizes(episode.states)

    def errors(states: Array, exact: list[list[mpf]]) -> Array:
        each = np.array([reference.state_differences(a, b) for a, b in zip(states, exact, strict=True)])
        for i in wraps:
            each[:, i] = np.remainder(each[:, i] + math.pi, 2.0 * math.pi) - math.pi
        return np.abs(each)

    alone = [step(y, i, u) for i, (y, u) in enumerate(zip(states, episode.controls, strict=False), start=1)]
    up_to = np.maximum.accumulate(errors(states, path))
    one = errors(states[1:], alone).max(axis=0)
    with mp.workdps(60):
        growth = np.array(
            [[float(a - b) for a, b in zip(x, y, strict=True)] for x, y in zip(shifted, path, strict=True)]
        )
    error = (up_to / scale).max(axis=1)
    amplified = np.maximum.accumulate((np.abs(growth) / scale).max(axis=1))
    steps = len(episode.controls)
    marks = {**{f"{t:g} s": round(t / dt) for t in TIMES}, "the end": steps}

    def marked(values: Array) -> dict[str, float | None]:
        return {name: float(values[i]) if i <= steps else None for name, i in marks.items()}

    points = np.unique(np.geomspace(1, steps, POINTS).round().astype(int))
    return {
        "dt": dt,
        "steps": steps,
        "seconds": steps * dt,
        "terminated": episode.terminated,
        "error": {"one step": float((one / scale).max()), **marked(error)},
        "amplified": marked(amplified),
        "curve": [[float(i * dt), float(error[i]), float(amplified[i])] for i in points],
        "entries": [
            {"name": name, "unit": unit, "size": float(size), "one step": float(worst), **marked(each)}
            for (name, unit), size, worst, each in zip(entries, scale, one, up_to.T, strict=True)
        ],
    }
