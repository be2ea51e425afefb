"""Rows, some of which are stored several times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from lag_envs.stepping.rows import Rows


class Ring(NamedTuple):
    """Rows that are stored several times, in slots that are used in turn."""

    rows: Sequence[str]
    slots: int

    @property
    def names(self) -> list[str]:
        """The rows of all slots, one slot after the other."""
        return [f"{row}_{slot}" for slot in range(self.slots) for row in self.rows]


class RowsWithRings(Rows):
    """Rows, some of which are in rings; the arguments are those of `Rows`."""

    def whole(self, number: object) -> str:
        """Return a whole number as printed, of the type of the indices."""
        return f"np.uint64({number})" if isinstance(self.stride, int) else f"np.int64({number})"

    def in_slot(self, ring: Ring, row: str) -> str:
        """Return the place of a row of a ring, in the slot numbered ``slot``."""
        first, n = self.whole(self.names.index(f"{row}_0")), self.whole(len(ring.rows))
        return f"{self.array}[{self.first} + ({first} + slot * {n}) * {self.whole(self.stride)}]"

    def turn(self, ring: Ring, values: Mapping[str, str], results: Mapping[str, str]) -> list[str]:
        """Return the lines of step ``n`` that write values and read the oldest ones, as results by row."""
        slots = self.whole(ring.slots)
        return [
            f"slot = {self.whole('n')} % {slots}",
            *self.put(ring, values),
            f"slot = (slot + {self.whole(1)}) % {slots}",
            *self.take(ring, results),
        ]

    def take(self, ring: Ring, results: Mapping[str, str]) -> list[str]:
        """Return the lines that read the values in a slot, as results by row."""
        return [f"{result} = {self.in_slot(ring, row)}" for row, result in results.items()]

    def put(self, ring: Ring, values: Mapping[str, str]) -> list[str]:
        """Return the lines that write values into a slot."""
        return [f"{self.in_slot(ring, row)} = {value}" for row, value in values.items()]

    def fill(self, ring: Ring, values: Mapping[str, str]) -> list[str]:
        """Return the lines that write values into all slots."""
        if not ring.slots:
            return []
        slots = f"range({self.whole(ring.slots)})"
        return [f"for slot in {slots}:", *("    " + line for line in self.put(ring, values))]
