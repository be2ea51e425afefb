"""The board: states, locks, kills, merges, and what the page is told."""

import json
import os
import random
import shutil
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import fake_submissions
import pytest
from fake_submissions import ENV, write

from lag_envs.leaderboard import board as module
from lag_envs.leaderboard import submission
from lag_envs.leaderboard.board import Board, BoardError, board_data, finish, id_of
from lag_envs.leaderboard.log import ID, fold, parse
from lag_envs.leaderboard.protocol import PROTOCOL, first_seed
from lag_envs.leaderboard.spread import map_submissions, packed
from lag_envs.leaderboard.submission import Refused
from lag_envs.leaderboard.verify import verify_folder
from lag_envs.scores import KNOWN_RETURNS, score


@pytest.fixture(autouse=True)
def fakes(monkeypatch):
    fake_submissions.install(monkeypatch.setattr)


@pytest.fixture
def board(tmp_path):
    return Board(tmp_path / "board")


def add(board, name="PPO", nonce=None, **told):
    """Add a submission, with a nonce verify it too, and return its id."""
    folder = board.folder.parent / f"{len(list(board.folder.parent.iterdir()))}"
    id = board.add(fake_submissions.load(write(folder, name, **told))).id
    if nonce:
        board.publish(nonce)
        finish(board)
    return id


def states(board):
    return {id: entry.state for id, entry in board.read().entries.items()}


# --- states ---


def test_a_submission_waits_for_a_nonce_that_was_published_after_it(board):
    board.publish("known-before")
    id = add(board)
    finish(board)
    assert states(board) == {id: "pending"}
    board.publish("later")
    later = add(board, "TQC")
    finish(board)
    assert states(board) == {id: "verified", later: "pending"}
    entry = board.read().entry(id)
    assert entry.nonce == board.result(entry)["nonce"] == "later"
    board.publish("last")
    finish(board)
    assert board.read().entry(id).nonce == "later" and board.read().entry(later).nonce == "last"


@pytest.mark.parametrize("nonce", ["", "two words", "a\nb", "ü", "x" * 201])
def test_nonces_that_are_none(board, nonce):
    with pytest.raises(BoardError, match="a nonce is 1 to 200"):
        board.publish(nonce)


def test_a_nonce_counts_once(board):
    board.publish("abc")
    with pytest.raises(BoardError, match="'abc' was published before"):
        board.publish("abc")


def test_ids(board):
    id = add(board, "Ünîted PPO / v2")
    digest = board.read().entry(id).digest
    assert id == f"{ENV}-united-ppo-v2-{digest[:8]}"
    assert ID.fullmatch(id_of(fake_submissions.load(write(board.folder.parent / "x", "日本"))))
    assert sorted(path.name for path in board.submission(id).iterdir()) == [
        "policy_0.safetensors",
        "submission.toml",
    ]


def test_adding_twice_changes_nothing(board):
    folder = write(board.folder.parent / "one")
    first, second = (board.add(fake_submissions.load(folder)) for _ in range(2))
    assert first == second and len(board.log.read_bytes().splitlines()) == 1
    board.publish("n")
    finish(board)
    assert board.add(fake_submissions.load(folder)).state == "verified"
    assert len(board.log.read_bytes().splitlines()) == 3


def test_other_files_of_the_same_id_are_not_taken_for_those_that_are_there(board, monkeypatch):
    id = add(board)
    monkeypatch.setattr(module, "id_of", lambda submission: id)
    with pytest.raises(BoardError, match="taken by other files"):
        add(board, score=0.9)


def test_rejected_with_a_reason_and_may_be_added_again(board):
    id = add(board, nonce="n", reject="it returned an action that is not a finite number")
    entry = board.read().entry(id)
    assert (entry.state, entry.reason) == ("rejected", "it returned an action that is not a finite number")
    board.add(fake_submissions.load(board.submission(id)))
    assert states(board) == {id: "pending"}
    finish(board)  # the nonce was published before
    assert states(board) == {id: "pending"}


def test_the_same_authors_name_replaces_what_they_had(board):
    old = add(board, nonce="1", authors=["A", "B"])
    others = add(board, nonce="2", authors=["C"])
    elsewhere = add(board, nonce="3", authors=["A", "B"], env="InclineTilt-v0")
    new = add(board, nonce="4", authors=["B", "A"], score=0.1)  # even if it is worse
    assert states(board) == {
        old: "superseded", others: "verified", elsewhere: "verified", new: "verified",
    }  # fmt: skip
    assert board.read().entry(old).reason == f"by {new}"


def test_one_that_is_rejected_replaces_nothing(board):
    old = add(board, nonce="1")
    add(board, nonce="2", reject="no")
    assert states(board)[old] == "verified"


