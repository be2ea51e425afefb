"""Processes that work on a board at once, or are killed while doing so. Run by tests/test_board_log.py."""

import collections
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

import fake_submissions
from boards import lines
from fake_submissions import write

from lag_envs.leaderboard import (
    ranking,  # noqa: F401, so that not every process imports SciPy
    submission,
)
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.pending import finish

#: Calls that change files. Each is a moment to be killed at.
CALLS = ("open", "write", "fsync", "ftruncate", "rename", "replace", "mkdir", "rmdir", "unlink", "close")


def forked(work, *args):
    """Run a function in a separate process and return the process's id."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            work(*args)
            status = 0
        finally:
            os._exit(status)
    return child


def ended(child):
    """Wait for a process; return its status, negative for the signal that killed it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def add(board, folder, nonce):
    """Do the same as the command `leaderboard add FOLDER --nonce NONCE`."""
    entry = board.add(submission.load(folder))
    if entry.state == "pending" and board.read().nonce(entry) is None:
        board.publish(nonce)
    assert finish(board) == 0
    return entry.id


def check_whole(board, expected):
    """Check that a board has these states, each thing once, and no left-overs."""
    state = board.read()
    assert {e.id: e.state for e in state.entries.values()} == expected, state.entries
    for entry in state.entries.values():
        assert submission.load(board.submission(entry.id)).digest == entry.digest
        board.result(entry)
    counts = collections.Counter((e["event"], e["id"]) for e in lines(board) if "id" in e)
    assert set(counts.values()) <= {1}, counts
    left = [path for path in board.folder.rglob("*") if path.name.startswith(".")]
    assert not left, left


# --- killed at every step -----------------------------------------------------------------------------------


def killed_at(number, work):
    """Do the work, and be killed in the middle of the n-th call that changes files."""
    count = 0

    def wrap(name):
        real = getattr(os, name)

        def call(*args, **options):
            nonlocal count
            count += 1
            if count == number:
                if name == "write":  # half of it gets there
                    real(args[0], args[1][: len(args[1]) // 2])
                os.kill(os.getpid(), signal.SIGKILL)
            return real(*args, **options)

        setattr(os, name, call)

    for name in CALLS:
        wrap(name)
    work()


def every_step(root):
    old, new = write(root / "old", score=0.4), write(root / "new", score=0.6)
    start = Board(root / "start")
    first = add(start, old, "nonce-1")
    for number in range(1, 1000):
        board = Board(root / f"board{number}")
        shutil.copytree(start.folder, board.folder)
        status = ended(forked(killed_at, number, lambda board=board: add(board, new, "nonce-2")))
        state = board.read()  # must work at any moment
        assert state.entries[first].state in ("verified", "superseded"), number
        board.result(state.entries[first])
        second = add(board, new, "nonce-2" if status else "nonce-3")
        check_whole(board, {first: "superseded", second: "verified"})
        shutil.rmtree(board.folder)
        if status == 0:
            print(f"killed at {number - 1} steps")
            return
        assert status == -signal.SIGKILL, status
    raise AssertionError("it never came to its end")


# --- killed at random moments -------------------------------------------------------------------------------


def random_moments(root, rounds):
    board, rng, told = Board(root / "board"), random.Random(0), set()
    folders = [write(root / f"s{i}", name=f"agent {i}") for i in range(5 * rounds)]
    left = list(folders)
    for number in range(rounds):
        reader, writer = os.pipe()

        def work(number=number, writer=writer, left=tuple(left)):
            for folder in left:
                id = add(board, folder, f"nonce-{number}-{folder.name}")
                os.write(writer, f"{id}\n".encode())

        child = forked(work)
        os.close(writer)
        with os.fdopen(reader) as answers:
            ids = [answers.readline().strip() for _ in range(rng.randrange(3))]
            time.sleep(rng.uniform(0.0, 0.03))
            os.kill(child, signal.SIGKILL)
            ended(child)
            ids = [id for id in ids if id] + answers.read().splitlines()
        told.update(ids)
        left = left[len(ids) :]
        entries = board.read().entries
        assert all(entries[id].state == "verified" for id in told)
    assert told
    board.publish("the-last-one")
    finish(board)
    check_whole(board, dict.fromkeys(board.read().entries, "verified"))
    print(f"{len(told)} acknowledged, {rounds} kills")


# --- several at once ----------------------------------------------------------------------------------------


def at_once(root, processes, each):
    board = Board(root / "board")
    work = [[write(root / f"s{p}-{i}", name=f"agent {p} {i}") for i in range(each)] for p in range(processes)]

    def adds(number):
        for i, folder in enumerate(work[number]):
            add(board, folder, f"nonce-{number}-{i}")

    children = [forked(adds, number) for number in range(processes)]
    while any(children):  # a reader sees whole boards all the time
        board.read()
        for i, child in enumerate(children):
            if child and os.waitpid(child, os.WNOHANG)[0]:
                children[i] = 0
    state = board.read()
    assert len(state.entries) == processes * each
    assert finish(board) == 0
    check_whole(board, dict.fromkeys(state.entries, "verified"))
    print(f"{processes * each} added by {processes}")


def finished_at_once(root, processes, each):
    """Several processes that find the same pending submissions verify each of them once."""
    board = Board(root / "board")
    for i in range(each):
        board.add(submission.load(write(root / f"s{i}", name=f"agent {i}")))
    board.publish("nonce")
    tally = root / "tally"
    real = fake_submissions.recompute

    def slow(*args, **options):
        time.sleep(0.005)
        with tally.open("a") as out:
            out.write("x")
        return real(*args, **options)

    fake_submissions.verify.verify = slow
    for child in [forked(finish, board) for _ in range(processes)]:
        assert ended(child) == 0
    assert finish(board) == 0
    check_whole(board, dict.fromkeys(board.read().entries, "verified"))
    assert len(tally.read_text()) == each


if __name__ == "__main__":
    fake_submissions.install()
    # Data written by a killed process is safe in the system; only a power cut needs the slow flush to disk.
    os.fsync = lambda file: None
    globals()[sys.argv[1]](Path(sys.argv[2]), *map(int, sys.argv[3:]))
