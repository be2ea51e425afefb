"""The error that commands show without a traceback, and hints for names that do not exist."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """A user's mistake; only its text is shown, without a traceback."""


def hint(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return the known names that might be meant, or where to find them.

    Parameters
    ----------
    name : str
        The unknown name.
    known : iterable of str
        The names that exist.
    otherwise : str, optional
        The text if no name is close; by default all known names.

    Examples
    --------
    >>> hint("PivotedBra-v0", ["PivotedBar-v0", "Acrobot-v1"])
    'did you mean PivotedBar-v0?'
    """
    names = {k.lower(): k for k in known}
    close = [names[c] for c in difflib.get_close_matches(name.lower(), names, n=3, cutoff=0.5)]
    if close:
        return f"did you mean {' or '.join(close)}?"
    return otherwise or f"there are {', '.join(names.values())}"
