"""Steps between imperfect actuators and sensors: commands before, observations after the whole step."""

from __future__ import annotations

from typing import Any

from lag_envs.envs.imperfect.actuators import Actuators
from lag_envs.envs.imperfect.drawn import DrawnProgram
from lag_envs.envs.imperfect.lagged import LaggedCode
from lag_envs.envs.imperfect.rows import RowsWithRings
from lag_envs.envs.imperfect.sensors import Sensors
from lag_envs.envs.lines import EACH_LANE, indented
from lag_envs.stepping.compiling import BLOCK, indent
from lag_envs.stepping.rows import Rows
from lag_envs.tasks.base import Task


class WholeProgram(DrawnProgram):
    """The compiled functions of a task with imperfections that divide no step; see `Imperfections.whole`.

    The arguments are those of `Program`. Its further rows are those of `Sensors` and `Actuators`.
    """

    sensing = True

    def __init__(self, task: Task, absent: frozenset[str], varying: frozenset[str]) -> None:
        super().__init__(task, absent, varying)
        self._single = RowsWithRings(self.kept, "f", "np.uint64(0)", 1)
        self._lane = RowsWithRings(self.kept, "f", "base + i", BLOCK)

    @property
    def _printed(self) -> list[str]:
        parts = (self._actuators.perturb, self._actuators.at_rest, self._controls, self._sensors.sense)
        lag = [self._x, *self._code.any_step, *self._code.prepare] if self.options.lag else []
        return [*super()._printed, *(line for part in parts for line in part), self._sensors.due, *lag]

    def _step_code(self, formulas: Any, absent: frozenset[str], constants: dict[str, Any]) -> Any:
        held = super()._step_code(formulas, absent, constants)
        if not self.options.lag:
            return held
        code = LaggedCode(self._source.scene, held.start, held.end, formulas.lift("z"), constants)
        self.in_force, self.in_force_after, self.means = code.in_force, code.in_force_after, code.means
        return code

    def _record(self, formulas: Any, constants: dict[str, Any]) -> None:
        super()._record(formulas, constants)
        found = self.options
        if found.lag:
            self._x, self.fast = constants["lagged_order"], [f"dt = {constants['dt']}"]
        sensors = Sensors(found, self.o, self.observe, self._bounded, constants, formulas.trace)
        actuators = Actuators(found, formulas, self.a, self.y, self.u, self.clip, constants)
        self._sensors, self._actuators = sensors, actuators
        self.reached = actuators.reached
        self.reaching = [f"next_{c}" for c in self.reached]
        self.own = [*self.own, *self.reached, *sensors.shown, *actuators.ring.names, *sensors.ring.names]
        self._add_pushes(constants)

    def _bound_observations(self) -> None:
        """Leave observations unbounded; the readings of the sensors are bounded later."""

    @property
    def _controls(self) -> list[str]:
        reached = zip(self.reaching, self.reached, strict=True)
        command = ["h = k_dt", *self._actuators.command, *(f"{after} = {c}" for after, c in reached)]
        return [*self.clip, *command]

    def _begin(self, rows: RowsWithRings) -> list[str]:
        """Return the lines that begin an episode, after its start is drawn."""
        return [*self._actuators.begin(rows), *rows.store(self.reached), *self._sensors.begin(rows)]

    # --- one environment ------------------------------------------------------------------------------------

    @property
    def _command_one(self) -> list[str]:
        return ["key = ids[2]", *self._actuators.perturb, *self._actuators.delay(self._single)]

    @property
    def _observe_one(self) -> list[str]:
        return ["key = ids[2]", *self._sensors.read(self._single)]

    @property
    def _begin_one(self) -> list[str]:
        return self._begin(self._single)

    @property
    def _show_one(self) -> list[str]:
        shown = self._sensors.shown
        return [*self._single.load(shown), *self._shown_one.store(self.o, shown)]

    # --- a batch --------------------------------------------------------------------------------------------

    @property
    def _command_lanes(self) -> list[str]:
        delay = self._actuators.delay(self._lane)
        perturb = [self._key, *self._load([*self.a, "n"]), *self._actuators.perturb, *self._store(self.a)]
        return [
            *(indented(EACH_LANE, perturb) if delay or self.options.action_noise else []),
            # The environments do not go side by side, since each has its own slot. An environment that is to
            # be restarted has none.
            *(
                indented(EACH_LANE, [
                    self._key, *self._load(["n"]),
                    "if n >= 0.0:", *indent([*self._load(self.a), *delay, *self._store(self.a)]),
                ])
                if delay
                else []
            ),
        ]  # fmt: skip

    @property
    def _sense_lanes(self) -> list[str]:
        sensors, ordinary = self._sensors, self._load(["ordinary"])
        delay, clock = sensors.delay(self._lane), self._load(["clock"], ["n"])
        shown = f"stepped & ({sensors.due})" if sensors.due else "stepped"
        sense = [
            *ordinary, "stepped = ordinary == 1.0", self._key, *clock,
            *self._load([*self.o, *self.reached, *self.reaching, *sensors.shown]), *sensors.sense,
            f"shown = {shown}",
            *(f"{h} = select(shown, {o}, {h})" for h, o in zip(sensors.shown, self.o, strict=True)),
            *(f"{c} = select(stepped, next_{c}, {c})" for c in self.reached),
            *self._store([*sensors.shown, *self.reached]),
        ]  # fmt: skip
        return [
            *(
                indented(EACH_LANE, [
                    *ordinary, "if ordinary == 1.0:",
                    *indent([
                        *clock, *self._load([*self.o, *sensors.taken]), *delay, *self._store(self.o),
                    ]),
                ])
                if delay
                else []
            ),
            *indented(EACH_LANE, sense),
        ]  # fmt: skip

    @property
    def _begin_lane(self) -> list[str]:
        return self._begin(self._lane)

    @property
    def _show_lane(self) -> list[str]:
        shown = self._sensors.shown
        return [*self._load(shown), *self._shown_lane.store(self.o, shown)]

    @property
    def _show_block(self) -> list[str]:
        return Rows(self.kept, "f", "base", BLOCK).copy(self._sensors.shown, "size", "obs", "first")
