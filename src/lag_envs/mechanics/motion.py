"""The motion of a scene as expressions: the basis of steps, forces and powers.

Resting coordinates, held places and held rates are put in either before or after the derivation, whichever
gives the shorter result: resting coordinates leave no code.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Collection, Mapping
from functools import cached_property
from typing import Any

from lag_envs.mechanics import recording
from lag_envs.mechanics.algebra import Atom, Expr, FormulaError, derivative, substitute
from lag_envs.mechanics.equations import EquationsOfMotion, derive, place, time_derivative, velocity
from lag_envs.mechanics.identities import apply_identities
from lag_envs.mechanics.layout import Prescribed, SceneLayout
from lag_envs.mechanics.recording import SceneRecord, control, parameter, parameter_names


@dataclasses.dataclass(frozen=True)
class Mechanics:
    """The equations of motion of a scene, for its mode and its structural fields.

    The free coordinates move by ``Σ_j mass[i, j] a_j = force[i]``. The symbols in these are places and
    velocities of the free coordinates, places and velocities of prescribed coordinates with controlled
    acceleration, places of those with controlled rate, controls, and parameters. A held acceleration, rate
    or place appears as the control that sets it.

    Attributes
    ----------
    layout : SceneLayout
        Names of coordinates, controls and state.
    record : SceneRecord
        The formulas, with parameters that are 0 put in.
    mass : dict
        Entries of the mass matrix of the free coordinates, (i, j) with i <= j, without zeros.
    force : tuple of Expr
        Right-hand sides, one for each free coordinate.
    coupling : dict
        For a prescribed coordinate m with held rate, entries G_im of the mass matrix by (i, name of m): the
        state holds w = v + M⁻¹ Σ_m G_im ṡ_m.
    zeros : tuple of str
        Parameters that are 0 and occur in a denominator or a function: they are put in before the derivation.
        The terms of other parameters that are 0 are left out when code is made.
    """

    layout: SceneLayout
    record: SceneRecord
    mass: Mapping[tuple[int, int], Expr]
    force: tuple[Expr, ...]
    coupling: Mapping[tuple[int, str], Expr]
    zeros: tuple[str, ...] = ()

    @property
    def free(self) -> tuple[str, ...]:
        """Free coordinates, in order."""
        return self.layout.free

    @property
    def prescribed(self) -> tuple[Prescribed, ...]:
        """Prescribed coordinates with level and control."""
        return self.layout.prescribed

    def entry(self, i: int, j: int) -> Expr:
        """Return an entry of the mass matrix of the free coordinates."""
        return self.mass.get((min(i, j), max(i, j)), Expr({}))

    def entries(self) -> list[Expr]:
        """Return the free coordinates' mass matrix, row by row."""
        n = range(len(self.free))
        return [self.entry(i, j) for i in n for j in n]

    @cached_property
    def text(self) -> str:
        """Everything that decides a step, as text; scenes with the same text may share code."""
        mass = [f"{i} {j} {self.mass[i, j].text}" for i, j in sorted(self.mass)]
        coupling = [f"{i} {m} {self.coupling[i, m].text}" for i, m in sorted(self.coupling)]
        layout = (self.layout.free, self.layout.prescribed, self.layout.controls, self.layout.state)
        return "\n".join([repr(layout), *mass, *(f.text for f in self.force), *coupling])

    @cached_property
    def key(self) -> str:
        """A hash of `text`."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @cached_property
    def mass_rate(self) -> tuple[Expr, ...]:
        """The time derivatives of `entries`."""
        return tuple(time_derivative(entry, self.layout.names) for entry in self.entries())

    @cached_property
    def coupling_rate(self) -> dict[tuple[int, str], Expr]:
        """The time derivatives of `coupling`."""
        return {key: time_derivative(entry, self.layout.names) for key, entry in self.coupling.items()}

    @cached_property
    def _known(self) -> dict[Atom, Expr]:
        return _held(self.layout, self.record)

    @cached_property
    def applied(self) -> dict[str, Expr]:
        """Applied generalised forces by coordinate."""
        given = self.record.energies.applied
        return {name: substitute(force, self._known) for name, force in given.items()}

    @cached_property
    def drag(self) -> dict[str, Expr]:
        """∂D/∂v of each coordinate."""
        loss = self.record.energies.dissipation
        return {name: substitute(derivative(loss, velocity(name)), self._known) for name in self.layout.names}

    @cached_property
    def gyroscopic(self) -> tuple[Expr, Expr] | None:
        """T₁ and T₀, the parts of T of degree one and zero in the velocities, or None."""
        parts: list[dict] = [{}, {}]
        for monomial, c in apply_identities(self.record.energies.kinetic).terms.items():
            degree = sum(n for atom, n in monomial if atom.kind == "velocity")
            if degree < 2:
                parts[1 - degree][monomial] = c
        first, rest = (substitute(Expr(terms), self._known) for terms in parts)
        return (first, rest) if any(parts) else None

    def weight(self, name: str) -> list[Expr]:
        """Return the terms of ∂V/∂q of a coordinate without sines and cosines, which are 1 at most."""
        slope = substitute(derivative(self.record.energies.potential, place(name)), self._known)
        bare = []
        for monomial, c in slope.sorted_terms():
            bare.append(Expr({tuple((a, n) for a, n in monomial if a.function not in ("sin", "cos")): c}))
        return bare

    @cached_property
    def full(self) -> EquationsOfMotion:
        """Lagrange's equations of all coordinates, with resting ones put in after the derivation.

        The accelerations of the prescribed coordinates are not put in: see `EquationsOfMotion`. The force
        that moves or holds coordinate m is ``Σ_j entry(m, j) a_j - force[m]``.
        """
        moving = [p.name for p in self.layout.prescribed]
        found = derive(self.layout.free, moving, self.record.energies)
        mass = {ij: substitute(entry, self._known) for ij, entry in found.mass.items()}
        return EquationsOfMotion(
            found.coordinates,
            {ij: entry for ij, entry in mass.items() if entry.terms},
            tuple(substitute(f, self._known) for f in found.force),
        )


def _held(layout: SceneLayout, record: SceneRecord) -> dict[Atom, Expr]:
    """Return the known places and velocities of the prescribed coordinates under held controls."""
    values: dict[Atom, Expr] = {}
    for name, level, by in layout.prescribed:
        if level == "rest":
            values[place(name)] = record.rests.get(name, Expr.of(0))
        if level == "place":
            values[place(name)] = Expr.of(control(by))
        if level in ("rest", "place"):
            values[velocity(name)] = Expr.of(0)
        if level == "rate":
            values[velocity(name)] = Expr.of(control(by))
    return values


def derive_motion(
    scene: Any, layout: SceneLayout, found: SceneRecord, varying: Collection[str] = ()
) -> Mechanics:
    """Derive the equations of motion from the results of a scene's formulas.

    Parameters
    ----------
    scene : Scene
        The scene: its class's name for error messages, and its parameters that are 0.
    layout : SceneLayout
        Its names.
    found : SceneRecord
        Its formulas.
    varying : collection of str
        Parameters whose values are not put in even if they are 0.

    Raises
    ------
    FormulaError
        If the formulas are not valid energies, or need a coordinate that the state leaves out.
    """
    of = type(scene).__name__
    zero = {
        parameter(name): Expr.of(0)
        for name in parameter_names(scene)
        if getattr(scene, name) == 0.0
        and name not in varying
        and any(_is_hard(e, name) for e in found.exprs())
    }
    if zero:
        names = ", ".join(f"{atom.name}=0" for atom in zero)
        found = recording.restrict(found, zero, scene, f"with {names}")
    held = _held(layout, found)
    resting = {p.name for p in layout.at("rest", "place")}
    known = {atom: value for atom, value in held.items() if atom.name in resting}
    at_rest = recording.restrict(found, known, scene, "with its prescribed coordinates at rest")
    moving = [p.name for p in layout.at("acceleration", "rate")]
    try:
        equations = derive(layout.free, moving, at_rest.energies)
    except FormulaError as error:
        raise FormulaError(f"{of}.{error}") from error
    n = len(layout.free)
    force = list(equations.force[:n])
    coupling: dict[tuple[int, str], Expr] = {}
    for m, name in enumerate(moving, start=n):
        by = next(p for p in layout.prescribed if p.name == name)
        for i in range(n):
            entry = equations.entry(i, m)
            if by.level == "acceleration":
                force[i] = force[i] - entry * Expr.of(control(by.control))
            elif entry.terms:
                coupling[i, name] = entry
    mass = {(i, j): entry for (i, j), entry in equations.mass.items() if j < n}
    force = [substitute(f, held) for f in force]
    _check_left_out(of, layout, {**mass, **coupling}, force)
    return Mechanics(layout, found, mass, tuple(force), coupling, tuple(sorted(atom.name for atom in zero)))


def _is_hard(expr: Expr, name: str) -> bool:
    """Return whether formulas may differ where a parameter is 0: in a denominator, a root or a logarithm."""

    def hard(atom: Atom, power: int) -> bool:
        if atom.argument is None:
            return power < 0 and atom.name == name
        if power < 0 or atom.function in ("sqrt", "log"):
            return parameter(name) in atom.argument.symbols()
        return _is_hard(atom.argument, name)

    return any(hard(atom, n) for monomial in expr.terms for atom, n in monomial)


def _check_left_out(of: str, layout: SceneLayout, mass: Mapping, force: list[Expr]) -> None:
    omitted = set(layout.left_out)
    for expr in (*mass.values(), *force):
        for symbol in sorted(expr.symbols(), key=lambda s: s.text):
            name = {"place": symbol.name, "velocity": f"{symbol.name}_dot"}.get(symbol.kind)
            if name in omitted:
                raise FormulaError(
                    f"{of}.left_out: the motion of the free coordinates depends on {name!r}; "
                    "keep it in the state"
                )
