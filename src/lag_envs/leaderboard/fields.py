"""Read a table of a TOML file that nobody vouches for: key by key, with types and ranges."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from typing import Any

from lag_envs.leaderboard.names import unreadable
from lag_envs.leaderboard.protocol import Refused

#: Stands for a key that must be there.
NEEDED: Any = object()


def shown(value: Any) -> str:
    """Return a value for a message: short, in ASCII, without anything that a terminal would act on."""
    if isinstance(value, dict | list):
        return f"a {'table' if isinstance(value, dict) else 'list'} of {len(value)}"
    text = ascii(value)
    return text if len(text) <= 80 else text[:77] + "..."


def plain(text: object) -> str:
    """Return a text in ASCII, without anything that a terminal would act on."""
    return ascii(str(text))[1:-1]


class Fields:
    """A table; every key is taken once, by a method that checks it. `done` refuses those that were not.

    Parameters
    ----------
    where : str
        How messages call the table.
    table : object
        What the TOML file has there.

    Raises
    ------
    Refused
        By every method, for what is not as it should be.
    """

    def __init__(self, where: str, table: Any) -> None:
        if not isinstance(table, dict):
            raise Refused(f"{where} must be a table, got {shown(table)}")
        self.where, self._left = where, dict(table)

    def __contains__(self, key: str) -> bool:
        return key in self._left

    def done(self) -> None:
        """Refuse keys that nobody asked for."""
        if self._left:
            raise Refused(f"{self.where}: unknown key {shown(next(iter(self._left)))}; leave it out")

    def any(self, key: str, default: Any = NEEDED) -> Any:
        """Take a value of any type."""
        if key not in self._left and default is NEEDED:
            raise Refused(f"{self.where}: {key} is missing")
        return self._left.pop(key, default)

    def _refuse(self, key: str, needed: str, value: Any) -> Refused:
        return Refused(f"{self.where}: {key} must be {needed}, got {shown(value)}")

    def whole(self, key: str, low: int, high: int, default: Any = NEEDED) -> int:
        """Take a whole number from low to high."""
        value = self.any(key, default)
        if type(value) is not int or not low <= value <= high:
            raise self._refuse(key, f"a whole number from {low} to {high}", value)
        return value

    def number(self, key: str, low: float, high: float, default: Any = NEEDED) -> float:
        """Take a finite number from low to high."""
        return self._number(key, self.any(key, default), low, high)

    def _number(self, key: str, value: Any, low: float, high: float) -> float:
        if type(value) not in (int, float) or not low <= value <= high or not math.isfinite(value):
            raise self._refuse(key, f"a number from {low:g} to {high:g}", value)
        return float(value)

    def text(self, key: str, longest: int, default: Any = NEEDED, pattern: str = "") -> str:
        """Take one line of readable text: no control characters, changes of direction, invisible ones."""
        return self._text(key, self.any(key, default), longest, pattern)

    def _text(self, key: str, value: Any, longest: int, pattern: str = "") -> str:
        if not isinstance(value, str) or len(value) > longest:
            raise self._refuse(key, f"one line of printable text of at most {longest} characters", value)
        if reason := unreadable(value):
            raise self._refuse(key, f"one line of printable text ({reason})", value)
        if pattern and not re.fullmatch(pattern, value):
            raise self._refuse(key, f"of the form {pattern}", value)
        return value

    def choice(self, key: str, options: Collection[str], default: Any = NEEDED) -> str:
        """Take one of some words."""
        value = self.any(key, default)
        if not isinstance(value, str) or value not in options:
            raise self._refuse(key, "one of " + ", ".join(sorted(options)), value)
        return value

    def _list(self, key: str, least: int, most: int, default: Any = NEEDED) -> list[Any]:
        value = self.any(key, default)
        if not isinstance(value, list) or not least <= len(value) <= most:
            raise self._refuse(key, f"a list of {least} to {most}", value)
        return value

    def texts(self, key: str, least: int, most: int, longest: int, pattern: str = "") -> tuple[str, ...]:
        """Take a list of texts."""
        return tuple(self._text(key, v, longest, pattern) for v in self._list(key, least, most))

    def wholes(
        self, key: str, least: int, most: int, low: int, high: int, default: Any = NEEDED
    ) -> tuple[int, ...]:
        """Take a list of whole numbers."""
        values = self._list(key, least, most, default)
        for value in values:
            if type(value) is not int or not low <= value <= high:
                raise self._refuse(key, f"whole numbers from {low} to {high}", value)
        return tuple(values)

    def numbers(self, key: str, least: int, most: int, low: float, high: float) -> tuple[float, ...]:
        """Take a list of finite numbers."""
        return tuple(self._number(key, v, low, high) for v in self._list(key, least, most))

    def tables(self, key: str, most: int) -> list[Fields]:
        """Take a list of tables; an empty one where there is none."""
        found = self._list(key, 0, most, [])
        return [Fields(f"{self.where}.{key}[{i}]", table) for i, table in enumerate(found)]

    def table(self, key: str, default: Any = NEEDED) -> Fields:
        """Take a table."""
        return Fields(f"{self.where}.{key}" if self.where else f"[{key}]", self.any(key, default))
