import json
import math
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import own_tasks
import pytest
import scipy.linalg
import scipy.optimize
from covering import covering, engine, quick, slow
from rollouts import SINGLE

from agents import tune
from agents.run import fresh_seeds
from lag_envs.controllers import (
    ILQR,
    Constant,
    Random,
    ShellPD,
    TiltLQR,
    build,
    do_nothing,
    make_controller,
)  # fmt: skip
from lag_envs.controllers.basic import ObservationDecoder, Switch, actions_for, constant
from lag_envs.controllers.ilqr import within
from lag_envs.controllers.linear import Regulator, regulator, time_varying
from lag_envs.controllers.lookahead import LookAhead
from lag_envs.controllers.mpc import MPC, planner, without_kicks
from lag_envs.controllers.pivoted_bar import AdaptiveEnergyShapingLQR, EnergyShapingLQR
from lag_envs.controllers.swing_up import easier
from lag_envs.controllers.tracking import Tracking, search, waves
from lag_envs.envs.model import Model
from lag_envs.envs.single import LagrangianEnv
from lag_envs.evaluation.rollout import Rollout, play
from lag_envs.scenes import TwoLinkArm
from lag_envs.scenes.derivation import form_of
from lag_envs.scores import known_returns, score
from lag_envs.tasks import TASKS, Task, cart_pole, cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.record import Plans
from lag_envs.tasks.registration import make_task

SEED = 1_000_000_000
BAR, FREE, BALANCE = "PivotedBar-v0", pivoted_bar.SwingUpFree.id, pivoted_bar.Balance.id
INCLINE, BRAKE = incline.Tilt.id, incline.Brake.id
SHELL, PUMP, DAMPING = (getattr(cylinder_in_cylinder, name).id for name in ("Tilt", "Pump", "Damping"))


# --- performance: mean returns over 1,000 episodes, as in the agents' results ---

KEPT = json.loads((Path(__file__).parents[1] / "agents" / "results" / "summary.json").read_text())["envs"]
ALL = [(env_id, name, found) for env_id in KEPT for name, found in TASKS[env_id].controllers.items()]
PLANS = [(env_id, name) for env_id, name, found in ALL if found.plans and name in KEPT[env_id]["agents"]]


def kept(env_id, name):
    """Return mean return and its standard error."""
    found = KEPT[env_id]["agents"][name]["conditions"]["nominal"]
    return found["return"], found["return_error"]


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        (env_id, name) if env_id in quick(KEPT, of=engine) else slow(env_id, name)
        for env_id, name, found in ALL
        if not found.plans
    ],
)
def test_controller_reaches(env_id, name):
    returns = play(env_id, make_controller(env_id, name), range(SEED, SEED + 1000))
    assert returns.mean() > kept(env_id, name)[0] - 0.1


@pytest.mark.parametrize(
    ("env_id", "name"), [slow(*case) if case[0] != FREE else pytest.param(*case) for case in PLANS]
)
def test_plan_reaches(env_id, name):
    n = 4 if env_id == FREE else 32
    others = (name for name, found in TASKS[env_id].controllers.items() if not found.plans)
    start = max(others, key=lambda name: kept(env_id, name)[0])
    returns = play(env_id, make_controller(env_id, name), range(SEED, SEED + n))
    before = play(env_id, make_controller(env_id, start), range(SEED, SEED + n))
    mean, error = kept(env_id, name)
    assert returns.mean() > mean - 4.0 * error * math.sqrt(1000 / n)
    assert (returns > before - 0.01).all()


@pytest.mark.parametrize(
    ("env_id", "name", "least", "options"),
    [
        (BAR, "energy shaping + LQR", 415.0, {"mass": 0.4, "dt": 0.01}),
        (BALANCE, "LQR", 420.0, {"com_distance": 0.25}),
        slow(INCLINE, "cascade", 175.0, {"control": "tilt"}),
        slow(INCLINE, "PD", 175.0, {"control": "tilt"}),
        slow(BAR, "energy shaping + LQR", 400.0, {"com_distance": 0.2, "track": math.inf}),
        (BRAKE, "switching line", -2.0, {"tilt": 0.2, "dt": 0.01}),
        slow(SHELL, "LQR", 195.0, {"damping": 0.3, "dt": 0.02}),
        slow(DAMPING, "switching line", 320.0, {"mass": 1.3}),
    ],
)
def test_controller_takes_parameters_from_the_task(env_id, name, least, options):
    agent = make_controller(env_id, name, **options)
    assert play(env_id, agent, range(SEED, SEED + 32), **options).mean() > least


