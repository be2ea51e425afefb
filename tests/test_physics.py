"""Physics: what is computed is derived again, from energies by Euler-Lagrange or from places by Newton."""

import dataclasses
import math
import sys
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from mpmath import mp, mpf
from sympy import cos, sin

from lag_envs import lagrange
from lag_envs.lagrange import coordinates, euler_lagrange, symbolic, t
from lag_envs.report.reference import linear
from lag_envs.scenes import SCENES, CylinderInCylinder, Incline, Motion, PivotedBar
from lag_envs.stepping.pendulum import Drive
from lag_envs.stepping.slope import Pull, Turn

U, TAU, SPIN = sympy.symbols("u tau psi_dot", real=True)


def vanishes(expression):
    """Tell whether an expression, rational but for sines and cosines, is identically zero."""
    expression = sympy.numer(sympy.together(sympy.nsimplify(expression))).expand()
    for cosine in expression.atoms(cos):
        expression = expression.subs(cosine**2, 1 - sin(*cosine.args) ** 2).expand()
    return expression == 0


def controls(scene):
    """Return the keywords that choose a control of this kind of scene."""
    names = getattr(sys.modules[scene.__module__], "CONTROLS", None)
    return [{"control": name} for name in names] if names else [{}]


def name(scene, keywords):
    return "-".join([scene.__name__, *map(str, keywords.values())])


def variants(extra=()):
    pairs = [(scene, keywords) for scene in SCENES for keywords in controls(scene)] + list(extra)
    return pytest.mark.parametrize("scene", [pytest.param(s(**k), id=name(s, k)) for s, k in pairs])


FRAME = (PivotedBar, {"track": None})
PARAMETERS = [
    pytest.param(scene, field, id=f"{scene.__name__}-{field.name}")
    for scene in SCENES
    for field in dataclasses.fields(scene)
    if "unit" in field.metadata
]


def moved(scene):
    """Return the prescribed coordinate's value, rate and acceleration at the time tau within a step."""
    if isinstance(scene, PivotedBar):
        return {"s": (U * TAU**2 / 2, U * TAU, U)}
    if isinstance(scene, CylinderInCylinder):
        spin = scene.control == "tilt"
        return {"psi": (0, SPIN + U * TAU, U) if spin else (0, 0, 0)}
    tilt = symbolic(scene).tilt
    phi = sympy.Symbol("phi", real=True)
    return {"phi": {"damping": (tilt, 0, 0), "tilt": (U, 0, 0), "tilt_rate": (phi, U, 0)}[scene.control]}


def prescribe(expression, scene):
    """Put in how the prescribed coordinate moves."""
    q = vars(coordinates(scene)[0])
    for which, (place, rate, acceleration) in moved(scene).items():
        f = q[which]
        expression = expression.subs(f.diff(t, 2), acceleration).subs(f.diff(t), rate).subs(f, place)
    return expression


def normal_form(scene):
    """Return the free coordinate's acceleration as the stepping has it, and what makes the lifted state."""
    twin = symbolic(scene)
    k = SimpleNamespace(**twin.constants())
    q, v = coordinates(scene)
    free, rate = getattr(q, scene.coordinates[0]), getattr(v, scene.coordinates[0])
    if isinstance(scene, Incline):
        phi = moved(scene)["phi"][0]
        w = rate + twin.radius * U
        y = [free, w, phi, cos(phi), sin(phi)] if scene.control == "tilt_rate" else [free, rate]
    else:
        y = [free, rate, cos(free), sin(free)]
        if isinstance(scene, PivotedBar):
            y = [*sympy.symbols("s s_dot"), *y]
        elif scene.control == "tilt":
            y[2:2] = [SPIN]
    drive = scene.__class__.drive(twin, y, U, k, sympy)
    x, speed, *pair = scene.__class__.unpack(twin, y, U, k)
    assert sympy.expand(speed - rate) == 0 and x == free
    if isinstance(drive, Drive):
        c, s = pair
        alpha, beta, gamma, delta, ramp = drive
        return delta + ramp * TAU - alpha * s - beta * c - gamma * speed
    if isinstance(drive, Turn):
        return drive.rolling * (drive.gravity * pair[1] + drive.rate**2 * x) - drive.drag * speed
    assert isinstance(drive, Pull)
    return drive.pull - drive.drag * speed


