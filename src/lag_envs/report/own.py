"""The report on a user's own file: errors against time, the certificate, stability, scene by scene.

Subjects are the scenes of the file's tasks, with the tasks' parameters, starts and controls, and scenes that
no task uses, if their defaults suffice to make them. Loading the file runs its code, in each process that
measures.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs import own_files
from lag_envs.envs.single import LagrangianEnv
from lag_envs.errors import UserError
from lag_envs.report import general, general_results
from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.motions import Array, SceneProblems
from lag_envs.report.oracle import Unresolved
from lag_envs.report.peers import Heyoka
from lag_envs.report.points import MODES
from lag_envs.report.reference import exact_ends
from lag_envs.report.runner import JobResult, ReportJob, Row
from lag_envs.scenes.base import Scene
from lag_envs.scenes.checks import StepRefused
from lag_envs.scenes.derivation import order_of

#: Number of states with exact ends, and of states for the certificate; the same for a quick report.
MEMBERS, MANY = 50, 1000
FEW, SOME = 6, 100
TOLERANCES: Sequence[float] = (1e-3, 1e-6, 1e-9, 1e-12, 1e-14)
ORDERS: Sequence[int] = (8, 12, 16, 20, 24)
#: Factors for each parameter, one parameter at a time; the last number is a factor for states.
FACTORS, WILD = (1e-4, 1e-2, 1e2, 1e4), 10.0
#: Allowed excess over a bound by rounding, relative to max(1, |entry|).
ROUNDING = 1e-12
#: Allowed imbalance of energy, relative to energy and work.
BALANCE = 1e-9
#: How many times a step is halved to integrate the work.
DEEPEST = 12


class Subject(NamedTuple):
    """A scene, the start of its motions, and its controls."""

    name: str
    scene: Scene
    dt: float
    boxes: Sequence[tuple[float, float]]  #: centre and half width of each state entry
    controls: Sequence[tuple[float, float]]

    task: type[Any] | None = None

    def draw(self, count: int, seed: int = 0) -> tuple[Array, Array]:
        """Return states of random episodes, or random states if there is no task, and random controls."""
        rng = np.random.default_rng(seed)
        low, high = (np.array([box[i] for box in self.controls]) for i in (0, 1))
        controls = rng.uniform(low, high, (count, len(self.controls)))
        if self.task is not None:
            return _met(self.task, rng.integers(0, max(1, round(1.0 / self.dt)) + 1, count), seed), controls
        centre, half = (np.array([box[i] for box in self.boxes]) for i in (0, 1))
        return centre + half * rng.uniform(-1.0, 1.0, (count, len(centre))), controls


def _met(task: type[Any], lengths: NDArray[np.int64], seed: int) -> Array:
    """Return the states of episodes under random actions, after this many steps or before their end."""
    env = LagrangianEnv(task)  # type: ignore[arg-type]
    env.action_space.seed(seed)
    states = []
    for i, length in enumerate(lengths):
        env.reset(seed=seed if i == 0 else None)
        state = env.state
        for _ in range(length):
            try:
                ended = any(env.step(env.action_space.sample())[2:4])
            except StepRefused:
                break
            if ended:
                break
            state = env.state
        states.append(state)
    return np.array(states)


def subjects(name: str, tell: Callable[[str], object] = str) -> list[Subject]:
    """Return the subjects of ``FILE`` or ``FILE:Class``: scenes of tasks, then scenes that no task uses.

    Parameters
    ----------
    name : str
        The file, optionally with a class.
    tell : callable, optional
        Called with a message about each scene that is left out, and why.

    Raises
    ------
    UserError
        If there are no subjects.
    """
    path, kind = own_files.split_path(name)
    found, problems = [], []
    tasks, scenes = own_files.tasks(path), own_files.scenes(path)
    if kind and kind not in (*tasks, *scenes):
        own_files.chosen_tasks(name)  # raises
    used = {task.scene for task in tasks.values()}
    for label, task in tasks.items():
        if kind in ("", label):
            found.append(_of_task(label, own_files.made_with_defaults(task, path)))
    for label, scene in scenes.items():
        if kind == label or (not kind and scene not in used):
            try:
                found.append(_of_scene(label, scene()))
            except (TypeError, ValueError) as error:
                problems.append(f"{label}: {error}")
    if not found:
        why = "; ".join(problems) or "it defines no scene and no task"
        raise UserError(f"{path}: nothing to measure: {why}; {own_files.GUIDE}")
    for problem in problems:
        tell(f"{path}: left out: {problem}")
    return found


def _of_task(label: str, task: Any) -> Subject:
    constants, scene = task.formulas.constants(), task.scene
    ranges = {a.control: (a.low, a.high) for a in task.formulas.acting}
    return Subject(
        f"{type(scene).__name__} of {label}",
        scene,
        task.dt,
        [(constants[f"centre{i}"], constants[f"half{i}"]) for i in range(len(scene.state_names))],
        [ranges.get(name, (0.0, 0.0)) for name in scene.control_names],
        type(task),
    )


def _of_scene(label: str, scene: Scene) -> Subject:
    """Return a scene without a task as a subject: ±1, or ±π for an angle, and twice that for speeds."""
    boxes = [
        (0.0, (math.pi if "rad" in unit else 1.0) * (2.0 if unit.endswith("/s") else 1.0))
        for unit in scene.state_units
    ]
    return Subject(label, scene, general_results.DT, boxes, [(-1.0, 1.0)] * len(scene.control_names))


def subject(file: str, name: str) -> Subject:
    """Return a file's subject by its name, which is all that a measuring process is given."""
    return next(s for s in subjects(file) if s.name == name)


