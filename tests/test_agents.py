import errno
import json
import re
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from covering import slow
from gymnasium.wrappers.vector import ClipAction, RecordEpisodeStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from agents import bench, demo, ppo, race, report, scale, train, tune
from agents.policy import Policy
from lag_envs.controllers import make_controller
from lag_envs.errors import UserError
from lag_envs.evaluation.rollout import play
from lag_envs.sb3 import ScaledReward, VecEnv, make_vec_env
from lag_envs.scores import known_returns, score
from lag_envs.tasks import TASKS, arm, cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.measured import measured_entry
from tools.missing import have

ROOT = Path(__file__).parents[1]
ENV = "PivotedBar-v0"


def test_score():
    for env_id in have("returns"):
        known = known_returns(env_id)
        assert score(env_id, known.best) == 1.0 and score(env_id, known.random) == 0.0
        assert known.random < known.best


# --- the adapter ---


def pair(env_id, n=3, seed=7, **options):
    """Return the adapter and SB3's own vector environment over single ones, seeded alike."""
    adapter = make_vec_env(env_id, n, **options)
    dummy = DummyVecEnv([lambda: gym.make(env_id, **options)] * n)
    for envs in (adapter, dummy):
        envs.seed(seed)
    return adapter, dummy


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (ENV, {"duration": 1.0}),
        *(slow(task.id, {}) for task in (pivoted_bar.Balance, incline.Brake, incline.Tilt)),
    ],
)
def test_adapter_equals_dummy_vec_env(env_id, options):
    adapter, dummy = pair(env_id, **options)
    assert adapter.observation_space == dummy.observation_space
    assert adapter.action_space == dummy.action_space
    assert adapter.reset().tobytes() == dummy.reset().tobytes()
    rng = np.random.default_rng(0)
    ends = {True: 0, False: 0}
    for _ in range(450):
        actions = rng.uniform(-1.0, 1.0, (3, 1)).astype(np.float32)
        (o1, r1, d1, i1), (o2, r2, d2, i2) = adapter.step(actions), dummy.step(actions)
        assert (o1.tobytes(), r1.tobytes(), d1.tobytes()) == (o2.tobytes(), r2.tobytes(), d2.tobytes())
        assert (o1.dtype, r1.dtype, d1.dtype) == (o2.dtype, r2.dtype, d2.dtype)
        for a, b, done in zip(i1, i2, d1, strict=True):
            if done:
                assert a["terminal_observation"].tobytes() == b["terminal_observation"].tobytes()
                assert a["TimeLimit.truncated"] is b["TimeLimit.truncated"]
                ends[a["TimeLimit.truncated"]] += 1
            else:
                assert a == {}
    assert sum(ends.values()) >= 6
    # Without seeds a reset continues with the next episodes.
    assert adapter.reset().tobytes() == dummy.reset().tobytes()


def test_adapter_passes_options_and_infos_on():
    adapter, dummy = pair(ENV, diagnostics=True, duration=0.1)
    for envs in (adapter, dummy):
        envs.set_options({"state": [0.1, 0.0, 3.0, 0.0]})
    assert adapter.reset().tobytes() == dummy.reset().tobytes()
    np.testing.assert_array_equal(adapter.get_attr("state"), [[0.1, 0.0, 3.0, 0.0]] * 3)
    for _ in range(7):
        _, _, _, i1 = adapter.step(np.ones((3, 1), np.float32))
        _, _, _, i2 = dummy.step(np.ones((3, 1), np.float32))
        for a, b in zip(i1, i2, strict=True):
            b.pop("TimeLimit.truncated")
            a.pop("TimeLimit.truncated", None)
            assert set(a) == set(b)
            for name in a:
                np.testing.assert_allclose(a[name], b[name], rtol=1e-12, atol=1e-12)
    adapter.set_options([{"state": [0.0, 0.0, 0.0, 0.0]}, {}, {}])
    with pytest.raises(ValueError, match="all environments must be given the same"):
        adapter.reset()


