"""A step of a batch, shared among threads.

The thread that leads a step opens a turn, identified by its number. The leader and helpers claim blocks of
environments, each starting from its own place, so that a block mostly stays in the cache of one core. An
environment's bits do not depend on who steps it, or when. The leader waits only for claimed blocks. A helper
that comes late, or never, therefore costs only its help, and a helper that comes after the turn finds every
block claimed. Nothing hangs or goes wrong if a thread is missing after a fork.

Python threads suffice, since compiled code does not hold the interpreter's lock. They are started when first
needed, and ended before a process forks.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import queue
import threading
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.host import usable_cores
from lag_envs.stepping.compiling import BLOCK, compile_python

#: Environments per thread, by default: fewer environments would be stepped before another thread is awake.
SHARE = 4096
#: How often a thread checks whether another is ready, about 50 µs in total, before it sleeps.
PATIENCE = 200_000
#: Numbers that threads share: the turn, unfinished blocks, ended episodes, the refused environment, addresses
#: of the five arrays of a step, bytes per number of an action, numbers per block, and which of them is the
#: first of the row `n`. After them come, for each block, the turn in which it was last claimed, and for each
#: share whether a helper has it.
WORDS = 12
#: The arguments of `step_blocks`, the loop over the blocks that a thread claims.
STEP_BLOCKS = (
    "f, ids, par, action, obs, reward, terminated, truncated, count, at, blocks, turn, share, shares"
)


def words(blocks: int) -> int:
    """Return the number of numbers that threads share."""
    return WORDS + 2 * blocks


def write_places(ids: NDArray[np.uint64], count: int, kept: Sequence[str]) -> None:
    """Write the places of a batch's rows into its keys."""
    ids[3 * count + 10 : 3 * count + 12] = len(kept) * BLOCK, kept.index("n") * BLOCK