def test_withdrawn(board):
    id = add(board, nonce="1")
    board.withdraw(id, "trained on the wrong task")
    assert board.read().entry(id).reason == "trained on the wrong task"
    with pytest.raises(BoardError, match="was withdrawn before"):
        board.withdraw(id, "again")
    with pytest.raises(BoardError, match="there is no 'nobody' on the board"):
        board.withdraw("nobody", "")
    board.verified(id, {"nonce": "1"})  # comes too late
    board.rejected(id, "")
    assert states(board) == {id: "withdrawn"}


def test_failing_for_another_reason_stays_pending(board):
    told = []
    id = add(board, fail="no memory")
    board.publish("n")
    assert finish(board, tell=lambda entry, what: told.append(what)) == 1
    assert states(board) == {id: "pending"}
    assert told == ["could not be verified (MemoryError: no memory); it stays pending"]


def test_changed_files_are_not_what_was_added(board):
    id = add(board)
    board.publish("n")
    (board.submission(id) / "policy_0.safetensors").write_bytes(b"better numbers")
    finish(board)
    assert board.read().entry(id).reason == "its files are not those that were added"


def test_changed_results_are_noticed(board):
    id = add(board, nonce="n")
    path = board.folder / "results" / f"{id}.json.gz"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(BoardError, match="is not the file that was verified"):
        board_data(board)
    path.unlink()
    with pytest.raises(BoardError, match="is missing; restore it"):
        board_data(board)


def test_files_that_change_while_they_are_copied(board, monkeypatch):
    folder = write(board.folder.parent / "changing")
    submission = fake_submissions.load(folder)
    (folder / "policy_0.safetensors").write_bytes(b"others")
    with pytest.raises(BoardError, match="changes while it is read"):
        board.add(submission)
    assert states(board) == {}
    board.add(fake_submissions.load(folder))
    assert not (board.folder / "submissions" / ".new").exists()


# --- frozen boards ---


def test_a_new_protocol_begins_a_new_board_and_freezes_the_old(board, monkeypatch):
    old = add(board, nonce="1")
    waiting = add(board, "TQC")
    monkeypatch.setattr(module, "PROTOCOL", PROTOCOL + 1)
    before = board.log.read_bytes()
    board.publish("2")
    finish(board)
    entry = board.read().entry(waiting)
    assert entry.state == "rejected" and f"protocol {PROTOCOL} has ended" in entry.reason
    assert board.log.read_bytes().startswith(before)
    new = add(board, nonce="3", score=0.9)  # same name and authors, on another board
    assert states(board)[old] == states(board)[new] == "verified"
    found = {(e["id"], e["protocol"]): e for e in board_data(board)["environments"]}
    assert [row["id"] for row in found[ENV, PROTOCOL]["rows"]] == [old] and found[ENV, PROTOCOL]["frozen"]
    assert [row["id"] for row in found[ENV, PROTOCOL + 1]["rows"]] == [new]
    assert not found[ENV, PROTOCOL + 1]["frozen"]


def test_a_new_version_of_an_environment_freezes_the_board_of_the_old(board, monkeypatch):
    old = add(board, nonce="1")
    tasks = {"PivotedBar-v10": module.TASKS[ENV]}
    monkeypatch.setattr(module, "TASKS", module.TASKS | tasks)
    assert module.closed(ENV, PROTOCOL) == "PivotedBar-v10 has taken its place"
    assert module.closed("PivotedBar-v10", PROTOCOL) == module.closed("PivotedBarFree-v0", PROTOCOL) == ""
    with pytest.raises(BoardError, match=f"board of {ENV} is frozen: PivotedBar-v10 has taken its place"):
        add(board, "TQC")
    assert states(board) == {old: "verified"}
    board.withdraw(old, "this is still possible")


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


def test_a_last_line_without_its_end_counts(board):
    first = add(board)
    board.log.write_bytes(board.log.read_bytes()[:-1])
    assert states(board) == {first: "pending"}
    second = add(board, "TQC")
    assert states(board) == {first: "pending", second: "pending"}
    assert len(board.log.read_bytes().splitlines()) == 2


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


@pytest.mark.parametrize(
    "line",
    [
        b"<<<<<<< HEAD",
        b"[]",
        b"[" * 100_000,
        b'{"at": "2026-01-01T00:00:00.000000+00:00", "event": "promoted", "id": "a"}',
        b'{"at": "2026-01-01T00:00:00.000000+00:00", "event": "withdrawn", "id": "../a", "reason": ""}',
        b'{"at": "2026-01-01T00:00:00.000000+00:00", "event": "withdrawn", "id": "a"}',
        b'{"at": "yesterday", "event": "nonce", "value": "a"}',
    ],
)
def test_a_damaged_line_is_named(board, line):
    add(board)
    board.log.write_bytes(board.log.read_bytes() + line + b"\n")
    add_another = partial(add, board, "TQC")
    for use in (board.read, add_another):
        with pytest.raises(BoardError, match=r"board.jsonl, line 2 is no event .* version control"):
            use()


