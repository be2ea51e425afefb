"""MuJoCo as an independent engine: its multibody dynamics of the same bodies, at the same states.

MuJoCo's inverse dynamics is exact to rounding for tree-like bodies, so forces and accelerations are compared
state by state; its own integrator is then followed over a run.
"""

import math

import numpy as np
import pytest

from lag_envs.scenes import CylinderInCylinder, Incline, PivotedBar

mujoco = pytest.importorskip("mujoco")
pytestmark = pytest.mark.slow

# x to the right, z up; a hinge about -y turns counter-clockwise as seen with x to the right and z up.
BAR = """
<mujoco>
  <option gravity="0 0 -9.81" timestep="1e-4" integrator="RK4"/>
  <worldbody><body>
    <joint name="s" type="slide" axis="1 0 0"/>
    <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/>
    <body>
      <joint name="theta" type="hinge" axis="0 -1 0" damping="{b}"/>
      <inertial pos="0 0 -{arm}" mass="{m}" diaginertia="{i} {i} {i}"/>
    </body>
  </body></worldbody>
</mujoco>
"""

# The plane turns clockwise about the origin; the axis slides along it, R above; the cylinder turns on it.
PLANE = """
<mujoco>
  <option gravity="0 0 -9.81" timestep="1e-4" integrator="RK4"/>
  <worldbody><body>
    <joint name="phi" type="hinge" axis="0 1 0"/>
    <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/>
    <body pos="0 0 {r}">
      <joint name="x" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/>
      <body>
        <joint name="roll" type="hinge" axis="0 1 0"/>
        <inertial pos="0 0 0" mass="{m}" diaginertia="{i} {i} {i}"/>
      </body>
    </body>
  </body></worldbody>
</mujoco>
"""

# An arm of length a turns about the shell's axis and carries the cylinder, which turns on it.
SHELL = """
<mujoco>
  <option gravity="0 0 -9.81" timestep="1e-4" integrator="RK4"/>
  <worldbody><body>
    <joint name="theta" type="hinge" axis="0 -1 0"/>
    <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/>
    <body pos="0 0 -{arm}">
      <joint name="roll" type="hinge" axis="0 -1 0"/>
      <inertial pos="0 0 0" mass="{m}" diaginertia="{i} {i} {i}"/>
    </body>
  </body></worldbody>
</mujoco>
"""


class Engine:
    """A model, asked by joint name."""

    def __init__(self, xml, **numbers):
        self.model = mujoco.MjModel.from_xml_string(xml.format(**numbers))
        self.data = mujoco.MjData(self.model)
        self.at = {self.model.joint(j).name: j for j in range(self.model.njnt)}

    def set(self, array, **values):
        for name, value in values.items():
            array[self.at[name]] = value

    def inverse(self, q, v, a):
        """Return the generalised forces, without drag, that this motion needs."""
        self.set(self.data.qpos, **q)
        self.set(self.data.qvel, **v)
        self.set(self.data.qacc, **a)
        mujoco.mj_inverse(self.model, self.data)
        return {name: self.data.qfrc_inverse[j] for name, j in self.at.items()}


def random_states(n, sizes, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (n, len(sizes))) * sizes


def test_bar():
    """The pivot needs no torque, the support the force given by `forces`, whatever the state."""
    bar = PivotedBar(mass=0.3, com_distance=0.4, inertia=0.02, damping=0.01)
    engine = Engine(BAR, m=0.3, arm=0.4, i=0.02, b=0.01)
    for *state, u in random_states(200, [1, 2, 6, 10, 20]):
        s, rate, theta, turn = state
        need = engine.inverse(
            {"s": s, "theta": theta},
            {"s": rate, "theta": turn},
            {"s": u, "theta": bar.acceleration(state, u)["theta"]},
        )
        assert need["theta"] == pytest.approx(0.0, abs=1e-7)
        assert need["s"] == pytest.approx(bar.forces(state, u)["support_horizontal"], abs=1e-6)


