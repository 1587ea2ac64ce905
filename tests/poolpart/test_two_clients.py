"""Two clients that divide, move and undo at the same moment: one does, the other is told."""

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from distributed import Client
from tests.poolpart.helpers import LONG_S, declared

from poolpart import Partition, Pool, PoolError, n_workers, named, per_host, pool, rest


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
    ask = pool.call_steward

    def wait_and_ask(*args, **kwargs):
        looked.wait()
        return ask(*args, **kwargs)

    def call(*functions):
        def outcome(function):
            try:
                return function()
            except PoolError as error:
                return error

        monkeypatch.setattr(pool, "call_steward", wait_and_ask)
        with ThreadPoolExecutor(2) as threads:
            outcomes = list(threads.map(outcome, functions))
        monkeypatch.setattr(pool, "call_steward", ask)
        return outcomes

    return call


@pytest.mark.extended
@pytest.mark.parametrize(
    ("rule", "note"),
    [
        (n_workers(3), "The partition has 1 of the 3 workers that its rule requests"),
        (
            rest(),
            "The partition has 1 of the 4 workers that its rule would have selected when the pool",
        ),
        (
            per_host(3),
            "The partition has 1 of the 3 workers that its rule would have selected when the pool",
        ),
        (
            named("a", "b", "d"),
            "The partition does not have all workers that its rule names. Workers 'a', 'b' already "
            "belong to partition 'P'.",
        ),
    ],
)
def test_the_second_of_two_is_told_what_it_lacks(two, caplog, rule, note):
    first, second = map(Pool.from_client, two)
    first.divide({"P": named("a", "b", "c")})
    with caplog.at_level(logging.WARNING, "poolpart"):
        part = second.divide({"Q": rule})["Q"]
    assert len(part) == 1
    assert note in part.note
    assert f"Partition 'Q': {note}" in caplog.text
    with pytest.raises(PoolError, match="'Q' requires at least 2 workers, but its rule selects 1"):
        second.divide({"Q": replace(rule, minimum=2)})


def test_a_pool_that_has_made_a_partition_does_not_miss_its_workers(two):
    pool = Pool.from_client(two[0])
    pool.divide({"P": n_workers(3)})
    assert pool.divide({"Q": rest()})["Q"].note == ""


def test_a_second_rest_is_told_who_gets_later_workers(two):
    first, second = map(Pool.from_client, two)
    first.divide({"P": named("a"), "Q": rest()})
    note = "are assigned to partition 'Q', which already has the rule `rest()`."
    assert second.divide({"R": rest()})["R"].note.endswith(note)
    assert first.divide({"Q": rest()})["Q"].note == ""


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
    assert "Partition 'P' already exists" in (message := told(outcomes))
    assert "Pool.from_client(client)['P']" in message
    (part,) = (outcome for outcome in outcomes if isinstance(outcome, Partition))
    members = {worker.name for worker in part.workers}
    assert len(members) == 2
    assert sum(map(bool, declared(two[0]).values())) == 2
    # The same call again takes what there is, as by one client.
    again, _ = Pool.from_client(two[1]).partition("P", workers=sorted(members))
    assert {worker.name for worker in again.workers} == members


@pytest.mark.extended
def test_the_same_workers_under_different_names(two, both):
    mine, theirs = map(Pool.from_client, two)
    outcomes = both(
        lambda: mine.partition("P", n_workers=3, minimum=3, exclusive=True),
        lambda: theirs.partition("Q", n_workers=2, minimum=2, exclusive=True),
    )
    assert "of 4 workers" in told(outcomes)
    taken = [names for names in declared(two[0]).values() if names]
    assert taken in ([{"P": 1}] * 3, [{"Q": 1}] * 2)
    # Nothing of the one that was refused is left, a fence least of all.
    there = [name for name in "PQ" if Partition(name, two[0]).stats().exclusive]
    assert there == list(taken[0])
