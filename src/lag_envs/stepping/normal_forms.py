"""Equations of motion that have an exact flow of their own, recognised from the derived equations.

For one free coordinate of constant inertia there are three (`lag_envs.stepping.flows`)::

    driven pendulum   q'' = -alpha sin(q) - beta cos(q) - gamma q' + delta + ramp t
    fixed slope       x'' = acceleration - damping_rate x'
    turning slope     x'' = gravity sin(phi) + centrifugal phi'² x - damping_rate x',  phi' held

Each coefficient is a sum of terms: a constant, computed from the parameters, times a quantity that is held
during the step. Any other equation is stepped by the general series (`lag_envs.stepping.general`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lag_envs.mechanics.algebra import Atom, Expr, Monomial, derivative, evaluate
from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.evaluation import Exact, exactly
from lag_envs.mechanics.layout import SceneLayout
from lag_envs.mechanics.motion import Mechanics
from lag_envs.mechanics.recording import control, parameter
from lag_envs.stepping import pendulum, slope
from lag_envs.stepping.flows import SLIDE, TURN, Flow, pendulum_flow
from lag_envs.stepping.general import StepBound
from lag_envs.stepping.tracing import Trace


class CoefficientTerm(NamedTuple):
    """A term of a coefficient: a constant, by name, times a quantity that is held during the step."""

    constant: str
    held: Expr


@dataclasses.dataclass(frozen=True, eq=False)
class NormalForm:
    """An equation of motion with an exact flow of its own.

    The lifted state is the scene's, followed by cosine and sine of its angle if it has one.

    Attributes
    ----------
    kind : type
        The flow's coefficients.
    layout : SceneLayout
        Names of coordinates, controls and state.
    terms : mapping
        For each coefficient its terms.
    expressions : mapping
        Each constant as an expression, times the inertia.
    inertia : Expr
        The free coordinate's entry of the mass matrix.
    chosen : int
        Order of the flow's series, if it has one; with 0 the control step determines the order.
    """

    kind: ClassVar[type[Any]]
    layout: SceneLayout
    terms: Mapping[str, tuple[CoefficientTerm, ...]]
    expressions: Mapping[str, Expr]
    inertia: Expr
    chosen: int = 0

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries."""
        return tuple(entry.name for entry in self.layout.state)

    @property
    def angle(self) -> int | None:
        """Index of the state's entry whose cosine and sine are carried along, or None."""
        return None

    @property
    def width(self) -> int:
        """Number of entries of the lifted state."""
        return len(self.layout.state) + (0 if self.angle is None else 2)

    def _index(self, coordinate: str, *kinds: str) -> int:
        return next(
            i for i, e in enumerate(self.layout.state) if e.coordinate == coordinate and e.kind in kinds
        )

    def order(self, dt: float) -> int:
        """Return the order of the flow's series for a control step; 0 if it has no series."""
        return 0

    def flow(self, dt: float) -> Flow:
        """Return the exact flow for control steps of this length."""
        raise NotImplementedError

    def constants(self, parameters: Mapping[str, float], functions: Any = math) -> dict[str, float]:
        """Return the constants, each rounded once; `functions` has sine, cosine and so on."""
        numbers = evaluate([self.inertia, *self.expressions.values()], exactly(parameters), Exact(functions))
        return {name: _float(x, numbers[0]) for name, x in zip(self.expressions, numbers[1:], strict=True)}

    # --- one control step ----------------------------------------------------------------------------------

    def lift(self, state: ArrayLike) -> tuple:
        """Return the state's entries, each of shape (...), followed by cosine and sine of the angle."""
        return tuple(lifted(self, np.moveaxis(np.asarray(state, dtype=np.float64), -1, 0), np))

    def coefficients_at(self, y: Sequence, u: Sequence, k: Any, xp: Any) -> Any:
        """Return the flow's coefficients under held controls, from lifted state and constants."""
        values: dict[Atom, Any] = {control(name): x for name, x in zip(self.layout.controls, u, strict=True)}
        for entry, x in zip(self.layout.state, y, strict=False):
            if entry.kind == "velocity":
                values[velocity(entry.coordinate)] = x
        found = {}
        for name, terms in self.terms.items():
            total: Any = 0.0
            for term in terms:
                constant = getattr(k, term.constant)
                held = evaluate([term.held], values, xp)[0]
                total = total + (constant if term.held.number == 1.0 else constant * held)
            found[name] = total
        return self.kind(**found, **self._held(u))

    def _held(self, u: Sequence) -> Mapping[str, Any]:
        """Return the coefficients that are controls."""
        return {}

    def _carried(self, u: Sequence, k: Any) -> Any:
        """Return the part of the momentum that does not come from the free coordinate's velocity."""
        return 0.0

    def unpack(self, y: Sequence, u: Sequence, k: Any) -> list:
        """Return the flow's variables: place and velocity, and cosine and sine of the angle."""
        free = self.layout.free[0]
        q, v = y[self._index(free, "place")], y[self._index(free, "velocity", "momentum")]
        return [q, v - self._carried(u, k), *y[len(self.layout.state) :]]

    def pack(self, moved: Sequence, y: Sequence, u: Sequence, dt: Any, k: Any) -> list:
        """Return the lifted state at the step's end, from the moved variables."""
        given = dict(zip(self.state_names, y, strict=False)) | dict(zip(self.layout.controls, u, strict=True))
        after = []
        for entry in self.layout.state:
            by = next((p for p in self.layout.prescribed if p.name == entry.coordinate), None)
            if by is None and entry.kind == "place":
                after.append(moved[0])
            elif by is None:
                after.append(moved[1] + (self._carried(u, k) if entry.kind == "momentum" else 0.0))
            elif entry.kind == "velocity" or by.level == "rate":
                after.append(given[entry.name] + dt * given[by.control])
            else:
                rate, held = given[f"{by.name}_dot"], given[by.control]
                after.append(given[by.name] + dt * (rate + 0.5 * dt * held))
        return [*after, *moved[2:]]

    # --- derivatives ---------------------------------------------------------------------------------------

    def rates(self, parameters: Mapping[str, float], by: Sequence[str]) -> dict[str, list[float]]:
        """Return the derivatives of constants with respect to parameters, rounded once, without rows of 0."""
        exprs, values = [self.inertia, *self.expressions.values()], exactly(parameters)
        inertia, *numbers = map(Fraction, evaluate(exprs, values, Exact()))
        found: dict[str, list[float]] = {name: [] for name in self.expressions}
        for p in by:
            slopes = evaluate([derivative(expr, parameter(p)) for expr in exprs], values, Exact())
            first, *rest = map(Fraction, slopes)
            for name, x, rate in zip(found, numbers, rest, strict=True):
                found[name].append(_float(rate - x * first / inertia, inertia))
        return {name: row for name, row in found.items() if any(row)}

    # --- what depends on numbers ---------------------------------------------------------------------------

    def coefficients(self, state: ArrayLike, controls: Sequence, constants: Mapping[str, float]) -> Any:
        """Return the flow's coefficients as numbers, or arrays for states of shape (..., n_state)."""
        return self.coefficients_at(self.lift(state), controls, SimpleNamespace(**constants), np)

    def largest_majorant(self, dt: float) -> float:
        """Return the largest x for which one series is certified; closed forms do not need it."""
        return pendulum.largest_majorant(dt, self.order(dt) or pendulum.ORDER)

    def certified_speed(
        self, state: ArrayLike, controls: Sequence, dt: float, constants: Mapping[str, float]
    ) -> float | None:
        """Return the largest |q'| for which one series per step is certified, with all else as given [rad/s].

        Up to this speed, and not beyond, `step_bound` reports one substep, whose truncation error is at most
        1e-12 rad/s. The result is negative if drive, drag or field are too strong for one series at any
        speed, and None for a form that is stepped to rounding.
        """
        return None

    def step_bound(
        self, state: ArrayLike, controls: Sequence, dt: float, constants: Mapping[str, float]
    ) -> StepBound:
        """Return the step's bounds, known before it is taken; see `Scene.step_bound`."""
        return StepBound(1, 0, dict.fromkeys(self.state_names, 0.0), "stepped to rounding")


