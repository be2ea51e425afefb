"""The command ``lag-envs leaderboard``."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from lag_envs.errors import hint
from lag_envs.leaderboard.board import DEFAULT, Board
from lag_envs.leaderboard.log import (
    COMMIT,
    REMEDY,
    BoardEntry,
    BoardError,
    BoardState,
    parse,
    read_log,
)
from lag_envs.leaderboard.pending import finish
from lag_envs.leaderboard.standings import board_data, page_data
from lag_envs.options import count
from lag_envs.tables import aligned

#: Examples of each action, the simplest use first.
EXAMPLES = {
    "add": """lag-envs leaderboard add my-submission               it waits for the next nonce
lag-envs leaderboard add mine/* --nonce test-1       on a board of your own, verified at once""",
    "nonce": """lag-envs leaderboard nonce                           the hash of the last commit
lag-envs leaderboard nonce 5f3c... --source https://beacon.example/pulse/1""",
    "list": """lag-envs leaderboard list
lag-envs leaderboard list PivotedBar-v0""",
    "show": """lag-envs leaderboard show PivotedBar-v0-ppo-c1dc3900
lag-envs leaderboard show PivotedBar-v0-ppo-c1dc3900 --json""",
    "withdraw": 'lag-envs leaderboard withdraw PivotedBar-v0-ppo-c1dc3900 --reason "asked for"',
    "audit": """lag-envs leaderboard audit
lag-envs leaderboard audit --all                     every result again""",
    "pin": "lag-envs leaderboard pin",
    "open": "lag-envs leaderboard open",
    "build": "lag-envs leaderboard build site",
    "serve": "lag-envs leaderboard serve --port 0",
}


def declare_leaderboard(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``leaderboard``."""
    actions = parser.add_subparsers(dest="action", required=True, title="actions", metavar="ACTION")

    def action(name: str, help: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        examples = "".join(f"\n  {line}" for line in EXAMPLES.get(name, "").splitlines())
        one = actions.add_parser(
            name,
            help=help,
            description=textwrap.fill(help[0].upper() + help[1:] + ".", 97),
            epilog=examples and "examples:" + examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        one.add_argument(
            "--board",
            metavar="FOLDER",
            type=Path,
            default=DEFAULT,
            help="the board's folder (default: %(default)s)",
        )
        one.set_defaults(act=run)
        return one

    def source(one: argparse.ArgumentParser) -> None:
        one.add_argument(
            "--source", metavar="URL", default="", help="https address where anybody can find the nonce"
        )

    def parallel_options(one: argparse.ArgumentParser) -> None:
        one.add_argument(
            "--jobs",
            metavar="N",
            type=count,
            default=os.cpu_count() or 1,
            help="submissions to verify in parallel (default: one per core)",
        )
        one.add_argument(
            "--ray",
            metavar="ADDRESS",
            help="verify on a Ray cluster: its address, auto for a running one, local to start one here",
        )

    one = action("add", "add submissions, and verify all pending submissions that have a nonce", _add)
    one.add_argument("folders", metavar="FOLDER", nargs="*", type=Path, help="a submission")
    one.add_argument("--nonce", metavar="VALUE", help="publish this nonce after adding the submissions")
    source(one)
    parallel_options(one)
    one = action("nonce", "publish a nonce, and verify all that was added before", _nonce)
    one.add_argument(
        "value",
        metavar="VALUE",
        nargs="?",
        help="a nonce, ideally one that nobody can choose, such as the next pulse of a public beacon"
        " (default: the hash of the last commit, which must contain the board as it is)",
    )
    source(one)
    parallel_options(one)
    one = action("list", "show the ranking, and the state of all other submissions", _list)
    one.add_argument("env", metavar="ENV", nargs="?", help="only this environment")
    one = action("show", "show everything about one submission", _show)
    one.add_argument("id", metavar="ID", help="as `list` shows it")
    one.add_argument("--json", action="store_true", help="print JSON, with curves, profile and replays")
    one.add_argument(
        "--protocol", metavar="N", type=count, help="protocol of the board (default: the current one)"
    )
    one = action("withdraw", "take a submission off the board", _withdraw)
    one.add_argument("id", metavar="ID", help="as `list` shows it")
    one.add_argument("--reason", metavar="TEXT", required=True, help="the reason, which the page shows")
    one = action("audit", "check that nothing on the board has changed since it was added", _audit)
    one.add_argument(
        "--all", action="store_true", help="verify every result again, instead of a few episodes (minutes)"
    )
    one.add_argument(
        "--jobs", metavar="N", type=count, default=1, help="processes that play episodes (default: 1)"
    )
    one.add_argument(
        "--pin", metavar="FILE", type=Path, help="pin to check the log against (default: the release's)"
    )
    one = action("pin", "write the log's head into a file that ships with a release", _pin)
    one.add_argument(
        "file", metavar="FILE", nargs="?", type=Path, help="file to write (default: the pin of this package)"
    )
    one = action(
        "open",
        "open boards for environments that have none, or else begin the next protocol, which freezes the "
        "current scale; the next nonce then verifies everything again",
        _open,
    )
    one = action("build", "write the page", _build)
    one.add_argument(
        "out", metavar="OUT", nargs="?", type=Path, default=Path("site"), help="folder (default: site)"
    )
    one.add_argument(
        "--url", metavar="ADDRESS", default="", help="future address of the page, for previews and the feed"
    )
    one = action("serve", "write the page into a temporary folder and serve it to this machine only", _serve)
    one.add_argument(
        "--port", metavar="N", type=int, default=8000, help="port; 0 for any free port (default: 8000)"
    )


def run_leaderboard(args: argparse.Namespace) -> int:
    """Run the requested action; raise a UserError if it fails."""
    try:
        return args.act(args)
    except KeyboardInterrupt:
        if args.action in ("add", "nonce"):
            resume = f"`lag-envs leaderboard add{Board(args.board).option}`"
            again = "the same command" if args.action == "add" else resume
            print(f"interrupted; finished work is kept, and {again} resumes", file=sys.stderr)
        raise


def _existing(args: argparse.Namespace) -> Board:
    """Return the board that the arguments name; raise a BoardError if there is none."""
    board = Board(args.board)
    board.require()
    return board


# --- add, nonce ---------------------------------------------------------------------------------------------


def _add(args: argparse.Namespace) -> int:
    from lag_envs.leaderboard.fields import ascii_text
    from lag_envs.leaderboard.submission import Refused, load

    board = Board(args.board)
    there = board.exists()
    before = board.read().entries if there else {}
    failed, added = 0, []
    for folder in args.folders:
        try:
            entry = board.add(load(folder))
        except (Refused, BoardError) as error:
            failed += 1
            print(f"{ascii_text(folder)}: refused: {error}", file=sys.stderr)
            continue
        added.append(entry.id)
        was = before.get(entry.id)
        if was and was.state == "withdrawn":
            print(f"{entry.id}: had been withdrawn and is on the board again, {entry.state}")
        elif entry.state != "pending":
            print(f"{entry.id}: is already on the board, {entry.state}")
    if not there and board.exists():
        print(f"{board.folder} is a new board")
    if args.nonce is not None:
        state = board.read()
        waiting = [e for e in state.waiting() if state.nonce(e) is None]
        # If the same command was interrupted before, the nonce is already published.
        if any(not args.folders or e.id in added for e in waiting):
            _publish(board, args.nonce, args.source)
    if not (args.folders or board.read().waiting()):
        print("nothing is pending")
    return 1 if _finish(board, args) + failed else 0


def _nonce(args: argparse.Namespace) -> int:
    board = Board(args.board)
    if not board.read().waiting():
        raise BoardError("nothing is pending: a nonce now would be known before the next submission")
    _publish(board, args.value, args.source)
    return 1 if _finish(board, args) else 0


def _publish(board: Board, value: str | None, source: str) -> None:
    """Publish a nonce; the hash of a commit is published with its source."""
    from lag_envs.leaderboard.history import head_of

    if value is None:
        value, source = head_of(board), COMMIT
    elif not source and len(value) in (40, 64):
        with suppress(BoardError):
            source = COMMIT if head_of(board) == value else ""
    board.publish(value, source)
    print(f"nonce: {value}")
    if not source:
        print("the nonce names no public source (--source), so an audit will not accept it", file=sys.stderr)


def _open(args: argparse.Namespace) -> int:
    board = _existing(args)
    before = board.read()
    number, after = board.open(), board.read()
    waiting = len(after.waiting())
    if number == before.number and number in before.protocols:
        old = before.protocols[number].scales
        print("\n".join(env_id for env_id in after.protocols[number].scales if env_id not in old))
        print(f"joined protocol {number}; what was verified under it stays")
        return 0
    print(f"protocol {number}; submissions to verify under it: {waiting}")
    if waiting:
        print(f"commit and push, then run `lag-envs leaderboard nonce{board.option}`")
    return 0


def _finish(board: Board, args: argparse.Namespace) -> int:
    """Verify pending submissions, with progress on a terminal; return how many could not be verified."""

    def tell(entry: BoardEntry, what: str) -> None:
        print(f"{entry.id}: {what}", flush=True)

    def parallel_map(check: Callable[[Path], Any], folders: Sequence[Path]) -> Iterable[tuple[Path, Any]]:
        from tqdm import tqdm

        from lag_envs.leaderboard.parallel import map_submissions, with_bar

        if args.ray is None and min(args.jobs, len(folders)) <= 1:
            return map_submissions(partial(with_bar, check), folders)
        found = map_submissions(check, folders, args.jobs, args.ray)
        return tqdm(found, "verifying", len(folders), disable=None, leave=False)

    return finish(board, parallel_map=parallel_map, tell=tell)


# --- list, show, withdraw -----------------------------------------------------------------------------------


def _list(args: argparse.Namespace) -> int:
    board = Board(args.board)
    state = _some(board)
    boards = [b for b in board_data(board)["environments"] if b["rows"] or b["other"]]
    if args.env is not None:
        boards = [b for b in boards if b["id"] == args.env]
        if not boards:
            known = sorted({entry.env for entry in state.entries.values()})
            raise BoardError(f"there is no board named {args.env!r}; {hint(args.env, known)}")
    for number, found in enumerate(boards):
        frozen = ", frozen" if found["frozen"] else ""
        print("\n" * (number > 0) + f"{found['id']}, protocol {found['protocol']}{frozen}")
        lines = [("rank", "score", "95 % interval", "success", "kind", "name", "id")] if found["rows"] else []
        for row in found["rows"]:
            low, high = row["interval"]
            success = "" if row["success"] is None else f"{100.0 * row['success']['rate']:.1f} %"
            ends = f"{low:.4f} to {high:.4f}"
            told = (row["kind"], _plain(row["name"]), row["id"] + _remark(row))
            rank = "-" if row["rank"] is None else str(row["rank"])
            lines.append((rank, f"{row['score']:.4f}", ends, success, *told))
        print("\n".join("  " + line for line in aligned(lines)), end="\n" * bool(lines))
        for other in found["other"]:
            reason = f": {_plain(other['reason'])}" if other["reason"] else ""
            print(f"  {other['id']} {other['state']}{reason}")
    return 0


def _remark(row: dict[str, Any]) -> str:
    """Describe what distinguishes a row."""
    remarks = []
    if row["alike"]:
        remarks.append(f"acts like {row['alike']['id']}")
    if row["looks_like"]:
        remarks.append(f"not {_plain(row['looks_like'])}, though it looks the same")
    if row["reference"]:
        remarks.append("reference, measured in other episodes")
    return f" ({'; '.join(remarks)})" if remarks else ""


def _some(board: Board) -> BoardState:
    """Return the board's state; raise a BoardError if nothing is on it."""
    from lag_envs.leaderboard.checks import sound

    if not board.folder.is_dir():
        board.require()
    try:
        state = board.read()
    except BoardError:
        sound(board)  # which may say more about it
        raise
    if not state.entries:
        if parse(read_log(board.log))[1]:
            raise BoardError(f"{board.log} has only a torn line; {REMEDY}")
        raise BoardError(
            f"{board.folder} has no submissions; `lag-envs leaderboard add FOLDER{board.option}` adds one"
        )
    return state


def _show(args: argparse.Namespace) -> int:
    from lag_envs.leaderboard.checks import sound

    board = Board(args.board)
    state = _some(board)
    number = args.protocol or state.number
    if number not in state.boards:
        raise BoardError(f"there is no protocol {number}; the current one is {state.number}")
    entry = state.boards[number].get(args.id) or state.entry(args.id)
    told: dict[str, Any] = {
        key: value
        for key, value in vars(entry).items()
        if value and key not in ("sha256", "reason", "line", "since", "alike")
    }
    told["state"] = f"{entry.state}: {entry.reason}" if entry.reason else entry.state
    told["authors"] = ", ".join(entry.authors)
    told["files"] = str(board.submission(entry.id))
    row: dict[str, Any] = {}
    if entry.state == "verified":
        boards = board_data(board)["environments"]
        found = next(b for b in boards if (b["id"], b["protocol"]) == (entry.env, entry.protocol))
        row = next(r for r in found["rows"] if r["id"] == entry.id)
    else:
        sound(board)
    if args.json:
        print(json.dumps(told | row, indent=2))
        return 0
    for key in ("profile", "curves", "replays", "above", "id", "name", "authors", "kind", "state", "added"):
        row.pop(key, None)
    if row.get("alike"):
        row["alike"] = row["alike"]["id"]
    if row.get("robustness"):
        row["robustness"] = ", ".join(f"{name}: {value:.4g}" for name, value in row["robustness"].items())
    if row.get("success"):
        row["success"] = "{rate:.4g} ({low:.4g} to {high:.4g})".format(**row["success"])
    if row.get("interval"):
        row["interval"] = "{:.4g} to {:.4g}".format(*row["interval"])
    shown = [
        (key.replace("_", " "), value)
        for key, value in (told | row).items()
        if value not in (None, "", False)
    ]
    print("\n".join(aligned([(key, _plain(value)) for key, value in shown])))
    return 0


def _withdraw(args: argparse.Namespace) -> int:
    board = Board(args.board)
    _some(board)
    board.withdraw(args.id, args.reason)
    print(f"{args.id}: withdrawn")
    return 0


def _plain(value: Any) -> str:
    """Return text without anything that a terminal would act on."""
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return "".join(c if c.isprintable() else "?" for c in text)


# --- audit, pin ---------------------------------------------------------------------------------------------


def _audit(args: argparse.Namespace) -> int:
    """Print each finding; return 1 if something is wrong."""
    from tqdm import tqdm

    from lag_envs.leaderboard.audit import audit
    from lag_envs.leaderboard.history import Finding

    board = _existing(args)
    if args.pin and not args.pin.exists():
        raise BoardError(f"--pin: there is no file {args.pin}")
    with tqdm(desc="playing again", unit=" results", disable=None, leave=False, delay=1.0) as bar:

        def tell(finding: Finding) -> None:
            state = (
                "WRONG" if finding.wrong else "not checked: " + finding.open if finding.open else finding.told
            )
            with tqdm.external_write_mode():
                print(f"{finding.name:12} {_plain(state)}", flush=True)
                for text in finding.wrong:
                    print(f"  {_plain(text)}", flush=True)

        fine = audit(board, args.pin, args.all, tell, lambda entry: bar.update(), args.jobs)
    return 0 if fine else 1


def _pin(args: argparse.Namespace) -> int:
    from lag_envs.leaderboard.checks import write_pin
    from lag_envs.leaderboard.history import PIN

    pin = write_pin(_existing(args), args.file)
    print(f"{args.file or PIN}: {pin.lines} lines, head {pin.head}")
    return 0


# --- build, serve -------------------------------------------------------------------------------------------


def _build(args: argparse.Namespace) -> int:
    from lag_envs.leaderboard.site.build import safe_url, write_page

    board = _existing(args)
    if args.out.is_file():
        raise BoardError(f"{args.out} is a file; name a folder for the page, and the board with --board")
    if args.url and not safe_url(args.url):
        raise BoardError(f"--url: the page's address must begin with https:// or http://, got {args.url!r}")
    write_page(page_data(board), args.out, args.url)
    print(f"{args.out / 'index.html'}")
    return 0


def _serve(args: argparse.Namespace) -> int:
    """Serve to this machine only, until Ctrl-C."""
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

    from lag_envs.leaderboard.site.build import write_page

    board = _existing(args)

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *args: Any) -> None:
            pass

    with tempfile.TemporaryDirectory() as folder:
        try:
            server = ThreadingHTTPServer(("127.0.0.1", args.port), partial(Quiet, directory=folder))
        except OverflowError as error:
            raise BoardError(f"--port must be a number from 0 to 65535, got {args.port}") from error
        except OSError as error:
            raise BoardError(
                f"port {args.port} is already in use ({error}); --port 0 takes a free one"
            ) from error
        with server:
            write_page(page_data(board), Path(folder))
            print(f"http://127.0.0.1:{server.server_address[1]} (Ctrl-C ends)", flush=True)
            server.serve_forever()
    return 0
