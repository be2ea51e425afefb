"""Building blocks of compiled code: recorded formulas, a few instructions, the random generator.

The generator is counter-based: a draw is a pure function of (key, episode, step, index). Therefore draws can
be made inside a compiled loop, cost a few integer operations, and do not depend on how many environments are
stepped together. The function is the output mix of SplitMix64 [1]_ applied to a Weyl sequence. The origin of
that sequence is itself such a mix of key and episode.

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators",
   OOPSLA 2014; constants of variant 13 by D. Stafford.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from lag_envs.stepping.tracing import BOOLEAN, MAGIC, Operation

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = (np.uint64(n) for n in (30, 27, 31, 11))
#: Random numbers reserved for each step.
DRAWS = np.uint64(16)
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
    z = _mix(key + (step * DRAWS + index + _ONE) * GOLDEN)
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


def _atomic(instruction: Callable, arguments: int, result: Any) -> Callable:
    """Return an atomic instruction, ``(array, index, *arguments)``, on one number of an array."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, args[0])
        return instruction(builder, builder.gep(array.data, [args[1]]), *args[2:])

    def signed(array: Any) -> tuple:
        return result(array, *[types.uint64] * (1 + arguments)), codegen

    scope = {"signed": signed}
    names = "".join(f", x{i}" for i in range(arguments))
    exec(f"def atomic(typingctx, array, index{names}): return signed(array)", scope)
    return intrinsic(scope["atomic"])


def _replace(builder: ir.IRBuilder, at: ir.Value, old: ir.Value, new: ir.Value) -> ir.Value:
    return builder.extract_value(builder.cmpxchg(at, old, new, "acq_rel", "acquire"), 1)


#: ``(array, index)``: returns the number. Everything that another thread wrote before it stored the number is
#: then visible too.
atomic_load = _atomic(lambda b, at: b.load_atomic(at, "acquire", 8), 0, types.uint64)
#: ``(array, index, value)``
atomic_store = _atomic(lambda b, at, value: b.store_atomic(value, at, "release", 8), 1, types.void)
#: ``(array, index, value)``: adds to the number and returns its old value.
atomic_add = _atomic(lambda b, at, value: b.atomic_rmw("add", at, value, "acq_rel"), 1, types.uint64)
atomic_max = _atomic(lambda b, at, value: b.atomic_rmw("umax", at, value, "acq_rel"), 1, types.uint64)
#: ``(array, index, old, new)``: replaces the number if it is ``old``, and returns whether it was.
atomic_replace = _atomic(_replace, 2, types.boolean)


@intrinsic
def address(typingctx, array):  # type: ignore[no-untyped-def]
    """Return the address of an array's numbers, as uint64."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        given = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.ptrtoint(given.data, _INT)

    return types.uint64(array), codegen


@intrinsic
def moved(typingctx, array, address):  # type: ignore[no-untyped-def]
    """Return an array like this one with its numbers at an address (uint64), which nothing keeps alive."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        made = context.make_array(signature.return_type)(context, builder, args[0])
        made.data = builder.inttoptr(args[1], made.data.type)
        made.meminfo = ir.Constant(made.meminfo.type, None)
        made.parent = ir.Constant(made.parent.type, None)
        return made._getvalue()

    return array(array, types.uint64), codegen


