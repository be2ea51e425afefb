"""Learners side by side: what fails costs only itself, files of others are left alone, progress is shown."""

import errno
import json
import os
import signal
import sys
from pathlib import Path

import pytest
from rich.console import Console
from trainings import here

from agents import race, run, train, tune
from agents.run import UserError
from lag_envs.tasks import cart_pole, incline

ENV = incline.Brake.id
FOUND = {
    "score": 0.95, "seconds": 3.0, "processor_seconds": 2.0, "machine": "M, 2 cores", "versions": {},
    "curve": [[0, 0.0, 0.0, 0.0], [500, 1.0, 1.0, 0.5], [1000, 3.0, 2.0, 0.95]],
}  # fmt: skip


def by_seed(settings, folder):
    """Take the place of a training: seeds 0 and 1 fail."""
    if settings["seed"] == 0:
        raise UserError("no such luck")
    if settings["seed"] == 1:
        raise OSError(errno.ENOSPC, "No space left on device")
    train.tell({"trained": 250, "seconds": 0.5, "curve": FOUND["curve"][:1]})
    return FOUND | {"tests_seconds": 0.0}


def dies(settings, folder):
    """Report progress, leave a file, and die."""
    (folder / "model.zip").write_text(str(folder))
    train.tell({"trained": 250, "seconds": 0.5, "curve": [[str(folder), 0.0, 0.0, 0.0]]})
    train._events.close()
    train._events.join_thread()
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Return a function that races without training; it returns the status and what was printed."""
    monkeypatch.setattr(race, "train_seed", by_seed)
    monkeypatch.setattr(race.workers, "processes", here)

    def command(*arguments):
        status = race.main([ENV, "--learners", "fast_ppo", *arguments])
        return status, "".join(capsys.readouterr())

    return command


def test_a_training_that_fails_costs_only_itself(command, tmp_path):
    file = tmp_path / "race.jsonl"
    status, output = command("--seeds", "3", "--output", str(file))
    assert status == 1
    assert "seed 0: failed: no such luck\n" in output and "seed 1: failed: OSError: [Errno 28] No" in output
    assert "seed 2: 0.9 in 3.0 s, 0.97 never" in output and "s; evaluation at the end: 0.950\n" in output
    assert "fast PPO  0.9         1 of 1   1,000" in output
    (row,) = map(json.loads, file.read_text().splitlines())
    assert row["seed"] == 2 and row["machine"] == FOUND["machine"] and FOUND.items() <= row.items()
    # The one that worked is not trained again.
    assert command("--first-seed", "2", "--seeds", "1", "--output", str(file))[0] == 0
    assert len(file.read_text().splitlines()) == 1
    # Where nothing worked, nothing can be drawn.
    status, output = command("--seeds", "2", "--picture", str(tmp_path / "race.png"))
    assert status == 1 and "level" not in output and not (tmp_path / "race.png").exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_process_that_dies_leaves_nothing_behind(monkeypatch):
    monkeypatch.setattr(race, "train_seed", dies)
    shown = []
    row = race.raced({"seed": 5}, shown.append)
    assert row["failed"] == "the process died, exit status -9" and row["seed"] == 5
    assert shown[0]["curve"] == [] and row["trained"] == 250
    ((folder, *_),) = row["curve"]
    assert not Path(folder).exists()


def test_an_interrupted_race_shows_what_it_has(command, tmp_path, monkeypatch):
    def train(settings, folder):
        if settings["seed"] == 3:
            raise KeyboardInterrupt
        return by_seed(settings, folder)

    monkeypatch.setattr(race, "train_seed", train)
    given = ["--first-seed", "2", "--seeds", "2"]
    status, output = command(*given, "--output", str(tmp_path / "race.jsonl"))
    assert status == 130 and "fast PPO  0.9         1 of 1" in output and "Traceback" not in output
    assert "Stopped. What was finished is kept; re-run" in output
    assert "kept" not in command(*given)[1]


def test_a_full_disk_costs_no_table(command, tmp_path, monkeypatch):
    def full(path, *_):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    file, picture = tmp_path / "race.jsonl", tmp_path / "race.png"
    for name, given in (("append", ["--output", str(file)]), ("write_file", ["--picture", str(picture)])):
        with monkeypatch.context() as patch:
            patch.setattr(race.store, name, full)
            status, output = command("--first-seed", "2", "--seeds", "1", *given)
        assert status == 1 and "agents.race: error:" in output and given[1] in output
        assert not picture.exists() and not file.exists()
    assert "fast PPO  0.9         1 of 1" in output


def test_a_disk_without_room_is_named_before_the_work(tmp_path):
    resource = pytest.importorskip("resource")
    kept = tmp_path / "kept"
    kept.write_text("x" * 50)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60, limits[1]))
    try:
        for file in (kept, tmp_path / "folder" / "new"):
            with pytest.raises(UserError, match=f"{file.name} cannot be written: no space left"):
                run.check_writable(file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    for file in (kept, tmp_path / "folder" / "new"):
        run.check_writable(file)
    assert kept.read_text() == "x" * 50 and not list((tmp_path / "folder").iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--first-seed", "99999999999999999999"], "--first-seed must lie between 0 and 2147483647, got 999"),
        (["--steps", "99999999999999999999"], "--steps must lie between 1 and 2147483647, got 999"),
        (["--seeds", "0"], "--seeds must lie between 1"),
        (
            ["--seeds", "2", "--first-seed", "999"],
            "must lie below 1000, so that no two share an episode",
        ),
        (
            ["--learners", "fast_ppo", "dqn"],
            f"dqn needs one discrete action; {ENV} has a continuous one; available: ppo, sac",
        ),
        (["--learners", "fast_ppp"], "did you mean fast_ppo"),
        (["--output", os.devnull], "is not a regular file"),
        (["--output", "a/race.png", "--picture", "a/../a/race.png"], "--output and --picture are both"),
    ],
)
def test_mistakes_are_named_before_the_work(arguments, message, command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    status, output = command(*arguments)
    assert status == 2 and message in output and output.count("\n") == 1


@pytest.mark.parametrize("name", ["mine.py", "mine.py:Two", "mine:Two-v0"])
@pytest.mark.parametrize("module", [race, tune])
def test_a_task_of_ones_own_is_for_other_commands(module, name, capsys):
    assert module.main([name]) == 2
    assert f"is for ids of the package, got {name}; agents.train and agents.ppo" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["shac", "cloning", "sac"])
def test_discrete_actions_do_not_suit_every_learner(name, capsys):
    assert race.main([cart_pole.CartPoleExact.id, "--learners", name]) == 2
    assert f"{name} needs continuous actions; CartPole" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("my notes\n", "no line of it is JSON"),
        ("[1]\n", "row 1: Input should be"),
        (json.dumps(FOUND | {"process_seconds": 4.0}) + "\n{}\n", "row 2: curve Field required"),
        (json.dumps(FOUND | {"process_seconds": 4.0, "score": None}), "row 1: score Input should be"),
        (json.dumps(FOUND | {"process_seconds": 4.0, "curve": [[1, 2]]}), "row 1: curve 0 List should"),
    ],
)
def test_files_of_others_are_left_alone(text, message, command, tmp_path):
    file = tmp_path / "race.jsonl"
    file.write_text(text)
    status, output = command("--output", str(file))
    assert status == 2 and f"race.jsonl is not a file of a race ({message}" in output
    assert file.read_text() == text


def test_a_row_that_was_cut_off_is_trained_again(command, tmp_path):
    file, given = tmp_path / "race.jsonl", ["--first-seed", "2", "--seeds", "2"]
    assert command(*given, "--output", str(file))[0] == 0
    first, second = file.read_text().splitlines()
    file.write_text(first + "\n" + second[:40])
    status, output = command(*given, "--output", str(file))
    assert status == 0 and "race.jsonl: 1 line that is not JSON was left out" in output
    rows = file.read_text().splitlines()
    assert rows[0] == first and json.loads(rows[2])["seed"] == 3


# --- what is shown ---


def test_trainings_are_shown_while_they_run(command, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "100")
    status, output = command("--first-seed", "1", "--seeds", "2")
    assert status == 1 and "failed" in output and "to 3.0 s" in output and "to 1,000 steps" in output
    # The table came to the same place again and again, and what was printed above it stays.
    assert output.count("to 3.0 s") >= 2 and "\x1b[1A" in output and "seed 2: 0.9 in 3.0 s" in output


def test_the_live_table_compares_on_common_axes():
    half = {"trained": 500, "seconds": 1.5, "curve": FOUND["curve"][:2]}
    about = [{"algo": "fast_ppo", "seed": k} for k in range(4)]
    rows = [about[0] | FOUND, about[1] | half, about[2] | half | {"failed": "?", "curve": []}]
    console = Console(width=90, record=True, file=open(os.devnull, "w"))
    with console.file:
        console.print(race.live_table(rows))
    head, whole, running, failed = (line.rstrip() for line in console.export_text().splitlines())
    assert head.split() == ["seed", "steps", "s", "score", "to", "3.0", "s", "to", "1,000", "steps"]
    assert whole.split() == [
        "fast",
        "PPO",
        "0",
        "1,000",
        "3.0",
        "0.950",
        "▁" * 5 + "▄" * 10 + "█",
        "▁▁▁▁▁▁▁▄▄▄▄▄▄▄▄█",
    ]
    assert running.split() == ["fast", "PPO", "1", "500", "1.5", "0.500", "▁" * 5, "▁▁▁▁▁▁▁▄"]
    assert failed.split() == ["fast", "PPO", "2", "500", "1.5", "failed"]
    assert race.small_curve([(0, 0.0, 0.0, -3.0)], 0, 0) == ""


def test_times_of_several_machines_are_called_so():
    rows = [
        {"algo": "fast_ppo", "process_seconds": 4.0} | FOUND,
        {"algo": "ppo", "process_seconds": 4.0} | FOUND,
    ]
    assert not any("machines" in line for line in race.table_lines(rows))
    del rows[1]["machine"]
    assert race.table_lines(rows)[-1] == "Times are from several machines: M, 2 cores; an unknown machine"
    assert race.table_lines([]) == []


def test_the_picture_names_every_learner(tmp_path, monkeypatch):
    """Also one whose first seed failed."""
    from matplotlib.figure import Figure

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: drawn.append(self))
    race.draw_scores(
        [{"env": ENV, "algo": n, "seed": k} | FOUND for k, n in enumerate(["ppo", "fast_ppo"])],
        tmp_path / "a.PNG",
    )
    left, right = drawn[0].axes
    assert [text.get_text() for text in left.get_legend().get_texts()] == ["PPO", "fast PPO"]
    assert list(left.lines[0].get_xdata()) == [0.0, 1.0, 3.0] and list(right.lines[0].get_xdata()) == [
        0,
        500,
        1000,
    ]
