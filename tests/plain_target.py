"""Recorded operations, and the step of a series, carried out on Python's floats."""

import math
import types

import numpy as np

from lag_envs.stepping import compiling, driver
from lag_envs.stepping.machine import LaneLayout
from lag_envs.stepping.series import TOLERANCE, Series, StepProgress
from lag_envs.stepping.target import GROUP, elementary
from lag_envs.stepping.tracing import IEEE

#: The functions of formulas for floats.
FLOATS = types.SimpleNamespace(
    number=float,
    **{name: getattr(math, name) for name in ("sin", "cos", "sqrt", "exp", "log", "atan", "tanh")},
)


def evaluate_operations(operations, values):
    """Return inputs and results of recorded operations by name.

    Unfused operations give the bits of compiled code; so do fused ones, but slowly.
    """
    known = dict(values)
    for name, op, args in operations:
        known[name] = IEEE[op](*(known[a] if isinstance(a, str) else a for a in args))
    return known


class Plain:
    """The target that computes at once, on floats, with the bits of the unfused print."""

    group = GROUP

    def __init__(self, slots):
        self._memory = [{} for _ in range(slots)]

    def number(self, value):
        return float(value)

    def add(self, a, b):
        return a + b

    def sub(self, a, b):
        return a - b

    def mul(self, a, b):
        return a * b

    def div(self, a, b):
        return IEEE["/"](a, b)

    def fma(self, a, b, c):
        return a * b + c

    def neg(self, a):
        return -a

    def abs(self, a):
        return abs(a)

    def sqrt(self, a):
        return IEEE["sqrt"](a)

    def less(self, a, b):
        return bool(a < b)

    def both(self, a, b):
        return a and b

    def either(self, a, b):
        return a or b

    def all(self, condition):
        return condition

    def negated(self, condition):
        return not condition

    def select(self, condition, a, b):
        return a if condition else b

    def real(self, k):
        return float(k)

    def reciprocal(self, k):
        return 1.0 / k

    def index(self, k):
        return k

    def plus(self, k, n):
        return k + n

    def minus(self, a, b):
        return a - b

    def half(self, k):
        return k // 2

    def below(self, a, b):
        return a < b

    def load(self, slot, k):
        return self._memory[slot][k]

    def store(self, slot, k, value):
        self._memory[slot][k] = value

    def aside(self, values):
        return lambda: list(values)

    def loop(self, first, end, carried, body, step=1):
        values = list(carried)
        for k in range(first, end, step):
            values = body(k, values)
        return values

    def repeat(self, times, carried, body):
        values = list(carried)
        for count in range(times):
            going, values = body(count, values)
            if not going:
                break
        return values

    def when(self, condition, body, otherwise):
        return body() if condition else list(otherwise)

    def elementary(self, name, x):
        operations, result = elementary(name, fused=False)
        return evaluate_operations(operations, {"x": x})[result]

    def scalars(self, record, inputs):
        return evaluate_operations(record.scalars, inputs)


def in_python(name, source, *helpers, inner=False, **constants):
    """Replace `compile_function`: run the source in Python, and the recorded operations too."""

    def block(operations, inputs, outputs):
        def run(*values):
            known = evaluate_operations(operations, dict(zip(inputs, values, strict=True)))
            return tuple(known[name] for name in outputs)

        return run

    def read_rows(array, first, stride, rows):
        return tuple(array[first + row * stride] for row in rows)

    def write_rows(array, first, stride, rows, numbers):
        for row, number in zip(rows, numbers, strict=True):
            array[first + row * stride] = number

    numpy = types.SimpleNamespace(zeros=lambda n: [0.0] * n, int64=int)
    scope = {"np": numpy, "read_rows": read_rows, "write_rows": write_rows}
    scope |= constants | {helper.__name__: helper for helper in helpers}
    scope |= {name: block(*parts) for name, parts in compiling._blocks.items()}
    exec(source, scope)
    return scope[name]


def advance_in_python(record, tolerance=TOLERANCE, fused=False, fixed_order=None, bounds=False):
    """Replace `compile_advance`: the driver's own code on `Plain`."""
    series, layout, n = Series(record), LaneLayout(record), record.size

    def attempt(rows, at, order, tolerance):
        given = {name: rows[row] for name, row in layout.inputs.items()}
        q, v = (list(rows[first : first + n]) for first in (layout.q, layout.v))
        lane = StepProgress(q, v, *rows[layout.status : layout.span])
        dt = rows[layout.span]
        after, left_out = series.substep(Plain(series.slots), given, lane, dt, order, tolerance)
        rows[layout.q : layout.span] = [*after.q, *after.v, after.attempts, after.left, after.wish]
        if bounds:
            for row, bound in enumerate(left_out, layout.bounds):
                rows[row] += bound
        return not after.left > 0.0

    names = driver._numbers(record, tolerance) | {"attempt": attempt, "np": np}
    return types.FunctionType(driver._advance.__code__, names, "advance_lane")
