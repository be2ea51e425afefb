"""The choice of an environment's or a batch's program."""

from __future__ import annotations

from collections.abc import Sequence

from lag_envs.envs.imperfect.divided import DividedProgram
from lag_envs.envs.imperfect.drawn import DrawnProgram
from lag_envs.envs.imperfect.whole import WholeProgram
from lag_envs.envs.program import Program, program_for
from lag_envs.stepping.compiling import absent_from
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import Imperfections


def program_of(task: Task, constants: Sequence[dict[str, float]]) -> Program:
    """Return the program of an environment, or of a batch of tasks with these constants."""
    absent = absent_from(*constants)
    varying = frozenset(
        name for name in constants[0] if any(c[name] != constants[0][name] for c in constants)
    )
    if task.imperfections is None:
        return program_for(task, absent, varying)
    key = (type(task), type(task.scene), task.formulas.key, task.imperfections.structure, absent, varying)
    if task.drawn:
        key = (*key, task.drawn.inner.formulas.key, *task.drawn.made)
    if key not in _programs:
        only_drawn = Imperfections(drawn=task.imperfections.drawn) == task.imperfections
        undivided = WholeProgram if task.imperfections.whole else DividedProgram
        _programs[key] = (DrawnProgram if only_drawn else undivided)(task, absent, varying)
    return _programs[key]


_programs: dict[tuple, DrawnProgram] = {}
