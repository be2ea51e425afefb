"""Steps that imperfect sensors or actuators divide: commands change, or observations are taken, within them.

A step is moved piece by piece. A piece ends where a command comes into force, an observation is taken, or the
step is over. In a batch each environment has pieces of its own, and all go on side by side until the
environment with the most pieces is done.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lag_envs.envs.imperfect.rows import RowsWithRings
from lag_envs.envs.imperfect.whole import WholeProgram
from lag_envs.envs.lines import EACH_LANE, indented
from lag_envs.stepping.compiling import indent


class DividedProgram(WholeProgram):
    """The compiled functions of a task with imperfections that divide steps; the arguments are `Program`'s.

    Within a step, `t` is the time since its start, `switch` the time at which the commands ``u`` change,
    `end` that of the piece's end. The rows ``z`` hold the state at `t`, the rows ``mean_u`` sum up what the
    reward takes as controls, the rows ``now_u`` hold lagging controls.
    """

    def _record(self, formulas: Any, constants: dict[str, Any]) -> None:
        super()._record(formulas, constants)
        self._mean = [f"mean_{u}" for u in self.u]
        self._now = [f"now_{u}" for u in self.in_force]
        taken = self._sensors.taken
        self.passing = ["t", "switch", "end", "moved", "failed", *self._mean, *self._now, *taken]
        bound = [] if self.general else [f"x = {self._x} * (dt / k_dt)" if self._x else "x = 0.0"]
        #: The lines that say for how long a piece lasts, to the lines that move it.
        self._span = ["dt = end - t", *bound]

    @property
    def _printed(self) -> list[str]:
        return [*super()._printed, *self._sensors.divide, "k_late_low k_late_high"]

    @property
    def tries_all(self) -> bool:
        """See `Program.tries_all`."""
        return True

    def _choose(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that find the commands in force at `t`, and the end of the piece."""
        mean = [] if self.in_force else [f"mean_{u} += (h / k_dt) * {u}" for u in self.u]
        commands = [*self._actuators.choose(rows), "h = switch - t", *self._actuators.command, *mean]
        return [
            "if t == switch:", *indent(["switch = k_dt", *commands]),
            "end = switch", *self._sensors.divide,
        ]  # fmt: skip

    @property
    def _shares(self) -> list[tuple[str, str]]:
        """What a piece adds to the mean controls, where actuators lag; else `_choose` adds it."""
        return [(mean, f"(dt / k_dt) * {u}") for mean, u in zip(self._mean, self.means, strict=False)]

    # --- one environment ------------------------------------------------------------------------------------

    @property
    def _move_one(self) -> list[str]:
        begin = [f"begin_{y}" for y in self.y]
        piece = [
            *self._choose(self._single), *_assigned(self.reaching, self.reached),
            *self._span, *self._code.any_step, *indented("if status < 0:", self._leave_one),
            *(f"{mean} += {share}" for mean, share in self._shares),
            *_assigned(self.in_force, self.in_force_after), *_assigned(self.y, self.z),
            "t = end", *self._sensors.watch(self._single),
        ]  # fmt: skip
        return [
            *_assigned(begin, self.y), *(f"{mean} = 0.0" for mean in self._mean),
            *([self._room_one] if self.general else []),
            "t, switch = 0.0, 0.0", *indented("while t < k_dt:", piece),
            *self._one.store(self.u, self.in_force_after or self.u),
            *_assigned(self.u, self._mean), *_assigned(self.y, begin),
        ]  # fmt: skip

    # --- a batch --------------------------------------------------------------------------------------------

    @property
    def _move_lanes(self) -> list[str]:
        look = self._look
        return [
            *indented(EACH_LANE, self._begin_step),
            "pieces = np.uint64(1)",
            "while pieces > 0:",
            *indent([
                "pieces = np.uint64(0)",
                *indented(EACH_LANE, self._begin_piece),
                *(self._move_by_series if self.general else self._move_by_flow),
                *(indented(EACH_LANE, look) if look else []),
            ]),
        ]  # fmt: skip

    @property
    def _begin_step(self) -> list[str]:
        # An environment that is to be restarted has no piece.
        zeros = ["switch", "failed", *self._mean]
        return [
            *self._load([*self.y, *self.reached, "n"]), *self._in_force,
            "t, zero = select(n < 0.0, k_dt, 0.0), 0.0",
            *self._store(["t", *zeros], ["t", *["zero"] * len(zeros)]),
            *self._store([*self.z, *self.reaching, *self._now], [*self.y, *self.reached, *self.in_force]),
        ]  # fmt: skip

    @property
    def _load_piece(self) -> list[str]:
        """The lines that load what a piece starts from."""
        constants = [f"k_{name}" for name in self.varying]
        return [
            *self._load([*constants, "n", "t", "switch", "end", "failed", *self._mean]),
            *self._load(self.z, self.y), *self._load(self._commands, self.u),
            *self._load(self._now, self.in_force),
        ]  # fmt: skip

    @property
    def _begin_piece(self) -> list[str]:
        body = [
            self._key, *self._load_piece,
            *self._load(self.a), *self.clip, *self._load(self.reaching, self.reached),
            *self._choose(self._lane),
            *self._store(["switch", "end", *self._mean]),
            *self._store([*self._commands, *self.reaching], [*self.u, *self.reached]),
        ]  # fmt: skip
        return [*self._load(["t"]), *indented("if t < k_dt:", body)]

    @property
    def _move_by_series(self) -> list[str]:
        going = "going = t < k_dt"
        given = ["span, status = select(going, end - t, 0.0), select(going, 0.0, -1.0)"]
        found = [
            "moved = select(going & (status > 0.0), 1.0, 0.0)",
            "failed = select(going & (status < 0.0), 1.0, failed)",
        ]
        end = [*self._load_piece, going, *self._span, *self._advanced, *found, *self._end_piece]
        return [*self._advance_lanes([*self._load_piece, going, *given]), *indented(EACH_LANE, end)]

    @property
    def _move_by_flow(self) -> list[str]:
        # Lanes that the fast formula does not cover are moved by the second loop.
        fast = ["moved = select(t < k_dt, select(within, 1.0, 2.0), 0.0)"]
        slow = ["moved = select(status < 0, 0.0, 1.0)", "failed = 1.0 - moved"]
        first = [*self._load_piece, *self._span, *self._code.fast, *fast, *self._end_piece]
        second = [*self._load_piece, *self._span, *self._code.any_step, *slow, *self._end_piece]
        return [
            *indented(EACH_LANE, first),
            *indented(EACH_LANE, [*self._load(["moved"]), *indented("if moved == 2.0:", second)]),
        ]  # fmt: skip

    @property
    def _end_piece(self) -> list[str]:
        """The lines that keep the end of a piece if ``moved`` is 1, and end the step if it was refused."""
        pairs = zip([*self.y, *self.in_force], [*self.z, *self.in_force_after], strict=True)
        return [
            *(f"{before} = select(moved == 1.0, {after}, {before})" for before, after in pairs),
            *(f"{mean} = select(moved == 1.0, {mean} + {share}, {mean})" for mean, share in self._shares),
            "t = select(failed == 1.0, k_dt, select(moved == 1.0, end, t))",
            *self._store([*self.z, *self._now], [*self.y, *self.in_force]),
            *self._store(["t", "moved", "failed", *self._mean]),
            "pieces += np.uint64(t < k_dt)",
        ]  # fmt: skip

    @property
    def _look(self) -> list[str]:
        """The lines that take an observation at the end of a piece."""
        watch, taken = self._sensors.watch(self._lane), self._sensors.taken
        body = [self._key, *self._load_piece, *self._load([*self.g, *taken]), *watch, *self._store(taken)]
        return [*self._load(["moved"]), *indented("if moved == 1.0:", body)] if watch else []

    @property
    def _to_end(self) -> list[str]:
        return [*self._to_end_again, "within = failed == 0.0"]

    @property
    def _to_end_again(self) -> list[str]:
        return [
            *self._load([*self.z, "failed"]), *self._load(self._mean, self.u),
            *self._in_force, *self._load(self._now, self.in_force_after),
            "status = -failed",
        ]  # fmt: skip


def _assigned(names: Sequence[str], values: Sequence[str]) -> list[str]:
    return [f"{name} = {value}" for name, value in zip(names, values, strict=True)]
