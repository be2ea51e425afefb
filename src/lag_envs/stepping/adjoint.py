"""Reverse mode on a record: from the operations of a formula to the operations of its derivatives.

A formula is run on the recording numbers of `Differentiable`, which keeps sines and exponentials whole. The
record is then walked backwards, and the contributions of each operation to its operands' cotangents are
recorded too. The result is printed like any other record, with the same arithmetic for sines
(`stepping/elementary.py`).

Where a formula has kinks, the derivative is that of the branch that was taken: at a tie, ``minimum`` and
``maximum`` use the first operand; at 0, ``abs`` has the derivative from above. At 0, where the slope of
``sqrt`` is infinite, it counts as 0: most roots are distances, and the tip of a cone has no direction.
Comparisons and ``floor`` have the derivative 0. A branch that was not taken contributes exactly 0, whatever
its numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lag_envs.mechanics.evaluation import RATES
from lag_envs.stepping.compiling import compile_lines, record_block
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.tracing import BOOLEAN, Operation, Trace, TracedNumber

#: Number of lanes whose numbers lie together: few enough that all inputs and outputs fit into the nearest
#: cache.
LANES = 64


class Differentiable(Trace):
    """A recording in which functions are single operations."""

    def tan(self, a: Any) -> Any:
        """Return the tangent."""
        return self.sin(a) / self.cos(a)

    def atan(self, a: Any) -> Any:
        """Return the arc tangent."""
        return self.record("atan", a)

    arctan = atan

    def tanh(self, a: Any) -> Any:
        """Return the hyperbolic tangent."""
        return self.record("tanh", a)

    def adjoint(self, outputs: Sequence[Any], seeds: Sequence[Any], inputs: Sequence[TracedNumber]) -> list:
        """Record and return Σ seed ∂output/∂input for each input.

        Parameters
        ----------
        outputs : sequence of number
            The numbers to differentiate.
        seeds : sequence of number
            The cotangent of each output.
        inputs : sequence of TracedNumber
            The numbers to differentiate with respect to. Results of earlier operations count as independent
            inputs: nothing is passed on to the numbers from which they were computed.
        """
        total: dict[str, Any] = {}

        def pass_on(to: Any, amount: Any) -> None:
            if isinstance(to, TracedNumber):
                total[to.name] = total.get(to.name, 0.0) + amount

        for output, seed in zip(outputs, seeds, strict=True):
            pass_on(output, seed)
        nodes = self._between(outputs, {x.name for x in inputs if isinstance(x, TracedNumber)})
        branches = self._branches(nodes)
        for node in reversed(nodes):
            seed = total.pop(node.name, None)
            if seed is None or node.op in BOOLEAN or node.op == "floor":
                continue
            for operand, amount in self._shares(node, seed):
                if node.name in branches and node.op not in ("+", "-", "neg", "where"):
                    # A branch that is not taken gets exactly 0, even if its own slope is infinite. NaN is
                    # passed on.
                    amount = self.where(self.abs(seed) <= 0.0, 0.0, amount)
                pass_on(operand, amount)
        return [total.get(x.name, 0.0) if isinstance(x, TracedNumber) else 0.0 for x in inputs]

    def _between(self, outputs: Sequence[Any], inputs: set[str]) -> list[TracedNumber]:
        """Return the operations from these inputs to these outputs, in order."""
        needed, stack = set(inputs), list(outputs)
        while stack:
            value = stack.pop()
            if isinstance(value, TracedNumber) and value.name not in needed:
                needed.add(value.name)
                stack.extend(value.args)
        return [node for node in self._nodes if node.name in needed - inputs]

    def _shares(self, node: TracedNumber, seed: Any) -> list[tuple[Any, Any]]:
        """Return an operation's operands, each with its share of the cotangent."""
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
        if node.op == "neg":
            return [(a, -seed)]
        if node.op == "abs":
            return [(a, self.where(a < 0.0, -seed, seed))]
        rate = RATES.get(str(node.op))
        if rate is None:
            raise TypeError(f"a formula calls {node.op!r}, of which there is no derivative")
        share = seed * rate(a, node, self)
        return [(a, self.where(node <= 0.0, 0.0, share) if node.op == "sqrt" else share)]

    @staticmethod
    def _branches(nodes: Sequence[TracedNumber]) -> set[str]:
        """Return the operations that lead into branches of a selection; their numbers may be anything."""
        found: set[str] = set()
        for node in reversed(nodes):
            operands = node.args[1:] if node.op == "where" else node.args if node.name in found else ()
            found |= {a.name for a in operands if isinstance(a, TracedNumber)}
        return found


