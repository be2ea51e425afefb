"""Steps of the package's scenes against 40-digit references: one step, hard cases, long runs, backends."""

import contextlib
import math
import os
import subprocess
import sys
import time
from functools import cache
from itertools import product

import gymnasium as gym
import numpy as np
import pytest
from covering import PERFECT, covering, slow
from mpmath import mp, mpf
from reference import (
    EPS,
    VARIANTS,
    conditioning,
    flow,
    linear,
    moving_plane,
    random_cases,
    scales,
)
from rollouts import numbers_of_choices
from scipy.integrate import solve_ivp

from lag_envs import scenes
from lag_envs.report import reference as exact_ends
from lag_envs.report.bound import driven
from lag_envs.report.closed_forms import elliptic
from lag_envs.report.oracle import oracle_of
from lag_envs.scenes import CylinderInCylinder, Incline, PivotedBar, Scene, StepRefused, parameter
from lag_envs.scenes.derivation import form_of, motion_constants_of
from lag_envs.stepping import pendulum, slope
from lag_envs.stepping.compiling import absent_from
from lag_envs.stepping.flow_code import flow_code
from lag_envs.stepping.pendulum import Coefficients
from lag_envs.stepping.slope import FixedSlope, TurningSlope
from lag_envs.tasks import TASKS

KINDS = "task", "damped", "stiff", "extreme"


@pytest.fixture(autouse=True)
def precise():
    with mp.workdps(60):
        yield


def coefficients(scene):
    """Return the coefficients of bar and shell, typed in from their equations of motion."""
    if isinstance(scene, PivotedBar):
        arm, inertia = scene.mass * scene.com_distance, scene.mass * scene.com_distance**2 + scene.inertia
        return {
            "weight": arm * scene.gravity / inertia, "pull": arm / inertia, "drag": scene.damping / inertia
        }  # fmt: skip
    ratio = scene.inertia / (scene.mass * scene.radius**2)
    arm, rolling = scene.shell_radius - scene.radius, 1.0 / (1.0 + ratio)
    per_damping = rolling / (scene.mass * arm**2)
    return {
        "weight": rolling * scene.gravity / arm, "drag": scene.damping * per_damping, "brake": per_damping,
        "push": rolling * ratio * scene.shell_radius / arm,
    }  # fmt: skip


def operations(scene):
    """Return the number of operations of an ordinary step."""
    return flow_code(form_of(scene), 0.02, absent_from(motion_constants_of(scene))).operations


def advance_of(scene, dt):
    """Return the scene's compiled step, and its arguments after state, control and step."""
    constants = motion_constants_of(scene)
    code = flow_code(form_of(scene), dt, absent_from(constants))
    return code.compile(), [form_of(scene).largest_majorant(dt), *(v for v in constants.values() if v)]


# --- certified steps ---


def test_every_task_is_one_certified_step():
    """At the corners of TASKS' ranges of state and control one step is enough, to 1e-12 in theta'.

    With a long control step, or a strong brake, it may take two.
    """
    pendulums = set()
    for name, kind in TASKS.items():
        task = kind()
        for case in corners(task) if task.certified_speed() is not None else ():
            bound = task.scene.step_bound(*case, task.dt)
            if bound.order:
                pendulums.add(name)
                easy = task.dt < 0.03 and isinstance(task.scene, PivotedBar)
                assert bound.substeps <= (1 if easy else 2), (name, case)
                speed = abs(case[0][form_of(task.scene).angle + 1])
                size = 1.0 if bound.substeps == 1 else max(1.0, speed)
                assert 0.0 < bound.bounds["theta"] < bound.bounds["theta_dot"] <= 1e-12 * size, (name, case)
    assert len(pendulums) == 9


PENDULUMS = {
    "bar": PivotedBar(track=None),
    "damped bar": PivotedBar(mass=0.2, com_distance=0.3, damping=0.001, track=None),
    "short bar with a track": PivotedBar(com_distance=0.1, damping=1e-4),
    "bar without gravity": PivotedBar(gravity=0.0, track=None),
    "shell": CylinderInCylinder(),
    "damped shell": CylinderInCylinder(damping=0.24),
    "shell, drag": CylinderInCylinder(control="damping"),
}


