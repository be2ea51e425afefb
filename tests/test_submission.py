"""Submissions act as their numbers say, and the page about their format is right."""

import os
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save
from small_submissions import ABOUT, ENV, NET, TRAINING, built_in, learned, linear, net, network

from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.networks import bin_centres
from lag_envs.leaderboard.submission import Refused, load, write
from lag_envs.tasks import TASKS, incline

# --- what is accepted ---


def test_what_is_written_is_read(tmp_path):
    curve = {"seed": 1, "steps": [0, 500, 1000], "returns": [0.5, 1.5, 1e-3]}
    code = "https://example.org/a?b=1"
    made = learned(tmp_path / "a", code=code, description="Größe ±1", training=TRAINING | {"curves": [curve]})
    assert made.digest == load(tmp_path / "a").digest
    assert (made.env, made.name, made.authors, made.license) == (ENV, "An agent", ("A. Nobody",), "MIT")
    assert (made.kind, made.code, made.description) == ("learned", code, "Größe ±1")
    assert made.training == TRAINING | {"curves": [curve]}
    assert [seed for seed, _ in made.policies] == [0, 1, 2, 3, 4]
    for seed, policy in made.policies:
        for name, array in net(seed).items():
            assert np.array_equal(policy.arrays[name], array)
            assert not policy.arrays[name].flags.writeable


def test_numpys_numbers_are_written(tmp_path):
    curve = {"seed": np.int64(1), "steps": np.array([0, 500]), "returns": np.array([0.5, 1.5])}
    training = TRAINING | {"env_steps": np.int64(1000), "seconds": np.float32(2.5), "curves": [curve]}
    made = learned(tmp_path / "a", training=training, arrays={np.int64(s): net(s) for s in range(5)})
    assert made.training["env_steps"] == 1000 and made.training["curves"][0]["steps"] == [0, 500]
    assert [seed for seed, _ in made.policies] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("wrong", [np.ones(1, complex), np.array(["a"]), [[1.0], [1.0, 2.0]], object()])
def test_what_is_no_array_of_numbers_is_named(wrong, tmp_path):
    arrays = {s: net(s) | {"bias_0": wrong} for s in range(5)}
    with pytest.raises(Refused, match=r"arrays\[0\]\['bias_0'\] must be an array of float32 or float64, got"):
        learned(tmp_path / "a", arrays=arrays)
    with pytest.raises(Refused, match=r"submission\.toml cannot be written: .*object"):
        learned(tmp_path / "a", training=TRAINING | {"seconds": object()})
    assert not [*tmp_path.iterdir()]


def test_digest_is_of_the_bytes(tmp_path):
    first, again = learned(tmp_path / "a"), learned(tmp_path / "b")
    assert first.digest == again.digest
    assert learned(tmp_path / "c", name="Another").digest != first.digest
    arrays = {s: net(s + 1) for s in range(5)}
    assert learned(tmp_path / "d", arrays=arrays).digest != first.digest


def test_policies_may_have_any_seeds_in_any_order(tmp_path):
    made = learned(tmp_path / "a", arrays={s: net(s) for s in (999_999_999, 7, 3, 5, 10)})
    assert [seed for seed, _ in made.policies] == [3, 5, 7, 10, 999_999_999]


def test_network_is_what_the_arrays_say(tmp_path):
    rng = np.random.default_rng(0)
    arrays = net(0, (4, 6, 5, 1)) | {"obs_mean": rng.normal(size=4), "obs_var": rng.uniform(0.5, 2.0, 4)}
    policy = NET | {"hidden": [6, 5], "activation": "relu", "squash": "tanh", "mean_limit": 0.4}
    policy["normalise"] = {"epsilon": 1e-4, "clip": 1.5}
    made = network(tmp_path / "a", policy, arrays)
    agent = made.policies[0][1].agent()
    observations = rng.normal(size=(100, 4)).astype(np.float32)
    x = np.clip((observations - arrays["obs_mean"]) / np.sqrt(arrays["obs_var"] + 1e-4), -1.5, 1.5)
    for k in (0, 1):
        x = np.maximum(x @ arrays[f"weight_{k}"].T + arrays[f"bias_{k}"], 0.0)
    x = x @ arrays["weight_2"].T + arrays["bias_2"]
    wanted = np.tanh(np.clip(x, -0.4, 0.4))
    found, state = agent.predict(observations)
    assert state is None and found.dtype == np.float32
    assert np.abs(wanted).max() > 0.37 and np.abs(found - wanted).max() < 1e-6
    # Each row for itself, to the bit.
    assert np.array_equal(np.array([agent.predict(o)[0] for o in observations]), found)


