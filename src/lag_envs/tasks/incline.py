"""Roll a cylinder to a mark by tilting its plane; let it cross a line slowly by braking."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lag_envs.scenes import Incline
from lag_envs.scenes.shapes import (
    Arrow,
    Bodies,
    Circle,
    Frame,
    Line,
    Magnifier,
    Polygon,
    Reading,
    Window,
    arc,
    polar,
)
from lag_envs.stepping import slope
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import FASTEST_START, Task
from lag_envs.tasks.record import Axis, Controller, Examples, Goal, Optimum, ValueIteration


class Tilt(Task):
    """Roll a cylinder to a mark on a plane by tilting it, and stop there.

    ## Description

    A solid cylinder rolls without slipping on a plane that turns about its middle. Bring it to a mark and
    keep it there. The control is the rate at which the plane turns. The plane carries the cylinder, so
    turning the plane also pushes the cylinder.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step.

    The rate is clipped so that |φ| is at most 0.1 rad at the step's end. With `control="tilt"` the control
    is the tilt itself, 0.1 rad times the action, and the plane rests at that tilt during each step.

    ## Observation Space

    The bounds are proved for every accepted start. With `control="tilt"`, x_dot replaces w, and there is no
    phi.

    ## Rewards

    Each step pays exp(-((x - x*)/0.1)²) - 0.02 (u/U)², taken at its end; x* is the mark, u the control that
    was applied, U its limit. With another `dt` rewards are scaled by dt/0.05.

    ## Starting State

    The cylinder is anywhere near the middle and rolls slowly. Given starts must lie inside the limits.

    ## Episode End

    Termination: |x| > 0.5 m at a step's end.

    ## Arguments

    `control` is "tilt_rate" or "tilt". A target must lie within ±0.5 m.

    Any combination of values in these ranges is allowed: every step is taken, and observations stay within
    their space. Anything else is an error that names the value.

    ## Equations

    While the rate is held, φ̈ = 0. When the rate changes, x' jumps by -R times the change. The speed w = x' +
    R φ', which is proportional to the momentum, does not jump, so w is in the state.

    ## Signs and Units

    SI units. x is positive down the slope and 0 at the point about which the plane turns. φ is positive when
    the plane falls towards positive x.

    ## Numerical Accuracy

    The equation is linear while the rate is held. With `control="tilt"` it has a closed form.

    ## Known Returns

    The optimum is not known. docs/agents.md has the estimate of value iteration.

    ## Version History

    - v0: first version (lag_envs 0.1.0).
    """

    id = "InclineTilt-v0"
    quantities = {
        "x": ("m", "place along the plane"),
        "w": ("m/s", "x' + R φ', the speed proportional to the momentum"),
        "phi": ("rad", "tilt"),
        "phi_dot": ("rad/s", "rate of the tilt"),
        "target": ("m", "the mark x*"),
    }
    scene: Any = Incline
    defaults = {"mass": 1.0, "radius": 0.05, "damping": 0.03, "control": "tilt_rate"}
    interval, steps = 0.05, 200
    target = {"target": ("m", 0.3)}
    edge = 0.5
    largest_tilt, largest_rate = 0.1, 0.3

    goal = Goal(
        "success: within 5 cm of the mark throughout the last second; time: until it is so for good",
        arrival="there",
        rules=1,
    )
    reference = "cascade"
    controllers = {
        "PD": Controller(
            "lag_envs.controllers.incline:TiltPD", tune={"frequency": (1.0, 5.0), "lag": (0.05, 0.3)}
        ),
        "cascade": Controller(
            "lag_envs.controllers.incline:TiltCascade", tune={"braking": (0.3, 1.2), "effort": (0.0, 1.0)}
        ),
        "iLQR": Controller("lag_envs.controllers:plan", {"guess": "cascade"}, plans=True),
    }
    hyperparameters = {"off_policy": {"gamma": 0.98, "n_timesteps": 6e4}}
    value_iteration = ValueIteration(
        (
            Axis("x [m]", -0.5, 0.5, 36, scale=0.1, centre="target", level=2),
            Axis("w [m/s]", -1.0, 1.0, 36, scale=0.1),
            Axis("φ [rad]", -0.1, 0.1, 12),
        ),
        targets=(0.0, 0.1, 0.2, 0.3),
        levels=(1, 2, 4),
        lost=0.3,
        mirror="target",
    )
    examples = Examples(
        start={"state": [0.1, -0.2, 0.05], "target": -0.2},
        fast=[0.4, 100.0, 0.1],
        refused=[
            *({"state": state} for state in ([0.6, 0, 0], [0, 0, 0.11], [-0.6, 0, 0])),
            {"target": 0.6},
        ],
        ending=([0.499, 1.0, 0.0], 0.0),
        rest=[0.1, 0.0, 0.0],
        batch={
            "damping": [0.0, 0.03, 5.0, 500.0, 1e5, 0.0, 0.1],
            "target": [0.1, -0.1, 0.0, 0.5, -0.5, 0.2, 0.3],
        },
        variants={"quasi-static": {"control": "tilt"}, "fixed target": {"target": 0.2}},
    )
    difficulty = (
        "Tilting moves the cylinder in two opposite ways: by the slope, and by the plane that carries it. "
        "After tilting too far, the plane cannot be turned back in time to stop."
    )
    note = """
