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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.drives import the_scene, the_sweeps, write_set
from tests.spirals import WET, spiral, spiral_view
from websockets.sync.client import connect

from lidarfiles.datasets.job_table import JobRow
from lidarpool.pages.downloads import downloads
from lidarpool.pages.job_list import JobList
from lidarpool.pages.live_page import LivePage, live_page
from lidarpool.run.progress import Progress
from lidarview.viewer.server import page_server
from lidarview.viewer.sharing import render_page

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
    # Sites of others, and an address of a network, which is not loopback for the browser.
    "--host-resolver-rules=MAP site.example 127.0.0.1, MAP 203.0.113.50 127.0.0.1",
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
        """Value of an expression of JavaScript, or of its promise."""
        told = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        return told["result"].get("value")

    def resize(self, width: int, height: int = 720, *, mobile: bool = False) -> None:
        """Set the size of the window, pixels."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def prefer(self, scheme: str) -> None:
        """Prefer light or dark pages."""
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.call("Emulation.setEmulatedMedia", features=[feature])

    def watch_policy(self) -> None:
        """Note what the content policies of the pages opened from now on refuse."""
        listener = (
            "window.refused = []; addEventListener('securitypolicyviolation', (event) =>"
            " refused.push(`${event.effectiveDirective} ${event.blockedURI} ${event.sourceFile}`));"
        )
        self.call("Page.addScriptToEvaluateOnNewDocument", source=listener)

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


@pytest.fixture(scope="session")
def own_pages(tmp_path_factory):
    """Serve one page of each kind, {name: address}: of a result, of jobs, live, and exported."""
    folder = tmp_path_factory.mktemp("pages")
    view = replace(spiral_view(spiral(folder / "cloud.ply", WET)), note="A note of its own.")
    (folder / "page.html").write_bytes(render_page(view))
    scene = the_scene()
    write_set(folder / "set", "kitti", scene, the_sweeps(scene))
    view.downloads = downloads()
    with ExitStack() as stack:
        jobs = JobList(folder / "set")
        pages = {
            "result": stack.enter_context(page_server(view.answer, 0)),
            "jobs": stack.enter_context(page_server(jobs.answer, 0, index="jobs.html")),
            "live": stack.enter_context(page_server(survey_under_way(view), 0)),
            "campaign": stack.enter_context(campaign_under_way()),
        }
        urls = {name: page.url for name, page in pages.items()}
        frame = {"job in a frame": f"{urls['jobs']}job/1/?plain"}
        yield urls | frame | {"exported": (folder / "page.html").as_uri()}


def survey_under_way(view):
    """Return what a view answers while its survey goes on."""
    live = LivePage(1, (), "a survey")
    live.on_progress(Progress(12.0, 360, 300, 200, 150, 100, 20_000), lambda: [])

    def answer(question, arguments, abandoned):
        if question == "news":
            versions = {"rays_version": 1, "hits_version": 1, "version": 0, "ends": 0, "path": None}
            return live.answer("jobs", {}, abandoned)[0] | versions | {"time": 0.5}, {
                "rays": view.rays
            }
        header, arrays = view.answer(question, arguments, abandoned)
        return (
            header | {"live": True, "sampled": False} if question == "state" else header
        ), arrays

    return answer


@contextmanager
def campaign_under_way():
    """Serve the live page of a campaign with jobs that are done, failed and under way."""
    with live_page(9, ("height_m", "rain_mm_h"), "Heights", port=0, browser=False) as live:
        for number in range(5):
            values = {"height_m": 1.5 + number, "rain_mm_h": number}
            error = "The mesh wall.obj has no faces: give another." if number == 3 else ""
            live.on_job_end(
                JobRow(number, f"{number:02}", "", values, error, 36, 1, 900, 800, 700, 1.5)
            )
        under_way = [
            {"name": "05", "writing": False, "stored": 9, "scans": 36, "points": 90, "number": 5,
             "seconds": 1.0, "values": {"height_m": 6.5, "rain_mm_h": 5}, "opens": False}
        ]  # fmt: skip
        live.on_progress(Progress(seconds=20.0, jobs=9, jobs_done=5), lambda: under_way)
        yield live.page
