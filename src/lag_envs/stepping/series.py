"""One step of any equations of motion by Taylor series, with a proved bound on what the series leaves out.

The algorithm stands here once, written for a `Target`: something that adds and multiplies, keeps series in
numbered slots and runs loops. Targets print it to machine code (`lag_envs.stepping.machine`) or carry it out on
Python numbers (`Plain`).

**Series.** Let h be the step and t = hτ. The coefficients in τ of all nodes of the record follow order by order
(sums termwise, products by convolution, functions by their differential equations), with q_{k+1} = h v_k/(k+1),
v_{k+1} = h a_k/(k+1), and the accelerations from::

    M_0 a_k = r_k - Σ_{j=1..k} M_j a_{k-j}

with one factorisation M_0 = L D Lᵀ.

**Certificate.** |x| is the sum of absolute coefficients, E_x a bound on the sum of those of order N and above.
Known are the coefficients below N of every node, and v_N, q_N, q_{N+1}. Suppose that the velocities' beyond N
sum up to E_v at most. Then those of the places do to |q_N| + |q_{N+1}| + hE_v/(N+2), and tails follow node by
node, see `Certificate`. With R the tail of r - Ma, cut after N - 1, the step is accepted if for some E_a > 0::

    |M_0⁻¹| (R + |M - M_0| E_a) < E_a  (strictly, in every row)     and     hE_a/(N+1) <= E_v.

Proof: v_{k+1} = h a_k/(k+1), and a_k depends on coefficients up to order k only. So if the partial sums of the
tails up to k obey E_v and E_a, those up to k + 1 do; they stay bounded, so the series converges on the whole
step and is the solution. That the inequality is strict makes M invertible throughout. What is proved is the
truncation of each substep: rounding comes on top, and what the flow makes of earlier errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple, Protocol

from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.lowering import Node, SeriesRecord
from lag_envs.stepping.tracing import Operation, evaluate

#: The highest order that a series may have.
LARGEST_ORDER = 24
SMALLEST_ORDER = 4

#: What a substep's truncation may be, relative to the size of the velocities.
TOLERANCE = 1e-14
#: Sizes below this count as this: √(kg m²) m/s or what the mass matrix's units make of it.
SMALLEST_SIZE = 1e-12
#: How often a step is shortened before it counts as failed.
TRIES = 10


ELEMENTARY = ("sin", "cos", "exp", "log", "atan", "tanh")


@cache
def elementary(name: str, fused: bool) -> tuple[tuple[Operation, ...], str]:
    """Return the operations of an elementary function of ``x``, and the name of their result."""
    trace = ElementaryTrace()
    operations, (result,) = trace.operations([getattr(trace, name)(*trace.inputs("x"))], fused=fused)
    assert isinstance(result, str)
    return tuple(operations), result


class Target(Protocol):
    """Numbers, slots and loops; see `Plain`, the simplest one."""

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
    def any(self, condition: Any) -> Any: ...
    def real(self, k: Any) -> Any: ...
    def index(self, k: int) -> Any: ...
    def plus(self, k: Any, n: int) -> Any: ...
    def minus(self, a: Any, b: Any) -> Any: ...
    def load(self, slot: int, k: Any) -> Any: ...
    def store(self, slot: int, k: Any, value: Any) -> None: ...
    def loop(self, first: Any, end: Any, carried: Sequence, body: Callable) -> list: ...
    def repeat(self, times: int, going: Any, carried: Sequence, body: Callable) -> list: ...
    def when(self, condition: Any, body: Callable) -> None: ...
    def elementary(self, name: str, x: Any) -> Any: ...
    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]: ...


class Expansion(NamedTuple):
    """Coefficients of order 0 and what was made of the mass matrix; the rest lies in the slots."""

    zero: list
    inverse: Any
    scalars: dict[str, Any]


class Series:
    """The step of a record.

    Parameters
    ----------
    record : SeriesRecord
        What is to be computed.
    """

    def __init__(self, record: SeriesRecord) -> None:
        self.record = record
        self.size = record.size
        self._slots: dict[tuple[str, int], int] = {}
        self._planned = False
        for i in range(self.size):
            self._slot("v", i)
            self._slot("q", i)
        #: Pairs of slots (A, B) whose inner sums Σ_{0<j<k} A_j B_{k-j} an order needs, by what needs them.
        self._pairs: dict[tuple, tuple[int, int]] = {}
        for n, node in enumerate(record.nodes):
            self._plan(n, node)
        for place, (node, _) in record.mass.items():
            if node >= 0:
                for row, column in {place, place[::-1]}:
                    self._pair(("mass", row, column), self._x(node), self._slot("a", column))
        self._planned = True

    # --- which series are kept -----------------------------------------------------------------------------

    def _slot(self, kind: str, i: int) -> int:
        if (kind, i) not in self._slots:
            assert not self._planned, f"nobody planned for {kind}{i}"
            self._slots[kind, i] = len(self._slots)
        return self._slots[kind, i]

    def _x(self, n: int) -> int:
        """Return the slot of a node's coefficients."""
        node = self.record.nodes[n]
        if node.op in ("place", "velocity"):
            return self._slot({"place": "q", "velocity": "v"}[node.op], node.index)
        return self._slot("x", n)

    def _d(self, n: int) -> int:
        """Return the slot of a node's coefficients times their orders."""
        return self._slot("d", n)

    def _pair(self, key: tuple, a: int, b: int) -> None:
        self._pairs[key] = (a, b)

    def _plan(self, n: int, node: Node) -> None:
        if node.op == "product":
            self._pair((n,), self._x(node.args[0]), self._x(node.args[1]))
        elif node.op == "reciprocal":
            self._pair((n,), self._x(node.args[0]), self._x(n))
        elif node.op in ("sin", "cos"):
            self._pair((n,), self._d(node.args[0]), self._x(node.args[1]))
        elif node.op == "exp":
            self._pair((n,), self._d(node.args[0]), self._x(n))
        elif node.op == "log":
            self._pair((n,), self._d(n), self._x(node.args[0]))
        elif node.op == "sqrt":
            self._pair((n,), self._x(n), self._x(n))
        elif node.op in ("atan", "tanh"):
            self._pair((n,), self._d(node.args[0]), self._x(node.args[1]))
        elif node.op == "polynomial":
            self._x(n)

    @property
    def slots(self) -> int:
        """Number of series that are kept."""
        return len(self._slots)

    # --- the series ----------------------------------------------------------------------------------------

    def expand(
        self, t: Target, inputs: dict[str, Any], q: Sequence, v: Sequence, h: Any, order: Any
    ) -> Expansion:
        """Fill the slots with coefficients: velocities up to the order N, places up to N + 1, the rest below N.

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
        record = self.record
        scalars = t.scalars(record, inputs)
        for i in range(self.size):
            t.store(self._slots["q", i], t.index(0), q[i])
            t.store(self._slots["v", i], t.index(0), v[i])
        zero: list = []
        for n, node in enumerate(record.nodes):
            zero.append(self._first(t, node, zero, scalars, q, v))
            if ("x", n) in self._slots:
                t.store(self._slots["x", n], t.index(0), zero[n])
            if ("d", n) in self._slots:
                t.store(self._slots["d", n], t.index(0), t.number(0.0))
            if node.op == "polynomial":
                self._lay_out(t, n, node, scalars, h, order)
        matrix = {
            place: zero[node] if node >= 0 else self._weight(t, scalars, w)
            for place, (node, w) in record.mass.items()
        }
        inverse = Factors(t, matrix, self.size)
        right = [zero[f] if f >= 0 else None for f in record.force]
        start = self._accelerate(t, inverse, right, h, t.index(0))

        def at_order(k: Any, carried: Sequence) -> list:
            inner = self._inner(t, k)
            inner["per order"] = t.div(t.number(1.0), t.real(k))
            values: list = []
            for n, node in enumerate(record.nodes):
                value = self._next(t, n, node, values, zero, scalars, inner, k)
                values.append(value)
                if ("x", n) in self._slots and node.op != "polynomial":
                    t.store(self._slots["x", n], k, value)
                if ("d", n) in self._slots and node.op != "log":
                    t.store(self._slots["d", n], k, t.mul(t.real(k), value))
            right = []
            for i in range(self.size):
                f = record.force[i]
                total = values[f] if f >= 0 else None
                for (a, b), (node, _) in record.mass.items():
                    if node < 0 or i not in (a, b):
                        continue
                    j = b if i == a else a
                    more = t.fma(values[node], start[j], inner["mass", i, j])
                    total = t.neg(more) if total is None else t.sub(total, more)
                right.append(total)
            self._accelerate(t, inverse, right, h, k)
            return []

        t.loop(t.index(1), order, [], at_order)
        per = t.div(h, t.real(t.plus(order, 1)))
        for i in range(self.size):
            last = t.load(self._slots["v", i], order)
            t.store(self._slots["q", i], t.plus(order, 1), t.mul(per, last))
        return Expansion(zero, inverse, scalars)

    def _accelerate(self, t: Target, inverse: Factors, right: Sequence, h: Any, k: Any) -> list:
        """Store a_k, v_{k+1} and q_{k+1}; return a_k."""
        a = inverse.solve([t.number(0.0) if r is None else r for r in right])
        after = t.plus(k, 1)
        per = t.div(h, t.real(after))
        for i in range(self.size):
            if ("a", i) in self._slots:
                t.store(self._slots["a", i], k, a[i])
            rate = t.load(self._slots["v", i], k)
            t.store(self._slots["v", i], after, t.mul(per, a[i]))
            t.store(self._slots["q", i], after, t.mul(per, rate))
        return a

    def _weight(self, t: Target, scalars: dict[str, Any], weight: Any) -> Any:
        return scalars[weight] if isinstance(weight, str) else t.number(weight)

    def _lay_out(self, t: Target, n: int, node: Node, scalars: dict, h: Any, order: Any) -> None:
        """Store the coefficients of a polynomial in time."""
        slot, power = self._slots["x", n], h
        zero = t.number(0.0)

        def clear(k: Any, carried: Sequence) -> list:
            t.store(slot, k, zero)
            return []

        t.loop(t.index(1), order, [], clear)
        for k, w in enumerate(node.weights[1:], 1):
            t.store(slot, t.index(k), t.mul(power, self._weight(t, scalars, w)))
            power = t.mul(power, h)

    def _first(self, t: Target, node: Node, zero: list, scalars: dict, q: Sequence, v: Sequence) -> Any:
        """Return a node's coefficient of order 0, its value."""
        op, args = node.op, node.args
        if op == "place":
            return q[node.index]
        if op == "velocity":
            return v[node.index]
        if op == "polynomial":
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

    def _weighted(self, t: Target, node: Node, values: list, scalars: dict, total: Any) -> Any:
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

    def _inner(self, t: Target, k: Any, group: int = 8) -> dict[Any, Any]:
        """Return Σ_{0<j<k} A_j B_{k-j} for all pairs, several in one loop."""
        distinct = list(dict.fromkeys(self._pairs.values()))
        sums: dict[tuple[int, int], Any] = {}
        for first in range(0, len(distinct), group):
            pairs = distinct[first : first + group]

            def accumulate(j: Any, carried: Sequence, pairs: Sequence = pairs) -> list:
                seen: dict[tuple, Any] = {}
                other = t.minus(k, j)

                def value(slot: int, where: Any, which: str) -> Any:
                    if (slot, which) not in seen:
                        seen[slot, which] = t.load(slot, where)
                    return seen[slot, which]

                return [
                    t.fma(value(a, j, "j"), value(b, other, "k-j"), total)
                    for (a, b), total in zip(pairs, carried, strict=True)
                ]

            totals = t.loop(t.index(1), k, [t.number(0.0)] * len(pairs), accumulate)
            sums |= dict(zip(pairs, totals, strict=True))
        return {key: sums[pair] for key, pair in self._pairs.items()}

    def _next(
        self, t: Target, n: int, node: Node, values: list, zero: list, scalars: dict, inner: dict, k: Any
    ) -> Any:
        """Return a node's coefficient of order k > 0."""
        op, args = node.op, node.args
        if op in ("place", "velocity", "polynomial"):
            return t.load(self._x(n), k)
        if op == "sum":
            return self._weighted(t, node, values, scalars, None)
        total = inner[(n,)]
        x = args[0]
        if op == "product":
            y = args[1]
            if x == y:
                return t.fma(t.add(zero[x], zero[x]), values[x], total)
            return t.fma(zero[x], values[y], t.fma(zero[y], values[x], total))
        if op == "reciprocal":
            return t.neg(t.mul(t.fma(values[x], zero[n], total), zero[n]))
        if op == "sqrt":
            return t.div(t.sub(values[x], total), t.add(zero[n], zero[n]))
        per = inner["per order"]
        if op == "log":
            weighted = t.div(t.sub(t.mul(t.real(k), values[x]), total), zero[x])
            t.store(self._slots["d", n], k, weighted)
            return t.mul(weighted, per)
        partner = zero[n] if op == "exp" else zero[args[1]]
        value = t.fma(values[x], partner, t.mul(total, per))
        return t.neg(value) if op == "cos" else value

    def advance(self, t: Target, order: Any) -> tuple[list, list]:
        """Return places and velocities at the step's end: the sums of their series, small terms first."""
        q, v = [], []
        for i in range(self.size):
            for kind, end, result in (("v", order, v), ("q", t.plus(order, 1), q)):
                slot = self._slots[kind, i]

                def down(m: Any, carried: Sequence, slot: int = slot, end: Any = end) -> list:
                    return [t.add(carried[0], t.load(slot, t.minus(end, m)))]

                total = t.loop(t.index(1), t.plus(end, 1), [t.load(slot, end)], down)
                result += total
        return q, v

    def shorten(self, t: Target, factor: Any, order: Any) -> None:
        """Turn the coefficients of a step h into those of the step factor · h."""

        def scale(k: Any, carried: Sequence) -> list:
            power = t.mul(carried[0], factor)
            for slot in range(self.slots):
                t.store(slot, k, t.mul(power, t.load(slot, k)))
            return [power]

        (power,) = t.loop(t.index(1), order, [t.number(1.0)], scale)
        power = t.mul(power, factor)
        after = t.plus(order, 1)
        for i in range(self.size):
            v, q = self._slots["v", i], self._slots["q", i]
            t.store(v, order, t.mul(power, t.load(v, order)))
            t.store(q, order, t.mul(power, t.load(q, order)))
            t.store(q, after, t.mul(t.mul(power, factor), t.load(q, after)))

    def attempt(
        self, t: Target, inputs: dict[str, Any], q: Sequence, v: Sequence, h: Any, order: Any, tolerance: Any
    ) -> tuple[Any, Any, list, list, list]:
        """Take a certified step of length h, or of as much of h as can be certified from one expansion.

        Returns
        -------
        done : condition
            Whether a step was certified.
        h : number
            Its length.
        q, v : list of number
            Places and velocities at its end; meaningless where there was none.
        bounds : list of number
            Bounds on what v leaves out; q leaves out at most h/(N+2) times as much.
        """
        expansion = self.expand(t, inputs, q, v, h, order)
        certificate = Certificate(self, t, expansion, order, tolerance)
        none = [t.number(math.inf)] * self.size
        wanted = certificate.guess()
        never = t.less(t.number(1.0), t.number(0.0))

        def shortened(count: Any, carried: Sequence) -> tuple[Any, list]:
            done, h, factor, *_ = carried
            one = t.number(1.0)
            t.when(t.any(t.less(factor, one)), lambda: self.shorten(t, factor, order))
            h = t.mul(h, factor)
            passed, bounds = certificate.check(h)
            factor = t.select(passed, one, t.number(0.65))
            return t.any(t.less(factor, one)), [passed, h, factor, *bounds]

        going = t.less(t.number(0.0), t.number(1.0))
        done, h, _, *bounds = t.repeat(TRIES, t.any(going), [never, h, wanted, *none], shortened)
        return done, h, *self.advance(t, order), bounds


