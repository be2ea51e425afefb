"""Agents in the page: they act as in Python, and drive as ghosts."""

from itertools import pairwise

import numpy as np
import pytest
from browsers import serious, until
from covering import size
from driven import at_random
from driving import (
    HOLD,
    LINEAR,
    bare_pages,  # noqa: F401
    check_bits,
    driver_page,  # noqa: F401
    files,
    haunted_page,  # noqa: F401
    link_of,
    made,
    message,
    reading,
    readout,
    shows,
)
from later_policies import EVERY as LATER
from later_policies import LISTED, LISTS, TwoLists
from later_policies import OWN as LATER_TASKS
from own_tasks import TASKS as OWN
from own_tasks import Switched

from lag_envs import register, replay
from lag_envs.controllers import controllers
from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.policies import SubmittedPolicy, architecture
from lag_envs.leaderboard.site.build import write_page
from lag_envs.leaderboard.site.driving import agent, script_of
from lag_envs.tasks import TASKS, cylinder_in_cylinder, incline, pendulum, pivoted_bar

pytestmark = pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")


def policies():
    """Yield a policy of every kind of schema 1 that runs in the page: name, environment, table and arrays."""
    rng = np.random.default_rng(0)
    bar, tilt = pivoted_bar.SwingUpFree.id, cylinder_in_cylinder.Tilt.id
    wide = pendulum.PendulumExact.id

    def layers(*widths):
        found = {}
        for k, (a, b) in enumerate(pairwise(widths)):
            found |= {f"weight_{k}": rng.normal(size=(b, a)), f"bias_{k}": rng.normal(size=b)}
        return found

    for activation in ("tanh", "relu", "elu", "leaky_relu", "silu", "sigmoid"):
        table = {"architecture": "mlp", "hidden": [5, 4], "activation": activation, "squash": "tanh"}
        yield activation, bar, table, layers(3, 5, 4, 1)
    table = {"architecture": "mlp", "hidden": [], "squash": "tanh"}
    yield "actions up to two", wide, table, layers(3, 1)
    normal = {"obs_mean": rng.normal(size=3), "obs_var": rng.random(3)}
    table = {
        "architecture": "mlp",
        "hidden": [6],
        "squash": "clip",
        "mean_limit": 0.4,
        "normalise": {"clip": 1.5},
    }
    yield "normalised", bar, table, layers(3, 6, 1) | normal
    table = {"architecture": "mlp", "hidden": [3], "squash": "tanh"}
    yield "what is noisy and late", pivoted_bar.SwingUpUnknown.id, table, layers(5, 3, 1)
    yield "bins", bar, {"architecture": "mlp", "hidden": [6], "bins": 7}, layers(3, 6, 7)
    yield LINEAR
    axes = {"axis_0": np.linspace(-3, 3, 9), "axis_1": np.linspace(-8, 8, 7)}
    table = {"architecture": "table", "axes": ["theta", "theta_dot"], "kind": "action", "mirror": "theta_dot"}
    yield "actions", bar, table, axes | {"table": rng.uniform(-1, 1, (9, 7))}
    axes = {
        "axis_0": np.linspace(-0.6, 0.6, 9),
        "axis_1": np.linspace(0, 2, 4),
        "axis_2": np.linspace(-1, 1, 5),
    }
    table = {"architecture": "table", "axes": ["theta - target", "time", "theta_dot"], "kind": "value"}
    yield "values", tilt, table, axes | {"table": rng.normal(size=(9, 4, 5))}
    axes = {"axis_0": np.linspace(2, 4, 9), "axis_1": np.linspace(-8, 8, 7)}
    table = {"architecture": "table", "axes": ["theta_1", "theta_1_dot"], "kind": "value"}
    yield "values, from a list", Switched.id, table, axes | {"table": rng.normal(size=(9, 7))}


#: Controllers that are feedback, and so run in the page.
FEEDBACK = (
    "basic:constant",
    "basic:feedback",
    "linear:BalanceLQR",
    "linear:Regulator",
    "tracking:hold",
    "tracking:recorded",
)


def feedback():
    """Yield a controller of every kind that is feedback, on the smallest environment that has it."""
    found = {}
    for id in sorted(TASKS, key=lambda id: size(TASKS[id])):
        for name, controller in controllers(TASKS[id]).items():
            kind = controller.place.removeprefix("lag_envs.controllers."), bool(TASKS[id]().formulas.choices)
            if kind[0] in FEEDBACK and kind not in found:
                found[kind] = f"{id}, {name}", id, {"architecture": "controller", "name": name}, {}
    return found.values()


POLICIES = [*policies(), *((f"{id}: {table}", id, table, None) for id, table in LATER), *feedback()]


def covering_architectures():
    """Yield all policies; all but the first of each architecture are slow, as are those of listed actions."""
    seen = set()
    for name, id, table, arrays in POLICIES:
        kind = table["architecture"], id in (LISTED, LISTS)
        yield pytest.param(name, id, table, arrays, id=name, marks=[pytest.mark.slow] * (kind in seen))
        seen.add(kind)


