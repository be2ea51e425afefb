"""The board: states of submissions, who is ranked, and the page's data."""

import json
import os
import re
from functools import partial

import fake_submissions
import pytest
from boards import add, events, fake_board, states  # noqa: F401
from fake_submissions import ENV, write

from lag_envs.leaderboard import board as module
from lag_envs.leaderboard import submission
from lag_envs.leaderboard.board import BoardError, id_of
from lag_envs.leaderboard.parallel import map_submissions
from lag_envs.leaderboard.pending import finish
from lag_envs.leaderboard.protocol import first_seed
from lag_envs.leaderboard.standings import board_data
from lag_envs.leaderboard.submission import Refused
from lag_envs.leaderboard.verify import verify_folder
from lag_envs.scores import known_returns, score
from lag_envs.tasks import incline, pivoted_bar

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
def test_bad_nonces_are_refused(board, nonce):
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


def test_an_id_that_other_files_have_is_refused(board, monkeypatch):
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
        board.withdraw("nobody", "x")
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


def test_a_missing_result_is_noticed(board):
    id = add(board, nonce="n")
    (board.folder / "results" / f"{id}.json.gz").unlink()
    with pytest.raises(BoardError, match="is missing; restore it"):
        board_data(board)


def test_files_that_change_while_they_are_copied(board):
    folder = write(board.folder.parent / "changing")
    submission = fake_submissions.load(folder)
    (folder / "policy_0.safetensors").write_bytes(b"others")
    with pytest.raises(BoardError, match="changed while it was read"):
        board.add(submission)
    assert states(board) == {}
    board.add(fake_submissions.load(folder))
    assert not (board.folder / "submissions" / ".new").exists()


@pytest.mark.parametrize("verified", [True, False])
def test_a_submission_that_comes_back_keeps_its_first_nonce(board, verified):
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


def test_a_submission_that_comes_back_does_not_displace_later_ones(board):
    old = add(board, nonce="1", score=0.9)
    board.withdraw(old, "a better one is coming")
    new = add(board, nonce="2", score=0.1)
    board.add(fake_submissions.load(board.submission(old)))
    assert states(board) == {old: "superseded", new: "verified"}
    assert board.read().entry(old).reason == f"by {new}"


def shown(board):
    rows = board_data(board)["environments"][0]["rows"]
    return {row["name"]: (row["rank"], row["alike"] and row["alike"]["name"]) for row in rows}


# --- those that act alike ---


def test_a_submission_that_acts_like_an_earlier_one_has_no_rank(board):
    add(board, nonce="1", acts="x", score=0.5)
    add(board, "other", nonce="2", score=0.3)
    add(board, "clone", nonce="3", authors=["B"], acts="x", score=0.7)
    add(board, "clone of the clone", nonce="4", authors=["C"], acts="x", score=0.6)
    assert shown(board) == {
        "clone": (None, "PPO"), "clone of the clone": (None, "PPO"), "PPO": (1, None), "other": (2, None),
    }  # fmt: skip


def test_the_first_is_the_first_added_not_the_first_verified(board, monkeypatch):
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


def test_submitting_the_same_again_brings_no_better_luck(board):
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


def outcome(folder):
    """A job that processes are given."""
    if folder.name == "dies":
        os._exit(3)
    if folder.name == "refused":
        raise Refused("no")
    return (folder / "submission.toml").read_text()


# --- spreading ---


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 2])
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
def test_verifying_on_ray_is_verifying_here(tmp_path):
    pytest.importorskip("ray")
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
    assert found["known"]["best"] == known_returns(ENV).best and "upright" in found["goal"]
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