@pytest.mark.parametrize("name", PENDULUMS)
@pytest.mark.parametrize("dt", [slow(0.002), 0.02, slow(0.05), 0.3])
def test_one_substep_leaves_out_no_more_than_the_tolerance(name, dt):
    """Walk the speed: one substep up to the certified speed, within 1e-12 rad/s; several within the size."""
    scene = PENDULUMS[name]
    tolerance, place = pendulum.TOLERANCE, form_of(scene).angle + 1
    state = np.linspace(0.3, 1.0, len(scene.state_names))
    advance, numbers = advance_of(scene, dt)
    reached = set()
    for u in (0.0, 5.0, 200.0):
        certified = form_of(scene).certified_speed(state, [u], dt, motion_constants_of(scene))
        field = math.hypot(*form_of(scene).coefficients(state, [u], motion_constants_of(scene))[:2])
        near = max(certified, 0.0)
        walk = {near, near * (1.0 + 1e-12), near + 0.01, 1.1 * near, *np.linspace(0.0, 40.0, 300)}
        walk |= {*np.linspace(0.5 * near, 2.0 * near, 100)}
        for speed in walk:
            state[place] = speed * (1.0 if u else -1.0)
            bound = scene.step_bound(state, u, dt)
            assert (bound.substeps == 1) == (speed <= certified), speed
            size = 1.0 if bound.substeps == 1 else max(1.0, speed, math.sqrt(field))
            assert bound.bounds["theta_dot"] <= tolerance * size, (speed, bound)
            reached.add(bound.substeps)
        for speed in (0.999 * near, 1.001 * near + 1e-3):
            state[place] = speed
            *_, taken = advance(*map(float, form_of(scene).lift(state)), u, dt, *numbers)
            expected = scene.step_bound(state, u, dt).substeps
            assert taken == expected or (expected > 500 and 1 < taken < expected)  # along the slow manifold
    assert {1, 2} <= reached or dt > 0.02


def corners(task):
    """Return the fastest states and strongest controls of a task."""
    form, reach = form_of(task.scene), task.examples.reach
    (low,), (high,) = task.control_range
    angle = None if task.certified_speed() is None else form.angle
    for edge, speed, control in product(task.edges, (-reach, reach), (low, high)):
        for place in (0.0, 1.5, math.pi) if angle is not None else (0.0,):
            state = list(edge)
            if angle is not None:
                state[angle], state[angle + 1] = place, speed
            yield state, control


@cache
def body(kind, **parameters):
    return getattr(scenes, kind)(**parameters)


def one_step(case):
    """Return the step's error over 1e-12 scale and over eps cond + 1e-12 scale; None if refused.

    cond counts roundings of state, control and parameters: the scene's constants are floats made from them.
    """
    arguments = [case[k] for k in ("scene", "params", "state", "control", "dt")]
    scene = body(case["scene"], **case["params"])
    try:
        end = scene.simulate(case["state"], [case["control"]], case["dt"])[1]
    except StepRefused as error:
        assert np.array_equal(error.trajectory, [case["state"]])
        return None
    errors = [abs(mpf(float(a)) - b) for a, b in zip(end, flow(*arguments, dps=30), strict=True)]
    sizes = scales(*arguments)
    plain = max(float(e) / (1e-12 * s) for e, s in zip(errors, sizes, strict=True))
    if plain < 0.1:
        return plain, plain
    amplified = conditioning(*arguments, include_params=True)
    shares = zip(errors, sizes, amplified, strict=True)
    return plain, max(float(e) / (EPS * a + 1e-12 * s) for e, s, a in shares)


# --- one step against the reference ---


@pytest.mark.parametrize(
    ("kind", "n", "seed", "allowed"),
    [("task", 60, 21, 1e-3), ("damped", 48, 22, 1e-2), ("stiff", 36, 23, 1e-2)],
)
def test_one_step(kind, n, seed, allowed):
    """Errors over 1e-12 max(1, ...): 2e-16 on the tasks, 1e-15 with drag up to gamma dt = 1e6."""
    for case in random_cases(kind, n, seed):
        assert one_step(case)[0] < allowed, case


@pytest.mark.slow
def test_one_step_of_extremes():
    """Full accuracy or a refusal; measured with the system's own amplification of the state's rounding."""
    refused = 0
    for case in random_cases("extreme", 36, 24):
        error = one_step(case)
        refused += error is None
        assert error is None or error[1] < 10.0, case
    assert refused <= 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_one_step_of_many(kind, capsys):
    """The same for 300 cases of each kind, and the largest error of each scene."""
    worst = {}
    for case in random_cases(kind, 300, 31):
        error = one_step(case)
        key = case["scene"], case["control_kind"]
        entry = worst.setdefault(key, [0.0, 0.0, 0])
        if error is None:
            entry[2] += 1
        else:
            entry[:2] = map(max, entry[:2], error)
    with capsys.disabled():
        print(f"\n{kind}: largest error / (1e-12 scale), / (eps cond + 1e-12 scale), refused")
        for key, (plain, share, refused) in worst.items():
            print("   ", *key, f"{plain:.1e} {share:.1e} {refused}")
    assert set(worst) == set(VARIANTS)
    allowed = {"task": 1e-3, "extreme": 10.0}.get(kind, 0.1)
    assert max(e[0 if kind != "extreme" else 1] for e in worst.values()) < allowed


@cache
def any_pendulum():
    return pendulum.compile_flow()


