"""Scenes that are nothing but energies: error against time beside other engines, certificates, energy.

Each system is stepped for one control step from the same harsh states, every joint turning fast at once. All
rivals run in compiled loops, many states in one call, and the errors are those of the calls that are timed.
What other engines are given is proved to be the same model first.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from statistics import median
from time import process_time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lag_envs.report.content import Claim, Content, Picture, Table
from lag_envs.report.linkages import ENGINES, SYSTEMS, System, differences
from lag_envs.report.motions import Array, Certified, SceneProblems
from lag_envs.report.peers import Heyoka
from lag_envs.report.radau import CompiledRadau
from lag_envs.report.reference import ends
from lag_envs.report.rivals import Compiled, Rival
from lag_envs.report.runner import Job, Result, Row, describe
from lag_envs.report.timing import Sample, interleaved
from lag_envs.stepping.general import code_of, usual_order
from lag_envs.stepping.series import TOLERANCE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECTION = "general"
DT = 0.02
#: Systems, states, copies of them in a timed call, tolerances and orders of ours; the same for a quick look.
MEMBERS, COPIES = 200, 8
TOLERANCES: Sequence[float] = (1e-2, 1e-3, 1e-4, 1e-6, 1e-7, 1e-9, 1e-10, 1e-12, 1e-14)
ORDERS: Sequence[int] = tuple(range(4, 25, 2))
#: Settings of the others.
HEYOKA: Sequence[float] = (1e-2, 1e-3, 1e-4, 1e-6, 1e-7, 1e-9, 1e-10, 1e-12, 1e-13, 1e-15)
SUBSTEPS = {
    "RK4": (1, 2, 4, 8, 16, 32, 64, 128, 256, 512),
    "DOP853": (1, 2, 3, 4, 6, 8, 12, 16, 32),
    CompiledRadau.METHOD: (1, 2, 4, 8, 16, 32, 64),
}
#: Errors at which times are compared.
TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
MODES = {"single": "alone", "batch": "in a batch"}
FAMILIES = ("compiled", "heyoka", *ENGINES)
LABELS = {"heyoka": "heyoka", "mujoco": "MuJoCo", "pinocchio": "Pinocchio", "compiled": "compiled"}
#: What the certificate is asked for: lengths of a step [s] and orders.
LENGTHS = (0.005, 0.01, 0.02, 0.05, 0.1)
CERTIFIED_ORDERS = (12, 14, 16, 18, 20, 22)
#: The order of the clock, with which every job's samples are taken in turn.
CLOCK = (1e-12, 16)
#: Models count as equal to this, relative.
EQUAL = 1e-12
#: Seconds over which energy is watched, and the most that may be lost of it, relative.
LONG, DRIFT = 1000.0, 1e-9
#: Prints the seconds until a scene has made its first step.
FIRST = """
from time import process_time
import numpy, numba, llvmlite.binding
from lag_envs.scenes import *
begin = process_time()
scene = {scene}
scene.simulate({state}, [{control}], {dt})
print(process_time() - begin)
"""


# --- jobs ---


def jobs(quick: bool) -> list[Job]:
    """Return the jobs: exact ends, equality of models, then all that is timed."""
    names = ["cart-pole"] if quick else list(SYSTEMS)
    families = [f for f in FAMILIES if not (quick and f == "pinocchio")]
    count = 8 if quick else MEMBERS
    made = [
        Job(SECTION, f"exact: {name}", f"{SECTION}:exact", {"name": name, "count": count}, 900.0)
        for name in names
    ]
    made += [
        Job(SECTION, f"model: {name}, {engine}", f"{SECTION}:models", {"name": name, "engine": engine}, 600.0)
        for name in names
        for engine in ENGINES
        if engine in families
    ]
    made += [
        Job(
            SECTION, f"certificate: {name}", f"{SECTION}:certificate",
            {"name": name, "count": count if quick else 1000}, 300.0,
        )
        for name in names
    ]  # fmt: skip
    made.append(Job(SECTION, "energy", f"{SECTION}:energy", {"quick": quick}, 600.0))
    alone = partial(Job, SECTION, timeout=900.0, alone=True)
    made += [
        alone(f"{family}: {name}", f"{SECTION}:points", {"name": name, "family": family, "quick": quick})
        for name in names
        for family in families
    ]
    made += [
        alone(f"first step: {name}", f"{SECTION}:first", {"name": name, "rounds": 1 if quick else 3})
        for name in names
    ]
    return made


def exact(name: str, count: int) -> Iterator[Row]:
    """Compute the exact ends, which are kept for the other jobs."""
    system = SYSTEMS[name]
    high, _ = ends(system.scene, *system.draw(count), DT)
    yield {"kind": "exact", "system": name, "states": len(high)}


def models(name: str, engine: str) -> Iterator[Row]:
    """Yield how far an engine's model is from the scene's equations by SymPy."""
    about = {"kind": "model", "system": name, "engine": engine}
    try:
        mass, acceleration = differences(SYSTEMS[name], engine)
    except ImportError as error:
        yield about | {"problem": describe(error)}
    else:
        yield about | {"mass": mass, "acceleration": acceleration}


# --- error against time ---


def rivals(family: str, quick: bool) -> list[Rival]:
    """Return a family's methods at all settings; ours are with those that our machinery compiles."""
    some: slice = slice(-1, None, -5) if quick else slice(None)
    if family == "heyoka":
        methods = ("Taylor",) if quick else ("Taylor", Heyoka.NARROW)
        return [Heyoka(method, tolerance) for method in methods for tolerance in HEYOKA[some]]
    if family in ENGINES:
        kind = ENGINES[family]
        return [kind(method, n) for method, found in kind.settings.items() for n in found[some]]
    ours = [
        Certified(Certified.method_of(order), tolerance)
        for tolerance in TOLERANCES[some]
        for order in ORDERS[some]
    ]
    others = [Compiled(method, n) for method in ("RK4", "DOP853") for n in SUBSTEPS[method][some]]
    return [
        *ours,
        *others,
        *(CompiledRadau(CompiledRadau.METHOD, n) for n in SUBSTEPS[CompiledRadau.METHOD][some]),
    ]


