"""The data with which a browser drives an environment: its step as a script, sliders, and live agents."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.policies import SubmittedPolicy
from lag_envs.leaderboard.site.scenery import page_json, picture_data
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.mechanics.recording import parameter_values
from lag_envs.replay import LEVELS, VERSION
from lag_envs.scenes import StepRefused
from lag_envs.scenes.derivation import form_of
from lag_envs.scenes.picture import Picture
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task

#: Marks of the sliders, as multiples of a parameter's value.
MARKS = (0.5, 2.0**-0.5, 1.0, 2.0**0.5, 2.0)


def script(env_id: str) -> str | None:
    """Return the file with which a page drives an environment of the package.

    None for an unknown id, and for an environment with imperfections that scripts do not have.
    """
    kind: Any = TASKS.get(env_id)
    try:
        return script_of(kind) if kind else None
    except FormulaError:
        return None


@cache
def script_of(kind: type[Task]) -> str:
    """Return the file with which a page drives a task.

    Parameters
    ----------
    kind : type
        The task's class.

    Returns
    -------
    str
        JavaScript: a call of ``lagEnvs.put`` with the step's functions and data about it.
    """
    task = kind()
    env = Unfused(task)
    program, names = env.program, ", ".join(env.program.names)
    constants = ", ".join(map(_number, program.constants))
    about = page_json(_about(kind, env))
    return (
        f'"use strict";\n(() => {{\n{program.javascript}'
        f"lagEnvs.put({{ functions: {{ {names} }}, constants: [{constants}], about: {about} }});\n}})();\n"
    )


def _number(x: float) -> str:
    return repr(x) if math.isfinite(x) else "NaN" if x != x else "Infinity" if x > 0.0 else "-Infinity"


def _about(kind: type[Task], env: Unfused) -> dict[str, Any]:
    """Return the page's data about a step, in JSON types."""
    task, program = env.task, env.program
    formulas, rows = task.formulas, env.program.rows
    resting = formulas.rest_action
    form = form_of(task.scene)
    return {
        "id": kind.id,
        "version": VERSION,
        "levels": LEVELS,
        "digest": program.digest,
        "dt": task.dt,
        "limit": task.limit if math.isfinite(task.limit) else None,
        "rows": {
            name: [row.start, row.stop] if isinstance(row, slice) else row
            for name, row in rows._asdict().items()
        },
        "size": program.size,
        "states": program.states,
        "starts": program.states + formulas.targets,
        "draws": task.draws,
        "drawn": program.drawn,
        "noise": program.noise,
        "delay": program.delay,
        "controls": [
            {
                "name": a.control,
                "unit": a.unit,
                "meaning": task.quantities.get(a.control, ("", None))[1],
                "low": a.low,
                "high": a.high,
                "values": a.values,
                "row": range(program.size)[rows.u][task.scene.control_names.index(a.control)],
            }
            for a in formulas.acting
        ],
        "largest": formulas.largest,
        "rest": resting if isinstance(resting, list) else [resting] * formulas.actions,
        "frames": len(program.frames),
        "targets": [{"name": t.name, "unit": t.unit} for t in formulas.target_boxes],
        "angle": form.angle if form else None,
        "sliders": sliders(kind, env),
    }


# --- sliders ------------------------------------------------------------------------------------------------


def sliders(kind: type[Task], env: Unfused) -> list[dict[str, Any]]:
    """Return the parameters that may be changed while driving.

    Only parameters that have an effect, and for which the changed script steps like an environment made
    with the changed value: Python code beyond the formulas' arithmetic does not reach the script. The effect
    on the picture is given at `MARKS`. The limit of the controls is a factor, `shown` in units of the only
    control or in per cent.
    """
    task, program = env.task, env.program
    names, fields = list(program.given), type(task.scene).__dataclass_fields__
    fixed = {*program.made, *(d.name for d in (task.imperfections.drawn if task.imperfections else ()))}
    values = {name: value for name, value in parameter_values(task.scene).items() if name not in fixed}
    marked = {
        name: others
        for name, value in values.items()
        if 0.0 < value < math.inf and (others := _made(kind, {name: value}, MARKS))
    }
    # Try all at once, which is quick; try them one by one only if that fails.
    together = _follows(env, {name: values[name] for name in marked})
    found: list[dict[str, Any]] = []
    for name, others in marked.items():
        if together or _follows(env, {name: values[name]}):
            looks = [_look(other) for other in others]
            seen = looks[0] != looks[-1]
            if seen or _acts(env, name, MARKS[-1] * values[name]):
                unit, at = fields[name].metadata["unit"], names.index(f"self_{name}")
                slider = {"name": name, "unit": "" if unit == "1" else unit, "at": at, "value": values[name]}
                found.append(slider | ({"looks": looks} if seen else {}))
    acting = task.formulas.acting
    if not task.formulas.choices and acting and all(a.low == -a.high for a in acting):
        limit = {"name": "control limit", "at": names.index("strength"), "value": 1.0}
        if len(acting) == 1:
            found.append(limit | {"shown": acting[0].high, "unit": acting[0].unit})
        else:
            found.append(limit | {"shown": 100.0, "unit": "%"})
    return found


