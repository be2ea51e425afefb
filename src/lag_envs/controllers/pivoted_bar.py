"""Controllers of the bar on a moving support."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers.basic import Agent, Array, ObservationDecoder, as_actions
from lag_envs.controllers.energy import in_charge
from lag_envs.controllers.ilqr import ILQR, Opening
from lag_envs.controllers.linear import regulator
from lag_envs.tasks.pivoted_bar import SwingUp

#: The upright rest, after the support's place and speed, if those are states.
UPRIGHT = (0.0, 0.0, math.pi, 0.0)

#: Thresholds of the LQR and strength of pumping, with and without a track.
TUNED = {True: (2.5, 1.5), False: (5.8, 3.8)}


class EnergyShapingLQR(Agent):
    """Pump a bar up to the energy of the upright rest, then hold it by a linear-quadratic regulator.

    Far from upright, the support is accelerated in the direction that does work on the bar [1]_, and, on a
    track, softly back to its middle. Near upright the LQR takes over, and it gives up only farther away.
    Distance is measured by the LQR's cost to go, and the thresholds for taking over and giving up differ.

    The default numbers, with and without a track, were found by ``python -m agents.tune``.

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
        holds = in_charge(self.cost_to_go(x), state, episode_start, self.catch, self.lose)
        u = np.where(holds, -from_upright(x) @ self.gain, self.swing(x))
        return as_actions(self.task.formulas.action(u)), holds

    def cost_to_go(self, x: Array) -> Array:
        """Return the LQR's expected loss of reward from given states, near upright."""
        off = from_upright(x)
        return np.einsum("...i,ij,...j->...", off, self.cost, off)

    def swing(self, x: Array) -> Array:
        """Return the support's acceleration [m/s²] that brings the bar's energy to that of the upright rest.

        Per moment of inertia, the energy is E = θ'²/2 - ω₀² cosθ. The control u changes it in proportion to
        -u θ' cosθ.
        """
        theta_dot, cosine = x[..., -1], np.cos(x[..., -2])
        missing = self.omega0_squared - (0.5 * theta_dot * theta_dot - self.omega0_squared * cosine)
        work = np.where(theta_dot * cosine < 0.0, 1.0, -1.0)  # never 0: a bar at rest has to be set in motion
        u = self.pump * missing * work
        if self.task.has_track:
            u -= self.centring * x[..., 0] + 2.0 * math.sqrt(self.centring) * x[..., 1]
        return u


class Estimate(NamedTuple):
    """The memory of `AdaptiveEnergyShapingLQR` for n episodes.

    Attributes
    ----------
    seen : ndarray, shape (n, 4)
        The last observed state.
    applied : ndarray, shape (n,)
        The control [m/s²] that acts from then on.
    under_way : ndarray, shape (n, steps of delay)
        The requested controls that do not act yet, oldest first.
    faded : ndarray, shape (n, 3)
        Sums over the steps with fading weights: of the regressors of q and γ, and of the change of θ'.
    information, weighed : ndarray, shapes (n, 2, 2) and (n, 2)
        Matrix and right side of the least squares for q and γ.
    holds : ndarray of bool, shape (n,)
        Whether the LQR is in charge.
    """

    seen: Array
    applied: Array
    under_way: Array
    faded: Array
    information: Array
    weighed: Array
    holds: NDArray[np.bool_]


