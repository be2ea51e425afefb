"""Swing-ups, balance, an arm, the real double pendulum, and the task whose optimum is proved."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
from covering import every, slow
from rollouts import Noisy, actions, episode, make

from lag_envs.controllers import ILQR, build, make_controller
from lag_envs.controllers.basic import Constant, ObservationDecoder
from lag_envs.controllers.lookahead import LookAhead
from lag_envs.envs.model import Model
from lag_envs.evaluation.rollout import play
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scores import known_returns
from lag_envs.tasks import TASKS
from lag_envs.tasks.acrobot import AcrobotReal, PendubotReal
from lag_envs.tasks.arm import Reach
from lag_envs.tasks.cart_pole import CartPoleContinuous, CartPoleSwingUp
from lag_envs.tasks.chain import Balance, SwingUp
from lag_envs.tasks.pendulum import PendulumExact, PendulumRegret
from lag_envs.tasks.registration import make_task
from lag_envs.tasks.rotary_pendulum import RotarySwingUp

# --- rewards, restated ---


def cart_swing(y, u, target):
    return ((1 + math.cos(y[2])) / 2) ** 2 * (1 - 0.1 * (u / 10) ** 2)


def cart_balance(y, u, target):
    if abs(y[0]) > 2.4 or abs(y[2]) > math.pi / 15:
        return 0.0
    return (1 - (15 * y[2] / math.pi) ** 2 / 2 - (y[0] / 2.4) ** 2 / 2) * (1 - 0.1 * (u / 10) ** 2)


def rotary(y, u, target):
    return ((1 - math.cos(y[2])) / 2) ** 2 * (0.8 + 0.2 * math.cos(y[0])) * (1 - 0.1 * (u / 0.15) ** 2)


def real(y, u, target):
    tip = -(0.2 * math.cos(y[0]) + 0.3 * math.cos(y[0] + y[2])) / 0.5
    return 0.02 * ((1 + tip) / 2) ** 4 * (1 - 0.1 * (u / 6) ** 2)


def reach(y, u, target):
    hand = np.array([0.4 * f(y[0]) + 0.3 * f(y[0] + y[2]) for f in (math.cos, math.sin)])
    effort = 1 - 0.05 * ((u[0] / 8) ** 2 + (u[1] / 3) ** 2)
    return math.exp(-np.linalg.norm(hand - target) / 0.1) * effort


@pytest.mark.parametrize(
    ("env_id", "restated"),
    [
        (CartPoleSwingUp.id, cart_swing),
        (CartPoleContinuous.id, cart_balance),
        (Reach.id, reach),
        slow(RotarySwingUp.id, rotary),
        slow(AcrobotReal.id, real),
        slow(PendubotReal.id, real),
    ],
)
def test_rewards_are_as_written_and_never_below_0(env_id, restated):
    env = make(env_id)
    env.reset(seed=1)
    for i, action in enumerate(actions(300, env.action_space)):
        if i % 50 == 25:  # also far from the start
            env.reset(options={"state": env.task.examples.start["state"]})
        before = env.state
        _, reward, terminated, _, _ = env.step(action)
        after = env.scene.simulate(before, [np.atleast_1d(env.control)], env.task.dt)[1]
        assert reward == pytest.approx(restated(after, env.control, env.target), rel=1e-9, abs=1e-12)
        assert reward >= 0.0
        if terminated:
            env.reset()


# --- unintended solutions ---


def best(env_id):
    return known_returns(env_id).best


@pytest.mark.parametrize("env_id", [CartPoleSwingUp.id, slow(CartPoleContinuous.id), slow(Balance.id)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_leaving_does_not_pay(env_id, side):
    assert play(env_id, Constant(side), range(20)).max() < 0.2 * best(env_id)


@pytest.mark.parametrize(
    ("env_id", "state", "share"),
    [
        (CartPoleSwingUp.id, [0.0, 0.0, math.pi, 15.0], 0.5),
        (RotarySwingUp.id, [0.0, 0.0, 0.0, 25.0], 0.5),
        (AcrobotReal.id, [0.0, 25.0, 0.0, 0.0], 0.35),
        (PendubotReal.id, [0.0, 25.0, 0.0, 0.0], 0.35),
    ],
)
def test_spinning_does_not_pay(env_id, state, share):
    """Even if something spins from the start, which takes effort to reach."""
    options = {"duration": 2.0} | ({"damping": 0.0} if env_id == RotarySwingUp.id else {})
    env = make(env_id, **options)
    total, _ = episode(env, Constant(0.0), seed=0, options={"state": state})
    assert total * env.task.interval * env.task.steps / 2.0 < share * best(env_id)


@pytest.mark.parametrize(
    ("env_id", "state"),
    [
        slow(Reach.id, [-0.5 * math.pi, 0.0, 0.0, 0.0]),
        slow(Reach.id, [0.3, 0.0, math.pi, 0.0]),
        slow(AcrobotReal.id, [math.pi, 0.0, 0.0, 0.0]),
        slow(AcrobotReal.id, [0.0, 0.0, math.pi, 0.0]),
        (RotarySwingUp.id, [0.0, 0.0, 0.0, 0.0]),
        (SwingUp.id, [0.0, 0.0, 0.0, 0.0, math.pi, 0.0]),
    ],
)
def test_singular_starts_are_no_exception(env_id, state):
    """Links exactly in line, stretched or folded, and equilibria are stepped like their neighbours."""
    task, aim = TASKS[env_id](), [0.35, 0.1] if env_id == Reach.id else None
    near = np.array([state, np.array(state) + 1e-9, np.array(state) - 1e-9])
    actions = np.full((3, task.formulas.actions), 0.5)
    ends, rewards, ended = Model(task)(near, actions if task.formulas.actions > 1 else actions[:, 0], aim)
    assert np.isfinite(ends).all() and not ended.any()
    assert np.abs(ends - ends[0]).max() < 1e-7 and np.abs(rewards - rewards[0]).max() < 1e-7
    assert np.abs(task.scene.jacobian(near[0], task.wanted(actions)[0], task.dt)[0]).max() < 10.0


@pytest.mark.parametrize(
    "kind", [CartPoleSwingUp, CartPoleContinuous, Reach, RotarySwingUp, AcrobotReal, PendubotReal]
)
def test_easy_entries_are_no_gift(kind):
    """Random actions get next to nothing of the possible return."""
    known = known_returns(kind.id)
    assert known.random < 0.1 * known.best


# --- the arm ---


@pytest.mark.slow
def test_the_arm_needs_more_than_springs():
    springs, torque = (
        play(Reach.id, make_controller(Reach.id, name), range(100)) for name in ("springs", "computed torque")
    )
    assert springs.mean() + 50.0 < torque.mean() < 190.0
    planned = play(Reach.id, make_controller(Reach.id, "MPC"), range(8))
    assert planned.mean() > torque[:8].mean() + 2.0


def test_some_points_can_be_held_in_one_posture_only():
    controller = build(make_task(Reach.id), "computed torque")
    rng = np.random.default_rng(0)
    points = np.array([0.35, 0.0]) + rng.uniform(-1.0, 1.0, (500, 2)) * [0.15, 0.45]
    holding = np.array([controller.holding(posture) for posture in controller.postures(points)])
    assert (holding.min(axis=0) < 1.0).all()
    assert 0.02 < (holding.max(axis=0) > 1.0).mean() < 0.9
    for posture in controller.postures(points):
        x = 0.4 * np.cos(posture[:, 0]) + 0.3 * np.cos(posture.sum(axis=1))
        y = 0.4 * np.sin(posture[:, 0]) + 0.3 * np.sin(posture.sum(axis=1))
        np.testing.assert_allclose(np.stack([x, y], axis=1), points, atol=1e-12)


# --- the real double pendulum ---


def published(q, v, torque):
    """Return accelerations by the project's equations (docs/text/dynamics.rst), with its numbers."""
    m2, l1, r1, r2, gears, rotor, g = (
        0.6255677234174437,
        0.2,
        0.2,
        0.25569305436052964,
        6.0,
        6.287203962819607e-05,
        9.81,
    )
    m1, i1, i2 = 0.5234602302310271, 0.031887199591513114, 0.05086984812807257
    coupling = m2 * l1 * r2 * math.cos(q[1])
    m00 = i1 + i2 + m2 * l1**2 + 2 * coupling + gears**2 * rotor + rotor
    m01 = i2 + coupling - gears * rotor
    mass = np.array([[m00, m01], [m01, i2 + gears**2 * rotor]])
    turning = m2 * l1 * r2 * math.sin(q[1])
    coriolis = np.array([-2 * turning * v[1] * v[0] - turning * v[1] ** 2, turning * v[0] ** 2])
    second = m2 * r2 * g * math.sin(q[0] + q[1])
    weight = -np.array([(m1 * r1 + m2 * l1) * g * math.sin(q[0]) + second, second])
    friction = [0.001 * w + c * math.atan(100 * w) for w, c in zip(v, (0.16, 0.12), strict=True)]
    return np.linalg.solve(mass, torque + weight - coriolis - friction)


