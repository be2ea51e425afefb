"""MuJoCo as an independent engine: mass matrix and accelerations of the same bodies at the same states."""

import numpy as np
import pytest

from lag_envs.scenes.acrobot import Acrobot
from lag_envs.scenes.cart_pole import CartPole
from lag_envs.scenes.chain import Chain
from lag_envs.scenes.derivation import layout_of
from lag_envs.scenes.rotary_pendulum import RotaryPendulum
from lag_envs.scenes.two_link_arm import TwoLinkArm

mujoco = pytest.importorskip("mujoco")

# x to the right, z up; a hinge about -y turns counter-clockwise as seen with x to the right and z up.
HINGE = '<joint type="hinge" axis="0 -1 0" damping="{b}"/>'


def model(body, gravity=9.81):
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="0 0 -{gravity}"/><worldbody>{body}</worldbody></mujoco>'
    )


def rod(mass, com, inertia, along=(0, 0, -1)):
    """Return an inertial of a thin rod: its axial inertia is tiny but positive, as MuJoCo requires."""
    place = " ".join(str(com * x) for x in along)
    sizes = [inertia if x == 0 else 1e-13 for x in along]
    sizes = [s if s > 1e-12 else 2e-13 for s in sizes]
    return f'<inertial pos="{place}" mass="{mass}" diaginertia="{sizes[0]} {sizes[1]} {sizes[2]}"/>'


def pair(m1, c1, i1, l1, m2, c2, i2, b, along=(0, 0, -1)):
    end = " ".join(str(l1 * x) for x in along)
    hinge = HINGE.format(b=b)
    second = f"<body pos='{end}'>{hinge}{rod(m2, c2, i2, along)}</body>"
    return f"<body>{hinge}{rod(m1, c1, i1, along)}{second}</body>"


def answers(engine, q, v, force):
    """Return mass matrix and accelerations of MuJoCo."""
    data = mujoco.MjData(engine)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, force
    mujoco.mj_forward(engine, data)
    mass = np.zeros((engine.nv, engine.nv))
    for column, unit in zip(mass, np.eye(engine.nv), strict=True):
        mujoco.mj_mulM(engine, data, column, unit)
    return mass, data.qacc.copy()


def compare(scene, engine, force_of, turn=None, prescribed=(), push=2.0):
    """Compare at random states; ``turn`` maps the scene's velocities to MuJoCo's."""
    n = len(layout_of(scene).free)
    turn = np.eye(n) if turn is None else turn
    generator = np.random.default_rng(0)
    for _ in range(50):
        q, v = generator.uniform(-2, 2, n), generator.uniform(-6, 6, n)
        u = generator.uniform(-push, push, len(scene.control_names))
        state = np.concatenate([prescribed, np.stack([q, v], axis=1).ravel()])
        mass, acceleration = answers(engine, turn @ q, turn @ v, force_of(u))
        # MuJoCo's rods are 1e-13 kg m² thick.
        np.testing.assert_allclose(scene.mass_matrix(state), turn.T @ mass @ turn, rtol=1e-10, atol=1e-11)
        mine = turn @ np.array(list(scene.acceleration(state, u).values()))
        np.testing.assert_allclose(mine, acceleration, rtol=1e-8, atol=1e-8 * np.abs(acceleration).max())


def test_cart_pole():
    scene = CartPole(friction=0.2)
    pole = f'<joint type="hinge" axis="0 1 0"/>{rod(0.1, 0.5, 0.1 * 0.25 / 3, (0, 0, 1))}'
    cart = (
        '<joint type="slide" axis="1 0 0" damping="0.2"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    )
    compare(scene, model(f"<body>{cart}<body>{pole}</body></body>", 9.8), lambda u: [u[0], 0.0])


def test_acrobot():
    scene = Acrobot(
        mass_2=0.7, com_distance_2=0.3, inertia_1=0.2, inertia_2=0.05, damping=0.1, control="both"
    )
    engine = model(pair(1.0, 0.5, 0.2, 1.0, 0.7, 0.3, 0.05, 0.1))
    compare(scene, engine, lambda u: u)


def test_two_link_arm():
    """The load is a point at the forearm's end: one rod with the mass, centre and inertia of both."""
    scene = TwoLinkArm(load=0.5, damping=0.3)
    m, c = 1.5, (0.15 + 0.5 * 0.3) / 1.5
    inertia = 0.3**2 / 12 + (c - 0.15) ** 2 + 0.5 * (0.3 - c) ** 2
    engine = model(pair(2.0, 0.2, 2.0 * 0.16 / 12, 0.4, m, c, inertia, 0.3, (1, 0, 0)))
    compare(scene, engine, lambda u: u)


def test_rotary_pendulum():
    """The arm lies along x and turns about the vertical, the pendulum about the arm."""
    scene = RotaryPendulum(arm_damping=0.002, damping=0.001)
    arm = '<joint type="hinge" axis="0 0 1" damping="0.002"/>'
    arm += '<inertial pos="0 0 0" mass="1" diaginertia="1 1 .001"/>'
    swing = f'<joint type="hinge" axis="1 0 0" damping="0.001"/>{rod(0.1, 0.15, 0.1 * 0.15**2 / 3)}'
    compare(scene, model(f'<body>{arm}<body pos=".2 0 0">{swing}</body></body>'), lambda u: [u[0], 0.0])


@pytest.mark.parametrize("bars", [1, 2, 3, 6])
def test_chain(bars):
    """A support's acceleration is a field, and MuJoCo's angles are relative."""
    scene = Chain(bars=bars, com_distance=0.25, inertia=0.01, damping=0.02)
    engine = model(_nested(bars))

    def tilt(u):
        engine.opt.gravity[:] = (-u[0], 0.0, -9.81)
        return np.zeros(bars)

    compare(scene, engine, tilt, np.eye(bars) - np.eye(bars, k=-1), prescribed=[0.3, -0.4], push=10.0)


def _nested(bars, first=True):
    if not bars:
        return ""
    place = "" if first else ' pos="0 0 -0.6"'
    return f"<body{place}>{HINGE.format(b=0.02)}{rod(0.2, 0.25, 0.01)}{_nested(bars - 1, False)}</body>"
