"""The leaderboard's page behaves in a real browser."""

import http.server
import itertools
import json
import runpy
import threading
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from browsers import serious, until
from covering import every, slow
from toy_pendulum import Swing

from lag_envs import store
from lag_envs.leaderboard.board import Board
from lag_envs.leaderboard.site.build import render, write_page
from lag_envs.leaderboard.site.scenery import picture_data
from lag_envs.leaderboard.standings import board_data
from lag_envs.scenes import TwoLinkArm
from lag_envs.scenes.picture import Picture
from lag_envs.scenes.shapes import Arrow, Circle, Frame, Line, Magnifier, Polygon
from lag_envs.tasks import TASKS, Task, cylinder_in_cylinder, incline, rotary_pendulum
from tests import board_pages
from tests.board_pages import HOSTILE, clean

# So that the warning is shown instead of an error.
pytestmark = pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")
#: Roles of elements that need a name for screen readers.
NAMED = {"button", "combobox", "slider", "searchbox", "radio", "checkbox", "link", "image", "img", "region"}


@pytest.fixture(scope="module")
def data():
    return board_pages.data()


@pytest.fixture(scope="module")
def folder(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    write_page(data, out)
    return out


@contextmanager
def serving(folder):
    """Serve a folder, and return its address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="module")
def served(folder):
    """Return the address of the page on a server."""
    with serving(folder) as address:
        yield address


@pytest.fixture(scope="module")
def documented(data, tmp_path_factory):
    """Return the address of a server whose folder ``board`` has the page as a part of the documentation."""
    folder = tmp_path_factory.mktemp("documented")
    for content in render(data, "", [("Home", "../index.html")], documentation="../environments/"):
        for name, text in content.items():
            store.write_file(folder / "board" / name, text)
    with serving(folder) as address:
        yield address


@pytest.fixture
def open_page(browsing, folder):
    """Open a page of the site."""

    def open_it(name="PivotedBar-v0", root=None, **options):
        root = root or folder.as_uri()
        page = browsing.open(f"{root}/{name}.html", root, **options)
        if options.get("java_script_enabled", True) and name != "index":
            see_episodes(page)
        return page

    return open_it


def see_episodes(page):
    """Go to the place where episodes are watched, which loads them, and back."""
    there = "document.querySelector('#watch').scrollIntoView({ behavior: 'instant' })"
    until(page, f"({there}, document.querySelectorAll('.episode option').length >= 2)")
    page.evaluate("scrollTo({ top: 0, behavior: 'instant' })")


def recorded(task, env_id, seed=0):
    """Return an episode of random actions, in the form of the page's data."""
    rng = np.random.default_rng(seed)
    states, n = [[float(x) for x in task.centre]], 40
    actions = rng.uniform(-1, 1, (n, task.formulas.actions))
    for control in task.wanted(actions):
        states.append(task.scene.simulate(states[-1], control[None], task.dt)[-1].tolist())
    return {
        "label": "median", "seed": seed, "dt": task.dt, "return": 1.0, "score": 0.5, "states": states,
        "actions": actions.round(5).tolist(), "rewards": [1.0 / n] * n,
        "target": [0.1] * task.formulas.targets or None,
    }  # fmt: skip


class Reach(Task):
    """Turn an arm by two torques."""

    scene = TwoLinkArm
    action = {"shoulder": 5.0, "elbow": 2.0}
    target = {"goal_1": ("rad", 0.5), "goal_2": ("rad", 0.5)}

    def observe(self, after, target, xp):
        return {name: after[name] for name in self.scene.state_names}

    def reward(self, before, after, control, target, dt, xp):
        return 1.0

    def bodies(self):
        return {**super().bodies(), "turn": [Arrow([(0.2, 0.0), (0.2, 0.1)])]}

    def indicators(self, now, xp):
        return {**super().indicators(now, xp), "turn": (0.0, 0.0, now.target.goal_1, now.share.elbow)}


@pytest.fixture
def own(monkeypatch):
    """Return a board of scenes that are not in the package, including one without bodies."""
    example = Path(__file__).parents[1] / "examples" / "ball_on_beam.py"
    balance = runpy.run_path(str(example))["Balance"]
    shapeless = type("Shapeless", (Swing,), {"bodies": lambda self: {}})
    kinds = {"BallOnBeam-v0": balance, "Reach-v0": Reach, "Shapeless-v0": shapeless}
    boards = []
    for env_id, kind in kinds.items():
        monkeypatch.setitem(TASKS.data, env_id, kind)
        rows = [{"name": n, "rank": 1, "replays": [recorded(kind(), env_id, i)]} for i, n in enumerate("AB")]
        boards.append({"id": env_id, "rows": rows})
    return {"protocol": 1, "made": "today", "environments": boards}


def colours(page, selector, least=0):
    """Return the number of colours on a canvas, as soon as there are so many."""
    return until(
        page,
        f"""(() => {{
        const c = document.querySelector({json.dumps(selector)});
        const copy = new OffscreenCanvas(c.width, c.height);
        const pen = copy.getContext("2d", {{willReadFrequently: true}});
        pen.drawImage(c, 0, 0);
        const found = new Set(new Uint32Array(pen.getImageData(0, 0, c.width, c.height).data.buffer)).size;
        return found > {least} && found;
    }})()""",
    )


def column(page, selector):
    """Return the texts of a column of the ranking, from top to bottom, for visible rows."""
    return page.evaluate(
        f"[...document.querySelectorAll('.ranking tbody tr:not([hidden]) {selector}')].map(e => e.innerText)"
    )


def clock(page):
    return float(page.evaluate("document.querySelector('.clock').textContent").split(" /")[0])


def reading(page, side, name):
    return page.evaluate(
        f"[...document.querySelectorAll('.side')[{side}].querySelectorAll('.readout div')]"
        f".find(d => d.firstChild.textContent === {json.dumps(name)}).lastChild.textContent"
    ).replace("−", "-")


def test_overview(open_page, data):
    page = open_page("index")
    assert page.locator(".card").count() == 3
    assert page.locator(".card .strip .dot").count() == 3 * len(board_pages.AGENTS)
    for i in range(3):
        assert colours(page, f".card:nth-child({i + 1}) canvas", 50)
    told = page.evaluate("[...document.querySelectorAll('.combined tbody tr')].map((row) => row.innerText)")
    (row,) = (" ".join(text.split()) for text in told)
    assert row.lower() == "ppo learned 0.700 0.650 to 0.750 2 of 3 0.900 66.7 % 33.3 % 0.0 %"
    page.click(".card:nth-child(2) .whole")
    page.wait_for_url(f"**/{incline.Brake.id}.html")
    assert page.evaluate("document.querySelector('nav [aria-current]').textContent") == incline.Brake.id


def test_scenes_of_ones_own_are_drawn(own, open_page, tmp_path):
    write_page(own, tmp_path)
    for name, drawn in (("BallOnBeam-v0", True), ("Reach-v0", True), ("Shapeless-v0", False)):
        page = open_page(name, root=tmp_path.as_uri())
        assert (colours(page, ".scene", 20 if drawn else 0) > 20) == drawn
        assert page.evaluate("document.querySelectorAll('[data-poster]').length") == 1
        page.evaluate("document.querySelector('.scrub input').focus()")
        before = page.evaluate("document.querySelector('.scene').toDataURL()")
        heights = {"Reach-v0": 3}  # two actions and the reward
        rem = page.evaluate("parseFloat(getComputedStyle(document.documentElement).fontSize)")
        height = page.evaluate("document.querySelector('.traces canvas').clientHeight")
        assert height == pytest.approx(4.75 * rem * heights.get(name, 2), abs=1)
        page.keyboard.press("End")
        until(page, "document.querySelector('.clock').textContent.startsWith('0.80 ')")
        assert (page.evaluate("document.querySelector('.scene').toDataURL()") != before) == drawn
    page = open_page("index", root=tmp_path.as_uri())
    assert colours(page, ".card:nth-child(1) canvas", 10)


def flat(shape):
    """Return a shape in the script's form."""
    match shape:
        case Line(points, role):
            return ["line", np.array(points), role]
        case Polygon(points, role):
            return ["polygon", np.array(points), role]
        case Arrow(points, role):
            return ["arrow", np.array(points), role]
        case Circle(centre, radius, role):
            return ["circle", np.array([*centre, radius]), role]
        case Magnifier(centre, radius):
            return ["magnifier", np.array([*centre, radius]), None]


def test_scenes_are_drawn_as_python_draws_them(open_page):
    page = open_page()
    rng = np.random.default_rng(0)
    for env_id, kind in TASKS.items():
        task = kind()
        shown, wide = Picture(task), Picture(task).view
        described, size = json.dumps(picture_data(shown)), max(wide.right - wide.left, wide.top - wide.bottom)
        for _ in range(3):
            state = (task.centre + rng.uniform(-3, 3, len(task.centre)) * task.half_widths).tolist()
            controls = task.wanted(rng.uniform(-1, 1, (1, task.formulas.actions)))[0]
            target, turned = float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-3, 3))
            now = Frame(state, controls, task.share(controls), target, turned)
            poses = shown.poses(now)
            window = page.evaluate(f"lagEnvs.windowOf({described}, {json.dumps(poses)})")
            assert window == pytest.approx(shown.window(poses)[:4], abs=1e-4 * size)
            found = page.evaluate(f"lagEnvs.placed({described}, {json.dumps(poses)}, {json.dumps(window)})")
            wanted = [flat(shape) for shape in shown.placed(now)]
            assert [s[0] for s in found] == [w[0] for w in wanted], env_id
            for shape, (what, points, role) in zip(found, wanted, strict=True):
                round_one = what in ("circle", "magnifier")
                assert (shape[3] if what == "circle" else shape[2] if what != "magnifier" else None) == role
                own = [*shape[1], shape[2]] if round_one else shape[1]
                np.testing.assert_allclose(own, points, atol=1e-4 * size)
    # A ghost brings the parts of the frame that are elsewhere, such as a turned arm.
    shown = Picture(rotary_pendulum.RotarySwingUp())
    moments = [shown.poses(Frame([angle, 0.0, 0.1, 0.0])) for angle in (0.0, 1.0)]
    roles = page.evaluate(
        "([picture, now, there]) => [there, now].map((other) =>"
        "lagEnvs.apart(picture, now, other).shapes.map((shape) => shape[shape.length - 1]))",
        [picture_data(shown), *moments],
    )
    assert roles == [["frame", "body"], ["body"]]


