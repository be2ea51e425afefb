"""The environment's step without fused operations: the same bits on any machine, in three languages.

The formulas of task and scene and the general series are recorded as for the compiled step and printed as a
script (`lag_envs.stepping.script`). All scenes are stepped by the general series here, even those with an
exact flow of their own: the code of the series has one form, including its loops, whereas the flows call
fused operations and the C library.

A script has the functions below. All work on arrays of numbers: ``k``, the constants; ``f``, the rows of one
environment; ``a``, the action; ``d``, random numbers in [0, 1); ``p``, poses.

=================  ==========================================================================================
``derive(k)``      computes the constants that follow from the given ones, after one of these was changed
``start(f, d, k)`` sets an episode's start, from one draw for each entry of state and target
``lift(f, k)``     computes what the formulas need besides the state; call it after setting the state by hand
``move(f, a, k)``  takes a step: control, motion, reward, ending
``kick(f, d, k)``  applies the random kick after the step
``observe(f, k)``  computes the observation
``poses(f, p, k)`` computes the poses of the picture's frames: x, y, angle and part of each
=================  ==========================================================================================

With hidden parameters or noisy sensors there are two more (`UnfusedImperfectProgram`):

=================  ==========================================================================================
``draw(k, d)``     sets the drawn parameters of an episode; call ``derive`` next
``sense(f, d, k)`` turns the true observation into the one that the sensors show
=================  ==========================================================================================

The caller stores actions that take effect later.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from lag_envs.mechanics.algebra import FormulaError, evaluate
from lag_envs.mechanics.recording import parameter, parameter_names, parameter_values
from lag_envs.scenes import picture
from lag_envs.scenes.derivation import form_of, layout_of, motion_constants_of, series_order_of
from lag_envs.scenes.shapes import Frame
from lag_envs.stepping.compiling import absent_from, split_lengths
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.general import stepper_of
from lag_envs.stepping.script import JAVASCRIPT, PYTHON, Script, run_python, script_motion
from lag_envs.stepping.series import TOLERANCE
from lag_envs.stepping.tracing import TracedNumber
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import Imperfections, normals, seen_box

#: Largest truncation error of a substep in single precision, relative to the velocities: half a unit in the
#: last place.
SINGLE_TOLERANCE = 2.0**-25


class ScriptRows(NamedTuple):
    """The places of an environment's numbers in ``f``.

    Attributes
    ----------
    y : slice
        The state, and cosine and sine of its angle if the scene has a normal form.
    g, u, o : slice
        Targets, controls, observation.
    turned : slice
        Places that the state leaves out, for the picture.
    reward, ended, refused : int
        Results of the last step; the latter two are 1.0 or 0.0.
    """

    y: slice
    g: slice
    u: slice
    o: slice
    turned: slice
    reward: int
    ended: int
    refused: int


class UnfusedProgram:
    """The step of a task as a script.

    Parameters
    ----------
    task : Task
        The task, without imperfections; for these there is `UnfusedImperfectProgram`.
    single : bool
        Whether to use single precision, for which shorter series suffice.

    Attributes
    ----------
    rows : ScriptRows
        The places of the numbers.
    given : dict of str to float
        The constants that the script is given, in order; they come first. One of them, ``strength``,
        multiplies actions in [-1, 1]; it is 1 in the environment.
    derived : dict of str to float
        The constants after those, which are computed from them; each is rounded once.
    frames : list of str
        The picture's frames; empty if there is no picture.
    """

    #: The script's functions.
    names: tuple[str, ...] = ("derive", "start", "lift", "move", "kick", "observe", "poses")
    #: The number of drawn parameters, the number of draws for noise in a step, and the number of steps after
    #: which an action takes effect.
    drawn, noise, delay = 0, 0, 0

    def __init__(self, task: Task, single: bool = False) -> None:
        if task.imperfections:
            raise FormulaError(
                f"{type(task).__name__} has hidden parameters or imperfect sensors or actuators, which this "
                "script does not support; switch them off with None, as in observation_noise=None"
            )
        self.task, formulas, scene = task, task.formulas, task.scene
        self._formulas, self._form, self._stepper = formulas, form_of(scene), stepper_of(scene.mechanics)
        own = formulas.constants()
        scenes = motion_constants_of(scene)
        self.given = {name: value for name, value in own.items() if name not in scenes and name != "x"}
        self.given["strength"] = 1.0
        fields = {f.name: f.metadata["made"] for f in dataclasses.fields(scene) if "unit" in f.metadata}
        #: Parameters that are computed from others, and how.
        self.made = {
            name: fields[name]
            for name in parameter_names(scene)
            if fields[name] is not None and fields[name](scene) == getattr(scene, name)
        }
        expressions = self._stepper.expressions()
        self._motion = {f"motion_{name}": e for name, e in expressions.items()}
        # Functions of parameters must have the same bits everywhere, too.
        parameters, functions = parameter_values(scene), ElementaryTrace()
        motion = self._stepper.constants(parameters, functions)
        gone = absent_from(motion)
        self.derived = self._form.constants(parameters, functions) if self._form else {}
        self.derived |= {f"motion_{name}": value for name, value in motion.items()}
        numbers = self.given | self.derived
        self._place = {name: f"k[{i}]" for i, name in enumerate(numbers)}
        #: Constants for formulas; zeros leave no code.
        self._k = {name: 0.0 if numbers[name] == 0.0 else place for name, place in self._place.items()}
        self._record = self._stepper.record(gone, fused=False)
        order = series_order_of(scene, task.dt)
        self._order, self._tolerance = (order // 2, SINGLE_TOLERANCE) if single else (order, TOLERANCE)
        self.states = len(formulas.state)
        self._width = self._form.width if self._form else self.states
        layout = layout_of(scene)
        self._turned = len([n for n in layout.left_out if n in layout.names])
        sizes = (self._width, formulas.targets, formulas.controls, len(formulas.observation), self._turned)
        ends = np.cumsum((0, *sizes)).tolist()
        self.size = ends[-1] + 3
        y, g, u, o, turned = (slice(a, b) for a, b in pairwise(ends))
        self.rows = ScriptRows(y, g, u, o, turned, *range(ends[-1], self.size))
        self.frames: list[str] = []

    # --- scripts --------------------------------------------------------------------------------------------

    @property
    def constants(self) -> list[float]:
        """All constants."""
        return [*self.given.values(), *self.derived.values()]

    @cached_property
    def python(self) -> str:
        """The script in Python."""
        return self.script.text(PYTHON)

    @cached_property
    def functions(self) -> dict[str, Any]:
        """The functions of the script in Python; they have no state of their own."""
        return run_python(self.python)

    @cached_property
    def javascript(self) -> str:
        """The script in JavaScript."""
        return self.script.text(JAVASCRIPT)

    @cached_property
    def digest(self) -> str:
        """A digest of everything that decides the bits of an episode."""
        numbers = repr(self.constants)
        late = self.delay or ""
        text = f"{self.python.partition('def poses(')[0]}{numbers}{late}"
        return hashlib.sha256(text.encode()).hexdigest()[:8]

    @cached_property
    def script(self) -> Script:
        """The functions listed at the top of this module."""
        return self.written(*self.names)

    def written(self, *names: str) -> Script:
        """Return a script of these functions."""
        known = self._writers
        t = Script()
        for name in names:
            arguments, write = known[name]
            t.function(name, arguments, partial(write, t))
        return t

    @property
    def _writers(self) -> dict[str, tuple[str, Callable]]:
        return {
            "derive": ("k", self._derive),
            "start": ("f, d, k", self._start),
            "lift": ("f, k", self._lift),
            "move": ("f, a, k", self._move),
            "kick": ("f, d, k", self._kick),
            "observe": ("f, k", self._observe),
            "poses": ("f, p, k", self._poses),
        }

    def _read(self, t: Script, rows: slice, array: str = "f") -> list[str]:
        return [t.put("read", array, i) for i in range(rows.start, rows.stop)]

    def _write(self, t: Script, rows: slice | int, values: Sequence, array: str = "f") -> None:
        first = rows if isinstance(rows, int) else rows.start
        for i, value in enumerate(values):
            t.say("write", array, first + i, value)

    def _lift(self, t: Script) -> None:
        self._write_state(t, self._read(t, self.rows.y)[: self.states])

    def _write_state(self, t: Script, y: Sequence) -> None:
        """Write a state, and cosine and sine of its angle."""
        self._write(t, self.rows.y, self._lifted(t, y))

    def _lifted(self, t: Script, y: Sequence) -> list[Any]:
        angle = self._form.angle if self._form else None
        if angle is None:
            return list(y)
        return [*y, *t.formula(lambda xp, x: [xp.cos(x), xp.sin(x)], {"x": y[angle]})]

    def _run(self, t: Script, formula: Callable, *given: Sequence) -> list[Any]:
        """Write a formula whose arguments are lists of numbers and the constants."""
        sizes = [len(values) for values in given]
        inputs = {f"i{n}": value for n, value in enumerate(value for values in given for value in values)}

        def recorded(xp: Any, *numbers: Any) -> list:
            *lists, rest = split_lengths(numbers, *sizes)
            return list(formula(xp, *lists, SimpleNamespace(**dict(zip(self._k, rest, strict=True)))))

        return t.formula(recorded, inputs | self._k)

    def _derive(self, t: Script) -> None:
        names = parameter_names(self.task.scene)
        known: dict[str, Any] = {n: self._place[f"self_{n}"] for n in names if n not in self.made}
        for name, made in self.made.items():

            def follows(xp: Any, *numbers: Any, made: Callable = made, given: tuple = tuple(known)) -> list:
                return [made(_PartlyRecorded(self.task.scene, dict(zip(given, numbers, strict=True))))]

            (known[name],) = t.formula(follows, known)
        for name in self.made:
            self._write(t, list(self._place).index(f"self_{name}"), [known[name]], "k")

        def constants(xp: Any, *numbers: Any) -> list:
            values = {parameter(n): x for n, x in zip(names, numbers, strict=True)}
            found = evaluate(self._motion.values(), values, xp)
            if self._form:
                inertia, *rest = evaluate([self._form.inertia, *self._form.expressions.values()], values, xp)
                found = [x / inertia for x in rest] + found
            return found

        results = t.formula(constants, {n: known[n] for n in names})
        self._write(t, len(self.given), results, "k")
        moved = self._moved_starts()

        def starts(xp: Any, *numbers: Any) -> list:
            found = self._formulas.starts_of(dict(zip(names, numbers, strict=True)))
            return [found[name] for name in moved]

        results = t.formula(starts, {n: known[n] for n in names})
        for name, result in zip(moved, results, strict=True):
            self._write(t, list(self._place).index(name), [result], "k")

    def _moved_starts(self) -> list[str]:
        """Return the start's constants that follow from parameters, if plain arithmetic computes them."""
        names = list(parameter_names(self.task.scene))
        try:
            found = self._formulas.starts_of(dict(zip(names, ElementaryTrace().inputs(*names), strict=True)))
        except FormulaError:
            return []
        return [name for name, value in found.items() if isinstance(value, TracedNumber)]

    def _start(self, t: Script) -> None:
        formulas, n = self._formulas, self.states
        draws = self._read(t, slice(0, n + formulas.targets), "d")
        found = self._run(t, lambda xp, draws, k: formulas.sample_start(draws, vars(k)), draws)
        self._write_state(t, found[:n])
        self._write(t, self.rows.g, found[n:])
        for rows in (self.rows.u, self.rows.turned, slice(self.rows.reward, self.size)):
            self._write(t, rows, [0.0] * (rows.stop - rows.start))

    def _move(self, t: Script) -> None:
        formulas, scene, rows = self._formulas, self.task.scene, self.rows
        y, g, turned = (self._read(t, part) for part in (rows.y, rows.g, rows.turned))
        actions = self._read(t, slice(0, formulas.actions), "a")

        def control(xp: Any, a: Sequence, y: Sequence, g: Sequence, k: Any) -> list:
            if not formulas.choices:
                top = formulas.largest
                a = [xp.where(x < -top, -top, xp.where(x > top, top, x)) * k.strength for x in a]
            return formulas.control(xp, a, y, g, k)

        u = self._run(t, control, actions, y, g)
        z, refused = self._advance(t, y[: self.states], u)
        z = self._lifted(t, z)

        def outcome(xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> list:
            reward, ended = formulas.outcome(xp, y, z, u, g, k)
            if formulas.has_last:
                reward = xp.where(ended, formulas.last(xp, y, z, u, g, k), reward)
            return [reward, xp.where(ended, 1.0, 0.0)]

        found = self._run(t, outcome, y, z, u, g)

        def turn(xp: Any, turned: Sequence, y: Sequence, z: Sequence, k: Any) -> list:
            rates = [picture.left_out_rates(scene, x) for x in (y, z)]
            return [
                x + 0.5 * k.dt * (before + after) for x, before, after in zip(turned, *rates, strict=True)
            ]

        turned = self._run(t, turn, turned, y[: self.states], z[: self.states])
        self._write(t, rows.y, z)
        self._write(t, rows.u, u)
        self._write(t, rows.turned, turned)
        self._write(t, rows.reward, found)
        self._write(t, rows.refused, [t.select(refused, 1.0, 0.0)])

    def _advance(self, t: Script, y: Sequence, u: Sequence) -> tuple[list, str]:
        """Write the motion; return the state after the step, and whether the step was refused."""
        stepper, record, n, dt = self._stepper, self._record, self._record.size, self._k["dt"]
        wanted = [name for name in record.given if name.startswith(("control_", "start_"))]
        moving = [f"{letter}{i}" for letter in "qv" for i in range(n)]

        def named(k: Any) -> dict[str, Any]:
            return {name.removeprefix("motion_"): x for name, x in vars(k).items()}

        def prepare(xp: Any, y: Sequence, u: Sequence, k: Any) -> list:
            found = stepper.prepare(xp, y, u, named(k))
            return [found[name] for name in (*wanted, *moving)]

        def finish(xp: Any, q: Sequence, v: Sequence, y: Sequence, u: Sequence, k: Any) -> list:
            return stepper.finish(xp, q, v, y, u, k.dt, named(k))

        given = dict(zip((*wanted, *moving), self._run(t, prepare, y, u), strict=True))
        inputs = {name: given.get(name) or self._k[f"motion_{name}"] for name in record.given}
        places, velocities = [given[x] for x in moving[:n]], [given[x] for x in moving[n:]]
        q, v, refused = script_motion(t, record, inputs, places, velocities, dt, self._order, self._tolerance)
        return self._run(t, finish, q, v, y, u), refused

    def _kick(self, t: Script) -> None:
        if self._formulas.draws:
            y, d = self._read(t, self.rows.y), self._read(t, slice(0, self._formulas.draws), "d")
            self._write(t, self.rows.y, self._run(t, self._formulas.kick, d, y))

    def _observe(self, t: Script) -> None:
        y, g = self._read(t, self.rows.y), self._read(t, self.rows.g)
        self._write(t, self.rows.o, self._run(t, self._formulas.observe, y, g))

    def _poses(self, t: Script) -> None:
        rows, n = self.rows, self.states
        try:
            shown = picture.Picture(self.task)
        except FormulaError:
            return
        self.frames = shown.frames if shown.shapes else []
        if not self.frames:
            return

        def poses(
            own: bool, xp: Any, y: Sequence, g: Sequence, u: Sequence, turned: Sequence, k: Any
        ) -> list:
            of = self.task
            if own:
                of = self._formulas.with_numbers(k)
                vars(of)["formulas"] = self._formulas  # not the formulas of recorded numbers
            found = picture.poses_of(of, Frame(y, u, of.share(list(u)), list(g), turned), xp)
            return [x for pose in found.values() for x in pose]

        given = [self._read(t, part) for part in (slice(0, n), rows.g, rows.u, rows.turned)]
        # If the poses do more than arithmetic with the parameters, the parameters stay fixed. If they do more
        # with the state, there is no picture.
        for own in (True, False):
            try:
                self._write(t, 0, self._run(t, partial(poses, own), *given), "p")
                return
            except (AttributeError, TypeError, ValueError, FormulaError):
                pass
        self.frames = []


class UnfusedImperfectProgram(UnfusedProgram):
    """The step of a task with hidden parameters, noisy sensors or delayed actions, as a script.

    Parameters
    ----------
    task : Task
        The task. Scripts support no other imperfections.

    Raises
    ------
    FormulaError
        For other imperfections, or a delay that is not a fixed number of whole steps.
    """

    names = ("derive", "draw", "start", "lift", "move", "kick", "observe", "sense", "poses")

    def __init__(self, task: Task) -> None:
        found: Any = task.imperfections
        least = found.action_delay[0]
        known = Imperfections(
            drawn=found.drawn, observation_noise=found.observation_noise, action_delay=(least, least)
        )
        if found != known or least % 1.0:
            raise FormulaError(
                f"{type(task).__name__} has hidden parameters or imperfect sensors or actuators, of which "
                "scripts support only randomize, observation_noise, and action_delay in whole steps; switch "
                "the others off with None, as in lag=None"
            )
        super().__init__(task.drawn.inner if task.drawn else task.varied())
        self._options, self._box = found, seen_box(task)
        self.drawn, self.delay = len(found.drawn), int(least)
        wide = len(self._formulas.observation)
        self.noise = wide + wide % 2 if found.observation_noise else 0

    @property
    def _writers(self) -> dict[str, tuple[str, Callable]]:
        return super()._writers | {"draw": ("k, d", self._draw), "sense": ("f, d, k", self._sense)}

    def _draw(self, t: Script) -> None:
        def drawn(xp: Any, shares: Sequence, k: Any) -> list:
            return [
                d.printed(share, d.base, d.low, d.high, xp)
                for d, share in zip(self._options.drawn, shares, strict=True)
            ]

        values = self._run(t, drawn, self._read(t, slice(0, self.drawn), "d"))
        for d, value in zip(self._options.drawn, values, strict=True):
            self._write(t, list(self._place).index(f"self_{d.name}"), [value], "k")

    def _sense(self, t: Script) -> None:
        def shown(xp: Any, draws: Sequence, seen: Sequence, k: Any) -> list:
            pairs = zip(draws[::2], draws[1::2], strict=True)
            noise = [x for pair in pairs for x in normals(*pair, xp)]
            sigma = self._options.observation_noise
            if noise:
                seen = [o + s * x if s else o for o, s, x in zip(seen, sigma, noise, strict=False)]
            return [
                xp.where(o < low, low, xp.where(o > high, high, o))
                for o, low, high in zip(seen, *self._box, strict=True)
            ]

        draws, seen = self._read(t, slice(0, self.noise), "d"), self._read(t, self.rows.o)
        self._write(t, self.rows.o, self._run(t, shown, draws, seen))


class _PartlyRecorded:
    """A scene with some recorded parameters, to compute those that follow from them."""

    def __init__(self, scene: Any, numbers: dict[str, Any]) -> None:
        self._scene, self._recorded = scene, numbers

    def __getattr__(self, name: str) -> Any:
        return self._recorded[name] if name in self._recorded else getattr(self._scene, name)
