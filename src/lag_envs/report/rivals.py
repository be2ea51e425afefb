"""The methods to compare: lag_envs, and rivals of any kind behind one interface, each in its fastest form.

A `Rival` is built for some `Problems` and a time over which their controls are held. It runs, and is timed,
in one call for all problems over the whole time: in compiled loops, on blocks of states at once, and with its
own choice of steps, whichever of these it offers. Errors are those of the same calls that are timed.

`ShippedStepping` and `CompiledMethod` are compiled by our machinery; other libraries are in `peers`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache
from typing import ClassVar

import numpy as np

from lag_envs.report.arithmetic import Arithmetic
from lag_envs.report.cases import Case
from lag_envs.report.equations import Equation, Problems
from lag_envs.report.integrators import METHODS
from lag_envs.report.timing import BLOCK, FlowSteps, Sample, at_once, blocks, one_by_one, unblocked
from lag_envs.scenes.base import Scene
from lag_envs.stepping.compiling import compile_lines, record_block
from lag_envs.stepping.elementary import ElementaryTrace


class Rival(ABC):
    """A method at one setting.

    Parameters
    ----------
    method : str
        One of its methods.
    setting : float
        A tolerance or, for methods that are `fixed`, the substeps per control step; 1/4 is one step for four
        control steps.
    """

    #: The origin of the method: a package's name, "compiled", or "lag_envs".
    family: ClassVar[str]
    #: Whether all steps have the same length, so that time is proportional to their number for any horizon.
    fixed = False
    #: Whether the method can take many states at once.
    batched = True
    #: Whether the states of a batch share their steps, so that each one's error depends on the others.
    shared = False
    #: Whether one call can go through many controls.
    changing = False

    def __init__(self, method: str, setting: float) -> None:
        self.method, self.setting = method, setting

    @abstractmethod
    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile everything that can be compiled and return the call, with its end states.

        Parameters
        ----------
        problems : Problems
            The problems to solve, in one call.
        dt : float
            The control step [s].
        steps : int
            For how many control steps each control is held.
        together : bool
            Whether to take all states at once, otherwise one after the other.
        changes : int, default 1
            For timing single steps, the number of steps that follow one another in the call. In a call state
            by state, each problem continues with the next problem's control; in a batch, with its own
            control. The end states then have no meaning.

        Raises
        ------
        ImportError
            If the library is missing.
        ValueError
            For an equation that the method cannot solve.
        """

    def substeps(self, steps: int) -> int:
        """Return the number of steps over some control steps, for a fixed method."""
        return max(1, round(self.setting * steps))


class ShippedStepping(Rival):
    """The shipped stepping: a scene's own flow, and no other order or tolerance.

    The setting is the number of steps per control step, because users change the accuracy by another `dt`.
    """

    family = "lag_envs"
    METHOD = "lag_envs"  #: control step by control step, like an environment
    ONE_CALL = "lag_envs, one call"  #: the whole time as one step, which `simulate` divides by the bound

    changing = True  # a trajectory has a control for each step

    def __init__(self, setting: float = 1, one_call: bool = False) -> None:
        super().__init__(self.ONE_CALL if one_call else self.METHOD, setting)
        self.fixed = not one_call

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile the scene's own step; scenes with other parameters are separate batches."""
        cases = problems.cases
        count = self.substeps(steps) if self.fixed else 1
        length = dt * steps / count
        kernels = FlowSteps(cases[0].scene, dt=length)
        alike: dict[Scene, list[Case]] = {}
        for case in cases:
            alike.setdefault(case.scene, []).append(case)
        parts = []
        for some in alike.values():
            if together:
                parts.append(at_once(kernels, some, count * changes, length))
            else:
                given = np.array([case.control for case in some])
                turns = np.arange(len(some))[:, None] + np.arange(changes)
                controls = np.repeat(given[turns % len(some)], count, axis=1)
                parts.append(one_by_one(kernels, some, controls, length))

        def run() -> None:
            if any([part.run() for part in parts]):
                raise ArithmeticError("a step was refused")

        def prepare() -> None:
            for part in parts:
                part.prepare()

        return Sample(
            run, len(cases) * steps * changes, prepare, lambda: np.concatenate([p.ends() for p in parts])
        )


