"""Random impulses, which change free velocities now and then after a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lag_envs.envs.imperfect.draws import purpose_key
from lag_envs.tasks.imperfections import Imperfections


def pushes(options: Imperfections, constants: Mapping[str, Any]) -> list[str]:
    """Return the lines that push the state ``y``; `constants` has name, or zero, of each constant."""
    found = [i for i, size in enumerate(options.push) if size > 0.0]
    if not found:
        return []
    draws = (f"uniform(key_push, np.uint64(n), np.uint64({1 + j}))" for j in range(len(found)))
    return [
        f"key_push = {purpose_key('push')}",
        f"if uniform(key_push, np.uint64(n), np.uint64(0)) < {constants['push_chance']}:",
        *(
            f"    y{i} = y{i} + {constants[f'push{i}']} * (2.0 * {draw} - 1.0)"
            for i, draw in zip(found, draws, strict=True)
        ),
    ]