def test_adapter_attributes():
    envs = make_vec_env(ENV, 3, render_mode="rgb_array", mass=[0.1, 0.2, 0.3])
    envs.seed(1)
    observations = envs.reset()
    assert [s.shape for s in envs.get_attr("state")] == [(4,)] * 3
    assert envs.get_attr("state", [1])[0][0] == pytest.approx(0.5 * observations[1, 0])
    assert envs.get_attr("action_space", 0) == [envs.action_space]
    assert envs.has_attr("scene") and not envs.has_attr("nonsense")
    assert envs.env_is_wrapped(gym.Wrapper) == [False] * 3
    envs.set_attr("mark", 7)
    assert envs.get_attr("mark", [0, 2]) == [7, 7]
    with pytest.raises(NotImplementedError, match="all of its environments"):
        envs.set_attr("mark", 8, [0])
    with pytest.raises(AttributeError, match=r"^damping cannot be set once the environment is made"):
        envs.set_attr("damping", 8.0)
    assert len(envs.env_method("render")) == 3
    assert envs.render().ndim == 3  # tiled into one picture
    envs.close()


def test_adapter_shares_out_only_what_belongs_to_each():
    """It does not guess by length: here the numbers of environments are those of other things."""
    for n in (2, 3):
        adapter, dummy = pair(ENV, n)
        assert adapter.reset().tobytes() == dummy.reset().tobytes()
        for (o1, i1), (o2, i2) in zip(adapter.env_method("reset"), dummy.env_method("reset"), strict=True):
            assert o1.tobytes() == o2.tobytes() and i1 == i2 == {}
        for envs in (adapter, dummy):
            envs.set_attr("mark", ["a"] * n)
            assert envs.get_attr("mark") == [["a"] * n] * n
    envs = make_vec_env(ENV, 2, mass=[0.1, 0.2], randomize={"damping": (0.1, 0.2)})
    envs.reset()
    drawn = envs.env.parameters["damping"].tolist()
    assert envs.get_attr("parameters", [1, 0]) == [{"damping": d} for d in reversed(drawn)]
    assert [task.scene.mass for task in envs.get_attr("task")] == [0.1, 0.2]
    assert [scene.mass for scene in envs.get_attr("scene")] == [0.1, 0.2]


def test_adapter_shows_one_picture_of_all():
    envs = make_vec_env(ENV, 9, render_mode="rgb_array", show_tiles=4)
    envs.reset()
    (picture,) = envs.get_images()
    assert picture.ndim == 3 and envs.render().tobytes() == picture.tobytes()
    assert len(envs.env_method("render")) == 9


def test_adapter_takes_targets_by_name():
    """As the single environments do."""
    goal = {"goal_x": 0.3, "goal_y": 0.4}
    adapter, dummy = pair(arm.Reach.id)
    for envs in (adapter, dummy):
        envs.set_options({"target": goal})
    assert adapter.reset().tobytes() == dummy.reset().tobytes()
    adapter.set_options([{"target": goal | {"goal_x": x}} for x in (0.2, 0.3, 0.4)])
    adapter.reset()
    assert [target.tolist() for target in adapter.get_attr("target")] == [[x, 0.4] for x in (0.2, 0.3, 0.4)]


def test_adapter_over_wrappers():
    envs = VecEnv(ClipAction(gym.make_vec(ENV, 2, autoreset_mode="SameStep")))
    envs.reset()
    assert envs.get_attr("scene") == [envs.env.unwrapped.scene] * 2
    envs.env_method("set_state", envs.env_method("get_state")[0])
    envs.set_attr("mark", 7)
    assert envs.get_attr("mark") == [7, 7]


