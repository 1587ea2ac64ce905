"""The page is for this machine alone."""

import http.client
import threading
import time
import types
import urllib.error
import urllib.request

import numpy as np
import pytest
from tests.pages import ask

from lidarpool.live.points import Abandoned
from lidarpool.live.server import announced, may_ask, page_server

# {(Host, Origin): whether it may ask}
ASKED = {
    ("127.0.0.1:8080", None): True,
    ("127.0.0.1:8080", "http://127.0.0.1:8080"): True,
    ("localhost:18080", "http://localhost:18080"): True,
    ("LOCALHOST", "http://localhost"): True,
    ("[::1]:80", "http://[::1]:80"): True,
    ("[::1]", None): True,
    ("example.com:8080", None): False,  # rebound to 127.0.0.1 by its own DNS server
    ("example.com:8080", "http://example.com:8080"): False,
    ("localhost.example.com:8080", None): False,
    ("192.168.0.2:8080", None): False,
    ("0.0.0.0:8080", None): False,
    ("", None): False,
    ("127.0.0.1:8080", "http://example.com"): False,
    ("127.0.0.1:8080", "http://127.0.0.1:9090"): False,  # another server of this machine
    ("127.0.0.1:8080", "null"): False,
    ("127.0.0.1:8080", "file://"): False,
}


class Secrets:
    """Something to see and a button."""

    def __init__(self):
        self.ordered = []
        self.asked, self.abandoned = threading.Event(), threading.Event()

    def answer(self, what, asked, abandoned):
        if what == "slow":
            self.asked.set()
            while not abandoned():
                time.sleep(0.01)
            self.abandoned.set()
            raise Abandoned
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


def said(page, method, what, **headers):
    """Return the status and the body of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=120)
    connection.request(method, f"/{what}", headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


@pytest.mark.parametrize(("host", "origin"), ASKED)
def test_who_may_ask(host, origin):
    assert may_ask(host, origin) == ASKED[host, origin]


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


def test_a_stranger_sees_nothing_and_presses_nothing(served, caplog):
    page, source = served
    port = page.port
    strange = {"Host": f"example.com:{port}"}, {"Origin": "http://example.com:8080"}
    for headers in strange:
        for method, what in (("GET", ""), ("GET", "secret"), ("POST", "stop")):
            headers = {**headers, "X-Lidarpool": "1"}
            status, body = said(page, method, what, **headers)
            assert (status, b"secret" in body) == (403, False)
    assert "refused" in caplog.text
    # A form of a strange page, in a browser that tells no origin, cannot set a header.
    assert said(page, "POST", "stop")[0] == 403
    assert source.ordered == []
    own = {"Origin": page.url, "X-Lidarpool": "1"}
    assert said(page, "POST", "stop", **own)[0] == 200
    assert said(page, "POST", "nothing", **own)[0] == 404
    assert source.ordered == ["stop"]


def test_an_answer_that_nobody_waits_for_is_given_up(served):
    page, source = served
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=120)
    connection.request("GET", "/slow")
    assert source.asked.wait(120)
    connection.sock.close()
    connection.close()
    assert source.abandoned.wait(120)


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


@pytest.mark.parametrize("hub", ["none", "a hub", "a hub with a proxy"])
def test_a_cell_shows_the_page_or_says_how_to_reach_it(served, monkeypatch, hub):
    """On a hub, 127.0.0.1 in a frame would be the reader's own machine."""
    cells = []
    cell = types.SimpleNamespace(update=cells.append)
    display = types.SimpleNamespace(HTML=str, display=lambda html, **_: cells.append(html) or cell)
    monkeypatch.setattr("lidarpool.live.server.cell_display", lambda: display)
    monkeypatch.setattr(
        "lidarpool.live.server.find_spec", lambda name: hub.endswith("proxy") or None
    )
    monkeypatch.delenv("JUPYTERHUB_SERVICE_PREFIX", raising=False)
    if hub != "none":
        monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/ada/")
    page = served[0]
    with announced(page, f"live page: {page.url}", browser=True):
        (shown,) = cells
    assert cells == [shown, ""]
    proxied = f"/user/ada/proxy/{page.port}/"
    assert ("<iframe" in shown) == (hub != "a hub")
    assert (f'src="{proxied}"' in shown) == hub.endswith("proxy")
    assert (f"ssh -L {page.port}:127.0.0.1:{page.port}" in shown) == (hub == "a hub")
    if hub != "none":  # through the hub's proxy, the page has the hub's name
        headers = {"Host": "hub.example.com", "Origin": "https://hub.example.com"}
        assert said(page, "GET", "secret", **headers)[0] == 200


def test_json_has_no_words_that_browsers_cannot_read(served, monkeypatch):
    page, source = served
    monkeypatch.setattr(source, "answer", lambda *_: ({"x": float("nan")}, {}))
    assert said(page, "GET", "secret")[0] == 500
