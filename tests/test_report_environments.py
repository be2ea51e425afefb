"""The report on whole episodes: its references, Gymnasium's equations, its claims, and the errors."""

import itertools
import math
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest
from covering import PERFECT, covering, engine
from mpmath import mp, mpf
from rollouts import actions

from lag_envs.report import environment_results, environments, episodes, gymnasium_peers
from lag_envs.report.bound import Driven
from lag_envs.report.cases import Case
from lag_envs.report.episodes import RecordedEpisode, endless_actions, exact_stepping, record_episode
from lag_envs.report.integrators import comparison
from lag_envs.report.oracle import Oracle, oracle_of
from lag_envs.report.runner import JobResult
from lag_envs.report.stepped import Stepped
from lag_envs.report.timing import FlowSteps
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping.series import TOLERANCE
from lag_envs.tasks import TASKS, cart_pole, cylinder_in_cylinder, incline, pivoted_bar

#: Limit on the error of a second with an exact flow, relative to the state's size; measured 5.3e-16.
ONE_SECOND = 2e-15


def euler(rates, y, dt):
    return y + dt * rates(y)


def semi_implicit(rates, y, dt):
    rate = y[1] + dt * rates(y)[1]
    return np.array([y[0] + dt * rate, rate])


def rk4(rates, y, dt):
    a = rates(y)
    b = rates(y + 0.5 * dt * a)
    c = rates(y + 0.5 * dt * b)
    d = rates(y + dt * c)
    return y + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)


STEPS = {"Pendulum-v1": semi_implicit, "CartPole-v1": euler, "Acrobot-v1": rk4}


def float_rates(env, peer, u):
    """Return the equations of a peer's scene on floats, as SymPy derives them."""
    oracle, own = oracle_of(peer.scene(env)), np.argsort(peer.order)

    def rates(y):
        state = np.asarray(y)[list(peer.order)]
        found = np.empty(len(state))
        found[0::2], found[1::2] = state[1::2], oracle.at(state, [u])[1]
        return found[own]

    return rates


def short_episode(id, seconds=1.0):
    peer = gymnasium_peers.PEERS[id]
    env = gym.make(id).unwrapped
    env.reset(seed=0)
    steps = round(seconds / peer.step(env))
    actions = endless_actions(env, 0)
    if id == "Pendulum-v1":
        actions = map(np.float64, actions)  # with float32 it rounds the torque's part to float32
    return env, peer, gymnasium_peers.record_peer(env, peer, actions, steps, to_the_end=False)


@pytest.mark.parametrize("id", gymnasium_peers.PEERS)
@pytest.mark.filterwarnings("ignore")
def test_peers_equations_are_those_of_their_code(id):
    env, peer, episode = short_episode(id, 2.0)
    for before, u, after in zip(episode.states, episode.controls, episode.states[1:], strict=False):
        step = STEPS[id](float_rates(env, peer, u), before, peer.step(env))
        for i in peer.wraps:
            step[i] = math.remainder(step[i], 2.0 * math.pi)
        np.testing.assert_allclose(step, after, rtol=0, atol=1e-12)


def solve_peer(env, peer, episode):
    """Return the exact states under an episode's controls."""
    step = gymnasium_peers.exact_peer_step(env, peer)
    return episodes.chained(step, episode.states[0], episode.controls)


@pytest.mark.parametrize("id", gymnasium_peers.PEERS)
@pytest.mark.filterwarnings("ignore")
def test_peers_exact_states_agree_with_dop853(id):
    integrate = pytest.importorskip("scipy.integrate")
    env, peer, episode = short_episode(id)
    y = episode.states[0]
    for u in episode.controls:
        rates = float_rates(env, peer, u)
        y = integrate.solve_ivp(
            lambda t, y, f=rates: f(y), (0, peer.step(env)), y, "DOP853", rtol=1e-13, atol=1e-13
        ).y[:, -1]
    exact = solve_peer(env, peer, episode)[-1]
    np.testing.assert_allclose(np.array(exact, dtype=float), y, rtol=0, atol=1e-11)


