"""The board's log survives kills, full disks, clones and several processes at once."""

import json
import os
import shutil
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import fake_submissions
import pytest
from boards import add, chained, events, fake_board, lines, states  # noqa: F401
from covering import slow
from fake_submissions import write

from lag_envs.leaderboard.board import Board, BoardError
from lag_envs.leaderboard.log import fold, parse
from lag_envs.leaderboard.standings import board_data

# --- the log ---


@pytest.mark.parametrize("torn", [b"{", b'{"at": "2026', b"\x00\x00\x00", b'{"at": "2026-01-01T00:00:00"}'])
def test_a_torn_last_line_is_passed_over_and_removed(board, torn):
    first = add(board)
    whole = board.log.read_bytes()
    board.log.write_bytes(whole + torn)
    assert states(board) == {first: "pending"}
    second = add(board, "TQC")
    assert states(board) == {first: "pending", second: "pending"}
    assert board.log.read_bytes().startswith(whole + b'{"at"')


def test_the_first_submission_is_added_while_the_board_is_read(board, monkeypatch):
    board.folder.mkdir(parents=True, exist_ok=True)
    board.log.touch()
    others = [add]

    def read_log(path):
        content = path.read_bytes()
        if others:
            others.pop()(board)
        return content

    monkeypatch.setattr("lag_envs.leaderboard.board.read_log", read_log)
    assert not board.read().entries
    assert list(states(board).values()) == ["pending"]
    board.log.write_bytes(b"")
    with pytest.raises(BoardError, match="is empty, though there are submissions; restore it"):
        board.read()


def test_a_last_line_without_its_end_counts(board):
    first = add(board)
    board.log.write_bytes(board.log.read_bytes()[:-1])
    assert states(board) == {first: "pending"}
    second = add(board, "TQC")
    assert states(board) == {first: "pending", second: "pending"}
    assert events(board) == ["protocol", "added", "added"]


def test_every_beginning_of_a_log_can_be_read(board):
    add(board, nonce="1")
    add(board, nonce="2", score=0.7)
    log = board.log.read_bytes()
    seen = 0
    for end in range(len(log) + 1):
        events, torn = parse(log[:end])
        seen = max(seen, len(fold(events).entries))
        assert not torn or log[:end].endswith(torn)
    assert seen == 2


AT = '"at": "2026-01-01T00:00:00.000000+00:00"'


@pytest.mark.parametrize(
    "line",
    [
        "<<<<<<< HEAD",
        "[]",
        "[" * 100_000,
        "null",
        "\ufeff{}",
        '{"at": NaN}',
        '{"a": 1, "a": 2}',
        '{"at": ' + "9" * 5000 + "}",
        f'{{{AT}, "event": "promoted", "id": "a"}}',
        f'{{{AT}, "event": ["withdrawn"], "id": "a", "reason": ""}}',
        f'{{{AT}, "event": "withdrawn", "id": "../a", "reason": ""}}',
        f'{{{AT}, "event": "withdrawn", "id": "a\\n", "reason": ""}}',
        f'{{{AT}, "event": "withdrawn", "id": "a"}}',
        f'{{{AT}, "event": "withdrawn", "id": "a", "reason": "\\ud800"}}',
        f'{{{AT}, "event": "withdrawn", "id": "a", "reason": "", "also": 1}}',
        f'{{{AT}, "event": "verified", "id": "a", "nonce": "n", "sha256": "{64 * "0"}",'
        ' "supersedes": [{}]}',
        '{"at": "yesterday", "event": "nonce", "value": "a"}',
        '{"at": "9999-12-31T23:59:59.999999+00:00", "event": "nonce", "value": "a"}',
        '{"at": "2026-13-31T23:59:59.999999+00:00", "event": "nonce", "value": "a"}',
        '{"at": "2026-01-01T00:00:00.000000+00:00\\n", "event": "nonce", "value": "a"}',
        f'{{{AT}, "event": "nonce", "value": 1e400}}',
        f'{{{AT}, "event": "added", "id": "a", "protocol": 1{"0" * 400}}}',
    ],
)
def test_a_damaged_line_is_named(board, line):
    add(board)
    board.log.write_bytes(board.log.read_bytes() + line.encode() + b"\n")
    add_another, withdraw = partial(add, board, "TQC"), partial(board.withdraw, next(iter(ids(board))), "x")
    for use in (board.read, add_another, withdraw, board.open, partial(board_data, board)):
        with pytest.raises(BoardError, match=r"board.jsonl, line 3 is not an event .* version control"):
            use()


def ids(board):
    told = (json.loads(line) for line in board.log.read_bytes().splitlines()[:-1])  # the last one is damaged
    return [line["id"] for line in told if "id" in line]


