"""Trained models and our own agents become submissions that act alike."""

import argparse
import json
import math
import shutil

import numpy as np
import pytest
from covering import slow
from small_submissions import ABOUT, ENV, network

from agents import measure
from agents.run import CHECKPOINT
from lag_envs import sb3_policies
from lag_envs.errors import UserError
from lag_envs.leaderboard import export
from lag_envs.leaderboard.sb3_models import ModelPolicy
from lag_envs.leaderboard.submission import load, write
from lag_envs.tasks import TASKS, cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.record import Goal

SLOW = pytest.mark.slow


def model(algo, seed=0, bins=0, frames=0, normalise=False, env_id=ENV, **options):
    """Return an untrained model with steep layers, and its normalisation, as a training would leave them."""
    sb3 = pytest.importorskip("stable_baselines3")
    import gymnasium as gym
    import torch
    from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

    import lag_envs  # noqa: F401  (registers the environments)

    def make():
        env = gym.make(env_id)
        return gym.wrappers.DiscretizeAction(env, bins=bins) if bins else env

    torch.set_num_threads(1)
    env = DummyVecEnv([make])
    env = VecFrameStack(env, frames) if frames else env
    if normalise:
        env = VecNormalize(env)
        env.seed(seed)
        env.reset()
        for _ in range(20):
            env.step(np.array([env.action_space.sample()]))
    place = pytest.importorskip("sb3_contrib") if algo == "TQC" else sb3
    if algo in ("SAC", "TD3", "TQC", "DQN", "DDPG"):
        options["buffer_size"] = 10
    kind = options.pop("kind", "MlpPolicy")
    made = getattr(place, algo)(kind, env, seed=seed, device="cpu", **options)
    for parameter in made.policy.parameters():
        parameter.data *= 2.0
    return made, env if normalise else None


# --- export ---


@pytest.mark.parametrize(
    ("algo", "options"),
    [
        ("PPO", {"use_sde": True, "normalise": True}),
        ("PPO", {"use_sde": True, "policy_kwargs": {"squash_output": True, "net_arch": [8, 5]}}),
        ("PPO", {"bins": 5, "policy_kwargs": {"net_arch": []}}),
        ("PPO", {"frames": 3, "normalise": True}),
        slow("DQN", {"frames": 2, "bins": 5, "policy_kwargs": {"net_arch": [8]}}),
        pytest.param("A2C", {}, marks=SLOW),
        ("SAC", {"use_sde": True, "policy_kwargs": {"net_arch": [16, 16]}}),
        pytest.param("SAC", {"normalise": True, "policy_kwargs": {"net_arch": [16]}}, marks=SLOW),
        ("TD3", {"policy_kwargs": {"net_arch": [16, 16]}}),
        ("TQC", {"kind": sb3_policies.TQC, "policy_kwargs": {"net_arch": [16, 16]}}),
        pytest.param("DDPG", {"policy_kwargs": {"net_arch": [16, 16]}}, marks=SLOW),
        slow("TQC", {"use_sde": True, "policy_kwargs": {"net_arch": [16, 16]}}),
        ("DQN", {"bins": 9, "normalise": True, "policy_kwargs": {"net_arch": [16, 16]}}),
    ],
)
def test_export_acts_as_the_model(algo, options, tmp_path):
    made, normalise = model(algo, **options)
    made.save(tmp_path / "model.zip")
    # A policy of our own does not tell what it was trained by; its training's result does.
    result = {"algo": algo.lower()} if "kind" in options else None
    found = export.algorithm_of(export.Source(tmp_path / "model.zip", result=result))
    assert found == {"DDPG": "td3"}.get(algo, algo.lower())
    frames = options.get("frames", 1)
    table, arrays = export.convert(made, TASKS[ENV](), normalise, frames)
    agent = network(tmp_path / "a", table, arrays).policies[0][1].agent()
    policy = ModelPolicy(made, TASKS[ENV](), normalise, frames)
    off, count = export.difference(policy, agent, ENV)
    assert off <= 1e-5 and count == 16_384
    if algo == "SAC" and "use_sde" in options:
        assert table["mean_limit"] == 2.0
    assert table.get("frames", 1) == frames
    # A change that can be felt is noticed.
    arrays["weight_0"] = -arrays["weight_0"]
    agent = network(tmp_path / "b", table, arrays).policies[0][1].agent()
    assert export.difference(policy, agent, ENV)[0] > 1e-3


