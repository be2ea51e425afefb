"""A scene's mistakes are refused when its class is used, by name and with the remedy."""

import contextlib
import dataclasses
import functools
import math
import random
import re
import weakref
from functools import partial

import numpy as np
import pytest

from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes import CylinderInCylinder, door
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Circle, Line


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


def changed(**attributes):
    """Return a class with other attributes."""
    return type("Bad", (Good,), attributes | {"__module__": __name__})


#: Functions that make a class that must be refused, and what its error says.
MISTAKES = []


def mistake(*words):
    """Add a function to these."""

    def add(make):
        MISTAKES.append(pytest.param(make, words, id=make.__name__))
        return make

    return add


# --- numbers that cannot be traced -------------------------------------------------------------------------


def guarded(of):
    try:
        return of()
    except (TypeError, ValueError):
        return 0.0


UNTRACEABLE = {
    "math function of a coordinate": (
        {"potential": lambda self, q, xp: math.sin(q.x)},
        "potential; math; functions of xp",
    ),
    "math function of a parameter": (
        {"potential": lambda self, q, xp: math.sqrt(self.mass) * q.x**2},
        "potential; math; functions of xp",
    ),
    "math function of a parameter that is zero": (
        {"potential": lambda self, q, xp: math.sqrt(self.friction) + q.x**2},
        "potential; math; functions of xp",
    ),
    "numpy function": ({"potential": lambda self, q, xp: np.sin(q.x)}, "potential; np.sin; xp.sin"),
    "numpy function of an array of numbers": (
        {"potential": lambda self, q, xp: np.sin(np.array([q.x, q.y])).sum()},
        "potential; sin; functions of xp",
    ),
    "float of a number": ({"potential": lambda self, q, xp: float(q.x) ** 2}, "potential; float()"),
    "number beyond floats": ({"potential": lambda self, q, xp: 10**400 * q.x}, "potential; the number inf"),
    "int of a number": ({"potential": lambda self, q, xp: int(q.x) * q.x}, "potential; int(); smooth"),
    "remainder": ({"potential": lambda self, q, xp: (q.x % 1.0) ** 2}, "potential; %; smooth"),
    "floor division": ({"potential": lambda self, q, xp: (q.x // 1.0) ** 2}, "potential; //; smooth"),
    "largest": ({"potential": lambda self, q, xp: max(q.x, 0.0) ** 2}, "potential; max; branch"),
    "less than": (
        {"potential": lambda self, q, xp: q.x**2 if q.x < 0.0 else 0.0},
        "potential; comparison; branch",
    ),
    "equal": (
        {"potential": lambda self, q, xp: q.x**2 if self.spring == 0.0 else 0.0},
        "potential; comparison; branch on a field that is not a parameter",
    ),
    "is in": (
        {"potential": lambda self, q, xp: q.x**2 if self.spring in (0.0, 1.0) else 0.0},
        "potential; comparison",
    ),
    "table": (
        {"potential": lambda self, q, xp: {1.0: 2.0}.get(self.mass, 1.0) * q.x**2},
        "potential; a look-up in a table; look up a field that is not a parameter",
    ),
    "cache": (
        {"potential": functools.cache(lambda self, q, xp: self.mass * q.x**2)},
        "potential; cache; drop the cache",
    ),
    "type": (
        {"potential": lambda self, q, xp: q.x**2 if isinstance(self.mass, float) else 0.0},
        "potential; another result on plain numbers; the type or the text",
    ),
    "text of a parameter": (
        {"applied": lambda self, q, v, u, xp: {"x": u.force if str(self.mass) == "1.0" else 2.0 * u.force}},
        "applied; another result on plain numbers",
    ),
    "a refusal that is caught": (
        {"potential": lambda self, q, xp: guarded(lambda: 9.81 if self.mass > 0.5 else 1.62) * q.x},
        "potential; comparison; the formula catches this error",
    ),
    "type of a parameter, beside large numbers": (
        {"potential": lambda self, q, xp: 5e4 * q.x**2 + (9.81 * q.x if type(self.mass) is float else 0.0)},
        "potential; another result on plain numbers",
    ),
    "recursion": (
        {"potential": lambda self, q, xp: self.potential(q, xp)},
        "potential; RecursionError; calls itself without end",
    ),
    "is among the coordinates": (
        {"potential": lambda self, q, xp: q.x**2 if self.spring in q else 0.0},
        "potential; `in`",
    ),
    "truth": (
        {"potential": lambda self, q, xp: q.x**2 if self.friction else 0.0},
        "potential; `if`; branch on a field that is not a parameter",
    ),
    "logic": ({"potential": lambda self, q, xp: self.friction or q.x**2}, "potential; `if`"),
    "where": ({"potential": lambda self, q, xp: xp.where(True, q.x, 0.0)}, "potential; xp.where; smooth"),
    "absolute value": (
        {"potential": lambda self, q, xp: abs(q.x)},
        "potential; abs(); xp.sqrt(x * x + eps * eps)",
    ),
    "absolute value by xp": ({"potential": lambda self, q, xp: xp.abs(q.x)}, "potential; xp.abs; smooth"),
    "absolute value by a root": (
        {"potential": lambda self, q, xp: xp.sqrt(q.x**2)},
        "potential; absolute value; eps",
    ),
    "coulomb friction": (
        {"dissipation": lambda self, q, v, u, xp: self.mass * v.x * xp.sign(v.x)},
        "dissipation; xp.sign; smooth",
    ),
    "coulomb friction by a power": (
        {"dissipation": lambda self, q, v, u, xp: self.mass * (v.x * v.x) ** 0.5},
        "dissipation; absolute value",
    ),
    "coulomb friction on a belt": (
        {"dissipation": lambda self, q, v, u, xp: self.mass * xp.sqrt((v.x - v.s - 0.25) ** 2)},
        "dissipation; absolute value",
    ),
    "unknown function": ({"potential": lambda self, q, xp: xp.erf(q.x)}, "potential; xp.erf; xp.sin, cos"),
    "function of others": (
        {"potential": lambda self, q, xp: xp.cosh(q.x)},
        "potential; xp.cosh; write (xp.exp(x) + xp.exp(-x)) / 2",
    ),
    "fractional power": (
        {"potential": lambda self, q, xp: q.x**1.5},
        "potential; power; xp.exp(p * xp.log(x))",
    ),
    "recorded power": ({"potential": lambda self, q, xp: q.x**self.spring}, "potential; power"),
    "recorded exponent": (
        {"potential": lambda self, q, xp: 2.0**q.x},
        "potential; power; xp.exp(x * xp.log(2.0))",
    ),
    "count by a parameter": (
        {"potential": lambda self, q, xp: sum(q.x**2 for _ in range(self.spring))},
        "potential; index or range; structural",
    ),
    "rounded": ({"potential": lambda self, q, xp: round(q.x) ** 2}, "potential; round()"),
    "complex number": ({"potential": lambda self, q, xp: q.x * 1j}, "potential; real"),
    "complex result": ({"potential": lambda self, q, xp: 1.0 + 2.0j}, "potential; complex"),
    "no result": ({"potential": lambda self, q, xp: None}, "potential; None; return"),
    "array": ({"potential": lambda self, q, xp: np.array([q.x, q.y]) ** 2}, "potential; ndarray; one number"),
    "all coordinates": (
        {"potential": lambda self, q, xp: q},
        "potential; <coordinates x, y, s, rise>; by its name",
    ),
    "function of all coordinates": (
        {"potential": lambda self, q, xp: xp.cos(q)},
        "potential; <coordinates x, y, s, rise>, which is not a real number",
    ),
    "function of two numbers": (
        {"potential": lambda self, q, xp: xp.sin(q.x, q.y)},
        "potential; the arguments of NumPy's, as in xp.cos(x)",
    ),
    "tangent of nothing": (
        {"potential": lambda self, q, xp: xp.tan() * q.x},
        "potential; the arguments of NumPy's, as in xp.cos(x)",
    ),
    "several results": ({"kinetic": lambda self, q, v, xp: (v.x**2, v.y**2)}, "kinetic; tuple; one number"),
    "text": ({"potential": lambda self, q, xp: q.x + "text"}, "potential; 'text'"),
    "not a number": ({"potential": lambda self, q, xp: q.x * math.nan}, "potential; nan"),
    "infinity": ({"potential": lambda self, q, xp: q.x * math.inf}, "potential; inf"),
    "division by a parameter that is zero": (
        {"potential": lambda self, q, xp: q.x**2 / self.friction},
        "potential; divides by zero; friction=0",
    ),
    "logarithm of nothing": ({"potential": lambda self, q, xp: xp.log(0.0) + q.x}, "potential; log; 0"),
    "function without xp": ({"potential": lambda self, q, xp: sin(q.x)}, "potential; NameError; sin"),  # noqa: F821
    "unknown coordinate": ({"potential": lambda self, q, xp: q.z**2}, "potential; 'z'; x, y, s, rise"),
    "index too large": ({"potential": lambda self, q, xp: q[7] ** 2}, "potential; number 7"),
    "unknown control": (
        {"applied": lambda self, q, v, u, xp: {"x": u.force + u.push}},
        "applied; 'push'; force",
    ),
    "unknown parameter": ({"potential": lambda self, q, xp: self.width * q.x**2}, "potential; 'width'"),
    "misspelt parameter": (
        {"potential": lambda self, q, xp: self.sprng * q.x**2},
        "potential; 'sprng'; did you mean spring?",
    ),
    "derived from itself": (
        {"potential": lambda self, q, xp: self.energy([0.0] * 6)["total"]},
        "potential; derived",
    ),
    "simulated by itself": (
        {"potential": lambda self, q, xp: self.simulate([0.0] * 6, [[0.0, 0.0]], 0.1)[1, 0]},
        "potential; derived",
    ),
    "chance": ({"potential": lambda self, q, xp: random.random() * q.x**2}, "formula; again; chance"),
}


@mistake("potential", "self", "spring")
def assignment_to_self():
    def formula(self, q, xp):
        self.spring = 3.0
        return self.spring * q.x**2

    return changed(potential=formula)


@mistake("cannot assign to field 'mass'", "declare the numbers", "mass: float = parameter")
def numbers_set_by_an_init():
    def init(self, mass=1.0):
        self.mass = mass

    return changed(__init__=init)


@mistake("potential", "sets", "read")
def assignment_to_a_coordinate():
    def formula(self, q, xp):
        q.x = 0.0
        return q.x**2

    return changed(potential=formula)


@mistake("potential", "another result on plain numbers", "numbers kept from an earlier run")
def number_kept_from_an_earlier_run():
    kept = []

    def formula(self, q, xp):
        kept.append(q.x)
        return kept[0] ** 2

    return changed(potential=formula)


# --- invalid energies --------------------------------------------------------------------------------------

INVALID = {
    "fourth power of a sum": (
        {"kinetic": lambda self, q, v, xp: v.x**2 + v.y**2 + (v.x - v.y) ** 4},
        "kinetic; degree 4; at most two",
    ),
    "arguments in another order": (
        {"dissipation": lambda self, v, q, u, xp: 0.5 * self.mass * v.x**2},
        "dissipation; (self, q, v, u, xp); (self, v, q, u, xp)",
    ),
    "dissipation that is a force": (
        {"dissipation": lambda self, q, v, u, xp: -self.mass * v.x},
        "dissipation; constant force; derivative by the velocity is the drag",
    ),
    "dissipation without velocities": (
        {"dissipation": lambda self, q, v, u, xp: self.mass * q.x**2},
        "dissipation; no velocity; no effect",
    ),
    "third degree": (
        {"kinetic": lambda self, q, v, xp: v.x**2 + v.y**2 + v.x**3},
        "kinetic; degree 3; at most two",
    ),
    "relativity in two terms": (
        {"kinetic": lambda self, q, v, xp: (v.x**2 + v.y**2) / 2 + 3 * v.x**4 / 8},
        "kinetic; degree 4; at most two",
    ),
    "velocity in a function": (
        {"kinetic": lambda self, q, v, xp: xp.sqrt(1 + v.x**2) + v.y**2},
        "kinetic; function or denominator; sqrt",
    ),
    "velocity in a denominator": (
        {"kinetic": lambda self, q, v, xp: v.x**2 + v.y**2 + 1 / (1 + v.x)},
        "kinetic; function or denominator",
    ),
    "coordinate without mass": ({"kinetic": lambda self, q, v, xp: v.x**2 / 2}, "kinetic; 'y'; mass"),
    "energy without velocities": (
        {"kinetic": lambda self, q, v, xp: q.x**2 / 2 + q.y**2},
        "kinetic; 'x'; mass",
    ),
    "singular mass": ({"kinetic": lambda self, q, v, xp: (v.x + v.y) ** 2 / 2}, "kinetic; singular; x, y"),
    "singular mass everywhere by angles": (
        {"kinetic": lambda self, q, v, xp: (v.x * xp.cos(q.x) + v.y * xp.sin(q.x)) ** 2 / 2},
        "kinetic; singular",
    ),
    "negative mass": ({"kinetic": lambda self, q, v, xp: v.x**2 / 2 - v.y**2 / 2}, "kinetic; not positive"),
    "velocity in the potential": (
        {"potential": lambda self, q, v, xp: q.x**2 + v.x},
        "potential: it must be; (self, q, xp); (self, q, v, xp)",
    ),
    "explicit time": (
        {"potential": lambda self, q, t, xp: q.x**2 * xp.cos(t)},
        "potential; (self, q, xp); time",
    ),
    "signature of version 0.1": (
        {"dissipation": lambda self, v, u: v.x**2},
        "dissipation; (self, q, v, u, xp)",
    ),
    "forces without names": ({"applied": lambda self, q, v, u, xp: [u.force, 0.0]}, "applied; by coordinate"),
    "force on an unknown coordinate": (
        {"applied": lambda self, q, v, u, xp: {"theta": u.force}},
        "applied; 'theta'; x, y",
    ),
    "force that is all controls": (
        {"applied": lambda self, q, v, u, xp: {"x": u}},
        "applied; for 'x' it returns <controls force, s_ddot>; by its name",
    ),
    "force that is none": (
        {"applied": lambda self, q, v, u, xp: {"x": u.force if self.links > 3 else None}},
        "applied; None; 'x'",
    ),
    "rest of a free coordinate": ({"rests": lambda self: {"x": 1.0}}, "rests; 'x'; prescribed"),
    "pose without an angle": (
        {"poses": lambda self, q, xp: {"cart": (q.x, q.y)}},
        "poses; 'cart'; (x, y, angle)",
    ),
    "body without a pose": ({"bodies": lambda self: {"wheel": []}}, "bodies; 'wheel'; poses"),
    "body that is no shape": (
        {"bodies": lambda self: {"ground": ["cart"]}},
        "bodies; 'ground'; Line, Polygon, Circle; 'cart'",
    ),
    "body that is one shape": (
        {"bodies": lambda self: {"ground": Circle((0.0, 0.0), 1.0)}},
        "bodies; a list of shapes; 'ground'",
    ),
    "shape in a colour": (
        {"bodies": lambda self: {"ground": [Circle((0.0, 0.0), 1.0, "red")]}},
        "bodies: a role must be one of body, mark; 'red'",
    ),
    "shape without pairs": (
        {"bodies": lambda self: {"ground": [Line((0.0, 0.0, 1.0, 1.0))]}},
        "bodies: points must be pairs (x, y)",
    ),
    "shape of texts": (
        {"bodies": lambda self: {"ground": [Circle((0.0, 0.0), "1.0")]}},
        "bodies: sizes must be numbers; '1.0'",
    ),
    "shape of negative size": (
        {"bodies": lambda self: {"ground": [Circle((0.0, 0.0), -1.0)]}},
        "bodies: sizes must not be negative; radius=-1.0",
    ),
    "indicator at a coordinate of the moment": (
        {"indicators": lambda self, now, xp: {"arrow": (now.x, 0.0)}},
        "indicators; it has q, state, share, target",
    ),
    "indicator without a place": (
        {"indicators": lambda self, now, xp: {"arrow": now.q.x}},
        "indicators; 'arrow'; (x, y, angle, part)",
    ),
    "indicators without names": (
        {"indicators": lambda self, now, xp: [(now.q.x, 0.0)]},
        "indicators; by frame",
    ),
    "indicator at an unknown coordinate": (
        {"indicators": lambda self, now, xp: {"arrow": (now.q.z, 0.0)}},
        "indicators; 'z'; x, y",
    ),
    "shapes per moment": (
        {"shapes": lambda self, now: []},
        "shapes; bodies(self); poses(self, q, xp); indicators(self, now, xp)",
    ),
}


def test_a_constant_beyond_floats_that_only_the_equation_has():
    scene = changed(potential=lambda self, q, xp: 1e308 * q.x**2)()
    with pytest.raises(FormulaError, match=r"constant beyond 1.8e308; write the energies in other units"):
        scene.simulate([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [[0.0] * len(scene.control_names)], dt=0.01)


@mistake("kinetic", "kinetic(self, q, v, xp)", "method")
def formula_that_is_no_method():
    return changed(kinetic=1.0)


@mistake("Bad.rests must be a method, rests(self), got {'x': 0.1}")
def rests_that_are_no_method():
    return changed(rests={"x": 0.1})


@mistake("Bad.potential must be a method, potential(self, q, xp), got a property")
def formula_that_is_a_property():
    return changed(potential=property(lambda self: 0.0))


@mistake("Bad.window must be a method, window(self), got (0, 0, 1, 1)")
def window_that_is_no_method():
    return changed(window=(0, 0, 1, 1))


# --- names -------------------------------------------------------------------------------------------------

DECLARED = {
    "coordinates without units": ({"coordinates": ("x", "y")}, 'coordinates; {"x": "m"}'),
    "unit that is no text": ({"coordinates": {"x": "m", "y": 1.0}}, "coordinates; unit of 'y'"),
    "keyword": ({"coordinates": {"x": "m", "lambda": "m"}}, "coordinates; 'lambda'; keyword"),
    "name that Python reads as another": (
        {"coordinates": {"x": "m", "\u00b5": "m"}},
        "coordinates; Python reads '\u00b5' in a formula as '\u03bc', '\\u03bc'; write it that way",
    ),
    "name with a blank": ({"coordinates": {"x": "m", "x 1": "m"}}, "coordinates; 'x 1'"),
    "name with an underscore first": ({"coordinates": {"x": "m", "_x": "m"}}, "coordinates; '_x'"),
    "coordinate beside its rate": (
        {"coordinates": {"x": "m", "y": "m", "x_dot": "m/s"}},
        "'x_dot'; derivative of 'x'",
    ),
    "coordinate free and prescribed": (
        {"prescribed": {"s": "m", "rise": "m", "x": "m"}},
        "'x'; free and prescribed",
    ),
    "control of a free coordinate": ({"controls": {"x_ddot": "m/s²"}}, "'x_ddot'; applied"),
    "two controls of one coordinate": (
        {"controls": {"force": "N", "s_ddot": "m/s²", "s_dot": "m/s"}},
        "'s_ddot'; 's_dot'; both",
    ),
    "control that is not used": (
        {"controls": {"force": "N", "motor": "N"}},
        "'motor'; has no effect; u.motor",
    ),
    "method of every scene": ({"power": lambda self: 1.0}, "power; another"),
    "state that lacks a name": ({"state": ("x", "x_dot", "y", "y_dot")}, "state; in some order"),
    "state that is text": ({"state": "x"}, "state; names in order"),
    "rate left out without its place": ({"left_out": ("s_dot",)}, "left_out; 's'; 's_dot'"),
    "left out that is not there": ({"left_out": ("z",)}, "left_out; 'z'"),
    "rate of a free coordinate left out": ({"left_out": ("x", "x_dot")}, "left_out; 'x_dot'; free"),
    "left out free place that is needed": ({"left_out": ("x",)}, "left_out; depends on 'x'"),
    "reaction on what is not prescribed": (
        {"reactions": {"support": "rise", "push": "s", "wall": "x"}},
        "reactions; 'wall'; prescribed",
    ),
    "ratio of unknown forces": ({"ratios": {"needed": ("push", "normal")}}, "ratios; 'normal'; reactions"),
    "reaction named like a drive": (
        {"reactions": {"support": "rise", "drive_s": "rise"}, "ratios": {}},
        "two; 'drive_s'; rename; reactions",
    ),
    "ratio named like a reaction": ({"ratios": {"push": ("push", "support")}}, "two; 'push'; rename"),
    "ratio of one force": ({"ratios": {"needed": "push"}}, "ratios; pair"),
    "controls and modes": ({"modes": {"pushed": {"force": "N"}}}, "controls and modes"),
    "mode that is no dict": ({"controls": {}, "modes": {"pushed": "force"}}, "modes; 'pushed'"),
}


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


@mistake("'x'", "coordinate")
def parameter_named_like_a_coordinate():
    class Bad(Good):
        x: float = parameter(1.0, "m")

    return Bad


@mistake("'y_dot'", "coordinate")
def parameter_named_like_a_state():
    class Bad(Good):
        y_dot: float = parameter(1.0, "m")

    return Bad


@mistake("'force'", "a control")
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


@mistake("'potential'")
def parameter_named_like_a_formula():
    class Bad(Good):
        potential: float = parameter(1.0, "J")

    return Bad


@mistake("width has no annotation", "width: float = parameter(...)")
def parameter_without_annotation():
    class Bad(Good):
        width = parameter(1.0, "m")

    return Bad


@mistake("width replaces a field without an annotation", "width: float = parameter(...)")
def parameter_replaced_by_a_number():
    class Wide(Good):
        width: float = parameter(1.0, "m")

    class Bad(Wide):
        width = 2.0

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


@mistake("coordinates", "index or range", "structural")
def coordinates_that_count_a_parameter():
    return changed(coordinates=property(lambda self: {f"x_{i}": "m" for i in range(self.spring)}))


@mistake("left_out", "comparison")
def state_that_depends_on_a_parameter():
    return changed(left_out=property(lambda self: () if self.friction == 0.0 else ("s",)))


@mistake("frozen", "kw_only=True")
def dataclass_that_is_not_frozen():
    @dataclasses.dataclass
    class Bad(Scene):
        coordinates = {"x": "m"}

        def kinetic(self, q, v, xp):
            return v.x**2

        def potential(self, q, xp):
            return q.x**2

    return Bad


@mistake("frozen", "kw_only=True")
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


@mistake("0.1", "drive, unpack and pack")
def scene_of_version_0_1():
    class Bad(Good):
        def drive(self, y, u, k, xp): ...

        def unpack(self, y, u, k): ...

        def pack(self, moved, y, u, dt, k): ...

    return Bad


@mistake("unhashable type: 'list'", "structural fields must be hashable: give a tuple")
def structural_field_that_is_a_list():
    class Bad(Good):
        lengths: tuple = ()

    return lambda: Bad(lengths=[1.0, 2.0])


@mistake("Bad.coordinates fails with TypeError: 'str' object cannot be", "; it was given links='4'")
def structural_field_of_another_type():
    bad = changed(coordinates=property(lambda self: {f"x_{i}": "m" for i in range(self.links)}))
    return lambda: bad(links="4")


@mistake("Bad.bodies fails with IndexError", "it was given mass=1.0, spring=2.0, friction=0.0, links=2")
def bodies_that_fail():
    return changed(bodies=lambda self: {"ground": [][self.links]})


@mistake("Bad.spring fails with ZeroDivisionError", "it was given mass=1.0, friction=0.0, links=2")
def computed_default_that_fails():
    class Bad(Good):
        spring: float = parameter(lambda scene: 1.0 / scene.friction, "N/m")

    return Bad


@mistake("Bad.spring fails with AttributeError", "no attribute 'mas'; did you mean mass")
def computed_default_of_an_unknown_name():
    class Bad(Good):
        spring: float = parameter(lambda scene: 2.0 * scene.mas, "N/m")

    return Bad


@mistake("Bad.kinetic", "'Values' and 'int'; take the numbers one by one, by name or index")
def arithmetic_with_all_velocities():
    return changed(kinetic=lambda self, q, v, xp: self.mass * v**2)


# --- the test ----------------------------------------------------------------------------------------------

for name, (attributes, words) in (UNTRACEABLE | INVALID | DECLARED).items():
    MISTAKES.append(pytest.param(partial(changed, **attributes), words.split("; "), id=name))


def test_the_good_one_is_good():
    assert Good().state_names == ("s", "s_dot", "x", "x_dot", "y", "y_dot")


@pytest.mark.parametrize("decorated", [False, True], ids=["plain", "decorated"])
@pytest.mark.parametrize(("make", "words"), MISTAKES)
def test_mistake_is_refused_by_name_and_with_the_remedy(make, words, decorated):
    bad = make()
    if decorated and isinstance(bad, type) and "__dataclass_fields__" not in vars(bad):
        bad = dataclasses.dataclass(frozen=True, kw_only=True)(bad)
    for _ in range(2):  # and again, whatever the first attempt left behind
        with pytest.raises(FormulaError) as caught:
            bad()
        message = str(caught.value)
        assert re.match(r"Bad\b", message), message
        for word in words:
            assert word in message, message
        assert len(message) < 400


def test_there_are_many_kinds_of_mistakes():
    assert len(MISTAKES) > 60


def test_what_is_refused_is_a_type_error_and_a_value_error():
    """Catching one of them catches all."""
    assert issubclass(FormulaError, TypeError) and issubclass(FormulaError, ValueError)


def test_unit_of_a_parameter():
    with pytest.raises(
        FormulaError, match=r"must be text, as in parameter\(1.0, .kg.\), or .1. for a pure number, got 3"
    ):
        parameter(1.0, 3)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"above": 3.0, "below": 2.0}, "the range of a parameter is empty: no value is above 3 and below 2"),
        ({"least": 3.0, "below": 3.0}, "no value is at least 3 and below 3"),
        ({"least": 3.0, "most": 2.0}, "no value is at least 3 and at most 2"),
        ({"above": "0", "below": 3.0}, "above of a parameter must be a number, as in above=0.0, got '0'"),
        ({"usable": (2.0, 1.0)}, r"usable must be (lowest, highest), in this order, got (2.0, 1.0)"),
    ],
)
def test_limits_that_no_parameter_meets(limits, words):
    with pytest.raises(FormulaError, match=re.escape(words)):
        parameter(2.5, "m", **limits)
    parameter(3.0, "m", least=3.0, most=3.0)


