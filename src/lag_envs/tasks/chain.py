"""Swing chains of bars up by moving their support, and keep them up."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from lag_envs.scenes import Chain
from lag_envs.scenes.shapes import Bodies, Polygon
from lag_envs.tasks.base import FASTEST_START
from lag_envs.tasks.record import Controller, Examples, Goal, Open, Plans
from lag_envs.tasks.track import GuardedTrack, Support

#: Settings of SAC, TD3 and TQC for swinging up. Sixteen steps for each update did best in trials.
OFF_POLICY: Mapping[str, Mapping[str, Any]] = {
    "off_policy": {
        "n_timesteps": 2e6, "n_envs": 128, "n_steps": 3, "gamma": 0.97, "gradient_steps": 8,
        "buffer_size": 1_000_000, "learning_rate": "lin_2e-3",
        "policy_kwargs": {"net_arch": [64, 64], "noise_steps": 4},
    },
    "td3": {"policy_kwargs": {"noise": 0.3}},
}  # fmt: skip


class _ChainTask(Support):
    """What the tasks with chains share."""

    scene: Any
    #: Chance of a kick per interval, and its largest size [rad/s].
    kick_chance, largest_kick = 0.01, 0.0

    @property
    def angles(self) -> list[str]:
        """Names of the angles, starting at the support."""
        return list(self.scene.coordinates)

    def fastest_turn(self) -> float:
        r"""Return a bound on the rates of the angles [rad/s].

        Let W be kinetic plus potential energy in the support's frame, at least 0, and M the mass of all bars.
        The frame's acceleration u adds the power -u Σ m x' ≤ U √(2 M W), and damping only reduces W, so √W
        grows by at most U √(M/2) a second. A kick k of the last bar's rate adds at most k √(J/2) to √W, where
        J is the bar's moment of inertia about its joint. Each bar's rotational energy is part of W, so
        I θ'²/2 ≤ W.
        """
        scene = self.scene
        if scene.inertia == 0.0:
            return math.inf
        arms = [i * scene.length + scene.com_distance for i in range(scene.bars)]
        turning = 0.5 * FASTEST_START**2 * sum(scene.mass * arm**2 + scene.inertia for arm in arms)
        fall = 2.0 * scene.mass * scene.gravity * sum(arms)
        driven = self.largest * math.sqrt(0.5 * scene.bars * scene.mass) * self.duration
        about_joint = scene.inertia + scene.mass * scene.com_distance**2
        kicked = self.largest_kick * math.sqrt(0.5 * about_joint) * self.limit
        return (math.sqrt(turning + fall) + driven + kicked) * math.sqrt(2.0 / scene.inertia)

    def occasional_kick(self, draws: Any, xp: Any) -> dict[str, Any]:
        """Return an occasional kick of the last bar's rate to either side."""
        size = self.largest_kick * (2.0 * draws[1] - 1.0)
        return {f"{self.angles[-1]}_dot": xp.where(draws[0] < self.chance(self.kick_chance), size, 0.0)}

    def bodies(self) -> Bodies:
        """Add the upright chain."""
        half, low = 0.05 * self.scene.length, -self.scene.reach
        corners = [(-half, half), (-half, low - half), (half, low - half), (half, half)]
        return {"upright": [Polygon(corners, "target")], **super().bodies()}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add its place."""
        return {**super().indicators(now, xp), "upright": (now.q.s, 0.0, math.pi)}


class SwingUp(GuardedTrack, _ChainTask):
    """Swing a double pendulum up by moving its support, and hold it upright.

    ## Description

    Uniform bars, each hinged to the end of the one above, hang from a support. Move the support to and fro to
    swing them up, then keep all of them upright, within the support's track.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step.

    The support must be able to stop inside the track, braking at U, the largest acceleration. If the
    requested acceleration would make that impossible, the nearest one that allows it is applied.
    `env.unwrapped.control` is the acceleration applied.

    ## Observation Space

    The bounds are proved for every accepted start. The proof assumes that the support only adds energy, so
    real episodes stay far within the bounds.

    ## Rewards

    Each step pays h⁴ - 0.02 (u/U)². The height h of the chain's end is 0 hanging and 1 upright, taken at
    the step's end; u is the acceleration that was applied. Because of the fourth power, a spinning chain
    earns little, and so does a chain whose upper bar stands while the lower bar hangs. With another `dt`
    rewards are scaled by dt/0.02, so a second is always worth the same.

    ## Starting State

    The chain hangs, nearly at rest. Starts from which the support cannot stop inside the track are refused.
    At the start, s lies within a tenth of the track's half length.

    ## Episode End

    Termination: never. The ends of the track are guarded, as described above.

    ## Arguments

    `track=math.inf` is an endless track; the observation then divides s by 0.5 m. `bars` changes the
    state and the spaces.

    ## Equations

    The drive is strong enough to move the support as commanded: the bars do not act back on it.

    ## Signs and Units

    SI units. Angles are measured from straight down, not from the bar above: a bar hangs at θ = 0 and stands
    at θ = π. They grow counter-clockwise and are not wrapped. s is positive to the right and 0 in the middle
    of the track.

    ## Numerical Accuracy

    s and s' are exact to rounding. The last bar moves fast: a step is divided if one series would not
    converge.

    ## Known Returns

    The optimum is not known.

    ## Version History

    - v0: first version (lag_envs 0.2.0).
    """

    id = "DoubleBar-v0"
    scene: Any = Chain
    defaults = {"bars": 2, "mass": 0.1, "length": 0.3, "damping": 1e-4, "track": 0.6}
    largest = 10.0

    goal = Goal(
        "success: each bar within 0.2 rad of upright throughout the last second; time: until it is so for "
        "good",
        arrival="upright",
    )
    controllers = {
        "LQR": Controller("lag_envs.controllers.tracking:hold"),
        "plan + TVLQR": Controller("lag_envs.controllers.tracking:recorded"),
        "iLQR": Controller("lag_envs.controllers.chain:replan", plans=True),
        "MPC": Controller("lag_envs.controllers.mpc:renewed", plans=True, real_time={"ahead": 4}),
    }
    examples = Examples(
        start={"state": [0.1, -0.2, 2.0, 3.0, 2.5, -4.0]},
        moving=[0.1, -0.2, 2.0, 12.0, 2.5, -20.0],
        refused=[{"state": [s, s_dot, 0, 0, 0, 0]} for s, s_dot in ((0.7, 0), (0.3, 3.0), (-0.3, -3.0))],
        reach=60.0,
        rest=[0.0, 0.0, math.pi, 0.0, math.pi, 0.0],
        batch={
            "damping": [0.0, 1e-4, 0.01, 1e-3, 1e-4],
            "gravity": [9.81, 0.0, 30.0, 1.6, 9.81],
            "track": [0.6, 0.3, 1.0, 0.6, 5.0],
        },
        variants={"endless track": {"track": math.inf}, "three bars": {"bars": 3}},
    )
    difficulty = (
        "Two unstable bars share one control, on a short track. The right energy is not enough: both bars "
        "must arrive upright at the same moment and at rest, which the chaotic swing before makes hard to "
        "time."
    )
    hyperparameters = {
        "fast_ppo": {
            "n_timesteps": 5e6, "learning_rate": 8e-3, "n_steps": 128, "n_epochs": 5, "batch_size": 2048,
            "reward_scale": 1.0, "log_std_init": 0.5, "actor": [64, 64], "critic": [128, 128],
            "first_layer_scale": 3.0,
        },
        **OFF_POLICY,
    }  # fmt: skip
    note = """
