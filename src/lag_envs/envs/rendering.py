"""Pictures of scenes and their tasks: what a viewer shows, and grids of pictures."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.envs.forces import Forces
from lag_envs.envs.painting import FORCE, STYLES, TRAIL, Pen, StyledShape
from lag_envs.envs.readout import Readout
from lag_envs.envs.screen import desk, load_pygame
from lag_envs.scenes import shapes as s
from lag_envs.scenes.picture import Picture, left_out_rates
from lag_envs.scenes.shapes import Frame, Point, Pose, Reading, in_plane
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import measured_entry

#: Width and height of a picture [pixels].
WIDTH, HEIGHT = 600, 400
#: A window shows at most this many pictures per second.
RATE = 60.0


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
        Whether time, return, controls, score and state are written below.
    """

    arrows: bool = False
    trail: float = 0.0
    readout: bool = False


class Viewer:
    """Paints one environment.

    Parameters
    ----------
    task : Task
        The task; together with its scene it decides what is shown.
    mode : {"human", "rgb_array"}
        Whether `draw` shows the picture in a window, in real time, or returns it.
    look : Look, optional
        What else is shown.
    size : (int, int)
        Width and height of the picture [pixels].

    Notes
    -----
    A process has one window; several viewers share it side by side. If the user closes the window, the
    environments continue without a picture until they are closed and rendered again.

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
            load_pygame()
        if self._human:
            desk.add(self)

    def use(self, task: Task) -> None:
        """Show another task from now on, of the same class with other parameters."""
        self._task, self._picture = task, Picture(task)
        self._pen: Pen | None = None
        self._readout: Readout | None = None
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
        over: bool = False,
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
            A number that identifies the episode.
        over : bool
            Whether the episode is over.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3), or None
            The picture; None if it is shown in a window.
        """
        if self._human and self not in desk:
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
            self._trail.append([in_plane(poses[frame], tip) for frame, tip in self._tips.items()])
        if self._human and not again and not self._is_due():
            return None
        picture = self._paint(now, poses, steps * self._task.dt, total, over)
        if not self._human:
            return picture
        desk.show(self, picture)
        if not again:
            self._wait()
        return None

    def close(self) -> None:
        """Remove the picture from the window; the last viewer closes it."""
        desk.remove(self)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture [pixels]."""
        return self._size

    def _paint(
        self, now: Frame, poses: list[Pose], seconds: float, total: float, over: bool
    ) -> NDArray[np.uint8]:
        width, height = self._size
        image = np.full((height, width, 3), 255, np.uint8)
        more = list(self._more(now))
        readings = self._readings(now, seconds, total, over) if self._look.readout else None
        if self._pen is None:
            self._readout = None if readings is None else Readout(readings, self._size)
            self._pen = Pen(self._picture, self._size, self._readout.height if self._readout else 0)
        self._pen.paint(image, poses, self._picture.window(poses), more)
        if self._readout and readings:
            self._readout.write(image, readings, self._pen.scale)
        return image

    def _more(self, now: Frame) -> Iterator[StyledShape]:
        """Yield trail and arrows."""
        pieces = min(12, len(self._trail) - 1)
        for tip in range(len(self._tips)):
            way = [points[tip] for points in self._trail]
            for i in range(pieces):
                part = way[i * (len(way) - 1) // pieces : (i + 1) * (len(way) - 1) // pieces + 1]
                yield StyledShape(s.Line(part), TRAIL, (i + 1.0) / pieces)
        if self._forces is not None:
            for arrow, is_control in self._forces.arrows(now):
                yield StyledShape(arrow, STYLES["action"] if is_control else FORCE, 1.0)

    def _readings(self, now: Frame, seconds: float, total: float, over: bool) -> list[list[Reading]]:
        """Return the groups of the read-out, the most important first.

        Before an episode's end, a random policy's return counts in proportion to the time that has passed, so
        that the score begins at 0.
        """
        task = self._task
        first = [Reading("time", seconds, "s"), Reading("return", total, ""), *task.control_readings(now)]
        if self._scale is not None:
            random, best = self._scale
            passed = 1.0 if over else seconds / task.duration
            first.append(Reading("score", (total - random * passed) / (best - random), ""))
        names = zip(task.scene.state_names, now.state, task.scene.state_units, strict=True)
        return [[*first, *task.readings(now)], [Reading(*entry) for entry in names]]

    def _turn(self, state: list[float]) -> None:
        """Integrate angles that the state leaves out; exact if rates are linear and every step is drawn."""
        rate = np.array(left_out_rates(self._task.scene, state))
        if self._before is not None and self._before[0] != state:
            self._turned += 0.5 * self._task.dt * (self._before[1] + rate)
        self._before = (state, rate)

    # --- real time ------------------------------------------------------------------------------------------

    def _is_due(self) -> bool:
        """Return whether to show this step; if steps are faster than the window, only some are shown."""
        now = time.perf_counter()
        self._due += self._task.dt
        if not now - 0.25 < self._due:
            self._due = now  # at the start, and after a delay; lost time is not made up for
        return self._due - self._shown > 1.0 / RATE - 1e-4

    def _wait(self) -> None:
        """Wait until one control interval after the previous step."""
        self._shown = self._due
        time.sleep(max(0.0, self._due - time.perf_counter()))


def _scale(task: Task) -> tuple[float, float] | None:
    """Return the returns that score 0 and 1, or None if the task's parameters are not the standard ones."""
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


def paint(task: Task, now: Frame, size: tuple[int, int] = (WIDTH, HEIGHT)) -> NDArray[np.uint8]:
    """Return a picture of a moment, in a given size."""
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
