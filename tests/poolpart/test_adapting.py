"""Partitions whose jobs come and go with their work, and adaptive clusters of Dask itself.

The queue is made up, and its jobs are workers of this process; `tests/system/test_queues.py` has a
real one.
"""

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import dask
import pytest
from distributed import Client, Event, get_client, secede, wait
from tests.clusters import import_jobqueue
from tests.poolpart.helpers import LONG_S, twice, wait_for, worker_name
from tests.poolpart.job_queue import SCHEDULER

import poolpart.adapting
import poolpart.deploy.clusters
from poolpart import Partition, Pool, PoolError, n_workers, per_host, rest
from poolpart.deploy import start_partitions
from poolpart.task_locations import take_snapshot

IDLE_S = 0.2


@contextmanager
def cluster_of(partitions: dict[str, dict[str, Any]], **options: Any) -> Iterator[Client]:
    """Client of a cluster of jobs."""
    with import_jobqueue().SLURMCluster(
        cores=2, processes=1, memory="2GB", scheduler_options=SCHEDULER
    ) as cluster:
        start_partitions(cluster, partitions, **options)
        with Client(cluster) as client:
            yield client


def adaptive(minimum: int, maximum: int, **options: Any) -> dict[str, Any]:
    return {"adapt": [minimum, maximum], "idle_s": IDLE_S, **options}


@pytest.mark.extended
def test_jobs_are_of_the_partition_that_has_work_and_go_when_it_is_done(queue, wait_until):
    with cluster_of({"GPU": adaptive(0, 3), "IO": adaptive(0, 3), "FIX": {}}) as client:
        gpu = Partition("GPU", client)
        io = Partition("IO", client)
        assert queue.submitted == ["FIX-0"]
        tasks = [gpu.submit(wait_for, "go") for _ in range(8)]
        wait_until(lambda: len(gpu) == 3)
        assert len(io) == 0
        Event("go", client).set()
        client.gather(tasks)
        names = {gpu.submit(worker_name).result(LONG_S) for _ in range(5)}
        assert names <= {"GPU-0", "GPU-1", "GPU-2"}
        del tasks
        wait_until(lambda: len(gpu) == 0)
        time.sleep(5 * IDLE_S)
        assert queue.submitted.count("FIX-0") == 1
        assert len(Partition("FIX", client)) == 1
        assert sorted(queue.submitted) == ["FIX-0", "GPU-0", "GPU-1", "GPU-2"]
        wait_until(lambda: list(queue.workers) == ["0"])
        # Later ones have names of their own.
        assert gpu.submit(worker_name).result(LONG_S) == "GPU-3"
        assert Pool.from_client(client).partitions().keys() == {"FIX", "GPU", "IO"}


@pytest.mark.extended
def test_the_minimum_stays_and_the_range_can_be_changed(queue, wait_until):
    with cluster_of({"GPU": adaptive(1, 2)}) as client:
        gpu = Partition("GPU", client)
        wait_until(lambda: len(gpu) == 1)
        time.sleep(5 * IDLE_S)
        assert len(gpu) == 1
        gpu.adapt(3, 3, idle_s=IDLE_S)
        wait_until(lambda: len(gpu) == 3)
        gpu.adapt(0, 3, idle_s=IDLE_S)
        wait_until(lambda: len(gpu) == 0)
        assert queue.cancelled == []


def secedes(event):
    secede()
    return wait_for(event)


def tell_and_wait(event):
    Event(f"{event}-began").set()
    return wait_for(event)


class Counter:
    """An actor."""


def is_kept(partition, queue, begin):
    """Whether the one worker stays that has what `begin` begins; it ends with what that returns."""
    partition.adapt(1, 1)
    partition.submit(worker_name).result(LONG_S)
    began = len(queue.submitted)
    end = begin()
    partition.adapt(0, 1, idle_s=IDLE_S)
    time.sleep(2.5 * IDLE_S)
    kept = len(partition) == 1 and len(queue.submitted) == began
    end()
    return kept


