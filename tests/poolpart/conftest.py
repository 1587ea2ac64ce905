"""Clusters to test on: of threads, or of processes for tests that kill workers."""

from __future__ import annotations

import logging
import traceback
import uuid
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import pytest
from distributed import Client, Nanny, Scheduler
from distributed.comm import tcp
from tests.clusters import QUIET, cluster_of, import_jobqueue
from tests.daemons import wait_until
from tests.poolpart.job_queue import Queue

import poolpart
from poolpart import Partition, Pipe, Pool
from poolpart.deploy import local_cluster
from poolpart.deploy.local_processes import FixedCluster

PACKAGE = Path(poolpart.__file__).parent


class CaughtErrors(logging.Handler):
    """Texts of logged errors that were raised in poolpart."""

    def __init__(self):
        super().__init__()
        self.texts = []

    def emit(self, record):
        _, error, trace = record.exc_info or (None, None, None)
        if any(PACKAGE in Path(frame.filename).parents for frame in traceback.extract_tb(trace)):
            self.texts.append("".join(traceback.format_exception(error)))


@pytest.fixture(autouse=True)
def caught_errors():
    """Fail a test if poolpart raises an error that is only logged; return the list of errors.

    Dask and poolpart catch errors of plugins and rules on the scheduler, and go on without them. A
    test that provokes such errors clears the list.
    """
    handler = CaughtErrors()
    loggers = [logging.getLogger(name) for name in ("distributed.scheduler", "asyncio", "poolpart")]
    for logger in loggers:
        logger.addHandler(handler)
    yield handler.texts
    for logger in loggers:
        logger.removeHandler(handler)
    assert not handler.texts, "\n".join(handler.texts)


def thread_cluster(workers):
    """Return a cluster in this process, whose tasks get the objects of the tests.

    `workers` has options of each worker, by name.
    """
    return cluster_of(workers, {"protocol": "inproc://"})


@pytest.fixture
def start():
    """Start a cluster of threads from worker options by name; returns its client."""
    with ExitStack() as stack:

        def start(workers):
            return stack.enter_context(Client(stack.enter_context(thread_cluster(workers))))

        yield start


@pytest.fixture(scope="session")
def _threads():
    workers = {
        "A-0": {"resources": {"A": 2}, "nthreads": 2},
        "A-1": {"resources": {"A": 2}, "nthreads": 2},
        "B-0": {"resources": {"B": 1}},
        "plain": {},
    }
    with thread_cluster(workers) as cluster:
        yield cluster


@pytest.fixture
def client(_threads):
    """Client of a cluster of threads: A-0 and A-1 of two slots each, B-0, and a plain worker."""
    with Client(_threads) as client:
        yield client
    wait_until(lambda: not _threads.scheduler.tasks)


@pytest.fixture
def a(client):
    return Partition("A", client)


@pytest.fixture
def b(client):
    return Partition("B", client)


@pytest.fixture(scope="session")
def processes():
    """Client of a local cluster of processes: workers GPU, IO with four slots, and OTHER."""
    with (
        local_cluster({"GPU": (1, 1), "IO": (1, 4), "OTHER": (1, 1)}) as cluster,
        Client(cluster) as client,
    ):
        yield client


def nanny_cluster():
    """Cluster of two worker processes, 0 and 1, that belong to no partition."""
    options = {"nthreads": 1, "host": "127.0.0.1", "dashboard": False, "silence_logs": QUIET}
    spec = {name: {"cls": Nanny, "options": options} for name in (0, 1)}
    scheduler = {
        "cls": Scheduler,
        "options": {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "dashboard": False},
    }
    # Not a bare SpecCluster: it gives up a worker that is dead 15 seconds after another death.
    return FixedCluster(workers=spec, scheduler=scheduler, silence_logs=QUIET)


@pytest.fixture(scope="session")
def _nannies():
    with nanny_cluster() as cluster:
        yield cluster


@pytest.fixture
def patient(monkeypatch):
    """Have the scheduler wait long: a busy machine needs time to start a worker again."""
    monkeypatch.setattr("poolpart.steward.HOLD_S", 3600.0)
    monkeypatch.setattr("poolpart.division.PATIENCE_S", 120.0)


@pytest.fixture
def nannies(_nannies, patient):
    """Client of a cluster of two worker processes that belong to no partition.

    Tests share the cluster: workers may be killed, but not changed for good.
    """
    with Client(_nannies) as client:
        client.wait_for_workers(2, timeout=120)
        yield client
        client.wait_for_workers(2, timeout=120)
        Pool(client, []).dissolve(timeout_s=120)
        wait_until(lambda: not any(map(partitions_of, _nannies.scheduler.workers.values())))
    wait_until(lambda: not _nannies.scheduler.tasks)


def partitions_of(worker):
    """Return the partitions of a worker, as the scheduler knows the worker."""
    return [name for name, slots in worker.resources.items() if slots]


@pytest.fixture
def own_nannies(patient):
    """Client of a `nanny_cluster` that a test may damage."""
    with nanny_cluster() as cluster, Client(cluster) as client:
        yield client


@pytest.fixture
def queue(monkeypatch):
    """Stand-in for the queue of Slurm; partitions look at their jobs 20 times a second."""
    jobs = import_jobqueue().slurm.SLURMJob
    queue = Queue()
    monkeypatch.setattr(jobs, "_submit_job", lambda job, path: queue.submit(job, path))
    monkeypatch.setattr(jobs, "_close_job", lambda job, *arguments: queue.close(job, *arguments))
    monkeypatch.setattr("poolpart.deploy.clusters.ADAPT_EVERY_S", 0.05)
    monkeypatch.setattr("poolpart.deploy.clusters.CHECK_EVERY_S", 0.05)
    return queue


@pytest.fixture
def make_pipe():
    """Return a function that makes pipes of random names, and delete these pipes."""
    pipes = []

    def make(client, capacity=3, producers=1):
        name = f"test-{uuid.uuid4().hex[:8]}"
        pipes.append(Pipe(name, capacity, client, producers).create())
        return pipes[-1]

    yield make
    for pipe in pipes:
        pipe.delete()


@pytest.fixture
def received(monkeypatch):
    """Count the bytes that this process, with client and scheduler, receives: {peer: bytes}."""
    counts = Counter()
    read = tcp.read_bytes_rw

    async def count(stream, n):
        counts[stream.socket.getpeername()[:2]] += n
        return await read(stream, n)

    monkeypatch.setattr(tcp, "read_bytes_rw", count)
    return counts


@pytest.fixture(name="wait_until")
def _wait_until():
    return wait_until
