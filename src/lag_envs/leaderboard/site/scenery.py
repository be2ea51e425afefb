"""What a browser needs to draw an environment from its states: geometry, names and units."""

from __future__ import annotations

import inspect
from typing import Any

from lag_envs.scenes.cylinder_in_cylinder import CylinderInCylinder
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.pivoted_bar import PivotedBar
from lag_envs.scenes.shapes import Moment
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task


def describe(env_id: str) -> dict[str, Any]:
    """Return what the page says of an environment and draws it with.

    Parameters
    ----------
    env_id : str
        Id of an environment.

    Returns
    -------
    dict
        ``title``, ``scene``, ``geometry`` (metres, radians; None for a scene that the page cannot draw),
        ``state_names``, ``state_units``, ``start`` (the middle of where episodes start), ``dt`` [s] and
        ``control`` (name, unit, value at action -1 and 1, and the limit that an arrow is a share of; None
        where there are several).
        Empty for an id that this version does not have, such as that of a frozen board.

    Examples
    --------
    >>> describe("PivotedBar-v0")["state_names"]
    ['s', 's_dot', 'theta', 'theta_dot']
    >>> describe("Gone-v0")
    {}
    """
    if env_id not in TASKS:
        return {}
    task = TASKS[env_id]()
    return {
        "title": (inspect.getdoc(type(task)) or env_id).partition("\n")[0],
        "scene": type(task.scene).__name__,
        "geometry": geometry(task),
        "state_names": list(task.scene.state_names),
        "state_units": list(task.scene.state_units),
        "start": [float(x) for x in task.centre],
        "dt": task.dt,
        "control": _control(task),
    }


def _control(task: Task) -> dict[str, Any] | None:
    if len(task.formulas.acting) != 1:
        return None
    (acting,) = task.formulas.acting
    units = dict(zip(task.scene.control_names, task.scene.control_units, strict=True))
    ends = {"low": acting.low, "high": acting.high, "limit": task.limit_control}
    return {"name": acting.control, "unit": units[acting.control], **ends}


def geometry(task: Task) -> dict[str, Any] | None:
    """Return the numbers from which ``site.js`` draws what `Task.shapes` draws [m, rad].

    None for another scene: its page has curves, but no picture.
    """
    scene = task.scene
    own: dict[str, Any]
    if isinstance(scene, PivotedBar):
        own = {
            "reach": scene.reach,
            # A uniform bar's far end lies as far beyond its centre of mass as the near one before it.
            "near": 2.0 * scene.com_distance - scene.reach,
            "com": scene.com_distance,
            "track": scene.track,
            "lean": getattr(task, "largest_angle", None),
        }
    elif isinstance(scene, Incline):
        own = {
            "control": scene.control,
            "radius": scene.radius,
            "ratio": scene.inertia / (scene.mass * scene.radius**2),
            "tilt": scene.tilt,
            "edge": getattr(task, "edge", None),
            "largest_tilt": getattr(task, "largest_tilt", None),
        }
    elif isinstance(scene, CylinderInCylinder):
        amplitude = getattr(task, "amplitude", None)
        own = {
            "control": scene.control,
            "shell": scene.shell_radius,
            "radius": scene.radius,
            "arm": scene.arm,
            "ratio": scene.inertia / (scene.mass * scene.radius**2),
            "largest_angle": getattr(task, "largest_angle", None),
            # Where the marks are: at the episode's target, or at fixed angles.
            "marks": None
            if task.target_range is not None
            else ([0.0] if amplitude is None else [-amplitude, amplitude]),
        }
    else:
        return None
    start = [float(x) for x in task.centre]
    return own | {"window": list(task.window(Moment(start)))}
