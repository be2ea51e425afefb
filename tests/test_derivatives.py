"""Derivatives by parameters, and backwards, against differences in 40-digit arithmetic."""

import math
import zlib

import mpmath
import numpy as np
import pytest
from covering import covering
from test_jacobian import exact_step

from lag_envs.scenes import Acrobot, CartPole, Incline, PivotedBar, Scene, parameter
from lag_envs.tasks import TASKS


def seeded(name):
    return np.random.default_rng(zlib.crc32(name.encode()))


def finite(scene):
    """Return the names of the parameters that are not infinite."""
    return [name for name in scene._numbers() if math.isfinite(getattr(scene, name))]


def directional(scene, state, control, dt, names, direction):
    """Return the derivative of a step along a direction of state, controls and parameters, exactly."""
    n, m, h = len(state), len(control), mpmath.mpf(10) ** -12
    ends = []
    for side in (h, -h):
        values = [mpmath.mpf(x) for x in (*state, *control, *(getattr(scene, p) for p in names))]
        y = [x + side * d for x, d in zip(values, map(mpmath.mpf, direction), strict=True)]
        ends.append(exact_step(scene, y[:n], y[n : n + m], dt, dict(zip(names, y[n + m :], strict=True))))
    return np.array([float(x) for x in (ends[0] - ends[1]) / (2 * h)])


def check_directions(scene, state, control, dt, directions):
    """Compare the Jacobian along directions, which broadcast to rows of all entries."""
    names = finite(scene)
    found = np.concatenate(scene.jacobian(state, control, dt, parameters=names), axis=-1)
    with mpmath.workdps(40):
        for direction in np.broadcast_to(directions, (len(directions), found.shape[-1])):
            expected = directional(scene, state, control, dt, names, direction)
            size = np.maximum(np.abs(found) @ np.abs(direction), 1e-300)
            assert (np.abs(found @ direction - expected) <= 1e-10 * size).all(), direction


@pytest.mark.parametrize("env_id", covering())
def test_jacobian_by_all_parameters(env_id):
    """Along a random direction, so that two exact steps are enough."""
    scene, rng = TASKS[env_id]().scene, seeded(env_id)
    state = rng.uniform(-2.0, 2.0, len(scene.state_names))
    control = rng.uniform(0.0, 2.0, len(scene.control_names))
    width = len(state) + len(control) + len(finite(scene))
    check_directions(scene, state, control, 0.02, rng.uniform(-1.0, 1.0, (1, width)))


#: Parameters that are 0: their terms leave no code in the step, or they stand in a function.
ZERO = {
    "damping": (PivotedBar(damping=0.0), [0.1, 0.2, 2.0, -3.0], [1.0], "damping"),
    "friction": (CartPole(friction=0.0), [0.1, 0.2, 2.0, -3.0], [1.0], "friction"),
    "tilt": (Incline(control="damping", tilt=0.0), [0.1, 0.2], [0.1], "tilt"),
    "a series that the step lacks": (Acrobot(), [0.5, 1.0, -1.0, 2.0], [0.3], "dry_friction"),
}


@pytest.mark.parametrize("case", ZERO)
def test_parameters_that_are_zero(case):
    scene, state, control, name = ZERO[case]
    assert getattr(scene, name) == 0.0
    ahead = len(state) + len(control) + finite(scene).index(name)
    direction = np.zeros((1, len(state) + len(control) + len(finite(scene))))
    direction[0, ahead] = 1.0
    check_directions(scene, state, control, 0.02, direction)
    alone = scene.jacobian(state, control, 0.02, parameters=[name])[2]
    assert np.abs(alone).max() > 1e-4


def test_rows_and_columns_by_parameters():
    bar = PivotedBar()
    states = np.array([[0.1, 0.2, 2.0, -3.0], [0.0, 0.0, 1.0, 9.0]])
    a, b, p = bar.jacobian(states, [1.0, -2.0], parameters=["track", "mass", "damping"])
    assert p.shape == (2, 4, 3)
    np.testing.assert_array_equal(p[..., 0], 0.0)  # the track's length does not move the bar
    for x, y in zip((a, b), bar.jacobian(states, [1.0, -2.0]), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(bar.jacobian(states[1], -2.0, parameters=("damping",))[2], p[1, :, 2:])
    assert bar.jacobian(states, 0.0, parameters=())[2].shape == (2, 4, 0)


class Spring(Scene):
    """A spring whose softness stands in a denominator."""

    softness: float = parameter(0.5, "m/N", least=0.0)
    mass: float = parameter(1.0, "kg", above=0.0)
    reach: float = parameter(math.inf, "m", above=0.0, endless=True)

    coordinates = {"x": "m"}

    def kinetic(self, q, v, xp):
        return 0.5 * self.mass * v.x**2

    def potential(self, q, xp):
        return 0.5 * q.x**2 / self.softness


def test_what_has_no_derivative():
    with pytest.raises(ValueError, match="PivotedBar has no parameter 'lenght', only mass, com_distance"):
        PivotedBar().jacobian([0.0] * 4, parameters=["lenght"])
    with pytest.raises(ValueError, match=r"sequence of names, such as \['mass'\]"):
        PivotedBar().jacobian([0.0] * 4, parameters="mass")
    with pytest.raises(ValueError, match="'mass' is named twice"):
        PivotedBar().jacobian([0.0] * 4, parameters=["mass", "mass"])
    with pytest.raises(ValueError, match="reach=inf: by what is infinite"):
        Spring().jacobian([1.0, 0.0], parameters=["reach"])
    a, _, p = Spring().jacobian([1.0, 0.0], parameters=["mass", "softness"])
    assert a.shape == (2, 2) and np.isfinite(p).all()
