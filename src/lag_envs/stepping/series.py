"""One step of any equations of motion by Taylor series, with a proved bound on what the series leaves out.

The algorithm stands here once, written for a `Target`: something that adds and multiplies, keeps series in
numbered slots and runs loops. Targets print it to machine code (`lag_envs.stepping.machine`) or carry it out
on Python numbers (`Plain`).

**Series.** Let h be the step and t = hτ. The coefficients in τ of all nodes of the record follow order by
order (sums termwise, products by convolution, functions by z' = w x'), with q_{k+1} = h v_k/(k+1), v_{k+1}
= h a_k/(k+1), and the accelerations from::

    M_0 a_k = r_k - Σ_{j=1..k} M_j a_{k-j}

with M_0⁻¹ found once, as numbers. docs/engine.md derives all of this.

**Certificate.** |x| is the sum of absolute coefficients, E_x a bound on the sum of those of order N and
above. Known are the coefficients below N of every node, and v_N. Suppose that the velocities' beyond N sum
up to E_v at most. Then tails follow node by node, see `Certificate`. With R the tail of r - Ma, a cut after
N - 1, the step is accepted if for some E_a > 0::

    |M_0⁻¹| (R + |M - M_0| E_a) < E_a  (strictly, in every row)     and     hE_a/(N+1) <= E_v.

Proof: v_{k+1} = h a_k/(k+1), and a_k depends on coefficients up to order k only. So if the partial sums of
the tails up to k obey E_v and E_a, those up to k + 1 do; they stay bounded, so the series converges on the
whole step and is the solution. That the inequality is strict makes M invertible throughout. What is proved is
the truncation of each substep: rounding comes on top, and what the flow makes of earlier errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple, Protocol

from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.lowering import ELAPSED, FUNCTIONS, KNOWN, Node, SeriesRecord
from lag_envs.stepping.tracing import MAGIC, Operation, evaluate_operations

#: The orders that a series may have.
SMALLEST_ORDER, LARGEST_ORDER = 4, 24

#: What a substep's truncation may be, relative to the size of the velocities.
TOLERANCE = 1e-14
#: Sizes below this count as this: √(kg m²) m/s or what the mass matrix's units make of it.
SMALLEST_SIZE = 1e-12
#: While a control that lags is still far from its command, a substep is at most this many time constants.
REACH = 2.0
#: Numbers that are set aside for one series: a velocity has N + 1, and one more where N is odd.
STRIDE = LARGEST_ORDER + 3
#: How often a step is shortened before it counts as failed.
TRIES = 4
#: How many sums run side by side in one loop: enough to keep the processor busy, few enough for its
#: registers.
GROUP = 8


def check_order(name: str, value: Any) -> int:
    """Return an order that a task may choose, or raise a ValueError; below 6 no step would be worth it."""
    if type(value) is not int or not 6 <= value <= LARGEST_ORDER:
        raise ValueError(f"{name} must be a whole number from 6 to {LARGEST_ORDER}, got {value!r:.60}")
    return value


def _rough_log2(x: Any, xp: Any) -> Any:
    """Return the logarithm of x to the base 2, to 0.01."""
    n = xp.exponent(x)
    rest = x * xp.pow2(-n) - 1.0
    return n + rest * (1.3465 - 0.3465 * rest)


def _rough_exp2(x: Any, xp: Any) -> Any:
    """Return 2**x, to 0.3 %."""
    n = (x - 0.5 + MAGIC) - MAGIC
    rest = x - n
    return xp.pow2(n) * (1.0 + rest * (0.6565 + 0.3435 * rest))


_OTHERS = {"rough log2": _rough_log2, "rough exp2": _rough_exp2}


@cache
def elementary(name: str, fused: bool) -> tuple[tuple[Operation, ...], str]:
    """Return the operations of an elementary function of ``x``, and the name of their result."""
    trace = ElementaryTrace()
    (x,) = trace.inputs("x")
    value = _OTHERS[name](x, trace) if name in _OTHERS else getattr(trace, name)(x)
    operations, (result,) = trace.operations([value], fused=fused)
    assert isinstance(result, str)
    return tuple(operations), result


class Target(Protocol):
    """Numbers, slots and loops; see `Plain`, the simplest one. An index is a whole number."""

    def number(self, value: float) -> Any: ...
    def add(self, a: Any, b: Any) -> Any: ...
    def sub(self, a: Any, b: Any) -> Any: ...
    def mul(self, a: Any, b: Any) -> Any: ...
    def div(self, a: Any, b: Any) -> Any: ...
    def fma(self, a: Any, b: Any, c: Any) -> Any: ...
    def neg(self, a: Any) -> Any: ...
    def abs(self, a: Any) -> Any: ...
    def sqrt(self, a: Any) -> Any: ...
    def less(self, a: Any, b: Any) -> Any: ...
    def both(self, a: Any, b: Any) -> Any: ...
    def select(self, condition: Any, a: Any, b: Any) -> Any: ...
    def either(self, a: Any, b: Any) -> Any: ...
    def all(self, condition: Any) -> Any: ...
    def negated(self, condition: Any) -> Any: ...
    def real(self, k: Any) -> Any: ...
    def reciprocal(self, k: Any) -> Any: ...
    def index(self, k: int) -> Any: ...
    def plus(self, k: Any, n: int) -> Any: ...
    def minus(self, a: Any, b: Any) -> Any: ...
    def half(self, k: Any) -> Any: ...
    def below(self, a: Any, b: Any) -> Any: ...
    def load(self, slot: int, k: Any) -> Any: ...
    def store(self, slot: int, k: Any, value: Any) -> None: ...
    def loop(self, first: Any, end: Any, carried: Sequence, body: Callable, step: int = 1) -> list: ...
    def repeat(self, times: int, carried: Sequence, body: Callable) -> list: ...
    def when(self, condition: Any, body: Callable, otherwise: Sequence) -> list: ...
    def elementary(self, name: str, x: Any) -> Any: ...
    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]: ...


class Factor(NamedTuple):
    """A factor of a convolution: its coefficient of order k is entry k - back of a slot."""

    slot: int
    back: int = 0

    def load(self, t: Target, k: Any) -> Any:
        """Return the coefficient of order k."""
        return t.load(self.slot, t.plus(k, -self.back))


class ExpansionStart(NamedTuple):
    """What an expansion knows beside its slots: coefficients of order 0, the inverse of M_0, weights."""

    zero: dict[int, Any]
    inverse: Inverse
    scalars: dict[str, Any]


class StepProgress(NamedTuple):
    """A control step on its way.

    Attributes
    ----------
    q, v : sequence of number
        Places and velocities.
    status : number
        Number of attempts so far.
    left : number
        What is left of the step [s]; 0 where it is done.
    wish : number
        The substep that is to be tried next [s].
    """

    q: Sequence
    v: Sequence
    status: Any
    left: Any
    wish: Any


class Series:
    """The step of a record.

    Parameters
    ----------
    record : SeriesRecord
        What is to be computed.
    """

    def __init__(self, record: SeriesRecord) -> None:
        self.record, self.size = record, record.size
        self._slots: dict[tuple[str, int], int] = {}
        #: Nodes of which more than the value is needed.
        self._live = self._find_live()
        #: Products of series, by what needs them: a node or a place (i, j) in the mass matrix.
        self._pairs: dict[Any, tuple[Factor, Factor]] = {}
        for i in range(self.size):
            self._slot("v", i)
        for n in self._live:
            self._plan(n, record.nodes[n])
        for (i, j), (node, _, _) in record.mass.items():
            if node >= 0:
                for row, column in {(i, j), (j, i)}:
                    self._pairs[row, column] = self._factor(node), Factor(self._slot("a", column))
        self._distinct = list(dict.fromkeys(self._pairs.values()))
        #: For each node 1 - tanh² that is the slope of a tanh, the node of its argument.
        self._slopes_of_tanh = {x.args[1]: x.args[0] for x in record.nodes if x.op == "tanh"}
        #: Number of series that are kept.
        self.slots = len(self._slots)

    # --- which series are kept -----------------------------------------------------------------------------

    def _find_live(self) -> list[int]:
        found: set[int] = set()
        pending = [*self.record.force, *(node for node, _, _ in self.record.mass.values())]
        while pending:
            n = pending.pop()
            if n >= 0 and n not in found:
                found.add(n)
                node = self.record.nodes[n]
                pending += node.args[1:] if node.op in FUNCTIONS and len(node.args) > 2 else node.args
        return sorted(found)

    def _slot(self, kind: str, i: int) -> int:
        if (kind, i) not in self._slots:
            assert not hasattr(self, "slots"), f"nobody planned for {kind}{i}"
            self._slots[kind, i] = len(self._slots)
        return self._slots[kind, i]

    def _factor(self, n: int) -> Factor:
        """Return where a node's coefficients are."""
        node = self.record.nodes[n]
        return Factor(self._slot("v", node.index) if node.op == "velocity" else self._slot("x", n))

    def _slope(self, n: int) -> Factor:
        """Return where D_k = k x_k of a function's argument x is."""
        args = self.record.nodes[n].args
        if len(args) > 2:
            return Factor(self._factor(args[2]).slot, back=1)
        return Factor(self._slot("d", args[0]))

    def _plan(self, n: int, node: Node) -> None:
        if node.op == "product":
            self._pairs[n] = self._factor(node.args[0]), self._factor(node.args[1])
        elif node.op == "reciprocal":
            self._pairs[n] = self._factor(node.args[0]), self._factor(n)
        elif node.op == "sqrt":
            self._pairs[n] = self._factor(n), self._factor(n)
        elif node.op in FUNCTIONS:
            self._pairs[n] = self._slope(n), self._factor(node.args[1])
        elif node.op in KNOWN:
            self._factor(n)

    # --- the series ----------------------------------------------------------------------------------------

    def expand(
        self, t: Target, inputs: dict[str, Any], q: Sequence, v: Sequence, h: Any, order: Any
    ) -> ExpansionStart:
        """Fill the slots with coefficients: velocities up to the order N, the rest below N.

        Parameters
        ----------
        t : Target
            Where to.
        inputs : dict
            Constants, controls and starts of moving prescribed coordinates, by name.
        q, v : sequence of number
            Places and velocities of the free coordinates.
        h : number
            The step.
        order : index
            N.
        """
        record, zero = self.record, t.number(0.0)
        scalars = t.scalars(record, inputs)
        known: dict[int, Any] = {}
        halves: dict[int, Any] = {}
        for n, node in enumerate(record.nodes):
            known[n] = self._first(t, n, known, scalars, q, v)
            self._keep(t, n, t.index(0), known[n])
            if ("d", n) in self._slots:
                t.store(self._slots["d", n], t.index(0), zero)
            if node.op == "sqrt":
                halves[n] = t.div(t.number(0.5), known[n])
            if node.op in KNOWN and n in self._live:
                self._lay_out(t, n, node, scalars, h, order)
        for i in range(self.size):
            t.store(self._slots["v", i], t.index(0), v[i])
        matrix = {place: self._entry(t, known, scalars, *entry) for place, entry in record.mass.items()}
        inverse = Inverse(t, matrix, self.size)
        start = ExpansionStart(known, inverse, scalars)
        right = [known[f] if f >= 0 else None for f in record.force]
        rates = self._accelerate(t, inverse, right, h, t.index(0))

        def two_orders(k: Any, carried: Sequence) -> list:
            sums = self._convolve(t, k)
            self._one_order(t, start, halves, rates, h, k, lambda pair: sums[pair][0])
            self._one_order(
                t, start, halves, rates, h, t.plus(k, 1), lambda pair: self._newest(t, k, pair, sums[pair][1])
            )
            return []

        self._one_order(t, start, halves, rates, h, t.index(1), lambda pair: None)
        t.loop(t.index(2), order, [], two_orders, step=2)
        return start

    def _keep(self, t: Target, n: int, k: Any, value: Any) -> None:
        if ("x", n) in self._slots:
            t.store(self._slots["x", n], k, value)

    def _entry(self, t: Target, values: dict, scalars: dict, node: int, weight: Any, constant: Any) -> Any:
        """Return an entry of the mass matrix."""
        if node < 0:
            return self._weight(t, scalars, constant)
        value = values[node]
        if weight != 1.0 and constant != 0.0:
            return t.fma(self._weight(t, scalars, weight), value, self._weight(t, scalars, constant))
        if weight != 1.0:
            return t.mul(self._weight(t, scalars, weight), value)
        return value if constant == 0.0 else t.add(value, self._weight(t, scalars, constant))

    def _weight(self, t: Target, scalars: dict[str, Any], weight: Any) -> Any:
        return scalars[weight] if isinstance(weight, str) else t.number(weight)

    def _lay_out(self, t: Target, n: int, node: Node, scalars: dict, h: Any, order: Any) -> None:
        """Store the coefficients of a series that is known, up to the order N."""
        if node.op == "decay":
            self._lay_out_decay(t, n, node, scalars, h, order)
            return
        slot, power = self._slots["x", n], h
        zero = t.number(0.0)

        def clear(k: Any, carried: Sequence) -> list:
            t.store(slot, k, zero)
            return []

        t.loop(t.index(1), order, [], clear)
        for k, w in enumerate(node.weights[1:], 1):
            t.store(slot, t.index(k), t.mul(power, self._weight(t, scalars, w)))
            power = t.mul(power, h)

    def _lay_out_decay(self, t: Target, n: int, node: Node, scalars: dict, h: Any, order: Any) -> None:
        slot, power = self._slots["x", n], h
        *first, rate = (self._weight(t, scalars, w) for w in node.weights)
        last = first[0]
        for k, w in enumerate(first[1:], 1):
            last = t.mul(power, w)
            t.store(slot, t.index(k), last)
            power = t.mul(power, h)
        step = t.mul(h, rate)

        def further(k: Any, carried: Sequence) -> list:
            last = t.mul(carried[0], t.mul(step, t.reciprocal(k)))
            t.store(slot, k, last)
            return [last]

        t.loop(t.index(len(first)), t.plus(order, 1), [last], further)

    def _first(self, t: Target, n: int, zero: dict, scalars: dict, q: Sequence, v: Sequence) -> Any:
        """Return a node's coefficient of order 0, its value."""
        node = self.record.nodes[n]
        op, args = node.op, node.args
        if n in self._slopes_of_tanh:
            return _slope_of_tanh(t, zero[self._slopes_of_tanh[n]])
        if op == "place":
            return q[node.index]
        if op == "velocity":
            return v[node.index]
        if op in KNOWN:
            return self._weight(t, scalars, node.weights[0])
        if op == "sum":
            constant = node.weights[-1]
            start = None if constant == 0.0 else self._weight(t, scalars, constant)
            return self._weighted(t, node, zero, scalars, start)
        if op == "product":
            return t.mul(zero[args[0]], zero[args[1]])
        if op == "reciprocal":
            return t.div(t.number(1.0), zero[args[0]])
        if op == "sqrt":
            return t.sqrt(zero[args[0]])
        return t.elementary(op, zero[args[0]])

    def _weighted(self, t: Target, node: Node, values: dict, scalars: dict, total: Any) -> Any:
        for a, w in zip(node.args, node.weights[:-1], strict=True):
            x = values[a]
            if isinstance(w, float) and abs(w) == 1.0:
                if total is None:
                    total = x if w > 0 else t.neg(x)
                else:
                    total = t.add(total, x) if w > 0 else t.sub(total, x)
            else:
                weight = self._weight(t, scalars, w)
                total = t.mul(weight, x) if total is None else t.fma(weight, x, total)
        return t.number(0.0) if total is None else total

    def _convolve(self, t: Target, k: Any) -> dict:
        """Return Σ_{0<j<k} A_j B_{k-j} and Σ_{1<j<k} A_j B_{k+1-j} for all pairs, k even.

        Both share what they load: B_{k+1-j} is what B_{k-j} was for the j before.
        """
        unlike = [pair for pair in self._distinct if pair[0] != pair[1]]
        squares = [pair for pair in self._distinct if pair[0] == pair[1]]
        sums: dict = {}
        for pairs, end in ((unlike, k), (squares, t.half(k))):
            for first in range(0, len(pairs), GROUP):
                sums |= self._convolve_group(t, k, pairs[first : first + GROUP], end)
        return sums

    def _convolve_group(self, t: Target, k: Any, pairs: Sequence[tuple[Factor, Factor]], end: Any) -> dict:
        n = len(pairs)
        lower = list(dict.fromkeys(a for a, _ in pairs))
        upper = list(dict.fromkeys(b for _, b in pairs))

        def accumulate(j: Any, carried: Sequence) -> list:
            other = t.minus(k, j)
            x = {a: a.load(t, j) for a in lower}
            y = {b: b.load(t, other) for b in upper}
            last = dict(zip(upper, carried[2 * n :], strict=True))
            even = [t.fma(x[a], y[b], total) for (a, b), total in zip(pairs, carried[:n], strict=True)]
            odd = [
                t.fma(x[a], last[b], total) for (a, b), total in zip(pairs, carried[n : 2 * n], strict=True)
            ]
            return [*even, *odd, *y.values()]

        zeros = [t.number(0.0)] * (2 * n + len(upper))
        totals = t.loop(t.index(1), end, zeros, accumulate)
        last = dict(zip(upper, totals[2 * n :], strict=True))
        result = {}
        for (a, b), even, odd in zip(pairs, totals[:n], totals[n : 2 * n], strict=True):
            if a == b:  # the sums so far are one half, without the middle
                middle = a.load(t, end)
                even = t.fma(middle, middle, t.add(even, even))
                odd = t.fma(middle, last[b], odd)
                odd = t.add(odd, odd)
            result[a, b] = even, odd
        return result

    def _newest(self, t: Target, k: Any, pair: tuple[Factor, Factor], total: Any) -> Any:
        """Add A_1 B_k + A_k B_1."""
        a, b = pair
        total = t.fma(a.load(t, t.index(1)), b.load(t, k), total)
        return t.fma(a.load(t, k), b.load(t, t.index(1)), total)

    def _one_order(
        self, t: Target, start: ExpansionStart, halves: dict, rates: list, h: Any, k: Any, inner_of: Callable
    ) -> list:
        """Compute the coefficients of order k > 0, with sums from `_convolve`."""
        record = self.record
        before = t.plus(k, -1)
        per = t.reciprocal(k)
        step = t.mul(h, per)
        values: dict[int, Any] = {}

        def inner(key: Any) -> Any:
            """Return Σ_{0<j<k} A_j B_{k-j}."""
            total = inner_of(self._pairs[key])
            return t.number(0.0) if total is None else total

        def compute(n: int, node: Node) -> Any:
            op, args = node.op, node.args
            if op == "place":
                return t.mul(step, t.load(self._slots["v", node.index], before))
            if op == "velocity" or op in KNOWN:
                return self._factor(n).load(t, k)
            if op == "sum":
                return self._weighted(t, node, values, start.scalars, None)
            total, x = inner(n), args[0]
            if op == "product":
                y = args[1]
                if x == y:
                    return t.fma(t.add(start.zero[x], start.zero[x]), values[x], total)
                return t.fma(start.zero[x], values[y], t.fma(start.zero[y], values[x], total))
            if op == "reciprocal":
                return t.neg(t.mul(t.fma(values[x], start.zero[n], total), start.zero[n]))
            if op == "sqrt":
                return t.mul(t.sub(values[x], total), halves[n])
            slope = self._slope(n)
            if slope.back:
                value = t.mul(step, t.fma(slope.load(t, k), start.zero[args[1]], total))
            else:
                value = t.fma(values[x], start.zero[args[1]], t.mul(per, total))
            return t.neg(value) if op == "cos" else value

        for n in self._live:
            values[n] = compute(n, record.nodes[n])
            if record.nodes[n].op not in KNOWN:
                self._keep(t, n, k, values[n])
            if ("d", n) in self._slots:
                t.store(self._slots["d", n], k, t.mul(t.real(k), values[n]))
        right = []
        for i in range(self.size):
            f = record.force[i]
            total = values[f] if f >= 0 else None
            for (a, b), (node, weight, _) in record.mass.items():
                if node < 0 or i not in (a, b):
                    continue
                j = b if i == a else a
                more = t.fma(values[node], rates[j], inner((i, j)))
                if weight != 1.0:
                    more = t.mul(self._weight(t, start.scalars, weight), more)
                total = t.neg(more) if total is None else t.sub(total, more)
            right.append(total)
        self._accelerate(t, start.inverse, right, h, k)
        return []

    def _accelerate(self, t: Target, inverse: Inverse, right: Sequence, h: Any, k: Any) -> list:
        """Store a_k and v_{k+1}; return a_k."""
        a = [t.number(0.0) if x is None else x for x in matrix_times(t, inverse.rows, right)]
        after = t.plus(k, 1)
        step = t.mul(h, t.reciprocal(after))
        for i in range(self.size):
            if ("a", i) in self._slots:
                t.store(self._slots["a", i], k, a[i])
            t.store(self._slots["v", i], after, t.mul(step, a[i]))
        return a

    def advance(self, t: Target, q: Sequence, h: Any, order: Any) -> tuple[list, list]:
        """Return places and velocities at the step's end: the sums of their series, small terms first."""
        slots = [self._slots["v", i] for i in range(self.size)]

        def down(m: Any, carried: Sequence) -> list:
            k = t.minus(order, m)
            v = [t.load(slot, k) for slot in slots]
            sums = [t.add(total, x) for total, x in zip(carried, v, strict=False)]
            per = t.reciprocal(t.plus(k, 1))
            return sums + [t.fma(per, x, total) for total, x in zip(carried[self.size :], v, strict=True)]

        totals = t.loop(t.index(0), t.plus(order, 1), [t.number(0.0)] * (2 * self.size), down)
        after = [t.fma(h, total, x) for total, x in zip(totals[self.size :], q, strict=True)]
        return after, totals[: self.size]

    def shorten(self, t: Target, part: Any, order: Any) -> None:
        """Turn the velocities' coefficients into those of a part of the step."""

        def scale(k: Any, carried: Sequence) -> list:
            power = t.mul(carried[0], part)
            for i in range(self.size):
                slot = self._slots["v", i]
                t.store(slot, k, t.mul(power, t.load(slot, k)))
            return [power]

        t.loop(t.index(1), t.plus(order, 1), [t.number(1.0)], scale)

    def attempt(
        self,
        t: Target,
        inputs: dict[str, Any],
        q: Sequence,
        v: Sequence,
        h: Any,
        order: Any,
        tolerance: Any,
        wanted: Any = None,
    ) -> tuple[Any, Any, list, list, list]:
        """Take a certified step of length h, or of as much of h as can be certified from one expansion.

        Coefficients of a shorter step are those of h times powers of their ratio: so nothing is computed
        again.

        Parameters
        ----------
        t, inputs, q, v, h, order
            See `expand`.
        tolerance : number
            What v may leave out, in its sizes, see `Certificate`.
        wanted : condition, optional
            Where a result is wanted; only there it is worth trying again.

        Returns
        -------
        done : condition
            Whether a step was certified.
        h : number
            Its length, or that of the shortest that was tried.
        q, v : list of number
            Places and velocities at its end; meaningless where there was none.
        bounds : list of number
            Bounds on what v leaves out; q leaves out at most h/(N+2) times as much.
        """
        start = self.expand(t, inputs, q, v, h, order)
        return self._certified(t, start, q, h, order, tolerance, wanted)

    def _certified(
        self, t: Target, start: ExpansionStart, q: Sequence, h: Any, order: Any, tolerance: Any, wanted: Any
    ) -> tuple[Any, Any, list, list, list]:
        """Do what `attempt` does, after the expansion."""
        certificate = Certificate(self, t, start, h, order, tolerance)
        one = t.number(1.0)

        def going(passed: Any) -> Any:
            return t.negated(t.all(passed if wanted is None else t.either(passed, t.negated(wanted))))

        def retry(count: Any, carried: Sequence) -> tuple[Any, list]:
            passed, part, power, factor, *_ = carried
            factor = t.select(passed, one, factor)
            part = t.mul(factor, part)
            (power,) = t.loop(t.index(0), order, [power], lambda k, value: [t.mul(factor, value[0])])
            passed, bounds = certificate.check(part, power)
            return going(passed), [passed, part, power, certificate.factor(), *bounds]

        def shorten() -> list:
            first = [done, one, one, certificate.factor(), *bounds_of_all]
            passed, part, _, _, *bounds = t.repeat(TRIES, first, retry)
            self.shorten(t, part, order)
            return [passed, part, *bounds]

        done, bounds_of_all = certificate.check()
        done, part, *bounds = t.when(going(done), shorten, [done, one, *bounds_of_all])
        h = t.mul(h, part)
        q, v = self.advance(t, q, h, order)
        for x in (*q, *v):  # what overflows is not done
            done = t.both(done, t.less(t.abs(x), t.number(math.inf)))
        return done, h, q, v, bounds

    def _within_lags(self, t: Target, inputs: dict[str, Any], h: Any) -> Any:
        """Return a step that lagged controls do not make hopeless, h at most.

        With z = h/τ, an exponential's coefficients sum up to e^z times its size. It has died out as far as
        e^(-z) after a time of z, so steps may double. Much longer ones would not be certified, and terms that
        cancel would be taken for large velocities.
        """
        for name in self.record.inputs:
            if name.startswith("decay_"):
                gap = inputs[f"gap_{name.removeprefix('decay_')}"]
                reach = t.add(inputs[ELAPSED], t.div(t.number(REACH), inputs[name]))
                # What is longer by a rounding only would leave a rest too short to be stepped.
                over = t.less(t.mul(t.number(1.001), reach), h)
                shorter = t.both(over, t.less(t.number(0.0), t.abs(gap)))
                h = t.select(shorter, reach, h)
        return h

    def substep(
        self, t: Target, inputs: dict[str, Any], lane: StepProgress, dt: Any, order: Any, tolerance: Any
    ) -> tuple[StepProgress, list]:
        """Continue with a control step dt of which something is left, by what one expansion gives.

        Returns
        -------
        lane : Lane
            What it is afterwards; as before where nothing was left or certified.
        bounds : list of number
            Bounds on what places and velocities leave out.
        """
        wanted = t.less(t.number(0.0), lane.left)
        inputs, wish = self._before(t, inputs, lane, dt)
        found = self.attempt(t, inputs, lane.q, lane.v, wish, order, tolerance, wanted)
        return self._after(t, lane, order, wanted, *found)

    def _before(
        self, t: Target, inputs: dict[str, Any], lane: StepProgress, dt: Any
    ) -> tuple[dict[str, Any], Any]:
        """Return a substep's inputs and its length."""
        if ELAPSED in self.record.inputs:
            inputs = inputs | {ELAPSED: t.sub(dt, lane.left)}
        return inputs, self._within_lags(t, inputs, lane.wish)

    def _after(
        self,
        t: Target,
        lane: StepProgress,
        order: Any,
        wanted: Any,
        done: Any,
        tried: Any,
        q: Sequence,
        v: Sequence,
        bounds: Sequence,
    ) -> tuple[StepProgress, list]:
        """Return what `substep` does, from what `attempt` found."""
        zero = t.number(0.0)
        done = t.both(done, wanted)
        used = t.select(done, tried, zero)
        left = t.sub(lane.left, used)
        # What is nearly a step more is taken as one.
        longer = t.select(t.less(left, t.mul(t.number(3.0), used)), left, t.add(used, used))
        after = StepProgress(
            [t.select(done, x, before) for x, before in zip(q, lane.q, strict=True)],
            [t.select(done, x, before) for x, before in zip(v, lane.v, strict=True)],
            t.add(lane.status, t.select(wanted, t.number(1.0), zero)),
            left,
            t.select(done, longer, tried),
        )
        per = t.mul(used, t.reciprocal(t.plus(order, 2)))
        bounds = [*(t.mul(per, bound) for bound in bounds), *bounds]
        return after, [t.select(done, bound, zero) for bound in bounds]


