"""Steps behind a first-order actuator: against systems with it as a coordinate, and in every form."""

from __future__ import annotations

import itertools
import math
import types
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import mpmath
import numpy as np
import own_tasks
import pytest
from batches import played
from contract_scenes import Functions, Trolley
from covering import slow
from plain_target import Plain, advance_in_python, evaluate_operations, in_python
from reference import agreed_end

import lag_envs
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.report.oracle import oracle_of
from lag_envs.scenes import CartPole, Chain, Incline, PivotedBar, StepRefused, TwoLinkArm
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.checks import SMALLEST_LAG
from lag_envs.scenes.derivation import form_of, layout_of, motion_constants_of
from lag_envs.stepping import compiling, driver, general
from lag_envs.stepping.certificate import Certificate
from lag_envs.stepping.compiling import BLOCK, absent_from
from lag_envs.stepping.driver import compile_advance_block
from lag_envs.stepping.elementary import ElementaryTrace, fading
from lag_envs.stepping.lag import LaggedStepper, lagged_stepper
from lag_envs.stepping.machine import LaneLayout
from lag_envs.stepping.series import REACH, Series
from lag_envs.tasks import TASKS, arm

#: Error of a control step, relative to the entry or to 1.
LARGEST_ERROR = 2e-13

# --- systems whose actuators are coordinates ----------------------------------------------------------------
#
# The rates of `a` and `b` are the applied controls. Nothing acts back on them. So the oracle, which knows
# nothing of lag, gives the motion behind the actuators.


class _Actuators(Scene):
    lag_a: float = parameter(0.1, "s", above=0.0)
    lag_b: float = parameter(0.1, "s", above=0.0)
    to_a: float = parameter(0.0, "")
    to_b: float = parameter(0.0, "")

    def follow(self, v):
        return {"a": (self.to_a - v.a) / self.lag_a, "b": (self.to_b - v.b) / self.lag_b}

    def inertia(self, v):
        return 0.5 * (v.a**2 + v.b**2)


class BarThere(_Actuators):
    """A bar on a pivot whose support has the acceleration a'."""

    coordinates = {"s": "m", "theta": "rad", "a": "", "b": ""}

    def kinetic(self, q, v, xp):
        return self.inertia(v) + 0.5 * (v.s**2 + 0.2 * 0.3**2 * 4 / 3 * v.theta**2)

    def potential(self, q, xp):
        return -0.2 * 9.81 * 0.3 * xp.cos(q.theta)

    def applied(self, q, v, u, xp):
        torque = -0.2 * 0.3 * xp.cos(q.theta) * v.a - 0.001 * v.theta
        return self.follow(v) | {"s": v.a, "theta": torque}


class CartThere(_Actuators, CartPole):
    """A pole on a cart that the force a' pushes."""

    coordinates = {"x": "m", "theta": "rad", "a": "", "b": ""}
    controls = {}
    poses = bodies = indicators = lambda self, *_: {}

    def kinetic(self, q, v, xp):
        return self.inertia(v) + CartPole.kinetic(self, q, v, xp)

    def applied(self, q, v, u, xp):
        return self.follow(v) | {"x": v.a}


class ArmThere(_Actuators, TwoLinkArm):
    """An arm with the torques a' and b'."""

    damping: float = parameter(0.1, "N m s", least=0.0)
    coordinates = {"theta_1": "rad", "theta_2": "rad", "a": "", "b": ""}
    controls = {}
    poses = bodies = indicators = lambda self, *_: {}

    def kinetic(self, q, v, xp):
        return self.inertia(v) + TwoLinkArm.kinetic(self, q, v, xp)

    def applied(self, q, v, u, xp):
        return self.follow(v) | {"theta_1": v.a, "theta_2": v.b}


class _Slope(_Actuators):
    """A cylinder of 1 kg and 0.05 m on a slope."""

    coordinates = {"x": "m", "a": "", "b": ""}

    def kinetic(self, q, v, xp):
        return self.inertia(v) + 0.75 * v.x**2

    def potential(self, q, xp):
        return 0.0


