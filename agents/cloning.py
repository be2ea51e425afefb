"""Cloning a controller in one file: a network learns the controller's action in every state that it reaches.

Cloning needs no reward, and the network becomes at best as good as the controller. In each iteration the
network acts, the controller labels the states (`Learner.collect`), and the network learns by regression from
all data collected so far (`Learner.update`). The algorithm is DAgger [1]_.

References
----------
.. [1] S. Ross, G. Gordon, D. Bagnell, "A reduction of imitation learning and structured prediction to
   no-regret online learning", AISTATS 2011.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from pydantic import Field

from agents.learners import LAYERS, Count, LearnerSettings, Width, trainable
from agents.policy import Policy, network, shared_weights
from agents.run import UserError, first_training_seed
from lag_envs.controllers import build
from lag_envs.envs.stagger import stagger
from lag_envs.tasks.base import Task

NAME = "cloning"  #: see `agents.learners.OWN`


class Settings(LearnerSettings):
    """Settings of a training; `lag_envs.hyperparams` has the values."""

    learner = NAME

    controller: str = Field(description="name of the controller; empty: the first that needs no plan")
    n_timesteps: float = Field(ge=1, description="steps of all environments together")
    n_envs: Count = Field(description="environments stepped together")
    n_steps: Count = Field(description="steps of each environment between updates")
    n_updates: int = Field(ge=1, description="minibatches of an update")
    batch_size: int = Field(ge=1, description="steps of a minibatch, drawn from all collected data")
    learning_rate: float = Field(ge=0, description="Adam's step size at the start; falls linearly to 0")
    actor: list[Width] = Field(
        min_length=1, max_length=LAYERS, description="widths of the policy's hidden layers"
    )
    first_layer_scale: float = Field(gt=0, description="factor of the first layer's weights at the start")


class Learner:
    """Environments, controller, network and optimiser.

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
        If the environment has discrete actions, or no controller that acts without a plan.
    """

    def __init__(self, env_id: str, settings: Settings, seed: int, steps: int) -> None:
        torch.set_num_threads(1)  # the network is too small for several threads
        torch.manual_seed(seed)
        self.settings, self.steps, self.trained = settings, steps, 0
        self.rng = np.random.default_rng(seed)
        task = trainable(env_id)
        formulas = task.formulas
        if formulas.choices:
            raise UserError(f"{NAME} learns continuous actions, and {env_id} has discrete ones; try fast_ppo")
        self.expert = expert(task, settings.controller)
        self.envs: Any = gym.make_vec(env_id, settings.n_envs, autoreset_mode="SameStep")
        first = first_training_seed(seed)
        self.envs.reset(seed=first)
        self.observation, _ = stagger(self.envs, round(task.limit), first)
        self.holds: Any = None  # the controller's memory
        self.begun = np.ones(settings.n_envs, np.bool_)
        wide = self.observation.shape[1]
        self.seen, self.wanted = np.empty((0, wide), np.float32), np.empty((0, formulas.actions), np.float32)
        self.actor = network([wide, *settings.actor, formulas.actions], settings.first_layer_scale)
        self.adam = torch.optim.Adam(self.actor.parameters(), fused=True)
        self.policy = Policy(shared_weights(self.actor), (), formulas.largest)

    def iterate(self) -> None:
        """Collect the controller's actions, and learn them."""
        self.collect()
        self.update()
        self.trained += self.settings.n_envs * self.settings.n_steps

    def collect(self) -> None:
        """Let the network act while the controller labels its states; at first the controller acts."""
        seen, wanted = [self.seen], [self.wanted]
        for _ in range(self.settings.n_steps):
            seen.append(self.observation)
            would, self.holds = self.expert.predict(self.observation, self.holds, self.begun)
            wanted.append(would)
            # The environments clip actions beyond the action space.
            action = self.policy.outputs(self.observation)[1] if self.trained else would
            self.observation, _, terminated, truncated, _ = self.envs.step(action)
            self.begun = terminated | truncated
        self.seen, self.wanted = np.concatenate(seen), np.concatenate(wanted)

    def update(self) -> None:
        """Learn from minibatches of all collected data."""
        s = self.settings
        seen, wanted = torch.from_numpy(self.seen), torch.from_numpy(self.wanted)
        self.adam.param_groups[0]["lr"] = s.learning_rate * max(0.0, 1.0 - self.trained / self.steps)
        for _ in range(s.n_updates):
            batch = torch.from_numpy(self.rng.integers(len(seen), size=s.batch_size))
            self.adam.zero_grad()
            (self.actor(seen[batch]) - wanted[batch]).square().mean().backward()
            self.adam.step()

    def weights(self) -> list[torch.nn.Parameter]:
        """Return everything that is learned."""
        return list(self.actor.parameters())

    def state(self) -> dict[str, Any]:
        """Return everything that changes, for a checkpoint."""
        names = ("trained", "rng", "observation", "holds", "begun", "seen", "wanted")
        return {
            "actor": self.actor.state_dict(), "adam": self.adam.state_dict(), "envs": self.envs.get_state(),
            "rest": {name: getattr(self, name) for name in names},
        }  # fmt: skip

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state`; the continuation is the same, bit for bit."""
        self.actor.load_state_dict(state["actor"])
        self.adam.load_state_dict(state["adam"])
        self.envs.set_state(state["envs"])
        for name, value in state["rest"].items():
            setattr(self, name, value)


def expert(task: Task, name: str) -> Any:
    """Return a task's controller, or raise a UserError."""
    acting = [key for key, found in task.controllers.items() if not found.plans]
    if not name and not acting:
        raise UserError(f"{task.id} has no controller that acts without a plan: there is nothing to clone")
    try:
        return build(task, name or acting[0])
    except ValueError as error:
        raise UserError(str(error)) from error


if __name__ == "__main__":
    raise SystemExit("To train it: python -m agents.train ENV --algo cloning (python -m agents.train --help)")
