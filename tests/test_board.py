"""The board: states, locks, kills, merges, and the page's data."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import fake_submissions
import pytest
from covering import slow
from fake_submissions import ENV, write

from lag_envs import scores
from lag_envs.leaderboard import board as module
from lag_envs.leaderboard import protocol, ranking, standings, submission
from lag_envs.leaderboard.board import Board, BoardError, closed, id_of
from lag_envs.leaderboard.log import LogLine, fold, parse
from lag_envs.leaderboard.parallel import map_submissions, packed
from lag_envs.leaderboard.pending import finish
from lag_envs.leaderboard.protocol import first_seed
from lag_envs.leaderboard.standings import board_data
from lag_envs.leaderboard.submission import Refused
from lag_envs.leaderboard.verify import verify_folder
from lag_envs.scores import known_returns, score
from lag_envs.tasks import incline, pivoted_bar


@pytest.fixture(autouse=True)
def fakes(monkeypatch):
    fake_submissions.install(monkeypatch.setattr)


@pytest.fixture
def board(tmp_path):
    return Board(tmp_path / "board")


def add(board, name="PPO", nonce=None, **told):
    """Add a submission, with a nonce also verify it, and return its id."""
    folder = board.folder.parent / f"{len(list(board.folder.parent.iterdir()))}"
    id = board.add(fake_submissions.load(write(folder, name, **told))).id
    if nonce:
        board.publish(nonce)
        finish(board)
    return id


def events(board):
    return [json.loads(line)["event"] for line in board.log.read_bytes().splitlines()]


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
    assert re.fullmatch(
        r"[A-Za-z0-9]+(-[A-Za-z0-9]+)*",
        id_of(fake_submissions.load(write(board.folder.parent / "x", "日本"))),
    )
    assert sorted(path.name for path in board.submission(id).iterdir()) == [
        "policy_0.safetensors",
        "submission.toml",
    ]


def test_adding_twice_changes_nothing(board):
    folder = write(board.folder.parent / "one")
    first, second = (board.add(fake_submissions.load(folder)) for _ in range(2))
    assert first == second and events(board) == ["protocol", "added"]
    board.publish("n")
    finish(board)
    assert board.add(fake_submissions.load(folder)).state == "verified"
    assert events(board) == ["protocol", "added", "nonce", "verified"]


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
    board.publish("better-luck")
    finish(board)  # with the nonce of the first time, and the same outcome as then
    assert board.read().entry(id) == entry


def test_the_same_authors_name_replaces_what_they_had(board):
    old = add(board, nonce="1", authors=["A", "B"])
    others = add(board, nonce="2", authors=["C"])
    elsewhere = add(board, nonce="3", authors=["A", "B"], env=incline.Tilt.id)
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


@pytest.mark.parametrize("verified", [True, False])
def test_who_comes_back_finds_the_luck_of_the_first_time(board, verified):
    id = add(board)
    board.publish("1")
    if verified:
        finish(board)
    first = board.read().entry(id)
    board.withdraw(id, "bad luck")
    board.publish("2")
    board.add(fake_submissions.load(board.submission(id)))
    finish(board)
    again = board.read().entry(id)
    assert (again.state, again.nonce) == ("verified", "1") and again.added == first.added
    assert not verified or again == first
    assert events(board).count("verified") == 1


def test_who_comes_back_does_not_displace_what_came_later(board):
    old = add(board, nonce="1", score=0.9)
    board.withdraw(old, "a better one is coming")
    new = add(board, nonce="2", score=0.1)
    board.add(fake_submissions.load(board.submission(old)))
    assert states(board) == {old: "superseded", new: "verified"}
    assert board.read().entry(old).reason == f"by {new}"


# --- those that act alike ---


def shown(board):
    rows = board_data(board)["environments"][0]["rows"]
    return {row["name"]: (row["rank"], row["alike"] and row["alike"]["name"]) for row in rows}


def test_who_acts_like_an_earlier_one_is_shown_without_a_rank(board):
    add(board, nonce="1", acts="x", score=0.5)
    add(board, "other", nonce="2", score=0.3)
    add(board, "clone", nonce="3", authors=["B"], acts="x", score=0.7)
    add(board, "clone of the clone", nonce="4", authors=["C"], acts="x", score=0.6)
    assert shown(board) == {
        "clone": (None, "PPO"), "clone of the clone": (None, "PPO"), "PPO": (1, None), "other": (2, None),
    }  # fmt: skip


def test_the_first_is_who_was_added_first_whoever_is_verified_first(board, monkeypatch):
    failing = [True]
    real = fake_submissions.recompute

    def recompute(found, *args, **options):
        if failing[0] and fake_submissions.told(found)["name"] == "PPO":
            raise MemoryError("now")
        return real(found, *args, **options)

    monkeypatch.setattr(fake_submissions.verify, "verify", recompute)
    add(board, acts="x")
    add(board, "clone", acts="x", authors=["B"])
    board.publish("1")
    assert finish(board) == 1
    assert shown(board) == {"clone": (1, None)}
    failing[0] = False
    assert finish(board) == 0
    assert shown(board) == {"clone": (None, "PPO"), "PPO": (1, None)}


def test_better_luck_is_not_had_by_submitting_the_same_again(board):
    first = add(board, nonce="1", acts="x")
    again = add(board, nonce="2", acts="x", score=0.51)
    assert states(board) == {first: "verified", again: "verified"}  # it does not replace the first
    board.withdraw(first, "bad luck")
    third = add(board, nonce="3", acts="x", score=0.52)
    assert states(board) == {first: "withdrawn", again: "verified", third: "verified"}
    rows = board_data(board)["environments"][0]["rows"]
    assert [row["rank"] for row in rows] == [None, None]
    assert {row["alike"]["state"] for row in rows} == {"withdrawn"}
    improved = add(board, nonce="4", score=0.8)
    assert states(board)[improved] == "verified" and states(board)[again] == "superseded"


def test_likeness_counts_within_a_board(board):
    add(board, nonce="1", acts="x")
    add(board, nonce="2", acts="x", env=pivoted_bar.SwingUpFree.id)
    assert all(
        [row["rank"] for row in found["rows"]] == [1] for found in board_data(board)["environments"][:2]
    )


def test_names_that_look_like_others_are_shown_as_such(board):
    add(board, "PPO", nonce="1", authors=["A. Author"])
    add(board, "\u0420PO", nonce="2", authors=["B"], score=0.4)
    add(board, "SAC", nonce="3", authors=["\u0410. Author"], score=0.3)
    add(board, "A. author", nonce="4", authors=["C"], score=0.2)
    add(board, "PPO", nonce="5", authors=["D"], score=0.1)
    rows = board_data(board)["environments"][0]["rows"]
    assert [row["looks_like"] for row in rows] == ["", "PPO", "A. Author", "A. Author", ""]


# --- protocols, and frozen boards ---


def test_a_new_protocol_verifies_anew_what_is_there_and_freezes_the_old(board):
    old = add(board, nonce="1")
    waiting = add(board, "TQC")
    gone = add(board, "SAC", nonce="1b")
    board.withdraw(gone, "no more")
    finish(board)
    log, result = board.log.read_bytes(), board.result_file(board.read().entry(old))
    before, kept = board_data(board, "today"), result.read_bytes()
    assert board.open() == 2
    assert states(board) == {old: "pending", waiting: "pending"}
    finish(board)  # the existing nonces were known before
    assert states(board) == {old: "pending", waiting: "pending"}
    board.publish("2")
    finish(board)
    assert states(board) == {old: "verified", waiting: "verified"}
    assert {entry.nonce for entry in board.read().entries.values()} == {"2"}
    assert board.log.read_bytes().startswith(log) and result.read_bytes() == kept
    found = {(e["id"], e["protocol"]): e for e in board_data(board, "today")["environments"]}
    frozen = before["environments"][0]
    assert found[ENV, 1] == frozen | {"frozen": True, "other": found[ENV, 1]["other"]}
    assert {row["id"] for row in found[ENV, 2]["rows"]} == {old, waiting} and not found[ENV, 2]["frozen"]
    board.add(fake_submissions.load(board.submission(gone)))  # and may come back, with new episodes
    assert states(board)[gone] == "pending"
    new = add(board, score=0.9)  # same name and authors
    board.publish("3")
    finish(board)
    assert states(board) == {old: "superseded", waiting: "verified", gone: "verified", new: "verified"}


def test_boards_of_new_environments_join_the_protocol(board, monkeypatch):
    new = pivoted_bar.SwingUpFree.id
    tasks = {name: task for name, task in module.TASKS.items() if name != new}
    with monkeypatch.context() as before:
        for place in (module, protocol, standings):
            before.setattr(place, "TASKS", tasks)
        old = add(board, nonce="1")
        shown = board_data(board, "today")["environments"][0]
    with pytest.raises(BoardError, match="add to a board of protocol 1: success differ"):
        add(board, "TQC")
    assert board.open() == 1 and events(board)[-1] == "opened"
    joined = board.read().protocols[1]
    assert set(joined.scales) == set(protocol.boards()) and joined.rules.model_dump() == protocol.rules()
    assert joined.references.keys() == {id for id in protocol.boards() if protocol.reference(id)}
    assert states(board) == {old: "verified"}  # nothing is verified again
    assert board_data(board, "today")["environments"][0] == shown
    other = add(board, env=new, nonce="2")
    assert states(board) == {old: "verified", other: "verified"}
    told = next(line for line in parse(board.log.read_bytes())[0] if line.event.event == "opened")
    again = [
        *parse(board.log.read_bytes())[0],
        LogLine(99, told.event.model_copy(update={"at": board.read().last})),
    ]
    with pytest.raises(BoardError, match=f"{new} joins protocol 1, and has a board there already"):
        fold(again)
    assert board.open() == 2  # now that all are there


def test_boards_join_no_protocol_of_other_rules(board, monkeypatch):
    tasks = {name: task for name, task in module.TASKS.items() if name != pivoted_bar.SwingUpFree.id}
    with monkeypatch.context() as before:
        for place in (module, protocol, standings):
            before.setattr(place, "TASKS", tasks)
        add(board, nonce="1")
    monkeypatch.setattr(protocol, "LEARNED_POLICIES", 7)
    assert board.open() == 2


def test_a_later_record_does_not_move_the_scale_of_a_board(board, monkeypatch):
    add(board, nonce="1", score=1.0)
    before = board_data(board, "today")
    known = known_returns(ENV)
    record = known._replace(best=known.random + 2.0 * (known.best - known.random), policy="a record")
    for place in (scores, fake_submissions):
        monkeypatch.setattr(place, "known_returns", lambda id: record if id == ENV else known_returns(id))
    assert board_data(board, "today") == before
    board.open()
    board.publish("2")
    finish(board)
    (new, *_), (old,) = (
        [e for e in board_data(board)["environments"] if e["id"] == ENV and e["protocol"] == n]
        for n in (2, 1)
    )
    assert (new["known"]["policy"], old["known"]["policy"]) == ("a record", known.policy)
    assert old["rows"] == before["environments"][0]["rows"]
    assert new["rows"][0]["return"] == pytest.approx(record.best, rel=0.01)  # the fake ones keep their score


def test_other_rules_need_another_protocol(board, monkeypatch):
    add(board, nonce="1")
    monkeypatch.setattr(protocol, "LEARNED_POLICIES", 7)
    with pytest.raises(BoardError, match="add to a board of protocol 1: learned_policies differ"):
        add(board, "TQC")
    assert len(board_data(board)["environments"][0]["rows"]) == 1  # existing results can be shown
    board.open()
    with pytest.raises(BoardError, match="published"):
        board.publish("1")
    add(board, "TQC")


def test_a_log_from_before_there_were_protocols_in_it(board):
    """The log states protocol 1 late; this causes no new verification."""
    id = add(board, nonce="1")
    lines = [json.loads(line) for line in board.log.read_text().splitlines()][1:]
    old = "".join(json.dumps({k: v for k, v in line.items() if k != "prev"}) + "\n" for line in lines)
    board.log.write_text(old)
    assert states(board) == {id: "verified"}
    with pytest.raises(BoardError, match="does not tell the scale of protocol 1"):
        add(board, "TQC")
    assert board_data(board)["environments"][0]["rows"] == []
    assert board.open() == 1
    assert board.log.read_text().startswith(old) and states(board) == {id: "verified"}
    assert [row["id"] for row in board_data(board)["environments"][0]["rows"]] == [id]
    assert board.open() == 2


def test_a_new_version_of_an_environment_freezes_the_board_of_the_old(board, monkeypatch):
    old = add(board, nonce="1")
    waiting = add(board, "TQC")
    tasks = {"PivotedBar-v10": module.TASKS[ENV]}
    monkeypatch.setattr(module, "TASKS", module.TASKS | tasks)
    assert closed(ENV, 1, 1) == "PivotedBar-v10 has taken its place"
    assert closed("PivotedBar-v10", 1, 1) == closed(pivoted_bar.SwingUpFree.id, 1, 1) == ""
    with pytest.raises(BoardError, match=f"board of {ENV} is frozen: PivotedBar-v10 has taken its place"):
        add(board, "SAC")
    board.publish("2")
    finish(board)
    assert states(board) == {old: "verified", waiting: "rejected"}
    board.withdraw(old, "this is still possible")


def test_the_board_of_an_environment_that_is_gone_is_still_shown(board, monkeypatch):
    id = add(board, nonce="1")
    other = add(board, env=pivoted_bar.SwingUpFree.id, nonce="2")
    before = board_data(board, "today")["environments"][0]
    tasks = {name: task for name, task in module.TASKS.items() if name != ENV}
    for place in (module, ranking, standings):
        monkeypatch.setattr(place, "TASKS", tasks)
    real = fake_submissions.about

    def about(files):
        if real(files).env == ENV:
            raise Refused("submission.toml: env must be one of ...")
        return real(files)

    monkeypatch.setattr(submission, "about", about)
    frozen = board_data(board, "today")["environments"][-1]
    assert frozen["frozen"] and frozen["rows"] == before["rows"] and frozen["rows"][0]["id"] == id
    assert board.open() == 2
    assert states(board) == {other: "pending"}


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
        with pytest.raises(BoardError, match=r"board.jsonl, line 3 is no event .* version control"):
            use()


def ids(board):
    lines = (json.loads(line) for line in board.log.read_bytes().splitlines()[:-1])
    return [line["id"] for line in lines if "id" in line]


def chained(*events):
    """Return a log of events, each with the hash of the log before it."""
    log = b""
    for event in events:
        event = event | {"prev": hashlib.sha256(log).hexdigest()}
        log += json.dumps(event).encode() + b"\n"
    return log


def rewritten(board, change):
    """Let a function change a board's events, and chain them again."""
    told = [json.loads(line) for line in board.log.read_bytes().splitlines()]
    change(told)
    board.log.write_bytes(chained(*({k: v for k, v in event.items() if k != "prev"} for event in told)))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda told: told.pop(1), "line 3: .* is verified, and was never added"),
        (lambda told: told.pop(0), "line 4: .*|does not tell"),
        (lambda told: told.pop(2), "line 3: .* nonce 'n', which is not its own"),
        (lambda told: told.insert(1, told.pop(2)), "line 3: .* is earlier than the line before it"),
        (lambda told: told.append(told[3]), "line 5: .* is verified, but was verified already"),
        (lambda told: told.append(told[1] | {"at": told[3]["at"]}), "line 5: .* is there already, verified"),
        (lambda told: told.append(told[2] | {"at": told[3]["at"]}), "line 5: the nonce 'n' was published"),
        (lambda told: told[3].update(nonce="other"), "line 4: .* which is not its own"),
        (lambda told: told[3].update(supersedes=[told[1]["id"]]), "line 4: .* not another result"),
        (lambda told: told[3].update(supersedes=["Gone"]), "line 4: .* not another result"),
        (lambda told: told[0].update(number=2), "line 1: protocol 2 begins where 1 would be the next"),
        (lambda told: told[1].update(protocol=2), "line 2: .* added under protocol 2, the current is 1"),
        (lambda told: told[3].update(event="rejected"), "line 4 is no event"),
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