class AdaptiveEnergyShapingLQR(Agent):
    """Swing up a bar of unknown length and friction: estimate both while moving, and act on them.

    The bar moves by θ'' = -q (g sinθ + u cosθ) - γ θ', where q = m L/(m L² + I) follows from its length. This
    is linear in both unknowns, so least squares find them: over a step, θ' changes by q and γ times integrals
    of observed quantities. Changes are summed with fading weights, which is exact and reduces the effect of
    noise in single readings. Regulators are designed beforehand for several lengths in the drawn range, and
    interpolated in q. Delayed actions are taken into account: the state is predicted to the time at which the
    next action takes effect.

    Parameters
    ----------
    task : SwingUp
        The task, ``env.unwrapped.task``, with a track and a ``com_distance`` that is drawn.
    catch, lose : float
        Cost to go below which the LQR takes over, and above which it gives up.
    pump : float
        Acceleration of the support per missing energy [(m/s²)/(rad²/s²)].
    centring : float
        Stiffness with which pumping draws the support to the middle of its track [1/s²].
    fade : float
        Factor of a step's weight in the sums after each further step.
    noise : float
        Standard deviation of an observed θ' [rad/s], which sets the weight of the prior range.
    designs : int
        Number of lengths for which regulators are designed.

    Raises
    ------
    ValueError
        If no length is drawn, or actions are not late by a whole number of control steps.
    """

    #: Largest plausible γ [1/s], and the standard deviation of its prior about 0.
    LARGEST_FRICTION, PRIOR_STD = 3.0, 0.3

    def __init__(
        self,
        task: SwingUp,
        *,
        catch: float = 2.0,
        lose: float = 30.0,
        pump: float = 2.5,
        centring: float = 7.0,
        fade: float = 0.9,
        noise: float = 0.1,
        designs: int = 13,
    ) -> None:
        drawn = {d.name: d for d in task.imperfections.drawn} if task.imperfections else {}
        if "com_distance" not in drawn or not task.has_track:
            raise ValueError("this controller is for a bar on a track whose com_distance is drawn")
        late = task.imperfections.action_delay
        if late[0] != late[1] or late[0] % 1.0:
            raise ValueError(f"actions must be late by a whole number of control steps, got {late}")
        self.delay = int(late[0])
        self.task, self.catch, self.lose, self.pump, self.centring = task, catch, lose, pump, centring
        self.fade, self.weight = fade, (1.0 - fade) / noise**2
        lengths = [drawn["com_distance"].at(share) for share in np.linspace(1.0, 0.0, designs)]
        tasks: list[Any] = [task.varied(com_distance=length) for length in lengths]
        rest = [0.0] * len(task.scene.state_names)
        #: q of the designs, ascending, with gains and costs to go.
        self.q = np.array([float(bar.coefficients(rest, [1.0], np).beta) for bar in tasks])
        found = [lqr(bar) for bar in tasks]
        self.gains, self.costs = np.array([k for k, _ in found]), np.array([p for _, p in found])
        self.read, self._k = ObservationDecoder(task), SimpleNamespace(**task.formulas.constants())

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.float32], Estimate]:
        """Return the action for each observation; the state is the estimate so far."""
        seen = self.read(observation)[0]
        x = seen.reshape(-1, seen.shape[-1])
        known = self._begin(x)
        if state is not None:
            start = np.zeros(len(x), np.bool_) if episode_start is None else np.reshape(episode_start, -1)
            learned = self._learn(state, x)
            both = zip(known, learned, strict=True)
            known = Estimate(*(np.where(start.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in both))
        found = np.linalg.solve(known.information, known.weighed[..., None])[..., 0]
        q = np.clip(found[:, 0], self.q[0], self.q[-1])
        friction = np.clip(found[:, 1], 0.0, self.LARGEST_FRICTION)
        # Pending controls act first.
        applied = None
        for i in range(self.delay):
            u = self._guarded(known.under_way[:, i], x)
            applied = u if applied is None else applied
            x = self._step(x, u, q, friction)
        wanted, holds = self._control(x, q, known.holds)
        action = as_actions(self.task.formulas.action(wanted))
        asked = self.task.wanted(action)[:, 0]
        under_way = np.concatenate([known.under_way, asked[:, None]], axis=1)[:, 1:]
        applied = self._guarded(asked, x) if applied is None else applied
        memory = known._replace(applied=applied, under_way=under_way, holds=holds)
        return action.reshape(*seen.shape[:-1], 1), memory

    def _begin(self, x: Array) -> Estimate:
        """Return the estimate before anything has moved."""
        n, middle, half = len(x), 0.5 * (self.q[0] + self.q[-1]), 0.5 * (self.q[-1] - self.q[0])
        sure = np.array([1.0 / half**2, 1.0 / self.PRIOR_STD**2])
        return Estimate(
            x,
            np.zeros(n),
            np.zeros((n, self.delay)),
            np.zeros((n, 3)),
            np.tile(np.diag(sure), (n, 1, 1)),
            np.tile(sure * [middle, 0.0], (n, 1)),
            np.zeros(n, np.bool_),
        )

    def _learn(self, known: Estimate, x: Array) -> Estimate:
        """Return the estimate after the states x have been observed."""
        old, u = known.seen, known.applied
        turned = np.remainder(x[:, 2] - old[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        integral = -0.5 * self.task.dt * (self._tangential(old, u) + self._tangential(x, u))
        faded = self.fade * known.faded + np.stack([integral, -turned, x[:, 3] - old[:, 3]], axis=-1)
        by = faded[:, :2]
        return known._replace(
            seen=x,
            faded=faded,
            information=known.information + self.weight * by[:, :, None] * by[:, None, :],
            weighed=known.weighed + self.weight * by * faded[:, 2:],
        )

    def _tangential(self, x: Array, u: Array) -> Array:
        """Return the tangential part of the field in the support's frame, g sinθ + u cosθ."""
        return self.task.scene.gravity * np.sin(x[:, 2]) + u * np.cos(x[:, 2])

    def _guarded(self, u: Array, x: Array) -> Array:
        """Return the applied control for a requested u."""
        lifted = [*x.T, np.cos(x[:, 2]), np.sin(x[:, 2])]
        return np.asarray(self.task.formulas.guarded(np, [u], lifted, self._k)[0])

    def _step(self, x: Array, u: Array, q: Array, friction: Array) -> Array:
        """Predict a control step by the midpoint rule: the estimates are less accurate than that."""
        dt = self.task.dt

        def slope(y: Array) -> Array:
            return np.stack([y[:, 1], u, y[:, 3], -q * self._tangential(y, u) - friction * y[:, 3]], axis=-1)

        return x + dt * slope(x + 0.5 * dt * slope(x))

    def _control(self, x: Array, q: Array, held: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
        """Return the support's acceleration for states, and whether the LQR gives it."""
        i = np.clip(np.searchsorted(self.q, q) - 1, 0, len(self.q) - 2)
        share = (q - self.q[i]) / (self.q[i + 1] - self.q[i])
        gain = self.gains[i] + share[:, None] * (self.gains[i + 1] - self.gains[i])
        cost = self.costs[i] + share[:, None, None] * (self.costs[i + 1] - self.costs[i])
        off = from_upright(x)
        holds = np.einsum("ni,nij,nj->n", off, cost, off) < np.where(held, self.lose, self.catch)
        field, cosine, rate = q * self.task.scene.gravity, np.cos(x[:, 2]), x[:, 3]
        missing = field - (0.5 * rate * rate - field * cosine)
        swing = self.pump * missing * np.where(rate * cosine < 0.0, 1.0, -1.0)
        swing -= self.centring * x[:, 0] + 2.0 * math.sqrt(self.centring) * x[:, 1]
        return np.where(holds, -np.einsum("ni,ni->n", off, gain), swing), holds


def plan_swing_up(task: SwingUp, *, periods: float = 3.2, opening: float = 0.16) -> ILQR:
    """Return an iLQR that plans the swing-up from both directions, and leaves holding to the LQR.

    Parameters
    ----------
    task : SwingUp
        The task, ``env.unwrapped.task``.
    periods : float
        How far ahead to plan, in periods of a small swing of the hanging bar.
    opening : float
        Duration of the first push of the support to either side, in such periods. Which side is better
        depends on the start, and iLQR cannot change from one to the other.
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
    """Return states relative to upright, with the angle within ±π."""
    off = x.copy()
    off[..., -2] = np.remainder(off[..., -2], 2.0 * math.pi) - math.pi
    return off


def lqr(task: SwingUp) -> tuple[Array, Array]:
    """Return the gain K of u = -K x and P of the cost to go x'Px, near upright.

    There x = (s, s', e, θ') with e = θ - π. A step costs the reward's loss h² - 0.02 (u/U)² to second order,
    e²/2 + 0.02 (u/U)², plus 0.02 (s/S)² for the track, which the reward ignores: otherwise nothing would draw
    the support back.
    """
    extra = {"s": 0.02 / task.length**2} if task.has_track else {}
    return regulator(task, UPRIGHT[-len(task.scene.state_names) :], extra=extra)
