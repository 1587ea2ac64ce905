"""Drivers that are killed in the middle of what they ask: it is done whole, and can be undone."""

import subprocess
import sys

import pytest
from distributed import Client
from tests.clusters import cluster_of
from tests.poolpart.helpers import LONG_S, declared, declared_by_themselves

from poolpart import Partition, Pool, n_workers, rest, steward

# Says that it is ready, does one thing when it is told to, and stays.
DRIVER = """
import sys
from distributed import Client
from poolpart import Partition, Pool, n_workers, rest
with Client(sys.argv[1]) as client:
    pool = Pool.from_client(client)
    print("ready", flush=True)
    sys.stdin.readline()
    exec(sys.argv[2])
    print("done", flush=True)
    sys.stdin.readline()
"""
RULES = '{"A": n_workers(2, exclusive=True), "B": rest(exclusive=True)}'


@pytest.fixture
def cluster():
    """Client of a cluster of four workers in this process, which others can reach."""
    workers = {name: {} for name in "abcd"}
    with cluster_of(workers, {}, host="127.0.0.1") as cluster, Client(cluster) as client:
        yield client


@pytest.fixture
def driver(cluster):
    """Start a driver that does what is given once it is told to."""
    drivers = []

    def start(what):
        command = [sys.executable, "-c", DRIVER, cluster.cluster.scheduler_address, what]
        drivers.append(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        )
        assert drivers[-1].stdout.readline() == "ready\n"
        return drivers[-1]

    yield start
    for process in drivers:
        process.kill()
        process.communicate()


def tell(process):
    process.stdin.write("\n")
    process.stdin.flush()


def known(client):
    """What the scheduler and the workers know of partitions."""
    scheduler = client.cluster.scheduler
    overridden = {name for name in vars(scheduler) if hasattr(type(scheduler), name)}
    return declared(client), declared_by_themselves(client), set(scheduler.plugins), overridden


def sizes(client):
    """Workers of each partition, as the scheduler knows them; with those on their way."""
    workers = client.cluster.scheduler.workers.values()
    return sorted("".join(name for name, slots in w.resources.items() if slots) for w in workers)


def kill_when_told(process, monkeypatch):
    """Kill the driver when the scheduler, which is in this process, first tells a worker."""
    killed = []
    call = steward.call_worker

    async def kill_and_call(*args, **kwargs):
        if not killed:
            killed.append(process.pid)
            process.kill()
            process.wait(LONG_S)
        return await call(*args, **kwargs)

    monkeypatch.setattr(steward, "call_worker", kill_and_call)
    return killed


def await_that_it_is_gone(client, wait_until):
    clients = client.cluster.scheduler.clients
    wait_until(lambda: [name for name in clients if name.startswith("Client-")] == [client.id])


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("what", "after"),
    [
        (f"pool.divide({RULES})", ["A", "A", "B", "B"]),
        ("Partition('A', client).grow(1, source='B')", ["A", "A", "A", "B"]),
        ("pool.dissolve()", ["", "", "", ""]),
    ],
)
def test_what_was_asked_is_done_whole(cluster, driver, wait_until, monkeypatch, what, after):
    before = known(cluster)
    if "divide" not in what:
        Pool.from_client(cluster).divide(
            {"A": n_workers(2, exclusive=True), "B": rest(exclusive=True)}
        )
    process = driver(what)
    killed = kill_when_told(process, monkeypatch)
    tell(process)
    wait_until(lambda: killed)
    await_that_it_is_gone(cluster, wait_until)
    wait_until(lambda: sizes(cluster) == after)
    for name in "AB":
        assert Partition(name, cluster).stats().exclusive == (name in after)
    # The next client goes on with it, and can undo all of it.
    pool = Pool.from_client(cluster)
    if {"A", "B"} <= set(after):
        assert {Partition(n, cluster).submit(pow, 2, 5).result() for n in "AB"} == {32}
        wait_until(lambda: not cluster.cluster.scheduler.tasks)
    pool.dissolve()
    # The scheduler may still be about to answer the driver, and keeps its book as long.
    wait_until(lambda: known(cluster) == before)
