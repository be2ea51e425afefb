"""Forgeries by the board's keeper, with an editor: each is found, and named with its line and a remedy."""

import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import fake_submissions
import pytest
from boards import chained, lines
from covering import every, slow
from fake_submissions import ENV, write

from lag_envs import cli
from lag_envs.leaderboard import audit, checks, history, log, protocol
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.log import BoardError
from lag_envs.leaderboard.pending import finish
from lag_envs.leaderboard.standings import board_data
from lag_envs.tasks import incline

ROOT = Path(__file__).parents[1]
needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")


def git(folder, *arguments):
    env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    for who in ("AUTHOR", "COMMITTER"):
        env |= {f"GIT_{who}_NAME": "A", f"GIT_{who}_EMAIL": "a@example.org"}
    command = ["git", "-C", str(folder), "-c", "commit.gpgsign=false", *arguments]
    return subprocess.run(command, check=True, capture_output=True, env=env).stdout.decode().strip()


def commit(board, message="change"):
    git(board.folder.parent, "add", "--all")
    git(board.folder.parent, "commit", "--quiet", "--allow-empty", "-m", message)
    return git(board.folder.parent, "rev-parse", "HEAD")


def fill(board):
    """Run a board through two protocols: a withdrawn, a cloned submission and another."""
    source = board.folder.parent / "sources"

    def add(name, **told):
        return board.add(fake_submissions.load(write(source / f"{name}-{len(told)}", name, **told))).id

    def settle():
        board.publish(commit(board), "commit")
        assert finish(board) == 0

    add("PPO", score=0.8, acts="x")
    gone = add("SAC", score=0.7)
    settle()
    board.open()
    add("clone", score=0.81, acts="x", authors=["B"])
    settle()
    board.withdraw(gone, "no more")
    commit(board)


@pytest.fixture
def fakes(monkeypatch):
    fake_submissions.install(monkeypatch.setattr)
    # This package's release knows another board.
    monkeypatch.setattr(history, "PIN", Path("nowhere") / "pin.json")
    monkeypatch.setattr(audit, "REFERENCE_EPISODES", 64)


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A board in a repository, as it should be."""
    folder = tmp_path_factory.mktemp("repository")
    git(folder, "init", "--quiet")
    board = Board(folder / "board")
    with pytest.MonkeyPatch.context() as patch:
        fake_submissions.install(patch.setattr)
        fill(board)
    return board


@pytest.fixture
def board(filled, tmp_path, fakes):
    shutil.copytree(filled.folder.parent, tmp_path / "repository")
    return Board(tmp_path / "repository" / "board")


def wrong(board, **options):
    """Return an audit's findings, by the name of the check."""
    found = []
    fine = audit.audit(board, tell=found.append, **options)
    texts = {finding.name: finding.wrong for finding in found if finding.wrong}
    assert fine == (not texts)
    return texts


def refused(board):
    """Return why a board is not shown; empty if it is."""
    try:
        board_data(board)
    except BoardError as error:
        return str(error)
    return ""


# --- forging ------------------------------------------------------------------------------------------------


def relog(board, told, chain=True):
    """Write events as the log, with a new chain, as a careful forger would."""
    by_hand = (json.dumps(event, ensure_ascii=False).encode() + b"\n" for event in told)
    board.log.write_bytes(chained(*told) if chain else b"".join(by_hand))


def at(told, event, number=-1):
    """Return one of the events of a kind."""
    return [e for e in told if e["event"] == event][number]


def entry_of(board, name="PPO"):
    return next(e for e in board.read().entries.values() if e.name == name)


