"""Random impulses, which change free velocities now and then after a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.envs.imperfect.draws import purpose_key
from lag_envs.tasks.imperfections import Imperfections


def pushes(
    options: Imperfections, state: Sequence[str], constants: Mapping[str, Any]
) -> tuple[list[str], list[str]]:
    """Return names for the state after a possible push, and the lines that compute these.

    Parameters
    ----------
    options : Imperfections
        The sizes of pushes.
    state : sequence of str
        The state before.
    constants : mapping
        Name, or zero, of each constant.
    """
    found = [i for i, size in enumerate(options.push) if size > 0.0]
    after = [f"pushed{i}" if i in found else name for i, name in enumerate(state)]
    if not found:
        return after, []
    draws = (f"uniform(key_push, np.uint64(n), np.uint64({1 + j}))" for j in range(len(found)))
    sizes = (f"{constants[f'push{i}']} * (2.0 * {draw} - 1.0)" for i, draw in zip(found, draws, strict=True))
    return after, [
        f"key_push = {purpose_key('push')}",
        f"push = uniform(key_push, np.uint64(n), np.uint64(0)) < {constants['push_chance']}",
        *(
            f"pushed{i} = select(push, {state[i]} + {size}, {state[i]})"
            for i, size in zip(found, sizes, strict=True)
        ),
    ]
