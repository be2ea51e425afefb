"""Run a formula once on recording numbers and turn it into straight-line code.

Scenes, tasks and the Taylor recurrences are written as short loops on "numbers": floats, NumPy arrays, torch
tensors or SymPy symbols. For speed the same functions are run once on `TracedNumber` objects, which record
every operation; the record then becomes one straight-line compiled function. Three things happen on the way:

* Equal operations are recorded once, and operations on constants are evaluated at once.
* ``a * b + c`` becomes one fused multiply-add if the product is used nowhere else. The fusion is thus
  chosen here and not by the compiler, so that one environment and ten thousand give the same bits.
* A zero term is dropped. This alone decides which terms a scene pays for: a coefficient that a scene does not
have is returned as ``0.0``, a parameter that is zero is known to be zero (`Trace.zero`), and neither leaves
any compiled code.
"""

from __future__ import annotations

import math
import numbers
import struct
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, NoReturn

from lag_envs.mechanics.algebra import FormulaError

#: Adding this to a number below 2^51 and subtracting it again gives the nearest integer, ties to even.
MAGIC = 1.5 * 2.0**52


def _bits(value: float) -> int:
    return int(struct.unpack("<Q", struct.pack("<d", value))[0])


def _pow2(n: float) -> float:
    # As in machine code: with 2^52 and 2^51 added, the number's last bits hold n + 1023.
    bits = _bits(n + (MAGIC + 1023.0)) << 52
    return float(struct.unpack("<d", struct.pack("<Q", bits % 2**64))[0])


_FLOAT: dict[str, Callable] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "neg": lambda a: -a,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    "&": lambda a, b: a and b,
    "|": lambda a, b: a or b,
    "~": lambda a: not a,
    "where": lambda c, a, b: a if c else b,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "log": math.log,
    "sin": math.sin,
    "cos": math.cos,
    "atan": math.atan,
    "tanh": math.tanh,
    "abs": abs,
    "floor": math.floor,
    "pow2": _pow2,
    "exponent": lambda a: (_bits(a) >> 52 & 0x7FF) - 1023.0,
    "copysign": math.copysign,
}


def _divide(a: Any, b: Any) -> Any:
    if b == 0.0:
        return math.nan if a == 0.0 or a != a else math.copysign(math.inf, a) * math.copysign(1.0, b)
    return a / b


def _fma(a: Any, b: Any, c: Any) -> Any:
    try:
        exact = Fraction(a) * Fraction(b) + Fraction(c)
    except (OverflowError, ValueError):  # infinite, not a number
        return c if math.isfinite(a) and math.isfinite(b) else a * b + c
    try:
        return float(exact) if exact else a * b + c
    except OverflowError:
        return math.inf if exact > 0 else -math.inf


#: Every operation on Python's floats, with the bits of machine code (except for library functions).
IEEE: dict[str, Callable] = _FLOAT | {
    "/": _divide,
    "sqrt": lambda a: math.nan if a < 0.0 else math.sqrt(a),
    "floor": lambda a: math.copysign(math.floor(a), a) if math.isfinite(a) else a,
    "a*b+c": _fma,
    "a*b-c": lambda a, b, c: _fma(a, b, -c),
    "c-a*b": lambda a, b, c: _fma(-a, b, c),
}

#: The operation that a sum becomes if its first or second term is a product that is used nowhere else.
FUSED = {"+": ("a*b+c", "a*b+c"), "-": ("a*b-c", "c-a*b")}
BOOLEAN = frozenset({"<", "<=", "&", "|", "~"})
#: Operations that take truth values.
LOGIC = frozenset({"&", "|", "~"})


#: The name of an earlier result, or a constant.
Value = str | float | bool


class Operation(NamedTuple):
    """One step of straight-line code."""

    name: str
    op: str
    args: tuple[Value, ...]


def _operator(op: str) -> tuple[Any, Any]:
    """Return the methods that record an operation: with the number as first and as second operand."""
    return lambda a, b: a.trace.record(op, a, b), lambda a, b: a.trace.record(op, b, a)


