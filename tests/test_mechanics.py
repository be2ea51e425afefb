"""The algebra of recorded formulas against numbers in 30 digits, and operations that a record leaves out."""

import math
import pickle
import random
from collections import Counter

import mpmath
import pytest
from series_systems import SYSTEMS

from lag_envs.mechanics.algebra import (
    LARGEST_PRODUCT,
    Atom,
    Expr,
    RecordedFunctions,
    apart,
    derivative,
    evaluate,
    function_of,
    linear_opened,
    opened,
    substitute,
)
from lag_envs.mechanics.identities import apply_identities, shorter
from lag_envs.scenes import Chain
from lag_envs.stepping.general import series_code_of
from lag_envs.stepping.lowering import Lowering

PLACES = [Atom("place", name) for name in "abc"]
X, Y = (Expr.of(place) for place in PLACES[:2])


@pytest.fixture(autouse=True)
def precise():
    with mpmath.workdps(30):
        yield


def values():
    return dict(zip(PLACES, map(mpmath.mpf, ("0.7", "-1.3", "0.4")), strict=True))


def agree(a, b):
    return abs(a - b) < 1e-14 * (1 + abs(b))  # a function of a number is taken in floats


def formula(seed, leaves, xp):
    """Return a random formula of three numbers of any kind; the same for each kind."""
    chance = random.Random(seed)

    def make(depth):
        if depth == 0:
            return chance.choice(leaves)
        a, kind = make(depth - 1), chance.choice("+-*/^fff")
        if kind == "^":
            return a ** chance.choice((2, 3))
        if kind == "f":
            name = chance.choice(("sin", "cos", "tan", "atan", "tanh", "exp", "log", "sqrt"))
            inner = 2 + a * a if name in ("log", "sqrt") else a / (3 + a * a)
            return getattr(xp, name)(inner)
        b = make(depth - 1)
        return {"+": a + b, "-": a - 2 * b, "*": a * b / 4, "/": a / (3 + b * b)}[kind]

    return make(4)


@pytest.mark.parametrize("seed", range(40))
def test_formulas_have_the_value_and_the_derivatives_that_numbers_give(seed):
    known = values()
    expr = Expr.of(formula(seed, [Expr.of(place) for place in PLACES], RecordedFunctions()))
    number = formula(seed, list(known.values()), mpmath)
    assert all(agree(x, number) for x in evaluate([expr, apply_identities(expr)], known, mpmath))
    for i, place in enumerate(PLACES):

        def along(x, i=i):
            return formula(seed, [*list(known.values())[:i], x, *list(known.values())[i + 1 :]], mpmath)

        (slope,) = evaluate([derivative(expr, place)], known, mpmath)
        assert abs(slope - mpmath.diff(along, known[place])) < 1e-12 * (1 + abs(slope))
    (moved,) = evaluate([substitute(expr, {PLACES[0]: Y * Y})], known, mpmath)
    _, b, c = known.values()
    assert agree(moved, formula(seed, [b * b, b, c], mpmath))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("names", [("cos", "cos"), ("sin", "sin"), ("sin", "cos")])
def test_sums_of_angles_become_one_function(names, sign):
    other = ["sin" if name == "cos" else "cos" for name in names]
    first, second = (function_of(a, X) * function_of(b, Y) for a, b in (names, other))
    found = apply_identities(3 * first + 3 * sign * second)
    assert len(found.terms) == 1
    assert agree(*evaluate([found, 3 * first + 3 * sign * second], values(), mpmath))


def test_squares_of_cosine_and_sine():
    c, s = function_of("cos", X), function_of("sin", X)
    assert apply_identities(Y * (c * c + s * s)).same(Y)
    assert apply_identities(5 * Y * c * c + 2 * Y * s * s).same(2 * Y + 3 * Y * c * c)
    root = function_of("sqrt", 1 + X * X)
    assert (root * root).same(1 + X * X) and (root / root).same(Expr.of(1))


def test_texts_do_not_depend_on_the_order_of_making():
    terms = [X * Y, function_of("cos", X - Y), 3 / (1 + X), -Y]
    forward, backward = sum(terms), sum(reversed(terms))
    assert forward.text == backward.text and forward.same(backward)
    assert function_of("cos", X - Y).same(function_of("cos", Y - X))
    atom = pickle.loads(pickle.dumps(Atom("place", "a")))
    assert atom is PLACES[0]


