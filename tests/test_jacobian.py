"""Derivatives of a control step against differences in 50-digit arithmetic."""

import math

import mpmath
import numpy as np
import pytest
from contract_scenes import ChargedParticle, RotatingHoop, Trolley
from covering import slow
from reference import exact_step, flow, random_cases
from series_systems import SYSTEMS

from lag_envs import scenes
from lag_envs.envs.model import Model
from lag_envs.scenes import (
    Acrobot,
    CartPole,
    Chain,
    CylinderInCylinder,
    RotaryPendulum,
    Scene,
    StepRefused,
    TwoLinkArm,
    parameter,
)
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.steps import derivatives_of
from lag_envs.tasks.pivoted_bar import SwingUp

CASES = {
    "cart_pole": (CartPole(), [0.3, -1.0, 2.0, 3.0], [4.0], 0.02),
    "friction": (CartPole(friction=0.2), [0.3, -1.0, 2.0, 3.0], [4.0], 0.02),
    "acrobot": (Acrobot(), [0.5, 1.0, -1.0, 2.0], [0.3], 0.02),
    "double": (Chain(bars=2, damping=0.01), [0.1, 0.2, 2.0, -5.0, 1.0, 6.0], [3.0], 0.02),
    "triple, long step": (Chain(bars=3), [0.1, 0.2, 2.0, -5.0, 1.0, 6.0, 0.3, -4.0], [3.0], 0.1),
    "rotary": (RotaryPendulum(), [0.2, 1.0, 2.0, -3.0], [0.1], 0.02),
    "arm": (TwoLinkArm(), [0.2, 1.0, 2.0, -3.0], [0.4, -0.2], 0.02),
    "charge": (ChargedParticle(), [0.2, 1.0, 2.0, -3.0], [], 0.1),
    "hoop": (RotatingHoop(), [0.4, 1.0], [0.01], 0.05),
    "turning shell": (CylinderInCylinder(damping=0.24), [0.3, 1.0, 4.0], [9.0], 0.05),
    "turning plane": (Incline(control="tilt_rate", damping=0.03), [0.1, 0.2, 0.05], [0.3], 0.05),
    "two rates": (Trolley(), [0.2, 0.1, 1.0, 2.0, -0.5, -3.0], [0.7, 0.2, 0.3], 0.02),
    **{
        f"the series' {system.name}": (system.scene, *system.draw(np.random.default_rng(16), 0.5), 0.02)
        for system in SYSTEMS
        if system.name in ("acrobot", "elastic pendulum", "lattice")
    },
}


@pytest.mark.parametrize("case", [case if case == "cart_pole" else slow(case) for case in CASES])
def test_jacobian_is_the_derivative(case):
    scene, state, control, dt = CASES[case]
    a, b = scene.jacobian(state, control, dt) if control else scene.jacobian(state, dt=dt)
    found = np.concatenate([a, b], axis=1)
    with mpmath.workdps(50):
        at = [mpmath.mpf(x) for x in [*state, *control]]
        h = mpmath.mpf(10) ** -12
        columns = []
        for j in range(len(at)):
            ends = []
            for side in (h, -h):
                moved = [*at[:j], at[j] + side, *at[j + 1 :]]
                ends.append(exact_step(scene, moved[: len(state)], moved[len(state) :], dt))
            columns.append([float(x) for x in (ends[0] - ends[1]) / (2 * h)])
    expected = np.array(columns).T
    n = len(state)
    by_state, by_control = scene.vjp([state] * n, [control] * n, dt, np.eye(n))
    for slopes in (found, np.concatenate([by_state, by_control], axis=1)):
        np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max()))


