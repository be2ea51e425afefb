"""Scenes and tasks outside the package: written by name, with everything that the package's own have."""

import copy
import math
import pickle
from pathlib import Path
from types import SimpleNamespace

import cloudpickle
import gymnasium as gym
import numpy as np
import own_tasks
import pytest
from batches import assert_alike, assert_same, pair
from contract_scenes import Along, Bead
from covering import slow
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from own_tasks import mistaken
from rollouts import RENDERS

import lag_envs
from lag_envs.envs.single import LagrangianEnv
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes import Scene, StepRefused, parameter
from lag_envs.stepping.compiling import BLOCK
from lag_envs.tasks import Task, pivoted_bar

IDS = [task.id for task in own_tasks.TASKS]
EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(autouse=True)
def registered():
    for task in own_tasks.TASKS:
        lag_envs.register(task)


@pytest.mark.parametrize("id", IDS)
def test_gymnasium_checker(id):
    check_env(gym.make(id).unwrapped, skip_render_check=not RENDERS)


@pytest.mark.parametrize("id", [slow(IDS[0]), *IDS[1:]])
@pytest.mark.parametrize("n", [3, slow(70)])
def test_vector_is_single(id, n):
    native, single = pair(id, n)
    assert_same(native.reset(seed=5), single.reset(seed=5))
    ends = assert_alike(native, single, 200 if n == 3 else 30)
    assert ends or n != 3


def test_simulate_is_step():
    env = gym.make("OwnCrane-v0", rail_drag=0.0).unwrapped
    env.reset(seed=3)
    env.action_space.seed(0)
    states, controls = [env.state], []
    for _ in range(5):
        before = env.state
        env.step(env.action_space.sample())
        controls.append(env.control)
        states.append(env.scene.simulate(before, [env.control], env.task.dt)[1])
        kicked = env.state
        # The kick comes after the held step, and changes rates only.
        assert kicked[:1] == states[-1][:1] and kicked[2] == states[-1][2]
    assert np.shape(controls) == (5, 2)


@pytest.mark.slow
def test_numbers_of_a_batch_may_differ_zero_among_them():
    drags = [0.0, 0.3, 2.0]
    native = gym.make_vec("OwnCrane-v0", num_envs=3, rope_drag=drags, load_mass=[0.5, 1.0, 2.0])
    single = [
        gym.make("OwnCrane-v0", rope_drag=d, load_mass=m) for d, m in zip(drags, [0.5, 1.0, 2.0], strict=True)
    ]
    seen = [native.reset(seed=7)[0]], [np.stack([e.reset(seed=7 + i)[0] for i, e in enumerate(single)])]
    native.action_space.seed(2)
    for _ in range(8):
        actions = native.action_space.sample()
        seen[0].append(native.step(actions)[0])
        seen[1].append(np.stack([e.step(a)[0] for e, a in zip(single, actions, strict=True)]))
    np.testing.assert_array_equal(*seen)


def test_structure_of_a_batch_must_agree():
    with pytest.raises(ValueError, match="agree"):
        gym.make_vec("OwnSwitched-v0", num_envs=2, bars=[3, 4])


class Stacked(Along):
    """A pile of masses on a rail; how many there are is structural, and the tuple may hold anything."""

    id = "OwnStacked-v0"
    action = {"push": 1.0}

    class scene(Bead):
        masses: tuple = (1.0, 2.0)
        controls = {"push": "N"}

        def kinetic(self, q, v, xp):
            return 0.5 * sum(self.masses) * v.x**2

        def applied(self, q, v, u, xp):
            return {"x": u.push}


@pytest.mark.parametrize("given", [(1.0, 4.0), [1.0, 4.0], (1.0, 4.0, 3.0), ()])
@pytest.mark.parametrize("n", [1, 2])
def test_a_field_that_is_a_tuple(n, given):
    if not given:
        with pytest.raises(FormulaError, match="does not contain the rate of 'x'"):
            gym.make_vec(lag_envs.register(Stacked), num_envs=n, masses=given)
        return
    env = gym.make(lag_envs.register(Stacked), masses=given)
    vec = gym.make_vec(Stacked.id, num_envs=n, masses=given)
    each = gym.make_vec(Stacked.id, num_envs=n, masses=[given] * n)
    copies = (
        gym.make(EnvSpec.from_json(env.spec.to_json())),
        gym.make_vec(EnvSpec.from_json(vec.spec.to_json())),
    )
    for other in (env, vec, each, *copies):
        assert other.unwrapped.scene.masses == tuple(given)
    with pytest.raises(ValueError, match="must agree in structural options"):
        gym.make_vec(Stacked.id, num_envs=2, masses=[given, (1.0, 7.0)])