class Factors:
    """M = L D Lᵀ, and what can be solved with it. Entries that are not there cost nothing."""

    def __init__(self, t: Target, matrix: dict[tuple[int, int], Any], size: int) -> None:
        self._t, self._size = t, size
        self.matrix = matrix
        lower: dict[tuple[int, int], Any] = {}
        self._inverse: list = []
        scaled: dict[tuple[int, int], Any] = {}
        for j in range(size):
            pivot = matrix[j, j]
            for k in range(j):
                if (j, k) in lower:
                    pivot = t.sub(pivot, t.mul(lower[j, k], scaled[j, k]))
            self._inverse.append(t.div(t.number(1.0), pivot))
            self.definite = (
                t.less(t.number(0.0), pivot)
                if j == 0
                else t.both(self.definite, t.less(t.number(0.0), pivot))
            )
            for i in range(j + 1, size):
                entry = matrix.get((j, i))
                for k in range(j):
                    if (i, k) in lower and (j, k) in lower:
                        product = t.mul(lower[i, k], scaled[j, k])
                        entry = t.neg(product) if entry is None else t.sub(entry, product)
                if entry is not None:
                    scaled[i, j] = entry
                    lower[i, j] = t.mul(entry, self._inverse[j])
        self._lower = lower

    def solve(self, right: Sequence) -> list:
        """Return M⁻¹ times a vector; None stands for zero."""
        t, n = self._t, self._size
        y: list = list(right)
        for i in range(n):
            for k in range(i):
                if (i, k) in self._lower and y[k] is not None:
                    product = t.mul(self._lower[i, k], y[k])
                    y[i] = t.neg(product) if y[i] is None else t.sub(y[i], product)
        x = [None if y[i] is None else t.mul(y[i], self._inverse[i]) for i in range(n)]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                if (k, i) in self._lower and x[k] is not None:
                    product = t.mul(self._lower[k, i], x[k])
                    x[i] = t.neg(product) if x[i] is None else t.sub(x[i], product)
        return x

    def absolute_inverse(self) -> list[list]:
        """Return |M⁻¹| by rows; None stands for zero."""
        t, n = self._t, self._size
        columns = [self.solve([t.number(1.0) if i == j else None for i in range(n)]) for j in range(n)]
        return [[None if columns[j][i] is None else t.abs(columns[j][i]) for j in range(n)] for i in range(n)]


