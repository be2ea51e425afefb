"""The oracle is checked against closed forms, first principles and, by other methods, itself."""

import numpy as np
import pytest
import sympy
from contract_scenes import Bead
from covering import every, slow
from mpmath import mp, mpf
from plain_target import FLOATS
from reference import agreed_end, conditioning, flow, linear, moving_plane, random_cases, scales
from series_systems import SYSTEMS, acceleration

from lag_envs import scenes
from lag_envs.report import formulas, reference
from lag_envs.report import oracle as oracles
from lag_envs.report.bound import driven
from lag_envs.report.closed_forms import elliptic
from lag_envs.report.formulas import OperationList
from lag_envs.report.oracle import Oracle, Unresolved, oracle_of
from lag_envs.scenes import Scene, parameter
from lag_envs.stepping.pendulum import Coefficients

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


def series(drive, theta, rate, dt, digits=50):
    """Return the driven pendulum's end by the oracle, from a single computation."""
    scene, control = driven(Coefficients(*drive))
    return oracle_of(scene).once([0.0, 0.0, theta, rate], control, dt, digits)[2:]


# --- closed forms -------------------------------------------------------------------------------------------


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
def test_series_is_elliptic_without_damping(theta, rate, u, dt):
    exact = elliptic(mpf(24.5), mpf(2.5) * u, mpf(theta), mpf(rate), mpf(dt))
    assert distance(series((24.5, 2.5 * u, 0, 0, 0), theta, rate, dt), exact) < 1e-40


@pytest.mark.parametrize("excess", [0, 1e-15, -1e-15, 1e-30, -1e-30])
def test_separatrix(excess):
    start = ZERO, 4 * (1 + mpf(excess))
    end = elliptic(mpf(4), ZERO, *start, mpf(3))
    assert distance(end, series((4, 0, 0, 0, 0), *start, 3)) < 1e-40
    if excess == 0:
        assert distance(end, [2 * mp.atan(mp.sinh(6)), 4 / mp.cosh(6)]) < 1e-60


def test_full_period():
    """A swing of amplitude 2 rad returns after 4 K(sin(1)^2) / omega."""
    period = 4 * mp.ellipk(mp.sin(1) ** 2) / 3
    assert distance(elliptic(mpf(9), ZERO, mpf(2), ZERO, period), [2, 0]) < 1e-60
    assert distance(series((9, 0, 0, 0, 0), 2, 0, period), [2, 0]) < 1e-45


@pytest.mark.parametrize("track", [1.5, None])
def test_what_goes_far_is_by_the_closed_form(track, monkeypatch):
    """The bar's own equation is recognised, but only if undamped, with its moving support or without one."""
    bar, start = scenes.PivotedBar(track=track), [0.3, -0.2][: 2 if track else 0]
    state = [*start, 2.0, 3.0]
    exact = agreed_end(oracle_of(bar), state, 4.0, 1.5)
    monkeypatch.setattr(Oracle, "once", None)  # not called
    assert distance(reference.exact_flow(bar, state, 4.0, 1.5), exact) < 1e-29
    with pytest.raises(TypeError):
        reference.exact_flow(scenes.PivotedBar(track=track, damping=1e-9), state, 4.0, 1.5)


@pytest.mark.parametrize("decay", [1e-9, 1, 30, 2e3])
def test_linear_limit_is_exponential(decay):
    """Without field theta' - v decays as exp(-gamma t), where v is the terminal drift under the drive."""
    dt, delta, start = mpf(0.02), mpf(3), (mpf(1), mpf(-7))
    gamma = mpf(decay / 0.02)
    drift = delta / gamma
    with mp.workdps(120):
        fall = 1 - mp.exp(-gamma * dt)
        closed = [start[0] + drift * dt + (start[1] - drift) * fall / gamma, 0]
        closed[1] = drift + (start[1] - drift) * (1 - fall)
    assert distance(linear(gamma, delta, ZERO, *start, dt), closed) < 1e-60
    assert distance(series((0, 0, gamma, 3, 0), 1, -7, dt), closed) < 1e-45
    ramp = linear(gamma, delta, mpf(400), *start, dt)
    assert distance(series((0, 0, gamma, 3, 400), 1, -7, dt), ramp) < 1e-45


