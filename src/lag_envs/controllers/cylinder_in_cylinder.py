"""Controllers of the cylinder that rolls inside a shell."""

from __future__ import annotations

import math

import numpy as np

from lag_envs.controllers.basic import Array, FeedbackController
from lag_envs.controllers.ilqr import ILQR, Opening
from lag_envs.controllers.linear import regulator
from lag_envs.controllers.pd import PD
from lag_envs.tasks.cylinder_in_cylinder import Damping, Pump, Tilt


class ShellPD(PD):
    """Hold a cylinder at an angle by the shell's rate; see `PD`. Defaults are from `agents.tune`."""

    task: Tilt

    def __init__(self, task: Tilt, *, frequency: float = 17.0, lag: float = 0.49) -> None:
        super().__init__(task, frequency=frequency, lag=lag)

    def find_strength(self) -> float:
        """Return the acceleration for each unit of the shell's rate."""
        return self.rest.gamma

    def control(self, state: Array, target: Array) -> Array:
        """Return the shell's acceleration.

        The wanted acceleration is -alpha sin(place) - gamma (speed - the shell's rate).
        """
        wanted = self.wanted(state, target)
        rate = (wanted + self.rest.alpha * np.sin(state[..., 0])) / self.strength + state[..., 1]
        return (rate - state[..., 2]) / self.lag


class TiltLQR(FeedbackController):
    """Hold a cylinder at an angle by a linear-quadratic regulator about the shell rate that holds it there.

    This rate follows from the equation of motion at rest.

    Parameters
    ----------
    task : Tilt
        The task, ``env.unwrapped.task``; its medium must have drag, otherwise no rate holds the cylinder.
    effort : float
        Weight of (u/U)² that is added to the reward's 0.02.
    """

    def __init__(self, task: Tilt, *, effort: float = 0.034) -> None:
        super().__init__(task)
        if task.scene.damping == 0.0:
            raise ValueError("without drag no rate of the shell holds the cylinder, got damping=0 N m s")
        self.gain, _ = regulator(task, [0.0, 0.0, 0.0], extra={"u": effort / task.limit_control**2})
        #: At rest -alpha sinθ + gamma ψ' = 0.
        self.coeffs = task.coefficients([0.0, 0.0, 0.0], [0.0], np)

    def holding_rate(self, theta: Array) -> Array:
        """Return the shell's rate that holds the cylinder at an angle [rad/s]."""
        return self.coeffs.alpha / self.coeffs.gamma * np.sin(theta)

    def control(self, state: Array, target: Array) -> Array:
        """Return the shell's acceleration."""
        wanted = np.stack([target, np.zeros_like(target), self.holding_rate(target)], axis=-1)
        return (wanted - state) @ self.gain


class EnergyPump(FeedbackController):
    """Pump the swing to the wanted energy, and compensate for the drag.

    Per inertia the energy is E = θ'²/2 + ω₀² (1 - cosθ). It changes at the rate θ' (gain u - drag (θ' - ψ')),
    so one value of the control keeps the energy constant, and an addition in the direction of θ' raises it.
    The shell is drawn back to rest.

    Parameters
    ----------
    task : Pump
        The task, ``env.unwrapped.task``.
    pump : float
        Acceleration of the shell per missing share of the energy and per largest rate of the cylinder,
        relative to the largest acceleration.
    centring : float
        Rate at which the shell is drawn back to rest [1/s].
    """

    def __init__(self, task: Pump, *, pump: float = 29.0, centring: float = 2.0) -> None:
        super().__init__(task)
        if task.scene.inertia == 0.0:
            raise ValueError(
                "turning the shell does not push a cylinder without inertia, got inertia=0 kg m²"
            )
        self.pump, self.centring = pump, centring
        coeffs = task.coefficients([0.0, 0.0, 0.0], [1.0], np)
        self.omega0_squared, self.damping_rate, self.gain = coeffs.alpha, coeffs.gamma, coeffs.delta
        self.wanted = task.energies([0.0, 0.0, 0.0], np)[1]

    def control(self, state: Array, target: Array) -> Array:
        """Return the shell's acceleration."""
        theta, theta_dot, psi_dot = np.moveaxis(state, -1, 0)
        energy = 0.5 * theta_dot**2 + self.omega0_squared * (1.0 - np.cos(theta))
        missing = 1.0 - energy / self.wanted
        keeping = self.damping_rate / self.gain * (theta_dot - psi_dot)
        pumping = self.pump * self.task.limit_control * missing * theta_dot / np.sqrt(2.0 * self.wanted)
        return keeping + pumping - self.centring * psi_dot


def plan_pumping(task: Pump, *, opening: float = 0.25) -> ILQR:
    """Return an iLQR that plans the pumping from both directions.

    Planning starts from a softer pump, which leads to better plans.

    Parameters
    ----------
    task : Pump
        The task, ``env.unwrapped.task``.
    opening : float
        Duration of the first push of the shell to either side, in periods of a small swing.
    """
    follow = EnergyPump(task, pump=5.0, centring=0.3)
    steps = round(opening * 2.0 * math.pi / math.sqrt(follow.omega0_squared) / task.dt)
    return ILQR(task, [Opening(side, max(steps, 1), follow) for side in (-1.0, 1.0)])


class BrakingLine(FeedbackController):
    """Brake hard away from the bottom, roll freely towards it, and brake along a line into it.

    Under full brake the cylinder is overdamped: near the bottom it creeps along the slow direction of its
    linearised motion, or rushes along the fast one, θ' = -s θ. So the cylinder rolls freely until it is
    nearly that fast, and is then braked onto this line and kept there.

    Parameters
    ----------
    task : Damping
        The task, ``env.unwrapped.task``.
    steepness : float
        Slope of the line, divided by that of the fast direction.
    sharpness : float
        Change of the brake, relative to the largest, per relative deviation of the speed from the line's.
    """

    def __init__(self, task: Damping, *, steepness: float = 1.0, sharpness: float = 5.5) -> None:
        super().__init__(task)
        # Near the bottom θ'' = a θ + b θ', with b in proportion to the brake.
        (free, full) = (task.scene.linearise([0.0, 0.0], c)[0] for c in (0.0, task.limit_control))
        # If the cylinder swings even under full brake, the real part is the rate of its decay.
        self.slope = steepness * np.abs(np.linalg.eigvals(full).real).max()
        # θ' = -s θ is a solution for b = a/s - s.
        wanted = full[1, 0] / self.slope - self.slope
        self.keeping = (wanted - free[1, 1]) / (full[1, 1] - free[1, 1])
        self.sharpness = sharpness

    def control(self, state: Array, target: Array) -> Array:
        """Return the brake's drag coefficient."""
        theta, theta_dot = np.moveaxis(state, -1, 0)
        speed = np.maximum(np.abs(theta_dot), 1e-9)
        share = self.keeping + self.sharpness * (1.0 - self.slope * np.abs(theta) / speed)
        share = np.where(theta * theta_dot < 0.0, np.clip(share, 0.0, 1.0), 1.0)
        return self.task.limit_control * share
