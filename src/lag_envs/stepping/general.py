"""One control step of any scene: from its state to the series' variables, the series, and back.

A control that sets the acceleration of a prescribed coordinate moves it exactly. If it sets the rate instead,
velocities jump when the rate is switched, and the state holds w = v + M⁻¹ Σ_m G_m ṡ_m in place of the
velocities; w is converted at both ends of the control step.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lag_envs.mechanics.algebra import Atom, Expr, derivative, evaluate
from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.evaluation import eliminated, exactly
from lag_envs.mechanics.layout import Prescribed
from lag_envs.mechanics.motion import Mechanics
from lag_envs.mechanics.recording import control, parameter, parameter_values
from lag_envs.stepping.compiling import absent_from, block_lines, compile_lines, indent
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.lowering import CLOCK, Lowering, SeriesRecord
from lag_envs.stepping.rows import Rows
from lag_envs.stepping.series import TOLERANCE

#: The largest order for which code for this order alone may be faster.
LARGEST_FIXED = 12


class SeriesStepper:
    """One scene's control step by the general series, as lines of code and compiled functions.

    Parameters
    ----------
    mechanics : Mechanics
        The scene's equations of motion.
    """

    def __init__(self, mechanics: Mechanics) -> None:
        self.mechanics = mechanics
        self._layout = mechanics.layout
        self._lowering, self._parts = self._lowered()
        self._whole = self._lowering.without(*self._parts)
        converted = [*mechanics.mass.values(), *mechanics.coupling.values()] if mechanics.coupling else []
        self._codes: dict[tuple[frozenset[str], bool, int | None], SeriesCode] = {}
        self._tangents: dict[tuple[str, ...], tuple[Lowering, tuple[list[int], dict]]] = {}
        self._parameters = sorted({s.name for e in converted for s in e.symbols() if s.kind == "parameter"})

    def _lowered(self, tangents: Sequence[str] | None = None) -> tuple[Lowering, tuple[list[int], dict]]:
        """Return the lowering of the equations, and its parts."""
        lowering = Lowering(self._layout.free, self._moving(), tangents)
        return lowering, lowering.parts(self.mechanics.mass, self.mechanics.force)

    def _moving(self) -> dict[str, list[Expr]]:
        """Return the moving prescribed coordinates as polynomials in time."""
        elapsed = Expr.of(CLOCK)
        moving: dict[str, list[Expr]] = {}
        for p in self._layout.at("acceleration", "rate"):
            s = Expr.of(Atom("start", p.name))
            held = Expr.of(control(p.control))
            if p.level == "rate":
                moving[p.name] = [s + elapsed * held, held]
            else:
                rate = Expr.of(Atom("start", f"{p.name}_dot"))
                half = held / 2
                moving[p.name] = [s + elapsed * (rate + elapsed * half), rate + elapsed * held, half]
        return moving

    # --- constants ------------------------------------------------------------------------------------------

    def constants(self, parameters: Mapping[str, float], functions: Any = math) -> dict[str, float]:
        """Return the numbers that a step needs, computed from the parameters; zeros leave no code.

        `functions` has sine, cosine and so on.
        """
        return _evaluated(self.expressions(), parameters, functions)

    # --- from the state and back ----------------------------------------------------------------------------

    @property
    def arguments(self) -> list[str]:
        """Names of the code's arguments for the controls."""
        return [f"u{i}" for i in range(len(self._layout.controls))]

    @property
    def applied(self) -> list[str]:
        """Names of the results of `followed`."""
        return []

    def followed(self, xp: Any, u: Sequence, dt: Any) -> list:
        """Return the lagged controls after the step; nothing if controls are held."""
        return []

    def _state(self, y: Sequence) -> dict[str, Any]:
        """Return the state's entries by name."""
        return dict(zip((e.name for e in self._layout.state), y, strict=True))

    def _starting(self, xp: Any, u: Sequence) -> Sequence:
        """Return the controls at the step's start."""
        return u

    def _inputs(self, xp: Any, u: Sequence) -> dict[str, Any]:
        """Return the inputs that follow from the controls."""
        return {f"control_{name}": value for name, value in zip(self._layout.controls, u, strict=True)}

    def prepare(self, xp: Any, y: Sequence, u: Sequence, k: Mapping[str, Any]) -> dict[str, Any]:
        """Return the inputs of the series by name, and places ``q0``, ... and velocities ``v0``, ...."""
        given = self._state(y)
        known = {f"start_{name}": value for name, value in given.items()} | self._inputs(xp, u)
        inputs = {name: known[name] for name in self._whole.inputs if name in known}
        q = [given.get(name, 0.0) for name in self._layout.free]  # places left out do not matter
        driven = {p.name: given.get(p.name) for p in self._layout.prescribed}
        shift = self._shift(xp, q, driven, self._starting(xp, u), k)
        for i, name in enumerate(self._layout.free):
            inputs[f"q{i}"] = q[i]
            inputs[f"v{i}"] = self._rate(given, name, shift[i])
        return inputs

    def _rate(self, given: Mapping[str, Any], name: str, shift: Any) -> Any:
        for entry in self._layout.state:
            if entry.coordinate == name and entry.kind == "velocity":
                return given[entry.name]
            if entry.coordinate == name and entry.kind == "momentum":
                return given[entry.name] - shift
        raise AssertionError(name)

    def _shift(self, xp: Any, q: Sequence, s: Mapping[str, Any], u: Sequence, k: Mapping[str, Any]) -> list:
        """Return M⁻¹ Σ_m G_m ṡ_m for the prescribed coordinates whose rates are held."""
        m = self.mechanics
        n = len(m.free)
        if not m.coupling:
            return [0.0] * n
        values: dict[Atom, Any] = {parameter(name): k[f"p_{name}"] for name in self._parameters}
        values |= {place(name): value for name, value in zip(m.free, q, strict=True)}
        values |= {place(name): value for name, value in s.items() if value is not None}
        values |= {control(name): value for name, value in zip(self._layout.controls, u, strict=True)}
        rates = {p.name: self._by(p, u) for p in self._layout.at("rate")}
        values |= {velocity(name): rate for name, rate in rates.items()}
        entries = evaluate(m.entries(), values, xp)
        right: list[Any] = [0.0] * n
        for (i, name), entry in sorted(m.coupling.items()):
            (weight,) = evaluate([entry], values, xp)
            right[i] = right[i] + weight * rates[name]
        return eliminated([entries[i * n : (i + 1) * n] for i in range(n)], right)

    def finish(
        self, xp: Any, q: Sequence, v: Sequence, y: Sequence, u: Sequence, dt: Any, k: Mapping[str, Any]
    ) -> list:
        """Return the state at the step's end."""
        after, u = self._driven(xp, self._state(y), u, dt)
        shift = self._shift(xp, q, {p.name: after.get(p.name) for p in self._layout.prescribed}, u, k)
        for entry in self._layout.state:
            if entry.coordinate in self._layout.free:
                i = self._layout.free.index(entry.coordinate)
                if entry.kind == "place":
                    after[entry.name] = q[i]
                else:
                    after[entry.name] = v[i] if entry.kind == "velocity" else v[i] + shift[i]
        return [after[entry.name] for entry in self._layout.state]

    def _driven(
        self, xp: Any, given: Mapping[str, Any], u: Sequence, dt: Any
    ) -> tuple[dict[str, Any], Sequence]:
        """Return the state of the prescribed coordinates at the step's end, and the controls there."""
        after: dict[str, Any] = {}
        for p in self._layout.prescribed:
            if p.level == "acceleration" and f"{p.name}_dot" in given:
                held, rate = self._by(p, u), given[f"{p.name}_dot"]
                if p.name in given:
                    after[p.name] = given[p.name] + dt * (rate + 0.5 * dt * held)
                after[f"{p.name}_dot"] = rate + dt * held
            elif p.level == "rate" and p.name in given:
                after[p.name] = given[p.name] + dt * self._by(p, u)
        return after, u

    def _by(self, p: Prescribed, numbers: Sequence) -> Any:
        """Return the number for the control of a prescribed coordinate, from the numbers for all controls."""
        return numbers[self._layout.controls.index(p.control)]

    # --- derivatives ---------------------------------------------------------------------------------------

    def tangent_record(
        self, parameters: Mapping[str, float], by: tuple[str, ...]
    ) -> tuple[SeriesRecord, dict[str, float], dict[str, float]]:
        """Return the step's record with tangents with respect to the parameters in `by` too.

        Its constants with these parameters are returned with it, and the parameters that `prepare` takes.
        """
        if by not in self._tangents:
            self._tangents[by] = self._lowered(tangents=by)
        lowering, parts = self._tangents[by]
        constants = _evaluated(lowering.constants, parameters)
        exprs = {name: e for name, e in lowering.constants.items() if constants[name] == 0.0}
        lifted: set[str] = set()  # a parameter that is 0 brings in a further series
        for p in by:
            slopes = _evaluated({n: derivative(e, parameter(p)) for n, e in exprs.items()}, parameters)
            lifted |= {name for name in exprs if slopes[name] != 0.0}
        numbers = {f"p_{name}": float(parameters[name]) for name in self._parameters}
        return lowering.without(*parts, frozenset(exprs) - lifted), constants, numbers

    # --- code -----------------------------------------------------------------------------------------------

    def code(self, absent: frozenset[str] = frozenset(), fused: bool = True, order: int = 0) -> SeriesCode:
        """Return the step without the terms of constants that are zero.

        An unfused step has the same bits as plain + - * / √ and comparisons on any machine. If it will be
        called with one order only, that order may be given: the bits are the same, but low orders are faster.
        """
        fixed = order if order and _pays_fixed(order, len(self._layout.free)) else None
        key = absent, fused, fixed
        if key not in self._codes:
            self._codes[key] = SeriesCode(self, self.record(absent, fused), *key)
        return self._codes[key]

    def record(self, absent: frozenset[str] = frozenset(), fused: bool = True) -> SeriesRecord:
        """Return the record of the step, without the terms of constants that are zero."""
        return self._lowering.without(*self._parts, absent, fused)

    def expressions(self) -> dict[str, Expr]:
        """Return the numbers that a step needs, as expressions in the parameters."""
        own = {f"p_{name}": Expr.of(parameter(name)) for name in self._parameters}
        return dict(self._whole.constants) | own


