"""The contract of a task: what it adds to a scene."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import math
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.mechanics.algebra import FormulaError
from lag_envs.mechanics.recording import Values, formula, twin
from lag_envs.scenes import picture
from lag_envs.scenes.base import Scene
from lag_envs.scenes.checks import StepRefused, check_number, check_state, real_array
from lag_envs.scenes.declaring import ORDER, complete
from lag_envs.scenes.door import is_own
from lag_envs.scenes.shapes import Bodies, Frame, Reading, Shape, Window
from lag_envs.scenes.steps import refusal
from lag_envs.stepping.elementary import ElementaryTrace
from lag_envs.stepping.flows import lift_lines
from lag_envs.stepping.series import check_order
from lag_envs.tasks.imperfections import KEYWORDS, Drawn, imperfections_of
from lag_envs.tasks.record import Controller, Examples, Goal, Open, Optimum, ValueIteration

if TYPE_CHECKING:
    from lag_envs.stepping.normal_forms import NormalForm

#: Largest speed of a given start, so that observation bounds can be proved [rad/s or m/s].
FASTEST_START = 100.0
#: Largest angle [rad] turned at the speed `Task.fastest` in a step. A step then needs far fewer substeps than
#: are allowed, even after many steps have added to the speed.
LONGEST_TURN = 5000.0
#: Names of the formulas of a task.
FORMULAS = ("guard", "observe", "reward", "last_reward", "terminated", "kick")
_UNBOUNDED = float(np.finfo(np.float32).max)


class Task:
    """A task on a scene.

    A subclass defines some of the attributes and methods below, at least `scene`, `interval`, `steps`,
    `action`, `observe` and `reward`. Formulas use names: ``before`` and ``after`` are the state at both ends
    of the step, with the names of ``scene.state_names``; ``control`` has the applied controls, ``target`` the
    targets. Formulas may use ``+ - * /``, integer powers, comparisons joined by ``|`` and ``&``, functions
    of ``xp`` (sin, cos, tan, atan, tanh, sqrt, exp, log, where, abs, minimum, maximum), and the scene's
    parameters and energies: ``self.scene.mass``, ``self.scene.potential(after, xp)``.

    Attributes
    ----------
    id : str
        Name under which `lag_envs.register` registers it.
    scene : type
        The scene's class; on an instance of the task, the scene itself.
    defaults : mapping
        Parameters of the scene whose defaults this task changes.
    interval : float
        Control interval [s].
    steps : int
        Steps of an episode.
    action : mapping
        For each control that actions set: its limit, (low, high), or a list of values to choose from.
    start : mapping
        For entries of the state: a half width around 0, or (centre, half width). The others start at 0.
    target : mapping
        For each target: (unit, half width) or (unit, centre, half width).
    draws : int
        Random numbers in [0, 1) that `kick` uses.
    scaled : bool
        Whether rewards are scaled by dt/interval for another `dt`.
    largest_action : float
        The action for the largest control: the action space is ± this value. It differs from 1 only in tasks
        that copy another environment's space.
    peer : str
        The environment of Gymnasium that has the same spaces, rewards and endings.
    unbounded : float
        Bound in the space for unbounded observations: the largest float32, or infinity.
    order : int, optional
        Order of the general series, 6 to 24; by default it follows from `dt`. Slow motions are stepped
        faster with a lower order, fast ones with a higher one. Steps are certified with any order.
        ``lag-envs order FILE`` measures the best.
    usable : mapping
        Ranges of parameters in which the task can be used, if they differ from those that the scene declares.
        For any combination of values in these ranges that `fastest` does not forbid, every accepted start and
        action gives finite observations within their space, and no step is refused.
    controllers : mapping
        A `record.Controller` for each of its controllers, by name. Every task also has "zero" and "random".
    reference : str
        A quick controller among them, used as a control variate where episodes differ much.
    imperfections : mapping
        Keywords of imperfect sensors and actuators and of hidden parameters (`lag_envs.tasks.imperfections`)
        that are on in this task's environments. On an instance: the checked values, or None. Formulas, and so
        `envs.model.Model` and controllers, are those of the task without them.
    hyperparameters : mapping
        For a learner, one of `lag_envs.hyperparams.learners`, or for "off_policy", which stands for several:
        the differences from `lag_envs.hyperparams.DEFAULTS`. Settings in its `policy_kwargs` are changed one
        by one.
    goal : record.Goal, optional
        When the task is solved. Tasks of the package with a goal have a board.
    value_iteration : record.ValueIteration, optional
        The grid on which ``python -m agents.optimum`` solves it.
    plans : record.Plans, optional
        How ``python -m agents.optimum`` finds the plan that ships with the package.
    optimum : record.Optimum, optional
        The largest return from given starts, where it is known.
    open : record.Open, optional
        Marks a task that nobody has solved, with the attempts.
    examples : record.Examples
        Cases for tests and pictures.
    difficulty : str
        Why the task is hard, in a sentence or two, for its page.
    note : str
        A text about its agents for docs/agents.md, without numbers, which are in the tables.
    quantities : mapping
        For entries of the observation (unit, meaning), as the environment's page has them.

    Parameters
    ----------
    dt : float, optional
        Control interval [s]. The episode keeps its length in seconds, not in steps.
    duration : float, optional
        Length of an episode [s]; infinity for no end.
    target : float, sequence or mapping, optional
        Fixed targets in place of random ones.
    **parameters
        Parameters of the scene.
    """

    id: ClassVar[str] = ""
    scene: Any
    defaults: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    interval: ClassVar[float] = 0.02
    steps: ClassVar[int] = 500
    action: Any = MappingProxyType({})
    start: Any = MappingProxyType({})
    target: Any = MappingProxyType({})
    draws: ClassVar[int] = 0
    scaled: ClassVar[bool] = True
    largest_action: ClassVar[float] = 1.0
    peer: ClassVar[str] = ""
    unbounded: ClassVar[float] = _UNBOUNDED
    order: ClassVar[int | None] = None
    usable: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType({})
    controllers: ClassVar[Mapping[str, Controller]] = MappingProxyType({})
    reference: ClassVar[str] = ""
    imperfections: Any = MappingProxyType({})
    hyperparameters: ClassVar[Mapping[str, Mapping[str, Any]]] = MappingProxyType({})
    goal: ClassVar[Goal | None] = None
    value_iteration: ClassVar[ValueIteration | None] = None
    plans: Any = None
    optimum: ClassVar[Optimum | None] = None
    open: ClassVar[Open | None] = None
    examples: ClassVar[Examples] = Examples()
    difficulty: ClassVar[str] = ""
    note: ClassVar[str] = ""
    quantities: ClassVar[Mapping[str, tuple[str, str]]] = MappingProxyType({})

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for name in ("defaults", "action", "start", "target", "usable", "imperfections"):
            if isinstance(vars(cls).get(name), Mapping):
                setattr(cls, name, MappingProxyType(dict(vars(cls)[name])))

    def __init__(
        self, *, dt: float | None = None, duration: float | None = None, target: Any = None, **parameters: Any
    ) -> None:
        if hasattr(type(self), "scene_type"):
            raise FormulaError(
                f"{type(self).__name__} is written for lag_envs 0.1, with scene_type and formulas by index; "
                "write scene, action, start, observe and reward by name (see CHANGELOG.md)"
            )
        if type(self).shapes is not Task.shapes:
            raise FormulaError(f"{type(self).__name__}.shapes: {picture.INSTEAD_OF_SHAPES}")
        kind = type(self).scene
        if not (isinstance(kind, type) and issubclass(kind, Scene)):
            raise FormulaError(
                f"{type(self).__name__}.scene must be a class derived from Scene, got {kind!r:.60}"
            )
        asked = {name: parameters.pop(name) for name in KEYWORDS if name in parameters}
        known = list(inspect.signature(kind).parameters)
        for name in sorted(set(parameters) - set(known)):
            options = [
                *sorted(known),
                "dt",
                "duration",
                *(["target"] if type(self).target else []),
                *KEYWORDS,
            ]
            # In Python's own words, by which libraries notice that an environment takes no `frameskip`.
            raise TypeError(
                f"got an unexpected keyword argument {name!r}; this environment takes {', '.join(options)}"
            )
        #: Parameters of the scene that were given, here or by the class.
        self.given = dict(self.defaults) | parameters
        self.scene = kind(**self.given)
        if self.order is not None:
            vars(self.scene)[ORDER] = check_order(f"{type(self).__name__}.order", self.order)
        self.dt = self.interval if dt is None else check_number("dt", dt, "s")
        if not 1e-6 <= self.dt <= 1.0:
            raise ValueError(f"dt must lie between 1e-6 and 1 s, got {self.dt:g} s")
        seconds = self.interval * self.steps if duration is None else duration
        self.duration = check_number("duration", seconds, "s", endless=True)
        if not self.duration >= self.dt:
            raise ValueError(f"duration must be at least dt={self.dt:g} s, got {self.duration:g} s")
        self.fixed_target: NDArray[np.float64] | None = None
        self.check()
        self.check_usable()
        _ = self.formulas
        if target is not None:
            self.fixed_target = np.atleast_1d(self.check_target(target))
        self.imperfections = imperfections_of(self, asked)

    # --- what a task defines -------------------------------------------------------------------------------

    def guard(self, wanted: Any, before: Any, dt: Any, xp: Any) -> Any:
        """Return the controls to apply in place of the wanted ones, by name."""
        return wanted

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return the observation: numbers by name, in order."""
        raise FormulaError("it is not defined; write observe(self, after, target, xp)")

    def bounds(self) -> Mapping[str, Any]:
        """Return proved bounds on entries of the observation: ±bound or (low, high)."""
        return {}

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return the reward of a step of `interval`."""
        raise FormulaError("it is not defined; write reward(self, before, after, control, target, dt, xp)")

    def last_reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return the reward of the terminating step; by default the same as of any other."""
        return self.reward(before, after, control, target, dt, xp)

    def terminated(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the episode terminates."""
        return False

    def kick(self, after: Any, draws: Any, xp: Any) -> Mapping[str, Any]:
        """Return the change of the state's entries by a random kick; draws lie in [0, 1)."""
        return {}

    def reached(self, after: Any, target: Any, xp: Any) -> Any:
        """Return whether the `goal` holds at a step's end."""
        return False

    def behaviour(self, played: Any) -> Mapping[str, float]:
        """Return measures of `evaluation.rollout.Episodes` for docs/agents.md, besides the arrival."""
        return {}

    def check(self) -> None:
        """Raise ValueError if the parameters do not fit the task."""

    def check_start(self, state: Any) -> None:
        """Raise ValueError for an impossible start; `state` is accessed by name or by index."""

    @property
    def fastest(self) -> float:
        """The largest speed that field and drive can give to a swing [rad/s]; 0 if nothing swings."""
        return 0.0

    @property
    def edges(self) -> Sequence[Sequence[float]]:
        """Extreme states of the task, in every entry that affects the motion except angle and rate."""
        return [self.centre]

    # --- what follows --------------------------------------------------------------------------------------

    @classmethod
    def usable_ranges(cls) -> dict[str, tuple[float, float]]:
        """Return the range of each parameter in which the task can be used."""
        complete(cls.scene)
        fields = dataclasses.fields(cls.scene)
        return {f.name: f.metadata["usable"] for f in fields if "usable" in f.metadata} | dict(cls.usable)

    def check_usable(self) -> None:
        """Raise ValueError if a parameter is outside the range in which the task can be used."""
        for name, (low, high) in self.usable_ranges().items():
            value = getattr(self.scene, name)
            if value is not None and not math.isinf(value) and not low <= value <= high:
                raise ValueError(
                    f"{name} must lie between {low:g} and {high:g} in this environment, got {value!r}"
                )
        fastest = self.fastest
        if fastest * self.dt > LONGEST_TURN:
            raise ValueError(
                f"dt must be at most {LONGEST_TURN / fastest:.3g} s where speeds reach {fastest:.3g} rad/s, "
                f"got {self.dt!r} s with {self.scene}"
            )

    def coefficients(self, state: Any, control: Any, xp: Any) -> Any:
        """Return the coefficients of the scene's normal form while a control is held.

        Parameters
        ----------
        state, control : Values or sequence of numbers
            As formulas have them, or numbers.
        xp : namespace
            That of the formula; NumPy for numbers.

        Returns
        -------
        pendulum.Coefficients, slope.FixedSlope or slope.TurningSlope
            See `lag_envs.stepping.normal_forms`. In a formula they are those that the step uses.
        """
        form = self.scene._form if self._recording is None else self._recording.form
        if form is None:
            raise FormulaError(f"{type(self.scene).__name__} has no normal form; use its energies")
        k = SimpleNamespace(**self.scene._constants()) if self._recording is None else self._recording.k
        return form.drive(list(state), list(control), k, xp)

    #: While formulas are recorded, the recorded constants.
    _recording: Any = None

    @property
    def centre(self) -> list[float]:
        """Centre of the box from which the state starts."""
        return [self.formulas.starts[name][0] for name in self.scene.state_names]

    @property
    def half_widths(self) -> list[float]:
        """Half widths of the box from which the state starts."""
        return [self.formulas.starts[name][1] for name in self.scene.state_names]

    @property
    def limit_control(self) -> Any:
        """Largest size of the control; an array if there are several."""
        largest = [max(abs(a.low), abs(a.high)) for a in self.formulas.acting]
        return largest[0] if len(largest) == 1 else np.array(largest)

    @property
    def rest_action(self) -> Any:
        """The action for zero control, or the nearest to it; applied if nobody presses a key."""
        return self.formulas.rest_action

    @property
    def control_range(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The controls of the lowest and of the highest actions at the centre of the starts."""
        return self.formulas.control_range()

    def certified_speed(self) -> float | None:
        """Return the rate of the angle up to which one series per step is certified, whatever the control.

        It is below 0 if one series is never enough, and None if the scene is not a driven pendulum. See
        `NormalForm.certified_speed`.
        """
        form, k = self.scene._form, self.scene._constants()
        if form is None:
            return None
        found = [form.certified_speed(y, u, self.dt, k) for y in self.edges for u in self.control_range]
        return min((speed for speed in found if speed is not None), default=None)

    def chance(self, per_interval: float) -> float:
        """Return an event's chance per step from that per interval: its rate is the same for any `dt`."""
        if self._recording is not None:
            return self._recording.chance(per_interval)
        if self.dt == self.interval:
            return per_interval
        return -math.expm1(self.dt / self.interval * math.log1p(-per_interval))

    @property
    def limit(self) -> float:
        """Steps of an episode; infinity for one without an end."""
        steps = self.duration / self.dt
        return steps if math.isinf(steps) else float(round(steps))

    @cached_property
    def formulas(self) -> TaskFormulas:
        """The formulas from which the compiled functions are made."""
        return TaskFormulas(self)

    @cached_property
    def drawn(self) -> Drawn | None:
        """The tasks among which each episode's is drawn; None if no parameter is drawn."""
        return Drawn(self) if self.imperfections and self.imperfections.drawn else None

    def varied(self, **parameters: float) -> Task:
        """Return the same task, without imperfections, with other parameters of the scene."""
        target: Any = self.fixed_target
        if target is not None:
            target = float(target[0]) if len(target) == 1 else target
        off = dict.fromkeys(KEYWORDS)
        given = self.given | parameters
        return type(self)(dt=self.dt, duration=self.duration, target=target, **given, **off)

    @property
    def observation(self) -> tuple[str, ...]:
        """Names of the observation's entries."""
        return self.formulas.observation

    @property
    def variant(self) -> tuple:
        """What determines the code besides the class: the environments of a batch must agree in it."""
        scene, form = self.scene, self.scene._form
        order = form.order(self.dt) if form else 0
        return *scene._structure[1:3], scene.mechanics.zeros, order, self.fixed_target is None

    @property
    def target_range(self) -> Any:
        """Half width of the random target, a tuple if there are several; None for a task without targets."""
        half = tuple(t.half for t in self.formulas.target_boxes)
        return half[0] if len(half) == 1 else half or None

    def start_state(self, state: ArrayLike) -> NDArray[np.float64]:
        """Return a given start as float64 array, or raise a ValueError if the task cannot start there."""
        array = check_state(self.scene, state)
        for entry, value in zip(self.scene._layout.state, array, strict=True):
            if entry.kind != "place" and abs(value) > FASTEST_START:
                raise ValueError(
                    f"{entry.name} must lie within ±{FASTEST_START:g} {entry.unit} at the start, "
                    f"got {value:g} {entry.unit}"
                )
        self.check_start(
            Values("entry of the state", dict(zip(self.scene.state_names, array.tolist(), strict=True)))
        )
        return array

    def check_target(self, target: Any) -> Any:
        """Return the target as float, or as array if there are several; or raise a ValueError."""
        names = [t.name for t in self.formulas.target_boxes]
        if not names:
            raise ValueError(f"this task has no target, got target={target!r}")
        if isinstance(target, Mapping):
            if sorted(target) != sorted(names):
                raise ValueError(f"target must give {', '.join(names)}, got {dict(target)!r}")
            target = [target[name] for name in names]
        elif len(names) == 1:
            return check_number("target", target)
        array = np.atleast_1d(real_array("target", target))
        if array.shape != (len(names),):
            raise ValueError(f"target must be {', '.join(names)}, got {target!r}")
        for name, value in zip(names, array, strict=True):
            if not math.isfinite(value):
                raise ValueError(f"target {name} must be finite, got {value}")
        return float(array[0]) if len(names) == 1 else array

    def effort(self, control: Any) -> NDArray[np.float64]:
        """Return the mean square of the controls that actions set, as shares; for (n,) or (n, n_controls)."""
        columns = [self.scene.control_names.index(a.control) for a in self.formulas.acting]
        shares = np.reshape(control, (len(control), -1))[:, columns] / np.atleast_1d(self.limit_control)
        return np.mean(shares**2, axis=1)

    def goal_holds(self, states: ArrayLike, targets: ArrayLike | None = None) -> NDArray[np.bool_]:
        """Return whether the goal holds at states (n, n_state) with targets (n,) or (n, n_targets)."""
        array, count = np.asarray(states), self.formulas.targets
        goals = np.zeros((len(array), count)) if targets is None else np.reshape(targets, (len(array), -1))
        holds = self.reached(self.formulas._state([*array.T]), self.formulas._targets([*goals.T][:count]), np)
        return np.broadcast_to(np.asarray(holds, np.bool_), len(array))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("formulas", "drawn")}

    # --- the picture ---------------------------------------------------------------------------------------

    def bodies(self) -> Bodies:
        """Return shapes by frame, from back to front: the scene's, and those of the task."""
        return dict(self.scene.bodies())

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the places of the frames that show more than bodies: see `Scene.indicators`."""
        return dict(self.scene.indicators(now, xp))

    def window(self) -> Window:
        """Return the part of the plane to look at [m]."""
        return self.scene.window()

    def shapes(self, now: Frame) -> list[Shape]:
        """Return the visible shapes at a moment, from back to front."""
        return picture.Picture(self).placed(now)

    def wanted(self, actions: ArrayLike) -> NDArray[np.float64]:
        """Return the controls that actions (n,) or (n, n_actions) ask for, shape (n, n_controls)."""
        columns = np.reshape(np.asarray(actions, np.float64), (-1, len(self.formulas.acting))).T
        columns = np.asarray(self.formulas.shares([*columns]))
        names, found = self.scene.control_names, np.zeros((columns.shape[-1], len(self.scene.control_names)))
        for acting, numbers in zip(self.formulas.acting, columns, strict=True):
            found[:, names.index(acting.control)] = _control(acting, numbers, np)
        return found

    def share(self, control: Any) -> list[Any]:
        """Return controls, numbers or arrays, as shares of their largest sizes."""
        largest = {a.control: max(abs(a.low), abs(a.high)) for a in self.formulas.acting}
        values = control if isinstance(control, list) else np.atleast_1d(control)
        return [
            value / largest[name] if name in largest else 0.0 * value
            for name, value in zip(self.scene.control_names, values, strict=True)
        ]

    def control_readings(self, now: Frame) -> list[Reading]:
        """Return the read-out's entries for the controls."""
        names = zip(
            self.scene.control_names, np.atleast_1d(now.control), self.scene.control_units, strict=True
        )
        return [Reading(name, float(value), unit, "action") for name, value, unit in names]

    def readings(self, now: Frame) -> list[Reading]:
        """Return the read-out's entries besides state and controls: the targets."""
        given: Any = [] if now.target is None else np.atleast_1d(now.target)
        return [
            Reading(t.name, float(value), t.unit, "target")
            for t, value in zip(self.formulas.target_boxes, given, strict=False)
        ]


@dataclasses.dataclass(frozen=True)
class TargetBox:
    """The range of a random target."""

    name: str
    unit: str
    centre: float
    half: float


@dataclasses.dataclass(frozen=True)
class Acting:
    """How a control follows from an action: ``low + (high - low)(a + 1)/2``, or one of `values`."""

    control: str
    low: float
    high: float
    values: tuple[float, ...] = ()


class _Recording(NamedTuple):
    """The parts of a step that a task can access while its formulas are recorded."""

    k: Any
    form: NormalForm | None
    chance: Callable[[float], Any]


class Lifted:
    """The namespace ``xp`` with known cosines and sines of angles.

    Parameters
    ----------
    xp : namespace
        Computes everything else.
    known : sequence of (angle, cosine, sine)
        An angle is recognised by identity: it is the very object that a formula gets.
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
_NUMBERS = {"scene", "dt", "duration", "fixed_target", "formulas", "given", "imperfections", "drawn"}


class TaskFormulas:
    """The formulas of a task, as `lag_envs.envs.program` uses them.

    If the scene has a normal form, states ``y`` and ``z`` are lifted: cosine and sine of its angle follow.
    """

    trace = ElementaryTrace

    def __init__(self, task: Task) -> None:
        self._task = task
        self._chances: dict[float, str] = {}
        scene = task.scene
        self._form = scene._form
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
                f"{type(task).__name__}.action mixes lists of values with ranges; "
                "give every control a list, or every control a range"
            )
        self.clipped = not self.choices
        #: The action of the largest control.
        self.largest = float(task.largest_action)
        if not 0.0 < self.largest < math.inf:
            raise FormulaError(
                f"{type(task).__name__}.largest_action must be above 0 and finite, "
                f"got {task.largest_action!r}"
            )
        self.target_boxes = _target_boxes(task)
        self.targets = len(self.target_boxes)
        self.draws = task.draws
        self.starts = _starts(task)
        self.has_last = type(task).last_reward is not Task.last_reward
        known = _checked.setdefault(type(task), {})
        key = self.key
        if key not in known or not is_own(type(task)):
            known[key] = self._names(), self._chances
        self.observation, self._chances = known[key]

    # --- constants ------------------------------------------------------------------------------------------

    def constants(self) -> dict[str, float]:
        """Return every number that compiled functions take, by name."""
        task, scene = self._task, self._task.scene
        found = dict(scene._constants())
        found |= {f"self_{name}": float(getattr(scene, name)) for name in scene._numbers()}
        for i, name in enumerate(self.state):
            found[f"centre{i}"], found[f"half{i}"] = self.starts[name]
        if task.fixed_target is not None:
            found |= {f"goal{i}": float(value) for i, value in enumerate(task.fixed_target)}
        found |= {name: task.chance(p) for p, name in self._chances.items()}
        found |= {"scale": task.dt / task.interval, "limit": task.limit, "dt": task.dt}
        return found | {"x": scene._limit(task.dt)}

    def starts_of(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Return the nonzero constants of the start for other values of the parameters."""
        k = SimpleNamespace(**self.constants())
        vars(k).update({f"self_{name}": x for name, x in numbers.items()})
        with formula(self._task, "start"):
            given = dict(self._self(k).start)
        found = {}
        for i, name in enumerate(self.state):
            if name in given:
                pair = given[name] if isinstance(given[name], tuple) else (0.0, given[name])
                found[f"centre{i}"], found[f"half{i}"] = pair
        return found

    @property
    def key(self) -> tuple:
        """What determines the code: tasks of a class that agree in it differ only in their numbers."""
        scene = self._task.scene
        kind = type(self._task)
        formulas = tuple(getattr(kind, name) for name in FORMULAS)
        plain = (self._task.scaled, self.draws, tuple(self.acting), tuple(self.target_boxes))
        # Formulas may also use attributes of the task that were set by hand.
        own = [(name, repr(v)) for name, v in vars(self._task).items() if name not in _NUMBERS]
        shared = [v for c in kind.__mro__ for v in vars(c).values() if isinstance(v, int | float)]
        return scene.mechanics.key, self._task.variant, formulas, *plain, *own, *shared

    def refusal(self, state: Any, control: Any, dt: float, trajectory: Any, where: str) -> StepRefused:
        """Return the error for a step that was refused."""
        found = self._task.imperfections
        lagged = bool(found and found.lag)
        return refusal(self._task.scene, state, control, dt, trajectory, where, lagged=lagged)

    def stepper(self, absent: frozenset[str]) -> Any:
        """Return the code of a control step."""
        scene = self._task.scene
        return self._form.stepper(self._task.dt, absent) if self._form else scene._stepper.code(absent)

    # --- formulas -------------------------------------------------------------------------------------------

    def _self(self, k: Any) -> Task:
        """Return a copy of the task with recorded numbers."""
        task = copy.copy(self._task)
        for name in ("formulas", "drawn"):
            vars(task).pop(name, None)
        names = self._task.scene._numbers()
        task.scene = twin(self._task.scene, {name: getattr(k, f"self_{name}") for name in names})
        task.dt = k.dt
        task._recording = _Recording(
            k, self._form, lambda p: getattr(k, self._chances.setdefault(p, f"chance{len(self._chances)}"))
        )
        return task

    def _known(self, xp: Any, *states: Sequence) -> Any:
        """Return the namespace that knows cosine and sine of the states' angles."""
        if self._form is None or self._form.angle is None:
            return xp
        return Lifted(xp, [(y[self._form.angle], *y[len(self.state) :]) for y in states])

    def _state(self, y: Sequence) -> Values:
        layout = self._task.scene._layout
        names = dict(zip(self.state, y, strict=False))
        rates = {e.coordinate: names[e.name] for e in layout.state if e.kind == "velocity"}
        hidden = {} if "v" in names else {"v": Values("velocity of a coordinate", rates)}
        return Values("entry of the state", names, hidden)

    def _targets(self, g: Sequence) -> Values:
        return Values("target", dict(zip((t.name for t in self.target_boxes), g, strict=True)))

    def _applied(self, u: Sequence) -> Values:
        return Values("control", dict(zip(self._controls, u, strict=True)))

    def _call(self, name: str, k: Any, *arguments: Any) -> Any:
        with formula(self._task, name):
            return getattr(self._self(k), name)(*arguments)

    def action(self, control: Any) -> Any:
        """Return the unclipped action that requests a control; for tasks with one control."""
        (acting,) = self.acting
        if acting.low == -acting.high:
            return self.largest * (control / acting.high)
        return self.largest * (2.0 * ((control - acting.low) / (acting.high - acting.low)) - 1.0)

    def shares(self, actions: Sequence) -> Sequence:
        """Return actions as shares of the largest one; choices are unchanged."""
        if self.choices or self.largest == 1.0:
            return actions
        return [a * (1.0 / self.largest) for a in actions]

    def control(self, xp: Any, a: Sequence, y: Sequence, g: Sequence, k: Any) -> list:
        """Return the controls that are applied."""
        return self.guarded(xp, self.wanted(xp, a), y, k)

    def wanted(self, xp: Any, a: Sequence) -> list:
        """Return the controls that actions request, one for each that actions set."""
        shares = zip(self.acting, self.shares(a), strict=True)
        return [_control(acting, share, xp) for acting, share in shares]

    def guarded(self, xp: Any, asked: Sequence, y: Sequence, k: Any) -> list:
        """Return the controls that are applied if these are requested."""
        wanted = dict.fromkeys(self._controls, 0.0)
        wanted |= {acting.control: u for acting, u in zip(self.acting, asked, strict=True)}
        if type(self._task).guard is Task.guard:
            return list(wanted.values())
        given = Values("control", wanted)
        found = self._call("guard", k, given, self._state(y), k.dt, self._known(xp, y))
        if isinstance(found, Values):
            return list(found)
        if not isinstance(found, Mapping):
            if len(self.acting) != 1:
                raise FormulaError(
                    f"{type(self._task).__name__}.guard must return controls by name, got {found!r:.60}"
                )
            found = {self.acting[0].control: found}
        for name in found:
            if name not in wanted:
                raise FormulaError(
                    f"{type(self._task).__name__}.guard: there is no control {name!r}, "
                    f"only {', '.join(wanted)}"
                )
        return list((wanted | dict(found)).values())

    def outcome(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> tuple:
        """Return the reward, and whether the episode is over."""
        ended = self._call("terminated", k, self._state(z), self._targets(g), self._known(xp, z))
        return self.reward(xp, y, z, u, g, k), ended

    def reward(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> Any:
        """Return the reward of a step that goes on."""
        return self._reward("reward", xp, y, z, u, g, k)

    def last(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> Any:
        """Return the reward of a step that terminates."""
        return self._reward("last_reward", xp, y, z, u, g, k)

    def _reward(self, name: str, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> Any:
        xp = self._known(xp, y, z)
        value = self._call(
            name, k, self._state(y), self._state(z), self._applied(u), self._targets(g), k.dt, xp
        )
        if value is None or isinstance(value, Mapping | Sequence):
            raise FormulaError(
                f"{type(self._task).__name__}.{name} returns {value!r:.60}; it must return a number"
            )
        return k.scale * value if self._task.scaled else value

    def kick(self, xp: Any, draws: Sequence, z: Sequence, k: Any) -> list:
        """Return the state after a kick."""
        added = self._call("kick", k, self._state(z), draws, self._known(xp, z))
        after = dict(zip(self.state, z, strict=False))
        for name, value in added.items():
            if name not in after:
                raise FormulaError(
                    f"{type(self._task).__name__}.kick: there is no entry {name!r} of the state, "
                    f"only {', '.join(self.state)}"
                )
            after[name] = after[name] + value
        angle = None if self._form is None else self._form.angle
        if angle is None or self.state[angle] not in added:
            return [*after.values(), *z[len(self.state) :]]
        turned = after[self.state[angle]]
        return [*after.values(), xp.cos(turned), xp.sin(turned)]

    def observe(self, xp: Any, y: Sequence, g: Sequence, k: Any) -> list:
        """Return the observation."""
        found = self._call("observe", k, self._state(y), self._targets(g), self._known(xp, y))
        if not isinstance(found, Mapping) or not found:
            raise FormulaError(
                f"{type(self._task).__name__}.observe must return numbers by name, in order, "
                f"got {found!r:.60}"
            )
        return list(found.values())

    def _names(self) -> tuple[str, ...]:
        """Run all formulas once, for their errors and for the observation's names."""
        trace = self.trace()

        class Inputs:
            def __getattr__(self, name: str) -> Any:
                return trace.inputs(name)[0]

        k = Inputs()
        width = len(self.state) if self._form is None else self._form.width
        y, z = ([trace.inputs(f"{letter}{i}")[0] for i in range(width)] for letter in "yz")
        a = [trace.inputs(f"a{i}")[0] for i in range(self.actions)]
        u = [trace.inputs(f"u{i}")[0] for i in range(self.controls)]
        g = [trace.inputs(f"g{i}")[0] for i in range(self.targets)]
        self.control(trace, a, y, g, k)
        self.outcome(trace, y, z, u, g, k)
        if self.has_last:
            self.last(trace, y, z, u, g, k)
        if self.draws:
            self.kick(trace, [trace.inputs(f"d{i}")[0] for i in range(self.draws)], z, k)
        self.observe(trace, y, g, k)
        return tuple(self._call("observe", k, self._state(y), self._targets(g), trace))

    def sample_targets(self, draws: Sequence, k: Any) -> list:
        """Return targets from draws in [0, 1)."""
        if self._task.fixed_target is not None:
            return [k[f"goal{i}"] for i in range(self.targets)]
        return [t.centre + t.half * (2.0 * d - 1.0) for t, d in zip(self.target_boxes, draws, strict=True)]

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
        given = dict(self._task.bounds())
        for name in given:
            if name not in self.observation:
                raise FormulaError(
                    f"{type(self._task).__name__}.bounds: there is no observation {name!r}, "
                    f"only {', '.join(self.observation)}"
                )
        low, high, unbounded = [], [], self._task.unbounded
        for name in self.observation:
            bound = given.get(name, unbounded)
            pair = tuple(bound) if isinstance(bound, Sequence) else (-bound, bound)
            # An episode without an end has no bound, and a speed of 0 times infinity is NaN.
            low.append(float(pair[0]) if pair[0] > -_UNBOUNDED else -unbounded)
            high.append(float(pair[1]) if pair[1] < _UNBOUNDED else unbounded)
        return low, high


def _control(acting: Acting, a: Any, xp: Any) -> Any:
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
    except (TypeError, ValueError) as error:
        raise FormulaError(f"{where}: {error}") from error


def _mapping(task: Task, name: str) -> dict[str, Any]:
    value = getattr(task if name != "target" else type(task), name)
    if not isinstance(value, Mapping):
        raise FormulaError(f"{type(task).__name__}.{name} must map names to numbers, got {value!r:.60}")
    return dict(value)


def _acting(task: Task) -> list[Acting]:
    of, known = type(task).__name__, task.scene.control_names
    found = []
    for name, given in _mapping(task, "action").items():
        where = f"{of}.action[{name!r}]"
        if name not in known:
            raise FormulaError(f"{where}: the scene has no such control, only {', '.join(known) or 'none'}")
        if isinstance(given, list):
            values = _numbers_of(where, given)
            if len(values) < 2:
                raise FormulaError(f"{where} must list at least two values, got {given!r}")
            found.append(Acting(name, min(values), max(values), values))
            continue
        low, high = (
            _numbers_of(where, given if isinstance(given, tuple) else (given,))
            if isinstance(given, tuple)
            else (-check_number(where, given), check_number(where, given))
        )
        if not low < high:
            raise FormulaError(f"{where} must be a limit above 0 or (low, high), got {given!r}")
        found.append(Acting(name, low, high))
    if known and not found:
        raise FormulaError(f"{of}.action must give limits of controls, as in {{{known[0]!r}: 1.0}}")
    return found


def _target_boxes(task: Task) -> list[TargetBox]:
    of, found = type(task).__name__, []
    for name, given in _mapping(task, "target").items():
        where = f"{of}.target[{name!r}]"
        if not isinstance(given, tuple) or len(given) not in (2, 3) or not isinstance(given[0], str):
            raise FormulaError(f"{where} must be (unit, half width), got {given!r:.60}")
        *centre, half = _numbers_of(where, given[1:])
        found.append(TargetBox(name, given[0], centre[0] if centre else 0.0, half))
    return found


def _starts(task: Task) -> dict[str, tuple[float, float]]:
    of, names = type(task).__name__, task.scene.state_names
    found = dict.fromkeys(names, (0.0, 0.0))
    for name, given in _mapping(task, "start").items():
        where = f"{of}.start[{name!r}]"
        if name not in found:
            raise FormulaError(f"{where}: the state has no such entry, only {', '.join(names)}")
        if isinstance(given, tuple) and len(given) != 2:
            raise FormulaError(f"{where} must be a half width or (centre, half width), got {given!r}")
        pair = _numbers_of(where, given if isinstance(given, tuple) else (0.0, given))
        found[name] = pair[0], pair[1]
    return found
