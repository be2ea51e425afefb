"""Hidden parameters, imperfect sensors and actuators, in the single and in the vector environment."""

from __future__ import annotations

import math
from bisect import bisect
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import own_tasks
import pytest
from batches import ALL, ID, played
from covering import slow

import lag_envs
from lag_envs import replay
from lag_envs.envs import program as program_module
from lag_envs.envs.imperfect.constants import constants_of
from lag_envs.envs.imperfect.draws import PURPOSES
from lag_envs.envs.imperfect.programs import program_of
from lag_envs.envs.imperfect.whole import WholeProgram
from lag_envs.envs.program import BLOCK, Program
from lag_envs.envs.unfused import Unfused
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.leaderboard.site import driving
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes.checks import StepRefused
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping.compiling import absent_from
from lag_envs.stepping.primitives import episode_key, uniform
from lag_envs.tasks import TASKS, Task, pivoted_bar
from lag_envs.tasks.imperfections import KEYWORDS, LARGEST_NORMAL, MARGIN
from lag_envs.tasks.registration import make_task


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_all_together_single_and_vector(mode):
    seen, envs = played(ID, 3, 70, mode, duration=0.5, **ALL)
    assert len(np.unique(seen[:, :, 2])) > 50 and set(envs.unwrapped.parameters) == set(ALL["randomize"])


#: The same without what divides steps.
WHOLE = ALL | {"observation_delay": 0.04, "action_delay": 0.06}


@pytest.mark.parametrize(
    ("mode", "lag"),
    [slow("NextStep", 0.01), slow("SameStep", 0.01), slow("NextStep", None), slow("SameStep", None)],
)
def test_what_divides_no_step_single_and_vector(mode, lag):
    _, envs = played(ID, 3, 70, mode, duration=0.5, **WHOLE | {"lag": lag})
    assert type(envs.unwrapped._program) is WholeProgram


@pytest.mark.slow
def test_every_place_in_a_batch_has_the_same_bits():
    lanes, count = [0, 3, BLOCK - 2, BLOCK - 1, BLOCK, BLOCK + 57], BLOCK + 58
    many = gym.make_vec(ID, num_envs=count, duration=0.4, **WHOLE)
    few = gym.make_vec(ID, num_envs=len(lanes), duration=0.4, **WHOLE)
    assert np.array_equal(many.reset(seed=5)[0][lanes], few.reset(seed=[5 + i for i in lanes])[0])
    many.action_space.seed(0)
    for step in range(60):
        actions = many.action_space.sample()
        for a, b in zip(many.step(actions)[:4], few.step(actions[lanes])[:4], strict=True):
            assert np.array_equal(a[lanes], b)
        if step == 30:
            mask = np.arange(count) % 3 == 0
            a = many.reset(options={"reset_mask": mask})[0]
            assert np.array_equal(a[lanes], few.reset(options={"reset_mask": mask[lanes]})[0])


@pytest.mark.slow
def test_a_refused_step_changes_no_command_and_no_reading():
    # Without rope the crane's mass matrix is singular.
    endless = {"id": "OwnSlack-v0", "terminated": Task.terminated}
    spec = lag_envs.register(type("Slack", (own_tasks.Deliver,), endless))
    keywords = {"observation_noise": 0.1, "observation_every": 2, "slew": 50.0}
    envs = gym.make_vec(spec, num_envs=3, **keywords).unwrapped
    calm, wild = [0, 0, 1, 0, 0.1, 0], [0, 0, 0, 0, 0.3, 1]
    shown, _ = envs.reset(seed=0, options={"state": [calm, wild, calm]})
    before = envs.get_state().rows
    with pytest.raises(StepRefused) as refusal:
        envs.step(np.ones((3, 2), np.float32))
    after = envs.get_state().rows
    for name in ("n", "c0", "c1", "h0", "h1"):
        assert after[name][1] == before[name][1]
    assert after["c0"][0] > 0.0 and (after["n"] == [1, 0, 1]).all()
    assert np.array_equal(refusal.value.results[0][1], shown[1])
    envs.reset(seed=0, options={"state": [calm] * 3})
    envs.step(np.ones((3, 2), np.float32))
    rows = envs.get_state().rows
    assert all((rows[name][[0, 2]] == after[name][[0, 2]]).all() for name in rows)


