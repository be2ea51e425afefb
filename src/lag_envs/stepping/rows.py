"""Rows of numbers, as compiled code reads and writes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class Rows:
    """Rows of numbers in an array: row r lies at ``array[first + r * stride]``.

    For Numba each line is one step, whereas an index for each row would be a dozen.

    Parameters
    ----------
    names : sequence of str
        All rows, in their order.
    array, first : str
        As printed.
    stride : int or str
        A number, if it is known.
    """

    def __init__(self, names: Sequence[str], array: str, first: str, stride: int | str) -> None:
        self.names, self.array, self.first, self.stride = list(names), array, first, stride

    def load(self, rows: Sequence[str], names: Sequence[str] | None = None) -> list[str]:
        """Return the line that reads rows into variables, by default into variables with the rows' names."""
        return [f"{', '.join(names or rows)}, = read_rows({self._places(rows)})"] if rows else []

    def store(self, rows: Sequence[str], values: Sequence[Any] | None = None) -> list[str]:
        """Return the line that writes values into rows, by default the variables with the rows' names."""
        return [f"write_rows({self._places(rows)}, ({', '.join(map(str, values or rows))},))"] if rows else []

    def copy(self, rows: Sequence[str], size: str, table: str, column: str) -> list[str]:
        """Return the line that copies `size` numbers of successive rows into a table, from a column on."""
        begin = self.names.index(rows[0])
        if self.names[begin : begin + len(rows)] != list(rows):
            raise ValueError(f"rows that are copied must follow one another, got {list(rows)}")
        places = f"{self.array}, {self.first}, {self.stride}, ({begin}, {len(rows)})"
        return [f"copy_rows({places}, {size}, {table}, {column})"]

    def _places(self, rows: Sequence[str]) -> str:
        numbers = "".join(f"{self.names.index(row)}, " for row in rows)
        return f"{self.array}, {self.first}, {self.stride}, ({numbers})"
