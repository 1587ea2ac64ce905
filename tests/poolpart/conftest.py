"""Clusters to test on: of threads where nothing is killed, of processes where something is."""

from __future__ import annotations

import time
import uuid
from contextlib import ExitStack

import pytest
from distributed import Client, Nanny, Scheduler, SpecCluster, Worker

from poolpart import Pipe, local_cluster

QUIET = 50  # logging level: the workers that tests kill are not news


def thread_cluster(workers):
    """Cluster in this process; `workers` gives options by name."""
    spec = {
        name: {"cls": Worker, "options": {"nthreads": 1, "dashboard": False, **options}}
        for name, options in workers.items()
    }
    scheduler = {
        "cls": Scheduler,
        "options": {
            "protocol": "inproc://",
            "dashboard": False,
            "dashboard_address": "127.0.0.1:0",
        },
    }
    return SpecCluster(workers=spec, scheduler=scheduler, silence_logs=QUIET)


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
    """Client of a cluster of threads: A with two workers of two slots, B with one, one plain."""
    with Client(_threads) as client:
        yield client
    wait_until(lambda: not _threads.scheduler.tasks)


@pytest.fixture(scope="session")
def processes():
    """Client of a local cluster of processes: GPU, LIDAR and OTHER, one worker each."""
    with (
        local_cluster(gpu_workers=1, lidar_slots=4, other_workers=1, dashboard_port=0) as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture
def nannies(monkeypatch):
    """Client of a cluster of two worker processes that belong to no partition."""
    # A busy machine needs longer than that to start a worker again.
    monkeypatch.setattr("poolpart.book.HOLD_S", 3600.0)
    monkeypatch.setattr("poolpart.declare.PATIENCE_S", 120.0)
    options = {"nthreads": 1, "host": "127.0.0.1", "dashboard": False, "silence_logs": QUIET}
    spec = {name: {"cls": Nanny, "options": options} for name in (0, 1)}
    scheduler = {
        "cls": Scheduler,
        "options": {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "dashboard": False},
    }
    with (
        SpecCluster(workers=spec, scheduler=scheduler, silence_logs=QUIET) as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture
def make_pipe():
    """Make pipes with names of their own; those that a test leaves are deleted."""
    made = []

    def make(client, capacity=3):
        made.append(Pipe(f"test-{uuid.uuid4().hex[:8]}", capacity, client).create())
        return made[-1]

    yield make
    for pipe in made:
        pipe.delete()


def wait_until(condition, timeout_s=120.0):
    """Wait for something that happens by itself; fail the test when it does not."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "what was waited for did not happen"
        time.sleep(0.01)


@pytest.fixture(name="wait_until")
def _wait_until():
    return wait_until