def rewritten(board, change):
    """Let a function change a board's events, and chain them again."""
    told = lines(board)
    change(told)
    board.log.write_bytes(chained(*({k: v for k, v in event.items() if k != "prev"} for event in told)))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda told: told.pop(1), "line 3: .* is verified, but was never added"),
        (lambda told: told.pop(0), "line 4: .*|does not state the scale"),
        (lambda told: told.pop(2), "line 3: .* nonce 'n', which is not its own"),
        (lambda told: told.insert(1, told.pop(2)), "line 3: .* is earlier than the line before it"),
        (lambda told: told.append(told[3]), "line 5: .* is verified, but was verified already"),
        (lambda told: told.append(told[1] | {"at": told[3]["at"]}), "line 5: .* is already on the board"),
        (lambda told: told.append(told[2] | {"at": told[3]["at"]}), "line 5: the nonce 'n' was published"),
        (lambda told: told[3].update(nonce="other"), "line 4: .* which is not its own"),
        (lambda told: told[3].update(supersedes=[told[1]["id"]]), "line 4: .* not another result"),
        (lambda told: told[3].update(supersedes=["Gone"]), "line 4: .* not another result"),
        (lambda told: told[0].update(number=2), "line 1: protocol 2 begins, but the next would be 1"),
        (lambda told: told[1].update(protocol=2), "line 2: .* protocol 2, but the current one is 1"),
        (lambda told: told[3].update(event="rejected"), "line 4 is not an event"),
    ],
)  # fmt: skip
def test_events_that_contradict_each_other(board, change, reason):
    add(board, nonce="n")
    rewritten(board, change)
    with pytest.raises(BoardError, match=reason):
        board.read()
        board.add(fake_submissions.load(write(board.folder.parent / "another", "TQC")))


def test_times_grow_even_if_the_clock_is_set_back(board):
    board.folder.mkdir()
    event = {"at": "2199-01-01T00:00:00.000000+00:00", "event": "nonce", "value": "n"}
    board.log.write_bytes(chained(event))
    id = add(board)
    assert board.read().entry(id).added > "2199-01-01" and board.read().nonce(board.read().entry(id)) is None
    board.log.write_bytes(chained(event | {"at": "2199-12-31T23:59:59.999999+00:00"}))
    with pytest.raises(BoardError, match=r"this cannot be logged: .* before the year 2200"):
        add(board, "TQC")


def test_additions_of_two_clones_conflict(board, tmp_path):
    """Git's merge is a conflict; the second to push takes the other's log and adds again."""
    add(board, nonce="1")
    first, second = tmp_path / "first", tmp_path / "second"
    for clone, name in ((first, "TQC"), (second, "SAC")):
        shutil.copytree(board.folder, clone / "board")
        add(Board(clone / "board"), name)
    base, a, b = (path / "board.jsonl" for path in (board.folder, first / "board", second / "board"))
    for how in ([], ["--union"]):  # a union would keep both, and break the chain
        merge = ["git", "merge-file", *how, "-p", str(a), str(base), str(b)]
        merged = subprocess.run(merge, capture_output=True).stdout
        with pytest.raises(BoardError, match=r"line \d+ (is not an event|does not follow)"):
            parse(merged)
    shutil.copy(b, a)
    first = Board(first / "board")
    first.add(fake_submissions.load(next(first.folder.glob("submissions/*-tqc-*"))))
    assert {e.name: e.state for e in first.read().entries.values()} == {
        "PPO": "verified", "SAC": "pending", "TQC": "pending",
    }  # fmt: skip


def test_a_full_disk_leaves_the_log_as_it_was(board, monkeypatch):
    add(board)
    before = board.log.read_bytes()
    real = os.write
    monkeypatch.setattr(os, "write", lambda file, content: real(file, content[:10]))
    with pytest.raises(OSError, match="the disk is full"):
        board.publish("n")
    assert board.log.read_bytes() == before


def test_a_log_that_is_replaced_while_one_waits(board):
    """As version control may do: a process that waits for the lock writes to the new file."""
    add(board)
    waiting = threading.Thread(target=board.publish, args=("n",))
    with board.change():
        waiting.start()
        waiting.join(0.1)
        shutil.copy(board.log, board.folder / "other")
        os.replace(board.folder / "other", board.log)
    waiting.join(10)
    assert [value for _, value, _ in board.read().nonces] == ["n"]


# --- several at once, and kills ---


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(
    "task",
    [
        slow(("every_step",)),
        ("random_moments", "6"),
        slow(("random_moments", "200")),
        slow(("at_once", "3", "5")),
        slow(("at_once", "8", "40")),
        slow(("finished_at_once", "3", "4")),
    ],
    ids=" ".join,
)
def test_processes(task, tmp_path):
    name, *numbers = task
    here = Path(__file__).parent
    command = [sys.executable, str(here / "board_processes.py"), name, str(tmp_path), *numbers]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr
