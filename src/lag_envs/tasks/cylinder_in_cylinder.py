"""Hold, pump or calm a cylinder that rolls inside another one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lag_envs.scenes import CylinderInCylinder
from lag_envs.scenes.shapes import Bodies, Circle, Frame, Line, Reading
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import FASTEST_START, Task
from lag_envs.tasks.record import Axis, Controller, Examples, Goal, ValueIteration

#: For steps of 0.05 s, so that the horizon of 1/(1 - gamma) steps keeps its length in seconds.
_PPO = {"gamma": 0.98, "gae_lambda": 0.95}

#: The observed quantities with their units.
_ROLLING = {"theta": ("rad", "angle of the small cylinder's axis"), "theta_dot": ("rad/s", "its rate")}
_SHELL = {
    **_ROLLING,
    "psi_dot": ("rad/s", "rate of the shell"),
    "psi_ddot": ("rad/s²", "acceleration of the shell"),
}


class _Shell(Task):
    """What the two tasks that turn the shell share."""

    scene: Any = CylinderInCylinder
    interval, steps = 0.05, 200
    start = {"theta": 0.1, "theta_dot": 0.2}  # near the bottom, the shell at rest
    largest: float  # acceleration of the shell [rad/s²]
    fastest_shell: float
    largest_angle: float

    def check(self) -> None:
        """Refuse the damping control."""
        if self.scene.control != "tilt":
            raise ValueError(f"this task is controlled by 'tilt', got control={self.scene.control!r}")

    @property
    def action(self) -> Mapping[str, float]:
        """The shell's acceleration."""
        return {"psi_ddot": self.largest}

    @property
    def edges(self) -> Sequence[Sequence[float]]:
        """The shell turning at its fastest, in either direction."""
        return [[0.0, 0.0, rate] for rate in (-self.fastest_shell, self.fastest_shell)]

    def guard(self, wanted: Any, before: Any, dt: Any, xp: Any) -> Any:
        """Return U·a, clipped so that the shell's rate stays within its limit at the step's end."""
        low, high = (
            (rate - before.psi_dot) * (1.0 / dt) for rate in (-self.fastest_shell, self.fastest_shell)
        )
        return clip(wanted.psi_ddot, low, high, xp)

    @property
    def fastest(self) -> float:
        """Speed from a fall, from a change of the shell's rate between its limits, and from drag [rad/s]."""
        coeffs = self.coefficients([0.0, 0.0, 0.0], [1.0], np)
        return float(2.0 * math.sqrt(coeffs.alpha) + (2.0 * coeffs.delta + 1.0) * self.fastest_shell)

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the cylinder has been carried too high."""
        return xp.abs(after.theta) > self.largest_angle

    def bounds(self) -> Mapping[str, float]:
        """Return bounds on θ, θ' and ψ'; |θ'| grows by at most (weight + gain U + drag ψ') a second."""
        strongest = self.coefficients([0.0, 0.0, self.fastest_shell], [self.largest], np)
        swing = FASTEST_START + (strongest.alpha + strongest.delta) * self.duration
        return {
            "theta": self.largest_angle + swing * self.dt,
            "theta_dot": swing,
            "psi_dot": self.fastest_shell * (1.0 + 1e-6),
        }

    def bodies(self) -> Bodies:
        """Add the limits of the cylinder's angle."""
        scene, limits = self.scene, (-self.largest_angle, self.largest_angle)
        inner = scene.shell_radius - scene.radius
        lines = [Line([scene.place(a, inner), scene.place(a, scene.shell_radius)], "limit") for a in limits]
        return {**super().bodies(), "limits": lines}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add the places of the limits."""
        return {**super().indicators(now, xp), "limits": (0.0, 0.0)}

    def check_start(self, state: Any) -> None:
        """Refuse a start at which the episode would be over, or with the shell too fast."""
        if abs(state.theta) > self.largest_angle:
            raise ValueError(
                f"the episode would be over at theta={state.theta:g} rad: "
                f"|theta| must be at most {self.largest_angle} rad"
            )
        if abs(state.psi_dot) > self.fastest_shell:
            raise ValueError(
                f"psi_dot must lie within ±{self.fastest_shell} rad/s, got {state.psi_dot:g} rad/s"
            )


class Tilt(_Shell):
    """Hold a cylinder at an angle inside a shell by turning the shell.

    ## Description

    A solid cylinder rolls without slipping inside a larger hollow one, the shell. The shell is filled with a
    medium that turns with the shell and drags the small cylinder along. Turn the shell to bring the small
    cylinder to an angle and keep it at this angle.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step.

    The control is clipped so that |ψ'| is at most 6 rad/s at the step's end.

    ## Observation Space

    The bounds are proved for every accepted start.

    ## Rewards

    Each step pays exp(-((θ - θ*)/0.1)²) - 0.02 (u/15)², taken at its end; θ* is the angle to hold, u the
    control that was applied. With another `dt` rewards are scaled by dt/0.05.

    ## Starting State

    Near the bottom, the shell at rest. Given starts must lie inside the limits.

    ## Episode End

    Termination: |θ| > 1.05 rad at a step's end.

    ## Arguments

    `control` must be "tilt". A target must lie within ±1.05 rad.

    Any combination of values in these ranges is allowed as long as the step is short enough for the swing: (2
    √(k g/a) + (2 k I R/(m r² a) + 1) 6 rad/s) dt must be at most 5,000 rad, with a = R - r and k = 1/(1 +
    I/(m r²)). Then no step is refused, and observations stay within their space. Anything else is an error
    that names the value.

    ## Equations

    A round shell has no orientation: a static tilt does nothing. Its acceleration drives the cylinder, and
    its rate drags it along.
    To hold the cylinder at 0.3 rad the shell must turn at 4.83 rad/s.

    ## Signs and Units

    SI units. θ = 0 is at the bottom. θ and ψ grow counter-clockwise and are not wrapped.

    ## Known Returns

    The optimum is not known. docs/agents.md has the estimate of value iteration.

    ## Version History

    - v0: first version (lag_envs 0.1.0).
    """

    id = "CylinderInCylinderTilt-v0"
    quantities = {**_SHELL, "target": ("rad", "the angle θ* to hold")}
    defaults = {"mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "damping": 0.24, "control": "tilt"}
    target = {"target": ("rad", 0.3)}
    largest, fastest_shell, largest_angle = 15.0, 6.0, 1.05

    goal = Goal(
        "success: within 0.05 rad of the target throughout the last second; time: until it is so for good",
        arrival="there",
        rules=1,
    )
    reference = "LQR"
    controllers = {
        "PD": Controller(
            "lag_envs.controllers.cylinder_in_cylinder:ShellPD",
            tune={"frequency": (2.0, 30.0), "lag": (0.05, 0.6)},
        ),
        "LQR": Controller("lag_envs.controllers.cylinder_in_cylinder:TiltLQR", tune={"effort": (0.0, 0.5)}),
        "iLQR": Controller("lag_envs.controllers:plan", {"guess": "LQR"}, plans=True),
    }
    hyperparameters = {
        "ppo": _PPO,
        "off_policy": {"gamma": 0.98, "n_timesteps": 6e4},
    }
    value_iteration = ValueIteration(
        (
            Axis("θ [rad]", -1.05, 1.05, 30, scale=0.05, centre="target"),
            Axis("θ' [rad/s]", -4.0, 4.0, 30, scale=1.0),
            Axis("ψ' [rad/s]", -6.0, 6.0, 16),
        ),
        targets=(0.0, 0.15, 0.3),
        levels=(1, 2, 4),
        lost=0.3,
        mirror="target",
    )
    examples = Examples(
        start={"state": [0.3, -0.2, 1.0], "target": -0.4},
        fast=[1.0, 100.0, 6.0],
        refused=[
            *({"state": state} for state in ([1.1, 0, 0], [0, 0, 6.1], [-1.1, 0, 0])),
            {"target": 1.2},
        ],
        ending=([1.049, 1.0, 0.0], 0.0),
        reach=6.0,
        rest=[0.3, 0.0, 16.35 * math.sin(0.3)],
        batch={
            "radius": [0.1, 0.4, 0.49, 0.499, 1e-3, 0.1, 0.2],
            "damping": [0.0, 0.24, 5.0, 500.0, 1e5, 0.0, 0.1],
        },
        variants={"fixed target": {"target": -0.4}},
    )
    difficulty = (
        "The shell drags the cylinder along only while it turns, and to hold an angle it has to keep "
        "turning at a constant rate; the cylinder swings about that angle with little damping."
    )
    note = """
