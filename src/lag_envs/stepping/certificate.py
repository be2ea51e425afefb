"""The test whether a step is certified, and the bounds on what its series leave out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lag_envs.stepping.lowering import Node
from lag_envs.stepping.matrices import matrix_times
from lag_envs.stepping.slots import ExpansionStart, Factor, SeriesSlots
from lag_envs.stepping.target import Target

#: Smaller sizes are replaced by this one; its unit is √(kg m²) m/s, or whatever follows from those of the
#: mass matrix.
SMALLEST_SIZE = 1e-12
#: A part of a step may leave out this many tolerances, relative to the sum of its own terms. In stiff linear
#: motion the terms of the whole step are many orders larger, and one tolerance of their sum would allow
#: anything.
PART_TOLERANCES = 30.0


class Certificate:
    """Bounds on what a step's series leave out; `lag_envs.stepping.series` has the proof.

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

    Each holds for partial sums too, as the proof requires: coefficient k of the left-hand side uses only
    coefficients below k of its own series.
    """

    def __init__(
        self, series: SeriesSlots, t: Target, start: ExpansionStart, h: Any, order: Any, tolerance: Any
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
        self._largest = self._largest_of([self._all[self._series.slot_of["v", i]] for i in range(n)])
        self._sizes = [t.mul(self._largest, per) for per in self._per_root]
        self._allowed = [t.mul(self._tolerance, size) for size in self._sizes]
        self._tails: dict[int, Any] = {}
        for i in self._series.live:
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
        passed = self._fine
        for new, g in zip(again(guess), guess, strict=True):
            passed = t.both(passed, t.less(new, g))
        self._bounds = [t.mul(self._per_next, g) for g in guess]
        for bound, allowed in zip(self._bounds, self._allowed, strict=True):
            passed = t.both(passed, t.less(bound, allowed))
        if part is not None:
            allowed = t.mul(t.number(PART_TOLERANCES), self._tolerance)
            own = t.mul(allowed, self._largest_of(self._sums(part)))
            for bound, per in zip(self._bounds, self._per_root, strict=True):
                passed = t.both(passed, t.less(bound, t.mul(own, per)))
        return passed, self._bounds

    def factor(self) -> Any:
        """Return which part of a step that has just failed the check will probably be certified."""
        t = self._t
        # Bounds grow with the power N + 1 of the step. Where there are no bounds, the last terms serve in
        # their place.
        bounds = terms = t.number(0.0)
        for i, (bound, root) in enumerate(zip(self._bounds, self._roots, strict=True)):
            slot = self._series.slot_of["v", i]
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

    def _largest_of(self, velocities: Sequence) -> Any:
        """Return the size of the largest velocity, measured by energy."""
        total = self._t.number(SMALLEST_SIZE)
        for root, velocity in zip(self._roots, velocities, strict=True):
            total = self._larger(total, self._t.mul(root, velocity))
        return total

    def _sums(self, part: Any) -> list:
        """Return Σ |v_k| of each velocity over a part of the step, below order N."""
        t, slots = self._t, [self._series.slot_of["v", i] for i in range(self._n)]

        def down(m: Any, carried: Sequence) -> list:
            k = t.minus(self._order, m)
            return [
                t.fma(part, total, self._size(slot, k)) for slot, total in zip(slots, carried, strict=True)
            ]

        return t.loop(t.index(1), t.plus(self._order, 1), [t.number(0.0)] * self._n, down)

    def _measure(self) -> None:
        """Find the norms Σ' of all slots, and the overlaps H of all pairs."""
        t, order, most = self._t, self._order, self._t.group
        self._norms: dict[int, Any] = {}
        self._overlaps: dict[tuple[Factor, Factor], Any] = {}
        pairs = self._series.distinct_pairs
        n = -(-len(pairs) // most)
        groups = [pairs[i * len(pairs) // n : (i + 1) * len(pairs) // n] for i in range(n)]
        # A group's sums wait in memory while the registers are needed for the next group's.
        waiting = [t.aside(self._measure_pairs(group)) for group in groups[:-1]]
        sums = [self._measure_pairs(group) for group in groups[-1:]]
        for group, found in zip(groups, [*(back() for back in waiting), *sums], strict=True):
            upper = _factors(group, 1)
            self._norms |= {b.slot: s for b, s in zip(upper, found, strict=False)}
            self._overlaps |= dict(zip(group, found[len(upper) :], strict=True))
        alone = [slot for slot in range(self._series.slots) if slot not in self._norms]
        for first in range(0, len(alone), most):
            some = alone[first : first + most]

            def accumulate(k: Any, carried: Sequence, some: Sequence = some) -> list:
                return [t.add(total, self._size(slot, k)) for slot, total in zip(some, carried, strict=True)]

            totals = t.loop(t.index(1), order, [t.number(0.0)] * len(some), accumulate)
            self._norms |= dict(zip(some, totals, strict=True))

    def _measure_pairs(self, pairs: Sequence[tuple[Factor, Factor]]) -> list:
        """Sum |B_m| for each B, and for each pair |A_j| times the sum of |B_m| over m >= N - j."""
        t, order = self._t, self._order
        lower, upper = _factors(pairs, 0), _factors(pairs, 1)

        def accumulate(j: Any, carried: Sequence) -> list:
            other = t.minus(order, j)
            x = {a: t.abs(a.load(t, j)) for a in lower}
            sums = {b: t.add(s, t.abs(b.load(t, other))) for b, s in zip(upper, carried, strict=False)}
            totals = zip(pairs, carried[len(upper) :], strict=True)
            return [*sums.values(), *(t.fma(x[a], sums[b], total) for (a, b), total in totals)]

        return t.loop(t.index(1), order, [t.number(0.0)] * (len(upper) + len(pairs)), accumulate)

    def _overlap(self, key: Any) -> Any:
        return self._powered(self._overlaps[self._series.pairs[key]])

    def _powered(self, x: Any) -> Any:
        """Return the size of terms of order N and above in the part of the step, from that in the whole."""
        return x if self._power is None else self._t.mul(self._power, x)

    def _norm(self, n: int) -> Any:
        return self._all[self._series.factor_of(n).slot]

    def _balance(self) -> tuple[list, list[list]]:
        """Return R, the tail of r - M a, and the bounds |M - M_0| by rows; None stands for zero."""
        t, series, n = self._t, self._series, self._n
        right: list = [None if f < 0 else self._tails[f] for f in series.record.force]
        change: list[list] = [[None] * n for _ in range(n)]
        for (a, b), (node, weight, _) in series.record.mass.items():
            if node < 0:
                continue
            tail, moved = self._tails[node], self._later[series.factor_of(node).slot]
            scale = None if weight == 1.0 else t.abs(series.weight(t, self._start.scalars, weight))
            for i, j in {(a, b), (b, a)}:
                more = t.fma(tail, self._all[series.slot_of["a", j]], self._overlap((i, j)))
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
            slot = series.slot_of["v", node.index]
            tail = t.add(self._powered(self._size(slot, self._order)), self._allowed[node.index])
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
                weight = t.abs(series.weight(t, self._start.scalars, w))
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
            slot = series.factor_of(x).slot
            p = t.sub(t.sub(self._size(slot, t.index(0)), self._later[slot]), self._tails[x])
            self._require(t.less(t.number(0.0), p))
            return t.div(t.fma(self._tails[x], self._norm(n), self._overlap(n)), p)
        if op == "sqrt":
            slot = series.factor_of(n).slot
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
        last = self._powered(self._size(series.slot_of["x", n], self._order))
        rate = t.abs(series.weight(t, self._start.scalars, node.weights[-1]))
        z = t.mul(rate, self._h)
        b = t.mul(z, self._per_next)
        grown = t.select(
            t.less(b, t.number(0.5)), t.fma(t.number(2.0), b, t.number(1.0)), t.elementary("exp", z)
        )
        # An exponential that has died out leaves nothing, over any time.
        return t.select(t.less(t.number(0.0), last), t.mul(last, grown), last)

    def _tail_of_function(self, n: int, op: str, args: tuple[int, ...]) -> Any:
        t, series = self._t, self._series
        slope = series.slope_of(n)
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


def _factors(pairs: Sequence[tuple[Factor, Factor]], side: int) -> list[Factor]:
    """Return the distinct factors on one side of pairs."""
    return list(dict.fromkeys(pair[side] for pair in pairs))
