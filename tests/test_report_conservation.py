"""Conservation and omitted terms: small regenerations of both sections and of their claims."""

import math

import gymnasium as gym
import numpy as np
import pytest
from covering import PERFECT, covering, engine

from lag_envs.report import conservation, leave_out
from lag_envs.report.points import ROUNDING
from lag_envs.scenes.derivation import form_of
from lag_envs.tasks import TASKS


def claims(content):
    return {claim.text: claim.holds for claim in content.claims}


#: Those whose scene has a dedicated flow.
FORMS = [id for id in TASKS if form_of(TASKS[id]().scene) is not None]


@pytest.fixture(scope="module")
def runs():
    rows = []
    for name in conservation.FREE:
        rows += conservation.free(name, conservation.LAG_ENVS, 10_000)
    for method in ("RK4", "Verlet"):
        rows += conservation.free("bar, 2 rad", method, 10_000)
    return [*rows, *conservation.energy_imbalance("CylinderInCylinder, tilt", 20)]


@pytest.mark.slow
def test_claims_hold(runs):
    content = conservation.content(runs, [])
    assert set(claims(content).values()) == {True}, content.claims
    assert [len(row) for table in content.tables for row in table.rows] == [
        len(table.columns) for table in content.tables for row in table.rows
    ]
    for picture in content.pictures:
        assert picture.draw().axes


@pytest.mark.slow
def test_energy_of_lag_envs_and_of_others(runs):
    """lag_envs is at rounding; Verlet's drift is bounded and RK4's grows, as in theory."""
    drift = {(r["name"], r["method"]): r for r in runs if r["kind"] == "drift"}
    for name in conservation.FREE:
        limit = 1e-12 if name == "incline" else 1e-13
        assert conservation.worst(drift[name, "lag_envs"]["energy"]) < limit
    verlet, rk4 = (drift["bar, 2 rad", method] for method in ("Verlet", "RK4"))
    assert 1e-4 < conservation.worst(verlet["energy"]) < 1e-2
    assert abs(conservation.exponent(verlet["steps"], verlet["energy"])) < 0.1
    assert conservation.exponent(rk4["steps"], rk4["energy"]) == pytest.approx(1.0, abs=0.1)


def test_a_report_without_drifts_says_nothing_of_their_steps():
    found = conservation.content(conservation.energy_imbalance("CylinderInCylinder, tilt", 2), [])
    assert len(found.claims) == 3 and not any(" 0 " in text for text in (*found.text, *claims(found)))


def test_march_is_simulate():
    """The loop of the long runs gives the bits of `Scene.simulate`."""
    problem = conservation.FREE["bar, turning over"]
    end = conservation.lifted_run(problem, conservation.LAG_ENVS, np.array([7, 1000]))
    path = problem.scene.simulate(problem.state, np.zeros(1000), problem.dt)
    np.testing.assert_array_equal(end[:, :2], path[[7, 1000]])


def test_marks_are_exact_times():
    from fractions import Fraction

    dt = conservation.FREE["bar, 2 rad"].dt
    for n in conservation.marks(conservation.STEPS).tolist():
        assert Fraction(float(n) * dt) == n * Fraction(dt)


@pytest.mark.slow
def test_a_broken_balance_is_seen(runs):
    (row,) = [r for r in runs if r["kind"] == "balance"]
    assert row["largest"] < 1e-13 * row["energy"]
    content = conservation.content([row | {"largest": 1e-9}], [])
    assert False in claims(content).values()


@pytest.mark.parametrize("id", covering(FORMS))
def test_nothing_is_carried_for_nothing(id):
    row = leave_out.carried_numbers(TASKS[id]())
    assert (row["unused"], row["idle"]) == ([], [])
    assert row["operations"] > 0 and row["stages"]


def test_unused_things_are_found():
    needed = leave_out.live(["a = f(k_one)", "b = g(k_two, a)", "z = h(a)"], ["z"])
    assert "k_one" in needed and "k_two" not in needed and "b" not in needed


@pytest.mark.slow
def test_what_is_left_out_saves_operations():
    rows = list(leave_out.savings(len(leave_out.PAIRS), 1))
    assert all(row["operations"][0] < row["operations"][1] for row in rows)
    assert all(ns > 0 for row in rows for ns in row["ns"])
    content = leave_out.content([*rows, *leave_out.terms()], [])
    assert set(claims(content).values()) == {True}
    assert len(content.summary.rows) == len(FORMS)
    assert content.pictures[0].draw().axes


@pytest.mark.parametrize(
    "name", [name for name, problem in conservation.FREE.items() if form_of(problem.scene).angle is not None]
)
def test_cosine_and_sine_stay_a_pair(name):
    """c² + s² does not grow; θ differs from the pair's angle only by its own accumulated roundings."""
    at = conservation.marks(100_000)
    theta, _, c, s = conservation.lifted_run(conservation.FREE[name], conservation.LAG_ENVS, at).T
    assert np.abs(c * c + s * s - 1.0).max() < 1e-15
    turns = (theta - np.arctan2(s, c)) / (2.0 * math.pi)
    apart = 2.0 * math.pi * np.abs(turns - np.round(turns))
    assert (apart <= 4.0 * ROUNDING * at * np.maximum(1.0, np.abs(theta))).all()


#: Constants that act only at random or at a limit are changed by more, so that few steps show it.
MOVED = {"chance0": 1.0, "limit": 0.5, "x": 0.01, "self_radius": 0.5, "self_shell_radius": 0.5}


@pytest.mark.parametrize("id", covering((i for i in FORMS if i in PERFECT), of=engine))
def test_every_constant_changes_something(id):
    """Change each constant, by 1e-3 unless stated otherwise: the results of a start or step differ."""
    env = gym.make(id).unwrapped
    env.reset(seed=1)
    program, rows, angle = env._program, env._rows.copy(), form_of(env.task.scene).angle
    first, n = len(program.kept + program.scratch), len(program.y)
    rng = np.random.default_rng(2)
    starts = []
    for i in range(6000):
        start = rows.copy()
        start[:n] = rng.uniform(-8.0, 8.0, n) * (0.1 if i % 2 else 1.0)
        if angle is not None:
            if i % 2:
                start[angle + 1] = 0.005 * i  # passes the certified speed
            start[n - 2 : n] = math.cos(start[angle]), math.sin(start[angle])
        start[program.kept.index("n")] = i % 500
        starts.append((start, float(rng.uniform(-1, 1)), i))

    def outcomes(j, factor):
        obs = np.zeros(len(program.o), dtype=np.float32)
        for start, action, i in starts:
            row = start.copy()
            row[first + j] *= factor
            result = env._step(row, obs, action, np.array([1, i, i], dtype=np.uint64))
            yield (*row[: len(program.kept)], *result, *obs)
        begun = rows.copy()
        begun[first + j] *= factor
        program.start_one(begun, obs, np.array([1, 0, 0], dtype=np.uint64), False, False)
        yield (*begun[: len(program.kept)], *obs)

    for j, name in enumerate(program.uniform):
        pairs = zip(outcomes(j, 1.0), outcomes(j, 1.0 + MOVED.get(name, 1e-3)), strict=True)
        # NaN would differ from itself.
        assert any(not np.array_equal(a, b, equal_nan=True) for a, b in pairs), f"{name} changes nothing"