class DragThere(_Slope):
    """The drag's coefficient is a'."""

    def applied(self, q, v, u, xp):
        return self.follow(v) | {"x": 9.81 * xp.sin(0.26) - (0.5 + v.a) * v.x}


class TiltThere(_Slope):
    """The tilt is a', without any effect of its rate."""

    def applied(self, q, v, u, xp):
        return self.follow(v) | {"x": 9.81 * xp.sin(v.a) - 0.5 * v.x}


class TurnThere(_Slope):
    """The tilt is a, its rate a'."""

    def applied(self, q, v, u, xp):
        turning = -1.5 * 0.05 * self.follow(v)["a"]
        return self.follow(v) | {"x": 9.81 * xp.sin(q.a) + q.x * v.a**2 - 0.5 * v.x + turning}


class Case(NamedTuple):
    """A scene and its twin, whose state is ``there(state, a', b')``; ``back`` is the inverse."""

    scene: Scene
    twin: type
    state: list
    applied: list
    command: list
    there: Callable = lambda y, a, b=0.0: [*y, 0.0, a, 0.0, b]
    back: Callable = lambda y: y[:-4]

    def oracle(self, lags):
        """Return the oracle of the twin, and its state."""
        names = ("a", "b")[: len(lags)]
        numbers = {f"lag_{x}": lag for x, lag in zip(names, lags, strict=True)}
        numbers |= {f"to_{x}": command for x, command in zip(names, self.command, strict=True)}
        return oracle_of(self.twin(**numbers)), self.there(self.state, *self.applied)

    def exact(self, lags, dt):
        """Return the state at a step's end, the controls there, and their means."""
        oracle, start = self.oracle(lags)
        end = [float(x) for x in agreed_end(oracle, start, [], dt, 25)]
        moved = end[-4:][: 2 * len(lags)]
        return [*self.back(end), *moved[1::2], *(float(x) / dt for x in self._travel(moved[::2]))]

    def _travel(self, places):
        return [x - (self.state[2] if self.twin is TurnThere else 0.0) for x in places]

    def step(self, lags, dt, order=None, tolerance=None):
        """Return the same from the engine, and the number of attempts."""
        code, numbers = code_of(self.scene)
        advance = code.compile(*([tolerance] if tolerance else []), bounds=True)
        given = [*self.state, *self.applied, *self.command, *(1.0 / lag for lag in lags)]
        rows = np.zeros(code.scratch)
        *found, status = advance(rows, *given, dt, float(order or general.usual_order(dt)), *numbers)
        return np.array(found), status, rows[-2 * code.record.size :]


def code_of(scene, fused=True):
    constants = motion_constants_of(scene, lagged=True)
    code = lagged_stepper(scene.mechanics).code(absent_from(constants), fused)
    return code, [constants[name.removeprefix("k_")] for name in code.constants]


SLOPE = {"damping": 0.5}
CASES = {
    "bar": Case(PivotedBar(damping=0.001), BarThere, [0.1, -0.4, 2.0, 3.0], [-3.0], [10.0]),
    "cart": Case(CartPole(), CartThere, [0.1, -0.4, 2.0, 3.0], [6.0], [-10.0]),
    "arm": Case(TwoLinkArm(damping=0.1), ArmThere, [0.5, -2.0, 1.0, 4.0], [3.0, 1.0], [-5.0, 2.0]),
    "drag": Case(Incline(**SLOPE), DragThere, [0.1, 1.5], [0.2], [4.0]),
    "tilt": Case(Incline(**SLOPE, control="tilt"), TiltThere, [0.1, -0.5], [-0.3], [0.5]),
    "turn": Case(
        Incline(**SLOPE, control="tilt_rate"), TurnThere, [0.4, -0.5, 0.2], [-1.0], [3.0],
        lambda y, a: [y[0], y[1] - 0.05 * a, y[2], a, 0.0, 0.0],
        lambda y: [y[0], y[1] + 0.05 * y[3], y[2]],
    ),
}  # fmt: skip


def worst(case, lags, dt):
    """Return the largest error of a control step, relative to the entry or to 1."""
    exact = np.array(case.exact(lags, dt))
    found, status, _ = case.step(lags, dt)
    assert status > 0
    return np.max(np.abs(found - exact) / np.maximum(1.0, np.abs(exact)))


