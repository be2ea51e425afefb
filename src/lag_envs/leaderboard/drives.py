"""The best human drives: links in the board's ``drives.txt``, recomputed whenever the page is built.

A line is a link and the driver's name, with white space between them. Empty lines and lines that begin with
``# `` are ignored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lag_envs.leaderboard.files import read_plain
from lag_envs.leaderboard.log import BoardError
from lag_envs.replay import LinkError, read_link, replay

FILE = "drives.txt"
#: Largest file [bytes], longest name [characters], and how many drives of one environment are shown.
MOST, NAME, SHOWN = 2**22, 60, 10


def best_drives(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return each environment's best drives, the best first.

    Parameters
    ----------
    folder : Path
        The board's folder.

    Raises
    ------
    BoardError
        For the first line that is not a link and a name, or whose claim is false.
    """
    path = folder / FILE
    try:
        text = read_plain(path, MOST).decode()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise BoardError(f"{path} cannot be read: {error}") from None
    found: dict[str, list[dict[str, Any]]] = {}
    seen: set[str] = set()
    for i, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("# "):
            continue
        where = f"{path}, line {i}"
        link, _, name = line.strip().partition(" ")
        name = name.strip()
        if not name or len(name) > NAME or not name.isprintable():
            raise BoardError(f"{where}: write a link, a space and a name of at most {NAME} characters")
        try:
            drive = read_link(link)
            played = replay(drive)
        except LinkError as error:
            raise BoardError(f"{where}: {error}; remove the line") from error
        if not played.true:
            raise BoardError(
                f"{where}: the claim is false: {drive.claimed!r} is claimed, but {played.total!r} is true"
            )
        if not played.finished:
            raise BoardError(f"{where}: the drive stops before its episode's end; remove the line")
        anchor = f"#{link.rpartition('#')[2]}"
        if anchor in seen:
            raise BoardError(f"{where}: this drive is already listed; remove the line")
        seen.add(anchor)
        entry = {"name": name, "link": anchor, "return": played.total, "score": played.score}
        found.setdefault(drive.id, []).append(entry)
    return {id: sorted(drives, key=lambda drive: -drive["return"])[:SHOWN] for id, drives in found.items()}