def test_adapter_passes_on_what_wrappers_report():
    batch = gym.make_vec(ENV, 2, autoreset_mode="SameStep", duration=0.1)
    envs = VecEnv(RecordEpisodeStatistics(batch))
    envs.reset()
    ends = [[info.get("episode", {}).get("l") for info in envs.step(np.zeros((2, 1)))[3]] for _ in range(5)]
    assert ends == [[None, None]] * 4 + [[5, 5]]
    assert envs.get_attr("episode_count") == [2, 2]


def test_adapter_refuses_other_environments():
    with pytest.raises(ValueError, match="SameStep"):
        VecEnv(gym.make_vec(ENV, 2))
    with pytest.raises(TypeError, match="a vector environment is needed, as from make_vec_env, got "):
        VecEnv(gym.make(ENV))


def test_keywords_of_stable_baselines3():
    envs, other = make_vec_env(ENV, 2, seed=3), make_vec_env(ENV, 2)
    other.seed(3)
    np.testing.assert_array_equal(envs.reset(), other.reset())
    with pytest.raises(TypeError, match="themselves in place of env_kwargs"):
        make_vec_env(ENV, 2, env_kwargs={"mass": 0.1})


def test_staggered_starts():
    """The environments then end their first episodes at different times."""
    envs = make_vec_env(ENV, 4, stagger=20, duration=0.4)
    envs.seed(1)
    first = envs.reset()
    ends = {t: np.flatnonzero(envs.step(np.zeros((4, 1), np.float32))[2]).tolist() for t in range(1, 41)}
    assert {t: e for t, e in ends.items() if e} == {t: [t // 5 % 4] for t in range(5, 41, 5)}
    envs.seed(1)
    assert envs.reset().tobytes() == first.tobytes()


def test_sb3_wrappers_and_learner_work_on_the_adapter():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = VecMonitor(make_vec_env(ENV, 4, duration=0.5))
        model = PPO("MlpPolicy", VecNormalize(ScaledReward(envs, 0.1)), n_steps=32, batch_size=64, n_epochs=1)
        model.learn(256)
    assert {e["l"] for e in model.ep_info_buffer} == {25}
    assert len(model.ep_info_buffer) == 8


# --- the demo ---


@pytest.fixture
def demonstrate(monkeypatch, capsys, tmp_path):
    """Return a function that runs the demo here; it returns the status and what was printed."""
    monkeypatch.setattr(demo, "EPISODES", 2)

    def demonstrate(*arguments):
        status = demo.main([*arguments, "--output", str(tmp_path / "run")])
        return status, "".join(capsys.readouterr())

    return demonstrate


def test_demo_trains_compares_and_shows(demonstrate, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    status, output = demonstrate("--steps", "5000", "--env", incline.Brake.id)
    assert status == 0, output
    assert "switching line" in output and "best known" in output
    comparison = json.loads((folder / "comparison.json").read_text())
    assert {"fast PPO", "random", "zero", "full damping", "switching line"} <= set(comparison["agents"])
    assert len(comparison["agents"]["fast PPO"]["returns"]) == len(set(comparison["evaluation_seeds"])) == 2
    assert (folder / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "episode.mp4").stat().st_size > 1000
    assert json.loads((folder / "result.json").read_text())["trained"] >= 5000
    # The same command evaluates it again; other settings need --new.
    (folder / "episode.mp4").unlink()
    before = (folder / "model.zip").stat().st_mtime_ns
    status, output = demonstrate("--steps", "5000", "--env", incline.Brake.id, "--no-video")
    assert status == 0 and "switching line" in output and not (folder / "episode.mp4").exists()
    assert (folder / "model.zip").stat().st_mtime_ns == before
    assert "seed 0: finished before" in output and "0 of" not in output
    # A video that fails costs no more than itself.
    (folder / "comparison.json").unlink()

    def full(*_, **options):
        raise OSError(errno.ENOSPC, "No space left on device", options["video"])

    monkeypatch.setattr(demo, "watch", full)
    status, output = demonstrate("--steps", "5000", "--env", incline.Brake.id)
    assert status == 1 and "agents.demo: error: " in output and "episode.mp4" in output
    assert "switching line" in output and (folder / "comparison.json").exists()
    (folder / "model.zip").unlink()
    status, output = demonstrate("--steps", "5000", "--env", incline.Brake.id)
    assert status == 2 and "but no model.zip; remove it to train again, or start over with --new" in output
    (folder / "model.zip").write_bytes(b"")
    status, output = demonstrate("--steps", "5000", "--env", incline.Brake.id)
    assert status == 2 and "cannot be read" in output and "train it again, with --new" in output
    status, output = demonstrate("--env", incline.Brake.id, "--seed", "5", "--steps", "5000")
    assert status == 2 and "belongs to a run with seed 0, not 5; --new starts over" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "PivotedBr-v0"], "did you mean PivotedBar-v0"),
        (["--algo", "fastppo"], "did you mean fast_ppo"),
        (["--steps", "0"], "--steps must lie between 1"),
        (["--seed", "-1"], "--seed must lie between"),
        (["--seed", "1000"], "training seeds must lie below 1000"),
    ],
)
def test_demo_says_what_is_wrong(arguments, message, demonstrate):
    status, output = demonstrate(*arguments)
    assert status == 2 and message in output and output.startswith("python -m agents.demo: error:")


