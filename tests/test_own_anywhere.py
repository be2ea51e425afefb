"""The tutorial's example in other libraries: videos, workers, learners, clusters."""

import os
import threading
from pathlib import Path

import gymnasium as gym
import numpy as np
import own_tasks
import pytest
from rollouts import RENDERS

import lag_envs

EXAMPLES = Path(__file__).parents[1] / "examples"
ID = "ball_on_beam:BallOnBeam-v0"
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (15, 2, 1)).astype(np.float32)


@pytest.fixture(autouse=True)
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    for folder in (Path(__file__).parent, EXAMPLES):  # for child processes
        monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)


def rolled(envs):
    seen = [envs.reset(seed=3)[0]]
    for actions in ACTIONS:
        seen.append(envs.step(actions)[0])
    envs.close()
    return np.array(seen)


@pytest.mark.slow
def test_workers_that_are_spawned_give_the_same_numbers():
    native = gym.make_vec(ID, num_envs=2)
    workers = gym.make_vec(ID, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    np.testing.assert_array_equal(rolled(native), rolled(workers))


def test_workers_take_a_class_that_stands_in_a_function():
    class Here(own_tasks.Drift):
        id = "OwnHere-v0"

    lag_envs.register(Here)
    envs = gym.make_vec(
        "OwnHere-v0",
        2,
        vectorization_mode="async",
        vector_kwargs={"context": "spawn", "shared_memory": False},
    )
    observations, _ = envs.reset(seed=1)
    one, _ = gym.make("OwnHere-v0").reset(seed=1)
    envs.close()
    np.testing.assert_array_equal(observations[0], one)


@pytest.mark.slow
@pytest.mark.skipif(not RENDERS, reason="needs pygame")
def test_video(tmp_path):
    env = gym.wrappers.RecordVideo(
        gym.make(ID, render_mode="rgb_array", duration=0.2), str(tmp_path / "videos")
    )
    env.reset(seed=0)
    while not env.step(np.zeros(1, np.float32))[3]:
        pass
    env.close()
    assert [f.stat().st_size > 1000 for f in (tmp_path / "videos").glob("*.mp4")] == [True]


def test_linear_quadratic_regulator():
    pytest.importorskip("sympy")
    from lag_envs.controllers.linear import regulator

    env = gym.make(ID, target=0.0).unwrapped
    gain, _ = regulator(env.task, [0.0] * 4, extra={"u": 0.1})
    env.reset(options={"state": [0.05, 0.0, 0.0, 0.0]})
    for _ in range(400):
        env.step(np.array([-gain @ env.state], np.float64))
    assert np.abs(env.state).max() < 1e-3


def test_threads_give_the_same_bits():
    found = {}

    def roll(name):
        found[name] = rolled(gym.make_vec(ID, num_envs=2))

    gym.make(ID).close()  # registers it: Gymnasium's registration is not thread-safe
    threads = [threading.Thread(target=roll, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(found[0], found[i]) for i in range(4))


@pytest.mark.slow
def test_learner_with_workers_that_are_spawned():
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    envs = make_vec_env(ID, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "spawn"}, seed=0)
    model = PPO("MlpPolicy", envs, n_steps=32, batch_size=32, n_epochs=1, device="cpu").learn(64)
    assert model.num_timesteps == 64
    envs.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_ray():
    ray = pytest.importorskip("ray")

    def roll(class_):
        import gymnasium
        import numpy

        import lag_envs

        lag_envs.register(class_)
        env = gymnasium.make(class_.id, disable_env_checker=True)
        seen, _ = env.reset(seed=5)
        return numpy.asarray(seen)

    class Here(own_tasks.Drift):
        id = "OwnHere-v0"

    ray.init(num_cpus=1, include_dashboard=False, configure_logging=False)
    try:
        there = ray.get(ray.remote(roll).remote(Here))
    finally:
        ray.shutdown()
    here = roll(Here)
    np.testing.assert_array_equal(there, here)
