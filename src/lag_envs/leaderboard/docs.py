"""The leaderboard in README and docs: ``python -m lag_envs.leaderboard.docs PROJECT``.

From a checkout's folder ``leaderboard``, it writes the agents with the best combined scores into README.md,
and each board's best agents and success criterion into ``docs/leaderboard.md``. The texts depend on the files
alone, so a test generates them again and compares.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lag_envs.generated import replaced
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.goals import goal_text
from lag_envs.leaderboard.protocol import boards
from lag_envs.leaderboard.standings import board_data
from lag_envs.options import module_parser
from lag_envs.store import write_file
from lag_envs.tables import markdown_table
from lag_envs.tasks import TASKS

#: Agents in README's table.
BEST = 5


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the generated texts of a checkout."""
    parser = module_parser(
        "lag_envs.leaderboard.docs",
        "Write the leaderboard's tables into a checkout.",
        "examples:\n  python -m lag_envs.leaderboard.docs",
    )
    parser.add_argument("project", type=Path, nargs="?", default=Path(), help="the checkout (default: here)")
    for path, text in generated(parser.parse_args(arguments).project).items():
        write_file(path, text)
    return 0


def generated(project: Path) -> dict[Path, str]:
    """Return the generated files as they should be."""
    readme, page = project / "README.md", project / "docs" / "leaderboard.md"
    data = board_data(Board(project / "leaderboard"))
    text = replaced(page.read_text(encoding="utf-8"), "goals", goals())
    return {
        readme: replaced(readme.read_text(encoding="utf-8"), "leaderboard", together(data)),
        page: replaced(text, "boards", top(data)),
    }


def together(data: dict[str, Any]) -> str:
    """Return a table of the best agents over all boards, which always has the best learned one."""
    every = list(enumerate(data["combined"], 1))
    shown = every[:BEST] + [one for one in every[BEST:] if one[1]["kind"] == "learned"][:1]
    if not shown:
        return "Nothing has been submitted yet."
    rows = [
        [
            str(number),
            plain_markdown(row["name"]),
            _scored(row, 3),
            f"{row['boards']} of {row['of']}",
            f"{row['there']:.3f}",
        ]
        for number, row in shown
    ]
    return markdown_table(("", "agent", "mean score (95 % interval)", "boards", "mean on those"), rows)


def top(data: dict[str, Any]) -> str:
    """Return a table of all agents that share first place on each open board, and the best learned one."""
    rows = []
    for environment in data["environments"]:
        if environment["frozen"]:
            continue
        best = [row for row in environment["rows"] if row["rank"] is not None]
        first = [row for row in best if row["rank"] == best[0]["rank"]]
        learned = [row for row in best if row["kind"] == "learned"][:1]
        if first:
            rows.append([environment["id"], _listed(first), _listed(learned)])
    if not rows:
        return "Nothing has been submitted yet."
    return markdown_table(("environment", "best (95 % interval)", "best learned"), rows)


def _listed(rows: Sequence[dict[str, Any]]) -> str:
    return ", ".join(f"{plain_markdown(row['name'])} {_scored(row)}" for row in rows)


def _scored(row: dict[str, Any], digits: int = 4) -> str:
    score, low, high = (f"{x:.{digits}f}" for x in (row["score"], *row["interval"]))
    return f"{score} ({low} to {high})"


def goals() -> str:
    """Return a table of the success criteria."""
    rows = [(env_id, goal_text(TASKS[env_id].goal.text)) for env_id in boards()]
    return markdown_table(("environment", "success and time"), rows)


def plain_markdown(text: str) -> str:
    """Return text that Markdown and HTML show as it is."""
    escaped = html.escape(text, quote=False)
    return "".join("\\" + c if c in "\\`*_{}[]()#!~" else c for c in " ".join(escaped.split()))


if __name__ == "__main__":
    raise SystemExit(main())
