"""A scene with a hand-made flow and a task on it, in one file, as the first three scenes are written.

A pendulum on a fixed pivot, driven by a torque u::

        A         theta = 0 hangs straight down, positive counter-clockwise
         \\  l
          O  m    T = m l² theta'²/2,   V = -m g l cos(theta)

    theta'' = -(g/l) sin(theta) - b/(m l²) theta' + u/(m l²)
"""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np

from lag_envs.scenes.base import Motion, Scene, parameter
from lag_envs.scenes.shapes import Circle, Line, Window, polar
from lag_envs.stepping import pendulum
from lag_envs.stepping.flows import pendulum_flow
from lag_envs.tasks.base import FASTEST_START, Task, finite


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pendulum(Scene):
    """A point mass on a massless rod, driven by a torque at the pivot."""

    mass: float = parameter(1.0, "kg", above=0.0)
    length: float = parameter(1.0, "m", above=0.0)
    damping: float = parameter(0.0, "N m s", least=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)

    state_names = ("theta", "theta_dot")
    state_units = ("rad", "rad/s")
    control_unit = "torque [N m]"
    coordinates = ("theta",)  # all of them are free: nothing is moved from outside
    flow = pendulum_flow()
    angle = 0  # the state whose cosine and sine travel along

    # The energies, from which tests derive the equation of motion.

    def kinetic(self, q, v, xp):
        return 0.5 * self.mass * self.length * self.length * v.theta * v.theta

    def potential(self, q, xp):
        return -self.mass * self.gravity * self.length * xp.cos(q.theta)

    def dissipation(self, v, u):
        return 0.5 * self.damping * v.theta * v.theta

    # The equation of motion, in the flow's normal form. The lifted state y is (theta, theta_dot, cos, sin).

    def constants(self):
        push = 1.0 / (self.mass * self.length * self.length)
        return {"weight": self.gravity / self.length, "drag": self.damping * push, "push": push}

    def drive(self, y, u, k, xp):
        return pendulum.Drive(alpha=k.weight, gamma=k.drag, delta=k.push * u)

    def unpack(self, y, u, k):
        return y

    def pack(self, moved, y, u, dt, k):
        return moved

    # Forces and power, and the picture.

    def motion(self, state, control):
        theta, omega, c, s = self.lift(state)
        drive = self.drive((theta, omega, c, s), np.asarray(control), SimpleNamespace(**self.constants()), np)
        q, v = SimpleNamespace(theta=theta), SimpleNamespace(theta=omega)
        return Motion(q, v, SimpleNamespace(theta=pendulum.acceleration(omega, c, s, drive)))

    def reactions(self, m, u):
        pull = self.mass * (self.length * m.v.theta * m.v.theta + self.gravity * np.cos(m.q.theta))
        return {"rod_tension": pull}

    def drive_power(self, m, u):
        return u * m.v.theta

    def shapes(self, now):
        end = polar((0.0, 0.0), self.length, now.state[0] - 0.5 * math.pi)
        return [Line([(0.0, 0.0), end]), Circle(end, 0.1 * self.length)]

    def window(self, now):
        size = 1.2 * self.length
        return Window(-size, -size, size, size)


class Swing(Task):
    """Hold the pendulum upright; the torque is too weak to lift it at once."""

    scene_type = Pendulum
    observation = ("cos(theta)", "sin(theta)", "theta_dot")
    limit_control = 3.0
    start = (0.1, 0.1)

    def numbers(self):
        return {"limit_control": self.limit_control}

    def control(self, a, y, k, dt, xp):
        return k.limit_control * a

    def reward(self, y, z, u, g, k, dt, xp):
        return k.scale * (0.5 - 0.5 * z[2])

    def observe(self, z, g, k):
        return [z[2], z[3], z[1]]

    def bounds(self):
        k = self.scene.constants()
        fastest = FASTEST_START + (k["weight"] + k["push"] * self.limit_control) * self.duration
        return [1.0, 1.0, finite(fastest)]