@pytest.mark.parametrize("name", ["bar", "arm", "turn"])
def test_step_is_that_of_a_system_with_actuators(name):
    case = CASES[name]
    lags = [0.013, 0.05][: len(case.applied)]
    assert worst(case, lags, 0.02) < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("part", [1e-3, 0.05, 0.3, 1.0, 2.5, 40.0, 1e3, 1e6])
@pytest.mark.parametrize("name", CASES)
def test_step_at_any_lag(name, part, dt):
    case = CASES[name]
    lags = [part * dt, 3.0 * part * dt][: len(case.applied)]
    assert worst(case, lags, dt) < LARGEST_ERROR


# --- any scene, compared with itself ------------------------------------------------------------------------


def in_pieces(scene, state, applied, command, lag, dt, pieces):
    """Return the end of a step in which each piece has the mean of the lagged control held."""
    times = np.linspace(0.0, dt, pieces + 1)[:, None]
    gap = np.array(applied) - command
    means = command - gap * np.diff(np.exp(-times / lag), axis=0) * lag * pieces / dt
    return scene.simulate(state, means, dt / pieces)[-1]


@pytest.mark.parametrize(
    ("scene", "state", "applied", "command"),
    [
        (Trolley(), [0.2, 0.1, 1.0, 3.0, -0.5, -2.0], [0.7, 0.2, 0.3], [-0.8, 0.5, -2.0]),  # two rates
        pytest.param(
            *(Functions(), [0.4, 0.3, 0.2, -0.5], [0.5, 1.0], [-0.3, -2.0]),  # a place
            marks=pytest.mark.slow,
        ),
        slow(Chain(bars=2), [0.0, 0.1, 1.0, 2.0, -1.0, 3.0], [3.0], [-5.0]),
    ],
    ids=["Trolley", "Functions", "Chain"],
)
def test_lag_is_the_limit_of_many_held_pieces(scene, state, applied, command):
    lag, dt = 0.03, 0.02
    found = scene.simulate(state, [command], dt, lag=lag, applied=applied)[1]
    held = [
        in_pieces(scene, state, np.array(applied), np.array(command), lag, dt, pieces)
        for pieces in (8, 16, 32, 64)
    ]
    while len(held) > 1:  # errors are even powers of the pieces' length
        power = 4.0 ** (5 - len(held))
        held = [(power * b - a) / (power - 1.0) for a, b in itertools.pairwise(held)]
    np.testing.assert_allclose(found, held[0], rtol=0, atol=1e-11)
    assert np.abs(found - scene.simulate(state, [command], dt)[1]).max() > 1e-4


# --- the certificate ----------------------------------------------------------------------------------------


def test_fading_in_every_range():
    trace = ElementaryTrace()
    results = fading(trace.inputs("x")[0], trace)
    operations, names = trace.operations(results, fused=False)
    generator = np.random.default_rng(1)
    with mpmath.workdps(40):
        for x in [0.0, 5e-324, 1e-9, 0.999999, 1.0, 1e3, 1e300, *10.0 ** generator.uniform(-12, 3, 200)]:
            known = evaluate_operations(operations, {"x": float(x)})
            exact = mpmath.mpf(float(x))
            once = -mpmath.expm1(-exact) / exact if x else mpmath.mpf(1)
            # 1 - φ₁ cancels for small x
            twice = (1 - once) / exact if x > 1e-3 else mpmath.hyp1f1(1, 3, -exact) / 2
            for name, value in zip(names, (mpmath.exp(-exact), once, twice), strict=True):
                assert abs(known[name] - value) <= 5e-16 * value + mpmath.mpf(5e-324)


