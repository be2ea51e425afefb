"""The native vector environment against Gymnasium's own of single environments: the same bits."""

from __future__ import annotations

import copy
import math
import pickle
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from batches import assert_alike, assert_same, pair
from covering import IMPERFECT, PERFECT, covering, engine, features, quick, slow, way
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from rollouts import ANY_BAR, SINGLE, actions, make

from lag_envs.scenes.checks import StepRefused
from lag_envs.tasks import TASKS, incline, pivoted_bar

each_id = pytest.mark.parametrize("env_id", covering())
each_engine = pytest.mark.parametrize("env_id", covering(of=engine))
each_single = pytest.mark.parametrize("env_id", covering(SINGLE))
MODES = ["NextStep", "SameStep", "Disabled"]
each_mode = pytest.mark.parametrize("mode", MODES)


def in_every_mode(of=features):
    """Quick are a covering set with the first mode, and one environment with every mode."""
    chosen = quick(of=of)
    fast = {(chosen[0], mode) for mode in MODES} | {(i, MODES[0]) for i in chosen}
    pairs = [(i, mode) for mode in MODES for i in TASKS]
    values = [pair if pair in fast else slow(*pair) for pair in pairs]
    return pytest.mark.parametrize(("env_id", "mode"), values)


def lasting(env_id, steps):
    """Return the keyword that limits episodes to this many of the task's own steps."""
    return {"duration": min(steps, TASKS[env_id].steps) * TASKS[env_id].interval}


def lanes(env_id):
    """Return the size of the record's batch with mixed parameters."""
    (number,) = {len(values) for values in TASKS[env_id].examples.batch.values()}
    return number


def mixed_pair(env_id, mode="NextStep", **options):
    """Return the native environment with different parameters, and Gymnasium's of as many single ones."""

    def one(i):
        own = {name: values[i] for name, values in TASKS[env_id].examples.batch.items()}
        return lambda: gym.make(env_id, disable_env_checker=True, **own, **options)

    sync = SyncVectorEnv(
        [one(i) for i in range(lanes(env_id))],
        autoreset_mode=AutoresetMode(mode),
        observation_mode="different",
    )
    return gym.make_vec(
        env_id, num_envs=lanes(env_id), autoreset_mode=mode, **TASKS[env_id].examples.batch, **options
    ), sync


# --- the same bits ---


@each_id
@pytest.mark.parametrize(("n", "steps"), [slow(1, 3000), (7, 2000), slow(64, 600)])
def test_same_bits(env_id, n, steps):
    native, sync = pair(env_id, n, **lasting(env_id, 500))
    assert_same(native.reset(seed=17), sync.reset(seed=17))
    assert assert_alike(native, sync, steps) > n // 2


@in_every_mode()
@pytest.mark.parametrize(("n", "steps"), [(7, 700), slow(65, 150), (130, 80)])
def test_same_bits_in_every_mode(env_id, mode, n, steps):
    native, sync = pair(env_id, n, mode, **lasting(env_id, 50))
    assert_same(native.reset(seed=3), sync.reset(seed=3))
    assert assert_alike(native, sync, steps) > n // 2
    # Episodes go on if no new seed is given.
    assert_same(native.reset(), sync.reset())
    assert_alike(native, sync, 20, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", quick())
@each_mode
@pytest.mark.parametrize(("n", "steps"), [(1, 20_000), (7, 10_000), (64, 2_000), (130, 1_000)])
def test_same_bits_for_long(env_id, mode, n, steps):
    native, sync = pair(env_id, n, mode)
    assert_same(native.reset(seed=17), sync.reset(seed=17))
    assert assert_alike(native, sync, steps, seed=2) >= n


@in_every_mode(of=way)
def test_same_bits_where_parameters_differ(env_id, mode):
    native, sync = mixed_pair(env_id, mode, **lasting(env_id, 250))
    assert_same(native.reset(seed=5), sync.reset(seed=5))
    assert assert_alike(native, sync, 600) > 0
    for i, env in enumerate(sync.envs):
        assert env.unwrapped.state.tobytes() == native.state[i].tobytes()
        assert np.array_equal(native.control[i], env.unwrapped.control)
        assert native.target is None or np.array_equal(native.target[i], env.unwrapped.target)
        space = native.single_observation_space
        assert (space.high >= env.observation_space.high).all() and (
            space.low <= env.observation_space.low
        ).all()


@pytest.mark.parametrize("env_id", [*covering(PERFECT, engine), *map(slow, IMPERFECT)])
def test_same_bits_with_a_coarse_step(env_id):
    dt = min(10.0 * TASKS[env_id].interval, 0.2)  # more than one substep here and there
    native, sync = pair(env_id, 7, dt=dt, **lasting(env_id, 200))
    assert_same(native.reset(seed=5), sync.reset(seed=5))
    assert_alike(native, sync, 300)


@in_every_mode(of=engine)
def test_same_diagnostics(env_id, mode):
    native, sync = pair(env_id, 5, mode, diagnostics=True, **lasting(env_id, 25))
    assert_same(native.reset(seed=3), sync.reset(seed=3))
    assert assert_alike(native, sync, 40) > 0


@in_every_mode()
def test_max_episode_steps(env_id, mode):
    native, sync = pair(env_id, 3, mode, max_episode_steps=9)
    assert_same(native.reset(seed=3), sync.reset(seed=3))
    assert assert_alike(native, sync, 60) >= 12


@each_single
def test_states_and_targets_by_hand(env_id):
    single = make(env_id)
    starts = []
    for seed in range(6):
        single.reset(seed=seed)
        starts.append(single.state)
    options = {"state": np.array(starts)}
    if single.target is not None:
        options["target"] = np.linspace(-0.2, 0.2, 6)
    native = gym.make_vec(env_id, num_envs=6)
    observations, _ = native.reset(seed=0, options=options)
    assert native.state.tobytes() == options["state"].tobytes()
    given = actions(1, native.action_space)[0]
    stepped = native.step(given)[0]
    for i in range(6):
        own = {name: values[i] for name, values in options.items()}
        assert single.reset(seed=i, options=own)[0].tobytes() == observations[i].tobytes()
        assert single.step(given[i])[0].tobytes() == stepped[i].tobytes()


# --- autoreset ---


@pytest.mark.parametrize(
    "mode", [*MODES, *AutoresetMode, "NEXT_STEP", "next_step", "same_step", "DISABLED"], ids=str
)
def test_mode_as_string_or_enum(mode):
    envs = gym.make_vec("PivotedBar-v0", num_envs=2, autoreset_mode=mode)
    wanted = (
        AutoresetMode[mode.upper()] if isinstance(mode, str) and mode not in MODES else AutoresetMode(mode)
    )
    assert envs.metadata["autoreset_mode"] is wanted
    assert "autoreset_mode" not in gym.make_vec("PivotedBar-v0", num_envs=2).__class__.metadata


@pytest.mark.parametrize("mode", ["never", None, 1, ""])
def test_unknown_mode(mode):
    with pytest.raises(ValueError, match="autoreset_mode must be one of"):
        gym.make_vec("PivotedBar-v0", num_envs=2, autoreset_mode=mode)


def test_metadata_belongs_to_the_instance():
    a, b = (
        gym.make_vec("PivotedBar-v0", num_envs=2, autoreset_mode=mode) for mode in ("NextStep", "Disabled")
    )
    assert a.metadata is not b.metadata
    assert a.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert a.metadata["render_fps"] == 50


def test_disabled_asks_for_a_reset():
    envs = gym.make_vec("PivotedBar-v0", num_envs=3, autoreset_mode="Disabled", duration=0.1)
    envs.reset(seed=1)
    for _ in range(3):
        envs.step(np.zeros((3, 1), np.float32))
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    for _ in range(2):
        *_, truncated, _ = envs.step(np.zeros((3, 1), np.float32))
    assert truncated.tolist() == [True, False, True]
    state = envs.state
    with pytest.raises(ResetNeeded, match=r"environments \[0, 2\] are over"):
        envs.step(np.zeros((3, 1), np.float32))
    assert (envs.state == state).all()
    envs.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(ResetNeeded, match=r"environments \[2\] are over"):
        envs.step(np.zeros((3, 1), np.float32))
    envs.reset(options={"reset_mask": truncated})
    assert truncated.tolist() == [True, False, True]
    envs.step(np.zeros((3, 1), np.float32))


def test_the_mask_is_read_only():
    envs = gym.make_vec("PivotedBar-v0", num_envs=3)
    envs.reset(seed=1)
    options = {"reset_mask": np.array([True, False, False])}
    kept = envs.state
    envs.reset(options=options)
    assert options["reset_mask"].tolist() == [True, False, False] and list(options) == ["reset_mask"]
    assert ((envs.state != kept).any(axis=1) == options["reset_mask"]).all()


def test_masked_rows_are_not_looked_at():
    envs = gym.make_vec(incline.Tilt.id, num_envs=3)
    first, _ = envs.reset(seed=1)
    kept = envs.state
    mask = np.array([False, True, False])
    state, target = np.full((3, 3), np.nan), np.full(3, 1e9)
    state[1], target[1] = [0.1, 0.2, 0.05], -0.25
    observations, _ = envs.reset(options={"state": state, "target": target, "reset_mask": mask})
    assert observations[1].tolist() == np.array([0.1, 0.2, 0.05, -0.25], dtype=np.float32).tolist()
    assert (observations[~mask] == first[~mask]).all() and (envs.state[~mask] == kept[~mask]).all()
    # A target from the options holds for one episode.
    envs.reset(options={"reset_mask": mask})
    assert envs.target[1] != -0.25


# --- seeds ---


@each_id
def test_seeds(env_id):
    native, sync = pair(env_id, 5)
    for seed in (9, [3, 1, 4, 1, 5], [7, None, 2**40, None, 0], None, 2**63, 0):
        assert_same(native.reset(seed=seed), sync.reset(seed=seed))
        assert_alike(native, sync, 5)
    a, b = (native.reset(seed=[8, 8, 9, 10, 8])[0] for _ in range(2))
    assert (a == b).all() and (a[0] == a[1]).all() and (a[0] == a[4]).all() and (a[0] != a[2]).any()
    assert (native.reset(seed=np.array([8, 8, 9, 10, 8]))[0] == a).all()


@each_id
def test_unseeded_environments_differ(env_id):
    runs = [
        gym.make_vec(env_id, num_envs=4).reset(seed=seed)[0]
        for seed in (None, None, [1, None, None, 2], [1, None, None, 2])
    ]
    assert (
        len({row.tobytes() for row in np.concatenate([runs[0], runs[1], runs[2][1:3], runs[3][1:3]])}) == 12
    )
    assert (runs[2][[0, 3]] == runs[3][[0, 3]]).all()


@pytest.mark.parametrize("seed", [-1, [1, 2], [1, 2, -3], [1, 2, 3, 4]])
def test_bad_seeds(seed):
    envs, twin = running(3), running(3)
    with pytest.raises((ValueError, gym.error.Error)):
        envs.reset(seed=seed)
    assert (envs.state == twin.state).all()
    assert_same(envs.reset(), twin.reset())


# --- what is returned ---


@in_every_mode()
def test_nothing_is_shared(env_id, mode):
    envs = gym.make_vec(env_id, num_envs=3, autoreset_mode=mode, diagnostics=True, **lasting(env_id, 8))
    kept = []
    for _ in range(2):
        arrays = [envs.reset(seed=1)[0]]
        for action in actions(20, envs.action_space):
            *out, info = envs.step(action)
            over = out[2] | out[3]
            arrays += [
                *out,
                envs.state,
                envs.control,
                *(v for v in info.values() if isinstance(v, np.ndarray)),
            ]
            arrays += [row for row in info.get("final_obs", ()) if row is not None]
            if mode == "Disabled" and over.any():
                arrays.append(envs.reset(options={"reset_mask": over})[0])
        kept.append((arrays, [a.copy() for a in arrays]))
    for arrays, copies in kept:
        for a, b in zip(arrays, copies, strict=True):
            assert_same(a, b)
    whole = [a for a in kept[0][0] if a.dtype != object]
    spans = sorted((a.__array_interface__["data"][0], a.nbytes) for a in whole)
    assert all(start + size <= following for (start, size), (following, _) in pairwise(spans))


@each_id
def test_spaces_and_types(env_id):
    native, sync = pair(env_id, 4)
    for name in ("single_action_space", "single_observation_space", "action_space", "observation_space"):
        assert getattr(native, name) == getattr(sync, name)
    observations, infos = native.reset(seed=1)
    assert observations in native.observation_space and infos == {}
    observations, rewards, terminations, truncations, infos = native.step(native.action_space.sample())
    assert observations in native.observation_space and infos == {}
    assert rewards.dtype == np.float64 and terminations.dtype == truncations.dtype == np.bool_
    assert native.state.shape == (4, len(native.unwrapped.scene.state_names))
    assert native.num_envs == 4 and native.unwrapped is native
    native.close()


@each_id
def test_observations_stay_in_the_space(env_id):
    envs = gym.make_vec(env_id, num_envs=100, autoreset_mode="SameStep")
    observations, _ = envs.reset(seed=1)
    for action in actions(400, envs.action_space, seed=5):
        assert observations in envs.observation_space
        observations, *_, infos = envs.step(action)
        for last in infos.get("final_obs", ()):
            assert last is None or last in envs.single_observation_space


# --- copies and specs ---


@each_engine
@pytest.mark.parametrize(
    "clone",
    [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))],
    ids=["copy", "deepcopy", "pickle"],
)
def test_copies_go_on_alike(env_id, clone):
    envs = gym.make_vec(env_id, num_envs=lanes(env_id), duration=1.0, **TASKS[env_id].examples.batch)
    envs.reset(seed=2)
    for action in actions(37, envs.action_space):
        envs.step(action)
    twin = clone(envs)
    before = twin.state
    for action in actions(60, envs.action_space, seed=1):
        mine = envs.step(action)
        assert (twin.state == before).all()  # nothing is shared
        assert_same(mine, twin.step(action))
        before = twin.state
    assert twin.metadata == envs.metadata and twin.spec == envs.spec


