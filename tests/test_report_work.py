"""Work-precision: orders of convergence, rivals in their best forms, statements about who is faster."""

import dataclasses
import json
import re
import sys
from fractions import Fraction
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from covering import every, slow

from lag_envs.report import diagrams, peers, work_precision
from lag_envs.report import work_precision_results as results
from lag_envs.report.cases import VARIANTS, ensemble
from lag_envs.report.equations import Equation, Problems
from lag_envs.report.integrators import METHODS, comparison
from lag_envs.report.points import LAG_ENVS, MODES, TARGETS, WorkPrecisionPoint
from lag_envs.report.rivals import CompiledMethod, ShippedStepping
from lag_envs.report.timing import FlowSteps
from lag_envs.report.work_precision import OrderedMethod
from lag_envs.scenes.derivation import form_of

BAR = VARIANTS["PivotedBar"].scene()
SERIES = [
    s for s in work_precision.series(BAR) if s.method.partition(" ")[0] != "plain" or s.order in (4, 14)
]


@cache
def single_steps():
    return work_precision.single_steps("PivotedBar", ensemble("PivotedBar", 16))


@cache
def truths(name, count, steps=1):
    dt = work_precision.control_step(name)
    return [work_precision.exact_end(case, dt, steps) for case in ensemble(name, count, seed=5)]


def worst(rival, name, together, steps=1, count=6):
    """Return the largest error of a rival, run as in the report."""
    some = truths(name, count, steps)
    sample = rival.build(Problems([t.case for t in some]), work_precision.control_step(name), steps, together)
    return max(t.error(end) for t, end in zip(some, sample.end(), strict=True))


@pytest.mark.parametrize(
    "method",
    [*SERIES[:2], *(pytest.param(method, marks=pytest.mark.slow) for method in SERIES[2:])],
    ids=lambda method: method.method,
)
def test_order_of_convergence(method):
    """The error of one step of length h grows like h^(order + 1), however cosine and sine are computed."""
    assert work_precision.measured_order(method, single_steps()) == pytest.approx(method.order, abs=0.2)


# --- the shipped stepping ---


@pytest.mark.parametrize("name", every(3, VARIANTS))
@pytest.mark.parametrize("mode", MODES)
def test_a_step_is_exact(name, mode):
    """A regression of the shipped integrator's accuracy fails here."""
    assert worst(ShippedStepping(), name, mode == "batch", count=12) < 1e-15


@pytest.mark.parametrize("name", every(3, VARIANTS))
def test_the_shipped_stepping_is_what_simulate_does(name):
    """What is timed has the bits of the shipped `simulate`, alone and in a batch, at any speed."""
    dt, steps = work_precision.control_step(name), 3
    cases = [
        case._replace(state=tuple(4.0 * x for x in case.state)) for case in ensemble(name, 70, vary=False)
    ]
    found = (
        (ShippedStepping(), dt, 3),
        (ShippedStepping(2), dt / 2, 6),
        (ShippedStepping(one_call=True), steps * dt, 1),
    )
    for rival, length, count in found:
        ends = [c.scene.simulate(c.state, [c.control] * count, length)[-1] for c in cases]
        for together in (False, True):
            sample = rival.build(Problems(cases), dt, steps, together)
            assert np.array_equal(sample.end(), ends), (rival.method, rival.setting, together)


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("name", VARIANTS)
def test_only_what_is_shipped_counts_as_lag_envs(name, quick):
    """Only the scene's own order and tolerance are compared with others."""
    for horizon in work_precision.QUICK if quick else work_precision.HORIZONS:
        found = work_precision.variant_rivals(name, horizon, "compiled", quick)
        assert {r.method for r in found if r.family == "lag_envs"} <= {
            ShippedStepping.METHOD,
            ShippedStepping.ONE_CALL,
        }
        assert {r.family for r in found} == {"lag_envs", "compiled"}
        assert not any("series" in r.method for r in found)


