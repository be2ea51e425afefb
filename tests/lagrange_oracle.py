"""Lagrange's equations of a scene by SymPy and mpmath. Shares no code with `lag_envs.mechanics`."""

import dataclasses
from collections import namedtuple
from types import SimpleNamespace

import mpmath
import sympy

XP = SimpleNamespace(
    **{
        name: getattr(sympy, name)
        for name in ("sin", "cos", "tan", "atan", "tanh", "exp", "log", "sqrt", "pi")
    },
    arctan=sympy.atan,
)


class Oracle:
    """The Euler-Lagrange equations of one scene, by second derivatives of its Lagrangian.

    Attributes
    ----------
    coordinates : tuple of str
        The free coordinates, then the prescribed ones.
    controls : tuple of str
        Controls of all modes.
    """

    def __init__(self, scene):
        cls = type(scene)
        self.free, self.prescribed = tuple(scene.coordinates), tuple(scene.prescribed)
        self.coordinates = self.free + self.prescribed
        modes = scene.modes.values() if scene.modes else [scene.controls]
        self.controls = tuple(dict.fromkeys(name for controls in modes for name in controls))
        self.active = tuple(scene.modes[scene.control] if scene.modes else scene.controls)
        twin = object.__new__(cls)
        self.parameters = {}
        for field in dataclasses.fields(scene):
            value = getattr(scene, field.name)
            if "unit" in field.metadata and value is not None:
                self.parameters[field.name] = value
                value = sympy.Symbol("p_" + field.name, positive=True)
            object.__setattr__(twin, field.name, value)
        q = self._named("q", self.coordinates)
        v = self._named("v", self.coordinates)
        u = self._named("u", self.controls)
        self.symbols = [*q, *v, *u, *(sympy.Symbol("p_" + name, positive=True) for name in self.parameters)]
        exact = lambda x: sympy.nsimplify(sympy.sympify(x), rational=True)  # noqa: E731
        self.kinetic, self.potential = exact(twin.kinetic(q, v, XP)), exact(twin.potential(q, XP))
        loss, forces = exact(twin.dissipation(q, v, u, XP)), twin.applied(q, v, u, XP)
        self.rests = {name: self._function(value) for name, value in twin.rests().items()}
        lagrangian = self.kinetic - self.potential
        momenta = [lagrangian.diff(w) for w in v]
        self.mass = [[self._function(p.diff(w)) for w in v] for p in momenta]
        self.rest = []
        for i, p in enumerate(momenta):
            parts = [p.diff(x) * w for x, w in zip(q, v, strict=True)]
            parts += [-lagrangian.diff(q[i]), loss.diff(v[i]), -exact(forces.get(self.coordinates[i], 0))]
            self.rest.append([self._function(part) for part in parts])
        self.loss = self._function(sum(w * loss.diff(w) for w in v))
        self.energy = self._function(self.kinetic + self.potential)

    @staticmethod
    def _named(kind, names):
        return namedtuple(kind, names)(*(sympy.Symbol(f"{kind}_{name}", real=True) for name in names))

    def _function(self, expression):
        return sympy.lambdify(self.symbols, expression, modules="mpmath")

    def point(self, scene, generator):
        """Return random numbers for places, velocities, accelerations, controls and parameters.

        Accelerations of free coordinates are missing.
        """
        real = lambda: mpmath.mpf(generator.uniform(-1.5, 1.5))  # noqa: E731
        p = {name: mpmath.mpf(generator.uniform(0.3, 1.5)) for name in self.parameters}
        u = {name: real() if name in self.active else mpmath.mpf(0) for name in self.controls}
        q, v, a = ({name: real() for name in self.coordinates} for _ in range(3))
        zero = mpmath.mpf(0)
        for name in self.prescribed:
            if name + "_ddot" in self.active:
                a[name] = u[name + "_ddot"]
            elif name + "_dot" in self.active:
                v[name], a[name] = u[name + "_dot"], zero
            else:
                v[name] = a[name] = zero
                at_rest = self.rests.get(name, lambda *numbers: zero)
                q[name] = (
                    u[name]
                    if name in self.active
                    else at_rest(*[zero] * (len(self.symbols) - len(p)), *p.values())
                )
        for name in self.free:
            del a[name]
        return SimpleNamespace(q=q, v=v, a=a, u=u, p=p)

    def numbers(self, point):
        return [*point.q.values(), *point.v.values(), *point.u.values(), *point.p.values()]

    def residual(self, coordinate, point):
        """Return what Lagrange's equation leaves for a coordinate, and the largest of its terms."""
        i, numbers = self.coordinates.index(coordinate), self.numbers(point)
        terms = [m(*numbers) * point.a[c] for m, c in zip(self.mass[i], self.coordinates, strict=True)]
        terms += [f(*numbers) for f in self.rest[i]]
        return mpmath.fsum(terms), max([*map(abs, terms), mpmath.mpf("1e-3")])
