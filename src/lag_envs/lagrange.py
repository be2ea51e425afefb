"""SymPy's side of a scene: the Lagrangian, Euler-Lagrange equations and the equation of motion.

The expressions are made by passing symbols through the very functions that the numbers pass through.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, TypeVar

import sympy

from lag_envs.scenes.base import Scene

S = TypeVar("S", bound=Scene)
t = sympy.Symbol("t", real=True)


def symbolic(scene: S) -> S:
    """Return a copy of the scene whose parameters are positive symbols of their names."""
    twin = object.__new__(type(scene))
    for field in dataclasses.fields(scene):
        value = getattr(scene, field.name)
        if "unit" in field.metadata and value is not None:
            value = sympy.Symbol(field.name, positive=True)
        object.__setattr__(twin, field.name, value)
    return twin


def coordinates(scene: Scene) -> tuple[SimpleNamespace, SimpleNamespace]:
    """Return the scene's coordinates as functions of time, and their velocities."""
    q = {name: sympy.Function(name, real=True)(t) for name in scene.coordinates}
    return SimpleNamespace(**q), SimpleNamespace(**{name: f.diff(t) for name, f in q.items()})


def lagrangian(scene: Scene) -> sympy.Expr:
    """Return T - V of the scene with symbols for its parameters."""
    twin = symbolic(scene)
    q, v = coordinates(scene)
    return sympy.nsimplify(twin.kinetic(q, v, sympy) - twin.potential(q, sympy))


def euler_lagrange(scene: Scene, coordinate: str, control: Any = 0) -> sympy.Expr:
    """Return d/dt ∂L/∂q' - ∂L/∂q + ∂(dissipation)/∂q': zero for a free coordinate, else the drive's force.

    Parameters
    ----------
    scene : Scene
        The scene; its numbers do not matter.
    coordinate : str
        One of its `coordinates`.
    control : symbol, optional
        The control, where drag depends on it.
    """
    q, v = coordinates(scene)
    dissipation = sympy.nsimplify(symbolic(scene).dissipation(v, control))
    of, rate = getattr(q, coordinate), getattr(v, coordinate)
    energy = lagrangian(scene)
    return sympy.expand(energy.diff(rate).diff(t) - energy.diff(of) + dissipation.diff(rate))


def acceleration(scene: Scene, control: Any = 0) -> sympy.Expr:
    """Return the free coordinate's acceleration, solved from its Euler-Lagrange equation."""
    free = scene.coordinates[0]
    second = getattr(coordinates(scene)[0], free).diff(t, 2)
    equation = euler_lagrange(scene, free, control)
    inertia = equation.coeff(second)
    return sympy.factor_terms((inertia * second - equation).expand() / inertia)
