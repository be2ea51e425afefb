"""Tasks on the scenes: start, control, reward, ending, observation.

``TASKS`` maps the id of every environment to where its task stands and to parameters that the id fixes. To
add an environment, write its task and add a line here.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lag_envs.tasks.base import Task


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


def load_task(place: str) -> type[Task]:
    """Return the task class at "module:Class", or raise a ValueError."""
    try:
        module, _, name = place.partition(":")
        return getattr(import_module(module), name)
    except (AttributeError, ImportError, TypeError, ValueError) as error:
        raise ValueError(f"task must be given as 'module:Class', got {place!r:.200}: {error}") from error