@variants([FRAME])
def test_stepping_is_euler_lagrange(scene):
    """The held coefficients, from `drive`, give the acceleration that follows from kinetic - potential."""
    derived = prescribe(lagrange.acceleration(scene, U), scene)
    assert vanishes(normal_form(scene) - derived)


@variants()
def test_power_balance(scene):
    """dE/dt is the power of the forces in both coordinates' equations less the drag's loss."""
    q, v = coordinates(scene)
    twin = symbolic(scene)
    energy = sympy.nsimplify(twin.kinetic(q, v, sympy) + twin.potential(q, sympy))
    lost = 2 * sympy.nsimplify(twin.dissipation(v, U))
    fed = sum(getattr(v, c) * euler_lagrange(scene, c, U) for c in scene.coordinates)
    assert sympy.expand(energy.diff(t) - (fed - lost)) == 0


def test_momentum_is_continuous():
    """When phi' jumps, dL/dx' and so w = x' + R phi' does not; nor does theta' - kK(R/a)psi' with psi'."""
    incline, shell = Incline(control="tilt_rate"), CylinderInCylinder()
    push = symbolic(shell).constants()["push"]
    for scene, carried in ((incline, symbolic(incline).radius), (shell, -push)):
        v = coordinates(scene)[1]
        free, prescribed = (getattr(v, c) for c in scene.coordinates)
        momentum = lagrange.lagrangian(scene).diff(free).expand()
        assert vanishes(momentum - momentum.coeff(free) * (free + carried * prescribed))


# --- Newton ------------------------------------------------------------------------------------------------


def newton(scene):
    """Return reaction forces from the accelerations of centre of mass and spin, and what must vanish.

    Written for any motion of both coordinates; the drag c acts between the axis and what it rolls on.
    """
    q, v = coordinates(scene)
    p = symbolic(scene)
    g = p.gravity
    c = p.damping + (U if getattr(scene, "control", "") == "damping" else 0)
    if isinstance(scene, PivotedBar):
        arm = p.com_distance
        place = sympy.Matrix([q.s + arm * sin(q.theta), -arm * cos(q.theta)])
        force = p.mass * (place.diff(t, 2) + sympy.Matrix([0, g]))
        # About the centre of mass, the pivot's force acts at -arm (sin, -cos).
        torque = -arm * (sin(q.theta) * force[1] + cos(q.theta) * force[0]) - p.damping * v.theta
        return {"support_horizontal": force[0], "support_vertical": force[1]}, {
            "theta": p.inertia * q.theta.diff(t, 2) - torque
        }
    if isinstance(scene, Incline):
        along, up = sympy.Matrix([cos(q.phi), -sin(q.phi)]), sympy.Matrix([sin(q.phi), cos(q.phi)])
        place = q.x * along + p.radius * up
        force = p.mass * (place.diff(t, 2) + sympy.Matrix([0, g]))
        friction = p.inertia * (v.x / p.radius + v.phi).diff(t) / p.radius  # up the slope
        normal = force.dot(up)
        # The massless plane turns under the contact's and the drag's reactions.
        torque = -(q.x * normal + p.radius * c * v.x)
        return {"normal": normal, "friction": friction, "drive_torque": torque}, {
            "x": force.dot(along) + friction + c * v.x
        }
    arm = p.shell_radius - p.radius
    out, along = sympy.Matrix([sin(q.theta), -cos(q.theta)]), sympy.Matrix([cos(q.theta), sin(q.theta)])
    force = p.mass * ((arm * out).diff(t, 2) + sympy.Matrix([0, g]))
    friction = p.inertia * ((p.shell_radius * v.psi - arm * v.theta) / p.radius).diff(t) / p.radius
    drag = c * (v.theta - v.psi)
    torque = friction * p.shell_radius - drag
    return {"normal": -force.dot(out), "friction": friction, "drive_torque": torque}, {
        "theta": arm * (force.dot(along) - friction) + drag
    }


