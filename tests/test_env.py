"""The single environment behind Gymnasium's interface, for every id."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import own_tasks
import pytest
from covering import PERFECT, covering
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from rollouts import ANY_BAR, IDS, RENDERS, SINGLE, actions, make, nothing, trace

import lag_envs
from lag_envs.envs import program
from lag_envs.envs.model import Model
from lag_envs.envs.program import Program
from lag_envs.envs.single import LagrangianEnv
from lag_envs.scenes import CylinderInCylinder, Incline, PivotedBar
from lag_envs.scenes.checks import StepRefused
from lag_envs.tasks import TASKS, Task, cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.incline import Brake

each_id = pytest.mark.parametrize("env_id", covering())
each_perfect = pytest.mark.parametrize("env_id", covering(PERFECT))
each_single = pytest.mark.parametrize("env_id", covering(SINGLE))
each_perfect_single = pytest.mark.parametrize("env_id", covering(i for i in SINGLE if i in PERFECT))

#: Parameters that a scene, or a task, must refuse. For what is no number, see test_hostile.
IMPOSSIBLE = {
    PivotedBar: [
        {"mass": 0.0},
        {"mass": -1.0},
        {"inertia": -1e-9},
        {"damping": -0.1},
        {"gravity": math.inf},
        {"track": 0.0},
    ],
    pivoted_bar.Balance: [{"track": None}, {"track": math.inf}],
    Incline: [{"radius": 0.0}, {"gravity": -1.0}, {"damping": math.inf}],
    incline.Tilt: [
        {"control": "damping"},
        {"control": "magic"},
        {"tilt": 0.1},
        {"target": 0.51},
        {"target": math.nan},
    ],
    Brake: [{"control": "tilt_rate"}, {"tilt": -0.1}, {"tilt": 1.6}, {"target": 0.1}],
    CylinderInCylinder: [{"radius": 0.5}, {"radius": 0.6}, {"shell_radius": 0.0}, {"mass": -1.0}],
    cylinder_in_cylinder.Tilt: [{"control": "damping"}, {"target": 1.06}, {"target": "up"}],
    cylinder_in_cylinder.Pump: [{"gravity": 0.0}],
    cylinder_in_cylinder.Damping: [{"gravity": 0.0}, {"control": "tilt"}],
    Task: [
        {"dt": 0.0},
        {"dt": 2.0},
        {"dt": -0.02},
        {"dt": math.nan},
        {"dt": "fast"},
        {"duration": 0.0},
        {"duration": -1.0},
        {"duration": math.nan},
        {"duration": "long"},
        {"duration": [1.0]},
    ],
}


# --- checkers and registration ---


#: Checkers' complaints about spaces, even Gymnasium's own.
unusual_spaces = pytest.mark.filterwarnings(
    "ignore:.*(recommend (using|you to use) a symmetric|observation space (min|max)imum value is):UserWarning"
)


@each_id
@unusual_spaces
def test_gymnasium_checker(env_id):
    check_env(make(env_id), skip_render_check=not RENDERS)


@pytest.mark.parametrize("task", [*TASKS.values(), *own_tasks.TASKS], ids=lambda task: task.id)
def test_keys_of_gymnasiums_play_are_actions(task):
    env = gym.make(task.id if task.id in TASKS else lag_envs.register(task))
    keys = env.unwrapped.get_keys_to_action()
    assert list(keys) == ["", "a", "d", "ad"]
    assert all(env.action_space.contains(action) for action in keys.values())


@each_id
@unusual_spaces
def test_stable_baselines_checker(env_id):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(make(env_id), skip_render_check=not RENDERS)


@each_id
def test_made_with_all_wrappers(env_id):
    env = gym.make(env_id)  # PassiveEnvChecker may warn
    env.reset(seed=1)
    trace(env, actions(300, env.action_space))
    env.close()


def test_namespace_of_the_module():
    code = (
        "import gymnasium as gym; e = gym.make('lag_envs:PivotedBar-v0'); e.reset(seed=1); print(e.spec.id)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["PivotedBar-v0"]


@each_id
def test_spec_survives_json(env_id):
    some = dict(list(make(env_id).task.examples.batch.items())[:1])
    env = gym.make(env_id, dt=0.04, **{name: values[1] for name, values in some.items()})
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec == env.spec
    twin = gym.make(spec)
    assert twin.spec == env.spec
    assert twin.unwrapped.task.dt == 0.04
    assert twin.observation_space == env.observation_space
    for e in (env, twin):
        e.reset(seed=3)
    given = actions(60, env.action_space)
    assert trace(env, given) == trace(twin, given)


@each_id
@pytest.mark.parametrize(
    "options", [{}, {"dt": 0.005}, {"duration": 3.0}, {"dt": 0.1, "duration": 2.0}], ids=str
)
@pytest.mark.parametrize(
    "copied",
    [lambda s: s, lambda s: EnvSpec.from_json(s.to_json()), lambda s: pickle.loads(pickle.dumps(s))],
    ids=["spec", "json", "pickle"],
)
def test_spec_names_the_steps_of_an_episode(env_id, options, copied):
    first = gym.make(env_id, **options)
    kind = TASKS[env_id]
    seconds = options.get("duration", kind.interval * kind.steps)
    steps = round(seconds / options.get("dt", kind.interval))
    again = gym.make(copied(gym.make(copied(first.spec)).spec))  # twice: limits don't add up
    native = gym.make_vec(env_id, num_envs=2, **options)
    many = gym.make_vec(copied(gym.make_vec(copied(native.spec)).spec))
    one_of_many = gym.make_vec(copied(first.spec), num_envs=2)
    for env in (first, again, native, many, one_of_many, pickle.loads(pickle.dumps(again))):
        assert env.spec.max_episode_steps == steps
    for env in (first, again):
        limits = [env.unwrapped.task.limit]
        while isinstance(env, gym.Wrapper):
            limits += [env._max_episode_steps] if isinstance(env, gym.wrappers.TimeLimit) else []
            env = env.env
        assert set(limits) == {steps}


def test_episodes_of_remade_environments_are_as_long():
    spec = gym.make("PivotedBar-v0", dt=0.005, duration=1.0).spec
    assert steps_until_truncated(gym.make(EnvSpec.from_json(spec.to_json()))) == 200
    # A spec's steps are a limit. If the interval is changed, Gymnasium is told to leave it out.
    spec = gym.make("PivotedBar-v0", duration=1.0).spec
    assert steps_until_truncated(gym.make(spec, dt=0.005)) == 50
    assert steps_until_truncated(gym.make(spec, dt=0.005, max_episode_steps=-1)) == 200


def test_spec_of_parameters_in_numpys_types_survives_json():
    env = gym.make("PivotedBar-v0", mass=np.float32(0.25), dt=np.array(0.04), damping=np.int64(1))
    twin = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert twin.spec == env.spec and twin.unwrapped.scene == env.unwrapped.scene
    assert twin.unwrapped.task.dt == 0.04


def test_spec_of_an_endless_episode_survives_json():
    env = gym.make(pivoted_bar.SwingUpFree.id, duration=math.inf)
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec == env.spec and spec.max_episode_steps is None
    assert gym.make(spec).unwrapped.task.duration == math.inf


@each_id
def test_spaces(env_id):
    env = make(env_id)
    choices = [len(values) for values in env.task.action.values() if isinstance(values, list)]
    top = env.task.largest_action
    box = gym.spaces.Box(-top, top, (len(env.task.action),), np.float32)
    lists = gym.spaces.Discrete(*choices) if len(choices) == 1 else gym.spaces.MultiDiscrete(choices)
    assert env.action_space == (lists if choices else box)
    space = env.observation_space
    assert space.dtype == np.float32 and space.shape == (len(env.task.observation),)
    finite = env.task.unbounded < np.inf
    assert np.isfinite(space.high).all() == finite
    assert ((space.low == -space.high) | (env_id not in SINGLE)).all()
    assert type(env).metadata["render_modes"] == ["human", "rgb_array"]
    assert env.metadata["render_fps"] == round(1.0 / env.task.dt)


# --- seeds, copies ---


@each_id
def test_a_seed_gives_one_episode(env_id):
    first, second, other = make(env_id), make(env_id), make(env_id)
    given = actions(700, first.action_space)
    starts = [env.reset(seed=seed)[0] for env, seed in ((first, 7), (second, 7), (other, 8))]
    assert starts[0].tobytes() == starts[1].tobytes()
    assert (starts[0] != starts[2]).any()
    history = trace(first, given)
    assert history == trace(second, given)
    first.reset(seed=7)
    assert trace(first, given) == history


@each_id
def test_reset_without_seed_goes_on_with_fresh_episodes(env_id):
    env, twin = make(env_id), make(env_id)
    starts = [
        [e.reset(seed=5)[0].tobytes(), *(e.reset()[0].tobytes() for _ in range(20))] for e in (env, twin)
    ]
    assert starts[0] == starts[1]
    assert len(set(starts[0])) == 21


@each_id
def test_unseeded_environments_differ(env_id):
    assert make(env_id).reset()[0].tobytes() != make(env_id).reset()[0].tobytes()


@pytest.mark.parametrize("seed", [0, 2**32 - 1, 2**63, 2**64 + 5])
def test_any_seed(seed):
    env = make("PivotedBar-v0")
    assert env.reset(seed=seed)[0].tobytes() == env.reset(seed=seed)[0].tobytes()
    assert env.np_random_seed == seed


@pytest.mark.parametrize("seed", [-1, 1.5, "one"])
def test_refused_seeds_leave_the_environment_as_it_was(seed):
    env, twin = running_twins(pivoted_bar.Balance.id)  # its kicks are random
    with pytest.raises((TypeError, ValueError), match="seed must be "):
        env.reset(seed=seed)
    assert trace(env, actions(200, 1)) == trace(twin, actions(200, 1))


@each_id
@pytest.mark.parametrize(
    "clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)
def test_copies_go_on_alike(env_id, clone):
    env = gym.make(env_id)
    env.reset(seed=2)
    trace(env, actions(37, env.action_space))
    twin = clone(env)
    assert (twin.unwrapped.state == env.unwrapped.state).all()
    given = actions(300, env.action_space, seed=1)
    assert trace(env, given) == trace(twin, given)
    assert twin.spec == env.spec


def test_copies_are_independent():
    env = make("PivotedBar-v0")
    env.reset(seed=2)
    before = env.state
    twin = copy.deepcopy(env)
    trace(twin, actions(5, env.action_space))
    assert (env.state == before).all()


# --- parameters ---


@each_id
def test_unknown_keyword(env_id):
    known = next(iter(TASKS[env_id].usable_ranges()))
    told = rf"unexpected keyword argument 'colour'; .*this environment takes .*\b{known}\b"
    with pytest.raises(TypeError, match=told):
        make(env_id, colour="red")


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (env_id, options)
        for env_id in IDS
        for part, many in IMPOSSIBLE.items()
        if issubclass(TASKS[env_id], part) or issubclass(TASKS[env_id].scene, part)
        for options in many
    ],
)
def test_impossible_parameters(env_id, options):
    (name,) = options
    with pytest.raises(ValueError, match=name):
        make(env_id, **options)


def test_bad_render_mode():
    with pytest.raises(ValueError, match="render_mode must be one of human, rgb_array or None, got 'ascii'"):
        LagrangianEnv("lag_envs.tasks.pivoted_bar:SwingUp", render_mode="ascii")


def test_parameters_reach_the_scene():
    env = make("PivotedBar-v0", mass=0.3, com_distance=0.4, inertia=0.01, damping=0.0, gravity=1.6, track=1.0)
    scene = env.scene
    assert (scene.mass, scene.com_distance, scene.inertia, scene.damping, scene.gravity, scene.track) == (
        0.3,
        0.4,
        0.01,
        0.0,
        1.6,
        1.0,
    )
    assert env.scene is env.task.scene


# --- what a step returns ---


@each_single
def test_types(env_id):
    env = make(env_id)
    observation, info = env.reset(seed=1)
    assert type(observation) is np.ndarray and observation.dtype == np.float32 and info == {}
    for action in actions(5, env.action_space):
        observation, reward, terminated, truncated, info = env.step(action)
        assert type(observation) is np.ndarray and observation.dtype == np.float32
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool and info == {}
    assert env.state.dtype == np.float64 and type(env.control) is float
    assert env.target is None or type(env.target) is float


@each_id
def test_nothing_is_shared(env_id):
    env = make(env_id, diagnostics=True)
    arrays, infos = [env.reset(seed=1)[0]], []
    for action in actions(5, env.action_space):
        observation, *_, info = env.step(action)
        arrays += [observation, env.state]
        infos.append(info)
    kept = [a.copy() for a in arrays]
    env.step(actions(1, env.action_space)[0])
    for i, a in enumerate(arrays):
        assert (a == kept[i]).all()
        assert not any(np.shares_memory(a, b) for b in arrays[:i])
    assert len({id(info) for info in infos}) == len(infos)
    state = env.state
    env.state[:] = 7.0
    assert (env.state == state).all()


@each_single
@pytest.mark.parametrize(
    "options", [{}, {"dt": 0.1}, {"dt": 1.0, "duration": 1.0}], ids=["usual", "slow", "one step"]
)
def test_observations_stay_in_the_space(env_id, options):
    env = make(env_id, **options)
    given = actions(3000, 1, seed=4)
    for policy in (
        lambda o, i: given[i],
        lambda o, i: np.sign(o[-1:]),
        lambda o, i: -np.sign(o[:1]),
        lambda o, i: np.sign(o[1:2]),
    ):
        observation, _ = env.reset(seed=3)
        for i in range(600):
            assert observation in env.observation_space
            observation, _, terminated, truncated, _ = env.step(policy(observation, i))
            assert observation in env.observation_space
            if terminated or truncated:
                observation, _ = env.reset()


@each_single
@pytest.mark.parametrize("dt", [None, 1.0])
def test_fastest_starts_stay_in_the_space(env_id, dt):
    env = make(env_id, dt=dt, duration=dt)
    rng = np.random.default_rng(0)
    n = len(env.scene.state_names)
    tried = 0
    for _ in range(300):
        state = np.array(TASKS[env_id].examples.start["state"]) * rng.choice([-1.0, 1.0, 1.8], n)
        fast = [unit.endswith("/s") for unit in env.scene.state_units]
        state[fast] = np.where(
            rng.random(sum(fast)) < 0.5, state[fast], rng.choice([-100.0, 100.0], sum(fast))
        )
        try:
            observation, _ = env.reset(options={"state": state})
        except ValueError:
            continue
        tried += 1
        assert observation in env.observation_space
        for _ in range(5):
            observation, _, terminated, truncated, _ = env.step(rng.choice([-1.0, 1.0], 1))
            assert observation in env.observation_space
            if terminated or truncated:
                break
    assert tried > 20


def test_endless_episodes_are_bounded_by_float32():
    env = make("PivotedBar-v0", duration=math.inf, track=math.inf)
    big = np.finfo(np.float32).max
    assert env.observation_space.high.tolist() == [big, big, 1.0, 1.0, big]
    assert env.observation_space.contains(env.reset(seed=1)[0])


# --- actions ---

BAD = [
    [math.nan],
    [math.inf],
    [-math.inf],
    np.array([np.nan], dtype=np.float32),
    0.5,
    np.float32(0.5),
    [],
    [0.1, 0.2],
    [[0.1]],
    np.zeros((1, 1)),
    [1j],
    np.array([0.5 + 0j]),
    ["up"],
    "up",
    ["0.5"],
    None,
    [None],
    {},
    object(),
    [[0.1], [0.2, 0.3]],
    np.array([np.datetime64("2020-01-01")]),
]


def running_twins(env_id, **options):
    """Return two environments in the midst of one episode."""
    twins = make(env_id, **options), make(env_id, **options)
    for env in twins:
        env.reset(seed=11)
        env.step(np.array([0.25]))
    return twins


@each_single
def test_bad_actions_leave_the_environment_as_it_was(env_id):
    env, twin = running_twins(env_id)
    for action in BAD:
        with pytest.raises(ValueError, match=r"action|inhomogeneous"):
            env.step(action)
    given = actions(50, env.action_space)
    assert trace(env, given) == trace(twin, given)


@each_single
@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (np.array([3.5]), 1.0),
        ([-1e300], -1.0),
        ([1], 1.0),
        (np.array([1], dtype=np.int8), 1.0),
        ([True], 1.0),
        (np.array([False]), 0.0),
        ((0.3,), 0.3),
        (np.array([0.5], dtype=np.float16), 0.5),
        (np.array([0.3], dtype=np.longdouble), 0.3),
        (np.array([0.3], dtype=">f8"), 0.3),
        (np.array([2], dtype=np.uint64), 1.0),
    ],
)
def test_other_actions_mean_their_value(env_id, given, meant):
    env, twin = running_twins(env_id)
    assert trace(env, [given]) == trace(twin, [np.array([meant])])


@each_perfect_single
def test_actions_are_not_rounded(env_id):
    env, twin = running_twins(env_id)
    env.step(np.array([0.3]))
    twin.step(np.array([0.3], dtype=np.float32))
    assert 0.0 < abs(env.control - twin.control) < 1e-7 * env.task.limit_control


@each_single
def test_the_action_is_not_changed(env_id):
    env, _ = running_twins(env_id)
    action = np.array([3.0], dtype=np.float32)
    env.step(action)
    assert action.tolist() == [3.0]


# --- resets ---


@each_id
def test_step_before_reset(env_id):
    env = make(env_id)
    with pytest.raises(ResetNeeded, match="no episode has begun"):
        env.step(nothing(env))
    env.reset(seed=1)
    env.step(nothing(env))


@pytest.mark.parametrize("env_id", covering(i for i, task in TASKS.items() if task.examples.ending))
def test_step_after_termination(env_id):
    env, (start, action) = make(env_id), TASKS[env_id].examples.ending
    env.reset(seed=1, options={"state": start})
    terminated = False
    for _ in range(20):
        _, _, terminated, truncated, _ = env.step(
            np.full(env.action_space.shape, action, env.action_space.dtype)
        )
        if terminated:
            break
    assert terminated and not truncated
    state = env.state
    with pytest.raises(ResetNeeded, match="terminated"):
        env.step(nothing(env))
    assert (env.state == state).all()
    env.reset()
    env.step(nothing(env))


@pytest.mark.parametrize("env_id", ["PivotedBar-v0", pivoted_bar.SwingUpFree.id])
def test_going_on_after_truncation_is_allowed(env_id):
    env = make(env_id, duration=0.1)
    env.reset(seed=1)
    assert [env.step(nothing(env))[3] for _ in range(7)] == [False] * 4 + [True] * 3


@each_perfect
def test_options_state(env_id):
    env = make(env_id)
    start = TASKS[env_id].examples.start["state"]
    observation, _ = env.reset(seed=1, options={"state": start})
    assert env.state.tolist() == start
    assert not np.any(env.control)
    env.step(nothing(env) + 1)
    again, _ = env.reset(options={"state": np.array(start, dtype=np.float64)})
    n = len(observation) - env.task.formulas.targets
    assert again[:n].tobytes() == observation[:n].tobytes()
    assert env.reset(options={})[0].tobytes() != observation.tobytes()


@each_single
def test_unsafe_starts_are_refused(env_id):
    env, twin = running_twins(env_id)
    cases = TASKS[env_id].examples
    good, unsafe = cases.start["state"], [case["state"] for case in cases.refused if "state" in case]
    fast = [101.0 if unit.endswith("/s") else x for x, unit in zip(good, env.scene.state_units, strict=True)]
    for state in [
        *unsafe,
        fast,
        good[:-1],
        [*good, 0.0],
        [math.nan, *good[1:]],
        [*good[:-1], math.inf],
        "up",
        [good],
        1.0,
    ]:
        with pytest.raises(ValueError, match=r"\w"):
            env.reset(seed=1, options={"state": state})
    for options in ({"speed": 1.0}, {"reset_mask": np.array([True])}):
        with pytest.raises(ValueError, match="unknown reset option"):
            env.reset(options=options)
    assert env.control == twin.control
    given = actions(50, env.action_space)
    assert trace(env, given) == trace(twin, given)


@each_single
def test_targets(env_id):
    cases = TASKS[env_id].examples
    if "target" not in cases.start:
        env, twin = running_twins(env_id)
        assert env.target is None
        with pytest.raises(ValueError, match="no target"):
            env.reset(options={"target": 0.1})
        given = actions(20, env.action_space)
        assert trace(env, given) == trace(twin, given)
        with pytest.raises(ValueError, match="no target"):
            make(env_id, target=0.1)
        return
    good, bad = cases.start["target"], [case["target"] for case in cases.refused if "target" in case]
    env, twin = running_twins(env_id)
    for target in (*bad, math.nan, "high", [0.1]):
        with pytest.raises(ValueError, match="target"):
            env.reset(options={"target": target})
    given = actions(20, env.action_space)
    assert trace(env, given) == trace(twin, given)
    observation, _ = env.reset(options={"target": good})
    assert env.target == good and observation[-1] == np.float32(good)
    env.reset()
    assert env.target != good
    fixed = make(env_id, target=good)
    assert {fixed.reset()[0][-1] for _ in range(5)} == {np.float32(good)}
    fixed.reset(options={"target": 0.05})
    assert fixed.target == 0.05
    fixed.reset()
    assert fixed.target == good
    # A fixed target changes no other draw.
    assert (fixed.reset(seed=3)[0][:-1] == env.reset(seed=3)[0][:-1]).all()


# --- time ---


def steps_until_truncated(env):
    env.reset(seed=1)
    for n in range(1, 100_000):
        *_, terminated, truncated, _ = env.step(nothing(env))
        if truncated:
            return n
        if terminated:
            return None
    return None


@each_id
def test_episodes_keep_their_seconds(env_id):
    env = make(env_id)
    seconds = env.task.duration
    assert seconds == env.task.interval * env.task.steps
    assert gym.make(env_id).spec.max_episode_steps == env.task.limit == round(seconds / env.task.dt)
    for dt in (0.01, 0.04, 0.1):
        assert gym.make(env_id, dt=dt).spec.max_episode_steps == round(seconds / dt)
    assert make(env_id, dt=0.1, duration=0.3).task.limit == 3


@pytest.mark.parametrize(
    "options", [{}, {"dt": 0.1}, {"duration": 0.06}, {"dt": 0.03, "duration": 0.1}], ids=str
)
def test_truncation_comes_in_time(options):
    for env_id in ("PivotedBar-v0", cylinder_in_cylinder.Pump.id):
        env = make(env_id, **options)
        assert steps_until_truncated(env) == env.task.limit == round(env.task.duration / env.task.dt)


def test_max_episode_steps_shortens():
    assert steps_until_truncated(gym.make("PivotedBar-v0", max_episode_steps=7)) == 7
    assert gym.make("PivotedBar-v0", max_episode_steps=7).spec.max_episode_steps == 7
    assert steps_until_truncated(gym.make("PivotedBar-v0", max_episode_steps=2000)) == 500
    assert steps_until_truncated(gym.make("PivotedBar-v0", max_episode_steps=-1)) == 500
    assert steps_until_truncated(gym.make("PivotedBar-v0", duration=20.0)) == 1000


def test_an_endless_episode():
    env = gym.make(pivoted_bar.SwingUpFree.id, duration=math.inf)
    assert env.spec.max_episode_steps is None
    env.reset(seed=1)
    assert not any(env.step(nothing(env))[3] for _ in range(2000))


@pytest.mark.parametrize("env_id", covering(i for i in PERFECT if TASKS[i].scaled))
def test_running_rewards_scale_with_the_interval(env_id):
    start = TASKS[env_id].examples.start["state"]
    rates = []
    for dt in (1e-6, 2e-6):
        env = make(env_id, dt=dt, duration=1.0)
        env.reset(seed=1, options={"state": start})
        action = np.full(env.action_space.shape, 0.5).astype(env.action_space.dtype)
        rates.append(env.step(action)[1] / dt)
    assert rates[0] == pytest.approx(rates[1], rel=1e-3)


# --- diagnostics ---


@each_perfect_single
def test_diagnostics(env_id):
    env = make(env_id, diagnostics=True)
    _, info = env.reset(seed=1)
    names = {"control", "energy", *env.scene.forces(env.state)}
    assert set(info) == names and info["control"] == 0.0
    for action in actions(5, env.action_space):
        *_, info = env.step(action)
        assert set(info) == names
        assert info["control"] == env.control
        assert info["energy"] == env.scene.energy(env.state, env.control)["total"]
        for name, value in env.scene.forces(env.state, env.control).items():
            assert info[name] == value
    assert {*env.scene.reactions, *env.scene.ratios} <= names


# --- steps that cannot be taken ---


def test_a_refused_step_changes_nothing():
    extreme = {"com_distance": 1e-9, "inertia": 1e-30, "gravity": 1e3, "mass": 1.0, "damping": 0.0}
    env = make(pivoted_bar.SwingUpFree.id, dt=1.0, **extreme, **ANY_BAR)
    env.reset(seed=1)
    state = env.state
    for _ in range(2):
        with pytest.raises(StepRefused, match="the step was refused: from \\(theta="):
            env.step(nothing(env) + 1)
        assert (env.state == state).all() and env.control == 0.0
    env.reset(seed=2)


@each_id
def test_making_again_derives_nothing(env_id, monkeypatch):
    """Other numbers need no other equations: 64 environments are made in some 30 ms."""
    scene = make(env_id).scene
    others = {name: 1.1 * getattr(scene, name) for name in ("mass", "gravity") if hasattr(scene, name)}

    def refuse(*arguments):
        raise AssertionError("derived again")

    monkeypatch.setattr("lag_envs.mechanics.motion.derive_motion", refuse)
    monkeypatch.setattr("lag_envs.mechanics.recording.record_scene", refuse)
    monkeypatch.setattr("lag_envs.tasks.base.TaskFormulas.recorded", refuse)
    make(env_id, **others)


def test_formulas_are_recorded_once_for_all_numbers(monkeypatch):
    # This takes most of the time of making an environment.
    recorded = []
    record = Program._record

    def count(self, task, constants):
        recorded.append(task)
        record(self, task, constants)

    monkeypatch.setattr(Program, "_record", count)
    monkeypatch.setattr(program, "_programs", {})
    for i in range(5):
        make("PivotedBar-v0", mass=0.1 + 0.1 * i, dt=0.01 + 0.005 * i)
        gym.make_vec("PivotedBar-v0", num_envs=3, track=0.4 + 0.1 * i)
    assert len(recorded) == 1
    others = [{"track": None}, {"track": math.inf}, {"damping": 0.0}, {"gravity": 0.0}]
    for options in others:
        make("PivotedBar-v0", **options)
        make("PivotedBar-v0", mass=0.3, **options)
    assert len(recorded) == 1 + len(others)
    gym.make_vec("PivotedBar-v0", num_envs=2, mass=[0.1, 0.2])
    gym.make_vec("PivotedBar-v0", num_envs=2, mass=[0.3, 0.2])
    assert len(recorded) == 2 + len(others)
    for options in ({}, {"target": 0.1}, {"control": "tilt"}):
        make(incline.Tilt.id, **options)
        make(incline.Tilt.id, **options)
    assert len(recorded) == 5 + len(others)


class Own(Brake):
    """A task with an attribute that is set before it is made."""

    id = ""

    def __init__(self, gentle=Brake.gentle, **keywords):
        self.gentle = gentle
        super().__init__(**keywords)


def test_attributes_set_by_hand_are_not_taken_from_elsewhere(monkeypatch):
    # A formula may name an attribute of the task; a program that another task has recorded does not know it.
    def crossing(task):
        return Model(task)([[-0.001, 2.0]], [-1.0])[1][0]

    usual, lenient = crossing(Own()), crossing(Own(1.5))
    assert lenient == pytest.approx(usual + 5.0, abs=1e-9)
    assert crossing(Own()) == crossing(make(incline.Brake.id).task) == usual
    monkeypatch.setattr(Brake, "gentle", 1.5)
    assert crossing(make(incline.Brake.id).task) == lenient
    monkeypatch.undo()
    assert crossing(make(incline.Brake.id).task) == usual


@pytest.mark.parametrize("name", ["damping", "dt", "scene", "task", "action_noise"])
def test_what_is_decided_when_an_environment_is_made_cannot_be_set(name):
    for env in (make(incline.Brake.id), gym.make_vec(incline.Brake.id, num_envs=2)):
        with pytest.raises(
            AttributeError, match=rf"^{name} cannot be set .* make another one with other keyw"
        ):
            setattr(env, name, 1.5)
        env.note = "one's own"
        assert copy.deepcopy(env).note == "one's own"
        with pytest.raises(AttributeError, match=r"^state cannot be assigned; call reset\(options=\{'state'"):
            env.state = [0.0, 0.0]


@pytest.mark.parametrize("name", ["gentle", "dt", "interval", "scene", "anything"])
def test_a_task_cannot_be_changed(name):
    """Its formulas are recorded once, so a change would have no effect."""
    task = make(incline.Brake.id).task
    with pytest.raises(AttributeError, match=rf"Brake.{name} cannot be set .* give a keyword"):
        setattr(task, name, 1.5)
