"""The page of partitions: served by the scheduler, self-contained, and safe with users' names."""

import base64
import hashlib
import json
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from importlib.resources import files

import pytest
from distributed import Client, Scheduler, SpecCluster, Worker, get_worker

from poolpart import Partition, Pipe, Pool, PoolError
from poolpart.fence import raise_fence
from poolpart.page import partitions_page, remove_partitions_page, snapshot, tell_page
from poolpart.stats import Ran, statistics_of

LONG_S = 120.0
NASTY = "<script>alert('x')</script>&\"'"
PAGE = files("poolpart").joinpath("page.html").read_text(encoding="utf-8")


def get(url):
    """Status, headers and text of an answer."""
    try:
        with urllib.request.urlopen(url, timeout=LONG_S) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read().decode()


def data_of(url, since=0):
    status, headers, text = get(f"{url}/data?since={since}")
    assert (status, headers["Content-Type"]) == (200, "application/json; charset=UTF-8")
    return json.loads(text)


def work(_=None):
    return str(get_worker().name)


def broken():
    raise ValueError("broken")


@contextmanager
def cluster(dashboard):
    scheduler = {"host": "127.0.0.1", "dashboard": dashboard, "dashboard_address": "127.0.0.1:0"}
    workers = {NASTY: {"resources": {"A": 2}}, "plain": {}}
    options = {"nthreads": 2, "dashboard": False, "host": "127.0.0.1"}
    with (
        SpecCluster(
            workers={n: {"cls": Worker, "options": {**options, **o}} for n, o in workers.items()},
            scheduler={"cls": Scheduler, "options": scheduler},
            silence_logs=50,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture
def client():
    with cluster(dashboard=True) as client:
        yield client


def test_it_is_served_and_taken_away(client):
    url = partitions_page(client)
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/partitions", url)
    status, headers, text = get(url)
    assert (status, headers["Content-Type"], text) == (200, "text/html; charset=UTF-8", PAGE)
    assert headers["Cache-Control"] == "no-store"
    assert partitions_page(client) == url  # once more changes nothing
    applications = client.cluster.scheduler.http_application.applications
    assert sum(type(a).__name__ == "PageApplication" for a in applications) == 1
    # The rest of the dashboard is as it was.
    assert get(url.replace("partitions", "json/counts.json"))[0] == 200
    assert get(f"{url}/nonsense")[0] == 404

    remove_partitions_page(client)
    remove_partitions_page(client)
    assert [get(gone)[0] for gone in (url, f"{url}/data")] == [404, 404]
    assert get(url.replace("partitions", "json/counts.json"))[0] == 200


def test_what_it_tells(client, wait_until):
    url = partitions_page(client)
    part = Partition("A", client)
    results = [part.submit(work, i) for i in range(6)]
    failing = part.submit(broken)
    pipe = Pipe("frames-12345678", 5, client).create()
    try:
        for item in range(3):
            pipe.put(item)
        client.gather(results)
        wait_until(failing.done)
        raise_fence(client, "A")
        tell_page(client, replayed=3, note=NASTY)
        data = data_of(url)
        pipe.fail("the reason")
        assert data_of(url)["pipes"] == [
            {
                "name": "frames-12345678",
                "depth": 3,
                "state": "failed",
                "failure": "the reason",
            }
        ]
    finally:
        pipe.delete()
    assert {(p["name"], p["exclusive"]) for p in data["partitions"]} == {("A", True), ("", False)}
    [stages] = [p["stages"] for p in data["partitions"] if p["name"] == "A"]
    assert (stages["work"]["done"], stages["broken"]["failed"]) == (6, 1)
    assert {(w["name"], w["partition"], w["slots"], w["threads"]) for w in data["workers"]} == {
        (NASTY, "A", 2, 2),
        ("plain", "", 2, 2),
    }
    assert data["pipes"][0]["depth"] == 3
    assert data["pipes"][0]["state"] == "open"
    assert data["totals"] == {"replayed": "3", "note": NASTY[:40]}
    # Tasks that have run; told once.
    assert [(worker, stage) for worker, stage, *_ in data["tasks"]].count((NASTY, "work")) == 6
    assert all(start <= stop for _, _, start, stop, _ in data["tasks"])
    assert data_of(url, since=data["ran"])["tasks"] == []
    assert len(data_of(url, since=data["ran"] - 2)["tasks"]) == 2
    assert len(data_of(url, since="nonsense")["tasks"]) == 7
    assert data_of(url)["pipes"] == []


go = threading.Event()  # the workers are threads of this process


def hold():
    go.wait(LONG_S)


def test_running_tasks_are_told_by_heartbeat(client, wait_until):
    url, before, told = partitions_page(client), time.time(), []
    go.clear()
    task = Partition("A", client).submit(hold, key="hold-1")

    def executing():
        told[:] = [task for worker in data_of(url)["workers"] for task in worker["executing"]]
        return told

    try:
        wait_until(executing)
    finally:
        go.set()
    [(key, stage, start)] = told
    assert (key, stage) == ("hold-1", "hold")
    # By two clocks, of the worker's message and of the task, read one after the other.
    assert before - 1 < start <= time.time()
    task.result(LONG_S)


def test_the_page_needs_nothing_from_elsewhere():
    assert not re.search(r"""https?:|//cdn|(?:src|href)\s*=|@import|url\(""", PAGE)
    assert len(re.findall(r"\bfetch\(", PAGE)) == 1
    assert 'fetch("partitions/data' in PAGE


def test_names_of_users_stay_text(client):
    """Nothing in the script makes HTML of text, and the browser runs only that script."""
    assert not re.search(
        r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|new Function", PAGE
    )
    url = partitions_page(client)
    policy = get(url)[1]["Content-Security-Policy"]
    [script] = re.findall(r"<script>(.*?)</script>", PAGE, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe-inline" not in policy.split("style-src")[0]
    # A browser that opens the data itself is told that they are not a page.
    _, headers, text = get(f"{url}/data")
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "</script>" not in text


def test_pools_have_a_page_and_dissolving_takes_it_away():
    with cluster(dashboard=False) as client:
        scheduler = client.cluster.scheduler
        before = list(scheduler.http_application.applications), set(scheduler.plugins)
        pool = Pool.from_client(client)
        pool.partition("P", workers=["plain"])
        url = pool.page()
        assert [p["name"] for p in data_of(url)["partitions"]] == ["A", "P", ""]
        pool.dissolve()
        assert get(url)[0] == 404
        assert (list(scheduler.http_application.applications), set(scheduler.plugins)) == before


def test_a_scheduler_without_a_port(client, monkeypatch):
    monkeypatch.setattr(Client, "dashboard_link", property(lambda self: None))
    with pytest.raises(PoolError, match="no HTTP server"):
        partitions_page(client)


def test_an_answer_has_a_bounded_size_whatever_piles_up():
    with cluster(dashboard=False) as client:
        scheduler = client.cluster.scheduler
        partitions_page(client)
        statistics = statistics_of(scheduler)
        for second in range(5000):
            statistics.recent.append(Ran("plain", "", "work", second, second + 1, False))
            statistics.ran += 1
        assert len(snapshot(scheduler, 0)["tasks"]) == 4000
        assert len(snapshot(scheduler, 4990)["tasks"]) == 10
        assert len(json.dumps(snapshot(scheduler, 5000))) < 5000


@pytest.fixture
def outside():
    """Address of a scheduler from the command line."""
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
    command += ["--port", "0", "--dashboard-address", "127.0.0.1:0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        yield next(line.split()[-1] for line in process.stderr if "Scheduler at:" in line)
        process.send_signal(signal.SIGINT)
        process.wait(LONG_S)


def test_a_cluster_that_somebody_else_started(outside):
    with Client(outside) as client:
        url = partitions_page(client)
    # It stays when the client has gone.
    assert get(url)[2] == PAGE
    assert data_of(url)["workers"] == []
