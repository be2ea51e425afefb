"""Threads that step a batch together: the same bits as one thread, in any order and in any process."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import threading
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from covering import slow
from rollouts import ANY_BAR, actions

from lag_envs.envs import sharing
from lag_envs.scenes import StepRefused
from lag_envs.stepping.compiling import BLOCK, compile_function
from lag_envs.tasks import cart_pole, pivoted_bar

ID = "PivotedBar-v0"
#: Some whole blocks and a part of one.
MANY = 7 * BLOCK + 5


def made(threads, n=MANY, env_id=ID, **options):
    return gym.make_vec(env_id, num_envs=n, num_threads=threads, **options)


def digest(envs, steps, seed=3):
    """Return a digest of all results of this many steps; with a seed, after a reset."""
    found = hashlib.sha256()
    if seed is not None:
        found.update(envs.reset(seed=seed)[0].tobytes())
    for action in actions(steps, envs.action_space):
        for array in envs.step(action)[:4]:
            found.update(array.tobytes())
    found.update(envs.state.tobytes())
    return found.hexdigest()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"autoreset_mode": "SameStep"},
        slow({"observation_noise": 0.01, "action_delay": 0.013}),
        slow({"randomize": {"damping": (0.1, 10.0)}}),
        slow({"mass": np.linspace(0.1, 0.3, MANY)}),
        slow({"env_id": cart_pole.CartPoleExact.id}),
    ],
    ids=["plain", "same step", "imperfect", "drawn", "each its own", "series"],
)
def test_bits_do_not_depend_on_the_number_of_threads(options):
    alone = digest(made(1, duration=0.3, **options), 40)
    for threads in (2, 3, 5, 50):
        assert digest(made(threads, duration=0.3, **options), 40) == alone


def test_a_batch_can_change_hands():
    one, three = made(1), made(3)
    digest(one, 5)
    three.reset(seed=0)
    three.set_state(one.get_state())
    for envs in (three, pickle.loads(pickle.dumps(three))):
        assert envs.num_threads == 3
        assert digest(envs, 5, seed=None) == digest(pickle.loads(pickle.dumps(one)), 5, seed=None)


def test_a_bad_action_steps_nothing():
    envs, twin = made(3), made(1)
    envs.reset(seed=1), twin.reset(seed=1)
    action = np.zeros((MANY, 1), np.float32)
    action[5 * BLOCK + 1] = np.nan
    before = envs.state
    with pytest.raises(ValueError, match=f"for environment {5 * BLOCK + 1}$"):
        envs.step(action)
    assert (envs.state == before).all()
    assert digest(envs, 5, seed=None) == digest(twin, 5, seed=None)


@pytest.mark.slow
def test_refused_environments_do_not_stop_the_others():
    """The named environment is the first, as with one thread, and all are marked."""
    stuck = [BLOCK + 3, 4 * BLOCK, 5 * BLOCK + 1]
    lengths = np.full(MANY, 0.3)
    lengths[stuck] = 1e-30
    options = {"env_id": pivoted_bar.SwingUpFree.id, "com_distance": lengths, "damping": 0.0, **ANY_BAR}
    seen = []
    for threads in (1, 3):
        envs = made(threads, **options)
        envs.reset(seed=1)
        for action in actions(3, MANY, 1):
            with pytest.raises(
                StepRefused, match=f"environment {stuck[0]} .like those of {stuck[1]}, {stuck[2]};"
            ) as error:
                envs.step(action)
            assert np.flatnonzero(error.value.results[-1]["refused"]).tolist() == stuck
            seen.append([envs.state, *error.value.results[:4]])
    for alone, together in zip(seen[:3], seen[3:], strict=True):
        assert [a.tobytes() for a in alone] == [b.tobytes() for b in together]


def test_types_of_actions_may_change_from_step_to_step():
    envs, twin = made(3), made(1)
    envs.reset(seed=1), twin.reset(seed=1)
    for i, action in enumerate(actions(40, MANY, 1)):
        given = action.astype((np.float32, np.float64, np.int64)[i % 3])
        both = envs.step(given)[:4], twin.step(given)[:4]
        assert all((one == two).all() for one, two in zip(*both, strict=True))


TOY = """
def step_blocks(f, ids, par, action, obs, reward, ended, cut, count, at, blocks, turn, share, shares):
    over, refused, taken = np.uint64(0), np.uint64(0), np.uint64(0)
    block, tried = next_block(ids, at, turn, blocks, np.uint64(0), share, shares)
    while block < blocks:
        f[block] += 1.0
        reward[block] = par[0]
        for i in range(20_000):
            par[1] = math.sin(par[1])
        over += np.uint64(1)
        refused = max(refused, block + np.uint64(1))
        taken += np.uint64(1)
        block, tried = next_block(ids, at, turn, blocks, tried, share, shares)
    hand_in(ids, at, taken, over, refused)
