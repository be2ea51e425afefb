"""Identities of sine and cosine, applied to recorded formulas."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from lag_envs.mechanics.algebra import Atom, Expr, Monomial, function_of, opened


def apply_identities(expr: Expr) -> Expr:
    """Apply cos² + sin² = 1, and the addition formulas of cosine and sine, to terms that match.

    Two terms match if they agree in all but a pair of factors and their coefficients have the same size. As a
    result, energies written in Cartesian velocities become as short as energies written in angles.
    """
    terms = dict(expr.terms)
    while True:
        found = _meeting(terms)
        if found is None:
            return Expr(terms)
        for change in found:
            for monomial, c in change.items():
                total = terms.get(monomial, 0) + c
                if total:
                    terms[monomial] = total
                else:
                    terms.pop(monomial, None)


def shorter(energy: Expr) -> Expr:
    """Return an energy with its sums multiplied out if that leaves fewer terms that move.

    Terms may combine by cos² + sin² = 1, as in the squared distance of two points. Sums inside functions stay
    whole: under a root the constant matters, and digits would be lost.
    """
    multiplied = opened(energy)
    if multiplied.same(energy):
        return energy
    multiplied = apply_identities(multiplied)
    return multiplied if _moving(multiplied) < _moving(apply_identities(energy)) else energy


def _moving(expr: Expr) -> int:
    """Return the number of terms that change with the motion."""
    return sum(any(s.kind != "parameter" for a, _ in m for s in Expr.of(a).symbols()) for m in expr.terms)


def _meeting(terms: Mapping[Monomial, int | Fraction]) -> list[dict[Monomial, int | Fraction]] | None:
    """Return the changes of terms that one rule makes, or None if no rule applies."""
    for monomial in sorted(terms, key=lambda m: [(a.text, n) for a, n in m]):
        c = terms[monomial]
        waves = [(a, n) for a, n in monomial if a.function in ("sin", "cos")]
        for a, n in waves:
            if a.function == "sin" and n >= 2:
                partner = _exchange(monomial, {a: -2, _twin(a): 2})
                d = terms.get(partner)
                if d is not None and (c > 0) == (d > 0):
                    common: Any = c if abs(Fraction(c)) < abs(Fraction(d)) else d
                    return [{monomial: -common}, {partner: -common}, {_exchange(monomial, {a: -2}): common}]
        for x, (a, _) in enumerate(waves):
            for b, _ in waves[x + 1 :]:
                if a.argument is b.argument or a.argument.same(b.argument):  # type: ignore[union-attr, arg-type]
                    continue
                partner = _exchange(monomial, {a: -1, b: -1, _twin(a): 1, _twin(b): 1})
                d = terms.get(partner)
                if d is None or abs(c) != abs(d) or partner == monomial:
                    continue
                rest = Expr({_exchange(monomial, {a: -1, b: -1}): c})
                return [{monomial: -c}, {partner: -d}, (rest * _of_sum(a, b, c == d)).terms]
    return None


def _of_sum(a: Atom, b: Atom, alike: bool) -> Expr:
    """Return a b ± (twin of a)(twin of b) as one function of a sum of angles."""
    x, y = a.argument, b.argument
    assert x is not None and y is not None
    if a.function == b.function == "cos":
        return function_of("cos", x - y if alike else x + y)
    if a.function == b.function == "sin":
        return function_of("cos", x - y) if alike else -function_of("cos", x + y)
    if a.function == "cos":  # sin y cos x ± sin x cos y
        return function_of("sin", y + x if alike else y - x)
    return function_of("sin", x + y if alike else x - y)


def _twin(atom: Atom) -> Atom:
    return Atom("function", "cos" if atom.function == "sin" else "sin", atom.argument)


def _exchange(monomial: Monomial, change: Mapping[Atom, int]) -> Monomial:
    """Return the monomial with powers of some atoms changed."""
    powers = dict(monomial)
    for atom, n in change.items():
        powers[atom] = powers.get(atom, 0) + n
    return tuple(sorted(((a, n) for a, n in powers.items() if n), key=lambda p: p[0].text))