def test_events_of_what_was_never_added(board):
    line = '{"at": "2026-01-01T00:00:00.000000+00:00", "event": "withdrawn", "id": "a", "reason": ""}\n'
    board.folder.mkdir()
    board.log.write_text(line)
    with pytest.raises(BoardError, match="a is withdrawn, and was never added"):
        board.read()


def test_merged_lines_may_be_shuffled(board):
    """Git's union merge keeps all lines of both sides, in whatever order."""
    add(board, nonce="1")
    add(board, "TQC", reject="no", nonce="2")
    board.withdraw(add(board, "SAC", nonce="3"), "why not")
    add(board, nonce="4", score=0.7)
    events, _ = parse(board.log.read_bytes())
    expected = fold(events)
    for seed in range(20):
        random.Random(seed).shuffle(events)
        assert fold(events) == expected


def test_two_clones_may_both_add(board, tmp_path):
    add(board, nonce="1")
    mine, theirs = tmp_path / "mine", tmp_path / "theirs"
    for clone, name in ((mine, "TQC"), (theirs, "SAC")):
        shutil.copytree(board.folder, clone / "board")
        add(Board(clone / "board"), name)
        add(Board(clone / "board"), "DQN")  # both the same
    base, a, b = (path / "board.jsonl" for path in (board.folder, mine / "board", theirs / "board"))
    merge = ["git", "merge-file", "--union", "-p", str(a), str(base), str(b)]
    merged = subprocess.run(merge, capture_output=True, check=True).stdout
    state = fold(parse(merged)[0])
    assert [e.name for e in state.entries.values()].count("DQN") == 1
    assert {e.name: e.state for e in state.entries.values()} == {
        "PPO": "verified", "TQC": "pending", "SAC": "pending", "DQN": "pending",
    }  # fmt: skip


def test_times_grow_even_if_the_clock_is_set_back(board):
    future = '{"at": "2999-01-01T00:00:00.000000+00:00", "event": "nonce", "value": "n"}\n'
    board.folder.mkdir()
    board.log.write_text(future)
    id = add(board)
    assert board.read().entry(id).added > "2999-01-01" and board.read().nonce(board.read().entry(id)) is None


def test_a_full_disk_leaves_the_log_as_it_was(board, monkeypatch):
    add(board)
    before = board.log.read_bytes()
    real = os.write
    monkeypatch.setattr(os, "write", lambda file, content: real(file, content[:10]))
    with pytest.raises(OSError, match="the disk is full"):
        board.publish("n")
    assert board.log.read_bytes() == before


def test_a_log_that_is_replaced_while_one_waits(board):
    """As version control does: who waits for the lock writes to the new file."""
    add(board)
    waiting = threading.Thread(target=board.publish, args=("n",))
    with board.change():
        waiting.start()
        waiting.join(0.1)
        shutil.copy(board.log, board.folder / "other")
        os.replace(board.folder / "other", board.log)
    waiting.join(10)
    assert [value for _, value in board.read().nonces] == ["n"]


# --- several at once, and kills ---


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(
    "task",
    [
        ("every_step",),
        ("random_moments", "6"),
        pytest.param(("random_moments", "200"), marks=pytest.mark.slow),
        ("at_once", "3", "5"),
        pytest.param(("at_once", "8", "40"), marks=pytest.mark.slow),
        ("finished_at_once", "3", "4"),
    ],
    ids=" ".join,
)
def test_processes(task, tmp_path):
    name, *numbers = task
    here = Path(__file__).parent
    command = [sys.executable, str(here / "board_processes.py"), name, str(tmp_path), *numbers]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


# --- spreading ---


def outcome(folder):
    """Work of a kind that processes are given."""
    if folder.name == "dies":
        os._exit(3)
    if folder.name == "refused":
        raise Refused("no")
    return (folder / "submission.toml").read_text()


@pytest.mark.parametrize("jobs", [1, 2])
def test_map_submissions(tmp_path, jobs):
    folders = [tmp_path / name for name in ("a", "refused", "b", *["dies"] * (jobs - 1))]
    for folder in folders:
        folder.mkdir()
        (folder / "submission.toml").write_text(folder.name)
    found = {folder.name: result for folder, result in map_submissions(outcome, folders, jobs)}
    assert [found[name] for name in "ab"] == ["a", "b"]  # whatever becomes of others
    assert isinstance(found["refused"], Refused) and str(found["refused"]) == "no"
    if jobs > 1:
        assert type(found["dies"]).__name__ == "BrokenProcessPool"


