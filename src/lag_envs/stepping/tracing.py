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
from typing import Any

_CODE = {
    "+": "({} + {})",
    "-": "({} - {})",
    "*": "({} * {})",
    "/": "({} / {})",
    "neg": "(-{})",
    "<": "({} < {})",
    "<=": "({} <= {})",
    "&": "({} & {})",
    "|": "({} | {})",
    "~": "(not {})",
    "where": "select({}, {}, {})",
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

_LONGEST = 160  # characters of an expression that is still moved into another


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
    ['out = fma(a, b, b)']
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

    def code(self, outputs: dict[str, Any]) -> list[str]:
        """Return the lines that compute the outputs, unused operations left out."""
        uses: dict[str, int] = {}

        def visit(value: Any) -> None:
            stack = [value]
            while stack:
                v = stack.pop()
                if isinstance(v, Number):
                    uses[v.name] = uses.get(v.name, 0) + 1
                    if uses[v.name] == 1:
                        stack.extend(v.args)

        for value in outputs.values():
            visit(value)
        text: dict[str, str] = {}

        def show(value: Any) -> str:
            return text.get(value.name, value.name) if isinstance(value, Number) else _literal(value)

        lines = []
        for node in self._nodes:
            if node.name in uses:
                code = _print(node, uses, show)
                # What is used once moves to where it is used: fewer names are quicker to compile.
                if uses[node.name] == 1 and len(code) < _LONGEST:
                    text[node.name] = code
                else:
                    lines.append(f"{node.name} = {_bare(code)}")
        return lines + [f"{name} = {_bare(show(value))}" for name, value in outputs.items()]

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


def _print(node: Number, uses: dict[str, int], show: Callable[[Any], str]) -> str:
    """Return an operation as code; a sum swallows a product that nobody else uses."""
    op, (a, b) = str(node.op), (*node.args, None)[:2]
    if op in ("+", "-"):
        sign = "" if op == "+" else "-"
        for product, other, template in (
            (a, b, "fma({}, {}, " + sign + "{})"),
            (b, a, "fma(" + sign + "{}, {}, {})"),
        ):
            if isinstance(product, Number) and product.op == "*" and uses[product.name] == 1:
                return template.format(*map(show, product.args), show(other))
    return _CODE[op].format(*map(show, node.args))


def _bare(code: str) -> str:
    """Return code without the parentheses around all of it."""
    return code[1:-1] if code.startswith("(") else code


def _literal(value: float | bool) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return {"inf": "math.inf", "-inf": "-math.inf"}.get(str(value), "math.nan")
    return f"({value!r})" if value < 0 else repr(value)
