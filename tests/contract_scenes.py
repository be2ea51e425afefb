"""Scenes for tests, each with a feature that the package's own scenes lack, and a base of their tasks."""

import dataclasses

import numpy as np

from lag_envs.scenes.base import Scene, parameter
from lag_envs.tasks import Task


class Bead(Scene):
    """A bead of 1 kg on a rail, the base of scenes with a potential or a force of their own."""

    coordinates = {"x": "m"}

    def kinetic(self, q, v, xp):
        return 0.5 * v.x**2

    def potential(self, q, xp):
        return 0.0


class Along(Task):
    """The base of tasks with a coordinate x, which is all that is observed, and the reward."""

    def observe(self, after, target, xp):
        return {"x": after.x}

    def reward(self, before, after, control, target, dt, xp):
        return after.x


class ChargedParticle(Scene):
    """A charge in a plane, in a magnetic field that grows with x: T has a linear part."""

    mass: float = parameter(1.0, "kg", above=0.0)
    field: float = parameter(0.7, "T")
    growth: float = parameter(0.2, "T/m")
    spring: float = parameter(0.5, "N/m", least=0.0)
    coordinates = {"x": "m", "y": "m"}
    controls = {}

    def kinetic(self, q, v, xp):
        potential = self.field * q.x + self.growth * q.x**2 / 2
        return self.mass * (v.x**2 + v.y**2) / 2 + potential * v.y

    def potential(self, q, xp):
        return self.spring * (q.x**2 + q.y**2) / 2


class RotatingHoop(Scene):
    """A bead on a hoop that turns at a constant rate, a parameter: T has a part without velocities."""

    mass: float = parameter(0.1, "kg", above=0.0)
    radius: float = parameter(0.4, "m", above=0.0)
    rate: float = parameter(6.0, "rad/s")
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    damping: float = parameter(0.01, "N m s", least=0.0)
    coordinates = {"theta": "rad"}
    controls = {"torque": "N m"}

    def kinetic(self, q, v, xp):
        return self.mass * self.radius**2 * (v.theta**2 + (self.rate * xp.sin(q.theta)) ** 2) / 2

    def potential(self, q, xp):
        return -self.mass * self.gravity * self.radius * xp.cos(q.theta)

    def dissipation(self, q, v, u, xp):
        return self.damping * v.theta**2 / 2

    def applied(self, q, v, u, xp):
        return {"theta": u.torque}


class RotatingFrame(Scene):
    """A mass on a spring in a plane that turns at a constant rate: T has parts of all degrees."""

    mass: float = parameter(1.0, "kg", above=0.0)
    rate: float = parameter(0.8, "rad/s")
    spring: float = parameter(3.0, "N/m", least=0.0)
    skew: float = parameter(0.0, "N/m²")
    drag: float = parameter(0.1, "N s/m", least=0.0)
    coordinates = {"x": "m", "y": "m"}
    controls = {"push_x": "N", "push_y": "N"}

    def kinetic(self, q, v, xp):
        return self.mass * ((v.x - self.rate * q.y) ** 2 + (v.y + self.rate * q.x) ** 2) / 2

    def potential(self, q, xp):
        return self.spring * (q.x**2 + q.y**2) / 2 + self.skew * (q.x**2 * q.y - q.y**3 / 3)

    def dissipation(self, q, v, u, xp):
        return self.drag * (v.x**2 + v.y**2) / 2

    def applied(self, q, v, u, xp):
        push_x, push_y = u
        return {"x": push_x, "y": push_y}


