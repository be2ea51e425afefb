"""The step of `lag_envs.stepping.series` backwards, from the gradient at its end to that at its start.

A small change of the motion obeys M δa = δF - δM a. So the cotangents μ of places and ν of velocities, with
M σ = ν and g = σᵀ(F - M a), obey the adjoint equation::

    dμ/dt = -∂g/∂q,     dν/dt = -μ - ∂g/∂v

whose derivatives are taken with σ and a held fixed. The integration starts at the end of a substep and goes
back in time, so both series are expanded at that end: first the series of the motion, then that of the
cotangents, order by order. The derivatives of g follow node by node from the last to the first. A product z =
x y adds the series z̄ y to x̄ and z̄ x to ȳ; a function with z' = w x' adds z̄ w. Therefore an order costs at
most two sums of products where the series of the motion has one. The gradient with respect to a weight w is
the integral of ∂g/∂w. The terms of all these series show how much the series leave out. The lengths of the
substeps are held fixed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from lag_envs.stepping.lowering import FUNCTIONS, KNOWN, Node, SeriesRecord
from lag_envs.stepping.matrices import matrix_times
from lag_envs.stepping.series import STRIDE, Series, StepProgress, evenly, following
from lag_envs.stepping.slots import ExpansionStart, Factor
from lag_envs.stepping.target import Target


class Backward(Series):
    """The step of a record backwards.

    Parameters
    ----------
    record : SeriesRecord
        What is stepped, made with tangents.
    sources : tuple of str
        Names in the record's tangents; gradients are taken with respect to these, places and velocities.
    """

    def __init__(self, record: SeriesRecord, sources: tuple[str, ...]) -> None:
        self._sources = sources
        #: Weights that depend on sources.
        self._active = [
            name for name, slopes in record.tangents.items() if any(source in sources for source in slopes)
        ]
        super().__init__(record)
        del self.slots  # more series are needed than for the step
        #: Products of a cotangent's series with one of the motion, by what needs them.
        self.products: dict[tuple, tuple[Factor, Factor]] = {}
        self._reached = self._find_reached()
        for n in self._reached:
            self._plan_back(n, record.nodes[n])
        for (i, j), entry in record.mass.items():
            self._plan_entry(i, j, *entry)
        self._distinct = list(dict.fromkeys(self.products.values()))
        #: Series whose sums are wanted: the cotangents, and the integrals that belong to weights.
        self._found = [
            *(self._slot(kind, i) for kind in ("q bar", "v bar") for i in range(self.size)),
            *(self._slot("weight bar", i) for i in range(len(self._active))),
        ]
        self.slots = len(self.slot_of)

    @property
    def entries(self) -> int:
        """The number of coefficients that a lane needs."""
        return STRIDE * self.slots

    # --- which series are kept -----------------------------------------------------------------------------

    def _find_live(self) -> list[int]:
        """Return the nodes whose series are kept, including those that active weights multiply."""
        sums = [node for n in self._find_reached() if (node := self.record.nodes[n]).op == "sum"]
        pairs = [pair for node in sums for pair in zip(node.args, node.weights, strict=False)]
        return sorted({*super()._find_live(), *(a for a, weight in pairs if weight in self._active)})

    def _find_reached(self) -> list[int]:
        """Return the nodes that g depends on, including the arguments of functions."""
        return self._reach(lambda args: args[:1])

    def _plan_back(self, n: int, node: Node) -> None:
        def plan(i: int, kind: str, other: int) -> None:
            self.products[n, i] = Factor(self._slot(kind, n)), self.factor_of(other)

        args = node.args
        if node.op == "product":
            plan(0, "bar", args[1])
            plan(1, "bar", args[0])
        elif node.op == "reciprocal":  # x̄ = -z̄ z z
            plan(0, "bar", n)
            plan(1, "share", n)
        elif node.op == "sqrt":  # 2 x̄ z = z̄
            plan(0, "share", n)
        elif node.op in FUNCTIONS:
            plan(0, "bar", args[1])
        elif node.op == "sum":
            for i, (a, w) in enumerate(zip(args, node.weights, strict=False)):
                if w in self._active:
                    plan(i, "bar", a)

    def _plan_entry(self, i: int, j: int, node: int, weight: Any, constant: Any) -> None:
        if node < 0 and constant not in self._active:
            return
        for row, column in {(i, j), (j, i)}:
            s = Factor(self._slot("s", row))
            self.products["entry", row, column] = s, Factor(self._slot("a", column))
            if node >= 0:
                self.products["solve", column, row] = s, self.factor_of(node)
        if weight in self._active:
            bar = Factor(self._slot("entry bar", self.size * i + j))
            self.products["weight", i, j] = bar, self.factor_of(node)

    # --- the step ------------------------------------------------------------------------------------------

    def vjp(
        self,
        t: Any,
        inputs: dict[str, Any],
        end: StepProgress,
        dt: Any,
        order: Any,
        bars: Sequence,
    ) -> list:
        """Take a substep backwards.

        Parameters
        ----------
        t, inputs, dt, order
            See `substep`.
        end : StepProgress
            The lane after the substep, with the substep's length in place of the next one's.
        bars : sequence of number
            Cotangents of places, then of velocities after the substep, then of the sources.

        Returns
        -------
        list of number
            Cotangents before the substep, with those of the sources added up; then an estimate of what they
            leave out, relative to them.
        """
        length = end.wish
        here = self._inputs_at(t, inputs, dt, end.left)
        start = self.expand(t, here, end.q, end.v, t.neg(length), order)
        found, rest, sizes = self._sweep(t, start, length, order, bars)
        return [*found, self._largest_ratio(t, length, rest, sizes, bars)]

    def _largest_ratio(self, t: Target, h: Any, parts: Sequence, *wholes: Sequence) -> Any:
        """Return the largest ratio of parts of cotangents to their sizes before and after the step.

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

    # --- the cotangents' series ----------------------------------------------------------------------------

    def _sweep(
        self, t: Target, start: ExpansionStart, h: Any, order: Any, ends: Sequence
    ) -> tuple[list, list, list]:
        """Return the cotangents before the step just expanded at its end, what they leave out, and sizes.

        They come from those after it; what is left out is estimated as in `following`. See `_collect`.
        """
        first, n = t.index(0), self.size
        initial = [*ends[: 2 * n], *[t.number(0.0)] * len(self._active)]
        for slot, x in zip(self._found, initial, strict=True):
            t.store(slot, first, x)

        def newest(k: Any, product: tuple[Factor, Factor], total: Any) -> Any:
            """Add A_k B_1."""
            return t.fma(product[0].load(t, k), product[1].load(t, t.index(1)), total)

        def two_orders(k: Any, carried: Sequence) -> list:
            sums = self._convolve_back(t, k)
            self._one_order_back(t, start, h, k, lambda product: sums[product][0])
            after = t.plus(k, 1)
            self._one_order_back(t, start, h, after, lambda product: newest(k, product, sums[product][1]))
            return []

        def one_order(k: Any, carried: Sequence) -> list:
            return self._one_order_back(t, start, h, k, lambda product: t.number(0.0))

        half = t.half(order)
        odd = t.minus(t.minus(order, half), half)
        t.loop(first, odd, [], one_order)  # of an odd number of orders, the first alone
        t.loop(odd, order, [], two_orders, step=2)
        return self._collect(t, start, order, ends)

    def _convolve_back(self, t: Target, k: Any) -> dict:
        """Return Σ_{j<k} A_j B_{k-j} and Σ_{j<k} A_j B_{k+1-j} for all products."""
        sums: dict = {}
        for some in evenly(self._distinct, t.group):
            last = {b: b.load(t, t.plus(k, 1)) for _, b in some}
            sums |= self.sum_products(t, k, some, t.index(0), k, last)[0]
        return sums

    def _one_order_back(self, t: Target, start: ExpansionStart, h: Any, k: Any, sum_of: Callable) -> list:
        """Compute the coefficients of order k + 1, with Σ_{j<k} A_j B_{k-j} from `sum_of`."""
        order = _Order(self, t, start, k, sum_of)
        after = t.plus(k, 1)
        step = t.mul(h, t.reciprocal(after))
        self._solve_back(order)
        for i in reversed(self._reached):
            node, bar = self.record.nodes[i], order.bars[i]
            order.keep("bar", i, bar)
            if node.op in KNOWN:
                self._integrate_known(order, node, bar, h, step)
            elif node.op == "sum":
                self._sum_back(order, i, node, bar)
            elif node.op in ("place", "velocity"):
                order.add(order.moving, (node.op, node.index), bar)
            else:
                self._node_back(order, i, node, bar)
        for i in range(self.size):
            q_bar, v_bar = (self.slot_of[kind, i] for kind in ("q bar", "v bar"))
            rate = t.load(q_bar, k)
            if ("velocity", i) in order.moving:
                rate = t.add(rate, order.moving["velocity", i])
            t.store(v_bar, after, t.mul(step, rate))
            t.store(q_bar, after, t.mul(step, order.moving.get(("place", i), t.number(0.0))))
        for i, name in enumerate(self._active):
            total = order.integrals.get(name, t.number(0.0))
            total = t.fma(step, order.rates[name], total) if name in order.rates else total
            t.store(self.slot_of["weight bar", i], after, total)
        return []

    def _solve_back(self, order: _Order) -> None:
        """Find σ with M σ = ν, and what it gives to forces and to entries of the mass matrix."""
        t, record, scalars = order.t, self.record, order.start.scalars
        right = [t.load(self.slot_of["v bar", i], order.k) for i in range(self.size)]
        for (i, j), (node, weight, _) in record.mass.items():
            for row, column in {(i, j), (j, i)} if node >= 0 else ():
                less = order.before(("solve", row, column))
                less = less if weight == 1.0 else t.mul(self.weight(t, scalars, weight), less)
                right[row] = t.sub(right[row], less)
        found = matrix_times(t, order.start.inverse.rows, right)
        s = [t.number(0.0) if x is None else x for x in found]
        for i, f in enumerate(record.force):
            order.keep("s", i, s[i])
            if f >= 0:
                order.add(order.bars, f, s[i])
        for (i, j), (node, weight, constant) in record.mass.items():
            if node < 0 and constant not in self._active:
                continue
            bar = order.whole(("entry", i, j), s[i])
            bar = t.neg(bar if i == j else t.add(bar, order.whole(("entry", j, i), s[j])))
            if constant in self._active:
                order.add(order.rates, constant, bar)
            if weight in self._active:
                order.keep("entry bar", self.size * i + j, bar)
                order.add(order.rates, weight, order.whole(("weight", i, j), bar))
            if node >= 0:
                order.add(order.bars, node, bar, weight)

    def _integrate_known(self, order: _Order, node: Node, bar: Any, h: Any, step: Any) -> None:
        """Add to the integrals of z̄ t^m, which belong to a known series' weights; t is at most 0."""
        t, power, after = order.t, step, order.t.plus(order.k, 1)
        for m, weight in enumerate(node.weights):
            if weight in self._active:
                part = t.div(t.real(after), t.real(t.plus(after, m)))
                order.add(order.integrals, weight, t.mul(bar, t.mul(power, part) if m else power))
            power = t.neg(t.mul(power, h))

    def _sum_back(self, order: _Order, n: int, node: Node, bar: Any) -> None:
        for i, (a, weight) in enumerate(zip(node.args, node.weights, strict=False)):
            order.add(order.bars, a, bar, weight)
            if weight in self._active:
                order.add(order.rates, weight, order.whole((n, i), bar))
        if node.weights[-1] in self._active:
            order.add(order.rates, node.weights[-1], bar)

    def _node_back(self, order: _Order, n: int, node: Node, bar: Any) -> None:
        t, op, args, bars = order.t, node.op, node.args, order.bars
        if op == "product":
            order.add(bars, args[0], order.whole((n, 0), bar))
            order.add(bars, args[1], order.whole((n, 1), bar))
        elif op == "reciprocal":
            share = order.whole((n, 0), bar)
            order.keep("share", n, share)
            order.add(bars, args[0], order.whole((n, 1), share), -1.0)
        elif op == "sqrt":
            half = t.mul(t.number(0.5), bar)
            share = t.div(t.sub(half, order.before((n, 0))), order.start.zero[n])
            order.keep("share", n, share)
            order.add(bars, args[0], share)
        else:  # z' = w x'; of a cosine, w is the sine
            assert op in FUNCTIONS
            order.add(bars, args[0], order.whole((n, 0), bar), -1.0 if op == "cos" else 1.0)

    def _collect(
        self, t: Target, start: ExpansionStart, order: Any, ends: Sequence
    ) -> tuple[list, list, list]:
        """Return the sums of the series, small terms first, what they leave out, and their sizes.

        The gradient by a source is a sum over weights, which may cancel: its size is that of the terms.
        """
        first, per_order = following(t, order)
        count, zero = len(self._found), t.number(0.0)

        def down(m: Any, carried: Sequence) -> list:
            (weight, *sums), k = carried, t.minus(order, m)
            terms = [t.load(slot, k) for slot in self._found]
            wholes = [t.add(total, x) for total, x in zip(sums[:count], terms, strict=True)]
            parts = [t.fma(weight, t.abs(x), total) for total, x in zip(sums[count:], terms, strict=True)]
            return [t.mul(weight, per_order), *wholes, *parts]

        _, *sums = t.loop(t.index(0), t.plus(order, 1), [first, *[zero] * (2 * count)], down)
        wholes, parts = sums[:count], sums[count:]
        moving = 2 * self.size
        found, rest, sizes = wholes[:moving], parts[:moving], wholes[:moving]
        for source, total in zip(self._sources, ends[moving:], strict=True):
            part = size = zero
            for name, bar, more in zip(self._active, wholes[moving:], parts[moving:], strict=True):
                slope = self.record.tangents[name].get(source, 0.0)
                if slope != 0.0:
                    slope = self.weight(t, start.scalars, slope)
                    total, slope = t.fma(bar, slope, total), t.abs(slope)
                    part, size = t.fma(more, slope, part), t.fma(t.abs(bar), slope, size)
            found.append(total)
            rest.append(part)
            sizes.append(size)
        return found, rest, sizes


