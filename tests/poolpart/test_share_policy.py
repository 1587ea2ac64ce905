"""The policy of fair shares: by values, and in a simulation of 2 and of 126 workers."""

import random

import pytest
from tests.poolpart.share_model import SharedPartition, User

WEIGHTS = {"a": 1, "b": 1, "c": 3, "d": 1, "e": 1}


def mixed(rng, shortest_s=0.01, longest_s=10.0):
    """Return a function of running times, of all orders of magnitude."""
    return lambda: shortest_s * (longest_s / shortest_s) ** rng.random()


def deviation(partition, start, end, active):
    """Return how far the share of an active client is off at most, relative to its fair share."""
    shares = partition.shares(start, end)
    total = sum(WEIGHTS[name] for name in active)
    return max(abs(shares[name] * total / WEIGHTS[name] - 1) for name in active)


@pytest.mark.parametrize("names", ["ab", "abc", "abcde"])
@pytest.mark.parametrize(("workers", "windows"), [(2, 3), (126, 1)])
def test_clients_with_mixed_tasks_get_their_shares(names, workers, windows):
    rng = random.Random(1)
    users = [User(name, mixed(rng), WEIGHTS[name]) for name in names]
    partition = SharedPartition(users, workers).run(500 * windows)
    for number in range(windows):
        assert deviation(partition, 500 * number, 500 * (number + 1), names) < 0.1
    assert partition.busy(0, 500 * windows) > 0.98


@pytest.mark.parametrize("workers", [2, 8])
def test_clients_with_tasks_of_different_lengths_get_their_shares(workers):
    users = [
        User("a", lambda: 0.05, WEIGHTS["a"]),
        User("b", lambda: 10.0, WEIGHTS["b"]),
        User("c", lambda: 1.0, WEIGHTS["c"]),
    ]
    partition = SharedPartition(users, workers).run(1000)
    assert deviation(partition, 0, 500, "abc") < 0.1
    assert deviation(partition, 500, 1000, "abc") < 0.1
    assert partition.busy(0, 1000) > 0.98
