"""Hyperparameters of learners: those of Stable-Baselines3, in the form of the RL Zoo, and our own.

A task states its own deviations (`Task.hyperparameters`). docs/agents.md has the results.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

DISCRETISE = "gymnasium.wrappers.DiscretizeAction"
#: Learners that the Zoo does not have.
OWN = ("fast_ppo", "shac", "cloning")
#: Learners with a replay buffer. A task may state deviations for all of them, as "off_policy".
OFF_POLICY = ("sac", "td3", "tqc")
#: For speed, there is one update with 256 steps for every 16 new steps. Noise is kept for some steps.
_OFF_POLICY: Mapping[str, Any] = {
    "n_envs": 16,
    "n_timesteps": 1e5,
    "buffer_size": 200_000,
    "learning_starts": 4000,
    "batch_size": 256,
    "train_freq": 1,
    "gradient_steps": 1,
    "gamma": 0.99,
    "learning_rate": 2e-3,
    "tau": 0.02,
}
_POLICY: Mapping[str, Any] = {
    "net_arch": [64, 64],
    "noise_steps": 8,
    "first_layer_scale": 3.0,
    "optimizer_kwargs": {"fused": True},
}
#: For each learner, the hyperparameters for any task.
DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    # Exploration uses noise that depends on the state (gSDE) and is kept for some steps; it moves the bar,
    # whereas noise redrawn at each step averages out. Observations are of order one already; rewards are
    # scaled by their running spread.
    "ppo": {
        "n_envs": 64,
        "n_timesteps": 5e5,
        "policy": "MlpPolicy",
        "n_steps": 64,
        "batch_size": 1024,
        "n_epochs": 10,
        "gamma": 0.995,
        "gae_lambda": 0.9,
        "learning_rate": "lin_3e-3",
        "ent_coef": 0.001,
        "max_grad_norm": 1.0,
        "use_sde": True,
        "sde_sample_freq": 4,
        "normalize": {"norm_obs": False, "norm_reward": True},
        "policy_kwargs": {
            "net_arch": {"pi": [32, 32], "vf": [128, 128]},
            "log_std_init": 0.0,
            "optimizer_kwargs": {"eps": 1e-5, "fused": True},
        },
    },
    "sac": {
        **_OFF_POLICY,
        "policy": "lag_envs.sb3_policies.SAC",
        "ent_coef": "auto",
        "policy_kwargs": _POLICY,
    },
    "td3": {
        **_OFF_POLICY,
        "policy": "lag_envs.sb3_policies.TD3",
        "policy_kwargs": {**_POLICY, "noise": 0.6},
    },
    "tqc": {
        **_OFF_POLICY,
        "policy": "lag_envs.sb3_policies.TQC",
        "ent_coef": "auto",
        "top_quantiles_to_drop_per_net": 1,
        # With 25 quantiles, the library's default, an update takes two and a half times as long.
        "policy_kwargs": {**_POLICY, "n_quantiles": 10},
    },
    # For discrete actions; a continuous control is split into 9 by Gymnasium's wrapper.
    "dqn": {
        **_OFF_POLICY,
        "policy": "MlpPolicy",
        "learning_starts": 1000,
        "learning_rate": 1e-3,
        "tau": 1.0,
        "gradient_steps": 8,
        "target_update_interval": 500,
        "exploration_fraction": 0.3,
        "exploration_final_eps": 0.02,
        "env_wrapper": [{DISCRETISE: {"bins": 9}}],
        "policy_kwargs": {"net_arch": [128, 128]},
    },
    # PPO in one file (agents/ppo.py), with the settings below. The initial weights of the first layer are
    # multiplied, because observations of order one would otherwise hardly leave the linear part of its tanh.
    "fast_ppo": {
        "n_timesteps": 4e5,
        "n_envs": 64,
        "n_steps": 96,
        "n_epochs": 3,
        "batch_size": 512,
        "learning_rate": 5e-3,
        "gamma": 0.99,
        "gae_lambda": 0.9,
        "clip_range": 0.2,
        "ent_coef": 1e-3,
        "vf_coef": 0.5,
        "max_grad_norm": 3.0,
        "reward_scale": 0.1,
        "episode_share": 0.5,
        "state_noise": True,
        "noise_steps": 4,
        "log_std_init": 0.0,
        "frames": 1,
        "actor": [32, 32],
        "critic": [64, 32],
        "first_layer_scale": 2.0,
    },
    # Learns from gradients through the environment (agents/shac.py).
    "shac": {
        "n_timesteps": 1e6,
        "n_envs": 64,
        "n_steps": 16,
        "learning_rate": 1e-2,
        "gamma": 0.99,
        "max_grad_norm": 1.0,
        "max_slope": 3.0,
        "reward_scale": 0.1,
        "episode_share": 0.5,
        "random_starts": 0.0,
        "start_ranges": {},
        "actor": [64, 64],
        "first_layer_scale": 2.0,
        "critic": [64, 64],
        "critic_rate": 3e-3,
        "critic_epochs": 4,
        "batch_size": 256,
        "td_lambda": 0.95,
    },
    # A controller cloned by a network (agents/cloning.py).
    "cloning": {
        "controller": "",
        "n_timesteps": 1.6e5,
        "n_envs": 64,
        "n_steps": 100,
        "n_updates": 100,
        "batch_size": 512,
        "learning_rate": 5e-3,
        "actor": [64, 64],
        "first_layer_scale": 2.0,
    },
}


def learners() -> list[str]:
    """Return the names of the learners."""
    return sorted(DEFAULTS)


def hyperparameters(learner: str, task: Any) -> dict[str, Any]:
    """Return a learner's hyperparameters for a task.

    Parameters
    ----------
    learner : str
        One of `learners`.
    task : Task
        The task. Discrete actions are not discretised again, nor explored by gSDE; our own learners take
        care of that themselves.

    Raises
    ------
    ValueError
        If the task states hyperparameters of a learner that does not exist.
    """
    known = [*learners(), "off_policy"]
    for name in task.hyperparameters:
        if name not in known:
            what = f"{type(task).__name__}.hyperparameters: there is no learner {name!r}"
            raise ValueError(f"{what}, only {', '.join(known)}")
    families = ["off_policy"] * (learner in OFF_POLICY) + [learner]
    found = dict(DEFAULTS[learner])
    for family in families:
        own = task.hyperparameters.get(family, {})
        if "policy_kwargs" in own:  # the policy's other settings stay
            own = {**own, "policy_kwargs": {**found.get("policy_kwargs", {}), **own["policy_kwargs"]}}
        found |= own
    if task.formulas.choices and learner not in OWN:
        found = {name: value for name, value in found.items() if name not in ("use_sde", "sde_sample_freq")}
        wrappers = [wrapper for wrapper in found.pop("env_wrapper", []) if DISCRETISE not in wrapper]
        found |= {"env_wrapper": wrappers} if wrappers else {}
    return found


def as_yaml(learner: str, tasks: Mapping[str, Any]) -> str:
    """Return the hyperparameters of tasks, by id, as a file for the RL Zoo or for ``--config``."""
    use = "for `python -m agents.train --config`" if learner in OWN else "in the form of the RL Zoo"
    lines = [f"# {learner.upper()}, {use}."]
    for env_id, task in tasks.items():
        lines.append(f"{env_id}:")
        lines += [f"  {name}: {_yaml(value)}" for name, value in hyperparameters(learner, task).items()]
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    """Return a value in YAML's flow style, which is that of JSON except for numbers such as 1e-05."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {_yaml(each)}" for name, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    return f"!!float {value!r}" if isinstance(value, float) else json.dumps(value)
