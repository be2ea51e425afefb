"""Proximal policy optimisation in one file of plain PyTorch, to be read from top to bottom.

``python -m agents.ppo --help`` has the options. An iteration lets the policy act in all environments
(`Learner.collect`), estimates how much better each action was than expected (`Learner.advantages`), and
makes better actions more likely, within limits (`Learner.update`). The algorithm is that of [1]_, with the
estimator of [2]_ and the exploration of [3]_. Networks, resuming and evaluation, which all our learners
share, are in other files of this folder, so copy the whole folder ``agents``.

References
----------
.. [1] J. Schulman et al., "Proximal policy optimization algorithms", arXiv:1707.06347, 2017.
.. [2] J. Schulman et al., "High-dimensional continuous control using generalized advantage estimation",
   ICLR 2016.
.. [3] A. Raffin, J. Kober, F. Stulp, "Smooth exploration for robotic reinforcement learning", CoRL 2021.
"""

from __future__ import annotations

import argparse
import sys
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self, get_origin

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, PositiveInt, model_validator
from torch import Tensor, nn

import agents
from agents.learners import LAYERS, Count, Frames, LearnerSettings, Width, check_rewards, trainable
from agents.policy import Array, Policy, network, shared_weights
from agents.run import CHECKPOINT, first_training_seed, reports_errors
from agents.train import add_run_options, here, planned_runs, train_all
from lag_envs.envs.stagger import stagger
from lag_envs.leaderboard.networks import stacked
from lag_envs.options import module_parser

NAME = "fast_ppo"  #: see `agents.learners.OWN`


# --- settings -----------------------------------------------------------------------------------------------


class Settings(LearnerSettings):
    """Settings of a training; `lag_envs.hyperparams` has the values."""

    learner = NAME

    n_timesteps: float = Field(ge=1, description="steps of all environments together")
    n_envs: Count = Field(description="environments stepped together")
    n_steps: Count = Field(description="steps of each environment between updates")
    n_epochs: int = Field(ge=1, description="passes over the collected steps in an update")
    batch_size: int = Field(ge=2, description="steps of a minibatch")
    learning_rate: float = Field(ge=0, description="Adam's step size at the start; falls linearly to 0")
    gamma: float = Field(ge=0, le=1, description="discount of a step")
    gae_lambda: float = Field(ge=0, le=1, description="decay of the advantage's weights")
    td_lambda: float | None = Field(
        None, ge=0, le=1, description="decay of the weights in the critic's targets (default: gae_lambda)"
    )
    clip_range: float = Field(gt=0, description="limit of a probability's relative change in an update")
    ent_coef: float = Field(ge=0, description="weight of the entropy in the loss")
    vf_coef: float = Field(ge=0, description="weight of the critic's squared error in the loss")
    limit_coef: float = Field(
        0.0, ge=0, description="weight in the loss of the squares by which mean actions exceed their limits"
    )
    max_grad_norm: float = Field(ge=0, description="largest norm of a gradient")
    reward_scale: float = Field(gt=0, description="factor of the rewards")
    episode_share: float = Field(gt=0, le=1, description="share of its length after which an episode is cut")
    state_noise: bool = Field(description="whether noise of continuous actions depends on the state (gSDE)")
    noise_steps: int = Field(ge=1, description="steps for which this noise is held")
    log_std_init: float = Field(ge=-20, le=5, description="log standard deviation of actions at the start")
    frames: Frames = Field(description="number of last observations that actor and critic see")
    actor: list[Width] = Field(
        min_length=1, max_length=LAYERS, description="widths of the policy's hidden layers"
    )
    critic: list[PositiveInt] = Field(min_length=1, description="widths of the critic's hidden layers")
    first_layer_scale: float = Field(gt=0, description="factor of the first layers' weights at the start")

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if (size := self.n_envs * self.n_steps) % self.batch_size:
            raise ValueError(f"batch_size must divide n_envs * n_steps = {size}, got {self.batch_size}")
        return self


# --- actions ------------------------------------------------------------------------------------------------


