"""Boards with fake submissions."""

import hashlib
import json

import fake_submissions
import pytest
from fake_submissions import write

from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.pending import finish


@pytest.fixture(name="board")
def fake_board(tmp_path, monkeypatch):
    """A board for fake submissions."""
    fake_submissions.install(monkeypatch.setattr)
    return Board(tmp_path / "board")


def add(board, name="PPO", nonce=None, **told):
    """Add a submission, with a nonce also verify it, and return its id."""
    folder = board.folder.parent / f"{len(list(board.folder.parent.iterdir()))}"
    id = board.add(fake_submissions.load(write(folder, name, **told))).id
    if nonce:
        board.publish(nonce)
        finish(board)
    return id


def lines(board):
    return [json.loads(line) for line in board.log.read_bytes().splitlines()]


def chained(*events):
    """Return a log of events, each with the hash of the log before it."""
    log = b""
    for event in events:
        event = event | {"prev": hashlib.sha256(log).hexdigest()}
        log += json.dumps(event, ensure_ascii=False).encode() + b"\n"
    return log


def events(board):
    return [line["event"] for line in lines(board)]


def states(board):
    return {id: entry.state for id, entry in board.read().entries.items()}
