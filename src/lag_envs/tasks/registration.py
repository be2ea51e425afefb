"""Registers tasks as Gymnasium environments."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

import gymnasium as gym

from lag_envs.tasks import load_task


def register(task: str | type[Any], *, id: str | None = None, **options: Any) -> str:
    """Register a task with Gymnasium, for `gym.make` and `gym.make_vec`.

    Parameters
    ----------
    task : type or str
        The task's class, or its place: ``"module:Class"``.
    id : str, optional
        Name of the environment; by default the class's own ``id``.
    **options
        Parameters of the scene and of the task that differ from their defaults.

    Returns
    -------
    str
        The environment's id.

    Raises
    ------
    ValueError
        If there is no id, or the class is a scene.

    Notes
    -----
    A class that can be imported is registered by its place, so that specs can be serialised as JSON. A class
    defined in a notebook or inside a function is registered itself; worker processes then need cloudpickle,
    which Gymnasium's `AsyncVectorEnv` and Stable-Baselines3's `SubprocVecEnv` use.
    """
    if isinstance(task, type):
        from lag_envs.scenes import Scene

        if issubclass(task, Scene):
            raise ValueError(f"{task.__name__} is a Scene; register a Task whose scene it is")
        id = id or getattr(task, "id", "")
        if not id:
            raise ValueError(f'{task.__name__} has no id; write id = "{task.__name__}-v0" into the class')
        task = _place(task)
    if not isinstance(task, str | type):
        raise ValueError(f"register takes a task's class, or 'module:Class', got {task!r:.60}")
    if not id:
        raise ValueError(f"an id is needed: write register({task!r}, id=...)")
    gym.register(
        id,
        entry_point="lag_envs.envs.single:LagrangianEnv",
        vector_entry_point="lag_envs.envs.vector:LagrangianVectorEnv",
        order_enforce=False,  # the environment itself refuses a step before its reset
        kwargs={"task": task, **options},
    )
    return id


def make_task(env_id: str, **options: Any) -> Any:
    """Return the task of a registered environment, with some of its parameters changed.

    As with `gym.make`, an id of the form "module:Id-v0" imports the module first.
    """
    if ":" in env_id:
        module, _, env_id = env_id.partition(":")
        import_module(module)
    keywords = gym.spec(env_id).kwargs | options
    return load_task(keywords.pop("task"))(**keywords)


def _place(task: type[Any]) -> str | type[Any]:
    """Return "module:Class" if that leads to the class, else the class."""
    found: Any = sys.modules.get(task.__module__)
    if task.__module__ == "__main__" and not hasattr(found, "__file__"):
        return task  # from a notebook or a prompt, where another process would not find it
    for part in task.__qualname__.split("."):
        found = getattr(found, part, None)
    # A class that a decorator registers is not yet defined in its module while the module runs.
    return f"{task.__module__}:{task.__qualname__}" if found is task else task