The best known method plans anew for each start. MPC is nearly as good and needs no time before the start: it
begins with a recorded plan and improves this plan on the way up. One recorded plan with time-varying feedback
comes close, because all starts are close together. SAC and TD3 take fewer steps than the PPO in one file, but
learn less.
"""

    steps_of_plan, batch, iterations, price, strength = 65, 32, 120, 0.05, 0.95
    quick = MappingProxyType({"steps": 68, "batch": 64, "share": 1.0, "edge": 0.97, "effort": 0.02})

    @property
    def plans(self) -> Plans:
        """How the swing-up is planned; the feedback weighs the angles most."""
        weights = {"s": 0.1 / self.length**2, "s_dot": 0.1}
        for name in self.angles:
            weights |= {name: 1.0, f"{name}_dot": 0.02}
        return Plans(
            "lag_envs.controllers.chain:easier",
            {"effort": self.price, "share": self.strength},
            steps=self.steps_of_plan,
            quick=self.quick,
            batch=self.batch,
            iterations=self.iterations,
            rest=(0.0, 0.0, *(math.pi, 0.0) * self.scene.bars),
            weights=weights,
            effort=0.02,
            extra={"s": 0.02 / self.length**2},  # a cost has to draw the support back
        )

    @property
    def quantities(self) -> Mapping[str, tuple[str, str]]:  # type: ignore[override]
        """The observation's units and meanings."""
        return {
            "s/S": ("1", "place of the support, divided by the track's half length S"),
            "s_dot/2": ("m/s", "speed of the support, halved"),
            "s_ddot": ("m/s²", "acceleration of the support"),
            **{f"cos({name})": ("1", f"cosine of {name}") for name in self.angles},
            **{f"sin({name})": ("1", f"sine of {name}") for name in self.angles},
            **{f"{name}_dot/8": ("rad/s", f"rate of {name}, divided by 8") for name in self.angles},
        }

    @property
    def start(self) -> Mapping[str, float]:
        """Hanging, nearly at rest, near the middle of the track."""
        rates = {f"{name}_dot": 0.1 for name in self.angles}
        return {**self.start_of_support(), **dict.fromkeys(self.angles, 0.1), **rates}

    def height(self, state: Any, xp: Any) -> Any:
        """Return the height of the chain's end: 0 hanging, 1 upright."""
        cosines = sum(xp.cos(state[name]) for name in self.angles)
        return 0.5 - cosines * (0.5 / self.scene.bars)

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return h⁴ - 0.02 (u/U)²."""
        effort = control.s_ddot * (1.0 / self.largest)
        return self.height(after, xp) ** 4 - 0.02 * (effort * effort)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether each bar is within 0.2 rad of upright."""
        lowest = xp.cos(after[self.angles[0]])
        for name in self.angles[1:]:
            lowest = xp.maximum(lowest, xp.cos(after[name]))
        return lowest <= -math.cos(0.2)

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return s/S, s'/2, the cosines, the sines, and the rates divided by 8."""
        cosines = {f"cos({name})": xp.cos(after[name]) for name in self.angles}
        sines = {f"sin({name})": xp.sin(after[name]) for name in self.angles}
        rates = {f"{name}_dot/8": 0.125 * after[f"{name}_dot"] for name in self.angles}
        return self.observe_support(after) | cosines | sines | rates

    def bounds(self) -> Mapping[str, float]:
        """Return bounds on the observation."""
        circle = {f"{part}({name})": 1.0 for part in ("cos", "sin") for name in self.angles}
        turn = 0.125 * self.fastest_turn()
        return self.bounds_of_support() | circle | {f"{name}_dot/8": turn for name in self.angles}


