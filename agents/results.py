"""Measure all agents on all environments, and write the results, the figures and the page of agents.

``python -m agents.results --help`` has the options.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from agents.analysis import Data, best_first, chances_of_improvement, summarise_env, summarise_learners
from agents.measure import Evaluation, MeasurementJob, measure_policies
from agents.run import FIRST_FRESH_SEED, SCHEMA, UserError, check_env, check_numbers, reports_errors
from lag_envs import TASKS, __version__
from lag_envs.errors import hint
from lag_envs.evaluation.statistics import rounded_data
from lag_envs.host import installed_versions, machine
from lag_envs.options import module_parser
from lag_envs.scores import known_returns
from lag_envs.store import readable_json, write_file

ROOT = Path(__file__).parents[1]
SUMMARY, PAGE, PICTURES = "agents/results/summary.json", "docs/agents.md", "docs/images"
#: The page with the table of the best agents.
TRAINING = "docs/training.md"
#: Episodes under each condition, and with --quick.
EPISODES, QUICK = 1000, 20
PACKAGES = ("gymnasium", "numpy", "numba", "scipy", "torch", "stable-baselines3", "sb3-contrib", "matplotlib")

EPILOG = f"""files read and written:
  RUNS/ENV/ALGO/seed<K>/       policies from `python -m agents.train` (default runs/)
  RUNS/measurements/ENV.jsonl  finished measurements; they are not repeated
  OUTPUT/{SUMMARY}   all numbers
  OUTPUT/{PAGE}        the page, with figures in OUTPUT/{PICTURES}
  OUTPUT/docs/training.md     its table, if the page has one

The command can be interrupted at any time; re-run it to resume. Agents missing now (such as other machines'
runs) keep their numbers in the summary. Commands for different --envs may run side by side.

examples:
  python -m agents.results --quick                      see whether everything works
  python -m agents.results --envs PivotedBar-v0 --agents ppo sac
  python -m agents.results --redraw                     the page again, from the summary
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = module_parser("agents.results", "Measure all agents, and write results, figures and page.", EPILOG)
    p.add_argument("--envs", nargs="+", metavar="ENV", help="environments to measure (default: all)")
    p.add_argument("--agents", nargs="+", metavar="NAME", help="agents to measure (default: all)")
    p.add_argument(
        "--runs",
        type=Path,
        default=ROOT / "runs",
        metavar="FOLDER",
        help="folder of learners' runs (default runs/)",
    )
    p.add_argument(
        "--output",
        type=Path,
        metavar="FOLDER",
        help="where to write (default: this clone; with --quick, RUNS/quick)",
    )
    p.add_argument(
        "--episodes", type=int, metavar="N", help=f"episodes under each condition (default {EPISODES})"
    )
    p.add_argument(
        "--changed",
        type=int,
        metavar="N",
        help="at most N episodes under changed conditions (default: 200 for agents that plan, else no limit)",
    )
    p.add_argument("--quick", action="store_true", help=f"{QUICK} episodes, to see whether everything works")
    p.add_argument("--new", action="store_true", help="discard other agents' numbers in the summary")
    p.add_argument("--redraw", action="store_true", help="only remake figures and page from the summary")
    return p


@reports_errors("agents.results")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 where an agent failed, 2 for a user's mistake, 130 when interrupted."""
    args = parser().parse_args(arguments)
    output = args.output or (args.runs / "quick" if args.quick else ROOT)
    try:
        if args.redraw:
            return show(load_summary(output, needed=True), output)
        envs = list(dict.fromkeys(map(check_env, args.envs))) if args.envs else list(TASKS)
        usual = QUICK if args.quick else EPISODES
        episodes = usual if args.episodes is None else args.episodes
        if not 1 <= episodes <= 1_000_000:
            raise UserError(f"--episodes must lie between 1 and 1000000, got {episodes}")
        check_numbers(args, changed=1)
        if not args.new:
            load_summary(output)  # fail now, not after everything has been measured
        found = measure_all(envs, args.agents, args.runs, episodes, args.changed)
        # Read only now, as another command may have written the summary meanwhile.
        data = summarise_results(found, usual, {} if args.new else load_summary(output))
        write_file(output / SUMMARY, readable_json(data))
        show(data, output)
        broken = [problem for evaluation, _ in found for problem in evaluation.broken]
        for problem in broken:
            print(f"left out: {problem}", file=sys.stderr)
        return 1 if broken else 0
    except KeyboardInterrupt:
        print("\nStopped. What was measured is kept; re-run the command to resume.", file=sys.stderr)
        return 130


# --- measuring ----------------------------------------------------------------------------------------------


