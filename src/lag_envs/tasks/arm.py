"""Reach for a point with an arm of two links, and stay there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from lag_envs.scenes import TwoLinkArm
from lag_envs.scenes.shapes import Bodies, Circle
from lag_envs.tasks.angles import bounds_of_circle, circle
from lag_envs.tasks.base import Task
from lag_envs.tasks.record import Controller, Examples, Goal


class Reach(Task):
    """Bring an arm's hand to a point with torques at shoulder and elbow, and keep it there.

    ## Description

    An arm of two links hangs in a vertical plane. A point in front of it is drawn for each episode. Bring the
    hand there quickly, and hold it still against gravity. The motors are weak: the shoulder's cannot hold the
    arm stretched out level, so often only one of the two postures that reach a point can be held.

    ## Action Space

    `Box(-1, 1, (2,), float32)`. Values outside are clipped. The torques are held for one step.

    ## Observation Space

    Cosine and sine of both angles, the rates, which have no bound, and the point to reach.

    ## Rewards

    Each step pays exp(-d/0.1)(1 - 0.05 (a₁² + a₂²)), with the hand's distance d from the point in metres at
    the step's end and the actions a. Passing through the point pays next to nothing: the hand has to stay at
    the point. With another `dt` rewards are scaled by dt/0.02.

    ## Starting State

    The arm hangs, nearly at rest.

    ## Episode End

    Termination: never.

    ## Equations

    Both links are uniform.

    ## Signs and Units

    SI units. θ₁ is measured from the horizontal, counter-clockwise, so the arm hangs at -π/2; θ₂ = 0 is
    stretched. Neither angle is wrapped. The shoulder is the origin; x points right and y up.

    ## Known Returns

    The optimum is not known; no return exceeds 200.

    ## Version History

    - v0: first version.
    """

    id = "TwoLinkArm-v0"
    quantities = {
        "cos(theta_1)": ("1", "cosine of the upper arm's angle, 1 level to the right"),
        "sin(theta_1)": ("1", "sine of the upper arm's angle, -1 hanging"),
        "cos(theta_2)": ("1", "cosine of the forearm's angle from the upper arm, 1 stretched"),
        "sin(theta_2)": ("1", "its sine"),
        "theta_1_dot/5": ("rad/s", "angular velocity of the upper arm, divided by 5"),
        "theta_2_dot/10": ("rad/s", "angular velocity of the forearm relative to it, divided by 10"),
        "goal_x": ("m", "place of the point to reach, to the right of the shoulder"),
        "goal_y": ("m", "height of the point above the shoulder"),
        "shoulder": ("N m", "torque at the shoulder"),
        "elbow": ("N m", "torque at the elbow"),
    }
    scene: Any = TwoLinkArm
    defaults = {"damping": 0.05}
    interval, steps = 0.02, 200
    action = {"shoulder": 8.0, "elbow": 3.0}
    start = {"theta_1": (-0.5 * math.pi, 0.3), "theta_1_dot": 0.1, "theta_2": 0.3, "theta_2_dot": 0.1}
    target = {"goal_x": ("m", 0.35, 0.15), "goal_y": ("m", 0.45)}

    goal = Goal(
        "success: the hand within 2 cm of the point throughout the last second; time: until it is so for "
        "good",
        arrival="there",
    )
    controllers = {
        "springs": Controller("lag_envs.controllers.arm:Springs"),
        "computed torque": Controller(
            "lag_envs.controllers.arm:ComputedTorque",
            tune={"frequency": (2.0, 40.0), "damping": (0.3, 2.0)},
        ),
        "MPC": Controller(
            "lag_envs.controllers.mpc:planner",
            {"horizon": 50, "every": 5, "iterations": 3, "guesses": 32},
            plans=True,
            real_time={"ahead": 5, "every": 1},
        ),
    }
    reference = "computed torque"
    hyperparameters = {
        "ppo": {"gamma": 0.98},
        "fast_ppo": {
            "n_timesteps": 2e6, "n_steps": 128, "n_epochs": 5, "gamma": 0.98, "max_grad_norm": 0.5,
            "reward_scale": 1.0, "actor": [64, 64],
        },
        "off_policy": {"gamma": 0.98, "n_steps": 4, "gradient_steps": 4, "learning_rate": "lin_2e-3"},
        "td3": {"policy_kwargs": {"noise": 0.3}},
    }  # fmt: skip
    examples = Examples(
        start={"state": [-1.0, 1.0, 0.5, -1.0], "target": [0.4, 0.1]},
        moving=[-1.0, 6.0, 0.5, -9.0],
        rest=[-0.5 * math.pi, 0.0, 0.0, 0.0],
        batch={
            "load": [0.0, 0.2, 1.0, 0.0, 0.2, 0.0, 1.0],
            "gravity": [9.81, 1.6, 0.0, 9.81, 1.6, 9.81, 0.0],
        },
    )
    difficulty = (
        "Torques are limited, the links act on each other, and a posture that cannot be held must be avoided."
    )
    note = (
        "Springs that pull towards the joint angles of the posture sag below them, because gravity pulls "
        "too. The computed torque compensates gravity and the links' coupling, and picks the posture that "
        "costs less to hold. MPC plans on the exact model, and gets more in nearly every episode. Among the "
        "learners the PPO in one file is best, followed by TQC, then by SAC and TD3."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return cosines, sines, scaled rates and the point."""
        return circle(after, "theta_1", "theta_2", xp=xp) | {
            "theta_1_dot/5": 0.2 * after.theta_1_dot,
            "theta_2_dot/10": 0.1 * after.theta_2_dot,
            "goal_x": target.goal_x,
            "goal_y": target.goal_y,
        }

    def bounds(self) -> Mapping[str, float]:
        """Return the bounds of cosines and sines."""
        return bounds_of_circle(self.quantities)

    def off(self, after: Any, target: Any, xp: Any) -> Any:
        """Return the square of the hand's distance from the point [m²]."""
        upper, fore, both = self.scene.length_1, self.scene.length_2, after.theta_1 + after.theta_2
        x = upper * xp.cos(after.theta_1) + fore * xp.cos(both) - target.goal_x
        y = upper * xp.sin(after.theta_1) + fore * xp.sin(both) - target.goal_y
        return x * x + y * y

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-d/0.1)(1 - 0.05 (a₁² + a₂²))."""
        effort = sum((control[name] * (1.0 / most)) ** 2 for name, most in self.action.items())
        return xp.exp(-10.0 * xp.sqrt(self.off(after, target, xp))) * (1.0 - 0.05 * effort)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the hand is within 2 cm of the point."""
        return self.off(after, target, xp) <= 0.02**2

    def bodies(self) -> Bodies:
        """Add the point."""
        size = 0.05 * (self.scene.length_1 + self.scene.length_2)
        return {"point": [Circle((0.0, 0.0), size, "target")], **super().bodies()}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add the place of the point."""
        return {**super().indicators(now, xp), "point": (now.target[0], now.target[1], 0.0)}
