"""Writes the leaderboard's page: an overview, a page for each environment and agent, a feed of new entries.

Submissions' contents are untrusted. They reach HTML only through jinja2's escaping, scripts only as JSON
without ``<``, ``>`` and ``&``, and links only if they are http or https addresses.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, urlsplit

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from tqdm import tqdm

from lag_envs import store
from lag_envs.leaderboard.goals import goal_by_column
from lag_envs.leaderboard.log import BoardError
from lag_envs.leaderboard.site import driving
from lag_envs.leaderboard.site.scenery import Scenery, page_json, scenery_data
from lag_envs.tables import rate_text, three_digits

#: Lists the files that the last build wrote; only these are ever removed.
MANIFEST = "site.json"
STATIC = Path(__file__).parent / "static"
PACKAGE = Path(__file__).parents[2]
#: Poses of one episode in an overview's picture.
POSES = 15
#: Entries of the feed.
NEWS = 50
ABOUT = "Leaderboard of lag_envs: every score is recomputed from a policy that contains only data."

#: Conditions of robustness in words that need no context.
CONDITIONS = {
    "noise": "sensor noise",
    "late by a step": "actions a step late",
    "lag of two steps": "actuators with a lag of two steps",
    "pushes": "random pushes",
    "hidden, within 20 %": "unknown parameters, within 20 %",
}
KINDS = {"learned": "Learned", "controller": "Controller", "optimal": "Optimal"}


class Column(NamedTuple):
    """A column of a ranking: its key in a row, heading, meaning, and whether small values are good."""

    key: str
    label: str
    meaning: str
    rising: bool = False


COLUMNS = (
    Column(
        "rank",
        "Rank",
        "Of the agents that share a rank, none is clearly better than another. An agent that acts like an "
        "earlier one has no rank.",
        True,
    ),
    Column("name", "Agent", "The submission's name and kind.", True),
    Column(
        "score",
        "Score",
        "Interquartile mean, over training seeds, of the mean over episodes. 0 is the random policy's "
        "return, 1 the best known. The bar is the 95 % bootstrap interval.",
    ),
    Column(
        "return",
        "Return",
        "Mean return of an episode, over all training seeds. A seed that failed lowers it, but hardly "
        "affects the score, which leaves out the best and the worst seeds.",
    ),
    Column(
        "gap",
        "Gap",
        "Optimality gap: how far policies fall short of a score of 1, on average over training seeds.",
        True,
    ),
    Column(
        "success",
        "Success",
        "Share of episodes that succeed, over all training seeds, with Wilson's 95 % interval.",
    ),
    Column(
        "settle",
        "Settle",
        "Median time, over all episodes, until the goal is reached for good, unless stated otherwise. It is "
        "missing if half of the episodes never reach the goal.",
        True,
    ),
    Column("effort", "Effort", "Mean square of the control, as a share of its limit.", True),
    Column("env_steps", "Steps", "Environment steps taken in training, as stated by the authors.", True),
    Column("seconds", "Training", "Time taken by training, as stated by the authors.", True),
    Column(
        "robustness",
        "Robust",
        "Lowest score in changed environments: with other masses, drag and the like, and on newer boards "
        "also with noise, delays and pushes.",
    ),
    Column("often", "10 × rate", "Score when the agent acts ten times as often."),
)


def write_page(data: Mapping[str, Any], out: Path, url: str = "") -> None:
    """Write the page.

    Pages stay whole for a browser that reads the old page meanwhile, and after a kill at any moment: scripts,
    styles and data have the hash of their content in their names, each page is replaced at once, the overview
    last, and files that no page refers to are removed at the end.

    Parameters
    ----------
    data : Mapping
        The result of `lag_envs.leaderboard.standings.page_data`.
    out : Path
        Folder of the page; made if it does not exist.
    url : str, optional
        Address at which the folder will be found. Link previews need it for their pictures.

    Raises
    ------
    ValueError
        If the address is not http or https.
    BoardError
        If the folder holds files that no earlier build wrote.
    NotADirectoryError, OSError
        If the folder cannot be written.
    """
    out = Path(out)
    before = _manifest(out)
    pages, files = render(data, url)
    wanted = {**files, **pages}
    store.write_file(out / MANIFEST, json.dumps({"files": sorted({*before, *wanted})}, indent=0))
    for name, text in wanted.items():
        # The hash in its name covers the content, so an existing file need not be written again.
        if name in pages or not (out / name).is_file():
            store.write_file(out / name, text)
    for name in before - set(wanted):
        (out / name).unlink(missing_ok=True)
    store.write_file(out / MANIFEST, json.dumps({"files": sorted(wanted)}, indent=0))


class Assets:
    """Files that pages refer to: content by path."""

    def __init__(self) -> None:
        self.files: dict[str, str | bytes] = {}

    def keep(self, stem: str, kind: str, content: str | bytes) -> str:
        """Keep a file, and return its path, whose hash covers the content."""
        found = hashlib.sha256(content.encode() if isinstance(content, str) else content)
        name = f"assets/{stem}-{found.hexdigest()[:10]}.{kind}"
        self.files[name] = content
        return name

    def keep_data(self, stem: str, value: Any) -> str:
        """Keep data as a script that hands it to the page's own."""
        return self.keep(stem, "js", f"lagEnvs.put({page_json(value)});\n")


