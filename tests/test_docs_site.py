"""The documentation's site: it builds, makes no request to other hosts, and has no broken links."""

import os
import posixpath
import re
from html import escape, unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

import pytest
import yaml
from browsers import serious, until
from fontTools.ttLib import TTFont
from mkdocs.commands.build import build
from mkdocs.config import load_config

from lag_envs.mechanics.recording import parameter_names
from lag_envs.scenes import SCENES
from lag_envs.tasks import TASKS, acrobot, chain
from tools.docs import equations
from tools.docs.font import CHARACTERS, FILE

ROOT = Path(__file__).parents[1]
#: Attributes by which a page loads something; other elements with an address only link to it.
LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}
#: Relations of a `link` that load nothing.
NAMED = {"canonical", "next", "prev", "alternate"}

pytestmark = [
    pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM"),
    # MkDocs and its plugins are third-party code.
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


class Page(HTMLParser):
    """The resources that a page loads, its links, and its anchors."""

    def __init__(self, text):
        super().__init__()
        self.loads, self.links, self.anchors = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.anchors |= {found[key] for key in ("id", "name") if found.get(key)}
        address = found.get(LOADED.get(tag, ""))
        if address and not NAMED & set(found.get("rel", "").split()):
            self.loads.append(address)
        if tag == "a" and found.get("href"):
            self.links.append(found["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the site as `make docs` does; that takes long, so only its links are checked each time."""
    folder = tmp_path_factory.mktemp("docs")
    os.environ["NO_MKDOCS_2_WARNING"] = "1"
    config = load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder), strict=True)
    config.plugins.on_startup(command="build", dirty=False)
    build(config)
    return folder


@pytest.fixture(scope="module")
def pages(site):
    found = {path.relative_to(site).as_posix(): path for path in site.rglob("*.html")}
    del found["404.html"]  # its addresses depend on the host
    return {name: Page(path.read_text("utf-8")) for name, path in found.items()}


@pytest.mark.slow
def test_every_page_is_there(site, pages):
    for env_id in TASKS:
        assert {f"environments/{env_id}.html", f"board/{env_id}.html"} <= set(pages)
    assert {"index.html", "scenes.html", "api/scenes.html", "board/index.html", "changelog.html"} <= set(
        pages
    )
    scenes = (site / "scenes.html").read_text("utf-8")
    assert all(f'id="{kind.__name__.lower()}"' in scenes and "<math" in scenes for kind in SCENES)
    # Most public objects have a docstring, and these are in the reference.
    reference = (site / "api" / "tasks.html").read_text("utf-8")
    for path in [*site.glob("api/*.html"), *site.glob("environments/*.html")]:
        assert not re.search(r"::</p>|\[\d\]_|<p>\.\. \[|\w<em>", path.read_text("utf-8")), path
    assert "Return the reward of a step of" in reference and "numbers by name, in order" in reference


@pytest.mark.slow
def test_minus_signs_and_pictures_of_a_long_page(site):
    text = (site / "agents.html").read_text("utf-8")
    assert "random actions −1266.5" in text and "gravity −20 %" in text
    article = text.partition("<article")[2]
    assert article.count("<img ") - article.count('<img loading="lazy" ') == 1


@pytest.mark.slow
def test_titles_and_previews(site, pages):
    """Each page has a title of its own, and says what a shared link shows."""
    texts = {name: (site / name).read_text("utf-8") for name in pages}
    titles = {name: re.search("<title>(.*?)</title>", text)[1] for name, text in texts.items()}
    address = yaml.safe_load(text_of("mkdocs.yml"))["site_url"]
    docs = [title for name, title in titles.items() if not name.startswith("board/")]
    assert len(set(docs)) == len(docs) > 50
    assert titles["index.html"] == "Lagrangian mechanics as Gymnasium environments - lag_envs"
    for name, text in texts.items():
        for what in ("title", "description"):
            assert text.count(f'<meta property="og:{what}"') == 1, name
        (url,) = re.findall(f'og:url" content="{address}(.*?)"', text)
        assert url.removesuffix("index.html") == name.removesuffix("index.html")
        (picture,) = re.findall(f'og:image" content="{address}(.*?)"', text)
        assert (site / picture).is_file() and text.count('<meta name="twitter:card"') == 1, name
    told = {
        name: re.search('<meta name="description" content="(.*?)">', text)[1] for name, text in texts.items()
    }
    own = [about for name, about in told.items() if not name.startswith("board/")]
    assert len(set(own)) == len(own) and all(20 < len(about) < 300 for about in own)
    for env_id in TASKS:
        head = texts[f"environments/{env_id}.html"].partition("</head>")[0]
        assert f'og:description" content="{escape(TASKS[env_id].__doc__.partition(chr(10))[0])}"' in head


@pytest.mark.slow
def test_lists_of_pages(site):
    """Sitemap and feed name the board, and a page that is missing leads home."""
    places = (site / "sitemap.xml").read_text("utf-8")
    for name in ("index.html", "board/index.html", *(f"board/{env_id}.html" for env_id in TASKS)):
        assert places.count(f"/lag-envs/{name}</loc>") == 1, name
    ElementTree.fromstring(places)
    feed = ElementTree.parse(site / "board" / "feed.xml")
    (itself,) = feed.iterfind("{*}link[@rel='self']")
    assert itself.get("href").endswith("/lag-envs/board/feed.xml")
    missing = (site / "404.html").read_text("utf-8")
    assert "To the home page</a>" in missing and "<title>Page not found - lag_envs</title>" in missing


def links_in(text, name, start, end):
    """Return (title, target) of the links in a part of a page; targets are paths in the site."""
    part = text.partition(start)[2].partition(end)[0]
    found = re.findall(r'<a href="([^"]*)"[^>]*>\s*(?:<span[^>]*>\s*)?([^<]*?)\s*<', part)
    return [(title, posixpath.normpath(posixpath.join(posixpath.dirname(name), at))) for at, title in found]


@pytest.mark.slow
def test_one_navigation(site, pages):
    """The same links in the same order in the heads of all pages, and in the menu of narrow screens."""
    tabs = ("md-tabs__list", "</ul>")
    sections = links_in((site / "index.html").read_text("utf-8"), "index.html", *tabs)
    assert [title for title, _ in sections] == [
        next(iter(entry)) for entry in yaml.safe_load(text_of("mkdocs.yml"))["nav"]
    ]
    assert ("Leaderboard", "board/index.html") in sections
    env_id = next(iter(TASKS))
    for name in ("accuracy.html", f"environments/{env_id}.html"):
        assert links_in((site / name).read_text("utf-8"), name, *tabs) == sections
    guides = links_in((site / "drive.html").read_text("utf-8"), "drive.html", "<body", "</body>")
    agent = next(name for name in pages if name.startswith(f"board/{env_id}-"))
    for name in ("board/index.html", f"board/{env_id}.html", agent):
        text = (site / name).read_text("utf-8")
        for where in ("wide", "narrow"):
            (place,) = re.findall(f'class="site {where}".*?</ul>', text, re.DOTALL)
            assert links_in(place, name, "<ul>", "</ul>") == sections
            assert re.findall(r'href="([^"]*)" aria-current', place) == ["index.html"], (
                "the section is marked"
            )
            own = links_in(text, name, f'class="leaderboard {where}"', "</ul>")
            assert [link for link in dict.fromkeys(guides) if link in own] == own
            assert own[0] == ("Board", "board/index.html") and len(own) == 5
    assert "../environments/../leaderboard.html" in pages["board/index.html"].links  # how to submit


def text_of(name):
    return re.sub(r"!!python\S+", "", (ROOT / name).read_text("utf-8"))


@pytest.mark.slow
def test_nothing_comes_from_another_host(site, pages):
    for name, page in pages.items():
        for address in page.loads:
            assert not urlsplit(address).netloc, (name, address)
    for path in site.rglob("*.css"):
        for address in re.findall(r"url\(([^)]*)\)|@import\s+([^;]+)", path.read_text("utf-8")):
            assert not re.match(r"[\"']?(https?:)?//", "".join(address)), (path.name, address)


def test_links_lead_somewhere(site, pages):
    for name, page in pages.items():
        for link in [*page.links, *page.loads]:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (site / name).parent / unquote(parts.path) if parts.path else site / name
            assert target.is_file(), (name, link)
            place = target.resolve().relative_to(site.resolve()).as_posix()
            if parts.fragment and place in pages and not place.startswith("board/"):
                assert unquote(parts.fragment) in pages[place].anchors, (name, link)


@pytest.mark.slow
def test_what_is_bundled_is_noticed(site):
    """NOTICE.md covers each third-party script, style and font."""
    notice = (ROOT / "NOTICE.md").read_text("utf-8")
    own_files = {"docs.css", "docs.js"}
    for path in [*site.rglob("*.js"), *site.rglob("*.css")]:
        place = path.relative_to(site)
        if place.parts[0] in ("board", "search") or path.name in own_files:
            continue
        assert place.parts[0] == "assets", place
    for name in ("Material for MkDocs", "iframe-worker", "lunr", "RxJS", "clipboard.js", "Icons", "STIX"):
        assert name in notice
    (font,) = [path for kind in ("woff*", "ttf", "otf") for path in site.rglob(f"*.{kind}")]
    assert font == site / FILE and font.stat().st_size < 100_000
    assert "Open Font License" in TTFont(font)["name"].getDebugName(13)


@pytest.mark.slow
def test_formulas_are_whole(site):
    """Each element has the required number of parts, and each formula includes its LaTeX."""
    parts = {"msup": 2, "msub": 2, "mfrac": 2, "mover": 2, "munder": 2, "msubsup": 3, "munderover": 3}
    found = []
    written = ("numerics.html", "engine.html", "physics.html", "scenes.html")
    for name in (*written, *(f"environments/{env_id}.html" for env_id in TASKS)):
        text = (site / name).read_text("utf-8")
        wide = re.findall('<div class="equation".*?</div>', text, re.DOTALL)
        alone = re.findall(
            r"<math.*?</math>", re.sub('<div class="equation".*?</div>', "", text, flags=re.DOTALL)
        )
        assert all(one.count("</annotation>") == 1 for one in (*wide, *alone))
        assert wide and "$$" not in text, name
        found += [*alone, *(part for one in wide for part in re.findall(r"<math.*?</math>", one, re.DOTALL))]
    assert len(found) > 3 * len(TASKS)
    assert r"\\frac" not in (site / "search" / "search_index.json").read_text("utf-8"), "LaTeX is not found"
    shown = unescape(re.sub("<annotation.*?</annotation>|<[^>]*>", "", "".join(found)))
    assert {x for x in shown if not x.isspace()} <= {*CHARACTERS}
    for formula in map(ElementTree.fromstring, found):
        elements = [(element.tag.rpartition("}")[2], element) for element in formula.iter()]
        assert all(len(element) == parts.get(tag, len(element)) for tag, element in elements)


def test_symbols_are_those_of_the_docstrings():
    for kind in SCENES:
        symbols = [equations.symbol(kind, name) for name in parameter_names(kind())]
        assert len(set(symbols)) == len(symbols), kind
        assert not any("mathrm" in symbol for symbol in symbols), kind


def test_pages_are_published_only_when_switched_on():
    jobs = yaml.safe_load(text_of(".github/workflows/pages.yml"))["jobs"]
    assert jobs["publish"]["if"] == "vars.PAGES == 'true'" and jobs["publish"]["needs"] == "build"


# --- in a browser, from files, without a server ---


@pytest.mark.slow
def test_in_a_browser(site, browser):
    """No page requests anything outside its folder, search works offline, and pages fit a narrow screen."""
    asked = []
    page = browser.new_page(viewport={"width": 320, "height": 800})
    page.on("request", lambda r: asked.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
    page.on("pageerror", lambda error: asked.append(str(error)))
    env_id = next(iter(TASKS))
    formulas = ("numerics", "engine", "physics")
    for name in ("index", f"environments/{env_id}", "scenes", "accuracy", "api/scenes", *formulas):
        page.goto(f"{site.as_uri()}/{name}.html")
        assert page.evaluate("document.documentElement.scrollWidth") <= 320, name
    page.set_viewport_size({"width": 1280, "height": 900})
    page.goto(f"{site.as_uri()}/index.html")
    page.get_by_role("textbox", name="Search").fill("truncation bound")
    page.locator(".md-search-result__item").first.wait_for(timeout=20_000)
    page.keyboard.press("Tab")  # leaves the search, past what can no longer be seen
    assert page.evaluate("document.activeElement.innerText") == "Home"
    assert not asked


@pytest.mark.slow
def test_documentation_and_board_share_their_head(site, browser):
    """Its parts have the same places, colours and fonts, and the choice of light or dark holds on both."""
    parts = [
        (".md-header .md-ellipsis", ".brand b"),
        (".md-header .md-logo img", ".brand img"),
        (".md-header__option label:not([hidden]) svg", ".scheme svg"),
        *((f".md-tabs__item:nth-child({i}) a", f".site.wide li:nth-child({i}) a") for i in (1, 4, 8)),
    ]
    looks = """[document.body, document.querySelector('h1')].flatMap((e) => {
        const look = getComputedStyle(e);
        return [look.color, look.fontFamily, look.fontWeight];
    }).concat(getComputedStyle(document.body).backgroundColor)"""
    scheme = """[getComputedStyle(document.documentElement).colorScheme,
        getComputedStyle(document.body).backgroundColor]"""
    left = "(e) => e.getBoundingClientRect().left + parseFloat(getComputedStyle(e).paddingLeft)"
    page = browser.new_page()
    for width in (1280, 1920):
        page.set_viewport_size({"width": width, "height": 900})
        seen, places = [], []
        for name, selectors in zip(("accuracy", "board/index"), zip(*parts, strict=True), strict=True):
            page.goto(f"{site.as_uri()}/{name}.html")
            seen.append(page.evaluate(looks))
            places.append([page.locator(selector).first.evaluate(left) for selector in selectors])
            page.evaluate("scrollTo({ top: 400, behavior: 'instant' })")
            assert page.evaluate("document.querySelector('header').getBoundingClientRect().bottom") <= 0.0
        assert seen[0] == seen[1]
        assert places[0] == pytest.approx(places[1], abs=1.0)
    for name, button in (("board/index", ".scheme"), ("index", "label[title=Light]")):
        page.goto(f"{site.as_uri()}/{name}.html")
        page.click(button)
        schemes = []
        for there in ("index", "board/index"):
            page.goto(f"{site.as_uri()}/{there}.html")
            schemes.append(page.evaluate(scheme))
        assert schemes[0] == schemes[1] and (schemes[0][1] != seen[0][-1]) == (name == "board/index")
    page.close()


#: Words of code in tables that are broken in two.
BROKEN = r"""[...document.querySelectorAll('td code')].flatMap(({ firstChild: text }) => {
    if (text?.nodeType !== 3) return [];
    const top = (i) => {
        const range = document.createRange();
        range.setStart(text, i);
        range.setEnd(text, i + 1);
        return range.getBoundingClientRect().top;
    };
    const places = [...text.data].keys();
    const word = (i) => /\w\w/.test(text.data.slice(i, i + 2));
    return [...places].some((i) => word(i) && top(i + 1) > top(i) + 4) ? [text.data] : [];
})"""


@pytest.mark.slow
def test_code_and_formulas_are_readable(site, browser):
    """Tables keep the words of code whole, and only single terms are wider than the page."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    pages = [f"environments/{kind.id}" for kind in (chain.SwingUpTriple, acrobot.AcrobotReal)]
    for name in [*pages, "physics"]:
        page.goto(f"{site.as_uri()}/{name}.html")
        assert page.evaluate(BROKEN) == [], name
        widths = page.evaluate(
            "[...document.querySelectorAll('.equation')].map((e) => e.scrollWidth / e.clientWidth)"
        )
        assert max(widths, default=0.0) < 1.2, name
    page.close()


@pytest.mark.slow
def test_figures_suit_narrow_screens_and_the_dark(site, browser):
    """A wide figure scrolls by keyboard; in the dark none is white, and maps keep their colours."""
    page = browser.new_page(viewport={"width": 320, "height": 700}, color_scheme="dark")
    page.goto(f"{site.as_uri()}/accuracy.html")
    figure = page.locator(".figure").first
    until(page, "document.querySelector('.figure').tabIndex", lambda stop: stop == 0)
    assert figure.locator("img").bounding_box()["width"] > 600
    assert page.evaluate("document.documentElement.scrollWidth") == 320
    figure.focus()
    page.keyboard.press("ArrowRight")
    until(page, "document.querySelector('.figure').scrollLeft > 0")
    look = "(image) => [getComputedStyle(image).filter, getComputedStyle(image).mixBlendMode]"
    assert figure.locator("img").evaluate(look) == ["invert(1) hue-rotate(180deg)", "screen"]
    for name in ("stability-damping", "extreme-cases-map"):
        assert page.locator(f"img[src*='{name}']").first.evaluate(look) == ["brightness(0.8)", "normal"]
    page.goto(f"{site.as_uri()}/index.html")
    assert page.locator(".moving img").evaluate(look)[1] == "screen"
    page.emulate_media(media="print")
    assert page.locator(".moving img").evaluate(look) == ["none", "normal"]
    assert not page.is_visible(".moving button")
    page.close()


@pytest.mark.slow
def test_menu_of_narrow_screens_by_keyboard(site, browser):
    """It opens and closes, and while it is open or closed, the focus only goes to what is in sight."""
    page = browser.new_page(viewport={"width": 320, "height": 700}, reduced_motion="reduce")
    page.goto(f"{site.as_uri()}/accuracy.html")
    name = "document.activeElement.ariaLabel || document.activeElement.innerText.trim()"
    seen = """(e => {
        const { left, top, width, height } = e.getBoundingClientRect();
        const there = document.elementFromPoint(left + width / 2, top + height / 2);
        return e.contains(there) || there?.contains(e);
    })(document.activeElement)"""

    def stops(count):
        found = []
        for _ in range(count):
            page.keyboard.press("Tab")
            page.wait_for_timeout(300)  # what is in sight only while it has the focus moves in
            tag = page.evaluate("document.activeElement.tagName")
            assert tag == "INPUT" or page.evaluate(seen), page.evaluate(name)
            found.append(page.evaluate(name))
        return found

    is_open = "document.getElementById('__drawer').checked"
    assert stops(2) == ["Skip to content", "Menu"]
    stops(4)
    page.reload()
    stops(2)
    page.keyboard.press("Enter")
    until(page, is_open)
    found = stops(6)
    assert {"Accuracy", "Accuracy in detail", "Speed"} <= set(found) and "Numerics" not in found
    page.keyboard.press("Escape")
    until(page, f"!{is_open}")
    assert page.evaluate(name) == "Menu"
    page.keyboard.press("Space")
    until(page, is_open)
    page.close()


@pytest.mark.slow
def test_pictures_can_stand_still(site, browser):
    for motion in ("reduce", "no-preference"):
        page = browser.new_page(reduced_motion=motion)
        page.goto(f"{site.as_uri()}/environments/{next(iter(TASKS))}.html")
        shown = "document.querySelector('.moving img').currentSrc"
        label = "document.querySelector('.moving button').textContent"
        for still in (motion == "reduce", motion != "reduce"):
            until(page, f"{shown}.endsWith('-still.webp') === {str(still).lower()}")
            assert page.evaluate(label) == ("Play the picture" if still else "Pause the picture")
            page.click(".moving button")
        page.close()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_axe_finds_nothing_serious(site, browser, scheme, width):
    """On every page but 404.html, which finds its style on the published site only; of a kind, on one."""
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    names = [f"environments/{next(iter(TASKS))}", "environments/index", "api/controllers"]
    for name in [*sorted({file.stem for file in site.glob("*.html")} - {"404"}), *names]:
        page.goto(f"{site.as_uri()}/{name}.html")
        # Wide tables get their tab stop after the page has been laid out.
        page.wait_for_timeout(500)
        assert serious(page) == [], name
    page.close()
