"""Classes of scenes: how they are made, copied, sent elsewhere and forgotten."""

import copy
import dataclasses
import gc
import inspect
import itertools
import math
import pickle
import subprocess
import sys
import threading
import weakref
from types import MappingProxyType

import cloudpickle
import numpy as np
import pytest
from contract_scenes import cart

from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes.acrobot import Acrobot
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.cart_pole import CartPole
from lag_envs.scenes.chain import Chain
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.pivoted_bar import PivotedBar

both = pytest.mark.parametrize("decorate", [False, True], ids=["plain", "decorated"])


# --- how a class is made ---


@both
def test_class_is_a_frozen_dataclass_with_and_without_the_decorator(decorate):
    cls = cart(decorate)
    assert list(inspect.signature(cls).parameters) == ["mass", "spring", "springs", "pair"]
    scene = cls(mass=2.0, springs=3)
    assert repr(scene).endswith("Cart(mass=2.0, spring=2.0, springs=3, pair=())")
    assert scene == cls(mass=2.0, springs=3) != cls()
    assert hash(scene) == hash(cls(mass=2.0, springs=3))
    assert dataclasses.replace(scene, spring=1.0).acceleration([1.0, 0.0])["x"] == -1.5
    assert [f.name for f in dataclasses.fields(cls)] == ["mass", "spring", "springs", "pair"]
    assert cls.mass == 1.0
    for change in (
        lambda: setattr(scene, "mass", 3.0),
        lambda: setattr(scene, "other", 3.0),
        lambda: delattr(scene, "mass"),
    ):
        with pytest.raises(dataclasses.FrozenInstanceError):
            change()
    with pytest.raises(TypeError, match="width"):
        cls(width=1.0)
    with pytest.raises(TypeError):
        cls(2.0)


def test_other_ways_of_dataclasses():
    """Slots, positional fields, a custom __init__, an annotation that makes no field."""
    from typing import ClassVar

    @dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
    class Slots(cart(False)):
        width: float = parameter(0.5, "m", least=0.0)

        def potential(self, q, xp):
            return self.spring * (q.x - self.width) ** 2 / 2

    @dataclasses.dataclass(frozen=True)
    class Positional(cart(False)):
        width: float = parameter(0.5, "m", least=0.0)
        coordinates: ClassVar = {"x": "m"}

    class Own(cart(False)):
        def __init__(self, width):
            for name, value in {"mass": width, "spring": 2.0, "springs": 1, "pair": ()}.items():
                object.__setattr__(self, name, value)

    slots = Slots(width=1.0)
    assert slots.acceleration([1.5, 0.0])["x"] == -1.0
    assert copy.deepcopy(slots) == copy.copy(slots) == slots and copy.copy(Own(2.0)) == Own(2.0)
    assert dataclasses.replace(slots, mass=2.0).acceleration([1.5, 0.0])["x"] == -0.5
    assert Positional(0.25).width == 0.25
    assert Own(4.0).acceleration([1.0, 0.0])["x"] == -0.5


