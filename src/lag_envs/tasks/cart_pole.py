"""Tasks with a pole on a cart: Gymnasium's, stepped exactly; with a continuous force; and the swing-up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from lag_envs.scenes import CartPole
from lag_envs.scenes.shapes import Bodies, Line, Window, outlines
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.angles import bounds_of_circle, circle
from lag_envs.tasks.base import Task
from lag_envs.tasks.record import Controller, Examples, Goal, Plans

_STATE = {
    "x": ("m", "place of the cart"),
    "x_dot": ("m/s", "its speed"),
    "theta": ("rad", "angle of the pole, 0 upright"),
    "theta_dot": ("rad/s", "its angular velocity"),
}


class _OnTrack(Task):
    """What the tasks share: a cart on a track that ends 2.4 m from its middle."""

    scene: Any = CartPole
    interval, steps = 0.02, 500
    order = 10  # the pole is slow: order 16 takes half as long again, order 8 nearly twice as long
    track = 2.4  # half length [m]

    def bodies(self) -> Bodies:
        """Add the upright pole, and the ends of the track."""
        size = 0.2 * self.scene.half_length
        posts = [Line([(x, -2.0 * size), (x, 2.0 * size)], "limit") for x in (-self.track, self.track)]
        return {"posts": posts, "upright": outlines(self.scene.bodies()["pole"]), **super().bodies()}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add their places."""
        added = {"posts": (0.0, 0.0, 0.0), "upright": (now.q.x, 0.0, 0.0)}
        return {**super().indicators(now, xp), **added}

    def window(self) -> Window:
        """Return a window on the whole track."""
        wide, tall = 1.15 * self.track, 2.4 * self.scene.half_length
        return Window(-wide, -tall, wide, tall)

    def off_track(self, after: Any, xp: Any) -> Any:
        """Return whether the cart has left its track."""
        return xp.abs(after.x) > self.track