@each_engine
def test_spec_survives_json(env_id):
    envs = gym.make_vec(
        env_id, lanes(env_id), autoreset_mode="SameStep", max_episode_steps=30, **TASKS[env_id].examples.batch
    )
    spec = EnvSpec.from_json(envs.spec.to_json())
    assert spec == envs.spec
    twin = gym.make_vec(spec)
    assert twin.num_envs == lanes(env_id) and twin.metadata == envs.metadata
    assert_same(envs.reset(seed=1), twin.reset(seed=1))
    for action in actions(40, envs.action_space):
        assert_same(envs.step(action), twin.step(action))


def test_spec_of_arrays_and_enums_survives_json():
    envs = gym.make_vec(
        "PivotedBar-v0", num_envs=3, mass=np.linspace(0.1, 0.3, 3), autoreset_mode=AutoresetMode.SAME_STEP
    )
    twin = gym.make_vec(EnvSpec.from_json(envs.spec.to_json()))
    assert twin.spec == envs.spec and twin.metadata == envs.metadata
    assert_same(envs.reset(seed=1), twin.reset(seed=1))
    push = np.ones((3, 1), np.float32)
    assert_same(envs.step(push), twin.step(push))


@pytest.mark.parametrize("mode", MODES)
def test_autoreset_mode_stands_where_gymnasiums_own_have_it(mode):
    native, sync = pair("PivotedBar-v0", 2, mode)
    assert native.autoreset_mode is sync.autoreset_mode is native.metadata["autoreset_mode"]


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_record_episode_statistics(mode):
    envs = RecordEpisodeStatistics(
        gym.make_vec(incline.Brake.id, num_envs=4, autoreset_mode=mode, duration=1.0)
    )
    envs.reset(seed=1)
    returns, recorded = np.zeros(4), 0
    for action in actions(300, 4, 1):
        _, rewards, terminations, truncations, infos = envs.step(action)
        returns += rewards
        over = terminations | truncations
        if over.any():
            recorded += over.sum()
            assert (infos["_episode"] == over).all()
            np.testing.assert_allclose(infos["episode"]["r"][over], returns[over], rtol=1e-6)
            returns[over] = 0.0
            if mode == "Disabled":
                envs.reset(options={"reset_mask": over})
    assert recorded > 10


