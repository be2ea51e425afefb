"""Prints the step of `lag_envs.stepping.series` to machine code, for one lane or for several."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.extending import intrinsic

from lag_envs.mechanics import algebra
from lag_envs.stepping import (
    backward,
    certificate,
    dual,
    elementary,
    lowering,
    matrices,
    primitives,
    series,
    slots,
    target,
    tracing,
)
from lag_envs.stepping.backward import Backward
from lag_envs.stepping.compiling import BLOCK, compile_function
from lag_envs.stepping.dual import DualTarget
from lag_envs.stepping.lowering import ELAPSED, SeriesRecord
from lag_envs.stepping.primitives import emit
from lag_envs.stepping.series import STRIDE, Series, StepProgress, following

_DOUBLE, _INT, _BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(1)


class LaneLayout:
    """The places of the numbers of a lane: rows that lie one behind the other or `BLOCK` numbers apart.

    Attributes
    ----------
    inputs : dict of str to int
        Inputs by name.
    q, v : int
        The first place and the first velocity.
    status : int
        The number of attempts, negative where the lane is not stepped.
    left, wish, span : int
        What is left of the control step (0 when it is done), the length wished for the next substep, and the
        length of the control step [s].
    bounds : int
        Sums of the bounds on what places and velocities leave out; only a single lane may have them.
    rows : int
        Number of rows.
    """

    def __init__(self, record: SeriesRecord) -> None:
        n = record.size
        self.inputs = {name: i for i, name in enumerate(record.given)}
        self.q = len(self.inputs)
        self.v, self.status = self.q + n, self.q + 2 * n
        self.left, self.wish, self.span = (self.status + i for i in (1, 2, 3))
        self.bounds = self.span + 1
        self.rows = self.bounds + 2 * n


class Registers(NamedTuple):
    """The number of the processor's vector registers, and the number of doubles that each of them holds."""

    number: int
    doubles: int


@cache
def registers() -> Registers:
    """Return the vector registers of this processor."""
    features = get_host_cpu_features()
    if features.get("avx512f"):
        return Registers(32, 8)
    if features.get("avx2"):
        return Registers(16, 4)
    return Registers(32 if features.get("neon") else 16, 2)


