"""The report on scenes of energies: exact ends, equal models for all, and whose setting is the quickest."""

import importlib.util
from functools import cache

import numpy as np
import pytest
from covering import slow

from lag_envs.report import general, general_results
from lag_envs.report.linkage_rivals import ENGINES, differences
from lag_envs.report.linkages import SYSTEMS
from lag_envs.report.motions import CertifiedSeries, SceneEquation, SceneProblems
from lag_envs.report.oracle import oracle_of
from lag_envs.report.peers import Heyoka
from lag_envs.report.radau import CompiledRadau
from lag_envs.report.reference import exact_ends
from lag_envs.report.rivals import CompiledMethod
from lag_envs.scenes import Scene, parameter
from lag_envs.scenes.derivation import order_of

COUNT = 3


class Trolley(Scene):
    """A pendulum on a trolley whose rate, or place, is held, with terms that a rival cannot leave out."""

    length: float = parameter(0.7, "m", above=0.0)
    steep: float = parameter(0.4, "1/m")
    drag: float = parameter(0.1, "N m s", least=0.0)
    control: str = "rate"

    coordinates = {"theta": "rad"}
    prescribed = {"s": "m"}
    modes = {"rate": {"s_dot": "m/s"}, "place": {"s": "m"}, "acceleration": {"s_ddot": "m/s²"}}

    def kinetic(self, q, v, xp):
        along = v.s + self.length * v.theta * xp.cos(q.theta)
        return 0.5 * (along**2 + (self.length * v.theta * xp.sin(q.theta)) ** 2) + 0.1 * v.theta**2

    def potential(self, q, xp):
        return -9.81 * self.length * xp.cos(q.theta) * xp.exp(self.steep * q.s)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.drag * v.theta**2


@cache
def problem(name):
    """Return a system's problems and their exact ends."""
    system = SYSTEMS[name]
    starts, controls = system.draw(COUNT)
    return SceneProblems(system.scene, starts, controls, system), exact_ends(
        system.scene, starts, controls, general_results.DT
    )


def worst(rival, name, together=False):
    problems, truth = problem(name)
    return general.worst_and_median(rival.build(problems, general_results.DT, 1, together).end(), truth)[0]


# --- the reference ---


@pytest.mark.parametrize(
    "rivals",
    [
        (CertifiedSeries(18, 1e-14), CompiledMethod("DOP853", 8)),
        slow((CompiledRadau(200),)),
    ],
    ids=["explicit", "implicit"],
)
@pytest.mark.parametrize("control", ["rate", slow("place"), slow("acceleration")])
def test_what_moves_a_support(control, rivals):
    """The exact end, and the integrators' equation, whether acceleration, rate or place is held."""
    scene = Trolley(control=control)
    states = np.random.default_rng(1).uniform(-2, 2, (4, len(scene.state_names)))
    controls = np.random.default_rng(2).uniform(-2, 2, (4, 1))
    truth = exact_ends(scene, states, controls, 0.05)
    problems = SceneProblems(scene, states, controls)
    for rival in rivals:
        assert general.worst_and_median(rival.build(problems, 0.05, 1, False).end(), truth)[0] < 1e-13


# --- the rivals ---


@pytest.mark.parametrize("name", SYSTEMS)
def test_equations_of_the_rivals_are_those_of_sympy(name):
    system = SYSTEMS[name]
    starts, controls = system.draw(20, seed=7)
    problems, oracle = SceneProblems(system.scene, starts, controls), oracle_of(system.scene)
    rates = SceneEquation(system.scene).rate(0.0, problems.y, problems.p, np)
    n = problems.equation.size // 2
    for j in range(20):
        exact = oracle.at(starts[j].tolist(), controls[j].tolist())[1]
        np.testing.assert_allclose(
            [r[j] for r in rates[n:]], exact, rtol=1e-10, atol=1e-11 * np.abs(exact).max()
        )


