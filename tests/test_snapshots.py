"""Snapshots: environments that are restored, here or in another process, continue with the same bits."""

from __future__ import annotations

import dataclasses
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from batches import ALL, ID
from covering import covering, slow
from gymnasium.error import ResetNeeded

from lag_envs.envs import snapshots
from lag_envs.scenes import StepRefused
from lag_envs.tasks.pivoted_bar import SwingUpFree

#: The cases share a program with the tests of imperfections.
CASES = [
    pytest.param(ID, {"duration": 0.5}, id="perfect"),
    pytest.param(ID, {"duration": 0.5, **ALL}, id="all"),
]


def go_on(env: gym.Env, steps: int) -> list:
    """Return everything observable in this many steps, resets included."""
    rng, seen = np.random.default_rng(0), []
    for _ in range(steps):
        action = (
            rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            if np.issubdtype(env.action_space.dtype, np.floating)
            else rng.integers(0, 2, env.action_space.shape)
        )
        try:
            results = env.step(action)
        except ResetNeeded:
            results = env.reset()
        own = env.unwrapped
        seen.append([*(np.array(x).tolist() for x in results[:4]), np.array(own.state).tolist(), _drawn(own)])
        if not hasattr(own, "num_envs") and len(results) > 2 and results[3]:
            seen.append(env.reset()[0].tolist())
    return seen


def _drawn(env):
    return {name: np.array(values).tolist() for name, values in env.parameters.items()}


@pytest.mark.parametrize(("env_id", "keywords"), CASES)
def test_a_single_environment_goes_on_with_the_same_bits(env_id, keywords):
    env, other = (gym.make(env_id, **keywords) for _ in range(2))
    env.reset(seed=3)
    go_on(env, 13)
    snapshot = env.unwrapped.get_state()
    first = go_on(env, 40)
    assert go_on(env, 40) != first
    env.unwrapped.set_state(snapshot)
    assert go_on(env, 40) == first
    other.reset(seed=99)  # required by Gymnasium's checker
    other.unwrapped.set_state(pickle.loads(pickle.dumps(snapshot)))
    assert go_on(other, 40) == first


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    ("env_id", "keywords"), [CASES[0], pytest.param(*CASES[1].values, id="all", marks=pytest.mark.slow)]
)
def test_a_batch_goes_on_with_the_same_bits(env_id, keywords, mode):
    envs, other = (gym.make_vec(env_id, num_envs=3, autoreset_mode=mode, **keywords) for _ in range(2))
    envs.reset(seed=3)
    go_on(envs, 24)
    for _ in range(4):  # before, at and after the end of the episodes, which is after step 25
        snapshot = envs.unwrapped.get_state()
        first = go_on(envs, 30)
        for again in (envs, other):
            again.unwrapped.set_state(snapshot)
            assert go_on(again, 30) == first
        envs.unwrapped.set_state(snapshot)
        go_on(envs, 1)


@pytest.mark.parametrize("keywords", [{}, slow(ALL)], ids=["perfect", "all"])
def test_a_mask_sets_some_and_leaves_the_others(keywords):
    envs = gym.make_vec(ID, num_envs=3, **keywords)
    own, zero = envs.unwrapped, np.zeros((3, 1), np.float32)
    with pytest.raises(ResetNeeded, match="before get_state"):
        own.get_state()
    envs.reset(seed=1)
    before, snapshot = own.state, own.get_state()
    for _ in range(5):
        envs.step(zero)
    after = own.state
    own.set_state(snapshot, mask=np.array([True, False, True]))
    assert np.array_equal(own.state, np.where([[True], [False], [True]], before, after))
    with pytest.raises(ValueError, match="mask must have shape"):
        own.set_state(snapshot, mask=np.array([True, False]))
    with pytest.raises(TypeError, match="mask must be a NumPy array of bool"):
        own.set_state(snapshot, mask=[1, 0, 1])


def test_a_snapshot_is_a_copy():
    env = gym.make(ID)
    env.reset(seed=1)
    snapshot = env.unwrapped.get_state()
    before = {name: values.copy() for name, values in snapshot.rows.items()}
    go_on(env, 5)
    assert all(np.array_equal(before[name], values) for name, values in snapshot.rows.items())


@pytest.mark.slow
def test_another_process_goes_on_with_the_same_bits(tmp_path):
    env = gym.make(ID, duration=0.5, **ALL)
    env.reset(seed=3)
    go_on(env, 13)
    (tmp_path / "snapshot").write_bytes(pickle.dumps(env.unwrapped.get_state()))
    code = (
        "import pickle, sys, gymnasium as gym, lag_envs, test_snapshots as t\n"
        "env = gym.make(t.ID, duration=0.5, **t.ALL, disable_env_checker=True)\n"
        f"env.unwrapped.set_state(pickle.load(open({str(tmp_path / 'snapshot')!r}, 'rb')))\n"
        "sys.stdout.buffer.write(pickle.dumps(t.go_on(env, 40)))"
    )
    here = Path(__file__).parent
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, cwd=here)
    assert pickle.loads(done.stdout) == go_on(env, 40)