def points(name: str, family: str, quick: bool) -> Iterator[Row]:
    """Yield worst error and time of a family's settings on a system, alone and in a batch."""
    system, count = SYSTEMS[name], 8 if quick else MEMBERS
    starts, controls = system.draw(count)
    truth = ends(system.scene, starts, controls, DT)
    copies = 1 if family in ENGINES else COPIES
    problems = SceneProblems(
        system.scene, np.tile(starts, (copies, 1)), np.tile(controls, (copies, 1)), system
    )
    clock = Certified(Certified.method_of(CLOCK[1]), CLOCK[0])
    for mode in MODES:
        yield from measured(
            problems, truth, rivals(family, quick), clock, mode, 3 if quick else 9, {"system": name}
        )


def measured(
    problems: SceneProblems,
    truth: tuple[Array, Array],
    some: Sequence[Rival],
    clock: Rival,
    mode: str,
    rounds: int,
    about: Mapping[str, Any],
    dt: float = DT,
) -> Iterator[Row]:
    """Yield errors and times of rivals, those of a call from all states, taken in turn with a clock's."""
    together = mode == "batch"
    found: list[Row] = []
    samples: list[Sample] = []
    for rival in some:
        if together and not rival.batched:
            continue
        row = {
            "kind": "point", "mode": mode, "family": rival.family, "method": rival.method,
            "setting": rival.setting, "batched": rival.batched, **about,
        }  # fmt: skip
        try:
            sample = rival.build(problems, dt, 1, together)
            worst, typical = errors(sample.end(), truth)
        except Exception as error:
            yield row | {"problem": describe(error)}
            if isinstance(error, ImportError):
                return
        else:
            found.append(row | {"error": worst, "median": typical})
            samples.append(again(sample))
    shown = [again(clock.build(problems, dt, 1, together)), *samples]
    times = interleaved(dict(enumerate(shown)), rounds, process_time)
    for i, row in enumerate(found):
        yield row | {"ns": times[i + 1], "clock": times[0]}