class Inverse:
    """The inverse of a symmetric matrix by symmetric sweeps. Entries that are not there cost nothing.

    Attributes
    ----------
    rows : list of list
        M⁻¹; None stands for zero.
    definite : condition
        Whether all pivots are positive, those of M = L D Lᵀ.
    """

    def __init__(self, t: Target, matrix: dict[tuple[int, int], Any], size: int) -> None:
        self.matrix = matrix
        a = {
            place: entry
            for i, j in matrix
            for place, entry in (((i, j), matrix[i, j]), ((j, i), matrix[i, j]))
        }
        self.definite: Any = None
        for k in range(size):
            positive = t.less(t.number(0.0), a[k, k])
            self.definite = positive if k == 0 else t.both(self.definite, positive)
            per = t.div(t.number(1.0), a[k, k])
            row = {i: a[i, k] for i in range(size) if i != k and (i, k) in a}
            scaled = {i: t.mul(x, per) for i, x in row.items()}
            for i in row:
                less = t.neg(scaled[i])
                for j in row:
                    if j >= i:
                        a[i, j] = a[j, i] = _add_product(t, a.get((i, j)), less, row[j])
                a[i, k] = a[k, i] = scaled[i]
            a[k, k] = t.neg(per)
        # Every sweep leaves the negative inverse of the part that was swept.
        found = {(i, j): t.neg(x) for (i, j), x in a.items() if j >= i}
        self.rows = [[found.get((min(i, j), max(i, j))) for j in range(size)] for i in range(size)]