@intrinsic(prefer_literal=True)
def read_rows(typingctx, array, first, stride, rows):  # type: ignore[no-untyped-def]
    """Return ``array[first + row * stride]`` for each of these rows, a tuple of literal ints.

    For Numba this is one step, whereas an expression for each row would be a dozen.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        numbers = [builder.load(at) for at in _places(context, builder, signature, args)]
        return context.make_tuple(builder, signature.return_type, numbers)

    return types.UniTuple(types.float64, len(rows))(array, first, stride, rows), codegen


@intrinsic(prefer_literal=True)
def write_rows(typingctx, array, first, stride, rows, numbers):  # type: ignore[no-untyped-def]
    """Write numbers, a tuple, to the places from which `read_rows` would read them."""

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kinds = signature.args[4]
        for i, at in enumerate(_places(context, builder, signature, args)):
            number = builder.extract_value(args[4], i)
            builder.store(context.cast(builder, number, kinds[i], signature.args[0].dtype), at)
        return context.get_dummy_value()

    return types.void(array, first, stride, rows, numbers), codegen


@intrinsic(prefer_literal=True)
def copy_rows(typingctx, array, first, stride, rows, size, table, column):  # type: ignore[no-untyped-def]
    """Copy ``array[first + (rows[0] + k) * stride + i]``, i < size, to ``table[k, column + i]``, k < rows[1].

    There are two loops, whatever the number of rows, because vector instructions for each row would take
    longer to compile. A loop that wrote all rows at once would have to check them for overlap.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        source = context.make_array(signature.args[0])(context, builder, args[0]).data
        made = context.make_array(signature.args[5])(context, builder, args[5])
        first, stride, size, column = (
            context.cast(builder, args[i], signature.args[i], types.uint64) for i in (1, 2, 4, 6)
        )
        begin, many = (_INT(row.literal_value) for row in signature.args[3])
        width = cgutils.unpack_tuple(builder, made.shape)[1]
        with cgutils.for_range(builder, many) as rows:
            row = builder.mul(builder.add(begin, rows.index), stride)
            read = builder.gep(source, [builder.add(first, row)])
            write = builder.gep(made.data, [builder.add(column, builder.mul(rows.index, width))])
            with cgutils.for_range(builder, size) as entries:
                number = builder.load(builder.gep(read, [entries.index]))
                number = context.cast(builder, number, types.float64, signature.args[5].dtype)
                builder.store(number, builder.gep(write, [entries.index]))
        return context.get_dummy_value()

    return types.void(array, first, stride, rows, size, table, column), codegen


def _places(context: Any, builder: ir.IRBuilder, signature: Any, args: Sequence) -> list[ir.Value]:
    array, *integers = signature.args[:3]
    data = context.make_array(array)(context, builder, args[0]).data
    first, stride = (
        context.cast(builder, value, kind, types.uint64)
        for value, kind in zip(args[1:3], integers, strict=True)
    )
    return [
        builder.gep(data, [builder.add(first, builder.mul(_INT(row.literal_value), stride))])
        for row in signature.args[3]
    ]


def at_address(name: str, arguments: int) -> Callable:
    """Return ``name(address, *arguments)`` for compiled code, which calls other compiled code at an address.

    The called code returns nothing and cannot fail.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = context.call_conv.get_function_type(types.none, signature.args[1:])
        # The places where Numba's functions put their result and their error.
        room = [cgutils.alloca_once(builder, pointer.pointee) for pointer in kind.args[:2]]
        given = context.get_arg_packer(signature.args[1:]).as_arguments(builder, args[1:])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), [*room, *given])
        return context.get_dummy_value()

    names = ", ".join(f"a{i}" for i in range(arguments))
    scope = {"answer": lambda *kinds: (types.void(types.int64, *kinds), codegen)}
    exec(f"def call(typingctx, address, {names}): return answer({names})", scope)
    function = intrinsic(scope["call"])
    function.__name__ = f"{name}_{arguments}"
    return function


@intrinsic
def wide_vectors(typingctx):  # type: ignore[no-untyped-def]
    """Ask for 512-bit vectors where the processor has them.

    On many such processors LLVM prefers 256 bits because code is usually mixed. These loops are pure
    arithmetic and run faster at full width. The bits of the result do not depend on the width.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        # llvmlite does not support string attributes, but prints whatever the set contains.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return ir.Constant(ir.IntType(8).as_pointer(), None)

    return types.void(), codegen