class GaussianActor:
    """Continuous actions: Gaussian around the actor's outputs, with noise held for some steps.

    The noise is features · E, where E (features, actions) is drawn with a learned standard deviation for each
    entry. The features are the actor's last hidden layer (gSDE), or 1 for noise that does not depend on the
    state. The environment clips actions beyond the action space.
    """

    def __init__(self, settings: Settings, actions: int) -> None:
        self.by_state, self.steps = settings.state_noise, settings.noise_steps
        shape = settings.actor[-1] if self.by_state else 1, actions
        self.log_std = nn.Parameter(torch.full(shape, float(settings.log_std_init)))
        self.parameters = [self.log_std]
        self.exploration = np.zeros((0, *shape), np.float32)

    def sample(self, rng: np.random.Generator, t: int, features: Array, means: Array) -> Array:
        """Return actions for step t of a roll-out, (n, actions)."""
        if t % self.steps == 0:
            draws = rng.standard_normal((len(means), *self.log_std.shape), np.float32)
            self.exploration = draws * np.exp(self.log_std.detach().numpy())
        features = features if self.by_state else np.ones_like(features[:, :1])
        return means + np.einsum("nf,nfa->na", features, self.exploration)

    def log_prob(self, features: Tensor, means: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions' log probability density and the entropy, up to constants, (n,) each."""
        features = features.detach() if self.by_state else torch.ones_like(features[:, :1])
        variance = features.square() @ (2.0 * self.log_std).exp() + 1e-6
        log = variance.log()
        return -0.5 * ((actions - means).square() / variance + log).sum(1), 0.5 * log.sum(1)


class CategoricalActor:
    """Discrete actions: the actor outputs a logit for each value of each list."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.parameters: list[nn.Parameter] = []

    def sample(self, rng: np.random.Generator, t: int, features: Array, logits: Array) -> NDArray[np.int64]:
        """Return values, (n, actions)."""
        gumbel = rng.gumbel(size=logits.shape)  # the largest sum is distributed as softmax(logits)
        return self.policy.chosen(logits + gumbel).reshape(len(logits), -1)

    def log_prob(self, features: Tensor, logits: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the values' log probability and the entropy, (n,) each."""
        parts = [part.log_softmax(1) for part in logits.split(self.policy.choices, dim=1)]
        taken = [part.gather(1, a[:, None])[:, 0] for part, a in zip(parts, actions.unbind(1), strict=True)]
        return sum(taken), sum(-(part.exp() * part).sum(1) for part in parts)


# --- learning -----------------------------------------------------------------------------------------------


class Experience(NamedTuple):
    """The experience of n environments in T steps; observations are stacked."""

    observations: Array  #: (T + 1, n, frames * n_observation)
    actions: NDArray  #: (T, n, n_actions)
    rewards: Array  #: (T, n)
    terminated: NDArray[np.bool_]  #: (T, n)
    over: NDArray[np.bool_]  #: (T, n)
    final: Array  #: (T, n, frames * n_observation); episodes' last observations, at the steps where they end


def later_sums(surprise: Array, over: NDArray[np.bool_], decay: float) -> Array:
    """Return each step's surprise plus the later ones of its episode, weighted by powers of `decay`."""
    sums, later = np.empty_like(surprise), np.zeros_like(surprise[0])
    for t in reversed(range(len(surprise))):
        later = sums[t] = surprise[t] + decay * ~over[t] * later
    return sums


class Learner:
    """Environments, networks and optimiser.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    settings : Settings
        The settings.
    seed : int
        Decides everything that is random.
    steps : int
        Steps to train for; after them the learning rate is 0.
    """

    def __init__(self, env_id: str, settings: Settings, seed: int, steps: int) -> None:
        torch.set_num_threads(1)  # the networks are too small for several threads
        torch.manual_seed(seed)
        self.env_id, self.settings, self.steps, self.trained = env_id, settings, steps, 0
        self.rng = np.random.default_rng(seed)
        task = trainable(env_id)
        formulas = task.formulas
        limit = max(1, round(settings.episode_share * task.limit))
        self.envs: Any = gym.make_vec(
            env_id, settings.n_envs, autoreset_mode="SameStep", max_episode_steps=limit
        )
        first = first_training_seed(seed)
        self.envs.reset(seed=first)
        # Episodes are under way already, and earlier observations are not seen.
        self.observation = stacked(stagger(self.envs, limit, first)[0], settings.frames)
        self.actions, self.shape = formulas.actions, self.envs.action_space.shape

        inputs, outputs = self.observation.shape[1], sum(formulas.choices) or formulas.actions
        self.actor = network([inputs, *settings.actor, outputs], settings.first_layer_scale)
        self.critic = network([inputs, *settings.critic, 1], settings.first_layer_scale)
        self.policy = Policy([], formulas.choices, formulas.largest, settings.frames)
        self.head = (
            CategoricalActor(self.policy) if formulas.choices else GaussianActor(settings, formulas.actions)
        )
        # All parameters lie in one array, and so do their gradients: Adam and the norm then take one call
        # each.
        parts = [*self.actor.parameters(), *self.critic.parameters(), *self.head.parameters]
        self.parameters = nn.Parameter(torch.cat([p.detach().flatten() for p in parts]))
        self.gradient = self.parameters.grad = torch.zeros_like(self.parameters)
        sizes = [p.numel() for p in parts]
        places = zip(self.parameters.data.split(sizes), self.gradient.split(sizes), strict=True)
        for p, (values, gradients) in zip(parts, places, strict=True):
            p.data, p.grad = values.view_as(p), gradients.view_as(p)
        self.adam = torch.optim.Adam([self.parameters], eps=1e-5, fused=True)
        self.policy.layers = shared_weights(self.actor)

    def iterate(self) -> None:
        """Collect experience and learn from it."""
        rollout = self.collect()
        check_rewards(self.env_id, rollout.rewards)
        self.update(rollout, *self.advantages(rollout))
        self.trained += rollout.rewards.size

    def collect(self) -> Experience:
        """Let the policy act."""
        steps, n, frames = self.settings.n_steps, self.settings.n_envs, self.settings.frames
        wide = self.observation.shape[1]
        kind = np.int64 if self.policy.choices else np.float32
        found = Experience(
            np.empty((steps + 1, n, wide), np.float32), np.empty((steps, n, self.actions), kind),
            np.empty((steps, n), np.float32), np.empty((steps, n), np.bool_), np.empty((steps, n), np.bool_),
            np.zeros((steps, n, wide), np.float32),
        )  # fmt: skip
        for t in range(steps):
            found.observations[t] = self.observation
            found.actions[t] = self.head.sample(self.rng, t, *self.policy.outputs(self.observation))
            observation, reward, found.terminated[t], truncated, infos = self.envs.step(
                found.actions[t].reshape(self.shape)
            )
            found.rewards[t] = self.settings.reward_scale * reward
            over = found.over[t] = found.terminated[t] | truncated
            if over.any():
                last = np.stack(infos["final_obs"][over])
                found.final[t, over] = stacked(last, frames, self.observation[over])
            self.observation = stacked(observation, frames, self.observation, over)
        found.observations[steps] = self.observation
        return found

    @torch.no_grad()
    def advantages(self, found: Experience) -> tuple[Array, Array]:
        """Return the advantages of the actions and the critic's targets, (T, n) each.

        A truncated episode would have continued: the value of its last observation stands for the rest.
        The targets may look further ahead than the advantages. The critic then learns sooner that a state has
        become better, while the actor's estimates stay as steady as before.
        """
        s = self.settings
        values = self.critic(torch.from_numpy(found.observations)).numpy()[..., 0]
        following = values[1:].copy()
        if found.over.any():
            following[found.over] = self.critic(torch.from_numpy(found.final[found.over])).numpy()[:, 0]
        following[found.terminated] = 0.0
        surprise = found.rewards + s.gamma * following - values[:-1]
        advantages = later_sums(surprise, found.over, s.gamma * s.gae_lambda)
        if s.td_lambda is None:
            return advantages, advantages + values[:-1]
        return advantages, later_sums(surprise, found.over, s.gamma * s.td_lambda) + values[:-1]

    def update(self, found: Experience, advantages: Array, targets: Array) -> None:
        """Improve actor and critic by several epochs of Adam on the collected experience."""
        s, body, last = self.settings, self.actor[:-1], self.actor[-1]
        self.adam.param_groups[0]["lr"] = s.learning_rate * max(0.0, 1.0 - self.trained / self.steps)
        observations = torch.from_numpy(found.observations[:-1].reshape(advantages.size, -1))
        actions = torch.from_numpy(found.actions.reshape(advantages.size, -1))
        advantage, target = (torch.from_numpy(x.reshape(-1)) for x in (advantages, targets))
        with torch.no_grad():
            features = body(observations)
            before, _ = self.head.log_prob(features, last(features), actions)
        for _ in range(s.n_epochs):
            for batch in torch.from_numpy(self.rng.permutation(advantages.size)).split(s.batch_size):
                seen, gain = observations[batch], advantage[batch]
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                features = body(seen)
                means = last(features)
                log_prob, entropy = self.head.log_prob(features, means, actions[batch])
                ratio = (log_prob - before[batch]).exp()
                limited = ratio.clamp(1.0 - s.clip_range, 1.0 + s.clip_range)
                better = torch.min(ratio * gain, limited * gain).mean()
                off = (self.critic(seen)[:, 0] - target[batch]).square().mean()
                loss = s.vf_coef * off - better - s.ent_coef * entropy.mean()
                if s.limit_coef and not self.policy.choices:
                    # Far beyond a limit noise changes nothing, so nothing would be learned there.
                    beyond = (means.abs() / self.policy.largest - 1.0).clamp(min=0.0)
                    loss = loss + s.limit_coef * beyond.square().mean()
                self.gradient.zero_()
                loss.backward()
                self.gradient.mul_((s.max_grad_norm / (self.gradient.norm() + 1e-6)).clamp(max=1.0))
                self.adam.step()

    def weights(self) -> list[nn.Parameter]:
        """Return everything that is learned."""
        return [self.parameters]

    def state(self) -> dict[str, Any]:
        """Return everything that changes, for a checkpoint."""
        return {
            "trained": self.trained, "parameters": self.parameters.detach().numpy(),
            "adam": self.adam.state_dict(), "rng": self.rng,
            "envs": self.envs.get_state(), "observation": self.observation,
        }  # fmt: skip

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state`; the continuation is the same, bit for bit."""
        with torch.no_grad():
            self.parameters.copy_(torch.from_numpy(state["parameters"]))
        self.adam.load_state_dict(state["adam"])
        self.envs.set_state(state["envs"])
        for name in ("trained", "rng", "observation"):
            setattr(self, name, state[name])


# --- the command --------------------------------------------------------------------------------------------

EPILOG = f"""files in FOLDER/ENV/{NAME}/seed<K>:
  result.json          returns on 100 fresh episodes, score, learning curve, settings, versions, times
  model.zip            weights, for numpy.load; agents.learners.load_policy takes the folder
  {CHECKPOINT}       while the run is not finished: everything needed to resume

The same seed gives the same policy, bit for bit, even if the training was interrupted (by Ctrl-C or by a
kill) and the command run again. Settings are those of `lag-envs hyperparams {NAME}`, unless an option changes
them. `python -m agents.train ENV --algo {NAME}` trains several seeds side by side, or on a Ray cluster.

examples:
  python -m agents.ppo PivotedBar-v0                       one seed, in seconds
  python -m agents.ppo PivotedBar-v0 --seeds 5 --first-seed 10
  python -m agents.ppo PivotedBar-v0 --gamma 0.98 --actor 64 64 --output runs/wide
  python -m agents.ppo examples/ball_on_beam.py            a task of your own; this runs the file
"""

#: Settings that are command-line options; n_timesteps is --steps.
OPTIONS = [name for name in Settings.model_fields if name != "n_timesteps"]


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser(
        "agents.ppo", "Train PPO, in one file of plain PyTorch, and evaluate it over fresh episodes.", EPILOG
    )
    p.add_argument("env", nargs="+", metavar="ENV", help="ids, module:ID, or your own FILE or FILE:Class")
    add_run_options(p)
    group = p.add_argument_group(
        "settings (default: the task's own, which `lag-envs hyperparams fast_ppo` prints)"
    )
    for name in OPTIONS:
        field = Settings.model_fields[name]
        kinds: dict[Any, Any] = {float: float, float | None: float, bool: yes_or_no}
        kind = kinds.get(field.annotation, int)
        many: Any = {"nargs": "+"} if get_origin(field.annotation) is list else {}
        shown = "yes|no" if kind is yes_or_no else "X"
        group.add_argument(
            "--" + name.replace("_", "-"), type=kind, metavar=shown, help=field.description, **many
        )
    return p


def yes_or_no(text: str) -> bool:
    """Return the value of yes or no."""
    if text not in ("yes", "no"):
        raise argparse.ArgumentTypeError(f"must be yes or no, got {text!r}")
    return text == "yes"


@reports_errors("agents.ppo")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where a seed failed, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    given = {name: getattr(args, name) for name in OPTIONS}
    changed = {name: value for name, value in given.items() if value is not None}
    runs = planned_runs(Namespace(**vars(args), algo=[NAME], config=None, ray=None, jobs=None), changed)
    for run in runs:
        Settings.of(run.hyperparameters)  # fail now, not after training another seed
    status = train_all(runs, here, "agents.ppo", arguments)
    if status == 0:
        print(
            f"Since the command began, with imports, compiling, tests and evaluation: "
            f"{time.perf_counter() - agents.STARTED:.1f} s, {time.process_time():.1f} s of them on the "
            "processor"
        )
    return status


if __name__ == "__main__":
    sys.exit(main())
