"""What a task adds to a scene: start, control, reward, ending, observation."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.scenes.base import Scene, StepRefused, check_number
from lag_envs.scenes.shapes import Moment, Reading, Shape, Window
from lag_envs.stepping.flows import Stepper, lift_lines
from lag_envs.stepping.tracing import Trace

#: Starts given by hand may be this fast at most, so that observation bounds can be proved [rad/s or m/s].
FASTEST_START = 100.0
#: Angle [rad] through which `Task.fastest` may turn in a step. It then needs far fewer substeps than are
#: allowed, also after many steps have added to the speed.
LONGEST_TURN = 5000.0


class Task(ABC):
    """A task on a scene.

    A subclass says what its class attributes and abstract methods ask for. Formulas follow the same rules as
    a scene's: numbers in, ``+ - * /`` and `xp`, numbers out. ``y`` is the lifted state before the step, ``z``
    the one after it, ``u`` the control that was applied, ``g`` the target, ``k`` the constants by name.

    Parameters
    ----------
    dt : float, optional
        Control interval [s]. The episode keeps its seconds, not its steps.
    duration : float, optional
        Length of an episode [s]; infinity for one without an end.
    target : float, optional
        A fixed target in place of a random one, for tasks that have one.
    **parameters
        Parameters of the scene.
    """

    scene_type: ClassVar[type[Scene]]
    #: Parameters of the scene that differ from its own defaults.
    defaults: ClassVar[dict[str, Any]] = {}
    #: Control interval [s] and steps of an episode.
    interval: ClassVar[float] = 0.02
    steps: ClassVar[int] = 500
    #: Names of the observation's entries.
    observation: ClassVar[tuple[str, ...]]
    #: Random targets lie in [-target_range, target_range]; None for a task without target.
    target_range: ClassVar[float | None] = None
    #: The action without control; with it a person's hands are off.
    rest_action: ClassVar[float] = 0.0
    #: Random numbers that one step's kick uses, at most 16.
    draws: ClassVar[int] = 0
    #: Ranges of parameters in which the task can be used, where they are not those that the scene declares.
    #: Wherever in these ranges all of them lie, unless `fastest` forbids it, every accepted start and action
    #: gives finite observations within their space, and every step is taken.
    usable: ClassVar[dict[str, tuple[float, float]]] = {}

    def __init__(
        self,
        *,
        dt: float | None = None,
        duration: float | None = None,
        target: float | None = None,
        **parameters: Any,
    ) -> None:
        known = {f.name for f in dataclasses.fields(self.scene_type)}
        unknown = sorted(set(parameters) - known)
        if unknown:
            options = [
                *sorted(known),
                "dt",
                "duration",
                *(["target"] if self.target_range is not None else []),
            ]
            # In Python's own words, by which libraries notice that an environment takes no `frameskip`.
            raise TypeError(
                f"got an unexpected keyword argument {unknown[0]!r}; "
                f"this environment takes {', '.join(options)}"
            )
        self.scene: Scene = self.scene_type(**(self.defaults | parameters))
        self.dt = self.interval if dt is None else check_number("dt", dt, "s")
        if not 1e-6 <= self.dt <= 1.0:
            raise ValueError(f"dt must lie between 1e-6 and 1 s, got {self.dt:g} s")
        seconds = self.interval * self.steps if duration is None else duration
        self.duration = check_number("duration", seconds, "s", endless=True)
        if not self.duration >= self.dt:
            raise ValueError(f"duration must be at least dt={self.dt:g} s, got {self.duration:g} s")
        self.target: float | None = None if target is None else self.check_target(target)
        self.check()
        self.check_usable()

    def check(self) -> None:
        """Raise ValueError where the parameters do not fit the task."""

    def check_usable(self) -> None:
        """Raise ValueError where a parameter is outside the range in which the task can be used."""
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

    @property
    def fastest(self) -> float:
        """Speed that field and drive give to what swings [rad/s]; 0 where nothing does."""
        return 0.0

    @classmethod
    def usable_ranges(cls) -> dict[str, tuple[float, float]]:
        """Return the range of each parameter in which the task can be used."""
        fields = dataclasses.fields(cls.scene_type)
        return {f.name: f.metadata["usable"] for f in fields if "usable" in f.metadata} | cls.usable

    @property
    def variant(self) -> tuple:
        """What decides the code besides class and control: the environments of a batch must agree in it."""
        return self.scene.state_names, self.target is None

    @property
    def limit(self) -> float:
        """Steps of an episode; infinity for one without an end."""
        steps = self.duration / self.dt
        return steps if math.isinf(steps) else float(round(steps))

    def constants(self) -> dict[str, float]:
        """Return what the compiled step needs: constants of scene, task and stepping."""
        own = {name: float(value) for name, value in self.numbers().items()}
        stepping = {"scale": self.dt / self.interval, "limit": self.limit}
        goal = {} if self.target is None else {"goal": self.target}
        return self.scene.constants() | own | stepping | goal

    @property
    def largest_x(self) -> float:
        """The bound's x up to which one step is certified."""
        return self.scene.largest_x(self.dt)

    @property
    def control_range(self) -> tuple[float, float]:
        """The controls of the actions -1 and 1 at the centre of the starts."""
        k = SimpleNamespace(**self.constants())
        y = self.scene.lift(self.centre)
        low, high = (float(self.control(a, y, k, self.dt, np)) for a in (-1.0, 1.0))
        return low, high

    @property
    def edges(self) -> Sequence[Sequence[float]]:
        """States at the edge of what the task reaches, in all that drives the motion but θ and θ'."""
        return [self.centre]

    def certified_speed(self) -> float | None:
        """Return the |θ'| up to which one series per step is certified, whatever the control [rad/s].

        It is below 0 where one series is never enough, and None where the scene is not stepped by one. See
        `Scene.certified_speed`.
        """
        found = [
            self.scene.certified_speed(state, u, self.dt) for state in self.edges for u in self.control_range
        ]
        return min((speed for speed in found if speed is not None), default=None)

    def check_target(self, target: Any) -> float:
        """Return the target as float, or raise a ValueError."""
        if self.target_range is None:
            raise ValueError(f"this task has no target, got target={target!r}")
        return check_number("target", target)

    def check_start(self, state: ArrayLike) -> NDArray[np.float64]:
        """Return a given start as float64 array, or raise a ValueError where the task cannot start there."""
        array = self.scene.check_state(state)
        for name, unit, value in zip(self.scene.state_names, self.scene.state_units, array, strict=True):
            if unit.endswith("/s") and abs(value) > FASTEST_START:
                raise ValueError(
                    f"{name} must lie within ±{FASTEST_START:g} {unit} at the start, got {value:g} {unit}"
                )
        self.check_safe(array)
        return array

    def check_safe(self, state: NDArray[np.float64]) -> None:
        """Raise ValueError for a start outside the set in which the episode goes on."""

    def start_state(self, state: ArrayLike) -> NDArray[np.float64]:
        """Return a given start, checked; see `check_start`."""
        return self.check_start(state)

    @property
    def formulas(self) -> FlowFormulas:
        """What compiled functions are made of."""
        return FlowFormulas(self)

    # --- the picture ---------------------------------------------------------------------------------------

    def shapes(self, now: Moment) -> list[Shape]:
        """Return what is to be seen, from back to front: the scene, and what matters to the task."""
        return self.scene.shapes(now)

    def window(self, now: Moment) -> Window:
        """Return the part of the plane to look at [m]."""
        return self.scene.window(now)

    def share(self, control: float) -> float:
        """Return the control as a share of the largest one."""
        return control / self.limit_control

    def turning(self, state: Sequence[float]) -> float:
        """Return the rate of a coordinate that the picture shows and the state leaves out."""
        return self.scene.turning(state)

    def control_readings(self, now: Moment) -> list[Reading]:
        """Return what the read-out tells of the control."""
        name, _, unit = self.scene.control_unit.rstrip("]").partition(" [")
        return [Reading(name, now.control, unit, "action")]

    def readings(self, now: Moment) -> list[Reading]:
        """Return what the read-out tells besides state and control."""
        if now.target is None:
            return []
        return [Reading(self.scene.state_names[0] + "*", now.target, self.scene.state_units[0], "target")]

    # --- what a task defines -------------------------------------------------------------------------------

    @property
    @abstractmethod
    def limit_control(self) -> float:
        """Largest control."""

    @property
    @abstractmethod
    def start(self) -> Sequence[float]:
        """Half widths of the box around `centre` from which the state starts."""

    @property
    def centre(self) -> Sequence[float]:
        """Centre of the box from which the state starts."""
        return [0.0] * len(self.scene.state_names)

    @abstractmethod
    def numbers(self) -> dict[str, float]:
        """Return the constants that the task's formulas need."""

    @abstractmethod
    def control(self, a: Any, y: Sequence, k: Any, dt: Any, xp: Any) -> Any:
        """Return the control for an action in [-1, 1]."""

    @abstractmethod
    def reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return the step's reward."""

    def last_reward(self, y: Sequence, z: Sequence, u: Any, g: Any, k: Any, dt: Any, xp: Any) -> Any:
        """Return the reward of the step that terminates, or None where it is like any other."""
        return None

    def terminated(self, z: Sequence, k: Any, xp: Any) -> Any:
        """Tell whether the episode has come to its end."""
        return False

    def kick(self, z: Sequence, draws: Sequence, k: Any, xp: Any) -> Sequence:
        """Return the lifted state after a random kick; draws lie in [0, 1)."""
        return z

    @abstractmethod
    def observe(self, z: Sequence, g: Any, k: Any) -> Sequence:
        """Return the observation's entries."""

    @abstractmethod
    def bounds(self) -> Sequence[float]:
        """Return a bound on the size of each observation entry, proved for every start that is accepted."""


