"""Measurements of the package's tasks: ``measured.json``, which ``python -m agents.scale`` writes."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

#: The file; for each id, ``envs`` holds ``scale`` and ``reference``, set once, and later ``measured`` values.
FILE = Path(__file__).with_name("measured.json")


def measured_entry(env_id: str) -> dict[str, Any]:
    """Return the file's entry for an environment; empty for one that was never measured."""
    return _envs(FILE).get(env_id, {})


def measured_ids() -> list[str]:
    """Return the measured ids, in the order in which they were added."""
    return list(_envs(FILE))


@cache
def _envs(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8"))["envs"]
