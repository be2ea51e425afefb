"""What people decide about a task beside its formulas, as data.

A task's class holds these under the names of `lag_envs.tasks.Task`. Code is named, "module:function", and
resolved where it is used: a task imports no controller, learner or leaderboard.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Goal:
    """When an episode counts as a success; `Task.reached` says where the goal holds. It makes a board.

    Parameters
    ----------
    text : str
        Success and time, in words.
    hold : float or None
        Seconds before the episode's end from which on the goal must hold without a break. None: it need not.
    terminated : bool or None
        Whether the episode must have terminated. None: must not, and reaching the goal does not matter.
    arrival : str
        What is reached then, in a word or two: docs/agents.md tells when it is, and what is lost by then.
        Empty: it does not.
    """

    text: str
    hold: float | None = 1.0
    terminated: bool | None = False
    arrival: str = ""


@dataclass(frozen=True)
class Controller:
    """A controller of a task.

    Parameters
    ----------
    place : str
        Where it is made from the task, "module:function".
    numbers : mapping
        Keywords that it is made with.
    tune : mapping
        Keywords that ``python -m agents.tune`` finds, and between which values it looks for them.
    plans : bool
        Whether it plans for seconds before each episode.
    """

    place: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    tune: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    plans: bool = False


@dataclass(frozen=True)
class Optimum:
    """The largest return from given starts, where it is known.

    Parameters
    ----------
    place : str
        What returns it from the task and the entries of the states, "module:function".
    text : str
        Of which policy, in words.
    """

    place: str
    text: str


@dataclass(frozen=True)
class Axis:
    """One axis of a grid: its range, and where its nodes lie densely.

    Parameters
    ----------
    label : str
        Name with unit, for figures.
    low, high : float
        The range. States outside are taken to be as good as the nearest one on the edge.
    cells : int
        Cells at level 1, even; twice as many at level 2.
    scale : float, optional
        Within this distance of the centre the nodes lie evenly, farther out ever wider; None: all evenly.
    centre : float or "target"
        The dense place.
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
        Parameters of the task that is solved in place of this one, an easier one: a relaxation. There is no
        policy then.
    keep : tuple of int
        Which entries of the scene's state are on the grid; the others are 0 there. Empty: all.
    targets : tuple of float
        Targets, from 0 on, to solve for; others are interpolated, negative ones mirrored. Empty: none.
    pushes : int
        Sizes of a kick that its expectation takes: midpoints of as many parts of its random number.
    actions : int
        Number of actions, evenly from -1 to 1.
    levels : tuple of float
        How fine the grids are, each twice as fine as the one before.
    lost : float
        Share of the grid in which so much is lost that figures need not tell one place from another.
    mirror : str
        Entry of the state, or ``"target"``, on whose sign the submitted table is mirrored; empty: on none.
    relaxed : str
        Id whose solution bounds this task from above, in place of a grid of its own; it is looked up at the
        entries `keep` of the state.
    """

    axes: tuple[Axis, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    keep: tuple[int, ...] = ()
    targets: tuple[float, ...] = ()
    pushes: int = 0
    actions: int = 11
    levels: tuple[float, ...] = (2, 4, 8)
    lost: float = 0.0
    mirror: str = ""
    relaxed: str = ""


@dataclass(frozen=True)
class Examples:
    """Cases of a task that tests, pictures and docs take.

    Parameters
    ----------
    start : mapping
        Options of a reset: a ``state`` in mid-task, and a ``target`` where there is one.
    moving : sequence of float, optional
        A faster state, for rollouts that are kept; by default that of `start`.
    refused : sequence of mapping
        Options of resets that the task must refuse.
    ending : tuple, optional
        A state and an action that soon terminate the episode.
    reach : float
        Rate of the angle that episodes come to [rad/s].
    rest : sequence of float, optional
        A state of rest, with the action 0.
    batch : mapping
        Parameters, one for each environment of a batch, mild and extreme ones side by side.
    variants : mapping
        By name, keywords of the environment that are more than numbers.
    """

    start: Mapping[str, Any] = field(default_factory=dict)
    moving: Sequence[float] | None = None
    refused: Sequence[Mapping[str, Any]] = ()
    ending: tuple[Sequence[float], float] | None = None
    reach: float = 0.0
    rest: Sequence[float] | None = None
    batch: Mapping[str, Sequence[float]] = field(default_factory=dict)
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
