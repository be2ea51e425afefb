"""The optimum of every task: by value iteration if the state has 2 or 3 dimensions, otherwise bounds.

``python -m agents.optimum --help`` has the options.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.run import FIRST_FRESH_SEED, check_env, fresh_seeds, reports_errors
from agents.value_iteration import (
    DynamicProgramme,
    Grid,
    Kick,
    interpolate_rows,
    regridded,
    stretched,
)
from lag_envs import TASKS, __version__
from lag_envs.controllers.lookahead import LookAhead
from lag_envs.envs.model import Model
from lag_envs.evaluation import statistics
from lag_envs.evaluation.rollout import Rollout, play, record_rollout
from lag_envs.host import machine
from lag_envs.mechanics.recording import parameter_values
from lag_envs.options import module_parser
from lag_envs.store import write_file
from lag_envs.tasks import resolve
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import FILE
from lag_envs.tasks.record import Axis, ValueIteration

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
DEFAULT_FOLDER = Path("runs/optimum")
RESULTS, IMAGES = ROOT / "agents" / "results" / "optimum", ROOT / "docs" / "images"
#: Versions of the results, and of the cache.
SCHEMA, CACHED = 2, 1
#: Number of episodes compared.
EPISODES = 1_000

HELP = """value iteration stores V_t, the largest return still attainable after t steps, at the nodes of a
grid, and goes backwards from the end of the episode. It runs on several grids, each twice as fine as the one
before.

what is written:
  agents/results/optimum/ID.json   lower and upper bounds, and how they were found
  docs/images/value-ID.png         the value function at the start, where the best action changes sign
  FOLDER/ID/.../values.npy         all V_t, up to 1 GB each, 12 GB for all ids; may be deleted at any time

how to read the numbers:
  grid value    mean of V_0 over the starts of 1,000 fixed episodes. Interpolation makes it too large or too
                small; the finer the grid, the smaller the error.
  lower         mean return that the greedy policy gets in those episodes, with the 95 % confidence
                interval of the mean. Since a policy attains it, the optimum is not below it.
  estimate      grid values extrapolated to zero cell width, by the order of convergence that the last three
                show; its error bar is how much the last halving changed it. It is an ESTIMATE, not a
                bound. No estimate is given if the greedy policy gets more.
  bound         proved upper bound on the return of any policy; crude unless the optimum is known.
For a task with plans (`Task.plans`), plans are found instead, by iLQR from random guesses, in minutes per id:
  src/lag_envs/controllers/plans/ID-followed.npz
                a plan that is followed from any start by feedback; of those found, the one with the best
                mean return over 200 fresh starts
  src/lag_envs/controllers/plans/ID-quick.npz
                a quicker plan, from which each episode is replanned
  src/lag_envs/tasks/measured.json
                the returns of both plans, by python -m agents.scale: means over fresh starts with standard
                errors; the better one is the best known return, a lower bound
With --quick, plans of one seed are written to FOLDER and nothing is measured.
For a task with neither grid nor plans, python -m agents.scale measures the controllers and the best policy of
a run, or the one that ships with the package; with --quick nothing is written.

If the state has 4 dimensions, an easier task is solved, such as that without a track. Its value is an
upper bound; lower is the return of the best agent, see the agents' results.

The command can be stopped at any time (Ctrl-C, SIGTERM, or a kill); re-run it to resume.