@pytest.mark.parametrize("name", SYSTEMS)
def test_mujoco_has_the_same_models(name):
    pytest.importorskip("mujoco")
    assert max(differences(SYSTEMS[name], "mujoco")) < general_results.EQUAL


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_pinocchio_has_the_same_models(name, tmp_path_factory, monkeypatch):
    if importlib.util.find_spec("pinocchio") is None:
        pytest.skip("Pinocchio is not installed")
    from lag_envs.report import reference

    monkeypatch.setattr(reference, "store", reference.store or tmp_path_factory.getbasetemp())
    assert max(differences(SYSTEMS[name], "pinocchio")) < general_results.EQUAL


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("name", ["cart-pole", slow("double pendulum, driven")])
def test_it_is_what_simulate_does(name, together):
    """The timed code has the bits of `simulate`."""
    problems, _ = problem(name)
    order = int(order_of(problems.scene, general_results.DT))
    found = CertifiedSeries(order, 1e-14).build(problems, general_results.DT, 1, together).end()
    paths = [
        problems.scene.simulate(y, u[None], general_results.DT)[-1]
        for y, u in zip(problems.starts, problems.controls, strict=True)
    ]
    assert np.array_equal(found, paths)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cart-pole", "rotary pendulum"])
def test_every_rival_converges(name):
    """No form is fast because it is broken."""
    assert worst(CertifiedSeries(12, 1e-6), name) < 1e-5
    for rival in (CompiledMethod("RK4", 256), CompiledMethod("DOP853", 8), CompiledRadau(64)):
        assert worst(rival, name) < 1e-9, rival.method
    if importlib.util.find_spec("mujoco"):
        assert worst(ENGINES["mujoco"]("RK4", 128), name) < 1e-9
    if importlib.util.find_spec("heyoka"):
        for together in (False, True):
            assert worst(Heyoka("Taylor", 1e-12), name, together) < 1e-11


# --- results ---


def point(family, method, setting, error, ns, mode="single", batched=True, clock=100.0):
    return {
        "kind": "point", "system": "cart-pole", "mode": mode, "family": family, "method": method,
        "setting": setting, "error": error, "ns": ns, "clock": clock, "batched": batched,
    }  # fmt: skip


ROWS = [
    point("lag_envs", "lag_envs, order 8", 1e-4, 1e-5, 50.0),
    point("lag_envs", "lag_envs, order 16", 1e-12, 1e-13, 80.0),
    point("lag_envs", "lag_envs, order 16", 1e-12, 1e-13, 20.0, "batch"),
    point("heyoka", "Taylor", 1e-9, 1e-10, 160.0, clock=200.0),
    point("mujoco", "RK4", 8, 1e-4, 900.0, batched=False),
]


def test_times_are_compared_at_equal_error_in_one_clock():
    found = general_results.best_settings(ROWS)
    assert found["cart-pole", "single", 1e-3]["lag_envs"].ns == 50.0
    assert found["cart-pole", "single", 1e-6]["lag_envs"].ns == 80.0
    assert found["cart-pole", "single", 1e-6]["heyoka"].ns == 80.0  # its job ran at half the speed
    assert "MuJoCo" not in found["cart-pole", "single", 1e-6]
    assert found["cart-pole", "batch", 1e-3]["MuJoCo"].ns == 900.0  # it has no batch


def test_a_defeat_is_told_like_a_win():
    rows = [*ROWS, point("compiled", "RK4", 1, 1e-4, 10.0)]
    content = general_results.content(rows, [])
    alone = next(c for c in content.claims if "compiled like lag_envs, alone" in c.text)
    assert alone.holds is False and "RK4, compiled by 5.00 (cart-pole, 0.001)" in alone.evidence
    assert any(
        "RK4, compiled takes 0.2 to 0.2 times our time, and is faster in 1 of 1" in t for t in content.text
    )
    assert [row[0] for row in content.summary.rows] == ["cart-pole", "cart-pole"]


def test_what_is_missing_is_said_and_no_error(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "heyoka", None)
    problems, truth = problem("cart-pole")
    rows = list(general.timed_rivals("cart-pole", problems, truth, [Heyoka("Taylor", 1e-9)], "single", 1))
    assert [row["problem"] for row in rows] == ["heyoka is not installed"]
    assert "Not compared: heyoka is not installed." in general_results.content(rows, []).text


def test_certificates_of_a_scene():
    system = SYSTEMS["cart-pole"]
    attempts, bounds = general.attempts_and_bounds(system.scene, *system.draw(20), 0.02, 16)
    assert attempts == [1] * 20 and bounds.max() < 1e-12
    assert general.shares([1, 2, -5]) == {"share": 1 / 3, "attempts": 1.5, "refused": 1}
