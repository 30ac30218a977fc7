"""A headless chromium that shows one page, driven by its own DevTools protocol."""

import base64
import contextlib
import io
import json
import shutil
import subprocess
import time

import numpy as np
from PIL import Image


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--no-first-run",
    "--disable-extensions", "--disable-background-networking",
)  # fmt: skip
_FRAMES = """new Promise(done => {
    let left = 3;
    const next = () => left-- > 0 ? requestAnimationFrame(next) : done();
    next();
})"""
PATIENCE = 240  # seconds; a page in software on a busy machine is slow


class Page:
    """A page of the browser.

    - `requests`: all addresses that it has asked for.
    """

    def __init__(self, socket):
        self._socket, self._number, self.requests = socket, 0, []

    def call(self, method, **params):
        """The answer to a command of the protocol."""
        self._number += 1
        message = dict(id=self._number, method=method, params=params)
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("method") == "Network.requestWillBeSent":
                self.requests.append(answer["params"]["request"]["url"])
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, script):
        asked = dict(expression=script, returnByValue=True, awaitPromise=True)
        found = self.call("Runtime.evaluate", **asked)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, script):
        """Waits until a condition of the page is true."""
        end = time.monotonic() + PATIENCE
        while not self.evaluate(script):
            assert time.monotonic() < end, f"{script} was not true in {PATIENCE} s"
            time.sleep(0.1)

    def press_space(self):
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=" ", code="Space")

    def press(self, x, y, *, to=None):
        """Presses the mouse button at a place; drags to another if there is one."""
        mouse = lambda kind, x, y: self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1
        )
        # The page handles what happens within one frame as one event: a short click can
        # be none.
        mouse("mousePressed", x, y)
        self.evaluate(_FRAMES)
        if to is not None:
            for part in (0.5, 1.0):
                mouse("mouseMoved", x + part * (to[0] - x), y + part * (to[1] - y))
                self.evaluate(_FRAMES)
        mouse("mouseReleased", *(to or (x, y)))
        self.evaluate(_FRAMES)

    def picture(self):
        """What is seen in a few frames from now, as an array `(height, width, 3)`."""
        self.evaluate(_FRAMES)
        data = self.call("Page.captureScreenshot", format="png")["data"]
        image = Image.open(io.BytesIO(base64.b64decode(data)))
        return np.asarray(image.convert("RGB")).astype(int)

    def settled(self):
        """What is seen when it does not change any more."""
        end, seen = time.monotonic() + PATIENCE, self.picture()
        while not np.array_equal(seen, seen := self.picture()):
            assert time.monotonic() < end, "the picture does not come to rest"
        return seen


@contextlib.contextmanager
def open_page(file, folder, size):
    """A page with a file, in a window of this size; `folder` is for the browser's own."""
    from websockets.sync.client import connect  # pyright: ignore

    command = [CHROMIUM, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        port, end = folder / "DevToolsActivePort", time.monotonic() + PATIENCE
        while not (port.exists() and port.read_text().count("\n")):
            assert process.poll() is None, "the browser ended"
            assert time.monotonic() < end, "the browser did not start"
            time.sleep(0.1)
        number = port.read_text().split()[0]
        with connect(f"ws://127.0.0.1:{number}{_target(number)}", max_size=None) as socket:
            page = Page(socket)
            for domain in ("Page", "Network", "Runtime"):
                page.call(f"{domain}.enable")
            screen = dict(width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
            page.call("Emulation.setDeviceMetricsOverride", **screen)
            page.call("Page.navigate", url=file.as_uri())
            yield page
    finally:
        process.kill()
        process.wait()


def _target(port):
    """The address of the page in the browser."""
    from urllib.request import urlopen

    with urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
        targets = json.load(answer)
    page = next(x for x in targets if x["type"] == "page")
    return "/" + page["webSocketDebuggerUrl"].split("/", 3)[3]
