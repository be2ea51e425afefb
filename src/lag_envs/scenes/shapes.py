"""What a scene and a task look like: plain data in metres, x to the right and y up.

A shape lies in a frame, and a pose says where the frame is at a moment. A painter needs nothing else; it
transforms the shapes and paints them. A shape names its role, not its colour; the painter decides how a role
looks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Literal, NamedTuple

Point = tuple[float, float]

#: A ``body`` moves by the laws of the scene; a ``mark`` is painted on it and a ``hole`` cut out of it;
#: ``ground`` and ``frame`` support it; a ``guide`` is an imaginary line, such as an angle's zero; ``target``,
#: ``limit`` and ``action`` belong to the task.
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
    """A line through points [m] with a head at its end."""

    points: Sequence[Point]
    role: Role = "action"


class Ruler(NamedTuple):
    """Ticks below the x axis at every multiple of a step across the view; `size` is their length [m]."""

    step: float
    size: float
    role: Role = "ground"


class Magnifier(NamedTuple):
    """A round part of the picture [m] that is shown again, magnified."""

    centre: Point
    radius: float


Shape = Line | Polygon | Circle | Arrow | Ruler | Magnifier

#: Shapes by frame, from back to front.
Bodies = dict[str, Sequence[Shape]]


class Pose(NamedTuple):
    """The pose of a frame.

    Attributes
    ----------
    x, y : float [m]
        Its origin.
    angle : float [rad]
        Its rotation, counter-clockwise.
    part : float
        The visible part of the frame's lines and arrows, measured from their start. A negative part shows the
        mirror image of the frame, with -y for y: an arrow along the y axis then points the other way.
    """

    x: float
    y: float
    angle: float = 0.0
    part: float = 1.0


class Window(NamedTuple):
    """The visible part of the plane [m]; if it names a frame, it moves with the origin of that frame."""

    left: float
    bottom: float
    right: float
    top: float
    frame: str = ""

    def moved(self, x: float, y: float) -> Window:
        """Return the window moved to another place."""
        return Window(self.left + x, self.bottom + y, self.right + x, self.top + y)


class Frame(NamedTuple):
    """The content of a picture, or of many pictures if arrays take the place of numbers.

    Attributes
    ----------
    state : sequence of float
        The state, in the scene's order.
    control : float or sequence of float
        The controls applied last, in SI units.
    share : float or sequence of float
        The same controls as shares of the task's largest controls; these are the lengths of arrows.
    target : float, sequence of float or None
        The episode's targets.
    turned : float or sequence of float
        The places that the state leaves out; see `picture.left_out_rates`.
    """

    state: Sequence[Any]
    control: Any = 0.0
    share: Any = 0.0
    target: Any = None
    turned: Any = 0.0


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
    """Return points [m] along a circle between two angles [rad], in n pieces or in enough to look smooth."""
    n = n or 1 + math.ceil(abs(end - start) / 0.1)
    return [polar(centre, radius, start + (end - start) * i / n) for i in range(n + 1)]


def torque(radius: float) -> list[Shape]:
    """Return an arrow around a joint [m], starting at the x axis."""
    return [Arrow(arc((0.0, 0.0), radius, 0.0, 2.0 * math.pi / 3.0))]


def outlines(shapes: Sequence[Shape]) -> list[Shape]:
    """Return the outlines of shapes with an area, as for a goal."""
    return [shape._replace(role="target") for shape in shapes if isinstance(shape, Polygon)]


def in_plane(pose: Pose, point: Point) -> Point:
    """Return the place of a frame's point in the plane."""
    c, s, way = math.cos(pose.angle), math.sin(pose.angle), -1.0 if pose.part < 0.0 else 1.0
    a, b = point[0], way * point[1]
    return pose.x + c * a - s * b, pose.y + s * a + c * b


def placed(shape: Shape, pose: Pose, view: Window) -> list[Shape]:
    """Return the visible part of a shape, moved from its frame to the plane."""
    move = partial(in_plane, pose)
    match shape:
        case Circle() | Magnifier():
            return [shape._replace(centre=move(shape.centre))]
        case Polygon():
            return [shape._replace(points=[move(point) for point in shape.points])]
        case Ruler(_, size, role):
            return [Line([move((a, 0.0)), move((a, -size))], role) for a in ruled(shape, pose, view)]
        case _:
            return [shape._replace(points=[move(point) for point in beginning(shape.points, abs(pose.part))])]