def oracle(case):
    """Return the derivatives of a step by differences of the lecture's equations in 60 digits."""
    at = [mpmath.mpf(x) for x in [*case["state"], case["control"]]]
    n, columns = len(case["state"]), []
    with mpmath.workdps(60):
        h = mpmath.mpf(10) ** -15
        for j in range(len(at)):
            ends = [
                flow(case["scene"], case["params"], moved[:n], moved[n], case["dt"], 50)
                for moved in ([*at[:j], at[j] + side, *at[j + 1 :]] for side in (h, -h))
            ]
            columns.append([float((a - b) / (2 * h)) for a, b in zip(*ends, strict=True)])
    return np.array(columns).T


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "n"), [("task", 3), ("damped", 40), ("stiff", 40)])
def test_exact_flows(kind, n):
    """Each scene and control, with drag from gamma dt = 0 to 1e6: also with the drag as control."""
    for case in random_cases(kind, n, 41 + n):
        scene = getattr(scenes, case["scene"])(**case["params"])
        found = np.concatenate(scene.jacobian(case["state"], case["control"], case["dt"]), axis=1)
        expected = oracle(case)
        size = np.maximum(np.abs(expected).max(axis=0), 1e-3)  # column by column
        assert (np.abs(found - expected) <= 1e-12 * size).all(), case


#: Slow manifold and boundary layer, with a field from the control, or one that is negligible beside it.
HEAVY = {
    "support at rest": ("PivotedBar", {"damping": 40.0}, [0.1, 0.0, 2.0, -30.0], 0.0, 0.02),
    "support driven": ("PivotedBar", {"damping": 4e3}, [0.1, 0.0, 2.0, 3.0], 9.0, 0.05),
    "no field": ("PivotedBar", {"damping": 40.0, "gravity": 0.0}, [0.0, 0.0, 2.0, 1.0], 0.0, 0.02),
    "shell turns": ("CylinderInCylinder", {"damping": 40.0, "control": "tilt"}, [0.5, 2.0, 3.0], -9.0, 0.5),
    "shell turns without gravity": (
        "CylinderInCylinder",
        {"damping": 1e3, "control": "tilt", "gravity": 0.0},
        [0.5, 2.0, 3.0],
        -9.0,
        0.5,
    ),
    "the control is the drag": ("CylinderInCylinder", {"control": "damping"}, [1.0, -20.0], 3e4, 0.05),
    "plane turns": ("Incline", {"control": "tilt_rate", "damping": 1e5}, [0.3, 2.0, 0.2], -0.5, 0.05),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", HEAVY)
def test_heavy_damping(case):
    name, given, state, control, dt = HEAVY[case]
    bar = {"mass": 0.2, "com_distance": 0.3, "gravity": 9.81, "track": math.inf}
    rolling = {"mass": 1.0, "radius": 0.1, "gravity": 9.81}
    shell = rolling | {"shell_radius": 0.5}
    params = {"PivotedBar": bar, "Incline": rolling, "CylinderInCylinder": shell}[name] | given
    found = np.concatenate(getattr(scenes, name)(**params).jacobian(state, control, dt), axis=1)
    problem = {"scene": name, "params": params, "state": state, "control": control, "dt": dt}
    expected = oracle(problem)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max()))


