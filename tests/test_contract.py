"""The contract of a scene: what its formulas are given, and what follows from them."""

import copy
import inspect
import math
import pickle
import re
from fractions import Fraction

import cloudpickle
import contract_scenes
import gymnasium as gym
import numpy as np
import pytest
import sympy
from contract_scenes import cart
from reference import agreed_end
from sympy.physics.vector import dynamicsymbols

from lag_envs.mechanics.algebra import FormulaError
from lag_envs.report.oracle import oracle_of
from lag_envs.scenes.acrobot import Acrobot
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.cart_pole import CartPole
from lag_envs.scenes.chain import Chain
from lag_envs.scenes.cylinder_in_cylinder import CylinderInCylinder
from lag_envs.scenes.derivation import code_of
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.pivoted_bar import PivotedBar
from lag_envs.scenes.rotary_pendulum import RotaryPendulum
from lag_envs.scenes.symbolic import equations, t
from lag_envs.scenes.two_link_arm import TwoLinkArm

# --- places, velocities and controls ---


def test_numbers_go_by_name_by_index_and_in_order():
    class Chain3(Scene):
        coordinates = {"a": "m", "b": "m", "c": "m"}
        prescribed = {"s": "m"}
        controls = {"first": "N", "second": "N"}

        def kinetic(self, q, v, xp):
            a, b, c, _ = v
            assert len(v) == 4
            return a * a / 2 + sum(w**2 for w in v[1:3]) / 2 + 0 * (b + c)

        def potential(self, q, xp):
            return sum(x**2 for x in q) / 2 + q[-1] * q.a + q["b"] ** 2

        def applied(self, q, v, u, xp):
            first, second = u
            return {"a": first, "b": u[1], "c": u.second - second}

    acceleration = Chain3().acceleration([1.0, 0.0, 2.0, 0.0, 3.0, 0.0], [10.0, 20.0])
    assert list(acceleration.values()) == [9.0, 14.0, -3.0]


def test_modes_share_formulas_and_leave_no_code():
    assert Incline.control == "damping" and Acrobot().control_names == ("elbow_torque",)
    for mode, names in (("damping", ("drag",)), ("tilt", ("phi",)), ("tilt_rate", ("phi_dot",))):
        scene = Incline(control=mode)
        assert scene.control_names == names
        assert "drag" in scene.mechanics.text if mode == "damping" else "drag" not in scene.mechanics.text
    with pytest.raises(ValueError, match="control must be one of damping, tilt, tilt_rate, got 'drag'"):
        Incline(control="drag")

    class Cart(cart(False)):
        controls = {}
        modes = {"pushed": {"force": "N"}, "free": {}}

        def applied(self, q, v, u, xp):
            return {"x": u.force}

    assert Cart().control == "pushed" and list(inspect.signature(Cart).parameters)[-1] == "control"
    free = Cart(control="free")
    assert free.control_names == () and "control" not in free.mechanics.force[0].text
    assert free.acceleration([1.0, 0.0])["x"] == -2.0


def test_structural_fields_may_branch_and_count():
    for bars in (1, 2, 5):
        names = Chain(bars=bars).state_names
        assert len(names) == 2 + 2 * bars and names[-1] == f"theta_{bars}_dot"
    for bad in (0, 1.5, True, "2"):
        with pytest.raises(ValueError, match="bars must be a whole number above 0"):
            Chain(bars=bad)


def test_control_may_depend_on_a_structural_field():
    class Motors(Scene):
        n: int = 3

        @property
        def coordinates(self):
            return {f"x_{i}": "m" for i in range(self.n)}

        @property
        def controls(self):
            return {f"f_{i}": "N" for i in range(self.n)}

        def kinetic(self, q, v, xp):
            return sum(w**2 for w in v) / 2

        def potential(self, q, xp):
            return 0.0

        def applied(self, q, v, u, xp):
            return {f"x_{i}": u[i] for i in range(self.n)}

    assert Motors(n=2).acceleration([0.0] * 4, [1.0, 2.0]) == {"x_0": 1.0, "x_1": 2.0}
    assert Motors().control_units == ("N", "N", "N")


def layout(controls, **declared):
    """Return names and units of the state of a scene with free x and theta and prescribed s and h."""

    class Free(Scene):
        coordinates = {"x": "m", "theta": "rad"}
        prescribed = {"s": "furlong", "h": ""}

        def kinetic(self, q, v, xp):
            return (v.x + v.s) ** 2 + (v.theta + v.h) ** 2

        def potential(self, q, xp):
            return q.x**2 + (q.theta) ** 2

        def applied(self, q, v, u, xp):
            return {"x": sum(x for name, x in zip(self.controls, u, strict=True) if name == "push")}

    scene = type("Scene1", (Free,), {"controls": controls, **declared})()
    return scene.state_names, scene.state_units