def render(
    data: Mapping[str, Any],
    url: str = "",
    site: Sequence[tuple[str, str]] = (),
    section: Sequence[tuple[str, str]] = (),
    source: str = "",
    documentation: str = "",
) -> tuple[dict[str, str], dict[str, str | bytes]]:
    """Return the pages, the overview last, and the files they refer to: content by path.

    If the page is part of a larger site, `site` has (title, address) of its sections, home first, and
    `section` those of the pages of the board's own, for the pages' head; the overview is index.html in both.
    `source` is the address of the project's files, to which submissions are linked, `documentation` that of
    the environments' pages, ID.html; both end with a slash.
    """
    if url and not safe_url(url):
        raise ValueError(f"the page's address must begin with https:// or http://, got {url!r}")
    assets, taken = Assets(), {"index"}
    look = "\n".join((STATIC / f"{name}.css").read_text("utf-8") for name in ("look", "site"))
    style = assets.keep("site", "css", look)
    script = assets.keep("site", "js", (STATIC / "site.js").read_text("utf-8"))
    scheme = documentation and assets.keep("scheme", "js", (STATIC / "scheme.js").read_text("utf-8"))
    parts = "\n".join((STATIC / f"{name}.js").read_text("utf-8") for name in ("episode", "drive"))
    drive = assets.keep("drive", "js", f'"use strict";\n(() => {{\n{parts}}})();\n')
    given = tqdm(data["environments"], "drawing", unit=" environments", disable=None, leave=False)
    boards = [_board_with_files(one, data["protocol"], assets, taken, bool(url)) for one in given]
    templates = Environment(
        loader=PackageLoader("lag_envs.leaderboard.site"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    templates.filters |= {
        "number": rounded_text, "steps": count_text, "duration": duration, "seconds": seconds,
        "percent": percent, "condition": condition, "about": _about, "place": place_of, "lowest": lowest,
    }  # fmt: skip
    templates.globals |= {
        "columns": COLUMNS, "kinds": KINDS, "boards": boards, "combined": _clean(data.get("combined") or []),
        "made": data["made"], "style": style,
        "logo": f"data:image/svg+xml,{quote((STATIC / 'logo.svg').read_text('utf-8'))}",
        "script": script, "scheme": scheme, "drive": drive, "protocol": data["protocol"],
        "embed": lambda value: Markup(page_json(value)), "url": url and url.rstrip("/") + "/",
        "site": site, "section": section, "source": source, "documentation": documentation,
        "preview": next((b["preview"] for b in boards), None),
    }  # fmt: skip
    drawn = ("picture", "poster", "optimum")
    summary = [{key: b[key] for key in drawn} | {"rows": _scores(b["rows"])} for b in boards]
    pages: dict[str, str] = {}

    def page(template: str, name: str, **values: Any) -> None:
        pages[name] = templates.get_template(template).render(file=name, **values)

    for b in boards:
        known = {"now": b["page"], "preview": b["preview"]}
        titled = f"{b['id']}, protocol {b['protocol']}" if b["frozen"] else b["id"]
        for row in b["rows"]:
            alone = b | {"rows": [row]}
            title = f"{row['name']} · {titled}"
            page("agent.html", f"{row['page']}.html", board=alone, title=title, about=_about(row, b), **known)
        page("environment.html", f"{b['page']}.html", board=b, title=titled, about=b["title"], **known)
    news = sorted(
        ((b, row) for b in boards if not b["frozen"] for row in b["rows"] if row["added"]),
        key=lambda entry: entry[1]["added"], reverse=True,
    )  # fmt: skip
    page("feed.xml", "feed.xml", entries=news[:NEWS])
    page("index.html", "index.html", title="Overview", about=ABOUT, now="index", summary=summary)
    return pages, assets.files


def _board_with_files(
    given: Mapping[str, Any], protocol: Any, assets: Assets, taken: set[str], preview: bool
) -> dict[str, Any]:
    """Return an environment's data for the templates, and keep the files that its pages fetch."""
    scenery = Scenery(str(given["id"]))
    board = _board(_clean(given), protocol, scenery)
    board["page"] = _unused(board["page"], taken)
    code, fuller = (None, None) if board["frozen"] else driving.scripts(str(given["id"]))
    board["code"] = code and assets.keep(f"{board['page']}-drive", "js", code)
    board["fuller"] = fuller and assets.keep(f"{board['page']}-fuller", "js", fuller)
    board["film"] = None
    for i, row in enumerate(board["rows"]):
        own = str(row["id"] or row["name"]).removeprefix(f"{board['id']}-")
        row["page"] = _unused(f"{board['page']}-{_slug(own)}", taken)
        replays, live = row.pop("replays"), row.pop("agent")
        row["file"] = None
        row["live"] = assets.keep_data(f"{board['page']}-{i}-live", live) if live and code else None
        if replays:
            # The script that fetches the file knows it by this key.
            episodes = [scenery.episode(replay) for replay in replays]
            row["file"] = assets.keep_data(f"{board['page']}-{i}", episodes)
            if row["name"] == board["shown"] and not board["film"]:
                board["film"] = assets.keep_data(f"{board['page']}-film", episodes[:1])
    states, target = board.pop("states"), board.pop("goal_of_states")
    image = scenery.preview(states, target) if preview else None
    board["preview"] = image and assets.keep(board["page"], "png", image)
    return board


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text)[:80]


def _unused(name: str, taken: set[str]) -> str:
    """Return a name that is not taken yet, and take it."""
    while name in taken:
        name += "-2"
    taken.add(name)
    return name


def _about(row: Mapping[str, Any], board: Mapping[str, Any]) -> str:
    """Return a summary of an agent on a board."""
    ranked = sum(other["rank"] is not None for other in board["rows"])
    place = "" if row["rank"] is None else f", rank {row['rank']} of {ranked}"
    kind = KINDS.get(row["kind"], row["kind"])
    return f"{kind}: score {rounded_text(row['score'])}{place}. {board['title']}"


def _board(given: dict[str, Any], protocol: Any, scenery: Scenery) -> dict[str, Any]:
    """Return an environment's data for the templates and the script."""
    board: dict[str, Any] = {
        "known": None, "value": None, "other": [], "goal": None, "picture": None, "frozen": False,
        "state_names": [], "state_units": [], "pairs": [], "controls": [], "dt": None, "scene": "",
        "title": given["id"], "about": [], "difficulty": "", "open": None, "drives": [],
    }  # fmt: skip
    board |= {"protocol": protocol} | given | scenery_data(given["id"])
    board["rows"] = [_row(dict(row)) for row in given["rows"]]
    known = board["known"] or {}
    returns = [known.get("random"), known.get("best"), *(row["return"] for row in board["rows"])]
    largest = max((abs(x) for x in returns if isinstance(x, int | float)), default=0.0)
    # All returns have as many digits, so that they line up.
    board["digits"] = 1 if largest >= 100.0 else 2 if largest >= 10.0 else 3
    board["goals"] = goal_by_column(board["goal"])
    board["page"] = _slug(str(given["id"]))
    if board["protocol"] != protocol:
        board["page"] += f"-protocol-{re.sub('[^0-9]+', '-', str(board['protocol']))}"
    board["optimum"] = None
    if known.get("optimum") is not None and known["best"] != known["random"]:
        board["optimum"] = (known["optimum"] - known["random"]) / (known["best"] - known["random"])
    # Taken from the best agent that can be watched; without one, the scene is shown at its start.
    watched = [row for row in board["rows"] if row["replays"]]
    shown = next((row for row in watched if row["rank"] is not None), watched[0] if watched else None)
    board["shown"] = shown and shown["name"]
    states = _apart(shown["replays"][0]["states"], board["state_names"]) if shown else scenery.start
    target = shown["replays"][0].get("target") if shown else None
    board["poster"] = scenery.still(states, target) if states else None
    board |= {"states": states, "goal_of_states": target}
    return board


def _row(row: dict[str, Any]) -> dict[str, Any]:
    others = "interval license description hardware id above alike added agent module".split()
    empty: dict[str, Any] = dict.fromkeys([*(c.key for c in COLUMNS), *others])
    empty |= {"looks_like": "", "reference": False}
    row = empty | {"authors": [], "curves": [], "profile": [], "kind": "learned", "state": "verified"} | row
    row["code"] = safe_url(row.get("code"))
    row["curves"], row["profile"] = row["curves"] or [], row["profile"] or []
    row["replays"] = [r for r in row.get("replays") or [] if r.get("states")]
    row["authors"] = [str(a) for a in row["authors"] or []]
    row["find"] = " ".join(
        str(x) for x in (row["name"], *row["authors"], row["id"], row["description"] or "")
    ).casefold()
    return row


def _scores(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{key: row[key] for key in ("name", "kind", "score", "interval")} for row in rows]


def safe_url(url: Any) -> str | None:
    """Return an http or https address as it is, and None for anything else.

    Examples
    --------
    >>> safe_url("https://example.org/a"), safe_url("javascript:alert(1)"), safe_url(" https://x")
    ('https://example.org/a', None, None)
    """
    if not isinstance(url, str) or len(url) > 500 or re.search(r"[\x00-\x20\x7f\\\"'<>]", url):
        return None
    try:
        parts = urlsplit(url)
        return url if parts.scheme in ("http", "https") and parts.hostname else None
    except ValueError:
        return None


def _apart(states: Sequence[Sequence[float]], names: Sequence[str]) -> list[Sequence[float]]:
    """Return states of an episode at evenly spaced times, while most of the motion happens."""
    if not names or len(states[0]) != len(names):
        return []
    values = np.nan_to_num(np.array(states, np.float64))
    path = (np.abs(np.diff(values, axis=0)) / np.maximum(np.ptp(values, axis=0), 1e-9)).sum(axis=1).cumsum()
    end = 1 + int(np.searchsorted(path, 0.98 * path[-1])) if len(path) else 1
    chosen = [round(i * end / (POSES - 1)) for i in range(POSES)]
    return [states[min(i, len(states) - 1)] for i in dict.fromkeys(chosen)]


# --- numbers as text --------------------------------------------------------------------------------------


def lowest(scores: Mapping[str, float | None] | None) -> float | None:
    """Return the lowest of some scores; None if there are none.

    Examples
    --------
    >>> lowest({"noise": 0.9, "pushes": 0.8, "late": None}), lowest({}), lowest(None)
    (0.8, None, None)
    """
    return min((x for x in (scores or {}).values() if x is not None), default=None)


def rounded_text(value: Any, digits: int = 3) -> str:
    """Return a number with this many digits after the point.

    Examples
    --------
    >>> [rounded_text(x) for x in (0.98765, -1.7386, -1e-9, None)], rounded_text(-421.0, 1)
    (['0.988', '−1.739', '0.000', '–'], '−421.0')
    """
    if not isinstance(value, int | float) or isinstance(value, bool):
        return "–"
    text = f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) else text.replace("-", "")


