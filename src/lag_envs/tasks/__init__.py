"""Tasks on the scenes: start, control, reward, ending, observation, and every other design decision.

``TASKS`` maps ids to the classes of the environments. To add one, write its task in a file of this folder.
"""

from __future__ import annotations

import re
import sys
from collections import UserDict
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lag_envs.errors import UserError, fault
from lag_envs.tasks.measured import measured_ids


class Tasks(UserDict[str, Any]):
    """Task classes by id; a class given as "module:Class" is imported on first access."""

    def __getitem__(self, env_id: str) -> type[Any]:
        """Return the class."""
        return load_task(self.data[env_id])


def __getattr__(name: str) -> Any:
    """Return `Task`, the base class of every task; it is loaded on first access."""
    if name == "Task":
        from lag_envs.tasks.base import Task

        return Task
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def load_task(place: str | type[Any]) -> type[Any]:
    """Return the task class at "module:Class"; a task class is returned unchanged.

    Raises
    ------
    UserError
        If the module exists but fails when it is imported; the error names the file.
    ValueError
        For anything else that does not lead to a task class.
    """
    from lag_envs.tasks.base import Task

    kind = place if isinstance(place, type) else _found(place)
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise ValueError(f"task must be or lead to a class derived from Task, got {kind!r:.100}")
    return kind


def _found(place: Any) -> Any:
    """Return the object at "module:Class", or raise an error as `load_task` does."""
    if not isinstance(place, str):
        raise ValueError(
            f"task must be given as 'module:Class' or as the class itself, its parameters as keywords, "
            f"got {place!r:.200}"
        )
    try:
        return resolve(place)
    except Exception as error:
        if file := _broken(place):
            raise UserError(fault(file, file, error)) from error
        if isinstance(error, AttributeError | ImportError | TypeError | ValueError):
            raise ValueError(f"task must be given as 'module:Class', got {place!r:.200}: {error}") from error
        raise


def _broken(place: Any) -> str | None:
    """Return the file of a place's module, if the file exists but could not be imported."""
    module = str(place).partition(":")[0]
    if module in sys.modules:
        return None
    try:
        spec = find_spec(module)
    except Exception:  # of a package around it
        return None
    return spec.origin if spec else None


def resolve(place: str) -> Any:
    """Return the object at "module:name"."""
    module, _, name = place.partition(":")
    found: Any = import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    return found


def find_tasks(folder: Path, package: str) -> dict[str, str]:
    """Return the places of the tasks in a package's folder: classes with a line ``id = "..."``.

    The files are read, not imported: importing them would make ``import lag_envs`` half as slow again.
    """
    lines = re.compile(r'\nclass (\w+)|\n    id = "([\w-]+)"')
    places = {}
    for file in sorted(folder.glob("*.py")):
        kind = ""
        for name, env_id in lines.findall(file.read_text(encoding="utf-8")):
            kind = name or kind
            if env_id:
                places[env_id] = f"{package}{file.stem}:{kind}"
    # In the order in which they were measured.
    order = {env_id: i for i, env_id in enumerate(measured_ids())}
    return dict(sorted(places.items(), key=lambda item: order.get(item[0], len(order))))


#: The package's tasks.
TASKS = Tasks(find_tasks(Path(__file__).parent, f"{__name__}."))
