"""The page's step against Python's, bit for bit."""

import pytest
from covering import slow
from driven import Six, at_random, by_agent
from driving import (
    bare_pages,  # noqa: F401
    check_bits,
)
from own_tasks import TASKS as OWN

from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.site.build import write_page
from lag_envs.leaderboard.site.driving import fuller, sliders
from lag_envs.tasks import TASKS, incline
from tests import board_pages

pytestmark = pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")


@pytest.fixture
def alone(tmp_path, id):
    """A folder with the page of an environment, without agents."""
    write_page(board_pages.data((id,), agents=()), tmp_path)
    return tmp_path


@pytest.mark.parametrize("id", TASKS)
def test_the_pages_step_has_pythons_bits(browsing, alone, id):
    task = TASKS[id]()
    page = browsing.open(f"{alone.as_uri()}/{id}.html", alone.as_uri())
    check_bits(page, alone, task, id, [(7, at_random(task, 1)), (2**63 + 11, at_random(task, 2))], steps=200)


@pytest.mark.parametrize("kind", [OWN[0], *map(slow, [*OWN[1:], Six])], ids=lambda kind: kind.__name__)
def test_the_pages_step_has_pythons_bits_on_users_tasks_too(browsing, bare, kind):
    """Two controls, ranges, targets, kicks, choices, a last reward, chains, nothing that acts."""
    page = browsing.open(f"{bare.as_uri()}/{incline.Tilt.id}.html", bare.as_uri())
    task = kind()
    check_bits(page, bare, task, kind.id, [(seed, at_random(task, seed)) for seed in (3, 2**64 - 1)])


@pytest.mark.parametrize("id", [id for id in TASKS if fuller(TASKS[id])[0]])
def test_so_has_that_of_a_machine_with_more_to_it(browsing, alone, id):
    """With all sliders moved, also those of parameters that are 0."""
    page = browsing.open(f"{alone.as_uri()}/{id}.html", alone.as_uri())
    base, (full, _) = Unfused(TASKS[id]()), fuller(TASKS[id])
    changed = Unfused(full.task, full.program)
    changed.constants[:] = base.constants
    moved = [(one["at"], one.get("most", 1.2 * one["value"])) for one in sliders(TASKS[id], base)]
    for at, value in moved:
        changed.constants[at] = value
    full.program.functions["derive"](changed.constants)
    (file,) = alone.glob("assets/*-fuller-*.js")
    episodes = [(7, at_random(full.task, 1)), (2**63 + 11, at_random(full.task, 2))]
    more = (f"assets/{file.name}", moved)
    check_bits(page, alone, full.task, id, episodes, steps=100, env=changed, more=more)


@pytest.mark.slow
@pytest.mark.parametrize("id", TASKS)
def test_all_bits_in_a_hundred_episodes(browsing, alone, id):
    task = TASKS[id]()
    page = browsing.open(f"{alone.as_uri()}/{id}.html", alone.as_uri())
    episodes = [(2**40 + i, at_random(task, i) if i % 2 else by_agent(task)) for i in range(100)]
    check_bits(page, alone, task, id, episodes)
