"""The recipe of CONTRIBUTING.md: a task is one file. Here such a file is taken through the whole project.

It has two controls and a vector target. It is not in the package but in a folder, where it is found as it
would be there. A scene with its task is also one file: `toy_pendulum.py`.
"""

import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from batches import assert_alike, assert_same, pair
from gymnasium.utils.env_checker import check_env
from rollouts import RENDERS
from scipy.integrate import solve_ivp
from toy_pendulum import Pendulum, Swing

from agents import behaviour, results, scale, submit, train
from agents.learners import load_policy
from agents.report import agents_page
from lag_envs import TASKS, cli, register
from lag_envs.controllers import controllers, make_controller
from lag_envs.controllers.basic import ObservationDecoder
from lag_envs.evaluation import conditions
from lag_envs.evaluation.rollout import Rollout, play, record_rollout
from lag_envs.leaderboard import docs, protocol
from lag_envs.leaderboard.audit import audit
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.pending import finish
from lag_envs.leaderboard.site.build import write_page
from lag_envs.leaderboard.standings import page_data
from lag_envs.leaderboard.submission import load
from lag_envs.own_files import load_module
from lag_envs.scenes.derivation import form_of, motion_constants_of
from lag_envs.scores import known_returns
from lag_envs.tasks import find_tasks, measured
from tools.docs import environments

ROOT = Path(__file__).parents[1]
RECIPE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
CODE = re.search(r"## Add an environment.*?```python\n(.*?)```", RECIPE, re.DOTALL)[1]
ID = re.search(r'id = "(.*?)"', CODE)[1]


# --- a task in one file ---


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Return the file of CONTRIBUTING.md, in a folder of its own."""
    path = tmp_path_factory.mktemp("tasks") / "two_link_arm.py"
    path.write_text(CODE, encoding="utf-8")
    return path


@pytest.fixture
def task(file, tmp_path, monkeypatch):
    """Find the file's task like those of the package, and return its class."""
    places = find_tasks(file.parent, "")
    assert places == {ID: "two_link_arm:Reach"}
    monkeypatch.syspath_prepend(str(file.parent))
    monkeypatch.setitem(TASKS.data, ID, places[ID])
    register(places[ID], id=ID)
    yield TASKS[ID]
    for name in ("two_link_arm", "own_two_link_arm"):
        sys.modules.pop(name, None)
    load_module.cache_clear()


@pytest.fixture
def scaled(task, tmp_path, monkeypatch):
    """Measure its score scale, write it to a file, and let the package read that file."""
    monkeypatch.setattr(scale, "BATCH", 200)
    path = tmp_path / "measured.json"
    assert scale.main([ID, "--batches", "1", "--output", str(path)]) == 0
    monkeypatch.setattr(measured, "FILE", path)
    return known_returns(ID)


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]], ids=" ".join)
def test_ruff_has_nothing_to_say(command):
    place = ["--stdin-filename", "src/lag_envs/tasks/two_link_arm.py", "-"]
    ruff = [sys.executable, "-m", "ruff", *command, *place]
    told = subprocess.run(ruff, cwd=ROOT, input=CODE, text=True, encoding="utf-8", capture_output=True)
    assert told.returncode == 0, told.stdout


def test_environment(task):
    check_env(gym.make(ID, damping=0.2).unwrapped, skip_render_check=not RENDERS)
    env = gym.make(ID).unwrapped
    assert env.action_space.shape == (2,) and env.reset(seed=1)[0].shape == (6,)
    env.reset(options=dict(task.examples.start))
    assert env.state.tolist() == task.examples.start["state"]
    assert env.target.tolist() == task.examples.start["target"]


def test_vector_is_single(task):
    assert_vector_is_single(ID, 250)


def assert_vector_is_single(env_id, steps):
    """Step the native vector environment and Gymnasium's of single ones alike."""
    native, single = pair(env_id, 3)
    assert type(native) is not type(single)
    assert_same(native.reset(seed=5), single.reset(seed=5))
    assert assert_alike(native, single, steps) > 0


