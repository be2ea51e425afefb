"""The extended Kalman filter, by the statistics of its errors and by differences."""

import math

import numpy as np
import own_tasks
import pytest

from lag_envs.controllers import build, make_controller
from lag_envs.controllers.basic import ObservationDecoder, constant
from lag_envs.controllers.filtering import Filtered
from lag_envs.evaluation.rollout import Rollout, play
from lag_envs.tasks import TASKS
from lag_envs.tasks.cart_pole import CartPoleExact
from lag_envs.tasks.chain import SwingUpTripleNoisy
from lag_envs.tasks.incline import Tilt
from lag_envs.tasks.registration import make_task

ENV, NOISE = "PivotedBar-v0", 0.01


def test_what_is_expected_is_what_is_seen():
    task = TASKS[SwingUpTripleNoisy.id](observation_noise=None)
    x = np.random.default_rng(0).uniform(-3.0, 3.0, (4, 8))
    read = ObservationDecoder(task)
    seen, slopes = read.expected(x)
    states, _ = read(seen)
    assert np.abs(states - x).max() <= 1e-12
    moves = 1e-6 * np.eye(8)
    for j, move in enumerate(moves):
        change = (read.expected(x + move)[0] - read.expected(x - move)[0]) / 2e-6
        assert np.abs(change - slopes[:, :, j]).max() <= 1e-8


@pytest.mark.slow
def test_errors_are_as_large_as_the_filter_believes():
    """Errors normalised by the covariance are distributed as χ² with a degree of freedom for each entry."""
    options = {"observation_noise": NOISE, "track": math.inf}
    task = make_task(ENV, **options)
    agent = Filtered(task, constant(task, action=0.3))
    rollout = Rollout(ENV, agent, range(200), **options)
    weighed = []
    for t, _ in enumerate(rollout):
        if t in (5, 40, 120):
            known = rollout.memory
            moved, covariance = agent._move(known)  # from before the step to the present
            off = rollout.state - moved
            weighed.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off).mean())
        if t == 120:
            break
    # The mean of 200 has a standard deviation of √(2·4/200) = 0.2.
    assert np.abs(np.array(weighed) - 4.0).max() <= 0.8


def test_an_episode_that_begins_is_believed_anew():
    task = make_task(ENV, observation_noise=NOISE)
    agent, rng = Filtered(task, constant(task, action=0.0)), np.random.default_rng(0)
    first, second = rng.normal(0.0, NOISE, (2, 3, 5)).astype(np.float32)
    _, known = agent.predict(first)
    _, known = agent.predict(second, known, np.array([False, True, False]))
    _, again = agent.predict(second)
    _, single = agent.predict(second[1])
    assert (known.state[1] == again.state[1]).all() and (known.state[0] != again.state[0]).any()
    assert np.abs(single.state[0] - again.state[1]).max() <= 1e-15


@pytest.mark.slow
def test_plans_are_renewed_by_each_estimate_alone():
    """Also those of an episode that begins while another's plan is under way."""
    task, rng = TASKS[SwingUpTripleNoisy.id](), np.random.default_rng(0)
    agents = [build(task, "filter + MPC", every=3) for _ in range(2)]
    seen = ObservationDecoder(task).expected(np.array([task.centre]))[0] + rng.normal(0.0, 0.008, (12, 2, 11))
    memory = own = None
    for k, both in enumerate(seen.astype(np.float32)):
        actions, memory = agents[0].predict(both, memory, np.array([k == 0, k in (0, 5)]))
        alone, own = agents[1].predict(both[1], own if k != 5 else None, k in (0, 5))
        assert np.abs(actions[1] - alone).max() <= 1e-6
    assert memory.memory.step.tolist() == [3, 1]
    assert agents[0].controller.plans.effort == 1.0 > task.plans.effort


@pytest.mark.slow
def test_renewing_gently_is_no_worse_than_following():
    env_id, seeds = SwingUpTripleNoisy.id, range(2_000_001_000, 2_000_001_096)
    followed, renewed = (
        play(env_id, make_controller(env_id, f"filter + {name}"), seeds) for name in ("plan + TVLQR", "MPC")
    )
    # The mean difference of so many has a standard deviation of 13.
    assert renewed.mean() > followed.mean()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "needs a task with noise on every entry of the observation"),
        ({"observation_noise": {"cos(theta)": 0.01}}, "noise on every entry"),
        ({"observation_noise": 0.01, "action_delay": 0.02}, "every observation on time"),
        ({"observation_noise": 0.01, "observation_every": 2}, "every observation on time"),
        ({"observation_noise": 0.01, "randomize": {"damping": (0.5, 2.0)}}, "needs known parameters"),
        ({"observation_noise": 0.01, "lag": 0.05}, "controls that act at once"),
        ({"observation_noise": 0.01, "slew": 1.0}, "controls that act at once"),
        ({"observation_noise": 0.01, "action_noise": 0.1}, "action noise need drift > 0"),
        ({"observation_noise": 0.01, "push": (1.0, 0.1)}, "pushes and action noise need drift > 0"),
    ],
)
def test_a_filter_is_refused_where_it_would_be_wrong(options, message):
    task = make_task(ENV, **options)
    with pytest.raises(ValueError, match=message):
        Filtered(task, constant(task, action=0.0))


@pytest.mark.parametrize("kind", [own_tasks.Deliver, CartPoleExact, Tilt])
def test_a_filter_is_refused_for_several_controls_lists_and_targets(kind):
    with pytest.raises(ValueError, match=r"takes one control with continuous actions|has targets"):
        Filtered(kind(observation_noise=0.01), None, drift=0.1)
