"""Two clients that divide, move and undo at the same moment: one does, the other is told."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
from distributed import Client, Event

from poolpart import Partition, Pool, PoolError, n_workers, pool, rest, steward, trace_to

LONG_S = 120.0


def wait_for(event):
    return Event(event).wait(LONG_S)


def declared(client):
    workers = client.cluster.scheduler.workers.values()
    return {str(worker.name): dict(worker.resources) for worker in workers}


@pytest.fixture
def two(start):
    """Two clients of a cluster of four workers."""
    client = start({name: {} for name in "abcd"})
    with Client(client.cluster) as other:
        yield client, other


@pytest.fixture
def both(monkeypatch):
    """Call two functions so that both have looked at the cluster before either changes it."""
    looked = threading.Barrier(2, timeout=LONG_S)
    declare = pool.declare

    def wait_and_declare(*args):
        looked.wait()
        declare(*args)

    def call(*functions):
        def outcome(function):
            try:
                return function()
            except PoolError as error:
                return error

        monkeypatch.setattr(pool, "declare", wait_and_declare)
        with ThreadPoolExecutor(2) as threads:
            outcomes = list(threads.map(outcome, functions))
        monkeypatch.setattr(pool, "declare", declare)
        return outcomes

    return call


def told(outcomes):
    """Return the message of the one that was refused; fails unless the other was not."""
    errors = [outcome for outcome in outcomes if isinstance(outcome, PoolError)]
    assert len(errors) == 1, outcomes
    return str(errors[0])


@pytest.mark.parametrize("others", [{"n_workers": 2}, {"workers": ["c", "d"]}])
def test_one_name(two, both, others):
    mine, theirs = map(Pool.from_client, two)
    outcomes = both(
        lambda: mine.partition("P", workers=["a", "b"])[0],
        lambda: theirs.partition("P", **others)[0],
    )
    assert "partition 'P' meanwhile" in (message := told(outcomes))
    assert "Pool.partitions()['P']" in message
    (part,) = (outcome for outcome in outcomes if isinstance(outcome, Partition))
    members = {worker.name for worker in part.workers}
    assert len(members) == 2
    assert sum(map(bool, declared(two[0]).values())) == 2
    # The same call again takes what there is, as by one client.
    again, _ = Pool.from_client(two[1]).partition("P", workers=sorted(members))
    assert {worker.name for worker in again.workers} == members


def test_the_same_rules(two, both):
    rules = {"A": n_workers(2, exclusive=True), "B": rest()}
    pools = [Pool.from_client(client) for client in two]
    outcomes = both(*(partial(pool.divide, rules) for pool in pools))
    assert "meanwhile" in told(outcomes)
    assert sorted(str(d) for d in declared(two[0]).values()) == ["{'A': 1}"] * 2 + ["{'B': 1}"] * 2
    assert Pool.from_client(two[1]).dissolve() == ["A", "B"]


def test_the_same_workers_under_different_names(two, both):
    mine, theirs = map(Pool.from_client, two)
    outcomes = both(
        lambda: mine.partition("P", n_workers=3, exclusive=True),
        lambda: theirs.partition("Q", n_workers=2, exclusive=True),
    )
    assert "make the pool anew" in (message := told(outcomes)).lower(), message
    taken = [names for names in declared(two[0]).values() if names]
    assert taken in ([{"P": 1}] * 3, [{"Q": 1}] * 2)
    # Nothing of the one that was refused is left, a fence least of all.
    there = [name for name in "PQ" if Partition(name, two[0]).stats().exclusive]
    assert there == list(taken[0])


def test_workers_that_are_under_way_are_not_counted_on(start, wait_until):
    """One grows a partition, with a worker that cannot come; another shrinks it meanwhile."""
    client = start({"a": {}, "b": {}})
    parts = Pool.from_client(client).divide({"A": n_workers(1), "B": rest()})
    event = Event("under way", client)
    task = parts["B"].submit(wait_for, "under way")
    wait_until(lambda: any(w.processing for w in client.cluster.scheduler.workers.values()))
    with ThreadPoolExecutor(1) as thread:
        growing = thread.submit(parts["A"].grow, 1, timeout_s=1.0)
        # Where nobody looks for a second, it has turned back by then.
        wait_until(lambda: growing.done() or not any(d.get("B") for d in declared(client).values()))
        with pytest.raises(PoolError, match="'A' cannot shrink by 1: it has 1 worker"):
            parts["A"].shrink(1)
        with pytest.raises(PoolError, match="1 of 1 worker could not be moved"):
            growing.result()
    wait_until(lambda: sorted(map(str, declared(client).values())) == ["{'A': 1}", "{'B': 1}"])
    event.set()
    assert task.result()


def test_a_partition_that_is_dissolved_while_it_grows(start, wait_until):
    client = start({"a": {}, "b": {}})
    parts = Pool.from_client(client).divide({"A": n_workers(1), "B": rest()})
    event = Event("overtaken", client)
    task = parts["B"].submit(wait_for, "overtaken")
    wait_until(lambda: any(w.processing for w in client.cluster.scheduler.workers.values()))
    rules = client.cluster.scheduler.plugins[steward.NAME].book.rules
    with ThreadPoolExecutor(2) as threads:
        growing = threads.submit(parts["A"].grow, 1, timeout_s=LONG_S)
        wait_until(lambda: not any(d.get("B") for d in declared(client).values()))
        dissolving = threads.submit(parts["A"].dissolve, timeout_s=LONG_S)
        wait_until(lambda: "A" not in rules)
        event.set()
        dissolving.result()
        with pytest.raises(
            PoolError, match="did not arrive in partition 'A': somebody has dissolved it"
        ):
            growing.result()
    assert task.result()
    wait_until(lambda: not any(declared(client).values()))


def test_never_below_the_minimum_whoever_moves(start):
    """Many moves by two clients, at once: each worker is in one partition, and none too few."""
    client = start({name: {} for name in "abcdef"})
    rules = {"A": n_workers(2, minimum=2), "B": n_workers(2, minimum=1), "C": rest(minimum=1)}
    Pool.from_client(client).divide(rules)
    least = {"A": 2, "B": 1, "C": 1}
    workers = client.cluster.scheduler.workers
    seen = []  # what all workers declared, each time that one of them was told

    def see(point, fields):
        now = [{name for name, slots in w.resources.items() if slots} for w in workers.values()]
        seen.append(now)

    def move(number):
        with Client(client.cluster) as mine:
            parts = {name: Partition(name, mine) for name in least}
            done = 0
            for turn in range(20):
                name = "ABC"[(turn + number) % 3]
                source = "ABC"[(turn + number + 1 + turn % 2) % 3]
                try:
                    if turn % 3:
                        parts[name].grow(1, source=source)
                    else:
                        parts[name].shrink(1)
                    done += 1
                except PoolError as error:
                    assert "cannot" in str(error)
            return done

    trace_to(see)
    try:
        with ThreadPoolExecutor(2) as threads:
            moved = list(threads.map(move, range(2)))
    finally:
        trace_to(None)
    assert min(moved) > 2
    assert len(seen) > sum(moved)
    for declares in seen:
        assert all(len(names) <= 1 for names in declares)
        for name, least_of_it in least.items():
            assert sum(name in names for names in declares) >= least_of_it
