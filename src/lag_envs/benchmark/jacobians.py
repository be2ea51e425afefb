"""The cost of a control step's derivatives, relative to the step: two sections of ``lag-envs bench``.

In the first section, a step and its derivatives start from the same states. The compiled step is called for
each state, because `Scene.simulate` would follow a single motion. The second section compares whole steps of
a vector environment with the same steps backwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lag_envs import scenes
from lag_envs.envs.model import Model
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.scenes import Scene
from lag_envs.scenes.derivation import code_of, form_of, motion_constants_of, step_argument_of
from lag_envs.stepping.compiling import compile_lines, indent
from lag_envs.stepping.flow_code import lift_lines
from lag_envs.tasks import TASKS
from lag_envs.workers import stopping_point

#: Length of the step [s], states in a batch, and calls in a sample of single steps.
DT, BATCH, CALLS = 0.02, 1024, 20
#: Number of environments, and of consecutive whole steps that are taken and differentiated.
ENVS, STEPS = 16384, 8
#: Scenes of the package, each with its most expensive control.
CASES: dict[str, Callable[[], Scene]] = {
    "PivotedBar": scenes.PivotedBar,
    "Incline": scenes.Incline,
    "Incline, tilt_rate": lambda: scenes.Incline(control="tilt_rate"),
    "CylinderInCylinder": lambda: scenes.CylinderInCylinder(damping=0.24),
    "CylinderInCylinder, damping": lambda: scenes.CylinderInCylinder(control="damping"),
    "CartPole": scenes.CartPole,
    "Acrobot": scenes.Acrobot,
    "Chain(2)": lambda: scenes.Chain(bars=2),
    "Chain(3)": lambda: scenes.Chain(bars=3),
    "RotaryPendulum": scenes.RotaryPendulum,
    "TwoLinkArm": scenes.TwoLinkArm,
}


def compile_steps(scene: Scene, dt: float) -> Callable[[Any, Any], Any]:
    """Return a function that takes a step from each of many states and returns the sum of the results."""
    code, constants = code_of(scene, dt), motion_constants_of(scene)
    numbers = [constants[name.removeprefix("k_")] for name in code.constants]
    form, n = form_of(scene), len(scene.state_names)
    general, angle = form is None, None if form is None else form.angle
    held = ["order" if general else "x", *code.constants]
    call = [*(["rows"] if general else []), *code.start, *code.controls, "dt", *held]
    loop = [
        *(f"{y} = states[i, {j}]" for j, y in enumerate(code.start[:n])),
        *lift_lines(n, angle, "y"),
        *(f"{u} = controls[i, {j}]" for j, u in enumerate(code.controls)),
        f"{', '.join(code.end)}, status = advance({', '.join(call)})",
        f"total += {' + '.join(code.end[:n])}",
    ]
    body = [
        *([f"rows = np.zeros({code.scratch})"] if general else []),
        "total = 0.0",
        "for i in range(states.shape[0]):",
        *indent(loop),
        "return total",
    ]
    steps = compile_lines("steps", ", ".join(["states, controls, dt", *held]), body, code.compile())
    limit = step_argument_of(scene, dt)
    return lambda states, controls: steps(states, controls, dt, limit, *numbers)


def jacobians(rounds: int, clock: Callable[[], float], names: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Measure the cost of `Scene.jacobian`, in a batch and one by one, and that of `Scene.vjp`.

    Parameters
    ----------
    rounds : int
        Number of rounds; in each, step and derivatives are measured in turn, and the shortest time counts.
    clock : callable
        Returns the time [s].
    names : sequence of str
        Some of `CASES`; by default all.

    Returns
    -------
    list of dict
        For each scene its ``name``; ``columns`` K, by states and controls; ``step_ns`` and ``jacobian_ns`` of
        a row of a batch, ``ratio`` and its ``aim`` 1 + 2K; ``call_us`` of one call, and ``call_ratio``, its
        ratio to a call of `Scene.simulate`; ``vjp_ns`` of a row backwards, and ``vjp_ratio``, which should be
        at most 4.
    """
    return [_cost(name, rounds, clock) for name in names or CASES]


