"""Arrows for controls, and for the forces that a scene names.

Each arrow is a generalised force along a coordinate. The poses determine where the force acts and its
direction: it pushes the first body that the coordinate moves, in the direction in which the coordinate moves
this body.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from lag_envs.mechanics.evaluation import Numeric
from lag_envs.mechanics.recording import Values
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.picture import Picture, places
from lag_envs.scenes.shapes import Arrow, Frame, Point, arc
from lag_envs.tasks.base import Task

#: Length of the arrow of the largest control, or of a force of usual size, as a share of the window; and the
#: length of the longest arrow, as a multiple of this.
LONG, MOST = 0.22, 1.6
#: How far coordinates are moved to find out which bodies move with them.
STEP = 1e-6


class Forces:
    """The arrows of a task.

    Parameters
    ----------
    task : Task
        The task.
    picture : Picture
        Its picture; if the picture already has arrows for the controls, no other control arrows are drawn.
    """

    def __init__(self, task: Task, picture: Picture) -> None:
        self._task, self._scene, self._picture = task, task.scene, picture
        view = picture.view
        self._long = LONG * min(view.right - view.left, view.top - view.bottom)
        own = any(isinstance(shape, Arrow) for _, shape in picture.shapes)
        self._controls = () if own else tuple(acting.control for acting in task.formulas.acting)
        self._reactions = dict(layout_of(self._scene).reactions)
        self._usual = self._sizes()

    def arrows(self, now: Frame) -> Iterator[tuple[Arrow, bool]]:
        """Yield the arrows of a moment, and whether each is a control's."""
        q = places(self._scene, now)
        for name, share in zip(self._scene.control_names, np.atleast_1d(now.share), strict=True):
            if name in self._controls:
                for coordinate, part in self._effect(name, now, q).items():
                    yield from ((arrow, True) for arrow in self._arrow(coordinate, float(share) * part, q))
        if self._reactions:
            with np.errstate(all="ignore"):
                found = self._scene.forces(now.state, np.atleast_1d(now.control))
            for name, coordinate in self._reactions.items():
                if usual := self._usual.get(name):
                    share = float(found[name]) / usual
                    yield from ((arrow, False) for arrow in self._arrow(coordinate, share, q))

    def _sizes(self) -> dict[str, float]:
        """Return each force's usual size: the largest in the same unit, at the middle of the starts."""
        if not self._reactions:
            return {}
        scene, found = self._scene, dict.fromkeys(self._reactions, 0.0)
        for control in (np.zeros(len(scene.control_names)), *self._task.control_range):
            with np.errstate(all="ignore"):
                forces = scene.forces(self._task.centre, control)
            for name in found:
                size = abs(float(forces[name]))
                found[name] = max(found[name], size if math.isfinite(size) else 0.0)
        # Forces are drawn on one scale, torques on another.
        units = dict(self._scene.prescribed)
        largest: dict[str, float] = {}
        for name, coordinate in self._reactions.items():
            unit = units.get(coordinate, "")
            largest[unit] = max(largest.get(unit, 0.0), found[name])
        return {name: largest[units.get(coordinate, "")] for name, coordinate in self._reactions.items()}

    def _effect(self, name: str, now: Frame, q: Mapping[str, float]) -> dict[str, float]:
        """Return the coordinates on which a control acts at full size, each with its share of the force."""
        layout = layout_of(self._scene)
        for moved in layout.prescribed:
            if moved.control == name:
                return {moved.name: 1.0}
        rates = {e.coordinate: now.state[i] for i, e in enumerate(layout.state) if e.kind == "velocity"}
        v = {coordinate: rates.get(coordinate, 0.0) for coordinate in layout.names}
        found = {coordinate: self._force(name, coordinate, q, v) for coordinate in layout.names}
        size = max(map(abs, found.values()), default=0.0)
        return {c: value / size for c, value in found.items() if abs(value) > 1e-9 * size > 0.0}

    def _force(self, name: str, coordinate: str, q: Mapping[str, float], v: Mapping[str, float]) -> float:
        """Return the generalised force of one unit of a control along a coordinate."""
        scene = self._scene

        def control(size: float) -> Values:
            layout = layout_of(scene)
            given = dict.fromkeys((*layout.controls, *layout.absent), 0.0)
            return Values("control", given | {name: size})

        def lost(rate: float, size: float) -> float:
            moved = Values("velocity of a coordinate", dict(v) | {coordinate: rate})
            return float(scene.dissipation(Values("coordinate", dict(q)), moved, control(size), Numeric))

        def given(size: float) -> float:
            at, rates = Values("coordinate", dict(q)), Values("velocity of a coordinate", dict(v))
            return float(dict(scene.applied(at, rates, control(size), Numeric) or {}).get(coordinate, 0.0))

        step = STEP * max(1.0, abs(v[coordinate]))
        ends = v[coordinate] + step, v[coordinate] - step
        drag = [(lost(ends[0], size) - lost(ends[1], size)) / (2.0 * step) for size in (1.0, 0.0)]
        return given(1.0) - given(0.0) - (drag[0] - drag[1])

    def _arrow(self, coordinate: str, share: float, q: Mapping[str, float]) -> Iterator[Arrow]:
        """Yield the arrow of a force along a coordinate, if the coordinate moves anything visible."""
        share = max(-MOST, min(MOST, share))
        if not math.isfinite(share) or abs(share) < 0.02:
            return
        step = STEP * max(1.0, abs(q[coordinate]))
        here, there = (
            dict(self._scene.poses(Values("coordinate", dict(q) | {coordinate: q[coordinate] + d}), Numeric))
            for d in (-0.5 * step, 0.5 * step)
        )
        for body, pose in here.items():
            (x0, y0, *a0), (x1, y1, *a1) = pose, there[body]
            dx, dy = (x1 - x0) / step, (y1 - y0) / step
            turn = (a1[0] - a0[0]) / step if a0 and a1 else 0.0
            x, y, size = 0.5 * (x0 + x1), 0.5 * (y0 + y1), math.hypot(dx, dy)
            if size > 1e-6:
                reach = share * self._long / size
                yield Arrow([(x, y), (x + reach * dx, y + reach * dy)])
                return
            if abs(turn) > 1e-6:
                start, end = 0.25 * math.pi, 0.25 * math.pi + share * math.copysign(math.pi, turn)
                ring: list[Point] = arc((x, y), 0.5 * self._long, start, end)
                yield Arrow(ring)
                return