def test_tail_of_an_exponential_is_bounded():
    code, _ = code_of(PivotedBar())
    series, order = Series(code.record), 12
    (node,) = [n for n, node in enumerate(code.record.nodes) if node.op == "decay"]
    found = []
    for z in [0.01, 0.5, 3.0, 6.4, 6.6, 30.0, 300.0]:
        for part in [None, 0.3, 0.01]:
            t = Plain(series.slots)
            given = dict.fromkeys(code.record.inputs, 1.0)
            given |= {"decay_s_ddot": z, "clock_elapsed": 0.0, "gap_s_ddot": -3.0, "command_s_ddot": 2.0}
            start = series.expand(t, given, [0.5], [1.0], 1.0, order)
            certificate = Certificate(series, t, start, 1.0, order, 1e-14)
            certificate.check(*([] if part is None else [part, part**order]))
            z_part = z * (part or 1.0)
            exact = 3 * (mpmath.gammainc(order, 0, z_part, regularized=True)) * mpmath.exp(z_part)
            found.append(certificate._tails[node] / exact)
    assert min(found) > 1.0 - 1e-12
    assert max(found[:9]) < 1.5  # of z up to 3


def tails(case, lags, h, order):
    """Return the truncation errors of places and velocities beyond an order, from series in 40 digits."""
    oracle, start = case.oracle(lags)
    found = oracle.coefficients(start, [], h, order + 20, 45)
    free = layout_of(case.scene).free
    with mpmath.workdps(40):
        return [
            float(sum(abs(c) for c in of[name][order + more :]))
            for more, of in zip((2, 1), found, strict=True)
            for name in free
        ]


def check_certificate(name, count):
    case, generator, found = CASES[name], np.random.default_rng(2), []
    while len(found) < count:
        order, tolerance = [(6, 1e-5), (9, 1e-14), (12, 1e-9)][generator.integers(3)]
        h = 10.0 ** generator.uniform(-3, -0.7)
        lags = (h * 10.0 ** generator.uniform(-0.7, 1.5, len(case.applied))).tolist()
        case = case._replace(command=generator.uniform(-3.0, 3.0, len(case.applied)).tolist())
        _, status, bounds = case.step(lags, h, order, tolerance)
        if status == 1:
            found += [true / bound for true, bound in zip(tails(case, lags, h, order), bounds, strict=True)]
    assert max(found) < 1.0
    assert np.median(found) > 1e-3


def test_certificate_bounds_the_tail_behind_an_actuator():
    check_certificate("bar", 12)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_certificate_bounds_the_tail_behind_any_actuator(name):
    check_certificate(name, 150)


# --- every form of the code ---------------------------------------------------------------------------------

TROLLEY = Trolley(), [0.2, 0.1, 1.0, 9.0, -0.5, -8.0], [0.7, 0.2, 0.3], [-0.8, 0.5, -2.0], [0.01, 0.05, 0.004]


def rows_of(scene, state, applied, commands, lags, fused=True, compiled=True):
    """Return states and applied controls of several steps."""
    code, numbers = code_of(scene, fused)
    trajectory = np.zeros((len(commands) + 1, len(state) + len(applied)))
    trajectory[0] = [*state, *applied]
    given = np.array([[*command, *(1.0 / lag if lag else 0.0 for lag in lags)] for command in commands])
    run = code.compile_simulate()
    if not compiled:
        trajectory, given = trajectory.astype(object), given.astype(object)
    assert not run(trajectory, given, 0.04, 10, *numbers)
    return trajectory.astype(float)


def test_unfused_bits_are_those_of_plain_numbers(monkeypatch):
    scene, state, applied, command, lags = TROLLEY
    compiled = rows_of(scene, state, applied, [command] * 2, lags, fused=False)
    monkeypatch.setattr(compiling, "compile_function", in_python)
    monkeypatch.setattr(driver, "compile_advance", advance_in_python)
    python = rows_of(scene, state, applied, [command] * 2, lags, fused=False, compiled=False)
    np.testing.assert_array_equal(compiled, python)