def test_sorting_by_mouse_and_keyboard(open_page, data):
    page, rows = open_page(), data["environments"][0]["rows"]

    def names(key, rising):
        present = [r for r in rows if r[key] is not None]
        ordered = sorted(present, key=lambda r: r[key] if rising else -r[key])
        return [r["name"] for r in (*ordered, *(r for r in rows if r[key] is None))]

    def sorted_by():
        return page.evaluate(
            "[...document.querySelectorAll('th[aria-sort]:not([aria-sort=none])')]"
            ".map(t => t.querySelector('button').textContent + ' ' + t.getAttribute('aria-sort'))"
        )

    assert sorted_by() == ["Rank ascending"]
    page.click("[data-key=settle]")
    assert column(page, ".name bdi") == names("settle", True)
    assert sorted_by() == ["Settle ascending"]
    page.click("[data-key=settle]")
    assert column(page, ".name bdi") == names("settle", False)
    assert "descending" in page.evaluate("document.querySelector('#ranking .status').textContent")
    page.evaluate("document.querySelector('[data-key=return]').focus()")
    page.keyboard.press("Enter")
    assert column(page, ".name bdi") == names("return", False)
    page.keyboard.press("Space")
    assert sorted_by() == ["Return ascending"]
    page.click("[data-key=name]")
    assert column(page, ".name bdi") == sorted((r["name"] for r in rows), key=str.casefold)
    page.click("[data-key=rank]")
    assert column(page, ".name bdi") == [r["name"] for r in rows]