@pytest.mark.slow
@pytest.mark.parametrize("keywords", [{}, {"randomize": {"gravity": (0.5, 1.0)}}], ids=str)
@pytest.mark.parametrize("env_id", covering())
def test_every_environment(env_id, keywords):
    for make in (gym.make, lambda id, **given: gym.make_vec(id, num_envs=3, **given)):
        env = make(env_id, **keywords)
        env.reset(seed=2)
        try:
            go_on(env, 50)
            snapshot = env.unwrapped.get_state()
            first = go_on(env, 100)
        except StepRefused:
            continue
        env.unwrapped.set_state(snapshot)
        assert go_on(env, 100) == first


# --- snapshots of another environment -----------------------------------------------------------------------

OTHERS = [
    (ID, {"damping": 0.5}, "damping is 0.5 in the snapshot, and 0.001 here"),
    (ID, {"dt": 0.01}, "dt is 0.01 in the snapshot, and 0.02 here"),
    (ID, {"duration": 3.0}, "duration is 3.0 in the snapshot, and 10.0 here"),
    (ID, ALL, r"observation_noise is \(0.01, 0.0, .*\) in the snapshot, and \(\) here"),
    (ID, {"lag": 0.05}, r"lag is \(0.05,\) in the snapshot, and \(\) here"),
    (SwingUpFree.id, {}, "task is .*SwingUpFree' in the snapshot, and .*SwingUp' here"),
    ("CylinderInCylinderPump-v0", {}, "task is .*Pump' in the snapshot"),
]


@pytest.mark.parametrize(("env_id", "keywords", "message"), OTHERS, ids=str)
def test_a_snapshot_of_another_environment_is_refused(env_id, keywords, message):
    other, here = gym.make(env_id, **keywords), gym.make(ID)
    other.reset(seed=1)
    here.reset(seed=1)
    before = here.unwrapped.state
    with pytest.raises(ValueError, match=f"snapshot of another environment: {message}"):
        here.unwrapped.set_state(other.unwrapped.get_state())
    assert np.array_equal(here.unwrapped.state, before)


def test_other_ranges_are_refused():
    here, other = (gym.make(ID, **ALL | {"randomize": {"mass": (0.5, high)}}) for high in (2.0, 3.0))
    snapshot = snapshots.Snapshot(other.unwrapped._about, {}, *[np.zeros(1)] * 3)
    with pytest.raises(ValueError, match=r"randomize is .* 3.0, .* in the snapshot, and .* 2.0, .* here"):
        here.unwrapped.set_state(snapshot)


@pytest.mark.parametrize("damage", ["rows", "ids", "steps", "totals"])
@pytest.mark.parametrize("many", [False, True])
def test_a_damaged_snapshot_changes_nothing(many, damage):
    env = (gym.make_vec(ID, num_envs=2) if many else gym.make(ID)).unwrapped
    env.reset(seed=1)
    good = env.get_state()
    rows = dict(good.rows)
    if damage == "rows":
        rows[list(rows)[-1]] = 0.5
    changes = {"rows": rows} if damage == "rows" else {damage: getattr(good, damage)[:0]}
    env.step(env.action_space.sample())
    before = env.get_state()
    with pytest.raises(ValueError, match=r"snapshot is damaged: .* must be an array of numbers of shape"):
        env.set_state(dataclasses.replace(good, **changes))
    for name, values in env.get_state().rows.items():
        assert np.array_equal(values, before.rows[name])


def test_other_batches_are_refused():
    here = gym.make_vec(ID, num_envs=3, damping=[0.1, 0.2, 0.3])
    for keywords, message in (
        ({"num_envs": 4}, "num_envs is 4 in the snapshot, and 3 here"),
        ({"num_envs": 3, "autoreset_mode": "SameStep"}, "autoreset_mode is 'SameStep' in the snapshot"),
        ({"num_envs": 3, "max_episode_steps": 7}, "max_episode_steps is 7.0 in the snapshot, and 500.0 here"),
        ({"num_envs": 3}, r"damping is 0.001 in the snapshot, and \(0.1, 0.2, 0.3\) here"),
    ):
        other = gym.make_vec(ID, **keywords)
        other.reset(seed=1)
        with pytest.raises(ValueError, match=message):
            here.unwrapped.set_state(other.unwrapped.get_state())
    single = gym.make(ID)
    single.reset(seed=1)
    with pytest.raises(ValueError, match="num_envs is None in the snapshot, and 3 here"):
        here.unwrapped.set_state(single.unwrapped.get_state())
    with pytest.raises(TypeError, match="set_state takes what get_state returned, got 3"):
        here.unwrapped.set_state(3)
