"""Recorded operations, and the step of a series, carried out on Python's floats."""

from lag_envs.stepping.target import GROUP, elementary
from lag_envs.stepping.tracing import IEEE


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