def test_filtering(open_page, data):
    page, rows = open_page(), data["environments"][0]["rows"]
    page.click(".filter [value=controller]")
    assert column(page, ".name bdi") == [r["name"] for r in rows if r["kind"] == "controller"]
    assert page.evaluate("document.querySelector('#ranking .status').textContent") == "3 of 10 agents"
    page.keyboard.press("ArrowRight")
    assert column(page, ".name bdi") == ["Value iteration, 81 nodes"]
    page.click(".filter [value='']")
    page.click(".find input")
    page.keyboard.insert_text("pUmPing lqr")
    assert column(page, ".name bdi") == ["Energy pumping + LQR"]
    page.keyboard.insert_text(" nothing like it")
    assert column(page, ".name bdi") == []
    assert page.evaluate("document.querySelector('.none').hidden") is False
    page.evaluate("document.querySelector('.find input').select()")
    page.keyboard.insert_text(" ")
    assert len(column(page, ".name bdi")) == 10


def test_intervals_as_pictures(open_page, data):
    page = open_page()

    def ends():
        place = ".ranking tbody tr:nth-child(5) .interval"
        return [float(page.get_attribute(place, end).rstrip("%")) for end in ("x1", "x2")]

    low, high = ends()
    row = data["environments"][0]["rows"][4]
    assert page.evaluate("document.querySelectorAll('.ranking .picture .dot').length") == 10
    width = row["interval"][1] - row["interval"][0]
    assert high - low == pytest.approx(100 * width / 1.1, rel=0.15)
    page.click(".filter [value=near]")
    near_low, near_high = ends()
    assert near_high - near_low > 5 * (high - low)