def percent(value: Any) -> str:
    r"""Return a share as text.

    Examples
    --------
    >>> percent(0.98765), percent(1.0), percent(None)
    ('98.8\xa0%', '100.0\xa0%', '–')
    """
    if not isinstance(value, int | float):
        return "–"
    return f"{100.0 * value:.1f}\N{NO-BREAK SPACE}%"


def count_text(value: Any) -> str:
    r"""Return a count as text.

    Examples
    --------
    >>> count_text(500_000), count_text(1_250_000), count_text(2e6), count_text(7), count_text(None)
    ('500\xa0k', '1.25\xa0M', '2.00\xa0M', '7', '–')
    """
    if not isinstance(value, int | float):
        return "–"
    return rate_text(value).replace(" ", "\N{NO-BREAK SPACE}")


def duration(value: Any) -> str:
    r"""Return seconds as text.

    Examples
    --------
    >>> duration(1.25), duration(95), duration(9000), duration(None)
    ('1.25\xa0s', '1.58\xa0min', '2.50\xa0h', '–')
    """
    if not isinstance(value, int | float):
        return "–"
    for size, sign in ((3600.0, "h"), (60.0, "min")):
        if value >= size:
            return f"{three_digits(value / size)}\N{NO-BREAK SPACE}{sign}"
    return f"{three_digits(value)}\N{NO-BREAK SPACE}s"


