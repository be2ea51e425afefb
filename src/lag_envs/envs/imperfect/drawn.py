"""Parameters that are redrawn for each episode."""

from __future__ import annotations

from typing import Any

from lag_envs.envs.imperfect.constants import constants_of
from lag_envs.envs.imperfect.derived import DerivedConstants
from lag_envs.envs.imperfect.draws import purpose_key
from lag_envs.envs.imperfect.pushes import pushes
from lag_envs.envs.program import Program
from lag_envs.tasks.base import Task


class DrawnProgram(Program):
    """The compiled functions of a task with drawn parameters; the arguments are those of `Program`.

    The drawn parameters ``p_`` are rows, and so are the constants that depend on them. Apart from this, and
    from keeping observations within their bounds, steps are those of any batch of different environments.
    """

    def __init__(self, task: Task, absent: frozenset[str], varying: frozenset[str]) -> None:
        assert task.imperfections is not None
        self.options = task.imperfections
        self._made = DerivedConstants(task, absent) if task.drawn else None
        changed = self._made.changed if self._made else []
        self.p = [f"p_{d.name}" for d in self.options.drawn]
        self.asked = [f"asked{i}" for i in range(len(self.options.lag))]
        self.own = [*self.p, *self.own, *self.asked]
        self._source = task.drawn.inner if task.drawn else task
        super().__init__(self._source, absent, varying | frozenset(changed), list(constants_of(task)))
        self.drawn = [*self.p, *(f"k_{name}" for name in self.varying if name in changed)]

    @property
    def _printed(self) -> list[str]:
        return [*super()._printed, *self.begin]

    def _record(self, formulas: Any, constants: dict[str, Any]) -> None:
        super()._record(formulas, constants)
        self.begin = self._made.lines(constants) if self._made else []
        limits = [(constants[f"seen_low{i}"], constants[f"seen_high{i}"]) for i in range(len(self.o))]
        self._bounded = [
            f"{o} = select({o} < {low}, {low}, select({o} > {high}, {high}, {o}))"
            for o, (low, high) in zip(self.o, limits, strict=True)
        ]
        self._bound_observations()

    def _add_pushes(self, constants: dict[str, Any]) -> None:
        """Let pushes follow the kicks; for programs with further imperfections."""
        self.moved, lines = pushes(self.options, self.moved, constants)
        self.kick = [*self.kick, *lines]
        self.move = [f"{a} = {b}" for a, b in zip(self.y, self.moved, strict=True)]

    def _bound_observations(self) -> None:
        self.observe = [*self.observe, *self._bounded]

    @property
    def _start(self) -> list[str]:
        draws = (f"uniform(key_parameters, np.uint64(0), np.uint64({j}))" for j in range(len(self.p)))
        return [
            *([f"key_parameters = {purpose_key('parameters')}"] if self.p else []),
            *(f"share{j} = {draw}" for j, draw in enumerate(draws)),
            *self.begin,
            *super()._start,
        ]