"""


@pytest.fixture(scope="module")
def toy():
    """Yield `step_all` of environments that count how often their block is stepped."""
    blocks = compile_function("step_blocks", TOY, *sharing.claiming())
    f, ids, arrays, _ = room(1)
    yield partial(sharing.compile_step_all(), sharing.address_of(blocks, f, ids, np.zeros(2), *arrays))


def room(blocks):
    """Return arrays of the toy: places, keys with the threads' shared data, and those of a step."""
    count = blocks * BLOCK
    flags = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    arrays = np.zeros(count, np.float32), np.zeros((1, count), np.float32), np.zeros(count), *flags
    return np.zeros(blocks), np.zeros(3 * count + sharing.words(blocks), np.uint64), arrays, count


def test_each_block_is_stepped_once_and_helpers_help(toy):
    blocks, shares = 23, 3
    f, ids, arrays, count = room(blocks)
    pars = [np.array([float(i), 0.5]) for i in range(shares)]
    helped = set()
    for turn in range(1, 5000):
        rest = (*arrays, count, turn)
        calls = [(*toy.args, f, ids, pars[i], *rest, i, shares) for i in range(1, shares)]
        sharing.offer(calls, arrays[0].dtype)
        while (answer := toy(f, ids, pars[0], *rest, 0, shares))[1] < 0:
            pass
        assert answer == (blocks, blocks)
        assert (f == turn).all()
        helped |= set(arrays[2][:blocks])
        if turn > 50 and len(helped) > 1:
            return
    pytest.fail("no helper came")


def test_who_comes_late_finds_nothing_to_do(toy):
    f, ids, arrays, count = room(5)
    par = np.array([0.0, 0.5])
    for turn in (1, 2, 3):
        assert toy(f, ids, par, *arrays, count, turn, 0, 2) == (5, 5)
    for turn in (1, 2, 3, 4):
        toy(f, ids, par, *arrays, count, turn, 1, 2)
    assert (f == 3.0).all()


def test_no_two_helpers_have_one_share(toy):
    """They would share a step's working memory."""
    f, ids, arrays, count = room(5)
    par = np.array([0.0, 0.5])
    taken = 3 * count + sharing.WORDS + 5 + 1
    toy(f, ids, par, *arrays, count, 1, 0, 2)
    toy(f, ids, par, *arrays, count, 1, 1, 2)
    assert ids[taken] == 0  # given back
    ids[taken] = 1
    leader = threading.Thread(target=toy, args=(f, ids, par, *arrays, count, 2, 0, 2))
    other = np.array([7.0, 0.5])
    leader.start()
    while leader.is_alive():
        toy(f, ids, other, *arrays, count, 2, 1, 2)
    assert ids[taken] == 1 and not (arrays[2] == 7.0).any() and (f == 2.0).all()
    sharing.forget_helpers(ids, count)
    assert ids[taken] == 0 and ids[taken - 2] == 2


def test_a_step_waits_for_what_is_left_of_the_last_one():
    """As after a keyboard interrupt while a helper was working."""
    envs, twin = made(2), made(2)
    digest(envs, 3), digest(twin, 3)
    left = 3 * MANY + 1
    envs._ids[left] = 1
    timer = threading.Timer(0.1, lambda: envs._ids.__setitem__(left, 0))
    timer.start()
    found = digest(envs, 3, seed=None)
    assert not timer.is_alive() and found == digest(twin, 3, seed=None)


def test_two_batches_in_two_threads():
    alone = digest(made(1), 20)
    found = []
    threads = [threading.Thread(target=lambda: found.append(digest(made(2), 20))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [alone] * 2


# --- processes ---


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_after_a_fork_both_processes_go_on():
    envs = made(3)
    digest(envs, 3)
    assert any("lag_envs helper" in thread.name for thread in threading.enumerate())
    receiver, sender = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(sender, digest(envs, 5, seed=None).encode())
        os._exit(0)
    expected = digest(envs, 5, seed=None)
    os.close(sender)
    with os.fdopen(receiver) as file:
        assert file.read() == expected
    assert os.waitpid(child, 0)[1] == 0


def in_a_worker(_):
    return made(None, 4 * sharing.SHARE).num_threads, digest(made(2), 5)


def test_spawned_workers_take_one_thread_unless_told():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(in_a_worker, [None]) == [(1, digest(made(1), 5))]


def test_default(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)), raising=False)
    sizes = (1, 2 * sharing.SHARE - 1, 2 * sharing.SHARE, 4 * sharing.SHARE, 100 * sharing.SHARE)
    assert [sharing.default_threads(n) for n in sizes] == [1, 1, 2, 4, 6]
    for text, threads in (("1", 1), ("3,2", 3), ("100", 6), ("0", 1), ("many", 6), ("", 6)):
        monkeypatch.setenv("OMP_NUM_THREADS", text)  # Ray sets it for its workers
        assert sharing.default_threads(sizes[-1]) == threads


@pytest.mark.parametrize("value", [0, -1, 1.5, "2", True, np.nan])
def test_bad_numbers_of_threads(value):
    with pytest.raises(ValueError, match="num_threads must be a whole number of at least 1") as error:
        made(value)
    assert str(error.value).endswith(f"got {value!r}")
