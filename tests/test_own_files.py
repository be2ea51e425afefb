"""A user's file in `report`, `info`, `bench` and `play`: the classes found, the messages about mistakes."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from lag_envs import own_files
from lag_envs.benchmark import cold_start, contestants
from lag_envs.benchmark.actions import actions_of
from lag_envs.benchmark.measurement import BenchmarkSettings, bench
from lag_envs.cli import main
from lag_envs.errors import UserError

ROOT = Path(__file__).parents[1]
BALL = str(ROOT / "examples" / "ball_on_beam.py")
#: A task with two controls, one with a choice among three, and one without controls.
SEVERAL = str(ROOT / "tests" / "own_tasks.py")

SCENE = """
from lag_envs.scenes import Scene, parameter

class Swing(Scene):
    length: float = parameter(1.0, "m", above=0.0)
    coordinates = {"theta": "rad"}
    controls = {"torque": "N m"}

    def kinetic(self, q, v, xp):
        return 0.5 * (self.length * v.theta) ** 2

    def potential(self, q, xp):
        return -9.81 * self.length * xp.cos(q.theta)

    def applied(self, q, v, u, xp):
        return {"theta": u.torque}
"""
TASK = """
from lag_envs.tasks import Task

class Pump(Task):
    scene = Swing
    action = {"torque": 2.0}
    start = {"theta": 0.5}

    def observe(self, after, target, xp):
        return {"theta": after.theta}

    def reward(self, before, after, control, target, dt, xp):
        return -xp.cos(after.theta)
