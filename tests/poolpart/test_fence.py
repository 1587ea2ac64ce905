"""Fences: who is kept out, who passes, what waits, and what is left when one is lowered."""

import os
import threading
import time
import warnings

import dask
import dask.array
import pytest
from distributed import get_worker, wait, worker_client
from tests.poolpart.helpers import LONG_S

from poolpart import Pool, named

OUTSIDE = {"B-0", "plain"}


def worker_name(*_, pause_s=0.0):
    time.sleep(pause_s)
    return str(get_worker().name)


def inside(count):
    """Submit from inside a task, without a partition."""
    with worker_client() as client:
        return client.gather([client.submit(worker_name, i, pure=False) for i in range(count)])


class Counting:
    def where(self):
        return worker_name()


@pytest.fixture
def client(start, monkeypatch):
    # How long workers may take to answer, and after which time tasks that wait are told of again.
    monkeypatch.setattr("poolpart.fence.WARN_EVERY_S", 3600.0)
    client = start({key: {} for key in ("A-0", "A-1", "B-0", "plain")})
    client.cluster.scheduler.validate = True  # Dask checks itself after each step
    return client


def enclose(client, **partitions):
    """Make exclusive partitions of workers by name."""
    rules = {n: named(*workers, exclusive=True) for n, workers in partitions.items()}
    return Pool.from_client(client).divide(rules)


A = {"A": ("A-0", "A-1")}
B = {"B": ("B-0",)}


def scheduler_of(client):
    return client.cluster.scheduler


def state_of(client, name):
    return next(w for w in scheduler_of(client).workers.values() if w.name == name)


go = threading.Event()  # the workers are threads of this process


def here_after_all(*_, pause_s=0.0):
    """Wait until all are submitted: else the first have ended by then, on a slow machine."""
    go.wait(LONG_S)
    return worker_name(pause_s=pause_s)


