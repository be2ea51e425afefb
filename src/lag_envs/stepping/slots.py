"""Which series of a record are kept, and in which slots; what an expansion leaves there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from lag_envs.stepping.lowering import FUNCTIONS, KNOWN, Node, SeriesRecord
from lag_envs.stepping.matrices import Inverse
from lag_envs.stepping.target import Target


class Factor(NamedTuple):
    """A factor of a convolution: its coefficient of order k is entry k - back of a slot."""

    slot: int
    back: int = 0

    def load(self, t: Target, k: Any) -> Any:
        """Return the coefficient of order k."""
        return t.load(self.slot, t.plus(k, -self.back))


class ExpansionStart(NamedTuple):
    """An expansion's data besides its slots: coefficients of order 0, the inverse of M_0, weights."""

    zero: dict[int, Any]
    inverse: Inverse
    scalars: dict[str, Any]


class SeriesSlots:
    """The slots of a record's series.

    Parameters
    ----------
    record : SeriesRecord
        What is to be computed.
    """

    def __init__(self, record: SeriesRecord) -> None:
        self.record, self.size = record, record.size
        self.slot_of: dict[tuple[str, int], int] = {}
        #: Nodes of which more than the value is needed.
        self.live = self._find_live()
        #: Products of series, by what needs them: a node or a place (i, j) in the mass matrix.
        self.pairs: dict[Any, tuple[Factor, Factor]] = {}
        for i in range(self.size):
            self._slot("v", i)
        for n in self.live:
            self._plan(n, record.nodes[n])
        for (i, j), (node, _, _) in record.mass.items():
            if node >= 0:
                for row, column in {(i, j), (j, i)}:
                    self.pairs[row, column] = self.factor_of(node), Factor(self._slot("a", column))
        self.distinct_pairs = list(dict.fromkeys(self.pairs.values()))
        #: Number of series that are kept.
        self.slots = len(self.slot_of)

    def _find_live(self) -> list[int]:
        return self._reach(lambda args: args[1:] if len(args) > 2 else args)

    def _reach(self, through: Callable[[Sequence[int]], Sequence[int]]) -> list[int]:
        """Return the nodes that g depends on; `through` chooses among the arguments of functions."""
        found: set[int] = set()
        pending = [*self.record.force, *(node for node, _, _ in self.record.mass.values())]
        while pending:
            n = pending.pop()
            if n >= 0 and n not in found:
                found.add(n)
                node = self.record.nodes[n]
                pending += through(node.args) if node.op in FUNCTIONS else node.args
        return sorted(found)

    def _slot(self, kind: str, i: int) -> int:
        if (kind, i) not in self.slot_of:
            assert not hasattr(self, "slots"), f"nobody planned for {kind}{i}"
            self.slot_of[kind, i] = len(self.slot_of)
        return self.slot_of[kind, i]

    def factor_of(self, n: int) -> Factor:
        """Return the place of a node's coefficients."""
        node = self.record.nodes[n]
        return Factor(self._slot("v", node.index) if node.op == "velocity" else self._slot("x", n))

    def slope_of(self, n: int) -> Factor:
        """Return the place of D_k = k x_k for a function's argument x."""
        args = self.record.nodes[n].args
        if len(args) > 2:
            return Factor(self.factor_of(args[2]).slot, back=1)
        return Factor(self._slot("d", args[0]))

    def _plan(self, n: int, node: Node) -> None:
        if node.op == "product":
            self.pairs[n] = self.factor_of(node.args[0]), self.factor_of(node.args[1])
        elif node.op == "reciprocal":
            self.pairs[n] = self.factor_of(node.args[0]), self.factor_of(n)
        elif node.op == "sqrt":
            self.pairs[n] = self.factor_of(n), self.factor_of(n)
        elif node.op in FUNCTIONS:
            self.pairs[n] = self.slope_of(n), self.factor_of(node.args[1])
        elif node.op in KNOWN:
            self.factor_of(n)

    def weight(self, t: Target, scalars: dict[str, Any], weight: Any) -> Any:
        """Return a weight as a number of the target: a literal, or one of the scalars by name."""
        return scalars[weight] if isinstance(weight, str) else t.number(weight)
