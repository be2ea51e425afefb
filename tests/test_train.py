"""The training script: learners, checkpoints, parallel seeds, Ray, and users' mistakes."""

import errno
import io
import json
import os
import pickle
import re
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from covering import slow
from rollouts import one_by_one
from trainings import go, kill_and_interrupt, short_evaluations

from agents import learners, run, train
from agents.learners import ALGORITHMS, load_policy, zoo_hyperparameters
from agents.run import Run, UserError
from lag_envs import cli, own_files, sb3
from lag_envs.evaluation.rollout import play
from lag_envs.hyperparams import OFF_POLICY, as_yaml
from lag_envs.scores import known_returns
from lag_envs.tasks import TASKS, incline
from lag_envs.tasks.arm import Reach
from lag_envs.tasks.cart_pole import CartPoleExact

ROOT = Path(__file__).parents[1]
ENV = incline.Tilt.id
#: Hyperparameters for a training that takes a second.
SHORT = {
    "ppo": {"n_envs": 4, "n_steps": 32, "batch_size": 64, "n_epochs": 2},
    "sac": {"n_envs": 4, "learning_starts": 40, "batch_size": 16, "train_freq": 4, "gradient_steps": 1},
}
SHORT |= {name: SHORT["sac"] for name in ("tqc", "dqn")} | {"td3": SHORT["sac"] | {"n_steps": 3}}


short = short_evaluations(3)


def make_run(folder, algo="ppo", env_id=ENV, steps=400, **more):
    hyper = zoo_hyperparameters(algo, env_id) | SHORT[algo] | more
    return Run(Path(folder), env_id, algo, 3, steps, hyper)


@pytest.fixture
def command(capsys, tmp_path):
    """Return a function that runs the script here; it returns the status and what was printed."""

    def command(*arguments):
        status = train.main([*arguments, "--output", str(tmp_path)])
        return status, "".join(capsys.readouterr())

    return command


@pytest.fixture
def config(tmp_path):
    """Return a file of hyperparameters with which a run takes seconds."""
    file = tmp_path / "short.yml"
    entry = {name: value for name, value in zoo_hyperparameters("ppo", ENV).items() if name != "env_wrapper"}
    file.write_text(yaml.safe_dump({ENV: entry | SHORT["ppo"] | {"n_timesteps": 400}}))
    return file


# --- learners ---


@pytest.mark.parametrize(
    "algo",
    # TQC is SAC with another critic, and the slowest.
    [slow(a) if a == "tqc" else a for a in ALGORITHMS],
)
def test_every_learner_goes_on_from_its_checkpoint(algo, tmp_path):
    cut = make_run(tmp_path / "cut", algo, normalize=True)
    curve, before = [], None
    for until in (150, 300):
        assert not go(cut, until)
        assert cut.load_result() is None
        cut = make_run(tmp_path / "cut", algo, normalize=True)
        content = cut.load_checkpoint()
        model = learners.thaw(cut, content)
        # Weights, optimiser, normalisation and memory are restored, and training continues.
        normalise, buffer = pickle.loads(content["normalisation"]), pickle.loads(content["buffer"])
        assert model.get_vec_normalize_env().obs_rms.mean.tolist() == normalise.obs_rms.mean.tolist()
        assert (buffer is None) == (algo == "ppo") and model.num_timesteps == cut.trained
        if buffer is not None:
            assert model.replay_buffer.size() == buffer.size() > 0
            assert getattr(model.replay_buffer, "n_steps", 1) == SHORT[algo].get("n_steps", 1)
            assert np.array_equal(model.replay_buffer.observations, buffer.observations)
        weights = [w.detach().numpy().copy() for w in model.policy.parameters()]
        assert before is None or not all(map(np.array_equal, before, weights))
        assert len(cut.curve) > len(curve) and cut.curve[: len(curve)] == curve
        curve, before = list(cut.curve), weights
    assert go(cut)
    first = json.loads((tmp_path / "cut" / run.RESULT).read_text())
    assert len(first["evaluation"]["returns"]) == 3
    assert first["curve"][: len(curve)] == [list(point) for point in curve] and len(first["curve"]) > len(
        curve
    )
    assert (
        first["trained"] >= 400
        and first["versions"]["torch"]
        and first["hyperparameters"] == cut.hyperparameters
    )
    assert not cut.path(run.CHECKPOINT).exists()
    # The written policy acts like the evaluated one, one by one and together.
    policy = load_policy(tmp_path / "cut")
    returns = play(ENV, policy, run.fresh_seeds(3))
    assert returns.tolist() == first["evaluation"]["returns"]
    one = one_by_one(ENV, policy, [run.FIRST_FRESH_SEED])
    np.testing.assert_allclose(one, returns[:1], rtol=1e-4)