def _evaluated(
    constants: Mapping[str, Expr], parameters: Mapping[str, float], functions: Any = math
) -> dict[str, float]:
    """Return the values of a record's constants, each rounded once."""
    numbers = evaluate(list(constants.values()), exactly(parameters), functions)
    return {name: float(value) for name, value in zip(constants, numbers, strict=True)}


class StepBound(NamedTuple):
    """How a control step is divided, and bounds on its truncation error.

    Attributes
    ----------
    substeps : int
        Number of attempts that the step took; 1 if the first one was certified for the whole step.
    order : int
        Order of the series.
    bounds : dict of str to float
        For each entry of the state a bound on the truncation error, in its unit.
    kind : str
        ``"proved with the step"``, or ``"proved before the step"``.
    """

    substeps: int
    order: int
    bounds: dict[str, float]
    kind: str


class SeriesCode:
    """The code of a control step.

    Attributes
    ----------
    start, end : list of str
        Names of the state's entries before and after the step.
    controls : list of str
        Names of the controls, or of the inputs that they follow from.
    applied : list of str
        Names of the results about lagged controls that `compile` returns.
    constants : list of str
        Names of the constants that the code uses.
    rows : list of str
        Rows of a lane that the block function reads and writes: those of `LaneLayout`, then room.
    """

    def __init__(
        self,
        stepper: SeriesStepper,
        record: SeriesRecord,
        absent: frozenset[str],
        fused: bool = True,
        fixed_order: int | None = None,
    ) -> None:
        layout = stepper._layout
        self.record, self._options = record, {"fused": fused, "fixed_order": fixed_order}
        self.start = [f"y{i}" for i in range(len(layout.state))]
        self.end = [f"z{i}" for i in range(len(layout.state))]
        self.controls = stepper.arguments
        self.applied = stepper.applied
        n = record.size
        self._n = n
        names = [*stepper._whole.constants, *(f"p_{name}" for name in stepper._parameters)]
        given: dict[str, Any] = {name: 0.0 if name in absent else f"k_{name}" for name in names}
        q, v = [f"q{i}" for i in range(n)], [f"v{i}" for i in range(n)]
        self._inputs = [f"k_{name}" if name in record.constants else name for name in record.given]
        wanted = [name for name in record.given if name not in record.constants]

        def run(formula: Callable, inputs: Sequence[str]) -> list[str]:
            trace = ElementaryTrace()
            numbers = {
                name: trace.zero() if value == 0.0 else trace.inputs(value)[0]
                for name, value in given.items()
                if name.startswith("p_")
            }
            return block_lines(trace, formula(trace, trace.inputs(*inputs), numbers), fused=fused)

        states, controls = len(self.start), len(self.controls)

        def prepare(xp: Any, values: Sequence, k: Mapping) -> dict[str, Any]:
            found = stepper.prepare(xp, values[:states], values[states:], k)
            return {name: found[name] for name in (*wanted, *q, *v)}

        def finish(xp: Any, values: Sequence, k: Mapping) -> dict[str, Any]:
            rest = values[2 * n :]
            given = rest[states : states + controls]
            ends = stepper.finish(xp, values[:n], values[n : 2 * n], rest[:states], given, rest[-1], k)
            found = dict(zip(self.end, ends, strict=True))
            return found | dict(zip(self.applied, stepper.followed(xp, given, rest[-1]), strict=True))

        self.prepare = run(prepare, [*self.start, *self.controls])
        self.finish = run(finish, [*q, *v, *self.start, *self.controls, "dt"])
        words = set(re.findall(r"\w+", " ".join([*self.prepare, *self.finish, *self._inputs])))
        self.constants = [value for value in given.values() if value in words]
        #: Rows that must be filled in before the step.
        self.given = [*self._inputs, *q, *v, "status", "span"]
        own = [*self._inputs, *q, *v, "status", "left", "wish", "span"]
        self.rows = [*own, *(f"rest_{name}" for name in own), "rest_lane"]
        #: The rows that are read after the step.
        self.results = [*q, *v, "status"]

    @property
    def scratch(self) -> int:
        """Numbers that `compile` needs in its array of rows."""
        from lag_envs.stepping.machine import LaneLayout

        return LaneLayout(self.record).rows

    @property
    def arguments(self) -> str:
        """The arguments of `advance`."""
        return ", ".join(["rows", *self.start, *self.controls, "dt", "order", *self.constants])

    def compile(self, tolerance: float = TOLERANCE, bounds: bool = False) -> Callable:
        """Compile ``advance(rows, y..., u..., dt, order, constants...)`` to ``(z..., applied..., status)``.

        The status is the number of attempts, or negative if the step is refused. `rows` has `scratch`
        numbers. With `bounds`, the substeps' bounds on places and velocities are added to the last of them.
        """
        results = ", ".join([*self.end, *self.applied, "status"])
        body = [*self.any_step, f"return {results}"]
        return compile_lines("advance", self.arguments, body, self.engine(tolerance, bounds))

    @property
    def any_step(self) -> list[str]:
        """The lines of any step, from ``y``, ``u``, ``dt``, ``order`` to ``z``, `applied`, ``status``."""
        n = range(self._n)
        moved = [*(f"q{i}" for i in n), *(f"v{i}" for i in n)]
        rows = Rows([*self._inputs, *moved], "rows", "0", 1)
        return [
            *self.prepare,
            *rows.store(rows.names),
            "status = advance_lane(rows, dt, np.int64(order))",
            *rows.load(moved),
            *self.finish,
        ]

    def engine(self, tolerance: float = TOLERANCE, bounds: bool = False) -> Callable:
        """Return the function that the lines of `any_step` call."""
        from lag_envs.stepping.driver import compile_advance

        return compile_advance(self.record, tolerance, bounds=bounds, **self._options)

    def bounded(
        self,
        state: Sequence[float],
        controls: Sequence[float],
        dt: float,
        order: int,
        constants: Sequence[float],
    ) -> tuple[int, tuple[Any, Any]]:
        """Take a step; return its status, and the sums of bounds on places and velocities."""
        rows = np.zeros(self.scratch)
        *_, status = self._bounded(rows, *state, *controls, dt, float(order), *constants)
        n = self._n
        return status, (rows[-2 * n : -n], rows[-n:])

    @cached_property
    def _bounded(self) -> Callable:
        return self.compile(bounds=True)

    @cached_property
    def simulation(self) -> Callable:
        """The function that `compile_simulate` makes."""
        return self.compile_simulate()

    def compile_block(self, tolerance: float = TOLERANCE) -> Callable:
        """Compile ``advance_block(memory, base, count, order)`` on `rows` of BLOCK lanes."""
        from lag_envs.stepping.driver import compile_advance_block

        return compile_advance_block(self.record, tolerance, **self._options)

    def compile_simulate(self, tolerance: float = TOLERANCE) -> Callable:
        """Compile ``simulate(trajectory, controls, dt, order, constants...)``.

        It fills the trajectory's rows from the second on, and returns the row whose step was refused, or 0.
        A row is the state, followed by the lagged controls; `controls` holds the commands of each step.
        """
        arguments = ", ".join(["trajectory, controls, dt, order", *self.constants])
        reached = [name.removesuffix("_end") for name in self.applied if name.endswith("_end")]
        carried = [*self.start, *reached]
        given = [name for name in self.controls if name not in reached]
        ends = [*self.end, *self.applied[: len(reached)]]
        loop = [
            *(f"{u} = controls[i, {j}]" for j, u in enumerate(given)),
            *self.any_step,
            "if status < 0:",
            "    return i + 1",
            *(
                f"{y} = trajectory[i + 1, {i}] = {z}"
                for i, (y, z) in enumerate(zip(carried, ends, strict=True))
            ),
        ]
        body = [
            f"rows = np.zeros({self.scratch})",
            *(f"{y} = trajectory[0, {i}]" for i, y in enumerate(carried)),
            "for i in range(controls.shape[0]):",
            *indent(loop),
            "return 0",
        ]
        return compile_lines("simulate", arguments, body, self.engine(tolerance))


