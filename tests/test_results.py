"""What was measured of agents: the summary, the command, figures and page."""

import errno
import json
import re
from pathlib import Path

import numpy as np
import pytest
from covering import covering, engine

from agents import behaviour, figures, measure, report, results
from agents.analysis import learning_curve, level, summarise_env, summarise_learners, times_to_levels
from agents.run import fresh_seeds
from lag_envs.controllers import KNOW_NOTHING, Constant, controllers, make_controller
from lag_envs.evaluation.conditions import NOMINAL, OFTEN, Condition
from lag_envs.evaluation.rollout import Episodes, Rollout, play, record_rollout
from lag_envs.generated import replaced
from lag_envs.scores import KnownReturns
from lag_envs.store import readable_json
from lag_envs.tasks import TASKS, incline, pivoted_bar
from tools.missing import have

ROOT = Path(__file__).parents[1]
ENV = incline.Brake.id


# --- the summary ---


def test_fewer_episodes_are_levelled():
    """A condition that changes nothing costs nothing, whichever episodes it was measured in."""
    found = level({NOMINAL: [[1.0, 2.0, 9.0]], OFTEN: [[1.0, 2.0]], "late": [[0.0, 1.0]]})
    assert found[OFTEN][0].mean() == 4.0 and found["late"][0].mean() == 3.0
    np.testing.assert_array_equal(found[NOMINAL][0], [1.0, 2.0, 9.0])


def test_learning_curve_by_hand():
    curves = [[[0, 0.0, 1.0], [100, 2.0, 3.0]], [[20, 1.0, 5.0], [120, 3.0, 5.0]]]
    found = learning_curve(curves, 0)
    assert (found["x"][0], found["x"][-1]) == (20.0, 100.0)
    assert found["value"][0] == pytest.approx(np.mean([1.4, 5.0]))
    assert (found["low"][-1], found["high"][-1]) == (3.0, 5.0)
    assert learning_curve(curves, 1)["x"][-1] == 2.0
    assert learning_curve(curves[:1], 0)["low"] is None
    assert learning_curve([], 0) is None and learning_curve([[[0, 0.0, 1.0]]], 0) is None


def learner(name, seeds, best=0.9, n=4):
    """Return what is measured of a learner, invented; returns lie between 0 and 10."""
    rng = np.random.default_rng(len(name))
    returns = [10.0 * (best + 0.05 * rng.normal(size=n)) for _ in range(seeds)]
    curve = [[0, 0.1, 0.0], [500, 3.0, 5.0], [1000, 6.0, 10.0 * best]]
    return {
        "name": name,
        "kind": "learned",
        "conditions": {NOMINAL: returns, OFTEN: returns, "late": [r - 2.0 for r in returns]},
        "seeds": list(range(seeds)),
        "steps": [1000] * seeds,
        "seconds": [6.0] * seeds,
        "curves": [curve] * seeds,
        "trained_on": ["a machine: torch 2"],
    }


def classical(name, value):
    returns = [[value - 0.5, value + 0.5, value, value]]
    return {"name": name, "kind": "classical", "conditions": {NOMINAL: returns, "late": returns}}


SCALE = KnownReturns(0.0, 10.0, 0.1, "x")


def invented():
    """Return a whole summary of invented results."""
    agents = [learner("ppo", 5), learner("sac+", 3, 0.8), learner("td3", 1), classical("a|b", 9.9)]
    envs = {
        "PivotedBar-v0": summarise_env([*agents, classical("zero", -30.0)], SCALE),
        pivoted_bar.Balance.id: summarise_env(agents[::2], None),
        incline.Tilt.id: summarise_env([classical("zero", 1.0)], SCALE),
    }
    for env in envs.values():
        env |= {"observation_std": {"s": 0.5}, "problems": ["optimal: not computed"]}
    machine = {"processor": "P", "cores": 2, "system": "S", "python": "3"}
    return {
        "schema": 1,
        "date": "2026-01-01",
        "first_seed": 10**9,
        "episodes": 4,
        "machine": machine,
        "versions": {"numpy": "2"},
        "envs": envs,
        "learners": summarise_learners(envs),
    }


