"""Exact algebra on recorded formulas: sums of products of symbols and of functions of such sums.

Energies are run once on `Expr` objects. An `Expr` is kept expanded, as a map from monomials to rational
coefficients, so that equal terms are merged and terms that cancel leave nothing behind: deriving an equation
of motion consists of sums, products and derivatives of such maps. A monomial is a product of powers of atoms;
an atom is a symbol (a coordinate, a velocity, a parameter, ...) or a function of an `Expr`. Powers and
products of sums that change with the motion are not expanded, except squares and products whose terms may
combine with others (see `apart`). Besides the rules of sums and products there is one more rule: √x² = x. The
rules of sine and cosine are applied on request (`lag_envs.mechanics.identities`).

Everything is ordered by its text, never by the time at which it was made, so the same formulas give the same
code and the same bits in every process.
"""

from __future__ import annotations

import math
import numbers
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from fractions import Fraction
from functools import partial
from typing import Any, ClassVar, NoReturn

Monomial = tuple[tuple["Atom", int], ...]

#: A product of two sums that would have more terms than this stays a product.
LARGEST_PRODUCT = 4096
#: What to write in place of functions that formulas do not have.
INSTEAD = {
    "arcsin": "xp.atan(x / xp.sqrt(1 - x * x))",
    "arctan2": "xp.atan(y / x) where x is positive",
    "clip": "xp.minimum(xp.maximum(x, low), high)",
    "cosh": "(xp.exp(x) + xp.exp(-x)) / 2",
    "hypot": "xp.sqrt(x * x + y * y)",
    "log10": "xp.log(x) / xp.log(10)",
    "max": "xp.maximum(x, y)",
    "min": "xp.minimum(x, y)",
    "power": "x**2, or xp.exp(p * xp.log(x)) where x is positive",
    "sign": "xp.where(x < 0, -1.0, 1.0)",
    "sinh": "(xp.exp(x) - xp.exp(-x)) / 2",
    "square": "x * x",
}
INSTEAD |= {"asin": INSTEAD["arcsin"], "atan2": INSTEAD["arctan2"], "pow": INSTEAD["power"]}
#: The remedy for a branch on a number.
BRANCH = "where the form differs, branch on a field that is not a parameter, such as `spring: bool = True`"


_apart: ContextVar[bool] = ContextVar("apart", default=False)


@contextmanager
def apart(wanted: bool = True) -> Iterator[None]:
    """Keep squares and products of sums with sines and cosines, and squares with velocities, as they are.

    A kinetic energy is expanded, since cos² + sin² = 1 shortens it. In other formulas, expansion would turn a
    quantity that depends on the distance of two nearby points, or on the speed relative to a wind, into a
    small difference of large numbers.
    """
    token = _apart.set(wanted)
    try:
        yield
    finally:
        _apart.reset(token)


#: The errors raised so far by the formula that is being run, which the formula may have caught.
raised: ContextVar[list[FormulaError] | None] = ContextVar("raised", default=None)


