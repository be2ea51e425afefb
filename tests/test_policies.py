"""Policies of schema 2: with a memory, with several actions, with actions from lists, and plans."""

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from later_policies import EVERY, LISTED, LISTS, NET, OWN, PLAN, RANGES, UNIT, numbers
from rollouts import one_by_one

from lag_envs import register
from lag_envs.controllers.basic import Choice, Constant
from lag_envs.controllers.tracking import Tracking
from lag_envs.evaluation.conditions import often
from lag_envs.evaluation.rollout import play
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.alike import Likeness, check_twins
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.kernels import affine
from lag_envs.leaderboard.policies import ARCHITECTURES, SubmittedPolicy, architecture
from lag_envs.leaderboard.submission import Refused, load, write
from lag_envs.leaderboard.verify import record_again, verify
from lag_envs.scenes import TwoLinkArm
from lag_envs.tasks import TASKS, incline, pivoted_bar
from lag_envs.tasks.arm import Reach

BOARD = Board(Path(__file__).parents[1] / "leaderboard")
ABOUT = {"name": "An agent", "authors": ["A. Nobody"], "license": "MIT"}
TRAINING = {"env_steps": 1000, "seconds": 2.5, "hardware": "abacus"}
AHEAD = {"architecture": "mpc", "horizon": 25, "guesses": 4, "budget": 2_000}
BEAM = {"architecture": "mpc", "horizon": 20, "budget": 4_000}


@pytest.fixture(autouse=True)
def boards(monkeypatch):
    """Give the tasks above a board each."""
    for kind in OWN:
        monkeypatch.setitem(TASKS.data, kind.id, kind)
        register(kind)


def agent(env, policy, seed=0):
    return SubmittedPolicy(architecture(env, policy), numbers(env, policy, seed)).agent()


def submission(folder, env, policy, **changed):
    """Write five policies with a training, or one without."""
    given = ABOUT | {"env": env, "policy": policy}
    if policy["architecture"] in ("mlp", "gru"):
        given |= {"arrays": {seed: numbers(env, policy, seed) for seed in range(5)}, "training": TRAINING}
    elif "arrays" not in changed:
        given["arrays"] = {0: numbers(env, policy)}
    return write(folder, **(given | changed))


def seen(env, n, steps=6):
    """Return observations of random actions, shape (steps, n, n_observation)."""
    envs = gym.make_vec(env, n, vectorization_mode="sync")  # single ones are quicker to compile
    envs.action_space.seed(3)
    first, _ = envs.reset(seed=5)
    return np.array([first, *(envs.step(envs.action_space.sample())[0] for _ in range(steps - 1))])


@pytest.mark.parametrize(("env", "policy"), EVERY)
def test_each_row_for_itself_to_the_bit(env, policy):
    """Together as alone; an episode's first action does not depend on earlier episodes."""
    acting, observations = agent(env, policy), seen(env, 4)
    space, memory, together = gym.make(env).action_space, None, []
    for i, rows in enumerate(observations):
        start = np.array([i == 0, i == 0, i == 0, i in (0, 3)])
        actions, memory = acting.predict(rows, memory, start)
        assert all(space.contains(action) for action in actions)
        together.append(actions)
    for row in range(4):
        memory = None
        for i, rows in enumerate(observations):
            action, memory = acting.predict(rows[row], memory, np.array([i == 3 and row == 3]))
            assert np.array_equal(action, together[i][row])
    fresh = acting.predict(observations[3])[0]
    assert np.array_equal(fresh[3], together[3][3])


def test_the_unit_is_torchs():
    torch = pytest.importorskip("torch")
    policy = UNIT | {"hidden": [4], "activation": "relu"}
    arrays = numbers(incline.Tilt.id, policy)
    unit = torch.nn.GRU(4, 5, dtype=torch.float64)
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
    unit.load_state_dict({f"{name}_l0": tensors[name] for name in names})
    observations = seen(incline.Tilt.id, 3).astype(np.float64)
    with torch.no_grad():
        x, _ = unit(torch.from_numpy(observations))
        x = torch.relu(x @ tensors["weight_0"].T + tensors["bias_0"])
        wanted = torch.tanh(x @ tensors["weight_1"].T + tensors["bias_1"]).numpy()
    acting, memory = agent(incline.Tilt.id, policy), None
    for rows, expected in zip(observations, wanted, strict=True):
        actions, memory = acting.predict(rows, memory)
        np.testing.assert_allclose(actions, expected, atol=1e-6)
    assert np.ptp(wanted) > 1e-3


