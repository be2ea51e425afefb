"""Physics: results are derived again, from places by Newton's laws, and checked against closed forms."""

import dataclasses
import math
import re
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from mpmath import mp, mpf
from reference import linear
from sympy import cos, sin

from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes import Chain, CylinderInCylinder, Incline, PivotedBar
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.symbolic import symbolic, t

U = sympy.Symbol("u", real=True)
SCENES = (PivotedBar, Incline, CylinderInCylinder)


def vanishes(expression):
    """Return whether an expression, rational but for sines and cosines, is identically zero."""
    expression = sympy.numer(sympy.together(sympy.nsimplify(expression))).expand()
    for cosine in expression.atoms(cos):
        expression = expression.subs(cosine**2, 1 - sin(*cosine.args) ** 2).expand()
    return expression == 0


def controls(scene):
    """Return the keywords that choose a control of this kind of scene."""
    return [{"control": name} for name in scene.modes] or [{}]


def name(scene, keywords):
    return "-".join([scene.__name__, *map(str, keywords.values())])


def variants(extra=()):
    pairs = [(scene, keywords) for scene in SCENES for keywords in controls(scene)] + list(extra)
    return pytest.mark.parametrize("scene", [pytest.param(s(**k), id=name(s, k)) for s, k in pairs])


FRAME = (PivotedBar, {"track": None})
PARAMETERS = [
    pytest.param(scene, field, id=f"{scene.__name__}-{field.name}")
    for scene in SCENES
    for field in dataclasses.fields(scene())
    if "unit" in field.metadata
]


def moving(scene):
    """Return the names of the coordinates that move in Newton's laws; all others rest."""
    return layout_of(scene).names[:2]


def coordinates(scene):
    """Return the moving coordinates as functions of time, and their velocities."""
    q = {c: sympy.Function(c, real=True)(t) for c in moving(scene)}
    return SimpleNamespace(**q), SimpleNamespace(**{c: f.diff(t) for c, f in q.items()})


# --- Newton ------------------------------------------------------------------------------------------------


def newton(scene):
    """Return reaction forces from the accelerations of centre of mass and spin, and the residuals.

    Written for any motion of both coordinates; the drag c acts between the axis and the surface it rolls on.
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


@variants([FRAME])
def test_forces_are_newton(scene):
    """`acceleration` obeys the laws of Newton and Euler, and `forces` are those in them, at random."""
    rng = np.random.default_rng(5)
    forces, laws = newton(scene)
    checked = set()
    for _ in range(20):
        numbers = {name: float(rng.uniform(0.2, 1.0)) for name in parameter_names(scene) if name != "track"}
        if "shell_radius" in numbers:
            numbers["shell_radius"] += 1.0
        body = dataclasses.replace(scene, **numbers)
        u = float(rng.uniform(0.0, 1.0))
        state = rng.uniform(-2.0, 2.0, len(scene.state_names))
        point = body._point(state, u)[0]
        q, v = coordinates(scene)
        # Derivatives first: a place that is replaced by a number has none.
        values = [(getattr(q, c).diff(t, 2), float(point.acceleration[c])) for c in moving(scene)]
        values += [(getattr(v, c), float(point.values[velocity(c)])) for c in moving(scene)]
        values += [(getattr(q, c), float(point.values[place(c)])) for c in moving(scene)]
        twin = symbolic(scene)
        values += [(getattr(twin, name), number) for name, number in numbers.items()] + [(U, u)]

        def number(expression, values=values):
            return float(expression.subs(values))

        found = body.forces(state, u)
        size = 1.0 + sum(abs(float(f)) for f in found.values() if np.isfinite(f))
        for law in laws.values():
            assert abs(number(law)) < 1e-13 * size
        for force, formula in forces.items():
            if force in found:
                assert found[force] == pytest.approx(number(formula), abs=1e-13 * size)
                checked.add(force)
        if "normal" in found:
            share = abs(found["friction"]) / found["normal"]
            assert found["needed_friction"] == (share if found["normal"] > 0.0 else math.inf)
    assert checked == set(forces) & set(found)
    assert checked >= set(forces) - {"drive_torque"}


@variants([FRAME])
def test_energy_balance(scene):
    """A step's change of energy is work minus loss, to rounding."""
    scene, u = dataclasses.replace(scene, damping=0.03), 0.4
    state = [0.2, -0.7, 0.7, 2.5][-len(scene.state_names) :]
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
    for share in (0.0, 0.5, 1.0):
        free = Incline(mass=2.0, radius=0.3, inertia=share * 0.18, tilt=0.3).acceleration([0.4, 1.0])["x"]
        assert free == pytest.approx(9.81 * math.sin(0.3) / (1.0 + share), rel=1e-15)
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
    m, arm, inertia, radius, g = 2.0, 0.4, 0.03, 0.1, 9.81
    shell = CylinderInCylinder(mass=m, radius=radius, inertia=inertia, control="damping")
    expected = m * g * arm / (m * arm**2 + inertia * (arm / radius) ** 2)
    assert shell.linearise([0.0, 0.0])[0][1, 0] == pytest.approx(-expected, rel=1e-14)
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
    """The cylinder rolls down a wall as on any slope, but nothing presses it on: no friction is enough."""
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
    """A normal force up to 1e-12 of the weight counts as none, on the plane and in the shell."""
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
    weightless = CylinderInCylinder(control="damping", gravity=0.0)
    assert weightless.forces([0.0, 0.0])["needed_friction"] == math.inf
    assert weightless.forces([0.0, 1.0])["needed_friction"] == 0.0


