"""Control steps with actuators of first order: u' = (w - u)/τ, with the command w held.

From the value u₀ at the step's start, a control follows u(t) = w + (u₀ - w) e^(-t/τ). The series of the
control, and of the prescribed coordinate that it moves, are known to every order. The state follows
ẏ = f(y, u(t)) with the scene's own f: a control that is a place remains quasi-static; a control that is a
rate accelerates the coordinate that it moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.mechanics.algebra import Atom, Expr
from lag_envs.mechanics.equations import velocity
from lag_envs.mechanics.motion import Mechanics
from lag_envs.stepping.elementary import fading
from lag_envs.stepping.general import SeriesStepper, stepper_of
from lag_envs.stepping.lowering import CLOCK, FADING, Lowering


class LaggedStepper(SeriesStepper):
    """One scene's control step with lagged controls, by the general series.

    In place of the controls, its code takes their values at the step's start, ``u0``, ...; then their
    commands, ``u0_command``, ...; then 1/τ [1/s], ``u0_decay``, ..., where 0 means no lag. After the state it
    returns the controls at the step's end, ``u0_end``, ...; then their means over the step, ``u0_mean``, ....
    """

    @property
    def arguments(self) -> list[str]:
        """Names of the code's arguments for the controls."""
        names = super().arguments
        return [*names, *(f"{u}_command" for u in names), *(f"{u}_decay" for u in names)]

    @property
    def applied(self) -> list[str]:
        """Names of the results of `followed`."""
        names = super().arguments
        return [*(f"{u}_end" for u in names), *(f"{u}_mean" for u in names)]

    # --- the series -----------------------------------------------------------------------------------------

    def _lowered(self, tangents: Sequence[str] | None = None) -> tuple[Lowering, tuple[list[int], dict]]:
        layout, m = self._layout, self.mechanics
        rates = {name: -Expr.of(Atom("decay", name)) for name in layout.controls}
        rates |= {p.name: rates[p.control] for p in layout.at("acceleration", "rate")}
        lowering = Lowering(layout.free, self._moving(), tangents, rates)
        force = list(m.force)
        of = {p.name: p.control for p in layout.prescribed}
        for (i, name), entry in sorted(m.coupling.items()):  # a changing rate exerts a force
            force[i] = force[i] - entry * Expr.of(velocity(of[name]))
        return lowering, lowering.parts(m.mass, force)

    def _moving(self) -> dict[str, list[Expr]]:
        """Return controls and moving prescribed coordinates as the first terms of their series in time."""
        elapsed = Expr.of(CLOCK)
        moving: dict[str, list[Expr]] = {}
        for name in self._layout.controls:
            gap, decay = Expr.of(Atom("gap", name)), Expr.of(Atom("decay", name))
            fade = Expr.of(Atom(FADING[0], name))
            moving[name] = [Expr.of(Atom("command", name)) + gap * fade, -decay * gap * fade]
        for p in self._layout.at("acceleration", "rate"):
            s, by = Expr.of(Atom("start", p.name)), p.control
            command, gap = (Expr.of(Atom(kind, by)) for kind in ("command", "gap"))
            once, twice = (Expr.of(Atom(kind, by)) for kind in FADING[1:])
            u, u_dot = moving[by]
            if p.level == "rate":
                moving[p.name] = [s + elapsed * (command + gap * once), u, u_dot / 2]
            else:
                rate = Expr.of(Atom("start", f"{p.name}_dot"))
                far = elapsed * (rate + elapsed * (command / 2 + gap * twice))
                moving[p.name] = [s + far, rate + elapsed * (command + gap * once), u / 2, u_dot / 6]
        return moving

    # --- from the state and back ----------------------------------------------------------------------------

    def _split(self, xp: Any, u: Sequence) -> list[tuple[Any, Any, Any, Any]]:
        """Return for each control its starting value, w, u₀ - w and 1/τ."""
        n = len(self._layout.controls)
        found = []
        for now, command, decay in zip(u[:n], u[n : 2 * n], u[2 * n :], strict=True):
            start = xp.where(0.0 < decay, now, command)
            found.append((start, command, start - command, decay))
        return found

    def _starting(self, xp: Any, u: Sequence) -> Sequence:
        return [start for start, *_ in self._split(xp, u)]

    def _inputs(self, xp: Any, u: Sequence) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, (_, command, gap, decay) in zip(self._layout.controls, self._split(xp, u), strict=True):
            found |= {f"command_{name}": command, f"gap_{name}": gap, f"decay_{name}": decay}
        return found

    def followed(self, xp: Any, u: Sequence, dt: Any) -> list:
        """Return the controls at the step's end, and their means over the step."""
        ends, means, _ = self._after(xp, u, dt)
        return [*ends, *means]

    def _after(self, xp: Any, u: Sequence, dt: Any) -> tuple[list, list, list]:
        """Return the controls at the step's end, their means ∫u dt/dt, and the means ∫∫u dt dt/dt²."""
        ends, once, twice = [], [], []
        for _, command, gap, decay in self._split(xp, u):
            fades = fading(dt * decay, xp)
            ends.append(command + gap * fades[0])
            once.append(command + gap * fades[1])
            twice.append(0.5 * command + gap * fades[2])
        return ends, once, twice

    def _driven(
        self, xp: Any, given: Mapping[str, Any], u: Sequence, dt: Any
    ) -> tuple[dict[str, Any], Sequence]:
        ends, once, twice = self._after(xp, u, dt)
        after: dict[str, Any] = {}
        for p in self._layout.prescribed:
            if p.level == "acceleration" and f"{p.name}_dot" in given:
                rate = given[f"{p.name}_dot"]
                if p.name in given:
                    after[p.name] = given[p.name] + dt * (rate + dt * self._by(p, twice))
                after[f"{p.name}_dot"] = rate + dt * self._by(p, once)
            elif p.level == "rate" and p.name in given:
                after[p.name] = given[p.name] + dt * self._by(p, once)
        return after, ends


def lagged_stepper(mechanics: Mechanics) -> SeriesStepper:
    """Return the stepper of these equations of motion with lagged controls; equal equations share one."""
    return stepper_of(mechanics, LaggedStepper)
