"""Run a formula once on recording numbers and turn it into straight-line code.

Scenes, tasks and the Taylor recurrences are written as short loops on "numbers": floats, NumPy
arrays, torch tensors and SymPy symbols all will do. For speed the same functions are run once on
`Number` objects, which record every operation; the record is then printed as straight-line Python
for Numba. Three things happen on the way:

* An operation on constants is done at once, and a term multiplied by the literal ``0.0`` is dropped.
  This is the one place where it is decided what a scene pays for: a coefficient that a scene
  does not have is returned as ``0.0`` and leaves no trace in the compiled code.
* Equal operations are recorded once.
* ``a * b + c`` with a product that nobody else uses becomes one fused multiply-add. The fusion is thus
  chosen here and not by the compiler, so that one environment and ten thousand give the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

_CODE = {
    "a*b+c": "{} * {} + {}",
    "a*b-c": "{} * {} - {}",
    "c-a*b": "{2} - {0} * {1}",
    "+": "{} + {}",
    "-": "{} - {}",
    "*": "{} * {}",
    "/": "{} / {}",
    "neg": "-{}",
    "<": "{} < {}",
    "<=": "{} <= {}",
    "&": "{} & {}",
    "|": "{} | {}",
    "~": "not {}",
    "where": "{1} if {0} else {2}",
    "sqrt": "math.sqrt({})",
    "exp": "exp({})",
    "log": "math.log({})",
    "sin": "math.sin({})",
    "cos": "math.cos({})",
    "abs": "abs({})",
    "floor": "np.floor({})",
}
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
    "abs": abs,
    "floor": math.floor,
}

#: What a sum becomes when its first or its second term is a product that nobody else uses.
FUSED = {"+": ("a*b+c", "a*b+c"), "-": ("a*b-c", "c-a*b")}
BOOLEAN = frozenset({"<", "<=", "&", "|", "~"})


class Operation(NamedTuple):
    """One step of straight-line code; arguments are names of earlier results, or constants."""

    name: str
    op: str
    args: tuple[str | float | bool, ...]


class Number:
    """A value that records the arithmetic done on it."""

    __slots__ = ("args", "name", "op", "trace")

    def __init__(self, trace: Trace, name: str, op: str | None = None, args: tuple = ()) -> None:
        self.trace, self.name, self.op, self.args = trace, name, op, args

    def __add__(self, other: Any) -> Any:
        return self.trace.record("+", self, other)

    def __radd__(self, other: Any) -> Any:
        return self.trace.record("+", other, self)

    def __sub__(self, other: Any) -> Any:
        return self.trace.record("-", self, other)

    def __rsub__(self, other: Any) -> Any:
        return self.trace.record("-", other, self)

    def __mul__(self, other: Any) -> Any:
        return self.trace.record("*", self, other)

    def __rmul__(self, other: Any) -> Any:
        return self.trace.record("*", other, self)

    def __truediv__(self, other: Any) -> Any:
        return self.trace.record("/", self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return self.trace.record("/", other, self)

    def __neg__(self) -> Any:
        return self.trace.record("neg", self)

    def __lt__(self, other: Any) -> Any:
        return self.trace.record("<", self, other)

    def __gt__(self, other: Any) -> Any:
        return self.trace.record("<", other, self)

    def __le__(self, other: Any) -> Any:
        return self.trace.record("<=", self, other)

    def __ge__(self, other: Any) -> Any:
        return self.trace.record("<=", other, self)

    def __and__(self, other: Any) -> Any:
        return self.trace.record("&", self, other)

    def __rand__(self, other: Any) -> Any:
        return self.trace.record("&", other, self)

    def __or__(self, other: Any) -> Any:
        return self.trace.record("|", self, other)

    def __ror__(self, other: Any) -> Any:
        return self.trace.record("|", other, self)

    def __invert__(self) -> Any:
        return self.trace.record("~", self)

    def __bool__(self) -> bool:
        raise TypeError(
            "a formula that is compiled cannot branch on its numbers with if, and, or, min or max; "
            "use xp.where, &, |, xp.minimum and xp.maximum"
        )


class Trace:
    """One recording: inputs, operations, and the code they make.

    A trace is also the ``xp`` namespace that traced formulas take their functions from, so that
    ``xp.where`` means `numpy.where` on arrays and a recorded selection here.

    Examples
    --------
    >>> trace = Trace()
    >>> a, b = trace.inputs("a", "b")
    >>> trace.code({"out": a * b + 0.0 * a + b})
    ['t1 = a * b + b', 'out = t1']
    """

    def __init__(self, prefix: str = "t") -> None:
        self._prefix = prefix
        self._nodes: list[Number] = []
        self._known: dict[tuple, Number] = {}

    def inputs(self, *names: str) -> list[Number]:
        """Return one `Number` per name."""
        return [Number(self, name) for name in names]

    def record(self, op: str, *args: Any) -> Any:
        """Record an operation, or do it at once where it needs no recording."""
        args = tuple(a if isinstance(a, Number | bool) else float(a) for a in args)
        if not any(isinstance(a, Number) for a in args):
            return _FLOAT[op](*args)
        simple = _simplify(op, args)
        if simple is not None:
            return simple
        key = (op, *(a.name if isinstance(a, Number) else (type(a), str(a)) for a in args))
        if key not in self._known:
            node = Number(self, f"{self._prefix}{len(self._nodes)}", op, args)
            self._nodes.append(node)
            self._known[key] = node
        return self._known[key]

    def operations(self, outputs: Iterable[Any]) -> list[Operation]:
        """Return what computes the outputs, in order: unused operations left out, products fused into sums."""
        uses: dict[str, int] = {}
        stack = list(outputs)
        while stack:
            value = stack.pop()
            if isinstance(value, Number):
                uses[value.name] = uses.get(value.name, 0) + 1
                if uses[value.name] == 1:
                    stack.extend(value.args)
        fused: dict[str, Operation] = {}
        swallowed: set[str] = set()
        for node in self._nodes:
            if node.name in uses and node.op in FUSED:
                first, second = node.args
                for op, product, other in zip(FUSED[node.op], (first, second), (second, first), strict=True):
                    if isinstance(product, Number) and product.op == "*" and uses[product.name] == 1:
                        fused[node.name] = Operation(node.name, op, (*map(_name, product.args), _name(other)))
                        swallowed.add(product.name)
                        break
        return [
            fused.get(node.name) or Operation(node.name, str(node.op), tuple(map(_name, node.args)))
            for node in self._nodes
            if node.name in uses and node.name not in swallowed
        ]

    def code(self, outputs: dict[str, Any]) -> list[str]:
        """Return lines of Python that compute the outputs, for people to read."""
        lines = [f"{name} = {_CODE[op].format(*args)}" for name, op, args in self.operations(outputs.values())]
        return lines + [f"{name} = {_name(value)}" for name, value in outputs.items()]

    # The functions that a formula may call, named as in NumPy.

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
        """Return the largest whole number that is not above."""
        return self.record("floor", a)


def balanced_sum(products: Iterable[tuple[Any, Any]]) -> Any:
    """Sum products, given in the order in which their factors become known.

    All but the last two run in two chains side by side, which a processor can finish while it waits for the
    rest.

    Examples
    --------
    >>> balanced_sum([(1.0, 2.0), (3.0, 4.0), (5.0, 6.0)])
    44.0
    """
    products = list(products)
    chains: list[Any] = []
    for i, (a, b) in enumerate(products[:-2]):
        if i < 2:
            chains.append(a * b)
        else:
            chains[i % 2] = chains[i % 2] + a * b
    total = sum(chains[1:], *chains[:1]) if chains else None
    for a, b in products[-2:]:
        total = a * b if total is None else total + a * b
    return total


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
    """Return the operation's value where it is trivial, else None."""
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


def _name(value: Any) -> str | float | bool:
    """Return a number's name, or the constant."""
    return value.name if isinstance(value, Number) else value
