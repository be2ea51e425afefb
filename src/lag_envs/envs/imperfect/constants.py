"""The constants that the compiled functions of an environment take."""

from __future__ import annotations

import math
from typing import Any

from lag_envs.scenes.derivation import motion_constants_of, step_argument_of
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import seen_box


def constants_of(task: Task) -> dict[str, float]:
    """Return every constant that an environment's compiled functions take, by name."""
    found = task.imperfections
    if found is None:
        return task.formulas.constants()
    inner = task.drawn.inner if task.drawn else task
    constants = dict(inner.formulas.constants())
    for name, values in (
        ("sigma", found.observation_noise),
        ("shake", found.action_noise),
        ("slew", found.slew),
        ("push", found.push),
        ("draw_base", [d.base for d in found.drawn]),
        ("draw_low", [d.low for d in found.drawn]),
        ("draw_high", [d.high for d in found.drawn]),
        ("rest", _listed(task.formulas.rest_action) if task.formulas.acting else []),
        *zip(("seen_low", "seen_high"), seen_box(task), strict=True),
    ):
        constants |= {f"{name}{i}": float(value) for i, value in enumerate(values)}
    # Pushes come at a rate: this is the probability of one in a step.
    constants["push_chance"] = -math.expm1(-found.push_rate * task.dt)
    constants["late_low"], constants["late_high"] = found.action_delay
    if found.lag:
        scene = (task.drawn.inner if task.drawn else task).scene
        constants |= {f"lagged_{name}": x for name, x in motion_constants_of(scene, lagged=True).items()}
        constants |= {f"decay{i}": x for i, x in enumerate(found.lag)}
        constants["lagged_order"] = step_argument_of(scene, task.dt, lagged=True)
    constants["age_low"], constants["age_high"] = found.observation_delay or (0.0, 0.0)
    constants["shown_at"] = (1.0 - constants["age_high"] % 1.0) * task.dt
    return constants | {"every": float(found.observation_every)}


def _listed(values: Any) -> list[Any]:
    return list(values) if isinstance(values, list | tuple) else [values]