def edit(board, change, entry=None):
    """Change a result; return the log's events with its new hash."""
    entry = entry or entry_of(board)
    path = board.result_file(entry)
    result = json.loads(gzip.decompress(path.read_bytes()))
    change(result)
    path.write_bytes(gzip.compress(json.dumps(result).encode(), mtime=0))
    told = lines(board)
    event = next(e for e in told if e.get("sha256") == entry.sha256)
    event["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    return told


def better(result):
    for policy in result["policies"]:
        policy["returns"] = [23.5 * 419.0 for _ in policy["returns"]]


def consistent(result):
    """Make the recorded episodes consistent with the returns."""
    better(result)
    for replay in result["replays"]:
        replay["return"] = 23.5 * 419.0
        # Episodes with equal returns keep their order.
        number = {"median": 9, "best": 19, "worst": 0}[replay["label"]]
        first = protocol.first_seed(result["digest"], result["nonce"], 2)
        replay["reset_seed"], replay["seed"] = first + number, 2


def test_a_board_as_it_should_be(board):
    assert refused(board) == "" and wrong(board) == {}
    rows = {row["name"]: row for row in board_data(board)["environments"][0]["rows"]}
    assert rows["clone"]["alike"]["name"] == "PPO"


@pytest.mark.slow
def test_everything_is_played_again(board):
    assert wrong(board, everything=True) == {}
    relog(board, edit(board, consistent))
    shutil.rmtree(board.folder.parent / ".git")
    assert any("differs in mean returns" in text for text in wrong(board, everything=True)["scores"])


def test_a_result_is_edited(board):
    edit(board, better)
    assert "line 10: " in refused(board) and "is not the file that was verified; restore it" in refused(board)
    assert "results" in wrong(board)


def test_a_result_and_its_hash_are_edited(board):
    relog(board, edit(board, better), chain=False)
    assert re.search(r"line \d+ is not what it was in commit \w+", refused(board))
    assert "line 11 does not follow" in wrong(board)["log"][0]
    told = lines(board)
    relog(board, told)  # and the chain is made again
    assert "line 10 is not what it was in commit" in refused(board)
    shutil.rmtree(board.folder.parent / ".git")  # and the history is gone
    assert "has recorded other episodes than" in refused(board)


def test_a_result_is_edited_so_that_it_agrees_with_itself(board):
    """Then only playing it again reveals it."""
    relog(board, edit(board, consistent))
    shutil.rmtree(board.folder.parent / ".git")
    assert refused(board) == ""
    (text, *_) = wrong(board)["scores"]
    assert "line 10: " in text and "other returns than episodes" in text and "verify" in text


@pytest.mark.parametrize(
    ("change", "check"),
    [
        slow(lambda result: result["robustness"].update({"mass +20 %": [1e3] * 5}), "all"),
        slow(lambda result: result.update(often=[1e3] * 5), "all"),
        (lambda result: result["policies"][0].update(success=[False] * 20), "sample"),
        (lambda result: result["policies"][0].update(settle=[0.1] * 20), "sample"),
        (lambda result: result["policies"][0].update(effort=[0.0] * 20), "sample"),
        (lambda result: result["replays"][1].update(states=[[9.0] * 4] * 3), "sample"),
        (lambda result: result["replays"].pop(), "cheap"),
        (lambda result: result["replays"][0].update(reset_seed=1), "cheap"),
        (lambda result: result["claimed"].update(env_steps=1.0), "cheap"),
        (lambda result: result["claimed"].update(license="X"), "cheap"),
        (lambda result: result["policies"].pop(), "cheap"),
        (lambda result: result["policies"][0].update(seed=77), "cheap"),
        (lambda result: result.update(digest="0" * 64), "cheap"),
        (lambda result: result.update(nonce="mine"), "cheap"),
        (lambda result: result.update(episodes=21), "cheap"),
        (lambda result: result.update(more=1), "cheap"),
    ],
)  # fmt: skip
def test_part_of_a_result_is_edited(board, change, check, monkeypatch):
    monkeypatch.setattr(audit, "code_digest", lambda: "0" * 64)
    relog(board, edit(board, change))
    shutil.rmtree(board.folder.parent / ".git")
    assert bool(refused(board)) == (check == "cheap")
    if check == "cheap":
        assert "line 10: " in refused(board) and ("restore it" in refused(board) or "again" in refused(board))
    found = wrong(board, everything=check == "all")
    assert [name for name in found if name not in ("nonces",)] == [
        "results" if check == "cheap" else "scores"
    ]


LOG = {
    "a name": lambda told: at(told, "added", 0).update(name="My agent"),
    "an author": lambda told: at(told, "added", 0).update(authors=["Somebody else"]),
    "a kind": lambda told: at(told, "added", 0).update(kind="optimal"),
    "a kind becomes markup": lambda told: at(told, "added", 0).update(kind="<b>learned</b>"),
    "a digest": lambda told: at(told, "added", 0).update(digest="0" * 64),
    "an id": lambda told: at(told, "added", 0).update(id="PivotedBar-v0-other-00000000"),
    "a nonce": lambda told: at(told, "nonce").update(value="mine"),
    "a nonce is deleted": lambda told: told.remove(at(told, "nonce")),
    "all nonces are deleted": lambda told: [told.remove(e) for e in list(told) if e["event"] == "nonce"],
    "a source": lambda told: at(told, "nonce").update(source=""),
    "a time": lambda told: at(told, "added", 0).update(at="2020-01-01T00:00:00.000000+00:00"),
    "the scale": lambda told: at(told, "protocol")["scales"][ENV].update(best=100.0),
    "the scale becomes a point": lambda told: at(told, "protocol")["scales"][ENV].update(best=-0.72),
    "the scale becomes huge": lambda told: at(told, "protocol")["scales"][ENV].update(best=1e300),
    "a reference": lambda told: at(told, "protocol")["references"][incline.Tilt.id].update(mean=1.0),
    "the rules": lambda told: at(told, "protocol")["rules"].update(episodes=3),
    "a likeness": lambda told: at(told, "verified").update(alike=[]),
    "a withdrawal is deleted": lambda told: told.pop(),
    "a withdrawal": lambda told: told[-1].update(reason="it was too good"),
    "a verification is deleted": lambda told: told.remove(at(told, "verified")),
    "a submission is deleted": lambda told: told.remove(at(told, "added", 0)),
    "a protocol is deleted": lambda told: told.remove(at(told, "protocol", 1)),
    "lines change places": lambda told: told.insert(1, told.pop(2)),
    "an event is put in": lambda told: told.insert(-1, told[-1] | {"id": at(told, "added")["id"]}),
    "the end is cut off": lambda told: told.__delitem__(slice(6, None)),
    "everything is gone": lambda told: told.clear(),
}  # fmt: skip


@needs_git
@pytest.mark.parametrize("how", every(5, LOG))
@pytest.mark.parametrize("chain", [False, True], ids=["by hand", "with the chain rebuilt"])
def test_the_log_is_edited(board, how, chain):
    before = board.log.read_bytes()
    told = lines(board)
    LOG[how](told)
    relog(board, told, chain)
    if not chain:  # as after an edit: other lines keep their bytes
        kept = {json.dumps(json.loads(line)): line for line in before.splitlines()}
        board.log.write_bytes(b"".join(kept.get(json.dumps(e), json.dumps(e).encode()) + b"\n" for e in told))
    reason = refused(board)
    assert "board.jsonl, line" in reason and "restore" in reason
    commit(board)  # and it is committed
    assert "board.jsonl, line" in refused(board)
    assert wrong(board)


@pytest.mark.parametrize("how", ["deleted", "overwritten", "added to", "a link", "another's"])
def test_a_submission_is_changed_after_verification(board, how):
    entry = entry_of(board)
    folder = board.submission(entry.id)
    if how == "deleted":
        shutil.rmtree(folder)
    elif how == "overwritten":
        (folder / "policy_0.safetensors").write_bytes(b"better numbers")
    elif how == "added to":
        (folder / "policy_9.safetensors").write_bytes(b"")
    elif how == "a link":
        shutil.move(folder, folder.parent / "elsewhere")
        folder.symlink_to(folder.parent / "elsewhere")
    else:
        shutil.rmtree(folder)
        shutil.copytree(board.submission(entry_of(board, "clone").id), folder)
    if how != "a link":  # the real `load` refuses it, see tests/test_hostile_submissions.py
        assert f"line {entry.line}: {folder} is not what was added" in refused(board)
        assert "submissions" in wrong(board)


def test_name_and_files_and_digest_are_edited(board):
    """All cheap checks pass again, but the episodes are different ones."""
    entry = entry_of(board)
    folder, told = board.submission(entry.id), lines(board)
    toml = folder / "submission.toml"
    toml.write_text(toml.read_text().replace("A. Author", "B. Author"))
    digest = fake_submissions.load(folder).digest
    for event in told:
        if event.get("digest") == entry.digest:
            event.update(digest=digest, authors=["B. Author"])
    relog(board, told)
    shutil.rmtree(board.folder.parent / ".git")
    assert "is of digest" in refused(board)
    first_seed = protocol.first_seed

    def moved(result):
        result["digest"] = digest
        for replay in result["replays"]:
            given = result["nonce"], replay["seed"]
            replay["reset_seed"] += first_seed(digest, *given) - first_seed(entry.digest, *given)

    for number in (1, 2):
        relog(board, edit(board, moved, board.read().boards[number][entry.id]))
    assert refused(board) == ""
    assert "other returns than episodes" in wrong(board)["scores"][0]


# --- nonces -------------------------------------------------------------------------------------------------


@needs_git
def test_a_nonce_that_was_known_before_the_submission(board):
    """Something is added and verified with the hash of a commit that was already there."""
    value = commit(board)
    board.add(fake_submissions.load(write(board.folder.parent / "late", "late")))
    board.publish(value, "commit")
    finish(board)
    commit(board)
    assert refused(board) == ""
    assert wrong(board) == {"nonces": [text for text in wrong(board)["nonces"] if "it was known" in text]}


@needs_git
def test_a_nonce_of_a_missing_commit(board):
    board.publish("ab" * 20, "commit")
    commit(board)
    assert "is not a commit in the history" in wrong(board)["nonces"][0]


@needs_git
def test_a_nonce_of_another_branch(board):
    folder = board.folder.parent
    git(folder, "checkout", "--quiet", "-b", "other")
    value = commit(board)
    git(folder, "checkout", "--quiet", "-")
    board.publish(value, "commit")
    commit(board)
    assert "is not a commit in the history" in wrong(board)["nonces"][0]


def test_a_process_that_dies_is_told(board, monkeypatch):
    def shared(work, function, jobs):
        assert jobs == 2
        return ((key, RuntimeError("gone")) for key, _ in work)

    monkeypatch.setattr(audit, "shared", shared)
    assert (
        "has policies that cannot be played: RuntimeError: gone; verify" in wrong(board, jobs=2)["scores"][0]
    )


def test_a_nonce_without_a_public_source(board):
    board.publish("chosen-by-me")
    assert "names no public source" in wrong(board)["nonces"][0]


def test_a_nonce_of_a_beacon_is_to_be_looked_up(board):
    board.publish("0123", "https://api.drand.sh/public/1000")
    found = []
    assert audit.audit(board, tell=found.append)
    (told,) = (finding.told for finding in found if finding.name == "nonces")
    assert re.search(r"their sources: line \d+: 0123 by https://api\.drand\.sh/public/1000$", told)


@needs_git
def test_the_commit_that_is_the_nonce_must_hold_the_board(board):
    head = commit(board)
    assert history.head_of(board) == head
    board.add(fake_submissions.load(write(board.folder.parent / "new", "new")))
    with pytest.raises(BoardError, match="has changed since the last commit; commit and push first"):
        history.head_of(board)


# --- history, and the pin -----------------------------------------------------------------------------------


@needs_git
def test_history_before_a_tag_is_checked_too(board):
    folder = board.folder.parent
    git(folder, "tag", "v1")
    git(folder, "checkout", "--quiet", "--orphan", "clean")  # a rewritten history
    told = lines(board)
    at(told, "protocol")["scales"][ENV].update(best=100.0)
    relog(board, told)
    commit(board)
    assert "line 7 is not what it was in commit" in refused(board)
    git(folder, "tag", "--delete", "v1")
    assert refused(board) == ""  # a history that was rewritten as a whole


@needs_git
def test_an_older_checkout_is_no_forgery(board):
    folder = board.folder.parent
    git(folder, "tag", "later")
    git(folder, "checkout", "--quiet", "HEAD~1")
    assert refused(board) == "" and wrong(board) == {}


@needs_git
def test_boards_that_were_started_over_before_logs_had_a_chain(board):
    """As in the repository itself: that does not help anybody who begins again later."""
    folder = board.folder.parent
    shutil.rmtree(folder / ".git")
    git(folder, "init", "--quiet")
    whole = board.log.read_bytes()
    board.log.write_text('{"at": "2020-01-01T00:00:00.000000+00:00", "event": "nonce", "value": "x"}\n')
    commit(board)
    board.log.write_bytes(whole)
    commit(board)
    found = checks.cheap(board)
    assert "1 belong to boards that were started over" in found.findings[2].told and not refused(board)


def test_without_a_repository(board):
    shutil.rmtree(board.folder.parent / ".git")
    found = []
    assert audit.audit(board, tell=found.append) and refused(board) == ""
    opened = {finding.name: finding.open for finding in found if finding.open}
    assert set(opened) == {"pin", "history", "nonces"} and "not a git repository" in opened["history"]


def test_the_pin_of_a_release(board, tmp_path, monkeypatch):
    pin = tmp_path / "pin.json"
    checks.write_pin(board, pin)
    shutil.rmtree(board.folder.parent / ".git")
    monkeypatch.setattr(history, "PIN", pin)
    assert refused(board) == ""
    board.publish("goes-on", "https://example.org")  # a board grows beyond its pin
    assert refused(board) == "" and wrong(board) == {}
    whole = lines(board)
    for change, reason in (
        (lambda told: told[-2].update(reason="other"), "one of the first 13 lines was changed"),
        (lambda told: told.__delitem__(slice(-2, None)), "some were removed"),
        (
            lambda told: at(told, "protocol")["scales"][ENV].update(best=100.0),
            "one of the first 13 lines was changed",
        ),
    ):
        told = json.loads(json.dumps(whole))
        change(told)
        relog(board, told)
        assert reason in refused(board) and "pin" in wrong(board)
    # It says nothing of another board, unless asked to.
    other = Board(tmp_path / "other")
    other.add(fake_submissions.load(write(tmp_path / "another", "another")))
    assert refused(other) == "" and "pin" in wrong(other, pin=pin)
    before = pin.read_bytes()
    with pytest.raises(BoardError, match=r"pin.json stays as it is: this is not the board .* another FILE"):
        checks.write_pin(other)
    assert pin.read_bytes() == before
    assert "pin" in wrong(other, pin=tmp_path / "nowhere")


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"board": 1}', "[" * 10**5])
def test_a_bad_pin_is_refused(board, tmp_path, monkeypatch, content):
    monkeypatch.setattr(history, "PIN", tmp_path / "pin.json")
    history.PIN.write_text(content)
    assert "is not a pin" in refused(board)


