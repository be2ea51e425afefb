"""From a task to compiled functions: one program for the single and for the vector environment.

A program records the formulas of a task and its scene as lines of code and prints them into a few functions.
All functions follow one order within a step: control, held step, reward and ending, kick, observation.

The memory of one environment is a column of numbers, its rows. Rows kept from step to step: lifted state
``y``, target ``g`` if there is one, control ``u``, steps taken ``n`` (in a batch, once the episode is over,
minus the kind of its end: 1 terminated, 2 truncated, 3 both). Rows needed within a step: lifted state at its
end ``z``, reward ``r``, kind of end ``over``, whether the step was ``ordinary`` (1; 0 special; 2 a restart
instead of a step), observation ``o``; in a batch also ``lane``, the list of the lanes that were not ordinary.

A batch is cut into blocks of `BLOCK` environments. The rows of a block lie one after another at distances
known at compile time, so the compiler sees that they do not overlap and turns the loop over a block into
vector instructions; with one array per row it fails to prove this. Rows needed only within a step exist once
for all blocks and therefore stay in the processor's nearest cache.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cached_property
from types import SimpleNamespace
from typing import Any

from lag_envs.envs import sharing
from lag_envs.envs.lines import EACH_LANE, draw_lines, indented, next_episode, recorded_lines
from lag_envs.stepping import primitives
from lag_envs.stepping.compiling import BLOCK, compile_lines, indent, split_lengths
from lag_envs.stepping.rows import Rows

#: Random numbers reserved for one step.
DRAWS = int(primitives.DRAWS)
SLOW = -3  #: status of a step that the fast formula does not cover


def program_for(task: Any, absent: frozenset[str], varying: frozenset[str] = frozenset()) -> Program:
    """Return the program of a task: the same for all tasks that differ only in `formulas.constants()`."""
    key = (type(task), type(task.scene), task.formulas.key, absent, varying)
    if key not in _programs:
        _programs[key] = Program(task, absent, varying)
    return _programs[key]


_programs: dict[tuple, Program] = {}


def check_draws(task: Any) -> None:
    """Raise ValueError if a step or an episode's start needs more random numbers than are reserved."""
    if task.draws > DRAWS:
        raise ValueError(f"a kick takes {DRAWS} random numbers at most, got draws={task.draws}")
    needed = len(task.scene.state_names) + task.formulas.targets
    if needed > DRAWS:
        choices = {
            f.name: getattr(task.scene, f.name) for f in fields(task.scene) if "unit" not in f.metadata
        }
        made = "".join(f", {name}={value!r}" for name, value in choices.items())
        raise ValueError(
            "an episode's start takes a random number for each entry of the state and each target, at most "
            f"{DRAWS}, got {needed}: use a scene with fewer coordinates than {type(task.scene).__name__}"
            + (f" with {made[2:]}" if made else "")
        )


