"""Rules: whom they choose, now and when a worker joins, without a cluster and on one."""

import time

import pytest
from distributed import Client
from hypothesis import given
from hypothesis import strategies as st
from tests.poolpart.helpers import declared, join, leave, worker_name

from poolpart import (
    Pool,
    PoolError,
    WorkerInfo,
    n_workers,
    named,
    per_gpu,
    per_host,
    probe,
    rest,
    steward,
)
from poolpart.rules import divide_workers, partition_for


def worker(name, *gpus, host="h", **resources):
    return WorkerInfo(name, f"tcp://{name}", host, 2, gpus=gpus, resources=resources)


def names(rules, pool):
    return {name: [w.name for w in group] for name, group in divide_workers(rules, pool)[0].items()}


def test_each_rule_takes_of_what_those_before_it_have_left():
    pool = [worker("a"), worker("b", "x"), worker("c", "x"), worker("d"), worker("e", host="2")]
    rules = {"GPU": per_gpu(1), "IO": per_host(1), "REST": rest()}
    assert names(rules, pool) == {"GPU": ["b"], "IO": ["a", "e"], "REST": ["c", "d"]}


def test_workers_that_a_rule_names_are_kept_for_it():
    pool = [worker("a"), worker("b"), worker("c")]
    rules = {"P": n_workers(1), "Q": named("a", "tcp://b")}
    assert names(rules, pool) == {"P": ["c"], "Q": ["a", "b"]}


def test_fewer_than_the_minimum():
    pool = [worker("a"), worker("b")]
    message = "'Q' requires at least 1 worker, but its rule selects 0. 0 of 2 workers are available"
    with pytest.raises(PoolError, match=message):
        divide_workers({"P": n_workers(2), "Q": per_host(1)}, pool)
    assert names({"P": n_workers(2), "Q": per_host(1, minimum=0)}, pool)["Q"] == []
    with pytest.raises(PoolError, match=r"no worker named 'c'\. Existing workers: 'a', 'b'\.$"):
        divide_workers({"P": named("c")}, pool)
    with pytest.raises(PoolError, match=r"workers are available .* Start more workers\.$"):
        divide_workers({"P": per_host(1, minimum=2)}, pool)
    with pytest.raises(PoolError, match="requires at least 3 workers, but its rule selects 2"):
        divide_workers({"P": rest(minimum=3)}, pool)


def test_two_rules_for_the_rest():
    with pytest.raises(PoolError, match=r"'P' and 'Q' both have the rule `rest\(\)`.*before 'P'"):
        divide_workers({"P": rest(), "Q": rest()}, [worker("a")])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "no arguments"),
        ((["a", "b"],), r"an invalid argument \['a', 'b'\]"),
        ((True,), "an invalid argument True"),
    ],
)
def test_what_names_no_workers(names, message):
    with pytest.raises(PoolError, match=f"{message}. Pass the name or address"):
        named(*names)


def test_workers_that_a_rule_names_and_that_are_not_there():
    rules = {"P": named("a", "tcp://b", 3)}
    _, notes = divide_workers(rules, [worker("a"), worker("b")])
    assert notes == {
        "P": "The partition does not have all workers that its rule names. The pool has no worker "
        "named '3'. Existing workers: 'a', 'b'."
    }


def test_named_workers_that_belong_elsewhere_are_reported_with_their_partition():
    pool = [worker(f"lidar-{i}", LIDAR=1) for i in (10, 1, 0)] + [worker("gpu-0", "x", GPU=1)]
    with pytest.raises(PoolError) as caught:
        divide_workers({"PLAN": named("lidar-0", "lidar-1", "nobody")}, pool)
    assert str(caught.value).startswith(
        "Partition 'PLAN' requires at least 1 worker, but its rule selects 0. Workers 'lidar-0', "
        "'lidar-1' already belong to partition 'LIDAR'. The pool has no worker named 'nobody'. "
        "Existing workers: 'gpu-0', 'lidar-0', 'lidar-1', 'lidar-10'. "
        "A worker can belong to only one"
    )
    assert "`partition.resize(1, source='LIDAR')`" in str(caught.value)
    with pytest.raises(PoolError, match="Worker 'a' is selected by another rule"):
        divide_workers({"P": named("a"), "Q": named("a")}, [worker("a")])