SINGLE = [{name: value} for name, value in ALL.items()] + [
    {"action_delay": 0.04},
    {"action_delay": 0.033},
    {"observation_delay": 0.04},
    {"action_delay": 0.013, "observation_delay": 0.05, "observation_noise": 0.1},
    {"observation_delay": (0.0, 0.015), "observation_every": 2, "lag": 0.02},
    {"action_delay": (0.0, 0.05), "observation_delay": (0.02, 0.08), "observation_noise": 0.01},
]


@pytest.mark.parametrize("keywords", [*map(slow, SINGLE), {"observation_delay": 0.03}], ids=str)
def test_each_keyword_single_and_vector(keywords):
    played(ID, 3, 70, duration=0.5, **keywords)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", TASKS)
def test_every_environment(env_id):
    task = make_task(env_id)
    names, drawn = (
        task.observation,
        next(n for n in parameter_names(task.scene) if 0.0 < getattr(task.scene, n) < 1e9),
    )
    keywords = ALL | {
        "observation_noise": {names[0]: 0.1, names[-1]: 0.2},
        "randomize": {drawn: (0.9, 1.1)},
        "action_noise": None if task.formulas.choices else 0.1,
    }
    played(env_id, 3, 60, duration=40 * task.dt, **keywords)


@pytest.mark.slow
@pytest.mark.parametrize("task", own_tasks.TASKS, ids=lambda task: task.id)
def test_tasks_of_ones_own(task):
    spec = lag_envs.register(task)
    keywords = {"observation_noise": 0.1, "observation_delay": 0.07, "push": (5.0, 0.1)}
    if task.action:
        keywords |= {"action_delay": (0.01, 0.1), "slew": 50.0, "lag": 0.05}
    if task is own_tasks.Deliver:
        keywords |= {"action_noise": {"pull": 0.2}, "randomize": {"load_mass": (0.5, 2.0)}}
    if task is own_tasks.Drift:
        keywords |= {"randomize": {"length": (0.5, 2.0)}}
    played(spec, 3, 100, **keywords)


# --- off ----------------------------------------------------------------------------------------------------

NEUTRAL = {
    "randomize": {},
    "observation_noise": 0.0,
    "observation_delay": 0,
    "observation_every": 1,
    "action_noise": {"s_ddot": 0.0},
    "action_delay": (0.0, 0.0),
    "slew": math.inf,
    "lag": {"s_ddot": 0.0},
    "push": (0.0, 1.0),
}


def test_what_is_off_leaves_everything_as_it_is():
    assert set(NEUTRAL) == set(ALL) == set(KEYWORDS)
    plain = make_task(ID)
    for keywords in (NEUTRAL, dict.fromkeys(KEYWORDS)):
        task = make_task(ID, **keywords)
        assert task.imperfections is None
        assert constants_of(task) == plain.formulas.constants()
        program = program_of(task, [constants_of(task)])
        assert type(program) is Program and program is program_of(plain, [plain.formulas.constants()])


def test_perfect_programs_print_what_they_printed_without_the_module(monkeypatch):
    # No line of imperfections is left: no row, no constant, no key.
    printed: list[str] = []
    monkeypatch.setattr(
        program_module, "compile_lines", lambda *given, **_: printed.append("\n".join(given[2]))
    )
    task = make_task(ID)
    program = Program(task, absent_from(task.formulas.constants()))
    _ = program.step_one, program.start_one, program.start_all, program.finish_one
    assert len(printed) == 4 and set(program.kept) == {*program.y, *program.u, "n"}
    own = ("slot", "key_", "share", "mean_", "shown_at", "seen", "sigma", "slew", "push", "late")
    assert not [word for word in own for text in printed if word in text]


