"""The reference is held against closed forms, first principles and itself by other methods."""

import numpy as np
import pytest
from mpmath import mp, mpf
from reference import conditioning, flow, random_cases, scales

from lag_envs import scenes
from lag_envs.report import reference
from lag_envs.report.reference import Pendulum, elliptic, linear, pendulum, slow_manifold, taylor

ZERO = mpf(0)
KINDS = "task", "damped", "stiff", "extreme"


@pytest.fixture(autouse=True)
def precise():
    with mp.workdps(80):
        yield


def distance(a, b):
    return max(abs(x - y) / max(1, abs(y)) for x, y in zip(a, b, strict=True))


def arguments(case):
    return [case[k] for k in ("scene", "params", "state", "control", "dt")]


@pytest.mark.parametrize(
    ("theta", "rate", "u", "dt"),
    [
        (2, 0, 0, 0.02),
        (1, 5, 30, 0.3),
        (1, -50, -30, 0.3),
        (np.pi, 0, 0, 1),
        (20, -12, 3, 1),
        (7, -0.3, -1e6, 0.003),
        (0.1, 1e4, 3, 0.003),
        (0, 9.9, 0, 1),
    ],
)
def test_taylor_is_elliptic_without_damping(theta, rate, u, dt):
    p = Pendulum(mpf(24.5), mpf(2.5) * u, ZERO, ZERO, ZERO)
    start = mpf(theta), mpf(rate)
    assert distance(taylor(p, *start, mpf(dt), 50), elliptic(p, *start, mpf(dt))) < 1e-40


@pytest.mark.parametrize("excess", [0, 1e-15, -1e-15, 1e-30, -1e-30])
def test_separatrix(excess):
    p = Pendulum(mpf(4), ZERO, ZERO, ZERO, ZERO)
    start = ZERO, 4 * (1 + mpf(excess))
    end = elliptic(p, *start, mpf(3))
    assert distance(end, taylor(p, *start, mpf(3), 50)) < 1e-40
    if excess == 0:
        assert distance(end, [2 * mp.atan(mp.sinh(6)), 4 / mp.cosh(6)]) < 1e-60


def test_full_period():
    """A swing of amplitude 2 rad returns after 4 K(sin(1)^2) / omega."""
    p = Pendulum(mpf(9), ZERO, ZERO, ZERO, ZERO)
    period = 4 * mp.ellipk(mp.sin(1) ** 2) / 3
    assert distance(elliptic(p, mpf(2), ZERO, period), [2, 0]) < 1e-60
    assert distance(taylor(p, mpf(2), ZERO, period, 50), [2, 0]) < 1e-45


@pytest.mark.parametrize("decay", [1e-9, 1, 30, 2e3])
def test_linear_limit_is_exponential(decay):
    """Without field theta' - v decays as exp(-gamma t), v the drift that the drive settles at."""
    dt, delta, start = mpf(0.02), mpf(3), (mpf(1), mpf(-7))
    gamma = decay / dt
    p = Pendulum(ZERO, ZERO, gamma, delta, ZERO)
    drift = delta / gamma
    with mp.workdps(120):
        fall = 1 - mp.exp(-gamma * dt)
        closed = [start[0] + drift * dt + (start[1] - drift) * fall / gamma, 0]
        closed[1] = drift + (start[1] - drift) * (1 - fall)
    assert distance(linear(gamma, delta, ZERO, *start, dt), closed) < 1e-60
    assert distance(pendulum(p, *start, dt, 50), closed) < 1e-45
    assert distance(taylor(p, *start, dt, 50), closed) < 1e-45
    ramp = p._replace(slope=mpf(400))
    assert distance(taylor(ramp, *start, dt, 50), pendulum(ramp, *start, dt, 50)) < 1e-45


@pytest.mark.parametrize(
    ("gamma", "field", "delta", "slope"),
    [
        (1e5, (24, 75), 0, 0),
        (1e5, (24, 0), 3e5, 1e6),
        (2e4, (2e4, -7e5), 50, 0),
        (1e6, (2e7, 0), 0, 0),
    ],
)
def test_slow_manifold_is_taylor(gamma, field, delta, slope):
    """gamma dt = 1e3 to 2e4; the strongest field moves up to .7 rad along the manifold."""
    p = Pendulum(*map(mpf, (*field, gamma, delta, slope)))
    start, dt, layer = (mpf(2), mpf(-7)), mpf(0.02), mpf(150) / gamma
    plain = taylor(p, *start, dt, 55)
    layered = slow_manifold(p, *taylor(p, *start, layer, 50), layer, dt, 50)
    assert distance(layered, plain) < 1e-38
    assert distance(pendulum(p, *start, dt, 50), plain) < 1e-38