def test_demo_leaves_folders_of_others_alone(demonstrate, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "model.zip").write_text("somebody's")
    status, output = demonstrate()
    assert status == 2 and "holds files but no run" in output
    assert (tmp_path / "run" / "model.zip").read_text() == "somebody's"


# --- the adapter's speed ---


def test_bench_writes_what_the_page_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "SIZES", (2,))
    monkeypatch.setattr(bench, "TRAINED", 16)
    monkeypatch.setattr(report, "ADAPTER", tmp_path / "adapter.json")
    assert bench.main(["--rounds", "1", "--output", str(report.ADAPTER)]) == 0
    assert "DummyVecEnv" in capsys.readouterr().out
    assert "| step | 2 | " in report.adapter_rates() and "| PPO | 16 | " in report.adapter_rates()
    assert bench.main(["--rounds", "0"]) == 2


# --- the scale of scores ---


def test_there_is_no_scale_unless_something_is_better_than_random_actions(monkeypatch, tmp_path):
    monkeypatch.setattr(scale, "fast_returns", lambda *_, **__: np.ones(4))
    monkeypatch.setattr(scale, "optima", lambda *_: np.ones(4))
    with pytest.raises(UserError, match=rf"{incline.Brake.id}: nothing is better than random actions.*train"):
        scale.measure_environment(incline.Brake.id, 1, True, {}, 4, 1, tmp_path)


