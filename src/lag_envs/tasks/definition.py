"""What a task's class may define; its mistakes are named before anything is recorded."""

from __future__ import annotations

import inspect
import warnings
import weakref
from collections.abc import Mapping
from typing import Any

from lag_envs.errors import warn_of_misspelt
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes import picture
from lag_envs.scenes.base import SceneType
from lag_envs.scenes.checks import not_a_method
from lag_envs.tasks.formulas import FORMULAS
from lag_envs.tasks.imperfections import KEYWORDS
from lag_envs.tasks.record import Controller, Examples, Goal, Open, Optimum, ValueIteration

#: What a task may define besides its attributes; all other public names of `Task` are its calls.
METHODS = (
    *FORMULAS,
    *("bounds", "reached", "behaviour", "check", "check_start", "check_target", "check_usable", "fastest"),
    *("edges", "variant", "bodies", "indicators", "window", "readings"),
)
#: Attributes that map names to something; `action`, `start` and `target` are read for each task.
MAPPINGS = ("defaults", "usable", "imperfections", "controllers", "hyperparameters", "quantities")
#: Attributes that are texts, and those that are parts of a record.
KINDS: dict[str, type] = dict.fromkeys(("id", "peer", "reference", "difficulty", "note"), str) | {
    "goal": Goal,
    "value_iteration": ValueIteration,
    "optimum": Optimum,
    "open": Open,
    "examples": Examples,
}
#: What a class has in place of keywords of environments.
INSTEAD = {
    "max_episode_steps": "steps",
    "observation_space": "observe and bounds",
    "action_space": "action",
    "reset": "start",
    "render": "bodies and poses in the scene",
} | {name: f"imperfections = {{{name!r}: ...}}" for name in KEYWORDS}

_checked: weakref.WeakSet[type] = weakref.WeakSet()


def check_definition(kind: type, base: type) -> None:
    """Raise a FormulaError if a task's class is not defined as tasks are; warn of names that nothing uses."""
    if kind in _checked:
        return
    if hasattr(kind, "scene_type"):
        raise FormulaError(
            f"{kind.__name__} is written for lag_envs 0.1, with scene_type and formulas by index; "
            "write scene, action, start, observe and reward by name (see CHANGELOG.md)"
        )
    if kind.shapes is not base.shapes:  # type: ignore[attr-defined]
        raise FormulaError(f"{kind.__name__}.shapes: {picture.INSTEAD_OF_SHAPES}")
    scene = kind.scene  # type: ignore[attr-defined]
    fields = inspect.signature(scene).parameters if isinstance(scene, SceneType) else ()
    for c in kind.__mro__[: kind.__mro__.index(base)]:
        if "__dataclass_fields__" in vars(c):
            raise FormulaError(
                f"{c.__name__} must not be a dataclass: tasks are written without a decorator, and their "
                "attributes are read from the class"
            )
        for name, value in vars(c).items():
            if fault := _fault(base, name, value):
                raise FormulaError(f"{c.__name__}.{name} {fault}")
            if name in fields and not hasattr(base, name) and not hasattr(value, "__get__"):
                what = f"{c.__name__}.{name} does not change the scene's {name}"
                warnings.warn(f"{what}; write defaults = {{{name!r}: ...}}", UserWarning, stacklevel=2)
    _check_kick(kind, base)
    _check_last_reward(kind, base)
    warn_of_misspelt(kind, base, INSTEAD)
    _checked.add(kind)


def _fault(base: type, name: str, value: Any) -> str:
    """Return what is wrong with a class's attribute, if anything."""
    if name in ("dt", "duration"):
        instead = "interval [s]" if name == "dt" else "steps"
        return f"is a keyword of environments; in a class, write {instead}"
    defined = name in METHODS or name in inspect.get_annotations(base) or name.startswith("_")
    if name in ("given", "fixed_target") or (hasattr(base, name) and not defined):
        return "hides an attribute of every task; choose another name"
    if inspect.isfunction(vars(base).get(name)) and (fault := not_a_method(name, value, base)):
        return fault
    if hasattr(value, "__get__") or (value is None and name in KINDS):  # a method, or a property
        return ""
    got = f"got {value!r:.60}"
    if name in MAPPINGS and not isinstance(value, Mapping):
        return f"must map names to values, as a dict does, {got}"
    if name == "controllers" and (odd := [n for n, c in value.items() if not isinstance(c, Controller)]):
        return f"must map names to Controller(...), got {value[odd[0]]!r:.60} for {odd[0]!r}"
    if name == "quantities" and (
        odd := [n for n, q in value.items() if not isinstance(q, tuple | list) or len(q) != 2]
    ):
        return f"must map names to (unit, meaning), got {value[odd[0]]!r:.60} for {odd[0]!r}"
    if name == "draws" and (type(value) is not int or value < 0):
        return f"must be a whole number, 0 or more, {got}"
    if name in KINDS and not isinstance(value, KINDS[name]):
        what = "text" if KINDS[name] is str else f"a record.{KINDS[name].__name__}"
        return f"must be {what}, {got}; choose another name for a number of your own"
    return ""


def _check_kick(kind: Any, base: Any) -> None:
    """Raise a FormulaError if a kick has no random numbers, or random numbers have no kick."""
    counted = any("draws" in vars(c) for c in kind.__mro__[: kind.__mro__.index(base)])
    if kind.kick is not base.kick and not counted:
        raise FormulaError(
            f"{kind.__name__}.kick is defined, but not how many random numbers it takes: write draws = 1, "
            "or the number that it takes"
        )
    if kind.kick is base.kick and kind.draws:
        raise FormulaError(f"{kind.__name__}.draws is {kind.draws}, but there is no kick to use these draws")


def _check_last_reward(kind: Any, base: Any) -> None:
    """Warn if a class defines the last reward, but no step can get it."""
    if "last_reward" in vars(kind) and kind.terminated is base.terminated:
        what = f"nothing uses {kind.__name__}.last_reward: without terminated, no step ends an episode early"
        warnings.warn(what, UserWarning, stacklevel=3)
