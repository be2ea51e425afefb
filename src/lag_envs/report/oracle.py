"""The oracle: the exact motion of any scene, from Lagrange's equations derived by SymPy.

Of the package it uses only the scene's energies, its names and their form in SymPy
(`lag_envs.scenes.symbolic`). Equations, series, arithmetic and step control share nothing with `mechanics`
and `stepping`; numbers are python-flint's balls. There are two methods:

* Taylor series, with one more coefficient by each Picard iteration on series of balls. The last coefficients
  decide the step's length. Balls enclose the effects of rounding and cancellation within a step.
* Where damping is so heavy that such steps would be far shorter than the time that is left, and once its
  boundary layer has died out: collocation at Chebyshev nodes that include the end of the step, which is
  stable for any damping, by Newton's method.

Everything is computed twice, with different digits, orders and step lengths. A result is returned only if the
two agree to the requested digits; otherwise the digits are doubled.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from operator import mul
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple

import flint
import numpy as np
import sympy
from mpmath import mp, mpf
from numpy.typing import NDArray

from lag_envs.report.formulas import FormulaSeries, OperationList
from lag_envs.scenes import symbolic
from lag_envs.scenes.base import Scene

Array = NDArray[np.float64]
#: Largest number of series for one motion; beyond it, the motion counts as unresolved.
MOST_STEPS = 5_000
#: How many times digits are doubled.
DOUBLINGS = 2
#: Collocation is tried if damping times the time that is left exceeds this.
STIFF = 300.0
#: Number of series before collocation is first tried, about as many as the boundary layer takes; before each
#: further try half as many again.
FIRST_TRY = 16
#: Numbers of extra bits against rounding within a step, tried in turn.
SPARE = (80, 240, 720)


class Unresolved(ArithmeticError):
    """Raised if the oracle cannot guarantee its result because the motion is singular or nearly singular."""


class Singular(Unresolved):
    """Raised if the steps are so short, or so many, that more digits would not help."""


class Rounded(Unresolved):
    """Raised if rounding within a step exceeds the allowed truncation error: there are too few bits."""


# --- equations ----------------------------------------------------------------------------------------------


class SceneNames(NamedTuple):
    """A scene's coordinates, controls and state, as read from their names."""

    free: tuple[str, ...]
    #: Prescribed coordinates: the control, and whether it is their acceleration, rate or place.
    moved: Mapping[str, tuple[str, str]]
    controls: tuple[str, ...]
    state: Sequence[tuple[str, str]]  #: coordinate, and "place", "velocity" or "momentum"


def names_of(scene: Scene) -> SceneNames:
    """Return the names of a scene."""
    free, controls = tuple(scene.coordinates), tuple(scene.control_names)
    moved = {
        name: (name + ending, level)
        for name in scene.prescribed
        for ending, level in (("_ddot", "acceleration"), ("_dot", "rate"), ("", "place"))
        if name + ending in controls
    }
    state = []
    for name in scene.state_names:
        if name in (*free, *moved):
            state.append((name, "place"))
        elif name.removesuffix("_dot") in (*free, *moved):
            state.append((name.removesuffix("_dot"), "velocity"))
        else:  # w, or w_<name> if several coordinates have one
            state.append((name[2:] or free[0], "momentum"))
    return SceneNames(free, moved, controls, state)


