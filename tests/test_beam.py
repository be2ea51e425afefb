"""Beam search, for tasks whose actions are listed."""

import math

import numpy as np
import pytest
from own_tasks import Deliver, Switched

from lag_envs.controllers import make_controller
from lag_envs.controllers.beam import BeamSearch, beam
from lag_envs.envs.model import Model
from lag_envs.envs.single import LagrangianEnv
from lag_envs.evaluation.rollout import play
from lag_envs.tasks import acrobot, cart_pole, pendulum

ACROBOT, CART_POLE = acrobot.AcrobotExact.id, cart_pole.CartPoleExact.id
#: So fine that every state has a cell of its own.
FINE = 1e-9


def returns_of_all(task, start, steps):
    """Return what each of all sequences of listed actions pays, up to its end, and which end."""
    count = task.formulas.choices[0]
    choices = np.indices((count,) * steps).reshape(steps, -1)
    model = Model(task)
    states = np.tile(start, (choices.shape[1], 1))
    total, over = np.zeros(len(states)), np.zeros(len(states), bool)
    for choice in choices:
        states, rewards, ended = model(states, choice)
        total += np.where(over, 0.0, rewards)
        over |= ended
    return total, over


@pytest.mark.parametrize(
    ("kind", "start", "steps"),
    [
        (acrobot.AcrobotExact, [1.2, 2.0, 0.0, 2.0], 6),  # few reach the goal
        (acrobot.AcrobotExact, [0.1, 0.0, 0.0, 0.1], 4),  # it is out of reach
        (cart_pole.CartPoleExact, [0.0, 0.0, 0.15, 1.0], 6),  # most sequences drop the pole
        (cart_pole.CartPoleExact, [0.0, 0.0, 0.2, 1.0], 6),  # it cannot be held
        (Switched, [0.0, 0.0, 2.0, 1.0, 2.1, 0.0, 1.9, 3.0], 6),  # rewards of different sizes
    ],
)
def test_a_wide_search_finds_the_best_of_all_sequences(kind, start, steps):
    task = kind()
    total, over = returns_of_all(task, start, steps)
    planner = BeamSearch(task, horizon=steps, width=len(total), cell=FINE)
    found = planner.search(np.array(start))
    assert found.rewards.sum() == pytest.approx(total.max(), abs=1e-12)
    assert found.ended == over[total == total.max()].all() and len(found.choices) <= steps
    # The trajectory is what its choices lead to.
    states, rewards, _ = planner.model(found.states, found.choices)
    np.testing.assert_array_equal(states[:-1], found.states[1:])
    np.testing.assert_array_equal(rewards, found.rewards)


def test_the_final_cost_ranks_sequences():
    task, start, steps = acrobot.AcrobotExact(), np.array([0.05, 0.0, 0.0, -0.05]), 5
    planner = beam(task, energy=2.0, weights={"theta_1": 0.1}, horizon=steps, width=3**steps, cell=FINE)
    states = np.tile(start, (3**steps, 1))
    for choice in np.indices((3,) * steps).reshape(steps, -1):
        states, _, _ = planner.model(states, choice)
    cost = 0.2 * (1.0 - np.cos(states[:, 0])) - 2.0 * task.scene.energy(states)["total"]
    np.testing.assert_allclose(planner.tail(states), cost)
    found = planner.search(start)
    assert planner.tail(planner.model(found.states[-1:], found.choices[-1:])[0]) == pytest.approx(cost.min())


def test_no_cell_keeps_two():
    """Angles count up to whole turns; the better state stays, and the best comes first."""
    planner = BeamSearch(acrobot.AcrobotExact(), width=3, cell=0.5)
    turn = 2.0 * math.pi
    states = np.array(
        [[0.1, 0, 0, 0], [0.1 + turn, 0, 0, 0], [2.0, 0, 0, 0], [-2.0, 0, 0, 9.0], [1.0, 5.0, 0, 0]]
    )
    kept = planner._select(states, np.array([0.0, 1.0, 2.0, -1.0, 3.0]))
    assert kept.tolist() == [4, 2, 1]


