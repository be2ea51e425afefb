"""The picture of a scene or of a task: shapes in frames, and the poses of the frames at a moment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.mechanics.algebra import Expr, FormulaError
from lag_envs.mechanics.evaluation import Numeric
from lag_envs.mechanics.recording import Values, formula
from lag_envs.scenes.checks import real_array
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.shapes import Frame, Polygon, Pose, Role, Shape, Window, extent, placed

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

#: The frame that never moves.
GROUND = "ground"
INSTEAD_OF_SHAPES = (
    "a picture is drawn from shapes in frames and from the frames' places; return the shapes by frame from "
    "bodies(self), the places of bodies from poses(self, q, xp), and the places of arrows, targets and the "
    "like from indicators(self, now, xp)"
)


class Now(NamedTuple):
    """The values that indicators can show, all by name.

    Attributes
    ----------
    q : Values
        Places of all coordinates, including those that the state leaves out.
    state : Values
        The state.
    share : Values
        The controls as shares of their largest sizes.
    target : Values
        The targets.
    """

    q: Values
    state: Values
    share: Values
    target: Values


class Seen(Numeric):
    """The namespace ``xp`` of `indicators`: the functions that a task's formulas have."""

    where, abs, minimum, maximum = np.where, np.abs, np.minimum, np.maximum


class Picture:
    """The picture that a painter paints.

    Parameters
    ----------
    of : Scene or Task
        The scene or task; a task's picture is its scene's plus its own shapes.

    Attributes
    ----------
    frames : list of str
        The frames, in the order of `poses`.
    shapes : list of (int, Shape)
        Each shape and the number of its frame, from back to front.
    view : Window
        The view that `window` moves.

    Raises
    ------
    FormulaError
        If shapes lie in a frame without a pose.
    """

    def __init__(self, of: Any) -> None:
        self._of, self._scene = of, getattr(of, "scene", of)
        bodies, window = of.bodies(), of.window()
        if not isinstance(window, Window):
            wanted = "Window(left, bottom, right, top)"
            raise FormulaError(f"{type(of).__name__}.window must return {wanted}, got {window!r:.60}")
        found = self._poses(Frame([0.0] * len(self._scene.state_names)))
        self.frames = list(found)
        for frame in [*bodies, *filter(None, [window.frame])]:
            if frame not in found:
                raise no_place(of, "bodies" if frame in bodies else "window", frame, self.frames)
            check_shapes(of, frame, bodies.get(frame, []))
        self.shapes = [(self.frames.index(frame), shape) for frame in bodies for shape in bodies[frame]]
        self.view = window

    def poses(self, now: Frame) -> list[Pose]:
        """Return the poses of all frames."""
        return [Pose(*map(float, pose)) for pose in self._poses(now).values()]

    def episode(self, states: ArrayLike, controls: ArrayLike, target: Any, dt: float) -> NDArray[np.float64]:
        """Return the poses of an episode, shape (n, frames, 4).

        Parameters
        ----------
        states : array_like, shape (n, n_state)
            Its states.
        controls : array_like, shape (n - 1, n_controls)
            The controls between them.
        target : float, sequence of float or None
            Its targets.
        dt : float
            The time between two states [s].
        """
        array = np.asarray(states, np.float64)
        n, columns = len(array), list(array.T)
        held = np.zeros((n, len(self._scene.control_names)))
        held[1:] = np.reshape(controls, held[1:].shape)
        # This is exact if the rates are linear between two states, as for a coordinate with held
        # acceleration.
        turned = []
        for rate in left_out_rates(self._scene, columns):
            rates = np.broadcast_to(rate, n)
            turned.append(np.concatenate([[0.0], np.cumsum(0.5 * dt * (rates[1:] + rates[:-1]))]))
        now = Frame(columns, list(held.T), self._of.share(list(held.T)), target, turned)
        found = self._poses(now).values()
        return np.stack([np.stack([np.broadcast_to(x, n) for x in pose], -1) for pose in found], 1)

    def window(self, poses: Sequence[Pose]) -> Window:
        """Return the part of the plane to look at."""
        if not self.view.frame:
            return self.view
        frame = poses[self.frames.index(self.view.frame)]
        return self.view.moved(frame[0], frame[1])

    def placed(self, now: Frame) -> list[Shape]:
        """Return the shapes that are visible at a moment, from back to front."""
        poses = self.poses(now)
        view = self.window(poses)
        return [part for frame, shape in self.shapes for part in placed(shape, poses[frame], view)]

    def _poses(self, now: Frame) -> dict[str, Pose]:
        return poses_of(self._of, now)


