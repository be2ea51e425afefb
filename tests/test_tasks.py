"""Each task restated in plain numbers, checked against the environments."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
from covering import slow
from mpmath import mp, mpf
from rollouts import actions, make

from lag_envs.controllers import Constant, Random, make_controller
from lag_envs.envs.model import Model
from lag_envs.evaluation.rollout import play
from lag_envs.tasks import cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.registration import make_task

PI = math.pi


# --- the table ---


BAR = {
    "mass": 0.2, "com_distance": 0.3, "inertia": pytest.approx(0.006, rel=1e-15), "damping": 0.001,
    "gravity": 9.81, "track": 0.5,
}  # fmt: skip
PLANE = {"mass": 1.0, "radius": 0.05, "inertia": pytest.approx(0.5 * 0.05**2), "gravity": 9.81}
SHELL = {
    "mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "inertia": pytest.approx(0.005), "gravity": 9.81,
}  # fmt: skip


class Row:
    """One row of the table: dt, steps, the scene, boxes of the start, and formulas in the order of a step."""

    dt, steps = 0.02, 500
    ends: bool | None = True  # whether the test's actions end episodes, None if it does not matter
    largest = 1.0  # control
    target = 0.0  # half width
    kicks: tuple = ()

    def control(self, a, y):
        return self.largest * a

    def ended(self, y):
        return False


class PivotedBar(Row):
    task, scene, ends = pivoted_bar.SwingUp, BAR, False
    start = ((0, 0.05), (0, 0.02), (0, 0.1), (0, 0.1))
    largest, track = 5.0, 0.5

    def control(self, a, y, dt=0.02):
        return nearest_safe(y[0], y[1], self.largest * a, self.largest, self.track, dt)

    def reward(self, y, u, target):
        return ((1 - math.cos(y[2])) / 2) ** 2 - 0.02 * (u / 5) ** 2

    def observe(self, y, target):
        return [y[0] / 0.5, y[1] / 2, math.cos(y[2]), math.sin(y[2]), y[3] / 8]


class PivotedBarFree(Row):
    task, scene, ends = pivoted_bar.SwingUpFree, BAR | {"track": None}, False
    start = ((0, 0.1), (0, 0.1))
    largest = 5.0

    def reward(self, y, u, target):
        return ((1 - math.cos(y[0])) / 2) ** 2 - 0.02 * (u / 5) ** 2

    def observe(self, y, target):
        return [math.cos(y[0]), math.sin(y[0]), y[1] / 8]


class PivotedBarBalance(Row):
    task, scene = pivoted_bar.Balance, BAR
    start = ((0, 0.2), (0, 0.2), (PI, 0.15), (0, 0.3))
    largest = 3.0

    def reward(self, y, u, target):
        return 1 - 0.5 * ((y[2] - PI) / 0.35) ** 2 - 0.5 * (y[0] / 0.5) ** 2

    def ended(self, y):
        return abs(y[2] - PI) > 0.35 or abs(y[0]) > 0.5

    def observe(self, y, target):
        return [y[0], y[1], y[2] - PI, y[3]]

    def kicked(self, size):
        return abs(size) <= 1.0

    def check_kicks(self, kicks):
        assert_uniform((np.sort(kicks) + 1) / 2)

    def acceleration(self, theta, theta_dot, u):
        moment = 0.06 * (u * np.cos(theta) + 9.81 * np.sin(theta))
        return -(moment + 0.001 * theta_dot) / (0.006 + 0.2 * 0.3**2)


class InclineTilt(Row):
    task, scene = incline.Tilt, PLANE | {"damping": 0.03}
    dt, steps = 0.05, 200
    start = ((0, 0.4), (0, 0.3), (0, 0.05))
    largest, target = 0.3, 0.3

    def control(self, a, y, dt=0.05):
        return min(max(0.3 * a, (-0.1 - y[2]) / dt), (0.1 - y[2]) / dt)

    def reward(self, y, u, target):
        return math.exp(-(((y[0] - target) / 0.1) ** 2)) - 0.02 * (u / 0.3) ** 2

    def ended(self, y):
        return abs(y[0]) > 0.5

    def observe(self, y, target):
        return [*y, target]


class InclineBrake(Row):
    task, scene = incline.Brake, PLANE | {"damping": 0.0, "tilt": pytest.approx(PI / 12)}
    start = ((-2, 1.0), (0.5, 0.5))

    def control(self, a, y):
        return 3.0 * (1 + a)

    def reward(self, y, u, target):
        return None if self.ended(y) else -0.02  # the last step has a test of its own

    def ended(self, y):
        return y[0] >= 0.0

    def observe(self, y, target):
        return [-y[0], y[1]]


class CylinderInCylinderTilt(Row):
    task, scene = cylinder_in_cylinder.Tilt, SHELL | {"damping": 0.24}
    dt, steps = 0.05, 200
    start = ((0, 0.1), (0, 0.2), (0, 0.0))
    largest, target, fastest, highest = 15.0, 0.3, 6.0, 1.05

    def control(self, a, y, dt=0.05):
        return min(max(self.largest * a, (-self.fastest - y[2]) / dt), (self.fastest - y[2]) / dt)

    def reward(self, y, u, target):
        return math.exp(-(((y[0] - target) / 0.1) ** 2)) - 0.02 * (u / 15) ** 2

    def ended(self, y):
        return abs(y[0]) > self.highest

    def observe(self, y, target):
        return [*y, target]


class CylinderInCylinderPump(CylinderInCylinderTilt):
    task, scene, ends = cylinder_in_cylinder.Pump, SHELL | {"damping": 0.024}, None
    largest, target, fastest, highest = 4.0, 0.0, 3.0, 1.3

    def reward(self, y, u, target):
        square, wanted = 2 / 3 * 9.81 / 0.4, 2 / 3 * 9.81 / 0.4 * (1 - math.cos(0.9))
        assert wanted == pytest.approx(6.187, abs=5e-4)
        energy = y[1] ** 2 / 2 + square * (1 - math.cos(y[0]))
        return math.exp(-abs(energy - wanted) / (0.3 * wanted)) - 0.02 * (u / 4) ** 2

    def observe(self, y, target):
        return list(y)


class CylinderInCylinderDamping(Row):
    task, scene, ends = cylinder_in_cylinder.Damping, SHELL | {"damping": 0.0}, None
    start = ((0, 0.8), (0, 1.0))

    def control(self, a, y):
        return 1.2 * (1 + a)

    def reward(self, y, u, target):
        square = 2 / 3 * 9.81 / 0.4
        assert math.sqrt(square) == pytest.approx(4.0435, abs=5e-5)
        return math.exp(-math.sqrt(y[0] ** 2 + y[1] ** 2 / square) / 0.1)

    def ended(self, y):
        return 0.4 * y[1] ** 2 + 9.81 * math.cos(y[0]) < 0

    def observe(self, y, target):
        return list(y)

    def kicked(self, size):
        return min(abs(abs(size) - 1.5), abs(abs(size) - 3.0)) < 1e-12

    def check_kicks(self, kicks):
        counts = [np.sum(np.abs(kicks - size) < 1e-7) for size in (-3.0, -1.5, 1.5, 3.0)]
        assert sum(counts) == len(kicks)
        assert np.abs(np.array(counts) - len(kicks) / 4).max() < 5 * math.sqrt(len(kicks) / 4)

    def acceleration(self, theta, theta_dot, u):
        return -2 / 3 * 9.81 / 0.4 * np.sin(theta) - 2 / 3 * u / 0.16 * theta_dot


def each(*rows):
    return pytest.mark.parametrize("row", rows, ids=lambda row: row.task.id)


KICKED = PivotedBarBalance(), CylinderInCylinderDamping()
PAID_BY_THE_STEP = (
    PivotedBar(), PivotedBarFree(), InclineTilt(), CylinderInCylinderTilt(), CylinderInCylinderPump(), *KICKED
)  # fmt: skip
each_row = each(*PAID_BY_THE_STEP, InclineBrake())


def nearest_safe(s, s_dot, wanted, top, track, dt):
    """Return the control nearest to the wanted one after which braking at `top` stops on the track."""

    def overshoot(u, side):
        v = s_dot + u * dt
        return v * v / (2 * top) + side * (s + s_dot * dt + u * dt * dt / 2) - track

    candidates = [wanted, -top, top]
    for side in (1, -1):
        a, b = dt * dt / (2 * top), s_dot * dt / top + side * dt * dt / 2
        c = s_dot * s_dot / (2 * top) + side * (s + s_dot * dt) - track
        candidates += [root.real for root in np.roots([a, b, c]) if abs(root.imag) <= 1e-6 * abs(root)]
    safe = [u for u in candidates if abs(u) <= top + 1e-9 and max(overshoot(u, 1), overshoot(u, -1)) <= 1e-12]
    return min(safe, key=lambda u: abs(u - wanted)) if safe else -math.copysign(top, s_dot)


def bold(env, i, rng):
    """Return actions that reach limits and ends: noise, then long pushes."""
    if i % 2:
        return rng.uniform(-1.2, 1.2, 1)
    return np.sign(env.state[-1:] if (i // 100) % 4 == 0 else rng.normal(size=1))


# --- the step ---


@each_row
def test_parameters_and_time(row):
    env = make(row.task.id)
    assert (env.task.dt, env.task.limit) == (row.dt, row.steps)
    assert {name: getattr(env.scene, name) for name in row.scene} == row.scene


@each_row
def test_every_step_is_as_the_table_says(row):
    env = make(row.task.id)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    n, ends, cuts, kicks = 0, 0, 0, 0
    a = np.zeros(1)
    for i in range(1200):
        before, target = env.state, env.target
        a = bold(env, i // 10, rng) if i % 10 == 0 or i // 10 % 2 else a
        observation, reward, terminated, truncated, _ = env.step(a)
        n += 1
        u = env.control
        assert u == pytest.approx(row.control(float(np.clip(a[0], -1, 1)), before), abs=1e-7)
        after = env.scene.simulate(before, [u], row.dt)[1]
        jump = env.state - after
        if hasattr(row, "kicked"):
            kicks += abs(jump[-1]) > 1e-9
            assert abs(jump[-1]) < 1e-12 or row.kicked(jump[-1])
            jump[-1] = 0.0
        np.testing.assert_allclose(jump, 0.0, atol=1e-13)
        # Reward and ending look at the state before the kick, the observation at the one after it.
        if (expected := row.reward(after, u, target)) is not None:
            assert reward == pytest.approx(expected, rel=1e-12, abs=1e-14)
        assert terminated == row.ended(after)
        np.testing.assert_allclose(
            observation, np.float32(row.observe(env.state, target)), rtol=3e-7, atol=1e-7
        )
        assert truncated == (n == row.steps)
        ends, cuts = ends + terminated, cuts + truncated
        if terminated or truncated:
            env.reset()
            n = 0
    assert row.ends is None or (ends > 0 if row.ends else ends == 0 and cuts > 0)
    assert (kicks > 0) == hasattr(row, "kicked")


@each_row
def test_starts(row):
    envs = gym.make_vec(row.task.id, num_envs=20_000)
    envs.reset(seed=0)
    columns = list(envs.state.T)
    boxes = list(row.start)
    assert (envs.target is None) == (row.target == 0.0)
    if row.target:
        columns.append(envs.target)
        boxes.append((0, row.target))
    drawn = []
    for values, (centre, half) in zip(columns, boxes, strict=True):
        if half == 0:
            assert (values == centre).all()
            continue
        share = (np.sort(values) - centre + half) / (2 * half)
        assert 0.0 <= share[0] and share[-1] < 1.0 + 1e-12
        assert_uniform(share)
        drawn.append(values)
    correlations = np.corrcoef(drawn) - np.eye(len(drawn))
    assert np.abs(correlations).max() < 5.0 / math.sqrt(20_000)
    # The second episodes are drawn afresh.
    envs.reset()
    assert abs(np.corrcoef(drawn[0], envs.state[:, 0])[0, 1]) < 5.0 / math.sqrt(20_000)


def assert_uniform(share):
    """Compare sorted numbers with the uniform distribution: Kolmogorov-Smirnov at a chance of 1e-5."""
    n = len(share)
    assert np.abs(share - (np.arange(n) + 0.5) / n).max() < 2.5 / math.sqrt(n)


def rolled(row, y, u, dt):
    """Return the angle's rate after a step, by classical Runge-Kutta steps for all environments at once."""

    def rate(y):
        return np.array([y[1], row.acceleration(*y, u)])

    h = dt / 100
    for _ in range(100):
        a = rate(y)
        b = rate(y + h / 2 * a)
        c = rate(y + h / 2 * b)
        y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))
    return y


