"""Hidden parameters, imperfect sensors and actuators: the keywords that every environment takes.

The keywords are checked here and stored as numbers; `lag_envs.envs.imperfect` prints their code.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes.checks import check_lags, check_number, shown
from lag_envs.scenes.declaring import complete
from lag_envs.scenes.derivation import layout_of, motion_constants_of
from lag_envs.tasks.formulas import UNBOUNDED

if TYPE_CHECKING:
    from lag_envs.tasks.base import Task

#: No normal draw is larger: √(2 · 53 log 2), since the uniform number behind it is at least 2^-53.
LARGEST_NORMAL = math.sqrt(106.0 * math.log(2.0)) * (1.0 + 1e-9)
#: Largest number of control steps by which actions and observations may be late.
LATEST = 20_000
#: Largest number of parameters that may be drawn: all corners of their ranges are tried.
MOST_DRAWN = 8
#: A delay that is this close to a whole number of control steps is rounded to that number [steps].
_WHOLE = 1e-9
#: Bounds that are not proved are widened by this share; values beyond the bounds are clipped.
MARGIN = 0.1


def normals(first: Any, second: Any, xp: Any) -> list[Any]:
    """Return two normal numbers, computed from two uniform ones in [0, 1)."""
    radius, angle = xp.sqrt(-2.0 * xp.log(1.0 - first)), 2.0 * math.pi * second
    return [radius * xp.cos(angle), radius * xp.sin(angle)]


class Draw(NamedTuple):
    """A parameter that is drawn anew for each episode: `base` times a factor between `low` and `high`."""

    name: str
    base: float
    low: float
    high: float
    log: bool

    def at(self, share: float) -> float:
        """Return the value at a share of the range."""
        return float(self.printed(share, self.base, self.low, self.high, np))

    def printed(self, share: Any, base: Any, low: Any, high: Any, xp: Any) -> Any:
        """Return the value at a share of the range; numbers may be recorded."""
        if self.log:
            factor = xp.exp(xp.log(low) + share * (xp.log(high) - xp.log(low)))
        else:
            factor = low + share * (high - low)
        return base * xp.minimum(xp.maximum(factor, low), high)


@dataclasses.dataclass(frozen=True)
class Imperfections:
    """Checked deviations from perfect sensors, perfect actuators and known parameters.

    Attributes
    ----------
    drawn : tuple of Draw
        Parameters that are drawn for each episode.
    observation_noise : tuple of float
        Standard deviation for each entry of the observation, in its unit.
    observation_delay : tuple of float
        Lowest and highest age of the observations [control steps]; empty for none.
    observation_every : int
        Control steps from one reading to the next.
    action_noise : tuple of float
        Standard deviation for each action, actions being in [-1, 1].
    action_delay : (float, float)
        Shortest and longest time from an action to its effect [control steps].
    slew : tuple of float
        Largest change of each control that actions set [SI unit per second]; infinity for no limit.
    lag : tuple of float
        1/τ of the actuator of each control of the scene [1/s]; 0 for an actuator without a lag.
    push : tuple of float
        Largest size of a random impulse, for each entry of the state.
    push_rate : float
        Pushes per second.
    """

    drawn: tuple[Draw, ...] = ()
    observation_noise: tuple[float, ...] = ()
    observation_delay: tuple[float, ...] = ()
    observation_every: int = 1
    action_noise: tuple[float, ...] = ()
    action_delay: tuple[float, float] = (0.0, 0.0)
    slew: tuple[float, ...] = ()
    lag: tuple[float, ...] = ()
    push: tuple[float, ...] = ()
    push_rate: float = 0.0

    @property
    def commands(self) -> int:
        """Number of stored actions: those that may still come into force, and the action in force."""
        return 1 + math.ceil(self.action_delay[1])

    @property
    def readings(self) -> int:
        """Number of stored observations: those that are still to be shown."""
        return 1 + math.floor(self.observation_delay[1]) if self.observation_delay else 0

    @property
    def jittered(self) -> bool:
        """Whether the age of the observations varies."""
        return len(set(self.observation_delay)) > 1

    @property
    def within(self) -> bool:
        """Whether observations are taken within a control step."""
        return self.jittered or any(age % 1.0 for age in self.observation_delay)

    @property
    def whole(self) -> bool:
        """Whether commands change and observations are taken only at the ends of control steps."""
        shortest, longest = self.action_delay
        return not (self.within or shortest < longest or longest % 1.0)

    @property
    def structure(self) -> tuple:
        """What determines the code; all other numbers are its input."""
        return (
            tuple((d.name, d.log) for d in self.drawn),
            tuple(x > 0.0 for x in self.observation_noise),
            (self.readings, self.within, self.jittered),
            self.observation_every > 1,
            tuple(x > 0.0 for x in self.action_noise),
            self.commands,
            self.whole,
            self.action_delay[0] < self.action_delay[1],
            tuple(map(math.isfinite, self.slew)),
            bool(self.lag),
            tuple(x > 0.0 for x in self.push),
        )


def imperfections_of(task: Task, given: Mapping[str, Any]) -> Imperfections | None:
    """Return the imperfections requested by keywords, or else by the task itself; None for none.

    Raises
    ------
    ValueError
        If a keyword is wrong; the message names keyword, value and remedy.
    """
    own = type(task).imperfections
    for name in own:
        if name not in KEYWORDS:
            raise ValueError(
                f"{type(task).__name__}.imperfections: unknown {name!r}; known are {', '.join(KEYWORDS)}"
            )
    asked = {name: value for name, value in (dict(own) | dict(given)).items() if value is not None}
    found: dict[str, Any] = {}
    for name, value in asked.items():
        try:
            found |= _READERS[name](task, value)
        except ValueError as error:
            if name in given:
                raise
            raise ValueError(f"{type(task).__name__}.imperfections: {error}") from error
    made = Imperfections(**found)
    return None if made == Imperfections() else made


# --- one keyword each ---------------------------------------------------------------------------------------


def _numbers(keyword: str, value: Any, names: Sequence[str], what: str, missing: float) -> tuple[float, ...]:
    """Return a number for each name, from one number for all, from a mapping, or from a sequence."""
    if not names:
        raise ValueError(f"{keyword}: this task has no {what}, got {shown(value)}; leave it out")
    if isinstance(value, Mapping):
        for name in value:
            if name not in names:
                raise ValueError(f"{keyword}: there is no {what} {name!r}, only {', '.join(names)}")
        given = [value.get(name, missing) for name in names]
    elif isinstance(value, Sequence | np.ndarray) and not isinstance(value, str) and np.ndim(value) == 1:
        if len(value) != len(names):
            raise ValueError(
                f"{keyword} must be one number for all, numbers by name, or {len(names)} numbers, for "
                f"{', '.join(names)}; got {shown(value)}"
            )
        given = list(value)
    else:
        given = [value] * len(names)
    return tuple(
        check_number(keyword, x) if x is value else check_number(f"{keyword} of {name}", x, endless=True)
        for name, x in zip(names, given, strict=True)
    )


def _sizes(keyword: str, value: Any, names: Sequence[str], what: str) -> tuple[float, ...]:
    """Return numbers of at least 0; an empty tuple if all are 0."""
    found = _numbers(keyword, value, names, what, 0.0)
    for name, x in zip(names, found, strict=True):
        if not 0.0 <= x < math.inf:
            raise ValueError(
                f"{keyword} must be finite and at least 0, got {x:g} for {name}; 0 switches it off"
            )
    return found if any(found) else ()


def _seconds(keyword: str, value: Any, dt: float) -> float:
    """Return a delay in control steps."""
    delay = check_number(keyword, value, "s")
    if not 0.0 <= delay:
        raise ValueError(f"{keyword} must be at least 0 s, got {delay:g} s: a delay cannot be negative")
    steps = delay / dt
    if abs(steps - round(steps)) <= _WHOLE:
        steps = float(round(steps))
    if steps > LATEST:
        raise ValueError(
            f"{keyword} must be at most {LATEST} control steps, {LATEST * dt:g} s, got {delay:g} s"
        )
    return steps


def _delays(keyword: str, value: Any, dt: float) -> tuple[float, float]:
    """Return the shortest and the longest delay in control steps, from one number or from a pair."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, Sequence) or isinstance(value, str):
        delay = _seconds(keyword, value, dt)
        return delay, delay
    if len(value) != 2:
        raise ValueError(f"{keyword} must be seconds, or the shortest and the longest, got {shown(value)}")
    low, high = (_seconds(keyword, x, dt) for x in value)
    if low > high:
        raise ValueError(f"{keyword} must be (shortest, longest), got {shown(value)}")
    return low, high


