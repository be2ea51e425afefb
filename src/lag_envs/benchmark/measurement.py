"""The whole measurement, from its settings to a report."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lag_envs
from lag_envs.benchmark import cold_start
from lag_envs.benchmark.chain_costs import chain_costs, chain_divisions
from lag_envs.benchmark.console import report_lines
from lag_envs.benchmark.contestants import contestants
from lag_envs.benchmark.divisions import divisions
from lag_envs.benchmark.docs import take_over
from lag_envs.benchmark.energies import of_energies
from lag_envs.benchmark.jacobians import backwards, jacobians
from lag_envs.benchmark.peak import arithmetic
from lag_envs.benchmark.results import row_summary, speedups
from lag_envs.benchmark.rounds import CLOCKS, measure_rates
from lag_envs.benchmark.targets import verdicts
from lag_envs.host import installed_versions, machine
from lag_envs.own_files import registered
from lag_envs.store import readable_json, write_file
from lag_envs.tasks import TASKS

LIBRARIES = ("gymnasium", "numpy", "numba", "llvmlite", "envpool", "gymnax", "jax", "torchrl", "torch")


@dataclass
class BenchmarkSettings:
    """Contents and length of a measurement."""

    ids: tuple[str, ...] = tuple(TASKS)
    files: tuple[str, ...] = ()  #: users' own files, which register some of the ids
    keywords: tuple[str, ...] = ()  #: each as in a call: measured in addition to the defaults
    energies: bool = False  #: also scenes defined by energies alone, beside CartPole-v1
    jacobians: bool = False  #: also the cost of a step's derivatives
    divisions: bool = False  #: also how often the certificate divides steps
    sizes: tuple[int, ...] = (1, 64, 1024, 16384)
    threads: int = 1  #: if more than 1, also batches stepped by this many
    rounds: int = 31
    seconds: float = 0.05  #: target length of one sample
    clock: str = "wall"  #: or "cpu", which leaves out the time of other programs on the core
    speed: bool = True
    cold_starts: int = 9  #: processes with a filled cache; half as many with an empty one
    date: str = ""
    output: str | None = None
    checkout: str | None = None  #: docs to write the result into


def bench(settings: BenchmarkSettings) -> dict[str, Any]:
    """Measure, print the tables, write the file if one is named, and return its contents.

    If anything fails or interrupts the measurement, everything measured before is printed and written.
    """
    for name in settings.files:
        registered(name)
    selection = settings.ids, settings.sizes, settings.keywords, settings.threads
    rows = contestants(*selection) if settings.speed else []
    if settings.speed and settings.energies:
        rows += of_energies(settings.sizes)
    times: dict[str, list[list[float]]] = {}
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    sections: dict[str, Any] = {}
    parts: dict[int, float] | None = None
    failure: Exception | None = None
    try:
        clock = CLOCKS[settings.clock]
        complete = measure_rates(rows, settings.rounds, settings.seconds, clock)
        if complete and settings.cold_starts:
            complete = cold_start.cold_starts(settings.ids[0], settings.cold_starts, times, settings.files)
        if complete and settings.jacobians:
            sections["jacobians"] = jacobians(settings.rounds, clock)
            sections["backwards"] = backwards(settings.rounds, clock)
        if complete and settings.divisions:
            sections["divisions"] = divisions(settings.ids)
            parts = chain_divisions() if settings.energies else None
    except KeyboardInterrupt:
        complete = False
    except Exception as error:
        complete, failure = False, error
    cold = {cache: cold_start.start_summary(some) for cache, some in times.items()}
    results = [row_summary(row, rows) for row in rows]
    report: dict[str, Any] = {
        "date": settings.date,
        "complete": complete,
        "machine": machine() | {"load_at_start": load},
        "versions": {"lag_envs": lag_envs.__version__} | installed_versions(LIBRARIES),
        "settings": asdict(settings),
        "rows": results,
        "cold_start": cold,
        "targets": verdicts(results, {cache: found["seconds"] for cache, found in cold.items()}),
        "chains": chain_costs(results, parts),
        "speedups": speedups(rows),
        "arithmetic": arithmetic(rows),
    } | sections
    measured = complete or times or any(row.rates for row in rows)
    output = Path(settings.output) if settings.output and measured else None
    try:
        if output:
            write_file(output, readable_json(report))
    finally:
        print("\n".join(report_lines(report)))
    if output:
        print(f"written to {output}")
    if failure is not None:
        raise failure
    if settings.checkout and complete:
        take_over(report, Path(settings.checkout))
        print(f"written to docs/speed.json, docs/speed.md and README.md in {settings.checkout}")
    return report
