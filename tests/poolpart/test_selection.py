"""Choosing workers: what the selectors take and what they refuse, without a cluster."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from poolpart import PoolError, WorkerInfo, n_workers
from poolpart.rules import NO_GPU, check_request, choose, divide

NONE = dict.fromkeys(("max_workers_per_gpu", "max_workers_per_host", "n_workers", "workers"))


def worker(name, *gpus, host="h", **resources):
    return WorkerInfo(name, f"tcp://{name}", host, 1, gpus=gpus, resources=resources)


def names(pool, **selector):
    return [w.name for w in choose("P", pool, **selector)[0]]


@pytest.mark.parametrize(
    ("selectors", "message"),
    [
        ({}, "exactly one of .* not none"),
        ({"n_workers": 1, "workers": ["a"]}, "exactly one of .* not n_workers and workers"),
        ({"n_workers": 0}, "n_workers is 0; give a whole number"),
        ({"n_workers": -2}, "n_workers is -2"),
        ({"max_workers_per_gpu": 0}, "max_workers_per_gpu is 0"),
        ({"max_workers_per_host": 1.5}, "max_workers_per_host is 1.5"),
        ({"n_workers": float("nan")}, "n_workers is nan"),
        ({"workers": []}, r"workers is \[\]; give a list"),
        ({"workers": "GPU-0"}, "workers is 'GPU-0'; give a list"),
    ],
)
def test_requests_that_make_no_sense(selectors, message):
    with pytest.raises(PoolError, match=message):
        check_request("P", NONE | selectors, None)


@pytest.mark.parametrize("slots", [0, -1])
def test_slots_below_one(slots):
    with pytest.raises(PoolError, match=f"slots is {slots}"):
        check_request("P", NONE | {"n_workers": 1}, slots)


def test_a_partition_needs_a_name():
    with pytest.raises(PoolError, match="name of a partition is ''"):
        check_request("", NONE | {"n_workers": 1}, None)


def test_members_are_chosen_first_so_that_the_same_call_gives_the_same_partition():
    assert names([worker("new"), worker("old", P=1)], n_workers=1) == ["old"]


def test_workers_of_other_partitions_are_passed_over():
    pool = [worker("a", Q=1), worker("b"), worker("c", P=1, Q=1), worker("d")]
    assert names(pool, n_workers=2) == ["b", "d"]
    assert names(pool, max_workers_per_host=9) == ["b", "d"]


def test_a_resource_of_quantity_0_does_not_bind_a_worker():
    assert names([worker("a", Q=0)], n_workers=1) == ["a"]


def test_too_few():
    with pytest.raises(PoolError, match="3 workers; the pool has 1 worker in no other partition"):
        choose("P", [worker("a"), worker("b", Q=1)], n_workers=3)


@pytest.mark.parametrize("selector", ["n_workers", "max_workers_per_host"])
def test_workers_that_cannot_be_had_are_told_by_what_they_declare(selector):
    pool = [worker("a", memory=1e9), worker("b", memory=1e9, disk=1)]
    with pytest.raises(PoolError, match="another resource is not taken: disk by 1, memory by 2"):
        choose("P", pool, **{selector: 1})
    with pytest.raises(PoolError, match="another resource is not taken: disk by 1, memory by 2"):
        divide({"P": n_workers(1)}, pool)


@pytest.mark.parametrize("selector", ["max_workers_per_host", "max_workers_per_gpu"])
def test_none_left(selector):
    with pytest.raises(PoolError, match="No worker is left for partition 'P': all 1"):
        choose("P", [worker("a", Q=1)], **{selector: 1})


def test_by_name_and_address_and_twice():
    pool = [worker("a"), worker("b"), worker("3")]
    assert names(pool, workers=["tcp://b", "a", "b"]) == ["a", "b"]
    assert names(pool, workers=[3]) == ["3"]


def test_a_name_that_is_unknown():
    with pytest.raises(PoolError, match="'P': x, y not in this pool, which has a"):
        choose("P", [worker("a")], workers=["a", "x", "y"])


def test_a_worker_of_another_partition():
    with pytest.raises(PoolError, match="Worker a already declares Q; a worker belongs to one"):
        choose("P", [worker("a", Q=1)], workers=["a"])


def test_two_workers_on_one_gpu_make_way_for_one_on_another():
    pool = [worker("a", "x"), worker("b", "x"), worker("c", "y")]
    assert names(pool, max_workers_per_gpu=1) == ["a", "c"]


def test_gpu_hosts_are_preferred_to_hosts_without():
    pool = [worker("cpu", host="h1"), worker("a", "x", host="h2"), worker("b", "x", host="h2")]
    chosen, note = choose("P", pool, max_workers_per_gpu=1)
    assert ([w.name for w in chosen], note) == (["a"], "")


def test_without_any_gpu_so_many_cpu_workers_a_host_and_a_note():
    pool = [worker("a", host="h1"), worker("b", host="h1"), worker("c", host="h2")]
    chosen, note = choose("P", pool, max_workers_per_gpu=1)
    assert ([w.name for w in chosen], note) == (["a", "c"], NO_GPU)


HOSTS = st.lists(
    st.tuples(st.integers(0, 3), st.integers(1, 6)), max_size=4, unique_by=lambda host: host[1]
)


@given(hosts=HOSTS, most=st.integers(1, 4))
def test_plain_workers_take_up_each_gpu_so_often(hosts, most):
    pool = [
        worker(f"{h}-{i}", *(f"{h}:{g}" for g in range(gpus)), host=str(h))
        for h, (gpus, count) in enumerate(hosts)
        for i in range(count)
    ]
    if not any(w.gpus for w in pool):
        return
    chosen = Counter(w.host for w in choose("P", pool, max_workers_per_gpu=most)[0])
    for h, (gpus, count) in enumerate(hosts):
        assert chosen[str(h)] == min(count, most * gpus)


@given(hosts=st.lists(st.integers(1, 6), min_size=1, max_size=4), most=st.integers(1, 4))
def test_so_many_workers_of_each_host(hosts, most):
    pool = [worker(f"{h}-{i}", host=str(h)) for h, count in enumerate(hosts) for i in range(count)]
    chosen = Counter(w.host for w in choose("P", pool, max_workers_per_host=most)[0])
    assert chosen == {str(h): min(count, most) for h, count in enumerate(hosts)}
