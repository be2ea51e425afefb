"""A scene in SymPy: its Lagrangian and Euler-Lagrange equations, and scenes made from expressions.

The expressions are made by passing symbols through the same formulas as numbers.
"""

from __future__ import annotations

import dataclasses
import types
import unicodedata
from collections.abc import Callable, Hashable, Mapping
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import sympy
from sympy.core.function import AppliedUndef

from lag_envs.mechanics.algebra import FormulaError, RecordedFunctions
from lag_envs.mechanics.recording import Values, parameter_names, twin
from lag_envs.scenes.checks import check_number
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.parameters import parameter

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

t = sympy.Symbol("t", real=True)


_FUNCTIONS = {
    f: f.__name__ for f in (sympy.sin, sympy.cos, sympy.tan, sympy.exp, sympy.log, sympy.atan, sympy.tanh)
}


def decimal(expression: Any) -> sympy.Expr:
    """Return an expression with rational numbers in place of floats: 1/10 for 0.1."""
    return sympy.nsimplify(sympy.sympify(expression), rational=True)


def binary(expression: Any) -> sympy.Expr:
    """Return an expression with the exact rational numbers that its floats stand for."""
    expression = sympy.sympify(expression)
    return expression.xreplace({number: sympy.Rational(number) for number in expression.atoms(sympy.Float)})


def _functions(of: Callable[[Any], Any], rational: Callable[[Any], sympy.Expr]) -> types.SimpleNamespace:
    """Return the namespace of a formula on SymPy's expressions; `of` is applied to functions' arguments."""

    def taken(function: Any) -> Callable[[Any], Any]:
        return lambda x: function(of(x))

    named = {name: taken(f) for f, name in _FUNCTIONS.items()}
    return types.SimpleNamespace(
        pi=sympy.pi, sqrt=taken(sympy.sqrt), arctan=taken(sympy.atan), rational=rational, **named
    )


#: Namespaces ``xp`` of a formula on SymPy's expressions. The first is for people to read; in the second, a
#: float stands for its exact value, and no function is called on floats.
Symbolic, Exact = _functions(lambda x: x, decimal), _functions(binary, binary)


# --- a scene as expressions --------------------------------------------------------------------------------


def symbolic(scene: Scene) -> Any:
    """Return a twin of the scene whose parameters are symbols with their names."""
    ranges = {f.name: f.metadata for f in dataclasses.fields(scene)}  # type: ignore[arg-type]
    symbols = {}
    for name in parameter_names(scene):
        positive = any(
            ranges[name][bound] is not None and ranges[name][bound] >= 0 for bound in ("above", "least")
        )
        symbols[name] = sympy.Symbol(name, positive=True) if positive else sympy.Symbol(name, real=True)
        if symbols[name] == t:  # a parameter is not a time
            symbols[name] = sympy.Symbol(name, real=True, polar=False)
    return twin(scene, symbols)


def motion_symbols(scene: Scene) -> tuple[Values, Values, Values]:
    """Return places, velocities and controls as SymPy's functions of time."""
    layout = layout_of(scene)
    q: dict[str, Any] = {name: sympy.Function(name, real=True)(t) for name in layout.names}
    u = {name: sympy.Function(name, real=True)(t) for name in layout.controls}
    return (
        Values("coordinate", q),
        Values("velocity of a coordinate", {name: place.diff(t) for name, place in q.items()}),
        Values("control", u, dict.fromkeys(layout.absent, sympy.Integer(0))),
    )


def _resting(scene: Scene, expression: sympy.Expr, xp: Any) -> sympy.Expr:
    """Return an expression with resting coordinates at their places and without rates of held coordinates."""
    values: dict[Any, Any] = {}
    rests = symbolic(scene).rests()
    for p in layout_of(scene).at("rest", "place"):
        place = sympy.Function(p.name, real=True)(t)
        values |= {place.diff(t): 0, place.diff(t, 2): 0}
        if p.level == "rest":
            values[place] = xp.rational(rests.get(p.name, 0))
    return expression.xreplace({key: sympy.sympify(value) for key, value in values.items()})


def _lagrangian(scene: Scene, xp: Any) -> sympy.Expr:
    copy, (q, v, _) = symbolic(scene), motion_symbols(scene)
    return xp.rational(copy.kinetic(q, v, xp) - copy.potential(q, xp))


def lagrangian(scene: Scene, xp: Any = Symbolic) -> sympy.Expr:
    """Return T - V of the scene with symbols for its parameters."""
    return _resting(scene, _lagrangian(scene, xp), xp)