def errors(found: Array, truth: tuple[Array, Array]) -> tuple[float | None, float | None]:
    """Return worst and median over states of the largest entry's error, relative to max(1, |entry|)."""
    high, low = truth
    some = found[: len(high)]
    if not np.isfinite(some).all():
        return None, None
    each = np.max(np.abs((some - high) - low) / np.maximum(1.0, np.abs(high)), axis=1)
    return float(each.max()), float(np.median(each))


def again(sample: Sample, least: int = 10_000) -> Sample:
    """Return the sample so often repeated from its start that it has so many steps, if they are quick."""
    sample.end()
    begin = process_time()
    sample.end()
    spent = max(process_time() - begin, 1e-6)
    times = max(1, min(-(-least // sample.steps), int(0.02 / spent)))

    def run() -> None:
        for _ in range(times):
            sample.prepare()
            sample.run()

    return Sample(run, sample.steps * times)


# --- certificate, first step, energy ---


def certificate(name: str, count: int) -> Iterator[Row]:
    """Yield how many steps from harsh states are certified as a whole, and the attempts of the others."""
    system = SYSTEMS[name]
    for dt in LENGTHS:
        for order in CERTIFIED_ORDERS:
            attempts = certified(system.scene, *system.draw(count, seed=2), dt, order)[0]
            yield {"kind": "certificate", "system": name, "dt": dt, "order": order, **shares(attempts)}


def certified(scene: Any, states: Array, controls: Array, dt: float, order: int) -> tuple[list[int], Array]:
    """Return the attempts of each step, not positive where it was refused, and its largest bound."""
    code, numbers = code_of(scene)
    attempts, bounds = [], []
    for state, held in zip(states.tolist(), controls.tolist(), strict=True):
        status, found = code.bounded(state, held, dt, order, numbers)
        attempts.append(int(status))
        bounds.append(float(max(np.max(part) for part in found)))
    return attempts, np.array(bounds)


def shares(attempts: Sequence[int]) -> Row:
    """Return the share of steps certified in one attempt, the mean of attempts, and how many were refused."""
    taken = [a for a in attempts if a > 0]
    return {
        "share": sum(a == 1 for a in attempts) / len(attempts),
        "attempts": sum(taken) / len(taken) if taken else None,
        "refused": len(attempts) - len(taken),
    }


def first(name: str, rounds: int) -> Iterator[Row]:
    """Yield the seconds until the first step: ours with an empty and a filled cache, heyoka's compiling."""
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
        try:
            yield {
                "kind": "first",
                "system": name,
                "what": f"heyoka, {mode}",
                "seconds": _heyoka(system, mode),
            }
        except ImportError as error:
            yield {"kind": "first", "system": name, "what": f"heyoka, {mode}", "problem": describe(error)}
            return


def _heyoka(system: System, mode: str) -> float:
    import heyoka

    problems = SceneProblems(system.scene, *system.draw(1), system)
    width = 1 if mode == "single" else 2 * heyoka.recommended_simd_size()
    state: Any = heyoka.llvm_state
    # What it has compiled before, on this day or another, does not count; version 7 keeps it on disk too.
    state.clear_memcache()
    switch = getattr(state, "set_diskcache_enabled", lambda on: None)
    switch(False)
    try:
        begin = process_time()
        Heyoka("Taylor", 1e-15)._integrator(problems.equation, width)
        return process_time() - begin
    finally:
        switch(True)


def energy(quick: bool) -> Iterator[Row]:
    """Yield how far the energy of undamped double pendulums is from where it was, relative to its range.

    Ours over the whole path, the others at its end.
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
        end = Compiled(method, n).build(problems, DT, steps, False).end()
        drift = np.abs(scene.energy(end)["total"] - before) / size
        row = {"kind": "energy", "method": f"{method}, {n} substeps", "seconds": steps * DT}
        yield row | {"drift": float(drift.max()) if np.isfinite(drift).all() else None}


def _path(scene: Any, start: Array, steps: int, tolerance: float | None) -> Array:
    """Return a trajectory without control, certified to a tolerance."""
    if tolerance is None:
        return scene.simulate(start, np.zeros(steps), DT)
    code, numbers = code_of(scene)
    path = np.empty((steps + 1, len(start)))
    path[0] = start
    if code.compile_simulate(tolerance)(path, np.zeros((steps, 1)), DT, float(scene._order(DT)), *numbers):
        raise ArithmeticError("a step was refused")
    return path


# --- what it comes to ---


class Best(NamedTuple):
    """The quickest setting of a method that reaches an error."""

    ns: float
    label: str


def label(row: Row) -> str:
    """Return a setting in words."""
    if row["family"] in ("ours", "heyoka"):
        return f"{row['method'].removeprefix('lag_envs, ')}, {row['setting']:g}"
    return f"{row['method']}, {row['setting']:g} substep{'s' if row['setting'] > 1 else ''}"


def column(row: Row) -> str:
    """Return whose column a point belongs to: compiled methods have one each."""
    if row["family"] == "ours":
        return "lag_envs"
    if row["family"] == "compiled":
        return f"{row['method']}, compiled"
    return LABELS[row["family"]]


#: Those that are compared with, and in which columns they are.
OTHERS = (
    ("other libraries", ("heyoka", "MuJoCo", "Pinocchio")),
    (
        "steps of one length without a bound, compiled as ours is",
        ("RK4, compiled", "DOP853, compiled", "Radau IIA, compiled"),
    ),
)
COLUMNS = (*OTHERS[0][1], *OTHERS[1][1])


def best(rows: Sequence[Row]) -> dict[tuple[str, str, float], dict[str, Best]]:
    """Return, by system, mode and error, the quickest setting of each column.

    Times are in ours of one job, by the clock that every job has taken; what has no batch is in it as alone.
    """
    points = [r for r in rows if r["kind"] == "point" and "ns" in r and r["error"] is not None]
    clocks: dict[tuple[str, str], float] = {}
    for r in points:
        if r["family"] == "ours":
            clocks.setdefault((r["system"], r["mode"]), r["clock"])
    found: dict[tuple[str, str, float], dict[str, Best]] = {}
    for r in points:
        ns = r["ns"] * clocks.get((r["system"], r["mode"]), r["clock"]) / r["clock"]
        for mode in MODES:
            if mode != r["mode"] and r["batched"]:
                continue
            for target in TARGETS:
                here = found.setdefault((r["system"], mode, target), {})
                if r["error"] <= target and not (column(r) in here and here[column(r)].ns <= ns):
                    here[column(r)] = Best(ns, label(r))
    return found


def content(rows: Sequence[Row], problems: Sequence[Result]) -> Content:
    """Return what is shown: times at equal errors, equality of models, certificates, first steps, energy."""
    found = best(rows)
    missing = sorted({r["problem"] for r in rows if "not installed" in r.get("problem", "")})
    fastest = [_fastest(found, mode, *others) for others in OTHERS for mode in MODES]
    claims = [_equal(rows), _accurate(rows), *fastest, _conserved(rows)]
    pictures = [
        Picture(
            f"general-{slug(name)}",
            f"Error against time, {name}. One control step of {DT:g} s from {MEMBERS} harsh states: worst "
            "error, and CPU time of a state's step; reference: Lagrange's equations by SymPy, Taylor "
            "series in python-flint's balls.",
            partial(draw, name, [r for r in rows if r["kind"] == "point" and r["system"] == name]),
        )
        for name in SYSTEMS
        if any(r["kind"] == "point" and r["system"] == name for r in rows)
    ]
    tables = [_times(found, mode) for mode in MODES]
    tables += [_models(rows), _shares(rows), _first(rows), _energy(rows)]
    return Content(
        "Any Lagrangian",
        [
            "Scenes that state nothing but their energies are stepped by the general series, with the "
            f"certificate that comes with each step. Here they take one control step of {DT:g} s from "
            f"{MEMBERS} harsh states, each joint turning at up to 6 to 12 rad/s at once. An error is that "
            "of the worst entry of the worst state, relative to max(1, |entry|), against Taylor series of "
            "Lagrange's equations by SymPy in python-flint's ball arithmetic.",
            "All run in compiled loops, many states in one call, on one core; what a call costs counts for "
            "everybody, compiling for nobody. Samples are taken in turn, and times are medians of the "
            "processor's time. The errors are those of the calls that are timed, at the quickest setting "
            "that reaches the error given.",
            "Ours certifies each step, at a tolerance and an order. The others give no bound: which "
            "setting reaches an error is known here from the exact ends. heyoka runs with fast_math, "
            "without compact mode, its compiled step in a compiled loop, in a batch in blocks of two "
            "widths. MuJoCo runs its own model in compiled rollouts, by Euler, implicitfast and RK4, "
            "Pinocchio its articulated-body algorithm in RK4 steps in a C++ loop; a driven support is a "
            "field in its frame for both. RK4, DOP853 and Radau IIA take steps of one length and are "
            "compiled as ours is.",
            *([f"Not taken part: {', '.join(missing)}."] if missing else []),
            *(verdict(found, mode) for mode in MODES if found),
        ],
        [t for t in tables if t.rows],
        pictures,
        claims,
        summary=_summary(found),
        details=[_all(rows)],
    )


def slug(name: str) -> str:
    """Return a system's name as part of a file's."""
    return name.replace(",", "").replace(" ", "-")


def verdict(found: Mapping[tuple, Mapping[str, Best]], mode: str) -> str:
    """Say of each column how it compares at equal error."""
    parts = []
    for name in COLUMNS:
        ratios = [
            here[name].ns / here["lag_envs"].ns
            for (_, of, _), here in found.items()
            if of == mode and name in here and "lag_envs" in here
        ]
        if not ratios:
            continue
        worst, wins = min(ratios), sum(r < 1.0 for r in ratios)
        text = f"{name} takes {worst:.2g} to {max(ratios):.3g} times our time"
        parts.append(text + (f", and is faster in {wins} of {len(ratios)} cases" if wins else ""))
    return (
        f"At equal error, {MODES[mode]}: {'; '.join(parts)}."
        if parts
        else f"Nothing to compare {MODES[mode]}."
    )


def _cell(here: Mapping[str, Best], name: str) -> float | None:
    return round(here[name].ns, 1) if name in here else None


def _others(here: Mapping[str, Best]) -> list[tuple[float, str]]:
    return sorted((b.ns, name) for name, b in here.items() if name != "lag_envs")


def _times(found: Mapping[tuple, Mapping[str, Best]], mode: str) -> Table:
    rows = []
    for (system, of, target), here in found.items():
        if of != mode or "lag_envs" not in here:
            continue
        others, ours = _others(here), here["lag_envs"]
        ratio = others[0][0] / ours.ns if others else None
        rows.append((
            system, f"{target:g}", round(ours.ns, 1), ours.label, *(_cell(here, name) for name in COLUMNS),
            ratio, f"{others[0][1]}: {here[others[0][1]].label}" if others else None,
        ))  # fmt: skip
    return Table(
        f"general-times-{mode}",
        f"CPU time of a control step [ns] {MODES[mode]}, each at its quickest setting whose worst error is "
        "below the one given; the ratio is that of the quickest other to ours, below 1 where the other is "
        "faster",
        (
            "system",
            "error",
            "lag_envs",
            "order, tolerance",
            *COLUMNS,
            "quickest other / ours",
            "quickest other",
        ),
        rows,
    )


def _summary(found: Mapping[tuple, Mapping[str, Best]]) -> Table | None:
    rows = []
    for (system, mode, target), here in found.items():
        if mode == "single" and target in (1e-6, 1e-12) and "lag_envs" in here:
            together = found[system, "batch", target]
            cells = [_cell(here, name) for name in COLUMNS[:5]]
            rows.append((system, f"{target:g}", _cell(here, "lag_envs"), _cell(together, "lag_envs"), *cells,
                         _cell(together, "heyoka")))  # fmt: skip
    if not rows:
        return None
    return Table(
        "general-summary",
        f"Scenes that are only energies: CPU time of a control step of {DT:g} s [ns], each at its quickest "
        f"setting whose worst error from {MEMBERS} harsh states is below the one given; ours is certified, "
        "the others give no bound (`lag-envs report`)",
        ("system", "error", "lag_envs", "in a batch", *COLUMNS[:5], "heyoka in a batch"),
        rows,
    )


def _equal(rows: Sequence[Row]) -> Claim:
    found = [r for r in rows if r["kind"] == "model" and "mass" in r]
    worst = max((max(r["mass"], r["acceleration"]) for r in found), default=0.0)
    return Claim(
        f"Other engines have the same models: mass matrices and accelerations to {EQUAL:g}.",
        worst <= EQUAL if found else None,
        f"{worst:.1e} at most in {len(found)} models" if found else "",
    )


def _accurate(rows: Sequence[Row]) -> Claim:
    shipped = TOLERANCE, Certified.method_of(usual_order(DT))
    found = [r for r in rows if r["kind"] == "point" and (r["setting"], r["method"]) == shipped]
    worst = max((math.inf if r["error"] is None else r["error"] for r in found), default=0.0)
    return Claim(
        "At the tolerance and the order that are shipped, a step from a harsh state errs by less than 1e-12.",
        worst < 1e-12 if found else None,
        f"{worst:.1e} at most" if found else "",
    )


def _fastest(found: Mapping[tuple, Mapping[str, Best]], mode: str, who: str, names: Sequence[str]) -> Claim:
    lost, cases = [], 0
    for (system, of, target), here in found.items():
        others = [(ns, name) for ns, name in _others(here) if name in names]
        if of != mode or "lag_envs" not in here or not others:
            continue
        cases += 1
        ns, name = others[0]
        if ns < here["lag_envs"].ns:
            lost.append(f"{name} by {here['lag_envs'].ns / ns:.2f} ({system}, {target:g})")
    told = f"{cases - len(lost)} of {cases} cases" + (f"; faster: {', '.join(lost)}" if lost else "")
    return Claim(
        f"Ours reaches each error in less time than {who}, {MODES[mode]}.",
        not lost if cases else None,
        told if cases else "",
    )


def _conserved(rows: Sequence[Row]) -> Claim:
    found = [r for r in rows if r["kind"] == "energy" and r["method"] == "lag_envs, as shipped"]
    return Claim(
        f"The energy of an undamped double pendulum stays within {DRIFT:g} of its range.",
        all(r["drift"] <= DRIFT for r in found) if found else None,
        f"{max(r['drift'] for r in found):.1e} over {found[0]['seconds']:,.0f} s" if found else "",
    )


def _models(rows: Sequence[Row]) -> Table:
    return Table(
        "general-models",
        "Other engines' models against Lagrange's equations by SymPy, at 50 random states: largest "
        "differences, relative",
        ("system", "engine", "mass matrix", "acceleration"),
        [
            (r["system"], LABELS[r["engine"]], r.get("mass", r.get("problem")), r.get("acceleration"))
            for r in rows
            if r["kind"] == "model"
        ],
    )


def _shares(rows: Sequence[Row]) -> Table:
    found: dict[tuple[str, float], dict[int, Row]] = {}
    for r in rows:
        if r["kind"] == "certificate":
            found.setdefault((r["system"], r["dt"]), {})[r["order"]] = r
    return Table(
        "general-certificate",
        "Share of harsh states from which a step of a length is certified as a whole at the tolerance that "
        f"is shipped, by order, and attempts a step at order {CERTIFIED_ORDERS[-1]}",
        ("system", "step [s]", *(f"order {n}" for n in CERTIFIED_ORDERS), "attempts", "refused"),
        [
            (system, dt, *(f"{100.0 * here[n]['share']:.1f} %" for n in CERTIFIED_ORDERS),
             here[CERTIFIED_ORDERS[-1]]["attempts"], sum(r["refused"] for r in here.values()))
            for (system, dt), here in found.items()
            if len(here) == len(CERTIFIED_ORDERS)
        ],
    )  # fmt: skip


def _first(rows: Sequence[Row]) -> Table:
    found: dict[str, dict[str, list[float]]] = {}
    for r in rows:
        if r["kind"] == "first" and "seconds" in r:
            found.setdefault(r["system"], {}).setdefault(r["what"], []).append(r["seconds"])
    kinds = ("cold", "cached", "heyoka, single", "heyoka, batch")
    return Table(
        "general-first",
        "CPU seconds until the first step, imports apart: ours from energies to a step, with an empty and "
        "a filled cache of compiled code; heyoka's compiling at tolerance 1e-15",
        ("system", "lag_envs, cold", "lag_envs, cached", "heyoka", "heyoka, batch"),
        [(name, *(median(of[k]) if k in of else None for k in kinds)) for name, of in found.items()],
    )


def _energy(rows: Sequence[Row]) -> Table:
    return Table(
        "general-energy",
        "Energy of undamped double pendulums: how far from where it was at most, relative to its height "
        "above the lowest; ours over the whole time, the others at its end",
        ("method", "seconds", "drift"),
        [
            (r["method"], r["seconds"], "lost" if r["drift"] is None else r["drift"])
            for r in rows
            if r["kind"] == "energy"
        ],
    )


def _all(rows: Sequence[Row]) -> Table:
    names = ("system", "mode", "family", "method", "setting", "error", "median", "ns", "clock", "problem")
    return Table(
        "general-points",
        "All points",
        names,
        [[r.get(name) for name in names] for r in rows if r["kind"] == "point"],
    )


#: Colours after Okabe and Ito.
STYLES = {
    "lag_envs": ("#003B5C", "*"),
    "heyoka": ("#000000", "X"),
    "MuJoCo": ("#B8860B", "D"),
    "Pinocchio": ("#7F3C8D", "o"),
    "RK4, compiled": ("#E69F00", "D"),
    "DOP853, compiled": ("#D55E00", "s"),
    "Radau IIA, compiled": ("#CC79A7", "^"),
}


def draw(name: str, rows: Sequence[Row]) -> Figure:
    """Draw worst errors against times: of each column the settings that none of its others beats."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    for ax, (mode, words) in zip(figure.subplots(1, 2, sharey=True), MODES.items(), strict=True):
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_ylim(1e-16, 1.0)
        ax.grid(True, which="major", color="0.9", linewidth=0.6)
        ax.set_title(f"{name}, {words}", fontsize=10)
        ax.set_xlabel("time of a control step [ns]")
        for title, (colour, marker) in STYLES.items():
            some = [
                (r["ns"], r["error"])
                for r in rows
                if column(r) == title
                and (r["mode"] == mode or not r["batched"])
                and r.get("error") is not None
            ]
            front = sorted(p for p in some if not any(o[0] < p[0] and o[1] <= p[1] for o in some))
            if front:
                x, y = zip(*front, strict=True)
                ax.plot(
                    x,
                    np.maximum(y, 1e-16),
                    color=colour,
                    marker=marker,
                    linewidth=1.0,
                    markersize=4,
                    label=title,
                )
    figure.axes[0].set_ylabel("worst error, relative")
    handles = {
        text: line for ax in figure.axes for line, text in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(handles.values()), list(handles), loc="outside lower center", ncols=7, fontsize=8, frameon=False
    )
    return figure
