"""The dynamic programme against cases solved by hand, its cache, and the committed optima."""

import dataclasses
import gzip
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from rollouts import Noisy, one_by_one
from scipy.optimize import brentq, minimize_scalar

import lag_envs
from agents import optimum
from agents.optimum import IMAGES, RESULTS, extrapolated
from agents.run import fresh_seeds
from agents.solution import GreedyPolicy, Solution, grid, nodes, played, solvable
from agents.value_iteration import (
    PROGRESS,
    VALUES,
    CacheError,
    DynamicProgramme,
    Grid,
    interpolate_rows,
    stretched,
)
from lag_envs.controllers import make_controller, optimal_return
from lag_envs.controllers.basic import ObservationDecoder, constant
from lag_envs.envs.model import Model
from lag_envs.evaluation.rollout import Rollout, play, record_rollout
from lag_envs.leaderboard.protocol import first_seed
from lag_envs.leaderboard.shipped import shipped
from lag_envs.scores import known_returns
from lag_envs.tasks import TASKS, cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.arm import Reach
from lag_envs.tasks.incline import Brake
from lag_envs.tasks.pendulum import PendulumExact

ROOT = Path(__file__).parents[1]
COMPUTED = sorted(RESULTS.glob("*.json"))
each_result = pytest.mark.parametrize("file", COMPUTED, ids=[file.stem for file in COMPUTED])


# --- the grid ---


def interpolate(grid, values, coordinates):
    """Return values given at the nodes, (*shape,), interpolated at coordinates (n, d)."""
    cells, places = grid.locate(coordinates)
    return interpolate_rows(values.reshape(1, -1), 0 * cells.astype(np.int64), cells, places, grid.strides)


def test_interpolation_is_exact_for_multilinear_functions():
    rng = np.random.default_rng(0)
    for d in (2, 3):
        axes = tuple(np.sort(rng.uniform(-1.0, 1.0, n)) for n in (7, 5, 6)[:d])
        grid = Grid(axes, (None,) * d)
        points = np.stack([rng.uniform(a[0], a[-1], 100) for a in axes], axis=1)
        values = (2.0 + grid.points()).prod(axis=1).reshape(grid.shape).astype(np.float32)
        np.testing.assert_allclose(interpolate(grid, values, points), (2.0 + points).prod(axis=1), rtol=1e-5)
        # The nodes themselves, including the last ones; and outside the nearest edge.
        np.testing.assert_array_equal(interpolate(grid, values, grid.points()), values.ravel())
        corner = np.array([[axis[-1] + 1.0 for axis in axes]])
        assert interpolate(grid, values, corner) == values[(-1,) * d]


def test_interpolation_goes_round():
    axis = stretched(0.0, 2.0, 5.0, 40, 1.0)
    grid = Grid((axis, np.array([0.0, 1.0])), (5.0, None))
    values = np.repeat(np.cos(2.0 * np.pi * axis / 5.0)[:, None], 2, axis=1).astype(np.float32)
    x = np.linspace(-5.0, 10.0, 301)
    found = interpolate(grid, values, np.stack([x, 0.3 * np.ones_like(x)], axis=1))
    np.testing.assert_allclose(found, np.cos(2.0 * np.pi * x / 5.0), atol=0.02)
    np.testing.assert_allclose(found[:100], found[200:300], atol=1e-6)


def test_nodes_halve():
    coarse, fine = stretched(-1.0, 0.3, 0.5, 10, 0.1), stretched(-1.0, 0.3, 0.5, 20, 0.1)
    np.testing.assert_allclose(fine[::2], coarse, atol=1e-15)
    assert (coarse[0], coarse[5], coarse[-1]) == (-1.0, 0.3, 0.5)
    assert np.diff(coarse).argmin() in (4, 5)
    assert len(stretched(-1.0, 0.0, 0.0, 10, 0.1)) == 11


def test_bad_grids_are_named():
    axis = np.array([0.0, 1.0])
    for axes, periods, message in (
        ((axis,), (None,), "2 or 3 axes"),
        ((axis, axis[::-1]), (None, None), "axis 1 needs at least two nodes, in increasing order"),
        ((axis, axis), (2.0, None), "axis 0 has the period 2"),
    ):
        with pytest.raises(ValueError, match=message):
            Grid(axes, periods)