class SwingUpWeak(SwingUp):  # noqa: D101 (SwingUp's docstring, adapted, as in the classes below)
    __doc__ = (SwingUp.__doc__ or "").replace("its support,", "a weak support,", 1)
    id = "DoubleBarWeak-v0"
    defaults = {**SwingUp.defaults, "track": 0.5}
    largest = 5.0
    steps_of_plan, strength = 115, 0.9
    quick = MappingProxyType({"steps": 108, "share": 0.92, "edge": 0.92})
    # A plan that goes far beyond the catch drifts to states where this support can no longer correct it.
    controllers = SwingUp.controllers | {
        "iLQR, to the catch": Controller("lag_envs.controllers.chain:replan", {"beyond": 1.1}, plans=True)
    }
    hyperparameters = {
        "fast_ppo": {
            "n_timesteps": 5e6, "learning_rate": 8e-3, "n_steps": 128, "n_epochs": 5, "batch_size": 2048,
            "reward_scale": 1.0, "episode_share": 1.0, "actor": [64, 64], "critic": [128, 128],
            "first_layer_scale": 3.0,
        },
        **OFF_POLICY,
    }  # fmt: skip

    difficulty = (
        "As with the strong support of DoubleBar-v0, but with half the acceleration on a shorter track: "
        "energy has to be pumped in over several swings, and this support cannot catch deviations at the top "
        "that a strong one could."
    )
    note = """
Planning anew for each start is best. When the board opened, the plans went on far beyond the catch. Plans
that end with the catch have been found since and are better, so scores above one are possible. MPC, which
improves a recorded plan on the way up, comes between planning before the start and following one recorded
plan with time-varying feedback. All methods are close, because the starts are close together.
"""