def test_slow_manifold_to_leading_order():
    """At gamma dt = 1e6 a bar without drive creeps: tan(theta/2) ~ exp(-alpha t / gamma)."""
    gamma, alpha, dt = 1e7, 1e6, 0.1
    params = {"mass": 1.0, "com_distance": 1.0, "inertia": 0.0, "damping": gamma, "gravity": alpha}
    theta, rate = flow("PivotedBar", params, (2.0, 0.0), 0.0, dt)
    expected = 2 * mp.atan(mp.tan(1) * mp.exp(-mpf(alpha) / mpf(gamma) * mpf(dt)))
    assert abs(theta - expected) < 10 * alpha / gamma**2
    assert abs(rate + alpha / gamma * mp.sin(theta)) < 10 * (alpha / gamma) ** 2 / gamma


@pytest.mark.parametrize("beta", [1e-9, 0.4, 50.0])
def test_fixed_incline(beta):
    """The lecture's v_inf = k g sin(phi) / beta and its exponential approach; k = 2/3."""
    params = {"mass": 2.0, "radius": 0.5, "inertia": 0.25, "tilt": 0.25, "control": "damping"}
    x, v, dt = mpf(0.5), mpf(-1.5), mpf(0.75)
    with mp.workdps(120):
        rate = mpf(3 * beta) / 3
        limit = mp.mpf(9.81) * 2 / 3 * mp.sin(mpf(0.25)) / rate
        end = [x + limit * dt + (v - limit) * (1 - mp.exp(-rate * dt)) / rate]
        end.append(limit + (v - limit) * mp.exp(-rate * dt))
    assert distance(flow("Incline", params, (0.5, -1.5), 3 * beta, 0.75, dps=60), end) < 1e-45


def test_still_plane_is_the_fixed_one():
    plane = {"mass": 1.0, "radius": 0.05, "inertia": 0.001, "damping": 0.3}
    still = flow("Incline", {**plane, "control": "tilt_rate"}, (0.1, 0.2, 0.3), 0.0, 0.5)
    fixed = flow("Incline", {**plane, "control": "tilt"}, (0.1, 0.2), 0.3, 0.5)
    assert distance(still, [*fixed, mpf(0.3)]) < 1e-38


def test_moving_plane_without_drag():
    """x'' = k Omega^2 x + k g sin(phi): hyperbolic functions and A sin(phi) + B, k = 1."""
    params = {"mass": 1.0, "radius": 0.5, "inertia": 0.0, "gravity": 8.0, "control": "tilt_rate"}
    x, w, phi, turn, dt = map(mpf, (0.25, -0.5, 0.75, 2, 0.5))
    part = [-8 / (2 * turn**2) * mp.sin(a) for a in (phi, phi + turn * dt)]
    slope = [-8 / (2 * turn) * mp.cos(a) for a in (phi, phi + turn * dt)]
    cosh, sinh = mp.cosh(turn * dt), mp.sinh(turn * dt)
    dx, dv = x - part[0], w - turn / 2 - slope[0]
    end = [part[1] + dx * cosh + dv / turn * sinh, 0, phi + turn * dt]
    end[1] = slope[1] + dx * turn * sinh + dv * cosh + turn / 2
    assert distance(flow("Incline", params, (0.25, -0.5, 0.75), 2.0, 0.5), end) < 1e-38


def bar_lagrangian(q, v, t):
    """Pivot at s with s' = 0.25 + 3 t; kinetic energy from the velocity of the centre of mass."""
    m, arm, inertia, g = mpf(0.5), mpf(0.25), mpf(0.125), mpf(9.5)
    velocity = mpf(0.25) + 3 * t + arm * v * mp.cos(q), arm * v * mp.sin(q)
    height = -arm * mp.cos(q)
    return m * mp.fsum(x**2 for x in velocity) / 2 + inertia * v**2 / 2 - m * g * height


def plane_lagrangian(q, v, t):
    """Plane at phi = 0.5 + 2 t through the point x = 0; the axis at x along it, R above it."""
    m, radius, inertia, g = mpf(0.5), mpf(0.25), mpf(0.0625), mpf(9.5)
    turn = 2
    cos, sin = mp.cos_sin(mpf(0.5) + turn * t)
    velocity = (
        v * cos - q * turn * sin + radius * turn * cos,
        -v * sin - q * turn * cos - radius * turn * sin,
    )
    height = -q * sin + radius * cos
    rolling = v / radius + turn
    return m * mp.fsum(x**2 for x in velocity) / 2 + inertia * rolling**2 / 2 - m * g * height


def shell_lagrangian(q, v, t):
    """Shell at psi' = -1 + 3 t; rolling without slipping inside it."""
    m, big, radius, inertia, g = mpf(0.5), mpf(1), mpf(0.25), mpf(0.0625), mpf(9.5)
    arm = big - radius
    rolling = (big * (-1 + 3 * t) - arm * v) / radius
    return m * (arm * v) ** 2 / 2 + inertia * rolling**2 / 2 + m * g * arm * mp.cos(q)


