"""Prints recorded formulas and the series' step as source text, in Python or in JavaScript.

What is printed is unfused: + - * / √, comparisons, and a few exact operations on bits. So the text of either
language gives the same bits, on any machine. `OPERATIONS` has a line per operation and a column per language;
loops, over the order of the series among them, are printed as loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from lag_envs.stepping.driver import LARGEST_COUNT, SMALLEST_PART
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.lowering import SeriesRecord
from lag_envs.stepping.series import LARGEST_ORDER, TOLERANCE, Lane, Series, elementary
from lag_envs.stepping.tracing import IEEE, MAGIC, Number, Operation, Value

#: Every operation of a recording, in Python and in JavaScript. Where Python raises an error, C does not.
OPERATIONS: Mapping[str, tuple[str, str]] = {
    "+": ("{} + {}", "{} + {}"),
    "-": ("{} - {}", "{} - {}"),
    "*": ("{} * {}", "{} * {}"),
    "/": ("{0} / {1} if {1} else divide({0}, {1})", "{} / {}"),
    "neg": ("-{}", "-{}"),
    "<": ("{} < {}", "{} < {}"),
    "<=": ("{} <= {}", "{} <= {}"),
    "&": ("{} and {}", "{} && {}"),
    "|": ("{} or {}", "{} || {}"),
    "~": ("not {}", "!{}"),
    "where": ("{1} if {0} else {2}", "{} ? {} : {}"),
    "sqrt": ("sqrt({0}) if {0} >= 0.0 else nan", "Math.sqrt({})"),
    "abs": ("abs({})", "Math.abs({})"),
    "floor": ("floor({})", "Math.floor({})"),
    "pow2": ("pow2({})", "pow2({})"),
    "exponent": ("exponent({})", "exponent({})"),
    "copysign": ("copysign({}, {})", "copysign({}, {})"),
    "real": ("float({})", "{}"),
    "read": ("{}[{}]", "{}[{}]"),
}

#: Statements in both languages.
STATEMENTS: Mapping[str, tuple[str, str]] = {
    "let": ("{} = {}", "const {} = {};"),
    "vary": ("{} = {}", "let {} = {};"),
    "set": ("{} = {}", "{} = {};"),
    "write": ("{}[{}] = {}", "{}[{}] = {};"),
    "if": ("if {}:", "if ({}) {{"),
    "for": ("for {0} in range({1}, {2}, {3}):", "for (let {0} = {1}; {0} < {2}; {0} += {3}) {{"),
    "leave": ("if not {}: break", "if (!{}) break;"),
    "function": ("def {}({}):", "function {}({}) {{"),
    "return": ("return {}", "return {};"),
    "nothing": ("pass", ""),
    "end": ("", "}}"),
}


class Language(NamedTuple):
    """A language of scripts.

    Attributes
    ----------
    column : int
        Its column in `OPERATIONS` and `STATEMENTS`.
    words : mapping
        Its words for truth values and for numbers that are none.
    memory : str
        What makes an array of so many numbers.
    head : str
        What the operations on bits are made of.
    """

    column: int
    words: Mapping[str, str]
    memory: str
    head: str


PYTHON = Language(
    0, {"True": "True", "False": "False", "inf": "inf", "-inf": "(-inf)", "nan": "nan"}, "[0.0] * {}", ""
)
JAVASCRIPT = Language(
    1,
    {"True": "true", "False": "false", "inf": "Infinity", "-inf": "(-Infinity)", "nan": "NaN"},
    "new Float64Array({})",
    f"""const real = new Float64Array(1);