class SwingUpTriple(SwingUp):  # noqa: D101
    __doc__ = (SwingUp.__doc__ or "").replace("double", "triple", 1)
    id = "TripleBar-v0"
    defaults = {"bars": 3, "mass": 0.1, "length": 0.2, "damping": 5e-4, "track": 0.8}
    largest = 15.0
    steps_of_plan, batch, iterations, price, strength = 150, 28, 180, 0.02, 0.85
    quick = MappingProxyType({})  # feedback cannot correct a plan that uses the control at its limits

    controllers = {
        **{name: SwingUp.controllers[name] for name in ("LQR", "plan + TVLQR")},
        # The cost that the regulator would add is known for small deviations only, which here means very
        # small ones.
        "MPC": Controller(
            "lag_envs.controllers.mpc:renewed",
            {"beyond": 1.0, "every": 2, "near": 0.05},
            plans=True,
            real_time={"ahead": 6, "every": 1},
        ),
    }

    examples = Examples(
        start={"state": [0.1, -0.2, 2.0, 3.0, 2.5, -4.0, 1.0, 2.0]},
        moving=[0.1, -0.2, 2.0, 12.0, 2.5, -20.0, 1.0, 30.0],
        refused=[{"state": [s, s_dot, *[0] * 6]} for s, s_dot in ((0.9, 0), (0.3, 4.5), (-0.3, -4.5))],
        reach=95.0,
        rest=[0.0, 0.0, *[math.pi, 0.0] * 3],
        batch=SwingUp.examples.batch,
        variants={"endless track": {"track": math.inf}},
    )
    hyperparameters = {
        "fast_ppo": {
            "n_timesteps": 5e6,
            "n_epochs": 5,
            "reward_scale": 1.0,
            "episode_share": 1.0,
            "actor": [64, 64],
        },
        **OFF_POLICY,
    }
    difficulty = (
        "Three unstable bars share one control. The chain has to arrive upright with all three bars nearly "
        "at rest at once, and feedback cannot correct a plan that uses the control at its limits."
    )
    note = """
When the board opened, one recorded plan with time-varying feedback was best; it nearly always catches the
chain. One of PPO's seeds has learned a better swing since. Plans that are improved before the start use the
control at its limits, where feedback has no authority, and lose the chain on the way. MPC begins with the
recorded plan or its mirror image, improves it a little every other step, and follows it by the same kind of
feedback. It is better than the recorded plan, but that seed's swing is better still.
"""


class SwingUpTripleNoisy(SwingUpTriple):  # noqa: D101
    __doc__ = (
        (SwingUpTriple.__doc__ or "")
        .replace("and hold it upright.", "and hold it upright, through noise.", 1)
        .replace("The bounds are", "Each entry has normal noise. Without the noise, the bounds are", 1)
    )
    id = "TripleBarNoisy-v0"
    imperfections = {"observation_noise": 0.008}

    controllers = {
        "plan + TVLQR": SwingUpTriple.controllers["plan + TVLQR"],
        "filter + plan + TVLQR": Controller(
            "lag_envs.controllers.filtering:follow_filtered",
            {"effort": 1.0, "drift": 0.01},
            tune={"effort": (0.02, 4.0), "drift": (0.0, 0.03)},
        ),
        "filter + MPC": Controller(
            "lag_envs.controllers.filtering:renewed_filtered",
            {"effort": 1.0, "drift": 0.01, "beyond": 1.0, "every": 10, "surprise": math.inf, "near": 0.1},
            plans=True,
            real_time={"ahead": 4},
        ),
    }
    open = Open(
        "plan + TVLQR",
        {"observation_noise": None},
        knows="sees the exact state",
        tried={
            "plan + TVLQR": "the best of 18 plans, followed on the noisy observations",
            "filter + plan + TVLQR": "the same plan, followed on the estimate of an extended Kalman filter "
            "on the exact model; of 13 pairs of its weight and drift, the best in 96 or 192 episodes",
            "filter + MPC": "the plan, renewed every 10 steps from the same estimate, and followed as "
            "gently; of 8 choices of its numbers, the best in 96 episodes",
            "fast PPO": "5 million steps a seed, on the last 4 observations",
        },
    )
    examples = dataclasses.replace(SwingUpTriple.examples, variants={"perfect": {"observation_noise": None}})
    hyperparameters = {
        "fast_ppo": {**SwingUpTriple.hyperparameters["fast_ppo"], "learning_rate": 2.5e-3, "frames": 4},
        **OFF_POLICY,
    }
    difficulty = (
        "In the linear approximation a filter's estimate is good enough, with control and track to spare. "
        "But the remaining noise drives the chain out of the region where that approximation holds, and it "
        "is lost on the way up or at the top."
    )
    note = """
The best agents follow a plan gently, on a filter's estimate. MPC, which renews the plan on the way up, loses
the chain less often than an agent that follows the plan to its end. The PPO in one file, which sees the last
few observations, gets nearly as high a return as the latter agent, but seldom holds all bars upright for
good. With the exact state the chain is hardly ever lost. Nobody has tried to choose more informative motions.
"""

    @property
    def plans(self) -> Plans:
        """The plans of the task without noise."""
        return dataclasses.replace(super().plans, of=SwingUpTriple.id)


