"""What both environments share in their interface to Gymnasium: options, seeds, spaces, spec, info."""

from __future__ import annotations

import copy
import dataclasses
import enum
import math
from collections.abc import Mapping
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from lag_envs.scenes.checks import check_number, shown
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import KEYWORDS, seen_box

RENDER_MODES = ["human", "rgb_array"]
#: The longest time for which `show_trail` shows the path [s].
LONGEST_TRAIL = 60.0
FLOAT32 = np.dtype(np.float32)


class TaskEnv:
    """The part that the single environment and the batch share.

    Attributes
    ----------
    task : Task
        The task; the first one of a batch.
    """

    task: Task
    #: Steps of an episode; infinity for one without an end.
    _limit: float
    _started: bool
    _spec: EnvSpec | None = None
    #: Whether everything is decided. (Looking into `__dict__` for it would slow down every later step.)
    _made = False

    def __setattr__(self, name: str, value: Any) -> None:
        if name[:1] != "_" and self._made and (name == "state" or not hasattr(type(self), name)):
            self.check_settable(name)
        object.__setattr__(self, name, value)

    def __copy__(self) -> Self:
        """Return an environment of its own: if two shared their memory, stepping one would step both."""
        return copy.deepcopy(self)

    @property
    def spec(self) -> EnvSpec | None:
        """How the environment was made; its step limit is the one that the environment itself enforces."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._spec = None if value is None else true_spec(value, self._limit)

    def check_settable(self, name: str) -> None:
        """Raise an AttributeError for what is decided when the environment is made, and for its state."""
        if name == "state":
            raise AttributeError(
                "state cannot be assigned; call reset(options={'state': ...}), or set_state with a snapshot "
                "from get_state"
            )
        parameters = (field.name for field in dataclasses.fields(self.task.scene))
        if name in ("task", "scene", "dt", "duration", *KEYWORDS, *parameters):
            raise AttributeError(
                f"{name} cannot be set once the environment is made; make another one with other keywords"
            )

    @property
    def _drawn(self) -> list[str]:
        """Names of the parameters that are drawn for each episode; none before the first."""
        found = self.task.imperfections
        return [d.name for d in found.drawn] if found and self._started else []


def true_spec(spec: EnvSpec, limit: float) -> EnvSpec:
    """Return a copy of a spec with the number of steps of an episode, in a form that can be written as JSON.

    Gymnasium omits the number if the environment itself ends an episode. From a spec that contains the
    number, Gymnasium adds a `TimeLimit` with the same number of steps, which then agrees with the
    environment's own limit.

    Parameters
    ----------
    spec : EnvSpec
        Gymnasium's spec of how the environment was made.
    limit : float
        Steps of an episode; infinity for an endless one.
    """
    steps = int(limit) if math.isfinite(limit) else None
    # `make_vec` passes the number of steps on as a keyword, which the spec need not repeat.
    kwargs = {name: plain_data(value) for name, value in spec.kwargs.items() if name != "max_episode_steps"}
    return dataclasses.replace(spec, max_episode_steps=steps, kwargs=kwargs)


def plain_data(value: Any) -> Any:
    """Return arrays and NumPy numbers as lists and numbers, an enum as its value, others unchanged."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain_data(v) for v in value]
    if isinstance(value, Mapping):
        return {name: plain_data(v) for name, v in value.items()}
    return value.value if isinstance(value, enum.Enum) else value


def observation_space(tasks: list[Task]) -> gym.spaces.Box[np.float32]:
    """Return a space that contains the observations of all the tasks."""
    boxes = [seen_box(task) for task in {id(task): task for task in tasks}.values()]
    low = np.min([low for low, _ in boxes], axis=0).astype(np.float32)
    high = np.max([high for _, high in boxes], axis=0).astype(np.float32)
    return gym.spaces.Box(low, high, dtype=np.float32)


def check_render_mode(mode: str | None) -> None:
    """Raise ValueError for an unknown render mode."""
    if mode is not None and not (isinstance(mode, str) and mode in RENDER_MODES):
        raise ValueError(f"render_mode must be one of {', '.join(RENDER_MODES)} or None, got {shown(mode)}")


def check_look(arrows: Any, trail: Any, readout: Any) -> tuple[bool, float, bool]:
    """Return the checked options of `rendering.Look`, or raise a ValueError."""
    check_flag("show_arrows", arrows)
    check_flag("show_readout", readout)
    seconds = check_number("show_trail", trail, "s")
    if not 0.0 <= seconds <= LONGEST_TRAIL:
        raise ValueError(f"show_trail must lie between 0 and {LONGEST_TRAIL:g} s, got {shown(trail)}")
    return bool(arrows), seconds, bool(readout)


def check_flag(name: str, value: Any) -> None:
    """Raise ValueError for anything but a bool, since any string would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {shown(value)}")


def check_seed(name: str, seed: Any) -> int:
    """Return a seed as int; TypeError if it is not an integer, ValueError if it is negative."""
    if isinstance(seed, bool | np.timedelta64) or not isinstance(seed, int | np.integer):
        raise TypeError(f"{name} must be an int or None, got {shown(seed)}")
    if seed < 0:
        raise ValueError(f"{name} must be at least 0, got {shown(seed)}")
    return int(seed)


def seed_key(seed: int) -> int:
    """Return the 64-bit key for a seed: the seed itself, or a digest if it has more bits."""
    return seed if seed < 2**64 else int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0])


def start_options(options: dict[str, Any] | None, known: tuple[str, ...] = ("state", "target")) -> list[Any]:
    """Return the values of the known options of `reset`, None for missing ones."""
    if options is None:
        options = {}
    if not isinstance(options, Mapping):
        raise TypeError(f"options must be a dict or None, got {shown(options)}")
    for name in options:
        if name not in known:
            raise ValueError(f"unknown reset option {shown(name)}; known are {', '.join(known)}")
    return [options.get(name) for name in known]


def diagnostics(scene: Any, state: NDArray[np.float64], control: Any) -> dict[str, Any]:
    """Return the diagnostics in `info`: forces and energies, and the applied control."""
    return {
        "control": control,
        **scene.forces(state, control),
        "energy": scene.energy(state, control)["total"],
    }
