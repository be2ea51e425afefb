"""A scene's mistakes are refused when its class is used, by name and with the remedy."""

import dataclasses
import math
import random
import re
import weakref

import numpy as np
import pytest

from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes import CylinderInCylinder, door
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Circle


class Good(Scene):
    """A cart on a spring; each mistake below changes one thing in it."""

    mass: float = parameter(1.0, "kg", above=0.0)
    spring: float = parameter(2.0, "N/m", least=0.0)
    friction: float = parameter(0.0, "N s/m", least=0.0)
    links: int = 2
    coordinates = {"x": "m", "y": "m"}
    prescribed = {"s": "m", "rise": "m"}
    controls = {"force": "N", "s_ddot": "m/s²"}
    reactions = {"support": "rise", "push": "s"}
    ratios = {"needed": ("push", "support")}

    def kinetic(self, q, v, xp):
        return self.mass * ((v.x + v.s) ** 2 + (v.y + v.rise) ** 2) / 2

    def potential(self, q, xp):
        return self.spring * (q.x**2 + q.y**2) / 2

    def dissipation(self, q, v, u, xp):
        return self.friction * (v.x**2 + v.y**2) / 2

    def applied(self, q, v, u, xp):
        return {"x": u.force}


MISTAKES = []


def mistake(formula, *words):
    """Add a class, made by a function, to those that must be refused.

    Parameters
    ----------
    formula : str
        The name in the error, after the class's name.
    words : str
        Further text in the error.
    """

    def add(make):
        MISTAKES.append(pytest.param(make, formula, words, id=make.__name__))
        return make

    return add


def changed(name, method):
    """Return a class that differs in one method."""
    return type("Bad", (Good,), {name: method, "__module__": __name__})


def potential(formula):
    return changed("potential", lambda self, q, xp: formula(self, q, xp))


def kinetic(formula):
    return changed("kinetic", lambda self, q, v, xp: formula(self, q, v, xp))


# --- numbers that cannot be traced -------------------------------------------------------------------------


@mistake("potential", "math", "functions of xp")
def math_function_of_a_coordinate():
    return potential(lambda self, q, xp: math.sin(q.x))


@mistake("potential", "math", "functions of xp")
def math_function_of_a_parameter():
    return potential(lambda self, q, xp: math.sqrt(self.mass) * q.x**2)


@mistake("potential", "math", "functions of xp")
def math_function_of_a_parameter_that_is_zero():
    return potential(lambda self, q, xp: math.sqrt(self.friction) + q.x**2)


@mistake("potential", "np.sin", "xp.sin")
def numpy_function():
    return potential(lambda self, q, xp: np.sin(q.x))


@mistake("potential", "sin", "functions of xp")
def numpy_function_of_an_array_of_numbers():
    return potential(lambda self, q, xp: np.sin(np.array([q.x, q.y])).sum())


@mistake("potential", "float()")
def float_of_a_number():
    return potential(lambda self, q, xp: float(q.x) ** 2)


@mistake("potential", "the number inf")
def number_beyond_floats():
    return potential(lambda self, q, xp: 10**400 * q.x)


@mistake("potential", "int()", "smooth")
def int_of_a_number():
    return potential(lambda self, q, xp: int(q.x) * q.x)


@mistake("potential", "%", "smooth")
def remainder():
    return potential(lambda self, q, xp: (q.x % 1.0) ** 2)