@variants()
def test_newton_is_euler_lagrange(scene):
    """Newton's and Euler's laws, with the contact's forces, give the free coordinate's equation of motion."""
    for coordinate, residual in newton(scene)[1].items():
        assert vanishes(residual - euler_lagrange(scene, coordinate, U))


@variants()
def test_drive_force_is_euler_lagrange(scene):
    """Newton's force on support, plane or shell is the prescribed coordinate's residual."""
    forces, laws = newton(scene)
    force = forces.get("drive_torque", forces.get("support_horizontal"))
    residual = euler_lagrange(scene, scene.coordinates[1], U)
    free = getattr(coordinates(scene)[0], scene.coordinates[0]).diff(t, 2)
    law = laws[scene.coordinates[0]].expand()
    difference = (force - residual).expand()
    assert vanishes(difference * law.coeff(free) - law * difference.coeff(free))


@variants()
def test_forces_are_newton(scene):
    """The numbers of `reactions` for random bodies and motions, accelerated in both coordinates."""
    q, v = coordinates(scene)
    twin = vars(symbolic(scene))
    names = [n for n, value in twin.items() if isinstance(value, sympy.Symbol)]
    symbols = [twin[n] for n in names]
    functions = [getattr(space, c) for space in (q, v) for c in scene.coordinates]
    rates = [getattr(v, c).diff(t) for c in scene.coordinates]
    variables = sympy.symbols(f"z:{len(functions) + len(rates)}")
    # Derivatives before what they derive from.
    table = dict(reversed(list(zip([*functions, *rates], variables, strict=True))))
    expressions = {n: f.subs(list(table.items())) for n, f in newton(scene)[0].items()}
    formulas = {n: sympy.lambdify([*symbols, U, *variables], f) for n, f in expressions.items()}
    rng = np.random.default_rng(5)
    n = len(scene.coordinates)
    checked = set()
    for _ in range(20):
        numbers = dict(zip(names, rng.uniform(0.2, 1.0, len(names)).tolist(), strict=True))
        if "shell_radius" in numbers:
            numbers["shell_radius"] += 1.0
        body = dataclasses.replace(scene, **numbers)
        u = rng.uniform(0.0, 1.0)
        values = rng.uniform(-2.0, 2.0, 3 * n)
        parts = [dict(zip(scene.coordinates, part, strict=True)) for part in values.reshape(3, n)]
        motion = Motion(*(SimpleNamespace(**part) for part in parts))
        reactions = body.reactions(motion, u)
        for force, formula in formulas.items():
            if force == "drive_torque":
                # Its formula may use the equation of motion, so the motion has to obey it.
                continue
            expected = formula(*numbers.values(), u, *values)
            assert reactions[force] == pytest.approx(expected, rel=1e-12, abs=1e-12)
            checked.add(force)
        if "normal" in reactions:
            size = abs(reactions["friction"]) / reactions["normal"]
            assert reactions["needed_friction"] == (size if reactions["normal"] > 0.0 else math.inf)
    assert checked == set(formulas) - {"drive_torque"}


STATES = {
    "PivotedBar": [0.2, -0.7, 2.0, 3.0],
    "Incline": [0.3, -0.8],
    "Incline-tilt_rate": [0.3, -0.8, 0.4],
    "CylinderInCylinder-damping": [0.7, 2.5],
    "CylinderInCylinder-tilt": [0.7, 2.5, 3.0],
}


def example(scene):
    """Return the scene with drag, a state and a control."""
    kind = getattr(scene, "control", None)
    key = next(k for k in (f"{type(scene).__name__}-{kind}", type(scene).__name__) if k in STATES)
    state = STATES[key][-2:] if getattr(scene, "track", 1) is None else STATES[key]
    return dataclasses.replace(scene, damping=0.03), state, 0.4


