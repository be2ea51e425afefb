"""Environments as HTML for notebooks: a picture, spaces, controls and parameters."""

from __future__ import annotations

import base64
import inspect
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.envs import raster
from lag_envs.scenes.html import html_table, parameter_rows
from lag_envs.tasks.base import Task


def environment_html(
    task: Task, title: str, spaces: dict[str, Any], picture: NDArray[np.uint8] | None
) -> str:
    """Return an environment's HTML for a notebook.

    Parameters
    ----------
    task : Task
        Its task.
    title : str
        Its name.
    spaces : mapping of str to gym.Space
        Its spaces by name.
    picture : ndarray of uint8, shape (height, width, 3), or None
        Its picture.
    """
    about = (inspect.getdoc(type(task)) or "").partition("\n")[0]
    image = ""
    if picture is not None:
        data = base64.b64encode(raster.png(picture)).decode()
        height, width = picture.shape[:2]
        image = (
            f'<img alt="{escape(about)}" width="{width // 2}" height="{height // 2}" '
            f'src="data:image/png;base64,{data}">'
        )
    rows = [(name, str(space)) for name, space in spaces.items()]
    rows.append(("observed", ", ".join(task.observation)))
    for acting in task.formulas.acting:
        given = acting.values or (acting.low, acting.high)
        between = ", " if acting.values else " to "
        rows.append((acting.control, f"{between.join(f'{v:g}' for v in given)} {acting.unit}"))
    rows += [
        ("control interval", f"{task.dt:g} s"),
        ("episode", f"{task.limit:g} steps, {task.duration:g} s"),
    ]
    return (
        f"<div><b>{escape(title)}</b> {escape(about)}<br>{image}{html_table(rows)}"
        f"<details><summary>{escape(type(task.scene).__name__)}</summary>"
        f"{html_table(parameter_rows(task.scene), ('parameter', 'value'))}</details></div>"
    )


def still(
    task: Task, state: Any = None, control: Any = 0.0, target: Any = None, *, columns: int = 1
) -> NDArray[np.uint8] | None:
    """Return a picture of a state, by default the middle of the starts; None if there is nothing to draw.

    With `columns`, the size of the picture leaves room for this many pictures side by side.
    """
    from lag_envs.envs.rendering import paint, tile_size
    from lag_envs.scenes.shapes import Frame

    if not any(task.bodies().values()):
        return None
    held = np.broadcast_to(control, len(task.scene.control_names))
    now = Frame(list(task.centre if state is None else state), held, task.share(held), target)
    return paint(task, now, tile_size(columns * columns))
