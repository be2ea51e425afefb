"""What a task may not be is refused when it is made, by name and with the remedy."""

import dataclasses
import inspect
import math
import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import own_tasks
import pytest
from contract_scenes import Bead
from own_tasks import mistaken

import lag_envs
from lag_envs.envs.single import LagrangianEnv
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes import CartPole, Incline, Scene, parameter
from lag_envs.tasks import Task, pivoted_bar
from lag_envs.tasks.imperfections import KEYWORDS


def _difference(last, x):
    before, last["f"] = last["f"], x
    return x - before


def _guarded(function, x):
    try:
        return function(x)
    except ValueError:
        return 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene": None}, "Mistaken.scene must be a class derived from Scene"),
        ({"action": {"shove": 1.0}}, r"action\['shove'\]: the scene has no such control, only push, pull"),
        (
            {"scene": Incline, "defaults": {}, "action": {"phi_dot": 1.0}},
            r"action\['phi_dot'\]: the scene .* only drag; write 'control': 'tilt_rate' into defaults",
        ),
        ({"action": {}}, "Mistaken.action must give limits"),
        ({"action": {"push": 0.0, "pull": 1.0}}, "limit above 0"),
        (
            {"action": {"push": (1.0, 2.0, 3.0), "pull": 1.0}},
            r"action\['push'\] must be a limit above 0, \(low, high\) or a list of values",
        ),
        ({"action": {"push": {0.0, 1.0}, "pull": 1.0}}, r"must be .* or a list of values, got \{0.0, 1.0\}"),
        ({"action": {"push": (1.0,), "pull": 1.0}}, "limit above 0"),
        (
            {"action": {"push": "far", "pull": 1.0}},
            r"^Mistaken.action\['push'\] must be a limit above 0, .* got 'far'",
        ),
        ({"action": {"push": [1.0, 2.0], "pull": 1.0}}, "mixes lists of values with ranges"),
        ({"action": {"push": [1.0]}}, "at least two values"),
        ({"action": {"push": [1.0, 1.0]}}, r"at least two values, each once, got \[1.0, 1.0\]"),
        ({"scaled": "no"}, "Mistaken.scaled must be True or False, got 'no'"),
        ({"action": {"push": np.ones((2, 2))}}, r"action\['push'\] must be a real number, got array"),
        ({"start": {"y": 0.1}}, r"start\['y'\]: the state has no such entry, only x, x_dot"),
        ({"start": {"x": "far"}}, r"^Mistaken.start\['x'\] must be a real number, got 'far'"),
        ({"target": {"x_goal": 0.3}}, r"target\['x_goal'\] must be \(unit, half width\)"),
        ({"observe": lambda self, after, target, xp: [after.x]}, "observe must return numbers by name"),
        ({"observe": lambda self, after, target, xp: {"x": after.y}}, "there is no entry of the state 'y'"),
        ({"reward": lambda self, *_: None}, "reward returns None"),
        (
            {"reward": lambda self, b, after, c, t, dt, xp: xp.clip(after.x, 0.0, 1.0)},
            r"it uses xp.clip, .* write xp.minimum\(xp.maximum\(x, low\), high\)",
        ),
        (
            {"reward": lambda self, b, after, c, t, dt, xp: xp.where(after.x > 0.0, 1.0)},
            "give xp.where all its arguments",
        ),
        (
            {"reward": lambda self, b, after, c, t, dt, xp: self.target["there"]},
            "KeyError: 'there'; look up only names that exist; state, controls and target are arguments",
        ),
        (
            {"reward": lambda self, after: 0.0},
            r"reward must be reward\(self, before, .*, got \(self, after\)",
        ),
        ({"reward": 0.0}, r"Mistaken.reward must be a method, reward\(self, before, .*, got 0.0"),
        ({"reward": lambda self, b, after, *a: a[-1].clip(after.x, 0, 1)}, "it uses xp.clip, .* minimum"),
        ({"reward": lambda self, b, after, *a: a[-1].pow(after.x, 2)}, r"it uses xp.pow, .* write x"),
        ({"reward": lambda self, b, after, *_: math.exp(after.x)}, "write xp.exp for math.exp"),
        ({"reward": lambda self, b, after, *_: np.exp(after.x)}, "write xp.exp"),
        ({"reward": lambda self, *_: self.scene.load_mas}, "no attribute 'load_mas'; did you mean load_mass"),
        (
            {"reward": lambda self, *_: self.scene.brake},
            "no attribute 'brake'; it has trolley_mass, load_mass",
        ),
        ({"reward": lambda self, *_: self.scne.load_mass}, "no attribute 'scne'; did you mean scene"),
        (
            {"reward": lambda self, b, after, *_: after.x - self.target.x_goal},
            "no attribute 'x_goal'; look up only names that exist; state, controls and target are arguments",
        ),
        ({"reward": lambda self, b, after, *a: a[-1].abs(after)}, "take the numbers one by one, by name"),
        (
            {"reward": lambda self, b, after, *a: a[-1].sin(after.x, after.rope)},
            r"give functions of xp the arguments of NumPy's, as in xp.cos\(x\)",
        ),
        (
            {"reward": lambda self, *_: self.scene.simulate([0.0] * 6, [[0.0, 0.0]], 0.1)[1, 0]},
            "reward: a formula calls something that is derived .* self.scene.kinetic",
        ),
        ({"kick": lambda self, after, draws, xp: {"x": draws[2]}}, "no random draw number 2, only 2 of them"),
        ({"reward": lambda self, b, after, *_: [after.x]}, "returns a list; it must return a number"),
        ({"reward": lambda self, b, after, *_: 1.0 if after.x > 0 else 0.0}, "branch"),
        ({"terminated": lambda self, after, target, xp: after.x > 1 and after.x < 2}, "branch"),
        ({"terminated": lambda self, after, target, xp: after.x == 1}, "terminated: .* by ==, != or in"),
        ({"reward": lambda self, *_: 1.0 if self.scene.load_mass != 0.3 else 0.0}, "by ==, != or in"),
        ({"reward": lambda self, b, after, *_: 1.0 if after.x in (0.0, 1.0) else 0.0}, "by ==, != or in"),
        ({"reward": lambda self, *_: {0.3: 1.0}.get(self.scene.load_mass, 0.0)}, "looked up .* xp.where"),
        ({"reward": lambda self, *_: {"0.3": 1.0}.get(f"{self.scene.load_mass}", 0.0)}, "uses the text of"),
        (
            {"reward": lambda self, b, after, c, *_, last={"f": 0.0}: _difference(last, c.push)},
            "uses a number from an earlier call; formulas must not keep numbers in a list",
        ),
        (
            {"reward": lambda self, b, after, *_: _guarded(math.acos, after.x)},
            "reward: a function of math, .* the formula catches this error, which it must not",
        ),
        ({"reward": lambda self, b, after, *_: after.x % 2.0}, r"for a % b write a - b \* xp.floor\(a / b\)"),
        ({"reward": lambda self, b, after, *_: round(after.x)}, r"write xp.floor\(x \+ 0.5\)"),
        ({"kick": lambda self, after, draws, xp: {"place": 1.0}}, "no entry 'place' of the state"),
        ({"guard": lambda self, wanted, before, dt, xp: {"shove": 1.0}}, "there is no control 'shove'"),
        ({"bounds": lambda self: {"height": 1.0}}, "there is no observation 'height'"),
        ({"bounds": lambda self: {"x": "far"}}, r"bounds\['x'\] must be a bound above 0 or \(low, high\)"),
        ({"bounds": lambda self: {"x": (2.0, 1.0)}}, r"bounds\['x'\] must be .* got \(2.0, 1.0\)"),
        ({"bounds": lambda self: {"x": ("a", "b")}}, r"bounds\['x'\] must be .* got \('a', 'b'\)"),
        ({"bounds": lambda self: {"x": math.nan}}, r"^Mistaken.bounds\['x'\] must be .* got nan"),
        ({"bounds": lambda self: {"x": (math.nan, 1.0)}}, r"bounds\['x'\] must be .* got \(nan, 1.0\)"),
        ({"bounds": lambda self: {"x": np.ones(2)}}, r"bounds\['x'\] must be .* got array"),
        ({"bounds": lambda self: None}, "^Mistaken.bounds returns None; it must return bounds by name"),
        ({"bounds": lambda self: [1.0, 2.0]}, "bounds returns a list; it must return bounds by name"),
        ({"start": {"x": [0.0, 0.5]}}, r"start\['x'\] must be a half width or \(centre, .* got \[0.0, 0.5\]"),
        ({"start": {"x": (0.0, -0.5)}}, r"start\['x'\]: a half width must not be negative"),
        ({"target": {"x_goal": ("m", -1.0)}}, r"target\['x_goal'\]: a half width must not be negative"),
        ({"defaults": {"load_mas": 1.0}}, "Mistaken.defaults: .*'load_mas'; did you mean load_mass?"),
        ({"usable": {"load_mas": (0.0, 1.0)}}, "Mistaken.usable: .*'load_mas'; did you mean load_mass?"),
        (
            {"usable": {"load_mass": (1.0, 0.1)}},
            r"usable\['load_mass'\] must be .*, in this order, got \(1.0, 0.1",
        ),
        (
            {"interval": 0.0},
            "Mistaken.interval must lie between 1e-6 and 1 s, got 0 s; .* another unit of time",
        ),
        (
            {"steps": 0},
            r"duration \(Mistaken.steps \* Mistaken.interval\) must be at least dt=0.05 s, got 0 s",
        ),
        ({"interval": "short"}, "Mistaken.interval must be a real number"),
        ({"steps": 50.5}, "Mistaken.steps must be a whole number, or infinity for no end, got 50.5"),
        ({"draws": 1.5}, "Mistaken.draws must be a whole number, 0 or more, got 1.5"),
        ({"kick": Task.kick}, "Mistaken.draws is 2, but there is no kick"),
        ({"kick": lambda self, after, draws, xp: None}, "kick returns None; it must return changes"),
        ({"guard": lambda self, *_: {"pull": None}}, "guard returns None; it must return numbers"),
        ({"guard": lambda self, *_: {"pull": math.nan}}, r"Mistaken.guard\['pull'\] must be finite, got nan"),
        (
            {"guard": lambda self, wanted, before, *_: before},
            "guard must return controls by name, got <entry",
        ),
        (
            {"observe": lambda self, after, target, xp: {"x": "y1"}},
            "observe returns 'y1'; it must return num",
        ),
        (
            {"observe": lambda self, after, *_: {"x": after.x, "top": math.inf}, "bounds": Task.bounds},
            r"^Mistaken.observe\['top'\] must be finite, got inf",
        ),
        ({"observe": lambda *_: {"x": 10**400}}, r"Mistaken.observe\['x'\] must be finite, got 1000"),
        (
            {"reward": lambda self, b, after, control, *_: control},
            "reward returns <controls push, pull>; it must return a number; .* as in control.NAME",
        ),
        (
            {"last_reward": lambda self, b, after, *_: after},
            "last_reward returns <entry of the states x, x_dot",
        ),
        ({"reward": lambda self, b, after, control, *_: -(control**2)}, "take the numbers one by one"),
        ({"kick": lambda self, after, draws, xp: {"x": draws}}, "kick returns <random draws 0, 1>; it must"),
        (
            {"reward": lambda self, b, after, *_: np.array([after.x])},
            "reward returns an array; it must return a number",
        ),
        (
            {"reward": lambda self, after, before, control, target, dt, xp: after.x - before.x},
            r"reward must be reward\(self, before, after, .* got \(self, after, before, ",
        ),
        (
            {"reward": lambda self, *_: np.random.default_rng().random()},
            "another result when it is run again",
        ),
        (
            {"reward": lambda self, b, after, *_: after.x - self.__dict__.setdefault("last", after.x)},
            "reward: it assigns to self.last, .* `before` in a reward",
        ),
        ({"terminated": lambda self, after, target, xp: after.x}, "returns a number; it must return a truth"),
        ({"terminated": lambda self, after, target, xp: None}, "returns None; it must return a truth value"),
        ({"terminated": lambda self, after, target, xp: after.x & (after.x > 0)}, "take comparisons"),
        (
            {"terminated": lambda self, after, *_: after.x > 1 | after.x_dot},
            r"terminated: &, .* in parentheses",
        ),
        ({"reward": lambda self, b, after, *a: a[-1].where(after.x, 1.0, 0.0)}, "take comparisons"),
        ({"reward": lambda self, b, after, *_: (after.x > 0) + (b.x > 0)}, "applied to comparisons alone"),
        (
            {"reward": lambda self, b, after, *_: self.scene.energy([*after])["total"]},
            "reward: a formula calls something .* self.scene.kinetic and self.scene.potential",
        ),
        ({"imperfections": {"lag": -1.0}}, "^Mistaken.imperfections: lag must be 0 or at least .* got -1 s"),
        ({"observe": lambda self, after, *_: np.ones(2)}, "numbers by name, .* got a ndarray"),
        ({"observe": lambda self, after, *_: {0: after.x}}, "observe: names must be texts, got 0"),
        ({"target": {1: ("m", 0.1)}}, "Mistaken.target: 1 is not a name"),
        ({"kick": lambda self, after, draws, xp: {"x": "1"}}, "kick returns '1'; it must return numbers"),
        ({"kick": lambda self, after, draws, xp: {"x": math.inf}}, r"kick\['x'\] must be finite, got inf"),
        ({"reward": lambda self, *_: 1j}, "reward returns 1j; it must return a number"),
        ({"reward": lambda self, *_: self.chance(-0.1)}, "chance takes a number from 0 to 1, got -0.1"),
        ({"reward": lambda self, *_: self.chance(self.scene.load_mass)}, "chance takes a number from 0 to 1"),
        ({"limit": 2.4}, "Mistaken.limit hides an attribute of every task; choose another name"),
        ({"fixed_target": 2.4}, "Mistaken.fixed_target hides an attribute of every task"),
        ({"goal": 1.0}, "Mistaken.goal must be a record.Goal, got 1.0; choose another name for a number"),
        ({"reference": 1.0}, "Mistaken.reference must be text, got 1.0"),
        ({"dt": 0.5}, r"Mistaken.dt is a keyword of environments; in a class, write interval \[s\]"),
        ({"duration": 0.5}, "Mistaken.duration is a keyword of environments; in a class, write steps"),
        ({"bounds": {"x": 1.0}}, r"Mistaken.bounds must be a method, bounds\(self\), got {'x': 1.0}"),
        ({"check": 1}, r"Mistaken.check must be a method, check\(self\), got 1"),
        ({"defaults": ["m"]}, r"Mistaken.defaults must map names to values, as a dict does, got \['m'\]"),
        ({"imperfections": None}, "Mistaken.imperfections must map names to values, .* got None"),
        ({"controllers": {"a": 1}}, r"Mistaken.controllers must map names to Controller.*, got 1 for 'a'"),
        (
            {"quantities": {"x": "m"}},
            r"Mistaken.quantities must map names to \(unit, meaning\), got 'm' for 'x'",
        ),
        ({"draws": -1}, "Mistaken.draws must be a whole number, 0 or more, got -1"),
        ({"reward": lambda self, b, after, *_: int(after.x)}, r"no int\(\), .* write xp.floor\(x\)"),
        (
            {"target": {}, "observe": lambda self, after, target, xp: {"x": target.x_goal}},
            "no target 'x_goal', nor any other",
        ),
    ],
)
def test_mistakes_in_a_task(changes, message):
    with pytest.raises((FormulaError, ValueError), match=message):
        mistaken(**changes)().formulas.box()


