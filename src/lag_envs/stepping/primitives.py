"""What compiled code is made of: recorded formulas as blocks, a few instructions, the random generator.

The generator is counter-based: a draw is a pure function of (key, episode, step, index). So it can be made
inside a compiled loop, costs a few integer operations, and does not depend on how many environments are
stepped together. The function is the output mix of SplitMix64 [1]_ applied to a Weyl sequence whose origin is
itself such a mix of key and episode.

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators",
   OOPSLA 2014; constants of variant 13 by D. Stafford.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from lag_envs.stepping.tracing import BOOLEAN, Operation

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = (np.uint64(n) for n in (30, 27, 31, 11))
_DRAWS = np.uint64(16)  # draws set aside for each step
_ONE = np.uint64(1)


@njit(forceinline=True)
def _mix(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> _S30)) * _M1
    z = (z ^ (z >> _S27)) * _M2
    return z ^ (z >> _S31)


@njit(forceinline=True)
def episode_key(key, episode):  # type: ignore[no-untyped-def]
    """Return the key of one episode (both uint64)."""
    return _mix(_mix(key) + episode * GOLDEN)


@njit(forceinline=True)
def uniform(key, step, index):  # type: ignore[no-untyped-def]
    """Return draw ``index`` (below 16) of step ``step`` of the episode with this key, in [0, 1)."""
    z = _mix(key + (step * _DRAWS + index + _ONE) * GOLDEN)
    return np.float64(np.int64(z >> _S11)) * 2.0**-53


@intrinsic
def fma(typingctx, a, b, c):  # type: ignore[no-untyped-def]
    """Return a * b + c, rounded once."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.fma(*args)

    return types.float64(types.float64, types.float64, types.float64), codegen


@intrinsic
def select(typingctx, condition, a, b):  # type: ignore[no-untyped-def]
    """Return a where the condition holds, else b, without a branch."""
    kind = types.boolean if a == types.boolean else types.float64

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        c, x, y = (
            context.cast(builder, v, t, u)
            for v, t, u in zip(args, signature.args, (types.boolean, kind, kind), strict=True)
        )
        return builder.select(c, x, y)

    return kind(condition, a, b), codegen


@intrinsic
def wide_vectors(typingctx):  # type: ignore[no-untyped-def]
    """Ask for 512-bit vectors where the processor has them.

    LLVM prefers 256 bits on many such processors for the sake of mixed code; these loops are nothing but
    arithmetic and run faster with the full width. The result's bits do not depend on it.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        # llvmlite knows no string attributes, but prints what the set holds.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return ir.Constant(ir.IntType(8).as_pointer(), None)

    return types.void(), codegen


def block(operations: Sequence[Operation], inputs: Sequence[str], outputs: Sequence[Any]) -> Callable:
    """Return a function that carries out recorded operations, written straight in LLVM's language.

    Parameters
    ----------
    operations : sequence of Operation
        What to do.
    inputs : sequence of str
        The arguments, all float64.
    outputs : sequence of str or float
        Which results to return, as a tuple.
    """
    boolean = {operation.name for operation in operations if operation.op in BOOLEAN}
    kinds = [types.boolean if o in boolean or isinstance(o, bool) else types.float64 for o in outputs]
    result = types.Tuple(kinds)

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        known = dict(zip(inputs, args, strict=True))

        def value(of: Any) -> ir.Value:
            if isinstance(of, str):
                return known[of]
            return ir.Constant(ir.IntType(1), int(of)) if isinstance(of, bool) else ir.Constant(_DOUBLE, of)

        for name, op, arguments in operations:
            known[name] = _emit(builder, op, [value(a) for a in arguments])
        return context.make_tuple(builder, signature.return_type, [value(o) for o in outputs])

    # Numba wants the arguments by name.
    scope = {"answer": lambda: (result(*[types.float64] * len(inputs)), codegen)}
    exec(f"def block(typingctx, {', '.join(inputs)}): return answer()", scope)
    return intrinsic(scope["block"])


_DOUBLE = ir.DoubleType()
_INT = ir.IntType(64)


def _emit(b: ir.IRBuilder, op: str, args: list[ir.Value]) -> ir.Value:
    """Write one operation."""
    if op in ("sqrt", "sin", "cos", "log", "floor", "abs"):
        name = "llvm.fabs" if op == "abs" else f"llvm.{op}"
        return b.call(b.module.declare_intrinsic(name, [_DOUBLE]), args)
    if op in ("<", "<="):
        return b.fcmp_ordered(op, *args)
    return {
        "+": b.fadd,
        "-": b.fsub,
        "*": b.fmul,
        "/": b.fdiv,
        "neg": b.fneg,
        "a*b+c": b.fma,
        "a*b-c": lambda x, y, z: b.fma(x, y, b.fneg(z)),
        "c-a*b": lambda x, y, z: b.fma(b.fneg(x), y, z),
        "where": b.select,
        "&": b.and_,
        "|": b.or_,
        "~": b.not_,
        "exp": lambda x: _exp(b, x),
    }[op](*args)


def _exp(b: ir.IRBuilder, x: ir.Value) -> ir.Value:
    """Write e**x to 1 ulp, clipped to |x| <= 700: arithmetic only, so that a loop with it becomes vectors."""

    def number(value: float) -> ir.Constant:
        return ir.Constant(_DOUBLE, value)

    for limit, beyond in ((-700.0, "<"), (700.0, ">")):
        x = b.select(b.fcmp_ordered(beyond, x, number(limit)), number(limit), x)
    # x = n log 2 + r with |r| <= log(2)/2; log 2 in two parts.
    n = _emit(b, "floor", [b.fma(x, number(1.4426950408889634), number(0.5))])
    r = b.fma(b.fneg(n), number(0.6931471803691238), x)
    r = b.fma(b.fneg(n), number(1.9082149292705877e-10), r)
    p = number(1.0 / math.factorial(13))
    for k in range(12, -1, -1):
        p = b.fma(p, r, number(1.0 / math.factorial(k)))
    exponent = b.shl(b.add(b.fptosi(n, _INT), ir.Constant(_INT, 1023)), ir.Constant(_INT, 52))
    return b.fmul(p, b.bitcast(exponent, _DOUBLE))


#: What the source of a compiled function may name.
NAMES = {
    "np": np,
    "math": math,
    "fma": fma,
    "select": select,
    "wide_vectors": wide_vectors,
    "uniform": uniform,
    "episode_key": episode_key,
}
