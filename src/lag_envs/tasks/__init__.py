"""Tasks on the scenes: start, control, reward, ending, observation, and all else that people decide.

``TASKS`` has the class of every environment by id. To add one, write its task in a file of this folder.
"""

from __future__ import annotations

import re
from collections import UserDict
from importlib import import_module
from pathlib import Path
from typing import Any

from lag_envs.tasks.measured import known


class Tasks(UserDict[str, Any]):
    """Task classes by id; given as "module:Class", one is imported when it is asked for."""

    def __getitem__(self, env_id: str) -> type[Any]:
        """Return the class."""
        return load_task(self.data[env_id])


def __getattr__(name: str) -> Any:
    """Return `Task`, from which a task of one's own derives; it is loaded when it is asked for."""
    if name == "Task":
        from lag_envs.tasks.base import Task

        return Task
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def load_task(place: str | type[Any]) -> type[Any]:
    """Return the task class at "module:Class", or raise a ValueError; a class as it is."""
    if isinstance(place, type):
        return place
    try:
        return resolve(place)
    except (AttributeError, ImportError, TypeError, ValueError) as error:
        raise ValueError(f"task must be given as 'module:Class', got {place!r:.200}: {error}") from error


def resolve(place: str) -> Any:
    """Return what stands at "module:name"."""
    module, _, name = place.partition(":")
    found: Any = import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    return found


def find(folder: Path, package: str) -> dict[str, str]:
    """Return where the tasks in a package's folder stand: classes with a line ``id = "..."``.

    The files are read and not imported: that would add half to the time of ``import lag_envs``.
    """
    lines = re.compile(r'\nclass (\w+)|\n    id = "([\w-]+)"')
    places = {}
    for file in sorted(folder.glob("*.py")):
        kind = ""
        for name, env_id in lines.findall(file.read_text(encoding="utf-8")):
            kind = name or kind
            if env_id:
                places[env_id] = f"{package}{file.stem}:{kind}"
    # Those that were measured first come first.
    order = {env_id: i for i, env_id in enumerate(known())}
    return dict(sorted(places.items(), key=lambda item: order.get(item[0], len(order))))


#: The package's tasks.
TASKS = Tasks(find(Path(__file__).parent, f"{__name__}."))