# --- cases solved by hand ---


def double_integrator(points, actions, dt):
    """Hold x'' = a for dt."""
    x, v = points.T
    return np.stack([x + dt * (v + 0.5 * dt * actions), v + dt * actions], axis=1)


def test_linear_quadratic_value():
    # x⁺ = A x + B a, reward -(x'Qx + R a²): V_t = -x'P_t x by the Riccati recursion; a is never at its limit.
    dt, steps, cost, price = 0.2, 15, np.diag([1.0, 0.3]), 0.5
    a, b = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[0.5 * dt * dt], [dt]])
    p = np.zeros((2, 2))
    for _ in range(steps):
        gain = np.linalg.solve(price + b.T @ p @ b, b.T @ p @ a)
        p = cost + a.T @ p @ a - a.T @ p @ b @ gain

    def step(points, actions):
        rewards = -((points @ cost) * points).sum(axis=1) - price * actions**2
        return double_integrator(points, actions, dt), rewards, np.zeros(len(points), bool)

    points = np.array([[0.3, 0.1], [-0.4, 0.2], [0.2, -0.4], [0.05, 0.0]])
    exact, found = -((points @ p) * points).sum(axis=1), []
    for n in (51, 101):
        axis = np.linspace(-1.0, 1.0, n)
        problem = DynamicProgramme(Grid((axis, axis), (None, None)), np.linspace(-2, 2, 81), step, steps)
        values = problem.solve(quiet=True)
        found.append(interpolate(problem.grid, values[0], points))
    # Between nodes a concave function lies above its interpolation, by less the finer the grid is.
    errors = exact - np.array(found)
    assert (errors > 0.0).all() and (errors[1] < 0.012).all() and (errors[1] < 0.55 * errors[0]).all()
    best = interpolate(problem.grid, problem.greedy(values[1]).astype(np.float32), points)
    np.testing.assert_allclose(best, -(points @ gain.T)[:, 0], atol=0.04)


def test_double_integrator_in_least_time():
    # To the origin in least time by |a| <= 1, from (1, 0): full on, then full back, 2 s in all; from (x, v)
    # above the switching curve v + 2 sqrt(v²/2 + x).
    dt, ball = 0.05, 0.08

    def step(points, actions):
        ends = double_integrator(points, actions, dt)
        return ends, np.full(len(points), -dt), (np.abs(ends) < ball).all(axis=1)

    axes = tuple(stretched(-2.0, 0.0, 2.0, 160, 0.3) for _ in range(2))
    problem = DynamicProgramme(Grid(axes, (None, None)), [-1.0, 0.0, 1.0], step, 90)
    values = problem.solve(quiet=True)
    points = np.array([[1.0, 0.0], [-1.0, 0.0], [0.5, 0.5], [-0.5, -0.5]])
    x, v = (points * np.sign(points[:, :1])).T
    exact = v + 2.0 * np.sqrt(0.5 * v * v + x)
    np.testing.assert_allclose(-interpolate(problem.grid, values[0], points), exact, atol=0.15)
    action = problem.greedy(values[1])
    near = interpolate(problem.grid, action.astype(np.float32), np.array([[1.0, 0.5], [-1.0, -0.5]]))
    assert near.tolist() == [-1.0, 1.0]  # before the switching curve x = -v |v|/2
    behind = interpolate(problem.grid, action.astype(np.float32), np.array([[0.3, -1.2], [-0.3, 1.2]]))
    assert behind.tolist() == [1.0, -1.0]


def test_expectation_over_kicks():
    # Only kicks move it; each step pays x²: the expected return is that of a random walk.
    axis = np.linspace(-3.0, 3.0, 61)

    def step(points, actions):
        return points, points[:, 0] ** 2, np.zeros(len(points), bool)

    def kick(points):
        push = np.array([0.2, 0.0])
        return np.stack([points, points + push, points - push]), np.array([0.8, 0.1, 0.1])

    problem = DynamicProgramme(Grid((axis, axis), (None, None)), [0.0], step, 5, kick)
    values = problem.solve(quiet=True)
    exact = 5 * 0.5**2 + (1 + 2 + 3 + 4) * 0.2 * 0.2**2
    assert interpolate(problem.grid, values[0], np.array([[0.5, 0.0]]))[0] == pytest.approx(exact, rel=1e-5)


