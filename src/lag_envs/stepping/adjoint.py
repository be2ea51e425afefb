"""Reverse mode on a record: from the operations of a formula those of its derivatives.

A formula is run on the recording numbers of `Differentiable`, which keeps sines and exponentials whole. The
record is then walked backwards, and what each operation passes on to its operands is recorded too. The
result is printed like any other record, with the same arithmetic for sines (`stepping/elementary.py`).

Where a formula has kinks the derivative is that of the branch that its value came from: of ``minimum`` and
``maximum`` at a tie that of the first operand, of ``abs`` at 0 that from above. What a comparison or
``floor`` gives has the derivative 0. A branch that was not taken passes on exactly 0, whatever its numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from lag_envs.stepping.compiling import BLOCK, compile_function, record_block
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.tracing import BOOLEAN, Number, Operation, Trace


def _whole(name: str) -> Callable:
    function = getattr(math, name)

    def of(self: Differentiable, a: Any) -> Any:
        return self.record(name, a) if isinstance(a, Number) else function(a)

    of.__doc__ = f"Return {name} of a number."
    return of


class Differentiable(Trace):
    """A recording in which functions are single operations."""

    sin, cos, exp, log, atan, tanh = map(_whole, ("sin", "cos", "exp", "log", "atan", "tanh"))
    arctan = atan

    def tan(self, a: Any) -> Any:
        """Return the tangent."""
        return self.sin(a) / self.cos(a)

    def adjoint(self, outputs: Sequence[Any], seeds: Sequence[Any], inputs: Sequence[Number]) -> list:
        """Record and return Σ seed ∂output/∂input for each input.

        Parameters
        ----------
        outputs : sequence of number
            What is differentiated.
        seeds : sequence of number
            One for each output, its cotangent.
        inputs : sequence of Number
            By what.
        """
        total: dict[str, Any] = {}

        def pass_on(to: Any, amount: Any) -> None:
            if isinstance(to, Number):
                total[to.name] = total.get(to.name, 0.0) + amount

        for output, seed in zip(outputs, seeds, strict=True):
            pass_on(output, seed)
        nodes = list(self._nodes)
        branches = self._branches(nodes)
        for node in reversed(nodes):
            seed = total.pop(node.name, None)
            if seed is None or node.op in BOOLEAN or node.op == "floor":
                continue
            for operand, amount in self._shares(node, seed):
                if node.name in branches and node.op not in ("+", "-", "neg", "where"):
                    amount = self.where(0.0 < self.abs(seed), amount, 0.0)
                pass_on(operand, amount)
        return [total.get(number.name, 0.0) for number in inputs]

    def _shares(self, node: Number, seed: Any) -> list[tuple[Any, Any]]:
        """Return the operands of an operation, and what each gets of its cotangent."""
        a, b, c = (*node.args, None, None)[:3]
        if node.op == "where":
            return [(b, self.where(a, seed, 0.0)), (c, self.where(a, 0.0, seed))]
        if node.op == "/":
            share = seed / b
            return [(a, share), (b, -(share * node))]
        if node.op == "*":
            return [(a, seed * b), (b, seed * a)]
        if node.op in ("+", "-"):
            return [(a, seed), (b, seed if node.op == "+" else -seed)]
        rule = {
            "neg": lambda: -seed,
            "abs": lambda: self.where(a < 0.0, -seed, seed),
            "sqrt": lambda: 0.5 * (seed / node),
            "exp": lambda: seed * node,
            "log": lambda: seed / a,
            "sin": lambda: seed * self.cos(a),
            "cos": lambda: -(seed * self.sin(a)),
            "atan": lambda: seed / (1.0 + a * a),
            "tanh": lambda: seed * (1.0 - node * node),
        }.get(str(node.op))
        if rule is None:
            raise TypeError(f"a formula calls {node.op!r}, of which there is no derivative")
        return [(a, rule())]

    @staticmethod
    def _branches(nodes: Sequence[Number]) -> set[str]:
        """Return the operations that lead into one of two branches: there numbers may be of any kind."""
        found: set[str] = set()
        for node in reversed(nodes):
            operands = node.args[1:] if node.op == "where" else node.args if node.name in found else ()
            found |= {a.name for a in operands if isinstance(a, Number)}
        return found


def replay(operations: Sequence[Operation], values: Mapping[str, Any], trace: Trace) -> dict[str, Any]:
    """Carry out operations on the numbers of another recording; return all results by name."""
    known = dict(values)
    for name, op, args in operations:
        numbers = [known[a] if isinstance(a, str) else a for a in args]
        function = getattr(trace, op, None) if op.isalpha() and op != "neg" else None
        known[name] = function(*numbers) if function else trace.record(op, *numbers)
    return known


def compile_lanes(
    name: str,
    formula: Callable,
    inputs: Sequence[str],
    constants: Sequence[str],
    absent: Collection[str],
    outputs: int,
) -> Callable:
    """Compile ``name(given, found, numbers)``, which carries out a formula for each lane of a batch.

    Parameters
    ----------
    name : str
        Name of the compiled function.
    formula : callable
        ``formula(trace, numbers)`` takes a `Differentiable` and a dict of numbers by name, and returns
        `outputs` numbers.
    inputs : sequence of str
        Rows of `given`, of shape (inputs, lanes).
    constants : sequence of str
        What the lanes have in common: the entries of `numbers`.
    absent : collection of str
        Constants that are known to be zero.
    outputs : int
        Rows of `found`, of shape (outputs, lanes).
    """
    trace = Differentiable()
    numbers = {n: trace.zero() if n in absent else trace.inputs(n)[0] for n in (*inputs, *constants)}
    operations, results = trace.operations(formula(trace, numbers), fused=False)
    target = ElementaryTrace()
    known = replay(operations, {n: target.inputs(n)[0] for n in numbers if n not in absent}, target)
    ends = [known[result] if isinstance(result, str) else float(result) for result in results]
    lines, values = record_block(target, {f"out{i}": end for i, end in enumerate(ends)})
    # As in `envs/program.py`: rows at distances known when compiling, so that lanes become vectors.
    body = [
        f"def {name}(given, found, numbers):",
        "wide_vectors()",
        f"rows, count = np.empty({(len(inputs) + outputs) * BLOCK}), np.uint64(given.shape[1])",
        *(f"{constant} = numbers[{j}]" for j, constant in enumerate(constants)),
        f"for block in range(np.uint64((given.shape[1] + {BLOCK - 1}) // {BLOCK})):",
        f"    first = block * np.uint64({BLOCK})",
        f"    size = min(np.uint64({BLOCK}), count - first)",
        *(
            line
            for j in range(len(inputs))
            for line in (
                "    for i in range(size):",
                f"        rows[np.uint64({j * BLOCK}) + i] = given[{j}, first + i]",
            )
        ),
        "    for i in range(size):",
        *(f"        {n} = rows[np.uint64({j * BLOCK}) + i]" for j, n in enumerate(inputs)),
        *(f"        {line}" for line in lines),
        *(
            f"        rows[np.uint64({(len(inputs) + j) * BLOCK}) + i] = {value}"
            for j, value in enumerate(values)
        ),
        *(
            line
            for j in range(outputs)
            for line in (
                "    for i in range(size):",
                f"        found[{j}, first + i] = rows[np.uint64({(len(inputs) + j) * BLOCK}) + i]",
            )
        ),
    ]
    return compile_function(name, "\n    ".join(body) + "\n")