def test_the_real_pendulums_equations_are_the_published_ones():
    numbers = {name: getattr(make_task(AcrobotReal.id).scene, name) for name in AcrobotReal.defaults}
    friction = {"damping": 0.001, "damping_2": 0.001, "dry_friction": 0.16, "dry_friction_2": 0.12}
    scene = AcrobotReal.scene(control="both", **(numbers | friction))
    rng = np.random.default_rng(0)
    for _ in range(50):
        q, v, u = rng.uniform(-3.0, 3.0, 2), rng.uniform(-20.0, 20.0, 2), rng.uniform(-6.0, 6.0, 2)
        found = scene.acceleration([q[0], v[0], q[1], v[1]], u)
        np.testing.assert_allclose([found["theta_1"], found["theta_2"]], published(q, v, u), rtol=1e-10)


@pytest.mark.parametrize(("kind", "idle"), [(AcrobotReal, ""), (PendubotReal, "_2")])
def test_only_the_driven_joint_has_friction(kind, idle):
    scene = make_task(kind.id).scene
    assert getattr(scene, f"damping{idle}") == getattr(scene, f"dry_friction{idle}") == 0.0
    driven = {"": "_2", "_2": ""}[idle]
    assert getattr(scene, f"damping{driven}") == 0.001 and getattr(scene, f"dry_friction{driven}") > 0.1
    # The idle motor's compensation is within the project's limits.
    assert 0.16 * math.pi / 2 + 0.001 * 100.0 < 0.5


