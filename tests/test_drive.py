"""Driving in the page: the page's step against Python's, bit for bit, and its behaviour in a browser."""

import json
import math
import struct
import time
from itertools import pairwise

import numpy as np
import pytest
from browsers import serious, until
from covering import covering, size, slow
from driven import Six, at_random, by_agent
from own_tasks import TASKS as OWN
from own_tasks import Switched
from test_policies import EVERY as LATER
from test_policies import LISTED, LISTS, TwoLists, numbers
from test_policies import OWN as LATER_TASKS

from lag_envs import cli, register, replay
from lag_envs.controllers import controllers
from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.policies import SubmittedPolicy, architecture
from lag_envs.leaderboard.site.build import write_page
from lag_envs.leaderboard.site.driving import agent, script_of, sliders
from lag_envs.tasks import TASKS, acrobot, chain, cylinder_in_cylinder, incline, pendulum, pivoted_bar
from tests import board_pages

pytestmark = pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")
#: Environments for the hand-written tests.
BARE = (
    pivoted_bar.SwingUp.id,
    pivoted_bar.Balance.id,
    incline.Tilt.id,
    incline.Brake.id,
    cylinder_in_cylinder.Tilt.id,
)
#: Plays actions in the page and returns the bits of all results.
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


@pytest.fixture
def alone(tmp_path, id):
    """A folder with the page of an environment, without agents."""
    write_page(board_pages.data((id,), agents=()), tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
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


def check_bits(page, folder, task, name, episodes, steps=math.inf):
    """Compare the page's episodes with Python's, for `episodes` of (seed, actions) of at most some steps."""
    env = Unfused(task)
    for seed, actions in episodes:
        told, used = rollout(task, seed, actions, env, steps)
        (found,) = page.evaluate(ROLLOUT, [*files(folder, name), [[str(seed), used]]])
        assert found == told, next(
            (i, a, b) for i, (a, b) in enumerate(zip(found, told, strict=False)) if a != b
        )


@pytest.mark.parametrize("id", covering(TASKS))
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


@pytest.mark.slow
@pytest.mark.parametrize("id", TASKS)
def test_all_bits_in_a_hundred_episodes(browsing, alone, id):
    task = TASKS[id]()
    page = browsing.open(f"{alone.as_uri()}/{id}.html", alone.as_uri())
    episodes = [(2**40 + i, at_random(task, i) if i % 2 else by_agent(task)) for i in range(100)]
    check_bits(page, alone, task, id, episodes)


# --- a person at the page -----------------------------------------------------------------------------------


def message(page):
    return page.text_content(".message")


def verdict(page):
    return page.text_content(".verdict")


def reading(page, name):
    return page.evaluate(
        "(name) => [...document.querySelectorAll('.driver .readout dt')]"
        ".find((e) => e.textContent === name)?.nextSibling.textContent",
        name,
    )


def shows(page, name, wanted):
    """Wait until the read-out shows a text."""
    end = time.monotonic() + 20.0
    while reading(page, name) != wanted:
        assert time.monotonic() < end, (name, reading(page, name), wanted)
        page.wait_for_timeout(20)


@pytest.fixture
def drive(browsing, bare):
    """Open an environment's page, and its driver."""

    def open_it(id=pivoted_bar.Balance.id, hash="", folder=bare, **options):
        page = browsing.open(f"{folder.as_uri()}/{id}.html{hash}", folder.as_uri(), **options)
        if not hash:
            page.click(".begin")
        until(
            page, "document.querySelector('.driver .stage') && document.querySelector('.message').textContent"
        )
        return page

    return open_it


def link_of(page):
    return until(page, "document.querySelector('.share input').value")


def test_by_keys_alone(drive, capsys):
    """Tab, arrows, Space, R and N; the command confirms the drive."""
    page = drive(incline.Tilt.id, hash="#seed=12")
    told = message(page)
    assert "← → rate of the tilt φ\u0307 [rad/s]" in told and "Space or a tap starts" in told
    page.focus("main")
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.className") == "stage":
            break
    assert page.evaluate("document.activeElement.getAttribute('role')") == "application"
    page.keyboard.down("ArrowRight")
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    page.wait_for_timeout(300)
    page.keyboard.up("ArrowRight")
    page.keyboard.press("Space")
    assert message(page).startswith("Paused at 0.")
    assert reading(page, "Score") == "at the end"
    held = link_of(page)
    assert replay.read_link(held).seed == 12
    assert cli.main(["replay", held]) == 0
    said = capsys.readouterr().out
    assert "stopped before its end" in said and "score" not in said
    page.keyboard.press("Space")
    page.keyboard.down("ArrowRight")
    until(page, "/The episode has ended|Time is up/.test(document.querySelector('.message').textContent)")
    page.keyboard.up("ArrowRight")
    whole = link_of(page)
    assert cli.main(["replay", whole]) == 0
    said = capsys.readouterr().out
    assert "terminated" in said and "true: every bit" in said
    score = float(said.split("score ")[1].split()[0])
    assert float(reading(page, "Score").replace("−", "-")) == pytest.approx(score, abs=1e-3)
    page.keyboard.press("r")
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    assert page.evaluate("location.hash") == "#seed=12"
    page.keyboard.down("n")
    until(page, "location.hash !== '#seed=12'")
    # Held down, a key acts once.
    held = page.evaluate("location.hash")
    page.keyboard.down("n")
    assert page.evaluate("location.hash") == held
    for _ in range(2):
        page.keyboard.down("Space")
    assert message(page).startswith("Paused at ")


@pytest.fixture(scope="module")
def link():
    """Return the contents of a drive's link that ends before its ten seconds."""
    task = TASKS[incline.Tilt.id]()
    env = Unfused(task)
    env.reset(77)
    keys, total, over = [], 0.0, False
    while not over:
        keys.append(((-64, 33, 64)[min(len(keys) // 9, 2)],))
        _, reward, *ended = env.step(replay.action_from_numbers(keys[-1], task))
        total, over = total + reward, any(ended)
    return replay.Drive(task.id, 77, replay.pack(keys), total, env.program.digest)


def test_a_link_is_recomputed_in_the_page(drive, link):
    page = drive(link.id, replay.write_link(link))
    until(page, "document.querySelector('.verdict').textContent.startsWith('The link is true')")
    assert page.evaluate("document.querySelector('.drive-controls select option:checked') !== null")
    # Watching it leads to the same return; it is the driver's ghost.
    assert page.evaluate("[...document.querySelectorAll('.drive-controls select')][1].value") == "link:0"
    page.select_option(".drive-controls select >> nth=0", "1")
    page.click(".rerun")
    until(page, "document.querySelector('.message').textContent.includes('R: drive from')")
    assert float(reading(page, "Return").replace("−", "-")) == pytest.approx(link.claimed, abs=6e-3)
    assert reading(page, "Score") not in ("–", "at the end")
    # With its last bit changed, it is false, and all digits say so.
    other = float(np.nextafter(link.claimed, np.inf))
    page = drive(link.id, replay.write_link(link._replace(claimed=other)))
    until(page, "document.querySelector('.verdict').dataset.true === 'false'")
    assert verdict(page).replace("−", "-") == (
        f"The link is false: it claims a return of {other!r}, but its keys give {link.claimed!r}."
    )


def test_a_link_with_a_key_after_the_end_is_forged_for_page_and_command(drive, link, capsys):
    keys = replay.unpack(link.keys, 1)
    longer = replay.write_link(link._replace(keys=replay.pack([*keys, (0,)])))
    page = drive(link.id, longer)
    until(page, "document.querySelector('.verdict').dataset.true === 'false'")
    n = len(keys)
    assert verdict(page) == (
        f"The link is forged: its episode ends after {n} steps, but it has keys for {n + 1}."
    )
    assert cli.main(["replay", longer]) == 2
    assert f"the episode ends after {n} steps, the link has {n + 1}: it is forged" in capsys.readouterr().err


def test_part_of_an_episode_has_no_score(drive):
    """Where all rewards are costs, the first steps have a better return than the best policy's episode."""
    task = TASKS[incline.Brake.id]()
    env = Unfused(task)
    env.reset(3)
    total = sum(env.step(replay.action_from_numbers((0,), task))[1] for _ in range(9))
    part = replay.Drive(task.id, 3, replay.pack([(0,)] * 9), total, env.program.digest)
    assert replay.replay(part).true and replay.replay(part).score is None
    page = drive(task.id, replay.write_link(part))
    until(page, "document.querySelector('.verdict').dataset.true === 'true'")
    assert "score " not in verdict(page) and "no score" in verdict(page)
    page.click(".rerun")
    until(page, "document.querySelector('.message').textContent.startsWith(\"The link's keys end here\")")
    assert "score" not in message(page) and reading(page, "Score") == "–"


@pytest.mark.slow
def test_while_watching_the_keys_are_said_to_be_silent(drive, link):
    """After the end, the button and the keys start a drive of one's own on the same start."""
    half = replay.unpack(link.keys, 1)[:30]
    env = Unfused(TASKS[link.id]())
    env.reset(link.seed)
    total = sum(env.step(replay.action_from_numbers(key, env.task))[1] for key in half)
    page = drive(link.id, replay.write_link(link._replace(keys=replay.pack(half), claimed=total)))
    until(page, "document.querySelector('.verdict').dataset.true === 'true'")
    assert page.evaluate("document.activeElement.className") == "stage"
    page.click(".rerun")
    assert message(page).startswith("Watching the link's drive: you do not steer")
    assert page.evaluate("document.activeElement.className") == "stage"
    until(page, "document.querySelector('.message').textContent.includes('R: drive from this start')")
    assert page.text_content(".go") == "Start again"
    page.click(".go")
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    assert message(page) == ""
    page.wait_for_timeout(200)
    page.keyboard.press("Space")
    mine = replay.read_link(link_of(page))
    assert mine.seed == link.seed and set(replay.unpack(mine.keys, 1)) == {(0,)}


def test_after_a_false_link_one_drives_on_its_start(drive, link):
    false = link._replace(claimed=np.nextafter(link.claimed, np.inf))
    page = drive(link.id, replay.write_link(false))
    until(page, "document.querySelector('.verdict').dataset.true === 'false'")
    page.focus(".stage")
    page.keyboard.press("Space")
    page.wait_for_timeout(300)
    page.keyboard.press("Space")
    mine = link_of(page)
    assert replay.replay(mine).true and replay.read_link(mine).seed == link.seed


def test_another_link_or_seed_may_follow_a_link(drive, link):
    """The next address takes nothing from the link before; an error in the page fails the test."""
    page = drive(link.id, replay.write_link(link))
    ghost = "[...document.querySelectorAll('.drive-controls select')][1]"
    until(page, f"{ghost}.value === 'link:0'")
    page.focus(".stage")
    page.keyboard.press("Space")
    page.evaluate("location.hash = '#drive=1~bad'")
    until(page, "document.querySelector('.verdict').textContent.includes('damaged')")
    assert page.evaluate(f"{ghost}.value") == ""
    page.evaluate(f"location.hash = {replay.write_link(link)!r}")
    until(page, f"{ghost}.value === 'link:0'")
    page.click(".rerun")
    page.evaluate("location.hash = '#seed=9'")
    until(page, "document.querySelector('.message').textContent.includes('starts')")
    assert page.text_content(".go") == "Start"
    page.focus(".stage")
    page.keyboard.press("r")
    page.wait_for_timeout(300)
    page.keyboard.press("Space")
    assert replay.read_link(link_of(page)).seed == 9


#: Invalid links, whole or as changes of a valid one; and the page's messages.
IMPOSSIBLE = [
    ({"step": "00000000"}, "another version"),
    ("#drive=1~x", "damaged"),
    slow("#drive=%E0%A4%A", "not a link to a drive"),
    slow("#drive=2~a~b~c~d~e~f", "version"),
    slow({"seed": 2**64}, "forged"),
    slow({"keys": replay.pack([(65,)])}, "between -64 and 64"),
    slow({"keys": "gA"}, "damaged"),
    slow({"keys": ""}, "no step"),
    ({"claimed": np.nan}, "not a finite number"),
    slow({"claimed": -np.inf}, "not a finite number"),
    slow({"claimed": -0.0}, "claims a return of −0, but"),
    slow({"keys": "gAECB"}, "forged"),
    slow("#seed=99999999999999999999", "below 2"),
]


@pytest.mark.parametrize(("made", "told"), IMPOSSIBLE)
def test_an_impossible_link_is_explained(drive, link, made, told):
    hash = made if isinstance(made, str) else replay.write_link(link._replace(**made))
    page = drive(link.id, hash)
    until(page, f"document.querySelector('.verdict').textContent.includes({told!r})")


def test_a_link_of_another_environment_leads_there(drive, link):
    foreign = replay.write_link(link._replace(id=pivoted_bar.SwingUp.id))
    page = drive(link.id, foreign)
    until(page, "document.querySelector('.verdict').textContent.includes('another environment')")
    href = page.evaluate("document.querySelector('.verdict a').getAttribute('href')")
    assert href == f"{pivoted_bar.SwingUp.id}.html#{foreign.partition('#')[2]}"


def test_a_link_cut_short_is_explained(drive, link):
    page = drive(link.id, replay.write_link(link)[:-1])
    until(page, "document.querySelector('.verdict').textContent.includes('damaged')")


#: Left, top, width and height of the picture.
PLACE = """(() => {
    const b = document.querySelector('.driver .scene').getBoundingClientRect();
    return [b.left, b.top, b.width, b.height];
})()"""


def test_by_pointer_and_by_touch(drive, browsing):
    page = drive(incline.Tilt.id, hash="#seed=3")
    page.evaluate("document.querySelector('.stage').scrollIntoView()")
    box = page.evaluate(PLACE)
    middle = box[1] + box[3] / 2
    page.mouse.move(box[0] + 0.98 * box[2], middle)
    page.mouse.down()
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    shows(page, "φ\u0307", "0.300 rad/s")
    page.mouse.move(box[0] + 0.29 * box[2], middle)
    shows(page, "φ\u0307", "−0.150 rad/s")
    page.mouse.up()
    shows(page, "φ\u0307", "0.000 rad/s")
    page.keyboard.press("Space")
    assert cli.main(["replay", link_of(page)]) == 0

    # On a phone on its side: all of the picture is visible, a swipe scrolls the page, and a tap starts.
    page.set_viewport_size({"width": 844, "height": 390})
    cdp = page.context.new_cdp_session(page)
    cdp.send("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2})
    page.evaluate("document.querySelector('.stage').scrollIntoView({ behavior: 'instant' })")
    left, top, width, height = page.evaluate(PLACE)
    assert height <= 0.8 * 390 + 1

    def touch(kind, *fingers, down=0):
        points = [{"x": left + x * width, "y": top + height / 2 + down, "id": id} for id, x in fingers]
        cdp.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    before = page.evaluate("scrollY")
    touch("touchStart", (0, 0.5))
    for down in range(10, 120, 10):
        touch("touchMove", (0, 0.5), down=down)
    touch("touchEnd")
    until(page, f"scrollY < {before - 50}")
    assert page.text_content(".go") == "Resume"
    page.evaluate("document.querySelector('.stage').scrollIntoView({ behavior: 'instant' })")
    touch("touchStart", (0, 0.5))
    assert page.text_content(".go") == "Resume"
    touch("touchEnd")
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    # The first finger steers, whatever the second does.
    touch("touchStart", (0, 0.98))
    shows(page, "φ\u0307", "0.300 rad/s")
    touch("touchStart", (0, 0.98), (1, 0.1))
    touch("touchMove", (0, 0.71), (1, 0.2))
    shows(page, "φ\u0307", "0.150 rad/s")
    touch("touchEnd", (1, 0.2))  # this one is lifted
    page.wait_for_timeout(200)
    assert reading(page, "φ\u0307") == "0.150 rad/s"
    touch("touchEnd")
    shows(page, "φ\u0307", "0.000 rad/s")


GAMEPAD = """() => {
    const pad = {connected: true, index: 0, axes: [0.5, 0, 0, 0], buttons: []};
    window.pad = pad;
    Object.defineProperty(navigator, 'getGamepads', {value: () => [pad.connected ? pad : null]});
    const event = new Event('gamepadconnected');
    event.gamepad = pad;
    window.dispatchEvent(event);
}"""


def test_a_gamepad_drives_and_may_leave(drive):
    page = drive(incline.Tilt.id, hash="#seed=3")
    page.evaluate(GAMEPAD)
    assert "A gamepad is connected" in message(page)
    page.click(".go")
    shows(page, "φ\u0307", "0.150 rad/s")
    page.evaluate("window.pad.connected = false")
    until(page, "document.querySelector('.message').textContent.startsWith('The gamepad is disconnected')")
    assert page.text_content(".go") == "Resume"
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, "document.querySelector('.go').textContent === 'Pause'")


def test_a_gamepad_is_enough(drive):
    page = drive(incline.Tilt.id, hash="#seed=3")
    page.evaluate(GAMEPAD)
    assert "A or Start starts and pauses, B restarts" in message(page)
    button = "document.querySelector('.go').textContent"

    def press(number, then):
        page.evaluate(f"window.pad.buttons[{number}].pressed = true")
        until(page, f"{button} === {then!r}")
        page.evaluate(f"window.pad.buttons[{number}].pressed = false")
        page.wait_for_timeout(100)
        assert page.evaluate(button) == then

    page.evaluate("window.pad.buttons = Array.from({length: 10}, () => ({pressed: false}))")
    page.wait_for_timeout(100)
    assert page.evaluate(button) == "Start"
    press(0, "Pause")
    press(9, "Resume")
    press(1, "Pause")
    assert float(reading(page, "Time").split()[0]) < 3.0
    press(9, "Resume")
    # A stick that was at rest starts, too.
    page.evaluate("window.pad.axes = [0, 0, 0, 0]")
    page.wait_for_timeout(100)
    page.evaluate("window.pad.axes = [-1, 0, 0, 0]")
    shows(page, "φ\u0307", "−0.300 rad/s")


def test_a_changed_machine_is_not_scored(drive):
    page = drive("PivotedBar-v0")
    page.click(".sliders summary")
    names = page.locator(".sliders label span").all_text_contents()
    assert names == ["mass", "centre-of-mass distance", "damping", "gravity", "track", "control limit"]
    before = page.evaluate("document.querySelector('.driver .scene').toDataURL()")
    assert page.locator(".sliders output").last.text_content() == "5 m/s²"
    page.fill(".sliders input >> nth=1", "1")
    assert "not scored" in message(page)
    assert page.evaluate("document.querySelector('.driver .scene').toDataURL()") != before
    page.focus(".stage")
    page.keyboard.press("Space")
    page.wait_for_timeout(200)
    page.keyboard.press("Space")
    assert reading(page, "Score") == "not scored"
    assert page.evaluate("document.querySelector('.copy').disabled")
    page.click(".reset")
    assert "scored again" in message(page)


@pytest.fixture(scope="module")
def owned(tmp_path_factory):
    """Pages of users' tasks, from records of any kind."""
    folder = tmp_path_factory.mktemp("owned")
    with pytest.MonkeyPatch.context() as patch:
        for task in OWN:
            patch.setitem(TASKS, task.id, task)
        boards = [{"id": task.id, "rows": []} for task in OWN]
        write_page({"protocol": 1, "made": "today", "environments": boards}, folder)
    return folder


def test_two_controls_without_a_picture(drive, owned):
    page = drive("OwnCrane-v0", folder=owned)
    assert "← → push [N], ↓ ↑ pull [N]" in message(page) and "nothing to draw" in message(page)
    for key in ("ArrowRight", "ArrowUp"):
        page.keyboard.down(key)
    shows(page, "push", "20.00 N")
    shows(page, "pull", "20.00 N")
    assert reading(page, "Score") == "–"
    page.keyboard.up("ArrowUp")
    page.wait_for_timeout(300)
    if not message(page):
        assert reading(page, "pull") == "0.00 N"


def test_choices(drive, owned):
    page = drive("OwnSwitched-v0", folder=owned)
    assert "1 to 3 for one of the listed actions" in message(page)
    page.keyboard.down("ArrowLeft")
    shows(page, "s\u0308", "−5.00 m/s²")
    assert reading(page, "θ₁").endswith(" rad") and reading(page, "θ\u0307₁").endswith(" rad/s")
    page.keyboard.up("ArrowLeft")
    page.keyboard.down("3")
    shows(page, "s\u0308", "5.00 m/s²")
    page.keyboard.up("3")
    shows(page, "s\u0308", "0.00 m/s²")


@pytest.mark.slow
def test_nothing_acts(drive, owned):
    page = drive("OwnDrift-v0", folder=owned)
    assert "nothing to control here" in message(page)
    page.keyboard.press("Space")
    until(page, "document.querySelector('.message').textContent.startsWith('Time is up')")


def test_what_the_browser_lacks_is_told(browsing, bare):
    page = browsing.open(f"{bare.as_uri()}/PivotedBar-v0.html", bare.as_uri())
    page.evaluate("delete window.CanvasRenderingContext2D")
    page.click(".begin")
    status = "document.querySelector('#drive .status').textContent"
    until(page, f"{status}.includes('lacks what driving needs: drawing')")
    assert not page.evaluate("document.querySelector('.begin').disabled")


def test_names_for_those_who_do_not_see(drive):
    page = drive()
    tree = page.context.new_cdp_session(page)
    nodes = [n for n in tree.send("Accessibility.getFullAXTree")["nodes"] if not n["ignored"]]
    for node in nodes:
        if node["role"]["value"] in {"button", "combobox", "slider", "application", "textbox"}:
            assert node["name"]["value"].strip(), node
    said = f"Drive {pivoted_bar.Balance.id}. left arrow and right arrow: acceleration of the support in m/s²."
    assert said in str(nodes)


@pytest.mark.parametrize("scheme", ["light", slow("dark")])
def test_axe_finds_nothing_serious(drive, haunted, scheme):
    page = drive(cylinder_in_cylinder.Tilt.id, folder=haunted, color_scheme=scheme, bypass_csp=True)
    page.select_option(".drive-controls select >> nth=1", "stored:1")
    page.click(".sliders summary")
    page.focus(".stage")
    for _ in range(2):
        page.keyboard.press("Space")
        page.wait_for_timeout(200)
    link_of(page)
    assert serious(page) == []


@pytest.mark.parametrize("width", [320, 1920])
def test_nothing_overflows(drive, width):
    page = drive(viewport={"width": width, "height": 700})
    page.click(".sliders summary")
    assert page.evaluate("document.documentElement.scrollWidth") == width


# --- ghosts -------------------------------------------------------------------------------------------------


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


LINEAR = (
    "linear",
    cylinder_in_cylinder.Tilt.id,
    {"architecture": "linear"},
    {"gain": [1.0, 0.5, -0.2, -0.7], "offset": [0.1]},
)
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


def made(id, table, arrays):
    arrays = numbers(id, table) if arrays is None else arrays
    return SubmittedPolicy(
        architecture(id, table), {name: np.asarray(x, np.float64) for name, x in arrays.items()}
    )


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


@pytest.fixture(scope="module")
def haunted(tmp_path_factory):
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


def test_ghosts_run_beside(drive, haunted):
    page = drive(cylinder_in_cylinder.Tilt.id, folder=haunted)
    ghosts = ".drive-controls select >> nth=1"
    page.select_option(ghosts, "live:0")
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, "parseFloat(document.querySelector('.driver .readout dd').textContent) > 0.3")
    assert reading(page, "Ghost's return") not in (None, "–")
    page.select_option(ghosts, "stored:1")
    until(page, "!document.querySelectorAll('.drive-controls label')[2].hidden")
    until(page, "document.querySelector('.go').textContent === 'Start'")
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, f"location.hash === '#seed={2**61 + 3}'")
    page.click(".drives a")
    until(page, "location.hash === '#seed=4'")
    until(page, "document.activeElement.className === 'stage'")


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


# --- speed --------------------------------------------------------------------------------------------------


#: Ghosts by environment: one that looks a step ahead, and a network as large as those on the board.
BESIDE = {
    cylinder_in_cylinder.Tilt.id: (
        {"architecture": "table", "axes": ["theta - target", "theta_dot"], "kind": "value"},
        {"axis_0": np.linspace(-1, 1, 9), "axis_1": np.linspace(-2, 2, 9), "table": np.ones((9, 9))},
    ),
    acrobot.AcrobotReal.id: (
        {"architecture": "mlp", "hidden": [256, 256], "activation": "relu", "squash": "tanh"},
        None,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("id", ["PivotedBar-v0", incline.Brake.id, chain.SwingUpTriple.id, *BESIDE])
def test_a_frame_takes_eight_milliseconds_at_most(drive, id, tmp_path):
    """In at least one of three drives, for the machine may be busy."""
    data = board_pages.data((id,), board_pages.AGENTS[:1])
    if id in BESIDE:
        data["environments"][0]["rows"][0]["agent"] = agent(made(id, *BESIDE[id]))
    write_page(data, tmp_path)
    drives = (frames(drive(id, folder=tmp_path), id in BESIDE) for _ in range(3))
    assert any(np.quantile(found, 0.99) <= 8.0 for found in drives)


@pytest.mark.slow
def test_so_does_the_frame_in_which_an_episode_ends(drive, tmp_path):
    write_page(board_pages.data(("PivotedBar-v0",), board_pages.AGENTS[:1]), tmp_path)
    drives = (frames(drive("PivotedBar-v0", folder=tmp_path), to_the_end=True) for _ in range(3))
    assert any(max(found) <= 8.0 for found in drives)


def frames(page, ghost=False, to_the_end=False):
    """Return the time of each frame while keys are pressed, with the processor throttled four times [ms]."""
    if ghost:
        page.select_option(".drive-controls select >> nth=1", "live:0")
    cdp = page.context.new_cdp_session(page)
    cdp.send("Emulation.setCPUThrottlingRate", {"rate": 4})
    page.focus(".stage")
    page.keyboard.press("Space")
    page.wait_for_timeout(2000 if to_the_end else 500)  # the first frames also compile
    page.context.browser.start_tracing(page=page, categories=["devtools.timeline"])
    for i in range(8):
        key = ("ArrowLeft", "ArrowRight")[i % 2]
        page.keyboard.down(key)
        page.wait_for_timeout(400)
        page.keyboard.up(key)
    if to_the_end:
        until(page, "document.querySelector('.go').textContent === 'Start again'")
        link_of(page)
    events = json.loads(page.context.browser.stop_tracing())["traceEvents"]
    # The main thread's own time: the machine may be busy otherwise.
    took = np.array([e["tdur"] / 1e3 for e in events if e["name"] == "FireAnimationFrame" and "tdur" in e])
    print(len(took), np.quantile(took, [0.5, 0.95, 1.0]))
    assert len(took) > 30
    return took


@pytest.mark.parametrize(
    "kind, names",
    [
        (incline.Brake, ["mass", "radius", "tilt", "gravity"]),
        (
            cylinder_in_cylinder.Tilt,
            ["mass", "shell_radius", "radius", "damping", "gravity", "control limit"],
        ),
    ],
)
def test_parameters_that_the_script_follows_have_sliders(kind, names):
    assert [slider["name"] for slider in sliders(kind, Unfused(kind()))] == names