def _slope_of_tanh(t: Target, x: Any) -> Any:
    """Return 1 - tanh², with all digits also where tanh is nearly 1.

    Taking 1 - tanh² literally would leave it a few digits or none, and so all coefficients of tanh. Where
    tanh rounds to 1 they would be 0, and a step on which it falls to 0 would be certified with it at 1.
    """
    fading = t.elementary("exp", t.mul(t.number(-2.0), t.abs(x)))
    grown = t.add(t.number(1.0), fading)
    return t.div(t.mul(t.number(4.0), fading), t.mul(grown, grown))


def _add_product(t: Target, total: Any, a: Any, b: Any) -> Any:
    return t.mul(a, b) if total is None else t.fma(a, b, total)


def matrix_times(t: Target, matrix: Sequence[Sequence], vector: Sequence) -> list:
    """Return a matrix times a vector; None stands for zero."""
    result = []
    for row in matrix:
        total = None
        for entry, value in zip(row, vector, strict=True):
            if entry is not None and value is not None:
                total = _add_product(t, total, entry, value)
        result.append(total)
    return result


class Certificate:
    """Bounds on what a step's series leave out; see the module's docstring.

    Rules for tails, with H(X, Y) = Σ_{j+k>=N; j,k<N} |X_j| |Y_k|, |X| the norm of the known part and Σ'
    without order 0:

    * velocity: |v_N| + E_v. Place: h(|v_{N-1}| + |v_N| + E_v)/N.
    * decay: c_{k+1} = -c_k z/(k+1) from N - 1 on, z = h/τ, leaves |c_N| (1 + z/(N+1) + ...). That is at most
      |c_N| / (1 - b) <= |c_N| (1 + 2b) where b = z/(N+1) <= 1/2, and always at most |c_N| e^z.
    * product: H(X, Y) + |X| E_Y + |Y| E_X + E_X E_Y.
    * reciprocal z of x: x z = 1 leaves E_z = (H(x, z) + |z| E_x) / p where p = |x_0| - Σ'|x| - E_x > 0.
    * sqrt z of x: (ẑ + e)² = x leaves e² + 2ẑe = R, |R| <= E_x + H(z, z), so E_z = R/(p + √(p² - R)) where
      p = |z_0| - Σ'|z|; it needs p² > R.
    * functions, z' = w x' with D_j = j x_j: k z_k = Σ_j D_j w_{k-j} leaves E_z = A + B E_w, with
      A = H(D, w)/N + L |w| and B = Σ'|D|/(N+1) + L. Here L bounds Σ_{j>=N} |D_j|/j: it is E_x, or what is
      said of places. For sine and cosine both rules together give s <= (A_s + B A_c)/(1 - B²); for exp, where
      w is z, A/(1 - B); for tanh, where w is 1 - z², the smaller root of E = A + B (H(z, z) + 2|z|E + E²).

    Each holds for partial sums too, as the proof requires: the coefficient k of the left-hand side takes from
    its own series what is below k only.
    """

    def __init__(
        self, series: Series, t: Target, start: ExpansionStart, h: Any, order: Any, tolerance: Any
    ) -> None:
        self._series, self._t, self._order, self._tolerance = series, t, order, tolerance
        self._start, self._n, self._whole = start, series.size, h
        self._inverse = [[None if x is None else t.abs(x) for x in row] for row in start.inverse.rows]
        matrix = start.inverse.matrix
        self._roots = [t.sqrt(matrix[i, i]) for i in range(self._n)]
        self._per_root = [t.div(t.number(1.0), root) for root in self._roots]
        self._per = t.reciprocal(order)
        self._per_next = t.reciprocal(t.plus(order, 1))
        self._measure()

    def check(self, part: Any = None, power: Any = None) -> tuple[Any, list]:
        """Return whether the step, or a part of it, is certified, and return the bounds on what v leaves out.

        A part f < 1 makes Σ' |x_k| at most f times as large, and overlaps, sums of orders from N on, f^N
        times.

        Parameters
        ----------
        part, power : number, optional
            The part, and its N-th power.
        """
        t, n = self._t, self._n
        self._fine, self._power = self._start.inverse.definite, power
        self._h, self._later = self._whole, self._norms
        if part is not None:
            self._h = t.mul(self._whole, part)
            self._later = {slot: t.mul(part, x) for slot, x in self._norms.items()}
        self._all = {slot: t.add(x, self._size(slot, t.index(0))) for slot, x in self._later.items()}
        self._sizes = self._find_sizes()
        self._rest = [t.mul(self._tolerance, size) for size in self._sizes]
        self._tails: dict[int, Any] = {}
        for i in self._series._live:
            self._tails[i] = self._tail(i)
        right, change = self._balance()
        base = [
            t.number(0.0) if b is None else t.mul(self._h, b) for b in matrix_times(t, self._inverse, right)
        ]
        coupled = any(e is not None for row in change for e in row)
        # The fixed point of E = base + C E by a few terms of its Neumann series, a little enlarged; any E > 0
        # that passes the strict inequality is as good as another.
        matrix: list = [[None] * n for _ in range(n)]
        if coupled:
            columns = [matrix_times(t, self._inverse, column) for column in zip(*change, strict=True)]
            matrix = [list(row) for row in zip(*columns, strict=True)]

        def again(guess: list) -> list:
            more = matrix_times(t, matrix, guess)
            return [b if m is None else t.add(b, m) for b, m in zip(base, more, strict=True)]

        guess = base
        for _ in range(3 if coupled else 0):
            guess = again(guess)
        least = t.number(1e-30)
        guess = [t.fma(t.number(1.25), g, t.mul(least, s)) for g, s in zip(guess, self._sizes, strict=True)]
        passed, self._bounds = self._fine, []
        for new, g, rest in zip(again(guess), guess, self._rest, strict=True):
            bound = t.mul(self._per_next, g)
            self._bounds.append(bound)
            passed = t.both(passed, t.both(t.less(new, g), t.less(bound, rest)))
        return passed, self._bounds

    def factor(self) -> Any:
        """Return what part of the step just checked will probably be certified, where it was not."""
        t = self._t
        # Bounds grow with the power N + 1 of the step. Where there are none, the last terms have to do.
        bounds = terms = t.number(0.0)
        for i, (bound, root) in enumerate(zip(self._bounds, self._roots, strict=True)):
            slot = self._series._slots["v", i]
            last = t.add(self._size(slot, self._order), t.mul(t.number(0.1), self._last_but_one(slot)))
            bounds, terms = self._larger(bounds, t.mul(bound, root)), self._larger(terms, t.mul(last, root))
        excess = t.select(self._fine, bounds, self._powered(terms))
        excess = t.div(excess, t.mul(self._tolerance, self._largest))
        logarithm = t.mul(self._per_next, t.elementary("rough log2", excess))
        safety = t.select(self._fine, t.number(0.98), t.number(0.9))
        found = t.mul(safety, t.elementary("rough exp2", t.neg(logarithm)))
        largest = t.number(0.85)
        found = t.select(t.less(found, largest), found, largest)
        return t.select(t.less(t.number(0.02), found), found, t.number(0.02))

    def _size(self, slot: int, k: Any) -> Any:
        return self._t.abs(self._t.load(slot, k))

    def _last_but_one(self, slot: int) -> Any:
        return self._size(slot, self._t.plus(self._order, -1))

    def _larger(self, a: Any, b: Any) -> Any:
        return self._t.select(self._t.less(a, b), b, a)

    def _find_sizes(self) -> list:
        """Return the size of each velocity: that of the largest one, measured by energy."""
        t = self._t
        total = t.number(SMALLEST_SIZE)
        for i, root in enumerate(self._roots):
            total = self._larger(total, t.mul(root, self._all[self._series._slots["v", i]]))
        self._largest = total
        return [t.mul(total, per) for per in self._per_root]

    def _measure(self) -> None:
        """Find the norms Σ' of all slots, and the overlaps H of all pairs."""
        t, order, pairs = self._t, self._order, self._series._distinct
        self._norms: dict[int, Any] = {}
        self._overlaps: dict[tuple[Factor, Factor], Any] = {}
        for first in range(0, len(pairs), GROUP):
            self._measure_pairs(pairs[first : first + GROUP])
        alone = [slot for slot in range(self._series.slots) if slot not in self._norms]
        for first in range(0, len(alone), GROUP):
            some = alone[first : first + GROUP]

            def accumulate(k: Any, carried: Sequence, some: Sequence = some) -> list:
                return [t.add(total, self._size(slot, k)) for slot, total in zip(some, carried, strict=True)]

            totals = t.loop(t.index(1), order, [t.number(0.0)] * len(some), accumulate)
            self._norms |= dict(zip(some, totals, strict=True))

    def _measure_pairs(self, pairs: Sequence[tuple[Factor, Factor]]) -> None:
        """Sum |A_j| times the sum of |B_m| over m >= N - j."""
        t, order = self._t, self._order
        lower, upper = (list(dict.fromkeys(pair[i] for pair in pairs)) for i in (0, 1))

        def accumulate(j: Any, carried: Sequence) -> list:
            other = t.minus(order, j)
            x = {a: t.abs(a.load(t, j)) for a in lower}
            sums = {b: t.add(s, t.abs(b.load(t, other))) for b, s in zip(upper, carried, strict=False)}
            totals = zip(pairs, carried[len(upper) :], strict=True)
            return [*sums.values(), *(t.fma(x[a], sums[b], total) for (a, b), total in totals)]

        found = t.loop(t.index(1), order, [t.number(0.0)] * (len(upper) + len(pairs)), accumulate)
        self._norms |= {b.slot: s for b, s in zip(upper, found, strict=False)}
        self._overlaps |= dict(zip(pairs, found[len(upper) :], strict=True))

    def _overlap(self, key: Any) -> Any:
        return self._powered(self._overlaps[self._series._pairs[key]])

    def _powered(self, x: Any) -> Any:
        """Return what terms of order N and above, of this size together, are in the part of the step."""
        return x if self._power is None else self._t.mul(self._power, x)

    def _norm(self, n: int) -> Any:
        return self._all[self._series._factor(n).slot]

    def _balance(self) -> tuple[list, list[list]]:
        """Return R, the tail of r - M a, and the bounds |M - M_0| by rows; None stands for zero."""
        t, series, n = self._t, self._series, self._n
        right: list = [None if f < 0 else self._tails[f] for f in series.record.force]
        change: list[list] = [[None] * n for _ in range(n)]
        for (a, b), (node, weight, _) in series.record.mass.items():
            if node < 0:
                continue
            tail, moved = self._tails[node], self._later[series._factor(node).slot]
            scale = None if weight == 1.0 else t.abs(series._weight(t, self._start.scalars, weight))
            for i, j in {(a, b), (b, a)}:
                more = t.fma(tail, self._all[series._slots["a", j]], self._overlap((i, j)))
                more = more if scale is None else t.mul(scale, more)
                right[i] = more if right[i] is None else t.add(right[i], more)
                change[i][j] = t.add(moved, tail) if scale is None else t.mul(scale, t.add(moved, tail))
        return right, change

    def _require(self, condition: Any) -> None:
        self._fine = self._t.both(self._fine, condition)

    def _integrated(self, slot: int, tail: Any) -> Any:
        """Return h(|x_{N-1}| + E_x)/N, a bound on the tail of the series that has hx for its derivative."""
        t = self._t
        last = t.mul(self._powered(self._whole), self._last_but_one(slot))
        return t.mul(self._per, t.fma(self._h, tail, last))

    def _tail(self, n: int) -> Any:
        """Return a bound on the coefficients of order N and above of a node."""
        t, series = self._t, self._series
        node = series.record.nodes[n]
        op, args = node.op, node.args
        if op in ("place", "velocity"):
            slot = series._slots["v", node.index]
            tail = t.add(self._powered(self._size(slot, self._order)), self._rest[node.index])
            return tail if op == "velocity" else self._integrated(slot, tail)
        if op == "polynomial":
            return t.number(0.0)
        if op == "decay":
            return self._tail_of_decay(n, node)
        if op == "sum":
            total = None
            for a, w in zip(args, node.weights[:-1], strict=True):
                if isinstance(w, float) and abs(w) == 1.0:
                    total = self._tails[a] if total is None else t.add(total, self._tails[a])
                    continue
                weight = t.abs(series._weight(t, self._start.scalars, w))
                total = (
                    t.mul(weight, self._tails[a]) if total is None else t.fma(weight, self._tails[a], total)
                )
            return t.number(0.0) if total is None else total
        if op == "product":
            x, y = args
            both = t.fma(t.add(self._norm(y), self._tails[y]), self._tails[x], self._overlap(n))
            return t.fma(self._norm(x), self._tails[y], both)
        if op == "reciprocal":
            (x,) = args
            slot = series._factor(x).slot
            p = t.sub(t.sub(self._size(slot, t.index(0)), self._later[slot]), self._tails[x])
            self._require(t.less(t.number(0.0), p))
            return t.div(t.fma(self._tails[x], self._norm(n), self._overlap(n)), p)
        if op == "sqrt":
            slot = series._factor(n).slot
            p = t.sub(self._size(slot, t.index(0)), self._later[slot])
            r = t.add(self._tails[args[0]], self._overlap(n))
            return t.div(r, self._reach(p, r))
        return self._tails[n] if n in self._tails else self._tail_of_function(n, op, args)

    def _reach(self, p: Any, r: Any) -> Any:
        """Return p + √(p² - r): r over it is the smaller root of e² - 2pe + r = 0 for p > 0."""
        t, zero = self._t, self._t.number(0.0)
        room = t.sub(t.mul(p, p), r)
        self._require(t.both(t.less(zero, p), t.less(zero, room)))
        return t.add(p, t.sqrt(t.select(t.less(zero, room), room, zero)))

    def _tail_of_decay(self, n: int, node: Node) -> Any:
        t, series = self._t, self._series
        last = self._powered(self._size(series._slots["x", n], self._order))
        rate = t.abs(series._weight(t, self._start.scalars, node.weights[-1]))
        z = t.mul(rate, self._h)
        b = t.mul(z, self._per_next)
        grown = t.select(
            t.less(b, t.number(0.5)), t.fma(t.number(2.0), b, t.number(1.0)), t.elementary("exp", z)
        )
        # What has died out leaves nothing, over any time.
        return t.select(t.less(t.number(0.0), last), t.mul(last, grown), last)

    def _tail_of_function(self, n: int, op: str, args: tuple[int, ...]) -> Any:
        t, series = self._t, self._series
        slope = series._slope(n)
        if slope.back:  # D is h times the argument's rate
            along, scale = t.mul(self._h, self._all[slope.slot]), t.mul(self._whole, self._per)
            lead = self._integrated(slope.slot, self._tails[args[2]])
        else:
            along, scale, lead = self._later[slope.slot], self._per, self._tails[args[0]]
        b = t.fma(along, self._per_next, lead)

        def start(of: int) -> Any:
            return t.fma(lead, self._norm(series.record.nodes[of].args[1]), t.mul(scale, self._overlap(of)))

        a = start(n)
        if op in ("atan", "log"):
            return t.fma(b, self._tails[args[1]], a)
        if op == "tanh":
            square = self._overlap(series.record.nodes[args[1]].args[0])
            a = t.fma(b, square, a)
            p = t.sub(t.number(0.5), t.mul(b, self._norm(n)))
            return t.div(a, self._reach(p, t.mul(a, b)))
        # 1/(1 - b) <= 1 + 2b and 1/(1 - b²) <= 1 + 4/3 b² up to b = 1/2
        self._require(t.less(b, t.number(0.5)))
        if op == "exp":
            return t.fma(t.add(b, b), a, a)
        other = start(args[1])
        grown = t.fma(t.mul(b, b), t.number(1.3333333333333335), t.number(1.0))
        self._tails[args[1]] = t.mul(grown, t.fma(b, a, other))
        return t.mul(grown, t.fma(b, other, a))