def test_extrapolation():
    assert extrapolated([2.0 + h for h in (4.0, 2.0, 1.0)]) == (2.0, 1.0, 1.0)
    limit, error, order = extrapolated([2.0 - h**1.5 for h in (4.0, 2.0, 1.0)])
    assert (limit, order) == pytest.approx((2.0, 1.5)) and error == pytest.approx(2.0**1.5 - 1.0)
    assert extrapolated([3.0, 1.0, 2.0]) == (3.0, 1.0, 1.0)


@pytest.mark.parametrize("order", [0.9, 1.0, 1.3, 2.0, 2.5])
def test_error_bar_holds_the_truth(order):
    """This also holds if the order is a little below 1, or above 2."""
    limit, error, _ = extrapolated([7.0 - h**order for h in (4.0, 2.0, 1.0)])
    assert abs(limit - 7.0) <= error


# --- the cache ---


class Stop(Exception):
    pass


@pytest.fixture
def small():
    """Return a function that makes a problem, which may stop in the middle of its solution."""

    def make(steps=20, pull=0.1, **parameters):
        def step(points, actions):
            ends = double_integrator(points, actions - pull * points[:, 0], 0.1)
            return ends, -(points**2).sum(axis=1), np.zeros(len(points), bool)

        axis = np.linspace(-1.0, 1.0, 21)
        return DynamicProgramme(
            Grid((axis, axis), (None, None)), [-1.0, 0.0, 1.0], step, steps, None, parameters
        )

    return make


def test_resumed_is_the_same_as_uninterrupted(small, tmp_path, monkeypatch):
    import tqdm

    whole = small().solve(quiet=True)

    class Bar(tqdm.tqdm):
        def update(self, n=1):
            self.n += n
            if self.n == 9:
                raise Stop

    monkeypatch.setattr("agents.value_iteration.RECORD", 0.0)
    monkeypatch.setattr(tqdm, "tqdm", Bar)
    with pytest.raises(Stop):
        small().solve(tmp_path, quiet=True)
    monkeypatch.undo()
    file = tmp_path / small().name / PROGRESS
    assert json.loads(file.read_text())["done"] == 12  # of 20; the unfinished one is not recorded
    again = small()
    np.testing.assert_array_equal(again.solve(tmp_path, quiet=True), whole)
    assert json.loads(file.read_text())["done"] == 0
    # Finished work is read; a changed number makes another cache.
    monkeypatch.setattr("agents.value_iteration.transitions", None)
    np.testing.assert_array_equal(small().solve(tmp_path, quiet=True), whole)
    names = {p.name for p in (small(), small(steps=21), small(pull=0.2), small(target=0.1))}
    assert len(names) == 4


def test_unusable_cache_is_an_error(small, tmp_path):
    small().solve(tmp_path, quiet=True)
    folder = tmp_path / small().name
    progress, values = (folder / PROGRESS).read_text(), (folder / VALUES).read_bytes()
    for name, content, message in (
        (PROGRESS, progress[:30], "JSONDecodeError"),
        (PROGRESS, progress.replace('"steps": 20', '"steps": 19'), "belongs to another problem"),
        (PROGRESS, progress.replace('"done": 0', '"done": 77'), "done=77 is not a step"),
        (VALUES, values[:-1000], "mmap"),
        (VALUES, values[:10_000], ""),
        (VALUES, b"no array", ""),
        (VALUES, values[:128] + bytes(100) + values[228:], "checksum"),
    ):
        (folder / PROGRESS).write_text(progress)
        (folder / VALUES).write_bytes(values)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(CacheError, match=f"{re.escape(str(folder))} cannot be used.*{message}.*--new"):
            small().solve(tmp_path, quiet=True)
    np.testing.assert_array_equal(small().solve(tmp_path, new=True, quiet=True), small().solve(quiet=True))


