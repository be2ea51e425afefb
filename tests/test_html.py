"""The HTML of scenes and environments in a notebook: complete, escaped, and self-contained."""

import re
from html import unescape
from html.parser import HTMLParser

import gymnasium as gym
import numpy as np
import pytest
from covering import covering

from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes import SCENES, Scene, html, parameter
from lag_envs.tasks import incline


class Checked(HTMLParser):
    """Notes a text's elements, and fails if elements are not closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text = [], set(), ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        for name, value in attributes:
            assert name not in ("href",) and (name != "src" or value.startswith("data:image/png;base64,"))
        if tag not in ("br", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("kind", SCENES)
def test_scenes_show_parameters_and_equations(kind):
    scene = kind()
    shown = Checked(scene._repr_html_())
    assert "math" in shown.tags and "script" not in shown.tags
    for name in (*scene.state_names, *scene.control_names, *parameter_names(scene)):
        assert name in shown.text, name
    assert "mover" in shown.tags  # rates have dots


def test_equations_are_those_of_the_scene():
    class Swing(Scene):
        """A bob <on> a rod."""

        mass: float = parameter(1.0, "kg", above=0.0)
        length: float = parameter(1.0, "m", above=0.0)
        coordinates = {"theta": "rad"}
        controls = {"torque": "N m"}

        def kinetic(self, q, v, xp):
            # Written such that a square of a sine has to be eliminated.
            return (
                0.5 * self.mass * self.length**2 * v.theta**2 * (xp.cos(q.theta) ** 2 + xp.sin(q.theta) ** 2)
            )

        def potential(self, q, xp):
            return -9.81 * self.mass * self.length * xp.cos(q.theta)

        def applied(self, q, v, u, xp):
            return {"theta": u.torque}

    text = Swing()._repr_html_()
    assert "A bob &lt;on&gt; a rod." in text
    equation = re.sub(r"<[^>]*>", " ", unescape(text.rpartition("Equations of motion")[2])).split()
    assert equation.count("θ") == 2 and equation.count("¨") == 1 and equation.count("˙") == 0
    assert {"torque", "mass", "length", "sin", "981"} <= set(equation) and equation[-2:] == ["=", "0"]


def test_formulas_of_a_notebook():
    """Terms wrap; a rate's index and exponent are beside one dotted letter; only short parts are indices."""
    import sympy

    from lag_envs.scenes.symbolic import t

    rest, mass = sympy.symbols("rest_length mass_12")
    rate = sympy.Function("theta_1")(t).diff(t)
    text = html.mathml(rest * rate**2 - mass, " = 0")
    assert text.count("<math ") == 2 and '<mo form="infix">' in text
    assert "<mi>rest_length</mi>" in text and "<msub><mi>mass</mi><mn>12</mn></msub>" in text
    dotted = f"{html.LOW}<mover><mi>θ</mi><mo>˙</mo></mover></mpadded>"
    assert f"<msubsup>{dotted}<mn>1</mn><mn>2</mn></msubsup>" in text


@pytest.mark.parametrize("formula", ["exp(x)", "pi*x", "exp(-x**2/alpha_1)", "exp(1)*x", "sqrt(pi)*x**3"])
def test_formulas_with_pi_and_e(formula):
    """SymPy's MathML has entities for them, which only browsers know."""
    import sympy

    text = html.mathml(sympy.sympify(formula), " = 0")
    assert ("<mi>π</mi>" if "pi" in formula else "<mi>e</mi>") in text


@pytest.mark.parametrize("name", ["sin", "cos", "tan", "atan", "tanh", "sqrt", "exp", "log"])
def test_every_function_is_shown(name):
    class Curved(Scene):
        stiffness: float = parameter(1.0, "N", above=0.0)
        coordinates = {"x": "m"}

        def kinetic(self, q, v, xp):
            return v.x**2 / 2

        def potential(self, q, xp):
            return self.stiffness * xp.pi * getattr(xp, name)(2 + q.x) ** 2

    shown = Checked(Curved()._repr_html_())
    assert "π" in shown.text and "Equations of motion" in shown.text
    assert "Curved(" not in shown.text  # the signature, which a class without a docstring gets as one


def test_without_sympy_the_rest_is_shown(monkeypatch):
    monkeypatch.setattr(html, "find_spec", lambda name: None)
    shown = Checked(SCENES[0]()._repr_html_())
    assert 'pip install "lag-envs[symbolic]"' in shown.text and "mass" in shown.text


def test_long_equations_are_left_out():
    from lag_envs.scenes import Chain

    assert "equations of motion are long" in Chain(bars=4)._repr_html_()


@pytest.mark.parametrize("env_id", covering())
def test_environments_show_picture_and_spaces(env_id):
    env = gym.make(env_id).unwrapped
    before = env._repr_html_()
    env.reset(seed=1)
    for _ in range(5):
        env.step(env.action_space.sample())
    state = env.state
    shown = Checked(env._repr_html_())
    assert np.array_equal(env.state, state) and env._viewer is None and env._repr_html_() != before
    assert "img" in shown.tags and env_id in shown.text and str(env.action_space) in shown.text
    for name in (*env.task.observation, *env.scene.control_names, *parameter_names(env.scene)):
        assert name in shown.text


def test_environments_have_a_text():
    made = gym.make(incline.Tilt.id, mass=2.0, observation_noise=0.1)
    assert repr(made.unwrapped) == f"LagrangianEnv({incline.Tilt.id}, mass=2.0, observation_noise=0.1)"
    assert repr(type(made.unwrapped)("lag_envs.tasks.incline:Tilt")) == "LagrangianEnv(Tilt)"


def test_batches_show_a_grid():
    envs = gym.make_vec(incline.Tilt.id, 20)
    assert f"{incline.Tilt.id} × 20 (the first 9 are shown)" in Checked(envs._repr_html_()).text
    envs.reset(seed=1)
    assert 'width="600"' in envs._repr_html_() and len(envs._repr_html_()) < 100_000


def test_what_draws_nothing_shows_the_rest():
    import own_tasks

    from lag_envs import register

    class Bare(own_tasks.Drift):
        id = "Bare-v0"

        def bodies(self):
            return {}

    register(Bare)
    shown = Checked(gym.make("Bare-v0").unwrapped._repr_html_())
    assert "img" not in shown.tags and "Bare-v0" in shown.text
    assert "img" not in Checked(gym.make_vec("Bare-v0", 2)._repr_html_()).tags