@pytest.mark.parametrize(("algo", "kept"), [("sac", 1), ("ppo", -1)])
def test_off_policy_learners_keep_what_did_best_in_a_test(algo, kept, tmp_path, monkeypatch):
    means = iter([1.0, 7.0, 3.0, 2.0, 4.0, 0.0, 0.0])
    monkeypatch.setattr(learners, "play", lambda env, policy, seeds: np.full(len(seeds), next(means)))
    cut = make_run(tmp_path, algo)
    assert not go(cut, 300) and len(cut.curve) >= 2
    going = make_run(tmp_path, algo)  # the second test was the best, and is from before the interruption
    file = io.BytesIO(going.load_checkpoint()["best"]["model"])
    weights = learners.learner(algo).load(file, device="cpu").policy.state_dict()
    assert go(going)
    result = json.loads(going.path(run.RESULT).read_text())
    assert result["policy_of_step"] == result["curve"][kept][0]
    found = load_policy(tmp_path).model.policy.state_dict()
    same = [bool((w == weights[name]).all()) for name, w in found.items()]
    assert all(same) == (kept == 1)


def test_normalised_observations_belong_to_the_policy(tmp_path):
    going = make_run(tmp_path, normalize=True)
    go(going)
    policy = load_policy(tmp_path)
    assert policy.normalise is not None
    expected = json.loads(going.path(run.RESULT).read_text())["evaluation"]["returns"]
    assert play(ENV, policy, run.fresh_seeds(3)).tolist() == expected
    policy.normalise = None
    assert play(ENV, policy, run.fresh_seeds(3)).tolist() != expected


def test_a_policy_may_see_several_observations_side_by_side(tmp_path):
    going = make_run(tmp_path, frame_stack=3, env_wrapper=[])
    assert not go(going, 150)
    going = make_run(tmp_path, frame_stack=3, env_wrapper=[])
    assert go(going)
    policy, expected = load_policy(tmp_path), json.loads(going.path(run.RESULT).read_text())["evaluation"]
    assert policy.model.observation_space.shape == (3 * len(TASKS[ENV]().observation),)
    returns = one_by_one(ENV, policy, run.fresh_seeds(3))
    np.testing.assert_allclose(returns, expected["returns"], rtol=1e-4)
    with pytest.raises(UserError, match="frame_stack does not go with normalised observations"):
        go(make_run(tmp_path / "other", frame_stack=3, normalize=True))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_hyperparameters_are_there_for_every_environment(algo):
    entries = yaml.safe_load(printed(algo))
    assert list(TASKS) == list(entries)
    for env_id in TASKS:
        entry = zoo_hyperparameters(algo, env_id)
        assert entries[env_id] == entry  # in the Zoo's form they are the same
        assert entry["n_timesteps"] >= 1e4
        learners.check_hyperparameters(algo, entry)
        policy = f"lag_envs.sb3_policies.{algo.upper()}" if algo in OFF_POLICY else "MlpPolicy"
        assert entry["policy"] == policy


def test_a_task_changes_parts_of_the_policys_settings(monkeypatch):
    task = TASKS[ENV]
    own = {"off_policy": {"policy_kwargs": {"noise_steps": 4}}, "td3": {"policy_kwargs": {"noise": 0.1}}}
    usual = zoo_hyperparameters("td3", ENV)["policy_kwargs"]
    monkeypatch.setattr(task, "hyperparameters", own)
    assert zoo_hyperparameters("td3", ENV)["policy_kwargs"] == usual | {"noise_steps": 4, "noise": 0.1}


