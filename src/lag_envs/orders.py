"""The cost of each order of the series in a task's own episodes: ``lag-envs order``."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.errors import UserError
from lag_envs.stepping.series import LARGEST_ORDER

#: Only even orders: an odd order takes as much work as the next even order.
ORDERS = tuple(range(6, LARGEST_ORDER + 1, 2))
#: A lower order is preferred to an order that is faster by less than this factor, which is within the noise.
SAME = 1.02
#: Number of steps in a sample.
STEPS = 20


def measure_orders(
    task: type[Any],
    num_envs: int = 1024,
    rounds: int = 9,
    advance: Callable[[], Any] = lambda: None,
) -> dict[int, float]:
    """Return the time of a step [ns] for each order of the series.

    One batch continues under random actions, with its episodes restarted as they end; each round steps it
    with every order in turn. With any order, each step is certified to the same tolerance.

    Parameters
    ----------
    task : type
        A task whose scene has no flow of its own.
    num_envs : int
        Size of the batch.
    rounds : int
        Number of samples, each of `STEPS` steps.
    advance : callable
        Called after each sample.
    """
    envs = LagrangianVectorEnv(task, num_envs)
    if envs.order is None:
        raise UserError(
            f"{task.__name__} has a flow of its own, since {type(envs.scene).__name__} moves like a pendulum "
            "or on a slope; only orders of the general series are measured"
        )
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(64)]
    # Let the ages of the episodes spread before measuring.
    for action in actions * max(1, min(8, round(envs.task.limit / 64))):
        envs.step(action)
    samples: dict[int, list[float]] = {order: [] for order in ORDERS}
    for _ in range(rounds):
        for order, times in samples.items():
            envs.order = order
            begin = time.perf_counter()
            for action in actions[:STEPS]:
                envs.step(action)
            times.append((time.perf_counter() - begin) / (STEPS * num_envs) * 1e9)
            advance()
    envs.close()
    return {order: median(times) for order, times in samples.items()}


def best_order(times: dict[int, float]) -> int:
    """Return the lowest order whose time does not differ from the fastest by more than noise."""
    fastest = min(times.values())
    return next(order for order, taken in times.items() if taken <= SAME * fastest)


def lines(task: type[Any], times: dict[int, float], now: int) -> Sequence[str]:
    """Return the lines of the table, and the advice for the task."""
    found = best_order(times)
    rows = [f"{order:5}  {taken:8.1f}  {taken / times[found]:5.2f}" for order, taken in times.items()]
    if times[now + now % 2] <= SAME * times[found]:
        advice = f"{task.__name__} is stepped by order {now}, which is as fast as any."
    else:
        advice = (
            f"Write `order = {found}` into {task.__qualname__} ({task.__module__}), which is now stepped by "
            f"order {now}."
        )
    return ["order  ns a step  ratio", *rows, "", advice]
