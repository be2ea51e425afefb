"""Chains of bars: rewards that cannot be exploited, bars that whip, plans, and planning from anywhere."""

from __future__ import annotations

import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from covering import slow
from rollouts import episode

from agents import optimum, plans
from lag_envs.controllers import build, make_controller
from lag_envs.controllers.basic import Constant, ObservationDecoder, feedback
from lag_envs.controllers.chain import replan
from lag_envs.controllers.ilqr import ILQR
from lag_envs.controllers.linear import time_varying
from lag_envs.controllers.mpc import MPC, loss, without_kicks
from lag_envs.controllers.tracking import Tracking, follow, hold, recorded, search
from lag_envs.envs.model import Model
from lag_envs.envs.program import check_draws
from lag_envs.evaluation.rollout import Rollout, play, record_rollout
from lag_envs.tasks import chain, pivoted_bar

# They share their formulas; each has its own programs, which compile for seconds.
SWING_UPS = (chain.SwingUp, slow(chain.SwingUpWeak), slow(chain.SwingUpTriple))
each_swing_up = pytest.mark.parametrize("kind", SWING_UPS, ids=lambda kind: kind.id)
SEEDS = range(3_600_000_000, 3_600_000_050)


def returns_from(kind, state, agent):
    """Return an agent's return from a start, with no step of the episode left out."""
    total, terminated = episode(gym.make(kind.id), agent, seed=0, options={"state": state})
    assert not terminated
    return total


def test_too_many_random_numbers_are_named():
    with pytest.raises(ValueError, match=r"at most 16, got 18: .* fewer coordinates than Chain with bars=8"):
        gym.make(chain.SwingUpTriple.id, bars=8)
    with pytest.raises(ValueError, match="a kick takes 16 random numbers at most, got draws=17"):
        check_draws(SimpleNamespace(draws=17))


# --- rewards ---


@pytest.mark.slow
@each_swing_up
def test_spinning_does_not_pay(kind):
    """A chain that spins stretched out earns 35/128 a step, the mean of h⁴; learning that must not pay."""
    bars = kind().scene.bars
    total = returns_from(kind, [0.0, 0.0, *[0.0, 30.0] * bars], Constant(0.0))
    assert total < 150.0 < 0.4 * play(kind.id, make_controller(kind.id, "plan + TVLQR"), SEEDS).mean()


def test_one_bar_up_and_one_down_does_not_pay():
    """Feedback holds the upper bar up with the other hanging, a way to earn a sixteenth of a step."""
    task = chain.SwingUp()
    rest = [0.0, 0.0, math.pi, 0.0, 0.0, 0.0]
    _, gain = time_varying(task, np.array([rest]), np.empty(0), rest, task.plans.weights, task.plans.effort)
    agent = Tracking(task, states=[rest], actions=[], gains=np.empty((0, 6)), rest=rest, hold=gain)
    total = returns_from(chain.SwingUp, np.array(rest) + 0.01, agent)
    assert 30.0 < total < 35.0


@each_swing_up
def test_doing_nothing_earns_nothing(kind):
    assert 0.0 <= play(kind.id, make_controller(kind.id, "zero"), SEEDS).mean() < 1e-6


# --- whipping ---


@pytest.mark.parametrize(("kind", "fastest"), [(chain.SwingUp, 45.0), slow(chain.SwingUpTriple, 70.0)])
def test_bars_whip_and_steps_are_divided(kind, fastest):
    """Random actions turn bars so fast that one series diverges; divided, a step equals its four quarters."""
    played = record_rollout(Rollout(kind.id, make_controller(kind.id, "random"), range(300)))
    states, task = played.states.reshape(-1, played.states.shape[-1]), kind()
    rates = np.abs(states[:, 3::2]).max(axis=1)
    state = states[rates.argmax()]
    assert fastest < rates.max() < task.fastest_turn()
    bound = task.scene.step_bound(state, 0.0, task.dt)
    assert bound.substeps > 1 and bound.kind == "proved with the step"
    whole, parts = (task.scene.simulate(state, np.zeros(n), task.dt / n)[-1] for n in (1, 4))
    np.testing.assert_allclose(whole, parts, rtol=1e-11, atol=1e-11)


