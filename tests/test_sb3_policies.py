"""Policies for Stable-Baselines3 that keep their noise for some steps."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from lag_envs import sb3_policies

POLICIES = {"SAC": SACPolicy, "TD3": TD3Policy, "TQC": TQCPolicy}
SPACES = gym.spaces.Box(-10.0, 10.0, (5,)), gym.spaces.Box(-1.0, 1.0, (2,))


def make(kind, **options):
    torch.manual_seed(0)
    return kind(*SPACES, lambda _: 1e-3, net_arch=[16, 16], **options)


def own_policy(name, **options):
    return make(getattr(sb3_policies, name), **options)


@pytest.fixture
def observations():
    return torch.as_tensor(np.random.default_rng(0).normal(size=(4, 5)), dtype=torch.float32)


@pytest.mark.parametrize("name", POLICIES)
def test_noise_is_kept_and_then_drawn_anew(name, observations):
    policy = own_policy(name, noise_steps=3)
    with torch.no_grad():
        taken = [policy._predict(observations) for _ in range(7)]
    same = [torch.equal(a, b) for a, b in pairwise(taken)]
    assert same == [True, True, False, True, True, False]
    one = observations[:1].expand(4, -1)  # each environment has its own noise
    with torch.no_grad():
        assert len(policy._predict(one).unique(dim=0)) == 4
        assert len(policy._predict(observations[:2])) == 2  # another number of environments: new noise


@pytest.mark.parametrize("name", POLICIES)
def test_without_noise_it_is_the_librarys_policy(name, observations):
    policy = own_policy(name, first_layer_scale=1.0)
    original = make(POLICIES[name], activation_fn=nn.Tanh)
    with torch.no_grad():
        expected = original._predict(observations, True)
        torch.testing.assert_close(policy._predict(observations, True), expected, rtol=0.0, atol=0.0)
    scaled = own_policy(name, first_layer_scale=3.0)
    with torch.no_grad():
        wide = original._predict(3.0 * observations, True)
        inputs = torch.cat([observations, torch.full((4, 2), 0.3)], dim=1)
        tripled = torch.cat([3.0 * observations, torch.full((4, 2), 0.3)], dim=1)
        # Biases stay, and so do a critic's weights for actions.
        torch.testing.assert_close(scaled._predict(observations, True), wide)
        for mine, other in zip(scaled.critic.q_networks, original.critic.q_networks, strict=True):
            torch.testing.assert_close(mine(inputs), other(tripled))
        for mine, target in zip(scaled.critic.parameters(), scaled.critic_target.parameters(), strict=True):
            assert torch.equal(mine, target)


@pytest.mark.parametrize("name", ["SAC", "TQC"])
def test_what_is_drawn_is_what_is_learnt_from(name):
    """Actions have the distribution whose likelihood the learner computes: the network's mean and spread."""
    policy = own_policy(name, noise_steps=1)
    many = torch.full((20_000, 5), 0.2)
    with torch.no_grad():
        mean, log_std, _ = policy.actor.get_action_dist_params(many[:1])
        drawn = (torch.atanh(policy._predict(many).double()) - mean) / log_std.exp()
    assert torch.all(drawn.mean(0).abs() < 0.03)
    assert torch.all((drawn.std(0) - 1.0).abs() < 0.02)


def test_noise_of_td3():
    policy = own_policy("TD3", noise=0.2, noise_steps=1)
    many = torch.full((20_000, 5), 0.2)
    with torch.no_grad():
        centre, drawn = policy._predict(many, True), policy._predict(many)
        assert torch.all(((drawn - centre).std(0) - 0.2).abs() < 0.01)
        assert own_policy("TD3", noise=5.0)._predict(many).abs().max() == 1.0


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("SAC", {"noise_steps": 0}, "noise_steps must be at least 1"),
        ("TQC", {"first_layer_scale": 0.0}, "first_layer_scale positive, got 8 and 0.0"),
        ("TD3", {"first_layer_scale": float("nan")}, "first_layer_scale positive, got 8 and nan"),
        ("TD3", {"noise": -0.1}, "noise must not be negative, got -0.1"),
    ],
)
def test_bad_numbers(name, options, message):
    with pytest.raises(ValueError, match=message):
        own_policy(name, **options)
