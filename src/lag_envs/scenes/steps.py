"""Control steps of a scene: what its calls `simulate`, `step_bound`, `jacobian` and `energy_balance` do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.scenes.checks import (
    StepRefused,
    check_both,
    check_controls,
    check_sequence,
    check_state,
    check_step,
)
from lag_envs.stepping.pendulum import MAX_SUBSTEPS

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene
    from lag_envs.stepping.general import StepBound

Array = NDArray[np.float64]


def simulate(scene: Scene, state: ArrayLike, controls: ArrayLike | int, dt: float) -> Array:
    """See `Scene.simulate`."""
    start, dt = check_state(scene, state), check_step(dt)
    given = check_sequence(scene, controls)
    trajectory = np.empty((len(given) + 1, len(start)))
    trajectory[0] = start
    code, constants = scene._code(dt), scene._constants()
    numbers = [constants[name.removeprefix("k_")] for name in code.constants]
    row = code.simulation(trajectory, given, dt, scene._limit(dt), *numbers)
    if not row and not np.isfinite(trajectory[-1]).all():
        row = int(np.argmin(np.isfinite(trajectory).all(axis=1)))
    if row:
        raise refusal(
            scene,
            trajectory[row - 1],
            given[row - 1],
            dt,
            trajectory[:row],
            f"step {row - 1} of {len(given)}",
        )
    return trajectory


def step_bound(scene: Scene, state: ArrayLike, control: ArrayLike, dt: float) -> StepBound:
    """See `Scene.step_bound`."""
    from lag_envs.stepping.general import StepBound

    start, dt = check_state(scene, state), check_step(dt)
    held = check_controls(scene, control, 1).reshape(-1)
    if scene._form:
        return scene._form.step_bound(start, list(held), dt, scene._constants())
    code, constants = scene._code(dt), scene._constants()
    numbers = [constants[name.removeprefix("k_")] for name in code.constants]
    order = scene._order(dt)
    status, bounds = code.bounded(start.tolist(), held.tolist(), dt, order, numbers)
    if status < 0:
        raise refusal(scene, start, held, dt, None, "the step")
    of = {("place", name): bounds[0][i] for i, name in enumerate(scene._layout.free)}
    of |= {("velocity", name): bounds[1][i] for i, name in enumerate(scene._layout.free)}
    by_state = {e.name: float(of.get((e.kind, e.coordinate), 0.0)) for e in scene._layout.state}
    return StepBound(status, order, by_state, "proved with the step")


def jacobian(scene: Scene, state: ArrayLike, control: ArrayLike, dt: float) -> tuple[Array, Array]:
    """See `Scene.jacobian`."""
    states, controls, shape = check_both(scene, state, control)
    dt = check_step(dt)
    n, m = states.shape[-1], controls.shape[-1]
    count = math.prod(shape)
    states = np.array(np.broadcast_to(states, (*shape, n)), order="C").reshape(count, n)
    controls = np.array(np.broadcast_to(controls, (*shape, m)), order="C").reshape(count, m)
    if scene._form:
        found, refused = scene._form.jacobian(states, controls, scene._constants(), dt)
    else:
        tangent = vars(scene).get("_cached_tangent")
        if tangent is None:
            tangent = scene._stepper.tangent({name: getattr(scene, name) for name in scene._numbers()})
            vars(scene)["_cached_tangent"] = tangent
        found, refused = tangent.jacobian(states, controls, dt, scene._order(dt))
    if refused:
        i = refused - 1
        raise refusal(scene, states[i], controls[i], dt, None, f"the step of row {i}")
    found = found.reshape(*shape, n, n + m)
    return found[..., :n], found[..., n:]


def energy_balance(
    scene: Scene, state: ArrayLike, control: ArrayLike, dt: float, nodes: int
) -> dict[str, float]:
    """See `Scene.energy_balance`."""
    dt = check_step(dt)
    controls = check_controls(scene, control, 1)
    points, weights = np.polynomial.legendre.leggauss(nodes)
    times = 0.5 * dt * (points + 1.0)
    held: Any = controls[None] if scene.control_names else 1
    states = np.array([scene.simulate(state, held, t)[1] for t in [*times, dt]])
    power = scene.power(states[:-1], controls)
    work, loss = (
        float(np.sum(0.5 * dt * weights * value))
        for value in (power["drive"] + power["applied"], power["drag"])
    )
    name = "total" if scene.mechanics.gyroscopic is None else "jacobi"
    change = float(scene.energy(states[-1], controls)[name] - scene.energy(state, controls)[name])
    return {"change": change, "work": work, "loss": loss, "residual": change - work + loss}


def refusal(
    scene: Scene, state: Array, control: ArrayLike, dt: float, trajectory: Array | None, where: str
) -> StepRefused:
    """Return the error for a step that was refused."""
    start = ", ".join(f"{n}={v:g}" for n, v in zip(scene.state_names, state, strict=True))
    held = zip(scene.control_names, np.atleast_1d(np.asarray(control, dtype=np.float64)), strict=True)
    why = "it could not be certified within the largest number of substeps"
    if scene._form is not None:
        why = f"it would need more than {MAX_SUBSTEPS:,} substeps"
    error = StepRefused(
        f"{where} was refused: from ({start}) with "
        f"{', '.join(f'{n}={v:g}' for n, v in held) or 'no control'} and dt={dt:g} s {why}, or has no "
        "finite result; take a smaller dt or milder parameters"
    )
    error.trajectory = None if trajectory is None else trajectory.copy()
    return error