def test_products_of_long_sums_are_kept():
    long = sum(X**n for n in range(70))
    other = sum(Y**n for n in range(70))
    product = long * other
    assert len(long.terms) * len(other.terms) > LARGEST_PRODUCT and len(product.terms) == 1
    a, b, _ = values().values()
    (value,) = evaluate([product], values(), mpmath)
    assert agree(value, sum(a**n for n in range(70)) * sum(b**n for n in range(70)))
    (slope,) = evaluate([derivative(product, PLACES[0])], values(), mpmath)
    assert agree(slope, sum(n * a ** (n - 1) for n in range(1, 70)) * sum(b**n for n in range(70)))


C, K = (Expr.of(Atom("parameter", name)) for name in "ck")


def test_products_of_a_sum_are_its_powers():
    d = X - C
    assert (d * d * d * d).same(d**4) and (d * d**2 * d).same(d**4)
    assert (0.5 * K * d * d * d * d).same(0.5 * K * d**4)
    assert (d * -d * (2 * d)).same(-2 * d**3)
    assert (X * d * (X * d) * d).same(X**2 * d**3)
    assert (d**3 / d).same(d**2) and (d / d).same(Expr.of(1)) and (2 * d / d**2).same(2 / d)
    fast = Expr.of(Atom("velocity", "a")) - Expr.of(Atom("velocity", "b"))
    assert (fast * fast**3).same(fast**4)


def test_products_of_moving_sums_stay_factors():
    def factors(x, y, c):
        d = x - c
        return [d - 2, 3 * d + 1, d * d - 0.25, y - x, x * y - c * y, 1 + x / (1 + d * d)]

    product = math.prod(factors(X, Y, C))
    assert len(product.terms) == 1
    for seed in range(5):
        shuffled = random.Random(seed).sample(factors(X, Y, C), 6)
        assert math.prod(shuffled).same(product)
        assert (math.prod(shuffled[:3]) * math.prod(shuffled[3:])).same(product)
    x, y, c = map(mpmath.mpf, ("1024.7", "1023.1", "1024.4"))
    known = dict(zip([*PLACES[:2], *C.atoms()], map(float, (x, y, c)), strict=True))
    x, y, c = map(mpmath.mpf, known.values())
    slope = mpmath.diff(lambda x: math.prod(factors(x, y, c)), x)
    found = evaluate([product, derivative(product, PLACES[0])], known, math)
    assert found == pytest.approx([math.prod(factors(x, y, c)), slope], rel=1e-12)
    there = math.prod(factors(Expr.of(1024.5), Y, C))
    assert substitute(product, {PLACES[0]: Expr.of(1024.5)}).same(there)


def test_sums_that_may_meet_others_are_multiplied_out():
    d, c, v = X - C, function_of("cos", X), Expr.of(Atom("velocity", "a"))
    for a, b in ((1 + c, 2 + c), (1 + v, 2 + v), (1 + v, c - C), (1 + c, d), (1 + K, d), (1 + K, 2 + K)):
        assert len((a * b).terms) > 2 and (a * b).same(b * a)
    assert apply_identities((1 + c) * (1 - c) - 1).same(-c * c)


def test_sums_with_cosines_stay_factors_apart():
    """So a potential keeps its digits where they are small."""
    with apart():
        w = function_of("cos", X) - C
        power = w**6
        assert (w * w * w * w * w * w).same(power) and ((w * w) ** 3).same(power) and len(power.terms) == 1
        square = (function_of("sin", X) - function_of("sin", Y)) ** 2
        assert len(square.terms) == 1 and len((square + w**2).terms) == 2
        many = math.prod(function_of("sin", i * X) + function_of("cos", Y + i) + C for i in range(1, 9))
        assert len(many.terms) == 1
        wind = Expr.of(Atom("velocity", "a")) - Expr.of(Atom("control", "w"))
        assert (wind * wind * wind).same(wind**3) and len((-wind * wind * wind).terms) == 1
        assert len((wind * wind).terms) == 1 and len(linear_opened(wind**2 * K).terms) == 3
        assert len(linear_opened(wind**2 * function_of("sqrt", 1 + wind**2)).terms) == 1
    assert len((w * w).terms) == 3 and len((wind * wind).terms) == 3
    shift = {PLACES[0]: X + 1}  # puts in a place, and takes nothing apart
    assert len(substitute(square, shift).terms) == 1
    assert len(substitute(square, {place: Expr.of(1) for place in PLACES}).terms) == 0