@pytest.mark.slow
def test_a_worker_is_kept_for_what_would_be_lost_with_it(queue, wait_until):
    events = itertools.count()
    with cluster_of({"GPU": adaptive(0, 1)}) as client:
        gpu = Partition("GPU", client)

        def runs(function):
            name = f"end-{next(events)}"
            task = gpu.submit(function, name)

            def end():
                Event(name, client).set()
                task.result(LONG_S)
                task.release()

            return end

        def has_result():
            task = gpu.submit(twice, 2)
            wait(task)
            return lambda: (task.result(LONG_S), task.release())

        def has_data():
            data = client.scatter([1], workers=[gpu.workers[0].address])
            return data.clear

        def has_actor():
            actor = [client.submit(Counter, actor=True, resources={"GPU": 1})]
            wait(actor)
            return actor.clear

        def runs_what_was_cancelled():
            name = f"end-{next(events)}"
            task = gpu.submit(tell_and_wait, name)
            [worker] = client.cluster.scheduler.workers.values()
            assert Event(f"{name}-began", client).wait(LONG_S)
            task.cancel()
            wait_until(lambda: not worker.processing)
            return Event(name, client).set

        begins = [lambda: runs(wait_for), lambda: runs(secedes)]
        begins += [has_result, has_data, has_actor, runs_what_was_cancelled]
        for begin in begins:
            assert is_kept(gpu, queue, begin)
            wait_until(lambda: len(gpu) == 0)


def test_a_job_in_the_queue_is_cancelled_when_its_work_is_gone(queue, wait_until):
    queue.held = True
    with cluster_of({"GPU": adaptive(0, 4)}) as client:
        gpu = Partition("GPU", client)
        tasks = [gpu.submit(worker_name) for _ in range(3)]
        wait_until(lambda: take_snapshot(client, "GPU").queued_jobs == 3)
        seen = take_snapshot(client, "GPU")
        assert (len(queue.waiting), seen.slots, seen.max_slots) == (3, 0, 4)
        tasks.pop().cancel()
        wait_until(lambda: queue.cancelled == ["GPU-2"])
        for task in tasks:
            task.cancel()
        wait_until(lambda: not queue.waiting)
        wait_until(lambda: take_snapshot(client, "GPU").queued_jobs == 0)
        wait_until(lambda: not client.cluster.worker_spec)


@pytest.mark.extended
@pytest.mark.parametrize("kind", [{"adapt": [0, 1]}, {}])
def test_a_map_waits_for_workers_that_are_queued_or_can_be(queue, wait_until, kind):
    queue.held = True
    with cluster_of({"GPU": kind}) as client:
        gpu = Partition("GPU", client)
        scheduler = client.cluster.scheduler
        wait_until(lambda: poolpart.adapting.expects_workers(scheduler, "GPU"))
        results = gpu.map(twice, [1, 2], empty_s=0.0)
        wait_until(lambda: queue.waiting)
        client.sync(queue.release)
        assert list(results) == [2, 4]


def test_a_worker_whose_job_was_cancelled_too_late_gets_no_task(queue, wait_until):
    queue.held = True
    with cluster_of({"GPU": adaptive(0, 1)}) as client:
        gpu = Partition("GPU", client)
        task = gpu.submit(worker_name)
        wait_until(lambda: queue.waiting)
        [number] = queue.waiting
        scheduler = client.cluster.scheduler
        task.cancel()
        # The scheduler has decided, and the queue has not been told.
        adaptation = scheduler.plugins[poolpart.adapting.NAME]
        adaptation._cancelled.add("GPU-0")  # private: the moment is too short to meet otherwise
        task = gpu.submit(worker_name)
        client.sync(queue.begin, number)
        wait_until(lambda: not scheduler.workers)
        assert not task.done()
        client.sync(queue.release)  # another job may have been submitted by now
        gpu.adapt(0, 2, idle_s=IDLE_S)
        assert task.result(LONG_S) == "GPU-1"


