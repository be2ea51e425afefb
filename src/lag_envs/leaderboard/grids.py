"""Tables of actions or values over a grid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from lag_envs.controllers.basic import ObservationDecoder
from lag_envs.controllers.lookahead import Clocked, LookAhead
from lag_envs.leaderboard.architecture import POLICY, Architecture, Array, Head, PageData, PolicyTable
from lag_envs.leaderboard.fields import between, length_between, line, shown_ascii
from lag_envs.leaderboard.protocol import Refused
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task


class GridTable(PolicyTable):
    """The table ``[policy]`` of numbers on a grid."""

    axes: Annotated[list[Annotated[str, line(40)]], length_between(1, 5)]
    kind: Literal["action", "value"]
    actions: Annotated[int, between(3, 21)] = 11
    mirror: str = ""

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if len(set(self.axes)) < len(self.axes):
            raise ValueError("axes must differ")
        if self.kind == "action" and "actions" in self.model_fields_set:
            raise ValueError("actions has no meaning in a table of actions; leave it out")
        if self.mirror not in ("", *(set(self.axes) - {"time"})):
            raise ValueError(f"mirror must be one of the axes and not time, not {shown_ascii(self.mirror)}")
        return self


class GridArchitecture(Architecture):
    """Numbers at the nodes of a grid, interpolated linearly along every axis; edge values hold outside.

    In the table: `axes`, the list of the axes, each of which is a state by its name (`lag-envs info ID`),
    ``target``, a state relative to the target as ``"x - target"``, or ``time`` [s] since the episode's start.
    An angle that is observed by its cosine and sine lies in [-π, π].

    `kind` is "action" or "value". A table of actions gives the action itself. A table of values gives the
    return still to come from the state in which a step's motion ends (the mean over a random kick that may
    follow). The action is the one with the largest reward + value one step ahead, by the exact model of the
    undisturbed environment: the best of `actions` evenly spaced ones, refined around it, or the best of the
    listed ones.

    `mirror`, optional, names an axis. If its coordinate is negative, the mirror image is looked up: all signs
    change except that of time, and so does the action's, unless the control is a drag, which has no sign.

    Arrays: ``axis_0`` (n0,), ``axis_1`` (n1,) and so on, increasing, and ``table`` (n0, n1, ...).
    """

    table = GridTable
    counts_as = "optimal"

    def __init__(self, env_id: str, table: GridTable) -> None:
        self.task = TASKS[env_id]()
        if self.task.formulas.actions != 1 or self.task.formulas.targets > 1:
            raise Refused(f"{POLICY}: tables are for tasks with one control and at most one target")
        if self.task.formulas.choices:
            self.schema = 2
            if table.kind == "action" or "actions" in table.model_fields_set or table.mirror:
                raise Refused(
                    f'{POLICY}: where actions are listed, kind must be "value", without actions and mirror'
                )
        self.head = Head(self.task)
        names = list(self.task.scene.state_names)
        has_target = self.task.target_range is not None
        known = [*names, "time"]
        if has_target:
            known += ["target", *(f"{name} - target" for name in names)]
        self.axes = tuple(table.axes)
        for axis in self.axes:
            if axis not in known:
                raise Refused(f"{POLICY}: axes must be among {', '.join(known)}; got {shown_ascii(axis)}")
        self.kind, self.actions, mirror = table.kind, table.actions, table.mirror
        #: For each axis, its coefficients of (*states, target, time): 0, 1 or -1.
        self.sums = np.zeros((len(self.axes), len(names) + 2))
        for row, axis in zip(self.sums, self.axes, strict=True):
            first, _, minus = axis.partition(" - ")
            row[[*names, "target", "time"].index(first)] = 1.0
            if minus:
                row[-2] = -1.0
        self.mirror = self.axes.index(mirror) if mirror else None
        #: Sign of an action in the mirror image; a control that is zero at an end of its range has no sign.
        self.sign = 1.0 if abs(self.task.rest_action) == 1.0 else -1.0
        self.arrays = {f"axis_{j}": (f"n{j}",) for j in range(len(self.axes))}
        self.arrays["table"] = tuple(f"n{j}" for j in range(len(self.axes)))

    def agent(self, arrays: Mapping[str, Array]) -> Clocked:
        """Return the agent of these numbers."""
        axes = [arrays[f"axis_{j}"] for j in range(len(self.axes))]
        for j, axis in enumerate(axes):
            if not (axis[1:] > axis[:-1]).all():
                raise Refused(f"the nodes of axis_{j} must increase")
        grid = _GridValues(self, axes, arrays["table"])
        if self.kind == "action":
            return _LookUp(self.task, grid)
        listed, largest = self.head.choices, self.head.largest
        tried = np.arange(float(listed[0])) if listed else np.linspace(-largest, largest, self.actions)
        return LookAhead(self.task, grid.value, tried)

    def page_data(self, arrays: Mapping[str, Array]) -> PageData | None:
        """Return the table's data; None if it looks ahead on an undisturbed environment that no page has."""
        if self.task.imperfections:
            return None
        about = {
            "kind": f"{self.kind} table",
            "sums": self.sums.tolist(),
            "axes": self.axes,
            "mirror": self.mirror,
            "sign": self.sign,
            "actions": self.actions,
            "read": self.agent(arrays).read.numbers(),
            "interval": self.task.interval,
        }
        return PageData(about, arrays, self.head)