class OracleEquations:
    """Lagrange's equations M a = f of all scenes that differ only in numbers.

    Parameters
    ----------
    scene : Scene
        One of them.

    Attributes
    ----------
    mass, force, coupling : list of sympy.Expr
        Rows of M, f, and the rows of the mass matrix that couple free coordinates with held rates.
    q, v, u : dict of sympy.Symbol
        Places and velocities of all moving coordinates, and controls, by name.
    """

    def __init__(self, scene: Scene) -> None:
        names, t = names_of(scene), symbolic.t
        self.names = names
        self.rates = [name for name, (_, level) in names.moved.items() if level == "rate"]
        all_ = (*names.free, *names.moved)
        self.q, self.v, a = (
            {name: sympy.Symbol(f"{name}:{order}", real=True) for name in all_} for order in range(3)
        )
        self.u = {name: sympy.Symbol(f"u:{name}", real=True) for name in names.controls}
        places = {name: sympy.Function(name, real=True)(t) for name in all_}
        replaced: dict[Any, Any] = {sympy.Function(n, real=True)(t): u for n, u in self.u.items()}
        for name, place in places.items():
            replaced |= {place: self.q[name], place.diff(t): self.v[name], place.diff(t, 2): a[name]}
        found = [
            symbolic.euler_lagrange(scene, name, symbolic.Exact).xreplace(replaced) for name in names.free
        ]
        self.a = [a[name] for name in names.free]
        self.mass = [e.diff(symbol) for e in found for symbol in self.a]
        self.coupling = [e.diff(a[name]) for e in found for name in self.rates]
        given = dict.fromkeys(a.values(), sympy.Integer(0))
        given |= {
            a[n]: self.u[control] for n, (control, level) in names.moved.items() if level == "acceleration"
        }
        self.force = [-e.xreplace(given) for e in found]
        self.inputs = [*self.q.values(), *self.v.values()]
        self.formulas = OperationList(
            [*self.mass, *self.force, *self.coupling], self.inputs, [*self.u.values()]
        )

    @cached_property
    def residuals(self) -> OperationList:
        """M a - f, and its rows of derivatives with respect to places, velocities and accelerations."""
        n = len(self.a)
        left = [sum((self.mass[i * n + j] * self.a[j] for j in range(n)), -self.force[i]) for i in range(n)]
        of = [[symbols[name] for name in self.names.free] for symbols in (self.q, self.v)]
        slopes = [e.diff(symbol) for e in left for symbol in (*of[0], *of[1], *self.a)]
        return OperationList([*left, *slopes], [*self.inputs, *self.a], [*self.u.values()])

    @cached_property
    def damping(self) -> OperationList:
        """∂f/∂v."""
        drag = [f.diff(self.v[name]) for f in self.force for name in self.names.free]
        return OperationList(drag, self.inputs, [*self.u.values()])


_known: dict[Any, OracleEquations] = {}


def equations_of(scene: Scene) -> OracleEquations:
    """Return a scene's equations, derived once for all scenes that differ only in numbers."""
    numbers = symbolic.parameter_names(scene)
    fields = [f.name for f in dataclasses.fields(scene)]  # type: ignore[arg-type]
    key = type(scene), repr([(name, getattr(scene, name)) for name in fields if name not in numbers]), numbers
    if key not in _known:
        _known[key] = OracleEquations(scene)
    return _known[key]


# --- numbers ------------------------------------------------------------------------------------------------


#: Functions of floats and arrays, and of balls.
FLOATS = SimpleNamespace(
    atan=np.arctan,
    sin_cos=lambda x: (np.sin(x), np.cos(x)),
    **{name: getattr(np, name) for name in ("exp", "log", "sqrt")},
)
BALLS = SimpleNamespace(
    **{name: getattr(flint.arb, name) for name in ("sin_cos", "exp", "log", "atan", "sqrt")}
)


def solve_positive(rows: Sequence[Sequence], right: Sequence) -> list:
    """Return the solution of a small positive system, by elimination on numbers of any kind."""
    n = len(right)
    table = [[*row, b] for row, b in zip(rows, right, strict=True)]
    for i in range(n):
        for j in range(i + 1, n):
            factor = table[j][i] / table[i][i]
            table[j] = [x - factor * y for x, y in zip(table[j], table[i], strict=True)]
    found: list = [None] * n
    for i in reversed(range(n)):
        total = table[i][n]
        for j in range(i + 1, n):
            total = total - table[i][j] * found[j]
        found[i] = total / table[i][i]
    return found


def _ball(x: Any) -> Any:
    return x if isinstance(x, flint.arb) else flint.arb(x if isinstance(x, mpf) else float(x))