def ruled(ruler: Ruler, pose: Pose, view: Window) -> list[float]:
    """Return the places of a ruler's visible ticks along its axis [m]."""
    across, up = 0.5 * (view.left + view.right) - pose.x, 0.5 * (view.bottom + view.top) - pose.y
    middle = math.cos(pose.angle) * across + math.sin(pose.angle) * up
    far = 2.0 * max(view.right - view.left, view.top - view.bottom)
    # Ticks too fine to see are left out.
    return ticks(middle - far, middle + far, ruler.step) if far < 5_000.0 * ruler.step else []


def beginning(points: Sequence[Point], part: float) -> Sequence[Point]:
    """Return the first part of a line."""
    if part >= 1.0:
        return points
    room, kept = part * sum(math.dist(a, b) for a, b in pairwise(points)), [points[0]]
    for a, b in pairwise(points):
        step = math.dist(a, b)
        if step >= room:
            share = room / step if step else 0.0
            return [*kept, (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))]
        kept.append(b)
        room -= step
    return kept


def extent(shapes: Sequence[Shape]) -> float:
    """Return the largest distance of shapes from the origin of their frame [m]."""
    sizes = [0.0]
    for shape in shapes:
        if isinstance(shape, Circle | Magnifier):
            sizes.append(math.hypot(*shape.centre) + shape.radius)
        elif not isinstance(shape, Ruler):
            sizes += [math.hypot(*point) for point in shape.points]
    return max(sizes)


def roller(radius: float, ratio: float) -> list[Shape]:
    """Return a rolling cylinder about the origin [m].

    A ratio I/(m r²) above 1/2 makes it a tube, which is drawn to scale.
    """
    hollow = min(math.sqrt(max(2.0 * ratio - 1.0, 0.0)), 0.95) * radius
    centre, quarter = (0.0, 0.0), 0.5 * math.pi
    rims = [arc(centre, radius, start, start + quarter) for start in (quarter, 3.0 * quarter)]
    marks = [Polygon([centre, *rim], "mark") for rim in rims]
    return [Circle(centre, radius), *marks, Circle(centre, max(hollow, 0.1 * radius), "hole")]


def half_turn(radius: float) -> Line:
    """Return the arc that shows an angle: it begins at the x axis and is half a turn long when complete."""
    return Line(arc((0.0, 0.0), radius, 0.0, math.pi), "guide")


def share_of_half_turn(angle: Any, xp: Any) -> Any:
    """Return an angle within (-π, π) as a share of half a turn."""
    return 2.0 / math.pi * xp.atan(xp.sin(angle) / xp.maximum(1.0 + xp.cos(angle), 1e-9))


def rail(track: float | None, reach: float) -> list[Shape]:
    """Return the fixed part of a rail: a track with its ends, or the ticks of a track without ends.

    Parameters
    ----------
    track : float [m] or None
        Half length of the track; infinity for a track without ends, None for no track.
    reach : float [m]
        Size of the body that hangs from the support.
    """
    if track is None:
        return [Line([(-2.0 * reach, 0.0), (2.0 * reach, 0.0)], "guide")]
    size = 0.035 * reach
    if math.isinf(track):
        return [Ruler(round_length(0.6 * reach), size)]
    return [
        *(Line([(x, 0.0), (x, -size)], "ground") for x in ticks(-track, track, round_length(0.2 * track))),
        Line([(-track, 0.0), (track, 0.0)], "frame"),
        *(Line([(end, -2.0 * size), (end, 2.0 * size)], "limit") for end in (-track, track)),
    ]


def rail_without_end(track: float | None, reach: float) -> list[Shape]:
    """Return the part of a track without ends that moves with the support."""
    return [Line([(-3.0 * reach, 0.0), (3.0 * reach, 0.0)], "frame")] if track == math.inf else []


def window_on_rail(track: float | None, tall: float) -> Window:
    """Return a window on the whole track with a margin [m], or one that follows the support."""
    if track is None or math.isinf(track):
        return Window(-tall, -tall, tall, tall, "support")
    return Window(-track - tall, -tall, track + tall, tall)


def ticks(low: float, high: float, step: float) -> list[float]:
    """Return the multiples of a step between two numbers."""
    return [i * step for i in range(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)]


def round_length(length: float) -> float:
    """Return the largest number of the form 1, 2 or 5 times a power of ten that is at most the length."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1.0, 2.0, 5.0) if step == 1.0 or step * power <= 1.000001 * length)
