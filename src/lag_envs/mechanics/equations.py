"""Lagrange's equations of a recorded scene.

With T = ½ Σ G_bc v_b v_c + Σ b_c v_c + T₀, over the free and the prescribed coordinates together, p_i =
∂T/∂v_i and Rayleigh's function D, Lagrange's equation of coordinate i is::

    Σ_j G_ij a_j + Σ_c ∂p_i/∂q_c v_c − ∂T/∂q_i + ∂V/∂q_i + ∂D/∂v_i − Q_i = F_i

For a free coordinate F_i = 0, and the equation gives the accelerations; for a prescribed one F_i is the force
that moves or holds it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

from lag_envs.mechanics.algebra import Atom, Expr, FormulaError, derivative
from lag_envs.mechanics.identities import apply_identities


def place(name: str) -> Atom:
    """Return the symbol of a coordinate."""
    return Atom("place", name)


def velocity(name: str) -> Atom:
    """Return the symbol of a coordinate's rate."""
    return Atom("velocity", name)


@dataclasses.dataclass(frozen=True)
class Energies:
    """The results of a scene's formulas on recorded numbers.

    ``applied`` holds the generalised forces by coordinate.
    """

    kinetic: Expr
    potential: Expr
    dissipation: Expr
    applied: Mapping[str, Expr]


@dataclasses.dataclass(frozen=True)
class EquationsOfMotion:
    """The equations of motion ``Σ_j mass[i, j] a_j = force[i]``.

    Attributes
    ----------
    coordinates : tuple of str
        The free coordinates, then the prescribed ones.
    mass : dict
        Entries G_ij with i <= j, over all coordinates; those that vanish are left out.
    force : tuple of Expr
        For each coordinate, the whole equation except Σ_j G_ij a_j, moved to the right-hand side.
    """

    coordinates: tuple[str, ...]
    mass: Mapping[tuple[int, int], Expr]
    force: tuple[Expr, ...]

    def entry(self, i: int, j: int) -> Expr:
        """Return G_ij."""
        return self.mass.get((min(i, j), max(i, j)), Expr({}))


def _degree(monomial: Sequence[tuple[Atom, int]]) -> int:
    return sum(n for atom, n in monomial if atom.kind == "velocity" or _is_power(atom, n))


def _is_power(atom: Atom, n: int) -> bool:
    """Return whether this is a sum of velocities raised to a power."""
    return n > 0 and atom.function == "sum" and any(s.kind == "velocity" for s in Expr.of(atom).symbols())


def derive(free: Sequence[str], prescribed: Sequence[str], energies: Energies) -> EquationsOfMotion:
    """Derive Lagrange's equations.

    Parameters
    ----------
    free, prescribed : sequence of str
        Names of the coordinates.
    energies : Energies
        The scene's formulas in the symbols `place` and `velocity` of these coordinates.

    Raises
    ------
    FormulaError
        If the kinetic energy is not a polynomial of degree two in the velocities, or lacks a coordinate.
    """
    names = (*free, *prescribed)
    kinetic = apply_identities(energies.kinetic)
    _check_velocities(kinetic)
    _check_no_velocity("potential", energies.potential)
    momenta = [derivative(kinetic, velocity(name)) for name in names]
    mass: dict[tuple[int, int], Expr] = {}
    for i in range(len(names)):
        for j in range(i, len(names)):
            entry = apply_identities(derivative(momenta[i], velocity(names[j])))
            if entry.terms:
                mass[i, j] = entry
    for i, name in enumerate(free):
        if (i, i) not in mass:
            raise FormulaError(
                f"kinetic does not contain the rate of {name!r} squared, so nothing determines its "
                f"acceleration; give it a mass, or prescribe {name!r}"
            )
    force = []
    for name, momentum in zip(names, momenta, strict=True):
        q, v = place(name), velocity(name)
        convective = time_derivative(momentum, names)
        total = derivative(kinetic, q) - convective - derivative(energies.potential, q)
        total = total - derivative(energies.dissipation, v) + energies.applied.get(name, Expr({}))
        force.append(apply_identities(total))
    return EquationsOfMotion(names, mass, tuple(force))


def time_derivative(expr: Expr, names: Iterable[str]) -> Expr:
    """Return Σ ∂e/∂q q', the part of the time derivative that comes from these places."""
    total = Expr({})
    for name in names:
        total = total + derivative(expr, place(name)) * velocity(name)
    return total


def _check_velocities(kinetic: Expr) -> None:
    for monomial in kinetic.terms:
        for atom, n in monomial:
            inside = atom.argument is not None and any(s.kind == "velocity" for s in atom.argument.symbols())
            if (inside and not _is_power(atom, n)) or (atom.kind == "velocity" and n < 0):
                what = atom.text if inside else f"1/{atom.name}"
                raise FormulaError(
                    f"kinetic has a velocity in a function or denominator: {what:.60}; kinetic must be a "
                    "polynomial of degree two in the velocities"
                )
        if _degree(monomial) > 2:
            text = Expr({monomial: 1}).text
            raise FormulaError(
                f"kinetic has degree {_degree(monomial)} in the velocities, in {text:.60}; its degree must "
                "be at most two"
            )


def _check_no_velocity(formula: str, expr: Expr) -> None:
    for symbol in sorted(expr.symbols(), key=lambda s: s.text):
        if symbol.kind == "velocity":
            raise FormulaError(
                f"{formula} contains the velocity of {symbol.name!r}; only kinetic, dissipation and "
                "applied may contain velocities"
            )
