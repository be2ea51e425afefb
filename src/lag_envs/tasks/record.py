"""The data of a task beside its formulas: goal, controllers, hyperparameters, grids, examples.

A task's class holds them as the attributes that `lag_envs.tasks.Task` lists. Code is given by name,
"module:function", and resolved where it is used, so a task imports no controller, learner or leaderboard.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Goal:
    """When an episode counts as a success. `Task.reached` decides whether the goal holds in a state.

    A task with a goal has a board.

    Parameters
    ----------
    text : str
        What counts as success, and which time is reported: "success: ...; time: ..." (or "there is no time").
    hold : float or None
        The goal must hold without a break for this many seconds at the episode's end. None: it need not hold.
    terminated : bool or None
        Whether the episode must have terminated. None: it must not have terminated, and reaching the goal
        does not matter.
    arrival : str
        Name of the event of reaching the goal, in a word or two. docs/agents.md reports the time of this
        event and the reward lost until then, unless the string is empty.
    rules : int
        Version of the board's rules: 2 adds imperfect sensors and actuators, and hidden parameters, to its
        disturbances. A board keeps the version that it began with.
    counted : bool
        Whether the board shows how many episodes succeed. This is False if the protocol began with a rule for
        success that cannot hold; the rule stays until the next protocol.
    """

    text: str
    hold: float | None = 1.0
    terminated: bool | None = False
    arrival: str = ""
    rules: int = 2
    counted: bool = True


@dataclass(frozen=True)
class Controller:
    """A controller of a task.

    Parameters
    ----------
    place : str
        Function that makes the controller from the task, "module:function". The controller must be a
        `lag_envs.controllers.basic.Agent`.
    numbers : mapping
        Its keyword arguments.
    tune : mapping
        Keywords that ``python -m agents.tune`` optimises, and the range of each.
    plans : bool
        Whether it plans in each episode, which may take seconds.
    real_time : mapping, optional
        For a controller whose planning takes longer than a step: the numbers with which it acts in real time.
    """

    place: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    tune: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    plans: bool = False
    real_time: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plans:
    """How plans for a task are found and followed: iLQR from random guesses, then time-varying feedback.

    Parameters
    ----------
    place : str
        Function of the task, "module:function". It returns a task on the same scene that is easier to plan
        for, and the terminal cost of a plan, a function from states (n, n_state) to numbers (n,).
    numbers : mapping
        Its keyword arguments.
    steps : int
        Steps of the easier task in a plan that is followed.
    quick : mapping
        Differences for the plan that serves as initial guess of each episode's own plan: other
        `numbers`, ``steps``, ``batch`` or ``iterations``.
    batch : int
        Number of guesses that are improved at once.
    iterations : int
        Largest number of improvements.
    rest : sequence of float
        The equilibrium in which a plan should end.
    weights : mapping of str to float
        Weights of the feedback: squares of deviations, by entry of the state.
    effort : float
        Weight of the square of an action's deviation.
    extra : mapping of str to float
        Costs of the squares of entries of the state that the reward ignores, in a step near the end.
    smooth : mapping
        Parameters of the scene that differ in the model of the feedback: dry friction is so steep at rest
        that its linearisation misleads.
    of : str
        Id of the task whose recorded plans are followed. Empty: the task's own plans.
    """

    place: str
    numbers: Mapping[str, Any]
    steps: int
    quick: Mapping[str, Any]
    batch: int
    iterations: int
    rest: Sequence[float]
    weights: Mapping[str, float]
    effort: float
    extra: Mapping[str, float] = field(default_factory=dict)
    smooth: Mapping[str, float] = field(default_factory=dict)
    of: str = ""


@dataclass(frozen=True)
class Open:
    """Marks an open task: the best known policies stay far below a reference with privileged knowledge.

    Parameters
    ----------
    controller : str
        Name of the controller of the task that is the reference.
    options : mapping
        Keywords of the environment in which this controller acts; they give it the privileged knowledge.
    knows : str
        The privileged knowledge, in words.
    tried : mapping of str to str
        The methods that were tried, and the budget of each.
    """

    controller: str
    options: Mapping[str, Any]
    knows: str
    tried: Mapping[str, str]


@dataclass(frozen=True)
class Optimum:
    """The largest return from given starts, where it is known.

    Parameters
    ----------
    place : str
        Function of the task and the entries of the states that returns the optimum, "module:function".
    text : str
        The optimal policy, in words.
    """

    place: str
    text: str


@dataclass(frozen=True)
class Axis:
    """One axis of a grid: its range, and the density of its nodes.

    Parameters
    ----------
    label : str
        Name with unit, for figures.
    low, high : float
        The range. A state outside gets the value of the nearest state on the edge.
    cells : int
        Number of cells at level 1, an even number; level 2 has twice as many.
    scale : float, optional
        Within this distance of the centre the nodes are evenly spaced; farther out the spacing grows. None:
        evenly spaced everywhere.
    centre : float or "target"
        Where nodes are densest.
    periodic : bool
        Whether the range is one period.
    level : float
        How fine the axis is in the table that is submitted to the leaderboard.
    """

    label: str
    low: float
    high: float
    cells: int
    scale: float | None = None
    centre: float | str = 0.0
    periodic: bool = False
    level: float = 1.0


@dataclass(frozen=True)
class ValueIteration:
    """How a task is solved by value iteration.

    Parameters
    ----------
    axes : tuple of Axis
        The grid.
    options : mapping
        Parameters of an easier task that is solved in place of this one, a relaxation. There is no policy
        then.
    keep : tuple of int
        Indices of the state's entries that are axes of the grid; the other entries are 0 on the grid. Empty:
        all.
    targets : tuple of float
        Targets to solve for, from 0 upwards. Other targets are interpolated, and negative ones mirrored.
        Empty: no target.
    kick_sizes : int
        Number of kick sizes in the expectation: midpoints of as many parts of a kick's second random number.
    chance : float
        Chance of a kick per interval: a kick happens if its first random number is below this.
    actions : int
        Number of actions, evenly spaced between the extremes.
    most : float
        Largest reward of a step.
    levels : tuple of float
        Fineness of the grids, each twice as fine as the one before.
    lost : float
        Share of the grid whose values are so low that figures need not distinguish them.
    mirror : str
        Entry of the state, or ``"target"``, by whose sign the submitted table is mirrored. Empty: none.
    relaxed : str
        Id of the task whose solution bounds this one from above, in place of a grid of its own. That solution
        is looked up at the entries `keep` of the state.
    """

    axes: tuple[Axis, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    keep: tuple[int, ...] = ()
    targets: tuple[float, ...] = ()
    kick_sizes: int = 0
    chance: float = 0.01
    actions: int = 11
    most: float = 1.0
    levels: tuple[float, ...] = (2, 4, 8)
    lost: float = 0.0
    mirror: str = ""
    relaxed: str = ""


@dataclass(frozen=True)
class Examples:
    """Cases of a task for tests, pictures and docs.

    Parameters
    ----------
    start : mapping
        Options of a reset: a ``state`` in mid-task, and a ``target`` where there is one.
    moving : sequence of float, optional
        A faster state, for the recorded rollouts of the tests; by default the state of `start`.
    fast : sequence of float, optional
        A state at a large speed from which episodes work whatever the parameters, within their ranges.
    refused : sequence of mapping
        Options of resets that the task must refuse.
    ending : tuple, optional
        A state and an action that soon terminate the episode.
    reach : float
        Largest rate of the angle in episodes [rad/s].
    rest : sequence of float, optional
        A state of rest, with the action 0.
    batch : mapping
        Parameters with a value for each environment of a batch, mild and extreme values.
    variants : mapping
        Named sets of keywords of the environment that change more than numbers.
    """

    start: Mapping[str, Any] = field(default_factory=dict)
    moving: Sequence[float] | None = None
    fast: Sequence[float] | None = None
    refused: Sequence[Mapping[str, Any]] = ()
    ending: tuple[Sequence[float], float] | None = None
    reach: float = 0.0
    rest: Sequence[float] | None = None
    batch: Mapping[str, Sequence[float]] = field(default_factory=dict)
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
