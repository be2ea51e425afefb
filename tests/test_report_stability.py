"""A small report of bound and stability, and whether its claims hold."""

import json

import numpy as np
import pytest
from mpmath import mp, mpf

from lag_envs.report import bound, extremes, reference, stability, stability_results
from lag_envs.report.cases import VARIANTS, Case, ensemble, scales
from lag_envs.report.oracle import Unresolved
from lag_envs.scenes import PivotedBar
from lag_envs.stepping import pendulum
from lag_envs.stepping.pendulum import Coefficients
from lag_envs.tasks import cylinder_in_cylinder


def draw(content):
    """Draw every picture and write every cell as JSON, like a report."""
    for picture in content.pictures:
        picture.draw().canvas.draw()
    for table in (*content.tables, *content.details, *filter(None, [content.summary])):
        assert {len(row) for row in table.rows} == {len(table.columns)}
        json.dumps(table.rows, allow_nan=False)


# --- bound ---


def test_bound_is_never_broken():
    """30 comparisons of truncation with the bound, of each of θ and θ'; none closer than a factor of 10."""
    rows = list(bound.bound_points(6, seed=5))
    assert len(rows) == 30
    for row in rows:
        assert 0.0 < 10.0 * row["theta"] < row["theta_bound"]
        assert 0.0 < 10.0 * row["theta_dot"] < row["theta_dot_bound"]
    content = bound.content(rows, [])
    assert content.claims[0].holds
    assert "60 comparisons" in content.claims[0].evidence
    draw(content)
    rows[3]["theta"] = 2.0 * rows[3]["theta_bound"]
    claim = bound.content(rows, []).claims[0]
    assert not claim.holds
    assert claim.evidence.startswith("1 of 60")


def test_what_is_left_out_is_the_sum_of_the_rest():
    """The exact end minus the series multiplied out by hand, and minus the compiled recurrence."""
    alpha, gamma, theta, omega, h = 3.0, 0.75, 0.4, 1.1, 0.125
    drive = Coefficients(alpha, 0.0, gamma, 0.0, 0.0)
    scene, control = bound.driven(drive)
    end = reference.exact_flow(scene, [0.0, 0.0, theta, omega], control, h)[2:]
    with mp.workdps(60):
        cos, sin = mp.cos_sin(mpf(theta))
        a, g, w, t = mpf(alpha), mpf(gamma), mpf(omega), mpf(h)
        first = -a * sin - g * w
        second = -a * cos * w - g * first
        third = a * sin * w**2 - a * cos * first - g * second
        by_hand = [
            theta + w * t + first * t**2 / 2 + second * t**3 / 6 + third * t**4 / 24,
            w + first * t + second * t**2 / 2 + third * t**3 / 6,
        ]
        for found, kept, exact in zip(bound.truncation(theta, omega, drive, h, 3), by_hand, end, strict=True):
            assert found == pytest.approx(float(abs(exact - kept)), rel=1e-12)
    W, _ = pendulum.taylor_coefficients(omega * h, float(cos), float(sin), pendulum.scaled(drive, h), 3)
    kept = [theta + sum(x / (k + 1) for k, x in enumerate(W)), sum(W) / h]
    assert kept == pytest.approx([float(x) for x in by_hand], rel=1e-15)


def test_bound_is_that_of_the_product():
    """With the package's x, the drawn bound is the bound that the package reports."""
    drive, omega, h = Coefficients(20.0, 3.0, 0.5, 0.0, 0.0), 2.0, 0.01
    known = pendulum.truncation_bound(omega, drive, h)
    assert known.substeps == 1
    x = pendulum.least_majorant(omega, drive, h)
    assert bound.majorant(x, h, known.order) == pytest.approx((known.theta, known.theta_dot), rel=1e-12)
    assert pendulum.certified(omega, drive, bound.step_at(omega, drive, 0.3), 0.3001, np)


def test_cost_of_the_bound():
    rows = list(bound.substeps_needed(6, seed=3))
    assert all(1 <= row["needed"] <= row["chosen"] <= bound.MOST_SUBSTEPS for row in rows)
    content = bound.content(rows, [])
    assert content.claims[0].holds is None
    assert content.claims[1].holds
    draw(content)


def test_environments_keep_within_the_bound():
    *steps, reach = bound.environment(cylinder_in_cylinder.Pump.id, 4)
    assert all(row["substeps"] == 1 and row["theta_dot"] < row["theta_dot_bound"] < 1.01e-12 for row in steps)
    assert reach["certified"] == pytest.approx(6.094, abs=0.001)
    assert 1.5 < reach["actual"] / reach["certified"] < 3.0
    content = bound.content([*steps, reach], [])
    assert content.summary.rows[0][3] == 6.0  # rounded down
    draw(content)
    draw(bound.content([reach], []))


# --- stiff and extreme cases ---


@pytest.mark.slow
def test_verdicts():
    """All of the quick report's cases are met: accurate as expected, or refused as expected."""
    rows = list(stability.extreme_errors(extremes.QUICK))
    content = stability.content(rows, [])
    verdicts = {row[0]: row[-1] for row in content.tables[0].rows}
    assert verdicts == dict.fromkeys(extremes.QUICK, "met")
    assert content.claims[1].holds
    refused = [row["name"] for row in rows if row["outcome"] == extremes.REFUSED]
    assert refused == ["1e7 rad/s for a second", "r = R"]
    draw(content)


@pytest.mark.parametrize(
    "name", [name for name, case in extremes.EXTREMES.items() if case.expected == extremes.REFUSED]
)
def test_refused(name):
    row = extremes.measure_extreme(name)
    assert row["met"]
    assert row["outcome"] == extremes.REFUSED
    assert row["message"]


