"""The environments for the quick tests: a few that together have every feature of a task's record.

Tests over environments take their parameters from `covering`. Those outside the covering set are marked slow,
so ``make test`` costs about the same however many environments there are, and ``make test-slow`` runs the
rest. Checks of a few milliseconds run on all: they are parametrised with `TASKS` itself. Those that compile
their own programs, and test the engine rather than formulas, cover the engines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import pytest

from lag_envs.scenes.derivation import form_of, layout_of
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task

#: Entries of a record in which tasks differ only by numbers and words. Any other entry of a task's own is a
#: feature.
WORDS_AND_NUMBERS = frozenset(
    "id scene defaults interval steps action start target usable usable_ranges check check_start fastest "
    "edges observe bounds reward reached behaviour controllers reference hyperparameters goal "
    "value_iteration examples difficulty note open quantities".split()
)
#: The features that a covering set covers.
Features = Callable[[type[Task]], frozenset[str]]
#: Environments without hidden parameters, imperfect sensors or actuators.
PERFECT = [env_id for env_id, kind in TASKS.items() if not kind.imperfections]
IMPERFECT = [env_id for env_id in TASKS if env_id not in PERFECT]


def slow(*values: Any) -> Any:
    """Mark a case of a parametrised test as slow."""
    return pytest.param(*values, marks=pytest.mark.slow)


def every(n: int, cases: Iterable[Any]) -> list[Any]:
    """Mark all cases but the first, the n-th after it, and so on, as slow."""
    return [
        pytest.param(*(case if type(case) is tuple else [case]), marks=[pytest.mark.slow] * (i % n > 0))
        for i, case in enumerate(cases)
    ]


@cache
def features(kind: type[Task]) -> frozenset[str]:
    """Return the features of a task's record on which code depends, in words."""
    task = kind()
    formulas, form = task.formulas, form_of(task.scene)
    own = {name for name in vars(Task) if getattr(kind, name) is not getattr(Task, name)}
    found = {name for name in own - WORDS_AND_NUMBERS if not name.startswith("_")}
    found |= {f"variant: {name}" for name in kind.examples.variants}
    found |= {f"control: {held.level}" for held in layout_of(task.scene).prescribed if held.level}
    found.add(f"engine: {form.kind.__name__ if form else 'series'}")
    found.add(f"{formulas.actions} actions, {'listed' if formulas.choices else 'ranges'}")
    found.add(f"{formulas.targets} targets")
    if any(acting.low != -acting.high for acting in formulas.acting if not acting.values):
        found.add("a range that is not symmetric")
    return frozenset(found)


@cache
def engine(kind: type[Task]) -> frozenset[str]:
    """Return the features that decide how a step is printed, apart from its formulas."""
    form = form_of(kind().scene)
    return frozenset(["imperfect" if kind.imperfections else form.kind.__name__ if form else "series"])


def way(kind: type[Task]) -> frozenset[str]:
    """Return how a step is computed, in the roughest words."""
    return frozenset(["imperfect" if kind.imperfections else "flow" if form_of(kind().scene) else "series"])


@cache
def size(kind: type[Task]) -> int:
    """Return how many coordinates a task's scene has."""
    return len(layout_of(kind().scene).free)


def quick(ids: Iterable[str] = TASKS, of: Features = features) -> list[str]:
    """Return a covering set, chosen greedily: most new features first, then fewest coordinates."""
    left = {env_id: of(TASKS[env_id]) for env_id in ids}
    missing, found = frozenset[str]().union(*left.values()), []
    while missing:
        found.append(max(left, key=lambda env_id: (len(left[env_id] & missing), -size(TASKS[env_id]))))
        missing -= left[found[-1]]
    return [env_id for env_id in left if env_id in found]


def covering(ids: Iterable[str] = TASKS, of: Features = features) -> list[Any]:
    """Return all ids as test parameters, those outside their covering set marked slow."""
    every = list(ids)
    chosen = quick(every, of)
    return [i if i in chosen else slow(i) for i in every]
