"""The content of a section of the report, independent of its layout: text, tables, pictures, claims."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure


@dataclass(frozen=True)
class Table:
    """A table in which numbers remain numbers, so that the CSV file has all their digits."""

    name: str  #: of the CSV file, and the anchor
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]

    @classmethod
    def of(
        cls, name: str, caption: str, columns: Mapping[str, str | Callable[[Any], Any]], found: Iterable[Any]
    ) -> Table:
        """Return a table with a line for each item of `found`.

        A column shows an entry of the item, or what a function returns for the item.

        Examples
        --------
        >>> columns = {"scene": "name", "error [%]": lambda row: 100.0 * row["error"]}
        >>> Table.of("errors", "Errors.", columns, [{"name": "bar", "error": 0.5}]).rows
        [['bar', 50.0]]
        """
        cells = [
            [row[get] if isinstance(get, str) else get(row) for get in columns.values()] for row in found
        ]
        return cls(name, caption, list(columns), cells)

    def part(self, name: str, caption: str, columns: Sequence[str]) -> Table:
        """Return a table with some of the columns."""
        places = [list(self.columns).index(column) for column in columns]
        return Table(name, caption, columns, [[row[i] for i in places] for row in self.rows])


@dataclass(frozen=True)
class ReportFigure:
    """A figure, which is drawn when its file is written."""

    name: str  #: of the file
    caption: str  #: the content, the cases, and the reference
    draw: Callable[[], Figure]
    raster: bool = False  #: many cells or points: PNG instead of SVG


@dataclass(frozen=True)
class Claim:
    """A measured statement; `holds` is None if nothing was measured that could decide it."""

    text: str
    holds: bool | None
    evidence: str


@dataclass(frozen=True)
class Content:
    """A section."""

    title: str
    text: Sequence[str]  #: paragraphs: what was measured, how, against which reference
    tables: Sequence[Table] = ()
    pictures: Sequence[ReportFigure] = ()
    claims: Sequence[Claim] = ()
    summary: Table | None = None  #: a small table for docs/accuracy.md
    details: Sequence[Table] = ()  #: long tables: CSV only
