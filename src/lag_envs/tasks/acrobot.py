"""Tasks with two links on a pivot: Gymnasium's, stepped exactly, and those of a real machine."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from lag_envs.scenes import Acrobot
from lag_envs.scenes.shapes import Bodies, Line, outlines
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.angles import bounds_of_circle, circle
from lag_envs.tasks.base import Task
from lag_envs.tasks.record import Controller, Examples, Goal, Plans

_ANGLES = {
    "cos(theta_1)": ("1", "cosine of the first link's angle, 1 hanging"),
    "sin(theta_1)": ("1", "its sine"),
    "cos(theta_2)": ("1", "cosine of the second link's angle from the first, 1 straight"),
    "sin(theta_2)": ("1", "its sine"),
}
#: For learners with a replay buffer on the real machines, where a step is short and pays at most 0.02, eight
#: steps count together. Further below, noise is held for 0.05 s, and rewards are multiplied.
_PATIENT = {"n_timesteps": 3e5, "n_steps": 8, "gamma": 0.995}


class AcrobotExact(Task):
    """Lift the tip of two links above a line with a motor at the elbow: Gymnasium's Acrobot-v1, exact.

    ## Description

    Two links hang from a pivot, with a motor only at the elbow. Swing them so that the tip gets one link's
    length above the pivot as soon as possible. Spaces, rewards, starts and endings are those of Gymnasium's
    `Acrobot-v1`, so a policy trained there runs here unchanged, and vice versa.

    Two things differ. First, Gymnasium takes one Runge-Kutta step of 0.2 s at a time, so the energy of the
    undriven links drifts by joules within an episode. Here the motion under the held torque is exact. Second,
    Gymnasium clips the speeds at 4π and 9π rad/s, which removes energy without a physical cause. Here the
    speeds are free, and only their observations are clipped.

    The inertia of 1 kg m² about each centre of mass is kept, although no link of 1 kg and 1 m can have it: no
    mass distribution within a link gives more than a quarter of this value.

    ## Action Space

    `Discrete(3)`. The torque is held for one step.

    ## Observation Space

    Cosine and sine of both angles, and the speeds, clipped at 4π and 9π rad/s.

    ## Rewards

    Each step pays -1; the step that reaches the goal pays 0. With another `dt` rewards are scaled by dt/0.2.

    ## Starting State

    The links hang, nearly at rest.

    ## Episode End

    Termination: -cosθ₁ - cos(θ₁ + θ₂) > 1 at a step's end.

    ## Arguments

    The parameters, which are constants of the class in Gymnasium, are keywords here. By default `damping_2`
    and `dry_friction_2` equal the shoulder's.

    ## Equations

    The equations are those of Sutton and Barto's book, as in Gymnasium (`book_or_nips = "book"`).

    ## Signs and Units

    SI units. θ₁ = 0 hangs, θ₂ = 0 is straight; both grow counter-clockwise and are not wrapped.

    ## Numerical Accuracy

    Two integrators of the same equation diverge after a while, so episodes do not agree step by step. The
    returns of a policy do agree.

    ## Known Returns

    The optimum is not known. The best known plans come from a beam search on the exact model, which ranks
    states by their energy. From the hanging starts they take about 59 steps; a search many times as wide
    saves less than one. Learners take some 25 steps more.

    ## Version History

    - v0: first version.
    """

    id = "AcrobotExact-v0"
    peer = "Acrobot-v1"
    quantities = {
        **_ANGLES,
        "theta_1_dot": ("rad/s", "angular velocity of the first link, clipped at 4π"),
        "theta_2_dot": ("rad/s", "angular velocity of the second link relative to the first, clipped at 9π"),
        "elbow_torque": ("N m", "torque at the elbow"),
    }
    scene: Any = Acrobot
    defaults = {"inertia_1": 1.0, "inertia_2": 1.0, "gravity": 9.8}
    interval, steps = 0.2, 500
    action = {"elbow_torque": [-1.0, 0.0, 1.0]}
    start = dict.fromkeys(("theta_1", "theta_1_dot", "theta_2", "theta_2_dot"), 0.1)
    fastest_seen = {"theta_1_dot": 4.0 * math.pi, "theta_2_dot": 9.0 * math.pi}  # [rad/s]

    goal = Goal("success: the tip passes the line; time: until then", hold=None, terminated=True)
    controllers = {
        "switch": Controller(
            "lag_envs.controllers.basic:Switch",
            {"weights": {"sin(theta_1)": 1.3, "theta_1_dot": -0.3, "sin(theta_2)": -0.3, "theta_2_dot": 0.9}},
        ),
        "beam search": Controller("lag_envs.controllers.beam:beam", {"energy": 1.0}, plans=True),
    }
    reference = "switch"
    hyperparameters = {
        "ppo": {"gamma": 0.99},
        "fast_ppo": {
            "n_timesteps": 5e6, "n_envs": 128, "n_steps": 64, "n_epochs": 5, "gae_lambda": 0.98,
            "ent_coef": 3e-3, "reward_scale": 0.03, "critic": [128, 128],
        },
        "dqn": {  # near the RL Zoo's for Gymnasium's
            "learning_rate": 6.3e-4, "batch_size": 128, "buffer_size": 50_000, "target_update_interval": 250,
            "gradient_steps": 4, "exploration_fraction": 0.12, "exploration_final_eps": 0.1,
        },
    }  # fmt: skip
    examples = Examples(
        start={"state": [0.5, -1.0, 0.8, 1.0]},
        moving=[1.0, 3.0, -1.0, 5.0],
        ending=([2.6, 1.0, 0.0, 0.0], 1),
        batch={"mass_2": [1.0, 0.2, 3.0, 1.0, 0.2, 1.0, 3.0], "damping": [0.0, 0.1, 1.0, 0.0, 0.1, 0.0, 1.0]},
    )
    difficulty = "The elbow's torque is far too weak to lift the links, so they have to be swung."
    note = (
        "The switch takes the torque's sign from a weighted sum of observations, with weights found by "
        "random search. It never plans ahead. The beam search does, on the exact model: of the states that "
        "it can reach, it follows those with the most energy, one in each neighbourhood. It reaches the line "
        "first. Nothing proves its plans the shortest, but much wider searches hardly shorten them. The PPO "
        "in one file comes close to it; it takes more steps than the other learners, and less time."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return cosines, sines and clipped speeds."""
        return circle(after, "theta_1", "theta_2", xp=xp) | {
            name: clip(after[name], -top, top, xp) for name, top in self.fastest_seen.items()
        }

    def bounds(self) -> Mapping[str, float]:
        """Return the bounds of Gymnasium's space."""
        return bounds_of_circle(_ANGLES) | self.fastest_seen

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return -1."""
        return -1.0

    def last_reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return 0."""
        return 0.0

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the tip is a link's length above the pivot."""
        return -xp.cos(after.theta_1) - xp.cos(after.theta_1 + after.theta_2) > 1.0

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the tip has passed the line, which also ends the episode."""
        return self.reached(after, target, xp)

    def check_start(self, state: Any) -> None:
        """Accept every start, as Gymnasium's Acrobot does."""

    def bodies(self) -> Bodies:
        """Add the line that the tip is to pass."""
        wide = 1.1 * (self.scene.length_1 + self.scene.length_2)
        return {"line": [Line([(-wide, 0.0), (wide, 0.0)], "target")], **super().bodies()}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add the place of the line."""
        return {**super().indicators(now, xp), "line": (0.0, self.scene.length_1, 0.0)}


class AcrobotReal(Task):
    """Swing two links of a real machine up by a motor at the elbow, and hold them upright.

    ## Description

    This is the double pendulum of the RealAIGym project, with its identified parameters: two links with
    quasi-direct-drive motors and friction in both joints. Here only the elbow is driven. Swing both links up
    and keep them upright.

    Parameters, torque limit, control interval, length of an episode and criterion of success are those of the
    project's published leaderboards [1]_: `design_C.1`, `model_1.0`, 6 N m, 0.002 s and 10 s. The project's
    simulations omit friction and rotors, but its machine has them, and so has this environment. The driven
    joint has the identified friction. The idle joint has none, because on the machine the idle motor
    compensates its friction: this motor may use 0.5 N m, and friction takes at most half of it.

    .. [1] F. Wiebe et al., "Open Source Dual-Purpose Acrobot and Pendubot Platform", IEEE Robotics &
       Automation Magazine 31 (2024); github.com/dfki-ric-underactuated-lab/double_pendulum, folders
       `data/system_identification/identified_parameters` and `leaderboard`.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The torque is held for one step.

    ## Observation Space

    Cosine and sine of both angles; the speeds, divided by 10 and 20, have no bound.

    ## Rewards

    Each step pays 0.02 h⁴ (1 - 0.1 a²), so that a second pays 10 at most. The tip's height h is 0 hanging and
    1 upright, taken at the step's end; a is the action. The project's own score, which weighs several norms
    of a whole trajectory, is not a sum over steps. With another `dt` rewards are scaled by dt/0.002.

    ## Starting State

    The links hang, nearly at rest; in the project they start exactly at rest.

    ## Episode End

    Termination: never.

    ## Arguments

    Inertias are about the centres of mass; in the project's files they are about the joints. The shoulder's
    identified friction is `damping=0.001` and `dry_friction=0.16`, the elbow's `damping_2=0.001` and
    `dry_friction_2=0.12`. With `rotor_inertia=0` and no friction, this is the project's simulation.

    ## Equations

    The dry friction f atan(100 v) is also the project's.

    ## Signs and Units

    SI units. θ₁ = 0 hangs, θ₂ = 0 is straight; both grow counter-clockwise and are not wrapped.

    ## Numerical Accuracy

    Dry friction changes steeply around zero speed: where a joint's speed passes 0, steps are divided.

    ## Known Returns

    The optimum is not known; no return exceeds 100.

    ## Version History

    - v0: first version.
    """

    id = "AcrobotReal-v0"
    quantities = {
        **_ANGLES,
        "theta_1_dot/10": ("rad/s", "angular velocity of the first link, divided by 10"),
        "theta_2_dot/20": ("rad/s", "angular velocity of the second relative to the first, divided by 20"),
        "shoulder_torque": ("N m", "torque at the shoulder"),
        "elbow_torque": ("N m", "torque at the elbow"),
    }
    scene: Any = Acrobot
    #: Inertias about the centres of mass; the source gives 0.031887199591513114 and 0.05086984812807257 kg m²
    #: about the joints.
    defaults = {
        "mass_1": 0.5234602302310271,
        "mass_2": 0.6255677234174437,
        "length_1": 0.2,
        "length_2": 0.3,
        "com_distance_1": 0.2,
        "com_distance_2": 0.25569305436052964,
        "inertia_1": 0.031887199591513114 - 0.5234602302310271 * 0.2**2,
        "inertia_2": 0.05086984812807257 - 0.6255677234174437 * 0.25569305436052964**2,
        "damping": 0.0,
        "damping_2": 0.001,
        "dry_friction": 0.0,
        "dry_friction_2": 0.12,
        "rotor_inertia": 6.287203962819607e-05,
        "gear_ratio": 6.0,
        "gravity": 9.81,
    }
    interval, steps = 0.002, 5000
    order = 12  # friction divides the steps; order 16 takes a little longer
    action = {"elbow_torque": 6.0}
    start = dict.fromkeys(("theta_1", "theta_1_dot", "theta_2", "theta_2_dot"), 0.05)
    high = 0.9  # share of both lengths above which the tip is up, as in the project

    goal = Goal(
        "success: the tip above nine tenths of both links' lengths throughout the last second, and time: "
        "until it is so for good, the project's swing-up time",
        arrival="up",
    )
    controllers = {
        "LQR": Controller(
            "lag_envs.controllers.acrobot:PublishedLQR", {"weights": (0.97, 0.93, 0.39, 0.26), "effort": 0.11}
        ),
        "plan + TVLQR": Controller("lag_envs.controllers.tracking:recorded"),
        "MPC": Controller(
            "lag_envs.controllers.mpc:renewed",
            {"finer": 5, "every": 5, "iterations": 3, "surprise": math.inf, "reserve": 0.05},
            plans=True,
            real_time={"ahead": 12, "every": 1},
        ),
    }
    plans = Plans(
        "lag_envs.controllers.swing_up:easier",
        {
            "end": {"theta_1": 10.0, "theta_1_dot": 0.1, "theta_2": 10.0, "theta_2_dot": 0.1},
            "effort": 0.01,
            "every": 5,
        },
        steps=130,
        quick={},
        batch=24,
        iterations=80,
        rest=(math.pi, 0.0, 0.0, 0.0),
        weights={"theta_1": 1.0, "theta_1_dot": 0.05, "theta_2": 1.0, "theta_2_dot": 0.05},
        effort=0.5,
        smooth={"dry_friction": 0.0, "dry_friction_2": 0.0},
    )
    hyperparameters = {
        "ppo": {"gamma": 0.999},
        "fast_ppo": {
            "n_timesteps": 5e6, "learning_rate": 8e-3, "n_steps": 128, "n_epochs": 5, "batch_size": 2048,
            "gamma": 0.998, "gae_lambda": 0.95, "reward_scale": 1.0, "noise_steps": 25, "log_std_init": 0.5,
            "actor": [64, 64], "critic": [128, 128], "first_layer_scale": 3.0,
        },
        "off_policy": {
            **_PATIENT, "vec_env_wrapper": [{"lag_envs.sb3.ScaledReward": {"factor": 30.0}}],
            "policy_kwargs": {"net_arch": [64, 64], "noise_steps": 25},
        },
        "td3": {
            **_PATIENT, "vec_env_wrapper": [{"lag_envs.sb3.ScaledReward": {"factor": 10.0}}],
            "policy_kwargs": {"net_arch": [64, 64], "noise_steps": 25, "noise": 0.5},
        },
    }  # fmt: skip
    examples = Examples(
        start={"state": [2.8, -1.0, 0.3, 1.0]},
        moving=[1.0, 8.0, -1.0, -9.0],
        rest=[math.pi, 0.0, 0.0, 0.0],
        batch={
            "mass_2": [0.6, 0.3, 1.2, 0.6, 0.3, 0.6, 1.2],
            "gravity": [9.81, 3.7, 0.0, 9.81, 3.7, 9.81, 0.0],
        },
    )
    difficulty = (
        "There is one motor for two joints, and friction dissipates the energy that is pumped in. The "
        "upright equilibrium is unstable, and 500 decisions a second leave little time for each."
    )
    note = (
        "The LQR is that of the project's leaderboard. It only holds links that are upright already; it "
        "does not swing up hanging ones. The plan was found on the exact model with friction; its feedback "
        "comes from a model without dry friction. MPC begins with that plan or its mirror image, and renews "
        "it on the way up, which brings the links up sooner; but with wrong parameters it is no more "
        "reliable than the plan. Learners stay below the plan on average, and their seeds differ much. TD3, "
        "SAC and TQC hold their noise for many steps. The PPO in one file takes many more steps, and less "
        "time."
    )

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return cosines, sines and scaled speeds."""
        return circle(after, "theta_1", "theta_2", xp=xp) | {
            "theta_1_dot/10": 0.1 * after.theta_1_dot,
            "theta_2_dot/20": 0.05 * after.theta_2_dot,
        }

    def bounds(self) -> Mapping[str, float]:
        """Return the bounds of cosines and sines."""
        return bounds_of_circle(_ANGLES)

    def tip(self, after: Any, xp: Any) -> Any:
        """Return the tip's height above the shoulder, as a share of both links' lengths."""
        upper, lower = self.scene.length_1, self.scene.length_2
        height = -upper * xp.cos(after.theta_1) - lower * xp.cos(after.theta_1 + after.theta_2)
        return height / (upper + lower)

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return 0.02 h⁴ (1 - 0.1 a²)."""
        height = 0.5 + 0.5 * self.tip(after, xp)
        effort = sum((control[name] * (1.0 / most)) ** 2 for name, most in self.action.items())
        return 0.02 * height**4 * (1.0 - 0.1 * effort)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the tip is up."""
        return self.tip(after, xp) > self.high

    def bodies(self) -> Bodies:
        """Add the upright links."""
        shapes = self.scene.bodies()
        upright = {f"upright {name}": outlines(shapes[name]) for name in ("first", "second")}
        return {**upright, **super().bodies()}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add the places of the upright links."""
        added = {"upright first": (0.0, 0.0, math.pi), "upright second": (0.0, self.scene.length_1, math.pi)}
        return {**super().indicators(now, xp), **added}


class PendubotReal(AcrobotReal):  # noqa: D101 (AcrobotReal's docstring, adapted)
    __doc__ = (
        (AcrobotReal.__doc__ or "")
        .replace("by a motor at the elbow", "by a motor at the shoulder")
        .replace("only the elbow is driven", "only the shoulder is driven")
    )
    id = "PendubotReal-v0"
    defaults = {
        **AcrobotReal.defaults,
        "control": "shoulder",
        "damping": 0.001,
        "damping_2": 0.0,
        "dry_friction": 0.16,
        "dry_friction_2": 0.0,
    }
    action = {"shoulder_torque": 6.0}
    hyperparameters = {
        **AcrobotReal.hyperparameters,
        "fast_ppo": {
            "n_timesteps": 5e6, "n_steps": 128, "batch_size": 2048, "gamma": 0.998, "gae_lambda": 0.95,
            "reward_scale": 1.0, "max_grad_norm": 0.5,
        },
    }  # fmt: skip
    plans = dataclasses.replace(AcrobotReal.plans, steps=85)
    controllers = {
        "LQR": Controller(
            "lag_envs.controllers.acrobot:PublishedLQR",
            {"weights": (0.00125, 0.65, 0.000688, 0.000936), "effort": 25.0},
        ),
        "plan + TVLQR": Controller("lag_envs.controllers.tracking:recorded"),
        "MPC": Controller(
            "lag_envs.controllers.mpc:renewed",
            {"finer": 5, "every": 2, "iterations": 3, "surprise": math.inf, "reserve": 0.05},
            plans=True,
            real_time={"ahead": 8, "every": 1},
        ),
    }