def forget_helpers(ids: NDArray[np.uint64], count: int) -> None:
    """Mark, in a copy of a batch's keys, that no helper has a share of the copy."""
    ids[3 * count + WORDS + -(-count // BLOCK) :] = 0


# --- compiled ---


def _step_all(  # type: ignore[no-untyped-def]
    loop, f, ids, par, action, obs, reward, terminated, truncated, count, turn, share, shares
):
    """Take part in a turn; see `compile_step_all`."""
    at, now = np.uint64(3 * count), np.uint64(turn)
    blocks = np.uint64((count + BLOCK - 1) // BLOCK)
    if share > 0:
        mine = at + np.uint64(WORDS) + blocks + np.uint64(share)
        if not atomic_replace(ids, mine, np.uint64(0), np.uint64(1)):
            return 0, 0  # another helper is still waiting for the next turn, with this `par`
        # Waking takes much of a turn's time, so a helper also takes part in turns that follow soon.
        while opened(ids, at, now):
            now = atomic_load(ids, at)
            if ids[at + np.uint64(9)] != np.uint64(action.itemsize):
                break
            step_blocks(
                loop, f, ids, par,
                moved(action, ids[at + np.uint64(4)]),
                moved(obs, ids[at + np.uint64(5)]),
                moved(reward, ids[at + np.uint64(6)]),
                moved(terminated, ids[at + np.uint64(7)]),
                moved(truncated, ids[at + np.uint64(8)]),
                count, at, blocks, now, np.uint64(share), np.uint64(shares),
            )  # fmt: skip
            now += np.uint64(1)
        atomic_store(ids, mine, np.uint64(0))
        return 0, 0
    if atomic_load(ids, at) < now:
        if not done(ids, at):
            return 0, -1
        bad = bad_action(f, action, count, ids[at + np.uint64(10)], ids[at + np.uint64(11)])
        if bad < 0:
            return bad, 0
        ids[at + np.uint64(1)] = blocks
        ids[at + np.uint64(2)] = ids[at + np.uint64(3)] = np.uint64(0)
        ids[at + np.uint64(4)] = address(action)
        ids[at + np.uint64(5)] = address(obs)
        ids[at + np.uint64(6)] = address(reward)
        ids[at + np.uint64(7)] = address(terminated)
        ids[at + np.uint64(8)] = address(truncated)
        ids[at + np.uint64(9)] = np.uint64(action.itemsize)
        atomic_store(ids, at, now)
    step_blocks(
        loop, f, ids, par, action, obs, reward, terminated, truncated, count, at, blocks, now,
        np.uint64(0), np.uint64(shares),
    )  # fmt: skip
    if not done(ids, at):
        return 0, -1
    return np.int64(ids[at + np.uint64(3)]), np.int64(ids[at + np.uint64(2)])


def _bad_action(f, action, count, size, first):  # type: ignore[no-untyped-def]
    """Return -(i + 1) if action i is not finite, or 0; for `size` and `first`, see `write_places`.

    An environment that is to be restarted ignores its action.
    """
    bad = 0
    for i in range(np.uint64(len(action))):
        bad += not abs(action[i]) < math.inf
    if bad > 0:
        many = len(action) // count
        for i in range(count):
            going = f[np.uint64(i // BLOCK) * size + first + np.uint64(i % BLOCK)] >= 0.0
            for j in range(i * many, (i + 1) * many):
                if going and not abs(action[j]) < math.inf:
                    return -(i + 1)
    return 0


def _next_block(ids, at, turn, blocks, tried, share, shares):  # type: ignore[no-untyped-def]
    """Claim a block; return it, or `blocks` if none is left, and how many have been tried.

    Shares lie next to one another. The two threads of each pair of shares start at its opposite ends and meet
    in the middle; then they continue with the next pair.
    """
    first = share * blocks // shares
    last = (share + np.uint64(1)) * blocks // shares - np.uint64(1)
    while tried < blocks:
        block = first + tried if share % np.uint64(2) == np.uint64(0) else last + blocks - tried
        block = block if block < blocks else block - blocks
        tried += np.uint64(1)
        claim = at + np.uint64(WORDS) + block
        before = atomic_load(ids, claim)
        if before < turn and atomic_replace(ids, claim, before, turn):
            return block, tried
    return blocks, tried


def _hand_in(ids, at, taken, over, refused):  # type: ignore[no-untyped-def]
    """Add the results of the claimed blocks, and after that mark them as done."""
    if taken > np.uint64(0):
        atomic_add(ids, at + np.uint64(2), over)
        atomic_max(ids, at + np.uint64(3), refused)
        atomic_add(ids, at + np.uint64(1), np.uint64(0) - taken)


def _opened(ids, at, turn):  # type: ignore[no-untyped-def]
    """Return whether a turn is open, or over, after waiting briefly."""
    for _ in range(PATIENCE):
        if atomic_load(ids, at) >= turn:
            return True
    return False


def _done(ids, at):  # type: ignore[no-untyped-def]
    """Return whether all blocks of the last turn are done, after waiting briefly."""
    for _ in range(PATIENCE):
        if atomic_load(ids, at + np.uint64(1)) == np.uint64(0):
            return True
    return False


def _compiled(function: Callable, *helpers: Callable) -> Callable:
    numbers = {"BLOCK": BLOCK, "WORDS": WORDS, "PATIENCE": PATIENCE}
    return compile_python(function.__name__[1:], function, *helpers, inner=not helpers, **numbers)


def claiming() -> list[Callable]:
    """Return `next_block` and `hand_in`, which the loop over blocks uses."""
    return [_compiled(_next_block), _compiled(_hand_in)]


@cache
def compile_step_all() -> Callable:
    """Compile ``step_all(loop, f, ids, par, action, obs, reward, ended, cut, count, turn, share, shares)``.

    Steps every environment; one whose episode was over is restarted instead. `loop` is the `address_of` the
    loop over the blocks that a thread can claim. `ended` and `cut` are the arrays of terminations and
    truncations. `turn` is the number of the step, from 1.

    The thread with `share` 0 leads, and gets (status, over). The status is 0; or i + 1 if environment i was
    refused and kept its state; or -(i + 1) if action i is not finite, in which case nothing was stepped.
    ``over`` counts the environments whose episode has just ended; it is -1 if helpers are not done yet, and
    then the same call has to be made again. Helpers make this call with another number below `shares` and the
    `par` that belongs to it; they continue with steps that follow soon. The results of these calls mean
    nothing.
    """
    from lag_envs.stepping.primitives import at_address

    step_blocks = at_address("step_blocks", len(STEP_BLOCKS.split(", ")))
    return _compiled(_step_all, step_blocks, _compiled(_bad_action), _compiled(_opened), _compiled(_done))


def address_of(step_blocks: Any, *arrays: NDArray) -> int:
    """Compile a loop over blocks for these types of arrays, and return where it lies in memory.

    Parameters
    ----------
    step_blocks : callable
        ``step_blocks(f, ids, par, ..., count, at, blocks, turn, share, shares)``. The caller keeps it alive.
    *arrays : ndarray
        Arrays like those that `step_all` will be called with, from `f` to `cut`.
    """
    from numba import typeof, types

    signature = (*map(typeof, arrays), types.int64, *[types.uint64] * 5)
    step_blocks.compile(signature)
    compiled = step_blocks.overloads[signature]
    return int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name))


# --- the threads of this process ---


def default_threads(count: int) -> int:
    """Return the default number of threads for a batch of this size.

    There is one thread for each `SHARE` environments and at most one for each core that this process may use,
    but no more than ``OMP_NUM_THREADS``, which Ray and others set for their workers. In a process of
    `multiprocessing` there is one thread.
    """
    if count < 2 * SHARE or multiprocessing.parent_process() is not None:
        return 1
    limit = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return max(1, min(count // SHARE, usable_cores(), int(limit) if limit.isdecimal() else count))


def offer(calls: Sequence[tuple], kind: np.dtype) -> None:
    """Offer calls of `step_all`, one for each of these tuples of arguments, to idle helpers.

    Earlier offers for other arguments are withdrawn; those for the same arguments remain valid. `kind` is the
    type of actions. The first step with a new type compiles, and gets no help, because a thread might still
    be compiling when the process ends.
    """
    global _offered
    if kind not in _compiled_for:
        _compiled_for.add(kind)
        return
    if id(calls) == _offered and _offers.qsize() >= len(calls):
        return
    _offered = id(calls)  # the calls themselves are not stored, since they would keep a batch's memory
    with contextlib.suppress(queue.Empty):
        while _offers.get_nowait() is not None:
            pass
        _offers.put(None)  # this dismissal was meant for a helper
    for i in range(len(_helpers), len(calls)):
        _helpers.append(threading.Thread(target=_help, name=f"lag_envs helper {i + 1}", daemon=True))
        _helpers[i].start()
    for arguments in calls:
        _offers.put(arguments)


def _help() -> None:
    step_all = compile_step_all()
    while (arguments := _offers.get()) is not None:
        step_all(*arguments)
        del arguments  # its arrays may be large


def _dismiss() -> None:
    """End the helpers, because a thread does not survive a fork."""
    for _ in _helpers:
        _offers.put(None)
    while _helpers:
        _helpers.pop().join()


_offers: queue.SimpleQueue[tuple | None] = queue.SimpleQueue()
_offered = 0
_helpers: list[threading.Thread] = []
_compiled_for: set[np.dtype] = set()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_dismiss)