def test_the_largest_partition_is_suggested_as_source():
    pool = [worker("gpu-0", "x", GPU=1), *(worker(f"cpu-{i}", CPU=1) for i in range(3))]
    with pytest.raises(PoolError, match=r"`n_workers\(1, minimum=0\)` .* source='CPU'\)`"):
        divide_workers({"PLAN": n_workers(1)}, pool)
    _, notes = divide_workers({"PLAN": n_workers(2, minimum=0)}, pool)
    assert notes["PLAN"] == (
        "The partition has 0 of the 2 workers that its rule requests. Workers that join the "
        "cluster later are added to it, and `resize(…, source='CPU')` moves existing workers into "
        "it."
    )


@pytest.mark.parametrize("number", [{"workers": 1.5}, {"workers": 1, "slots": 0}])
def test_a_number_that_cannot_be_is_refused_by_name(number):
    with pytest.raises(
        PoolError, match=f"for `{[*number][-1]}` of the rule `n_workers`. Expected an integer"
    ):
        n_workers(**number)


RULES = {"GPU": per_gpu(1), "IO": per_host(2), "OTHER": rest()}


def test_a_gpu_that_nobody_uses_comes_first():
    members = {"GPU": [worker("a", "x")], "IO": [worker("b")], "OTHER": []}
    assert partition_for(worker("new", "y"), RULES, members) == "GPU"
    assert partition_for(worker("new", "x"), RULES, members) == "IO"
    assert partition_for(worker("new"), RULES, members) == "IO"
    assert partition_for(worker("new", host="2"), RULES, members) == "IO"
    full = members | {"IO": [worker("b"), worker("c")]}
    assert partition_for(worker("new"), RULES, full) == "OTHER"


def test_a_gpu_worker_joins_where_cpu_workers_had_to_do():
    members = {"GPU": [worker("a")], "IO": [worker("b"), worker("c")], "OTHER": []}
    assert partition_for(worker("new", "x"), RULES, members) == "GPU"
    assert partition_for(worker("new"), RULES, members) == "OTHER"
    assert partition_for(worker("new", host="2"), RULES, members) == "GPU"


def test_what_is_short_is_filled_first():
    rules = {"A": per_host(2), "B": n_workers(3, minimum=2), "C": rest()}
    members = {"A": [worker("a")], "B": [worker("b")], "C": []}
    assert partition_for(worker("new"), rules, members) == "B"
    members["B"].append(worker("c"))
    assert partition_for(worker("new"), rules, members) == "A"
    assert partition_for(worker("new"), rules, members | {"A": [], "B": []}) == "A"


def test_nobody_wants_it():
    rules = {"A": n_workers(1), "B": named("b")}
    members = {"A": [worker("a")], "B": []}
    assert partition_for(worker("new"), rules, members) is None
    assert partition_for(worker("b"), rules, members) == "B"


@pytest.mark.extended
@given(
    gpus=st.lists(st.integers(0, 3), min_size=1, max_size=4),
    order=st.randoms(use_true_random=False),
    most=st.integers(1, 3),
)
def test_whoever_joins_finds_a_place_and_no_rule_gets_more_than_it_wants(gpus, order, most):
    pool = [
        worker(f"{h}-{i}", *(f"{h}:{g}" for g in range(count)), host=str(h))
        for h, count in enumerate(gpus)
        for i in range(2 + count)
    ]
    rules = {"GPU": per_gpu(most), "HOST": per_host(1), "REST": rest()}
    members = {name: [] for name in rules}
    order.shuffle(pool)
    for one in pool:
        members[partition_for(one, rules, members)].append(one)
    assert sum(map(len, members.values())) == len(pool)
    assert len(rules["HOST"].choose(members["HOST"])) == len(members["HOST"])
    casting = [w for w in members["GPU"] if w.gpus]
    assert len(rules["GPU"].choose(casting)) == len(casting)
    # What goes to the rest is wanted by nobody else.
    for one in members["REST"]:
        others = {name: group for name, group in members.items() if name != "REST"}
        assert partition_for(one, {n: rules[n] for n in others}, others) is None