def test_player(open_page, data):
    page, rows = open_page(), data["environments"][0]["rows"]
    first, second = (rows[i]["replays"][0] for i in (0, 1))
    assert clock(page) == 0.0
    before = page.evaluate("document.querySelector('.scene').toDataURL()")
    page.click(".play")
    assert page.get_attribute(".play", "aria-label") == "Pause"
    until(page, "parseFloat(document.querySelector('.clock').textContent) > 0.32")
    # A page that was hidden, or busy, goes on where it was.
    now = clock(page)
    page.evaluate("() => { for (const end = performance.now() + 1500; performance.now() < end;); }")
    page.wait_for_timeout(50)
    assert clock(page) < now + 1.0
    page.keyboard.press("Space")  # the button has the focus; the clock goes to the nearest whole step
    stopped = clock(page)
    assert 0.3 < stopped < 8.0 and page.get_attribute(".play", "aria-label") == "Play"
    assert page.evaluate("document.querySelector('.scene').toDataURL()") != before

    # Scrubbing sets the time, for both.
    page.fill(".scrub input", "120")
    until(page, "document.querySelector('.clock').textContent.startsWith('2.40 ')")
    for side, replay in enumerate((first, second)):
        assert reading(page, side, "Time") == "2.40 s"
        assert float(reading(page, side, "Action")) == pytest.approx(replay["actions"][119], abs=1e-3)
        assert float(reading(page, side, "Reward")) == pytest.approx(replay["rewards"][119], abs=1e-3)
        assert float(reading(page, side, "Return")) == pytest.approx(sum(replay["rewards"][:120]), abs=1e-2)
        assert float(reading(page, side, "θ").split()[0]) == pytest.approx(replay["states"][120][2], abs=1e-2)

    # By keyboard.
    for key, then in (("ArrowRight", 2.42), ("Shift+ArrowLeft", 2.22), ("End", 10.0), ("ArrowRight", 10.0),
                      ("Home", 0.0)):  # fmt: skip
        page.keyboard.press(key)
        until(page, f"document.querySelector('.clock').textContent.startsWith('{then:.2f} ')")
    page.keyboard.press("Space")
    until(page, "!!document.querySelector('.playing')")
    page.keyboard.press("Space")
    assert not page.evaluate("!!document.querySelector('.playing')")
    until(page, "document.querySelector('#said').textContent.includes('B, iLQR, at ')")

    # Another agent on the right, another episode on the left.
    page.click("tr[data-row='5'] .pick[data-side='1']")
    until(page, "document.querySelector(\"tr[data-row='5'] .pick\").nextSibling.ariaPressed === 'true'")
    pressed = page.evaluate(
        "[...document.querySelectorAll('.pick[aria-pressed=true]')].map(p => p.ariaLabel)"
    )
    assert pressed == ["Watch Value iteration, 81 nodes as A", "Watch Energy pumping + LQR as B"]
    page.select_option(".episode >> nth=0", "1")
    page.evaluate("document.querySelector('.scrub input').focus()")
    page.keyboard.press("End")
    total = f"{rows[0]['replays'][1]['return']:.2f}".replace("-", "−")
    until(page, f"document.querySelector('.readout').textContent.includes('{total}')")


