"""Recompute the scores of a submission: 1,000 episodes of each policy, and fewer under disturbances."""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs import __version__
from lag_envs.errors import UserError
from lag_envs.evaluation.conditions import OFTEN, Condition, often, on_board
from lag_envs.evaluation.rollout import Meter, Outcome, PolicyError, Rollout, play, record_rollout
from lag_envs.evaluation.statistics import rounded_data
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.fields import ascii_text
from lag_envs.leaderboard.files import read_plain
from lag_envs.leaderboard.log import load_json
from lag_envs.leaderboard.results import UNPACKED, checked_result, code_digest, compare_results
from lag_envs.leaderboard.submission import Refused, Submission, about, load, read_files
from lag_envs.options import new_file
from lag_envs.store import write_file
from lag_envs.tables import aligned
from lag_envs.tasks import TASKS

Array = NDArray[np.float64]
#: Libraries that decide the bits of a trajectory.
PACKAGES = ("gymnasium", "numpy", "numba", "llvmlite", "scipy", "safetensors")


def verify(
    submission: Submission,
    nonce: str,
    episodes: int = protocol.EPISODES,
    progress: Callable[[int, int], Any] | None = None,
) -> dict[str, Any]:
    """Return the results of a submission's policies, all of them recomputed.

    Parameters
    ----------
    submission : Submission
        The submission.
    nonce : str
        Decides the episodes, together with the submission's digest, see `protocol.first_seed`.
    episodes : int
        Episodes of each policy. There are at most `protocol.DISTURBED_EPISODES` under disturbances, and when
        acting often without kicks.
    progress : callable, optional
        Called now and then with the steps taken so far, and the largest number of steps to take.

    Returns
    -------
    dict
        Of JSON types, as in `results.VerificationResult`: env, digest, nonce, episodes, policies,
        robustness, often, seconds, machine, versions, build. ``policies`` has for each one its seed, the
        episodes' returns, successes, times [s] (None if the goal was not reached) and efforts (mean of
        (u/U)²), a hash of all actions, rewards and ends, and the returns of the environment's ``reference``
        in the same episodes, if it has one. ``robustness`` maps disturbances to the policies' mean returns;
        ``often`` has those for acting ten times as often, None for an agent that counts steps and cannot.

    Raises
    ------
    Refused
        If a policy fails, or returns something that is not an action.
    """
    if not 1 <= episodes <= 100_000:
        raise ValueError(f"episodes must lie between 1 and 100000, got {episodes}")
    started, busy = time.perf_counter(), time.process_time()
    env, few = submission.env, min(episodes, protocol.DISTURBED_EPISODES)
    # Acting often draws other kicks, and averaging these out takes all episodes.
    runs = [(condition, few) for condition in on_board(env)]
    runs.append((often(env), episodes if TASKS[env]().draws else few))
    nominal, *sizes = (condition.steps(env) * count for condition, count in [(Condition(), episodes), *runs])

    def show(done: int, work: int) -> None:
        if time.process_time() - busy > protocol.CPU_SECONDS:
            raise Refused(f"verifying it takes more than {protocol.CPU_SECONDS:g} s of CPU time")
        if progress is not None:
            progress(done, work)

    meter = Meter((nominal + sum(sizes)) * len(submission.policies), show)
    policies: list[dict[str, Any]] = []
    means: dict[str, list[float | None]] = {condition.name: [] for condition, _ in runs}
    for number, (seed, policy) in enumerate(submission.policies):
        first = protocol.first_seed(submission.digest, nonce, number)
        seeds = range(first, first + episodes)
        try:
            rollout = Rollout(env, policy.agent(), seeds)
            outcome = Outcome(rollout)
            returns = rollout.run(outcome, meter)
            meter.close(nominal)
            reference = _reference(env, seeds)
            for size, (condition, count) in zip(sizes, runs, strict=True):
                agent, mean = policy.agent(), None
                if condition.suits(agent, policy.architecture.plans):
                    mean = float(Rollout(env, agent, seeds[:count], **condition.options).run(meter).mean())
                means[condition.name].append(mean)
                meter.close(size)
        except (PolicyError, Refused) as error:
            raise Refused(f"policy of seed {seed}: {error}") from error
        policies.append({"seed": seed, "returns": returns.tolist(), **reference, **outcome.result()})
    faster = means.pop(OFTEN)
    return {
        "env": env,
        "digest": submission.digest,
        "nonce": nonce,
        "episodes": episodes,
        "policies": policies,
        "robustness": means,
        "often": faster,
        "seconds": round(time.perf_counter() - started, 2),
        "machine": _machine(),
        "versions": {"python": platform.python_version(), "lag-envs": __version__}
        | {name: version(name) for name in PACKAGES},
        "build": code_digest(),
    }


def _machine() -> dict[str, Any]:
    from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

    from lag_envs.host import machine

    # The features that code is compiled for; a processor's name does not always tell them.
    features = hashlib.sha256(get_host_cpu_features().flatten().encode()).hexdigest()[:16]
    return machine() | {"target": f"{get_host_cpu_name()} {features}"}