@pytest.mark.parametrize("algo", ["PPO", "DQN"])
def test_export_of_a_model_that_chooses_what_the_environment_lists(algo, tmp_path, monkeypatch):
    env = next(env_id for env_id, task in TASKS.items() if len(task().formulas.choices) == 1)
    monkeypatch.setattr(TASKS[env], "goal", Goal("success: none is asked for", hold=None))  # gives it a board
    made, _ = model(algo, env_id=env, policy_kwargs={"net_arch": [8]})
    table, arrays = export.convert(made, TASKS[env]())
    assert not {"bins", "squash"} & set(table)
    agent = network(tmp_path / "a", table, arrays, env=env).policies[0][1].agent()
    policy = ModelPolicy(made, TASKS[env]())
    assert export.difference(policy, agent, env) == (0.0, 16_384)
    arrays["weight_0"] = -arrays["weight_0"]
    agent = network(tmp_path / "b", table, arrays, env=env).policies[0][1].agent()
    assert export.difference(policy, agent, env)[0] == 1.0


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Five finished runs, as `agents.train` leaves them."""
    above = tmp_path_factory.mktemp("runs") / ENV / "ppo"
    for seed in range(5):
        made, normalise = model("PPO", seed, normalise=True)
        folder = above / f"seed{seed}"
        folder.mkdir(parents=True)
        made.save(folder / "model.zip")
        normalise.save(folder / "vecnormalize.pkl")
        result = {
            "env": ENV, "seed": seed, "trained": 500, "wall_seconds": 2.0 + seed, "machine": "abacus",
            "curve": [[0, 0.0, 1.0], [500, 1.0, 2.0], [500, 1.1, 3.0]],
        }  # fmt: skip
        (folder / "result.json").write_text(json.dumps(result))
    return above


def export_command(*arguments):
    parser = argparse.ArgumentParser()
    export.declare_export(parser)
    return export.run_export(parser.parse_args([str(a) for a in arguments]))


def test_command_exports_the_runs_of_a_folder(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert export_command(runs, "--author", "A", "--author", "B", "--license", "MIT") == 0
    assert "largest difference" in capsys.readouterr().out
    made = load(tmp_path / f"{ENV}-PPO")
    assert (made.env, made.name, made.authors, made.kind) == (ENV, "PPO", ("A", "B"), "learned")
    curves = [{"seed": s, "steps": [0, 500], "returns": [1.0, 3.0]} for s in range(5)]
    assert made.training == {"env_steps": 500, "seconds": 4.0, "hardware": "abacus", "curves": curves}
    assert made.policies[0][1].architecture.normalise.model_dump() == {"epsilon": 1e-8, "clip": 10.0}
    # So they are measured, to the bit: in chaotic motion a rounding makes other episodes.
    seen = np.random.default_rng(0).normal(size=(100, len(TASKS[ENV]().observation))).astype(np.float32)
    for seed, policy in made.policies:
        measured = measure._policy(ENV, runs / f"seed{seed}").predict(seen)[0]
        assert measured.tobytes() == policy.agent().predict(seen)[0].tobytes()


def network_file(folder):
    """Write a network of our own."""
    file = folder / "model.zip"
    with file.open("wb") as there:
        np.savez(there, choices=False, weight_0=np.zeros((1, 4)), bias_0=np.zeros(1))
    return file


@pytest.mark.parametrize(
    ("algo", "name"), [("fast_ppo", "fast PPO"), ("cloning", "cloning"), ("shac", "SHAC"), (None, "PPO")]
)
def test_networks_of_our_own_are_called_by_their_learners(algo, name, tmp_path):
    source = export.Source(network_file(tmp_path), result={"algo": algo} if algo else None)
    assert export._name(source, None) == name
    with pytest.raises(export.ExportError, match="--algo is for models of Stable-Baselines3"):
        export.exported(source, ENV, "sac")


@pytest.mark.parametrize(("option", "value"), [("frames", 4), ("algo", "sac"), ("normalise", "norm.pkl")])
def test_options_for_models_are_refused_for_networks(option, value, tmp_path):
    given = ["--author", "A", "--license", "MIT", "--env", ENV, "--name", "x", "--seconds", 1]
    with pytest.raises(UserError, match=f"--{option} is for models of Stable-Baselines3; .* holds a network"):
        export_command(network_file(tmp_path), *given, f"--{option}", value)


def test_command_exports_files(runs, tmp_path):
    files = [runs / f"seed{s}" / "model.zip" for s in range(5)]
    norms = [file.with_name("vecnormalize.pkl") for file in files]
    given = [*files, "--author", "A", "--license", "MIT", "--output", tmp_path / "out"]
    with pytest.raises(UserError, match="give --env"):
        export_command(*given, "--normalise", *norms)
    given += ["--env", ENV]
    with pytest.raises(UserError, match="give --seconds"):
        export_command(*given, "--normalise", *norms)
    given += ["--seconds", 5]
    with pytest.raises(UserError, match="one file for each path"):
        export_command(*given, "--normalise", norms[0])
    with pytest.raises(
        UserError, match=rf"takes 4 numbers; {incline.Brake.id} has . per observation\. Is --env right"
    ):
        export_command(*given, "--env", incline.Brake.id)
    with pytest.raises(UserError, match="there is no environment 'x'"):
        export_command(*given, "--env", "x")
    assert not (tmp_path / "out").exists()
    export_command(*given, "--normalise", *norms, "--name", "Mine")
    assert load(tmp_path / "out").name == "Mine"
    with pytest.raises(UserError, match="already exists"):
        export_command(*given)


def test_models_that_cannot_be_exported(runs, tmp_path):
    torch = pytest.importorskip("torch")
    made, _ = model("PPO", policy_kwargs={"activation_fn": torch.nn.Hardswish})
    with pytest.raises(export.ExportError, match="all activations must be one of"):
        export.convert(made, TASKS[ENV]())
    with pytest.raises(
        export.ExportError, match=rf"takes 4 numbers; {ENV} has 4 per observation, 12 in 3 frames\. Is --env"
    ):
        export.convert(made, TASKS[ENV](), frames=3)
    with pytest.raises(export.ExportError, match="is neither a model nor a folder"):
        export.find([tmp_path])
    source = export.Source(tmp_path / "x.zip")
    source.model.write_bytes(b"no zip")
    with pytest.raises(export.ExportError, match="nor a model of Stable-Baselines3"):
        export.export([source], tmp_path / "a", authors=["A"], license="MIT", env=ENV, seconds=1)
    with pytest.raises(export.ExportError, match="at least 5 policies"):
        export.export(export.find([runs / "seed0"]), tmp_path / "a", authors=["A"], license="MIT")
    for content in (b"", b"no zip"):
        source.model.write_bytes(content)
        with pytest.raises(export.ExportError, match=r"x\.zip is neither a network of ours nor a model of"):
            export.algorithm_of(source)
        assert export.arrays_of(source.model) is None
    for arrays in ({"weight_0": np.ones((4, 1))}, {"weight_0": np.ones(1), "bias_0": np.array("a")}):
        with source.model.open("wb") as file:
            np.savez(file, choices=np.zeros(0), **arrays)
        with pytest.raises(export.ExportError, match=r"x\.zip is damaged: it should hold weight_0, bias_0"):
            export.arrays_of(source.model)
    made, _ = model("PPO")
    with torch.no_grad():
        made.policy.action_net.weight[0, 0] = math.nan
    made.save(source.model)
    with pytest.raises(export.ExportError, match=r"x\.zip: weight_\d has entries that are not finite"):
        export.exported(source, ENV)
    (tmp_path / "norm.pkl").write_bytes(b"")
    with pytest.raises(export.ExportError, match=r"norm\.pkl cannot be read for PPO: EOFError"):
        export.exported(export.Source(source.model, tmp_path / "norm.pkl"), ENV)
    made, _ = model("PPO", policy_kwargs={"net_arch": [7]})
    made.save(tmp_path / "other.zip")
    sources = [*export.find([runs / "seed0"]), export.Source(tmp_path / "other.zip")]
    with pytest.raises(export.ExportError, match="networks differ"):
        export.export(sources, tmp_path / "a", authors=["A"], license="MIT", seconds=1.0)


def test_a_run_that_is_not_finished_is_named(runs, tmp_path):
    shutil.copytree(runs, tmp_path / "runs")
    assert len(export.find([tmp_path / "runs"])) == len(export.find([runs]))
    (tmp_path / "runs" / "seed9").mkdir()
    (tmp_path / "runs" / "seed9" / CHECKPOINT).touch()
    with pytest.raises(export.ExportError, match=r"seed9: not finished; resume the training, or name"):
        export.find([tmp_path / "runs"])


# --- our own agents ---


@pytest.mark.parametrize("env", [pivoted_bar.SwingUpFree.id, cylinder_in_cylinder.Pump.id, incline.Tilt.id])
def test_optimal_table_is_the_value_function(env, tmp_path):
    pytest.importorskip("tqdm")
    from dataclasses import replace as replaced

    from agents.solution import GreedyPolicy, Solution
    from agents.submit import tabulate

    problem = TASKS[env].value_iteration
    axes = tuple(replaced(axis, level=0.25) for axis in problem.axes)
    problem = replaced(problem, axes=axes, targets=(0.0, 0.3)[: len(problem.targets)])
    solution = Solution(env, 0.25, folder=None, quiet=True, problem=problem)
    policy, arrays = tabulate(solution)
    about = ABOUT | {"env": env, "policy": policy, "arrays": {0: arrays}}
    agent = write(tmp_path / "a", **about).policies[0][1].agent()
    rng = np.random.default_rng(0)
    nodes = np.stack([rng.choice(axis, 200) for axis in solution.programs[0].grid.axes], axis=1)
    targets = rng.choice([-0.3, 0.0, 0.3], 200) if problem.targets else np.zeros(200)
    if problem.targets:
        nodes[:, 0] += targets
    wanted = solution.expected(1, nodes, targets if problem.targets else None)
    found = agent.value(nodes, targets, np.zeros(200))
    inside = np.abs(nodes[:, 0]) < 0.4 if problem.targets else np.ones(200, np.bool_)
    most = (0.05 if problem.targets else 1e-5) * (wanted.max() - wanted.min())
    assert (nodes < 0.0).any() and inside.sum() > 50
    assert np.abs(found - wanted)[inside].max() < most
    if env == pivoted_bar.SwingUpFree.id:
        theta, theta_dot = rng.uniform(-3.0, 3.0, (2, 200))
        seen = np.stack([np.cos(theta), np.sin(theta), theta_dot / 8.0], axis=1)
        acting, best = agent.predict(seen)[0], GreedyPolicy(env, solution=solution).predict(seen)[0]
        assert (np.abs(acting - best) < 1e-6).mean() > 0.9


def test_all_agents_are_submitted(runs, tmp_path, monkeypatch, capsys):
    pytest.importorskip("tqdm")
    from agents.submit import main
    from lag_envs.controllers import controllers

    shutil.copytree(runs, tmp_path / "runs" / ENV / "ppo")
    (tmp_path / "runs" / ENV / "sac" / "seed0").mkdir(parents=True)
    (tmp_path / "runs" / ENV / "sac" / "seed0" / "model.zip").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    assert main(["out", "--envs", ENV]) == 0
    assert "left out: it has 1 finished" in capsys.readouterr().out
    found = {load(folder).name for folder in (tmp_path / "out").iterdir()}
    assert found == {*controllers(TASKS[ENV]), "PPO"}
    assert main(["out", "--envs", ENV]) == 0
    assert main(["out", "--envs", "Nothing"]) == 2
