"""Compile straight-line code with Numba, and keep the result on disk.

Numba is imported on first use: importing takes a while, and also loads SciPy if that is installed.
"""

from __future__ import annotations

import hashlib
import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import islice
from typing import Any

from lag_envs.stepping.tracing import Trace, Value

#: Number of lanes of a batch whose numbers lie together, as rows: few enough for the nearest cache, and
#: enough for the lanes that need further substeps to fill vectors.
BLOCK = 192

_BLOCK = "block_[0-9a-f]{16}"
_blocks: dict[str, tuple] = {}


def record_block(
    trace: Trace, outputs: dict[str, Any], *, fused: bool = True
) -> tuple[list[str], list[Value]]:
    """Return the code that computes a trace's outputs, as one call of a straight-line function.

    Numba then need not infer the types inside, which would take most of the compile time.
    ``fused`` is passed on to `Trace.operations`.

    Returns
    -------
    lines : list of str
        The code.
    values : list of str or float
        For each output, its name or, if it turned out to be constant, its value.
    """
    operations, results = trace.operations(outputs.values(), fused=fused)
    made = {operation.name for operation in operations}
    named = {name: result for name, result in zip(outputs, results, strict=True) if isinstance(result, str)}
    used = [arg for operation in operations for arg in operation.args] + list(named.values())
    inputs = tuple(dict.fromkeys(arg for arg in used if isinstance(arg, str) and arg not in made))
    parts = (tuple(operations), inputs, tuple(named.values()))
    block = f"block_{hashlib.sha256(repr(parts).encode()).hexdigest()[:16]}"
    _blocks[block] = parts
    lines = [f"{', '.join(named)}, = {block}({', '.join(inputs)})"] if named else []
    return lines, [name if name in named else result for name, result in zip(outputs, results, strict=True)]


def block_lines(trace: Trace, outputs: dict[str, Any], *, fused: bool = True) -> list[str]:
    """Return the code of `record_block`, with outputs that turned out to be constant assigned as well."""
    lines, values = record_block(trace, outputs, fused=fused)
    return lines + [f"{name} = {value}" for name, value in zip(outputs, values, strict=True) if name != value]


def section(
    formula: Callable, inputs: Sequence[Any], outputs: Sequence[str], kind: type[Trace] = Trace
) -> tuple[list[str], list]:
    """Record ``formula(xp, *inputs)``.

    Parameters
    ----------
    formula : callable
        Returns one number per output.
    inputs : sequence of str or float
        A string names an input; a float is a constant.
    outputs : sequence of str
        Names for the results.
    kind : type
        The kind of recording, which decides how functions are recorded.

    Returns
    -------
    lines : list of str
        The code.
    values : list of str or float
        For each output, its name, or its value if it turned out to be constant.
    """
    trace = kind()
    results = formula(trace, *(_input(trace, i) for i in inputs))
    return record_block(trace, dict(zip(outputs, results, strict=True)))


def _input(trace: Trace, value: Any) -> Any:
    if isinstance(value, str):
        return trace.inputs(value)[0]
    return trace.zero() if value == 0.0 else value


def split_lengths(values: Sequence, *sizes: int) -> list[list]:
    """Cut a sequence into lists of the given lengths; the rest forms the last.

    Examples
    --------
    >>> split_lengths([1, 2, 3, 4], 1, 2)
    [[1], [2, 3], [4]]
    """
    rest = iter(values)
    return [*(list(islice(rest, n)) for n in sizes), list(rest)]


def count_operations(lines: Iterable[str], kinds: frozenset[str] | None = None) -> int:
    """Count the operations (of these kinds, or all) of the blocks in these lines of code."""
    blocks = (_blocks[name][0] for line in lines for name in re.findall(_BLOCK, line))
    return sum(kinds is None or operation.op in kinds for block in blocks for operation in block)


@cache
def compile_function(
    name: str, source: str, /, *helpers: Callable, inner: bool = False, **constants: float | tuple[int, ...]
) -> Callable:
    """Compile the function ``name`` that ``source`` defines.

    Parameters
    ----------
    name : str
        The function's name in the source.
    source : str
        Python source of one function; it may use recorded blocks, `primitives.NAMES`, the helpers
        and the constants.
    *helpers : callable
        Functions that the source calls, under their names there, as compiled by this function.
    inner : bool, default False
        Whether only compiled code calls the function, which saves compiling the code that Python would need.
    **constants : float or tuple of int
        Constants in the source.

    Returns
    -------
    callable
        The compiled function.

    Notes
    -----
    The name carries a digest of the source, the constants and the names of the helpers, which carry digests
    of their own. The name therefore covers everything that the compiled code depends on, and the cache uses
    it as the key.
    """
    from lag_envs.stepping import primitives
    from lag_envs.stepping.cache import jit

    parts = [
        inspect.getsource(primitives),
        source,
        repr((sorted(constants.items()), inner)),
        *(h.__name__ for h in helpers),
    ]
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    unique = f"{name}_{digest}"
    code = compile(source.replace(f"def {name}(", f"def {unique}(", 1), f"<{unique}>", "exec")
    # A result may turn out to be an infinite constant, or NaN.
    words = {"inf": math.inf, "nan": math.nan}
    namespace: dict[str, Any] = dict(primitives.NAMES, **words, **constants, __name__=__name__)
    namespace |= {helper.__name__.rsplit("_", 1)[0]: helper for helper in helpers}
    namespace |= {block: primitives.block(*_blocks[block]) for block in re.findall(_BLOCK, source)}
    exec(code, namespace)
    return jit(namespace[unique], unique, inner)


def absent_from(*constants: Mapping[str, float]) -> frozenset[str]:
    """Return the names of the constants that are zero in every given set: they leave no code."""
    return frozenset(name for name in constants[0] if all(c[name] == 0.0 for c in constants))


def indent(lines: Iterable[str]) -> list[str]:
    """Indent lines of code."""
    return ["    " + line for line in lines]


def compile_lines(
    name: str, arguments: str, body: Iterable[str], *helpers: Callable, inner: bool = False
) -> Callable:
    """Compile a function of these lines under a name; otherwise like `compile_function`."""
    source = "\n".join([f"def {name}({arguments}):", *indent(body), ""])
    return compile_function(name, source, *helpers, inner=inner)


def compile_python(
    name: str,
    function: Callable,
    *helpers: Callable,
    inner: bool = False,
    **constants: float | tuple[int, ...],
) -> Callable:
    """Compile a function written in Python under a name; otherwise like `compile_function`."""
    source = inspect.getsource(function).replace(f"def {function.__name__}(", f"def {name}(", 1)
    return compile_function(name, source, *helpers, inner=inner, **constants)


def compile_traced(
    name: str, arguments: str, formula: Callable, absent: frozenset[str] = frozenset()
) -> Callable:
    """Run ``formula(xp, *arguments)`` once on recording numbers and compile the recorded operations.

    Parameters
    ----------
    name : str
        Name of the compiled function.
    arguments : str
        Its arguments, separated by commas.
    formula : callable
        Takes the `Trace` as namespace and one `TracedNumber` per argument; returns a tuple of numbers.
    absent : frozenset of str
        Arguments that are known to be zero.
    """
    trace = Trace()
    names = arguments.split(", ")
    outputs = formula(trace, *(trace.zero() if n in absent else trace.inputs(n)[0] for n in names))
    names = [f"out{i}" for i in range(len(outputs))]
    lines, values = record_block(trace, dict(zip(names, outputs, strict=True)))
    body = [*lines, f"return {', '.join(map(str, values))}"]
    return compile_lines(name, arguments, body)
