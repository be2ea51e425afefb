"""Protocols: what a new one verifies again, and which boards it freezes."""

import json

import fake_submissions
import pytest
from boards import add, events, fake_board, states  # noqa: F401
from fake_submissions import ENV

from lag_envs import scores
from lag_envs.leaderboard import board as module
from lag_envs.leaderboard import protocol, ranking, standings, submission
from lag_envs.leaderboard.board import BoardError, closed
from lag_envs.leaderboard.log import LogLine, fold, parse
from lag_envs.leaderboard.pending import finish
from lag_envs.leaderboard.standings import board_data
from lag_envs.leaderboard.submission import Refused
from lag_envs.scores import known_returns
from lag_envs.tasks import pivoted_bar


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


def without(patch, env_id):
    """Leave an environment out of the package."""
    tasks = {name: task for name, task in module.TASKS.items() if name != env_id}
    for place in (module, protocol, ranking, standings):
        patch.setattr(place, "TASKS", tasks)


def test_boards_of_new_environments_join_the_protocol(board, monkeypatch):
    new = pivoted_bar.SwingUpFree.id
    with monkeypatch.context() as before:
        without(before, new)
        old = add(board, nonce="1")
    with pytest.raises(BoardError, match=f"{new} has no board yet; `lag-envs leaderboard open` opens one"):
        add(board, env=new)
    with monkeypatch.context() as unmeasured:
        unmeasured.setattr(scores, "known_returns", lambda id: None if id == new else known_returns(id))
        with pytest.raises(BoardError, match=f"{new}: no scale has been measured.*agents.scale"):
            board.open()
    later = add(board, "TQC", nonce="1b")  # the other boards go on
    shown = board_data(board, "today")["environments"][0]
    assert board.open() == 1 and events(board)[-1] == "opened"
    joined = board.read().protocols[1]
    assert set(joined.scales) == set(protocol.boards()) and joined.rules.model_dump() == protocol.rules()
    assert joined.references.keys() == {id for id in protocol.boards() if protocol.reference(id)}
    assert states(board) == {old: "verified", later: "verified"}  # nothing is verified again
    assert board_data(board, "today")["environments"][0] == shown
    other = add(board, env=new, nonce="2")
    assert states(board) == {old: "verified", later: "verified", other: "verified"}
    told = next(line for line in parse(board.log.read_bytes())[0] if line.event.event == "opened")
    again = [
        *parse(board.log.read_bytes())[0],
        LogLine(99, told.event.model_copy(update={"at": board.read().last})),
    ]
    with pytest.raises(BoardError, match=f"{new} joins protocol 1, but already has a board there"):
        fold(again)
    assert board.open() == 2  # now that all are there


def test_boards_join_no_protocol_of_other_rules(board, monkeypatch):
    with monkeypatch.context() as before:
        without(before, pivoted_bar.SwingUpFree.id)
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
    with pytest.raises(BoardError, match="add to a board of protocol 1, whose learned_policies differ"):
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
    with pytest.raises(BoardError, match="does not state the scale of protocol 1"):
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
    without(monkeypatch, ENV)
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