def test_exact_states_are_those_of_equations_that_are_typed_in():
    """Pendulum-v1 and the bar as driven pendulums, with coefficients by hand in exact fractions."""
    env, peer, episode = short_episode("Pendulum-v1")
    path = solve_peer(env, peer, episode)
    given = [({"alpha": -15, "delta": 3 * Fraction(u)}, env.dt) for u in episode.controls]
    same(path, episode.states[0], given)

    env = gym.make(pivoted_bar.SwingUpFree.id, duration=1.0).unwrapped
    env.reset(seed=0)
    episode = record_episode(env, endless_actions(env, 0))
    path = episodes.chained(exact_stepping(env.task, 0, 34), episode.states[0], episode.controls)
    names = "mass", "com_distance", "inertia", "damping", "gravity"
    m, arm, i, b, g = (Fraction(getattr(env.scene, name)) for name in names)
    about = m * arm**2 + i
    given = [
        (
            {"alpha": m * arm * g / about, "beta": m * arm * Fraction(u) / about, "gamma": b / about},
            env.task.dt,
        )
        for u in episode.controls
    ]
    same(path, episode.states[0], given)


def same(path, start, given):
    """Compare a path's end with the driven pendulum's, with coefficients and length of each step."""
    y = [mpf(x) for x in start]
    for coefficients, dt in given:
        numbers = {"alpha": 0, "beta": 0, "gamma": 0, "delta": 0} | coefficients
        y = Oracle(Driven(), numbers).once([0.0, 0.0, *y], [0.0], dt, 45)[2:]
    with mp.workdps(60):
        assert all(abs(a - b) < mpf(10) ** -25 for a, b in zip(path[-1], y, strict=True))


