"""Scenes defined by energies alone: work-precision compared with other engines, certificates, energy.

Each system takes one control step from the same harsh states, with every joint turning fast at once. All
rivals run in compiled loops, with many states in one call, and the errors are those of the timed calls. Other
engines' models are first checked to be equal.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from time import process_time
from typing import Any

import numpy as np

from lag_envs.report.general_results import CERTIFIED_ORDERS, DT, MEMBERS, content
from lag_envs.report.linkage_rivals import ENGINES, differences
from lag_envs.report.linkages import SYSTEMS, System
from lag_envs.report.motions import Array, CertifiedSeries, SceneProblems
from lag_envs.report.peers import Heyoka
from lag_envs.report.points import MODES
from lag_envs.report.radau import CompiledRadau
from lag_envs.report.reference import exact_ends
from lag_envs.report.rivals import CompiledMethod, Rival
from lag_envs.report.runner import ReportJob, Row, error_line
from lag_envs.report.timing import Sample, interleaved
from lag_envs.scenes.derivation import order_of
from lag_envs.stepping.general import LARGEST_FIXED, series_code_of
from lag_envs.stepping.series import LARGEST_ORDER

__all__ = ["attempts_and_bounds", "content", "jobs", "shares", "timed_rivals", "worst_and_median"]

#: Copies of the states in a timed call.
COPIES = 8
#: Tolerances of heyoka and lag_envs. They lie closest together where an error used for comparison is just
#: reached.
TOLERANCES: Sequence[float] = (
    1e-1, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6, 5e-7, 3e-7, 1e-7, 1e-8, 1e-9, 3e-10, 1e-10, 1e-11, 1e-12,
    3e-13, 1e-13, 1e-14,
)  # fmt: skip
HEYOKA: Sequence[float] = (*TOLERANCES, 1e-15)
#: Our tolerances and orders.
CERTIFIED: Sequence[tuple[float, int]] = tuple(
    (tolerance, order)
    for tolerance in TOLERANCES
    for order in (*range(3, LARGEST_FIXED), *range(LARGEST_FIXED, LARGEST_ORDER + 1, 2))
    if -math.log10(tolerance) <= order <= 6.0 - 2.0 * math.log10(tolerance)
)
#: Settings of the other methods.
RK4: Sequence[int] = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
DOP853: Sequence[int] = (1, 2, 3, 4, 6, 8, 12, 16, 32)
RADAU: Sequence[int] = (1, 2, 4, 8, 16, 32, 64)
#: Step lengths at which the certificate is tried [s].
LENGTHS = (0.005, 0.01, 0.02, 0.05, 0.1)
FAMILIES = ("compiled", "heyoka", *ENGINES)
#: The sample that is timed in turn with every job's samples.
CLOCK = CertifiedSeries(16, 1e-12)
#: Seconds over which energy is recorded.
LONG = 1000.0
#: Prints the time that a scene takes until its first step [s].
FIRST = """
from math import inf
from time import process_time
import numpy, numba, llvmlite.binding
from lag_envs.scenes import *
begin = process_time()
scene = {scene}
scene.simulate({state}, [{control}], {dt})
print(process_time() - begin)
"""


# --- jobs ---


def jobs(quick: bool) -> list[ReportJob]:
    """Return the jobs: exact end states, equality of models, then everything that is timed."""
    names = ["cart-pole"] if quick else list(SYSTEMS)
    families = [f for f in FAMILIES if not (quick and f == "pinocchio")]
    count = 8 if quick else MEMBERS
    made = [
        ReportJob(exact_ends_of_systems, f"exact: {name}", {"name": name, "count": count}, 900.0)
        for name in names
    ]
    made += [
        ReportJob(models, f"model: {name}, {engine}", {"name": name, "engine": engine}, 600.0)
        for name in names
        for engine in ENGINES
        if engine in families
    ]
    states = count if quick else 1000
    made += [
        ReportJob(certificate, f"certificate: {name}", {"name": name, "count": states}, 300.0)
        for name in names
    ]
    made.append(ReportJob(energy, "energy", {"quick": quick}, 600.0))
    alone = partial(ReportJob, timeout=900.0, alone=True)
    made += [
        alone(system_points, f"{family}: {name}", {"name": name, "family": family, "quick": quick})
        for name in names
        for family in families
    ]
    rounds = 1 if quick else 3
    made += [
        alone(first_step_seconds, f"first step: {name}", {"name": name, "rounds": rounds}) for name in names
    ]
    return made


def exact_ends_of_systems(name: str, count: int) -> Iterator[Row]:
    """Compute the exact end states and keep them for the other jobs."""
    system = SYSTEMS[name]
    high, _ = exact_ends(system.scene, *system.draw(count), DT)
    yield {"kind": "exact", "system": name, "states": len(high)}


def models(name: str, engine: str) -> Iterator[Row]:
    """Yield the difference of an engine's model from the scene's equations by SymPy."""
    about = {"kind": "model", "system": name, "engine": engine}
    try:
        mass, acceleration = differences(SYSTEMS[name], engine)
    except ImportError as error:
        yield about | {"problem": error_line(error)}
    else:
        yield about | {"mass": mass, "acceleration": acceleration}


# --- work-precision ---


def system_rivals(family: str, quick: bool) -> list[Rival]:
    """Return a family's methods at all settings; lag_envs is among the compiled ones."""
    some: slice = slice(-1, None, -5) if quick else slice(None)
    if family == "heyoka":
        methods = ("Taylor",) if quick else ("Taylor", Heyoka.NARROW)
        return [Heyoka(method, tolerance) for method in methods for tolerance in HEYOKA[some]]
    if family in ENGINES:
        kind = ENGINES[family]
        return [kind(method, n) for method, found in kind.settings.items() for n in found[some]]
    return compiled_rivals(CERTIFIED[slice(-1, None, -25) if quick else some], some)


