"""Any input to an environment works, or an error names it. No result leaves the spaces."""

from __future__ import annotations

import dataclasses
import decimal
import fractions
import itertools
import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from covering import PERFECT, covering
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rollouts import IDS, actions, make, trace

from lag_envs.envs.interface import check_seed, seed_key
from lag_envs.scenes import CylinderInCylinder, PivotedBar
from lag_envs.tasks import TASKS, incline, pivoted_bar

#: Those that promise to work for all parameters within their ranges.
PROMISED = [i for i in IDS if any(math.isfinite(low) for low, _ in TASKS[i]().usable_ranges().values())]
each_id = pytest.mark.parametrize("env_id", covering(PROMISED))
#: For drawn parameters, the ranges apply to the drawn values.
each_perfect = pytest.mark.parametrize("env_id", covering(i for i in PROMISED if i in PERFECT))

MASKED = np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False])
#: Invalid numbers, and invalid sequences of a number for each of three environments.
NO_NUMBERS = [
    "1", "nan", "", b"1", True, np.True_, 1j, math.nan, -math.inf, 10**400, -(10**400), [], [1.0],
    [1.0, "a", 2.0], [[1.0], [2.0], [3.0]], [1.0, [2.0], 3.0], {}, {"a": 1}, {1.0}, object(), float,
    np.array([1.0]), np.array("a"), np.array(None), MASKED, np.ma.masked, np.ma.masked_array(1.0),
    np.timedelta64(1, "s"), np.datetime64("2020"), np.array([1, 2, 3], "timedelta64[s]"),
    decimal.Decimal(1), iter([1.0]), "long" * 500, np.arange(1000.0), Ellipsis, np.void(b"a"), NotImplemented,
]  # fmt: skip


def parameters(env_id):
    """Return the names of an id's numbers, and of all its keywords."""
    task = TASKS[env_id]()
    numbers = [name for name in task.usable_ranges() if getattr(task.scene, name) is not None]
    return numbers, [*numbers, "dt", "duration", *(["target"] if task.target_range else [])]


def tells(message, name, value):
    """Whether a message names a keyword and shows its value or one of its values, long ones cut short."""
    shown = [value]
    if isinstance(value, list | tuple | range) or (isinstance(value, np.ndarray) and value.ndim):
        shown += list(value)
    starts = [start[:30] for one in shown for start in (repr(one), str(one))]
    starts += [f"{one:g}" for one in shown if isinstance(one, float)]
    return name in message and any(start in message for start in starts)


# --- invalid numbers ---


@each_id
def test_keywords_that_are_no_number(env_id):
    for name, value in itertools.product(parameters(env_id)[1], NO_NUMBERS):
        for build in (make, lambda env_id, **options: gym.make_vec(env_id, num_envs=3, **options)):
            with pytest.raises(ValueError) as error:
                build(env_id, **{name: value})
            assert tells(str(error.value), name, value), (name, value, str(error.value))


@pytest.mark.parametrize("value", ["False", "", 1, 0, None, [], [True], np.array([True, False]), math.nan])
def test_flags(value):
    for build in (make, gym.make_vec):
        with pytest.raises(ValueError, match="diagnostics must be True or False, got ") as error:
            build(incline.Brake.id, diagnostics=value)
        assert repr(value) in str(error.value)


@pytest.mark.parametrize("value", ["", "state", ["state"], [], (), 0, False, {"state"}, MASKED, object()])
def test_options_that_are_no_dict(value):
    env, envs = make(incline.Brake.id), gym.make_vec(incline.Brake.id, num_envs=2)
    for one in (env, envs):
        with pytest.raises(TypeError, match="options must be a dict or None, got ") as error:
            one.reset(options=value)
        assert repr(value)[:40] in str(error.value)
    for key in (1, None, ("state",), "States", b"state"):
        with pytest.raises(ValueError, match=r"unknown reset option .*; known are state, target") as error:
            env.reset(options={key: [1.0]})
        assert repr(key) in str(error.value)


@pytest.mark.parametrize("name", ["state", "target", "reset_mask"])
def test_options_that_are_no_numbers(name):
    env, envs = make(incline.Tilt.id), gym.make_vec(incline.Tilt.id, num_envs=3)
    twins = make(incline.Tilt.id), gym.make_vec(incline.Tilt.id, num_envs=3)
    for one in (env, envs, *twins):
        one.reset(seed=1)
    for value in [*NO_NUMBERS, [0.0, 0.0], np.zeros((3, 4)), [MASKED, MASKED, MASKED]]:
        for one in (env, envs):
            if one is env and name == "reset_mask":
                continue  # an unknown option there
            with pytest.raises((ValueError, TypeError)) as error:
                one.reset(seed=5, options={name: value})
            assert tells(str(error.value), name, value), (value, str(error.value))
    assert trace(env, actions(20, 1)) == trace(twins[0], actions(20, 1))
    assert (envs.state == twins[1].state).all()


