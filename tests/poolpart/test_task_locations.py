"""Free slots, long-running tasks and tasks that the scheduler knows."""

from distributed import Event, secede

from poolpart import Partition, Pool
from poolpart.task_locations import take_snapshot


def hold(name):
    """A long-running task: frees its thread, keeps its slot."""
    secede()
    Event(name).wait(120)


def test_slots_that_long_tasks_hold_are_not_free(client, wait_until):
    partition = Pool.from_client(client).partitions()["A"]
    one, two = (worker.address for worker in partition.workers)
    assert take_snapshot(client, "A").free == {one: 2, two: 2}
    done = Event("slots-done", client=client)
    futures = [partition.submit(hold, "slots-done", workers=one) for _ in range(3)]
    keys = [future.key for future in futures]

    def running():
        seen = take_snapshot(client, "A", keys)
        return [place.state for place in seen.tasks.values()].count("processing") == 3 and (
            sum(map(seen.is_long_running, keys)) == 2
        )

    try:
        wait_until(running)
        seen = take_snapshot(client, "A", [*keys, "never-submitted"])
        assert seen.free == {one: -1, two: 2}
        assert seen.members == {one, two}
        assert seen.tasks.keys() == set(keys)
        assert {place.workers for place in seen.tasks.values()} == {(one,)}
        assert seen.slots == 4  # free or not
    finally:
        done.set()
    client.gather(futures)
    assert not any(map(take_snapshot(client, "A", keys).is_long_running, keys))


def test_slots_are_free_whatever_dask_counts_after_work_stealing(client):
    """It counts a stolen task against the worker that it was taken from, for good."""

    def miscount(stolen, dask_scheduler=None):
        dask_scheduler.workers[one].used_resources["A"] += stolen
        dask_scheduler.workers[two].used_resources["A"] -= stolen

    partition = Pool.from_client(client).partitions()["A"]
    one, two = (worker.address for worker in partition.workers)
    client.run_on_scheduler(miscount, 5)
    try:
        assert take_snapshot(client, "A").free == {one: 2, two: 2}
    finally:
        client.run_on_scheduler(miscount, -5)


def test_workers_that_take_no_tasks_have_no_slots(start):
    client = start({"a": {"resources": {"A": 2}, "nthreads": 2}, "b": {"resources": {"A": 1}}})
    partition = Partition("A", client)
    a, b = (worker.address for worker in partition.workers)
    assert take_snapshot(client, "A").slots == 3
    client.run_on_scheduler(
        lambda dask_scheduler: dask_scheduler.handle_worker_status_change("paused", a, "test")
    )
    seen = take_snapshot(client, "A")
    assert (seen.free, seen.slots, seen.members) == ({b: 1}, 1, {a, b})
