"""The leaderboard in README and docs: ``python -m lag_envs.leaderboard.docs PROJECT``.

From a checkout's folder ``leaderboard`` it writes the top of each board into README.md, and what counts as
success into ``docs/leaderboard.md``. The texts follow from the files alone, so a test makes them again and
compares.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lag_envs.generated import replaced
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.protocol import boards
from lag_envs.leaderboard.standings import board_data
from lag_envs.store import write
from lag_envs.tables import markdown_table
from lag_envs.tasks import TASKS

#: Rows of each board that README shows.
TOP = 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the generated texts of a checkout."""
    parser = argparse.ArgumentParser(description="Write the leaderboard's tables into a checkout.")
    parser.add_argument("project", type=Path, nargs="?", default=Path(), help="the checkout (default: here)")
    for path, text in generated(parser.parse_args(arguments).project).items():
        write(path, text)
    return 0


def generated(project: Path) -> dict[Path, str]:
    """Return the generated files, as they ought to be."""
    readme, page = project / "README.md", project / "docs" / "leaderboard.md"
    data = board_data(Board(project / "leaderboard"))
    return {
        readme: replaced(readme.read_text(encoding="utf-8"), "leaderboard", top(data)),
        page: replaced(page.read_text(encoding="utf-8"), "goals", goals()),
    }


def top(data: dict[str, Any]) -> str:
    """Return a table of the first rows of every board that is open and has some."""
    rows = []
    for environment in data["environments"]:
        if not environment["frozen"]:
            best = [row for row in environment["rows"] if row["rank"] is not None][:TOP]
            rows += [_line("" if number else environment["id"], row) for number, row in enumerate(best)]
    if not rows:
        return "Nothing has been submitted yet."
    head = ("environment", "rank", "agent", "score (95 % interval)", "success", "acting 10 × as often")
    return markdown_table(head, rows)


def _line(environment: str, row: dict[str, Any]) -> list[str]:
    low, high = row["interval"]
    success = "" if row["success"] is None else f"{100.0 * row['success']['rate']:.1f} %"
    often = "" if row["often"] is None else f"{row['often']:.3f}"
    score = f"{row['score']:.4f} ({low:.4f} to {high:.4f})"
    return [environment, str(row["rank"]), f"{_text(row['name'])}, {row['kind']}", score, success, often]


def goals() -> str:
    """Return a table of what counts as success."""
    texts = {env_id: TASKS[env_id].goal.text for env_id in boards()}
    rows = [(env_id, text[0].upper() + text[1:]) for env_id, text in texts.items()]
    return markdown_table(("environment", "success and time"), rows)


def _text(text: str) -> str:
    """Return text that means nothing but itself in Markdown and HTML."""
    escaped = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return "".join("\\" + c if c in "\\`*_{}[]()#!~" else c for c in " ".join(escaped.split()))


if __name__ == "__main__":
    raise SystemExit(main())