# --- the state ---


@pytest.mark.parametrize(
    ("controls", "names"),
    [
        ({}, "x x_dot theta theta_dot"),
        ({"push": "N"}, "x x_dot theta theta_dot"),
        ({"s_ddot": "a"}, "s s_dot x x_dot theta theta_dot"),
        ({"h_ddot": "a"}, "h h_dot x x_dot theta theta_dot"),
        ({"h_ddot": "a", "s_ddot": "a"}, "s s_dot h h_dot x x_dot theta theta_dot"),
        ({"s_dot": "a"}, "s x w_x theta w_theta"),
        ({"s_dot": "a", "h_ddot": "a"}, "s h h_dot x w_x theta w_theta"),
        ({"s": "a"}, "x x_dot theta theta_dot"),
        ({"s": "a", "h_dot": "a"}, "h x w_x theta w_theta"),
    ],
    ids=str,
)
def test_state_follows_from_the_names_of_the_controls(controls, names):
    assert layout(controls)[0] == tuple(names.split())


@pytest.mark.parametrize("unit", ["radians", "radian", "Rad", "deg", "degrees", "°", "deg/s"])
def test_angles_are_in_rad(unit):
    with pytest.raises(FormulaError, match=f"the unit of 's_ddot' is '{unit}'; write 'rad'"):
        layout({"s_ddot": unit})


def test_other_units_are_never_read():
    assert layout({"s_ddot": "acres", "h_ddot": ""})[1] == (
        "furlong", "furlong/s", "", "1/s", "m", "m/s", "rad", "rad/s"
    )  # fmt: skip
    assert layout({"s_dot": "acres"})[1] == ("furlong", "m", "m/s", "rad", "rad/s")
    assert CylinderInCylinder().control_units == ("rad/s²",)


def test_order_and_omission_are_declared():
    assert layout({"s_ddot": ""}, left_out=("s",))[0] == ("s_dot", "x", "x_dot", "theta", "theta_dot")
    assert layout({"s_ddot": ""}, left_out=["s", "s_dot"])[0] == ("x", "x_dot", "theta", "theta_dot")
    assert layout({"s_dot": ""}, left_out=("s",))[0] == ("x", "w_x", "theta", "w_theta")
    turned = ("theta_dot", "x_dot", "theta", "x")
    assert layout({}, state=turned)[0] == turned
    assert Incline(control="tilt_rate").state_names == ("x", "w", "phi")


def test_free_place_may_be_left_out():
    class Coasting(Scene):
        coordinates = {"x": "m", "theta": "rad"}
        left_out = ("x",)

        def kinetic(self, q, v, xp):
            return v.x**2 + v.x * v.theta * xp.cos(q.theta) + v.theta**2

        def potential(self, q, xp):
            return -xp.cos(q.theta)

    scene = Coasting()
    assert scene.state_names == ("x_dot", "theta", "theta_dot")
    whole = type("Whole", (Coasting,), {"left_out": ()})()
    path = whole.simulate([5.0, 1.0, 0.2, 0.3], 3, 0.02)
    np.testing.assert_array_equal(scene.simulate([1.0, 0.2, 0.3], 3, 0.02), path[:, 1:])
    A, B = scene.linearise([1.0, 0.2, 0.3])
    assert A.shape == (3, 3) and B.shape == (3, 0)


# --- consequences ---


def test_parameter_that_is_zero_leaves_no_code_and_another_value_gives_the_same():
    """In a denominator or a function it is inserted at once; elsewhere code leaves out its products."""
    damped = RotaryPendulum(damping=0.1)
    assert damped.mechanics.key == RotaryPendulum(damping=0.2, mass=3.0).mechanics.key
    assert code_of(RotaryPendulum(), 0.02) is not code_of(damped, 0.02)
    assert code_of(damped, 0.02) is code_of(RotaryPendulum(damping=0.2, mass=3.0), 0.02)

    class Soft(cart(False)):
        width: float = parameter(0.5, "m", least=0.0)
        slope: float = parameter(0.0, "N", least=0.0)

        def potential(self, q, xp):
            return self.spring * xp.sqrt(1 + q.x**2 + self.width * q.x**4) + self.slope * q.x

    assert "width" in Soft().mechanics.text and "width" not in Soft(width=0.0).mechanics.text
    assert Soft(width=0.1).mechanics.key == Soft(width=0.2).mechanics.key != Soft(width=0.0).mechanics.key
    assert Soft(width=0.0).acceleration([1.0, 0.0])["x"] == pytest.approx(-math.sqrt(2.0))