def lifted(form: NormalForm | None, y: Any, xp: Any) -> list:
    """Return a state's entries, followed by cosine and sine of the angle if the scene's form has one."""
    angle = None if form is None else form.angle
    return [*y] if angle is None else [*y, xp.cos(y[angle]), xp.sin(y[angle])]


class DrivenPendulum(NormalForm):
    """The driven pendulum: a certified Taylor series."""

    kind = pendulum.Coefficients

    @property
    def angle(self) -> int:
        """Index of the pendulum's angle."""
        return self._index(self.layout.free[0], "place")

    def order(self, dt: float) -> int:
        """Return the order of the series for a control step.

        Order 14 is enough for most steps up to 0.03 s, order 16 for those up to 0.05 s and for brakes, which
        may be strong.
        """
        brakes = any(term.held.number is None for term in self.terms["gamma"])
        return self.chosen or (20 if dt > 0.05 else 16 if brakes or dt > 0.03 else 14)

    def flow(self, dt: float) -> Flow:
        """Return the exact flow for control steps of this length."""
        return pendulum_flow(self.order(dt))

    def certified_speed(
        self, state: ArrayLike, controls: Sequence, dt: float, constants: Mapping[str, float]
    ) -> float:
        """Return the largest |q'| for which one series per step is certified [rad/s]; see `NormalForm`."""
        coeffs = self.kind(*map(float, self.coefficients(state, controls, constants)))
        return pendulum.certified_speed(coeffs, dt, self.order(dt))

    def step_bound(
        self, state: ArrayLike, controls: Sequence, dt: float, constants: Mapping[str, float]
    ) -> StepBound:
        """Return the bound that is proved before the step."""
        bounds = dict.fromkeys(self.state_names, 0.0)
        coeffs = self.kind(*map(float, self.coefficients(state, controls, constants)))
        free = self.layout.free[0]
        moving = [self._index(free, kind) for kind in ("place", "velocity")]
        found = pendulum.truncation_bound(float(np.asarray(state)[moving[1]]), coeffs, dt, self.order(dt))
        for i, bound in zip(moving, (found.theta, found.theta_dot), strict=True):
            bounds[self.state_names[i]] = bound
        return StepBound(found.substeps, found.order, bounds, "proved before the step")