def midpoint(ball: Any) -> mpf:
    """Return a ball's midpoint as an mpmath number, without rounding."""
    mantissa, exponent = ball.mid().man_exp()
    with mp.workprec(int(mantissa).bit_length() + 1):
        return mp.ldexp(mpf(int(mantissa)), int(exponent))


class Precision(NamedTuple):
    """The precision of a computation."""

    digits: int  #: kept by each step, absolute and relative to places and velocities
    spare: int = SPARE[0]  #: extra bits; a recurrence loses some with each order

    @property
    def order(self) -> int:
        """Largest number of coefficients of a series."""
        return int(1.15 * self.digits) + 8

    @property
    def bits(self) -> int:
        """Of the arithmetic."""
        return int(3.33 * self.digits) + self.spare

    def small(self, of: Any) -> Any:
        """Return the allowed truncation error for a number of this size."""
        return flint.arb(10) ** -self.digits * (1 + abs(of).mid())


def agreed(compute: Callable[[int], list[mpf]], digits: int) -> list[mpf]:
    """Return a result with at least this many digits, once two such computations agree.

    Raises
    ------
    Unresolved
        If they do not, even with four times the digits.
    """
    working, why = digits + 12, ""
    for _ in range(DOUBLINGS + 1):
        try:
            coarse, fine = compute(working), compute(working + 9)
        except Singular:
            raise
        except Unresolved as error:
            why = str(error)
        else:
            with mp.workdps(working + 30):
                far = max(abs(a - b) / max(1, abs(b)) for a, b in zip(coarse, fine, strict=True))
                if far <= mpf(10) ** -digits:
                    return fine
            why = f"two precisions differ by {mp.nstr(far, 3)}"
        working *= 2
    raise Unresolved(why)


# --- a scene's motion ---------------------------------------------------------------------------------------


