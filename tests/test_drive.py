"""Driving in the page: what a person meets there."""

import numpy as np
import pytest
from browsers import serious, until
from covering import slow
from driving import (
    HOLD,
    bare_pages,  # noqa: F401
    driver_page,  # noqa: F401
    haunted_page,  # noqa: F401
    link_of,
    message,
    reading,
    readout,
    shows,
    verdict,
)
from own_tasks import TASKS as OWN

from lag_envs import cli, replay
from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.site.build import write_page
from lag_envs.scores import known_returns
from lag_envs.tasks import TASKS, cart_pole, cylinder_in_cylinder, incline, pivoted_bar
from tests import board_pages

pytestmark = pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")
#: How many numbers of the read-out are painted, and how many are text.
PAINTED = """(() => {
    const canvas = document.querySelector('.values');
    const { top, left } = canvas.getBoundingClientRect();
    const { width, height } = canvas;
    const copy = Object.assign(document.createElement('canvas'), { width, height });
    const pen = copy.getContext('2d', { willReadFrequently: true });
    pen.drawImage(canvas, 0, 0);
    const [painted, written] = [[], []];
    for (const cell of document.querySelectorAll('.driver .readout dd')) {
        const box = cell.getBoundingClientRect();
        const part = [box.left - left, box.top - top, box.width, box.height];
        painted.push(pen.getImageData(...part).data.some(Boolean));
        written.push(getComputedStyle(cell).visibility === 'visible');
    }
    return [painted, written].map((each) => each.filter(Boolean).length);
})()"""


def test_by_keys_alone(drive, capsys):
    """Tab, arrows, Space, R and N; the command confirms the drive."""
    page = drive(incline.Tilt.id, hash="#seed=12", slowly=True)
    told = message(page)
    assert "← → rate of the tilt dφ/dt [rad/s]" in told and "Space or a click starts" in told
    page.focus("main")
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.className") == "stage":
            break
    assert page.evaluate("document.activeElement.getAttribute('role')") == "application"
    page.keyboard.down("ArrowRight")
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    until(page, readout("Time"), lambda text: text > "0.1")
    numbers, written = page.evaluate(PAINTED)
    assert numbers > 5 and not written
    page.keyboard.up("ArrowRight")
    # A key that is tapped between two steps acts on the next one.
    page.keyboard.press("ArrowLeft")
    shows(page, "dφ/dt", "−0.300 rad/s")
    shows(page, "dφ/dt", "0.000 rad/s")
    page.keyboard.press("Space")
    assert message(page).startswith("Paused at 0.")
    assert page.evaluate(PAINTED) == [0, numbers]
    held = link_of(page)
    assert replay.read_link(held).seed == 12
    known, limit = known_returns(incline.Tilt.id), incline.Tilt().limit
    passed = len(replay.unpack(replay.read_link(held).keys, 1)) / limit
    expected = (replay.read_link(held).claimed - passed * known.random) / (known.best - known.random)
    so_far = reading(page, "Score")
    assert so_far.endswith(" so far")
    assert float(so_far.split()[0].replace("−", "-")) == pytest.approx(expected, abs=1e-3)
    assert replay.unpack(replay.read_link(held).keys, 1).count((-64,)) == 1
    assert cli.main(["replay", held]) == 0
    said = capsys.readouterr().out
    assert "stopped before its end" in said and "score" not in said
    page.select_option(".drive-controls select >> nth=0", "1")
    page.focus(".stage")
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