# --- parameters --------------------------------------------------------------------------------------------


def refuses(scene, rule, **keywords):
    """Return the message of the ValueError."""
    with pytest.raises(ValueError, match=rule) as error:
        scene(**keywords)
    return str(error.value)


@pytest.mark.parametrize(("scene", "field"), PARAMETERS)
def test_every_parameter_is_checked(scene, field):
    for bad in (math.nan, -math.inf, 10**400, *([] if field.metadata["endless"] else [math.inf])):
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
    if field.metadata["made"]:
        assert getattr(scene(**{field.name: None}), field.name) is not None
    elif field.metadata["optional"]:
        assert getattr(scene(**{field.name: None}), field.name) is None
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


def test_good_track():
    assert PivotedBar(track=None).state_names == ("theta", "theta_dot")
    assert PivotedBar(track=math.inf).state_names == ("s", "s_dot", "theta", "theta_dot")
    assert PivotedBar(track=2).track == 2.0


@variants([FRAME])
def test_lagrangian(scene):
    """`lagrangian` is a function of time, with exact numbers."""
    for c in type(scene).coordinates:
        assert scene.lagrangian().has(sympy.Function(c, real=True)(t).diff(t))
    assert not scene.lagrangian().atoms(sympy.Float)


def test_many_states():
    """Energy and forces broadcast over leading axes."""
    shell = CylinderInCylinder()
    states, u = np.random.default_rng(0).uniform(-1, 1, (2, 5, 3)), np.linspace(-1, 1, 5)
    for method in (shell.energy, shell.forces, shell.power):
        many = method(states, u)
        for key, values in many.items():
            assert values.shape == (2, 5)
            assert values[1, 3] == pytest.approx(float(method(states[1, 3], u[3])[key]), rel=1e-14)


@pytest.mark.parametrize(("state", "shape"), [([1.0], "(1,)"), (np.zeros((2, 4)), "(2, 4)"), (3.0, "()")])
def test_states_of_another_shape_are_refused(state, shape):
    bar = PivotedBar(track=None)
    for method in (bar.energy, bar.forces, bar.power):
        with pytest.raises(ValueError, match=re.escape(f"(theta, theta_dot), got shape {shape}")):
            method(state)


def test_step_bound():
    bar = PivotedBar()
    easy, hard = (bar.step_bound([0.0, 0.0, 1.0, w], 5.0, 0.02) for w in (5.0, 200.0))
    assert easy.kind == hard.kind == "proved before the step" and easy.order == 14
    assert easy.substeps == 1 and 0.0 < easy.bounds["theta"] < easy.bounds["theta_dot"] <= 1e-12
    assert hard.substeps > 1 and 0.0 < hard.bounds["theta"] < hard.bounds["theta_dot"] <= 200e-12
    assert easy.bounds["s"] == easy.bounds["s_dot"] == 0.0
    assert bar.truncation_bound([0.0, 0.0, 1.0, 5.0], 5.0, 0.02) == easy
    for still in (Incline(), Incline(control="tilt_rate")):
        found = still.step_bound([0.0] * len(still.state_names), 0.1, 0.02)
        assert found.kind == "stepped to rounding" and not any(found.bounds.values())
    assert bar.step_bound([0.0, 0.0, 1.0, 1e308], 0.0, 1e10).bounds["theta"] == math.inf
    for state, u, dt in (([0.0] * 3, 0.0, 0.02), ([0.0] * 4, math.nan, 0.02), ([0.0] * 4, 0.0, 0.0)):
        with pytest.raises(ValueError, match="must be"):
            bar.step_bound(state, u, dt)
    for bound in (bar.step_bound, bar.truncation_bound, Chain(bars=2).step_bound):
        with pytest.raises(ValueError, match=r"one set of controls, got shape \(2, 1\)"):
            bound([0.0] * len(bound.__self__.state_names), [1.0, 2.0], 0.02)