class SwingUpAnywhere(SwingUp):
    """Swing a double pendulum up from anywhere, and keep it up against kicks.

    ## Description

    Two uniform bars, one hinged to the end of the other, start at any angles, moving. Bring them upright by
    moving their support, and do so again whenever a kick has thrown them over. No recorded plan fits more
    than a few of the starts.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step.

    The support must be able to stop inside the track, braking at U, the largest acceleration. If the
    requested acceleration would make that impossible, the nearest one that allows it is applied.
    `env.unwrapped.control` is the acceleration applied.

    ## Observation Space

    The bounds are proved for every accepted start, even with a kick in every step.

    ## Rewards

    Each step pays h⁴ - 0.02 (u/U)², taken at the step's end and before a kick. The height h of the chain's
    end is 0 hanging and 1 upright; u is the acceleration that was applied. With another `dt` rewards are
    scaled by dt/0.02, so a second is always worth the same.

    ## Starting State

    The angles are arbitrary, and the bars move. Starts from which the support cannot stop inside the track
    are refused. At the start, s lies within a tenth of the track's half length.

    After each step, with probability 0.005 (1 - 0.995^(dt/0.02) for another `dt`), a kick changes the last
    bar's rate by a uniform amount within ±1 rad/s.

    ## Episode End

    Termination: never. The ends of the track are guarded, as described above.

    ## Arguments

    `track=math.inf` is an endless track; the observation then divides s by 0.5 m. `bars` changes the
    state and the spaces.

    ## Equations

    The drive is strong enough to move the support as commanded: the bars do not act back on it.

    ## Signs and Units

    SI units. Angles are measured from straight down, not from the bar above: a bar hangs at θ = 0 and stands
    at θ = π. They grow counter-clockwise and are not wrapped. s is positive to the right and 0 in the middle
    of the track.

    ## Numerical Accuracy

    s and s' are exact to rounding. The last bar moves fast: a step is divided if one series would not
    converge.

    ## Known Returns

    The optimum is not known; it depends on the kicks.

    ## Version History

    - v0: first version (lag_envs 0.2.0).
    """

    id = "DoubleBarAnywhere-v0"
    draws = 2
    kick_chance, largest_kick = 0.005, 1.0
    hyperparameters = {
        "fast_ppo": {
            "n_timesteps": 5e6, "learning_rate": 8e-3, "n_steps": 128, "n_epochs": 5, "gae_lambda": 0.8,
            "clip_range": 0.1, "noise_steps": 2, "log_std_init": 0.5, "actor": [64, 64], "critic": [128, 128],
        },
        **OFF_POLICY,
    }  # fmt: skip

    controllers = {
        "LQR": Controller("lag_envs.controllers.tracking:hold"),
        "MPC": Controller(
            "lag_envs.controllers.chain:anywhere", plans=True, real_time={"ahead": 60, "every": 30}
        ),
    }
    difficulty = (
        "No two episodes need the same swing-up, so one has to be found each time, by planning or by a "
        "policy that covers them all; and kicks throw upright bars over."
    )
    note = """
The best known method plans on the exact model, at the start and whenever a kick has spoilt the plan. Holding
alone works only if the bars happen to pass upright slowly.
"""

    @property
    def start(self) -> Mapping[str, float]:
        """At any angles, moving, near the middle of the track."""
        rates = {f"{name}_dot": 3.0 for name in self.angles}
        return {**self.start_of_support(), **dict.fromkeys(self.angles, math.pi), **rates}

    def kick(self, after: Any, draws: Any, xp: Any) -> Mapping[str, Any]:
        """Change the last bar's rate, now and then."""
        return self.occasional_kick(draws, xp)


