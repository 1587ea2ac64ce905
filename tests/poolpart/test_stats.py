"""Statistics of partitions: each task counted once, whatever happens."""

import os
import re
import signal
import threading
import time
import uuid
from datetime import UTC, datetime

import pytest
from distributed import Client, get_worker, worker_client
from tests.poolpart.helpers import LONG_S, metrics_of

from poolpart import Partition, Pool, StageStats, n_workers

CLUSTER = {"A-0": {"resources": {"A": 2}, "nthreads": 2}, "B-0": {"resources": {"B": 1}}}

go = threading.Event()  # the workers are threads of this process


def held(_):
    go.wait(LONG_S)


def after(*_):
    return str(get_worker().name)


def broken(_):
    raise ValueError("broken")


def nesting():
    with worker_client() as client:
        client.submit(held, "nested", pure=False, key=f"nested-{uuid.uuid4()}").result()


@pytest.fixture
def client(start):
    go.clear()
    yield start(CLUSTER)
    go.set()


def test_tasks_that_wait_run_and_end(client, wait_until):
    part = Partition("A", client)
    empty = part.stats()
    assert (empty.name, empty.workers, empty.slots, empty.busy) == ("A", 1, 2, 0)
    assert (empty.done, empty.stages, empty.exclusive) == (0, {}, False)

    running = [part.submit(held, i) for i in range(5)]
    last = part.submit(after, running)
    wait_until(lambda: part.stats().waiting == 1)
    stats = part.stats()
    assert (stats.running, stats.queued, stats.busy) == (2, 3, 2)
    assert stats.stages["held"] == StageStats(running=2, queued=3)

    go.set()
    assert last.result(LONG_S) == "A-0"
    stats = part.stats()
    assert (stats.waiting, stats.queued, stats.running, stats.done) == (0, 0, 0, 6)
    assert stats.stages["held"].done == 5
    assert 0 < stats.stages["held"].seconds <= stats.seconds

    failing = [part.submit(broken, i) for i in range(3)]
    dependent = part.submit(after, failing[0])
    wait_until(lambda: dependent.status == "error" and all(task.done() for task in failing))
    assert (part.stats().failed, part.stats().done) == (3, 6)  # the dependent one never ran


def test_stages_are_named_by_their_function(start):
    part = Partition("A", start({"a": {"resources": {"A": 1}}}))
    part.stats()  # counting begins

    def f1(x):
        return x

    def f2(x):
        return x

    assert list(part.map(f1, range(3), chunk=1)) == list(part.map(f2, range(3), chunk=1))
    assert part.submit(f1, 0).result(LONG_S) == 0
    stages = part.stats().stages
    assert {name: stage.done for name, stage in stages.items()} == {
        "f1": 1,
        "f1-map": 3,
        "f2-map": 3,
    }


def die_once(marker):
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)


def test_runs_that_are_lost_with_their_worker_are_counted(nannies, tmp_path):
    part = Pool.from_client(nannies).divide({"A": n_workers(1)})["A"]
    assert part.submit(die_once, tmp_path / "marker").result(LONG_S) is None
    stats = part.stats()
    assert (stats.lost, stats.done, stats.failed) == (1, 1, 0)
    assert stats.stages["die_once"].lost == 1
    assert "1 lost task" in repr(stats)


def test_prometheus_reads_the_demand_of_each_partition(client, wait_until):
    part = Partition("A", client)
    part.stats()  # counts from here on
    running = [part.submit(held, i) for i in range(5)]
    last = part.submit(after, running)
    wait_until(lambda: part.stats().running == 2 and part.stats().waiting == 1)
    figures = metrics_of(client)
    assert figures["slots", "A"] == figures["busy_slots", "A"] == 2
    assert figures["workers", "A"] == figures["workers", "B"] == 1
    states = ("running", "queued", "waiting")
    assert [figures["tasks", "A", state] for state in states] == [2, 3, 1]
    assert [figures["tasks", "B", state] for state in states] == [0, 0, 0]
    time.sleep(0.2)
    go.set()
    last.result(LONG_S)
    figures = metrics_of(client)
    assert figures["tasks_ended_total", "A", "done"] == 6
    assert figures["running_seconds_total", "A"] == pytest.approx(part.stats().seconds)
    waited_s = figures["waiting_seconds_total", "A"]
    assert waited_s == pytest.approx(part.stats().queued_seconds)
    assert waited_s >= 3 * 0.2  # three tasks had to wait for slots


