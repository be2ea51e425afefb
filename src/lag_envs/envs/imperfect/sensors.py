"""What sensors show of the observation: late, with noise, and not after every step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.envs.imperfect.draws import noise, purpose_key
from lag_envs.envs.imperfect.rows import Ring, RowsWithRings
from lag_envs.stepping.compiling import indent
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
        self._low, self._high = constants["age_low"], constants["age_high"]
        every = constants["every"]
        #: Whether a reading is due after step ``n``; empty if a reading is always due.
        self.due = f"np.floor(n / {every}) * {every} == n" if options.observation_every > 1 else ""
        self.shown = [f"h{i}" for i in range(len(observed))]
        #: The observation taken within a step, if all observations have one age; otherwise it goes to its
        #: slot at once.
        single = options.within and not options.jittered
        self.taken = [f"m{i}" for i in range(len(observed))] if single else []
        self._seen = {f"seen{i}": o for i, o in enumerate(observed)}
        self.ring = Ring([*self._seen], options.readings)
        sigmas = {f"sigma{i}": x for i, x in enumerate(options.observation_noise)}
        #: The lines that add noise.
        self.sense = [*noise(observed, "observation", sigmas, constants, trace), *bounded]

    @property
    def divide(self) -> list[str]:
        """The lines that end a piece of a step where an observation is taken, if that is before `end`."""
        if self._options.jittered:
            return self._each_coming(["if t < seen_at < end:", "    end = seen_at"])
        return ["if t < k_shown_at < end:", "    end = k_shown_at"] if self._options.within else []

    def watch(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that store, at the end of a piece, what will be shown later."""
        if self._options.jittered:
            slot = f"slot = {rows.whole(f'(np.int64(n) + coming) % {self.ring.slots}')}"
            store = [*self._observe, slot, *rows.put(self.ring, self._seen)]
            return self._each_coming(["if t == seen_at:", *indent(store)])
        if not self.taken:
            return []
        seen = [*self._observe, *(f"{m} = {o}" for m, o in zip(self.taken, self._o, strict=True))]
        return ["if t == k_shown_at:", *indent(seen)]

    def _each_coming(self, body: Sequence[str]) -> list[str]:
        """Return the loop over the readings to come, each of its own age, that may be taken in this step.

        A reading of age 0 is taken at the step's end; no reading is taken at its beginning, which was the end
        of the last step.
        """
        lines = [
            "part = uniform(key_age, np.uint64(n + coming), np.uint64(0))",
            f"seen_at = (coming - ({self._low} + ({self._high} - {self._low}) * part)) * k_dt",
            *body,
        ]
        return [
            f"key_age = {purpose_key('age')}",
            f"for coming in range(1, {self.ring.slots + 1}):",
            *indent(lines),
        ]

    def begin(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that show a start as if the state had been the same for a long time."""
        return [*self._observe, *rows.fill(self.ring, self._seen), *self.sense, *self._show(rows)]

    def read(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that show the observation at the end of a step."""
        show = [*self.sense, *self._show(rows)]
        shown = [f"if {self.due}:", *indent(show)] if self.due else show
        return [*self._observe, *self.delay(rows), *shown]

    def delay(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that replace the observation by the one to be shown now, if sensors are late."""
        if self._options.jittered:
            slot = f"slot = {rows.whole('n')} % {rows.whole(self.ring.slots)}"
            return [slot, *rows.take(self.ring, self._seen)]
        taken = dict(zip(self._seen, self.taken, strict=True)) if self.taken else self._seen
        return rows.turn(self.ring, taken, self._seen) if self.ring.slots else []

    def _show(self, rows: RowsWithRings) -> list[str]:
        return rows.store(self.shown, self._o)
