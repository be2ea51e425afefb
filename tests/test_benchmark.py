"""The command `lag-envs` and the benchmark: their output, files and robustness. No speed is judged here."""

import dataclasses
import json
import re
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from covering import covering

import lag_envs
from lag_envs import cli, workers
from lag_envs.benchmark import (
    chain_costs,
    cold_start,
    contestants,
    divisions,
    docs,
    energies,
    jacobians,
    measurement,
)
from lag_envs.benchmark.actions import random_actions
from lag_envs.benchmark.environments import stagger_episodes
from lag_envs.benchmark.measurement import BenchmarkSettings, bench
from lag_envs.benchmark.peak import PRODUCTS
from lag_envs.benchmark.results import quartiles, ratios, row_summary
from lag_envs.benchmark.rounds import CORE, ENERGIES, THREADED, VARIED, Contestant, measure_rates
from lag_envs.benchmark.targets import SERIES_TARGETS, TARGETS, has_own_flow, verdicts
from lag_envs.envs.single import LagrangianEnv
from lag_envs.scenes import CartPole
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping.compiling import count_operations, record_block
from lag_envs.stepping.tracing import Trace
from lag_envs.store import readable_json
from lag_envs.tables import rate_text
from lag_envs.tasks import TASKS, chain, incline, pivoted_bar

ID = pivoted_bar.SwingUpFree.id


def call(capsys, *arguments):
    """Run the command in this process; return its exit status and what it printed."""
    try:
        status = cli.main(arguments)
    except SystemExit as end:
        status = end.code
    printed = capsys.readouterr()
    return status, printed.out, printed.err


# --- the command ---


def test_no_command_shows_the_help(capsys):
    status, out, err = call(capsys)
    assert (status, out) == (2, "")
    assert "lag-envs bench --quick" in err


def test_version(capsys):
    assert call(capsys, "--version") == (0, f"lag-envs {lag_envs.__version__}\n", "")


def test_list_has_a_line_for_each_environment(capsys):
    status, out, _ = call(capsys, "list")
    assert status == 0
    for id in TASKS:
        (line,) = [line for line in out.splitlines() if line.startswith(id + " ")]
        assert line.endswith(f" {TASKS[id]().duration:g} s")


def test_list_shows_the_control_in_its_unit(capsys):
    out = call(capsys, "list")[1]
    (line,) = [line for line in out.splitlines() if line.startswith("PivotedBar-v0")]
    assert "  s_ddot -5 to 5 m/s²  0.02 s  500  10 s" in re.sub(" {2,}", "  ", line)


@pytest.mark.parametrize("id", covering())
def test_info_tells_about_parameters_and_accuracy(id, capsys):
    status, out, _ = call(capsys, "info", id)
    assert status == 0
    words = {line.split()[0] for line in out.splitlines() if line}
    task = TASKS[id]()
    numbers = {field.name for field in dataclasses.fields(task.scene)}
    assert {*task.scene.state_names, *task.observation, *numbers, "dt", "duration"} <= words
    assert "one substep" in out or "proved with the step" in out


