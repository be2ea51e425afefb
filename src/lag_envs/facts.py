"""Facts about a task of the general contract, as text; the command ``lag-envs info``."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from lag_envs.envs.interface import observation_space
from lag_envs.scenes.checks import StepRefused
from lag_envs.scenes.derivation import layout_of
from lag_envs.tables import aligned, number_text
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import KEYWORDS


class Keyword(NamedTuple):
    """A keyword of an environment: its default, and as text its unit, its range and its meaning."""

    name: str
    default: Any
    unit: str
    within: str
    meaning: str


def facts(task: Task, name: str, formulas: str) -> list[str]:
    """Return lines on description, state, controls, observation, start, parameters and accuracy.

    `formulas` says where the task's formulas are.
    """
    scene = task.scene
    states = zip(scene.state_names, scene.state_units, strict=True)
    about = _description(task)
    text = [name, "", *([about, ""] if about else [])]
    text += [f"Scene: {type(scene).__module__}.{type(scene).__name__}"]
    text += [f"State: {', '.join(f'{name} [{unit}]' for name, unit in states)}"]
    text += [f"Step: {task.dt:g} s; episode: {task.limit:g} steps, {task.duration:g} s"]
    text += ["", "Controls, and the actions that set them", *_indented(_controls(task))]
    if task.formulas.target_boxes:
        rows: list[tuple[str, ...]] = [
            (t.name, f"{t.centre:g} ± {t.half:g} {t.unit}", "or target=...")
            for t in task.formulas.target_boxes
        ]
        text += ["", "Targets (uniform)", *_indented(rows)]
    space = observation_space([task])
    bounds = zip(task.observation, space.low.tolist(), space.high.tolist(), strict=True)
    text += [
        "",
        "Observation and its bounds",
        *_indented([(n, _bound(low, high), *task.quantities.get(n, ("", ""))) for n, low, high in bounds]),
    ]
    text += ["", "Start (uniform, unless reset(options={'state': ...}))", *_indented(_starts(task))]
    text += ["", "Parameters, keywords of gym.make", *_indented(_parameters(task))]
    own = type(task).imperfections
    text += ["", "Imperfections, keywords too (None switches one off)"]
    text += _indented([(f"{keyword}={value!r}",) for keyword, value in own.items()])
    text += [f"  off: {', '.join(keyword for keyword in KEYWORDS if keyword not in own)}"]
    text += ["", "Numerical accuracy", *("  " + line for line in _accuracy(task))]
    text += ["", "Rewards, end of the episode, equations, optimal value:", f"  {formulas}"]
    return text


def _indented(rows: list[tuple[str, ...]]) -> list[str]:
    return [f"  {line}" for line in aligned(rows)] if rows else ["  none"]


def _description(task: Task) -> str:
    """Return the class's docstring up to its tables, with its references as plain text."""
    text = inspect.getdoc(type(task)) or ""
    text = re.sub(r"(?m)^\.\. (?=\[\d+\] )|(?<=\[\d\])_", "", text)
    summary, _, rest = text.partition("\n\n## Description\n\n")
    return (
        f"{summary}\n\n{rest.partition(chr(10) * 2 + '## ')[0]}" if rest else summary.partition("\n\n## ")[0]
    )


def _controls(task: Task) -> list[tuple[str, ...]]:
    units = dict(zip(task.scene.control_names, task.scene.control_units, strict=True))
    rows: list[tuple[str, ...]] = []
    top = task.formulas.largest
    for acting in task.formulas.acting:
        del units[acting.control]
        given = ", ".join(f"{v:g}" for v in acting.values) or f"{acting.low:g} to {acting.high:g}"
        actions = f"0 to {len(acting.values) - 1}" if acting.values else f"{-top:g} to {top:g}"
        rows.append((acting.control, f"{given} {acting.unit}", f"actions {actions}"))
    return rows + [(name, f"0 {unit}", "no action sets it") for name, unit in units.items()]


def _bound(low: float, high: float) -> str:
    largest = float(np.finfo(np.float32).max)
    if low <= -largest and high >= largest:
        return "unbounded"
    return f"±{high:g}" if low == -high else f"{low:g} to {high:g}"


def _starts(task: Task) -> list[tuple[str, ...]]:
    names = zip(task.scene.state_names, task.centre, task.half_widths, task.scene.state_units, strict=True)
    return [(name, f"{centre:.4g} ± {half:g} {unit}") for name, centre, half, unit in names]