def poses_of(of: Any, now: Frame, xp: Any = None) -> dict[str, Pose]:
    """Return the poses of all frames of a scene or a task.

    Parameters
    ----------
    of : Scene or Task
        The scene or task.
    now : Frame
        The moment, or many of them.
    xp : namespace, optional
        Functions for numbers other than floats and arrays.
    """
    scene = getattr(of, "scene", of)
    targets = [t.name for t in of.formulas.target_boxes] if of is not scene else []
    q = places(scene, now)
    found = {GROUND: (0.0, 0.0)} | dict(scene.poses(Values("coordinate", q), xp or Numeric))
    seen = Now(
        Values("coordinate", q),
        Values("entry of the state", dict(zip(scene.state_names, now.state, strict=True))),
        Values("control", _filled(scene.control_names, now.share)),
        Values("target", _filled(targets, 0.0 if now.target is None else now.target)),
    )
    found |= indicated(of, seen, xp or Seen)
    return {frame: Pose(*pose) for frame, pose in found.items()}


def no_place(of: Any, where: str, frame: str, known: Sequence[str]) -> FormulaError:
    """Return the error for a frame without a pose."""
    return FormulaError(
        f"{type(of).__name__}.{where} has {frame!r}, which has no place in poses or indicators "
        f"({', '.join(known)})"
    )


def check_shapes(of: Any, frame: str, shapes: Any) -> None:
    """Raise a FormulaError if something is not a list of shapes."""
    for shape in shapes if isinstance(shapes, Sequence) else [shapes]:
        if not isinstance(shape, Shape) or shape is shapes:
            kinds = ", ".join(kind.__name__ for kind in get_args(Shape))
            raise FormulaError(
                f"{type(of).__name__}.bodies must have a list of shapes ({kinds}) for {frame!r}, "
                f"got {shapes!r:.60}"
            )
        if fault := _fault(shape):
            raise FormulaError(f"{type(of).__name__}.bodies: {fault}, got {shape!r:.80}")


def _fault(shape: Any) -> str:
    """Return what is wrong with a shape, if anything."""
    roles = get_args(Role)
    if getattr(shape, "role", roles[0]) not in roles:
        return f"a role must be one of {', '.join(roles)}"
    try:
        sizes = real_array("", [getattr(shape, name, 1.0) for name in ("radius", "step", "size")])
        points = real_array("", getattr(shape, "points", [getattr(shape, "centre", (0.0, 0.0))]))
    except ValueError:  # no numbers, or pairs beside triples
        return "sizes must be numbers, and points pairs (x, y)"
    if points.shape[1:] != (2,) or len(points) < (3 if isinstance(shape, Polygon) else 1) or sizes.ndim > 1:
        return "points must be pairs (x, y), three or more for a polygon"
    if not (np.isfinite(points).all() and np.isfinite(sizes).all()):
        return "numbers must be finite"
    return "" if (sizes >= 0.0).all() else "sizes must not be negative"


def indicated(of: Any, now: Now, xp: Any = Seen) -> dict[str, tuple]:
    """Return the poses of a scene's or a task's indicators, or raise a FormulaError."""
    with formula(of, "indicators"):
        found = of.indicators(now, xp)
        if not isinstance(found, Mapping):
            raise FormulaError(f"it must return places by frame, got {found!r:.60}")
        for frame, pose in found.items():
            if not isinstance(pose, Sequence) or not 2 <= len(pose) <= 4:
                raise FormulaError(
                    f"{frame!r} must be at (x, y), (x, y, angle) or (x, y, angle, part), got {pose!r:.60}"
                )
            if any(isinstance(number, Values) for number in pose):
                raise FormulaError(f"{frame!r}: take numbers by their names, as in now.target.NAME")
    return dict(found)