def test_a_lost_worker_is_replaced_while_there_is_work(queue, wait_until):
    soon = dask.config.set({"distributed.deploy.lost-worker-timeout": "0.1s"})
    with soon, cluster_of({"GPU": adaptive(0, 2)}) as client:
        gpu = Partition("GPU", client)
        tasks = [gpu.submit(wait_for, "go") for _ in range(2)]
        wait_until(lambda: len(queue.workers) == len(gpu) == 2)  # known to both
        [worker] = queue.workers.pop("0")
        client.sync(worker.close, timeout=1)
        wait_until(lambda: len(gpu) == 2)
        Event("go", client).set()
        assert client.gather(tasks) == [True, True]
        del tasks
        wait_until(lambda: not client.cluster.worker_spec)


def test_jobs_that_the_queue_refuses_are_tried_again_while_there_is_work(queue, wait_until):
    said: list[str] = []
    queue.full = True
    with cluster_of({"GPU": adaptive(0, 2)}, report=said.append) as client:
        gpu = Partition("GPU", client)
        task = gpu.submit(worker_name)
        wait_until(lambda: said)
        assert said == ["A worker could not be started: the queue is full"]
        task.cancel()
        wait_until(lambda: not client.cluster.worker_spec)
        task = gpu.submit(worker_name)
        wait_until(lambda: client.cluster.worker_spec)
        queue.full = False
        assert task.result(LONG_S).startswith("GPU-")


@pytest.mark.extended
def test_workers_of_one_job_go_together(queue, wait_until):
    with cluster_of({"NODE": adaptive(0, 2, processes=2, slots=2)}) as client:
        node = Partition("NODE", client)
        tasks = [node.submit(wait_for, "go") for _ in range(5)]  # four slots a job
        wait_until(lambda: len(node) == 4)
        Event("go", client).set()
        client.gather(tasks)
        del tasks
        wait_until(lambda: len(node) == 0)
        name = "end"
        long = node.submit(wait_for, name)
        wait_until(lambda: len(node) == 2)
        time.sleep(4 * IDLE_S)
        assert len(node) == 2
        Event(name, client).set()
        assert long.result(LONG_S)


@pytest.mark.extended
def test_what_a_client_wants_ends_with_it(queue, wait_until):
    with cluster_of({"GPU": adaptive(0, 3, slots=2), "FIX": {}}) as client:
        with Client(client.cluster) as other:
            gpu = Partition("GPU", other)
            assert gpu.request_slots(3)
            assert not Partition("FIX", other).request_slots(3)
            wait_until(lambda: len(gpu) == 2)
            time.sleep(4 * IDLE_S)
            assert len(gpu) == 2
            gpu.request_slots(1)
            wait_until(lambda: len(gpu) == 1)
            with pytest.raises(PoolError, match="value -1 for the number of requested slots"):
                gpu.request_slots(-1)
        wait_until(lambda: len(Partition("GPU", client)) == 0)


@pytest.mark.extended
def test_tasks_for_one_worker_start_no_others(queue, wait_until):
    with cluster_of({"GPU": adaptive(1, 3)}) as client:
        gpu = Partition("GPU", client)
        wait_until(lambda: len(gpu) == 1)
        tasks = [gpu.submit(wait_for, "go", workers="GPU-0") for _ in range(5)]
        time.sleep(0.5)
        assert queue.submitted == ["GPU-0"]
        tasks.append(gpu.submit(worker_name))
        assert tasks[-1].result(LONG_S) == "GPU-1"
        Event("go", client).set()
        client.gather(tasks)


