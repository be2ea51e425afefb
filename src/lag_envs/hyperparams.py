"""Hyperparameters of learners: of Stable-Baselines3's in the form of the RL Zoo, and of our own.

A task says what differs for it (`Task.hyperparameters`). Measured at these steps; see docs/agents.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

DISCRETISE = "gymnasium.wrappers.DiscretizeAction"
#: Learners that the Zoo does not know.
OWN = ("fast_ppo", "shac", "cloning")
_OFF_POLICY: Mapping[str, Any] = {
    "n_envs": 4,
    "n_timesteps": 4e4,
    "policy": "MlpPolicy",
    "buffer_size": 100_000,
    "learning_starts": 1000,
    "batch_size": 256,
    "gamma": 0.99,
    "learning_rate": 1e-3,
}
#: Exploration as PPO's, kept for half a second. SAC draws it anew whenever it learns: so it learns as seldom,
#: by as many steps at once.
_SAC: Mapping[str, Any] = {
    **_OFF_POLICY,
    "train_freq": 25,
    "gradient_steps": 50,
    "tau": 0.02,
    "ent_coef": "auto",
    "use_sde": True,
    "sde_sample_freq": 25,
    "policy_kwargs": {"net_arch": [64, 64], "log_std_init": 0.0},
}
#: By learner what any task is trained with.
DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    # Exploration by noise that depends on the state (gSDE) and is kept for some steps moves the bar where
    # noise drawn anew at each step averages out. Observations are of order one already; rewards are scaled by
    # their running spread.
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
    "sac": _SAC,
    "td3": {
        **_OFF_POLICY,
        "train_freq": 1,
        "gradient_steps": 2,
        "tau": 0.02,
        "noise_type": "normal",
        "noise_std": 0.5,
        "policy_kwargs": {"net_arch": [64, 64]},
    },
    "tqc": {**_SAC, "top_quantiles_to_drop_per_net": 2},
    # Actions are numbered by Gymnasium's wrapper.
    "dqn": {
        **_OFF_POLICY,
        "n_timesteps": 6e4,
        "train_freq": 1,
        "gradient_steps": 2,
        "target_update_interval": 500,
        "exploration_fraction": 0.3,
        "exploration_final_eps": 0.02,
        "env_wrapper": [{DISCRETISE: {"bins": 9}}],
        "policy_kwargs": {"net_arch": [128, 128]},
    },
    # PPO in one file (agents/ppo.py), whose settings these are. Weights of the first layer are multiplied at
    # the start, for otherwise observations of order one hardly bend its tanh.
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
        "actor": [32, 32],
        "critic": [64, 32],
        "first_layer_scale": 2.0,
    },
    # By gradients through the environment (agents/shac.py). Windows are short: a guard's kinks make gradients of
    # longer ones useless.
    "shac": {
        "n_timesteps": 1e6,
        "n_envs": 64,
        "n_steps": 16,
        "learning_rate": 3e-3,
        "gamma": 0.99,
        "max_grad_norm": 1.0,
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
}


def learners() -> list[str]:
    """Return the names of the learners."""
    return sorted(DEFAULTS)


def hyperparameters(learner: str, task: Any) -> dict[str, Any]:
    """Return what a learner is trained with on a task.

    Parameters
    ----------
    learner : str
        One of `learners`.
    task : Task
        The task. Where its actions are choices, none are numbered and none explored by gSDE; our own learners
        look after that themselves.
    """
    found = {**DEFAULTS[learner], **task.hyperparameters.get(learner, {})}
    if task.formulas.choices and learner not in OWN:
        found = {name: value for name, value in found.items() if name not in ("use_sde", "sde_sample_freq")}
        wrappers = [wrapper for wrapper in found.pop("env_wrapper", []) if DISCRETISE not in wrapper]
        found |= {"env_wrapper": wrappers} if wrappers else {}
    return found


def as_yaml(learner: str, tasks: Mapping[str, Any]) -> str:
    """Return the hyperparameters of tasks, by id, as a file of the RL Zoo or for ``--config``."""
    use = "for `python -m agents.train --config`" if learner in OWN else "in the form of the RL Zoo"
    lines = [f"# {learner.upper()}, {use}."]
    for env_id, task in tasks.items():
        lines.append(f"{env_id}:")
        lines += [f"  {name}: {_yaml(value)}" for name, value in hyperparameters(learner, task).items()]
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    """Return a value in YAML's flow style, which is JSON's but for numbers such as 1e-05."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {_yaml(each)}" for name, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    return f"!!float {value!r}" if isinstance(value, float) else json.dumps(value)