def test_a_refused_step_is_no_point():
    case = ensemble("PivotedBar", 1)[0]._replace(state=(0.0, 1e12))
    with pytest.raises(ArithmeticError, match="refused"):
        ShippedStepping().build(Problems([case]), 0.02, 1, False).end()


def test_kernels_refuse_other_constants():
    with pytest.raises(ValueError, match="compiled for the constants"):
        FlowSteps(BAR).arguments(dataclasses.replace(BAR, damping=0.0), 0.02)


# --- rivals: no form is fast because it is broken ---


@pytest.mark.parametrize("mode", every(2, MODES))
@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("PivotedBar", "RK4"), ("PivotedBar", "RK4, carried"), ("PivotedBar", "ETD4RK, carried"),
        ("Incline, drag", "DOP853"),
        *((name, "DOP853, carried") for name in VARIANTS if name != "Incline, drag"),
    ],
)  # fmt: skip
def test_integrators_are_accurate(name, method, mode):
    assert method in CompiledMethod.methods(Problems(ensemble(name, 1)).equation)
    assert worst(CompiledMethod(method, 32), name, mode == "batch") < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_all_integrators_are_accurate(name):
    """In every form, and with the same bits in a batch as alone."""
    some = [t.case for t in truths(name, 6)]
    for method in CompiledMethod.methods(Problems(some).equation):
        order = METHODS[method.removesuffix(CompiledMethod.CARRIED)].order
        assert worst(CompiledMethod(method, 256), name, False) < max(10.0 ** (-4 * order + 2), 1e-11), method
        ends = [
            CompiledMethod(method, 2).build(Problems(some), 0.02, 3, together).end()
            for together in (False, True)
        ]
        assert np.array_equal(*ends), method


@pytest.mark.parametrize("name", ["PivotedBar", "CylinderInCylinder, tilt", "Incline, moving"])
def test_held_controls_are_one_call(name):
    """Over many control steps an integrator takes substeps, or one step for several."""
    fine, coarse = (worst(CompiledMethod("DOP853, carried", n), name, True, 40) for n in (4, 1 / 4))
    assert fine < 1e-12 and coarse < 1e-2
    assert CompiledMethod("RK4", 1 / 4).substeps(40) == 10


@pytest.mark.parametrize("method", ["dopri5", "dop853", "lsoda", "Radau"])
@pytest.mark.parametrize("name", every(2, VARIANTS))
def test_libraries_are_given_the_scene(name, method):
    """SciPy ends where the exact flow does, on every equation, over several control steps."""
    rival = peers.SciPy(method, 1e-11)
    for together in (False, True) if rival.batched else (False,):
        assert worst(rival, name, together, steps=4, count=3) < 1e-8


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("steps", [slow(1), 20])
@pytest.mark.parametrize("name", every(2, VARIANTS))
def test_heyoka(name, steps, mode):
    """Its compiled step in a loop, and propagate_until over a longer time, alone and in blocks."""
    pytest.importorskip("heyoka")
    assert worst(peers.Heyoka("Taylor", 1e-15), name, mode == "batch", steps, count=19) < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_heyokas_own_step_is_what_is_timed(mode, monkeypatch):
    """The loop around heyoka's machine code has the bits of its propagate_until."""
    pytest.importorskip("heyoka")
    problems, ends = Problems(ensemble("CylinderInCylinder, tilt", 19)), []
    ends.append(peers.Heyoka("Taylor", 1e-10).build(problems, 0.05, 1, mode == "batch").end())
    monkeypatch.setattr(peers, "_compiled_step", lambda integrator: None)
    ends.append(peers.Heyoka("Taylor", 1e-10).build(problems, 0.05, 1, mode == "batch").end())
    assert np.array_equal(*ends)


