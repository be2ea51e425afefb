"""Shapes become pixels, in the same way as on the leaderboard's page.

Shapes are turned into outlines once, in their frames. Painting a picture then takes a pose for each frame and
one compiled call.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.envs import raster
from lag_envs.scenes import shapes as s
from lag_envs.scenes.picture import Picture
from lag_envs.scenes.shapes import Point, Pose, Role, Shape, Window, in_plane

#: Margin around a picture's content [pixels].
MARGIN = 8
#: Side of a magnifier, as a share of the picture's shorter side, and its distance from the corner [pixels].
GLASS, GLASS_ROOM = 0.36, 12
#: A line with more dashes than this is drawn without gaps.
DASHES = 2_000

PAPER = "#ffffff"


class Style(NamedTuple):
    """How a role looks: colours, width of lines, length of dashes and of the gaps between them [pixels]."""

    fill: str | None
    edge: str
    width: float
    dash: tuple[float, float] | None = None


#: As in the page's style sheet and painter, in the light theme. The colours that carry meaning are Okabe and
#: Ito's, which colour-blind people can tell apart.
STYLES: dict[Role, Style] = {
    "body": Style("#56b4e9", "#0b5f9c", 1.5),
    "mark": Style("#0b5f9c", "#0b5f9c", 0.0),
    "hole": Style(PAPER, "#605e58", 1.2),
    "ground": Style("#e9e7e1", "#98958c", 1.2),
    "frame": Style("#bdbbb4", "#605e58", 1.5),
    "guide": Style(None, "#a5a299", 1.0, (4.0, 4.0)),
    "target": Style(None, "#00805c", 1.8, (6.0, 4.0)),
    "limit": Style("#b0558a", "#b0558a", 2.5),
    "action": Style("#ad4200", "#ad4200", 4.0),
}
#: The arrow of a force, a trail, and the rim of a magnifier.
FORCE, TRAIL = Style("#5b3a8c", "#5b3a8c", 3.0), Style(None, "#0b5f9c", 1.6)
RIM = STYLES["guide"]._replace(width=1.2, dash=None)


@cache
def rgb(colour: str) -> tuple[float, float, float]:
    """Return red, green and blue, 0 to 255."""
    return float(int(colour[1:3], 16)), float(int(colour[3:5], 16)), float(int(colour[5:7], 16))


class StyledShape(NamedTuple):
    """A line or an arrow in the plane with a style of its own, and how opaque it is."""

    shape: s.Line | s.Arrow
    style: Style
    opacity: float


class Outline(NamedTuple):
    """Polygons of one shape, see `raster.fill`."""

    points: NDArray[np.float64]
    ends: NDArray[np.int64]
    colours: NDArray[np.float64]


class Pen:
    """Paints the shapes of a picture; the picture's window is shown as large as the image allows.

    Parameters
    ----------
    picture : Picture
        The shapes; its view may move but keeps its size.
    size : (int, int)
        Width and height of the image [pixels].
    strip : int
        Height of the free strip below [pixels].
    glass : float, optional
        If given, a square with sides of this length [m] is shown, without a margin, in place of the picture's
        window.
    """

    def __init__(
        self, picture: Picture, size: tuple[int, int], strip: int = 0, glass: float | None = None
    ) -> None:
        self._picture, (width, height) = picture, size
        view, margin = picture.view, MARGIN if glass is None else 0
        wide, high = (view.right - view.left, view.top - view.bottom) if glass is None else (glass, glass)
        self._box = width - 2 * margin, height - strip - 2 * margin
        self.scale = 1.0 / max(wide / self._box[0], high / self._box[1])
        self._middle = 0.5 * width, 0.5 * (height - strip)
        self._shapes = [x for x in picture.shapes if not isinstance(x[1], s.Magnifier)]
        self._lenses = [x for x in picture.shapes if isinstance(x[1], s.Magnifier)] if glass is None else []
        #: Rulers' outlines depend on the view and are rebuilt for each picture.
        self._outlines = [self._outline(shape) for _, shape in self._shapes]
        self._room = np.zeros((height, width + 2))
        self._plane = len(picture.frames)
        self._glass: Glass | None = None

    def paint(
        self, image: NDArray[np.uint8], poses: Sequence[Pose], view: Window, more: Sequence[StyledShape] = ()
    ) -> None:
        """Paint the shapes, and then the extras in the plane, over an image."""
        places = self._places(poses, view)
        found, frames = [], []
        for (frame, shape), outline in zip(self._shapes, self._outlines, strict=True):
            pose = poses[frame]
            if isinstance(shape, s.Ruler):
                outline = self._ticks(shape, s.ruled(shape, pose, view))
            elif abs(pose.part) < 1.0 and isinstance(shape, s.Line | s.Arrow):
                outline = self._outline(shape._replace(points=s.beginning(shape.points, abs(pose.part))))
            found.append(outline)
            frames.append(frame)
        for shape, style, opacity in more:
            outline = self._outline(shape, style)
            outline.colours[:, 3] = opacity
            found.append(outline)
            frames.append(self._plane)
        self._fill(image, found, frames, places)
        for frame, lens in self._lenses:
            self._magnify(image, lens, in_plane(poses[frame], lens.centre), poses, places)

    def _places(self, poses: Sequence[Pose], view: Window) -> NDArray[np.float64]:
        """Return the maps of all frames, and finally of the plane, to the image."""
        places = np.empty((len(poses) + 1, 6))
        scale, (across, down) = self.scale, self._middle
        x0, y0 = 0.5 * (view.left + view.right), 0.5 * (view.bottom + view.top)
        for i, (x, y, angle, part) in enumerate((*poses, Pose(0.0, 0.0))):
            c, n = scale * math.cos(angle), scale * math.sin(angle)
            way = -1.0 if part < 0.0 else 1.0
            places[i] = c, -n * way, -n, -c * way, across + scale * (x - x0), down - scale * (y - y0)
        return places

    def _fill(
        self,
        image: NDArray[np.uint8],
        outlines: Sequence[Outline],
        frames: Sequence[int],
        places: NDArray[np.float64],
    ) -> None:
        if not outlines:
            return
        counts = [len(outline.ends) for outline in outlines]
        sizes = [0, *accumulate(len(outline.points) for outline in outlines)]
        ends = np.concatenate([outline.ends for outline in outlines]) + np.repeat(sizes[:-1], counts)
        points = np.concatenate([outline.points for outline in outlines])
        colours = np.concatenate([outline.colours for outline in outlines])
        raster.fill(image, points, ends, np.repeat(frames, counts), places, colours, self._room)

    def _outline(self, shape: Shape, style: Style | None = None) -> Outline:
        """Return the polygons of a shape, in metres of its frame."""
        polygons: list[tuple[Sequence[Point], str]] = []
        look, unit = style or STYLES[shape.role], 1.0 / self.scale  # type: ignore[union-attr]
        match shape:
            case s.Line(points):
                polygons += _line(list(points), look, unit)
            case s.Polygon(points):
                polygons += _area(list(points), look, unit)
            case s.Circle(centre, radius):
                polygons += _disc(centre, radius, look, unit)
            case s.Arrow(points):
                polygons += _arrow(list(points), look, unit)
        return _joined(polygons)

    def _ticks(self, ruler: s.Ruler, at: Sequence[float]) -> Outline:
        """Return a ruler's ticks."""
        style = STYLES[ruler.role]
        half = 0.5 * style.width / self.scale
        tick = np.array([(-half, 0.0), (half, 0.0), (half, -ruler.size), (-half, -ruler.size)])
        points = (np.array(at).reshape(-1, 1, 1) * (1.0, 0.0) + tick).reshape(-1, 2)
        colours = np.tile((*rgb(style.edge), 1.0), (len(at), 1))
        return Outline(points, 4 * np.arange(1, len(at) + 1), colours)

    def _magnify(
        self,
        image: NDArray[np.uint8],
        lens: s.Magnifier,
        centre: Point,
        poses: Sequence[Pose],
        places: NDArray[np.float64],
    ) -> None:
        """Show a part of the picture magnified, in the upper right corner."""
        size = round(GLASS * min(self._box))
        if size < 8:
            return
        if self._glass is None or self._glass.lens != lens:
            self._glass = self._ground(lens, size)
        x, y = centre
        view = Window(x - lens.radius, y - lens.radius, x + lens.radius, y + lens.radius)
        glass = np.full((size, size, 3), 255, np.uint8)
        self._glass.pen.paint(glass, poses, view)
        left, top = MARGIN + self._box[0] - size - GLASS_ROOM, MARGIN + GLASS_ROOM
        place = image[top : top + size, left : left + size]
        place[:] = place + self._glass.cover * (glass - place.astype(np.float32)) + 0.5
        a, *_, e, f = places[-1].tolist()
        middles = [(left + 0.5 * size, top + 0.5 * size), (e + a * x, f - a * y)]
        at = np.array([(1.0, 0.0, 0.0, 1.0, *middle) for middle in middles])
        self._fill(image, self._glass.rims, [0, 1], at)

    def _ground(self, lens: s.Magnifier, size: int) -> Glass:
        """Return the parts of a magnifier that stay the same."""
        mask, rim = np.zeros((size, size, 3), np.uint8), np.array(_rim((0.5, 0.5), 0.5, 1.0 / size))
        at, white = np.array([[size, 0.0, 0.0, size, 0.0, 0.0]]), np.array([[255.0, 255.0, 255.0, 1.0]])
        none, room = np.zeros(1, np.int64), np.zeros((size, size + 2))
        raster.fill(mask, rim, np.array([len(rim)]), none, at, white, room)
        pen = Pen(self._picture, (size, size), glass=2.0 * lens.radius)
        circles = [
            _line(_rim((0.0, 0.0), radius, 1.0), RIM, 1.0)
            for radius in (0.5 * size, lens.radius * self.scale)
        ]
        return Glass(lens, pen, mask[:, :, :1].astype(np.float32) / 255.0, [_joined(c) for c in circles])


