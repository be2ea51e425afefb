"""How fast a GPU steps environments: the command ``lag-envs bench --device cuda``.

The rate is that of whole steps as in training: control, motion, reward, observation, ending, kick and
restarts, in environments that are in the midst of their episodes. It is measured twice: calling `step`, and
replaying a CUDA graph of it, which leaves out Python's share. Beside the latter stands the data that a step
has to read and write, as a share of the memory's rate, which is measured by copying in the same run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import product
from statistics import median
from typing import Any

import numpy as np
import torch

from lag_envs.device import DeviceEnvs
from lag_envs.progress import progress

#: Numbers copied to measure the memory, more than any cache holds.
COPIED = 2**28
#: Bytes of an environment besides its numbers: its age, read and written, and four booleans.
FLAGS = 4 + 4 + 4
#: Environments that go through an episode before a measurement, to provide states, and its maximum length.
FEW, LONGEST = 4096, 1000
#: Batches of random actions, used in turn.
BATCHES = 4


def measured(
    ids: Sequence[str], sizes: Sequence[int], device: torch.device, seconds: float, rounds: int
) -> dict[str, Any]:
    """Measure environments on a GPU, in single and in double precision.

    Parameters
    ----------
    ids : sequence of str
        Environments without imperfections.
    sizes : sequence of int
        Numbers of environments.
    device : torch.device
        The GPU.
    seconds : float
        Target length of a sample.
    rounds : int
        Samples of each; the median counts.

    Returns
    -------
    dict
        ``gpu``, its name; ``settings``; ``bandwidth``, the bytes a second that copying reads and writes; and
        ``rows``. A row has ``id``, ``precision`` and ``num_envs``; ``steps`` and ``replayed``, the steps a
        second of all environments together, when `step` is called and in a CUDA graph; and ``share``, the
        data of the latter as a share of the bandwidth.
    """

    def calls_a_second(run: Callable[[], Any]) -> float:
        return _calls_a_second(run, device, seconds, rounds)

    bandwidth = 2 * 4 * COPIED * calls_a_second(_copying(device))
    rows = []
    cases = list(product(ids, (torch.float32, torch.float64), sizes))
    with progress(len(cases)) as advance:
        for env_id, dtype, size in cases:
            envs = _under_way(env_id, size, device, dtype)
            run = _stepping(envs)
            replayed = BATCHES * size * calls_a_second(_in_graph(run, device))
            rows.append(
                {
                    "id": env_id,
                    "precision": str(dtype).removeprefix("torch."),
                    "num_envs": size,
                    "steps": BATCHES * size * calls_a_second(run),
                    "replayed": replayed,
                    "share": replayed * traffic(envs) / bandwidth,
                }
            )
            advance(env_id)
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else "none"
    settings = {"sizes": list(sizes), "seconds": seconds, "rounds": rounds}
    return {"gpu": gpu, "settings": settings, "bandwidth": bandwidth, "rows": rows}


def traffic(envs: DeviceEnvs) -> int:
    """Return the bytes that a step of one environment must at least read and write."""
    number = envs.rows.element_size()
    kept, seen = envs.rows.shape[0], len(envs.task.observation)
    actions = envs.task.formulas.actions
    return number * (2 * kept + actions + 1) + 2 * 4 * seen + FLAGS


def _copying(device: torch.device) -> Callable[[], Any]:
    """Return a function that copies numbers from one place of the memory to another."""
    numbers, copy = torch.empty(2, COPIED, dtype=torch.float32, device=device)
    return lambda: copy.copy_(numbers)


def _under_way(env_id: str, size: int, device: torch.device, dtype: torch.dtype) -> DeviceEnvs:
    """Return environments at all times of their episodes, with the states that random actions lead to."""
    few, envs = (
        DeviceEnvs(env_id, n, device, dtype, autoreset_mode="SameStep") for n in (min(size, FEW), size)
    )
    few.reset(seed=0)
    envs.reset(seed=0)
    length = int(min(few.task.limit, LONGEST))
    few.ages.random_(length)
    run = _stepping(few)
    for _ in range(0, length, BATCHES):
        run()
    for given, found in ((envs.rows, few.rows), (envs.ages, few.ages)):
        copies = found.repeat(*[1] * (found.ndim - 1), -(-size // few.num_envs))
        given.copy_(copies[..., :size])
    return envs


def _stepping(envs: DeviceEnvs) -> Callable[[], Any]:
    """Return a function that takes steps with random actions made beforehand."""
    space = envs.sample.single_action_space
    space.seed(0)
    sample = torch.as_tensor(np.array([space.sample() for _ in range(1000)]), device=envs.device)
    if sample.is_floating_point():
        sample = sample.to(envs.dtype)
    actions = sample[torch.randint(len(sample), (BATCHES, envs.num_envs), device=envs.device)].unbind()

    def run() -> None:
        for batch in actions:
            envs.step(batch)

    return run


def _in_graph(run: Callable[[], Any], device: torch.device) -> Callable[[], Any]:
    """Return a function that replays steps recorded in a CUDA graph; without a GPU, the steps."""
    if device.type != "cuda":
        return run
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph.replay


def _calls_a_second(run: Callable[[], Any], device: torch.device, seconds: float, rounds: int) -> float:
    """Return how often per second a function can be called, the median of samples of a given length."""

    def wait() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    def sample(count: int) -> float:
        wait()
        begun = time.perf_counter()
        for _ in range(count):
            run()
        wait()
        return (time.perf_counter() - begun) / count

    sample(1)
    count = max(1, round(seconds / sample(1)))
    return 1.0 / median(sample(count) for _ in range(rounds))