@variants()
def test_forces_of_a_state(scene):
    """`forces` puts the true accelerations in: all agree with Newton and with Euler-Lagrange."""
    scene, state, u = example(scene)
    q, v = coordinates(scene)
    derived = lagrange.acceleration(scene, U)
    motion = scene.motion(state, u)
    formulas = dict(newton(scene)[0])
    prescribed = euler_lagrange(scene, scene.coordinates[1], U)
    if "drive_torque" in formulas:
        formulas["drive_torque"] = prescribed
    if "support_horizontal" in formulas:
        formulas["support_horizontal"] = prescribed
    values = [(getattr(symbolic(scene), f.name), getattr(scene, f.name)) for f in dataclasses.fields(scene)]
    values = [(symbol, number) for symbol, number in values if isinstance(symbol, sympy.Symbol)] + [(U, u)]

    def number(expression):
        free = getattr(q, scene.coordinates[0])
        expression = expression.subs(free.diff(t, 2), derived)
        order = [(v, motion.v), (q, motion.q)]
        for c in scene.coordinates:
            expression = expression.subs(getattr(q, c).diff(t, 2), getattr(motion.a, c))
        for functions, numbers in order:
            for c in scene.coordinates:
                expression = expression.subs(getattr(functions, c), getattr(numbers, c))
        return float(expression.subs(values))

    assert getattr(motion.a, scene.coordinates[0]) == pytest.approx(number(derived), rel=1e-13)
    for force, value in scene.forces(state, u).items():
        if force != "needed_friction":
            assert value == pytest.approx(number(formulas[force]), rel=1e-12)


@variants([FRAME])
def test_energy_balance(scene):
    """A step's change of energy is work less loss, to rounding."""
    scene, state, u = example(scene)
    for dt in (0.01, 0.05):
        balance = scene.energy_balance(state, u, dt)
        size = sum(map(abs, scene.energy(state, u).values())) + abs(balance["work"]) + balance["loss"]
        assert abs(balance["residual"]) < 4e-15 * size
        assert balance["loss"] > 0.0
    rate = (balance["change"], balance["work"] - balance["loss"])
    power = scene.power(state, u)
    assert rate[0] / dt == pytest.approx(float(power["drive"] - power["drag"]), rel=0.5)


# --- the lecture's results ---------------------------------------------------------------------------------


def test_incline_of_the_lecture():
    """x'' = g sin(phi)/(1 + I/mR²), 2/3 g sin(phi) for the solid cylinder; v∞ = k g sin(phi)/beta."""
    scene = Incline()
    p = symbolic(scene)
    phi = sympy.Symbol("phi", real=True)
    free = prescribe(lagrange.acceleration(scene), scene).subs(p.tilt, phi).subs(p.damping, 0)
    assert vanishes(free - p.gravity * sin(phi) / (1 + p.inertia / (p.mass * p.radius**2)))
    assert vanishes(free.subs(p.inertia, p.mass * p.radius**2 / 2) - 2 * p.gravity * sin(phi) / 3)
    fast = Incline(tilt=0.3, damping=50.0).simulate([0.0, 0.0], [0.0] * 20, 1.0)[-1, 1]
    assert fast == pytest.approx(9.81 * math.sin(0.3) / 50.0, rel=1e-14)


@pytest.mark.parametrize(("share", "tilt"), [(0.5, 0.3), (1.0, 0.7), (0.0, 0.5)])
def test_needed_friction_of_the_lecture(share, tilt):
    """mu = K/(1 + K) tan(phi) on a fixed plane without drag, F = kK m g sin(theta) in a fixed shell."""
    plane = Incline(mass=2.0, radius=0.3, inertia=share * 2.0 * 0.09, tilt=tilt)
    needed = plane.forces([0.4, 1.0])["needed_friction"]
    assert needed == pytest.approx(share / (1 + share) * math.tan(tilt), rel=1e-14)
    shell = CylinderInCylinder(mass=2.0, radius=0.1, inertia=share * 2.0 * 0.01, control="damping")
    friction = shell.forces([tilt, 1.0])["friction"]
    assert friction == pytest.approx(share / (1 + share) * 2.0 * 9.81 * math.sin(tilt), rel=1e-13)


