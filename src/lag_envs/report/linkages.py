"""The general engine's scenes in the form that other engines take: links, each hanging from another.

A moving support is a field in its own frame, and hinges measure angles from link to link, so each system
defines how its coordinates map to joints. `lag_envs.report.linkage_rivals` has the engines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes import Acrobot, CartPole, Chain, RotaryPendulum
from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import layout_of

Array = NDArray[np.float64]
#: Inertia about the own axis of a rod without one, since MuJoCo requires a positive value [kg m²].
THIN = 1e-15


class Link(NamedTuple):
    """A body and the joint that it hangs from; z is up."""

    kind: str  #: "slide" or "hinge"
    axis: tuple[float, float, float]
    place: tuple[float, float, float]  #: of the joint, from the previous one [m]
    mass: float
    centre: tuple[float, float, float]  #: of mass, from the joint [m]
    inertia: tuple[float, float, float]  #: about the centre, along the axes [kg m²]


@dataclass(frozen=True)
class System:
    """A scene, the ranges from which its states and controls are drawn, and its links."""

    name: str
    scene: Scene
    places: Sequence[float]  #: half widths, by free coordinate
    speeds: Sequence[float]
    push: float
    links: Sequence[Link]
    relative: bool = False  #: whether joints' angles are differences of the scene's angles
    field: bool = False  #: whether the control moves the support; otherwise it is the joint's force
    joint: int = 0  #: the joint that the control acts on

    def turned(self, values: Array) -> Array:
        """Return joint values for coordinate values, one row each."""
        if not self.relative:
            return values
        return np.concatenate([values[:1], np.diff(values, axis=0)])

    def back(self, values: Array) -> Array:
        """Return coordinate values for joint values."""
        return np.cumsum(values, axis=0) if self.relative else values

    def forces(self, controls: Array) -> Array:
        """Return the forces on the joints, one row for each control."""
        forces = np.zeros((len(controls), len(self.links)))
        if not self.field:
            forces[:, self.joint] = controls
        return forces

    def fields(self, controls: Array) -> Array:
        """Return the fields [m/s²], one row for each control."""
        gravity: float = self.scene.gravity  # type: ignore[attr-defined]
        along = controls if self.field else 0.0 * controls  # a support's acceleration acts against x
        return np.stack([along, 0.0 * controls, np.full(len(controls), -gravity)], axis=1)

    def draw(self, count: int, seed: int = 0) -> tuple[Array, Array]:
        """Return harsh random states and controls, one row each; prescribed coordinates start at 0.

        All joints turn at once, each with up to its full speed.
        """
        rng = np.random.default_rng(seed)
        states = np.zeros((count, len(self.scene.state_names)))
        controls = np.zeros((count, 1))
        free = layout_of(self.scene).free
        for j in range(count):
            for i, entry in enumerate(layout_of(self.scene).state):
                if entry.coordinate in free:
                    widths = self.places if entry.kind == "place" else self.speeds
                    states[j, i] = rng.uniform(-1, 1) * widths[free.index(entry.coordinate)]
            controls[j] = rng.uniform(-self.push, self.push)
        return states, controls


def _bars(
    lengths: Sequence[float], masses: Sequence[float], centres: Sequence[float], own: Sequence[float]
) -> list:
    """Return bars that hang one from the other and turn counter-clockwise in the plane.

    Here x points to the left, so that the hinges' axis is a coordinate axis, which is faster in Pinocchio.
    """
    places = [0.0, *lengths[:-1]]
    return [
        Link("hinge", (0.0, 1.0, 0.0), (0.0, 0.0, -place), m, (0.0, 0.0, -c), (i, i, i))
        for place, m, c, i in zip(places, masses, centres, own, strict=True)
    ]  # fmt: skip


def _cart_pole() -> System:
    s = CartPole()
    own = s.pole_mass * s.half_length**2 / 3
    cart = Link("slide", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), s.cart_mass, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    pole = Link(
        "hinge", (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), s.pole_mass, (0.0, 0.0, s.half_length), (own, own, own)
    )
    return System("cart-pole", s, (2.0, np.pi), (3.0, 12.0), 10.0, [cart, pole])


def _acrobot() -> System:
    s = Acrobot()
    links = _bars(
        (s.length_1, s.length_2), (s.mass_1, s.mass_2), (s.com_distance_1, s.com_distance_2),
        (s.inertia_1, s.inertia_2),
    )  # fmt: skip
    return System("acrobot", s, (np.pi, np.pi), (6.0, 8.0), 2.0, links, joint=1)


def _rotary() -> System:
    s, zero = RotaryPendulum(), (0.0, 0.0, 0.0)
    arm = Link("hinge", (0.0, 0.0, 1.0), zero, 1.0, zero, (1.0, 1.0, s.arm_inertia))
    rod = Link(
        "hinge", (1.0, 0.0, 0.0), (s.arm_length, 0.0, 0.0), s.mass, (0.0, 0.0, -s.com_distance),
        (s.inertia, s.inertia, THIN),
    )  # fmt: skip
    return System("rotary pendulum", s, (np.pi, np.pi), (10.0, 10.0), 0.1, [arm, rod])


def _chain(bars: int, name: str, speed: float) -> System:
    s = Chain(bars=bars)
    links = _bars(*([x] * bars for x in (s.length, s.mass, s.com_distance, s.inertia)))
    return System(name, s, (np.pi,) * bars, (speed,) * bars, 15.0, links, relative=True, field=True)


SYSTEMS = {
    system.name: system
    for system in (
        _cart_pole(),
        _acrobot(),
        _rotary(),
        _chain(2, "double pendulum, driven", 10.0),
        _chain(3, "triple pendulum, driven", 8.0),
    )
}