def test_summary_of_an_environment():
    env = invented()["envs"]["PivotedBar-v0"]
    assert [*env["agents"]] == ["a|b", "td3", "ppo", "sac+", "zero"]
    found = env["agents"]["a|b"]["conditions"][NOMINAL]
    assert found["value"] == pytest.approx(0.99) and found["return"] == pytest.approx(9.9)
    assert env["agents"]["ppo"]["conditions"]["late"]["value"] == pytest.approx(
        env["agents"]["ppo"]["conditions"][NOMINAL]["value"] - 0.2
    )
    assert set(env["improvement"]) == {"ppo", "sac+", "td3"}
    assert env["improvement"]["ppo"]["sac+"]["value"] == 1.0 and len(env["improvement"]["ppo"]) == 4
    assert env["improvement"]["td3"]["ppo"]["interval"] is None
    assert invented()["learners"]["ppo"]["envs"] == ["PivotedBar-v0"]  # the others have no score


def test_when_learners_reach_a_score():
    """Half of the seeds or more have to reach a level for a median; without a scale there are no levels."""
    slow, quick = ([(0, 0.1, 0.0), (500 * k, 3.0 * k, 0.98)] for k in (2, 1))
    assert times_to_levels([slow, quick, quick[:1]]) == {
        "0.9": {"seeds": 2, "steps": 1000.0, "seconds": 6.0},
        "0.97": {"seeds": 2, "steps": 1000.0, "seconds": 6.0},
        "0.99": {"seeds": 0, "steps": None, "seconds": None},
    }
    text = report.agents_page(invented())
    assert "| PPO, 5 seeds of 1,000 steps | 5 of 5: 1,000 steps, 6 s | 0 of 5 | 0 of 5 |" in text
    assert "reached" not in invented()["envs"][pivoted_bar.Balance.id]["agents"]["ppo"]


# --- the command ---