def test_shell_of_the_lecture():
    """omega0² = m g (R-r)/(m (R-r)² + I ((R-r)/r)²); f = sqrt(2g/(3(R-r)))/2 pi when solid."""
    scene = CylinderInCylinder(control="damping")
    p = symbolic(scene)
    theta = coordinates(scene)[0].theta
    arm = p.shell_radius - p.radius
    free = prescribe(lagrange.acceleration(scene), scene)
    stiffness = -free.diff(theta).subs(theta.diff(t), 0).subs(theta, 0)
    expected = p.mass * p.gravity * arm / (p.mass * arm**2 + p.inertia * (arm / p.radius) ** 2)
    assert vanishes(stiffness - expected)
    frequency = math.sqrt(2 * 9.81 / (3 * 0.4)) / (2 * math.pi)
    period = CylinderInCylinder().simulate([1e-6, 0.0, 0.0], [0.0] * 64, 1.0 / frequency / 64)
    assert period[-1, :2] == pytest.approx([1e-6, 0.0], abs=1e-15)
    assert period[32, 0] == pytest.approx(-1e-6, rel=1e-10)


def test_bar_at_rest():
    """A hanging bar stays, carries m g, and its energy, zero at the pivot, is -m g L."""
    bar = PivotedBar()
    assert np.array_equal(bar.simulate(np.zeros(4), [0.0] * 3, 0.02), np.zeros((4, 4)))
    assert bar.forces(np.zeros(4))["support_vertical"] == pytest.approx(0.2 * 9.81)
    assert bar.energy(np.zeros(4)) == pytest.approx({"kinetic": 0.0, "potential": -0.5886, "total": -0.5886})
    assert PivotedBar(mass=3.0, com_distance=0.5).inertia == pytest.approx(3.0 * 1.0**2 / 12)


def test_frame_energy_of_the_bar():
    """Without track: change of energy = -m L u (sin(theta1) - sin(theta0)), exactly."""
    bar, u = PivotedBar(track=None), 4.0
    rows = bar.simulate([0.5, -2.0], [u], 0.3)
    work = -0.2 * 0.3 * u * (np.sin(rows[1, 0]) - np.sin(rows[0, 0]))
    energy = bar.energy(rows)["total"]
    assert energy[1] - energy[0] == pytest.approx(work, rel=1e-13)


@pytest.mark.parametrize("tilt", [math.pi / 2, -math.pi / 2])
def test_a_vertical_plane(tilt):
    """The cylinder rolls down a wall as on any slope, but nothing presses it to it: no friction is enough."""
    side = math.copysign(1.0, tilt)
    for damping in (0.0, 0.3):
        plane = Incline(tilt=tilt, damping=damping)
        end = plane.simulate([0.1, -0.2], [0.0], 0.5)[1]
        with mp.workdps(40):
            drag, pull = mpf(damping) / mpf(1.5), side * mpf(9.81) / mpf(1.5)
            exact = linear(drag, pull, mpf(0), mpf(0.1), mpf(-0.2), mpf(0.5))
            assert max(abs(a - b) for a, b in zip(end, exact, strict=True)) < 1e-15
        assert plane.energy_balance([0.1, -0.2], 0.0, 0.5)["residual"] == pytest.approx(0.0, abs=1e-14)
    forces = Incline(tilt=tilt).forces([0.1, -0.2])
    assert abs(forces["normal"]) < 1e-15 and forces["friction"] == pytest.approx(side * 9.81 / 3.0)
    assert forces["needed_friction"] == math.inf
    # The same plane, by tilting it: with the control, and on the way.
    assert Incline(control="tilt").forces([0.1, -0.2], tilt)["needed_friction"] == math.inf
    assert Incline(control="tilt_rate").forces([0.1, -0.2, tilt], 0.0)["needed_friction"] == math.inf
    for beyond in (math.nextafter(tilt, 2.0 * tilt), 1.01 * tilt):
        refuses(Incline, "tilt must be at (most|least)", tilt=beyond)


