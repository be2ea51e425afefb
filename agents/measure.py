"""The agents to measure, the conditions, and the measurements; each is stored as soon as it is done."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.analysis import Data
from agents.run import (
    FIRST_FRESH_SEED,
    MODEL,
    NORMALISATION,
    RESULT,
    SCHEMA,
    UserError,
    fresh_seeds,
    read_result,
)
from agents.solution import RESULTS, GreedyPolicy, played
from lag_envs import TASKS, __version__, controllers, store
from lag_envs.controllers.basic import trait
from lag_envs.evaluation.conditions import NOMINAL, Condition, Sensor, conditions
from lag_envs.evaluation.rollout import Meter, Rollout, RolloutStep, observation_std
from lag_envs.evaluation.statistics import rounded_data
from lag_envs.leaderboard import export
from lag_envs.leaderboard.export import exported, find

AGENTS = Path(__file__).parent
CONTROLLERS = Path(controllers.__file__).parent
EXPORT = Path(export.__file__)
#: Episodes of slow agents under changed conditions.
PLANNED = 200
#: First seed of the episodes of random actions that determine the size of the noise.
NOISE_SEED = 3_000_000_000

# --- who is measured ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entrant:
    """One policy: an untrained agent's, or the result of one training run.

    Parameters
    ----------
    env, name, kind : str
        Id of the environment, name of the agent, and "classical", "optimal" or "learned".
    make : callable
        Returns the policy; takes no arguments.
    mark : str
        A text that changes with everything that determines how the policy acts.
    run : dict, optional
        The contents of ``result.json``, for a learner.
    plans : bool
        Whether the policy plans before each episode, which takes long.
    """

    env: str
    name: str
    kind: str
    make: Callable[[], Any]
    mark: str
    run: Data | None = None
    plans: bool = False

    @property
    def seed(self) -> int | None:
        """Seed of the training."""
        return None if self.run is None else self.run["seed"]

    def __str__(self) -> str:
        seed = "" if self.seed is None else f" seed {self.seed}"
        return f"{self.env} {self.name}{seed}"


def no_optimum(env_id: str) -> str:
    """Return why there is no optimal policy; an empty text if there is one."""
    if env_id not in played():
        return "value iteration gives no policy here"
    if not (RESULTS / f"{env_id}.json").exists():
        return "not computed; `python -m agents.optimum` does"
    return ""


def _policy(env_id: str, folder: Path) -> Any:
    """Return a learner's policy as the board plays it.

    A model of Stable-Baselines3 agrees with that policy only to float32's rounding, which chaotic motion
    amplifies.
    """
    import torch

    torch.set_num_threads(1)
    (source,) = find([folder])
    return exported(source, env_id).agent


def learned_policy(env_id: str, folder: Path) -> Entrant:
    """Return the policy of a finished run, or raise a UserError."""
    result = read_result(folder / RESULT)
    own = env_id, folder.parent.name, folder.name.removeprefix("seed")
    if (result.get("env"), result.get("algo"), str(result.get("seed"))) != own:
        raise UserError(
            f"{folder / RESULT} is of {result.get('env')} {result.get('algo')} seed {result.get('seed')},"
            " which is not what its folder says; move it to the right folder"
        )
    if not (folder / MODEL).exists():
        raise UserError(f"{folder} has a result but no {MODEL}; train the run again, or remove it")
    mark = digest(folder / MODEL, folder / NORMALISATION, EXPORT)
    return Entrant(env_id, own[1], "learned", partial(_policy, env_id, folder), mark, result)


def check_alike(entrant: Entrant, first: Entrant) -> None:
    """Raise a UserError if runs were trained differently, as they are then not of the same learner."""
    assert entrant.run is not None and first.run is not None
    for name in ("steps", "hyperparameters"):
        if entrant.run[name] != first.run[name]:
            raise UserError(
                f"{entrant} was trained with other {name} than {first}; both cannot count as the same learner"
            )


def digest(*files: Path | str) -> str:
    """Return a digest of the files; names are modules or folders in `agents`."""
    total = hashlib.sha256()
    for file in files:
        path = file if isinstance(file, Path) else AGENTS / file
        for part in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            total.update(part.name.encode() + (part.read_bytes() if part.exists() else b""))
    return total.hexdigest()[:16]


# --- measuring ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MeasurementJob:
    """One policy under one condition."""

    entrant: Entrant
    condition: Condition
    episodes: int

    @property
    def key(self) -> str:
        """The key under which the returns are stored: everything that determines them."""
        c, e = self.condition, self.entrant
        what = [e.env, e.name, e.seed, e.mark, c.options, c.noise, c.late, self.episodes, __version__]
        return hashlib.sha256(json.dumps([*what, FIRST_FRESH_SEED, SCHEMA]).encode()).hexdigest()[:24]

    @property
    def steps(self) -> int:
        """The largest number of steps."""
        return self.condition.steps(self.entrant.env) * self.episodes


class Evaluation:
    """The agents of an environment, and their measurements.

    Each measurement is stored as soon as it is done, as a line of JSON; a damaged one is repeated.

    Parameters
    ----------
    env_id : str
        The environment.
    runs : Path
        Folder of the learners' runs and the measurements.

    Attributes
    ----------
    entrants : list of Entrant
        The classical controllers, the optimal policy and the learners' runs, each agent's side by side.
    absent, broken : list of str
        Agents that are missing, and agents with a problem.
    returns : dict of str to list of float
        The returns of each `MeasurementJob`, by its key.
    noise : ndarray, shape (n_observation,)
        Scale of the observation noise.
    """

    def __init__(self, env_id: str, runs: Path) -> None:
        self.env = env_id
        self.entrants: list[Entrant] = []
        self.absent: list[str] = []
        self.broken: list[str] = []
        self._gather(runs)
        self.file, self.returns = runs / "measurements" / f"{env_id}.jsonl", {}
        for row in store.rows(self.file):
            with suppress(ValueError, KeyError, TypeError):  # damaged
                self.returns[row["key"]] = [float(x) for x in row["returns"]]
        self.noise = observation_std(env_id, range(NOISE_SEED, NOISE_SEED + 100))

    def _gather(self, runs: Path) -> None:
        task = TASKS[self.env]()
        for name, found in controllers.controllers(task).items():
            make = partial(controllers.build, task, name)
            entrant = Entrant(self.env, name, "classical", make, digest(CONTROLLERS), plans=found.plans)
            self.entrants.append(entrant)
        if reason := no_optimum(self.env):
            self.absent.append(f"optimal: {reason}")
        else:
            mark = digest("solution.py", "value_iteration.py", RESULTS / f"{self.env}.json")
            self.entrants.append(
                Entrant(self.env, "optimal", "optimal", partial(GreedyPolicy, self.env), mark)
            )
        folders = [file.parent for file in runs.glob(f"{self.env}/*/seed*/{RESULT}")]
        first: dict[str, Entrant] = {}
        for folder in sorted(folders, key=lambda p: (p.parent.name, len(p.name), p.name)):
            try:
                entrant = learned_policy(self.env, folder)
                check_alike(entrant, first.setdefault(entrant.name, entrant))
            except UserError as error:
                self.broken.append(str(error))
            else:
                self.entrants.append(entrant)
        if not first:
            self.absent.append("learners: no finished run")

    def jobs(
        self, names: Sequence[str] | None, episodes: int, changed: int | None = None
    ) -> list[MeasurementJob]:
        """Return the measurements to make for the named agents.

        Parameters
        ----------
        names : sequence of str, optional
            The agents; by default all.
        episodes : int
            Number of episodes.
        changed : int, optional
            Largest number of episodes under changed conditions; by default `PLANNED` for agents that plan.
        """

        def count(entrant: Entrant, condition: Condition) -> int:
            most = changed or (PLANNED if entrant.plans else episodes)
            return episodes if condition.name == NOMINAL else min(episodes, most)

        return [
            MeasurementJob(entrant, condition, count(entrant, condition))
            for entrant in self.entrants
            if names is None or entrant.name in names
            for condition in conditions(self.env)
        ]

    def run(self, job: MeasurementJob, agent: Any, tick: Callable[[RolloutStep], Any]) -> NDArray[np.float64]:
        """Return an agent's returns under a condition, shape (episodes,); `tick` is called with each step."""
        found = job.condition
        sensor = Sensor(found.noise * self.noise, found.late)
        return Rollout(self.env, agent, fresh_seeds(job.episodes), sensor, **found.options).run(tick)

    def keep(self, job: MeasurementJob, returns: NDArray) -> None:
        """Store a measurement."""
        about = {"key": job.key, "agent": str(job.entrant), "condition": job.condition.name}
        row = about | {"returns": rounded_data(returns.tolist())}
        store.append(self.file, row)
        self.returns[job.key] = row["returns"]

    def measured(self, jobs: Iterable[MeasurementJob]) -> Iterator[Data]:
        """Yield the input of `summarise_env` for each agent, from the finished jobs."""
        order = [condition.name for condition in conditions(self.env)]
        for name, group in groupby(jobs, key=lambda job: job.entrant.name):
            entrants, policies = [], []
            for entrant, own in groupby(group, key=lambda job: job.entrant):
                found = {job.condition.name: self.returns[job.key] for job in own if job.key in self.returns}
                if NOMINAL in found:
                    entrants.append(entrant)
                    policies.append(found)
            if not policies:
                continue
            agent: Data = {"name": name, "kind": entrants[0].kind}
            groups = {c: [found[c] for found in policies if c in found] for c in order}
            agent["conditions"] = {c: returns for c, returns in groups.items() if returns}
            if runs := [_timed(entrant.run) for entrant in entrants if entrant.run is not None]:
                told = {"seeds": "seed", "steps": "trained", "seconds": "seconds", "curves": "curve"}
                agent |= {many: [run[one] for run in runs] for many, one in told.items()}
                agent["trained_on"] = sorted(set(map(_where, runs)))
            yield agent