@pytest.mark.slow
def test_verifying_on_ray_is_verifying_here(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.undo()  # the real ones
    kinds = {"kind": "controller", "license": "MIT", "authors": ["A"]}
    for name in ("full damping", "switching line"):
        policy = {"architecture": "controller", "name": name}
        submission.write(tmp_path / name, env="InclineBrake-v0", name=name, policy=policy, **kinds)
    (tmp_path / "refused").mkdir()
    (tmp_path / "refused" / "link").symlink_to(tmp_path)
    folders = [path for path in tmp_path.iterdir() if path.is_dir()]
    work = partial(verify_folder, nonce="n", episodes=5)
    here, there = ({f.name: r for f, r in map_submissions(work, folders, ray=ray)} for ray in (None, "local"))
    assert here["refused"] == there["refused"] and "refused" in here["refused"]
    for name in ("full damping", "switching line"):
        assert here[name]["policies"] == there[name]["policies"]


def test_only_plain_small_files_travel(tmp_path):
    folder = write(tmp_path / "a")
    assert sorted(packed(folder)) == ["policy_0.safetensors", "submission.toml"]
    with (folder / "large").open("wb") as out:
        out.truncate(10**9)
    assert packed(folder) is None
    (folder / "large").unlink()
    (folder / "link").symlink_to("/etc/passwd")
    assert packed(folder) is None
    assert packed(tmp_path / "none") is None


# --- what the page is told ---


def test_board_data(board):
    best = add(board, "best", nonce="1", score=0.9, kind="controller")
    add(board, nonce="2", score=0.5)
    rejected = add(board, "bad", nonce="3", reject="no")
    pending = add(board, "new")
    data = board_data(board, "2026-01-01")
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert (data["protocol"], data["made"]) == (PROTOCOL, "2026-01-01")
    assert [e["id"] for e in data["environments"]] == list(module.TASKS)
    found = data["environments"][0]
    assert (
        found["known"]["best"] == KNOWN_RETURNS[ENV].best
        and found["title"]
        and found["scene"] == "PivotedBar"
    )
    assert found["dt"] == 0.02 and "upright" in found["goal"]
    first, second = found["rows"]
    assert (first["id"], first["rank"], second["rank"]) == (best, 1, 2)
    assert first["score"] == pytest.approx(0.9, abs=0.01) and first["interval"][0] <= first["score"]
    assert second["above"] == [1.0, 1.0, 1.0] and first["above"] is None
    assert (first["env_steps"], first["seconds"], first["code"]) == (1000, 2.0, "https://example.org/code")
    assert first["curves"][0]["scores"][0] == pytest.approx(0.0, abs=0.01)
    assert [(o["id"], o["state"], o["reason"]) for o in found["other"]] == [
        (rejected, "rejected", "no"),
        (pending, "pending", ""),
    ]


def test_replays_are_of_verified_episodes(board):
    """Of the policy in the middle: the median, the best and the worst episode."""
    id = add(board, nonce="1")
    entry = board.read().entry(id)
    result = board.result(entry)
    means = [sum(p["returns"]) for p in result["policies"]]
    middle = sorted(range(5), key=means.__getitem__)[2]
    returns = result["policies"][middle]["returns"]
    first = first_seed(entry.digest, "1", middle)
    chosen = {r["label"]: returns[r["reset_seed"] - first] for r in result["replays"]}
    assert chosen == {"median": sorted(returns)[9], "best": max(returns), "worst": min(returns)}
    row = board_data(board)["environments"][0]["rows"][0]
    assert [r["label"] for r in row["replays"]] == ["median", "best", "worst"]
    assert row["replays"][0]["score"] == pytest.approx(score(ENV, 100.0), rel=1e-4)


def test_value_function(board):
    add(board)
    (board.folder / "values").mkdir()
    value = {"axes": [{"label": "a"}, {"label": "b"}], "values": [[1.0]]}
    (board.folder / "values" / f"{ENV}.json").write_text(json.dumps(value))
    environments = board_data(board)["environments"]
    assert environments[0]["value"] == value and environments[1]["value"] is None


@pytest.mark.slow
def test_coarse_value_functions():
    from agents.board_values import coarse

    value = coarse("PivotedBar-v0", None)  # that of the bar without a track
    theta, theta_dot = value["axes"]
    assert (theta["label"], theta_dot["label"], theta["low"]) == ("theta", "theta_dot", 0.0)
    assert len(value["values"]) == theta["n"] and {len(row) for row in value["values"]} == {theta_dot["n"]}
    best = max(range(theta["n"]), key=lambda i: value["values"][i][theta_dot["n"] // 2])
    assert best == theta["n"] // 2  # upright
    assert coarse("InclineBrake-v0", None)["axes"][1]["label"] == "x_dot"


def test_an_empty_board(board):
    assert all(not e["rows"] and not e["other"] for e in board_data(board)["environments"])
    assert not board.folder.exists()
