"""The picture of a scene from its bodies and their poses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from lag_envs.mechanics.algebra import Expr
from lag_envs.mechanics.evaluation import Numeric
from lag_envs.mechanics.recording import Values
from lag_envs.scenes.shapes import Moment, Shape, Window, extent, placed

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

Pose = tuple[float, float, float]


def turning(scene: Scene, state: Sequence[float]) -> tuple[float, ...]:
    """Return the rates of the places that the state leaves out, in their order; unknown ones are 0."""
    layout = scene._layout
    rates = {entry.coordinate: state[i] for i, entry in enumerate(layout.state) if entry.kind == "velocity"}
    return tuple(float(rates.get(name, 0.0)) for name in layout.left_out if name in layout.names)


def poses(scene: Scene, now: Moment) -> dict[str, Pose]:
    """Return place [m] and angle [rad] of each body."""
    layout = scene._layout
    controls = dict(zip(layout.controls, np.ravel(now.control).tolist(), strict=False))
    unseen = (name for name in layout.left_out if name in layout.names)
    turned = dict(itertools.zip_longest(unseen, np.ravel(now.turned).tolist(), fillvalue=0.0))
    rests = scene.rests()
    q = dict.fromkeys(layout.names, 0.0)
    for name, level, by in layout.prescribed:
        q[name] = (
            rests.get(name, 0.0)
            if level == "rest"
            else controls.get(by or "", 0.0)
            if level == "place"
            else 0.0
        )
    q |= {name: turned[name] for name in turned if name in q}
    q |= {entry.coordinate: now.state[i] for i, entry in enumerate(layout.state) if entry.kind == "place"}
    return _poses(scene, q)


def _poses(scene: Scene, q: dict[str, float]) -> dict[str, Pose]:
    found = scene.poses(Values("coordinate", q), Numeric)
    return {body: (float(x), float(y), float(angle)) for body, (x, y, angle) in found.items()}


def shapes(scene: Scene, now: Moment) -> list[Shape]:
    """Return the shapes of all bodies where they are."""
    bodies = scene.bodies()
    return [shape for body, pose in poses(scene, now).items() for shape in placed(bodies.get(body, []), pose)]


def window(scene: Scene, now: Moment) -> Window:
    """Return a window that follows the first body and holds what the others reach."""
    found = poses(scene, now)
    x, y, _ = next(iter(found.values()), (0.0, 0.0, 0.0))
    size = 1.15 * _reach(scene)
    return Window(x - size, y - size, x + size, y + size)


@lru_cache(maxsize=256)
def _reach(scene: Scene) -> float:
    """Return the largest distance of any body's outline from the first body, over all angles [m].

    A coordinate that the poses have in sines and cosines only is taken for an angle, any other for a length,
    which is followed for as far as the bodies are large.
    """
    sizes = {body: extent(outline) for body, outline in scene.bodies().items()}
    names, record = scene._layout.names, scene.mechanics.record.poses
    lengths = {s.name for x, y, _ in record.values() for s in _plain(x) | _plain(y)}
    generator, far = np.random.default_rng(5), 0.0
    scale = max(sizes.values(), default=1.0) or 1.0
    for _ in range(256):
        q = {
            n: generator.uniform(-scale, scale) if n in lengths else generator.uniform(-math.pi, math.pi)
            for n in names
        }
        found = _poses(scene, q)
        x, y, _ = next(iter(found.values()), (0.0, 0.0, 0.0))
        for body, pose in found.items():
            far = max(far, math.hypot(pose[0] - x, pose[1] - y) + sizes.get(body, 0.0))
    return far or 1.0


def _plain(expr: Expr) -> set[Any]:
    """Return the places that stand outside sines and cosines."""
    found = set()
    for atom in expr.atoms():
        if atom.kind == "place":
            found.add(atom)
        elif atom.argument is not None and atom.function not in ("sin", "cos"):
            found |= _plain(atom.argument)
    return found