def test_learners_refuse_what_they_do_not_know(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="did you mean tqc"):
        zoo_hyperparameters("tqd", ENV)
    with monkeypatch.context() as changed:
        changed.setattr(TASKS[ENV], "hyperparameters", {"fast_poo": {"gamma": 0.9}})
        with pytest.raises(UserError, match=r"there is no learner 'fast_poo', only .*, fast_ppo, "):
            zoo_hyperparameters("ppo", ENV)
    for changes, message in (
        ({"gama": 0.9}, "ppo has no hyperparameter 'gama'; did you mean gamma"),
        ({"env_wrapper": [{"gymnasium.wrappers.ClipReward": {}}]}, "wrapper .*ClipReward is not known"),
        ({"env_wrapper": [{learners.TIME_LIMIT: {"steps": 3}}]}, "TimeLimit: {max_episode_steps: ...}"),
    ):
        with pytest.raises(UserError, match=message):
            go(make_run(tmp_path, **changes))
    file = tmp_path / "bad.yml"
    for text, message in (
        ("a: [", "cannot be read"),
        ("[1, 2]", "map ids to hyperparameters, got a list; `lag-envs hyperparams ppo` prints"),
        ("a: 1", f"no entry for {ENV}, only for a"),
        (f"{ENV}: 3", f"bad.yml: the entry for {ENV} must map names to values, got 3"),
        (f"{ENV}: {{}}", f"bad.yml, entry {ENV}: n_timesteps is missing"),
        (f"{ENV}: {{n_timesteps: 100}}", "policy is missing; `lag-envs hyperparams ppo` prints complete"),
        (f"{ENV}: {{n_timestep: 100}}", "no hyperparameter 'n_timestep'; did you mean n_timesteps"),
        (f"{ENV}: {{gamma: high}}", f"entry {ENV}: gamma: Input should be a valid number, got 'high'"),
        (f"{ENV}: {{n_envs: 2.5}}", "n_envs: Input should be a valid integer, got 2.5"),
        (f"{ENV}: {{policy: 1}}", "policy: Input should be a valid string, got 1"),
        (f"{ENV}: {{n_envs: 0}}", "n_envs: Input should be greater than or equal to 1, got 0"),
        (
            f"{ENV}: {{n_envs: 1000000000}}",
            "n_envs: Input should be less than or equal to 100000, got 1000000000",
        ),
        (f"{ENV}: {{frame_stack: -1}}", "frame_stack: Input should be greater than or equal to 1, got -1"),
        (f"{ENV}: {{normalize: {{foo: 1}}}}", "normalize has no hyperparameter 'foo'; available: training"),
        (f"{ENV}: {{normalize: {{clip_obs: x}}}}", "clip_obs: Input should be a valid number, got 'x'"),
        (f"{ENV}: {{normalize: {{gamma: 0.9}}}}", "normalize has no hyperparameter 'gamma'"),
        (f"{ENV}: {{normalize: yes please}}", "normalize: Input should be a valid boolean, got 'yes please'"),
        (
            f"{ENV}: {{env_kwargs: {{mass: 1}}}}",
            "env_kwargs would change the environment of training, but not",
        ),
        (f"{ENV}: {{env_wrapper: a.B}}", "env_wrapper: Input should be a valid list, got 'a.B'"),
        (
            f"{ENV}: {{env_wrapper: [{{{learners.TIME_LIMIT}: {{max_episode_steps: abc}}}}]}}",
            "TimeLimit: max_episode_steps: Input should be a valid integer, got 'abc'",
        ),
        (
            f"{ENV}: {{vec_env_wrapper: [{{{learners.SCALE}: {{factor: abc}}}}]}}",
            "ScaledReward: factor: Input should be a valid number, got 'abc'",
        ),
    ):
        file.write_text(text)
        with pytest.raises(UserError, match=re.escape(message)):
            zoo_hyperparameters("ppo", ENV, file)
    file.write_text(f"{ENV}: {{policy: 1}}")
    with pytest.raises(UserError, match=r"bad.yml, entry .*: settings of fast_ppo: policy is an unknown key"):
        zoo_hyperparameters("fast_ppo", ENV, file)