class ElasticPendulum(Scene):
    """A mass on a spring, in Cartesian coordinates, with a rail whose support moves at a held rate."""

    mass: float = parameter(0.3, "kg", above=0.0)
    spring: float = parameter(20.0, "N/m", above=0.0)
    length: float = parameter(0.7, "m", above=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    drag: float = parameter(0.02, "N s/m", least=0.0)
    coordinates = {"x": "m", "y": "m"}
    prescribed = {"s": "m"}
    controls = {"s_dot": "m/s"}
    reactions = {"pull": "s"}

    def kinetic(self, q, v, xp):
        return self.mass * ((v.x + v.s) ** 2 + v.y**2) / 2  # x from the support

    def potential(self, q, xp):
        stretch = xp.sqrt(q.x**2 + q.y**2) - self.length
        return self.spring * stretch**2 / 2 + self.mass * self.gravity * q.y

    def dissipation(self, q, v, u, xp):
        return self.drag * ((v.x + v.s) ** 2 + v.y**2) / 2


class Trolley(Scene):
    """Two pendulums of different length on a driven trolley, whose rate and whose hoist's rate are held."""

    masses: tuple = (0.5, 0.25)
    length: float = parameter(0.7, "m", above=0.0)
    short: float = parameter(0.4, "m", above=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    damping: float = parameter(0.03, "N m s", least=0.0)
    coordinates = {"alpha": "rad", "beta": "rad"}
    prescribed = {"s": "m", "h": "m", "side": "m"}
    controls = {"s_dot": "m/s", "h_dot": "m/s", "motor": "N m"}
    reactions = {"sideways": "side"}

    def kinetic(self, q, v, xp):
        first, second = self.masses
        total = 0
        for m, length, name in ((first, self.length + q.h, "alpha"), (second, self.short, "beta")):
            angle, rate = getattr(q, name), getattr(v, name)
            out = v.h if name == "alpha" else 0
            x = v.s + length * rate * xp.cos(angle) + out * xp.sin(angle)
            y = length * rate * xp.sin(angle) - out * xp.cos(angle)
            total = total + m / 2 * (x**2 + y**2 + v.side**2)
        return total + (v.alpha - v.beta) ** 2 / 100

    def potential(self, q, xp):
        first, second = self.masses
        return -self.gravity * (
            first * (self.length + q.h) * xp.cos(q.alpha) + second * self.short * xp.cos(q.beta)
        )

    def dissipation(self, q, v, u, xp):
        return self.damping * (v.alpha**2 + v.beta**2) / 2

    def applied(self, q, v, u, xp):
        return {"alpha": u.motor, "beta": -u.motor, "s": -v.s}


class Functions(Scene):
    """A scene with every function of an energy, a quotient, a tangent, and a commanded place."""

    mass: float = parameter(1.3, "kg", above=0.0)
    size: float = parameter(1.1, "m", above=0.0)
    coordinates = {"r": "m", "theta": "rad"}
    prescribed = {"z": "m"}
    controls = {"z": "m", "torque": "N m"}

    def kinetic(self, q, v, xp):
        inertia = self.mass * (self.size**2 + q.r**2) / (2 + xp.sin(q.theta))
        return (
            inertia * v.theta**2 / 2
            + self.mass * v.r**2 * (1 + xp.exp(-q.r))
            + v.r * v.theta * xp.tanh(q.r) / 7
        )

    def potential(self, q, xp):
        well = xp.log(self.size + q.r**2) + xp.atan(q.r - q.z) + xp.sqrt(1 + q.theta**2)
        return well + xp.tan(q.theta / 4) ** 2 + 1 / (3 + q.r)

    def dissipation(self, q, v, u, xp):
        return (1 + q.r**2) * v.theta**4 / 8 + xp.log(1 + v.r**2)

    def applied(self, q, v, u, xp):
        return {"theta": u.torque * xp.cos(q.theta), "r": -xp.tanh(10 * v.r) - 3 * v.r**3}


class Top(Scene):
    """A heavy top in Euler's angles, its rates in the body's frame, spun by a motor."""

    across: float = parameter(0.02, "kg m²", above=0.0)
    along: float = parameter(0.01, "kg m²", above=0.0)
    moment: float = parameter(1.2, "N m", least=0.0)
    coordinates = {"phi": "rad", "theta": "rad", "psi": "rad"}
    controls = {"motor": "N m"}

    def kinetic(self, q, v, xp):
        first = v.phi * xp.sin(q.theta) * xp.sin(q.psi) + v.theta * xp.cos(q.psi)
        second = v.phi * xp.sin(q.theta) * xp.cos(q.psi) - v.theta * xp.sin(q.psi)
        third = v.phi * xp.cos(q.theta) + v.psi
        return (self.across * (first**2 + second**2) + self.along * third**2) / 2

    def potential(self, q, xp):
        return self.moment * xp.cos(q.theta)

    def applied(self, q, v, u, xp):
        return {"psi": u.motor}


class Crane(Scene):
    """A load on a rope that a winch shortens, under a trolley that a force pushes, in matrices of NumPy."""

    load: float = parameter(1.0, "kg", above=0.0)
    trolley: float = parameter(3.0, "kg", above=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    friction: float = parameter(0.2, "N", least=0.0)
    coordinates = {"x": "m", "theta": "rad"}
    prescribed = {"rope": "m"}
    controls = {"force": "N", "rope_ddot": "m/s²"}
    reactions = {"winch": "rope"}

    def kinetic(self, q, v, xp):
        c, s = xp.cos(q.theta), xp.sin(q.theta)
        jacobian = np.array([[1, q.rope * c, s], [0, q.rope * s, -c]])
        speed = jacobian @ np.array(list(v))
        return self.trolley * v.x**2 / 2 + self.load * (speed @ speed) / 2

    def potential(self, q, xp):
        return -self.load * self.gravity * q.rope * xp.cos(q.theta)

    def applied(self, q, v, u, xp):
        return {"x": u.force - self.friction * xp.tanh(50 * v.x)}


ALL = (ChargedParticle, RotatingHoop, RotatingFrame, ElasticPendulum, Trolley, Functions, Top, Crane)


def cart(decorate):
    """Return a class of a cart on a spring, made with or without the decorator."""

    class Cart(Scene):
        mass: float = parameter(1.0, "kg", above=0.0)
        spring: float = parameter(2.0, "N/m", least=0.0)
        springs: int = 1
        pair: tuple = dataclasses.field(default_factory=tuple)
        coordinates = {"x": "m"}
        controls = {"force": "N"}

        def kinetic(self, q, v, xp):
            return self.mass * v.x**2 / 2

        def potential(self, q, xp):
            return self.springs * self.spring * q.x**2 / 2

        def applied(self, q, v, u, xp):
            return {"x": u.force}

    return dataclasses.dataclass(frozen=True, kw_only=True)(Cart) if decorate else Cart
