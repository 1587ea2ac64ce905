"""Slots for several tasks, or none."""

from __future__ import annotations

import time

import pytest
from distributed import Client, Event

from poolpart import Pool, claim_slots, drop_claim
from poolpart.claims import NAME, _claim


@pytest.fixture
def other(client):
    with Client(client.cluster, set_as_default=False) as other:
        yield other


@pytest.fixture
def known(client):
    """Whether the scheduler keeps claims at all."""

    def look(dask_scheduler=None):
        return NAME in dask_scheduler.plugins

    yield lambda: client.run_on_scheduler(look)
    assert not client.run_on_scheduler(look)


def keys(owner, count):
    return [f"claimed-{owner}-{number}" for number in range(count)]


def test_one_of_two_gets_all_slots_and_the_other_none(client, other, known):
    claim = claim_slots(client, "A", keys("one", 3))
    assert claim.granted and claim.slots == sum(claim.free.values()) == 4
    refused = claim_slots(other, "A", keys("two", 2))
    assert not refused.granted and refused.slots == 4
    assert claim_slots(other, "A", keys("two", 1)).granted
    assert claim_slots(other, "B", keys("b", 1)).granted  # another partition's
    drop_claim(other, keys("b", 1))
    assert claim_slots(client, "A", keys("one", 3)).granted  # still, and not twice
    drop_claim(client, keys("one", 3))
    assert claim_slots(other, "A", keys("two", 4)).granted
    drop_claim(other, keys("two", 4))
    drop_claim(other, keys("two", 4))  # of nothing


def test_a_client_that_leaves_gives_back_what_it_was_granted(client, known):
    with Client(client.cluster, set_as_default=False) as leaving:
        assert claim_slots(leaving, "A", keys("one", 4)).granted
        assert not claim_slots(client, "A", keys("two", 1)).granted
    deadline = time.monotonic() + 120
    while known():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert claim_slots(client, "A", keys("two", 4)).granted
    drop_claim(client, keys("two", 4))


def test_two_runs_of_one_client_are_two(client, known):
    """In threads of one program, say."""
    assert claim_slots(client, "A", keys("one", 3)).granted
    assert not claim_slots(client, "A", keys("two", 3)).granted
    drop_claim(client, keys("two", 3))  # as the one that was refused does when it ends
    assert not claim_slots(client, "A", keys("two", 3)).granted
    drop_claim(client, keys("one", 3))


def test_a_question_that_is_read_after_its_client_has_left_is_granted_nothing(client, known):
    answer = client.run_on_scheduler(_claim, owner="gone", resource="A", keys=keys("one", 1))
    assert answer[0] is False


def test_tasks_that_are_there_do_not_count_twice(client, other, known):
    partition = Pool.from_client(client).partitions()["A"]
    assert claim_slots(client, "A", keys("here", 2)).granted
    done = Event("claims-done", client=client)
    futures = [partition.submit(Event("claims-done").wait, key=key) for key in keys("here", 2)]
    try:
        deadline = time.monotonic() + 120
        while not claim_slots(other, "A", keys("two", 2)).granted:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        drop_claim(other, keys("two", 2))
        assert not claim_slots(other, "A", keys("two", 3)).granted  # they hold their slots
    finally:
        done.set()
    client.gather(futures)
    assert claim_slots(other, "A", keys("two", 4)).granted
    drop_claim(other, keys("two", 4))


def test_a_partition_that_is_not_there_has_nothing_to_claim(client, known):
    claim = claim_slots(client, "C", keys("one", 1))
    assert (claim.granted, claim.free, claim.slots) == (False, {}, 0)