def test_speed_and_loop(open_page):
    page = open_page(incline.Brake.id)
    page.select_option(".speed select", "4")
    page.click(".loop")
    page.click(".play")
    until(page, "parseFloat(document.querySelector('.clock').textContent) > 1.5")
    until(page, "parseFloat(document.querySelector('.clock').textContent) < 1.0")
    assert page.evaluate("!!document.querySelector('.playing')")


def test_pictures_of_the_ranking(open_page):
    page = open_page()
    assert page.evaluate("document.querySelectorAll('#profile .curve').length") == 10
    assert page.evaluate("document.querySelectorAll('#profile .chosen').length") == 5
    assert page.evaluate("document.querySelectorAll('#curves .curve').length") == 6
    told = page.evaluate("document.querySelector('#profile svg').ariaLabel")
    assert "SAC, half of its episodes above 0.96" in told
    page.click(".legend button:nth-child(6)")
    assert page.evaluate("document.querySelectorAll('#profile .chosen').length") == 6
    # The value function and the path over it; another pair of coordinates has none.
    until(page, "document.querySelector('.phase').ariaLabel.endsWith('over the value function')")
    shaded = colours(page, ".phase")
    pairs = page.locator(".pair option").all_inner_texts()
    assert pairs == ["θ [rad], dθ/dt [rad/s]", "s [m], ds/dt [m/s]"]
    page.select_option(".pair select", "1")
    until(page, "document.querySelector('.phase').ariaLabel.startsWith('s [m] against ')")
    assert 100 < colours(page, ".phase") < shaded


def test_hostile_names_stay_names(open_page, tmp_path):
    write_page(board_pages.hostile(), tmp_path)
    page = open_page(root=tmp_path.as_uri())
    for names in (".ranking .name bdi", ".legend bdi"):
        assert page.locator(names).all_text_contents() == [clean(name) for name in HOSTILE]
    assert page.locator(".agent").first.locator("option").count() == len(HOSTILE)
    page.click(".play")
    until(page, "parseFloat(document.querySelector('.clock').textContent) > 0.1")
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert page.evaluate("document.querySelectorAll('.more a, .ranking img').length") == 0
    for width in (320, 1280):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("window.hacked") is None
    page = open_page("index", root=tmp_path.as_uri())
    assert page.evaluate("window.hacked") is None


@pytest.mark.parametrize("scheme", ["light", slow("dark")])
def test_narrow_screen(open_page, scheme):
    for name in ("index", "PivotedBar-v0", cylinder_in_cylinder.Tilt.id):
        page = open_page(name, viewport={"width": 320, "height": 640}, is_mobile=True, color_scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") == 320
    # Cards instead of columns; a list replaces sorting by the column heads.
    page.select_option(".order select", "effort")
    efforts = [float(x.split()[-1]) for x in column(page, "[data-label=Effort]")]
    assert efforts == sorted(efforts)
    for button in (".play", ".step", ".pick"):
        size = page.evaluate(f"Math.min(...['width', 'height'].map("
                       f"k => document.querySelector('{button}').getBoundingClientRect()[k]))")  # fmt: skip
        assert size >= 32, button
    page.set_viewport_size({"width": 1280, "height": 800})
    until(page, "getComputedStyle(document.querySelector('.ranking thead')).display !== 'none'")


WIDTHS = (320, 375, 480, 640, 832, 833, 900, 992, 1024, 1280, 1408, 1409, 1440, 1600, 1920)


def test_ranking_fits_at_every_width(open_page, tmp_path):
    names = ["An agent whose authors gave it a name that goes on and on " * 3, "N" * 120]
    write_page(board_pages.data(agents=[(name, "controller", 0.5) for name in names]), tmp_path)
    for root in (None, tmp_path.as_uri()):
        page = open_page(root=root)
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 800})
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            over = page.evaluate("(() => { const e = document.querySelector('#ranking .scroll');"
                                 "return e.scrollWidth - e.clientWidth; })()")  # fmt: skip
            assert over <= 0, (root, width)


