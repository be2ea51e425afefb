"""Who is measured, under which conditions, and measurements that are kept as soon as they are there."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
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
from lag_envs import TASKS, __version__, controllers, store
from lag_envs.evaluation.conditions import Condition, Sensor
from lag_envs.evaluation.rollout import Rollout, Step
from lag_envs.evaluation.statistics import rounded

AGENTS = Path(__file__).parent
OPTIMA = AGENTS / "results" / "optimum"
CONTROLLERS = Path(controllers.__file__).parent

# --- who is measured ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entrant:
    """One policy: of an agent that is not trained, or of one training run.

    Parameters
    ----------
    env, name, kind : str
        Id of the environment, name of the agent, and "classical", "optimal" or "learned".
    make : callable
        Returns the policy; without arguments.
    mark : str
        Changes with what decides how it acts.
    run : dict, optional
        What ``result.json`` holds, for a learner.
    """

    env: str
    name: str
    kind: str
    make: Callable[[], Any]
    mark: str
    run: Data | None = None

    @property
    def seed(self) -> int | None:
        """Seed of the training."""
        return None if self.run is None else self.run["seed"]

    def __str__(self) -> str:
        seed = "" if self.seed is None else f" seed {self.seed}"
        return f"{self.env} {self.name}{seed}"


@dataclass
class Field:
    """Who is measured on an environment, and what is wrong with others."""

    env: str
    entrants: list[Entrant] = field(default_factory=list)
    #: Agents that are not there, and those with which something is wrong.
    absent: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


def gather(env_id: str, runs: Path) -> Field:
    """Return the classical controllers, the optimal policy and the learners' runs of an environment."""
    found = Field(env_id)
    task = TASKS[env_id]()
    for name in controllers.controllers(task):
        make = partial(controllers.build, task, name)
        found.entrants.append(Entrant(env_id, name, "classical", make, digest(CONTROLLERS)))
    if reason := no_optimum(env_id):
        found.absent.append(f"optimal: {reason}")
    else:
        mark = digest("optimum.py", "value_iteration.py", OPTIMA / f"{env_id}.json")
        found.entrants.append(Entrant(env_id, "optimal", "optimal", partial(_optimal, env_id), mark))
    folders = [file.parent for file in runs.glob(f"{env_id}/*/seed*/{RESULT}")]
    folders.sort(key=lambda p: (p.parent.name, len(p.name), p.name))
    first: dict[str, Entrant] = {}
    for folder in folders:
        try:
            entrant = learned(env_id, folder)
            check_alike(entrant, first.setdefault(entrant.name, entrant))
        except UserError as error:
            found.broken.append(str(error))
        else:
            found.entrants.append(entrant)
    if not first:
        found.absent.append("learners: no finished run")
    return found


def no_optimum(env_id: str) -> str:
    """Return why there is no optimal policy; nothing where there is one."""
    try:
        from agents.optimum import played
    except ImportError:
        return "agents.optimum is not there"
    if env_id not in played():
        return "value iteration gives no policy here"
    if not (OPTIMA / f"{env_id}.json").exists():
        return "not computed; `python -m agents.optimum` does"
    return ""


def _optimal(env_id: str) -> Any:
    from agents.optimum import Optimal

    return Optimal(env_id)


def _policy(folder: Path) -> Any:
    import torch

    from agents.learners import load_policy

    torch.set_num_threads(1)
    return load_policy(folder)


def learned(env_id: str, folder: Path) -> Entrant:
    """Return the policy of a finished run, or raise a UserError."""
    result = read_result(folder / RESULT)
    own = env_id, folder.parent.name, folder.name.removeprefix("seed")
    if (result.get("env"), result.get("algo"), str(result.get("seed"))) != own:
        raise UserError(
            f"{folder / RESULT} is of {result.get('env')} {result.get('algo')} seed {result.get('seed')},"
            " not of what its folder says; move the run to where it belongs"
        )
    try:
        float(result["wall_seconds"]), int(result["trained"]), result["hyperparameters"], result["steps"]
        np.array(result["curve"], np.float64).reshape(-1, 3)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{folder / RESULT} cannot be read ({error!r}); train the run anew") from error
    if not (folder / MODEL).exists():
        raise UserError(f"{folder} has a result but no {MODEL}; train the run anew, or remove it")
    mark = digest(folder / MODEL, folder / NORMALISATION)
    return Entrant(env_id, own[1], "learned", partial(_policy, folder), mark, result)


