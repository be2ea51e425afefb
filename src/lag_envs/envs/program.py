"""From a task to compiled functions: one program for the single and for the vector environment.

A program records the formulas of a task and its scene as lines of code and prints them into a few functions.
All keep one order within a step: control, held step, reward and ending, kick, observation.

Memory of one environment is a column of numbers, its rows. Kept from step to step: lifted state ``y``, target
``g`` where there is one, control ``u``, steps taken ``n`` (in a batch, where the episode is over, minus the
kind of its end: 1 terminated, 2 truncated, 3 both). Needed within a step: lifted state at its end ``z``,
reward ``r``, kind of end ``over``, whether the step was an ``ordinary`` one (1; 0 special; 2 none but a
restart), observation ``o``.

A batch is cut into blocks of 64 environments. The rows of a block lie behind one another at distances known
when compiling, so the compiler sees that they do not overlap and turns the loop over a block into vector
instructions; with one array per row it gives up on proving that. Rows needed within a step exist once for all
blocks and so stay in the processor's nearest cache.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from types import SimpleNamespace
from typing import Any

from lag_envs.stepping.compiling import compile_function
from lag_envs.stepping.flows import Stepper, lift_lines, section, split
from lag_envs.tasks.base import Task

BLOCK = 64
DRAWS = 16  #: random numbers set aside for one step; `primitives.uniform` counts on it
SLOW = -3  #: status of a step that the fast formula does not cover


def constants_of(task: Task) -> dict[str, float]:
    """Return every number that a task's compiled functions take, by name."""
    start = {f"centre{i}": c for i, c in enumerate(task.centre)} | {
        f"half{i}": h for i, h in enumerate(task.start)
    }
    return task.constants() | start | {"dt": task.dt, "x": task.largest_x}


def program_for(task: Task, absent: frozenset[str], varying: frozenset[str] = frozenset()) -> Program:
    """Return the program of a task: one for all tasks that differ in `constants_of` only."""
    scene = task.scene
    values = (getattr(scene, field.name) for field in dataclasses.fields(scene))
    choices = [math.isinf(v) if isinstance(v, float) else repr(v) for v in values]
    # Formulas may also name attributes of the task, which somebody may have set by hand.
    own = [(name, repr(v)) for name, v in vars(task).items() if name not in _NUMBERS]
    shared = [v for c in type(task).__mro__ for v in vars(c).values() if isinstance(v, int | float)]
    parts = (type(task), type(scene), task.variant, absent, varying, *choices, *own, *shared)
    if parts not in _programs:
        _programs[parts] = Program(task, absent, varying)
    return _programs[parts]


#: Attributes of a task whose numbers reach its code as constants, if at all.
_NUMBERS = {"scene", "dt", "duration", "target"}
_programs: dict[tuple, Program] = {}