def test_partitions_are_counted_apart_and_from_any_client(client):
    Partition("A", client).stats()  # counts from here on
    a = Partition("A", client)
    b = Partition("B", client)
    kept = client.gather([a.submit(after), b.submit(after), client.submit(after, 1)])
    with Client(client.scheduler.address, set_as_default=False) as other:
        assert Partition("A", other).stats().done == 1
        assert Partition("B", other).stats().stages["after"].done == 1
        assert Partition("", other).stats().done == 1  # asks for no resource
        assert Partition("nobody's", other).stats().workers == 0
    assert kept[0] == "A-0"


def test_a_task_that_is_computed_again(start, wait_until):
    client = start({"one": {"resources": {"A": 1}}, "two": {"resources": {"A": 1}}})
    part = Partition("A", client)
    Partition("A", client).stats()  # counts from here on
    results = [part.submit(after, i) for i in range(4)]
    names = client.gather(results)
    scheduler = client.cluster.scheduler
    lost = names.count("one")
    assert lost
    [address] = [w.address for w in scheduler.workers.values() if w.name == "one"]
    client.run_on_scheduler(lose, address=address)
    wait_until(lambda: part.stats().done == 4 + lost)
    stats = part.stats()
    assert (stats.failed, stats.workers, stats.queued) == (0, 1, 0)


async def lose(address, dask_scheduler):
    await dask_scheduler.remove_worker(address, stimulus_id="test", expected=True)


def test_a_task_that_lends_its_slots_and_the_one_that_has_them_are_one(client, wait_until):
    part = Partition("A", client)
    tasks = [part.submit(nesting) for _ in range(2)]
    wait_until(lambda: part.stats().stages.get("nested", StageStats()) != StageStats())
    wait_until(lambda: part.stats().running + part.stats().queued == 4)
    assert (part.stats().busy, part.stats().running) == (2, 2)
    go.set()
    client.gather(tasks)


def test_tasks_are_counted_from_the_first_submit(client, wait_until):
    before = datetime.now(UTC)
    part = Partition("A", client)
    assert part.submit(after, 1).result(LONG_S) == "A-0"
    submitted = datetime.now(UTC)
    with Client(client.scheduler.address, set_as_default=False) as other:
        stats = Partition("A", other).stats()
        (task,) = Partition("A", other).tasks()
        assert before < Partition("A", other).tasks().since == stats.since < submitted
    assert (stats.done, task.function, task.state) == (1, "after", "done")


def test_counts_that_nobody_requested_end_with_the_last_client(client, wait_until):
    plugins = set(client.cluster.scheduler.plugins)
    with Client(client.scheduler.address, set_as_default=False) as other:
        Partition("A", other).submit(after, 1).result(LONG_S)
        assert "poolpart-stats" in client.cluster.scheduler.plugins
    wait_until(lambda: set(client.cluster.scheduler.plugins) == plugins)
    with Client(client.scheduler.address, set_as_default=False) as other:
        Partition("A", other).submit(after, 1).result(LONG_S)
        Partition("A", other).stats()
    wait_until(lambda: "poolpart-registrations" not in client.cluster.scheduler.plugins)
    assert Partition("A", client).stats().done == 1


def test_statistics_are_printed_as_a_table(client):
    part = Partition("A", client)
    client.gather([part.submit(after, i) for i in range(3)])
    title, head, *rows = repr(part.stats()).splitlines()
    assert re.fullmatch(
        r"<PartitionStats 'A': 1 worker, 2 slots, 0 busy, counted since [\d:]{8} UTC>", title
    )
    assert head.split() == [
        *("stage", "waiting", "queued", "running", "done", "failed", "seconds", "peak", "memory")
    ]
    assert [row.split()[:6] for row in rows] == [
        ["after", "0", "0", "0", "3", "0"],
        ["all", "0", "0", "0", "3", "0"],
    ]
    assert repr(part) == "<Partition 'A': 1 worker, 2 slots>"
