"""Rows of numbers, as compiled code reads and writes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class Rows:
    """Rows of numbers in an array: row r lies at ``array[first + r * stride]``.

    Parameters
    ----------
    names : sequence of str
        All rows, in their order.
    array, first : str
        As printed.
    stride : int or str
        A number, if it is known; then indices are unsigned. (A signed one could be negative, and by NumPy's
        rules that needs a branch.)
    """

    def __init__(self, names: Sequence[str], array: str, first: str, stride: int | str) -> None:
        self.names, self.array, self.first, self.stride = list(names), array, first, stride

    def at(self, row: str) -> str:
        """Return the place of a row."""
        r, stride = self.names.index(row), self.stride
        beyond = f"np.uint64({r * stride})" if isinstance(stride, int) else f"{r} * {stride}"
        return f"{self.array}[{self.first} + {beyond}]"

    def load(self, rows: Sequence[str], names: Sequence[str] | None = None) -> list[str]:
        """Return the line that reads rows into variables, by default of their names."""
        return [f"{', '.join(names or rows)}, = read_rows({self._places(rows)})"] if rows else []

    def store(self, rows: Sequence[str], values: Sequence[Any] | None = None) -> list[str]:
        """Return the line that writes values into rows, by default the variables of their names."""
        return [f"write_rows({self._places(rows)}, ({', '.join(map(str, values or rows))},))"] if rows else []

    def _places(self, rows: Sequence[str]) -> str:
        numbers = "".join(f"{self.names.index(row)}, " for row in rows)
        return f"{self.array}, {self.first}, {self.stride}, ({numbers})"
