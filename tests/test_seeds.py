"""The three first scenes, written by their energies, against the same scenes written by hand."""

import itertools
import math

import numpy as np
import pytest

from lag_envs.scenes import CylinderInCylinder as OldShell
from lag_envs.scenes import Incline as OldIncline
from lag_envs.scenes import PivotedBar as OldBar
from lag_envs.scenes.cylinder_in_cylinder import CylinderInCylinder
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.pivoted_bar import PivotedBar
from lag_envs.scenes.shapes import Moment

#: Old class, new class and keywords of all variants.
VARIANTS = [
    (OldBar, PivotedBar, {"track": 0.5}),
    (OldBar, PivotedBar, {"track": math.inf}),
    (OldBar, PivotedBar, {"track": None}),
    (OldIncline, Incline, {"control": "damping"}),
    (OldIncline, Incline, {"control": "tilt"}),
    (OldIncline, Incline, {"control": "tilt_rate"}),
    (OldShell, CylinderInCylinder, {"control": "damping"}),
    (OldShell, CylinderInCylinder, {"control": "tilt"}),
]
variants = pytest.mark.parametrize(
    ("old", "new", "keywords"),
    VARIANTS,
    ids=["-".join([v[1].__name__, *map(str, v[2].values())]) for v in VARIANTS],
)


def pairs(old, new, keywords):
    """Yield old and new scenes with default and with random parameters, damped and not, and a generator."""
    for seed, damping, gravity in itertools.product(range(3), (0.0, 0.3), (9.81, 0.0)):
        generator = np.random.default_rng(seed)
        numbers = {"damping": damping, "gravity": gravity}
        if seed:
            numbers |= {"mass": generator.uniform(0.1, 3.0), "inertia": generator.uniform(0.001, 0.1)}
        yield old(**keywords, **numbers), new(**keywords, **numbers), generator


def agree(mine, theirs, size=1.0):
    mine, theirs = np.broadcast_arrays(mine, theirs)
    finite = np.isfinite(theirs)
    np.testing.assert_array_equal(np.isfinite(mine), finite)
    scale = np.maximum(size, np.abs(theirs[finite]))
    assert (np.abs(mine[finite] - theirs[finite]) <= 1e-13 * scale).all()


@variants
def test_seeds_are_what_they_were(old, new, keywords):
    """Names, units, accelerations, energies, forces, needed friction and powers."""
    for before, after, generator in pairs(old, new, keywords):
        assert after.state_names == before.state_names
        assert after.state_units == before.state_units
        assert before.control_unit.endswith(f"[{after.control_units[0]}]")
        states = generator.uniform(-2.0, 2.0, (50, len(after.state_names)))
        controls = generator.uniform(0.0, 1.5, 50)
        moved = before.motion(states, controls).a
        size = float(np.max(np.abs(getattr(moved, before.coordinates[0])))) + 1.0
        for name, value in after.acceleration(states, controls).items():
            agree(value, getattr(moved, name), size)
        for call in ("energy", "forces", "power"):
            mine, theirs = getattr(after, call)(states, controls), getattr(before, call)(states, controls)
            assert set(theirs) <= set(mine) <= set(theirs) | {"applied"}
            bound = max(
                float(np.max(np.abs(v[np.isfinite(v)]), initial=1.0))
                for v in map(np.asarray, theirs.values())
            )
            for name, value in theirs.items():
                if name != "needed_friction":
                    agree(mine[name], value, bound)
        if "needed_friction" in theirs:
            friction = after.forces(states, controls)["needed_friction"]
            carries = np.abs(mine["normal"]) > 1e-3
            agree(friction[carries], theirs["needed_friction"][carries])


def test_vertical_plane_carries_nothing():
    for tilt in (math.pi / 2, -math.pi / 2, 1.2):
        before, after = OldIncline(tilt=tilt), Incline(tilt=tilt)
        assert after.forces([0.1, 0.2]) == pytest.approx(before.forces([0.1, 0.2]), rel=1e-13, abs=1e-13)
        assert math.isinf(after.forces([0.1, 0.2])["needed_friction"]) == (tilt != 1.2)
        now = Moment([0.1, 0.2], 0.0)
        assert sorted(map(_summary, after.shapes(now))) == sorted(map(_summary, before.shapes(now)))
    with pytest.raises(ValueError, match="tilt must be at most"):
        Incline(tilt=1.6)


@variants
def test_one_state_is_a_row_of_many(old, new, keywords):
    scene, generator = new(**keywords), np.random.default_rng(4)
    states, controls = generator.normal(size=(3, 5, len(scene.state_names))), generator.normal(size=(3, 5))
    for call in (scene.acceleration, scene.energy, scene.forces, scene.power):
        many, column = call(states, controls), call(states, controls[..., None])
        for name, value in call(states[1, 2], controls[1, 2]).items():
            assert np.ndim(value) == 0 and many[name].shape == (3, 5)
            np.testing.assert_allclose(many[name][1, 2], value, rtol=1e-14)
            np.testing.assert_array_equal(many[name], column[name])
    A, B = scene.linearise(states, controls)
    assert A.shape == (3, 5, len(scene.state_names), len(scene.state_names)) and B.shape[-1] == 1
    np.testing.assert_allclose(
        A[1, 2], scene.linearise(states[1, 2], controls[1, 2])[0], rtol=1e-13, atol=1e-13
    )


@variants
def test_pictures_are_what_they_were(old, new, keywords):
    for before, after, generator in pairs(old, new, keywords):
        for _ in range(3):
            state = generator.uniform(-1.0, 1.0, len(after.state_names)).tolist()
            now = Moment(
                state,
                generator.uniform(0.1, 1.0),
                0.4,
                turned=0.3 if keywords.get("control") == "tilt" else 0.0,
            )
            assert np.allclose(after.window(now), before.window(now))
            mine, theirs = after.shapes(now), before.shapes(now)
            assert sorted(map(_summary, mine)) == sorted(map(_summary, theirs))


def _summary(shape):
    """Return a shape as rounded text; a polygon's corners may begin anywhere."""
    points = getattr(shape, "points", None) or [shape.centre, (getattr(shape, "radius", 0.0), 0.0)]
    rounded = [f"{x + 1e-9:.6f} {y + 1e-9:.6f}" for x, y in points]
    return f"{type(shape).__name__} {shape.role} {sorted(rounded)}"