def keywords(task: Task) -> list[Keyword]:
    """Return an environment's keywords, for parameters, `dt`, `duration`, the target and pictures.

    Imperfections and `diagnostics` are not among these keywords. The meaning of a parameter is left to the
    scene.
    """
    usable, rows = task.usable_ranges(), []
    for field in dataclasses.fields(task.scene):
        if field.init:
            within = _range(field.metadata, usable.get(field.name, (-math.inf, math.inf)))
            unit = field.metadata.get("unit", "")
            rows.append(Keyword(field.name, getattr(task.scene, field.name), unit, within, ""))
    rows += [
        Keyword("dt", task.dt, "s", "1e-6 to 1", "Control interval. The duration stays the same."),
        Keyword("duration", task.duration, "s", "at least dt; math.inf for no end", "Length of an episode."),
    ]
    if task.formulas.target_boxes:
        unit = ", ".join(dict.fromkeys(target.unit for target in task.formulas.target_boxes))
        fixed = "A fixed target for every episode; None: a random one."
        rows.append(Keyword("target", None, unit, "", fixed))
    return [
        *rows,
        Keyword("show_arrows", False, "", "", "Arrows for controls and forces in pictures."),
        Keyword("show_trail", 0.0, "s", "0 to 60", "How far back the bodies' trails go in pictures."),
        Keyword("show_readout", False, "", "", "Time, return, controls and state below pictures."),
    ]


def _range(declared: Mapping[str, Any], usable: tuple[float, float]) -> str:
    """Return a parameter's range: the range in which the task is usable, or else the declared range."""
    words = {"above": "above", "least": "at least", "below": "below", "most": "at most"}
    rules = [
        f"{word} {number_text(declared[key])}" for key, word in words.items() if declared.get(key) is not None
    ]
    if any(map(math.isfinite, usable)):
        rules = [" to ".join(map(number_text, usable))]
    return ", ".join(rules) + ", or math.inf" * bool(declared.get("endless"))


def _parameters(task: Task) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, value, unit, within, meaning in keywords(task):
        shown = f"{value:.6g} {unit}".rstrip() if isinstance(value, float) else repr(value)
        rows.append((name, shown, within, meaning.rstrip(".")))
    return rows


def _edges(task: Task) -> Iterator[tuple[list[float], list[float]]]:
    """Yield the corners of the starts' box, or a sample of many corners, with controls at both limits."""
    boxes = list(zip(task.centre, task.half_widths, strict=True))
    ends = {a.control: (a.low, a.high) for a in task.formulas.acting}
    for side in (0, 1):
        held = [ends.get(name, (0.0, 0.0))[side] for name in task.scene.control_names]
        signs = itertools.product(*((-1.0, 1.0) if half else (0.0,) for _, half in boxes))
        for sign in itertools.islice(signs, 64):
            yield [c + s * half for s, (c, half) in zip(sign, boxes, strict=True)], held


def _accuracy(task: Task) -> list[str]:
    """Describe the proved accuracy of steps from extreme starts under the largest controls."""
    scene: Any = task.scene
    found, refused = [], 0
    for state, held in _edges(task):
        try:
            found.append(scene.step_bound(state, held, task.dt))
        except StepRefused:
            refused += 1
    lines = []
    if found and not any(bound.order for bound in found):
        return ["stepped in closed form, or by a series summed to rounding: one substep, nothing to certify"]
    if found:
        attempts = max(bound.substeps for bound in found)
        largest = max(max(bound.bounds.values(), default=0.0) for bound in found)
        whole = sum(bound.substeps == 1 for bound in found)
        lines += [
            f"Taylor series of order {found[0].order}, {found[0].kind}",
            f"from extreme starts under the largest controls: {whole} of {len(found)} steps certified as a "
            f"whole, {attempts} attempt{'s' if attempts > 1 else ''} at most",
        ]
        if math.isfinite(largest):
            lines += [f"proved truncation error there: {largest:.1e} at most, in units of the state"]
    speed = task.certified_speed()
    if speed is not None and speed >= 0.0:
        shown, rate = math.floor(10.0 * speed) / 10.0, f"{layout_of(scene).free[0]}_dot"
        lines += [f"one substep is certified up to |{rate}| = {shown:g} rad/s, whatever the control"]
    elif speed is not None:
        lines += ["one substep is certified at no speed: a bound before each step decides how many are taken"]
    if refused:
        lines += [f"{refused} of these steps are refused: take a smaller dt or milder parameters"]
    return lines
