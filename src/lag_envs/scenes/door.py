"""Checks made when a scene's class is used: its names, its formulas, and whether the motion is determined."""

from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.errors import warn_of_misspelt
from lag_envs.mechanics import recording
from lag_envs.mechanics.algebra import Expr, FormulaError, evaluate
from lag_envs.mechanics.equations import Energies, place, velocity
from lag_envs.mechanics.evaluation import Exact, Numeric, exactly
from lag_envs.mechanics.layout import SceneLayout, check_name
from lag_envs.mechanics.motion import Mechanics
from lag_envs.mechanics.recording import SceneRecord, Values, parameter_names
from lag_envs.scenes import picture
from lag_envs.scenes.checks import run_check, shown
from lag_envs.scenes.declaring import DEFINED, own_annotations
from lag_envs.scenes.derivation import layout_of, structure_of
from lag_envs.scenes.parameters import fill_in

#: A mass matrix, scaled to a diagonal of 1, counts as singular if its smallest eigenvalue is below this.
SINGULAR = 1e-13
#: If the smallest eigenvalue is below this, the certificate is coarse, because it bounds the inverse entry by
#: entry.
ILL_CONDITIONED = 1e-3

#: Layouts and equations of scenes that passed the checks: by class, and by `structure_of`.
_admitted: weakref.WeakKeyDictionary[type, dict[tuple, tuple[SceneLayout, Mechanics]]] = (
    weakref.WeakKeyDictionary()
)


def is_own(kind: type) -> bool:
    """Return whether a class is the package's own; then only its structure decides its formulas' results.

    Other people's formulas may use names defined outside, which can change.
    """
    return kind.__module__.startswith("lag_envs.")


def admit(scene: Any, base: type) -> None:
    """Check a new scene: its parameters, its mass matrix and, for the first of its kind, names and formulas.

    Parameters
    ----------
    scene : Scene
        The scene.
    base : type
        The class that all scenes are derived from.
    """
    if scene.modes:
        mode = scene.control
        if not isinstance(mode, str) or mode not in scene.modes:
            raise ValueError(f"control must be one of {', '.join(scene.modes)}, got {shown(mode)}")
    fill_in(scene)
    run_check(scene)
    try:
        key = structure_of(scene)
        known = _admitted.setdefault(type(scene), {}).get(key)
    except TypeError as error:
        raise FormulaError(
            f"{type(scene).__name__}: {error}; structural fields must be hashable: give a tuple"
        ) from error
    if known is not None and is_own(type(scene)):
        vars(scene)["_cached_layout"], vars(scene)["_cached_mechanics"] = known
    elif known is None:
        _check_names(scene, base)
        layout = layout_of(scene)
        recording.check_again(scene, layout, recording.record_scene(scene, layout))
        _check_on_numbers(scene, scene.mechanics)
        _check_motion(scene, scene.mechanics)
        _check_bodies(scene)
        _admitted[type(scene)][key] = layout, scene.mechanics
    else:
        _check_on_numbers(scene, scene.mechanics)
        _check_motion(scene, known[1])  # a parameter may have another sign


def check_class(cls: type, base: type) -> None:
    """Raise a FormulaError for faults of a class that can be seen before a scene is made."""
    of = cls.__name__
    for c in cls.__mro__[: cls.__mro__.index(base)]:
        if "drive" in vars(c) and "pack" in vars(c) and "unpack" in vars(c):
            raise FormulaError(
                f"{of} is written for lag_envs 0.1, with drive, unpack and pack; write kinetic, potential, "
                "dissipation and applied, from which these follow (see CHANGELOG.md)"
            )
        if "shapes" in vars(c):
            raise FormulaError(f"{of}.shapes: {picture.INSTEAD_OF_SHAPES}")
        if not issubclass(c, base) and "__dataclass_fields__" not in vars(c):
            for name, value in vars(c).items():
                if isinstance(value, dataclasses.Field) or name in getattr(cls, "__dataclass_fields__", ()):
                    raise FormulaError(
                        f"{of}.{name}: {c.__name__} is not a scene, so this has no effect; declare it in {of}"
                    )
    faults = [fault for c in cls.__mro__ for fault in vars(c).get("_faults", ())]
    if faults:
        raise FormulaError(f"{of}.{faults[0]}")
    if not cls.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise FormulaError(
            f"{of} is not a frozen dataclass; write @dataclasses.dataclass(frozen=True, kw_only=True)"
        )