def test_two_clones_that_both_added(board, tmp_path):
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
        with pytest.raises(BoardError, match=r"line \d+ is (no event|not what followed)"):
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
        ("at_once", "3", "5"),
        slow(("at_once", "8", "40")),
        ("finished_at_once", "3", "4"),
    ],
    ids=" ".join,
)
def test_processes(task, tmp_path):
    name, *numbers = task
    here = Path(__file__).parent
    command = [sys.executable, str(here / "board_processes.py"), name, str(tmp_path), *numbers]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr


# --- spreading ---


def outcome(folder):
    """A job that processes are given."""
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
    assert [found[name] for name in "ab"] == ["a", "b"]  # whatever happens to the others
    assert isinstance(found["refused"], Refused) and str(found["refused"]) == "no"
    if jobs > 1:
        assert type(found["dies"]).__name__ == "ProcessExpired"


@pytest.mark.slow
def test_verifying_on_ray_is_verifying_here(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.undo()  # the real ones
    kinds = {"kind": "controller", "license": "MIT", "authors": ["A"]}
    for name in ("full damping", "switching line"):
        policy = {"architecture": "controller", "name": name}
        submission.write(tmp_path / name, env=incline.Brake.id, name=name, policy=policy, **kinds)
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


# --- the page's data ---


def test_board_data(board):
    best = add(board, "best", nonce="1", score=0.9, kind="controller")
    add(board, nonce="2", score=0.5)
    rejected = add(board, "bad", nonce="3", reject="no")
    pending = add(board, "new")
    data = board_data(board, "2026-01-01")
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert (data["protocol"], data["made"]) == (1, "2026-01-01")
    assert [e["id"] for e in data["environments"]] == list(module.TASKS)
    found = data["environments"][0]
    assert found["known"]["best"] == known_returns(ENV).best and found["title"] and found["picture"]["shapes"]
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
    assert row["replays"][1]["score"] == pytest.approx(score(ENV, max(returns)), rel=1e-4)


def test_value_function(board):
    add(board)
    (board.folder / "values").mkdir()
    axis = {"label": "a", "low": 0.0, "high": 1.0, "n": 2}
    value = {"axes": [axis, axis | {"label": "b"}], "values": [[1.0, 2.0], [3.0, 4.0]]}
    file = board.folder / "values" / f"{ENV}.json"
    file.write_text(json.dumps(value))
    environments = board_data(board)["environments"]
    assert environments[0]["value"] == value and environments[1]["value"] is None


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        '{"axes": [], "values": []}',
        "[" * 100_000,
        '{"axes": NaN}',
        "\x00",
        '{"axes": 1, "axes": 2}',
    ],
)
def test_broken_value_functions(board, content):
    add(board)
    (board.folder / "values").mkdir()
    (board.folder / "values" / f"{ENV}.json").write_text(content)
    with pytest.raises(BoardError, match=rf"values/{ENV}.json cannot be read: .*; restore it"):
        board_data(board)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize("place", ["board.jsonl", "values/{env}.json", "results/{id}.json.gz"])