def _reference(env_id: str, seeds: Sequence[int]) -> dict[str, list[float]]:
    """Return the reference's returns in the same episodes; empty if the environment has none."""
    reference = protocol.reference(env_id)
    if reference is None:
        return {}
    from lag_envs.controllers import build

    agent = build(TASKS[env_id](), reference.controller)
    return {"reference": play(env_id, agent, seeds).tolist()}


def record_again(
    submission: Submission, result: dict[str, Any], policy: int, chosen: Sequence[int]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Play some of the episodes of a verification again, and record them.

    Networks and linear feedback repeat the verification's numbers, bit for bit. Other agents may differ in
    the last digit, since their libraries round differently for another number of rows.

    Parameters
    ----------
    submission : Submission
        The submission.
    result : dict
        What `verify` returned, or its digest, nonce and number of episodes.
    policy : int
        Number of the policy, from 0.
    chosen : sequence of int
        Numbers of the episodes, from 0.

    Returns
    -------
    found : dict
        The same data as `verify` has of the policy, for these episodes alone.
    episodes : list of dict
        For each of them ``seed`` (of the training), ``reset_seed``, ``return``, ``dt`` [s], ``states`` (steps
        + 1 of them, in SI units), ``actions`` and ``rewards`` (steps), ``target`` (or None); rounded to 6
        digits.
    """
    env = submission.env
    training_seed, data = submission.policies[policy]
    first = protocol.first_seed(result["digest"], result["nonce"], policy)
    agent = data.agent()
    if agent.random:  # all episodes have to be played
        rows, seeds = list(chosen), list(range(first, first + result["episodes"]))
    else:
        rows, seeds = list(range(len(chosen))), [first + i for i in chosen]
    rollout = Rollout(env, agent, seeds)
    outcome = Outcome(rollout)
    played = record_rollout(rollout, outcome)
    told = {"seed": training_seed, "returns": rollout.returns[rows].tolist()}
    told |= _reference(env, [first + i for i in chosen])
    for name, values in outcome.result().items():
        told[name] = [values[row] for row in rows] if isinstance(values, list) else values

    def episode(i: int, row: int) -> dict[str, Any]:
        steps = int(played.steps[row])
        return {
            "seed": training_seed, "reset_seed": first + i, "return": float(rollout.returns[row]),
            "dt": played.task.dt,
            "states": rounded_data(played.states[: steps + 1, row].tolist()),
            "actions": _plain(played.actions[:steps, row]),
            "rewards": rounded_data(played.rewards[:steps, row].tolist()),
            "target": None if played.targets is None else _plain(played.targets[None, row])[0],
        }  # fmt: skip

    return told, [episode(i, row) for i, row in zip(chosen, rows, strict=True)]


def _plain(values: Array) -> list[Any]:
    """Return rows in JSON types; a row of one number as that number."""
    return rounded_data((values[:, 0] if values.shape[1:] == (1,) else values).tolist())


# --- the command --------------------------------------------------------------------------------------------


def verify_folder(
    folder: Path,
    nonce: str = "",
    episodes: int = protocol.EPISODES,
    progress: Callable[[int, int], Any] | None = None,
) -> dict[str, Any]:
    """Return the result of `verify` for a folder, or ``{"refused": reason}``."""
    try:
        return verify(load(folder), nonce, episodes, progress)
    except Refused as error:
        return {"refused": str(error)}


def declare_verify(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``verify``."""
    parser.add_argument("folders", metavar="FOLDER", nargs="+", help="a submission")
    parser.add_argument(
        "--nonce", default="", metavar="TEXT",
        help="determines the episodes' seeds (default: empty, for the same practice episodes each time)",
    )  # fmt: skip
    parser.add_argument(
        "--episodes", metavar="N", type=int, default=protocol.EPISODES,
        help="episodes of each policy (default: %(default)s, as on the board)",
    )  # fmt: skip
    parser.add_argument(
        "--jobs", metavar="N", type=int, default=1, help="submissions to verify in parallel (default: 1)"
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help='distribute the submissions over a Ray cluster; "local" starts one'
    )
    parser.add_argument("--json", type=new_file, metavar="FILE", help="write all results to this file")
    parser.add_argument(
        "--against", metavar="FILE",
        help="compare with results that --json wrote, here or elsewhere, for the same submissions, nonce and "
        "episodes; the exit status is 1 if they differ too much",
    )  # fmt: skip


def run_verify(args: argparse.Namespace) -> int:
    """Verify submissions and print their results; return 1 if one was refused, or is not as before."""
    if not 1 <= args.episodes <= 100_000:
        raise UserError(f"--episodes must lie between 1 and 100000, got {args.episodes}")
    if args.jobs < 1:
        raise UserError(f"--jobs must be at least 1, got {args.jobs}")
    folders = [Path(folder) for folder in args.folders]
    before = _read(Path(args.against)) if args.against else None
    if before is not None and not _comparable(folders, before, args):
        return 1
    results: list[dict[str, Any]] = []
    far = False
    try:
        for folder, result in _results(folders, args):
            if isinstance(result, Exception):
                raise result
            results.append({"folder": str(folder)} | result)
            print("\n".join(result_lines(results[-1])), flush=True)
            if before is not None and "refused" not in result:
                plans = load(folder).architecture.plans
                far |= _report(result, before.get(result["digest"]), args.against, plans)
    except KeyboardInterrupt:
        done = [result["folder"] for result in results]
        rest = [folder for folder in map(str, folders) if folder not in done]
        other = ", with another --json" if args.json and results else ""
        if rest:
            print(f"interrupted; left to verify{other}: {shlex.join(rest)}", file=sys.stderr)
        raise
    finally:  # also after an error
        if args.json and results:
            write_file(args.json, json.dumps(results, allow_nan=False) + "\n")
    return 1 if far or any("refused" in result for result in results) else 0


def _read(file: Path) -> dict[str, dict[str, Any]]:
    """Return earlier results, by digest."""
    try:
        found = load_json(read_plain(file, UNPACKED))
        if not isinstance(found, list) or not all(isinstance(r, dict) for r in found):
            raise ValueError("it is not a list of results")
        told = ({key: value for key, value in r.items() if key != "folder"} for r in found)
        return {r["digest"]: checked_result(r) for r in told if "refused" not in r}
    except (OSError, ValueError, KeyError) as error:
        what = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"--against: {file} cannot be read: {what}") from error


