"""The solution of a task on a grid: value functions by value iteration, and the policy that follows them."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.value_iteration import DynamicProgramme, Grid, Kick, interpolate_rows, regridded, stretched
from lag_envs import TASKS
from lag_envs.controllers.lookahead import LookAhead
from lag_envs.envs.model import Model
from lag_envs.tasks.base import Task
from lag_envs.tasks.record import Axis, ValueIteration

Array = NDArray[np.float64]

#: Where the values are cached, and where ``python -m agents.optimum`` writes what follows from them.
DEFAULT_FOLDER = Path("runs/optimum")
RESULTS = Path(__file__).parent / "results" / "optimum"
#: Version of the cache.
CACHED = 1


def nodes(axis: Axis, level: float, target: float | None) -> Array:
    """Return an axis's nodes."""
    cells = 2 * round(0.5 * level * axis.cells)
    if axis.scale is None:
        return np.linspace(axis.low, axis.high, cells + 1)
    centre = target if axis.centre == "target" else axis.centre
    assert isinstance(centre, float)
    return stretched(axis.low, centre, axis.high, cells, axis.scale)


def grid(problem: ValueIteration, level: float, target: float | None = None) -> Grid:
    """Return the grid of a level."""
    axes = tuple(nodes(axis, level, target) for axis in problem.axes)
    return Grid(axes, tuple(a.high - a.low if a.periodic else None for a in problem.axes))


def solvable() -> dict[str, ValueIteration]:
    """Return the problems that are solved on a grid, by id."""
    found = {env_id: task.value_iteration for env_id, task in TASKS.items()}
    return {env_id: problem for env_id, problem in found.items() if problem and problem.axes}


def solved_for(env_id: str) -> tuple[str, ValueIteration]:
    """Return the id and the problem whose solution solves an environment or bounds it from above."""
    own = TASKS[env_id].value_iteration
    assert own is not None
    source = own.relaxed or env_id
    return source, solvable()[source]


def played() -> list[str]:
    """Return the ids for which value iteration gives a policy: those that are solved themselves."""
    return [env_id for env_id, problem in solvable().items() if not problem.options]