# --- refusals ---


def running(n, env_id="PivotedBar-v0", **options):
    envs = gym.make_vec(env_id, num_envs=n, **options)
    envs.reset(seed=1)
    envs.step(np.full((n, 1), 0.25))
    return envs


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 63, 64, 99])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_that_are_not_finite_step_nothing(value, place, dtype):
    envs, twin = running(100), running(100)
    action = np.zeros((100, 1), dtype=dtype)
    action[place] = value
    with pytest.raises(ValueError, match=rf"must be finite, got .* for environment {place}$"):
        envs.step(action)
    assert (envs.state == twin.state).all() and (envs.control == twin.control).all()
    for action in actions(20, 100, 1):
        assert_same(envs.step(action), twin.step(action))


@pytest.mark.parametrize(
    "action",
    [
        np.zeros(3),
        np.zeros((3, 2)),
        np.zeros((2, 1)),
        np.zeros((1, 3)),
        0.5,
        None,
        "up",
        np.zeros((3, 1), dtype=complex),
        np.array([["a"], ["b"], ["c"]]),
        [[0.1], [0.2], [None]],
        [[0.1], [0.2], [0.3, 0.4]],
    ],
)
def test_bad_actions(action):
    envs, twin = running(3), running(3)
    with pytest.raises(ValueError, match=r"actions|inhomogeneous"):
        envs.step(action)
    assert_same(envs.step(np.zeros((3, 1), np.float32)), twin.step(np.zeros((3, 1))))


