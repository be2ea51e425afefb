"""Swing a bar up by moving its support, and keep it up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes import PivotedBar
from lag_envs.scenes.shapes import Line, Moment, Polygon, Shape, Window, polar
from lag_envs.stepping.tracing import clip
from lag_envs.tasks.base import FASTEST_START, Task, finite, kick_chance


def _speed_bound(task: Task, limit: float) -> float:
    """Return a bound on |theta'| in an episode: start + (|field| + |drive|) · length; damping only helps."""
    k = task.scene.constants()
    return FASTEST_START + (k["weight"] + k["pull"] * limit) * task.duration


class SwingUp(Task):
    """Swing a bar up by moving its support, and hold it upright.

    ## Description

    A uniform bar hangs from a support. The support is accelerated to and fro; the bar is to be swung up and
    kept upright. With a track (`PivotedBar-v0`) the support has half a metre to either side; without one
    (`PivotedBarFree-v0`, the same class with `track=None`) its place and speed are no part of the task.

    ## Action Space

    `Box(-1, 1, (1,), float32)`; finite values outside are clipped. The control is held for one step.

    | Num | Control | Unit | At -1 | At 1 |
    | --- | ------- | ---- | ----- | ---- |
    | 0 | acceleration u = s'' of the support, 5 times the action | m/s² | -5 | 5 |

    With a track, the control applied is the one nearest to 5 times the action from which the support can
    still stop inside the track by braking at 5 m/s²; read it as `env.unwrapped.control`.

    ## Observation Space

    `Box` of float32. The bounds are proved for every start that is accepted. Without a track the first two
    rows are missing.

    | Num | Observation | Quantity | Unit | Min | Max |
    | --- | ----------- | -------- | ---- | --- | --- |
    | 0 | s/S | place of the support over S = 0.5 m | 1 | -1.000 | 1.000 |
    | 1 | s_dot/2 | speed of the support, halved | m/s | -1.118 | 1.118 |
    | 2 | cos(theta) | cosine of the bar's angle | 1 | -1 | 1 |
    | 3 | sin(theta) | sine of it | 1 | -1 | 1 |
    | 4 | theta_dot/8 | angular velocity, over 8 | rad/s | -58.78 | 58.78 |

    ## Rewards

    h² - 0.02 (u/5)² for each step, where h = (1 - cosθ)/2 is 0 hanging and 1 upright, taken at the step's
    end, and u is the control applied. The square keeps a spinning bar from paying (3/8 of the optimum). For
    another `dt` it is scaled by dt/0.02, so that a second is worth the same.

    ## Starting State

    Uniform, hanging nearly at rest; or `reset(options={"state": [s, s_dot, theta, theta_dot]})` (without a
    track `[theta, theta_dot]`). A start from which the support cannot stop inside the track is refused.

    | State | Unit | Centre | To either side |
    | ----- | ---- | ------ | -------------- |
    | s | m | 0 | 0.05 |
    | s_dot | m/s | 0 | 0.02 |
    | theta | rad | 0 | 0.1 |
    | theta_dot | rad/s | 0 | 0.1 |

    The half width of s is a tenth of the track's.

    ## Episode End

    Termination: never; the track's ends are guarded, see above. Truncation: after 500 steps (10 s).

    ## Arguments

    | Keyword | Default | Unit | Range | Meaning |
    | ------- | ------- | ---- | ----- | ------- |
    | mass | 0.2 | kg | 1e-6 to 1e6 | mass m |
    | com_distance | 0.3 | m | 1e-9 to 1e9 | distance L from pivot to centre of mass, half of the length |
    | inertia | 0.006 | kg m² | 0 to 1e27 | moment of inertia I about the centre of mass; None: mL²/3 |
    | damping | 0.001 | N m s | 0 to 1e9 | coefficient b of the pivot's torque -bθ' |
    | gravity | 9.81 | m/s² | 0 to 1e6 | field g, downward |
    | track | 0.5 | m | 1e-3 to 1e9 | travel S to either side; `math.inf`: no end (S = 0.5 m); None: none |
    | dt | 0.02 | s | 1e-6 to 1 | control interval; the episode keeps its seconds |
    | duration | 10 | s | dt or more | length of an episode, `math.inf` for one without an end |

    Each may lie anywhere in its range, whatever the others, as long as a step is not too long for the swing:
    2 √((g + 5 m/s²) m L/J) dt is at most 5,000 rad. Then every step is taken, and observations stay within
    their space. Outside, an error names it.

    Also `render_mode`, and `diagnostics=True` for support forces and energy in `info`.

    ## Equations

    With J = mL² + I:

        θ'' = -(m L (u cosθ + g sinθ) + b θ')/J = -24.525 sinθ - 2.5 u cosθ - 0.041667 θ'
        s'' = u

    The numbers are those of the default parameters. The support is moved by a drive that is strong enough:
    the bar does not act back on it.

    ## Signs and Units

    SI units. θ = 0 hangs straight down, θ = π stands; positive counter-clockwise, not wrapped. s is
    positive to the right, 0 in the middle of the track. The state is float64: `env.unwrapped.state`.

    ## Numerical Accuracy

    Taylor series of order 14. One series is certified to leave out at most 1e-12 rad/s while |θ'| is at
    most 13.2 rad/s, whatever the control; above that the step is divided, by the same bound. Every step of
    whole episodes under random actions, against 40 digits: below 1e-15 of the state's size
    (docs/numerics.md). s and s' are exact to rounding.

    ## Optimal Value

    Not known. The best policy known is a plan by iLQR on the exact model (`python -m agents.scale`
    measures it, in episodes of its own); what value iteration estimates of the optimum, tells
    docs/agents.md. Mean returns ± standard errors, of the other policies over 4,096 episodes:

    | Id | Random actions | Zero control | Best known |
    | -- | -------------- | ------------ | ---------- |
    | PivotedBar-v0 | -0.779 ± 0.072 | 0.0002 ± 0.0000 | 418.987 ± 0.012 |
    | PivotedBarFree-v0 | -2.426 ± 0.025 | 0.0002 ± 0.0000 | 422.490 ± 0.013 |

    `make demo` trains an agent and shows what it and a classical controller reach.

    ## Version History

    - v0: first version (lag_envs 0.1.0).
    """

    scene: PivotedBar
    scene_type = PivotedBar
    defaults: ClassVar = {"mass": 0.2, "com_distance": 0.3, "damping": 0.001}
    usable: ClassVar = {"track": (1e-3, 1e9)}
    limit_control = 5.0

    @property
    def has_track(self) -> bool:
        """Whether the support's place is part of the task."""
        return self.scene.track is not None

    @property
    def variant(self) -> tuple:
        """Add whether there is an end of the track to guard."""
        return *super().variant, self.scene.track == math.inf

    @property
    def observation(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the observation's entries."""
        return (*(("s/S", "s_dot/2") if self.has_track else ()), "cos(theta)", "sin(theta)", "theta_dot/8")

    @property
    def start(self) -> Sequence[float]:
        """Hanging, nearly at rest, near the middle of the track."""
        return [*([0.1 * self.numbers()["track"], 0.02] if self.has_track else []), 0.1, 0.1]

    @property
    def fastest(self) -> float:
        """Speed of a fall in the field that the support makes stronger [rad/s]."""
        k = self.scene.constants()
        return 2.0 * math.sqrt(k["weight"] + k["pull"] * self.limit_control)

    def numbers(self) -> dict[str, float]:
        """Return the limit U of the control and the track's half length S."""
        limit, track = {"limit_control": self.limit_control}, self.scene.track
        return limit if track is None else {**limit, "track": track if math.isfinite(track) else 0.5}

    def control(self, a: Any, y: Sequence, k: Any, dt: Any, xp: Any) -> Any:
        """Return the acceleration nearest to U·a from which the support can still stop inside the track."""
        wanted = k.limit_control * a
        if self.scene.track is None or math.isinf(self.scene.track):
            return wanted
        # With v the speed at the step's end, and braking from there at U, the support stops at
        # ±v²/(2U) + s + (s' + v) dt/2. Multiplied by 2U, it passes S or -S where v² + |reach| > 2US.
        s, s_dot = y[:2]
        top, per_step = k.limit_control, k.limit_control * dt
        ends, start = 2.0 * (top * k.track), (2.0 * top) * s + per_step * s_dot
        v = s_dot + dt * wanted
        reach = start + per_step * v
        side = xp.where(reach < 0.0, -1.0, 1.0)
        # The root of v² + U dt v + start = 2US, seen from that side, is the highest speed allowed.
        half = 0.5 * per_step
        highest = xp.sqrt(xp.maximum(half * half + ends - side * start, 0.0)) - half
        hardest = clip((highest - side * s_dot) * (1.0 / dt), -top, top, xp)
        return xp.where(v * v + xp.abs(reach) > ends, side * xp.minimum(side * wanted, hardest), wanted)

    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return h² - 0.02 (u/U)² with the height h = (1 - cosθ)/2."""
        height = 0.5 - 0.5 * z[-2]
        effort = u * (1.0 / k.limit_control)
        return k.scale * (height * height - 0.02 * (effort * effort))

    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return (s/S, s'/2,) cosθ, sinθ, θ'/8."""
        support = [z[0] * (1.0 / k.track), 0.5 * z[1]] if self.has_track else []
        return [*support, z[-2], z[-1], 0.125 * z[-3]]

    def bounds(self) -> Sequence[float]:
        """Return bounds on the observation."""
        u, track = self.limit_control, self.scene.track
        support: list[float] = []
        if track is not None:
            fastest = FASTEST_START + u * self.duration
            if math.isfinite(track):
                support = [1.0 + 1e-6, 0.5 * (math.sqrt(2.0 * u * track) * (1.0 + 1e-6))]
            else:
                support = [finite((1e3 + fastest * self.duration) / 0.5), finite(0.5 * fastest)]
        return [*support, 1.0, 1.0, finite(0.125 * _speed_bound(self, u))]

    def shapes(self, now: Moment) -> list[Shape]:
        """Add the upright bar."""
        s = now.state[0] if self.has_track else 0.0
        return [Polygon(self.scene.outline(s, math.pi), "target"), *super().shapes(now)]

    def check_safe(self, state: NDArray[np.float64]) -> None:
        """Refuse a start from which the support cannot stop inside the track."""
        if self.scene.track is not None:
            s, s_dot = state[:2]
            if math.isinf(self.scene.track):
                if abs(s) > 1e3:
                    raise ValueError(f"s must lie within ±1000 m at the start, got {s:g} m")
            elif abs(s) + s_dot * s_dot / (2.0 * self.limit_control) > self.scene.track:
                raise ValueError(
                    f"from s={s:g} m with s_dot={s_dot:g} m/s the support cannot stop inside the track: "
                    f"|s| + s_dot²/(2U) must be at most {self.scene.track:g} m "
                    f"with U={self.limit_control:g} m/s²"
                )


class Balance(SwingUp):
    """Keep a bar upright against kicks by moving its support.

    ## Description

    The bar of `SwingUp` starts nearly upright. It is to be kept there, near the middle of the track, while
    random kicks knock it off balance. Without kicks the task would be trivial.

    ## Action Space

    `Box(-1, 1, (1,), float32)`; finite values outside are clipped. The control is held for one step.

    | Num | Control | Unit | At -1 | At 1 |
    | --- | ------- | ---- | ----- | ---- |
    | 0 | acceleration u = s'' of the support, 3 times the action | m/s² | -3 | 3 |

    ## Observation Space

    `Box` of float32. The bounds are proved for every start that is accepted, at worst a kick in every step.

    | Num | Observation | Quantity | Unit | Min | Max |
    | --- | ----------- | -------- | ---- | --- | --- |
    | 0 | s | place of the support | m | -3.1 | 3.1 |
    | 1 | s_dot | its speed | m/s | -130 | 130 |
    | 2 | e | angle from upright, θ - π | rad | -18.76 | 18.76 |
    | 3 | theta_dot | angular velocity | rad/s | -920.3 | 920.3 |

    ## Rewards

    1 - (e/0.35)²/2 - (s/S)²/2 for each step, at its end and before a kick, with S = 0.5 m: between 0 and 1
    inside the limits. For another `dt` it is scaled by dt/0.02.

    ## Starting State

    Uniform; or `reset(options={"state": [s, s_dot, theta, theta_dot]})`, inside the limits below.

    | State | Unit | Centre | To either side |
    | ----- | ---- | ------ | -------------- |
    | s | m | 0 | 0.2 |
    | s_dot | m/s | 0 | 0.2 |
    | theta | rad | 3.14159 | 0.15 |
    | theta_dot | rad/s | 0 | 0.3 |

    After each step, with probability 0.01 (1 - 0.99^(dt/0.02) for another `dt`), a kick changes θ' by a
    uniform amount in ±1 rad/s.

    ## Episode End

    Termination: |e| > 0.35 rad or |s| > 0.5 m at a step's end; that step still pays. Truncation: after 500
    steps (10 s).

    ## Arguments

    | Keyword | Default | Unit | Range | Meaning |
    | ------- | ------- | ---- | ----- | ------- |
    | mass | 0.2 | kg | 1e-6 to 1e6 | mass m |
    | com_distance | 0.3 | m | 1e-9 to 1e9 | distance L from pivot to centre of mass, half of the length |
    | inertia | 0.006 | kg m² | 0 to 1e27 | moment of inertia I about the centre of mass; None: mL²/3 |
    | damping | 0.001 | N m s | 0 to 1e9 | coefficient b of the pivot's torque -bθ' |
    | gravity | 9.81 | m/s² | 0 to 1e6 | field g, downward |
    | track | 0.5 | m | 1e-3 to 1e9 | travel S to either side; finite here |
    | dt | 0.02 | s | 1e-6 to 1 | control interval; the episode keeps its seconds |
    | duration | 10 | s | dt or more | length of an episode, `math.inf` for one without an end |

    Each may lie anywhere in its range, whatever the others, as long as a step is not too long for the swing:
    2 √((g + 3 m/s²) m L/J) dt is at most 5,000 rad. Then every step is taken, and observations stay within
    their space. Outside, an error names it.

    Also `render_mode`, and `diagnostics=True` for support forces and energy in `info`.

    ## Equations

    With J = mL² + I:

        θ'' = -(m L (u cosθ + g sinθ) + b θ')/J
        s'' = u

    Upright, without control, a deviation grows e-fold in √(J/(mgL)) = 0.2 s.

    ## Signs and Units

    SI units. θ = 0 hangs straight down, θ = π stands; positive counter-clockwise, not wrapped: θ = -π is
    another angle and outside the limits. s is positive to the right. The state is float64:
    `env.unwrapped.state`.

    ## Numerical Accuracy

    Taylor series of order 14. One series is certified to leave out at most 1e-12 rad/s while |θ'| is at
    most 13.2 rad/s, whatever the control; above that the step is divided, by the same bound. Every step of
    whole episodes under random actions, against 40 digits: below 1e-15 of the state's size
    (docs/numerics.md). s and s' are exact to rounding.

    ## Optimal Value

    Not known. The best policy known is a linear-quadratic regulator (`python -m agents.scale` measures
    it, in episodes of its own); what value iteration estimates of a far easier task, tells
    docs/agents.md. Mean returns ± standard errors, of the other policies over 4,096 episodes; the
    linear feedback is

        action = 1.83 s + 1.43 s' - 12.4 e - 1.84 θ', clipped to ±1

    | Id | Random actions | Zero control | Linear feedback | Best known |
    | -- | -------------- | ------------ | --------------- | ---------- |
    | PivotedBarBalance-v0 | 21.25 ± 0.15 | 21.78 ± 0.16 | 445.7 ± 1.7 | 452.70 ± 0.14 |

    Kicks that no control survives keep the optimum below 500.

    ## Version History

    - v0: first version (lag_envs 0.1.0).
    """

    limit_control = 3.0
    draws = 2
    observation = ("s", "s_dot", "e", "theta_dot")
    largest_angle = 0.35

    def check(self) -> None:
        """Ask for a track: the task ends at its ends."""
        if self.scene.track is None or math.isinf(self.scene.track):
            raise ValueError(f"balancing needs a track of finite length, got track={self.scene.track}")

    @property
    def track(self) -> float:
        """The support's travel to either side [m]; `check` has asked for one."""
        assert self.scene.track is not None
        return self.scene.track

    @property
    def start(self) -> Sequence[float]:
        """Nearly upright."""
        return [0.4 * self.track, 0.2, 0.15, 0.3]

    @property
    def centre(self) -> Sequence[float]:
        """Upright."""
        return [0.0, 0.0, math.pi, 0.0]

    def numbers(self) -> dict[str, float]:
        """Return limits, track and the chance of a kick."""
        return {
            "limit_control": self.limit_control,
            "track": self.track,
            "chance": kick_chance(self, 0.01),
        }

    def control(self, a: Any, y: Sequence, k: Any, dt: Any, xp: Any) -> Any:
        """Return U·a; running off the track ends the episode, so nothing guards it."""
        return k.limit_control * a

    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return 1 - (e/0.35)²/2 - (s/S)²/2."""
        e = (z[2] - math.pi) * (1.0 / self.largest_angle)
        s = z[0] * (1.0 / k.track)
        return k.scale * (1.0 - 0.5 * (e * e) - 0.5 * (s * s))

    def terminated(self, z: Sequence, k: Any, xp: Any) -> Any:
        """Tell whether the bar has fallen or the support has left the track."""
        return (xp.abs(z[2] - math.pi) > self.largest_angle) | (xp.abs(z[0]) > k.track)

    def kick(self, z: Sequence, draws: Sequence, k: Any, xp: Any) -> Sequence:
        """Change θ' by up to 1 rad/s to either side, now and then."""
        push = xp.where(draws[0] < k.chance, 2.0 * draws[1] - 1.0, 0.0)
        return (*z[:3], z[3] + push, *z[4:])

    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return s, s', e = θ - π, θ'."""
        return [z[0], z[1], z[2] - math.pi, z[3]]

    def bounds(self) -> Sequence[float]:
        """Return bounds on the observation."""
        u = self.limit_control
        kicks = self.limit if math.isfinite(self.limit) else math.inf
        slide = FASTEST_START + u * self.duration
        swing = _speed_bound(self, u) + kicks
        return [
            finite(self.track + slide * self.dt),
            finite(slide),
            finite(self.largest_angle + swing * self.dt),
            finite(swing),
        ]

    def shapes(self, now: Moment) -> list[Shape]:
        """Add how far the bar may lean."""
        pivot, up, reach = (now.state[0], 0.0), 0.5 * math.pi, self.scene.reach
        limits = [up - self.largest_angle, up + self.largest_angle]
        lines = [Line([polar(pivot, r * reach, a) for r in (0.9, 1.05)], "limit") for a in limits]
        return [*super().shapes(now), *lines]

    def window(self, now: Moment) -> Window:
        """Look at the upper half."""
        reach, side = self.scene.reach, self.track + 0.5 * self.scene.reach
        return Window(-side, -0.3 * reach, side, 1.15 * reach)

    def check_safe(self, state: NDArray[np.float64]) -> None:
        """Refuse a start at which the episode would be over."""
        s, _, theta, _ = state
        if abs(theta - math.pi) > self.largest_angle or abs(s) > self.track:
            raise ValueError(
                f"the episode would be over at s={s:g} m, theta={theta:g} rad: |theta - pi| must be at most "
                f"{self.largest_angle} rad and |s| at most {self.track:g} m"
            )
