"""Polygons, lines and text become the same pixels as on the leaderboard's page."""

import base64
import io
import math
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from covering import covering
from pictures import TASKS, length, moment, shown

from lag_envs.envs import painting, raster, readout, rendering
from lag_envs.scenes.picture import Picture
from lag_envs.scenes.shapes import Role, round_length, ticks

pygame = pytest.importorskip("pygame")


def test_every_role_has_a_style():
    assert set(painting.STYLES) == set(get_args(Role))


def test_round_lengths_and_ticks():
    assert [round_length(x) for x in (0.03, 0.1, 0.99, 5.0, 40.0)] == pytest.approx(
        [0.02, 0.1, 0.5, 5.0, 20.0]
    )
    assert ticks(-0.25, 0.2, 0.1) == pytest.approx([-0.2, -0.1, 0.0, 0.1, 0.2])


def test_dashes_cover_the_line():
    dashes = list(painting._dashes([(0.0, 0.0), (7.0, 0.0), (7.0, 13.0)], 3.0, 2.0))
    assert sum(length(dash) for dash in dashes) == pytest.approx(3.0 * 4)
    assert dashes[0] == [(0.0, 0.0), (3.0, 0.0)]
    assert dashes[1] == [(5.0, 0.0), (7.0, 0.0), (7.0, 1.0)]


def test_numbers_keep_their_width():
    assert [readout._number(x) for x in (-1.5, 12.345, -419.0)] == ["−1.500", "12.35", "−419.0"]
    assert readout._number(123456.0) == "1.23e+05" and readout._number(math.nan) == "–"


def test_names_are_written_as_on_the_page():
    """The page's rule is in JavaScript; both must split a name alike."""
    script = (Path(painting.__file__).parents[1] / "leaderboard/site/static/site.js").read_text("utf-8")
    assert f"name.match(/{readout.NAME.pattern}/)" in script
    assert readout.name_parts("theta_1_dot") == ("θ", "1", 1)
    for word, letter in re.findall(r'(\w+): "(.)"', re.search(r"const GREEK = \{(.*?)\}", script)[1]):
        assert readout.name_parts(word)[0] == letter


@pytest.mark.parametrize(("size", "least"), [((600, 400), math.inf), ((300, 200), 4), ((150, 100), 2)])
def test_readouts_have_room_for_everything_or_for_the_first_entries(size, least):
    for task in TASKS.values():
        viewer = rendering.Viewer(task, "rgb_array", rendering.Look(readout=True), size)
        now = moment(task)
        groups = viewer._readings(now, 0.0, 0.0, False)
        assert [reading.name for reading in groups[0]][:2] == ["time", "return"]
        written = readout.Readout(groups, size)
        assert len(written._places) >= min(least, sum(map(len, groups)))
        assert written._has_bar or size != (600, 400)
        assert written.height <= max(48, size[1] / 3)
        for row, x, right, after in written._places:
            assert 0 <= x < right < after <= size[0] and 8 + readout.ROW * (row + 1) <= written.height


# --- polygons ---


def test_a_polygon_covers_its_area():
    """The sum over the pixels is the area, exactly except for the rounding to bytes."""
    rng, room = np.random.default_rng(1), np.zeros((60, 92))
    for _ in range(200):
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, 9))
        points = np.stack([45 + 40 * np.cos(angles), 30 + 25 * np.sin(angles)], axis=1)
        image = np.zeros((60, 90, 3), np.uint8)
        colour, at = np.array([[255.0, 255.0, 255.0, 1.0]]), np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
        raster.fill(image, points, np.array([9]), np.array([0]), at, colour, room)
        (x, y), edge = points.T, (image > 0) & (image < 255)
        area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
        assert image[:, :, 0].sum() / 255.0 == pytest.approx(area, abs=0.3)
        assert edge[:, :, 0].sum() < 500 and not room.any()