@pytest.mark.parametrize("algo", ["ppo", "fast_ppo"])
def test_a_training_that_diverges_is_told_in_a_line(algo, tmp_path):
    hyper = zoo_hyperparameters(algo, ENV) | SHORT["ppo"] | {"learning_rate": 1e9}
    failure = train.train_run(Run(tmp_path, ENV, algo, 3, 400, hyper), lambda event: None)
    assert not failure.passing
    assert re.fullmatch(
        r"the training diverged \(seed 3, after [0-9]+ steps\): lower learning_rate", failure.reason
    )


@pytest.mark.parametrize(("algo", "returns"), [("ppo", -np.inf), ("fast_ppo", np.nan)])
def test_a_reward_that_is_no_number_is_not_called_divergence(algo, returns, tmp_path, monkeypatch):
    monkeypatch.setattr(learners, "play", lambda env, policy, seeds: np.full(len(seeds), returns))
    hyper = zoo_hyperparameters(algo, ENV) | SHORT["ppo"]
    with pytest.raises(UserError, match=f"the reward of {ENV} is {returns}; it must be a finite number"):
        go(Run(tmp_path, ENV, algo, 3, 400, hyper))


@pytest.mark.parametrize("algo", ["ppo", "td3"])
def test_nor_is_one_that_only_exploration_meets(algo, tmp_path, monkeypatch):
    step = sb3.VecEnv.step_wait

    def undefined(self):
        observations, rewards, *rest = step(self)
        rewards[1] = np.nan
        return observations, rewards, *rest

    monkeypatch.setattr(sb3.VecEnv, "step_wait", undefined)
    with pytest.raises(UserError, match=f"the reward of {ENV} is nan"):
        go(make_run(tmp_path, algo, normalize=True))


# --- damaged and foreign files ---