@pytest.mark.parametrize("dt", [0.02, slow(0.2), slow(0.005)])
@each(*KICKED)
def test_kicks(row, dt):
    n, steps = 4000, 20
    envs = gym.make_vec(row.task.id, num_envs=n, dt=dt, autoreset_mode="Disabled")
    envs.reset(seed=1)
    sizes = []
    for action in actions(steps, n, 1):
        before = envs.state.T[-2:]
        *_, terminated, truncated, _ = envs.step(action)
        jump = envs.state.T[-2:] - rolled(row, before, envs.control, dt)
        np.testing.assert_allclose(jump[0], 0.0, atol=1e-9)
        sizes.append(jump[1])
        if (over := terminated | truncated).any():
            envs.reset(options={"reset_mask": over})
    sizes = np.concatenate(sizes)
    kicks = sizes[np.abs(sizes) > 1e-7]
    chance = 1 - 0.99 ** (dt / 0.02)
    assert abs(len(kicks) - chance * len(sizes)) < 5 * math.sqrt(chance * len(sizes))
    row.check_kicks(kicks)


@each(*PAID_BY_THE_STEP)
def test_running_rewards_with_another_interval(row):
    env = make(row.task.id, dt=0.03)
    env.reset(seed=3)
    for a in actions(50, 1):
        before, target = env.state, env.target
        _, reward, terminated, _, _ = env.step(a)
        after = env.scene.simulate(before, [env.control], 0.03)[1]
        assert reward == pytest.approx(
            0.03 / row.dt * row.reward(after, env.control, target), rel=1e-12, abs=1e-14
        )
        if terminated:
            env.reset()


