"""Tuning: failed trainings are said and tried again, and options that have no effect are refused."""

import json
import os
import signal

import pytest
from trainings import here

from agents import tune
from lag_envs.tasks import incline

ENV = incline.Brake.id
WORKED = {"trained": 256, "return": -2.0, "score": 0.9, "seconds": 1.0, "processor_seconds": 1.0, "curve": []}


def second_fails(folder, env_id, changed, seed, steps, episodes):
    if seed == 501:
        raise OSError(28, "No space left on device")
    return {"seed": seed} | WORKED


def dies(folder, *_):
    folder.mkdir()
    with open(os.environ["TOLD"], "w") as out:
        out.write(str(folder))
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def search(monkeypatch, capsys, tmp_path):
    """Return a function that tries a setting; it returns the status, what was printed, and the seeds kept."""
    monkeypatch.setattr(tune, "trial", second_fails)
    monkeypatch.setattr(tune.workers, "processes", here)
    file = tmp_path / "tuning.json"

    def search(*arguments):
        status = tune.main([ENV, "--settings", "1", "--output", str(file), *arguments])
        kept = json.loads(file.read_text())["settings"][0]["runs"] if file.exists() else []
        return status, "".join(capsys.readouterr()), [run["seed"] for run in kept]

    return search


def test_trainings_that_fail_are_said_and_tried_again(search, tmp_path, monkeypatch):
    status, output, kept = search()
    assert status == 1 and kept == [500]
    assert "setting 0, seed 501: failed: OSError: [Errno 28] No space left on device\n" in output
    assert "1 of the trainings failed; re-run the command to try them again" in output and "-2.00" in output
    # Earlier versions stored the failures.
    data = json.loads((tmp_path / "tuning.json").read_text())
    data["settings"][0]["runs"].append({"seed": 501, "failed": "OSError"})
    (tmp_path / "tuning.json").write_text(json.dumps(data))
    monkeypatch.setattr(tune, "trial", lambda folder, *given: {"seed": given[2]} | WORKED)
    status, output, kept = search()
    assert status == 0 and kept == [500, 501] and "seed 500" not in output


def test_a_search_goes_on_with_the_seeds_that_it_began_with(search, tmp_path, monkeypatch):
    """Earlier versions began with 0."""
    monkeypatch.setattr(tune, "trial", lambda folder, *given: {"seed": given[2]} | WORKED)
    assert search("--seeds", "1")[2] == [500]
    data = json.loads((tmp_path / "tuning.json").read_text())
    assert data.pop("first_seed") == 500
    data["settings"][0]["runs"][0]["seed"] = 0
    (tmp_path / "tuning.json").write_text(json.dumps(data))
    assert search()[2] == [0, 1]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_search_in_which_nothing_worked_has_no_table(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tune, "trial", dies)
    monkeypatch.setenv("TOLD", str(tmp_path / "told"))
    file = tmp_path / "tuning.json"
    assert tune.main([ENV, "--settings", "1", "--seeds", "1", "--output", str(file)]) == 1
    output = "".join(capsys.readouterr())
    assert "seed 500: failed: the process died, exit status -9" in output
    assert "nan" not in output and "mean return" not in output and not file.exists()
    assert (tmp_path / "told").read_text() and not os.path.exists((tmp_path / "told").read_text())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--settings", "1", "--only", "best constant"], "--only has no effect with --settings"),
        (["--settings", "1", "--generations", "2"], "--generations has no effect with --settings"),
        (["--seeds", "2"], "--seeds has no effect without --settings"),
        (["--settings", "0"], "--settings must lie between 1"),
    ],
)
def test_options_without_effect_are_refused(arguments, message, capsys):
    assert tune.main([ENV, *arguments]) == 2
    assert message in capsys.readouterr().err


def test_damaged_results_are_named(search, tmp_path):
    search()
    data = json.loads((tmp_path / "tuning.json").read_text())
    data["settings"][0]["runs"][0].pop("return")
    (tmp_path / "tuning.json").write_text(json.dumps(data))
    status, output, _ = search()
    assert status == 2 and "cannot be read" in output


@pytest.mark.parametrize(("name", "given"), [("play", []), ("trial", ["--settings", "1"])])
def test_an_interrupted_search_ends_without_a_traceback(name, given, monkeypatch, tmp_path):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(tune, name, interrupt)
    monkeypatch.setattr(tune.workers, "processes", here)
    monkeypatch.setattr(tune, "RESULTS", tmp_path)
    assert tune.main([ENV, *given]) == 130
