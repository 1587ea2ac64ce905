"""What tasks report of where they ran."""

import time

import pytest
from distributed import Client
from tests.clusters import cluster_of

from lidarpool.run.pipeline.task_records import call_recorded, placement_violations


@pytest.fixture
def client():
    """Client of a cluster of threads: a worker of A, one of B, and a plain one."""
    workers = {"A-0": {"resources": {"A": 2}}, "B-0": {"resources": {"B": 1}}, "plain": {}}
    with cluster_of(workers, {"protocol": "inproc://"}) as cluster, Client(cluster) as client:
        yield client


def twice(x, *, plus=0):
    time.sleep(0.001)
    return 2 * x + plus


def test_tasks_report_time_and_place_and_those_that_escape_are_found_out(client):
    before = time.time()
    futures = [
        client.submit(call_recorded, "s", "A", twice, i, plus=1, pure=False, workers=[name])
        for i, name in enumerate(["A-0", "B-0", "plain"])
    ]
    results, records = zip(*(future.result() for future in futures), strict=True)
    assert results == (1, 3, 5)
    assert all(before <= r.start < r.stop <= time.time() for r in records)
    assert (records[0].stage, records[0].resources, records[0].items) == ("s", ("A",), 1)
    assert [record.worker for record in placement_violations(records)] == ["B-0", "plain"]