@pytest.mark.parametrize("kind", [AcrobotReal, PendubotReal])
def test_the_published_regulator_holds_the_real_pendulum(kind):
    env = make(kind.id, duration=3.0)
    episode(env, build(env.task, "LQR"), seed=0, options={"state": [math.pi + 0.03, 0.0, -0.02, 0.0]})
    assert bool(env.task.goal_holds([env.state])[0])
    assert np.abs(env.state - [math.pi, 0.0, 0.0, 0.0]).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "gain"), [(AcrobotReal, 1.7), (PendubotReal, 1.0)])
def test_renewing_the_recorded_plan_is_better(kind, gain):
    followed, renewed = (
        play(kind.id, make_controller(kind.id, name), range(3)) for name in ("plan + TVLQR", "MPC")
    )
    assert (renewed > followed + gain).all()


@pytest.mark.slow
def test_renewed_plans_are_the_same_alone_and_after_a_restart():
    task = make_task(PendubotReal.id)
    agents, read, model = [build(task, "MPC") for _ in range(2)], ObservationDecoder(task), Model(task)
    states, memory, own = np.array([task.centre, [0.03, -0.02, 0.01, 0.04]]), None, None
    for k in range(26):
        if k == 13:
            states[1] = [-0.02, 0.01, 0.03, 0.0]  # another episode begins in the middle of the first's
        seen = read.expected(states)[0].astype(np.float32)
        actions, memory = agents[0].predict(seen, memory, np.array([k == 0, k in (0, 13)]))
        alone, own = agents[1].predict(seen[0], own, k == 0)
        assert (actions[0] == alone).all()
        if k == 13:
            assert (actions[1] == build(task, "MPC").predict(seen[1])[0]).all()
        states = model(states, actions[:, 0])[0]
    # Plans leave a twentieth of the torque to their feedback.
    assert 0.9 < np.abs(memory.actions).max() <= 0.95
    # Every second of its steps a plan is renewed, each of them five calls long.
    assert memory.step.tolist() == [6, 3]