def compiled_rivals(certified: Sequence[tuple[float, int]], some: slice) -> list[Rival]:
    """Return lag_envs at tolerances and orders, and the usual integrators at some of their settings."""
    return [
        *(CertifiedSeries(order, tolerance) for tolerance, order in certified),
        *(CompiledMethod("RK4", n) for n in RK4[some]),
        *(CompiledMethod("DOP853", n) for n in DOP853[some]),
        *(CompiledRadau(n) for n in RADAU[some]),
    ]


def system_points(name: str, family: str, quick: bool) -> Iterator[Row]:
    """Yield worst error and time of a family's settings on a system, alone and in a batch."""
    system, count = SYSTEMS[name], 8 if quick else MEMBERS
    starts, controls = system.draw(count)
    truth = exact_ends(system.scene, starts, controls, DT)
    copies = 1 if family in ENGINES else COPIES
    problems = SceneProblems(
        system.scene, np.tile(starts, (copies, 1)), np.tile(controls, (copies, 1)), system
    )
    for mode in MODES:
        yield from timed_rivals(name, problems, truth, system_rivals(family, quick), mode, 3 if quick else 9)


def timed_rivals(
    name: str,
    problems: SceneProblems,
    truth: tuple[Array, Array],
    some: Sequence[Rival],
    mode: str,
    rounds: int,
    dt: float = DT,
) -> Iterator[Row]:
    """Yield errors and times of rivals, for calls with all states, timed in turn with the clock."""
    together = mode == "batch"
    found: list[Row] = []
    samples: list[Sample] = []
    for rival in some:
        if together and not rival.batched:
            continue
        row = {
            "kind": "point", "mode": mode, "family": rival.family, "method": rival.method,
            "setting": rival.setting, "batched": rival.batched, "system": name,
        }  # fmt: skip
        try:
            sample = rival.build(problems, dt, 1, together)
            worst, typical = worst_and_median(sample.end(), truth)
        except Exception as error:
            yield row | {"problem": error_line(error)}
            if isinstance(error, ImportError):
                return
        else:
            found.append(row | {"error": worst, "median": typical})
            samples.append(again(sample))
    clock = again(CLOCK.build(problems, dt, 1, together))
    own, *times = interleaved([clock, *samples], rounds, process_time)
    for row, ns in zip(found, times, strict=True):
        yield row | {"ns": ns, "clock": own}


def worst_and_median(found: Array, truth: tuple[Array, Array]) -> tuple[float | None, float | None]:
    """Return the worst and median error over states, of the largest entry relative to max(1, |entry|)."""
    high, low = truth
    some = found[: len(high)]
    if not np.isfinite(some).all():
        return None, None
    each = np.max(np.abs((some - high) - low) / np.maximum(1.0, np.abs(high)), axis=1)
    return float(each.max()), float(np.median(each))