# --- the commands -------------------------------------------------------------------------------------------


def run(capsys, *arguments):
    status = cli.main(["leaderboard", *map(str, arguments)])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@needs_git
def test_commands(board, tmp_path, capsys):
    status, out, _ = run(capsys, "audit", "--board", board.folder)
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()] == [
        "log", "pin", "history", "submissions", "results", "nonces", "scores",
    ]  # fmt: skip
    assert f"head {hashlib.sha256(board.log.read_bytes()).hexdigest()}" in out
    pin = tmp_path / "pin.json"
    assert run(capsys, "pin", pin, "--board", board.folder)[0] == 0
    assert run(capsys, "audit", "--pin", pin, "--board", board.folder)[0] == 0
    board.add(fake_submissions.load(write(tmp_path / "new", "new")))
    assert "has changed since the last commit" in run(capsys, "nonce", "--board", board.folder)[2]
    head = commit(board)
    status, out, _ = run(capsys, "nonce", "--board", board.folder)
    assert status == 0 and out.startswith(f"nonce: {head}\n")
    assert lines(board)[-2]["source"] == "commit"
    assert run(capsys, "open", "--board", board.folder)[1].startswith(
        "protocol 3; submissions to verify under it: 3"
    )
    commit(board)
    id, told = entry_of(board).id, lines(board)
    at(told, "added", 0).update(name="x")
    relog(board, told)
    status, out, _ = run(capsys, "audit", "--board", board.folder)
    assert status == 1 and "WRONG" in out and "board.jsonl, line" in out
    for action in (
        ["list"],
        ["build", tmp_path / "site"],
        ["serve", "--port", "0"],
        ["show", id],
    ):
        status, out, err = run(capsys, *action, "--board", board.folder)
        assert (status, out) == (2, "") and "board.jsonl, line" in err and "more: `lag-envs" in err
    assert not (tmp_path / "site").exists()


# --- the repository's own board -----------------------------------------------------------------------------


@pytest.mark.slow  # `make audit` covers it too, and `make check` runs both
def test_the_repositorys_board_is_sound():
    """The other checks of `make audit` take longer."""
    found = checks.cheap(Board(ROOT / "leaderboard"))
    assert [text for finding in found.findings for text in finding.wrong] == []
    assert found.state.number in found.state.protocols
    links = [line.event.prev for line in found.lines]
    assert all(links[links.index(next(filter(None, links))) :])
    nonces = audit._nonces(Board(ROOT / "leaderboard"), found)
    assert nonces.wrong == [] or nonces.open


def test_a_log_without_a_chain_is_of_protocol_1_at_most():
    told = {"at": "2026-01-01T00:00:00.000000+00:00", "event": "nonce", "value": "n"}
    linked = told | {"prev": hashlib.sha256(json.dumps(told).encode() + b"\n").hexdigest(), "value": "m"}
    content = b"".join(json.dumps(e).encode() + b"\n" for e in (told, linked))
    assert len(log.parse(content)[0]) == 2
    with pytest.raises(BoardError, match="line 3 holds no hash of the lines before it"):
        log.parse(content + json.dumps(told | {"value": "o"}).encode() + b"\n")
