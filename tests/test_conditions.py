"""The conditions of an evaluation: their list, their changes, and the agents they suit."""

import math

import numpy as np
import own_tasks
import pytest

from lag_envs.controllers import Constant
from lag_envs.evaluation.conditions import (
    NOMINAL,
    OFTEN,
    Condition,
    Sensor,
    conditions,
    disturbances,
    imperfections,
    often,
    on_board,
)
from lag_envs.mechanics.recording import parameter_names
from lag_envs.tasks import TASKS


@pytest.mark.parametrize("env_id", TASKS)
def test_conditions_make_environments(env_id):
    found = {c.name: c for c in conditions(env_id)}
    assert list(found)[:2] == [NOMINAL, OFTEN] and {"noise 1 %", "noise 5 %", "late"} <= set(found)
    tasks = {name: TASKS[env_id](**condition.options) for name, condition in found.items()}
    assert tasks[OFTEN].dt == pytest.approx(tasks[NOMINAL].interval / 10.0)
    assert tasks[OFTEN].limit == 10.0 * tasks[NOMINAL].steps
    disturbed = [condition.name for condition in disturbances(env_id)]
    scene = TASKS[env_id]().scene
    numbers = [name for name in parameter_names(scene) if 0.0 < getattr(scene, name) < math.inf]
    for name in numbers:
        changed = getattr(tasks[f"{name} +20 %"].scene, name)
        assert changed == pytest.approx(1.2 * getattr(tasks[NOMINAL].scene, name))
    assert disturbed == [f"{name} {sign}20 %" for name in numbers for sign in "-+"] and len(numbers) >= 3


def test_numbers_that_a_task_refuses_are_left_out(monkeypatch):
    class Narrow(own_tasks.Deliver):
        def check(self):
            if self.scene.load_mass > 1.1:
                raise ValueError("too heavy")

    monkeypatch.setitem(TASKS.data, Narrow.id, Narrow)
    found = [condition.name for condition in disturbances(Narrow.id)]
    assert "load_mass -20 %" in found and "trolley_mass +20 %" in found and "load_mass +20 %" not in found
    assert all("load_mass" not in c.options.get("randomize", ()) for c in imperfections(Narrow.id))


@pytest.mark.parametrize("env_id", TASKS)
def test_imperfections_are_possible_and_new(env_id):
    task, names = TASKS[env_id], set()
    for condition in imperfections(env_id):
        (keyword,) = condition.options
        assert keyword not in task.imperfections
        made = task(**condition.options)
        assert made.imperfections != task().imperfections
        assert not made.imperfections.drawn or made.drawn  # all corners of the ranges are tasks
        names.add(keyword)
    assert names | set(task.imperfections) >= {"observation_noise", "action_delay", "lag", "randomize"}
    assert ("push" in names) == bool(task.examples.reach) or "push" in task.imperfections


def test_boards_that_began_without_imperfections_stay_without():
    first = [env_id for env_id in TASKS if (goal := TASKS[env_id].goal) and goal.rules == 1]
    assert first[0] == "PivotedBar-v0" and len(first) == 8
    for env_id in TASKS:
        more = [] if env_id in first else imperfections(env_id)
        assert TASKS[env_id].goal is None or on_board(env_id) == disturbances(env_id) + more


def test_who_plans_for_one_interval_keeps_it():
    class Clock:
        pace = 1.0

    other, same = often("PivotedBar-v0"), Condition("mass", {"mass": 1.1})
    assert other.suits(Clock(), plans=True) and other.suits(Constant(0.0), plans=False)
    assert not other.suits(Constant(0.0), plans=True) and same.suits(Constant(0.0), plans=True)


def test_sensor():
    observations = [np.full((2, 3), float(i), np.float32) for i in range(3)]
    late = Sensor(late=True)
    assert [late(o).tolist() for o in observations] == [[[x] * 3] * 2 for x in (0.0, 0.0, 1.0)]
    np.testing.assert_array_equal(Sensor()(observations[1]), observations[1])
    noisy, nothing = Sensor(noise=[0.0, 1.0, 5.0]), np.zeros((20_000, 3), np.float32)
    seen = noisy(nothing)
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen.std(axis=0), [0.0, 1.0, 5.0], rtol=0.02)
    assert (noisy(nothing) != seen)[:, 1:].any()
    np.testing.assert_array_equal(Sensor(noise=[0.0, 1.0, 5.0])(nothing), seen)  # the same for everybody