class FixedSlopeForm(NormalForm):
    """The fixed slope: a closed form."""

    kind = slope.FixedSlope

    def flow(self, dt: float) -> Flow:
        """Return the exact flow."""
        return SLIDE


class TurningSlopeForm(NormalForm):
    """The slope that turns at a held rate: a series summed to rounding."""

    kind = slope.TurningSlope

    @property
    def angle(self) -> int:
        """Index of the slope's angle."""
        return self._index(self.layout.at("rate")[0].name, "place")

    def flow(self, dt: float) -> Flow:
        """Return the exact flow."""
        return TURN

    def _held(self, u: Sequence) -> Mapping[str, Any]:
        return {"rate": u[self.layout.controls.index(self.layout.at("rate")[0].control)]}

    def _carried(self, u: Sequence, k: Any) -> Any:
        return k.shift * self._held(u)["rate"]


def _float(x: Any, divisor: Any) -> float:
    try:
        return float(Fraction(x) / Fraction(divisor))
    except OverflowError:
        return math.inf


# --- recognition --------------------------------------------------------------------------------------------


def normal_form(m: Mechanics, order: int = 0) -> NormalForm | None:
    """Return the normal form of these equations of motion, or None if they have none.

    Parameters
    ----------
    m : Mechanics
        The equations of motion.
    order : int
        Order of the flow's series, if it has one; by default the control step determines the order.
    """
    if (m.key, order) not in _known:
        form = normal_form(m) if order else _recognised(m)
        _known[m.key, order] = form and dataclasses.replace(form, chosen=order)
    return _known[m.key, order]


_known: dict[tuple[str, int], NormalForm | None] = {}


def _recognised(m: Mechanics) -> NormalForm | None:
    rates = m.layout.at("rate")
    if len(m.free) != 1 or not _is_constant(m.entry(0, 0)) or m.free[0] in m.layout.left_out:
        return None
    q = place(m.free[0])
    of = {
        Atom("function", "sin", Expr.of(q)): "alpha",
        Atom("function", "cos", Expr.of(q)): "beta",
        velocity(m.free[0]): "gamma",
    }
    of |= {velocity(p.name): p.name for p in m.layout.at("acceleration")}
    if rates:
        of |= {Atom("function", "sin", Expr.of(place(rates[0].name))): "gravity", q: "centrifugal"}
    parts = _split(m.force[0], of)
    if parts is None:
        return None
    if rates:
        return _turning(m, parts)
    if parts.keys() <= {"", "gamma"}:
        terms = {"acceleration": parts.get("", {}), "damping_rate": _negative(parts.get("gamma", {}))}
        return _form(m, FixedSlopeForm, terms)
    if not parts.keys() & {"alpha", "beta"}:
        return None
    delta, ramp = dict(parts.get("", {})), {}
    for p in m.layout.at("acceleration"):
        for held, constant in parts.get(p.name, {}).items():
            if held != Expr.of(1).text:
                return None  # a product of a control and a changing rate
            delta[Expr.of(velocity(p.name)).text] = Expr.of(velocity(p.name)), constant[1]
            ramp[Expr.of(control(p.control)).text] = Expr.of(control(p.control)), constant[1]
    terms = {name: _negative(parts.get(name, {})) for name in ("alpha", "beta", "gamma")}
    return _form(m, DrivenPendulum, terms | {"delta": delta, "ramp": ramp})


