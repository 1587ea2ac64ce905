"""Nannies that go with their workers: nobody waits for those workers to come back."""

import asyncio
import socket

from poolpart import Pool, book, n_workers
from poolpart.nannies import has_gone


def declared(client):
    workers = client.cluster.scheduler.workers.values()
    return {worker.name: dict(worker.resources) for worker in workers}


def test_nobody_listens():
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = "tcp://{}:{}".format(*server.getsockname())
        assert not asyncio.run(has_gone(address))
    assert asyncio.run(has_gone(address))
    assert not asyncio.run(has_gone("inproc://127.0.0.1/1/2"))


def test_the_place_of_a_worker_that_was_stopped_goes_to_the_next(nannies, wait_until, monkeypatch):
    monkeypatch.setattr(book, "HOLD_S", 3600.0)
    parts = Pool.from_client(nannies).divide({"A": n_workers(1), "B": n_workers(1)})
    (name,) = (name for name, resources in declared(nannies).items() if "A" in resources)
    spec = nannies.cluster.worker_spec.pop(name)
    nannies.sync(nannies.cluster._correct_state)
    wait_until(lambda: name not in declared(nannies))
    waiting = parts["A"].submit(pow, 2, 6)
    nannies.cluster.worker_spec["next"] = spec
    nannies.sync(nannies.cluster._correct_state)
    assert waiting.result(30) == 64
    assert declared(nannies)["next"] == {"A": 1}
