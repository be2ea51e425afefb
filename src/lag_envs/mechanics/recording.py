"""Run a scene's formulas on recorded numbers, and refuse early what recorded numbers cannot follow.

A formula runs on a twin of the scene: an object of the same class whose parameters are symbols, so that
methods and properties that a formula calls see symbols too. Structural fields keep their values; formulas may
branch on them and use them as counts.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NoReturn

from lag_envs.errors import hint
from lag_envs.mechanics.algebra import (
    Atom,
    Expr,
    FormulaError,
    RecordedFunctions,
    apart,
    linear_opened,
    raised,
    substitute,
)
from lag_envs.mechanics.equations import Energies, place, velocity
from lag_envs.mechanics.identities import shorter
from lag_envs.mechanics.layout import SceneLayout

#: The formulas of a scene and their arguments after ``self``.
ARGUMENTS: Mapping[str, tuple[str, ...]] = {
    "kinetic": ("q", "v", "xp"),
    "potential": ("q", "xp"),
    "dissipation": ("q", "v", "u", "xp"),
    "applied": ("q", "v", "u", "xp"),
    "poses": ("q", "xp"),
}

#: The entry that marks a twin's ``__dict__``.
TWIN = "_twin"


def parameter(name: str) -> Atom:
    """Return the symbol of a parameter."""
    return Atom("parameter", name)


def control(name: str) -> Atom:
    """Return the symbol of a control."""
    return Atom("control", name)


class Values:
    """Numbers by name, by index and in order: ``q.theta``, ``q[0]``, ``x, theta = q``."""

    __slots__ = ("_hidden", "_items", "_what", "_why")

    def __init__(
        self, what: str, items: Mapping[str, Any], hidden: Mapping[str, Any] | None = None, why: str = ""
    ) -> None:
        """Hold numbers.

        Parameters
        ----------
        what : str
            A word for the numbers, for error messages.
        items : mapping
            The numbers, in order.
        hidden : mapping, optional
            Further numbers, accessible by name only.
        why : str, optional
            Why a number may be missing, for error messages.
        """
        object.__setattr__(self, "_what", what)
        object.__setattr__(self, "_items", dict(items))
        object.__setattr__(self, "_hidden", dict(hidden or {}))
        object.__setattr__(self, "_why", f"; {why}" if why else "")

    def __getattr__(self, name: str) -> Any:
        for found in (self._items, self._hidden):
            if name in found:
                return found[name]
        if name.startswith("__"):
            raise AttributeError(name)
        raise FormulaError(f"there is no {self._what} {name!r}, {_others(self._items)}{self._why}")

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, str):
            return getattr(self, index)
        values = tuple(self._items.values())
        try:
            return values[index]
        except IndexError:
            raise FormulaError(
                f"there is no {self._what} number {index}, only {len(values)} of them, counted from 0"
                f"{self._why}"
            ) from None

    def __iter__(self) -> Iterator[Any]:
        return iter(self._items.values())

    def __len__(self) -> int:
        return len(self._items)

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        raise FormulaError(f"a formula sets the {self._what} {name!r}; formulas may only read numbers")

    def __setitem__(self, index: Any, value: Any) -> NoReturn:
        raise FormulaError(f"a formula sets the {self._what} {index!r}; formulas may only read numbers")

    def __contains__(self, item: Any) -> NoReturn:
        raise FormulaError(f"a formula uses `in` on the {self._what}s; formulas cannot branch on numbers")

    def __repr__(self) -> str:
        return f"<{self._what}s {', '.join(self._items)}>"


def _others(names: Collection[str]) -> str:
    """Return a text with the names that exist, for an error about a missing name."""
    return f"only {', '.join(names)}" if names else "nor any other"


def parameter_names(scene: Any) -> tuple[str, ...]:
    """Return the names of a scene's parameters that have a value."""
    fields = dataclasses.fields(scene)
    return tuple(f.name for f in fields if "unit" in f.metadata and getattr(scene, f.name) is not None)


def parameter_values(scene: Any) -> dict[str, Any]:
    """Return a scene's parameters that have a value, by name."""
    return {name: getattr(scene, name) for name in parameter_names(scene)}