class Machine:
    """The target that writes LLVM's language: numbers are doubles, or vectors of them."""

    def __init__(self, builder: ir.IRBuilder, entries: int, lanes: int, fused: bool) -> None:
        self._b, self._fused = builder, fused
        self.kind = _DOUBLE if lanes == 1 else ir.VectorType(_DOUBLE, lanes)
        self._lanes = lanes
        # A product takes four numbers: two sums and two factors. Numbers that find no register go to memory.
        self.group = max(2, registers().number // (4 * -(-lanes // registers().doubles)))
        memory = builder.alloca(self.kind, entries)
        memory.align = 8 * lanes
        self._memory = memory

    def number(self, value: float) -> ir.Value:
        constant = ir.Constant(_DOUBLE, value)
        return constant if self._lanes == 1 else ir.Constant(self.kind, [constant] * self._lanes)

    def add(self, a: Any, b: Any) -> ir.Value:
        return self._b.fadd(a, b)

    def sub(self, a: Any, b: Any) -> ir.Value:
        return self._b.fsub(a, b)

    def mul(self, a: Any, b: Any) -> ir.Value:
        return self._b.fmul(a, b)

    def div(self, a: Any, b: Any) -> ir.Value:
        return self._b.fdiv(a, b)

    def fma(self, a: Any, b: Any, c: Any) -> ir.Value:
        if not self._fused:
            return self._b.fadd(self._b.fmul(a, b), c)
        return primitives.call(self._b, "fma", a, b, c)

    def neg(self, a: Any) -> ir.Value:
        return self._b.fneg(a)

    def abs(self, a: Any) -> ir.Value:
        return primitives.call(self._b, "fabs", a)

    def sqrt(self, a: Any) -> ir.Value:
        return primitives.call(self._b, "sqrt", a)

    def less(self, a: Any, b: Any) -> ir.Value:
        return self._b.fcmp_ordered("<", a, b)

    def both(self, a: Any, b: Any) -> ir.Value:
        return self._b.and_(a, b)

    def select(self, condition: Any, a: Any, b: Any) -> ir.Value:
        return self._b.select(condition, a, b)

    def either(self, a: Any, b: Any) -> ir.Value:
        return self._b.or_(a, b)

    def all(self, condition: Any) -> ir.Value:
        if self._lanes == 1:
            return condition
        kind = ir.IntType(self._lanes)
        return self._b.icmp_unsigned("==", self._b.bitcast(condition, kind), ir.Constant(kind, -1))

    def negated(self, condition: Any) -> ir.Value:
        return self._b.not_(condition)

    def real(self, k: Any) -> ir.Value:
        return self.broadcast(self._b.sitofp(k, _DOUBLE))

    def reciprocal(self, k: Any) -> ir.Value:
        table = self._b.module.globals.get("reciprocals")
        if table is None:
            values = [ir.Constant(_DOUBLE, 1.0 / max(i, 1)) for i in range(STRIDE + 1)]
            kind = ir.ArrayType(_DOUBLE, len(values))
            table = ir.GlobalVariable(self._b.module, kind, "reciprocals")
            table.linkage, table.global_constant = "internal", True
            table.initializer = ir.Constant(kind, values)
        return self.broadcast(self._b.load(self._b.gep(table, [ir.Constant(_INT, 0), k])))

    def broadcast(self, value: Any) -> ir.Value:
        return value if self._lanes == 1 else primitives.splat(self._b, value, self._lanes)

    def index(self, k: int) -> ir.Value:
        return ir.Constant(_INT, k)

    def plus(self, k: Any, n: int) -> ir.Value:
        if isinstance(k, ir.Constant):
            return ir.Constant(_INT, k.constant + n)
        return self._b.add(k, ir.Constant(_INT, n))

    def minus(self, a: Any, b: Any) -> ir.Value:
        if isinstance(a, ir.Constant) and isinstance(b, ir.Constant):
            return ir.Constant(_INT, a.constant - b.constant)
        return self._b.sub(a, b)

    def half(self, k: Any) -> ir.Value:
        if isinstance(k, ir.Constant):
            return ir.Constant(_INT, k.constant // 2)
        return self._b.lshr(k, ir.Constant(_INT, 1))

    def below(self, a: Any, b: Any) -> ir.Value:
        return self._b.icmp_signed("<", a, b)

    def _at(self, slot: int, k: Any) -> ir.Value:
        return self._b.gep(self._memory, [self.plus(k, slot * STRIDE)])

    def load(self, slot: int, k: Any) -> ir.Value:
        return self._b.load(self._at(slot, k))

    def store(self, slot: int, k: Any, value: Any) -> None:
        self._b.store(value, self._at(slot, k))

    def aside(self, values: Sequence) -> Callable[[], list]:
        # Without this, LLVM keeps the results of a loop in registers, and spills the next loop's own sums.
        b, void = self._b, ir.VoidType()
        with b.goto_entry_block():
            places = b.alloca(self.kind, len(values))
            places.align = 8 * self._lanes
        at = [b.gep(places, [ir.Constant(_INT, i)]) for i in range(len(values))]
        for place, value in zip(at, values, strict=True):
            b.store(value, place)
        # As far as LLVM knows, this changes the memory at that place; it generates no instruction.
        kind = ir.FunctionType(void, [places.type])
        b.call(ir.InlineAsm(kind, "", "r,~{memory}", side_effect=True), [places])
        return lambda: [b.load(place) for place in at]

    def loop(self, first: Any, end: Any, carried: Sequence, body: Callable, step: int = 1) -> list:
        if isinstance(first, ir.Constant) and isinstance(end, ir.Constant):  # for a fixed order
            values = list(carried)
            for k in range(first.constant, end.constant, step):
                values = body(ir.Constant(_INT, k), values)
            return values
        b = self._b
        start = b.basic_block
        head, inside, after = (b.append_basic_block(name) for name in ("head", "inside", "after"))
        b.branch(head)
        b.position_at_end(head)
        k, phis = self._phis(start, first, carried)
        b.cbranch(self.below(k, end), inside, after)
        b.position_at_end(inside)
        self._again(k, phis, body(k, list(phis)), step)
        b.branch(head).set_metadata("llvm.loop", self._as_written())
        b.position_at_end(after)
        return phis

    def repeat(self, times: int, carried: Sequence, body: Callable) -> list:
        b = self._b
        start = b.basic_block
        head, after = (b.append_basic_block(name) for name in ("head", "after"))
        b.branch(head)
        b.position_at_end(head)
        k, phis = self._phis(start, self.index(0), carried)
        going, values = body(k, list(phis))
        self._again(k, phis, values, 1)
        b.cbranch(b.and_(going, self.below(k, self.index(times - 1))), head, after)
        b.position_at_end(after)
        return values

    def _as_written(self) -> ir.MDValue:
        """Return the request not to unroll a loop: the loops are short, and long code compiles slowly."""
        module = self._b.module
        unrolled = module.add_metadata([ir.MetaDataString(module, "llvm.loop.unroll.disable")])
        off = ir.Constant(_BIT, 0)
        vectors = module.add_metadata([ir.MetaDataString(module, "llvm.loop.vectorize.enable"), off])
        loop = module.add_metadata([unrolled, ir.Constant(_INT, len(module.metadata))])
        loop.operands = (loop, unrolled, vectors)  # a loop's first operand is itself
        return loop

    def _phis(self, start: ir.Block, first: Any, carried: Sequence) -> tuple[ir.Value, list]:
        k = self._b.phi(_INT)
        k.add_incoming(first, start)
        phis = [self._b.phi(value.type) for value in carried]
        for phi, value in zip(phis, carried, strict=True):
            phi.add_incoming(value, start)
        return k, phis

    def _again(self, k: Any, phis: Sequence, values: Sequence, step: int) -> None:
        k.add_incoming(self._b.add(k, ir.Constant(_INT, step)), self._b.basic_block)
        for phi, value in zip(phis, values, strict=True):
            phi.add_incoming(value, self._b.basic_block)

    def when(self, condition: Any, body: Callable, otherwise: Sequence) -> list:
        b = self._b
        start = b.basic_block
        with b.if_then(condition):
            values = body()
            last = b.basic_block
        phis = [b.phi(value.type) for value in otherwise]
        for phi, value, other in zip(phis, values, otherwise, strict=True):
            phi.add_incoming(value, last)
            phi.add_incoming(other, start)
        return phis

    def elementary(self, name: str, x: Any) -> ir.Value:
        operations, result = target.elementary(name, self._fused)
        return emit(self._b, operations, {"x": x})[result]

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]:
        return emit(self._b, record.scalars, dict(inputs))


@cache
def _version() -> str:
    """Return a digest of all that decides what is printed: this code, registers, and the length of rows."""
    modules = (
        *(algebra, backward, certificate, dual, elementary, lowering, matrices, primitives),
        *(series, slots, target, tracing),
    )
    source = "".join(inspect.getsource(module) for module in modules) + inspect.getsource(
        sys.modules[__name__]
    )
    return hashlib.sha256(f"{source}{registers()}{BLOCK}".encode()).hexdigest()


def _linked(name: str, kind: ir.FunctionType, write: Callable) -> Callable:
    """Return a function for compiled code whose code exists only once, in a module of its own.

    Callers are linked with this function when they are loaded. Numba itself would put a copy into every
    caller, and into the callers' callers, and compile them all.

    Parameters
    ----------
    name : str
        The function's name.
    kind : ir.FunctionType
        Its type; the first argument is a pointer. Compiled code gives an array and an index in its place.
    write : callable
        Writes the function into a module.
    """
    known = {_DOUBLE: types.float64, _INT: types.int64, ir.VoidType(): types.void}
    arguments = ", ".join(["rows", "at", *(f"a{i}" for i in range(len(kind.args) - 1))])
    result, rest = known[kind.return_type], [known[a] for a in kind.args[1:]]

    def called(declare: Callable) -> Callable:
        def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> Any:
            array = context.make_array(signature.args[0])(context, builder, args[0])
            function = builder.module.globals.get(name) or declare(builder.module)
            value = builder.call(function, [builder.gep(array.data, [args[1]]), *args[2:]])
            return context.get_dummy_value() if result is types.void else value

        # Numba wants the arguments by name.
        scope = {"answer": lambda rows: (result(rows, types.int64, *rest), codegen)}
        exec(f"def function(typingctx, {arguments}): return answer(rows)", scope)
        function = intrinsic(scope["function"])
        function.__name__ = name
        return function

    short = name.rsplit("_", 1)[0]
    source = f"def hold({arguments}):\n    return {short}({arguments})\n"
    holder: Any = compile_function("hold", source, called(lambda module: write(module, name)), inner=True)
    holder.compile((types.float64[::1], types.int64, *rest))
    function: Any = called(lambda module: ir.Function(module, kind, name))
    function.holder = holder  # keeps the code in memory
    return function


@cache
def compile_attempt(
    record: SeriesRecord,
    lanes: int,
    fused: bool = True,
    fixed_order: int | None = None,
    bounds: bool = False,
) -> Callable:
    """Return ``attempt(rows, at, order, tolerance)``, to be called from compiled code.

    It takes a step of each lane for which something is left, of the length that is wished for or of a part of
    it, and replaces places, velocities, status, `left` and `wish` in the rows of `LaneLayout`, which begin at
    ``rows[at]``. It returns 1 where nothing is left, else 0. See `Series.substep`.

    Parameters
    ----------
    record : SeriesRecord
        What is stepped.
    lanes : int
        How many steps are taken at once. A row is one number for a single lane, and `BLOCK` numbers for
        several lanes.
    fused : bool, default True
        Whether fused multiply-adds are used. Without them the bits are those of any other language's doubles.
    fixed_order : int, optional
        The only order for which the function is called. All loops over orders are then written out. The bits
        are the same. It pays for low orders: the code grows with the square of the order.
    bounds : bool, default False
        Whether the attempt's bounds are added to the rows `bounds` of its only lane.
    """
    digest = hashlib.sha256(
        f"{_version()} {record.digest} {lanes} {fused} {fixed_order} {bounds}".encode()
    ).hexdigest()[:16]
    kind = ir.FunctionType(_INT, [_DOUBLE.as_pointer(), _INT, _DOUBLE])
    return _linked(
        f"attempt_{digest}",
        kind,
        lambda module, name: _write(module, name, kind, record, lanes, fused, fixed_order, bounds),
    )


def _write(
    module: ir.Module,
    name: str,
    kind: ir.FunctionType,
    record: SeriesRecord,
    lanes: int,
    fused: bool,
    fixed_order: int | None = None,
    bounds: bool = False,
) -> ir.Function:
    """Write the function ``name(rows, order, tolerance)`` into a module."""
    step, layout, n = Series(record), LaneLayout(record), record.size
    function = ir.Function(module, kind, name)
    set.add(function.attributes, "noinline")
    set.add(function.attributes, '"prefer-vector-width"="512"')
    rows, order, tolerance = function.args
    if fixed_order is not None:
        order = ir.Constant(_INT, fixed_order)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    t = Machine(builder, step.slots * STRIDE, lanes, fused)
    apart = 1 if lanes == 1 else BLOCK

    def pointer(row: int) -> ir.Value:
        return builder.bitcast(builder.gep(rows, [ir.Constant(_INT, row * apart)]), t.kind.as_pointer())

    def read(row: int) -> ir.Value:
        value = builder.load(pointer(row))
        value.align = 8
        return value

    def write(row: int, value: ir.Value) -> None:
        builder.store(value, pointer(row)).align = 8

    inputs = {name: read(row) for name, row in layout.inputs.items()}
    q, v = ([read(first + i) for i in range(n)] for first in (layout.q, layout.v))
    before = StepProgress(q, v, read(layout.status), read(layout.left), read(layout.wish))
    lane, left_out = step.substep(t, inputs, before, read(layout.span), order, t.broadcast(tolerance))
    for i in range(n):
        write(layout.q + i, lane.q[i])
        write(layout.v + i, lane.v[i])
    write(layout.status, lane.attempts)
    write(layout.left, lane.left)
    write(layout.wish, lane.wish)
    if bounds:
        for row, bound in enumerate(left_out, layout.bounds):
            write(row, t.add(read(row), bound))
    over = t.all(t.negated(t.less(t.number(0.0), lane.left)))
    builder.ret(builder.zext(over, _INT))
    return function


def slots_for(columns: int) -> int:
    """Return how many numbers a row of derivatives takes: whole vectors."""
    return 1 << max(columns - 1, 0).bit_length()


def compile_series_tangent(record: SeriesRecord, columns: tuple[str, ...]) -> Callable:
    """Return ``tangent(rows, at, order)``: a step of given length and its derivatives, for compiled code.

    The rows are inputs, places and velocities as in `LaneLayout`, the time since the control step began, the
    step, and then the derivatives of the places and velocities by `columns`, as a matrix with `slots_for`
    columns. Places, velocities and the matrix are replaced by those after the step. Behind the matrix lie an
    estimate of what each column leaves out, and the columns' sizes, in two rows.

    Parameters
    ----------
    record : SeriesRecord
        What is stepped, made with tangents.
    columns : tuple of str
        The variables of the derivatives: places, velocities, and names in the record's tangents.
    """
    digest = hashlib.sha256(f"{_version()} {record.digest} {columns} tangent".encode()).hexdigest()[:16]
    kind = ir.FunctionType(ir.VoidType(), [_DOUBLE.as_pointer(), _INT])
    return _linked(
        f"tangent_{digest}", kind, lambda module, name: _write_tangent(module, name, kind, record, columns)
    )


def _write_tangent(
    module: ir.Module, name: str, kind: ir.FunctionType, record: SeriesRecord, columns: tuple[str, ...]
) -> ir.Function:
    """Write the function ``name(rows, order)`` into a module."""
    step, layout, n = Series(record), LaneLayout(record), record.size
    width, matrix = slots_for(len(columns)), layout.status + 2
    function = ir.Function(module, kind, name)
    set.add(function.attributes, '"prefer-vector-width"="512"')
    rows, order = function.args
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    plain, wide = (Machine(builder, step.slots * STRIDE, lanes, True) for lanes in (1, width))

    def unit(column: int) -> Any:
        numbers = [ir.Constant(_DOUBLE, float(i == column)) for i in range(width)]
        return numbers[0] if width == 1 else ir.Constant(wide.kind, numbers)

    tangents = {source: unit(i) for i, source in enumerate(columns)}
    t: Any = DualTarget(plain, wide, wide.broadcast, tangents)

    def at(row: int) -> ir.Value:
        return builder.gep(rows, [ir.Constant(_INT, row)])

    def slopes(i: int) -> ir.Value:
        return builder.bitcast(at(matrix + i * width), wide.kind.as_pointer())

    def moving(row: int, i: int) -> dual.DualNumber:
        derivatives = builder.load(slopes(i))
        derivatives.align = 8
        return dual.DualNumber(builder.load(at(row)), derivatives)

    inputs = {name: dual.DualNumber(builder.load(at(row))) for name, row in layout.inputs.items()}
    inputs[ELAPSED] = dual.DualNumber(builder.load(at(layout.status)))
    q = [moving(layout.q + i, i) for i in range(n)]
    v = [moving(layout.v + i, n + i) for i in range(n)]
    h = dual.DualNumber(builder.load(at(layout.status + 1)))
    step.expand(t, inputs, q, v, h, order)
    columns_of = [number.slopes for number in (*q, *v)]
    q, v = step.advance(t, q, h, order)
    columns_of += [number.slopes for number in (*q, *v)]
    for i, number in enumerate([*q, *v]):
        builder.store(number.value, at(layout.q + i))
        builder.store(wide.number(0.0) if number.slopes is None else number.slopes, slopes(i)).align = 8

    def largest(numbers: Sequence, least: float) -> Any:
        total = wide.number(least)
        for x in numbers:
            total = wide.select(wide.less(total, wide.abs(x)), wide.abs(x), total)
        return total

    first, per_order = following(wide, order)

    def weigh(k: Any, carried: Sequence) -> list:
        terms = (wide.abs(wide.load(step.slot_of["v", i], k)) for i in range(n))
        return [wide.fma(total, per_order, x) for total, x in zip(carried, terms, strict=True)]

    weighed = plain.loop(plain.index(0), plain.plus(order, 1), [wide.number(0.0)] * n, weigh)
    rest = wide.mul(first, largest(weighed, 0.0))
    size = largest([x for x in columns_of if x is not None], 1e-280)
    builder.store(rest, slopes(2 * n)).align = 8
    builder.store(size, slopes(2 * n + 1)).align = 8
    builder.ret_void()
    return function


def compile_vjp(record: SeriesRecord, sources: tuple[str, ...], lanes: int) -> Callable:
    """Return ``vjp(rows, at, dt, order)``: a substep backwards, for compiled code.

    Rows are `BLOCK` numbers apart: those of `LaneLayout` up to `span` after the substep, with its length in
    `wish`, then cotangents of places and velocities after the substep, and of the sources. The cotangents are
    replaced by those before the substep. An estimate of what they leave out, relative to them, follows.

    Parameters
    ----------
    record : SeriesRecord
        What is stepped, made with tangents.
    sources : tuple of str
        See `Backward`.
    lanes : int
        How many steps are taken at once.
    """
    digest = hashlib.sha256(f"{_version()} {record.digest} {sources} {lanes} vjp".encode()).hexdigest()[:16]
    kind = ir.FunctionType(ir.VoidType(), [_DOUBLE.as_pointer(), _DOUBLE, _INT])
    return _linked(
        f"vjp_{digest}", kind, lambda module, name: _write_vjp(module, name, kind, record, sources, lanes)
    )


def _write_vjp(
    module: ir.Module, name: str, kind: ir.FunctionType, record: SeriesRecord, sources: tuple, lanes: int
) -> ir.Function:
    """Write the function ``name(rows, dt, order)`` into a module."""
    step, layout, n = Backward(record, sources), LaneLayout(record), record.size
    function = ir.Function(module, kind, name)
    set.add(function.attributes, "noinline")
    set.add(function.attributes, '"prefer-vector-width"="512"')
    rows, dt, order = function.args
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    t = Machine(builder, step.entries, lanes, True)

    def pointer(row: int) -> ir.Value:
        return builder.bitcast(builder.gep(rows, [ir.Constant(_INT, row * BLOCK)]), t.kind.as_pointer())

    def read(row: int) -> ir.Value:
        value = builder.load(pointer(row))
        value.align = 8
        return value

    inputs = {name: read(row) for name, row in layout.inputs.items()}
    q, v = ([read(first + i) for i in range(n)] for first in (layout.q, layout.v))
    end = StepProgress(q, v, read(layout.status), read(layout.left), read(layout.wish))
    bars = [read(layout.bounds + i) for i in range(2 * n + len(sources))]
    for row, value in enumerate(step.vjp(t, inputs, end, t.broadcast(dt), order, bars), layout.bounds):
        builder.store(value, pointer(row)).align = 8
    builder.ret_void()
    return function
