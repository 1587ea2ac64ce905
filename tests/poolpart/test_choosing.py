"""Workers of large groups are chosen among a few, as evenly as Dask chooses among all."""

import asyncio
import time
from collections import Counter

import dask
import pytest
from benchmarks import placing
from distributed import Client, Event, wait
from tests.poolpart.helpers import LONG_S, wait_for, worker_name

from poolpart import Pool, n_workers, rest

NAMES = [f"{letter}-{number}" for letter in "ab" for number in range(5)]


@pytest.fixture
def client(start, monkeypatch):
    """Client of ten workers; one worker is compared for a task, and none steals."""
    monkeypatch.setattr("poolpart.choosing.MAX_COMPARED", 1)
    with dask.config.set({"distributed.scheduler.work-stealing": False}):
        client = start({name: {} for name in NAMES})
    client.cluster.scheduler.validate = True  # Dask checks itself after each step
    return client


@pytest.fixture
def parts(client):
    return Pool.from_client(client).divide({"A": n_workers(5, exclusive=True), "B": rest()})


def gather_places(client, futures):
    return Counter(client.gather(futures))


def wait_here(event, *_):
    wait_for(event)
    return worker_name()


def open_gate(client, gate, futures):
    """Let tasks end once each task has a worker, so that no task finds an idle worker again."""
    keys = {future.key for future in futures}
    deadline = time.monotonic() + LONG_S
    while count_placed(client, keys) < len(keys):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    Event(gate, client).set()


def count_placed(client, keys):
    def count(dask_scheduler):
        tasks = dask_scheduler.tasks
        return sum(key in tasks and tasks[key].processing_on is not None for key in keys)

    return client.run_on_scheduler(count)


@pytest.mark.extended
def test_each_worker_of_a_partition_gets_as_many_tasks(client, parts):
    gate = f"gate-{client.id}"
    # Further tasks would wait on the scheduler.
    futures = [parts["A"].submit(wait_here, gate) for _ in range(5)]
    open_gate(client, gate, futures)
    members = {worker.name for worker in parts["A"].workers}
    assert gather_places(client, futures) == dict.fromkeys(members, 1)


def test_tasks_of_others_stay_outside_and_are_spread(client, parts):
    gate = f"gate-{client.id}"
    with Client(client.cluster) as stranger:
        # Other keys: Dask would queue the tasks of a large group.
        futures = [stranger.submit(wait_here, gate, n, key=f"{n}-work") for n in range(20)]
        open_gate(client, gate, futures)
        outside = {worker.name for worker in parts["B"].workers}
        assert gather_places(stranger, futures) == dict.fromkeys(outside, 4)


@pytest.mark.extended
def test_a_worker_that_is_free_is_chosen_before_busy_workers(client, parts):
    gate = f"gate-{client.id}"
    busy = [parts["A"].submit(wait_here, gate) for _ in range(4)]
    for _ in range(8):
        assert parts["A"].submit(worker_name).result(LONG_S)
    open_gate(client, gate, busy)
    client.gather(busy)


def place_of_input(data, *_):
    return data, worker_name()


@pytest.mark.extended
def test_a_task_runs_where_its_input_is(client, parts):
    for _ in range(8):
        data = parts["A"].submit(worker_name)
        wait(data)
        place, own = parts["A"].submit(place_of_input, data).result(LONG_S)
        assert place == own


@pytest.mark.extended
def test_a_task_that_takes_several_slots_goes_to_a_worker_that_has_them(client):
    rules = {"A": n_workers(5, slots=1), "B": rest(slots=3)}
    parts = Pool.from_client(client).divide(rules)
    members = {worker.name for worker in parts["B"].workers}
    for _ in range(8):
        assert parts["B"].submit(worker_name, slots=3).result(LONG_S) in members


@pytest.mark.extended
def test_workers_that_join_leave_and_move_are_counted(client, parts):
    parts["A"].grow(2, source="B")
    gate = f"gate-{client.id}"
    futures = [parts["A"].submit(wait_here, gate) for _ in range(7)]
    open_gate(client, gate, futures)
    members = {worker.name for worker in parts["A"].workers}
    places = gather_places(client, futures)
    assert len(members) == 7
    assert places.keys() == members


@pytest.mark.extended
def test_dask_decides_within_the_fence_if_the_rule_fails(
    client, parts, monkeypatch, caplog, caught_errors
):
    monkeypatch.delattr("poolpart.choosing.free_threads_of")
    members = {worker.name for worker in parts["A"].workers}
    assert {parts["A"].submit(worker_name).result(LONG_S) for _ in range(10)} <= members
    assert (
        not {client.submit(worker_name, n, pure=False).result(LONG_S) for n in range(10)} & members
    )
    assert "failed with distributed" in caplog.text
    caught_errors.clear()


def test_nothing_is_left_after_dissolving(client, parts):
    parts["A"].submit(worker_name).result(LONG_S)
    Pool.from_client(client).dissolve()
    scheduler = client.cluster.scheduler
    assert "poolpart-choice" not in scheduler.plugins
    assert "decide_worker_non_rootish" not in vars(scheduler)


@pytest.mark.extended
def test_simulated_workers_get_tasks_as_evenly_as_from_dask():
    figures = asyncio.run(placing.measure(200, rounds=50, tasks_per_worker=3))
    for name in ("partition", "others"):
        assert figures[f"{name}_poolpart_end"] < 1.1 * figures[f"{name}_dask_end"]
        assert figures[f"{name}_poolpart_longest"] <= figures[f"{name}_dask_longest"]