def test_controllers(task):
    assert list(controllers(task)) == ["zero", "random", "springs"]
    mean = {name: play(ID, make_controller(ID, name), range(0, 50)).mean() for name in controllers(task)}
    assert mean["springs"] > max(mean["zero"], mean["random"]) + 20.0
    with gym.make(ID) as env:
        observation, _ = env.reset(seed=0)
        assert make_controller(ID, "springs").predict(observation)[0].shape == (2,)
        _, targets = ObservationDecoder(task())(observation)
        np.testing.assert_allclose(targets, env.unwrapped.target, atol=1e-6)
    with pytest.raises(ValueError, match=r"gain must have shape \(2, 6\), got \(1, 1\)"):
        make_controller(ID, "springs").__class__(task(), gain=[1.0])


def test_scale(scaled):
    assert scaled.policy == "springs" and scaled.random < scaled.best and scaled.optimum is None
    assert protocol.reference(ID).controller == "springs"
    assert protocol.reference(ID).mean == pytest.approx(scaled.best, abs=5.0)


def test_commands(task, file, capsys):
    for command, wanted in (("list", ID), ("info", "goal_1"), ("hyperparams", f"{ID}:\n")):
        assert cli.main([command, *{"info": [ID], "hyperparams": ["ppo"]}.get(command, [])]) == 0
        assert wanted in capsys.readouterr().out


def test_docs_page(task):
    """Its page, though it has no results yet."""
    page = environments.environment_page(ID)
    headings = re.findall("^## (.+)$", page, re.MULTILINE)
    assert headings == [name for name in environments.HEADINGS if name in headings]
    assert {"Action Space", "Observation Space", "Arguments", "Equations"} <= set(headings)
    assert "| 1 | `elbow` |  | N m | -2 | 2 |" in page and '"target": [goal_1, goal_2]' in page
    assert (
        "| 0 | `theta_1` | angle of the upper arm | rad | -∞ | ∞ |" in page
        and page.count('class="equation"') == 3
    )


@pytest.mark.slow
def test_report(task, file, tmp_path, monkeypatch):
    monkeypatch.setattr("lag_envs.report.own.FEW", 2)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["report", "--quick", str(file), "out"]) == 0
    assert "Reach" in Path("out", "index.html").read_text(encoding="utf-8")