def _comparable(folders: list[Path], before: dict[str, dict[str, Any]], args: argparse.Namespace) -> bool:
    """Return whether there are earlier results of all submissions; print the names of those without.

    Raises
    ------
    UserError
        If an earlier result is of other episodes, or was measured under other conditions.
    """
    missing = 0
    for folder in folders:
        try:
            told = about(read_files(folder))
        except Refused:
            continue  # the verification reports why
        name, other = ascii_text(folder), before.get(told.digest)
        if other is None:
            missing += 1
            print(f"{name}: {args.against} has no result of it (digest {told.digest})", file=sys.stderr)
            continue
        for option in ("nonce", "episodes"):
            here, there = getattr(args, option), other[option]
            if here != there:
                raise UserError(
                    f"--against: {args.against} has {name} with --{option} {there!r}, not {here!r}; "
                    "only the same episodes can be compared"
                )
        if set(other["robustness"]) != {condition.name for condition in on_board(told.env)}:
            raise UserError(
                f"--against: {args.against} has {name} under other conditions, by another version of lag_envs"
            )
    return not missing


def _report(result: dict[str, Any], other: dict[str, Any] | None, file: str, plans: bool) -> bool:
    """Print how a result compares with an earlier one; return whether it is too far from it."""
    from lag_envs.scores import known_returns

    if other is None:
        print(f"  {file} has no result of it")
        return True
    known = known_returns(result["env"])
    assert known is not None
    try:
        found = compare_results(result, other, known.best - known.random, plans)
    except ValueError as error:
        raise UserError(f"--against: {file}: {error}") from error
    if found.same:
        print(f"  the same, to the bit, as {file}")
    else:
        print(f"  mean scores differ by {found.difference:.1e} at most from {file}")
    for what in found.far:
        print(f"  differs too much in {what}")
    return bool(found.far)


def _results(folders: list[Path], args: argparse.Namespace) -> Iterator[tuple[Path, Any]]:
    """Verify here, with a progress bar, or on a Ray cluster."""
    from lag_envs.leaderboard.parallel import map_submissions, with_bar

    function = partial(verify_folder, nonce=args.nonce, episodes=args.episodes)
    if args.jobs == 1 and args.ray is None:
        function = partial(with_bar, function)
    return map_submissions(function, folders, args.jobs, args.ray)


def result_lines(result: dict[str, Any]) -> list[str]:
    """Return a result as lines of text."""
    from lag_envs.leaderboard.ranking import corrected, policy_error
    from lag_envs.scores import score

    if "refused" in result:
        return [f"{ascii_text(result['folder'])}: refused: {result['refused']}"]
    env, folder = result["env"], ascii_text(result["folder"])
    reference = protocol.reference(env)
    rows = [("seed", "return", "±", "score", "success", "time", "effort")]
    for policy in result["policies"]:
        mean = float(corrected(reference, [policy]).mean())
        error = policy_error(reference, [policy])
        times = [t for t in policy["settle"] if t is not None]
        part = score(env, mean)
        row = (
            str(policy["seed"]),
            f"{mean:.5g}",
            "-" if error is None else f"{error:.2g}",
            "" if part is None else f"{part:.4f}",
            f"{np.mean(policy['success']):.1%}",
            f"{np.median(times):.2f} s" if times else "-",
            f"{np.mean(policy['effort']):.3f}",
        )
        rows.append(row)
    lines = [f"{folder}: {env}, {result['episodes']} episodes each, {result['seconds']:.1f} s"]
    lines += ["  " + line for line in aligned(rows)]
    worst = min(result["robustness"], key=lambda name: np.mean(result["robustness"][name]))
    lines.append(f"  worst disturbance: {worst}, mean return {np.mean(result['robustness'][worst]):.5g}")
    if None not in result["often"]:
        lines.append(f"  acting ten times as often: mean return {np.mean(result['often']):.5g}")
    return [*lines, f"  digest {result['digest']}"]