_steppers: dict[tuple[type[SeriesStepper], str], SeriesStepper] = {}


def stepper_of(mechanics: Mechanics, kind: type[SeriesStepper] = SeriesStepper) -> SeriesStepper:
    """Return the stepper of these equations of motion; equal equations share one."""
    if (kind, mechanics.key) not in _steppers:
        _steppers[kind, mechanics.key] = kind(mechanics)
    return _steppers[kind, mechanics.key]


def series_code_of(scene: Any, order: int = 0) -> tuple[SeriesCode, list[float]]:
    """Return the code with which the general series steps a scene, and the constants that it takes.

    `SeriesStepper.code` says what `order` is.
    """
    stepper = stepper_of(scene.mechanics)
    constants = stepper.constants(parameter_values(scene))
    code = stepper.code(absent_from(constants), order=order)
    return code, [constants[name.removeprefix("k_")] for name in code.constants]


def _pays_fixed(order: int, coordinates: int) -> bool:
    """Return whether code for one order is faster than loops over orders; long code is not."""
    return order < 8 or (order <= LARGEST_FIXED and coordinates <= 2)


def usual_order(dt: float) -> int:
    """Return the order of the series for a control step [s], unless a scene sets another."""
    return 16 if dt <= 0.03 else 20 if dt <= 0.1 else 22
