"""The environments' behaviour against that of the settled version 0: see golden_rollouts.py.

Only the public interface is used, so that this holds for any implementation.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from covering import PERFECT, quick
from golden_rollouts import GOLDEN, Roll, Run, main, planned, play, runs, stack

from lag_envs.tasks import TASKS

RUNS = runs()
IDS = dict.fromkeys(name.partition("/")[0] for name in RUNS)


def each(ids):
    """Return the runs of some ids as parameters.

    Quick runs are single environments of a covering set, and one run of every id; a batch has the bits of
    single environments (test_vector.py), and its own programs to compile.
    """
    chosen, found = quick(ids), []
    for name, run in RUNS.items():
        env_id, _, kind = name.partition("/")
        if env_id in ids:
            fast = kind == "defaults" or (env_id in chosen and not run.mode)
            found.append(pytest.param(name, marks=() if fast else pytest.mark.slow))
    return pytest.mark.parametrize("name", found)


each_run = each(IDS)
#: In the others, a step depends on more than the state and the action.
each_perfect_run = each([env_id for env_id in IDS if env_id in PERFECT])
TOLERANCE = 1e-12


@functools.cache
def kept() -> dict[str, np.ndarray]:
    with np.load(GOLDEN) as file:
        return dict(file)


def arrays(name: str) -> dict[str, np.ndarray]:
    prefix = f"{name}/"
    return {key.removeprefix(prefix): value for key, value in kept().items() if key.startswith(prefix)}


def assert_close(mine: np.ndarray, golden: np.ndarray, what: str, tolerance: float) -> None:
    """Compare to a tolerance relative to the largest number in an entry's history, at least 1."""
    assert mine.shape == golden.shape, what
    if golden.dtype == np.float32:  # these are rounded: one unit in the last place may lie between
        slack = np.spacing(np.abs(golden)).astype(np.float64)
    elif golden.dtype == np.float64:
        slack = 0.0
    else:
        assert np.array_equal(mine, golden), what
        return
    mine, golden = mine.astype(np.float64), golden.astype(np.float64)
    finite = np.isfinite(golden)  # the friction that an unloaded contact needs is infinite
    assert np.array_equal(mine[~finite], golden[~finite]), what
    size = np.maximum(1.0, np.max(np.abs(golden), axis=0, where=finite, initial=0.0))
    off = np.abs(np.subtract(mine, golden, where=finite, out=np.zeros_like(golden))) - slack
    worst = np.unravel_index(np.argmax(off / size), off.shape)
    assert (off <= tolerance * size).all(), f"{what} at {worst}: {mine[worst]!r}, not {golden[worst]!r}"


@pytest.mark.parametrize(("argument", "status"), [("--help", 0), ("PivotedBra-v0", 2)])
def test_nothing_is_recorded_by_mistake(argument, status, monkeypatch, capsys):
    monkeypatch.setattr("golden_rollouts.record", None)
    with pytest.raises(SystemExit) as stopped:
        main(["PivotedBar-v0", argument])
    told = capsys.readouterr()
    assert stopped.value.code == status
    assert ("did you mean PivotedBar-v0" in told.err) if status else ("records those" in told.out)


def test_the_file_holds_every_run():
    assert {key.rpartition("/")[0] for key in kept()} - {""} == set(RUNS)
    ids = {name.partition("/")[0] for name in RUNS}
    assert ids <= set(TASKS) and {name for name in planned() if name.partition("/")[0] in ids} <= set(RUNS)
    ends = np.concatenate([arrays(name)["over"].ravel() for name in RUNS])
    assert all(np.count_nonzero(ends == kind) > 50 for kind in (1, 2))
    assert GOLDEN.stat().st_size < 1e6


@each_run
def test_whole_run(name):
    # From its seed and actions alone. The motion amplifies a rounding up to 2,000 times on the way.
    golden = arrays(name)
    mine = stack(play(name.partition("/")[0], RUNS[name], golden["actions"]))
    assert mine.keys() == golden.keys() - {"actions"}
    for key, value in mine.items():
        assert_close(value, golden[key], key, 10 * TOLERANCE)


@each_perfect_run
def test_each_step(name):
    # From the recorded state, so that nothing can add up or be amplified.
    golden, run, env_id = arrays(name), RUNS[name], name.partition("/")[0]
    keywords = {key: value for key, value in run.keywords.items() if key != "diagnostics"}
    roll = Roll(env_id, Run(keywords, run.steps, mode=run.mode and "Disabled"))
    before, after = golden["over"][:-1] > 0, golden["over"][1:] > 0
    # A reset has no step to repeat; a batch without autoreset is reset by a mask.
    reset = before.any(axis=1) if run.mode in ("", "Disabled") else np.zeros(len(before), bool)
    stepped = ~before & ~reset[:, None]
    restarted = after & (run.mode == "SameStep")
    # Lanes without a step to repeat stay where all began. A clipped entry may lie beyond its limit by a
    # rounding; a start there would be refused.
    starts = np.where(stepped[..., None], golden["state"][:-1] * (1.0 - 1e-15), golden["state"][0])
    steps = []
    for t, start in enumerate(starts):
        options = {"state": start}
        if "target" in golden:
            options["target"] = golden["target"][t]
        if not run.mode:
            options = {key: value[0] for key, value in options.items()}
        roll.reset(seed=t, options=options)
        steps.append(roll.step((golden["actions"][t + 1] / 100.0).astype(np.float32)))
    mine = stack(steps)
    state, wanted = mine["state"], golden["state"][1:]
    if TASKS[env_id].draws:  # kicks are drawn differently: they hit few, and only the last rate
        kicked = np.abs(state[..., -1] - wanted[..., -1]) > 1e-6
        alike = ~kicked[stepped & ~restarted]
        assert np.count_nonzero(~alike) <= max(3, 0.1 * alike.size)
        stepped &= ~kicked
    going_on = stepped & ~restarted
    assert_close(state[going_on], wanted[going_on], "state", TOLERANCE)
    assert_close(mine["reward"][stepped], golden["reward"][1:][stepped], "reward", TOLERANCE)
    assert_close(mine["observation"][going_on], golden["observation"][1:][going_on], "observation", TOLERANCE)
    assert np.array_equal(mine["over"][stepped] % 2, golden["over"][1:][stepped] % 2)
