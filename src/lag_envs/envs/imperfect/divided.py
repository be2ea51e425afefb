"""Steps that imperfect sensors or actuators divide, one environment at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

from lag_envs.envs import sharing
from lag_envs.envs.imperfect.actuators import Actuators
from lag_envs.envs.imperfect.drawn import DrawnProgram
from lag_envs.envs.imperfect.lagged import lagged_code
from lag_envs.envs.imperfect.motion import Held, Lagged
from lag_envs.envs.imperfect.rows import RowsWithRings
from lag_envs.envs.imperfect.sensors import Sensors
from lag_envs.envs.lines import compiled_lines, indent, next_episode
from lag_envs.envs.program import SLOW
from lag_envs.stepping.compiling import BLOCK
from lag_envs.stepping.rows import Rows
from lag_envs.tasks.base import Task


class DividedProgram(DrawnProgram):
    """The compiled functions of a task with imperfections; the arguments are those of `Program`.

    The further rows that it keeps are those of `Sensors` and `Actuators`.
    """

    def __init__(self, task: Task, absent: frozenset[str], varying: frozenset[str]) -> None:
        super().__init__(task, absent, varying)
        self.scratch = [*self.a, *self.o, *self.held]
        self._where = RowsWithRings(self.kept, "f", "base", "stride")
        self._lane = Rows(self.kept, "f", "base", BLOCK)
        self._work = Rows(self.scratch, "work", "0", 1)

    @property
    def _printed(self) -> list[str]:
        inside = (self._actuators.perturb, self._sensors.sense, [self._sensors.due], self._sensors.divide)
        commands = (self._actuators.at_rest, self._actuators.command)
        more = (*inside, *commands, ["k_late_low k_late_high"], self._motion.constants)
        return [*super()._printed, *(line for part in more for line in part)]

    def _record(self, formulas: Any, constants: dict[str, Any]) -> None:
        super()._record(formulas, constants)
        found, scene, trace = self.options, self._source.scene, formulas.trace
        self._sensors = Sensors(found, self.o, self.observe, self._bounded, constants, trace)
        self._actuators = Actuators(found, formulas, self.a, self.y, self.u, self.clip, constants)
        self._add_pushes(constants)
        self._lagged: Any = None
        self._motion: Held | Lagged
        if found.lag:
            self._lagged = lagged_code(scene, constants)
            lift = formulas.lift("z")
            self._motion = Lagged(self._lagged, lift, self.n_state, self.y, self.z, self.u, constants)
        else:
            self._motion = Held(self._stepper, self.y, self.z, self.u, self._x)
        sensors, actuators = self._sensors, self._actuators
        self.own = [
            *self.own, *actuators.reached, *sensors.shown, *actuators.ring.names, *sensors.ring.names,
        ]  # fmt: skip

    @property
    def order_constant(self) -> str | None:
        """See `Program.order_constant`."""
        return "lagged_order" if self._lagged else super().order_constant

    @property
    def tries_all(self) -> bool:
        """See `Program.tries_all`."""
        return True

    def _bound_observations(self) -> None:
        """Leave observations unbounded: what the sensors show is bounded later."""

    # --- one environment, alone or in a batch ---------------------------------------------------------------

    @property
    def _rows_of_constants(self) -> list[str]:
        return [f"k_{name}" for name in self.varying]

    @cached_property
    def take(self) -> Callable:
        """``take(f, base, stride, par, work, room, key)`` to (reward, over): a step of one environment.

        `work` holds the action; it receives the shown observation, or the controls of a refused step.
        """
        rows, actuators, sensors = self._where, self._actuators, self._sensors
        body = [
            *self._parameters(),
            *rows.load([*self._rows_of_constants, *self.y, *self.g, *actuators.reached, "n"]),
            *self._work.load(self.a), *actuators.perturb, *actuators.send(rows), *self._through,
            *self.outcome, *(["if over > 0.0:", *indent(self.last)] if self.last else []),
            "n = n + 1.0", *self.kick, *self.move,
            "if n >= k_limit:", "    over = over + 2.0",
            *sensors.read(rows),
            *rows.load(sensors.shown), *self._work.store(self.o, sensors.shown),
            *rows.store([*self.y, *actuators.reached, "n"]),
            *rows.store(self.u, [f"last_{u}" for u in self.u]),
            "return r, np.int64(over)",
        ]  # fmt: skip
        advance = self._lagged.compile() if self._lagged else self.advance
        return compiled_lines("take", "f, base, stride, par, work, room, key", body, advance)

    @property
    def _through(self) -> list[str]:
        """The lines of a whole step: from ``y`` to ``z``, with the mean controls in ``u``."""
        within, motion, actuators = self.options.within, self._motion, self._actuators
        move = [
            "h = end - t", *motion.move,
            "if status < 0:",
            *indent([*self._work.store(self.held, self.u), f"return 0.0, {SLOW}"]),
            *motion.behind,
            *(f"{y} = {z}" for y, z in zip(self.y, self.z, strict=True)),
            "t = end",
        ]  # fmt: skip
        # If nothing changes within the step it is one piece, and its mean control is the control itself.
        whole = ["h, t, end = k_dt, 0.0, k_dt", *actuators.command, *motion.mean, *move]
        commands = [*actuators.choose(self._where), "h = switch - t", *actuators.command, *motion.mean]
        pieces = [
            "t, switch = 0.0, 0.0",
            "while t < k_dt:",
            *indent([
                "if t == switch:", *indent(["switch = k_dt", *commands]),
                "end = switch",
                *self._sensors.divide,
                *move,
                *self._sensors.watch(self._where),
            ]),
        ]  # fmt: skip
        return [
            *(f"b_{y} = {y}" for y in self.y), *(f"mean_{u} = 0.0" for u in self.u),
            *motion.begin(self._where),
            *(pieces if within or actuators.ring.slots else whole),
            *(f"{y} = b_{y}" for y in self.y),
            *(f"last_{u}, {u} = {now}, mean_{u}" for u, now in zip(self.u, motion.reached, strict=True)),
        ]  # fmt: skip

    @property
    def room(self) -> int:
        """Numbers that the series needs."""
        return self._lagged.scratch if self._lagged else super().room

    @cached_property
    def launch(self) -> Callable:
        """``launch(f, base, stride, par, key, state_given, target_given)``: begin an episode."""
        rows, actuators = self._where, self._actuators
        undrawn = [row for row in self._rows_of_constants if row not in self.drawn]
        body = [
            *self._parameters(),
            *rows.load([*undrawn, *self.y[: self.n_state], *self.g]),
            *self._start, *actuators.begin(rows), *self._sensors.begin(rows),
            *rows.store([*self.y, *self.g, *self.u, *actuators.reached, "n", *self.drawn]),
        ]  # fmt: skip
        return compiled_lines("launch", "f, base, stride, par, key, state_given, target_given", body)

    # --- the functions of `Program` ------------------------------------------------------------------------

    def _slices(self, at: int, work: int) -> list[str]:
        """Return the lines that cut constants, working memory of a step and of the series out of an array."""
        return [
            f"par = memory[{at}:]",
            f"work = memory[{work}:]",
            f"room = memory[{max(at + len(self.uniform), work + len(self.scratch))}:]",
        ]

    @cached_property
    def step_one(self) -> Callable:
        """See `Program.step_one`."""
        first, n = len(self.kept), len(self.a)
        body = [
            "memory = f", *self._slices(first + len(self.scratch), first),
            *self._work.store(self.a, ["a"] if n == 1 else [f"a[{i}]" for i in range(n)]),
            "r, over = take(f, np.int64(0), np.int64(1), par, work, room, ids[2])",
            *self._work.load(self.o), *self._shown_one.store(self.o),
            "return r, over",
        ]  # fmt: skip
        return compiled_lines("step_one", "f, obs, a, ids", body, self.take)

    @cached_property
    def start_one(self) -> Callable:
        """See `Program.start_one`."""
        first = len(self.kept)
        body = [
            "memory = f", *self._slices(first + len(self.scratch), first), *next_episode("0", "1", "2"),
            "launch(f, np.int64(0), np.int64(1), par, key, state_given, target_given)",
            *self._one.load(self._sensors.shown), *self._shown_one.store(self.o, self._sensors.shown),
        ]  # fmt: skip
        return compiled_lines("start_one", "f, obs, ids, state_given, target_given", body, self.launch)

    def _each(self, body: Sequence[str]) -> list[str]:
        """Return the loop over the environments of a block."""
        return [
            "for lane in range(np.int64(first), np.int64(first + size)):",
            f"    base = (lane // {BLOCK}) * {BLOCK * len(self.kept)} + lane % {BLOCK}",
            *indent(body),
        ]

    @property
    def _show(self) -> list[str]:
        shown = self._sensors.shown
        return [*self._lane.load(shown), *Rows(self.o, "obs", "lane", "count").store(self.o, shown)]

    @property
    def room_of_all(self) -> int:
        """Numbers that `step_all` needs after the constants."""
        return len(self.scratch) + self.room

    @cached_property
    def step_blocks(self) -> Callable:
        """See `Program.step_blocks`."""
        n, stride = len(self.a), f"np.int64({BLOCK})"
        step = [
            *self._work.store(self.a, [f"action[lane * {n} + {j}]" for j in range(n)]),
            f"r, over = take(f, base, {stride}, par, work, room, ids[2 * count + lane])",
            f"if over == {SLOW}:",
            "    refused, over = max(refused, np.uint64(lane + 1)), 0",
            *indent([*self._work.load(self.held), *self._lane.store(self.asked or self.u, self.held)]),
            "if over > 0:",
            *indent([*self._lane.store(["n"], ["-np.float64(over)"]), "overs += np.uint64(1)"]),
        ]
        restart = [
            *next_episode("lane", "count + lane", "2 * count + lane"),
            f"launch(f, base, {stride}, par, key, False, False)",
            "r, over = 0.0, 0",
        ]
        body = [
            "memory = par", *self._slices(0, len(self.uniform)),
            *self._claimed(self._each([
                *self._lane.load(["n"]), "if n < 0.0:", *indent(restart), "else:", *indent(step),
                "reward[lane] = r",
                "terminated[lane] = (over == 1) | (over == 3)", "truncated[lane] = over >= 2",
                *self._show,
            ])),
        ]  # fmt: skip
        helpers = self.take, self.launch, *sharing.claiming()
        return compiled_lines("step_blocks", sharing.STEP_BLOCKS, body, *helpers, inner=True)

    @cached_property
    def start_all(self) -> Callable:
        """See `Program.start_all`."""
        begin = [
            *next_episode("lane", "count + lane", "2 * count + lane"),
            f"launch(f, base, np.int64({BLOCK}), par, key, state_given, target_given)",
        ]
        body = [
            f"for block in range(np.uint64((count + {BLOCK - 1}) // {BLOCK})):",
            *indent([
                *self._place,
                *self._each([
                    "if mask[lane]:", *indent(begin),
                    "if mask[lane] or whole:", *indent(self._show),
                ]),
            ]),
        ]  # fmt: skip
        arguments = "f, ids, par, obs, mask, whole, state_given, target_given, count"
        return compiled_lines("start_all", arguments, body, self.launch)