class Pushed(Bead):
    """A bead on a rail that is pushed at a given rate: its state holds w."""

    prescribed = {"s": "m"}
    controls = {"s_dot": "m/s"}

    def kinetic(self, q, v, xp):
        return 0.5 * (v.x + v.s) ** 2


class Hidden(Scene):
    """A scene whose coordinate has the name of the velocities."""

    coordinates = {"v": "m"}
    controls = {"f": "N"}

    def kinetic(self, q, v, xp):
        return 0.5 * v.v**2

    def potential(self, q, xp):
        return 0.0

    def applied(self, q, v, u, xp):
        return {"v": u.f}


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (
            Pushed,
            "Energetic.reward: there is no velocity of a coordinate 'x', nor any other; the state holds w "
            "instead, because velocities jump with s_dot; write the formula with w",
        ),
        (Hidden, "Energetic.reward: after.v is the place of the coordinate 'v', which hides the velocities"),
    ],
)
def test_velocities_that_a_task_cannot_have(scene, message):
    class Energetic(Task):
        action = {next(iter(scene.controls)): 1.0}

        def observe(self, after, target, xp):
            return {"first": after[0]}

        def reward(self, before, after, control, target, dt, xp):
            return self.scene.kinetic(after, after.v, xp)

    Energetic.scene = scene
    with pytest.raises(FormulaError, match=message):
        Energetic()