def _made(kind: type[Task], values: Mapping[str, float], marks: Sequence[float]) -> list[Task]:
    """Return the task with parameters at marks; empty if one of them is refused."""
    try:
        return [kind(**{name: value * mark for name, value in values.items()}) for mark in marks]
    except (ValueError, TypeError, FormulaError):
        return []


def _follows(env: Unfused, values: Mapping[str, float]) -> bool:
    """Return whether a script with changed parameters does the same as tasks made with them."""
    others = _made(type(env.task), values, (MARKS[0], MARKS[-1]))
    return bool(others) and all(_steps_as(env, list(values), other) for other in others)


def _acts(env: Unfused, name: str, value: float) -> bool:
    """Return whether the step reads a parameter, or a constant that changes with it."""
    changed = Unfused(env.task, env.program)
    changed.set_parameter(name, value)
    step = env.program.python.partition("def start(")[2]  # what comes before computes the constants
    pairs = zip(env.program.constants, changed.constants, strict=True)
    return any(a != b and f"k[{i}]" in step for i, (a, b) in enumerate(pairs))


def _look(task: Task) -> dict[str, Any]:
    found = picture_data(Picture(task)) or {}
    return {key: found.get(key) for key in ("shapes", "window")}


def _steps_as(env: Unfused, names: Sequence[str], other: Task) -> bool:
    """Return whether a script with another task's parameters does the same as that task."""
    if other.formulas.key != env.task.formulas.key or other.limit != env.task.limit:
        return False
    changed, own = Unfused(env.task, env.program), Unfused(other)
    for name in names:
        changed.set_parameter(name, getattr(other.scene, name))
    if not np.allclose(changed.constants, own.constants, rtol=1e-13, atol=0.0):
        return False
    formulas = other.formulas
    for one in (changed, own):
        one.reset(1)
        try:
            for i in range(3):
                one.step(
                    formulas.rest_action if formulas.choices else [(0.7, -0.4, 0.1)[i]] * formulas.actions
                )
        except StepRefused:
            return False
    numbers = np.allclose(changed.numbers, own.numbers, rtol=1e-9, atol=1e-12)
    return numbers and np.allclose(changed.poses(), own.poses(), atol=1e-9)


# --- agents -------------------------------------------------------------------------------------------------


def agent(policy: SubmittedPolicy) -> dict[str, Any] | None:
    """Return a policy as the page runs it, in JSON types; None for one that only Python can run.

    Parameters
    ----------
    policy : SubmittedPolicy
        The policy.
    """
    data = policy.architecture.page_data(policy.arrays)
    if data is None:
        return None
    return data.about | {
        "largest": data.head.largest,
        "choices": data.head.choices,
        # Sorted, because safetensors reads them in any order, and pages are named by their content.
        "arrays": {name: _array(data.arrays[name]) for name in sorted(data.arrays)},
    }


def _array(array: Any) -> dict[str, Any]:
    """Return an array's bytes in base64, in 32 bits per number if that is exact, else in 64."""
    short = array.astype("<f4")
    exact = bool((short.astype(np.float64) == array).all())
    data = np.ascontiguousarray(short if exact else array.astype("<f8"))
    return {
        "shape": list(array.shape),
        "bits": 32 if exact else 64,
        "data": base64.b64encode(data.tobytes()).decode(),
    }