#: Attributes of a task whose numbers reach its code as constants, if at all.
_NUMBERS = {"scene", "dt", "duration", "target"}


class FlowFormulas:
    """The formulas of a task on a scene with a flow of its own, as `lag_envs.envs.program` asks for them."""

    clipped = True
    actions = controls = 1
    choices = ()
    trace = Trace

    def __init__(self, task: Task) -> None:
        self._task = task
        self.state = task.scene.state_names
        self.observation = task.observation
        self.draws = task.draws
        self.targets = 0 if task.target_range is None else 1
        self.bounded = bool(task.scene.order)
        self.has_last = type(task).last_reward is not Task.last_reward

    @property
    def key(self) -> tuple:
        """What decides the code: tasks of a class that agree in it differ in their numbers only."""
        task, scene = self._task, self._task.scene
        values = (getattr(scene, field.name) for field in dataclasses.fields(scene))
        choices = [math.isinf(v) if isinstance(v, float) else repr(v) for v in values]
        # Formulas may also name attributes of the task, which somebody may have set by hand.
        own = [(name, repr(v)) for name, v in vars(task).items() if name not in _NUMBERS]
        shared = [v for c in type(task).__mro__ for v in vars(c).values() if isinstance(v, int | float)]
        return task.variant, *choices, *own, *shared

    def refusal(self, *arguments: Any) -> StepRefused:
        """Return the error for a step that was refused."""
        return self._task.scene.refusal(*arguments)

    def box(self) -> tuple[list[float], list[float]]:
        """Return the lowest and highest values of the observation's entries."""
        high = list(self._task.bounds())
        return [-b for b in high], high

    def constants(self) -> dict[str, float]:
        """Return every number that compiled functions take, by name."""
        task = self._task
        start = {f"centre{i}": c for i, c in enumerate(task.centre)}
        start |= {f"half{i}": h for i, h in enumerate(task.start)}
        return task.constants() | start | {"dt": task.dt, "x": task.largest_x}

    def stepper(self, absent: frozenset[str]) -> Stepper:
        """Return the code of a control step."""
        return Stepper(self._task.scene, absent)

    def control(self, xp: Any, a: Sequence, y: Sequence, g: Sequence, k: Any) -> list:
        """Return the controls that are applied."""
        return [self._task.control(a[0], y, k, k.dt, xp)]

    def judge(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> tuple:
        """Return the reward, and whether the episode is over."""
        reward = self._task.reward(y, z, u[0], g[0] if g else 0.0, k, k.dt, xp)
        return reward, self._task.terminated(z, k, xp)

    def last(self, xp: Any, y: Sequence, z: Sequence, u: Sequence, g: Sequence, k: Any) -> Any:
        """Return the reward of a step that terminates."""
        return self._task.last_reward(y, z, u[0], g[0] if g else 0.0, k, k.dt, xp)

    def kick(self, xp: Any, draws: Sequence, z: Sequence, k: Any) -> Sequence:
        """Return the lifted state after a kick."""
        return self._task.kick(z, draws, k, xp)

    def observe(self, xp: Any, y: Sequence, g: Sequence, k: Any) -> Sequence:
        """Return the observation."""
        return self._task.observe(y, g[0] if g else 0.0, k)

    def sample_targets(self, draws: Sequence, k: Any) -> list:
        """Return targets from draws in [0, 1)."""
        if not self.targets:
            return []
        if self._task.target is not None:
            return [k["goal"]]
        return [self._task.target_range * (2.0 * draws[0] - 1.0)]

    def lift(self, y: str) -> list[str]:
        """Return the lines that complete the lifted state."""
        return lift_lines(len(self.state), self._task.scene.angle, y)


def finite(bound: float) -> float:
    """Return the bound, or the largest float32 where the episode has no end and so no bound exists."""
    largest = float(np.finfo(np.float32).max)
    return bound if bound < largest else largest  # no speed times no end is no number


def kick_chance(task: Task, chance: float) -> float:
    """Return a step's chance of a kick such that a second has as many as at the task's own interval."""
    return -math.expm1(task.dt / task.interval * math.log1p(-chance))
