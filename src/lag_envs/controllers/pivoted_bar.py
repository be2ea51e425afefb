"""Controllers of the bar on a moving support."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import Array, ObservationDecoder, as_actions
from lag_envs.controllers.ilqr import ILQR, Opening
from lag_envs.controllers.linear import regulator
from lag_envs.tasks.pivoted_bar import SwingUp

#: What upright is, behind the support's place and speed, if those are states.
UPRIGHT = (0.0, 0.0, math.pi, 0.0)

#: Where the LQR takes over, and strength of pumping, with a track and without.
TUNED = {True: (2.5, 1.5), False: (5.8, 3.8)}


class EnergyShapingLQR:
    """Pump a bar up to the energy of the upright rest, then hold it by a linear-quadratic regulator.

    Far from upright the support is accelerated in the direction in which it does work on the bar [1]_, and,
    on a track, softly back to its middle. Near upright the LQR takes over, and hands back only when out of
    its depth: nearness is the LQR's own cost to go, and the two thresholds differ.

    The numbers are what ``python -m agents.tune`` found, with a track and without.

    Parameters
    ----------
    task : SwingUp
        The task with its parameters, ``env.unwrapped.task``; with or without track.
    catch, lose : float, optional
        Cost to go below which the LQR takes over, and above which it gives up.
    pump : float, optional
        Acceleration of the support per missing energy [(m/s²)/(rad²/s²)].
    centring : float
        Stiffness with which pumping draws the support to the middle of its track [1/s²].

    References
    ----------
    .. [1] K. J. Åström and K. Furuta, "Swinging up a pendulum by energy control", Automatica 36 (2000),
       287-295.
    """

    def __init__(
        self,
        task: SwingUp,
        *,
        catch: float | None = None,
        lose: float = 30.0,
        pump: float | None = None,
        centring: float = 5.0,
    ) -> None:
        self.task, self.scene = task, task.scene
        tuned = TUNED[task.has_track]
        self.catch = tuned[0] if catch is None else catch
        self.pump = tuned[1] if pump is None else pump
        self.lose, self.centring = lose, centring
        self.gain, self.cost = lqr(task)
        self.omega0_squared = task.coefficients([0.0] * len(self.scene.state_names), [0.0], np).alpha
        self.read = ObservationDecoder(task)

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the action for each observation; the state tells where the LQR is in charge."""
        x, _ = self.read(observation)
        holds = np.zeros(x.shape[:-1], np.bool_) if state is None else np.array(state, np.bool_)
        if episode_start is not None:
            holds &= ~np.asarray(episode_start, np.bool_).reshape(holds.shape)
        cost = self.cost_to_go(x)
        holds = cost < np.where(holds, self.lose, self.catch)
        u = np.where(holds, -from_upright(x) @ self.gain, self.swing(x))
        return as_actions(self.task.formulas.action(u)), holds

    def cost_to_go(self, x: Array) -> Array:
        """Return what the LQR expects to lose of the reward from states on, near upright."""
        off = from_upright(x)
        return np.einsum("...i,ij,...j->...", off, self.cost, off)

    def swing(self, x: Array) -> Array:
        """Return the support's acceleration [m/s²] that brings the bar's energy to that of the upright rest.

        Per moment of inertia the energy is E = θ'²/2 - ω₀² cosθ, and u changes it in proportion to
        -u θ' cosθ.
        """
        theta_dot, cosine = x[..., -1], np.cos(x[..., -2])
        missing = self.omega0_squared - (0.5 * theta_dot * theta_dot - self.omega0_squared * cosine)
        work = np.where(theta_dot * cosine < 0.0, 1.0, -1.0)  # never 0: a bar at rest must be set going
        u = self.pump * missing * work
        if self.task.has_track:
            u -= self.centring * x[..., 0] + 2.0 * math.sqrt(self.centring) * x[..., 1]
        return u


def plan_swing_up(task: SwingUp, *, periods: float = 3.2, opening: float = 0.16) -> ILQR:
    """Return an iLQR that plans the swing-up from two sides, and leaves the hold to the LQR.

    Parameters
    ----------
    task : SwingUp
        The task, ``env.unwrapped.task``.
    periods : float
        How far ahead to plan, in periods of a small swing of the hanging bar.
    opening : float
        For how many of them the support is first pushed to one side or the other. Which one is better
        depends on the start, and iLQR does not get from one to the other.
    """
    follow = EnergyShapingLQR(task)
    steps = 2.0 * math.pi / math.sqrt(max(follow.omega0_squared, 1.0)) / task.dt
    return ILQR(
        task,
        [Opening(side, max(round(opening * steps), 1), follow) for side in (-1.0, 1.0)],
        after=follow,
        tail=follow.cost_to_go,
        steps=max(round(periods * steps), 1),
    )


def from_upright(x: Array) -> Array:
    """Return states relative to upright, the angle within ±π."""
    off = x.copy()
    off[..., -2] = np.remainder(off[..., -2], 2.0 * math.pi) - math.pi
    return off


def lqr(task: SwingUp) -> tuple[Array, Array]:
    """Return the gain K of u = -K x and P of the cost to go x'Px, near upright.

    There x = (s, s', e, θ') with e = θ - π. A step costs what the reward h² - 0.02 (u/U)² loses there to
    second order, e²/2 + 0.02 (u/U)², and for the track, which the reward does not mind, 0.02 (s/S)²: else
    nothing would call the support back.
    """
    extra = {"s": 0.02 / task.length**2} if task.has_track else {}
    return regulator(task, UPRIGHT[-len(task.scene.state_names) :], extra=extra)
