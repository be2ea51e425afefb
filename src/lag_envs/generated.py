"""Parts of documents that commands generate."""

from __future__ import annotations


def replaced(text: str, name: str, block: str) -> str:
    r"""Return the text with the part between two marks replaced.

    Examples
    --------
    >>> replaced("a <!-- x:begin -->old<!-- x:end --> b", "x", "new")
    'a <!-- x:begin -->\nnew\n<!-- x:end --> b'
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, _, rest = text.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise ValueError(f"the text has no {begin} ... {end}")
    return f"{before}{begin}\n{block}\n{end}{after}"
