"""Speed beside other environments, and the time to a first step; the command ``lag-envs bench``.

All contestants are measured in one process on one core, in turn, round after round, and compared within each
round, so that a slow spell of the machine falls on all of them. A sample is a loop over actions made
beforehand; it holds all that a step does: dynamics, observation, reward, endings, kicks, and the resets that
follow. Where batches are measured that several threads step, the process has a core for each of them.
"""

from __future__ import annotations

import ast
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib import import_module
from itertools import cycle, islice
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

import lag_envs
from lag_envs import benchmark_divisions, benchmark_jacobians
from lag_envs.benchmark_divisions import divisions
from lag_envs.benchmark_jacobians import jacobians
from lag_envs.benchmark_peak import NUMBERS, peak, products
from lag_envs.host import ONE_THREAD, installed, machine
from lag_envs.own_files import registered
from lag_envs.progress import progress
from lag_envs.store import write
from lag_envs.tables import columns, markdown_table
from lag_envs.tasks import TASKS

SIZES = (1, 64, 1024, 16384)
LIBRARIES = ("gymnasium", "numpy", "numba", "llvmlite", "envpool", "gymnax", "jax", "torchrl", "torch")
#: What a cold start does after the start of the process, in stages; prints the seconds of each.
COLD_START = """
from time import perf_counter
times = [perf_counter()]
import numpy
times.append(perf_counter())
import gymnasium
times.append(perf_counter())
import numba
times.append(perf_counter())
import lag_envs
{load}env = gymnasium.make({id!r})
times.append(perf_counter())
env.reset(seed=1)
times.append(perf_counter())
env.step(env.action_space.sample())
times.append(perf_counter())
gymnasium.make({id!r})
times.append(perf_counter())
print(*(b - a for a, b in zip(times, times[1:])))
"""
STAGES = (
    "Python's own start and end", "import numpy", "import gymnasium", "import numba",
    "import lag_envs, gym.make", "reset", "step", "gym.make again",
)  # fmt: skip

#: Whose rows scenes of energies are, and how many bars the longest chain has.
ENERGIES, LONGEST = "lag_envs, energies", 6
#: Whose rows environments with other keywords are, and those that several threads step.
VARIED, THREADED = "lag_envs, varied", "lag_envs, threads"

#: Whose row is what the core can do.
CORE = "this core"

#: Takes at least that many steps of every environment, and returns how many it took.
Run = Callable[[int], int]
Clock = Callable[[], float]
CLOCKS: dict[str, Clock] = {"wall": time.perf_counter, "cpu": time.process_time}


class Target(NamedTuple):
    """A ratio that ours is to reach, against Gymnasium's CartPole-v1 of the same kind and size."""

    kind: str
    num_envs: int
    ratio: float

    def __str__(self) -> str:
        """Return what is compared."""
        return f"{self.kind}, {self.num_envs:,}" if self.kind == "vector" else f"single, {self.kind}"


TARGETS = (
    Target("made", 1, 2.0),
    Target("vector", 64, 6.0),
    Target("vector", 1024, 3.0),
    Target("vector", 16384, 3.0),
)
#: Seconds from the start of a process to its end after one step, by state of the cache of compiled code.
COLD_TARGETS = {"empty": 2.5, "filled": 0.5}


@dataclass
class Settings:
    """What is measured, and for how long."""

    ids: tuple[str, ...] = tuple(TASKS)
    files: tuple[str, ...] = ()  #: users' own, which register some of the ids
    keywords: tuple[str, ...] = ()  #: each as a call takes them: measured beside the defaults
    energies: bool = False  #: scenes that are only energies too, beside CartPole-v1
    jacobians: bool = False  #: what derivatives of a step cost beside it
    divisions: bool = False  #: how often the certificate divides steps
    sizes: tuple[int, ...] = SIZES
    threads: int = 1  #: where more, batches that they step are measured too
    rounds: int = 31
    seconds: float = 0.05  #: aimed length of one sample
    clock: str = "wall"  #: or "cpu", which leaves out what other programs take of the core
    speed: bool = True
    cold_starts: int = 9  #: processes with a filled cache; with an empty one half as many
    date: str = ""
    output: str | None = None
    checkout: str | None = None  #: whose docs take the result over


@dataclass
class Contestant:
    """One row of the table.

    ``rates`` holds the env-steps per second of each round; ``problem`` tells why there are no (more) of them.
    """

    library: str
    id: str
    kind: str  #: "made", "unwrapped" or "vector"
    num_envs: int
    prepare: Callable[[], Run]
    rates: list[float] = field(default_factory=list)
    problem: str | None = None