def _check_names(scene: Any, base: type) -> None:
    """Raise a FormulaError if a name is taken."""
    cls, of = type(scene), type(scene).__name__
    public = {name for name in dir(base) if not name.startswith("_")}
    for c in cls.__mro__[: cls.__mro__.index(base)]:
        for name in (*own_annotations(c), *vars(c)):
            inner = name[:1] == "_" != name[-1:] and callable(vars(base).get(name))
            if inner or (name in public and name not in DEFINED):
                raise FormulaError(f"{of}.{name} hides an attribute of every scene; choose another name")
    warn_of_misspelt(cls, base)
    layout = layout_of(scene)
    derived = [name + ending for name in layout.names for ending in ("", "_dot", "_ddot")]
    taken = {
        **dict.fromkeys(DEFINED, "part of every scene"),
        **dict.fromkeys((e.name for e in layout.state), "an entry of the state"),
        **dict.fromkeys(derived, "a coordinate or its derivative"),
        **dict.fromkeys((*layout.controls, *layout.absent), "a control"),
    }
    for field in dataclasses.fields(scene):
        check_name(of, field.name)
        if field.name in taken:
            raise FormulaError(
                f"{of}: the field {field.name!r} has the name of {taken[field.name]}; choose another"
            )
    others = set(layout.controls) - {p.control for p in layout.prescribed}
    for name in sorted(others & {e.name for e in layout.state}):
        raise FormulaError(
            f"{of}: the control {name!r} has the name of an entry of the state; choose another"
        )


def _check_bodies(scene: Any) -> None:
    """Raise a FormulaError if a body has no pose, or a force no equation."""
    of, found = type(scene).__name__, scene.mechanics
    with recording.formula(scene, "bodies", [field.name for field in dataclasses.fields(scene)]):
        bodies = scene.bodies()
    if not isinstance(bodies, Mapping):
        raise FormulaError(f"{of}.bodies must return shapes by body, got {bodies!r:.60}")
    known = [picture.GROUND, *found.record.poses, *picture.indicated(scene, picture.at_rest(scene))]
    for body, shapes in bodies.items():
        if body not in known:
            raise picture.no_place(scene, "bodies", body, known)
        picture.check_shapes(scene, body, shapes)
    try:
        found.full  # noqa: B018
    except FormulaError as error:
        raise FormulaError(f"{of}.{error}") from error


def _check_on_numbers(scene: Any, found: Mechanics) -> None:
    """Raise a FormulaError if a formula gives something else on plain numbers than what was recorded.

    This happens if a formula asks for a parameter's type or text, or keeps a number. Each formula is tried at
    two points. An allowance is made for rounding: where terms cancel in the record, plain numbers may leave a
    little of the squares of a formula's parameters, or of a parameter that drops out.
    """
    layout, parameters = found.layout, recording.parameter_values(scene)
    largest = max(map(abs, parameters.values()), default=0.0)
    names = [(name, x) for name, exprs in found.record.by_formula().items() for x in exprs]
    read = [{s.name for s in x.symbols() if s.kind == "parameter"} for _, x in names]
    allowed = [
        1e-15 * (largest + max((parameters[p] ** 2 for p in own if p in parameters), default=0.0))
        for own in read
    ]
    alike: list[set[bool]] = [set() for _ in names]
    for first, step in ((0.37, 0.11), (1.3, -0.23)):
        numbers = {name: np.float64(first + step * i) for i, name in enumerate(layout.names)}
        rates = {name: 0.7 - x for name, x in numbers.items()}
        controls = {name: np.float64(0.6 + step * i) for i, name in enumerate(layout.controls)}
        values = exactly(parameters)
        for symbol, known in ((place, numbers), (velocity, rates), (recording.control, controls)):
            values |= {symbol(name): x for name, x in known.items()}
        q, v = Values("coordinate", numbers), Values("velocity", rates)
        u = Values("control", controls, dict.fromkeys(layout.absent, 0.0))
        try:
            with np.errstate(all="ignore"):
                terms = [evaluate(_terms(x), values, Numeric) for _, x in names]
                plain = _on_numbers(scene, q, v, u)
        except ArithmeticError:  # there it has no value
            continue
        for outcomes, parts, x, rounding in zip(alike, terms, plain, allowed, strict=True):
            total, size = sum(parts), sum(map(abs, parts))
            if isinstance(x, Expr):  # kept from an earlier run
                outcomes.add(False)
            elif not isinstance(x, complex) and math.isfinite(size) and math.isfinite(x):
                outcomes.add(bool(abs(x - total) <= 1e-6 * size + rounding))
    for (name, _), outcomes in zip(names, alike, strict=True):
        if outcomes == {False}:
            raise FormulaError(
                f"{type(scene).__name__}.{name} gives another result on plain numbers than on recorded ones; "
                "it must not depend on the type or the text of a number, on numbers kept from an earlier "
                "run, nor on what is set in __post_init__"
            )


