"""Whole control steps from attempts: substeps as the certificate asks for, one lane or a block of lanes.

An attempt (`lag_envs.stepping.machine`) advances by as much of the wished-for step as it could certify. Here
it is repeated until the control step is over. In a block the lanes that are not done are gathered and go on
together. Each lane goes through the same attempts as it would alone, so its bits do not depend on its
neighbours.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from lag_envs.stepping.compiling import compile_python
from lag_envs.stepping.lowering import SeriesRecord
from lag_envs.stepping.machine import Layout, compile_attempt, compile_tangent
from lag_envs.stepping.series import TOLERANCE

#: A control step that would need more attempts than this is refused.
LARGEST_COUNT = 20_000
#: So is one that would need a substep below this part of it.
SMALLEST_PART = 1e-9
#: Lanes of a block, and those that are stepped at once.
BLOCK, LANES = 64, 8


def _advance(rows, dt, order):  # type: ignore[no-untyped-def]
    """Take one control step of the lane in `rows`; return the number of attempts, negative where refused.

    Inputs, places and velocities are read, places and velocities are replaced; behind the rows of the attempt
    the sums of the substeps' bounds on places and velocities are left.
    """
    for i in range(2 * n):
        rows[size + i] = 0.0
    remaining, h, count = dt, dt, 0
    while True:
        rows[wish] = h
        if elapsed >= 0:
            rows[elapsed] = dt - remaining
        attempt(rows, 0, order, tolerance)
        count += 1
        if rows[done] > 0.0:
            for i in range(2 * n):
                rows[q + i] = rows[after + i]
            for i in range(n):
                rows[size + i] += rows[bound + i] * (rows[used] / (order + 2))
                rows[size + n + i] += rows[bound + i]
            if not rows[used] < remaining:
                break
            remaining -= rows[used]
            h = min(remaining, 2.0 * rows[used])
        else:
            h *= 0.0625
            if not h > SMALLEST_PART * dt:
                return -count
        if count >= LARGEST_COUNT:
            return -count
    for i in range(2 * n):
        if not abs(rows[q + i]) < np.inf:
            return -count
    return count


def _advance_block(memory, base, count, dt, order):  # type: ignore[no-untyped-def]
    """Take one control step of up to BLOCK lanes; return how many were refused.

    Row r of lane i lies at ``memory[base + r * BLOCK + i]``: inputs, places, velocities as in an attempt, and
    after them the status: the number of attempts, negative where the lane was refused. A lane whose status is
    negative to begin with is left alone.
    """
    rows = np.empty(size * LANES)
    remaining = np.empty(BLOCK)
    wishes = np.empty(BLOCK)
    lane = np.empty(BLOCK, np.int64)
    status = base + (q + 2 * n) * BLOCK
    going = 0
    for i in range(count):
        remaining[i] = dt
        wishes[i] = dt
        if memory[status + i] >= 0.0:
            memory[status + i] = 0.0
            lane[going] = i
            going += 1
    refused, first_round = 0, going == count
    while going > 0:
        kept = 0
        for first in range(0, going, LANES):
            some = min(LANES, going - first)
            if first_round and some == LANES:
                for r in range(q + 2 * n):
                    at = base + r * BLOCK + first
                    for i in range(LANES):
                        rows[r * LANES + i] = memory[at + i]
            else:
                for r in range(q + 2 * n):
                    for i in range(LANES):
                        rows[r * LANES + i] = memory[base + r * BLOCK + lane[first + min(i, some - 1)]]
            for i in range(LANES):
                source = lane[first + min(i, some - 1)]
                rows[wish * LANES + i] = wishes[source]
                if elapsed >= 0:
                    rows[elapsed * LANES + i] = dt - remaining[source]
            attempt(rows, 0, order, tolerance)
            for i in range(some):
                source = lane[first + i]
                memory[status + source] += 1.0
                spent = memory[status + source] >= LARGEST_COUNT
                if rows[done * LANES + i] > 0.0:
                    for r in range(2 * n):
                        memory[base + (q + r) * BLOCK + source] = rows[(after + r) * LANES + i]
                    step = rows[used * LANES + i]
                    if not step < remaining[source]:
                        for r in range(2 * n):
                            if not abs(memory[base + (q + r) * BLOCK + source]) < np.inf:
                                spent = True
                        if spent and memory[status + source] > 0.0:
                            memory[status + source] *= -1.0
                            refused += 1
                        continue
                    remaining[source] -= step
                    wishes[source] = min(remaining[source], 2.0 * step)
                else:
                    wishes[source] *= 0.0625
                    spent = spent or not wishes[source] > SMALLEST_PART * dt
                if spent:
                    memory[status + source] *= -1.0
                    refused += 1
                else:
                    lane[kept] = source
                    kept += 1
        going, first_round = kept, False
    return refused


def _numbers(record: SeriesRecord, tolerance: float) -> dict[str, float]:
    layout = Layout(record)
    return {
        "n": record.size,
        "q": layout.q,
        "wish": layout.h,
        "done": layout.done,
        "used": layout.used,
        "after": layout.q_after,
        "bound": layout.bound,
        "size": layout.rows,
        "elapsed": layout.inputs.get("start_elapsed", -1),
        "tolerance": tolerance,
        "SMALLEST_PART": SMALLEST_PART,
        "LARGEST_COUNT": LARGEST_COUNT,
    }


@cache
def compile_advance(record: SeriesRecord, tolerance: float = TOLERANCE) -> Callable:
    """Compile ``advance(rows, dt, order)``, see `_advance`."""
    return compile_python("advance_lane", _advance, compile_attempt(record, 1), **_numbers(record, tolerance))


@cache
def compile_advance_block(record: SeriesRecord, tolerance: float = TOLERANCE) -> Callable:
    """Compile ``advance(memory, base, count, dt, order)``, see `_advance_block`."""
    numbers = _numbers(record, tolerance) | {"BLOCK": BLOCK, "LANES": LANES}
    return compile_python("advance_block", _advance_block, compile_attempt(record, LANES), **numbers)


def _advance_tangent(rows, slopes, dt, order):  # type: ignore[no-untyped-def]
    """Take one control step and its derivatives; return the number of attempts, negative where refused.

    `rows` are those of an attempt. `slopes` begin with inputs, places, velocities and the step, as they do,
    and go on with the matrix of derivatives, which is that of unit vectors to begin with.
    """
    remaining, h, count = dt, dt, 0
    while True:
        rows[wish] = h
        if elapsed >= 0:
            rows[elapsed] = dt - remaining
            slopes[elapsed] = dt - remaining
        attempt(rows, 0, order, tolerance)
        count += 1
        if rows[done] > 0.0:
            slopes[wish] = rows[used]
            tangent(slopes, 0, order)
            for i in range(2 * n):
                rows[q + i] = rows[after + i]
                slopes[q + i] = rows[after + i]
            if not rows[used] < remaining:
                return count
            remaining -= rows[used]
            h = min(remaining, 2.0 * rows[used])
        else:
            h *= 0.0625
            if not h > SMALLEST_PART * dt:
                return -count
        if count >= LARGEST_COUNT:
            return -count


def _advance_tangents(values, slopes, dt, order):  # type: ignore[no-untyped-def]
    """Take a control step from each row of `values`; return the row that was refused, or 0.

    A row of `values` holds inputs, places and velocities; the last two are replaced. A row of `slopes`
    becomes the matrix of derivatives of places and velocities, row by row.
    """
    rows = np.zeros(size)
    moving = np.zeros(done + 2 * n * width)
    for i in range(values.shape[0]):
        for j in range(q + 2 * n):
            rows[j] = moving[j] = values[i, j]
        for j in range(2 * n * width):
            moving[done + j] = 0.0
        for j in range(2 * n):
            moving[done + j * width + j] = 1.0
        if advance(rows, moving, dt, order) < 0:
            return i + 1
        for j in range(2 * n):
            values[i, q + j] = rows[q + j]
        for j in range(2 * n * width):
            slopes[i, j] = moving[done + j]
            if not abs(slopes[i, j]) < np.inf:
                return i + 1
    return 0


@cache
def compile_advance_tangents(
    record: SeriesRecord, columns: tuple[str, ...], tolerance: float = TOLERANCE
) -> Callable:
    """Compile ``advance(values, slopes, dt, order)``, see `_advance_tangents`.

    Parameters
    ----------
    record : SeriesRecord
        What is stepped, made with tangents.
    columns : tuple of str
        Inputs by which derivatives are taken, besides places and velocities.
    tolerance : float
        What a substep may leave out, relative to the size of the velocities.
    """
    helpers = compile_attempt(record, 1), compile_tangent(record, columns)
    numbers = _numbers(record, tolerance)
    advance = compile_python("advance", _advance_tangent, *helpers, **numbers)
    width = 2 * record.size + len(columns)
    return compile_python("advance_tangents", _advance_tangents, advance, width=width, **numbers)