def test_targets():
    env = gym.make("OwnCrane-v0", target={"x_goal": 0.4, "y_goal": -1.4}).unwrapped
    env.reset(seed=1)
    np.testing.assert_array_equal(env.target, [0.4, -1.4])
    env = gym.make("OwnCrane-v0").unwrapped
    env.reset(seed=1, options={"target": [0.1, -1.3]})
    np.testing.assert_array_equal(env.target, [0.1, -1.3])
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for seed in range(200):
        env.reset(seed=seed)
        low, high = np.minimum(low, env.target), np.maximum(high, env.target)
    assert -1.0 <= low[0] < -0.9 < 0.9 < high[0] <= 1.0
    assert -1.8 <= low[1] < -1.75 < -1.25 < high[1] <= -1.2
    vec = gym.make_vec("OwnCrane-v0", num_envs=2)
    vec.reset(seed=0, options={"target": [[0.1, -1.3], [0.2, -1.4]]})
    np.testing.assert_array_equal(vec.unwrapped.target, [[0.1, -1.3], [0.2, -1.4]])
    vec.reset(seed=0, options={"target": {"x_goal": 0.3, "y_goal": [-1.3, -1.4]}})
    np.testing.assert_array_equal(vec.unwrapped.target, [[0.3, -1.3], [0.3, -1.4]])
    vec.reset(seed=0, options={"target": {"x_goal": np.array([0.1, 0.2]), "y_goal": np.array(-1.5)}})
    np.testing.assert_array_equal(vec.unwrapped.target, [[0.1, -1.5], [0.2, -1.5]])
    told = r"options\['target'\]\['y_goal'\] must be one number or have shape \(2,\), got shape \(1,\)"
    with pytest.raises(ValueError, match=told):
        vec.reset(options={"target": {"x_goal": 0.3, "y_goal": [-1.3]}})


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("one", [[0.4, -1.4], np.array([0.4, -1.4]), {"x_goal": 0.4, "y_goal": -1.4}])
def test_a_target_for_all_of_a_batch(n, one):
    vec = gym.make_vec("OwnCrane-v0", num_envs=n, target=one)
    vec.reset(seed=1)
    np.testing.assert_array_equal(vec.unwrapped.target, [[0.4, -1.4]] * n)
    vec = gym.make_vec("OwnCrane-v0", num_envs=n, target=[[0.4, -1.4]] * n)
    vec.reset(seed=1)
    np.testing.assert_array_equal(vec.unwrapped.target, [[0.4, -1.4]] * n)


def test_a_start_from_which_the_episode_would_be_over():
    over, good = [2.5, 0, 1, 0, 0, 0], [0, 0, 1, 0, 0, 0]
    env, vec = gym.make("OwnCrane-v0").unwrapped, gym.make_vec("OwnCrane-v0", num_envs=2).unwrapped
    wanted = "the episode would be over at x=2.5, x_dot=0, rope=1, "
    with pytest.raises(ValueError, match=wanted):
        env.reset(options={"state": over})
    with pytest.raises(ValueError, match=f"environment 1: {wanted}"):
        vec.reset(options={"state": [good, over]})
    # Whether this one is over depends on the target, which the first step knows.
    near = mistaken(terminated=lambda self, after, target, xp: xp.abs(after.x - target.x_goal) > 1.0)()
    np.testing.assert_array_equal(near.start_state(over), over)
    inside = mistaken(terminated=lambda self, after, target, xp: ~(xp.abs(after.x) < 2.0))()
    np.testing.assert_array_equal(inside.start_state(good), good)
    with pytest.raises(ValueError, match=wanted):
        inside.start_state(over)