def test_a_state_is_not_taken_for_velocities():
    def energy(self, before, after, control, target, dt, xp):
        return self.scene.kinetic(after, after, xp)

    def loss(self, before, after, control, target, dt, xp):
        return self.scene.dissipation(before, v=before, u=control, xp=xp)

    def force(self, before, after, control, target, dt, xp):
        return self.scene.applied(before, before, control, xp)["x"]

    def swapped(self, before, after, control, target, dt, xp):
        return self.scene.kinetic(after.v, after.q, xp)

    for name, reward, what in (
        ("kinetic", energy, "the state"),
        ("dissipation", loss, "the state"),
        ("applied", force, "the state"),
        ("kinetic", swapped, "places"),
    ):
        message = rf"Mistaken.reward: self.scene.{name} is given {what} .*; give after.v or before.v"
        with pytest.raises(FormulaError, match=message):
            mistaken(reward=reward)()


def test_a_check_of_starts_returns_nothing():
    class Checked(own_tasks.Deliver):
        def check_start(self, state):
            return state.x < 1.0

    with pytest.raises(
        FormulaError, match=r"check_start must raise a ValueError or return nothing, got True"
    ):
        LagrangianEnv(Checked).reset(options={"state": [0.0] * 6})


def test_a_task_without_a_scene():
    with pytest.raises(FormulaError, match=r"Sceneless\.scene must be a class derived from Scene, got None"):
        type("Sceneless", (Task,), {"action": {"push": 1.0}})()