class TracedNumber:
    """A value that records the arithmetic done on it."""

    __slots__ = ("args", "name", "op", "trace")

    def __init__(self, trace: Trace, name: str, op: str | None = None, args: tuple = ()) -> None:
        self.trace, self.name, self.op, self.args = trace, name, op, args

    __add__, __radd__ = _operator("+")
    __sub__, __rsub__ = _operator("-")
    __mul__, __rmul__ = _operator("*")
    __truediv__, __rtruediv__ = _operator("/")
    __lt__, __gt__ = _operator("<")
    __le__, __ge__ = _operator("<=")
    __and__, __rand__ = _operator("&")
    __or__, __ror__ = _operator("|")

    def __neg__(self) -> Any:
        return self.trace.record("neg", self)

    def __pos__(self) -> Any:
        return self

    def __abs__(self) -> Any:
        return self.trace.record("abs", self)

    def __pow__(self, exponent: Any) -> Any:
        whole = not isinstance(exponent, bool) and isinstance(exponent, numbers.Real)
        if not whole or float(exponent) != int(float(exponent)):
            raise FormulaError(
                f"the power {exponent!r} is not a whole number; write xp.sqrt(x) or xp.exp(p * xp.log(x))"
            )
        power: Any = 1.0
        for bit in bin(abs(int(float(exponent))))[2:]:
            power = power * power
            power = power * self if bit == "1" else power
        return power if float(exponent) >= 0 else 1.0 / power

    def __invert__(self) -> Any:
        return self.trace.record("~", self)

    def __float__(self) -> float:
        raise FormulaError(
            "a function of math, or float(), is applied to a recorded number: write xp.exp for math.exp"
        )

    def __eq__(self, other: object) -> NoReturn:
        raise FormulaError(
            "a recorded number is compared by ==, != or in, whose result depends on rounding; use < and <=, "
            "or branch on a field that is not a parameter"
        )

    __ne__ = __eq__

    def __hash__(self) -> NoReturn:
        raise FormulaError(
            "a recorded number is looked up in a table, set or cache; use xp.where, or look up a field that "
            "is not a parameter"
        )

    def __str__(self) -> str:
        raise FormulaError("a formula uses the text of a recorded number, which has no fixed value")

    def __mod__(self, other: Any) -> NoReturn:
        raise FormulaError(
            "a compiled formula has no %, // or divmod(); for a % b write a - b * xp.floor(a / b)"
        )

    __rmod__ = __floordiv__ = __rfloordiv__ = __divmod__ = __rdivmod__ = __mod__

    def __round__(self, digits: Any = None) -> NoReturn:
        raise FormulaError("a compiled formula has no round(); write xp.floor(x + 0.5)")

    def __int__(self) -> NoReturn:
        raise FormulaError("a compiled formula has no int(), floor() or ceil() of Python; write xp.floor(x)")

    __floor__ = __ceil__ = __trunc__ = __index__ = __int__

    def __bool__(self) -> bool:
        raise FormulaError(
            "a compiled formula cannot branch on its numbers with if, and, or, min or max; "
            "use xp.where, &, |, xp.minimum and xp.maximum"
        )


def is_truth(value: Any) -> bool:
    """Return whether a recorded value is a truth value rather than a number."""
    if not isinstance(value, TracedNumber):
        return isinstance(value, bool)
    return value.op in BOOLEAN or (value.op == "where" and is_truth(value.args[1]))