def test_time_waits_where_an_action_pushes(drive, tmp_path):
    """Without a key the cart is pushed to the left: the episode would be over in a moment."""
    id = cart_pole.CartPoleExact.id
    write_page(board_pages.data((id,), agents=()), tmp_path)
    page = drive(id, folder=tmp_path)
    assert "Without a key, force is −10 N." in message(page)
    page.keyboard.press("Space")
    page.wait_for_timeout(400)
    assert message(page) == "Time begins with your first key." and reading(page, "Time") == "0.00 s"
    page.keyboard.down("d")
    until(page, "document.querySelector('.message').textContent.startsWith('The episode has ended')")
    page.keyboard.up("d")
    keys = replay.read_link(link_of(page)).keys
    assert set(replay.unpack(keys, 1)) == {(1,)}, "A D act like the arrows"


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
    encoded = replay.write_link(link).replace("=", "%3D").replace("~", "%7E")
    page = drive(link.id, encoded)
    until(page, "document.querySelector('.verdict').textContent.startsWith('The link is true')")
    assert page.evaluate("document.querySelector('.drive-controls select option:checked') !== null")
    # Watching it leads to the same return; it is the driver's ghost.
    assert page.evaluate("[...document.querySelectorAll('.drive-controls select')][1].value") == "link:0"
    page.select_option(".drive-controls select >> nth=0", "1")
    page.click(".rerun")
    until(page, "document.querySelector('.message').textContent.includes('Press R to drive from')")
    assert float(reading(page, "Return").replace("−", "-")) == pytest.approx(link.claimed, abs=6e-3)
    assert reading(page, "Score") != "–" and "so far" not in reading(page, "Score")
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
    assert (
        f"the episode ends after {n} steps, but the link has {n + 1}: it is forged" in capsys.readouterr().err
    )


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
    until(page, "document.querySelector('.message').textContent.includes('Press R to drive from this start')")
    assert page.text_content(".go") == "Restart" and not page.is_visible(".again")
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
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    page.evaluate(f"location.hash = {replay.write_link(link) + ' '!r}")
    until(page, "document.querySelector('.go').textContent === 'Start'")
    assert "Space or a click starts" in message(page) and reading(page, "Time") == "0.00 s"
    page.evaluate("location.hash = '#seed=8'")
    until(page, f"{ghost}.value === ''")
    page.click(".rerun")
    page.evaluate("location.hash = '#seed=9'")
    until(page, "document.querySelector('.message').textContent.includes('starts')")
    assert page.text_content(".go") == "Start"
    page.focus(".stage")
    page.keyboard.press("r")
    page.wait_for_timeout(300)
    page.keyboard.press("Space")
    assert replay.read_link(link_of(page)).seed == 9


#: Invalid links and seeds, whole or as changes of a valid one; and the page's messages.
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
    slow("#seed=99999999999999999999", "must be a whole number from 0 to 2⁶⁴ − 1"),
    slow("#seed=-1", "must be a whole number from 0 to 2⁶⁴ − 1"),
    ("#seed=7&x=1", "must be a whole number from 0 to 2⁶⁴ − 1; this start is a random one."),
]


@pytest.mark.parametrize(("made", "told"), IMPOSSIBLE)
def test_an_impossible_link_or_seed_is_explained(drive, link, made, told):
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


def test_by_pointer_and_by_touch(drive):
    page = drive(incline.Tilt.id, hash="#seed=3", slowly=True)
    page.evaluate("document.querySelector('.stage').scrollIntoView()")
    box = page.evaluate(PLACE)
    middle = box[1] + box[3] / 2
    page.mouse.move(box[0] + 0.98 * box[2], middle)
    page.mouse.down()
    until(page, "document.querySelector('.go').textContent === 'Pause'")
    shows(page, "dφ/dt", "0.300 rad/s")
    page.mouse.move(box[0] + 0.29 * box[2], middle)
    shows(page, "dφ/dt", "−0.150 rad/s")
    page.mouse.up()
    shows(page, "dφ/dt", "0.000 rad/s")
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
    shows(page, "dφ/dt", "0.300 rad/s")
    touch("touchStart", (0, 0.98), (1, 0.1))
    touch("touchMove", (0, 0.71), (1, 0.2))
    shows(page, "dφ/dt", "0.150 rad/s")
    touch("touchEnd", (1, 0.2))  # this one is lifted
    page.wait_for_timeout(200)
    assert reading(page, "dφ/dt") == "0.150 rad/s"
    touch("touchEnd")
    shows(page, "dφ/dt", "0.000 rad/s")


GAMEPAD = """() => {
    const pad = {connected: true, index: 0, axes: [0.5, 0, 0, 0], buttons: []};
    window.pad = pad;
    Object.defineProperty(navigator, 'getGamepads', {value: () => [pad.connected ? pad : null]});
    const event = new Event('gamepadconnected');
    event.gamepad = pad;
    window.dispatchEvent(event);
}"""


def test_a_gamepad_drives_and_may_leave(drive):
    page = drive(incline.Tilt.id, hash="#seed=3", slowly=True)
    page.evaluate(GAMEPAD)
    assert "A gamepad is connected" in message(page)
    page.click(".go")
    shows(page, "dφ/dt", "0.150 rad/s")
    page.evaluate("window.pad.connected = false")
    until(page, "document.querySelector('.message').textContent.startsWith('The gamepad is disconnected')")
    assert page.text_content(".go") == "Resume"
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, "document.querySelector('.go').textContent === 'Pause'")


