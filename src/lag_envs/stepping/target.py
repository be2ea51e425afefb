"""What the step of a series needs of numbers: arithmetic, series in numbered slots, loops.

`Target` lists the operations. `Plain` carries them out on floats; others print them
(`lag_envs.stepping.machine`, `lag_envs.stepping.script`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Protocol

from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.lowering import SeriesRecord
from lag_envs.stepping.tracing import MAGIC, Operation, evaluate_operations

#: How many products are summed side by side in one loop, where registers are no concern.
GROUP = 8


def _rough_log2(x: Any, xp: Any) -> Any:
    """Return the logarithm of x to the base 2, to 0.01."""
    n = xp.exponent(x)
    rest = x * xp.pow2(-n) - 1.0
    return n + rest * (1.3465 - 0.3465 * rest)


def _rough_exp2(x: Any, xp: Any) -> Any:
    """Return 2**x, to 0.3 %."""
    n = (x - 0.5 + MAGIC) - MAGIC
    rest = x - n
    return xp.pow2(n) * (1.0 + rest * (0.6565 + 0.3435 * rest))


_OTHERS = {"rough log2": _rough_log2, "rough exp2": _rough_exp2}


@cache
def elementary(name: str, fused: bool) -> tuple[tuple[Operation, ...], str]:
    """Return the operations of an elementary function of ``x``, and the name of their result."""
    trace = ElementaryTrace()
    (x,) = trace.inputs("x")
    value = _OTHERS[name](x, trace) if name in _OTHERS else getattr(trace, name)(x)
    operations, (result,) = trace.operations([value], fused=fused)
    assert isinstance(result, str)
    return tuple(operations), result


class Target(Protocol):
    """Numbers, slots and loops; see `Plain`, the simplest one. An index is a whole number.

    Attributes
    ----------
    group : int
        How many products are summed side by side in one loop. Results do not depend on it.

    Notes
    -----
    `aside` may move numbers to memory, and returns a function that brings them back.
    """

    group: int

    def number(self, value: float) -> Any: ...
    def add(self, a: Any, b: Any) -> Any: ...
    def sub(self, a: Any, b: Any) -> Any: ...
    def mul(self, a: Any, b: Any) -> Any: ...
    def div(self, a: Any, b: Any) -> Any: ...
    def fma(self, a: Any, b: Any, c: Any) -> Any: ...
    def neg(self, a: Any) -> Any: ...
    def abs(self, a: Any) -> Any: ...
    def sqrt(self, a: Any) -> Any: ...
    def less(self, a: Any, b: Any) -> Any: ...
    def both(self, a: Any, b: Any) -> Any: ...
    def select(self, condition: Any, a: Any, b: Any) -> Any: ...
    def either(self, a: Any, b: Any) -> Any: ...
    def all(self, condition: Any) -> Any: ...
    def negated(self, condition: Any) -> Any: ...
    def real(self, k: Any) -> Any: ...
    def reciprocal(self, k: Any) -> Any: ...
    def index(self, k: int) -> Any: ...
    def plus(self, k: Any, n: int) -> Any: ...
    def minus(self, a: Any, b: Any) -> Any: ...
    def half(self, k: Any) -> Any: ...
    def below(self, a: Any, b: Any) -> Any: ...
    def load(self, slot: int, k: Any) -> Any: ...
    def store(self, slot: int, k: Any, value: Any) -> None: ...
    def aside(self, values: Sequence) -> Callable[[], list]: ...
    def loop(self, first: Any, end: Any, carried: Sequence, body: Callable, step: int = 1) -> list: ...
    def repeat(self, times: int, carried: Sequence, body: Callable) -> list: ...
    def when(self, condition: Any, body: Callable, otherwise: Sequence) -> list: ...
    def elementary(self, name: str, x: Any) -> Any: ...
    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]: ...


class Plain:
    """The target that computes at once, on floats, with the bits of the unfused print."""

    group = GROUP

    def __init__(self, slots: int) -> None:
        self._memory: list[dict[int, float]] = [{} for _ in range(slots)]

    def number(self, value: float) -> float:
        return float(value)

    def add(self, a: Any, b: Any) -> Any:
        return a + b

    def sub(self, a: Any, b: Any) -> Any:
        return a - b

    def mul(self, a: Any, b: Any) -> Any:
        return a * b

    def div(self, a: Any, b: Any) -> Any:
        try:
            return a / b
        except ZeroDivisionError:
            return a * math.copysign(math.inf, b) if a == a and a != 0 else math.nan

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        return a * b + c

    def neg(self, a: Any) -> Any:
        return -a

    def abs(self, a: Any) -> Any:
        return abs(a)

    def sqrt(self, a: Any) -> Any:
        return math.sqrt(a) if a >= 0 else math.nan

    def less(self, a: Any, b: Any) -> bool:
        return bool(a < b)

    def both(self, a: bool, b: bool) -> bool:
        return a and b

    def either(self, a: bool, b: bool) -> bool:
        return a or b

    def all(self, condition: bool) -> bool:
        return condition

    def negated(self, condition: bool) -> bool:
        return not condition

    def select(self, condition: bool, a: Any, b: Any) -> Any:
        return a if condition else b

    def real(self, k: int) -> Any:
        return float(k)

    def reciprocal(self, k: int) -> Any:
        return 1.0 / k

    def index(self, k: int) -> int:
        return k

    def plus(self, k: int, n: int) -> int:
        return k + n

    def minus(self, a: int, b: int) -> int:
        return a - b

    def half(self, k: int) -> int:
        return k // 2

    def below(self, a: int, b: int) -> bool:
        return a < b

    def load(self, slot: int, k: int) -> Any:
        return self._memory[slot][k]

    def store(self, slot: int, k: int, value: Any) -> None:
        self._memory[slot][k] = value

    def aside(self, values: Sequence) -> Callable[[], list]:
        return lambda: list(values)

    def loop(self, first: int, end: int, carried: Sequence, body: Callable, step: int = 1) -> list:
        values = list(carried)
        for k in range(first, end, step):
            values = body(k, values)
        return values

    def repeat(self, times: int, carried: Sequence, body: Callable) -> list:
        values = list(carried)
        for count in range(times):
            going, values = body(count, values)
            if not going:
                break
        return values

    def when(self, condition: bool, body: Callable, otherwise: Sequence) -> list:
        return body() if condition else list(otherwise)

    def elementary(self, name: str, x: Any) -> Any:
        operations, result = elementary(name, fused=False)
        return evaluate_operations(operations, {"x": x})[result]

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]:
        return evaluate_operations(record.scalars, inputs)