iLQR is best; LQR, PD and the greedy policy of value iteration are close behind. Among the learners TD3 and
SAC are better than PPO, with far fewer steps. They reach the target nearly as soon as the controllers. Most
of their loss comes afterwards: they stop beside the target, while the controllers end on the target.
"""

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-((θ - θ*)/0.1)²) - 0.02 (u/U)²."""
        off = 10.0 * (after.theta - target.target)
        effort = control.psi_ddot * (1.0 / self.largest)
        return xp.exp(-(off * off)) - 0.02 * (effort * effort)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the angle is within 0.05 rad of the target."""
        return xp.abs(after.theta - target.target) <= 0.05

    def behaviour(self, played: Any) -> Mapping[str, float]:
        """Return the distance from the target at the end of an episode."""
        off = 1e3 * np.abs(played.states[-1][:, 0] - played.targets)
        return {"off at the end [mrad], median": float(np.median(off))}

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return θ, θ', ψ' and the target."""
        return {name: after[name] for name in self.scene.state_names} | {"target": target.target}

    def bounds(self) -> Mapping[str, float]:
        """Return bounds on the observation."""
        return {**super().bounds(), "target": self.largest_angle}

    def bodies(self) -> Bodies:
        """Add the target."""
        return {**super().bodies(), "goal": [Circle((0.0, 0.0), self.scene.radius, "target")]}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add the place of the target."""
        return {**super().indicators(now, xp), "goal": self.scene.place(now.target.target, xp=xp)}

    def check_target(self, target: Any) -> float:
        """Refuse a target at which the episode would be over."""
        target = super().check_target(target)
        if abs(target) > self.largest_angle:
            raise ValueError(f"target must lie within ±{self.largest_angle} rad, got {target:g} rad")
        return target


class Pump(_Shell):
    """Pump a cylinder rolling inside a shell up to a given energy by turning the shell, and keep it there.

    ## Description

    A solid cylinder rolls inside a shell, with little drag and a weak drive. Pump its swing to the energy of
    an amplitude of 0.9 rad, and keep it at this energy. One push is not enough: the drive has to follow the
    swing.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step.

    The control is clipped so that |ψ'| is at most 3 rad/s at the step's end.

    ## Observation Space

    The bounds are proved for every accepted start.

    ## Rewards

    Each step pays exp(-|E - E*|/(0.3 E*)) - 0.02 (u/4)², taken at its end; u is the control that was applied.
    E = θ'²/2 + ω₀² (1 - cosθ) is the energy per inertia, where ω₀² = k g/a. E* = 6.187/s² is the energy of
    the wanted amplitude. With another `dt` rewards are scaled by dt/0.05.

    ## Starting State

    Near the bottom, the shell at rest. Given starts must lie inside the limits.

    ## Episode End

    Termination: |θ| > 1.3 rad at a step's end.

    ## Arguments

    `control` must be "tilt".

    Any combination of values in these ranges is allowed as long as the step is short enough for the swing: (2
    √(k g/a) + (2 k I R/(m r² a) + 1) 3 rad/s) dt must be at most 5,000 rad, with a = R - r and k = 1/(1 +
    I/(m r²)). Then no step is refused, and observations stay within their space. Anything else is an error
    that names the value.

    ## Equations

    A round shell has no orientation: a static tilt does nothing. Its acceleration drives the cylinder, and
    its rate drags it along.

    ## Signs and Units

    SI units. θ = 0 is at the bottom. θ and ψ grow counter-clockwise and are not wrapped.

    ## Known Returns

    The optimum is not known. docs/agents.md has the estimate of value iteration.

    ## Version History

    - v0: first version (lag_envs 0.1.0).
    """

    id = "CylinderInCylinderPump-v0"
    quantities = _SHELL
    defaults = {"mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "damping": 0.024, "control": "tilt"}
    usable = {"gravity": (1e-3, 1e6)}  # without gravity the amplitude has no energy
    largest, fastest_shell, largest_angle = 4.0, 3.0, 1.3
    amplitude = 0.9
    order = 15  # within the limits no step is divided; order 14 would divide the fastest

    goal = Goal(
        "success: energy within 20 % of the wanted one throughout the last second; time: until it is so for "
        "good",
        arrival="within 20 % of the energy",
        rules=1,
    )
    reference = "energy pump"
    controllers = {
        "energy pump": Controller(
            "lag_envs.controllers.cylinder_in_cylinder:EnergyPump",
            tune={"pump": (5.0, 60.0), "centring": (0.0, 3.0)},
        ),
        "iLQR": Controller("lag_envs.controllers.cylinder_in_cylinder:plan_pumping", plans=True),
    }
    hyperparameters = {
        "ppo": {**_PPO, "n_timesteps": 8e5, "normalize": True},
        "fast_ppo": {
            "n_timesteps": 5e6, "n_epochs": 5, "reward_scale": 1.0, "episode_share": 1.0, "actor": [64, 64],
        },
        # A push pays only some steps later, but costs at once.
        "off_policy": {"gamma": 0.98, "n_steps": 4, "gradient_steps": 2, "learning_rate": "lin_2e-3"},
    }  # fmt: skip
    value_iteration = ValueIteration(
        (
            Axis("θ [rad]", -1.3, 1.3, 56, level=2),
            Axis("θ' [rad/s]", -4.4, 4.4, 56, level=2),
            Axis("ψ' [rad/s]", -3.0, 3.0, 6, level=2),
        ),
        levels=(1, 2, 4),
        lost=0.1,
        mirror="theta",
    )
    examples = Examples(
        start={"state": [0.3, -0.2, 1.0]},
        fast=[1.0, 100.0, 3.0],
        refused=[{"state": state} for state in ([1.4, 0, 0], [0, 0, -3.1])],
        ending=([1.299, 2.0, 0.0], 0.0),
        reach=6.0,
        rest=[0.0, 0.0, 0.0],
        batch={
            "gravity": [9.81, 1.6, 100.0, 1e3, 9.81, 9.81, 9.81],
            "damping": [0.0, 0.2, 5.0, 500.0, 1e5, 0.0, 0.1],
        },
    )
    difficulty = (
        "The drive is weak: it has to push in time with the swing for many periods, and to stop pumping "
        "when the energy is right."
    )
    note = """