class Program:
    """The compiled functions of a task.

    Parameters
    ----------
    task : Task
        Its class and its scene's class and control decide the code; its numbers do not.
    absent : frozenset of str
        Constants that are zero in every environment that the program is for: they leave no code behind.
    varying : frozenset of str
        Constants that differ within a batch; they become rows.
    """

    def __init__(self, task: Task, absent: frozenset[str], varying: frozenset[str] = frozenset()) -> None:
        scene = task.scene
        names = constants_of(task)
        self._stepper = Stepper(scene, absent)
        if max(task.draws, len(scene.state_names) + 1) > DRAWS:
            raise ValueError(f"a step may use {DRAWS} random numbers at most, got draws={task.draws}")
        self.y, self.z = self._stepper.start, self._stepper.end
        self.o = [f"o{i}" for i in range(len(task.observation))]
        self.g = ["g"] if task.target_range is not None else []
        self._record(task, {name: 0.0 if name in absent else f"k_{name}" for name in names})
        lines = [*self.control, *self.fast, *self.judge, *self.last, *self.kick, *self.observe, *self.sample]
        used = {"k_limit", *self._stepper.constants, *re.findall(r"\bk_\w+", " ".join(lines))}
        #: Names of the constants that are carried: those that are not zero, and that something uses.
        self.constants = [name for name in names if f"k_{name}" in used]
        self.uniform = [name for name in self.constants if name not in varying]
        self.varying = [name for name in self.constants if name in varying]
        #: Names of the rows that are kept from step to step, and of those that are needed within one.
        self.kept = [*self.y, *self.g, "u", "n", *(f"k_{name}" for name in self.varying)]
        self.scratch = [*self.z, "a", "r", "over", "ordinary", *self.o]

    def _record(self, task: Task, constants: dict[str, Any]) -> None:
        scene, width = task.scene, task.scene.width
        self.n_state = states = len(scene.state_names)
        given = list(constants.values())
        g: list[Any] = self.g or [0.0]

        def k(values: Sequence) -> SimpleNamespace:
            return SimpleNamespace(**dict(zip(constants, values, strict=True)))

        def control(xp: Any, a: Any, *values: Any) -> list:
            y, rest = split(values, width)
            return [task.control(a, y, k(rest), k(rest).dt, xp)]

        def judge(xp: Any, u: Any, g: Any, *values: Any) -> list:
            y, z, rest = split(values, width, width)
            reward = task.reward(y, z, u, g, k(rest), k(rest).dt, xp)
            return [reward, xp.where(task.terminated(z, k(rest), xp), 1.0, 0.0)]

        def last(xp: Any, u: Any, g: Any, *values: Any) -> list:
            y, z, rest = split(values, width, width)
            return [task.last_reward(y, z, u, g, k(rest), k(rest).dt, xp)]

        def kick(xp: Any, *values: Any) -> Sequence:
            draws, z, rest = split(values, task.draws, width)
            return task.kick(z, draws, k(rest), xp)

        def observe(xp: Any, g: Any, *values: Any) -> Sequence:
            y, rest = split(values, width)
            return task.observe(y, g, k(rest))

        def start(xp: Any, *values: Any) -> list:
            draws, rest = split(values, states + len(self.g))
            numbers = vars(k(rest))
            state = [
                numbers[f"centre{i}"] + numbers[f"half{i}"] * (2.0 * draws[i] - 1.0) for i in range(states)
            ]
            if not self.g:
                return state
            if task.target is not None:
                return [*state, k(rest).goal]
            return [*state, task.target_range * (2.0 * draws[states] - 1.0)]

        clip = ["a = select(a < -1.0, -1.0, select(a > 1.0, 1.0, a))"]
        self.control = clip + _lines(control, ["a", *self.y, *given], ["u"])
        self.fast = [f"dt = {constants['dt']}", *self._stepper.fast]
        #: What closed forms do without.
        self._x = constants["x"] if scene.order else 0.0
        if scene.order:
            self.fast.insert(0, f"x = {self._x}")
        self.judge = _lines(judge, ["u", *g, *self.y, *self.z, *given], ["r", "over"])
        has_last = type(task).last_reward is not Task.last_reward
        self.last = _lines(last, ["u", *g, *self.y, *self.z, *given], ["r"]) if has_last else []
        draws, kicked = [f"draw{i}" for i in range(task.draws)], [f"e{i}" for i in range(width)]
        self.kick = (
            _draw(draws, "np.uint64(n)") + _lines(kick, [*draws, *self.z, *given], kicked) if draws else []
        )
        self.moved = kicked if draws else self.z
        self.move = [f"{a} = {b}" for a, b in zip(self.y, self.moved, strict=True)]
        self.observe = _lines(observe, [*g, *self.y, *given], self.o)
        draws, names = ([f"{name}{i}" for i in range(states + len(self.g))] for name in ("draw", "s"))
        self.sample = _draw(draws, "np.uint64(0)") + _lines(start, [*draws, *given], names)
        self.lift = lift_lines(states, scene.angle, "y")

    # --- one environment: rows, then constants, in one array -----------------------------------------------

    @cached_property
    def step_one(self) -> Callable:
        """``step_one(f, obs, a, ids)`` to (reward, over), or to (0, SLOW) with only the control stored."""
        at = self._at_one
        body = [
            *self._constants_one(), *_load(at, [*self.y, *self.g, "n"]),
            *self.control, *_store(at, ["u"]), *self.fast,
            "if not within:", f"    return 0.0, {SLOW}",
            *self._finish_one(),
        ]  # fmt: skip
        return _function("step_one", "f, obs, a, ids", body)

    @cached_property
    def finish_one(self) -> Callable:
        """``finish_one(f, obs, ids)``: the rest of a step whose rows ``z`` were filled in by `advance`."""
        rows = _load(self._at_one, [*self.y, *self.z, *self.g, "u", "n"])
        return _function("finish_one", "f, obs, ids", [*self._constants_one(), *rows, *self._finish_one()])

    @cached_property
    def start_one(self) -> Callable:
        """``start_one(f, obs, ids, state_given, target_given)``: begin an episode, sampling the rest."""
        rows = [*self.y[: self.n_state], *self.g]
        body = [
            *self._constants_one(), *_load(self._at_one, rows),
            *_next_episode("0", "1", "2"), *self._start, *self.observe,
            *_store(self._at_one, [*self.y, *self.g, "u", "n"]),
            *(f"obs[{j}] = {o}" for j, o in enumerate(self.o)),
        ]  # fmt: skip
        return _function("start_one", "f, obs, ids, state_given, target_given", body)

    @cached_property
    def advance(self) -> Callable:
        """The scalar function for any step; see `Stepper.compile`."""
        return self._stepper.compile()

    @property
    def advance_constants(self) -> list[str]:
        """Names of the constants that `advance` takes after ``y..., u, dt, x``."""
        return [name.removeprefix("k_") for name in self._stepper.constants]

    @cached_property
    def model(self) -> Callable:
        """``model(states, actions, targets, par, ends, rewards, ended)``: a step from each state, no kick.

        Returns 0, or i + 1 where the step of row i was refused.
        """
        n = self.n_state
        call = ", ".join([*self.y, "u", "k_dt", str(self._x), *self._stepper.constants])
        row = [
            *(f"y{j} = states[i, {j}]" for j in range(n)), *self.lift,
            "a = actions[i]", *(["g = targets[i]"] if self.g else []),
            *self.control, *self.fast,
            "if not within:",
            *_indent([
                f"{', '.join(self.z)}, status = advance({call})",
                "if status < 0:", "    return i + 1",
            ]),
            *self.judge, *(["if over > 0.0:", *_indent(self.last)] if self.last else []),
            *(f"ends[i, {j}] = z{j}" for j in range(n)),
            "rewards[i] = r", "ended[i] = over > 0.0",
        ]  # fmt: skip
        body = [
            *(f"k_{name} = par[{j}]" for j, name in enumerate(self.uniform)),
            "for i in range(states.shape[0]):", *_indent(row),
            "return 0",
        ]  # fmt: skip
        return _function("model", "states, actions, targets, par, ends, rewards, ended", body, self.advance)

    def _at_one(self, row: str) -> str:
        return f"f[{(self.kept + self.scratch).index(row)}]"

    def _constants_one(self) -> list[str]:
        first = len(self.kept + self.scratch)
        return [f"k_{name} = f[{first + j}]" for j, name in enumerate(self.uniform)]

    def _finish_one(self) -> list[str]:
        return [
            *self.judge, *(["if over > 0.0:", *_indent(self.last)] if self.last else []),
            "n = n + 1.0", *(["key = ids[2]"] if self.kick else []), *self.kick, *self.move,
            "if n >= k_limit:", "    over = over + 2.0",
            *self.observe, *_store(self._at_one, [*self.y, "n"]),
            *(f"obs[{j}] = {o}" for j, o in enumerate(self.o)),
            "return r, np.int64(over)",
        ]  # fmt: skip

    @property
    def _start(self) -> list[str]:
        return [
            *self.sample,
            "if not state_given:", *_indent([f"y{i} = s{i}" for i in range(self.n_state)]),
            *(["if not target_given:", f"    g = s{self.n_state}"] if self.g else []),
            *self.lift, "u = 0.0", "n = 0.0",
        ]  # fmt: skip

    # --- a batch: blocks of rows of 64 environments --------------------------------------------------------

    @cached_property
    def step_all(self) -> Callable:
        """``step_all(f, ids, par, action, obs, reward, terminated, truncated, count)``.

        Steps every environment; one whose episode was over is restarted instead. Returns (status, over). The
        status is 0; or i + 1 where environment i was refused and kept its state; or -(i + 1), before anything
        was stepped, where action i is not finite. ``over`` counts the environments whose episode is over now.
        """
        y, z, varying = self.y, self.z, [f"k_{name}" for name in self.varying]
        lane = "for i in range(size):"
        inputs = _load(_at, [*varying, *y, *self.g, "n"])
        results = ["n", "over", "r", "ordinary", *self.o]
        key = ["key = ids[last + first + i]"] if self.kick else []
        # Where the fast formula does not hold, or the last reward is special, the start is kept for `redo`.
        special = " and not over > 0.0" if self.last else ""
        main = [
            *inputs, f"a = {_at('a')}", *self.control, *self.fast,
            "again = n < 0.0", *self.judge,
            f"plain = within{special}", "ordinary = select(again, 2.0, select(plain, 1.0, 0.0))",
            "n = n + 1.0", "over = select(n >= k_limit, over + 2.0, over)", *key, *self.kick,
            *(f"y{i} = select(plain, {value}, y{i})" for i, value in enumerate(self.moved)),
            "n = select(plain, select(over > 0.0, -over, n), n - 1.0)",
            *self.observe, *_store(_at, [*y, "u", *results]),
        ]  # fmt: skip
        call = ", ".join([*y, "u", "k_dt", str(self._x), *self._stepper.constants])
        redo = [
            f"if {_at('ordinary')} == 0.0:",
            *_indent([
                *inputs, f"u = {_at('u')}",
                f"{', '.join(z)}, status = advance({call})",
                "if status < 0:",
                "    refused = first + i + np.uint64(1)",
                f"    {_at('over')} = 0.0",
                "else:",
                *_indent([
                    *self.judge, *(["if over > 0.0:", *_indent(self.last)] if self.last else []),
                    "n = n + 1.0",
                    "if n >= k_limit:", "    over = over + 2.0",
                    *key, *self.kick, *self.move, *self.observe,
                    "if over > 0.0:", "    n = -over",
                    *_store(_at, [*y, "n", "over", "r", *self.o]),
                ]),
            ]),
        ]  # fmt: skip
        restart = [
            f"if {_at('ordinary')} == 2.0:",
            *_indent([
                *_load(_at, [*varying, *self.g]),
                *_next_episode("first + i", "second + first + i", "last + first + i"),
                "state_given, target_given = False, False", *self._start, "r = 0.0", "over = 0.0",
                *self.observe,
                *_store(_at, [*y, *self.g, "u", "n", "over", "r", *self.o]),
            ]),
        ]  # fmt: skip
        output = [
            f"reward[first + i] = {_at('r')}", f"over = {_at('over')}",
            "terminated[first + i] = (over == 1.0) | (over == 3.0)", "truncated[first + i] = over >= 2.0",
            "overs += over > 0.0",
        ]  # fmt: skip
        # An environment that is to be restarted ignores its action, whatever it is.
        place = f"(i // {BLOCK}) * {BLOCK * len(self.kept)} + {BLOCK * self.kept.index('n')} + i % {BLOCK}"
        running = f"f[{place}] >= 0.0"
        body = [
            "wide_vectors()",
            *(f"k_{name} = par[{j}]" for j, name in enumerate(self.uniform)),
            "second, last = np.uint64(count), np.uint64(2 * count)",
            "bad = 0",
            "for i in range(second):", "    bad += not (abs(action[i]) < math.inf)",
            "if bad > 0:",
            "    for i in range(count):",
            f"        if not (abs(action[i]) < math.inf) and {running}:",
            "            return -(i + 1), 0",
            "overs, refused = 0, np.uint64(0)",
            *self._each_block,
            *_indent([
                "slow, restarts = 0, 0",
                *_block(lane, [f"{_at('a')} = action[first + i]"]),
                *_block(lane, main),
                *_block(lane, [f"slow += {_at('ordinary')} == 0.0", f"restarts += {_at('ordinary')} == 2.0"]),
                "if slow > 0:", *_indent(_block(lane, redo)),
                "if restarts > 0:", *_indent(_block(lane, restart)),
                *_block(lane, output),
                # One loop per entry: one that writes to many arrays would have to check them for overlap.
                *(line for entry in _observations(self.o) for line in _block(lane, [entry])),
            ]),
            "return np.int64(refused), overs",
        ]  # fmt: skip
        arguments = "f, ids, par, action, obs, reward, terminated, truncated, count"
        return self._batch("step_all", arguments, body, self.advance)

    @cached_property
    def start_all(self) -> Callable:
        """``start_all(f, ids, par, obs, mask, whole, state_given, target_given, count)``.

        Begins episodes where the mask is set. Writes their observations, and with `whole` everybody's.
        """
        varying = [f"k_{name}" for name in self.varying]
        start = [
            "if mask[first + i] or whole:",
            *_indent([
                *_load(_at, [*varying, *self.y, *self.g, "u", "n"]),
                "if mask[first + i]:",
                *_indent([
                    *_next_episode("first + i", "second + first + i", "last + first + i"), *self._start,
                ]),
                *self.observe, *_store(_at, [*self.y, *self.g, "u", "n"]), *_observations(self.o, "{}"),
            ]),
        ]  # fmt: skip
        body = [
            *(f"k_{name} = par[{j}]" for j, name in enumerate(self.uniform)),
            "second, last = np.uint64(count), np.uint64(2 * count)",
            *self._each_block,
            *_indent(_block("for i in range(size):", start)),
        ]  # fmt: skip
        return self._batch(
            "start_all", "f, ids, par, obs, mask, whole, state_given, target_given, count", body
        )

    def _batch(self, name: str, arguments: str, body: Sequence[str], *helpers: Callable) -> Callable:
        """Compile a function on a batch: kept rows lie in `f`, the others behind the constants in `par`."""

        def place(match: re.Match) -> str:
            if match[1] in self.kept:
                return f"f[base + np.uint64({self.kept.index(match[1]) * BLOCK}) + i]"
            return f"par[np.uint64({len(self.uniform) + self.scratch.index(match[1]) * BLOCK}) + i]"

        # Indices are unsigned: a signed one might be negative, which by NumPy's rules makes a branch.
        return _function(name, arguments, [re.sub(r"row_(\w+)\[i\]", place, line) for line in body], *helpers)

    @property
    def _each_block(self) -> list[str]:
        """The head of the loop over blocks."""
        return [
            f"for block in range(np.uint64((count + {BLOCK - 1}) // {BLOCK})):",
            f"    first = block * np.uint64({BLOCK})",
            f"    size = min(np.uint64({BLOCK}), second - first)",
            f"    base = block * np.uint64({BLOCK * len(self.kept)})",
        ]