def test_workers_that_join_later(start, wait_until):
    client = start({"a": {}, "b": {}})
    Pool.from_client(client).divide({"A": n_workers(2), "B": per_host(2, minimum=0), "C": rest()})
    for name in "cdef":
        join(client, name, nthreads=3)
        wait_until(lambda name=name: declared(client).get(name))
    assert declared(client) == {
        **{name: {"A": 1} for name in "ab"},
        **{name: {"B": 3} for name in "cd"},
        **{name: {"C": 3} for name in "ef"},
    }


def test_a_rule_holds_when_its_client_has_gone(start, wait_until):
    client = start({"a": {}})
    with Client(client.cluster) as other:
        Pool.from_client(other).divide({"A": n_workers(1), "B": rest()})
    join(client, "b")
    wait_until(lambda: declared(client).get("b") == {"B": 1})


def test_a_worker_that_left_is_replaced_by_one_that_joins_and_waiting_tasks_run(start, wait_until):
    client = start({"a": {}, "b": {}})
    parts = Pool.from_client(client).divide({"A": named("b", "late"), "B": rest()})
    leave(client, "b")
    waiting = [parts["A"].submit(worker_name) for _ in range(3)]
    wait_until(lambda: len(client.cluster.scheduler.unrunnable) == 3)
    join(client, "late")
    assert client.gather(waiting) == ["late"] * 3
    assert declared(client) == {"a": {"B": 1}, "late": {"A": 1}}


def test_a_late_worker_is_asked_for_its_gpus(start, wait_until, monkeypatch):
    gpus = iter([("x",), ("x", "y"), ("x", "y")])
    # As long as a driver takes to answer: others are placed meanwhile.
    monkeypatch.setattr(probe, "visible_gpus", lambda: time.sleep(0.3) or next(gpus))
    client = start({"a": {}})
    Pool.from_client(client).divide({"GPU": per_gpu(1), "OTHER": rest()})
    for name in ("second", "third"):
        join(client, name)
        wait_until(lambda name=name: declared(client).get(name))
    assert declared(client) == {"a": {"GPU": 1}, "second": {"GPU": 1}, "third": {"OTHER": 1}}


def test_a_later_partition_of_the_remainder_forgets_no_gpus(start, wait_until, monkeypatch):
    monkeypatch.setattr(probe, "visible_gpus", lambda: ("x",))
    client = start({"a": {}, "b": {}})
    gpu, remainder = Pool.from_client(client).partition("GPU", max_workers_per_gpu=1)
    remainder.partition("OTHER", n_workers=1)
    records = client.cluster.scheduler.plugins[steward.NAME].records
    join(client, "late")
    wait_until(lambda: records["late"].info.gpus == ("x",))
    assert records["late"].partition is None
    assert len(gpu) == 1


def test_a_late_worker_that_declares_a_partition_belongs_to_it(start, wait_until):
    client = start({"a": {}, "b": {}})
    parts = Pool.from_client(client).divide({"A": n_workers(1), "B": rest()})
    join(client, "c", resources={"A": 5})
    join(client, "d", resources={"DISK": 1})
    wait_until(lambda: len(parts["A"]) == 2)
    wait_until(lambda: len(declared(client)) == 4)
    assert [declared(client)[name] for name in "cd"] == [{"A": 5}, {"DISK": 1}]
