"""From an action to the control: noise, delay, slew."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

from lag_envs.envs.imperfect.draws import noise, purpose_key
from lag_envs.envs.imperfect.rows import Ring, RowsWithRings
from lag_envs.envs.lines import recorded_lines
from lag_envs.stepping.compiling import split_lengths
from lag_envs.tasks.imperfections import Imperfections


class Actuators:
    """Prints the lines for actuators.

    Its own rows are the commands ``c`` that the slew has reached, and those under way, ``sent``, with their
    delays ``at``.

    Parameters
    ----------
    options : Imperfections
        The imperfections of the actuators.
    formulas : TaskFormulas
        The task's formulas.
    a, y, u : sequence of str
        Actions, state and controls.
    clip : sequence of str
        The lines that keep actions within their bounds.
    constants : dict
        Name, or zero, of each constant.
    """

    def __init__(
        self,
        options: Imperfections,
        formulas: Any,
        a: Sequence[str],
        y: Sequence[str],
        u: Sequence[str],
        clip: Sequence[str],
        constants: dict[str, Any],
    ) -> None:
        self._options, self._constants = options, constants
        self.reached = [f"c{i}" for i in range(len(a))] if options.slew else []
        self._sent = {f"sent{i}": name for i, name in enumerate(a)}
        late = [] if options.whole else ["at"]
        self.ring = Ring([*self._sent, *late], options.commands if options.commands > 1 else 0)

        def asked(xp: Any, *values: Any) -> Sequence:
            return formulas.wanted(xp, list(values))

        def limited(xp: Any, *values: Any) -> list:
            actions, old, (h,), rest = split_lengths(values, len(a), len(a), 1)
            at, reached = dict(zip(constants, rest, strict=True)), []
            for i, (u, c) in enumerate(zip(formulas.wanted(xp, actions), old, strict=True)):
                if options.slew[i] < math.inf:
                    most = h * at[f"slew{i}"]
                    u = xp.minimum(xp.maximum(u, c - most), c + most)
                reached.append(u)
            return reached

        def guarded(xp: Any, *values: Any) -> Sequence:
            w, y_now, rest = split_lengths(values, len(a), len(y))
            k = SimpleNamespace(**dict(zip(constants, rest, strict=True)))
            return formulas.guarded(xp, w, y_now, k)

        def record(formula: Callable, inputs: Sequence, outputs: Sequence[str]) -> list[str]:
            return recorded_lines(formula, inputs, outputs, formulas.trace)

        wanted = [f"w{i}" for i in range(len(a))]
        #: From the command in force to the control: ``a``, ``c``, ``y``, ``h`` to ``u``.
        if self.reached:
            self.command = record(limited, [*a, *self.reached, "h", *constants.values()], wanted)
            self.command += [f"{c} = {w}" for c, w in zip(self.reached, wanted, strict=True)]
        else:
            self.command = record(asked, a, wanted)
        within = constants | {"dt": "h"}  # within a piece of a step, its length
        self.command += record(guarded, [*wanted, *y, *within.values()], u)
        #: The command before the first action.
        self.at_rest = [f"{name} = {constants[f'rest{i}']}" for i, name in enumerate(a)]
        if self.reached:
            self.at_rest += record(asked, a, self.reached)
        sigmas = {f"shake{i}": x for i, x in enumerate(options.action_noise)}
        noisy = noise(a, "action", sigmas, constants, formulas.trace)
        #: From an action to the command.
        self.perturb = [*clip, *noisy, *(clip if noisy else [])]

    def begin(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that begin an episode with the command at rest."""
        return [
            *self.at_rest,
            *rows.fill(self.ring, self._sent | ({} if self._options.whole else {"at": "0.0"})),
        ]

    def delay(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that replace a command by the one in force, or send it, if that changes in a step.

        If all commands are late by whole steps, a command of an earlier step is in force throughout.
        """
        if not self.ring.slots:
            return []
        if self._options.whole:
            return rows.turn(self.ring, self._sent, self._sent)
        low, high = self._constants["late_low"], self._constants["late_high"]
        shortest, longest = self._options.action_delay
        draw = f" + ({high} - {low}) * uniform({purpose_key('delay')}, np.uint64(n), np.uint64(0))"
        late = f"{low}{draw if shortest < longest else ''}"
        slot = f"slot = {rows.whole('n')} % {rows.whole(self.ring.slots)}"
        return [slot, *rows.put(self.ring, self._sent | {"at": late})]

    def choose(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that find the command in force at `t`, and when the next one takes effect.

        It is the command sent last among those that have arrived; this piece of the step ends when another
        one arrives.
        """
        ring = self.ring
        if not ring.slots:
            return []
        return [
            f"for back in range({ring.slots}):",
            f"    slot = {rows.whole(f'(np.int64(n) + {ring.slots} - back) % {ring.slots}')}",
            f"    comes = ({rows.in_slot(ring, 'at')} - back) * k_dt",
            "    if comes <= t:", "        break",
            "    if comes < switch:", "        switch = comes",
            *(f"{a} = {rows.in_slot(ring, sent)}" for sent, a in self._sent.items()),
        ]  # fmt: skip