def _keywords(*calls):
    every = [p for call in calls for p in inspect.signature(call).parameters.values()]
    return {p.name for p in every if p.kind is not inspect.Parameter.VAR_KEYWORD}


def test_a_field_of_a_scene_is_no_keyword_of_environments():
    names = _keywords(LagrangianEnv, LagrangianVectorEnv, gym.make, gym.make_vec, Task)
    for name in sorted(names | {*KEYWORDS}):
        fields = {"__annotations__": {name: "float"}, name: parameter(2.0, "N/m", above=0.0)}
        scene = type("Motor", (CartPole,), {"__module__": __name__, **fields})
        assert getattr(scene(), name) == 2.0  # a scene that is only simulated may have it
        with pytest.raises(FormulaError, match=f"Mistaken.scene: the field '{name}' of Motor .* rename the"):
            mistaken(scene=scene)()


def test_a_kick_states_how_many_numbers_it_draws():
    class Silent(pivoted_bar.SwingUp):
        id = "OwnSilent-v0"

        def kick(self, after, draws, xp):
            return {"theta_dot": draws[0]}

    with pytest.raises(FormulaError, match=r"Silent.kick is defined, but not how many .* write draws = 1"):
        Silent()
    assert type("Off", (Silent,), {"draws": 0})().draws == 0
    assert type("On", (Silent,), {"draws": 1})().draws == 1


