"""Work-precision: orders of convergence, accuracy, the batch that is timed, what a missing peer leaves."""

import dataclasses
import sys
from fractions import Fraction
from functools import cache

import numpy as np
import pytest

from lag_envs.report import peers, work_precision
from lag_envs.report.cases import VARIANTS, ensemble
from lag_envs.report.runner import Result
from lag_envs.report.steppers import METHODS, comparison, plain_series
from lag_envs.report.timing import Kernels
from lag_envs.report.work_precision import Contestant, Point

ORDERS = [Contestant("ours", f"order {n}", plain_series(n), n, False) for n in (4, 8, 14, 20)]
ORDERS += [
    Contestant("comparison", name, comparison(name, VARIANTS["PivotedBar"].scene().flow), method.order, False)
    for name, method in METHODS.items()
]


@cache
def single_steps():
    return work_precision.single_steps("PivotedBar", ensemble("PivotedBar", 16))


@pytest.mark.parametrize("method", ORDERS, ids=lambda method: method.method)
def test_order_of_convergence(method):
    """The error of one step of length h grows like h^(order + 1)."""
    assert work_precision.measured_order(method, single_steps()) == pytest.approx(method.order, abs=0.2)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_step_is_exact(name):
    """A regression of the shipped stepper's accuracy fails here."""
    dt = work_precision.control_step(name)
    cases = ensemble(name, 12, seed=5)
    kernels = Kernels(cases[0].scene, cases[0].scene.flow)
    truths = [work_precision.truth(case, dt, 1) for case in cases]
    assert max(t.error(kernels.end(t.case, dt, 1)) for t in truths) < 1e-15


@pytest.mark.parametrize("name", VARIANTS)
def test_batch_has_the_bits_of_simulate(name):
    """The kernel that is timed is the one whose errors are measured; fast states take substeps."""
    dt, steps = VARIANTS[name].dt, 3
    cases = [
        case._replace(state=tuple(4.0 * x for x in case.state)) for case in ensemble(name, 70, vary=False)
    ]
    scene = cases[0].scene
    for flow in (scene.flow, comparison("RK4", scene.flow)):
        kernels = Kernels(scene, flow)
        rows = kernels.fill(cases)
        assert kernels.batch(rows, len(cases), steps, *kernels.arguments(scene, dt)) == 0
        ends = [kernels.scene.simulate(c.state, [c.control] * steps, dt)[-1] for c in cases]
        assert np.array_equal(kernels.states(rows, len(cases)), ends)


def test_kernels_refuse_other_constants():
    bar = VARIANTS["PivotedBar"].scene()
    with pytest.raises(ValueError, match="compiled for the constants"):
        Kernels(bar, bar.flow).arguments(dataclasses.replace(bar, damping=0.0), 0.02)


@pytest.mark.parametrize("name", VARIANTS)
def test_libraries_are_given_the_scene(name):
    """SciPy ends where the exact flow does, on every equation, over several control steps."""
    dt = work_precision.control_step(name)
    case = ensemble(name, 1, seed=2)[0]
    exact = work_precision.truth(case, dt, 4)
    end = peers.SciPy([case], ("DOP853", 1e-12)).move(np.array([case.state]), dt, 4)[0]
    assert exact.error(end) < 1e-11


@pytest.mark.parametrize("package", [p for p in peers.PEERS if p not in ("scipy", "mujoco")])
def test_libraries_take_batches(package):
    pytest.importorskip(package)
    cases = ensemble("CylinderInCylinder, tilt", 3)
    peer = peers.PEERS[package]
    moved = peer(cases, (peer.settings[0][0], 1e-12)).move(np.array([c.state for c in cases]), 0.05, 2)
    ends = [c.scene.simulate(c.state, [c.control] * 2, 0.05)[-1] for c in cases]
    assert np.abs(moved - ends).max() < 1e-7


def test_a_missing_library_is_a_row(monkeypatch):
    monkeypatch.setitem(sys.modules, "heyoka", None)
    rows = list(work_precision.library("PivotedBar", "heyoka", quick=True))
    assert [row["problem"] for row in rows] == ["heyoka is not installed"]
    table = next(t for t in work_precision.content(rows, []).tables if t.name.endswith("problems"))
    assert table.rows == [["PivotedBar", "one step", "heyoka Taylor", "0.0001", "heyoka is not installed"]]


def test_a_lost_job_is_a_row_and_claims_nothing():
    """Without rows every claim is open; the problem is told."""
    lost = Result("work_precision", "times: PivotedBar", "key", problem="stopped after 120 s")
    content = work_precision.content([], [lost])
    assert all(claim.holds is None for claim in content.claims)
    assert any("stopped after 120 s" in row for table in content.tables for row in table.rows)


def test_a_point_is_matched_by_error_and_time():
    def point(ns, *errors):
        worst = None if None in errors else max(errors)
        return Point("v", "one step", "batch", "ours", "m", 1, worst, worst, errors, ns)

    other = point(10.0, 1e-9, 1e-8)
    assert work_precision.matched(other, [point(10.0, 1e-9, 1e-8, 1.0)], 0.0)
    assert not work_precision.matched(other, [point(11.0, 0.0, 0.0), point(9.0, 0.0, 2e-8)], 0.0)
    assert not work_precision.matched(other, [point(9.0, 0.0, None)], 0.0)
    assert work_precision.matched(other, [point(9.0, 0.0, 2e-8)], 1e-8)


def test_rows_become_points_and_a_picture():
    """Substeps multiply the time; a library without a batch is drawn at its own time."""
    about = {"variant": "PivotedBar", "horizon": "one step"}
    errors = {"error": 1e-9, "median": 1e-10, "errors": [1e-9], "members": 1, "diverged": 0}
    rows = [
        about | {"kind": "time", "method": "RK4", "single": 50.0, "batch": 8.0},
        about | {"kind": "time", "method": "lag_envs", "single": 80.0, "batch": 10.0},
        about | {"kind": "error", "family": "comparison", "method": "RK4", "substeps": 4, **errors},
        about | {"kind": "error", "family": "ours", "method": "lag_envs", "substeps": 1, **errors},
        about | {"kind": "library", "family": "scipy", "method": "RK45", "setting": 1e-5, **errors}
        | {"single": 1e5, "batch": None},
        about | {"kind": "rounding", "amplified": 1e-16},
    ]  # fmt: skip
    times = {(p.method, p.mode): p.ns for p in work_precision.gathered(rows)}
    assert times == {
        ("RK4", "single"): 200.0, ("RK4", "batch"): 32.0,
        ("lag_envs", "single"): 80.0, ("lag_envs", "batch"): 10.0,
        ("RK45", "single"): 1e5, ("RK45", "batch"): 1e5,
    }  # fmt: skip
    content = work_precision.content(rows, [])
    assert content.claims[0].holds
    assert len(content.pictures[0].draw().axes) == 2
    assert content.summary.rows[0][4] == "RK4, 4 substeps: 2.5 ×"


def test_long_horizons_are_exact_products():
    """The reference is asked for the time that the steps add up to, without a rounding."""
    for name in VARIANTS:
        dt = work_precision.control_step(name)
        for horizon in work_precision.HORIZONS.values():
            steps = horizon.steps(dt)
            assert Fraction(dt) * steps == Fraction(dt * steps)