class Oracle:
    """The motion of one scene.

    Parameters
    ----------
    scene : Scene
        Its parameters are taken as exact numbers.
    numbers : mapping, optional
        Other numbers for some parameters, also taken as exact.

    Examples
    --------
    >>> from lag_envs.scenes import PivotedBar
    >>> oracle = Oracle(PivotedBar(gravity=0.0, track=None))
    >>> [float(x) for x in oracle.once((2.0, 3.0), 0.0, 0.5, digits=30)]
    [3.5, 3.0]
    """

    def __init__(self, scene: Scene, numbers: Mapping[str, Any] = MappingProxyType({})) -> None:
        self.equations = equations_of(scene)
        self.names = self.equations.names
        values = {name: getattr(scene, name) for name in symbolic.parameter_names(scene)} | dict(numbers)
        symbols = {symbol for e in (*self.equations.mass, *self.equations.force) for symbol in e.free_symbols}
        symbols |= {symbol for e in self.equations.coupling for symbol in e.free_symbols}
        self._values = {s: sympy.Rational(values[s.name]) for s in symbols if s.name in values}
        self._bound: dict[tuple[int, int], list] = {}

    def exactly(self, expression: Any) -> Any:
        """Return an expression with the scene's numbers inserted."""
        return expression.xreplace(self._values)

    def _constants(self, formulas: OperationList, bits: int) -> list:
        """Return the constants of formulas as balls with this many bits, or as floats for 0 bits."""
        key = id(formulas), bits
        if key not in self._bound:
            exact = [self.exactly(e) for e in formulas.constants]
            if bits:
                self._bound[key] = [
                    flint.arb(flint.fmpq(int(e.p), int(e.q))) if e.is_Rational else _evaluated(e, bits)
                    for e in exact
                ]
            else:
                self._bound[key] = [float(e) for e in exact]
        return self._bound[key]

    # --- in floats ---

    def terms(
        self, q: Mapping[str, Any], v: Mapping[str, Any], u: Sequence, xp: Any = FLOATS, bits: int = 0
    ) -> tuple[list, list, list]:
        """Return rows of M, f, and the rows of the mass matrix that couple free coordinates with held rates.

        Parameters
        ----------
        q, v : mapping
            Places and velocities of all coordinates that are not at rest, by name.
        u : sequence
            The controls.
        xp : namespace
            Functions for numbers of this kind.
        bits : int
            Precision of the constants; 0 for floats.
        """
        formulas, n, rates = self.equations.formulas, len(self.names.free), len(self.equations.rates)
        given = [*(q[name] for name in self.equations.q), *(v[name] for name in self.equations.v), *u]
        found = formulas.numbers(given, self._constants(formulas, bits), xp)
        rest = found[n * n + n :]
        return (
            [found[i * n : (i + 1) * n] for i in range(n)],
            found[n * n : n * n + n],
            [rest[i * rates : (i + 1) * rates] for i in range(n)],
        )

    def at(self, state: Sequence[float], controls: Sequence[float]) -> tuple[Array, Array]:
        """Return mass matrix and accelerations at a state without held rates, in floats."""
        mass, force, _ = self.terms(*self.start(state, controls, float), controls)
        matrix = np.array(mass, dtype=np.float64)
        return matrix, np.array(solve_positive(matrix.tolist(), force), dtype=np.float64)

    def start(self, state: Sequence, controls: Sequence, make: Callable) -> tuple[dict, dict]:
        """Return places and velocities of all coordinates; w replaces the velocity if a rate is held."""
        zero = make(0.0)
        q, v = (dict.fromkeys((*self.names.free, *self.names.moved), zero) for _ in range(2))
        for (name, kind), x in zip(self.names.state, state, strict=True):
            (q if kind == "place" else v)[name] = x
        held = dict(zip(self.names.controls, controls, strict=True))
        for name, (control, level) in self.names.moved.items():
            if level == "place":
                q[name], v[name] = held[control], zero
            elif level == "rate":
                v[name] = held[control]
        return q, v

    def shift(self, q: Mapping, v: Mapping, u: Sequence, xp: Any = FLOATS, bits: int = 0) -> list:
        """Return M⁻¹ G ṡ, by which w exceeds the velocities if rates ṡ are held."""
        mass, _, coupling = self.terms(q, v, u, xp, bits)
        rates = [v[name] for name in self.equations.rates]
        return solve_positive(mass, [sum(g * s for g, s in zip(row, rates, strict=True)) for row in coupling])

    # --- exact ---

    def once(self, state: Sequence, controls: Any, dt: Any, digits: int) -> list[mpf]:
        """Return the state after a time dt with the controls held, from one computation; see `agreed`.

        Parameters
        ----------
        state : sequence of float or mpf
            Start; numbers are taken as exact.
        controls : number or sequence of numbers
            The control, or the controls.
        dt : float or mpf
            The time [s], which may be much longer than a control step.
        digits : int
            Number of decimal digits that the steps keep.

        Raises
        ------
        Unresolved
            If the motion comes to a singular point, or needs too many steps.
        ValueError
            If the state or the controls do not have the scene's length.
        """
        for what, given, names in (
            ("state", state, self.names.state),
            ("controls", control_list(controls), self.names.controls),
        ):
            if len(given) != len(names):
                raise ValueError(f"{what} must have {len(names)} entries, got {len(given)}")
        for spare in SPARE:
            plan = Precision(digits, spare)
            with flint.ctx.workprec(plan.bits):
                try:
                    return [midpoint(x) for x in self._end(plan, state, controls, dt)]
                except Rounded:
                    if spare == SPARE[-1]:
                        raise
                except (ValueError, ZeroDivisionError, OverflowError) as error:
                    raise Unresolved(f"a singular point on the way: {error}") from error
        raise AssertionError(SPARE)

    def _end(self, plan: Precision, state: Sequence, controls: Any, dt: Any) -> list:
        u, left = [_ball(x) for x in control_list(controls)], _ball(dt)
        q, v = self.start([_ball(x) for x in state], u, flint.arb)
        v = self._shifted(plan, q, v, u, -1)
        h, again = left, FIRST_TRY
        for step in range(MOST_STEPS):
            if step == again:
                again += again // 2
                if self._damping(q, v, u) * float(left) > STIFF and (slow := self._slow(plan, q, v, u, left)):
                    q, v = slow
                    break
            q, v, part = self._series(plan, q, v, u, h)
            if part == 1 and h is left:
                break
            done = part * h
            if done < plan.small(flint.arb(0)) * left:
                raise Singular(f"steps shrink to nothing with {left.str(5, radius=False)} s left")
            left = (left - done).mid()
            h = left if left < 2 * done else 2 * done
        else:
            raise Singular(f"{MOST_STEPS} series end with {left.str(5, radius=False)} s left")
        v = self._shifted(plan, q, v, u, 1)
        return [(q if kind == "place" else v)[name] for name, kind in self.names.state]

    def _shifted(self, plan: Precision, q: dict, v: dict, u: Sequence, sign: int) -> dict:
        """Return velocities plus or minus the result of `shift`."""
        if not self.equations.rates:
            return v
        more = self.shift(q, v, u, BALLS, plan.bits)
        return v | {name: v[name] + sign * x for name, x in zip(self.names.free, more, strict=True)}

    def driven(self, q: Mapping, v: Mapping, u: Sequence, zero: Any) -> dict[str, list]:
        """Return place, rate and acceleration of each prescribed coordinate."""
        held = dict(zip(self.names.controls, u, strict=True))
        return {
            name: [q[name], v[name], held[control] if level == "acceleration" else zero]
            for name, (control, level) in self.names.moved.items()
        }

    def coefficients(
        self, state: Sequence, controls: Any, h: Any, count: int, digits: int
    ) -> tuple[dict[str, list[mpf]], dict[str, list[mpf]]]:
        """Return the first Taylor coefficients of places and of velocities, with time in units of h.

        Parameters
        ----------
        state, controls
            As in `once`.
        h : float or mpf
            The unit of time [s].
        count : int
            Number of coefficients, including the value at the start.
        digits : int
            Of the arithmetic.
        """
        plan = Precision(digits)
        with flint.ctx.workprec(plan.bits):
            u = [_ball(x) for x in control_list(controls)]
            q, v = self.start([_ball(x) for x in state], u, flint.arb)
            v = self._shifted(plan, q, v, u, -1)
            grown = self._coefficients(plan, q, v, u, _ball(h))
            *_, found = itertools.islice(grown, max(1, count - 1))
            places, rates = ({name: [midpoint(c) for c in of[name][:count]] for name in of} for of in found)
            return places, rates

    def _coefficients(
        self, plan: Precision, q: dict, v: dict, u: Sequence, h: Any
    ) -> Iterator[tuple[dict[str, list], dict[str, list]]]:
        """Yield the coefficients of places and velocities, with time in units of h, one order at a time."""
        free, n, zero = self.names.free, len(self.names.free), flint.arb(0)
        x, w = ({name: [value] for name, value in start.items()} for start in (q, v))
        formulas = self.equations.formulas
        inputs = [*x.values(), *w.values(), *([y] for y in u)]
        series = FormulaSeries(formulas, inputs, self._constants(formulas, plan.bits))
        mass, force = [series.found[i * n : (i + 1) * n] for i in range(n)], series.found[n * n :][:n]
        driven = {
            name: ([h * rate, h * h * held / 2], [h * held])
            for name, (_, rate, held) in self.driven(q, v, u, flint.arb(0)).items()
        }
        a: list[list] = [[] for _ in free]
        for k in itertools.count():
            series.extend()
            if k == 0:
                inverse = flint.arb_mat([[m[0] for m in row] for row in mass]).inv()
            right = []
            for row, f in zip(mass, force, strict=True):
                known = sum(sum(map(mul, m[1:], reversed(b))) for m, b in zip(row, a, strict=True))
                right.append([(f[k] if k < len(f) else zero) - known])
            found = (inverse * flint.arb_mat(right)).entries()
            for name, of, value in zip(free, a, found, strict=True):
                of.append(value)
                x[name].append(h * w[name][k] / (k + 1))
                w[name].append(h * value / (k + 1))
            for name, some in driven.items():
                for coefficients, known in zip((x, w), some, strict=True):
                    coefficients[name].append(known[k] if k < len(known) else zero)
            yield x, w

    def _series(self, plan: Precision, q: dict, v: dict, u: Sequence, h: Any) -> tuple[dict, dict, Any]:
        """Return places and velocities after a fraction of a time h, and that fraction."""
        free, part = self.names.free, flint.arb(1)
        limits = [plan.small(start[name]) for start in (q, v) for name in free]
        grown = enumerate(self._coefficients(plan, q, v, u, h), start=1)
        for k, (x, w) in itertools.islice(grown, plan.order):
            # More than two are used, since every second coefficient may vanish.
            last = [of[name][-4:] for of in (x, w) for name in free]
            if k > 6 and all(abs(c) < limit for cs, limit in zip(last, limits, strict=True) for c in cs):
                break
        else:
            shorter = (
                _shorter(j, c, limit)
                for cs, limit in zip(last, limits, strict=True)
                for j, c in enumerate(cs, start=k - 3)
            )
            part = flint.arb(min(1.0, *shorter))
        places, rates = ({name: flint.arb_poly(of[name])(part) for name in of} for of in (x, w))
        after = [of[name] for of in (places, rates) for name in free]
        if not all(y.rad() < limit for y, limit in zip(after, limits, strict=True)):
            raise Rounded("rounding within a step exceeds its allowed truncation error")
        return {n: y.mid() for n, y in places.items()}, {n: y.mid() for n, y in rates.items()}, part

    # --- heavy damping ---

    def _damping(self, q: dict, v: dict, u: Sequence) -> float:
        """Return the rate at which drag slows the motion down, about [1/s]."""
        n, formulas = len(self.names.free), self.equations.damping
        q, v = ({name: float(x) for name, x in of.items()} for of in (q, v))
        held = [float(x) for x in u]
        given = [*(q[name] for name in self.equations.q), *(v[name] for name in self.equations.v), *held]
        drag = np.reshape(formulas.numbers(given, self._constants(formulas, 0), FLOATS), (n, n))
        mass = np.array(self.terms(q, v, held)[0], dtype=np.float64)
        return float(np.abs(np.linalg.solve(mass, drag.astype(np.float64))).sum(axis=1).max())

    def _slow(self, plan: Precision, q: dict, v: dict, u: Sequence, left: Any) -> tuple[dict, dict] | None:
        """Return places and velocities after the remaining time, or None if they are not smooth."""
        h, shortest = left, left / 8
        while True:
            found = self._collocated(plan, q, v, u, h)
            if found is None:
                h = h / 2
                if h < shortest:
                    return None
                continue
            q, v = found
            if h is left:
                return q, v
            left = (left - h).mid()
            h = left if left < 2 * h else 2 * h

    def _collocated(self, plan: Precision, q: dict, v: dict, u: Sequence, h: Any) -> tuple[dict, dict] | None:
        """Return places and velocities after a time h, from one polynomial for each acceleration."""
        free, n, arb_mat = self.names.free, len(self.names.free), flint.arb_mat
        formulas, nodes = self.equations.residuals, _nodes(plan.digits, plan.bits)
        constants, count = self._constants(formulas, plan.bits), len(nodes.x)
        driven = self.driven(q, v, u, flint.arb(0))
        once, twice = (h * nodes.once).mid(), (h * h * nodes.twice).mid()
        a = arb_mat(count, n)
        limits = [plan.small(v[name]) for name in free]
        rows = list(zip(nodes.x, once.tolist(), twice.tolist(), strict=True))
        for _ in range(20):
            along, about = (once * a).tolist(), (twice * a).tolist()
            left: list[list] = []
            matrix: list[list] = []
            for i, (x, once_row, twice_row) in enumerate(rows):
                t = h * x
                q_now = {name: q[name] + t * v[name] + about[i][c] for c, name in enumerate(free)}
                v_now = {name: v[name] + along[i][c] for c, name in enumerate(free)}
                for name, (place, rate, held) in driven.items():
                    q_now[name], v_now[name] = place + t * (rate + t * held / 2), rate + t * held
                if i == 0:
                    end = q_now, v_now
                given = [*(q_now[m] for m in self.equations.q), *(v_now[m] for m in self.equations.v)]
                found = formulas.numbers([*given, *(a[i, c] for c in range(n)), *u], constants, BALLS)
                left += [[x.mid()] for x in found[:n]]
                for c in range(n):
                    by_q, by_v, by_a = (found[n + 3 * n * c + part * n :][:n] for part in range(3))
                    row = []
                    for d in range(n):
                        row += [by_q[d] * y + by_v[d] * z for y, z in zip(twice_row, once_row, strict=True)]
                        row[d * count + i] += by_a[d]
                    matrix.append(row)
            change = arb_mat(matrix).mid().solve(arb_mat(left), algorithm="approx").tolist()
            by_node = [[change[c * count + i][0] for c in range(n)] for i in range(count)]
            a = (a - arb_mat(by_node)).mid()
            if all(abs(h * x) < limit for row in by_node for x, limit in zip(row, limits, strict=True)):
                break
        else:
            return None
        along = once * a
        # Check smoothness: a polynomial misses the start because of a layer that has died out long before the
        # end.
        rest, first = nodes.last * along, nodes.first * along
        for c, name in enumerate(free):
            smooth = all(abs(rest[k, c]) < 10 * limits[c] for k in range(rest.nrows()))
            if not (smooth and abs(h * first[0, c]) < 10 * plan.small(q[name])):
                return None
        q_end, v_end = ({name: x.mid() for name, x in of.items()} for of in end)
        return q_end, v_end