# --- limits ---


def pushes(rng):
    """Return policies that try to leave the track."""
    return [
        lambda y: 1.0,
        lambda y: -1.0,
        lambda y: np.sign(y[1]) or 1.0,
        lambda y: -np.sign(y[1]) or 1.0,
        lambda y: rng.choice([-1.0, 1.0]),
        lambda y: rng.uniform(-1.0, 1.0),
        lambda y: math.cos(40 * y[0]),
    ]


@pytest.mark.parametrize(
    ("track", "dt"),
    [(0.5, 0.1), (0.5, 1e-4), *(slow(*pair) for pair in [(0.5, 0.02), (0.05, 0.02), (3.0, 0.005)])],
)
def test_the_track_is_never_left(track, dt):
    env = make("PivotedBar-v0", track=track, dt=dt)
    rng = np.random.default_rng(0)
    worst = 0.0
    for policy in pushes(rng):
        for edge in (0.0, 0.3, 0.999999, 1.0):
            s = rng.uniform(-track, track) if edge < 1.0 else rng.choice([-track, track])
            s_dot = rng.choice([-1.0, 1.0]) * math.sqrt(2 * 5.0 * edge * (track - abs(s)))
            env.reset(seed=1, options={"state": [s, s_dot, 0.0, 0.0]})
            for _ in range(150):
                y = env.state
                a = policy(y)
                env.step(np.array([a]))
                s, s_dot = env.state[:2]
                worst = max(worst, abs(s) - track, abs(s) + s_dot**2 / 10 - track)
                # Near a double root, the root's error is the square root of rounding.
                assert env.control == pytest.approx(
                    nearest_safe(y[0], y[1], 5.0 * a, 5.0, track, dt), abs=1e-8 / dt
                )
    assert worst < 1e-14 * (1 + track)


