"""The page is for who knows its address alone."""

import http.client
import json
import socket
import subprocess
import sys
import threading
import time
import types
import urllib.error
import urllib.request
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pytest
from tests.pages import ask

from lidarview.viewer.guarded_server import MAX_CONNECTIONS
from lidarview.viewer.point_selection import ClientDisconnected
from lidarview.viewer.server import MAX_SLOW, MAX_WAITING, announce_page, page_server

# Another user's process: asks for addresses, prints their status and whether it saw anything.
STRANGER = """
import encodings.idna, http.client, json, os, sys  # all, before it is a user who reads no files
if os.getuid() == 0:
    os.setgroups([]), os.setgid(65534), os.setuid(65534)
for port, method, path in json.loads(sys.argv[1]):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request(method, path)
    answer = connection.getresponse()
    print(answer.status, b"secret" in answer.read())
"""


class Secrets:
    """Something to see and a button."""

    def __init__(self):
        self.ordered = []
        self.asked = threading.Event()
        self.abandoned = threading.Event()

    def answer(self, what, asked, abandoned):
        if what == "slow":
            self.asked.set()
            while not abandoned():
                time.sleep(0.01)
            self.abandoned.set()
            raise ClientDisconnected
        if what == "wrong":
            raise ValueError(asked["number"])
        if what != "secret":
            raise KeyError(what)
        arrays = {"bytes": np.arange(3, dtype=np.uint8), "reals": np.float32([[1, 2], [3, np.nan]])}
        return {"secret": "ä", "asked": asked}, arrays

    def stop(self):
        self.ordered.append("stop")


@pytest.fixture
def served():
    """Return a page and what it shows."""
    source = Secrets()
    with page_server(lambda *asked: source.answer(*asked), 0, source.stop) as page:
        yield page, source


