"""A headless Chromium driven through a pipe by Chrome's DevTools protocol: no driver, no port, no package.

``python -m tests.chromium`` prints which one the tests use, and fails where there is none;
``python -m tests.chromium URL FILE.png [light|dark] [WIDTH] [HEIGHT]`` makes a picture of a page.
"""

import base64
import fcntl
import json
import os
import select
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

NAMES = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
)  # fmt: skip
# Keys that are not characters: key, code, virtual key code.
KEYS = {
    "Tab": 9, "Enter": 13, " ": 32, "End": 35, "Home": 36, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39,
    "ArrowDown": 40,
}  # fmt: skip


class BrowserError(Exception):
    pass


def find():
    """Return the path of a Chromium: that in $CHROMIUM, one on the PATH or one that Playwright installed."""
    if named := os.environ.get("CHROMIUM"):
        return shutil.which(named)
    for name in NAMES:
        if found := shutil.which(name):
            return found
    store = Path(os.environ.get("PLAYWRIGHT_BROWSERS_PATH") or Path.home() / ".cache" / "ms-playwright")
    patterns = ("chromium-*/chrome-linux*/chrome", "chromium_headless_shell-*/*/*headless*shell")
    return next((str(path) for p in patterns for path in sorted(store.glob(p)) if path.is_file()), None)