class _Order:
    """The results of an order while it is computed.

    Attributes
    ----------
    bars, moving, rates : dict
        Coefficients of order k of the derivatives of g by nodes, by places and velocities, and by weights.
    integrals : dict
        Coefficients of order k + 1 of the integrals that belong to weights of known series.
    """

    def __init__(self, step: Backward, t: Target, start: ExpansionStart, k: Any, sum_of: Callable) -> None:
        self._step, self._sum_of = step, sum_of
        self.t, self.start, self.k = t, start, k
        self.bars: dict[int, Any] = {}
        self.moving: dict[tuple[str, int], Any] = {}
        self.rates: dict[Any, Any] = {}
        self.integrals: dict[Any, Any] = {}

    def before(self, key: tuple) -> Any:
        """Return a product's sum without its last term, A_k B_0."""
        return self._sum_of(self._step.products[key])

    def whole(self, key: tuple, newest: Any) -> Any:
        """Return a product's sum, where A_k is the newest coefficient."""
        last = self._step.products[key][1].load(self.t, self.t.index(0))
        return self.t.fma(newest, last, self.before(key))

    def add(self, to: dict, key: Any, x: Any, weight: Any = 1.0) -> None:
        """Add a weight times a number to an entry."""
        t = self.t
        if isinstance(weight, float) and abs(weight) == 1.0:
            x = x if weight > 0.0 else t.neg(x)
            to[key] = t.add(to[key], x) if key in to else x
        else:
            weight = self._step.weight(t, self.start.scalars, weight)
            to[key] = t.fma(weight, x, to[key]) if key in to else t.mul(weight, x)

    def keep(self, kind: str, i: int, value: Any) -> None:
        """Store a coefficient if it is needed later."""
        if (kind, i) in self._step.slot_of:
            self.t.store(self._step.slot_of[kind, i], self.k, value)