def test_misspelt_names_are_noticed():
    with pytest.warns(UserWarning, match=r"nothing uses Mistaken.terminate; did you mean terminated?"):
        mistaken(terminate=lambda self, after, target, xp: after.x > 1.0)()
    with pytest.warns(UserWarning, match=r"nothing uses Mistaken.slew; write imperfections = {'slew': ...}"):
        mistaken(slew=3.0)()
    with pytest.warns(UserWarning, match="Mistaken.load_mass does not change .* {'load_mass'"):
        mistaken(load_mass=3.0)()
    with pytest.warns(UserWarning, match=r"nothing uses Mistaken.action_space; write action"):
        mistaken(action_space=gym.spaces.Box(-1.0, 1.0))()
    with pytest.warns(UserWarning, match=r"nothing uses Mistaken.last_reward: without terminated, no step"):
        mistaken(terminated=Task.terminated, last_reward=lambda self, before, after, *_: -1.0)()
    with pytest.warns(UserWarning, match=r"nothing uses Sticky.disipation; did you mean dissipation?"):
        type("Sticky", (own_tasks.Crane,), {"disipation": lambda self, q, v, u, xp: v.x**2})()
    # A name that a formula uses is the user's own business.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mistaken(rewards=2.0, reward=lambda self, before, after, *_: self.rewards * after.x)()


