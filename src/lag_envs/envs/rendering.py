"""Pictures: what a scene and its task say is to be seen, painted with pygame.

``python -m lag_envs.envs.rendering DIRECTORY`` writes a picture of every environment as PNG.
"""

from __future__ import annotations

import math
import os
import sys
import unicodedata
import weakref
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium.error import DependencyNotInstalled, Error
from numpy.typing import NDArray

from lag_envs.scenes import shapes as s
from lag_envs.scenes.picture import Picture, turning
from lag_envs.scenes.shapes import Frame, Point, Reading, Role, Shape, Window
from lag_envs.tasks.base import Task

if TYPE_CHECKING:
    import pygame

#: Width and height of a picture, and height of the strip below it that holds the read-out [pixels].
WIDTH, HEIGHT, STRIP = 640, 432, 48
#: Pictures are painted this much larger, then scaled down, for smooth edges.
FINE = 2
FAR = 8_000.0

PAPER, STRIP_PAPER, INK = "#ffffff", "#f2f2f2", "#303030"


class Style(NamedTuple):
    """How a role looks: colours, width of lines and length of dashes [pixels]."""

    fill: str | None
    edge: str
    width: float
    dash: float = 0.0


#: The colours that carry meaning are Okabe and Ito's, which colour-blind people can tell apart.
STYLES: dict[Role, Style] = {
    "body": Style("#56b4e9", "#0072b2", 2.0),
    "mark": Style("#0072b2", "#0072b2", 0.0),
    "hole": Style(PAPER, "#606060", 1.5),
    "ground": Style("#e3e3e3", "#8a8a8a", 1.5),
    "frame": Style("#b4b4b4", "#606060", 2.0),
    "guide": Style(None, "#9a9a9a", 1.2, 5.0),
    "target": Style(None, "#009e73", 2.2, 7.0),
    "limit": Style("#cc79a7", "#b0558a", 3.0),
    "action": Style("#d55e00", "#d55e00", 5.0),
}


@cache
def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled('rendering needs pygame: pip install "lag-envs[render]"') from error
    return pygame


class Viewer:
    """Paints one environment.

    Parameters
    ----------
    task : Task
        Says, with its scene, what is to be seen.
    mode : {"human", "rgb_array"}
        Whether `draw` shows the picture in a window, at the pace of the control interval, or returns it.

    Notes
    -----
    A process has one window; several viewers share it side by side. When its user closes it, the
    environments go on unseen until they are closed and rendered again.

    Raises
    ------
    DependencyNotInstalled
        Where pygame is missing.
    Error
        From `draw`, where there is no display for the window.
    """

    def __init__(self, task: Task, mode: str) -> None:
        pygame = _pygame()
        self._task = task
        self._picture = Picture(task)
        self._turned: Any = 0.0
        self._before: tuple[list[float], NDArray[np.float64]] | None = None
        self._clock = pygame.time.Clock()
        self._rate = max(1, round(1.0 / task.dt))
        self._human = mode == "human"
        if self._human:
            _desk.add(self)

    def draw(
        self, state: NDArray[np.float64], control: float, target: float | None
    ) -> NDArray[np.uint8] | None:
        """Paint a state.

        Parameters
        ----------
        state : ndarray, shape (n_state,)
            State in SI units, in the scene's order.
        control : float
            Control applied last, in SI units.
        target : float or None
            The episode's target.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3), or None
            The picture; None where it is shown in a window.
        """
        if self._human and self not in _desk:
            return None
        values = state.tolist()
        self._turn(values)
        now = Frame(values, control, self._task.share(control), target, self._turned)
        picture = paint(self._task, now, self._picture)
        if self._human:
            _desk.show(self, picture)
            self._clock.tick(self._rate)
            return None
        pixels = np.frombuffer(_pygame().image.tobytes(picture, "RGB"), dtype=np.uint8)
        return pixels.reshape(HEIGHT, WIDTH, 3).copy()

    def close(self) -> None:
        """Take the picture off the window; the last one closes it."""
        _desk.remove(self)

    def _turn(self, state: list[float]) -> None:
        """Integrate what turns but is not in the state; exact if its rate is linear and each step drawn."""
        rate = np.array(turning(self._task.scene, state))
        if self._before is not None and self._before[0] != state:
            self._turned += 0.5 * self._task.dt * (self._before[1] + rate)
        self._before = (state, rate)