class FormulaError(TypeError, ValueError):
    """A formula does something that recorded numbers cannot follow, or a name is wrong."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)
        if (errors := raised.get()) is not None:
            errors.append(self)


class Atom:
    """A symbol, or a function of an expression. Atoms with the same text are the same object."""

    __slots__ = ("argument", "function", "kind", "name", "text")
    _all: ClassVar[dict[str, Atom]] = {}

    kind: str
    name: str
    function: str
    argument: Expr | None
    text: str

    def __new__(cls, kind: str, name: str, argument: Expr | None = None) -> Atom:
        """Return the atom of this kind and name.

        Parameters
        ----------
        kind : str
            ``"function"``, or what the symbol stands for: ``"parameter"``, ``"place"``, ``"velocity"``,
            ``"control"``, ...
        name : str
            The symbol's or the function's name; the function ``"sum"`` is its argument itself.
        argument : Expr, optional
            The function's argument.
        """
        text = f"{kind} {name}" if argument is None else f"{name}({argument.text})"
        found = cls._all.get(text)
        if found is None:
            found = object.__new__(cls)
            found.kind, found.name, found.argument, found.text = kind, name, argument, text
            found.function = name if argument is not None else ""
            found = cls._all.setdefault(text, found)
        return found

    def __repr__(self) -> str:
        return self.text

    def __reduce__(self) -> tuple:
        return Atom, (self.kind, self.name, self.argument)


def _exact(value: Any) -> int | Fraction:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise FormulaError(f"a formula uses the number {number}")
    if isinstance(value, int | Fraction):
        return value
    return int(number) if number.is_integer() else Fraction(number)


def _simplest(number: Fraction) -> int | Fraction:
    return int(number) if number.denominator == 1 else number


class Expr:
    """A recorded number. It can be added, multiplied, divided and raised to whole powers."""

    __slots__ = ("_text", "terms")

    def __init__(self, terms: Mapping[Monomial, int | Fraction]) -> None:
        self.terms = dict(terms)
        self._text: str | None = None

    @staticmethod
    def of(value: Any) -> Expr:
        """Return a number, an atom or an expression as an expression."""
        if isinstance(value, Expr):
            return value
        if isinstance(value, Atom):
            return Expr({((value, 1),): 1})
        if hasattr(type(value), "shape") and value.shape == ():  # NumPy's number, or array without dimensions
            value = value.item()
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise FormulaError(
                f"a formula combines a recorded number with {value!r}, which is not a real number"
            )
        exact = _exact(value)
        return Expr({(): exact} if exact else {})

    # --- queries --------------------------------------------------------------------------------------------

    @property
    def text(self) -> str:
        """The expression as text; equal expressions have equal texts."""
        if self._text is None:
            parts = []
            for monomial, c in self.sorted_terms():
                factors = [a.text if n == 1 else f"{a.text}^{n}" for a, n in monomial]
                parts.append("*".join([str(c), *factors] if c != 1 or not factors else factors))
            self._text = " + ".join(parts) or "0"
        return self._text

    def sorted_terms(self) -> list[tuple[Monomial, int | Fraction]]:
        """Return the terms, in an order that does not depend on how they were made."""
        return sorted(self.terms.items(), key=lambda term: [(a.text, n) for a, n in term[0]])

    def __repr__(self) -> str:
        return f"Expr({self.text})"

    def same(self, other: Expr) -> bool:
        """Return whether two expressions have the same terms."""
        return self.terms == other.terms

    @property
    def number(self) -> float | None:
        """The expression as a number, or None if it has symbols."""
        if not self.terms:
            return 0.0
        if len(self.terms) == 1 and () in self.terms:
            try:
                return float(self.terms[()])
            except OverflowError:
                raise FormulaError(
                    "the equation of motion has a constant beyond 1.8e308; write the energies in other units"
                ) from None
        return None

    def atoms(self) -> set[Atom]:
        """Return the atoms of all monomials, without those inside functions."""
        return {a for monomial in self.terms for a, _ in monomial}

    def symbols(self) -> set[Atom]:
        """Return all symbols, including those inside functions."""
        found: set[Atom] = set()
        for atom in self.atoms():
            found |= {atom} if atom.argument is None else atom.argument.symbols()
        return found

    # --- arithmetic -----------------------------------------------------------------------------------------

    def __add__(self, other: Any) -> Expr:
        other = Expr.of(other)
        terms = dict(self.terms)
        for monomial, c in other.terms.items():
            total = terms.get(monomial, 0) + c
            if total:
                terms[monomial] = total
            else:
                del terms[monomial]
        return Expr(terms)

    __radd__ = __add__

    def __neg__(self) -> Expr:
        return Expr({m: -c for m, c in self.terms.items()})

    def __pos__(self) -> Expr:
        return self

    def __sub__(self, other: Any) -> Expr:
        return self + -Expr.of(other)

    def __rsub__(self, other: Any) -> Expr:
        return -self + other

    def __mul__(self, other: Any) -> Expr:
        second = Expr.of(other)
        ratio = second._ratio(self)
        kept = _kept_product(self, second) if ratio is None else self._kept(2)
        if kept is None:
            return _expanded(self, second)
        return kept if ratio is None else kept * ratio

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Expr:
        return self * Expr.of(other).reciprocal()

    def __rtruediv__(self, other: Any) -> Expr:
        return self.reciprocal() * other

    def __pow__(self, exponent: Any, modulo: Any = None) -> Expr:
        if isinstance(exponent, Expr):
            number = exponent.number
            exponent = exponent if number is None else number
        whole = isinstance(exponent, numbers.Real) and float(exponent).is_integer()
        if not whole or modulo is not None:
            if isinstance(exponent, numbers.Real) and float(exponent) in (0.5, -0.5):
                root = function_of("sqrt", self)
                return root if float(exponent) > 0 else root.reciprocal()
            raise FormulaError(
                f"a recorded number is raised to the power {exponent!r}; only whole numbers and ±0.5 can be "
                "powers: write xp.exp(p * xp.log(x)) for others"
            )
        n = int(exponent)
        kept = self._kept(n)
        if kept is not None:
            return kept
        base = self if n >= 0 else self.reciprocal()
        result = Expr.of(1)
        for bit in bin(abs(n))[2:]:
            result = result * result
            if bit == "1":
                result = result * base
        return result

    def __rpow__(self, base: Any) -> NoReturn:
        log = f"xp.log({float(base) if isinstance(base, numbers.Real) else base!r})"
        raise FormulaError(f"{base!r} is raised to a recorded power x; write xp.exp(x * {log})")

    def _kept(self, exponent: int) -> Expr | None:
        """Return a power of this that is kept as it is, or None if the power is expanded.

        If expanded, (x - c)⁴ would be a small difference of large numbers where x is near c. A factor that
        all terms share is taken out first: (x v - c v)² is (x - c)² v².
        """
        if exponent < 2 or len(self.terms) < 2:
            return None
        shared, rest = self._divided()
        if not rest._stays(exponent):
            return None
        power = Expr({((Atom("function", "sum", rest), exponent),): 1})
        return power * Expr({tuple((a, n * exponent) for a, n in shared): 1})

    def _divided(self) -> tuple[Monomial, Expr]:
        """Return a factor that all terms share, and the sum without it."""
        first, *others = (dict(monomial) for monomial in self.terms)
        shared = {a: min([n, *(o.get(a, 0) for o in others)]) for a, n in first.items()}
        shared = {a: n for a, n in shared.items() if n > 0}
        rest = _expanded(self, Expr({tuple((a, -n) for a, n in shared.items()): 1})) if shared else self
        return tuple(shared.items()), rest

    def _stays(self, exponent: int) -> bool:
        """Return whether this power of the sum is not expanded.

        Except within `apart`, a square is expanded if its terms may combine with others: those with
        velocities, and sines and cosines by cos² + sin² = 1.
        """
        if len(self.terms) < 2:
            return False
        moving = [a for a in self.atoms() if any(s.kind != "parameter" for s in Expr.of(a).symbols())]
        if exponent > 2:
            return bool(moving)
        return bool(moving) and (
            _apart.get()
            or not any(
                a.function in ("sin", "cos") or s.kind == "velocity"
                for a in moving
                for s in Expr.of(a).symbols()
            )
        )

    def _has_velocity(self) -> bool:
        return any(s.kind == "velocity" for s in self.symbols())

    def _is_apart(self) -> bool:
        """Return whether `apart` is the only reason not to expand the sum."""
        with apart():
            stays = self._is_factor()
        return stays and not self._is_factor()

    def _is_factor(self) -> bool:
        """Return whether the sum stays apart in a product with another such sum."""
        return self._stays(2) and any(s.kind == "place" for s in self.symbols())

    def _ratio(self, other: Expr) -> int | Fraction | None:
        """Return the number that times `other` gives this expression, or None if no number does."""
        if self.terms.keys() != other.terms.keys():
            return None
        ratios = {Fraction(c) / other.terms[monomial] for monomial, c in self.terms.items()}
        return _simplest(ratios.pop()) if len(ratios) == 1 else None

    def reciprocal(self) -> Expr:
        """Return one over the expression."""
        if not self.terms:
            raise FormulaError("a formula divides by zero")
        if len(self.terms) == 1:
            ((monomial, c),) = self.terms.items()
            return Expr({(): _simplest(Fraction(1) / c)}) * Expr({tuple((a, -n) for a, n in monomial): 1})
        return Expr({((Atom("function", "sum", self), -1),): 1})

    # --- refused operations ---------------------------------------------------------------------------------

    def _refuse(self, what: str, remedy: str) -> NoReturn:
        raise FormulaError(f"{what} of a recorded number; {remedy}")

    def __float__(self) -> float:
        self._refuse(
            "float(), or a function of math or NumPy,", "use + - * /, whole powers and functions of xp"
        )

    def __int__(self) -> int:
        self._refuse("int()", "a formula must be smooth")

    def __index__(self) -> int:
        self._refuse("an index or range", "only structural fields can be counts")

    def __complex__(self) -> complex:
        self._refuse("complex()", "formulas are real")

    def __bool__(self) -> bool:
        self._refuse("`if`, `and`, `or`, `not` or `in`", f"a formula cannot branch on its numbers; {BRANCH}")

    def _compare(self, other: Any) -> NoReturn:
        remedy = f"an energy must be smooth and cannot branch on its numbers; {BRANCH}"
        self._refuse("a comparison, min or max", remedy)

    __eq__ = __ne__ = __lt__ = __le__ = __gt__ = __ge__ = _compare

    def __hash__(self) -> int:
        remedy = (
            "look up a field that is not a parameter, such as `gear: int = 2`; drop the cache; take "
            "functions from xp, as in xp.cos, not from SymPy"
        )
        self._refuse("a look-up in a table, set or cache", remedy)

    def __abs__(self) -> Expr:
        self._refuse("abs()", "an energy must be smooth: xp.sqrt(x * x + eps * eps) rounds the corner")

    def __mod__(self, other: Any) -> Expr:
        self._refuse("%, // or divmod()", "a formula must be smooth")

    __rmod__ = __floordiv__ = __rfloordiv__ = __divmod__ = __rdivmod__ = __mod__

    def __round__(self, digits: Any = None) -> Expr:
        self._refuse("round()", "a formula must be smooth")

    __floor__ = __ceil__ = __trunc__ = __round__

    def __iter__(self) -> Any:
        self._refuse("a loop over the entries", "such a number has no entries")

    __array_priority__ = 1000.0

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """Let NumPy's numbers be added and multiplied; refuse its functions and arrays."""
        operators: dict[str, Callable] = {
            "add": operator.add, "subtract": operator.sub, "multiply": operator.mul,
            "divide": operator.truediv, "negative": operator.neg,
        }  # fmt: skip
        name = ufunc.__name__
        if method != "__call__" or name not in operators or options:
            known = callable(getattr(RecordedFunctions, name, None))
            self._refuse(f"np.{name}", f"use {f'xp.{name}' if known else 'whole powers and functions of xp'}")
        operands = [Expr.of(i if isinstance(i, Expr) else _scalar(i)) for i in inputs]
        return operators[name](*operands)


