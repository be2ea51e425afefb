"""The cost of a step of a chain, by the number of its bars: a section of ``lag-envs bench``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lag_envs.benchmark.chain_swing import ChainSwing
from lag_envs.benchmark.divisions import BATCH, divided
from lag_envs.benchmark.energies import LONGEST
from lag_envs.benchmark.rounds import ENERGIES
from lag_envs.envs.vector import LagrangianVectorEnv

Costs = dict[str, Any]


def chain_divisions() -> dict[int, float]:
    """Return the mean number of series that a step is divided into, by the number of bars."""
    return {
        n: divided(LagrangianVectorEnv(ChainSwing, BATCH, autoreset_mode="SameStep", bars=n))["mean"]
        for n in range(1, LONGEST + 1)
    }


def chain_costs(rows: Sequence[dict[str, Any]], series: Mapping[int, float] | None = None) -> Costs | None:
    """Return the time of a step and of one series.

    Parameters
    ----------
    rows : sequence of dict
        The measurements.
    series : mapping, optional
        The mean number of series in a step, by the number of bars.

    Returns
    -------
    dict or None
        ``bars``, the time ``ns`` of a step, and the ``exponent`` of the best fit of these times by a power
        law. If `series` is given, also `series` as a list, and ``series_exponent`` for the time of one
        series. None for fewer than two chains.

    Examples
    --------
    >>> about = {"library": ENERGIES, "num_envs": 8}
    >>> rows = [
    ...     {**about, "id": f"Chain({n})", "steps_per_second": [0.0, 1e9 / n**3, 0.0]} for n in (1, 2, 4)
    ... ]
    >>> chain_costs(rows)
    {'bars': [1, 2, 4], 'ns': [1.0, 8.0, 64.0], 'exponent': 3.0}
    >>> chain_costs(rows, {1: 1.0, 2: 2.0, 4: 4.0})["series_exponent"]
    2.0
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
    costs: Costs = {"bars": bars, "ns": [round(times[n], 1) for n in bars]}
    costs["exponent"] = _exponent(bars, costs["ns"])
    if series is not None:
        costs["series"] = [series[n] for n in bars]
        costs["series_exponent"] = _exponent(bars, _of_a_series(costs))
    return costs


def _of_a_series(costs: Costs) -> list[float]:
    return [ns / parts for ns, parts in zip(costs["ns"], costs["series"], strict=True)]


def _exponent(bars: Sequence[int], times: Sequence[float]) -> float:
    return round(float(np.polyfit(np.log(bars), np.log(times), 1)[0]), 2)


def cost_table(costs: Costs) -> list[tuple[str, ...]]:
    """Return a table of the times; its first row is the head."""
    head, times = ["bars", "step, ns"], [[f"{ns:,.0f}" for ns in costs["ns"]]]
    if "series" in costs:
        head += ["series a step", "series, ns"]
        times += [[f"{n:.2f}" for n in costs["series"]], [f"{ns:,.0f}" for ns in _of_a_series(costs)]]
    return [tuple(head), *zip(map(str, costs["bars"]), *times, strict=True)]


def growth(costs: Costs) -> str:
    """Return how fast the times grow, in words."""
    text = f"the time of a step grows as the number of bars to the power {costs['exponent']:g}"
    return text + (
        f", that of one series as the power {costs['series_exponent']:g}" if "series" in costs else ""
    )


def write_figure(costs: Costs, path: Path) -> None:
    """Draw the times and the cube of the number of bars; the file depends on nothing else."""
    import matplotlib
    from matplotlib.figure import Figure

    bars = costs["bars"]
    series = _of_a_series(costs)
    with matplotlib.rc_context({"svg.hashsalt": "lag_envs", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(5.2, 3.4), layout="constrained")
        ax = figure.subplots()
        ax.loglog(bars, costs["ns"], "o-", color="#D55E00", label="a step, substeps included")
        ax.loglog(bars, series, "s-", color="#0072B2", label="one series")
        ax.loglog(bars, [series[0] * n**3 for n in bars], "--", color="0.6", label="bars³")
        ax.set(xlabel="bars", ylabel="time [ns]", xticks=bars, xticklabels=bars)
        ax.minorticks_off()
        ax.grid(True, color="0.9", linewidth=0.6)
        ax.legend(frameon=False)
        figure.savefig(path, format="svg", facecolor="white", metadata={"Date": None, "Creator": None})
