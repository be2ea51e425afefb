"""Angles as tasks observe them: by cosine and sine, which are the same after a full turn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def circle(state: Any, *names: str, xp: Any) -> dict[str, Any]:
    """Return cosine and sine of each of these angles, in this order."""
    functions = {"cos": xp.cos, "sin": xp.sin}
    return {f"{part}({name})": f(state[name]) for name in names for part, f in functions.items()}


def bounds_of_circle(quantities: Mapping[str, Any]) -> dict[str, float]:
    """Return the bound of each cosine and sine in the observation."""
    return {name: 1.0 for name in quantities if name.startswith(("cos(", "sin("))}
