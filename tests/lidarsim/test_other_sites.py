"""Which requests are of another website: the check that all our services share."""

import socket
from pathlib import Path

import pytest

from lidarsim.environment.other_sites import names_of_machine, refusal

NAMES = {"localhost", "lab"}
BROWSER = {"host": "192.168.1.50", "user-agent": "Mozilla/5.0 (X11; Linux x86_64)"}


def test_both_packages_have_the_same_check():
    root = Path(__file__).parents[2]
    files = (
        "workflows/lidarsim/environment/other_sites.py",
        "scheduler/poolpart/extras/other_sites.py",
    )
    assert len({(root / file).read_bytes() for file in files}) == 1


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1", "127.0.0.2:8080", "192.168.1.50", "[::1]:80", "localhost", "LOCALHOST:80",
        "localhost.", "lab", "lab:8080",
    ],
)  # fmt: skip
def test_a_service_is_asked_by_its_names_and_by_addresses(host):
    assert refusal({"host": host}, NAMES, changes_state=True) == ""
    assert refusal({"host": host}, NAMES, url_authority=host, changes_state=True) == ""


@pytest.mark.parametrize(
    "host",
    [
        "site.example", "127.0.0.1.site.example", "localhost.site.example:80", "lab.site.example",
        "site.example.", "lab@site.example", "127.0.0.1,site.example", "127.0.0.1/", "[::1",
        "2130706433", "localhost:80:80", "::1", " ", "x" * 100_000,
    ],
)  # fmt: skip
def test_another_name_is_refused_in_a_line(host):
    for words in (refusal({"host": host}, NAMES), refusal({}, NAMES, url_authority=host)):
        assert "is not a name of this server. Use its address" in words
        assert len(words) < 200
    assert "not a name" in refusal({"host": "localhost"}, NAMES, url_authority=host)


def test_any_name_is_right_behind_a_proxy_whose_name_is_unknown():
    assert refusal({"host": "hub.example"}, None) == ""
    assert refusal({"host": "hub.example", "origin": "https://hub.example"}, None) == ""
    assert refusal({"host": "hub.example", "origin": "https://site.example"}, None)
    assert refusal({"host": "a@b"}, None)


@pytest.mark.parametrize(
    ("headers", "is_refused"),
    [
        ({}, False),
        ({"sec-fetch-site": "none"}, False),
        ({"sec-fetch-site": "same-origin"}, False),
        ({"sec-fetch-site": "same-site"}, True),
        ({"sec-fetch-site": "cross-site"}, True),
        ({"sec-fetch-site": "none,cross-site"}, True),
        ({"sec-fetch-site": ""}, True),
        ({"origin": "http://127.0.0.2:8080"}, False),
        ({"origin": "http://127.0.0.2"}, True),
        ({"origin": "http://127.0.0.1:8080"}, True),
        ({"origin": "http://site.example"}, True),
        ({"origin": "http://127.0.0.2:8080@site.example"}, True),
        ({"origin": "http://[::1"}, True),
        ({"origin": "null"}, True),
        ({"origin": ""}, True),
    ],
)
def test_what_browsers_say_of_a_request_decides(headers, is_refused):
    for changes_state in (False, True):
        words = refusal({"host": "127.0.0.2:8080"} | headers, NAMES, changes_state=changes_state)
        assert words == ("Requests from other websites are rejected." if is_refused else "")


def test_a_link_of_another_website_leads_to_a_page_only():
    link = {"host": "127.0.0.1", "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert refusal(link, NAMES, is_page=True) == ""
    assert refusal(link, NAMES)
    assert refusal(link | {"sec-fetch-mode": "no-cors"}, NAMES, is_page=True)
    assert refusal(link | {"host": "site.example"}, NAMES, is_page=True)


@pytest.mark.parametrize(
    ("headers", "is_refused"),
    [
        ({}, True),
        ({"referer": "http://192.168.1.50/api/v1/sensor/config"}, False),
        ({"referer": "http://192.168.1.50.site.example/"}, True),
        ({"referer": "http://site.example/192.168.1.50"}, True),
        ({"origin": "http://192.168.1.50"}, False),
        ({"sec-fetch-site": "none"}, False),
        ({"user-agent": "curl/8.5.0"}, False),
        ({"user-agent": "python-requests/2.32"}, False),
    ],
)
def test_a_browser_that_says_nothing_changes_nothing(headers, is_refused):
    assert bool(refusal(BROWSER | headers, NAMES, changes_state=True)) == is_refused
    assert refusal(BROWSER | headers, NAMES) == ""


def test_the_names_of_a_machine(monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "Lab")
    monkeypatch.setattr(socket, "getfqdn", lambda: "lab.domain.example")
    assert names_of_machine("127.0.0.2") == {"localhost", "lab", "lab.local"}
    assert "lab.domain.example" in names_of_machine("192.168.1.50")
    assert "lab.domain.example" not in names_of_machine("::1")