def check_alike(entrant: Entrant, first: Entrant) -> None:
    """Raise a UserError where two runs of a learner were not trained alike, and so are no two samples."""
    assert entrant.run is not None and first.run is not None
    for name in ("steps", "hyperparameters"):
        if entrant.run[name] != first.run[name]:
            raise UserError(
                f"{entrant} was trained with other {name} than {first}; both cannot count as the same learner"
            )


def digest(*files: Path | str) -> str:
    """Return what changes with the files; names are modules or folders in `agents`."""
    total = hashlib.sha256()
    for file in files:
        path = file if isinstance(file, Path) else AGENTS / file
        for part in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            total.update(part.name.encode() + (part.read_bytes() if part.exists() else b""))
    return total.hexdigest()[:16]


# --- measuring ----------------------------------------------------------------------------------------------


class Store:
    """Measurements of an environment, a line of JSON for each, written as soon as it is there.

    Parameters
    ----------
    file : Path
        Where they are kept. Lines that cannot be read are measured again.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.returns: dict[str, list[float]] = {}
        for row in store.rows(file):
            with suppress(ValueError, KeyError, TypeError):  # damaged
                self.returns[row["key"]] = [float(x) for x in row["returns"]]

    def add(self, key: str, about: Data, returns: NDArray) -> None:
        """Keep a measurement."""
        row = {"key": key, **about, "returns": rounded(returns.tolist())}
        store.append(self.file, row)
        self.returns[key] = row["returns"]


@dataclass(frozen=True)
class Job:
    """One policy under one condition."""

    entrant: Entrant
    condition: Condition
    episodes: int

    @property
    def key(self) -> str:
        """What the returns are found by again: all that decides them."""
        c, e = self.condition, self.entrant
        what = [e.env, e.name, e.seed, e.mark, c.options, c.noise, c.late, self.episodes, __version__]
        return hashlib.sha256(json.dumps([*what, FIRST_FRESH_SEED, SCHEMA]).encode()).hexdigest()[:24]

    @property
    def steps(self) -> int:
        """Steps that it takes at most."""
        return int(TASKS[self.entrant.env](**self.condition.options).limit)


def plans(entrant: Entrant) -> bool:
    """Tell whether an agent plans before each episode, which takes long."""
    found = controllers.controllers(TASKS[entrant.env]).get(entrant.name)
    return entrant.kind == "classical" and found is not None and found.plans


def measure(job: Job, agent: Any, scale: NDArray, tick: Callable[[Step], Any]) -> NDArray[np.float64]:
    """Return the returns of a policy under a condition, shape (episodes,).

    Parameters
    ----------
    job : Job
        What to measure.
    agent : object
        The policy.
    scale : ndarray, shape (n_observation,)
        What noise is relative to.
    tick : callable
        Called with each step.
    """
    found = job.condition
    sensor = Sensor(found.noise * scale, found.late)
    rollout = Rollout(job.entrant.env, agent, fresh_seeds(job.episodes), sensor, **found.options)
    return rollout.run(tick)


def follow(
    todo: Iterable[Job],
    stores: dict[str, Store],
    scales: dict[str, NDArray],
    fields: dict[str, Field],
) -> None:
    """Measure, policy by policy, and show how far it is and what is left."""
    from tqdm import tqdm

    groups: dict[str, list[Job]] = {}
    for job in todo:
        groups.setdefault(str(job.entrant), []).append(job)
    total = sum(job.steps for jobs in groups.values() for job in jobs)
    started = time.monotonic()
    with tqdm(total=total, unit=" steps", unit_scale=True, disable=None, dynamic_ncols=True) as bar:
        done = 0
        for name, jobs in groups.items():
            bar.set_description_str(name)
            env_id, agent = jobs[0].entrant.env, None
            said = ""
            for job in jobs:
                try:
                    # What draws random numbers begins anew, so that the order of measurements is all one.
                    if agent is None or hasattr(agent, "rng"):
                        agent = job.entrant.make()
                    if not job.condition.suits(agent, plans(job.entrant)):
                        continue
                    returns = measure(job, agent, scales[env_id], bar.update)
                except Exception as error:  # whatever an agent does; the others are measured all the same
                    first = f"{type(error).__name__}: {error}".splitlines()[0]
                    fields[env_id].broken.append(f"{name}, {job.condition.name}: {first}")
                else:
                    about = {"agent": name, "condition": job.condition.name}
                    stores[env_id].add(job.key, about, returns)
                    said = said or f"{job.condition.name} {returns.mean():.4g}"
                done += job.steps
                bar.update(done - bar.n)
            seconds = time.monotonic() - started
            left = seconds * (total - done) / max(done, 1)
            if said:
                bar.write(f"{name}: {said} ({seconds:.0f} s, {left:.0f} s left)")
                sys.stdout.flush()
