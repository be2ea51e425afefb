"""Pages that are driven in a browser: fixtures, what they show, and their bits."""

import json
import math
import struct

import numpy as np
import pytest
from browsers import until
from driven import Six
from later_policies import numbers
from own_tasks import TASKS as OWN

from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.policies import SubmittedPolicy, architecture
from lag_envs.leaderboard.site.build import write_page
from lag_envs.leaderboard.site.driving import agent, script_of
from lag_envs.tasks import cylinder_in_cylinder, incline, pivoted_bar
from tests import board_pages

#: Environments for the hand-written tests.
BARE = (
    pivoted_bar.SwingUp.id,
    pivoted_bar.Balance.id,
    incline.Tilt.id,
    incline.Brake.id,
    cylinder_in_cylinder.Tilt.id,
)
#: Plays actions in the page and returns the bits of all results.
ROLLOUT = """async ([program, code, episodes, fuller, changes = []]) => {
    const drive = await lagEnvs.load(program);
    const made = { ...(await lagEnvs.load(code)), ...(fuller && (await lagEnvs.load(fuller))) };
    const constants = Float64Array.from(made.constants);
    for (const [at, value] of changes) constants[at] = value;
    if (changes.length) made.functions.derive(constants);
    return episodes.map(([seed, actions]) => {
        const episode = new drive.Episode(made, BigInt(seed), constants);
        const all = () => [...episode.f].map(drive.hexOf).join();
        const told = [all()];
        for (const action of actions) {
            episode.step(action);
            const poses = episode.poses().flat().map(drive.hexOf);
            told.push(`${all()} ${drive.hexOf(episode.total)} ${episode.over} ${poses}`);
            if (episode.over) break;
        }
        return told;
    });
}"""


#: Keeps files from being loaded; the last is window.held.
HOLD = """() => {
    document.head.append = (script) => (window.held = script);
}"""


def hex_of(x):
    return struct.pack(">d", x).hex()


def rollout(task, seed, actions, env=None, steps=math.inf):
    """Return the result of `ROLLOUT`, and the actions; at most a number of steps."""
    env = env or Unfused(task)
    env.reset(seed)

    def everything():
        return ",".join(map(hex_of, env.numbers))

    told, total, over, used = [everything()], 0.0, False, []
    while not over and len(used) < steps:
        action = actions(env, len(used))
        _, reward, terminated, truncated = env.step(action)
        total += reward
        used.append(np.atleast_1d(action).tolist())
        over = terminated or truncated
        how = "terminated" if terminated else "truncated" if truncated else ""
        poses = ",".join(hex_of(x) for pose in env.poses() for x in pose)
        told.append(f"{everything()} {hex_of(total)} {how} {poses}")
    return told, used


@pytest.fixture(name="bare", scope="module")
def bare_pages(tmp_path_factory):
    """A folder with pages of environments, without agents, and the files that drive users' tasks."""
    folder = tmp_path_factory.mktemp("bare")
    write_page(board_pages.data(BARE, agents=()), folder)
    for task in (*OWN, Six):
        (folder / "assets" / f"{task.id}.js").write_text(script_of(task))
    return folder


def files(folder, name):
    (program,) = folder.glob("assets/drive-*.js")
    (code,) = [*folder.glob(f"assets/{name}-drive-*.js"), *folder.glob(f"assets/{name}.js")]
    return [f"assets/{program.name}", f"assets/{code.name}"]


def check_bits(page, folder, task, name, episodes, steps=math.inf, env=None, more=()):
    """Compare the page's episodes with Python's, for `episodes` of (seed, actions) of at most some steps.

    For a changed machine `env` is this machine, and `more` its file and its changed constants.
    """
    env = env or Unfused(task)
    for seed, actions in episodes:
        told, used = rollout(task, seed, actions, env, steps)
        (found,) = page.evaluate(ROLLOUT, [*files(folder, name), [[str(seed), used]], *more])
        assert found == told, next(
            (i, a, b) for i, (a, b) in enumerate(zip(found, told, strict=False)) if a != b
        )


LINEAR = (
    "linear",
    cylinder_in_cylinder.Tilt.id,
    {"architecture": "linear"},
    {"gain": [1.0, 0.5, -0.2, -0.7], "offset": [0.1]},
)


def made(id, table, arrays):
    arrays = numbers(id, table) if arrays is None else arrays
    return SubmittedPolicy(
        architecture(id, table), {name: np.asarray(x, np.float64) for name, x in arrays.items()}
    )


@pytest.fixture(name="haunted", scope="module")
def haunted_page(tmp_path_factory):
    """A page with an agent that runs live, and one that is recorded at a seed."""
    folder = tmp_path_factory.mktemp("haunted")
    data = board_pages.data((cylinder_in_cylinder.Tilt.id,), board_pages.AGENTS[:2])
    live, recorded = data["environments"][0]["rows"]
    live |= {"agent": agent(made(*LINEAR[1:]))}
    for replay_ in recorded["replays"]:
        replay_["reset_seed"] = 2**61 + 3
    data["environments"][0]["drives"] = [{"name": "Ada", "link": "#seed=4", "return": 1.0, "score": 0.5}]
    write_page(data, folder)
    return folder


def message(page):
    return page.text_content(".message")


def verdict(page):
    return page.text_content(".verdict")


def reading(page, name):
    return page.evaluate(readout(name))


def readout(name):
    """Return the expression for a text of the read-out; while one drives, of what stands for its picture."""
    return f"""[...document.querySelectorAll(
            document.querySelector('.stage[data-driving]') ? '.driver .values dt' : '.driver .readout dt')]
        .find((e) => e.textContent === {json.dumps(name)})?.nextSibling.textContent"""


def shows(page, name, wanted):
    """Wait until the read-out shows a text."""
    until(page, readout(name), lambda text: text == wanted)


@pytest.fixture(name="drive")
def driver_page(browsing, bare):
    """Open an environment's page and its driver.

    With `slowly` it plays at a tenth of the speed, so that no episode ends before a slow machine has acted.
    """

    def open_it(id=pivoted_bar.Balance.id, hash="", folder=bare, slowly=False, **options):
        page = browsing.open(f"{folder.as_uri()}/{id}.html{hash}", folder.as_uri(), **options)
        if not hash:
            page.click(".begin")
        until(
            page, "document.querySelector('.driver .stage') && document.querySelector('.message').textContent"
        )
        if slowly:
            page.select_option(".drive-controls select >> nth=0", "0.1")
        return page

    return open_it


def link_of(page):
    return until(page, "document.querySelector('.share input').value")