@pytest.mark.parametrize("target", [0.5, [0.5], [0.5, 1.0, 2.0], "far", [["a"]], [[0.1], [0.2, 0.3]]])
def test_bad_targets(target):
    wanted = (
        r"target must be 2 numbers \(x_goal, y_goal\), or a mapping of these names, got|real numbers, got"
    )
    for make in (gym.make, gym.make_vec):
        with pytest.raises(ValueError, match=f"{wanted}|one per environment, got"):
            make("OwnCrane-v0", target=target)
    vec = gym.make_vec("OwnCrane-v0", num_envs=2)
    for given in (target, {"x_goal": target}, {"x_goal": target, "y_goal": [0.1, 0.2, 0.3]}):
        with pytest.raises(ValueError, match=r"options\['target'\]|target must give x_goal, y_goal, got"):
            vec.reset(options={"target": given})


def test_targets_and_angles_that_no_observation_can_show():
    env = gym.make("OwnCrane-v0")
    with pytest.raises(ValueError, match=r"target y_goal must lie within ±3.4e\+38, .* got 1e\+39"):
        env.reset(options={"target": [0.0, 1e39]})
    with pytest.raises(
        ValueError, match=r"swing must lie within ±2.6e\+07 rad, got 3e\+07 rad; subtract whole"
    ):
        env.reset(options={"state": [0, 0, 1, 0, 3e7, 0]})


def test_reward_scales_with_dt():
    rewards = []
    for dt in (0.05, 0.025):
        env = gym.make("OwnCrane-v0", dt=dt).unwrapped
        env.reset(seed=0, options={"state": [0, 0, 1, 0, 0, 0], "target": [0, -1]})
        rewards.append(env.step(np.array([0.0, -0.019], np.float32))[1])
    assert rewards[0] == pytest.approx(2 * rewards[1], rel=1e-2)


def test_discrete_actions():
    env = gym.make("OwnSwitched-v0").unwrapped
    assert env.action_space == gym.spaces.Discrete(3)
    env.reset(seed=0)
    for action, control in ((0, -5.0), (1, 0.0), (2, 5.0), (np.int64(2), 5.0)):
        env.step(action)
        assert env.control == control
    for wrong in (3, -1, 0.5, [1], True, None):
        with pytest.raises(ValueError, match="action"):
            env.step(wrong)


@pytest.mark.parametrize("values", [np.array([-1.0, 0.0, 2.0]), range(-1, 3)])
def test_listed_actions_may_be_an_array_or_a_range(values):
    task = mistaken(action={"push": values, "pull": [0.0, 1.0]})()
    assert task.formulas.acting[0].values == tuple(map(float, values))
    assert task.formulas.choices == (len(values), 2)


@pytest.mark.parametrize("action", [[0.1], [0.1, 0.2, 0.3], [0.1, np.nan], ["a", "b"], None, [[0.1, 0.2]]])
def test_bad_actions(action):
    env = gym.make("OwnCrane-v0").unwrapped
    env.reset(seed=0)
    before = env.state
    with pytest.raises(ValueError, match="action"):
        env.step(action)
    np.testing.assert_array_equal(env.state, before)


# Without rope the mass matrix is singular: at the start, or after some substeps.
@pytest.mark.parametrize(
    ("wild", "why"),
    [
        slow(
            [0, 0, 0, 0, 0.3, 1],
            "the mass matrix of x, rope, swing is not positive definite there; choose other",
        ),
        ([0, 0, 0.2, -10, 0, 0], "take a smaller dt .* near a singular configuration, other coordinates"),
    ],
)
def test_refused_step_keeps_the_state(wild, why):
    Slack = type("Slack", (own_tasks.Deliver,), {"id": "OwnSlack-v0", "terminated": Task.terminated})
    env = gym.make(lag_envs.register(Slack)).unwrapped
    env.reset(seed=0, options={"state": wild})
    before = env.state
    with pytest.raises(StepRefused, match=why):
        env.step(np.zeros(2, np.float32))
    np.testing.assert_array_equal(env.state, before)
    vec = gym.make_vec(Slack.id, num_envs=3)
    calm = [0, 0, 1, 0, 0.1, 0]
    vec.reset(seed=0, options={"state": [calm, wild, calm]})
    with pytest.raises(StepRefused, match=why) as refusal:
        vec.step(np.zeros((3, 2), np.float32))
    states = vec.unwrapped.state
    np.testing.assert_array_equal(states[1], wild)
    np.testing.assert_array_equal(states[0], env.scene.simulate(calm, [vec.unwrapped.control[0]], 0.05)[1])
    assert np.isfinite(refusal.value.results[1][[0, 2]]).all()