def _scalar(value: Any) -> float:
    if getattr(value, "ndim", 0):
        raise FormulaError(
            "a formula combines a recorded number with an array; a formula must return single numbers"
        )
    return float(value)


def _product(first: Monomial, second: Monomial) -> tuple[Monomial, Expr | None]:
    """Return the product of two monomials, and a further factor from squares of roots and sums, or None."""
    if not first:
        return second, None
    if not second:
        return first, None
    powers = dict(first)
    for atom, n in second:
        powers[atom] = powers.get(atom, 0) + n
    more: Expr | None = None
    for atom, n in list(powers.items()):
        if atom.function == "sqrt" and abs(n) > 1:
            assert atom.argument is not None
            half = int(n / 2)
            powers[atom] = n - 2 * half
            factor = atom.argument**half
            more = factor if more is None else more * factor
    return tuple(sorted(((a, n) for a, n in powers.items() if n), key=lambda p: p[0].text)), more


def _kept_product(first: Expr, second: Expr) -> Expr | None:
    """Return a product in which sums stay factors, or None if it is expanded.

    If expanded, (x - c - 1)(x - c + 1)(x - c - 2) would be a small difference of large numbers, like a power.
    Sums with velocities, and usually with sines or cosines, are expanded (see `Expr._stays`), unless the
    other operand already contains a power of the same sum. A sum of places stays a factor of velocities.
    """
    if len(first.terms) < len(second.terms):
        first, second = second, first
    if len(first.terms) < 2 or not second.terms:
        return None
    if len(second.terms) > 1:
        (shared, rest), (more, other) = first._divided(), second._divided()
        if rest._is_factor() != other._is_factor():
            return _over_velocities(*((first, second) if rest._is_factor() else (second, first)))
        if not (rest._is_factor() and other._is_factor()):
            return None
        base, factor = sorted((rest, other), key=lambda e: (len(e.text), e.text))
        return _with_factor(_as_factor(base), factor) * (Expr({shared: 1}) * Expr({more: 1}))
    (monomial,) = second.terms
    if first._is_factor() and second._has_velocity():
        return _over_velocities(first, second)
    sums = [(a.argument, n) for a, n in monomial if a.argument is not None and a.function == "sum"]
    if not sums:
        return None
    shared, rest = first._divided()
    joins = rest._is_factor() and any(n > 0 and e._is_factor() for e, n in sums)
    if not joins and all(rest._ratio(e) is None for e, _ in sums):
        return None
    return _with_factor(second, rest) * Expr({shared: 1})