class Certificate:
    """Bounds on what a step's series leave out; see the module's docstring.

    Rules for tails, with H(X, Y) = Σ_{j+k>=N; j,k<N} |X_j| |Y_k|, |X| the norm of the known part, Σ' without
    order 0, D_j = j X_j, and b = Σ|D_j|/N:

    * product: H(X, Y) + |X| E_Y + |Y| E_X + E_X E_Y.
    * reciprocal z of x: x z = 1 leaves E_z = (H(x, z) + |z| E_x) / p, where 1/x has a norm of at most 1/p with
      p = |x_0| - Σ'|x| - E_x > 0.
    * sin and cos, b < 1: for the truncated argument the tails s, c of the pair obey s <= (H(D, cos) + Σ|D| c)/N
      and c <= (H(D, sin) + Σ|D| s)/N, for k >= N in the recurrence's factor 1/k. The rest of the argument, of
      norm E, adds (|sin| + s)(cosh E - 1) + (|cos| + c) sinh E to the sine's, likewise to the cosine's.
    * exp z: s <= (H(D, z) + Σ|D| s)/N, then E_z = s + (|z| + s)(exp E - 1).
    * sqrt z of x: (ẑ + e)² = x leaves e² + 2ẑe = R with |R| <= E_x + H(z, z), so E_z = R/(p + √(p² - R)) where
      p = |z_0| - Σ'|z| bounds 1/|ẑ⁻¹| from below; it needs p² > R.
    * log z of x: x̂ D_z = D_x̂ leaves H(D_z, x)/(N p) for the truncated x̂, with p = |x_0| - Σ'|x|; then
      log(1 + e/x̂) adds E_x/(p - E_x).
    * atan z with slope g = 1/(1 + x²): (H(D, g) + Σ|D| E_g)/N + E_x (|g| + E_g), the integral of the slope
      along the rest of the argument; E_g holds for every part of that rest, since it grows with E_x.
    * tanh z, slope 1 - z²: for the truncated argument E = A + b(2|z|E + E²) with A = (H(D, g) + Σ|D| H(z, z))/N,
      its smaller root; the rest of the argument adds δ = 2 E_x (1 + Y²), Y = |z| + E, if (Y + δ)² + 1 does not
      exceed 2 (1 + Y²).
    """

    def __init__(self, series: Series, t: Target, expansion: Expansion, order: Any, tolerance: Any) -> None:
        self._series, self._t, self._order, self._tolerance = series, t, order, tolerance
        self._expansion = expansion
        self._steps = t.real(order)

    def _last(self, i: int) -> Any:
        return self._t.abs(self._t.load(self._series._slots["v", i], self._order))

    def _roots(self) -> list:
        """Return the roots of the mass matrix's diagonal."""
        t, matrix = self._t, self._expansion.inverse.matrix
        return [t.sqrt(matrix[i, i]) for i in range(self._series.size)]

    def _sizes(self, norms: Sequence) -> list:
        """Return the size of each velocity: that of the largest one, measured by energy."""
        t = self._t
        roots = self._roots()
        total = t.number(SMALLEST_SIZE)
        for root, norm in zip(roots, norms, strict=True):
            product = t.mul(root, norm)
            total = t.select(t.less(total, product), product, total)
        return [t.div(total, root) for root in roots]

    def guess(self) -> Any:
        """Return the part of the step that will probably be certified: 1, or less where the tail is far too long."""
        t, series = self._t, self._series
        norms = self._norms([series._slots["v", i] for i in range(series.size)], self._order)
        sizes = self._sizes([norms[series._slots["v", i], 0] for i in range(series.size)])
        worst = t.number(0.0)
        before = t.plus(self._order, -1)
        for i, size in enumerate(sizes):
            slot = series._slots["v", i]
            last = t.abs(t.load(slot, self._order))
            last = t.add(last, t.mul(t.number(0.1), t.abs(t.load(slot, before))))
            ratio = t.div(last, size)
            worst = t.select(t.less(worst, ratio), ratio, worst)
        # A tail of w at the order N is one of w f^N after a step of f h: ten, hundred, ... times too long.
        excess = t.div(worst, t.mul(t.number(10.0), self._tolerance))
        one = t.number(1.0)
        factor, power = one, one

        def halve(count: Any, carried: Sequence) -> tuple[Any, list]:
            factor, power = carried
            long = t.less(one, t.mul(excess, power))
            factor = t.select(long, t.mul(factor, t.number(0.7)), factor)
            power = t.select(long, t.mul(power, small), power)
            return t.any(long), [factor, power]

        def raised(k: Any, carried: Sequence) -> list:
            return [t.mul(carried[0], t.number(0.7))]

        (small,) = t.loop(t.index(0), self._order, [one], raised)
        factor, _ = t.repeat(24, t.any(t.less(one, excess)), [factor, power], halve)
        return factor

    def _norms(self, slots: Sequence[int], end: Any, group: int = 8) -> dict[tuple[int, int], Any]:
        """Return for each slot the sum of absolute coefficients from order 0 (key 0) and from order 1 (key 1)."""
        t = self._t
        result = {}
        for first in range(0, len(slots), group):
            some = slots[first : first + group]

            def accumulate(k: Any, carried: Sequence, some: Sequence = some) -> list:
                return [
                    t.add(total, t.abs(t.load(slot, k))) for slot, total in zip(some, carried, strict=True)
                ]

            totals = t.loop(t.index(1), end, [t.number(0.0)] * len(some), accumulate)
            for slot, total in zip(some, totals, strict=True):
                result[slot, 1] = total
                result[slot, 0] = t.add(total, t.abs(t.load(slot, t.index(0))))
        return result

    def _overlaps(self, pairs: Sequence[tuple[int, int]], group: int = 6) -> dict[tuple[int, int], Any]:
        """Return H(A, B) = Σ_{j=1..N-1} |A_j| Σ_{m=N-j..N-1} |B_m| for pairs of slots."""
        t = self._t
        result = {}
        for first in range(0, len(pairs), group):
            some = pairs[first : first + group]
            suffixes = list(dict.fromkeys(b for _, b in some))

            def accumulate(
                j: Any, carried: Sequence, some: Sequence = some, suffixes: Sequence = suffixes
            ) -> list:
                other = t.minus(self._order, j)
                sums = dict(zip(suffixes, carried, strict=False))
                sums = {b: t.add(total, t.abs(t.load(b, other))) for b, total in sums.items()}
                totals = [
                    t.fma(t.abs(t.load(a, j)), sums[b], total)
                    for (a, b), total in zip(some, carried[len(suffixes) :], strict=True)
                ]
                return [*sums.values(), *totals]

            zeros = [t.number(0.0)] * (len(suffixes) + len(some))
            totals = t.loop(t.index(1), self._order, zeros, accumulate)
            result |= dict(zip(some, totals[len(suffixes) :], strict=True))
        return result

    def check(self, h: Any) -> tuple[Any, list]:
        """Tell whether the step of length h is certified, and return the bounds on what v leaves out."""
        t, series, record = self._t, self._series, self._series.record
        slots, n = series._slots, series.size
        self._n = self._norms(range(series.slots), self._order)
        overlaps = self._overlaps(list(dict.fromkeys(series._pairs.values())))
        self._h = {key: overlaps[pair] for key, pair in series._pairs.items()}
        sizes = self._sizes([self._n[slots["v", i], 0] for i in range(n)])
        rest = [t.mul(self._tolerance, size) for size in sizes]
        self._fine = self._expansion.inverse.definite
        tails: list = []
        for i, node in enumerate(record.nodes):
            tails.append(self._tail(i, node, tails, rest, h))
        right, change = self._balance(tails)
        inverse = self._expansion.inverse.absolute_inverse()

        def times(matrix: list[list], vector: list) -> list:
            result = []
            for row in matrix:
                total = None
                for entry, value in zip(row, vector, strict=True):
                    if entry is not None and value is not None:
                        total = t.mul(entry, value) if total is None else t.fma(entry, value, total)
                result.append(total)
            return result

        base = times(inverse, right)
        base = [t.number(0.0) if b is None else b for b in base]
        coupled = any(e is not None for row in change for e in row)
        # The fixed point of E = base + C E by a few terms of its Neumann series, a little enlarged; any E > 0
        # that passes the strict inequality is as good as another.
        least = [t.div(t.mul(t.number(1e-30), size), h) for size in sizes]
        guess = list(base)
        if coupled:
            for _ in range(3):
                guess = [
                    b if c is None else t.add(b, c)
                    for b, c in zip(base, times(inverse, times(change, guess)), strict=True)
                ]
        guess = [t.fma(t.number(1.25), g, low) for g, low in zip(guess, least, strict=True)]
        again = times(inverse, times(change, guess)) if coupled else [None] * n
        passed = self._fine
        bounds = []
        per = t.div(h, t.real(t.plus(self._order, 1)))
        for i in range(n):
            total = base[i] if again[i] is None else t.add(base[i], again[i])
            passed = t.both(passed, t.less(total, guess[i]))
            bounds.append(t.mul(per, guess[i]))
            passed = t.both(passed, t.less(bounds[i], rest[i]))
        return passed, bounds

    def _balance(self, tails: list) -> tuple[list, list[list]]:
        """Return R, the tail of r - M a, and the bounds |M - M_0| by rows; None stands for zero."""
        t, series, record = self._t, self._series, self._series.record
        n, slots = series.size, series._slots
        right: list = [None if f < 0 else tails[f] for f in record.force]
        change: list[list] = [[None] * n for _ in range(n)]
        for (a, b), (node, _) in record.mass.items():
            if node < 0:
                continue
            moved = t.add(self._n[series._x(node), 1], tails[node])
            for i, j in {(a, b), (b, a)}:
                change[i][j] = moved
                more = t.fma(tails[node], self._n[slots["a", j], 0], self._h["mass", i, j])
                right[i] = more if right[i] is None else t.add(right[i], more)
        return right, change

    def _require(self, condition: Any) -> None:
        self._fine = self._t.both(self._fine, condition)

    def _tail(self, i: int, node: Node, tails: list, rest: list, h: Any) -> Any:
        """Return a bound on the coefficients of order N and above of a node."""
        t, series, order = self._t, self._series, self._order
        slots, op, args = series._slots, node.op, node.args
        if op == "place":
            slot = slots["q", node.index]
            known = t.add(t.abs(t.load(slot, order)), t.abs(t.load(slot, t.plus(order, 1))))
            return t.fma(t.div(h, t.real(t.plus(order, 2))), rest[node.index], known)
        if op == "velocity":
            return t.add(self._last(node.index), rest[node.index])
        if op == "polynomial":
            return t.number(0.0)
        if op == "sum":
            total = None
            for a, w in zip(args, node.weights[:-1], strict=True):
                weight = t.abs(series._weight(t, self._expansion.scalars, w))
                total = t.mul(weight, tails[a]) if total is None else t.fma(weight, tails[a], total)
            return t.number(0.0) if total is None else total
        if op == "cos":
            return self._pair_tails[1]
        x = args[0]
        # The slope of tanh comes after it; its own tail is part of the rule.
        if op == "product":
            y = args[1]
            nx, ny = self._n[series._x(x), 0], self._n[series._x(y), 0]
            return self._of_product(self._h[i,], nx, tails[x], ny, tails[y])
        if op == "reciprocal":
            slot = series._x(x)
            p = t.sub(t.sub(t.abs(t.load(slot, t.index(0))), self._n[slot, 1]), tails[x])
            self._require(t.less(t.number(0.0), p))
            return t.div(t.fma(tails[x], self._n[series._x(i), 0], self._h[i,]), p)
        if op == "sqrt":
            slot = series._x(i)
            p = t.sub(t.abs(t.load(slot, t.index(0))), self._n[slot, 1])
            r = t.add(tails[x], self._h[i,])
            room = t.sub(t.mul(p, p), r)
            self._require(t.both(t.less(t.number(0.0), p), t.less(t.number(0.0), room)))
            return t.div(r, t.add(p, t.sqrt(self._positive(room))))
        one, tail = t.number(1.0), tails[x]
        if op == "log":
            slot = series._x(x)
            p = t.sub(t.abs(t.load(slot, t.index(0))), self._n[slot, 1])
            room = t.sub(p, tail)
            self._require(t.less(t.number(0.0), room))
            return t.add(t.div(self._h[i,], t.mul(p, self._steps)), t.div(tail, room))
        self._require(t.less(tail, one))
        slope_sum = self._n[series._d(x), 1]
        b = t.div(slope_sum, self._steps)
        if op in ("sin", "exp"):
            self._require(t.less(b, one))
        own = self._n[series._x(i), 0] if ("x", i) in slots else None
        square = t.mul(tail, tail)
        if op == "sin":
            # cosh E - 1 and sinh E for E < 1.
            rise = t.mul(square, t.fma(t.number(0.05), square, t.number(0.5)))
            sinh = t.mul(tail, t.fma(t.number(0.2), square, one))
            partner = args[1]
            h_cos = t.div(self._h[i,], self._steps)  # H(D, cos)/N
            h_sin = t.div(self._h[partner,], self._steps)
            room = t.sub(one, t.mul(b, b))
            s = t.div(t.fma(b, h_sin, h_cos), room)
            c = t.div(t.fma(b, h_cos, h_sin), room)
            all_s = t.add(self._n[series._x(i), 0], s)
            all_c = t.add(self._n[series._x(partner), 0], c)
            self._pair_tails = (
                t.add(s, t.fma(all_s, rise, t.mul(all_c, sinh))),
                t.add(c, t.fma(all_c, rise, t.mul(all_s, sinh))),
            )
            return self._pair_tails[0]
        overlap = t.div(self._h[i,], self._steps)
        if op == "exp":
            s = t.div(overlap, t.sub(one, b))
            growth = t.mul(tail, t.fma(t.number(0.72), tail, one))
            return t.fma(t.add(own, s), growth, s)
        slope = args[1]
        if op == "atan":
            whole = t.add(self._n[series._x(slope), 0], tails[slope])
            return t.fma(tail, whole, t.fma(b, tails[slope], overlap))
        assert op == "tanh"
        z = self._n[series._x(i), 0]
        own_overlap = self._h[i + 1,]  # H(z, z), of the square that makes the slope
        start = t.fma(b, own_overlap, overlap)
        linear = t.sub(one, t.mul(t.add(b, b), z))
        inside = t.sub(t.mul(linear, linear), t.mul(t.number(4.0), t.mul(b, start)))
        self._require(t.both(t.less(t.number(0.0), linear), t.less(t.number(0.0), inside)))
        e = t.div(t.add(start, start), t.add(linear, t.sqrt(self._positive(inside))))
        y = t.add(z, e)
        twice = t.mul(t.number(2.0), t.fma(y, y, one))
        more = t.mul(tail, twice)
        reach = t.add(y, more)
        self._require(t.less(t.fma(reach, reach, one), twice))
        return t.add(e, more)

    def _positive(self, x: Any) -> Any:
        t = self._t
        return t.select(t.less(t.number(0.0), x), x, t.number(0.0))

    def _of_product(self, overlap: Any, nx: Any, ex: Any, ny: Any, ey: Any) -> Any:
        t = self._t
        return t.fma(nx, ey, t.fma(t.add(ny, ey), ex, overlap))


