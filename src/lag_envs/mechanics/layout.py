"""A scene's declarations: coordinates, controls and state, with every name and unit checked or derived.

The only unit with a meaning is ``rad``: a coordinate in this unit is an angle. The name of a control decides
what it does: ``s_ddot``, ``s_dot`` or ``s`` moves a prescribed coordinate ``s``. The unit of a rate is that
of the coordinate with ``/s`` appended.
"""

from __future__ import annotations

import dataclasses
import keyword
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from lag_envs.mechanics.algebra import FormulaError

#: What a control sets of a prescribed coordinate; ``"rest"`` if no control sets anything.
Level = Literal["acceleration", "rate", "place", "rest"]

#: Other spellings of radians, which would not be taken for an angle, and degrees.
_NOT_RAD = ("radian", "radians", "rads", "deg", "degree", "degrees", "°")

_ENDINGS: tuple[tuple[str, Level], ...] = (("_ddot", "acceleration"), ("_dot", "rate"), ("", "place"))


class Prescribed(NamedTuple):
    """A coordinate that is moved or held from outside; a resting coordinate has the control ``""``."""

    name: str
    level: Level
    control: str


class StateEntry(NamedTuple):
    """An entry of the state.

    ``kind`` is ``"place"``, ``"velocity"``, or ``"momentum"`` for w = v + M⁻¹ Σ G ṡ of a free coordinate.
    """

    name: str
    kind: Literal["place", "velocity", "momentum"]
    coordinate: str
    unit: str


@dataclasses.dataclass(frozen=True)
class SceneLayout:
    """The names of a scene, in order, for one mode and one set of structural fields.

    Attributes
    ----------
    free : tuple of str
        Free coordinates.
    prescribed : tuple of Prescribed
        Prescribed coordinates.
    controls, control_units : tuple of str
        Controls of the mode.
    absent : tuple of str
        Controls of other modes, which read 0.
    state : tuple of StateEntry
        Entries of the state.
    left_out : tuple of str
        Entries that the state leaves out.
    reactions : tuple of (str, str)
        Names of forces, with the prescribed coordinate that each moves or holds.
    ratios : tuple of (str, str, str)
        Names of ratios, with the friction and the normal force.
    """

    free: tuple[str, ...]
    prescribed: tuple[Prescribed, ...]
    controls: tuple[str, ...]
    control_units: tuple[str, ...]
    absent: tuple[str, ...]
    state: tuple[StateEntry, ...]
    left_out: tuple[str, ...]
    reactions: tuple[tuple[str, str], ...]
    ratios: tuple[tuple[str, str, str], ...]

    def at(self, *levels: Level) -> tuple[Prescribed, ...]:
        """Return the prescribed coordinates with these levels."""
        return tuple(p for p in self.prescribed if p.level in levels)

    @property
    def names(self) -> tuple[str, ...]:
        """All coordinates, the free ones first."""
        return (*self.free, *(p.name for p in self.prescribed))

    @property
    def forces(self) -> tuple[tuple[str, str], ...]:
        """Names of all forces, those of `reactions` first, with the coordinate that each moves or holds."""
        named = {coordinate for _, coordinate in self.reactions}
        driven = [p.name for p in self.at("acceleration", "rate") if p.name not in named]
        return (*self.reactions, *((f"drive_{name}", name) for name in driven))


def check_name(where: str, name: Any) -> str:
    """Return a name that can follow a dot in a formula, or raise a FormulaError."""
    if (
        not isinstance(name, str)
        or not name.isidentifier()
        or keyword.iskeyword(name)
        or name.startswith("_")
    ):
        why = "a keyword of Python" if isinstance(name, str) and keyword.iskeyword(name) else "not a name"
        raise FormulaError(f"{where}: {name!r} is {why}; use letters, digits and _ as in q.theta_1")
    if name != (read := unicodedata.normalize("NFKC", name)):  # many letters look alike: µ and μ, ϑ and θ
        raise FormulaError(
            f"{where}: Python reads {name!r} in a formula as {read!r}, {read!a}; write it that way"
        )
    return name