class Glass(NamedTuple):
    """A magnifier: its pen, its coverage of each pixel, its own rim, and the rim of the magnified part."""

    lens: s.Magnifier
    pen: Pen
    cover: NDArray[np.float32]
    rims: list[Outline]


def _joined(polygons: Polygons) -> Outline:
    """Return polygons in the form that `raster.fill` takes."""
    ends = np.array([*accumulate(len(points) for points, _ in polygons)], np.int64)
    flat = [point for points, _ in polygons for point in points]
    colours = [(*rgb(colour), 1.0) for _, colour in polygons]
    return Outline(
        np.array(flat, np.float64).reshape(-1, 2), ends, np.array(colours, np.float64).reshape(-1, 4)
    )


# --- outlines, in metres ----------------------------------------------------------------------------------
# `unit` is the length of a pixel.

Polygons = list[tuple[Sequence[Point], str]]


def _line(points: list[Point], style: Style, unit: float) -> Polygons:
    if style.dash is None or not _dashable(points, style.dash, unit):
        return _stroke(points, style.edge, unit * style.width)
    found: Polygons = []
    for dash in _dashes(points, unit * style.dash[0], unit * style.dash[1]):
        found += _stroke(dash, style.edge, unit * style.width)
    return found


def _dashable(points: list[Point], dash: tuple[float, float], unit: float) -> bool:
    return sum(math.dist(a, b) for a, b in pairwise(points)) < DASHES * unit * sum(dash)


