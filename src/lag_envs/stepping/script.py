"""Prints recorded formulas and the series' step as source text, in Python, JavaScript or C++.

The text is unfused: + - * / √, comparisons, and a few exact operations on bits. It therefore gives the same
bits in every language and on any machine, and in C++ also on a GPU. `OPERATIONS` has a line per operation and
a column per language; loops, including those over the order of the series, are printed as loops.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lag_envs.stepping.driver import LARGEST_COUNT, SMALLEST_PART
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.lowering import SeriesRecord
from lag_envs.stepping.series import STRIDE, TOLERANCE, Series, StepProgress
from lag_envs.stepping.target import GROUP, elementary
from lag_envs.stepping.tracing import IEEE, MAGIC, Operation, TracedNumber, Value

#: Every operation of a recording, in Python, JavaScript and C++. Where Python raises an error, C does not.
OPERATIONS: Mapping[str, tuple[str, str, str]] = {
    "+": ("{} + {}", "{} + {}", "{} + {}"),
    "-": ("{} - {}", "{} - {}", "{} - {}"),
    "*": ("{} * {}", "{} * {}", "{} * {}"),
    "/": ("{0} / {1} if {1} else divide({0}, {1})", "{} / {}", "{} / {}"),
    "neg": ("-{}", "-{}", "-{}"),
    "<": ("{} < {}", "{} < {}", "{} < {}"),
    "<=": ("{} <= {}", "{} <= {}", "{} <= {}"),
    "&": ("{} and {}", "{} && {}", "{} && {}"),
    "|": ("{} or {}", "{} || {}", "{} || {}"),
    "~": ("not {}", "!{}", "!{}"),
    "where": ("{1} if {0} else {2}", "{} ? {} : {}", "{} ? {} : {}"),
    "sqrt": ("sqrt({0}) if {0} >= 0.0 else nan", "Math.sqrt({})", "sqrt({})"),
    "abs": ("abs({})", "Math.abs({})", "fabs({})"),
    "floor": ("floor({})", "Math.floor({})", "floor({})"),
    "pow2": ("pow2({})", "pow2({})", "pow2({})"),
    "exponent": ("exponent({})", "exponent({})", "exponent({})"),
    "copysign": ("copysign({}, {})", "copysign({}, {})", "copysign({}, {})"),
    "real": ("float({})", "{}", "real({})"),
    "read": ("{}[{}]", "{}[{}]", "{}[{}]"),
}

_FOR = (
    "for {0} in range({1}, {2}, {3}):",
    "for (let {0} = {1}; {0} < {2}; {0} += {3}) {{",
    "for (int {0} = {1}; {0} < {2}; {0} += {3}) {{",
)

#: Statements in all languages. A "repeat" may be left before its end. A "for" is short, and a GPU's compiler
#: is asked to unroll it.
STATEMENTS: Mapping[str, tuple[str, str, str]] = {
    "let": ("{} = {}", "const {} = {};", "const auto {} = {};"),
    "array": ("{} = [0.0] * {}", "const {} = new Float64Array({});", "real {}[{}];"),
    "vary": ("{} = {}", "let {} = {};", "auto {} = {};"),
    "set": ("{} = {}", "{} = {};", "{} = {};"),
    "write": ("{}[{}] = {}", "{}[{}] = {};", "{}[{}] = {};"),
    "if": ("if {}:", "if ({}) {{", "if ({}) {{"),
    "for": (*_FOR[:2], f"UNROLL {_FOR[2]}"),
    "repeat": _FOR,
    "leave": ("if not {}: break", "if (!{}) break;", "if (!{}) break;"),
    "function": ("def {}({}):", "function {}({}) {{", "INLINE auto {}({}) {{"),
    "return": ("return {}", "return {};", "return {};"),
    "call": ("{}({})", "{}({});", "{}({});"),
    "nothing": ("pass", "", ""),
    "end": ("", "}}", "}}"),
}


#: A function with more statements than this is split, because browsers run functions with more than about 60
#: kB of code much more slowly.
LARGEST = 1500


class Language(NamedTuple):
    """A language of scripts.

    Attributes
    ----------
    column : int
        Its column in `OPERATIONS` and `STATEMENTS`.
    words : mapping
        Its words for truth values, infinity and NaN.
    head : str
        Code that defines the operations on bits.
    rounded : callable
        Rounds a float to the language's numbers.
    suffix : str
        The suffix of a literal.
    arguments : mapping
        Declarations of a function's arguments, where their names are not enough.
    largest : int, optional
        Largest number of statements of a function; longer functions are split.
    own_functions : bool
        Whether sines and other elementary functions are printed too. If not, the library's functions are
        called, which give other bits.
    own_memory : bool
        Whether each function has its own arrays; if not, all functions share them.
    """

    column: int
    words: Mapping[str, str]
    head: str
    rounded: Callable[[float], float] = float
    suffix: str = ""
    arguments: Mapping[str, str] = {}
    largest: int | None = LARGEST
    own_functions: bool = True
    own_memory: bool = False


PYTHON = Language(0, {"True": "True", "False": "False", "inf": "inf", "-inf": "(-inf)", "nan": "nan"}, "")
JAVASCRIPT = Language(
    1,
    {"True": "true", "False": "false", "inf": "Infinity", "-inf": "(-Infinity)", "nan": "NaN"},
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
#: C++ for processors and GPUs; INLINE, INF, UNDEFINED and UNROLL are defined by the surrounding code.
CPP = Language(
    2,
    {"True": "true", "False": "false", "inf": "INF", "-inf": "(-INF)", "nan": "UNDEFINED"},
    f"""typedef double real;