def test_checkpoints_of_others_and_damaged_ones_are_refused(tmp_path):
    begun = make_run(tmp_path)
    go(begun, 150)
    data = begun.path(run.CHECKPOINT).read_bytes()
    for other, message in (
        (make_run(tmp_path, steps=500), "steps 400, not 500"),
        (make_run(tmp_path, gamma=0.9), r"other hyperparameters \(gamma\)"),
        (make_run(tmp_path, env_id=incline.Brake.id), f"env '{ENV}', not"),
    ):
        with pytest.raises(UserError, match=message):
            go(other)
    flipped = bytearray(data)
    flipped[-100] ^= 1
    for damaged in (b"", b"nonsense", data[: len(data) // 2], bytes(flipped)):
        begun.path(run.CHECKPOINT).write_bytes(damaged)
        with pytest.raises(UserError, match=r"checkpoint.pkl cannot be read .*--new starts over"):
            go(make_run(tmp_path))
    begun.path(run.CHECKPOINT).write_bytes(
        data[len(run.DIGEST) + 32 :]
    )  # as versions without digest wrote it
    assert make_run(tmp_path).load_checkpoint() is not None
    begun.path(run.CHECKPOINT).write_bytes(data)
    assert go(make_run(tmp_path))


RESULT = {
    "schema": 1, "env": ENV, "algo": "ppo", "seed": 3, "steps": 400, "hyperparameters": {}, "trained": 400,
    "wall_seconds": 1.0, "mean_return": 1.0, "score": None, "curve": [[0, 0.0, 1.0]],
    "evaluation": {"returns": [1.0]},
}  # fmt: skip


@pytest.mark.parametrize(
    "content",
    [
        "{", "[]", '{"schema": 0}', '{"schema": 1, "evaluation": {"returns": 1}}',
        *(json.dumps(RESULT | {name: ["?"]}) for name in RESULT),
        *(json.dumps(RESULT | {"curve": curve}) for curve in ([1], [[1, 2]], [[1, 2, "3"]])),
    ],
)  # fmt: skip
def test_a_damaged_result_is_named(content, tmp_path):
    (tmp_path / run.RESULT).write_text(json.dumps(RESULT))
    assert run.read_result(tmp_path / run.RESULT) == RESULT
    (tmp_path / run.RESULT).write_text(content)
    with pytest.raises(UserError, match=r"result.json cannot be read"):
        make_run(tmp_path).load_result()
    with pytest.raises(UserError, match=r"result.json cannot be read"):
        load_policy(tmp_path)


def test_what_is_no_folder_of_a_run_is_named(tmp_path):
    (tmp_path / run.MODEL).touch()
    for given, message in (
        (str(tmp_path), f"there is no finished run in {tmp_path}: it has no result.json"),
        (tmp_path / "x", f"there is no finished run in {tmp_path / 'x'}"),
        (tmp_path / run.MODEL, f"model.zip is a file; give the folder in which it lies, {tmp_path}"),
    ):
        with pytest.raises(UserError, match=re.escape(message)):
            load_policy(given)


def test_a_damaged_model_is_named(tmp_path):
    going = make_run(tmp_path, steps=100)
    go(going)
    going.path(run.MODEL).write_bytes(b"nonsense")
    with pytest.raises(UserError, match=r"the policy in .* cannot be read"):
        load_policy(tmp_path)


def test_a_full_disk_loses_nothing_that_was_saved(tmp_path, monkeypatch):
    going = make_run(tmp_path)
    go(going, 150)
    saved = going.path(run.CHECKPOINT).read_bytes()

    def full(self, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    events = []
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        some = train.train_run(make_run(tmp_path), events.append)
        nothing = train.train_run(make_run(tmp_path / "new"), events.append)
    assert "No space left on device" in some.reason and "what was saved before is kept" in some.reason
    assert "No space left on device" in nothing.reason and "kept" not in nothing.reason
    assert some.passing and nothing.passing
    assert going.path(run.CHECKPOINT).read_bytes() == saved
    assert go(make_run(tmp_path))


# --- the command ---


@pytest.mark.parametrize(
    ("error", "status", "told"),
    [
        (OSError(errno.EROFS, "Read-only file system", "runs/x"), 1, ("x: error: ", "Read-only", "runs/x")),
        (KeyboardInterrupt(), 130, ()),
    ],
)
def test_refusals_of_the_system_are_told_in_a_line(error, status, told, capsys):
    @run.reports_errors("x")
    def main(arguments):
        raise error

    assert main([]) == status
    output = capsys.readouterr().err.strip()
    assert all(word in output for word in told) and "\n" not in output


def test_a_reader_that_leaves_ends_a_command_quietly():
    script = (
        "from agents import run\n"
        "@run.reports_errors('x')\n"
        "def main(arguments):\n"
        "    while True: print('line', flush=True)\n"
        "raise SystemExit(main([]))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"},
    )  # fmt: skip
    process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait(60) == 0
    process.stderr.close()


def test_a_result_without_its_model_is_not_finished(command, tmp_path):
    folder = tmp_path / ENV / "ppo" / "seed3"
    folder.mkdir(parents=True)
    about = {"hyperparameters": zoo_hyperparameters("ppo", ENV)}
    (folder / run.RESULT).write_text(json.dumps(RESULT | about))
    given = [ENV, "--first-seed", "3", "--steps", "400"]
    status, output = command(*given)
    assert status == 2 and "but no model.zip; remove it to train again, or start over with --new" in output
    (folder / run.MODEL).write_bytes(b"")
    assert command(*given)[0] == 0


@pytest.mark.slow
def test_seeds_side_by_side(command, config, tmp_path):
    """Two seeds train, a third one cannot."""
    folder = tmp_path / ENV / "ppo"
    folder.mkdir(parents=True)
    (folder / "seed2").write_text("in the way")
    arguments = (ENV, "--config", str(config))
    status, output = command(*arguments, "--seeds", "3")
    assert status == 1 and "seed 2 failed: " in output and "To resume:" in output
    assert "seed 0: finished, return" in output and "seed 1: finished, return" in output
    results = [json.loads((folder / f"seed{k}" / run.RESULT).read_text()) for k in range(2)]
    assert results[0]["evaluation"]["returns"] != results[1]["evaluation"]["returns"]
    assert list(folder.glob("seed1/tensorboard/*/events*"))
    # Finished seeds are left as they are.
    before = (folder / "seed0" / run.MODEL).stat().st_mtime_ns
    status, output = command(*arguments, "--seeds", "2")
    assert status == 0 and output.count("finished before") == 2
    assert (folder / "seed0" / run.MODEL).stat().st_mtime_ns == before
    (folder / "seed1" / run.RESULT).write_text("{")
    status, output = command(*arguments, "--seeds", "2")
    assert status == 2 and "result.json cannot be read" in output


@pytest.mark.slow
def test_killed_and_interrupted_runs_go_on(config, tmp_path):
    output = kill_and_interrupt(
        "agents.train", ENV, "--steps", "30000", "--config", str(config), "--jobs", "1",
        "--output", str(tmp_path),
    )  # fmt: skip
    assert f"agents.train {ENV}" in output
    content = Run(
        tmp_path / ENV / "ppo" / "seed0", ENV, "ppo", 0, 30000, zoo_hyperparameters("ppo", ENV, config)
    )
    assert content.load_checkpoint() is not None and content.trained >= 3700 and len(content.curve) >= 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["PivotedBra-v0"], "did you mean PivotedBar-v0"),
        ([ENV, "--algo", "sacc"], "did you mean sac"),
        ([ENV, "--seeds", "0"], "--seeds must lie between 1"),
        ([ENV, "--steps", "-5"], "--steps must lie between 1"),
        ([ENV, "--first-seed", "1000"], "training seeds must lie below 1000, so that no two share"),
        ([ENV, "--seeds", "1001"], "no two share an episode; got up to 1000"),
        ([ENV, "--config", "nowhere.yml"], "nowhere.yml cannot be read"),
        ([CartPoleExact.id, "--algo", "ppo", "sac"], "sac needs continuous actions; CartPole"),
        (
            [Reach.id, "--algo", "dqn"],
            f"dqn needs one discrete action; {Reach.id} has several; available: ppo, sac",
        ),
    ],
)
def test_mistakes_are_named(arguments, message, command):
    status, output = command(*arguments)
    assert status == 2 and message in output and output.startswith("python -m agents.train: error:")


