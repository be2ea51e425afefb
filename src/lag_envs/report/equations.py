"""Problems in the form that every rival takes: y' = rate(t, y, p) on generic numbers; arrays of starts.

`Problems` makes them from a scene's cases by the scene's own flow and coefficients, so that all rivals solve
the same equation. Any other equation can be used as well: a rival needs an `Equation`, the arrays, and a
function that converts its unknowns back to states.

Examples
--------
>>> from lag_envs.report.cases import ensemble
>>> problems = Problems(ensemble("PivotedBar", 3))
>>> problems.equation.size, problems.y.shape, problems.p.shape
(2, (4, 3), (3, 3))
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.report.cases import Case
from lag_envs.report.flow_equations import EQUATIONS
from lag_envs.report.integrators import METHODS, comparison, explicit
from lag_envs.report.stepped import Stepped
from lag_envs.scenes.derivation import motion_constants_of

Array = NDArray[np.float64]


class Equation(ABC):
    """A system of first order; equal systems share compiled code, so they are hashable."""

    size: int  #: number of unknowns
    lifted: int  #: the same, with cosines and sines as additional unknowns
    parameters: int  #: numbers that each problem has of its own, constant in time

    @abstractmethod
    def rate(self, t: Any, y: Sequence, p: Sequence, xp: Any) -> tuple:
        """Return y'; if `y` is lifted, no function of `xp` is called."""

    def step_of(self, method: str, carried: bool) -> Callable:
        """Return ``step(y, p, t, h, xp)`` of one of `METHODS`.

        The step takes and returns lifted unknowns; if cosines and sines are not carried, they are left
        unchanged.

        Raises
        ------
        ValueError
            For a method that needs more than the rate.
        """
        tableau = METHODS[method].tableau
        if tableau is None:
            raise ValueError(f"{method} needs more than the rate of {type(self).__name__}")

        def step(y: Sequence, p: Sequence, t: Any, h: Any, xp: Any) -> Sequence:
            moving = y if carried else y[: self.size]
            moved = explicit(tableau(), lambda s, y: self.rate(t + s, y, p, xp), moving, h)
            return [*moved, *y[len(moved) :]]

        return step


@dataclass(frozen=True)
class NormalFormEquation(Equation):
    """The equation of motion of one of the three flows, with only its nonzero terms.

    Parameters
    ----------
    kind : type
        The flow's coefficients. After them, `p` has the turning plane's angle at the start.
    present : tuple of bool
        Tells which coefficients are not zero.
    """

    kind: type
    present: tuple[bool, ...]

    size = 2

    @property
    def lifted(self) -> int:  # type: ignore[override]
        """Number of the flow's variables."""
        return EQUATIONS[self.kind].lifted

    @property
    def parameters(self) -> int:  # type: ignore[override]
        """Number of nonzero coefficients, plus the angle."""
        return sum(self.present) + EQUATIONS[self.kind].turns

    def coefficients(self, p: Sequence) -> Any:
        """Return the flow's coefficients; missing coefficients are a literal 0.0."""
        given = iter(p)
        return self.kind(*(next(given) if there else 0.0 for there in self.present))

    def rate(self, t: Any, y: Sequence, p: Sequence, xp: Any) -> tuple:
        """Return (q', v'), and the rates of cosine and sine if these are among the unknowns."""
        return EQUATIONS[self.kind].rate(self.coefficients(p), t, y, xp, p[-1])

    def step_of(self, method: str, carried: bool) -> Callable:
        """Return any of `METHODS`; all of them take the flow's variables."""
        equation = EQUATIONS[self.kind]
        step = comparison(method, equation.flow, carried).fast

        def move(y: Sequence, p: Sequence, t: Any, h: Any, xp: Any) -> Sequence:
            return step(y, equation.later(self.coefficients(p), t), h, xp)

        return move


class Problems:
    """Several cases on one kind of scene, as arrays with a column for each.

    Parameters
    ----------
    cases : sequence of Case
        The problems; each control is constant.
    """

    def __init__(self, cases: Sequence[Case]) -> None:
        self.cases = list(cases)
        stepped = Stepped(self.cases[0].scene)
        self._form, flow = stepped.form, stepped.flow
        constants = [motion_constants_of(case.scene) for case in self.cases]
        self._k = SimpleNamespace(**{name: np.array([k[name] for k in constants]) for name in constants[0]})
        self._u = [np.array([case.control for case in self.cases])]
        states = np.array([case.state for case in self.cases])
        self._lifted = self._form.lift(states)
        given = self._form.coefficients_at(self._lifted, self._u, self._k, np)
        coefficients = np.array([np.broadcast_to(x, len(self.cases)) for x in given])
        present = tuple(bool(row.any()) for row in coefficients)
        #: The equation to solve.
        self.equation: Equation = NormalFormEquation(flow.coefficients, present)
        rows = [row for row, there in zip(coefficients, present, strict=True) if there]
        if EQUATIONS[flow.coefficients].turns:
            assert self._form.angle is not None
            rows.append(states[:, self._form.angle])
        #: Parameters, shape (parameters, problems).
        self.p: Array = np.array(rows).reshape(len(rows), len(self.cases))
        self._variables = self._form.unpack(self._lifted, self._u, self._k)
        #: Starts, the unknowns first and then cosine and sine, shape (lifted, problems).
        self.y: Array = np.array(self._variables, dtype=np.float64)

    def __len__(self) -> int:
        return len(self.cases)

    def states(self, y: Array, span: float) -> Array:
        """Return the scene's states, one per line, from unknowns after the control was held for some time."""
        moved = [*y[:2], *self._variables[2:]]
        ends = self._form.pack(moved, self._lifted, self._u, span, self._k)
        return np.stack(ends[: len(self._form.state_names)], axis=1)