class Trace:
    """A recording: inputs, operations, and the code made from them.

    A trace is also the ``xp`` namespace of traced formulas: ``xp.where`` means `numpy.where` on arrays and a
    recorded selection here.

    Parameters
    ----------
    numeric : bool, default False
        Whether all inputs are numbers; otherwise some may be truth values.

    Examples
    --------
    >>> trace = Trace()
    >>> a, b = trace.inputs("a", "b")
    >>> operations, results = trace.operations([a * b + 0.0 * a + b])
    >>> operations
    [Operation(name='t1', op='a*b+c', args=('a', 'b', 'b'))]
    """

    def __init__(self, numeric: bool = False) -> None:
        self._numeric = numeric
        self._nodes: list[TracedNumber] = []
        self._known: dict[tuple, TracedNumber] = {}
        self._zeros: set[str] = set()

    def inputs(self, *names: str) -> list[TracedNumber]:
        """Return one `TracedNumber` per name."""
        return [TracedNumber(self, name) for name in names]

    def record(self, op: str, *args: Any) -> Any:
        """Record an operation, or evaluate it if it needs no recording."""
        args = tuple(a if isinstance(a, TracedNumber | bool) else float(a) for a in args)
        given = [a for a in args if isinstance(a, TracedNumber)]
        if not given:
            return _FLOAT[op](*args)
        if any(a.trace is not self for a in given):
            raise FormulaError(
                "a formula uses a number from an earlier call; formulas must not keep numbers in a list, a "
                "dict or an attribute: the state before the step is `before`, and nothing else is remembered"
            )
        args = self._as_numbers(op, args)
        simple = _simplify(op, args)
        if simple is not None:
            return simple
        key = (op, *(a.name if isinstance(a, TracedNumber) else (type(a), str(a)) for a in args))
        if key not in self._known:
            node = TracedNumber(self, f"t{len(self._nodes)}", op, args)
            self._nodes.append(node)
            self._known[key] = node
        return self._known[key]

    def _as_numbers(self, op: str, args: tuple) -> tuple:
        """Return the arguments of an operation, with truth values as 1 or 0 where numbers are needed."""
        conditions = args if op in LOGIC else args[: op == "where"]
        if not all(is_truth(c) or self._may_be_truth(c) for c in conditions):
            raise FormulaError(
                "&, |, ~ and the condition of xp.where take comparisons, not numbers; put each comparison in "
                "parentheses, as in (x > 0.0) | (y > 1.0)"
            )
        others = args[len(conditions) :]
        truths = [is_truth(a) for a in others]
        if not any(truths) or (op == "where" and all(truths)):
            return args
        if all(truths):
            raise TypeError(
                f"{op} is applied to comparisons alone; join comparisons with | and &, or turn them into "
                "numbers with xp.where(condition, 1.0, 0.0)"
            )
        counted = (self.where(a, 1.0, 0.0) if t else a for a, t in zip(others, truths, strict=True))
        return *conditions, *counted

    def _may_be_truth(self, value: Any) -> bool:
        return isinstance(value, TracedNumber) and value.op is None and not self._numeric

    def zero(self) -> TracedNumber:
        """Return a number known to be zero.

        Its terms are dropped, like those of a literal 0.0, but only after products have been fused. Therefore
        the other terms round as they would if the number were not zero, and in one batch, environments with
        and without, say, damping get the same bits.
        """
        number = TracedNumber(self, f"zero{len(self._zeros)}")
        self._zeros.add(number.name)
        return number

    def operations(
        self, outputs: Iterable[Any], zeros: Iterable[str] = (), *, fused: bool = True
    ) -> tuple[list[Operation], list[Value]]:
        """Return the operations that compute the outputs, and the outputs as names or constants.

        The operations are in order, without those that no output needs. Inputs named in `zeros` are known to
        be zero, like the numbers that `zero` returns. With ``fused=False`` no product is fused with a sum:
        then all operations round alike on every machine and in every language.
        """
        outputs = list(outputs)
        results = [_name(value) for value in outputs]
        operations = _drop_zeros(self._collected(outputs, fused), results, self._zeros | set(zeros))
        needed = set(results)
        kept = []
        for operation in reversed(operations):
            if operation.name in needed:
                kept.append(operation)
                needed.update(operation.args)
        return kept[::-1], results

    def _collected(self, outputs: list, fuse: bool) -> list[Operation]:
        uses: dict[str, int] = {}
        stack = list(outputs)
        while stack:
            value = stack.pop()
            if isinstance(value, TracedNumber):
                uses[value.name] = uses.get(value.name, 0) + 1
                if uses[value.name] == 1:
                    stack.extend(value.args)
        fused: dict[str, Operation] = {}
        swallowed: set[str] = set()
        for node in self._nodes:
            if fuse and node.name in uses and node.op in FUSED:
                first, second = node.args
                for op, product, other in zip(FUSED[node.op], (first, second), (second, first), strict=True):
                    if isinstance(product, TracedNumber) and product.op == "*" and uses[product.name] == 1:
                        fused[node.name] = Operation(node.name, op, (*map(_name, product.args), _name(other)))
                        swallowed.add(product.name)
                        break
        return [
            fused.get(node.name) or Operation(node.name, str(node.op), tuple(map(_name, node.args)))
            for node in self._nodes
            if node.name in uses and node.name not in swallowed
        ]

    # The functions that a formula may call, named as in NumPy.

    pi = math.pi

    def where(self, condition: Any, a: Any, b: Any) -> Any:
        """Select elementwise."""
        return self.record("where", condition, a, b)

    def minimum(self, a: Any, b: Any) -> Any:
        """Return the smaller one."""
        return self.record("where", self.record("<", b, a), b, a)

    def maximum(self, a: Any, b: Any) -> Any:
        """Return the larger one."""
        return self.record("where", self.record("<", a, b), b, a)

    def abs(self, a: Any) -> Any:
        """Return the absolute value."""
        return self.record("abs", a)

    def sqrt(self, a: Any) -> Any:
        """Return the square root."""
        return self.record("sqrt", a)

    def exp(self, a: Any) -> Any:
        """Return the exponential."""
        return self.record("exp", a)

    def log(self, a: Any) -> Any:
        """Return the natural logarithm."""
        return self.record("log", a)

    def sin(self, a: Any) -> Any:
        """Return the sine."""
        return self.record("sin", a)

    def cos(self, a: Any) -> Any:
        """Return the cosine."""
        return self.record("cos", a)

    def floor(self, a: Any) -> Any:
        """Return the largest integer not above a number."""
        return self.record("floor", a)

    # Building blocks of elementary functions, besides arithmetic; each is exact.

    def pow2(self, n: Any) -> Any:
        """Return 2**n for an integer n in [-1022, 1023]."""
        return self.record("pow2", n)

    def exponent(self, a: Any) -> Any:
        """Return the integer n with 2**n <= abs(a) < 2**(n + 1), for normal numbers a."""
        return self.record("exponent", a)

    def copysign(self, a: Any, sign: Any) -> Any:
        """Return a with the sign of another number, which may be a signed zero."""
        return self.record("copysign", a, sign)