def pile_up(client, wait_until, count=40):
    """Tasks that Dask gives to the workers at once, more than they can run; they wait for `go`."""
    go.clear()
    scheduler_of(client).WORKER_SATURATION = float("inf")
    futures = [client.submit(here_after_all, i, pause_s=0.05, pure=False) for i in range(count)]
    wait_until(lambda: len(state_of(client, "plain").processing) == count // 2)
    return futures


def submitted(client):
    return client.gather([client.submit(worker_name, i, pure=False) for i in range(40)])


def mapped(client):
    return client.gather(client.map(worker_name, range(200), pure=False))


def mapped_on_a_scheduler_without_a_queue(client):
    scheduler_of(client).WORKER_SATURATION = float("inf")
    return mapped(client)


def from_inside_others(client):
    return client.submit(inside, 40, pure=False).result(LONG_S)


def delayed(client):
    return dask.compute(*(dask.delayed(worker_name, pure=False)(i) for i in range(40)))


def dependent(client):
    """Tasks whose only input lies behind the fence."""
    behind = client.submit(bytes, 10_000_000, resources={"A": 1})
    go.clear()
    futures = [client.submit(here_after_all, behind, i, pure=False) for i in range(20)]
    go.set()
    return client.gather(futures)


def preferring_the_partition(client):
    wanted = [state_of(client, "A-0").address]
    futures = [
        client.submit(worker_name, i, workers=wanted, allow_other_workers=True, pure=False)
        for i in range(10)
    ]
    return client.gather(futures)


def actors(client):
    # Kept: an actor whose future goes before the actor asks for it anew is gone as well.
    futures = [client.submit(Counting, actor=True, key=f"counting-{i}") for i in range(6)]
    return [future.result().where().result() for future in futures]


def shuffled(client):
    """Outputs of a peer-to-peer shuffle, which chooses their workers itself."""
    whole = dask.array.ones((200, 200), chunks=(10, 200)).rechunk((200, 10), method="p2p").persist()
    wait(whole, LONG_S)
    return [w.name for w in scheduler_of(client).workers.values() if w.has_what]


@pytest.mark.extended(every=4)
@pytest.mark.parametrize(
    "way",
    [
        submitted,
        mapped,
        mapped_on_a_scheduler_without_a_queue,
        from_inside_others,
        delayed,
        dependent,
        preferring_the_partition,
        actors,
        shuffled,
    ],
)
def test_other_tasks_stay_out(client, way):
    enclose(client, **A)
    assert set(way(client)) == OUTSIDE


@pytest.mark.extended
def test_without_a_fence_they_come_in(client):
    """Else the tests above would say nothing."""
    for way in (submitted, mapped, delayed, preferring_the_partition, shuffled):
        assert not set(way(client)) <= OUTSIDE, way.__name__


@pytest.mark.extended
def test_tasks_of_the_partition_pass(client):
    parts = enclose(client, **A, **B)
    assert set(parts["A"].map(worker_name, range(20))) == {"A-0", "A-1"}
    assert set(parts["B"].map(worker_name, range(5))) == {"B-0"}
    assert set(submitted(client)) == {"plain"}
    assert len(client.run(os.getpid)) == 4  # not a task


def test_root_tasks_are_held_back_as_before(client, wait_until):
    enclose(client, **A, **B)
    go.clear()
    futures = client.map(here_after_all, range(200), pure=False)
    scheduler = scheduler_of(client)
    wait_until(lambda: len(scheduler.queued) > 150)
    assert len(state_of(client, "plain").processing) <= 2
    go.set()
    del futures


async def steal(dask_scheduler):
    """Have work stealing look for work now; who steals, if anybody does."""
    stealing = dask_scheduler.extensions["stealing"]
    stealing.balance()
    thieves = {str(move["thief"].name) for move in stealing.in_flight.values()}
    return ", ".join(thieves)


@pytest.mark.extended
def test_nothing_is_stolen_into_a_partition(client, wait_until):
    enclose(client, **A)
    futures = pile_up(client, wait_until, 60)
    go.set()
    assert {client.run_on_scheduler(steal) for _ in range(20)} <= {"", *OUTSIDE}
    assert set(client.gather(futures)) == OUTSIDE


def complaints(warned):
    """What was said of waiting tasks; what earlier tests have left may be warned of as well."""
    said = [str(warning.message) for warning in list(warned)]
    return [text for text in said if text.startswith("Tasks such as")]


@pytest.mark.extended
def test_tasks_wait_where_all_workers_are_behind_fences_and_everybody_is_told(client, wait_until):
    parts = enclose(client, **A, **B, C=["plain"])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nowhere = client.submit(worker_name, workers="nobody", pure=False)  # not for the fences
        wait_until(lambda: nowhere.key in scheduler_of(client).tasks)
        one = client.submit(worker_name, pure=False)
        many = client.map(worker_name, range(100), pure=False)
        wait_until(lambda: complaints(caught) and len(scheduler_of(client).tasks) == 102)
    [complaint] = complaints(caught)  # not one for each task
    assert f"such as '{one.key}'" in complaint
    assert "exclusive partitions (A, B, C)" in complaint
    assert not one.done()
    parts["B"].dissolve()
    assert {one.result(LONG_S), *client.gather(many)} == {"B-0"}


def test_waiting_tasks_go_to_a_worker_that_leaves_the_partition(start, wait_until):
    client = start({"A-0": {}})
    part, _ = Pool.from_client(client).partition("A", n_workers=1, exclusive=True, minimum=0)
    with pytest.warns(UserWarning, match="are waiting, because all workers") as told:
        waiting = [
            client.submit(worker_name, pure=False),
            *client.map(worker_name, range(50), pure=False),
        ]
        wait_until(lambda: complaints(told))
    part.shrink()
    assert set(client.gather(waiting)) == {"A-0"}


def place(*_, pause_s=0.001):
    time.sleep(pause_s)
    return [name for name, slots in get_worker().state.total_resources.items() if slots]


@pytest.mark.extended
def test_nothing_is_lost_while_workers_move_to_and_fro(start):
    client = start({name: {"nthreads": 2} for name in ("a", "b", "c", "d")})
    client.cluster.scheduler.validate = True
    pool = Pool.from_client(client)
    part, _ = pool.partition("P", n_workers=1, exclusive=True)
    inside = []
    outside = []
    for move in (part.grow, part.grow, part.shrink, part.grow, part.shrink, part.shrink):
        inside += [part.submit(place, pause_s=0.02) for _ in range(20)]
        outside += client.map(place, range(40), pause_s=0.01, pure=False)
        outside += [
            client.submit(place, i, key=f"{move.__name__}-{i}-{len(outside)}", pause_s=0.01)
            for i in range(4)
        ]
        move(1)
    assert client.gather(inside) == [["P"]] * len(inside)
    assert client.gather(outside).count([]) > len(outside) / 2  # some ran where P was to come
    settled = client.gather([client.submit(place, i, pure=False) for i in range(50)])
    assert settled == [[]] * 50
    pool.dissolve()
    assert "poolpart-fences" not in client.cluster.scheduler.plugins