def at_rest(scene: Scene) -> Now:
    """Return a moment at which all numbers are zero."""
    zero = Frame([0.0] * len(scene.state_names))
    return Now(
        Values("coordinate", places(scene, zero)),
        Values("entry of the state", dict.fromkeys(scene.state_names, 0.0)),
        Values("control", dict.fromkeys(scene.control_names, 0.0)),
        Values("target", {}),
    )


def left_out_rates(scene: Scene, state: Sequence[Any]) -> tuple[Any, ...]:
    """Return the rates of the places that the state leaves out, in order; unknown ones are 0."""
    layout = layout_of(scene)
    rates = {entry.coordinate: state[i] for i, entry in enumerate(layout.state) if entry.kind == "velocity"}
    return tuple(rates.get(name, 0.0) for name in layout.left_out if name in layout.names)


def _filled(names: Sequence[str], given: Any) -> dict[str, Any]:
    """Return numbers by name, 0 for missing ones; many moments are given as a list of arrays."""
    values = list(given) if isinstance(given, list | tuple) or np.ndim(given) else [given]
    return dict.fromkeys(names, 0.0) | dict(zip(names, values, strict=False))


def places(scene: Scene, now: Frame) -> dict[str, Any]:
    """Return the places of all coordinates."""
    layout = layout_of(scene)
    controls = _filled(layout.controls, now.control)
    turned = _filled([name for name in layout.left_out if name in layout.names], now.turned)
    rests = scene.rests()
    q: dict[str, Any] = dict.fromkeys(layout.names, 0.0)
    for name, level, by in layout.prescribed:
        q[name] = {"rest": rests.get(name, 0.0), "place": controls.get(by, 0.0)}.get(level, 0.0)
    places = {entry.coordinate: now.state[i] for i, entry in enumerate(layout.state) if entry.kind == "place"}
    return q | turned | places


def window(scene: Scene, lengths: Mapping[str, float] = MappingProxyType({})) -> Window:
    """Return a window that follows the first body and contains the others' reach.

    Its width assumes that every length is at most as large as the bodies, or as large as given by name.
    """
    size, first = 1.15 * _reach(scene, tuple(lengths.items())), next(iter(scene.mechanics.record.poses), "")
    return Window(-size, -size, size, size, first)


@lru_cache(maxsize=256)
def _reach(scene: Scene, given: tuple[tuple[str, float], ...]) -> float:
    """Return the largest distance of any body's outline from the first body, over all angles [m].

    A coordinate that occurs in the poses only in sines and cosines counts as an angle, any other as a length.
    """
    names, record, longest = layout_of(scene).names, scene.mechanics.record.poses, dict(given)
    sizes = {body: extent(outline) for body, outline in scene.bodies().items() if body in record}
    lengths = {s.name for x, y, *_ in record.values() for s in _plain(x) | _plain(y)}
    generator, far = np.random.default_rng(5), 0.0
    scale = max(sizes.values(), default=1.0) or 1.0
    ends = {n: max(scale, longest.get(n, 0.0)) if n in lengths else math.pi for n in names}
    for _ in range(256):
        q = {n: generator.uniform(-end, end) for n, end in ends.items()}
        found = scene.poses(Values("coordinate", q), Numeric)
        x, y, *_ = next(iter(found.values()), (0.0, 0.0, 0.0))
        for body, pose in found.items():
            far = max(far, math.hypot(pose[0] - x, pose[1] - y) + sizes.get(body, 0.0))
    return far or 1.0


def _plain(expr: Expr) -> set[Any]:
    """Return the places that occur outside sines and cosines."""
    found = set()
    for atom in expr.atoms():
        if atom.kind == "place":
            found.add(atom)
        elif atom.argument is not None and atom.function not in ("sin", "cos"):
            found |= _plain(atom.argument)
    return found
