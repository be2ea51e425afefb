"""Rows of one environment, alone or in a batch: row r lies at ``f[base + r * stride]``."""

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
    """Rows of one environment, some of them in rings.

    Parameters
    ----------
    kept : sequence of str
        All rows, in their order.
    """

    def __init__(self, kept: Sequence[str]) -> None:
        super().__init__(kept, "f", "base", "stride")

    def in_slot(self, ring: Ring, row: str) -> str:
        """Return the place of a row of a ring, in the slot numbered ``slot``."""
        first = self.names.index(f"{row}_0")
        return f"f[base + ({first} + slot * {len(ring.rows)}) * stride]"

    def put(self, ring: Ring, values: Mapping[str, str]) -> list[str]:
        """Return the lines that write values into a slot."""
        return [f"{self.in_slot(ring, row)} = {value}" for row, value in values.items()]

    def fill(self, ring: Ring, values: Mapping[str, str]) -> list[str]:
        """Return the lines that write values into all slots."""
        if not ring.slots:
            return []
        return [f"for slot in range({ring.slots}):", *("    " + line for line in self.put(ring, values))]
