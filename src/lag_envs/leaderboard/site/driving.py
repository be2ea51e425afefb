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
from lag_envs.scenes.parameters import natural_size
from lag_envs.scenes.picture import Picture
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task

#: Marks of the sliders, as multiples of a parameter's value.
MARKS = (0.5, 2.0**-0.5, 1.0, 2.0**0.5, 2.0)
#: Marks for a parameter that is 0, as multiples of its `natural_size`.
ADDED = (0.0, 0.025, 0.05, 0.075, 0.1)


def scripts(env_id: str) -> tuple[str | None, str | None]:
    """Return the files of `script_of` and `fuller_script_of` for an environment of the package.

    None for an unknown id, and for an environment with imperfections that scripts do not have.
    """
    kind: Any = TASKS.get(env_id)
    try:
        return (script_of(kind), fuller_script_of(kind)) if kind else (None, None)
    except FormulaError:
        return None, None


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
    env = Unfused(kind())
    constants = ", ".join(map(_number, env.program.constants))
    return _file(env, f", constants: [{constants}], about: {page_json(_about(kind, env))}")


def fuller_script_of(kind: type[Task]) -> str | None:
    """Return the file with the functions of the step that `fuller` finds, if any."""
    env, _ = fuller(kind)
    return _file(env) if env else None


def _file(env: Unfused, more: str = "") -> str:
    names = ", ".join(env.program.names)
    put = f"lagEnvs.put({{ functions: {{ {names} }}{more} }});"
    return f'"use strict";\n(() => {{\n{env.program.javascript}{put}\n}})();\n'


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
    on the picture is given at the marks. A parameter that is 0 has a largest value, `most`; for values above
    0 there is the script of `fuller`. The limit of the controls is a factor, `shown` in units of the only
    control or in per cent.
    """
    task, names, fields = env.task, list(env.program.given), type(env.task.scene).__dataclass_fields__
    more, added = fuller(kind)
    marked = _followed(kind, env) | added
    found: list[dict[str, Any]] = []
    for name, value in _changeable(env).items():
        if marks := marked.get(name):
            looks = [_look(other) for other in _made(kind, {name: marks})]
            seen = looks[0] != looks[-1]
            if seen or _acts((more if name in added else None) or env, name, marks):
                unit, at = fields[name].metadata["unit"], names.index(f"self_{name}")
                slider = {"name": name, "unit": "" if unit == "1" else unit, "at": at, "value": value}
                slider |= {"most": marks[-1]} if name in added else {}
                found.append(slider | ({"looks": looks} if seen else {}))
    acting = task.formulas.acting
    if not task.formulas.choices and acting and all(a.low == -a.high for a in acting):
        limit = {"name": "control limit", "at": names.index("strength"), "value": 1.0}
        if len(acting) == 1:
            found.append(limit | {"shown": acting[0].high, "unit": acting[0].unit})
        else:
            found.append(limit | {"shown": 100.0, "unit": "%"})
    return found


def _changeable(env: Unfused) -> dict[str, float]:
    """Return the parameters that are given, neither drawn nor computed from others."""
    task = env.task
    fixed = {*env.program.made, *(d.name for d in (task.imperfections.drawn if task.imperfections else ()))}
    values = parameter_values(task.scene)
    return {name: value for name, value in values.items() if name not in fixed and 0.0 <= value < math.inf}


def _followed(kind: type[Task], env: Unfused) -> dict[str, list[float]]:
    """Return the parameters above 0 that a task's script follows, with their values at `MARKS`."""
    marked = {name: [value * mark for mark in MARKS] for name, value in _changeable(env).items() if value}
    marked = {name: marks for name, marks in marked.items() if _made(kind, {name: marks})}
    # Try all at once, which is quick; try them one by one only if that fails.
    if _follows(env, marked):
        return marked
    return {name: marks for name, marks in marked.items() if _follows(env, {name: marks})}


@cache
def fuller(kind: type[Task]) -> tuple[Unfused | None, dict[str, list[float]]]:
    """Return a step that keeps the terms of parameters that are 0, and these with their values at `ADDED`.

    A task's own script leaves these terms out. This one is the script of the same task with the parameters
    above 0; its numbers have the same places. None if there are no such parameters.
    """
    env = Unfused(kind())
    scene, usual = env.task.scene, _followed(kind, env)

    def fits(added: dict[str, list[float]]) -> tuple[Unfused, dict[str, list[float]]] | None:
        tasks = _made(kind, added)
        found = Unfused(tasks[-1]) if tasks else None
        return (found, added) if found and _alike(env, found) and _follows(found, usual | added) else None

    added = {
        name: [size * mark for mark in ADDED]
        for name, value in _changeable(env).items()
        if value == 0.0 and name not in scene.mechanics.zeros and (size := natural_size(scene, name))
    }
    found = fits(added) or fits({name: marks for name, marks in added.items() if fits({name: marks})})
    return found or (None, {})


def _made(kind: type[Task], marked: Mapping[str, Sequence[float]]) -> list[Task]:
    """Return the task with parameters at their marks; empty if one of them is refused."""
    try:
        rows = zip(*marked.values(), strict=True)
        return [kind(**dict(zip(marked, row, strict=True))) for row in rows]
    except (ValueError, TypeError, FormulaError):
        return []


def _follows(env: Unfused, marked: Mapping[str, Sequence[float]]) -> bool:
    """Return whether a script with changed parameters does the same as tasks made with them."""
    others = _made(type(env.task), {name: (marks[0], marks[-1]) for name, marks in marked.items()})
    return bool(others) and all(_steps_as(env, list(marked), other) for other in others)


def _acts(env: Unfused, name: str, marks: Sequence[float]) -> bool:
    """Return whether the step reads a parameter, or a constant that changes with it."""
    lowest, highest = Unfused(env.task, env.program), Unfused(env.task, env.program)
    lowest.set_parameter(name, marks[0])
    highest.set_parameter(name, marks[-1])
    step = env.program.python.partition("def start(")[2]  # what comes before computes the constants
    pairs = zip(lowest.constants, highest.constants, strict=True)
    return any(a != b and f"k[{i}]" in step for i, (a, b) in enumerate(pairs))


def _alike(one: Unfused, other: Unfused) -> bool:
    """Return whether the numbers of two steps have the same places."""
    a, b = ((list(p.given), list(p.derived), p.rows, p.frames) for p in (one.program, other.program))
    return a == b


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
