"""Names for people to read: no invisible characters, and no confusion of names that look the same."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from functools import cache

#: Unicode's Default_Ignorable_Code_Point, where Python calls them printable, and other blanks.
INVISIBLE = frozenset(
    chr(code)
    for first, last in (
        (0x034F, 0x034F),  # combining grapheme joiner
        (0x115F, 0x1160), (0x3164, 0x3164), (0xFFA0, 0xFFA0),  # Hangul fillers
        (0x17B4, 0x17B5), (0x180B, 0x180F),  # Khmer and Mongolian
        (0x2800, 0x2800),  # Braille without a dot
        (0xFE00, 0xFE0F), (0xE0100, 0xE01EF),  # variation selectors
        (0x1D159, 0x1D159), (0x16FE4, 0x16FE4),  # a musical symbol and a filler without ink
    )
    for code in range(first, last + 1)
)  # fmt: skip
#: Marks that may stand on one letter: more of them overlap the lines above.
MOST_MARKS = 2


def unreadable(text: str) -> str:
    r"""Return why a text cannot be shown as it is; empty if it can.

    Examples
    --------
    >>> unreadable("Zoë O'Neil, 東京"), unreadable("PPO\u200b"), unreadable("\u3164")
    ('', 'it holds the invisible U+200B', 'it holds the invisible U+3164')
    """
    marks = 0
    for char in text:
        category = unicodedata.category(char)
        # Python calls controls, formats, surrogates, unassigned characters and foreign spaces not printable.
        if not char.isprintable() or char in INVISIBLE:
            return f"it holds the invisible U+{ord(char):04X}"
        marks = marks + 1 if category.startswith("M") else 0
        if marks > MOST_MARKS:
            return f"more than {MOST_MARKS} marks stand on one letter"
    first = unicodedata.category(text[0]) if text else ""
    return "it begins with a mark that has no letter" if first.startswith("M") else ""


def wordless(text: str) -> bool:
    """Return whether a text has no letter and no digit.

    Examples
    --------
    >>> wordless("..."), wordless("A. Nobody"), wordless("王")
    (True, False, False)
    """
    return not any(unicodedata.category(char)[0] in "LN" for char in text)


@cache
def _prototypes() -> dict[str, str]:
    """Return, for each character that has look-alikes, the representative of their class.

    From Unicode's list of confusables: characters that look alike form a class with one representative, a
    sequence such as "rn" before a character such as "m".
    """
    from confusable_homoglyphs.confusables import confusables_data

    above: dict[str, str] = {}

    def top(text: str) -> str:
        while text in above:
            text = above[text]
        return text

    for char, others in confusables_data.items():
        for other in others:
            # In the list, right-to-left characters stand between direction marks.
            a, b = (top(text.replace("\u200e", "")) for text in (char, other["c"]))
            if a != b:
                first, second = sorted((a, b), key=lambda text: (-len(text), text))
                above[second] = first
    return {char: top(char) for char in confusables_data if len(char) == 1}


def skeleton(text: str) -> str:
    r"""Return what a text looks like: two texts with the same skeleton can be mistaken for each other.

    Follows Unicode's UTS 39, but without spaces and marks on letters, which are easily overlooked.

    Examples
    --------
    >>> skeleton("\u0420\u0420\u041e") == skeleton("PPO"), skeleton("A. Srnith") == skeleton("A. Smith")
    (True, True)
    >>> skeleton("SAC") == skeleton("TD3")
    False
    """
    found = "".join(_prototypes().get(char, char) for char in unicodedata.normalize("NFKD", text))
    found = unicodedata.normalize("NFKD", found)
    return "".join(c for c in found if c != " " and not unicodedata.category(c).startswith("M"))


def lookalike(text: str, earlier: Iterable[str]) -> str:
    """Return the first of some earlier texts that looks like a text but differs from it; empty if none does.

    Capitals and small letters count as alike.
    """
    looks = {skeleton(text), skeleton(text.casefold())}
    first = next((e for e in earlier if looks & {skeleton(e), skeleton(e.casefold())}), text)
    return "" if first == text else first