def test_actions_that_are_no_numbers():
    env, envs = make(incline.Tilt.id), gym.make_vec(incline.Tilt.id, num_envs=3)
    for one in (env, envs):
        one.reset(seed=1)
        state = one.state
        for value in [*NO_NUMBERS, None, 0.5, MASKED[:, None], np.ma.masked_array([0.5])]:
            if repr(value) in (("[1.0]", "array([1.])") if one is env else ("[[1.0], [2.0], [3.0]]",)):
                continue  # these are actions
            with pytest.raises(ValueError, match="action") as error:
                one.step(value)
            assert tells(str(error.value), "action", value), (value, str(error.value))
        assert (one.state == state).all()


@pytest.mark.parametrize("name", ["num_envs", "max_episode_steps"])
def test_counts(name):
    for value in [0, -2, 1.5, 2.0, "3", *NO_NUMBERS]:
        with pytest.raises(ValueError) as error:
            gym.make_vec(incline.Brake.id, **{"num_envs": 3, name: value})
        assert tells(str(error.value), name, value), (value, str(error.value))
    made = gym.make_vec(incline.Brake.id, **{"num_envs": 3, name: np.int64(2)})
    assert made.num_envs == (2 if name == "num_envs" else 3)


# --- seeds ---

NO_SEEDS = [
    True, np.True_, 1.5, 2.0, np.float64(3.0), "5", "12345", b"12345", bytearray(5), {}, {1: 1, 2: 2, 3: 3},
    {1, 2, 3}, frozenset({1, 2, 3}), np.array(5), np.timedelta64(5, "s"), object(), iter(range(3)), 1j,
    decimal.Decimal(5), fractions.Fraction(5),
]  # fmt: skip
NO_SEED_LISTS = [
    [1.5] * 3, ["1"] * 3, [True] * 3, [1, 2, 3.0], [[1]] * 3, [1, [2], 3], np.arange(3.0),
    np.array([1, 0, 1], bool), np.arange(3).astype("timedelta64[s]"), np.zeros((3, 1), int),
    np.ma.masked_array([1, 2, 3], [0, 1, 0]), np.array(["1", "2", "3"]), (1, 2, b"3"),
    np.array([1, 2, "3"], object),
]  # fmt: skip


@pytest.mark.parametrize("seed", NO_SEEDS, ids=lambda seed: type(seed).__name__)
def test_no_seeds(seed):
    env, envs = make(incline.Brake.id), gym.make_vec(incline.Brake.id, num_envs=3)
    said = []
    for one in (env, envs):
        one.reset(seed=1)
        before = one.state
        with pytest.raises(TypeError, match="seed must be an int or None, got ") as error:
            one.reset(seed=seed)
        said.append(str(error.value))
        assert (one.state == before).all()
    assert said[0] == said[1]
    assert repr(seed)[:40] in said[0]


@pytest.mark.parametrize("seed", NO_SEED_LISTS, ids=repr)
def test_no_lists_of_seeds(seed):
    envs = gym.make_vec(incline.Brake.id, num_envs=3)
    envs.reset(seed=1)
    before = envs.state
    with pytest.raises(TypeError, match=r"seed(\[\d\])? must be an int or None, got "):
        envs.reset(seed=seed)
    assert (envs.state == before).all()


@pytest.mark.parametrize("seed", [-1, np.int64(-5), -(2**70)])
def test_seeds_below_zero(seed):
    env, envs = make(incline.Brake.id), gym.make_vec(incline.Brake.id, num_envs=2)
    for one, given_seed in ((env, seed), (envs, seed), (envs, [1, seed])):
        with pytest.raises(ValueError, match=r"seed(\[1\])? must be at least 0, got ") as error:
            one.reset(seed=given_seed)
        assert repr(seed) in str(error.value)