@pytest.mark.parametrize("name", ["tanh", "relu", "elu", "leaky_relu", "silu", "sigmoid"])
def test_activations_are_those_of_torch(name):
    torch = pytest.importorskip("torch")
    from lag_envs.leaderboard.networks import ACTIVATIONS

    x = np.linspace(-30.0, 30.0, 1001)
    module = {"tanh": "Tanh", "relu": "ReLU", "elu": "ELU", "leaky_relu": "LeakyReLU", "silu": "SiLU"}
    wanted = getattr(torch.nn, module.get(name, "Sigmoid"))()(torch.from_numpy(x)).numpy()
    assert np.abs(ACTIVATIONS[name](x) - wanted).max() < 1e-13


def test_bins_are_those_of_gymnasium(tmp_path):
    import gymnasium as gym

    env = gym.wrappers.DiscretizeAction(gym.make(ENV), bins=7)
    np.testing.assert_allclose(bin_centres(7)[:, None], [env.action(i) for i in range(7)], atol=1e-7)
    policy = {"architecture": "mlp", "hidden": [], "bins": 7}
    arrays = {"weight_0": np.zeros((7, 4)), "bias_0": np.arange(7.0) % 5}
    made = network(tmp_path / "a", policy, arrays)
    assert made.policies[0][1].agent().predict(np.zeros(4))[0] == np.float32(bin_centres(7)[4])


def test_linear_feedback(tmp_path):
    agent = linear(tmp_path / "a").policies[0][1].agent()
    observations = np.array([[0.1, 0.2, 0.05, 0.3], [9.0, 0.0, 0.0, 0.0]], np.float32)
    assert np.allclose(agent.predict(observations)[0], [[-0.15], [-1.0]], atol=1e-7)


def test_table_of_actions(tmp_path):
    policy = {"architecture": "table", "kind": "action", "axes": ["x - target", "w", "time"]}
    axes = [np.array([-0.5, -0.1, 0.2]), np.array([-1.0, 1.0]), np.array([0.0, 0.05, 0.1])]
    x, w, t = np.meshgrid(*axes, indexing="ij")
    arrays = {f"axis_{j}": axis for j, axis in enumerate(axes)} | {"table": -x - 0.5 * w + 4.0 * t}
    agent = linear(tmp_path / "a", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    # (x, w, phi, target): inside, and far outside of two axes.
    observations = np.array([[0.2, 0.4, 0.0, 0.3], [-3.0, 5.0, 0.0, 0.0]], np.float32)
    action, state = agent.predict(observations)
    assert np.allclose(action[:, 0], [0.1 - 0.2, 0.5 - 0.5], atol=1e-6)
    action, state = agent.predict(observations, state)
    assert np.allclose(action[:, 0], [-0.1 + 0.2, 0.2], atol=1e-6)
    action, state = agent.predict(observations, state, np.array([True, False]))
    assert np.allclose(action[:, 0], [-0.1, 0.4], atol=1e-6)
    assert state.tolist() == [1.0, 3.0]


def test_mirrored_table(tmp_path):
    policy = {"architecture": "table", "kind": "action", "axes": ["x", "target"], "mirror": "target"}
    arrays = {"axis_0": np.array([-0.5, 0.5]), "axis_1": np.array([0.0, 0.3]), "table": np.zeros((2, 2))}
    arrays["table"][:] = [[0.1, 0.2], [0.3, 0.4]]
    agent = linear(tmp_path / "a", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    up = agent.predict(np.array([-0.5, 0.0, 0.0, 0.3]))[0]
    down = agent.predict(np.array([0.5, 0.0, 0.0, -0.3]))[0]
    assert up == pytest.approx(0.2) and down == -up


def test_table_of_values_looks_one_step_ahead(tmp_path):
    """With a value that only asks for x to grow, the plane is tilted as hard as can be."""
    policy = {"architecture": "table", "kind": "value", "axes": ["x"]}
    arrays = {"axis_0": np.array([-1.0, 1.0]), "table": np.array([-1e6, 1e6])}
    agent = linear(tmp_path / "a", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    observation = np.array([[0.0, 0.1, 0.0, 0.2]] * 2)
    first = agent.predict(observation)[0]
    arrays["table"] *= -1.0
    agent = linear(tmp_path / "b", policy=policy, arrays={0: arrays}).policies[0][1].agent()
    assert (agent.predict(observation)[0] == -first).all() and (np.abs(first) == 1.0).all()


@pytest.mark.parametrize("numbers", [{}, {"frequency": 3.0, "lag": 1}])
def test_controller_is_the_built_in_one(tmp_path, numbers):
    from lag_envs.controllers import TiltPD

    made = built_in(tmp_path / "a", numbers=numbers)
    observations = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 4))
    wanted = TiltPD(TASKS[ENV](), **numbers).predict(observations)[0]
    assert np.array_equal(made.policies[0][1].agent().predict(observations)[0], wanted)
    assert os.listdir(tmp_path / "a") == ["submission.toml"]


def test_every_controller_of_every_environment_can_be_submitted(tmp_path):
    from lag_envs.controllers import controllers

    policy = {"architecture": "controller"}
    for env in ("PivotedBar-v0", incline.Brake.id):
        for i, name in enumerate(controllers(TASKS[env])):
            about = ABOUT | {"env": env, "policy": policy | {"name": name}}
            write(tmp_path / f"{env}{i}", **about)


def test_writing_refuses_and_leaves_nothing(tmp_path):
    with pytest.raises(Refused, match="1 to 60 characters"):
        linear(tmp_path / "a", name="x" * 61)
    assert os.listdir(tmp_path) == []
    linear(tmp_path / "a")
    with pytest.raises(FileExistsError):
        linear(tmp_path / "a")
    assert os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"authors": "Ann"}, r'authors must be a list, such as \["Ann"\], got \'Ann\''),
        ({"policy": "linear"}, "policy must be a table, such as .* got 'linear'"),
        ({"arrays": [1]}, "arrays must be a mapping of training seeds .* got a list of 1"),
        ({"arrays": {0: [1]}}, r"arrays\[0\] must be a mapping of names"),
        ({"training": "none"}, "training must be a table"),
        ({"env": incline.Tilt}, "env must be an environment's id"),
        ({"license": None}, "license must be a text, got None"),
    ],
)
def test_writing_tells_what_is_wanted(tmp_path, given, told):
    with pytest.raises(Refused, match=told):
        linear(tmp_path / "a", **given)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("license", "kept"),
    [("MIT", "MIT"), ("apache-2.0 or mit", "Apache-2.0 OR MIT"), ("LicenseRef-x", "LicenseRef-x")],
)
def test_licences_are_those_of_spdx(tmp_path, license, kept):
    assert linear(tmp_path / "a", license=license).license == kept