def test_the_guard_leaves_alone_what_is_safe():
    env = make("PivotedBar-v0")
    env.reset(seed=1, options={"state": [0.1, 0.2, 0.0, 0.0]})
    for a in (0.123456789, -1.0, 1.0):
        env.step(np.array([a]))
        assert env.control == 5.0 * a


def test_an_endless_track_has_no_guard():
    env = make("PivotedBar-v0", track=math.inf)
    env.reset(seed=1)
    for _ in range(300):
        env.step(np.ones(1))
        assert env.control == 5.0
    assert env.state[0] > 50.0


@pytest.mark.parametrize(
    ("env_id", "entry", "limit"),
    [
        (incline.Tilt.id, 2, 0.1),
        (cylinder_in_cylinder.Tilt.id, 2, 6.0),
        (cylinder_in_cylinder.Pump.id, 2, 3.0),
    ],
)
@pytest.mark.parametrize("dt", [None, 0.013, 0.7])
def test_limits_are_met_at_the_end_of_a_step(env_id, entry, limit, dt):
    env = make(env_id, dt=dt)
    rng = np.random.default_rng(0)
    env.reset(seed=1)
    met = 0
    for i in range(2000):
        side = 1.0 if i // 120 % 2 else -1.0
        *_, terminated, truncated, _ = env.step(np.array([side * rng.choice([1.0, 1.0, 0.7])]))
        value = abs(env.state[entry])
        assert value <= limit * (1 + 4e-16)
        met += value == pytest.approx(limit, rel=1e-12)
        if terminated or truncated:
            env.reset()
    assert met > 5


