"""How fast a GPU steps environments: the command ``lag-envs bench --device cuda``.

The rate is that of whole steps as in training: control, motion, reward, observation, ending, kick and
restarts, with random actions, at all times of the episodes. It is measured in two ways, in turn: calling
`step`, and replaying a CUDA graph of it, which leaves out Python's share. For both, the result includes the
data that a step has to read and write, as a share of the memory bandwidth. The bandwidth is measured by
copying in the same run. If gymnax and a JAX for the GPU are installed, gymnax's environment of the same task
is measured in turn with ours, its steps compiled into one call.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from itertools import product
from statistics import median
from typing import Any

import torch

from lag_envs import TASKS
from lag_envs.benchmark import peers
from lag_envs.device import DeviceEnvs
from lag_envs.errors import one_line
from lag_envs.progress import progress

#: How many numbers are copied to measure the bandwidth; no cache holds that many.
COPIED = 2**28
#: Bytes of an environment besides its numbers: its age, which is read and written, and four booleans.
FLAGS = 4 + 4 + 4
#: Number of environments that provide states by an episode before a measurement, and its maximum length.
FEW, LONGEST = 4096, 1000
#: Number of batches of random actions, used in turn while time is measured.
BATCHES = 16
#: Steps in one call of gymnax, and how many of them are unrolled, up to a number of environments: the fastest
#: forms that were tried on an H100, with its pendulum. So many calls are queued before their results are
#: waited for.
GYMNAX, QUEUED = {2**16: (64, 4), 2**62: (16, 1)}, 8

Run = Callable[[], Any]


def measured(
    ids: Sequence[str], sizes: Sequence[int], device: torch.device, seconds: float, rounds: int
) -> dict[str, Any]:
    """Measure environments on a GPU, in single and in double precision.

    If an environment fails, its row has the error. An interrupt ends the measurement.

    Parameters
    ----------
    ids : sequence of str
        Environments.
    sizes : sequence of int
        Numbers of environments.
    device : torch.device
        The GPU.
    seconds : float
        Target length of a sample.
    rounds : int
        Samples of each environment; the median counts.

    Returns
    -------
    dict
        ``gpu``, its name; ``settings``; ``bandwidth``, the bytes a second that copying reads and writes;
        ``complete``, whether it was not interrupted; and ``rows``. A row has ``id``, ``precision`` and
        ``num_envs``, and then ``problem``, or ``steps`` and ``replayed``, the steps a second of all
        environments together when `step` is called and in a CUDA graph, and ``share`` and
        ``replayed_share``, their data as a share of the bandwidth.
    """
    (copies,) = _rates([_copying(device)], device, seconds, rounds)
    report: dict[str, Any] = {
        "gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else "none",
        "settings": {"sizes": list(sizes), "seconds": seconds, "rounds": rounds},
        "bandwidth": 2 * 4 * COPIED * copies,
        "complete": False,
        "rows": [],
    }
    cases = list(product(ids, (torch.float32, torch.float64), sizes))
    with progress(len(cases)) as advance:
        for env_id, dtype, size in cases:
            row: dict[str, Any] = {
                "id": env_id,
                "precision": str(dtype).removeprefix("torch."),
                "num_envs": size,
            }
            try:
                envs = _under_way(env_id, size, device, dtype)
                run = _stepping(envs)
                runs = {"steps": (run, BATCHES), "replayed": (_in_graph(run, device), BATCHES)}
                runs |= _peer(env_id, size, device, dtype)
                rates = _rates([run for run, _ in runs.values()], device, seconds, rounds)
            except KeyboardInterrupt:
                return report
            except Exception as error:
                row["problem"] = f"failed: {one_line(error)}"
            else:
                for (name, (_, steps)), rate in zip(runs.items(), rates, strict=True):
                    row[name] = size * steps * rate
                per_step = traffic(envs) / report["bandwidth"]
                row["share"], row["replayed_share"] = row["steps"] * per_step, row["replayed"] * per_step
            report["rows"].append(row)
            advance(env_id)
    return report | {"complete": True}


def traffic(envs: DeviceEnvs) -> int:
    """Return the bytes that a step of one environment must at least read and write."""
    number = envs.rows.element_size()
    kept, seen = envs.rows.shape[0], len(envs.task.observation)
    actions = envs.task.formulas.actions
    return number * (2 * kept + actions + 1) + 2 * 4 * seen + FLAGS


def _copying(device: torch.device) -> Run:
    """Return a function that copies numbers from one place of the memory to another."""
    numbers, copy = torch.empty(2, COPIED, dtype=torch.float32, device=device)
    return lambda: copy.copy_(numbers)


def _under_way(env_id: str, size: int, device: torch.device, dtype: torch.dtype) -> DeviceEnvs:
    """Return environments in the middle of episodes, with the states that random actions lead to.

    Some environments go through a whole episode, or its first `LONGEST` steps, and stop at different times.
    The others are copies of these environments.
    """
    torch.manual_seed(0)
    few, envs = (
        DeviceEnvs(env_id, n, device, dtype, autoreset_mode="SameStep") for n in (min(size, FEW), size)
    )
    few.reset(seed=0)
    envs.reset(seed=0)
    length = int(min(few.task.limit, LONGEST))
    few.ages.random_(length)
    for _ in range(length):
        few.step(_random_actions(few))
    for given, found in ((envs.rows, few.rows), (envs.ages, few.ages)):
        copies = found.repeat(*[1] * (found.ndim - 1), -(-size // few.num_envs))
        given.copy_(copies[..., :size])
    return envs


def _random_actions(envs: DeviceEnvs) -> torch.Tensor:
    """Return an action for each environment."""
    space: Any = envs.sample.single_action_space
    shape = envs.num_envs, *(space.shape or ())
    if not envs.task.formulas.choices:
        low, high = (torch.as_tensor(x, device=envs.device) for x in (space.low, space.high))
        return low + (high - low) * torch.rand(shape, dtype=envs.dtype, device=envs.device)
    choices = torch.tensor(envs.task.formulas.choices, device=envs.device).expand(shape)
    return (torch.rand(shape, device=envs.device) * choices).long()


def _stepping(envs: DeviceEnvs) -> Run:
    """Return a function that takes steps with random actions made beforehand."""
    actions = [_random_actions(envs) for _ in range(BATCHES)]

    def run() -> None:
        for batch in actions:
            envs.step(batch)

    return run


def _in_graph(run: Run, device: torch.device) -> Run:
    """Return a function that replays steps recorded in a CUDA graph; without a GPU it takes the steps."""
    if device.type != "cuda":
        return run
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device), torch.cuda.graph(graph):
        run()
    return graph.replay


def _peer(env_id: str, size: int, device: torch.device, dtype: torch.dtype) -> dict[str, tuple[Run, int]]:
    """Return a run of gymnax's version of a task, and its number of steps; nothing if it cannot run."""
    name = TASKS[env_id].peer if env_id in TASKS else ""
    if not name or dtype != torch.float32 or device.type != "cuda":
        return {}
    together, unroll = next(form for most, form in GYMNAX.items() if size <= most)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs memory too
    try:
        import jax

        there = jax.default_device(jax.devices("cuda")[device.index])
        with there:
            step = peers.gymnax(size, name, together, unroll)
    except (ImportError, RuntimeError):  # not installed, or not for this GPU
        return {}

    def run() -> None:
        with there:
            step(QUEUED * together)

    return {"gymnax": (run, QUEUED * together)}


def _rates(runs: Sequence[Run], device: torch.device, seconds: float, rounds: int) -> list[float]:
    """Return how often per second functions can be called: medians of samples, taken in turn."""

    def wait() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    def sample(run: Run, count: int) -> float:
        wait()
        begun = time.perf_counter()
        for _ in range(count):
            run()
        wait()
        return (time.perf_counter() - begun) / count

    for run in runs:
        sample(run, 1)
    counts = [max(1, round(seconds / sample(run, 1))) for run in runs]
    times = [[sample(run, count) for run, count in zip(runs, counts, strict=True)] for _ in range(rounds)]
    return [1.0 / median(column) for column in zip(*times, strict=True)]
