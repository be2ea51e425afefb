"""Eight systems for the tests of the series: scenes, half of them the package's, and hand-written equations.

The equations give mass matrix and right-hand side in plain arithmetic and a few functions, so they run on
floats, on mpmath's numbers and on series of python-flint. They use nothing of the package.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from contract_scenes import RotatingFrame

from lag_envs.report.oracle import solve_positive
from lag_envs.scenes import Acrobot, CartPole, Chain, RotaryPendulum
from lag_envs.scenes.base import Scene, parameter


class System(NamedTuple):
    """A scene, and its equations to compare with.

    ``motion(q, v, u, s, a, xp)`` returns mass matrix and right-hand side; s and a are the place and the
    acceleration of the prescribed coordinate. ``places`` and ``speeds`` are half widths of the harsh states
    drawn around ``centre``, ``push`` those of the controls.
    """

    name: str
    scene: Scene
    motion: Callable
    places: tuple[float, ...]
    speeds: tuple[float, ...]
    push: tuple[float, ...] = ()
    centre: tuple[float, ...] = ()

    @property
    def driven(self) -> bool:
        return bool(self.scene.prescribed)

    def draw(self, generator: np.random.Generator, part: float = 1.0) -> tuple[list[float], list[float]]:
        """Return a random state in the scene's order, and random controls."""
        state = [0.3, -0.8] if self.driven else []
        centre = self.centre or (0.0,) * len(self.places)
        for c, place, speed in zip(centre, self.places, self.speeds, strict=True):
            state += [c + place * generator.uniform(-1, 1), part * speed * generator.uniform(-1, 1)]
        return state, [part * push * generator.uniform(-1, 1) for push in self.push]


def cart_pole(q, v, u, s, a, xp):
    m, length, c = 0.1, 0.5, xp.cos(q[1])
    mass = [[1.0 + m, m * length * c], [m * length * c, 4 * m * length**2 / xp.number(3)]]
    return mass, [
        u[0] - 0.05 * v[0] + m * length * v[1] * v[1] * xp.sin(q[1]),
        m * 9.8 * length * xp.sin(q[1]),
    ]


def acrobot(q, v, u, s, a, xp):
    m, length = xp.number(0.8), xp.number(0.9)
    bar, half = m * length**2 / 3, m * length**2 / 2
    c, sine = xp.cos(q[1]), xp.sin(q[1])
    mixed = bar + half * c
    w, both = v[1], v[0] + v[1]
    weight = 9.81 * m * length / 2
    lower = weight * xp.sin(q[0] + q[1])
    force = half * sine * (both * both - v[0] * v[0]) - 3 * weight * xp.sin(q[0]) - lower - 0.1 * v[0]
    elbow = -half * sine * v[0] * v[0] - lower + u[0] - 0.1 * w - 0.2 * xp.atan(100 * w)
    return [[bar + m * length**2 + 2 * half * c + bar, mixed], [mixed, bar]], [force, elbow]


def chain(q, v, u, s, a, xp):
    n = len(q)
    m, length, friction = xp.number(0.1), xp.number(0.3), 1e-4
    mass: list[list] = [[None] * n for _ in range(n)]
    force = []
    for i in range(n):
        total = -m * length * (n - i) * (9.81 * xp.sin(q[i]) + a * xp.cos(q[i]))
        total = total - friction * (v[i] - (v[i - 1] if i else 0.0))
        if i + 1 < n:
            total = total + friction * (v[i + 1] - v[i])
        for j in range(n):
            weight = m * length * length * (n - max(i, j))
            mass[i][j] = weight * xp.cos(q[i] - q[j])
            if i != j:
                total = total - weight * xp.sin(q[i] - q[j]) * v[j] * v[j]
        force.append(total)
    return mass, force


def rotary(q, v, u, s, a, xp):
    m, r, length = xp.number(0.1), xp.number(0.2), xp.number(0.15)
    c, sine = xp.cos(q[1]), xp.sin(q[1])
    square = m * length**2
    mixed = m * r * length * c
    phi = u[0] - 1e-3 * v[0] - 2 * square * sine * c * v[0] * v[1] + m * r * length * sine * v[1] * v[1]
    theta = square * sine * c * v[0] * v[0] - m * 9.81 * length * sine
    return [[2e-3 + m * r**2 + square * sine * sine, mixed], [mixed, square + 0 * c]], [phi, theta]