def test_a_singular_state_does_not_make_a_scene_invalid():
    class Polar(Scene):
        coordinates = {"r": "m", "phi": "rad"}

        def kinetic(self, q, v, xp):
            return (v.r**2 + q.r**2 * v.phi**2) / 2

        def potential(self, q, xp):
            return -1 / q.r

    scene = Polar()
    found = scene.acceleration([[1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0], [2.0, 0.0, 0.0, 1.0]])["r"]
    assert found[0] == 0.0 and found[2] == 1.75 and not np.isfinite(found[1])
    A, _ = scene.linearise([[1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    assert np.isfinite(A[0]).all() and not np.isfinite(A[1]).all()


@both
def test_derived_class_inherits_parameters_and_formulas(decorate):
    class Stiff(cart(decorate)):
        cubic: float = parameter(4.0, "N/m³")

        def potential(self, q, xp):
            return super().potential(q, xp) + self.cubic * q.x**4 / 4

    assert Stiff(mass=2.0).acceleration([1.0, 0.0], 2.0)["x"] == -2.0
    assert list(inspect.signature(Stiff).parameters) == ["mass", "spring", "springs", "pair", "cubic"]


@both
def test_own_post_init_does_not_switch_the_checks_off(decorate):
    class Own(cart(decorate)):
        def __post_init__(self):
            pass

    with pytest.raises(ValueError, match="mass must be above 0 kg"):
        Own(mass=-1.0)


def test_declared_dicts_are_copies_that_cannot_be_changed():
    mine = {"x": "m"}

    class Cart(cart(False)):
        coordinates = mine

    mine["y"] = "m"
    assert Cart().state_names == ("x", "x_dot")
    assert isinstance(Cart.coordinates, MappingProxyType)
    with pytest.raises(TypeError):
        Cart.coordinates["y"] = "m"
    with pytest.raises(TypeError):
        Incline.modes["tilt"]["psi"] = "rad"


def test_scene_itself_is_no_scene():
    with pytest.raises(FormulaError, match="base"):
        Scene()


def test_parameter_made_from_others():
    assert PivotedBar(mass=3.0, com_distance=2.0).inertia == 4.0
    assert PivotedBar(mass=3.0, com_distance=2.0, inertia=None).inertia == 4.0
    assert PivotedBar(inertia=0.0).inertia == 0.0
    assert Incline().tilt == 0.26 and Incline(control="tilt").tilt is None
    with pytest.raises(ValueError, match=r"tilt=0.1 rad would be ignored"):
        Incline(control="tilt", tilt=0.1)
    assert PivotedBar(track=math.inf).track == math.inf
    with pytest.raises(ValueError, match="finite"):
        PivotedBar(mass=math.inf)

    class Difference(cart(False)):
        rest: float = parameter(lambda scene: scene.mass - 2.0, "kg", above=0.0)

    assert Difference(mass=3.0).rest == 1.0
    with pytest.raises(ValueError, match="rest must be above 0 kg, but follows as -1 kg"):
        Difference()

    class Uniform(cart(False)):
        inertia: float = parameter(None, "kg m²", least=0.0)

        def kinetic(self, q, v, xp):
            inertia = self.mass / 3 if self.inertia is None else self.inertia
            return inertia * v.x**2 / 2

    assert Uniform().mass_matrix([0.0, 0.0]) == pytest.approx(1 / 3)
    assert Uniform(inertia=4.0).mass_matrix([0.0, 0.0]) == 4.0


def test_a_parameter_made_from_a_later_one_is_named():
    class Late(PivotedBar):
        half: float = parameter(lambda s: None if s.double is None else 0.25 * s.double, "kg")
        double: float = parameter(lambda s: 2.0 * s.mass, "kg")

    with pytest.raises(FormulaError, match=r"Late.half: it uses double, .* declare double first"):
        Late()
    assert Late(double=1.0).half == 0.25


def test_a_derived_class_may_begin_in_another_mode():
    tilted = type("Tilted", (Incline,), {"control": "tilt"})
    for scene in (tilted(), type("Again", (tilted,), {})(), copy.deepcopy(tilted())):
        assert (scene.control, scene.control_names) == ("tilt", ("phi",))
    assert tilted(control="tilt_rate").control == "tilt_rate"


def test_an_attribute_of_instances_is_noticed_beside_large_numbers():
    """What is allowed for rounding follows a formula's own parameters."""

    class Stiff(cart(False)):
        modulus: float = parameter(2e11, "Pa", above=0.0)
        area: float = parameter(1e-11, "m", above=0.0)
        extra = 100.0

        def __post_init__(self):
            object.__setattr__(self, "extra", self.mass)

        def kinetic(self, q, v, xp):
            return 0.5 * self.extra * v.x**2

        def potential(self, q, xp):
            return 0.5 * self.modulus * self.area * q.x**2

    with pytest.raises(
        FormulaError, match=r"Stiff.kinetic gives another result on plain .* in __post_init__"
    ):
        Stiff()


def test_a_yes_or_no_is_a_bool():
    kind = type("Sprung", (PivotedBar,), {"__annotations__": {"spring": "bool"}, "spring": True})
    assert kind(spring=np.False_).spring == np.False_
    with pytest.raises(ValueError, match="spring must be True or False, got 'no'"):
        kind(spring="no")


@pytest.mark.parametrize("value", [50.0, parameter(50.0, "kg")])
def test_a_parameter_in_a_class_that_is_no_scene_is_named(value):
    mixin = type("Heavy", (), {"mass": value})
    with pytest.raises(
        FormulaError, match=r"Mixed.mass: Heavy is not a scene, so this has no effect; declare"
    ):
        type("Mixed", (mixin, PivotedBar), {})()


def test_what_nothing_calls_is_noticed():
    rub = {"friction": lambda self, q, v, u, xp: v.theta**2}
    with pytest.warns(
        UserWarning, match=r"nothing uses Rubbed.friction, though it takes xp as the formulas of"
    ):
        type("Rubbed", (PivotedBar,), rub)()
    with pytest.raises(FormulaError, match=r"Own._point hides an attribute of every scene"):
        type("Own", (PivotedBar,), {"_point": lambda self, q, xp: q.theta})()
    with pytest.raises(FormulaError, match=r"Own.check must raise a ValueError or return nothing, got False"):
        type("Own", (PivotedBar,), {"check": lambda self: False})()


def test_check_may_fill_in_as_before():
    class Uniform(cart(False)):
        inertia: float = parameter(None, "kg m²", least=0.0)

        def check(self):
            if self.inertia is None:
                object.__setattr__(self, "inertia", self.mass / 3)

        def kinetic(self, q, v, xp):
            return self.inertia * v.x**2 / 2

    assert Uniform(mass=6.0).mass_matrix([0.0, 0.0]) == 2.0


def test_methods_and_properties_that_formulas_call_see_recorded_numbers():
    class Cart(cart(False)):
        @property
        def doubled(self):
            return 2 * self.spring

        def energy_of(self, stretch):
            return self.doubled * stretch**2 / 4

        def potential(self, q, xp):
            return self.energy_of(q.x)

    assert {s.name for s in Cart().mechanics.record.energies.potential.symbols()} == {"spring", "x"}
    assert Cart(spring=3.0).acceleration([1.0, 0.0])["x"] == -3.0
    assert Cart(spring=3.0).doubled == 6.0


# --- anywhere ---


@pytest.mark.parametrize(
    "scene",
    [
        PivotedBar(track=None),
        Incline(control="tilt_rate"),
        Chain(bars=3),
        Acrobot(control="both"),
        CartPole(friction=1.0),
    ],
    ids=lambda s: type(s).__name__,
)
def test_copies_are_the_same(scene):
    state = np.linspace(0.1, 0.9, len(scene.state_names))
    control = np.linspace(0.5, 1.0, len(scene.control_names))
    expected = scene.acceleration(state, control)  # fills the caches
    copies = [
        pickle.loads(pickle.dumps(scene)),
        copy.copy(scene),
        copy.deepcopy(scene),
        cloudpickle.loads(cloudpickle.dumps(scene)),
    ]
    for again in copies:
        assert again == scene and type(again) is type(scene)
        assert again.acceleration(state, control) == expected


def test_class_that_no_module_has_goes_by_value():
    """As with classes of `__main__` and of notebooks: cloudpickle, in another process; used before or not."""
    sent = []
    for decorate, used in itertools.product((False, True), repeat=2):
        cls = cart(decorate)
        sent.append((cls, cls(mass=2.0, pair=(1, 2)) if used else None))
    code = (
        "import sys, dataclasses, pickle\n"
        "for cls, scene in map(pickle.loads, pickle.loads(sys.stdin.buffer.read())):\n"
        "    scene = scene or cls(mass=2.0, pair=(1, 2))\n"
        "    again = dataclasses.replace(scene, spring=4.0)\n"
        "    print(again, again.acceleration([1.0, 0.0], 3.0)['x'], cls(springs=2) == cls(springs=2))\n"
        "    try: cls(mass=-1.0)\n"
        "    except ValueError as error: print(error)\n"
    )
    text = pickle.dumps([cloudpickle.dumps(one) for one in sent])
    run = subprocess.run([sys.executable, "-c", code], input=text, capture_output=True, check=False)
    lines = run.stdout.decode().splitlines()
    assert len(lines) == 8, run.stderr.decode()
    for first, second in zip(lines[::2], lines[1::2], strict=True):
        assert first.endswith("Cart(mass=2.0, spring=4.0, springs=1, pair=(1, 2)) -0.5 True")
        assert second == "mass must be above 0 kg, got -1 kg"


def test_class_of_a_missing_module_works():
    """It was sent by value, before its first use, to a process that cannot import its module."""
    control = {"modes": {"push": {"force": "N"}}, "controls": {}, "__module__": "nowhere"}
    assert type("Moved", (cart(False),), control)().control == "push"
    assert "nowhere" not in sys.modules


MAIN = """
import multiprocessing, pickle
from lag_envs.scenes.base import Scene, parameter

class Cart(Scene):
    mass: float = parameter(1.0, "kg", above=0.0)
    coordinates = {"x": "m"}
    def kinetic(self, q, v, xp): return self.mass * v.x**2 / 2
    def potential(self, q, xp): return q.x**2 / 2

def work(scene):
    return scene.acceleration([1.0, 0.0])["x"]

if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        print(pool.map(work, [Cart(mass=2.0)])[0])
"""


def test_script_sends_its_scene_to_a_spawned_worker(tmp_path):
    (tmp_path / "script.py").write_text(MAIN)
    run = subprocess.run(
        [sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=False
    )
    assert run.stdout == "-0.5\n", run.stderr


def test_classes_of_one_name_never_share():
    """As a notebook's cell that is run again with another formula."""
    scenes = []
    for factor in (1, 2, 3):
        space = {"Scene": Scene, "__name__": "__main__"}
        exec(
            "class Cart(Scene):\n"
            "    coordinates = {'x': 'm'}\n"
            "    def kinetic(self, q, v, xp): return v.x**2 / 2\n"
            f"    def potential(self, q, xp): return {factor} * q.x**2 / 2\n",
            space,
        )
        scenes.append(space["Cart"]())
    assert [scene.acceleration([1.0, 0.0])["x"] for scene in scenes] == [-1.0, -2.0, -3.0]
    assert len({scene.mechanics.key for scene in scenes}) == 3


FACTOR = 1.0


def test_formula_sees_what_it_uses_when_the_scene_is_made(monkeypatch):
    class Cart(cart(False)):
        def potential(self, q, xp):
            return FACTOR * q.x**2

    assert Cart().acceleration([1.0, 0.0])["x"] == -2.0
    monkeypatch.setitem(globals(), "FACTOR", 5.0)
    assert Cart().acceleration([1.0, 0.0])["x"] == -10.0


def test_replaced_formula_is_looked_at_again(monkeypatch):
    cls = cart(False)
    assert cls().acceleration([1.0, 0.0])["x"] == -2.0
    monkeypatch.setattr(cls, "potential", lambda self, q, xp: math.sin(q.x))
    with pytest.raises(FormulaError, match="potential"):
        cls()


def test_classes_can_be_forgotten():
    gc.freeze()  # what other tests left need not be searched
    cls = cart(False)
    cls().mechanics  # noqa: B018
    gone = weakref.ref(cls)
    del cls
    gc.collect()
    assert gone() is None


def test_threads_share_a_scene():
    scene, states = Chain(bars=3), np.random.default_rng(8).normal(size=(40, 8))
    expected = Chain(bars=3).acceleration(states)["theta_2"]
    found = []
    threads = [
        threading.Thread(target=lambda: found.append(scene.acceleration(states)["theta_2"])) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8 and all((x == expected).all() for x in found)


def test_sympy_is_not_loaded():
    code = (
        "import sys; from lag_envs.scenes.chain import Chain; Chain(bars=2).linearise([.1] * 6)\n"
        "print([m for m in ('sympy', 'scipy', 'pygame', 'torch', 'matplotlib') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
