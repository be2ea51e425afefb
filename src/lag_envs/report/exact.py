"""Exact ends of a scene's motions: Lagrange's equations by SymPy, series in python-flint's ball arithmetic.

Only the scene's energies and names are taken from the package; derivation, series and arithmetic are others'.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from lag_envs.mechanics.recording import Values, twin
from lag_envs.report import reference
from lag_envs.scenes.base import Scene
from lag_envs.store import write

Array = NDArray[np.float64]
#: Bits of the arithmetic, coefficients of a series, and digits to which two computations have to agree.
BITS, ORDER, DIGITS = 170, 30, 20
#: A step is cut into so many pieces at most.
MOST_PIECES = 2**7

_FUNCTIONS = {
    f: f.__name__ for f in (sympy.sin, sympy.cos, sympy.tan, sympy.exp, sympy.log, sympy.atan, sympy.tanh)
}
#: The functions of a formula on SymPy's expressions.
SYMBOLIC = SimpleNamespace(
    pi=sympy.pi, sqrt=sympy.sqrt, arctan=sympy.atan, **{name: f for f, name in _FUNCTIONS.items()}
)
#: The same on floats and arrays.
FLOATS = SimpleNamespace(
    number=float,
    atan=np.arctan,
    **{n: getattr(np, n) for n in ("sin", "cos", "tan", "exp", "log", "tanh", "sqrt")},
)


class Unresolved(ArithmeticError):
    """No exact end was found: the motion is singular on the way, or nearly so."""


def evaluate(expression: Any, values: Mapping[Any, Any], xp: Any) -> Any:
    """Return the value of a SymPy expression on numbers of any kind.

    Parameters
    ----------
    expression : sympy.Expr
        What to evaluate.
    values : mapping
        A number for each symbol.
    xp : namespace
        Functions of these numbers, and ``number(float)``, which makes one.
    """
    if expression in values:
        return values[expression]
    if expression.is_Integer:
        return int(expression)
    if expression.is_Rational:
        return xp.number(int(expression.p)) / int(expression.q)
    if expression.is_number:
        return xp.number(float(expression))
    if expression.is_Pow:
        base, exponent = expression.args
        value, whole = evaluate(base, values, xp), 2 * exponent
        if not whole.is_Integer:
            raise ValueError(f"the power {expression} is neither whole nor a half")
        if not exponent.is_Integer:
            value = xp.sqrt(value)
        times = int(exponent if exponent.is_Integer else whole)
        power = value
        for _ in range(abs(times) - 1):
            power = power * value
        return power if times > 0 else 1 / power
    given = [evaluate(a, values, xp) for a in expression.args]
    if expression.is_Add or expression.is_Mul:
        total = given[0]
        for value in given[1:]:
            total = total + value if expression.is_Add else total * value
        return total
    return getattr(xp, _FUNCTIONS[expression.func])(given[0])


class Motion:
    """Lagrange's equations of a scene, M a = f, as SymPy derives them from its energies.

    Parameters
    ----------
    scene : Scene
        The scene.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        layout = self.layout = scene._layout
        names, moved = layout.free, [p.name for p in layout.prescribed]
        parameters = {name: sympy.Symbol(f"p_{name}", positive=True) for name in scene._numbers()}
        copy = twin(scene, parameters)
        rests = copy.rests()
        q = {name: sympy.Symbol(f"q_{name}", real=True) for name in (*names, *moved)}
        v = {name: sympy.Symbol(f"v_{name}", real=True) for name in (*names, *moved)}
        u = {name: sympy.Symbol(f"u_{name}", real=True) for name in layout.controls}
        places, rates = (
            Values(
                "coordinate", q | {p.name: sympy.sympify(rests.get(p.name, 0)) for p in layout.at("rest")}
            ),
            Values("velocity", v | {p.name: sympy.Integer(0) for p in layout.at("rest")}),
        )
        held = Values("control", u, dict.fromkeys(layout.absent, sympy.Integer(0)))
        energy = copy.kinetic(places, rates, SYMBOLIC) - copy.potential(places, SYMBOLIC)
        loss = sympy.sympify(copy.dissipation(places, rates, held, SYMBOLIC))
        push = copy.applied(places, rates, held, SYMBOLIC)
        momenta = [sympy.diff(energy, v[name]) for name in names]
        moving = [p.name for p in layout.at("acceleration", "rate")]
        force = []
        for name, momentum in zip(names, momenta, strict=True):
            total = sympy.diff(energy, q[name]) - sympy.diff(loss, v[name]) + push.get(name, 0)
            for other in (*names, *moving):
                total -= sympy.diff(momentum, q[other]) * v[other]
            for p in layout.at("acceleration"):
                total -= sympy.diff(momentum, v[p.name]) * u[p.control or ""]
            force.append(total)
        self._mass = [sympy.diff(p, v[name]) for p in momenta for name in names]
        self._coupling = [sympy.diff(p, v[m.name]) for p in momenta for m in layout.at("rate")]
        self._names, self._u, self._q, self._v = names, u, q, v
        self._parameters = {symbol: getattr(scene, name) for name, symbol in parameters.items()}
        self._shared, self._found = sympy.cse([*self._mass, *force, *self._coupling])

    def terms(
        self, q: Mapping[str, Any], v: Mapping[str, Any], u: Sequence, xp: Any
    ) -> tuple[list, list, list]:
        """Return rows of M, f, and rows of the mass matrix between free coordinates and held rates.

        Parameters
        ----------
        q, v : mapping
            Places and velocities of all coordinates that do not rest, by name.
        u : sequence
            The controls.
        xp : namespace
            As for `evaluate`.
        """
        values = {symbol: xp.number(float(value)) for symbol, value in self._parameters.items()}
        values |= {self._q[name]: x for name, x in q.items()} | {self._v[name]: x for name, x in v.items()}
        values |= dict(zip(self._u.values(), u, strict=True))
        for symbol, expression in self._shared:
            values[symbol] = evaluate(expression, values, xp)
        found = [evaluate(expression, values, xp) for expression in self._found]
        n, rates = len(self._names), len(self.layout.at("rate"))
        rest = found[n * n + n :]
        return (
            [found[i * n : (i + 1) * n] for i in range(n)],
            found[n * n : n * n + n],
            [rest[i * rates : (i + 1) * rates] for i in range(n)],
        )

    # --- floats ---------------------------------------------------------------------------------------------

    def at(self, state: Sequence[float], controls: Sequence[float]) -> tuple[Array, Array]:
        """Return mass matrix and accelerations at a state without held rates, in floats."""
        given = dict(zip((e.name for e in self.layout.state), state, strict=True))
        held = dict(zip(self.layout.controls, controls, strict=True))
        q, v = self._start(given, held, float)
        mass, force, _ = self.terms(q, v, list(controls), FLOATS)
        matrix = np.array(mass, dtype=np.float64)
        return matrix, np.array(solve(matrix.tolist(), force), dtype=np.float64)

    def _start(
        self, given: Mapping[str, Any], held: Mapping[str, Any], number: Callable
    ) -> tuple[dict, dict]:
        """Return places and velocities of all coordinates; w stands for the velocity where a rate is held."""
        zero = number(0.0)
        q = {name: given.get(name, zero) for name in self._names}
        v = {
            e.coordinate: given[e.name]
            for e in self.layout.state
            if e.kind != "place" and e.coordinate in self._names
        }
        for p in self.layout.prescribed:
            if p.level == "place":
                q[p.name], v[p.name] = held[p.control or ""], zero
            elif p.level == "rate":
                q[p.name], v[p.name] = given.get(p.name, zero), held[p.control or ""]
            elif p.level == "acceleration":
                q[p.name], v[p.name] = given.get(p.name, zero), given.get(f"{p.name}_dot", zero)
        return q, v

    # --- balls ----------------------------------------------------------------------------------------------

    @cached_property
    def _balls(self) -> SimpleNamespace:
        """Return the functions on series of balls."""
        import flint

        def tanh(x: Any) -> Any:
            e = (2 * x).exp()
            return (e - 1) / (e + 1)

        of = {
            name: getattr(flint.arb_series, name)
            for name in ("sin", "cos", "tan", "exp", "log", "atan", "sqrt")
        }
        return SimpleNamespace(number=lambda x: flint.arb_series([flint.arb(x)]), tanh=tanh, **of)

    def end(self, state: Sequence[float], controls: Sequence[float], dt: float) -> list[Any]:
        """Return the state at the end of a control step, as balls.

        Entries on which two computations, by pieces of two lengths, agree to 10**-`DIGITS` times
        max(1, abs(entry)).

        Raises
        ------
        Unresolved
            Where they do not agree, however many pieces there are.
        """
        import flint

        with flint.ctx.workprec(BITS):
            cap = flint.ctx.cap
            try:
                pieces, coarse = 4, None
                while pieces <= MOST_PIECES:
                    try:
                        fine = self._end(state, controls, dt, pieces)
                    except (ValueError, ZeroDivisionError):
                        fine = None  # a ball in a denominator, or under a root, has grown over 0
                    if coarse and fine and all(_agree(a, b) for a, b in zip(coarse, fine, strict=True)):
                        return fine
                    pieces, coarse = 2 * pieces, fine
            finally:
                flint.ctx.cap = cap
        raise Unresolved(f"{MOST_PIECES} pieces do not resolve the motion from {tuple(state)}")

    def _end(self, state: Sequence[float], controls: Sequence[float], dt: float, pieces: int) -> list[Any]:
        from flint import arb

        u = [arb(float(x)) for x in controls]
        held = dict(zip(self.layout.controls, u, strict=True))
        given = {e.name: arb(float(x)) for e, x in zip(self.layout.state, state, strict=True)}
        q, v = self._start(given, held, arb)
        v = self._shifted(q, v, u, -1)
        h = arb(float(dt)) / pieces
        for _ in range(pieces):
            q, v = self._piece(q, v, u, held, h)
        v = self._shifted(q, v, u, 1)
        ends = {e.name: (q if e.kind == "place" else v)[e.coordinate] for e in self.layout.state}
        return list(ends.values())

    def shift(self, q: Mapping[str, Any], v: Mapping[str, Any], u: Sequence, xp: Any) -> list:
        """Return M⁻¹ G ṡ of the rates that are held, which w has more than the velocities."""
        mass, _, coupling = self.terms(q, v, u, xp)
        rates = [v[p.name] for p in self.layout.at("rate")]
        right = [sum((g * s for g, s in zip(row, rates, strict=True)), 0.0 * rates[0]) for row in coupling]
        return solve(mass, right)

    def _shifted(self, q: dict, v: dict, u: Sequence, sign: int) -> dict:
        """Return velocities with what `shift` returns added or taken away."""
        import flint

        if not self.layout.at("rate"):
            return v
        flint.ctx.cap = 1
        places, rates = ({name: flint.arb_series([x]) for name, x in given.items()} for given in (q, v))
        shift = self.shift(places, rates, [flint.arb_series([x]) for x in u], self._balls)
        return v | {name: v[name] + sign * _series(s)[0] for name, s in zip(self._names, shift, strict=True)}

    def _piece(self, q: dict, v: dict, u: Sequence, held: Mapping, h: Any) -> tuple[dict, dict]:
        """Return places and velocities after a time h, by Picard's iteration on series in units of h.

        Each iteration makes one more coefficient exact.
        """
        import flint

        names = self._names
        moved: dict[str, tuple[Any, Any]] = {}
        flint.ctx.cap = ORDER + 2
        for p in self.layout.at("acceleration", "rate", "place"):
            rate = v[p.name]
            push = held[p.control or ""] if p.level == "acceleration" else 0 * rate
            moved[p.name] = (
                flint.arb_series([q[p.name], h * rate, h * h * push / 2]), flint.arb_series([rate, h * push])
            )  # fmt: skip
        x = {name: flint.arb_series([q[name]]) for name in names}
        w = {name: flint.arb_series([v[name]]) for name in names}
        for known in range(1, ORDER + 1):
            flint.ctx.cap = known
            mass, force, _ = self.terms(
                x | {name: s for name, (s, _) in moved.items()},
                w | {name: s for name, (_, s) in moved.items()},
                [flint.arb_series([value]) for value in u],
                self._balls,
            )
            rates = solve(mass, force)
            flint.ctx.cap = known + 1
            x = {name: (w[name] * h).integral() + q[name] for name in names}
            w = {name: (_series(a) * h).integral() + v[name] for name, a in zip(names, rates, strict=True)}
        sums = [
            {name: sum(series.coeffs(), flint.arb(0)) for name, series in found.items()}
            for found in (
                x | {n: s for n, (s, _) in moved.items()},
                w | {n: s for n, (_, s) in moved.items()},
            )
        ]
        return sums[0], sums[1]