def twin(scene: Any, numbers: Mapping[str, Any]) -> Any:
    """Return an object like the scene whose parameters are other numbers, or symbols.

    Parameters
    ----------
    scene : Scene
        The scene.
    numbers : mapping
        A number for each parameter that is not None.
    """
    other, given = object.__new__(type(scene)), parameter_names(scene)
    for field in dataclasses.fields(scene):
        value = numbers[field.name] if field.name in given else getattr(scene, field.name)
        object.__setattr__(other, field.name, value)
    vars(other)[TWIN] = True
    return other


def symbolic_twin(scene: Any) -> Any:
    """Return an object like the scene whose parameters are recorded numbers."""
    return twin(scene, {name: Expr.of(parameter(name)) for name in parameter_names(scene)})


@dataclasses.dataclass(frozen=True)
class SceneRecord:
    """The results of a scene's formulas on symbols.

    Attributes
    ----------
    energies : Energies
        Kinetic and potential energy, dissipation and applied forces.
    rests : mapping from str to Expr
        Resting places of prescribed coordinates.
    poses : mapping from str to (Expr, Expr, Expr)
        Place [m] and angle [rad] of each body.
    """

    energies: Energies
    rests: Mapping[str, Expr]
    poses: Mapping[str, tuple[Expr, Expr, Expr]]

    def by_formula(self) -> dict[str, list[Expr]]:
        """Return the expressions of each formula, in a fixed order."""
        e = self.energies
        return {
            "kinetic": [e.kinetic],
            "potential": [e.potential],
            "dissipation": [e.dissipation],
            "applied": [e.applied[name] for name in sorted(e.applied)],
            "rests": [self.rests[name] for name in sorted(self.rests)],
            "poses": [x for name in sorted(self.poses) for x in self.poses[name]],
        }

    def exprs(self) -> list[Expr]:
        """Return all expressions, in a fixed order."""
        return [x for found in self.by_formula().values() for x in found]


@contextlib.contextmanager
def formula(scene: Any, name: str, fields: Sequence[str] | None = None) -> Iterator[None]:
    """Add class and formula to the message of errors raised within.

    Parameters
    ----------
    scene : Scene or Task
        The scene or task to which the formula belongs.
    name : str
        The formula, or a computed property or parameter.
    fields : sequence of str, optional
        The fields that a formula may use, if it is not run on recorded numbers.
    """
    where, token = f"{type(scene).__name__}.{name}", raised.set([])
    try:
        yield
        for error in raised.get() or ():
            raise FormulaError(f"{error}; the formula catches this error, which it must not do")
    except FormulaError as error:
        raise FormulaError(f"{where}: {error}") from error
    except dataclasses.FrozenInstanceError as error:
        raise FormulaError(f"{where} assigns to self: {error}; use a local name") from error
    except Exception as error:
        on = " on recorded numbers" if fields is None else ""
        raise FormulaError(
            f"{where} fails{on} with {type(error).__name__}: {error}; {_remedy(scene, error, fields)}"
        ) from error
    finally:
        raised.reset(token)


def _remedy(of: Any, error: Exception, used: Sequence[str] | None) -> str:
    """Return what to do about an error in a formula of a scene or task, or the fields that it was given."""
    if of_numpy := re.search(r"no callable (\w+) method", str(error)):  # np.exp of a recorded number
        return f"write xp.{of_numpy[1]}, and functions of xp only"
    if isinstance(error, RecursionError):
        return "a formula calls itself without end"
    owner = getattr(error, "obj", None)
    if isinstance(error, KeyError) or isinstance(owner, Mapping):
        return "look up only names that exist; state, controls and target are arguments"
    if of_xp := re.search(r"Trace\.(\w+)\(\) missing", str(error)):
        return f"give xp.{of_xp[1]} all its arguments, as for NumPy's"
    if re.search(r"(function_of|Functions\.tan|Trace\.\w+)\(\) (missing|takes)", str(error)):
        return "give functions of xp the arguments of NumPy's, as in xp.cos(x)"
    if names := getattr(type(owner), "_fields", None):
        return f"it has {', '.join(names)}"
    ours = owner is not None and type(owner) in (type(of), type(getattr(of, "scene", None)))
    if not isinstance(error, AttributeError) or not ours:
        if used is not None:
            return f"it was given {', '.join(f'{f}={getattr(of, f)!r:.40}' for f in used) or 'no fields'}"
        if re.search("'(Values|State)'", str(error)):  # arithmetic with all of them
            return "take the numbers one by one, by name or index"
        return "use + - * /, whole powers and functions of xp"
    fields = [field.name for field in dataclasses.fields(owner)] if dataclasses.is_dataclass(owner) else []
    otherwise = f"it has {', '.join(fields)}" if fields else "define it in the class"
    return hint(str(error.name), [name for name in dir(owner) if not name.startswith("_")], otherwise)