# --- interface ---


@pytest.fixture(scope="module")
def observations():
    """Return a batch of observations of an environment, all different."""

    def make(env_id, n):
        rng = np.random.default_rng(0)
        task = make_task(env_id)
        centre, start = np.array(task.centre), np.array(task.half_widths)
        states = centre + start * rng.uniform(-1.0, 1.0, (n, len(centre)))
        if env_id in (BAR, FREE):
            states[n // 2 :, -2:] = [3.0, 0.1]  # where the LQR takes over
        goal = 0.0 if task.target_range is None else task.target_range * rng.uniform(-1.0, 1.0, n)
        read = ObservationDecoder(task)
        k = SimpleNamespace(**task.formulas.constants())
        form, goals = form_of(task.scene), [goal] * task.formulas.targets

        def seen(states):
            rows = form.lift(states) if form else tuple(states.T)
            found = task.formulas.observe(np, rows, goals, k)
            return np.stack(np.broadcast_arrays(*found), axis=-1).astype(np.float32)

        values = seen(states)
        decoded, decoded_goal = read(values)
        np.testing.assert_allclose(seen(decoded), values, atol=1e-6)  # angles differ by whole turns
        np.testing.assert_allclose(decoded_goal, goal, atol=1e-6)
        return values

    return make


ASKED = [
    (env_id, name) if env_id in quick(KEPT) else slow(env_id, name)
    for env_id, name, found in ALL
    if env_id in SINGLE and not found.plans
]


@pytest.mark.parametrize(("env_id", "name"), [*ASKED, (BAR, "zero")])
def test_one_observation_is_answered_as_a_batch(env_id, name, observations):
    agent = make_controller(env_id, name)
    batch = observations(env_id, 6)
    actions, _ = agent.predict(batch)
    assert actions.shape == (6, 1) and actions.dtype == np.float32
    assert (np.abs(actions) <= 1.0).all()
    for one, action in zip(batch, actions, strict=True):
        np.testing.assert_allclose(agent.predict(one)[0], action, atol=1e-6)


@pytest.mark.slow
def test_plans_are_kept_outside(observations):
    task = make_task(SHELL, duration=1.0)
    agent = ILQR(task, [TiltLQR(task)], iterations=3, steps=12)
    first, second = observations(SHELL, 4)[:2], observations(SHELL, 4)[2:]
    _, state = agent.predict(first)
    _, other = agent.predict(second)  # another episode in between
    follow, later = agent.predict(first, state)
    np.testing.assert_array_equal(follow, agent.predict(first, state)[0])
    # New episodes are planned again, the others continue.
    _, mixed = agent.predict(np.stack([first[0], second[1]]), later, np.array([False, True]))
    assert mixed.step.tolist() == [3, 1]
    np.testing.assert_array_equal(mixed.actions[0], state.actions[0])
    np.testing.assert_allclose(mixed.actions[1], other.actions[1], atol=1e-9)
    # One observation alone.
    action, state = agent.predict(first[0])
    assert action.shape == (1,)
    # Beyond the plan, the guess takes over.
    for _ in range(13):
        action, state = agent.predict(first[0], state)
    np.testing.assert_array_equal(action, TiltLQR(task).predict(first[0])[0])


# --- linearisation ---

RESTING = [env_id for env_id, task in TASKS.items() if task.examples.rest]
QUICK = (BAR,)


@pytest.mark.parametrize("env_id", [*QUICK, *(slow(env_id) for env_id in RESTING if env_id not in QUICK)])
def test_linearisation_is_the_slope_of_the_model(env_id):
    task = make_task(env_id)
    rest = np.array(task.examples.rest)
    n, m = len(rest), task.formulas.actions
    h = 1e-5  # small against 0.01 rad/s, over which the real machines' dry friction changes its sign
    a, b = task.scene.jacobian(rest, task.wanted(np.zeros((1, m)))[0], task.dt)
    moves = h * np.vstack([np.eye(n + m), -np.eye(n + m)])
    actions = moves[:, n] if m == 1 else moves[:, n:]
    goal = np.zeros(task.formulas.targets).squeeze() if task.target else None
    ends = Model(task)(rest + moves[:, :n], actions, goal)[0]
    slopes = (ends[: n + m] - ends[n + m :]).T / (2.0 * h)
    per_action = task.wanted(np.eye(m)) - task.wanted(np.zeros((m, m)))
    np.testing.assert_allclose(slopes[:, :n], a, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(slopes[:, n:], b @ per_action.T, rtol=1e-5, atol=1e-6)


# --- several controls ---


class Whirl(Task):
    """Turn the upper arm fast, which takes all of the shoulder, and hardly the forearm."""

    id = ""
    scene = TwoLinkArm
    defaults = {"gravity": 0.0}
    interval, steps = 0.02, 8
    action = {"shoulder": 5.0, "elbow": (-3.0, 5.0)}
    start = {"theta_1": 0.5, "theta_2": 0.5}
    plans = Plans(
        f"{__name__}:unchanged", {}, steps=8, quick={}, batch=2, iterations=20, rest=(0.0, 0.0, 0.0, 0.0),
        weights={"theta_1": 1.0, "theta_2": 2.0}, effort=0.1,
    )  # fmt: skip

    def observe(self, after, target, xp):
        return {name: after[name] for name in self.scene.state_names}

    def reward(self, before, after, control, target, dt, xp):
        effort = 1e-3 * (control.shoulder**2 + control.elbow**2)
        return -((after.theta_1_dot - 6.0) ** 2) - (after.theta_2_dot + 0.5) ** 2 - effort


def unchanged(task):
    """Return the task itself as an easier one, and a final cost."""
    return task, lambda states: np.square(states[:, 2])


def returns_of(planner, actions, starts, targets):
    """Return the returns of actions (n, steps, n_actions)."""
    x, total, alive = starts, np.zeros(len(starts)), np.ones(len(starts), np.bool_)
    for t in range(planner.steps):
        x, reward, ended = planner.advance(x, actions[:, t], targets)
        total += np.where(alive, reward, 0.0)
        alive &= ~ended
    return total


def test_plans_of_several_actions_beat_random_search():
    planner, n = ILQR(without_kicks(own_tasks.Deliver()), [], steps=30), 3000
    start, target = np.array([0.4, 1.2, 0.2, 0.0, 0.0, 0.0]), np.array([-0.4, -1.4])
    tried = waves(np.random.default_rng(0), n, 30, planner.task.dt, 2)
    assert tried.shape == (n, 30, 2) and not (tried[..., 0] == tried[..., 1]).any(axis=1).all()
    found = returns_of(planner, tried, np.tile(start, (n, 1)), np.tile(target, (n, 1)))
    plan, value = planner.improve(start[None], target[None], np.zeros((1, 30, 2)))
    assert value[0] > found.max() + 0.5 > np.median(found) + 5.0
    assert value == pytest.approx(returns_of(planner, plan.actions, start[None], target[None]))


def test_one_action_at_its_bound_and_one_within():
    planner, start = ILQR(Whirl(), [], steps=8, tolerance=1e-12), np.zeros((1, 4))
    plan, value = planner.improve(start, np.zeros(1), np.zeros((1, 8, 2)))

    def lost(actions):
        return -returns_of(planner, actions.reshape(1, 8, 2), start, np.zeros(1))[0]

    best = scipy.optimize.minimize(
        lost, np.zeros(16), bounds=[(-1.0, 1.0)] * 16, options={"ftol": 1e-14, "gtol": 1e-8}
    )
    assert value[0] == pytest.approx(-best.fun, abs=2e-3)
    np.testing.assert_allclose(plan.actions[0], best.x.reshape(8, 2), atol=2e-3)
    shoulder, elbow = np.abs(plan.actions[0]).T
    assert (shoulder[:6] == 1.0).all() and (elbow < 0.9).all()
    assert not plan.gains[0, :6, 0].any() and plan.gains[0, :6, 1].any(axis=1).all()


def test_steps_of_several_actions_within_their_bounds():
    rng, n, m = np.random.default_rng(0), 200, 3
    roots = rng.normal(size=(n, m, m)) + 0.3 * np.eye(m)
    bend, slope = roots.transpose(0, 2, 1) @ roots, 2.0 * rng.normal(size=(n, m))
    actions, mixed = np.clip(1.5 * rng.normal(size=(n, m)), -1.0, 1.0), rng.normal(size=(n, m, 2))
    step, gains = within(actions, slope, bend, mixed, 1.0)
    held = np.abs(actions + step) > 1.0 - 1e-9
    assert {0, 1, 2, 3} == set(held.sum(axis=1))
    for i in range(n):
        wanted = np.linalg.solve(roots[i].T, slope[i])
        bounds = -1.0 - actions[i], 1.0 - actions[i] + 1e-12
        best = scipy.optimize.lsq_linear(roots[i], wanted, bounds, method="bvls", tol=1e-14)
        np.testing.assert_allclose(step[i], best.x, atol=1e-6)
        free = ~held[i]
        expected = np.linalg.solve(bend[i][np.ix_(free, free)], mixed[i, free])
        np.testing.assert_allclose(gains[i, free], expected, atol=1e-9)
        assert not gains[i, held[i]].any()


def test_feedback_along_plans_of_several_actions():
    task = Whirl()
    best = next(search(task))
    assert best.actions.shape == (8, 2) and best.gains.shape == (8, 2, 4) and best.hold.shape == (2, 4)
    model = Model(task)
    x = best.states[:1]
    for t in range(8):
        np.testing.assert_allclose(x[0], best.states[t], atol=1e-9)
        x = model(x, best.actions[t][None])[0]
    # At rest it is the regulator's, whose controls are in newton metres.
    still = time_varying(task, np.zeros((3, 4)), np.tile(task.rest_action, (2, 1)), [0.0] * 4,
                         task.plans.weights, task.plans.effort)  # fmt: skip
    np.testing.assert_allclose(still[0], np.tile(still[1], (2, 1, 1)), rtol=1e-6)
    by_control = np.diag([1.0 / 5.0, 1.0 / 4.0])
    a, b = task.scene.jacobian(np.zeros(4), np.zeros(2), task.dt)
    p = scipy.linalg.solve_discrete_are(a, b, np.diag([1.0, 0.0, 2.0, 0.0]), 0.1 * by_control @ by_control)
    gain = np.linalg.solve(0.1 * by_control @ by_control + b.T @ p @ b, b.T @ p @ a)
    np.testing.assert_allclose(still[1], by_control @ gain, rtol=1e-6)
    # A planner leaves holding to it.
    agent = MPC(task, horizon=3, guesses=1, iterations=1, budget=30, hold=best, holds=lambda x: x[:, 0] > 0.1)
    seen = np.array([[0.2, 0.0, 0.1, 0.0], [0.0, 0.0, 0.0, 0.0]], np.float32)
    actions, plan = agent.predict(seen)
    held = best.act(seen.astype(np.float64), None, np.full(2, np.inf))
    np.testing.assert_allclose(actions[0], np.clip(held[0], -1.0, 1.0), rtol=1e-6)
    assert actions.shape == (2, 2) and plan.actions.shape == (2, 3, 2) and actions[1, 0] == 1.0
    alone, _ = agent.predict(seen[0])
    assert alone.shape == (2,)


# --- mistakes ---


def test_unknown_names_get_hints():
    with pytest.raises(ValueError, match="did you mean PivotedBar-v0"):
        make_controller("PivotedBr-v0", "zero")
    with pytest.raises(ValueError, match="did you mean cascade"):
        make_controller(INCLINE, "casc")
    with pytest.raises(ValueError, match="available: zero, random, LQR"):
        make_controller(BALANCE, "xyz")
    with pytest.raises(TypeError, match="unexpected keyword argument 'weight'"):
        make_controller(BALANCE, "LQR", weight=1.0)
    with pytest.raises(TypeError, match=r"an environment's id is needed.*controllers\.build takes a task"):
        make_controller(TASKS[BALANCE](), "LQR")
    with pytest.raises(TypeError, match="a controller's name is needed, got None; available: zero, random"):
        make_controller(BALANCE, None)


class Lopsided(cart_pole.CartPoleContinuous):
    """The middle of its actions is not the force 0."""

    id = ""
    action = {"force": (-4.0, 16.0)}
    draws = 0


def test_feedback_along_a_plan_holds_a_rest_without_control():
    task, weights = Lopsided(), {"x": 0.1, "theta": 1.0}
    gains, last = time_varying(task, np.zeros((1, 4)), np.empty(0), [0.0] * 4, weights, 1e-3)
    agent = Tracking(task, states=np.zeros((1, 4)), actions=[], gains=gains, rest=[0.0] * 4, hold=last)
    env = LagrangianEnv(Lopsided)
    for controller in (agent, agent.mirrored()):
        seen, _ = env.reset(options={"state": [0.0] * 4})
        action, _ = controller.predict(seen, None, True)
        env.step(action)
        assert abs(env.control) < 1e-6
    np.testing.assert_allclose(agent.law(task).actions, [[-0.6]])
    planner = MPC(task, horizon=3, guesses=1, iterations=1, budget=30)
    blank = planner.predict(np.zeros(4, np.float32))[1]
    assert planner.idle == pytest.approx(-0.6) and np.isfinite(blank.actions).all()


@pytest.mark.slow
def test_what_cannot_work_is_refused():
    with pytest.raises(ValueError, match=r"must have shape \(\.\.\., 4\) for theta, theta_dot, psi_dot"):
        make_controller(SHELL, "LQR").predict(np.zeros(3))
    with pytest.raises(ValueError, match="Balance has random kicks"):
        ILQR(make_task(BALANCE), [Constant(0.0)])
    with pytest.raises(ValueError, match=r"takes one control .*; Deliver has 2 controls"):
        regulator(own_tasks.Deliver(), [0.0] * 6)
    for kind in (ILQR, MPC):
        with pytest.raises(ValueError, match="takes continuous actions; CartPoleExact has listed actions"):
            kind(cart_pole.CartPoleExact(), [])
    for names in ({"weights": {"thetta": 1.0}}, {"rest": {"thetta": 1.0}}):
        with pytest.raises(ValueError, match=r"(weights|rest): there is no 'thetta'; did you mean theta"):
            planner(make_task(BAR), **names)
    misspelt = {"thetta": 1.0}
    for found in ({"weights": {}, "at": misspelt}, {"weights": misspelt}):
        with pytest.raises(ValueError, match=r"(at|weights): there is no 'thetta'; did you mean theta"):
            Regulator(cart_pole.CartPoleContinuous(), effort=1.0, **found)
    with pytest.raises(ValueError, match=r"holds a rest .* from there theta_dot changes by 0\.1"):
        Regulator(cart_pole.CartPoleContinuous(), weights={"x": 1.0}, effort=1.0, at={"theta": 0.5})
    with pytest.raises(ValueError, match="inertia=0"):
        make_controller(PUMP, "energy pump", inertia=0.0)
    for controller in (TiltLQR, ShellPD):
        with pytest.raises(ValueError, match="damping"):
            controller(make_task(SHELL, damping=0.0))


class Unseen(cart_pole.CartPoleContinuous):
    """Observes what does not tell the state linearly."""

    id = ""
    draws, kick, shown = 0, Task.kick, ()

    def observe(self, after, target, xp):
        seen = {
            "x": after.x, "x_dot": after.x_dot, "theta": after.theta, "theta_dot": after.theta_dot,
            "tip": xp.sin(after.theta) * (1.0 + after.x), "1/x": 1.0 / after.x, "|x|": xp.abs(after.x),
            "tanh": xp.tanh(after.theta), "sin": xp.sin(after.theta), "cos": xp.cos(after.theta),
        }  # fmt: skip
        return {name: seen[name] for name in self.shown}

    def bounds(self):
        return dict.fromkeys(self.shown, math.inf)


@pytest.mark.parametrize(
    ("shown", "lost"),
    [
        (["x", "x_dot", "theta", "theta_dot", "tip"], "tip in the observation"),
        (["x", "x_dot", "theta", "theta_dot", "1/x"], "1/x in the observation"),
        (["|x|", "x_dot", "tanh", "theta_dot"], r"\|x\|, tanh in the observation"),
        (["x", "theta"], "x_dot, theta_dot in the state"),
        (["x", "x_dot", "sin", "theta_dot"], "theta in the state"),
        (["x", "x_dot", "sin", "cos", "theta_dot"], ""),
    ],
)
def test_only_what_can_be_read_is_read(shown, lost):
    task = type("Seen", (Unseen,), {"shown": shown})()
    numbers = {"weights": {"theta": 1.0}, "effort": 1.0}
    for make in (lambda: Regulator(task, **numbers), lambda: MPC(task, budget=10), lambda: ILQR(task, [])):
        if not lost:
            assert make().read.wrapped == [2]
            continue
        with pytest.raises(ValueError, match=f"but not {lost} of Seen: observe every entry of the state"):
            make()


def test_targets_must_be_told():
    class Blind(own_tasks.Deliver):
        id, draws, kick = "", 0, Task.kick

        def observe(self, after, target, xp):
            return {name: value for name, value in super().observe(after, target, xp).items() if name != "y"}

        def bounds(self):
            return {"sin": 1.0, "cos": 1.0}

    for make in (MPC, lambda task: ILQR(task, [])):
        with pytest.raises(ValueError, match=r"but Blind does not tell it: observe every target"):
            make(Blind())
    assert MPC(Blind(target=[0.2, -1.5]), budget=10).read is not None


def swing(reward):
    """Return a cart and pole without kicks that pays like this."""
    own = {"id": "", "draws": 0, "kick": Task.kick, "reward": reward}
    return type("Paid", (cart_pole.CartPoleContinuous,), own)()


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (lambda self, before, after, control, target, dt, xp: -control[0] * after.x, "separate terms"),
        (lambda self, before, after, control, target, dt, xp: -((after.x - before.x) ** 2), "after the step"),
        (lambda self, before, after, control, target, dt, xp: -xp.abs(after.x), "needs a smooth reward"),
        (lambda self, before, after, control, target, dt, xp: xp.where(after.x > 1.0, 0.0, 1.0), "smooth"),
    ],
)
def test_a_regulator_takes_quadratic_rewards(reward, message):
    with pytest.raises(ValueError, match=f"{message}.* that of Paid is not"):
        regulator(swing(reward), [0.0] * 4)


