"""Snapshots of environments: everything that decides how this and all later episodes continue."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.checks import shown
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import Imperfections


@dataclasses.dataclass(frozen=True, eq=False)
class Snapshot:
    """The state of an environment or of a batch, as plain data that can be pickled.

    A snapshot is made by `get_state`, for `set_state` of the same environment or of one that was made in the
    same way, in this process or another. The environment then continues with the same bits.

    Attributes
    ----------
    about : mapping
        Properties of the environment that was saved: task, parameters, options.
    rows : mapping of str to ndarray, shape (num_envs,)
        The numbers from which a step starts: state, target, controls, clock, pending commands and
        observations, drawn parameters.
    ids : ndarray of uint64, shape (3, num_envs)
        Keys of the seeds, numbers of the episodes, keys of the episodes.
    steps, totals : ndarray, shape (num_envs,)
        Steps and sums of rewards, if the environment counts them for pictures.
    ready : bool
        Whether a single environment may be stepped: false after a termination.
    """

    about: Mapping[str, Any]
    rows: Mapping[str, NDArray[np.float64]]
    ids: NDArray[np.uint64]
    steps: NDArray[np.int64]
    totals: NDArray[np.float64]
    ready: bool = True


def properties(tasks: Sequence[Task], **options: Any) -> dict[str, Any]:
    """Return the properties that a snapshot must share, by name, in the order in which errors name them."""
    first, kind = tasks[0], type(tasks[0])
    found: dict[str, Any] = {"task": f"{kind.__module__}:{kind.__qualname__}", **options}
    fields = [f.name for f in dataclasses.fields(first.scene)]
    for name in fields:
        found[name] = _common([getattr(task.scene, name) for task in tasks])
    targets = [None if t.fixed_target is None else tuple(t.fixed_target.tolist()) for t in tasks]
    found |= {"dt": first.dt, "duration": first.duration, "target": _common(targets)}
    asked = dataclasses.asdict(first.imperfections or Imperfections())
    del asked["drawn"]
    asked["lag"] = tuple(1.0 / decay if decay else 0.0 for decay in asked["lag"])  # in seconds, as given
    drawn = [tuple(map(tuple, (task.imperfections or Imperfections()).drawn)) for task in tasks]
    return found | asked | {"randomize": _common(drawn)}


def check_snapshot(snapshot: Any, here: Mapping[str, Any], rows: Sequence[str]) -> None:
    """Raise an error for something that is not a snapshot, or a snapshot of another environment."""
    if not isinstance(snapshot, Snapshot):
        raise TypeError(f"set_state takes what get_state returned, got {shown(snapshot)}")
    for name in dict.fromkeys([*here, *snapshot.about]):
        there = snapshot.about.get(name), name in snapshot.about
        if there != (here.get(name), name in here):
            raise ValueError(
                f"this is a snapshot of another environment: {name} is {shown(there[0])} in the snapshot, "
                f"and {shown(here.get(name))} here"
            )
    if set(rows) != set(snapshot.rows):
        raise ValueError("this snapshot was made by another version of lag_envs and has other numbers")
    n = here["num_envs"] or 1
    shapes = dict.fromkeys(rows, (n,)) | {"ids": (3, n), "steps": (n,), "totals": (n,)}
    for name, shape in shapes.items():
        found = snapshot.rows[name] if name in rows else getattr(snapshot, name)
        if not isinstance(found, np.ndarray) or found.shape != shape or found.dtype.kind not in "fiu":
            raise ValueError(
                f"this snapshot is damaged: {name} must be an array of numbers of shape {shape}, "
                f"got {shown(found)}"
            )


def _common(values: list[Any]) -> Any:
    """Return the value that all environments share, or else all values."""
    return values[0] if all(value == values[0] for value in values) else tuple(values)
