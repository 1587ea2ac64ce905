"""Adaptive clusters: the scheduler offers none to stop that a partition needs."""

from distributed import Event
from tests.poolpart.helpers import wait_for

from poolpart import Pool, n_workers, per_host, rest


def to_close(client):
    """What an adaptive cluster asks of the scheduler, in the way in which it asks."""

    async def ask(dask_scheduler):
        return dask_scheduler.handlers["workers_to_close"]()

    return client.run_on_scheduler(ask)


def test_a_partition_keeps_its_minimum(start):
    client = start({name: {} for name in "abcdef"})
    rules = {"A": n_workers(2, minimum=1), "B": per_host(2, minimum=2), "C": rest()}
    pool = Pool.from_client(client)
    pool.divide(rules)
    assert len(to_close(client)) == 3
    pool.dissolve()
    assert len(to_close(client)) == 6


def test_the_busy_one_is_kept_and_the_idle_one_may_go(start, wait_until):
    client = start({name: {} for name in "abc"})
    parts = Pool.from_client(client).divide({"A": rest(minimum=1)})
    event = Event("busy", client)
    busy = parts["A"].workers[1].address
    task = parts["A"].submit(wait_for, "busy", workers=busy)
    wait_until(lambda: client.cluster.scheduler.workers[busy].processing)
    assert len(to_close(client)) == 2
    assert busy not in to_close(client)
    event.set()
    assert task.result()