const bits = new Uint32Array(real.buffer);
function pow2(n) {{
  real[0] = n + {MAGIC + 1023.0!r};
  bits[1] = bits[0] << 20;
  bits[0] = 0;
  return real[0];
}}
function exponent(x) {{
  real[0] = x;
  return ((bits[1] >>> 20) & 0x7ff) - 1023;
}}
function copysign(x, sign) {{
  real[0] = sign;
  return bits[1] >>> 31 ? -Math.abs(x) : Math.abs(x);
}}
""",
)


class Formulas(ElementaryTrace):
    """A recording in which functions stay calls; scripts have each function once."""

    def _function(self, name: str, a: Any) -> Any:
        if isinstance(a, Number):
            return self.record(name, a)
        return getattr(ElementaryTrace, name)(self, a)

    def sin(self, a: Any) -> Any:
        """Return the sine."""
        return self._function("sin", a)

    def cos(self, a: Any) -> Any:
        """Return the cosine."""
        return self._function("cos", a)

    def tan(self, a: Any) -> Any:
        """Return the tangent."""
        return self._function("tan", a)

    def exp(self, a: Any) -> Any:
        """Return the exponential."""
        return self._function("exp", a)

    def log(self, a: Any) -> Any:
        """Return the natural logarithm."""
        return self._function("log", a)

    def atan(self, a: Any) -> Any:
        """Return the arc tangent."""
        return self._function("atan", a)

    arctan = atan

    def tanh(self, a: Any) -> Any:
        """Return the hyperbolic tangent."""
        return self._function("tanh", a)


class Script:
    """The target that writes a language's text: numbers are names or literals; see `series.Target`.

    Parameters
    ----------
    language : Language
        The language.
    """

    def __init__(self, language: Language) -> None:
        self._language = language
        self._lines: list[str] = []
        self._depth = self._count = self._memory = 0
        self._functions: dict[str, str] = {}

    # --- text ----------------------------------------------------------------------------------------------

    def text(self) -> str:
        """Return all that was written, and before it what it is made of."""
        parts = [self._language.head, *self._functions.values()]
        if self._memory:
            parts.insert(1, self._said("let", "m", self._language.memory.format(self._memory)) + "\n")
        return "".join([*parts, *(line + "\n" for line in self._lines)])

    def _said(self, statement: str, *parts: Any) -> str:
        return STATEMENTS[statement][self._language.column].format(*parts)

    def say(self, statement: str, *parts: Any) -> None:
        """Write a statement of `STATEMENTS`."""
        line = self._said(statement, *parts)
        if line:
            self._lines.append(" " * self._depth + line)

    def _new(self, letter: str = "x") -> str:
        self._count += 1
        return f"{letter}{self._count}"

    def put(self, op: str, *args: Any, statement: str = "let") -> str:
        """Write an operation; return the name of its result."""
        name = self._new()
        self.say(statement, name, OPERATIONS[op][self._language.column].format(*map(self.literal, args)))
        return name

    def literal(self, value: Any) -> str:
        """Return a number as this language writes it; a name as it is."""
        if isinstance(value, str):
            return value
        known = self._language.words.get(str(value))
        text = known or repr(value)
        return f"({text})" if text.startswith("-") else text

    def _block(self, body: Callable[[], Any]) -> Any:
        """Write the lines of a body, indented, to its end."""
        self._depth += 1
        before = len(self._lines)
        result = body()
        if len(self._lines) == before:
            self.say("nothing")
        self._depth -= 1
        self.say("end")
        return result

    def function(self, name: str, arguments: str, body: Callable[[], Any]) -> None:
        """Write a function whose body returns what it returns, or None."""

        def inside() -> None:
            result = body()
            if result is not None:
                self.say("return", self.literal(result))

        self._count = 0
        self.say("function", name, arguments)
        self._block(inside)

    def emit(self, operations: Iterable[Operation], values: Mapping[str, Any]) -> dict[str, Any]:
        """Write recorded operations; return what all names stand for."""
        known = dict(values)
        for name, op, args in operations:
            given = [known[a] if isinstance(a, str) else a for a in args]
            if op in OPERATIONS:
                known[name] = self.put(op, *given)
            else:
                known[name] = self.elementary(op, *given)
        return known

    def formula(self, formula: Callable, inputs: Mapping[str, Value]) -> list[Any]:
        """Record ``formula(xp, *numbers)`` and write it; return its results.

        Inputs are names of this script by names of one's own; one that is 0.0 is known to be zero.
        """
        trace = Formulas()
        given = [
            trace.inputs(name)[0] if isinstance(value, str) else trace.zero() if value == 0.0 else value
            for name, value in inputs.items()
        ]
        operations, results = trace.operations(formula(trace, *given), fused=False)
        known = self.emit(operations, inputs)
        return [known[r] if isinstance(r, str) else r for r in results]

    # --- what `series.Target` asks for ----------------------------------------------------------------------

    def number(self, value: float) -> Any:
        return float(value)

    def add(self, a: Any, b: Any) -> str:
        return self.put("+", a, b)

    def sub(self, a: Any, b: Any) -> str:
        return self.put("-", a, b)

    def mul(self, a: Any, b: Any) -> str:
        return self.put("*", a, b)

    def div(self, a: Any, b: Any) -> str:
        return self.put("/", a, b)

    def fma(self, a: Any, b: Any, c: Any) -> str:
        return self.put("+", self.put("*", a, b), c)

    def neg(self, a: Any) -> str:
        return self.put("neg", a)

    def abs(self, a: Any) -> str:
        return self.put("abs", a)

    def sqrt(self, a: Any) -> str:
        return self.put("sqrt", a)

    def less(self, a: Any, b: Any) -> str:
        return self.put("<", a, b)

    def both(self, a: Any, b: Any) -> str:
        return self.put("&", a, b)

    def select(self, condition: Any, a: Any, b: Any) -> str:
        return self.put("where", condition, a, b)

    def either(self, a: Any, b: Any) -> str:
        return self.put("|", a, b)

    def all(self, condition: Any) -> Any:
        return condition

    def negated(self, condition: Any) -> str:
        return self.put("~", condition)

    def real(self, k: Any) -> Any:
        return float(k) if isinstance(k, int) else self.put("real", k)

    def reciprocal(self, k: Any) -> Any:
        return 1.0 / k if isinstance(k, int) else self.put("/", 1.0, k)

    def index(self, k: int) -> int:
        return k

    def plus(self, k: Any, n: int) -> Any:
        return k + n if isinstance(k, int) else f"({k} + {n})"

    def minus(self, a: Any, b: Any) -> Any:
        return a - b if isinstance(a, int) and isinstance(b, int) else f"({a} - {b})"

    def half(self, k: Any) -> Any:
        return k // 2 if isinstance(k, int) else f"({k} >> 1)"

    def below(self, a: Any, b: Any) -> str:
        return f"{a} < {b}"

    def _at(self, slot: int, k: Any) -> Any:
        self._memory = max(self._memory, (slot + 1) * STRIDE)
        return slot * STRIDE + k if isinstance(k, int) else f"{slot * STRIDE} + {k}"

    def load(self, slot: int, k: Any) -> str:
        return self.put("read", "m", self._at(slot, k))

    def store(self, slot: int, k: Any, value: Any) -> None:
        self.say("write", "m", self._at(slot, k), self.literal(value))

    def loop(self, first: Any, end: Any, carried: Sequence, body: Callable, step: int = 1) -> list:
        names = self._vary(carried)
        k = self._new("k")
        self.say("for", k, first, end, step)
        self._block(lambda: self._change(names, body(k, list(names))))
        return names

    def repeat(self, times: int, carried: Sequence, body: Callable) -> list:
        names = self._vary(carried)
        k = self._new("k")

        def inside() -> None:
            going, values = body(k, list(names))
            self._change(names, values)
            self.say("leave", self.literal(going))

        self.say("for", k, 0, times, 1)
        self._block(inside)
        return names

    def when(self, condition: Any, body: Callable, otherwise: Sequence) -> list:
        names = self._vary(otherwise)
        self.say("if", condition)
        self._block(lambda: self._change(names, body()))
        return names

    def _vary(self, values: Sequence) -> list[str]:
        names = [self._new("y") for _ in values]
        for name, value in zip(names, values, strict=True):
            self.say("vary", name, self.literal(value))
        return names

    def _change(self, names: Sequence[str], values: Sequence) -> None:
        """Give variables their next values, all at once."""
        changed: set[str] = set()
        kept = []
        for name, value in zip(names, values, strict=True):
            if value in changed:  # it would be overwritten before it is used
                raise AssertionError(f"{value} is carried on under another name")
            if value != name:
                kept.append((name, value))
                changed.add(name)
        for name, value in kept:
            self.say("set", name, self.literal(value))

    def elementary(self, name: str, x: Any) -> str:
        called = name.replace(" ", "_")
        if called not in self._functions:
            operations, result = elementary(name, False)
            script = Script(self._language)
            script.function(called, "x", lambda: script.emit(operations, {"x": "x"})[result])
            self._functions[called] = "".join(line + "\n" for line in script._lines)
        result = self._new()
        self.say("let", result, f"{called}({self.literal(x)})")
        return result

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]:
        return self.emit(record.scalars, inputs)


#: Numbers that are set aside for one series.
STRIDE = LARGEST_ORDER + 3


def motion(
    t: Script, record: SeriesRecord, inputs: dict[str, Any], q: list, v: list, dt: Any, order: int
) -> tuple[list, list, str]:
    """Write a control step of the series; return places, velocities, and whether it was refused.

    Parameters
    ----------
    t : Script
        Where to.
    record : SeriesRecord
        What is stepped.
    inputs : dict
        Names of its inputs' values.
    q, v : list
        Names of places and velocities at the start.
    dt : str or float
        The control step [s].
    order : int
        Order of the series.
    """
    n, step = record.size, Series(record)
    smallest = t.mul(SMALLEST_PART, dt)

    def attempt(count: Any, carried: Sequence) -> tuple[Any, list]:
        lane = Lane(carried[:n], carried[n : 2 * n], 0.0, *carried[2 * n :])
        after, _ = step.substep(t, inputs, lane, dt, order, TOLERANCE)
        going = t.both(t.less(0.0, after.left), t.less(smallest, after.wish))
        return going, [*after.q, *after.v, after.left, after.wish]

    *found, left, _ = t.repeat(LARGEST_COUNT, [*q, *v, dt, dt], attempt)
    return found[:n], found[n:], t.less(0.0, left)


def run_python(text: str) -> dict[str, Any]:
    """Return the functions of a script in Python."""
    names = {"divide": "/", "floor": "floor", "pow2": "pow2", "exponent": "exponent", "copysign": "copysign"}
    scope: dict[str, Any] = {name: IEEE[op] for name, op in names.items()}
    scope |= {"sqrt": math.sqrt, "inf": math.inf, "nan": math.nan}
    exec(compile(text, "<script>", "exec"), scope)
    return scope