def _at(row: str) -> str:
    """Return a row's number in the environment at hand; `Program._batch` says where it lies."""
    return f"row_{row}[i]"


def _observations(names: Sequence[str], value: str = _at("{}")) -> list[str]:
    """Put the observation's numbers into the batch's array, one row per entry."""
    return [f"obs[{j}, first + i] = {value.format(o)}" for j, o in enumerate(names)]


def _next_episode(key: str, episode: str, episode_key: str) -> list[str]:
    return [
        f"ids[{episode}] += np.uint64(1)",
        f"key = episode_key(ids[{key}], ids[{episode}])",
        f"ids[{episode_key}] = key",
    ]


def _block(head: str, body: Sequence[str]) -> list[str]:
    return [head, *_indent(body)]


def _lines(formula: Callable, inputs: Sequence[Any], outputs: Sequence[str]) -> list[str]:
    """Record a formula; outputs that turned out constant are assigned as well."""
    lines, values = section(formula, inputs, outputs)
    return lines + [f"{name} = {value}" for name, value in zip(outputs, values, strict=True) if value != name]


def _draw(names: Sequence[str], step: str) -> list[str]:
    return [f"{name} = uniform(key, {step}, np.uint64({i}))" for i, name in enumerate(names)]


def _load(at: Callable, rows: Sequence[str]) -> list[str]:
    return [f"{row} = {at(row)}" for row in rows]


def _store(at: Callable, rows: Sequence[str]) -> list[str]:
    return [f"{at(row)} = {row}" for row in rows]


def _indent(lines: Sequence[str], levels: int = 1) -> list[str]:
    return ["    " * levels + line for line in lines]


def _function(name: str, arguments: str, body: Sequence[str], *helpers: Callable) -> Callable:
    return compile_function(name, "\n".join([f"def {name}({arguments}):", *_indent(body), ""]), *helpers)
