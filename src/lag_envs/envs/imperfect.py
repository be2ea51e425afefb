"""Programs of environments with hidden parameters, imperfect sensors or actuators.

What the keywords mean is told in docs/usage.md; `lag_envs.tasks.imperfections` checks them. Parameters that
are drawn are rows of a batch, as those that differ in any batch are (`DrawnProgram`). With everything else
(`ImperfectProgram`) a control step is taken by one function on the rows of one environment. The single
environment calls it on its own rows, a batch on those of each environment in turn, so both have the same
bits. Within the step the command in force may change, and what a late sensor shows may lie in its midst: it
is divided there, and nowhere else.

Draws come from the same generator as starts and kicks, with a key of their own for each purpose, which
follows from the episode's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cached_property
from types import SimpleNamespace
from typing import Any

from lag_envs.envs import sharing
from lag_envs.envs.program import (
    DRAWS,
    SLOW,
    STEP_BLOCKS,
    Program,
    _indent,
    _lines,
    _next_episode,
    constants_of,
    program_for,
)
from lag_envs.mechanics.algebra import evaluate
from lag_envs.mechanics.recording import formula as naming
from lag_envs.mechanics.recording import parameter, twin
from lag_envs.stepping.compiling import BLOCK, compile_function, record_block
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.flows import split
from lag_envs.stepping.tracing import Number
from lag_envs.stepping.twofold import two_product, two_sum
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import Imperfections, normals, seen_box

#: What has draws of its own, by the number that its key is made with.
PURPOSES = {"parameters": 1, "observation": 2, "action": 3, "delay": 4, "push": 5}


def numbers_of(task: Task) -> dict[str, float]:
    """Return every number that an environment's compiled functions take, by name."""
    found = task.imperfections
    if found is None:
        return constants_of(task)
    numbers = dict(constants_of(task.drawn.inner if task.drawn else task))
    for name, values in (
        ("sigma", found.observation_noise),
        ("shake", found.action_noise),
        ("slew", found.slew),
        ("push", found.push),
        ("draw_base", [d.base for d in found.drawn]),
        ("draw_low", [d.low for d in found.drawn]),
        ("draw_high", [d.high for d in found.drawn]),
        ("rest", _listed(task.formulas.rest_action) if task.formulas.acting else []),
        *zip(("seen_low", "seen_high"), seen_box(task), strict=True),
    ):
        numbers |= {f"{name}{i}": float(value) for i, value in enumerate(values)}
    # Pushes that come at a rate: the chance that there is one in a step.
    numbers["push_chance"] = -math.expm1(-found.push_rate * task.dt)
    numbers["late_low"], numbers["late_high"] = found.action_delay
    if found.lag:
        scene = (task.drawn.inner if task.drawn else task).scene
        numbers |= {f"lagged_{name}": x for name, x in scene._constants(lagged=True).items()}
        numbers |= {f"decay{i}": x for i, x in enumerate(found.lag)}
        numbers["lagged_order"] = scene._limit(task.dt, lagged=True)
    numbers["shown_at"] = (1.0 - found.observation_delay % 1.0) * task.dt
    return numbers | {"every": float(found.observation_every)}


def program_of(task: Task, constants: Sequence[dict[str, float]]) -> Program:
    """Return the program of an environment, or of a batch of tasks that have these constants."""
    absent = frozenset(name for name in constants[0] if all(c[name] == 0.0 for c in constants))
    varying = frozenset(
        name for name in constants[0] if any(c[name] != constants[0][name] for c in constants)
    )
    if task.imperfections is None:
        return program_for(task, absent, varying)
    key = (type(task), type(task.scene), task.formulas.key, task.imperfections.structure, absent, varying)
    if task.drawn:
        key = (*key, task.drawn.inner.formulas.key, *task.drawn.made)
    if key not in _programs:
        only_drawn = Imperfections(drawn=task.imperfections.drawn) == task.imperfections
        _programs[key] = (DrawnProgram if only_drawn else ImperfectProgram)(task, absent, varying)
    return _programs[key]


_programs: dict[tuple, DrawnProgram] = {}