def test_starts_are_those_without():
    perfect, imperfect = (gym.make(ID, duration=0.5, **keywords) for keywords in ({}, ALL))
    for seed in (3, None, None):
        perfect.reset(seed=seed)
        imperfect.reset(seed=seed)
        assert np.array_equal(perfect.unwrapped.state, imperfect.unwrapped.state)


# --- draws --------------------------------------------------------------------------------------------------


def draws(seed: int, episode: int, purpose: str, step: int, count: int) -> np.ndarray:
    key = np.uint64(episode_key(np.uint64(seed), np.uint64(episode)))
    key = np.uint64(episode_key(key, np.uint64(PURPOSES[purpose])))
    return np.array([uniform(key, np.uint64(step), np.uint64(i)) for i in range(count)])


def test_parameters_are_predicted_from_the_seed():
    env = gym.make(ID, duration=0.5, **ALL)
    for episode in (1, 2):
        env.reset(seed=11 if episode == 1 else None)
        first, second = draws(11, episode, "parameters", 0, 2)
        found = env.unwrapped.parameters
        assert found["damping"] == pytest.approx(0.001 * (0.1 * 100**first), rel=1e-14)
        assert found["com_distance"] == 0.15 + second * (0.6 - 0.15)
    assert env.unwrapped.task.scene.damping == 0.001  # Model and controllers see the nominal one


def test_noise_is_predicted_from_the_seed():
    noisy = gym.make(ID, duration=0.5, **ALL)
    observation, _ = noisy.reset(seed=11)
    state, u = noisy.unwrapped.state, draws(11, 1, "observation", 0, 6)
    theta, sigmas = state[2], (0.01, 0.0, 0.02, 0.02, 0.05)
    true = np.array([state[0] / 0.5, state[1] / 2, math.cos(theta), math.sin(theta), state[3] / 8])
    for i, sigma in enumerate(sigmas):
        first, second = u[i - i % 2], u[i - i % 2 + 1]
        turn = (math.cos, math.sin)[i % 2](2 * math.pi * second)
        true[i] += sigma * math.sqrt(-2 * math.log(1 - first)) * turn
    assert observation == pytest.approx(true, abs=1e-6)


def test_draws_are_spread_as_they_should_be():
    n = 4096
    envs = gym.make_vec(ID, num_envs=n, duration=0.5, **ALL)
    observations, _ = envs.reset(seed=0)
    theta = envs.unwrapped.state[:, 2]
    off = (observations[:, 2] - np.cos(theta)) / 0.02, (observations[:, 3] - np.sin(theta)) / 0.02
    for values in off:
        assert abs(values.mean()) < 5 / math.sqrt(n) and abs(values.std() - 1) < 5 / math.sqrt(2 * n)
    assert abs(np.corrcoef(*off)[0, 1]) < 5 / math.sqrt(n)
    share = np.log(envs.unwrapped.parameters["damping"] / 1e-4) / math.log(100)
    length = (envs.unwrapped.parameters["com_distance"] - 0.15) / 0.45
    for values in (share, length):
        assert np.histogram(values, 8, (0, 1))[0] == pytest.approx(
            np.full(8, n / 8), abs=5 * math.sqrt(n / 8)
        )


@pytest.mark.slow
def test_an_environment_has_the_bits_of_one_made_with_the_drawn_values():
    drawn = gym.make(ID, randomize=ALL["randomize"])
    for seed in range(3):
        drawn.reset(seed=seed)
        values = drawn.unwrapped.parameters
        assert drawn.unwrapped.drawn_task.scene.inertia == pytest.approx(
            0.2 * values["com_distance"] ** 2 / 3, rel=1e-15
        )
        # With noise, both programs call the scalar step, which changes nothing else.
        made = gym.make(ID, **values)
        made.reset(seed=seed)
        for t in range(100):
            action = np.array([math.sin(0.3 * t)], np.float32)
            assert np.array_equal(drawn.step(action)[0], made.step(action)[0])