The greedy policy of value iteration is best. Doing nothing is a local optimum: every action costs effort
before it pays. The PPO in one file escapes it with enough steps, and is then as good as the energy pump. TD3
reaches the target energy as soon as the energy pump does, and then spends more effort on keeping it. PPO gets
there later, except for one seed, and keeps the energy with less effort than TD3. TQC and SAC are not quite as
good as these two.
"""

    def energies(self, state: Any, xp: Any) -> tuple[Any, Any]:
        """Return E = θ'²/2 + ω₀² (1 - cosθ), and E* of the amplitude 0.9 rad, per inertia [1/s²]."""
        weight = self.coefficients([0.0] * 5, [0.0], xp).alpha
        energy = 0.5 * (state[1] * state[1]) + weight * (1.0 - xp.cos(state[0]))
        return energy, weight * (1.0 - math.cos(self.amplitude))

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-|E - E*|/(0.3 E*)) - 0.02 (u/U)²."""
        energy, wanted = self.energies(after, xp)
        effort = control.psi_ddot * (1.0 / self.largest)
        off = xp.abs(energy - wanted) * (1.0 / (0.3 * wanted))
        return xp.exp(-off) - 0.02 * (effort * effort)

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the energy is within 20 % of the wanted one."""
        energy, wanted = self.energies(after, xp)
        return xp.abs(energy - wanted) <= 0.2 * wanted

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return θ, θ', ψ'."""
        return {name: after[name] for name in self.scene.state_names}

    def bodies(self) -> Bodies:
        """Add the turning points of a swing of the wanted energy."""
        places = [self.scene.place(a) for a in (-self.amplitude, self.amplitude)]
        marks = [Circle(place, self.scene.radius, "target") for place in places]
        shapes = super().bodies()
        return {**shapes, "limits": [*shapes["limits"], *marks]}

    def readings(self, now: Frame) -> list[Reading]:
        """Return the energy per inertia, and the wanted energy."""
        energy, wanted = self.energies(now.state, np)
        return [Reading("E", float(energy), "1/s²"), Reading("E*", float(wanted), "1/s²", "target")]


class Damping(Task):
    """Calm a kicked cylinder inside a fixed shell by braking it.

    ## Description

    A solid cylinder rolls without slipping inside a fixed hollow one. The control is a brake: it sets the
    coefficient of a drag that removes energy. Kicks add energy again. Bring the cylinder to rest at the
    bottom. Braking as hard as possible is not optimal, because it makes the cylinder creep.

    ## Action Space

    `Box(-1, 1, (1,), float32)`. Values outside are clipped. The control is held for one step. The action -1
    releases the brake.

    ## Observation Space

    The bounds are proved for every accepted start, even with a kick in every step.

    ## Rewards

    Each step pays exp(-√(θ² + θ'²/ω₀²)/0.1), evaluated at the end of the step and before a kick, with ω₀ =
    √(k g/a) = 4.0435/s. With another `dt` rewards are scaled by dt/0.02.

    ## Starting State

    The cylinder is high on the wall and moving. For given starts there must be contact, and |θ| must be at
    most 1,000 rad.

    After each step, with probability 0.01 (1 - 0.99^(dt/0.02) for another `dt`), a kick changes θ' by -3,
    -1.5, 1.5 or 3 rad/s, each equally likely.

    ## Episode End

    Termination: contact is lost, that is, N = m (a θ'² + g cosθ) < 0 at a step's end.

    ## Arguments

    `control` must be "damping"; `damping` is a constant drag that is added to the drag of the brake.

    Any combination of values in these ranges is allowed as long as the step is short enough for the swing: 2
    √(k g/a) dt must be at most 5,000 rad, with a = R - r and k = 1/(1 + I/(m r²)). Every step is then taken,
    and observations stay within their space. Anything else is an error that names the value.

    ## Equations

    The motion is overdamped if the drag slows it at a rate of 2 ω₀ = 8.1/s or more.

    ## Signs and Units

    SI units. θ = 0 is at the bottom; θ grows counter-clockwise and is not wrapped.

    ## Known Returns

    The optimum is not known. docs/agents.md has the estimate of value iteration.

    ## Version History

    - v0: first version (lag_envs 0.1.0).
    """

    id = "CylinderInCylinderDamping-v0"
    quantities = {**_ROLLING, "drag": ("N m s", "coefficient of the brake")}
    scene: Any = CylinderInCylinder
    defaults = {"mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "control": "damping"}
    usable = {"gravity": (1e-3, 1e6)}  # without a field nothing holds the cylinder in the shell
    action = {"drag": (0.0, 2.4)}
    start = {"theta": 0.8, "theta_dot": 1.0}  # high on the wall, moving
    draws = 2

    goal = Goal(
        "success: never loses contact in 10 s; time: until it comes to rest first, √(θ² + θ'²/ω₀²) <= 0.1",
        hold=None,
        terminated=None,
        rules=1,
    )
    reference = "switching line"
    controllers = {
        "full damping": Controller("lag_envs.controllers.basic:constant", {"action": 1.0}),
        "best constant": Controller(
            "lag_envs.controllers.basic:constant", {"action": 0.38}, tune={"action": (-1.0, 1.0)}
        ),
        "switching line": Controller(
            "lag_envs.controllers.cylinder_in_cylinder:BrakingLine",
            tune={"steepness": (0.6, 1.2), "sharpness": (1.0, 30.0)},
        ),
    }
    hyperparameters = {
        "ppo": {**_PPO, "n_timesteps": 8e5},
        "fast_ppo": {
            "n_timesteps": 2e6, "learning_rate": 8e-3, "n_steps": 128, "n_epochs": 5, "batch_size": 2048,
            "reward_scale": 1.0, "log_std_init": 0.5, "actor": [64, 64], "critic": [128, 128],
            "first_layer_scale": 3.0,
        },
        # The reward comes near rest, some swings later.
        "off_policy": {"n_steps": 4, "learning_rate": "lin_2e-3"},
        "td3": {"learning_rate": "lin_1e-3", "gradient_steps": 2, "policy_kwargs": {"noise": 0.3}},
    }  # fmt: skip
    value_iteration = ValueIteration(
        (
            Axis("θ [rad]", -2.5, 2.5, 80, scale=0.03, level=4),
            Axis("θ' [rad/s]", -9.0, 9.0, 80, scale=0.1, level=4),
        ),
        kick_sizes=4,
        lost=0.1,
        mirror="theta",
    )
    examples = Examples(
        start={"state": [0.3, -0.2]},
        moving=[3.0, 7.0],  # soon loses contact
        fast=[0.5, 100.0],
        refused=[{"state": state} for state in ([3.0, 0.0], [2e3, 20.0])],
        ending=([2.0, 3.4], 1.0),
        reach=8.0,
        rest=[0.0, 0.0],
        batch={
            "gravity": [9.81, 1.6, 100.0, 1e3, 9.81, 9.81, 9.81],
            "damping": [0.0, 0.2, 5.0, 500.0, 1e5, 0.0, 0.1],
        },
    )
    difficulty = (
        "Too little drag lets the cylinder swing on, too much drag makes it creep, and too much speed makes "
        "it leave the shell, so the best drag changes with the motion."
    )
    note = """
The greedy policy of value iteration is best. The switching line is as good within the uncertainty of these
episodes: it releases the brake, and brakes fully as soon as full braking leads straight to rest. PPO is near
rest for as much of the time as the switching line, but very close to rest for less of the time, because its
network does not resolve the corner of the line. The PPO in one file, with more steps, is the best learner.
TQC is as good as PPO within the uncertainty, with far fewer steps; SAC and TD3 are worse.
"""

    def check(self) -> None:
        """Refuse the other control."""
        if self.scene.control != "damping":
            raise ValueError(f"this task is controlled by 'damping', got control={self.scene.control!r}")

    def omega0_squared(self, xp: Any = np) -> Any:
        """Return ω₀², the square of small swings' angular frequency [1/s²]."""
        return self.coefficients([0.0] * 4, [0.0], xp).alpha

    @property
    def fastest(self) -> float:
        """Speed of a fall [rad/s]."""
        return 2.0 * math.sqrt(self.omega0_squared())

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return exp(-√(θ² + θ'²/ω₀²)/0.1)."""
        theta, rate = after.theta, after.theta_dot
        return xp.exp(-10.0 * xp.sqrt(theta * theta + (rate * rate) * (1.0 / self.omega0_squared(xp))))

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the cylinder is near rest."""
        return after.theta * after.theta + after.theta_dot * after.theta_dot / self.omega0_squared() <= 0.1**2

    def behaviour(self, played: Any) -> Mapping[str, float]:
        """Return the shares of time in which the cylinder is near rest, and very near."""
        theta, rate = played.states[1:, :, 0], played.states[1:, :, 1]
        distance = np.hypot(theta, rate / np.sqrt(self.omega0_squared()))
        going_on = np.arange(len(theta))[:, None] < played.steps
        shares = {size: 100.0 * float((distance[going_on] <= size).mean()) for size in (0.1, 0.01)}
        return {f"time within {size:g} of rest [%]": share for size, share in shares.items()}

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the contact is lost: aθ'² + g cosθ < 0."""
        hold = self.scene.gravity / self.scene.arm
        return after.theta_dot * after.theta_dot + hold * xp.cos(after.theta) < 0.0

    def kick(self, after: Any, draws: Any, xp: Any) -> Mapping[str, Any]:
        """Occasionally change θ' by ±1.5 or ±3 rad/s."""
        size = xp.where(draws[1] < 0.5, 1.5, 3.0)
        kick = xp.where((draws[1] < 0.25) | (draws[1] >= 0.75), -size, size)
        return {"theta_dot": xp.where(draws[0] < self.chance(0.01), kick, 0.0)}

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return θ and θ'."""
        return {"theta": after.theta, "theta_dot": after.theta_dot}

    def bounds(self) -> Mapping[str, float]:
        """Return bounds: θ' grows by at most ω₀² a second and 3 rad/s a kick."""
        swing = FASTEST_START + self.omega0_squared() * self.duration + 3.0 * self.limit
        return {"theta": 1e3 + swing * self.duration, "theta_dot": swing}

    def bodies(self) -> Bodies:
        """Add the place of rest."""
        return {**super().bodies(), "goal": [Circle(self.scene.place(0.0), self.scene.radius, "target")]}

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Add the frame of the place of rest."""
        return {**super().indicators(now, xp), "goal": (0.0, 0.0)}

    def check_start(self, state: Any) -> None:
        """Refuse a start without contact."""
        theta, theta_dot = state.theta, state.theta_dot
        normal = self.scene.forces([theta, theta_dot])["normal"]
        if normal < 0.0:
            raise ValueError(
                f"there is no contact at theta={theta:g} rad, theta_dot={theta_dot:g} rad/s: N={normal:g} N"
            )
        if abs(theta) > 1e3:
            raise ValueError(f"theta must lie within ±1000 rad at the start, got {theta:g} rad")