def paint(task: Task, now: Frame, shown: Picture | None = None) -> pygame.Surface:
    """Return a picture with its read-out; `shown` is the task's `Picture`, where it was made before."""
    pygame, shown = _pygame(), shown or Picture(task)
    poses = shown.poses(now)
    view = shown.window(poses)
    scene = pygame.Surface((FINE * WIDTH, FINE * (HEIGHT - STRIP)), depth=32)
    scene.fill(PAPER)
    pen = Pen(scene, view)
    pen.paint([part for frame, shape in shown.shapes for part in s.placed(shape, poses[frame], view)])
    picture = pygame.Surface((WIDTH, HEIGHT), depth=32)
    size = (WIDTH, HEIGHT - STRIP)
    pygame.transform.smoothscale(scene, size, picture.subsurface((0, 0), size))
    picture.fill(STRIP_PAPER, (0, HEIGHT - STRIP, WIDTH, STRIP))
    names = zip(task.scene.state_names, now.state, task.scene.state_units, strict=True)
    _write_row(picture, 0, [Reading(*entry) for entry in names])
    _write_row(picture, 1, [*task.control_readings(now), *task.readings(now)])
    _draw_scale(picture, pen.scale / FINE)
    return picture


class Pen:
    """Paints shapes on a surface, of which a window in metres fills as much as it can."""

    def __init__(self, surface: pygame.Surface, window: Window) -> None:
        self._surface = surface
        self._size = width, height = surface.get_size()
        self.scale = 1.0 / max((window.right - window.left) / width, (window.top - window.bottom) / height)
        self._left = 0.5 * (width - self.scale * (window.left + window.right))
        self._top = 0.5 * (height + self.scale * (window.bottom + window.top))

    def paint(self, shapes: Sequence[Shape]) -> None:
        """Paint shapes, later ones over earlier ones."""
        for shape in shapes:
            match shape:
                case s.Line(points, role):
                    self._line(self._place(points), STYLES[role])
                case s.Polygon(points, role):
                    self._area(self._place(points), STYLES[role])
                case s.Circle(centre, radius, role):
                    self._disc(centre, radius, STYLES[role])
                case s.Arrow(points, role):
                    self._arrow(self._place(points), STYLES[role])
                case s.Magnifier():
                    self._magnify(shape, [x for x in shapes if not isinstance(x, s.Magnifier)])

    def _place(self, points: Sequence[Point]) -> list[Point]:
        return _near([(self._left + self.scale * x, self._top - self.scale * y) for x, y in points])

    def _area(self, points: list[Point], style: Style) -> None:
        half = 0.5 * FINE * style.width
        if style.fill is None:
            self._line([*points, points[0]], style)
        elif half == 0.0:
            self._fill(points, style.fill)
        else:
            turn = sum(a[0] * b[1] - a[1] * b[0] for a, b in pairwise([*points, points[0]]))
            outward, ways = math.copysign(half, turn), _aside(points, closed=True)
            self._fill(_moved(points, ways, outward), style.edge)
            self._fill(_moved(points, ways, -outward), style.fill)

    def _disc(self, centre: Point, radius: float, style: Style) -> None:
        (middle,), size, half = self._place([centre]), self.scale * radius, 0.5 * FINE * style.width
        if style.fill is None:
            self._line(_rim(middle, size), style)
        else:
            self._fill(_rim(middle, size + half), style.edge)
            self._fill(_rim(middle, size - half), style.fill)

    def _line(self, points: list[Point], style: Style) -> None:
        for part in _dashes(points, FINE * style.dash) if style.dash else [points]:
            self._stroke(part, style.edge, FINE * style.width)

    def _arrow(self, points: list[Point], style: Style) -> None:
        """Paint an arrow as long as its points say; a short one is thinner."""
        length, width = sum(math.dist(a, b) for a, b in pairwise(points)), FINE * style.width
        if length < 1.0:
            return
        width *= min(1.0, length / (4.0 * width))
        head, shaft = 3.0 * width, [points[0]]
        room = length - head
        for a, b in pairwise(points):
            step = math.dist(a, b)
            if step >= room:
                shaft.append(_between(a, b, room / step))
                break
            shaft.append(b)
            room -= step
        tip, (x, y) = points[-1], shaft[-1]
        aside = 0.5 * (tip[1] - y), 0.5 * (x - tip[0])
        self._stroke(shaft, style.edge, width)
        self._fill([tip, (x + aside[0], y + aside[1]), (x - aside[0], y - aside[1])], style.edge)

    def _stroke(self, points: list[Point], colour: str, width: float) -> None:
        # Most dashes of a guide are beside a lens.
        if self._beside(points, 4.0 * width):
            return
        ways = _aside(points)
        there, back = _moved(points, ways, 0.5 * width), _moved(points, ways, -0.5 * width)
        self._fill([*there, *reversed(back)], colour)

    def _beside(self, points: list[Point], pad: float) -> bool:
        """Tell whether nothing of an outline can be on the surface."""
        width, height = self._size
        x, y = [p[0] for p in points], [p[1] for p in points]
        return max(x) < -pad or min(x) > width + pad or max(y) < -pad or min(y) > height + pad

    def _fill(self, points: list[Point], colour: str) -> None:
        if self._beside(points, 2.0):
            return
        draw, points = _pygame().draw, _near(points)
        draw.polygon(self._surface, colour, points)
        draw.aalines(self._surface, colour, True, points)

    def _magnify(self, lens: s.Magnifier, shapes: Sequence[Shape]) -> None:
        """Show a part of the picture in its upper right corner."""
        pygame = _pygame()
        size = FINE * 150
        x, y = lens.centre
        glass = pygame.Surface((size, size), pygame.SRCALPHA)
        glass.fill(PAPER)
        pen = Pen(glass, Window(x - lens.radius, y - lens.radius, x + lens.radius, y + lens.radius))
        pen.paint(shapes)
        mask = pygame.Surface((size, size), pygame.SRCALPHA)
        pygame.draw.circle(mask, "white", (size / 2, size / 2), size / 2 - FINE)
        glass.blit(mask, (0, 0), special_flags=pygame.BLEND_RGBA_MIN)
        corner = (self._surface.get_width() - size - FINE * 12, FINE * 12)
        middle = (corner[0] + size / 2, corner[1] + size / 2)
        (small,) = self._place([lens.centre])
        style = STYLES["guide"]._replace(dash=0.0)
        radius = lens.radius * self.scale
        # The common outer tangents of the two circles.
        gap, turn = math.dist(small, middle), math.atan2(middle[1] - small[1], middle[0] - small[0])
        if gap > size / 2 + radius:
            spread = math.acos((radius - size / 2) / gap)
            for angle in (turn + spread, turn - spread):
                self._line([s.polar(small, radius, angle), s.polar(middle, size / 2 - FINE, angle)], style)
        self._line(_rim(small, radius), style)
        self._surface.blit(glass, corner)
        self._line(_rim(middle, size / 2 - FINE), style)