def test_steps_without_an_end_are_refused(command, config):
    config.write_text(f"{ENV}: {{n_timesteps: .inf, policy: MlpPolicy}}")
    status, output = command(ENV, "--config", str(config))
    assert status == 2 and "n_timesteps must be a number of steps, got inf" in output


@pytest.mark.parametrize(
    ("module", "words"), [("train", ("result.json", "--ray")), ("demo", ("model.zip", "--new"))]
)
def test_help_is_quick(module, words):
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", f"agents.{module}", "--help"], cwd=ROOT, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
    )  # fmt: skip
    assert done.returncode == 0 and all(word in done.stdout for word in words)
    assert time.perf_counter() - started < 20.0


# --- other libraries ---


@pytest.mark.slow
# Other tests load JAX, which warns about any fork in this process; Ray's forks only start programs.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_on_a_local_ray_cluster(command, config, tmp_path):
    arguments = (ENV, "--seeds", "2", "--config", str(config))
    status, output = command(*arguments, "--ray", "local")
    assert status == 0, output
    here = [tmp_path / ENV / "ppo" / f"seed{k}" for k in range(2)]
    returns = [json.loads((f / run.RESULT).read_text())["evaluation"]["returns"] for f in here]
    assert load_policy(here[1]).predict(np.zeros(4, np.float32))[0].shape == (1,)
    # The same numbers as without Ray.
    status, _ = command(*arguments, "--new")
    assert status == 0
    assert [json.loads((f / run.RESULT).read_text())["evaluation"]["returns"] for f in here] == returns


def test_only_what_may_succeed_later_is_resumed(capsys):
    lasting, passing = train.Failure("no such luck"), train.Failure("a full disk", passing=True)
    for failed, stopped, status in (({"a": lasting}, False, 1), ({"a": lasting, "b": passing}, False, 1),
                                    ({}, True, 130)):  # fmt: skip
        assert train.report_failures(failed, stopped, "agents.train", [ENV, "--new"]) == status
        output = capsys.readouterr()
        assert ("a failed: no such luck" in output.err) == ("a" in failed)
        resumed = re.search(f"To resume: .* -m agents.train {ENV}\n", output.out)
        assert bool(resumed) == (stopped or "b" in failed)


def test_digits_are_as_many_as_the_standard_error_allows():
    known = known_returns(ENV)
    returns = known.random + (known.best - known.random) * np.array([0.8, 1.0, 1.0, 0.8])
    mean, value = train.with_errors(ENV, returns)
    assert value == "0.900 ± 0.058" and re.fullmatch(r"\d+\.\d ± \d+\.\d|\d+ ± \d\d", mean)
    assert train.with_errors("OwnDrift-v0", [1.0, 1.0]) == ("1.00 ± 0.00", "")


