"""A whole control step behind lagging actuators, in the form of `SeriesCode`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.scenes.derivation import chosen_order_of
from lag_envs.stepping.compiling import absent_from
from lag_envs.stepping.lag import lagged_stepper


class LaggedCode:
    """The code of a step with lag, under the names of an environment's program.

    The commands are ``u0``, ..., see `Program.in_force` for the rest.

    Parameters
    ----------
    scene : Scene
        The scene.
    start, end : sequence of str
        The state before and after, with the cosine and sine of an angle if the program keeps them.
    lift_end : sequence of str
        The lines that add these to the end.
    constants : mapping
        Name, or zero, of each constant.
    """

    def __init__(
        self,
        scene: Any,
        start: Sequence[str],
        end: Sequence[str],
        lift_end: Sequence[str],
        constants: Mapping[str, Any],
    ) -> None:
        lagged = {n.removeprefix("lagged_"): x for n, x in constants.items() if n.startswith("lagged_")}
        code = lagged_stepper(scene.mechanics).code(absent_from(lagged), order=chosen_order_of(scene))
        n = range(len(code.controls) // 3)
        self.start, self.end = start, end
        self.in_force = [f"reached{i}" for i in n]
        self.in_force_after = [f"u{i}_end" for i in n]
        self.means = [f"u{i}_mean" for i in n]
        self._names = {name: name.replace("k_", "k_lagged_", 1) for name in code.constants}
        for i in n:
            decay = str(constants[f"decay{i}"])
            self._names |= {f"u{i}": f"reached{i}", f"u{i}_command": f"u{i}", f"u{i}_decay": decay}
        self.scratch, self.engine, self.compile_block = code.scratch, code.engine, code.compile_block
        self.constants = [self._names[name] for name in code.constants]
        self.rows, self.given, self.results = map(self._named, (code.rows, code.given, code.results))
        self.prepare = self._named(code.prepare)
        self.finish = [*self._named(code.finish), *lift_end]
        self.any_step = [*self._named(code.any_step), *lift_end]

    def _named(self, lines: Sequence[str]) -> list[str]:
        """Return lines in which the code's names are replaced."""
        return [re.sub(r"\b[ku]\w+\b", lambda m: self._names.get(m[0], m[0]), line) for line in lines]
