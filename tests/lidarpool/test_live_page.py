"""The page is for this machine alone, and is redrawn in a thread of its own."""

import base64
import os
import queue
import socket
import threading
import time
import types
from importlib.metadata import version

import msgspec
import pytest
import zstandard
from benchmarks.live import CAMERA
from websockets.exceptions import ConnectionClosed
from websockets.frames import OP_BINARY, Frame
from websockets.sync.client import connect

from lidarpool.live.page import announced, live_page, may_connect, redrawn

# {origin of a page: whether it may connect}
ORIGINS = {
    "http://127.0.0.1:8080": True,
    "http://localhost:18080": True,
    "https://LOCALHOST": True,
    "http://[::1]:80": True,
    "http://example.com": False,
    "https://localhost.example.com:8080": False,  # rebound to 127.0.0.1 by its own DNS server
    "https://127.0.0.1.example.com": False,
    "http://192.168.0.2:8080": False,
    "http://0.0.0.0:8080": False,
    "file://": False,
    "chrome-extension://localhost": False,
    "null": False,
    "http://[::1": False,
    "": False,
}
OWN = "http://localhost:18080"
PROTOCOL = f"viser-v{version('viser')}"


@pytest.fixture
def served():
    """Return a page with a button, the messages that press it, and how often it was pressed."""
    pressed = queue.Queue()
    with live_page("a page", port=0) as page:
        page.gui.add_html("a secret")
        button = page.gui.add_button("Stop")
        button.on_click(pressed.put)
        press = {"type": "GuiUpdateMessage", "uuid": button._impl.uuid, "updates": {"value": True}}
        yield page, [msgspec.msgpack.encode(message) for message in (CAMERA, press)], pressed


def connected(page, origin):
    """Connect to a page as a browser does that shows a page of this origin."""
    url = page.url.replace("http", "ws", 1)
    return connect(url, origin=origin, subprotocols=[PROTOCOL], max_size=None)


def turned_away(page, origin, messages):
    """Say something; return what was said, and why, before the connection was closed."""
    said = []
    with connected(page, origin) as visitor:
        try:
            for message in messages:
                visitor.send(message)
            while True:
                said.append(visitor.recv(timeout=120))
        except ConnectionClosed as closed:
            return said, closed.rcvd.code


def see_and_press(page, origin, messages, pressed):
    """Stay until the page's secret was seen and its button was pressed."""
    with connected(page, origin) as visitor:
        for message in messages:
            visitor.send(message)
        while b"a secret" not in unpacked(visitor.recv(timeout=120)):
            pass
        pressed.get(timeout=120)
        assert visitor.ping().wait(120)  # it was not closed


@pytest.mark.parametrize("origin", ORIGINS)
def test_who_may_connect(origin):
    assert may_connect([origin]) == ORIGINS[origin]
    assert may_connect([OWN, origin]) == ORIGINS[origin]


@pytest.mark.parametrize("origin", [OWN, None], ids=["own", "no browser"])
def test_whoever_is_of_this_machine_sees_the_page_and_may_press(served, origin):
    see_and_press(served[0], origin, *served[1:])


@pytest.mark.parametrize("origin", ["http://example.com:8080", "null"])
def test_a_stranger_sees_nothing_and_presses_nothing(served, origin, caplog):
    page, messages, pressed = served
    assert turned_away(page, origin, messages) == ([], 1008)
    settle(page)
    assert pressed.empty()
    assert page.get_clients() == {}
    assert f"a page of [{origin!r}] wanted to connect to the live page: refused" in caplog.text
    see_and_press(page, OWN, messages, pressed)  # others still may


def test_what_comes_with_the_first_bytes_is_not_taken_either(served):
    """A message that lies in wait when the connection is made is not closed away."""
    page, messages, pressed = served
    with socket.create_connection(("127.0.0.1", page.get_port())) as stranger:
        head = (
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{page.get_port()}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
            f"{base64.b64encode(os.urandom(16)).decode()}\r\nSec-WebSocket-Protocol: {PROTOCOL}"
            "\r\nOrigin: http://example.com\r\n\r\n"
        )
        frames = [Frame(OP_BINARY, message).serialize(mask=True) for message in messages]
        stranger.sendall(b"".join([head.encode(), *frames]))
        stranger.settimeout(120)
        answer = b""
        while b"may connect" not in answer:  # the reason, in the frame that closes
            piece = stranger.recv(1 << 16)
            assert piece, answer
            answer += piece
    assert b"101 Switching Protocols" in answer
    assert b"a secret" not in answer
    settle(page)
    assert pressed.empty()


def settle(page):
    """Wait until the server has forgotten all that were connected."""
    server = page._websock_server
    deadline = time.monotonic() + 120
    while server._live_connections or server._client_state_from_id:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def unpacked(data):
    """Messages of a window as they were before they were compressed."""
    packed = int.from_bytes(data[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed])


def test_a_port_that_is_taken_is_no_reason_to_fail(served):
    page, *_ = served
    with live_page("another", port=page.get_port()) as other:
        assert other.get_port() != page.get_port()


def test_drawing_goes_on_beside_the_body_and_once_more_at_its_end():
    drawn, state, may = [], [0], threading.Event()

    def draw():
        drawn.append(state[0])
        may.wait(120)
        return 1.0

    with redrawn(draw, 0.01):
        for state[0] in range(1000):
            pass  # a drawing that takes long holds nobody up
        may.set()
        while len(drawn) < 3:
            time.sleep(0.01)
        state[0] = -1
    assert drawn[-1] == -1


def test_an_error_ends_the_drawing_and_not_the_run(caplog):
    def draw():
        raise OSError("no paint")

    with redrawn(draw, 0.0):
        while "no paint" not in caplog.text:
            time.sleep(0.01)
    assert caplog.text.count("OSError: no paint") == 1


@pytest.mark.parametrize("hub", [False, True])
def test_a_cell_shows_the_page_unless_it_is_on_the_machine_of_a_hub(served, monkeypatch, hub):
    """There 127.0.0.1 in a frame would be the reader's own machine."""
    cells = []
    cell = types.SimpleNamespace(update=cells.append)
    display = types.SimpleNamespace(HTML=str, display=lambda html, **_: cells.append(html) or cell)
    monkeypatch.setattr("lidarpool.live.page.cell_display", lambda: display)
    monkeypatch.delenv("JUPYTERHUB_SERVICE_PREFIX", raising=False)
    if hub:
        monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/ada/")
    page = served[0]
    with announced(page, f"live page at {page.url}", browser=True):
        (shown,) = cells
    assert cells == [shown, ""] and f"live page at {page.url}" in shown
    assert ("<iframe" in shown) != hub
    assert (f"ssh -L {page.get_port()}:127.0.0.1:{page.get_port()}" in shown) == hub