def test_a_missing_ray_is_named(command, config):
    status, output = command(ENV, "--config", str(config), "--ray", "127.0.0.1:1")
    assert status == 2 and ("pip install" in output or "no Ray cluster at" in output)


# --- the RL Zoo ---


def printed(algo):
    return as_yaml(algo, {env_id: task() for env_id, task in TASKS.items()})


def test_hyperparams_prints_a_file_of_the_zoo(capsys):
    for algo in ALGORITHMS:
        assert cli.main(["hyperparams", algo]) == 0
        assert capsys.readouterr().out == printed(algo)
    assert cli.main(["hyperparams", "sacc"]) == 2
    assert "did you mean sac" in capsys.readouterr().err


def test_hyperparameters_name_what_the_package_brings():
    """The Zoo imports the wrappers by name, without a clone."""
    for algo in ALGORITHMS:
        for entry in yaml.safe_load(printed(algo)).values():
            for wrapper in entry.get("env_wrapper", []) + entry.get("vec_env_wrapper", []):
                module, _, name = next(iter(wrapper)).rpartition(".")
                assert module in ("gymnasium.wrappers", "lag_envs.sb3")
                assert hasattr(import_module(module), name)


def test_any_script_of_the_zoo_finds_the_environments(tmp_path):
    """A script that, like `record_video`, neither imports packages nor takes --gym-packages."""
    (tmp_path / "rl_zoo3").mkdir()
    (tmp_path / "rl_zoo3" / "__init__.py").write_text("")
    script = (
        "import sys; from gymnasium.envs import registry; print(*sys.argv[1:], 'PivotedBar-v0' in registry)"
    )
    (tmp_path / "rl_zoo3" / "record_video.py").write_text(f"if __name__ == '__main__':\n    {script}\n")

    def zoo(*arguments, path=tmp_path):
        return subprocess.run(
            [sys.executable, "-m", "lag_envs.zoo", *arguments], cwd=tmp_path, capture_output=True, text=True,
            env=os.environ | {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{path}"},
        )  # fmt: skip

    for given in (["-n", "5"], ["-n", "5", "--gym-packages", "json"]):
        done = zoo("record_video", *given)
        assert done.stdout.split() == ["-n", "5", "True"], done.stderr
    done = zoo("record_vide")
    assert done.returncode == 1 and "no script 'record_vide'" in done.stderr and "Trace" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_zoo_trains_shows_and_films(algo, tmp_path):
    def zoo(module, *arguments):
        done = subprocess.run(
            [sys.executable, "-m", *module, "--algo", algo, "--env", ENV, "-f", "logs", *arguments],
            cwd=tmp_path, capture_output=True, text=True,
            env=os.environ | {"PYTHONPATH": str(ROOT / "src"), "SDL_VIDEODRIVER": "dummy"},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    config = tmp_path / "config.yml"
    config.write_text(printed(algo))
    packages = ["--gym-packages", "lag_envs"]
    train = ["--conf-file", "config.yml", "-n", "200", "--eval-freq", "-1", "-P"]
    zoo(["rl_zoo3.train"], *packages, *train)
    assert list(tmp_path.glob(f"logs/{algo}/{ENV}_1/{ENV}.zip"))
    assert "Episode Reward" in zoo(["rl_zoo3.enjoy"], *packages, "-n", "600")
    zoo(["lag_envs.zoo", "record_video"], *packages, "-n", "20")
    assert list(tmp_path.glob(f"logs/{algo}/{ENV}_1/videos/*.mp4"))


# --- users' environments ---

BALL, SEVERAL = ROOT / "examples" / "ball_on_beam.py", ROOT / "tests" / "own_tasks.py"


@pytest.fixture
def beside_the_example(monkeypatch):
    """Put the example's folder on the path, here and in the workers, and forget its registration."""
    monkeypatch.syspath_prepend(str(BALL.parent))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(BALL.parent), *filter(None, sys.path)]))
    yield
    for name in ("own_ball_on_beam", "own_own_tasks"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("given", "env_id"),
    [
        slow(str(BALL), "BallOnBeam-v0"),
        slow("ball_on_beam:BallOnBeam-v0", "BallOnBeam-v0"),
        # It chooses among three actions.
        slow(f"{SEVERAL}:Switched", "OwnSwitched-v0"),
        # It has two controls and two targets. The quick version is fast PPO's training in test_add_task.py.
        slow(f"{SEVERAL}:Deliver", "OwnCrane-v0"),
    ],
)
def test_ppo_trains_on_an_environment_of_ones_own(given, env_id, beside_the_example, tmp_path):
    arguments = [given, "--steps", "4096", "--output", str(tmp_path)]
    assert train.main(arguments) == 0
    result = json.loads((tmp_path / env_id / "ppo" / "seed0" / "result.json").read_text())
    assert result["env"] == env_id and result["trained"] == 4096 and result["score"] is None
    assert ("use_sde" in result["hyperparameters"]) == (env_id != "OwnSwitched-v0")
    policy = load_policy(tmp_path / env_id / "ppo" / "seed0")
    returns = play(env_id, policy, run.fresh_seeds(100))
    np.testing.assert_allclose(returns.mean(), result["mean_return"], rtol=1e-6)
    assert train.main(arguments) == 0  # finished before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([str(SEVERAL)], "has several tasks: name one"),
        (["nowhere.py"], "there is no file nowhere.py"),
        (["no_module:Id-v0"], "there is no environment 'no_module:Id-v0': No module named 'no_module'"),
        (["ball_on_beam:Other-v0"], "there is no environment 'ball_on_beam:Other-v0'"),
        ([str(BALL), "--ray", "local"], "a file does not exist on the other machines"),
        slow([f"{SEVERAL}:Switched", "--algo", "sac"], "continuous actions; OwnSwitched-v0 has discrete"),
        slow([f"{SEVERAL}:Deliver", "--algo", "dqn"], "needs one discrete action; OwnCrane-v0 has several"),
        slow([f"{SEVERAL}:Drift"], "OwnDrift-v0 has no control: there is nothing to learn"),
    ],
)
def test_mistakes_with_ones_own_are_named(arguments, message, beside_the_example, tmp_path, capsys):
    status = train.main([*arguments, "--steps", "100", "--output", str(tmp_path)])
    assert status == 2 and message in "".join(capsys.readouterr())


