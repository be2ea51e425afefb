"""Classical controllers and two agents that know nothing, all with Stable-Baselines3's `predict`.

Every agent takes one observation or a batch, and hands back what it has to remember until the next call::

    action, state = agent.predict(observation, state, episode_start)
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from lag_envs.scenes import PivotedBar
from lag_envs.tasks.pivoted_bar import SwingUp


class Constant:
    """Always the same action.

    Parameters
    ----------
    action : float
        The action in [-1, 1].
    """

    def __init__(self, action: float) -> None:
        self.action = action

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action, for each observation."""
        return np.full((*observation.shape[:-1], 1), self.action, np.float32), state


def do_nothing(env: gym.Env) -> Constant:
    """Return the agent of zero control: where the control is a damping, its action is -1."""
    return Constant(-1.0 if getattr(env.unwrapped.scene, "control", None) == "damping" else 0.0)


class Random:
    """Uniformly random actions.

    Parameters
    ----------
    seed : int
        Seed of the actions.
    """

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float32], Any]:
        """Return an action for each observation."""
        return self.rng.uniform(-1.0, 1.0, (*observation.shape[:-1], 1)).astype(np.float32), state


class EnergyShapingLQR:
    """Pump a bar up to the energy of the upright rest, then hold it by a linear-quadratic regulator.

    Far from upright the support is accelerated in the direction in which it does work on the bar [1]_, and
    softly back to the middle of the track. Near upright the LQR takes over, and hands back only when out of
    its depth: nearness is the LQR's own cost to go, and the two thresholds differ.

    Parameters
    ----------
    task : SwingUp
        The task with its parameters, ``env.unwrapped.task``; it must have a track.
    catch, lose : float
        Cost to go below which the LQR takes over, and above which it gives up.
    pump : float
        Acceleration of the support per missing energy [(m/s²)/(rad²/s²)].
    centring : float
        Stiffness with which pumping draws the support to the middle [1/s²].

    References
    ----------
    .. [1] K. J. Åström and K. Furuta, "Swinging up a pendulum by energy control", Automatica 36 (2000),
       287-295.
    """

    def __init__(
        self,
        task: SwingUp,
        *,
        catch: float = 2.5,
        lose: float = 30.0,
        pump: float = 1.5,
        centring: float = 5.0,
    ) -> None:
        if not task.has_track or math.isinf(task.scene.track):
            raise ValueError(f"the controller needs a track of finite length, got track={task.scene.track}")
        self.task, self.scene = task, task.scene
        self.catch, self.lose, self.pump, self.centring = catch, lose, pump, centring
        self.gain, self.cost = lqr(task)
        constants = self.scene.constants()
        self.weight, self.pull = constants["weight"], constants["pull"]

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the action for each observation; the state tells where the LQR is in charge."""
        place, speed, cosine, sine, turn = np.moveaxis(np.asarray(observation, np.float64), -1, 0)
        s, s_dot, theta_dot = self.scene.track * place, 2.0 * speed, 8.0 * turn
        holds = np.zeros(s.shape, np.bool_) if state is None else np.array(state, np.bool_)
        if episode_start is not None:
            holds &= ~np.asarray(episode_start, np.bool_).reshape(holds.shape)
        x = np.stack([s, s_dot, np.arctan2(-sine, -cosine), theta_dot], axis=-1)
        cost = np.einsum("...i,ij,...j->...", x, self.cost, x)
        holds = cost < np.where(holds, self.lose, self.catch)
        u = np.where(holds, -x @ self.gain, self.swing(s, s_dot, cosine, theta_dot))
        return np.clip(u / self.task.limit_control, -1.0, 1.0)[..., None].astype(np.float32), holds

    def swing(self, s: Any, s_dot: Any, cosine: Any, theta_dot: Any) -> Any:
        """Return the support's acceleration [m/s²] that brings the bar's energy to that of the upright rest.

        Per moment of inertia the energy is E = θ'²/2 - weight·cosθ, and u changes it by -pull·u·θ'·cosθ.
        """
        missing = self.weight - (0.5 * theta_dot * theta_dot - self.weight * cosine)
        work = np.where(theta_dot * cosine < 0.0, 1.0, -1.0)  # never 0: a bar at rest must be set going
        return self.pump * missing * work - self.centring * s - 2.0 * math.sqrt(self.centring) * s_dot


def linearised(scene: PivotedBar) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return A and B of x' = A x + B s'' near upright, for x = (s, s', θ - π, θ'), from the Lagrangian."""
    import sympy

    from lag_envs.lagrange import acceleration, coordinates, t

    q, v = coordinates(scene)
    theta, omega, u = sympy.symbols("theta omega u")
    values = {
        sympy.Symbol(n, positive=True): getattr(scene, n)
        for n in ("mass", "com_distance", "inertia", "damping", "gravity")
    }
    formula = (
        acceleration(scene)
        .subs({q.s.diff(t, 2): u})
        .subs({v.theta: omega})
        .subs({q.theta: theta})
        .subs(values)
    )
    upright = {theta: sympy.pi, omega: 0, u: 0}
    slope = [float(formula.diff(x).subs(upright)) for x in (theta, omega, u)]
    a = np.array([[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, slope[0], slope[1]]], np.float64)
    return a, np.array([0.0, 1.0, 0.0, slope[2]])


def lqr(task: SwingUp) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the gain K of u = -K x and P of the cost to go x'Px, near upright.

    There x = (s, s', e, θ') with e = θ - π. A step costs what the reward h² - 0.02 (u/U)² loses there to
    second order, e²/2 + 0.02 (u/U)², and for the track, which the reward does not mind, 0.02 (s/S)²: else
    nothing would call the support back.
    """
    a, b = linearised(task.scene)
    # The control is held over a step: the exact discretisation is a matrix exponential.
    held = expm(task.dt * np.block([[a, b[:, None]], [np.zeros((1, 5))]]))
    a, b = held[:4, :4], held[:4, 4:]
    q = np.diag([0.02 / task.scene.track**2, 0.0, 0.5, 0.0])
    r = np.array([[0.02 / task.limit_control**2]])
    p = solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)[0], p