@pytest.mark.parametrize("place", [0.0, -1.0])
def test_refusal_where_a_formula_has_no_value(place):
    class Uphill(Bead):
        def potential(self, q, xp):
            return xp.sqrt(q.x)

    with pytest.raises(
        StepRefused, match=r"the acceleration there is not finite; .* end or reset the episode"
    ):
        Uphill().simulate([place, 0.0], 1, 0.02)


def test_the_motion_of_a_logarithm_is_that_of_the_size():
    """As docs/tutorial.md says: the equation of motion has its derivative only."""

    class Charge(Bead):
        def potential(self, q, xp):
            return -xp.log(q.x)

    scene = Charge()
    np.testing.assert_array_equal(scene.simulate([-1.0, 0.1], 5, 0.1), -scene.simulate([1.0, -0.1], 5, 0.1))
    assert np.isnan(scene.energy([-1.0, 0.1])["total"])


@pytest.mark.parametrize("kind", [own_tasks.Deliver, pivoted_bar.SwingUp])
def test_refusal_after_a_kick_that_is_no_number(kind):
    def kick(self, after, draws, xp):
        return {self.scene.state_names[-1]: xp.log(draws[0] - 2.0)}

    torn = {"id": "OwnTorn-v0", "draws": 1, "kick": kick, "terminated": Task.terminated}
    env = gym.make(lag_envs.register(type("Torn", (kind,), torn)), disable_env_checker=True)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    with pytest.raises(StepRefused, match="the state is not finite; reset the episode"):
        env.step(env.action_space.sample())


@pytest.mark.parametrize(
    ("kind", "imperfections"),
    [
        (own_tasks.Deliver, {}),
        slow(own_tasks.Deliver, {"lag": 0.05}),
        slow(pivoted_bar.SwingUp, {}),
        slow(pivoted_bar.SwingUp, {"lag": 0.05}),
    ],
)
def test_refusal_after_a_guard_that_is_no_number(kind, imperfections):
    def guard(self, wanted, before, dt, xp):
        name = self.scene.control_names[-1]
        return {name: wanted[name] + xp.log(before[0])}

    torn = {"id": "OwnTornGuard-v0", "guard": guard, "terminated": Task.terminated}
    vec = gym.make_vec(lag_envs.register(type("Torn", (kind,), torn)), num_envs=3, **imperfections)
    vec.reset(seed=0)
    state = vec.unwrapped.state
    state[:, 0] = 0.1, -0.1, 0.2
    vec.reset(options={"state": state})
    message = "the step of environment 1 .*=nan .* the control is not finite; if the task has a guard"
    with pytest.raises(StepRefused, match=message) as refusal:
        vec.step(np.zeros(vec.action_space.shape, np.float32))
    assert np.isfinite(refusal.value.results[1][[0, 2]]).all()


@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_reward_of_nan_is_no_refusal(num_threads):
    class Logarithmic(own_tasks.Deliver):
        id = "OwnLogarithmic-v0"
        terminated = Task.terminated

        def reward(self, before, after, control, target, dt, xp):
            return xp.log(after.x)

    n = 2 * BLOCK
    starts = np.tile([0.0, 0.0, 1.0, 0.0, 0.1, 0.0], (n, 1))
    starts[:, 0] = np.where(np.arange(n) % 3, 1.0, -1.0)
    refused = np.isin(np.arange(n), [1, n - 1])
    starts[refused] = [1.0, 0.0, 0.2, -10.0, 0.0, 0.0]  # the rope runs out
    vec = LagrangianVectorEnv(Logarithmic, n, num_threads=num_threads)
    vec.reset(seed=0, options={"state": starts})
    with pytest.raises(StepRefused, match=rf"environment 1 \(like those of {n - 1};") as error:
        vec.step(np.zeros((n, 2), np.float32))
    rewards = error.value.results[1]
    assert np.array_equal(error.value.results[-1]["refused"], refused)
    assert np.array_equal(np.isnan(rewards), (starts[:, 0] < 0.0) & ~refused)
    assert (rewards[refused] == 0.0).all()


@pytest.mark.parametrize("dump", [pickle, cloudpickle], ids=["pickle", "cloudpickle"])
@pytest.mark.parametrize("id", IDS)
def test_copies_go_on_alike(id, dump):
    env = gym.make(id).unwrapped
    env.reset(seed=2)
    env.action_space.seed(0)
    twins = [dump.loads(dump.dumps(env)), copy.deepcopy(env), copy.copy(env)]
    action = env.action_space.sample()
    expected = env.step(action)
    for twin in twins:
        np.testing.assert_array_equal(twin.step(action)[0], expected[0])


