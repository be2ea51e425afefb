"""The command ``lag-envs leaderboard``, the tables generated from the board, and CI's recipe."""

import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from importlib.machinery import SourceFileLoader
from pathlib import Path

import fake_submissions
import pytest
from fake_submissions import ENV, write

from lag_envs import cli
from lag_envs.evaluation.statistics import LEVEL, RESAMPLES
from lag_envs.leaderboard import alike, audit, docs, protocol
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.log import STATES
from lag_envs.leaderboard.standings import board_data
from lag_envs.tables import columns
from lag_envs.tasks import incline

ROOT = Path(__file__).parents[1]


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Give a function that runs the command in a separate folder and returns status and output."""
    fake_submissions.install(monkeypatch.setattr)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # another process would use the real functions
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        status = cli.main(["leaderboard", *map(str, arguments)])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call


def ids():
    return list(Board("leaderboard").read().entries)


# --- add, nonce, list, show, withdraw ---


def test_from_adding_to_the_ranking(run):
    write("a", "PPO", score=0.8)
    status, out, _ = run("add", "a")
    (id,) = ids()
    assert status == 0
    waits = f"{id}: pending, until a nonce is published: `lag-envs leaderboard nonce`\n"
    assert out == "leaderboard is a new board\n" + waits
    beacon = "https://api.drand.sh/public/1234"
    assert run("nonce", "drand-1234", "--source", beacon) == (0, f"nonce: drand-1234\n{id}: verified\n", "")
    assert run("add", "a")[1] == f"{id}: is already on the board, verified\n"
    status, out, _ = run("list")
    assert status == 0 and re.search(rf"1 +0\.\d{{4}} +0\.\d+ to 0\.\d+ +100\.0 % +learned +PPO +{id}", out)
    assert run("list", ENV)[1] == out
    status, out, _ = run("show", id)
    assert status == 0
    assert re.search(r"^state +verified$", out, re.MULTILINE) and re.search(r"nonce +drand-1234\n", out)
    told = json.loads(run("show", id, "--json")[1])
    assert told["rank"] == 1 and len(told["replays"]) == 3 and told["curves"]


def test_add_with_a_nonce(run):
    folders = [write(name, name) for name in ("a", "b")]
    status, out, _ = run("add", *folders, "--nonce", "test-1")
    verified = "".join(f"{id}: verified\n" for id in ids())
    assert status == 0 and out == "leaderboard is a new board\nnonce: test-1\n" + verified


def test_what_is_refused_is_told_and_costs_the_others_nothing(run):
    write("good")
    write("bad", refuse="policy_0.safetensors: holds NaN")
    status, out, err = run("add", "bad", "good", "none", "--nonce", "n")
    assert status == 1 and "verified" in out
    assert "bad: refused: policy_0.safetensors: holds NaN\n" in err and "none: refused: submission" in err
    assert len(ids()) == 1


def test_rejected_in_verification(run):
    write("bad", reject="it returned an action that is not a finite number")
    write("weak", name="weak", fail="no memory")
    status, out, _ = run("add", "bad", "weak", "--nonce", "n")
    assert status == 1  # for the one that stays pending
    assert "rejected: it returned an action that is not a finite number" in out
    assert "could not be verified (MemoryError: no memory); it stays pending" in out
    out = run("list")[1]
    assert re.search(r"ppo-\w+ rejected: it returned", out) and re.search(r"weak-\w+ pending\n", out)
    assert run("show", ids()[0])[0] == 0


def test_the_same_command_goes_on_after_a_kill(run):
    write("a")
    run("add", "a")
    Board("leaderboard").publish("n")  # and killed here
    assert run("add", "a", "--nonce", "n") == (0, f"{ids()[0]}: verified\n", "")
    assert run("add", "a", "--nonce", "n")[:2] == (0, f"{ids()[0]}: is already on the board, verified\n")


@pytest.mark.parametrize(
    ("action", "again"),
    [
        (("add", "a", "--nonce", "n"), "the same command"),
        (("nonce", "n"), "`lag-envs leaderboard add --board 'my board'`"),
    ],
)
def test_ctrl_c_tells_how_to_go_on(run, monkeypatch, action, again):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    write("a")
    run("add", "a", "--board", "my board")
    with monkeypatch.context() as patched:
        patched.setattr("lag_envs.leaderboard.cli.finish", interrupted)
        status, _, err = run(*action, "--board", "my board")
    assert status == 130 and err.endswith(f"interrupted; finished work is kept, and {again} resumes\n")
    assert run("add", "--board", "my board")[1].endswith(": verified\n")


def test_add_without_a_folder_goes_on(run):
    write("a")
    run("add", "a")
    Board("leaderboard").publish("n")  # and killed here
    assert run("add")[1] == f"{ids()[0]}: verified\n"
    assert run("add") == (0, "nothing is pending\n", "")


def test_withdraw(run):
    write("a")
    run("add", "a", "--nonce", "n")
    (id,) = ids()
    status, _, err = run("withdraw", id, "--reason", "wrong\x1b[2J numbers")
    assert status == 2 and "this cannot be logged: withdrawn.reason: it holds the invisible U+001B" in err
    status, _, err = run("withdraw", id, "--reason", " ")
    assert status == 2 and "give a reason" in err
    assert run("withdraw", id, "--reason", "wrong numbers")[0] == 0
    assert f"{id} withdrawn: wrong numbers" in run("list")[1]
    assert run("withdraw", id, "--reason", "x") == (2, "", f"lag-envs: error: {id} was withdrawn before\n")
    assert f"{id}: had been withdrawn and is on the board again, verified" in run("add", "a")[1]


@pytest.mark.parametrize("command", [["list"], ["add", "a"], ["build", "site"]])
def test_an_emptied_log_is_no_new_board(command, run):
    write("a")
    run("add", "a", "--nonce", "n")
    Path("leaderboard/board.jsonl").write_bytes(b"")
    status, _, err = run(*command)
    assert status == 2 and "board.jsonl is empty, though there are submissions; " in err
    assert err.count("is empty") == 1 and not Path("site").exists()


def test_mistakes(run):
    for arguments, status in ((["--help"], 0), (["add", "--jobs", "0"], 2), ([], 2)):
        with pytest.raises(SystemExit) as left:
            run(*arguments)
        assert left.value.code == status
    assert "there is no board in leaderboard. Give a board's folder with --board, or start" in run("list")[2]
    Path("torn").mkdir()
    Path("torn", "board.jsonl").write_text('{"event": "prot')
    status, _, err = run("list", "--board", "torn")
    assert status == 2 and "board.jsonl has only a torn line; restore it from version control" in err
    write("a")
    run("add", "a", "--nonce", "n")
    assert "nothing is pending" in run("nonce")[2]
    other = incline.Tilt.id
    assert f"there is no board named {other!r}; available: PivotedBar-v0" in run("list", other)[2]
    assert "there is no 'x' on the board" in run("show", "x")[2]
    assert "published before" in run("add", write("b", "b"), "--nonce", "n")[2]
    assert "there is no protocol 3; the current one is 1" in run("show", ids()[0], "--protocol", "3")[2]
    Path("leaderboard/board.jsonl").write_text("<<<<<<< HEAD\n")
    assert "line 1 is not an event" in run("list")[2]


@pytest.mark.parametrize(
    "action",
    ["add", "nonce", "list", "show x", "withdraw x --reason y", "audit", "pin p", "open", "build", "serve"],
)
def test_a_board_that_does_not_exist(run, action):
    status, out, err = run(*action.split(), "--board", "my typo")
    assert (status, out) == (2, "")
    assert "no board in my typo. Give a board's folder with --board, or start one with `lag-envs" in err
    assert "leaderboard add FOLDER --board 'my typo'`" in err
    Path("file").write_text("")
    assert "file is a file; a board is a folder" in run(*action.split(), "--board", "file")[2]
    assert os.listdir() == ["file"]


def test_a_new_board_is_told(run):
    assert "new is a new board\n" in run("add", write("good"), "--board", "new")[1]
    assert "new board" not in run("add", write("better"), "--board", "new")[1]
    assert run("add", write("bad", refuse="why"), "--board", "other")[1] == ""
    assert not Path("other").exists()


def test_columns_of_wide_names(run):
    write("a", "PPO")
    write("b", "王 2")
    run("add", "a", "b", "--nonce", "n")
    lines = [line for line in run("list")[1].splitlines() if "learned" in line]
    assert len({columns(line[: line.index("PivotedBar")]) for line in lines}) == 1


def test_missing_packages_are_named(run, monkeypatch):
    monkeypatch.setattr("lag_envs.commands.base.find_spec", lambda name: None if name == "safetensors" else 1)
    assert 'safetensors is missing: pip install "lag-envs[leaderboard]"' in run("list")[2]
    assert cli.main(["list"]) == 0  # others do not need it


def test_other_commands_do_not_load_the_leaderboard():
    script = "import sys; from lag_envs import cli; cli.main(['list'])\n"
    script += "assert not [m for m in sys.modules if m.startswith('lag_envs.leaderboard')]"
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


# --- build, serve ---


@pytest.mark.slow
def test_build(run):
    write("a", "An agent")
    run("add", "a", "--nonce", "n")
    Path("page/.git").mkdir(parents=True)  # as in a checkout
    status, out, _ = run("build", "page")
    assert status == 0 and out == f"{Path('page/index.html')}\n"
    assert any("An agent" in path.read_text(encoding="utf-8") for path in Path("page").glob("*.html"))
    Path("other").mkdir()
    Path("other/index.html").write_text("mine")
    Path("my.py").touch()
    assert "my.py is a file; name a folder for the page" in run("build", "my.py")[2]
    assert "--url: the page's address must begin with https://" in run("build", "--url", "ftp://a")[2]
    status, _, err = run("build", "other")
    assert status == 2 and "other holds other things, such as index.html; name a new or an empty" in err
    assert os.listdir("other") == ["index.html"] and Path("other/index.html").read_text() == "mine"


def test_what_does_not_exist_is_told_at_once(run):
    write("a", "An agent")
    run("add", "a", "--nonce", "n")
    for arguments, told in (
        (("serve", "--port", "99999999"), "--port must be a number from 0 to 65535, got 99999999"),
        (("audit", "--pin", "typo.json"), "--pin: there is no file typo.json"),
    ):
        status, _, err = run(*arguments)
        assert status == 2 and told in err


@pytest.mark.slow
def test_serve(run):
    write("a", "An agent")
    run("add", "a", "--nonce", "n")
    script = "import fake_submissions; from lag_envs import cli; fake_submissions.install()\n"
    script += "raise SystemExit(cli.main(['leaderboard', 'serve', '--port', '0']))"
    path = os.pathsep.join([str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    server = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    stop = threading.Timer(300, server.kill)
    stop.start()
    try:
        address = server.stdout.readline().split()[0]
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert "Leaderboard" in answer.read().decode()
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(f"{address}/../leaderboard/board.jsonl", timeout=30)
        refused.value.close()
        server.send_signal(signal.SIGINT)
        assert server.wait(30) == 130
    finally:
        stop.cancel()
        server.kill()
        server.wait()
        server.stdout.close()


# --- tables in README and docs ---


def test_generated_parts_are_as_generated():
    for path, text in docs.generated(ROOT).items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name}: `python -m lag_envs.leaderboard.docs` writes it again"
        )


def cells_of(table):
    """Return the cells of a table in Markdown, by rows."""
    lines = table.splitlines()
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_top_of_each_board(run):
    for number in range(4):
        write(f"{number}", f"agent {number}", score=0.2 * number)
    write("other", "x | <b>[y](z)</b>", env=incline.Tilt.id, kind="controller")
    run("add", *range(4), "other", "--nonce", "n")
    cells = cells_of(docs.top(board_data(Board("leaderboard"))))
    assert [[row[0], *(cell.partition(" 0.")[0] for cell in row[1:])] for row in cells[2:]] == [
        [ENV, "agent 3", "agent 3"],
        [incline.Tilt.id, r"x \| &lt;b&gt;\[y\]\(z\)&lt;/b&gt;", ""],
    ]
    assert {len(row) for row in cells} == {3}


def test_agents_over_all_boards(run):
    """An agent on both boards ranks above a better one on one board; the best learner is always shown."""
    for number in range(docs.BEST):
        write(f"c{number}", f"C{number}", score=0.9 + 0.01 * number, kind="controller")
    write("low", "Learner", score=0.4)
    write("both", "Both | *", score=0.6, kind="controller")
    write("again", "Both | *", score=0.7, env=incline.Tilt.id, kind="controller")
    run("add", *(f"c{number}" for number in range(docs.BEST)), "low", "both", "again", "--nonce", "n")
    data = board_data(Board("leaderboard"))
    found = {row["name"]: row for row in data["combined"]}
    assert found["Both | *"]["boards"] == 2 and found["Both | *"]["of"] == 2
    assert found["C4"]["score"] == pytest.approx(0.5 * 0.94, abs=0.01)
    assert found["C4"]["there"] == pytest.approx(0.94, abs=0.01)
    cells = cells_of(docs.together(data))
    assert [row[:2] for row in cells[2:]] == [
        ["1", r"Both \| \*"], ["2", "C4"], ["3", "C3"], ["4", "C2"], ["5", "C1"], ["7", "Learner"]
    ]  # fmt: skip
    assert [row[3] for row in cells[2:4]] == ["2 of 2", "1 of 2"]
    assert docs.together({"combined": []}) == "Nothing has been submitted yet."


def page():
    return (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8")


def test_the_page_states_the_protocols_numbers():
    text = " ".join(page().split())
    stated = [
        f"Each policy plays {protocol.EPISODES:,} episodes",
        f"The lowest score (IQM of {protocol.DISTURBED_EPISODES} episodes) over all changed conditions",
        f"Score (IQM) in {protocol.DISTURBED_EPISODES} episodes when acting",
        f"Percentile bootstrap, {100 * LEVEL:.0f} %, {RESAMPLES:,} samples",
        f"mean scores differ by at most {protocol.TOLERANCE:.0e}".replace("e-0", "e-"),
        f"no more than {protocol.APART:.0%} of the episodes".replace("%", " %"),
        f"each return of a planner may differ by {protocol.PLANNED:.0e}".replace("e-0", "e-"),
        f"Two policies play {alike.EPISODES} episodes",
        f"differ by less than {alike.ACTIONS:.0e} (root".replace("e-0", "e-"),
        f"of one learner that differ by less than {alike.TWINS:.0e}".replace("e-0", "e-"),
    ]
    assert alike.RETURNS == 0.1 and "a tenth of a standard error of the score" in text
    assert audit.SAMPLE == 4 and "four episodes of each policy" in text
    assert [phrase for phrase in stated if phrase not in text] == []
    assert protocol.LEARNED_POLICIES == 5 and "at least five training seeds" in text
    assert [state for state in STATES if f"| {state} |" not in text] == []


def test_the_recipe_of_the_docs_computes_a_rank(run, capsys):
    write("a", score=0.6)
    write("b", "b")
    run("add", "a", "b", "--nonce", "n")
    (recipe,) = re.findall(r"```python\n(.*?)```", page(), re.DOTALL)
    exec(recipe, dict(zip(("ID_ABOVE", "ID_BELOW"), ids(), strict=True)))
    assert capsys.readouterr().out.startswith("Chance(value=1.0, low=1.0, high=1.0)")


# --- CI's recipe ---


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Give CI's recipe, in a repository with a board, and a function that commits all changes there."""
    if shutil.which("git") is None:
        pytest.skip("needs git")
    loader = SourceFileLoader("submissions", str(ROOT / ".ci" / "submissions"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    recipe = importlib.util.module_from_spec(importlib.util.spec_from_loader("submissions", loader))
    loader.exec_module(recipe)
    home = tmp_path / "repository"
    (home / "leaderboard").mkdir(parents=True)
    (home / "leaderboard" / "board.jsonl").write_text("")
    for name in ("GIT_AUTHOR", "GIT_COMMITTER"):
        monkeypatch.setenv(f"{name}_NAME", "A")
        monkeypatch.setenv(f"{name}_EMAIL", "a@example.org")
    monkeypatch.chdir(home)
    recipe.git("init", "--quiet")

    def commit():
        recipe.git("add", "--all", "--force")
        recipe.git("-c", "commit.gpgsign=false", "commit", "--quiet", "--allow-empty", "-m", "change")
        return recipe.git("rev-parse", "HEAD").decode().strip()

    return recipe, commit


def test_recipe_takes_the_changed_submissions_as_data(repository, tmp_path):
    recipe, commit = repository
    write("leaderboard/inbox/before")
    base = commit()
    folder = write("leaderboard/inbox/mine", "PPO")
    Path("setup.py").write_text("raise SystemExit('never run')")
    change = commit()
    assert recipe.changed(base, change) == ["mine"]
    assert recipe.write(change, "mine", tmp_path / "out")
    for path in folder.iterdir():
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes()
    shutil.rmtree(folder)
    assert recipe.changed(change, commit()) == ["mine"]
    assert not recipe.write("HEAD", "mine", tmp_path / "gone")


def test_recipe_refuses_what_is_not_a_submission(repository, tmp_path):
    recipe, commit = repository
    base = commit()
    Path("leaderboard/board.jsonl").write_text("{}\n")
    with pytest.raises(SystemExit, match="only maintainers change the board"):
        recipe.changed(base, commit())
    kinds = {
        "link": lambda folder: (folder / "policy_1.safetensors").symlink_to("/etc/passwd"),
        "nested": lambda folder: write(folder / "deeper"),
        "program": lambda folder: os.chmod(folder / "submission.toml", 0o755),
    }
    for name, spoil in kinds.items():
        spoil(write(f"leaderboard/inbox/{name}"))
        with pytest.raises(SystemExit, match="a submission is a folder of plain files"):
            recipe.write(commit(), name, tmp_path / name)
        assert not (tmp_path / name).exists()
    with (write("leaderboard/inbox/large") / "more").open("wb") as out:
        out.truncate(recipe.BYTES)
    with pytest.raises(SystemExit, match="'large': more than"):
        recipe.write(commit(), "large", tmp_path / "large")


def test_recipe_verifies_with_the_code_that_it_stands_in(repository, monkeypatch):
    recipe, commit = repository
    base = commit()
    write("leaderboard/inbox/mine")
    change = commit()
    seen = []
    real = subprocess.run

    def run(command, **options):
        if command[0] == "git":
            return real(command, **options)
        seen.append((command, json.loads((Path(command[-1]) / "submission.toml").read_text())["name"]))
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(recipe.subprocess, "run", run)
    monkeypatch.setattr(sys, "argv", ["submissions", base, change])
    assert recipe.main() == 1
    ((command, name),) = seen
    assert command[:-1] == [sys.executable, "-P", "-m", "lag_envs.cli", "verify", "--nonce", change]
    assert name == "PPO"
