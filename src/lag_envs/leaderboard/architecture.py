"""The base of all architectures: each reads a table, names the arrays it needs, and makes an agent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import Agent, Stateless
from lag_envs.leaderboard.fields import Strict
from lag_envs.tasks.base import Task

Array = NDArray[np.float64]
#: Lengths of an array's axes. A name stands for any length of at least 2, the same everywhere; "name + 1" for
#: one more.
Shape = tuple[int | str, ...]

#: The table's name in messages.
POLICY = "[policy]"


class PolicyTable(Strict):
    """The table ``[policy]``."""

    architecture: str


class Architecture(ABC):
    """One entry of the list, checked.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    table : Strict
        The table ``[policy]``, as `table` describes it.

    Raises
    ------
    Refused
        If anything in the table is wrong.
    """

    #: What the table ``[policy]`` must be.
    table: type[Strict] = PolicyTable
    #: First version of ``submission.toml`` that has this architecture.
    schema = 1
    #: The kind of such policies; if empty, they are learned if there is a training, and controllers
    #: otherwise.
    counts_as = ""
    #: Names and shapes of the arrays in each policy's file; empty if there are no files.
    arrays: dict[str, Shape]
    #: Whether it searches for a plan in each episode, see `protocol.PLANNED`.
    plans = False
    #: The module with the agent's code; empty if its arrays say everything.
    module = ""

    @abstractmethod
    def __init__(self, env_id: str, table: Any) -> None: ...

    @abstractmethod
    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return the agent; raise Refused if the arrays' values do not fit."""

    def page_data(self, arrays: Mapping[str, Array]) -> PageData | None:
        """Return the data with which a page runs the policy; None if only Python can run it."""
        return None


class Head:
    """Turns numbers into actions of a task: clipped to their range, or the largest number picks from a list.

    Parameters
    ----------
    task : Task
        The task.

    Attributes
    ----------
    choices : tuple of int
        Lengths of the lists from which actions are chosen; empty if actions lie in a range.
    size : int
        How many numbers it takes: one per component of an action, or one per value of each list.
    """

    def __init__(self, task: Task) -> None:
        formulas = task.formulas
        self.choices = formulas.choices
        self.size = sum(self.choices) or formulas.actions
        self.largest = formulas.largest
        self._single = len(self.choices) == 1
        self._ends = np.cumsum(self.choices)[:-1]

    def __call__(self, numbers: Array) -> NDArray:
        """Return actions (n, ...) for numbers (n, size)."""
        if not self.choices:
            return np.clip(numbers, -self.largest, self.largest).astype(np.float32)
        if not np.isfinite(numbers).all():
            raise ValueError("the numbers that decide its actions are not finite")
        chosen = [part.argmax(axis=1) for part in np.split(numbers, self._ends, axis=1)]
        return chosen[0] if self._single else np.stack(chosen, axis=1)


class PageData(NamedTuple):
    """What a page needs to run a policy; ``static/drive.js`` has the code."""

    about: dict[str, Any]  #: the kind of policy, and its numbers, in JSON types
    arrays: Mapping[str, Array]
    head: Head


def feedback_data(agent: Agent, task: Task) -> PageData | None:
    """Return a page's data about an agent that is pure feedback; None for any other."""
    law = agent.law(task)
    if law is None:
        return None
    if law.read is None:
        arrays = {"gain": -law.gains[0].T, "offset": law.actions[0]}
        return PageData({"kind": "linear"}, arrays, Head(task))
    arrays = {"states": law.states, "actions": law.actions, "gains": law.gains}
    return PageData({"kind": "plan", "read": law.read.numbers()}, arrays, Head(task))


class Memoryless(Stateless):
    """An agent without memory.

    Parameters
    ----------
    head : Head
        Turns numbers into actions.
    numbers : callable
        Returns numbers (n, size) for the head, for observations (n, n_observation).
    """

    def __init__(self, head: Head, numbers: Callable[[Array], Array]) -> None:
        self.head, self.numbers = head, numbers

    def answer(self, observation: NDArray) -> NDArray:
        """Return the action for each observation."""
        values = np.asarray(observation, np.float64)
        # An overflow ends as a non-finite action, which verification refuses.
        with np.errstate(all="ignore"):
            actions = self.head(self.numbers(np.atleast_2d(values)))
        return actions.reshape((*values.shape[:-1], *actions.shape[1:]))


class Remembering(Agent):
    """Base of the agents with a memory in each episode; a subclass defines `begin` and `act`.

    Parameters
    ----------
    head : Head
        Turns numbers into actions.
    """

    of_one_interval = True

    def __init__(self, head: Head) -> None:
        self.head = head

    @abstractmethod
    def begin(self, observations: Array) -> Array:
        """Return the memories (n, ...) before the first step, for the first observations."""

    @abstractmethod
    def act(self, observations: Array, memories: Array) -> tuple[Array, Array]:
        """Return numbers (n, size) for the head, and the memories after the step."""

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray, Array]:
        """Return the action for each observation, and the memory of each episode."""
        values = np.asarray(observation, np.float64)
        batch = np.atleast_2d(values)
        with np.errstate(all="ignore"):
            memories = self.begin(batch)
            if state is not None:
                start = np.broadcast_to(False if episode_start is None else episode_start, len(batch))
                memories[~start] = np.asarray(state)[~start]
            numbers, memories = self.act(batch, memories)
            actions = self.head(numbers)
        return actions.reshape((*values.shape[:-1], *actions.shape[1:])), memories