# --- delays -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("action_delay", "observation_delay"),
    [
        ((0.004, 0.05), (0.0, 0.05)),
        slow((0.004, 0.05), 0.027),
        slow(0.033, 0.027),
        slow(0.06, 0.01),
        slow(0.013, 0.04),
        slow(0.033, (0.013, 0.014)),
        slow(0.0, (0.02, 0.08)),
    ],
)
def test_delays_against_pieces_of_simulate(action_delay, observation_delay):
    env = gym.make(ID, action_delay=action_delay, observation_delay=observation_delay, duration=2.0)
    own, seed, dt = env.unwrapped, 3, 0.02
    shown = [env.reset(seed=seed)[0]]
    task, state = own.task, own.state
    formulas, k = task.formulas, task.formulas.constants()
    delays, ages = (
        delay if isinstance(delay, tuple) else (delay, delay) for delay in (action_delay, observation_delay)
    )
    arrivals, pieces = [(0.0, 0.0)], []  # (when, which control); (when, state, control) of simulated pieces
    rng = np.random.default_rng(1)
    for n in range(60):
        action = rng.uniform(-1, 1, 1).astype(np.float32) if n % 3 else np.ones(1, np.float32)
        late = delays[0] + (delays[1] - delays[0]) * draws(seed, 1, "delay", n, 1)[0]
        arrivals.append((n * dt + late, 5.0 * float(action[0])))
        observation, reward, *_ = env.step(action)
        shown.append(observation)
        # A command that arrives after a later one has no effect.
        came = [i for i, (t, _) in enumerate(arrivals) if n * dt + 1e-12 < t < (n + 1) * dt - 1e-12]
        news = [arrivals[i][0] for i in came if not any(t <= arrivals[i][0] for t, _ in arrivals[i + 1 :])]
        switches = sorted([n * dt, *news])
        mean = 0.0
        for t, end in zip(switches, [*switches[1:], (n + 1) * dt], strict=True):
            wanted = [u for when, u in arrivals if when <= t + 1e-12][-1]
            numbers = SimpleNamespace(**k | {"dt": end - t})
            (control,) = formulas.guarded(np, [wanted], form_of(task.scene).lift(state), numbers)
            pieces.append((t, state, control))
            state = task.scene.simulate(state, [control], end - t)[-1]
            mean += control * (end - t) / dt
        assert own.state == pytest.approx(state, abs=1e-11)
        assert reward == pytest.approx(
            (0.5 - 0.5 * math.cos(state[2])) ** 2 - 0.02 * (mean / 5) ** 2, abs=1e-11
        )
        age = ages[0] + (ages[1] - ages[0]) * draws(seed, 1, "age", n + 1, 1)[0]
        seen_at = (n + 1) * dt - age
        if seen_at <= 0:
            assert np.array_equal(observation, shown[0])
            continue
        when, at, control = pieces[bisect(pieces, seen_at, key=lambda piece: piece[0]) - 1]
        s, s_dot, theta, theta_dot = task.scene.simulate(at, [control], max(seen_at - when, 1e-15))[-1]
        true = [s / 0.5, s_dot / 2, math.cos(theta), math.sin(theta), theta_dot / 8]
        assert observation == pytest.approx(true, abs=1e-6)


def test_first_commands_under_way_are_zero_control():
    env = gym.make(ID, action_delay=(0.0499, 0.05), observation_delay=0.027)
    env.reset(seed=0)
    for t in range(4):
        env.step(np.ones(1, np.float32))
        assert env.unwrapped.control == (0.0 if t < 2 else 5.0)


@pytest.mark.slow
def test_whole_delays_are_not_divided_and_shift_what_is_done():
    late, prompt = (gym.make(ID, **keywords) for keywords in ({"action_delay": 0.06}, {}))
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 1)).astype(np.float32)
    late.reset(seed=2)
    prompt.reset(seed=2)
    for t in range(40):
        a, b = late.step(actions[t]), prompt.step(actions[t - 3] if t >= 3 else np.zeros(1, np.float32))
        assert np.array_equal(a[0], b[0]) and a[1] == b[1]