@pytest.mark.parametrize("padding", ["zero", "first"])
def test_frames_are_the_last_observations(padding):
    policy = {"architecture": "mlp", "hidden": [], "squash": "tanh", "frames": 3, "padding": padding}
    arrays = numbers(incline.Tilt.id, policy)
    observations = seen(incline.Tilt.id, 2).astype(np.float64)
    before = np.zeros_like(observations[:2]) if padding == "zero" else np.stack([observations[0]] * 2)
    padded = np.concatenate([before, observations])
    acting, memory = agent(incline.Tilt.id, policy), None
    for i, rows in enumerate(observations):
        actions, memory = acting.predict(rows, memory)
        stacked = np.concatenate(padded[i : i + 3], axis=1)
        wanted = np.tanh(affine(stacked, arrays["weight_0"].T.copy(), arrays["bias_0"]))
        assert np.array_equal(actions, wanted.astype(np.float32))
    with pytest.raises(ValueError, match=rf"takes rows of {stacked.shape[1]} numbers, got shape \(2, 3\)"):
        acting.predict(np.zeros((2, 1)))  # compiled code would read other numbers


def test_a_plan_is_followed_and_held():
    """Angles are compared the shorter way around; in the end the state of rest is held."""
    made = architecture(RANGES, {"architecture": "plan"})
    assert made.arrays["states"] == ("steps + 1", 4) and made.arrays["gains"] == ("steps", 2, 4)
    arrays = {
        "states": np.array([[0.0] * 4, [2.0 * math.pi, 0.0, 0.0, 0.0], [0.0] * 4]),
        "actions": np.array([[0.5, -0.25], [0.1, 0.2]]),
        "gains": np.array([[[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]], [[0.5, 0.0, 0.0, 0.0], [0.0] * 4]]),
        "rest": np.array([0.25, 0.0, 0.0, 0.0]),
        "hold": np.array([[2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 9.0]]),
    }
    names = TwoLinkArm().state_names
    assert names == ("theta_1", "theta_1_dot", "theta_2", "theta_2_dot")
    acting = SubmittedPolicy(made, arrays).agent()
    observation = np.array([math.cos(0.3), math.sin(0.3), 1.0, 0.0, 0.0, 0.15])
    told, memory = [], None
    for _ in range(4):
        action, memory = acting.predict(observation, memory)
        told.append(action.tolist())
    wanted = [[0.5 - 0.3, -0.25 - 0.15], [0.1 - 0.15, 0.2], [-0.1, -1.0], [-0.1, -1.0]]
    np.testing.assert_allclose(told, wanted, atol=1e-6)


def test_a_plan_does_what_the_controller_of_such_numbers_does(tmp_path):
    """Also where it acts ten times as often."""
    env = incline.Tilt.id
    tracking = Tracking(TASKS[env](), **numbers(env, PLAN))
    made = submission(tmp_path / "a", env, PLAN)
    assert made.kind == "controller"
    for options in ({}, often(env).options):
        submitted = made.policies[0][1].agent()
        assert np.array_equal(
            play(env, submitted, range(3), **options), play(env, tracking, range(3), **options)
        )


@pytest.mark.slow
@pytest.mark.parametrize("env", [LISTED, LISTS])
def test_listed_actions_go_through_the_board(env, tmp_path):
    """They are verified, replayed, and compared: one choice differs from another, however near."""
    policy = {"architecture": "mlp", "hidden": [4]}
    made = submission(tmp_path / "a", env, policy)
    result = verify(made, "nonce", 3)
    assert result["often"] and len(result["policies"][0]["returns"]) == 3
    told, episodes = record_again(made, result, 1, [2])
    assert told["returns"] == result["policies"][1]["returns"][2:]
    sizes = TASKS[env]().formulas.choices
    actions = np.reshape(episodes[0]["actions"], (-1, len(sizes)))
    assert (actions == actions.astype(int)).all() and (actions < sizes).all()
    other = submission(tmp_path / "b", env, {"architecture": "linear"})
    alike = Likeness(env, "nonce")
    assert alike(made, made, 1.0).actions == 0.0
    assert alike(other, made, 1e-9).actions > 0.05
    twins = {seed: numbers(env, policy, seed % 4) for seed in range(5)}
    twins[4]["bias_1"] += 1e-9
    with pytest.raises(Refused, match="seeds 0 and 4 act the same"):
        check_twins(submission(tmp_path / "c", env, policy, arrays=twins), "nonce")