class _Desk:
    """The window of the process, which the viewers share."""

    def __init__(self) -> None:
        # Weak, so that an environment that was dropped without being closed leaves no place behind.
        self._viewers: weakref.WeakKeyDictionary[Viewer, None] = weakref.WeakKeyDictionary()
        self._screen: pygame.Surface | None = None
        self._places = 0

    def __contains__(self, viewer: Viewer) -> bool:
        return viewer in self._viewers

    def add(self, viewer: Viewer) -> None:
        """Make room for a viewer."""
        self._viewers[viewer] = None

    def remove(self, viewer: Viewer) -> None:
        """Take a viewer's picture away; the last one closes the window."""
        if viewer in self._viewers:
            del self._viewers[viewer]
            if not self._viewers:
                self._close()

    def show(self, viewer: Viewer, picture: pygame.Surface) -> None:
        """Show a viewer's picture, and close the window if its user asks for it."""
        pygame, places = _pygame(), list(self._viewers)
        columns = math.ceil(math.sqrt(len(places)))
        # There is no surface either where another part of the program has closed all windows.
        if self._screen is None or self._places != len(places) or pygame.display.get_surface() is None:
            rows = math.ceil(len(places) / columns)
            self._screen, self._places = _open_window(columns * WIDTH, rows * HEIGHT), len(places)
        row, column = divmod(places.index(viewer), columns)
        self._screen.blit(picture, (column * WIDTH, row * HEIGHT))
        pygame.display.flip()
        pygame.event.pump()
        # Only this event is taken, so that a program can read keys.
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


# --- geometry, in pixels ----------------------------------------------------------------------------------


def _near(points: list[Point]) -> list[Point]:
    """Move points that are far outside nearer: pygame goes through all rows and columns of what it draws."""
    if all(-FAR < x < FAR and -FAR < y < FAR for x, y in points):
        return points
    return [(min(max(x, -FAR), FAR), min(max(y, -FAR), FAR)) for x, y in points]


def _rim(centre: Point, radius: float) -> list[Point]:
    """Return points of a circle, as many as its size asks for; the last is the first."""
    return s.arc(
        centre, radius, 0.0, 2.0 * math.pi, min(max(12, math.ceil(4.0 * math.sqrt(max(radius, 0.0)))), 200)
    )


def _between(a: Point, b: Point, share: float) -> Point:
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])


def _aside(points: list[Point], closed: bool = False) -> list[Point]:
    """Return for each point of a line the way to another line that runs beside it at a distance of 1."""
    first, last = (points[-1], points[0]) if closed else (points[0], points[-1])
    ways = []
    for (ax, ay), (bx, by) in pairwise(_normal(a, b) for a, b in pairwise([first, *points, last])):
        # Where two pieces meet, the sum of their normals points to the corner; at an end one of them is zero.
        stretch = 1.0 / max(1.0 + ax * bx + ay * by, 0.3)
        ways.append((stretch * (ax + bx), stretch * (ay + by)))
    return ways


