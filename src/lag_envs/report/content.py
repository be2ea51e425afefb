"""The content of a section of the report, independent of its layout: text, tables, pictures, claims."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Table:
    """A table; numbers stay numbers, so that the CSV file has all their digits."""

    name: str  #: of the CSV file, and the anchor
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]


@dataclass(frozen=True)
class ReportFigure:
    """A figure, drawn when it is written."""

    name: str  #: of the file
    caption: str  #: the content, the cases, and the reference
    draw: Callable[[], Figure]
    raster: bool = False  #: many cells or points: PNG instead of SVG


@dataclass(frozen=True)
class Claim:
    """A measured statement; `holds` is None if there was nothing to measure it by."""

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
    summary: Table | None = None  #: a small table for the README
    details: Sequence[Table] = ()  #: long tables: CSV only
