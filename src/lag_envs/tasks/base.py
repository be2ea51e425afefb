"""The contract of a task: what it adds to a scene."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import math
import numbers
from abc import ABCMeta
from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from types import MappingProxyType, SimpleNamespace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.errors import hint
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.mechanics.recording import Values
from lag_envs.scenes import picture
from lag_envs.scenes.base import Scene
from lag_envs.scenes.checks import check_number, check_state, real_array, run_check, shown
from lag_envs.scenes.declaring import ORDER, complete
from lag_envs.scenes.derivation import chosen_order_of, form_of, layout_of, motion_constants_of, structure_of
from lag_envs.scenes.shapes import Bodies, Frame, Reading, Shape, Window
from lag_envs.stepping.elementary import LARGEST_ANGLE
from lag_envs.stepping.series import check_order
from lag_envs.tasks.definition import check_definition
from lag_envs.tasks.formulas import UNBOUNDED, TaskFormulas, control_of
from lag_envs.tasks.imperfections import KEYWORDS, Drawn, imperfections_of
from lag_envs.tasks.record import Controller, Examples, Goal, Open, Optimum, ValueIteration

#: Largest speed of a given start, so that observation bounds can be proved [rad/s or m/s]; larger speeds are
#: accepted where episodes start with them.
FASTEST_START = 100.0
#: Largest angle [rad] that the speed `Task.fastest` may cover in a step. A step then needs far fewer substeps
#: than are allowed, even after many steps have added to the speed.
LONGEST_TURN = 5000.0
#: Keywords that environments take besides those of their task.
OF_ENVIRONMENTS = ("render_mode", "diagnostics", "show_arrows", "show_trail", "show_readout")
#: Further keywords that vector environments take.
OF_BATCHES = ("num_envs", "max_episode_steps", "autoreset_mode", "num_threads", "show_tiles")
#: What to do instead of giving these, which are no keywords of a single environment.
INSTEAD = dict.fromkeys(OF_BATCHES, "gym.make_vec makes many;") | {
    "interval": "for another control interval, give dt;",
    "steps": "for another length of episodes, give duration [s];",
}


class TaskType(ABCMeta):
    """The type of tasks; a task remembers its arguments, among which may be those of a subclass."""

    def __call__(cls, *given: Any, **keywords: Any) -> Any:
        """Return a task with checked formulas."""
        check_definition(cls, Task)
        kind: Any = cls
        task = kind.__new__(kind)
        vars(task)["_made_with"] = given, keywords
        task.__init__(*given, **keywords)
        if "imperfections" not in vars(task):
            raise FormulaError(
                f"{cls.__name__}.__init__ must call super().__init__(**keywords), which makes the task"
            )
        return task

    @property
    def __signature__(cls) -> inspect.Signature:
        """The signature of a call, for help."""
        signature = inspect.signature(cls.__init__)  # type: ignore[misc]
        return signature.replace(parameters=list(signature.parameters.values())[1:])


class Task(metaclass=TaskType):
    """A task on a scene.

    A subclass defines some of the attributes and methods below, at least `scene`, `action`, `observe` and
    `reward`. Formulas access values by name: ``before`` and ``after`` are the states at the start and end of
    the step, with the names of ``scene.state_names``; ``control`` has the applied controls, and ``target``
    has the targets. Formulas may use ``+ - * /``, integer powers, comparisons joined by ``|`` and ``&``,
    functions of ``xp`` (sin, cos, tan, atan, tanh, sqrt, exp, log, where, abs, minimum, maximum), and the
    scene's parameters and energies: ``self.scene.mass``, ``self.scene.potential(after, xp)`` and
    ``self.scene.kinetic(after, after.v, xp)``. ``after.q`` and ``after.v`` are the places and velocities by
    coordinate, as the energies take them. A coordinate whose velocity jumps with a control has no entry in
    ``after.v``: the state holds ``w`` instead.

    Attributes
    ----------
    id : str
        Name under which `lag_envs.register` registers it.
    scene : type
        The scene's class; on an instance of the task, the scene itself.
    defaults : mapping
        Parameters of the scene whose defaults this task changes.
    interval : float
        Control interval [s], 0.02 by default.
    steps : int
        Steps of an episode, 500 by default.
    action : mapping
        For each control that actions set: its limit, a pair (low, high), or a list, array or range of values
        to choose from.
    start : mapping
        For entries of the state: a half width around 0, or (centre, half width). All other entries start at
        0.
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
        Order of the series, 6 to 24; by default it follows from `dt`. Slow motions are stepped faster with a
        lower order, fast motions with a higher order. With any order, steps are certified.
        ``lag-envs order FILE`` finds the fastest order.
    usable : mapping
        Ranges of parameters in which the task can be used, if they differ from those that the scene declares.
        For any combination of values in these ranges that `fastest` does not forbid, every accepted start and
        action gives finite observations within their space, and no step is refused.
    controllers : mapping
        A `record.Controller` for each of its controllers, by name. Every task also has "zero" and "random".
    reference : str
        The name of a quick controller among these, used as a control variate where episodes differ much.
    imperfections : mapping
        Keywords of imperfect sensors and actuators and of hidden parameters (`lag_envs.tasks.imperfections`)
        that are on in this task's environments. On an instance, these are the checked values, or None.
        Formulas, and therefore `envs.model.Model` and controllers, are those of the task without
        imperfections.
    hyperparameters : mapping
        Differences from `lag_envs.hyperparams.DEFAULTS`, by learner: a name from
        `lag_envs.hyperparams.learners`, or "off_policy", which stands for several learners. Settings in
        `policy_kwargs` are changed one by one.
    goal : record.Goal, optional
        When the task counts as solved. Tasks of the package with a goal have a board.
    value_iteration : record.ValueIteration, optional
        The grid on which ``python -m agents.optimum`` solves the task.
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
        A text about the task's agents for docs/agents.md. It contains no numbers, because these are in the
        tables.
    quantities : mapping
        For entries of the observation and for controls: (unit, meaning), as shown on the environment's page.

    Parameters
    ----------
    dt : float, optional
        Control interval [s]. The episode keeps its length in seconds, rounded to whole steps.
    duration : float, optional
        Length of an episode [s]; infinity for no end.
    target : float, sequence or mapping, optional
        Fixed targets in place of random ones.
    **parameters
        Parameters of the scene.
    """

    id: ClassVar[str] = ""
    scene: Any = None
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
    unbounded: ClassVar[float] = UNBOUNDED
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
        if cls.__doc__ is None and cls.__base__ is Task:  # or it would be described as "A task on a scene."
            cls.__doc__ = ""
        for name in ("defaults", "action", "start", "target", "usable", "imperfections"):
            if isinstance(vars(cls).get(name), Mapping):
                setattr(cls, name, MappingProxyType(dict(vars(cls)[name])))

    def __init__(
        self, *, dt: float | None = None, duration: float | None = None, target: Any = None, **parameters: Any
    ) -> None:
        of = type(self).__name__
        kind = type(self).scene
        if not (isinstance(kind, type) and issubclass(kind, Scene)):
            raise FormulaError(f"{of}.scene must be a class derived from Scene, got {kind!r:.60}")
        asked = {name: parameters.pop(name) for name in KEYWORDS if name in parameters}
        fields = inspect.signature(kind).parameters
        known = list(fields)
        for name in known:
            if name in _reserved():
                raise FormulaError(
                    f"{of}.scene: the field {name!r} of {kind.__name__} has the name of a "
                    "keyword of environments, so it could not be set; rename the field"
                )
        for mapping in ("defaults", "usable"):
            for name in sorted(set(getattr(self, mapping)) - set(known)):
                raise FormulaError(
                    f"{of}.{mapping}: {kind.__name__} has no parameter {name!r}; {hint(name, known)}"
                )
        for name, pair in self.usable.items():
            if not (isinstance(pair, Sequence) and len(pair) == 2 and pair[0] <= pair[1]):
                raise FormulaError(
                    f"{of}.usable[{name!r}] must be (lowest, highest), in this order, got {pair!r:.60}"
                )
        for name in sorted(set(parameters) - set(known)):
            target = ["target"] if type(self).target else []
            options = [*sorted(known), "dt", "duration", *target, *KEYWORDS, *OF_ENVIRONMENTS]
            meant = INSTEAD.get(name) or hint(name, [*options, *OF_BATCHES], " ").strip()
            # The message has Python's own words, by which libraries notice that an environment takes no
            # `frameskip`.
            raise TypeError(
                f"got an unexpected keyword argument {name!r}; {meant}{' ' if meant else ''}this environment "
                f"takes {', '.join(options)}"
            )
        #: Parameters of the scene that were given, here or by the class. JSON has lists for tuples.
        self.given = dict(self.defaults) | {
            name: _tuples(value) if isinstance(fields[name].default, tuple) else value
            for name, value in parameters.items()
        }
        self.scene = kind(**self.given)
        if self.order is not None:
            vars(self.scene)[ORDER] = check_order(f"{of}.order", self.order)
        if not isinstance(self.scaled, bool):
            raise ValueError(f"{of}.scaled must be True or False, got {self.scaled!r:.60}")
        interval = check_number(f"{of}.interval", self.interval, "s")
        self.dt = interval if dt is None else check_number("dt", dt, "s")
        if not 1e-6 <= self.dt <= 1.0:
            name = f"{of}.interval" if dt is None else "dt"
            raise ValueError(
                f"{name} must lie between 1e-6 and 1 s, got {self.dt:g} s; for faster or slower motions "
                "write all numbers of scene and task in another unit of time"
            )
        steps = check_number(f"{of}.steps", self.steps, endless=True)
        if steps != math.inf and steps % 1.0:
            raise ValueError(f"{of}.steps must be a whole number, or infinity for no end, got {steps:g}")
        seconds = interval * steps if duration is None else duration
        self.duration = check_number("duration", seconds, "s", endless=True)
        if not self.duration >= self.dt:
            name = f"duration ({of}.steps * {of}.interval)" if duration is None else "duration"
            raise ValueError(f"{name} must be at least dt={self.dt:g} s, got {self.duration:g} s")
        self.fixed_target: NDArray[np.float64] | None = None
        run_check(self)
        self.check_usable()
        _ = self.formulas
        if target is not None:
            self.fixed_target = np.atleast_1d(self.check_target(target))
        self.imperfections = imperfections_of(self, asked)

    def __setattr__(self, name: str, value: Any) -> None:
        # The formulas are recorded once, so a later change would have no effect.
        if "imperfections" in vars(self):
            raise dataclasses.FrozenInstanceError(
                f"{type(self).__name__}.{name} cannot be set once the task is made: give a keyword, write a "
                "subclass, or set it before super().__init__()"
            )
        super().__setattr__(name, value)

    # --- what a task defines -------------------------------------------------------------------------------

    def guard(self, wanted: Any, before: Any, dt: Any, xp: Any) -> Any:
        """Return the controls to apply in place of the requested ones, by name."""
        return wanted

    def observe(self, after: Any, target: Any, xp: Any) -> Mapping[str, Any]:
        """Return the observation: numbers by name, in order."""
        raise FormulaError("it is not defined; write observe(self, after, target, xp)")

    def bounds(self) -> Mapping[str, Any]:
        """Return proved bounds on entries of the observation: ±bound or (low, high)."""
        return {}

    def reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return the reward of a step of length `interval`."""
        raise FormulaError("it is not defined; write reward(self, before, after, control, target, dt, xp)")

    def last_reward(self, before: Any, after: Any, control: Any, target: Any, dt: Any, xp: Any) -> Any:
        """Return the reward of the terminating step; by default, that of any other step.

        For another `dt`, it is scaled like `reward`; see `scaled`.
        """
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
        """Return measures of `evaluation.rollout.Episodes` for docs/agents.md, in addition to the arrival."""
        return {}

    def check(self) -> None:
        """Raise ValueError if the parameters do not fit the task."""

    def check_start(self, state: Any) -> None:
        """Raise ValueError for an impossible start: by default, a start at which the episode would be over.

        `state` is accessed by name or by index.
        """
        numbers, ended = np.array([*state]), False
        # If the ending depends on the target, the first step decides.
        with contextlib.suppress(AttributeError, TypeError), np.errstate(all="ignore"):
            ended = bool(self.formulas.own().terminated(self.formulas.named_state([*numbers]), None, np))
        if ended:
            given = ", ".join(f"{n}={x:g}" for n, x in zip(self.scene.state_names, numbers, strict=True))
            raise ValueError(f"the episode would be over at {given}; give a state at which it continues")

    @property
    def fastest(self) -> float:
        """The largest speed that gravity and drive can give to a swing [rad/s]; 0 if nothing swings."""
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
            As in formulas, or numbers.
        xp : namespace
            The formula's; NumPy for numbers.

        Returns
        -------
        pendulum.Coefficients, slope.FixedSlope or slope.TurningSlope
            See `lag_envs.stepping.normal_forms`. In a formula, these are the coefficients that the step uses.
        """
        recorded = self._recording
        form = form_of(self.scene) if recorded is None else recorded.form
        if form is None:
            raise FormulaError(f"{type(self.scene).__name__} has no normal form; use its energies")
        k = SimpleNamespace(**motion_constants_of(self.scene)) if recorded is None else recorded.k
        return form.coefficients_at(list(state), list(control), k, xp)

    #: Arguments that the task was made with.
    _made_with: tuple[tuple, dict[str, Any]]
    #: The recorded constants, while formulas are recorded.
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
        """The action whose control is zero, or nearest to zero; it is applied while no key is pressed."""
        return self.formulas.rest_action

    @property
    def control_range(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The controls of the lowest and of the highest actions at the centre of the starts."""
        return self.formulas.control_range()

    def certified_speed(self) -> float | None:
        """Return the rate of the angle up to which one series per step is certified, whatever the control.

        The rate is below 0 if one series is never enough, and None if the scene is not a driven pendulum. See
        `NormalForm.certified_speed`.
        """
        form: Any = form_of(self.scene)
        k = motion_constants_of(self.scene)
        if form is None:
            return None
        found = [form.certified_speed(y, u, self.dt, k) for y in self.edges for u in self.control_range]
        return min((speed for speed in found if speed is not None), default=None)

    def chance(self, per_interval: float) -> float:
        """Return an event's chance per step from that per interval; any `dt` gives the same rate."""
        if not isinstance(per_interval, numbers.Real) or not 0.0 <= per_interval <= 1.0:
            raise FormulaError(f"chance takes a number from 0 to 1, got {per_interval!r:.60}")
        if self._recording is not None:
            return self._recording.chance(per_interval)
        if self.dt == self.interval or per_interval == 1.0:
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
        return TaskFormulas(self, Task)

    @cached_property
    def drawn(self) -> Drawn | None:
        """The tasks from which each episode's task is drawn, or None if no parameter is drawn."""
        return Drawn(self) if self.imperfections and self.imperfections.drawn else None

    def varied(self, kind: type[Task] | None = None, /, **changes: Any) -> Task:
        """Return the same task, without imperfections, with other keywords; or one of another class."""
        given, keywords = self._made_with
        off = {name: None for name in KEYWORDS if name in keywords or name in type(self).imperfections}
        return (kind or type(self))(*given, **(keywords | off | changes))

    @property
    def observation(self) -> tuple[str, ...]:
        """Names of the observation's entries."""
        return self.formulas.observation

    @property
    def variant(self) -> tuple:
        """What determines the code besides the class; the environments of a batch must agree in this."""
        scene, form = self.scene, form_of(self.scene)
        order = form.order(self.dt) if form else chosen_order_of(scene)
        return *structure_of(scene)[1:3], scene.mechanics.zeros, order, self.fixed_target is None

    @property
    def target_range(self) -> Any:
        """Half width of the random target: a tuple for several targets, None for a task without targets."""
        half = tuple(t.half for t in self.formulas.target_boxes)
        return half[0] if len(half) == 1 else half or None

    def start_state(self, state: ArrayLike) -> NDArray[np.float64]:
        """Return a given start as float64 array, or raise a ValueError if the task cannot start there."""
        array = check_state(self.scene, state)
        for entry, value in zip(layout_of(self.scene).state, array, strict=True):
            centre, half = self.formulas.starts[entry.name]
            fastest = max(FASTEST_START, abs(centre) + half)
            if entry.kind != "place" and abs(value) > fastest:
                raise ValueError(
                    f"{entry.name} must lie within ±{fastest:g} {entry.unit} at the start, got {value:g} "
                    f"{entry.unit}; a task whose `start` reaches further accepts more"
                )
            if entry.unit == "rad" and abs(value) > LARGEST_ANGLE and form_of(self.scene) is None:
                raise ValueError(
                    f"{entry.name} must lie within ±{LARGEST_ANGLE:g} rad, got {value:g} rad; subtract whole "
                    "turns"
                )
        named = Values("entry of the state", dict(zip(self.scene.state_names, array.tolist(), strict=True)))
        if (returned := self.check_start(named)) is not None:  # type: ignore[func-returns-value]
            raise FormulaError(
                f"{type(self).__name__}.check_start must raise a ValueError or return nothing, "
                f"got {returned!r:.60}"
            )
        return array

    def check_target(self, target: Any) -> Any:
        """Return the target as float, or as array if there are several; or raise a ValueError."""
        names = [t.name for t in self.formulas.target_boxes]
        if not names:
            raise ValueError(f"this task has no target, got target={target!r}")
        if isinstance(target, Mapping):
            if set(target) != set(names):
                raise ValueError(f"target must give {', '.join(names)}, got {dict(target)!r}")
            target = [check_number(f"target {name}", target[name]) for name in names]
        elif len(names) == 1:
            target = [check_number("target", target)]
        array = np.atleast_1d(real_array("target", target))
        if array.shape != (len(names),):
            raise ValueError(
                f"target must be {len(names)} numbers ({', '.join(names)}), or a mapping of these names, "
                f"got {target!r}"
            )
        for name, value in zip(names, array, strict=True):
            if not math.isfinite(value):
                raise ValueError(f"target {name} must be finite, got {value}")
            if abs(value) > UNBOUNDED:
                raise ValueError(
                    f"target {name} must lie within ±{UNBOUNDED:.3g}, the range of float32, got {value:g}"
                )
        return float(array[0]) if len(names) == 1 else array

    def effort(self, control: Any) -> NDArray[np.float64]:
        """Return the mean square of the controls (n,) or (n, n_controls) that actions set, as shares."""
        columns = [self.scene.control_names.index(a.control) for a in self.formulas.acting]
        shares = np.reshape(control, (len(control), -1))[:, columns] / np.atleast_1d(self.limit_control)
        return np.mean(shares**2, axis=1)

    def goal_holds(self, states: ArrayLike, targets: ArrayLike | None = None) -> NDArray[np.bool_]:
        """Return whether the goal holds at states (n, n_state) with targets (n,) or (n, n_targets)."""
        array, count = np.asarray(states), self.formulas.targets
        goals = np.zeros((len(array), count)) if targets is None else np.reshape(targets, (len(array), -1))
        after = self.formulas.named_state([*array.T])
        holds = self.formulas.own().reached(after, self.formulas.named_targets([*goals.T][:count]), np)
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
        """Return the part of the plane to look at [m]: by default, as far as bodies reach from the starts."""
        if type(self.scene).window is not Scene.window:
            return self.scene.window()
        starts = self.formulas.starts.items()
        return picture.window(self.scene, {name: abs(centre) + half for name, (centre, half) in starts})

    def shapes(self, now: Frame) -> list[Shape]:
        """Return the visible shapes at a moment, from back to front."""
        return picture.Picture(self).placed(now)

    def wanted(self, actions: ArrayLike) -> NDArray[np.float64]:
        """Return the controls that actions (n,) or (n, n_actions) ask for, shape (n, n_controls)."""
        columns = np.reshape(np.asarray(actions, np.float64), (-1, len(self.formulas.acting))).T
        columns = np.asarray(self.formulas.shares([*columns]))
        names, found = self.scene.control_names, np.zeros((columns.shape[-1], len(self.scene.control_names)))
        for acting, column in zip(self.formulas.acting, columns, strict=True):
            found[:, names.index(acting.control)] = control_of(acting, column, np)
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


def check_task(what: str, task: Any) -> None:
    """Raise a TypeError for a value that is not a task, such as an id or an environment."""
    if not isinstance(task, Task):
        raise TypeError(f"{what} takes a task, such as gym.make(ID).unwrapped.task, got {shown(task)}")


def _tuples(value: Any) -> Any:
    """Return a list, and lists within it, as tuples; other values as they are."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


@cache
def _reserved() -> frozenset[str]:
    """Return the names that no field of a scene may have: keywords of environments and of what makes them."""
    calls = (Task.__init__, gym.make, gym.make_vec)
    every = [p for call in calls for p in inspect.signature(call).parameters.values()]
    named = [p.name for p in every if p.kind is not inspect.Parameter.VAR_KEYWORD]
    return frozenset((*named, "task", *KEYWORDS, *OF_ENVIRONMENTS, *OF_BATCHES))
