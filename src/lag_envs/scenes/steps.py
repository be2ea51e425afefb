"""Control steps of a scene: the code of its `simulate`, `step_bound`, `jacobian` and `energy_balance`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.mechanics.evaluation import DualArray, DualArrayFunctions, MotionPoint, exactly
from lag_envs.mechanics.recording import parameter_values
from lag_envs.scenes.checks import (
    StepRefused,
    check_applied,
    check_both,
    check_control,
    check_count,
    check_lags,
    check_parameters,
    check_sequence,
    check_state,
    check_step,
    real_array,
)
from lag_envs.scenes.derivation import (
    chosen_order_of,
    code_of,
    form_of,
    layout_of,
    mechanics_with,
    motion_constants_of,
    order_of,
    series_order_of,
    step_argument_of,
)
from lag_envs.scenes.door import ILL_CONDITIONED, SINGULAR, smallest_eigenvalue
from lag_envs.stepping.elementary import LARGEST_ANGLE
from lag_envs.stepping.pendulum import MAX_SUBSTEPS

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene
    from lag_envs.stepping.general import StepBound
    from lag_envs.stepping.tangent import FlowTangent, SeriesTangent

Array = NDArray[np.float64]


def simulate(
    scene: Scene,
    state: ArrayLike,
    controls: ArrayLike | int,
    dt: float,
    lag: float | Mapping[str, float] | None = None,
    applied: ArrayLike | None = None,
) -> Array:
    """See `Scene.simulate`."""
    start, dt = check_state(scene, state), check_step(dt)
    given, n = check_sequence(scene, controls), len(start)
    decays, reached = _lagging(scene, lag, applied, dt)
    lagged, each = decays is not None, given
    if decays is not None:
        start = np.concatenate([start, reached])
        each = np.concatenate([given, np.broadcast_to(decays, given.shape)], axis=1)
    trajectory = np.empty((len(given) + 1, len(start)))
    trajectory[0] = start
    code, argument = code_of(scene, dt, lagged), step_argument_of(scene, dt, lagged)
    row = code.simulation(trajectory, each, dt, argument, *_numbers(scene, code, lagged))
    if not row and not np.isfinite(trajectory[-1]).all():
        row = int(np.argmin(np.isfinite(trajectory).all(axis=1)))
    if lagged:
        trajectory = np.ascontiguousarray(trajectory[:, :n])
    if row:
        raise refusal(
            scene,
            trajectory[row - 1],
            given[row - 1],
            dt,
            trajectory[:row],
            f"step {row - 1} of {len(given)}",
            lagged=lagged,
        )
    return trajectory


def _lagging(scene: Scene, lag: Any, applied: Any, dt: float) -> tuple[Array | None, Array]:
    """Return 1/τ of the controls, or None if none lags, and their starting values."""
    names = scene.control_names
    decays = np.zeros(len(names)) if lag is None else check_lags(names, lag, dt)
    reached = np.zeros(len(names)) if applied is None else check_applied(names, applied, decays)
    return decays if decays.any() else None, reached


def _numbers(scene: Scene, code: Any, lagged: bool) -> list[float]:
    """Return the constants that the step's code takes."""
    constants = motion_constants_of(scene, lagged)
    return [constants[name.removeprefix("k_")] for name in code.constants]


