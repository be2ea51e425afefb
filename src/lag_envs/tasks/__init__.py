"""Tasks on the scenes: start, control, reward, ending, observation.

``TASKS`` maps the id of every environment to where its task stands and to parameters that the id fixes. To
add an environment, write its task and add a line here.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "PivotedBar-v0": ("lag_envs.tasks.pivoted_bar:SwingUp", {}),
    "PivotedBarFree-v0": ("lag_envs.tasks.pivoted_bar:SwingUp", {"track": None}),
    "PivotedBarBalance-v0": ("lag_envs.tasks.pivoted_bar:Balance", {}),
    "InclineTilt-v0": ("lag_envs.tasks.incline:Tilt", {}),
    "InclineBrake-v0": ("lag_envs.tasks.incline:Brake", {}),
    "CylinderInCylinderTilt-v0": ("lag_envs.tasks.cylinder_in_cylinder:Tilt", {}),
    "CylinderInCylinderPump-v0": ("lag_envs.tasks.cylinder_in_cylinder:Pump", {}),
    "CylinderInCylinderDamping-v0": ("lag_envs.tasks.cylinder_in_cylinder:Damping", {}),
}


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
        module, _, name = place.partition(":")
        found: Any = import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        return found
    except (AttributeError, ImportError, TypeError, ValueError) as error:
        raise ValueError(f"task must be given as 'module:Class', got {place!r:.200}: {error}") from error
