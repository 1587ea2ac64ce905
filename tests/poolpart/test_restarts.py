"""Workers that are killed come back into their partition, and tasks that waited run."""

import pytest
from tests.poolpart.helpers import LONG_S, addresses, declared, join, kill, leave, worker_name

from poolpart import Partition, Pool, n_workers, rest


def kill_and_submit_at_once(client, partition, name, count=5):
    """Kill a partition's only worker and submit before the scheduler knows of it."""
    kill(client, name)
    return [partition.submit(worker_name) for _ in range(count)]


def test_a_partition_made_at_run_time(nannies, wait_until):
    part, remainder = Pool.from_client(nannies).partition("P", workers=[1], slots=3)
    for _ in range(2):
        waiting = kill_and_submit_at_once(nannies, part, "1")
        assert [future.result(LONG_S) for future in waiting] == ["1"] * 5
        assert [(w.name, w.resources) for w in part.workers] == [("1", {"P": 3})]
    # The other worker belongs to no partition, and stays so.
    assert remainder.names == ["0"]
    assert part.submit(worker_name, workers=1).result(LONG_S) == "1"  # Dask's own names are numbers
    killed = kill(nannies, "0")
    wait_until(lambda: addresses(nannies).get("0", killed) != killed)
    assert [worker.name for worker in part.workers] == ["1"]


def test_a_partition_of_a_cluster_declared_so(processes):
    gpu = Partition("GPU", processes)
    waiting = kill_and_submit_at_once(processes, gpu, "GPU-0")
    assert [future.result(LONG_S) for future in waiting] == ["GPU-0"] * 5


@pytest.mark.extended
@pytest.mark.parametrize("other", [n_workers(1), rest()])
def test_the_place_of_a_worker_that_does_not_come_back_goes_to_the_next(
    own_nannies, wait_until, monkeypatch, other
):
    monkeypatch.setattr("poolpart.steward.HOLD_S", 3.0)  # the next joins before
    parts = Pool.from_client(own_nannies).divide({"A": n_workers(1), "B": other})
    (name,) = (name for name, resources in declared(own_nannies).items() if "A" in resources)
    leave(own_nannies, int(name))
    wait_until(lambda: name not in declared(own_nannies))
    waiting = parts["A"].submit(pow, 2, 6)
    join(own_nannies, "next")
    assert waiting.result(120) == 64
    (stayed,) = declared(own_nannies).keys() - {"next"}
    assert declared(own_nannies) == {"next": {"A": 1}, stayed: {"B": 1}}
