"""Elementary functions from plain arithmetic, and the code generated from recorded operations.

Each formula is recorded once. The tests cover the machine code on vectors of 8 and on single numbers, and the
same operations on Python's floats, fused and unfused.
"""

import math
import re
from functools import cache

import mpmath
import numpy as np
import pytest
from llvmlite import binding, ir
from numba import njit, types
from numba.extending import intrinsic
from plain_target import evaluate_operations

from lag_envs.stepping import elementary
from lag_envs.stepping.elementary import LARGEST_ANGLE, ElementaryTrace
from lag_envs.stepping.primitives import emit
from lag_envs.stepping.tracing import Trace

# For each formula its exact values and the largest error allowed [ulp].
EXACT = {
    "sincos": ((mpmath.sin, mpmath.cos), 1.5),
    "tan": ((mpmath.tan,), 3.0),
    "exp": ((mpmath.exp,), 1.5),
    "log": ((mpmath.log,), 1.5),
    "atan": ((mpmath.atan,), 1.5),
    "tanh": ((mpmath.tanh,), 2.5),
}
SPECIAL = [0.0, -0.0, math.inf, -math.inf, math.nan, 5e-324, -5e-324, 2.0**-1022, -1.0, 1.8e308, -1.79e308]
BOTH = pytest.mark.parametrize("fused", [True, False], ids=["fused", "unfused"])


def lanes(operations, inputs, outputs, width):
    """Return a compiled function that carries out operations on vectors, from (..., inputs, width)."""
    kind = ir.VectorType(ir.DoubleType(), width) if width > 1 else ir.DoubleType()

    @intrinsic
    def body(typingctx, source, target):
        def codegen(context, builder, signature, args):
            x, y = (builder.inttoptr(a, kind.as_pointer()) for a in args)
            write(builder, operations, inputs, outputs, x, y)
            return context.get_dummy_value()

        return types.void(types.intp, types.intp), codegen

    @njit
    def loop(x, y):
        for i in range(len(x)):
            body(x[i].ctypes.data, y[i].ctypes.data)

    def call(x):
        y = np.empty((len(x), len(outputs), width))
        loop(np.ascontiguousarray(x, dtype=float), y)
        return y

    return call


def write(builder, operations, inputs, outputs, x, y):
    """Write: load the inputs, carry out the operations, store the outputs."""

    def place(pointer, i):
        return builder.gep(pointer, [ir.Constant(ir.IntType(64), i)])

    values = emit(builder, operations, {n: builder.load(place(x, i), align=8) for i, n in enumerate(inputs)})
    for i, name in enumerate(outputs):
        builder.store(values[name], place(y, i), align=8)


@cache
def recorded(function, fused):
    """Return operations and results of one formula."""
    trace = Trace()
    results = getattr(elementary, function)(*trace.inputs("x"), trace)
    return trace.operations(results if isinstance(results, tuple) else [results], fused=fused)


@cache
def compiled(function, fused, width):
    """Return a formula as compiled function, from (n,) to (n, results)."""
    operations, results = recorded(function, fused)
    run = lanes(operations, ["x"], results, width)

    def call(x):
        padded = np.append(x, np.ones(-len(x) % width)).reshape(-1, 1, width)
        return run(padded).transpose(0, 2, 1).reshape(-1, len(results))[: len(x)]

    return call


def interpreted(function, fused, x):
    """Return the results with Python's floats, (n, results)."""
    operations, results = recorded(function, fused)
    known = [evaluate_operations(operations, {"x": value}) for value in x.tolist()]
    return np.array([[values[name] for name in results] for values in known])


def assert_same_bits(a, b):
    """Compare bit for bit, including signs of zeros; NaN has no sign."""
    np.testing.assert_array_equal(a, b)
    number = ~np.isnan(a)
    np.testing.assert_array_equal(np.signbit(a)[number], np.signbit(b)[number])


def neighbours(values, reach):
    values = np.asarray(values, dtype=float)
    return np.concatenate([values + k * np.spacing(values) for k in range(-reach, reach + 1)])


