"""The cost of each order of the series in a task's own episodes: ``lag-envs order``."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

from lag_envs.benchmark.environments import stepped
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.errors import UserError
from lag_envs.scenes.derivation import order_of
from lag_envs.stepping.general import LARGEST_FIXED
from lag_envs.stepping.series import LARGEST_ORDER, LEAST_ORDER

#: Odd ones only where code may be for one order: in loops they take as much work as the next even order.
ORDERS = (*range(LEAST_ORDER, LARGEST_FIXED), *range(LARGEST_FIXED, LARGEST_ORDER + 1, 2))
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

    For each order a batch continues under the same random actions, with its episodes restarted as they end;
    each round steps all batches in turn. With any order, each step is certified to the same tolerance.

    Parameters
    ----------
    task : type
        A task whose scene is stepped by a series.
    num_envs : int
        Size of a batch.
    rounds : int
        Number of samples, each of `STEPS` steps.
    advance : callable
        Called after each sample.
    """
    one = task()
    if not order_of(one.scene, one.dt):
        raise UserError(
            f"{task.__name__} is stepped in closed form or with an order that never changes, since "
            f"{type(one.scene).__name__} moves on a slope"
        )
    runs = {
        order: stepped(LagrangianVectorEnv(type(task.__name__, (task,), {"order": order}), num_envs))
        for order in ORDERS
    }
    samples: dict[int, list[float]] = {order: [] for order in ORDERS}
    for _ in range(rounds):
        for order, times in samples.items():
            begin = time.perf_counter()
            steps = runs[order](STEPS)
            times.append((time.perf_counter() - begin) / (steps * num_envs) * 1e9)
            advance()
    return {order: median(times) for order, times in samples.items()}


def best_order(times: dict[int, float]) -> int:
    """Return the lowest order whose time does not differ from the fastest by more than noise."""
    fastest = min(times.values())
    return next(order for order, taken in times.items() if taken <= SAME * fastest)


def lines(task: type[Any], times: dict[int, float], now: int) -> Sequence[str]:
    """Return the lines of the table, and the advice for the task."""
    found = best_order(times)
    rows = [f"{order:5}  {taken:8.1f}  {taken / times[found]:5.2f}" for order, taken in times.items()]
    if times[now if now in times else now + 1] <= SAME * times[found]:
        advice = f"{task.__name__} is stepped by order {now}, which is as fast as any."
    else:
        advice = (
            f"Write `order = {found}` into {task.__qualname__} ({task.__module__}), which is now stepped by "
            f"order {now}."
        )
    return ["order  ns a step  ratio", *rows, "", advice]