def test_other_actions_mean_their_value():
    envs, twin = running(3), running(3)
    fine = np.array([[0.3], [-1.0], [1.0]])
    for action in (
        [[0.3], [-5], [1e300]],
        np.array([[0.3], [-1.0], [1.0]], dtype=">f8"),
        np.array([[0.3], [-1.0], [1.0]], dtype=np.longdouble),
        np.asfortranarray(fine),
        np.array([[0.3, 9.0], [-1.0, 9.0], [1.0, 9.0]])[:, :1],
    ):
        assert_same(envs.step(action), twin.step(fine))
    assert_same(envs.step(np.array([[1], [0], [1]], dtype=bool)), twin.step(np.array([[1.0], [0.0], [1.0]])))


def test_step_before_reset():
    envs = gym.make_vec("PivotedBar-v0", num_envs=2)
    with pytest.raises(ResetNeeded, match="no episode has begun"):
        envs.step(np.zeros((2, 1)))
    with pytest.raises(ResetNeeded, match="first reset must reset every environment"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset(options={"reset_mask": np.array([True, True])})
    envs.step(np.zeros((2, 1)))


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"reset_mask": [True, False, False]}, TypeError, "reset_mask"),
        ({"reset_mask": np.array([1, 0, 0])}, TypeError, "reset_mask"),
        ({"reset_mask": np.array([True, False])}, ValueError, "reset_mask"),
        ({"reset_mask": np.zeros(3, dtype=bool)}, ValueError, "at least one"),
        ({"state": np.zeros((2, 4))}, ValueError, "state"),
        ({"state": [0.0, 0.0, 0.0, 0.0]}, ValueError, "state"),
        ({"state": [[0, 0, 0, 0], [0, 0, 0, 0], [0.6, 0, 0, 0]]}, ValueError, "track"),
        ({"state": [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, math.nan, 0]]}, ValueError, "finite"),
        ({"state": "up"}, ValueError, "state"),
        ({"state": {"s": 0.1}}, ValueError, r"rows of \(s, s_dot, theta, theta_dot\), without names"),
        ({"target": np.zeros(3)}, ValueError, "no target"),
        ({"colour": 1}, ValueError, "unknown reset option 'colour'"),
    ],
)
def test_bad_options_reset_nothing(options, error, match):
    envs, twin = running(3), running(3)
    with pytest.raises(error, match=match):
        envs.reset(seed=5, options=options)
    assert (envs.state == twin.state).all()
    for action in actions(20, envs.action_space):
        assert_same(envs.step(action), twin.step(action))


