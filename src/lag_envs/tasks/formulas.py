"""A task's formulas: checked, run on recorded numbers, and with the numbers that they take."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import inspect
import itertools
import math
import numbers
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from functools import cached_property
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from lag_envs.mechanics.algebra import INSTEAD, FormulaError
from lag_envs.mechanics.layout import check_name
from lag_envs.mechanics.recording import ARGUMENTS, Values, displaced, formula, parameter_names, twin
from lag_envs.scenes.checks import StepRefused, check_number
from lag_envs.scenes.derivation import (
    chosen_order_of,
    form_of,
    layout_of,
    motion_constants_of,
    step_argument_of,
)
from lag_envs.scenes.door import is_own
from lag_envs.scenes.steps import refusal
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.flow_code import flow_code, lift_lines
from lag_envs.stepping.general import stepper_of
from lag_envs.stepping.normal_forms import NormalForm
from lag_envs.stepping.tracing import TracedNumber, is_truth

if TYPE_CHECKING:
    from lag_envs.tasks.base import Task

#: Names of the formulas of a task.
FORMULAS = ("guard", "observe", "reward", "last_reward", "terminated", "kick")
#: Bounds of an observation that has none.
UNBOUNDED = float(np.finfo(np.float32).max)


@dataclasses.dataclass(frozen=True)
class TargetBox:
    """The range of a random target."""

    name: str
    unit: str
    centre: float
    half: float


@dataclasses.dataclass(frozen=True)
class Acting:
    """How a control follows from an action: ``low + (high - low)(a + 1)/2``, or a value from `values`."""

    control: str
    unit: str
    low: float
    high: float
    values: tuple[float, ...] = ()


class RecordedStep(NamedTuple):
    """The parts of a step that a task can access while its formulas are recorded."""

    k: Any
    form: NormalForm | None
    chance: Callable[[float], Any]


class Places(Values):
    """The places of a state's coordinates."""

    __slots__ = ()


class State(Values):
    """The entries of a state; ``q`` and ``v`` hold the places and velocities of its coordinates.

    A coordinate named ``q`` or ``v`` hides them.
    """

    __slots__ = ("_places",)

    def __init__(self, entries: Mapping[str, Any], places: Values, velocities: Values) -> None:
        hidden = {"q": places, "v": velocities}
        super().__init__(
            "entry of the state", entries, {name: hidden[name] for name in hidden if name not in entries}
        )
        object.__setattr__(self, "_places", places)


class Lifted:
    """The namespace ``xp`` with known cosines and sines of angles.

    Parameters
    ----------
    xp : namespace
        Computes everything else.
    known : sequence of (angle, cosine, sine)
        An angle is recognised by identity, as the very object that a formula gets.
    """

    def __init__(self, xp: Any, known: Sequence[tuple[Any, Any, Any]]) -> None:
        self._xp, self._known = xp, known

    def __getattr__(self, name: str) -> Any:
        return getattr(self._xp, name)

    def cos(self, x: Any) -> Any:
        """Return the cosine."""
        for angle, c, _ in self._known:
            if angle is x:
                return c
        return self._xp.cos(x)

    def sin(self, x: Any) -> Any:
        """Return the sine."""
        for angle, _, s in self._known:
            if angle is x:
                return s
        return self._xp.sin(x)


#: Observations and chances of tasks whose formulas have been run: by class, and by `TaskFormulas.key`.
_checked: weakref.WeakKeyDictionary[type, dict[tuple, tuple]] = weakref.WeakKeyDictionary()

#: Attributes of a task whose numbers reach its code as constants, if at all.
NUMBERS = frozenset(
    ("scene", "dt", "duration", "fixed_target", "formulas", "given", "imperfections", "drawn", "_made_with")
)