def test_agents_page(open_page):
    page = open_page()
    page.click(".ranking a:has-text('TD3')")
    until(page, "document.querySelector('h1')?.innerText === 'TD3'")
    see_episodes(page)
    page.click(".play")
    until(page, "parseFloat(document.querySelector('.clock').textContent) > 0.1")
    assert page.evaluate("document.querySelectorAll('#curves path').length") >= 3


def test_environments_are_listed_in_a_menu(open_page, data, documented):
    """By keyboard, pointer and without a script; it covers the page instead of moving it, at every width."""
    own, root = cylinder_in_cylinder.Tilt.id, f"{documented}/board"
    page = open_page(own, root, bypass_csp=True)
    top, focus = (
        "document.querySelector('main').getBoundingClientRect().top",
        "document.activeElement.innerText",
    )
    is_open, summary = "document.querySelector('.menu').open", page.locator(".menu summary")
    summary.focus()
    page.keyboard.press("Enter")
    listed = page.locator(".menu .scenes > li").all_inner_texts()
    groups = {type(TASKS[b["id"]]().scene).__name__: b["id"] for b in data["environments"]}
    assert [text.split() for text in listed] == [[scene, env_id] for scene, env_id in sorted(groups.items())]
    assert page.locator(".menu [aria-current=page]").inner_text() == own
    assert serious(page) == []
    page.keyboard.press("Tab")
    assert page.evaluate(focus) == min(groups.items())[1]
    page.keyboard.press("Escape")
    assert not page.evaluate(is_open) and page.evaluate(focus) == "Environments"
    summary.click()
    page.mouse.click(640, 880)
    assert not page.evaluate(is_open)
    summary.click()
    page.keyboard.press("Shift+Tab")
    assert not page.evaluate(is_open), "it does not cover what has the focus"
    for script in (True, False):
        page = open_page(own, root, java_script_enabled=script, is_mobile=True, has_touch=True)
        for width in (320, 768, 1280, 1920):
            page.set_viewport_size({"width": width, "height": 640})
            before = page.evaluate(top)
            assert before < 200
            page.tap(".menu summary")
            assert page.evaluate(f"{is_open} && document.documentElement.scrollWidth") == width
            box = page.locator(".menu .sheet").bounding_box()
            assert page.evaluate(top) == before and box["y"] + box["height"] <= 640
            # The site's links are in the head or, where they would be cut off, in the menu.
            home = page.locator("a:text-is('Home')").all()
            assert sorted(link.is_visible() for link in home) == [False, True]
            assert page.locator(".sheet a:text-is('Home')").is_visible() == (width < 1220)
            if script:
                page.focus(".skip")
                page.keyboard.press("Tab")
                first = page.evaluate("document.activeElement.tagName")
                assert first == ("SUMMARY" if width < 1220 else "A"), "the first in sight"
                page.tap(".menu summary")
            page.tap(".menu summary")
        page.tap(".menu summary")
        page.tap(f".menu a:text-is('{incline.Brake.id}')")
        page.wait_for_url(f"**/{incline.Brake.id}.html")


@pytest.mark.slow
def test_the_picture_moves_unless_the_reader_wants_calm(open_page):
    moved = """new Promise(done => { const c = document.querySelector('.hero canvas');
        const before = c.toDataURL(); setTimeout(() => done(c.toDataURL() !== before), 400); })"""
    page = open_page()
    until(page, "!document.querySelector('.film').hidden")
    assert page.evaluate(moved)
    page.click(".film")
    assert not page.evaluate(moved)
    page = open_page(reduced_motion="reduce")
    until(page, "!document.querySelector('.film').hidden")
    assert not page.evaluate(moved)
    page.click(".film")
    assert page.evaluate(moved)


def test_canvases_out_of_sight_are_skipped_but_keep_their_names(open_page):
    """Otherwise the browser copies all of them with each change of the page."""
    page = open_page()
    skipped = "getComputedStyle(document.querySelector('{}')).contentVisibility === 'hidden'"
    for seen, other in itertools.permutations((".hero canvas", ".traces canvas")):
        page.locator(seen).scroll_into_view_if_needed()
        until(page, f"!({skipped.format(seen)}) && {skipped.format(other)}")
        assert page.get_by_role("img", name="Action and reward over time").count() == 1