SLED = """
from sled import Sled

import lag_envs
from lag_envs.tasks import Task


class Slide(Task):
    id = "OwnSlide-v0"
    scene = Sled
    interval, steps = 0.1, 30
    action = {"push": 1.0}
    start = {"x": 0.5}

    def observe(self, after, target, xp):
        return {"x": after.x, "x_dot": after.x_dot}

    def reward(self, before, after, control, target, dt, xp):
        return -after.x**2


lag_envs.register(Slide)
"""
SCENE = """
from lag_envs.scenes import Scene


class Sled(Scene):
    coordinates = {"x": "m"}
    controls = {"push": "N"}

    def kinetic(self, q, v, xp):
        return 0.5 * v.x**2

    def potential(self, q, xp):
        return 0.0

    def applied(self, q, v, u, xp):
        return {"x": u.push}
"""


@pytest.mark.parametrize("edited", ["slide.py", "sled.py"])
@pytest.mark.parametrize("given", ["slide.py", "slide.py:Slide", "slide:OwnSlide-v0"])
def test_a_task_that_was_edited_is_another_one(given, edited, tmp_path, monkeypatch):
    (tmp_path / "slide.py").write_text(SLED)
    (tmp_path / "sled.py").write_text(SCENE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    args = train.parser().parse_args([given, "--algo", "fast_ppo"])
    try:
        (begun,) = train.planned_runs(args)
        begun.save_checkpoint({})
        assert train.planned_runs(args)[0].settings == begun.settings
        (tmp_path / edited).write_text((tmp_path / edited).read_text() + "\n")
        with pytest.raises(UserError, match=f"pkl belongs to another version of {given}; --new starts over"):
            train.planned_runs(args)
        args.new = True
        assert train.planned_runs(args)[0].digest != begun.digest
    finally:
        own_files.load_module.cache_clear()
        gym.registry.pop("OwnSlide-v0", None)
        for name in ("slide", "sled", "own_slide"):
            sys.modules.pop(name, None)
    assert "digest" not in make_run(tmp_path).settings  # a task of the package is known by its id
