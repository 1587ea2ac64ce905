"""Adaptive clusters: partitions keep their minimum, and get workers when their tasks wait."""

from contextlib import ExitStack

import dask
import pytest
from distributed import Client, Event, LocalCluster, get_worker

from poolpart import Pool, n_workers, per_host, rest

LONG_S = 120.0
QUIET = 50


def here():
    return str(get_worker().name)


def wait_for(event):
    return Event(event).wait(LONG_S)


@pytest.fixture
def workers():
    """Client of a cluster of so many workers, which can have more of the same kind."""
    with ExitStack() as stack:

        def start(number):
            cluster = LocalCluster(
                n_workers=number,
                threads_per_worker=1,
                processes=False,
                dashboard_address=None,
                silence_logs=QUIET,
            )
            return stack.enter_context(Client(stack.enter_context(cluster)))

        yield start


def adapt(client, **options):
    client.cluster.adapt(minimum=0, interval="20ms", wait_count=1, **options)


def ask(client, method, **arguments):
    """What an adaptive cluster asks of the scheduler, in the way in which it asks."""

    async def ask(dask_scheduler):
        return dask_scheduler.handlers[method](**arguments)

    return client.run_on_scheduler(ask)


def sizes(parts):
    return {name: len(part) for name, part in parts.items()}


def test_a_partition_keeps_its_minimum(workers, wait_until):
    client = workers(6)
    rules = {"A": n_workers(2, minimum=1), "B": per_host(2, minimum=2), "C": rest()}
    parts = Pool.from_client(client).divide(rules)
    assert len(ask(client, "workers_to_close")) == 3
    adapt(client, maximum=6)
    wait_until(lambda: sizes(parts) == {"A": 1, "B": 2, "C": 0})
    assert ask(client, "workers_to_close") == ask(client, "workers_to_close", n=3) == []
    assert ask(client, "adaptive_target") == 3
    assert len({future.result() for future in parts["B"].submit_many(lambda _: here(), "ab")}) <= 2


def test_without_partitions_it_is_as_dask_has_it(workers, wait_until):
    client = workers(2)
    pool = Pool.from_client(client)
    pool.divide({"A": rest(minimum=2)})
    assert ask(client, "workers_to_close") == []
    pool.dissolve()
    assert "adaptive_target" not in vars(client.cluster.scheduler)
    assert len(ask(client, "workers_to_close")) == 2


def test_the_busy_one_is_kept_and_the_idle_one_may_go(workers, wait_until):
    client = workers(3)
    parts = Pool.from_client(client).divide({"A": rest(minimum=1)})
    event = Event("busy", client)
    busy = parts["A"].workers[1].address
    task = parts["A"].submit(wait_for, "busy", worker=busy)
    wait_until(lambda: client.cluster.scheduler.workers[busy].processing)
    to_close = ask(client, "workers_to_close")
    assert len(to_close) == 2
    assert busy not in to_close
    event.set()
    assert task.result()


def test_tasks_of_an_empty_partition_bring_a_worker_while_others_are_idle(workers, wait_until):
    client = workers(3)
    parts = Pool.from_client(client).divide({"A": n_workers(1, minimum=0), "B": rest(minimum=2)})
    adapt(client, maximum=3)
    wait_until(lambda: sizes(parts) == {"A": 0, "B": 2})
    waiting = [parts["A"].submit(here) for _ in range(3)]
    assert len({future.result(LONG_S) for future in waiting}) == 1


def test_what_waits_is_counted_by_partition(workers, wait_until):
    client = workers(4)
    parts = Pool.from_client(client).divide({"A": n_workers(3, minimum=3), "B": rest()})
    event = Event("counted", client)
    # What Dask guesses grows with the time that a task takes; what it is told does not.
    told = {"distributed.scheduler.default-task-durations": {"wait_for": "100s"}}
    with dask.config.set(told):  # B has 2000 s of work, A none
        tasks = [parts["B"].submit(wait_for, "counted") for _ in range(20)]
        wait_until(lambda: any(len(w.processing) == 20 for w in states(client)))
    assert ask(client, "adaptive_target", target_duration="1000s") == 4 + 1
    assert ask(client, "adaptive_target", target_duration="400s") == 4 + 4
    tasks += [parts["A"].submit(wait_for, "counted") for _ in range(60)]
    wait_until(lambda: sum(len(w.processing) for w in states(client)) == 80)
    # A has as many workers as its rule allows: none of them would be for it.
    assert ask(client, "adaptive_target", target_duration="2000s") == 4
    event.set()
    assert all(client.gather(tasks))


def states(client):
    return client.cluster.scheduler.workers.values()