def _moved(points: list[Point], ways: list[Point], distance: float) -> list[Point]:
    return [(x + distance * a, y + distance * b) for (x, y), (a, b) in zip(points, ways, strict=True)]


def _normal(a: Point, b: Point) -> Point:
    length = math.dist(a, b)
    return ((b[1] - a[1]) / length, (a[0] - b[0]) / length) if length else (0.0, 0.0)


def _dashes(points: list[Point], length: float) -> Iterator[list[Point]]:
    """Cut a line into dashes with gaps of two thirds of their length."""
    dash, room, on = [points[0]], length, True
    for a, b in pairwise(points):
        step, done = math.dist(a, b), 0.0
        while step - done > room:
            done += room
            cut = _between(a, b, done / step)
            if on:
                yield [*dash, cut]
            dash, on = [cut], not on
            room = length if on else length * 2.0 / 3.0
        room -= step - done
        dash.append(b)
    if on:
        yield dash


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
        # Another program part has called pygame.quit(), after which fonts are void.
        _font.cache_clear()
        return _font(size).render(text, True, colour)


def _write_row(picture: pygame.Surface, row: int, readings: Sequence[Reading]) -> None:
    """Write readings in columns that do not move with the length of the numbers."""
    y = HEIGHT - STRIP + 6 + 20 * row
    for column, reading in enumerate(readings):
        x = 14 + 128 * column
        colour = STYLES[reading.role].edge if reading.role != "frame" else INK
        _write_name(picture, reading.name, x, y, colour)
        number = _text(_number(reading.value), 20, colour)
        picture.blit(number, (x + 70 - number.get_width(), y))
        picture.blit(_text(reading.unit, 20, colour), (x + 74, y))


def _write_name(picture: pygame.Surface, name: str, x: int, y: int, colour: str) -> None:
    base = name.removesuffix("*").rstrip("'").replace("_dot", "").replace("_ddot", "")
    dots = name.count("'") + name.count("_dot") + 2 * name.count("_ddot")
    try:
        base = unicodedata.lookup(f"GREEK SMALL LETTER {base}")
    except KeyError:
        pass
    letter = _text(base, 20, colour)
    picture.blit(letter, (x, y))
    for i in range(dots):
        place = x + 0.5 * letter.get_width() + 4 * (i - 0.5 * (dots - 1))
        _pygame().draw.rect(picture, colour, (round(place) - 1, y - 2, 2, 2))
    if name.endswith("*"):
        picture.blit(_text("*", 20, colour), (x + letter.get_width(), y))


def _number(value: float) -> str:
    return (f"{value:.3f}" if abs(value) < 1e4 else f"{value:.2e}").replace("-", "−")


def _draw_scale(picture: pygame.Surface, scale: float) -> None:
    """Draw a length and say how long it is."""
    length = s.round_length(100.0 / scale)
    label = _text(f"{length:g} m", 18, INK)
    right, y = WIDTH - 14, HEIGHT - 9
    left = right - round(length * scale)
    draw = _pygame().draw
    draw.line(picture, INK, (left, y), (right, y))
    for x in (left, right):
        draw.line(picture, INK, (x, y - 3), (x, y + 3))
    picture.blit(label, ((left + right - label.get_width()) // 2, y - 15))


# --- pictures of all environments -------------------------------------------------------------------------


def write_pictures(directory: str | Path, seconds: float = 0.4, seed: int = 9) -> list[Path]:
    """Write a picture of every environment as PNG.

    Parameters
    ----------
    directory : str or Path
        Where to; made if it does not exist.
    seconds : float, default 0.4
        How long the control swings to and fro before [s]; an episode that ends earlier is shown as it ended.
    seed : int, default 9
        Seed of the start.

    Returns
    -------
    list of Path
        The files, one for each id.
    """
    import gymnasium as gym

    from lag_envs.tasks import TASKS

    pygame, files = _pygame(), []
    Path(directory).mkdir(parents=True, exist_ok=True)
    for env_id in TASKS:
        env = gym.make(env_id, render_mode="rgb_array")
        env.reset(seed=seed)
        task: Task = env.unwrapped.task  # type: ignore[attr-defined]
        for i in range(round(seconds / task.dt)):
            swing = np.float32(0.8 * math.cos(7.0 * i * task.dt))
            action = (
                task.rest_action if task.formulas.choices else np.full(env.action_space.shape or (), swing)
            )
            if any(env.step(action)[2:4]):
                break
        picture: Any = env.render()
        files.append(Path(directory) / f"{env_id}.png")
        pygame.image.save(pygame.image.frombytes(picture.tobytes(), (WIDTH, HEIGHT), "RGB"), files[-1])
    return files


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m lag_envs.envs.rendering DIRECTORY")
    for file in write_pictures(sys.argv[1]):
        print(file)