def pendulum_errors(theta, omega, drive, dt):
    """Return errors of theta and theta' as shares of their limits, and the substeps."""
    c, s = math.cos(theta), math.sin(theta)
    x = pendulum.largest_majorant(dt)
    *end, substeps = any_pendulum()(theta, omega, c, s, *map(float, drive), dt, x)
    scene, control = driven(drive)
    exact = exact_ends.once(oracle_of(scene), [0.0, 0.0, theta, omega], control, dt, 40)[2:]
    field = math.hypot(drive.alpha, drive.beta)
    size = (
        max(1.0, abs(theta), abs(omega) * dt, abs(end[0])),
        max(1.0, abs(omega), math.sqrt(field), abs(end[1])),
    )
    assert end[2:4] == pytest.approx([math.cos(end[0]), math.sin(end[0])], abs=1e-15 * size[0])
    return *(float(abs(a - b)) / (1e-12 * s) for a, b, s in zip(end[:2], exact, size, strict=True)), substeps


@pytest.mark.parametrize("decay", [79.0, *(slow(x) for x in (83.0, 110.0, 800.0))])
@pytest.mark.parametrize("share", [1.001e-3, slow(0.999e-3), slow(1e-5)])
def test_heavy_damping_at_its_thresholds(decay, share):
    """field = share gamma², gamma dt = decay: on both sides of where the slow manifold is used."""
    dt = 0.02
    gamma = decay / dt
    field = share * gamma * gamma
    for omega in (0.0, -1e6):
        for theta, parts in (
            (2.0, (1.0, 0.0, 0.0, 0.0)),
            (-1.0, (0.0, -1.0, 0.0, 0.0)),
            (3.1, (0.3, 0.3, 0.4, 0.0)),
            (1.0, (0.2, -0.3, 0.0, 0.5)),
            (0.5, (0.0, 0.0, -1.0, 0.0)),
        ):
            a, b, d, r = (field * part for part in parts)
            *errors, _ = pendulum_errors(theta, omega, Coefficients(a, b, gamma, d, r / dt), dt)
            assert max(errors) < 0.1, (omega, parts)


@pytest.mark.parametrize("share", [0.2e-2, 0.999e-2, 1.001e-2])
@pytest.mark.parametrize("decay", [90.0, slow(800.0)])
def test_heavy_damping_of_a_fast_drive(decay, share):
    """drive = share gamma², the field much smaller: it turns the pendulum round and round."""
    dt = 0.02
    gamma = decay / dt
    push = share * gamma * gamma
    for field in (1e-4 * push, 0.05 * push):
        for d, r in ((1.0, 0.0), (-0.3, 0.7)):
            drive = Coefficients(field, -0.5 * field, gamma, d * push, r * push / dt)
            *errors, substeps = pendulum_errors(0.4, -2.0, drive, dt)
            assert max(errors) < 1e-2 and substeps > 1


@pytest.mark.parametrize("dt", [1.0, slow(0.1), 0.02])
@pytest.mark.parametrize("spin", [100.0, 1e4, *(slow(x) for x in (333.0, 700.0, 1650.0, 2500.0))])
@pytest.mark.parametrize("control", [0.0, -3000.0])
def test_heavy_drag_in_a_turning_shell(spin, dt, control):
    """Without gravity the motion is linear, whatever the shell's rate: θ = ψ' (t - (1 - e^(-Γt))/Γ)."""
    for decay in (1e6, 1e4, 1e2):
        shell = CylinderInCylinder(damping=0.24 * decay / dt, gravity=0.0)
        end = shell.simulate([0.3, 0.0, spin], [control], dt)[1]
        params = {
            name: getattr(shell, name) for name in ("mass", "shell_radius", "radius", "inertia", "damping")
        }
        given = {**params, "gravity": 0.0, "control": "tilt"}
        exact = flow("CylinderInCylinder", given, (0.3, 0.0, spin), control, dt)
        for value, truth in zip(end, exact, strict=True):
            assert abs(value - truth) < 3e-15 * max(1, abs(truth)), decay


def turned_by_gravity(k, spin, dt):
    """Return by how much gravity moves the cylinder in a shell with heavy drag, to first order in it [rad].

    ε'' + Γε' = -α sinθ along θ = ψ' (t - (1 - e^(-Γt))/Γ), so ε = -α ∫ (1 - e^(-Γ(T-t)))/Γ sinθ dt.
    """
    alpha, drag = k["weight"], k["drag"]
    layer = 50.0 / drag
    ends = np.array([0.0, *np.linspace(layer, dt - layer, 2 + int(2.0 * spin * dt)), dt])
    ends = np.unique([*ends, *np.linspace(0.0, layer, 30), *np.linspace(dt - layer, dt, 30)])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half = 0.5 * np.diff(ends)[:, None]
    t = ends[:-1, None] + half * (1.0 + nodes)
    theta = spin * (t + np.expm1(-drag * t) / drag)
    return alpha / drag * float(np.sum(half * weights * np.expm1(-drag * (dt - t)) * np.sin(theta)))


