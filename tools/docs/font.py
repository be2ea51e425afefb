"""The font of the site's formulas: the part of STIX Two Math that they need.

Browsers set MathML by a font's tables for mathematics. Few systems have such a font.
"""

from __future__ import annotations

import io
from importlib.metadata import distribution
from pathlib import Path

from fontTools.subset import Options, Subsetter
from fontTools.ttLib import TTFont

#: The font's path in the site.
FILE = "assets/stix-two-math.woff"
#: ziamath brings the font, which is all that the site needs of it.
SOURCE = Path(str(distribution("ziamath").locate_file("ziamath/fonts/STIXTwoMath-Regular.ttf")))
#: ASCII, Greek, italics, and other signs; browsers show what is not here in another font.
CHARACTERS = (
    *map(chr, (*range(0x20, 0x7F), *range(0x391, 0x3D6), *range(0x1D434, 0x1D468), *range(0x1D6E2, 0x1D71C))),
    *"\N{PLANCK CONSTANT}\N{SCRIPT CAPITAL L}∂∑∞√∫−±×·…′″≤≥≠≈→∈",
    *"\N{DOT ABOVE}\N{DIAERESIS}\N{MACRON}\N{COMBINING DOT ABOVE}\N{COMBINING DIAERESIS}",
)


def math_font() -> bytes:
    """Return the font as a WOFF file, with its copyright and licence."""
    options = Options()
    options.layout_features = ["ssty"]  # forms for exponents and indices
    options.hinting, options.name_IDs = False, ["*"]
    subsetter = Subsetter(options)
    subsetter.populate(text="".join(CHARACTERS))
    subsetter.subset(font := TTFont(SOURCE, recalcTimestamp=False))
    font.flavor = "woff"
    font.save(found := io.BytesIO())
    return found.getvalue()