examples:
  python -m agents.optimum PivotedBar-v0 --quick      one id on coarse grids, in seconds; writes to FOLDER
  python -m agents.optimum                            all ids, tens of minutes on one core
  python -m agents.optimum PivotedBar-v0 --new        start over, discarding what was computed"""


# --- what is solved -----------------------------------------------------------------------------------------


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
            "level": self.level, "pushes": problem.pushes, "constants": self.task.formulas.constants(),
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
            if self.task.draws == 2 and self.problem.pushes
            else []
        )
        if not ends or (ends[0] == ends[1]).all() or (ends[1] != state).any():
            raise ValueError(
                f"value iteration would leave out the kicks of {self.env_id}: it takes those of two random "
                "numbers, of which the first is below the chance of a kick and the second gives its size; "
                "set `pushes` and `chance` in its ValueIteration"
            )
        return True

    def _kick(self, points: Array) -> tuple[Array, Array]:
        """Return the outcomes of no kick and of kicks of all sizes, with their probabilities."""
        states, pushes = self.states(points), self.problem.pushes
        chance = self.task.chance(self.problem.chance)
        # The first random number decides whether there is a kick, the second one its size.
        draws = [(1.0 - 1e-9, 0.5), *((0.0, (i + 0.5) / pushes) for i in range(pushes))]
        weights = np.array([1.0 - chance, *[chance / pushes] * pushes])
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


# --- numbers ------------------------------------------------------------------------------------------------


def starts(env_id: str, episodes: int = EPISODES) -> tuple[Array, Array | None]:
    """Return states and targets at the start of the episodes on which agents are compared."""
    rollout = Rollout(env_id, None, fresh_seeds(episodes))
    return rollout.state, rollout.target


def proved_bound(env_id: str) -> tuple[float, str]:
    """Return an upper bound on any policy's mean return over the starts, and the reason for it."""
    task: Task = TASKS[env_id]()
    if task.optimum is None:
        most = solvable()[env_id].most
        return most * task.limit, f"no step of an episode pays more than {most:g}"
    states, _ = starts(env_id)
    place, text = task.optimum.place, task.optimum.text
    return float(resolve(place)(task, *states.T).mean()), f"{text} (`{place.replace(':', '.')}`)"


def extrapolated(values: Sequence[float]) -> tuple[float, float, float]:
    """Extrapolate values on grids, each twice as fine as the one before, to zero cell width.

    Returns
    -------
    limit : float
        The limit, by the order of convergence that the last three values show, clipped to between 1 and 2.
    error : float
        How much the last halving of the cells changed the value. If the order is at least 1, the error on the
        finest grid is at most this, and a misjudged order moves the limit by less.
    order : float
        The order; 1 if there are fewer than three values, or if they do not converge evenly.

    Examples
    --------
    >>> extrapolated([5.0, 4.0])
    (3.0, 1.0, 1.0)
    >>> extrapolated([9.0, 6.0, 5.25])
    (5.0, 0.75, 2.0)
    """
    steps = np.diff(values)
    order = 1.0
    if len(steps) > 1 and steps[-1] != 0.0 and steps[-2] / steps[-1] > 1.0:
        order = float(np.clip(np.log2(steps[-2] / steps[-1]), 1.0, 2.0))
    return float(values[-1] + steps[-1] / (2.0**order - 1.0)), float(abs(steps[-1])), order


def scene_numbers(task: Task) -> dict[str, float]:
    """Return the numbers of a task's scene, its step [s] and the steps of an episode."""
    scene = task.scene
    return parameter_values(scene) | {"dt": task.dt, "limit": task.limit}


def compute(env_id: str, folder: Path, *, quick: bool = False, new: bool = False) -> dict[str, Any]:
    """Solve the problems that an environment needs, and return its numbers."""
    source, problem = solved_for(env_id)
    levels = [problem.levels[0] / 2, problem.levels[0]] if quick else list(problem.levels)
    states, targets = starts(env_id)
    grids = []
    for level in levels:
        solution = Solution(source, level, folder, new=new and source == env_id)
        keep = solution.keep if source == env_id else list(TASKS[env_id].value_iteration.keep)
        value = float(solution.value(0, states[:, keep], targets).mean())
        grids.append(
            {
                "level": level, "nodes": list(solution.programs[0].grid.shape), "value": round(value, 4),
                "cpu_seconds": round(solution.seconds, 2),
                "caches": [program.name for program in solution.programs],
            }
        )  # fmt: skip
        print(f"{env_id}: {' x '.join(map(str, grids[-1]['nodes']))} nodes, value {value:.3f}", flush=True)
    relaxed = env_id != source or bool(problem.options)
    lower, started = None, time.process_time()
    if not relaxed:
        agent = GreedyPolicy(env_id, solution=solution)
        found = statistics.estimate([play(env_id, agent, fresh_seeds(EPISODES))])
        low, high = (round(found[end], 4) for end in ("low", "high"))
        lower = {"mean": round(found["mean"], 4), "interval": [low, high]}
    limit, error, order = extrapolated([grid["value"] for grid in grids])
    bound, why = proved_bound(env_id)
    broken = lower is not None and lower["mean"] > limit + error
    estimate = None if broken else {"value": round(limit, 4), "error": round(error, 4)}
    return {
        "schema": SCHEMA,
        "env": env_id,
        "solved": source + (" with " + ", ".join(f"{k}={v:g}" for k, v in problem.options.items())
                            if problem.options else ""),
        "how": explanation(env_id, source, problem, grids),
        "parameters": scene_numbers(TASKS[source](**problem.options)),
        "axes": [
            {"label": a.label, "low": a.low, "high": a.high, "cells_at_level_1": a.cells,
             "even_within": a.scale, "centre": a.centre, "periodic": a.periodic}
            for a in problem.axes
        ],
        "actions": problem.actions,
        "targets": list(problem.targets),
        "grids": grids,
        "episodes": EPISODES,
        "first_seed": FIRST_FRESH_SEED,
        "lower": lower,
        "estimate": estimate,
        "order": round(order, 2),
        "bound": {"value": round(bound, 4), "why": why, "exact": TASKS[env_id].optimum is not None},
        "cpu_seconds": round(sum(g["cpu_seconds"] for g in grids) + time.process_time() - started, 1),
        "machine": machine(),
        "versions": {"lag-envs": __version__} | {n: version(n) for n in ("numpy", "numba", "gymnasium")},
    }  # fmt: skip