@pytest.mark.parametrize("spin", [100.0, 700.0, 2500.0])
@pytest.mark.parametrize("gravity", [9.81, 1e-3, 1e-25])
def test_heavy_drag_in_a_turning_shell_with_gravity(spin, gravity):
    """Gravity's part by quadrature; its truncation error is of the order of (α/Γ)²/ψ' dt."""
    for dt, decay in ((1.0, 1e6), (0.3, 1e6), (0.02, 1e6), (0.02, 1e5)):
        shell = CylinderInCylinder(damping=0.24 * decay / dt, gravity=gravity)
        k = coefficients(shell)
        end = shell.simulate([0.0, 0.0, spin], [0.0], dt)[1]
        with mp.workdps(40):
            drag = mpf(k["drag"])
            free = mpf(spin) * (mpf(dt) - (1 - mp.exp(-drag * mpf(dt))) / drag)
            left_out = (k["weight"] / k["drag"]) ** 2 / spin * dt
            size = max(1.0, spin * dt)
            assert abs(end[0] - free - turned_by_gravity(k, spin, dt)) < 1e-15 * size + left_out
        assert end[1] == pytest.approx(spin, abs=2.0 * k["weight"] / k["drag"] + 1e-15 * spin)


def test_heavy_drag_in_a_turning_shell_against_collocation():
    """The same with gravity, rate and acceleration of the shell, by the oracle's collocation."""
    dt, spin, control = 0.02, 700.0, -2000.0
    shell = CylinderInCylinder(damping=0.24 * 1e6 / dt)
    end = shell.simulate([0.3, 0.0, spin], [control], dt)[1]
    exact = exact_ends.exact_flow(shell, [0.3, 0.0, spin], control, dt)
    for value, truth in zip(end, exact, strict=True):
        assert abs(value - truth) < 3e-15 * abs(truth)


@pytest.mark.parametrize("decay", [1e4, 1e6])
def test_very_heavy_damping(decay):
    dt = 0.05
    gamma = decay / dt
    for omega, field in ((1e4, 25.0), (-3.0, 5e3), (0.0, 1e-5 * gamma * decay)):
        *errors, substeps = pendulum_errors(
            2.5, omega, Coefficients(field, -0.5 * field, gamma, 0.3 * field, field / dt), dt
        )
        assert max(errors) < 1e-2
        assert 0 < substeps < 1000