@pytest.mark.parametrize(
    ("method", "setting"), [("Euler", 256), ("implicitfast", 256), ("RK4", 16)], ids=lambda x: str(x)
)
def test_mujoco(method, setting):
    """Its own model of the bar is the bar, over more control steps than one rollout holds."""
    pytest.importorskip("mujoco")
    limit = 1e-9 if method == "RK4" else 1e-2
    assert worst(peers.MuJoCo(method, setting), "PivotedBar", False, steps=5, count=3) < limit


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("package", "method"),
    [pytest.param("diffrax", "Tsit5", marks=pytest.mark.slow), ("torchdiffeq", "dopri8")],
)
def test_libraries_take_batches(package, method, mode):
    pytest.importorskip(package)
    rival = peers.PEERS[package](method, 1e-11)
    assert worst(rival, "CylinderInCylinder, tilt", mode == "batch", steps=2, count=3) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["PivotedBar", "Incline, moving", "Incline, drag"])
@pytest.mark.parametrize("package", [p for p in peers.PEERS if p != "mujoco"])
def test_all_libraries_at_their_finest(package, name, mode):
    pytest.importorskip(package)
    for method, settings in peers.PEERS[package].settings.items():
        rival = peers.PEERS[package](method, settings[-1])
        if rival.batched or mode == "single":
            assert worst(rival, name, mode == "batch", count=3) < results.ACCURATE, method


def test_a_scene_of_ones_own():
    """Rivals take any equation: here one without its own flow, with two angles that are carried along."""

    class Coupled(Equation):
        """Two pendulums with a spring; closed form for small swings in phase: cos(√p t)."""

        size, lifted, parameters = 4, 8, 1

        def rate(self, t, y, p, xp):
            a, b, va, vb, *pairs = y
            ca, sa, cb, sb = pairs or (xp.cos(a), xp.sin(a), xp.cos(b), xp.sin(b))
            turns = (-(va * sa), va * ca, -(vb * sb), vb * cb) if pairs else ()
            spring = 3.0 * (b - a)
            return va, vb, spring - p[0] * sa, -spring - p[0] * sb, *turns

    class Some:
        equation = Coupled()
        p = np.array([[9.0, 4.0]])
        y = np.array([[1e-6, 1e-6]] * 2 + [[0.0, 0.0]] * 2 + [[1.0, 1.0], [1e-6, 1e-6]] * 2)

        def __len__(self):
            return 2

        def states(self, y, span):
            return np.array(y[:4].T)

    exact = 1e-6 * np.cos(np.sqrt(Some.p[0]) * 0.4)
    found = [CompiledMethod("RK4", 8), CompiledMethod("DOP853, carried", 1), peers.SciPy("dop853", 1e-12)]
    for rival in found + ([peers.Heyoka("Taylor", 1e-15)] if find_spec("heyoka") else []):
        for together in (False, True):
            ends = rival.build(Some(), 0.1, 4, together).end()
            assert ends[:, 0] == pytest.approx(exact, rel=1e-4, abs=0) and ends.shape == (2, 4)
    wrong = Some()
    wrong.y = Some.y * np.array([[1.0]] * 4 + [[0.0]] * 4)  # unknowns that are not carried are not used
    assert CompiledMethod("RK4", 8).build(wrong, 0.1, 4, True).end()[:, 0] == pytest.approx(
        exact, rel=1e-4, abs=0
    )
    with pytest.raises(ValueError, match="ETD4RK needs more than the rate"):
        CompiledMethod("ETD4RK", 1).build(Some(), 0.1, 4, False)
    assert "Verlet" in CompiledMethod.methods(Problems(ensemble("PivotedBar", 1)).equation)


def test_a_missing_library_is_a_row(monkeypatch):
    monkeypatch.setitem(sys.modules, "heyoka", None)
    rows = list(work_precision.variant_points("PivotedBar", "heyoka", quick=True))
    assert [row["problem"] for row in rows] == ["heyoka is not installed"]
    table = next(t for t in work_precision.content(rows, []).tables if t.name.endswith("problems"))
    assert table.rows == [
        ["PivotedBar", "one step, alone", "heyoka Taylor, 0.0001", "heyoka is not installed"]
    ]


