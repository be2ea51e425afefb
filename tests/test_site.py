"""The leaderboard's page: its files."""

import itertools
import json
import math
import os
import re
import tomllib
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard import standings
from lag_envs.leaderboard.log import BoardError
from lag_envs.leaderboard.site import build as site
from lag_envs.leaderboard.site.build import render, write_page
from lag_envs.leaderboard.site.driving import fuller, sliders
from lag_envs.leaderboard.site.scenery import Scenery, picture_data
from lag_envs.scenes import Pendulum, parameter
from lag_envs.scenes.picture import Picture
from lag_envs.tasks import TASKS, acrobot, cylinder_in_cylinder, incline, pendulum
from tests import board_pages
from tests.board_pages import HOSTILE, clean


@pytest.fixture(scope="module")
def data():
    return board_pages.data()


def unpacked(column, n, unit):
    """Return the numbers of a column."""
    return unit * np.cumsum(np.cumsum(column) if isinstance(column, list) else [column] + [0] * (n - 1))


def test_what_comes_from_submissions_is_escaped():
    pages, files = render(board_pages.hostile())
    for name, text in (pages | files).items():
        if "/site-" in name:
            continue
        assert isinstance(text, str)
        for bad in HOSTILE[:3]:
            assert bad not in text, name
        assert 'href="javascript' not in text and "49{%" not in text
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", pages["PivotedBar-v0.html"], re.DOTALL)
    assert len(scripts) == 2 and not re.search(r"[<>&]", scripts[1])
    assert [row["name"] for row in json.loads(scripts[1])["rows"]] == [clean(name) for name in HOSTILE]
    html = [text for name, text in pages.items() if name.endswith(".html")]
    assert all("script-src 'self' file:;" in text and "unsafe" not in text for text in html)
    ElementTree.fromstring(pages["feed.xml"])


@pytest.mark.parametrize(
    "url", ["javascript:alert(1)", "data:text/html,x", "//example.org", "https://", "https://a b", "file:///etc",
            "https://x\n.org", 'https://x.org/"', " https://x.org", None, 3, "https://[x", "HTTPS//x"],
)  # fmt: skip
def test_addresses_that_are_no_links(url):
    assert site.safe_url(url) is None


def test_numbers_that_json_does_not_have_are_left_out():
    found = board_pages.data((incline.Tilt.id,), board_pages.AGENTS[:2])
    found["environments"][0]["rows"][0] |= {
        "score": math.nan,
        "interval": [math.nan, math.inf],
        "settle": None,
    }
    pages, _ = render(found)
    row = json.loads(re.findall(r'id="data">(.*?)<', pages[f"{incline.Tilt.id}.html"])[0])["rows"][0]
    assert row["score"] is None and row["interval"] == [None, None]


def test_little_is_enough():
    boards = [
        {"id": "Gone-v0", "rows": [], "protocol": 1, "frozen": True},
        {"id": "Gone-v0", "rows": [{"name": "A"}], "protocol": 0, "frozen": True},
        {"id": "../../index", "rows": []},
        {"id": "index", "rows": []},
    ]
    pages, _ = render({"protocol": 1, "made": "today", "environments": boards})
    names = ["-index", "Gone-v0", "Gone-v0-protocol-0", "Gone-v0-protocol-0-A", "index", "index-2"]
    assert sorted(pages) == sorted([*(f"{name}.html" for name in names), "feed.xml"])
    assert "This environment has no ranking" in pages["Gone-v0.html"]
    assert "protocol 0" in pages["Gone-v0-protocol-0.html"]


