"""The step of `lag_envs.stepping.series` backwards: from the gradient at its end to that at its start.

The series that ends a control step is still available; those of earlier substeps are expanded again. Then the
recurrences are traversed from the highest order to the lowest. Each is a relation that is linear in the
coefficient that it gives and bilinear in the others, such as Σ_j x_j z_{k-j} = 0 of a reciprocal. The
cotangent P_k of its Σ_j A_j B_{k-j} is kept. The cotangents of its factors are then sums of products too:
that of A_j is Σ_{k>j} P_k B_{k-j}. So an order costs two sums where the series has one. The lengths of the
substeps are held fixed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from lag_envs.stepping.lowering import FUNCTIONS, KNOWN, SeriesRecord
from lag_envs.stepping.matrices import matrix_times
from lag_envs.stepping.paired import Pair, PairTarget
from lag_envs.stepping.series import STRIDE, ExpansionStart, Factor, Series, StepProgress, following
from lag_envs.stepping.target import Target


class Backward(Series):
    """The step of a record, forwards and backwards.

    Parameters
    ----------
    record : SeriesRecord
        What is stepped, made with tangents.
    sources : tuple of str
        Names in the record's tangents: gradients are with respect to them, places and velocities.
    """

    def __init__(self, record: SeriesRecord, sources: tuple[str, ...]) -> None:
        super().__init__(record)
        self._sources = sources
        #: Weights that sources change.
        self._active = [
            name for name, slopes in record.tangents.items() if any(source in sources for source in slopes)
        ]
        del self.slots  # more series are needed than for the step
        for i in range(self.size):
            self._slot("a", i)
        for n in self.live:
            node = record.nodes[n]
            if node.op == "sum":
                for a, w in zip(node.args, node.weights, strict=False):
                    if w in self._active:
                        self.factor_of(a)
        self.slots = len(self.slot_of)
        #: Slots of cotangents: of each node's or matrix entry's sum of products; and, by slot, of series to
        #: which several orders add, or which are known, and so wanted at the end.
        self._sums = {key: self.slots + i for i, key in enumerate(self.pairs)}
        first, rates = self.slots + len(self._sums), {a.slot for a, _ in self.pairs.values() if a.back}
        kept = [
            slot
            for (kind, i), slot in self.slot_of.items()
            if kind == "v" or slot in rates or self._is_known(kind, i)
        ]
        self._bars = {slot: first + i for i, slot in enumerate(kept)}
        self._cells = {key: i for i, key in enumerate([*record.mass, *self._active])}

    @property
    def entries(self) -> int:
        """How many numbers a lane needs: coefficients, and pairs of cotangents."""
        return STRIDE * (self.slots + 2 * self._bar_slots)

    @property
    def _bar_slots(self) -> int:
        """How many slots cotangents need, with those of masses and weights."""
        return self._first_cell - self.slots - (-max(len(self._cells), 1) // STRIDE)

    @property
    def _first_cell(self) -> int:
        return self.slots + len(self._sums) + len(self._bars)

    def _is_known(self, kind: str, i: int) -> bool:
        return kind == "x" and self.record.nodes[i].op in KNOWN

    def pull(
        self,
        t: Any,
        inputs: dict[str, Any],
        lane: StepProgress,
        dt: Any,
        order: Any,
        tolerance: Any,
        bars: Sequence,
    ) -> tuple[StepProgress, list, Any]:
        """Take a substep like `substep`; in lanes where it ends the control step, also take it backwards.

        Parameters
        ----------
        t, inputs, lane, dt, order
            See `substep`.
        tolerance : number
            Allowed truncation error of v. If negative, the substep was taken before and is only taken
            backwards: `lane` is its start, and the lane's wish is the certified length.
        bars : sequence of number
            Cotangents of places, then of velocities after the substep, then of the sources.

        Returns
        -------
        lane : StepProgress
            The lane after the substep.
        bars : list of number
            Cotangents before the substep in lanes that went backwards, with those of the sources added up;
            then an estimate of what they leave out, relative to them.
        back : condition
            Whether lanes that ended their control step went backwards. They do not if they are only a few of
            the lanes of a vector.
        """
        zero, again = t.number(0.0), t.less(tolerance, t.number(0.0))
        wanted = t.both(t.negated(again), t.less(zero, lane.left))
        inputs, h = self._before(t, inputs, lane, dt)
        start = self.expand(t, inputs, lane.q, lane.v, h, order)
        n = self.size

        def certify() -> list:
            found = self._certified(t, start, lane.q, h, order, tolerance, wanted)
            after, _ = self._after(t, lane, order, wanted, *found)
            return [*after.q, *after.v, *after[2:]]

        after = t.when(t.negated(t.all(again)), certify, [*lane.q, *lane.v, *lane[2:]])
        lane = StepProgress(after[:n], after[n : 2 * n], *after[2 * n :])
        ended = t.either(again, t.both(wanted, t.negated(t.less(zero, lane.left))))
        back = t.most(ended, wanted)

        def go_back() -> list:
            rest, whole = self._back(t, start, h, order, bars)
            found = [t.select(ended, new, old) for new, old in zip(whole, bars, strict=True)]
            return [*found, self._largest_ratio(t, h, rest, whole, bars)]

        return lane, t.when(back, go_back, [*bars, zero]), back

    def _largest_ratio(self, t: Target, h: Any, parts: Sequence, *wholes: Sequence) -> Any:
        """Return the largest ratio of parts of cotangents to the cotangents before and after the step.

        Those of a coordinate's place and velocity count together: each often passes through zero.
        """
        n = self.size

        def sizes(bars: Sequence) -> list:
            size = [t.abs(bar) for bar in bars]
            return [t.fma(h, *pair) for pair in zip(size[:n], size[n : 2 * n], strict=True)] + size[2 * n :]

        total, least = t.number(0.0), t.number(sys.float_info.min)
        for part, before, after in zip(*map(sizes, (parts, *wholes)), strict=True):
            ratio = t.div(part, t.add(least, t.add(before, after)))
            total = t.select(t.less(total, ratio), ratio, total)
        return total

    def _back(
        self, t: Target, start: ExpansionStart, h: Any, order: Any, ends: Sequence
    ) -> tuple[list, list]:
        """Return what the cotangents leave out, estimated as in `following`, and the cotangents.

        They are those before the step just expanded, from those after it; see `pull`.
        """
        both: Any = PairTarget(t, self.slots, self._bar_slots)
        found = self._sweep(both, start, h, order, ends)
        return [x.last for x in found], [x.whole for x in found]

    def _sweep(self, t: Any, start: ExpansionStart, h: Any, order: Any, ends: Sequence) -> list[Pair]:
        """Return cotangents before the step, each with an estimate of what it leaves out."""
        zero = t.number(0.0)
        first, per_order = following(t, order)
        self._clear(t, order)
        n = self.size

        def seed(m: Any, carried: Sequence) -> list:
            k, (weight,) = t.minus(order, m), carried
            per = t.mul(h, t.reciprocal(t.plus(k, 1)))
            for i in range(n):
                bar = t.fma(per, ends[i], ends[n + i])
                t.store(self._bar("v", i), k, Pair(bar, t.mul(weight, bar)))
            return [t.mul(weight, per_order)]

        t.loop(t.index(0), t.plus(order, 1), [first], seed)
        ends = [Pair(end, zero) for end in ends]

        def back(m: Any, carried: Sequence) -> list:
            self._one_order_back(t, start, h, t.minus(order, m), order)
            return []

        t.loop(t.index(1), order, [], back)
        places, weights = self._first_order_back(t, start, h, order)
        velocities = [t.load(self._bar("v", i), t.index(0)) for i in range(n)]
        found = [total if x is None else t.add(x, total) for x, total in zip(places[:n], ends, strict=False)]
        found += [
            x if more is None else t.add(x, more) for x, more in zip(velocities, places[n:], strict=True)
        ]
        sources = zip(self._sources, ends[2 * n :], strict=True)
        return found + [self._of_source(t, start, weights, source, total) for source, total in sources]

    def _of_source(
        self, t: Target, start: ExpansionStart, weights: dict[str, Any], source: str, total: Any
    ) -> Any:
        for name, bar in weights.items():
            slope = self.record.tangents[name].get(source, 0.0)
            if slope != 0.0:
                total = t.fma(bar, self.weight(t, start.scalars, slope), total)
        return total

    # --- cotangents in memory ------------------------------------------------------------------------------

    def _bar(self, kind: str, i: int) -> int:
        return self._bars[self.slot_of[kind, i]]

    def _clear(self, t: Target, order: Any) -> None:
        zero = t.number(0.0)

        def clear(k: Any, carried: Sequence) -> list:
            for (kind, _), slot in self.slot_of.items():
                if kind == "x" and slot in self._bars:
                    t.store(self._bars[slot], k, zero)
            return []

        t.loop(t.index(0), order, [], clear)
        for key in self._cells:
            t.store(*self._cell(t, key), zero)

    def _cell(self, t: Target, key: Any) -> tuple[int, Any]:
        cell = self._cells[key]
        return self._first_cell + cell // STRIDE, t.index(cell % STRIDE)

    def _add(self, t: Target, slot: int, k: Any, a: Any, b: Any) -> None:
        """Add a product to a number in memory."""
        t.store(slot, k, t.fma(a, b, t.load(slot, k)))

    def _weight_bar(self, t: Target, weight: Any, a: Any, b: Any) -> None:
        if weight in self._active:
            self._add(t, *self._cell(t, weight), a, b)

    # --- one order -----------------------------------------------------------------------------------------

    def _gather(self, t: Target, k: Any, order: Any, first: bool = False) -> dict[Factor, Any]:
        """Return what sums of products of higher orders add to cotangents of factors of order k.

        For factors whose cotangents are kept in slots, it is added there.
        """
        products: dict[Factor, list] = {}  # Σ_m P_m B_{m-k} is added to the cotangent of A_k
        for key, (a, b) in self.pairs.items():
            if not (first and isinstance(key, tuple)):  # what M_0 gets is in its cells
                products.setdefault(a, []).append((key, b))
            if a != b:
                products.setdefault(b, []).append((key, a))
        factors, most, waiting = list(products), 2 * t.group, []
        for begin in range(0, len(factors), most):
            some = factors[begin : begin + most]

            def later(i: Any, carried: Sequence, some: Sequence = some) -> list:
                m, found = t.minus(order, i), []  # what was found last is added last
                for factor, total in zip(some, carried, strict=True):
                    for key, other in products[factor]:
                        total = t.fma(t.load(self._sums[key], m), other.load(t, t.minus(m, k)), total)
                    found.append(total)
                return found

            # Several chains of additions keep the processor busy. Their results wait in memory, so that the
            # next chains find room in registers.
            zero = Pair(t.number(0.0), t.number(0.0))
            waiting.append(t.aside(t.loop(t.index(1), t.minus(order, k), [zero] * len(some), later)))
        found = dict(zip(factors, (x for back in waiting for x in back()), strict=True))
        for factor in [factor for factor in found if factor.slot in self._bars]:
            total = found.pop(factor)
            if not (first and factor.back):
                self._add(t, self._bars[factor.slot], t.plus(k, -factor.back), t.number(1.0), total)
        return found

    def _solve_back(self, t: Target, start: ExpansionStart, h: Any, k: Any, found: dict[Factor, Any]) -> list:
        """Go back through M_0 a_k = r and v_{k+1} = h a_k/(k+1); return the cotangents of r."""
        after = t.plus(k, 1)
        step = t.mul(h, t.reciprocal(after))
        a, bars = [], []
        for i in range(self.size):
            slot = self.slot_of["a", i]
            a.append(t.load(slot, k))
            v_bar = t.load(self._bar("v", i), after)
            own = found.get(Factor(slot))
            bars.append(t.mul(step, v_bar) if own is None else t.fma(step, v_bar, own))
        right = [t.number(0.0) if x is None else x for x in matrix_times(t, start.inverse.rows, bars)]
        for i, j in self.record.mass:
            less = t.mul(right[i], a[j])
            less = less if i == j else t.fma(right[j], a[i], less)
            cell = self._cell(t, (i, j))
            t.store(*cell, t.sub(t.load(*cell), less))
        return right

    def _one_order_back(self, t: Target, start: ExpansionStart, h: Any, k: Any, order: Any) -> None:
        """Take the cotangents of all coefficients of order k > 0 to those of lower ones."""
        record, first = self.record, t.index(0)
        found = self._gather(t, k, order)
        bars: dict[int, Any] = {}
        for n in self.live:
            slot = self.slot_of.get(("x", n), -1)
            if slot in self._bars and record.nodes[n].op not in KNOWN:
                bars[n] = t.load(self._bars[slot], k)
            elif Factor(slot) in found:
                bars[n] = found[Factor(slot)]
            if ("d", n) in self.slot_of and (bar := found.get(Factor(self.slot_of["d", n]))) is not None:
                more = t.mul(t.real(k), bar)
                bars[n] = t.add(bars[n], more) if n in bars else more

        def add(n: int, a: Any, b: Any) -> None:
            bars[n] = t.fma(a, b, bars[n]) if n in bars else t.mul(a, b)

        right = self._solve_back(t, start, h, k, found)
        one = t.number(1.0)
        for i, f in enumerate(record.force):
            if f >= 0:
                add(f, right[i], one)
        for (a, b), (node, weight, _) in record.mass.items():
            if node < 0:
                continue
            for i, j in {(a, b), (b, a)}:
                rate, factor = Factor(self.slot_of["a", j]), self.factor_of(node)
                less = t.neg(right[i])
                if weight in self._active:
                    self._weight_bar(t, weight, less, self._product(t, k, factor, rate))
                if weight != 1.0:
                    less = t.mul(less, self.weight(t, start.scalars, weight))
                add(node, less, rate.load(t, first))
                t.store(self._sums[i, j], k, less)
        for n in reversed(self.live):
            if n in bars:
                self._node_back(t, start, n, bars[n], h, k, add)
            elif n in self.pairs:
                t.store(self._sums[n], k, t.number(0.0))

    def _node_back(
        self, t: Target, start: ExpansionStart, n: int, bar: Any, h: Any, k: Any, add: Callable
    ) -> None:
        """Take a node's cotangent of order k to what it was made of, and to its sum of products."""
        node, zero = self.record.nodes[n], start.zero
        op, args = node.op, node.args
        if op == "place":
            step = t.mul(h, t.reciprocal(k))
            self._add(t, self._bar("v", node.index), t.plus(k, -1), step, bar)
        elif op == "velocity" or op in KNOWN:
            self._add(t, self._bars[self.factor_of(n).slot], k, bar, t.number(1.0))
        elif op == "sum":
            for a, weight in zip(args, node.weights, strict=False):
                add(a, bar, self.weight(t, start.scalars, weight))
                if weight in self._active:
                    self._weight_bar(t, weight, bar, self.factor_of(a).load(t, k))
        elif op == "product":
            add(args[0], bar, zero[args[1]])
            add(args[1], bar, zero[args[0]])
            self._keep_sum(t, n, k, bar)
        elif op == "reciprocal":  # Σ x_j z_{k-j} = 0
            less = t.neg(t.mul(bar, zero[n]))
            add(args[0], less, zero[n])
            self._keep_sum(t, n, k, less)
        elif op == "sqrt":  # Σ z_j z_{k-j} = x_k
            half = t.mul(bar, t.div(t.number(0.5), zero[n]))
            add(args[0], half, t.number(1.0))
            self._keep_sum(t, n, k, t.neg(half))
        else:  # k z_k = Σ_{j>0} D_j w_{k-j}
            assert op in FUNCTIONS
            slope = self.slope_of(n)
            bar = t.neg(bar) if op == "cos" else bar
            scaled = t.mul(t.reciprocal(k), bar)
            if slope.back:  # D is h times the argument's rate
                scaled = t.mul(h, scaled)
                self._add(t, self._bars[slope.slot], t.plus(k, -1), scaled, zero[args[1]])
            else:
                add(args[0], bar, zero[args[1]])
            self._keep_sum(t, n, k, scaled)

    def _keep_sum(self, t: Target, n: int, k: Any, bar: Any) -> None:
        """Store the cotangent of a node's sum of products, twice where both factors are the same."""
        a, b = self.pairs[n]
        t.store(self._sums[n], k, t.add(bar, bar) if a == b else bar)

    def _product(self, t: Target, k: Any, a: Factor, b: Factor) -> Any:
        """Return Σ_{0<j<=k} A_j B_{k-j}."""

        def total(j: Any, carried: Sequence) -> list:
            return [t.fma(a.load(t, j), b.load(t, t.minus(k, j)), carried[0])]

        (found,) = t.loop(t.index(1), t.plus(k, 1), [t.number(0.0)], total)
        return found

    # --- order 0 -------------------------------------------------------------------------------------------

    def _first_order_back(
        self, t: Target, start: ExpansionStart, h: Any, order: Any
    ) -> tuple[list, dict[str, Any]]:
        """Return cotangents of places and velocities (None: zero), and of the active weights."""
        record, zero, first, n = self.record, start.zero, t.index(0), self.size
        gathered = self._gather(t, first, order, first=True)
        bars: dict[int, Any] = {}
        for (kind, i), slot in self.slot_of.items():
            if kind == "x" and slot in self._bars:
                bars[i] = t.load(self._bars[slot], first)
            elif kind == "x" and Factor(slot) in gathered:
                bars[i] = gathered[Factor(slot)]
        found: list[Any] = [None] * (2 * n)

        def add(to: Any, key: int, a: Any, b: Any) -> None:
            old = to.get(key) if isinstance(to, dict) else to[key]
            to[key] = t.mul(a, b) if old is None else t.fma(a, b, old)

        one = t.number(1.0)
        for f, bar in zip(record.force, self._solve_back(t, start, h, first, gathered), strict=True):
            if f >= 0:
                add(bars, f, bar, one)
        for place, (entry, weight, constant) in record.mass.items():
            bar = t.load(*self._cell(t, place))
            self._weight_bar(t, constant, bar, one)
            if entry >= 0:
                add(bars, entry, bar, self.weight(t, start.scalars, weight))
                self._weight_bar(t, weight, bar, zero[entry])
        for i in reversed(range(len(record.nodes))):
            node = record.nodes[i]
            op, args = node.op, node.args
            if op in KNOWN and ("x", i) in self.slot_of:
                power = h
                for k, w in enumerate(node.weights[1:], 1):
                    self._weight_bar(t, w, power, t.load(self._bar("x", i), t.index(k)))
                    power = t.mul(power, h)
            if i not in bars:
                continue
            bar = bars[i]
            if op in ("place", "velocity"):
                add(found, node.index + n * (op == "velocity"), bar, one)
            elif op in KNOWN:
                self._weight_bar(t, node.weights[0], bar, one)
            elif op == "sum":
                self._weight_bar(t, node.weights[-1], bar, one)
                for a, w in zip(args, node.weights, strict=False):
                    add(bars, a, bar, self.weight(t, start.scalars, w))
                    self._weight_bar(t, w, bar, zero[a])
            elif op == "product":
                add(bars, args[0], bar, zero[args[1]])
                add(bars, args[1], bar, zero[args[0]])
            elif op == "reciprocal":
                add(bars, args[0], bar, t.neg(t.mul(zero[i], zero[i])))
            elif op == "sqrt":
                add(bars, args[0], bar, t.div(t.number(0.5), zero[i]))
            else:
                add(bars, args[0], t.neg(bar) if op == "cos" else bar, zero[args[1]])
        return found, {name: t.load(*self._cell(t, name)) for name in self._active}
