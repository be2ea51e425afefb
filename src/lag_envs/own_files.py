"""Scenes and tasks in users' own files, for the commands: ``FILE`` or ``FILE:Class`` in place of an id.

Loading a file runs its code. The leaderboard never does this.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from lag_envs.errors import UserError, fault, hint
from lag_envs.tasks import TASKS
from lag_envs.tasks.registration import register

GUIDE = "docs/tutorial.md and examples/ball_on_beam.py show how"


def is_file(name: str) -> bool:
    """Return whether a name on the command line is a file rather than an id.

    Examples
    --------
    >>> [is_file(name) for name in ("PivotedBar-v0", "us:a/Bar-v0", "mine.py", "mine.py:Balance", "./mine")]
    [False, False, True, True, True]
    """
    path = split_path(name)[0]
    is_id = re.fullmatch(r"([\w.]+:)?([\w-]+/)?[\w.-]+-v\d+", path)  # it may have a namespace
    return path.endswith(".py") or bool(re.search(r"[/\\]", path) and not is_id) or Path(path).is_file()


def split_path(name: str) -> tuple[str, str]:
    r"""Return path and class; on Windows a path may contain a colon itself.

    Examples
    --------
    >>> split_path("mine.py:Balance"), split_path("mine.py"), split_path(r"C:\mine.py")
    (('mine.py', 'Balance'), ('mine.py', ''), ('C:\\mine.py', ''))
    """
    path, colon, kind = name.rpartition(":")
    return (path, kind) if colon and (not kind or re.fullmatch(r"\w+", kind)) else (name, "")


@cache
def load_module(path: str) -> ModuleType:
    """Run a file and return its module.

    Raises
    ------
    UserError
        If the file does not exist, is not Python, or fails; the message then gives the line.
    """
    file = Path(path)
    if file.is_dir():
        raise UserError(f"{path} is a folder; name a Python file in it")
    if not file.is_file():
        raise UserError(f"there is no file {path}")
    if file.suffix != ".py":
        raise UserError(f"{path} is not a Python file; its name must end with .py")
    file = file.resolve()
    name = _name(file)
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # As with `python FILE`, modules in the file's folder can be imported.
    if str(file.parent) not in sys.path:
        sys.path.insert(0, str(file.parent))
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise UserError(fault(path, str(file), error)) from error
    except SystemExit as error:
        del sys.modules[name]
        raise UserError(
            f"{path} exits when it is loaded; put code that only scripts need under "
            'if __name__ == "__main__":'
        ) from error
    return module


def _name(file: Path) -> str:
    """Return the name for a file's module: the file's own name, unless another module has this name."""
    name = file.stem
    if not name.isidentifier():
        return "own_" + re.sub(r"\W", "_", name)
    try:
        known = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        known = None
    taken = name in sys.modules or (known is not None and known.origin != str(file))
    return f"own_{name}" if taken else name


def tasks(path: str) -> dict[str, type[Any]]:
    """Return the tasks that a file defines, by name: classes with a scene."""
    from lag_envs.scenes.base import Scene
    from lag_envs.tasks.base import Task

    found = {}
    for name, kind in _classes(load_module(path)).items():
        scene = getattr(kind, "scene", None)
        if issubclass(kind, Task) and isinstance(scene, type) and issubclass(scene, Scene):
            found[name] = kind
    return found


def scenes(path: str) -> dict[str, type[Any]]:
    """Return the scenes that a file defines, by name."""
    from lag_envs.scenes.base import Scene

    return {name: kind for name, kind in _classes(load_module(path)).items() if issubclass(kind, Scene)}


def _classes(module: ModuleType) -> dict[str, type]:
    """Return the classes of a module by their first names; an alias does not count as another class."""
    names: dict[type, str] = {}
    for name, value in vars(module).items():
        if isinstance(value, type) and value.__module__ == module.__name__:
            names.setdefault(value, name)
    return {name: kind for kind, name in names.items()}


def chosen_tasks(name: str) -> dict[str, type[Any]]:
    """Return the tasks of ``FILE`` or ``FILE:Class``, by name.

    Raises
    ------
    UserError
        If there are no tasks.
    """
    path, kind = split_path(name)
    found = tasks(path)
    if kind:
        if kind not in found:
            raise UserError(
                f"{path} has no task {kind!r}; "
                + (hint(kind, found) if found else f"the file defines no task at all; {GUIDE}")
            )
        return {kind: found[kind]}
    if not found:
        have = ", ".join(scenes(path))
        more = f" (only {have}, for which `lag-envs report {path}` works)" if have else ""
        raise UserError(f"{path} defines no task{more}; derive one from lag_envs.tasks.Task, {GUIDE}")
    return found


def one(name: str) -> type[Any]:
    """Return the only task of ``FILE`` or ``FILE:Class``, or raise a UserError that lists them."""
    found = chosen_tasks(name)
    if len(found) > 1:
        path = split_path(name)[0]
        raise UserError(
            f"{path} has several tasks: name one, {' or '.join(f'{path}:{kind}' for kind in found)}"
        )
    return next(iter(found.values()))


def made_with_defaults(kind: type[Any], path: str) -> Any:
    """Return a task or scene with its defaults, or raise a UserError for a fault in its formulas or id."""
    import gymnasium as gym
    from gymnasium.envs.registration import parse_env_id

    file, id = split_path(path)[0], getattr(kind, "id", "")
    if id in TASKS and inspect.getsourcefile(TASKS[id]) != inspect.getsourcefile(kind):
        raise UserError(f"{file}: the id {id!r} is that of an environment of this package; choose another")
    try:
        if id:
            parse_env_id(id)
        return kind()
    except (TypeError, ValueError, gym.error.Error) as error:
        raise UserError(f"{file}: {error}") from error
    except Exception as error:  # from the class's own code
        raise UserError(fault(file, str(Path(file).resolve()), error)) from error


def registered(name: str) -> list[str]:
    """Return the ids of ``FILE``, ``FILE:Class`` or ``module:Id``; tasks without an id get one."""
    import gymnasium as gym

    if not is_file(name):
        return [imported(name)]
    ids = []
    for kind in chosen_tasks(name).values():
        made_with_defaults(kind, name)
        id = kind.id or f"{kind.__name__}-v0"
        if id not in gym.registry or gym.registry[id].kwargs.get("task") not in (kind, _place(kind)):
            gym.registry.pop(id, None)
            register(kind, id=id)
        ids.append(id)
    return ids


def imported(name: str) -> str:
    """Import the module of ``module:Id`` and return the id, or raise a UserError."""
    import gymnasium as gym

    module, _, env_id = name.partition(":")
    see_current_folder()
    try:
        importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise UserError(f"there is no environment {name!r}: {error}") from error
    try:
        return gym.spec(env_id).id
    except (gym.error.Error, ValueError) as error:
        own = [
            id for id, spec in gym.registry.items() if str(spec.kwargs.get("task")).startswith(f"{module}:")
        ]
        told = hint(env_id, own) if own else f"{module} registers no environment"
        raise UserError(f"there is no environment {name!r}; {told}") from error


def see_current_folder() -> None:
    """Let modules in the current folder be imported, after all others."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.append(os.getcwd())


def _place(kind: type[Any]) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"
