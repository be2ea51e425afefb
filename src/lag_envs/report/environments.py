"""The error of whole episodes: every environment of ours, and Gymnasium's of the same kind.

An episode is recorded as it comes out of ``gym.make``: its float64 states, and the controls that were
applied. From the same start, under the same controls, the exact states are computed to more than 30 digits by
chaining control steps whose states are not rounded in between. For the error of one step, every step of the
episode is taken again by itself, from the state that was recorded. Ours are computed by `reference`.
Gymnasium's equations are typed in here, and solved by Taylor series in integers that share no code with the
product.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from operator import mul
from statistics import median
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from mpmath import mp, mpf
from numpy.typing import NDArray

from lag_envs import TASKS
from lag_envs.report import reference
from lag_envs.report.content import Claim, Content, Picture, Table
from lag_envs.report.runner import Job, Result, Row
from lag_envs.stepping.primitives import episode_key, uniform
from lag_envs.tasks.base import Task
from lag_envs.tasks.pivoted_bar import SwingUpFree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECTION = "environments"
Array = NDArray[np.float64]

EPS = 2.0**-53
DIGITS = 34
#: Errors are told up to these times [s], and up to the end.
TIMES = (1.0, 5.0, 10.0)
#: Every step of ours is to stay below the first; every episode below the second, and below so many amplified
#: roundings of its start.
LARGEST_STEP, LARGEST_ERROR, ROUNDINGS = 1e-15, 1e-13, 100.0
APART = 1e9  #: by this factor at least, Gymnasium's errors are to be larger than the largest of ours
POINTS = 120  #: of a curve in the picture


def jobs(quick: bool) -> list[Job]:
    """Return the jobs: one per environment and seed. Quick: one seed, the first second of each episode."""
    seeds = range(1 if quick else 5)
    seconds = 1.0 if quick else None
    made = [
        Job(SECTION, f"{id}, seed {seed}", "environments:ours", {"id": id, "seed": seed, "duration": seconds})
        for id in TASKS
        for seed in seeds
    ]
    made += [
        Job(
            SECTION, f"{id}, seed {seed}", "environments:theirs", {"id": id, "seed": seed, "seconds": seconds}
        )
        for id in PEERS
        for seed in (seeds[:3] if id == "Acrobot-v1" else seeds)  # its episodes last 100 s
    ]
    free: list[dict[str, Any]] = [{"id": id} for id in ("", *UNDRIVEN)]
    if not quick:
        free.insert(1, {"id": "", "dt": 0.02})
    names = [f"{f['id'] or 'ours'}, undriven" + (f", dt {f['dt']:g} s" if "dt" in f else "") for f in free]
    return made + [
        Job(SECTION, name, "environments:undriven", arguments)
        for name, arguments in zip(names, free, strict=True)
    ]


# --- episodes ---


class Episode(NamedTuple):
    """What was recorded: ``controls[i]`` was held from ``states[i]`` to ``states[i + 1]``."""

    states: Array
    controls: list[float]
    terminated: bool


def play(env: gym.Env, actions: Iterator[Any]) -> Episode:
    """Record an episode of one of our environments, which has been reset."""
    inner: Any = env.unwrapped
    states, controls, terminated, truncated = [inner.state], [], False, False
    while not (terminated or truncated):
        _, _, terminated, truncated, _ = env.step(next(actions))
        states.append(inner.state)
        controls.append(inner.control)
    return Episode(np.array(states), controls, terminated)


def random_actions(env: gym.Env, seed: int) -> Iterator[Any]:
    """Return an endless sequence of actions."""
    env.action_space.seed(seed)
    while True:
        yield env.action_space.sample()


def stepping(task: Task, seed: int, digits: int) -> Callable[[Sequence[Any], int, float], list[mpf]]:
    """Return what takes one exact step of our environment: from a state, with a number from 1 and a control.

    Kicks are those of the first episode after a reset with that seed, made by the task's own formula from the
    environment's own random numbers, which are a function of seed, episode and step. They are multiples of
    2**-52, so they are exact.
    """
    k, choose = (
        SimpleNamespace(**task.formulas.constants()),
        SimpleNamespace(where=lambda c, a, b: a if c else b),
    )
    key = np.uint64(episode_key(np.uint64(seed), np.uint64(1)))  # a plain integer would be taken as signed

    def step(state: Sequence[Any], number: int, control: float) -> list[mpf]:
        # One computation; `ours` vouches for whole episodes by a second one with more digits.
        state = reference._once(task.scene, state, control, task.dt, digits)
        with mp.workdps(digits + 30):
            draws = [float(uniform(key, np.uint64(number), np.uint64(i))) for i in range(task.draws)]
            return list(task.formulas.kick(choose, draws, state, k))

    return step


def replay(
    task: Task, seed: int, start: Sequence[Any], controls: Sequence[float], digits: int
) -> list[list[mpf]]:
    """Return the exact states of one of our episodes: the first one after a reset with that seed."""
    step = stepping(task, seed, digits)
    path = [[mpf(x) for x in start]]
    for number, control in enumerate(controls, start=1):
        path.append(step(path[-1], number, control))
    return path


def ours(id: str, seed: int, duration: float | None = None) -> Iterator[Row]:
    """Yield one row: an episode of our environment against the exact one."""
    options: dict[str, Any] = {} if duration is None else {"duration": duration}
    env = gym.make(id, disable_env_checker=True, **options)
    env.reset(seed=seed)
    episode = play(env, random_actions(env, seed))
    row = against_exact(env.unwrapped.task, episode, seed, vouch=seed == 0)  # type: ignore[attr-defined]
    yield row | {"case": id, "seed": seed}


def against_exact(task: Task, episode: Episode, seed: int, vouch: bool = False) -> Row:
    """Return the row of an episode of ours; if asked, computed twice, with how far the two lie apart."""

    def exact(start: Sequence[Any], digits: int = DIGITS) -> list[list[mpf]]:
        return replay(task, seed, start, episode.controls, digits)

    path, step = exact(episode.states[0]), stepping(task, seed, DIGITS)
    alone = [step(y, i, u) for i, (y, u) in enumerate(zip(episode.states, episode.controls, strict=False), 1)]
    row = compare(episode, path, exact(moved(episode.states), DIGITS - 10), alone, task.dt)
    if vouch:
        row["disagreement"] = float(
            max(
                abs(a - b)
                for x, y in zip(path, exact(episode.states[0], DIGITS + 12), strict=True)
                for a, b in zip(x, y, strict=True)
            )
        )
    order = task.scene._order(task.dt)
    row |= {
        "ours": True,
        "integrator": f"Taylor series, order {order}" if order else "exact flow",
        "entries": entries(row.pop("each"), task.scene.state_names, task.scene.state_units),
    }
    return row


# --- measures ---


def sizes(states: Array) -> Array:
    """Return the size of each state entry: the largest it gets in the episode, at least 1."""
    return np.maximum(1.0, np.abs(states).max(axis=0))


def moved(states: Array) -> list[mpf]:
    """Return the start with every entry moved by one rounding of its size."""
    with mp.workdps(60):
        return [mpf(x) + EPS * mpf(size) for x, size in zip(states[0], sizes(states), strict=True)]


def compare(
    episode: Episode,
    path: list[list[mpf]],
    shifted: list[list[mpf]],
    alone: list[list[mpf]],
    dt: float,
    wraps: Sequence[int] = (),
) -> Row:
    """Return errors and amplified rounding, each as the largest up to a time, relative to the states' sizes.

    "one step" is the largest error that any step of the episode makes by itself.

    Parameters
    ----------
    episode : Episode
        What was recorded.
    path, shifted : list of list of mpf
        The exact states from the same start, and from the start that was moved by a rounding.
    alone : list of list of mpf
        For each step the exact state at its end, from the recorded state at its start.
    dt : float
        Control step [s].
    wraps : sequence of int
        Entries that the environment brings back into [-π, π].
    """
    states, scale = episode.states, sizes(episode.states)

    def errors(states: Array, exact: list[list[mpf]]) -> Array:
        each = np.array([reference.errors(a, b) for a, b in zip(states, exact, strict=True)])
        for i in wraps:
            each[:, i] = np.remainder(each[:, i] + math.pi, 2.0 * math.pi) - math.pi
        return np.abs(each)

    up_to = np.maximum.accumulate(errors(states, path))
    one = errors(states[1:], alone).max(axis=0)
    with mp.workdps(60):
        growth = np.array(
            [[float(a - b) for a, b in zip(x, y, strict=True)] for x, y in zip(shifted, path, strict=True)]
        )
    error = (up_to / scale).max(axis=1)
    amplified = np.maximum.accumulate((np.abs(growth) / scale).max(axis=1))
    steps = len(episode.controls)
    marks = {**{f"{t:g} s": round(t / dt) for t in TIMES}, "the end": steps}

    def pairs(values: Array) -> list[list[float]]:
        return [[float(a), float(s)] for a, s in zip(values, scale, strict=True)]

    points = np.unique(np.geomspace(1, steps, POINTS).round().astype(int))
    return {
        "dt": dt,
        "steps": steps,
        "seconds": steps * dt,
        "terminated": episode.terminated,
        "error": {"one step": float((one / scale).max())}
        | {name: float(error[i]) if i <= steps else None for name, i in marks.items()},
        "amplified": {name: float(amplified[i]) if i <= steps else None for name, i in marks.items()},
        "curve": [[float(i * dt), float(error[i]), float(amplified[i])] for i in points],
        "each": {"one step": pairs(one)}
        | {name: pairs(up_to[i]) if i <= steps else None for name, i in marks.items()},
    }


def entries(each: dict[str, Any], names: Sequence[str], units: Sequence[str]) -> list[Row]:
    """Return for each state entry its name, unit, size, and the error up to each mark in that unit."""
    return [
        {"name": name, "unit": unit, "size": each["the end"][i][1]}
        | {mark: values and values[i][0] for mark, values in each.items()}
        for i, (name, unit) in enumerate(zip(names, units, strict=True))
    ]


# --- Gymnasium's equations of motion ---


def pendulum(y: Sequence, u: Any, env: Any, cos_sin: Callable) -> Sequence:
    """Return the rates of (θ, θ') of Pendulum-v1; u is the torque, θ = 0 upright.

    From ``gymnasium/envs/classic_control/pendulum.py``.
    """
    theta, omega = y
    _, sine = cos_sin(theta)
    return omega, (3 * env.g / (2 * env.l)) * sine + (3.0 / (env.m * env.l**2)) * u


def cartpole(y: Sequence, u: Any, env: Any, cos_sin: Callable) -> Sequence:
    """Return the rates of (x, x', θ, θ') of CartPole-v1; u is the force, θ = 0 upright.

    From ``gymnasium/envs/classic_control/cartpole.py``.
    """
    _, speed, theta, omega = y
    c, s = cos_sin(theta)
    push = (u + env.polemass_length * (omega * omega * s)) * (1.0 / env.total_mass)
    leverage = 4.0 / 3.0 - (env.masspole / env.total_mass) * (c * c)
    turn = (env.gravity * s - c * push) / (env.length * leverage)
    return speed, push - (env.polemass_length / env.total_mass) * (turn * c), omega, turn


def acrobot(y: Sequence, u: Any, env: Any, cos_sin: Callable) -> Sequence:
    """Return the rates of (θ1, θ2, θ1', θ2') of Acrobot-v1 ("book"); u is the torque, θ = 0 hangs.

    From ``gymnasium/envs/classic_control/acrobot.py``, with cos(θ - π/2) written as sinθ.
    """
    m1, m2, l1 = env.LINK_MASS_1, env.LINK_MASS_2, env.LINK_LENGTH_1
    a1, a2, inertia, g = env.LINK_COM_POS_1, env.LINK_COM_POS_2, env.LINK_MOI, 9.8
    one, two, rate1, rate2 = y
    c2, s2 = cos_sin(two)
    bend = (m2 * l1 * a2) * s2
    d1 = (m1 * a1**2 + m2 * (l1**2 + a2**2) + 2 * inertia) + (2 * m2 * l1 * a2) * c2
    d2 = (m2 * a2**2 + inertia) + (m2 * l1 * a2) * c2
    phi2 = (m2 * a2 * g) * cos_sin(one + two)[1]
    phi1 = ((m1 * a1 + m2 * l1) * g) * cos_sin(one)[1] + phi2 - bend * rate2 * (rate2 + 2.0 * rate1)
    ratio = d2 / d1
    turn2 = (u + ratio * phi1 - bend * (rate1 * rate1) - phi2) / ((m2 * a2**2 + inertia) - d2 * ratio)
    return rate1, rate2, -1.0 * (d2 * turn2 + phi1) / d1, turn2


def pendulum_energy(y: Sequence, env: Any) -> Any:
    """Return Pendulum-v1's energy above rest [J]."""
    theta, omega = y
    return env.m * env.l**2 * omega**2 / 6 + 0.5 * env.m * env.g * env.l * (1.0 + np.cos(theta))


def cartpole_energy(y: Sequence, env: Any) -> Any:
    """Return CartPole-v1's energy above rest [J]; ``length`` is half of the pole's."""
    _, speed, theta, omega = y
    moving = 0.5 * env.total_mass * speed**2 + env.polemass_length * speed * omega * np.cos(theta)
    turning = (2.0 / 3.0) * env.polemass_length * env.length * omega**2
    return moving + turning + env.polemass_length * env.gravity * (1.0 + np.cos(theta))


class Peer(NamedTuple):
    """One of Gymnasium's environments: its equations, and what its actions mean."""

    rates: Callable[[Sequence, Any, Any, Callable], Sequence]
    names: Sequence[str]
    units: Sequence[str]
    integrator: str
    step: Callable[[Any], float]  #: the control step [s] of an instance
    control: Callable[[Any, Any], float]  #: from an instance and an action, as the environment's own code
    wraps: Sequence[int] = ()
    limits: Callable[[Any], Sequence[float]] = lambda env: ()  #: speeds are cut here, the last entries
    energy: Callable[[Sequence, Any], Any] | None = None  #: above rest [J]


PEERS = {
    "Pendulum-v1": Peer(
        pendulum,
        ("theta", "theta_dot"),
        ("rad", "rad/s"),
        "semi-implicit Euler",
        lambda env: env.dt,
        lambda env, action: float(np.clip(action, -env.max_torque, env.max_torque)[0]),
        limits=lambda env: [env.max_speed],
        energy=pendulum_energy,
    ),
    "CartPole-v1": Peer(
        cartpole,
        ("x", "x_dot", "theta", "theta_dot"),
        ("m", "m/s", "rad", "rad/s"),
        "explicit Euler",
        lambda env: env.tau,
        lambda env, action: env.force_mag if action == 1 else -env.force_mag,
        energy=cartpole_energy,
    ),
    "Acrobot-v1": Peer(
        acrobot,
        ("theta1", "theta2", "theta1_dot", "theta2_dot"),
        ("rad", "rad", "rad/s", "rad/s"),
        "RK4",
        lambda env: env.dt,
        lambda env, action: float(env.AVAIL_TORQUE[action]),
        wraps=(0, 1),
        limits=lambda env: [env.MAX_VEL_1, env.MAX_VEL_2],
    ),
}


def watch(env: Any, peer: Peer, actions: Iterator[Any], steps: int, to_the_end: bool) -> Episode:
    """Record up to so many steps of a peer that has been reset; to its termination, or past it."""
    states, controls, terminated = [np.array(env.state, np.float64)], [], False
    for action in itertools.islice(actions, steps):
        controls.append(peer.control(env, action))
        _, _, over, _, _ = env.step(action)
        states.append(np.array(env.state, np.float64))
        terminated = terminated or bool(over)
        if terminated and to_the_end:
            break
    return Episode(np.array(states), controls, terminated)


def random_episode(id: str, seed: int, steps: int, to_the_end: bool) -> tuple[Any, Episode, int]:
    """Return a peer, an episode of it, and its seed: a later one if with that asked for a speed is cut."""
    peer = PEERS[id]
    env: Any = gym.make(id, disable_env_checker=True).unwrapped
    while True:
        env.reset(seed=seed)
        episode = watch(env, peer, random_actions(env, seed), steps, to_the_end)
        limits = peer.limits(env)
        if not limits or (np.abs(episode.states[:, -len(limits) :]) < limits).all():
            return env, episode, seed
        seed += 1000


def theirs(id: str, seed: int, seconds: float | None = None) -> Iterator[Row]:
    """Yield rows of one of Gymnasium's environments under random actions.

    CartPole-v1 falls within half a second; a second row goes on to 10 s, by its own update, as if it had not.
    """
    seconds = seconds or {"Acrobot-v1": 100.0}.get(id, 10.0)
    steps = round(seconds / PEERS[id].step(gym.make(id, disable_env_checker=True).unwrapped))
    cases = {id: True}
    if id == "CartPole-v1":
        cases["CartPole-v1, past its end"] = False
    for case, to_the_end in cases.items():
        env, episode, used = random_episode(id, seed, steps, to_the_end)
        yield measure(env, PEERS[id], episode) | {"case": case, "seed": used}


def measure(env: Any, peer: Peer, episode: Episode) -> Row:
    """Return the row of a peer's episode against the exact one."""
    dt = peer.step(env)
    path = solve(env, peer, episode.states[0], episode.controls)
    shifted = solve(env, peer, moved(episode.states), episode.controls)
    alone = [solve(env, peer, y, [u])[-1] for y, u in zip(episode.states, episode.controls, strict=False)]
    row = compare(episode, path, shifted, alone, dt, peer.wraps)
    return row | {
        "ours": False,
        "integrator": peer.integrator,
        "entries": entries(row.pop("each"), peer.names, peer.units),
    }


def solve(env: Any, peer: Peer, start: Sequence[Any], controls: Sequence[float]) -> list[list[mpf]]:
    """Return the exact states of a peer's equations of motion, each control held for one step."""
    dt = fixed(peer.step(env))
    with mp.workprec(BITS + 20):
        y = [fixed(x) for x in start]
        path = [y]
        for u in controls:
            y = taylor(lambda states, u=u: peer.rates(states, u, env, cos_sin), y, dt)  # type: ignore[misc]
            path.append(y)
        return [[mp.ldexp(x, -BITS) for x in y] for y in path]


# --- the undriven pendulum ---

#: Let go at rest, this far from hanging [rad]; compared over the first, energy over the second time [s].
RELEASED, COMPARED, LONG = 2.5, 10.0, 100.0
#: Peers, what gives them no force, and the action for it.
UNDRIVEN: dict[str, tuple[dict[str, float], Any]] = {
    "Pendulum-v1": ({}, np.zeros(1, np.float32)),
    "CartPole-v1": ({"force_mag": 0.0}, 0),
}
#: Makes an environment of ours with Pendulum-v1's equation of motion: a rod of 1 m and 1 kg.
TWIN: dict[str, Any] = {
    "mass": 1.0,
    "com_distance": 0.5,
    "damping": 0.0,
    "gravity": 10.0,
    "duration": LONG,
}


def undriven(id: str = "", dt: float = 0.05) -> Iterator[Row]:
    """Yield a row of a pendulum without control, let go at rest: a peer's, or ours with the same equation.

    ``dt`` is the control step of ours [s], by default that of Pendulum-v1.

    ``gain`` is the share by which energy above rest grows in 100 s.
    """
    if not id:
        env: Any = gym.make(SwingUpFree.id, disable_env_checker=True, **TWIN, dt=dt)
        env.reset(seed=0, options={"state": [RELEASED, 0.0]})
        episode = play(env, itertools.repeat(np.zeros(1, np.float32)))
        scene = env.unwrapped.scene
        row = against_exact(env.unwrapped.task, first(episode, dt), seed=0)
        energy = scene.energy(episode.states)["total"] - scene.energy([0.0, 0.0])["total"]
        case = f"{SwingUpFree.id} with Pendulum-v1's equation, undriven"
    else:
        peer, (changes, action) = PEERS[id], UNDRIVEN[id]
        env = gym.make(id, disable_env_checker=True).unwrapped
        env.reset(seed=0)
        vars(env).update(changes)
        env.state = np.array([*[0.0] * (len(peer.names) - 2), math.pi - RELEASED, 0.0])
        dt = peer.step(env)
        episode = watch(env, peer, itertools.repeat(action), round(LONG / dt), to_the_end=False)
        row = measure(env, peer, first(episode, dt))
        assert peer.energy
        energy = peer.energy(list(episode.states.T), env)
        case = f"{id}, undriven"
    yield row | {"case": case, "seed": None, "gain": float(energy[-1] / energy[0] - 1.0)}


def first(episode: Episode, dt: float) -> Episode:
    """Return the part of an undriven episode that is compared."""
    steps = round(COMPARED / dt)
    return Episode(episode.states[: steps + 1], episode.controls[:steps], False)


# --- Taylor series of any equation of motion, in integers ---

BITS, ORDER, TOLERANCE = 160, 40, 100  #: unit 2**-160; what is left out of a step is below about 2**-100


def fixed(x: Any) -> int:
    """Return a number in units of 2**-BITS; a float of ordinary size is exact."""
    return int(mp.ldexp(mpf(x), BITS))


class Series:
    """A quantity as Taylor series in time: each coefficient is found when it is asked for, then known."""

    def __init__(self, rule: Callable[[int], int] | None = None, first: int | None = None) -> None:
        self.known = [] if first is None else [first]
        self._rule = rule

    def to(self, k: int) -> list[int]:
        """Return the coefficients up to the k-th."""
        while len(self.known) <= k:
            assert self._rule
            self.known.append(self._rule(len(self.known)))
        return self.known

    def __add__(self, other: Any) -> Series:
        if isinstance(other, Series):
            return Series(lambda k: self.to(k)[k] + other.to(k)[k])
        number = fixed(other)
        return Series(lambda k: self.to(k)[k] + (0 if k else number))

    def __mul__(self, other: Any) -> Series:
        if isinstance(other, Series):
            return Series(lambda k: sum(map(mul, self.to(k)[: k + 1], other.to(k)[k::-1])) >> BITS)
        number = fixed(other)
        return Series(lambda k: self.to(k)[k] * number >> BITS)

    def __truediv__(self, other: Series) -> Series:
        quotient = Series()

        def rule(k: int) -> int:
            b = other.to(k)
            return ((self.to(k)[k] << BITS) - sum(map(mul, quotient.known, b[k:0:-1]))) // b[0]

        quotient._rule = rule
        return quotient

    def __sub__(self, other: Any) -> Series:
        return self + (-1.0) * other

    def __rsub__(self, other: float) -> Series:
        return (-1.0) * self + other

    __radd__, __rmul__ = __add__, __mul__


def cos_sin(x: Series) -> tuple[Series, Series]:
    """Return cosine and sine of a series."""
    pair = Series(), Series()

    def rule(of: int, sign: int) -> Callable[[int], int]:
        def coefficient(k: int) -> int:
            if k == 0:
                return fixed(mp.cos_sin(mp.ldexp(x.to(0)[0], -BITS))[of])
            turned = [j * a for j, a in enumerate(x.to(k)[: k + 1])]
            other = pair[1 - of].to(k - 1)
            return (sign * sum(map(mul, turned[1:], other[k - 1 :: -1])) >> BITS) // k

        return coefficient

    pair[0]._rule, pair[1]._rule = rule(0, -1), rule(1, 1)
    return pair


def taylor(rates: Callable[[Sequence[Series]], Sequence[Any]], y: list[int], dt: int) -> list[int]:
    """Return the state after dt, both in units of 2**-BITS, of the equations y' = rates(y).

    Examples
    --------
    >>> end = taylor(lambda y: [y[0]], [fixed(1)], fixed(1))
    >>> abs(math.ldexp(end[0], -BITS) - math.e) < 1e-15
    True
    """
    left = h = dt
    while left > 0:
        states = [Series(first=x) for x in y]
        slopes = rates(states)
        for k in range(ORDER):
            new = [(slope.to(k)[k] * h >> BITS) // (k + 1) for slope in slopes]
            for state, coefficient in zip(states, new, strict=True):
                state.known.append(coefficient)
            last = [abs(c) for state in states for c in state.known[-4:]]
            if k > 6 and max(last) < 1 << (BITS - TOLERANCE):
                break
        # Shorten the step until the last coefficients are below the tolerance.
        spare = min(
            (BITS - TOLERANCE - abs(state.known[k]).bit_length()) / k
            for state in states
            for k in range(len(state.known) - 4, len(state.known))
        )
        part = fixed(2.0 ** min(0.0, spare))
        y = []
        for state in states:
            total = 0
            for coefficient in reversed(state.known):
                total = (total * part >> BITS) + coefficient
            y.append(total)
        done = part * h >> BITS
        left -= done
        h = min(left, 2 * done)
    return y


# --- what is shown ---

MARKS = ("one step", *(f"{t:g} s" for t in TIMES), "the end")
BLUE, GREY = "#0072b2", "#666666"
#: Colours of Okabe and Ito.
COLOURS = {"Pendulum-v1": "#d55e00", "CartPole-v1": "#cc79a7", "Acrobot-v1": "#009e73"}


def content(rows: list[Row], problems: list[Result]) -> Content:
    """Return what the section shows."""
    cases = {case: [r for r in rows if r["case"] == case] for case in dict.fromkeys(r["case"] for r in rows)}
    episodes = {case: group for case, group in cases.items() if group[0]["seed"] is not None}
    free = {case: group for case, group in cases.items() if group[0]["seed"] is None}
    failed = {result.name: result.problem or "" for result in problems}
    pictures = []
    if episodes:
        pictures = [
            Picture(
                "environment-errors",
                "Error of whole episodes, relative to the size of the state, as the largest up to a time. "
                "One line per episode, and for CartPole-v1 another for its update carried on past its end. "
                "The exact states are computed to more than 30 digits. Dotted, in the same colours: what "
                "one rounding of the start grows to, in exact arithmetic.",
                lambda: _draw_all(episodes),
            ),
            Picture(
                "environment-errors-each",
                "The same, environment by environment. Solid: error of an episode. Dotted: one rounding of "
                "its start, amplified by the system itself.",
                lambda: _draw_each(episodes),
            ),
        ]
    return Content(
        "Environments over whole episodes",
        _text(),
        [_cases_table(episodes, failed), _entries_table(cases), *([_free_table(free)] if free else [])],
        pictures,
        _claims(rows),
        _summary(episodes),
        [_details(rows)] if rows else [],
    )


def _text() -> list[str]:
    return [
        "Episodes are recorded from gym.make under random actions: float64 states, and the controls that "
        "were applied. The exact states have the same start and the same controls, and are not rounded in "
        f"between. Ours are computed by the report's reference with {DIGITS} digits, and once more with "
        f"{DIGITS + 12} for the first seed. Where a task kicks, the kicks are made by its own formula from "
        "the environment's own random numbers, without rounding.",
        "Gymnasium's equations are read from its source, their parameters from each instance. They are "
        f"solved by Taylor series of order {ORDER} at most, in integers, one held control at a time; a step "
        f"leaves out less than about 1e-{math.floor(TOLERANCE * math.log10(2))}. Its environments cut "
        "speeds: such episodes are left out, and the next seed is taken. Angles that Acrobot-v1 wraps are "
        "compared up to whole turns. Pendulum-v1 rounds the torque's part to float32, as its actions are; "
        "that counts as its error. CartPole-v1 falls within a second under random actions, so its update is "
        "also carried on past that end, to 10 s.",
        "An error is the largest over the entries of the state and over the time until then, each entry "
        "relative to the largest that it gets in the episode, at least 1 in SI units. No method that starts "
        "from float64 numbers can do better than about one rounding of the start, amplified by the system. "
        "So that is shown beside it: every entry of the start is moved by 2^-53 of its size, and followed in "
        "exact arithmetic. Where the system damps or does not amplify, roundings of later steps add to it.",
        "The error of one step is the largest that any step of the episode makes by itself: each is taken "
        "again from the state that was recorded before it, in exact arithmetic, and compared with the state "
        "recorded after it. Ours carry cosine and sine beside the angle; where an angle has grown to many "
        "turns, its rounding and theirs differ, and that counts as error too.",
    ]


def _column(mark: str) -> str:
    return "largest error of one step" if mark == "one step" else f"error up to {mark}"


def _largest(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return max(there) if len(there) == len(values) and there else None


def _ratio(row: Row) -> float:
    return row["error"]["the end"] / row["amplified"]["the end"]


def _span(values: Sequence[float]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def _cases_table(episodes: dict[str, list[Row]], failed: dict[str, str]) -> Table:
    lines: list[list[Any]] = []
    for case, group in episodes.items():
        ends = [r["error"]["the end"] for r in group]
        lines.append(
            [
                case,
                group[0]["integrator"],
                group[0]["dt"],
                len(group),
                _span([r["seconds"] for r in group]),
                *(_largest([r["error"][mark] for r in group]) for mark in MARKS[:-1]),
                median(ends),
                max(ends),
                max(r["amplified"]["the end"] for r in group),
                max(_ratio(r) for r in group),
                "",
            ]
        )
    columns = [
        *("environment", "integrator", "dt [s]", "episodes", "length [s]"),
        *map(_column, MARKS[:-1]),
        *("whole episode, median", "whole episode, largest"),
        *("amplified rounding", "error over amplified rounding", "problem"),
    ]
    empty = [None] * (len(columns) - 2)
    lines += [[name, *empty, problem] for name, problem in failed.items()]
    return Table(
        "environment-errors",
        "Errors relative to the size of the state. Largest over the episodes where not said otherwise; "
        "empty where an episode was over before.",
        columns,
        lines,
    )


def _entries_table(cases: dict[str, list[Row]]) -> Table:
    lines = []
    for case, group in cases.items():
        for i, entry in enumerate(group[0]["entries"]):
            errors = [_largest([r["entries"][i][mark] for r in group]) for mark in MARKS]
            size = max(r["entries"][i]["size"] for r in group)
            lines.append([case, entry["name"], entry["unit"], size, *errors])
    return Table(
        "environment-entries",
        "Errors of each entry of the state in its unit, the largest over the episodes. Size: the largest "
        "that the entry gets, at least 1.",
        ["environment", "entry", "unit", "size", *map(_column, MARKS)],
        lines,
    )


def _free_table(free: dict[str, list[Row]]) -> Table:
    lines = []
    for case, row in ((case, row) for case, group in free.items() for row in group):
        angle = next(e for e in row["entries"] if e["name"] == "theta")
        steps = [case, row["integrator"], row["dt"], angle["one step"], angle["1 s"], angle["10 s"]]
        lines.append([*steps, row["amplified"]["10 s"], _ratio(row), 100.0 * row["gain"]])
    return Table(
        "environment-undriven",
        f"A pendulum without control, let go at rest {RELEASED} rad from hanging: error of its angle, and by "
        f"how much its energy above rest grows in {LONG:g} s, where it should stay. Ours has the equation of "
        "motion of Pendulum-v1. A step of 0.05 s is 2.5 times the one that its series is laid out for, so "
        "the error is truncation within the 1e-12 rad/s that a step may leave out; with 0.02 s only rounding "
        "is left. CartPole-v1 is given no force.",
        [
            *("case", "integrator", "dt [s]", "angle, one step [rad]", "up to 1 s [rad]"),
            *("up to 10 s [rad]", "amplified rounding", "error over amplified rounding"),
            f"energy gained in {LONG:g} s [%]",
        ],
        lines,
    )


def _details(rows: list[Row]) -> Table:
    lines = [
        [r["case"], r["seed"], r["steps"], r["terminated"], e["name"], e["unit"], *(e[m] for m in MARKS)]
        for r in rows
        for e in r["entries"]
    ]
    columns = ["case", "seed", "steps", "terminated", "entry", "unit", *map(_column, MARKS)]
    return Table(
        "environment-episodes", "Errors of each episode, entry by entry, in its unit.", columns, lines
    )


def _summary(episodes: dict[str, list[Row]]) -> Table | None:
    lines = [
        [
            case,
            group[0]["integrator"],
            _largest([r["error"]["one step"] for r in group]),
            max(r["error"]["the end"] for r in group),
            _span([r["seconds"] for r in group]),
            max(_ratio(r) for r in group),
        ]
        for case, group in episodes.items()
    ]
    if not lines:
        return None
    return Table(
        "environments",
        "Error against the exact motion under the same controls, relative to the size of the state; the "
        "largest over random episodes. One step: the largest over all of their steps. Last column: over what "
        "one rounding of the start grows to by itself.",
        ["environment", "integrator", "one step", "whole episode", "length [s]", "over rounding"],
        lines,
    )


def _claims(rows: list[Row]) -> list[Claim]:
    made = [r for r in rows if r["ours"] and r["seed"] is not None]
    peers = [r for r in rows if not r["ours"] and r["seed"] is not None]
    apart = [r["disagreement"] for r in made if "disagreement" in r]
    free = [r for r in rows if r["seed"] is None]
    same = {r["ours"]: r for r in free if "Pendulum-v1" in r["case"] and r["dt"] == 0.05}
    worst = max(made, key=lambda r: r["error"]["the end"], default=None)
    least = min(peers, key=lambda r: r["error"]["the end"], default=None)
    above = max(made, key=_ratio, default=None)
    step = max(made, key=lambda r: r["error"]["one step"], default=None)
    claims = [
        Claim(
            f"No episode of ours is off by more than {LARGEST_ERROR:g} of the state's size.",
            worst["error"]["the end"] <= LARGEST_ERROR if worst else None,
            f"{worst['error']['the end']:.2g} in {worst['case']}, of {len(made)} episodes" if worst else "",
        ),
        Claim(
            f"Every error of ours stays below {ROUNDINGS:g} times one rounding of the start, as the system "
            "itself amplifies it.",
            _ratio(above) <= ROUNDINGS if above else None,
            f"{_ratio(above):.2g} times in {above['case']}" if above else "",
        ),
        Claim(
            f"No step of ours is off by more than {LARGEST_STEP:g} of the state's size.",
            step["error"]["one step"] <= LARGEST_STEP if step else None,
            f"{step['error']['one step']:.2g} in {step['case']}, of {sum(r['steps'] for r in made):,} steps"
            if step
            else "",
        ),
        Claim(
            f"Every episode of Gymnasium's is off by more than {APART:g} times the largest error of ours.",
            least["error"]["the end"] > APART * worst["error"]["the end"] if worst and least else None,
            f"{least['case']}: at least {least['error']['the end']:.2g}, "
            f"{least['error']['the end'] / worst['error']['the end']:.1g} times"
            if worst and least
            else "",
        ),
        Claim(
            "On the undriven pendulum with the same equation and step, Pendulum-v1 is off by more than "
            f"{APART:g} times as much as ours, after 10 s.",
            _angle(same[False]) > APART * _angle(same[True]) if len(same) == 2 else None,
            "; ".join(f"{r['case']}, dt {r['dt']:g} s: {_angle(r):.3g} rad" for r in free),
        ),
        Claim(
            "Two computations of the exact states with different digits agree to 1e-25.",
            max(apart) <= 1e-25 if apart else None,
            f"{max(apart):.1g} apart in {len(apart)} episodes" if apart else "",
        ),
    ]
    return claims


def _angle(row: Row) -> float:
    """Return the largest error of an undriven pendulum's angle [rad]."""
    return next(e["the end"] for e in row["entries"] if e["name"] == "theta")


def _colour(row: Row) -> str:
    return BLUE if row["ours"] else COLOURS[row["case"].partition(",")[0]]


def _curve(row: Row) -> tuple[list[float], list[float], list[float]]:
    """Return times, errors and amplified roundings; what is exactly 0 is drawn at the picture's lower end."""
    times, errors, amplified = zip(*row["curve"], strict=True)
    return list(times), [max(e, 1e-19) for e in errors], list(amplified)


def _draw_all(episodes: dict[str, list[Row]]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5.2), layout="constrained")
    axes = figure.add_subplot()
    named: set[str] = set()
    for row in sorted(itertools.chain(*episodes.values()), key=lambda r: r["ours"]):
        name = "lag_envs, all environments" if row["ours"] else row["case"].partition(",")[0]
        times, errors, amplified = _curve(row)
        label = None if name in named else name
        named.add(name)
        axes.plot(times, errors, color=_colour(row), lw=1.8 if row["ours"] else 1.2, label=label)
        axes.plot(times, amplified, color=_colour(row), lw=0.7, ls=":")
    axes.plot([], [], color=GREY, lw=1, ls=":", label="one rounding of the start, amplified")
    axes.set(xscale="log", yscale="log", xlabel="time in the episode [s]", ylim=(1e-18, 30))
    axes.set_ylabel("error relative to the state's size")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.52), fontsize=9)
    return figure


def _draw_each(episodes: dict[str, list[Row]]) -> Figure:
    from matplotlib.figure import Figure

    columns = 3
    lines = -(-len(episodes) // columns)
    figure = Figure(figsize=(8, 0.6 + 1.75 * lines), layout="constrained")
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(episodes) :]:
        axes.set_axis_off()
    for axes, (case, group) in zip(grid.flat, episodes.items(), strict=False):
        for row in group:
            times, errors, amplified = _curve(row)
            axes.plot(times, errors, color=_colour(row), lw=1.6)
            axes.plot(times, amplified, color=GREY, lw=1, ls=":")
        axes.set(xscale="log", yscale="log", ylim=(1e-18, 30))
        axes.set_title(case, fontsize=9)
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8)
    figure.supxlabel("time in the episode [s]", fontsize=9)
    figure.supylabel("error relative to the state's size", fontsize=9)
    return figure