class Bowl(Scene):
    """A sphere that rolls in a bowl of nearly its own radius, on a spring-borne sledge."""

    bowl: float = parameter(1.0, "m", above=0.0)
    sphere: float = parameter(1.0 - 2.0**-20 + 2.0**-50, "m", above=0.0)
    coordinates = {"x": "m", "theta": "rad"}
    controls = {"force": "N"}

    def kinetic(self, q, v, xp):
        gap = self.bowl - self.sphere
        along, up = v.x + gap * v.theta * xp.cos(q.theta), gap * v.theta * xp.sin(q.theta)
        return 0.5 * v.x**2 + 0.5 * (along**2 + up**2) + 0.2 * gap**2 * v.theta**2

    def potential(self, q, xp):
        return -9.81 * (self.bowl - self.sphere) * xp.cos(q.theta) + 2.0 * q.x**2

    def applied(self, q, v, u, xp):
        return {"x": u.force}


def test_differences_of_parameters_keep_their_digits():
    """The equations are expanded, (R - r)² too; sums of parameters alone are rounded once."""
    scene, state, control = Bowl(), [0.1, -0.3, 0.4, 2.0], [0.7]
    gap = Fraction(scene.bowl) - Fraction(scene.sphere)
    assert scene.mass_matrix(state)[1, 1] == pytest.approx(float(Fraction(7, 5) * gap**2), rel=1e-15)
    rolling = CylinderInCylinder(mass=1.0, shell_radius=1.0, radius=scene.sphere)
    inertia = float(Fraction(3, 2) * gap**2)
    assert rolling.mass_matrix([0.5, 1.0, 0.3]).item() == pytest.approx(inertia, rel=1e-15)
    mass, acceleration = oracle_of(scene).at(state, control)
    np.testing.assert_allclose(scene.mass_matrix(state), mass, rtol=1e-15)
    found = scene.acceleration(state, control)
    np.testing.assert_allclose([found["x"], found["theta"]], acceleration, rtol=1e-13)
    exact = [float(x) for x in agreed_end(oracle_of(scene), state, control, 1e-4)]
    np.testing.assert_allclose(scene.simulate(state, [control], 1e-4)[-1], exact, rtol=1e-13)


class Elsewhere(Scene):
    """A slider on a turning beam, held by springs, wells and a bump about one place."""

    where: float = parameter(0.0, "m")
    coordinates = {"x": "m", "psi": "rad"}

    def kinetic(self, q, v, xp):
        across = (q.x - self.where) * v.psi
        return 0.5 * v.x**2 + 0.5 * (across**2 + 0.01 * v.psi**2)

    def potential(self, q, xp):
        out = q.x - self.where
        springs = 20 * out**3 + 100 * out**8 + (out**2 - 0.25) ** 2
        return springs + out * out * xp.cos(q.psi) + xp.exp(-50 * out**2) + xp.sqrt(0.01 + out**2)