def test_missed_and_lost_cases_show(monkeypatch):
    """A case that is accepted but should be refused is missed; one that cannot be measured says why."""
    wrong = extremes.EXTREMES["step of 1e-6 s"]._replace(expected=extremes.REFUSED)
    monkeypatch.setitem(extremes.EXTREMES, "step of 1e-6 s", wrong)
    monkeypatch.setitem(extremes.EXTREMES, "odd", wrong._replace(scene="Unknown"))
    rows = list(stability.extreme_errors(["step of 1e-6 s", "odd"]))
    content = stability.content(rows, [])
    assert not content.claims[1].holds
    assert "step of 1e-6 s, odd" in content.claims[1].evidence
    assert [row[-1] for row in content.tables[0].rows] == ["missed", "unknown"]
    assert "Unknown" in content.tables[-1].rows[0][1]
    draw(content)


def test_amplification_of_an_upright_bar():
    """A rounding of θ and θ' grows with cosh and sinh of λ dt."""
    bar = PivotedBar(inertia=0.0, com_distance=0.5, track=None)
    rate = (9.81 / 0.5) ** 0.5
    angle, speed = extremes.amplification(Case(bar, (3.0, 0.0), 0.0), 0.001)
    assert angle == pytest.approx(3.0 + 0.001 * rate, rel=1e-4)
    assert speed == pytest.approx(rate + 3.0 * rate**2 * 0.001, rel=2e-2)


# --- maps ---


def test_heavy_damping():
    """At γ dt = 1e4 explicit Euler and RK4 diverge, lag_envs and the exponential integrator do not."""
    (row,) = stability.map_errors("damping", "PivotedBar", 0.02, [1e4])
    errors = row["errors"]
    assert errors["explicit Euler"] == errors["RK4, 16"] == stability_results.DIVERGED
    assert errors["lag_envs"] < 1e-12
    assert errors["lag_envs"] < errors["ETD4RK"] < 1e-10
    assert errors["lag_envs, float32"] == stability_results.TOO_LONG


@pytest.mark.parametrize("name", VARIANTS)
def test_ordinary_cells(name):
    """In float64 lag_envs is exact to rounding; in float32 every method is as exact as float32 can be."""
    rows = list(stability.map_errors("damping", name, 0.02, [1e-3, 1e-2]))
    for row in rows:
        errors = row["errors"]
        assert errors["lag_envs"] < 2e-15
        assert 1e-9 < errors["lag_envs, float32"] < 1e-5
        assert errors["explicit Euler"] > errors["RK4"]
        assert errors["RK4, float32"] < 1e-5
    content = stability.content(rows, [])
    assert content.claims[0].holds
    assert content.summary.rows[0][:2] == [name, "100 %"]
    draw(content)


def test_float32_of_ordinary_steps():
    """Errors of single precision, between 1e-8 and 1e-5, over an ensemble."""
    found = [case._replace(scene=PivotedBar(track=None)) for case in ensemble("PivotedBar", 20, seed=2)]
    ends = stability.methods(found, 0.02)["lag_envs, float32"]
    worst = 0.0
    for case, end in zip(found, ends, strict=True):
        exact = case.scene.simulate(case.state, [case.control], 0.02)[-1]
        worst = max(worst, np.max(np.abs(end - exact) / scales(case, 0.02)))
    assert 1e-8 < worst < 1e-5


def test_formulas_on_arrays_are_the_compiled_ones():
    """The comparison integrators as NumPy formulas give the same as the compiled flows."""
    from lag_envs.report.integrators import comparison
    from lag_envs.report.stepped import Stepped
    from lag_envs.report.timing import FlowSteps

    case = Case(PivotedBar(track=None, damping=0.01), (2.0, 3.0), 3.0)
    flow = comparison("RK4", Stepped(case.scene).flow)
    compiled = FlowSteps(case.scene, flow).end(case, 0.1 / 16, 16)
    (formula,) = stability.step_cases(flow.fast, [case], 0.1, np.array([16]), np.float64)
    assert formula == pytest.approx(compiled.tolist(), rel=1e-13)


def test_a_cell_without_a_reference_says_so(monkeypatch):
    def unresolved(*args):
        raise Unresolved("two precisions differ")

    monkeypatch.setattr(stability.reference, "remembered", unresolved)
    (row,) = stability.map_errors("damping", "PivotedBar", 0.02, [1.0])
    assert set(row["errors"].values()) == {stability_results.NO_REFERENCE}
    content = stability.content([row], [])
    assert "1 without a reference" in content.claims[0].evidence
    assert "two precisions differ" in content.tables[-1].rows[0][1]
    draw(content)


@pytest.mark.slow
def test_refused_and_amplified_cells():
    """A fast start is refused; 850,000 substeps in a shell that leaves no room are accurate to rounding."""
    (fast,) = stability.map_errors("speed", "PivotedBar", 1.0, [1e7])
    (tight,) = stability.map_errors("arm", "CylinderInCylinder, drag", 1.0, [1e-9])
    assert fast["errors"]["lag_envs"] == stability_results.REFUSED
    assert tight["errors"]["lag_envs"] > 1e-12
    assert tight["roundings"] < extremes.ROUNDINGS
    content = stability.content([fast, tight], [])
    assert content.claims[0].holds
    draw(content)
    tight["roundings"] = 2.0 * extremes.ROUNDINGS
    content = stability.content([fast, tight], [])
    assert not content.claims[0].holds
    assert content.tables[1].rows[0][-1] == "missed"


def test_many_substeps():
    """A bar of 1e-8 m swings 5,000 times in a second: an earlier version was off by 30 times too much."""
    row = extremes.measure_extreme("bar of 1e-8 m, 1 s")
    assert row["substeps"] > 200_000
    assert row["outcome"] == extremes.FULL and row["met"]
    assert row["roundings"] < 3.0