# --- jobs ---


def jobs(quick: bool, file: str) -> list[ReportJob]:
    """Return the jobs: errors and certificate, stability, then everything that is timed."""
    path, found = Path(own_files.split_path(file)[0]), subjects(file)
    # Rows from another version of the file, or of a scene that it imports, are not reused.
    motions = repr([(s.scene, s.scene.mechanics.key) for s in found])
    about = {
        "file": str(path.resolve()) + file[len(str(path)) :],
        "digest": hashlib.sha256(path.read_bytes() + motions.encode()).hexdigest()[:16],
        "quick": quick,
    }
    kinds = {"steps": shipped_steps, "stability": stability, "points": step_points}
    return [
        ReportJob(function, f"{what}: {s.name}", about | {"name": s.name}, 900.0, alone=what == "points")
        for what, function in kinds.items()
        for s in found
    ]


def shipped_steps(file: str, digest: str, quick: bool, name: str) -> Iterator[Row]:
    """Yield errors and bounds of steps as shipped, and the share that is certified as a whole."""
    s = subject(file, name)
    order = order_of(s.scene, s.dt)
    starts, controls = s.draw(SOME if quick else MANY, seed=1)
    attempts, bounds = general.attempts_and_bounds(s.scene, starts, controls, s.dt, order)
    kept = bounds[np.array(attempts) > 0]
    yield {
        "kind": "certificate", "subject": name, "dt": s.dt, "order": order, "states": len(starts),
        **general.shares(attempts), "bound": float(kept.max()) if len(kept) else None,
    }  # fmt: skip
    starts, controls, truth = exact_steps(s, quick)
    attempts, bounds = general.attempts_and_bounds(s.scene, starts, controls, s.dt, order)
    for j, taken in enumerate(attempts):
        if taken <= 0:
            continue
        end = s.scene.simulate(starts[j], controls[j][None] if len(controls[j]) else 1, s.dt)[-1]
        high, low = truth[0][j], truth[1][j]
        far = np.abs((end - high) - low)
        row = {"kind": "step", "subject": name, "attempts": taken, "bound": float(bounds[j])}
        scale = np.maximum(1.0, np.abs(high))
        yield row | {"error": float((far / scale).max()), "beyond": float(((far - bounds[j]) / scale).max())}


