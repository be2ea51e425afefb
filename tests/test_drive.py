"""Driving in the page: the page's step against Python's, bit for bit, and how it behaves in a browser."""

import struct

import numpy as np
import pytest
from own_tasks import TASKS as OWN

from lag_envs.controllers import build as make
from lag_envs.controllers import controllers
from lag_envs.envs.actions import Actions
from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.site.build import build
from lag_envs.leaderboard.site.driving import script_of
from lag_envs.tasks import TASKS
from tests import board_pages

pytestmark = pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")
#: Plays actions in the page and returns the bits of all that comes out.
ROLLOUT = """async ([program, code, episodes]) => {
    const drive = await lagEnvs.load(program);
    const made = await lagEnvs.load(code);
    return episodes.map(([seed, actions]) => {
        const episode = new drive.Episode(made, BigInt(seed));
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


def hex_of(x):
    return struct.pack(">d", x).hex()


def rollout(task, seed, actions, env=None):
    """Return what `ROLLOUT` does, and the actions that were used."""
    env = env or Unfused(task)
    env.reset(seed)

    def everything():
        return ",".join(map(hex_of, env.numbers))

    told, total, over, used = [everything()], 0.0, False, []
    while not over:
        action = actions(env, len(used))
        _, reward, terminated, truncated = env.step(action)
        total += reward
        used.append(np.atleast_1d(action).tolist())
        over = terminated or truncated
        how = "terminated" if terminated else "truncated" if truncated else ""
        poses = ",".join(hex_of(x) for pose in env.poses() for x in pose)
        told.append(f"{everything()} {hex_of(total)} {how} {poses}")
    return told, used


def at_random(task, seed):
    rng, formulas = np.random.default_rng(seed), task.formulas
    if formulas.choices:
        space = Actions(formulas.actions, formulas.choices).space
        space.seed(seed)
        return lambda env, i: space.sample()
    return lambda env, i: rng.uniform(-1.2, 1.2, formulas.actions).astype(np.float32)


def by_agent(task):
    """Return a controller of the task's own that plans nothing, by unfused observations."""
    names = [n for n, found in controllers(task).items() if not found.plans and n not in ("zero", "random")]
    if not names:
        return at_random(task, 99)
    made = make(task, names[-1])
    memory = {}

    def act(env, i):
        start = np.array([i == 0])
        action, memory["state"] = made.predict(
            np.array([env.observe()], np.float32), None if i == 0 else memory["state"], start
        )
        return action[0]

    return act


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A folder with a page for every environment, without agents, and the files that drive users' tasks."""
    folder = tmp_path_factory.mktemp("bare")
    build(board_pages.data(tuple(TASKS), agents=()), folder)
    for task in OWN:
        (folder / "assets" / f"{task.id}.js").write_text(script_of(task))
    return folder


def files(folder, name):
    (program,) = folder.glob("assets/drive-*.js")
    (code,) = [*folder.glob(f"assets/{name}-drive-*.js"), *folder.glob(f"assets/{name}.js")]
    return [f"assets/{program.name}", f"assets/{code.name}"]


def check_bits(page, folder, task, name, episodes):
    """Hold the page's episodes against Python's, `episodes` being (seed, actions) each."""
    env = Unfused(task)
    for seed, actions in episodes:
        told, used = rollout(task, seed, actions, env)
        (found,) = page.evaluate(ROLLOUT, [*files(folder, name), [[str(seed), used]]])
        assert found == told, next(
            (i, a, b) for i, (a, b) in enumerate(zip(found, told, strict=False)) if a != b
        )


@pytest.mark.parametrize("id", sorted(TASKS))
def test_the_pages_step_has_pythons_bits(browsing, bare, id):
    task = TASKS[id]()
    page = browsing.open(f"{bare.as_uri()}/{id}.html", bare.as_uri())
    check_bits(page, bare, task, id, [(7, at_random(task, 1)), (2**63 + 11, by_agent(task))])


@pytest.mark.parametrize("kind", OWN, ids=lambda kind: kind.__name__)
def test_so_it_has_on_users_tasks(browsing, bare, kind):
    """Two controls, ranges, targets, kicks, choices, a last reward, a chain, nothing that acts."""
    page = browsing.open(f"{bare.as_uri()}/InclineTilt-v0.html", bare.as_uri())
    task = kind()
    check_bits(page, bare, task, kind.id, [(seed, at_random(task, seed)) for seed in (3, 2**64 - 1)])


@pytest.mark.slow
@pytest.mark.parametrize("id", sorted(TASKS))
def test_all_bits_in_a_hundred_episodes(browsing, bare, id):
    task = TASKS[id]()
    page = browsing.open(f"{bare.as_uri()}/{id}.html", bare.as_uri())
    check_bits(
        page,
        bare,
        task,
        id,
        [(2**40 + i, at_random(task, i) if i % 2 else by_agent(task)) for i in range(100)],
    )