@pytest.mark.parametrize(
    ("gamma", "field", "delta", "slope"),
    [
        (1e5, (24, 75), 0, 0),
        (1e5, (24, 0), 3e5, 1e6),
        (2e4, (2e4, -7e5), 50, 0),
        slow(1e6, (2e7, 0), 0, 0),
    ],
)
def test_collocation_is_the_series(gamma, field, delta, slope, monkeypatch):
    """gamma dt = 400 to 2e4; the strongest field moves up to .7 rad along the slow manifold."""
    case = (*field, gamma, delta, slope), 2, -7, 0.02
    calls, collocated = [], Oracle._collocated

    def count(*given):
        calls.append(given)
        return collocated(*given)

    monkeypatch.setattr(Oracle, "_collocated", count)
    layered = series(*case)
    assert calls
    monkeypatch.setattr(oracles, "STIFF", np.inf)
    monkeypatch.setattr(Oracle, "_collocated", None)
    assert distance(layered, series(*case, digits=55)) < 1e-38


@pytest.mark.parametrize("dt", [0.02, 0.5])
def test_heavy_damping_of_one_joint_of_two(dt, monkeypatch):
    """A slow joint beside a stiff one: collocation against the series."""

    class Stiff(Scene):
        stiff: float = parameter(2e4, "N m s", least=0.0)
        coordinates = {"a": "rad", "b": "rad"}
        controls = {"torque": "N m"}

        def kinetic(self, q, v, xp):
            return v.a**2 + 0.5 * v.b**2 + 0.3 * v.a * v.b * xp.cos(q.a - q.b)

        def potential(self, q, xp):
            return -9.81 * (xp.cos(q.a) + 0.5 * xp.cos(q.b))

        def dissipation(self, q, v, u, xp):
            return 0.5 * self.stiff * (v.b - v.a) ** 2

        def applied(self, q, v, u, xp):
            return {"a": u.torque}

    case = [1.0, 2.0, -0.5, -3.0], [4.0], dt
    end = oracle_of(Stiff()).once(*case, 45)
    monkeypatch.setattr(oracles, "STIFF", np.inf)
    if dt == 0.02:
        assert distance(end, oracle_of(Stiff()).once(*case, 50)) < 1e-38
    else:  # the relative rate has died out, except for what the field maintains
        assert abs(end[1] - end[3]) < 1e-2


def test_slow_manifold_to_leading_order():
    """At gamma dt = 1e6 a bar without drive creeps: tan(theta/2) ~ exp(-alpha t / gamma)."""
    gamma, alpha, dt = 1e7, 1e6, 0.1
    params = {"mass": 1.0, "com_distance": 1.0, "inertia": 0.0, "damping": gamma, "gravity": alpha}
    theta, rate = flow("PivotedBar", params | {"track": None}, (2.0, 0.0), 0.0, dt)
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


@pytest.mark.parametrize("damping", [0.0, 0.7, 1e3, 1e6])
def test_turning_plane_is_the_matrix_exponential(damping):
    params = {"mass": 1.0, "radius": 0.5, "inertia": 0.125, "gravity": 8.0, "damping": damping}
    given = mpf(2) / 3, mpf(damping) * 2 / 3, mpf(8), mpf(0.5), mpf(1.5)
    case = (0.25, -0.5, 0.75), 1.5, 0.125
    with mp.workdps(100):
        exact = moving_plane(*given, list(map(mpf, case[0])), mpf(case[2]))
    assert distance(flow("Incline", {**params, "control": "tilt_rate"}, *case), exact) < 1e-29


# --- first principles ---------------------------------------------------------------------------------------


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

    The drag Q acts on v, on the shell relative to psi'; v is the state's entry minus R phi'.
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


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda system: system.name)
def test_sympy_gives_the_equations_that_were_typed_in(system):
    generator = np.random.default_rng(5)
    oracle, first = oracle_of(system.scene), 2 * system.driven
    for _ in range(10):
        state, control = system.draw(generator)
        q, v = state[first::2], state[first + 1 :: 2]
        typed = acceleration(system, q, v, control, state[0], control[0] if system.driven else None, FLOATS)
        found = oracle.at(state, control)[1]
        np.testing.assert_allclose(found, typed, rtol=1e-11, atol=1e-11 * np.abs(typed).max())


def test_floats_are_taken_as_they_are():
    """0.1 is not a tenth: neither as a parameter nor in a formula."""

    class Slide(Bead):
        push: float = parameter(0.1, "N")

        def potential(self, q, xp):
            return -(self.push + 0.1) * q.x

    x, v = agreed_end(oracle_of(Slide()), [0.0, 0.0], [], 1.0, 40)
    assert abs(v - 2 * mpf(0.1)) < 1e-39 < abs(v - mpf(1) / 5) and abs(x - mpf(0.1)) < 1e-39