def exact_steps(s: Subject, quick: bool) -> tuple[Array, Array, tuple[Array, Array]]:
    """Return states, controls and the exact ends of their steps; singular cases are left out."""
    starts, controls = s.draw(FEW if quick else MEMBERS)
    kept, high, low = [], [], []
    for j in range(len(starts)):
        try:
            a, b = exact_ends(s.scene, starts[j : j + 1], controls[j : j + 1], s.dt)
        except Unresolved:
            continue
        kept.append(j)
        high.append(a[0])
        low.append(b[0])
    return starts[kept], controls[kept], (np.array(high), np.array(low))


def step_points(file: str, digest: str, quick: bool, name: str) -> Iterator[Row]:
    """Yield errors and times of lag_envs and the usual integrators."""
    s = subject(file, name)
    starts, controls, truth = exact_steps(s, quick)
    if not len(starts):
        return
    copies = max(1, 1024 // len(starts))
    problems = SceneProblems(s.scene, np.tile(starts, (copies, 1)), np.tile(controls, (copies, 1)))
    some: slice = slice(-1, None, -3) if quick else slice(None)
    compiled_here = general.compiled_rivals(list(product(TOLERANCES[some], ORDERS[some])), some)
    others = [Heyoka("Taylor", tolerance) for tolerance in general.HEYOKA[some]]
    for mode in MODES:
        for rivals in (compiled_here, others):
            yield from general.timed_rivals(name, problems, truth, rivals, mode, 3 if quick else 7, s.dt)


def extreme_variants(s: Subject) -> Iterator[tuple[str, Scene, float]]:
    """Yield scenes with one extreme parameter each, if its range allows it, and a factor for the state."""
    yield "as it is", s.scene, 1.0
    yield f"states × {WILD:g}", s.scene, WILD
    for field in dataclasses.fields(s.scene):  # type: ignore[arg-type]
        value = getattr(s.scene, field.name)
        if "unit" not in field.metadata or not value or not math.isfinite(value):
            continue
        for factor in FACTORS:
            try:
                scene = dataclasses.replace(s.scene, **{field.name: factor * value})  # type: ignore[type-var]
            except (TypeError, ValueError):
                continue  # not in the parameter's range
            yield f"{field.name} × {factor:g}", scene, 1.0


def stability(file: str, digest: str, quick: bool, name: str) -> Iterator[Row]:
    """Yield refusals and the energy balance of steps with extreme parameters and states."""
    s = subject(file, name)
    count = 2 if quick else 20
    starts, controls = s.draw(count, seed=2)
    for label, scene, factor in extreme_variants(s):
        refused, worst = 0, 0.0
        for state, held in zip(starts, controls, strict=True):
            try:
                found = step_imbalance(scene, factor * state, held, s.dt)
            except StepRefused:
                refused += 1
                continue
            worst = max(worst, found if math.isfinite(found) else math.inf)
        about = {"kind": "stability", "subject": name, "case": label, "states": count, "refused": refused}
        yield about | {"balance": worst if math.isfinite(worst) else None}


def step_imbalance(scene: Scene, start: Array, held: Array, dt: float) -> float:
    """Return the imbalance between a step's change of energy and its work, relative to energy and work.

    The work is a quadrature along the motion. If the quadrature is too coarse, the time is halved.
    """
    control: Any = held if len(held) else 0.0
    total = size = 0.0
    todo = [(start, dt, 0)]
    while todo:
        state, span, depth = todo.pop()
        part, energy = scene.energy_balance(state, control, span), scene.energy(state, control)
        here = sum(abs(float(energy[k])) for k in ("kinetic", "potential")) + abs(part["work"]) + part["loss"]
        if depth < DEEPEST and not abs(part["residual"]) <= 1e-3 * BALANCE * here:
            middle = scene.simulate(state, held[None] if len(held) else 1, 0.5 * span)[-1]
            todo += [(middle, 0.5 * span, depth + 1), (state, 0.5 * span, depth + 1)]
            continue
        total, size = total + part["residual"], max(size, here)
    return abs(total) / size if size else 0.0


# --- results ---


def content(rows: Sequence[Row], problems: Sequence[JobResult]) -> Content:
    """Return the content."""
    names = list(dict.fromkeys(str(r.get("subject", r.get("system"))) for r in rows))
    found, factors = general_results.best_settings(rows), ", ".join(f"{f:g}" for f in FACTORS)
    pictures = [
        ReportFigure(
            f"own-{general_results.file_part(name)}",
            f"Error against time, {name}. One control step from {MEMBERS} states at most, {FEW} in a quick "
            "report: worst error, and CPU time of a state's step; reference: Taylor series of SymPy's "
            "equations in balls.",
            partial(general_results.draw_times, name, some),
        )
        for name in names
        if (some := [r for r in rows if r["kind"] == "point" and r["system"] == name and "ns" in r])
    ]
    missing = general_results.missing(rows)
    times = [general_results.best_times("own", found, mode) for mode in MODES]
    return Content(
        "Your own scenes",
        [
            "Steps of one control interval, from states that random actions reach within a second of the "
            "tasks' episodes; for a scene without a task, from random states within a unit or half a turn. "
            "Errors are against Taylor series of Lagrange's equations, which SymPy derives from the "
            "energies, in python-flint's ball arithmetic; relative to max(1, |entry|). Times are medians "
            "of the processor's time, samples taken in turn.",
            "The certificate bounds the truncation error of the step's series; rounding comes on top. "
            f"Stability is tested with each parameter multiplied by {factors}, where its range allows it: a "
            "step that cannot be certified is refused, and the change of energy has to equal the work done.",
            *([f"Not included: {missing}."] if missing else []),
        ],
        [t for t in (_steps(rows), *times, _stability(rows)) if t.rows],
        pictures,
        _claims(rows) if rows else [],
        details=[general_results.all_points("own-points", rows)],
    )


def _steps(rows: Sequence[Row]) -> Table:
    errors: dict[str, list[float]] = {}
    for r in rows:
        if r["kind"] == "step":
            errors.setdefault(r["subject"], []).append(r["error"])
    return Table.of(
        "own-steps",
        "Steps as shipped: the share certified in one attempt, attempts per step, the largest bound "
        "in units of the state, and the worst error where the exact end was computed",
        {
            "scene": "subject",
            "step [s]": "dt",
            "order": "order",
            "certified as a whole": lambda r: f"{100.0 * r['share']:.1f} % of {r['states']:,}",
            "attempts": "attempts",
            "refused": "refused",
            "largest bound": "bound",
            "worst error": lambda r: max(errors.get(r["subject"], ()), default=None),
            "of": lambda r: len(errors.get(r["subject"], ())),
        },
        [r for r in rows if r["kind"] == "certificate"],
    )


def _stability(rows: Sequence[Row]) -> Table:
    return Table.of(
        "own-stability",
        "Extreme parameters and states: refused steps, and the largest imbalance of energy, relative to "
        "energy and work",
        {
            "scene": "subject",
            "case": "case",
            "steps": "states",
            "refused": "refused",
            "balance": lambda r: "no number" if r["balance"] is None else r["balance"],
        },
        [r for r in rows if r["kind"] == "stability"],
    )


def _claims(rows: Sequence[Row]) -> list[Claim]:
    exact = [r for r in rows if r["kind"] == "step"]
    beyond = max((r["beyond"] for r in exact), default=0.0)
    shares = [r for r in rows if r["kind"] == "certificate"]
    balances = [r for r in rows if r["kind"] == "stability" and r["refused"] < r["states"]]
    worst = max((math.inf if r["balance"] is None else r["balance"] for r in balances), default=0.0)
    refused = sum(r["refused"] for r in shares)
    return [
        Claim(
            f"No error exceeds its bound by more than rounding ({ROUNDING:g}).",
            beyond <= ROUNDING if exact else None,
            f"{beyond:.1e} at most, {len(exact)} steps" if exact else "",
        ),
        Claim(
            "No step is refused from the states that random actions reach.",
            refused == 0 if shares else None,
            f"{refused} of {sum(r['states'] for r in shares):,}" if shares else "",
        ),
        Claim(
            f"The change of energy equals the work done, to {BALANCE:g}, at extreme parameters too.",
            worst <= BALANCE if balances else None,
            f"{worst:.1e} at most in {len(balances)} cases" if balances else "",
        ),
    ]
