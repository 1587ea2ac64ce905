"""Workers that are killed come back into their partition, and tasks that waited run."""

import asyncio
import os
import signal
import socket
import subprocess
import sys

import pytest
from distributed import Client, get_worker

from poolpart import Partition, Pool, n_workers, worker_identities
from poolpart.reconciler import has_gone

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


@pytest.fixture
def nameless():
    """Client of a cluster from the command line, whose worker was given no name."""
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
    scheduler += ["--port", "0", "--dashboard-address", "127.0.0.1:0"]
    with subprocess.Popen(scheduler, stderr=subprocess.PIPE, text=True) as first:
        address = next(line.split()[-1] for line in first.stderr if "Scheduler at:" in line)
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
        worker += ["--host", "127.0.0.1", "--no-dashboard"]
        with subprocess.Popen(worker, stderr=subprocess.DEVNULL) as second:
            with Client(address) as client:
                client.wait_for_workers(1, timeout=LONG_S)
                yield client
            second.send_signal(signal.SIGINT)
            second.wait(LONG_S)
        first.send_signal(signal.SIGINT)


def test_a_worker_without_a_name(nameless):
    pool = Pool.from_client(nameless)
    assert pool.names == [worker.address for worker in pool]
    part, _ = pool.partition("P", n_workers=1)
    waiting = kill_and_submit_at_once(nameless, part, pool.names[0])
    assert len({future.result(LONG_S) for future in waiting}) == 1
    assert [worker.resources for worker in part.workers] == [{"P": 1}]


# -- nannies that go with their workers: nobody waits for those to come back -----------


def declared_by(client):
    workers = client.cluster.scheduler.workers.values()
    return {worker.name: dict(worker.resources) for worker in workers}


def test_nobody_listens():
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = "tcp://{}:{}".format(*server.getsockname())
        assert not asyncio.run(has_gone(address))
    assert asyncio.run(has_gone(address))
    assert not asyncio.run(has_gone("inproc://127.0.0.1/1/2"))


def test_the_place_of_a_worker_that_was_stopped_goes_to_the_next(own_nannies, wait_until):
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
