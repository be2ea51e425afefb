"""Tables in a terminal: the only printer of the commands, so that the core asks for no library for it."""

from __future__ import annotations

import re
from collections.abc import Sequence


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align the rows' cells; what looks like a number goes to the right.

    Examples
    --------
    >>> columns([("name", "return"), ("a", "1"), ("bc", "-23")])
    ['name  return', 'a          1', 'bc       -23']
    """
    if not rows:
        return []
    widths = [max(len(row[j]) for row in rows if j < len(row)) for j in range(max(map(len, rows)))]
    return [
        "  ".join(
            cell.rjust(width) if re.fullmatch(r"-?[\d.,]+( [kMG])?", cell) else cell.ljust(width)
            for cell, width in zip(row, widths, strict=False)
        ).rstrip()
        for row in rows
    ]