class _GridValues:
    """Numbers over a grid."""

    def __init__(self, about: GridArchitecture, axes: list[Array], values: Array) -> None:
        self.about, self.axes, self.wrapped = about, axes, ObservationDecoder(about.task).wrapped
        self.strides = np.array([math.prod(values.shape[j + 1 :]) for j in range(values.ndim)])
        self.values = np.ascontiguousarray(values).reshape(-1)

    def value(self, states: Array, targets: Array, taken: Array) -> Array:
        """Return the numbers (n,) at the ends of steps; `taken` steps came before each."""
        return self.look_up(states, targets, taken + 1.0)[0]

    def look_up(self, states: Array, targets: Array, taken: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the numbers (n,), and which of them come from the mirror image."""
        from lag_envs.leaderboard.kernels import interpolate

        time = taken * self.about.task.interval
        if self.wrapped:
            states = states.copy()
        for angle in self.wrapped:
            states[:, angle] = np.remainder(states[:, angle] + math.pi, 2.0 * math.pi) - math.pi
        given = [*states.T, targets, time]
        # Sums by hand: the bits of a matrix product may depend on the number of rows.
        points = [sum(s * g for s, g in zip(row, given, strict=True) if s) for row in self.about.sums]
        mirrored = np.zeros(len(states), np.bool_)
        if self.about.mirror is not None:
            mirrored = points[self.about.mirror] < 0.0
            points = [
                p if name == "time" else np.where(mirrored, -p, p)
                for p, name in zip(points, self.about.axes, strict=True)
            ]
        cells, places = np.empty((len(states), len(points)), np.int64), np.empty((len(states), len(points)))
        for j, (axis, x) in enumerate(zip(self.axes, points, strict=True)):
            cell = np.clip(np.searchsorted(axis, x, side="right") - 1, 0, len(axis) - 2)
            cells[:, j] = cell
            places[:, j] = np.clip((x - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)
        return interpolate(self.values, self.strides, cells, places), mirrored


class _LookUp(Clocked):
    """Reads actions off a grid."""

    def __init__(self, task: Task, grid: _GridValues) -> None:
        super().__init__(task)
        self.grid = grid

    def act(self, states: Array, targets: Array, taken: Array) -> Array:
        found, mirrored = self.grid.look_up(states, targets, taken)
        return np.where(mirrored, self.grid.about.sign * found, found)