"""


@pytest.fixture
def write(tmp_path):
    """Write a file, and forget its definitions."""

    def write(text, name="mine.py"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    yield write
    for name in [
        name for name, module in sys.modules.items() if str(tmp_path) in str(getattr(module, "__file__", ""))
    ]:
        del sys.modules[name]
    if str(tmp_path) in sys.path:
        sys.path.remove(str(tmp_path))


def told(capsys, *arguments):
    """Run the command, which fails; return its message."""
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error and error.startswith("lag-envs: error: ")
    return error


# --- found classes ---


def test_info_prints_the_facts(capsys):
    assert main(["info", BALL]) == 0
    out = capsys.readouterr().out
    parts = [
        "BallOnBeam-v0", "Roll the ball", "angle_dot [rad/s]", "torque  -1 to 1 N m", "mark  0 ± 0.3 m",
        "ball_mass     0.1 kg      above 0", "0.02 s; episode: 500 steps", "order 16, proved",
    ]  # fmt: skip
    for part in parts:
        assert part in out, part


@pytest.mark.parametrize(
    ("kind", "parts"),
    [
        ("Deliver", ("push  -20 to 20 N", "pull  0 to 20 N", "y_goal  -1.5 ± 0.3 m", "sin        ±1")),
        ("Switched", ("s_ddot  -5, 0, 5 m/s²  actions 0 to 2", "bars          3")),
        ("Drift", ("Controls, and the actions that set them\n  none", "1 ± 0.5 rad")),
    ],
)  # fmt: skip
def test_info_of_one_of_several(kind, parts, capsys):
    assert main(["info", f"{SEVERAL}:{kind}"]) == 0
    out = capsys.readouterr().out
    for part in parts:
        assert part in out, part


def test_a_task_without_an_id_gets_one(write):
    path = write(SCENE + TASK)
    assert own_files.registered(path) == ["Pump-v0"]
    env = gym.make("Pump-v0", length=2.0)
    env.reset(seed=1)
    assert env.step(np.zeros(1, np.float32))[1] < 0


def test_another_file_replaces_what_was_registered(write):
    assert own_files.registered(write(SCENE + TASK)) == ["Pump-v0"]
    assert own_files.registered(write(SCENE + TASK.replace("2.0", "3.0"), "newer.py")) == ["Pump-v0"]
    assert gym.make("Pump-v0").unwrapped.task.action == {"torque": 3.0}


def test_an_alias_is_no_other_class(write):
    path = write(SCENE + TASK + "\nfor T in [Pump]:\n    pass\nAlias = Swing\n")
    assert own_files.one(path).__name__ == "Pump" and list(own_files.scenes(path)) == ["Swing"]


def test_neighbours_can_be_imported(write):
    write(SCENE, "swings.py")
    path = write("from swings import Swing\n" + TASK)
    assert list(own_files.chosen_tasks(path)) == ["Pump"]
    assert own_files.scenes(path) == {}


def test_the_name_of_another_module_is_left_to_it(write):
    import json

    path = write(SCENE + TASK, "json.py")
    assert own_files.load_module(path).__name__ == "own_json"
    assert sys.modules["json"] is json


# --- mistakes ---


@pytest.mark.parametrize("command", ["info", "play", "bench", "report"])
def test_what_is_neither_an_id_nor_a_file(command, capsys, tmp_path):
    missing = str(tmp_path / "no.py")
    assert f"there is no file {missing}" in told(capsys, command, missing)
    if command != "report":
        assert "the name of your own file must end with .py" in told(capsys, command, "BallOnBeam")
        assert "did you mean PivotedBar-v0" in told(capsys, command, "PivotdBar-v0")


def test_report_takes_no_id_for_a_folder(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("PivotedBr-v0", "ball_on_beam:BallOnBeam-v0"):
        assert f"{name} is not a FILE, and looks like an id" in told(capsys, "report", name, "--quick")
    assert "there is no section ''" in told(capsys, "report", "--quick", "--sections", "")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["info", "play", "bench", "watch", "order"])
def test_ids_that_no_task_of_a_file_may_have(command, write, capsys):
    for id, message in (
        ("PivotedBar-v0", "the id 'PivotedBar-v0' is that of an environment of this package; choose another"),
        ("Swing Up", "mine.py: Malformed environment ID: Swing Up"),
    ):
        text = SCENE + TASK.replace("    scene = Swing", f"    id = {id!r}\n    scene = Swing")
        assert message in told(capsys, command, write(text))
        own_files.load_module.cache_clear()


def test_modules_in_the_current_folder(write, tmp_path, monkeypatch, capsys):
    text = SCENE + TASK.replace("    scene = Swing", '    id = "OwnPump-v0"\n    scene = Swing')
    write(text + "\nimport lag_envs\n\nlag_envs.register(Pump)\n", "pumping.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    assert main(["info", "pumping:OwnPump-v0"]) == 0 and "torque" in capsys.readouterr().out
    assert "'pumping:Pump-v0'; did you mean OwnPump-v0?" in told(capsys, "info", "pumping:Pump-v0")
    assert "'math:Pump-v0'; math registers no environment" in told(capsys, "info", "math:Pump-v0")
    assert "No module named 'no_such'" in told(capsys, "info", "no_such:Pump-v0")


def test_places_that_are_no_python_file(capsys, tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    assert "is not a Python file" in told(capsys, "info", str(tmp_path / "notes.txt"))
    assert "is a folder" in told(capsys, "info", str(tmp_path))


@pytest.mark.parametrize("command", ["info", "play"])
def test_several_tasks_are_named(command, capsys):
    error = told(capsys, command, SEVERAL)
    assert "has several tasks: name one" in error
    for kind in ("Deliver", "Switched", "Drift"):
        assert f"{SEVERAL}:{kind}" in error
    assert "did you mean Deliver?" in told(capsys, command, f"{SEVERAL}:Delivr")


@pytest.mark.parametrize("command", ["info", "play", "bench"])
def test_a_file_without_a_task(command, write, capsys):
    error = told(capsys, command, write(SCENE))
    assert "defines no task (only Swing, for which `lag-envs report" in error and "docs/tutorial.md" in error


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\ny = 1 / 0\n", "mine.py, line 2: ZeroDivisionError: division by zero"),
        ("def f(:\n", "mine.py, line 1: SyntaxError"),
        ("import no_such_module\n", "mine.py, line 1: ModuleNotFoundError: No module named 'no_such_module'"),
        ("import sys\nsys.exit()\n", "__name__"),
        (
            SCENE.replace("xp.cos(q.theta)", "xp.cos(q.angle)") + TASK,
            "Swing.potential: there is no coordinate 'angle'",
        ),
        (
            SCENE + TASK.replace("after.theta)", "after.phi)"),
            "Pump.reward: there is no entry of the state 'phi'",
        ),
        (SCENE + TASK + "    def check(self):\n        {}[0]\n", "KeyError: 0"),
        (SCENE + TASK.replace('"torque": 2', '"force": 2'), "the scene has no such control, only torque"),
    ],
)
@pytest.mark.parametrize("command", ["info", "report"])
def test_mistakes_in_a_file_are_told_with_their_place(command, text, message, write, capsys):
    assert message in told(capsys, command, write(text))


def test_refused_steps_are_told(write, capsys):
    text = (SCENE + TASK).replace("xp.cos(q.theta)", "xp.sqrt(q.theta)")
    error = told(capsys, "order", write(text), "--num-envs", "2", "--rounds", "1")
    assert "the acceleration there is not finite" in error


def test_ids_with_a_namespace_and_tasks_without_a_description(write, capsys, monkeypatch):
    register = '\nimport lag_envs\nlag_envs.register(Pump, id="us/Pump-v0")\n'
    path = Path(write(SCENE + TASK + register, "named.py"))
    monkeypatch.syspath_prepend(path.parent)
    assert main(["info", "named:us/Pump-v0"]) == 0
    assert capsys.readouterr().out.startswith("us/Pump-v0\n\nScene: named.Swing\n")


def test_report_needs_something_to_measure(write, capsys):
    assert "nothing to measure: it defines no scene and no task" in told(capsys, "report", write("x = 1\n"))
    broken = SCENE.replace("9.81 * self.length", "9.81 * math.pi").replace("from", "import math\nfrom", 1)
    path = write(broken.replace("xp.cos(q.theta)", "math.cos(q.theta)"), "other.py")
    assert "Swing.potential" in told(capsys, "report", path)
    for option in (["--docs", "."], ["--sections", "bound"]):
        assert f"{option[0]} is for the report about this package" in told(capsys, "report", BALL, *option)
    assert "one FILE and one FOLDER" in told(capsys, "report", "a", "b")


@pytest.mark.parametrize("command", ["info", "play", "bench", "report"])
def test_help_says_that_the_code_is_run(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert "whose code is run" in " ".join(capsys.readouterr().out.split())


def test_the_leaderboard_runs_no_file_of_anybody():
    for path in (ROOT / "src" / "lag_envs" / "leaderboard").rglob("*.py"):
        assert not re.search(r"own_files|spec_from_file|runpy|\bexec\(", path.read_text(encoding="utf-8")), (
            path
        )


# --- bench ---


def test_bench_takes_tasks_of_a_file(monkeypatch):
    monkeypatch.setattr(contestants, "PEERS", [])
    ids = tuple(own_files.registered(SEVERAL))
    assert ids == ("OwnCrane-v0", "OwnSwitched-v0", "OwnDrift-v0")
    settings = BenchmarkSettings(ids[-1:], (SEVERAL,), sizes=(3,), rounds=1, seconds=1e-4, cold_starts=0)
    rows = [row for row in bench(settings)["rows"] if row["library"] == "lag_envs"]
    assert len(rows) == 3 and all(row["rates"] for row in rows), [row["problem"] for row in rows]


def test_random_actions_fit_their_space():
    box, several = gym.spaces.Box(-2.0, 2.0, (1,)), gym.spaces.Box(-1.0, 1.0, (2,))
    for space in (box, several, gym.spaces.Discrete(3), gym.spaces.MultiDiscrete([2, 3])):
        for actions in actions_of(space, 4)[:20]:
            assert all(
                space.contains(space.dtype.type(a) if a.ndim == 0 else a.astype(space.dtype)) for a in actions
            )
    chosen = np.concatenate(actions_of(gym.spaces.Discrete(3), 50))
    assert set(chosen) == {0, 1, 2}


@pytest.mark.slow
def test_cold_start_of_a_file(tmp_path):
    stages = cold_start.cold_start("OwnDrift-v0", str(tmp_path), (SEVERAL,))
    assert len(stages) == len(cold_start.STAGES) and min(stages) >= 0.0


# --- play ---


def _mapped(env, *names):
    from lag_envs.play import pressed_action, resting

    return pressed_action(env.action_space, names.__contains__, resting(env.unwrapped.task))


def test_keys_become_actions():
    own_files.registered(SEVERAL)
    crane, switched, drift = (gym.make(f"Own{name}-v0") for name in ("Crane", "Switched", "Drift"))
    assert _mapped(crane).tolist() == [0.0, -1.0]  # the second goes from 0 to 20 N
    assert _mapped(crane, "right", "up").tolist() == [1.0, 1.0]
    assert _mapped(crane, "left", "right").tolist() == [0.0, -1.0]
    assert [_mapped(switched, *keys) for keys in ((), ("left",), ("right",))] == [1, 0, 2]
    assert _mapped(drift).shape == (0,)
    for env in (crane, switched, drift):
        assert env.action_space.contains(_mapped(env, "left"))


@pytest.mark.parametrize("name", [f"{SEVERAL}:Deliver", f"{SEVERAL}:Switched", f"{SEVERAL}:Drift", BALL])
def test_play_steps_and_starts_over(name, monkeypatch, capsys):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    assert main(["play", name, "--steps", "25", "--seed", "1"]) == 0
    out = capsys.readouterr().out
    assert "r: start over" in out
    if name.endswith("Drift"):
        assert "time is up: return" in out
        assert "the scene has no bodies" in out


# --- report ---


@pytest.mark.parametrize("kind", ["Deliver", "Switched", "Drift"])
def test_steps_keep_their_bounds(kind, monkeypatch):
    """Errors against SymPy's equations, whatever the task's actions are."""
    monkeypatch.setattr("lag_envs.report.own.FEW", 2)
    from lag_envs.report import own

    (subject,) = own.subjects(f"{SEVERAL}:{kind}")
    rows = list(own.shipped_steps(f"{SEVERAL}:{kind}", "", True, subject.name))
    exact = [row for row in rows if row["kind"] == "step"]
    assert len(exact) >= 1
    assert max(row["beyond"] for row in exact) < own.ROUNDING
    assert rows[0]["kind"] == "certificate" and rows[0]["refused"] == 0


def test_subjects_are_the_scenes_of_tasks_and_the_others(write):
    from lag_envs.report import own

    path = write(SCENE + SCENE.replace("Swing", "Other") + TASK)
    assert [s.name for s in own.subjects(path)] == ["Swing of Pump", "Other"]
    assert [s.name for s in own.subjects(path + ":Other")] == ["Other"]
    with pytest.raises(UserError, match="has no task 'Pum'; did you mean Pump"):
        own.subjects(path + ":Pum")
    told = []
    broken = "\n\nclass Broken(Swing):\n    def kinetic(self, q, v, xp):\n        return None\n"
    assert len(own.subjects(write(SCENE + broken, "half.py"), told.append)) == 1
    assert len(told) == 1 and "left out: Broken: Broken.kinetic" in told[0]
    jobs = own.jobs(True, path)
    assert all(job.section == "own" and getattr(own, job.function.__name__) is job.function for job in jobs)
    names = [job.name for job in jobs]
    assert names == [
        f"{what}: {name}" for what in ("steps", "stability", "points") for name in ("Swing of Pump", "Other")
    ]


def test_rows_belong_to_the_physics_wherever_it_is_written(write, monkeypatch):
    """A scene's formulas, or its defaults, may come from another file."""
    from lag_envs.report import own

    path = write(SCENE)
    (subject,), (job, *_) = own.subjects(path), own.jobs(True, path)

    class Heavier(type(subject.scene)):
        def potential(self, q, xp):
            return 2.0 * super().potential(q, xp)

    for scene in (Heavier(), type(subject.scene)(length=2.0)):
        monkeypatch.setattr(own, "subjects", lambda file, scene=scene: [subject._replace(scene=scene)])
        assert own.jobs(True, path)[0].arguments["digest"] != job.arguments["digest"]


