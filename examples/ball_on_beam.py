"""A ball that rolls on a beam; a motor turns the beam. Everything follows from the energies below."""

import lag_envs
from lag_envs.scenes import Scene, parameter
from lag_envs.scenes.shapes import Circle, Polygon
from lag_envs.tasks import Task


class BallOnBeam(Scene):
    """A solid ball on a beam that turns about its middle.

    x is the ball's position along the beam, and angle is the beam's angle, counter-clockwise from horizontal.
    """

    ball_mass: float = parameter(0.1, "kg", above=0.0)
    ball_radius: float = parameter(0.02, "m", above=0.0)
    beam_inertia: float = parameter(0.02, "kg m²", above=0.0)
    half_length: float = parameter(0.5, "m", above=0.0)
    friction: float = parameter(0.01, "N m s", least=0.0)
    gravity: float = parameter(9.81, "m/s²", least=0.0)

    coordinates = {"x": "m", "angle": "rad"}
    controls = {"torque": "N m"}

    def kinetic(self, q, v, xp):
        spin = v.x / self.ball_radius  # rolling, seen from the beam
        ball = 0.5 * self.ball_mass * (v.x**2 + (q.x * v.angle) ** 2)
        return (
            ball + 0.2 * self.ball_mass * self.ball_radius**2 * spin**2 + 0.5 * self.beam_inertia * v.angle**2
        )

    def potential(self, q, xp):
        return self.ball_mass * self.gravity * q.x * xp.sin(q.angle)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.friction * v.angle**2

    def applied(self, q, v, u, xp):
        return {"angle": u.torque}

    def bodies(self):
        long, thick = self.half_length, 0.2 * self.ball_radius
        beam = Polygon([(-long, -thick), (long, -thick), (long, thick), (-long, thick)], "frame")
        return {"beam": [beam], "ball": [Circle((0.0, self.ball_radius), self.ball_radius)]}

    def poses(self, q, xp):
        c, s = xp.cos(q.angle), xp.sin(q.angle)
        return {"beam": (0.0, 0.0, q.angle), "ball": (q.x * c, q.x * s, q.angle)}


class Balance(Task):
    """Roll the ball to a mark on the beam and keep it there."""

    id = "BallOnBeam-v0"
    scene = BallOnBeam
    interval, steps = 0.02, 500
    action = {"torque": 1.0}
    start = {"x": 0.3, "x_dot": 0.1, "angle": 0.1, "angle_dot": 0.1}
    target = {"mark": ("m", 0.3)}

    def observe(self, after, target, xp):
        return {
            "x": after.x,
            "x_dot": after.x_dot,
            "angle": after.angle,
            "angle_dot": after.angle_dot,
            "mark": target.mark,
        }

    def reward(self, before, after, control, target, dt, xp):
        off = 10.0 * (after.x - target.mark)
        return xp.exp(-off * off) - 0.02 * control.torque**2

    def terminated(self, after, target, xp):
        return (xp.abs(after.x) > self.scene.half_length) | (xp.abs(after.angle) > 1.0)


lag_envs.register(Balance)