def explanation(env_id: str, source: str, problem: ValueIteration, grids: Sequence[dict[str, Any]]) -> str:
    """Describe in words how the numbers were computed."""
    sizes = ", ".join(" x ".join(map(str, grid["nodes"])) for grid in grids)
    text = (
        f"Finite-horizon value iteration on grids of {sizes} nodes with {problem.actions} actions, "
        "interpolated linearly; the step is the environment's own."
    )
    if problem.pushes:
        text += f" Expectation over kicks: {problem.pushes} sizes, equally likely."
    if problem.targets:
        text += (
            f" Solved for the targets {', '.join(f'{t:g}' for t in problem.targets)}; between them "
            "interpolated linearly, negative ones by the mirror image."
        )
    text += (
        f" Values are means over the starts of {EPISODES:,} episodes. estimate: the grid values extrapolated "
        "to cells without width by the order of convergence that the last three show (between 1 and 2); its "
        "error is what the last halving of the cells changed. It is not a bound."
    )
    if env_id != source:
        return text + (
            f" The value function is that of {source}: the same task without the track, from above because "
            "whatever is done on the track can be done without. From below: the best policy known, see the "
            "results of the agents."
        )
    if problem.options:
        return text + (
            " An easier task is solved: a track without ends, and no cost for being off its middle, so the "
            "true optimum is lower. From below: the best policy known, see the results of the agents. The "
            "range between is too wide for a score in percent."
        )
    return text + (
        " lower: mean return of the greedy policy (one step ahead, then finer around the best action) in the "
        "environment."
    )


# --- figures ------------------------------------------------------------------------------------------------


def draw_values(env_id: str, folder: Path, file: Path, level: float) -> None:
    """Draw the value function at the start, and where the best action changes sign."""
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    problem = solvable()[env_id]
    solution = Solution(env_id, level, folder)
    k = len(problem.targets) - 1 if problem.targets else 0
    target = problem.targets[k] if problem.targets else None
    program, values = solution.programs[k], solution.values[k]
    greedy = program.greedy(values[1])
    axes = program.grid.axes
    third = [None] if len(axes) == 2 else [len(axes[2]) // 4, len(axes[2]) // 2, 3 * len(axes[2]) // 4]
    with matplotlib.rc_context({"font.size": 9}):
        figure = Figure(figsize=(6.4, 4.6) if len(third) == 1 else (9.6, 3.9), dpi=100, layout="constrained")
        plots = np.atleast_1d(figure.subplots(1, len(third), sharex=True, sharey=True))
        low, high = float(np.quantile(values[0], problem.lost)), float(values[0].max())
        levels = MaxNLocator(25).tick_values(low, high)
        for plot, i in zip(plots, third, strict=True):
            part = (slice(None), slice(None)) if i is None else (slice(None), slice(None), i)
            colours = plot.contourf(
                axes[0], axes[1], values[0][part].T, levels, cmap="viridis", extend="min",
            )  # fmt: skip
            plot.contour(axes[0], axes[1], greedy[part].T, [0.0], colors="white", linewidths=1.0)
            plot.set_xlabel(problem.axes[0].label)
            if i is not None:
                name, unit = problem.axes[2].label.split()
                plot.set_title(f"{name} = {axes[2][i]:.3g} {unit.strip('[]')}", fontsize=9)
        plots[0].set_ylabel(problem.axes[1].label)
        if not problem.options and len(axes) == 2:
            played = record_rollout(Rollout(env_id, GreedyPolicy(env_id, solution=solution), fresh_seeds(1)))
            states = played.states[:, 0, solution.keep]
            if problem.axes[0].periodic:
                states[:, 0] = np.mod(states[:, 0], problem.axes[0].high)
                jumps = np.abs(np.diff(states[:, 0])) > 0.5 * problem.axes[0].high
                states = np.insert(states, np.flatnonzero(jumps) + 1, np.nan, axis=0)
            plots[0].plot(*states.T, color="tab:red", linewidth=1.2, label="one episode")
            plots[0].plot(*states[0], "o", color="tab:red", markersize=4)
        plots[0].plot([], [], color="white", linewidth=1.0, label="best action changes sign")
        legend = plots[0].legend(loc="upper right", fontsize=8, facecolor="0.35", labelcolor="white")
        legend.set_zorder(5)
        figure.colorbar(colours, ax=list(plots), label="largest return from here, $V_0$")
        title = f"{env_id}: value at the start of an episode"
        if problem.options:
            title = f"{env_id} without ends of the track: value at the start"
        figure.suptitle(title + ("" if target is None else f", target {target:g}"), fontsize=10)
        plots[0].set_xlim(axes[0][0], axes[0][-1])
        plots[0].set_ylim(axes[1][0], axes[1][-1])
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, metadata={"Software": None})


