"""Workers that are killed come back into their partition, and tasks that waited run."""

import os
import signal

from distributed import get_worker

from poolpart import Partition, Pool, n_workers, worker_identities

LONG_S = 120.0


def here():
    return str(get_worker().name)


def addresses(client):
    """Addresses of the workers by name."""
    workers = worker_identities(client).items()
    return {str(worker["name"]): address for address, worker in workers}


def kill(client, name):
    """Kill a worker's process; returns the address that it had."""
    address = addresses(client)[name]
    os.kill(client.run(os.getpid, workers=[address])[address], signal.SIGKILL)
    return address


def kill_and_submit_at_once(client, partition, name, count=5):
    """Kill a partition's only worker and submit before the scheduler knows of it."""
    kill(client, name)
    return [partition.submit(here) for _ in range(count)]


def test_a_partition_made_at_run_time(nannies, wait_until):
    part, rest = Pool.from_client(nannies).partition("P", workers=[1], slots=3)
    for _ in range(2):
        waiting = kill_and_submit_at_once(nannies, part, "1")
        assert [future.result(LONG_S) for future in waiting] == ["1"] * 5
        assert [(w.name, w.resources) for w in part.workers] == [("1", {"P": 3})]
    # The other worker belongs to no partition, and stays so.
    assert rest.names == ["0"]
    killed = kill(nannies, "0")
    wait_until(lambda: addresses(nannies).get("0", killed) != killed)
    assert [worker.name for worker in part.workers] == ["1"]


def test_a_partition_that_was_made_twice_keeps_the_later_slots(nannies):
    pool = Pool.from_client(nannies)
    pool.partition("P", workers=["0"], slots=1)
    part, _ = pool.partition("P", n_workers=1, slots=4)
    waiting = kill_and_submit_at_once(nannies, part, "0")
    assert [future.result(LONG_S) for future in waiting] == ["0"] * 5
    assert [(w.name, w.resources) for w in part.workers] == [("0", {"P": 4})]


def test_a_partition_of_a_cluster_declared_so(processes):
    gpu = Partition("GPU", processes)
    waiting = kill_and_submit_at_once(processes, gpu, "GPU-0")
    assert [future.result(LONG_S) for future in waiting] == ["GPU-0"] * 5


def declared_by(client):
    workers = client.cluster.scheduler.workers.values()
    return {worker.name: dict(worker.resources) for worker in workers}


def test_the_place_of_a_worker_that_does_not_come_back_goes_to_the_next(
    own_nannies, wait_until, monkeypatch
):
    monkeypatch.setattr("poolpart.steward.HOLD_S", 1.0)
    parts = Pool.from_client(own_nannies).divide({"A": n_workers(1), "B": n_workers(1)})
    (name,) = (name for name, resources in declared_by(own_nannies).items() if "A" in resources)
    spec = own_nannies.cluster.worker_spec.pop(name)
    own_nannies.sync(own_nannies.cluster._correct_state)
    wait_until(lambda: name not in declared_by(own_nannies))
    waiting = parts["A"].submit(pow, 2, 6)
    own_nannies.cluster.worker_spec["next"] = spec
    own_nannies.sync(own_nannies.cluster._correct_state)
    assert waiting.result(120) == 64
    (stayed,) = declared_by(own_nannies).keys() - {"next"}
    assert declared_by(own_nannies) == {"next": {"A": 1}, stayed: {"B": 1}}