# --- balancing ---


def test_feedback_by_entry():
    task = chain.Balance()
    agent = feedback(task, e_1=-2.0, s_dot=0.5)
    observation = np.array([9.0, 0.4, 0.1, 9.0, 9.0, 9.0], np.float32)
    assert agent.predict(observation)[0] == pytest.approx([0.0], abs=1e-7)
    with pytest.raises(ValueError, match="there is no observation 'e_3', only s, s_dot, e_1, e_2"):
        feedback(task, e_3=1.0)


def test_balancing_needs_a_track_and_an_upright_start():
    with pytest.raises(ValueError, match="a track of finite length, got track=inf"):
        chain.Balance(track=math.inf)
    env = gym.make(chain.Balance.id)
    with pytest.raises(ValueError, match=r"over at s=0 m, theta_1=3.14159 rad, theta_2=0 rad"):
        env.reset(options={"state": [0.0, 0.0, math.pi, 0.0, 0.0, 0.0]})


# --- plans ---


@pytest.mark.parametrize(
    ("kind", "least"),
    [(chain.SwingUp, 446.0), slow(chain.SwingUpWeak, 400.0), slow(chain.SwingUpTriple, 398.0)],
    ids=lambda one: getattr(one, "id", ""),
)
def test_recorded_plans_are_followed(kind, least):
    agent = make_controller(kind.id, "plan + TVLQR")
    returns = play(kind.id, agent, SEEDS)
    assert returns.mean() > least
    # Asked twice as often, it follows the same plan.
    fine = make_controller(kind.id, "plan + TVLQR", dt=0.01)
    assert play(kind.id, fine, SEEDS[:8], dt=0.01).mean() > least - 20.0


def test_mirror_images():
    task = chain.SwingUp()
    agent, states = recorded(task), np.random.default_rng(0).uniform(-0.2, 0.2, (5, 6))
    for taken in (0.0, 30.0, 400.0):
        near = states + agent.states[min(int(taken), len(agent.actions))]
        times = np.full(5, taken)
        np.testing.assert_allclose(
            agent.mirrored().act(-near, None, times), -agent.act(near, None, times), atol=1e-9
        )


def test_feedback_along_a_plan_ends_as_feedback_at_rest():
    """Along a stationary plan, the feedback is the regulator's; and it is stable."""
    task = chain.SwingUp()
    plans, n = task.plans, 40
    agent = follow(task, np.tile(plans.rest, (n + 1, 1)), np.zeros(n), plans)
    np.testing.assert_allclose(agent.gains, np.tile(agent.hold, (n, 1)), rtol=1e-6)
    a, b = task.scene.jacobian(plans.rest, [0.0], task.dt)
    assert np.abs(np.linalg.eigvals(a - task.largest * b @ agent.hold[None])).max() < 1.0
    # A prototype's gains, from the same weights on its own integrator: for s, s' and for each bar.
    gains = dict(zip(task.scene.state_names, task.largest * agent.hold, strict=True))
    assert [gains["theta_1"], gains["theta_2"]] == pytest.approx([182.3, -293.6], rel=0.01)


def test_plans_that_cannot_be_read(tmp_path):
    task = chain.SwingUp()
    with pytest.raises(ValueError, match=r"no plan .*nothing\.npz; python -m agents\.optimum DoubleBar"):
        Tracking.load(task, tmp_path / "nothing.npz")
    recorded(task).save(tmp_path / "plan.npz")
    with pytest.raises(ValueError, match=r"states must have shape \(66, 8\), got \(66, 6\)"):
        Tracking.load(chain.SwingUpTriple(), tmp_path / "plan.npz")
    again = Tracking.load(task, tmp_path / "plan.npz")
    assert again.gains.dtype == np.float64 and (again.gains == recorded(task).gains).all()


