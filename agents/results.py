"""Measure all agents on all environments, and write the results, figures and page that this project commits.

``python -m agents.results --help`` tells more.
"""

from __future__ import annotations

import argparse
import datetime
import errno
import json
import re
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from numpy.typing import NDArray

from agents.analysis import NOMINAL, Data, compare, ranked, rounded, summarise_env, summarise_learners
from agents.evaluate import observation_std
from agents.measure import Entrant, Field, Job, Store, conditions, follow, gather, plans
from agents.run import FIRST_FRESH_SEED, SCHEMA, UserError, check_env, terminable
from lag_envs import TASKS, __version__
from lag_envs.host import machine
from lag_envs.scores import known_returns
from lag_envs.store import write

ROOT = Path(__file__).parents[1]
SUMMARY, PAGE, PICTURES = "agents/results/summary.json", "docs/agents.md", "docs/images"
#: What has the table of the best agents.
TRAINING = "docs/training.md"
#: Episodes under each condition; those of agents that take long, where something is changed; with --quick.
EPISODES, PLANNED, QUICK = 1000, 200, 20
#: Seed of the random actions from which the noise's size is taken.
SCALE_SEED = 3_000_000_000
PACKAGES = ("gymnasium", "numpy", "numba", "scipy", "torch", "stable-baselines3", "sb3-contrib", "matplotlib")