@pytest.mark.parametrize(
    "decay", [0.0, 1e-300, 1e-12, 1e-6, 0.2499, 0.2501, 1.0, 1.499, 1.501, 30.0, 1e3, 1e6]
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_fixed_slope(decay, sign):
    """drag dt on both sides of each change of formula; a negative drag pushes."""
    if sign * decay < -700.0:
        return
    step = slope.compile_slide()
    for dt in (1e-6, 0.02, 1.0):
        for x, v, pull in ((0.3, -2.0, 5.0), (0.0, 0.0, 9.81), (1e3, 1e4, -0.1), (-1.0, 1.0, 0.0)):
            drag = sign * decay / dt
            *end, status = step(x, v, pull, drag, dt, 0.0)
            exact = linear(mpf(drag), mpf(pull), mpf(0), mpf(x), mpf(v), mpf(dt))
            growth = math.exp(max(0.0, -drag * dt)) * (1.0 + abs(drag * dt) * (sign < 0))
            size = (abs(x) + (abs(v) + abs(pull) * dt) * dt * growth, (abs(v) + abs(pull) * dt) * growth)
            assert status == 1
            for value, truth, scale in zip(end, exact, size, strict=True):
                assert abs(value - truth) <= 4e-16 * scale


@pytest.mark.parametrize("decay", [0.0, 1e-3, 0.124, 0.126, 3.0, 1e3, 1e6])
@pytest.mark.parametrize("rate", [0.0, 1e-300, -1e-12, 1e-3, 1.0, -40.0])
def test_turning_slope(decay, rate):
    """From a still plane to one that turns by 40 rad/s, on both sides of where short steps begin."""
    step = slope.compile_turn()
    k, gravity = 2.0 / 3.0, 9.81
    for dt in (0.02, 0.5):
        drag = decay / dt
        for x, v, phi in ((0.4, -1.0, 0.3), (-1.0, 0.0, -1.2)):
            *end, status = step(x, v, math.cos(phi), math.sin(phi), k, k * gravity, drag, rate, dt, 0.0)
            place, speed, tilt = moving_plane(
                *map(mpf, (k, drag, gravity, 0, rate)), map(mpf, (x, v, phi)), mpf(dt)
            )
            assert status == 1
            for value, truth in zip(end, (place, speed, mp.cos(tilt), mp.sin(tilt)), strict=True):
                assert abs(value - truth) <= 1e-14 * max(1, abs(truth))


def test_still_plane_is_the_fixed_one():
    plane = Incline(control="tilt_rate", damping=0.3).simulate([0.1, 0.2, 0.3], [0.0], 0.5)[1]
    fixed = Incline(control="tilt", damping=0.3).simulate([0.1, 0.2], [0.3], 0.5)[1]
    assert plane[:2] == pytest.approx(fixed, rel=1e-15)


@pytest.mark.parametrize("control", [-0.05, -3.0])
def test_negative_drag(control):
    """A drag that is the control may be negative; then it pushes, and the bound uses its size."""
    shell = CylinderInCylinder(control="damping")
    k = coefficients(shell)
    rows = shell.simulate([0.5, 0.2], [control] * 20, 0.02)

    def rhs(t, y):
        return [y[1], -k["weight"] * math.sin(y[0]) - k["brake"] * control * y[1]]

    exact = solve_ivp(rhs, (0.0, 0.4), [0.5, 0.2], "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    assert rows[-1] == pytest.approx(exact, rel=1e-10)
    with pytest.raises(StepRefused):
        shell.simulate([0.5, 0.2], [-1e8], 0.02)


BAR = {"mass": 1.0, "com_distance": 0.5, "inertia": 0.0, "track": None}
SHELL = {"mass": 1.0, "shell_radius": 0.5, "damping": 0.02}
HARD = {
    "drive of 1e6, damped": ("PivotedBar", {**BAR, "damping": 1.0}, (1.0, 0.0), 1e6, 0.01),
    "drive of 1e6 undamped": ("PivotedBar", BAR, (1.0, 0.0), 1e6, 1.0),
    "1e4 rad/s for a second": ("PivotedBar", BAR, (1.0, 1e4), 3.0, 1.0),
    "1e4 rad/s backwards": ("PivotedBar", BAR, (-math.pi, -1e4), 1e6, 0.1),
    "no gravity": ("PivotedBar", {**BAR, "gravity": 0.0}, (1.0, 2.0), 0.0, 1.0),
    "strong gravity": ("PivotedBar", {**BAR, "gravity": 1e3}, (math.pi, 0.0), 0.0, 0.5),
    "upright": ("PivotedBar", BAR, (math.pi, 0.0), 0.0, 1.0),
    "upright, tiny step": ("PivotedBar", BAR, (math.pi, 1.0), 1e6, 1e-6),
    "drive of 1e6, hardly damped": ("PivotedBar", {**BAR, "damping": 1e-3}, (1.0, 0.0), -1e6, 0.02),
    "short bar": ("PivotedBar", {**BAR, "com_distance": 1e-8}, (1.0, 3.0), 1.0, 0.01),
    "short bar for a second": ("PivotedBar", {**BAR, "com_distance": 1e-8}, (1.0, 3.0), 1.0, 1.0),
    "short bar that turns": ("PivotedBar", {**BAR, "com_distance": 3e-9}, (1.0, 2e5), -3.0, 0.3),
    "short bar, hardly damped": (
        "PivotedBar",
        {**BAR, "com_distance": 1e-7, "damping": 1e-14},
        (2.0, 3.0),
        1.0,
        0.001,
    ),
    "separatrix above": ("PivotedBar", BAR, (0.0, 2 * math.sqrt(9.81 / 0.5) * (1 + 1e-15)), 0.0, 1.0),
    "separatrix below": ("PivotedBar", BAR, (0.0, 2 * math.sqrt(9.81 / 0.5) * (1 - 1e-15)), 0.0, 1.0),
    "far angle": ("PivotedBar", BAR, (1e9, 3.0), 1.0, 0.02),
    "r near R": ("CylinderInCylinder", {**SHELL, "radius": 0.5 - 1e-9}, (1.0, 0.0, 2.0), 3.0, 1e-3),
    "r near 0": ("CylinderInCylinder", {**SHELL, "radius": 1e-9}, (1.0, 0.0, 2.0), 3.0, 0.5),
    "hoop, strong drive": (
        "CylinderInCylinder",
        {**SHELL, "radius": 0.1, "inertia": 0.01},
        (1.0, 0.0, 2.0),
        1e6,
        0.01,
    ),
    "point mass": (
        "CylinderInCylinder",
        {**SHELL, "radius": 0.1, "inertia": 0.0},
        (1.0, -4.0, 6.0),
        15.0,
        1.0,
    ),
    "r near R, a million substeps": (
        "CylinderInCylinder",
        {**SHELL, "damping": 0.0, "radius": 0.5 * (1 - 1e-9), "control": "damping"},
        (1.0, 3.0),
        0.0,
        1.0,
    ),
    "plane that turns fast": (
        "Incline",
        {"mass": 1.0, "radius": 0.05, "damping": 0.3, "control": "tilt_rate"},
        (0.3, -1.0, 0.2),
        -300.0,
        1.0,
    ),
}


#: These take seconds.
LONG = (
    "short bar, hardly damped",
    "hoop, strong drive",
    "plane that turns fast",
    "drive of 1e6, hardly damped",
    "drive of 1e6, damped",
)


# --- hard cases, and refusals ---


@pytest.mark.parametrize("name", [slow(name) if name in LONG else name for name in HARD])
def test_hard_case(name):
    """Accurate to a few roundings of state and parameters, however many substeps there are; and quick."""
    kind, params, state, control, dt = HARD[name]
    scene = body(kind, **params)
    took = []
    for _ in range(3):  # the first compiles
        began = time.process_time()
        end = scene.simulate(state, [control], dt)[1]
        took.append(time.process_time() - began)
    assert min(took) < 0.5
    arguments = kind, params, state, control, dt
    exact, amplified = flow(*arguments, dps=30), conditioning(*arguments, include_params=True)
    for value, truth, gain in zip(end, exact, amplified, strict=True):
        assert abs(value - truth) < 3 * EPS * max(1, gain, abs(truth))


@pytest.mark.parametrize(
    ("scene", "state", "control", "dt"),
    [
        (PivotedBar(track=None), (1.0, 1e7), 0.0, 1.0),
        (PivotedBar(track=None), (1.0, 1e300), 0.0, 1.0),
        (PivotedBar(track=None), (1.0, 0.0), 1e300, 0.02),
        (PivotedBar(track=None), (1.0, 0.0), 0.0, 1e300),
        (PivotedBar(), (1e308, 1e308, 0.0, 0.0), 0.0, 10.0),
        (CylinderInCylinder(control="damping"), (1.0, 0.0), 1e300, 0.02),
        (Incline(control="tilt_rate"), (1.0, 0.0, 0.0), 1e6, 1.0),
        (Incline(control="tilt_rate"), (1.0, 0.0, 0.0), 1e300, 1.0),
        (Incline(), (1e308, 1e308), 0.0, 10.0),
    ],
)
def test_refusal(scene, state, control, dt):
    """A refused step says so at once, keeps the results so far, and leaves the scene usable."""
    calm = np.full(len(state), 0.1)
    before = scene.simulate(calm, [0.0], 0.02)
    with contextlib.suppress(StepRefused):
        scene.simulate(state, [control], dt)  # compiles
    began = time.process_time()
    with pytest.raises(
        StepRefused, match=r"refused: from .* with \w+=\S+ and dt=.* more than 1,000,000 substeps"
    ) as error:
        scene.simulate(state, [control] * 3, dt)
    assert time.process_time() - began < 0.2
    assert np.array_equal(error.value.trajectory[0], state)
    assert np.isfinite(error.value.trajectory).all()
    assert np.array_equal(scene.simulate(calm, [0.0], 0.02), before)


def test_refused_step_keeps_the_rows_before():
    bar = PivotedBar(track=None)
    controls = [1.0, 2.0, 1e300, 1.0]
    with pytest.raises(StepRefused, match="step 2 of 4") as error:
        bar.simulate([1.0, 0.0], controls, 0.02)
    assert np.array_equal(error.value.trajectory, bar.simulate([1.0, 0.0], controls[:2], 0.02))


@pytest.mark.parametrize(
    ("state", "controls", "dt", "message"),
    [
        ([0.0, 0.0], [1.0, math.nan], 0.02, "controls must be finite, got nan in row 1"),
        ([0.0, 0.0], [math.inf], 0.02, "controls must be finite, got inf in row 0"),
        ([0.0, 0.0], 1.0, 0.02, r"shape \(T,\), with s_ddot for each step, got \(\)"),
        ([0.0, 0.0], [[1.0, 2.0]], 0.02, r"shape \(T,\), with s_ddot for each step, got \(1, 2\)"),
        ([0.0, 0.0], ["one"], 0.02, "controls must be real numbers"),
        ([0.0, 0.0, 0.0], [1.0], 0.02, r"state must be \(theta, theta_dot\), got .* \(3,\)"),
        ([0.0, math.nan], [1.0], 0.02, "state must be finite, got .*theta_dot"),
        ("ab", [1.0], 0.02, "state must be real numbers"),
        ({"theta": 1.0}, [1.0], 0.02, r"must be \(theta, theta_dot\), without names, got {'theta': 1.0}"),
        ([0.0, 0.0], [1.0], 0.0, "dt must be above 0 s, got 0 s"),
        ([0.0, 0.0], [1.0], -0.02, "dt must be above 0 s, got -0.02 s"),
        ([0.0, 0.0], [1.0], 1e-320, "dt must be above 0 s"),
        ([0.0, 0.0], [1.0], math.nan, "dt must be finite"),
        ([0.0, 0.0], [1.0], math.inf, "dt must be finite"),
        ([0.0, 0.0], [1.0], True, "dt must be a real number"),
    ],
)
def test_bad_arguments(state, controls, dt, message):
    with pytest.raises(ValueError, match=message):
        PivotedBar(track=None).simulate(state, controls, dt)


class Motor(Scene):
    """A pendulum, or with `gravity` 0 a wheel, with a motor."""

    gravity: float = parameter(9.81, "m/s²", least=0.0)
    coordinates = {"phi": "rad"}
    controls = {"u": "N m"}
    torque = staticmethod(lambda u, xp: u)

    def kinetic(self, q, v, xp):
        return 0.5 * v.phi**2

    def potential(self, q, xp):
        return -self.gravity * xp.cos(q.phi)

    def applied(self, q, v, u, xp):
        return {"phi": self.torque(u.u, xp)}


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [9.81, 0.0])
@pytest.mark.parametrize("name", ["tanh", "sin", "cos", "tan", "exp", "log", "sqrt", "atan"])
def test_functions_of_a_control(name, gravity):
    """As the held value itself; in a flow of its own, or in the general series, which has all functions."""

    class Shaped(Motor):
        torque = staticmethod(lambda u, xp: getattr(xp, name)(u))

    start, control, dt = [1.0, 0.3], 0.7, 0.02
    value = getattr(np, {"atan": "arctan"}.get(name, name))(control)
    after = Shaped(gravity=gravity).simulate(start, [control], dt)
    np.testing.assert_allclose(after, Motor(gravity=gravity).simulate(start, [value], dt), rtol=1e-14)
    slope = float(mp.diff(getattr(mp, name), control))
    found = Shaped(gravity=gravity).jacobian(start, control, dt)[1]
    wanted = slope * Motor(gravity=gravity).jacobian(start, value, dt)[1]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_no_controls():
    assert PivotedBar(track=None).simulate([1.0, 2.0], [], 0.02).tolist() == [[1.0, 2.0]]


# --- long runs ---


def test_long_run():
    """1,000 s undamped from 2 rad: energy, cos² + sin², and the angle by elliptic functions."""
    bar = PivotedBar(track=None)
    weight = coefficients(bar)["weight"]
    dt, steps = 0.02, 50_000
    rows = bar.simulate([2.0, 0.0], np.zeros(steps), dt)
    energy = bar.energy(rows)["total"]
    assert np.ptp(energy) / bar.mass / bar.gravity / bar.com_distance < 2e-12
    for row, allowed in ((500, 1e-12), (steps, 2e-9)):
        exact = elliptic(mpf(weight), mpf(0), mpf(2.0), mpf(0), row * mpf(dt))
        assert rows[row] == pytest.approx([float(v) for v in exact], abs=allowed)

    advance, numbers = advance_of(bar, dt)
    y = (2.0, 0.0, math.cos(2.0), math.sin(2.0))
    for _ in range(steps):
        *y, _ = advance(*y, 0.0, dt, *numbers)
    assert y[0] == rows[-1, 0]
    assert y[2] * y[2] + y[3] * y[3] == pytest.approx(1.0, abs=5e-16)
    assert y[2:] == pytest.approx([math.cos(y[0]), math.sin(y[0])], abs=1e-11)


@pytest.mark.slow
def test_energy_after_ten_million_steps():
    bar = PivotedBar(track=None)
    state, start = np.array([2.0, 0.0]), bar.energy([2.0, 0.0])["total"]
    worst = 0.0
    for _ in range(10):
        rows = bar.simulate(state, np.zeros(1_000_000), 0.02)
        state = rows[-1]
        worst = max(worst, np.abs(bar.energy(rows)["total"] - start).max())
    assert worst / bar.mass / bar.gravity / bar.com_distance < 1e-11


@pytest.mark.parametrize("kind", ["bar", "shell", "shell damping"])
def test_against_dop853(kind):
    """10 s with drag and a new control in each step, against SciPy at 1e-13."""
    rng = np.random.default_rng(3)
    if kind == "bar":
        scene, state, dt = PivotedBar(damping=0.001, track=None), [1.0, 2.0], 0.02
        controls = rng.uniform(-5, 5, 500)
    elif kind == "shell":
        scene, state, dt = CylinderInCylinder(damping=0.24), [0.3, 0.5, 1.0], 0.05
        controls = rng.uniform(-15, 15, 200)
    else:
        scene, state, dt = CylinderInCylinder(control="damping"), [0.8, 3.0], 0.02
        controls = rng.uniform(0, 2.4, 500) * (rng.random(500) < 0.1)
    rows = scene.simulate(state, controls, dt)
    k = coefficients(scene)

    def rhs(t, y, u):
        if kind == "bar":
            return [y[1], -k["weight"] * math.sin(y[0]) - k["pull"] * u * math.cos(y[0]) - k["drag"] * y[1]]
        if kind == "shell":
            return [y[1], -k["weight"] * math.sin(y[0]) + k["push"] * u - k["drag"] * (y[1] - y[2]), u]
        return [y[1], -k["weight"] * math.sin(y[0]) - k["brake"] * u * y[1]]

    y = np.array(state)
    for u in controls:
        y = solve_ivp(rhs, (0.0, dt), y, "DOP853", args=(u,), rtol=1e-13, atol=1e-13).y[:, -1]
    assert np.abs(rows[-1] - y).max() < 2e-11


def random_action(env, rng, size=1.0):
    """Return an action of an environment, as a share of the largest if it lies in a range."""
    if env.task.formulas.choices:
        return rng.integers(numbers_of_choices(env.action_space))
    return env.action_space.high * rng.uniform(-size, size, env.action_space.shape)


# --- one source, several backends ---


@pytest.mark.parametrize("name", covering(PERFECT))
def test_simulate_is_the_environments_step(name):
    """From a given state, with the applied control: the same bits, except for the kicked speed."""
    env = gym.make(name).unwrapped
    rng = np.random.default_rng(4)
    env.reset(seed=5)
    kicks, kicked = 0, f"{list(env.scene.coordinates)[-1]}_dot"
    for _ in range(60):
        env.reset()
        start = env.state
        env.reset(options={"state": start})
        env.step(random_action(env, rng))
        end, expected = env.state, env.scene.simulate(start, [env.control], env.task.dt)[1]
        kicks += not np.array_equal(end, expected)
        if kicks and not np.array_equal(end, expected):
            assert np.flatnonzero(end != expected).tolist() == [env.scene.state_names.index(kicked)]
    assert kicks <= (5 if env.task.draws else 0)
    if not env.task.draws:
        env.reset(options={"state": start})
        controls, states = [], [start]
        for _ in range(100):
            _, _, terminated, _, _ = env.step(random_action(env, rng, 0.2))
            controls.append(env.control)
            states.append(env.state)
            if terminated:
                break
        assert np.array_equal(states, env.scene.simulate(start, controls, env.task.dt))


def batch(n, sizes, seed):
    rng = np.random.default_rng(seed)
    return [rng.uniform(-size, size, n) for size in sizes]


def formulas():
    """Yield functions of columns, and the columns, for each of the three flows."""
    h = 0.02

    def swing(theta, omega, c, s, *drive):
        return pendulum.step(theta, omega, c, s, Coefficients(*drive), h)

    theta, omega, *drive = batch(200, [3, 10, 30, 10, 5, 5, 20], 7)
    yield swing, [theta, omega, np.cos(theta), np.sin(theta), *drive]
    yield lambda x, v, pull, drag: slope.slide(x, v, FixedSlope(pull, drag), h), batch(200, [1, 3, 9, 5], 8)
    x, v, phi, *turn = batch(200, [1, 3, 1, 1, 9, 1, 1], 9)
    yield (
        lambda x, v, c, s, *rest: slope.turn_series(x, v, c, s, TurningSlope(*rest), h),
        [x, v, np.cos(phi), np.sin(phi), *turn],
    )


@pytest.mark.parametrize("which", range(3))
def test_floats_arrays_and_tensors(which):
    """The same formula: equal bits on floats and arrays, a few units in the last place on torch tensors."""
    torch = pytest.importorskip("torch")
    formula, columns = list(formulas())[which]
    arrays = np.array(formula(*columns))
    floats = np.array([formula(*row) for row in np.transpose(columns).tolist()]).T
    assert np.array_equal(arrays, floats)
    tensors = np.array([v.numpy() for v in formula(*map(torch.from_numpy, columns))])
    assert np.abs(tensors - arrays).max() <= 4 * EPS * np.abs(arrays).max()


def test_compiled_is_the_formula():
    """Fused operations change only the last places."""
    formula, columns = next(iter(formulas()))
    plain = np.array(formula(*columns))
    x = pendulum.largest_majorant(0.02)
    for i, row in enumerate(np.transpose(columns).tolist()):
        *compiled, substeps = any_pendulum()(*row, 0.02, x)
        assert substeps == 1
        assert compiled == pytest.approx(plain[:, i], rel=1e-15, abs=1e-15)


@pytest.mark.parametrize(
    ("scene", "parameter", "state"),
    [
        (PivotedBar, "damping", (0.1, 0.2, 2.0, 3.0)),
        (PivotedBar, "gravity", (0.1, 0.2, 2.0, 3.0)),
        (CylinderInCylinder, "damping", (1.0, 2.0, 3.0)),
        (Incline, "damping", (0.4, -1.0)),
    ],
)
def test_what_is_zero_costs_nothing(scene, parameter, state):
    """A constant that is zero saves operations, and the numbers are those of a very small one."""
    keywords = {"control": "tilt"} if scene is Incline else {}
    without, with_it = (scene(**keywords, **{parameter: value}) for value in (0.0, 1e-50))
    assert operations(without) < operations(with_it)
    ends = [body.simulate(state, [1.3], 0.02)[1] for body in (without, with_it)]
    assert ends[0] == pytest.approx(ends[1], rel=1e-15)


def test_track_costs_only_itself():
    with_track, without = (operations(PivotedBar(track=track)) for track in (0.5, None))
    assert without < with_track <= without + 6


def test_same_bits_in_every_process():
    """Neither hash seeds nor the order of compilation have an effect."""
    code = (
        "from lag_envs.scenes import *; import numpy as np;"
        "a = PivotedBar(track=None).simulate([1, 2], np.linspace(-5, 5, 300), 0.02);"
        "b = Incline(control='tilt_rate').simulate([.1, .2, .3], np.linspace(-3, 3, 50), 0.05);"
        "print(a.tobytes().hex()[-64:], b.tobytes().hex()[-64:])"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    a = PivotedBar(track=None).simulate([1, 2], np.linspace(-5, 5, 300), 0.02)
    b = Incline(control="tilt_rate").simulate([0.1, 0.2, 0.3], np.linspace(-3, 3, 50), 0.05)
    assert run.stdout.split() == [a.tobytes().hex()[-64:], b.tobytes().hex()[-64:]]