class Plain:
    """The target that computes at once, on numbers of any kind: floats, or others with functions in `xp`.

    On floats its results are those of the unfused print, bit for bit.
    """

    def __init__(self, slots: int, number: Callable = float, xp: Any = None) -> None:
        self._memory: list[dict[int, Any]] = [{} for _ in range(slots)]
        self.number = number
        self._functions: Any = None
        if xp is not None:
            self._functions = {name: getattr(xp, name) for name in (*FUNCTIONS, "sqrt")}
            self._functions |= {
                "a*b+c": lambda a, b, c: a * b + c,
                "a*b-c": lambda a, b, c: a * b - c,
                "c-a*b": lambda a, b, c: c - a * b,
            }

    def add(self, a: Any, b: Any) -> Any:
        return a + b

    def sub(self, a: Any, b: Any) -> Any:
        return a - b

    def mul(self, a: Any, b: Any) -> Any:
        return a * b

    def div(self, a: Any, b: Any) -> Any:
        try:
            return a / b
        except ZeroDivisionError:
            return a * math.copysign(math.inf, b) if a == a and a != 0 else self.number(math.nan)

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        return a * b + c

    def neg(self, a: Any) -> Any:
        return -a

    def abs(self, a: Any) -> Any:
        return abs(a)

    def sqrt(self, a: Any) -> Any:
        if self._functions is not None:
            return self._functions["sqrt"](a)
        return math.sqrt(a) if a >= 0 else math.nan

    def less(self, a: Any, b: Any) -> bool:
        return bool(a < b)

    def both(self, a: bool, b: bool) -> bool:
        return a and b

    def either(self, a: bool, b: bool) -> bool:
        return a or b

    def all(self, condition: bool) -> bool:
        return condition

    def negated(self, condition: bool) -> bool:
        return not condition

    def select(self, condition: bool, a: Any, b: Any) -> Any:
        return a if condition else b

    def real(self, k: int) -> Any:
        return self.number(k)

    def reciprocal(self, k: int) -> Any:
        return self.number(1) / self.number(k)

    def index(self, k: int) -> int:
        return k

    def plus(self, k: int, n: int) -> int:
        return k + n

    def minus(self, a: int, b: int) -> int:
        return a - b

    def half(self, k: int) -> int:
        return k // 2

    def below(self, a: int, b: int) -> bool:
        return a < b

    def load(self, slot: int, k: int) -> Any:
        return self._memory[slot][k]

    def store(self, slot: int, k: int, value: Any) -> None:
        self._memory[slot][k] = value

    def loop(self, first: int, end: int, carried: Sequence, body: Callable, step: int = 1) -> list:
        values = list(carried)
        for k in range(first, end, step):
            values = body(k, values)
        return values

    def repeat(self, times: int, carried: Sequence, body: Callable) -> list:
        values = list(carried)
        for count in range(times):
            going, values = body(count, values)
            if not going:
                break
        return values

    def when(self, condition: bool, body: Callable, otherwise: Sequence) -> list:
        return body() if condition else list(otherwise)

    def elementary(self, name: str, x: Any) -> Any:
        if self._functions is not None:
            return self._functions[name](x)
        operations, result = elementary(name, fused=False)
        return evaluate_operations(operations, {"x": x})[result]

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]:
        return evaluate_operations(record.scalars, inputs, self._functions)
