"""Nannies that go with their workers: nobody waits for those workers to come back."""

import asyncio
import socket

import pytest

from poolpart import Pool, WorkerInfo, book, n_workers, per_gpu, rest
from poolpart.book import Book, Seat
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


@pytest.mark.parametrize("others", [n_workers(1), rest()])
def test_the_place_of_a_worker_that_was_stopped_goes_to_the_next(
    own_nannies, wait_until, monkeypatch, others
):
    """Also if that one has joined before, and was given to what takes the rest."""
    monkeypatch.setattr(book, "HOLD_S", 3600.0)
    parts = Pool.from_client(own_nannies).divide({"A": n_workers(1), "B": others})
    (name,) = (name for name, resources in declared(own_nannies).items() if "A" in resources)
    spec = own_nannies.cluster.worker_spec.pop(name)
    own_nannies.sync(own_nannies.cluster._correct_state)
    wait_until(lambda: name not in declared(own_nannies))
    waiting = parts["A"].submit(pow, 2, 6)
    own_nannies.cluster.worker_spec["next"] = spec
    own_nannies.sync(own_nannies.cluster._correct_state)
    assert waiting.result(120) == 64
    (stayed,) = declared(own_nannies).keys() - {"next"}
    assert declared(own_nannies) == {"next": {"A": 1}, stayed: {"B": 1}}


# -- who inherits a place, by the book alone -------------------------------------------


def seat(name, partition, **given):
    info = WorkerInfo(name, f"tcp://{name}", "h", 1, gpus=given.pop("gpus", ()))
    return Seat(name, info, {}, partition=partition, nanny="tcp://n", **given)


def a_book(*seats, **rules):
    return Book(rules=rules, seats={seat.key: seat for seat in seats}, names=set(rules))


def test_only_whoever_joined_since_inherits(monkeypatch):
    monkeypatch.setattr(book, "HOLD_S", 0.0)
    gone = seat("gone", "A", absent_since=10.0)
    before, after = seat("before", "B", joined=9.0), seat("after", "B", joined=11.0)
    rules = {"A": n_workers(1), "B": rest(minimum=1)}
    mine = a_book(gone, before, after, **rules)
    assert mine.vacated() == [gone]
    assert mine.vacated() == []
    assert mine.replacement(gone) is after
    assert a_book(gone, after, **rules).replacement(gone) is None  # B has none to spare
    assert a_book(gone, before, seat("b", "B"), **rules).replacement(gone) is None
    lent = seat("lent", "B", joined=11.0, home="C")
    assert a_book(gone, before, lent, **rules, C=n_workers(1)).replacement(gone) is None
    filled = a_book(gone, before, after, seat("next", "A", joined=12.0), **rules)
    assert filled.replacement(gone) is None


def test_a_place_at_a_gpu_is_not_for_a_worker_without(monkeypatch):
    monkeypatch.setattr(book, "HOLD_S", 0.0)
    gone = seat("gone", "GPU", absent_since=10.0, gpus=("x",))
    there = seat("there", "GPU", gpus=("y",))
    without, one = seat("without", "B", joined=11.0), seat("one", "B", joined=12.0, gpus=("x",))
    rules = {"GPU": per_gpu(1), "B": rest()}
    assert a_book(gone, there, without, one, **rules).replacement(gone) is one
    assert a_book(gone, there, without, **rules).replacement(gone) is None