def test_values_choose_among_listed_actions(tmp_path):
    axes = {"axis_0": np.array([-3.0, 3.0]), "table": np.array([-1e6, 1e6])}
    policy = {"architecture": "table", "kind": "value", "axes": ["s_dot"]}
    made = submission(tmp_path / "a", LISTED, policy, arrays={0: axes})
    assert made.kind == "optimal"
    observations = seen(LISTED, 3)[0]
    assert made.policies[0][1].agent().predict(observations)[0].tolist() == [2, 2, 2]
    axes["table"] = -axes["table"]
    opposite = submission(tmp_path / "b", LISTED, policy, arrays={0: axes}).policies[0][1].agent()
    assert opposite.predict(observations)[0].tolist() == [0, 0, 0]


def test_one_who_remembers_acts_at_one_interval(tmp_path):
    few = {"env": incline.Brake.id}
    result = verify(submission(tmp_path / "a", few["env"], UNIT), "nonce", 2)
    assert result["often"] == [None] * 5
    result = verify(submission(tmp_path / "b", few["env"], {"architecture": "plan"}), "nonce", 2)
    assert None not in result["often"]  # it knows the time
    assert not often(few["env"]).suits(agent(few["env"], UNIT), plans=False)


def test_one_who_plans_ahead_is_the_same_again(tmp_path):
    env = pivoted_bar.Balance.id
    policy = AHEAD | {"every": 5, "weights": {"theta": 100.0, "s": 10.0}, "rest": {"theta": math.pi}}
    made = submission(tmp_path / "a", env, policy, arrays=None)
    assert made.kind == "controller" and made.architecture.plans and made.architecture.schema == 2
    returns = [play(env, made.policies[0][1].agent(), range(4), duration=2.0) for _ in range(2)]
    assert (returns[0] == returns[1]).all() and returns[0].mean() > 80.0  # of 100