@pytest.mark.parametrize(
    ("env_id", "options", "match"),
    [
        ("PivotedBar-v0", {"mass": [0.1, 0.2]}, "mass must be one value or 3, one per environment, got 2"),
        ("PivotedBar-v0", {"mass": np.ones((3, 1))}, "mass"),
        ("PivotedBar-v0", {"mass": [0.1, 0.2, -0.3]}, "mass must be above 0 kg, got -0.3 kg"),
        ("PivotedBar-v0", {"dt": [0.01, 0.02, 0.03]}, "dt must be the same"),
        ("PivotedBar-v0", {"duration": [1.0, 2.0, 3.0]}, "duration must be the same"),
        ("PivotedBar-v0", {"track": [None, 0.5, 0.5]}, "track"),
        ("PivotedBar-v0", {"track": [0.5, math.inf, 0.5]}, "track"),
        (incline.Tilt.id, {"control": ["tilt", "tilt", "tilt_rate"]}, "control must be the same"),
        (incline.Tilt.id, {"target": [0.1, 0.2, 0.7]}, "target"),
        (incline.Tilt.id, {"target": [0.1, 0.2, None]}, "target"),
    ],
)
def test_bad_parameters(env_id, options, match):
    with pytest.raises(ValueError, match=match):
        gym.make_vec(env_id, num_envs=3, **options)


def test_unknown_keyword():
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        gym.make_vec("PivotedBar-v0", num_envs=2, colour="red")


@each_mode
def test_a_refused_environment_does_not_stop_the_others(mode):
    extreme = {
        "com_distance": [0.3, 1e-9, 0.4],
        "inertia": [None, 1e-30, None],
        "gravity": 1e3,
        "dt": 1.0,
        "damping": 0.0,
    }
    mild = extreme | {"com_distance": [0.3, 0.35, 0.4], "inertia": [None, 0.01, None]}
    envs = gym.make_vec(pivoted_bar.SwingUpFree.id, num_envs=3, autoreset_mode=mode, **extreme, **ANY_BAR)
    twin = gym.make_vec(pivoted_bar.SwingUpFree.id, num_envs=3, autoreset_mode=mode, **mild)
    envs.reset(seed=[1, 2, 3])
    twin.reset(seed=[1, 2, 3])
    stuck = envs.state[1]
    for action in actions(5, 3, 1):
        with pytest.raises(StepRefused, match="the step of environment 1 was refused"):
            envs.step(action)
        twin.step(action)
        assert (envs.state[[0, 2]] == twin.state[[0, 2]]).all()
        assert (envs.state[1] == stuck).all()
    # Once its state allows it, it goes on.
    envs.reset(options={"state": np.zeros((3, 2)), "reset_mask": np.array([False, True, False])})
    with pytest.raises(StepRefused):
        envs.step(np.ones((3, 1)))


# --- findings of a review ---


@each_mode
def test_a_fixed_target_returns_after_one_given_by_hand(mode):
    native, sync = pair(incline.Tilt.id, 3, mode, target=0.2, duration=0.3)
    given = {"target": np.array([0.1, 0.1, 0.1])}
    native.reset(seed=1, options=given)
    assert native.target.tolist() == [0.1] * 3
    sync.reset(seed=1, options={"target": 0.1})
    assert_alike(native, sync, 20)
    assert native.target.tolist() == [0.2] * 3