# --- the page about the format ---


def test_page_shows_submissions_that_are_accepted(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "submissions.md").read_text(encoding="utf-8")
    first, ahead, named = (part.split("```")[0] for part in text.split("```toml\n")[1:])
    start = first.replace('"learned"', '"controller"').split("[training]")[0]
    whole, planned, built = (tmp_path / name for name in ("whole", "planned", "built-in"))
    for folder, about in (
        (whole, first),
        (planned, start.replace("schema = 1", "schema = 2") + ahead),
        (built, start + named),
    ):
        folder.mkdir()
        (folder / "submission.toml").write_text(about, encoding="utf-8")
    for seed in range(5):
        (whole / f"policy_{seed}.safetensors").write_bytes(save(net(seed, (3, 32, 32, 1))))
    assert len(load(whole).policies) == 5
    assert load(planned).architecture.plans
    assert load(built).policies[0][1].agent().catch == 5.0


def test_page_tells_the_limits():
    text = (Path(__file__).parents[1] / "docs" / "submissions.md").read_text(encoding="utf-8")
    p = protocol
    for told in (
        f"{p.TOML_BYTES // 1024} KiB, lines of {p.LINE:,} characters",
        f"{p.POLICY_BYTES // 2**20} MiB, {p.FOLDER_BYTES // 2**20} MiB",
        f"{p.MOST_POLICIES}; of kind `learned` at least {p.LEARNED_POLICIES}",
        f"{p.LAYERS} hidden layers of width {p.WIDTH:,}, {p.NUMBERS:,} numbers",
        f"{p.FRAMES} frames, a memory of {p.MEMORY}",
        f"{p.CURVE} points",
    ):
        assert told in text
    from lag_envs.leaderboard.networks import ACTIVATIONS
    from lag_envs.leaderboard.policies import ARCHITECTURES

    assert all(f"`{name}`" in text for name in (*ACTIVATIONS, *ARCHITECTURES))
