"""The read-out below a picture: names, numbers and a scale bar."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lag_envs.envs.painting import STYLES
from lag_envs.envs.screen import load_pygame
from lag_envs.scenes.shapes import Reading, round_length

if TYPE_CHECKING:
    import pygame

#: Height of the read-out, and least width of its columns [pixels].
STRIP, COLUMN = 48, 90
STRIP_PAPER, INK = "#f2f2f2", "#303030"


@cache
def _font(size: int) -> pygame.font.Font:
    pygame = load_pygame()
    pygame.font.init()
    return pygame.font.Font(None, size)


def _text(text: str, size: int, colour: str) -> pygame.Surface:
    try:
        return _font(size).render(text, True, colour)
    except load_pygame().error:
        # Another part of the program has called pygame.quit(), which makes fonts invalid.
        _font.cache_clear()
        return _font(size).render(text, True, colour)


def write_readout(image: NDArray[np.uint8], rows: Sequence[Sequence[Reading]], scale: float) -> None:
    """Write rows of readings below a picture, in columns that do not shift with the length of the numbers.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width, 3)
        The picture.
    rows : sequence of sequence of Reading
        Two rows.
    scale : float
        Pixels per metre, of which a part is drawn.
    """
    pygame, (height, width) = load_pygame(), image.shape[:2]
    surface = pygame.image.frombuffer(image, (width, height), "RGB")
    surface.fill(STRIP_PAPER, (0, height - STRIP, width, STRIP))
    bar = min(100, width // 3)
    for number, row in enumerate(rows):
        x, y, end = 10, height - STRIP + 7 + 20 * number, width - number * (bar + 24)
        for reading in row:
            colour = STYLES[reading.role].edge if reading.role != "frame" else INK
            value, unit = _text(_number(reading.value), 17, colour), _text(reading.unit, 17, colour)
            # The column's width depends only on what stays the same.
            right = x + max(_name_width(reading.name) + 54, 62)
            if right + 4 + unit.get_width() > end:
                break
            _write_name(surface, reading.name, x, y, colour)
            surface.blit(value, (right - value.get_width(), y))
            surface.blit(unit, (right + 4, y))
            x = max(right + 4 + unit.get_width() + 14, x + COLUMN)
    _draw_scale(surface, scale, bar)


def _name_parts(name: str) -> tuple[str, int, bool]:
    """Return a name's letter or word, how many dots are above it, and whether a star follows."""
    base = name.removesuffix("*").rstrip("'").replace("_ddot", "").replace("_dot", "")
    dots = name.count("'") + name.count("_dot") + 2 * name.count("_ddot")
    try:
        base = unicodedata.lookup(f"GREEK SMALL LETTER {base}")
    except KeyError:
        pass
    return base, dots, name.endswith("*")


def _name_width(name: str) -> int:
    base, _, star = _name_parts(name)
    return _font(17).size(base + "*" * star)[0]


def _write_name(surface: pygame.Surface, name: str, x: int, y: int, colour: str) -> None:
    base, dots, star = _name_parts(name)
    letter = _text(base, 17, colour)
    surface.blit(letter, (x, y))
    for i in range(dots):
        place = x + 0.5 * letter.get_width() + 4 * (i - 0.5 * (dots - 1))
        load_pygame().draw.rect(surface, colour, (round(place) - 1, y - 2, 2, 2))
    if star:
        surface.blit(_text("*", 17, colour), (x + letter.get_width(), y))


def _number(value: float) -> str:
    digits = 3 if abs(value) < 10.0 else 2 if abs(value) < 100.0 else 1
    return (f"{value:.{digits}f}" if abs(value) < 1e4 else f"{value:.2e}").replace("-", "−")


def _draw_scale(surface: pygame.Surface, scale: float, longest: int) -> None:
    """Draw a scale bar with its length."""
    length = round_length(longest / scale)
    label = _text(f"{length:g} m", 16, INK)
    right, y = surface.get_width() - 12, surface.get_height() - 8
    left = right - round(length * scale)
    draw = load_pygame().draw
    draw.line(surface, INK, (left, y), (right, y))
    for x in (left, right):
        draw.line(surface, INK, (x, y - 3), (x, y + 3))
    surface.blit(label, ((left + right - label.get_width()) // 2, y - 14))