@pytest.mark.slow  # each part of it has quick tests of its own
def test_training_results_board_and_pages(scaled, task, file, tmp_path, monkeypatch, capsys):
    # Training: the worker knows the task by its file.
    runs = tmp_path / "runs"
    given = ["--output", str(runs), "--algo", "fast_ppo", "--seeds", "2", "--jobs", "1", "--steps", "4096"]
    assert train.main([str(file), *given]) == 0, capsys.readouterr()
    learned = sorted((runs / ID / "fast_ppo").glob("seed*"))
    assert len(learned) == 2 and -100.0 < play(ID, load_policy(learned[0]), range(0, 5)).mean() < 100.0

    # Results, and the page of docs/agents.md.
    output = tmp_path / "output"
    for folder in ("agents/results", "docs/images"):
        (output / folder).mkdir(parents=True)
    assert results.main(["--envs", ID, "--runs", str(runs), "--output", str(output), "--episodes", "8"]) == 0
    data = results.load_summary(output, needed=True)
    assert set(data["envs"][ID]["agents"]) == {"zero", "random", "springs", "fast_ppo"}
    text = (output / "docs" / "agents.md").read_text(encoding="utf-8")
    assert (
        text == agents_page(data) and f"## {ID}" in text and task.note in text and "springs, the best" in text
    )
    found = behaviour.measures(record_rollout(Rollout(ID, make_controller(ID, "springs"), range(20))))
    assert found["there after [s]"] < 1.5 and found["episodes without"] < 10

    # The board: a learner's and a controller's submission, verified in episodes that follow from a nonce.
    # Each kind of imperfection has a program of its own: two do here.
    monkeypatch.setattr(protocol, "LEARNED_POLICIES", 2)
    some = conditions.imperfections(ID)[::4]
    monkeypatch.setattr(conditions, "imperfections", lambda env_id: some)
    learned = submit.submit_learned(ID, runs / ID / "fast_ppo", tmp_path / "fast_ppo")
    assert learned.code.endswith("/agents/ppo.py")
    for name in controllers(task):
        submit.controller(ID, name, tmp_path / name)
    board = Board(tmp_path / "board")
    board.open()
    for name in ("fast_ppo", "springs", "random"):
        board.add(load(tmp_path / name))
    board.publish("nonce", "https://example.org/pulse/1")
    finish(board)
    assert {entry.state for entry in board.read().entries.values()} == {"verified"}
    data = page_data(board)
    shown = next(env for env in data["environments"] if env["id"] == ID)
    assert shown["rows"][0]["name"] == "springs" and shown["goal"] == task.goal.text
    assert shown["rows"][0]["module"] == task.controllers["springs"].place.partition(":")[0]
    replay = shown["rows"][0]["replays"][0]
    assert np.shape(replay["actions"])[1:] == (2,) and np.shape(replay["target"]) == (2,)
    findings = []
    audit(board, tell=findings.append)
    assert [finding.wrong for finding in findings if finding.wrong] == []

    # Its page, and its entries in README and docs.
    write_page(data | {"environments": [shown]}, tmp_path / "site")
    assert "springs" in (tmp_path / "site" / f"{ID}.html").read_text(encoding="utf-8")
    assert f"| {ID} | Success: both joints" in docs.goals()


# --- a scene with its task ---

TOY = Swing.id


@pytest.fixture
def toy():
    register(Swing)


def test_it_is_recognised_as_a_driven_pendulum():
    scene = Pendulum(mass=0.7, length=0.4, damping=0.05)
    drive = form_of(scene).coefficients([0.3, 1.0], [2.0], motion_constants_of(scene))
    per_torque = 1.0 / (0.7 * 0.4**2)
    assert drive == pytest.approx((9.81 / 0.4, 0.0, 0.05 * per_torque, 2.0 * per_torque, 0.0), rel=1e-15)


def test_simulate_against_scipy():
    scene, dt = Pendulum(mass=0.7, length=0.4, damping=0.05), 0.02
    controls = 2.0 * np.sin(np.arange(50.0))
    states = scene.simulate([1.0, -2.0], controls, dt)
    for start, end, u in zip(states[:-1], states[1:], controls, strict=True):

        def rhs(_, y, u=u):
            inertia = scene.mass * scene.length**2
            weight = scene.mass * scene.gravity * scene.length * np.sin(y[0])
            return y[1], (u - weight - scene.damping * y[1]) / inertia

        expected = solve_ivp(rhs, (0.0, dt), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        np.testing.assert_allclose(end, expected, rtol=1e-12, atol=1e-12)


def test_energy_balance():
    balance = Pendulum(damping=0.1).energy_balance([1.0, 4.0], 2.0, 0.02)
    assert abs(balance["residual"]) < 1e-13
    assert balance["work"] > 0.0 and balance["loss"] > 0.0
    with pytest.raises(ValueError, match=r"nodes must be a whole number of at least 1, got 0"):
        Pendulum().energy_balance([1.0, 4.0], 2.0, 0.02, nodes=0)
    with pytest.raises(ValueError, match=r"one set of controls, got shape \(2, 1\)"):
        Pendulum().energy_balance([1.0, 4.0], [2.0, 1.0], 0.02)


def test_the_toy_as_an_environment(toy):
    assert_vector_is_single(TOY, 700)
    check_env(gym.make(TOY, damping=0.2).unwrapped, skip_render_check=not RENDERS)
    with pytest.raises(ValueError, match="length must be above 0 m, got -1 m"):
        gym.make(TOY, length=-1.0)
