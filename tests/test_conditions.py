"""The conditions of an evaluation: which there are, what they change, and whom they suit."""

import math

import numpy as np
import pytest

from lag_envs.controllers import Constant
from lag_envs.evaluation.conditions import NOMINAL, OFTEN, Condition, Sensor, conditions, disturbances, often
from lag_envs.tasks import TASKS


@pytest.mark.parametrize("env_id", TASKS)
def test_conditions_make_environments(env_id):
    found = {c.name: c for c in conditions(env_id)}
    assert list(found)[:2] == [NOMINAL, OFTEN] and {"noise 1 %", "noise 5 %", "late"} <= set(found)
    tasks = {name: TASKS[env_id](**condition.options) for name, condition in found.items()}
    assert tasks[OFTEN].dt == pytest.approx(tasks[NOMINAL].interval / 10.0)
    assert tasks[OFTEN].limit == 10.0 * tasks[NOMINAL].steps
    assert tasks["gravity +20 %"].scene.gravity == pytest.approx(1.2 * tasks[NOMINAL].scene.gravity)
    disturbed = [condition.name for condition in disturbances(env_id)]
    scene = TASKS[env_id]().scene
    numbers = [name for name in scene._numbers() if 0.0 < getattr(scene, name) < math.inf]
    assert disturbed == [f"{name} {sign}20 %" for name in numbers for sign in "-+"] and len(numbers) >= 3


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