def test_a_restarting_environment_ignores_its_action():
    envs = gym.make_vec(incline.Tilt.id, num_envs=2, duration=0.1)
    envs.reset(seed=1)
    for _ in range(2):
        _, _, _, truncations, _ = envs.step(np.zeros((2, 1), np.float32))
    assert truncations.all()
    observations, *_ = envs.step(np.array([[np.nan], [0.0]], np.float32))
    assert np.isfinite(observations).all()
    with pytest.raises(ValueError, match="environment 0"):
        envs.step(np.array([[np.nan], [0.0]], np.float32))


def test_a_refusal_carries_what_the_others_did():
    lengths = {"com_distance": [0.3, 1e-30], "damping": 0.0}
    envs = gym.make_vec(pivoted_bar.SwingUpFree.id, num_envs=2, **lengths, **ANY_BAR)
    envs.reset(seed=1)
    with pytest.raises(StepRefused) as error:
        envs.step(np.zeros((2, 1), np.float32))
    observations, rewards, terminated, truncated, infos = error.value.results
    assert observations.shape == (2, 3) and rewards[0] > 0.0 and rewards[1] == 0.0
    assert infos["refused"].tolist() == [False, True] and not (terminated | truncated).any()
    # All are named, and marked; those that are reset go on.
    lengths["com_distance"] = [1e-30, 0.3, 1e-30, 1e-30]
    envs = gym.make_vec(pivoted_bar.SwingUpFree.id, num_envs=4, **lengths, **ANY_BAR)
    envs.reset(seed=1)
    with pytest.raises(
        StepRefused, match=r"environment 0 .like those of 2, 3; results.*was refused"
    ) as error:
        envs.step(np.zeros((4, 1), np.float32))
    assert error.value.results[-1]["refused"].tolist() == [True, False, True, True]


@pytest.mark.parametrize("diagnostics", [False, True])
def test_a_refusal_loses_no_episode_that_ends(diagnostics):
    given = {"gravity": [9.81, 1e12], "duration": 0.04, "diagnostics": diagnostics}
    envs = gym.make_vec("DoubleBar-v0", num_envs=2, autoreset_mode="SameStep", **given)
    twin = gym.make_vec("DoubleBar-v0", num_envs=1, autoreset_mode="SameStep", **given | {"gravity": 9.81})
    envs.reset(seed=5), twin.reset(seed=5)
    for end in (False, True, False, True):
        with pytest.raises(StepRefused, match="the step of environment 1 was refused") as error:
            envs.step(np.zeros((2, 1), np.float32))
        found, expected = error.value.results, twin.step(np.zeros((1, 1), np.float32))
        assert found[-1]["refused"].tolist() == [False, True] and found[3].tolist() == [end, False]
        for x, y in zip(found[:4], expected[:4], strict=True):
            assert np.array_equal(x[:1], y)
        assert ("final_obs" in found[-1]) == end
        if end:
            assert np.array_equal(found[-1]["final_obs"][0], expected[-1]["final_obs"][0])
            assert found[-1]["final_obs"][1] is None and found[-1]["_final_obs"].tolist() == [True, False]


def test_it_tells_limits_and_which_episodes_are_over():
    envs = gym.make_vec("PivotedBar-v0", 3, max_episode_steps=2).unwrapped
    envs.reset(seed=1)
    assert envs.limits.tolist() == [2.0] * 3 and envs.ended is None and len(envs.tasks) == 3
    for _ in range(2):
        envs.step(envs.action_space.sample())
    assert envs.ended.tolist() == [True] * 3


def test_far_too_many_environments_are_told():
    with pytest.raises(MemoryError, match=r"num_envs=10{15}: the list of tasks alone takes 7.45e.06 GiB"):
        gym.make_vec("PivotedBar-v0", num_envs=10**15)
