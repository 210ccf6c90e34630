"""A real browser without a window: what it shows, and what it complains about."""

import base64
import contextlib
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request

import numpy as np
from PIL import Image

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser")
SIZE = (1280, 800)

_OPTIONS = [
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
]


class Page:
    """A page, controlled over the Chrome DevTools Protocol.

    Attributes:
        errors: Errors of its scripts and of its console, in the order that they came.
    """

    def __init__(self, socket):
        self.errors = []
        self._socket, self._numbers = socket, itertools.count(1)
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            self._note(message)
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def _note(self, message):
        method, found = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(found["exceptionDetails"]["text"])
        if method == "Runtime.consoleAPICalled" and found["type"] in ("error", "assert"):
            self.errors.append(str([each.get("value") for each in found["args"]]))
        if method == "Log.entryAdded" and found["entry"]["level"] == "error":
            self.errors.append(found["entry"]["text"])

    def text(self):
        """The words on the page."""
        script = "document.body ? document.body.innerText : ''"
        return self.call("Runtime.evaluate", expression=script)["result"]["value"]

    def picture(self):
        """What the page shows, (H, W, 3) uint8."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.asarray(image.convert("RGB"))

    def wait_until_loaded(self, seconds=60):
        """Waits for the page itself; its scripts have just begun."""
        end = time.monotonic() + seconds
        while True:
            answer = self.call("Runtime.evaluate", expression="location.href + document.readyState")
            state = answer["result"].get("value", "")
            if state.endswith("complete") and not state.startswith("about:"):
                return
            assert time.monotonic() < end, f"not loaded within {seconds} s"
            time.sleep(0.2)

    def wait_for(self, is_there, seconds=120):
        """The first picture that a function is true for."""
        end = time.monotonic() + seconds
        while not is_there(picture := self.picture()):
            assert time.monotonic() < end, f"not shown within {seconds} s: {self.text()}"
            time.sleep(0.5)
        return picture

    def click(self, label):
        """Clicks on the button with a label."""
        find = f"""[...document.querySelectorAll('button')].find(
            each => each.innerText.trim() == {json.dumps(label)}).click()"""
        answer = self.call("Runtime.evaluate", expression=find)
        assert "exceptionDetails" not in answer, answer


@contextlib.contextmanager
def opened(url, folder):
    """Opens an address in a browser whose files go into a new folder."""
    from websockets.sync.client import connect

    profile = folder / "profile"
    command = [PROGRAM, *_OPTIONS, f"--window-size={SIZE[0]},{SIZE[1]}"]
    process = subprocess.Popen(
        [*command, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port = _wait_for_port(profile / "DevToolsActivePort")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=30) as answer:
            (target,) = [each for each in json.load(answer) if each["type"] == "page"]
        with connect(target["webSocketDebuggerUrl"], max_size=None) as socket:
            page = Page(socket)
            page.call("Page.navigate", url=url)
            page.wait_until_loaded()
            yield page
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait_for_port(file, seconds=60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if file.exists() and (lines := file.read_text().split()):
            return int(lines[0])
        time.sleep(0.1)
    raise AssertionError(f"the browser did not start within {seconds} s")