@pytest.mark.slow
def test_scale_measures_what_is_in_use(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(scale, "BATCH", 500)
    file = tmp_path / "scale.json"
    assert scale.main([incline.Brake.id, "--batches", "2", "--output", str(file)]) == 0
    found = json.loads(file.read_text())["envs"][incline.Brake.id]
    assert found["scale"] == {k: v for k, v in known_returns(incline.Brake.id)._asdict().items()}
    found = found["measured"]
    assert list(found) == ["random", "zero", "switching line", "reference", "optimum"]
    assert {row["episodes"] for row in found.values()} == {1000}
    # The same starts: this shows how little is lost by acting at intervals.
    assert 0.0 < found["optimum"]["mean"] - found["switching line"]["mean"] < 4e-4
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines] == [incline.Brake.id] * 5
    for line in [line for line in lines if " zero " not in line]:
        mean, error, used = (float(x) for x in re.findall(r"-?\d+\.\d+", line))
        assert abs(mean - used) < 5.0 * error
    assert scale.main([cylinder_in_cylinder.Pump.id, "--quick"]) == 0
    assert "optimal" not in capsys.readouterr().out
    assert scale.main(["PivotedBra-v0"]) == 2 and scale.main(["--batches", "0"]) == 2


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (bench, ["--output"]), (scale, [ENV, "--output"]), (tune, [ENV, "--output"]),
        (race, [ENV, "--output"]), (race, [ENV, "--picture"]),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_written_is_named_before_the_work(command, arguments, tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.write_text("{")
    wrong = {taken / "new.png": "is not a writable folder", tmp_path: "is a folder"}
    if arguments[-1] == "--picture":
        wrong = {taken / "new.png": "is not a writable folder", taken: "a picture's name ends with .png"}
    for file, message in wrong.items():
        with pytest.raises(SystemExit) as left:
            command.main([*arguments, str(file)])
        assert left.value.code == 2 and message in capsys.readouterr().err
    if command is scale:
        assert scale.main([ENV, "--output", str(taken)]) == 2
        assert "taken cannot be read" in capsys.readouterr().err and taken.read_text() == "{"


@pytest.mark.parametrize("command", [ppo, train, demo])
def test_a_folder_that_cannot_be_written_is_named_before_the_work(command, tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.write_text("{")
    for folder, message in {
        taken: "is not a folder",
        taken / "x" / "y": "taken is not a writable folder",
    }.items():
        with pytest.raises(SystemExit) as left:
            command.main([*([] if command is demo else [ENV]), "--output", str(folder)])
        assert left.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.slow
def test_scale_plans_in_few_episodes(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(scale, "BATCH", 500)
    monkeypatch.setattr(scale, "PLANNED", 20)
    ids, file = [incline.Brake.id, cylinder_in_cylinder.Tilt.id], tmp_path / "scale.json"
    for env_id in ids:
        capsys.readouterr()
        assert scale.main([env_id, "--batches", "1", "--output", str(file)]) == 0
    assert list(json.loads(file.read_text())["envs"]) == ids
    (line,) = (line for line in capsys.readouterr().out.splitlines() if " iLQR " in line)
    mean, error, used = (float(x) for x in re.findall(r"-?\d+\.\d+", line))
    assert abs(mean - used) < 5.0 * error < 1.0


def test_scale_takes_learners_into_account(monkeypatch, capsys, tmp_path):
    """The best seed of each plays; the best known one keeps its numbers if it no longer exists."""
    env_id, runs, before = incline.Brake.id, tmp_path / "runs", measured_entry(incline.Brake.id)
    monkeypatch.setattr(scale, "shipped", dict)
    for seed, (push, mean) in enumerate([(-1.0, -12.0), (1.0, -2.0), (0.5, -3.0)]):
        folder = runs / env_id / "fast_ppo" / f"seed{seed}"
        folder.mkdir(parents=True)
        layer = np.zeros((1, len(TASKS[env_id]().observation)), np.float32), np.array([push], np.float32)
        Policy([layer], ()).save(folder / "model.zip")
        result = {"schema": 1, "env": env_id, "algo": "fast_ppo", "seed": seed, "trained": 1, "steps": 1}
        result |= {"wall_seconds": 1.0, "mean_return": mean, "score": 0.0, "curve": [], "hyperparameters": {}}
        (folder / "result.json").write_text(json.dumps(result | {"evaluation": {"returns": []}}))
    new = scale.measure_environment(env_id, 1, True, {}, 100, runs=runs)
    constant = make_controller(env_id, "full damping")
    expected = play(env_id, constant, range(scale.FIRST_SEED, scale.FIRST_SEED + 100)).mean()
    assert new["measured"]["fast PPO"]["mean"] == pytest.approx(expected, abs=1e-6)
    assert new["scale"]["policy"] == before["scale"]["policy"]
    best = before | {"scale": new["scale"] | {"policy": "fast PPO"}, "measured": new["measured"]}
    capsys.readouterr()
    gone = scale.measure_environment(env_id, 1, True, best, 100, runs=tmp_path / "none")
    assert gone["measured"]["fast PPO"] == new["measured"]["fast PPO"]
    assert "fast PPO             is not in" in capsys.readouterr().out