@pytest.mark.parametrize("env", [LISTED, pytest.param(LISTS, marks=pytest.mark.slow)])
def test_one_who_plans_among_listed_actions_is_the_same_again(tmp_path, env):
    policy = BEAM | {"every": 5, "energy": 1e-3, "cell": 0.3}
    made = submission(tmp_path / "a", env, policy, arrays=None)
    assert made.kind == "controller" and made.architecture.plans and made.architecture.schema == 2
    planner, count = made.policies[0][1].agent(), math.prod(TASKS[env]().formulas.choices)
    assert (planner.horizon, planner.every, planner.cell) == (20, 5, 0.3)
    assert planner.width == (4_000 // 20 - 1) // count
    taken, model = [], planner.model
    planner.model = lambda states, *given: taken.append(len(states)) or model(states, *given)
    planner.search(np.array([math.pi] * len(TASKS[env]().scene.state_names)))
    assert sum(taken) <= 4_000
    agents = *(made.policies[0][1].agent() for _ in range(2)), Choice(TASKS[env]())
    short = {"duration": 40 * TASKS[env].interval}
    # Single environments are quicker to compile than a batch.
    first, again, idle = (one_by_one(env, agent, [5], **short) for agent in agents)
    assert first == again > idle


@pytest.mark.slow
def test_one_who_plans_ahead_for_two_controls(tmp_path):
    env = Reach.id
    policy = AHEAD | {"horizon": 40, "every": 5, "iterations": 2, "budget": 20_000}
    made = submission(tmp_path / "a", env, policy, arrays=None)
    returns = [play(env, made.policies[0][1].agent(), range(3), duration=1.0) for _ in range(2)]
    assert (returns[0] == returns[1]).all() and returns[0].mean() > 25.0  # of 50
    # A final cost for another arm.
    agent = architecture(RANGES, AHEAD | {"weights": {"theta_1": 10.0, "theta_1_dot": 1.0}}).agent({})
    idle = play(RANGES, Constant([0.0, 0.0]), range(2))
    assert (play(RANGES, agent, range(2)) > idle + 10.0).all()


# --- hostile ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "policy", "reason"),
    [
        (incline.Tilt.id, NET | {"frames": 0}, "frames: Input should be greater"),
        (incline.Tilt.id, NET | {"frames": 65}, "frames: Input should be less"),
        (incline.Tilt.id, NET | {"frames": 2.0}, "frames: Input should be a valid int"),
        (incline.Tilt.id, NET | {"frames": True}, "frames: Input should be a valid int"),
        (incline.Tilt.id, NET | {"frames": 10**30}, "frames: Input should be"),
        (incline.Tilt.id, NET | {"padding": "first"}, "padding has no meaning without frames"),
        (incline.Tilt.id, NET | {"frames": 2, "padding": "last"}, "padding: Input should be 'zero'"),
        (incline.Tilt.id, NET | {"frames": 64, "hidden": [1024]}, "at most 131072"),
        (incline.Tilt.id, UNIT | {"memory": 0}, "memory: Input should be greater"),
        (incline.Tilt.id, UNIT | {"memory": 257}, "memory: Input should be less"),
        (incline.Tilt.id, UNIT | {"memory": [5]}, "memory: Input should be a valid int"),
        (incline.Tilt.id, UNIT | {"memory": 256, "hidden": [1024]}, "at most 131072"),
        (incline.Tilt.id, UNIT | {"frames": 2}, "frames is an unknown key"),
        (incline.Tilt.id, UNIT | {"layers": 2}, "layers is an unknown key"),
        (incline.Tilt.id, {"architecture": "gru", "memory": 3}, "squash or bins is missing"),
        (incline.Tilt.id, {"architecture": "gru", "squash": "clip"}, "memory is missing"),
        (incline.Tilt.id, {"architecture": "plan", "steps": 3}, "steps is an unknown key"),
        (LISTED, NET, "squash has no meaning where actions are listed"),
        (LISTED, {"architecture": "mlp", "hidden": [], "bins": 3}, "bins has no meaning where actions"),
        (LISTED, {"architecture": "plan"}, "plans are for actions in a range"),
        (LISTED, AHEAD, "guesses has no meaning where actions are listed; leave it out"),
        (LISTED, BEAM | {"seed": 0}, "seed has no meaning where actions are listed"),
        (LISTED, BEAM | {"budget": 79}, "with 3 actions needs a budget of at least 80 model steps, got 79"),
        (LISTED, BEAM | {"budget": 20_001, "every": 2}, "at most 10000 are allowed; shorten"),
        (LISTED, BEAM | {"weights": {"x": 1.0}}, "weights must name entries of the state, s, "),
        (LISTED, BEAM | {"cell": 0.0}, "cell: Input should be greater"),
        (incline.Tilt.id, AHEAD | {"energy": 1.0}, "energy has no meaning where actions lie in a range"),
        (incline.Tilt.id, AHEAD | {"horizon": 251}, "horizon: Input should be less"),
        (incline.Tilt.id, AHEAD | {"budget": 10**7}, "budget: Input should be less"),
        (incline.Tilt.id, AHEAD | {"weights": {"x": -1.0}}, "weights.x: Input should be greater"),
        (incline.Tilt.id, AHEAD | {"rest": {"depth": 1.0}}, "rest must name entries of the state, x, "),
        (incline.Tilt.id, AHEAD | {"horizon": 250, "iterations": 20}, "at most 10000 are allowed; shorten"),
        (LISTED, {"architecture": "table", "kind": "action", "axes": ["s"]}, 'kind must be "value"'),
        (LISTED, {"architecture": "table", "kind": "value", "axes": ["s"], "actions": 5}, "without actions"),
        (LISTS, {"architecture": "table", "kind": "value", "axes": ["theta_1"]}, "tasks with one control"),
        (RANGES, {"architecture": "lstm"}, "must be one of controller, gru, linear, mlp, mpc, plan"),
    ],
)  # fmt: skip
def test_tables_with_something_wrong(env, policy, reason):
    with pytest.raises(Refused, match=reason) as caught:
        architecture(env, policy)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("policy", "changed", "reason"),
    [
        (PLAN, {"states": np.zeros((9, 3))}, r"actions must have the shape \(8\), got \(9,\)"),
        (PLAN, {"states": np.zeros((10, 4))}, r"must have the shape \(10, 3\)"),
        (PLAN, {"actions": np.zeros((9, 1))}, "actions must have 1 axes"),
        (PLAN, {"gains": np.zeros((8, 3))}, r"gains must have the shape \(9, 3\)"),
        (PLAN, {"hold": np.zeros(2)}, r"hold must have the shape \(3\)"),
        (PLAN, {"rest": np.array([0.0, np.nan, 0.0])}, "rest has entries that are not finite"),
        (PLAN, {"states": np.zeros(0)}, "states must have 2 axes"),
        (PLAN, {"extra": np.zeros(1)}, "'extra' is not known"),
        (UNIT, {"weight_ih": np.zeros((5, 4))}, r"weight_ih must have the shape \(15, 4\)"),
        (UNIT, {"weight_hh": np.zeros((15, 5, 1))}, "weight_hh must have 2 axes"),
        (UNIT, {"bias_hh": np.full(15, np.inf)}, "bias_hh has entries that are not finite"),
        (UNIT, {"weight_0": None}, "'weight_0' is missing"),
        (UNIT | {"normalise": {}}, {"obs_var": np.full(4, -1.0)}, "obs_var must not be below 0"),
        (NET | {"frames": 3}, {"weight_0": np.zeros((3, 4))}, r"weight_0 must have the shape \(3, 12\)"),
        (NET | {"frames": 3, "normalise": {}}, {"obs_mean": np.zeros(4)}, r"must have the shape \(12\)"),
    ],
)  # fmt: skip
def test_arrays_with_something_wrong(tmp_path, policy, changed, reason):
    given = numbers(incline.Tilt.id, policy) | changed
    arrays = {seed: {k: v for k, v in given.items() if v is not None} for seed in range(5)}
    with pytest.raises(Refused, match=reason) as caught:
        submission(tmp_path / "a", incline.Tilt.id, policy, arrays=arrays)
    assert str(caught.value).isprintable() and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("env", "policy"),
    [
        (incline.Tilt.id, NET | {"frames": 2, "activation": "relu"}),
        (incline.Tilt.id, UNIT | {"squash": "clip", "hidden": [2], "activation": "relu"}),
        (incline.Tilt.id, {"architecture": "plan"}),
        (LISTED, {"architecture": "linear"}),
        (LISTS, {"architecture": "gru", "memory": 2, "hidden": [2], "activation": "relu"}),
    ],
)
def test_what_overflows_is_refused(env, policy, tmp_path):
    """Numbers so large that their products overflow: the verification says so, and does not fail."""
    arrays = {}
    for seed in range(5):
        rng = np.random.default_rng(seed)
        drawn = numbers(env, policy, seed)
        arrays[seed] = {name: 1e308 * rng.choice([-1.0, 1.0], array.shape) for name, array in drawn.items()}
    kept = arrays if policy["architecture"] in ("mlp", "gru") else {0: arrays[0]}
    made = submission(tmp_path / "a", env, policy, arrays=kept)
    with pytest.raises(Refused, match=r"policy of seed \d: it (fails with|returned an action that is not)"):
        verify(made, "nonce", 2)