class DrawnProgram(Program):
    """The compiled functions of a task whose parameters are drawn; parameters as those of `Program`.

    The drawn parameters ``p_`` are rows, and so are the constants that follow from them. Beside that, and for
    observations within their bounds, steps are those of any batch whose environments differ.
    """

    def __init__(self, task: Task, absent: frozenset[str], varying: frozenset[str]) -> None:
        assert task.imperfections is not None
        self.options = task.imperfections
        self._made = _Constants(task, absent) if task.drawn else None
        changed = self._made.changed if self._made else []
        self.p = [f"p_{d.name}" for d in self.options.drawn]
        self.own = [*self.p, *self.own]
        source = task.drawn.inner if task.drawn else task
        super().__init__(source, absent, varying | frozenset(changed), list(numbers_of(task)))
        self.drawn = [*self.p, *(f"k_{name}" for name in self.varying if name in changed)]

    @property
    def _printed(self) -> list[str]:
        return [*super()._printed, *self.begin]

    def _record(self, formulas: Any, constants: dict[str, Any]) -> None:
        super()._record(formulas, constants)
        self._numbers = constants
        self.begin = self._made.lines(constants) if self._made else []
        self._bounded = [self._between(o, f"seen_low{i}", f"seen_high{i}") for i, o in enumerate(self.o)]
        self._bound_observations()

    def _bound_observations(self) -> None:
        self.observe = [*self.observe, *self._bounded]

    def _constant(self, name: str) -> str:
        return str(self._numbers[name])

    def _between(self, value: str, low: str, high: str) -> str:
        low, high = self._constant(low), self._constant(high)
        return f"{value} = select({value} < {low}, {low}, select({value} > {high}, {high}, {value}))"

    @staticmethod
    def _key(purpose: str) -> str:
        return f"episode_key(key, np.uint64({PURPOSES[purpose]}))"

    @property
    def _start(self) -> list[str]:
        draws = (f"uniform(key_parameters, np.uint64(0), np.uint64({j}))" for j in range(len(self.p)))
        return [
            *([f"key_parameters = {self._key('parameters')}"] if self.p else []),
            *(f"share{j} = {draw}" for j, draw in enumerate(draws)),
            *self.begin,
            *super()._start,
        ]


