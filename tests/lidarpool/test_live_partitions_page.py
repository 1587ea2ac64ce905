"""The option --page: a page while the command runs, and none afterwards."""

import json
import re
import urllib.error
import urllib.request

import pytest
from distributed import Client, Scheduler, SpecCluster, Worker

from lidarpool.live import partitions_page as module
from lidarpool.live import shown_on_page
from lidarpool.run.progress import Progress
from poolpart import has_partitions_page, partitions_page

PROGRESS = Progress(
    scans=1200,
    generated=4,
    cast=3,
    framed=2,
    collected=1,
    points=5000,
    trials=10,
    trials_done=6,
    seconds=1.5,
    replayed=7,
)


@pytest.fixture(scope="module")
def client():
    options = {"host": "127.0.0.1", "dashboard": False, "dashboard_address": "127.0.0.1:0"}
    with (
        SpecCluster(
            workers={"one": {"cls": Worker, "options": {"dashboard": False, "nthreads": 1}}},
            scheduler={"cls": Scheduler, "options": options},
            silence_logs=50,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def test_it_is_there_while_the_run_is(client, capsys):
    shown = []
    with shown_on_page(client, True, shown.append) as show:
        show(PROGRESS)
        said = capsys.readouterr()
        [url] = re.findall(r"^page of partitions: (\S+)$", said.err, re.M)
        with urllib.request.urlopen(f"{url}/data", timeout=120) as answer:
            totals = json.load(answer)["totals"]
    assert said.out == ""
    assert shown == [PROGRESS]
    assert totals == {
        "run": "running",
        "scans": "2 of 1,200",
        "points": "5,000",
        "trials": "6 of 10",
        "replayed": "7",
    }
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(url, timeout=120)


def test_without_the_option_there_is_none(client, capsys):
    with shown_on_page(client, False, print) as show:
        assert show is print
        assert not has_partitions_page(client)
    assert capsys.readouterr() == ("", "")


def test_a_lost_cluster_is_for_the_run_to_tell_of(client, monkeypatch):
    def lost(*_, **__):
        raise OSError("Connection to the scheduler closed")

    monkeypatch.setattr(module, "tell_page", lost)
    shown = []
    with shown_on_page(client, True, shown.append) as show:
        show(PROGRESS)
    assert shown == [PROGRESS]


def test_one_that_was_there_stays(client):
    partitions_page(client)
    with shown_on_page(client, True, print):
        pass
    assert has_partitions_page(client)
