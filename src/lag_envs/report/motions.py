"""Control steps of an energy-defined scene as problems for every method, lag_envs included."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.mechanics.algebra import Atom, Expr, evaluate, substitute
from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.recording import control, parameter, parameter_values
from lag_envs.report.equations import Equation, Problems
from lag_envs.report.linkages import System
from lag_envs.report.oracle import oracle_of, solve_positive
from lag_envs.report.rivals import Rival
from lag_envs.report.timing import BLOCK, Sample, blocks, unblocked
from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import layout_of
from lag_envs.stepping.compiling import compile_lines
from lag_envs.stepping.general import series_code_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SceneEquation(Equation):
    """The equation of motion of a scene with its numbers inserted; terms that vanish are left out.

    Unknowns are the free coordinates, then their velocities.
    """

    scene: Scene

    @cached_property
    def _motion(self) -> tuple[list[Expr], list[Expr]]:
        given = parameter_values(self.scene)
        # Parameters that may be infinite, such as a track, are in no formula.
        numbers = {parameter(name): Expr.of(x) for name, x in given.items() if math.isfinite(x)}
        found = self.scene.mechanics
        return [substitute(e, numbers) for e in found.entries()], [
            substitute(f, numbers) for f in found.force
        ]

    @property
    def size(self) -> int:  # type: ignore[override]
        """Two for each free coordinate."""
        return 2 * len(layout_of(self.scene).free)

    @property
    def lifted(self) -> int:  # type: ignore[override]
        """The same number, as cosines and sines are not carried."""
        return self.size

    @cached_property
    def needed(self) -> tuple[str, ...]:
        """The parameters: controls, and the starts of prescribed coordinates, ``s`` and ``s_dot``."""
        layout = layout_of(self.scene)
        symbols = {symbol for part in self._motion for expr in part for symbol in expr.symbols()}
        found = [name for name in layout.controls if control(name) in symbols]
        for p in layout.at("acceleration", "rate"):
            turns = place(p.name) in symbols, velocity(p.name) in symbols
            if any(turns) and p.control not in found:
                found.append(p.control)
            found += [p.name] * turns[0]
            found += [f"{p.name}_dot"] * (p.level == "acceleration" and any(turns))
        return tuple(found)

    @property
    def parameters(self) -> int:  # type: ignore[override]
        """How many there are."""
        return len(self.needed)

    def rate(self, t: Any, y: Sequence, p: Sequence, xp: Any) -> tuple:
        """Return velocities and accelerations."""
        layout, n = layout_of(self.scene), self.size // 2
        given = dict(zip(self.needed, p, strict=True))
        values: dict[Atom, Any] = {control(name): u for name, u in given.items() if name in layout.controls}
        values |= {place(name): y[i] for i, name in enumerate(layout.free)}
        values |= {velocity(name): y[n + i] for i, name in enumerate(layout.free)}
        for moved in layout.at("acceleration", "rate"):
            held = given.get(moved.control, 0.0)
            if moved.level == "acceleration":
                rate, acceleration = given.get(f"{moved.name}_dot", 0.0), held
            else:
                rate, acceleration = held, 0.0
            values[place(moved.name)] = given.get(moved.name, 0.0) + t * (rate + t * (0.5 * acceleration))
            values[velocity(moved.name)] = rate + t * acceleration
        mass, force = self._motion
        found = evaluate([*mass, *force], values, xp)
        rows = [found[i * n : (i + 1) * n] for i in range(n)]
        return *y[n : 2 * n], *solve_positive(rows, found[n * n :])


class SceneProblems(Problems):
    """Control steps of one scene from several states under several controls.

    Parameters
    ----------
    scene : Scene
        The scene.
    starts : ndarray, shape (n, n_state)
        States.
    controls : ndarray, shape (n, n_controls)
        Controls.
    system : System, optional
        The scene's bodies in the form for other engines.
    """

    def __init__(self, scene: Scene, starts: Array, controls: Array, system: System | None = None) -> None:
        self.scene, self.starts, self.controls, self.system = scene, starts, controls, system
        self.cases = []
        self.equation: SceneEquation = SceneEquation(scene)
        layout = layout_of(scene)
        zero = np.zeros(len(starts))
        held = dict(zip(layout.controls, controls.T, strict=True))
        self._q, w = oracle_of(scene).start(list(starts.T), list(controls.T), lambda x: zero + x)
        self._v = self._shifted(self._q, w, -1.0)
        free, moving = layout.free, [m.name for m in layout.at("acceleration", "rate")]
        self.y = np.array([*(self._q[name] for name in free), *(self._v[name] for name in free)])
        known = held | {name: self._q[name] for name in moving}
        known |= {f"{name}_dot": self._v[name] for name in moving}
        needed = self.equation.needed
        self.p = np.array([known[name] for name in needed]).reshape(len(needed), len(starts))

    def __len__(self) -> int:
        return len(self.starts)

    def _shifted(self, q: dict, v: dict, sign: float) -> dict:
        """Return velocities for w, if a rate is held, or w for velocities."""
        if not layout_of(self.scene).at("rate"):
            return v
        shift = oracle_of(self.scene).shift(q, v, list(self.controls.T))
        return v | {n: v[n] + sign * x for n, x in zip(layout_of(self.scene).free, shift, strict=True)}

    def states(self, y: Array, span: float) -> Array:
        """Return the scene's states, one per line, from the unknowns after a time with held controls."""
        layout = layout_of(self.scene)
        n = len(layout.free)
        q = self._q | dict(zip(layout.free, y[:n], strict=True))
        v = self._v | dict(zip(layout.free, y[n : 2 * n], strict=True))
        held = dict(zip(layout.controls, self.controls.T, strict=True))
        for p in layout.at("acceleration", "rate"):
            acceleration = held[p.control] if p.level == "acceleration" else 0.0
            q[p.name] = q[p.name] + span * (v[p.name] + span * (0.5 * acceleration))
            v[p.name] = v[p.name] + span * acceleration
        v = self._shifted(q, v, 1.0)
        return np.stack([(q if e.kind == "place" else v)[e.coordinate] for e in layout.state], axis=1)


