"""The state and terms that each environment carries, those that it leaves out, and the time saved."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from lag_envs import TASKS
from lag_envs.envs.program import Program
from lag_envs.report.cases import Case
from lag_envs.report.content import Claim, Content, ReportFigure, Table
from lag_envs.report.integrators import plain_series
from lag_envs.report.runner import JobResult, ReportJob, Row
from lag_envs.report.stepped import Stepped
from lag_envs.report.timing import FlowSteps, at_once, interleaved
from lag_envs.scenes import CylinderInCylinder, Incline, PivotedBar
from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping.compiling import absent_from
from lag_envs.stepping.flows import pendulum_flow
from lag_envs.tasks.base import Task

BATCH = 1024


class ScenePair(NamedTuple):
    """A scene with and without a feature, and a control step of both from the same state."""

    left_out: str
    without: Scene | Stepped
    having: Scene | Stepped
    dt: float = 0.02

    def stepped(self) -> tuple[Stepped, Stepped]:
        """Return both with their flows."""
        without, having = (
            given if isinstance(given, Stepped) else Stepped(given, dt=self.dt)
            for given in (self.without, self.having)
        )
        return without, having


_FREE = PivotedBar(track=None, damping=0.001)
PAIRS = (
    ScenePair("drag of the bar", PivotedBar(track=None), _FREE),
    ScenePair("support in the bar's state (track=None)", _FREE, PivotedBar(damping=0.001)),
    ScenePair("gravity of the bar", PivotedBar(track=None, damping=0.001, gravity=0.0), _FREE),
    ScenePair("orders 15 to 20 of the bar's series", _FREE, Stepped(_FREE, pendulum_flow(20))),
    ScenePair("test of the certificate (never left out)", Stepped(_FREE, plain_series(14)), _FREE),
    ScenePair("drag in a turning shell", CylinderInCylinder(), CylinderInCylinder(damping=0.024), 0.05),
    ScenePair(
        "turning of the shell", CylinderInCylinder(control="damping"), CylinderInCylinder(damping=0.024), 0.05
    ),
    ScenePair("drag on a slope", Incline(control="tilt"), Incline(control="tilt", damping=0.03), 0.05),
    ScenePair(
        "drag on a moving slope",
        Incline(control="tilt_rate"),
        Incline(control="tilt_rate", damping=0.03),
        0.05,
    ),
    ScenePair(
        "motion of the slope: closed form for a series",
        Incline(damping=0.03, tilt=0.1),
        Incline(control="tilt_rate", damping=0.03),
        0.05,
    ),
)
QUICK_PAIRS = 2


def jobs(quick: bool) -> list[ReportJob]:
    """Return the jobs: one that examines the compiled code of every id, one that measures times."""
    count = QUICK_PAIRS if quick else len(PAIRS)
    return [
        ReportJob(terms, "terms"),
        ReportJob(savings, "savings", {"count": count, "rounds": 5 if quick else 15}, alone=True),
    ]


# --- what is measured ---


def terms() -> Iterator[Row]:
    """Yield the contents of the compiled step of every environment with a dedicated flow."""
    for id, task in TASKS.items():
        if form_of(task().scene) is not None:
            yield {"kind": "terms", "id": id} | carried_numbers(task())


def carried_numbers(task: Task) -> Row:
    """Return state, terms, stages and constants of a task's compiled step, and which of them are unused."""
    scene = task.scene
    numbers = task.formulas.constants()
    absent = absent_from(numbers)
    program = Program(task, absent)
    stepped = Stepped(scene, dt=task.dt)
    code = stepped.code()
    lines = [*program.control, *program.fast, *program.outcome, *program.last, *program.kick, *program.move]
    lines += program.observe
    ends = [*program.moved, "r", "over", "within", *program.o]
    needed = live(lines, ends) | live(program.sample, [f"s{i}" for i in range(program.n_state)])
    constants = (f"k_{name}" for name in program.constants if name != "limit")
    given = [*program.y, *program.g, *program.a, *constants]
    return {
        "scene": type(scene).__name__,
        "state": list(scene.state_names) + (["cos", "sin"] if stepped.form.angle is not None else []),
        "terms": [name for name, there in code.terms.items() if there],
        "left_out": [name for name, there in code.terms.items() if not there],
        "stages": stepped.flow.method,
        "constants": program.constants,
        "zero": sorted(absent),
        "operations": code.operations,
        "unused": [name.removeprefix("k_") for name in given if name not in needed],
        "idle": [name for line in lines for name in assigned(line) if name not in needed],
    }


def assigned(line: str) -> list[str]:
    """Return the names that a line of code assigns.

    Examples
    --------
    >>> assigned("a, b = block_1(c)"), assigned("y0 += dt")
    (['a', 'b'], ['y0'])
    """
    head = re.match(r"([\w, ]+?) *[-+*/]?= ", line)
    return re.findall(r"[A-Za-z_]\w*", head.group(1)) if head else []


def live(lines: Sequence[str], results: Iterable[str]) -> set[str]:
    """Return the names on which the results depend, in straight-line code.

    Within a recorded block every input is used by construction, so only the calls have to be checked.

    Examples
    --------
    >>> sorted(live(["a = f(x)", "b = g(y)", "c = h(a)"], ["c"]))
    ['a', 'c', 'f', 'h', 'x']
    """
    needed = set(results)
    for line in reversed(lines):
        if needed & set(assigned(line)) or not assigned(line):
            needed |= set(re.findall(r"[A-Za-z_]\w*", line.partition("=")[2] if assigned(line) else line))
    return needed