def again(sample: Sample) -> Sample:
    """Return a quick sample, repeated from its start until it has at least 10,000 steps."""
    sample.end()
    begin = process_time()
    sample.end()
    spent = max(process_time() - begin, 1e-6)
    times = max(1, min(-(-10_000 // sample.steps), int(0.02 / spent)))

    def run() -> None:
        for _ in range(times):
            sample.prepare()
            sample.run()

    return Sample(run, sample.steps * times)


# --- certificate, first step, energy ---


def certificate(name: str, count: int) -> Iterator[Row]:
    """Yield how many steps from harsh states are certified as a whole, and how many attempts others need."""
    system = SYSTEMS[name]
    for dt in LENGTHS:
        for order in CERTIFIED_ORDERS:
            attempts = attempts_and_bounds(system.scene, *system.draw(count, seed=2), dt, order)[0]
            yield {"kind": "certificate", "system": name, "dt": dt, "order": order, **shares(attempts)}


def attempts_and_bounds(
    scene: Any, states: Array, controls: Array, dt: float, order: int
) -> tuple[list[int], Array]:
    """Return each step's attempts (not positive if refused), and the largest bound of any step."""
    code, numbers = series_code_of(scene)
    attempts, bounds = [], []
    for state, held in zip(states.tolist(), controls.tolist(), strict=True):
        status, found = code.bounded(state, held, dt, order, numbers)
        attempts.append(int(status))
        bounds.append(float(max(np.max(part) for part in found)))
    return attempts, np.array(bounds)


def shares(attempts: Sequence[int]) -> Row:
    """Return the share of steps certified in one attempt, the mean of attempts, and the number refused."""
    taken = [a for a in attempts if a > 0]
    return {
        "share": sum(a == 1 for a in attempts) / len(attempts),
        "attempts": sum(taken) / len(taken) if taken else None,
        "refused": len(attempts) - len(taken),
    }


def first_step_seconds(name: str, rounds: int) -> Iterator[Row]:
    """Yield the seconds until the first step, with an empty and with a filled cache, and those of heyoka."""
    system = SYSTEMS[name]
    state, control = (x[0].tolist() for x in system.draw(1))
    script = FIRST.format(scene=system.scene, state=state, control=control, dt=DT)
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as cache:
            for kind in ("cold", "cached"):
                done = subprocess.run(
                    [sys.executable, "-P", "-c", script], env=os.environ | {"NUMBA_CACHE_DIR": cache},
                    check=True, capture_output=True, text=True,
                )  # fmt: skip
                yield {"kind": "first", "system": name, "what": kind, "seconds": float(done.stdout)}
    for mode in MODES:
        row = {"kind": "first", "system": name, "what": f"heyoka, {mode}"}
        try:
            yield row | {"seconds": _heyoka(system, mode)}
        except ImportError as error:
            yield row | {"problem": error_line(error)}
            return


def _heyoka(system: System, mode: str) -> float:
    import heyoka

    problems = SceneProblems(system.scene, *system.draw(1), system)
    width = 1 if mode == "single" else 2 * heyoka.recommended_simd_size()
    state: Any = heyoka.llvm_state
    # Earlier compilations, today's or older, must not be reused; version 7 keeps them on disk too.
    state.clear_memcache()
    switch = getattr(state, "set_diskcache_enabled", lambda on: None)
    switch(False)
    try:
        begin = process_time()
        Heyoka("Taylor", 1e-15).integrator(problems.equation, width)
        return process_time() - begin
    finally:
        switch(True)


def energy(quick: bool) -> Iterator[Row]:
    """Yield how far the energy of undamped double pendulums drifts, relative to its range.

    For lag_envs the drift is taken over the whole path, for the others at the end.
    """
    scene = SYSTEMS["double pendulum, driven"].scene
    count, steps = (1, 500) if quick else (4, round(LONG / DT))
    rng = np.random.default_rng(3)
    starts = np.zeros((count, 6))
    starts[:, 2::2] = rng.uniform(-math.pi, math.pi, (count, 2))
    starts[:, 3::2] = rng.uniform(-10.0, 10.0, (count, 2))
    controls = np.zeros((count, 1))
    before = scene.energy(starts)["total"]
    lowest = scene.energy(np.zeros(6))["total"]
    size = before - lowest
    for tolerance in (1e-6, 1e-9, 1e-12, None):
        worst = 0.0
        for i in range(count):
            path = _path(scene, starts[i], steps, tolerance)
            worst = max(worst, float(np.abs(scene.energy(path)["total"] - before[i]).max() / size[i]))
        method = "lag_envs, as shipped" if tolerance is None else f"lag_envs, tolerance {tolerance:g}"
        yield {"kind": "energy", "method": method, "seconds": steps * DT, "drift": worst}
    problems = SceneProblems(scene, starts, controls)
    for method, n in (("RK4", 4), ("RK4", 32), ("DOP853", 2), ("DOP853", 8)):
        end = CompiledMethod(method, n).build(problems, DT, steps, False).end()
        drift = np.abs(scene.energy(end)["total"] - before) / size
        row = {"kind": "energy", "method": f"{method}, {n} substeps", "seconds": steps * DT}
        yield row | {"drift": float(drift.max()) if np.isfinite(drift).all() else None}


def _path(scene: Any, start: Array, steps: int, tolerance: float | None) -> Array:
    """Return a trajectory without control, certified to a tolerance."""
    if tolerance is None:
        return scene.simulate(start, np.zeros(steps), DT)
    code, numbers = series_code_of(scene)
    path = np.empty((steps + 1, len(start)))
    path[0] = start
    if code.compile_simulate(tolerance)(path, np.zeros((steps, 1)), DT, float(order_of(scene, DT)), *numbers):
        raise ArithmeticError("a step was refused")
    return path