def test_quasi_static_tilt():
    env = make(incline.Tilt.id, control="tilt")
    assert env.scene.state_names == ("x", "x_dot")
    observation, _ = env.reset(seed=1)
    assert observation.shape == (3,)
    env.step(np.array([0.5]))
    assert env.control == 0.05


# --- braking to the line ---


def crossing(x, v, pull, drag):
    """Return time and speed at the line of x'' = pull - drag x' from (x, v), in 60 digits."""
    x, v, pull, drag = map(mpf, (x, v, pull, drag))

    def at(t):
        phi1 = -mp.expm1(-drag * t) / drag if drag else t
        phi2 = (t - phi1) / drag if drag else t * t / 2
        return x + v * phi1 + pull * phi2, v * mp.exp(-drag * t) + pull * phi1

    high = mpf(1)
    low = mpf(0)
    for _ in range(220):
        middle = (low + high) / 2
        low, high = (low, middle) if at(middle)[0] >= 0 else (middle, high)
    return low, at(low)[1]


CROSSINGS = [
    # distance, speed, action, options
    (1e-3, 1.0, -1.0, {}),
    (0.015, 1.0, 0.3, {}),
    (0.0199, 1.0, -1.0, {}),
    (1e-9, 0.0, 1.0, {}),
    (1e-15, 1.0, 1.0, {}),
    (1e-4, 0.5, 1.0, {}),
    (0.01, 0.6, 1.0, {"damping": 5.0}),
    (0.5, 50.0, 0.5, {}),
    (1.5, 100.0, 1.0, {}),
    (0.3, 0.0, -1.0, {"dt": 1.0}),
    (0.5, 1.0, 1.0, {"dt": 1.0}),
    (0.2, 1.0, 1.0, {"dt": 1.0, "damping": 10.0}),
    # flat: the cylinder coasts, and may reach the line with hardly any speed
    (0.01, 1.0, -1.0, {"tilt": 0.0}),
    (0.01, 1.0, 1.0, {"tilt": 0.0}),
    (0.1, 1.0, 1.0, {"tilt": 0.0, "damping": 5.0, "dt": 1.0}),
    (0.015 * (1 - 1e-9), 1.0, -1.0, {"tilt": 0.0, "damping": 100.0, "dt": 1.0}),
    (0.015 * (1 - 1e-6), 1.0, -1.0, {"tilt": 0.0, "damping": 100.0, "dt": 0.5}),
    # down a wall
    (0.01, 1.0, -1.0, {"tilt": PI / 2}),
    (0.2, 1.0, 1.0, {"tilt": PI / 2, "dt": 1.0, "damping": 10.0}),
    # stiff: the speed is gone at once, or just before the line
    (1e-6, 1.0, 0.0, {"damping": 1e3}),
    (1e-6, 1.0, 0.0, {"damping": 1e5}),
    (1.4e-3, 1.0, 0.0, {"damping": 1e3}),
    (1.5e-3, 1.0, 0.0, {"damping": 1e3}),
    (1.51e-3, 1.0, 0.0, {"damping": 1e3}),
    (1.6e-3, 1.0, 0.0, {"damping": 1e3, "dt": 0.5}),
    (1.5e-6, 1.0, 0.0, {"damping": 1e6}),
    (1.5e-6 + 1e-12, 1.0, 0.0, {"damping": 1e6, "dt": 1.0}),
    (1e-8, 0.0, 0.0, {"damping": 1e6}),
    (1.5e-4, 100.0, 0.0, {"damping": 1e6, "dt": 1.0}),
]


@pytest.mark.parametrize(("distance", "speed", "action", "options"), CROSSINGS)
def test_crossing_time(distance, speed, action, options):
    env = make(incline.Brake.id, duration=10.0, **options)
    env.reset(seed=1, options={"state": [-distance, speed]})
    _, reward, terminated, _, _ = env.step(np.array([action]))
    assert terminated
    scene = env.scene
    c = 3.0 * (1.0 + action)
    assert env.control == pytest.approx(c)
    with mp.workdps(60):
        share = 1 / (1 + mpf(scene.inertia) / (mpf(scene.mass) * mpf(scene.radius) ** 2))
        pull = share * mpf(scene.gravity) * mp.sin(mpf(scene.tilt))
        time, end = crossing(
            -distance, speed, pull, share * (mpf(scene.damping) + mpf(env.control)) / mpf(scene.mass)
        )
        assert 0 <= time <= env.task.dt * (1 + mpf(10) ** -14)
        wanted = -time - 5 * max(end - mpf(0.5), 0)
        # Rounding the place changes the time by rounding over speed.
        assert abs(reward - wanted) < 1e-12 * (1 + speed) + (4 * 2**-53 * distance / end if end else 0)


