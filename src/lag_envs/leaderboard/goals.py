"""Goals as readers see them: a board's log freezes their texts, some phrases of which read badly."""

from __future__ import annotations

FROZEN = "until it is so for good"
#: Frozen phrases, and those that readers see.
PHRASES = {
    FROZEN: "until it stays there",
    ", and time: ": "; time: ",
    "the project's swing-up time": "RealAIGym's swing-up time",
}


def goal_text(goal: str) -> str:
    """Return a goal as a sentence.

    Examples
    --------
    >>> goal_text("success: up, and time: until it is so for good")
    'Success: up; time: until it stays there'
    """
    for frozen, plain in PHRASES.items():
        goal = goal.replace(frozen, plain)
    return goal[0].upper() + goal[1:]


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
    success, _, time = goal_text(goal).removeprefix("Success: ").partition("; time: ")
    time = time.removeprefix(PHRASES[FROZEN]).removeprefix(", ").replace("until then", "until success")
    return {"success": success.removesuffix("; there is no time")} | ({"settle": time} if time else {})