# --- spaces -------------------------------------------------------------------------------------------------


def test_spaces_are_as_wide_as_the_largest_noise():
    perfect, noisy = gym.make(ID), gym.make(ID, observation_noise=0.5)
    wider = noisy.observation_space.high - perfect.observation_space.high
    assert wider == pytest.approx(np.full(5, 0.5 * LARGEST_NORMAL), rel=1e-5)
    smallest = 1.0 - np.nextafter(1.0, 0.0)
    assert math.sqrt(-2.0 * math.log(smallest)) < LARGEST_NORMAL


def test_spaces_hold_all_that_may_be_drawn():
    drawn = gym.make(ID, randomize={"com_distance": (0.5, 2.0)}).observation_space.high
    ends = [gym.make(ID, com_distance=x).observation_space.high for x in (0.15, 0.3, 0.6)]
    assert drawn[:4] == pytest.approx(ends[0][:4]) and drawn[4] == pytest.approx((1 + MARGIN) * ends[0][4])
    assert (drawn >= np.max(ends, axis=0)).all()


@pytest.mark.slow
def test_what_the_space_cannot_hold_is_clipped_in_the_observation():
    class Narrow(TASKS["PivotedBar-v0"]):  # its bound is proved for a motion without pushes
        def bounds(self):
            return {**super().bounds(), "theta_dot/8": 0.2}

    envs = LagrangianVectorEnv(Narrow, 4, **ALL | {"push": (40.0, 9.0)})
    envs.reset(seed=0)
    seen = np.array([envs.step(envs.action_space.sample())[0] for _ in range(50)])
    high = envs.single_observation_space.high[4]
    assert np.abs(envs.state[:, 3]).max() > 1.6 and np.abs(seen[..., 4]).max() == high
    assert all(envs.observation_space.contains(o) for o in seen)


# --- actuators and pushes -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_slew_limits_the_change_of_the_command():
    env = gym.make("PivotedBarFree-v0", slew=100.0)
    env.reset(seed=0)
    controls = []
    for sign in (1, -1, 1):
        for _ in range(6):
            env.step(np.array([sign], np.float32))
            controls.append(env.unwrapped.control)
    assert controls[:4] == pytest.approx([2, 4, 5, 5]) and controls[6:12] == pytest.approx(
        [3, 1, -1, -3, -5, -5]
    )


@pytest.mark.slow
def test_pushes_come_at_their_rate():
    n, steps = 500, 100
    pushed, left = (gym.make_vec(ID, num_envs=n, **k) for k in ({"push": (3.0, 0.5)}, {}))
    rest = np.zeros((n, 1), np.float32)
    pushed.reset(seed=0)
    jumps = []
    for _ in range(steps):
        left.reset(seed=0, options={"state": pushed.unwrapped.state * (1 - 1e-15)})
        pushed.step(rest)
        left.step(rest)
        off = pushed.unwrapped.state - left.unwrapped.state
        assert np.abs(off[:, :3]).max() < 1e-9
        jumps.append(off[:, 3])
    jumps = np.concatenate(jumps)
    hit = np.abs(jumps) > 1e-9
    expected = -math.expm1(-3.0 * 0.02)
    assert hit.mean() == pytest.approx(expected, abs=5 * math.sqrt(expected / len(hit)))
    assert np.abs(jumps).max() <= 0.5 + 1e-9 and np.abs(jumps[hit]).mean() == pytest.approx(0.25, abs=0.02)


@pytest.mark.slow
def test_a_slow_sensor_holds_its_readings():
    env = gym.make(ID, observation_every=3, observation_noise=0.01)
    seen = [env.reset(seed=0)[0]] + [env.step(np.ones(1, np.float32))[0] for _ in range(9)]
    for i in (0, 3, 6):
        assert np.array_equal(seen[i], seen[i + 1]) and np.array_equal(seen[i], seen[i + 2])
        assert not np.array_equal(seen[i], seen[i + 3])


# --- refusals -----------------------------------------------------------------------------------------------