# --- the contestants ---


def contestants(
    ids: Sequence[str], sizes: Sequence[int], keywords: Sequence[str] = (), threads: int = 1
) -> list[Contestant]:
    """Return ours, with other keywords and several threads too, and the peers."""
    rows = []
    for id in ids:
        rows += [Contestant("lag_envs", id, "made", 1, partial(made, id))]
        rows += [Contestant("lag_envs", id, "unwrapped", 1, partial(unwrapped, id))]
        rows += [Contestant("lag_envs", id, "vector", n, partial(ours, id, n)) for n in sizes]
        if threads > 1:
            shared = partial(ours, id, num_threads=threads)
            rows += [Contestant(THREADED, id, "vector", n, partial(shared, n)) for n in sizes]
        for text in keywords:
            given, name = keywords_of(text), f"{id}, {text}"
            rows += [Contestant(VARIED, name, "unwrapped", 1, partial(unwrapped, id, **given))]
            rows += [Contestant(VARIED, name, "vector", n, partial(ours, id, n, **given)) for n in sizes]
    for id in ("CartPole-v1", "Pendulum-v1"):
        rows += [Contestant("gymnasium", id, "made", 1, partial(made, id))]
    rows += [Contestant(CORE, "multiply-adds", "arithmetic", NUMBERS, peak)]
    for library, id, prepare in PEERS:
        rows += [Contestant(library, id, "vector", n, partial(prepare, n)) for n in sizes]
    return rows


def keywords_of(text: str) -> dict[str, Any]:
    """Return keywords as they stand in a call, or raise a ValueError.

    Examples
    --------
    >>> keywords_of("observation_noise=0.01, push=(2, 0.5)")
    {'observation_noise': 0.01, 'push': (2, 0.5)}
    """
    try:
        call = ast.parse(f"_({text})", mode="eval").body
        if not isinstance(call, ast.Call) or call.args or not all(k.arg for k in call.keywords):
            raise SyntaxError
        return {str(k.arg): ast.literal_eval(k.value) for k in call.keywords}
    except (SyntaxError, ValueError):
        raise ValueError(
            f"keywords must be as in a call, such as 'observation_noise=0.01, push=(2, 0.5)', got {text!r}"
        ) from None


def of_energies(sizes: Sequence[int]) -> list[Contestant]:
    """Return the exact CartPole and the double pendulum at all sizes, and chains of bars at one of them."""
    # Batches of some thousand long chains would take minutes until their episodes are spread out.
    middle = max((n for n in sizes if n <= 1024), default=min(sizes))
    some: list[tuple[str, str, dict[str, Any], int]]
    some = [("CartPole, exact", "lag_envs.tasks.cart_pole:CartPoleExact", {}, n) for n in sizes]
    some += [("Chain(2)", "lag_envs.benchmark_tasks:ChainSwing", {"bars": 2}, n) for n in sizes]
    some += [
        (f"Chain({i})", "lag_envs.benchmark_tasks:ChainSwing", {"bars": i}, middle)
        for i in (1, *range(3, LONGEST + 1))
    ]
    return [
        Contestant(ENERGIES, id, "vector", n, partial(energies, task, given, n))
        for id, task, given, n in some
    ]


def energies(task: str, given: dict[str, Any], n: int) -> Run:
    """Prepare a vector environment of a task, "module:Class"."""
    from lag_envs.envs.vector import LagrangianVectorEnv

    envs = LagrangianVectorEnv(task, n, **given)
    actions = actions_of(envs.single_action_space, n)
    envs.reset(seed=0)
    stagger_episodes(envs, actions)
    return batch(envs.step, actions)


