"""Tasks with a rod on a hinge: Gymnasium's, stepped exactly, and one whose optimum is known."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from lag_envs.scenes import Pendulum
from lag_envs.scenes.shapes import Bodies, outlines
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.angles import bounds_of_circle, circle
from lag_envs.tasks.base import FASTEST_START, Task
from lag_envs.tasks.record import Axis, Controller, Examples, Goal, Optimum, ValueIteration


def wrapped(cosine: Any, sine: Any, xp: Any) -> Any:
    """Return the angle in [-π, π] with this cosine and sine."""
    steep = xp.abs(sine) > xp.abs(cosine)
    slope = xp.atan(xp.where(steep, cosine, sine) / xp.where(steep, sine, cosine))
    quarter = xp.where(sine < 0.0, -0.5 * math.pi, 0.5 * math.pi)
    return xp.where(steep, quarter - slope, slope + xp.where(cosine < 0.0, 2.0 * quarter, 0.0))


class _Rod(Task):
    """What the tasks share: a rod that a weak torque is to swing up."""

    scene: Any = Pendulum
    interval, steps = 0.05, 200
    action = {"torque": 2.0}
    examples = Examples(start={"state": [2.0, 3.0]}, moving=[2.0, 12.0], reach=12.0, rest=[0.0, 0.0])
    direction = {
        "cos(theta)": ("1", "cosine of the rod's angle, 1 upright"),
        "sin(theta)": ("1", "its sine"),
    }
    goal = Goal(
        "success: within 0.1 rad of upright throughout the last second; time: until it is so for good",
        arrival="upright",
    )

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the rod is within 0.1 rad of upright."""
        return xp.cos(after.theta) >= math.cos(0.1)

    def bodies(self) -> Bodies:
        """Add the upright rod."""
        return {"upright": outlines(self.scene.bodies()["rod"]), **super().bodies()}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add the place of the upright rod."""
        return {**super().indicators(now, xp), "upright": (0.0, 0.0, 0.0)}


class PendulumExact(_Rod):
    """Swing a rod up with a weak torque and hold it: Gymnasium's Pendulum-v1, stepped exactly.

    ## Description

    A uniform rod hangs from a motor that is too weak to lift it in one go. Spaces, rewards, starts and the
    length of an episode are those of Gymnasium's `Pendulum-v1`, so a policy trained there runs here
    unchanged, and vice versa.

    Two things differ. First, Gymnasium steps by semi-implicit Euler, so within a swing the energy of the
    undriven rod is off by several per cent. Here the motion under the held torque is exact. Second, Gymnasium
    clips the rod's speed at 8 rad/s, which removes energy without a physical cause. Here the speed is free,
    and only its *observation* is clipped, to the same 8 rad/s that the space allows. Random actions often
    exceed that speed. The reward uses the true speed.

    ## Action Space

    The torque in N m, `Box(-2, 2, (1,), float32)`, as in Gymnasium and unlike the package's own environments,
    whose actions lie in [-1, 1]. Values outside are clipped. The torque is held for one step.

    ## Observation Space

    The angle's cosine and sine, and the speed, clipped at 8 rad/s.

    ## Rewards

    Each step pays -(θ² + 0.1 θ'² + 0.001 u²), with θ in [-π, π] and the speed as they were *before* the step,
    as in Gymnasium. With another `dt` rewards are scaled by dt/0.05.

    ## Starting State

    Any angle, and a small speed.

    ## Episode End

    Termination: never.

    ## Arguments

    Gymnasium's `g` is `gravity` here.

    ## Equations

    The equation is the same as Gymnasium's, θ'' = 3g/(2l) sinθ + 3/(m l²) u.

    ## Signs and Units

    SI units. θ = 0 is upright; θ grows counter-clockwise and is not wrapped in the state.

    ## Numerical Accuracy

    Two integrators of the same equation diverge after a while, so episodes do not agree step by step. The
    returns of a policy do agree.

    ## Known Returns

    The optimum is not known. docs/agents.md has the estimate of value iteration.

    ## Version History

    - v0: first version.
    """

    id = "PendulumExact-v0"
    peer = "Pendulum-v1"
    order = 20  # random torques turn the rod fast: with order 16, six steps in a hundred are divided
    quantities = {
        **_Rod.direction,
        "theta_dot": ("rad/s", "angular velocity, clipped at 8"),
        "torque": ("N m", "torque at the pivot"),
    }
    defaults = {"gravity": 10.0}
    largest_action = 2.0
    start = {"theta": math.pi, "theta_dot": 1.0}
    fastest_seen = 8.0  # [rad/s]

    controllers = {
        "energy shaping + LQR": Controller("lag_envs.controllers.pendulum:PendulumEnergyLQR"),
        "MPC": Controller(
            "lag_envs.controllers.mpc:planner",
            {"horizon": 40, "iterations": 3, "guesses": 32},
            plans=True,
        ),
    }
    reference = "energy shaping + LQR"
    value_iteration = ValueIteration(
        (
            Axis("θ [rad]", 0.0, 2.0 * math.pi, 80, periodic=True, level=4),
            Axis("θ' [rad/s]", -12.0, 12.0, 80, level=4),
        ),
        mirror="theta",
        most=0.0,
    )
    hyperparameters = {
        "ppo": {"gamma": 0.95},
        "fast_ppo": {
            "n_timesteps": 2e6, "batch_size": 1024, "gamma": 0.97, "gae_lambda": 0.98, "clip_range": 0.1,
            "noise_steps": 1, "log_std_init": -0.5, "actor": [64, 64], "first_layer_scale": 3.0,
        },
        "off_policy": {"gamma": 0.98, "n_timesteps": 6e4},
    }  # fmt: skip
    examples = dataclasses.replace(
        _Rod.examples,
        batch={
            "length": [1.0, 0.1, 5.0, 1.0, 0.1, 1.0, 5.0],
            "damping": [0.0, 0.1, 10.0, 0.0, 0.1, 0.0, 10.0],
        },
    )
    difficulty = (
        "The motor can hold the rod only within some 24 degrees of upright, so energy must be pumped in "
        "first."
    )
    note = (
        "The greedy policy of value iteration is best. Energy shaping, which hands over to an LQR near "
        "upright, takes as many swings, but arrives later: its torque fades as the energy gets near that of "
        "upright. Among the learners the PPO in one file is best, and the others are about as good as energy "
        "shaping; MPC is too."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return cosθ, sinθ and the clipped θ'."""
        top = self.fastest_seen
        return circle(after, "theta", xp=xp) | {"theta_dot": clip(after.theta_dot, -top, top, xp)}

    def bounds(self) -> Mapping[str, float]:
        """Return the bounds of Gymnasium's space."""
        return bounds_of_circle(self.direction) | {"theta_dot": self.fastest_seen}

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return -(θ² + 0.1 θ'² + 0.001 u²) with the state before the step."""
        angle = wrapped(xp.cos(before.theta), xp.sin(before.theta), xp)
        return -(angle * angle + 0.1 * before.theta_dot**2 + 0.001 * control.torque**2)


class PendulumRegret(_Rod):
    """Swing a rod up with a weak torque in a task whose optimal policy and value are known exactly.

    ## Description

    A uniform rod hangs from a motor that is too weak to lift it in one go. Swing it up and hold it. The
    reward is special: it is constructed backwards, from a value function and a policy that were chosen first
    (converse optimality [1]_), on the exact motion of the step. Therefore the regret of any policy is known
    to rounding, and there is no "best known" return that could be beaten.

    .. [1] J. C. Doyle, J. A. Primbs, B. Shapiro and V. Nevistić, "Nonlinear games: examples and
       counterexamples", IEEE Conference on Decision and Control (1996), 3915-3920.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The torque is held for one step.

    ## Observation Space

    The angle's cosine and sine, and the speed, divided by 8. The speed's bound is proved: it is the largest
    speed that torque and weight can add within an episode. Friction only reduces the speed.

    ## Rewards

    Let V be the potential energy that the rod lacks to be upright, plus its kinetic energy, as a share of the
    potential energy between hanging and upright, times 100. Let π be a control law: far from upright, a
    torque that pumps the energy to that of the upright equilibrium; near upright, a damped spring. Each step
    pays

    V(before) - V(after) - 0.2 ((u - π(before))/U)².

    The sum over an episode is V(start) - V(end) - 0.2 Σ((u - π)/U)². Because V is nowhere negative, no policy
    gets more than V(start). The law π gets V(start) - V(end), and brings V close to 0.

    The task is still not trivial. An agent does not observe the law. Pumping raises V at first, and the
    penalty is small compared with this rise, so a policy that maximises the next reward brakes the rod and
    keeps it hanging. With another `dt`, V's share of the reward is not scaled, so the bound remains valid.

    ## Starting State

    The rod hangs, nearly at rest.

    ## Episode End

    Termination: never.

    ## Arguments

    The law is computed from the parameters. If they make the motor too weak for it, V(start) is still a
    bound.

    ## Equations

    J θ'' = w sinθ + u, with J = m l²/3 and w = m g l/2.

    ## Signs and Units

    SI units. θ = 0 is upright; θ grows counter-clockwise and is not wrapped.

    ## Numerical Accuracy

    The sum telescopes on the states that the steps return, so the identity holds to rounding.

    ## Known Returns

    The optimum lies between V(start) - V(end) of π and V(start).

    ## Version History

    - v0: first version.
    """

    id = "PendulumRegret-v0"
    quantities = {
        **_Rod.direction,
        "theta_dot/8": ("rad/s", "angular velocity, divided by 8"),
        "torque": ("N m", "torque at the pivot"),
    }
    scaled = False
    start = {"theta": (math.pi, 0.2), "theta_dot": 0.2}
    penalty = 0.2

    optimum = Optimum(
        "lag_envs.controllers.pendulum:value_at_start",
        "pump the energy up, then act as a damped spring; V(start), which nobody exceeds",
    )
    controllers = {
        "optimal law": Controller("lag_envs.controllers.pendulum:OwnLaw"),
        "energy shaping + LQR": Controller("lag_envs.controllers.pendulum:PendulumEnergyLQR"),
        "MPC": Controller(
            "lag_envs.controllers.mpc:planner",
            {"horizon": 60, "every": 2, "guesses": 32, "weights": {"theta": 5.0, "theta_dot": 0.5}},
            plans=True,
        ),
    }
    reference = "energy shaping + LQR"
    hyperparameters = {
        "ppo": {"gamma": 0.999},
        "fast_ppo": {
            "n_timesteps": 3e6, "n_envs": 128, "n_steps": 64, "n_epochs": 5, "gamma": 0.995,
            "gae_lambda": 0.98, "ent_coef": 3e-3, "reward_scale": 0.03, "state_noise": False,
            "log_std_init": 0.5, "critic": [128, 128],
        },
        "off_policy": {"n_timesteps": 8e4, "learning_rate": "lin_2e-3"},
    }  # fmt: skip
    examples = dataclasses.replace(
        _Rod.examples,
        batch={
            "length": [1.0, 0.5, 2.0, 1.0, 0.5, 1.0, 2.0],
            "damping": [0.0, 0.01, 0.1, 0.0, 0.01, 0.0, 0.1],
        },
    )
    difficulty = (
        "The reward of a single step misleads: it pays for height that is lost again, and pumping costs at "
        "first."
    )
    note = (
        "The optimal law loses only V at the end, which shows how far the rod is from upright. A good "
        "swing-up of another kind is penalised for each torque that differs."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return cosθ, sinθ, θ'/8."""
        return circle(after, "theta", xp=xp) | {"theta_dot/8": 0.125 * after.theta_dot}

    def bounds(self) -> Mapping[str, float]:
        """Return bounds on the observation: the speed's is start + (w + U)/J · length."""
        inertia, weight = self._numbers()
        fastest = FASTEST_START + (weight + self.action["torque"]) / inertia * self.duration
        return bounds_of_circle(self.direction) | {"theta_dot/8": 0.125 * fastest}

    def value(self, state: Any, xp: Any) -> Any:
        """Return V: 100 (w (1 - cosθ) + J θ'²/2)/(2w)."""
        inertia, weight = self._numbers()
        lacking = weight * (1.0 - xp.cos(state.theta)) + 0.5 * inertia * state.theta_dot**2
        return 50.0 * lacking / weight

    def law(self, state: Any, xp: Any) -> Any:
        """Return the optimal torque π [N m]."""
        inertia, weight = self._numbers()
        top = self.action["torque"]
        spring = -3.0 * weight * xp.sin(state.theta) - 3.0 * xp.sqrt(weight * inertia) * state.theta_dot
        missing = weight * (1.0 - xp.cos(state.theta)) - 0.5 * inertia * state.theta_dot**2
        pump = xp.where(state.theta_dot < 0.0, -1.0, 1.0) * (5.0 * top) * (missing / weight)
        near = (xp.cos(state.theta) > 0.9) & (xp.abs(spring) < top)
        return xp.where(near, spring, clip(pump, -top, top, xp))

    def _numbers(self) -> tuple[Any, Any]:
        """Return the rod's inertia J and the torque w of its weight."""
        rod = self.scene
        return rod.mass * rod.length**2 / 3.0, 0.5 * rod.mass * rod.gravity * rod.length

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return V(before) - V(after) - 0.2 ((u - π(before))/U)²."""
        off = (control.torque - self.law(before, xp)) * (1.0 / self.action["torque"])
        return self.value(before, xp) - self.value(after, xp) - self.penalty * off * off