class CompiledMethod(Rival):
    """An integrator of `METHODS`, compiled like lag_envs: with the same recorder, compiler and vector width.

    Coefficients are precomputed, so that only the method is timed. Single states are stepped in one compiled
    loop over steps and trajectories, batches in one compiled loop over blocks of states.
    """

    family = "compiled"
    CARRIED = ", carried"  #: suffix of a method that carries cosine and sine along

    fixed = changing = True

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile the loop."""
        name, carried = self.method.removesuffix(self.CARRIED), self.method.endswith(self.CARRIED)
        equation, n, count = problems.equation, self.substeps(steps), len(problems)
        h, size = dt * steps / n, problems.equation.lifted
        if together:
            loop = _batch(equation, name, carried)
            start = blocks(np.concatenate([problems.y, problems.p]), BLOCK)
            rows = start.copy()
            flat = rows.reshape(-1)
            return Sample(
                lambda: loop(flat, len(rows), n * changes, h),
                count * steps * changes,
                lambda: np.copyto(rows, start),
                lambda: problems.states(unblocked(rows, count)[:size], dt * steps),
            )
        loop = _alone(equation, name, carried)
        begin, p = np.ascontiguousarray(problems.y.T), np.ascontiguousarray(problems.p.T)
        y = begin.copy()
        return Sample(
            lambda: loop(y, p, changes, n, h),
            count * steps * changes,
            lambda: np.copyto(y, begin),
            lambda: problems.states(y.T, dt * steps),
        )

    @classmethod
    def methods(cls, equation: Equation) -> list[str]:
        """Return the names of all methods and forms for an equation."""
        forms = ("", cls.CARRIED) if equation.lifted > equation.size else ("",)
        return [name + form for name in METHODS for form in forms]


def _names(equation: Equation) -> tuple[list[str], list[str]]:
    return [f"y{i}" for i in range(equation.lifted)], [f"p{i}" for i in range(equation.parameters)]


@cache
def _step(equation: Equation, method: str, carried: bool) -> list[str]:
    """Return the lines that advance the unknowns y0, y1, ... by one step of length h from the time t."""
    y, p = _names(equation)
    trace = ElementaryTrace()
    given = trace.inputs(*y, *p, "t", "h")
    formula = equation.step_of(method, carried)
    moved = formula(given[: len(y)], given[len(y) : -2], *given[-2:], Arithmetic(trace))
    lines, ends = record_block(trace, {f"z{i}": z for i, z in enumerate(moved)})
    return [*lines, *(f"{name} = {z}" for name, z in zip(y, ends, strict=True))]


@cache
def _alone(equation: Equation, method: str, carried: bool) -> Callable:
    """Compile ``alone(y, p, changes, n, h)``: trajectories one after the other, n steps for each control."""
    y, p = _names(equation)
    lines = [
        "for j in range(y.shape[0]):",
        *(f"    {name} = y[j, {i}]" for i, name in enumerate(y)),
        "    for i in range(changes):",
        "        row = (j + i) % p.shape[0]",
        *(f"        {name} = p[row, {i}]" for i, name in enumerate(p)),
        "        for k in range(n):",
        "            t = k * h",
        *(f"            {line}" for line in _step(equation, method, carried)),
        *(f"    y[j, {i}] = {name}" for i, name in enumerate(y)),
    ]
    return compile_lines("alone", "y, p, changes, n, h", lines)


@cache
def _batch(equation: Equation, method: str, carried: bool) -> Callable:
    """Compile ``batch(rows, count, n, h)``: block by block, n steps of all states."""
    y, p = _names(equation)
    numbers = [*y, *p]
    at = {name: f"rows[base + np.uint64({BLOCK * j}) + i]" for j, name in enumerate(numbers)}
    lines = [
        "wide_vectors()",
        "for block in range(np.uint64(count)):",
        f"    base = block * np.uint64({BLOCK * len(numbers)})",
        "    for k in range(n):",
        "        t = k * h",
        f"        for i in range(np.uint64({BLOCK})):",
        *(f"            {name} = {at[name]}" for name in numbers),
        *(f"            {line}" for line in _step(equation, method, carried)),
        *(f"            {at[name]} = {name}" for name in y),
    ]
    return compile_lines("batch", "rows, count, n, h", lines)
