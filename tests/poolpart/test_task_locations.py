"""Free slots, long-running tasks and tasks that the scheduler knows."""

from __future__ import annotations

from distributed import Event, secede

from poolpart import Partition, Pool, Slots, look_at_slots


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
        assert slots.total == 4  # free or not
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
    assert slots == Slots({}, frozenset(), frozenset())


def test_tasks_that_the_scheduler_has_heard_of_are_known(client, wait_until):
    event = Event("slots-known", client=client)
    running = Partition("A", client).submit(event.wait, 120)
    waiting = Partition("nobody", client).submit(pow, 2, 3)
    try:
        keys = [running.key, waiting.key, "never-submitted"]
        wait_until(lambda: len(look_at_slots(client, "A", keys).known) > 1)
        slots = look_at_slots(client, "A", keys)
        assert slots.known == {running.key, waiting.key}
        assert slots.running == frozenset()  # it has not seceded
    finally:
        event.set()
        running.result(120)
        waiting.cancel()


def test_workers_that_take_no_tasks_have_no_slots(start):
    client = start({"a": {"resources": {"A": 2}, "nthreads": 2}, "b": {"resources": {"A": 1}}})
    partition = Partition("A", client)
    a, b = (worker.address for worker in partition.workers)
    assert look_at_slots(client, "A").total == 3
    client.run_on_scheduler(
        lambda dask_scheduler: dask_scheduler.handle_worker_status_change("paused", a, "test")
    )
    slots = look_at_slots(client, "A")
    assert (slots.free, slots.total, slots.present) == ({b: 1}, 1, {a, b})


def test_what_is_free_without_some_workers():
    slots = Slots({"a": 2, "b": 1}, frozenset("ab"), frozenset("k"), known=frozenset("k"), total=3)
    without = slots.without(["a", "unknown"])
    assert without.free == {"b": 1}
    assert (without.present, without.known, without.total) == (slots.present, slots.known, 3)
    assert slots.free == {"a": 2, "b": 1}