def control_list(controls: Any) -> list:
    """Return the controls as a list; a single control may be given as a number."""
    return list(controls) if isinstance(controls, Sequence | np.ndarray) else [controls]


def _shorter(order: int, coefficient: Any, limit: Any) -> float:
    """Return the fraction of a step at which the coefficient of that order is just small enough."""
    size = coefficient.abs_upper()
    if not size.is_finite():
        raise Unresolved("a coefficient of the series is not finite")
    return math.exp(float((limit / size).log()) / order) if size > 0 else 1.0


def _evaluated(expression: Any, bits: int) -> Any:
    with mp.workprec(bits + 10):
        return flint.arb(mp.make_mpf(expression.evalf(int(0.302 * bits) + 6)._mpf_))


class Nodes(NamedTuple):
    """Collocation nodes of a polynomial on [0, 1]: Chebyshev's, including one end."""

    x: Sequence[Any]  #: the first is 1
    once: Any  #: integrals from 0 to the nodes, from values at the nodes
    twice: Any  #: integrals of these
    last: Any  #: the last Chebyshev coefficients, from values at the nodes
    first: Any  #: the value at 0


@lru_cache(maxsize=16)
def _nodes(count: int, bits: int) -> Nodes:
    arb, arb_mat = flint.arb, flint.arb_mat
    with flint.ctx.workprec(bits + 16 * count):  # the inverse loses 11 bits for each node
        turns = [arb.pi() * (2 * i) / (2 * count - 1) for i in range(count)]
        x = [(1 + turn.cos()) / 2 for turn in turns]
        back = arb_mat([[at**j for j in range(count)] for at in x]).inv()
        once = arb_mat([[at ** (j + 1) / (j + 1) for j in range(count)] for at in x]) * back
        twice = arb_mat([[at ** (j + 2) / ((j + 1) * (j + 2)) for j in range(count)] for at in x]) * back
        waves = arb_mat([[(j * turn).cos() for j in range(count)] for turn in turns]).inv().tolist()
        first = arb_mat(back.tolist()[:1])
        return Nodes([at.mid() for at in x], once.mid(), twice.mid(), arb_mat(waves[-4:]).mid(), first.mid())


@lru_cache(maxsize=64)
def oracle_of(scene: Scene) -> Oracle:
    """Return the scene's oracle."""
    return Oracle(scene)