class TaskFormulas:
    """The formulas of a task, as `lag_envs.envs.program` uses them.

    If the scene has a normal form, states ``y`` and ``z`` are lifted: the cosine and sine of the angle come
    after the state.

    Parameters
    ----------
    task : Task
        The task.
    base : type
        The class that all tasks are derived from.
    """

    trace = ElementaryTrace

    def __init__(self, task: Task, base: type[Task]) -> None:
        self._task, self._base, self._of = task, base, type(task).__name__
        self._chances: dict[float, str] = {}
        scene = task.scene
        self._form = form_of(scene)
        #: Whether the step takes the constant ``x``: the largest one of one series, or the series' order.
        self.bounded = self._form is None or bool(self._form.order(task.dt))
        self.state = scene.state_names
        self._controls = scene.control_names
        self.controls = len(self._controls)
        self.acting = _acting(task)
        self.actions = len(self.acting)
        self.choices = tuple(len(a.values) for a in self.acting if a.values)
        if self.choices and len(self.choices) != self.actions:
            raise FormulaError(
                f"{self._of}.action mixes lists of values with ranges; "
                "give every control a list, or every control a range"
            )
        #: The action for the largest control.
        self.largest = float(task.largest_action)
        if not 0.0 < self.largest < math.inf:
            raise FormulaError(
                f"{self._of}.largest_action must be above 0 and finite, got {task.largest_action!r}"
            )
        self.target_boxes = _target_boxes(task)
        self.targets = len(self.target_boxes)
        self.draws = task.draws
        if type(self.draws) is not int or self.draws < 0:
            raise FormulaError(f"{self._of}.draws must be a whole number, 0 or more, got {task.draws!r}")
        self.starts = _starts(task)
        self.has_last = type(task).last_reward is not base.last_reward
        known = _checked.setdefault(type(task), {})
        key = self.key
        if key not in known:
            names, code = self.recorded()
            if self.recorded() != (names, code):
                raise FormulaError(
                    f"{self._of}: a formula gives another result when it is run again; formulas may "
                    "depend on their arguments and on parameters only, not on time or chance"
                )
            self.observation = names
            self.box()  # for its errors
            known[key] = names, self._chances
        self.observation, self._chances = known[key]

    # --- constants ------------------------------------------------------------------------------------------

    def constants(self) -> dict[str, float]:
        """Return every number that compiled functions take, by name."""
        task, scene = self._task, self._task.scene
        found = dict(motion_constants_of(scene))
        found |= {f"self_{name}": float(getattr(scene, name)) for name in parameter_names(scene)}
        for i, name in enumerate(self.state):
            found[f"centre{i}"], found[f"half{i}"] = self.starts[name]
        if task.fixed_target is not None:
            found |= {f"goal{i}": float(value) for i, value in enumerate(task.fixed_target)}
        found |= {name: task.chance(p) for p, name in self._chances.items()}
        found |= {"scale": task.dt / task.interval, "limit": task.limit, "dt": task.dt}
        return found | {"x": step_argument_of(scene, task.dt)}

    def starts_of(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Return the nonzero constants of the start for other values of the parameters."""
        k = SimpleNamespace(**self.constants())
        vars(k).update({f"self_{name}": x for name, x in numbers.items()})
        with formula(self._task, "start"):
            given = dict(self.with_numbers(k).start)
        found = {}
        for i, name in enumerate(self.state):
            if name in given:
                pair = given[name] if isinstance(given[name], tuple) else (0.0, given[name])
                found[f"centre{i}"], found[f"half{i}"] = pair
        return found

    @property
    def key(self) -> tuple:
        """What determines the code: tasks of a class with the same key differ only in their numbers."""
        kind = type(self._task)
        plain = (self._task.scaled, self.draws, tuple(self.acting), tuple(self.target_boxes))
        if is_own(kind):
            # Besides these, the task's formulas use attributes, which may have been set by hand.
            own = [(name, repr(v)) for name, v in vars(self._task).items() if name not in NUMBERS]
            shared = [v for c in kind.__mro__ for v in vars(c).values() if isinstance(v, int | float)]
            formulas: Any = (*(getattr(kind, name) for name in FORMULAS), *own, *shared)
        else:
            formulas = self.recorded()
        return self._task.scene.mechanics.key, self._task.variant, formulas, *plain

    def refusal(self, state: Any, control: Any, dt: float, where: str) -> StepRefused:
        """Return the error for a step that was refused."""
        found = self._task.imperfections
        lagged = bool(found and found.lag)
        return refusal(self._task.scene, state, control, dt, None, where, lagged=lagged)

    def step_code(self, absent: frozenset[str]) -> Any:
        """Return the code of a control step."""
        if self._form:
            return flow_code(self._form, self._task.dt, absent)
        scene = self._task.scene
        return stepper_of(scene.mechanics).code(absent, order=chosen_order_of(scene))

    # --- formulas -------------------------------------------------------------------------------------------

    def with_numbers(self, k: Any) -> Task:
        """Return a copy of the task with recorded numbers."""
        task = copy.copy(self._task)
        for name in ("formulas", "drawn"):
            vars(task).pop(name, None)
        scene = self._scene_with_numbers(k)
        for name in ARGUMENTS:
            vars(scene)[name] = _taking_states(scene, name)
        recording = RecordedStep(
            k, self._form, lambda p: getattr(k, self._chances.setdefault(p, f"chance{len(self._chances)}"))
        )
        vars(task).update(scene=scene, dt=k.dt, _recording=recording)
        return task

    def own(self) -> Task:
        """Return a copy of the task whose formulas can be called with its own numbers."""
        return self.with_numbers(SimpleNamespace(**self.constants()))

    def _scene_with_numbers(self, k: Any) -> Any:
        scene = self._task.scene
        return twin(scene, {name: getattr(k, f"self_{name}") for name in parameter_names(scene)})

    def _known(self, xp: Any, *states: Sequence) -> Any:
        """Return the namespace that knows cosine and sine of the states' angles."""
        if self._form is None or self._form.angle is None:
            return xp
        return Lifted(xp, [(y[self._form.angle], *y[len(self.state) :]) for y in states])

    def named_state(self, y: Sequence, k: Any = None) -> State:
        """Return the entries of a state by name, and places and velocities by coordinate.

        Resting places are computed from recorded numbers, if given, or else from the scene's own.
        """
        layout = layout_of(self._task.scene)
        entries = dict(zip(self.state, y, strict=False))
        held = dict.fromkeys((p.name for p in layout.at("rest")), 0.0)
        rests: dict[str, Any] = {}
        if held:
            rests = (self._task.scene if k is None else self._scene_with_numbers(k)).rests()
        places = held | rests | {e.coordinate: entries[e.name] for e in layout.state if e.kind == "place"}
        rates = held | {e.coordinate: entries[e.name] for e in layout.state if e.kind == "velocity"}
        carried = [e.name for e in layout.state if e.kind == "momentum"]
        why = ""
        if carried:
            movers = ", ".join(str(p.control) for p in layout.at("rate"))
            why = (
                f"the state holds {', '.join(carried)} instead, because velocities jump with {movers}; "
                f"write the formula with {carried[0]}"
            )
        return State(
            entries,
            Places("coordinate", _in_order(layout.names, places), places),
            Values("velocity of a coordinate", _in_order(layout.names, rates), rates, why),
        )

    def named_targets(self, g: Sequence) -> Values:
        """Return the targets by name."""
        return Values("target", dict(zip((t.name for t in self.target_boxes), g, strict=True)))

    def _applied(self, u: Sequence) -> Values:
        return Values("control", dict(zip(self._controls, u, strict=True)))

    def _call(self, name: str, k: Any, *arguments: Any) -> Any:
        with formula(self._task, name):
            task = self.with_numbers(k)
            before = dict(vars(task))
            try:
                result = getattr(task, name)(*arguments)
            except AttributeError as error:
                names = layout_of(self._task.scene).names
                for hidden, what in (("q", "places"), ("v", "velocities")):
                    if isinstance(error.obj, TracedNumber) and hidden in self.state and error.name in names:
                        why = f"is the place of the coordinate {hidden!r}, which hides the {what}; rename it"
                        raise FormulaError(f"after.{hidden} {why}") from error
                if not isinstance(error.obj, ElementaryTrace):
                    raise
                instead = f": write {INSTEAD[error.name]}" if error.name in INSTEAD else ""
                raise FormulaError(
                    f"it uses xp.{error.name}, but a task's formula has only xp.sin, cos, tan, atan, tanh, "
                    f"sqrt, exp, log, where, abs, minimum, maximum, floor and pi{instead}"
                ) from error
            for key, value in vars(task).items():
                kept = isinstance(getattr(type(task), key, None), cached_property)
                if not kept and (key not in before or before[key] is not value):
                    raise FormulaError(
                        f"it assigns to self.{key}, but a formula is run once and compiled; use the "
                        "formula's arguments, such as `before` in a reward, or entries of the state"
                    )
            return result

    def action(self, control: Any) -> Any:
        """Return the unclipped action that requests a control; for tasks with one control."""
        (acting,) = self.acting
        if acting.low == -acting.high:
            return self.largest * (control / acting.high)
        return self.largest * (2.0 * ((control - acting.low) / (acting.high - acting.low)) - 1.0)

    def shares(self, actions: Sequence) -> Sequence:
        """Return actions as shares of the largest action; choices are unchanged."""
        if self.choices or self.largest == 1.0:
            return actions
        return [a * (1.0 / self.largest) for a in actions]

    def control(self, xp: Any, a: Sequence, y: Sequence, g: Sequence, k: Any) -> list:
        """Return the controls that are applied."""
        return self.guarded(xp, self.wanted(xp, a), y, k)

    def wanted(self, xp: Any, a: Sequence) -> list:
        """Return the requested controls, one for each control that actions set."""
        shares = zip(self.acting, self.shares(a), strict=True)
        return [control_of(acting, share, xp) for acting, share in shares]

    def guarded(self, xp: Any, asked: Sequence, y: Sequence, k: Any) -> list:
        """Return the controls that are applied if the given ones are requested."""
        wanted = dict.fromkeys(self._controls, 0.0)
        wanted |= {acting.control: u for acting, u in zip(self.acting, asked, strict=True)}
        if type(self._task).guard is self._base.guard:
            return list(wanted.values())
        given = Values("control", wanted)
        found = self._call("guard", k, given, self.named_state(y, k), k.dt, self._known(xp, y))
        if found is given:
            return list(given)
        if not isinstance(found, Mapping):
            if len(self.acting) != 1:
                raise FormulaError(f"{self._of}.guard must return controls by name, got {found!r:.60}")
            found = {self.acting[0].control: found}
        self._check_names("guard", "control {!r}", found, wanted)
        return list((wanted | dict(found)).values())

    def outcome(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> tuple:
        """Return the reward, and whether the episode is over."""
        ended = self._call("terminated", k, self.named_state(z, k), self.named_targets(g), self._known(xp, z))
        return self.reward(xp, y, z, u, g, k), ended

    def reward(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> Any:
        """Return the reward of a step that does not end the episode."""
        return self._reward("reward", xp, y, z, u, g, k)

    def last(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> Any:
        """Return the reward of a step that terminates."""
        return self._reward("last_reward", xp, y, z, u, g, k)

    def _reward(self, name: str, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> Any:
        xp = self._known(xp, y, z)
        before, after = self.named_state(y, k), self.named_state(z, k)
        value = self._call(name, k, before, after, self._applied(u), self.named_targets(g), k.dt, xp)
        self._check_numbers(name, {"": value}, k, "a number")
        return k.scale * value if self._task.scaled else _counted(value)

    def added(self, xp: Any, draws: Sequence, z: Sequence, k: Any) -> dict[str, Any]:
        """Return what a kick adds to entries of the state, by name."""
        drawn = Values("random draw", {str(i): draw for i, draw in enumerate(draws)})
        added = self._call("kick", k, self.named_state(z, k), drawn, self._known(xp, z))
        if not isinstance(added, Mapping):
            self._refuse("kick", added, "changes of the state's entries by name")
        self._check_names("kick", "entry {!r} of the state", added, self.state)
        self._check_numbers("kick", added, k, "numbers")
        return dict(added)

    def kick(self, xp: Any, draws: Sequence, z: Sequence, k: Any) -> list:
        """Return the state after a kick."""
        after, added = dict(zip(self.state, z, strict=False)), self.added(xp, draws, z, k)
        for name, value in added.items():
            after[name] = after[name] + value
        angle = None if self._form is None else self._form.angle
        if angle is None or self.state[angle] not in added:
            return [*after.values(), *z[len(self.state) :]]
        turned = after[self.state[angle]]
        return [*after.values(), xp.cos(turned), xp.sin(turned)]

    def observe(self, xp: Any, y: Sequence, g: Sequence, k: Any) -> list:
        """Return the observation."""
        found = self._call("observe", k, self.named_state(y, k), self.named_targets(g), self._known(xp, y))
        if not isinstance(found, Mapping) or not found:
            empty = found is None or isinstance(found, Mapping)
            got = "nothing" if empty else f"a {type(found).__name__}"
            wanted = 'numbers by name, as in {"x": after.x}'
            raise FormulaError(f"{self._of}.observe must return {wanted}, got {got}")
        for name in found:
            if not isinstance(name, str):
                raise FormulaError(f"{self._of}.observe: names must be texts, got {name!r:.60}")
        return [_counted(value) for value in found.values()]

    def recorded(self) -> tuple[tuple[str, ...], str]:
        """Run all formulas, for their errors; return the observation's names and a digest of the code."""
        _check_arguments(self._task, self._base)
        trace = self.trace(numeric=True)

        class Inputs:
            def __getattr__(self, name: str) -> Any:
                return trace.inputs(name)[0]

        k = Inputs()
        width = len(self.state) if self._form is None else self._form.width
        y, z = ([trace.inputs(f"{letter}{i}")[0] for i in range(width)] for letter in "yz")
        a = [trace.inputs(f"a{i}")[0] for i in range(self.actions)]
        u = [trace.inputs(f"u{i}")[0] for i in range(self.controls)]
        g = [trace.inputs(f"g{i}")[0] for i in range(self.targets)]
        d = [trace.inputs(f"d{i}")[0] for i in range(self.draws)]
        reward, ended = self.outcome(trace, y, z, u, g, k)
        if not (is_truth(ended) or isinstance(ended, np.bool_)):
            self._refuse("terminated", ended, "a truth value, such as after.x > 1.0")
        found = {
            "guard": self.control(trace, a, y, g, k),
            "reward": [reward],
            "last_reward": [self.last(trace, y, z, u, g, k)] if self.has_last else [],
            "kick": self.kick(trace, d, z, k) if self.draws else [],
            "observe": self.observe(trace, y, g, k),
        }
        names = tuple(self._call("observe", k, self.named_state(y, k), self.named_targets(g), trace))
        for name, entries in (("guard", self._controls), ("observe", names)):
            self._check_numbers(name, dict(zip(entries, found[name], strict=True)), k, "numbers")
        code = trace.operations([ended, *itertools.chain(*found.values())])
        return names, hashlib.sha256(repr(code).encode()).hexdigest()

    def _check_numbers(self, name: str, found: Mapping[str, Any], k: Any, wanted: str) -> None:
        """Raise a FormulaError if a recorded formula returns anything but numbers; named ones are finite."""
        if not isinstance(k.dt, TracedNumber):
            return  # on other numbers, such as arrays, it is only run after it has been recorded
        for entry, value in found.items():
            if not isinstance(value, TracedNumber | numbers.Real | np.bool_):
                self._refuse(name, value, wanted)
            if entry and isinstance(value, numbers.Real):
                _numbers_of(f"{self._of}.{name}[{entry!r}]", [value])

    def _refuse(self, name: str, found: Any, wanted: str) -> NoReturn:
        kinds = {TracedNumber: "a number", np.ndarray: "an array", list: "a list", tuple: "a tuple"}
        got = kinds.get(type(found)) or f"{found!r:.60}"
        if isinstance(found, Values):
            wanted += "; take an entry by its name, as in control.NAME or after.NAME"
        raise FormulaError(f"{self._of}.{name} returns {got}; it must return {wanted}")

    def _check_names(self, formula: str, what: str, given: Iterable[str], known: Iterable[str]) -> None:
        """Raise a FormulaError if a formula's result has a name that is not known; `what` is its format."""
        for name in given:
            if name not in known:
                raise FormulaError(
                    f"{self._of}.{formula}: there is no {what.format(name)}, only {', '.join(known)}"
                )

    def sample_start(self, draws: Sequence, k: Any) -> list:
        """Return the entries of a state and the targets at an episode's start, from draws in [0, 1)."""
        n = len(self.state)
        state = [k[f"centre{i}"] + k[f"half{i}"] * (2.0 * d - 1.0) for i, d in enumerate(draws[:n])]
        if self._task.fixed_target is not None:
            return state + [k[f"goal{i}"] for i in range(self.targets)]
        drawn = zip(self.target_boxes, draws[n:], strict=True)
        return state + [t.centre + t.half * (2.0 * d - 1.0) for t, d in drawn]

    def lift(self, y: str) -> list[str]:
        """Return the lines that complete the lifted state."""
        return lift_lines(len(self.state), self._form.angle if self._form else None, y)

    @property
    def rest_action(self) -> Any:
        """The action whose controls are nearest to 0."""
        if self.choices:
            found: Any = [int(np.argmin(np.abs(a.values))) for a in self.acting]
        else:
            found = [
                self.largest * min(1.0, max(-1.0, -(a.high + a.low) / (a.high - a.low))) for a in self.acting
            ]
        return found[0] if len(found) == 1 else found

    def control_range(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the controls of the lowest and of the highest actions at the centre of the starts."""
        k = SimpleNamespace(**self.constants())
        y: Any = self._task.centre if self._form is None else self._form.lift(self._task.centre)
        ends = ([0.0 for a in self.acting], [float(n - 1) for n in self.choices])
        if not self.choices:
            ends = ([-self.largest] * self.actions, [self.largest] * self.actions)
        low, high = ends
        found = (self.control(np, a, y, [0.0] * self.targets, k) for a in (low, high))
        first, last = (np.array([float(u) for u in controls]) for controls in found)
        return first, last

    def box(self) -> tuple[list[float], list[float]]:
        """Return the lowest and highest values of the observation's entries."""
        given = self._task.bounds()
        if not isinstance(given, Mapping):
            self._refuse("bounds", given, "bounds by name, or {} if none is known")
        self._check_names("bounds", "observation {!r}", given, self.observation)
        low, high, unbounded = [], [], self._task.unbounded
        # In an episode without an end, entries have no bound, and a speed of 0 times infinity is NaN.
        endless = math.isinf(self._task.duration)
        for name in self.observation:
            bound = given.get(name, unbounded)
            where = f"{self._of}.bounds[{name!r}]"
            try:
                bottom, top = map(float, bound if isinstance(bound, tuple | list) else (-bound, bound))
                wrong = bottom > top if endless else not bottom <= top
            except (TypeError, ValueError):  # other than two numbers
                wrong = True
            if wrong:
                raise FormulaError(f"{where} must be a bound above 0 or (low, high), got {bound!r:.60}")
            low.append(bottom if bottom > -UNBOUNDED else -unbounded)
            high.append(top if top < UNBOUNDED else unbounded)
        return low, high


def _in_order(names: Sequence[str], known: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers that can be accessed by index: those before the first that is missing."""
    return {name: known[name] for name in itertools.takewhile(known.__contains__, names)}


def _taking_states(scene: Any, name: str) -> Callable:
    """Return a formula of the scene that takes a state as places.

    As velocities it refuses states and places: they have the same names, and would be taken for velocities.
    """
    method = getattr(scene, name)

    def taking(*given: Any, **named: Any) -> Any:
        bound = inspect.signature(method).bind(*given, **named)
        v = bound.arguments.get("v")
        if isinstance(v, State | Places):
            what = "the state" if isinstance(v, State) else "places"
            raise FormulaError(
                f"self.scene.{name} is given {what} instead of the velocities; give after.v or before.v"
            )
        if isinstance(q := bound.arguments.get("q"), State):
            bound.arguments["q"] = q._places
        return method(*bound.args, **bound.kwargs)

    return taking


def _counted(value: Any) -> Any:
    """Return a recorded truth value as 1 or 0, and numbers as they are."""
    return 1.0 * value if is_truth(value) else value


def _check_arguments(task: Task, base: type[Task]) -> None:
    """Raise a FormulaError if a formula does not take the arguments that it is given."""
    for name in FORMULAS:
        method, wanted = getattr(task, name), list(inspect.signature(getattr(base, name)).parameters)
        taken = inspect.signature(method)
        try:
            fits = bool(taken.bind(*wanted[1:])) and not displaced([*taken.parameters], wanted[1:])
        except TypeError:
            fits = False
        if not fits:
            raise FormulaError(
                f"{type(task).__name__}.{name} must be {name}({', '.join(wanted)}), "
                f"got ({', '.join(['self', *taken.parameters])})"
            )


def control_of(acting: Acting, a: Any, xp: Any) -> Any:
    """Return the control that an action in [-1, 1], or a choice, requests."""
    if acting.values:
        value: Any = acting.values[-1]
        for i in reversed(range(len(acting.values) - 1)):
            value = xp.where(a < i + 0.5, acting.values[i], value)
        return value
    if acting.low == -acting.high:
        return acting.high * a
    return acting.low + (acting.high - acting.low) * (0.5 + 0.5 * a)


def _numbers_of(where: str, value: Any) -> tuple[float, ...]:
    try:
        return tuple(check_number(where, v) for v in value)
    except ValueError as error:
        raise FormulaError(str(error)) from error


def _mapping(task: Task, name: str) -> dict[str, Any]:
    value = getattr(task if name != "target" else type(task), name)
    if not isinstance(value, Mapping):
        raise FormulaError(f"{type(task).__name__}.{name} must map names to numbers, got {value!r:.60}")
    return dict(value)


def _acting(task: Task) -> list[Acting]:
    of, found = type(task).__name__, []
    known = dict(zip(task.scene.control_names, task.scene.control_units, strict=True))
    for name, given in _mapping(task, "action").items():
        where = f"{of}.action[{name!r}]"
        if name not in known:
            fault = f"{where}: the scene has no such control, only {', '.join(known) or 'none'}"
            modes = [mode for mode, controls in task.scene.modes.items() if name in controls]
            remedy = f"; write 'control': {modes[0]!r} into defaults" if modes else ""
            raise FormulaError(fault + remedy)
        if isinstance(given, list | range) or (isinstance(given, np.ndarray) and given.ndim):
            values = _numbers_of(where, given)
            if len(set(values)) < max(2, len(values)):
                raise FormulaError(f"{where} must list at least two values, each once, got {given!r}")
            found.append(Acting(name, known[name], min(values), max(values), values))
            continue
        forms = f"{where} must be a limit above 0, (low, high) or a list of values, got {given!r:.60}"
        if isinstance(given, Set | str):
            raise FormulaError(forms)
        pair = _numbers_of(where, given if isinstance(given, tuple) else (given,))
        pair = pair if isinstance(given, tuple) else (-pair[0], pair[0])
        if len(pair) != 2 or not pair[0] < pair[1]:
            raise FormulaError(forms)
        found.append(Acting(name, known[name], *pair))
    if known and not found:
        raise FormulaError(f"{of}.action must give limits of controls, as in {{{next(iter(known))!r}: 1.0}}")
    return found


def _target_boxes(task: Task) -> list[TargetBox]:
    of, found = type(task).__name__, []
    for name, given in _mapping(task, "target").items():
        where = f"{of}.target[{name!r}]"
        check_name(f"{of}.target", name)
        if not isinstance(given, tuple) or len(given) not in (2, 3) or not isinstance(given[0], str):
            raise FormulaError(f"{where} must be (unit, half width), got {given!r:.60}")
        *centre, half = _numbers_of(where, given[1:])
        _check_half_width(where, half)
        found.append(TargetBox(name, given[0], centre[0] if centre else 0.0, half))
    return found


def _starts(task: Task) -> dict[str, tuple[float, float]]:
    of, names = type(task).__name__, task.scene.state_names
    found = dict.fromkeys(names, (0.0, 0.0))
    for name, given in _mapping(task, "start").items():
        where = f"{of}.start[{name!r}]"
        if name not in found:
            raise FormulaError(f"{where}: the state has no such entry, only {', '.join(names)}")
        if isinstance(given, list) or (isinstance(given, tuple) and len(given) != 2):
            raise FormulaError(f"{where} must be a half width or (centre, half width), got {given!r}")
        pair = _numbers_of(where, given if isinstance(given, tuple) else (0.0, given))
        _check_half_width(where, pair[1])
        found[name] = pair[0], pair[1]
    return found


def _check_half_width(where: str, half: float) -> None:
    if half < 0.0:
        raise FormulaError(f"{where}: a half width must not be negative, got {half:g}")