def test_likeness_of_acts_and_of_names_is_shown():
    found = board_pages.data((incline.Brake.id,))
    rows = found["environments"][0]["rows"]
    like = {"id": f"{incline.Brake.id}-first", "name": "The <first>", "state": "withdrawn"}
    rows[0] |= {"rank": None, "alike": like}
    rows[1] |= {"looks_like": "P\u0420O & co"}
    rows[2] |= {"reference": True}
    pages, _ = render(found)
    page = pages[f"{incline.Brake.id}.html"]
    ranks = re.findall(r'class="rank">([^<]*)<', page)
    assert ranks[0] == "–" and page.count(">acts like") == 1 and page.count("not to be confused with") == 1
    assert 'acts like <span dir="auto">The &lt;first&gt;</span>' in page
    assert "(withdrawn)" in pages[f"{incline.Brake.id}-00000000.html"]
    assert 'confused with <span dir="auto">P\u0420O &amp; co</span>' in page
    assert '<span class="remark">reference<' in page
    index = pages["index.html"]
    assert "9 ranked agents" in index and f"<bdi>{rows[1]['name']}</bdi>" in index  # the best with a rank


def test_agents_have_pages_and_news_are_fed():
    found = board_pages.data((incline.Brake.id,), board_pages.AGENTS[:3])
    for i, row in enumerate(found["environments"][0]["rows"]):
        row |= {"added": f"2026-11-0{i + 1}", "description": "see `lag-envs list` <b>"}
    pages, files = render(found, "https://example.org/board")
    env_id, own = incline.Brake.id, f"{incline.Brake.id}-00000001"
    assert f'href="{own}.html"' in pages[f"{env_id}.html"]
    page = pages[f"{own}.html"]
    for part in ("<bdi>iLQR</bdi></h1>", "0.996",
                 "<bdi>see <code>lag-envs list</code> &lt;b&gt;</bdi>", "Ada Example", 'href="https://example.org/code"',
                 f"lag-envs watch {env_id} --agent leaderboard/submissions/{own}",
                 f'<meta property="og:title" content="iLQR · {env_id} · lag_envs leaderboard">',
                 "Controller: score 0.996, rank 1 of 3. "):  # fmt: skip
        assert part in page, part
    assert len(json.loads(re.findall(r'id="data">(.*?)<', page)[0])["rows"]) == 1
    preview = re.findall(r'og:image" content="https://example.org/board/(assets/[^"]+png)"', page)[0]
    assert files[preview].startswith(b"\x89PNG")
    feed = ElementTree.fromstring(pages["feed.xml"])
    atom = "{http://www.w3.org/2005/Atom}"
    entries = feed.findall(f"{atom}entry")
    assert [e.findtext(f"{atom}updated")[:10] for e in entries] == ["2026-11-03", "2026-11-02", "2026-11-01"]
    assert entries[1].find(f"{atom}link").get("href") == f"https://example.org/board/{own}.html"
    assert "<title>Leaderboard · lag_envs</title>" in pages["index.html"]
    bare, _ = render(found)
    assert "og:image" not in bare[f"{env_id}.html"], "a preview needs a whole address"
    assert f"<id>urn:lag-envs:{own}</id>" in bare["feed.xml"]
    with pytest.raises(ValueError, match="must begin with https:// or http://, got 'javascript:1'"):
        render(found, "javascript:1")


def test_submissions_are_linked_where_their_files_are_public():
    found = board_pages.data((incline.Brake.id,))
    row = found["environments"][0]["rows"][0]
    row |= {"id": "made/by hand", "module": "lag_envs.controllers.basic", "code": None}
    found["environments"][0]["rows"][1] |= {"module": "lag_envs.controllers", "code": None}
    found["environments"][0]["rows"][2] |= {"module": "lag_envs.gone", "code": None}
    main = "https://example.org/main/"
    there, without = "".join(render(found, source=main)[0].values()), "".join(render(found)[0].values())
    for link in ("leaderboard/submissions/made/by%20hand", "src/lag_envs/controllers/basic.py",
                 "src/lag_envs/controllers/__init__.py"):  # fmt: skip
        assert f'href="{main}{link}"' in there and link not in without
    linked = re.findall(f'href="{main}(src/[^"]+)"', there)
    assert len(linked) == 2 and all((site.PACKAGE.parents[1] / link).is_file() for link in linked)


