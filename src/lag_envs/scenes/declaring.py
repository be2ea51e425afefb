"""How a scene's class is made: read-only attributes, fields, a frozen dataclass."""

from __future__ import annotations

import copyreg
import dataclasses
import inspect
import sys
from collections.abc import Mapping
from types import MappingProxyType, ModuleType
from typing import Any

from lag_envs.mechanics import recording
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.mechanics.layout import check_name, units
from lag_envs.scenes.checks import not_a_method

#: Class attributes that are mappings, and those that are names in order.
MAPPINGS = ("coordinates", "prescribed", "controls", "modes", "reactions", "ratios")
SEQUENCES = ("state", "left_out")
METHODS = ("rests", *recording.ARGUMENTS, "bodies", "indicators", "window", "check")

#: Where a task stores the order of the series that it chose for its scene.
ORDER = "_order_of_task"

#: What a scene may define; all other public names of `Scene` are its calls.
DEFINED = (*MAPPINGS, *SEQUENCES, *METHODS)


# If a class is sent to another process by value before its first use, its fields are sent too, and this
# marker with them. The marker is recognised by identity, so a copy of it would be taken for a default value.
copyreg.pickle(type(dataclasses.MISSING), lambda mark: "MISSING")


def own_annotations(cls: type) -> dict[str, Any]:
    """Return the class's own annotations; from Python 3.14 on they may refer to names not yet defined."""
    if sys.version_info >= (3, 14):
        import annotationlib

        return dict(annotationlib.get_annotations(cls, format=annotationlib.Format.FORWARDREF))
    return dict(inspect.get_annotations(cls))


def _frozen(given: Mapping) -> Mapping:
    """Return a read-only copy of a mapping and of the mappings in it."""
    items = {key: _frozen(value) if isinstance(value, Mapping) else value for key, value in given.items()}
    return MappingProxyType(items)


def complete(cls: type) -> None:
    """Make the class a frozen dataclass, unless a decorator has done so."""
    if cls.__base__ is object:
        raise FormulaError(
            "Scene is the base of scenes; derive a class with coordinates, kinetic and potential"
        )
    if "__dataclass_fields__" not in vars(cls):
        for name in own_annotations(cls):  # a class that is made by code may have names of any kind
            if not name.startswith("_"):
                check_name(cls.__name__, name)
        # For annotations that are texts, a dataclass looks into the class's module. That module may be
        # missing in a process to which the class was sent by value.
        absent = cls.__module__ not in sys.modules
        if absent:
            sys.modules[cls.__module__] = ModuleType(cls.__module__)
        try:
            dataclasses.dataclass(frozen=True, kw_only=True)(cls)
        except ValueError as error:  # a mutable default
            what, remedy = str(error).partition(":")[0], "give a tuple, or a constant without annotation"
            raise FormulaError(f"{cls.__name__}: {what}; {remedy}") from error
        finally:
            if absent:
                del sys.modules[cls.__module__]


def declare_scene(cls: Any, meta: type[type]) -> None:
    """Prepare a new class of scenes: copy its mappings, and note faults in its names.

    Parameters
    ----------
    cls : type
        The class.
    meta : type
        The type of scenes; parents of this type are made dataclasses first.
    """
    for parent in cls.__mro__[1:]:
        if isinstance(parent, meta) and parent.__base__ is not object:
            complete(parent)
    own, annotations = vars(cls), own_annotations(cls)
    faults = []
    for name in (*MAPPINGS, *SEQUENCES):
        kind = str(annotations.get(name, "ClassVar")).removeprefix("typing.")
        if kind.startswith("ClassVar"):
            continue
        # A dataclass would take it for a field; the fault is reported when the class is used.
        if isinstance(own.get(name), dataclasses.Field):
            faults.append(f"{name} is part of every scene; give the parameter another name")
            delattr(cls, name)
        else:
            faults.append(f"{name} has an annotation; write {name} = ... without one")
        del annotations[name]
    for name in [n for n, v in own.items() if isinstance(v, dataclasses.Field) and n not in annotations]:
        faults.append(f"{name} has no annotation; write {name}: float = parameter(...)")
        delattr(cls, name)
    base: Any = next(c for c in cls.__mro__ if isinstance(c, meta) and c.__base__ is object)
    for name in [n for n in METHODS if n in own and n not in annotations]:
        if fault := not_a_method(name, own[name], base):
            faults.append(f"{name} {fault}")
    inherited = {name for parent in cls.__mro__[1:] for name in getattr(parent, "__dataclass_fields__", ())}
    for name in sorted(inherited.intersection(own) - {*annotations, "control"}):
        if not inspect.ismemberdescriptor(own[name]):  # a slot; of anything else a dataclass takes no notice
            faults.append(
                f"{name} replaces a field without an annotation; write {name}: float = parameter(...)"
            )
    has_modes = isinstance(own.get("modes"), Mapping) and bool(own["modes"])
    if "control" not in annotations and (has_modes or ("control" in own and "control" in inherited)):
        annotations["control"] = "str"
        if "control" not in own:
            cls.control = next(iter(own["modes"]))
    if annotations != own_annotations(cls):
        cls.__annotations__ = annotations
    for name in MAPPINGS:
        if isinstance(own.get(name), Mapping):
            setattr(cls, name, _frozen(own[name]))
    for name in SEQUENCES:
        if isinstance(own.get(name), list):
            setattr(cls, name, tuple(own[name]))
    cls._faults = tuple(faults)


def controls_of(scene: Any, modes: Any, controls: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the mode's controls, and the names of all modes' controls."""
    of = type(scene).__name__
    if not isinstance(modes, Mapping):
        raise FormulaError(f"{of}.modes must map names to controls, got {modes!r:.80}")
    if not modes:
        return controls, ()
    if controls:
        raise FormulaError(f"{of} has controls and modes; put the controls into the modes")
    every: dict[str, str] = {}
    for mode, given in modes.items():
        every |= units(f"{of}.modes[{mode!r}]", given)
    return modes[scene.control], tuple(every)
