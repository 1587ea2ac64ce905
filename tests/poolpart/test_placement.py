"""What tasks report of where they ran."""

import time

from poolpart import Partition, placement_violations, recorded


def twice(x, *, plus=0):
    time.sleep(0.001)
    return 2 * x + plus


def test_tasks_of_a_partition_report_their_place_and_time(client):
    before = time.time()
    futures = [Partition("A", client).submit(recorded, "s", "A", twice, i) for i in range(50)]
    results, records = zip(*(future.result() for future in futures), strict=True)
    assert list(results) == [2 * i for i in range(50)]
    assert {record.worker for record in records} == {"A-0", "A-1"}
    assert {(r.stage, r.partition, r.resources, r.items) for r in records} == {
        ("s", "A", ("A",), 1)
    }
    assert all(before <= r.start < r.stop <= time.time() for r in records)
    assert placement_violations(records) == []


def test_tasks_that_escape_are_found_out(client):
    futures = [
        client.submit(recorded, "s", "A", twice, i, plus=1, pure=False, workers=[name])
        for i, name in enumerate(["A-0", "B-0", "plain"])
    ]
    records = [future.result()[1] for future in futures]
    assert [record.worker for record in placement_violations(records)] == ["B-0", "plain"]
