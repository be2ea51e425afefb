"""The model: one step as a function, checked against the environments themselves."""

from __future__ import annotations

from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from contract_scenes import Along, Bead
from covering import PERFECT, covering, engine, slow
from rollouts import actions, make

from lag_envs.controllers.mpc import MPC
from lag_envs.envs.model import Model
from lag_envs.scenes import StepRefused
from lag_envs.tasks import TASKS, incline, pivoted_bar


@pytest.mark.parametrize("env_id", covering(PERFECT, engine))
def test_steps_as_the_environment_does(env_id):
    n = 64
    envs = gym.make_vec(env_id, n, autoreset_mode="SameStep", duration=100.0)
    model = Model(envs.unwrapped.task)
    envs.reset(seed=1)
    rng = np.random.default_rng(0)
    for action in actions(60, envs.action_space, seed=2):
        before, target = envs.unwrapped.state, envs.unwrapped.target
        one = action[:, 0] if action.ndim > 1 and action.shape[1] == 1 else action
        states, rewards, ended = model(before, one, target)
        _, reward, terminated, _, _ = envs.step(action)
        assert (ended == terminated).all()
        np.testing.assert_allclose(rewards, reward, rtol=1e-12, atol=1e-12)
        # Without a kick the states agree; after a kick they differ.
        idle = np.ones((model.task.draws, n)) * 0.999
        np.testing.assert_array_equal(model.kicked(states, idle), states)
        same = np.isclose(envs.unwrapped.state, states, rtol=1e-12, atol=1e-12).all(axis=1)
        assert (same | terminated).mean() > (0.8 if model.task.draws else 0.99)
        if model.task.draws:
            kicked = model.kicked(states, np.stack([np.zeros(n), rng.uniform(size=n)]))
            assert (np.abs(kicked - states).max(axis=1) > 0.0).all()


def test_far_from_ordinary_steps_are_taken_too():
    task = make(pivoted_bar.SwingUpFree.id).task
    ends, _, _ = Model(task)([[0.3, 90.0]], [0.5])
    exact = task.scene.simulate([0.3, 90.0], [2.5], 0.02)[1]
    np.testing.assert_allclose(ends[0], exact, rtol=1e-14)


@pytest.mark.slow
def test_a_refusal_names_the_applied_control():
    """Not the action, which is clipped, scaled and guarded."""

    class Uphill(Bead):
        controls = {"f": "N"}

        def potential(self, q, xp):
            return xp.sqrt(q.x)

        def applied(self, q, v, u, xp):
            return {"x": u.f}

    class Climb(Along):
        scene = Uphill
        action = {"f": (0.0, 50.0)}

        def guard(self, wanted, before, dt, xp):
            return {"f": wanted.f - xp.sqrt(3.0 - before.x)}

    model = Model(Climb())
    for action, control in ((0.5, 35.5), (7.0, 48.0)):
        with pytest.raises(StepRefused, match=rf"the step of row 1 .* with f={control:g} and dt=0.02 s"):
            model([[1.0, 0.0], [-1.0, 0.0]], [0.0, action])
    states, message = (
        [[1.0, 0.0], [4.0, 0.0]],
        "the step of row 1 .* with f=nan .* if the task has a guard, check",
    )
    with pytest.raises(StepRefused, match=message):
        model(states, [0.0, 0.0])
    with pytest.raises(StepRefused, match=message):
        model.vjp(states, [0.0, 0.0], by_states=1.0, ends=states)


