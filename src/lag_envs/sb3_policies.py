"""Policies of Stable-Baselines3's SAC, TD3 and TQC that explore with noise kept for some steps.

Noise redrawn at each step averages out before it has moved anything heavy. Here each environment keeps its
draw for `noise_steps` steps. The learning itself is the library's.

`agents.train` and the RL Zoo take these policies by name, as in ``policy: lag_envs.sb3_policies.SAC``.
"""

from __future__ import annotations

from typing import Any

import torch
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import Tensor, nn


class _KeptNoise(BasePolicy):
    """The common part of the policies; their networks use tanh unless `activation_fn` is given.

    Parameters
    ----------
    *args, **kwargs
        Arguments of the library's policy.
    noise_steps : int, default 8
        Number of steps for which noise is kept.
    first_layer_scale : float, default 3
        Factor of the initial weights of observations, in the first layers of actor and critics. Without it,
        observations of order one hardly leave the linear part of a tanh.

    Raises
    ------
    ValueError
        For a number that is out of range.
    """

    actor: Any
    critic: Any
    critic_target: Any

    def __init__(
        self, *args: Any, noise_steps: int = 8, first_layer_scale: float = 3.0, **kwargs: Any
    ) -> None:
        if noise_steps < 1 or not first_layer_scale > 0.0:
            raise ValueError(
                "noise_steps must be at least 1 and first_layer_scale positive, "
                f"got {noise_steps} and {first_layer_scale}"
            )
        self.noise_steps, self.first_layer_scale = noise_steps, first_layer_scale
        self._noise, self._steps = torch.zeros(0), 0
        super().__init__(*args, **{"activation_fn": nn.Tanh, **kwargs})

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)  # type: ignore[misc]  # all of the library's policies have it
        for actor in (self.actor, getattr(self, "actor_target", None)):
            if actor is not None:
                self._widen(getattr(actor, "latent_pi", actor.mu))
        for critic in (self.critic, self.critic_target):
            for network in critic.q_networks:
                self._widen(network)

    def _widen(self, network: Any) -> None:
        with torch.no_grad():
            network[0].weight[:, : self.actor.features_dim] *= self.first_layer_scale

    def _kept(self, like: Tensor) -> Tensor:
        """Return standard normal noise of a tensor's shape, kept for several calls."""
        if self._steps % self.noise_steps == 0 or self._noise.shape != like.shape:
            self._noise = torch.randn_like(like)
        self._steps += 1
        return self._noise


class _Stochastic(_KeptNoise):
    """A policy whose network determines the noise's standard deviation."""

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        mean, log_std, _ = self.actor.get_action_dist_params(observation)
        return torch.tanh(mean if deterministic else mean + log_std.exp() * self._kept(mean))


class SAC(_Stochastic, SACPolicy):
    """SAC's policy."""


class TQC(_Stochastic, TQCPolicy):
    """TQC's policy."""


class TD3(_KeptNoise, TD3Policy):
    """TD3's policy.

    Parameters
    ----------
    *args, **kwargs
        Arguments of the library's policy, and of the other policies here.
    noise : float, default 0.3
        Standard deviation of the noise, for actions in [-1, 1].
    """

    def __init__(self, *args: Any, noise: float = 0.3, **kwargs: Any) -> None:
        if not noise >= 0.0:
            raise ValueError(f"noise must not be negative, got {noise}")
        self.noise = noise
        super().__init__(*args, **kwargs)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        action = self.actor(observation)
        return action if deterministic else (action + self.noise * self._kept(action)).clamp(-1.0, 1.0)