def test_class_that_only_a_notebook_knows():
    def cell(gain):
        class Lean(Task):
            id = "OwnNotebook-v0"
            scene = own_tasks.Crane
            action = {"push": 1.0, "pull": 1.0}
            start = {"rope": (1.0, 0.0)}

            def observe(self, after, target, xp):
                return {"x": after.x}

            def reward(self, before, after, control, target, dt, xp):
                return gain * after.rope

        return Lean

    found = []
    for gain in (1.0, 3.0):  # the cell is run again with another formula
        lag_envs.register(cell(gain))
        env = gym.make("OwnNotebook-v0").unwrapped
        env.reset(seed=0)
        found.append(env.step(np.zeros(2, np.float32))[1])
        del gym.registry["OwnNotebook-v0"]
    assert found[1] == pytest.approx(3.0 * found[0])


class Hoist(Scene):
    """A bead and a weight; formulas take places and velocities by index, and one coordinate rests."""

    ceiling: float = parameter(2.0, "m")

    coordinates = {"x": "m", "y": "m"}
    prescribed = {"lift": "m", "s": "m"}
    controls = {"s_ddot": "m/s²"}

    def rests(self):
        return {"lift": 3.0 * self.ceiling}

    def kinetic(self, q, v, xp):
        x_dot, y_dot, lift_dot, s_dot = v
        return x_dot**2 + 2.0 * y_dot**2 + 3.0 * s_dot**2 + 5.0 * lift_dot**2

    def potential(self, q, xp):
        return q[0] ** 2 + 10.0 * q[1] ** 2 + 100.0 * q[2] + 0.5 * q[0] * q[3]

    def poses(self, q, xp):
        x, y, lift, s = q
        return {"bead": (x + s, y + lift, 0.0)}


@pytest.mark.parametrize("places", ["after", "after.q"])
def test_places_and_velocities_of_a_task_are_in_the_order_of_energies(places):
    class Hang(Task):
        scene = Hoist
        action = {"s_ddot": 1.0}

        def observe(self, after, target, xp):
            at = after if places == "after" else after.q
            x, y, _ = self.scene.poses(at, xp)["bead"]
            potential = self.scene.potential(at, xp=xp)
            return {"T": self.scene.kinetic(at, after.v, xp), "V": potential, "x": x, "y": y}

        def reward(self, before, after, control, target, dt, xp):
            return self.scene.potential(after, xp) - after.q.lift - after.v.lift

        def reached(self, after, target, xp):
            return self.scene.potential(after, xp) > 700.0

        def terminated(self, after, target, xp):
            return self.scene.potential(after, xp) > 700.0

    state = [0.1, 2.0, 0.3, 5.0, 0.2, 0.7]
    for ceiling, over in ((2.0, False), (2.5, True)):
        task = Hang(ceiling=ceiling)
        energy = task.scene.energy(state)
        seen = task.formulas.observe(np, state, [], SimpleNamespace(**task.formulas.constants()))
        expected = [energy["kinetic"], energy["potential"], 0.3 + 0.1, 0.2 + 3.0 * ceiling]
        assert task.scene.state_names == ("s", "s_dot", "x", "x_dot", "y", "y_dot")
        assert seen == pytest.approx(expected, rel=1e-15)
        assert task.goal_holds([state]).tolist() == [over]
        env = LagrangianEnv(Hang, ceiling=ceiling)
        if over:
            with pytest.raises(ValueError, match="the episode would be over"):
                env.reset(options={"state": state})
            continue
        env.reset(options={"state": state})
        _, reward, *_ = env.step([0.3])
        expected = env.scene.energy(env.state)["potential"] - 3.0 * ceiling
        assert reward == pytest.approx(expected, rel=1e-15)


def test_a_start_as_fast_as_those_of_episodes_is_accepted():
    class Thrown(own_tasks.Deliver):
        start = {"x_dot": (-300.0, 5.0), "rope": (1.0, 0.1)}

    env = LagrangianEnv(Thrown)
    env.reset(seed=0)
    env.reset(options={"state": env.state})
    with pytest.raises(ValueError, match=r"within ±305 m/s at the start, got 306 m/s; .* `start` reaches"):
        env.reset(options={"state": [0.0, 306.0, 1.0, 0.0, 0.0, 0.0]})


