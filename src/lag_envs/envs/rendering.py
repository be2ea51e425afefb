"""Pictures of scenes and their tasks, painted in the same way as on the leaderboard's page.

Shapes are turned into outlines once, in their frames; a picture is then a pose for each frame and one
compiled call. pygame only opens windows and writes the read-out.
"""

from __future__ import annotations

import math
import os
import time
import unicodedata
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium.error import DependencyNotInstalled, Error
from numpy.typing import NDArray

from lag_envs.envs import raster
from lag_envs.envs.forces import Forces
from lag_envs.scenes import shapes as s
from lag_envs.scenes.picture import Picture, left_out_rates
from lag_envs.scenes.shapes import Frame, Point, Pose, Reading, Role, Shape, Window
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import measured_entry

if TYPE_CHECKING:
    import pygame

#: Width and height of a picture, margin around its content, and height of the read-out [pixels].
WIDTH, HEIGHT, MARGIN, STRIP = 600, 400, 8, 48
#: Least width of a column of the read-out [pixels].
COLUMN = 90
#: Side of a magnifier, as a share of the picture's shorter side, and its distance from the corner [pixels].
GLASS, GLASS_ROOM = 0.36, 12
#: A window shows at most this many pictures per second.
RATE = 60.0
#: A line with more dashes than this is drawn without gaps.
DASHES = 2_000

PAPER, STRIP_PAPER, INK = "#ffffff", "#f2f2f2", "#303030"


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
def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled(
            'windows and the read-out need pygame: pip install "lag-envs[render]"'
        ) from error
    return pygame


@cache
def _rgb(colour: str) -> tuple[float, float, float]:
    """Return red, green and blue, 0 to 255."""
    return float(int(colour[1:3], 16)), float(int(colour[3:5], 16)), float(int(colour[5:7], 16))


class Look(NamedTuple):
    """What pictures show besides shapes.

    Attributes
    ----------
    arrows : bool
        Whether to draw arrows for controls without arrows of their own, and for the forces that the scene
        names.
    trail : float [s]
        How long the bodies' trails are.
    readout : bool
        Whether time, return, score, controls and state are written below.
    """

    arrows: bool = False
    trail: float = 0.0
    readout: bool = False


