"""A browser for tests of the page: the system's Chromium, by Playwright, if possible without windows."""

import os
import shutil
import time
import warnings

import pytest

_NAMED = os.environ.get("CHROMIUM")
CHROMIUM = shutil.which(_NAMED or "chromium-headless-shell") or (None if _NAMED else shutil.which("chromium"))
MISSING = (
    "THERE IS NO CHROMIUM, SO NO TEST OF THE LEADERBOARD'S PAGE IN A BROWSER WAS RUN: install chromium, or "
    "name one in the variable CHROMIUM"
)


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        warnings.warn(MISSING, stacklevel=1)
        pytest.skip(MISSING)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        yield browser
        browser.close()


class Pages:
    """Opens pages; in the end they must have met no error and made no request to other hosts."""

    def __init__(self, browser):
        self._browser, self._opened = browser, []

    def open(self, url, root, **options):
        page = self._browser.new_page(**{"viewport": {"width": 1280, "height": 900}} | options)
        wrong = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on(
            "console", lambda said: said.type in ("error", "warning", "assert") and wrong.append(said.text)
        )
        page.on("request", lambda asked: asked.url.startswith((root, "data:")) or wrong.append(asked.url))
        self._opened.append((page, wrong))
        page.goto(url)
        return page

    def close(self):
        for page, wrong in self._opened:
            page.close()
            assert not wrong, wrong


@pytest.fixture
def browsing(browser):
    found = Pages(browser)
    yield found
    found.close()


def until(page, expression, right=bool, wait=60.0):
    """Wait until an expression's value is right, by default true, and return it.

    Playwright's own way uses eval, which the page's rules forbid.
    """
    end = time.monotonic() + wait
    while not right(value := page.evaluate(expression)):
        assert time.monotonic() < end, (expression, value)
        page.wait_for_timeout(20)
    return value


def serious(page):
    """Return the serious findings of axe: rule and place."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page, options={"preload": False}).response["violations"]
    return [(v["id"], v["nodes"][0]["html"]) for v in found if v["impact"] in ("serious", "critical")]