def test_what_cannot_be_registered_is_named():
    with pytest.raises(ValueError, match="Crane is a Scene; register a Task whose scene it is"):
        lag_envs.register(own_tasks.Crane)
    with pytest.raises(ValueError, match='Blank has no id; write id = "Blank-v0" into the class'):
        lag_envs.register(type("Blank", (own_tasks.Deliver,), {"id": ""}))
    with pytest.raises(ValueError, match="register takes a task's class, or 'module:Class', got <"):
        lag_envs.register(own_tasks.Deliver())


@pytest.mark.parametrize("make", [LagrangianEnv, partial(LagrangianVectorEnv, num_envs=2)])
@pytest.mark.parametrize("place", ["own_tasks:Crane", "own_tasks:TASKS", "math:sin", own_tasks.Crane])
def test_a_place_that_leads_to_no_task(make, place):
    with pytest.raises(ValueError, match=r"task must be or lead to a class derived from Task, got [<(]"):
        make(place)


def test_a_task_is_no_dataclass():
    """The decorator would replace how tasks are made."""
    decorated = dataclasses.dataclass(type("Decorated", (own_tasks.Deliver,), {}))
    with pytest.raises(FormulaError, match="Decorated must not be a dataclass: tasks are written without"):
        decorated()


def test_an_own_init_that_does_not_call_that_of_tasks():
    class Bare(own_tasks.Deliver):
        id = ""

        def __init__(self, bonus=1.0):
            self.bonus = bonus

    for made in (Bare, partial(LagrangianEnv, Bare)):
        with pytest.raises(FormulaError, match=r"Bare.__init__ must call super\(\).__init__\(\*\*keywords\)"):
            made(bonus=2.0)
    assert list(inspect.signature(Bare).parameters) == ["bonus"]