class ImperfectProgram(DrawnProgram):
    """The compiled functions of a task with imperfections; parameters as those of `Program`.

    Rows that are kept besides: the commands that the actuator's slew has reached ``c``, those under way
    ``sent`` with the time ``at`` which each takes, observations that are still to be seen ``seen``, and what
    was shown last ``h``.
    """

    def __init__(self, task: Task, absent: frozenset[str], varying: frozenset[str]) -> None:
        found: Any = task.imperfections
        source = task.drawn.inner if task.drawn else task
        self._lagged: Any = None
        if found.lag:
            gone = frozenset(n.removeprefix("lagged_") for n in absent if n.startswith("lagged_"))
            self._lagged = source.scene._lagged.code(gone)
        self.a = [f"a{i}" for i in range(source.formulas.actions)]
        seen = range(len(source.formulas.observation))
        self.c = list(map("c{}".format, range(len(self.a)))) if found.slew else []
        ring = range(found.commands if found.commands > 1 else 0)
        self.own = [
            *self.c, *(f"h{i}" for i in seen),
            *(f"{row}_{slot}" for slot in ring for row in [*(f"sent{i}" for i in range(len(self.a))), "at"]),
            *(f"seen{i}_{slot}" for slot in range(found.readings) for i in seen),
        ]  # fmt: skip
        super().__init__(task, absent, varying)
        self.scratch = [*self.a, *self.o, *self.held]

    # --- lines ----------------------------------------------------------------------------------------------

    @property
    def _printed(self) -> list[str]:
        more = (self.perturb, self.sense, self.push, self.at_rest, self.command, self.respond)
        return [*super()._printed, *(line for part in more for line in part)]

    def _record(self, formulas: Any, constants: dict[str, Any]) -> None:
        super()._record(formulas, constants)
        found = self.options
        actions, width = len(self.a), len(self.y)
        given = constants | {"dt": "h"}  # within a piece of a step, its length

        def asked(xp: Any, *values: Any) -> Sequence:
            return formulas.wanted(xp, list(values))

        def limited(xp: Any, *values: Any) -> list:
            a, c, (h,), rest = split(values, actions, actions, 1)
            at = dict(zip(constants, rest, strict=True))
            reached = []
            for i, (u, old) in enumerate(zip(formulas.wanted(xp, a), c, strict=True)):
                if found.slew[i] < math.inf:
                    most = h * at[f"slew{i}"]
                    u = xp.minimum(xp.maximum(u, old - most), old + most)
                reached.append(u)
            return reached

        def guarded(xp: Any, *values: Any) -> Sequence:
            w, y, rest = split(values, actions, width)
            k = SimpleNamespace(**dict(zip(constants, rest, strict=True)))
            return formulas.guarded(xp, w, y, k)

        def record(formula: Callable, inputs: Sequence, outputs: Sequence[str]) -> list[str]:
            return _lines(formula, inputs, outputs, formulas.trace)

        wanted = [f"w{i}" for i in range(actions)]
        #: From the command in force to the control: ``a``, ``c``, ``y``, ``h`` to ``u``.
        if self.c:
            self.command = record(limited, [*self.a, *self.c, "h", *constants.values()], wanted)
            self.command += [f"{c} = {w}" for c, w in zip(self.c, wanted, strict=True)]
        else:
            self.command = record(asked, self.a, wanted)
        self.command += record(guarded, [*wanted, *self.y, *given.values()], self.u)
        #: The command before the first.
        self.at_rest = [f"{a} = {self._constant(f'rest{i}')}" for i, a in enumerate(self.a)]
        if self.c:
            self.at_rest += record(asked, self.a, self.c)
        self._lift_end = formulas.lift("z")
        self.perturb = self._perturb(formulas)
        self.sense = self._noisy(self.o, "observation", found.observation_noise, "sigma", formulas)
        self.sense += self._bounded
        self.push = self._pushes()
        self.respond = [f"k_{name}" for name in ("late_low", "late_high", "shown_at", "every", "push_chance")]
        if self._lagged:
            self.respond += [*self._decays, "k_lagged_order", *self._lagged_constants]

    @property
    def _decays(self) -> list[str]:
        return [self._constant(f"decay{i}") for i in range(len(self.u))]

    @property
    def _lagged_constants(self) -> list[str]:
        return [name.replace("k_", "k_lagged_", 1) for name in self._lagged.constants]

    def _bound_observations(self) -> None:
        """Leave what is observed as it is: what is shown follows later."""

    def _noisy(
        self, values: Sequence[str], purpose: str, sigma: Sequence[float], name: str, formulas: Any
    ) -> list[str]:
        """Return the lines that add normal draws to values; each two share a pair of uniform ones."""
        if not sigma:
            return []

        def recorded(xp: Any, first: Any, second: Any) -> list:
            return normals(first, second, xp)

        lines = [f"key_{purpose} = {self._key(purpose)}"]
        per_step = -(-(len(values) + len(values) % 2) // DRAWS)  # each step has that many times `DRAWS`
        for i in range(0, len(values), 2):
            pair = [j for j in (i, i + 1) if j < len(values) and sigma[j] > 0.0]
            if pair:
                lines += [
                    f"{x} = uniform(key_{purpose}, np.uint64(n) * np.uint64({per_step}), np.uint64({j}))"
                    for x, j in zip(("first", "second"), (i, i + 1), strict=True)
                ]
                lines += _lines(recorded, ["first", "second"], ["normal0", "normal1"], formulas.trace)
                lines += [f"{values[j]} += {self._constant(f'{name}{j}')} * normal{j - i}" for j in pair]
        return lines

    def _perturb(self, formulas: Any) -> list[str]:
        """Return the lines that make the command of an action."""
        noise = self._noisy(self.a, "action", self.options.action_noise, "shake", formulas)
        return [*self.clip, *noise, *(self.clip if noise else [])]

    def _pushes(self) -> list[str]:
        """Return the lines that push free velocities, now and then, after a step."""
        found = [i for i, size in enumerate(self.options.push) if size > 0.0]
        if not found:
            return []
        draws = (f"uniform(key_push, np.uint64(n), np.uint64({1 + j}))" for j in range(len(found)))
        return [
            f"key_push = {self._key('push')}",
            f"if uniform(key_push, np.uint64(n), np.uint64(0)) < {self._constant('push_chance')}:",
            *(
                f"    y{i} = y{i} + {self._constant(f'push{i}')} * (2.0 * {draw} - 1.0)"
                for i, draw in zip(found, draws, strict=True)
            ),
        ]

    # --- one environment, alone or in a batch: row r lies at f[base + r * stride] --------------------------

    def _at(self, row: str, slot: str = "") -> str:
        """Return where a row lies; with `slot` that of the slot of a ring with this number."""
        if not slot:
            return f"f[base + {self.kept.index(row)} * stride]"
        first = self.kept.index(f"{row}_0")
        width = len(self.o) if row.startswith("seen") else len(self.a) + 1
        return f"f[base + ({first} + {slot} * {width}) * stride]"

    def _load_row(self, rows: Sequence[str]) -> list[str]:
        return [f"{row} = {self._at(row)}" for row in rows]

    def _store_row(self, rows: Sequence[str]) -> list[str]:
        return [f"{self._at(row)} = {row}" for row in rows]

    @property
    def _parameters(self) -> list[str]:
        return [f"k_{name} = par[{j}]" for j, name in enumerate(self.uniform)]

    @property
    def _rows_of_constants(self) -> list[str]:
        return [f"k_{name}" for name in self.varying]

    @cached_property
    def take(self) -> Callable:
        """``take(f, base, stride, par, work, room, key)`` to (reward, over): a step of one environment.

        `work` has the action; it gets what is shown, or the controls of a step that is refused.
        """
        n_act, n_seen = len(self.a), len(self.o)
        body = [
            *self._parameters,
            *self._load_row([*self._rows_of_constants, *self.y, *self.g, *self.c, "n"]),
            *(f"a{i} = work[{i}]" for i in range(n_act)),
            *self.perturb, *self._send, *self._through,
            *self.outcome, *(["if over > 0.0:", *_indent(self.last)] if self.last else []),
            "n = n + 1.0", *self.kick, *self.move, *self.push,
            "if n >= k_limit:", "    over = over + 2.0",
            *self.observe, *self._read(),
            *(f"work[{n_act + i}] = {self._at(f'h{i}')}" for i in range(n_seen)),
            *self._store_row([*self.y, *self.c, "n"]),
            *(f"{self._at(u)} = last_{u}" for u in self.u),
            "return r, np.int64(over)",
        ]  # fmt: skip
        advance = self._lagged.compile() if self._lagged else self.advance
        return _compiled("take", "f, base, stride, par, work, room, key", body, advance)

    @property
    def _send(self) -> list[str]:
        """The lines that put a command on its way, where it takes time."""
        ring = self.options.commands
        if ring == 1:
            return []
        low, high = self._constant("late_low"), self._constant("late_high")
        draw = f" + ({high} - {low}) * uniform({self._key('delay')}, np.uint64(n), np.uint64(0))"
        jitter = self.options.action_delay[0] < self.options.action_delay[1]
        return [
            "now = np.int64(n)",
            f"slot = now % {ring}",
            *(f"{self._at(f'sent{i}', 'slot')} = {a}" for i, a in enumerate(self.a)),
            f"{self._at('at', 'slot')} = {low}{draw if jitter else ''}",
        ]

    @property
    def _choose(self) -> list[str]:
        """The lines that find the command in force at `t`, and when it will be followed by another.

        It is the last sent of those that have come; the others' times end this piece of the step.
        """
        ring = self.options.commands
        if ring == 1:
            return []
        return [
            f"for back in range({ring}):",
            f"    slot = (now + {ring} - back) % {ring}",
            f"    comes = ({self._at('at', 'slot')} - back) * k_dt",
            "    if comes <= t:", "        break",
            "    if comes < switch:", "        switch = comes",
            *(f"{a} = {self._at(f'sent{i}', 'slot')}" for i, a in enumerate(self.a)),
        ]  # fmt: skip

    @property
    def _through(self) -> list[str]:
        """The lines that go through a step: from ``y`` to ``z``, with the mean controls in ``u``."""
        within = self.options.within
        # Where nothing changes within the step it is one piece, and its mean control is the control.
        mean = [] if self._lagged else [f"mean_{u} += (h / k_dt) * {u}" for u in self.u]
        move = [
            "h = end - t", *(self._move_lagged if self._lagged else self._move),
            "if status < 0:",
            *(f"    work[{len(self.a) + len(self.o) + j}] = {u}" for j, u in enumerate(self.u)),
            f"    return 0.0, {SLOW}",
            *(self._follow if self._lagged else []),
            *(f"{y} = {z}" for y, z in zip(self.y, self.z, strict=True)),
            "t = end",
        ]  # fmt: skip
        watch = ["if t == k_shown_at:", *_indent([*self.observe, *(f"m{o[1:]} = {o}" for o in self.o)])]
        whole = ["h, t, end = k_dt, 0.0, k_dt", *self.command, *mean, *move]
        pieces = [
            "t, switch = 0.0, 0.0",
            "while t < k_dt:",
            *_indent([
                "if t == switch:",
                *_indent(["switch = k_dt", *self._choose, "h = switch - t", *self.command, *mean]),
                "end = switch",
                *(["if t < k_shown_at < end:", "    end = k_shown_at"] if within else []),
                *move,
                *(watch if within else []),
            ]),
        ]  # fmt: skip
        last = [f"reached{i}" for i in range(len(self.u))] if self._lagged else self.u
        return [
            *(f"b_{y} = {y}" for y in self.y), *(f"mean_{u} = 0.0" for u in self.u),
            *(f"reached{i} = {self._at(u)}" for i, u in enumerate(self.u) if self._lagged),
            *(pieces if within or self.options.commands > 1 else whole),
            *(f"{y} = b_{y}" for y in self.y),
            *(f"last_{u}, {u} = {now}, mean_{u}" for u, now in zip(self.u, last, strict=True)),
        ]  # fmt: skip

    @property
    def _move(self) -> list[str]:
        """The lines that move from ``y`` to ``z`` in a time `h`, under controls that are held."""
        arguments = [*(["room"] if self.general else []), *self.y, *self.u, "h", "limit"]
        limit = str(self._x) if self.general or self._x == 0.0 else f"{self._x} * (h / k_dt)"
        call = f"advance({', '.join([*arguments, *self._stepper.constants])})"
        return [f"limit = {limit}", f"{', '.join(self.z)}, status = {call}"]

    @property
    def _move_lagged(self) -> list[str]:
        """The same under controls that go from where they are, ``reached``, towards their commands ``u``."""
        n = range(len(self.u))
        arguments = [
            "room", *self.y[: self.n_state], *(f"reached{i}" for i in n), *self.u, *self._decays,
            "h", "k_lagged_order", *self._lagged_constants,
        ]  # fmt: skip
        found = [*self.z[: self.n_state], *(f"end{i}" for i in n), *(f"within{i}" for i in n), "status"]
        return [f"{', '.join(found)} = advance({', '.join(arguments)})"]

    @property
    def _follow(self) -> list[str]:
        """The lines behind `_move_lagged`: cosine and sine of the angle; where the controls are now."""
        n = range(len(self.u))
        return [
            *self._lift_end,
            *(f"reached{i} = end{i}" for i in n),
            *(f"mean_{u} += (h / k_dt) * within{i}" for i, u in zip(n, self.u, strict=True)),
        ]

    @property
    def room(self) -> int:
        """Numbers that the series needs."""
        return self._lagged.scratch if self._lagged else super().room

    def _read(self) -> list[str]:
        """Return the lines that show what is observed: late, with noise, and not after every step."""
        found, n = self.options, len(self.o)
        lines = []
        if found.readings:
            values = [f"{'m' if found.within else 'o'}{i}" for i in range(n)]
            lines += [
                f"slot = np.int64(n) % {found.readings}",
                *(f"{self._at(f'seen{i}', 'slot')} = {x}" for i, x in enumerate(values)),
                f"slot = (slot + 1) % {found.readings}",
                *(f"o{i} = {self._at(f'seen{i}', 'slot')}" for i in range(n)),
            ]
        show = [*self.sense, *(f"{self._at(f'h{i}')} = o{i}" for i in range(n))]
        if found.observation_every > 1:
            return [*lines, f"if np.int64(n) % np.int64({self._constant('every')}) == 0:", *_indent(show)]
        return [*lines, *show]

    @cached_property
    def launch(self) -> Callable:
        """``launch(f, base, stride, par, key, state_given, target_given)``: begin an episode."""
        found, n = self.options, len(self.o)
        sent = {f"sent{i}": a for i, a in enumerate(self.a)}
        undrawn = [row for row in self._rows_of_constants if row not in self.drawn]
        body = [
            *self._parameters,
            *self._load_row([*undrawn, *self.y[: self.n_state], *self.g]),
            *self._start, *self.at_rest,
            *self._fill(found.commands if found.commands > 1 else 0, {**sent, "at": "0.0"}),
            *self.observe,
            *self._fill(found.readings, {f"seen{i}": o for i, o in enumerate(self.o)}),
            *self.sense,
            *(f"{self._at(f'h{i}')} = o{i}" for i in range(n)),
            *self._store_row([*self.y, *self.g, *self.u, *self.c, "n", *self.drawn]),
        ]  # fmt: skip
        return _compiled("launch", "f, base, stride, par, key, state_given, target_given", body)

    def _fill(self, slots: int, values: dict[str, str]) -> list[str]:
        """Return the lines that fill all slots of a ring."""
        if not slots:
            return []
        lines = (f"    {self._at(row, 'slot')} = {value}" for row, value in values.items())
        return [f"for slot in range({slots}):", *lines]

    # --- the functions of `Program` ------------------------------------------------------------------------

    def _slices(self, at: int, work: int) -> list[str]:
        """Return the lines that cut constants, the room of a step, and that of the series out of an array."""
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
            *(f"work[{i}] = {'a' if n == 1 else f'a[{i}]'}" for i in range(n)),
            "r, over = take(f, np.int64(0), np.int64(1), par, work, room, ids[2])",
            *(f"obs[{j}] = work[{n + j}]" for j in range(len(self.o))),
            "return r, over",
        ]  # fmt: skip
        return _compiled("step_one", "f, obs, a, ids", body, self.take)

    @cached_property
    def start_one(self) -> Callable:
        """See `Program.start_one`."""
        first = len(self.kept)
        body = [
            "memory = f", *self._slices(first + len(self.scratch), first), *_next_episode("0", "1", "2"),
            "launch(f, np.int64(0), np.int64(1), par, key, state_given, target_given)",
            *(f"obs[{j}] = f[{self.kept.index(f'h{j}')}]" for j in range(len(self.o))),
        ]  # fmt: skip
        return _compiled("start_one", "f, obs, ids, state_given, target_given", body, self.launch)

    def _each(self, body: Sequence[str]) -> list[str]:
        """Return the loop over the environments of a block."""
        return [
            "for lane in range(np.int64(first), np.int64(first + size)):",
            f"    base = (lane // {BLOCK}) * {BLOCK * len(self.kept)} + lane % {BLOCK}",
            *_indent(body),
        ]

    @property
    def _show(self) -> list[str]:
        at = (f"f[base + {self.kept.index(f'h{j}') * BLOCK}]" for j in range(len(self.o)))
        return [f"obs[{j}, lane] = {h}" for j, h in enumerate(at)]

    @property
    def room_of_all(self) -> int:
        """Numbers that `step_all` needs behind the constants."""
        return len(self.scratch) + self.room

    @cached_property
    def step_blocks(self) -> Callable:
        """See `Program.step_blocks`."""
        n, stride = len(self.a), f"np.int64({BLOCK})"
        held = n + len(self.o)
        step = [
            *(f"work[{j}] = action[lane * {n} + {j}]" for j in range(n)),
            f"r, over = take(f, base, {stride}, par, work, room, ids[2 * count + lane])",
            f"if over == {SLOW}:",
            "    refused, over = max(refused, np.uint64(lane + 1)), 0",
            *(f"    {self._at_lane(u)} = work[{held + j}]" for j, u in enumerate(self.u)),
            "if over > 0:",
            f"    {self._at_lane('n')} = -np.float64(over)",
            "    overs += np.uint64(1)",
        ]
        restart = [
            *_next_episode("lane", "count + lane", "2 * count + lane"),
            f"launch(f, base, {stride}, par, key, False, False)",
            "r, over = 0.0, 0",
        ]
        body = [
            "memory = par", *self._slices(0, len(self.uniform)),
            *self._claimed(self._each([
                f"if {self._at_lane('n')} < 0.0:", *_indent(restart), "else:", *_indent(step),
                "reward[lane] = r",
                "terminated[lane] = (over == 1) | (over == 3)", "truncated[lane] = over >= 2",
                *self._show,
            ])),
        ]  # fmt: skip
        return _compiled("step_blocks", STEP_BLOCKS, body, self.take, self.launch, *sharing.claiming())

    def _at_lane(self, row: str) -> str:
        return f"f[base + {self.kept.index(row) * BLOCK}]"

    @cached_property
    def start_all(self) -> Callable:
        """See `Program.start_all`."""
        begin = [
            *_next_episode("lane", "count + lane", "2 * count + lane"),
            f"launch(f, base, np.int64({BLOCK}), par, key, state_given, target_given)",
        ]
        body = [
            f"for block in range(np.uint64((count + {BLOCK - 1}) // {BLOCK})):",
            *_indent([
                *self._place,
                *self._each([
                    "if mask[lane]:", *_indent(begin),
                    "if mask[lane] or whole:", *_indent(self._show),
                ]),
            ]),
        ]  # fmt: skip
        arguments = "f, ids, par, obs, mask, whole, state_given, target_given, count"
        return _compiled("start_all", arguments, body, self.launch)