def step_bound(
    scene: Scene,
    state: ArrayLike,
    control: ArrayLike,
    dt: float,
    lag: float | Mapping[str, float] | None = None,
    applied: ArrayLike | None = None,
) -> StepBound:
    """See `Scene.step_bound`."""
    from lag_envs.stepping.general import StepBound

    start, dt = check_state(scene, state), check_step(dt)
    held = check_control(scene, control)
    decays, reached = _lagging(scene, lag, applied, dt)
    lagged = decays is not None
    if not lagged and (form := form_of(scene)):
        return form.step_bound(start, list(held), dt, motion_constants_of(scene))
    code, order = code_of(scene, dt, lagged), order_of(scene, dt, lagged)
    given = held.tolist() if decays is None else [*reached.tolist(), *held.tolist(), *decays.tolist()]
    status, bounds = code.bounded(start.tolist(), given, dt, order, _numbers(scene, code, lagged))
    if status < 0:
        raise refusal(scene, start, held, dt, None, "the step", lagged=lagged)
    layout = layout_of(scene)
    of = {("place", name): bounds[0][i] for i, name in enumerate(layout.free)}
    of |= {("velocity", name): bounds[1][i] for i, name in enumerate(layout.free)}
    if any(e.kind == "momentum" for e in layout.state):
        end = simulate(scene, start, held[None], dt, lag, applied)[-1]
        final = held if decays is None else held + (decays > 0.0) * (reached - held) * np.exp(-decays * dt)
        of |= _momentum_bounds(scene, end, final, *bounds)
    by_state = {e.name: float(of.get((e.kind, e.coordinate), 0.0)) for e in layout.state}
    return StepBound(status, order, by_state, "proved with the step")


def _momentum_bounds(
    scene: Scene, end: Array, control: Array, places: Sequence[float], velocities: Sequence[float]
) -> dict[tuple[str, str], float]:
    """Return bounds on each w = v + k(q) at the end of a step, from those on q and v, to first order."""
    free = layout_of(scene).free
    unit = np.eye(len(free))
    numbers = [
        DualArray(x, unit[free.index(e.coordinate)]) if e.kind == "place" and e.coordinate in free else x
        for e, x in zip(layout_of(scene).state, end, strict=True)
    ]
    point = MotionPoint(
        scene.mechanics, exactly(parameter_values(scene)), numbers, list(control), DualArrayFunctions
    )
    slopes = [k.slope if isinstance(k, DualArray) else np.zeros(len(free)) for k in point.shift]
    return {
        ("momentum", name): v + float(np.abs(slope) @ places)
        for name, v, slope in zip(free, velocities, slopes, strict=True)
    }


def jacobian(
    scene: Scene, state: ArrayLike, control: ArrayLike, dt: float, parameters: Sequence[str] | None = None
) -> tuple[Array, ...]:
    """See `Scene.jacobian`."""
    states, controls, shape = _rows(scene, state, control)
    by = check_parameters(scene, parameters or ())
    found, refused = derivatives_of(scene, by).jacobian(states, controls, check_step(dt))
    n, m = states.shape[1], controls.shape[1]
    _check_refused(scene, states, controls, dt, refused)
    found = found.reshape(*shape, n, n + m + len(by))
    parts = found[..., :n], found[..., n : n + m], found[..., n + m :]
    return parts[:2] if parameters is None else parts


def vjp(
    scene: Scene,
    state: ArrayLike,
    control: ArrayLike,
    dt: float,
    cotangent: ArrayLike,
    parameters: Sequence[str] | None = None,
) -> tuple[Array, ...]:
    """See `Scene.vjp`."""
    states, controls, shape = _rows(scene, state, control)
    by = check_parameters(scene, parameters or ())
    seeds = real_array("cotangent", cotangent)
    n, m = states.shape[1], controls.shape[1]
    if seeds.shape != (*shape, n):
        raise ValueError(
            f"cotangent must have the shape of the state after the step, {(*shape, n)}, got {seeds.shape}"
        )
    if not np.isfinite(seeds).all():
        at = tuple(np.argwhere(~np.isfinite(seeds))[0].tolist())
        raise ValueError(f"cotangent must be finite, got {seeds[at]} at {at}")
    if form_of(scene):
        check_turns(scene, states)
    seeds = seeds.reshape(-1, n)
    found = vjp_of_rows(scene, states, controls, check_step(dt), seeds, by)
    if not np.isfinite(found).all():
        row = int(np.argwhere(~np.isfinite(found))[0, 0])
        raise ValueError(
            f"the gradient of row {row} is not finite: its cotangent {seeds[row].tolist()} is too large; "
            "scale it down"
        )
    found = found.reshape(*shape, n + m + len(by))
    parts = found[..., :n], found[..., n : n + m], found[..., n + m :]
    return parts[:2] if parameters is None else parts