@pytest.mark.parametrize("share", [0.0, 1e-13, 9.9e-13, 1.01e-12, 1e-9, 1.0])
@pytest.mark.parametrize("mass", [1e-3, 1.0, 1e3])
def test_what_counts_as_no_load(share, mass):
    """A normal force up to 1e-12 of the weight is none, on the plane and in the shell."""
    angle = math.acos(share)
    plane, shell = Incline(mass=mass, control="tilt"), CylinderInCylinder(mass=mass, control="damping")
    for forces in (plane.forces([0.0, 0.0], angle), shell.forces([angle, 0.0])):
        assert math.isinf(forces["needed_friction"]) == (share <= 1e-12)
        if share > 1e-12:
            assert forces["needed_friction"] == pytest.approx(1.0 / 3.0 * math.sin(angle) / share, rel=1e-3)


def test_contact_is_lost():
    shell = CylinderInCylinder(control="damping")
    forces = shell.forces([[3.0, 0.0], [3.0, 50.0]], [0.0, 0.0])
    assert forces["normal"][0] < 0.0 < forces["normal"][1]
    assert forces["needed_friction"][0] == math.inf


# --- parameters --------------------------------------------------------------------------------------------


def refuses(scene, rule, **keywords):
    """Return the message of the ValueError."""
    with pytest.raises(ValueError, match=rule) as error:
        scene(**keywords)
    return str(error.value)


@pytest.mark.parametrize(("scene", "field"), PARAMETERS)
def test_every_parameter_is_checked(scene, field):
    for bad in (math.nan, math.inf, -math.inf, 10**400):
        message = refuses(scene, f"^{field.name} must be finite, got", **{field.name: bad})
        assert str(bad)[:5] in message
    for bad in (True, np.True_, "1", 1j, [1.0], np.array([1.0]), object):
        refuses(scene, f"^{field.name} must be a real number, got", **{field.name: bad})
    unit, above = field.metadata["unit"], field.metadata["above"]
    rules = {"above": ("above", 0.0), "below": ("below", 0.0)}
    rules |= {"least": ("at least", -1e-9), "most": ("at most", 1e-9)}
    for key, (rule, beyond) in rules.items():
        limit = field.metadata[key]
        if limit is not None:
            bad = limit + beyond
            message = refuses(scene, f"^{field.name} must be {rule} {limit:g}", **{field.name: bad})
            assert f"{bad:g} {unit}" in message
    refuses(scene, f"^{field.name} must be (at most|below)", **{field.name: 1e70})
    if above == 0.0:
        refuses(scene, f"^{field.name} must be at least", **{field.name: 1e-70})
    if field.default is None:
        assert getattr(scene(**{field.name: None}), field.name) is not None
    else:
        refuses(scene, f"^{field.name} must be a real number, got None", **{field.name: None})
    value = getattr(scene(), field.name)
    for same in (np.float64(value), np.array(value), Fraction(value)):
        assert type(getattr(scene(**{field.name: same}), field.name)) is float


@pytest.mark.parametrize("radius", [0.5, 0.6])
def test_radius_below_shell_radius(radius):
    refuses(CylinderInCylinder, rf"radius must be below shell_radius=0.5 m, got {radius} m", radius=radius)


@pytest.mark.parametrize("scene", [s for s in SCENES if controls(s) != [{}]])
@pytest.mark.parametrize("control", ["brake", "", None, 3, []])
def test_unknown_control(scene, control):
    refuses(scene, "control must be one of damping, tilt", control=control)