def said(page, method, what, path=None, **headers):
    """Return the status and the body of an answer; _ of the names of headers is -."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=120)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, f"/{page.token}/{what}" if path is None else path, headers=named)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def test_questions_are_answered_with_words_and_arrays(served):
    page, _ = served
    told = ask(page.url, "secret", number=7)
    assert (told["secret"], told["asked"]) == ("ä", {"number": "7"})
    assert told["arrays"]["bytes"].tolist() == [0, 1, 2]
    assert np.array_equal(told["arrays"]["reals"], [[1, 2], [3, np.nan]], equal_nan=True)
    for what in ("nothing", "wrong?number=x", "wrong", "../pyproject.toml"):
        assert said(page, "GET", what)[0] == 404


def test_the_page_is_there_and_asks_nobody_else(served):
    page, _ = served
    status, text = said(page, "GET", "")
    assert (status, b"<!doctype html>" in text) == (200, True)
    for name in (b"page.css", b"page.js"):
        assert name in text
    for name in ("page.css", "page.js", "picture.js", "controls.js", "three.min.js"):
        status, text = said(page, "GET", name)
        assert status == 200
        assert name == "three.min.js" or b"https://" not in text.replace(b"http://www.w3.org", b"")


def test_another_user_needs_the_token(served):
    page, source = served
    wrong = page.token[:-1] + ("A" if page.token[-1] != "A" else "B")
    begins = ("/", "//", f"/{wrong}/", f"/{page.token[:-1]}/", "/job/7/", f"/{wrong}/job/7/")
    asked = [("GET", ""), ("GET", "secret"), ("GET", "page.js"), ("POST", "stop"), ("HEAD", "")]
    strange = [(page.port, method, begin + what) for begin in begins for method, what in asked]
    assert stranger(strange) == ["404 False"] * len(strange)
    assert source.ordered == []
    own = [(page.port, *one) for one in (("GET", f"/{page.token}/secret"),
                                         ("POST", f"/{page.token}/nothing"),
                                         ("POST", f"/{page.token}/stop"))]  # fmt: skip
    assert stranger(own) == ["200 True", "404 False", "200 False"]
    assert source.ordered == ["stop"]


def stranger(asked):
    """Return what a process of another user is answered."""
    command = [sys.executable, "-I", "-c", STRANGER, json.dumps(asked)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout.splitlines()


def test_what_a_browser_is_started_with_is_good_once(served):
    """Other users see it in the list of processes."""
    page, _ = served
    once = page.single_use_url()
    assert page.token not in once
    with urllib.request.urlopen(once, timeout=120) as answer:
        assert (answer.url, b"<!doctype html>" in answer.read()) == (page.url, True)
    assert said(page, "GET", "", f"/{once.split('/')[-2]}/")[0] == 404


@pytest.mark.parametrize("in_notebook", [False, True])
def test_other_pages_frame_it_in_notebooks_only_and_learn_no_address(monkeypatch, in_notebook):
    display = object() if in_notebook else None
    monkeypatch.setattr("lidarview.viewer.server.cell_display", lambda: display)
    source = Secrets()
    with page_server(source.answer, 0) as page:
        for what in ("", "job/7/", "secret"):
            with urllib.request.urlopen(page.url + what, timeout=120) as answer:
                allowed = answer.headers["Content-Security-Policy"]
                assert answer.headers["Referrer-Policy"] == "no-referrer"
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
            assert allowed.startswith("default-src 'none'; script-src 'self'; style-src 'self'; ")
            assert "unsafe" not in allowed
            assert ("frame-ancestors 'self'" in allowed) != in_notebook


def test_an_answer_that_nobody_waits_for_is_given_up(served):
    page, source = served
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=120)
    connection.request("GET", f"/{page.token}/slow")
    assert source.asked.wait(120)
    connection.sock.close()
    connection.close()
    assert source.abandoned.wait(120)


# -- other websites and programs that do not behave ------------------------------------------------


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "cors"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "null"},
        {"Host": "site.example"},
    ],
)
def test_other_websites_are_refused_whatever_they_know(served, headers):
    page, source = served
    for method, what in (("GET", ""), ("GET", "secret"), ("GET", "page.js"), ("POST", "stop")):
        status, body = said(page, method, what, **headers)
        assert (status, b"secret" in body) == (403, False)
        assert said(page, method, what, "/wrong/", **headers)[0] == 404
    once = page.single_use_url()
    assert said(page, "GET", "", f"/{once.split('/')[-2]}/", **headers)[0] == 403
    assert source.ordered == []


def test_a_browser_that_does_not_say_who_asks_stops_nothing(served):
    page, source = served
    browser = {"User_Agent": "Mozilla/5.0"}
    assert said(page, "POST", "stop", **browser)[0] == 403
    assert source.ordered == []
    assert said(page, "POST", "stop", Origin=f"http://127.0.0.1:{page.port}", **browser)[0] == 200
    assert said(page, "POST", "stop", Sec_Fetch_Site="same-origin", **browser)[0] == 200
    assert source.ordered == ["stop", "stop"]


def test_links_of_other_websites_lead_to_the_page_alone(served):
    page, source = served
    link = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}
    assert [said(page, "GET", what, **link)[0] for what in ("", "job/7/")] == [200, 200]
    for method, what in (("GET", "secret"), ("POST", "stop"), ("POST", "")):
        assert said(page, method, what, **link)[0] == 403
    assert source.ordered == []


def test_a_hub_passes_on_a_name_of_its_own(monkeypatch):
    monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/ada/")
    source = Secrets()
    with page_server(source.answer, 0, source.stop) as page:
        own = {"Host": "hub.example", "Sec_Fetch_Site": "same-origin"}
        assert said(page, "GET", "secret", **own)[0] == 200
        assert said(page, "POST", "stop", Origin="https://hub.example", **own)[0] == 200
        assert said(page, "POST", "stop", Origin="https://site.example", **own)[0] == 403
    assert source.ordered == ["stop"]


def sent(page, content, timeout_s=120):
    """Send bytes over a connection of its own; return what the server says until it closes."""
    with socket.create_connection(("127.0.0.1", page.port), timeout_s) as connection:
        connection.sendall(content)
        answer = b""
        while received := connection.recv(65_536):
            answer += received
    return answer


@pytest.mark.parametrize(
    ("token", "headers", "status"),
    [
        ("wrong", "Content-Length: 100000000", 404),
        ("wrong", "Transfer-Encoding: chunked", 404),
        ("", "Content-Length: 100000000\r\nExpect: 100-continue", 404),
        (None, "Content-Length: 100000000", 413),
        (None, f"Content-Length: {'9' * 5000}", 413),
        (None, "Content-Length: 4097", 413),
        (None, "Content-Length: -1", 400),
        (None, "Content-Length: 1\r\nSec-Fetch-Site: cross-site", 403),
    ],
)
def test_requests_are_refused_before_their_bodies_are_read(served, token, headers, status):
    page, source = served
    path = f"/{page.token if token is None else token}/stop"
    answer = sent(page, f"POST {path} HTTP/1.1\r\nHost: localhost\r\n{headers}\r\n\r\n".encode())
    assert answer.startswith(f"HTTP/1.1 {status} ".encode())
    assert source.ordered == []


def test_a_refusal_can_be_read_by_who_sends_a_large_body(served):
    page, _ = served
    answer = sent(
        page, b"POST /wrong/ HTTP/1.1\r\nContent-Length: 20000000\r\n\r\n" + bytes(2 << 20)
    )
    assert answer.startswith(b"HTTP/1.1 404 ")


def test_a_body_in_pieces_is_small_as_well(served):
    page, source = served
    head = (
        f"POST /{page.token}/stop HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    )
    piece = b"400\r\n" + bytes(1024) + b"\r\n"
    assert sent(page, head.encode() + 5 * piece).startswith(b"HTTP/1.1 400 ")
    assert source.ordered == []


@pytest.mark.parametrize(
    "content",
    [
        "",
        "GET /",
        "POST /{token}/stop HTTP/1.1\r\nHost: a\r\n",
        "GET http://[/ HTTP/1.1\r\n\r\n",
        "POST /{token}/stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\nab",
        "POST /wrong/stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\nab",
        "GET /{token}/page.css HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ],
)
def test_a_connection_without_a_whole_request_is_closed(monkeypatch, content):
    monkeypatch.setattr("lidarview.viewer.guarded_server.REQUEST_WITHIN_S", 0.2)
    source = Secrets()
    with page_server(source.answer, 0, source.stop) as page:
        sent(page, content.format(token=page.token).encode())  # returns once it is closed
    assert source.ordered == []


def test_connections_that_wait_give_way_to_new_ones(served):
    page, _ = served
    with ExitStack() as stack:
        address = ("127.0.0.1", page.port)
        waiting = []
        for number in range(200):
            waiting.append(stack.enter_context(socket.create_connection(address, 120)))
            waiting[-1].send(f"GET /{page.token}/secret HTTP/1.1\r\nHost: localhost\r\n".encode())
            if number % 50 == 49:
                assert said(page, "GET", "secret")[0] == 200
        for connection in waiting[: 200 - MAX_CONNECTIONS]:
            with suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        waiting[-1].send(b"\r\n")
        assert waiting[-1].recv(12) == b"HTTP/1.1 200"


# -- slow questions --------------------------------------------------------------------------------


READY_S = 60.0  # for which a large answer waits to be ready, if nothing says so earlier


class Large:
    """A source of points: each answer waits for `ready`, and has 40 MB."""

    def __init__(self):
        self.ready = threading.Event()
        self._lock = threading.Lock()
        self.now = self.most = 0  # answers that are being made, and most at a time

    def answer(self, what, asked, abandoned):
        if what == "state":
            return {"points": 20_000_000}, {}
        with self._lock:
            self.now += 1
            self.most = max(self.now, self.most)
        self.ready.wait(READY_S)
        with self._lock:
            self.now -= 1
        return {}, {"positions": np.zeros(10_000_000, np.float32)}


@pytest.fixture
def large():
    """Return a page and its source of large answers."""
    source = Large()
    with page_server(source.answer, port=0) as page:
        yield page, source
        source.ready.set()


@contextmanager
def unread(page, count, question):
    """Ask a question some times without reading the answers."""
    with ExitStack() as stack:
        for _ in range(count):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", page.port)))
            connection.sendall(f"GET /{page.token}/{question} HTTP/1.0\r\n\r\n".encode())
        yield


@pytest.mark.parametrize(
    "question", ["points?most=20000000", "points?most=9&filter=z,0,1", "export?format=ply"]
)
def test_others_are_answered_while_slow_questions_wait(large, question):
    page, source = large
    with unread(page, MAX_SLOW + MAX_WAITING + 4, question):
        while source.now < MAX_SLOW:
            time.sleep(0.01)
        for _ in range(5):
            started = time.monotonic()
            assert ask(page.url, "state")["points"] == 20_000_000
            assert time.monotonic() - started < READY_S / 2
        assert said(page, "GET", question)[0] == 503
        assert source.most == MAX_SLOW


def test_a_search_is_answered_while_nobody_reads_large_answers(large, monkeypatch):
    page, source = large
    monkeypatch.setattr("lidarview.viewer.server.STALL_S", 600.0)
    with unread(page, MAX_SLOW + MAX_WAITING, "points?most=20000000"):
        while source.now < MAX_SLOW:
            time.sleep(0.01)
        source.ready.set()
        ask(page.url, "points", most=9, filter="z,0,1")  # within the time that `ask` waits


def test_an_answer_that_is_not_read_ends(large, monkeypatch):
    page, source = large
    source.ready.set()
    monkeypatch.setattr("lidarview.viewer.server.STALL_S", 0.5)
    with unread(page, 2 * MAX_SLOW, "points?most=20000000"):
        time.sleep(0.2)
        started = time.monotonic()
        assert ask(page.url, "state")["points"] == 20_000_000
        assert time.monotonic() - started < READY_S / 2
        answer = ask(page.url, "points", most=20_000_000)
        assert len(answer["arrays"]["positions"]) == 10_000_000


def test_a_port_that_is_taken_is_no_reason_to_fail(served):
    page, source = served
    with page_server(source.answer, port=page.port) as other:
        assert other.port != page.port
        assert ask(other.url, "secret")["secret"] == "ä"
    with pytest.raises(urllib.error.URLError):
        ask(other.url, "secret")


def test_an_error_of_ours_is_logged_and_the_page_stays(served, caplog, monkeypatch):
    page, source = served
    monkeypatch.setattr(source, "answer", lambda *_: 1 / 0)
    assert said(page, "GET", "secret")[0] == 500
    assert "ZeroDivisionError" in caplog.text
    assert said(page, "GET", "")[0] == 200


@pytest.mark.parametrize("hub", [False, True])
def test_a_cell_shows_the_page_and_says_how_else_to_reach_it(served, monkeypatch, hub):
    """On a hub, 127.0.0.1 in a frame would be the reader's own machine."""
    cells = []
    cell = types.SimpleNamespace(update=cells.append)
    display = types.SimpleNamespace(HTML=str, display=lambda html, **_: cells.append(html) or cell)
    monkeypatch.setattr("lidarview.viewer.server.cell_display", lambda: display)
    monkeypatch.delenv("JUPYTERHUB_SERVICE_PREFIX", raising=False)
    if hub:
        monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/ada/")
    page = served[0]
    with announce_page(page, f"live page: {page.url}", browser=True):
        (shown,) = cells
    assert cells == [shown, ""]
    proxied = f"/user/ada/proxy/{page.port}/{page.token}/"
    assert f'<iframe src="{proxied if hub else page.url}"' in shown and page.url in shown
    assert (f"ssh -L {page.port}:127.0.0.1:{page.port}" in shown) == hub