def sum_of_products(factors: Iterable[tuple[Any, Any]]) -> Any:
    """Sum products one after the other, all but the first by fused operations.

    Examples
    --------
    >>> sum_of_products([(1.0, 2.0), (3.0, 4.0), (5.0, 6.0)])
    44.0
    """
    (a, b), *rest = factors
    total = a * b
    for a, b in rest:
        total = total + a * b
    return total


def pairwise_sum(terms: Sequence[Any]) -> Any:
    """Sum neighbours, then neighbouring sums, and so on, which makes a short chain with few roundings.

    Examples
    --------
    >>> pairwise_sum([1.0, 2.0, 3.0])
    6.0
    """
    while len(terms) > 1:
        terms = [a + b for a, b in zip(terms[::2], terms[1::2], strict=False)] + list(
            terms[len(terms) // 2 * 2 :]
        )
    return terms[0]


def polynomial(coefficients: Sequence[float], x: Any) -> Any:
    """Evaluate ``c[0] + c[1] x + c[2] x² + ...`` by Horner's rule.

    Examples
    --------
    >>> polynomial([1.0, 2.0, 3.0], 10.0)
    321.0
    """
    value = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        value = value * x + c
    return value


def clip(value: Any, low: Any, high: Any, xp: Any) -> Any:
    """Return the nearest value in [low, high]."""
    return xp.minimum(xp.maximum(value, low), high)


def _is(value: Any, number: float) -> bool:
    return type(value) is float and value == number


def _simplify(op: str, args: tuple) -> Any:
    """Return an operation's value if it is trivial, else None."""
    if op in ("+", "-") and _is(args[1], 0.0):
        return args[0]
    if op == "+" and _is(args[0], 0.0):
        return args[1]
    if op == "-" and _is(args[0], 0.0):
        return -args[1]
    if op == "*" and (_is(args[0], 0.0) or _is(args[1], 0.0)):
        return 0.0
    if op == "*" and _is(args[0], 1.0):
        return args[1]
    if op in ("*", "/") and _is(args[1], 1.0):
        return args[0]
    if op == "/" and _is(args[0], 0.0):
        return 0.0
    if op == "&" and type(args[0]) is bool:
        return args[1] if args[0] else False
    if op == "&" and type(args[1]) is bool:
        return args[0] if args[1] else False
    if op == "|" and type(args[0]) is bool:
        return True if args[0] else args[1]
    if op == "|" and type(args[1]) is bool:
        return True if args[1] else args[0]
    if op == "where" and type(args[0]) is bool:
        return args[1] if args[0] else args[2]
    return None


def _drop_zeros(operations: list[Operation], results: list[Value], zeros: set[str]) -> list[Operation]:
    """Return the operations without zero terms; rename the results accordingly."""
    now: dict[Value, Value] = dict.fromkeys(zeros, 0.0)
    kept = []
    for name, op, names in operations:
        args = tuple(now.get(arg, arg) for arg in names)
        zero = [_is(arg, 0.0) for arg in args]
        value: Value = name
        if op in ("neg", "abs", "sqrt", "/", "sin") and zero[0]:
            value = 0.0
        elif op == "*" and any(zero):
            value = 0.0
        elif op == "+" and any(zero):
            value = args[zero[0]]
        elif op == "-" and any(zero):
            op, args, value = ("neg", args[1:], name) if zero[0] else (op, args, args[0])
        elif op in ("a*b+c", "c-a*b") and any(zero[:2]):
            value = args[2]
        elif op == "a*b-c" and any(zero[:2]):
            op, args, value = ("neg", args[2:], name) if not zero[2] else (op, args, 0.0)
        elif op in ("a*b+c", "a*b-c") and zero[2]:
            op, args = "*", args[:2]
        elif op == "<" and args[0] == args[1]:
            value = False
        elif op == "where" and isinstance(args[0], bool):
            value = args[1] if args[0] else args[2]
        if value == name:
            kept.append(Operation(name, op, args))
        else:
            now[name] = value
    results[:] = [now.get(result, result) for result in results]
    return kept


def _name(value: Any) -> Value:
    """Return a number's name, or the constant."""
    return value.name if isinstance(value, TracedNumber) else value