REFUSED = [
    ({"randomize": 3}, "randomize must map parameters to ranges"),
    ({"randomize": {"dampng": (0.5, 2)}}, r"'dampng'.*no such parameter.*com_distance"),
    ({"randomize": {"dt": (0.5, 2)}}, r"'dt'.*it decides how the environment is built"),
    ({"randomize": {"damping": 3}}, r"'damping'.*\(low, high\)"),
    ({"randomize": {"damping": (2, 0.5)}}, "low must be below high"),
    ({"randomize": {"damping": (math.nan, 2)}}, "must be finite, got nan"),
    ({"randomize": {"damping": ("a", 2)}}, "must be a real number, got 'a'"),
    ({"randomize": {"damping": (0.5, 2, "lag")}}, "may come .*got 'lag'"),
    ({"randomize": {"damping": (0.5, 2, "log", "uniform")}}, "two of these words exclude each other"),
    ({"randomize": {"damping": (-1, 2)}}, "factors must be at least 0, got -1"),
    ({"randomize": {"damping": (0, 2, "log")}}, "must be above 0, got 0 to 2"),
    (
        {"randomize": {"mass": (-1, 1, "absolute")}},
        r"randomize allows mass=-1.*impossible: mass must be above 0",
    ),
    ({"randomize": {"track": (0.5, 2)}, "track": math.inf}, "track is inf.*absolute"),
    ({"observation_noise": -0.1}, "observation_noise must be finite and at least 0, got -0.1"),
    ({"observation_noise": math.nan}, "observation_noise must be finite, got nan"),
    ({"observation_noise": "much"}, "observation_noise must be a real number, got 'much'"),
    ({"observation_noise": {"x": 0.1}}, "no entry of the observation 'x', only s/S"),
    ({"observation_noise": {"s/S": math.inf}}, "must be finite and at least 0, got inf for s/S"),
    ({"observation_noise": [0.1, 0.2]}, "or 5 numbers, for s/S"),
    ({"observation_delay": -0.1}, "observation_delay must be at least 0 s, got -0.1 s"),
    ({"observation_delay": 500.0}, "observation_delay must be at most 20000 control steps, 400 s, got 500 s"),
    ({"observation_every": 0}, "observation_every must be a whole number .*got 0"),
    ({"observation_every": 1.5}, "observation_every must be a whole number .*got 1.5"),
    ({"action_noise": -1}, "action_noise must be finite and at least 0, got -1"),
    ({"action_noise": {"push": 0.1}}, "no control that actions set 'push', only s_ddot"),
    ({"action_delay": -0.01}, "action_delay must be at least 0 s, got -0.01 s"),
    ({"action_delay": (0.1, 0.01)}, r"\(shortest, longest\), got \(0.1, 0.01\)"),
    (
        {"observation_delay": (0.1, 0.01)},
        r"observation_delay must be \(shortest, longest\), got \(0.1, 0.01\)",
    ),
    ({"observation_delay": np.array([0.1, 0.01])}, r"\(shortest, longest\), got \[0.1, 0.01\]"),
    ({"observation_delay": [0.1, [0.2]]}, "observation_delay must be a real number"),
    ({"observation_delay": "late"}, "observation_delay must be a real number, got 'late'"),
    ({"action_delay": (0.1, 0.2, 0.3)}, "the shortest and the longest"),
    ({"action_delay": None, "slew": 0.0}, "slew must be above 0"),
    ({"slew": math.nan}, "slew must be finite, got nan"),
    ({"lag": -0.1}, "lag must be 0 or at least .*got -0.1 s; 0 means no lag"),
    ({"lag": [0.1]}, r"lag must be a real number, got \[0.1\]"),
    ({"lag": {"torque": 0.1}}, r"lag\['torque'\]: there is no such control, only s_ddot"),
    ({"push": 1.0}, r"push must be \(pushes per second, largest size\), got 1.0"),
    ({"push": (-1.0, 1.0)}, "its rate must be at least 0, got -1"),
    ({"push": (1.0, {"s_dot": 1.0})}, "no free velocity 's_dot', only theta_dot"),
    ({"push": (1.0, -1.0)}, "push: its size must be finite and at least 0, got -1"),
]


