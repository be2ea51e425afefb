"""Small matrices on the numbers of a `Target`; entries that are always zero are None and cost nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lag_envs.stepping.target import Target


class Inverse:
    """The inverse of a symmetric matrix by symmetric sweeps.

    Attributes
    ----------
    rows : list of list
        M⁻¹; None stands for zero.
    definite : condition
        Whether all pivots are positive, those of M = L D Lᵀ.
    """

    def __init__(self, t: Target, matrix: dict[tuple[int, int], Any], size: int) -> None:
        self.matrix = matrix
        a = {
            place: entry
            for i, j in matrix
            for place, entry in (((i, j), matrix[i, j]), ((j, i), matrix[i, j]))
        }
        self.definite: Any = None
        for k in range(size):
            positive = t.less(t.number(0.0), a[k, k])
            self.definite = positive if k == 0 else t.both(self.definite, positive)
            per = t.div(t.number(1.0), a[k, k])
            row = {i: a[i, k] for i in range(size) if i != k and (i, k) in a}
            scaled = {i: t.mul(x, per) for i, x in row.items()}
            for i in row:
                less = t.neg(scaled[i])
                for j in row:
                    if j >= i:
                        a[i, j] = a[j, i] = _add_product(t, a.get((i, j)), less, row[j])
                a[i, k] = a[k, i] = scaled[i]
            a[k, k] = t.neg(per)
        # Every sweep leaves the negative inverse of the part that was swept.
        found = {(i, j): t.neg(x) for (i, j), x in a.items() if j >= i}
        self.rows = [[found.get((min(i, j), max(i, j))) for j in range(size)] for i in range(size)]


def _add_product(t: Target, total: Any, a: Any, b: Any) -> Any:
    return t.mul(a, b) if total is None else t.fma(a, b, total)


def matrix_times(t: Target, matrix: Sequence[Sequence], vector: Sequence) -> list:
    """Return a matrix times a vector; None stands for zero."""
    result = []
    for row in matrix:
        total = None
        for entry, value in zip(row, vector, strict=True):
            if entry is not None and value is not None:
                total = _add_product(t, total, entry, value)
        result.append(total)
    return result