def check_signature(scene: Any, name: str) -> None:
    """Raise a FormulaError if a formula does not take the expected arguments."""
    arguments, kinds = ARGUMENTS[name], inspect.Parameter
    wanted = f"{name}(self, {', '.join(arguments)})"
    taken = list(inspect.signature(getattr(scene, name)).parameters.values())
    if any(p.kind is kinds.VAR_POSITIONAL for p in taken):
        return
    plain = [p for p in taken if p.kind in (kinds.POSITIONAL_ONLY, kinds.POSITIONAL_OR_KEYWORD)]
    swapped = displaced([p.name for p in taken], arguments)
    if swapped or len(plain) != len(arguments) or len(plain) != len(taken):
        time = (
            "; time is not an argument: for a given motion use a prescribed coordinate"
            if {"t", "time"} & {p.name for p in taken}
            else ""
        )
        raise FormulaError(
            f"it must be {wanted}, got ({', '.join(['self', *(p.name for p in taken)])}){time}"
        )


def displaced(names: Sequence[str], wanted: Sequence[str]) -> bool:
    """Return whether an argument has the name of an argument in another position."""
    return any(name != other and name in wanted for name, other in zip(names, wanted, strict=False))


def single_expression(value: Any, what: str = "") -> Expr:
    """Return a formula's result as an expression, or raise a FormulaError."""
    if value is None:
        raise FormulaError(f"{what}returns None; end it with a return of a number")
    if isinstance(value, Values):
        raise FormulaError(f"{what}returns {value!r:.60}; take one of them, by its name")
    if getattr(value, "ndim", 0) or isinstance(value, tuple | list | set | dict):
        raise FormulaError(f"{what}returns {type(value).__name__} where one number is expected")
    if isinstance(value, complex):
        raise FormulaError(f"{what}returns the complex number {value}; formulas are real")
    try:
        return Expr.of(value)
    except FormulaError:
        raise FormulaError(f"{what}returns {value!r:.60}, which is not a real number") from None


def record_scene(scene: Any, layout: SceneLayout) -> SceneRecord:
    """Run all formulas of a scene on symbols.

    Raises
    ------
    FormulaError
        If a formula does something that recorded numbers cannot follow; the message names class and formula.
    """
    names = layout.names
    copy = symbolic_twin(scene)
    q = Values("coordinate", {name: Expr.of(place(name)) for name in names})
    v = Values("velocity of a coordinate", {name: Expr.of(velocity(name)) for name in names})
    u = Values(
        "control",
        {name: Expr.of(control(name)) for name in layout.controls},
        {name: Expr.of(0) for name in layout.absent},
    )
    xp = RecordedFunctions()
    given = {"q": q, "v": v, "u": u, "xp": xp}

    def run(name: str) -> Any:
        check_signature(copy, name)
        return getattr(copy, name)(*(given[argument] for argument in ARGUMENTS[name]))

    parts = {}
    for name in ("kinetic", "potential", "dissipation"):
        with formula(scene, name), apart(name != "kinetic"):
            parts[name] = single_expression(run(name))
    for name in ("kinetic", "potential"):
        parts[name] = shorter(parts[name])
    parts["dissipation"] = linear_opened(parts["dissipation"])
    with formula(scene, "applied"), apart():
        applied = _by_name(run("applied"), names, "coordinate")
    with formula(scene, "rests"):
        rests = _by_name(copy.rests(), names[len(layout.free) :], "prescribed coordinate")
        for name, value in rests.items():
            if any(s.kind != "parameter" for s in value.symbols()):
                raise FormulaError(f"the place of {name!r} depends on more than parameters")
    with formula(scene, "poses"):
        poses = _poses(run("poses"))
    found = SceneRecord(Energies(applied=applied, **parts), rests, poses)
    _check_controls(scene, layout, found)
    _check_dissipation(scene, parts["dissipation"])
    return found


