"""The policy of fair shares: by values, and in a simulation of 2 and of 126 workers."""

import math
import random

import pytest
from tests.poolpart.share_model import SharedPartition, User

from poolpart.share_policy import RECENT_S, UNKNOWN_S, SharePolicy

WEIGHTS = {"a": 1, "b": 1, "c": 3, "d": 1, "e": 1}


def mixed(rng, shortest_s=0.01, longest_s=10.0):
    """Return a function of running times, of all orders of magnitude."""
    return lambda: shortest_s * (longest_s / shortest_s) ** rng.random()


def deviation(partition, start, end, active):
    """Return how far the share of an active client is off at most, relative to its fair share."""
    shares = partition.shares(start, end)
    total = sum(WEIGHTS[name] for name in active)
    return max(abs(shares[name] * total / WEIGHTS[name] - 1) for name in active)


@pytest.mark.parametrize(
    ("names", "workers", "windows"),
    [
        *(("ab", 2, 3), ("abc", 2, 3), ("abcd", 2, 3), ("abcde", 2, 3), ("abcde", 126, 1)),
        *(
            pytest.param(names, 126, 2, marks=pytest.mark.extended)
            for names in ("ab", "abc", "abcd", "abcde")
        ),
    ],
)
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


@pytest.mark.parametrize(("workers", "task_s"), [(2, 10.0), (126, 10.0), (126, 1.0)])
def test_a_client_that_arrives_soon_gets_its_first_slot(workers, task_s):
    rng = random.Random(2)
    users = [
        User("a", lambda: task_s * rng.uniform(0.5, 1.0)),
        User("b", lambda: task_s * rng.uniform(0.5, 1.0), weight=3),
        User("c", lambda: 0.01, start=30.0, most=1),
        User("d", lambda: task_s, start=100.0, end=130.0),
        User("d2", lambda: task_s, start=171.3),
    ]
    partition = SharedPartition(users, workers).run(200)
    for user in users:
        assert partition.first_start(user.name) - user.start < 2 * task_s


@pytest.mark.parametrize("workers", [2, 126])
def test_idle_shares_are_used_by_others_and_are_not_saved_up(workers):
    rng = random.Random(3)
    users = [
        User("a", mixed(rng, 0.1, 5.0)),
        User("b", mixed(rng, 0.1, 5.0), weight=3, start=100, end=150),
        User("b2", mixed(rng, 0.1, 5.0), start=300),
        User("c", mixed(rng, 0.1, 5.0), most=1),  # waits for each of its tasks
    ]
    partition = SharedPartition(users, workers).run(600)
    assert partition.busy(0, 600) > 0.98
    slots_of_c = partition.used(200, 300, "c") / 100
    assert 0.5 < slots_of_c <= 1.0
    assert partition.used(200, 300, "a") / 100 > 0.98 * (workers - 1)
    late = partition.shares(300, 550)
    assert late["b2"] == pytest.approx(late["a"], rel=0.1)


def test_slots_count():
    users = [User("a", lambda: 1.0, slots=2), User("b", lambda: 1.0)]
    partition = SharedPartition(users, workers=4, slots=2).run(100)
    shares = partition.shares(0, 100)
    assert shares["a"] == pytest.approx(shares["b"], rel=0.1)


def test_running_times_that_change_are_learned_again():
    users = [User("a", lambda: 0.05 if partition.time < 100 else 5.0), User("b", lambda: 0.5)]
    partition = SharedPartition(users, workers=4)
    partition.run(400)
    for start in (0, 150):
        shares = partition.shares(start, start + 250)
        assert shares["a"] == pytest.approx(shares["b"], rel=0.1)


def test_lost_workers_change_no_shares():
    rng = random.Random(4)
    users = [User("a", mixed(rng, 0.1, 5.0)), User("c", mixed(rng, 0.1, 5.0), weight=3)]
    partition = SharedPartition(users, workers=8)
    for number in range(60):
        partition.kill(3.0 * number, number % 8)
    partition.run(400)
    assert deviation(partition, 0, 200, "ac") < 0.15
    assert deviation(partition, 200, 400, "ac") < 0.1


@pytest.mark.parametrize(("lost", "seconds"), [(True, UNKNOWN_S), (False, 60.0)])
def test_only_lost_tasks_are_charged_for_at_most_the_expected_time(lost, seconds):
    policy = SharePolicy()
    for client in "ab":
        policy.add_waiting(client, 0.0)
        policy.start(client, client, "f", 1, 0.0)
    policy.charge_running(50.0)
    policy.finish("a", 60.0, None, lost=lost)
    assert policy.accounts["a"].tag == pytest.approx(seconds)
    assert policy.accounts["a"].seconds == pytest.approx(seconds)


