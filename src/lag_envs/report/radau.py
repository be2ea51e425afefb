"""Radau IIA of order 5 in a compiled loop, for any equation, by Newton's method with one Jacobian a step."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from lag_envs.report.equations import Equation, Problems
from lag_envs.report.integrators import RADAU
from lag_envs.report.peers import one_rate_lines
from lag_envs.report.rivals import Rival
from lag_envs.report.timing import Sample
from lag_envs.stepping.compiling import compile_function, compile_lines

A = np.array(RADAU)
#: Relative size of the last correction, largest number of iterations, and step of the Jacobian's differences.
LAST, MOST, APART = 1e-14, 20, 1e-7

SOURCE = """
def radau(starts, p, ends, a, n, h):
    size = starts.shape[1]
    y, moved, base, found = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    stages, wrong, matrix = np.empty(3 * size), np.empty(3 * size), np.empty((3 * size, 3 * size))
    for j in range(starts.shape[0]):
        y[:] = starts[j]
        for k in range(n):
            rate(k * h, y, p[j], base)
            for c in range(size):
                moved[:] = y
                apart = APART * max(1.0, abs(y[c]))
                moved[c] += apart
                rate(k * h, moved, p[j], found)
                for r in range(size):
                    slope = h * (found[r] - base[r]) / apart
                    for s in range(3):
                        for q in range(3):
                            one = 1.0 if r == c and s == q else 0.0
                            matrix[s * size + r, q * size + c] = one - a[s, q] * slope
            inverse = np.linalg.inv(matrix)
            for s in range(3):
                stages[s * size : (s + 1) * size] = base
            for turn in range(int(MOST)):
                for s in range(3):
                    at = 0.0
                    moved[:] = y
                    for q in range(3):
                        at += a[s, q] * h
                        for r in range(size):
                            moved[r] += h * a[s, q] * stages[q * size + r]
                    rate(k * h + at, moved, p[j], found)
                    for r in range(size):
                        wrong[s * size + r] = found[r] - stages[s * size + r]
                change = np.dot(inverse, wrong)
                stages += change
                if np.max(np.abs(change)) <= LAST * np.max(np.abs(stages)):
                    break
            for q in range(3):
                for r in range(size):
                    y[r] += h * a[2, q] * stages[q * size + r]
        ends[j] = y
"""


class CompiledRadau(Rival):
    """Radau IIA with steps of equal length."""

    family = "compiled"
    fixed, batched = True, False

    def __init__(self, setting: float) -> None:
        super().__init__("Radau IIA", setting)

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile the loop."""
        size, n = problems.equation.size, self.substeps(steps)
        loop = _loop(problems.equation)
        starts, p = np.ascontiguousarray(problems.y[:size].T), np.ascontiguousarray(problems.p.T)
        ends, h = np.empty_like(starts), dt * steps / n
        return Sample(
            lambda: loop(starts, p, ends, A, n, h),
            len(problems) * steps,
            ends=lambda: problems.states(ends.T, dt * steps),
        )


@cache
def _loop(equation: Equation) -> Callable:
    """Compile ``radau(starts, p, ends, a, n, h)``: n steps from each state, one after the other."""
    rate = compile_lines("rate", "t, y, p, out", one_rate_lines(equation))
    return compile_function("radau", SOURCE.lstrip(), rate, LAST=LAST, MOST=MOST, APART=APART)