iLQR is best, ahead of the cascade and of the greedy policy of value iteration, whose values are interpolated
between targets. PPO reaches the mark later than the cascade, and stops beside the mark, while the cascade
ends on the mark.
"""

    def check(self) -> None:
        """Refuse the damping control."""
        if self.scene.control == "damping":
            raise ValueError("this task is controlled by 'tilt_rate' or 'tilt', got control='damping'")

    @property
    def quasi_static(self) -> bool:
        """Whether the tilt itself is the control."""
        return self.scene.control == "tilt"

    @property
    def action(self) -> Mapping[str, float]:
        """The tilt [rad], or its rate [rad/s]."""
        return {"phi": self.largest_tilt} if self.quasi_static else {"phi_dot": self.largest_rate}

    @property
    def start(self) -> Mapping[str, float]:
        """Anywhere near, slowly rolling."""
        return {"x": 0.4, "x_dot": 0.3} if self.quasi_static else {"x": 0.4, "w": 0.3, "phi": 0.05}

    def guard(self, wanted: Any, before: Any, dt: Any, xp: Any) -> Any:
        """Return U·a, clipped so that the tilt stays within its limit at the step's end."""
        if self.quasi_static:
            return wanted
        low, high = ((limit - before.phi) * (1.0 / dt) for limit in (-self.largest_tilt, self.largest_tilt))
        return clip(wanted.phi_dot, low, high, xp)

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-((x - x*)/0.1)²) - 0.02 (u/U)²."""
        off = 10.0 * (after.x - target.target)
        effort = control[0] * (1.0 / (self.largest_tilt if self.quasi_static else self.largest_rate))
        return xp.exp(-(off * off)) - 0.02 * (effort * effort)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the cylinder is within 5 cm of the mark."""
        return xp.abs(after.x - target.target) <= 0.05

    def behaviour(self, played: Any) -> Mapping[str, float]:
        """Return the distance from the mark at the end of an episode."""
        off = 1e3 * np.abs(played.states[-1][:, 0] - played.targets)
        return {"off at the end [mm], median": float(np.median(off))}

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the cylinder has left the plane."""
        return xp.abs(after.x) > self.edge

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return the state and the target."""
        return {name: after[name] for name in self.scene.state_names} | {"target": target.target}

    def bounds(self) -> Mapping[str, float]:
        """Return bounds: inside, |w'| <= k (g sin(tilt) + |x| rate²) + drag R rate, and drag only slows."""
        reach, speed = self.edge + 1.0, FASTEST_START
        if self.quasi_static:
            plane = self.coefficients([0.0, 0.0], [self.largest_tilt], np)
            speed += plane.acceleration * self.duration
        else:
            rate, carried = self.largest_rate, self.scene.radius * self.largest_rate
            turn = self.coefficients([0.0, 0.0, 0.0], [rate], np)
            acceleration = (
                turn.gravity * math.sin(self.largest_tilt) + reach * rate * rate + turn.damping_rate * carried
            )
            speed += carried + acceleration * self.duration
        tilt = self.largest_tilt * (1.0 + 1e-6)
        x, v = self.scene.state_names[:2]
        return {x: self.edge + speed * self.dt, v: speed, "target": self.edge} | (
            {} if self.quasi_static else {"phi": tilt}
        )

    def bodies(self) -> Bodies:
        """Return a plank that ends at the edges, with the target and the largest tilt."""
        edge, radius, thick = self.edge, self.scene.radius, 0.04 * self.edge
        floor, side = -9.0 * thick, 2.0 * edge
        corners = [(-edge, 0.0), (edge, 0.0), (edge, -thick), (-edge, -thick)]
        posts = [Line([(x, 0.0), (x, 0.8 * radius)], "limit") for x in (-edge, edge)]
        tilts = [-self.largest_tilt, self.largest_tilt]
        limits = [Line([polar((0.0, 0.0), r * edge, a) for r in (1.03, 1.09)], "limit") for a in tilts]
        sweep = self.limit_control if self.quasi_static else 0.3
        return {
            "goal": [Circle((0.0, 0.0), radius, "target")],
            "ground": [
                Polygon([(-4.0 * thick, floor), (0.0, -0.5 * thick), (4.0 * thick, floor)], "ground"),
                Polygon([(-side, floor), (side, floor), (side, -side), (-side, -side)], "ground"),
                Line([(-1.3 * edge, 0.0), (1.3 * edge, 0.0)], "guide"),
            ],
            "plane": [Polygon(corners, "frame")],
            "cylinder": super().bodies()["cylinder"],
            "turn": [Arrow(arc((0.0, 0.0), 1.15 * edge, 0.0, -sweep))],
            "posts": posts,
            "limits": limits,
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the places of target, plank, limits and an arrow for the tilt or its rate."""
        phi = now.q.phi
        return {
            "goal": self.scene.place(now.target.target, self.scene.radius, phi, xp),
            "plane": (0.0, 0.0, -phi),
            "turn": (0.0, 0.0, 0.0 if self.quasi_static else -phi, now.share[0]),
            "posts": (0.0, 0.0, -phi),
            "limits": (0.0, 0.0),
        }

    def window(self) -> Window:
        """Look at the whole plank."""
        return Window(-1.25 * self.edge, -0.6 * self.edge, 1.25 * self.edge, 0.6 * self.edge)

    def check_target(self, target: Any) -> float:
        """Refuse a target off the plane."""
        target = super().check_target(target)
        if abs(target) > self.edge:
            raise ValueError(f"target must lie on the plane, within ±{self.edge} m, got {target:g} m")
        return target

    def check_start(self, state: Any) -> None:
        """Refuse a start off the plane or beyond the largest tilt."""
        if abs(state.x) > self.edge:
            raise ValueError(
                f"the episode would be over at x={state.x:g} m: |x| must be at most {self.edge} m"
            )
        if not self.quasi_static and abs(state.phi) > self.largest_tilt:
            raise ValueError(f"phi must lie within ±{self.largest_tilt} rad, got {state.phi:g} rad")


class Brake(Task):
    """Let a cylinder roll down to a line by braking it: cross slowly, but soon.

    ## Description

    A solid cylinder rolls without slipping down a slope of 15°. The control is a brake: it sets the
    coefficient of a drag. Let the cylinder cross a line soon, at 0.5 m/s or less. Time and excess speed both
    reduce the return.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step.

    ## Observation Space

    The bounds are proved for every accepted start; starts lie at most 1,000 m before the line.

    ## Rewards

    Each step costs its 0.02 s. The step that crosses the line costs the time to the crossing, plus
    5 (v - 0.5) if the speed v there is above 0.5 m/s. Both are evaluated at the exact crossing, not at the
    step's end.

    ## Starting State

    The cylinder is before the line, which is at x = 0, and does not move uphill.

    ## Episode End

    Termination: the line is crossed.

    ## Arguments

    Any combination of values in these ranges is allowed: every step is taken, and observations stay within
    their space. Anything else is an error that names the value.

    ## Equations

    With the brake fully on, the speed settles at 0.423 m/s.

    ## Signs and Units

    SI units. x is positive down the slope and 0 at the line.

    ## Numerical Accuracy

    The closed form is written so that no digits cancel at any drag. The crossing time is found by Newton's
    method, started just below it.

    ## Known Returns

    The optimum is known: roll freely, then brake fully from the best moment on. No policy exceeds this
    return. `lag_envs.controllers.optimal_return` returns it for any start. The best known policy acts at
    intervals and therefore falls slightly short of the optimum.

    ## Version History

    - v0: first version (lag_envs 0.1.0).
    """

    id = "InclineBrake-v0"
    quantities = {
        "distance": ("m", "distance to the line, -x"),
        "v": ("m/s", "speed x' down the slope"),
        "drag": ("N s/m", "coefficient of the brake"),
    }
    scene: Any = Incline
    defaults = {"mass": 1.0, "radius": 0.05, "tilt": math.radians(15.0), "control": "damping"}
    usable = {"tilt": (0.0, math.pi / 2)}  # otherwise the cylinder would not roll down
    action = {"drag": (0.0, 6.0)}
    start = {"x": (-2.0, 1.0), "x_dot": (0.5, 0.5)}
    scaled = False
    #: Speed that costs nothing at the line [m/s], and what each m/s above it costs.
    gentle, price = 0.5, 5.0

    goal = Goal(
        "success: across the line, at 0.55 m/s at most at the end of that step; time: until then",
        hold=None,
        terminated=True,
        rules=1,
    )
    reference = "switching line"
    controllers = {
        "full damping": Controller("lag_envs.controllers.basic:constant", {"action": 1.0}),
        "best constant": Controller(
            "lag_envs.controllers.basic:constant", {"action": 0.42}, tune={"action": (-1.0, 1.0)}
        ),
        "switching line": Controller(
            "lag_envs.controllers.incline:SwitchingLine", tune={"speed": (0.45, 0.52)}
        ),
    }
    # The decisive reward comes at the line, some hundred steps later.
    hyperparameters = {
        "ppo": {"gamma": 1.0, "gae_lambda": 0.98, "learning_rate": "lin_1e-3"},
        # In trials with a discount, one seed in five stayed far behind the others.
        "fast_ppo": {
            "n_timesteps": 1e6, "gamma": 1.0, "gae_lambda": 0.98, "learning_rate": 2e-3, "n_epochs": 5,
            "reward_scale": 1.0, "episode_share": 1.0, "actor": [64, 64],
        },
        # One step's braking changes the return by less than critics err, so several steps count together.
        "off_policy": {
            "gamma": 0.998, "n_steps": 8, "learning_rate": "lin_2e-3",
            "vec_env_wrapper": [{"lag_envs.sb3.ScaledReward": {"factor": 3.0}}],
            "policy_kwargs": {"noise_steps": 16},
        },
        # Otherwise the actor runs ahead of the critics and ends where its slope vanishes, at full braking.
        "td3": {
            "learning_rate": "lin_1e-3", "gradient_steps": 4, "policy_delay": 8,
            "policy_kwargs": {"noise_steps": 16, "noise": 0.3},
        },
    }  # fmt: skip
    value_iteration = ValueIteration(
        # On the line the episode is over, so the grid ends just before it.
        (
            Axis("x [m]", -3.0, -1e-6, 80, scale=0.3, centre=-1e-6, level=4),
            Axis("x' [m/s]", 0.0, 3.4, 80, scale=0.5, centre=0.5, level=4),
        ),
        lost=0.1,
    )
    optimum = Optimum(
        "lag_envs.controllers:optimal_return",
        "with the brake off, then fully on from the best moment",
    )
    examples = Examples(
        start={"state": [-1.5, 0.4]},
        fast=[-1e3, 100.0],
        refused=[{"state": state} for state in ([0.1, 0.5], [0.0, 0.5], [-1.0, -0.1], [-2e3, 0])],
        ending=([-0.001, 1.0], -1.0),
        batch={
            "tilt": [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 1.5],
            "damping": [0.0, 0.03, 5.0, 500.0, 1e5, 0.0, 0.1],
        },
    )
    difficulty = (
        "Braking early wastes time, and with late braking the cylinder crosses too fast. The best policy "
        "switches once, at a place that depends on the initial speed."
    )
    note = """
The switching line is best: roll freely, then brake fully along the curve that meets the line at the right
speed. It is slightly below the optimum, which may switch in the middle of a step. It beats the greedy policy
of value iteration, whose grid smears the moment of switching. PPO has found the same strategy, but usually
crosses a little too early and too fast, which costs more than the time it saves. The PPO in one file is as
good, without a discount and with twice as many steps. SAC and TQC get most of the way with a fifth of PPO's
steps. They need returns over several steps. TD3 does not get as far. Unless its actor learns much more slowly
than its critics, it soon brakes fully everywhere, and never stops doing so.
"""

    def check(self) -> None:
        """Refuse the other controls."""
        if self.scene.control != "damping":
            raise ValueError(f"this task is controlled by 'damping', got control={self.scene.control!r}")

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return minus the time that the step takes."""
        return -dt

    def crossing(self, before: Any, control: Any, dt: Any, xp: Any) -> tuple[Any, Any]:
        """Return the time to the line, and the speed there; from behind the line, those at the line."""
        force = self.coefficients(before, control, xp)
        place = xp.minimum(before.x, -1e-30)  # at rest on the line, the time would be 0/0
        time = slope.crossing_time(place, before.x_dot, force, dt, xp)
        # Integrating x'' = acceleration - damping_rate x' up to the line gives the speed there.
        return time, before.x_dot + force.acceleration * time + force.damping_rate * place

    def last_reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return minus the time to the line, minus the price of excess speed there."""
        time, speed = self.crossing(before, control, dt, xp)
        return -time - self.price * xp.maximum(speed - self.gentle, 0.0)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the cylinder is across the line, slowly."""
        return (after.x >= 0.0) & (after.x_dot <= 0.55)

    def behaviour(self, played: Any) -> Mapping[str, float]:
        """Return when and how fast the line is crossed."""
        last, each = played.steps - 1, np.arange(len(played.steps))
        before = self.formulas.named_state(played.states[last, each].T)
        control = self.limit_control * (0.5 + 0.5 * np.clip(played.actions[last, each, 0], -1.0, 1.0))
        with np.errstate(divide="ignore", invalid="ignore"):  # without a brake, in branches not taken
            time, speed = self.crossing(before, [control], self.dt, np)
        low, middle, high = np.quantile(speed, [0.05, 0.5, 0.95])
        return {
            "across after [s]": float(np.mean(last * self.dt + time)),
            "speed there, lowest twentieth [m/s]": float(low),
            "median [m/s]": float(middle),
            "highest twentieth [m/s]": float(high),
            "price of the speed": self.price * float(np.maximum(speed - self.gentle, 0.0).mean()),
        }

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the line has been crossed."""
        return after.x >= 0.0

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return distance to the line and speed."""
        return {"distance": -after.x, "v": after.x_dot}

    def bounds(self) -> Mapping[str, float]:
        """Return bounds; a start may lie at most 1000 m away."""
        speed = FASTEST_START + self.coefficients([0.0, 0.0], [0.0], np).acceleration * self.duration
        return {"distance": 1e3 + speed * self.duration, "v": speed}

    def bodies(self) -> Bodies:
        """Return the slope with the line, and the cylinder magnified."""
        radius, shapes = self.scene.radius, self.scene.bodies(-3.0, self._length + 3.0)
        line = Line([(0.0, 0.0), (0.0, 6.0 * radius)], "target")
        return {**shapes, "line": [line], "glass": [Magnifier((0.0, 0.0), 2.2 * radius)]}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the places of line and cylinder; the ground begins before both of them."""
        scene, x, phi = self.scene, now.q.x, now.q.phi
        start = xp.minimum(-3.2, x - 0.2)
        return {
            **super().indicators(now, xp),
            "hill": (*scene.place(start, 0.0, phi, xp), -phi),
            "line": (0.0, 0.0, -phi),
            "glass": scene.place(x, scene.radius, phi, xp),
        }

    #: Visible length of the slope [m].
    _length = 3.6

    def window(self) -> Window:
        """Look at the last metres before the line, or at those around a cylinder that is farther away."""
        near, far = (self.scene.place(x, self.scene.radius, self.scene.tilt) for x in (0.0, self._length))
        return Window(near[0], far[1], far[0], near[1], "hill")

    def readings(self, now: Frame) -> list[Reading]:
        """Return the speed at which the line should be crossed."""
        return [Reading("x_dot*", self.gentle, "m/s", "target")]

    def check_start(self, state: Any) -> None:
        """Refuse a start beyond the line, or uphill."""
        if not -1e3 <= state.x < 0.0:
            raise ValueError(f"x must lie before the line at 0 m, at -1000 m or later, got {state.x:g} m")
        if state.x_dot < 0.0:
            raise ValueError(f"x_dot must be at least 0 m/s, got {state.x_dot:g} m/s")