def vjp_of_rows(
    scene: Scene,
    states: Array,
    controls: Array,
    dt: float,
    cotangents: Array,
    by: tuple[str, ...],
    rows: Sequence[int] | None = None,
) -> Array:
    """Return `vjp` for rows of arrays checked by `check_turns` too; errors take row numbers from `rows`.

    Rows are not finite where their cotangents are not, or are too large.
    """
    derivatives = derivatives_of(scene, by)
    found, refused = derivatives.vjp(states, controls, dt, cotangents)
    if not refused and not np.isfinite(found).all():
        (bad,) = np.nonzero(~np.isfinite(found).all(axis=1))
        slopes, step_refused = derivatives.jacobian(states[bad], controls[bad], dt)
        if step_refused:
            refused = int(bad[step_refused - 1]) + 1
        elif not np.isfinite(slopes).all():
            refused = int(bad[np.argwhere(~np.isfinite(slopes))[0, 0]]) + 1
    _check_refused(scene, states, controls, dt, refused, rows)
    return found


def check_turns(scene: Scene, states: Array) -> None:
    """Raise StepRefused where a gradient needs sine and cosine of an angle that is too large for them.

    Steps of scenes with a flow of their own go further than their gradients. The series refuses such steps
    itself.
    """
    for name, unit, column in zip(scene.state_names, scene.state_units, states.T, strict=True):
        # The sum of squares is found quickly, and is nearly always small enough.
        if unit == "rad" and column @ column > LARGEST_ANGLE**2 and np.abs(column).max() > LARGEST_ANGLE:
            i = int(np.argmax(np.abs(column) > LARGEST_ANGLE))
            raise StepRefused(
                f"the gradient of row {i} needs sine and cosine of "
                f"{name}={column[i]:.9g}, which are not computed beyond {LARGEST_ANGLE:g} rad; "
                f"subtract whole turns from {name}"
            )


def _rows(scene: Scene, state: ArrayLike, control: ArrayLike) -> tuple[Array, Array, tuple[int, ...]]:
    """Return states and controls as rows, and the shape that they share."""
    *both, shape = check_both(scene, state, control)
    states, controls = (
        np.array(np.broadcast_to(x, (*shape, x.shape[-1])), order="C").reshape(math.prod(shape), x.shape[-1])
        for x in both
    )
    return states, controls, shape


def _check_refused(
    scene: Scene, states: Array, controls: Array, dt: float, refused: int, rows: Sequence[int] | None = None
) -> None:
    if refused:
        i = refused - 1
        row, held = i if rows is None else rows[i], controls[i][None] if scene.control_names else 1
        try:
            scene.simulate(states[i], held, dt)
        except (StepRefused, ValueError):  # the latter for a control that is not finite, from a guard
            raise refusal(scene, states[i], controls[i], dt, None, f"the step of row {row}") from None
        raise StepRefused(
            f"the step of row {row} can be taken, but its derivatives cannot be computed: they need more "
            "than the largest number of substeps, or are not finite; take a smaller dt"
        )