def test_full_disk_is_an_error(small, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(CacheError, match=r"No space left on device.*make room, or choose another --folder"):
        small().solve(tmp_path, quiet=True)
    assert not list(tmp_path.rglob(VALUES))


# --- the agent ---


@pytest.fixture(scope="module")
def brake():
    return GreedyPolicy(incline.Brake.id, level=2.0, folder=None)


def test_brake_in_a_few_seconds(brake):
    returns = play(incline.Brake.id, brake, fresh_seeds(500))
    assert returns.mean() > -1.78


def test_agent_takes_one_observation_as_a_batch(brake):
    one = one_by_one(incline.Brake.id, brake, range(5, 8))
    np.testing.assert_allclose(one, play(incline.Brake.id, brake, range(5, 8)), rtol=1e-12)


def test_agent_acts_in_the_last_step_and_past_the_end(brake):
    observation = np.array([1.0, 0.5])
    action, taken = brake.predict(observation, np.array([499]))
    assert action.shape == (1,) and action.dtype == np.float32 and taken.tolist() == [500]
    brake.predict(observation, taken)


class Listed(PendulumExact):
    """Three torques."""

    id = "Listed-v0"
    action = {"torque": [-2.0, 0.0, 2.0]}


def test_listed_actions_are_tried(monkeypatch):
    monkeypatch.setitem(TASKS.data, Listed.id, Listed)
    lag_envs.register(Listed)
    agent = GreedyPolicy(Listed.id, level=0.5, folder=None)
    assert agent.solution.programs[0].actions.tolist() == [0.0, 1.0, 2.0]
    seeds = fresh_seeds(20)
    returns = play(Listed.id, agent, seeds).mean()
    assert (
        returns > max(play(Listed.id, constant(Listed(), action=i), seeds).mean() for i in range(3)) + 300.0
    )


@pytest.mark.parametrize("numbers", [{"kick_sizes": 0}, {"chance": 0.02}])
def test_kicks_are_not_left_out(numbers, monkeypatch):
    problem = dataclasses.replace(cylinder_in_cylinder.Damping.value_iteration, **numbers)
    with pytest.raises(ValueError, match="value iteration would leave out the kicks of Cylinder"):
        Solution(cylinder_in_cylinder.Damping.id, 0.25, None, problem=problem)


def test_agent_is_there_for_what_is_solved():
    able = f"no policy for 'PivotedBar-v0', only for {pivoted_bar.SwingUpFree.id}"
    with pytest.raises(ValueError, match=able):
        GreedyPolicy("PivotedBar-v0")


@pytest.mark.parametrize("env_id", played())
def test_observations_are_read_back(env_id):
    read = ObservationDecoder(TASKS[env_id]())
    env = gym.make(env_id)
    env.reset(seed=3)
    env.action_space.seed(3)  # by chance, PendulumExact becomes faster than its observation tells
    for _ in range(50):
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        off = read.difference(read(observation)[0], env.unwrapped.state)
        np.testing.assert_allclose(off / np.maximum(np.abs(env.unwrapped.state), 1.0), 0.0, atol=1e-6)
        if terminated or truncated:
            env.reset()


@pytest.mark.parametrize("env_id", [id for id, p in solvable().items() if p.targets])
def test_targets_have_mirror_images(env_id):
    task = TASKS[env_id]()
    assert task.value_iteration.targets[-1] == task.target_range
    model, rng = Model(task), np.random.default_rng(0)
    states = rng.uniform(-1.2, 1.2, (500, 3)) * [0.5, 1.0, 0.1]
    actions, targets = rng.uniform(-1.0, 1.0, 500), rng.uniform(-0.3, 0.3, 500)
    ends, rewards, ended = model(states, actions, targets)
    mirrored, same, too = model(-states, -actions, -targets)
    np.testing.assert_allclose(mirrored, -ends, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(same, rewards, rtol=1e-12)
    assert (ended == too).all()


def test_between_targets_values_are_interpolated():
    solution = Solution(cylinder_in_cylinder.Tilt.id, 0.25, folder=None, quiet=True)
    # At equal places among the nodes the value is linear in the target; at the solved ones it is the grid's.
    axes = solution.programs[1].grid.axes
    i, j, k = 3, 2, 2
    _, first, second = solution.problem.targets
    at_node = np.array([[axes[0][i], axes[1][j], axes[2][k]]])
    assert solution.value(0, at_node, np.array([first]))[0] == solution.values[1][0, i, j, k]
    middle, between = at_node.copy(), 0.5 * (first + second)
    middle[0, 0] = nodes(solution.problem.axes[0], 0.25, between)[i]
    expected = 0.5 * (solution.values[1][0, i, j, k] + solution.values[2][0, i, j, k])
    assert solution.value(0, middle, np.array([between]))[0] == pytest.approx(expected, rel=1e-6)
    assert solution.value(0, -middle, np.array([-between]))[0] == pytest.approx(expected, rel=1e-6)
    with pytest.raises(ValueError, match=r"times must lie between 0 and [0-9]+, got -1 to -1"):
        solution.value(-1, at_node)


# --- the command ---


def test_command_writes_numbers_and_a_figure(tmp_path, capsys, monkeypatch):
    coarse = dataclasses.replace(Brake.value_iteration, levels=(1.0,))
    monkeypatch.setattr(Brake, "value_iteration", coarse)
    arguments = [incline.Brake.id, "--quick", "--folder", str(tmp_path)]
    assert optimum.main(arguments) == 0
    result = json.loads((tmp_path / f"{incline.Brake.id}.json").read_text())
    estimate = result["estimate"]
    assert result["lower"]["mean"] > -1.9
    assert abs(estimate["value"] - result["bound"]["value"]) < estimate["error"] < 0.2
    assert (tmp_path / f"value-{incline.Brake.id}.png").stat().st_size > 10_000
    assert "estimate -1." in capsys.readouterr().out
    # Damaged files are named, with the remedy.
    for file in tmp_path.rglob(VALUES):
        file.write_bytes(b"")
    assert optimum.main(arguments) == 2
    assert "use --new" in capsys.readouterr().err


@pytest.mark.slow
def test_without_grid_and_plans_the_best_known_policy_is_measured(capsys):
    """Its run is not kept: the policy that ships with the package is played."""
    assert optimum.main([Reach.id, "--quick"]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "fast PPO" in line)
    known, score = known_returns(Reach.id), shipped()[Reach.id].score
    assert float(line.split()[3]) == pytest.approx(
        known.random + score * (known.best - known.random), abs=3.0
    )


def test_mistakes_are_named(capsys):
    assert optimum.main(["PivotedBra-v0"]) == 2
    assert "PivotedBar-v0" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize("name", ["SIGKILL", "SIGTERM"])
def test_killed_command_goes_on(tmp_path, name):
    number = getattr(signal, name)
    command = [
        sys.executable,
        "-m",
        "agents.optimum",
        pivoted_bar.SwingUpFree.id,
        "--quick",
        "--folder",
        str(tmp_path),
    ]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        while not (done := [f for f in tmp_path.rglob(PROGRESS) if json.loads(f.read_text())["done"] < 500]):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(number)
        assert process.wait() == (-9 if name == "SIGKILL" else 130)
        assert done
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    fresh = Solution(pivoted_bar.SwingUpFree.id, 1.0, folder=None, quiet=True)
    kept = Solution(pivoted_bar.SwingUpFree.id, 1.0, folder=tmp_path, quiet=True)
    np.testing.assert_array_equal(fresh.values[0], kept.values[0])


@pytest.mark.slow
def test_bar_is_up_in_two_seconds():
    agent = GreedyPolicy(pivoted_bar.SwingUpFree.id, level=2.0, folder=None)
    played = record_rollout(Rollout(pivoted_bar.SwingUpFree.id, agent, fresh_seeds(1)))
    assert 1.5 < played.settled()[0] < 2.5  # up for good
    assert play(pivoted_bar.SwingUpFree.id, agent, fresh_seeds(100)).mean() > 419.5


# --- committed results ---


def test_whatever_is_solved_has_its_optimum():
    assert [file.stem for file in COMPUTED] == sorted(
        id for id, task in TASKS.items() if task.value_iteration
    )


@each_result
def test_committed_results_are_consistent(file):
    result = json.loads(file.read_text())
    assert result["env"] == file.stem and result["schema"] == optimum.SCHEMA
    source = TASKS[file.stem].value_iteration.relaxed or file.stem
    problem = solvable()[source]
    assert [grid["level"] for grid in result["grids"]] == list(problem.levels)
    assert [grid["nodes"] for grid in result["grids"]] == [
        list(grid(problem, level, 0.0).shape) for level in problem.levels
    ]
    # The caches' names depend on nodes, step and reward: none is out of date.
    assert result["parameters"] == pytest.approx(optimum.scene_numbers(TASKS[source](**problem.options)))
    assert problem.actions == result["actions"] and list(problem.targets) == result["targets"]
    if result["lower"] is not None:
        low, high = result["lower"]["interval"]
        assert low < result["lower"]["mean"] < high
        assert result["lower"]["mean"] <= result["bound"]["value"]
    limit, error, order = extrapolated([grid["value"] for grid in result["grids"]])
    assert result["estimate"] == {
        "value": pytest.approx(limit, abs=1e-4),
        "error": pytest.approx(error, abs=2e-4),
    }
    assert result["order"] == pytest.approx(order, abs=0.006)
    picture = IMAGES / f"value-{file.stem}.png"
    assert picture.exists() == (file.stem in solvable())
    assert not picture.exists() or picture.stat().st_size < 150_000


def summary(env_id):
    """Return the agents' results for an environment, by agent."""
    return json.loads((ROOT / "agents" / "results" / "summary.json").read_text())["envs"][env_id]["agents"]


def numbers(env_id):
    return json.loads((RESULTS / f"{env_id}.json").read_text())


def test_known_answers_come_out():
    free = numbers(pivoted_bar.SwingUpFree.id)
    assert free["lower"]["mean"] > 421.0
    damping = numbers(cylinder_in_cylinder.Damping.id)
    full = summary(cylinder_in_cylinder.Damping.id)["full damping"]["conditions"]["nominal"]
    assert damping["lower"]["interval"][0] > full["return"] + 2.0 * full["return_error"] + 50.0
    assert numbers(incline.Brake.id)["lower"]["mean"] > -1.76
    assert numbers(cylinder_in_cylinder.Tilt.id)["lower"]["mean"] > 197.6
    assert numbers(incline.Tilt.id)["lower"]["mean"] > 179.9
    assert numbers(cylinder_in_cylinder.Pump.id)["lower"]["mean"] > 142.1
    for env_id in ("PivotedBar-v0", pivoted_bar.Balance.id):
        result = numbers(env_id)
        assert result["lower"] is None and highest(env_id) < 500.0
    assert "too wide for a score" in numbers(pivoted_bar.Balance.id)["how"]
    assert math.isclose(highest("PivotedBar-v0"), highest(pivoted_bar.SwingUpFree.id), rel_tol=2e-4)


# --- upper bounds: the braking task's optimum, and all estimates, against all results ---


def brute_force(task, x, v):
    """Return the largest return of rolling freely and then braking fully, by trying switching times."""
    scene = task.scene
    mass = scene.mass + scene.inertia / scene.radius**2
    pull = scene.mass * scene.gravity * math.sin(scene.tilt) / mass
    weak, strong = scene.damping / mass, (scene.damping + 6.0) / mass

    def later(x, v, drag, t):
        if drag == 0.0:
            return x + v * t + 0.5 * pull * t * t, v + pull * t
        settled, left = pull / drag, math.exp(-drag * t)
        return x + settled * t + (v - settled) * (1.0 - left) / drag, settled + (v - settled) * left

    def crossing(x, v, drag):
        far = 1.0
        while later(x, v, drag, far)[0] < 0.0:
            far *= 2.0
        return brentq(lambda t: later(x, v, drag, t)[0], 0.0, far, xtol=1e-14)

    def cost(switch):
        place, speed = later(x, v, weak, switch)
        if place >= 0.0:
            return switch + 5.0 * max(0.0, speed - 0.5)
        t = crossing(place, speed, strong)
        return switch + t + 5.0 * max(0.0, later(place, speed, strong, t)[1] - 0.5)

    times = np.linspace(0.0, crossing(x, v, weak), 801)
    costs = [cost(t) for t in times]
    i = int(np.argmin(costs))
    ends = times[max(i - 1, 0)], times[min(i + 1, 800)]
    return -min(minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 1e-12}).fun, costs[i])