class Viewer:
    """Paints one environment.

    Parameters
    ----------
    task : Task
        The task; it decides, with its scene, what is shown.
    mode : {"human", "rgb_array"}
        Whether `draw` shows the picture in a window, in real time, or returns it.
    look : Look, optional
        What else is shown.
    size : (int, int)
        Width and height of the picture [pixels].

    Notes
    -----
    A process has one window; several viewers share it side by side. If its user closes it, the environments
    continue without a picture until they are closed and rendered again.

    Raises
    ------
    DependencyNotInstalled
        If pygame is missing, for a window or the read-out.
    Error
        From `draw`, if there is no display for the window.
    """

    def __init__(
        self,
        task: Task,
        mode: str,
        look: tuple[bool, float, bool] = Look(),
        size: tuple[int, int] = (WIDTH, HEIGHT),
    ) -> None:
        self._look, self._size = Look(*look), size
        self.use(task)
        self._trail: deque[list[Point]] = deque(maxlen=max(2, round(self._look.trail / task.dt) + 1))
        self._turned: Any = 0.0
        self._before: tuple[list[float], NDArray[np.float64]] | None = None
        self._steps, self._episode = 0, 0
        self._human = mode == "human"
        self._due = self._shown = -math.inf
        if self._human or self._look.readout:
            _pygame()
        if self._human:
            _desk.add(self)

    def use(self, task: Task) -> None:
        """Show another task from now on, of the same class with other parameters."""
        self._task, self._picture = task, Picture(task)
        self._pen = Pen(self._picture, self._size, STRIP if self._look.readout else 0)
        self._forces = Forces(task, self._picture) if self._look.arrows else None
        self._scale = _scale(task) if self._look.readout else None
        #: Points of the bodies that leave a trail; `_trail` has their earlier places.
        self._tips = tips(self._picture) if self._look.trail else {}

    def draw(
        self,
        state: NDArray[np.float64],
        control: Any,
        target: Any,
        steps: int = 0,
        total: float = 0.0,
        episode: int = 0,
    ) -> NDArray[np.uint8] | None:
        """Paint a state.

        Parameters
        ----------
        state : ndarray, shape (n_state,)
            State in SI units, in the scene's order.
        control : float or sequence of float
            Controls applied last, in SI units.
        target : float, sequence of float or None
            The episode's targets.
        steps : int
            Steps of the episode so far.
        total : float
            Sum of its rewards so far.
        episode : int
            A number that is different for each episode.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3), or None
            The picture; None if it is shown in a window.
        """
        if self._human and self not in _desk:
            return None
        if episode != self._episode or steps < self._steps:
            self._turned, self._before = 0.0, None
            self._trail.clear()
        again = steps == self._steps and self._before is not None
        self._episode, self._steps = episode, steps
        values = state.tolist()
        self._turn(values)
        now = Frame(values, control, self._task.share(control), target, self._turned)
        poses = self._picture.poses(now)
        if self._tips and not (again and self._trail):
            self._trail.append([_seen(poses[frame], tip) for frame, tip in self._tips.items()])
        if self._human and not again and not self._is_due():
            return None
        picture = self._paint(now, poses, steps * self._task.dt, total)
        if not self._human:
            return picture
        _desk.show(self, picture)
        if not again:
            self._wait()
        return None

    def close(self) -> None:
        """Remove the picture from the window; the last viewer closes it."""
        _desk.remove(self)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture [pixels]."""
        return self._size

    def _paint(self, now: Frame, poses: list[Pose], seconds: float, total: float) -> NDArray[np.uint8]:
        width, height = self._size
        image = np.full((height, width, 3), 255, np.uint8)
        more = list(self._more(now, poses))
        self._pen.paint(image, poses, self._picture.window(poses), more)
        if self._look.readout:
            write_readout(image, self._readings(now, seconds, total), self._pen.scale)
        return image

    def _more(self, now: Frame, poses: list[Pose]) -> Iterator[StyledShape]:
        """Yield trail and arrows."""
        pieces = min(12, len(self._trail) - 1)
        for tip in range(len(self._tips)):
            way = [points[tip] for points in self._trail]
            for i in range(pieces):
                part = way[i * (len(way) - 1) // pieces : (i + 1) * (len(way) - 1) // pieces + 1]
                yield StyledShape(s.Line(part), TRAIL, (i + 1.0) / pieces)
        if self._forces is not None:
            for arrow, is_control in self._forces.arrows(now, poses):
                yield StyledShape(arrow, STYLES["action"] if is_control else FORCE, 1.0)

    def _readings(self, now: Frame, seconds: float, total: float) -> list[list[Reading]]:
        """Return the rows of the read-out."""
        task = self._task
        first = [Reading("time", seconds, "s"), Reading("return", total, "")]
        if self._scale is not None:
            random, best = self._scale
            first.append(Reading("score", (total - random) / (best - random), ""))
        names = zip(task.scene.state_names, now.state, task.scene.state_units, strict=True)
        return [
            [*first, *task.control_readings(now), *task.readings(now)],
            [Reading(*entry) for entry in names],
        ]

    def _turn(self, state: list[float]) -> None:
        """Integrate angles that the state leaves out; exact if rates are linear and every step is drawn."""
        rate = np.array(left_out_rates(self._task.scene, state))
        if self._before is not None and self._before[0] != state:
            self._turned += 0.5 * self._task.dt * (self._before[1] + rate)
        self._before = (state, rate)

    # --- real time ------------------------------------------------------------------------------------------

    def _is_due(self) -> bool:
        """Return whether to show this step: if steps are faster than the window, only some are shown."""
        now = time.perf_counter()
        self._due += self._task.dt
        if not now - 0.25 < self._due:
            self._due = now  # at the start, and after a delay, which is not made up for
        return self._due - self._shown > 1.0 / RATE - 1e-4

    def _wait(self) -> None:
        """Wait until one control interval after the previous step."""
        self._shown = self._due
        time.sleep(max(0.0, self._due - time.perf_counter()))


def _scale(task: Task) -> tuple[float, float] | None:
    """Return the returns with scores 0 and 1; None if the task's parameters are not the standard ones."""
    known, usual = measured_entry(task.id).get("scale"), type(task)()
    same = (task.scene, task.dt, task.duration) == (usual.scene, usual.dt, usual.duration)
    return (known["random"], known["best"]) if known and same else None


def tips(picture: Picture) -> dict[int, Point]:
    """Return for each frame with a body the middle of its points farthest from the frame's origin."""
    found = {}
    for frame in dict.fromkeys(frame for frame, _ in picture.shapes):
        points: list[Point] = []
        for of, shape in picture.shapes:
            if of == frame and getattr(shape, "role", "") == "body":
                points += [shape.centre] if isinstance(shape, s.Circle) else list(shape.points)
        far = max((math.hypot(*point) for point in points), default=0.0)
        ends = [point for point in points if math.hypot(*point) >= 0.98 * far]
        if points:
            found[frame] = (sum(x for x, _ in ends) / len(ends), sum(y for _, y in ends) / len(ends))
    return found


def _seen(pose: Pose, point: Point) -> Point:
    """Return the place of a frame's point in the plane."""
    c, n, way = math.cos(pose.angle), math.sin(pose.angle), -1.0 if pose.part < 0.0 else 1.0
    return pose.x + c * point[0] - way * n * point[1], pose.y + n * point[0] + way * c * point[1]