def test_a_gamepad_is_enough(drive):
    page = drive(incline.Tilt.id, hash="#seed=3", slowly=True)
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
    shows(page, "dφ/dt", "0.150 rad/s")
    press(9, "Resume")
    press(1, "Pause")
    assert float(reading(page, "Time").split()[0]) < 3.0
    shows(page, "dφ/dt", "0.150 rad/s")
    press(9, "Resume")
    # A stick that was at rest starts, too.
    page.evaluate("window.pad.axes = [0, 0, 0, 0]")
    page.wait_for_timeout(100)
    page.evaluate("window.pad.axes = [-1, 0, 0, 0]")
    shows(page, "dφ/dt", "−0.300 rad/s")


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
    field = page.locator(".share input")
    assert field.get_attribute("placeholder") == "Drives of a changed machine have no link"
    page.click(".reset")
    assert "scored again" in message(page)
    assert field.get_attribute("placeholder") == "Your drive's link, once it stops"


def test_what_is_0_can_be_added(drive):
    """The step with the terms of such a parameter is loaded once it is moved, and only if it can be."""
    page = drive(incline.Brake.id)
    fuller = "document.querySelectorAll('script[src*=fuller]').length"
    assert page.evaluate(fuller) == 0
    page.click(".sliders summary")
    damping = page.locator(".sliders label", has_text="damping")
    assert damping.locator("output").text_content() == "0 N s/m"
    page.evaluate(HOLD)
    damping.locator("input").fill("0.5")
    assert message(page) == "Loading the changed machine …" and page.is_disabled(".go")
    page.evaluate("window.held.dispatchEvent(new Event('error'))")
    until(page, "document.querySelector('.message').textContent.includes('could not be loaded')")
    assert damping.locator("output").text_content() == "0 N s/m" and page.is_enabled(".go")
    page.evaluate("delete document.head.append")
    damping.locator("input").fill("0.5")
    until(page, "document.querySelector('.message').textContent.includes('not scored')")
    assert damping.locator("output").text_content() == "0.7 N s/m" and page.evaluate(fuller) == 1
    page.focus(".stage")
    page.keyboard.press("Space")
    until(page, "document.querySelector('.message').textContent.startsWith('The episode has ended')")
    assert reading(page, "Score") == "not scored" and page.is_disabled(".copy")
    page.click(".reset")
    assert "scored again" in message(page)
    page.focus(".stage")
    page.keyboard.press("Space")
    page.wait_for_timeout(200)
    page.keyboard.press("Space")
    assert replay.replay(link_of(page)).true


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
    page = drive("OwnCrane-v0", folder=owned, slowly=True)
    assert "← → push [N], ↓ ↑ pull [N]" in message(page) and "nothing to draw" in message(page)
    for key in ("ArrowRight", "ArrowUp"):
        page.keyboard.down(key)
    shows(page, "push", "20.00 N")
    shows(page, "pull", "20.00 N")
    assert reading(page, "Score") == "–"
    page.keyboard.up("ArrowUp")
    shows(page, "pull", "0.00 N")


def test_choices(drive, owned):
    page = drive("OwnSwitched-v0", folder=owned, slowly=True)
    assert ", or 1 for −5 m/s², 2 for 0 m/s², 3 for 5 m/s²; or hold" in message(page)
    page.keyboard.down("ArrowLeft")
    shows(page, "d²s/dt²", "−5.00 m/s²")
    assert reading(page, "θ₁").endswith(" rad") and reading(page, "dθ₁/dt").endswith(" rad/s")
    page.keyboard.up("ArrowLeft")
    page.keyboard.down("Digit3")
    shows(page, "d²s/dt²", "5.00 m/s²")
    # With Shift the same key is called otherwise when it is let go.
    page.keyboard.down("Shift")
    page.keyboard.up("Digit3")
    shows(page, "d²s/dt²", "0.00 m/s²")


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
    page.reload()
    page.evaluate(HOLD)
    page.click(".begin")
    page.evaluate("window.held.dispatchEvent(new Event('error'))")
    until(page, f"{status} === 'The program could not be loaded. Check the connection and try again.'")
    page.evaluate("delete document.head.append")
    page.evaluate("delete Math.fround")
    page.click(".begin")
    until(page, f"{status}.includes('from the end of 2020 on')")
    assert page.is_enabled(".begin") and page.evaluate("document.querySelector('.stage') === null")
    assert not page.is_visible(".unable")
    page.add_init_script("delete Element.prototype.replaceChildren")
    page.reload()
    assert "from the end of 2020" in page.inner_text("#drive .unable") and not page.is_visible(".begin")


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
