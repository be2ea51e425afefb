"""Whole control steps from attempts, in the substeps that the certificate requires, for one or many lanes.

An attempt (`lag_envs.stepping.machine`) advances by as much of the wished-for step as it could certify. Here
it is repeated until the control step is over. In a block the lanes that are not done are gathered and go on
together. Each lane goes through the same attempts as it would alone, so its bits do not depend on its
neighbours.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from lag_envs.stepping.compiling import BLOCK, compile_python
from lag_envs.stepping.lowering import SeriesRecord
from lag_envs.stepping.machine import (
    LaneLayout,
    compile_attempt,
    compile_series_tangent,
    compile_vjp,
    registers,
)
from lag_envs.stepping.series import LARGEST_ORDER, TOLERANCE, Series

#: A control step that would need more attempts than this is refused.
LARGEST_COUNT = 20_000
#: A control step that would need a substep below this part of it is refused too.
SMALLEST_PART = 1e-9
#: The largest part of the derivatives of a control step that may be left out.
COMPLETE = 1e-13
#: Last terms of derivatives below this part of them may be rounding errors.
ROUNDED = 2e-15
#: Steep functions. Their derivatives leave out far more than the motion does. For reverse mode, records with
#: such functions are stepped with this part of the usual tolerance, and with this many terms more.
STEEP, STRICTER, FURTHER = {"atan", "tanh"}, 1e-3, 4
#: A part of the control step that is not divided further for the sake of derivatives alone.
SHORT = 1e-6


def _advance(rows, dt, order):  # type: ignore[no-untyped-def]
    """Take one control step of the lane in `rows` (`LaneLayout`); return the attempts, negative if refused.

    Inputs, places and velocities are read; places and velocities are replaced.
    """
    rows[status] = 0.0
    rows[left] = rows[wish] = rows[span] = dt
    while attempt(rows, 0, order, tolerance) == 0:
        if rows[status] >= LARGEST_COUNT or not rows[wish] > SMALLEST_PART * dt:
            return -np.int64(rows[status])
    return np.int64(rows[status])


def _advance_block(memory, base, count, order):  # type: ignore[no-untyped-def]
    """Take one control step of up to BLOCK lanes; return how many were refused.

    Row r of lane i lies at ``memory[base + r * BLOCK + i]``, see `LaneLayout`, without bounds; behind them is
    room for as many rows and one more. Each lane has the length of its step in `span`. A lane whose status is
    negative to begin with is left alone. Afterwards it is the number of attempts, negative where a lane was
    refused.
    """
    block = memory[base:]
    for i in range(BLOCK):
        stepped = (i < count) & (block[status * BLOCK + i] >= 0.0)
        block[status * BLOCK + i] = 0.0 if stepped else -1.0
        block[left * BLOCK + i] = block[wish * BLOCK + i] = block[span * BLOCK + i] if stepped else 0.0
    over = 1
    for first in range(0, count, LANES):
        over &= attempt(memory, base + first, order, tolerance)
    return 0 if over else unfinished(memory, base, count, order)


def _unfinished(memory, base, count, order):  # type: ignore[no-untyped-def]
    """Continue with the lanes that are not done, side by side; return how many were refused."""
    block, rows = memory[base:], memory[base + bounds * BLOCK :]
    attempts, remains = rows[status * BLOCK :], rows[left * BLOCK :]
    wishes, lengths = rows[wish * BLOCK :], rows[span * BLOCK :]
    lanes = rows[bounds * BLOCK :]  # the last row: which lanes of the block these are
    going = refused = 0
    # Which lanes go on cannot be foreseen, so a branch for each would often be mispredicted. Numba tests
    # whether an index counts from the end, unless it is unsigned or can be seen not to be negative.
    for i in range(min(count, BLOCK)):
        lanes[np.uint64(going)] = i
        going += block[left * BLOCK + i] > 0.0
    for i in range(min(going, BLOCK)):
        lane = np.int64(lanes[i])
        for r in range(bounds):
            rows[r * BLOCK + i] = block[np.uint64(r * BLOCK + lane)]
    for i in range(going, BLOCK):
        remains[np.uint64(i)] = 0.0
    while going > 0:
        for first in range(0, going, LANES):
            attempt(rows, first, order, tolerance)
        # The last of the lanes that go on takes the place of one that does not.
        for i in range(going - 1, -1, -1):
            over = not remains[i] > 0.0
            if not over and attempts[i] < LARGEST_COUNT and wishes[i] > SMALLEST_PART * lengths[i]:
                continue
            lane, going = np.int64(lanes[i]), going - 1
            for r in range(q, left):
                block[np.uint64(r * BLOCK + lane)] = rows[np.uint64(r * BLOCK + i)]
            if not over:
                block[np.uint64(status * BLOCK + lane)] *= -1.0
                refused += 1
            for r in range(bounds + 1):
                rows[np.uint64(r * BLOCK + i)] = rows[np.uint64(r * BLOCK + going)]
            remains[np.uint64(going)] = 0.0
    return refused


def _numbers(record: SeriesRecord, tolerance: float) -> dict[str, Any]:
    layout = LaneLayout(record)
    return {
        "n": record.size,
        "q": layout.q,
        "status": layout.status,
        "left": layout.left,
        "wish": layout.wish,
        "span": layout.span,
        "bounds": layout.bounds,
        "size": layout.rows,
        "tolerance": tolerance,
        "SMALLEST_PART": SMALLEST_PART,
        "LARGEST_COUNT": LARGEST_COUNT,
    }


@cache
def compile_advance(
    record: SeriesRecord,
    tolerance: float = TOLERANCE,
    fused: bool = True,
    fixed_order: int | None = None,
    bounds: bool = False,
) -> Callable:
    """Compile ``advance(rows, dt, order)``, see `_advance`; `compile_attempt` says what the rest is."""
    attempt = compile_attempt(record, 1, fused, fixed_order, bounds)
    return compile_python("advance_lane", _advance, attempt, **_numbers(record, tolerance))


def lanes(record: SeriesRecord) -> int:
    """Return how many lanes are stepped at once.

    This is the number that one register holds, but at least four. Small series take two registers for each
    number.
    """
    doubles = registers().doubles
    return max(4, 2 * doubles if Series(record).slots < 8 else doubles)


@cache
def compile_advance_block(
    record: SeriesRecord,
    tolerance: float = TOLERANCE,
    fused: bool = True,
    width: int | None = None,
    fixed_order: int | None = None,
) -> Callable:
    """Compile ``advance(memory, base, count, order)``, see `_advance_block`.

    Parameters
    ----------
    record : SeriesRecord
        What is stepped.
    tolerance : float
        What a substep may leave out, relative to the size of the velocities.
    fused, fixed_order
        See `compile_attempt`.
    width : int, optional
        How many lanes are stepped at once; by default `lanes`. The bits do not depend on it.
    """
    width = width or lanes(record)
    numbers = _numbers(record, tolerance) | {"BLOCK": BLOCK, "LANES": width}
    attempt = compile_attempt(record, width, fused, fixed_order)
    unfinished = compile_python("unfinished", _unfinished, attempt, **numbers)
    return compile_python("advance_block", _advance_block, attempt, unfinished, **numbers)


def _enough(length, dt, left_out, order):  # type: ignore[no-untyped-def]
    """Return the length of a substep with which derivatives leave out little enough, infinity if they do.

    The certificate does not cover derivatives: at rest a series has no terms, while those of its derivatives
    may be large. `left_out` estimates what they leave out, relative to themselves, from their last terms. All
    substeps of a step `dt` together may leave out `COMPLETE`, or each as much as it is rounded. NaN is no
    reason for shorter substeps: the caller refuses results that are not finite.
    """
    if not (left_out > ROUNDED and left_out * dt > COMPLETE * length) or length < SHORT * dt:
        return np.inf
    return next_length(length, dt, left_out, order)


def _next_length(length, dt, left_out, order):  # type: ignore[no-untyped-def]
    """Return the length of a substep with which derivatives leave out just little enough, see `_enough`."""
    share = max(COMPLETE * length / dt, ROUNDED) / max(left_out, 1e-300)
    return length * min(4.0, max(0.05, 0.9 * share ** (1.0 / (order - 1))))


def _advance_tangent(rows, slopes, kept, sizes, dt, order):  # type: ignore[no-untyped-def]
    """Take one control step and its derivatives; return the number of attempts, negative where refused.

    `rows` are those of a lane, `slopes` those of `compile_series_tangent`; `kept` has room for what a substep
    that turns out to be too long has to restore, `sizes` for the largest size of each column so far.
    """
    rows[status] = 0.0
    rows[left] = rows[wish] = rows[span] = longest = dt
    behind, width = q + 2 + len(kept), len(sizes)  # the matrix ends there
    for i in range(width):
        sizes[i] = 0.0
    while rows[left] > 0.0:
        before = rows[left]
        # Without the margin, a rounding could leave a remainder too short to be stepped.
        if rows[wish] > 1.001 * longest:
            rows[wish] = longest
        attempt(rows, 0, order, tolerance)
        if rows[left] < before:
            for i in range(2 * n):
                kept[i] = slopes[q + i]
            for i in range(2 * n, len(kept)):
                kept[i] = slopes[q + 2 + i]
            used = before - rows[left]
            slopes[status] = dt - before
            slopes[status + 1] = used
            tangent(slopes, 0, order)
            left_out = 0.0
            for i in range(width):
                left_out = max(left_out, slopes[behind + i] / max(sizes[i], slopes[behind + width + i]))
            enough = enough_of(used, dt, left_out, order)
            if enough < np.inf:
                rows[left], rows[wish], longest = before, enough, enough
                for i in range(2 * n):
                    rows[q + i] = slopes[q + i] = kept[i]
                for i in range(2 * n, len(kept)):
                    slopes[q + 2 + i] = kept[i]
            else:
                for i in range(2 * n):
                    slopes[q + i] = rows[q + i]
                for i in range(width):
                    sizes[i] = max(sizes[i], slopes[behind + width + i])
                if longest < dt:  # the motion that needed short substeps may be over
                    longest = max(longest, next_length(used, dt, left_out, order))
        if rows[left] > 0.0 and (rows[status] >= LARGEST_COUNT or not rows[wish] > SMALLEST_PART * dt):
            return -np.int64(rows[status])
    return np.int64(rows[status])


def _advance_tangents(values, slopes, dt, order):  # type: ignore[no-untyped-def]
    """Take a control step from each row of `values`; return the row that was refused, or 0.

    A row of `values` holds inputs, places and velocities; the last two are replaced. A row of `slopes` is the
    matrix of derivatives of places and velocities, row by row, and is replaced too.
    """
    rows, matrix, numbers = np.zeros(size), status + 2, slopes.shape[1]
    kept, sizes = np.empty(2 * n + numbers), np.empty(numbers // (2 * n))
    moving = np.zeros(matrix + numbers + 2 * len(sizes))
    for i in range(values.shape[0]):
        for j in range(status):
            rows[j] = moving[j] = values[i, j]
        for j in range(numbers):
            moving[matrix + j] = slopes[i, j]
        if advance(rows, moving, kept, sizes, dt, order) < 0:
            return i + 1
        for j in range(2 * n):
            values[i, q + j] = rows[q + j]
        for j in range(numbers):
            slopes[i, j] = moving[matrix + j]
            if not abs(slopes[i, j]) < np.inf:
                return i + 1
    return 0


@cache
def compile_advance_tangents(record: SeriesRecord, columns: tuple[str, ...]) -> Callable:
    """Compile ``advance(values, slopes, dt, order)``, see `_advance_tangents`."""
    helpers = compile_attempt(record, 1), compile_series_tangent(record, columns), *_compile_lengths()
    numbers = _numbers(record, TOLERANCE)
    advance = compile_python("advance", _advance_tangent, *helpers, **numbers)
    return compile_python("advance_tangents", _advance_tangents, advance, **numbers)


@cache
def _compile_lengths() -> tuple[Callable, Callable]:
    limits = {"COMPLETE": COMPLETE, "ROUNDED": ROUNDED}
    next_length = compile_python("next_length", _next_length, inner=True, **limits)
    enough_of = compile_python("enough_of", _enough, next_length, inner=True, SHORT=SHORT, **limits)
    return enough_of, next_length


def _vjp_all(given, cotangents, found, longest, constants, starts, by_start, by_end, dt, order):  # type: ignore[no-untyped-def]
    """Take control steps, then the same substeps backwards.

    No substep is longer than its lane's entry of `longest`. Where that was too long for the derivatives, a
    smaller one takes its place, or 0 if there were too many substeps. In that case the results for the lane
    are of no use.

    Each row of `given` is an entry of the state or the controls, each row of `cotangents` one of the state
    after the step. `found` is filled in: its rows are entries of state, controls and parameters. The series
    has other variables, which depend linearly on these: inputs, places and velocities are
    ``constants + starts @ given``. `found` becomes ``direct.T @ cotangents`` plus ``by_start.T`` times the
    cotangents of places, velocities and sources. `by_end` holds the derivatives of places and velocities with
    respect to the state, followed by `direct`.
    """
    wanted, count = len(by_start), given.shape[1]
    order = min(order + further, LARGEST_ORDER)
    table = aligned_zeros((bounds + wanted + 1) * BLOCK).reshape((bounds + wanted + 1, BLOCK))
    bars, before = np.empty((wanted, BLOCK)), np.empty(BLOCK)
    for first in range(0, count, BLOCK):
        filled = min(BLOCK, count - first)
        for r in range(status):
            fill(table, r, 0, constants[r], BLOCK)
            for c in range(len(given)):
                if starts[r, c] != 0.0:
                    add(table, r, 0, starts[r, c], given, c, first, filled)
        for r in range(wanted):
            fill(bars, r, 0, 0.0, BLOCK)
            for c in range(len(cotangents) if r < 2 * n else 0):
                if by_end[c, r] != 0.0:
                    add(bars, r, 0, by_end[c, r], cotangents, c, first, filled)
            put(table, bounds + r, bars, r, BLOCK)
        if not at_once(table, bars, before, longest, first, filled, dt, order):
            inputs = table[:q].copy()
            ends, lanes, rounds = in_parts(table, wanted, before, longest[first:], filled, dt, order)
            stored(table, inputs, bars, ends, lanes, rounds, longest[first:], dt, order)
        for r in range(len(found)):
            fill(found, r, first, 0.0, filled)
            for c in range(len(cotangents)):
                if by_end[c, 2 * n + r] != 0.0:
                    add(found, r, first, by_end[c, 2 * n + r], cotangents, c, first, filled)
            for c in range(wanted):
                if by_start[c, r] != 0.0:
                    add(found, r, first, by_start[c, r], bars, c, 0, filled)


def _at_once(table, bars, before, longest, first, going, dt, order):  # type: ignore[no-untyped-def]
    """Take the first substeps of a block; where all lanes of a vector are done, take them backwards too.

    Most steps take one substep, and are done with that. Return whether all are. Otherwise `before` is what
    was left of each lane's step before its substep, 0 in lanes that are done. `longest` has the block's lanes
    from `first` on.
    """
    rows, left_out, done = table.reshape(-1), bounds + len(bars), True
    fill(table, status, 0, 0.0, BLOCK)
    fill(table, span, 0, dt, BLOCK)
    fill(table, left, 0, 0.0, BLOCK)
    fill(table, left, 0, dt, going)
    for i in range(BLOCK):
        before[i] = table[left, i]
        table[wish, i] = dt
    for i in range(going):
        limit = longest[np.uint64(first + i)]
        table[wish, i] = dt if dt <= 1.001 * limit else limit
    for begin in range(0, going, LANES):
        attempt(rows, begin, order, tolerance)
    for begin in range(0, going, LANES):
        if above(table, left, begin, 0.0):
            done = False
            continue
        fill(table, wish, begin, dt, LANES)
        for i in range(LANES):
            before[np.uint64(begin + i)] = 0.0
        vjp(rows, begin, dt, order)
        if above(table, left_out, begin, COMPLETE):
            for i in range(begin, min(begin + LANES, going)):
                lane = first + i
                longest[lane] = min(longest[lane], enough_of(dt, dt, table[left_out, i], order))
    for r in range(len(bars)):
        put(bars, r, table, bounds + r, going)
    return done


def _in_parts(table, wanted, before, longest, going, dt, order):  # type: ignore[no-untyped-def]
    """Take the remaining substeps of the lanes that are not done, with what `_at_once` has left.

    Lanes are moved together as in `_unfinished`. The ends of the substeps are returned: columns of places,
    velocities, what is left of the step, and the substep's length; then the lane of each, and the number of
    them after each round.
    """
    whose = np.arange(BLOCK)
    ends, lanes, rounds = np.empty((2 * n + 2, BLOCK)), np.empty(BLOCK, np.int64), np.empty(64, np.int64)
    end, turns = 0, 0
    while going > 0:
        if end + going > len(lanes):
            ends = np.concatenate((ends, np.empty_like(ends)), axis=1)
            lanes = np.concatenate((lanes, np.empty_like(lanes)))
        if turns == len(rounds):
            rounds = np.concatenate((rounds, np.empty_like(rounds)))
        still = 0
        for i in range(going):
            lane, remains = whose[i], table[left, i]
            used = before[i] - remains
            if used > 0.0:
                for r in range(2 * n):
                    ends[r, end] = table[q + r, i]
                ends[2 * n, end], ends[2 * n + 1, end] = remains, used
                lanes[end] = lane
                end += 1
            if remains == 0.0:
                continue
            if table[wish, i] > 1.001 * longest[lane]:
                table[wish, i] = longest[lane]
            if table[status, i] >= LARGEST_COUNT or not table[wish, i] > SMALLEST_PART * dt:
                longest[lane] = 0.0
                continue
            for r in range(bounds + wanted):
                table[r, still] = table[r, i]
            whose[still] = lane
            still += 1
        for i in range(still, going):
            table[left, i] = 0.0
        going = still
        rounds[turns] = end
        turns += 1
        for i in range(going):
            before[i] = table[left, i]
        for begin in range(0, going, LANES):
            attempt(table.reshape(-1), begin, order, tolerance)
    return ends, lanes, rounds[:turns]


def _above(table, r, begin, limit):  # type: ignore[no-untyped-def]
    """Return whether an entry of these lanes is above the limit."""
    found = False
    for i in range(LANES):
        found |= table[r, np.uint64(begin + i)] > limit
    return found


def _stored(table, inputs, bars, ends, lanes, rounds, longest, dt, order):  # type: ignore[no-untyped-def]
    """Take the substeps that end at `ends` backwards, last round first, again many lanes together."""
    for turn in range(len(rounds) - 1, -1, -1):
        begin = rounds[turn - 1] if turn > 0 else 0
        some = rounds[turn] - begin
        for i in range(some):
            lane = lanes[begin + i]
            for r in range(q):
                table[r, i] = inputs[r, lane]
            for r in range(2 * n):
                table[q + r, i] = ends[r, begin + i]
            table[left, i], table[wish, i] = ends[2 * n, begin + i], ends[2 * n + 1, begin + i]
            for r in range(len(bars)):
                table[bounds + r, i] = bars[r, lane]
        for i in range(0, some, LANES):
            vjp(table.reshape(-1), i, dt, order)
        for i in range(some):
            lane, used = lanes[begin + i], ends[2 * n + 1, begin + i]
            longest[lane] = min(longest[lane], enough_of(used, dt, table[bounds + len(bars), i], order))
        for r in range(len(bars)):
            for i in range(some):
                bars[r, lanes[begin + i]] = table[bounds + r, i]


# These take a table and the number of a row, since Numba would count references to a row, by atomic
# operations. For unsigned places see `_unfinished`.


def _fill(table, r, begin, value, count):  # type: ignore[no-untyped-def]
    for i in range(count):
        table[r, np.uint64(begin + i)] = value


def _put(table, r, other, s, count):  # type: ignore[no-untyped-def]
    for i in range(count):
        table[r, np.uint64(i)] = other[s, np.uint64(i)]


def _add(table, r, begin, weight, other, s, start, count):  # type: ignore[no-untyped-def]
    for i in range(count):
        table[r, np.uint64(begin + i)] += weight * other[s, np.uint64(start + i)]


@cache
def compile_vjp_all(record: SeriesRecord, sources: tuple[str, ...]) -> Callable:
    """Compile ``vjp_all(given, cotangents, found, ..., dt, order)``, see `_vjp_all` and `compile_vjp`."""
    steep = any(node.op in STEEP for node in record.nodes)
    stricter, further = (STRICTER, FURTHER) if steep else (1.0, 0)
    width = lanes(record)
    numbers = _numbers(record, TOLERANCE * stricter) | {"BLOCK": BLOCK, "LANES": width}
    attempt, vjp = compile_attempt(record, width), compile_vjp(record, sources, width)
    enough_of = _compile_lengths()[0]
    fill, put, add = (compile_python(f.__name__[1:], f, inner=True) for f in (_fill, _put, _add))
    above = compile_python("above", _above, inner=True, LANES=width)
    at_once = compile_python(
        "at_once", _at_once, attempt, vjp, enough_of, above, fill, put,
        inner=True, COMPLETE=COMPLETE, **numbers,
    )  # fmt: skip
    in_parts = compile_python("in_parts", _in_parts, attempt, inner=True, **numbers)
    stored = compile_python("stored", _stored, vjp, enough_of, inner=True, **numbers)
    numbers |= {"further": further, "LARGEST_ORDER": LARGEST_ORDER}
    return compile_python("vjp_all", _vjp_all, at_once, in_parts, stored, fill, put, add, **numbers)