def test_the_way_to_the_line_is_paid_by_the_second():
    for dt in (0.01, 0.02, 0.05):
        env = make(incline.Brake.id, dt=dt)
        env.reset(seed=1, options={"state": [-1.0, 0.0]})
        rewards = []
        terminated = False
        while not terminated:
            _, reward, terminated, _, _ = env.step(np.array([-1.0]))
            rewards.append(reward)
        assert rewards[:-1] == [-dt] * (len(rewards) - 1)
        pull = 2 / 3 * 9.81 * math.sin(PI / 12)
        assert sum(rewards) == pytest.approx(
            -math.sqrt(2 / pull) - 5 * (math.sqrt(2 * pull) - 0.5), rel=1e-12
        )


def test_from_on_or_behind_the_line_it_is_crossed_at_once():
    """No episode starts there, but planners and `lag_envs.torch.Step` may step from any state."""
    model, states = Model(make(incline.Brake.id).task), [[0.0, 0.0], [0.0, 2.0], [0.1, 0.0], [0.1, 2.0]]
    _, rewards, ended = model(states, [0.3] * 4)
    assert ended.all()
    np.testing.assert_allclose(rewards, [0.0, -7.5, 0.0, -7.5], atol=1e-14)
    slopes = model.vjp(states, [0.3] * 4, by_rewards=1.0).states
    np.testing.assert_allclose(slopes[1::2], [[0.0, -5.0]] * 2)


# --- known returns ---


@pytest.mark.parametrize(
    ("env_id", "policy", "options", "known"),
    [
        slow(pivoted_bar.SwingUpFree.id, None, {}, -2.9),
        slow(pivoted_bar.SwingUpFree.id, 0.0, {}, 0.0),
        slow("PivotedBar-v0", None, {}, 0.6),
        slow("PivotedBar-v0", 0.0, {}, 0.0),
        slow(pivoted_bar.Balance.id, None, {}, 21.0),
        slow(pivoted_bar.Balance.id, 0.0, {}, 21.0),
        slow(incline.Tilt.id, None, {"target": 0.0}, 9.0),
        slow(incline.Tilt.id, None, {"target": 0.3}, 6.0),
        slow(incline.Tilt.id, 0.0, {"target": 0.0}, 14.0),
        slow(incline.Tilt.id, 0.0, {"target": 0.3}, 9.0),
        (incline.Brake.id, None, {}, -4.27),
        (incline.Brake.id, -1.0, {}, -12.0),
        (incline.Brake.id, 1.0, {}, -4.66),
        slow(cylinder_in_cylinder.Tilt.id, None, {"target": 0.3}, 32.0),
        slow(cylinder_in_cylinder.Tilt.id, 0.0, {"target": 0.3}, 0.0),
        slow(cylinder_in_cylinder.Damping.id, None, {}, 283.0),
        slow(cylinder_in_cylinder.Damping.id, -1.0, {}, 9.0),
        slow(cylinder_in_cylinder.Damping.id, 1.0, {}, 295.0),
    ],
)
def test_known_returns(env_id, policy, options, known):
    agent = Random(1) if policy is None else Constant(policy)
    drawn = play(env_id, agent, range(500), **options)
    # The known figures are means of 20 episodes.
    assert abs(drawn.mean() - known) < 3 * drawn.std() / math.sqrt(20) + 0.05 + 0.01 * abs(known)


def test_a_tasks_module_is_imported(tmp_path, monkeypatch):
    (tmp_path / "of_its_own.py").write_text(
        "import lag_envs\nfrom own_tasks import Drift\n"
        "class Mine(Drift):\n    'Mine.'\n    id = 'OwnModule-v0'\n\nlag_envs.register(Mine)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert type(make_task("of_its_own:OwnModule-v0")).__name__ == "Mine"
    assert make_controller("of_its_own:OwnModule-v0", "zero") is not None