@mistake("potential", "%", "smooth")
def floor_division():
    return potential(lambda self, q, xp: (q.x // 1.0) ** 2)


@mistake("potential", "max", "branch")
def largest():
    return potential(lambda self, q, xp: max(q.x, 0.0) ** 2)


@mistake("potential", "comparison", "branch")
def less_than():
    return potential(lambda self, q, xp: q.x**2 if q.x < 0.0 else 0.0)


@mistake("potential", "comparison", "branch")
def equal():
    return potential(lambda self, q, xp: q.x**2 if self.spring == 0.0 else 0.0)


@mistake("potential", "comparison")
def is_in():
    return potential(lambda self, q, xp: q.x**2 if self.spring in (0.0, 1.0) else 0.0)


@mistake("potential", "`in`")
def is_among_the_coordinates():
    return potential(lambda self, q, xp: q.x**2 if self.spring in q else 0.0)


@mistake("potential", "`if`", "branch")
def truth():
    return potential(lambda self, q, xp: q.x**2 if self.friction else 0.0)


@mistake("potential", "`if`")
def logic():
    return potential(lambda self, q, xp: self.friction or q.x**2)


@mistake("potential", "xp.where", "smooth")
def where():
    return potential(lambda self, q, xp: xp.where(True, q.x, 0.0))


@mistake("potential", "abs()", "xp.sqrt(x * x + eps * eps)")
def absolute_value():
    return potential(lambda self, q, xp: abs(q.x))


@mistake("potential", "xp.abs", "smooth")
def absolute_value_by_xp():
    return potential(lambda self, q, xp: xp.abs(q.x))


@mistake("potential", "absolute value", "eps")
def absolute_value_by_a_root():
    return potential(lambda self, q, xp: xp.sqrt(q.x**2))


@mistake("dissipation", "xp.sign", "smooth")
def coulomb_friction():
    return changed("dissipation", lambda self, q, v, u, xp: self.mass * v.x * xp.sign(v.x))


@mistake("dissipation", "absolute value")
def coulomb_friction_by_a_power():
    return changed("dissipation", lambda self, q, v, u, xp: self.mass * (v.x * v.x) ** 0.5)


@mistake("dissipation", "absolute value")
def coulomb_friction_on_a_belt():
    return changed("dissipation", lambda self, q, v, u, xp: self.mass * xp.sqrt((v.x - v.s - 0.25) ** 2))


@mistake("potential", "xp.erf", "xp.sin, cos")
def unknown_function():
    return potential(lambda self, q, xp: xp.erf(q.x))


@mistake("potential", "power", "xp.exp(p * xp.log(x))")
def fractional_power():
    return potential(lambda self, q, xp: q.x**1.5)


@mistake("potential", "power")
def recorded_power():
    return potential(lambda self, q, xp: q.x**self.spring)


@mistake("potential", "power", "xp.exp")
def recorded_exponent():
    return potential(lambda self, q, xp: 2.0**q.x)


@mistake("potential", "index or range", "structural")
def count_by_a_parameter():
    return potential(lambda self, q, xp: sum(q.x**2 for _ in range(self.spring)))


@mistake("potential", "round()")
def rounded():
    return potential(lambda self, q, xp: round(q.x) ** 2)


@mistake("potential", "real")
def complex_number():
    return potential(lambda self, q, xp: q.x * 1j)


@mistake("potential", "complex")
def complex_result():
    return potential(lambda self, q, xp: 1.0 + 2.0j)


@mistake("potential", "None", "return")
def no_result():
    return potential(lambda self, q, xp: None)


@mistake("potential", "ndarray", "one number")
def array():
    return potential(lambda self, q, xp: np.array([q.x, q.y]) ** 2)


@mistake("kinetic", "tuple", "one number")
def several_results():
    return kinetic(lambda self, q, v, xp: (v.x**2, v.y**2))


@mistake("potential", "'text'")
def text():
    return potential(lambda self, q, xp: q.x + "text")


@mistake("potential", "nan")
def not_a_number():
    return potential(lambda self, q, xp: q.x * math.nan)


@mistake("potential", "inf")
def infinity():
    return potential(lambda self, q, xp: q.x * math.inf)


@mistake("potential", "divides by zero", "friction=0")
def division_by_a_parameter_that_is_zero():
    return potential(lambda self, q, xp: q.x**2 / self.friction)


@mistake("potential", "log", "0")
def logarithm_of_nothing():
    return potential(lambda self, q, xp: xp.log(0.0) + q.x)


@mistake("potential", "NameError", "sin")
def function_without_xp():
    return potential(lambda self, q, xp: sin(q.x))  # noqa: F821


@mistake("potential", "self", "spring")
def assignment_to_self():
    def formula(self, q, xp):
        self.spring = 3.0
        return self.spring * q.x**2

    return changed("potential", formula)


@mistake("potential", "sets", "read")
def assignment_to_a_coordinate():
    def formula(self, q, xp):
        q.x = 0.0
        return q.x**2

    return changed("potential", formula)


@mistake("potential", "'z'", "x, y, s, rise")
def unknown_coordinate():
    return potential(lambda self, q, xp: q.z**2)


@mistake("potential", "number 7")
def index_too_large():
    return potential(lambda self, q, xp: q[7] ** 2)


@mistake("applied", "'push'", "force")
def unknown_control():
    return changed("applied", lambda self, q, v, u, xp: {"x": u.force + u.push})


@mistake("potential", "'width'")
def unknown_parameter():
    return potential(lambda self, q, xp: self.width * q.x**2)


@mistake("potential", "derived")
def derived_from_itself():
    return potential(lambda self, q, xp: self.energy([0.0] * 6)["total"])


@mistake("formula", "again", "chance")
def chance():
    return potential(lambda self, q, xp: random.random() * q.x**2)


# --- invalid energies --------------------------------------------------------------------------------------


@mistake("kinetic", "degree 4", "two at most")
def fourth_power_of_a_sum():
    return kinetic(lambda self, q, v, xp: v.x**2 + v.y**2 + (v.x - v.y) ** 4)


@mistake("kinetic", "degree 3", "two at most")
def third_degree():
    return kinetic(lambda self, q, v, xp: v.x**2 + v.y**2 + v.x**3)


@mistake("kinetic", "degree 4", "two at most")
def relativity_in_two_terms():
    return kinetic(lambda self, q, v, xp: (v.x**2 + v.y**2) / 2 + 3 * v.x**4 / 8)


@mistake("kinetic", "function or denominator", "sqrt")
def velocity_in_a_function():
    return kinetic(lambda self, q, v, xp: xp.sqrt(1 + v.x**2) + v.y**2)


@mistake("kinetic", "function or denominator")
def velocity_in_a_denominator():
    return kinetic(lambda self, q, v, xp: v.x**2 + v.y**2 + 1 / (1 + v.x))


@mistake("kinetic", "'y'", "mass")
def coordinate_without_mass():
    return kinetic(lambda self, q, v, xp: v.x**2 / 2)


@mistake("kinetic", "'x'", "mass")
def energy_without_velocities():
    return kinetic(lambda self, q, v, xp: q.x**2 / 2 + q.y**2)


@mistake("kinetic", "singular", "x, y")
def singular_mass():
    return kinetic(lambda self, q, v, xp: (v.x + v.y) ** 2 / 2)


@mistake("kinetic", "singular")
def singular_mass_everywhere_by_angles():
    return kinetic(lambda self, q, v, xp: (v.x * xp.cos(q.x) + v.y * xp.sin(q.x)) ** 2 / 2)


@mistake("kinetic", "not positive")
def negative_mass():
    return kinetic(lambda self, q, v, xp: v.x**2 / 2 - v.y**2 / 2)


@mistake("potential", "(self, q, xp)", "(self, q, v, xp)")
def velocity_in_the_potential():
    return changed("potential", lambda self, q, v, xp: q.x**2 + v.x)


@mistake("potential", "(self, q, xp)", "time")
def explicit_time():
    return changed("potential", lambda self, q, t, xp: q.x**2 * xp.cos(t))


@mistake("kinetic", "kinetic(self, q, v, xp)", "method")
def formula_that_is_no_method():
    return changed("kinetic", 1.0)


@mistake("dissipation", "(self, q, v, u, xp)")
def signature_of_version_0_1():
    return changed("dissipation", lambda self, v, u: v.x**2)


@mistake("applied", "by coordinate")
def forces_without_names():
    return changed("applied", lambda self, q, v, u, xp: [u.force, 0.0])


@mistake("applied", "'theta'", "x, y")
def force_on_an_unknown_coordinate():
    return changed("applied", lambda self, q, v, u, xp: {"theta": u.force})


@mistake("applied", "None", "'x'")
def force_that_is_none():
    return changed("applied", lambda self, q, v, u, xp: {"x": u.force if self.links > 3 else None})


@mistake("rests", "'x'", "prescribed")
def rest_of_a_free_coordinate():
    return changed("rests", lambda self: {"x": 1.0})


@mistake("poses", "'cart'", "(x, y, angle)")
def pose_without_an_angle():
    return changed("poses", lambda self, q, xp: {"cart": (q.x, q.y)})


@mistake("bodies", "'wheel'", "poses")
def body_without_a_pose():
    return changed("bodies", lambda self: {"wheel": []})


@mistake("bodies", "'ground'", "Line, Polygon, Circle", "'cart'")
def body_that_is_no_shape():
    return changed("bodies", lambda self: {"ground": ["cart"]})


@mistake("bodies", "a list of shapes", "'ground'")
def body_that_is_one_shape():
    return changed("bodies", lambda self: {"ground": Circle((0.0, 0.0), 1.0)})


@mistake("indicators", "'arrow'", "(x, y, angle, part)")
def indicator_without_a_place():
    return changed("indicators", lambda self, now, xp: {"arrow": now.q.x})


@mistake("indicators", "by frame")
def indicators_without_names():
    return changed("indicators", lambda self, now, xp: [(now.q.x, 0.0)])


@mistake("indicators", "'z'", "x, y")
def indicator_at_an_unknown_coordinate():
    return changed("indicators", lambda self, now, xp: {"arrow": (now.q.z, 0.0)})


@mistake("shapes", "bodies(self)", "poses(self, q, xp)", "indicators(self, now, xp)")
def shapes_per_moment():
    return changed("shapes", lambda self, now: [])


# --- names -------------------------------------------------------------------------------------------------


@mistake("kinetic", "not defined")
def no_kinetic_energy():
    class Bad(Scene):
        coordinates = {"x": "m"}

        def potential(self, q, xp):
            return q.x**2

    return Bad


@mistake("potential", "not defined")
def no_potential_energy():
    class Bad(Scene):
        coordinates = {"x": "m"}

        def kinetic(self, q, v, xp):
            return v.x**2

    return Bad


@mistake("coordinates", "empty")
def no_coordinates():
    class Bad(Scene):
        def kinetic(self, q, v, xp):
            return 1.0

        def potential(self, q, xp):
            return 1.0

    return Bad


@mistake("coordinates", '{"x": "m"}')
def coordinates_without_units():
    class Bad(Good):
        coordinates = ("x", "y")

    return Bad


@mistake("coordinates", "unit of 'y'")
def unit_that_is_no_text():
    class Bad(Good):
        coordinates = {"x": "m", "y": 1.0}

    return Bad


@mistake("coordinates", "annotation")
def annotated_dict():
    class Bad(Good):
        coordinates: dict[str, str] = {"x": "m", "y": "m"}

    return Bad


@mistake("controls", "annotation")
def annotated_controls_on_a_scene_without():
    class Bad(Good):
        controls: dict = {"force": "N", "s_ddot": "m/s²"}

    return Bad


@mistake("coordinates", "'lambda'", "keyword")
def keyword():
    class Bad(Good):
        coordinates = {"x": "m", "lambda": "m"}

    return Bad


@mistake("coordinates", "'x 1'")
def name_with_a_blank():
    class Bad(Good):
        coordinates = {"x": "m", "x 1": "m"}

    return Bad


@mistake("coordinates", "'_x'")
def name_with_an_underscore_first():
    class Bad(Good):
        coordinates = {"x": "m", "_x": "m"}

    return Bad


@mistake("", "'x_dot'", "derivative of 'x'")
def coordinate_beside_its_rate():
    class Bad(Good):
        coordinates = {"x": "m", "y": "m", "x_dot": "m/s"}

    return Bad


@mistake("", "'x'", "free and prescribed")
def coordinate_free_and_prescribed():
    class Bad(Good):
        prescribed = {"s": "m", "rise": "m", "x": "m"}

    return Bad


@mistake("", "'x_ddot'", "applied")
def control_of_a_free_coordinate():
    class Bad(Good):
        controls = {"x_ddot": "m/s²"}

    return Bad


@mistake("", "'s_ddot'", "'s_dot'", "both")
def two_controls_of_one_coordinate():
    class Bad(Good):
        controls = {"force": "N", "s_ddot": "m/s²", "s_dot": "m/s"}

    return Bad


@mistake("", "'motor'", "has no effect", "u.motor")
def control_that_is_not_used():
    class Bad(Good):
        controls = {"force": "N", "motor": "N"}

    return Bad


@mistake("", "'x'", "coordinate")
def parameter_named_like_a_coordinate():
    class Bad(Good):
        x: float = parameter(1.0, "m")

    return Bad


@mistake("", "'y_dot'", "coordinate")
def parameter_named_like_a_state():
    class Bad(Good):
        y_dot: float = parameter(1.0, "m")

    return Bad


@mistake("", "'force'", "a control")
def parameter_named_like_a_control():
    class Bad(Good):
        force: float = parameter(1.0, "m")

    return Bad


@mistake("energy", "another")
def parameter_named_like_a_method():
    class Bad(Good):
        energy: float = parameter(1.0, "J")

    return Bad


@mistake("state", "another name")
def parameter_named_like_a_declaration():
    class Bad(Good):
        state: float = parameter(1.0, "J")

    return Bad


@mistake("", "'potential'")
def parameter_named_like_a_formula():
    class Bad(Good):
        potential: float = parameter(1.0, "J")

    return Bad


@mistake("power", "another")
def method_of_every_scene():
    return changed("power", lambda self: 1.0)


@mistake("state", "order of")
def state_that_lacks_a_name():
    class Bad(Good):
        state = ("x", "x_dot", "y", "y_dot")

    return Bad


@mistake("state", "names in order")
def state_that_is_text():
    class Bad(Good):
        state = "x"

    return Bad


@mistake("left_out", "'s'", "'s_dot'")
def rate_left_out_without_its_place():
    class Bad(Good):
        left_out = ("s_dot",)

    return Bad


@mistake("left_out", "'z'")
def left_out_that_is_not_there():
    class Bad(Good):
        left_out = ("z",)

    return Bad


@mistake("left_out", "'x_dot'", "free")
def rate_of_a_free_coordinate_left_out():
    class Bad(Good):
        left_out = ("x", "x_dot")

    return Bad


@mistake("left_out", "depends on 's'")
def left_out_that_is_needed():
    class Bad(Good):
        left_out = ("s",)

        def potential(self, q, xp):
            return (q.x - q.s) ** 2

    return Bad


@mistake("left_out", "depends on 's_dot'")
def left_out_rate_that_is_needed():
    class Bad(Good):
        left_out = ("s", "s_dot")

        def dissipation(self, q, v, u, xp):
            return (v.x + v.s) ** 2

    return Bad


@mistake("left_out", "depends on 'x'")
def left_out_free_place_that_is_needed():
    class Bad(Good):
        left_out = ("x",)

    return Bad


@mistake("coordinates", "index or range", "structural")
def coordinates_that_count_a_parameter():
    return changed("coordinates", property(lambda self: {f"x_{i}": "m" for i in range(self.spring)}))


@mistake("left_out", "comparison")
def state_that_depends_on_a_parameter():
    return changed("left_out", property(lambda self: () if self.friction == 0.0 else ("s",)))


@mistake("reactions", "'wall'", "prescribed")
def reaction_on_what_is_not_prescribed():
    class Bad(Good):
        reactions = {"support": "rise", "push": "s", "wall": "x"}

    return Bad


@mistake("ratios", "'normal'", "reactions")
def ratio_of_unknown_forces():
    class Bad(Good):
        ratios = {"needed": ("push", "normal")}

    return Bad


@mistake("ratios", "pair")
def ratio_of_one_force():
    class Bad(Good):
        ratios = {"needed": "push"}

    return Bad


@mistake("", "controls and modes")
def controls_and_modes():
    class Bad(Good):
        modes = {"pushed": {"force": "N"}}

    return Bad


@mistake("modes", "'pushed'")
def mode_that_is_no_dict():
    class Bad(Good):
        controls = {}
        modes = {"pushed": "force"}

    return Bad


@mistake("", "frozen", "kw_only=True")
def dataclass_that_is_not_frozen():
    @dataclasses.dataclass
    class Bad(Scene):
        coordinates = {"x": "m"}

        def kinetic(self, q, v, xp):
            return v.x**2

        def potential(self, q, xp):
            return q.x**2

    return Bad


@mistake("", "frozen", "kw_only=True")
def dataclass_with_a_parameter_that_is_not_frozen():
    @dataclasses.dataclass
    class Bad(Scene):
        mass: float = parameter(1.0, "kg", above=0.0)
        coordinates = {"x": "m"}

        def kinetic(self, q, v, xp):
            return self.mass * v.x**2

        def potential(self, q, xp):
            return q.x**2

    return Bad


@mistake("", "0.1", "drive, unpack and pack")
def scene_of_version_0_1():
    class Bad(Good):
        def drive(self, y, u, k, xp): ...

        def unpack(self, y, u, k): ...

        def pack(self, moved, y, u, dt, k): ...

    return Bad


@mistake("", "hashable")
def structural_field_that_is_a_list():
    class Bad(Good):
        lengths: tuple = ()

    return lambda: Bad(lengths=[1.0, 2.0])


# --- the test ----------------------------------------------------------------------------------------------


def test_the_good_one_is_good():
    assert Good().state_names == ("s", "s_dot", "x", "x_dot", "y", "y_dot")


@pytest.mark.parametrize("decorated", [False, True], ids=["plain", "decorated"])
@pytest.mark.parametrize(("make", "formula", "words"), MISTAKES)
def test_mistake_is_refused_by_name_and_with_the_remedy(make, formula, words, decorated):
    bad = make()
    if decorated and isinstance(bad, type) and "__dataclass_fields__" not in vars(bad):
        bad = dataclasses.dataclass(frozen=True, kw_only=True)(bad)
    for _ in range(2):  # and again, whatever the first attempt left behind
        with pytest.raises(FormulaError) as caught:
            bad()
        message = str(caught.value)
        assert re.match(r"Bad\b", message), message
        assert formula in message, message
        for word in words:
            assert word in message, message
        assert len(message) < 400


def test_there_are_many_kinds_of_mistakes():
    assert len(MISTAKES) > 60


def test_what_is_refused_is_a_type_error_and_a_value_error():
    """Catching one of them catches all."""
    assert issubclass(FormulaError, TypeError) and issubclass(FormulaError, ValueError)


def test_unit_of_a_parameter():
    with pytest.raises(FormulaError, match="the unit of a parameter must be text, got 3"):
        parameter(1.0, 3)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"mass": 0.0}, "mass must be above 0 kg"),
        ({"mass": math.nan}, "mass must be finite"),
        ({"mass": math.inf}, "mass must be finite"),
        ({"mass": "1"}, "mass must be a real number"),
        ({"mass": None}, "mass must be a real number"),
        ({"mass": True}, "mass must be a real number"),
        ({"spring": -1.0}, "spring must be at least 0"),
        ({"mass": 1e90}, "mass must be at most"),
    ],
    ids=str,
)
def test_bad_parameter(keywords, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        Good(**keywords)


@pytest.mark.parametrize(
    ("state", "control", "words"),
    [
        ([0.0] * 5, 0.0, "(s, s_dot, x, x_dot, y, y_dot)"),
        ([0.0, 0.0, math.nan, 0.0, 0.0, 0.0], 0.0, "'x': nan"),
        (["a"] * 6, 0.0, "real numbers"),
        ([0.0] * 6, 1.0, "(force, s_ddot)"),
        ([0.0] * 6, [1.0, 2.0, 3.0], "(force, s_ddot)"),
        ([0.0] * 6, [1.0, math.inf], "finite"),
        ([[0.0] * 6] * 3, [[1.0, 1.0]] * 2, "do not fit together"),
    ],
    ids=str,
)
@pytest.mark.parametrize("call", ["energy", "forces", "power", "acceleration", "mass_matrix", "linearise"])
def test_bad_state_or_control(call, state, control, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        getattr(Good(), call)(state, control)


@pytest.mark.parametrize("gap", [1e-6, 1e-9, 1e-12])
def test_a_mass_that_cancels_is_not_singular(gap, monkeypatch):
    """R² - 2Rr + r² rounds to 0, or below, for r near R; it does so in the first scene of a process."""
    monkeypatch.setattr(door, "_admitted", weakref.WeakKeyDictionary())
    shell = CylinderInCylinder(shell_radius=0.5, radius=0.5 - gap)
    acceleration = -9.81 * math.sin(0.1) / (1.5 * shell.arm)
    dt = 1e-3 / math.sqrt(-acceleration)
    after = shell.simulate([0.1, 0.0, 0.0], [0.0], dt)[-1]
    assert after[1] == pytest.approx(acceleration * dt, rel=1e-4)