def _terms(expr: Expr) -> list[Expr]:
    return [Expr({monomial: c}) for monomial, c in expr.terms.items()]


def _on_numbers(scene: Any, q: Values, v: Values, u: Values) -> list:
    """Return the results of the scene's formulas on plain numbers, in the order of `SceneRecord.exprs`."""
    energies = Energies(
        kinetic=scene.kinetic(q, v, Numeric),
        potential=scene.potential(q, Numeric),
        dissipation=scene.dissipation(q, v, u, Numeric),
        applied=scene.applied(q, v, u, Numeric),
    )
    return SceneRecord(energies, scene.rests(), scene.poses(q, Numeric)).exprs()


def _check_motion(scene: Any, found: Mechanics) -> None:
    """Raise a FormulaError if the mass matrix is singular wherever it was tried."""
    smallest = _smallest_eigenvalue(scene, found, np.float64, Numeric)
    if smallest < SINGULAR:  # perhaps because its terms cancel, as with two nearly equal radii
        smallest = _smallest_eigenvalue(scene, found, Fraction, Exact())
    if smallest < SINGULAR:
        what = "singular" if smallest > -SINGULAR else "not positive"
        raise FormulaError(
            f"{type(scene).__name__}.kinetic gives a mass matrix of {', '.join(found.free)} that is {what}; "
            "every motion of the free coordinates needs a positive kinetic energy"
        )


def _smallest_eigenvalue(scene: Any, found: Mechanics, number: Any, xp: Any) -> float:
    """Return the smallest eigenvalue of the mass matrix, scaled to a diagonal of 1, where it is largest.

    The search ends at the first eigenvalue that is large enough.
    """
    n = len(found.free)
    values = {recording.parameter(name): number(getattr(scene, name)) for name in parameter_names(scene)}
    generator = np.random.default_rng(11)
    symbols = sorted({s for e in found.entries() for s in e.symbols()} - set(values), key=lambda s: s.text)
    seen = []
    with np.errstate(all="ignore"):
        for low, high in ((0.1, 1.5), (-3.0, 3.0), (0.01, 0.1), (1.0, 10.0)) * 4:
            at = values | {symbol: number(generator.uniform(low, high)) for symbol in symbols}
            try:
                entries = evaluate(found.entries(), at, xp)
                matrix = np.array([float(x) for x in entries]).reshape(n, n)
            except (ArithmeticError, ValueError):
                continue
            if not np.isfinite(matrix).all():
                continue
            seen.append(smallest_eigenvalue(matrix))
            if seen[-1] >= SINGULAR:
                break
    return max(seen, default=math.inf)


def smallest_eigenvalue(mass: NDArray[np.float64]) -> float:
    """Return the smallest eigenvalue of a mass matrix that is scaled to a diagonal of 1."""
    size = np.sqrt(np.abs(np.diag(mass)))
    return float(np.linalg.eigvalsh(mass / np.outer(size, size))[0]) if size.all() else 0.0
