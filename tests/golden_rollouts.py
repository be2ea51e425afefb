"""Recorded roll-outs, to check later rewrites against.

``python tests/golden_rollouts.py ID`` records those of an environment, without ids those of all, into
``golden/rollouts.npz`` and ``runs.json``. Do that only for a new environment, or if one is meant to change:
the file holds the package's results when version 0 of its environments was settled. The roll-outs use only
the public interface, so a rewrite need not touch this file.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import lag_envs
from lag_envs.errors import hint
from lag_envs.tasks import TASKS

GOLDEN, RUNS = (Path(__file__).parent / "golden" / name for name in ("rollouts.npz", "runs.json"))


class Run(NamedTuple):
    """The settings of a roll-out.

    Attributes
    ----------
    keywords : dict
        Arguments of ``make`` or ``make_vec``.
    steps : int
        Number of calls after the first reset; in older runs the episode in progress is finished.
    start : dict
        Options of the first reset.
    mode : str
        Autoreset mode of a batch; "" for a single environment.
    """

    keywords: dict[str, Any]
    steps: int
    start: dict[str, Any] = {}
    mode: str = ""

    @property
    def lanes(self) -> int:
        """Number of environments."""
        return len(next(iter(self.mixed.values()))) if self.mode else 1

    @property
    def mixed(self) -> dict[str, list[float]]:
        """Keywords with a separate value for each environment of a batch."""
        return {name: value for name, value in self.keywords.items() if isinstance(value, list)}


def runs() -> dict[str, Run]:
    """Return the recorded runs by name: the id, a slash, and the special feature."""
    return {name: Run(**run) for name, run in json.loads(RUNS.read_text()).items()}


def planned() -> dict[str, Run]:
    """Return the runs to record: some of every task, from its examples.

    They are few and short, so that a file of all tasks stays small, and chaos has no time to grow. For the
    tasks that were recorded first there are longer ones, and batches in every reset mode, which do not depend
    on the task.
    """
    out = {}
    for env_id, task in TASKS.items():
        cases, dt = task.examples, task.interval
        start = {**cases.start, **({"state": cases.moving} if cases.moving else {})}
        other = {"dt": 1.5 * dt, "duration": 18 * dt, "diagnostics": True}
        out[f"{env_id}/defaults"] = Run({}, 20)
        out[f"{env_id}/another dt"] = Run(other, 14, start)
        for name, keywords in cases.variants.items():
            out[f"{env_id}/{name}"] = Run({"duration": 6 * dt, **keywords}, 8)
        mixed = {name: list(values[:2]) for name, values in cases.batch.items()}
        out[f"{env_id}/SameStep"] = Run({**mixed, "duration": 6 * dt}, 8, mode="SameStep")
    return out


class Roll:
    """An environment or a batch behind one interface, a single one being a batch of one.

    Parameters
    ----------
    env_id : str
        The environment.
    run : Run
        The settings of the roll-out.
    """

    def __init__(self, env_id: str, run: Run) -> None:
        self._mode, self._n = run.mode, run.lanes
        if run.mode:
            self.envs: Any = gym.make_vec(env_id, num_envs=run.lanes, autoreset_mode=run.mode, **run.keywords)
        else:
            self.envs = gym.make(env_id, **run.keywords)
        self._env = self.envs.unwrapped

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> dict[str, Any]:
        """Reset all, or those in a mask, and return everything observable."""
        observations, infos = self.envs.reset(seed=seed, options=options)
        zeros = np.zeros(self._n)
        return self._seen(observations, zeros, zeros.astype(bool), zeros.astype(bool), infos)

    def step(self, actions: np.ndarray) -> dict[str, Any]:
        """Take a step with shares of the largest action, shape (n,), and return everything observable.

        For choices, the share selects one by its place in the list; of several controls, every other one gets
        half the share, with the opposite sign.
        """
        space: Any = self.envs.single_action_space if self._mode else self.envs.action_space
        if isinstance(space, gym.spaces.Box):
            given = actions[:, None] * np.resize(np.float32([1.0, -0.5]), space.shape) * space.high
        else:
            n = space.n if isinstance(space, gym.spaces.Discrete) else space.nvec
            shares = actions[:, None] * np.resize([1.0, -0.5], np.shape(n)) if np.shape(n) else actions
            places = np.floor((0.5 + 0.5 * np.clip(shares, -1.0, 1.0)) * n).astype(np.int64)
            given = np.minimum(places, n - 1)
        return self._seen(*self.envs.step(given if self._mode else given[0]))

    def _seen(self, observations, rewards, terminated, truncated, infos) -> dict[str, Any]:  # type: ignore
        n = self._n
        over = np.reshape(terminated, n) * np.uint8(1) + np.reshape(truncated, n) * np.uint8(2)
        seen = {
            "observation": np.reshape(observations, (n, -1)).astype(np.float32),
            "state": np.reshape(self._env.state, (n, -1)),
            "reward": np.reshape(rewards, n).astype(np.float64),
            "over": over.astype(np.uint8),
        }
        if self._env.target is not None:
            targets = np.reshape(self._env.target, (n, -1))
            seen["target"] = targets[:, 0] if targets.shape[1] == 1 else targets
        if "final_obs" in infos:
            last = seen["observation"].copy()
            for i in np.flatnonzero(infos["_final_obs"]):
                last[i] = infos["final_obs"][i]
            seen["last observation"] = last
        if not self._mode:
            seen |= {f"info {name}": np.array([value]) for name, value in infos.items()}
        return seen


def play(env_id: str, run: Run, actions: np.ndarray) -> list[dict[str, Any]]:
    """Roll out: return everything observable after the first reset and after each later call.

    Finished episodes are reset by the next call, unless the environment does it itself; that call's row of
    actions is unused.

    Parameters
    ----------
    env_id : str
        The environment.
    run : Run
        The settings of the roll-out.
    actions : ndarray of int8, shape (calls, n)
        Actions, in hundredths, sometimes beyond ±1; the first row belongs to the reset and is unused.
    """
    roll = Roll(env_id, run)
    seen = [roll.reset(seed=1, options=run.start or None)]
    while len(seen) < len(actions):
        over = seen[-1]["over"] > 0
        if over.any() and run.mode in ("", "Disabled"):
            seen.append(roll.reset(options={"reset_mask": over} if run.mode else None))
        else:
            seen.append(roll.step((actions[len(seen)] / 100.0).astype(np.float32)))
    return seen


def stack(seen: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return the observations as arrays, with the calls along the first axis."""
    arrays = {name: np.array([s[name] for s in seen]) for name in seen[0]}
    # Most calls end no episode: if no final observation is given, it is the one returned.
    if any("last observation" in s for s in seen):
        over = arrays["over"] > 0
        last = np.array([s.get("last observation", s["observation"]) for s in seen])
        arrays["last observation"] = last[over]
    return arrays