@pytest.mark.slow
def test_what_equations_lack_has_no_column():
    scene = CartPole()
    a, b = scene.jacobian([0.3, -1.0, 2.0, 3.0], 4.0, 0.02)
    np.testing.assert_array_equal(a[:, 0], [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(a[:, 1], [0.02, 1.0, 0.0, 0.0])
    assert derivatives_of(scene, ())._columns == ("q1", "v1", "control_force")

    class Free(Scene):
        coordinates = {"x": "m"}

        def kinetic(self, q, v, xp):
            return 0.5 * v.x * v.x

        def potential(self, q, xp):
            return 0.0 * q.x

    a, b = Free().jacobian([1.0, 2.0], dt=0.5)
    np.testing.assert_array_equal(a, [[1.0, 0.5], [0.0, 1.0]])
    assert b.shape == (2, 0)


def test_rows_of_a_batch():
    scene, state, _, dt = CASES["double"]
    states = np.array([state, np.multiply(state, 0.5), np.zeros(6)])
    a, b = scene.jacobian(states, [[3.0], [1.0], [0.0]], dt)
    assert a.shape == (3, 6, 6) and b.shape == (3, 6, 1)
    for i, u in enumerate([3.0, 1.0, 0.0]):
        one = scene.jacobian(states[i], u, dt)
        np.testing.assert_array_equal(a[i], one[0])
        np.testing.assert_array_equal(b[i], one[1])


@pytest.mark.slow
def test_step_that_is_refused():
    # It would need so many substeps that it is refused, like the step itself.
    bar = scenes.PivotedBar(damping=0.0)
    with pytest.raises(StepRefused, match=r"the step of row 1.* more than 1,000,000 substeps"):
        bar.jacobian([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1e12]])
    with pytest.raises(StepRefused, match=r"cosine of theta, .* beyond 2.6e\+07 rad; subtract whole turns"):
        scenes.CartPole().jacobian([0.2, 1.0, 3e7, 0.0], 0.1, dt=0.02)
    far = r"the gradient of row 1 needs sine and cosine of theta=27000000, which .* subtract whole turns"
    with pytest.raises(StepRefused, match=far):
        bar.vjp([[0.0, 0.0, 3.0, 0.0], [0.0, 0.0, 2.7e7, 0.0]], 0.0, 0.02, np.ones((2, 4)))
    with pytest.raises(StepRefused, match=r"row 0 .* theta=26000000"):  # after the step it has got there
        Model(SwingUp()).vjp([[0.0, 0.0, 26e6 - 1e-3, 1.0]], [0.0], by_rewards=1.0)


@pytest.mark.slow
def test_step_from_where_the_model_is_singular_is_refused():
    class Rope(ChargedParticle):
        def kinetic(self, q, v, xp):
            return self.mass * (v.x**2 + (q.x * v.y) ** 2) / 2

    with pytest.raises(StepRefused, match="the step of row 1"):
        Rope().jacobian([[1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]], dt=0.02)


# --- what the certificate of the step does not cover ---


class Well(Scene):
    """A mass on a stiff spring, and another one that only the motion of the first would slow down."""

    coordinates = {"x": "m", "y": "m"}
    controls = {"force": "N"}
    stiffness: float = parameter(1e6, "N/m")

    def kinetic(self, q, v, xp):
        return 0.5 * v.x**2 + 0.5 * v.y**2 * (1.0 + q.x**2)

    def potential(self, q, xp):
        return self.stiffness * (0.5 * q.x**2 + q.x**4) + q.y**2

    def applied(self, q, v, u, xp):
        return {"x": u.force}


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [1e4, 1e6])
def test_at_rest_where_series_have_no_terms(stiffness):
    scene, dt, w = Well(stiffness=stiffness), 0.02, math.sqrt(stiffness)
    c, s = math.cos(w * dt), math.sin(w * dt)
    exact = np.array([[c, s / w], [-w * s, c]])
    by_force = np.array([(1.0 - c) / w**2, s / w])
    a, b = scene.jacobian([0.0] * 4, 0.0, dt)
    np.testing.assert_allclose(a[:2, :2], exact, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(b[:2, 0], by_force, rtol=1e-12, atol=1e-14)
    for row in range(2):
        by_state, by_control = scene.vjp([0.0] * 4, 0.0, dt, np.eye(4)[row])
        np.testing.assert_allclose(by_state[:2], exact[row], rtol=1e-12, atol=1e-12 * w)
        np.testing.assert_allclose(by_control[0], by_force[row], rtol=1e-12)


class Brake(Scene):
    """A mass that a constant force pulls against a brake whose force changes its sign very fast."""

    coordinates = {"x": "m"}
    controls = {"brake": "N"}
    mass: float = parameter(1.0, "kg", above=0.0)
    more: float = parameter(0.0, "N", least=0.0)

    def kinetic(self, q, v, xp):
        return 0.5 * self.mass * v.x**2

    def potential(self, q, xp):
        return -self.mass * q.x

    def applied(self, q, v, u, xp):
        return {"x": -(u.brake + self.more) * xp.tanh(v.x / 0.01)}


@pytest.mark.slow
@pytest.mark.parametrize(("mass", "more"), [(1.0, 0.0), (1.0, 1e-12), (1.0, 1e-6), (1e9, 0.0), (1e-8, 0.0)])
def test_what_is_multiplied_by_hardly_anything_has_its_derivatives(mass, more):
    """The brake that does not act changes the velocity by the integral of -tanh, from -2 to 0."""
    scene, state = Brake(mass=mass, more=more), [0.0, -0.02]
    exact = 0.01 * (2.0 + math.log1p(math.exp(-4.0)) - math.log(2.0)) / mass
    _, by_control, by_more = scene.jacobian(state, 0.0, 0.02, parameters=["more"])
    found = scene.vjp(state, 0.0, 0.02, [0.0, 1.0], parameters=["more"])
    for number in (by_control[1, 0], by_more[1, 0], found[1][0], found[2][0]):
        assert number == pytest.approx(exact, rel=1e-12 if more < 1e-9 else 1e-4)


class TurnedRod(Scene):
    """A rod that a torque turns from rest, so that most terms of its derivatives' series are 0."""

    coordinates = {"theta": "rad", "x": "m"}
    controls = {"torque": "N m"}
    by_cos: float = parameter(0.0, "J")
    by_sin: float = parameter(0.0, "J")
    by_square: float = parameter(0.0, "J")

    def kinetic(self, q, v, xp):
        return 0.5 * (v.theta**2 + v.x**2)

    def potential(self, q, xp):
        by_angle = self.by_cos * xp.cos(q.theta) + self.by_sin * xp.sin(q.theta)
        return by_angle + self.by_square * xp.sin(q.theta**2)

    def applied(self, q, v, u, xp):
        return {"theta": u.torque}


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.3, 1.0, 2.5])
@pytest.mark.parametrize("dt", [0.02, 0.1, 0.5])
def test_series_with_gaps(dt, angle):
    """Every fourth term, or every eighth: the last ones may all be 0 although others follow."""
    scene, torque, names = TurnedRod(), 2.0 * angle / dt**2, ["by_cos", "by_sin", "by_square"]
    by_parameters = scene.jacobian([0.0] * 4, torque, dt, parameters=names)[2][1]
    backwards = scene.vjp([0.0] * 4, torque, dt, [0.0, 1.0, 0.0, 0.0], parameters=names)[2]
    forces = (mpmath.sin, lambda x: -mpmath.cos(x), lambda x: -2.0 * x * mpmath.cos(x**2))
    for i, force in enumerate(forces):
        exact = mpmath.quad(lambda t, force=force: force(torque * t**2 / 2), mpmath.linspace(0, dt, 9))
        assert by_parameters[i] == pytest.approx(float(exact), rel=2e-12), (names[i], "forwards")
        assert backwards[i] == pytest.approx(float(exact), rel=2e-12), (names[i], "backwards")