@pytest.mark.parametrize(
    ("scene", "params", "state", "control", "place", "lagrangian", "carried"),
    [
        (
            "PivotedBar",
            {"com_distance": 0.25, "inertia": 0.125},
            (0.5, 0.25, 1.5, -2),
            3.0,
            2,
            bar_lagrangian,
            0,
        ),
        (
            "Incline",
            {"radius": 0.25, "inertia": 0.0625, "control": "tilt_rate"},
            (-0.75, 1.5, 0.5),
            2.0,
            0,
            plane_lagrangian,
            0.5,
        ),
        (
            "CylinderInCylinder",
            {"shell_radius": 1.0, "radius": 0.25, "inertia": 0.0625, "control": "tilt"},
            (0.5, 2, -1),
            3.0,
            0,
            shell_lagrangian,
            0,
        ),
    ],
)
def test_euler_lagrange(scene, params, state, control, place, lagrangian, carried):
    """d/dt dL/dv = dL/dq + Q along the flow, with L from the velocities in space.

    The drag Q acts on v, on the shell relative to psi'; v is the state's entry less R phi'.
    """
    drag = 0.75
    params = {"mass": 0.5, "damping": drag, "gravity": 9.5, **params}
    h = mpf(2) ** -60
    end = flow(scene, params, state, control, h, dps=50)
    start = [mpf(x) for x in state]

    def momentum(y, t):
        q, v = y[place], y[place + 1] - carried
        return (lagrangian(q, v + 1, t) - lagrangian(q, v - 1, t)) / 2

    q, v = start[place], start[place + 1] - carried
    relative = v + 1 if scene == "CylinderInCylinder" else v
    generalised = mp.diff(lambda x: lagrangian(x, v, ZERO), q) - mpf(drag) * relative
    assert abs((momentum(end, h) - momentum(start, 0)) / h - generalised) < 1e-15
    assert abs((end[place] - start[place]) / h - v) < 1e-15


@pytest.mark.parametrize("kind", KINDS)
def test_two_halves_make_a_step(kind):
    for case in random_cases(kind, 12, seed=7):
        scene, params, state, control, dt = arguments(case)
        if "r near" in case["label"] or "bar" in case["label"]:
            continue
        whole = flow(scene, params, state, control, dt, dps=30)
        half = flow(scene, params, state, control, dt / 2, dps=30)
        twice = flow(scene, params, half, control, dt / 2, dps=30)
        gap = distance(twice, whole)
        assert gap < 1e-25 or gap < 1e-25 * max(conditioning(*arguments(case))), case


def test_digits_agree():
    for case in random_cases("task", 12, seed=3):
        few, many = (flow(*arguments(case), dps=dps) for dps in (25, 60))
        assert distance(few, many) < 1e-25


def test_conditioning():
    """A rounded speed decays with the drag; next to the top a rounded angle grows like cosh."""
    slope = {
        "mass": 1.0,
        "radius": 1.0,
        "inertia": 0.0,
        "damping": 2.0,
        "gravity": 0.0,
        "control": "tilt",
    }
    assert conditioning("Incline", slope, (0.0, 3.0), 0.0, 1.0)[1] == pytest.approx(3 * np.exp(-2))
    bar = {"mass": 1.0, "com_distance": 1.0, "inertia": 0.0, "gravity": 9.0}
    angle = np.pi - 1e-6
    theta, rate = conditioning("PivotedBar", bar, (angle, 0.0), 0.0, 2.0)
    assert theta == pytest.approx(angle * np.cosh(6) + np.sinh(6), rel=1e-3)
    assert rate == pytest.approx(3 * (angle * np.sinh(6) + np.cosh(6)), rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_random_cases(kind):
    cases = random_cases(kind, 60, seed=1)
    assert cases == random_cases(kind, 60, seed=1)
    assert {(c["scene"], c["control_kind"]) for c in cases} == {
        (c["scene"], c["params"].get("control")) for c in cases
    }
    assert len({c["scene"] + str(c["control_kind"]) for c in cases}) == 6
    for case in cases:
        assert len(scales(*arguments(case))) == len(case["state"])
        assert np.all(np.isfinite([*case["state"], case["control"], case["dt"]]))


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_own_coefficients_are_the_typed_ones(kind):
    """The report takes coefficients from the scene's formulas; here they are typed in again."""
    for case in random_cases(kind, 12, seed=8):
        scene = getattr(scenes, case["scene"])(**case["params"])
        end = reference.flow(scene, case["state"], case["control"], case["dt"])
        assert distance(end, flow(*arguments(case))) < 1e-29, case


def test_remembered(tmp_path, monkeypatch):
    problem = scenes.PivotedBar(track=None), (2.0, 0.1), 3.0, 0.02
    monkeypatch.setattr(reference, "store", tmp_path)
    first = reference.remembered(*problem)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(reference, "flow", None)  # not called again
    assert distance(reference.remembered(*problem), first) < 1e-38
    assert reference.errors([float(x) for x in first], first) == pytest.approx([0.0, 0.0], abs=1e-15)
    with pytest.raises(TypeError):
        reference.remembered(*problem[:3], 0.03)
