"""What was measured of the package's tasks: ``measured.json``, which ``python -m agents.scale`` writes."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

#: The file; its ``envs`` hold, by id, ``scale`` and ``reference``, set once, and what was ``measured`` since.
FILE = Path(__file__).with_name("measured.json")


def measured(env_id: str) -> dict[str, Any]:
    """Return what the file tells of an environment; nothing of one that was never measured."""
    return _envs(FILE).get(env_id, {})


def known() -> list[str]:
    """Return the ids that were measured, in the order in which they came."""
    return list(_envs(FILE))


@cache
def _envs(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8"))["envs"]
