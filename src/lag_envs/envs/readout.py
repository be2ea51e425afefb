"""The read-out below a picture: names, numbers and a scale bar."""

from __future__ import annotations

import itertools
import math
import re
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

#: Height of a row, and least width of its columns [pixels].
ROW, COLUMN = 20, 90
STRIP_PAPER, INK = "#f2f2f2", "#303030"
#: A name: a letter or word, an index, a derivative. The board's page reads it alike, `symbol` in site.js.
NAME = re.compile(r"^(.+?)(?:_(\d+))?(_d+ot|'+)?$")


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


class Readout:
    """The strip below a picture; its columns do not shift with the length of the numbers.

    A group of entries begins a new line, and is continued on the next line if it is too long. If the groups
    take more than a third of the picture, entries follow each other without new lines, and the last entries
    are left out.

    Parameters
    ----------
    groups : sequence of sequence of Reading
        The entries, the most important ones first. Only names and units matter here.
    size : (int, int)
        Width and height of the picture [pixels].

    Attributes
    ----------
    height : int
        Height of the strip [pixels].
    """

    def __init__(self, groups: Sequence[Sequence[Reading]], size: tuple[int, int]) -> None:
        width, height = size
        self._bar, most = min(100, width // 3), max(2, (height // 3 - 8) // ROW)
        places, end = _flow(groups, width)
        if places[-1][0] >= most:
            places, end = _flow([list(itertools.chain(*groups))], width)
        rows = places[-1][0] + 1
        is_beside = end <= width - self._bar - 24
        self._has_bar = rows + (not is_beside) <= most
        #: For each entry, its row, and the places where its name begins, its value ends and its unit begins.
        self._places = [place for place in places if place[0] < most]
        self.height = 8 + ROW * min(most, rows + (not is_beside))

    def write(self, image: NDArray[np.uint8], groups: Sequence[Sequence[Reading]], scale: float) -> None:
        """Write entries below a picture.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width, 3)
            The picture.
        groups : sequence of sequence of Reading
            The entries, with the same names and units as before; NaN is written as a dash.
        scale : float
            Pixels per metre, for the scale bar.
        """
        pygame, (height, width) = load_pygame(), image.shape[:2]
        surface, top = pygame.image.frombuffer(image, (width, height), "RGB"), height - self.height
        surface.fill(STRIP_PAPER, (0, top, width, self.height))
        for reading, (row, x, right, after) in zip(itertools.chain(*groups), self._places, strict=False):
            y, colour = top + 7 + ROW * row, STYLES[reading.role].edge if reading.role != "frame" else INK
            value = _text(_number(reading.value), 17, colour)
            _write_name(surface, reading.name, x, y, colour)
            surface.blit(value, (right - value.get_width(), y))
            surface.blit(_text(reading.unit, 17, colour), (after, y))
        if self._has_bar:
            _draw_scale(surface, scale, self._bar)


def _flow(groups: Sequence[Sequence[Reading]], width: int) -> tuple[list[tuple[int, int, int, int]], int]:
    """Return the places of entries in lines of this width, and where the last line ends."""
    places, row = [], -1
    for group in groups:
        x, row = 10, row + 1
        for reading in group:
            value, unit, end = _column(reading, x)
            if end > width - 8 and x > 10:
                x, row = 10, row + 1
                value, unit, end = _column(reading, x)
            places.append((row, x, value, unit))
            x = max(end + 14, x + COLUMN)
    return places, x


def _column(reading: Reading, x: int) -> tuple[int, int, int]:
    """Return where an entry's value ends, its unit begins and its unit ends, if it begins at x."""
    # These places depend only on what stays the same.
    right = x + max(_name_width(reading.name) + 54, 62)
    return right, right + 4, right + 4 + _text(reading.unit, 17, INK).get_width()


def name_parts(name: str) -> tuple[str, str, int]:
    """Return a name's letter or word, its index or a star, and the number of dots above it.

    Examples
    --------
    >>> name_parts("theta_1_dot"), name_parts("psi''"), name_parts("goal_x"), name_parts("x_dot*")
    (('θ', '1', 1), ('ψ', '', 2), ('goal x', '', 0), ('x', '*', 1))
    """
    found = NAME.match(name.removesuffix("*"))
    base, index, rate = found.groups("") if found else (name, "", "")
    try:
        base = unicodedata.lookup(f"GREEK SMALL LETTER {base}")
    except KeyError:
        base = base.replace("_", " ")
    dots = len(rate) if rate.startswith("'") else max(0, len(rate) - 3)
    return base, index + "*" * name.endswith("*"), dots


def _name_width(name: str) -> int:
    base, index, _ = name_parts(name)
    return _text(base, 17, INK).get_width() + _text(index, 14, INK).get_width()


def _write_name(surface: pygame.Surface, name: str, x: int, y: int, colour: str) -> None:
    base, index, dots = name_parts(name)
    letter = _text(base, 17, colour)
    surface.blit(letter, (x, y))
    for i in range(dots):
        place = x + 0.5 * letter.get_width() + 4 * (i - 0.5 * (dots - 1))
        load_pygame().draw.rect(surface, colour, (round(place) - 1, y - 2, 2, 2))
    surface.blit(_text(index, 14, colour), (x + letter.get_width(), y + (0 if index == "*" else 5)))


def _number(value: float) -> str:
    """Return a number in a few digits.

    Examples
    --------
    >>> _number(-0.0001), _number(-1.5), _number(math.nan)
    ('0.000', '−1.500', '–')
    """
    if math.isnan(value):
        return "–"
    digits = 3 if abs(value) < 10.0 else 2 if abs(value) < 100.0 else 1
    return (f"{value:z.{digits}f}" if abs(value) < 1e4 else f"{value:.2e}").replace("-", "−")


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
