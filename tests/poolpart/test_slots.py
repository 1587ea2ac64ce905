from __future__ import annotations

from distributed import Event, secede

from poolpart import Pool, look_at_slots


def hold(name):
    """A long-running task: frees its thread, keeps its slot."""
    secede()
    Event(name).wait(120)


def test_slots_that_long_tasks_hold_are_not_free(client, wait_until):
    partition = Pool.from_client(client).partitions()["A"]
    one, two = (worker.address for worker in partition.workers)
    assert look_at_slots(client, "A").free == {one: 2, two: 2}
    done = Event("slots-done", client=client)
    futures = [partition.submit(hold, "slots-done", worker=one) for _ in range(3)]
    keys = [future.key for future in futures]
    try:
        tasks = client.cluster.scheduler.tasks
        wait_until(lambda: all(key in tasks and tasks[key].state == "processing" for key in keys))
        wait_until(lambda: len(look_at_slots(client, "A", keys).running) == 2)
        slots = look_at_slots(client, "A", keys)
        assert slots.free == {one: -1, two: 2}
        assert slots.present == {one, two}
        assert slots.running < set(keys)
    finally:
        done.set()
    client.gather(futures)
    assert look_at_slots(client, "A", keys).running == frozenset()


def test_slots_are_free_whatever_dask_counts_after_work_stealing(client):
    """It counts a stolen task against the worker that it was taken from, for good."""

    def miscount(stolen, dask_scheduler=None):
        dask_scheduler.workers[one].used_resources["A"] += stolen
        dask_scheduler.workers[two].used_resources["A"] -= stolen

    partition = Pool.from_client(client).partitions()["A"]
    one, two = (worker.address for worker in partition.workers)
    client.run_on_scheduler(miscount, 5)
    try:
        assert look_at_slots(client, "A").free == {one: 2, two: 2}
    finally:
        client.run_on_scheduler(miscount, -5)


def test_a_partition_that_is_not_there_has_no_slots(client):
    slots = look_at_slots(client, "C", ["no-such-key"])
    assert (slots.free, slots.present, slots.running) == ({}, frozenset(), frozenset())