def test_a_sum_of_places_stays_apart_from_velocities():
    """So do sines and cosines where they need not meet others."""
    (v, w), d, waves = (Expr.of(Atom("velocity", name)) for name in "ab"), X - Y, function_of("cos", X) - C
    assert len((waves * (v - w)).terms) == 4
    with apart():
        product = waves * (v - w)
        assert len(product.terms) == 2
    assert len(substitute(product, {PLACES[1]: X}).terms) == 2
    product = d * (v - w)
    assert len(product.terms) == 2 and len((d * v).terms) == len(((X * d) * v).terms) == 1
    assert product.same(d * v - d * w) and (2 * C * d * (v - w)).same((v - w) * (2 * C * d))
    assert len(substitute(product, {PLACES[0]: X + C}).terms) == 2
    assert substitute(product, {PLACES[0]: Y + C}).same(C * (v - w))


def test_squares_are_multiplied_out_where_that_is_shorter():
    with apart():
        x, y = (function_of(f, X) - function_of(f, Y) for f in ("sin", "cos"))
        square, well = x**2 + y**2, (function_of("cos", X) - C) ** 2
    assert len(square.terms) == 2
    assert shorter(square).same(2 - 2 * function_of("cos", X - Y))
    assert shorter(well).same(well) and shorter(function_of("sqrt", square)).same(function_of("sqrt", square))


def test_a_kinetic_energy_takes_the_shorter_form():
    """A sum of places stays if sine and cosine meet all the same, which depends on how rates are written."""
    v, w = (Expr.of(Atom("velocity", name)) for name in "ab")
    sin, cos = (function_of(name, Y) for name in ("sin", "cos"))
    across, along = v * cos - (C + X) * w * sin, v * sin + (C + X) * w * cos
    polar = v**2 + (C + X) ** 2 * w**2
    assert apply_identities(shorter(across**2 + along**2)).same(polar)
    along = v * sin + (C + X) * cos * w
    assert shorter(across**2 + along**2).same(opened(polar)) and len(opened(polar).terms) == 4


def test_roots_of_fourth_powers_are_squares():
    assert function_of("sqrt", X**4).same(X**2)
    assert function_of("sqrt", 9 * X**8 * C).same(X**4 * function_of("sqrt", 9 * C))
    assert function_of("sqrt", C / X**4).same(function_of("sqrt", C) / X**2)


# --- records ------------------------------------------------------------------------------------------------


def products(record):
    return Counter(node.op for node in record.nodes)["product"]


@pytest.mark.parametrize(
    "scene", [*(s.scene for s in SYSTEMS), Chain(bars=4)], ids=lambda s: type(s).__name__
)
def test_nothing_is_computed_twice_or_for_nothing(scene):
    record = series_code_of(scene)[0].record
    assert len(set(record.nodes)) == len(record.nodes)
    used = {a for node in record.nodes for a in node.args} | {n for n, *_ in record.mass.values()}
    assert used | set(record.force) >= set(range(len(record.nodes)))


def test_powers_and_common_factors():
    lowering = Lowering(["a", "b", "c"], {})
    z = Expr.of(PLACES[2])
    right, entries = lowering.parts({(0, 0): Expr.of(1)}, [X**8, X * Y + X * z, X * Y + X * z + X**2])
    record = lowering.without(right, entries)
    # x², x⁴, x⁸; x (y + z); and x (x + y + z) or x² + x (y + z)
    assert products(record) <= 5


def test_what_is_zero_takes_along_all_that_it_multiplies():
    k = Expr.of(Atom("parameter", "k"))
    lowering = Lowering(["a", "b", "c"], {})
    parts = lowering.parts({(0, 0): 1 + k * X * X}, [k * function_of("exp", X) * Y, function_of("sin", X)])
    (name,) = lowering.constants
    whole, without = lowering.without(*parts), lowering.without(*parts, frozenset([name]))
    assert sorted(node.op for node in without.nodes) == ["cos", "place", "sin", "velocity"]
    assert without.force[0] == -1 and without.mass == {(0, 0): (-1, 1.0, 1.0)}
    assert not without.given and whole.given == (name,)