class ElasticPendulum(Scene):
    """A ball on a spring, in Cartesian coordinates; the spring hangs on a support that is moved."""

    mass: float = parameter(0.3, "kg", above=0.0)
    stiffness: float = parameter(40.0, "N/m", above=0.0)
    length: float = parameter(0.4, "m", above=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    coordinates = {"x": "m", "y": "m"}
    prescribed = {"s": "m"}
    controls = {"s_ddot": "m/s²"}

    def kinetic(self, q, v, xp):
        return 0.5 * self.mass * (v.x**2 + v.y**2)

    def potential(self, q, xp):
        stretch = xp.sqrt((q.x - q.s) ** 2 + q.y**2) - self.length
        return 0.5 * self.stiffness * stretch**2 + self.mass * self.gravity * q.y


def elastic(q, v, u, s, a, xp):
    across = q[0] - s
    r = xp.sqrt(across * across + q[1] * q[1])
    pull = -40 * (1 - xp.number(0.4) / r)
    m = xp.number(0.3)
    return [[m, 0.0], [0.0, m]], [pull * across, pull * q[1] - m * 9.81]


def turning(q, v, u, s, a, xp):
    m, rate = xp.number(0.5), xp.number(7.0)
    x, y = q
    inward = m * rate**2 - 30
    return [[m, 0.0], [0.0, m]], [
        2 * m * rate * v[1] + inward * x - 50 * x * y + u[0],
        -2 * m * rate * v[0] + inward * y - 25 * (x * x - y * y) + u[1],
    ]


class Lattice(Scene):
    """Exponential, logarithm, hyperbolic tangent and reciprocals, in mass, forces and drag."""

    light: float = parameter(0.2, "kg", above=0.0)
    stiffness: float = parameter(12.0, "N/m", above=0.0)
    steep: float = parameter(1.5, "1/m", above=0.0)
    drag: float = parameter(0.7, "N", least=0.0)
    coordinates = {"x": "m", "y": "m"}
    controls = {"force": "N"}

    def kinetic(self, q, v, xp):
        return 0.5 * v.x**2 + 0.5 * (self.light + 1 / (1 + q.x**2)) * v.y**2

    def potential(self, q, xp):
        bond = xp.exp(-self.steep * (q.x - q.y)) + self.steep * (q.x - q.y)
        return self.stiffness * bond + 3 * xp.log(1 + q.y**2) + 0.5 * self.stiffness * q.x**2

    def applied(self, q, v, u, xp):
        return {"x": u.force, "y": -self.drag * xp.tanh(5 * v.y)}


def lattice(q, v, u, s, a, xp):
    x, y = q
    one = 1 / (1 + x * x)
    bond = 18 * (1 - xp.exp(-1.5 * (x - y)))
    return [[1.0 + 0 * x, 0.0], [0.0, xp.number(0.2) + one]], [
        u[0] - x * one * one * v[1] * v[1] - bond - 12 * x,
        bond - 6 * y / (1 + y * y) + 2 * x * one * one * v[0] * v[1] - xp.number(0.7) * xp.tanh(5 * v[1]),
    ]


POINTS = {"mass": 0.1, "length": 0.3, "com_distance": 0.3, "inertia": 0.0, "damping": 1e-4}
ACROBOT = Acrobot(
    mass_1=0.8, mass_2=0.8, length_1=0.9, length_2=0.9, damping=0.1, dry_friction=0.0, dry_friction_2=0.2
)
ROTARY = RotaryPendulum(
    arm_length=0.2, arm_inertia=2e-3, mass=0.1, com_distance=0.15, inertia=0.0, arm_damping=1e-3
)
FRAME = RotatingFrame(mass=0.5, rate=7.0, spring=30.0, skew=25.0, drag=0.0)
SYSTEMS = (
    System("cart-pole", CartPole(friction=0.05), cart_pole, (2.0, 3.1), (3.0, 12.0), (10.0,)),
    System("acrobot", ACROBOT, acrobot, (3.1, 3.1), (6.0, 8.0), (2.0,)),
    System("double pendulum", Chain(bars=2, **POINTS), chain, (3.1, 3.1), (10.0, 10.0), (15.0,)),
    System("triple pendulum", Chain(bars=3, **POINTS), chain, (3.1, 3.1, 3.1), (8.0, 8.0, 8.0), (15.0,)),
    System("rotary pendulum", ROTARY, rotary, (3.1, 3.1), (10.0, 10.0), (0.1,)),
    System("elastic pendulum", ElasticPendulum(), elastic, (0.35, 0.35), (3.0, 3.0), (15.0,), (0.3, -0.3)),
    System("turning frame", FRAME, turning, (0.5, 0.5), (4.0, 4.0), (3.0, 3.0)),
    System("lattice", Lattice(), lattice, (1.0, 1.0), (4.0, 4.0), (5.0,)),
)


def acceleration(system: System, q: list, v: list, u: list, s: Any, a: Any, xp: Any) -> list:
    """Return the accelerations, for numbers of any kind."""
    return solve_positive(*system.motion(q, v, u, s, a, xp))