def _timed(run: Data) -> Data:
    """Return a run with its processor seconds, which other programs on the machine hardly affect."""
    wall = run["wall_seconds"]
    seconds = run.get("processor_seconds", wall)  # earlier versions did not count them
    share = seconds / wall if wall else 1.0
    return run | {"seconds": seconds, "curve": [(steps, share * s, mean) for steps, s, mean in run["curve"]]}


def _where(run: Data) -> str:
    """Return where a run was trained."""
    found = ", ".join(f"{name} {number}" for name, number in run.get("versions", {}).items())
    return f"{run.get('machine', 'unknown machine')}: {found}"


def measure_policies(todo: Sequence[tuple[Evaluation, MeasurementJob]]) -> None:
    """Measure, policy by policy, and show the progress."""
    from tqdm import tqdm

    total, started = sum(job.steps for _, job in todo), time.monotonic()
    with tqdm(total=total, unit=" steps", unit_scale=True, disable=None, dynamic_ncols=True) as bar:
        meter = Meter(total, lambda done, total: bar.update(done - bar.n))
        for entrant, group in groupby(todo, key=lambda pair: pair[1].entrant):
            bar.set_description_str(str(entrant))
            agent, said = None, ""
            for evaluation, job in group:
                try:
                    # Random numbers start over, so that the order of measurements does not matter.
                    if agent is None or trait(agent, "random"):
                        agent = entrant.make()
                    if not job.condition.suits(agent, entrant.plans):
                        continue
                    returns = evaluation.run(job, agent, meter)
                except Exception as error:  # whatever an agent does; the others are measured all the same
                    first = f"{type(error).__name__}: {error}".splitlines()[0]
                    evaluation.broken.append(f"{entrant}, {job.condition.name}: {first}")
                else:
                    evaluation.keep(job, returns)
                    said = said or f"{job.condition.name} {returns.mean():.4g}"
                finally:
                    meter.close(job.steps)
            seconds = time.monotonic() - started
            left = seconds * (total - meter.done) / max(meter.done, 1)
            if said:
                bar.write(f"{entrant}: {said} ({seconds:.0f} s, {left:.0f} s left)")
                sys.stdout.flush()