class SwingingAtwood(scenes.Scene):
    """Two masses on a rope over a pulley; one of them swings."""

    coordinates = {"r": "m", "theta": "rad"}

    def kinetic(self, q, v, xp):
        return 1.75 * v.r**2 + 0.5 * q.r**2 * v.theta**2

    def potential(self, q, xp):
        return 9.81 * q.r * (2.5 - xp.cos(q.theta))


@pytest.mark.slow
def test_what_needs_short_substeps_once_is_not_paid_for_ever():
    """The rope nearly runs out at 0.084 s; after that substeps grow again."""
    scene, no_control = SwingingAtwood(), np.zeros((2, 0))
    states = np.array([[0.1, -1.0, 0.1, 0.5], [1.0, 0.2, 0.3, 0.1]])
    found, _ = scene.jacobian(states, no_control, 0.1)
    assert scene.step_bound(states[0], [], 0.1).substeps > 50
    path, product = scene.simulate(states[0], 40, 0.0025), np.eye(4)
    for state in path[:-1]:
        product = scene.jacobian(state, [], 0.0025)[0] @ product
    np.testing.assert_allclose(found[0], product, rtol=0.0, atol=2e-6 * np.abs(product).max())
    seeds = np.random.default_rng(0).normal(size=(2, 4))
    pulled, _ = scene.vjp(states, no_control, 0.1, seeds)
    wanted = np.einsum("ni,nij->nj", seeds, found)
    np.testing.assert_allclose(pulled, wanted, rtol=0.0, atol=1e-12 * np.abs(wanted).max())


class Neighbours(Scene):
    """Two pendulums on one pivot, whose bobs repel each other at a short distance."""

    coordinates = {"a": "rad", "b": "rad"}
    repulsion: float = parameter(1e-9, "N m2")

    def kinetic(self, q, v, xp):
        return 0.5 * (v.a**2 + v.b**2)

    def distance(self, q, xp):
        x, y = xp.sin(q.a) - xp.sin(q.b), xp.cos(q.b) - xp.cos(q.a)
        return xp.sqrt(x**2 + y**2)

    def potential(self, q, xp):
        return self.repulsion / self.distance(q, xp) - 9.81 * (xp.cos(q.a) + xp.cos(q.b))