# --- schemas ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("env", "policy"), EVERY)
def test_what_is_new_needs_the_new_schema(env, policy, tmp_path):
    submission(tmp_path / "a", env, policy)
    file = tmp_path / "a" / "submission.toml"
    text = file.read_text()
    assert "schema = 2\n" in text
    for old, reason in (("1", "this policy needs schema = 2, got 1"), ("3", "schema: Input should be less")):
        file.write_text(text.replace("schema = 2\n", f"schema = {old}\n"))
        with pytest.raises(Refused, match=reason):
            load(tmp_path / "a")


@pytest.mark.slow
def test_what_is_old_stays_what_it_is(tmp_path):
    """Everything on the board still has its digest; of schema 2 is only what needs it."""
    entries = BOARD.read().entries.values()
    assert len(entries) > 40
    listed = {env_id for env_id, task in TASKS.items() if task().formulas.choices}
    for entry in entries:
        found = load(BOARD.submission(entry.id))
        assert found.digest == entry.digest
        remembers = getattr(found.architecture, "frames", 1) > 1
        assert found.architecture.schema == 1 or found.env in listed or remembers
    assert protocol.SCHEMA == 2
    linear = {"gain": np.zeros(4), "offset": np.zeros(1)}
    policy = {"architecture": "linear"}
    made = write(tmp_path / "a", **ABOUT, env=incline.Tilt.id, policy=policy, arrays={0: linear})
    assert made.digest == "ddab848e5304c108efb6a573649fb3da4a0057fc820ce83b7728a6eec081f8ff"


@pytest.mark.parametrize("kind", ["mlp", "table", "controller"])
def test_old_policies_get_what_they_got(kind):
    """The first episodes of one of each architecture, to the bit, if the build is the same."""
    verified = (entry for entry in BOARD.read().entries.values() if entry.state == "verified")
    loaded = ((entry, load(BOARD.submission(entry.id))) for entry in verified)
    entry, found = next((e, s) for e, s in loaded if type(s.architecture) is ARCHITECTURES[kind])
    stored = BOARD.result(entry)
    for number, (_, policy) in enumerate(found.policies):
        first = protocol.first_seed(found.digest, stored["nonce"], number)
        returns = play(found.env, policy.agent(), range(first, first + 2))
        np.testing.assert_allclose(returns, stored["policies"][number]["returns"][:2], rtol=1e-9)


def test_every_architecture_of_schema_two_is_tested():
    new = {policy["architecture"] for policy in (*(policy for _, policy in EVERY), AHEAD)}
    assert new == {name for name in ARCHITECTURES if name not in ("table", "controller")}
    assert pivoted_bar.SwingUp.id in protocol.boards()