class CertifiedSeries(Rival):
    """The general engine at an order and a tolerance, each step certified.

    The setting is the tolerance. Single states run in the loop of `Scene.simulate`, batches in the block
    function of the vector environments; both take one control step from each state.
    """

    family = "lag_envs"

    def __init__(self, order: int, tolerance: float) -> None:
        super().__init__(f"lag_envs, order {order}", tolerance)
        self.order = order

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile."""
        assert isinstance(problems, SceneProblems) and steps == 1
        scene = problems.scene
        code, numbers = series_code_of(scene, self.order)
        starts, controls, count = problems.starts, problems.controls, len(problems)
        width, order = starts.shape[1], float(self.order)
        if not together:
            alone = _alone(code, self.setting)
            ends = np.empty_like(starts)

            def run() -> None:
                if alone(starts, controls, ends, dt, order, *numbers):
                    raise ArithmeticError("a step was refused")

            return Sample(run, count, ends=ends.copy)
        batch = _batch(code, self.setting)
        begin = blocks(np.concatenate([starts, controls], axis=1).T, BLOCK)
        memory = np.zeros((len(begin), begin.shape[1] + len(code.rows) + 1, BLOCK))

        def prepare() -> None:
            memory[:, : begin.shape[1]] = begin

        def together_run() -> None:
            if batch(memory.reshape(-1), count, dt, order, *numbers):
                raise ArithmeticError("a step was refused")

        return Sample(together_run, count, prepare, lambda: unblocked(memory[:, :width], count).T.copy())


@cache
def _alone(code: Any, tolerance: float) -> Callable:
    """Compile ``alone(starts, controls, ends, dt, order, constants...)``: a control step from each state."""
    lines = [
        f"rows = np.zeros({code.scratch})",
        "refused = 0",
        "for j in range(starts.shape[0]):",
        *(f"    {y} = starts[j, {i}]" for i, y in enumerate(code.start)),
        *(f"    {u} = controls[j, {i}]" for i, u in enumerate(code.controls)),
        f"    {', '.join(code.start)}, status = advance({code.arguments})",
        "    refused += status < 0",
        *(f"    ends[j, {i}] = {y}" for i, y in enumerate(code.start)),
        "return refused",
    ]
    arguments = ", ".join(["starts, controls, ends, dt, order", *code.constants])
    return compile_lines("alone", arguments, lines, code.compile(tolerance))


@cache
def _batch(code: Any, tolerance: float) -> Callable:
    """Compile ``batch(memory, count, dt, order, constants...)``: a control step of all lanes, block by block.

    A block has rows for state and controls, then those of `SeriesCode.rows`, and one more.
    """
    names = [*code.start, *code.controls]
    rows = {name: i for i, name in enumerate([*names, *code.rows])}
    # An input of the series may have the name of a control, or may have its own row.
    flow = {name: len(names) + i for i, name in enumerate(code.rows)}

    def at(row: int) -> str:
        return f"memory[base + np.uint64({BLOCK * row}) + i]"

    lanes = f"for i in range(np.uint64({BLOCK})):"
    load = [f"        {name} = {at(rows[name])}" for name in names]
    lines = [
        "wide_vectors()",
        "refused = 0",
        f"for block in range(np.uint64((count + {BLOCK - 1}) // {BLOCK})):",
        f"    base = block * np.uint64({BLOCK * (len(names) + len(code.rows) + 1)})",
        f"    size = min(np.int64({BLOCK}), np.int64(count) - np.int64(block) * {BLOCK})",
        f"    {lanes}",
        *load,
        *(f"        {line}" for line in code.prepare),
        "        status, span = 0.0, dt",
        *(f"        {at(flow[name])} = {name}" for name in code.given),
        f"    first = np.int64(base) + {BLOCK * len(names)}",
        "    refused += advance_block(memory, first, size, np.int64(order))",
        f"    {lanes}",
        *load,
        *(f"        {name} = {at(flow[name])}" for name in code.results),
        *(f"        {line}" for line in code.finish),
        *(f"        {at(rows[y])} = {z}" for y, z in zip(code.start, code.end, strict=True)),
        "return refused",
    ]
    arguments = ", ".join(["memory, count, dt, order", *code.constants])
    return compile_lines("batch", arguments, lines, code.compile_block(tolerance))