def test_info_certifies_the_substeps(capsys):
    out = call(capsys, "info", ID)[1]
    (line,) = [line for line in out.splitlines() if "certified up to" in line]
    fastest = float(line.split("=")[1].split()[0])
    task = TASKS[ID]()

    def substeps(speed):
        return max(task.scene.truncation_bound([0.1, speed], u, task.dt).substeps for u in (-5.0, 5.0))

    assert substeps(0.99 * fastest) == 1
    assert substeps(1.01 * fastest) > 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["info", "PivotdBar-v0"], "there is no environment 'PivotdBar-v0'; did you mean PivotedBar-v0"),
        (["info", "pivotedbar-v0"], "did you mean PivotedBar-v0"),
        (["info", "???"], "`lag-envs list` names all"),
        (["bench", "PivotedBra-v0"], "did you mean PivotedBar-v0"),
        (["bench", "--sizes", "1,x"], "a whole number of at least 1 is needed, got 'x'"),
        (["bench", "--rounds", "0"], "a whole number of at least 1 is needed, got '0'"),
        (["bench", "--seconds", "nan"], "a number above 0 is needed, got 'nan'"),
        (["bench", "--output", "."], "argument --output: . is a folder"),
        (["bench", "--output", "README.md/speed.json"], "README.md is not a writable folder"),
        (["bench", "--checkout", ".", "--quick"], "leave out IDs, --quick, --cold, --sizes"),
        (["bench", "--checkout", ".", incline.Tilt.id], "leave out IDs, --quick, --cold, --sizes"),
        (["bench", "--threads", "0"], "a whole number of at least 1 is needed, got '0'"),
        (["bench", "--threads", "10000"], "--threads 10000 needs 10000 cores; this process may use"),
        (["bench", "--checkout", "nowhere"], f"{Path('nowhere/README.md')} is missing"),
        (["bench", "PivotedBar-v0", "--with", "wind=1"], "--with wind=1: got an unexpected keyword"),
        (["fly"], "there is no command 'fly'; did you mean play?"),
        (["lst"], "there is no command 'lst'; did you mean list?"),
        (["list", "PivotedBar"], "usage: lag-envs list"),
        (["info", "no_module:Id-v0"], "No module named 'no_module'"),
        (["info", "gymnasium:CartPole-v1"], "gymnasium:CartPole-v1 is not a task of lag_envs"),
    ],
)
def test_mistakes_are_told_without_a_traceback(arguments, message, capsys):
    status, out, err = call(capsys, *arguments)
    assert (status, out) == (2, "")
    assert message in err
    assert "Traceback" not in err


def test_a_reader_that_leaves_is_no_error(tmp_path):
    script = (
        "import os, sys; from lag_envs import cli; r, w = os.pipe(); os.dup2(w, 1); os.close(w); os.close(r);"
    )
    script += "sys.exit(cli.main(['list']))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")


# --- the benchmark ---


def tiny(tmp_path, **changes):
    """Return settings for a measurement of minimal length."""
    some = {"ids": (ID,), "sizes": (1, 3), "rounds": 2, "seconds": 1e-4, "cold_starts": 0}
    return BenchmarkSettings(
        **(some | {"date": "2020-02-20", "output": str(tmp_path / "speed.json")} | changes)
    )


def broken(n):
    raise OSError("no luck\ntoday")


def absent(n):
    raise ModuleNotFoundError("No module named 'gone'", name="gone")


def peers(*prepare):
    return [("gone", f"Peer{i}", p) for i, p in enumerate(prepare)]


def row(report, id, kind="vector", num_envs=1):
    (found,) = [r for r in report["rows"] if (r["id"], r["kind"], r["num_envs"]) == (id, kind, num_envs)]
    return found


