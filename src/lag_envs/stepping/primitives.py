"""What compiled code is made of beside Python's arithmetic: a few instructions, and the random generator.

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
from collections.abc import Callable

import numba
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = (np.uint64(n) for n in (30, 27, 31, 11))
_DRAWS = np.uint64(16)  # draws set aside for each step
_ONE = np.uint64(1)


@njit(cache=True, forceinline=True)
def _mix(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> _S30)) * _M1
    z = (z ^ (z >> _S27)) * _M2
    return z ^ (z >> _S31)


@njit(cache=True, forceinline=True)
def episode_key(key, episode):  # type: ignore[no-untyped-def]
    """Return the key of one episode (both uint64)."""
    return _mix(_mix(key) + episode * GOLDEN)


@njit(cache=True, forceinline=True)
def uniform(key, step, index):  # type: ignore[no-untyped-def]
    """Return draw ``index`` (below 16) of step ``step`` of the episode with this key, in [0, 1)."""
    z = _mix(key + (step * _DRAWS + index + _ONE) * GOLDEN)
    return np.float64(np.int64(z >> _S11)) * 2.0**-53


@intrinsic
def fma(typingctx, a, b, c):  # type: ignore[no-untyped-def]
    """Return a * b + c, rounded once."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.fma(
            *(context.cast(builder, v, t, types.float64) for v, t in zip(args, signature.args, strict=True))
        )

    return types.float64(a, b, c), codegen


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
    arithmetic and run 1.5 to 1.7 times as fast with the full width. The result's bits do not depend on it.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        # llvmlite knows no string attributes, but prints what the set holds.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return ir.Constant(ir.IntType(8).as_pointer(), None)

    return types.void(), codegen


@intrinsic
def _power_of_two(typingctx, n):  # type: ignore[no-untyped-def]
    """Return 2**n for a whole number n in [-1022, 1023], by writing the exponent's bits."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        exponent = builder.add(builder.fptosi(args[0], ir.IntType(64)), ir.Constant(ir.IntType(64), 1023))
        return builder.bitcast(builder.shl(exponent, ir.Constant(ir.IntType(64), 52)), ir.DoubleType())

    return types.float64(types.float64), codegen


@njit(cache=True, forceinline=True)
def exp(x):  # type: ignore[no-untyped-def]
    """Return e**x to 1 ulp, clipped to |x| <= 700; arithmetic only, so that loops with it become vectors."""
    x = select(x < -700.0, -700.0, select(x > 700.0, 700.0, x))
    n = np.floor(fma(x, 1.4426950408889634, 0.5))
    r = fma(-n, 1.9082149292705877e-10, fma(-n, 0.693147180369123816490, x))
    p = 1.0 / 6227020800.0
    p = fma(p, r, 1.0 / 479001600.0)
    p = fma(p, r, 1.0 / 39916800.0)
    p = fma(p, r, 1.0 / 3628800.0)
    p = fma(p, r, 1.0 / 362880.0)
    p = fma(p, r, 1.0 / 40320.0)
    p = fma(p, r, 1.0 / 5040.0)
    p = fma(p, r, 1.0 / 720.0)
    p = fma(p, r, 1.0 / 120.0)
    p = fma(p, r, 1.0 / 24.0)
    p = fma(p, r, 1.0 / 6.0)
    p = fma(p, r, 1.0 / 2.0)
    p = fma(p, r, 1.0 / 1.0)
    p = fma(p, r, 1.0 / 1.0)
    return p * _power_of_two(n)


def jit(function: Callable) -> Callable:
    """Compile a function, cached on disk where a place can be written to."""
    options = {"error_model": "numpy", "nogil": True}
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:  # no writable cache folder: compile anew in every process
        return numba.njit(function, **options)


#: What the source of a compiled function may name.
NAMES = {
    "np": np,
    "math": math,
    "fma": fma,
    "select": select,
    "exp": exp,
    "wide_vectors": wide_vectors,
    "uniform": uniform,
    "episode_key": episode_key,
}
