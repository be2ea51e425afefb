"""A scene and a task on it outside the package, as in CONTRIBUTING.md."""

from lag_envs.scenes import Scene, parameter
from lag_envs.scenes.shapes import Circle, Line
from lag_envs.tasks import Task


class Pendulum(Scene):
    """A point mass on a massless rod, driven by a torque at the pivot; theta = 0 hangs straight down."""

    mass: float = parameter(1.0, "kg", above=0.0)
    length: float = parameter(1.0, "m", above=0.0)
    damping: float = parameter(0.0, "N m s", least=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)

    coordinates = {"theta": "rad"}
    controls = {"torque": "N m"}

    def kinetic(self, q, v, xp):
        return 0.5 * self.mass * (self.length * v.theta) ** 2

    def potential(self, q, xp):
        return -self.mass * self.gravity * self.length * xp.cos(q.theta)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.damping * v.theta**2

    def applied(self, q, v, u, xp):
        return {"theta": u.torque}

    def poses(self, q, xp):
        return {"rod": (0.0, 0.0, q.theta)}

    def bodies(self):
        end = (0.0, -self.length)
        return {"rod": [Line([(0.0, 0.0), end]), Circle(end, 0.1 * self.length)]}


class Swing(Task):
    """Hold the pendulum upright; the torque is too weak to lift it at once."""

    id = "ToySwing-v0"
    scene = Pendulum
    action = {"torque": 3.0}
    start = {"theta": 0.1, "theta_dot": 0.1}

    def observe(self, after, target, xp):
        theta = after.theta
        return {"cos(theta)": xp.cos(theta), "sin(theta)": xp.sin(theta), "theta_dot": after.theta_dot}

    def reward(self, before, after, control, target, dt, xp):
        return 0.5 - 0.5 * xp.cos(after.theta)
