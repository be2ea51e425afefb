"""How fast a GPU steps environments: the command ``lag-envs bench --device cuda``.

The rate is that of whole steps as in training: control, motion, reward, observation, ending, kick and
restarts. Beside it stands the data that the step has to read and write, as a share of the memory's rate,
which is measured by copying in the same run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import product
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch

from lag_envs.device import DeviceEnvs
from lag_envs.tables import aligned

#: Numbers copied to measure the memory, more than any cache holds.
COPIED = 2**28
#: Bytes of an environment besides its numbers: its age, read and written, and three booleans.
FLAGS = 4 + 4 + 3


class DeviceRate(NamedTuple):
    """Measurement of one environment.

    Attributes
    ----------
    id : str
        The environment.
    dtype : torch.dtype
        Precision of its numbers.
    num_envs : int
        How many environments step together.
    steps : float
        Steps per second of all of them together.
    share : float
        Data that they read and write, as a share of what the memory can transfer.
    """

    id: str
    dtype: torch.dtype
    num_envs: int
    steps: float
    share: float


def rates(
    ids: Sequence[str], sizes: Sequence[int], device: str | torch.device, seconds: float, rounds: int
) -> list[DeviceRate]:
    """Measure environments on a GPU, in single and in double precision.

    Parameters
    ----------
    ids : sequence of str
        Environments without imperfections.
    sizes : sequence of int
        Numbers of environments.
    device : str or torch.device
        The GPU.
    seconds : float
        Target length of a sample.
    rounds : int
        Samples of each; the median counts.
    """
    bandwidth = _bandwidth(device, seconds, rounds)
    found = []
    for env_id, dtype, size in product(ids, (torch.float32, torch.float64), sizes):
        envs = DeviceEnvs(env_id, size, device, dtype, autoreset_mode="SameStep")
        envs.reset(seed=0)
        steps = size * _calls_a_second(_stepping(envs), envs.device, seconds, rounds)
        found.append(DeviceRate(env_id, dtype, size, steps, steps * traffic(envs) / bandwidth))
    return found


def traffic(envs: DeviceEnvs) -> int:
    """Return the bytes that a step of one environment must at least read and write."""
    number = envs.rows.element_size()
    kept, seen = envs.rows.shape[0], len(envs.task.observation)
    actions = envs.task.formulas.actions
    return number * (2 * kept + actions + 1) + 2 * 4 * seen + FLAGS


def device_table(found: Sequence[DeviceRate]) -> str:
    """Return the measurements as text."""
    head = ("environment", "precision", "environments", "steps/s", "share of memory's rate")
    rows = [
        (r.id, str(r.dtype).removeprefix("torch."), f"{r.num_envs:,}", f"{r.steps:.3g}", f"{r.share:.0%}")
        for r in found
    ]
    return "\n".join(aligned([head, *rows]))


def _bandwidth(device: str | torch.device, seconds: float, rounds: int) -> float:
    """Return the bytes per second that copying reads and writes."""
    memory = torch.empty(COPIED, dtype=torch.float32, device=device)
    copy = torch.empty_like(memory)
    return 2 * memory.nbytes * _calls_a_second(lambda: copy.copy_(memory), memory.device, seconds, rounds)


def _stepping(envs: DeviceEnvs) -> Callable[[], Any]:
    """Return a function that takes a step with random actions made beforehand."""
    space = envs.sample.single_action_space
    space.seed(0)
    sample = torch.as_tensor(np.array([space.sample() for _ in range(1000)]), device=envs.device)
    actions = sample[torch.randint(len(sample), (envs.num_envs,), device=envs.device)]
    if actions.is_floating_point():
        actions = actions.to(envs.dtype)
    return lambda: envs.step(actions)


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
