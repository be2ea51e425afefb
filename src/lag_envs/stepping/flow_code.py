"""The code of a scene's control step by an exact flow.

A scene's normal form (`lag_envs.stepping.normal_forms`) says how its state and held controls become the
flow's variables and coefficients. From that, this module makes the scalar ``advance`` that single
environments and `Scene.simulate` call, and the code lines of the vectorised step. Both call the same recorded
blocks with the same roundings, which is why a batch and a single environment agree bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np

from lag_envs.stepping.adjoint import Differentiable, LaneFormula
from lag_envs.stepping.compiling import (
    compile_lines,
    count_operations,
    indent,
    section,
    split_lengths,
)
from lag_envs.stepping.dual import Variable, VariableFunctions
from lag_envs.stepping.flows import Flow
from lag_envs.stepping.normal_forms import NormalForm


def lift_lines(n: int, angle: int | None, y: str) -> list[str]:
    """Return the lines that append cosine and sine of the state's angle, if it has one."""
    return [] if angle is None else [f"{y}{n} = math.cos({y}{angle})", f"{y}{n + 1} = math.sin({y}{angle})"]


class FlowCode:
    """One scene's control step as lines of code.

    The lines take the lifted state ``y0, y1, ...``, the controls ``u0, ...``, the step ``dt``, the bound's
    ``x`` and the scene's constants (``k_`` and the name), and give the lifted state ``z0, z1, ...`` at the
    step's end.

    Parameters
    ----------
    form : NormalForm
        How state and controls become the flow's variables and coefficients.
    flow : Flow
        The flow.
    absent : frozenset of str
        Constants that are zero: their terms are left out of the code.
    """

    def __init__(self, form: NormalForm, flow: Flow, absent: frozenset[str]) -> None:
        self.flow = flow
        self._n_state, self._angle = len(form.state_names), form.angle
        width, controls = form.width, len(form.layout.controls)
        terms = len(flow.coefficients._fields)
        constants = {name: 0.0 if name in absent else f"k_{name}" for name in form.expressions}
        self.constants = [name for name in constants.values() if isinstance(name, str)]
        self.start = [f"y{i}" for i in range(width)]
        self.end = [f"z{i}" for i in range(width)]
        self.controls = [f"u{i}" for i in range(controls)]
        before = [f"before{i}" for i in range(flow.size)]
        after = [f"after{i}" for i in range(flow.size)]

        def k(values: Sequence) -> SimpleNamespace:
            return SimpleNamespace(**dict(zip(constants, values, strict=True)))

        def prepare(xp: Any, *values: Any) -> list:
            y, u, rest = split_lengths(values, width, controls)
            return [*form.unpack(y, u, k(rest)), *form.coefficients_at(y, u, k(rest), xp)]

        def finish(xp: Any, *values: Any) -> Sequence:
            moved, y, u, (dt,), rest = split_lengths(values, flow.size, width, controls, 1)
            return form.pack(moved, y, u, dt, k(rest))

        def move(xp: Any, *values: Any) -> tuple:
            variables, coefficients, (dt,) = split_lengths(values, flow.size, terms)
            return flow.fast(variables, flow.coefficients(*coefficients), dt, xp)

        def within(xp: Any, *values: Any) -> list:
            variables, coefficients, (dt, x) = split_lengths(values, flow.size, terms)
            return [flow.within(variables, flow.coefficients(*coefficients), dt, x, xp)]

        given = list(constants.values())
        names = [*before, *flow.coefficients._fields]
        prepared, values = section(prepare, [*self.start, *self.controls, *given], names)
        finished, _ = section(finish, [*after, *self.start, *self.controls, "dt", *given], self.end)
        moved, _ = section(move, [*values, "dt"], after)
        tested, (condition,) = section(within, [*values, "dt", "x"], ["within"])
        if isinstance(condition, bool):
            tested = [f"within = {condition}"]

        #: The lines of an ordinary step, without branches; ``within`` tells whether the step was ordinary.
        self.fast = [*prepared, *tested, *moved, *finished]
        by_name = dict(zip(flow.coefficients._fields, values[flow.size :], strict=True))
        left_out = frozenset(name for name, value in by_name.items() if isinstance(value, float))
        #: Names of the flow's coefficients, and whether each is in the code.
        self.terms = {name: name not in left_out for name in by_name}
        call = f"{', '.join(after)}, status = flow({', '.join(map(str, values))}, dt, x)"
        #: The lines of any step.
        self.any_step = [*prepared, call, *finished]
        #: A function that returns the function that these lines call.
        self.engine = lambda: flow.compile(left_out)
        self._tangent = lambda by: flow.compile_tangent(left_out, by)
        self._given, self._prepare, self._finish, self._form = given, prepare, finish, form
        self._names = [f"k_{name}" for name in constants]

    @property
    def operations(self) -> int:
        """Number of operations of an ordinary step."""
        return count_operations(self.fast)

    @property
    def arguments(self) -> str:
        """The arguments of `advance`."""
        return ", ".join([*self.start, *self.controls, "dt", "x", *self.constants])

    def compile(self) -> Callable:
        """Compile ``advance(y..., u..., dt, x, constants...)`` to ``(z..., status)``.

        It takes any step. The status is the number of substeps, or negative if the step is refused.
        """
        body = [*self.any_step, f"return {', '.join(self.end)}, status"]
        return compile_lines("advance", self.arguments, body, self.engine())

    @cache  # noqa: B019 - these codes are kept anyway
    def compile_jacobian(self, by: tuple[str, ...], constants: tuple[str, ...]) -> Callable:
        """Compile ``jacobian(states, controls, out, dt, x, constants...)``.

        It fills ``out[i]`` with the derivatives of the state after step i with respect to state, controls and
        constants, and returns the row whose step was refused, counted from 1, or 0. `by` names the
        coefficients that depend on these.
        """
        n = self._n_state
        columns = [*self.start[:n], *self.controls, *(f"k_{name}" for name in constants)]
        wide, size, rows = len(columns), self.flow.size, self.flow.size + len(self.terms)

        def given(names: Sequence[Any], numbers: Sequence) -> list[Variable]:
            found = [Variable.of_column(columns, name, x) for name, x in zip(names, numbers, strict=True)]
            if self._angle is not None:
                angle, (c, s) = found[self._angle].slopes, numbers[n : n + 2]
                found[n : n + 2] = [Variable(c, -(angle * s)), Variable(s, angle * c)]
            return found

        def prepare(xp: Any, *numbers: Any) -> list:
            names = [*self.start, *self.controls, *self._names]
            found = self._prepare(VariableFunctions(xp), *given(names, numbers))
            results = [x if isinstance(x, Variable) else Variable.of_column(columns, "", x) for x in found]
            return [x.value for x in results] + [slope for x in results for slope in x.slopes]

        def finish(xp: Any, *numbers: Any) -> list:
            slopes, rest = split_lengths(numbers, 2 * wide)
            names = [*self.start, *self.controls, "dt", *self._names]
            moved = [Variable(0.0, np.array(part, dtype=object)) for part in split_lengths(slopes, wide)]
            others = [Variable(0.0, 0.0)] * (size - 2)
            ends = self._finish(VariableFunctions(xp), *moved, *others, *given(names, rest))
            return [slope for x in ends[:n] for slope in x.slopes]

        held = [f"value{i}" for i in range(rows)] + [f"slope{i}" for i in range(rows * wide)]
        moved = [f"moved{i}" for i in range(2 * wide)]
        prepared, before = section(prepare, [*self.start, *self.controls, *self._given], held)
        ends = [f"end{i}" for i in range(n * wide)]
        finished, after = section(finish, [*moved, *self.start, *self.controls, "dt", *self._given], ends)
        loop = [
            *(f"{y} = states[i, {j}]" for j, y in enumerate(self.start[:n])),
            *lift_lines(n, self._angle, "y"),
            *(f"{u} = controls[i, {j}]" for j, u in enumerate(self.controls)),
            *prepared,
            *(f"values[{j}] = {x}" for j, x in enumerate(before[:rows])),
            *(f"slopes[{j // wide}, {j % wide}] = {x}" for j, x in enumerate(before[rows:])),
            "if tangent(values, slopes, scratch, dt, x) < 0:",
            "    return i + 1",
            *(f"{name} = slopes[{j // wide}, {j % wide}]" for j, name in enumerate(moved)),
            *finished,
            *(f"out[i, {j // wide}, {j % wide}] = {x}" for j, x in enumerate(after)),
        ]
        body = [
            f"values, slopes = np.empty({rows}), np.empty(({rows}, {wide}))",
            f"scratch = np.empty((4, {max(rows, wide)}))",
            "for i in range(states.shape[0]):",
            *indent(loop),
            "return 0",
        ]
        arguments = ", ".join(["states, controls, out, dt, x", *self.constants])
        return compile_lines("jacobian", arguments, body, self._tangent(by))

    def record_vjp(
        self,
        xp: Differentiable,
        state: Sequence,
        u: Sequence,
        k: Any,
        seeds: Sequence,
        by: Sequence,
    ) -> tuple[list, Any]:
        """Record the step backwards; return cotangents, and whether the step is ordinary.

        Parameters
        ----------
        xp : Differentiable
            The recording.
        state, u : sequence of number
            State and controls at the step's start.
        k : namespace
            The constants, with dt and x.
        seeds : sequence of number
            Cotangents of the state after the step.
        by : sequence of number
            The numbers whose cotangents are wanted.
        """
        form, flow, angle = self._form, self.flow, self._angle
        lifted = state if angle is None else [*state, xp.cos(state[angle]), xp.sin(state[angle])]
        variables, coefficients = form.unpack(lifted, u, k), form.coefficients_at(lifted, u, k, xp)
        # The end is linear in the moved variables, so the values of these variables are not needed.
        moved = xp.inputs("moved0", "moved1")
        ends = form.pack([*moved, *variables[2:]], lifted, u, k.dt, k)[: self._n_state]
        *bars, direct = split_lengths(xp.adjoint(ends, seeds, [*moved, *by]), 1, 1)
        earlier = flow.vjp(variables, coefficients, k.dt, [bar for (bar,) in bars], xp)
        found = xp.adjoint([*variables, *coefficients], earlier, by)
        within = flow.within(variables, coefficients, k.dt, k.x, xp)
        return [a + b for a, b in zip(direct, found, strict=True)], within

    @cache  # noqa: B019
    def vjp(self, constants: tuple[str, ...] = ()) -> LaneFormula:
        """Return the reverse mode of ordinary steps, compiled for lanes.

        Its inputs are the numbers dt, x and constants; states, controls, and cotangents of the states after
        the step. Its results are the cotangents of states and controls, those of `constants`, and 1 if the
        step is ordinary.
        """
        y, seeds = self.start[: self._n_state], [f"seed{i}" for i in range(self._n_state)]

        def vjp(xp: Any, numbers: Mapping[str, Any]) -> list[list]:
            state, u, bars = ([numbers[name] for name in names] for names in (y, self.controls, seeds))
            k = SimpleNamespace(
                **{name.removeprefix("k_"): numbers[name] for name in ("dt", "x", *self._names)}
            )
            by = [*state, *u, *(numbers[f"k_{name}"] for name in constants)]
            found, within = self.record_vjp(xp, state, u, k, bars, by)
            return [*split_lengths(found, len(state) + len(u)), [xp.where(within, 1.0, 0.0)]]

        absent = set(self._names) - set(self.constants)
        return LaneFormula("vjp", vjp, [y, self.controls, seeds], ["dt", "x", *self._names], absent)

    @cached_property
    def simulation(self) -> Callable:
        """``simulate(trajectory, controls, dt, x, constants...)``.

        It fills the trajectory's rows from the second on, and returns the row whose step was refused, or 0.
        """
        n = self._n_state
        load = [f"y{i} = trajectory[0, {i}]" for i in range(n)]
        load += lift_lines(n, self._angle, "y")
        loop = [
            *(f"{u} = controls[i, {j}]" for j, u in enumerate(self.controls)),
            *self.any_step,
            "if status < 0:",
            "    return i + 1",
            *(f"{y} = {z}" for y, z in zip(self.start, self.end, strict=True)),
            *(f"trajectory[i + 1, {i}] = y{i}" for i in range(n)),
        ]
        arguments = ", ".join(["trajectory, controls, dt, x", *self.constants])
        body = [
            *load,
            "for i in range(controls.shape[0]):",
            *indent(loop),
            "return 0",
        ]
        return compile_lines("simulate", arguments, body, self.engine())


@cache
def _kept_code(form: NormalForm, flow: Flow, absent: frozenset[str]) -> FlowCode:
    return FlowCode(form, flow, absent)


def flow_code(form: NormalForm, dt: float, absent: frozenset[str] = frozenset()) -> FlowCode:
    """Return the code of a control step by a form's own flow; constants that are zero leave no code."""
    return _kept_code(form, form.flow(dt), absent)