@pytest.mark.slow
def test_a_value_that_overflows_loses_no_plan(monkeypatch):
    task = make_task(PendubotReal.id)
    agent = build(task, "MPC")
    solve, calls = agent.planner._solve, []

    def overflowing(*args):
        change, gains = solve(*args)
        calls.append(change)
        return (np.full_like(change, np.nan), gains * np.nan) if len(calls) == 1 else (change, gains)

    monkeypatch.setattr(agent.planner, "_solve", overflowing)
    x = np.array([task.centre])
    plan = agent._make(agent._blank(x), x, np.zeros(1), False)
    assert len(calls) > 1
    assert np.isfinite(plan.actions).all() and np.isfinite(plan.gains).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("state", "torque"), [(None, 0.0), ([-2.50523255, 0.77003043, 0.4953778, 0.43204563], -4.25240342)]
)
def test_dry_friction_has_its_slope(state, torque):
    """It changes its sign over 0.01 rad/s: a joint at rest or reversing soon forgets how fast it turned."""
    task = make_task(AcrobotReal.id)
    scene, start = task.scene, np.array(task.centre if state is None else state)
    n, h, fine = len(start), 1e-7, 40
    held = np.full((fine, 1), torque)
    moved = [
        scene.simulate(start + sign * h * row, held, 0.01 / fine)[-1] for row in np.eye(n) for sign in (1, -1)
    ]
    slopes = (np.array(moved[::2]) - np.array(moved[1::2])).T / (2.0 * h)
    np.testing.assert_allclose(scene.jacobian(start, torque, 0.01)[0], slopes, rtol=1e-5, atol=1e-5)
    by_state = [scene.vjp(start, torque, 0.01, row)[0] for row in np.eye(n)]
    np.testing.assert_allclose(by_state, slopes, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_between_the_steps_of_a_plan_feedback_acts_on_the_line_between_its_states():
    task = make_task(PendubotReal.id)
    agent, read = build(task, "MPC", every=3), ObservationDecoder(task)
    assert agent.task.dt == pytest.approx(5 * task.dt) and agent.horizon == round(1.1 * 425 / 5)
    rows, x = np.arange(1), np.array([[0.01, 0.02, -0.03, 0.0]])
    _, plan = agent.predict(read.expected(x)[0].astype(np.float32))
    line = 0.6 * plan.states[0, 1] + 0.4 * plan.states[0, 2]
    move = np.array([1e-3, 0.0, 2e-3, 0.0])
    later = plan._replace(step=np.array([7]))
    off, _ = agent._followed(later, rows, later.step, line[None] + move)
    np.testing.assert_allclose(off[0], move, atol=1e-12)
    action, after = agent.predict(read.expected(line[None] + move)[0].astype(np.float32), later)
    expected = plan.actions[0, 1] + plan.gains[0, 1] @ move
    np.testing.assert_allclose(action[0], np.clip(expected, -1.0, 1.0), atol=1e-4)
    assert after.step[0] == 8 and (after.actions == plan.actions).all()


# --- an optimum that is proved ---


def greedy():
    return LookAhead(
        make_task(PendulumRegret.id), lambda ends, goals, before: np.zeros(len(ends)), np.linspace(-1, 1, 21)
    )


POLICIES = {
    "optimal": lambda: make_controller(PendulumRegret.id, "optimal law"),
    "energy shaping": lambda: make_controller(PendulumRegret.id, "energy shaping + LQR"),
    "random": lambda: make_controller(PendulumRegret.id, "random"),
    "zero": lambda: make_controller(PendulumRegret.id, "zero"),
    "push": lambda: Constant(1.0),
    "a little noise": lambda: Noisy(make_controller(PendulumRegret.id, "optimal law"), 0.05),
    "noise": lambda: Noisy(make_controller(PendulumRegret.id, "optimal law"), 0.5),
    "greedy": greedy,
}


def value(state):
    """Return V: missing height and kinetic energy in per cent of what lies between hanging and upright."""
    weight, inertia = 0.5 * 9.81, 1.0 / 3.0
    return 100 * (weight * (1 - np.cos(state[:, 0])) + 0.5 * inertia * state[:, 1] ** 2) / (2 * weight)


@pytest.mark.parametrize("name", every(2, POLICIES))
def test_no_policy_exceeds_the_value_of_the_start(name):
    """The sum telescopes: V(start) - V(end) minus deviations from the law, and V is nowhere below 0."""
    n = 16
    envs, agent = gym.make_vec(PendulumRegret.id, n, autoreset_mode="Disabled"), POLICIES[name]()
    task = envs.unwrapped.task
    observation, _ = envs.reset(seed=3)
    start = envs.unwrapped.state
    total, penalty, memory = np.zeros(n), np.zeros(n), None
    for _ in range(200):
        before = envs.unwrapped.state
        action, memory = agent.predict(observation, memory)
        observation, reward, _, truncated, _ = envs.step(action)
        names = type("State", (), {"theta": before[:, 0], "theta_dot": before[:, 1]})
        penalty += 0.2 * ((envs.unwrapped.control - task.law(names, np)) / 2.0) ** 2
        total += reward
    assert truncated.all()
    end = envs.unwrapped.state
    np.testing.assert_allclose(total, value(start) - value(end) - penalty, rtol=0.0, atol=1e-10)
    assert (total <= value(start) + 1e-10).all() and (penalty >= 0.0).all()
    if name == "optimal":
        assert (total >= value(start) - 1e-6).all() and (penalty < 1e-9).all()
    else:
        assert total.mean() < value(start).mean() - 0.05
    if name == "greedy":
        assert total.max() < 0.0


def test_the_known_optimum_is_the_value_of_the_start():
    from lag_envs.controllers.pendulum import value_at_start

    states = np.array([[math.pi, 0.0], [2.0, 1.0], [0.0, 0.0]])
    found = value_at_start(make_task(PendulumRegret.id), *states.T)
    np.testing.assert_allclose(found, value(states), atol=1e-12)
    assert found[0] == pytest.approx(100.0) and found[2] == 0.0


# --- actions in other units ---


@pytest.mark.parametrize("top", [0.0, -1.0, math.inf, math.nan])
def test_a_largest_action_must_be_a_size(top):
    kind = type("Odd", (PendulumExact,), {"id": "", "largest_action": top})
    with pytest.raises(FormulaError, match=f"Odd.largest_action must be above 0 and finite, got {top}"):
        kind()


@pytest.mark.slow
def test_plans_use_actions_beyond_1():
    task = make_task(PendulumExact.id, duration=1.0)
    guess = build(task, "energy shaping + LQR")
    agent = ILQR(task, [guess], iterations=5)
    starts = np.array([[1.0, 0.0], [math.pi, 1.0]])
    assert np.abs(agent.plan(starts, np.zeros(2))[0].actions).max() == 2.0
    follow = play(PendulumExact.id, guess, range(8), duration=1.0)
    assert play(PendulumExact.id, agent, range(8), duration=1.0).mean() > follow.mean()


def test_an_action_is_the_torque_itself():
    env = make(PendulumExact.id)
    env.reset(seed=0)
    for given, applied in ((0.5, 0.5), (2.0, 2.0), (-7.0, -2.0)):
        env.step(np.array([given], np.float32))
        assert env.control == applied
    assert env.task.wanted([[0.5]]).tolist() == [[0.5]] and env.task.formulas.action(0.5) == 0.5
