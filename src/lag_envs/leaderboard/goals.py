"""Goals as readers see them: a board's log freezes their texts, one phrase of which reads badly."""

from __future__ import annotations

FROZEN, PLAIN = "until it is so for good", "until it stays there"


def goal_text(goal: str) -> str:
    """Return a goal as a sentence."""
    return goal[0].upper() + goal[1:].replace(FROZEN, PLAIN)


def goal_by_column(goal: str | None) -> dict[str, str]:
    """Return what success and time mean, by column; what the column's own text says is left out.

    Examples
    --------
    >>> goal_by_column("success: across the line; time: until then")
    {'success': 'across the line', 'settle': 'until success'}
    >>> goal_by_column("success: upright; time: until it is so for good")
    {'success': 'upright'}
    >>> goal_by_column("success: up; there is no time")
    {'success': 'up'}
    """
    if not goal:
        return {}
    joined = goal.removeprefix("success: ").replace(", and time: ", "; time: ")
    success, _, time = joined.partition("; time: ")
    time = time.removeprefix(FROZEN).removeprefix(", ").replace("until then", "until success")
    return {"success": success.removesuffix("; there is no time")} | ({"settle": time} if time else {})