EPILOG = f"""what it reads and writes:
  RUNS/ENV/ALGO/seed<K>/       policies that `python -m agents.train` left (default runs/)
  RUNS/measurements/ENV.jsonl  what has been measured; it is not measured again
  OUTPUT/{SUMMARY}   all numbers
  OUTPUT/{PAGE}        the page, with figures in OUTPUT/{PICTURES}
  OUTPUT/docs/training.md     the table in it, where there is one

It can be interrupted at any time; re-run it to resume. Agents that are not there now (other machines'
runs, say) keep the numbers that the summary has of them. Commands for different --envs may run side by side.
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = argparse.ArgumentParser(
        prog="python -m agents.results",
        description="Measure all agents, and write results, figures and page.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--envs", nargs="+", metavar="ENV", help="environments to measure (default: all)")
    p.add_argument("--agents", nargs="+", metavar="NAME", help="agents to measure (default: all)")
    p.add_argument("--runs", type=Path, default=ROOT / "runs", metavar="FOLDER", help="default runs/")
    p.add_argument(
        "--output", type=Path, metavar="FOLDER", help="default: this checkout; with --quick, RUNS/quick"
    )
    p.add_argument("--episodes", type=int, metavar="N", help=f"under each condition (default {EPISODES})")
    p.add_argument("--quick", action="store_true", help=f"{QUICK} episodes, to see whether all works")
    p.add_argument("--new", action="store_true", help="forget what the summary has of other agents")
    p.add_argument("--redraw", action="store_true", help="measure nothing: figures and page from the summary")
    return p


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
        if not args.new:
            load_summary(output)  # better now than when all is measured
        with terminable():
            broken, parts = measure_all(envs, args.agents, args.runs, episodes)
            # Only now: another command may have written it meanwhile.
            data = summarise(*parts, usual, {} if args.new else load_summary(output))
            write(output / SUMMARY, to_json(data))
            show(data, output)
        for problem in broken:
            print(f"left out: {problem}", file=sys.stderr)
        return 1 if broken else 0
    except UserError as error:
        print(f"agents.results: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        full = " (no space left)" if error.errno == errno.ENOSPC else ""
        print(f"agents.results: error: {error}{full}; what was measured before is kept", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nStopped. What was measured is kept; re-run the command to resume.", file=sys.stderr)
        return 130


# --- measuring ----------------------------------------------------------------------------------------------


def measure_all(
    envs: Sequence[str], names: Sequence[str] | None, runs: Path, episodes: int
) -> tuple[list[str], tuple]:
    """Measure what has not been measured; return what is wrong, and what `summarise` begins with."""
    if runs.exists() and not runs.is_dir():
        raise UserError(f"--runs must be a folder, {runs} is not")
    fields = {env_id: gather(env_id, runs) for env_id in envs}
    if names is not None:
        there = {entrant.name for found in fields.values() for entrant in found.entrants}
        if unknown := sorted(set(names) - there):
            raise UserError(f"there is no agent {unknown[0]!r} here; there are {', '.join(sorted(there))}")
    stores = {env_id: Store(runs / "measurements" / f"{env_id}.jsonl") for env_id in envs}
    jobs = [
        Job(entrant, condition, episodes if condition.name == NOMINAL else min(episodes, few))
        for env_id, found in fields.items()
        for entrant in found.entrants
        if names is None or entrant.name in names
        for few in [PLANNED if plans(entrant) else episodes]
        for condition in conditions(env_id)
    ]
    todo = [job for job in jobs if job.key not in stores[job.entrant.env].returns]
    print(f"{len(jobs)} measurements, {len(jobs) - len(todo)} of them made before", flush=True)
    scales = {env_id: observation_std(env_id, SCALE_SEED) for env_id in envs}
    follow(todo, stores, scales, fields)

    broken = [problem for found in fields.values() for problem in found.broken]
    return broken, (fields, jobs, stores, scales)


# --- the summary --------------------------------------------------------------------------------------------


def summarise(
    fields: dict[str, Field],
    jobs: Iterable[Job],
    stores: dict[str, Store],
    scales: dict[str, NDArray],
    episodes: int,
    old: Data,
) -> Data:
    """Return all that page and figures need; agents that were not measured now keep their old numbers."""
    measured: dict[str, dict[str, Data]] = {env_id: {} for env_id in fields}
    policies: dict[tuple[str, str], dict[int | None, dict[str, list[float]]]] = {}
    entrants: dict[tuple[str, str, int | None], Entrant] = {}
    for job in jobs:
        e = job.entrant
        returns = stores[e.env].returns.get(job.key)
        if returns is not None:
            entrants[e.env, e.name, e.seed] = e
            policies.setdefault((e.env, e.name), {}).setdefault(e.seed, {})[job.condition.name] = returns
    for (env_id, name), by_seed in policies.items():
        by_seed = {seed: found for seed, found in by_seed.items() if NOMINAL in found}
        if not by_seed:
            continue
        who = [entrants[env_id, name, seed] for seed in by_seed]
        agent: Data = {"name": name, "kind": who[0].kind, "conditions": {}}
        for condition in conditions(env_id):
            groups = [found[condition.name] for found in by_seed.values() if condition.name in found]
            if groups:
                agent["conditions"][condition.name] = groups
        if agent["kind"] == "learned":
            results = [e.run or {} for e in who]
            agent |= {
                "seeds": [r["seed"] for r in results],
                "steps": [r["trained"] for r in results],
                "seconds": [r["wall_seconds"] for r in results],
                "curves": [r["curve"] for r in results],
            }
            agent["trained_on"] = sorted({_where(r) for r in results})
        measured[env_id][name] = agent

    envs: dict[str, Data] = {}
    for env_id in TASKS:
        before = old.get("envs", {}).get(env_id)
        if env_id not in fields:
            if before is not None:
                envs[env_id] = before
            continue
        scale = known_returns(env_id)
        known = (scale.random, scale.best) if scale else None
        found = rounded(summarise_env(measured[env_id].values(), known))
        if before is not None and before["known"] == found["known"]:
            found["agents"] = ranked(before["agents"] | found["agents"])
            found["improvement"] = rounded(compare(found["agents"]))
        elif before is not None and (lost := sorted(set(before["agents"]) - set(found["agents"]))):
            print(
                f"{env_id}: forgotten, as scores have another range now: {', '.join(lost)}", file=sys.stderr
            )
        if not found["agents"]:
            continue
        absent = [text for text in fields[env_id].absent if text.split(":")[0] not in found["agents"]]
        if any(agent["kind"] == "learned" for agent in found["agents"].values()):
            absent = [text for text in absent if not text.startswith("learners")]
        names = TASKS[env_id]().observation
        found["observation_std"] = rounded(dict(zip(names, scales[env_id].tolist(), strict=True)))
        found["problems"] = absent
        envs[env_id] = found
    if not envs:
        reasons = [problem for found in fields.values() for problem in [*found.broken, *found.absent]]
        raise UserError("no agent could be measured" + "".join(f"\n  {reason}" for reason in reasons))
    return {
        "schema": SCHEMA,
        "date": datetime.date.today().isoformat(),
        "first_seed": FIRST_FRESH_SEED,
        "episodes": episodes,
        "machine": machine(),
        "versions": versions(),
        "envs": envs,
        "learners": rounded(summarise_learners(envs)),
    }


def _where(result: Data) -> str:
    """Return where a run was trained."""
    found = ", ".join(f"{name} {number}" for name, number in result.get("versions", {}).items())
    return f"{result.get('machine', 'unknown machine')}: {found}"


def versions() -> dict[str, str]:
    """Return the versions of what took part."""
    found = {"lag_envs": __version__}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def to_json(data: Data) -> str:
    """Return data as JSON, with lists of numbers on a line."""
    text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
    return re.sub(r"\[[^\[\]{}\"]*\]", lambda found: " ".join(found[0].split()), text) + "\n"


def load_summary(output: Path, needed: bool = False) -> Data:
    """Return the summary that is in an output folder; an empty one where there is none and none is needed."""
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
    from agents.report import figures, page, summary
    from lag_envs.generated import replaced

    files = figures(data, output / PICTURES)
    for old in set((output / PICTURES).glob("agents-*.png")) - set(files):
        old.unlink()
    write(output / PAGE, page(data))
    training = output / TRAINING
    if training.exists():
        write(training, replaced(training.read_text(encoding="utf-8"), "agents", summary(data)))
    print(f"Written: {output / PAGE} and {len(files)} figures")
    return 0


if __name__ == "__main__":
    sys.exit(main())
