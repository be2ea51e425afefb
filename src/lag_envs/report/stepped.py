"""A scene in its normal form together with a flow that steps it: the shipped one, or one for comparison."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import form_of, motion_constants_of
from lag_envs.stepping import pendulum
from lag_envs.stepping.compiling import absent_from
from lag_envs.stepping.flow_code import FlowCode
from lag_envs.stepping.flows import Flow


class Stepped:
    """A scene with one control, and a flow.

    Parameters
    ----------
    scene : Scene
        A scene with a normal form.
    flow : Flow, optional
        The flow; by default our own for control steps of `dt`.
    dt : float
        Control step [s].

    Examples
    --------
    >>> from lag_envs.scenes import PivotedBar
    >>> variables, _ = Stepped(PivotedBar(track=None)).at([0.0, 3.0], 0.0)
    >>> [float(x) for x in variables]
    [0.0, 3.0, 1.0, 0.0]
    """

    def __init__(self, scene: Scene, flow: Flow | None = None, dt: float = 0.02) -> None:
        form = form_of(scene)
        if form is None:
            raise ValueError(f"{type(scene).__name__} has no normal form")
        self.scene, self.form = scene, form
        self.flow: Flow = form.flow(dt) if flow is None else flow

    def at(self, state: ArrayLike, u: Any) -> tuple[list, Any]:
        """Return the flow's variables and coefficients at a state under a control."""
        form, k = self.form, SimpleNamespace(**motion_constants_of(self.scene))
        y = form.lift(np.asarray(state, np.float64))
        return form.unpack(y, [u], k), form.coefficients_at(y, [u], k, np)

    def largest_majorant(self, dt: float) -> float:
        """Return the x of the bound up to which one series is certified."""
        return pendulum.largest_majorant(dt, self.flow.order or pendulum.ORDER)

    def code(self) -> FlowCode:
        """Return the code of a step, without the constants that are zero."""
        return FlowCode(self.form, self.flow, absent_from(motion_constants_of(self.scene)))

    def present(self) -> list[float]:
        """Return the constants of the code."""
        return [value for value in motion_constants_of(self.scene).values() if value != 0.0]