def random_actions(n: int, scale: float = 1.0) -> list[NDArray[np.float32]]:
    """Return batches of shape (n, 1), uniform in [-scale, scale]: enough that they do not repeat too soon.

    A few that come round again and again are a force with a period: they drive pendulums into resonance, to
    speeds at which steps are divided.
    """
    count = max(64, min(1024, 2**17 // n))
    return list(np.random.default_rng(0).uniform(-scale, scale, (count, n, 1)).astype(np.float32))


def actions_of(space: gym.Space, n: int) -> list[NDArray]:
    """Return batches of n random actions of a space: uniform numbers, or choices."""
    some = random_actions(n)
    if isinstance(space, gym.spaces.Discrete):
        return [((a[:, 0] + 1.0) * 0.5 * int(space.n)).astype(np.int64).clip(0, space.n - 1) for a in some]
    if isinstance(space, gym.spaces.Box) and space.shape == (1,):
        return [float(space.high[0]) * a for a in some]
    space.seed(0)
    return [np.array([space.sample() for _ in range(n)]).reshape(n, *(space.shape or ())) for _ in some[:64]]


def made(id: str) -> Run:
    """Prepare one environment as users make it, in Gymnasium's default wrappers."""
    return single(gym.make(id))


def unwrapped(id: str, **keywords: Any) -> Run:
    """Prepare one environment without wrappers."""
    return single(gym.make(id, **keywords).unwrapped)


def single(env: gym.Env) -> Run:
    """Prepare one environment of Gymnasium's interface."""
    # A choice as Python's int, as users give it.
    endless = cycle([a[0].item() if a.ndim == 1 else a[0] for a in actions_of(env.action_space, 1)])
    env.reset(seed=0)

    def run(steps: int) -> int:
        for action in islice(endless, steps):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return steps

    return run


def batch(step: Callable[[Any], Any], actions: Sequence[Any]) -> Run:
    """Prepare a batch that resets its environments itself."""
    endless = cycle(actions)

    def run(steps: int) -> int:
        for action in islice(endless, steps):
            step(action)
        return steps

    return run


def ours(id: str, n: int, **keywords: Any) -> Run:
    """Prepare a native vector environment, of one thread unless told otherwise."""
    envs = gym.make_vec(id, num_envs=n, **{"num_threads": 1} | keywords)
    actions = actions_of(envs.single_action_space, n)
    envs.reset(seed=0)
    stagger_episodes(envs, actions)
    return batch(envs.step, actions)


def stagger_episodes(envs: VectorEnv, actions: Sequence[Any]) -> None:
    """Shift the episodes against each other, so that every sample has its share of endings."""
    limit = envs.spec.max_episode_steps if envs.spec else None
    length = limit or round(envs.task.limit)  # type: ignore[attr-defined]
    turn = np.arange(envs.num_envs) * length // envs.num_envs
    for i, action in enumerate(islice(cycle(actions), length)):
        if (turn == i).any():
            envs.reset(options={"reset_mask": turn == i})
        envs.step(action)


def cartpole(n: int) -> Run:
    """Prepare Gymnasium's own vector environment of CartPole; its episodes soon end all over the place."""
    envs = gym.make_vec("CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")
    envs.reset(seed=0)
    run = batch(envs.step, [(a[:, 0] > 0.0).astype(np.int64) for a in random_actions(n)])
    run(100)
    return run


def envpool(n: int) -> Run:
    """Prepare EnvPool on one thread."""
    pool = import_module("envpool")
    envs = pool.make_gymnasium("Pendulum-v1", num_envs=n, num_threads=1, seed=0)
    envs.reset()
    return batch(envs.step, random_actions(n, 2.0))


def gymnax(n: int, together: int = 8) -> Run:
    """Prepare gymnax, several steps in one compiled call, as it is meant to be used."""
    jax = import_module("jax")
    env, params = import_module("gymnax").make("Pendulum-v1")
    reset = jax.vmap(env.reset, in_axes=(0, None))
    step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
    actions = jax.numpy.asarray(np.stack(random_actions(n, 2.0)[:together])[:, :, 0])

    def one(state: Any, inputs: tuple) -> tuple:
        key, action = inputs
        observation, state, *others = step(jax.random.split(key, n), state, action, params)
        return state, (observation, others[:-1])  # all but info

    @jax.jit
    def several(key: Any, state: Any) -> tuple:
        key, now = jax.random.split(key)
        return key, *jax.lax.scan(one, state, (jax.random.split(now, together), actions))

    key = jax.random.PRNGKey(0)
    _, state = jax.jit(reset)(jax.random.split(key, n), params)

    def run(steps: int) -> int:
        nonlocal key, state
        calls = -(-steps // together)
        for _ in range(calls):
            key, state, seen = several(key, state)
            jax.block_until_ready(seen)
        return calls * together

    return run


def torchrl(n: int) -> Run:
    """Prepare TorchRL's pendulum; its episodes have no end."""
    torch = import_module("torch")
    torch.set_num_threads(1)
    env = import_module("torchrl.envs").PendulumEnv()
    actions = cycle([torch.from_numpy(a) for a in random_actions(n, 2.0)])
    now = env.reset(env.gen_params(batch_size=[n]))

    @torch.no_grad()
    def run(steps: int) -> int:
        nonlocal now
        for action in islice(actions, steps):
            now["action"] = action
            now = env.step(now)["next"]
        return steps

    return run


#: Peers with batches: library, what they run, how they are prepared.
PEERS: list[tuple[str, str, Callable[[int], Run]]] = [
    ("gymnasium", "CartPole-v1", cartpole),
    ("envpool", "Pendulum-v1", envpool),
    ("gymnax", "Pendulum-v1", gymnax),
    ("torchrl", "PendulumEnv", torchrl),
]


# --- measuring ---


def bench(settings: Settings) -> dict[str, Any]:
    """Measure, print the tables, write the file if one is named, and return what it holds."""
    for name in settings.files:
        registered(name)
    ours = settings.ids, settings.sizes, settings.keywords, settings.threads
    rows = contestants(*ours) if settings.speed else []
    if settings.speed and settings.energies:
        rows += of_energies(settings.sizes)
    stages: dict[str, list[list[float]]] = {}
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    complete = measure(rows, settings.rounds, settings.seconds, CLOCKS[settings.clock])
    if complete and settings.cold_starts:
        complete = cold_starts(settings.ids[0], settings.cold_starts, stages, settings.files)
    cold = {name: [sum(one) for one in many] for name, many in stages.items()}
    results = [summary(row, rows) for row in rows]
    report: dict[str, Any] = {
        "date": settings.date,
        "complete": complete,
        "machine": machine() | {"load_at_start": load},
        "versions": {"lag_envs": lag_envs.__version__} | installed(LIBRARIES),
        "settings": asdict(settings),
        "rows": results,
        "cold_start": {
            name: {
                "seconds": times,
                "median": quartiles(times)[1],
                "stages": {
                    stage: quartiles(part)[1]
                    for stage, part in zip(STAGES, zip(*stages[name], strict=True), strict=True)
                },
            }
            for name, times in cold.items()
        },
    }
    report["targets"] = verdicts(results, cold)
    report["chains"] = chains(results)
    report["speedups"] = speedups(rows)
    report["arithmetic"] = arithmetic(rows)
    if settings.jacobians and complete:
        report["jacobians"] = jacobians(settings.rounds, CLOCKS[settings.clock])
    if settings.divisions and complete:
        report["divisions"] = divisions(settings.ids)
    print("\n".join(table(report)))
    if settings.output:
        Path(settings.output).write_text(to_json(report), encoding="utf-8")
        print(f"written to {settings.output}")
    if settings.checkout and complete:
        take_over(report, Path(settings.checkout))
        print(f"written to docs/speed.json, docs/speed.md and README.md in {settings.checkout}")
    return report


def measure(
    rows: Sequence[Contestant], rounds: int, seconds: float, clock: Clock = time.perf_counter
) -> bool:
    """Fill in the contestants' rates; return False where the user broke it off, keeping what there is."""
    runs: dict[int, tuple[Run, int]] = {}
    with progress(len(rows) * (rounds + 1)) as advance:
        try:
            for i, row in enumerate(rows):
                advance(f"{row.library} {row.id} {row.kind} {row.num_envs}")
                with excused(row):
                    run = row.prepare()
                    runs[i] = run, calibrate(run, seconds, clock)
            for _ in range(rounds):
                for i, row in enumerate(rows):
                    advance("measuring")
                    if row.problem is None:
                        with excused(row):
                            row.rates.append(rate(*runs[i], clock) * row.num_envs)
        except KeyboardInterrupt:
            return False
    return True


@contextmanager
def excused(row: Contestant) -> Iterator[None]:
    """Note in the row what goes wrong with a contestant, so that the others can go on."""
    try:
        yield
    except Exception as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == row.library
        text = " ".join(f"{type(error).__name__}: {error}".split())
        row.problem = "not installed" if missing else f"failed: {text[:200]}"


def calibrate(run: Run, seconds: float, clock: Clock) -> int:
    """Return the number of steps that take about that long."""
    run(1)  # compiles
    steps = 1
    while True:
        start = clock()
        taken = run(steps)
        elapsed = clock() - start
        if elapsed >= 0.25 * seconds:
            return max(1, round(taken * seconds / elapsed))
        steps *= 2


def rate(run: Run, steps: int, clock: Clock) -> float:
    """Return steps per second."""
    run(1)  # what the others have pushed out of the caches comes back
    start = clock()
    taken = run(steps)
    return taken / (clock() - start)


def cold_starts(id: str, count: int, times: dict[str, list[list[float]]], files: Sequence[str] = ()) -> bool:
    """Time the stages of whole processes into `times`; return False where the user broke it off."""
    empty = (count + 1) // 2
    with progress(empty + count) as advance, tempfile.TemporaryDirectory() as folder:
        try:
            for i in range(empty):
                advance("cold start, cache empty")
                times.setdefault("empty", []).append(cold_start(id, f"{folder}/{i}", files))
            for _ in range(count):
                advance("cold start, cache filled")
                times.setdefault("filled", []).append(cold_start(id, f"{folder}/0", files))
        except KeyboardInterrupt:
            return False
    return True


def cold_start(id: str, cache: str, files: Sequence[str] = ()) -> list[float]:
    """Return the seconds of each of `STAGES` of a process that takes one step."""
    load = "".join(f"from lag_envs.own_files import registered; registered({name!r})\n" for name in files)
    command = [sys.executable, "-P", "-c", COLD_START.format(id=id, load=load)]
    # As with installed packages, what is imported is there as bytecode: what lacks it is written at first.
    given = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    given["NUMBA_CACHE_DIR"] = cache
    start = time.perf_counter()
    done = subprocess.run(command, env=given, check=True, capture_output=True, text=True)
    total = time.perf_counter() - start
    stages = list(map(float, done.stdout.split()))
    return [total - sum(stages), *stages]


# --- statistics ---


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return lower quartile, median and upper quartile.

    Examples
    --------
    >>> quartiles([4.0, 1.0, 3.0, 2.0, 5.0])
    (2.0, 3.0, 4.0)
    """
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    return low, middle, high


def ratios(rates: Sequence[float], others: Sequence[float]) -> list[float]:
    """Return the ratio within each round that both have.

    Examples
    --------
    >>> ratios([4.0, 9.0], [2.0, 3.0, 5.0])
    [2.0, 3.0]
    """
    return [a / b for a, b in zip(rates, others, strict=False)]


def summary(row: Contestant, rows: Sequence[Contestant]) -> dict[str, Any]:
    """Return a row with its statistics, and its ratio to CartPole-v1 of its size."""
    kind = "vector" if row.kind == "vector" else "made"
    rival = [
        r.rates
        for r in rows
        if (r.library, r.id, r.kind, r.num_envs) == ("gymnasium", "CartPole-v1", kind, row.num_envs)
    ]
    result = {name: getattr(row, name) for name in ("library", "id", "kind", "num_envs", "problem", "rates")}
    if row.rates:
        result["steps_per_second"] = quartiles(row.rates)
    if rival and (pairs := ratios(row.rates, rival[0])):
        result["ratio"] = quartiles(pairs)
    return result


def verdicts(rows: Sequence[dict[str, Any]], cold: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Hold what was measured against the targets; ``met`` is None where nothing was measured."""
    results = []
    for target in TARGETS:
        measured = {
            row["id"]: row["ratio"][1]
            for row in rows
            if row["library"] == "lag_envs"
            and (row["kind"], row["num_envs"]) == target[:2]
            and "ratio" in row
        }
        met = all(value >= target.ratio for value in measured.values()) if measured else None
        goal = f"{target}: at least {target.ratio:g} x CartPole-v1"
        results.append({"target": goal, "limit": target.ratio, "met": met, "measured": measured})
    for name, limit in COLD_TARGETS.items():
        measured = {"seconds": quartiles(cold[name])[1]} if cold.get(name) else {}
        met = measured["seconds"] < limit if measured else None
        goal = f"cold start, cache {name}: below {limit:g} s"
        results.append({"target": goal, "limit": limit, "met": met, "measured": measured})
    return results


def speedups(rows: Sequence[Contestant]) -> list[dict[str, Any]]:
    """Return, for each batch that several threads step, the quartiles of the ratio to one thread."""
    rates = {(row.library, row.id, row.num_envs): row.rates for row in rows if row.kind == "vector"}
    return [
        {"id": id, "num_envs": n, "ratio": quartiles(pairs)}
        for (library, id, n), threaded in rates.items()
        if library == THREADED and (pairs := ratios(threaded, rates["lag_envs", id, n]))
    ]


def arithmetic(rows: Sequence[Contestant]) -> list[dict[str, Any]]:
    """Return, for our largest batch of each id, its products a step and its share of the core's peak.

    The share has quartiles, over the rounds, of products a second to multiply-adds a second.
    """
    limits = next((row.rates for row in rows if row.library == CORE), [])
    largest = {r.id: r for r in sorted(rows, key=lambda r: r.num_envs) if _is_batch(r)}
    found = []
    for id, row in largest.items():
        count = products(gym.make_vec(id, num_envs=1)._program) if row.rates else None  # type: ignore[attr-defined]
        if count and (pairs := ratios(row.rates, limits)):
            share = quartiles([count * pair for pair in pairs])
            found.append({"id": id, "num_envs": row.num_envs, "products": count, "share": share})
    return found


def _is_batch(row: Contestant) -> bool:
    return row.library == "lag_envs" and row.kind == "vector"


def chains(rows: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the time of a step by the number of bars [ns], and the exponent of the power that fits it best.

    Examples
    --------
    >>> about = {"library": ENERGIES, "num_envs": 8}
    >>> rows = [
    ...     {**about, "id": f"Chain({n})", "steps_per_second": [0.0, 1e9 / n**2, 0.0]} for n in (1, 2, 4)
    ... ]
    >>> chains(rows)
    {'bars': [1, 2, 4], 'ns': [1.0, 4.0, 16.0], 'exponent': 2.0}
    """
    found = [
        r
        for r in rows
        if r["library"] == ENERGIES and r["id"].startswith("Chain") and "steps_per_second" in r
    ]
    counts = [r["num_envs"] for r in found]
    size = max(counts, key=counts.count, default=0)
    times = {int(r["id"][6:-1]): 1e9 / r["steps_per_second"][1] for r in found if r["num_envs"] == size}
    if len(times) < 2:
        return None
    bars = sorted(times)
    slope = np.polyfit(np.log(bars), np.log([times[n] for n in bars]), 1)[0]
    return {"bars": bars, "ns": [round(times[n], 1) for n in bars], "exponent": round(float(slope), 2)}


def times_of(report: dict[str, Any]) -> dict[str, float]:
    """Return the time of a step of each environment [ns], in the largest batch."""
    found = [r for r in report["rows"] if r["library"] == "lag_envs" and "steps_per_second" in r]
    most = max((r["num_envs"] for r in found), default=0)
    return {r["id"]: 1e9 / r["steps_per_second"][1] for r in found if r["num_envs"] == most}


# --- printing ---


def table(report: dict[str, Any]) -> list[str]:
    """Return the report as lines of text."""
    about, settings = report["machine"], report["settings"]
    lines = [
        f"{about['processor']}, {about['cores']} cores, {about['system']}, Python {about['python']}",
        f"{'a core for each thread' if report.get('speedups') else 'one core'}, {settings['clock']} time, "
        f"{settings['rounds']} samples of {settings['seconds']:g} s each",
        ", ".join(f"{name} {number}" for name, number in report["versions"].items()),
        "",
    ]
    if report["rows"]:
        head = (
            "library",
            "environment",
            "kind",
            "envs",
            "steps/s",
            "(quartiles)",
            "ns/step",
            "x CartPole",
            "(quartiles)",
        )
        lines += columns([head, *map(_cells, report["rows"])])
        lines += [
            "",
            "x CartPole: median over the rounds of the ratio to Gymnasium's CartPole-v1 of the same size",
            "",
        ]
    if found := report.get("speedups"):
        names = ("environment", "envs", f"{settings['threads']} threads : 1", "(quartiles)")
        lines += [*columns([names, *map(_compared, found)]), ""]
    if found := report.get("arithmetic"):
        titles = ("environment", "envs", "products a step", "of the core's peak", "(quartiles)")
        lines += [*columns([titles, *map(_share, found)]), ""]
    if found := report.get("chains"):
        times = ", ".join(f"{bars}: {ns:,.0f}" for bars, ns in zip(found["bars"], found["ns"], strict=True))
        lines += [f"chains by their bars, ns a step: {times}; grows like the power {found['exponent']:g}", ""]
    if costs := report.get("jacobians"):
        lines += [*columns(benchmark_jacobians.table(costs)), ""]
    if found := report.get("divisions"):
        rows = [benchmark_divisions.cells(row, times_of(report).get(row["id"])) for row in found]
        lines += [*columns([benchmark_divisions.HEAD, *rows]), ""]
    for name, cold in report["cold_start"].items():
        low, middle, high = quartiles(cold["seconds"])
        spread = f"({low:.2f} - {high:.2f}), {len(cold['seconds'])} processes"
        lines += [f"cold start, cache {name}: {middle:.2f} s {spread}; median of each stage, ms:"]
        rows = [(f"  {stage}", f"{1e3 * seconds:.1f}") for stage, seconds in cold["stages"].items()]
        lines += [*columns(rows), ""]
    words = {True: "met", False: "missed", None: "not measured"}
    lines += columns([(words[t["met"]], t["target"], _worst(t)) for t in report["targets"]])
    if not report["complete"]:
        lines += ["", "interrupted: these are the samples so far"]
    return lines


def markdown(report: dict[str, Any]) -> str:
    """Return the table of docs/speed.md: every environment at the sizes of `TARGETS`; what misses is marked.

    Parameters
    ----------
    report : dict
        What `bench` returns; of these sizes, with CartPole-v1 among them.
    """
    rows = {(row["library"], row["id"], row["kind"], row["num_envs"]): row for row in report["rows"]}
    rival = ("gymnasium", "CartPole-v1")

    def cell(library: str, id: str, target: Target) -> str:
        row = rows[library, id, target.kind, target.num_envs]
        if "steps_per_second" not in row:
            return row["problem"] or "not measured"
        time = 1e9 / row["steps_per_second"][1]
        text = f"{time:,.0f} ns" if time >= 99.5 else f"{time:.3g} ns"
        if (library, id) == rival:
            return text
        ratio = row["ratio"][1]
        return f"{text}, {ratio:.1f}×" if ratio >= target.ratio else f"{text}, **{ratio:.2f}×, missed**"

    sizes = ["1 (`gym.make`)" if t.kind == "made" else f"{t.num_envs:,} at once" for t in TARGETS]
    lines = [
        *([id, *(cell("lag_envs", id, t) for t in TARGETS)] for id in _ours(report)),
        ["CartPole-v1", *(cell(*rival, t) for t in TARGETS)],
        ["*target*", *(f"*{t.ratio:g}×*" for t in TARGETS)],
    ]
    machine, settings = report["machine"], report["settings"]
    parts = [
        "Time of a step, and how many times as long a step of as many of Gymnasium's `CartPole-v1` takes: "
        f"medians of {settings['rounds']} rounds, {settings['clock']} time on one core of "
        f"{machine['processor']} (`lag-envs bench`, Gymnasium {report['versions']['gymnasium']}, "
        f"{report['date']}).",
        markdown_table(["id", *sizes], lines),
    ]
    exact = [r for r in report["rows"] if r["library"] == ENERGIES and "ratio" in r]
    if exact:
        size = max(r["num_envs"] for r in exact)
        told = [
            f"`{r['id']}` {1e9 / r['steps_per_second'][1]:,.0f} ns, {r['ratio'][1]:.2f}×"
            for r in exact
            if r["num_envs"] == size and r["id"] in ("CartPole, exact", "Chain(2)")
        ]
        parts.append(
            f"Scenes that are only energies, {size:,} at once, beside the same `CartPole-v1`: "
            f"{'; '.join(told)}."
        )
    if found := report.get("divisions"):
        parts.append(
            "Into how many series the certificate divides steps under random actions, and the time of one, "
            "many at once. Others never needed more than one; those with imperfections were left out."
        )
        parts.append(benchmark_divisions.markdown(found, times_of(report)))
    if cold := report["cold_start"]:
        starts = " and ".join(f"{part['median']:.2f} s with its cache {name}" for name, part in cold.items())
        parts.append(f"A whole process (import, make, reset, first step) took {starts}.")
    return "\n\n".join(parts)


def claim(report: dict[str, Any]) -> str:
    """Return a sentence on speed: the ranges of the table, and how many targets are missed."""
    rows = [row for row in report["rows"] if row["library"] == "lag_envs" and "ratio" in row]
    found = [
        sorted(row["ratio"][1] for row in rows if (row["kind"], row["num_envs"]) == target[:2])
        for target in TARGETS
    ]
    places = ["alone", *(f"{target.num_envs:,} at once" for target in TARGETS[1:])]
    ranges = ", ".join(
        f"{place} {ratios[0]:.3g} to {ratios[-1]:.3g} times"
        for place, ratios in zip(places, found, strict=True)
        if ratios
    )
    missed = sum(
        ratio < target.ratio for target, ratios in zip(TARGETS, found, strict=True) for ratio in ratios
    )
    aims = f"{missed} of {sum(map(len, found))} targets are missed" if missed else "all targets are met"
    return f"Steps per second, relative to Gymnasium's `CartPole-v1`: {ranges}; {aims}."


def _ours(report: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(row["id"] for row in report["rows"] if row["library"] == "lag_envs"))


def take_over(report: dict[str, Any], checkout: Path) -> None:
    """Write a report into a checkout: ``docs/speed.json``, and what docs/speed.md and README say of it."""
    write(checkout / "docs" / "speed.json", to_json(report))
    for path, text in texts(report, checkout).items():
        write(path, text)


def texts(report: dict[str, Any], checkout: Path) -> dict[Path, str]:
    """Return the files of a checkout that tell of a report, as they ought to be."""
    from lag_envs.generated import replaced

    page, readme = checkout / "docs" / "speed.md", checkout / "README.md"
    text = replaced(page.read_text(encoding="utf-8"), "bench", markdown(report))
    return {
        page: replaced(text, "fast", claim(report)),
        readme: replaced(readme.read_text(encoding="utf-8"), "fast", claim(report)),
    }


def to_json(report: dict[str, Any]) -> str:
    """Return a report as JSON, with lists of numbers on a line."""
    text = json.dumps(report, indent=1, allow_nan=False)
    return re.sub(r"\[[^\[\]{}\"]*\]", lambda found: " ".join(found[0].split()), text) + "\n"


def short(value: float) -> str:
    """Return a rate with three digits.

    Examples
    --------
    >>> short(1234.0), short(41_234_567.0)
    ('1.23 k', '41.2 M')
    """
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= 0.9995 * size:
            value /= size
            return f"{value:.{max(0, 2 - (value >= 9.995) - (value >= 99.95))}f} {unit}"
    return f"{value:.0f}"


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    name = (row["library"], row["id"], row["kind"], f"{row['num_envs']:,}")
    if "steps_per_second" not in row:
        return (*name, row["problem"] or "not measured")
    low, middle, high = row["steps_per_second"]
    cells: tuple[str, ...] = (*name, short(middle), f"({short(low)} - {short(high)})", f"{1e9 / middle:,.1f}")
    if "ratio" in row:
        low, middle, high = row["ratio"]
        cells = (*cells, f"{middle:.2f}", f"({low:.2f} - {high:.2f})")
    return (*cells, row["problem"]) if row["problem"] else cells


def _compared(row: dict[str, Any]) -> tuple[str, ...]:
    low, middle, high = row["ratio"]
    return row["id"], f"{row['num_envs']:,}", f"{middle:.2f}", f"({low:.2f} - {high:.2f})"


def _share(row: dict[str, Any]) -> tuple[str, ...]:
    low, middle, high = row["share"]
    numbers = f"{row['num_envs']:,}", f"{row['products']:,}"
    return row["id"], *numbers, f"{middle:.0%}", f"({low:.0%} - {high:.0%})"


def _worst(target: dict[str, Any]) -> str:
    measured = target["measured"]
    if not measured:
        return ""
    if "seconds" in measured:
        return f"{measured['seconds']:.2f} s"
    worst = min(measured, key=measured.get)
    missed = sum(value < target["limit"] for value in measured.values())
    return f"{measured[worst]:.2f} by {worst}" + (
        f", missed by {missed} of {len(measured)}" if missed and len(measured) > 1 else ""
    )


# --- the process that measures ---


def in_own_process(settings: Settings) -> int:
    """Run `bench` in a process of its own, on as many cores as it has threads; return its exit status."""
    command = [sys.executable, "-P", "-m", "lag_envs.benchmark", json.dumps(asdict(settings))]
    child = subprocess.Popen(command, env=os.environ | ONE_THREAD)

    def pass_on(*_: Any) -> None:
        if os.name == "posix":  # elsewhere the terminal tells the child itself
            child.send_signal(signal.SIGINT)

    before = {number: signal.signal(number, pass_on) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return child.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _break_off(*_: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)  # what was measured is still to be written
    raise KeyboardInterrupt


def main() -> int:
    """Measure as the settings on the command line say."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _break_off)
    warnings.simplefilter("ignore")  # of the peers
    settings = Settings(**json.loads(sys.argv[1]))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-settings.threads :])
    report = bench(settings)
    return 0 if report["complete"] else 130


if __name__ == "__main__":
    sys.exit(main())