def units(where: str, value: Any) -> dict[str, str]:
    """Return a mapping from names to units, or raise a FormulaError that shows how to write it."""
    if not isinstance(value, Mapping):
        raise FormulaError(f'{where} must map names to units, as in {{"x": "m"}}, got {value!r:.80}')
    for name, unit in value.items():
        check_name(where, name)
        if not isinstance(unit, str):
            raise FormulaError(f"{where}: the unit of {name!r} must be text, got {unit!r}")
        angle = unit.partition("/")[0].strip().lower()
        if angle in _NOT_RAD or (angle == "rad" and not unit.startswith("rad")):
            raise FormulaError(
                f"{where}: the unit of {name!r} is {unit!r}; write 'rad', because energies use radians"
            )
    return dict(value)


def _names(where: str, value: Any) -> tuple[str, ...]:
    if (
        isinstance(value, str)
        or not isinstance(value, Sequence)
        or not all(isinstance(n, str) for n in value)
    ):
        raise FormulaError(f'{where} must be names in order, as in ("theta", "theta_dot"), got {value!r:.80}')
    return tuple(value)


def make_layout(
    of: str,
    *,
    coordinates: Any,
    prescribed: Any,
    controls: Any,
    absent: Sequence[str],
    state: Any,
    left_out: Any,
    reactions: Any,
    ratios: Any,
) -> SceneLayout:
    """Return the layout from a class's declarations, or raise a FormulaError.

    Parameters
    ----------
    of : str
        Name of the class, for error messages.
    coordinates, prescribed, controls, state, left_out, reactions, ratios : object
        As declared; `controls` are those of the mode.
    absent : sequence of str
        Names of the controls of other modes.
    """
    free = units(f"{of}.coordinates", coordinates)
    moved = units(f"{of}.prescribed", prescribed)
    driven = units(f"{of}.controls", controls)
    if not free:
        raise FormulaError(f"{of}.coordinates is empty; a scene needs a free coordinate")
    _check_clashes(of, free, moved, (*driven, *absent))
    held = tuple(_held(of, name, driven) for name in moved)
    full = _full_state(free, moved, held)
    omitted = _names(f"{of}.left_out", left_out)
    _check_left_out(of, omitted, full, free)
    kept = [entry for entry in full if entry.name not in omitted]
    order = _names(f"{of}.state", state) or tuple(entry.name for entry in kept)
    if sorted(order) != sorted(entry.name for entry in kept):
        names = ", ".join(entry.name for entry in kept)
        raise FormulaError(
            f"{of}.state must list {names} in some order, got {', '.join(order)}; "
            "name entries that the state leaves out in left_out"
        )
    by_name = {entry.name: entry for entry in kept}
    if len(by_name) < len(kept):
        twice = next(e.name for e in kept if sum(e.name == other.name for other in kept) > 1)
        raise FormulaError(f"{of}: two entries of the state are named {twice!r}; rename a coordinate")
    forces = _reactions(of, reactions, moved)
    layout = SceneLayout(
        free=tuple(free),
        prescribed=held,
        controls=tuple(driven),
        control_units=tuple(driven.values()),
        absent=tuple(name for name in absent if name not in driven),
        state=tuple(by_name[name] for name in order),
        left_out=omitted,
        reactions=forces,
        ratios=_ratios(of, ratios, forces),
    )
    results = [name for name, *_ in (*layout.forces, *layout.ratios)]
    for name in results:
        if results.count(name) > 1:
            raise FormulaError(
                f"{of}: two forces or ratios are named {name!r}; rename one in reactions or ratios "
                "(drive_s is the force on a coordinate s that reactions does not name)"
            )
    return layout