def points(function, n, seed=0):
    """Return arguments that are hard for the function: about ``n`` of each kind."""
    rng = np.random.default_rng(seed)
    small = 10.0 ** rng.uniform(-320.0, 0.0, n // 2) * rng.choice([-1.0, 1.0], n // 2)
    if function in ("sincos", "tan"):
        quarters = [*range(-40, 41), *rng.integers(-16_500_000, 16_500_000, n)]
        multiples = [float(mpmath.pi / 2 * int(k)) for k in quarters]
        return np.concatenate(
            [
                rng.uniform(-0.8, 0.8, n),
                rng.uniform(-100.0, 100.0, n),
                rng.uniform(-LARGEST_ANGLE, LARGEST_ANGLE, n),
                neighbours(multiples, 1),
                neighbours(np.arange(-20, 20) * math.pi / 4.0, 1),
                # The nearest to multiples of pi/2 of all: within 2^-59.
                [45.553093477052, 91.106186954104, 14461176.67027838],
                small,
            ]
        )
    if function == "exp":
        halves = (rng.integers(-1074, 1024, n) + 0.5) * math.log(2.0)
        return np.concatenate(
            [
                rng.uniform(-0.5, 0.5, n),
                rng.uniform(-745.0, 709.7, n),
                rng.uniform(-746.0, -707.0, n),
                halves,
                small,
            ]
        )
    if function == "log":
        powers = 2.0 ** rng.integers(-1022, 1024, n)
        return np.concatenate(
            [
                rng.uniform(0.5, 2.0, 2 * n),
                1.0 + 1e-3 * rng.normal(size=n),
                10.0 ** rng.uniform(-323.0, 308.0, n),
                neighbours(powers * math.sqrt(0.5), 1),
                neighbours([1.0], 20),
            ]
        )
    if function == "atan":
        large = 10.0 ** rng.uniform(0.0, 308.0, n)
        return np.concatenate(
            [
                rng.uniform(-3.0, 3.0, n),
                rng.uniform(0.55, 0.7, n),
                rng.uniform(-2.5, -2.3, n),
                neighbours([0.55, 1.0, 2.4], 5),
                large,
                small,
            ]
        )
    steps = (np.arange(60) + 0.5) * math.log(2.0) / 2.0
    return np.concatenate(
        [
            rng.uniform(-1.0, 1.0, n),
            rng.uniform(-22.0, 22.0, n),
            rng.uniform(0.17, 0.4, 2 * n),
            neighbours(steps, 2),
            small,
        ]
    )


def error(value, exact):
    """Return the error in units in the last place of the exact value, at least those of subnormals."""
    if not math.isfinite(value):
        return 0.0 if abs(exact) >= mpmath.mpf(2) ** 1024 * (1 - mpmath.mpf(2) ** -54) else math.inf
    place = max(mpmath.frexp(exact)[1] - 53, -1074) if exact else -1074
    return float(abs(value - exact) * mpmath.ldexp(1, -place))


def assert_accurate(function, n):
    formulas, allowed = EXACT[function]
    x = points(function, n)
    with mpmath.workprec(200):
        exact = [[formula(mpmath.mpf(v)) for formula in formulas] for v in x.tolist()]
        for fused in (True, False):
            values = compiled(function, fused, 8)(x)
            for v, row, exact_row in zip(x.tolist(), values.tolist(), exact, strict=True):
                errors = [error(y, e) for y, e in zip(row, exact_row, strict=True)]
                assert max(errors) <= allowed, (function, fused, v, errors)


@pytest.mark.parametrize("function", EXACT)
def test_accurate_to_the_promised_units_in_the_last_place(function):
    assert_accurate(function, 150)


@pytest.mark.slow
@pytest.mark.parametrize("function", EXACT)
def test_accurate_at_many_points(function):
    assert_accurate(function, 20_000)


@BOTH
@pytest.mark.parametrize("function", EXACT)
def test_vectors_single_numbers_and_python_give_the_same_bits(function, fused):
    x = np.concatenate(
        [points(function, 40, seed=1), SPECIAL, np.random.default_rng(2).normal(size=3) * 1e300]
    )
    eight = compiled(function, fused, 8)(x)
    assert_same_bits(eight, compiled(function, fused, 1)(x))
    assert_same_bits(eight, interpreted(function, fused, x))


@BOTH
@pytest.mark.parametrize("width", [1, 8])
def test_ends_of_the_range(width, fused):
    def value(function, x):
        return compiled(function, fused, width)(np.array(x))[:, 0]

    inf, nan = math.inf, math.nan
    for function in EXACT:
        assert np.isnan(value(function, [nan])).all()
        if function not in ("exp", "log"):  # odd, and like their arguments near 0
            tiny = [0.0, -0.0, 5e-324, -5e-324, 1e-310, -1e-200]
            assert_same_bits(value(function, tiny), np.array(tiny))
    for function in ("sincos", "tan"):
        beyond = np.nextafter(LARGEST_ANGLE, inf)
        assert np.isnan(value(function, [beyond, -beyond, 1e300, inf, -inf])).all()
        assert np.isfinite(value(function, [LARGEST_ANGLE, -LARGEST_ANGLE])).all()
    largest = math.log(np.finfo(float).max)
    assert_same_bits(value("exp", [0.0, -0.0, inf, 1e300, 710.0]), np.array([1.0, 1.0, inf, inf, inf]))
    assert_same_bits(value("exp", [-inf, -1e300, -746.0, -745.0]), np.array([0.0, 0.0, 0.0, 5e-324]))
    assert np.isfinite(value("exp", [largest]))
    assert_same_bits(value("log", [1.0, 0.0, -0.0, inf]), np.array([0.0, -inf, -inf, inf]))
    assert np.isnan(value("log", [-5e-324, -1.0, -inf])).all()
    assert_same_bits(value("atan", [inf, -inf, 1e300]), np.array([1, -1, 1]) * (math.pi / 2.0))
    assert_same_bits(value("tanh", [inf, -inf, 30.0, 1e300]), np.array([1.0, -1.0, 1.0, 1.0]))


def test_sine_and_cosine_share_their_operations():
    assert len(recorded("sincos", True)[0]) <= 50
    assert len(recorded("sincos", False)[0]) <= 75


def test_parts_of_constants_have_exact_multiples():
    with mpmath.workprec(300):
        first, second, third, rest = map(mpmath.mpf, elementary._HALF_PI)
        assert abs(mpmath.pi / 2 - (first + second + third + rest)) < mpmath.mpf(2) ** -141
        high, low = map(mpmath.mpf, elementary._LOG2)
        assert abs(mpmath.log(2) - (high + low)) < mpmath.mpf(2) ** -84
    turns = math.ceil(LARGEST_ANGLE / (math.pi / 2.0))
    for part, largest in [(p, turns) for p in elementary._HALF_PI[:3]] + [(elementary._LOG2[0], 1077)]:
        numerator = part.as_integer_ratio()[0]
        significant = (numerator // (numerator & -numerator)).bit_length()
        assert significant + largest.bit_length() <= 53


@pytest.mark.parametrize(
    ("coefficients", "reach", "relative"),
    [
        ("_SIN", math.pi / 4.0, lambda r, p: (r - r**3 * p) / mpmath.sin(r) - 1),
        ("_COS", math.pi / 4.0, lambda r, p: (1 + r**2 * p) / mpmath.cos(r) - 1),
        ("_EXP", 0.75 * math.log(2.0), lambda r, p: (r + r**2 * p) / mpmath.expm1(r) - 1),
        ("_LOG", 3.0 - 2.0 * math.sqrt(2.0), lambda s, p: (2 * s + s**3 * p) / (2 * mpmath.atanh(s)) - 1),
        ("_ATAN", 0.55, lambda t, p: (t + t**3 * p) / mpmath.atan(t) - 1),
    ],
)
def test_polynomials_are_good_to_a_fraction_of_a_rounding(coefficients, reach, relative):
    table = [mpmath.mpf(c) for c in getattr(elementary, coefficients)]
    with mpmath.workprec(120):
        low = -reach / 3.0 if coefficients == "_EXP" else -reach
        for x in np.linspace(low, reach, 398):  # 0 is not among them
            r = mpmath.mpf(float(x))
            p = mpmath.polyval(table[::-1], r if coefficients == "_EXP" else r * r)
            assert abs(relative(r, p)) < 2.0**-56, (coefficients, x)


def test_exact_operations():
    trace = Trace()
    a, b = trace.inputs("a", "b")
    operations, results = trace.operations([trace.pow2(a), trace.exponent(b), trace.copysign(a, b)])
    powers = np.arange(-1022.0, 1024.0)[:2040]
    numbers = np.random.default_rng(3).uniform(1.0, 2.0, powers.size) * 2.0**powers
    numbers[::2] *= -1.0
    expected = np.array([2.0**powers, powers, np.copysign(powers, numbers)])
    for width in (1, 8):
        x = np.array([powers, numbers]).reshape(2, -1, width).transpose(1, 0, 2)
        values = lanes(operations, ["a", "b"], results, width)(x).transpose(1, 0, 2).reshape(3, -1)
        np.testing.assert_array_equal(values, expected)
    python = [evaluate_operations(operations, {"a": p, "b": x}) for p, x in zip(powers, numbers, strict=True)]
    np.testing.assert_array_equal([[known[r] for r in results] for known in python], expected.T)


@BOTH
def test_every_operation_on_vectors_and_on_floats(fused):
    def formula(a, b, xp):
        odd = (a < b) & ~(0.5 <= a) | (b <= a - 2.0)
        yield from (a * b + 1.0, a * b - a, b - a * a, a / b, -a, xp.where(odd, a, 3.0), xp.minimum(a, b))
        yield from (xp.sqrt(a), xp.abs(a), xp.floor(a), xp.floor(b), (a - a) / b, xp.sqrt(-xp.abs(b)))

    trace = Trace()
    operations, results = trace.operations(formula(*trace.inputs("a", "b"), trace), fused=fused)
    assert fused == any("a*b" in operation.op for operation in operations)
    rng = np.random.default_rng(4)
    values = rng.choice(
        [0.0, -0.0, 1.0, -2.5, 1e200, -1e300, 5e-324, math.inf, math.nan, *rng.normal(size=9)], (2, 400)
    )
    python = [evaluate_operations(operations, {"a": a, "b": b}) for a, b in values.T.tolist()]
    python = np.array([[known[r] for r in results] for known in python])
    for width in (1, 4, 8):
        x = values.reshape(2, -1, width).transpose(1, 0, 2)
        compiled = lanes(operations, ["a", "b"], results, width)(x)
        assert_same_bits(compiled.transpose(0, 2, 1).reshape(-1, len(results)), python)


def test_functions_of_the_library_on_vectors():
    trace = Trace()
    (x,) = trace.inputs("x")
    operations, results = trace.operations([trace.sin(x), trace.cos(x), trace.exp(x), trace.log(x)])
    values = np.random.default_rng(5).uniform(0.1, 5.0, 80)
    one, eight = (
        lanes(operations, ["x"], results, width)(values.reshape(-1, 1, width))
        .transpose(0, 2, 1)
        .reshape(-1, 4)
        for width in (1, 8)
    )
    assert_same_bits(one, eight)
    np.testing.assert_allclose(
        one.T, [f(values) for f in (np.sin, np.cos, np.exp, np.log)], rtol=1e-15, atol=1e-15
    )


def test_numbers_meet_vectors():
    trace = Trace()
    x, shared = trace.inputs("x", "shared")
    operations, (result,) = trace.operations([trace.where(x < shared, x * shared, shared + 1.0)])
    kind = ir.VectorType(ir.DoubleType(), 4)

    @intrinsic
    def body(typingctx, source, target, number):
        def codegen(context, builder, signature, args):
            x, y = (builder.inttoptr(a, kind.as_pointer()) for a in args[:2])
            values = {"x": builder.load(x, align=8), "shared": args[2]}
            assert emit(builder, operations, values) is values
            builder.store(values[result], y, align=8)
            return context.get_dummy_value()

        return types.void(types.intp, types.intp, types.float64), codegen

    @njit
    def call(x, y, number):
        body(x.ctypes.data, y.ctypes.data, number)

    x, y = np.array([1.0, 2.0, 3.0, 4.0]), np.empty(4)
    call(x, y, 2.5)
    np.testing.assert_array_equal(y, [2.5, 5.0, 3.5, 3.5])


@pytest.mark.parametrize(
    ("target", "features"),
    [
        ("x86_64-unknown-linux-gnu", ""),
        ("x86_64-pc-windows-msvc", "+avx2,+fma"),
        ("x86_64-unknown-linux-gnu", "+avx512f,+avx512dq,+fma"),
        ("aarch64-apple-darwin", "+neon"),
    ],
)
def test_code_for_every_processor_calls_nothing_and_fuses_only_what_is_recorded(target, features):
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    machine = binding.Target.from_triple(target).create_target_machine(features=features, opt=3)
    for fused in (False, True) if features else (False,):  # no features: a processor without fma
        module = ir.Module()
        module.triple = target
        pointer = ir.VectorType(ir.DoubleType(), 8).as_pointer()
        for function in EXACT:
            operations, results = recorded(function, fused)
            code = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer, pointer]), f"{function}_8")
            builder = ir.IRBuilder(code.append_basic_block())
            write(builder, operations, ["x"], results, *code.args)
            builder.ret_void()
        assembly = machine.emit_assembly(binding.parse_assembly(str(module)))
        assert not re.search(r"^\s+(callq?|bl|jmp|b)\s", assembly, re.MULTILINE)
        assert fused == bool(re.search(r"^\s+v?fn?m(la|ls|add|sub)", assembly, re.MULTILINE))


def test_trace_of_plain_arithmetic():
    trace = ElementaryTrace()
    (x,) = trace.inputs("x")
    functions = [
        trace.sin(x),
        trace.cos(x),
        trace.tan(x),
        trace.exp(x),
        trace.log(x),
        trace.atan(x),
        trace.tanh(x),
    ]
    operations, results = trace.operations(functions, fused=False)
    assert not {operation.op for operation in operations} & {"sin", "cos", "exp", "log"}
    known = evaluate_operations(operations, {"x": 0.7})
    exact = [f(0.7) for f in (math.sin, math.cos, math.tan, math.exp, math.log, math.atan, math.tanh)]
    np.testing.assert_allclose([known[result] for result in results], exact, rtol=5e-16)
    # Nothing is recorded for constants, and known zeros stay zero.
    assert (trace.sin(0.0), trace.exp(0.0), trace.log(0.0), trace.atan(1.0)) == (
        0.0,
        1.0,
        -math.inf,
        math.pi / 4,
    )
    operations, results = trace.operations([trace.sin(trace.zero()), trace.cos(trace.zero())])
    known = evaluate_operations(operations, {})
    assert [known.get(result, result) for result in results] == [0.0, 1.0]