class _Balance(_OnTrack):
    """What the tasks share in which the pole stands at first and must not fall."""

    highest = math.radians(12.0)  # [rad]
    examples = Examples(
        start={"state": [0.1, -0.2, 0.05, 0.1]},
        moving=[0.5, 2.0, 0.1, -3.0],
        refused=[{"state": [2.5, 0.0, 0.0, 0.0]}, {"state": [0.0, 0.0, -0.3, 0.0]}],
        ending=([2.39, 2.0, 0.0, 0.0], 1),
        batch={
            "half_length": [0.5, 0.1, 2.0, 0.5, 0.1, 0.5, 2.0],
            "friction": [0.0, 0.1, 5.0, 0.0, 0.1, 0.0, 5.0],
        },
    )

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the cart has left its track, or the pole leans by more than 12 degrees."""
        return self.off_track(after, xp) | (xp.abs(after.theta) > self.highest)


class CartPoleExact(_Balance):
    """Balance a pole on a cart with pushes to the left or right: Gymnasium's CartPole-v1, stepped exactly.

    ## Description

    A pole stands on a cart. Push the cart to either side so that the pole stays up. Spaces, rewards, starts
    and endings are those of Gymnasium's `CartPole-v1`, so a policy trained there runs here unchanged, and
    vice versa.

    One thing differs. Gymnasium steps by explicit Euler, so the position after a step does not depend on the
    push of this step, and energy grows without a physical cause, to several times its initial value within
    ten seconds. Here the motion under the held force is exact. At the end of an episode, values beyond the
    observation space are clipped in the observation, not in the state.

    ## Action Space

    `Discrete(2)`. The force is held for one step.

    ## Observation Space

    Position and angle are bounded by twice the limits at which an episode ends. The speeds have no bound;
    their bounds in the space are infinite, as in Gymnasium.

    ## Rewards

    Each step pays 1, including the last. With another `dt` rewards are scaled by dt/0.02.

    ## Starting State

    The pole stands, nearly at rest. Starts outside the limits below are refused.

    ## Episode End

    Termination: |x| > 2.4 m or |θ| > 12 degrees at a step's end.

    ## Arguments

    The force of a push is fixed. Gymnasium's `length` is `half_length` here.

    ## Equations

    The equations are those of Gymnasium, which solves them for the accelerations.

    ## Signs and Units

    SI units. θ = 0 is upright and positive to the right, x positive to the right.

    ## Numerical Accuracy

    Two integrators of the same equation diverge after a while, so episodes do not agree step by step. The
    returns of a policy do agree.

    ## Known Returns

    No return exceeds 500, and the best policies reach it.

    ## Version History

    - v0: first version.
    """

    id = "CartPoleExact-v0"
    peer = "CartPole-v1"
    quantities = {**_STATE, "force": ("N", "force on the cart")}
    action = {"force": [-10.0, 10.0]}
    start = dict.fromkeys(_STATE, 0.05)
    unbounded = math.inf

    goal = Goal("success: not fallen, and on the track", hold=None, terminated=None)
    controllers = {
        "LQR": Controller(
            "lag_envs.controllers.linear:Regulator",
            {"weights": {"x": 0.1, "x_dot": 0.1, "theta": 10.0, "theta_dot": 0.1}, "effort": 0.01},
        ),
        "beam search": Controller(
            "lag_envs.controllers.beam:beam",
            {
                "weights": {"x": 0.1, "x_dot": 0.1, "theta": 10.0, "theta_dot": 0.1},
                "horizon": 40,
                "width": 50,
                "every": 20,
            },
            plans=True,
        ),
    }
    reference = "LQR"
    hyperparameters = {
        "ppo": {"gamma": 0.99},
        "dqn": {  # the RL Zoo's for Gymnasium's
            "n_timesteps": 5e4, "learning_rate": 2.3e-3, "batch_size": 64, "target_update_interval": 10,
            "train_freq": 16, "gradient_steps": 128, "exploration_fraction": 0.16,
            "exploration_final_eps": 0.04,
        },
    }  # fmt: skip
    difficulty = "The pole falls within a second unless it is caught, and there is no push of strength zero."
    note = (
        "The sign of an LQR's control gives the push; this reaches the largest return. So does the beam "
        "search, which plans less than a second ahead."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return the state; place and angle clipped to the space."""
        ends = self.bounds()
        return {
            name: clip(after[name], -ends[name], ends[name], xp) if name in ends else after[name]
            for name in self.scene.state_names
        }

    def bounds(self) -> Mapping[str, float]:
        """Return the bounds of Gymnasium's space."""
        return {"x": 2.0 * self.track, "theta": 2.0 * self.highest}

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return 1."""
        return 1.0


class CartPoleContinuous(_Balance):
    """Balance a pole on a cart with a continuous force, against kicks, near the middle of the track.

    ## Description

    A pole stands on a cart. Push the cart so that the pole stays up, while random kicks knock it off balance.
    The model is that of Gymnasium's `CartPole-v1`, but the force is continuous.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The force is held for one step.

    ## Observation Space

    The state, each entry divided by its typical range. Inside the limits below, position and angle lie in
    [-1, 1]; the last step may lead beyond these bounds. The speeds have no bound.

    ## Rewards

    Each step pays (1 - (θ/0.21)²/2 - (x/2.4)²/2)(1 - 0.1 a²), evaluated at the end of the step and before a
    kick. Here a is the action, and 0.21 rad are the 12 degrees below. Inside the limits the reward lies
    between 0 and 1, and the effort is a factor, so ending an episode never pays. With another `dt` rewards
    are scaled by dt/0.02.

    ## Starting State

    The pole is nearly upright. Given starts must lie inside the limits below.

    After each step, with probability 0.02 (1 - 0.98^(dt/0.02) for another `dt`), a kick changes θ' by a
    uniform amount within ±1 rad/s.

    ## Episode End

    Termination: |x| > 2.4 m or |θ| > 12 degrees at a step's end. That step pays nothing.

    ## Equations

    Upright and without a force, a deviation of the default pole grows e-fold in 0.25 s.

    ## Signs and Units

    SI units. θ = 0 is upright and positive to the right, x positive to the right.

    ## Known Returns

    No return exceeds 500.

    ## Version History

    - v0: first version.
    """

    id = "CartPoleContinuous-v0"
    quantities = {
        "x/2.4": ("m", "place of the cart, divided by 2.4"),
        "x_dot/2": ("m/s", "its speed, halved"),
        "theta/0.21": ("rad", "angle of the pole, divided by 12 degrees"),
        "theta_dot/2": ("rad/s", "its angular velocity, halved"),
        "force": ("N", "force on the cart"),
    }
    action = {"force": 10.0}
    start = {"x": 1.0, "x_dot": 0.1, "theta": 0.1, "theta_dot": 0.2}
    draws = 2

    goal = Goal(
        "success: not fallen, and on the track", hold=None,
        counted=False,  # protocol 2 began with `terminated=False`; the next one has to begin with None
    )  # fmt: skip
    controllers = {
        "LQR": Controller(
            "lag_envs.controllers.linear:Regulator",
            {"weights": {"x": 0.03, "x_dot": 0.03, "theta": 10.0, "theta_dot": 0.21}, "effort": 5e-4},
            tune={"effort": (1e-4, 1.0)},
        ),
        "MPC": Controller(
            "lag_envs.controllers.mpc:planner",
            {
                "horizon": 50, "every": 2, "guesses": 4, "budget": 5_000,
                "weights": {"x": 3.0, "x_dot": 10.0, "theta": 100.0, "theta_dot": 10.0},
            },
            plans=True,
            real_time={"ahead": 2, "every": 1},
        ),
    }  # fmt: skip
    reference = "LQR"
    hyperparameters = {
        "ppo": {"gamma": 0.98},
        "fast_ppo": {"n_timesteps": 5e6, "gamma": 0.98},
        "off_policy": {"gamma": 0.98},
        # Large noise, kept for long, tips the pole over.
        "td3": {
            "n_timesteps": 5e4, "gradient_steps": 4,
            "policy_kwargs": {"noise_steps": 4, "noise": 0.3},
        },
    }  # fmt: skip
    difficulty = (
        "To move the cart to the middle, the agent must first push it away from the middle, and each kick "
        "hits a pole that is never stable by itself."
    )
    note = (
        "The weights of the LQR have the size of those in the reward; nobody tuned them further. MPC, which "
        "does not foresee the kicks, is no better."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return the scaled state."""
        return {
            "x/2.4": after.x * (1.0 / self.track),
            "x_dot/2": 0.5 * after.x_dot,
            "theta/0.21": after.theta * (1.0 / self.highest),
            "theta_dot/2": 0.5 * after.theta_dot,
        }

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return (1 - (θ/0.21)²/2 - (x/2.4)²/2)(1 - 0.1 a²)."""
        lean, place = after.theta * (1.0 / self.highest), after.x * (1.0 / self.track)
        effort = control.force * 0.1
        return (1.0 - 0.5 * lean * lean - 0.5 * place * place) * (1.0 - 0.1 * effort * effort)

    def last_reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return nothing: outside the limits the formula would fall below 0."""
        return 0.0

    def kick(self, after: Any, draws: Any, xp: Any) -> Mapping[str, Any]:
        """Return a change of the pole's rate within ±1 rad/s."""
        return {"theta_dot": xp.where(draws[0] < self.chance(0.02), 2.0 * draws[1] - 1.0, 0.0)}


