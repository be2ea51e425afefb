"""A control step by any flow, compiled for one trajectory and for a batch, and its time.

For our methods and others alike, the code is recorded in the same way, and compiled by the same compiler at
the same vector width, so that times compare methods.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cached_property
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.report.cases import Case
from lag_envs.report.stepped import Stepped
from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import motion_constants_of
from lag_envs.stepping.compiling import BLOCK, compile_lines
from lag_envs.stepping.flows import Flow

Array = NDArray[np.float64]


class FlowSteps:
    """The steps of a scene by one flow.

    Parameters
    ----------
    scene : Scene
        Its zero constants decide the code; problems on the same kind of scene share it.
    flow : Flow, optional
        The shipped one for steps of `dt`, or a comparison integrator.
    dt : float
        Control step [s].

    Examples
    --------
    >>> from lag_envs.report.cases import Case
    >>> from lag_envs.report.integrators import comparison
    >>> from lag_envs.scenes import PivotedBar
    >>> bar = PivotedBar(track=None)
    >>> rk4 = FlowSteps(bar, comparison("RK4", Stepped(bar).flow))
    >>> rk4.end(Case(bar, (2.0, 0.0), 0.0), 0.005, 4).round(6).tolist()
    [1.995538, -0.446313]
    >>> case = Case(bar, (3.0, 0.0), 1.0)
    >>> end = bar.simulate(case.state, [case.control] * 50, 0.02)[-1]
    >>> FlowSteps(bar).end(case, 0.02, 50).tolist() == end.tolist()
    True
    """

    def __init__(self, scene: Scene, flow: Flow | None = None, dt: float = 0.02) -> None:
        self.stepped = Stepped(scene, flow, dt)
        self._code = self.stepped.code()
        self._names = [name.removeprefix("k_") for name in self._code.constants]
        #: Whether every step is an ordinary one, as with the comparison integrators.
        self.plain = any(line == "within = True" for line in self._code.fast)

    def arguments(self, scene: Scene, dt: float) -> tuple[float, ...]:
        """Return the arguments of the compiled functions after states and controls."""
        constants = motion_constants_of(scene)
        present = [name for name, value in constants.items() if value != 0.0]
        if present != self._names:
            raise ValueError(f"compiled for the constants {self._names}, got {present}")
        return (dt, self.stepped.largest_majorant(dt), *(float(constants[name]) for name in present))

    def end(self, case: Case, dt: float, steps: int) -> Array:
        """Return the state after some steps with the control held; NaN if a step was refused."""
        trajectory = np.empty((steps + 1, len(case.state)))
        trajectory[0] = case.state
        refused = self._code.simulation(
            trajectory, np.full((steps, 1), case.control), *self.arguments(case.scene, dt)
        )
        return np.full(len(case.state), np.nan) if refused else trajectory[-1]

    @cached_property
    def several(self) -> Callable:
        """``several(trajectories, controls, dt, x, constants...)``: one trajectory after the other."""
        extra = "".join(f", {name}" for name in self._code.constants)
        lines = [
            "refused = 0",
            "for j in range(controls.shape[0]):",
            f"    refused += simulate(trajectories[j], controls[j], dt, x{extra})",
            "return refused",
        ]
        return compile_lines("several", f"trajectories, controls, dt, x{extra}", lines, self._code.simulation)

    @cached_property
    def batch(self) -> Callable:
        """``batch(rows, count, steps, dt, x, constants...)``: many states, block by block, each some steps.

        Returns the number of refused steps. `fill` and `states` define the layout.
        """
        code = self._code
        names = [*code.start, "u0", "ordinary"]

        def at(name: str) -> str:
            return f"rows[base + np.uint64({BLOCK * names.index(name)}) + i]"

        load = [f"{name} = {at(name)}" for name in [*code.start, "u0"]]
        fast = [*load, *code.fast]
        if self.plain:
            fast += [f"{at(y)} = {z}" for y, z in zip(code.start, code.end, strict=True)]
        else:
            fast += [f"{at(y)} = select(within, {z}, {y})" for y, z in zip(code.start, code.end, strict=True)]
            fast += [f"{at('ordinary')} = select(within, 1.0, 0.0)"]
        redo = [
            "slow = 0",
            "for i in lanes:",
            f"    slow += {at('ordinary')} == 0.0",
            "if slow > 0:",
            "    for i in lanes:",
            f"        if {at('ordinary')} == 0.0:",
            *(f"            {line}" for line in load),
            f"            {', '.join(code.start)}, status = advance({code.arguments})",
            "            refused += status < 0",
            *(f"            {at(y)} = {y}" for y in code.start),
        ]
        lines = [
            "wide_vectors()",
            "refused = 0",
            f"for block in range(np.uint64((count + {BLOCK - 1}) // {BLOCK})):",
            f"    base = block * np.uint64({BLOCK * len(names)})",
            "    for step in range(steps):",
            "        for i in lanes:",
            *(f"            {line}" for line in fast),
            *(() if self.plain else (f"        {line}" for line in redo)),
            "return refused",
        ]
        lines = [line.replace("lanes", f"range(np.uint64({BLOCK}))") for line in lines]
        arguments = ", ".join(["rows, count, steps, dt, x", *code.constants])
        return compile_lines("batch", arguments, lines, *(() if self.plain else (code.compile(),)))

    def fill(self, cases: Sequence[Case]) -> Array:
        """Return the rows of a batch."""
        y = self.stepped.form.lift(np.array([case.state for case in cases]))
        columns = np.array([*y, [case.control for case in cases], np.ones(len(cases))])
        return blocks(columns, BLOCK).ravel()

    def states(self, rows: Array, count: int) -> Array:
        """Return the states of a batch, one per line."""
        columns = unblocked(rows.reshape(-1, self.stepped.form.width + 2, BLOCK), count)
        return columns[: len(self.stepped.form.state_names)].T


def blocks(columns: Array, width: int) -> Array:
    """Return columns in blocks, shape (blocks, rows, width); the last is padded with the first column.

    Examples
    --------
    >>> blocks(np.array([[1.0, 2.0, 3.0]]), 2).tolist()
    [[[1.0, 2.0]], [[3.0, 1.0]]]
    """
    rows, count = columns.shape
    missing = -count % width
    filled = np.concatenate([columns, np.repeat(columns[:, :1], missing, axis=1)], axis=1)
    return np.ascontiguousarray(filled.reshape(rows, (count + missing) // width, width).transpose(1, 0, 2))


def unblocked(found: Array, count: int) -> Array:
    """Return the columns from the result of `blocks`.

    Examples
    --------
    >>> unblocked(blocks(np.array([[1.0, 2.0, 3.0]]), 2), 3).tolist()
    [[1.0, 2.0, 3.0]]
    """
    return found.transpose(1, 0, 2).reshape(found.shape[1], -1)[:, :count]


class Sample(NamedTuple):
    """A sample to time: `run` does this many control steps, after `prepare`, which is not timed."""

    run: Callable[[], object]
    steps: int
    prepare: Callable[[], object] = lambda: None
    ends: Callable[[], Array] = lambda: np.empty(0)  #: the states after `run`, one per line

    def end(self) -> Array:
        """Run once and return the states."""
        self.prepare()
        self.run()
        return self.ends()


def one_by_one(kernels: FlowSteps, cases: Sequence[Case], controls: Array, dt: float) -> Sample:
    """Return the sample of trajectories one after the other.

    Parameters
    ----------
    kernels : FlowSteps
        The compiled steps.
    cases : sequence of Case
        Starts, all on the same scene.
    controls : array, shape (len(cases), T)
        Controls of each trajectory.
    dt : float
        Control step [s].
    """
    several, arguments = kernels.several, kernels.arguments(cases[0].scene, dt)
    paths = np.full((len(cases), controls.shape[1] + 1, len(cases[0].state)), np.nan)
    paths[:, 0] = [case.state for case in cases]
    given = controls[..., None]
    return Sample(lambda: several(paths, given, *arguments), controls.size, ends=lambda: paths[:, -1])


def at_once(kernels: FlowSteps, cases: Sequence[Case], steps: int, dt: float) -> Sample:
    """Return the sample of a batch, each state with its control held for some steps."""
    batch, arguments = kernels.batch, kernels.arguments(cases[0].scene, dt)
    start = kernels.fill(cases)
    rows = start.copy()
    return Sample(
        lambda: batch(rows, len(cases), steps, *arguments),
        len(cases) * steps,
        lambda: np.copyto(rows, start),
        lambda: kernels.states(rows, len(cases)),
    )


def interleaved(
    samples: Sequence[Sample], rounds: int = 7, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Return each sample's time of a control step [ns], as the median over rounds.

    Every round runs each sample once, so that a slow phase of the machine affects all of them.

    Examples
    --------
    >>> ticks = iter(range(1000))
    >>> interleaved([Sample(lambda: None, 2)], clock=lambda: next(ticks))
    [500000000.0]
    """
    times: list[list[float]] = [[] for _ in samples]
    for sample in samples:
        sample.prepare()
        sample.run()  # compiles, and warms up
    for _ in range(rounds):
        for sample, found in zip(samples, times, strict=True):
            sample.prepare()
            before = clock()
            sample.run()
            found.append((clock() - before) / sample.steps)
    return [1e9 * median(found) for found in times]
