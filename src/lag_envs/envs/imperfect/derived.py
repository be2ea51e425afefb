"""Constants computed from drawn parameters."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

from lag_envs.envs.imperfect.twice import Twice, TwiceFunctions, nearest_float
from lag_envs.mechanics.algebra import evaluate
from lag_envs.mechanics.recording import formula as naming
from lag_envs.mechanics.recording import parameter, parameter_names, parameter_values, twin
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping.compiling import block_lines, record_block
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.general import stepper_of
from lag_envs.stepping.lag import lagged_stepper
from lag_envs.stepping.tracing import TracedNumber
from lag_envs.tasks.base import Task


class DerivedConstants:
    """The constants that depend on the drawn parameters, and the lines that compute them.

    They are computed with twice the digits, from drawn and other parameters, and rounded once. Therefore an
    environment gives the same bits as an environment that is made with these values.
    """

    def __init__(self, task: Task, absent: frozenset[str]) -> None:
        drawn = task.drawn
        assert drawn is not None
        self._task, self._draws, self._made = drawn.inner, drawn.draws, drawn.made
        self._scene = self._task.scene
        self._lags = bool(task.imperfections and task.imperfections.lag)
        inner = parameter_values(self._scene)
        trace = ElementaryTrace()
        for d in self._draws:
            inner[d.name] = trace.inputs(d.name)[0]
        self._follow(inner)
        parameters = {n for n, x in inner.items() if isinstance(x, TracedNumber)}
        found = self._task.formulas.starts_of(inner) | {f"self_{n}": x for n, x in inner.items()}
        found |= {n: x for n, x in self._motion(trace, inner, parameters).items() if n not in absent}
        #: Constants that change from episode to episode.
        self.changed = [name for name, x in found.items() if isinstance(x, TracedNumber)]
        self._parameters = parameters

    def _follow(self, numbers: dict[str, Any]) -> None:
        """Replace the parameters that are computed from others."""
        for name, made in self._made.items():
            with naming(self._scene, name):
                numbers[name] = made(twin(self._scene, numbers))

    def _motion(self, trace: Any, numbers: dict[str, Any], changed: set[str]) -> dict[str, Any]:
        """Return the constants of the motion that depend on changing parameters."""
        form, scene = form_of(self._scene), self._scene
        below = {s.name for s in form.inertia.symbols()} if form else set()
        wanted = dict(form.expressions if form else stepper_of(scene.mechanics).expressions())
        wanted = {n: e for n, e in wanted.items() if changed & ({s.name for s in e.symbols()} | below)}
        lagged = lagged_stepper(scene.mechanics).expressions() if self._lags else {}
        lagged = {f"lagged_{n}": e for n, e in lagged.items() if changed & {s.name for s in e.symbols()}}
        values = {
            parameter(name): Twice(x) if isinstance(x, TracedNumber) else Fraction(x)
            for name, x in numbers.items()
            if isinstance(x, TracedNumber) or math.isfinite(x)
        }
        functions = TwiceFunctions(trace)
        found = evaluate(list(wanted.values()), values, functions)
        if form:
            (inertia,) = evaluate([form.inertia], values, functions)
            found = [x / inertia for x in found]
        found += evaluate(list(lagged.values()), values, functions)
        return {name: nearest_float(x) for name, x in zip([*wanted, *lagged], found, strict=True)}

    def lines(self, constants: dict[str, Any]) -> list[str]:
        """Return the lines that draw parameters from ``share0``, ... and fill in the constants."""
        trace = ElementaryTrace()
        outputs: dict[str, Any] = {}
        for j, d in enumerate(self._draws):
            given = (constants[f"draw_{name}{j}"] for name in ("base", "low", "high"))
            base, low, high = (trace.inputs(x)[0] if isinstance(x, str) else x for x in given)
            (share,) = trace.inputs(f"share{j}")
            outputs[f"p_{d.name}"] = d.printed(share, base, low, high, trace)
        code = block_lines(trace, outputs, fused=False)
        # Derived parameters are computed as in Python, with one rounding for each operation.
        trace = ElementaryTrace()
        numbers = self._given(trace, constants)
        self._follow(numbers)
        follow = {f"p_{n}": numbers[n] for n in self._made if n in self._parameters}
        if follow:
            more, _ = record_block(trace, follow, fused=False)
            code += more
        trace = ElementaryTrace()
        numbers = self._given(trace, constants) | {n: trace.inputs(f"p_{n}")[0] for n in self._parameters}
        found = self._task.formulas.starts_of(numbers) | {f"self_{n}": x for n, x in numbers.items()}
        found |= self._motion(trace, numbers, self._parameters)
        return [*code, *block_lines(trace, {f"k_{name}": found[name] for name in self.changed})]

    def _given(self, trace: Any, constants: dict[str, Any]) -> dict[str, Any]:
        """Return all parameters as inputs, except that zeros stay zero."""
        numbers: dict[str, Any] = {}
        for name in parameter_names(self._scene):
            at = constants[f"self_{name}"]
            numbers[name] = trace.inputs(at)[0] if isinstance(at, str) else 0.0
        for d in self._draws:
            numbers[d.name] = trace.inputs(f"p_{d.name}")[0]
        return numbers