def rerun(operations: Sequence[Operation], values: Mapping[str, Any], trace: Trace) -> dict[str, Any]:
    """Carry out operations on the numbers of another recording; return all results by name."""
    known = dict(values)
    for name, op, args in operations:
        numbers = [known[a] if isinstance(a, str) else a for a in args]
        function = getattr(trace, op, None) if op.isalpha() and op != "neg" else None
        known[name] = function(*numbers) if function else trace.record(op, *numbers)
    return known


class LaneFormula:
    """A formula, compiled to be carried out for each lane of a batch.

    Parameters
    ----------
    name : str
        Name of the compiled function.
    formula : callable
        ``formula(trace, numbers)`` takes a `Differentiable` and a dict of numbers by name, and returns for
        each array of results a list of numbers.
    inputs : sequence of sequence of str
        For each array that is given, the names of its columns.
    constants : sequence of str
        Numbers that all lanes share.
    absent : collection of str
        Constants that are known to be zero.
    """

    def __init__(
        self,
        name: str,
        formula: Callable,
        inputs: Sequence[Sequence[str]],
        constants: Sequence[str],
        absent: Collection[str],
    ) -> None:
        trace = Differentiable()
        columns = {
            n: f"given{i}[first + i, {j}]" for i, names in enumerate(inputs) for j, n in enumerate(names)
        }
        numbers = {n: trace.zero() if n in absent else trace.inputs(n)[0] for n in (*columns, *constants)}
        found = formula(trace, numbers)
        operations, results = trace.operations([x for numbers in found for x in numbers])
        target = ElementaryTrace()
        known = rerun(operations, {n: target.inputs(n)[0] for n in numbers if n not in absent}, target)
        ends = [known[result] if isinstance(result, str) else float(result) for result in results]
        lines, values = record_block(target, {f"out{i}": end for i, end in enumerate(ends)})
        used = set(re.findall(r"\w+", " ".join([*lines, *map(str, values)])))
        columns = {n: place for n, place in columns.items() if n in used}
        places = [f"found{i}[first + i, {j}]" for i, x in enumerate(found) for j in range(len(x))]
        # As in `envs/program.py`: the rows' offsets are known at compile time, so that lanes become vectors.
        row = [f"rows[np.uint64({k * LANES}) + i]" for k in range(len(columns) + len(places))]
        into, out = row[: len(columns)], row[len(columns) :]
        work = [*(f"{n} = {at}" for n, at in zip(columns, into, strict=True)), *lines]
        work += [f"{at} = {value}" for at, value in zip(out, values, strict=True)]
        arrays = [f"given{i}" for i in range(len(inputs))], [f"found{i}" for i in range(len(found))]
        body = [
            "wide_vectors()",
            f"rows, count = aligned_zeros({len(row) * LANES}), np.uint64(found0.shape[0])",
            *(f"{constant} = numbers[{j}]" for j, constant in enumerate(constants)),
            f"for block in range(np.uint64((found0.shape[0] + {LANES - 1}) // {LANES})):",
            f"    first = block * np.uint64({LANES})",
            f"    size = min(np.uint64({LANES}), count - first)",
            *_loops(zip(into, columns.values(), strict=True)),
            "    for i in range(size):",
            *(f"        {line}" for line in work or ["pass"]),  # there may be no controls to compute
            *_loops(zip(places, out, strict=True)),
        ]
        self._compiled: Any = compile_lines(name, ", ".join([*arrays[0], *arrays[1], "numbers"]), body)
        self._sizes = [len(numbers) for numbers in found]
        self._kinds: dict[tuple[str, ...], Callable] = {}

    def __call__(self, numbers: Any, *given: Any, out: Sequence[Any] | None = None) -> list[Any]:
        """Return the results, arrays of shape (lanes, columns).

        Parameters
        ----------
        numbers : ndarray, shape (constants,)
            The constants.
        *given : ndarray, shape (lanes, columns)
            Numbers of float64 or float32, with any strides.
        out : sequence of ndarray, optional
            Arrays into which results are written.
        """
        found = [np.empty((n, len(given[0]))).T for n in self._sizes] if out is None else list(out)
        kinds = tuple(x.dtype.char for x in given)
        if kinds not in self._kinds:
            self._kinds[kinds] = self._compile(kinds)
        self._kinds[kinds](*given, *found, numbers)
        return found

    def _compile(self, kinds: Sequence[str]) -> Callable:
        """Compile for arrays of these types, once for all strides."""
        from numba import from_dtype, types

        given = [types.Array(from_dtype(np.dtype(kind)), 2, "A", readonly=True) for kind in kinds]
        found = [types.Array(types.float64, 2, "A")] * len(self._sizes)
        return self._compiled.compile((*given, *found, types.float64[::1]))


def _loops(pairs: Iterable[tuple[str, str]]) -> list[str]:
    return [line for a, b in pairs for line in ("    for i in range(size):", f"        {a} = {b}")]