def test_what_takes_too_long_is_not_run(monkeypatch):
    monkeypatch.setattr(work_precision, "LIMIT", 0.0)
    monkeypatch.setattr(work_precision, "QUICK", {"one step": work_precision.QUICK["one step"]})
    rows = list(work_precision.variant_points("PivotedBar", "scipy", quick=True))
    assert rows and all(row["problem"].startswith("not run: it would take") for row in rows)
    assert len({(row["mode"], row["method"]) for row in rows}) == len(rows)


# --- statements ---


def row(
    method, ns, error, *, family="compiled", variant="PivotedBar", horizon="one step", mode="single", **more
):
    """Return the row of a point; several errors, one may be None."""
    errors = error if isinstance(error, list) else [error]
    kept = [e for e in errors if e is not None]
    return {
        "kind": "point", "variant": variant, "horizon": horizon, "mode": mode, "family": family,
        "method": method, "setting": 1, "batched": True, "ns": ns, "clock": 100.0, "errors": errors,
        "error": max(kept, default=None), "median": max(kept, default=None), "members": len(errors),
        "diverged": len(errors) - len(kept), "digest": method,
    } | more  # fmt: skip


def both(*args, **options):
    return [row(*args, mode=mode, **options) for mode in MODES]


OWN = both(LAG_ENVS, 100.0, 1e-16, family="lag_envs")


def claimed(rows, horizon="One step"):
    found = [c for c in work_precision.content(rows, []).claims if c.text.startswith(horizon)]
    assert len(found) == 1
    return found[0]


def test_a_faster_rival_is_a_defeat_in_every_text():
    rows = OWN + both("DOP853, carried", 80.0, 1e-13) + both("RK4", 20.0, 1e-7)
    content = work_precision.content(rows, [])
    claim = claimed(rows)
    assert claim.holds is False
    assert claim.evidence == (
        "0 of 2; faster: PivotedBar alone: DOP853, carried, 1 substep, 0.8 ×; "
        "PivotedBar in a batch: DOP853, carried, 1 substep, 0.8 ×"
    )
    text = " ".join(content.text)
    assert "To 1e-06: a rival is faster in 2 of 2 comparisons and takes 0.2 (PivotedBar alone: RK4" in text
    assert "To 1e-12: a rival is faster in 2 of 2 comparisons and takes 0.8 (PivotedBar alone: DOP853" in text
    assert content.summary.rows[0] == [
        "PivotedBar", "alone", "1e-16", 100.0, "RK4, 1 substep: 0.2 ×",
        "DOP853, carried, 1 substep: 0.8 ×", "DOP853, carried, 1 substep: 0.8 ×",
    ]  # fmt: skip
    assert "To 1e-12: a rival is faster in 2 of 2" in content.summary.caption


def test_a_slower_rival_is_a_win():
    rows = OWN + both("DOP853", 250.0, 1e-13) + both("RK4", 20.0, 1e-7)
    assert claimed(rows).holds is True
    assert claimed(rows).evidence == "2 of 2; the fastest rivals take 2.5 to 2.5 × our time"
    assert (
        "To 1e-12: lag_envs is faster in 2 of 2, where the fastest rival takes 2.5 times as long."
        in work_precision.content(rows, []).summary.caption
    )


def test_a_rival_that_gets_there_alone_is_a_defeat():
    rows = both(LAG_ENVS, 100.0, 1e-10, family="lag_envs") + both("DOP853", 250.0, 1e-13)
    assert claimed(rows).holds is False and "lag_envs not at all" in claimed(rows).evidence
    assert "lag_envs does not reach the error and a rival does in 2" in " ".join(
        work_precision.content(rows, []).text
    )


def test_a_lost_member_reaches_nothing():
    rows = OWN + both("RK4", 20.0, [1e-14, None])
    assert claimed(rows).holds is True