@pytest.mark.slow
def test_stiff_parameters_are_counted(write, monkeypatch):
    from lag_envs.report import own

    monkeypatch.setattr(own, "FACTORS", (1e-4, 1e4))
    path = write(SCENE)
    found = {row["case"]: row for row in own.stability(path, "", True, "Swing")}
    assert found["as it is"]["refused"] == 0 and found["as it is"]["balance"] < 1e-12
    assert {"states × 10", "length × 0.0001", "length × 10000"} <= set(found)
    assert max(row["balance"] for row in found.values()) < own.BALANCE


def test_a_balance_of_quick_motion_needs_finer_quadrature(write):
    """With a load of a tenth of a gram the winch pulls it to and fro hundreds of times as fast."""
    from lag_envs.report import own

    (subject,) = own.subjects(f"{SEVERAL}:Deliver")
    light = dataclasses.replace(subject.scene, load_mass=1e-4)
    start, held = np.array([0.0, 0.0, 1.06, 0.7, 0.22, -0.6]), np.array([-9.5, 6.0])
    assert own.step_imbalance(light, start, held, subject.dt) < 1e-11
    coarse = light.energy_balance(start, held, subject.dt)
    assert abs(coarse["residual"]) > 1e-3 * abs(coarse["work"])


@pytest.mark.slow
def test_report_of_a_file(tmp_path):
    command = [sys.executable, "-m", "lag_envs.cli", "report", "--quick", BALL]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=300, env=os.environ.copy()
    )
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "report-ball_on_beam"
    text = (folder / "index.html").read_text(encoding="utf-8")
    for part in (
        "Your own scenes",
        "BallOnBeam of Balance",
        "own-steps",
        "figures/own-BallOnBeam-of-Balance.svg",
    ):
        assert part in text, part
    assert "DOES NOT HOLD" not in done.stdout
