"""The recipe of CONTRIBUTING.md: a scene and a task outside the package are as good as those inside."""

import gymnasium as gym
import numpy as np
import pytest
import sympy
from gymnasium.utils.env_checker import check_env
from rollouts import RENDERS, actions
from scipy.integrate import solve_ivp
from toy_pendulum import Pendulum

from lag_envs import lagrange
from lag_envs.lagrange import coordinates, symbolic

ID = "ToySwing-v0"


@pytest.fixture(autouse=True)
def registered():
    gym.register(
        ID,
        entry_point="lag_envs.envs.single:LagrangianEnv",
        vector_entry_point="lag_envs.envs.vector:LagrangianVectorEnv",
        kwargs={"task": "toy_pendulum:Swing"},
    )
    yield
    del gym.registry[ID]


def test_drive_is_euler_lagrange():
    scene, u = Pendulum(), sympy.Symbol("u")
    twin, q, v = symbolic(scene), *coordinates(scene)
    k = sympy.Dict(twin.constants())
    drive = twin.drive((), u, type("K", (), {str(a): b for a, b in k.items()}), sympy)
    stepped = drive.delta - drive.alpha * sympy.sin(q.theta) - drive.gamma * v.theta
    # The torque is the generalised force of theta.
    equation = lagrange.euler_lagrange(scene, "theta") - u
    assert sympy.simplify(sympy.nsimplify(equation.subs(v.theta.diff(lagrange.t), stepped))) == 0


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