def test_every_agent_of_the_board_has_a_link_to_its_code():
    """Learners and tables by what they say of themselves, unless they name an address."""
    root = site.PACKAGE.parents[1]
    found = [
        tomllib.loads(file.read_text()) for file in root.glob("leaderboard/submissions/*/submission.toml")
    ]
    silent = [told for told in found if "code" not in told and told["policy"]["architecture"] != "controller"]
    assert silent and all(standings.origin(told["authors"], told["description"]) for told in silent)
    assert all((root / site.place_of(module)).is_file() for module in standings.ORIGINS.values())


def test_numbers_of_a_column_line_up():
    found = board_pages.data((incline.Tilt.id,))
    rows = found["environments"][0]["rows"]
    for row, success in zip(rows, (1.0, 0.875, 0.0), strict=False):
        row |= {"success": {"rate": success, "low": success, "high": success}, "settle": success}
    page = render(found)[0][f"{incline.Tilt.id}.html"]
    for column, digits in (("return", 1), ("success", 1), ("settle", 2), ("gap", 3)):
        shown = re.findall(f'<td role="cell" class="{column}"[^>]*>([^<]*)', page)
        ends = {text.partition(".")[2].partition("\N{NO-BREAK SPACE}")[0] for text in shown if text != "–"}
        assert len(shown) == len(rows) and {len(end) for end in ends} == {digits}, (column, shown)


def test_texts_of_records_lose_their_markup():
    """A paragraph with a footnote or emphasis; goals in parts; parameters' names as words."""
    found = board_pages.data((pendulum.PendulumRegret.id,), board_pages.AGENTS[:1])
    board = found["environments"][0]
    board["goal"] = "success: upright throughout; time: until then"
    board["rows"][0]["robustness"] = {"mass_1 -20 %": 0.5, "late by a step": 0.4}
    pages = render(found)[0]
    page, own = (text for name, text in pages.items() if name.startswith(board["id"]))
    page, own = (page, own) if "Ranking" in page else (own, page)
    assert "converse optimality [1])" in page and "<p>[1] J. C. Doyle" in page
    for text in (page, own):
        assert "Here: upright throughout.</dd>" in text and "Here: until success.</dd>" in text
    assert "mass 1, −20 %" in own and "actions a step late" in own


def test_frozen_boards_stand_apart():
    found = board_pages.data((incline.Brake.id,))
    old = found["environments"][0] | {"frozen": True, "protocol": 1}
    found = found | {"protocol": 2, "environments": [found["environments"][0] | {"protocol": 2}, old]}
    pages, _ = render(found)
    index = pages["index.html"]
    assert index.count('class="card"') == 1
    assert f'href="{incline.Brake.id}-protocol-1.html">{incline.Brake.id}, protocol 1<' in index
    assert "protocol-1.html" not in pages[f"{incline.Brake.id}.html"]
    assert "frozen, protocol 1" in pages[f"{incline.Brake.id}-protocol-1.html"]
    titles = [re.search("<title>(.*?)</title>", text)[1] for text in pages.values()]
    assert len(set(titles)) == len(titles) > 4


def test_episodes_are_written_as_columns():
    for env_id in (incline.Tilt.id, cylinder_in_cylinder.Pump.id, "PivotedBar-v0"):
        task, replay = TASKS[env_id](), board_pages.replay(env_id, 0)
        found, n, units = (
            Scenery(env_id).episode(replay),
            len(replay["states"]),
            picture_data(Picture(task))["units"],
        )
        assert found["steps"] == n - 1 and found["label"] == "median"
        states = np.stack([unpacked(c, n, found["unit"]) for c in found["states"]], -1)
        np.testing.assert_allclose(states, replay["states"], atol=0.6e-4)
        returns = unpacked(found["returns"], n, found["unit"])
        np.testing.assert_allclose(returns[1:], np.cumsum(replay["rewards"]), atol=0.6e-4)
        controls = task.wanted(replay["actions"])
        poses = Picture(task).episode(replay["states"], controls, replay["target"], task.dt)
        for frame, numbers in enumerate(found["poses"]["frames"]):
            for i, c in enumerate(numbers):
                values = unpacked(found["poses"]["columns"][c], n, units[i])
                np.testing.assert_allclose(values, poses[:, frame, i], atol=0.6 * units[i])
        assert len(json.dumps(found)) < 1.4 * len(json.dumps(replay))


