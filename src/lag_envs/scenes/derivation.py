"""What follows from a scene and stays inside the package: its layout, its constants, the code of its steps.

These are functions, not attributes, so that scenes may use any name for a parameter. Results that take long
to compute are kept with the scene, under names with an underscore.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

from lag_envs.mechanics import motion, recording
from lag_envs.mechanics.layout import SceneLayout, make_layout
from lag_envs.mechanics.motion import Mechanics
from lag_envs.mechanics.recording import parameter_names, parameter_values
from lag_envs.scenes.declaring import MAPPINGS, ORDER, SEQUENCES, controls_of

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene
    from lag_envs.stepping.normal_forms import NormalForm


def layout_of(scene: Scene) -> SceneLayout:
    """Return the names of coordinates, controls and state."""
    found = vars(scene).get("_cached_layout")
    if found is None:
        # Properties may branch on structural fields and use them as counts, but not parameters.
        copy, declared = recording.symbolic_twin(scene), {}
        structural = [f.name for f in dataclasses.fields(scene) if "unit" not in f.metadata]  # type: ignore[arg-type]
        for name in (*MAPPINGS, *SEQUENCES):
            with recording.formula(scene, name, structural):
                declared[name] = getattr(copy, name)
        controls, absent = controls_of(scene, declared.pop("modes"), declared.pop("controls"))
        found = make_layout(type(scene).__name__, controls=controls, absent=absent, **declared)
        vars(scene)["_cached_layout"] = found
    return found


def structure_of(scene: Scene) -> tuple:
    """Return everything that decides the code of a step; scenes that share it differ only in numbers."""
    cls, numbers = type(scene), parameter_names(scene)
    # Formulas are compared by identity, because keeping a formula that calls super() would keep its class
    # alive.
    formulas = tuple(id(getattr(cls, name)) for name in ("rests", *recording.ARGUMENTS))
    fields = dataclasses.fields(scene)  # type: ignore[arg-type]
    plain = tuple((f.name, getattr(scene, f.name)) for f in fields if "unit" not in f.metadata)
    zero = tuple(name for name in numbers if getattr(scene, name) == 0.0)
    return formulas, plain, numbers, zero


def mechanics_with(scene: Scene, parameters: tuple[str, ...]) -> Mechanics:
    """Return the equations of motion with these parameters kept in them, even if they are 0."""
    if not set(parameters) & set(scene.mechanics.zeros):
        return scene.mechanics
    known = vars(scene).setdefault("_cached_mechanics_with", {})
    if parameters not in known:
        layout = layout_of(scene)
        known[parameters] = motion.derive_motion(
            scene, layout, recording.record_scene(scene, layout), parameters
        )
    return known[parameters]


def form_of(scene: Scene) -> NormalForm | None:
    """Return the equation of motion's normal form if it has an exact flow of its own, else None."""
    from lag_envs.stepping.normal_forms import normal_form

    return normal_form(scene.mechanics, chosen_order_of(scene))


def chosen_order_of(scene: Scene) -> int:
    """Return the order of the series that the scene's task chose, or 0."""
    return int(vars(scene).get(ORDER, 0))


def motion_constants_of(scene: Scene, lagged: bool = False) -> dict[str, float]:
    """Return the numbers that a step needs, computed from the parameters."""
    kept = "_cached_lagged_constants" if lagged else "_cached_constants"
    found = vars(scene).get(kept)
    if found is None:
        code = _form_or_series(scene, lagged)  # outside, since a FormulaError is a ValueError too
        try:
            found = code.constants(parameter_values(scene))
        except (ArithmeticError, ValueError) as error:  # a division by 0, the root of a negative number, ...
            raise ValueError(undefined(scene)) from error
        if not all(map(math.isfinite, found.values())):
            raise ValueError(undefined(scene))
        vars(scene)[kept] = found
    return found


def undefined(scene: Scene) -> str:
    """Return the message for parameters for which a formula has no value."""
    return (
        f"with these parameters a coefficient of the motion is undefined or not finite: {scene}; "
        "choose other values, and declare the range of the parameters in the class"
    )


def _form_or_series(scene: Scene, lagged: bool) -> Any:
    """Return the normal form of a scene, or its general series; always the series if lagged."""
    if lagged:
        from lag_envs.stepping.lag import lagged_stepper

        return lagged_stepper(scene.mechanics)
    if form := form_of(scene):
        return form
    from lag_envs.stepping.general import stepper_of

    return stepper_of(scene.mechanics)


def order_of(scene: Scene, dt: float, lagged: bool = False) -> int:
    """Return the order of the series for a control step; 0 for a closed form, which is never lagged."""
    form = None if lagged else form_of(scene)
    return form.order(dt) if form else series_order_of(scene, dt)


def series_order_of(scene: Scene, dt: float) -> int:
    """Return the order of the general series for a control step."""
    from lag_envs.stepping.general import usual_order

    return chosen_order_of(scene) or usual_order(dt)


def step_argument_of(scene: Scene, dt: float, lagged: bool = False) -> float:
    """Return the argument of a step besides dt: the largest x of one series, or the order of the series."""
    form = None if lagged else form_of(scene)
    return form.largest_majorant(dt) if form else float(series_order_of(scene, dt))


def code_of(scene: Scene, dt: float, lagged: bool = False) -> Any:
    """Return the code of a control step."""
    from lag_envs.stepping.compiling import absent_from

    absent = absent_from(motion_constants_of(scene, lagged))
    if not lagged and (form := form_of(scene)):
        from lag_envs.stepping.flow_code import flow_code

        return flow_code(form, dt, absent)
    return _form_or_series(scene, lagged).code(absent, order=chosen_order_of(scene))