@pytest.mark.parametrize("name, id, table, arrays", list(covering_architectures()))
def test_agents_act_in_the_page_as_in_python(browsing, bare, monkeypatch, name, id, table, arrays):
    for kind in (*OWN, *LATER_TASKS):
        monkeypatch.setitem(TASKS.data, kind.id, kind)
    policy, task = made(id, table, arrays), TASKS[id]()
    program, code = files(bare, incline.Tilt.id)[0], f"assets/{id}-alone.js"
    (bare / code).write_text(script_of(type(task)))
    page = browsing.open(f"{bare.as_uri()}/{incline.Tilt.id}.html", bare.as_uri())
    actions = page.evaluate(
        """async ([program, code, about]) => {
            const drive = await lagEnvs.load(program);
            const episode = new drive.Episode(await lagEnvs.load(code), 5);
            const act = drive.agentOf(about);
            return Array.from({ length: 60 }, () => {
                const action = act(episode);
                episode.step(action);
                return [...action];
            });
        }""",
        [program, code, agent(policy)],
    )
    env, python, memory = Unfused(task), policy.agent(), None
    env.reset(5)
    off = []
    for i, action in enumerate(actions):
        seen = np.array([env.observe()], np.float32)
        wanted, memory = python.predict(seen, memory, np.array([i == 0]))
        off.append(np.abs(wanted[0] - action).max())
        env.step(np.reshape(action, wanted[0].shape).astype(wanted.dtype))
    # If two actions are worth the same to rounding, either may be chosen.
    assert np.mean(np.array(off) < 2e-5) >= (0.9 if name == "values" else 1.0), max(off)


@pytest.mark.parametrize("name", ["random", "energy shaping + LQR", "iLQR"])
def test_others_run_in_python_only(name):
    table = {"architecture": "controller", "name": name}
    assert agent(SubmittedPolicy(architecture("PivotedBar-v0", table), {})) is None


def test_ghosts_run_beside(drive, haunted):
    page = drive(cylinder_in_cylinder.Tilt.id, folder=haunted)
    ghosts = ".drive-controls select >> nth=1"
    page.select_option(ghosts, "live:0")
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, readout("Time"), lambda text: (text or "") > "0.3")
    assert reading(page, "Ghost's return") not in (None, "–")
    page.select_option(ghosts, "stored:1")
    until(page, "!document.querySelectorAll('.drive-controls label')[2].hidden")
    until(page, "document.querySelector('.go').textContent === 'Start'")
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, f"location.hash === '#seed={2**61 + 3}'")
    page.keyboard.press("Space")
    page.click(".sliders summary")
    page.focus(".sliders input >> nth=0")
    page.keyboard.press("ArrowRight")
    assert message(page).endswith("The recorded ghost drives the unchanged one.")
    page.click(".drives a")
    until(page, "location.hash === '#seed=4'")
    until(page, "document.activeElement.className === 'stage'")
    assert page.evaluate("document.querySelectorAll('.drive-controls select')[1].value") == ""


def test_a_ghost_that_comes_late_or_never(drive, haunted):
    """Choosing one pauses the drive; nothing starts before it is there."""
    page = drive(cylinder_in_cylinder.Tilt.id, folder=haunted, slowly=True)
    page.evaluate(HOLD)
    page.focus(".stage")
    page.keyboard.down("ArrowRight")
    until(page, readout("Time"), lambda text: (text or "") > "0.1")
    page.select_option(".drive-controls select >> nth=1", "live:0")
    assert message(page) == "Loading the ghost …"
    assert page.text_content(".go") == "Resume" and page.evaluate("document.querySelector('.go').disabled")
    assert link_of(page)
    page.keyboard.press("Space")
    assert page.text_content(".go") == "Resume"
    page.evaluate("window.held.dispatchEvent(new Event('error'))")
    until(page, "document.querySelector('.message').textContent.startsWith('The ghost could not be loaded')")
    assert page.evaluate("document.querySelectorAll('.drive-controls select')[1].value") == ""
    page.click(".go")
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    page.select_option(".drive-controls select >> nth=1", "live:0")
    page.evaluate("document.documentElement.append(window.held)")
    until(page, "document.querySelector('.message').textContent.includes('starts')")
    assert page.text_content(".go") == "Start" and reading(page, "Time") == "0.00 s"
    assert reading(page, "Ghost's return") == "0.00"


class Everything(TwoLists):
    """Two controls from lists, noise, hidden parameters, a delay."""

    id = "Everything-v0"
    imperfections = {
        "randomize": {"mass_2": (0.5, 2.0)},
        "observation_noise": 0.02,
        "action_delay": 0.02,
    }


def test_one_record_with_everything(drive, monkeypatch, tmp_path):
    """A page needs only its record: two lists of actions, noise, hidden parameters, a delay, a memory."""
    monkeypatch.setitem(TASKS.data, Everything.id, Everything)
    register(Everything)
    remembers = made(Everything.id, {"architecture": "gru", "memory": 5}, None)
    board = {"id": Everything.id, "rows": [{"name": "Remembers", "agent": agent(remembers)}]}
    write_page({"protocol": 1, "made": "today", "environments": [board]}, tmp_path)
    page = drive(Everything.id, folder=tmp_path, bypass_csp=True)
    task = Everything()
    check_bits(page, tmp_path, task, Everything.id, [(seed, at_random(task, seed)) for seed in (3, 2**63)])
    assert "1 to 3 for the action with that number in each list" in message(page)
    page.select_option(".drive-controls select >> nth=1", "live:0")
    page.focus(".stage")
    page.keyboard.press("Space")
    page.keyboard.down("3")
    shows(page, "shoulder", "5.00 N m")
    page.keyboard.up("3")
    until(page, "document.querySelector('.message').textContent.startsWith('Time is up')")
    assert float(reading(page, "Ghost's return").replace("−", "-"))
    found = replay.replay(replay.read_link(link_of(page)))
    assert found.true and found.finished
    assert serious(page) == []
    page.set_viewport_size({"width": 320, "height": 700})
    assert page.evaluate("document.documentElement.scrollWidth") == 320