def test_a_page_shows_the_scene_of_its_environment(data):
    page = render(data)[0]["PivotedBar-v0.html"]
    shown = json.loads(re.findall(r'id="data">(.*?)<', page)[0])
    assert shown["title"] and shown["picture"]["shapes"] and shown["dt"] == 0.02


def test_episodes_that_cannot_be_drawn_are_kept():
    replay = {"states": [[0.0]], "actions": [], "rewards": [], "target": None}
    for env_id in ("Gone-v0", "PivotedBar-v0"):
        found = Scenery(env_id).episode(replay)
        assert found["poses"] is None and found["steps"] == 0 and found["states"] == [0]
    odd = {"states": [[0.0], [None], [2.0]], "actions": [None, 1.0], "rewards": [1.0, None], "target": None}
    found = Scenery("Gone-v0").episode(odd)
    assert found["states"] == [[0, 0, 20000]]
    assert unpacked(found["returns"], 3, 1e-4) == pytest.approx([0.0, 1.0, 1.0])


def files_of(folder):
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def test_build_again_leaves_nothing_behind_and_nothing_else_away(data, tmp_path):
    write_page(data, tmp_path)
    (tmp_path / "CNAME").write_text("example.org")
    first = files_of(tmp_path)
    write_page(data, tmp_path)
    assert files_of(tmp_path).keys() == first.keys()
    assert all(t == first[n] for n, t in files_of(tmp_path).items() if n.startswith("assets/"))
    write_page({**data, "environments": data["environments"][:1]}, tmp_path)
    left = files_of(tmp_path)
    assert f"{incline.Brake.id}.html" not in left and "CNAME" in left
    assert sum(name.startswith("assets/") for name in left) == 5 + len(board_pages.AGENTS)


def test_a_folder_with_other_files_is_refused(data, tmp_path):
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(BoardError, match="holds other things, such as index"):
        write_page(data, tmp_path)
    (tmp_path / "site.json").write_text("{")
    with pytest.raises(BoardError, match="cannot be read"):
        write_page(data, tmp_path)
    (tmp_path / "site.json").write_text('{"files": ["../precious.html", "index.html"]}')
    (tmp_path.parent / "precious.html").write_text("mine")
    write_page(data, tmp_path)
    assert (tmp_path.parent / "precious.html").exists()


@pytest.mark.slow
def test_a_kill_at_any_moment_leaves_whole_pages(tmp_path, monkeypatch):
    small = board_pages.data(("PivotedBar-v0", incline.Brake.id), board_pages.AGENTS[:1])
    other = board_pages.data((incline.Brake.id, cylinder_in_cylinder.Tilt.id), board_pages.AGENTS[1:2])
    write_page(other, tmp_path / "whole")

    def scripts(folder):
        return sorted(file.relative_to(folder) for file in folder.rglob("*.js"))

    real = os.replace
    for moment in itertools.count():
        out = tmp_path / str(moment)
        write_page(small, out)
        left = moment

        def replace(*names):
            nonlocal left
            if left == 0:
                raise KeyboardInterrupt
            left -= 1
            real(*names)

        monkeypatch.setattr(os, "replace", replace)
        try:
            write_page(other, out)
            finished = True
        except KeyboardInterrupt:
            finished = False
        monkeypatch.setattr(os, "replace", real)
        for page in out.glob("*.html"):
            text = page.read_text("utf-8")
            assert text.endswith("</html>")
            for name in re.findall(r"assets/[\w-]+\.(?:js|css)", text):
                assert (out / name).exists(), (moment, page.name, name)
        write_page(other, out)
        assert not list(out.rglob("*.part"))
        assert scripts(out) == scripts(tmp_path / "whole"), "what a killed build left is removed by the next"
        if finished:
            break
    assert moment > 5