def leave_run(folder, number, **changes):
    """Leave a finished run's folder."""
    path = folder / ENV / "ppo" / f"seed{number}"
    path.mkdir(parents=True)
    result = {
        "schema": 1, "env": ENV, "algo": "ppo", "seed": number, "steps": 1000, "trained": 1024,
        "hyperparameters": {"gamma": 0.9}, "wall_seconds": 6.0, "curve": [[0, 0.1, -5.0], [1024, 6.0, -2.0]],
        "evaluation": {"returns": [-2.0]}, "mean_return": -2.0, "score": 0.9, "versions": {"torch": "2"},
        "machine": "M",
    }  # fmt: skip
    (path / "result.json").write_text(json.dumps(result | changes))
    (path / "model.zip").write_bytes(b"policy %d" % number)
    return path


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Return a function that runs the command on a few agents and conditions."""
    monkeypatch.setattr(results, "EPISODES", 4)
    few = [
        Condition(NOMINAL),
        Condition("gravity +20 %", {"gravity": 11.8}),
        Condition("noise 5 %", noise=0.05),
    ]
    monkeypatch.setattr(measure, "conditions", lambda env_id: few)
    monkeypatch.setattr(measure.controllers, "controllers", lambda task: {"zero": KNOW_NOTHING["zero"]})
    monkeypatch.setattr(figures, "figures", lambda data, folder: [])  # another test draws
    monkeypatch.setattr(measure, "no_optimum", lambda env_id: "not computed")
    monkeypatch.setattr(measure, "_policy", lambda env_id, folder: Constant(0.1 * int(folder.name[-1])))
    monkeypatch.setattr(measure, "observation_std", lambda env_id, seeds: np.array([0.5, 0.1]))

    def run(*arguments):
        folders = ["--runs", str(tmp_path / "runs"), "--output", str(tmp_path)]
        status = results.main([*arguments, *folders])
        return status, "".join(capsys.readouterr())

    return run


def summary(tmp_path):
    return json.loads((tmp_path / results.SUMMARY).read_text())


def test_command_measures_and_resumes(command, tmp_path):
    folders = [leave_run(tmp_path / "runs", seed) for seed in (0, 1, 10)]
    status, output = command("--envs", ENV)
    assert status == 0 and "12 measurements, 0 of them made before" in output
    data = summary(tmp_path)
    agents = data["envs"][ENV]["agents"]
    assert set(agents) == {"ppo", "zero"} and agents["ppo"]["seeds"] == [0, 1, 10]
    expected = [play(ENV, Constant(0.1 * k), fresh_seeds(4)).mean() for k in (0, 1, 0)]
    np.testing.assert_allclose(agents["ppo"]["conditions"][NOMINAL]["return"], np.mean(expected), rtol=1e-4)
    assert agents["zero"]["conditions"]["gravity +20 %"] != agents["zero"]["conditions"][NOMINAL]
    assert (tmp_path / results.PAGE).read_text() == report.agents_page(data)
    assert "optimal: not computed" in (tmp_path / results.PAGE).read_text()

    # Nothing is measured twice, but a new policy is.
    status, output = command("--envs", ENV)
    assert status == 0 and "12 measurements, 12 of them made before" in output
    (folders[1] / "model.zip").write_bytes(b"another policy")
    assert "9 of them made before" in command("--envs", ENV)[1]
    # A line that was broken off, or damaged, is measured again.
    file = tmp_path / "runs" / "measurements" / f"{ENV}.jsonl"
    file.write_bytes(file.read_bytes()[:-10])
    assert "11 of them made before" in command("--envs", ENV)[1]
    assert "12 of them made before" in command("--envs", ENV)[1]
    # Agents that are not there now keep their numbers, unless told otherwise.
    for folder in folders:
        (folder / "result.json").unlink()
    assert command("--envs", ENV)[0] == 0
    assert summary(tmp_path)["envs"][ENV]["agents"]["ppo"] == agents["ppo"]
    assert "no finished run" not in (tmp_path / results.PAGE).read_text()
    assert command("--envs", ENV, "--new")[0] == 0
    assert set(summary(tmp_path)["envs"][ENV]["agents"]) == {"zero"}
    assert "no finished run" in (tmp_path / results.PAGE).read_text()


def test_command_leaves_out_what_is_broken(command, tmp_path, monkeypatch):
    leave_run(tmp_path / "runs", 0)
    (leave_run(tmp_path / "runs", 1) / "result.json").write_text('{"schema": 1')
    leave_run(tmp_path / "runs", 2, seed=7)
    (leave_run(tmp_path / "runs", 3) / "model.zip").unlink()
    leave_run(tmp_path / "runs", 4, hyperparameters={"gamma": 0.5})
    leave_run(tmp_path / "runs", 5, curve="?")
    leave_run(tmp_path / "runs", 6)

    def policy(env_id, folder):
        if folder.name == "seed6":
            raise results.UserError("the policy cannot be read")
        return Constant(0.0)

    monkeypatch.setattr(measure, "_policy", policy)
    status, output = command("--envs", ENV)
    assert status == 1
    for message in (
        "seed1/result.json cannot be read", "seed 7, which is not what its folder", "result but no model.zip",
        "other hyperparameters than", "seed5/result.json cannot be read", "seed 6, nominal: UserError: the",
    ):  # fmt: skip
        assert message in output
    assert summary(tmp_path)["envs"][ENV]["agents"]["ppo"]["seeds"] == [0]


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (KeyboardInterrupt(), 130, "What was measured is kept"),
        (OSError(errno.ENOSPC, "No space left on device"), 1, "No space left on device"),
    ],
)
def test_command_that_is_broken_off(error, status, message, command, tmp_path, monkeypatch):
    keep = measure.Evaluation.keep

    def stop(self, *arguments):
        if self.returns:
            raise error
        keep(self, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(measure.Evaluation, "keep", stop)
        found, output = command("--envs", ENV)
    assert found == status and message in output and not (tmp_path / results.SUMMARY).exists()
    found, output = command("--envs", ENV)
    assert found == 0 and "3 measurements, 1 of them made before" in output


def test_command_says_what_is_wrong(command, tmp_path):
    for arguments, message in (
        (["--envs", "PivotedBra-v0"], "did you mean PivotedBar-v0"),
        (["--envs", ENV, "--agents", "ppo"], "no agent 'ppo'; available: zero"),
        (["--envs", ENV, "--episodes", "0"], "--episodes must lie between"),
        (["--redraw"], "measure first"),
    ):
        status, output = command(*arguments)
        assert status == 2 and message in output, output
    results.write_file(tmp_path / results.SUMMARY, "{}")
    for arguments in (["--redraw"], ["--envs", ENV]):
        status, output = command(*arguments)
        assert status == 2 and "cannot be read" in output
    (tmp_path / "runs").write_text("a file")
    status, output = command("--envs", ENV, "--new")
    assert status == 2 and "--runs must be a folder" in output


# --- what is shown ---


def test_page_and_figures_of_any_results(tmp_path):
    data = results.rounded_data(invented())
    results.write_file(tmp_path / results.SUMMARY, readable_json(data))
    assert summary(tmp_path) == data
    stale = tmp_path / results.PICTURES / "agents-stale.png"
    results.write_file(stale, b"of an agent that is gone")
    assert results.main(["--redraw", "--output", str(tmp_path)]) == 0
    assert not stale.exists()
    text = (tmp_path / results.PAGE).read_text()
    assert text == report.agents_page(data) and "nan" not in text
    assert "| a\\|b | 9.90 ± 0.20 | 0.990 (0.950, 1.030) |" in text
    # Scores are shown with the seeds and steps that a learner was given.
    assert "| PPO, 5 seeds of 1,000 steps | " in text and "| TD3, 1 seed of 1,000 steps | " in text
    assert re.search(r"\| sac\+ \| .* \| 3 \| 1,000 \|", text)
    assert "Left out:" in text and "sac+" in text
    linked = {line.split("images/")[1].rstrip(")") for line in text.splitlines() if "](images/" in line}
    drawn = {file.name for file in (tmp_path / results.PICTURES).iterdir()}
    assert {file for file in linked if not file.startswith("value-")} == drawn
    for file in (tmp_path / results.PICTURES).iterdir():
        assert file.read_bytes().startswith(b"\x89PNG") and file.stat().st_size < 125_000


def a_rounding_away(observation):
    """Return observations of which every number is the next one."""
    return np.nextafter(observation, np.inf, dtype=observation.dtype)


def assert_reproduced(env_id, name, policies):
    """Play the committed episodes again.

    Motion that is chaotic makes other episodes of a rounding, which processors and libraries make: there the
    mean may be off by four of the standard errors that a rounding of what is observed leads to.
    """
    agents = summary(ROOT)["envs"][env_id]["agents"]
    stated = agents[name]["conditions"][NOMINAL]
    seeds = fresh_seeds(stated["episodes"])
    found = np.array([play(env_id, policy, seeds) for policy in policies])
    if found.mean() != pytest.approx(stated["return"], rel=1e-4, abs=1e-6):
        others = np.array([play(env_id, policy, seeds, sensor=a_rounding_away) for policy in policies])
        error = (others - found).std() / found.size**0.5
        assert found.mean() == pytest.approx(stated["return"], abs=4.0 * error), name


@pytest.mark.parametrize("env_id", covering(have("agents"), of=engine))
def test_committed_results_of_controllers_come_out_again(env_id):
    for name, found in controllers(TASKS[env_id]).items():
        if not found.plans:  # that takes minutes
            assert_reproduced(env_id, name, [make_controller(env_id, name)])


@pytest.mark.slow
@pytest.mark.parametrize("env_id", have("behaviour"))  # others have no board, where the policies are
def test_committed_results_of_learners_come_out_again(env_id):
    learned = {
        name: policies for name, policies in behaviour.agents(env_id) if name not in TASKS[env_id].controllers
    }
    assert learned
    for name, policies in learned.items():
        assert_reproduced(env_id, name, policies)


def test_fewer_episodes_where_something_is_changed(tmp_path):
    evaluation = measure.Evaluation(pivoted_bar.SwingUpFree.id, tmp_path)

    def counts(*numbers):
        found = {job.entrant.plans: set() for job in evaluation.jobs(["zero", "iLQR"], *numbers)}
        for job in evaluation.jobs(["zero", "iLQR"], *numbers):
            found[job.entrant.plans].add((job.condition.name == NOMINAL, job.episodes))
        return found[False], found[True]

    assert counts(1000) == ({(True, 1000), (False, 1000)}, {(True, 1000), (False, measure.PLANNED)})
    assert counts(1000, 50) == ({(True, 1000), (False, 50)},) * 2


def test_hours_of_all_trainings():
    agents = {"ppo": {"kind": "learned", "seeds": [0, 1], "seconds": 4500.0}, "zero": {"kind": "classical"}}
    (line,) = report._together({"envs": {"A": {"agents": agents}, "B": {"agents": agents}}})
    assert line == "- All 4 runs of learners took 5.0 hours of training."
    assert report._together({"envs": {}}) == []


def test_fewer_episodes_are_told():
    def agent(nominal, late):
        return {"conditions": {NOMINAL: {"episodes": nominal}, "late": {"episodes": late}}}

    envs = {
        "A": {"agents": {"slow": agent(9, 2), "quick": agent(9, 9)}},
        "B": {"agents": {"slow": agent(9, 3), "quick": agent(9, 3)}},
        "C": {"agents": {"quick": agent(9, 9)}},
    }
    (line,) = report._fewer({"envs": envs})
    assert "fewer episodes: slow 2, all of B 3. Their returns" in line
    assert report._fewer({"envs": {"C": envs["C"]}}) == []


def test_how_agents_act_is_what_is_committed():
    """A learner and a controller, played again."""
    kept = json.loads(behaviour.OUTPUT.read_text())
    assert set(kept["envs"]) <= set(TASKS) and kept["episodes"] == behaviour.EPISODES
    found = behaviour.behaviour_of(ENV)
    assert set(found) == set(kept["envs"][ENV]) >= {"fast_ppo", "ppo", "switching line"}
    for name, measures in found.items():
        for what, values in measures.items():
            np.testing.assert_allclose(kept["envs"][ENV][name][what], values, rtol=1e-3, atol=1e-4)
    assert found["switching line"]["median [m/s]"][0] == pytest.approx(0.5, abs=1e-3)


def test_how_agents_act_by_hand():
    """Constant brakes: nothing has to be learnt, and time and speed have closed forms."""
    played = record_rollout(Rollout(ENV, Constant(1.0), fresh_seeds(50)))
    measured = behaviour.measures(played)
    x, v = played.states[0].T
    rate = 6.0 * 2.0 / 3.0  # a solid cylinder of 1 kg
    settled = 2.0 / 3.0 * 9.81 * np.sin(np.radians(15.0)) / rate

    def place(t):
        return x + settled * t + (v - settled) * (1.0 - np.exp(-rate * t)) / rate

    low, high = np.zeros(50), np.full(50, 20.0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = np.where(place(middle) < 0.0, middle, low), np.where(place(middle) < 0.0, high, middle)
    assert measured["across after [s]"] == pytest.approx(low.mean(), rel=1e-6)
    assert measured["highest twentieth [m/s]"] == pytest.approx(settled, rel=1e-2)
    assert measured["price of the speed"] == 0.0
    np.testing.assert_allclose(played.rewards.sum(axis=0), -low, rtol=1e-6)


def test_arrival_by_hand():
    """One episode is there for good after the second step, one never."""
    task = pivoted_bar.SwingUpFree()
    angles = np.array([[0.0, 0.0], [np.pi, np.pi], [0.0, 0.0], [np.pi, 0.0], [np.pi - 0.1, 0.0]])
    played = Episodes(
        task, np.empty((4, 2, 5)), np.stack([angles, 0.0 * angles], axis=-1), np.zeros((4, 2, 1)),
        np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.0], [0.75, 0.0]]), np.array([4, 4]), None,
    )  # fmt: skip
    assert played.settled().tolist() == [3 * task.dt, np.inf]
    found = behaviour.measures(played)
    assert found == {
        "upright after [s]": 3 * task.dt,
        "lost by then": 2.25,
        "lost afterwards": 0.25,
        "episodes without": 1.0,
    }


def test_notes_hold_no_numbers_and_are_shown(monkeypatch):
    """A number needs a command that measures it, and those stand in tables."""
    for task in TASKS.values():
        text = task.note
        assert text and not re.search(r"\d", text.replace("TD3", "")), text
    monkeypatch.setattr(TASKS["PivotedBar-v0"], "note", "It is best.")
    assert "It is best." in report.agents_page(invented())


def test_committed_page_is_made_from_the_committed_results():
    data = summary(ROOT)
    training = (ROOT / results.TRAINING).read_text(encoding="utf-8")
    assert training == replaced(training, "agents", report.summary_table(data)), (
        "python -m agents.results --redraw"
    )
    text = (ROOT / results.PAGE).read_text(encoding="utf-8")
    assert text == report.agents_page(data), "python -m agents.results --redraw"
    for line in text.splitlines():
        if "](images/" in line:
            file = ROOT / "docs" / line.split("](")[1].rstrip(")")
            assert file.stat().st_size < 125_000