def test_the_documentations_choice_of_light_or_dark_is_followed(open_page, documented):
    """By pictures too, and when it changes; if anything else is stored, the system's is."""
    key, root = "/.__palette", f"{documented}/board"
    slate, default = (json.dumps({"color": {"scheme": name}}) for name in ("slate", "default"))

    canvas = "document.querySelector('canvas')"
    look = f"""[getComputedStyle(document.documentElement).colorScheme,
        getComputedStyle(document.body).backgroundColor, {canvas}.toDataURL()]"""
    blank = f"""Object.assign(document.createElement('canvas'),
        {{ width: {canvas}.width, height: {canvas}.height }}).toDataURL()"""

    def looks(page, wanted):
        page.wait_for_timeout(50)  # what will change it has begun to
        return until(page, look, lambda seen: seen == wanted)

    page = open_page("index", root, color_scheme="light")
    until(page, f"{canvas}.toDataURL() !== {blank}")
    light = page.evaluate(look)
    page.emulate_media(color_scheme="dark")
    dark = until(page, look, lambda seen: not set(seen) & set(light))
    assert (light[0], dark[0]) == ("light", "dark")
    rubbish = ("{", "null", "3", '{"color": 1}', '{"color": {"scheme": {}}}')
    for stored, wanted in ((default, light), (slate, dark), (default, light), *((x, dark) for x in rubbish)):
        page.evaluate("([key, value]) => { localStorage[key] = value; dispatchEvent(new Event('storage')); }",
                      [key, stored])  # fmt: skip
        assert looks(page, wanted), stored
    stored = {"origin": documented, "localStorage": [{"name": key, "value": slate}]}
    page = open_page("index", root, color_scheme="light", storage_state={"cookies": [], "origins": [stored]})
    assert looks(page, dark)
    for wanted in (light, dark):
        page.click(".scheme")
        assert looks(page, wanted), "its button is the documentation's"
        scheme = json.loads(page.evaluate("key => localStorage[key]", key))["color"]["scheme"]
        assert scheme == ("default" if wanted is light else "slate")
    early = "(e => !e.defer && !e.async && e.src.includes('/scheme-'))(document.querySelector('head script'))"
    assert page.evaluate(early), "it decides before the first paint"
    page.add_init_script("Object.defineProperty(window, 'localStorage', { get() { throw Error(); } })")
    page.reload()
    assert looks(page, light)


@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        slow("index", "light"),
        slow("PivotedBar-v0", "light"),
        ("PivotedBar-v0", "dark"),
        ("PivotedBar-v0-00000002", "dark"),
    ],
)
def test_axe_finds_nothing_serious(open_page, served, name, scheme):
    page = open_page(name, root=served, color_scheme=scheme, bypass_csp=True)
    if page.query_selector(".begin"):
        page.hover(".begin")  # the pointer changes colours
    assert serious(page) == []


@pytest.mark.parametrize("name", ["index", slow("PivotedBar-v0")])
def test_landmarks_are_told_apart(open_page, served, name):
    from axe_playwright_python.sync_playwright import Axe

    page = open_page(name, root=served, bypass_csp=True)
    options = {"preload": False, "runOnly": ["landmark-unique"]}
    assert Axe().run(page, options=options).response["violations"] == []


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The pages of the repository's board."""
    out = tmp_path_factory.mktemp("whole")
    write_page(board_data(Board(Path(__file__).parents[1] / "leaderboard")), out)
    return out


@pytest.mark.slow
def test_axe_finds_nothing_serious_on_the_whole_board(browser, whole):
    """On every page; for an environment's agents, whose pages are made alike, only on the first one's."""
    pages = {}
    for file in sorted(whole.glob("*.html")):
        of = next((env_id for env_id in TASKS if file.stem.startswith(f"{env_id}-")), file.stem)
        pages.setdefault((of, file.stem == of), file)
    assert len(pages) > len(TASKS)
    page = browser.new_page(bypass_csp=True)
    for file in pages.values():
        page.goto(file.as_uri())
        assert serious(page) == [], file.name