def _observation_noise(task: Task, value: Any) -> dict[str, Any]:
    return {
        "observation_noise": _sizes("observation_noise", value, task.observation, "entry of the observation")
    }


def _observation_delay(task: Task, value: Any) -> dict[str, Any]:
    ages = _delays("observation_delay", value, task.dt)
    return {"observation_delay": ages if any(ages) else ()}


def _observation_every(task: Task, value: Any) -> dict[str, Any]:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)
    if not whole or not 1 <= value < 2**31:
        raise ValueError(
            f"observation_every must be a whole number of control steps, at least 1, got {shown(value)}"
        )
    return {"observation_every": int(value)}


def _action_noise(task: Task, value: Any) -> dict[str, Any]:
    names = [a.control for a in task.formulas.acting]
    sizes = _sizes("action_noise", value, names, "control that actions set")
    if sizes and task.formulas.choices:
        raise ValueError(
            f"action_noise is for actions in [-1, 1]; the actions of {type(task).__name__} are choices from "
            f"a list, got {shown(value)}"
        )
    return {"action_noise": sizes}


def _action_delay(task: Task, value: Any) -> dict[str, Any]:
    delays = _delays("action_delay", value, task.dt)
    if any(delays) and not task.formulas.acting:
        raise ValueError(f"action_delay: this task has no action, got {shown(value)}; leave it out")
    return {"action_delay": delays}