@pytest.mark.parametrize(
    "options",
    # In the second, third and fifth case the price of the speed decides, not the free speed.
    [{}, {"mass": 2.0}, {"mass": 8.0, "tilt": 0.06}, {"damping": 0.5}, {"mass": 1.2, "damping": 0.1}],
)
def test_optimum_of_braking(options):
    task = Brake(duration=math.inf, **options)
    starts = [(-1.0, 0.0), (-2.0, 0.5), (-3.0, 3.0), (-0.05, 2.0), (-0.001, 0.1)]
    found = optimal_return(task, *np.transpose(starts))
    np.testing.assert_allclose(found, [brute_force(task, *start) for start in starts], rtol=1e-7)


def test_optimum_of_braking_where_the_line_is_out_of_reach():
    assert optimal_return(Brake(), -1000.0, 0.0) == -10.0
    with pytest.raises(ValueError, match=r"nothing is pulled .* tilt=0 rad and gravity=9.81 m/s²; give both"):
        optimal_return(Brake(tilt=0.0), -1.0, 1.0)


@pytest.mark.parametrize("options", [{}, {"mass": 1.2}, {"dt": 0.1}, {"tilt": 0.4}])
def test_nothing_beats_the_optimum_of_braking(options):
    names = ("switching line", "best constant", "full damping", "zero", "random")
    line, *others = (make_controller(incline.Brake.id, name, **options) for name in names)
    # And along the line, with every action changed a little to either side.
    for agent in (line, *others, Noisy(line, 0.1)):
        rollout = Rollout(incline.Brake.id, agent, range(3, 303), **options)
        best = optimal_return(rollout.task, *rollout.state.T)
        total = rollout.run()
        assert (total <= best + 1e-9).all()
        if agent is line and not options:
            assert (best - total).max() < 4e-4


