"""A browser without a window, driven through its debugging protocol."""

import base64
import itertools
import json
import shutil
import signal
import subprocess
import time
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Pictures are drawn by the processor, and nothing is asked of the network on its own account.
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--disable-backgrounding-occluded-windows",
    "--disable-renderer-backgrounding",
    "--window-size=1280,800",
    "--remote-debugging-port=0",
)


@dataclass(frozen=True)
class Browser:
    """Where a browser listens: its host, and the address for what is of no page."""

    host: str
    browser: str


class Tab:
    """One page of a browser: what it asked for, what it complained of, what it shows."""

    def __init__(self, url: str):
        self._open = ExitStack()
        link = connect(url, max_size=None, compression=None, ping_interval=None)
        self._socket = self._open.enter_context(link)
        self._numbers = itertools.count(1)
        self.requests: list[str] = []  # addresses
        self.errors: list[str] = []  # of the console, and exceptions
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params):
        """Ask the browser something; its events that come meanwhile are noted."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            if "method" in message:
                self._note(message["method"], message["params"])

    def _note(self, method: str, params: dict) -> None:
        if method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(params["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.errors.append(json.dumps(params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"] + " " + params["entry"].get("url", ""))

    def open(self, url: str) -> None:
        """Open an address."""
        self.call("Page.navigate", url=url)

    def value(self, script: str):
        """Value of an expression of JavaScript."""
        told = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return told["result"].get("value")

    @property
    def text(self) -> str:
        """Whatever can be read on the page."""
        return self.value("document.body ? document.body.innerText : ''") or ""

    def wait_for(self, condition: Callable[[str], object], seconds: float = 120.0):
        """Wait until something is true of the page's text; returns what it was."""
        deadline = time.monotonic() + seconds
        while not (found := condition(self.text)):
            assert time.monotonic() < deadline, f"the page says {self.text!r}"
            time.sleep(0.1)
        return found

    def click(self, label: str) -> None:
        """Press the button with this label."""
        self._act(
            f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === "
            f"{json.dumps(label)})",
            "it.click()",
        )

    def choose(self, title: str, value: str) -> None:
        """Choose an entry of the first menu with this title."""
        self._act(
            f"[...document.querySelectorAll('.row')].find(r => r.firstChild.textContent === "
            f"{json.dumps(title)})?.querySelector('select')",
            f"it.value = {json.dumps(value)}; it.onchange()",
        )

    def tick(self, title: str, on: bool) -> None:
        """Set the first box whose title begins so."""
        self._act(
            f"[...document.querySelectorAll('label.tick')].find(l => l.textContent.startsWith("
            f"{json.dumps(title)}))?.querySelector('input')",
            f"if (it.checked !== {json.dumps(on)}) it.click()",
        )

    def _act(self, it: str, act: str) -> None:
        """Do something with an element `it`, which has to be there."""
        assert self.value(f"(() => {{ const it = {it}; if (it) {{ {act} }} return !!it; }})()"), it

    def key(self, name: str) -> None:
        """Press a key."""
        text = {" ": " ", "Enter": "\r"}.get(name)
        given = {"text": text, "windowsVirtualKeyCode": ord(text)} if text else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name, **given)

    def press(self, x: float, y: float, *, shift: bool = False) -> None:
        """Click at a place of the window, pixels."""
        for kind in ("mousePressed", "mouseReleased"):
            given = {"type": kind, "x": x, "y": y, "modifiers": 8 if shift else 0}
            self.call("Input.dispatchMouseEvent", button="left", clickCount=1, **given)

    def picture(self, path: Path) -> np.ndarray:
        """Take a picture of the page, (height, width, 3), and keep it."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))
        return np.asarray(Image.open(path).convert("RGB"))

    def close(self) -> None:
        """Let go of the page."""
        self._open.close()


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """Return where a browser listens."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"needs a browser: none of {', '.join(NAMES)} is installed")
    profile = tmp_path_factory.mktemp("profile")
    process = subprocess.Popen(
        [program, *OPTIONS, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        told = profile / "DevToolsActivePort"
        deadline = time.monotonic() + 120
        while not told.exists() or len(told.read_text().split()) < 2:
            assert process.poll() is None, f"{program} ended with {process.returncode}"
            assert time.monotonic() < deadline, f"{program} does not answer"
            time.sleep(0.05)
        port, path = told.read_text().split()
        yield Browser(f"127.0.0.1:{port}", f"ws://127.0.0.1:{port}{path}")
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(120)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.fixture
def new_tab(chromium):
    """Return a function that opens a page in a tab of its own."""
    tabs = []

    def open_tab(url: str) -> Tab:
        # A window each: a tab behind another is not drawn.
        with connect(chromium.browser) as browser:
            params = {"url": "about:blank", "newWindow": True}
            browser.send(json.dumps({"id": 1, "method": "Target.createTarget", "params": params}))
            name = json.loads(browser.recv(timeout=120))["result"]["targetId"]
        tab = Tab(f"ws://{chromium.host}/devtools/page/{name}")
        tabs.append((tab, name))
        tab.open(url)
        return tab

    yield open_tab
    for tab, name in tabs:
        tab.close()
        urllib.request.urlopen(f"http://{chromium.host}/json/close/{name}", timeout=120).close()