@pytest.mark.slow
def test_command_writes_plans_where_it_is_told(tmp_path, capsys, monkeypatch):
    for name, number in {"batch": 6, "iterations": 10, "quick": {"steps": 60, "batch": 2}}.items():
        monkeypatch.setattr(chain.SwingUp, name, number)
    for name, number in {"PROMISING": 2, "EPISODES": 10, "STARTS": 1}.items():
        monkeypatch.setattr(plans, name, number)
    before = recorded(chain.SwingUp()).actions
    assert optimum.main([chain.SwingUp.id, "--quick", "--folder", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "in 10 episodes" in said and "best of 3 plans" in said
    made = {file.name: Tracking.load(chain.SwingUp(), file) for file in tmp_path.iterdir()}
    assert sorted(name.rpartition("-")[2] for name in made) == ["followed.npz", "quick.npz"]
    assert all(len(plan.actions) in (60, 65) for plan in made.values())
    assert (recorded(chain.SwingUp()).actions == before).all()


@pytest.mark.slow
def test_search_finds_plans():
    task = chain.SwingUp()
    best = next(search(task, 0))
    assert play(chain.SwingUp.id, best, SEEDS).mean() > 440.0


@pytest.mark.slow
def test_planning_anew_is_better_than_following():
    returns = play(chain.SwingUp.id, make_controller(chain.SwingUp.id, "iLQR"), SEEDS[:8])
    assert returns.mean() > 455.0


def test_replanning_begins_from_what_it_is_given():
    task = chain.SwingUp()
    agent = replan(task, guesses=[recorded(task)], beyond=1.2)
    assert agent.steps == 78 and len(agent.guesses) == 1
    assert loss(task)(np.array([task.plans.rest]))[0] == 0.0


# --- from anywhere, with kicks ---


@pytest.mark.slow
def test_a_recorded_plan_does_not_win_from_anywhere():
    task = chain.SwingUpAnywhere()
    agent = Tracking(task, **{name: getattr(recorded(chain.SwingUp()), name) for name in Tracking.DATA})
    assert play(task.id, agent, SEEDS).mean() < 120.0


@pytest.mark.slow
def test_planning_wins_from_anywhere():
    assert (
        play(chain.SwingUpAnywhere.id, make_controller(chain.SwingUpAnywhere.id, "MPC"), SEEDS[:4]).mean()
        > 250.0
    )


def test_tasks_without_kicks():
    task = chain.SwingUpAnywhere()
    calm = without_kicks(task)
    assert task.draws == 2 and calm.draws == 0 and calm.kick(None, [], np) == {}
    assert without_kicks(calm) is calm and calm.dt == task.dt and calm.scene == task.scene


@pytest.mark.slow
def test_mpc_for_any_task():
    """It balances a bar, planning in every step, without being told how."""
    task = pivoted_bar.Balance(duration=1.0)
    agent = MPC(task, horizon=25, iterations=1, guesses=4, budget=2_000)
    returns = play(pivoted_bar.Balance.id, agent, SEEDS[:4], duration=1.0)
    assert returns.mean() > 40.0  # of 50; doing nothing gets half of that
    for name in ("horizon", "every", "guesses", "budget", "finer"):
        with pytest.raises(ValueError, match=f"{name} must be a whole number of at least 1, got 0"):
            MPC(task, **{name: 0})
    for reserve in (-0.1, 1.0, math.nan):
        with pytest.raises(ValueError, match=f"reserve must be at least 0 and less than 1, got {reserve}"):
            MPC(task, reserve=reserve)
    assert build(task, "zero") is not None


def test_no_plan_is_longer_than_an_episode():
    task = chain.SwingUp(duration=0.4)
    agent, start = build(task, "MPC"), ObservationDecoder(task).expected(np.array([task.centre]))[0]
    action, plan = agent.predict(start.astype(np.float32))
    assert plan.states.shape == (1, 20, 6) and np.abs(action).max() <= 1.0


# --- from a recorded plan ---


def test_mpc_begins_with_the_best_recorded_plan():
    task = chain.SwingUp()
    agent = make_controller(task.id, "MPC")
    assert agent.horizon == round(1.1 * len(recorded(task, "quick").actions)) and len(agent.first) == 4
    # From the centre itself, a plan and its mirror image are equally good.
    start = np.array([np.add(task.centre, 1e-3), [0.01, 0.02, -0.1, 0.05, 0.1, -0.05]])
    found = agent._begin(start, np.zeros(2))
    for i, x in enumerate(start):
        values = []
        for law in agent.first:
            worse = ILQR(task, [law], tail=agent.tail, steps=agent.horizon, iterations=1, gains=agent._gains)
            plan, value = worse.plan(x[None], np.zeros(1))
            values.append((value[0], plan.actions[0]))
        best = max(values, key=lambda one: one[0])
        np.testing.assert_allclose(found.actions[i], best[1], atol=1e-5)
        law = follow(task, [*found.states[i], task.plans.rest], found.actions[i, :, 0], task.plans)
        np.testing.assert_allclose(found.gains[i, :, 0], -law.gains)


@pytest.mark.slow
def test_mpc_from_recorded_plans_is_the_same_alone():
    env_id, agents = chain.SwingUp.id, [make_controller(chain.SwingUp.id, "MPC") for _ in range(2)]
    rollouts = [Rollout(env_id, agent, SEEDS[:n]) for agent, n in zip(agents, (3, 1), strict=True)]
    for k, (together, alone) in enumerate(zip(*rollouts, strict=True)):
        assert (together.action[0] == alone.action[0]).all()
        if k == 20:
            break


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "least"),
    [(chain.SwingUp, 448.0), (chain.SwingUpWeak, 405.0), (chain.SwingUpTriple, 405.0)],
    ids=lambda one: getattr(one, "id", ""),
)
def test_mpc_from_recorded_plans_holds_all_bars(kind, least):
    rollout = Rollout(kind.id, make_controller(kind.id, "MPC"), SEEDS[:3])
    assert rollout.run().min() > least
    assert np.cos(rollout.state[:, 2::2]).max() < -0.999