class CartPoleSwingUp(_OnTrack):
    """Swing a pole up by pushing its cart, and hold it upright without leaving the track.

    ## Description

    A pole hangs from a cart. Push the cart to and fro to swing the pole up, then keep it upright. The model
    is that of Gymnasium's `CartPole-v1`.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The force is held for one step.

    ## Observation Space

    The speeds have no bound. Until the last step, the position lies in [-1, 1].

    ## Rewards

    Each step pays h² (1 - 0.1 a²). The height h = (1 + cosθ)/2 is 0 hanging and 1 upright, taken at the
    step's end; a is the action. Because of the square, a pole that only spins earns little. The effort is a
    factor, so no step pays less than 0 and leaving the track never pays. With another `dt` rewards are scaled
    by dt/0.02.

    ## Starting State

    The pole hangs, nearly at rest.

    ## Episode End

    Termination: |x| > 2.4 m at a step's end. That step still pays.

    ## Equations

    Force and motion are coupled: the swinging pole acts back on the cart.

    ## Signs and Units

    SI units. θ = 0 is upright and θ = π hangs; θ is positive to the right and not wrapped. x is positive to
    the right.

    ## Known Returns

    The optimum is not known.

    ## Version History

    - v0: first version.
    """

    id = "CartPoleSwingUp-v0"
    quantities = {
        "x/2.4": ("m", "place of the cart, divided by 2.4"),
        "x_dot/4": ("m/s", "speed of the cart, divided by 4"),
        "cos(theta)": ("1", "cosine of the pole's angle, 1 upright"),
        "sin(theta)": ("1", "its sine"),
        "theta_dot/8": ("rad/s", "its angular velocity, divided by 8"),
        "force": ("N", "force on the cart"),
    }
    action = {"force": 10.0}
    start = {"x": 0.2, "x_dot": 0.1, "theta": (math.pi, 0.05), "theta_dot": 0.1}

    goal = Goal(
        "success: within 0.2 rad of upright throughout the last second; time: until it is so for good",
        arrival="upright",
    )
    controllers = {
        "plan + TVLQR": Controller("lag_envs.controllers.tracking:recorded"),
        "energy shaping + LQR": Controller(
            "lag_envs.controllers.energy:PivotEnergyLQR",
            {
                "pivot": "x",
                "angle": "theta",
                "pump": 28.0,
                "centring": 10.0,
                "catch": 31.0,
                "lose": 36.0,
                "weights": {"x": 0.06, "x_dot": 0.046, "theta": 1.0, "theta_dot": 0.0165},
                "effort": 0.013,
            },
            tune={"pump": (1.0, 60.0), "centring": (0.2, 20.0), "catch": (1.0, 60.0), "lose": (10.0, 300.0)},
        ),
        "MPC": Controller(
            "lag_envs.controllers.mpc:planner",
            {
                "horizon": 80,
                "every": 10,
                "iterations": 3,
                "weights": {"x": 3.0, "x_dot": 0.3, "theta": 10.0, "theta_dot": 0.1},
                "good": 2.0,
                "pause": 20,
            },
            plans=True,
            real_time={"ahead": 2, "every": 8},
        ),
    }
    plans = Plans(
        "lag_envs.controllers.swing_up:easier",
        {
            "end": {"x": 3.0, "x_dot": 1.0, "theta": 10.0, "theta_dot": 0.3},
            "effort": 0.02,
            "walls": {"x": 2.4},
        },
        steps=65,
        quick={},
        batch=32,
        iterations=100,
        rest=(0.0, 0.0, 0.0, 0.0),
        weights={"x": 0.1, "x_dot": 0.02, "theta": 1.0, "theta_dot": 0.02},
        effort=0.03,
    )
    hyperparameters = {
        "ppo": {"gamma": 0.99},
        "fast_ppo": {
            "n_timesteps": 1e6,
            "n_epochs": 5,
            "reward_scale": 1.0,
            "episode_share": 1.0,
            "actor": [64, 64],
        },
        # Four updates a step learn to catch the pole; a falling rate keeps it.
        "off_policy": {"gradient_steps": 4, "learning_rate": "lin_2e-3"},
    }
    examples = Examples(
        start={"state": [0.1, -0.2, 2.0, 3.0]},
        refused=[{"state": [2.5, 0.0, 0.0, 0.0]}],
        ending=([2.39, 2.0, 3.0, 0.0], 1.0),
        reach=12.0,
        rest=[0.0, 0.0, 0.0, 0.0],
        batch={
            "half_length": [0.5, 0.1, 2.0, 0.5, 0.1, 0.5, 2.0],
            "friction": [0.0, 0.1, 5.0, 0.0, 0.1, 0.0, 5.0],
        },
    )
    difficulty = "The pole must be pumped and caught, while the cart stays on its track."
    note = (
        "MPC is best. SAC, TQC and TD3 are as good as following a plan with feedback. Energy "
        "shaping, which pumps with the cart's acceleration and hands over to an LQR, is nearly as good."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return x/2.4, x'/4, cosθ, sinθ, θ'/8."""
        return {
            "x/2.4": after.x * (1.0 / self.track),
            "x_dot/4": 0.25 * after.x_dot,
            **circle(after, "theta", xp=xp),
            "theta_dot/8": 0.125 * after.theta_dot,
        }

    def bounds(self) -> Mapping[str, float]:
        """Return bounds of cosine and sine."""
        return bounds_of_circle(self.quantities)

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return h² (1 - 0.1 a²) with the height h = (1 + cosθ)/2."""
        height, effort = 0.5 + 0.5 * xp.cos(after.theta), control.force * 0.1
        return height * height * (1.0 - 0.1 * effort * effort)

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the cart has left its track."""
        return self.off_track(after, xp)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the pole is within 0.2 rad of upright."""
        return xp.cos(after.theta) >= math.cos(0.2)