def _slew(task: Task, value: Any) -> dict[str, Any]:
    names = [a.control for a in task.formulas.acting]
    if np.ndim(value) == 0 and value == math.inf:
        return {}
    rates = _numbers("slew", value, names, "control that actions set", math.inf)
    for name, rate in zip(names, rates, strict=True):
        if not rate > 0.0:
            raise ValueError(
                f"slew must be above 0, in the control's unit per second, got {rate:g} for {name}; "
                "None switches it off"
            )
    return {"slew": rates if any(map(math.isfinite, rates)) else ()}


def _lag(task: Task, value: Any) -> dict[str, Any]:
    names = tuple(a.control for a in task.formulas.acting)
    decays = dict(zip(names, check_lags(names, value, task.dt).tolist(), strict=True))
    found = tuple(decays.get(name, 0.0) for name in task.scene.control_names)
    return {"lag": found if any(found) else ()}


def _push(task: Task, value: Any) -> dict[str, Any]:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise ValueError(f"push must be (pushes per second, largest size), got {shown(value)}")
    layout = layout_of(task.scene)
    moving = [e.name for e in layout.state if e.coordinate in layout.free and e.kind != "place"]
    rate = check_number("push: its rate", value[0], "1/s")
    if rate < 0.0:
        raise ValueError(f"push: its rate must be at least 0, got {rate:g}; 0 switches it off")
    sizes = dict(zip(moving, _sizes("push: its size", value[1], moving, "free velocity"), strict=False))
    if rate == 0.0 or not sizes:
        return {}
    return {"push": tuple(sizes.get(e.name, 0.0) for e in layout.state), "push_rate": rate}


def _randomize(task: Task, value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(
            f'randomize must map parameters to ranges, as in {{"damping": (0.1, 10, "log")}}, got '
            f"{shown(value)}"
        )
    if len(value) > MOST_DRAWN:
        raise ValueError(f"randomize takes {MOST_DRAWN} parameters at most, got {len(value)}")
    return {"drawn": tuple(_draw(task, name, given) for name, given in value.items())}


def _draw(task: Task, name: str, given: Any) -> Draw:
    where, scene = f"randomize[{name!r}]", task.scene
    if name not in (numbers := parameter_names(scene)):
        known = [*inspect.signature(type(scene)).parameters, "dt", "duration", "target"]
        why = "it decides how the environment is built" if name in known else "there is no such parameter"
        raise ValueError(f"{where}: this cannot be drawn, because {why}; choose from {', '.join(numbers)}")
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) < 2:
        raise ValueError(
            f'{where} must be (low, high), optionally followed by "log" and "absolute", got {shown(given)}'
        )
    words = list(given[2:])
    for word in words:
        if word not in ("log", "uniform", "absolute", "relative") or words.count(word) > 1:
            raise ValueError(
                f'{where}: after low and high may come "log" or "uniform" and "absolute" or "relative", '
                f"got {shown(word)}"
            )
    if {"log", "uniform"} <= set(words) or {"absolute", "relative"} <= set(words):
        raise ValueError(f"{where}: two of these words exclude each other, got {shown(given)}")
    low, high = (check_number(where, x) for x in given[:2])
    if not low < high:
        raise ValueError(f"{where}: low must be below high, got {shown(given)}")
    log, base = "log" in words, 1.0
    if "absolute" not in words:
        base = getattr(scene, name)
        if not 0.0 <= low:
            raise ValueError(f"{where}: factors must be at least 0, got {low:g}")
        if math.isinf(base):
            raise ValueError(
                f"{where}: {name} is {base:g}, to which no factor can apply; give its range in its unit, "
                '(low, high, "absolute")'
            )
    if log and not low > 0.0:
        raise ValueError(f'{where}: a "log" range must be above 0, got {low:g} to {high:g}')
    return Draw(name, base, low, high, log)