@pytest.mark.parametrize("kind", [int, np.int8, np.uint64, np.int32])
def test_seeds_of_numpy(kind):
    env, twin = make(incline.Brake.id), make(incline.Brake.id)
    assert env.reset(seed=kind(7))[0].tobytes() == twin.reset(seed=7)[0].tobytes()
    envs, twins = (gym.make_vec(incline.Brake.id, num_envs=3) for _ in range(2))
    wanted = twins.reset(seed=[7, 8, 9])[0].tobytes()
    for seed in (kind(7), np.array([7, 8, 9], kind), [kind(7), 8, kind(9)], range(7, 10), (7, 8, 9)):
        assert envs.reset(seed=seed)[0].tobytes() == wanted


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**64 - 1), st.integers(1, 2**70))
def test_every_bit_of_a_seed_counts(seed, more):
    assert seed_key(check_seed("seed", seed)) == seed
    assert seed_key(seed) != seed_key(seed + more * 2**64)


def test_seeds_beyond_64_bits_in_a_batch():
    envs, env = gym.make_vec(incline.Brake.id, num_envs=3), make(incline.Brake.id)
    seed = 2**64 - 1
    many = envs.reset(seed=seed)[0]
    for i in range(3):
        assert env.reset(seed=seed + i)[0].tobytes() == many[i].tobytes()
    assert len({row.tobytes() for row in [*many, *envs.reset(seed=[0, 1, 2])[0]]}) == 6


# --- ranges ---


def usable(env_id, keywords):
    """Whether the docs promise that these keywords can be used together."""
    task = make(env_id).task
    scene, ranges = task.scene, task.usable_ranges()
    dt = keywords.get("dt", task.dt)
    for name, value in keywords.items():
        low, high = {"dt": (1e-6, 1.0), "duration": (dt, math.inf)}.get(name) or ranges[name]
        if not low <= value <= high and not (name == "track" and value == math.inf):
            return False
    if (env_id, keywords.get("track")) == (pivoted_bar.Balance.id, math.inf):
        return False
    if "duration" not in keywords and dt > task.duration:
        return False
    kept = {field.name: getattr(scene, field.name) for field in dataclasses.fields(scene)}
    p = SimpleNamespace(**kept | keywords)
    if "inertia" not in keywords:
        p.inertia = None
    if isinstance(scene, PivotedBar):
        arm = p.mass * p.com_distance
        about_pivot = arm * p.com_distance + (
            p.mass * p.com_distance**2 / 3.0 if p.inertia is None else p.inertia
        )
        return 2.0 * math.sqrt((p.gravity + task.limit_control) * arm / about_pivot) * dt <= 5000.0
    if isinstance(scene, CylinderInCylinder):
        gap = p.shell_radius - p.radius
        ratio = 0.5 if p.inertia is None else p.inertia / (p.mass * p.radius**2)
        if not gap > 0.0:
            return False
        fall = 2.0 * math.sqrt(p.gravity / ((1.0 + ratio) * gap))
        shell = getattr(task, "fastest_shell", 0.0) * (
            2.0 * ratio * p.shell_radius / ((1.0 + ratio) * gap) + 1.0
        )
        return (fall + shell) * dt <= 5000.0
    return True


