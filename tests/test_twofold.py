"""Numbers with twice the digits, against fractions, in Python and compiled."""

import math
from fractions import Fraction

import numpy as np
import pytest

from lag_envs.stepping.compiling import compile_traced
from lag_envs.stepping.tracing import pairwise_sum, polynomial, sum_of_products
from lag_envs.stepping.twofold import Twofold, mixed_polynomial, two_product, two_sum

HALF_DIGITS = 2.0**-100  #: accuracy of sums of a few terms, relative to the largest


def exact(number):
    return Fraction(number.high) + Fraction(number.low)


def random_floats(n, seed, decades=8):
    rng = np.random.default_rng(seed)
    return (rng.uniform(-1.0, 1.0, n) * 10.0 ** rng.uniform(-decades, decades, n)).tolist()


def test_error_free_transformations():
    for a, b in zip(random_floats(300, 1), random_floats(300, 2), strict=True):
        total, rest = two_sum(a, b)
        assert total == a + b and Fraction(total) + Fraction(rest) == Fraction(a) + Fraction(b)
        product, rest = two_product(a, b)
        assert product == a * b and Fraction(product) + Fraction(rest) == Fraction(a) * Fraction(b)


def formula(xp, *numbers):
    """Run the operations of the series."""
    a, b, c, d = (Twofold(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True))
    results = [
        a + b,
        a - b * c,
        a * b * c,
        sum_of_products([(a, b), (c, d), (a, d)]),
        pairwise_sum([a, b, c, d, a * d]),
        (a * (1.0 / 3.0) - 1.0) * 0.5 + 0.1,
        polynomial([1.0, -0.5, 1.0 / 6.0], a),
        0.0 + a * 0.0 + b,
        -a,
    ]
    return tuple(part for number in results for part in number.parts())


def fractions(numbers):
    a, b, c, d = (
        Fraction(high) + Fraction(low) for high, low in zip(numbers[::2], numbers[1::2], strict=True)
    )
    third, tenth, sixth = Fraction(1, 3), Fraction(1, 10), Fraction(1, 6)
    return [
        (a + b, (a, b)),
        (a - b * c, (a, b * c)),
        (a * b * c, (a * b * c,)),
        (a * b + c * d + a * d, (a * b, c * d, a * d)),
        (a + b + c + d + a * d, (a, b, c, d, a * d)),
        ((a * third - 1) / 2 + tenth, (a, 1)),
        (1 - a / 2 + sixth * a * a, (1, a, a * a)),
        (b, (b,)),
        (-a, (a,)),
    ]


@pytest.fixture(scope="module")
def compiled():
    names = ", ".join(f"n{i}" for i in range(8))
    return compile_traced("twofold_formula", names, formula)


def test_twice_the_digits(compiled):
    """Sums, products and constants such as 1/3, in Python and compiled, with the same bits."""
    for i in range(200):
        high = random_floats(4, 100 + i, decades=3)
        low = [h * e * 2.0**-54 for h, e in zip(high, random_floats(4, 500 + i, decades=0), strict=True)]
        numbers = [x for pair in zip(high, low, strict=True) for x in pair]
        parts = formula(None, *numbers)
        results = compiled(*numbers)
        assert len(results) == len(parts)
        for given in (parts, results):
            for k, (truth, terms) in enumerate(fractions(numbers)):
                value, rest = given[2 * k], given[2 * k + 1]
                assert abs(rest) <= math.ulp(value)
                size = max(map(abs, terms))
                assert abs(Fraction(value) + Fraction(rest) - truth) <= HALF_DIGITS * size, k


def test_a_float_stands_for_its_fraction():
    for numerator in range(1, 31):
        for denominator in range(1, 31):
            third = Twofold(1.0) * (numerator / denominator)
            assert abs(exact(third) - Fraction(numerator, denominator)) < numerator * HALF_DIGITS
    for odd in (math.pi, 0.1 + 0.2, 1e-17, 12345.678901234567):
        assert exact(Twofold(1.0) * odd) == Fraction(odd)


def test_mixed_polynomial():
    """Small terms are computed as floats, without a visible effect."""
    sine = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(8)]
    for x in np.linspace(-0.5, 0.5, 41):
        z = Twofold(float(x)) * Twofold(float(x))
        value = exact(Twofold(float(x)) * mixed_polynomial(sine, z, twofold=3))
        truth = sum(
            Fraction((-1) ** k, math.factorial(2 * k + 1)) * Fraction(float(x)) ** (2 * k + 1)
            for k in range(8)
        )
        assert abs(value - truth) <= 2e-21 * abs(Fraction(float(x)))