def derivatives_of(scene: Scene, by: tuple[str, ...]) -> FlowTangent | SeriesTangent:
    """Return the derivatives of steps with respect to states, controls and parameters."""
    known = vars(scene).setdefault("_cached_derivatives", {})
    if by in known:
        return known[by]
    from lag_envs.stepping.general import stepper_of
    from lag_envs.stepping.normal_forms import normal_form
    from lag_envs.stepping.tangent import FlowTangent, SeriesTangent

    motion_constants_of(scene)  # for its errors
    mechanics = mechanics_with(scene, by)
    form, parameters = normal_form(mechanics, chosen_order_of(scene)), parameter_values(scene)
    try:
        known[by] = (
            FlowTangent(form, parameters, by)
            if form
            else SeriesTangent(stepper_of(mechanics), parameters, by, partial(series_order_of, scene))
        )
    except (ArithmeticError, ValueError) as error:
        given = ", ".join(f"{name}={parameters[name]:g}" for name in by)
        raise ValueError(
            f"the motion has no derivative with respect to the parameters at {given}; leave out parameters "
            "that are 0 if a formula divides by them or takes their root"
        ) from error
    return known[by]


def energy_balance(
    scene: Scene, state: ArrayLike, control: ArrayLike, dt: float, nodes: int
) -> dict[str, float]:
    """See `Scene.energy_balance`."""
    dt = check_step(dt)
    controls = check_control(scene, control)
    points, weights = np.polynomial.legendre.leggauss(check_count("nodes", nodes))
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
    scene: Scene,
    state: Array,
    control: ArrayLike,
    dt: float,
    trajectory: Array | None,
    where: str,
    lagged: bool = False,
) -> StepRefused:
    """Return the error for a refused step."""
    start = ", ".join(f"{n}={v:g}" for n, v in zip(scene.state_names, state, strict=True))
    values = np.atleast_1d(np.asarray(control, dtype=np.float64))
    held = zip(scene.control_names, values, strict=True)
    why = "the step could not be certified within the largest number of substeps, or has no finite result"
    remedy = "take a smaller dt or milder parameters, or, near a singular configuration, other coordinates"
    if not np.isfinite(state).all():
        why, remedy = "the state is not finite", "reset the episode; if the task has a kick, check the kick"
    elif not np.isfinite(values).all():
        why, remedy = "the control is not finite", "if the task has a guard, check the guard"
    elif form_of(scene) is not None and not lagged:
        why = f"the step would need more than {MAX_SUBSTEPS:,} substeps, or has no finite result"
        remedy = "take a smaller dt or milder parameters"
    elif far := _far_angles(scene, state, values):
        why = f"the step needs sine and cosine of {far}, which are not computed beyond {LARGEST_ANGLE:g} rad"
        remedy = f"subtract whole turns from {far}"
    elif singular := _singular(scene, state, values):
        why, remedy = singular, "choose other coordinates, or end or reset the episode before that state"
    elif smallest_eigenvalue(scene.mass_matrix(state, values)) < ILL_CONDITIONED:
        remedy = (
            "take a smaller dt, milder parameters, or coordinates that depend less on each other: at this "
            "state the mass matrix is nearly singular"
        )
    error = StepRefused(
        f"{where} was refused: from ({start}) with "
        f"{', '.join(f'{n}={v:g}' for n, v in held) or 'no control'} and dt={dt:g} s, {why}; {remedy}"
    )
    error.trajectory = None if trajectory is None else trajectory.copy()
    return error


def _singular(scene: Scene, state: Array, control: Array) -> str:
    """Return the reason why there is no motion from a state, or an empty text."""
    mass = scene.mass_matrix(state, control)
    if np.isfinite(mass).all() and smallest_eigenvalue(mass) < SINGULAR:
        return f"the mass matrix of {', '.join(layout_of(scene).free)} is not positive definite there"
    finite = np.isfinite(mass).all() and np.isfinite([*scene.acceleration(state, control).values()]).all()
    return "" if finite else "the acceleration there is not finite"


def _far_angles(scene: Scene, state: Array, control: Array) -> str:
    """Return the names of angles too large for the general series."""
    names, units = scene.state_names + scene.control_names, scene.state_units + scene.control_units
    given = zip(names, units, (*state, *control), strict=True)
    return " and ".join(n for n, unit, value in given if unit == "rad" and abs(value) > LARGEST_ANGLE)