def test_mpc_begins_only_with_plans_of_its_task():
    task, other = chain.SwingUp(), chain.SwingUp(bars=3)
    for law in (recorded(chain.SwingUpWeak()), hold(other), recorded(chain.SwingUp(damping=0.0))):
        with pytest.raises(ValueError, match=r"first: a plan for Chain\(.* cannot guide SwingUp"):
            MPC(task, first=[law])
    unplanned = chain.Balance()
    law = Tracking(unplanned, **{name: getattr(recorded(task), name) for name in Tracking.DATA})
    with pytest.raises(
        ValueError, match="Balance has no `plans`, which say how its plans are made and followed"
    ):
        MPC(unplanned, first=[law])


@pytest.mark.slow
def test_mpc_rescues_what_the_regulator_would_lose():
    task = chain.Balance()
    model, read = Model(without_kicks(task)), ObservationDecoder(task)
    offsets = np.random.default_rng(0).uniform(-1.0, 1.0, (16, 6)) * [0.1, 0.2, 0.12, 0.8, 0.12, 0.8]
    saved = {}
    for name in ("LQR", "MPC"):
        agent, memory, states = build(task, name), None, task.examples.rest + offsets
        alive = np.ones(len(states), np.bool_)
        for _ in range(60):
            actions, memory = agent.predict(read.expected(states)[0].astype(np.float32), memory)
            moved, _, ended = model(states, actions[:, 0])
            alive &= ~ended
            states = np.where(alive[:, None], moved, task.examples.rest)  # else the lost slow the planner
        saved[name] = alive
    assert (saved["MPC"] >= saved["LQR"]).all() and saved["MPC"].sum() > saved["LQR"].sum()
