"""From equations of motion to a record of series: the computations of each order, without repetition.

All printers print this record (`lag_envs.stepping.series`). Its nodes are series in time: coordinates,
velocities, their functions, products and weighted sums. Weights do not change within a step: they are
scalars, computed once from the held control and from constants. Constants are polynomials in the parameters,
computed once per scene; if one is zero, the terms that it multiplies are left out (`Lowering.without`).

Products are the main cost, order² each; sums cost only order. So common factors are pulled out of sums,
squares are made first, and parts that two equations share are computed once.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

from lag_envs.mechanics.algebra import Atom, Expr, derivative
from lag_envs.stepping.elementary import ElementaryTrace, fading
from lag_envs.stepping.tracing import Operation, Trace, TracedNumber

#: A weight in a sum: a scalar's name, or a number.
Weight = str | float

#: Kinds of symbols that change within a step.
VARYING = frozenset({"place", "velocity"})
#: Symbols for the functions of `fading`, of the time since the control step began in units of the lag.
FADING = ("fading_0", "fading_1", "fading_2")

#: The time since the control step began: a symbol in the places of prescribed coordinates, and an input.
CLOCK = Atom("clock", "elapsed")
ELAPSED = "clock_elapsed"

#: Nodes whose series are known from the start.
KNOWN = frozenset({"polynomial", "decay"})

#: Functions that are integrated along their argument.
FUNCTIONS = frozenset({"sin", "cos", "exp", "log", "atan", "tanh"})


@dataclasses.dataclass(frozen=True)
class Node:
    """A series in time.

    ``op`` is one of ``place``, ``velocity`` (of the free coordinate `index`), ``polynomial`` (known from the
    start: `weights` are its coefficients in powers of t), ``decay`` (a polynomial plus an exponential:
    `weights` are the first coefficients c_k, four at most, and then a rate, with which all further ones are
    c_k = c_{k-1} rate/k), ``sum`` (`weights` times `args`, plus a constant `weights[-1]`), ``product``,
    ``reciprocal``, ``sqrt`` (of `args`), and the functions `FUNCTIONS`. These obey z' = w x'. Their `args`
    are x, w (of a cosine: -w), and x' if x is a weighted sum of places.
    """

    op: str
    args: tuple[int, ...] = ()
    weights: tuple[Weight, ...] = ()
    index: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class SeriesRecord:
    """The computation of a step. Records with the same `digest` have the same code.

    Attributes
    ----------
    size : int
        Number of free coordinates.
    inputs : tuple of str
        Names of the scalars that are given: constants, held controls, moving prescribed coordinates.
    constants : mapping from str to Expr
        Constants among them, as expressions in the parameters.
    scalars : tuple of Operation
        Operations that compute the weights from the inputs.
    nodes : tuple of Node
        Ordered so that each needs only earlier ones (at the same order of the series).
    mass : mapping from (i, j), i <= j, to (node, weight, constant)
        Entries of the mass matrix, weight times node plus constant; the node is -1 if the entry does not
        change.
    force : tuple of int
        Nodes of the right-hand side; -1 where it vanishes.
    tangents : mapping from str to mapping
        For scalars that depend on controls, starts or chosen parameters, their derivatives with respect to
        each of them; empty unless asked for.
    """

    size: int
    inputs: tuple[str, ...]
    constants: Mapping[str, Expr]
    scalars: tuple[Operation, ...]
    nodes: tuple[Node, ...]
    mass: Mapping[tuple[int, int], tuple[int, Weight, Weight]]
    force: tuple[int, ...]
    tangents: Mapping[str, Mapping[str, Weight]] = dataclasses.field(default_factory=dict)

    @property
    def given(self) -> tuple[str, ...]:
        """The inputs that are the same for all substeps, that is, all but the time."""
        return tuple(name for name in self.inputs if name != ELAPSED)

    @cached_property
    def digest(self) -> str:
        """A digest of everything that decides the code; how the constants are computed does not."""
        parts: tuple = (
            self.size,
            self.inputs,
            self.scalars,
            self.nodes,
            sorted(self.mass.items()),
            self.force,
        )
        if self.tangents:
            parts += (sorted((name, sorted(slopes.items())) for name, slopes in self.tangents.items()),)
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SeriesRecord) and other.digest == self.digest

    def __hash__(self) -> int:
        return hash(self.digest)


class Lowering:
    """Builds a `SeriesRecord`.

    Parameters
    ----------
    free : sequence of str
        Names of the free coordinates.
    prescribed : mapping from str to sequence of Expr
        For each moving prescribed coordinate its place as a polynomial in time: coefficients in symbols of
        kind ``control`` (held), ``start`` (its place and rate when the control step begins) and `CLOCK`.
    tangents : sequence of str, optional
        Parameters with respect to which the scalars get derivatives, besides controls and starts; by default
        the scalars get no derivatives at all.
    rates : mapping from str to Expr
        With lagged controls: for each control, and for each coordinate that it moves, the rate of its
        exponential. Then `prescribed` contains the controls too, with coefficients as in a node ``decay``,
        in symbols of kind ``command``, ``gap``, ``decay`` and `FADING` in place of ``control``.
    """

    def __init__(
        self,
        free: Sequence[str],
        prescribed: Mapping[str, Sequence[Expr]],
        tangents: Sequence[str] | None = None,
        rates: Mapping[str, Expr] = MappingProxyType({}),
    ) -> None:
        self._wanted = tangents
        self._rates = rates
        self._varying = VARYING | {"control"} if rates else VARYING
        self._faded: dict[str, tuple] = {}
        self._slopes: dict[str, dict[str, Any]] = {}
        self._exprs: dict[str, Expr] = {}
        self._free = list(free)
        self._prescribed = dict(prescribed)
        self._trace: Trace = ElementaryTrace()
        self._inputs: dict[str, TracedNumber] = {}
        self.constants: dict[str, Expr] = {}
        self._by_text: dict[str, str] = {}
        self._scalars: dict[str, Any] = {}
        self.nodes: list[tuple] = []
        self._known: dict[tuple, int] = {}
        self._atoms: dict[Atom, int] = {}

    # --- scalars --------------------------------------------------------------------------------------------

    def _input(self, name: str) -> TracedNumber:
        if name not in self._inputs:
            (self._inputs[name],) = self._trace.inputs(name)
        return self._inputs[name]

    def _constant(self, expr: Expr) -> Any:
        """Return a number, or the input for an expression in the parameters."""
        number = expr.number
        if number is not None:
            return number
        if expr.text not in self._by_text:
            name = f"c{len(self.constants)}"
            self._by_text[expr.text] = name
            self.constants[name] = expr
        return self._input(self._by_text[expr.text])

    def scalar(self, expr: Expr) -> Any:
        """Return the recorded number of an expression that does not change within a step."""
        if expr.text not in self._scalars:
            by_monomial: dict[tuple, Expr] = {}
            for monomial, c in expr.sorted_terms():
                held = tuple((a, n) for a, n in monomial if not _is_constant(a))
                rest = tuple((a, n) for a, n in monomial if _is_constant(a))
                by_monomial[held] = by_monomial.get(held, Expr({})) + Expr({rest: c})
            total: Any = 0.0
            for held, weight in by_monomial.items():
                value = self._constant(weight)
                for atom, n in held:
                    number = self._held(atom)
                    for _ in range(abs(n)):
                        value = value * number if n > 0 else value / number
                total = total + value
            self._scalars[expr.text] = total
            if isinstance(total, TracedNumber):
                self._exprs[total.name] = expr
        return self._scalars[expr.text]

    def _differentiate(self, weights: Sequence[Any]) -> None:
        """Record the derivatives of weights with respect to their chosen sources."""
        for weight in weights:
            if self._wanted is None or not isinstance(weight, TracedNumber) or weight.name in self._slopes:
                continue
            expr = self._exprs[weight.name]
            self._slopes[weight.name] = {
                f"{s.kind}_{s.name}": self.scalar(derivative(expr, s))
                for s in sorted(expr.symbols(), key=lambda s: s.text)
                if s.kind in ("control", "start") or (s.kind == "parameter" and s.name in self._wanted)
            }

    def _held(self, atom: Atom) -> Any:
        if atom.kind in FADING:
            if atom.name not in self._faded:
                parts = self._input(ELAPSED) * self._input(f"decay_{atom.name}")
                self._faded[atom.name] = fading(parts, self._trace)
            return self._faded[atom.name][FADING.index(atom.kind)]
        if atom.argument is None:
            return self._input(f"{atom.kind}_{atom.name}")
        inner = self.scalar(atom.argument)
        if atom.function == "sum":
            return inner
        return getattr(self._trace, atom.function)(inner)

    # --- series ---------------------------------------------------------------------------------------------

    def _node(self, op: str, args: Sequence[int] = (), weights: Sequence[Any] = (), index: int = 0) -> int:
        key = (op, tuple(args), tuple(_key(w) for w in weights), index)
        if key not in self._known:
            self._known[key] = len(self.nodes)
            self.nodes.append((op, tuple(args), tuple(weights), index))
        return self._known[key]

    def _product(self, a: int, b: int) -> int:
        return self._node("product", (min(a, b), max(a, b)))

    def _varies(self, atom: Atom) -> bool:
        if atom.argument is None:
            return atom.kind in self._varying
        return any(s.kind in self._varying for s in atom.argument.symbols())

    def _atom(self, atom: Atom) -> int:
        """Return the node of an atom that changes within a step."""
        if atom not in self._atoms:
            self._atoms[atom] = self._make(atom)
        return self._atoms[atom]

    def _make(self, atom: Atom) -> int:
        if atom.argument is None:
            if atom.name in self._prescribed:
                terms = list(self._prescribed[atom.name])
                if atom.kind == "velocity":
                    terms = [e * k for k, e in enumerate(terms)][1:]
                if atom.name in self._rates:
                    return self._node("decay", (), [self.scalar(e) for e in (*terms, self._rates[atom.name])])
                return self._node("polynomial", (), [self.scalar(e) for e in terms])
            return self._node(atom.kind, index=self._free.index(atom.name))
        if atom.function == "sum":
            return self.series(atom.argument)
        x = self.series(atom.argument)
        if atom.function == "sqrt":
            return self._node("sqrt", (x,))
        rate = self._rate(atom.argument)
        key = ("pair" if atom.function in ("sin", "cos") else atom.function, x)
        if key not in self._known:
            slope = None
            if atom.function == "atan":
                slope = self._node("reciprocal", (self._node("sum", (self._product(x, x),), (1.0, 1.0)),))
            elif atom.function == "log":
                slope = self._node("reciprocal", (x,))
            first = len(self.nodes)
            self._known[key] = first
            if key[0] == "pair":  # sine and cosine are made together; each is the other's slope
                self.nodes += [("sin", (x, first + 1, *rate), (), 0), ("cos", (x, first, *rate), (), 0)]
            elif atom.function == "tanh":  # the slope is 1 - tanh²
                self.nodes.append(("tanh", (x, first + 2, *rate), (), 0))
                self._node("sum", (self._product(first, first),), (-1.0, 1.0))
            else:
                self.nodes.append((atom.function, (x, first if slope is None else slope, *rate), (), 0))
        return self._known[key] + (atom.function == "cos")

    def _rate(self, argument: Expr) -> tuple[int, ...]:
        """Return the node of an argument's rate if it is a weighted sum of places, else ()."""
        total = Expr({})
        for monomial, c in argument.terms.items():
            varying = [(atom, n) for atom, n in monomial if self._varies(atom)]
            if varying:
                ((atom, n), *more) = varying
                if more or n != 1 or atom.argument is not None or atom.kind != "place":
                    return ()
                rest = {tuple(f for f in monomial if f[0] is not atom): c}
                total = total + Expr(rest) * Expr.of(Atom("velocity", atom.name))
        return (self.series(total),)

    def series(self, expr: Expr) -> int:
        """Return the node of an expression that changes within a step."""
        terms: dict[tuple[tuple[int, int], ...], Expr] = {}
        for monomial, c in expr.sorted_terms():
            factors: Counter[int] = Counter()
            rest = []
            for atom, n in monomial:
                if self._varies(atom):
                    node = self._atom(atom)
                    factors[node if n > 0 else self._node("reciprocal", (node,))] += abs(n)
                else:
                    rest.append((atom, n))
            key = tuple(sorted(self._halved(factors).items()))
            terms[key] = terms.get(key, Expr({})) + Expr({tuple(rest): c})
        return self._sum(self._factored({k: e for k, e in terms.items() if e.terms}))

    def _halved(self, factors: Counter[int]) -> Counter[int]:
        """Return the factors with higher powers replaced by squares of squares."""
        result: Counter[int] = Counter()
        pending = dict(factors)
        while pending:
            node, n = pending.popitem()
            if n > 1:
                square = self._product(node, node)
                pending[square] = pending.get(square, 0) + n // 2
            if n % 2:
                result[node] += 1
        return result

    def _factored(self, terms: Mapping[tuple[tuple[int, int], ...], Expr]) -> list[tuple[int, Expr]]:
        """Return a weighted sum of single nodes; node -1 stands for the constant."""
        result: list[tuple[int, Expr]] = []
        rest = dict(terms)
        while True:
            count = Counter(node for key in rest if len(key) > 1 for node, _ in key)
            if not count:
                break
            node, n = min(count.items(), key=lambda item: (-item[1], item[0]))
            if n == 1:
                break
            inner = {
                tuple(f for f in key if f[0] != node): e
                for key, e in rest.items()
                if len(key) > 1 and (node, 1) in key
            }
            rest = {key: e for key, e in rest.items() if not (len(key) > 1 and (node, 1) in key)}
            factor, weight = self._single(self._factored(inner))
            result.append((self._product(node, factor), weight))
        for key, e in rest.items():
            nodes = [node for node, _ in key]
            while len(nodes) > 1:
                pairs = [(a, b) for i, a in enumerate(nodes) for b in nodes[i + 1 :]]
                a, b = next((p for p in pairs if ("product", p, (), 0) in self._known), pairs[0])
                nodes.remove(a)
                nodes.remove(b)
                nodes.append(self._product(a, b))
                nodes.sort()
            result.append((nodes[0] if nodes else -1, e))
        return result

    def _single(self, terms: list[tuple[int, Expr]]) -> tuple[int, Expr]:
        """Return one node and its weight; a common weight is pulled out so that nodes can be shared."""
        first = terms[0][1]
        if all(e.same(first) or e.same(-first) for _, e in terms):
            one = Expr.of(1)
            return self._sum([(n, one if e.same(first) else -one) for n, e in terms]), first
        return self._sum(terms), Expr.of(1)

    def _sum(self, terms: list[tuple[int, Expr]]) -> int:
        total: dict[int, Expr] = {}
        for node, e in terms:
            total[node] = total.get(node, Expr({})) + e
        constant = total.pop(-1, Expr({}))
        items = [(n, e) for n, e in total.items() if e.terms]
        if len(items) == 1 and not constant.terms and items[0][1].number == 1.0:
            return items[0][0]
        weights = [*(self.scalar(e) for _, e in items), self.scalar(constant)]
        return self._node("sum", [n for n, _ in items], weights)

    # --- the whole ------------------------------------------------------------------------------------------

    def parts(self, mass: Mapping[tuple[int, int], Expr], force: Sequence[Expr]) -> tuple[list[int], dict]:
        """Return nodes of the right-hand sides and entries of the mass matrix; see `without`.

        Parameters
        ----------
        mass : mapping from (i, j), i <= j, to Expr
            Mass matrix.
        force : sequence of Expr
            Right-hand side.
        """
        right = [self.series(e) if e.terms else -1 for e in force]
        entries: dict[tuple[int, int], tuple[int, Any]] = {}
        for where, e in sorted(mass.items()):
            varying = any(self._varies(a) for a in e.atoms())
            entries[where] = (self.series(e), 0.0) if varying else (-1, self.scalar(e))  # node, constant
        self._differentiate(_weights(self.nodes, entries))
        return right, entries

    def without(
        self, right: list[int], entries: dict, zero: frozenset[str] = frozenset(), fused: bool = True
    ) -> SeriesRecord:
        """Leave out the terms of constants that are zero, and everything unused.

        Terms are left out after products have been arranged, so the other terms round as if nothing had been
        left out.
        """
        weights = _weights(self.nodes, entries)
        slopes = [
            (w.name, source, slope)
            for w in {w.name: w for w in weights if isinstance(w, TracedNumber)}.values()
            for source, slope in self._slopes.get(w.name, {}).items()
        ]
        operations, results = self._trace.operations([*weights, *(s for *_, s in slopes)], zero, fused=fused)
        value = iter(results)
        called = {w.name: r for w, r in zip(weights, results, strict=False) if isinstance(w, TracedNumber)}
        tangents: dict[str, dict[str, Weight]] = {}
        for (name, source, _), slope in zip(slopes, results[len(weights) :], strict=True):
            if isinstance(called[name], str) and slope != 0.0:
                tangents.setdefault(str(called[name]), {})[source] = slope
        now: dict[int, int] = {-1: -1}  # -1: the series vanishes
        nodes: list[Node] = []

        def vanish(i: int) -> None:
            """Leave a series out, or keep it as a zero if it is an argument of a function."""
            now[i] = len(nodes) if i in arguments else -1
            if i in arguments:
                nodes.append(Node("sum", (), (0.0,)))

        arguments = {args[0] for op, args, _, _ in self.nodes if op not in ("sum", "product") and args}
        # Slopes may be referred to before they are made, because they follow at a fixed distance.
        for i, (op, args, ws, index) in enumerate(self.nodes):
            numbers = tuple(next(value) for _ in ws)
            if op == "sum":
                pairs = [(now[a], w) for a, w in zip(args, numbers[:-1], strict=True)]
                pairs = [(a, w) for a, w in pairs if a >= 0 and w != 0.0]
                if not pairs and numbers[-1] == 0.0:
                    vanish(i)
                elif len(pairs) == 1 and pairs[0][1] == 1.0 and numbers[-1] == 0.0:
                    now[i] = pairs[0][0]
                else:
                    now[i] = len(nodes)
                    nodes.append(
                        Node("sum", tuple(a for a, _ in pairs), (*(w for _, w in pairs), numbers[-1]))
                    )
                continue
            if (op == "product" and any(now[a] < 0 for a in args)) or (
                op in KNOWN and all(w == 0.0 for w in numbers[: len(numbers) - (op == "decay")])
            ):
                vanish(i)
                continue
            now[i] = len(nodes)
            found = [now[a] if a < i else now[i] + a - i for a in args]
            nodes.append(Node(op, tuple(a for a in found if a >= 0), numbers, index))  # a rate may vanish
        mass = {}
        for place, (node, _) in entries.items():
            weight: Weight = 1.0
            constant: Weight = next(value)
            node = now[node]
            if node >= 0 and nodes[node].op == "sum" and len(nodes[node].args) < 2:
                *several, constant = nodes[node].weights
                weight, node = (several[0], nodes[node].args[0]) if several else (1.0, -1)
            if node >= 0 or constant != 0.0:
                mass[place] = (node, weight, constant)
        return _needed(
            len(self._free),
            tuple(self._inputs),
            self.constants,
            operations,
            nodes,
            mass,
            [now[r] for r in right],
            tangents,
        )


