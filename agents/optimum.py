"""The optimum of every task: by value iteration if the state has 2 or 3 dimensions, otherwise bounds.

``python -m agents.optimum --help`` has the options.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import plans, scale
from agents.run import FIRST_FRESH_SEED, check_env, fresh_seeds, reports_errors
from agents.solution import DEFAULT_FOLDER, RESULTS, GreedyPolicy, Solution, solvable, solved_for
from lag_envs import TASKS, __version__
from lag_envs.evaluation import statistics
from lag_envs.evaluation.rollout import Rollout, play, record_rollout
from lag_envs.host import machine
from lag_envs.mechanics.recording import parameter_values
from lag_envs.options import module_parser
from lag_envs.store import write_file
from lag_envs.tasks import resolve
from lag_envs.tasks.base import Task
from lag_envs.tasks.measured import FILE
from lag_envs.tasks.record import ValueIteration

Array = NDArray[np.float64]

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
#: Version of the results.
SCHEMA = 2
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
    if problem.kick_sizes:
        text += f" Expectation over kicks: {problem.kick_sizes} sizes, equally likely."
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