@pytest.mark.parametrize("id", covering(PERFECT, engine))
def test_one_second_of_every_environment(id):
    """Exact flows to rounding; series to the truncation error that their certificate allows, in each step.

    Exact steps take long: for environments that act 500 times a second, less than a second has to do.
    """
    (row,) = environments.own_episode(id, seed=0, duration=min(1.0, 150 * TASKS[id].interval))
    assert row["seconds"] > 0.2
    assert row["disagreement"] < 1e-25
    if form_of(TASKS[id]().scene) is None:
        assert 0.0 < row["error"]["one step"] <= TOLERANCE and row["error"]["the end"] <= 1e-12
        return
    assert row["error"]["the end"] <= ONE_SECOND
    assert 0.0 < row["error"]["one step"] < environment_results.LARGEST_STEP
    assert row["error"]["the end"] <= environment_results.ROUNDINGS * row["amplified"]["the end"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("id", [i for i in PERFECT if form_of(TASKS[i]().scene)])
def test_every_step_of_whole_episodes(id, seed):
    """README's statement on random actions; beside it long pushes that spin a bar round and round."""
    (row,) = environments.own_episode(id, seed)
    assert row["error"]["one step"] < environment_results.LARGEST_STEP
    assert stubborn(id, seed)["error"]["one step"] < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("id", [i for i in PERFECT if not form_of(TASKS[i]().scene)])
def test_every_step_of_a_series(id):
    """The same for an episode's beginning: exact steps of these scenes take long."""
    duration = 100 * TASKS[id].interval
    (row,) = environments.own_episode(id, 1, duration)
    assert row["error"]["one step"] < 1e-12
    assert stubborn(id, 1, duration=duration)["error"]["one step"] < 1e-12


def stubborn(id, seed, **options):
    """Return the row of an episode with actions that are held for a long time."""
    env = gym.make(id, disable_env_checker=True, **options)
    env.reset(seed=seed)
    episode = record_episode(env, iter(actions(10_000, env.action_space, seed=seed + 9)))
    return environments.against_exact(env.unwrapped.task, episode, seed)


def test_one_step_is_the_worst_of_all_steps():
    """A single wrong step late in the episode shows, in its own entry, and nowhere else."""
    env = gym.make(pivoted_bar.SwingUpFree.id, duration=1.0)
    env.reset(seed=0)
    episode = record_episode(env, endless_actions(env, 0))
    task, late = env.unwrapped.task, len(episode.controls) - 3
    right = environments.against_exact(task, episode, 0)
    assert right["error"]["one step"] < environment_results.LARGEST_STEP
    states = episode.states.copy()
    states[late:, 1] += 1e-10  # the step that ends there is off, those that follow start from it
    wrong = environments.against_exact(task, episode._replace(states=states), 0)
    theta, theta_dot = wrong["entries"]
    assert theta_dot["one step"] == pytest.approx(1e-10, rel=0.2)
    assert theta["one step"] < 3e-12  # the effect of the changed speed on the next steps
    assert wrong["error"]["one step"] == pytest.approx(1e-10 / theta_dot["size"], rel=0.2)


@pytest.mark.filterwarnings("ignore")
def test_one_step_of_peers_is_the_worst_of_all_steps():
    """Explicit Euler's error of a step is h²/2 of the second derivative: larger once the pole falls."""
    env, peer, episode = short_episode("CartPole-v1")
    row = gymnasium_peers.measure_peer(env, peer, episode)
    first = gymnasium_peers.measure_peer(
        env, peer, RecordedEpisode(episode.states[:2], episode.controls[:1], False)
    )
    assert row["error"]["one step"] > first["error"]["one step"] > 1e-6


def test_kicks_are_part_of_the_exact_states(monkeypatch):
    """With this seed there is one before the bar has fallen."""
    (row,) = environments.own_episode(pivoted_bar.Balance.id, seed=4)
    assert row["error"]["the end"] < ONE_SECOND
    monkeypatch.setattr(episodes, "episode_key", lambda key, episode: 0)
    (row,) = environments.own_episode(pivoted_bar.Balance.id, seed=4)
    assert row["error"]["the end"] > 0.01


@pytest.fixture(scope="module")
def rows():
    jobs = [
        environments.own_episode(incline.Brake.id, 0, 1.0),
        environments.own_episode(cylinder_in_cylinder.Pump.id, 0, 1.0),
        environments.own_episode(cart_pole.CartPoleExact.id, 0, 1.0),
        environments.peer_episode("Pendulum-v1", 1, 1.0),
        environments.undriven(),
        environments.undriven("Pendulum-v1"),
    ]
    return list(itertools.chain(*jobs))


def test_small_report(rows):
    content = environments.content(
        rows, [JobResult("environments", "Acrobot-v1, seed 0", "", problem="lost")]
    )
    assert [claim.holds for claim in content.claims] == [True] * len(content.claims)
    for table in (*content.tables, *content.details, content.summary):
        assert table.rows and all(len(line) == len(table.columns) for line in table.rows)
    assert ["Acrobot-v1, seed 0", "lost"] == [content.tables[0].rows[-1][i] for i in (0, -1)]
    for picture in content.pictures:
        picture.draw()


def test_episodes_with_cut_speeds_are_passed_over(rows):
    """Pendulum-v1 clips its speed at 8 rad/s with seed 1, so another seed is taken."""
    row = next(row for row in rows if row["case"] == "Pendulum-v1")
    assert row["seed"] in (1, 1001)
    _, episode, seed = gymnasium_peers.random_episode("Pendulum-v1", 1, 200, True)
    assert seed == 1001 and np.abs(episode.states[:, 1]).max() < 8.0


def test_undriven_pendulum(rows):
    angles = {row["case"]: environment_results._angle(row) for row in rows if row["seed"] is None}
    assert angles["Pendulum-v1, undriven"] == pytest.approx(0.178, abs=0.0005)
    assert angles[f"{pivoted_bar.SwingUpFree.id} with Pendulum-v1's equation, undriven"] < 2e-12
    assert all(abs(row["gain"]) < 1e-12 for row in rows if row["seed"] is None and row["own"])


def test_a_worse_integrator_breaks_the_claims(rows):
    """RK4, once per control step, in place of the shipped step."""
    env = gym.make(pivoted_bar.SwingUpFree.id, duration=1.0).unwrapped
    env.reset(seed=0)
    episode = record_episode(env, endless_actions(env, 0))
    rk4, states = FlowSteps(env.scene, comparison("RK4", Stepped(env.scene).flow)), [episode.states[0]]
    for control in episode.controls:
        states.append(rk4.end(Case(env.scene, tuple(states[-1]), control), env.task.dt, 1))
    row = environments.against_exact(env.task, episode._replace(states=np.array(states)), seed=0)
    claims = environments.content([*rows, row | {"case": pivoted_bar.SwingUpFree.id, "seed": 0}], []).claims
    assert [claim.holds for claim in claims[:4]] == [False, True, False, True]  # the series' are unaffected


def test_what_a_certificate_allows_is_told_apart_from_rounding(rows):
    """A general-series step's truncation error may exceed a rounding, that of an exact flow may not."""
    (row,) = (row for row in rows if row["case"] == cart_pole.CartPoleExact.id)
    assert environment_results.LARGEST_STEP < row["error"]["one step"] < TOLERANCE
    held = environments.content([row], []).claims[:4]
    assert [claim.holds for claim in held] == [None, True, None, True]
    as_flow = environments.content([row | {"case": incline.Brake.id}], []).claims[:4]
    assert [claim.holds for claim in as_flow] == [True, None, False, None]
    worse = row | {"error": row["error"] | {"the end": 21e-14}}  # in 20 steps
    assert worse["steps"] == 20 and environments.content([worse], []).claims[1].holds is False