def test_forms_that_are_broken_are_told():
    content = work_precision.content([*OWN, *both("RK4", 20.0, 1e-12)], [])
    assert next(c for c in content.claims if c.text.startswith("No form")).holds is True
    rows = [*OWN, *both("RK4", 20.0, 1e-12), *both("RK4, carried", 9.0, 1e-3), *both("Verlet", 9.0, 1e-3)]
    claim = next(c for c in work_precision.content(rows, []).claims if c.text.startswith("No form"))
    assert claim.holds is False and "RK4, carried on PivotedBar alone: 1.0e-03" in claim.evidence
    assert "Verlet" not in claim.evidence  # its order is 2


def test_batches_with_other_bits_are_told():
    same = [*OWN, *both("RK4", 20.0, 1e-12)]
    claims = work_precision.content(same, []).claims
    assert next(c for c in claims if c.text.startswith("Batches")).evidence == "2 of 2"
    claims = work_precision.content([*same[:-1], same[-1] | {"digest": "else"}], []).claims
    assert next(c for c in claims if c.text.startswith("Batches")).holds is False


def test_sentences_count_what_the_table_has():
    """Random points: every count and every ratio in a sentence appears in the table."""
    rng = np.random.default_rng(1)
    rows = []
    for variant in VARIANTS:
        for horizon in results.HORIZONS:
            place = {"variant": variant, "horizon": horizon}
            rows += both(LAG_ENVS, 100.0, 1e-16, family="lag_envs", **place)
            rows += [
                row(
                    name, float(rng.uniform(20, 300)), float(10.0 ** rng.uniform(-16, -2)), mode=mode, **place
                )
                for name in METHODS
                for mode in MODES
            ]
    content = work_precision.content(rows, [])
    table = next(t for t in content.tables if t.name.endswith("targets"))
    assert_sentences_agree(content.text, table.columns, table.rows)


def assert_sentences_agree(text, columns, rows):
    """Check the paragraphs about who is faster against the table of targets."""
    found = [dict(zip(columns, line, strict=True)) for line in rows]
    seen = 0
    for paragraph in text:
        horizon = paragraph.partition(".")[0].lower()
        for target, sentence in re.findall(r"To (1e-\d\d): (.*?)\.(?= To 1e|$)", paragraph):
            here = [r for r in found if r["horizon"] == horizon and r["error"] == float(target)]
            ratios = sorted(r["other / lag_envs"] for r in here if r["other / lag_envs"] is not None)
            lost, won = [r for r in ratios if r < 1.0], [r for r in ratios if r >= 1.0]
            for words, some in (("a rival is faster in", lost), ("lag_envs is faster in", won)):
                counts = re.findall(rf"{words} (\d+) of (\d+)", sentence)
                assert counts == ([(str(len(some)), str(len(here)))] if some else [])
            if lost:
                assert f"takes {lost[0]:.2g} (" in sentence and f"{lost[-1]:.2g} (" in sentence
            if won:
                assert re.search(rf"takes {won[0]:.2g}( to {won[-1]:.2g})? times as long", sentence)
            for words, own, other in (
                ("no other method reaches the error", True, False),
                ("no method reaches the error", False, False),
                ("lag_envs does not reach the error and a rival does", False, True),
            ):  # fmt: skip
                count = sum(bool(r["lag_envs"]) == own and bool(r["fastest other"]) == other for r in here)
                assert (f"{words} in {count} (" in sentence) == bool(count)
            seen += 1
    assert seen == len({(r["horizon"], r["error"]) for r in found}) > 0


def committed():
    """Return the section that docs/accuracy.md and the README show."""
    path = Path(__file__).parents[1] / "docs" / "accuracy.json"
    sections = json.loads(path.read_text(encoding="utf-8"))["sections"]
    return next(section for section in sections if section["name"] == "work_precision")


def test_committed_sentences_count_what_the_table_has():
    section = committed()
    table = next(t for t in section["tables"] if t["name"].endswith("targets"))
    assert_sentences_agree(section["text"], table["columns"], table["rows"])