def _area(points: list[Point], style: Style, unit: float) -> Polygons:
    half = 0.5 * unit * style.width
    if style.fill is None:
        return _line([*points, points[0]], style, unit)
    if half == 0.0:
        return [(points, style.fill)]
    turn = sum(a[0] * b[1] - a[1] * b[0] for a, b in pairwise([*points, points[0]]))
    outward, ways = math.copysign(half, turn), _aside(points, closed=True)
    return [(_moved(points, ways, outward), style.edge), (_moved(points, ways, -outward), style.fill)]


def _disc(centre: Point, radius: float, style: Style, unit: float) -> Polygons:
    half = 0.5 * unit * style.width
    if style.fill is None:
        return _line(_rim(centre, radius, unit), style, unit)
    found: Polygons = [(_rim(centre, radius + half, unit), style.edge)]
    return [*found, (_rim(centre, radius - half, unit), style.fill)] if radius > half else found


def _rim(centre: Point, radius: float, unit: float) -> list[Point]:
    """Return points of a circle, clockwise and in a number that suits its size; the last equals the first."""
    n = min(max(12, math.ceil(7.0 * math.sqrt(max(radius, 0.0) / unit))), 300)
    return s.arc(centre, radius, 0.0, -2.0 * math.pi, n)


def _arrow(points: list[Point], style: Style, unit: float) -> Polygons:
    """Return an arrow with the length of its points; a short arrow is thinner."""
    length, width = sum(math.dist(a, b) for a, b in pairwise(points)), unit * style.width
    if length < 1.5 * unit:
        return []
    width *= min(1.0, length / (4.0 * width))
    shaft = list(s.beginning(points, 1.0 - 3.0 * width / length))
    tip, (x, y) = points[-1], shaft[-1]
    aside = 0.5 * (tip[1] - y), 0.5 * (x - tip[0])
    head = [tip, (x + aside[0], y + aside[1]), (x - aside[0], y - aside[1])]
    return [*_stroke(shaft, style.edge, width), (head, style.edge)]