class Program:
    """The compiled functions of a task.

    Parameters
    ----------
    task : Task
        Its class, its scene's class and its control decide the code; its numbers do not.
    absent : frozenset of str
        Constants that are zero in every environment of the program; they leave no code.
    varying : frozenset of str
        Constants that differ within a batch; they become rows.
    names : sequence of str, optional
        All constants; by default those of the task.
    """

    #: Further rows that are kept, and the rows and constants that are set at an episode's start.
    own: Sequence[str] = ()
    drawn: Sequence[str] = ()
    #: The rows of its own that a step replaces once the step is accepted, and the names of their new values.
    reached: Sequence[str] = ()
    reaching: Sequence[str] = ()
    #: Further rows needed within a step.
    passing: Sequence[str] = ()
    #: Whether a batch has a loop after the step for the readings of the sensors.
    sensing = False
    #: Where actuators lag: names of the controls in force at a step's start and end, which the rows ``u``
    #: keep between steps, and of their means, which rewards use. Within a step ``u`` are the commands, until
    #: the means replace them. A batch keeps the commands of a refused step in rows `asked`.
    in_force: Sequence[str] = ()
    in_force_after: Sequence[str] = ()
    means: Sequence[str] = ()
    asked: Sequence[str] = ()

    def __init__(
        self,
        task: Any,
        absent: frozenset[str],
        varying: frozenset[str] = frozenset(),
        names: Sequence[str] | None = None,
    ) -> None:
        formulas = task.formulas
        check_draws(task)
        names = names or list(formulas.constants())
        constants = {name: 0.0 if name in absent else f"k_{name}" for name in names}
        self._code = self._step_code(formulas, absent, constants)
        #: Whether steps use the general series, block by block, instead of a flow, lane by lane.
        self.general = not hasattr(self._code, "fast")
        self.y, self.z = self._code.start, self._code.end
        self.o = [f"o{i}" for i in range(len(formulas.observation))]
        self.a = [f"a{i}" for i in range(formulas.actions)]
        self.u = [f"u{i}" for i in range(formulas.controls)]
        self.g = [f"g{i}" for i in range(formulas.targets)]
        self._record(formulas, constants)
        lines = " ".join(self._printed)
        used = {"k_limit", "k_dt", *self._code.constants, *re.findall(r"\bk_\w+", lines)}
        #: Names of the constants that are carried: those that are used and not zero.
        self.constants = [name for name in names if f"k_{name}" in used]
        self.uniform = [name for name in self.constants if name not in varying]
        self.varying = [name for name in self.constants if name in varying]
        #: Names of the rows that are kept from step to step, and of those needed within one. The rows of the
        #: series come first, one after the other.
        self.kept = [*self.y, *self.g, *self.u, "n", *(f"k_{name}" for name in self.varying), *self.own]
        self.flow = [f"flow_{name}" for name in self._code.rows] if self.general else []
        self.held = [f"held{i}" for i in range(len(self.u))]
        self.scratch = [
            *self.flow, *self.z, *self.a, "r", "over", "ordinary", "lane", *self.o, *self.held,
            *self.reaching, *(["clock"] if self.sensing else []), *self.passing,
        ]  # fmt: skip

    def _step_code(self, formulas: Any, absent: frozenset[str], constants: dict[str, Any]) -> Any:
        """Return the code of a step of the scene."""
        return formulas.step_code(absent)

    def _record(self, formulas: Any, constants: dict[str, Any]) -> None:
        width, actions, controls, targets = len(self.y), len(self.a), len(self.u), len(self.g)
        self.n_state = states = len(formulas.state)
        given = list(constants.values())

        def k(values: Sequence) -> SimpleNamespace:
            return SimpleNamespace(**dict(zip(constants, values, strict=True)))

        def control(xp: Any, *values: Any) -> Sequence:
            a, y, g, rest = split_lengths(values, actions, width, targets)
            return formulas.control(xp, a, y, g, k(rest))

        def outcome(xp: Any, *values: Any) -> list:
            u, g, y, z, rest = split_lengths(values, controls, targets, width, width)
            reward, ended = formulas.outcome(xp, y, z, u, g, k(rest))
            return [reward, xp.where(ended, 1.0, 0.0)]

        def last(xp: Any, *values: Any) -> list:
            u, g, y, z, rest = split_lengths(values, controls, targets, width, width)
            return [formulas.last(xp, y, z, u, g, k(rest))]

        def kick(xp: Any, *values: Any) -> Sequence:
            draws, z, rest = split_lengths(values, formulas.draws, width)
            return formulas.kick(xp, draws, z, k(rest))

        def observe(xp: Any, *values: Any) -> Sequence:
            g, y, rest = split_lengths(values, targets, width)
            return formulas.observe(xp, y, g, k(rest))

        def start(xp: Any, *values: Any) -> list:
            draws, rest = split_lengths(values, states + targets)
            return formulas.sample_start(draws, vars(k(rest)))

        def lines(formula: Callable, inputs: Sequence, outputs: Sequence[str]) -> list[str]:
            return recorded_lines(formula, inputs, outputs, formulas.trace)

        top = formulas.largest
        self.clip = [
            f"{a} = select({a} < {-top}, {-top}, select({a} > {top}, {top}, {a}))"
            for a in self.a
            if not formulas.choices
        ]
        self.control = self.clip + lines(control, [*self.a, *self.y, *self.g, *given], self.u)
        step = [*self.u, *self.g, *self.y, *self.z, *given]
        self.fast = [f"dt = {constants['dt']}", *([] if self.general else self._code.fast)]
        #: Closed forms do not need it.
        self._x = constants["x"] if formulas.bounded else 0.0
        if formulas.bounded:
            self.fast.insert(0, f"x = {self._x}")
        self.outcome = lines(outcome, step, ["r", "over"])
        self.last = lines(last, step, ["r"]) if formulas.has_last else []
        draws, kicked = [f"draw{i}" for i in range(formulas.draws)], [f"e{i}" for i in range(width)]
        self.kick = (
            draw_lines(draws, "np.uint64(n)") + lines(kick, [*draws, *self.z, *given], kicked)
            if draws
            else []
        )
        self.moved = kicked if draws else self.z
        self.move = [f"{a} = {b}" for a, b in zip(self.y, self.moved, strict=True)]
        self.observe = lines(observe, [*self.g, *self.y, *given], self.o)
        draws, names = ([f"{name}{i}" for i in range(states + targets)] for name in ("draw", "s"))
        self.sample = draw_lines(draws, "np.uint64(0)") + lines(start, [*draws, *given], names)
        self.lift = formulas.lift("y")

    @property
    def _printed(self) -> list[str]:
        """The lines that use constants."""
        parts = (self.control, self.fast, self.outcome, self.last, self.kick, self.observe, self.sample)
        return [line for part in parts for line in part]

    # --- one environment: rows, then constants, in one array -----------------------------------------------

    @cached_property
    def step_one(self) -> Callable:
        """``step_one(f, obs, a, ids)`` to (reward, over), or to (0, SLOW) with only the rows `held` written.

        Those rows hold the controls of a step that the fast formula does not cover, or that was refused. The
        action is a number if it has one entry, else an array.
        """
        body = [
            *self._constants_one(), *self._one.load([*self.y, *self.g, *self.reached, "n"]),
            *self._one.load(self.u[: len(self.in_force)], self.in_force),
            *([f"a0 = {'a' if len(self.a) == 1 else 'a[0]'}"] if self.a else []),
            *(f"{name} = a[{i}]" for i, name in enumerate(self.a) if i > 0),
            *self._command_one, *self._move_one, *self._finish_one(),
        ]  # fmt: skip
        helpers = [self._code.engine()] if self.tries_all else []
        return compile_lines("step_one", "f, obs, a, ids", body, *helpers)

    @property
    def _move_one(self) -> list[str]:
        """The lines from the command and ``y`` to ``z``, with the controls of the reward in ``u``."""
        if self.general:
            move = [self._room_one, *self._code.any_step, "if status < 0:"]
        else:
            move = ["if not within:"]
        return [
            *self._controls, *self.fast, *move, *indent(self._leave_one), *self._average,
            *self._one.store(self.u, self.in_force_after or self.u),
        ]  # fmt: skip

    @property
    def _average(self) -> list[str]:
        """The lines that replace the commands of lagging actuators by the mean controls."""
        return [f"{u} = {mean}" for u, mean in zip(self.u, self.means, strict=False)]

    @property
    def _room_one(self) -> str:
        """The line that names what the general series takes."""
        return f"rows, order = f[{len(self.kept + self.scratch) + len(self.uniform)}:], {self._x}"

    @property
    def _leave_one(self) -> list[str]:
        """The lines that end `step_one` at a step that was not taken."""
        store = self._one.store([*self.held, *self.reaching], [*self.u, *self.reaching])
        return [*store, f"return 0.0, {SLOW}"]

    @property
    def order_constant(self) -> str | None:
        """Name of the constant that is the order of the general series; None if steps do without."""
        return str(self._x).removeprefix("k_") if self.general else None

    @property
    def tries_all(self) -> bool:
        """Whether a step that `step_one` does not take is refused, rather than left to `advance`."""
        return self.general

    @cached_property
    def finish_one(self) -> Callable:
        """``finish_one(f, obs, ids)``: the rest of a step after `advance` has filled in the rows ``z``."""
        rows = self._one.load([*self.y, *self.z, *self.g, *self.u, *self.reaching, "n"])
        return compile_lines(
            "finish_one", "f, obs, ids", [*self._constants_one(), *rows, *self._finish_one()]
        )

    @cached_property
    def start_one(self) -> Callable:
        """``start_one(f, obs, ids, state_given, target_given)``: begin an episode, sampling the rest."""
        rows = [*self.y[: self.n_state], *self.g]
        body = [
            *self._constants_one(), *self._one.load(rows),
            *next_episode("0", "1", "2"), *self._start, *self._begin_one, *self._show_one,
            *self._one.store([*self.y, *self.g, *self.u, "n", *self.drawn]),
        ]  # fmt: skip
        return compile_lines("start_one", "f, obs, ids, state_given, target_given", body)

    @cached_property
    def advance(self) -> Callable:
        """The scalar function for any step; see `FlowCode.compile` and `SeriesCode.compile`."""
        return self._code.compile()

    @property
    def advance_constants(self) -> list[str]:
        """Names of the constants that `advance` takes after ``y..., u..., dt, x``."""
        return [name.removeprefix("k_") for name in self._code.constants]

    @cached_property
    def model(self) -> Callable:
        """``model(states, actions, targets, par, ends, rewards, ended)``: a step from each state, no kick.

        Returns 0, or i + 1 if the step of row i was refused.
        """
        n = self.n_state
        step = [*self._code.any_step, "if status < 0:", "    return i + 1"]
        slow = ["if not within:", f"    x = {self._x}", *indent(step)]
        row = [
            *(f"y{j} = states[i, {j}]" for j in range(n)), *self.lift,
            *(f"{a} = actions[i, {j}]" for j, a in enumerate(self.a)),
            *(f"{g} = targets[i, {j}]" for j, g in enumerate(self.g)),
            *self.control, *self.fast,
            *([f"order = {self._x}", *step] if self.general else slow),
            *self.outcome, *(["if over > 0.0:", *indent(self.last)] if self.last else []),
            *(f"ends[i, {j}] = z{j}" for j in range(n)),
            "rewards[i] = r", "ended[i] = over > 0.0",
        ]  # fmt: skip
        body = [
            *self._parameters(),
            *([f"rows = np.zeros({self._code.scratch})"] if self.general else []),
            "for i in range(states.shape[0]):", *indent(row),
            "return 0",
        ]  # fmt: skip
        arguments = "states, actions, targets, par, ends, rewards, ended"
        return compile_lines("model", arguments, body, self._code.engine())

    @property
    def room(self) -> int:
        """Numbers that `step_one` needs after the constants."""
        return self._code.scratch if self.general else 0

    @property
    def room_of_all(self) -> int:
        """Numbers that `step_all` needs after the constants."""
        return len(self.scratch) * BLOCK

    @property
    def _one(self) -> Rows:
        """The rows of a single environment."""
        constants = [f"k_{name}" for name in self.uniform]
        return Rows([*self.kept, *self.scratch, *constants], "f", "0", 1)

    def _constants_one(self) -> list[str]:
        return self._one.load([f"k_{name}" for name in self.uniform + self.varying])

    def _parameters(self) -> list[str]:
        """Return the line that reads the constants of a batch."""
        names = [f"k_{name}" for name in self.uniform]
        return Rows(names, "par", "0", 1).load(names)

    def _finish_one(self) -> list[str]:
        return [
            *self.outcome, *(["if over > 0.0:", *indent(self.last)] if self.last else []),
            "n = n + 1.0", *(["key = ids[2]"] if self.kick else []), *self.kick, *self.move,
            "if n >= k_limit:", "    over = over + 2.0",
            *self._observe_one, *self._show_one,
            *self._one.store([*self.y, *self.reached, "n"], [*self.y, *self.reaching, "n"]),
            "return r, np.int64(over)",
        ]  # fmt: skip

    # What a subclass may do before the controls, and with the observation.

    @property
    def _command_one(self) -> list[str]:
        """The lines that turn an action into the command in force."""
        return []

    @property
    def _controls(self) -> list[str]:
        """The lines that turn the command in force into controls."""
        return self.control

    @property
    def _observe_one(self) -> list[str]:
        """The lines that observe the end of a step."""
        return self.observe

    @property
    def _begin_one(self) -> list[str]:
        """The lines that observe a start."""
        return self.observe

    @property
    def _show_one(self) -> list[str]:
        """The lines that put the observation into the environment's array."""
        return self._shown_one.store(self.o)

    @property
    def _shown_one(self) -> Rows:
        """The array of the environment's observation."""
        return Rows(self.o, "obs", "0", 1)

    @property
    def _start(self) -> list[str]:
        return [
            *self.sample,
            "if not state_given:", *indent([f"y{i} = s{i}" for i in range(self.n_state)]),
            *(
                ["if not target_given:", *(f"    {g} = s{self.n_state + i}" for i, g in enumerate(self.g))]
                if self.g
                else []
            ),
            *self.lift, *(f"{u} = 0.0" for u in self.u), "n = 0.0",
        ]  # fmt: skip

    # --- a batch: blocks of rows ---------------------------------------------------------------------------

    @cached_property
    def step_blocks(self) -> Callable:
        """A step of the environments in the blocks that a thread claims; see `sharing.compile_step_all`.

        All lanes of a block take an ordinary step first. Then come those that this left: starts of episodes,
        and steps for which the fast formula does not hold, or whose last reward is special.
        """
        output = [
            *self._load(["r", "over"]), "reward[first + i] = r",
            "terminated[first + i] = (over == 1.0) | (over == 3.0)", "truncated[first + i] = over >= 2.0",
            "overs += np.uint64(over > 0.0)",
        ]  # fmt: skip
        body = [
            "wide_vectors()",
            *self._parameters(),
            "second, last = np.uint64(count), np.uint64(2 * count)",
            *self._claimed([
                self._base,
                "special = np.uint64(0)",
                *(
                    line
                    for j, a in enumerate(self.a)
                    for line in indented(EACH_LANE, self._store([a], [f"action[{self._action(j)}]"]))
                ),
                *self._command_lanes, *self._move_lanes,
                *indented(EACH_LANE, self._ordinary_step),
                *indented(EACH_LANE, [*self._load(["ordinary"]), "special += np.uint64(ordinary != 1.0)"]),
                "if special > np.uint64(0):", *indent(self._special_lanes),
                *self._sense_lanes,
                *indented(EACH_LANE, output),
                *self._show_block,
            ]),
        ]  # fmt: skip
        engine = self._code.compile_block if self.general else self._code.engine
        return compile_lines(
            "step_blocks", sharing.STEP_BLOCKS, body, engine(), *sharing.claiming(), inner=True
        )

    @property
    def _ordinary_step(self) -> list[str]:
        """The lines of a lane's ordinary step; ``ordinary`` is 1 if it was one, 2 if an episode starts, or 0.

        Only the state after an ordinary step is kept; otherwise the start is, for `_special_step`.
        """
        holds = "within and not over > 0.0" if self.last else "within"
        return [
            *self._inputs, *self._to_end,
            "again = n < 0.0", *self.outcome,
            f"plain = {holds}", "ordinary = select(again, 2.0, select(plain, 1.0, 0.0))",
            "n = n + 1.0", *self._counted, "over = select(n >= k_limit, over + 2.0, over)",
            *self._kick_of_lane,
            *(f"y{i} = select(plain, {value}, y{i})" for i, value in enumerate(self.moved)),
            "n = select(plain, select(over > 0.0, -over, n), n - 1.0)",
            *(f"{start} = select(plain, {end}, {start})" for start, end in self._forced),
            *self.observe, *self._store([*self.y, *([] if self._move_lanes else [*self.u, *self.reaching])]),
            *self._store(self.u[: len(self._forced)], self.in_force),
            *self._store([*self._results, "ordinary"]),
        ]  # fmt: skip

    @property
    def _special_lanes(self) -> list[str]:
        """The loops that list the lanes that have taken no ordinary step, and that go through the list.

        Without a list, each lane would need a branch; in some processes, steps took nearly twice as long.
        """
        end, entry = (self._scratch_rows_at(place) for place in ("found", "j"))
        listed = [*self._load(["ordinary"]), *end.store(["lane"], ["np.float64(i)"])]
        return [
            "found = np.uint64(0)",
            *indented(EACH_LANE, [*listed, "found += np.uint64(ordinary != 1.0)"]),
            *indented(
                "for j in range(special):",
                [*entry.load(["lane"]), "i = np.uint64(lane)", *self._special_step],
            ),
        ]

    @property
    def _special_step(self) -> list[str]:
        """The lines of a lane that has taken no ordinary step: any other step, or the start of an episode."""
        refused = [*self._load(self.held, self.asked), *self._store(self.asked)] if self.asked else []
        ends = [*self.y, *self.u[: len(self._forced)], *self._results]
        return [
            *self._load(["ordinary"]),
            "if ordinary == 0.0:",
            *indent([
                *self._inputs, *self._to_end_again,
                "if status < 0:",
                "    refused = max(refused, first + i + np.uint64(1))",
                *indent([*self._store(["over", "r"], ["0.0", "REFUSED"]), *refused]),
                "else:",
                *indent([
                    *self.outcome, *(["if over > 0.0:", *indent(self.last)] if self.last else []),
                    "n = n + 1.0", *self._counted,
                    "if n >= k_limit:", "    over = over + 2.0",
                    *self._kick_of_lane, *self.move, *self.observe,
                    "if over > 0.0:", "    n = -over",
                    *self._store(ends, [*self.y, *self.in_force_after, *self._results]),
                    *(self._store(["ordinary"], ["1.0"]) if self.sensing else []),
                ]),
            ]),
            "elif ordinary == 2.0:",
            *indent([
                *self._load([*(f"k_{name}" for name in self.varying), *self.g]),
                *next_episode("first + i", "second + first + i", "last + first + i"),
                "state_given, target_given = False, False", *self._start, *self._begin_lane,
                "r = 0.0", "over = 0.0",
                *self._store([*self.y, *self.g, *self.u, "n", *self.drawn, "over", "r", *self.o]),
            ]),
        ]  # fmt: skip

    @property
    def _results(self) -> list[str]:
        """The rows that a step leaves besides the state."""
        return ["n", "over", "r", *self.o, *(["clock"] if self.sensing else [])]

    @property
    def _counted(self) -> list[str]:
        """The line that gives sensors the step's number."""
        return ["clock = n"] if self.sensing else []

    @property
    def _kick_of_lane(self) -> list[str]:
        """The lines of a random kick."""
        return [self._key, *self.kick] if self.kick else []

    @property
    def _forced(self) -> list[tuple[str, str]]:
        """The rows of the controls in force at a step's start, each with that at its end."""
        return list(zip(self.in_force, self.in_force_after, strict=True))

    @property
    def _inputs(self) -> list[str]:
        """The lines that load what a step starts from."""
        return self._load([*(f"k_{name}" for name in self.varying), *self.y, *self.g, *self.reached, "n"])

    @property
    def _commands(self) -> Sequence[str]:
        """The rows that keep the commands within a step."""
        return self.held if self.in_force else self.u

    @property
    def _in_force(self) -> list[str]:
        """The lines that load the controls at a step's start, where actuators lag."""
        return self._load(self.u[: len(self.in_force)], self.in_force)

    @property
    def _flow(self) -> dict[str, str]:
        """The rows of the general series, by their names in its code."""
        return dict(zip(self._code.rows, self.flow, strict=True))

    def _advance_lanes(self, before: Sequence[str]) -> list[str]:
        """Return the loop that fills in rows for the general series, and the call that moves the block."""
        given = self._code.given
        store = [*self._code.prepare, *self._store([self._flow[name] for name in given], given)]
        call = f"advance_block(par, np.int64({len(self.uniform)}), size, np.int64({self._x}))"
        return [*indented(EACH_LANE, [*before, *store]), call]

    @property
    def _advanced(self) -> list[str]:
        """The lines that load what the general series made of it."""
        results = self._code.results
        return [*self._load([self._flow[name] for name in results], results), *self._code.finish]

    @property
    def _move_lanes(self) -> list[str]:
        """The loops and calls that move a block before the main loop; a flow moves it there."""
        if not self.general:
            return []
        # The status of a lane shows that it is to be restarted, not stepped.
        return self._advance_lanes([
            *self._inputs, *self._load(self.a), *self._controls, *self._in_force,
            "status, span = select(n < 0.0, -1.0, 0.0), k_dt",
            *self._store([*self._commands, *self.reaching], [*self.u, *self.reaching]),
        ])  # fmt: skip

    @property
    def _to_end(self) -> list[str]:
        """The lines of the main loop to ``z`` and to the controls of the reward, and whether they hold."""
        if self.general:
            return [*self._to_end_again, "within = status > 0.0"]
        return [*self._load(self.a), *self._controls, *self.fast]

    @property
    def _to_end_again(self) -> list[str]:
        """The same with the commands stored, for any step of a single lane."""
        if not self.general:
            return [*self._load(self.u), f"dt, x = k_dt, {self._x}", *self._code.any_step]
        return [
            *self._load(self._commands, self.u), *self._in_force, *self.fast, *self._advanced, *self._average,
        ]  # fmt: skip

    def _claimed(self, body: Sequence[str]) -> list[str]:
        """Return the loop over the blocks that a thread claims; the body counts `overs`, sets `refused`."""
        claim = "block, tried = next_block(ids, at, turn, blocks, {}, share, shares)"
        return [
            "overs, refused, taken = np.uint64(0), np.uint64(0), np.uint64(0)",
            claim.format("np.uint64(0)"),
            "while block < blocks:",
            *indent([*self._place, *body, "taken += np.uint64(1)", claim.format("tried")]),
            "hand_in(ids, at, taken, overs, refused)",
        ]  # fmt: skip

    @property
    def _show_block(self) -> list[str]:
        """The line that puts the observations of a block into the batch's array."""
        return Rows(self.scratch, "par", self._scratch, BLOCK).copy(self.o, "size", "obs", "first")

    #: The key of the current environment's episode.
    _key = "key = ids[last + first + i]"

    # The same for a batch.

    @property
    def _command_lanes(self) -> list[str]:
        """The loops that turn actions into the commands in force."""
        return []

    @property
    def _sense_lanes(self) -> list[str]:
        """The loops that show what the sensors read after a step."""
        return []

    @property
    def _begin_lane(self) -> list[str]:
        """The lines that observe a start."""
        return self.observe

    @property
    def _show_lane(self) -> list[str]:
        """The lines that show the current environment, apart from a step."""
        rows = [*(f"k_{name}" for name in self.varying), *self.y, *self.g]
        return [*self._load(rows), *self.observe, *self._shown_lane.store(self.o)]

    @property
    def _shown_lane(self) -> Rows:
        """The places of the current environment's observation in the batch's array."""
        return Rows(self.o, "obs", "first + i", "count")

    def _action(self, j: int) -> str:
        """Return the place of action j of the current environment in the batch's array."""
        n = len(self.a)
        return "first + i" if n == 1 else f"np.uint64({n}) * (first + i) + np.uint64({j})"

    @cached_property
    def start_all(self) -> Callable:
        """``start_all(f, ids, par, obs, mask, whole, state_given, target_given, count)``.

        Begins episodes where the mask is set. Writes their observations, and with `whole` all observations.
        """
        rows = [*(f"k_{name}" for name in self.varying), *self.y, *self.g]
        start = [
            "if mask[first + i]:",
            *indent([
                *self._load(rows),
                *next_episode("first + i", "second + first + i", "last + first + i"),
                *self._start, *self._begin_lane,
                *self._store([*self.y, *self.g, *self.u, "n", *self.drawn]),
            ]),
            "if mask[first + i] or whole:", *indent(self._show_lane),
        ]  # fmt: skip
        body = [
            *self._parameters(),
            "second, last = np.uint64(count), np.uint64(2 * count)",
            f"for block in range(np.uint64((count + {BLOCK - 1}) // {BLOCK})):",
            *indent([*self._place, self._base, *indented(EACH_LANE, start)]),
        ]  # fmt: skip
        return compile_lines(
            "start_all", "f, ids, par, obs, mask, whole, state_given, target_given, count", body
        )

    # The rows of the current environment: those kept from step to step, and those needed within one, which
    # exist once for all blocks.

    @property
    def _kept_rows(self) -> Rows:
        return Rows(self.kept, "f", "base + i", BLOCK)

    @property
    def _scratch_rows(self) -> Rows:
        return self._scratch_rows_at("i")

    def _scratch_rows_at(self, place: str) -> Rows:
        return Rows(self.scratch, "par", f"{self._scratch} + {place}", BLOCK)

    @property
    def _scratch(self) -> str:
        return f"np.uint64({len(self.uniform)})"

    def _load(self, rows: Sequence[str], names: Sequence[str] | None = None) -> list[str]:
        """Return the lines that read rows into variables, by default of their names."""
        return self._each_kind(Rows.load, rows, names)

    def _store(self, rows: Sequence[str], values: Sequence[str] | None = None) -> list[str]:
        """Return the lines that write rows, by default from variables of their names."""
        return self._each_kind(Rows.store, rows, values)

    def _each_kind(self, move: Callable, rows: Sequence[str], names: Sequence[str] | None) -> list[str]:
        pairs = list(zip(rows, names or rows, strict=True))
        kinds = (self._kept_rows, self._scratch_rows)
        chosen = ((kind, [pair for pair in pairs if pair[0] in kind.names]) for kind in kinds)
        return [line for kind, found in chosen if found for line in move(kind, *zip(*found, strict=True))]

    @property
    def _place(self) -> list[str]:
        """The lines that say which environments a block contains."""
        return [
            f"first = block * np.uint64({BLOCK})",
            f"size = min(np.uint64({BLOCK}), np.uint64(count) - first)",
        ]

    @property
    def _base(self) -> str:
        """The line that says where the rows of a block begin."""
        return f"base = block * np.uint64({BLOCK * len(self.kept)})"
