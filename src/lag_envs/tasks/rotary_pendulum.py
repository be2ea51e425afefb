"""Swing Furuta's pendulum up with a torque on its arm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from lag_envs.scenes import RotaryPendulum
from lag_envs.scenes.shapes import Bodies, outlines
from lag_envs.tasks.angles import bounds_of_circle, circle
from lag_envs.tasks.base import Task
from lag_envs.tasks.record import Controller, Examples, Goal, Plans


class RotarySwingUp(Task):
    """Swing a pendulum up by turning the arm that carries it; hold it upright, with the arm where it began.

    ## Description

    A pendulum hangs from the end of an arm that a motor turns about the vertical: Furuta's apparatus. Turn
    the arm to and fro to swing the pendulum up, then keep it upright and the arm where it began.

    Pictures show two views side by side: on the left the arm, seen from above; on the right the pendulum,
    seen along the arm that carries it, with dashes where it should stand.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The torque is held for one step.

    ## Observation Space

    Cosine and sine of both angles; the rates, divided by 10 and 20, have no bound.

    ## Rewards

    Each step pays h² (0.8 + 0.2 cosφ)(1 - 0.1 a²). The height h = (1 - cosθ)/2 is 0 hanging and 1 upright;
    h and φ are taken at the step's end; a is the action. Because of the square, a pendulum that only spins
    earns little. With another `dt` rewards are scaled by dt/0.02.

    ## Starting State

    The pendulum hangs, nearly at rest.

    ## Episode End

    Termination: never.

    ## Equations

    A fast arm throws the pendulum outwards; this is the term with φ'² sin(2θ).

    ## Signs and Units

    SI units. θ = 0 hangs straight down and θ = π stands; neither angle is wrapped.

    ## Known Returns

    The optimum is not known; no return exceeds 500.

    ## Version History

    - v0: first version.
    """

    id = "RotaryPendulum-v0"
    quantities = {
        "cos(phi)": ("1", "cosine of the arm's angle"),
        "sin(phi)": ("1", "its sine"),
        "phi_dot/10": ("rad/s", "the arm's angular velocity, divided by 10"),
        "cos(theta)": ("1", "cosine of the pendulum's angle, 1 hanging"),
        "sin(theta)": ("1", "its sine"),
        "theta_dot/20": ("rad/s", "its angular velocity, divided by 20"),
        "torque": ("N m", "torque on the arm"),
    }
    scene: Any = RotaryPendulum
    defaults = {"arm_inertia": 2e-3, "inertia": 7.5e-4, "arm_damping": 5e-4, "damping": 1e-4}
    interval, steps = 0.02, 500
    action = {"torque": 0.15}
    start = dict.fromkeys(("phi", "phi_dot", "theta", "theta_dot"), 0.1)

    goal = Goal(
        "success: within 0.2 rad of upright throughout the last second; time: until it is so for good",
        arrival="upright",
    )
    controllers = {
        "plan + TVLQR": Controller("lag_envs.controllers.tracking:recorded"),
        "energy shaping + LQR": Controller(
            "lag_envs.controllers.energy:PivotEnergyLQR",
            {
                "pivot": "phi", "angle": "theta", "at": {"theta": math.pi},
                "pump": 162.0, "centring": 5.5, "catch": 18.0, "lose": 600.0,
                "weights": {"phi": 0.0235, "phi_dot": 7e-4, "theta": 1.0, "theta_dot": 6e-4}, "effort": 0.08,
            },
            tune={"pump": (10.0, 1e3), "centring": (0.5, 50.0), "catch": (1.0, 60.0), "lose": (10.0, 1e3)},
        ),
        "MPC": Controller(
            "lag_envs.controllers.mpc:planner",
            {
                "horizon": 70, "every": 10, "iterations": 3, "good": 3.0, "pause": 20,
                "weights": {"phi": 3.0, "phi_dot": 0.1, "theta": 10.0, "theta_dot": 0.1},
                "rest": {"theta": math.pi},
            },
            plans=True,
            real_time={"ahead": 4, "every": 6},
        ),
    }  # fmt: skip
    plans = Plans(
        "lag_envs.controllers.swing_up:easier",
        {
            "end": {"phi": 3.0, "phi_dot": 0.1, "theta": 10.0, "theta_dot": 0.1},
            "effort": 0.02,
            "share": 0.97,
        },
        steps=68,
        quick={},
        batch=32,
        iterations=100,
        rest=(0.0, 0.0, math.pi, 0.0),
        weights={"phi": 0.1, "phi_dot": 0.002, "theta": 1.0, "theta_dot": 0.002},
        effort=0.1,
    )
    hyperparameters = {
        "ppo": {"gamma": 0.99},
        "fast_ppo": {
            "n_timesteps": 5e6, "n_steps": 32, "gamma": 0.97, "max_grad_norm": 1.0, "reward_scale": 1.0,
            "state_noise": False, "log_std_init": 0.5, "critic": [64, 64],
        },
    }  # fmt: skip
    examples = Examples(
        start={"state": [0.3, -2.0, 2.0, 3.0]},
        moving=[0.3, -8.0, 2.0, 12.0],
        reach=20.0,
        rest=[0.0, 0.0, math.pi, 0.0],
        batch={
            "mass": [0.1, 0.05, 0.3, 0.1, 0.05, 0.1, 0.3],
            "damping": [0.0, 1e-4, 1e-2, 0.0, 1e-4, 0.0, 1e-2],
        },
    )
    difficulty = (
        "The motor is too weak to lift the pendulum in one go. The faster the arm and the pendulum move, the "
        "harder they push each other."
    )
    note = (
        "MPC, which plans again several times a second, is best. Following one plan with feedback comes "
        "close to it, and so does the PPO in one file, except for one seed. Energy shaping pumps with the "
        "arm's acceleration, then hands over to an LQR; it often fails to catch the pendulum, because "
        "pumping ignores the arm's speed."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return cosφ, sinφ, φ'/10, cosθ, sinθ, θ'/20."""
        return {
            **circle(after, "phi", xp=xp),
            "phi_dot/10": 0.1 * after.phi_dot,
            **circle(after, "theta", xp=xp),
            "theta_dot/20": 0.05 * after.theta_dot,
        }

    def bounds(self) -> Mapping[str, float]:
        """Return the bounds of cosines and sines."""
        return bounds_of_circle(self.quantities)

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return h² (0.8 + 0.2 cosφ)(1 - 0.1 a²)."""
        height, effort = 0.5 - 0.5 * xp.cos(after.theta), control.torque * (1.0 / self.action["torque"])
        return height * height * (0.8 + 0.2 * xp.cos(after.phi)) * (1.0 - 0.1 * effort * effort)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the pendulum is within 0.2 rad of upright."""
        return xp.cos(after.theta) <= -math.cos(0.2)

    def bodies(self) -> Bodies:
        """Add the upright pendulum."""
        return {"upright": outlines(self.scene.bodies()["pendulum"]), **super().bodies()}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add a mark where the upright pendulum is."""
        x, y, _ = self.scene.poses(now.q, xp)["pendulum"]
        return {**super().indicators(now, xp), "upright": (x, y, math.pi)}