def test_together_as_alone_to_the_bit():
    agent = beam(acrobot.AcrobotExact(), energy=1.0, width=20, horizon=30, every=3)
    env = LagrangianEnv(acrobot.AcrobotExact)
    starts = np.array([env.reset(seed=seed)[0] for seed in range(3)])
    later = np.array([env.reset(seed=seed)[0] for seed in range(3, 6)])
    memory, single = None, [None] * 3
    for rows, begins in ((starts, True), (later, False), (starts, np.array([False, True, False]))):
        actions, memory = agent.predict(rows, memory, np.broadcast_to(begins, 3))
        assert actions.dtype == np.int64 and actions.shape == (3,)
        for i in range(3):
            begin = np.broadcast_to(begins, 3)[i : i + 1]
            action, single[i] = agent.predict(rows[i : i + 1], single[i], begin)
            assert action[0] == actions[i]
            for name in memory._fields:
                np.testing.assert_array_equal(getattr(single[i], name)[0], getattr(memory, name)[i])
    action, _ = agent.predict(starts[0])
    assert action.shape == () and env.action_space.contains(action[()])


def test_it_plans_again_after_a_push_only(monkeypatch):
    env, searched = LagrangianEnv(acrobot.AcrobotExact), []
    agent = beam(acrobot.AcrobotExact(), energy=1.0, width=200, pause=2)
    search = agent.search
    monkeypatch.setattr(agent, "search", lambda *given: searched.append(given) or search(*given))
    start, pushed = {"state": [1.5, 0.5, 0.5, 1.0]}, [0.5, 0.1, 0.0, -1.0]
    seen, _ = env.reset(options=start)
    memory, ended, steps = None, False, 0
    while not ended and steps < 100:
        action, memory = agent.predict(seen, memory)
        seen, _, ended, _, _ = env.step(action[()])
        steps += 1
    assert len(searched) == 1 and ended and steps == memory.length[0] > 3
    # After the first step, the state is another one.
    _, memory = agent.predict(env.reset(options=start)[0])
    seen, _ = env.reset(options={"state": pushed})
    _, memory = agent.predict(seen, memory)
    assert len(searched) == 2  # not before the pause is over
    _, memory = agent.predict(seen, memory)
    assert len(searched) == 3
    np.testing.assert_allclose(memory.states[0, 0], pushed, atol=1e-6)


def test_what_still_ends_as_well_is_kept(monkeypatch):
    agent = beam(cart_pole.CartPoleExact(), weights={"theta": 1.0}, horizon=10, width=10, pause=1)
    seen = np.zeros(4, np.float32)
    _, memory = agent.predict(seen)
    monkeypatch.setattr(agent, "search", None)
    seen = memory.states[0, 1] + [0.01, 0.0, 0.0, 0.0]
    _, later = agent.predict(seen, memory)
    np.testing.assert_array_equal(later.choices, memory.choices)
    np.testing.assert_allclose(later.states[0, 1], seen)
    assert later.length[0] == 10 and later.step[0] == 2


def test_what_cannot_work_is_refused():
    for kind in (pendulum.PendulumExact, Deliver):
        reason = f"listed actions; those of {kind.__name__} lie in a range: use MPC"
        with pytest.raises(ValueError, match=reason):
            BeamSearch(kind())
    task = cart_pole.CartPoleExact()
    for numbers, reason in (
        ({"horizon": 0}, "horizon must be a whole number of at least 1, got 0"),
        ({"width": 0}, "width must be a whole number of at least 1"),
        ({"every": 0}, "every must be a whole number of at least 1"),
        ({"pause": 0}, "pause must be a whole number of at least 1"),
        ({"cell": 0.0}, "cell must be above 0"),
        ({"surprise": math.nan}, "surprise must be above 0, got nan"),
        ({"weights": {"thetta": 1.0}}, "weights: there is no 'thetta'; did you mean theta"),
        ({"rest": {"y": 1.0}}, "rest: there is no 'y'"),
    ):
        with pytest.raises(ValueError, match=reason):
            beam(task, **numbers)


@pytest.mark.slow
def test_cart_pole_stands_for_the_whole_episode():
    assert play(CART_POLE, make_controller(CART_POLE, "beam search"), range(1)).tolist() == [500.0]


@pytest.mark.slow
def test_acrobot_is_much_faster_than_any_learner():
    returns = play(ACROBOT, make_controller(ACROBOT, "beam search"), range(5_000, 5_024))
    assert returns.mean() > -61.0 and returns.min() > -70.0


@pytest.mark.slow
def test_a_narrow_search_is_faster_than_any_learner_too():
    agent = beam(acrobot.AcrobotExact(), energy=1.0, width=300)
    assert play(ACROBOT, agent, range(1)).min() > -75.0