@pytest.mark.extended
def test_a_map_has_work_for_all_that_may_come(queue, wait_until):
    with cluster_of({"GPU": adaptive(0, 3)}) as client:
        gpu = Partition("GPU", client)
        results = gpu.map(wait_for, ["go"] * 20, chunk=1)
        wait_until(lambda: len(gpu) == 3)
        Event("go", client).set()
        assert sum(results) == 20


def test_a_task_that_no_worker_to_come_can_run_is_refused(queue):
    with cluster_of({"GPU": adaptive(0, 3, slots=2)}) as client:
        with pytest.raises(PoolError, match=r"requests 3 slots .* have at most 2"):
            Partition("GPU", client).submit(worker_name, slots=3)
        assert Partition("GPU", client).submit(worker_name, slots=2).result(LONG_S) == "GPU-0"


def outer(number):
    return get_client().submit(twice, number).result()


ran: list[tuple[int, str, str]] = []  # number of a task, its partition, and its worker


def note(number, partition):
    ran.append((number, partition, worker_name()))
    return number


@pytest.mark.slow
def test_no_task_is_lost_or_run_again_while_workers_come_and_go(queue, monkeypatch):
    """Idle workers go at once, while tasks come one by one."""
    monkeypatch.setattr(poolpart.deploy.clusters, "ADAPT_EVERY_S", 0.01)
    ran.clear()
    partitions = {name: adaptive(0, 2) | {"idle_s": 0.0} for name in ("A", "B")}
    with cluster_of(partitions) as client:
        parts = [Partition(name, client) for name in partitions]
        for number in range(100):
            part = parts[number % 2]
            task = part.submit(note, number, part.name)
            assert task.result(LONG_S) == number
            del task
            if number % 3 == 0:
                time.sleep(0.01)
        assert parts[0].submit(outer, 3).result(LONG_S) == 6
    assert sorted(number for number, *_ in ran) == list(range(100))
    assert all(worker.startswith(partition) for _, partition, worker in ran)
    assert len(queue.submitted) > 10


WRONG = {
    "a number": ({"adapt": 3}, r"value 3 for `adapt` of partition 'GPU'\. .* for example \[0, 8\]"),
    "three": ({"adapt": [1, 2, 3]}, "the minimum and maximum"),
    "workers beside it": ({"adapt": [0, 1], "workers": 1}, "cannot be combined with `workers`"),
    "below 0": ({"adapt": [-1, 1]}, "value -1 for the minimum of partition 'GPU'"),
    "swapped": ({"adapt": [8, 1]}, "value 1 for the maximum of partition 'GPU'. .* at least 8"),
    "nothing": ({"adapt": [0, 0]}, "value 0 for the maximum of partition 'GPU'. .* at least 1"),
    "a time": ({"adapt": [0, 1], "idle_s": "1m"}, "value '1m' for `idle_s` of partition 'GPU'"),
    "a time alone": ({"idle_s": 60}, "`idle_s`, which requires `adapt`"),
    "an option": ({"adapt": [0, 1], "mem": "1GB"}, "'GPU' cannot be started.*'mem'"),
    "another option": ({"mem": "1GB"}, "'GPU' cannot be started.*'mem'"),
    "slots": ({"slots": 0}, "value 0 for the number of slots of partition 'GPU'"),
    "workers": ({"workers": "2"}, "value '2' for the number of workers of partition 'GPU'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_told_before_anything_starts(queue, case):
    options, says = WRONG[case]
    with pytest.raises(PoolError, match=says), cluster_of({"IO": {}, "GPU": options}):
        pass
    assert queue.submitted == []


def test_other_partitions_do_not_adapt(start):
    client = start({name: {} for name in "ab"})
    parts = Pool.from_client(client).divide({"A": n_workers(1), "B": rest()})
    with pytest.raises(
        PoolError, match=r"'A' has no jobs .*start_partitions`.* `Partition\.resize"
    ):
        parts["A"].adapt(0, 2)
    assert not parts["A"].request_slots(2)


# -- adaptive clusters of Dask: the scheduler offers none to stop that a partition needs ----


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