@njit(forceinline=True)
def aligned_zeros(count):  # type: ignore[no-untyped-def]
    """Return zeros that begin at the start of a cache line, so that each vector is on one line."""
    room = np.zeros(count + 7)
    return room[-(room.ctypes.data // 8) % 8 :][:count]


def block(operations: Sequence[Operation], inputs: Sequence[str], outputs: Sequence[Any]) -> Callable:
    """Return a function that carries out recorded operations, written directly in LLVM's language.

    Parameters
    ----------
    operations : sequence of Operation
        The operations.
    inputs : sequence of str
        The arguments, all float64.
    outputs : sequence of str or float
        The results to return, as a tuple.
    """
    boolean = {operation.name for operation in operations if operation.op in BOOLEAN}
    kinds = [types.boolean if o in boolean or isinstance(o, bool) else types.float64 for o in outputs]
    result = types.Tuple(kinds)

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        known = emit(builder, operations, dict(zip(inputs, args, strict=True)))
        results = [known[o] if isinstance(o, str) else _constant(o) for o in outputs]
        return context.make_tuple(builder, signature.return_type, results)

    # Numba wants the arguments by name.
    scope = {"answer": lambda: (result(*[types.float64] * len(inputs)), codegen)}
    exec(f"def block(typingctx, {', '.join(inputs)}): return answer()", scope)
    return intrinsic(scope["block"])


_DOUBLE = ir.DoubleType()
_INT = ir.IntType(64)


def emit(
    builder: ir.IRBuilder, operations: Iterable[Operation], values: dict[str, ir.Value]
) -> dict[str, ir.Value]:
    """Write recorded operations at the builder's position.

    Every lane of a vector goes through the same operations as a single number, and gets the same bits.

    Parameters
    ----------
    builder : llvmlite.ir.IRBuilder
        The builder that writes.
    operations : iterable of Operation
        The operations.
    values : dict of str to llvmlite.ir.Value
        The named values: doubles (truth values: i1), or vectors of them, all of one length. A single number
        combined with a vector stands for a vector of equal lanes. Results are added to this dict.

    Returns
    -------
    dict of str to llvmlite.ir.Value
        The values, results included.
    """
    for name, op, args in operations:
        known = [values[a] if isinstance(a, str) else _constant(a) for a in args]
        lanes = max((v.type.count for v in known if isinstance(v.type, ir.VectorType)), default=0)
        values[name] = _emit(builder, op, [splat(builder, v, lanes) for v in known] if lanes else known)
    return values


def _constant(value: Any) -> ir.Constant:
    return ir.Constant(ir.IntType(1), int(value)) if isinstance(value, bool) else ir.Constant(_DOUBLE, value)


def splat(b: ir.IRBuilder, value: ir.Value, lanes: int) -> ir.Value:
    """Return the vector whose lanes all equal this number; a vector is returned as it is."""
    if isinstance(value.type, ir.VectorType):
        return value
    kind = ir.VectorType(value.type, lanes)
    if isinstance(value, ir.Constant):
        return ir.Constant(kind, [value] * lanes)
    first = b.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [ir.IntType(32)(0)] * lanes)
    return b.shuffle_vector(first, first, zeros)


def _like(kind: ir.Type, value: Any, element: ir.Type = _DOUBLE) -> ir.Constant:
    """Return a constant with as many lanes as this type."""
    if isinstance(kind, ir.VectorType):
        return ir.Constant(ir.VectorType(element, kind.count), [ir.Constant(element, value)] * kind.count)
    return ir.Constant(element, value)


def call(b: ir.IRBuilder, function: str, *args: ir.Value) -> ir.Value:
    """Write a call of one of LLVM's own functions, on numbers or on vectors."""
    kind = args[0].type
    suffix = f"v{kind.count}f64" if isinstance(kind, ir.VectorType) else "f64"
    signature = ir.FunctionType(kind, [kind] * len(args))
    return b.call(b.module.declare_intrinsic(f"llvm.{function}.{suffix}", (), signature), args)


def _emit(b: ir.IRBuilder, op: str, args: list[ir.Value]) -> ir.Value:
    """Write one operation, on numbers or on vectors."""
    return {
        "+": b.fadd,
        "-": b.fsub,
        "*": b.fmul,
        "/": b.fdiv,
        "neg": b.fneg,
        "a*b+c": lambda x, y, z: call(b, "fma", x, y, z),
        "a*b-c": lambda x, y, z: call(b, "fma", x, y, b.fneg(z)),
        "c-a*b": lambda x, y, z: call(b, "fma", b.fneg(x), y, z),
        "<": lambda x, y: b.fcmp_ordered("<", x, y),
        "<=": lambda x, y: b.fcmp_ordered("<=", x, y),
        "where": b.select,
        "&": b.and_,
        "|": b.or_,
        "~": b.not_,
        "sqrt": lambda x: call(b, "sqrt", x),
        "sin": lambda x: call(b, "sin", x),
        "cos": lambda x: call(b, "cos", x),
        "log": lambda x: call(b, "log", x),
        "exp": lambda x: _exp(b, x),
        "abs": lambda x: call(b, "fabs", x),
        "floor": lambda x: call(b, "floor", x),
        "pow2": lambda n: _pow2(b, n),
        "exponent": lambda x: _exponent(b, x),
        "copysign": lambda x, sign: call(b, "copysign", x, sign),
    }[op](*args)


def _exp(b: ir.IRBuilder, x: ir.Value) -> ir.Value:
    """Write e**x to 1 ulp, clipped to |x| <= 700: arithmetic only, so that a loop with it becomes vectors."""

    def number(value: float) -> ir.Constant:
        return _like(x.type, value)

    def fma(x: ir.Value, y: ir.Value, z: ir.Value) -> ir.Value:
        return call(b, "fma", x, y, z)

    for limit, beyond in ((-700.0, "<"), (700.0, ">")):
        x = b.select(b.fcmp_ordered(beyond, x, number(limit)), number(limit), x)
    # x = n log 2 + r with |r| <= log(2)/2; log 2 in two parts.
    n = call(b, "floor", fma(x, number(1.4426950408889634), number(0.5)))
    r = fma(b.fneg(n), number(0.6931471803691238), x)
    r = fma(b.fneg(n), number(1.9082149292705877e-10), r)
    p = number(1.0 / math.factorial(13))
    for k in range(12, -1, -1):
        p = fma(p, r, number(1.0 / math.factorial(k)))
    return b.fmul(p, _pow2(b, n))


def _pow2(b: ir.IRBuilder, n: ir.Value) -> ir.Value:
    """Write 2**n: n + 1023 is put into the last bits of a sum and shifted into the exponent."""
    integers = _integers(n.type)
    biased = b.fadd(n, _like(n.type, MAGIC + 1023.0))
    return b.bitcast(b.shl(b.bitcast(biased, integers), _like(n.type, 52, _INT)), n.type)


def _exponent(b: ir.IRBuilder, x: ir.Value) -> ir.Value:
    """Write the exponent: its bits are put at the end of 2**52, then the bias is subtracted."""
    bits = b.lshr(b.bitcast(x, _integers(x.type)), _like(x.type, 52, _INT))
    bits = b.or_(b.and_(bits, _like(x.type, 0x7FF, _INT)), _like(x.type, 0x433 << 52, _INT))
    return b.fsub(b.bitcast(bits, x.type), _like(x.type, 2.0**52 + 1023.0))


def _integers(kind: ir.Type) -> ir.Type:
    return ir.VectorType(_INT, kind.count) if isinstance(kind, ir.VectorType) else _INT


_REFUSED_BITS = np.uint64(0x7FF8_0000_5EF0_5ED0)
#: What a batch gives as the reward of a step that was refused: NaN, with bits that no computation gives. A
#: task's own reward may be NaN too.
REFUSED = float(_REFUSED_BITS.view(np.float64))


def is_refused(rewards: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return where a reward is `REFUSED`."""
    return rewards.view(np.uint64) == _REFUSED_BITS


#: Names that the source of a compiled function may use.
NAMES = {
    "np": np,
    "math": math,
    "REFUSED": REFUSED,
    "fma": fma,
    "select": select,
    "read_rows": read_rows,
    "write_rows": write_rows,
    "copy_rows": copy_rows,
    "wide_vectors": wide_vectors,
    "aligned_zeros": aligned_zeros,
    "address": address,
    "moved": moved,
    "atomic_load": atomic_load,
    "atomic_store": atomic_store,
    "atomic_add": atomic_add,
    "atomic_max": atomic_max,
    "atomic_replace": atomic_replace,
    "uniform": uniform,
    "episode_key": episode_key,
}