def euler_lagrange(scene: Scene, coordinate: str, xp: Any = Symbolic) -> sympy.Expr:
    """Return d/dt ∂L/∂q' - ∂L/∂q + ∂D/∂q' - Q: zero for a free coordinate, else the force needed.

    Parameters
    ----------
    scene : Scene
        The scene; the values of its parameters do not matter.
    coordinate : str
        A free, moving or resting coordinate.
    xp : namespace, default `Symbolic`
        Functions of SymPy's expressions; with `Exact` the formulas' floats keep their exact values.
    """
    copy, (q, v, u) = symbolic(scene), motion_symbols(scene)
    of, rate, energy = q[coordinate], v[coordinate], _lagrangian(scene, xp)
    loss = xp.rational(copy.dissipation(q, v, u, xp))
    force = xp.rational(copy.applied(q, v, u, xp).get(coordinate, 0))
    return _resting(scene, energy.diff(rate).diff(t) - energy.diff(of) + loss.diff(rate) - force, xp)


def equations(scene: Scene) -> list[sympy.Eq]:
    """Return the equations of motion of the free coordinates; `sympy.latex` prints them."""
    return [sympy.Eq(sympy.simplify(euler_lagrange(scene, name)), 0) for name in layout_of(scene).free]


# --- expressions as a scene --------------------------------------------------------------------------------


def from_sympy(
    base: type[Scene],
    name: str,
    kinetic: Any,
    potential: Any,
    *,
    coordinates: Mapping,
    controls: Mapping,
    prescribed: Mapping,
    dissipation: Any,
    applied: Mapping | None,
    parameters: Mapping,
) -> Scene:
    """Return a scene made from SymPy expressions; see `Scene.from_sympy`."""
    maps = {
        "coordinates": coordinates,
        "controls": controls,
        "prescribed": prescribed,
        "parameters": parameters,
    }
    items: list[tuple[str, tuple]] = []
    known: dict[str, Any] = {}
    for what, given in {**maps, "applied": applied or {}}.items():
        try:
            pairs = [(_symbol(key), value) for key, value in dict(given).items()]
        except (TypeError, ValueError):
            raise FormulaError(
                f"{name}.{what} must be a dict with SymPy symbols as keys, got {given!r:.60}"
            ) from None
        for i, (key, value) in enumerate(pairs):
            if what == "parameters" and not callable(value):
                pairs[i] = key, check_number(_name(key), value)
            elif not isinstance(value, Hashable):
                wanted = "an expression" if what == "applied" else "a unit"
                raise FormulaError(f"{name}.{what}: {_name(key)} must have {wanted}, got {value!r:.60}")
            elif what == "applied":  # SymPy has other meanings for names such as E in a text
                pairs[i] = key, sympy.sympify(value, known)
        for key, _ in pairs if what in maps else ():
            if known.setdefault(_name(key), key) != key or [k for k, _ in pairs].count(key) > 1:
                raise FormulaError(f"{name}.{what}: {_name(key)} is declared twice; give one another name")
        items.append((what, tuple(pairs)))
    formulas = tuple(
        (what, sympy.sympify(e, known))
        for what, e in (("kinetic", kinetic), ("potential", potential), ("dissipation", dissipation))
    )
    return _scene_type(base, name, tuple(items), formulas)()


@lru_cache(maxsize=256)
def _scene_type(base: type[Scene], name: str, items: tuple, formulas: tuple) -> type[Scene]:
    """Return a class derived from `Scene` for these expressions; equal expressions give the same class."""
    given = {what: dict(pairs) for what, pairs in items}
    expressions = dict(formulas)
    named = {what: {_name(key): value for key, value in of.items()} for what, of in given.items()}
    applied = named["applied"]
    # The controls come first: a control that sets a place or a rate is read as that place or rate.
    places: dict[Any, tuple[str, str]] = {symbol: ("u", _name(symbol)) for symbol in given["controls"]}
    places |= {symbol: ("self", _name(symbol)) for symbol in given["parameters"]}
    for symbol in (*given["coordinates"], *given["prescribed"]):
        places[symbol] = ("q", _name(symbol))
        if isinstance(symbol, AppliedUndef):
            places[sympy.Derivative(symbol, *symbol.args)] = ("v", _name(symbol))
        else:
            places[sympy.Symbol(f"{symbol.name}_dot", **symbol._assumptions_orig)] = ("v", _name(symbol))

    def numbers(self: Any, **spaces: Any) -> dict[Any, Any]:
        spaces["self"] = self
        return {symbol: getattr(spaces[of], key) for symbol, (of, key) in places.items() if of in spaces}

    def kinetic(self: Any, q: Any, v: Any, xp: Any) -> Any:
        return evaluate_expression(expressions["kinetic"], numbers(self, q=q, v=v), xp)

    def potential(self: Any, q: Any, xp: Any) -> Any:
        return evaluate_expression(expressions["potential"], numbers(self, q=q), xp)

    def dissipation(self: Any, q: Any, v: Any, u: Any, xp: Any) -> Any:
        return evaluate_expression(expressions["dissipation"], numbers(self, q=q, v=v, u=u), xp)

    def forces(self: Any, q: Any, v: Any, u: Any, xp: Any) -> Any:
        return {
            key: evaluate_expression(force, numbers(self, q=q, v=v, u=u), xp)
            for key, force in applied.items()
        }

    def reduce(self: Any) -> Any:
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return _remake, (base, name, items, formulas, fields)

    body = {
        "__doc__": f"The scene {name} of SymPy expressions.",
        "__module__": __name__,
        "__annotations__": dict.fromkeys(named["parameters"], "float"),
        "__reduce__": reduce,
        "__call__": lambda self, **values: dataclasses.replace(self, **values),
        "coordinates": named["coordinates"],
        "prescribed": named["prescribed"],
        "controls": named["controls"],
        "kinetic": kinetic,
        "potential": potential,
        "dissipation": dissipation,
        "applied": forces,
        **{key: parameter(value, "") for key, value in named["parameters"].items()},
    }
    return types.new_class(name, (base,), exec_body=lambda space: space.update(body))