def test_committed_claims_follow_from_the_table():
    section = committed()
    table = next(t for t in section["tables"] if t["name"].endswith("targets"))
    rows = [dict(zip(table["columns"], line, strict=True)) for line in table["rows"]]
    for horizon, target in results.CLAIMED.items():
        here = [r for r in rows if (r["horizon"], r["error"]) == (horizon, target)]
        lost = [r for r in here if r["fastest other"] and (r["other / lag_envs"] or 0.0) < 1.0]
        claim = next(c for c in section["claims"] if c["text"].startswith(f"{horizon.capitalize()}: nobody"))
        assert claim["holds"] is not bool(lost)
        assert all(r["fastest other"] in claim["evidence"] for r in lost)


def test_only_what_is_shipped_is_committed_as_lag_envs():
    table = next(t for t in committed()["tables"] if t["name"].endswith("targets"))
    methods = {line[table["columns"].index("lag_envs")] for line in table["rows"]} - {None}
    steps = {
        f"{ShippedStepping.METHOD}, {words}"
        for words in ("2 substeps", *(f"a step for {n}" for n in (2, 4, 8)))
    }
    assert LAG_ENVS in methods <= {ShippedStepping.METHOD, ShippedStepping.ONE_CALL} | steps


def test_jobs_are_brought_to_one_scale():
    """A rival whose job ran on a machine of twice the speed is not counted as twice as fast."""
    slow = both("Taylor", 300.0, 1e-13, family="heyoka", clock=200.0)
    ns = {p.name: p.ns for p in results.gathered(OWN + slow)}
    assert ns == {LAG_ENVS: 100.0, "heyoka Taylor": 150.0}


def test_without_a_batch_it_is_one_after_the_other():
    radau = row("Radau", 300.0, 1e-13, family="scipy", batched=False)
    assert [p.mode for p in results.gathered([radau])] == ["single", "batch"]
    lost = row("Taylor", 300.0, 1e-13, family="heyoka")  # its batch was not run
    assert [p.mode for p in results.gathered([lost])] == ["single"]


def test_errors_below_amplified_rounding_are_none():
    rows = OWN + both("DOP853", 50.0, 3e-12)
    assert claimed(rows).holds is True
    floor = {"kind": "rounding", "variant": "PivotedBar", "horizon": "one step", "amplified": 1e-12}
    assert claimed([*rows, floor]).holds is False


def test_the_picture_has_the_fastest_form_of_each():
    def point(method, ns, error):
        return WorkPrecisionPoint(
            "PivotedBar", "one step", "single", "compiled", method, 1, error, error, [error], ns
        )

    points = [point("RK4", 50.0, 1e-9), point("RK4, carried", 20.0, 1e-8), point("RK4, carried", 60.0, 1e-8)]
    assert [(p.method, p.ns) for p in diagrams.curves(points)["RK4"]] == [
        ("RK4, carried", 20.0),
        ("RK4", 50.0),
    ]
    figure = diagrams.draw_variant("PivotedBar", points, {})
    assert len(figure.axes) == 2
    known = {*diagrams.STYLES, *diagrams.OWN_STYLES}
    assert {
        f"{results.LIBRARIES[p]} {m}".partition(",")[0] for p, c in peers.PEERS.items() for m in c.settings
    } <= known
    assert set(METHODS) <= known


def test_long_horizons_are_exact_products():
    """The reference is computed for the exact sum of the steps' times, without a rounding."""
    for name in VARIANTS:
        dt = work_precision.control_step(name)
        for horizon in work_precision.HORIZONS.values():
            steps = horizon.steps(dt)
            assert Fraction(dt) * steps == Fraction(dt * steps)


def test_targets_are_compared_once():
    found = results.compared(results.gathered(OWN), {})
    assert [(d.mode, d.target) for d in found] == [(mode, target) for mode in MODES for target in TARGETS]


def test_series_are_only_measured_for_their_order():
    assert all(isinstance(s, OrderedMethod) for s in work_precision.series(BAR))
    flow = form_of(BAR).flow(0.02)
    assert comparison("RK4", flow, True) is comparison("RK4", flow, True)