def loaded(browser, url, **network):
    """Return the number of bytes that a page loads, and the milliseconds until it can be read."""
    page, sizes = browser.new_page(), []
    page.on("response", lambda answer: sizes.append(len(answer.body())))
    if network:
        session = page.context.new_cdp_session(page)
        session.send("Network.enable")
        session.send("Network.emulateNetworkConditions", {"offline": False, **network})
    page.goto(url, wait_until="load")
    shown = page.evaluate("performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd")
    page.wait_for_load_state("networkidle")
    page.close()
    return sum(sizes), shown


SIZED = ("index", "PivotedBar-v0", cylinder_in_cylinder.Tilt.id)


@pytest.mark.parametrize("name", every(3, SIZED))
def test_page_is_light_before_anything_is_played(served, browser, name):
    assert loaded(browser, f"{served}/{name}.html")[0] < 300_000


@pytest.mark.slow
def test_every_page_of_the_board_is_light_too(browser, whole):
    """The longest episodes, with up to thousands of steps."""
    for env_id in TASKS:
        assert loaded(browser, (whole / f"{env_id}.html").as_uri())[0] < 300_000, env_id


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZED)
def test_page_can_be_read_soon_on_slow_4g(served, browser, name):
    """1.6 Mbit/s, 150 ms round trip, as in Lighthouse; the best of three, since the machine may be busy."""
    slow = {"latency": 150, "downloadThroughput": 2e5, "uploadThroughput": 1e5}
    assert min(loaded(browser, f"{served}/{name}.html", **slow)[1] for _ in range(3)) < 2_000


def test_what_a_screen_reader_meets(open_page):
    page = open_page()
    tree = page.context.new_cdp_session(page)
    nodes = [n for n in tree.send("Accessibility.getFullAXTree")["nodes"] if not n["ignored"]]
    roles = [n["role"]["value"] for n in nodes]
    for role in ("banner", "navigation", "main", "search", "contentinfo", "status", "slider"):
        assert role in roles, role
    for node in nodes:
        role = node["role"]["value"]
        if role in NAMED:
            assert node["name"]["value"].strip(), node
    assert roles.count("row") == 11 + 3 and roles.count("columnheader") == 8 + 3
    levels = [
        int(x) for x in page.evaluate("[...document.querySelectorAll('h1, h2, h3')].map(e => e.tagName[1])")
    ]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b - a <= 1 for a, b in itertools.pairwise(levels))
    ids = page.evaluate("[...document.querySelectorAll('[id]')].map(e => e.id)")
    assert len(ids) == len(set(ids))
    # The first stop skips the parts common to all pages, and every stop is visible.
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    until(page, "location.hash === '#main'")
    for _ in range(4):
        page.keyboard.press("Tab")
        assert page.evaluate("(e => (e.matches('.choice input') ? getComputedStyle(e.nextElementSibling) :"
                       "getComputedStyle(e)).outlineStyle)(document.activeElement)") != "none"  # fmt: skip


def test_reduced_motion(open_page):
    page = open_page(reduced_motion="reduce")
    page.evaluate("""(() => { window.asked = [];
        Element.prototype.scrollIntoView = function (o) { asked.push(o.behavior); }; })()""")
    page.evaluate("document.querySelector(\"tr[data-row='2'] .pick\").click()")
    assert until(page, "window.asked.length && window.asked") == ["auto"]
    style = "getComputedStyle(document.querySelector('.legend button'))"
    assert page.evaluate(f"{style}.transitionDuration") == "0s"
    assert not page.evaluate("!!document.querySelector('.playing')"), "nothing moves that was not asked to"


def test_on_paper_the_tables_remain(open_page):
    page = open_page(color_scheme="dark")
    page.emulate_media(media="print")
    for part, shown in {"#ranking": True, "#drive": False, "#watch": False, ".pick": False}.items():
        assert page.is_visible(part) == shown, part
    assert page.evaluate("getComputedStyle(document.documentElement).colorScheme") == "light"


def test_without_script_the_tables_remain(open_page):
    page = open_page(java_script_enabled=False)
    assert page.evaluate("document.querySelector('.ranking').innerText").count("\n") > 20
    assert page.evaluate("getComputedStyle(document.querySelector('#watch')).display") == "none"
    assert page.is_visible("#drive .unable"), "old browsers, which cannot read the script, are told too"


def test_served(open_page, served):
    page = open_page(root=served)
    until(page, "document.querySelectorAll('.readout dd').length > 6")