def test_a_task_does_not_count_while_it_lends_its_slots():
    policy = SharePolicy()
    for client in "ab":
        policy.add_waiting(client, 10.0, 2)
    policy.start("parent", "a", "f", 1, 10.0)
    policy.lend("parent", 11.0)
    policy.charge_running(60.0)
    policy.start("other", "b", "f", 1, 10.0)
    policy.charge_running(60.0)
    assert policy.accounts["a"].tag == pytest.approx(1.0)
    assert policy.accounts["b"].tag == pytest.approx(50.0)
    policy.take_back("parent", 70.0)
    policy.finish("parent", 72.0, 62.0)
    assert policy.accounts["a"].seconds == pytest.approx(3.0)
    assert policy.seconds_of("a", "f") == pytest.approx(3.0)


def test_clients_that_leave_are_forgotten_unless_they_owe_time():
    policy = SharePolicy()
    for client, seconds in (("a", 1.0), ("b", 100.0)):
        policy.add_waiting(client, 0.0, 2)
        policy.start(client, client, "f", 1, 0.0)
        policy.finish(client, seconds, seconds)
    policy.remove_waiting("b")
    policy.remove_idle({"a"}, 100.0)
    assert policy.accounts.keys() == {"a", "b"}
    policy.add_waiting("b", 101.0)
    assert policy.clients_in_turn()[0] == "a"
    policy.remove_waiting("b")
    policy.remove_waiting("a")
    policy.remove_idle(set(), 200.0)
    assert not policy.accounts


def test_a_client_whose_tasks_cannot_run_saves_up_no_credit():
    policy = SharePolicy()
    for client in "ab":
        policy.add_waiting(client, 0.0, 200)
    for number in range(100):
        policy.start(number, "a", "f", 1, float(number), passed_over=["b"])
        policy.finish(number, number + 1.0, 1.0)
    assert policy.accounts["b"].tag == pytest.approx(policy.accounts["a"].tag, abs=2.0)


def test_the_slots_of_a_client_are_those_of_its_running_tasks():
    policy = SharePolicy()
    policy.add_waiting("a", now=0.0, tasks=2)
    for key, slots in (("x", 1), ("y", 2)):
        policy.start(key, "a", "f", slots=slots, now=0.0)
    policy.finish("x", now=1.0, seconds=1.0)
    assert policy.accounts["a"].slots == 2
    policy.finish("y", now=1.0, seconds=1.0)
    assert policy.accounts["a"].slots == 0


def run_task(policy, client, end, seconds, waited_s=0.0):
    """Let a client run a task that ends at a time."""
    policy.add_waiting(client, end - seconds)
    policy.start("task", client, "f", 1, end - seconds, waited_s)
    policy.finish("task", end, seconds)


def test_the_displayed_share_is_that_of_the_recent_past():
    policy = SharePolicy()
    run_task(policy, "a", end=100.0, seconds=10.0)
    assert policy.share("a", 100.0) == 1.0
    run_task(policy, "b", end=100.0 + RECENT_S, seconds=10.0)
    earlier = math.exp(-1)
    assert policy.share("a", 100.0 + RECENT_S) == pytest.approx(earlier / (1 + earlier))
    assert policy.share("a", 100.0 + 3 * RECENT_S) == pytest.approx(earlier / (1 + earlier))
    run_task(policy, "a", end=100.0 + RECENT_S, seconds=10.0)
    assert policy.share("b", 100.0 + RECENT_S) == pytest.approx(1 / (2 + earlier))


def test_running_and_waiting_times_are_moving_averages():
    policy = SharePolicy()
    for end, seconds, waited_s in ((10.0, 1.0, 10.0), (20.0, 2.0, 20.0)):
        run_task(policy, "a", end, seconds, waited_s)
    assert policy.seconds_of("a", "f") == pytest.approx(1.0 + 0.3 * (2.0 - 1.0))
    account = policy.accounts["a"]
    assert account.recent_wait_s == pytest.approx(3.0 + 0.3 * (20.0 - 3.0))
    assert (account.waited_s, account.seconds) == (30.0, 3.0)


def test_after_all_clients_were_idle_they_start_with_the_same_tag():
    policy = SharePolicy()
    run_task(policy, "a", end=100.0, seconds=100.0)
    for client in ("new", "a"):
        policy.add_waiting(client, 200.0)
    assert policy.accounts["new"].tag == policy.accounts["a"].tag == pytest.approx(100.0)