class Browser:
    """A Chromium with a profile of its own; `close` ends it."""

    def __init__(self, binary, profile, wait=60.0):
        ours_in, theirs_out = _pipe()
        theirs_in, ours_out = _pipe()
        flags = [
            "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
            "--disable-component-update", "--disable-dev-shm-usage", "--no-first-run", "--hide-scrollbars",
            "--force-device-scale-factor=1", "--remote-debugging-pipe", f"--user-data-dir={profile}",
        ]  # fmt: skip
        nothing = [(os.POSIX_SPAWN_OPEN, end, os.devnull, os.O_RDWR, 0) for end in (0, 1, 2)]
        pipes = [(os.POSIX_SPAWN_DUP2, theirs_in, 3), (os.POSIX_SPAWN_DUP2, theirs_out, 4)]
        given = [binary, *flags, "about:blank"]
        self._pid = os.posix_spawn(binary, given, os.environ, file_actions=nothing + pipes)
        os.close(theirs_in)
        os.close(theirs_out)
        self._in, self._out, self._rest, self._last, self._pages = ours_in, ours_out, b"", 0, {}
        try:
            self.send("Browser.getVersion", wait=wait)
        except BrowserError:
            self.close()
            raise

    def send(self, method, parameters=None, session=None, wait=60.0):
        """Call a method and return its result; events that come meanwhile go to their page."""
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters or {}}
        if session:
            message["sessionId"] = session
        try:
            os.write(self._out, json.dumps(message).encode() + b"\0")
        except BrokenPipeError:
            raise BrowserError("Chromium has ended") from None
        end = time.monotonic() + wait
        while True:
            found = self._receive(end, method)
            if found.get("id") == message["id"]:
                if "error" in found:
                    raise BrowserError(f"{method}: {found['error']['message']}")
                return found["result"]

    def _receive(self, end, what):
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(0.0, end - time.monotonic()))
            part = os.read(self._in, 1 << 20) if ready else None
            if not part:
                raise BrowserError(f"Chromium {'has ended' if ready else 'does not answer'}: {what}")
            self._rest += part
        line, _, self._rest = self._rest.partition(b"\0")
        found = json.loads(line)
        if page := self._pages.get(found.get("sessionId")):
            page.happened(found)
        return found

    def open(self, url, width=1280, height=900, media=(), script=True):
        """Open an address in a window of this size and return the page when it has loaded.

        `media` are pairs such as ("prefers-color-scheme", "dark").
        """
        target = self.send("Target.createTarget", {"url": "about:blank"})["targetId"]
        session = self.send("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        page = self._pages[session] = Page(self, session, target)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.send(f"{domain}.enable")
        page.resize(width, height)
        page.send("Emulation.setEmulatedMedia", {"features": [{"name": n, "value": v} for n, v in media]})
        page.send("Emulation.setScriptExecutionDisabled", {"value": not script})
        page.send("Page.navigate", {"url": url})
        page.until("document.readyState === 'complete' && location.href !== 'about:blank'")
        return page

    def close(self):
        os.kill(self._pid, signal.SIGTERM)
        end = time.monotonic() + 10.0
        while os.waitpid(self._pid, os.WNOHANG) == (0, 0):
            time.sleep(0.02)
            if time.monotonic() > end:
                os.kill(self._pid, signal.SIGKILL)
                os.waitpid(self._pid, 0)
                break
        os.close(self._in)
        os.close(self._out)


class Page:
    """A tab: what it asked for in `requests`, what went wrong in `errors`."""

    def __init__(self, browser, session, target):
        self._browser, self._session, self._target = browser, session, target
        self.requests, self.errors = [], []

    def send(self, method, parameters=None):
        return self._browser.send(method, parameters, self._session)

    def happened(self, event):
        kind, given = event.get("method"), event.get("params", {})
        if kind == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])
        elif kind == "Runtime.exceptionThrown":
            details = given["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif kind == "Log.entryAdded" and given["entry"]["level"] in ("error", "warning"):
            self.errors.append(given["entry"]["text"])
        elif kind == "Runtime.consoleAPICalled" and given["type"] in ("error", "warning", "assert"):
            self.errors.append(str([a.get("value") for a in given["args"]]))

    def js(self, expression):
        """Evaluate an expression, awaiting promises, and return its value."""
        found = self.send(
            "Runtime.evaluate", {"expression": expression, "returnByValue": True, "awaitPromise": True}
        )
        if "exceptionDetails" in found:
            details = found["exceptionDetails"]
            raise BrowserError(f"{expression}: {details.get('exception', {}).get('description', details)}")
        return found["result"].get("value")

    def until(self, expression, wait=60.0):
        """Wait until an expression is true."""
        end = time.monotonic() + wait
        while not (value := self.js(expression)):
            if time.monotonic() > end:
                raise BrowserError(f"waited in vain for {expression}; errors: {self.errors}")
            time.sleep(0.02)
        return value

    def resize(self, width, height):
        self.send(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600},
        )

    def click(self, selector):
        """Click with the mouse in the middle of an element, which must be what is hit there."""
        quoted = json.dumps(selector)
        x, y, hit = self.js(f"""(() => {{
            const e = document.querySelector({quoted});
            e.scrollIntoView({{block: "center", behavior: "instant"}});
            const b = e.getBoundingClientRect(), [x, y] = [b.x + b.width / 2, b.y + b.height / 2];
            const hit = document.elementFromPoint(x, y);
            return [x, y, e.contains(hit) || hit.contains(e)];
        }})()""")
        if not hit:
            raise BrowserError(f"{selector} is covered")
        for kind in ("mousePressed", "mouseReleased"):
            at = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1}
            self.send("Input.dispatchMouseEvent", at)

    def key(self, key, shift=False):
        """Press and release a key."""
        given = {"key": key, "code": "Space" if key == " " else key, "windowsVirtualKeyCode": KEYS[key]}
        given |= {"modifiers": 8 if shift else 0}
        words = {"text": " "} if key == " " else {"text": "\r"} if key == "Enter" else {}
        self.send("Input.dispatchKeyEvent", {"type": "keyDown", **given, **words})
        self.send("Input.dispatchKeyEvent", {"type": "keyUp", **given})

    def type(self, text):
        self.send("Input.insertText", {"text": text})

    def picture(self, path, whole=True):
        """Write a screenshot."""
        found = self.send("Page.captureScreenshot", {"format": "png", "captureBeyondViewport": whole})
        Path(path).write_bytes(base64.b64decode(found["data"]))

    def close(self):
        self._browser._pages.pop(self._session, None)
        self._browser.send("Target.closeTarget", {"targetId": self._target})


def _pipe():
    """Return the ends of a pipe that lie above the two that Chromium expects."""
    ends = os.pipe()
    high = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 20) for end in ends)
    for end in ends:
        os.close(end)
    return high


if __name__ == "__main__":
    found = find()
    if found is None or len(sys.argv) < 3:
        print(found or "There is no Chromium.")
        sys.exit(found is None)
    url, file, scheme, width, height = [*sys.argv[1:], *("light", "1280", "900")[len(sys.argv) - 3 :]]
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(found, profile)
        page = browser.open(url, int(width), int(height), [("prefers-color-scheme", scheme)])
        time.sleep(1.0)
        page.picture(file, whole=False)
        browser.close()