def savings(count: int, rounds: int) -> Iterator[Row]:
    """Yield operations and times of a step with and without a feature, in a batch, timed in turn."""
    samples = []
    for pair in PAIRS[:count]:
        for stepped in pair.stepped():
            scene = stepped.scene
            state = tuple(0.1 * (i + 1) for i in range(len(scene.state_names)))
            cases = [Case(scene, state, 0.1)] * BATCH
            samples.append(at_once(FlowSteps(scene, stepped.flow), cases, 8, pair.dt))
    times = interleaved(samples, rounds)
    for i, pair in enumerate(PAIRS[:count]):
        operations = [stepped.code().operations for stepped in pair.stepped()]
        yield {
            "kind": "savings", "left_out": pair.left_out, "operations": operations,
            "ns": times[2 * i : 2 * i + 2],
        }  # fmt: skip


# --- what is shown ---

TEXT = (
    "A constant that is zero costs no operation, and the state has no entries that an environment "
    "does not need. Terms are those of θ'' = -α sinθ - β cosθ - γθ' + δ + ramp·t for bar and shell, of "
    "x'' = acceleration - damping_rate·x' for a fixed slope, and of the linear equation of a turning slope.",
    "Unused inputs of an id's compiled step are those on which no result depends. To find them, the step's "
    "lines are followed backwards from the next state, reward, ending and observation to constants, state, "
    "target and action. Idle operations are those whose result is not used.",
    "Savings: a control step of 1,024 states at once, dynamics only, compiled without and with a feature. "
    "Both versions are timed in turn; the numbers are medians.",
)


def content(rows: list[Row], problems: list[JobResult]) -> Content:
    """Return the section's content."""
    found = [row for row in rows if row["kind"] == "terms"]
    saved = [row for row in rows if row["kind"] == "savings"]
    carried = _terms(found)
    return Content(
        title="What each environment leaves out",
        text=TEXT,
        tables=[carried, _savings(saved)],
        pictures=[
            ReportFigure(
                "leave-out",
                "Time of a control step without a feature, and the time that the feature would add. "
                "Batches of 1,024.",
                lambda: _bars(saved),
            )
        ]
        if saved
        else [],
        claims=_claims(found, saved),
        summary=_summary(carried),
    )


def _listed(name: str) -> Callable[[Row], str]:
    """Return a function that formats a row's entry of this name, a list."""
    return lambda row: ", ".join(row[name]) or "none"


def _terms(rows: list[Row]) -> Table:
    return Table.of(
        "leave-out-terms",
        "The features that each id has and leaves out; operations are those of one step of the dynamics.",
        {
            "id": "id",
            "state": _listed("state"),
            "terms": _listed("terms"),
            "left out": _listed("left_out"),
            "a step is": "stages",
            "constants": _listed("constants"),
            "zero": _listed("zero"),
            "operations": "operations",
            "unused": _listed("unused"),
            "idle": _listed("idle"),
        },
        rows,
    )


def _savings(rows: list[Row]) -> Table:
    return Table.of(
        "leave-out-savings",
        "The time that leaving a feature out saves.",
        {
            "left out": "left_out",
            "operations without": lambda row: row["operations"][0],
            "with": lambda row: row["operations"][1],
            "ns without": lambda row: row["ns"][0],
            "ns with": lambda row: row["ns"][1],
            "saved [ns]": lambda row: row["ns"][1] - row["ns"][0],
            "saved [%]": lambda row: 100.0 * (1.0 - row["ns"][0] / row["ns"][1]),
        },
        rows,
    )


def _summary(carried: Table) -> Table | None:
    """Return some columns of the terms."""
    columns = ("id", "state", "terms", "left out", "operations", "unused")
    caption = "The parts of each environment's step:"
    return carried.part("leave_out", caption, columns) if carried.rows else None


def _claims(rows: list[Row], saved: list[Row]) -> list[Claim]:
    unused = [
        f"{row['id']}: {', '.join(row['unused'] + row['idle'])}"
        for row in rows
        if row["unused"] + row["idle"]
    ]
    more = [row["left_out"] for row in saved if row["operations"][0] >= row["operations"][1]]
    return [
        Claim(
            "Nothing that a step carries or computes is unused.",
            not unused if rows else None,
            "; ".join(unused) or f"{len(rows)} environments",
        ),
        Claim(
            "Features that are left out cost no operation.",
            not more if saved else None,
            "; ".join(more) or f"{len(saved)} pairs",
        ),
    ]


def _bars(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(7.5, 0.6 + 0.34 * len(rows)), layout="constrained")
    axis = figure.subplots()
    place = np.arange(len(rows))[::-1]
    without, having = np.array([row["ns"] for row in rows]).T
    axis.barh(place, without, color="#0072b2", label="without")
    axis.barh(place, np.maximum(having - without, 0.0), left=without, color="#e69f00", label="having it adds")
    axis.set_yticks(place, [row["left_out"] for row in rows])
    axis.set_xlabel("ns per control step")
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=8)
    return figure