@pytest.mark.parametrize("what", ["pipe", "folder", "link", "device"])
def test_only_plain_files_are_opened(board, place, what):
    id = add(board, nonce="n")
    file = board.folder / place.format(env=ENV, id=id)
    file.parent.mkdir(exist_ok=True)
    if file.exists():
        file.rename(board.folder / "kept")
    else:
        (board.folder / "kept").write_text("{}")
    make = {"pipe": os.mkfifo, "folder": os.mkdir}
    target = "/dev/zero" if what == "device" else board.folder / "kept"
    make.get(what, lambda file: file.symlink_to(target))(file)
    uses = [partial(board_data, board)]
    if place == "board.jsonl":
        uses += [partial(board.withdraw, id, "x"), partial(add, board, "TQC"), partial(board.publish, "m")]
    for use in uses:
        with pytest.raises(
            BoardError, match=r"it is not a plain file.*restore it|cannot be read: Is a directory"
        ):
            use()


@pytest.mark.slow
def test_coarse_value_functions():
    from agents.board_values import coarse

    value = coarse("PivotedBar-v0", None)  # of the bar without a track
    theta, theta_dot = value["axes"]
    assert (theta["label"], theta_dot["label"], theta["low"]) == ("theta", "theta_dot", 0.0)
    assert len(value["values"]) == theta["n"] and {len(row) for row in value["values"]} == {theta_dot["n"]}
    best = max(range(theta["n"]), key=lambda i: value["values"][i][theta_dot["n"] // 2])
    assert best == theta["n"] // 2  # upright
    assert coarse(incline.Brake.id, None)["axes"][1]["label"] == "x_dot"


def test_an_empty_board(board):
    assert all(not e["rows"] and not e["other"] for e in board_data(board)["environments"])
    assert not board.folder.exists()