# --- the command --------------------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser("agents.optimum", "Compute the best possible return of every task.", HELP)
    p.add_argument("env", nargs="*", metavar="ENV", help="ids of environments (default: all)")
    p.add_argument("--quick", action="store_true", help="coarse grids; everything is written to FOLDER")
    p.add_argument(
        "--folder",
        type=Path,
        default=DEFAULT_FOLDER,
        help="where value functions are kept (default %(default)s)",
    )
    p.add_argument("--new", action="store_true", help="compute again what is kept in FOLDER")
    return p


@reports_errors("agents.optimum")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 2 for a mistake of the user's, 130 when interrupted."""
    args = parser().parse_args(arguments)
    # Tasks that are relaxations of other tasks are solved first.
    known = {env_id: task.value_iteration for env_id, task in TASKS.items()}
    last = {env_id for env_id, problem in known.items() if problem and problem.relaxed}
    ids = [check_env(name) for name in args.env] or sorted(TASKS, key=last.__contains__)
    try:
        for env_id in dict.fromkeys(ids):
            compute_optimum(env_id, args)
    except KeyboardInterrupt:
        print("\nInterrupted; re-run it (without --new) to resume.", file=sys.stderr)
        return 130
    return 0


def compute_optimum(env_id: str, args: argparse.Namespace) -> None:
    """Compute, write and draw one environment's optimum; if it has no grid, plan instead.

    If it has no plan either, the best known policy is a controller or a learner's, and its return is
    measured.
    """
    task = TASKS[env_id]()
    if task.plans is not None or task.value_iteration is None:
        from agents import plans, scale  # the measurements play the plans found here

        if task.plans is not None:
            plans.find_plans(env_id, args.folder if args.quick else None, [0] if args.quick else plans.SEEDS)
        if not args.quick or task.plans is None or task.plans.of:
            size = ["--batches", "1", "--size", "512" if args.quick else "8192"]
            more = ["--quick"] if args.quick else ["--planned", str(plans.EPISODES), "--output", str(FILE)]
            scale.main([env_id, *size, *more])
        return
    results, images = (args.folder, args.folder) if args.quick else (RESULTS, IMAGES)
    result = compute(env_id, args.folder, quick=args.quick, new=args.new)
    write_file(results / f"{env_id}.json", json.dumps(result, indent=2, ensure_ascii=False) + "\n")
    if env_id in solvable():
        levels = solvable()[env_id].levels
        draw_values(
            env_id, args.folder, images / f"value-{env_id}.png", levels[0] if args.quick else levels[1]
        )
    lower = result["lower"]
    low = "see the agents' results" if lower is None else f"{lower['mean']:.3f} {lower['interval']}"
    found = result["estimate"]
    estimate = "none" if found is None else f"{found['value']:.3f} ± {found['error']:.3f}"
    print(
        f"{env_id}: lower {low}, estimate {estimate}, bound "
        f"{result['bound']['value']:.3f}, {result['cpu_seconds']:.0f} s of CPU time\n"
        f"  -> {results / env_id}.json",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