@pytest.mark.parametrize("control", ["tilt", "tilt_rate"])
def test_ignored_tilt(control):
    refuses(Incline, "tilt=0.1 rad would be ignored", control=control, tilt=0.1)


@pytest.mark.parametrize("track", [0.0, -1.0, math.nan, -math.inf, "1", True, [1.0], 1j])
def test_bad_track(track):
    refuses(PivotedBar, "track must be", track=track)


def test_good_track():
    assert PivotedBar(track=None).state_names == ("theta", "theta_dot")
    assert PivotedBar(track=math.inf).state_names == ("s", "s_dot", "theta", "theta_dot")
    assert PivotedBar(track=2).track == 2.0


@pytest.mark.parametrize("scene", SCENES)
def test_unknown_and_positional(scene):
    with pytest.raises(TypeError, match="colour"):
        scene(colour=1.0)
    with pytest.raises(TypeError, match="positional"):
        scene(1.0)


@variants([FRAME])
def test_immutable(scene):
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.mass = 3.0
    twin = dataclasses.replace(scene)
    assert twin == scene and hash(twin) == hash(scene) and twin is not scene
    assert dataclasses.replace(scene, mass=2.5) != scene
    assert len(scene.state_names) == len(scene.state_units) and scene.control_unit


@variants([FRAME])
def test_lagrangian(scene):
    """`lagrangian` is T - V of the very functions, in functions of time."""
    q, v = coordinates(scene)
    twin = symbolic(scene)
    assert vanishes(scene.lagrangian() - (twin.kinetic(q, v, sympy) - twin.potential(q, sympy)))
    assert scene.lagrangian().has(getattr(v, scene.coordinates[0]))
    assert not scene.lagrangian().atoms(sympy.Float)


def test_lagrangian_of_the_bar():
    bar = PivotedBar()
    p = symbolic(bar)
    q, v = coordinates(bar)
    m, arm, g = p.mass, p.com_distance, p.gravity
    expected = m * v.s**2 / 2 + m * arm * v.s * v.theta * cos(q.theta)
    expected += (m * arm**2 + p.inertia) * v.theta**2 / 2 + m * g * arm * cos(q.theta)
    assert sympy.expand(bar.lagrangian() - expected) == 0


@pytest.mark.parametrize(("state", "shape"), [([1.0], (1,)), (np.zeros((2, 4)), (2, 4)), (3.0, ())])
def test_states_of_wrong_shape(state, shape):
    bar = PivotedBar(track=None)
    for method in (bar.energy, bar.forces):
        with pytest.raises(ValueError, match="state must be"):
            method(state)


def test_many_states():
    """Energy and forces broadcast over leading axes."""
    shell = CylinderInCylinder()
    states, u = np.random.default_rng(0).uniform(-1, 1, (2, 5, 3)), np.linspace(-1, 1, 5)
    for method in (shell.energy, shell.forces, shell.power):
        many = method(states, u)
        for key, values in many.items():
            assert values.shape == (2, 5)
            assert values[1, 3] == pytest.approx(float(method(states[1, 3], u[3])[key]), rel=1e-14)


def test_truncation_bound():
    bar = PivotedBar()
    easy, hard = (bar.truncation_bound([0.0, 0.0, 1.0, w], 5.0, 0.02) for w in (5.0, 200.0))
    assert easy.substeps == 1 and 0.0 < easy.theta < easy.theta_dot <= 1e-12
    assert hard.substeps > 1 and 0.0 < hard.theta < hard.theta_dot <= 200e-12
    assert Incline().truncation_bound([0.0, 0.0], 0.0, 0.02) is None
    assert bar.truncation_bound([0.0, 0.0, 1.0, 1e308], 0.0, 1e10).theta == math.inf
    for state, u, dt in (([0.0] * 3, 0.0, 0.02), ([0.0] * 4, math.nan, 0.02), ([0.0] * 4, 0.0, 0.0)):
        with pytest.raises(ValueError, match="must be"):
            bar.truncation_bound(state, u, dt)
