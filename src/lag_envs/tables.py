"""The only printers of tables, for terminals and in Markdown, and of the numbers in them.

The core needs no library for them.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Sequence


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align the rows' cells; columns of numbers, with or without a unit, are aligned to the right.

    Examples
    --------
    >>> aligned([("name", "return"), ("a", "1"), ("bc", "-23")])
    ['name  return', 'a          1', 'bc       -23']
    """
    lines: list[list[str]] = [[] for _ in rows]
    for j in range(max(map(len, rows), default=0)):
        cells = [row[j] if j < len(row) else "" for row in rows]
        width = max(map(columns, cells))
        right = all(re.fullmatch(r"(-?[\d.,]+( ?[kMGs%])?|-?)", cell) for cell in cells[1:])
        for line, cell in zip(lines, cells, strict=True):
            blank = " " * (width - columns(cell))
            line.append(blank + cell if right else cell + blank)
    return ["  ".join(line).rstrip() for line in lines]


def columns(text: str) -> int:
    r"""Return how many columns of a terminal a text fills; Chinese characters fill two, marks none.

    Examples
    --------
    >>> columns("Zoë"), columns("Zoe\u0308"), columns("東京")
    (3, 3, 4)
    """
    marks = sum(unicodedata.category(char) in ("Mn", "Me") for char in text)
    return len(text) - marks + sum(unicodedata.east_asian_width(char) in "WF" for char in text)


def markdown_table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    r"""Return a table in Markdown.

    Examples
    --------
    >>> print(markdown_table(["name", "return"], [("a|b", 1)]))
    | name | return |
    | --- | --- |
    | a\|b | 1 |
    """
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(c).replace("|", "\\|") for c in line) + " |" for line in lines)


def number_text(value: float) -> str:
    """Return a number as people write it.

    Examples
    --------
    >>> [number_text(x) for x in (0.02, 1e-06, 100000.0, 210000.0, 1e9, 3.14159265, math.inf, -0.0)]
    ['0.02', '1e-6', '100000', '2.1e5', '1e9', '3.1416', '∞', '0']
    """
    if math.isinf(value):
        return "∞" if value > 0.0 else "-∞"
    if abs(value) == 1e5:
        return f"{value:.0f}"
    return re.sub(r"e([+-])0*", lambda sign: "e" + sign[1].replace("+", ""), f"{value + 0.0:.5g}")


def rate_text(value: float) -> str:
    """Return a rate with three digits.

    Examples
    --------
    >>> rate_text(1234.0), rate_text(41_234_567.0)
    ('1.23 k', '41.2 M')
    """
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= 0.9995 * size:
            return f"{three_digits(value / size)} {unit}"
    return f"{value:.0f}"


def three_digits(value: float) -> str:
    """Return a positive number with three digits, or all before the point."""
    return f"{value:#.3g}".removesuffix(".") if value < 999.5 else f"{value:.0f}"


def mean_with_error(mean: float, error: float, most: int = 6, exact: int = 4) -> str:
    """Return a mean with its standard error, which decides the digits.

    Parameters
    ----------
    mean, error : float
        The numbers.
    most, exact : int
        Digits after the point: at most, and if the error is 0.

    Examples
    --------
    >>> mean_with_error(418.987, 0.0117), mean_with_error(0.000165, 0.0), mean_with_error(-1e-5, 0.0)
    ('418.987 ± 0.012', '0.0002 ± 0.0000', '0.0000 ± 0.0000')
    """
    digits = exact if error <= 0.0 else min(most, max(0, 1 - math.floor(math.log10(error))))
    return f"{mean:z.{digits}f} ± {error:.{digits}f}"
