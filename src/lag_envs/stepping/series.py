"""One step of any equations of motion by Taylor series, with a proved bound on what the series leaves out.

The algorithm is written only once, for a `Target` (`lag_envs.stepping.target`): something that adds and
multiplies, keeps series in numbered slots and runs loops. Targets print the algorithm as machine code
(`lag_envs.stepping.machine`) or carry it out on Python numbers.

**Series.** Let h be the step and t = hτ. The coefficients in τ of all nodes of the record follow order by
order (sums termwise, products by convolution, functions by z' = w x'), with q_{k+1} = h v_k/(k+1), v_{k+1}
= h a_k/(k+1), and the accelerations from::

    M_0 a_k = r_k - Σ_{j=1..k} M_j a_{k-j}

with M_0⁻¹ found once, as numbers. docs/engine.md derives all of this.

**Certificate.** |x| is the sum of absolute coefficients, E_x a bound on the sum of those of order N and
above. The coefficients below N of every node, and v_N, are known. Suppose that those of the velocities beyond
N sum up to E_v at most. Then tails follow node by node, see `Certificate`. With R the tail of r - Ma, a cut
after N - 1, the step is accepted if for some E_a > 0::

    |M_0⁻¹| (R + |M - M_0| E_a) < E_a  (strictly, in every row)     and     hE_a/(N+1) <= E_v.

Proof: v_{k+1} = h a_k/(k+1), and a_k depends on coefficients up to order k only. So if the partial sums of
the tails up to k obey E_v and E_a, those up to k + 1 do; they stay bounded, so the series converges on the
whole step and is the solution. That the inequality is strict makes M invertible throughout. What is proved is
the truncation of each substep: rounding and the growth of earlier errors come on top.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from lag_envs.stepping.certificate import Certificate
from lag_envs.stepping.lowering import ELAPSED, KNOWN, Node, SeriesRecord
from lag_envs.stepping.matrices import Inverse, matrix_times
from lag_envs.stepping.slots import ExpansionStart, Factor, SeriesSlots
from lag_envs.stepping.target import Target

#: The largest order of a series, and the least one that a task may choose; lower ones would not pay.
LARGEST_ORDER, LEAST_ORDER = 24, 6

#: Largest truncation error of a substep, relative to the size of the velocities.
TOLERANCE = 1e-14
#: While a control that lags is still far from its command, a substep is at most this many time constants.
REACH = 2.0
#: Numbers that are set aside for one series: a velocity has N + 1 of them, and one more if N is odd.
STRIDE = LARGEST_ORDER + 3
#: How many times a step is shortened before it counts as failed.
TRIES = 4


def check_order(name: str, value: Any) -> int:
    """Return an order that a task may choose, or raise a ValueError."""
    if type(value) is not int or not LEAST_ORDER <= value <= LARGEST_ORDER:
        span = f"{LEAST_ORDER} to {LARGEST_ORDER}"
        raise ValueError(f"{name} must be a whole number from {span}, got {value!r:.60}")
    return value


def following(t: Target, order: Any) -> tuple[Any, Any]:
    """Return the weights with which the terms of a derivative's series estimate what follows the last.

    The first is the last term's weight, the second the ratio of each earlier term's weight to that of the
    term after it. A series of which 1e-13 is left out has terms that shrink by 1e-13^(1/(N+1)), which is
    0.0172 (N - 6) within 5 % for N from 8 to 24. The term that follows is smaller than the last by this
    factor. If the last terms are 0 because the series has gaps, earlier ones count instead, with lower
    weights: later terms shrink faster.
    """
    first = t.mul(t.number(0.0172), t.sub(t.real(order), t.number(6.0)))
    least = t.number(0.015)
    first = t.select(t.less(least, first), first, least)
    return first, t.mul(first, t.number(1.0 / 3.0))


def evenly(items: Sequence, most: int) -> list[Sequence]:
    """Return the fewest groups of at most `most` items, nearly equal, since a small group wastes time."""
    n, count = len(items), -(-len(items) // most)
    return [items[i * n // count : (i + 1) * n // count] for i in range(count)]


class StepProgress(NamedTuple):
    """A control step in progress.

    Attributes
    ----------
    q, v : sequence of number
        Places and velocities.
    attempts : number
        Number of attempts so far.
    left : number
        What is left of the step [s]; 0 where it is done.
    wish : number
        The substep that is to be tried next [s].
    """

    q: Sequence
    v: Sequence
    attempts: Any
    left: Any
    wish: Any


class Series(SeriesSlots):
    """The step of a record.

    Parameters
    ----------
    record : SeriesRecord
        What is to be computed.
    """

    def __init__(self, record: SeriesRecord) -> None:
        super().__init__(record)
        #: For each node 1 - tanh² that is the slope of a tanh, the node of its argument.
        self._slopes_of_tanh = {x.args[1]: x.args[0] for x in record.nodes if x.op == "tanh"}

    def expand(
        self, t: Target, inputs: dict[str, Any], q: Sequence, v: Sequence, h: Any, order: Any
    ) -> ExpansionStart:
        """Fill the slots with coefficients: velocities up to the order N, the rest below N.

        Parameters
        ----------
        t : Target
            The target to which the coefficients are written.
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
            if ("d", n) in self.slot_of:
                t.store(self.slot_of["d", n], t.index(0), zero)
            if node.op == "sqrt":
                halves[n] = t.div(t.number(0.5), known[n])
            if node.op in KNOWN and n in self.live:
                self._lay_out(t, n, node, scalars, h, order)
        for i in range(self.size):
            t.store(self.slot_of["v", i], t.index(0), v[i])
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
        if ("x", n) in self.slot_of:
            t.store(self.slot_of["x", n], k, value)

    def _entry(self, t: Target, values: dict, scalars: dict, node: int, weight: Any, constant: Any) -> Any:
        """Return an entry of the mass matrix."""
        if node < 0:
            return self.weight(t, scalars, constant)
        value = values[node]
        if weight != 1.0 and constant != 0.0:
            return t.fma(self.weight(t, scalars, weight), value, self.weight(t, scalars, constant))
        if weight != 1.0:
            return t.mul(self.weight(t, scalars, weight), value)
        return value if constant == 0.0 else t.add(value, self.weight(t, scalars, constant))

    def _lay_out(self, t: Target, n: int, node: Node, scalars: dict, h: Any, order: Any) -> None:
        """Store the coefficients of a series that is known, up to the order N."""
        if node.op == "decay":
            self._lay_out_decay(t, n, node, scalars, h, order)
            return
        slot, power = self.slot_of["x", n], h
        zero = t.number(0.0)

        def clear(k: Any, carried: Sequence) -> list:
            t.store(slot, k, zero)
            return []

        t.loop(t.index(1), order, [], clear)
        for k, w in enumerate(node.weights[1:], 1):
            t.store(slot, t.index(k), t.mul(power, self.weight(t, scalars, w)))
            power = t.mul(power, h)

    def _lay_out_decay(self, t: Target, n: int, node: Node, scalars: dict, h: Any, order: Any) -> None:
        slot, power = self.slot_of["x", n], h
        *first, rate = (self.weight(t, scalars, w) for w in node.weights)
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
            return slope_of_tanh(t, zero[self._slopes_of_tanh[n]])
        if op == "place":
            return q[node.index]
        if op == "velocity":
            return v[node.index]
        if op in KNOWN:
            return self.weight(t, scalars, node.weights[0])
        if op == "sum":
            constant = node.weights[-1]
            start = None if constant == 0.0 else self.weight(t, scalars, constant)
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
                weight = self.weight(t, scalars, w)
                total = t.mul(weight, x) if total is None else t.fma(weight, x, total)
        return t.number(0.0) if total is None else total

    def _convolve(self, t: Target, k: Any) -> dict:
        """Return Σ_{0<j<k} A_j B_{k-j} and Σ_{1<j<k} A_j B_{k+1-j} for all pairs, k even.

        Both share what they load: B_{k+1-j} is what B_{k-j} was for the j before.
        """
        unlike = [pair for pair in self.distinct_pairs if pair[0] != pair[1]]
        squares = [pair for pair in self.distinct_pairs if pair[0] == pair[1]]
        sums: dict = {}
        for pairs, end in ((unlike, k), (squares, t.half(k))):
            for some in evenly(pairs, t.group):
                sums |= self._convolve_group(t, k, some, end)
        return sums

    def _convolve_group(self, t: Target, k: Any, pairs: Sequence[tuple[Factor, Factor]], end: Any) -> dict:
        zeros = dict.fromkeys((b for _, b in pairs), t.number(0.0))
        sums, last = self.sum_products(t, k, pairs, t.index(1), end, zeros)
        result = {}
        for (a, b), (even, odd) in sums.items():
            if a == b:  # the sums so far are one half, without the middle
                middle = a.load(t, end)
                even = t.fma(middle, middle, t.add(even, even))
                odd = t.fma(middle, last[b], odd)
                odd = t.add(odd, odd)
            result[a, b] = even, odd
        return result

    def sum_products(
        self,
        t: Target,
        k: Any,
        pairs: Sequence[tuple[Factor, Factor]],
        first: Any,
        end: Any,
        last: dict[Factor, Any],
    ) -> tuple[dict, dict]:
        """Return Σ A_j B_{k-j} and Σ A_j B_{k+1-j} over first <= j < end for some pairs.

        `last` has B_{k+1-first}, or zeros to leave the first product of the second sum out. B_{k+1-end} is
        returned too.
        """
        n = len(pairs)
        lower = list(dict.fromkeys(a for a, _ in pairs))
        upper = list(last)

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

        totals = t.loop(first, end, [*[t.number(0.0)] * (2 * n), *last.values()], accumulate)
        sums = dict(zip(pairs, zip(totals[:n], totals[n : 2 * n], strict=True), strict=True))
        return sums, dict(zip(upper, totals[2 * n :], strict=True))

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
            total = inner_of(self.pairs[key])
            return t.number(0.0) if total is None else total

        def compute(n: int, node: Node) -> Any:
            op, args = node.op, node.args
            if op == "place":
                return t.mul(step, t.load(self.slot_of["v", node.index], before))
            if op == "velocity" or op in KNOWN:
                return self.factor_of(n).load(t, k)
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
            slope = self.slope_of(n)
            if slope.back:
                value = t.mul(step, t.fma(slope.load(t, k), start.zero[args[1]], total))
            else:
                value = t.fma(values[x], start.zero[args[1]], t.mul(per, total))
            return t.neg(value) if op == "cos" else value

        for n in self.live:
            values[n] = compute(n, record.nodes[n])
            if record.nodes[n].op not in KNOWN:
                self._keep(t, n, k, values[n])
            if ("d", n) in self.slot_of:
                t.store(self.slot_of["d", n], k, t.mul(t.real(k), values[n]))
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
                    more = t.mul(self.weight(t, start.scalars, weight), more)
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
            if ("a", i) in self.slot_of:
                t.store(self.slot_of["a", i], k, a[i])
            t.store(self.slot_of["v", i], after, t.mul(step, a[i]))
        return a

    def advance(self, t: Target, q: Sequence, h: Any, order: Any) -> tuple[list, list]:
        """Return places and velocities at the step's end: the sums of their series, small terms first."""
        slots = [self.slot_of["v", i] for i in range(self.size)]

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
                slot = self.slot_of["v", i]
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

        Coefficients of a shorter step are those of h times powers of the ratio of both lengths, so nothing is
        computed again.

        Parameters
        ----------
        t, inputs, q, v, h, order
            See `expand`.
        tolerance : number
            What v may leave out, relative to its size; see `Certificate`.
        wanted : condition, optional
            Where a result is wanted; trying again pays only where one is wanted.

        Returns
        -------
        done : condition
            Whether a step was certified.
        h : number
            The length of that step, or of the shortest step that was tried.
        q, v : list of number
            Places and velocities at its end; meaningless where there was none.
        bounds : list of number
            Bounds on what v leaves out; q leaves out at most h/(N+2) times as much.
        """
        start = self.expand(t, inputs, q, v, h, order)
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
        for x in (*q, *v):  # a step that overflows is not done
            done = t.both(done, t.less(t.abs(x), t.number(math.inf)))
        return done, h, q, v, bounds

    def _within_lags(self, t: Target, inputs: dict[str, Any], h: Any) -> Any:
        """Return a step, at most h, that is short enough for lagged controls.

        With z = h/τ, an exponential's coefficients sum up to e^z times its size. It has died out as far as
        e^(-z) after a time of z, so steps may double. Much longer steps would not be certified, and terms
        that cancel would be taken for large velocities.
        """
        for name in self.record.inputs:
            if name.startswith("decay_"):
                gap = inputs[f"gap_{name.removeprefix('decay_')}"]
                reach = t.add(inputs[ELAPSED], t.div(t.number(REACH), inputs[name]))
                # Without the margin, a rounding could leave a remainder too short to be stepped.
                over = t.less(t.mul(t.number(1.001), reach), h)
                shorter = t.both(over, t.less(t.number(0.0), t.abs(gap)))
                h = t.select(shorter, reach, h)
        return h

    def substep(
        self, t: Target, inputs: dict[str, Any], lane: StepProgress, dt: Any, order: Any, tolerance: Any
    ) -> tuple[StepProgress, list]:
        """Continue an unfinished control step dt by as much as one expansion gives.

        Returns
        -------
        lane : StepProgress
            The control step afterwards; it is unchanged if nothing was left, or nothing could be certified.
        bounds : list of number
            Bounds on what places and velocities leave out.
        """
        zero = t.number(0.0)
        wanted = t.less(zero, lane.left)
        inputs = self._inputs_at(t, inputs, dt, lane.left)
        wish = self._within_lags(t, inputs, lane.wish)
        done, tried, q, v, bounds = self.attempt(t, inputs, lane.q, lane.v, wish, order, tolerance, wanted)
        done = t.both(done, wanted)
        used = t.select(done, tried, zero)
        left = t.sub(lane.left, used)
        # The next substep is twice as long, or takes all that is left if that is less than three times this
        # substep.
        longer = t.select(t.less(left, t.mul(t.number(3.0), used)), left, t.add(used, used))
        after = StepProgress(
            [t.select(done, x, before) for x, before in zip(q, lane.q, strict=True)],
            [t.select(done, x, before) for x, before in zip(v, lane.v, strict=True)],
            t.add(lane.attempts, t.select(wanted, t.number(1.0), zero)),
            left,
            t.select(done, longer, tried),
        )
        per = t.mul(used, t.reciprocal(t.plus(order, 2)))
        bounds = [*(t.mul(per, bound) for bound in bounds), *bounds]
        return after, [t.select(done, bound, zero) for bound in bounds]

    def _inputs_at(self, t: Target, inputs: dict[str, Any], dt: Any, left: Any) -> dict[str, Any]:
        """Return the inputs when the given part of a control step dt is left."""
        return inputs | {ELAPSED: t.sub(dt, left)} if ELAPSED in self.record.inputs else inputs


def slope_of_tanh(t: Target, x: Any) -> Any:
    """Return 1 - tanh², with all digits also where tanh is nearly 1.

    Computed literally, 1 - tanh² would have few digits or none, and so would all coefficients of tanh. Where
    tanh rounds to 1 they would be 0, and a step on which it falls to 0 would be certified as if it stayed 1.
    """
    fading = t.elementary("exp", t.mul(t.number(-2.0), t.abs(x)))
    grown = t.add(t.number(1.0), fading)
    return t.div(t.mul(t.number(4.0), fading), t.mul(grown, grown))