def highest(env_id):
    """Return an upper bound of the optimum: the proved one, or the upper end of the estimate."""
    result = numbers(env_id)
    estimate = result["estimate"]
    return result["bound"]["value"] if result["bound"]["exact"] else estimate["value"] + estimate["error"]


@pytest.mark.parametrize("env_id", [file.stem for file in COMPUTED])
def test_no_agent_is_above_what_is_published_of_the_optimum(env_id):
    """All were played from the same starts, so only kicks are luck."""
    for name, agent in summary(env_id).items():
        found = agent["conditions"]["nominal"]
        luck = 3.0 * found["return_error"] if TASKS[env_id].value_iteration.kick_sizes else 0.0
        mean = found["return"]
        assert mean <= highest(env_id) + luck, name
        assert mean <= numbers(env_id)["bound"]["value"]


VERIFIED = sorted((ROOT / "leaderboard" / "results").glob("*.json.gz"))


@pytest.mark.parametrize("file", VERIFIED, ids=[file.name.partition(".")[0] for file in VERIFIED])
def test_no_verified_result_is_above_what_is_published_of_the_optimum(file):
    """Each has its own episodes: the optimum is shifted by the reference's luck in them."""
    result = json.loads(gzip.decompress(file.read_bytes()))
    env_id = result["env"]
    most = highest(env_id)
    for number, policy in enumerate(result["policies"]):
        returns = np.array(policy["returns"])
        if TASKS[env_id].optimum:
            seed = first_seed(result["digest"], result["nonce"], number)
            start = Rollout(env_id, None, range(seed, seed + len(returns)))
            assert (returns <= optimal_return(start.task, *start.state.T) + 1e-9).all()
            continue
        assert (returns <= numbers(env_id)["bound"]["value"]).all()
        ahead, most_ahead = returns, most
        if policy.get("reference"):
            ahead = returns - np.array(policy["reference"])
            most_ahead = most - summary(env_id)[TASKS[env_id].reference]["conditions"]["nominal"]["return"]
        assert ahead.mean() <= most_ahead + 3.0 * ahead.std() / math.sqrt(len(ahead))