# --- parameters that are drawn ------------------------------------------------------------------------------


class _Constants:
    """Which constants follow from the drawn parameters, and the lines that compute them.

    They are computed with twice the digits, from the drawn values and the others, and rounded once: an
    environment has the bits of one that is made with the values.
    """

    def __init__(self, task: Task, absent: frozenset[str]) -> None:
        drawn = task.drawn
        assert drawn is not None
        self._task, self._draws, self._made = drawn.inner, drawn.draws, drawn.made
        self._absent = absent
        self._scene = self._task.scene
        self._lags = bool(task.imperfections and task.imperfections.lag)
        inner = {name: getattr(self._scene, name) for name in self._scene._numbers()}
        trace = ElementaryTrace()
        for d in self._draws:
            inner[d.name] = trace.inputs(d.name)[0]
        self._follow(inner)
        parameters = {n for n, x in inner.items() if isinstance(x, Number)}
        found = self._task.formulas.starts_of(inner) | {f"self_{n}": x for n, x in inner.items()}
        found |= {n: x for n, x in self._motion(trace, inner, parameters).items() if n not in absent}
        #: Constants that differ from episode to episode.
        self.changed = [name for name, x in found.items() if isinstance(x, Number)]
        self._parameters = parameters

    def _follow(self, numbers: dict[str, Any]) -> None:
        """Replace the parameters that follow from others."""
        for name, made in self._made.items():
            with naming(self._scene, name):
                numbers[name] = made(twin(self._scene, numbers))

    def _motion(self, trace: Any, numbers: dict[str, Any], changed: set[str]) -> dict[str, Any]:
        """Return the constants of the motion that depend on parameters that change."""
        form, scene = self._scene._form, self._scene
        below = {s.name for s in form.inertia.symbols()} if form else set()
        wanted = dict(form.expressions if form else scene._stepper.expressions())
        wanted = {n: e for n, e in wanted.items() if changed & ({s.name for s in e.symbols()} | below)}
        lagged = scene._lagged.expressions() if self._lags else {}
        lagged = {f"lagged_{n}": e for n, e in lagged.items() if changed & {s.name for s in e.symbols()}}
        values = {
            parameter(name): _Twice(x) if isinstance(x, Number) else Fraction(x)
            for name, x in numbers.items()
            if isinstance(x, Number) or math.isfinite(x)
        }
        functions = _Functions(trace)
        found = evaluate(list(wanted.values()), values, functions)
        if form:
            (inertia,) = evaluate([form.inertia], values, functions)
            found = [x / inertia for x in found]
        found += evaluate(list(lagged.values()), values, functions)
        return {name: _rounded(x) for name, x in zip([*wanted, *lagged], found, strict=True)}

    def lines(self, constants: dict[str, Any]) -> list[str]:
        """Return the lines that draw parameters from ``share0``, ... and fill in the constants."""
        trace = ElementaryTrace()
        outputs: dict[str, Any] = {}
        for j, d in enumerate(self._draws):
            given = (constants[f"draw_{name}{j}"] for name in ("base", "low", "high"))
            base, low, high = (trace.inputs(x)[0] if isinstance(x, str) else x for x in given)
            (share,) = trace.inputs(f"share{j}")
            outputs[f"p_{d.name}"] = d.printed(share, base, low, high, trace)
        code, values = record_block(trace, outputs, fused=False)
        code += [f"{name} = {value}" for name, value in zip(outputs, values, strict=True) if name != value]
        # Those that follow are made as Python makes them: one rounding for each operation.
        trace = ElementaryTrace()
        numbers = self._given(trace, constants)
        self._follow(numbers)
        follow = {f"p_{n}": numbers[n] for n in self._made if n in self._parameters}
        if follow:
            more, _ = record_block(trace, follow, fused=False)
            code += more
        trace = ElementaryTrace()
        numbers = self._given(trace, constants) | {n: trace.inputs(f"p_{n}")[0] for n in self._parameters}
        found = self._task.formulas.starts_of(numbers) | {f"self_{n}": x for n, x in numbers.items()}
        found |= self._motion(trace, numbers, self._parameters)
        results = {f"k_{name}": found[name] for name in self.changed}
        last, values = record_block(trace, results)
        rename = [f"{n} = {v}" for n, v in zip(results, values, strict=True) if n != v]
        return [*code, *last, *rename]

    def _given(self, trace: Any, constants: dict[str, Any]) -> dict[str, Any]:
        """Return all parameters as inputs; what is zero as zero."""
        numbers: dict[str, Any] = {}
        for name in self._scene._numbers():
            at = constants[f"self_{name}"]
            numbers[name] = trace.inputs(at)[0] if isinstance(at, str) else 0.0
        for d in self._draws:
            numbers[d.name] = trace.inputs(f"p_{d.name}")[0]
        return numbers