@pytest.mark.slow
def test_regulators_of_one_control_among_two():
    class Shoved(own_tasks.Deliver):
        id, guard = "", Task.guard
        defaults = {"gravity": 0.0}
        action = {"push": 20.0}

        def reward(self, before, after, control, target, dt, xp):
            return -(after.x**2) - (after.rope - 1.0) ** 2 - after.swing**2 - control.push**2

    with pytest.raises(ValueError, match="check that the controls can bring it there"):
        regulator(Shoved(), [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # nothing acts on the rope


def test_unequal_forces():
    class Forward(cart_pole.CartPoleContinuous):
        id = ""
        action = {"force": (5.0, 14.0)}

    with pytest.raises(ValueError, match="but force of Forward goes from 5 to 14"):
        Regulator(Forward(), weights={"x": 1.0}, effort=1.0)
    with pytest.raises(ValueError, match="strong in both directions; that of Forward goes"):
        easier(Forward(), end={}, effort=1.0)


def test_one_of_listed_actions():
    task, observations = own_tasks.Switched(), np.zeros((4, len(own_tasks.Switched().observation)))
    actions, _ = constant(task, action=2).predict(observations)
    assert actions.tolist() == [2] * 4 and actions.dtype == np.int64
    assert constant(Levers(), action=[1, 4]).predict(np.zeros((2, 9)))[0].tolist() == [[1, 4]] * 2
    for action, message in ((3, "must be 0 to 2, got 3"), (0.5, "must be a whole number"), ([1], "shape")):
        with pytest.raises(ValueError, match=message):
            constant(task, action=action)
    for index in (-1.0, 0.5, 3.0):
        with pytest.raises(ValueError, match=f"numbers of choices, 0 to 2; got {index:g}"):
            Model(task)(np.full((1, 8), 0.1), [index])


def test_switches_know_their_observations():
    with pytest.raises(ValueError, match="weights: there is no 'thetta'; did you mean theta"):
        Switch(cart_pole.CartPoleContinuous(), weights={"thetta": 1.0})
    with pytest.raises(ValueError, match="Switch takes one control; Deliver has several"):
        Switch(own_tasks.Deliver(), weights={})


class Levers(own_tasks.Deliver):
    """Two lists of actions."""

    id = ""
    action = {"push": [-20.0, 0.0, 20.0], "pull": [0.0, 9.0, 10.0, 11.0, 20.0]}


def test_several_lists_get_the_nearest_actions():
    wanted = np.array([[-19.0, 9.6], [3.0, 30.0], [11.0, 8.0]])
    assert actions_for(Levers(), wanted).tolist() == [[0, 2], [1, 4], [2, 1]]


def test_controllers_need_something_to_do_and_sensible_numbers():
    idle = own_tasks.Drift()
    for make in (lambda: MPC(idle), lambda: Regulator(idle, weights={}, effort=1.0)):
        with pytest.raises(ValueError, match="has nothing to do: Drift has no control to act with"):
            make()
    task = cart_pole.CartPoleContinuous()
    for numbers, reason in (
        ({"effort": 0.0}, "effort must be finite and above 0, got 0"),
        ({"effort": math.nan}, "effort must be finite and above 0, got nan"),
        ({"weights": {"theta": -1.0}}, "weights: that of theta must be finite and at least 0, got -1"),
    ):
        with pytest.raises(ValueError, match=reason):
            Regulator(task, **{"weights": {"theta": 1.0}, "effort": 1.0} | numbers)
    with pytest.raises(ValueError, match=r"horizon must be a whole number of at least 1, got 2\.5"):
        MPC(task, horizon=2.5)
    with pytest.raises(ValueError, match="iLQR needs `guesses`"):
        ILQR(Lopsided(), []).predict(np.zeros(4))


# --- tuning ---


@pytest.mark.slow
def test_tuning(capsys, monkeypatch):
    for env_id, name, found in ALL:
        build(make_task(env_id), name, **{key: 0.5 * sum(ends) for key, ends in found.tune.items()})
    assert tune.tunable(BRAKE) and tune.tunable(BAR)
    used = []

    def evaluated(env_id, agent, seeds):
        used.append(seeds)
        return np.array([-((agent.action - 0.4) ** 2)])

    monkeypatch.setattr(tune, "play", evaluated)
    assert tune.main([BRAKE, "--only", "best constant", "--episodes", "5"]) == 0
    assert "best constant: {'action': 0.4}" in capsys.readouterr().out
    assert {(r.start, len(r)) for r in used} == {(3_000_000_000, 5)}
    assert tune.main(["PivotedBra-v0"]) == 2
    assert "did you mean PivotedBar-v0" in capsys.readouterr().err


# --- the swing-up, and agents that know nothing ---


@pytest.fixture(scope="module")
def controller():
    return EnergyShapingLQR(make_task(BAR))


def test_controller_swings_up_and_holds_each_time(controller):
    assert play(BAR, controller, fresh_seeds(100)).min() > 410.0  # none needs an extra swing, or falls


def test_controller_hands_over_with_hysteresis(controller):
    def holds(e, before, start=None):
        """Return where the LQR is in charge at this angle from upright, for each episode's memory."""
        observations = np.tile([0.0, 0.0, -np.cos(e), -np.sin(e), 0.0], (len(before), 1))
        return controller.predict(observations, np.array(before), start)[1].tolist()

    between = np.sqrt(0.5 * (controller.catch + controller.lose) / controller.cost[2, 2])
    assert holds(0.1, [False, True]) == [True, True]
    assert holds(between, [False, True]) == [False, True]
    assert holds(np.pi, [True]) == [False]
    # An episode's start erases its memory, and no other's.
    assert holds(between, [True, True], [True, False]) == [False, True]


def test_controller_gets_a_bar_at_rest_going(controller):
    action, _ = controller.predict(np.array([0.0, 0.0, 1.0, 0.0, 0.0]))
    assert abs(action.item()) == 1.0


@pytest.mark.parametrize("id", covering())
def test_doing_nothing_is_zero_control(id):
    with gym.make(id) as env:
        env.reset(seed=1)
        action, _ = do_nothing(env).predict(env.observation_space.sample())
        assert action.shape == env.action_space.shape
        env.step(action)
        task = env.unwrapped.task
        nearest = [min((abs(v) for v in a.values), default=0.0) for a in task.formulas.acting]
        assert np.max(np.abs(env.unwrapped.control)) == max(nearest)


def test_agents_without_knowledge():
    assert Constant(0.5).predict(np.zeros((3, 5)))[0].tolist() == [[0.5]] * 3
    first, second = (Random(1).predict(np.zeros((3, 5)))[0] for _ in range(2))
    assert first.shape == (3, 1) and (first == second).all() and len(set(first.ravel())) == 3
    assert play(BAR, Constant(0.0), range(0, 20)).mean() == pytest.approx(0.0, abs=0.1)
    assert play(BAR, Random(0), range(0, 100)).mean() == pytest.approx(known_returns(BAR).random, abs=3.0)


# --- looking ahead ---


def test_look_ahead_finds_the_best_action_of_a_step():
    """Nearly as good as the best of a thousand actions, here with a best one in between."""
    task, rng = make_task(SHELL), np.random.default_rng(0)

    def value(states, targets, taken):
        return -1e3 * (states[:, 1] - 0.02 * taken) ** 2

    agent, model = LookAhead(task, value, np.linspace(-1.0, 1.0, 11)), Model(task)
    states = rng.uniform(-0.1, 0.1, (40, len(task.scene.state_names)))
    targets, taken = rng.uniform(-0.1, 0.1, 40), np.arange(40.0)

    def gain(actions):
        ends, rewards, _ = model(states, actions, targets)
        return rewards + value(ends, targets, taken)

    most = np.max([gain(np.full(40, action)) for action in np.linspace(-1.0, 1.0, 1001)], axis=0)
    found = agent.act(states, targets, taken)
    assert (np.abs(found) < 0.99).any() and (most - gain(found) < 0.01 * np.ptp(most)).all()


def test_agents_count_the_steps_of_each_episode():
    agent = LookAhead(make_task(FREE), lambda states, targets, taken: 0.0 * taken, np.linspace(-1.0, 1.0, 3))
    seen = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.2]])
    action, taken = agent.predict(seen)
    assert action.shape == (2, 1) and action.dtype == np.float32 and taken.tolist() == [1.0, 1.0]
    agent.pace = 0.1
    _, taken = agent.predict(seen, taken, np.array([False, True]))
    assert taken.tolist() == [1.1, 0.1]
    assert agent.predict(seen[0], np.array([3.0]))[0].shape == (1,)