def record(chosen: dict[str, Run]) -> dict[str, np.ndarray]:
    """Return runs as arrays, by "run/array"."""
    out = {"version": np.array(lag_envs.__version__)}
    for number, (name, run) in enumerate(chosen.items()):
        rng = np.random.default_rng(number)
        # Held for some steps, so that they have an effect.
        given = rng.integers(-120, 121, (run.steps + 1, run.lanes)).repeat(rng.choice([1, 4]), axis=0)
        given = given[: run.steps + 1].astype(np.int8)
        arrays = {"actions": given, **stack(play(name.partition("/")[0], run, given))}
        out |= {f"{name}/{key}": value for key, value in arrays.items()}
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Record runs, and write them to the files."""
    parser = argparse.ArgumentParser(
        prog="python tests/golden_rollouts.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "ids", nargs="*", metavar="ID", help="record these, and keep the others as they are (default: all)"
    )
    ids = parser.parse_args(arguments).ids
    for env_id in ids:
        if env_id not in TASKS:
            parser.error(f"there is no environment {env_id!r}; {hint(env_id, TASKS)}")
    chosen = {name: run for name, run in planned().items() if name.partition("/")[0] in (ids or TASKS)}
    kept_runs = {name: run for name, run in runs().items() if ids and name not in chosen}
    with np.load(GOLDEN) as file:
        kept = {key: file[key] for key in file if key.rpartition("/")[0] in kept_runs}
    recorded = kept | record(chosen)
    everything = {name: run._asdict() for name, run in (kept_runs | chosen).items()}
    RUNS.write_text(json.dumps(everything, indent=1) + "\n")
    np.savez_compressed(GOLDEN, **recorded)  # type: ignore[arg-type]
    ends = sum(np.count_nonzero(v) for k, v in recorded.items() if k.endswith("/over"))
    calls = sum(v.size for k, v in recorded.items() if k.endswith("/over"))
    print(f"{GOLDEN}: {len(everything)} runs, {calls} calls, {ends} ends, {GOLDEN.stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