def test_lanes_of_a_block_have_the_bits_of_a_single_one():
    case, generator, dt, order = CASES["cart"], np.random.default_rng(3), 0.02, 16
    code, numbers = code_of(case.scene)
    layout, n = LaneLayout(code.record), code.record.size
    stepper = LaggedStepper(case.scene.mechanics)
    constants = motion_constants_of(case.scene, lagged=True)
    advance, xp = code.compile(), types.SimpleNamespace(where=lambda c, a, b: a if c else b)
    memory, alone = np.zeros((2 * layout.bounds + 1, BLOCK)), []
    memory[layout.span] = dt
    for lane in range(30):
        state = generator.uniform(-1.0, 1.0, 4) * [1.0, 3.0, 3.1, 9.0]
        lag = 10.0 ** generator.uniform(-4, 3)
        u = [*generator.uniform(-10.0, 10.0, 2), 1.0 / lag if lane else 0.0]
        given = constants | stepper.prepare(xp, state.tolist(), u, constants)
        for row, name in enumerate([*layout.inputs, *(f"{x}{i}" for x in "qv" for i in range(n))]):
            memory[row, lane] = given[name]
        *end, _, _, status = advance(np.zeros(code.scratch), *state, *u, dt, float(order), *numbers)
        alone.append([end[0], end[2], end[1], end[3], status])
    compile_advance_block(code.record)(memory.reshape(-1), 0, 30, order)
    np.testing.assert_array_equal(memory[layout.q : layout.status + 1, :30].T, alone)
    assert len({row[-1] for row in alone}) > 3


def test_pieces_of_a_step_are_the_step():
    case = CASES["arm"]
    code, numbers = code_of(case.scene)
    advance, decays = code.compile(), [40.0, 90.0]
    whole, _, _ = case.step([1.0 / d for d in decays], 0.02)
    y, u, total = case.state, case.applied, np.zeros(2)
    for h in (0.0131, 1e-7, 0.02 - 0.0131 - 1e-7):
        rows = np.zeros(code.scratch)
        *found, status = advance(rows, *y, *u, *case.command, *decays, h, 16.0, *numbers)
        y, u, means = found[:4], found[4:6], found[6:]
        total += h * np.array(means)
        assert status > 0
    np.testing.assert_allclose([*y, *u, *(total / 0.02)], whole, rtol=1e-13)


def test_control_without_lag_is_held():
    scene, state, _, command, _ = TROLLEY
    path = scene.simulate(state, [command], 0.02, lag={"s_dot": 0.0, "motor": 1e-3}, applied=[0, 0, 0.3])
    short = scene.simulate(state, [command], 0.02, lag={"motor": 1e-3}, applied=[0, 0, 0.3])
    np.testing.assert_array_equal(path, short)
    held = in_pieces(scene, state, np.array([*command[:2], 0.3]), np.array(command), 1e-3, 0.02, 2000)
    np.testing.assert_allclose(path[1], held, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(
        scene.simulate(state, [command], 0.02, lag=0.0), scene.simulate(state, [command], 0.02)
    )


@pytest.mark.parametrize("name", ["bar", *(slow(name) for name in CASES if name != "bar")])
def test_shortest_and_longest_lag(name):
    case = CASES[name]
    scene, commands = case.scene, [case.command] * 3
    first = [*case.command] if name == "turn" else case.applied  # a jump of a rate moves w's place at once
    at_once = scene.simulate(case.state, commands, 0.02)
    short = scene.simulate(case.state, commands, 0.02, lag=2e-8, applied=first)
    np.testing.assert_allclose(short, at_once, rtol=0, atol=1e-5)
    never = scene.simulate(case.state, [case.applied] * 3, 0.02)
    long = scene.simulate(case.state, commands, 0.02, lag=1e12, applied=case.applied)
    np.testing.assert_allclose(long, never, rtol=0, atol=1e-11)


def test_bound_of_a_lagged_step():
    scene = PivotedBar()
    bound = scene.step_bound([0.0, 0.0, 2.0, 3.0], 10.0, 0.02, lag=0.02, applied=-3.0)
    assert bound.kind == "proved with the step"
    assert bound.substeps == 2
    assert 0.0 < bound.bounds["theta_dot"] < 1e-12
    assert bound.bounds["s_dot"] == 0.0  # in closed form


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"lag": -1.0}, "lag must be 0 or at least 1e-06 times the step of 0.02 s, got -1 s"),
        (
            {"lag": 1e-9},
            "lag must be 0 or at least 1e-06 times the step of 0.02 s, got 1e-09 s; 0 means no lag",
        ),
        ({"lag": math.nan}, "lag must be finite, got nan"),
        ({"lag": "0.1"}, "lag must be a real number, got '0.1'"),
        ({"lag": {"wrist": 0.1}}, r"lag\['wrist'\]: there is no such control, only shoulder, elbow"),
        ({"lag": {"elbow": math.inf}}, r"lag\['elbow'\] must be finite, got inf s"),
        ({"lag": 0.1, "applied": 1.0}, r"applied must be \(shoulder, elbow\), got an array of shape \(\)"),
        ({"lag": 0.1, "applied": [1.0, math.inf]}, "applied must be finite, got inf for elbow"),
        ({"lag": {"elbow": 0.1}, "applied": [1.0, 0.0]}, "shoulder does not lag, so it cannot start at 1"),
        ({"applied": [0.0, 2.0]}, "elbow does not lag, so it cannot start at 2; give 0"),
    ],
)
def test_bad_lag_is_named(given, message):
    with pytest.raises(ValueError, match=message):
        TwoLinkArm().simulate([0.0] * 4, [[0.0, 0.0]], 0.02, **given)