def _over_velocities(places: Expr, others: Expr) -> Expr | None:
    """Return a sum of places times a sum with velocities, term by term, or None if there is no velocity."""
    if not others._has_velocity():
        return None
    return _expanded(_whole(places), others)


def _whole(expr: Expr) -> Expr:
    """Return a sum as a factor, without the factors that all its terms share, if `apart` keeps it."""
    with apart():
        if not expr._is_factor():
            return expr
    shared, rest = expr._divided()
    return _as_factor(rest) * Expr({shared: 1})


def _as_factor(expr: Expr) -> Expr:
    return Expr.of(Atom("function", "sum", expr))


def _with_factor(product: Expr, factor: Expr) -> Expr:
    """Return a product of kept sums times another sum; multiples of one sum make a power of it."""
    (monomial,) = product.terms
    for atom, _ in monomial:
        if atom.argument is not None and atom.function == "sum":
            ratio = factor._ratio(atom.argument)
            if ratio is not None:
                return product * Expr({((atom, 1),): ratio})
    return product * _as_factor(factor)


def _expanded(first: Expr, second: Expr) -> Expr:
    """Return the product of two expressions, term by term."""
    if len(first.terms) * len(second.terms) > LARGEST_PRODUCT:
        first, second = (_closed(e) for e in (first, second))
    result: dict[Monomial, int | Fraction] = {}
    rest: list[Expr] = []
    for m, c in first.terms.items():
        for n, d in second.terms.items():
            monomial, more = _product(m, n)
            if more is not None:
                rest.append(Expr({monomial: c * d}) * more)
                continue
            total = result.get(monomial, 0) + c * d
            if total:
                result[monomial] = total
            else:
                del result[monomial]
    value = Expr(result)
    for more in rest:
        value = value + more
    return value