def _remake(base: type[Scene], name: str, items: tuple, formulas: tuple, fields: dict) -> Scene:
    return _scene_type(base, name, items, formulas)(**fields)


def _symbol(key: Any) -> Any:
    """Return the symbol that a key of a dict stands for; a string stands for the symbol of that name."""
    return sympy.Symbol(key) if isinstance(key, str) else key


def _name(symbol: Any) -> str:
    """Return a symbol's name as Python would read it."""
    if isinstance(symbol, AppliedUndef):
        symbol = symbol.func.__name__
    if isinstance(symbol, sympy.Symbol):
        symbol = symbol.name
    if isinstance(symbol, str):
        return unicodedata.normalize("NFKC", symbol)
    if isinstance(symbol, sympy.Derivative) and isinstance(symbol.expr, AppliedUndef):
        rate = f"{symbol.expr.func.__name__}_{'d' * symbol.derivative_count}ot"
        raise FormulaError(
            f"{symbol!r} is a derivative, which cannot be a name; a control that sets it is called {rate!r}"
        )
    raise FormulaError(f"{symbol!r} is neither a SymPy symbol nor a function of time; it cannot be a name")


def evaluate_expression(expression: Any, values: Mapping[Any, Any], xp: Any) -> Any:
    """Return the value of a SymPy expression for numbers of any kind.

    Parameters
    ----------
    expression : sympy.Expr
        The expression.
    values : mapping
        A number for each symbol.
    xp : namespace
        Functions for these numbers.
    """
    of: Callable[[Any], Any] = lambda e: evaluate_expression(e, values, xp)  # noqa: E731
    if expression in values:
        return values[expression]
    if expression.is_Integer:
        return int(expression)
    if expression.is_Rational:
        exact = isinstance(xp, RecordedFunctions)
        return Fraction(expression.p, expression.q) if exact else expression.p / expression.q
    if expression.is_number and expression.is_real:
        return float(expression)
    if expression.is_Add or expression.is_Mul:
        first, *rest = (of(a) for a in expression.args)
        for value in rest:
            first = first + value if expression.is_Add else first * value
        return first
    if expression.is_Pow:
        base, exponent = expression.args
        if exponent.is_Float:  # exactly: 2.5 is a half
            exponent = sympy.Rational(exponent)
        if exponent.is_Integer:
            return of(base) ** int(exponent) if exponent > 0 else 1 / of(base) ** -int(exponent)
        if exponent.is_Rational and exponent.q == 2:
            root = xp.sqrt(of(base)) ** abs(int(exponent.p))
            return root if exponent > 0 else 1 / root
        raise FormulaError(
            f"{expression} has the power {expression.exp}; only whole numbers and halves can be powers"
        )
    if expression.func in _FUNCTIONS:
        return getattr(xp, _FUNCTIONS[expression.func])(of(expression.args[0]))
    if expression.is_Symbol or isinstance(expression, AppliedUndef | sympy.Derivative):
        if str(expression) in map(str, values):
            raise FormulaError(
                f"{expression} is not the declared symbol of that name: they differ in assumptions such as "
                "real=True; use the same symbol"
            )
        time = " (an energy has no symbol for time)" if str(expression) == "t" else ""
        raise FormulaError(
            f"{expression} is neither a coordinate, its velocity, a control nor a parameter of this "
            f"formula{time}; declare it"
        )
    raise FormulaError(
        f"{expression.func.__name__} in {expression!s:.40} is not one of sin, cos, tan, atan, tanh, sqrt, "
        "exp, log; rewrite it in these"
    )