def test_bad_input_is_named():
    model = Model(make(incline.Tilt.id).task)
    state = np.zeros((2, 3))
    for arguments, message in (
        ((np.zeros((2, 2)), [0, 0], 0.1), r"states must have shape \(n, 3\)"),
        ((state, [0.0], 0.1), r"actions must have shape \(2,\)"),
        ((state, [0.0, np.nan], 0.1), "actions must be finite, got nan in row 1"),
        ((state, [0.0, 0.0]), "targets must be given"),
        ((state, [0.0, 0.0], [0.1]), "targets must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            model(*arguments)
    for wrong, message in (
        ([[0.0, 0.0]], r"states must have shape \(n, 3\), got \(1, 2\)"),
        ([0.0, 0.0, 0.0], r"states must have shape \(n, 3\), got \(3,\)"),
        ([[0.0, 0.0, np.nan]], "states must be finite, got .* in row 0"),
    ):
        with pytest.raises(ValueError, match=message):
            model.observe(wrong, 0.1)
        with pytest.raises(ValueError, match=message):
            model.kicked(wrong, np.zeros((0, 1)))
    with pytest.raises(ValueError, match=r"targets must be finite, got \[nan\] in row 0"):
        model.observe(state, np.nan)
    with pytest.raises(ValueError, match=r"draws must have shape \(0, 2\), got \(1, 2\)"):
        model.kicked(state, np.zeros((1, 2)))
    for given, message in (
        ({"ends": np.zeros((2, 1))}, r"ends must have shape \(2, 3\), got \(2, 1\)"),
        ({"ends": np.full((2, 3), np.inf)}, "ends must be finite, got .* in row 0"),
        ({"by_rewards": np.nan}, "by_rewards must be finite, got nan"),
        ({"by_states": [[0.0] * 3, [0.0, 0.0, np.inf]]}, "by_states must be finite, got .* in row 1"),
        ({"by_observations": np.zeros((2, 1))}, "by_observations must be one number or have shape"),
        ({"kicks": -np.inf}, "kicks must be finite, got -inf"),
    ):
        with pytest.raises(ValueError, match=message):
            model.vjp(state, [0.0, 0.0], 0.1, **given)
    with pytest.raises(ValueError, match="has no target"):
        Model(make("PivotedBar-v0").task)(np.zeros((1, 4)), [0.0], 0.1)
    with pytest.raises(StepRefused, match="row 1"):
        Model(make(pivoted_bar.SwingUpFree.id, dt=1.0).task)([[0.0, 0.0], [0.0, 1e12]], [0.0, 0.0])


@pytest.mark.parametrize("parameters", [(), slow(("damping",))], ids=["one record", "the motion by itself"])
def test_a_gradient_that_is_not_finite_is_named(parameters):
    bar = Model(make("PivotedBar-v0").task)
    with pytest.raises(ValueError, match=r"gradient of row 1 is not finite, with by_states=.* scale them"):
        bar.vjp(np.ones((2, 4)), [0, 0], by_states=[[1.0] * 4, [1e308] * 4], parameters=parameters)


def test_a_fixed_target_is_taken():
    model = Model(make(incline.Tilt.id, target=0.2).task)
    states = np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    _, rewards, _ = model(states, [0.0, 0.0])
    assert rewards[0] > 0.99 > 0.1 > rewards[1]


@pytest.mark.parametrize(
    "env_id", [pivoted_bar.SwingUpFree.id, slow(pivoted_bar.SwingUp.id), slow(incline.Tilt.id)]
)
def test_expansion_of_a_step(env_id):
    """Slopes, gradient and curvature beside differences of the step itself, away from kinks."""
    task = TASKS[env_id]()
    model, rng = Model(task), np.random.default_rng(3)
    n, width = 20, len(task.scene.state_names)
    x, a = rng.uniform(-0.05, 0.05, (n, width)), rng.uniform(-0.5, 0.5, n)
    goals = None if task.target_range is None else rng.uniform(-0.1, 0.1, n)
    found, h = model.expand(x, a, goals), 1e-5
    for j in range(width + 1):
        move = h * np.eye(width + 1)[j]
        plus = model(x + move[:width], a + move[width], goals)
        minus = model(x - move[:width], a - move[width], goals)
        np.testing.assert_allclose(found.slopes[..., j], (plus[0] - minus[0]) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(found.gradient[:, j], (plus[1] - minus[1]) / (2 * h), rtol=5e-3, atol=3e-3)
    np.testing.assert_array_equal(found.curvature, np.swapaxes(found.curvature, 1, 2))


def test_expansion_needs_actions_between():
    class Choices(pivoted_bar.SwingUpFree):
        action: ClassVar = {"s_ddot": [-1.0, 1.0]}

    with pytest.raises(ValueError, match="Choices has a list of actions to choose from"):
        Model(Choices(track=None)).expand([[0.0, 0.0]], [0.0])


def test_what_is_no_task_is_told():
    env = make(incline.Tilt.id)
    for wrong in (incline.Tilt.id, env, incline.Tilt):
        for takes in (Model, MPC):
            with pytest.raises(TypeError, match=r"takes a task, such as gym\.make"):
                takes(wrong)