def assert_works(env, seed, steps=25, start=None):
    """Step with full swings to and fro; all results are finite and in their spaces."""
    observation, _ = env.reset(seed=seed, options=start)
    for i in range(steps):
        assert np.isfinite(observation).all()
        assert env.observation_space.contains(observation), (observation, env.observation_space.high)
        action = np.array([1.0 if (i // 3 + seed) % 2 else -1.0])
        observation, reward, terminated, truncated, _ = env.step(action)
        assert math.isfinite(reward)
        assert np.isfinite(env.state).all()
        if terminated or truncated:
            observation, _ = env.reset()


def numbers(low, high):
    """Return a strategy for a parameter: in its range, at its ends and just beyond, and anything else.

    Never zero: each set of zero constants has its own code, which would have to be compiled.
    """
    small = max(low, 1e-9 * high, 1e-12)
    inside = st.floats(math.log(small), math.log(high)).map(math.exp).filter(lambda x: low <= x <= high)
    ends = [small, high, math.nextafter(high, math.inf), 2.0 * high]
    ends += [math.nextafter(low, 0.0), 0.5 * low] if low else []
    wild = st.floats(allow_nan=False).filter(lambda x: x != 0.0 and abs(x) > 1e-200)
    return st.one_of(
        inside, inside, st.sampled_from(ends), st.sampled_from([1e-45, 1e50, 1e-300, 1e300]), wild
    )


def keywords_of(env_id):
    """Return a strategy for some keywords of an environment."""
    ranges = make(env_id).task.usable_ranges() | {"dt": (1e-6, 1.0), "duration": (1e-6, 1e6)}
    names = [*parameters(env_id)[0], "dt", "duration"]
    return st.dictionaries(st.sampled_from(names), st.none(), max_size=4).flatmap(
        lambda chosen: st.fixed_dictionaries({name: numbers(*ranges[name]) for name in chosen})
    )


@each_id
def test_any_numbers_work_or_are_named(env_id):
    @settings(
        max_examples=60, deadline=None, derandomize=True, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )  # fmt: skip
    @given(keywords_of(env_id), st.integers(0, 9))
    def check(keywords, seed):
        try:
            env = make(env_id, **keywords)
        except ValueError as error:
            assert not usable(env_id, keywords), error
            assert any(tells(str(error), name, value) for name, value in keywords.items()), error
        else:
            assert usable(env_id, keywords)
            assert_works(env, seed)

    check()


def corners(env_id):
    """Return all sets of keywords that lie at the ends of their ranges."""
    ranges = make(env_id).task.usable_ranges()
    ranges = {name: ranges[name] for name in parameters(env_id)[0]} | {"dt": (1e-6, 1.0)}
    if "tilt" in ranges:
        ranges["tilt"] = (0.0, 0.5 * math.pi)
    for values in itertools.product(*ranges.values()):
        keywords = dict(zip(ranges, values, strict=True)) | {"duration": 20.0}
        if "shell_radius" in keywords:  # the smallest shell has room for one radius, the largest for less
            big = max(keywords["shell_radius"], 2e-9)
            keywords |= {"shell_radius": big, "radius": min(keywords["radius"], 0.9999 * big)}
        # The longest allowed step, if the range's longest is too long.
        short = next(
            dt for dt in (keywords["dt"], 1e-2, 1e-4, 1e-6, 0.0) if usable(env_id, keywords | {"dt": dt})
        )
        keywords |= {"dt": short, "duration": 20.0 * short}
        yield keywords


@pytest.mark.slow
@each_perfect
def test_every_corner_of_the_ranges_works(env_id):
    for keywords in corners(env_id):
        env = make(env_id, **keywords)
        assert_works(env, 1)
        if fast := TASKS[env_id].examples.fast:
            assert_works(env, 1, start={"state": fast})


@each_perfect
def test_some_corners_of_the_ranges_work(env_id):
    needed = ("damping", "gravity", "tilt")
    whole = [c for c in corners(env_id) if all(c.get(name, 1.0) > 0.0 for name in needed)]
    for keywords in whole[:: max(1, len(whole) // 16)]:
        env = make(env_id, **keywords)
        assert_works(env, 1, steps=10)
        if fast := TASKS[env_id].examples.fast:
            assert_works(env, 1, steps=10, start={"state": fast})


@each_id
def test_outside_its_range_each_is_named(env_id):
    ranges = make(env_id).task.usable_ranges()
    for name in parameters(env_id)[0]:
        for value in (
            0.99 * ranges[name][0],
            1.01 * ranges[name][1],
            1e50,
            1e-45 if ranges[name][0] else -1e-45,
        ):
            if ranges[name][0] <= value <= ranges[name][1]:
                continue
            for build in (make, gym.make_vec):
                with pytest.raises(ValueError) as error:
                    build(env_id, **{name: value})
                assert tells(str(error.value), name, value), str(error.value)


def test_spaces_of_episodes_without_an_end():
    # Nothing pulls on a level slope: no speed is gained, however long the episode.
    for options in ({"tilt": 0.0}, {"gravity": 0.0}):
        env = make(incline.Brake.id, duration=math.inf, **options)
        assert np.isfinite(env.observation_space.high).all()


def test_errors_tell_which_environment():
    with pytest.raises(ValueError, match=r"environment 2: mass must be above 0 kg, got -0.3 kg"):
        gym.make_vec("PivotedBar-v0", num_envs=3, mass=[0.1, 0.2, -0.3])
    envs = gym.make_vec(incline.Tilt.id, num_envs=2)
    with pytest.raises(ValueError, match=r"environment 1: the episode would be over at x=0.6 m"):
        envs.reset(options={"state": [[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]]})
    with pytest.raises(ValueError, match=r"environment 1: target must lie on the plane"):
        envs.reset(options={"target": [0.1, 0.7]})


def test_a_parameter_is_declared_with_its_range():
    for env_id in PROMISED:
        task = make(env_id).task
        fields = {field.name for field in dataclasses.fields(task.scene) if field.name != "control"}
        assert set(task.usable_ranges()) == fields
        for name, (low, high) in task.usable_ranges().items():
            assert 0.0 <= low < high < math.inf or name == "tilt"
