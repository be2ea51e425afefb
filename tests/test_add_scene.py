"""The recipe of CONTRIBUTING.md: a scene and a task outside the package are as good as those inside."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rollouts import RENDERS, actions
from scipy.integrate import solve_ivp
from toy_pendulum import Pendulum, Swing

from lag_envs import register

ID = "ToySwing-v0"


@pytest.fixture(autouse=True)
def registered():
    register(Swing)
    yield
    del gym.registry[ID]


def test_it_is_recognised_as_a_driven_pendulum():
    scene = Pendulum(mass=0.7, length=0.4, damping=0.05)
    drive = scene._form.coefficients([0.3, 1.0], [2.0], scene._constants())
    per_torque = 1.0 / (0.7 * 0.4**2)
    assert drive == pytest.approx((9.81 / 0.4, 0.0, 0.05 * per_torque, 2.0 * per_torque, 0.0), rel=1e-15)


def test_simulate_against_scipy():
    scene, dt = Pendulum(mass=0.7, length=0.4, damping=0.05), 0.02
    controls = 2.0 * np.sin(np.arange(50.0))
    states = scene.simulate([1.0, -2.0], controls, dt)
    for start, end, u in zip(states[:-1], states[1:], controls, strict=True):

        def rhs(_, y, u=u):
            inertia = scene.mass * scene.length**2
            weight = scene.mass * scene.gravity * scene.length * np.sin(y[0])
            return y[1], (u - weight - scene.damping * y[1]) / inertia

        expected = solve_ivp(rhs, (0.0, dt), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        np.testing.assert_allclose(end, expected, rtol=1e-12, atol=1e-12)


def test_energy_balance():
    balance = Pendulum(damping=0.1).energy_balance([1.0, 4.0], 2.0, 0.02)
    assert abs(balance["residual"]) < 1e-13
    assert balance["work"] > 0.0 and balance["loss"] > 0.0


def test_vector_is_single():
    single = gym.make_vec(ID, num_envs=3, vectorization_mode="sync")
    native = gym.make_vec(ID, num_envs=3)
    assert type(native) is not type(single)
    given = actions(700, 3, 1)
    for envs in (single, native):
        envs.reset(seed=5)
    for a in given:
        for ours, theirs in zip(native.step(a)[:4], single.step(a)[:4], strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_gymnasium_checker():
    check_env(gym.make(ID, damping=0.2).unwrapped, skip_render_check=not RENDERS)


def test_parameters_are_checked():
    with pytest.raises(ValueError, match="length must be above 0 m, got -1 m"):
        gym.make(ID, length=-1.0)