@pytest.mark.parametrize(
    "potential",
    [
        lambda self, q, xp: q.x / (self.spring - 1.0),
        lambda self, q, xp: xp.sqrt(self.spring - 2.0) * q.x,
        lambda self, q, xp: xp.exp(800.0 * self.spring) * q.x,
    ],
)
def test_parameters_for_which_a_formula_has_no_value(potential):
    scene = changed(potential=potential)(spring=1.0)
    rest = [0.1] * len(scene.state_names)
    message = r"a coefficient of the motion is undefined or not finite: \w+\(.*spring=1.0"
    for call in (
        lambda: scene.simulate(rest, [[0.0] * len(scene.control_names)], 0.1),
        lambda: scene.jacobian(rest, [0.0] * len(scene.control_names), 0.1),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    with contextlib.suppress(ValueError):  # or not finite
        assert not all(map(math.isfinite, scene.acceleration(rest).values()))


def test_unknown_parameter():
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'massa'; did you mean mass\?"):
        Good(massa=1.0)
    with pytest.raises(
        TypeError, match="unexpected keyword argument 'qqq'; available: mass, spring, friction"
    ):
        Good(qqq=1.0)
    with pytest.raises(TypeError, match="3 were given; give mass, spring, friction, links by name"):
        Good(1.0, 2.0)


@pytest.mark.parametrize(
    ("state", "control", "words"),
    [
        ([0.0] * 5, 0.0, "(s, s_dot, x, x_dot, y, y_dot)"),
        (np.zeros((6, 5)), 0.0, "(s, s_dot, x, x_dot, y, y_dot)"),
        (3.0, 0.0, "(s, s_dot, x, x_dot, y, y_dot)"),
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


def test_every_scene_is_tried_on_plain_numbers():
    """A formula may ask for a type only with some parameters."""
    stiff = changed(
        potential=lambda self, q, xp: (
            (9.0 if isinstance(self.mass, float) and self.mass > 5.0 else 1.0) * q.x**2
        )
    )
    stiff(mass=1.0)
    with pytest.raises(FormulaError, match="potential gives another result on plain numbers"):
        stiff(mass=10.0)


def test_formulas_without_a_value_at_some_points():
    """Roots of negative numbers, which Python makes complex, and what cancels."""
    radius = changed(
        potential=lambda self, q, xp: -((self.mass**2 - q.x**2) ** 0.5) + ((self.spring - 3.0) ** 0.5) ** 4
    )
    assert radius().acceleration([0.1] * 6)["x"] < 0.0
    cancelling = changed(
        applied=lambda self, q, v, u, xp: {
            "x": u.force + self.spring * ((q.x + 1e3) ** 2 - q.x**2 - 2e3 * q.x - 1e6)
        }
    )
    assert cancelling().acceleration([0.0] * 6, [2.0, 0.0])["x"] == 2.0


def test_an_energy_that_divides_by_zero():
    """The motion does not: what is constant drops out."""
    scene = changed(potential=lambda self, q, xp: self.spring * q.x**2 + 1.0 / (self.mass - 2.0))(mass=2.0)
    rest = [0.1] * len(scene.state_names)
    assert math.isfinite(scene.acceleration(rest)["x"])
    with pytest.raises(ValueError, match=r"the energy is undefined with these parameters, .*mass=2.0"):
        scene.energy(rest)


@pytest.mark.parametrize("gap", [1e-6, 1e-9, 1e-12])
def test_a_mass_that_cancels_is_not_singular(gap, monkeypatch):
    """R² - 2Rr + r² rounds to 0, or below, for r near R; it does so in the first scene of a process."""
    monkeypatch.setattr(door, "_admitted", weakref.WeakKeyDictionary())
    shell = CylinderInCylinder(shell_radius=0.5, radius=0.5 - gap)
    acceleration = -9.81 * math.sin(0.1) / (1.5 * shell.arm)
    dt = 1e-3 / math.sqrt(-acceleration)
    after = shell.simulate([0.1, 0.0, 0.0], [0.0], dt)[-1]
    assert after[1] == pytest.approx(acceleration * dt, rel=1e-4)


def test_signs_of_the_mass_are_checked_for_every_scene():
    class Mass(Scene):
        coordinates = {"x": "m", "y": "m"}
        m: float = parameter(1.0, "kg")
        off: float = parameter(0.5, "kg")

        def kinetic(self, q, v, xp):
            return self.m * (v.x**2 + v.y**2) / 2 + self.off * v.x * v.y

        def potential(self, q, xp):
            return q.x**2 + q.y**2

    assert Mass().m == 1.0
    for numbers in ({"m": -1.0}, {"off": 1.0}, {"off": 2.0}):
        with pytest.raises(FormulaError, match=r"Mass\.kinetic gives a mass matrix of x, y that is"):
            Mass(**numbers)
    assert Mass(m=3.0, off=2.0).off == 2.0