def seconds(value: Any) -> str:
    r"""Return a time within an episode as text.

    Examples
    --------
    >>> seconds(0.5), seconds(None)
    ('0.50\xa0s', '–')
    """
    return f"{value:.2f}\N{NO-BREAK SPACE}s" if isinstance(value, int | float) else "–"


def condition(name: str) -> str:
    """Return a condition of robustness in words.

    Examples
    --------
    >>> condition("mass_1 -20 %"), condition("com_distance +20 %"), condition("noise")
    ('mass 1, −20 %', 'centre-of-mass distance, +20 %', 'sensor noise')
    """
    words = re.sub(r" (?=[+-]\d)", ", ", CONDITIONS.get(name, name)).replace(" -", " −")
    return re.sub("^com_", "centre-of-mass ", words).replace("_", " ")


def place_of(module: str | None) -> str | None:
    """Return the path of a module of the package or of the agents in the project; None if it has none.

    Examples
    --------
    >>> place_of("lag_envs.controllers.basic"), place_of("lag_envs.controllers"), place_of("lag_envs.gone")
    ('src/lag_envs/controllers/basic.py', 'src/lag_envs/controllers/__init__.py', None)
    >>> place_of("agents.ppo")
    'agents/ppo.py'
    """
    if re.fullmatch(r"agents\.\w+", module or ""):  # not in the wheel
        return f"{str(module).replace('.', '/')}.py"
    if not re.fullmatch(r"lag_envs(\.\w+)+", module or ""):
        return None
    path = str(module).replace(".", "/")
    files = (f"{path}.py", f"{path}/__init__.py")
    return next((f"src/{file}" for file in files if (PACKAGE.parent / file).is_file()), None)


# --- data and files ---------------------------------------------------------------------------------------


def _clean(value: Any) -> Any:
    """Return the value without invalid characters, and with None for numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {_clean(str(k)): _clean(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(v) for v in value]
    if isinstance(value, str):
        return re.sub(r"[\x00-\x08\x0b-\x1f\x7f\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _manifest(out: Path) -> set[str]:
    """Return the files that the last build wrote."""
    try:
        names = json.loads((out / MANIFEST).read_text("utf-8"))["files"]
        # A manifest that somebody wrote by hand must not remove files elsewhere.
        return {n for n in names if re.fullmatch(r"(assets/)?[\w-]+\.(html|css|js|png|xml)", n)}
    except FileNotFoundError:
        found = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
        foreign = [name for name in found if not name.startswith(".")]  # such as a checkout's .git
        if foreign:
            raise BoardError(
                f"{out} holds other things, such as {foreign[0]}; name a new or an empty folder"
            ) from None
        return set()
    except (ValueError, KeyError, TypeError) as error:
        raise BoardError(f"{out / MANIFEST} cannot be read ({error}); remove the folder") from error