def test_powers_about_a_far_place_keep_their_digits():
    """Expanded, (x - c)⁸ would be a small difference of large numbers."""
    near, far = Elsewhere(), Elsewhere(where=1024.0)
    here, there = np.array([0.375, 0.5, 0.25, -2.0]), np.array([1024.375, 0.5, 0.25, -2.0])
    np.testing.assert_allclose(far.mass_matrix(there), near.mass_matrix(here), rtol=1e-15)
    for name, found in far.acceleration(there).items():
        assert found == pytest.approx(near.acceleration(here)[name], rel=1e-12)
    assert far.step_bound(there).substeps == near.step_bound(here).substeps
    after = far.simulate(there, 1, 0.02)[1] - [1024.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(after, near.simulate(here, 1, 0.02)[1], rtol=1e-12)


class Wells(Scene):
    """A slider in wells about a far place, and another one on a hardening spring between them."""

    products: bool = True
    where: float = parameter(100.0, "m")
    depth: float = parameter(1.5, "J", above=0.0)
    coordinates = {"x": "m", "y": "m"}
    controls = {"force": "N"}

    def kinetic(self, q, v, xp):
        return 0.5 * v.x**2 + 0.5 * v.y**2

    def potential(self, q, xp):
        d, e, k = q.x - self.where, q.y - q.x, self.depth
        if self.products:
            wells = k * (d - 2) * (d - 1) * (d - 0.5) * (d + 0.5) * (d + 1) * (d + 2)
            return wells + e * e / 2 + e * e * e * e / 4
        return k * (d**6 - 5.25 * d**4 + 5.25 * d**2 - 1) + e**2 / 2 + e**4 / 4

    def applied(self, q, v, u, xp):
        return {"x": u.force}


@pytest.mark.parametrize("products", [True, False])
@pytest.mark.parametrize("where", [100.0, -300.3])
def test_wells_about_a_far_place_take_few_substeps(where, products):
    """Multiplied out, the wells at 100 m had errors of 5e-7 m/s after 415 substeps."""
    scene, control = Wells(where=where, products=products), [0.1]
    for d, e in ((0.75, 0.4), (-1.9, -1.1), (1.3, 0.2)):
        state = np.array([where + d, 0.3, where + d + e, -0.5])
        exact = np.array([float(x) for x in agreed_end(oracle_of(scene), state, control, 0.02)])
        error = np.abs(scene.simulate(state, [control], 0.02)[-1] - exact)
        assert (error <= 1e-15 * np.maximum(1.0, np.abs(state))).all()
        assert scene.step_bound(state, control, 0.02).substeps <= 3


class Balloon(Scene):
    """A balloon in a wind; its drag grows with the square of its speed relative to the air."""

    calm: float = parameter(1e-4, "m²/s²", least=0.0)
    leak: float = parameter(0.1, "N s/m", least=0.0)
    coordinates = {"x": "m", "y": "m"}
    controls = {"wind": "m/s"}

    def kinetic(self, q, v, xp):
        return 0.5 * (v.x**2 + v.y**2)

    def potential(self, q, xp):
        return 0.1 * q.y

    def dissipation(self, q, v, u, xp):
        squared = (v.x - u.wind) ** 2 + v.y**2
        return squared * xp.sqrt(squared + self.calm) / 3 + self.leak * (v.x - v.y) ** 2


@pytest.mark.parametrize("calm", [1e-4, 0.0])
@pytest.mark.parametrize("wind", [10.0, -1000.0])
def test_drag_in_a_wind_takes_few_substeps(wind, calm):
    """Multiplied out, the relative speed lost its digits, and a step took thousands of attempts."""
    scene, state = Balloon(calm=calm, leak=0.0), np.array([0.5, wind + 0.1, 0.2, 0.1])
    exact = np.array([float(x) for x in agreed_end(oracle_of(scene), state, [wind], 0.02)])
    error = np.abs(scene.simulate(state, [wind], 0.02)[-1] - exact)
    assert (error <= 1e-15 * np.maximum(1.0, np.abs(exact))).all()
    assert scene.step_bound(state, wind, 0.02).substeps <= 3


def test_terms_of_linear_drag_combine():
    text = Balloon().mechanics.force[0].text
    assert "leak*velocity x" in text and "leak*velocity y" in text


def test_product_of_a_sum_has_the_record_of_its_power():
    class Spring(Wells):
        def potential(self, q, xp):
            d = q.y - q.x
            return self.depth * d * d * d * d if self.products else self.depth * d**4

    assert Spring().mechanics.key == Spring(products=False).mechanics.key
    assert code_of(Spring(), 0.02) is code_of(Spring(products=False), 0.02)


def test_what_rests_leaves_no_code():
    for scene in (PivotedBar(), *(Incline(control=mode) for mode in Incline.modes), CylinderInCylinder()):
        for name in ("rise", "lift", "slip", "gap"):
            assert f" {name}" not in "".join(f.text for f in scene.mechanics.force)


def test_mechanics_says_how_prescribed_coordinates_are_moved():
    class Rail(cart(False)):
        prescribed = {"a": "m", "b": "m", "c": "m", "d": "m"}
        controls = {"a_ddot": "", "b_dot": "", "c": "", "force": "N"}

        def kinetic(self, q, v, xp):
            return (v.x + v.a + v.b + v.c + v.d) ** 2

        def potential(self, q, xp):
            return (q.x + q.a + q.b + q.c + q.d) ** 2

        def rests(self):
            return {"d": 3 * self.mass}

    found = Rail().mechanics
    assert [(p.name, p.level, p.control) for p in found.prescribed] == [
        ("a", "acceleration", "a_ddot"), ("b", "rate", "b_dot"), ("c", "place", "c"), ("d", "rest", "")
    ]  # fmt: skip
    assert found.free == ("x",)
    kinds = {(s.kind, s.name) for s in found.force[0].symbols()}
    assert kinds == {
        ("place", "x"), ("place", "a"), ("place", "b"), ("control", "c"), ("control", "a_ddot"), ("control",
        "force"), ("parameter", "mass"),
    }  # fmt: skip
    assert set(found.coupling) == {(0, "b")}


def test_energy_reports_jacobis_integral_where_it_differs():
    assert set(CartPole().energy([0.0] * 4)) == {"kinetic", "potential", "total"}
    hoop = contract_scenes.RotatingHoop(rate=2.0, gravity=0.0, radius=1.0, mass=2.0)
    energy = hoop.energy([math.pi / 2, 3.0])
    assert energy == {"kinetic": 13.0, "potential": 0.0, "total": 13.0, "jacobi": 5.0}
    charge = contract_scenes.ChargedParticle(growth=0.0, field=5.0)
    energy = charge.energy([[1.0, 2.0, 0.0, 4.0]])
    assert energy["kinetic"] == [30.0] and energy["jacobi"] == [10.25]


def test_forces_of_what_moves_have_names():
    class Rail(cart(False)):
        prescribed = {"s": "m", "h": "m"}
        controls = {"s_ddot": "m/s²"}

        def kinetic(self, q, v, xp):
            return self.mass * (v.x + v.s + v.h) ** 2 / 2

        def applied(self, q, v, u, xp):
            return {"s": 3.0}

    # x' = -s' - spring x / m: the force on s is m (x'' + s'') - 3.
    assert Rail().forces([0.0, 0.0, 1.0, 0.0], 5.0) == {"drive_s": -5.0}

    class Placed(Rail):
        controls = {"s": "m"}

    assert Placed().forces([1.0, 0.0], 5.0) == {}


def test_control_may_stand_without_its_axis():
    scene, states = CartPole(), np.random.default_rng(1).normal(size=(5, 4))
    for control in (2.0, [2.0], np.full(5, 2.0), np.full((5, 1), 2.0)):
        np.testing.assert_array_equal(
            scene.acceleration(states, control)["x"], scene.acceleration(states, np.full(5, 2.0))["x"]
        )
    many = scene.acceleration(states[0], np.linspace(-1, 1, 7))["x"]
    assert many.shape == (7,)
    arm = TwoLinkArm()
    assert arm.acceleration(states)["theta_1"].shape == (5,)
    assert arm.acceleration(states, np.ones((5, 2)))["theta_1"].shape == (5,)
    free = contract_scenes.ChargedParticle()
    assert free.acceleration(states)["x"].shape == (5,)
    assert free.acceleration(states, np.empty((5, 0)))["x"].shape == (5,)
    with pytest.raises(ValueError, match="has none"):
        free.acceleration(states, np.ones((5, 1)))


# --- references ---


def test_cart_pole_is_gymnasiums():
    env = gym.make("CartPole-v1").unwrapped
    env.tau = 1.0  # Euler's step of a second adds the acceleration
    generator = np.random.default_rng(2)
    for _ in range(50):
        state, action = generator.uniform(-2, 2, 4), int(generator.integers(2))
        env.reset(seed=1)
        env.state, env.steps_beyond_terminated = state.copy(), None
        with np.errstate(all="ignore"):
            env.step(action)
        found = CartPole().acceleration(state, 10.0 if action else -10.0)
        expected = np.asarray(env.state, dtype=np.float64)[[1, 3]] - state[[1, 3]]
        np.testing.assert_allclose(list(found.values()), expected, rtol=1e-6, atol=1e-6)


def test_acrobot_is_gymnasiums():
    env = gym.make("Acrobot-v1").unwrapped
    scene = Acrobot(inertia_1=1.0, inertia_2=1.0, gravity=9.8)
    generator = np.random.default_rng(3)
    for _ in range(50):
        theta_1, theta_2, rate_1, rate_2, torque = generator.uniform(-3, 3, 5)
        expected = env._dsdt([theta_1, theta_2, rate_1, rate_2, torque])[2:4]
        found = scene.acceleration([theta_1, rate_1, theta_2, rate_2], torque)
        np.testing.assert_allclose(list(found.values()), expected, rtol=1e-12)


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_chain_of_one_bar_is_the_bar(damping):
    bar = PivotedBar(mass=0.3, com_distance=0.4, damping=damping)
    chain = Chain(bars=1, mass=0.3, length=0.8, damping=damping)
    assert chain.inertia == pytest.approx(bar.inertia, rel=1e-15)
    generator = np.random.default_rng(4)
    states, controls = generator.normal(size=(50, 4)) * 3, generator.normal(size=50) * 5
    np.testing.assert_allclose(
        chain.acceleration(states, controls)["theta_1"],
        bar.acceleration(states, controls)["theta"],
        rtol=1e-13,
    )
    for call in ("energy", "forces", "power"):
        mine, of_bar = getattr(chain, call)(states, controls), getattr(bar, call)(states, controls)
        for name, value in of_bar.items():
            np.testing.assert_allclose(mine[name], value, rtol=1e-12, atol=1e-12)


def test_smooth_friction_is_what_it_says():
    scene = Acrobot(damping=0.2, dry_friction=0.3, control="both")
    bare = Acrobot(control="both")
    generator = np.random.default_rng(5)
    for rates in generator.normal(size=(20, 2)):
        state = [0.4, rates[0], -0.7, rates[1]]
        loss = np.array([0.2 * w + 0.3 * math.atan(100 * w) for w in rates])
        expected = bare.acceleration(state, -loss)
        for name, value in scene.acceleration(state).items():
            assert value == pytest.approx(expected[name], rel=1e-12, abs=1e-12)
        assert scene.power(state)["drag"] == pytest.approx(float(loss @ rates), rel=1e-12)


def test_chains_are_alike_in_any_frame():
    """Swinging on an accelerated support is swinging in a tilted field."""
    chain, generator = Chain(bars=3, gravity=3.0), np.random.default_rng(6)
    lean, field = math.atan2(4.0, 3.0), Chain(bars=3, gravity=5.0)
    for _ in range(10):
        angles, rates = generator.normal(size=(2, 3))
        upright = np.concatenate([[0, 0], np.stack([angles + lean, rates], axis=1).ravel()])
        tilted = np.concatenate([[0, 0], np.stack([angles, rates], axis=1).ravel()])
        np.testing.assert_allclose(
            list(chain.acceleration(tilted, 4.0).values()),
            list(field.acceleration(upright, 0.0).values()),
            rtol=1e-12,
        )


# --- SymPy ---


def test_lagrangian_is_t_less_v():
    bar = PivotedBar(track=None)
    names = "mass com_distance inertia gravity"
    m, d, i, g = sympy.symbols(names, positive=True)
    t = sympy.Symbol("t", real=True)
    s, theta = (sympy.Function(name, real=True)(t) for name in ("s", "theta"))
    along, up = s.diff(t) + d * theta.diff(t) * sympy.cos(theta), d * theta.diff(t) * sympy.sin(theta)
    expected = m * (along**2 + up**2) / 2 + i * theta.diff(t) ** 2 / 2 + m * g * d * sympy.cos(theta)
    assert sympy.expand(bar.lagrangian() - expected) == 0
    fixed = Incline().lagrangian()
    assert {str(f.func) for f in fixed.atoms(sympy.Function)} == {"sin", "cos", "x"}


def test_a_parameter_named_t_is_no_time():
    class Block(Scene):
        coordinates = {"x": "m"}
        t: float = parameter(2.0, "kg")

        def kinetic(self, q, v, xp):
            return self.t * v.x**2 / 2

        def potential(self, q, xp):
            return q.x**2 / 2

    (equation,) = equations(Block())
    x = sympy.Function("x", real=True)(t)
    assert equation.lhs.coeff(x.diff(t)) == 0 and equation.lhs.coeff(x) == 1
    assert r"t \frac{d^{2}}{d t^{2}} x" in sympy.latex(equation)


def test_equations_are_solved_by_the_accelerations():
    scene = CartPole(friction=0.2)
    found = equations(scene)
    assert len(found) == 2 and r"\frac{d^{2}}{d t^{2}} x" in sympy.latex(found[0])
    # A tilt that is the control is held: it is in the equation, but not its rates.
    tilted, tilt = Incline(control="tilt"), sympy.Function("phi", real=True)(sympy.Symbol("t", real=True))
    for shown in (*equations(tilted), tilted.lagrangian()):
        assert shown.has(tilt) and not shown.has(tilt.diff())


@pytest.mark.parametrize("functions_of_time", [False, True])
def test_scene_of_sympys_expressions(functions_of_time):
    m, l, g, b, tau = sympy.symbols("m l g b tau")  # noqa: E741
    if functions_of_time:
        x, theta = dynamicsymbols("x theta")
        x_dot, theta_dot = x.diff(), theta.diff()
    else:
        x, theta, x_dot, theta_dot = sympy.symbols("x theta x_dot theta_dot")
    along, up = x_dot + l * theta_dot * sympy.cos(theta), -l * theta_dot * sympy.sin(theta)
    scene = Scene.from_sympy(
        "Cart",
        x_dot**2 / 2 + m * (along**2 + up**2) / 2 + m * l**2 * theta_dot**2 / 6,
        m * g * l * sympy.cos(theta),
        coordinates={x: "m", theta: "rad"},
        controls={tau: "N"},
        dissipation=b * x_dot**2 / 2,
        applied={x: tau},
        parameters={m: 0.1, l: 0.5, g: 9.8, b: 0.2},
    )
    twin = CartPole(friction=0.2)
    assert type(scene).__name__ == "Cart" and scene.state_units == twin.state_units
    states = np.random.default_rng(7).normal(size=(20, 4))
    for name, value in twin.acceleration(states, 3.0).items():
        np.testing.assert_allclose(scene.acceleration(states, 3.0)[name], value, rtol=1e-13)
    np.testing.assert_allclose(scene.energy(states)["total"], twin.energy(states)["total"], rtol=1e-13)
    assert scene(b=0.0).b == 0.0 and type(scene(b=0.0)) is type(scene)
    for again in (
        pickle.loads(pickle.dumps(scene)),
        copy.deepcopy(scene),
        cloudpickle.loads(cloudpickle.dumps(scene)),
    ):
        assert again == scene and type(again) is type(scene)


def test_scene_of_sympys_expressions_has_all_functions():
    q, q_dot, k = sympy.symbols("q q_dot k")
    potential = sum(f(q / 3) for f in (sympy.sin, sympy.cos, sympy.tan, sympy.atan, sympy.tanh, sympy.exp))
    potential += (2 + q) ** 2.5 + (2 + q) ** -1.5 + (2 + q) ** 3.0  # floats that are halves
    potential += sympy.log(3 + q) + sympy.sqrt(3 + q) + 1 / sympy.sqrt(5 + q) + (4 + q) ** -2 + sympy.pi * q
    scene = Scene.from_sympy(
        "All", q_dot**2 * (k + sympy.Rational(1, 3)) / 2, potential, coordinates={q: "m"}, parameters={k: 1.0}
    )
    for x in (-0.3, 0.2, 1.0):
        expected = -float(potential.diff(q).subs(q, x)) / (4 / 3)
        assert scene.acceleration([x, 0.0])["q"] == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("functions_of_time", [False, True])
@pytest.mark.parametrize("control", ["s_ddot", "s_dot", "s"])
def test_controls_of_sympys_expressions_move_coordinates(control, functions_of_time):
    x, x_dot, s, s_dot, s_ddot = sympy.symbols("x x_dot s s_dot s_ddot")
    keys = {"s": s, "s_dot": s_dot, "s_ddot": s_ddot}
    if functions_of_time:
        x, s = dynamicsymbols("x s")
        x_dot, s_dot = x.diff(), s.diff()
        keys["s"] = s
    m, k = 2.0, 3.0
    given = Scene.from_sympy(
        "Pulled", m * (x_dot + s_dot) ** 2 / 2, k * (x**2 - s) ** 2 / 2, coordinates={x: "m"},
        prescribed={s: "m"}, controls={keys[control]: ""}, dissipation=(x_dot - s_dot) ** 2 / 20,
    )  # fmt: skip

    class Pulled(Scene):
        coordinates = {"x": "m"}
        prescribed = {"s": "m"}
        controls = {control: ""}

        def kinetic(self, q, v, xp):
            return m * (v.x + v.s) ** 2 / 2

        def potential(self, q, xp):
            return k * (q.x**2 - q.s) ** 2 / 2

        def dissipation(self, q, v, u, xp):
            return (v.x - v.s) ** 2 / 20

    start = np.linspace(0.2, 0.5, len(Pulled().state_names))
    path, expected = (scene.simulate(start, [0.4, -0.7, 0.1], 0.05) for scene in (given, Pulled()))
    assert given.state_names == Pulled().state_names
    np.testing.assert_allclose(path, expected, rtol=1e-13)


def test_sympys_expressions_may_be_text():
    given = {"coordinates": {"q": "m"}, "controls": {"f": "N"}, "applied": {"q": "f"}}
    scene = Scene.from_sympy("Text", "m*q_dot**2/2", "k*q**2", **given, parameters={"m": 2, "k": 3.0})
    assert scene.acceleration([1.0, 0.0], 4.0) == {"q": -1.0}


@pytest.mark.parametrize("number", [np.array([2.0]), None, [1.0], "2"], ids=repr)
def test_parameters_of_sympys_expressions_are_numbers(number):
    q, q_dot, m = sympy.symbols("q q_dot m")
    with pytest.raises(ValueError, match=re.escape(f"m must be a real number, got {number!r}")):
        Scene.from_sympy("Odd", m * q_dot**2, q**2, coordinates={q: "m"}, parameters={m: number})


def test_names_that_sympy_knows_are_the_declared_ones():
    """In a text, E would be 2.718..., and N and S functions of SymPy."""
    named = {"coordinates": {"E": "m"}, "controls": {"N": "N"}, "parameters": {"S": 3.0, "beta": 2.0}}
    scene = Scene.from_sympy("Text", "beta*E_dot**2", "S*E", applied={"E": "N"}, **named)
    assert scene.acceleration([0.5, 0.0], 1.0)["E"] == -0.5
    one, other = sympy.Symbol("m"), sympy.Symbol("m", positive=True)
    for twice in ({one: 1.0, other: 2.0}, {one: 1.0, "m": 2.0}):
        with pytest.raises(
            FormulaError, match=r"Text\.parameters: m is declared twice; give one another name"
        ):
            Scene.from_sympy("Text", "m*x_dot**2", "x**2", coordinates={"x": "m"}, parameters=twice)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"coordinates": {"q": ["m"]}}, "Odd.coordinates: q must have a unit, got ['m']"),
        ({"applied": {"q": {}}}, "Odd.applied: q must have an expression, got {}"),
        ({"controls": {dynamicsymbols("s").diff(): "m"}}, "a control that sets it is called 's_dot'"),
        ({"controls": {dynamicsymbols("s", 2): "m"}}, "a control that sets it is called 's_ddot'"),
    ],
)  # fmt: skip
def test_units_and_names_of_sympys_expressions(given, message):
    with pytest.raises(FormulaError, match=re.escape(message)):
        Scene.from_sympy("Odd", "q_dot**2 / 2", "q**2", **{"coordinates": {"q": "m"}} | given)