#: What reads each keyword.
_READERS: dict[str, Callable[[Task, Any], dict[str, Any]]] = {
    "randomize": _randomize,
    "observation_noise": _observation_noise,
    "observation_delay": _observation_delay,
    "observation_every": _observation_every,
    "action_noise": _action_noise,
    "action_delay": _action_delay,
    "slew": _slew,
    "lag": _lag,
    "push": _push,
}
#: The keywords.
KEYWORDS = tuple(_READERS)


# --- drawn parameters ---------------------------------------------------------------------------------------


class Drawn:
    """The tasks from which an episode's task is drawn.

    Parameters
    ----------
    task : Task
        A task with drawn parameters.

    Raises
    ------
    ValueError
        If a corner of the ranges is not a possible task, or needs different code.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        assert task.imperfections is not None
        self.draws = task.imperfections.drawn
        self._corners = [
            self.at(ends) for ends in itertools.product(*((d.at(0.0), d.at(1.0)) for d in self.draws))
        ]
        #: A task with values inside all ranges.
        self.inner = self.at([d.at(0.37 + 0.03 * i) for i, d in enumerate(self.draws)])
        for corner in self._corners:
            self._compare(corner)

    def at(self, values: Sequence[float]) -> Task:
        """Return the task, without imperfections, that has these values of the drawn parameters."""
        given = dict(zip((d.name for d in self.draws), values, strict=True))
        try:
            found = self.task.varied(**given)
            motion_constants_of(found.scene)  # for its errors
            return found
        except ValueError as error:
            raise ValueError(f"randomize allows {_listed(given)}, which is impossible: {error}") from error

    def _compare(self, corner: Task) -> None:
        if corner.formulas.key == self.inner.formulas.key:
            return
        values = {d.name: getattr(corner.scene, d.name) for d in self.draws}
        raise ValueError(
            f"randomize allows {_listed(values)}, where the formulas of {type(corner).__name__} differ from "
            "those inside the ranges: an attribute that it computes from parameters, or a zero that a "
            "formula divides by, would keep its value; narrow the ranges, or draw other parameters"
        )

    @cached_property
    def tried(self) -> list[Task]:
        """Tasks at the corners, and along lines through the middle of the ranges."""
        middle = [d.at(0.5) for d in self.draws]
        lines = [
            [d.at(share) if d is other else m for other, m in zip(self.draws, middle, strict=True)]
            for d in self.draws
            for share in (0.0, 0.25, 0.5, 0.75, 1.0)
        ]
        return [*self._corners, *map(self.at, lines)]

    @cached_property
    def made(self) -> dict[str, Callable[[Any], Any]]:
        """Parameters computed from others, with their formulas."""
        scene = self.inner.scene
        complete(type(scene))
        fields = {f.name: f.metadata["made"] for f in dataclasses.fields(scene) if "unit" in f.metadata}
        given = {d.name for d in self.draws} | {
            name for name, value in self.task.given.items() if value is not None
        }
        return {name: fields[name] for name in parameter_names(scene) if fields[name] and name not in given}


def _listed(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name}={value:g}" for name, value in values.items())


# --- what can be seen ---------------------------------------------------------------------------------------


def seen_box(task: Task) -> tuple[list[float], list[float]]:
    """Return the lowest and highest values that an environment of this task shows.

    The environment's bounds are those of the task for all parameters that may be drawn, widened by the
    largest noise. Tasks prove their bounds for given parameters, for controls that follow their commands, and
    for the ends of control steps. A margin allows for parameters between those that were tried, for
    observations within a step, and for a lag, which no guard can foresee.
    """
    found = task.imperfections
    if found is None:
        return task.formulas.box()
    boxes = [t.formulas.box() for t in (task.drawn.tried if task.drawn else [task])]
    low: list[float] = []
    high: list[float] = []
    noise = found.observation_noise or (0.0,) * len(task.observation)
    for i, sigma in enumerate(noise):
        ends = [box[0][i] for box in boxes], [box[1][i] for box in boxes]
        for values, end, side, out in ((ends[0], min, -1.0, low), (ends[1], max, 1.0, high)):
            bound = end(values)
            if abs(bound) < UNBOUNDED:
                if found.within or found.lag or min(values) != max(values):
                    bound += side * MARGIN * abs(bound)
                bound += side * sigma * LARGEST_NORMAL
            out.append(min(max(bound, -UNBOUNDED), UNBOUNDED))
    return low, high
