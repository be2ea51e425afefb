"""What sensors show of the observation: late, with noise, and not after every step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.envs.imperfect.draws import noise
from lag_envs.envs.imperfect.rows import Ring, RowsWithRings
from lag_envs.envs.lines import indent
from lag_envs.stepping.tracing import Trace
from lag_envs.tasks.imperfections import Imperfections


class Sensors:
    """Prints the lines for sensors.

    Its own rows are the observation shown last, ``h``, and observations still to be shown, ``seen``.

    Parameters
    ----------
    options : Imperfections
        The imperfections of the sensors.
    observed : sequence of str
        The observation that a perfect sensor shows.
    observe, bounded : sequence of str
        The lines that compute it, and those that keep it within its bounds.
    constants : mapping
        Name, or zero, of each constant.
    trace : type of Trace
        The kind of recording for formulas.
    """

    def __init__(
        self,
        options: Imperfections,
        observed: Sequence[str],
        observe: Sequence[str],
        bounded: Sequence[str],
        constants: Mapping[str, Any],
        trace: type[Trace],
    ) -> None:
        self._options, self._o, self._observe = options, observed, observe
        every = constants["every"]
        #: Whether a reading is due after step ``n``; empty if one always is.
        self.due = f"np.floor(n / {every}) * {every} == n" if options.observation_every > 1 else ""
        self.shown = [f"h{i}" for i in range(len(observed))]
        self._seen = {f"seen{i}": o for i, o in enumerate(observed)}
        self.ring = Ring([*self._seen], options.readings)
        sigmas = {f"sigma{i}": x for i, x in enumerate(options.observation_noise)}
        #: The lines that add noise.
        self.sense = [*noise(observed, "observation", sigmas, constants, trace), *bounded]

    @property
    def watch(self) -> list[str]:
        """The lines that store, within a step, what will be shown later."""
        seen = [*self._observe, *(f"m{i} = {o}" for i, o in enumerate(self._o))]
        return ["if t == k_shown_at:", *indent(seen)]

    def begin(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that show a start as if it had lasted for a long time."""
        return [*self._observe, *rows.fill(self.ring, self._seen), *self.sense, *self._show(rows)]

    def read(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that show the observation at the end of a step."""
        show = [*self.sense, *self._show(rows)]
        shown = [f"if {self.due}:", *indent(show)] if self.due else show
        return [*self._observe, *self.delay(rows), *shown]

    def delay(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that replace the observation by the one to be shown now, if sensors are late."""
        taken = {row: f"m{i}" for i, row in enumerate(self._seen)} if self._options.within else self._seen
        return rows.turn(self.ring, taken, self._seen) if self.ring.slots else []

    def _show(self, rows: RowsWithRings) -> list[str]:
        return rows.store(self.shown, self._o)
