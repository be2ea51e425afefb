"""Tasks as a user writes them, each with a feature that the package's own tasks lack."""

import math

from lag_envs.scenes import Chain, Scene, parameter
from lag_envs.tasks import Task


class Crane(Scene):
    """A load on a rope; a trolley and a winch move it."""

    trolley_mass: float = parameter(2.0, "kg", above=0.0)
    load_mass: float = parameter(1.0, "kg", above=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)
    rail_drag: float = parameter(0.5, "N s/m", least=0.0)
    rope_drag: float = parameter(0.0, "N s/m", least=0.0)

    coordinates = {"x": "m", "rope": "m", "swing": "rad"}
    controls = {"push": "N", "pull": "N"}

    def kinetic(self, q, v, xp):
        s, c = xp.sin(q.swing), xp.cos(q.swing)
        across = v.x + v.rope * s + q.rope * v.swing * c
        up = -v.rope * c + q.rope * v.swing * s
        return 0.5 * self.trolley_mass * v.x**2 + 0.5 * self.load_mass * (across**2 + up**2)

    def potential(self, q, xp):
        return -self.load_mass * self.gravity * q.rope * xp.cos(q.swing)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.rail_drag * v.x**2 + 0.5 * self.rope_drag * v.rope**2

    def applied(self, q, v, u, xp):
        return {"x": u.push, "rope": -u.pull}


class Deliver(Task):
    """Bring the load to a point."""

    id = "OwnCrane-v0"
    scene = Crane
    defaults = {"rail_drag": 1.0}
    interval, steps = 0.05, 60
    action = {"push": 20.0, "pull": (0.0, 20.0)}
    start = {"x": 0.5, "rope": (1.0, 0.2), "swing": 0.3, "swing_dot": 0.2}
    target = {"x_goal": ("m", 1.0), "y_goal": ("m", -1.5, 0.3)}
    draws = 2

    def guard(self, wanted, before, dt, xp):
        # The winch holds the rope when it is about to run out.
        return {"pull": xp.where(before.rope < 0.3, 0.0, wanted.pull)}

    def observe(self, after, target, xp):
        return {
            "x": after.x,
            "rope": after.rope,
            "sin": xp.sin(after.swing),
            "cos": xp.cos(after.swing),
            "x_dot": after.x_dot,
            "rope_dot": after.rope_dot,
            "swing_dot": after.swing_dot,
            "dx": target.x_goal - after.x,
            "y": target.y_goal,
        }

    def bounds(self):
        return {"sin": 1.0, "cos": 1.0, "y": (-1.8, -1.2)}

    def reward(self, before, after, control, target, dt, xp):
        x = after.x + after.rope * xp.sin(after.swing)
        y = -after.rope * xp.cos(after.swing)
        off = (x - target.x_goal) ** 2 + (y - target.y_goal) ** 2
        height = self.scene.potential(after, xp) / (self.scene.load_mass * 9.81)
        return xp.exp(-off) - 1e-4 * (control.push**2 + control.pull**2) + 1e-3 * height

    def last_reward(self, before, after, control, target, dt, xp):
        return -xp.maximum(xp.abs(before.swing_dot), xp.abs(after.swing_dot))

    def terminated(self, after, target, xp):
        return (after.rope < 0.2) | (xp.abs(after.x) > 2.0)

    def kick(self, after, draws, xp):
        gust = xp.where(draws[0] < self.chance(0.2), draws[1] - 0.5, 0.0)
        return {"swing_dot": gust, "x_dot": 0.1 * gust}


class Switched(Task):
    """A chain of bars whose support is pushed left, right or not at all; the reward takes every function."""

    id = "OwnSwitched-v0"
    scene = Chain
    defaults = {"bars": 3, "mass": 0.1, "length": 0.2}
    interval, steps = 0.02, 80
    action = {"s_ddot": [-5.0, 0.0, 5.0]}
    start = {f"theta_{i}": (math.pi, 0.3) for i in (1, 2, 3)}

    def observe(self, after, target, xp):
        return {name: after[name] for name in self.scene.state_names}

    def reward(self, before, after, control, target, dt, xp):
        up = xp.where(xp.cos(after.theta_3) < -0.5, 1.0, 0.0)
        x, y = xp.sin(after.theta_1), after.theta_1_dot
        smooth = xp.tan(x) + xp.atan(y) + xp.tanh(y) + xp.exp(-y * y) + xp.log(1.0 + y * y) + xp.sqrt(2.0 + x)
        kinks = xp.floor(y) + xp.abs(x) + xp.minimum(x, y) - xp.maximum(x, 0.5 * y)
        return up - 0.01 * control[0] ** 2 + 1e-3 * (smooth + kinks)


class Drift(Task):
    """Nothing acts: an environment only for looking at."""

    id = "OwnDrift-v0"
    interval, steps = 0.1, 20
    start = {"theta": (1.0, 0.5)}

    class scene(Scene):
        length: float = parameter(1.0, "m", above=0.0)
        coordinates = {"theta": "rad"}

        def kinetic(self, q, v, xp):
            return 0.5 * (self.length * v.theta) ** 2

        def potential(self, q, xp):
            return -9.81 * self.length * xp.cos(q.theta)

    def observe(self, after, target, xp):
        return {"theta": after.theta}

    def reward(self, before, after, control, target, dt, xp):
        return after.theta - before.theta


TASKS = (Deliver, Switched, Drift)


def mistaken(**changes):
    """Return `Deliver` with changes, most of them mistakes."""
    return type("Mistaken", (Deliver,), changes)