def test_scene_without_controls_cannot_lag():
    with pytest.raises(ValueError, match=r"lag=0\.1: this scene has no control that could lag"):
        BarThere().simulate([0.0] * 8, 3, 0.02, lag=0.1)


def test_refusal_brings_what_went_before():
    bar = PivotedBar(damping=1e6, track=None)  # without lag, a closed form handles this
    assert np.isfinite(bar.simulate([2.0, 0.0], [1.0, 2.0], 0.02)).all()
    with pytest.raises(StepRefused, match=r"step 0 of 2 .* could not be certified") as refusal:
        bar.simulate([2.0, 0.0], [1.0, 2.0], 0.02, lag=0.1)
    np.testing.assert_array_equal(refusal.value.trajectory, [[2.0, 0.0]])


# --- environments -------------------------------------------------------------------------------------------


def behind(u, command, lag, h):
    """Return the place of a control that follows its command for a time, and its mean."""
    left = math.exp(-h / lag)
    return command + (u - command) * left, command + (u - command) * lag * (1.0 - left) / h


DRAWN = {"randomize": {"damping": (0.1, 10), "com_distance": (0.5, 2)}}


@pytest.mark.parametrize(("late", "more"), [slow(0.0, {}), (0.013, {}), slow(0.013, DRAWN)])
def test_environment_against_simulate(late, more):
    lag, dt = 0.03, 0.02
    env = gym.make("PivotedBar-v0", lag=lag, action_delay=late, **more)
    env.reset(seed=3, options={"state": [0.3, 0.1, 2.0, -3.0]})
    own, task = env.unwrapped, env.unwrapped.drawn_task
    scene = task.scene
    assert own.control == 0.0
    state, applied, sent = own.state, 0.0, 0.0
    numbers = task.formulas.constants()
    for action in np.random.default_rng(1).uniform(-1, 1, (25, 1)).astype(np.float32):
        _, reward, *_ = env.step(action)
        mean = 0.0
        for h, wanted in ((late, sent), (dt - late, 5.0 * float(action[0]))):
            if h > 0.0:
                k = types.SimpleNamespace(**numbers | {"dt": h})
                (command,) = task.formulas.guarded(np, [wanted], form_of(scene).lift(state), k)
                state = scene.simulate(state, [command], h, lag=lag, applied=applied)[1]
                applied, part = behind(applied, command, lag, h)
                mean += part * h / dt
        sent = 5.0 * float(action[0])
        assert own.state == pytest.approx(state, abs=1e-11)
        assert own.control == pytest.approx(applied, abs=1e-12)
        height = (0.5 - 0.5 * math.cos(state[2])) ** 2
        assert reward == pytest.approx(height - 0.02 * (mean / 5) ** 2, abs=1e-11)


