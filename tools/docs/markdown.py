"""Small parts of Markdown pages: docstrings split at their headings, numbers."""

from __future__ import annotations

import inspect
import re
from typing import Any

from lag_envs.tables import number_text


def first_line(kind: type) -> str:
    """Return the first line of a class's docstring, without its full stop."""
    return (inspect.getdoc(kind) or "").partition("\n")[0].rstrip(".")


def sections(kind: type) -> dict[str, str]:
    """Return a docstring's text by its ``##`` headings; text before the first has an empty heading."""
    parts = re.split(r"^## (.+)$", inspect.getdoc(kind) or "", flags=re.MULTILINE)
    return dict(zip(["", *parts[1::2]], (part.strip() for part in parts[::2]), strict=True))


def parameter_descriptions(kind: type) -> dict[str, str]:
    """Return a numpydoc docstring's description of each parameter."""
    text = inspect.getdoc(kind) or ""
    block = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", text, re.MULTILINE | re.DOTALL)
    found: dict[str, str] = {}
    for names, body in re.findall(
        r"^(\w[\w, ]*) : [^\n]*\n((?:    [^\n]*\n?|\n)+)", block[1] if block else "", re.MULTILINE
    ):
        words = " ".join(body.split())
        found |= dict.fromkeys(re.split(r", *", names), words)
    return found


def groups(kind: type) -> dict[str, list[str]]:
    """Return, for each documented parameter, the names that share its entry."""
    text = inspect.getdoc(kind) or ""
    found: dict[str, list[str]] = {}
    for names in re.findall(r"^(\w[\w, ]*) : ", text, re.MULTILINE):
        listed = re.split(r", *", names)
        found |= dict.fromkeys(listed, listed)
    return found


def default_text(value: Any) -> str:
    """Return a default value as people type it."""
    return number_text(value) if isinstance(value, float) else repr(value)