#: For the text of each held quantity: the quantity, and the constant that multiplies it.
_Parts = dict[str, tuple[Expr, Expr]]


def _split(force: Expr, of: Mapping[Atom, str]) -> dict[str, _Parts] | None:
    """Sort a force's terms by their single factor in `of` ("" for none); None if a term does not fit."""
    parts: dict[str, _Parts] = {}
    for monomial, c in force.sorted_terms():
        constant: Monomial = ()
        held: Monomial = ()
        name = ""
        for atom, n in monomial:
            kinds = {s.kind for s in Expr.of(atom).symbols()}
            if kinds <= {"parameter"}:
                constant = (*constant, (atom, n))
            elif kinds == {"control"} and n > 0 and _has_code(atom):
                held = (*held, (atom, n))
            elif atom in of and n == 1 and not name:
                name = of[atom]
            else:
                return None
        expr, part = Expr({held: 1}), parts.setdefault(name, {})
        known = part.get(expr.text, (expr, Expr({})))[1]
        part[expr.text] = expr, known + Expr({constant: c})
    return parts


def _has_code(atom: Atom) -> bool:
    """Return whether a flow's code has all functions of an atom; the general series has atan and tanh too."""
    if atom.argument is None:
        return True
    known = atom.function == "sum" or hasattr(Trace, atom.function)
    return known and all(map(_has_code, atom.argument.atoms()))


def _is_constant(expr: Expr) -> bool:
    return all(s.kind == "parameter" for s in expr.symbols())


def _negative(part: _Parts) -> _Parts:
    return {text: (held, -constant) for text, (held, constant) in part.items()}


def _unheld(part: _Parts) -> _Parts:
    """Return the coefficient's only constant without its held factor, which is applied elsewhere."""
    constants = [constant for _, constant in part.values()]
    return {Expr.of(1).text: (Expr.of(1), constants[0])} if constants else {}


def _turning(m: Mechanics, parts: dict[str, _Parts]) -> NormalForm | None:
    """Return the turning slope's form, for a scene that holds the rate of one coordinate."""
    (rate, *others), one = m.layout.at("rate"), Expr.of(1).text
    held = Expr.of(control(rate.control))
    wanted = {"gravity": one, "centrifugal": (held * held).text, "gamma": one}
    if (
        others
        or not all(list(part) == [wanted.get(name)] for name, part in parts.items())
        or not all(_is_constant(entry) for entry in m.coupling.values())
        or not {rate.name} == {e.coordinate for e in m.layout.state if e.coordinate != m.free[0]}
    ):
        return None
    terms = {
        "centrifugal": _unheld(parts.get("centrifugal", {})),
        "gravity": parts.get("gravity", {}),
        "damping_rate": _negative(parts.get("gamma", {})),
    }
    return _form(m, TurningSlopeForm, terms, {"shift": m.coupling.get((0, rate.name), Expr({}))})


def _form(
    m: Mechanics,
    form: type[NormalForm],
    parts: Mapping[str, _Parts],
    others: Mapping[str, Expr] | None = None,
) -> NormalForm:
    """Name the constants; equal constants share a name."""
    expressions: dict[str, Expr] = dict(others or {})
    names = {expr.text: name for name, expr in expressions.items()}
    terms = {}
    for coefficient, part in parts.items():
        found: list[CoefficientTerm] = []
        for held, constant in part.values():
            if constant.text not in names:
                name = coefficient if held.number == 1.0 else f"{coefficient}_{len(found)}"
                names[constant.text] = name
                expressions[name] = constant
            found.append(CoefficientTerm(names[constant.text], held))
        terms[coefficient] = tuple(found)
    return form(m.layout, terms, expressions, m.entry(0, 0))
