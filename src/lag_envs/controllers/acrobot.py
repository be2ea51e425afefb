"""Controllers of two links on a pivot."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_continuous_are

from lag_envs.controllers.basic import Array, FeedbackController
from lag_envs.tasks.base import Task


class PublishedLQR(FeedbackController):
    """The double pendulum project's LQR about upright, with the project's weights and the frictionless model.

    The regulator acts while its cost to go is below a threshold; otherwise the motor is off. Friction in the
    driven joint is compensated, as on the project's machine.

    Parameters
    ----------
    task : AcrobotReal or PendubotReal
        The task, ``env.unwrapped.task``.
    weights : sequence of float
        Costs of the squares of both angles, then of both rates.
    effort : float
        Cost of the torque's square.
    most : float
        Largest cost to go at which the regulator acts.
    friction : bool
        Whether friction is compensated.

    References
    ----------
    F. Wiebe et al., github.com/dfki-ric-underactuated-lab/double_pendulum: ``examples/ideal/lqr.py`` and
    ``leaderboard/*/simulation_v1/con_pflcol_lqr.py`` have the weights.
    """

    def __init__(
        self,
        task: Task,
        *,
        weights: Sequence[float],
        effort: float,
        most: float = 15.0,
        friction: bool = True,
    ) -> None:
        super().__init__(task)
        scene = task.scene
        self.joint = ("shoulder", "elbow").index(scene.control)
        left_out = ("damping", "damping_2", "dry_friction", "dry_friction_2", "rotor_inertia")
        ideal = dataclasses.replace(scene, **dict.fromkeys(left_out, 0.0))
        self.rest, self.most = np.array([np.pi, 0.0, 0.0, 0.0]), most
        a, b = ideal.linearise(self.rest, [0.0])
        q = np.diag([weights[0], weights[2], weights[1], weights[3]])
        self.cost = solve_continuous_are(a, b, q, [[effort]])
        self.gain = (b.T @ self.cost)[0] / effort
        end = ("", "_2")[self.joint]
        self.friction = [
            float(friction) * getattr(scene, f"{kind}{end}") for kind in ("damping", "dry_friction")
        ]

    def control(self, state: Array, target: Array) -> Array:
        """Return the torque."""
        off = self.read.difference(state, self.rest)
        cost = np.einsum("...i,ij,...j->...", off, self.cost, off)
        v = state[..., 1 + 2 * self.joint]
        lost = self.friction[0] * v + self.friction[1] * np.arctan(100.0 * v)
        return np.where(cost < self.most, lost - off @ self.gain, 0.0)
