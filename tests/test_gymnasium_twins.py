"""Gymnasium's environments with exact motion: spaces, rewards, endings, and policies in both."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from rollouts import make

from lag_envs.controllers import make_controller
from lag_envs.mechanics.recording import parameter_names, parameter_values
from lag_envs.report.gymnasium_peers import PEERS
from lag_envs.tasks import TASKS
from lag_envs.tasks.cart_pole import CartPoleExact
from lag_envs.tasks.pendulum import PendulumExact, wrapped
from tools.docs import energy

each_pair = pytest.mark.parametrize(("env_id", "peer_id"), energy.with_peer().items())


def test_all_three_are_there():
    assert set(energy.with_peer().values()) == set(PEERS)


@each_pair
def test_spaces_and_length_are_gymnasiums(env_id, peer_id):
    twin, original = gym.make(env_id), gym.make(peer_id)
    assert twin.observation_space == original.observation_space
    assert twin.action_space == original.action_space
    assert twin.spec.max_episode_steps == original.spec.max_episode_steps
    assert twin.unwrapped.task.dt == PEERS[peer_id].step(original.unwrapped)


@each_pair
def test_scene_and_starts_are_gymnasiums(env_id, peer_id):
    task, original = TASKS[env_id](), gym.make(peer_id).unwrapped
    scene = PEERS[peer_id].scene(original)
    assert parameter_values(scene) == {name: getattr(task.scene, name) for name in parameter_names(scene)}
    order = list(PEERS[peer_id].order)
    starts = []
    for seed in range(300):
        original.reset(seed=seed)
        starts.append(np.array(original.state)[order])
    far = np.abs(np.array(starts) - task.centre) / np.array(task.half_widths)
    assert (far <= 1.0 + 1e-6).all() and (far.max(axis=0) > 0.98).all()


@each_pair
def test_steps_pay_and_end_as_gymnasiums(env_id, peer_id):
    """From the same states with the same actions: reward and ending, and roughly the motion."""
    twin, original = make(env_id), gym.make(peer_id, disable_env_checker=True).unwrapped
    peer, rng = PEERS[peer_id], np.random.default_rng(0)
    order, half = list(peer.order), np.array(twin.task.half_widths)
    ends = 0
    for _ in range(200):
        state = twin.task.centre + rng.uniform(-1.0, 1.0, len(half)) * np.minimum(half * 30.0, 3.0)
        if peer_id == "CartPole-v1":  # near enough to the limits to pass them now and then
            state = rng.uniform(-1.0, 1.0, 4) * [2.4, 2.0, 0.209, 3.0]
        twin.reset(seed=0, options={"state": state})
        original.reset(seed=0)
        original.state = state[np.argsort(order)]
        action = twin.action_space.sample()
        _, reward, terminated, _, _ = twin.step(action)
        _, their_reward, their_end, _, _ = original.step(action)
        assert twin.control == pytest.approx(peer.control(original, action), abs=1e-7)
        moved, off = np.abs(twin.state - state), twin.state - np.array(original.state)[order]
        wraps = [i for i, unit in enumerate(twin.scene.state_units) if unit == "rad"]
        off[wraps] -= 2.0 * np.pi * np.rint(off[wraps] / (2.0 * np.pi))
        assert np.abs(off).max() < 0.5 * max(moved.max(), 0.1)
        if terminated == their_end:
            assert reward == pytest.approx(their_reward, rel=1e-6)
            ends += terminated
    assert ends > 5 or peer_id == "Pendulum-v1"


@each_pair
def test_one_policy_in_both(env_id, peer_id):
    """A controller runs unchanged in both, with the same return."""
    agent = make_controller(env_id, TASKS[env_id].reference)
    original, twin = (energy.returns(name, agent, 40) for name in (peer_id, env_id))
    errors = [returns.std(ddof=1) / np.sqrt(len(returns)) for returns in (original, twin)]
    assert abs(original.mean() - twin.mean()) < 4.0 * np.hypot(*errors) + 1e-9
    assert min(original.mean(), twin.mean()) > {"CartPole-v1": 499.0, "Pendulum-v1": -250.0}.get(
        peer_id, -120.0
    )


@pytest.mark.slow
def test_a_policy_trained_there_runs_here():
    ppo = pytest.importorskip("stable_baselines3").PPO
    peer_id, env_id = CartPoleExact.peer, CartPoleExact.id
    model = ppo(
        "MlpPolicy", gym.make(peer_id), n_steps=512, batch_size=256, gae_lambda=0.8, gamma=0.98,
        n_epochs=20, learning_rate=1e-3, seed=0, device="cpu",
    )  # fmt: skip
    model.learn(25_600)
    assert min(energy.returns(name, model, 20).mean() for name in (peer_id, env_id)) > 300.0


@each_pair
def test_energy_is_kept_here_and_not_there(env_id, peer_id):
    found = energy.paths(env_id)
    (_, original), (_, twin) = found[peer_id], found[env_id]
    assert np.ptp(twin) < 1e-9 * np.abs(twin).max() < 1e-2 * np.ptp(original)


def test_only_the_observed_speed_is_clipped():
    env = make(PendulumExact.id)
    observation, _ = env.reset(seed=0, options={"state": [2.0, 12.0]})
    assert observation[2] == 8.0 and env.state[1] == 12.0
    observation, reward, *_ = env.step(np.zeros(1, np.float32))
    assert observation[2] == 8.0 and env.state[1] > 11.0
    assert reward == pytest.approx(-(2.0**2 + 0.1 * 12.0**2), rel=1e-12)


def test_what_cannot_be_seen_at_the_end_is_clipped():
    env = make(CartPoleExact.id)
    env.reset(seed=0, options={"state": [2.39, 100.0, 0.2, 60.0]})
    observation, reward, terminated, *_ = env.step(1)
    assert terminated and reward == 1.0 and env.observation_space.contains(observation)
    assert env.state[2] > env.observation_space.high[2] == observation[2]


def test_the_wrapped_angle():
    angles = np.concatenate([np.linspace(-9.0, 9.0, 2001), np.pi * np.arange(-4, 5) / 2.0, [1e-300, -1e-17]])
    for angle in angles:
        found = wrapped(np.cos(angle), np.sin(angle), np)
        off = angle - found
        assert abs(found) <= np.pi and off == pytest.approx(
            2.0 * np.pi * np.rint(off / (2.0 * np.pi)), abs=4e-15
        )