def _closed(expr: Expr) -> Expr:
    """Return a long sum without velocities as one atom, so that products with it stay short."""
    if len(expr.terms) <= 8 or any(s.kind == "velocity" for s in expr.symbols()):
        return expr
    return _as_factor(expr)


def function_of(name: str, argument: Any) -> Expr:
    """Return a function of an expression."""
    argument = Expr.of(argument)
    if name == "sqrt":
        _check_root(argument)
        if len(argument.terms) == 1:  # √(x⁴ y) = x² √y has all derivatives where x is 0
            ((monomial, c),) = argument.terms.items()
            even = tuple((a, n // 2) for a, n in monomial if n % 4 == 0)
            if even:
                rest = Expr({tuple((a, n) for a, n in monomial if n % 4): c})
                return Expr({even: 1}) * function_of("sqrt", rest)
    number = argument.number
    if number is not None:
        try:
            return Expr.of(getattr(math, name)(number))
        except ValueError as error:
            raise FormulaError(f"a formula takes xp.{name} of {number:g}") from error
    if name in ("sin", "cos", "atan", "tanh") and _leads_negative(argument):
        # One atom for an angle and its opposite.
        opposite = function_of(name, -argument)
        return opposite if name == "cos" else -opposite
    return Expr({((Atom("function", name, argument), 1),): 1})


def _check_root(argument: Expr) -> None:
    """Refuse √x² of a moving quantity: it is |x|, and not smooth."""
    root = _root(argument)
    moving = root is not None and any(s.kind != "parameter" for s in root.symbols())
    if not moving and len(argument.terms) == 1:  # a square times something
        squares = (a for a, n in next(iter(argument.terms)) if n % 4 == 2)
        moving = any(s.kind != "parameter" for a in squares for s in Expr.of(a).symbols())
    if moving:
        raise FormulaError(
            f"xp.sqrt of the square {argument.text:.60} is an absolute value; an energy must be smooth: "
            "write the number itself if it is positive, or xp.sqrt(x * x + eps * eps) to round the corner"
        )


def _root(square: Expr) -> Expr | None:
    """Return an expression with this square, or None if none is recognised."""
    parts: dict[Monomial, Fraction] = {}
    for monomial, c in square.sorted_terms():
        whole = Fraction(c)
        roots = [math.isqrt(n) if n > 0 else 0 for n in (whole.numerator, whole.denominator)]
        if all(n % 2 == 0 for _, n in monomial) and [r * r for r in roots] == [
            whole.numerator,
            whole.denominator,
        ]:
            parts[tuple((a, n // 2) for a, n in monomial)] = Fraction(*roots)
    root = Expr({})
    for monomial, c in parts.items():
        term = Expr({monomial: c})
        mixed = 2 * root * term
        opposite = any(square.terms.get(m, 0) == -d for m, d in mixed.terms.items())
        root = root - term if opposite else root + term
    # An even power must not be mistaken for a square that occurs by chance: only the whole decides.
    odd = any(n % 2 for monomial in root.terms for _, n in monomial) or len(root.terms) > 1
    return root if odd and _expanded(root, root).same(square) else None


def _leads_negative(expr: Expr) -> bool:
    return expr.sorted_terms()[0][1] < 0


class RecordedFunctions:
    """The namespace ``xp`` of a formula that is recorded."""

    pi = math.pi
    sin, cos, exp, log, sqrt, atan, tanh = (
        staticmethod(partial(function_of, name))
        for name in ("sin", "cos", "exp", "log", "sqrt", "atan", "tanh")
    )
    arctan = atan

    def tan(self, x: Any) -> Any:
        """Return the tangent."""
        return function_of("sin", x) / function_of("cos", x)

    def __getattr__(self, name: str) -> Any:
        remedy = f": write {INSTEAD[name]}" if name in INSTEAD else ""
        if name in ("where", "abs", "sign", "min", "max", "minimum", "maximum", "floor", "clip"):
            remedy = ": it must be smooth"
        known = "xp.sin, cos, tan, atan, tanh, sqrt, exp, log and pi"
        raise FormulaError(f"a formula uses xp.{name}; an energy has {known}{remedy}")


# --- calculus -----------------------------------------------------------------------------------------------


def _slope(atom: Atom) -> Expr:
    """Return the derivative of a function with respect to its argument."""
    x = atom.argument
    assert x is not None
    if atom.function == "sin":
        return function_of("cos", x)
    if atom.function == "cos":
        return -function_of("sin", x)
    if atom.function == "exp":
        return Expr.of(atom)
    if atom.function == "log":
        return x.reciprocal()
    if atom.function == "sqrt":
        return Fraction(1, 2) * Expr.of(atom).reciprocal()
    if atom.function == "atan":
        return (1 + x * x).reciprocal()
    if atom.function == "tanh":  # kept whole: its series has all digits also where tanh is nearly 1
        return Expr.of(Atom("function", "sum", 1 - Expr.of(atom) * Expr.of(atom)))
    return Expr.of(1)  # a sum


def derivative(expr: Expr, symbol: Atom) -> Expr:
    """Return the partial derivative of an expression with respect to a symbol."""
    chain: dict[Atom, Expr] = {}
    total = Expr({})
    for monomial, c in expr.terms.items():
        for i, (atom, n) in enumerate(monomial):
            if atom is symbol:
                inner = Expr.of(1)
            elif atom.argument is None:
                continue
            else:
                if atom not in chain:
                    slope = derivative(atom.argument, symbol)
                    chain[atom] = _expanded(_slope(atom), slope) if slope.terms else slope
                inner = chain[atom]
                if not inner.terms:
                    continue
            lower = ((atom, n - 1),) if n != 1 else ()
            rest = Expr({monomial[:i] + lower + monomial[i + 1 :]: c * n})
            total = total + _expanded(rest, inner)  # so that terms of an equation can combine
    return total


def substitute(expr: Expr, values: Mapping[Atom, Expr]) -> Expr:
    """Return the expression with symbols replaced."""
    if not expr.symbols() & set(values):
        return expr
    total = Expr({})
    for monomial, c in expr.terms.items():
        product, with_velocity = Expr.of(c), Expr({monomial: c})._has_velocity()
        for atom, n in monomial:
            if atom in values:
                factor = values[atom]
            elif atom.argument is None:
                factor = Expr.of(atom)
            else:
                inner = substitute(atom.argument, values)
                if atom.function != "sum":
                    factor = function_of(atom.function, inner)
                else:
                    factor = _whole(inner) if with_velocity or inner._is_apart() else inner
            with apart(atom.function == "sum" or _apart.get()):  # what was kept, is kept again
                power = factor**n
            product = product * power
        total = total + product
    return total


def linear_opened(loss: Expr) -> Expr:
    """Return a dissipation with the squares multiplied out whose drag is linear: its terms can combine."""
    total = Expr({})
    for monomial, c in loss.terms.items():
        moving = [f for f in monomial if any(s.kind != "parameter" for s in Expr.of(f[0]).symbols())]
        term = Expr({monomial: c})
        if len(moving) == 1 and moving[0][0].function == "sum" and moving[0][1] == 2:
            inner: Any = moving[0][0].argument
            rest = Expr({tuple(f for f in monomial if f not in moving): c})
            term = _expanded(_expanded(inner, inner), rest)
        total = total + term
    return total


def opened(expr: Expr) -> Expr:
    """Return the expression with the sums multiplied out whose terms may combine with others.

    These are factors of velocities, and the squares that `apart` has kept.
    """
    total = Expr({})
    for monomial, c in expr.terms.items():
        kept, with_velocity = [], Expr({monomial: c})._has_velocity()
        product = Expr.of(c)
        for atom, n in monomial:
            inner = atom.argument if atom.function == "sum" and 1 <= n <= 2 else None
            if inner is not None and (with_velocity or (n == 2 and inner._is_apart())):
                for _ in range(n):
                    product = _expanded(product, inner)
            else:
                kept.append((atom, n))
        total = total + _expanded(product, Expr({tuple(kept): 1}))
    return total


def evaluate(exprs: Iterable[Expr], values: Mapping[Atom, Any], xp: Any) -> list:
    """Evaluate expressions on numbers of any kind.

    Parameters
    ----------
    exprs : iterable of Expr
        The expressions.
    values : mapping from Atom to number
        A number for every symbol: floats, arrays, mpmath's or SymPy's. Fractions are combined exactly and
        rounded once, so that (R - r)² keeps its digits although it is expanded.
    xp : namespace
        Functions for these numbers, named as in NumPy or as here (``arctan`` or ``atan``).
    """
    known: dict[Atom, Any] = dict(values)
    rational = getattr(xp, "Rational", None)

    def value(atom: Atom) -> Any:
        if atom not in known:
            assert atom.argument is not None, f"no value for {atom.text}"
            inner = of(atom.argument)
            if atom.function != "sum":
                if isinstance(inner, Fraction) and rational is not Fraction:
                    inner = number(inner)
                inner = _call(xp, atom.function, inner)
            known[atom] = inner
        return known[atom]

    def of(expr: Expr) -> Any:
        collected: dict[Monomial, Any] = {}
        for monomial, c in expr.sorted_terms():
            rest = []
            for atom, n in monomial:
                if isinstance(x := value(atom), Fraction):
                    c = c * x**n
                else:
                    rest.append((atom, n))
            key = tuple(rest)
            collected[key] = collected.get(key, 0) + c
        if collected.keys() <= {()}:
            return collected.get((), 0)
        total: Any = None
        for monomial, c in collected.items():
            product: Any = None
            for atom, n in monomial:
                power = known[atom] if n > 0 else 1 / known[atom]
                for _ in range(abs(n)):
                    product = power if product is None else product * power
            term = number(c) if product is None else (product if c == 1 else product * number(c))
            total = term if total is None else total + term
        return total

    def number(c: int | Fraction) -> Any:
        if isinstance(c, int):
            return c
        if (exact := getattr(xp, "mpf", None)) is not None:
            return exact(c.numerator) / c.denominator
        if rational is not None:
            return rational(c.numerator, c.denominator)
        try:
            return float(c)
        except OverflowError:
            return math.copysign(math.inf, c)

    return [number(x) if isinstance(x, Fraction) else x for x in map(of, exprs)]


def _call(xp: Any, name: str, x: Any) -> Any:
    if name == "atan" and not hasattr(xp, "atan"):
        name = "arctan"
    return getattr(xp, name)(x)