def _series(value: Any) -> Any:
    import flint

    return value if isinstance(value, flint.arb_series) else flint.arb_series([value])


def _agree(a: Any, b: Any) -> bool:
    """Tell whether two balls are finite and their differences small; comparisons of balls are certain."""
    return bool(abs(a - b) < 10.0**-DIGITS * (1 + abs(b)))


def solve(matrix: Sequence[Sequence], right: Sequence) -> list:
    """Return the solution of a small positive system, by elimination on numbers of any kind."""
    n = len(right)
    rows = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for i in range(n):
        for j in range(i + 1, n):
            factor = rows[j][i] / rows[i][i]
            rows[j] = [x - factor * y for x, y in zip(rows[j], rows[i], strict=True)]
    found: list = [None] * n
    for i in reversed(range(n)):
        total = rows[i][n]
        for j in range(i + 1, n):
            total = total - rows[i][j] * found[j]
        found[i] = total / rows[i][i]
    return found


@lru_cache(maxsize=16)
def motion_of(scene: Scene) -> Motion:
    """Return the scene's equations by SymPy."""
    return Motion(scene)


def ends(scene: Scene, states: Array, controls: Array, dt: float) -> tuple[Array, Array]:
    """Return the exact ends of control steps in two parts, whose sum has twice the digits of a float.

    The processes of a report share them in `reference.store`.

    Parameters
    ----------
    scene : Scene
        The scene.
    states : ndarray, shape (n, n_state)
        Starts.
    controls : ndarray, shape (n, n_controls)
        Controls.
    dt : float
        Length of the step [s].
    """
    problem = repr((type(scene), scene, states.tobytes(), controls.tobytes(), float(dt).hex()))
    name = hashlib.sha256(problem.encode()).hexdigest()[:24]
    file = reference.store and reference.store / f"{name}.json"
    if file and file.exists():
        high, low = np.array(json.loads(file.read_text(encoding="utf-8")))
        return high, low
    motion = motion_of(scene)
    found = [motion.end(y, u, dt) for y, u in zip(states.tolist(), controls.tolist(), strict=True)]
    high = np.array([[float(x) for x in row] for row in found]).reshape(states.shape)
    low = np.array([[float(x - float(x)) for x in row] for row in found]).reshape(states.shape)
    if file:
        write(file, json.dumps([high.tolist(), low.tolist()]))
    return high, low
