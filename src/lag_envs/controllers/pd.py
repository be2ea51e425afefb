"""A proportional-derivative controller with feed-forward from the equation of motion."""

from __future__ import annotations

import numpy as np
import sympy

from lag_envs.controllers.basic import Array, Law
from lag_envs.controllers.linear import equations
from lag_envs.tasks.cylinder_in_cylinder import Tilt as ShellTilt
from lag_envs.tasks.incline import Tilt as InclineTilt

#: Frequency [rad/s] and lag of what is moved [s], as `tune` found them.
TUNED = {InclineTilt: (2.5, 0.07), ShellTilt: (17.0, 0.49)}


class PD(Law):
    """Bring place or angle to its target like a critically damped spring.

    The acceleration ω² (q* - q) - 2ω q' is asked for. What is moved, the tilt of the plane or the rate of the
    shell, has to be at a value that follows from the equation of motion, which is solved for it; the control
    brings it there.

    Parameters
    ----------
    task : lag_envs.tasks.incline.Tilt or lag_envs.tasks.cylinder_in_cylinder.Tilt
        The task, ``env.unwrapped.task``.
    frequency : float, optional
        The spring's ω [rad/s].
    lag : float, optional
        Time in which the control brings what is moved to where it is wanted [s]; at least a step.
    """

    task: InclineTilt | ShellTilt

    def __init__(
        self, task: InclineTilt | ShellTilt, *, frequency: float | None = None, lag: float | None = None
    ) -> None:
        super().__init__(task)
        if type(task) not in TUNED:
            raise ValueError(f"PD is for the tasks with a target to hold, got {type(task).__name__}")
        tuned = TUNED[type(task)]
        self.frequency = tuned[0] if frequency is None else frequency
        self.lag = max(tuned[1] if lag is None else lag, task.dt)
        eqs = equations(task.scene)
        place, speed = eqs.states[:2]
        #: The tilt may be the control itself; else what is moved is the last state.
        self.direct = len(eqs.states) == 2
        moved = eqs.control if self.direct else eqs.states[2]
        wanted = sympy.Symbol("wanted", real=True)
        rate = eqs.rates[1] if self.direct else eqs.rates[1].subs(eqs.control, 0)
        # Where the plane's tilt enters by its sine, that is what is solved for.
        sine = sympy.Symbol("sine", real=True)
        by_sine = rate.has(sympy.sin(moved))
        solution = sympy.solve(
            (rate.subs(sympy.sin(moved), sine) if by_sine else rate) - wanted, sine if by_sine else moved
        )
        if not solution:
            raise ValueError(f"nothing that the control moves accelerates the cylinder: {task.scene}")
        self._solved = sympy.lambdify((wanted, place, speed), solution[0], "numpy")
        self._by_sine = by_sine

    def control(self, state: Array, target: Array) -> Array:
        """Return the control."""
        place, speed = state[..., 0], state[..., 1]
        wanted = self.frequency**2 * (target - place) - 2.0 * self.frequency * speed
        moved = self._solved(wanted, place, speed)
        if self._by_sine:
            assert isinstance(self.task, InclineTilt)
            limit = np.sin(self.task.largest_tilt)
            moved = np.arcsin(np.clip(moved, -limit, limit))
        return moved if self.direct else (moved - state[..., 2]) / self.lag