def measure_all(
    envs: Sequence[str], names: Sequence[str] | None, runs: Path, episodes: int, changed: int | None
) -> list[tuple[Evaluation, list[MeasurementJob]]]:
    """Make the missing measurements; return everything to measure, by environment."""
    if runs.exists() and not runs.is_dir():
        raise UserError(f"--runs must be a folder, {runs} is not")
    evaluations = [Evaluation(env_id, runs) for env_id in envs]
    if names is not None:
        there = {entrant.name for evaluation in evaluations for entrant in evaluation.entrants}
        if unknown := sorted(set(names) - there):
            raise UserError(f"there is no agent {unknown[0]!r}; {hint(unknown[0], sorted(there))}")
    found = [(evaluation, evaluation.jobs(names, episodes, changed)) for evaluation in evaluations]
    jobs = [(evaluation, job) for evaluation, own in found for job in own]
    todo = [(evaluation, job) for evaluation, job in jobs if job.key not in evaluation.returns]
    print(f"{len(jobs)} measurements, {len(jobs) - len(todo)} of them made before", flush=True)
    measure_policies(todo)
    return found


# --- the summary --------------------------------------------------------------------------------------------


def summarise_results(
    found: Sequence[tuple[Evaluation, list[MeasurementJob]]], episodes: int, old: Data
) -> Data:
    """Return all that the page and the figures need; agents not measured now keep their old numbers."""
    envs = dict(old.get("envs", {}))
    for evaluation, jobs in found:
        envs[evaluation.env] = summarise_evaluation(evaluation, jobs, envs.get(evaluation.env))
    envs = {env_id: envs[env_id] for env_id in TASKS if env_id in envs and envs[env_id]["agents"]}
    if not envs:
        reasons = [problem for evaluation, _ in found for problem in [*evaluation.broken, *evaluation.absent]]
        raise UserError("no agent could be measured" + "".join(f"\n  {reason}" for reason in reasons))
    return {
        "schema": SCHEMA,
        "date": datetime.date.today().isoformat(),
        "first_seed": FIRST_FRESH_SEED,
        "episodes": episodes,
        "machine": machine(),
        "versions": {"lag_envs": __version__} | installed_versions(PACKAGES),
        "envs": envs,
        "learners": rounded_data(summarise_learners(envs)),
    }


def summarise_evaluation(evaluation: Evaluation, jobs: Sequence[MeasurementJob], before: Data | None) -> Data:
    """Return the summary of an environment; other agents' numbers are taken from an earlier summary."""
    env_id = evaluation.env
    found = rounded_data(summarise_env(evaluation.measured(jobs), known_returns(env_id)))
    if before is not None and before["known"] == found["known"]:
        found["agents"] = best_first(before["agents"] | found["agents"])
        found["improvement"] = rounded_data(chances_of_improvement(found["agents"]))
    elif before is not None and (lost := sorted(set(before["agents"]) - set(found["agents"]))):
        print(f"{env_id}: removed, as the scale of scores has changed: {', '.join(lost)}", file=sys.stderr)
    kinds = {agent["kind"] for agent in found["agents"].values()}
    there = {*found["agents"], *(["learners"] if "learned" in kinds else [])}
    names = TASKS[env_id]().observation
    found["observation_std"] = rounded_data(dict(zip(names, evaluation.noise.tolist(), strict=True)))
    found["problems"] = [text for text in evaluation.absent if text.split(":")[0] not in there]
    return found


def write_envs(file: Path, about: Data, envs: Data) -> None:
    """Write the results of all environments, in the order of the tasks, after what they have in common."""
    in_order = {name: envs[name] for name in TASKS if name in envs}
    write_file(file, readable_json(about | {"envs": in_order}))


def load_summary(output: Path, needed: bool = False) -> Data:
    """Return the summary in an output folder; an empty one if there is none and it need not exist."""
    file = output / SUMMARY
    if not file.exists():
        if needed:
            raise UserError(f"there is no {file}; measure first")
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(content, dict) or content.get("schema") != SCHEMA or not content["envs"]:
            raise ValueError("it was not written by this version")
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{file} cannot be read ({error}); --new starts over") from error
    return content


def show(data: Data, output: Path) -> int:
    """Write figures, page, and the table of the best agents."""
    from agents.figures import figures
    from agents.report import agents_page, summary_table
    from lag_envs.generated import replaced

    files = figures(data, output / PICTURES)
    for old in set((output / PICTURES).glob("agents-*.png")) - set(files):
        old.unlink()
    write_file(output / PAGE, agents_page(data))
    training = output / TRAINING
    if training.exists():
        write_file(training, replaced(training.read_text(encoding="utf-8"), "agents", summary_table(data)))
    print(f"Written: {output / PAGE} and {len(files)} figures")
    return 0


if __name__ == "__main__":
    sys.exit(main())