@pytest.mark.slow
def test_the_adaptive_controller_finds_the_bar():
    task = make_task(pivoted_bar.SwingUpUnknown.id)
    agent = AdaptiveEnergyShapingLQR(task, designs=4)
    rollout = Rollout(task.id, agent, range(64))
    assert rollout.run().mean() > 380.0
    length = rollout.envs.parameters["com_distance"]  # of a uniform bar, so that q = 3/(4 L)
    q, _ = np.linalg.solve(rollout.memory.information, rollout.memory.weighed[..., None])[..., 0].T
    assert np.median(np.abs(q * length / 0.75 - 1.0)) < 0.05
    one, _ = agent.predict(rollout.observation[0])
    assert one.shape == (1,)


def test_the_adaptive_controller_needs_something_to_adapt_to():
    with pytest.raises(ValueError, match="com_distance is drawn"):
        AdaptiveEnergyShapingLQR(make_task("PivotedBar-v0"))
    with pytest.raises(ValueError, match="late by a whole number of control steps"):
        AdaptiveEnergyShapingLQR(make_task(pivoted_bar.SwingUpUnknown.id, action_delay=0.013))


def test_an_observation_that_is_not_finite_is_named():
    agent = make_controller(BAR, "energy shaping + LQR")
    bad = np.zeros((2, 5), np.float32)
    bad[1, 4] = np.nan
    with pytest.raises(ValueError, match="observation 'theta_dot/8' must be finite, got nan in row 1"):
        agent.predict(bad)
    with pytest.raises(ValueError, match="observation must be numbers, got 'a'"):
        agent.predict("a")


def test_a_score_needs_an_environment_and_a_number():
    with pytest.raises(ValueError, match="no environment 'PivotedBr-v0'; did you mean PivotedBar-v0"):
        score("PivotedBr-v0", 1)
    with pytest.raises(ValueError, match="mean_return must be finite, got nan"):
        score(BAR, np.nan)
    with pytest.raises(ValueError, match="mean_return must be a real number, got 'a'"):
        score(BAR, "a")
    assert score("CartPole-v1", 1.0) is None