def test_bar_over_a_run():
    """MuJoCo's RK4 at 0.1 ms over 2 s, in the support's frame, where its acceleration tilts gravity."""
    bar = PivotedBar(mass=0.3, com_distance=0.4, inertia=0.02, damping=0.01, track=None)
    fixed = BAR.replace('<joint name="s" type="slide" axis="1 0 0"/>', "")
    engine = Engine(fixed, m=0.3, arm=0.4, i=0.02, b=0.01)
    engine.set(engine.data.qpos, theta=2.0)
    engine.set(engine.data.qvel, theta=-1.0)
    controls = np.random.default_rng(1).uniform(-10, 10, 100)
    for u in controls:
        engine.model.opt.gravity[:] = (-u, 0.0, -9.81)
        mujoco.mj_step(engine.model, engine.data, 200)
    end = bar.simulate([2.0, -1.0], controls, 0.02)[-1]
    assert [engine.data.qpos[0], engine.data.qvel[0]] == pytest.approx(end, abs=1e-9)


@pytest.mark.parametrize("rate", [0.0, 0.3, -3.0])
def test_incline(rate):
    """Rolling ties `roll` to x and phi; by virtual work the tied forces must balance the drag and the drive.

    With Omega = x'/R + phi', the cylinder's turn on the axis is x/R.
    """
    plane = Incline(mass=0.7, radius=0.2, inertia=0.02, damping=0.4, control="tilt_rate")
    engine = Engine(PLANE, m=0.7, r=0.2, i=0.02)
    for x, v, phi in random_states(100, [1, 3, 1.5], seed=2):
        state = [x, v + 0.2 * rate, phi]
        a = plane.acceleration(state, rate)["x"]
        need = engine.inverse(
            {"phi": phi, "x": x, "roll": x / 0.2},
            {"phi": rate, "x": v, "roll": v / 0.2},
            {"phi": 0.0, "x": a, "roll": a / 0.2},
        )
        forces = plane.forces(state, rate)
        assert need["x"] + need["roll"] / 0.2 == pytest.approx(-0.4 * v, abs=1e-7)
        assert need["phi"] == pytest.approx(forces["drive_torque"], abs=1e-7)
        # The tie's force at the rim is the friction.
        assert need["roll"] / 0.2 == pytest.approx(forces["friction"], abs=1e-7)


@pytest.mark.parametrize("control", ["damping", "tilt"])
def test_shell(control):
    """Rolling ties `roll` to theta and psi: Omega = (R psi' - a theta')/r, of which the arm turns theta'."""
    big, r, m, i, c = 0.5, 0.15, 0.7, 0.01, 0.05
    arm = big - r
    shell = CylinderInCylinder(mass=m, shell_radius=big, radius=r, inertia=i, damping=c, control=control)
    engine = Engine(SHELL, m=m, arm=arm, i=i)
    for theta, v, spin, u in random_states(100, [3, 8, 6, 15], seed=3):
        state, u, spin = ([theta, v, spin], u, spin) if control == "tilt" else ([theta, v], abs(u), 0.0)
        drag = c if control == "tilt" else c + u
        a = shell.acceleration(state, u)["theta"]

        def roll(shell_turn, turn):
            return (big * shell_turn - arm * turn) / r - turn

        need = engine.inverse(
            {"theta": theta, "roll": 0.0},
            {"theta": v, "roll": roll(spin, v)},
            {"theta": a, "roll": roll(u if control == "tilt" else 0.0, a)},
        )
        forces = shell.forces(state, u)
        # A step of theta turns the tied joint by -(a/r + 1), one of psi by R/r.
        assert need["theta"] - need["roll"] * (arm / r + 1) == pytest.approx(-drag * (v - spin), abs=1e-7)
        assert need["roll"] / r == pytest.approx(forces["friction"], abs=1e-7)
        if control == "tilt":
            torque = need["roll"] * big / r + drag * (spin - v)
            assert torque == pytest.approx(forces["drive_torque"], abs=1e-7)


def test_angles_turn_the_same_way():
    """A bar at +90 degrees points along +x in MuJoCo as it does here."""
    engine = Engine(BAR, m=0.3, arm=0.4, i=0.02, b=0.0)
    engine.set(engine.data.qpos, theta=math.pi / 2)
    mujoco.mj_forward(engine.model, engine.data)
    assert engine.data.xipos[-1] == pytest.approx([0.4, 0.0, 0.0], abs=1e-12)