def test_symbols_of_sympys_expressions_that_only_look_alike():
    q, q_dot = sympy.Symbol("q", real=True), sympy.Symbol("q_dot")
    with pytest.raises(FormulaError, match="q_dot is not the declared symbol of that name"):
        Scene.from_sympy("Odd", q_dot**2, q**2, coordinates={q: "m"})


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("lambda", "a keyword of Python"),
        ("class", "a keyword of Python"),
        (r"\theta", "not a name; use letters, digits"),
        ("theta ", "not a name"),
        ("1a", "not a name"),
        ("a'", "not a name"),
        ("mu_{k}", "not a name"),
    ],
)
def test_parameters_of_sympys_expressions_that_are_no_names(name, why):
    q, q_dot, bad = *sympy.symbols("q q_dot"), sympy.Symbol(name)
    with pytest.raises(FormulaError, match=re.escape(f"Odd: {name!r} is {why}")):
        Scene.from_sympy("Odd", bad * q_dot**2, sympy.cos(q), coordinates={q: "rad"}, parameters={bad: 2.0})


def test_names_of_sympys_expressions_are_those_that_python_reads():
    micro, rate, sign = sympy.symbols("\u00b5 \u00b5_dot \u03d1")
    scene = Scene.from_sympy(
        "Mu", rate**2 / 2, sign * micro**2 / 2, coordinates={micro: "m"}, parameters={sign: 2.0}
    )
    assert scene.state_names == ("\u03bc", "\u03bc_dot") and scene() == scene(θ=2.0)
    assert scene.acceleration([1.5, 0.0]) == {"\u03bc": -3.0}


@pytest.mark.parametrize(
    ("potential", "words"),
    [
        ("q + c", "c is neither a coordinate"),
        ("Abs(q)", "Abs"),
        ("sinh(q)", "sinh"),
        ("q * t", "time"),
        ("q ** 1.2", r"q\*\*1\.2 has the power 1\.2"),
        ("q_dot ** 2", "q_dot is neither"),
        ("I * q", "not one of|neither|real"),
        ("Piecewise((q, q > 0), (0, True))", "Piecewise"),
    ],
)
def test_expressions_that_are_no_energy(potential, words):
    q, q_dot = sympy.symbols("q q_dot")
    with pytest.raises(FormulaError, match=rf"(?s)Odd\.potential.*({words})"):
        Scene.from_sympy("Odd", q_dot**2, sympy.sympify(potential), coordinates={q: "m"})