def check_again(scene: Any, layout: SceneLayout, found: SceneRecord) -> None:
    """Raise a FormulaError if a formula gives another result when it is run again."""
    again = record_scene(scene, layout).exprs()
    if not all(a.same(b) for a, b in zip(found.exprs(), again, strict=True)):
        raise FormulaError(
            f"{type(scene).__name__}: a formula gives another result when it is run again; formulas may "
            "depend on place, velocity, controls and fields only, not on time or chance"
        )


def _by_name(values: Any, names: Sequence[str], what: str) -> dict[str, Expr]:
    if not isinstance(values, Mapping):
        raise FormulaError(
            f"it must return numbers by {what}, as in {{{names[0]!r}: ...}}, got {values!r:.60}"
            if names
            else f"it must return {{}}, since there is no {what}, got {values!r:.60}"
        )
    for name in values:
        if name not in names:
            raise FormulaError(f"there is no {what} {name!r}, {_others(names)}")
    return {name: single_expression(values[name], f"for {name!r} it ") for name in names if name in values}


def _poses(values: Any) -> dict[str, tuple[Expr, Expr, Expr]]:
    if not isinstance(values, Mapping):
        raise FormulaError(f"it must return {{body: (x, y, angle)}}, got {values!r:.60}")
    poses = {}
    for body, pose in values.items():
        if not isinstance(pose, Sequence) or len(pose) != 3:
            raise FormulaError(f"the pose of {body!r} must be (x, y, angle), got {pose!r:.60}")
        x, y, angle = (single_expression(value, f"for {body!r} it ") for value in pose)
        poses[body] = x, y, angle
    return poses


def _check_controls(scene: Any, layout: SceneLayout, found: SceneRecord) -> None:
    used = {s.name for e in found.exprs() for s in e.symbols() if s.kind == "control"}
    moving = {p.control for p in layout.prescribed}
    for name in layout.controls:
        if name not in used and name not in moving:
            raise FormulaError(
                f"{type(scene).__name__}: the control {name!r} has no effect; use u.{name} in applied or "
                "dissipation, or name it s_ddot, s_dot or s after a prescribed coordinate s"
            )


def _check_dissipation(scene: Any, loss: Expr) -> None:
    """Raise a FormulaError for a dissipation that has no velocities or acts as a constant force."""
    degrees = set()
    for monomial in loss.terms:
        moving = [(a, n) for a, n in monomial if any(s.kind == "velocity" for s in Expr.of(a).symbols())]
        degrees.add(sum(n if a.argument is None else 2 for a, n in moving))
    of = f"{type(scene).__name__}.dissipation"
    if degrees and not any(degrees):
        raise FormulaError(f"{of} contains no velocity, so it has no effect; forces belong in applied")
    if degrees and max(degrees) == 1:
        raise FormulaError(
            f"{of} is proportional to velocities, so it would push with a constant force; return a function "
            "whose derivative by the velocity is the drag, such as 0.5 * b * v.x**2 for b * v.x; forces "
            "belong in applied"
        )


def restrict(found: SceneRecord, values: Mapping[Atom, Expr], scene: Any, why: str) -> SceneRecord:
    """Return a record with symbols replaced; errors name the formula and the reason for replacing."""

    def of(name: str, expr: Expr) -> Expr:
        try:
            return substitute(expr, values)
        except FormulaError as error:
            raise FormulaError(f"{type(scene).__name__}.{name}, {why}: {error}") from error

    e = found.energies
    energies = Energies(
        kinetic=of("kinetic", e.kinetic),
        potential=of("potential", e.potential),
        dissipation=of("dissipation", e.dissipation),
        applied={name: of("applied", value) for name, value in e.applied.items()},
    )
    rests = {name: of("rests", value) for name, value in found.rests.items()}
    poses = {}
    for body, (x, y, angle) in found.poses.items():
        poses[body] = of("poses", x), of("poses", y), of("poses", angle)
    return SceneRecord(energies, rests, poses)