def test_what_overruns_its_guard_is_clipped_in_the_observation():
    # The guard limits the command. The delayed motion may leave the track, but not the observation's space.
    env = gym.make("PivotedBar-v0", lag=0.3)
    env.reset(seed=0)
    places = []
    for _ in range(60):
        observation, *_ = env.step(np.ones(1, np.float32))
        assert env.observation_space.contains(observation)
        places.append(env.unwrapped.state[0])
    assert max(places) > 0.5


@pytest.mark.slow
def test_one_control_of_several_lags():
    spec = lag_envs.register(own_tasks.Deliver)
    _, envs = played(spec, 3, 60, lag={"pull": 0.05}, action_delay=0.013)
    assert envs.unwrapped.order == general.usual_order(0.05)
    env = gym.make(spec, lag={"pull": 0.05})
    env.reset(seed=1)
    pull = 0.0
    for action in np.random.default_rng(2).uniform(-1, 1, (10, 2)).astype(np.float32):
        roped = env.unwrapped.state[env.unwrapped.scene.state_names.index("rope")] < 0.3
        env.step(action)
        command = 0.0 if roped else 10.0 + 10.0 * float(action[1])
        pull, _ = behind(pull, command, 0.05, 0.05)
        assert env.unwrapped.control == pytest.approx([20.0 * float(action[0]), pull], abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("more", "command"), [({}, 5), ({"action_delay": 0.01}, 0)])
def test_refused_step_leaves_the_environments_as_they_were(more, command):
    keywords = {"lag": 0.05, "damping": 1e6, "max_episode_steps": 500} | more
    env, envs = gym.make("PivotedBar-v0", **keywords), gym.make_vec("PivotedBar-v0", num_envs=2, **keywords)
    env.reset(seed=0, options={"state": [0.0, 0.0, 2.0, 1.0]})
    envs.reset(seed=0)
    with pytest.raises(StepRefused, match="could not be certified"):
        env.step(np.ones(1, np.float32))
    np.testing.assert_array_equal(env.unwrapped.state, [0.0, 0.0, 2.0, 1.0])
    assert env.unwrapped.control == 0.0
    before = envs.unwrapped.state
    with pytest.raises(StepRefused, match=rf"s_ddot={command} and .* could not be certified"):
        envs.step(np.ones((2, 1), np.float32))
    np.testing.assert_array_equal(envs.unwrapped.state, before)
    np.testing.assert_array_equal(envs.unwrapped.control, [0.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [arm.Reach.id, "PivotedBar-v0"])
@pytest.mark.parametrize("more", [{}, {"action_delay": 0.013}])
def test_a_batch_has_an_order_and_snapshots(env_id, more):
    envs = LagrangianVectorEnv(type("Other", (TASKS[env_id],), {"order": 12}), 3, lag=0.03, **more)
    envs.reset(seed=0)
    assert envs.order == 12
    actions = [envs.action_space.sample() for _ in range(6)]
    envs.step(actions[0])
    snapshot = envs.get_state()
    first = [envs.step(action)[:2] for action in actions]
    envs.set_state(snapshot)
    for one, action in zip(first, actions, strict=True):
        for a, b in zip(one, envs.step(action), strict=False):
            np.testing.assert_array_equal(a, b)


# --- documentation ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_numbers_in_the_documentation():
    path = Path(__file__).parents[1] / "docs" / "engine.md"
    text = " ".join(path.read_text(encoding="utf-8").replace("$", "").replace(r"\tau", "τ").split())
    counts = [
        [case.step([part * 0.02] * len(case.applied), 0.02)[1] for case in CASES.values()]
        for part in (1.0, 0.1, SMALLEST_LAG)
    ]
    spans = [f"{min(span)} to {max(span)}" for span in counts]
    smallest = f"{SMALLEST_LAG:.0e}".replace("e-0", "e-")
    said = [
        f"a substep is at most {REACH:g}τ longer than the time that has passed",
        f"six scenes take {spans[0]} attempts at τ = dt = 0.02 s, {spans[1]} at τ = dt/10, and",
        f"and {spans[2]} at τ = {smallest} dt",
        f"at least {smallest} of the control step",
        f"below {LARGEST_ERROR:g} of the entry",
    ]
    assert [words for words in said if words not in text] == []