def _cost(name: str, rounds: int, clock: Callable[[], float]) -> dict[str, Any]:
    """Return the row of a scene."""
    scene = CASES[name]()
    rng = np.random.default_rng(0)
    states = rng.uniform(-1.0, 1.0, (BATCH, len(scene.state_names)))
    controls = rng.uniform(0.0, 1.0, (BATCH, len(scene.control_names)))
    steps = compile_steps(scene, DT)

    def run_steps() -> None:
        for _ in range(CALLS):
            steps(states, controls)

    def simulate() -> None:
        for i in range(CALLS):
            scene.simulate(states[i], controls[i : i + 1], DT)

    def call() -> None:
        for i in range(CALLS):
            scene.jacobian(states[i], controls[i], DT)

    runs = (
        run_steps,
        lambda: scene.jacobian(states, controls, DT),
        simulate,
        call,
        lambda: scene.vjp(states, controls, DT, states),
    )
    all_steps, batch, one, single, back = _least(runs, rounds, clock)
    step, columns = all_steps / CALLS, states.shape[1] + controls.shape[1]
    return {
        "name": name,
        "columns": columns,
        "step_ns": round(1e9 * step / BATCH, 1),
        "jacobian_ns": round(1e9 * batch / BATCH, 1),
        "ratio": round(batch / step, 2),
        "aim": 1 + 2 * columns,
        "call_us": round(1e6 * single / CALLS, 1),
        "call_ratio": round(single / one, 2),
        "vjp_ns": round(1e9 * back / BATCH, 1),
        "vjp_ratio": round(back / step, 2),
    }


def backwards(
    rounds: int, clock: Callable[[], float], ids: Sequence[str] = (), count: int = ENVS
) -> list[dict[str, Any]]:
    """Measure the cost of a whole step of a vector environment backwards, on one core.

    Parameters
    ----------
    rounds, clock
        As for `jacobians`.
    ids : sequence of str
        Ids of environments; by default of all whose steps have derivatives.
    count : int
        Number of environments in a batch.

    Returns
    -------
    list of dict
        For each environment its ``id``; ``step_ns`` and ``back_ns`` for each environment; ``ratio``, which
        should be at most 4.
    """
    smooth = [name for name, kind in TASKS.items() if not kind().formulas.choices and not kind.imperfections]
    return [_backwards(name, rounds, clock, count) for name in ids or smooth]


def _backwards(name: str, rounds: int, clock: Callable[[], float], count: int) -> dict[str, Any]:
    """Return the row of an environment."""
    envs = LagrangianVectorEnv(TASKS[name], count, num_threads=1)
    envs.reset(seed=0)
    rng, reverse = np.random.default_rng(0), Model(envs.task).reverse()
    actions = rng.uniform(-1.0, 1.0, (STEPS, count, envs.task.formulas.actions)).astype(np.float32)
    targets = np.zeros((count, 0)) if envs.target is None else envs.target.reshape(count, -1)
    states = [envs.state]
    for action in actions:
        envs.step(action)
        states.append(envs.state)
    seeds = np.ones_like(states[0]), np.ones((count, len(envs.task.formulas.observation))), np.ones(count)

    def step() -> None:
        for action in actions:
            envs.step(action)

    def back() -> None:
        for i, action in enumerate(actions):
            reverse.vjp(states[i], action, targets, states[i + 1], states[i + 1], *seeds)

    # Both start from the same states, since these determine how a step is divided.
    times = _least((step, back), rounds, clock, before=lambda: envs.reset(seed=0))
    step_ns, back_ns = (1e9 * x / STEPS / count for x in times)
    return {
        "id": name,
        "step_ns": round(step_ns, 1),
        "back_ns": round(back_ns, 1),
        "ratio": round(back_ns / step_ns, 2),
    }


def backwards_table(rows: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Return the rows of a table, the first with the columns' names."""
    cells = [(r["id"], f"{r['step_ns']:,.1f}", f"{r['back_ns']:,.1f}", f"{r['ratio']:.1f}") for r in rows]
    return [("Whole step backwards", "step, ns", "backwards, ns", "steps"), *cells]


def _least(
    runs: Sequence[Callable[[], object]],
    rounds: int,
    clock: Callable[[], float],
    before: Callable[[], object] = lambda: None,
) -> list[float]:
    """Return the shortest time of each [s], without that of `before`; all of them run once first."""
    least = [float("inf")] * len(runs)
    for run in runs:
        stopping_point()
        run()
    for _ in range(rounds):
        stopping_point()
        for i, run in enumerate(runs):
            before()
            start = clock()
            run()
            least[i] = min(least[i], clock() - start)
    return least


def jacobian_table(rows: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Return the rows of a table, the first with the columns' names."""
    head = (
        "Jacobian of a step", "columns", "step, ns", "row, ns", "steps", "aim", "call, µs", "of a step's",
        "backwards, ns", "steps",
    )  # fmt: skip
    cells = [
        (
            r["name"], str(r["columns"]), f"{r['step_ns']:,.0f}", f"{r['jacobian_ns']:,.0f}",
            f"{r['ratio']:.1f}", str(r["aim"]), f"{r['call_us']:.0f}", f"{r['call_ratio']:.1f}",
            f"{r['vjp_ns']:,.0f}", f"{r['vjp_ratio']:.1f}",
        )
        for r in rows
    ]  # fmt: skip
    return [head, *cells]