def test_a_keyword_of_ones_own_stays_where_parameters_are_drawn():
    class Bonus(own_tasks.Deliver):
        id = ""

        def __init__(self, bonus, **keywords):
            self.bonus = bonus
            super().__init__(**keywords)

        def reward(self, before, after, control, target, dt, xp):
            return self.bonus

    envs = [
        LagrangianEnv(Bonus, bonus=7.0, **drawn) for drawn in ({}, {"randomize": {"load_mass": (0.5, 2.0)}})
    ]
    for env in envs:
        env.reset(seed=0)
        assert env.step(env.action_space.sample())[1] == 7.0
        assert env.drawn_task.bonus == 7.0
    assert Bonus(3.0, load_mass=0.5).varied(load_mass=0.4).scene.load_mass == 0.4


@pytest.mark.parametrize(
    "potential",
    [
        lambda self, q, xp: (q.x - self.length) ** 2,
        lambda self, q, xp: xp.cos(q.x - self.length) + (q.x - q.y - self.length) ** 4,
        lambda self, q, xp: (xp.sqrt(1.0 + q.x**2 + q.y**2) - self.length) ** 2,
    ],
)
def test_a_length_that_is_zero_in_part_of_a_batch(potential):
    """Nothing divides by it, so it is a number like others."""

    class Beads(Scene):
        length: float = parameter(0.1, "m")
        coordinates = {"x": "m", "y": "m"}
        controls = {"force": "N"}

        def kinetic(self, q, v, xp):
            return 0.5 * (1.0 + (q.y + self.length) ** 2) * v.x**2 + v.y**2

        def dissipation(self, q, v, u, xp):
            return 0.1 * (1.0 + (q.x - self.length) ** 2) * v.x**2

        def applied(self, q, v, u, xp):
            return {"x": u.force}

    Beads.potential = potential

    class Shift(Along):
        id = "OwnShift-v0"
        scene = Beads
        action = {"force": 1.0}
        start = {"x": 0.3, "y": 0.2}

    envs = LagrangianVectorEnv(Shift, 2, length=np.array([0.0, 0.1]))
    singles = [LagrangianEnv(Shift, length=length) for length in (0.0, 0.1)]
    envs.reset(seed=3)
    for i, env in enumerate(singles):
        env.reset(seed=3 + i)
    for _ in range(5):
        envs.step(np.ones((2, 1), np.float32))
        for i, env in enumerate(singles):
            env.step(np.ones(1, np.float32))
            assert envs.state[i] == pytest.approx(env.state, rel=1e-13, abs=1e-14)


def test_comparisons_count_as_one_and_zero():
    class Counted(own_tasks.Deliver):
        id = "OwnCounted-v0"

        def reward(self, before, after, control, target, dt, xp):
            return 2.0 * (after.x > 0.0) - (after.x <= 0.0) + (xp.abs(after.x) < 10.0)

    class Bare(Counted):
        id, scaled = "OwnBare-v0", False

        def reward(self, before, after, control, target, dt, xp):
            return after.x > 0.0

    for kind, expected in ((Counted, {True: 3.0, False: 0.0}), (Bare, {True: 1.0, False: 0.0})):
        env = gym.make(lag_envs.register(kind))
        for seed in range(6):
            env.reset(seed=seed)
            reward = env.step(env.action_space.sample())[1]
            assert reward == expected[bool(env.unwrapped.state[0] > 0.0)]


@pytest.mark.parametrize(("id", "scaled"), [("OwnEndless-v0", True), ("OwnEndless-v1", False)])
def test_a_reward_may_be_infinite(id, scaled):
    kind = mistaken(reward=lambda *_: -math.inf, scaled=scaled)
    env = gym.make(lag_envs.register(kind, id=id), disable_env_checker=True)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[1] == -math.inf