def test_polygons_are_cut_off_at_the_edges_and_blended():
    room, image = np.zeros((4, 6)), np.full((4, 4, 3), 200, np.uint8)
    points = np.array([(-1e9, -1e9), (1e9, -1e9), (1e9, 1.5), (-1e9, 1.5)])
    at, colour = np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]]), np.array([[0.0, 100.0, 200.0, 0.5]])
    raster.fill(image, points, np.array([4]), np.array([0]), at, colour, room)
    assert image[:, 2].tolist() == [[100, 150, 200], [150, 175, 200], [200, 200, 200], [200, 200, 200]]
    assert not room.any()
    # Beside the image, and without an extent.
    raster.fill(image, points - (0.0, 1e3), np.array([4]), np.array([0]), at, colour, room)
    raster.fill(image, 0.0 * points + 2.0, np.array([4]), np.array([0]), at, colour, room)
    assert image[2:].min() == 200


def test_png_can_be_read(tmp_path):
    frame = shown("PivotedBar-v0")
    (tmp_path / "a.png").write_bytes(raster.png(frame))
    read = pygame.surfarray.array3d(pygame.image.load(tmp_path / "a.png")).swapaxes(0, 1)
    assert np.array_equal(read, frame)


# --- compared with the page ---


def test_colours_and_widths_are_those_of_the_page():
    """`site.js` paints the same shapes in a browser; its style sheet has the colours of light and dark."""
    site = Path(painting.__file__).parents[1] / "leaderboard" / "site" / "static"
    css = (site / "look.css").read_text(encoding="utf-8")
    colour = dict(re.findall(r"--([\w-]+): var\(--light, (#[0-9a-f]{6})\)", css))
    roles = re.search(r"ink\.roles = \{(.*?)\n    \};", (site / "site.js").read_text(encoding="utf-8"), re.S)
    found = {}
    for role, given in re.findall(r"(\w+): \[(.*)\],", roles[1]):
        fill, edge, width, *dash = re.findall(r'get\("([\w-]+)"\)|null|([\d.]+)', given)
        numbers = [float(x[1]) for x in (width, *dash)]
        fills = colour[fill[0]] if fill[0] else None
        found[role] = painting.Style(fills, colour[edge[0]], numbers[0], tuple(numbers[1:]) or None)
    assert found == painting.STYLES


@pytest.fixture(scope="module")
def page(browser):
    """The page's painter in a browser, on an empty page."""
    site = Path(painting.__file__).parents[1] / "leaderboard" / "site" / "static"
    script, count = re.subn(
        r"\n  // --- replays -",
        "\n  window.painter = { paint, placed, windowOf, readColours };\n  // --- replays -",
        (site / "site.js").read_text(encoding="utf-8"),
    )
    assert count == 1
    page = browser.new_page(viewport={"width": 700, "height": 500})
    page.set_content(
        f"<style>{(site / 'look.css').read_text(encoding='utf-8')}</style>"
        "<canvas width=600 height=400></canvas>"
    )
    page.evaluate("text => { try { (0, eval)(text); } catch { /* there is no board */ } }", script)
    yield page
    page.close()


PAINT = """([picture, poses, margin]) => {
  const { paint, placed, windowOf, readColours } = window.painter;
  readColours();
  const pen = document.querySelector("canvas").getContext("2d");
  pen.fillStyle = "#ffffff";
  pen.fillRect(0, 0, 600, 400);
  const box = { x: margin, y: margin, width: 600 - 2 * margin, height: 400 - 2 * margin };
  const view = windowOf(picture, poses);
  paint(pen, box, view, placed(picture, poses, view));
  return document.querySelector("canvas").toDataURL();
}"""


@pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")
@pytest.mark.parametrize("env_id", covering())
def test_pictures_are_those_of_the_page(env_id, page):
    """Both painters, given the same shapes and poses; only roundings at edges differ."""
    from lag_envs.leaderboard.site import scenery

    task = TASKS[env_id]
    now, picture = moment(task), Picture(task)
    by_page = page.evaluate(PAINT, [scenery.picture_data(picture), picture.poses(now), painting.MARGIN])
    png = io.BytesIO(base64.b64decode(by_page.partition(",")[2]))
    by_page = pygame.surfarray.array3d(pygame.image.load(png, "a.png")).swapaxes(0, 1).astype(np.float64)
    apart = np.abs(by_page - rendering.paint(task, now)).max(axis=2)
    assert apart.mean() < 0.4 and np.mean(apart > 64) < 0.001, (apart.mean(), np.mean(apart > 64))