@pytest.mark.parametrize(("keywords", "message"), REFUSED, ids=str)
def test_what_is_impossible_is_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ID, **keywords)
    with pytest.raises(ValueError, match=message):
        gym.make_vec(ID, num_envs=2, **keywords)


def test_noise_on_what_does_not_exist_is_refused():
    with pytest.raises(ValueError, match=r"action_noise is for actions in .*choices from a list"):
        own_tasks.Switched(action_noise=0.1)
    for keyword in ("action_noise", "action_delay", "slew", "lag"):
        with pytest.raises(ValueError, match=f"{keyword}.* no .*; leave it out"):
            own_tasks.Drift(**{keyword: 0.1})


def test_slew_of_several_controls_is_a_sequence_of_any_kind():
    first, second = (own_tasks.Deliver(slew=rates) for rates in ([1.0, 2.0], np.array([1.0, 2.0])))
    assert first.imperfections == second.imperfections


def test_a_misspelt_keyword_is_answered_with_those_that_exist():
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'observation_nois'.*observation_noise"):
        gym.make(ID, observation_nois=0.1)


def test_a_parameter_that_an_attribute_follows_from_is_refused():
    class Stale(TASKS["PivotedBarFree-v0"]):
        def check(self):
            super().check()
            self.heavy = self.scene.mass * 2.0

        def reward(self, before, after, *others):
            return self.heavy * super().reward(before, after, *others)

    with pytest.raises(ValueError, match="an attribute that it computes from parameters"):
        LagrangianVectorEnv(Stale, 1, randomize={"mass": (0.5, 2.0)})


def test_pages_and_drives_leave_out_what_scripts_lack(monkeypatch):
    class Late(pivoted_bar.SwingUp):
        id = "OwnLate-v0"
        imperfections = {"action_delay": 0.5 * pivoted_bar.SwingUp.interval}

    monkeypatch.setitem(TASKS.data, Late.id, Late)
    assert driving.scripts(Late.id) == (None, None)
    drive = replay.Drive(Late.id, 1, "", 0.0, "")
    with pytest.raises(replay.LinkError, match=f"{Late.id} .* only .*action_delay in whole steps"):
        replay.replay(drive)


def test_scripts_refuse_them():
    with pytest.raises(FormulaError, match=r"SwingUp has hidden parameters or imperfect .*None"):
        Unfused(make_task(ID, **ALL))


@pytest.mark.slow
def test_pictures_show_the_drawn_parameters():
    keywords = {"randomize": {"com_distance": (0.5, 2.0)}, "duration": 0.5}
    drawn = gym.make(ID, render_mode="rgb_array", **keywords)
    drawn.reset(seed=1)
    shown = []
    for _ in range(2):
        start = {"state": [0.0, 0.0, 0.5, 0.0]}
        drawn.reset(options=start)
        made = gym.make(ID, render_mode="rgb_array", duration=0.5, **drawn.unwrapped.parameters)
        made.reset(options=start)
        shown.append(drawn.render())
        assert np.array_equal(shown[-1], made.render())
    assert not np.array_equal(*shown)
    envs = gym.make_vec(ID, num_envs=2, render_mode="rgb_array", **keywords)
    envs.reset(seed=1, options={"state": np.tile([0.0, 0.0, 0.5, 0.0], (2, 1))})
    assert not np.array_equal(*envs.render())


@pytest.mark.slow
def test_a_piece_longer_by_a_rounding_than_the_lag_is_followed_is_taken():
    env = gym.make("PivotedBarFree-v0", dt=0.05, lag=0.01, observation_delay=0.03)
    env.reset(seed=5)
    for _ in range(20):  # pieces of 0.020000000000000004 s
        env.step(np.ones(1, np.float32))
    assert env.unwrapped.control == pytest.approx(5.0)
