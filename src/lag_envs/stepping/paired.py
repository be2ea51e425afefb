"""Two cotangents taken backwards side by side: what a step's series gives, and an estimate of the rest.

Going backwards is linear in cotangents, and coefficients of series are the same for both. `PairTarget` makes
a target of such pairs from a plain one. So the recurrences are written once, and both load each coefficient
together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple


class Pair(NamedTuple):
    """A cotangent, and an estimate of the terms that its series leaves out, see `following`."""

    whole: Any
    last: Any


class PairTarget:
    """Pairs of numbers on a target of plain ones, as factors at most once in a product.

    Parameters
    ----------
    target : Target
        Where both are computed.
    first, shift : int
        Slots from `first` on hold pairs. The second of them is `shift` slots behind the first.
    """

    def __init__(self, target: Any, first: int, shift: int) -> None:
        self._t, self._first, self._shift = target, first, shift
        #: Twice as many sums in a loop have to find room in registers.
        self.group = max(1, target.group // 2)

    def __getattr__(self, name: str) -> Any:
        """Leave indices, conditions and numbers that are no pairs to the target."""
        return getattr(self._t, name)

    def _both(self, operation: Callable, *numbers: Any) -> Any:
        if not any(isinstance(x, Pair) for x in numbers):
            return operation(*numbers)
        sides = ([x[i] if isinstance(x, Pair) else x for x in numbers] for i in (0, 1))
        return Pair(*(operation(*side) for side in sides))

    def add(self, a: Any, b: Any) -> Any:
        return self._both(self._t.add, a, b)

    def sub(self, a: Any, b: Any) -> Any:
        return self._both(self._t.sub, a, b)

    def mul(self, a: Any, b: Any) -> Any:
        return self._both(self._t.mul, a, b)

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        return self._both(self._t.fma, a, b, c)

    def neg(self, a: Any) -> Any:
        return self._both(self._t.neg, a)

    def load(self, slot: int, k: Any) -> Any:
        found = self._t.load(slot, k)
        return found if slot < self._first else Pair(found, self._t.load(slot + self._shift, k))

    def store(self, slot: int, k: Any, value: Any) -> None:
        for i in (0, 1):
            self._t.store(slot + i * self._shift, k, value[i] if isinstance(value, Pair) else value)

    def aside(self, values: Sequence) -> Callable[[], list]:
        sides = [self._t.aside(side) for side in zip(*values, strict=True)]
        return lambda: [Pair(*pair) for pair in zip(*(back() for back in sides), strict=True)]

    def loop(self, first: Any, end: Any, carried: Sequence, body: Callable, step: int = 1) -> list:
        pairs = [isinstance(x, Pair) for x in carried]

        def split(values: Sequence) -> list:
            return [y for x, pair in zip(values, pairs, strict=True) for y in (x if pair else (x,))]

        def join(values: Sequence) -> list:
            rest = iter(values)
            return [Pair(next(rest), next(rest)) if pair else next(rest) for pair in pairs]

        found = self._t.loop(first, end, split(carried), lambda k, values: split(body(k, join(values))), step)
        return join(found)