def test_functions_of_a_formula():
    """Each of them, by energy: the place determines how much of the initial speed is left."""

    class Hill(Bead):
        kind: str = "tan"

        def potential(self, q, xp):
            return getattr(xp, self.kind)(0.5 + q.x**2)

    for kind in ("tan", "tanh", "atan", "exp", "log", "sqrt", "sin", "cos"):
        x, v = agreed_end(oracle_of(Hill(kind=kind)), [0.3, 0.2], [], 0.5, 40)
        f = getattr(mp, kind)
        energy = [w**2 / 2 + f(mpf(0.5) + y**2) for y, w in ((mpf(0.3), mpf(0.2)), (x, v))]
        assert abs(energy[1] - energy[0]) < 1e-39, kind
        assert abs(v - mpf(0.2)) > 1e-3


class Wall(Bead):
    """A singular potential at 0, which attracts or repels."""

    sign: float = parameter(1.0, "J")

    def potential(self, q, xp):
        return self.sign * xp.log(q.x)


def test_a_motion_into_a_singular_point_is_unresolved():
    with pytest.raises(Unresolved):
        agreed_end(oracle_of(Wall()), [1e-3, -10.0], [], 0.01)


def test_a_motion_to_the_edge_of_one_is_resolved():
    """It comes as near as 1e-25, and leaves with its initial energy."""
    x, v = agreed_end(oracle_of(Wall(sign=-1.0)), [1e-3, -10.0], [], 0.01)
    assert v > 0 and abs(v**2 / 2 - mp.log(x) - 50 + mp.log(mpf(1e-3))) < 1e-27


def test_a_power_that_it_does_not_know_is_named():
    x = sympy.Symbol("x")
    with pytest.raises(ValueError, match=r"the power x\*\*\(1/3\) is neither whole nor a half"):
        OperationList([x ** sympy.Rational(1, 3)], [x], [])


def test_a_state_of_another_length_is_refused():
    oracle = oracle_of(scenes.PivotedBar(track=None))
    with pytest.raises(ValueError, match="state must have 2 entries, got 4"):
        agreed_end(oracle, [0.0, 0.0, 1.0, 2.0], 0.0, 0.02)
    with pytest.raises(ValueError, match="controls must have 1 entries, got 2"):
        agreed_end(oracle, [1.0, 2.0], [0.0, 0.0], 0.02)


def test_it_shares_no_code_with_what_it_checks():
    """Neither equations nor stepping: it imports SymPy's view of a scene and nothing else of the package."""
    import ast
    from pathlib import Path

    imports = [
        f"{node.module}.{name.name}"
        for node in ast.walk(
            ast.parse("".join(Path(m.__file__).read_text("utf-8") for m in (oracles, formulas)))
        )
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    ]
    assert {name for name in imports if name.startswith("lag_envs")} == {
        "lag_envs.scenes.symbolic", "lag_envs.report.formulas.OperationList",
        "lag_envs.report.formulas.FormulaSeries", "lag_envs.scenes.base.Scene",
    }  # fmt: skip


# --- itself -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", every(2, KINDS))
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
    bar = {"mass": 1.0, "com_distance": 1.0, "inertia": 0.0, "gravity": 9.0, "track": None}
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


def test_remembered(tmp_path, monkeypatch):
    problem = scenes.PivotedBar(track=None), (2.0, 0.1), 3.0, 0.02
    monkeypatch.setattr(reference, "store", tmp_path)
    first = reference.remembered(*problem)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(reference, "exact_flow", None)  # not called again
    assert distance(reference.remembered(*problem), first) < 1e-38
    assert reference.state_differences([float(x) for x in first], first) == pytest.approx(
        [0.0, 0.0], abs=1e-15
    )
    with pytest.raises(TypeError):
        reference.remembered(*problem[:3], 0.03)


def test_recurrences_that_lose_many_bits():
    """tanh and exp in drag and forces: rounding grows with each order, and more bits are taken."""
    lattice = next(system.scene for system in SYSTEMS if system.name == "lattice")
    state = [0.7963143950173581, 9.9078134365626624e-4, -0.10207323685357128, 1.4940809122348817]
    found, finer = (oracle_of(lattice).once(state, [1.1647682194020892], 0.02, digits) for digits in (40, 60))
    assert max(abs(a - b) for a, b in zip(found, finer, strict=True)) < mpf(10) ** -38