def paint(task: Task, now: Frame, size: tuple[int, int] = (WIDTH, HEIGHT)) -> NDArray[np.uint8]:
    """Return a picture of a moment, of some size."""
    shown = Picture(task)
    poses = shown.poses(now)
    image = np.full((size[1], size[0], 3), 255, np.uint8)
    Pen(shown, size).paint(image, poses, shown.window(poses))
    return image


def columns_of(tiles: int) -> int:
    """Return the number of columns in a grid of this many pictures."""
    return math.ceil(math.sqrt(tiles))


def tile_size(tiles: int) -> tuple[int, int]:
    """Return the size of each picture of a grid, which is at most as wide as two pictures."""
    # Even numbers, which video files require.
    width, height = (max(30, size // columns_of(tiles)) * 2 for size in (WIDTH, HEIGHT))
    return min(WIDTH, width), min(HEIGHT, height)


def tiled(pictures: Sequence[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    """Return pictures of one size as a single one, row by row, with lines between them."""
    height, width = pictures[0].shape[:2]
    rows = math.ceil(len(pictures) / columns)
    image = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        y, x = divmod(i, columns)
        place = image[y * height : (y + 1) * height, x * width : (x + 1) * width]
        place[:] = picture
        place[-1:], place[:, -1:] = 0xC8, 0xC8
    return image


# --- painting ---------------------------------------------------------------------------------------------


class StyledShape(NamedTuple):
    """A line or an arrow in the plane with a style of its own, and how opaque it is."""

    shape: s.Line | s.Arrow
    style: Style
    opacity: float = 1.0


class Outline(NamedTuple):
    """Polygons of one shape, see `raster.fill`."""

    points: NDArray[np.float64]
    ends: NDArray[np.int64]
    colours: NDArray[np.float64]


class Pen:
    """Paints the shapes of a picture; the image shows as much of the picture's window as it can.

    Parameters
    ----------
    picture : Picture
        The shapes; its view may move but keeps its size.
    size : (int, int)
        Width and height of the image [pixels].
    strip : int
        Height of the free strip below [pixels].
    glass : float, optional
        Show a square with sides of this length [m], without a margin, in place of the picture's window.
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
            self._magnify(image, lens, _seen(poses[frame], lens.centre), poses, places)

    def _places(self, poses: Sequence[Pose], view: Window) -> NDArray[np.float64]:
        """Return the maps of each frame, and last of the plane, to the image."""
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
        colours = np.tile((*_rgb(style.edge), 1.0), (len(at), 1))
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
    colours = [(*_rgb(colour), 1.0) for _, colour in polygons]
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
    """Return points of a circle, clockwise, as many as its size needs; the last equals the first."""
    n = min(max(12, math.ceil(7.0 * math.sqrt(max(radius, 0.0) / unit))), 300)
    return s.arc(centre, radius, 0.0, -2.0 * math.pi, n)


def _arrow(points: list[Point], style: Style, unit: float) -> Polygons:
    """Return an arrow with the length of its points; a short one is thinner."""
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


# --- the window -------------------------------------------------------------------------------------------


class _Desk:
    """The window of the process, which the viewers share."""

    def __init__(self) -> None:
        # Weak, so that an environment that was dropped without being closed does not keep its place.
        self._viewers: weakref.WeakKeyDictionary[Viewer, None] = weakref.WeakKeyDictionary()
        self._screen: pygame.Surface | None = None
        self._places = 0

    def __contains__(self, viewer: Viewer) -> bool:
        return viewer in self._viewers

    def add(self, viewer: Viewer) -> None:
        """Make room for a viewer."""
        # Finalizers registered first run last: by then the viewer is no longer among these.
        weakref.finalize(viewer, self._tidy)
        self._viewers[viewer] = None

    def remove(self, viewer: Viewer) -> None:
        """Remove a viewer's picture; the last viewer closes the window."""
        self._viewers.pop(viewer, None)
        self._tidy()

    def _tidy(self) -> None:
        """Close the window if no viewer is left, as at the end of the program."""
        if self._screen is not None and not self._viewers:
            self._close()

    def show(self, viewer: Viewer, picture: NDArray[np.uint8]) -> None:
        """Show a viewer's picture, and close the window if its user asks for it."""
        pygame, places = _pygame(), list(self._viewers)
        columns, (width, height) = math.ceil(math.sqrt(len(places))), viewer.size
        # There is also no surface if another part of the program has closed all windows.
        if self._screen is None or self._places != len(places) or pygame.display.get_surface() is None:
            rows = math.ceil(len(places) / columns)
            self._screen, self._places = _open_window(columns * width, rows * height), len(places)
        row, column = divmod(places.index(viewer), columns)
        surface = pygame.image.frombuffer(picture, (width, height), "RGB")
        self._screen.blit(surface, (column * width, row * height))
        pygame.display.flip()
        pygame.event.pump()
        # Only this event is taken from the queue, so that a program can read keys.
        if pygame.event.get(pygame.QUIT):
            self._viewers.clear()
            self._close()

    def _close(self) -> None:
        self._screen = None
        _pygame().display.quit()


def _open_window(width: int, height: int) -> pygame.Surface:
    pygame = _pygame()
    try:
        pygame.display.init()
        screen = pygame.display.set_mode((width, height))
    except pygame.error as error:
        raise Error(f'no window can be opened ({error}); render_mode="rgb_array" needs none') from error
    pygame.display.set_caption("lag_envs")
    return screen


_desk = _Desk()


# --- the read-out -----------------------------------------------------------------------------------------


@cache
def _font(size: int) -> pygame.font.Font:
    pygame = _pygame()
    pygame.font.init()
    return pygame.font.Font(None, size)


def _text(text: str, size: int, colour: str) -> pygame.Surface:
    try:
        return _font(size).render(text, True, colour)
    except _pygame().error:
        # Another part of the program has called pygame.quit(), which makes fonts invalid.
        _font.cache_clear()
        return _font(size).render(text, True, colour)


def write_readout(image: NDArray[np.uint8], rows: Sequence[Sequence[Reading]], scale: float) -> None:
    """Write rows of readings below a picture, in columns that do not shift with the length of the numbers.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width, 3)
        The picture.
    rows : sequence of sequence of Reading
        Two rows.
    scale : float
        Pixels per metre, of which a part is drawn.
    """
    pygame, (height, width) = _pygame(), image.shape[:2]
    surface = pygame.image.frombuffer(image, (width, height), "RGB")
    surface.fill(STRIP_PAPER, (0, height - STRIP, width, STRIP))
    bar = min(100, width // 3)
    for number, row in enumerate(rows):
        x, y, end = 10, height - STRIP + 7 + 20 * number, width - number * (bar + 24)
        for reading in row:
            colour = STYLES[reading.role].edge if reading.role != "frame" else INK
            value, unit = _text(_number(reading.value), 17, colour), _text(reading.unit, 17, colour)
            # The column's width depends only on what stays the same.
            right = x + max(_name_width(reading.name) + 54, 62)
            if right + 4 + unit.get_width() > end:
                break
            _write_name(surface, reading.name, x, y, colour)
            surface.blit(value, (right - value.get_width(), y))
            surface.blit(unit, (right + 4, y))
            x = max(right + 4 + unit.get_width() + 14, x + COLUMN)
    _draw_scale(surface, scale, bar)


def _name_parts(name: str) -> tuple[str, int, bool]:
    """Return a name's letter or word, how many dots are above it, and whether a star follows."""
    base = name.removesuffix("*").rstrip("'").replace("_ddot", "").replace("_dot", "")
    dots = name.count("'") + name.count("_dot") + 2 * name.count("_ddot")
    try:
        base = unicodedata.lookup(f"GREEK SMALL LETTER {base}")
    except KeyError:
        pass
    return base, dots, name.endswith("*")


def _name_width(name: str) -> int:
    base, _, star = _name_parts(name)
    return _font(17).size(base + "*" * star)[0]


def _write_name(surface: pygame.Surface, name: str, x: int, y: int, colour: str) -> None:
    base, dots, star = _name_parts(name)
    letter = _text(base, 17, colour)
    surface.blit(letter, (x, y))
    for i in range(dots):
        place = x + 0.5 * letter.get_width() + 4 * (i - 0.5 * (dots - 1))
        _pygame().draw.rect(surface, colour, (round(place) - 1, y - 2, 2, 2))
    if star:
        surface.blit(_text("*", 17, colour), (x + letter.get_width(), y))


def _number(value: float) -> str:
    digits = 3 if abs(value) < 10.0 else 2 if abs(value) < 100.0 else 1
    return (f"{value:.{digits}f}" if abs(value) < 1e4 else f"{value:.2e}").replace("-", "−")


def _draw_scale(surface: pygame.Surface, scale: float, longest: int) -> None:
    """Draw a scale bar with its length."""
    length = s.round_length(longest / scale)
    label = _text(f"{length:g} m", 16, INK)
    right, y = surface.get_width() - 12, surface.get_height() - 8
    left = right - round(length * scale)
    draw = _pygame().draw
    draw.line(surface, INK, (left, y), (right, y))
    for x in (left, right):
        draw.line(surface, INK, (x, y - 3), (x, y + 3))
    surface.blit(label, ((left + right - label.get_width()) // 2, y - 14))
