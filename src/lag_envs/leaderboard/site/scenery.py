"""The data with which a browser shows an environment: names and units, shapes, and poses at each moment.

Numbers that change with time are columns: multiples of a unit, written as their second differences, which are
small. A number that never changes is written once.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.picture import Picture
from lag_envs.scenes.shapes import Circle, Frame, Magnifier, Ruler, Shape
from lag_envs.scores import share_of_privileged
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import measured_entry

#: Unit of states, actions and returns, which are shown with three digits.
UNIT = 1e-4
#: Units of lengths as a share of the window, of angles [rad] and of parts of lines: each a fraction of a
#: pixel.
LENGTH, ANGLE, PART = 1e-4, 2e-4, 2e-3


def scenery_data(env_id: str) -> dict[str, Any]:
    """Return the data with which the page describes and draws an environment.

    Parameters
    ----------
    env_id : str
        Id of an environment.

    Returns
    -------
    dict
        ``scene`` (its class's name), ``title``, ``about`` (its description's paragraphs), ``difficulty``,
        ``open`` (None, or ``knows``, ``share`` and ``tried``: method, budget, return), ``state_names``,
        ``state_units``, ``pairs`` (the entries that are a coordinate and its rate), ``controls`` (those that
        actions set), ``dt`` [s] and ``picture`` (None if the scene has no bodies). Empty for an id that this
        version does not have, such as a frozen board's.

    Examples
    --------
    >>> scenery_data("PivotedBar-v0")["state_names"]
    ['s', 's_dot', 'theta', 'theta_dot']
    >>> scenery_data("Gone-v0")
    {}
    """
    if env_id not in TASKS:
        return {}
    task = TASKS[env_id]()
    title, _, text = (inspect.getdoc(type(task)) or env_id).partition("\n")
    description = re.search(r"## Description\n+(.*?)(?=\n+## |\Z)", text, re.DOTALL)
    return {
        "scene": type(task.scene).__name__,
        "title": title,
        "about": [
            _plain(paragraph)
            for paragraph in (description[1] if description else "").split("\n\n")
            if paragraph.strip()
        ],
        "difficulty": task.difficulty,
        "open": _open(task),
        "state_names": list(task.scene.state_names),
        "state_units": list(task.scene.state_units),
        "pairs": _pairs(task.scene),
        "controls": [acting.control for acting in task.formulas.acting],
        "dt": task.dt,
        "picture": picture_data(Picture(task)),
    }


def _plain(paragraph: str) -> str:
    r"""Return a docstring's paragraph without its markup.

    Examples
    --------
    >>> _plain("only its *observation*, see [1]_"), _plain(".. [1] A. Author,\n   `x`")
    ('only its observation, see [1]', '[1] A. Author, x')
    """
    words = " ".join(paragraph.replace("`", "").split())
    return re.sub(r"\*(\w+)\*", r"\1", re.sub(r"^\.\. (?=\[)", "", words).replace("]_", "]"))


def _open(task: Task) -> dict[str, Any] | None:
    """Return what was tried on an open task, and how far it got."""
    if task.open is None:
        return None
    found = measured_entry(task.id).get("measured", {})
    tried = [[name, budget, found.get(name, {}).get("mean")] for name, budget in task.open.tried.items()]
    return {"knows": task.open.knows, "share": share_of_privileged(task.id), "tried": tried}


def _pairs(scene: Scene) -> list[list[int]]:
    """Return the places of each coordinate and its rate in the state, free coordinates first."""
    layout = layout_of(scene)
    state, free = layout.state, layout.free
    found = [
        [i, j]
        for i, a in enumerate(state)
        for j, b in enumerate(state)
        if a.kind == "place" and b.kind != "place" and a.coordinate == b.coordinate
    ]
    return sorted(found, key=lambda pair: state[pair[0]].coordinate not in free)


def picture_data(shown: Picture) -> dict[str, Any] | None:
    """Return the shapes of a picture in the form that ``site.js`` reads.

    Returns
    -------
    dict or None
        ``shapes``, each of them [kind, number of its frame, ...]; ``window``, [left, bottom, right, top] [m],
        which moves with the frame ``follows``; and ``units``, those of x, y, angle and part. None if there is
        nothing to see.
    """
    if not shown.shapes:
        return None
    left, bottom, right, top, follows = shown.view
    length = LENGTH * max(right - left, top - bottom)
    return {
        "shapes": [_shape(frame, shape) for frame, shape in shown.shapes],
        "window": _short([left, bottom, right, top]),
        "follows": shown.frames.index(follows) if follows else None,
        "units": _short([length, length, ANGLE, PART]),
    }


class Scenery:
    """Poses of an environment's episodes.

    Parameters
    ----------
    env_id : str
        Id of an environment; episodes of one that this version does not have get no poses.
    """

    def __init__(self, env_id: str) -> None:
        self._task: Task | None = TASKS[env_id]() if env_id in TASKS else None
        self._shown = Picture(self._task) if self._task else None
        found = picture_data(self._shown) if self._shown else None
        self._units = found and found["units"]

    def episode(self, replay: Mapping[str, Any]) -> dict[str, Any]:
        """Return a recorded episode with poses, and with columns instead of numbers."""
        steps = min(len(replay["states"]) - 1, len(replay["actions"]))
        states, actions = replay["states"][: steps + 1], replay["actions"][:steps]
        rewards = np.nan_to_num(np.array(replay["rewards"][:steps], np.float64))
        columns = {
            "states": [as_column(x, UNIT) for x in _columns(states)],
            "actions": [as_column(x, UNIT) for x in _columns(actions)],
            "returns": as_column(np.concatenate([[0.0], np.cumsum(rewards)]), UNIT),
        }
        kept = {key: value for key, value in replay.items() if key not in ("states", "actions", "rewards")}
        if "reset_seed" in kept:  # as a number, JavaScript would round it
            kept["reset_seed"] = str(kept["reset_seed"])
        dt = replay.get("dt") or (self._task.dt if self._task else 1.0)
        poses = self._poses(states, actions, replay.get("target"), dt)
        return {**kept, "unit": UNIT, "steps": steps, **columns, "poses": poses}

    def still(self, states: Sequence[Sequence[float]], target: Any) -> dict[str, Any]:
        """Return the poses of single states."""
        return {"count": len(states), "target": target, "poses": self._poses(states, None, target, 0.0)}

    def preview(self, states: Sequence[Sequence[float]], target: Any) -> bytes | None:
        """Return the last of some states as a PNG; None if there is nothing to see."""
        task, shown = self._task, self._shown
        if task is None or shown is None or not shown.shapes or not states:
            return None
        from lag_envs.envs.raster import png
        from lag_envs.envs.rendering import paint

        return png(paint(task, Frame(list(states[-1]), target=target)))

    @property
    def start(self) -> list[list[float]]:
        """The centre of the distribution of starts, if there is one."""
        return [[float(x) for x in self._task.centre]] if self._task else []

    def _poses(self, states: Any, actions: Any, target: Any, dt: float) -> dict[str, Any] | None:
        """Return the distinct columns, and for each frame the numbers of its x, y, angle and part."""
        task, shown = self._task, self._shown
        if task is None or shown is None or not self._units:
            return None
        if any(len(state) != len(task.scene.state_names) for state in states):
            return None
        controls = np.zeros((len(states) - 1, len(task.scene.control_names)))
        if actions:
            controls = task.wanted(actions)
        columns: dict[str, Any] = {}
        frames = []
        found = shown.episode(np.array(states, np.float64), controls, target, dt)
        for poses in found.swapaxes(0, 1):
            of = [as_column(x, unit) for x, unit in zip(poses.T, self._units, strict=True)]
            frames.append([columns.setdefault(str(x), (len(columns), x))[0] for x in of])
        return {"columns": [x for _, x in columns.values()], "frames": frames}


def page_json(value: Any) -> str:
    """Return JSON that cannot end a script element and means the same in JavaScript."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def as_column(values: ArrayLike, unit: float) -> int | list[int]:
    """Return numbers as a column.

    Examples
    --------
    >>> as_column([0.5, 0.5, 0.5], 0.1), as_column([0.0, 1.0, 2.0, 3.0, 3.0], 1.0)
    (5, [0, 1, 0, 0, -1])
    """
    whole = np.rint(np.nan_to_num(np.asarray(values, np.float64)) / unit).astype(np.int64)
    if (whole == whole[:1]).all():
        return int(whole[0]) if len(whole) else 0
    return np.diff(np.diff(whole, prepend=0), prepend=0).tolist()


def _columns(rows: Any) -> NDArray[np.float64]:
    array = np.array(rows, np.float64)
    return array.reshape(len(array), -1).T if len(array) else np.empty((1, 0))


def _shape(frame: int, shape: Shape) -> list[Any]:
    """Return a shape as [kind, frame, points or numbers, ..., role]."""
    kind = type(shape).__name__.lower()
    match shape:
        case Circle(centre, radius, role):
            return [kind, frame, _short(centre), *_short([radius]), role]
        case Ruler(step, size, role):
            return [kind, frame, *_short([step, size]), role]
        case Magnifier(centre, radius):
            return [kind, frame, _short(centre), *_short([radius])]
        case _:
            return [kind, frame, [_short(point) for point in shape.points], shape.role]


def _short(numbers: Iterable[float]) -> list[float]:
    """Return numbers with five digits."""
    return [float(f"{x:.5g}") for x in numbers]
