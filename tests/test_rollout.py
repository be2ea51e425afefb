"""Episodes that are stepped together: their outcomes, and the observers' records."""

import numpy as np
import pytest
from covering import covering, engine, slow
from rollouts import one_by_one

from lag_envs.controllers import Constant, build, controllers, make_controller
from lag_envs.evaluation.rollout import (
    Outcome,
    PolicyError,
    Rollout,
    arrivals,
    observation_std,
    play,
    record_rollout,
)
from lag_envs.tasks import TASKS, cylinder_in_cylinder, incline, pivoted_bar

ENV = incline.Brake.id


@pytest.mark.parametrize("env_id", covering(of=engine))
def test_together_as_one_by_one(env_id):
    """Also if episodes end at different times, and for arbitrary seeds.

    Agents round differently for one and for many, which an unstable motion amplifies: so only for 50 steps.
    """
    seeds, short = [5, 99, 7], {"duration": 50 * TASKS[env_id].interval}
    for name, found in controllers(TASKS[env_id]).items():
        if not found.plans and name != "random":  # random draws for all together
            agent = make_controller(env_id, name)
            together = play(env_id, agent, seeds, **short)
            np.testing.assert_allclose(one_by_one(env_id, agent, seeds, **short), together, rtol=1e-12)


def test_agents_with_a_clock_are_told_its_pace():
    class Clock(Constant):
        pace = 1.0

    clock = Clock(0.0)
    Rollout(ENV, clock, [0], dt=0.1 * TASKS[ENV]().interval)
    assert clock.pace == pytest.approx(0.1)
    Rollout(ENV, clock, [0])
    assert clock.pace == 1.0


def test_a_sensor_changes_what_an_agent_sees_and_nothing_else():
    seen = []

    class Agent(Constant):
        def predict(self, observation, *args, **options):
            seen.append(observation)
            return super().predict(observation, *args, **options)

    agent = Agent(0.3)
    plain = play(ENV, agent, range(3))
    half = len(seen)
    changed = play(ENV, agent, range(3), sensor=lambda observation: -observation)
    np.testing.assert_array_equal(plain, changed)
    for one, other in zip(seen[:half], seen[half:], strict=True):
        np.testing.assert_array_equal(one, -other)


@pytest.mark.parametrize("action", [np.nan, np.inf, "x", None, [0.0, 0.0]])
def test_agents_that_return_no_action_are_found(action):
    class Agent:
        def predict(self, observation, *args, **options):
            return np.full((len(observation), *np.shape(action)), action), None

    with pytest.raises(PolicyError, match=r"it returned an? action|it returned actions|it fails with"):
        play(ENV, Agent(), range(2))


def test_agents_that_fail_are_named_safely():
    class Agent:
        def predict(self, *args, **options):
            raise ZeroDivisionError("\x1b[31mno")

    with pytest.raises(PolicyError, match="it fails with 'ZeroDivisionError") as caught:
        play(ENV, Agent(), range(2))
    assert str(caught.value).isprintable()


def test_observation_std():
    rng, seen = np.random.default_rng(5), []

    class Agent:
        def predict(self, observation, *args, **options):
            seen.append(observation[0])
            return rng.uniform(-1.0, 1.0, (1, 1)).astype(np.float32), None

    play(ENV, Agent(), [5])
    np.testing.assert_allclose(observation_std(ENV, [5]), np.std(seen, axis=0), rtol=1e-5)


# --- observers ---


def test_arrivals_by_hand():
    inside = np.array(
        [[0, 0, 1, 1], [1, 0, 1, 0], [0, 0, 1, 1], [1, 0, 1, 1], [1, 1, 0, 1]], np.bool_
    )  # the third ends after three steps, the second before it arrives
    first, last = arrivals(inside, np.array([4, 3, 3, 4]))
    assert first.tolist() == [1.0, np.inf, 0.0, 0.0]
    assert last.tolist() == [3, 4, 0, 2]


def test_recorded_episodes_hold_together():
    rollout = Rollout(ENV, make_controller(ENV, "switching line"), range(20))
    outcome, taken = Outcome(rollout), []
    played = record_rollout(rollout, outcome, taken.append)
    steps = played.steps
    assert len(taken) == steps.max() > steps.min() and np.array_equal(outcome.steps, steps)
    assert played.states.shape == (steps.max() + 1, 20, 2) and played.actions.shape == (steps.max(), 20, 1)
    np.testing.assert_array_equal(played.rewards.sum(axis=0), rollout.returns)
    np.testing.assert_array_equal(played.running, [step.running for step in taken])
    over = int(steps.argmin())  # after its end, its last state is kept
    assert (played.states[steps[over] :, over] == played.states[-1, over]).all()
    np.testing.assert_allclose(np.abs(played.observations[0]), np.abs(played.states[0]), rtol=1e-6)


def test_the_hash_holds_all_that_happens():
    def bits(action, seeds=range(3), env_id=ENV, **options):
        rollout = Rollout(env_id, Constant(action), seeds, **options)
        outcome = Outcome(rollout)
        rollout.run(outcome)
        return outcome.result()["trajectory"]

    assert bits(0.3) == bits(0.3)
    others = bits(np.nextafter(np.float32(0.3), 1.0)), bits(0.3, range(1, 4)), bits(0.3, mass=1.1)
    assert len({bits(0.3), *others}) == 4


@pytest.mark.parametrize(
    ("env", "name", "success"),
    [
        (pivoted_bar.SwingUpFree.id, "energy shaping + LQR", 1.0),
        (pivoted_bar.SwingUpFree.id, "zero", 0.0),
        (pivoted_bar.Balance.id, "zero", 0.0),
        (incline.Brake.id, "switching line", 1.0),
        (incline.Brake.id, "zero", 0.0),
        slow(cylinder_in_cylinder.Tilt.id, "LQR", 1.0),
        (cylinder_in_cylinder.Pump.id, "energy pump", 1.0),
        (cylinder_in_cylinder.Damping.id, "switching line", 1.0),
    ],
)
def test_success_is_what_one_would_call_so(env, name, success):
    rollout = Rollout(env, build(TASKS[env](), name), range(1, 21))
    outcome = Outcome(rollout)
    rollout.run(outcome)
    found = outcome.result()
    assert np.mean(found["success"]) == success
    times = [t for t in found["settle"] if t is not None]
    assert len(times) == (20 * success if TASKS[env].goal.terminated is not None else len(times))
    assert all(0.0 <= t < 10.0 for t in times) and all(0.0 <= e <= 1.0 for e in found["effort"])
