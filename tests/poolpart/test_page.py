"""The page of partitions: served by the scheduler, without scripts, and safe with users' names."""

import re
import socket
import urllib.error
import urllib.request
from html import unescape

import dask
import pytest
from distributed import Client, get_worker
from tests.clusters import cluster_of
from tests.poolpart.helpers import LONG_S

from poolpart import Partition, Pipe, Pool, PoolError

NASTY = "<script>alert('x')</script>&\"'"


def get(url, headers=None):
    """Status, headers and text of an answer."""
    request = urllib.request.Request(url, headers=headers or {})
    try:
        with urllib.request.urlopen(request, timeout=LONG_S) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read().decode()


def rows_of(url):
    """Cells of each row of the page, below its first."""
    text = get(url)[2]
    rows = re.findall(r"<tr>(<td.*?)</tr>", text)
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in rows]
    return {unescape(first): others for first, *others in cells}


def all_rows(url, first):
    """Cells of all rows of the page with this first cell."""
    text = get(url)[2]
    rows = [
        re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr>(<td.*?)</tr>", text)
    ]
    return [cells[1:] for cells in rows if unescape(cells[0]) == first]


def work(_=None):
    return str(get_worker().name)


def broken():
    raise ValueError("broken")


@pytest.fixture(scope="module", params=[True, False], ids=["dashboard", "no dashboard"])
def client(request):
    workers = {NASTY: {"resources": {"A": 2}}, "plain": {"nthreads": 2}}
    options = {"dashboard": request.param}
    with (
        cluster_of(workers, options, host="127.0.0.1") as cluster,
        Client(cluster, name="alice") as client,
    ):
        yield client


def test_the_page_of_a_partition_shows_only_the_partition(client):
    pool = Pool.from_client(client)
    client.gather([pool["A"].submit(work, 1), client.submit(work, 2)])
    with Pipe("to nobody", 1, client):
        url = pool["A"].page()
        rows = rows_of(url)
        assert url == f"{pool.page()}?partition=A"
        assert rows["A"][:2] == ["1", "2"]
        assert rows[NASTY][0] == "A"
        assert {*rows} == {"A", NASTY, "work", "alice"}
        assert {"plain", "to nobody"} <= rows_of(pool.page()).keys()
    assert rows_of(url.replace("=A", "=B"))["B"][0] == "0"
    pool.leave_page()


def test_it_is_served_and_taken_away(client):
    applications = client.cluster.scheduler.http_application.applications
    before = list(applications)
    url = Pool.from_client(client).page()
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/partitions", url)
    status, headers, text = get(url)
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=UTF-8")
    assert headers["Cache-Control"] == "no-store"
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert "<title>Partitions</title>" in text
    assert Pool.from_client(client).page() == url  # once more changes nothing
    assert len(applications) == len(before) + 1
    # The rest of the dashboard is as it was.
    assert get(url.replace("partitions", "json/counts.json"))[0] == 200
    assert get(f"{url}/nonsense")[0] == 404

    Pool.from_client(client).dissolve()
    assert get(url)[0] == 404
    assert applications == before


def test_what_it_tells(client, wait_until):
    pool = Pool.from_client(client)
    url = pool.page()
    pool.partition("P", workers=["plain"], exclusive=True)
    part = Partition("A", client)
    results = [part.submit(work, i) for i in range(6)]
    failing = part.submit(broken)
    ordinary = [client.submit(work, i, pure=False) for i in range(3)]
    client.gather(ordinary)
    with Pipe("frames-12345678", 5, client) as pipe:
        for item in range(3):
            pipe.put(item)
        client.gather(results)
        wait_until(failing.done)
        rows = rows_of(url)
        assert rows["frames-12345678"] == ["3", "5", "open"]
        pipe.fail("the reason")
        assert rows_of(url)["frames-12345678"] == ["3", "5", "failed: the reason"]
    assert rows["A"][:3] == ["1", "2", "0"]
    assert sum(row[:5] == ["A", "0", "0", "0", "6"] for row in all_rows(url, "work")) == 1
    # Ordinary tasks run on a worker of A, as P is exclusive: no workers, but tasks.
    [no_partition] = all_rows(url, "no partition")
    assert (no_partition[:3], no_partition[6]) == (["0", "0", "0"], "3")
    assert (rows["broken"][0], rows["broken"][5]) == ("A", "1")
    assert rows[NASTY][:2] == ["A", "2"]
    assert rows["alice"][:3] == ["A", "1", "100%"]  # weight and share
    assert "<script>" not in get(url)[2]  # names of users stay text
    assert rows["plain"][:3] == ["P", "2", "0"]
    assert "P (exclusive)" in rows
    assert rows["P (exclusive)"][-1] == "–"  # no task of P has run
    assert f"<p>{client.scheduler.address}: workers 2, partitions 2, pipes 0</p>" in get(url)[2]
    assert "frames-12345678" not in rows_of(url)
    pool.dissolve()


def test_workers_are_in_the_order_of_partitions_and_names():
    workers = {"w10": {"A": 1}, "free": {}, "w9": {"A": 1}, "w11": {"B": 1}}
    specs = {name: {"resources": resources} for name, resources in workers.items()}
    with cluster_of(specs, {}, host="127.0.0.1") as cluster, Client(cluster) as client:
        assert len(client.scheduler_info(n_workers=-1)["workers"]) == len(workers)
        rows = rows_of(Pool.from_client(client).page())
    assert [name for name in rows if name in workers] == ["w9", "w10", "w11", "free"]


def test_it_goes_with_the_last_client_that_wanted_it(client, wait_until):
    plugins = set(client.cluster.scheduler.plugins)
    with Client(client.cluster.scheduler_address, set_as_default=False) as other:
        url = Pool.from_client(other).page()
        Pool.from_client(client).page()
        Pool.from_client(client).leave_page()
        assert get(url)[0] == 200
    wait_until(lambda: get(url)[0] == 404)
    assert set(client.cluster.scheduler.plugins) == plugins


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Sec-Fetch-Site": "same-origin"}, 200),
        ({"Sec-Fetch-Site": "none"}, 200),
        (
            {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"},
            200,
        ),  # a link was followed
        ({"Origin": "http://site.example"}, 403),
        ({"Host": "site.example"}, 403),
        ({"Host": "localhost:8787"}, 200),
        ({"Host": socket.gethostname()}, 200),
    ],
)
def test_other_websites_do_not_get_it(client, headers, status):
    url = Pool.from_client(client).page()
    assert get(url, headers)[0] == status


@pytest.mark.parametrize("link", ["https://site.example/{port}/status", "/proxy/{port}/status"])
def test_the_name_in_the_link_to_the_dashboard_is_its_name(client, link):
    Pool.from_client(client).leave_page()
    url = Pool.from_client(client).page()
    assert get(url, {"Host": "site.example"})[0] == 403
    with dask.config.set({"distributed.dashboard.link": link}):
        assert Pool.from_client(client).page() != url
    assert get(url, {"Host": "site.example"})[0] == 200
    Pool.from_client(client).leave_page()


def test_a_scheduler_without_a_port(client, monkeypatch):
    monkeypatch.setattr(Client, "dashboard_link", property(lambda self: None))
    with pytest.raises(PoolError, match="no HTTP server"):
        Pool.from_client(client).page()