class Balance(_ChainTask):
    """Keep a double pendulum upright against kicks by moving its support.

    ## Description

    Two uniform bars, one hinged to the end of the other, start nearly upright. Keep them there, near the
    middle of the track, while random kicks hit the upper one.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step.

    ## Observation Space

    The bounds are proved for every accepted start, even with a kick in every step.

    ## Rewards

    Each step pays 1 - mean((e/0.35)²)/2 - (s/S)²/2, evaluated at the step's end and before a kick. The mean
    is over the bars, and S is half the track. Inside the limits the reward lies between 0 and 1. With another
    `dt` rewards are scaled by dt/0.02.

    ## Starting State

    The bars are nearly upright. Given starts must lie inside the limits below.

    After each step, with probability 0.01 (1 - 0.99^(dt/0.02) for another `dt`), a kick changes the last
    bar's rate by a uniform amount within ±1 rad/s.

    ## Episode End

    Termination: |e| > 0.35 rad for one of the bars, or |s| > S at a step's end. That step still pays.

    ## Arguments

    The track must be finite here. `bars` changes the state and the spaces.

    ## Equations

    The drive is strong enough to move the support as commanded: the bars do not act back on it.

    ## Signs and Units

    SI units. Angles are measured from straight down, not from the bar below: a bar stands at θ = π. They grow
    counter-clockwise and are not wrapped, so θ = -π is a different angle and outside the limits. s is
    positive to the right.

    ## Numerical Accuracy

    s and s' are exact to rounding.

    ## Known Returns

    The optimum is not known. Some kicks cannot be survived, so the optimum lies below 500.

    ## Version History

    - v0: first version (lag_envs 0.2.0).
    """

    id = "DoubleBarBalance-v0"
    scene: Any = Chain
    defaults = {"bars": 2, "mass": 0.1, "length": 0.3, "damping": 1e-4, "track": 0.5}
    largest = 5.0
    draws = 2
    largest_angle = 0.35
    largest_kick = 1.0

    goal = Goal(
        "success: neither a bar nor the support leaves its limits in 10 s; there is no time", None, None
    )
    reference = "linear feedback"
    controllers = {
        "LQR": Controller(
            "lag_envs.controllers.linear:BalanceLQR",
            {"effort": 5.71, "slide": 0.016, "turn": 0.23},
            tune={"effort": (0.1, 30.0), "slide": (0.0, 5.0), "turn": (0.0, 20.0)},
        ),
        "linear feedback": Controller(
            "lag_envs.controllers.basic:feedback",
            {
                "s": -1.48,
                "s_dot": -0.71,
                "e_1": -28.2,
                "e_2": 35.2,
                "theta_1_dot": -0.985,
                "theta_2_dot": 2.67,
            },
            tune={
                "s": (-3.0, 0.0),
                "s_dot": (-3.0, 0.0),
                "e_1": (-40.0, 0.0),
                "e_2": (0.0, 40.0),
                "theta_1_dot": (-4.0, 2.0),
                "theta_2_dot": (0.0, 6.0),
            },
        ),
        "MPC": Controller(
            "lag_envs.controllers.chain:rescued",
            {
                "weights": {"effort": 5.71, "slide": 0.016, "turn": 0.23},
                "horizon": 40, "every": 2, "iterations": 5, "budget": 45_000, "good": 20.0,
            },
            plans=True,
            real_time={"ahead": 4, "every": 1, "budget": 10_000},
        ),
    }  # fmt: skip
    examples = Examples(
        start={"state": [0.1, -0.2, 3.0, 0.5, 3.2, -0.5]},
        refused=[
            {"state": state}
            for state in ([0.0] * 6, [0.51, 0, math.pi, 0, math.pi, 0], [0, 0, math.pi, 0, -math.pi, 0])
        ],
        ending=([0.0, 0.0, math.pi, 0.0, math.pi + 0.34, 3.0], 0.0),
        reach=12.0,
        rest=[0.0, 0.0, math.pi, 0.0, math.pi, 0.0],
        batch={
            "damping": [0.0, 1e-4, 0.01, 1e-3, 1e-4],
            "track": [0.5, 0.6, 1.0, 0.5, 0.3],
        },
    )
    difficulty = (
        "Two unstable bars share one control, and kicks come at random. To push the bars back, the support "
        "must first move the wrong way, which uses up the track."
    )
    hyperparameters = {
        "fast_ppo": {
            "n_timesteps": 2e7, "gae_lambda": 0.8, "max_grad_norm": 1.0, "reward_scale": 1.0,
            "critic": [64, 64],
        },
        # Large noise, kept for long, tips the bars over.
        "off_policy": {
            "n_steps": 3, "gradient_steps": 2, "learning_rate": "lin_2e-3",
            "policy_kwargs": {"noise_steps": 4},
        },
        "td3": {"policy_kwargs": {"noise": 0.15}},
    }  # fmt: skip
    note = """
The PPO in one file is best, after many more steps than the other learners take. MPC comes next: it leaves
holding to the LQR, and plans on the exact model where the LQR would lose the bars even without another kick.
The LQR is tuned for small deviations; feedback with directly optimised gains survives larger kicks.
"""

    def check(self) -> None:
        """Require a finite track, since the episode ends when the support leaves it."""
        if math.isinf(self.scene.track):
            raise ValueError(f"balancing needs a track of finite length, got track={self.scene.track}")

    @property
    def quantities(self) -> Mapping[str, tuple[str, str]]:  # type: ignore[override]
        """The observation's units and meanings."""
        return {
            "s": ("m", "place of the support"),
            "s_dot": ("m/s", "its speed"),
            "s_ddot": ("m/s²", "acceleration of the support"),
            **{
                f"e_{i + 1}": ("rad", f"angle from upright, {name} - π") for i, name in enumerate(self.angles)
            },
            **{f"{name}_dot": ("rad/s", f"rate of {name}") for name in self.angles},
        }

    @property
    def start(self) -> Mapping[str, Any]:
        """Nearly upright."""
        places = dict.fromkeys(self.angles, (math.pi, 0.05))
        rates = {f"{name}_dot": 0.15 for name in self.angles}
        return {"s": 0.2 * self.scene.track, "s_dot": 0.15, **places, **rates}

    def leaning(self, state: Any) -> dict[str, Any]:
        """Return the angles from upright."""
        return {f"e_{i + 1}": state[name] - math.pi for i, name in enumerate(self.angles)}

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return 1 - mean((e/0.35)²)/2 - (s/S)²/2."""
        squares = sum((e * (1.0 / self.largest_angle)) ** 2 for e in self.leaning(after).values())
        s = after.s * (1.0 / self.scene.track)
        return 1.0 - squares * (0.5 / self.scene.bars) - 0.5 * (s * s)

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether a bar has fallen or the support has left the track."""
        over = xp.abs(after.s) > self.scene.track
        for e in self.leaning(after).values():
            over = over | (xp.abs(e) > self.largest_angle)
        return over

    def behaviour(self, played: Any) -> Mapping[str, float]:
        """Return how often the bars stay balanced to the end."""
        return {"episodes that last 10 s [%]": 100.0 * float((played.steps == self.limit).mean())}

    def kick(self, after: Any, draws: Any, xp: Any) -> Mapping[str, Any]:
        """Change the last bar's rate, now and then."""
        return self.occasional_kick(draws, xp)

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return s, s', the angles from upright, and their rates."""
        rates = {f"{name}_dot": after[f"{name}_dot"] for name in self.angles}
        return {"s": after.s, "s_dot": after.s_dot} | self.leaning(after) | rates

    def bounds(self) -> Mapping[str, float]:
        """Return bounds on the observation; each step may have a kick."""
        slide = FASTEST_START + self.largest * self.duration
        turn = self.fastest_turn()
        found = {"s": self.scene.track + slide * self.dt, "s_dot": slide}
        for i, name in enumerate(self.angles):
            found |= {f"e_{i + 1}": self.largest_angle + turn * self.dt, f"{name}_dot": turn}
        return found

    def check_start(self, state: Any) -> None:
        """Refuse a start at which the episode would be over."""
        leaning = max(abs(e) for e in self.leaning(state).values())
        if leaning > self.largest_angle or abs(state.s) > self.scene.track:
            given = ", ".join(f"{name}={state[name]:g} rad" for name in self.angles)
            raise ValueError(
                f"the episode would be over at s={state.s:g} m, {given}: |theta - pi| must be at most "
                f"{self.largest_angle} rad and |s| at most {self.scene.track:g} m"
            )