class Plain:
    """The target that computes at once, on numbers of any kind: floats, or others with functions in `xp`.

    On floats its results are those of the unfused print, bit for bit.
    """

    def __init__(self, slots: int, number: Callable = float, xp: Any = None) -> None:
        self._memory: list[dict[int, Any]] = [{} for _ in range(slots)]
        self.number = number
        self._functions: Any = None
        if xp is not None:
            self._functions = {name: getattr(xp, name) for name in (*ELEMENTARY, "sqrt")}

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
            return a * math.inf if a == a and a != 0 else self.number(math.nan)

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

    def select(self, condition: bool, a: Any, b: Any) -> Any:
        return a if condition else b

    def any(self, condition: bool) -> bool:
        return condition

    def real(self, k: int) -> Any:
        return self.number(k)

    def index(self, k: int) -> int:
        return k

    def plus(self, k: int, n: int) -> int:
        return k + n

    def minus(self, a: int, b: int) -> int:
        return a - b

    def load(self, slot: int, k: int) -> Any:
        return self._memory[slot][k]

    def store(self, slot: int, k: int, value: Any) -> None:
        self._memory[slot][k] = value

    def loop(self, first: int, end: int, carried: Sequence, body: Callable) -> list:
        values = list(carried)
        for k in range(first, end):
            values = body(k, values)
        return values

    def repeat(self, times: int, going: bool, carried: Sequence, body: Callable) -> list:
        values = list(carried)
        for count in range(times):
            if not going:
                break
            going, values = body(count, values)
        return values

    def when(self, condition: bool, body: Callable) -> None:
        if condition:
            body()

    def elementary(self, name: str, x: Any) -> Any:
        if self._functions is not None:
            return self._functions[name](x)
        operations, result = elementary(name, fused=False)
        return evaluate(operations, {"x": x})[result]

    def scalars(self, record: SeriesRecord, inputs: dict[str, Any]) -> dict[str, Any]:
        return evaluate(record.scalars, inputs, self._functions)