union Bits {{
  double number;
  unsigned long long bits;
}};
INLINE real pow2(real n) {{
  Bits x;
  x.number = n + {MAGIC + 1023.0!r};
  x.bits <<= 52;
  return x.number;
}}
INLINE real exponent(real number) {{
  Bits x;
  x.number = number;
  return real(int(x.bits >> 52 & 0x7ff) - 1023);
}}
""",
    arguments={
        "x": "real x",
        "f, d, k": "real *f, const real *d, const real *k",
        "f, a, k": "real *f, const real *a, const real *k",
        "f, k": "real *f, const real *k",
    },
    largest=None,
    own_memory=True,
)
#: The same in single precision, with the functions of C's library.
CPP_SINGLE = CPP._replace(
    head="""typedef float real;
INLINE real pow2(real n) { return exp2(n); }
INLINE real exponent(real x) { return ilogb(x); }
INLINE real rough_exp2(real x) { return exp2(x); }
INLINE real rough_log2(real x) { return log2(x); }
""",
    rounded=lambda x: float(np.float32(x)),
    suffix="f",
    own_functions=False,
)


def _called(name: str) -> Callable:
    def of(self: ScriptTrace, a: Any) -> Any:
        if isinstance(a, TracedNumber):
            return self.record(name, a)
        return getattr(ElementaryTrace, name)(self, a)

    return of


class ScriptTrace(ElementaryTrace):
    """A recording in which function calls stay calls; a script contains each function once."""

    sin, cos, tan, exp, log, atan, tanh = map(_called, ("sin", "cos", "tan", "exp", "log", "atan", "tanh"))
    arctan = atan


class ScriptTerm(NamedTuple):
    """An operation of `OPERATIONS` on names and numbers, or a call of an elementary function."""

    op: str
    args: tuple[Any, ...]


class Statement(NamedTuple):
    """A statement of `STATEMENTS`, with its block if it has one."""

    kind: str
    parts: tuple[Any, ...]
    body: tuple[Statement, ...] = ()


class Script:
    """The target that writes source text: numbers are names or literals; see `target.Target`.

    Examples
    --------
    >>> script = Script()
    >>> script.function("norm", "a, b", lambda: script.sqrt(script.fma("a", "a", script.mul("b", "b"))))
    >>> print(script.text(JAVASCRIPT).partition("function norm")[2])
    (a, b) {
     const x1 = b * b;
     const x2 = a * a;
     const x3 = x2 + x1;
     const x4 = Math.sqrt(x3);
     return x4;
    }
    <BLANKLINE>
    """

    group = GROUP

    def __init__(self) -> None:
        self._block: list[Statement] = []
        self._functions: list[Statement] = []
        self._elementary: dict[str, Statement] = {}
        self._count = 0
        #: Size of the array that holds the coefficients of series.
        self.memory = 0

    # --- text ----------------------------------------------------------------------------------------------

    def text(self, language: Language) -> str:
        """Return everything written so far, as text in a language."""
        functions, spilled = self._functions, 0
        if language.largest:
            functions = []
            for function in self._functions:
                parts, numbers = _cut(function, language.largest)
                functions += parts
                spilled = max(spilled, numbers)
        arrays = [Statement("array", (name, n)) for name, n in (("m", self.memory), ("s", spilled)) if n]
        if language.own_memory:
            functions = [_with_memory(function, arrays) for function in functions]
            arrays = []
        own = self._elementary.values() if language.own_functions else ()
        lines = _lines([*arrays, *own, *functions], language)
        return language.head + "".join(line + "\n" for line in lines)

    def say(self, kind: str, *parts: Any, body: Sequence[Statement] = ()) -> None:
        """Write a statement of `STATEMENTS`."""
        self._block.append(Statement(kind, parts, tuple(body)))

    def _new(self, letter: str = "x") -> str:
        self._count += 1
        return f"{letter}{self._count}"

    def put(self, op: str, *args: Any) -> str:
        """Write an operation; return the name of its result."""
        name = self._new()
        self.say("let", name, ScriptTerm(op, args))
        return name

    def _inside(self, write: Callable[[], Any]) -> tuple[Statement, ...]:
        """Return the statements that ``write`` writes."""
        outer, self._block = self._block, []
        write()
        written, self._block = self._block, outer
        return tuple(written) or (Statement("nothing", ()),)

    def function(self, name: str, arguments: str, body: Callable[[], Any]) -> None:
        """Write a function that returns the result of `body`, if not None."""
        self._functions.append(_without_unused(self._function(name, arguments, body)))

    def _function(self, name: str, arguments: str, body: Callable[[], Any]) -> Statement:
        def inside() -> None:
            result = body()
            if result is not None:
                self.say("return", result)

        self._count = 0
        return Statement("function", (name, arguments), self._inside(inside))

    def emit(self, operations: Iterable[Operation], values: Mapping[str, Any]) -> dict[str, Any]:
        """Write recorded operations; return the values of all names."""
        known = dict(values)
        for name, op, args in operations:
            given = [known[a] if isinstance(a, str) else a for a in args]
            known[name] = self.put(op, *given) if op in OPERATIONS else self.elementary(op, *given)
        return known

    def formula(self, formula: Callable, inputs: Mapping[str, Value]) -> list[Any]:
        """Record ``formula(xp, *numbers)`` and write it; return its results.

        Inputs map the formula's names to names of this script; an input 0.0 is known to be zero.
        """
        trace = ScriptTrace()
        given = [
            trace.inputs(name)[0] if isinstance(value, str) else trace.zero() if value == 0.0 else value
            for name, value in inputs.items()
        ]
        operations, results = trace.operations(formula(trace, *given), fused=False)
        known = self.emit(operations, inputs)
        return [known[r] if isinstance(r, str) else r for r in results]

    # --- the operations of `target.Target` ------------------------------------------------------------------

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
        self.memory = max(self.memory, (slot + 1) * STRIDE)
        return slot * STRIDE + k if isinstance(k, int) else f"{slot * STRIDE} + {k}"

    def load(self, slot: int, k: Any) -> str:
        return self.put("read", "m", self._at(slot, k))

    def store(self, slot: int, k: Any, value: Any) -> None:
        self.say("write", "m", self._at(slot, k), value)

    def aside(self, values: Sequence) -> Callable[[], list]:
        return lambda: list(values)

    def loop(self, first: Any, end: Any, carried: Sequence, body: Callable, step: int = 1) -> list:
        names, k = self._vary(carried), self._new("k")
        written = self._inside(lambda: self._change(names, body(k, list(names))))
        self.say("for", k, first, end, step, body=written)
        return names

    def repeat(self, times: int, carried: Sequence, body: Callable) -> list:
        names, k = self._vary(carried), self._new("k")

        def inside() -> None:
            going, values = body(k, list(names))
            self._change(names, values)
            self.say("leave", going)

        self.say("repeat", k, 0, times, 1, body=self._inside(inside))
        return names

    def when(self, condition: Any, body: Callable, otherwise: Sequence) -> list:
        names = self._vary(otherwise)
        self.say("if", condition, body=self._inside(lambda: self._change(names, body())))
        return names

    def _vary(self, values: Sequence) -> list[str]:
        names = [self._new("y") for _ in values]
        for name, value in zip(names, values, strict=True):
            self.say("vary", name, value)
        return names

    def _change(self, names: Sequence[str], values: Sequence) -> None:
        """Give variables their next values, all at once."""
        changed: set[str] = set()
        for name, value in zip(names, values, strict=True):
            assert value not in changed, f"{value} would be overwritten before it is used"
            if value != name:
                self.say("set", name, value)
                changed.add(name)

    def elementary(self, name: str, x: Any) -> str:
        called = name.replace(" ", "_")
        if called not in self._elementary:
            operations, result = elementary(name, False)
            other = Script()
            made = other._function(called, "x", lambda: other.emit(operations, {"x": "x"})[result])
            self._elementary[called] = made
        return self.put(called, x)

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]:
        return self.emit(record.scalars, inputs)


_NAME = re.compile(r"\b[xyk][0-9]+\b")


# --- statements as text -------------------------------------------------------------------------------------


def _lines(block: Iterable[Statement], language: Language, depth: int = 0) -> Iterator[str]:
    """Return the lines of a block."""
    column = language.column

    def text(value: Any) -> str:
        if isinstance(value, ScriptTerm):
            form = OPERATIONS[value.op][column] if value.op in OPERATIONS else f"{value.op}({{}})"
            return form.format(*map(text, value.args))
        if isinstance(value, str):
            return value
        if isinstance(value, float):
            value = language.rounded(value)
            found = language.words.get(str(value)) or f"{value!r}{language.suffix}"
        else:
            found = language.words.get(str(value)) or repr(value)
        return f"({found})" if found.startswith("-") else found

    for kind, parts, body in block:
        if kind == "function":
            parts = parts[0], language.arguments.get(parts[1], parts[1])
        line = STATEMENTS[kind][column].format(*map(text, parts))
        if line:
            yield " " * depth + line
        if body:
            yield from _lines(body, language, depth + 1)
            if end := STATEMENTS["end"][column].format():
                yield " " * depth + end


# --- transformations of statements --------------------------------------------------------------------------


def _named(value: Any) -> Iterator[str]:
    """Return the variables in a part of a statement."""
    if isinstance(value, str):
        yield from _NAME.findall(value)
    elif isinstance(value, ScriptTerm):
        for arg in value.args:
            yield from _named(arg)


def _all(block: Iterable[Statement]) -> Iterator[Statement]:
    for statement in block:
        yield statement
        yield from _all(statement.body)


def _without_unused(function: Statement) -> Statement:
    """Leave out operations whose results are not used."""
    makes = ("let", "vary", "set")
    uses: Counter[str] = Counter()
    made: dict[str, list[str]] = {}
    for kind, parts, _ in _all(function.body):
        needed = [name for part in parts[kind in makes :] for name in _named(part)]
        uses.update(needed)
        if kind in makes:
            made.setdefault(parts[0], []).extend(needed)
    pending = [name for name in made if not uses[name]]
    unused = set(pending)
    while pending:
        for name in made[pending.pop()]:
            uses[name] -= 1
            if not uses[name] and name in made:
                unused.add(name)
                pending.append(name)

    def kept(block: Sequence[Statement]) -> tuple[Statement, ...]:
        found = (
            statement._replace(body=kept(statement.body))
            for statement in block
            if statement.kind not in makes or statement.parts[0] not in unused
        )
        return tuple(found) or (Statement("nothing", ()),) * bool(block)

    return function._replace(body=kept(function.body))


def _with_memory(function: Statement, arrays: Iterable[Statement]) -> Statement:
    """Return a function that declares the arrays that it uses."""
    every = list(_all(function.body))
    used = {
        part.args[0] for s in every for part in s.parts if isinstance(part, ScriptTerm) and part.op == "read"
    }
    used |= {s.parts[0] for s in every if s.kind == "write"}
    return function._replace(body=(*(array for array in arrays if array.parts[0] in used), *function.body))


def _cut(function: Statement, largest: int) -> tuple[list[Statement], int]:
    """Split a long function into several; return them, and how many numbers they share."""
    name, arguments = function.parts
    found: list[Statement] = []

    def size(block: Iterable[Statement]) -> int:
        return sum(1 for _ in _all(block))

    def shortened(block: Sequence[Statement]) -> tuple[Statement, ...]:
        if size(block) <= largest:
            return tuple(block)
        result: list[Statement] = []
        group: list[Statement] = []
        long = 0

        def close() -> None:
            if group:
                part = f"{name}_{len(found)}"
                found.append(Statement("function", (part, arguments), tuple(group)))
                result.append(Statement("call", (part, arguments)))
                group.clear()

        for statement in block:
            statement = statement._replace(body=shortened(statement.body))
            if statement.kind in ("leave", "return"):
                close()
                long = 0
                result.append(statement)
                continue
            more = size([statement])
            if long + more > largest:
                close()
                long = 0
            long += more
            group.append(statement)
        close()
        return tuple(result)

    whole = function._replace(body=shortened(function.body))
    if not found:
        return [whole], 0
    # Numbers that several of the functions need are kept in the array s.
    places: dict[str, set[int]] = {}
    for i, part in enumerate([*found, whole]):
        for statement in _all(part.body):
            for variable in (v for p in statement.parts for v in _named(p)):
                places.setdefault(variable, set()).add(i)
    shared = {v: f"s[{j}]" for j, v in enumerate(v for v, where in places.items() if len(where) > 1)}
    return [part._replace(body=_sharing(part.body, shared)) for part in [*found, whole]], len(shared)


def _sharing(block: Sequence[Statement], shared: Mapping[str, str]) -> tuple[Statement, ...]:
    """Return a block with its shared variables kept in an array."""

    def put(value: Any, known: Mapping[str, str]) -> Any:
        if isinstance(value, ScriptTerm):
            return ScriptTerm(value.op, tuple(put(arg, known) for arg in value.args))
        return _NAME.sub(lambda m: known.get(m[0], m[0]), value) if isinstance(value, str) else value

    def changed(block: Sequence[Statement], known: Mapping[str, str]) -> Iterator[Statement]:
        for kind, parts, body in block:
            if kind in ("let", "vary", "set") and parts[0] in known:
                at = known[parts[0]][2:-1]
                yield Statement("write", ("s", at, put(parts[1], known)))
            elif kind in ("for", "repeat") and parts[0] in known:
                k, inside = parts[0], {v: place for v, place in known.items() if v != parts[0]}
                keep = Statement("write", ("s", known[k][2:-1], k))
                ends = tuple(put(part, known) for part in parts[1:])
                yield Statement(kind, (k, *ends), (keep, *changed(body, inside)))
            else:
                yield Statement(kind, tuple(put(part, known) for part in parts), tuple(changed(body, known)))

    return tuple(changed(block, shared))


# --- the series' step, and running what was printed ---------------------------------------------------------


def script_motion(
    t: Script,
    record: SeriesRecord,
    inputs: dict[str, Any],
    q: list,
    v: list,
    dt: Any,
    order: int,
    tolerance: float = TOLERANCE,
) -> tuple[list, list, str]:
    """Write a control step of the series; return places, velocities, and whether it was refused.

    Parameters
    ----------
    t : Script
        The script to write to.
    record : SeriesRecord
        The equations to step.
    inputs : dict
        Names of the values of the record's inputs.
    q, v : list
        Names of places and velocities at the start.
    dt : str or float
        The control step [s].
    order : int
        Order of the series.
    tolerance : float
        Largest truncation error of a substep's velocities, relative to their size.
    """
    n, step = record.size, Series(record)
    smallest = t.mul(SMALLEST_PART, dt)

    def attempt(count: Any, carried: Sequence) -> tuple[Any, list]:
        lane = StepProgress(carried[:n], carried[n : 2 * n], 0.0, *carried[2 * n :])
        after, _ = step.substep(t, inputs, lane, dt, order, tolerance)
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
