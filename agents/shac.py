"""Short-horizon actor-critic in one file: a policy improved by the exact gradient of its return.

The environments' steps have derivatives (`lag_envs.envs.model.Model.vjp`), so nothing has to be tried out. In
each iteration the policy acts for a window of some steps (`Learner.collect`), the derivatives of all later
rewards in the window with respect to each action are computed (`Learner.gradients`), and the policy follows
the gradient (`Learner.update`). A critic estimates the rewards after the window. Without a critic, and with
windows as long as episodes, the method is back-propagation through time, also called analytic policy
gradients.

The algorithm follows [1]_, with notable differences:

- At each step, derivatives larger than `max_slope` are scaled back to it.
- The policy is deterministic, not a normal distribution: only starts and kicks bring exploration.
- Actions beyond their limits are clipped, and moved back towards them, never further out.
- Each action follows the gradient of the rewards after it, discounted from that action on. In [1]_ they are
  discounted from the window's start, so that late actions in a window count less.
- The critic's targets are computed from its own values; in [1]_, from those of a copy that follows slowly.
- A share of the episodes starts in random states (`random_starts`).

For PyTorch a window is one batch. The derivatives of all its steps are computed at once, because the states
are known by then; the backward pass is only a recursion of small matrices in NumPy.

References
----------
.. [1] J. Xu et al., "Accelerated policy learning with parallel differentiable simulation", ICLR 2022.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from itertools import product
from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveInt, model_validator
from torch import nn

from agents.learners import LAYERS, Count, LearnerSettings, Width, check_rewards, trainable
from agents.policy import Policy, network, shared_weights
from agents.run import UserError, first_training_seed
from lag_envs.torch import Step

NAME = "shac"  #: see `agents.learners.OWN`
Array = NDArray[np.float64]


# --- settings -----------------------------------------------------------------------------------------------


class Settings(LearnerSettings):
    """Settings of a training; `lag_envs.hyperparams` has the values."""

    learner = NAME

    n_timesteps: float = Field(ge=1, description="steps of all environments together")
    n_envs: Count = Field(description="environments stepped together")
    n_steps: Count = Field(description="steps of a window")
    learning_rate: float = Field(ge=0, description="of the policy at the start; falls linearly to 0")
    gamma: float = Field(ge=0, le=1, description="discount of a step")
    max_grad_norm: float = Field(ge=0, description="largest norm of the policy's gradient")
    max_slope: float = Field(gt=0, description="largest norm of a step's derivatives")
    reward_scale: float = Field(gt=0, description="factor of the rewards")
    episode_share: float = Field(gt=0, le=1, description="share of its length after which an episode is cut")
    random_starts: float = Field(ge=0, le=1, description="share of episodes that start in random states")
    start_ranges: dict[str, NonNegativeFloat] = Field(description="half widths of random starts")
    actor: list[Width] = Field(
        min_length=1, max_length=LAYERS, description="widths of the policy's hidden layers"
    )
    first_layer_scale: float = Field(gt=0, description="factor of the first layers' weights at the start")
    critic: list[PositiveInt] = Field(description="widths of the critic's hidden layers; empty: no critic")
    critic_rate: float = Field(ge=0, description="learning rate of the critic")
    critic_epochs: int = Field(ge=1, description="passes over a window, in each of which the critic learns")
    batch_size: int = Field(ge=1, description="steps of a minibatch of the critic")
    td_lambda: float = Field(ge=0, le=1, description="weight of later steps in the critic's targets (lambda)")

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if self.random_starts and not self.start_ranges:
            raise ValueError(f"random_starts={self.random_starts:g} needs start_ranges, got none")
        return self


# --- learning -----------------------------------------------------------------------------------------------


class ExperienceWindow(NamedTuple):
    """The experience of n environments in T steps."""

    observations: NDArray[np.float32]  #: (T, n, n_observations), before each step
    seen: NDArray[np.float32]  #: (T, n, n_observations), after it
    before: Array  #: (T, n, n_state)
    after: Array  #: (T, n, n_state)
    targets: Array  #: (T, n, n_targets)
    actions: NDArray[np.float32]  #: (T, n, n_actions), the policy's, not clipped
    rewards: Array  #: (T, n)
    terminated: NDArray[np.bool_]  #: (T, n)
    over: NDArray[np.bool_]  #: (T, n)


class Learner:
    """Environments, networks and optimisers.

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

    Raises
    ------
    UserError
        For an environment without derivatives, and for start ranges of unknown states, or beyond the
        starts that the task accepts.
    """

    def __init__(self, env_id: str, settings: Settings, seed: int, steps: int) -> None:
        torch.set_num_threads(1)  # the networks are too small for several threads
        torch.manual_seed(seed)
        self.env_id, self.settings, self.steps, self.trained = env_id, settings, steps, 0
        self.rng = np.random.default_rng(seed)
        self.task = trainable(env_id)
        try:
            self.model = Step(self.task).model
        except ValueError as error:
            raise UserError(f"{NAME} needs gradients: {error}") from error
        names = self.task.scene.state_names
        if unknown := [name for name in settings.start_ranges if name not in names]:
            raise UserError(f"start_ranges: {env_id} has no state {unknown[0]!r}; it has {', '.join(names)}")
        self.half_widths = np.array([settings.start_ranges.get(name, 0.0) for name in names])
        for corner in product((-1.0, 1.0), repeat=len(names)):
            try:
                self.task.start_state(self.task.centre + corner * self.half_widths)
            except ValueError as error:
                raise UserError(f"start_ranges reach beyond what {env_id} accepts: {error}") from error
        self.envs: Any = gym.make_vec(env_id, settings.n_envs, autoreset_mode="Disabled").unwrapped
        # If windows are shorter than episodes, the first episodes end at staggered times, so that each window
        # contains all phases.
        self.observation, _ = self.envs.reset(seed=first_training_seed(seed))
        self.limit = max(1, round(settings.episode_share * self.task.limit))
        ages = np.arange(settings.n_envs) * self.limit // settings.n_envs
        self.left = self.limit - ages * (self.limit > settings.n_steps)
        self.start(np.ones(settings.n_envs, np.bool_))

        formulas, inputs = self.task.formulas, self.observation.shape[1]
        self.actor = network([inputs, *settings.actor, formulas.actions], settings.first_layer_scale)
        self.critic = network([inputs, *settings.critic, 1], settings.first_layer_scale)
        self.adams = [
            torch.optim.Adam(self.actor.parameters(), fused=True),
            torch.optim.Adam(self.critic.parameters(), lr=settings.critic_rate, fused=True),
        ]
        self.policy = Policy(shared_weights(self.actor), (), formulas.largest)
        start = deepcopy(self.state())
        self.gradients(self.collect())  # compiles
        self.restore(start)

    def iterate(self) -> None:
        """Collect a window and learn from it."""
        window = self.collect()
        check_rewards(self.env_id, window.rewards)
        slopes = self.gradients(window)
        self.update(window, slopes)
        if self.settings.critic:
            self.learn_values(window)
        self.trained += window.rewards.size

    def start(self, which: NDArray[np.bool_]) -> None:
        """Begin episodes in some environments, a share of them in random states."""
        self.observation, _ = self.envs.reset(options={"reset_mask": which})
        chosen = which & (self.rng.random(len(which)) < self.settings.random_starts)
        if chosen.any():
            away = self.half_widths * self.rng.uniform(-1.0, 1.0, (len(which), len(self.half_widths)))
            state = np.where(self.half_widths > 0.0, self.task.centre + away, self.envs.state)
            self.observation, _ = self.envs.reset(options={"reset_mask": chosen, "state": state})

    def collect(self) -> ExperienceWindow:
        """Let the policy act for a window."""
        steps = []
        for _ in range(self.settings.n_steps):
            observation, before = self.observation, self.envs.state
            target = np.zeros(0) if self.envs.target is None else self.envs.target
            _, action = self.policy.outputs(observation)
            seen, reward, terminated, truncated, _ = self.envs.step(action)
            self.left -= 1
            over = terminated | truncated | (self.left == 0)
            states = before, self.envs.state, target.reshape(len(over), -1)
            steps.append((observation, seen, *states, action, reward, terminated, over))
            self.observation = seen
            if over.any():
                self.left[over] = self.limit
                self.start(over)
        return ExperienceWindow(*(np.stack(x) for x in zip(*steps, strict=True)))

    def gradients(self, w: ExperienceWindow) -> Array:
        """Differentiate the discounted rewards that follow an action with respect to it, (T, n, n_actions).

        The derivatives are with respect to the clipped actions. If an episode is cut, the critic's value
        stands for the rest of it. Let x and a be a step's state and action, x' and a' the next ones, where a'
        depends on the observation o'(x'). Backwards in time, the derivatives with respect to x and a follow
        from those with respect to x' and a':

            d/d(x, a) = ∂r/∂(x, a) + γ (d/dx' · ∂x'/∂(x, a) + d/da' · ∂a'/∂o' · ∂o'/∂(x, a))

        The partial derivatives on the right are known for all steps beforehand, and are computed at once.
        """
        (steps, n, wide), many, gamma = w.before.shape, w.actions.shape[2], self.settings.gamma
        going = ~w.over  # whether the next step is in the window
        going[-1] = False
        # The differentiated results of a step: each entry of the next state, each next action, and
        # the reward, together with the critic's value if no step follows.
        kinds = wide + many + 1
        by_states = np.zeros((kinds, steps, n, wide))
        by_seen = np.zeros((kinds, *w.seen.shape))
        by_rewards = np.zeros((kinds, steps, n))
        by_states[np.arange(wide), :, :, np.arange(wide)] = 1.0
        inside = np.moveaxis(np.abs(w.actions) <= self.policy.largest, 2, 0)  # else constant
        by_seen[wide:-1, :-1] = (slopes(self.actor, w.observations) * inside[..., None])[:, 1:]
        by_rewards[-1] = self.settings.reward_scale
        if self.settings.critic:
            cut = ~going & ~w.terminated
            by_seen[-1, cut] = gamma * slopes(self.critic, w.seen[cut])[0]

        by_both = self.through_step(w, by_states, by_seen, by_rewards)
        found = np.empty((steps, n, wide + many))
        later = np.zeros((n, wide + many))
        for t in reversed(range(steps)):
            passed = np.einsum("nk,knj->nj", later * going[t][:, None], by_both[:-1, t])
            total = by_both[-1, t] + gamma * passed
            # Derivatives that grow from step to step, near an unstable balance or at kinks, would dominate.
            size = np.linalg.norm(total, axis=1, keepdims=True)
            later = found[t] = total / np.maximum(1.0, size / self.settings.max_slope)
        return found[..., wide:]

    def through_step(self, w: ExperienceWindow, by_states: Array, by_seen: Array, by_rewards: Array) -> Array:
        """Convert gradients with respect to steps' results to those with respect to their states and actions.

        Each step has several gradients, given as (kinds, T, n, ...), returned as (kinds, T, n, n_state +
        n_actions).
        """
        kinds, task = len(by_rewards), self.task

        def rows(x: NDArray) -> Array:
            """Return all steps' rows, once for each kind."""
            return np.broadcast_to(x, (kinds, *w.rewards.shape, x.shape[-1])).reshape(-1, x.shape[-1])

        before, after, actions = rows(w.before), rows(w.after), rows(self.clipped(w.actions))
        targets = rows(w.targets) if task.formulas.targets and task.fixed_target is None else None
        given = before, one_axis(actions), one_axis(targets)
        moved = self.model(*given)[0] if task.draws else after  # kicks are constants
        found = self.model.vjp(
            *given, by_states=rows(by_states), by_observations=rows(by_seen), by_rewards=by_rewards.ravel(),
            ends=moved, kicks=after - moved,
        )  # fmt: skip
        both = np.concatenate([found.states, found.actions.reshape(actions.shape)], axis=1)
        return both.reshape(kinds, *w.rewards.shape, -1)

    def clipped(self, actions: NDArray) -> Array:
        """Return the actions in the form that the environment takes."""
        return np.clip(actions, -self.policy.largest, self.policy.largest).astype(np.float64)

    def update(self, w: ExperienceWindow, by_actions: Array) -> None:
        """Move the policy along the gradient.

        Actions beyond their limits are moved back, never further out.
        """
        outwards = (w.actions != self.clipped(w.actions)) & (by_actions * w.actions > 0.0)
        wanted = np.where(outwards, 0.0, by_actions / w.rewards.size).astype(np.float32)
        adam = self.adams[0]
        adam.param_groups[0]["lr"] = self.settings.learning_rate * max(0.0, 1.0 - self.trained / self.steps)
        adam.zero_grad()
        self.actor(torch.from_numpy(w.observations)).backward(-torch.from_numpy(wanted))
        nn.utils.clip_grad_norm_(self.actor.parameters(), self.settings.max_grad_norm)
        adam.step()

    def learn_values(self, w: ExperienceWindow) -> None:
        """Let the critic learn the discounted rewards after each observation, TD(λ)."""
        s = self.settings
        with torch.no_grad():
            following = self.critic(torch.from_numpy(w.seen)).numpy()[..., 0] * ~w.terminated
        target = np.empty_like(following)
        later = following[-1]
        for t in reversed(range(len(target))):
            ahead = np.where(
                w.over[t], following[t], (1.0 - s.td_lambda) * following[t] + s.td_lambda * later
            )
            later = target[t] = s.reward_scale * w.rewards[t] + s.gamma * ahead
        observations, targets = w.observations.reshape(target.size, -1), target.reshape(-1, 1)
        for _ in range(s.critic_epochs):
            order = self.rng.permutation(target.size)
            for first in range(0, target.size, s.batch_size):
                batch = order[first : first + s.batch_size]
                off = self.critic(torch.from_numpy(observations[batch])) - torch.from_numpy(targets[batch])
                self.adams[1].zero_grad()
                off.square().mean().backward()
                self.adams[1].step()

    def weights(self) -> list[nn.Parameter]:
        """Return everything that is learned."""
        return [*self.actor.parameters(), *self.critic.parameters()]

    def state(self) -> dict[str, Any]:
        """Return everything that changes, for a checkpoint."""
        return {
            "networks": [net.state_dict() for net in (self.actor, self.critic)],
            "adams": [adam.state_dict() for adam in self.adams],
            "trained": self.trained, "rng": self.rng, "left": self.left,
            "envs": self.envs.get_state(), "observation": self.observation,
        }  # fmt: skip

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state`; the continuation is the same, bit for bit."""
        for net, values in zip((self.actor, self.critic), state["networks"], strict=True):
            net.load_state_dict(values)
        for adam, values in zip(self.adams, state["adams"], strict=True):
            adam.load_state_dict(values)
        self.envs.set_state(state["envs"])
        for name in ("trained", "rng", "left", "observation"):
            setattr(self, name, state[name])


def slopes(network: nn.Module, seen: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the Jacobian of a network's outputs with respect to its inputs, (n_outputs, ..., n_inputs)."""
    inputs = torch.from_numpy(seen).requires_grad_()
    outputs = network(inputs).unbind(-1)
    found = [torch.autograd.grad(x.sum(), inputs, retain_graph=True)[0].numpy() for x in outputs]
    return np.stack(found)


def one_axis(rows: Array | None) -> Array | None:
    """Return single numbers without an axis of their own, as `Model` takes them."""
    return rows[:, 0] if rows is not None and rows.shape[1] == 1 else rows


if __name__ == "__main__":
    raise SystemExit("To train it: python -m agents.train ENV --algo shac (python -m agents.train --help)")