class HalfAngles(Neighbours):
    def distance(self, q, xp):
        return 2.0 * xp.sin((q.b - q.a) / 2.0)


def test_the_distance_of_close_points_keeps_its_digits():
    """Its square, multiplied out, is 2 - 2 cos(a - b)."""
    state = [0.3, 0.1, 0.3 + 1e-5, 0.1]
    with mpmath.workdps(40):
        gap = mpmath.mpf(state[2]) - mpmath.mpf(state[0])
        push = mpmath.mpf(1e-9) * mpmath.cos(gap / 2) / (4 * mpmath.sin(gap / 2) ** 2)
        wanted = float(-push - mpmath.mpf(9.81) * mpmath.sin(mpmath.mpf(state[0])))
    for scene in (Neighbours(), HalfAngles()):
        assert scene.acceleration(state)["a"] == pytest.approx(wanted, rel=1e-10)


@pytest.mark.slow
def test_so_do_the_step_and_its_derivatives():
    state = [0.3, 0.1, 0.3 + 1e-4, 0.1]
    one, other = Neighbours(), HalfAngles()
    assert one.step_bound(state, [], 0.02).substeps <= other.step_bound(state, [], 0.02).substeps + 2
    after = other.simulate(state, 1, 0.02)[-1]
    np.testing.assert_allclose(one.simulate(state, 1, 0.02)[-1], after, rtol=0.0, atol=1e-13)
    found, wanted = (scene.jacobian(state, [], 0.02)[0] for scene in (one, other))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-11 * np.abs(wanted).max())


class Damped(Scene):
    """Two masses in a plane, with a spring and a damper between them."""

    coordinates = {"x1": "m", "y1": "m", "x2": "m", "y2": "m"}

    def kinetic(self, q, v, xp):
        return 0.5 * sum(w**2 for w in v)

    def potential(self, q, xp):
        return 5.0 * ((q.x1 - q.x2) ** 2 + (q.y1 - q.y2) ** 2)

    def dissipation(self, q, v, u, xp):
        dx, dy = q.x1 - q.x2, q.y1 - q.y2
        return (dx * (v.x1 - v.x2) + dy * (v.y1 - v.y2)) ** 2 / (dx**2 + dy**2)


class Forced(Damped):
    """The damper as a force."""

    def dissipation(self, q, v, u, xp):
        return 0.0

    def applied(self, q, v, u, xp):
        dx, dy = q.x1 - q.x2, q.y1 - q.y2
        f = 2.0 * (dx * (v.x1 - v.x2) + dy * (v.y1 - v.y2)) / (dx**2 + dy**2)
        return {"x1": -f * dx, "y1": -f * dy, "x2": f * dx, "y2": f * dy}


class Inerter(Damped):
    """A flywheel that the damper's rod turns."""

    def kinetic(self, q, v, xp):
        return super().kinetic(q, v, xp) + super().dissipation(q, v, None, xp)


BETWEEN = pytest.mark.parametrize("scene", [kind() for kind in (Damped, Forced, Inerter)], ids=repr)


@BETWEEN
@pytest.mark.parametrize("gap", [1 / 8, 1 / 1024])
def test_a_damper_does_not_depend_on_where_it_is(scene, gap):
    """Multiplied out, it was a small difference of squares of places."""
    near, far = (np.array([x, 0.3, x, -0.2, x + gap, 0.1, x + gap / 2, 0.25]) for x in (0.0, 256.0))
    assert scene.acceleration(far) == pytest.approx(scene.acceleration(near), rel=1e-14)


@pytest.mark.slow
@BETWEEN
def test_nor_does_its_step(scene):
    near, far = (np.array([x, 0.3, x, -0.2, x + 1 / 8, 0.1, x + 1 / 16, 0.25]) for x in (0.0, 256.0))
    assert scene.step_bound(far, [], 0.02).substeps == scene.step_bound(near, [], 0.02).substeps == 1
    found, wanted = (scene.jacobian(state, [], 0.02)[0] for state in (far, near))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-11 * np.abs(wanted).max())
