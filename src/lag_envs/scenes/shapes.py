"""What is to be seen of a scene and of a task: plain data in metres, x to the right and y up.

A shape names its role and not its colour; how a role looks is the viewer's business.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

Point = tuple[float, float]

#: ``body`` moves by the laws of the scene, ``mark`` is painted on it and ``hole`` cut out of it; ``ground``
#: and ``frame`` carry it; ``guide`` is a line of thought, such as an angle's zero; ``target``, ``limit`` and
#: ``action`` belong to the task.
Role = Literal["body", "mark", "hole", "ground", "frame", "guide", "target", "limit", "action"]


class Line(NamedTuple):
    """A line through points [m]."""

    points: Sequence[Point]
    role: Role = "frame"


class Polygon(NamedTuple):
    """An area with corners [m]."""

    points: Sequence[Point]
    role: Role = "body"


class Circle(NamedTuple):
    """A disc [m]."""

    centre: Point
    radius: float
    role: Role = "body"


class Arrow(NamedTuple):
    """A line through points [m] that ends in a head."""

    points: Sequence[Point]
    role: Role = "action"


class Lens(NamedTuple):
    """A round part of the picture [m] that is shown once more, magnified."""

    centre: Point
    radius: float


Shape = Line | Polygon | Circle | Arrow | Lens


class Window(NamedTuple):
    """The part of the plane that is to be seen [m]."""

    left: float
    bottom: float
    right: float
    top: float


class Moment(NamedTuple):
    """What a picture shows.

    Attributes
    ----------
    state : sequence of float
        The state, in the scene's order.
    control : float
        The control that was applied last, in SI units.
    share : float
        The same as a share of the task's largest control; the length of an arrow.
    target : float or None
        The episode's target.
    turned : float
        Integral of `Scene.turning`.
    """

    state: Sequence[float]
    control: float = 0.0
    share: float = 0.0
    target: float | None = None
    turned: float = 0.0


class Reading(NamedTuple):
    """A line of the read-out; "theta" stands for the Greek letter, "_dot" or "'" for a derivative."""

    name: str
    value: float
    unit: str
    role: Role = "frame"


def polar(centre: Point, radius: float, angle: float) -> Point:
    """Return the point at a distance from a centre [m], at an angle from the x axis [rad]."""
    return centre[0] + radius * math.cos(angle), centre[1] + radius * math.sin(angle)


def arc(centre: Point, radius: float, start: float, end: float, n: int = 0) -> list[Point]:
    """Return points [m] along a circle between two angles [rad], in n pieces or as many as look smooth."""
    n = n or 1 + math.ceil(abs(end - start) / 0.1)
    return [polar(centre, radius, start + (end - start) * i / n) for i in range(n + 1)]


def placed(shapes: Sequence[Shape], pose: tuple[float, float, float]) -> list[Shape]:
    """Return shapes of a body's own frame where the body is: at (x, y) [m], turned by an angle [rad]."""
    x, y, angle = pose
    c, s = math.cos(angle), math.sin(angle)

    def move(point: Point) -> Point:
        return x + c * point[0] - s * point[1], y + s * point[0] + c * point[1]

    moved: list[Shape] = []
    for shape in shapes:
        if isinstance(shape, Circle | Lens):
            moved.append(shape._replace(centre=move(shape.centre)))
        else:
            moved.append(shape._replace(points=[move(point) for point in shape.points]))
    return moved


def extent(shapes: Sequence[Shape]) -> float:
    """Return the largest distance of shapes from the origin of their frame [m]."""
    sizes = [0.0]
    for shape in shapes:
        if isinstance(shape, Circle | Lens):
            sizes.append(math.hypot(*shape.centre) + shape.radius)
        else:
            sizes += [math.hypot(*point) for point in shape.points]
    return max(sizes)


def roller(centre: Point, radius: float, angle: float, ratio: float) -> list[Shape]:
    """Return a rolling cylinder that has turned counter-clockwise by an angle [rad].

    The ratio I/(m r²) above 1/2 is that of a tube, which is drawn to scale.
    """
    hollow = min(math.sqrt(max(2.0 * ratio - 1.0, 0.0)), 0.95) * radius
    quarters = [arc(centre, radius, angle + start, angle + start + 0.5 * math.pi) for start in (0.0, math.pi)]
    marks = [Polygon([centre, *rim], "mark") for rim in quarters]
    return [Circle(centre, radius), *marks, Circle(centre, max(hollow, 0.1 * radius), "hole")]


def ticks(low: float, high: float, step: float) -> list[float]:
    """Return the multiples of a step that lie between two numbers."""
    return [i * step for i in range(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)]


def round_length(length: float) -> float:
    """Return the largest of 1, 2, 5, 10, ... and their parts by ten that is at most the length."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1.0, 2.0, 5.0) if step == 1.0 or step * power <= 1.000001 * length)