def _stroke(points: list[Point], colour: str, width: float) -> Polygons:
    if len(points) < 2:
        return []
    ways = _aside(points)
    there, back = _moved(points, ways, 0.5 * width), _moved(points, ways, -0.5 * width)
    return [([*there, *reversed(back)], colour)]


def _between(a: Point, b: Point, share: float) -> Point:
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])


def _aside(points: list[Point], closed: bool = False) -> list[Point]:
    """Return for each point of a line its offset to a parallel line at a distance of 1."""
    first, last = (points[-1], points[0]) if closed else (points[0], points[-1])
    ways = []
    for (ax, ay), (bx, by) in pairwise(_normal(a, b) for a, b in pairwise([first, *points, last])):
        # At a corner, the sum of both pieces' normals points to the corner; at an end one of them is zero.
        stretch = 1.0 / max(1.0 + ax * bx + ay * by, 0.3)
        ways.append((stretch * (ax + bx), stretch * (ay + by)))
    return ways


def _moved(points: list[Point], ways: list[Point], distance: float) -> list[Point]:
    return [(x + distance * a, y + distance * b) for (x, y), (a, b) in zip(points, ways, strict=True)]


def _normal(a: Point, b: Point) -> Point:
    length = math.dist(a, b)
    return ((b[1] - a[1]) / length, (a[0] - b[0]) / length) if length else (0.0, 0.0)


def _dashes(points: list[Point], length: float, gap: float) -> Iterator[list[Point]]:
    """Cut a line into dashes with gaps between them."""
    dash, room, on = [points[0]], length, True
    for a, b in pairwise(points):
        step, done = math.dist(a, b), 0.0
        while step - done > room:
            done += room
            cut = _between(a, b, done / step)
            if on:
                yield [*dash, cut]
            dash, on = [cut], not on
            room = length if on else gap
        room -= step - done
        dash.append(b)
    if on:
        yield dash