class _Twice:
    """A number with twice the digits, for what `evaluate` does with parameters."""

    __slots__ = ("high", "low")

    def __init__(self, high: Any, low: Any = 0.0) -> None:
        self.high, self.low = high, low

    def __add__(self, other: Any) -> _Twice:
        other = _twice(other)
        high, rest = two_sum(self.high, other.high)
        return _Twice(*two_sum(high, rest + (self.low + other.low)))

    def __mul__(self, other: Any) -> _Twice:
        other = _twice(other)
        high, rest = two_product(self.high, other.high)
        return _Twice(*two_sum(high, rest + (self.high * other.low + self.low * other.high)))

    def __neg__(self) -> _Twice:
        return _Twice(-self.high, -self.low)

    def __sub__(self, other: Any) -> _Twice:
        return self + -_twice(other)

    def __truediv__(self, other: Any) -> _Twice:
        other = _twice(other)
        first = self.high / other.high
        rest = self - other * _Twice(first)
        return _Twice(*two_sum(first, (rest.high + rest.low) / other.high))

    def __rtruediv__(self, other: Any) -> _Twice:
        return _twice(other) / self

    __radd__, __rmul__ = __add__, __mul__


def _twice(value: Any) -> _Twice:
    if isinstance(value, _Twice):
        return value
    if isinstance(value, Number):
        return _Twice(value)
    exact = Fraction(value)
    return _Twice(float(exact), float(exact - Fraction(float(exact))))


def _rounded(value: Any) -> Any:
    return value.high + value.low if isinstance(value, _Twice) else float(value)


class _Functions:
    """Functions of numbers with twice the digits: of their nearest floats."""

    Rational, mpf, pi = Fraction, None, Fraction(math.pi)

    def __init__(self, trace: Any) -> None:
        self._trace = trace

    def __getattr__(self, name: str) -> Any:
        return lambda x: _Twice(getattr(self._trace, name)(_rounded(x)))


def _listed(values: Any) -> list[Any]:
    return list(values) if isinstance(values, list | tuple) else [values]


def _compiled(name: str, arguments: str, body: Sequence[str], *helpers: Callable) -> Callable:
    return compile_function(name, "\n".join([f"def {name}({arguments}):", *_indent(body), ""]), *helpers)