def test_bench_writes_json_and_goes_on_past_failing_peers(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(contestants, "PEERS", [*peers(broken, absent), *contestants.PEERS[:1]])
    bench(tiny(tmp_path))
    out = capsys.readouterr().out
    report = json.loads((tmp_path / "speed.json").read_text())

    assert report["complete"]
    assert report["date"] == "2020-02-20"
    assert report["versions"].keys() >= {"lag_envs", "gymnasium", "numpy", "numba"}
    assert report["machine"].keys() >= {"processor", "cores", "system", "python"}
    for kind, n in (("made", 1), ("unwrapped", 1), ("vector", 1), ("vector", 3)):
        measured = row(report, ID, kind, n)
        assert len(measured["rates"]) == 2 and all(rate > 0.0 for rate in measured["rates"])
        assert len(measured["ratio"]) == 3
    assert row(report, "CartPole-v1", "made")["ratio"] == [1.0, 1.0, 1.0]
    assert row(report, "Pendulum-v1", "made")["rates"]

    assert row(report, "Peer0")["problem"] == "failed: OSError: no luck today"
    assert row(report, "Peer1")["problem"] == "not installed"
    assert row(report, "Peer1")["rates"] == []
    lines = [line for line in out.splitlines() if "Peer0" in line]
    assert len(lines) == 2 and all(line.endswith("failed: OSError: no luck today") for line in lines)

    met = {t["target"]: t["met"] for t in report["targets"]}
    assert met["single, made: at least 2 x CartPole-v1"] in (True, False)
    assert met["vector, 64: at least 6 x CartPole-v1"] is None
    assert "not measured" in out


def test_a_peer_that_fails_later_keeps_its_samples():
    calls = []

    def fails(steps):
        calls.append(steps)
        if len(calls) > 4:  # two to calibrate, two for the first sample
            raise ZeroDivisionError("late")
        return steps

    rows = [
        Contestant("gone", f"Peer{i}", "vector", 2, lambda run=run: run) for i, run in enumerate((fails, int))
    ]
    assert measure_rates(rows, 3, 1e-9)
    assert rows[0].problem == "failed: ZeroDivisionError: late"
    assert [len(row.rates) for row in rows] == [1, 3]


def test_breaking_off_keeps_and_writes_what_was_measured(tmp_path, capsys, monkeypatch):
    calls = []

    def interrupted(n):
        def run(steps):
            calls.append(steps)
            if len(calls) > 8:
                raise KeyboardInterrupt
            return steps

        return run

    monkeypatch.setattr(contestants, "PEERS", peers(interrupted))
    bench(tiny(tmp_path, sizes=(1,), rounds=1000, seconds=1e-6, cold_starts=3))
    report = json.loads((tmp_path / "speed.json").read_text())
    assert not report["complete"]
    assert report["cold_start"] == {}
    assert row(report, ID, "made")["rates"]
    assert "interrupted" in capsys.readouterr().out


def test_it_stops_between_samples_when_asked(monkeypatch):
    """Also where the code that is measured swallows interrupts, as JAX's does."""
    asked = threading.Event()
    monkeypatch.setattr(workers, "_asked", asked)
    rows = [Contestant("a", "b", "vector", 1, lambda: lambda steps: steps) for _ in range(2)]

    def later():
        if rows[0].rates:
            asked.set()
        return time.perf_counter()

    assert not measure_rates(rows, 100, 1e-9, later)
    assert [len(row.rates) for row in rows] in ([1, 0], [1, 1])
    times = {}
    assert not cold_start.cold_starts(ID, 1, times) and times == {}
    for section in (partial(divisions.divisions, [ID]), partial(jacobians.jacobians, 1, time.perf_counter)):
        with pytest.raises(KeyboardInterrupt):
            section()


def interrupted(*args):
    raise KeyboardInterrupt


def failing(*args):
    raise ValueError("no luck")


@pytest.mark.parametrize(("place", "name"), [(cold_start, "cold_start"), (measurement, "divisions")])
@pytest.mark.parametrize("ends", [interrupted, failing])
def test_whatever_ends_a_later_section_the_rates_are_kept(place, name, ends, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(contestants, "PEERS", [])
    monkeypatch.setattr(place, name, ends)
    given = tiny(tmp_path, sizes=(1,), cold_starts=int(name == "cold_start"), divisions=True)
    with pytest.raises(ValueError, match="no luck") if ends is failing else nullcontext():
        bench(given)
    report = json.loads((tmp_path / "speed.json").read_text())
    assert not report["complete"] and len(row(report, ID)["rates"]) == 2
    assert report["cold_start"] == {} and "x CartPole" in capsys.readouterr().out


def test_what_cannot_be_written_is_printed_all_the_same(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(contestants, "PEERS", [])
    with pytest.raises(OSError, match=re.escape(str(tmp_path))):
        bench(tiny(tmp_path, sizes=(1,), output=str(tmp_path)))
    out = capsys.readouterr().out
    assert re.search(rf"lag_envs +{ID} +vector", out) and "written" not in out


def test_a_missing_core_environment_is_a_row_too(tmp_path, monkeypatch):
    monkeypatch.setattr(contestants, "PEERS", peers(broken))
    report = bench(tiny(tmp_path, sizes=(1,), output=None))
    assert "ratio" not in row(report, ID)  # nothing comparable
    assert "ratio" in row(report, ID, "made")


@pytest.mark.slow
def test_the_whole_command_measures_in_a_process_of_its_own(tmp_path):
    output = tmp_path / "speed.json"
    command = [sys.executable, "-m", "lag_envs.cli", "bench", ID, "--quick", "--sizes", "1", "--rounds", "1"]
    command += ["--seconds", "1e-4", "--date", "2026-01-31", "--output", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    report = json.loads(output.read_text())
    assert report["complete"]
    assert report["date"] == "2026-01-31"
    assert str(output) in done.stdout


def test_cold_start_times_empty_and_filled_caches(monkeypatch):
    caches = []
    monkeypatch.setattr(
        cold_start, "cold_start", lambda id, cache, files: caches.append(cache) or [len(caches)]
    )
    times = {}
    assert cold_start.cold_starts(ID, 3, times)
    assert times == {"empty": [[1], [2]], "filled": [[3], [4], [5]]}
    assert caches[0] != caches[1]
    assert caches[2:] == [caches[0]] * 3


def test_cold_start_shows_where_the_time_goes(tmp_path):
    start = time.perf_counter()
    stages = cold_start.cold_start(ID, str(tmp_path))
    assert len(stages) == len(cold_start.STAGES)
    assert 0.0 < sum(stages) < time.perf_counter() - start
    assert all(stage > 0.0 for stage in stages)


@pytest.mark.slow
def test_jacobians_beside_steps(tmp_path, monkeypatch, capsys):
    some = partial(jacobians.jacobians, names=("Incline", "CartPole"))
    monkeypatch.setattr(measurement, "jacobians", some)
    one = partial(jacobians.backwards, ids=(ID,), count=64)
    monkeypatch.setattr(measurement, "backwards", one)
    report = bench(tiny(tmp_path, speed=False, cold_starts=0, rounds=1, jacobians=True))
    rows = {row["name"]: row for row in report["jacobians"]}
    assert [rows[name]["columns"] for name in ("Incline", "CartPole")] == [3, 5]
    assert all(row["ratio"] > 0.0 and row["aim"] == 1 + 2 * row["columns"] for row in rows.values())
    (row,) = report["backwards"]
    assert row["id"] == ID and row["ratio"] == pytest.approx(row["back_ns"] / row["step_ns"], rel=0.02)
    printed = capsys.readouterr().out
    assert "Jacobian of a step" in printed and "Whole step backwards" in printed
    # The reference loop takes exactly the steps of the scene.
    scene, states = CartPole(), np.array([[0.1, 0.2, 0.3, 0.4], [0.5, -0.2, 3.0, 1.0]])
    ends = [scene.simulate(x, [u], 0.02)[1].sum() for x, u in zip(states, (1.0, -2.0), strict=True)]
    steps = jacobians.compile_steps(scene, 0.02)(states, np.array([[1.0], [-2.0]]))
    assert steps == pytest.approx(sum(ends), rel=1e-14)


@pytest.mark.slow
def test_how_often_steps_are_divided(tmp_path, capsys):
    ids = (ID, chain.SwingUp.id, pivoted_bar.SwingUpUnknown.id)
    report = bench(tiny(tmp_path, speed=False, cold_starts=0, rounds=1, divisions=True, ids=ids))
    one, two = report["divisions"]  # without the imperfect one
    assert (one["id"], one["mean"], one["most"], one["divided"]) == (ID, 1.0, 1, 0.0)
    assert two["most"] > 5 and 1.5 < two["mean"] < two["most"] and 0.5 < two["divided"] < 1.0
    assert two["fastest"] > 20.0
    assert "series a step" in capsys.readouterr().out
    text = divisions.divisions_markdown(report["divisions"], {two["id"]: 100.0 * two["mean"]})
    assert text.splitlines()[2].endswith("| 100 ns |") and ID not in text


@pytest.mark.slow
def test_scenes_of_energies_beside_cart_pole(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(energies, "LONGEST", 2)
    report = bench(tiny(tmp_path, sizes=(3,), rounds=1, energies=True, divisions=True))
    for id in ("CartPole, exact", "Chain(1)", "Chain(2)"):
        found = row(report, id, num_envs=3)
        assert found["problem"] is None and found["ratio"]
    assert report["chains"]["bars"] == [1, 2] and report["chains"]["series"][0] == 1.0
    assert "one series as the power" in capsys.readouterr().out


def test_chains_in_the_documentation(tmp_path):
    """Twice the series for twice the bars: the time of one grows more slowly by a power."""
    rows = [
        {"library": ENERGIES, "id": f"Chain({n})", "num_envs": 8, "steps_per_second": [0.0, 1e9 / n**4, 0.0]}
        for n in (1, 2, 4)
    ]
    costs = chain_costs.chain_costs(rows, {1: 1.0, 2: 2.0, 4: 4.0})
    text = docs.speed_markdown(report_of([2.0, 6.0, 3.0, 3.0]) | {"chains": costs})
    assert (
        "bars to the power 4, that of one series as the power 3" in text and "| 4 | 256 | 4.00 | 64 |" in text
    )
    for name in ("a.svg", "b.svg"):
        chain_costs.write_figure(costs, tmp_path / name)
    drawn = (tmp_path / "a.svg").read_text()
    assert "one series" in drawn and drawn == (tmp_path / "b.svg").read_text()


def test_exact_cart_pole_is_gymnasiums_but_for_its_steps():
    """Over a short step Euler's error is small: the same start goes the same way, to the same ending."""
    twin = LagrangianEnv("lag_envs.tasks.cart_pole:CartPoleExact", dt=1e-4)
    original = gym.make("CartPole-v1", max_episode_steps=100_000).unwrapped
    original.tau = 1e-4
    start = np.array([0.01, -0.02, 0.03, 0.04])
    twin.reset(options={"state": start})
    original.reset(seed=0)
    original.state = start
    for i in range(20_000):
        action = (i // 700) % 2
        a, b = twin.step(action), original.step(action)
        assert a[2] == b[2] or abs(abs(a[0][2]) - np.radians(12.0)) < 2e-3
        if a[2] or b[2]:
            break
    assert i > 1000
    np.testing.assert_allclose(a[0], b[0], atol=5e-3)
    assert twin.action_space == original.action_space


# --- statistics on known numbers ---


def made(library, id, kind, num_envs, rates):
    return Contestant(library, id, kind, num_envs, lambda: None, rates)


def test_rows_are_compared_with_cartpole_of_their_size():
    rows = [
        made("gymnasium", "CartPole-v1", "made", 1, [10.0, 10.0]),
        made("gymnasium", "CartPole-v1", "vector", 1, [1.0, 1.0]),
        made("gymnasium", "CartPole-v1", "vector", 64, [100.0, 200.0]),
        made("lag_envs", ID, "unwrapped", 1, [30.0, 30.0]),
        made("lag_envs", ID, "vector", 64, [700.0, 1000.0]),
        made("lag_envs", ID, "vector", 7, [1.0, 1.0]),
    ]
    results = [row_summary(r, rows) for r in rows]
    assert results[3]["ratio"] == (3.0, 3.0, 3.0)
    assert results[4]["ratio"] == (5.5, 6.0, 6.5)
    assert results[4]["steps_per_second"] == (775.0, 850.0, 925.0)
    assert "ratio" not in results[5]


@pytest.mark.parametrize(("ratio", "met"), [(6.0, True), (5.99, False)])
def test_targets(ratio, met):
    rows = [{"library": "lag_envs", "id": ID, "kind": "vector", "num_envs": 64, "ratio": (0.0, ratio, 9.0)}]
    results = {t["target"]: t for t in verdicts(rows, {"empty": [2.0, 2.4, 9.0], "filled": [1.2]})}
    assert results["vector, 64: at least 6 x CartPole-v1"]["met"] is met
    assert results["vector, 64: at least 6 x CartPole-v1"]["measured"] == {ID: ratio}
    assert results["single, made: at least 2 x CartPole-v1"]["met"] is None
    assert results["Chain(2), vector, 16,384: at least 0.25 x CartPole-v1"]["met"] is None
    assert results["cold start, cache empty: below 2.5 s"]["met"] is True
    assert results["cold start, cache filled: below 0.5 s"]["met"] is False


def test_who_has_a_target():
    """It applies to dedicated flows; for the general series only to the ids that the target names."""

    def meant(target, **changes):
        about = {"library": "lag_envs", "id": ID, "kind": target.kind, "num_envs": target.num_envs}
        return target.meant_for(about | changes)

    assert all(meant(target) for target in TARGETS) and not any(meant(target) for target in SERIES_TARGETS)
    assert not meant(TARGETS[1], num_envs=1) and not meant(TARGETS[1], library="gymnasium")
    unknown = [id for id, task in TASKS.items() if task.imperfections]
    general = [id for id, task in TASKS.items() if form_of(task().scene) is None]
    assert unknown and general and not any(has_own_flow(id) for id in (*unknown, *general, "Other-v0"))
    for target in SERIES_TARGETS:
        assert meant(target, library=ENERGIES, id=target.id) and not meant(target, id=target.id)


def report_of(ratios):
    """Return a report in which, at the targets' sizes, an environment is this many times as fast."""
    rows = []
    for target, ratio in zip(TARGETS, ratios, strict=True):
        rows += [made("gymnasium", "CartPole-v1", target.kind, target.num_envs, [1e7])]
        rows += [made("lag_envs", ID, target.kind, target.num_envs, [ratio * 1e7] if ratio else [])]
        rows[-1].problem = None if ratio else "failed: OSError: no luck"
    return {
        "date": "2020-02-20", "machine": {"processor": "P"}, "versions": {"gymnasium": "1"},
        "settings": {"rounds": 1, "clock": "wall"}, "rows": [row_summary(r, rows) for r in rows],
        "cold_start": {"empty": {"median": 1.234}},
    }  # fmt: skip


def test_checkout_takes_the_table_over(tmp_path):
    (tmp_path / "docs").mkdir()
    marks = "".join(f"<!-- {name}:begin --><!-- {name}:end -->\n" for name in ("fast", "bench"))
    for name in ("README.md", "docs/speed.md"):
        (tmp_path / name).write_text(marks)
    report = report_of([2.0, 5.99, 20.0, 1.5])
    docs.take_over(report, tmp_path)
    assert json.loads((tmp_path / "docs" / "speed.json").read_text()) == json.loads(readable_json(report))
    text = (tmp_path / "docs" / "speed.md").read_text()
    assert (
        f"| {ID} | 50 ns, 2.0× | 16.7 ns, **5.99×, missed** | 5 ns, 20.0× | 66.7 ns, **1.50×, missed** |"
        in text
    )
    assert "| CartPole-v1 | 100 ns | 100 ns | 100 ns | 100 ns |" in text
    assert "2020-02-20" in text and "took 1.23 s with its cache empty" in text
    for name in ("README.md", "docs/speed.md"):
        text = (tmp_path / name).read_text()
        assert "| a specialised integrator | 2 to 2 | 6 to 6 | 20 to 20 | 1.5 to 1.5 |" in text
        assert "general series" not in text and re.search(r"We set 4 speed targets.*; 2 are missed\.", text)
    assert "speed targets; all are met." in docs.claim(report_of([2.0, 6.0, 3.0, 3.0]))
    assert "| failed: OSError: no luck |" in docs.speed_markdown(report_of([2.0, 6.0, None, 3.0]))


def test_what_was_broken_off_is_not_taken_over(tmp_path, monkeypatch):
    monkeypatch.setattr(contestants, "PEERS", contestants.PEERS[:1])
    monkeypatch.setattr(measurement, "measure_rates", lambda *_: False)
    monkeypatch.setattr(measurement, "take_over", lambda *_: pytest.fail("taken over"))
    assert not bench(tiny(tmp_path, checkout=str(tmp_path)))["complete"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (999.0, "999"),
        (1e3, "1.00 k"),
        (9.996e3, "10.0 k"),
        (123_456.0, "123 k"),
        (999_900.0, "1.00 M"),
        (2e9, "2.00 G"),
    ],
)
def test_rates_have_three_digits(value, text):
    assert rate_text(value) == text


def test_episodes_are_spread_out():
    envs = gym.make_vec(ID, num_envs=4, duration=0.16)  # 8 steps
    envs.reset(seed=0)
    actions = random_actions(4)
    stagger_episodes(envs, actions)
    ended = [envs.step(action)[3] for action in actions[:9]]  # an episode and the step that resets
    assert [sum(column) for column in zip(*ended, strict=True)] == [1, 1, 1, 1]
    assert max(map(sum, ended)) == 1


def test_threads_are_measured_beside_one(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(contestants, "PEERS", [])
    report = bench(tiny(tmp_path, sizes=(3,), threads=2))
    (found,) = report["speedups"]
    one, two = (
        next(r["rates"] for r in report["rows"] if r["library"] == library and r["kind"] == "vector")
        for library in ("lag_envs", THREADED)
    )
    assert (found["id"], found["num_envs"]) == (ID, 3)
    assert found["ratio"] == quartiles(ratios(two, one))
    assert "2 threads : 1" in capsys.readouterr().out
    assert bench(tiny(tmp_path, sizes=(3,)))["speedups"] == []


def test_arithmetic_is_compared_with_what_the_core_can_do(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(contestants, "PEERS", [])
    report = bench(tiny(tmp_path, sizes=(1, 3)))
    (found,) = report["arithmetic"]
    (core,) = [r for r in report["rows"] if r["library"] == CORE]
    assert "ratio" not in core
    pairs = ratios(row(report, ID, num_envs=3)["rates"], core["rates"])
    assert (found["id"], found["num_envs"]) == (ID, 3)
    assert found["share"] == pytest.approx(quartiles([found["products"] * x for x in pairs]))
    assert "of the core's peak" in capsys.readouterr().out


def test_products_are_counted_with_and_without_a_sum():
    trace = Trace()
    a, b, c = trace.inputs("a", "b", "c")
    lines, _ = record_block(trace, {"out": a * b + c * (a - b)})
    assert count_operations(lines, PRODUCTS) == 2 and count_operations(lines) == 3


def test_keywords_are_measured_beside_the_defaults():
    rows = contestants.contestants((ID,), (1, 64), ("action_delay=0.013",))
    varied = [row for row in rows if row.library == VARIED]
    assert {row.id for row in varied} == {f"{ID}, action_delay=0.013"}
    assert [(row.kind, row.num_envs) for row in varied] == [("unwrapped", 1), ("vector", 1), ("vector", 64)]
    for text in ("0.013", "action_delay=", "**{}", "action_delay=open('x')"):
        with pytest.raises(ValueError, match="keywords must be as in a call"):
            contestants.keywords_of(text)
