"""How fast a GPU steps environments: the command ``lag-envs bench --device cuda``.

The rate is that of whole steps as in training: control, motion, reward, observation, ending, kick and
restarts. It is measured twice: calling `step`, and replaying a CUDA graph of it, which leaves out Python's
share. Beside the latter stands the data that a step has to read and write, as a share of the memory's rate,
which is measured by copying in the same run.
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
            envs = DeviceEnvs(env_id, size, device, dtype, autoreset_mode="SameStep")
            envs.reset(seed=0)
            step = _stepping(envs)
            replayed = size * calls_a_second(_in_graph(step, device))
            rows.append(
                {
                    "id": env_id,
                    "precision": str(dtype).removeprefix("torch."),
                    "num_envs": size,
                    "steps": size * calls_a_second(step),
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


def _stepping(envs: DeviceEnvs) -> Callable[[], Any]:
    """Return a function that takes a step with random actions made beforehand."""
    space = envs.sample.single_action_space
    space.seed(0)
    sample = torch.as_tensor(np.array([space.sample() for _ in range(1000)]), device=envs.device)
    actions = sample[torch.randint(len(sample), (envs.num_envs,), device=envs.device)]
    if actions.is_floating_point():
        actions = actions.to(envs.dtype)
    return lambda: envs.step(actions)


def _in_graph(step: Callable[[], Any], device: torch.device) -> Callable[[], Any]:
    """Return a function that replays a step recorded in a CUDA graph; without a GPU, the step itself."""
    if device.type != "cuda":
        return step
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        step()
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

    sample(3)
    count = max(1, round(seconds / sample(3)))
    return 1.0 / median(sample(count) for _ in range(rounds))