def test_nothing_in_the_page_is_from_elsewhere():
    for path in site.STATIC.iterdir():
        found = re.findall(r"https?://[^\s\"')]+|@import|url\(", path.read_text("utf-8"))
        assert set(found) <= {"http://www.w3.org/2000/svg"}, path


def test_a_finger_that_drives_selects_no_text_in_safari_either():
    """Safari knows the property only by its own name."""
    text = (site.STATIC / "site.css").read_text("utf-8")
    assert text.count("-webkit-user-select: none; user-select: none;") == text.count(" user-select:") > 0


def luminance(colour):
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts]
    return np.dot([0.2126, 0.7152, 0.0722], linear)


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_contrast(theme):
    text = (site.STATIC / "look.css").read_text("utf-8")
    found = re.findall(r"--([\w-]+): var\(--light, (#\w{6})\) var\(--dark, (#\w{6})\);", text)
    colours = {name: both[theme] for name, *both in found}

    def contrast(a, b):
        high, low = sorted((luminance(colours[a]), luminance(colours[b])), reverse=True)
        return (high + 0.05) / (low + 0.05)

    for back in ("paper", "card", "hair"):
        for name in ("ink", "soft", "link", "accent"):
            assert contrast(name, back) >= 4.5, (name, back)
        for i in range(8):
            assert contrast(f"c{i}", back) >= 3.0, (i, back)
    for name in ("body-edge", "target", "limit", "accent", "frame-edge"):
        assert contrast(name, "stage") >= 3.0, name
    for i in range(8):
        assert contrast(f"c{i}", "paper") >= 4.5, f"letters on c{i}"


@pytest.mark.parametrize(
    "kind, names",
    [
        (incline.Brake, ["mass", "radius", "damping", "tilt", "gravity"]),
        (
            cylinder_in_cylinder.Tilt,
            ["mass", "shell_radius", "radius", "damping", "gravity", "control limit"],
        ),
        # Without rotor inertia the gear ratio has no effect.
        (
            acrobot.AcrobotExact,
            [
                *("mass_1", "mass_2", "length_1", "length_2", "inertia_1", "inertia_2"),
                *("damping", "dry_friction", "rotor_inertia", "gravity"),
            ],
        ),
    ],
)
def test_parameters_that_the_script_follows_have_sliders(kind, names):
    assert [slider["name"] for slider in sliders(kind, Unfused(kind()))] == names


class SoftPendulum(Pendulum):
    """With a parameter in a denominator, and one of a unit that is none."""

    softness: float = parameter(0.0, "1", least=0.0)
    colour: float = parameter(0.0, "hue", least=0.0)

    def potential(self, q, xp):
        return super().potential(q, xp) / (1.0 + self.softness) - self.colour * xp.cos(q.theta)


class Softened(pendulum.PendulumExact):
    id = "Softened-v0"
    scene = SoftPendulum


def test_parameters_that_are_0_go_up_from_there():
    """To a tenth of what mass, length and gravity give for their unit; unless a formula divides by them."""
    found = {slider["name"]: slider for slider in sliders(Softened, Unfused(Softened()))}
    assert [name for name, slider in found.items() if "most" in slider] == ["damping"]
    assert found["damping"]["value"] == 0.0
    assert found["damping"]["most"] == pytest.approx(0.1 * 1.0 * 1.0**2 * math.sqrt(10.0 / 1.0))
    assert "softness" not in found and "colour" not in found
    assert fuller(incline.Tilt) == (None, {})


@pytest.mark.slow
def test_a_plain_number_has_no_unit():
    kind = acrobot.AcrobotReal
    units = {slider["name"]: slider["unit"] for slider in sliders(kind, Unfused(kind()))}
    assert units["gear_ratio"] == "" and units["gravity"] == "m/s²"