def _check_clashes(of: str, free: dict, moved: dict, controls: Sequence[str]) -> None:
    both = [name for name in free if name in moved]
    if both:
        raise FormulaError(f"{of}: {both[0]!r} is free and prescribed; a coordinate can only be one of these")
    names = {**free, **moved}
    for name in names:
        for ending in ("_dot", "_ddot"):
            if name + ending in names:
                raise FormulaError(
                    f"{of}: the coordinate {name + ending!r} has the name of a derivative of {name!r}; "
                    "declare coordinates only; their rates are named after them"
                )
    for control in controls:
        for name in free:
            if control in (name, f"{name}_dot", f"{name}_ddot"):
                raise FormulaError(
                    f"{of}: the control {control!r} would set the free coordinate {name!r}; move {name!r} to "
                    "prescribed, or let a force of another name act on it in applied"
                )


def _held(of: str, name: str, driven: Mapping[str, str]) -> Prescribed:
    found = [(name + ending, level) for ending, level in _ENDINGS if name + ending in driven]
    if len(found) > 1:
        raise FormulaError(
            f"{of}: the controls {found[0][0]!r} and {found[1][0]!r} both set {name!r}; keep one of them"
        )
    return Prescribed(name, found[0][1], found[0][0]) if found else Prescribed(name, "rest", "")


def _full_state(free: dict, moved: dict, held: Sequence[Prescribed]) -> list[StateEntry]:
    entries = []
    for name, level, _ in held:
        if level in ("acceleration", "rate"):
            entries.append(StateEntry(name, "place", name, moved[name]))
        if level == "acceleration":
            entries.append(StateEntry(f"{name}_dot", "velocity", name, rate_unit(moved[name])))
    jumps = any(p.level == "rate" for p in held)
    for name, unit in free.items():
        entries.append(StateEntry(name, "place", name, unit))
        if jumps:
            carried = "w" if len(free) == 1 else f"w_{name}"
            entries.append(StateEntry(carried, "momentum", name, rate_unit(unit)))
        else:
            entries.append(StateEntry(f"{name}_dot", "velocity", name, rate_unit(unit)))
    return entries


def rate_unit(unit: str) -> str:
    """Return the unit of a rate."""
    return f"{unit or '1'}/s"


def _check_left_out(of: str, omitted: Sequence[str], full: Sequence[StateEntry], free: dict) -> None:
    by_name = {entry.name: entry for entry in full}
    for name in omitted:
        if name not in by_name:
            raise FormulaError(f"{of}.left_out: {name!r} is not among the state's {', '.join(by_name)}")
        entry = by_name[name]
        if entry.kind == "place":
            continue
        if entry.coordinate in free:
            raise FormulaError(
                f"{of}.left_out: {name!r} is the rate of a free coordinate, which moves by itself"
            )
        if entry.coordinate not in omitted:
            raise FormulaError(
                f"{of}.left_out: {entry.coordinate!r} follows from {name!r}; leave out both, or neither"
            )


def _reactions(of: str, declared: Any, moved: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    if not isinstance(declared, Mapping):
        raise FormulaError(f"{of}.reactions must map names to prescribed coordinates, got {declared!r:.80}")
    for name, coordinate in declared.items():
        check_name(f"{of}.reactions", name)
        if coordinate not in moved:
            raise FormulaError(
                f"{of}.reactions: {name!r} is the force on {coordinate!r}, which is not in prescribed "
                f"({', '.join(moved) or 'empty'})"
            )
    return tuple(declared.items())


def _ratios(of: str, declared: Any, forces: Sequence[tuple[str, str]]) -> tuple[tuple[str, str, str], ...]:
    names = [name for name, _ in forces]
    found = []
    if not isinstance(declared, Mapping):
        raise FormulaError(f"{of}.ratios must map names to (friction, normal), got {declared!r:.80}")
    for name, pair in declared.items():
        check_name(f"{of}.ratios", name)
        if isinstance(pair, str) or not isinstance(pair, Sequence) or len(pair) != 2:
            raise FormulaError(f'{of}.ratios: {name!r} must be a pair ("friction", "normal"), got {pair!r}')
        unknown = [force for force in pair if force not in names]
        if unknown:
            raise FormulaError(
                f"{of}.ratios: {name!r} uses {unknown[0]!r}, which is not in reactions ({', '.join(names)})"
            )
        found.append((name, pair[0], pair[1]))
    return tuple(found)