class Solution:
    """The value functions of a problem on the grids of one level.

    Parameters
    ----------
    env_id : str
        Id of the environment that is solved.
    level : float
        How fine the grids are.
    folder : Path, optional
        Where the values are cached; None keeps them in memory.
    new : bool
        Whether to discard cached values.
    quiet : bool
        Whether to show no progress.
    problem : ValueIteration, optional
        The problem, if it differs from the task's.
    """

    def __init__(
        self,
        env_id: str,
        level: float,
        folder: Path | None = DEFAULT_FOLDER,
        *,
        new: bool = False,
        quiet: bool = False,
        problem: ValueIteration | None = None,
    ) -> None:
        problem = problem or solvable()[env_id]
        self.env_id, self.problem, self.level = env_id, problem, level
        self.task: Task = TASKS[env_id](**problem.options)
        self.model = Model(self.task)
        self.n_state = len(self.task.scene.state_names)
        self.keep = list(problem.keep or range(self.n_state))
        self.steps = int(self.task.limit)
        self.kick: Kick | None = self._kick if self._kicks() else None
        #: The last targets and the nodes of the axis that depends on them; targets last for an episode.
        self._asked: Array = np.empty(0)
        self._own: Array = np.empty((0, 0))
        self.programs, self.values, self.seconds = [], [], 0.0
        for target in problem.targets or (None,):
            program = self.program(target)
            label = f"{env_id}, {' x '.join(map(str, program.grid.shape))} nodes" + (
                "" if target is None else f", target {target:g}"
            )
            where = None if folder is None else folder / env_id
            self.values.append(program.solve(where, new=new, label=label, quiet=quiet))
            self.programs.append(program)
            self.seconds += program.seconds

    def program(self, target: float | None) -> DynamicProgramme:
        """Return the dynamic programme for a target."""
        problem = self.problem
        # The fingerprint does not cover the step between the points where it is evaluated.
        parameters = {
            "schema": CACHED, "env": self.env_id, "options": dict(problem.options), "target": target,
            "level": self.level, "pushes": problem.kick_sizes, "constants": self.task.formulas.constants(),
        }  # fmt: skip
        formulas = self.task.formulas
        largest = formulas.largest
        actions = np.linspace(-largest, largest, problem.actions)
        if formulas.choices:
            actions = np.arange(formulas.choices[0], dtype=np.float64)
        step = functools.partial(self.step, target=target)
        places = grid(problem, self.level, target)
        return DynamicProgramme(places, actions, step, self.steps, self.kick, parameters)

    def states(self, points: Array) -> Array:
        """Return the scene's states for points on the grid."""
        states = np.zeros((len(points), self.n_state))
        states[:, self.keep] = points
        return states

    def step(self, points: Array, actions: Array, target: ArrayLike | None) -> tuple[Array, Array, Any]:
        """Take the model's step from points on the grid."""
        ends, rewards, ended = self.model(self.states(points), actions, target)
        return ends[:, self.keep], rewards, ended

    def _kicks(self) -> bool:
        """Return whether there are random kicks; raise a ValueError for kicks that `_kick` does not know."""
        if not self.task.draws:
            return False
        chance, state = self.task.chance(self.problem.chance), np.array([self.task.centre])
        ends = (
            [self.model.kicked(state, [[share * chance], [0.9]]) for share in (1.0 - 1e-9, 1.0 + 1e-9)]
            if self.task.draws == 2 and self.problem.kick_sizes
            else []
        )
        if not ends or (ends[0] == ends[1]).all() or (ends[1] != state).any():
            raise ValueError(
                f"value iteration would leave out the kicks of {self.env_id}: it takes those of two random "
                "numbers, of which the first is below the chance of a kick and the second gives its size; "
                "set `kick_sizes` and `chance` in its ValueIteration"
            )
        return True

    def _kick(self, points: Array) -> tuple[Array, Array]:
        """Return the outcomes of no kick and of kicks of all sizes, with their probabilities."""
        states, sizes = self.states(points), self.problem.kick_sizes
        chance = self.task.chance(self.problem.chance)
        # The first random number decides whether there is a kick, the second one its size.
        draws = [(1.0 - 1e-9, 0.5), *((0.0, (i + 0.5) / sizes) for i in range(sizes))]
        weights = np.array([1.0 - chance, *[chance / sizes] * sizes])
        ones = np.ones(len(points))
        kicked = [self.model.kicked(states, np.array([a * ones, b * ones])) for a, b in draws]
        return np.stack(kicked)[:, :, self.keep], weights

    def value(self, times: ArrayLike, points: Array, targets: Array | None = None) -> Array:
        """Return V_t at points.

        Parameters
        ----------
        times : array_like of int, shape (n,) or ()
            Steps taken.
        points : ndarray, shape (n, d)
            States on the grid.
        targets : ndarray, shape (n,), optional
            Targets, if the task has any.
        """
        times = np.ascontiguousarray(np.broadcast_to(times, len(points)), np.int64)
        last = len(self.values[0]) - 1
        if ((times < 0) | (times > last)).any():
            raise ValueError(f"times must lie between 0 and {last}, got {times.min()} to {times.max()}")
        if targets is None:
            return self._at(0, times, points)
        points = np.where(targets < 0.0, -1.0, 1.0)[:, None] * points  # the mirror image
        targets = np.abs(targets)
        known = np.array(self.problem.targets)
        lower = np.clip(np.searchsorted(known, targets, side="right") - 1, 0, len(known) - 2)
        part = (targets - known[lower]) / (known[lower + 1] - known[lower])
        own = self._own_nodes(targets)
        result = np.zeros(len(points))
        for k in range(len(known)):
            for rows, weight in ((lower == k, 1.0 - part), (lower + 1 == k, part)):
                if rows.any():
                    # Points are mapped to the same place among the nodes of target k as among their own
                    # target's, so that targets and the edges at which episodes end correspond.
                    there, axis = points[rows], self._moving
                    there[:, axis] = regridded(
                        there[:, axis], self._own, own[rows], self.programs[k].grid.axes[axis]
                    )
                    result[rows] += weight[rows] * self._at(k, times[rows], there)
        return result

    def _at(self, k: int, times: NDArray[np.int64], points: Array) -> Array:
        grid, values = self.programs[k].grid, self.values[k]
        cells, places = grid.locate(points)
        return interpolate_rows(values.reshape(len(values), -1), times, cells, places, grid.strides)

    @property
    def _moving(self) -> int:
        """Index of the axis whose nodes depend on the target."""
        return [axis.centre for axis in self.problem.axes].index("target")

    def _own_nodes(self, targets: Array) -> NDArray[np.intp]:
        """Return for each target the row of `_own` whose nodes belong to the target."""
        different, rows = np.unique(targets, return_inverse=True)
        if not np.array_equal(different, self._asked):
            axis = self.problem.axes[self._moving]
            self._own = np.array([nodes(axis, self.level, float(target)) for target in different])
            self._asked = different
        return rows

    def expected(self, times: ArrayLike, points: Array, targets: Array | None = None) -> Array:
        """Return the expectation of V_t at points over the random kick that follows."""
        if self.kick is None:
            return self.value(times, points, targets)
        outcomes, weights = self.kick(points)
        return sum(w * self.value(times, p, targets) for w, p in zip(weights, outcomes, strict=True))


class GreedyPolicy(LookAhead):
    """The greedy policy of a computed value function.

    Parameters
    ----------
    env_id : str
        Id of an environment that value iteration solves.
    level : float, optional
        How fine the grid is; by default as fine as the finest of `python -m agents.optimum`. Values that are
        not in the cache are computed, which takes a moment.
    folder : Path, optional
        The cache.
    solution : Solution, optional
        An existing solution, in place of the other arguments.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from lag_envs.tasks.incline import Brake
    >>> agent = GreedyPolicy(Brake.id, level=0.5, folder=None)
    >>> observation, _ = gym.make(Brake.id).reset(seed=0)
    >>> action, taken = agent.predict(observation)
    >>> action, taken
    (array([-1.], dtype=float32), array([1.]))
    """

    def __init__(
        self,
        env_id: str,
        level: float | None = None,
        folder: Path | None = DEFAULT_FOLDER,
        solution: Solution | None = None,
    ) -> None:
        if env_id not in played():
            raise ValueError(
                f"value iteration gives no policy for {env_id!r}, only for {', '.join(played())}"
            )
        found = solution or Solution(env_id, level or solvable()[env_id].levels[-1], folder)
        self.solution = found
        super().__init__(found.task, self._value, found.programs[0].actions)

    def _value(self, ends: Array, targets: Array, taken: Array) -> Array:
        solution = self.solution
        # The margin allows for the rounding of a clock that advances by tenths of a step.
        after = np.minimum((taken + 1e-6).astype(np.int64) + 1, solution.steps)
        return solution.expected(after, ends[:, solution.keep], targets if solution.problem.targets else None)
