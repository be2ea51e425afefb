"""One record per environment: its id stands in one file, and no other file knows it."""

import re
import subprocess
from collections import defaultdict
from pathlib import Path

import pytest
from covering import covering

from lag_envs import cli, scenes
from lag_envs.controllers import build, controllers
from lag_envs.errors import UserError
from lag_envs.hyperparams import DEFAULTS, OFF_POLICY, learners
from lag_envs.scores import share_of_privileged
from lag_envs.tasks import TASKS, find_tasks, load_task
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import measured_entry
from tools.missing import COMMANDS, have, missing

ROOT = Path(__file__).parents[1]
#: The example in help texts, and in tests that are independent of the environment.
EXAMPLE = "PivotedBar-v0"
BY_HAND = (".py", ".toml", ".yml", ".yaml", ".js", ".html", ".cpp", "Makefile")
#: Files that commands write, and submissions.
GENERATED = ("leaderboard/submissions/", "leaderboard/results/", "agents/results/", "docs/", "tests/golden/")

each_task = pytest.mark.parametrize("env_id", TASKS)


def files():
    """Return the hand-written files."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    found = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    return [
        name
        for name in found
        if name.endswith(BY_HAND) and not name.startswith(GENERATED) and (ROOT / name).is_file()
    ]


def test_an_id_stands_in_two_files_at_most():
    named = defaultdict(set)
    for name in files():
        for env_id in re.findall(r"[A-Za-z]+-v\d+", (ROOT / name).read_text(encoding="utf-8")):
            named[env_id].add(name)
    for env_id, task in TASKS.items():
        assert f"src/{task.__module__.replace('.', '/')}.py" in named[env_id]
        assert len(named[env_id]) <= 2 or env_id == EXAMPLE, named[env_id]


def test_no_id_is_put_together():
    """No string is an id's part before the version; only a class without an id gets one made of its name."""
    stems = "|".join({re.sub(r"-v\d+$", "", env_id) for env_id in TASKS} - set(scenes.__all__))
    made = {"src/lag_envs/own_files.py", "src/lag_envs/tasks/registration.py", "tests/test_own_files.py"}
    made.add("tools/libraries/minari_replay.py")  # a data set
    for name in files():
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not re.search(rf"[\"'](?:{stems})[\"']", text), name
        assert name in made or not re.search(r"\}-v\d+[\"']|[\"']-v\d+[\"']", text), name


def test_tasks_are_found():
    """Reading the files finds the same as importing them: every task with an id, in its module."""
    places = find_tasks(Path(ROOT, "src/lag_envs/tasks"), "lag_envs.tasks.")
    assert places == TASKS.data
    assert next(iter(TASKS)) == EXAMPLE
    for env_id, task in TASKS.items():
        assert task.id == env_id and issubclass(task, Task)

    def below(kind):
        return {kind, *(one for sub in kind.__subclasses__() for one in below(sub))}

    own = {kind for kind in below(Task) if kind.__module__.startswith("lag_envs.tasks.")}
    assert {kind.id for kind in own if "id" in vars(kind) and kind.id} == set(TASKS)


def test_a_task_whose_file_fails_is_named_with_its_error(tmp_path, monkeypatch, capsys):
    file = tmp_path / "failing_task.py"
    file.write_text("import math\n\nclass Fails:\n    steps = undefined\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(TASKS.data, "Fails-v0", "failing_task:Fails")
    told = f"{file}, line 4: NameError: name 'undefined' is not defined"
    with pytest.raises(UserError, match=f"^{re.escape(told)}$"):
        TASKS["Fails-v0"]
    assert cli.main(["list"]) == 2 and told in capsys.readouterr().err
    for place in ("math:Fails", "no_such_module:Fails", "", None):
        with pytest.raises(ValueError, match="task must be given as 'module:Class'"):
            load_task(place)


@each_task
def test_records_are_whole(env_id):
    task = TASKS[env_id]
    assert task.goal is None or task.goal.text.startswith("success: ")
    assert task.goal is None or task.goal.hold is None or "time" in task.goal.text
    # Otherwise no episode could succeed.
    assert (
        task.goal is None
        or task.goal.terminated is None
        or task.reached is not Task.reached
        or not task.goal.counted
    )
    assert task.note and task.examples.start and task.examples.batch
    assert set(task.hyperparameters) <= {*learners(), "off_policy"}
    for learner, own in task.hyperparameters.items():
        general = DEFAULTS[OFF_POLICY[0] if learner == "off_policy" else learner]
        common = {name for name in own if own[name] == general.get(name)}
        assert not common, f"{learner}: {common} are the general ones"
    known = controllers(task)
    assert not task.reference or not known[task.reference].plans
    assert all(low < high for found in known.values() for low, high in found.tune.values())


@pytest.mark.parametrize("env_id", covering())
def test_controllers_of_records_can_be_built(env_id):
    task = TASKS[env_id]
    for name in controllers(task):
        try:
            assert build(task(), name) is not None
        except ValueError as error:  # until its plan has been computed
            assert "plan" in missing(env_id) and "there is no plan" in str(error)


@pytest.mark.parametrize("env_id", [env_id for env_id, task in TASKS.items() if task.open])
def test_what_is_open_is_far_from_solved(env_id):
    task = TASKS[env_id]
    assert task.open.controller in task.controllers
    assert len(task.open.tried) >= 3 and set(task.controllers) <= set(task.open.tried)
    share = share_of_privileged(env_id)
    assert share is None or 0.0 < share <= 0.8


def test_there_is_a_task_that_nobody_has_solved():
    assert any(task.open for task in TASKS.values())


@pytest.mark.slow
@each_task
def test_nothing_lacks(env_id):
    """The quick tests use what has been generated so far; before an issue is closed all of it is there."""
    assert missing(env_id) == {}


def test_what_lacks_is_told_with_its_command(monkeypatch):
    assert missing(EXAMPLE) == {}

    class New(TASKS[EXAMPLE]):
        id = "New-v0"

    monkeypatch.setitem(TASKS.data, "New-v0", New)
    found = missing("New-v0")
    assert set(found) == set(COMMANDS) - {"plan", "real time"}
    assert found["rollouts"] == "python tests/golden_rollouts.py New-v0"
    assert "New-v0" not in have("returns") and EXAMPLE in have("returns")
    with pytest.raises(ValueError, match="there is no 'films', only returns, rollouts, plan"):
        have("films")


@pytest.mark.parametrize("env_id", have("returns"))
def test_what_was_measured_is_there(env_id):
    found = measured_entry(env_id)
    assert {"random", "zero", found["scale"]["policy"]} <= set(found["measured"])
    assert ("reference" in found) == bool(TASKS[env_id].reference)
    assert ("optimum" in found["scale"]) == ("optimum" in found["measured"]) == bool(TASKS[env_id].optimum)
    assert ("privileged" in found["measured"]) == bool(TASKS[env_id].open)
    plans = {name for name, controller in TASKS[env_id].controllers.items() if controller.plans}
    for name, row in found["measured"].items():
        assert row["episodes"] >= (20 if name in plans else 1000) and row["error"] >= 0.0