def _needed(
    size: int, inputs: Any, constants: Any, operations: Any, nodes: Any, mass: Any, force: Any, tangents: Any
) -> SeriesRecord:
    used: set[int] = set()
    stack = [n for n, _, _ in mass.values()] + list(force)
    while stack:
        n = stack.pop()
        if n >= 0 and n not in used:
            used.add(n)
            stack += nodes[n].args
    renumber = {old: new for new, old in enumerate(sorted(used))} | {-1: -1}
    kept = tuple(
        dataclasses.replace(nodes[n], args=tuple(renumber[a] for a in nodes[n].args)) for n in sorted(used)
    )
    weights = {w for node in kept for w in node.weights} | {w for _, *ws in mass.values() for w in ws}
    names = {w for w in weights if isinstance(w, str)}
    tangents = {name: slopes for name, slopes in tangents.items() if name in names}
    names |= {w for slopes in tangents.values() for w in slopes.values() if isinstance(w, str)}
    lines = []
    for operation in reversed(operations):
        if operation.name in names:
            lines.append(operation)
            names |= {a for a in operation.args if isinstance(a, str)}
    given = tuple(name for name in inputs if name in names)
    return SeriesRecord(
        size,
        given,
        {name: e for name, e in constants.items() if name in given},
        tuple(lines[::-1]),
        kept,
        {place: (renumber[n], *ws) for place, (n, *ws) in mass.items()},
        tuple(renumber[n] for n in force),
        tangents,
    )


def _weights(nodes: Sequence[tuple], entries: Mapping) -> list:
    """Return all weights of nodes and of entries of the mass matrix, in order."""
    return [w for _, _, ws, _ in nodes for w in ws] + [w for _, w in entries.values()]


def _key(weight: Any) -> Any:
    return weight.name if isinstance(weight, TracedNumber) else float(weight)


def _is_constant(atom: Atom) -> bool:
    if atom.argument is None:
        return atom.kind == "parameter"
    return all(s.kind == "parameter" for s in atom.argument.symbols())
