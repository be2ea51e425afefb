"""Compiled loops of the policies: each row's result depends on that row alone, to the bit.

A library's matrix product guarantees neither this, nor the same bits for another number of rows or threads.
Sums are taken in order and not fused, so that they are the same on every machine.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lag_envs.leaderboard.protocol import TINY
from lag_envs.stepping.cache import jit


def affine(x: Any, weight: Any, bias: Any) -> Any:
    """Return x @ weight + bias for x (n, i), weight (i, o), bias (o,).

    Raises
    ------
    ValueError
        For arrays whose lengths do not agree; compiled code would read outside them.
    """
    if x.shape[1:] != weight.shape[:1] or bias.shape != weight.shape[1:]:
        raise ValueError(
            f"a layer of weights {weight.shape} and biases {bias.shape} takes rows of {len(weight)} numbers, "
            f"got shape {x.shape}"
        )
    return _affine(np.ascontiguousarray(x), weight, bias)


@jit
def _affine(x: Any, weight: Any, bias: Any) -> Any:
    n, (many, wide) = len(x), weight.shape
    out, row = np.empty((n, wide)), np.empty(many)
    for r in range(n):
        for i in range(many):
            row[i] = 0.0 if -TINY < x[r, i] < TINY else x[r, i]
        if wide < 5:  # too few to be summed side by side: each sum in a register, not in memory
            for j in range(wide):
                total = bias[j]
                for i in range(many):
                    total += row[i] * weight[i, j]
                out[r, j] = total
        else:
            for j in range(wide):
                out[r, j] = bias[j]
            for i in range(many):
                for j in range(wide):
                    out[r, j] += row[i] * weight[i, j]
    return out


@jit
def interpolate(values: Any, strides: Any, cells: Any, places: Any) -> Any:
    """Return the multilinear interpolation of flat values.

    For each row, cells (n, d) has its cell's first node, as indices along the axes, and places (n, d) the
    position in the cell, from 0 to 1.
    """
    n, d = cells.shape
    out = np.empty(n)
    for r in range(n):
        total = 0.0
        for corner in range(1 << d):
            weight, index = 1.0, 0
            for j in range(d):
                upper = (corner >> j) & 1
                weight *= places[r, j] if upper else 1.0 - places[r, j]
                index += (cells[r, j] + upper) * strides[j]
            if weight != 0.0:
                total += weight * values[index]
        out[r] = total
    return out