def test_changed_numbers_are_used():
    """Numbers that formulas find elsewhere, as in a notebook whose cells are run again."""
    table = {"bonus": 1.0}

    class Weighed(own_tasks.Deliver):
        id, weights = "OwnWeighed-v0", (1.0, 10.0)

        def check(self):
            self.path = np.zeros(2000)
            self.path[1000] = self.scene.load_mass

        def reward(self, before, after, control, target, dt, xp):
            return self.weights[0] + self.weights[1] + 100.0 * table["bonus"] + 1e3 * self.path[1000]

    spec = lag_envs.register(Weighed)

    def reward(**parameters):
        env = gym.make(spec, **parameters)
        env.reset(seed=0)
        return env.step(env.action_space.sample())[1]

    assert reward(load_mass=1.0) == 1111.0
    assert reward(load_mass=2.0) == 2111.0
    Weighed.weights = (2.0, 10.0)
    assert reward(load_mass=1.0) == 1112.0
    table["bonus"] = 2.0
    assert reward(load_mass=1.0) == 1212.0
    with pytest.raises(ValueError, match=r"the formulas of Weighed differ .* from self.scene"):
        gym.make_vec(spec, num_envs=2, load_mass=[1.0, 2.0])


def test_order_of_a_task():
    """It belongs to the environment and its scene, also in a copy; every step is certified with it."""
    task = type("Calm", (own_tasks.Switched,), {"order": 10, "id": "OwnCalm-v0"})
    lag_envs.register(task)
    env = gym.make("OwnCalm-v0").unwrapped
    copied = copy.deepcopy(env)
    for one in (env, copied):
        one.reset(seed=2)
        assert one.scene.step_bound(one.state, one.control, one.task.dt).order == 10
    for _ in range(5):
        before = env.state
        for one in (env, copied):
            one.step(env.action_space.sample() * 0 + 1)
        np.testing.assert_array_equal(env.state, copied.state)
        after = env.scene.simulate(before, [env.control], env.task.dt)[-1]
        np.testing.assert_array_equal(env.state, after)
    for order in (5, 25, 10.0, True):
        with pytest.raises(ValueError, match="order must be a whole number from 6 to 24"):
            type("Wrong", (own_tasks.Deliver,), {"order": order})()


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("wind", ""),
        ("lod_mass", "did you mean load_mass"),
        ("num_envs", "gym.make_vec makes many; "),
        ("steps", r"for another length of episodes, give duration \[s\]; "),
        ("interval", "for another control interval, give dt; "),
    ],
)
def test_unknown_keyword(name, meant):
    takes = "this environment takes gravity, load_mass, .*, target, .*, render_mode, diagnostics"
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'; {meant}.*{takes}"):
        gym.make("OwnCrane-v0", **{name: 1.0})


def test_example(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    env = gym.make("ball_on_beam:BallOnBeam-v0", render_mode="rgb_array" if RENDERS else None)
    check_env(env.unwrapped, skip_render_check=not RENDERS)
    scene = env.unwrapped.scene
    before = scene.energy([0.2, 0.0, 0.3, 0.0])["total"]
    after = scene.energy(type(scene)(friction=0.0).simulate([0.2, 0.0, 0.3, 0.0], np.zeros(50), 0.02)[-1])[
        "total"
    ]
    assert after == pytest.approx(before, abs=1e-14)


def test_a_friction_that_is_zero_in_part_of_a_batch():
    """The certificate then covers a friction that does not act, so substeps and roundings may differ."""

    class Sled(Scene):
        friction: float = parameter(1.0, "N", least=0.0)
        coordinates = {"x": "m", "a": "rad"}
        controls = {"force": "N"}

        def kinetic(self, q, v, xp):
            return v.x**2 + 0.1 * v.a**2 + 0.2 * v.x * v.a * xp.cos(q.a)

        def potential(self, q, xp):
            return -2.0 * xp.cos(q.a)

        def applied(self, q, v, u, xp):
            return {"x": u.force - self.friction * xp.tanh(v.x / 0.02)}

    class Slide(Along):
        id = "OwnSlide-v0"
        scene = Sled
        interval, steps = 0.05, 100
        action = {"force": 8.0}
        start = {"a": 1.0, "x_dot": 0.5}

    envs = LagrangianVectorEnv(Slide, 2, friction=np.array([0.0, 1.0]))
    ones = [LagrangianEnv(Slide, friction=friction) for friction in (0.0, 1.0)]
    envs.reset(seed=3)
    for i, env in enumerate(ones):
        env.reset(seed=3 + i)
    envs.action_space.seed(0)
    for _ in range(20):
        actions = envs.action_space.sample()
        envs.step(actions)
        for env, action in zip(ones, actions, strict=True):
            env.step(action)
        assert envs.state[1].tobytes() == ones[1].state.tobytes()
        np.testing.assert_allclose(envs.state[0], ones[0].state, rtol=1e-12, atol=1e-12)
