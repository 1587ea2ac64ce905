"""Pools on clusters: what they find, how they are divided, what they refuse."""

import logging
import math
import os
import signal

import pytest
from distributed import Client, LocalCluster
from tests.poolpart.helpers import declared, join, worker_name

from poolpart import Pool, PoolError, WorkerInfo, n_workers, probe, rest

PLAIN = {name: {} for name in ("a", "b", "c")}


def test_what_a_pool_knows(start):
    pool = Pool.from_client(start({"a": {"nthreads": 3}, "b": {"resources": {"GPU": 1}}}))
    assert len(pool) == 2
    assert {w.name: (w.nthreads, w.gpus, w.partitions) for w in pool} == {
        "a": (3, (), frozenset()),
        "b": (1, (), {"GPU"}),
    }
    assert sorted(pool.names) == ["a", "b"]
    assert repr(pool) == "<Pool: workers 2, hosts 1, GPUs 0; partitions: GPU 1>"


def test_a_cluster_without_workers(start):
    with pytest.raises(
        PoolError, match=r"has no workers\. Start workers, for example with `dask worker"
    ):
        Pool.from_client(start({}))


def test_a_worker_that_cannot_answer(start, monkeypatch):
    def broken():
        raise OSError("no such thing")

    monkeypatch.setattr(probe, "visible_gpus", broken)
    with pytest.raises(PoolError, match=r"Worker a at .* \(OSError: no such thing\)"):
        Pool.from_client(start({"a": {}}))


def test_more_workers_than_dask_lists_by_default(start):
    assert len(Pool.from_client(start({f"w{i}": {} for i in range(12)}))) == 12


def test_a_cluster_from_the_command_line_is_divided_already(start):
    workers = {"g": {"resources": {"GPU": 1}}, "l": {"resources": {"IO": 4}}, "free": {}}
    parts = Pool.from_client(start(workers)).partitions()
    assert {name: (len(part), part.slots) for name, part in parts.items()} == {
        "GPU": (1, 1),
        "IO": (1, 4),
    }
    assert parts["IO"].submit(worker_name).result() == "l"


@pytest.mark.parametrize(
    ("threads", "slots", "note"),
    [
        (
            4,
            1,
            "Worker w has 1 slot but 4 threads, so threads stay idle. Start it with `--",
        ),
        (1, 4, "Worker w has 4 slots but 1 thread, so tasks wait for a thread. Start it with "),
        (2, 2, ""),
    ],
)
def test_threads_that_slots_do_not_use_are_noted_once(start, caplog, threads, slots, note):
    client = start({"w": {"nthreads": threads, "resources": {"IO": slots}}, "free": {}})
    pool = Pool.from_client(client)
    with caplog.at_level(logging.WARNING, "poolpart"):
        parts = [pool["IO"] for _ in range(2)]
    assert {part.note[: len(note)] for part in parts} == {note}
    assert caplog.text.count("Worker w has") == bool(note)
    if note:
        assert parts[0].note.endswith(f'`--resources "IO={threads}"` to use every thread.')
    by_rule, _ = pool.partition("P", workers=["free"], slots=3)
    assert pool["P"].note == by_rule.note == ""  # as its rule says


def test_workers_by_name_and_by_address(start):
    pool = Pool.from_client(start(PLAIN))
    address = next(worker.address for worker in pool if worker.name == "b")
    part, rest = pool.partition("P", workers=["c", address])
    assert [worker.name for worker in part.workers] == ["b", "c"]
    assert rest.names == ["a"]


@pytest.mark.parametrize(("workers", "shown"), [(3, "'3'"), ("a", "'a'")])
def test_workers_that_are_no_list(start, workers, shown):
    message = rf"value {workers!r} for `workers` of partition 'P'\. Expected a list .* \[{shown}\]"
    with pytest.raises(PoolError, match=message):
        Pool.from_client(start(PLAIN)).partition("P", workers=workers)


def test_rules_without_names_of_partitions(start):
    with pytest.raises(
        PoolError, match=r"Invalid rules .* Expected a mapping of partition names to rules"
    ):
        Pool.from_client(start(PLAIN)).divide([rest()])


def test_rules_for_a_partition_that_workers_were_started_with(start):
    client = start({"a": {"resources": {"CPU": 1}}, "b": {"resources": {"CPU": 1}}, "c": {}})
    pool = Pool.from_client(client)
    message = (
        r"The rule does not select all workers that were started with the resource 'CPU'\. "
        r"Workers that are not selected: [ab]\. Use the existing partition with "
        r"`Pool\.from_client\(client\)\['CPU'\]`, pass a rule"
    )
    with pytest.raises(PoolError, match=message):
        pool.divide({"CPU": n_workers(1), "OTHER": rest()})
    message = (
        r"0 of 3 workers are available to this partition\. Start more workers, or place this "
        r"partition before the others\. 2 workers already declare the resource 'CPU'\. "
        r".* dissolve their partitions\. .*"
        r" with `n_workers\(1, minimum=0\)` and call `resize`, for example "
        r"`partition\.resize\(1, source='CPU'\)`"
    )
    with pytest.raises(PoolError, match=message):
        pool.divide({"ALL": n_workers(1), "OTHER": n_workers(1)})
    parts = pool.divide({"CPU": n_workers(2), "OTHER": rest()})
    assert [[w.name for w in part.workers] for part in parts.values()] == [["a", "b"], ["c"]]


def test_workers_of_a_partition_that_they_were_started_with_move_to_another(start):
    cpu = {"resources": {"CPU": 1}}
    pool = Pool.from_client(start({"a": cpu, "b": cpu, "c": cpu}))
    part = pool.divide({"PART": n_workers(2, minimum=0)})["PART"]
    assert len(part) == 0
    part.resize(2, source="CPU")
    assert [len(part), len(pool["CPU"])] == [2, 1]
    (other,) = pool["CPU"].workers
    assert part.submit(worker_name).result() != other.name
    assert pool["CPU"].submit(worker_name).result() == other.name
    pool["CPU"].grow(2, source="PART")
    assert [len(part), len(pool["CPU"])] == [0, 3]


def test_a_partition_without_workers_is_listed(start):
    client = start({"a": {}, "b": {}})
    pool = Pool.from_client(client)
    empty, _ = pool.partition("LATER", n_workers=0, minimum=0)
    pool.divide({"ALL": rest()})
    assert {name: len(part) for name, part in pool.partitions().items()} == {"ALL": 2, "LATER": 0}
    assert repr(pool) == "<Pool: workers 2, hosts 1, GPUs 0; partitions: ALL 2, LATER 0>"
    assert pool["LATER"].name == empty.name == "LATER"


@pytest.mark.parametrize("minimum", [0, 1])
def test_divide_and_partition_treat_a_lack_of_workers_alike(start, minimum):
    note = "The partition has 2 of the 5 workers that its rule requests."
    pool = Pool.from_client(start({"a": {}, "b": {}}))
    first, _ = pool.partition("A", n_workers=5, minimum=minimum)
    assert len(first) == 2 and first.note.startswith(note)
    pool.dissolve()
    second = pool.divide({"B": n_workers(5, minimum=minimum)})["B"]
    assert len(second) == 2 and second.note == first.note
    pool.dissolve()
    for call in (
        lambda: pool.partition("C", n_workers=5, minimum=3),
        lambda: pool.divide({"C": n_workers(5, minimum=3)}),
    ):
        with pytest.raises(PoolError, match="requires at least 3 workers, but its rule selects 2"):
            call()


def test_rules_for_workers_that_were_started_with_two_resources(start):
    pool = Pool.from_client(start({"a": {"resources": {"CPU": 1, "MEM": 5}}}))
    with pytest.raises(PoolError, match="1 worker already declares the resources 'CPU', 'MEM'"):
        pool.divide({"CPU": n_workers(1)})
    message = r'resources CPU, MEM, but a worker can belong to .* with only `--resources "CPU=1"`'
    with pytest.raises(PoolError, match=message):
        pool.divide({"CPU": rest()})


def test_workers_that_local_cluster_numbers():
    with (
        LocalCluster(
            n_workers=3, processes=False, threads_per_worker=1, dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster) as client,
    ):
        part, rest = Pool.from_client(client).partition("P", workers=[0, "2"])
        assert [worker.name for worker in part.workers] == ["0", "2"]
        assert rest.names == ["1"]
        assert part.submit(worker_name).result() in ("0", "2")


def test_a_refused_request_changes_nothing(start):
    client = start(PLAIN | {"other": {"resources": {"O": 1}}})
    pool = Pool.from_client(client)
    for arguments in (
        {},
        {"n_workers": 1, "max_workers_per_host": 1},
        {"n_workers": 4, "minimum": 4},
        {"n_workers": 0},
        {"workers": []},
        {"workers": ["a", "nobody"], "minimum": 2},
        {"workers": ["other"]},
    ):
        with pytest.raises(PoolError):
            pool.partition("P", **arguments)
    assert declared(client) == {"a": {}, "b": {}, "c": {}, "other": {"O": 1}}


def test_a_pool_that_is_divided_twice_does_not_give_one_worker_to_two(start):
    client = start(PLAIN)
    pool = Pool.from_client(client)
    first, _ = pool.partition("P", n_workers=2)
    _, rest = pool.partition("Q", n_workers=1)
    assert sorted(map(list, declared(client).values())) == [["P"], ["P"], ["Q"]]
    assert rest.names == []
    one, other = sorted(worker.name for worker in first.workers)
    with pytest.raises(
        PoolError, match=f"Workers '{one}', '{other}' already belong to partition 'P'"
    ):
        pool.partition("R", workers=[one, other])


def test_a_worker_that_has_left_is_not_chosen(start, wait_until):
    client = start(PLAIN)
    pool = Pool.from_client(client)
    client.retire_workers([worker.address for worker in pool if worker.name == "a"])
    wait_until(lambda: len(declared(client)) == 2)
    part, rest = pool.partition("P", n_workers=2)
    assert ([w.name for w in part.workers], rest.names) == (["b", "c"], [])
    assert list(pool.partitions()) == ["P"]
    with pytest.raises(PoolError, match=r"Invalid rule 3 for partition 'Q'\. .* `n_workers\(2\)`"):
        pool.divide({"Q": 3})
    with pytest.raises(PoolError, match="requires at least 1 worker, but its rule selects 0"):
        pool.partition("Q", workers=["a"])


def test_workers_that_join_after_the_pool_was_made_belong_to_it(start, monkeypatch):
    client = start({"a": {}, "b": {}})
    pool = Pool.from_client(client)
    _, rest = pool.partition("P", workers=["a", "b"])
    assert rest.names == []
    monkeypatch.setattr(probe, "visible_gpus", lambda: ("x",))
    for name in ("c", "d"):
        join(client, name)
    client.wait_for_workers(4)
    assert sorted(pool.names) == ["a", "b", "c", "d"] and sorted(rest.names) == ["c", "d"]
    assert repr(rest) == "<Pool: workers 2, hosts 1, GPUs 1; partitions: P 2>"
    gpu, rest = rest.partition("GPU", max_workers_per_gpu=1)
    assert ([worker.name for worker in gpu.workers], gpu.note) == (["c"], "")
    assert pool.divide({"Q": n_workers(1)})["Q"].workers[0].name == "d"
    assert rest.names == []


def test_a_partition_is_found_by_its_name(start):
    pool = Pool.from_client(start(PLAIN))
    with pytest.raises(PoolError, match="no partition 'P', because the pool has not been divided"):
        pool["P"]
    pool.divide({"P": n_workers(1), "Q": rest()})
    assert pool["P"].submit(pow, 2, 3).result() == 8 and len(pool["Q"]) == 2
    assert repr(pool) == "<Pool: workers 3, hosts 1, GPUs 0; partitions: P 1, Q 2>"
    with pytest.raises(PoolError, match=r"no partition 'GPU'\. Existing partitions: 'P', 'Q'"):
        pool["GPU"]
    pool.client.close()
    assert repr(pool) == "<Pool: workers 3, hosts 1, GPUs 0>"


def test_a_block_dissolves_what_its_pool_has_made(start):
    client = start(PLAIN | {"d": {"resources": {"OLD": 1}}})
    Pool.from_client(client).partition("OTHERS", workers=["a"])
    with pytest.raises(ZeroDivisionError), Pool.from_client(client) as pool:
        _, left = pool.partition("P", n_workers=1)
        left.divide({"Q": n_workers(1)})
        assert sorted(pool.partitions()) == ["OLD", "OTHERS", "P", "Q"]
        raise ZeroDivisionError
    assert sorted(pool.partitions()) == ["OLD", "OTHERS"]
    with pool:
        pool.dissolve()
    assert list(pool.partitions()) == ["OLD"]
    assert not [name for name in client.cluster.scheduler.plugins if "poolpart" in name]
    with pytest.raises(ZeroDivisionError) as raised, Pool.from_client(client) as pool:
        pool.partition("P", n_workers=1)
        client.close()
        raise ZeroDivisionError
    assert "The partitions were not dissolved. The client is closed" in raised.value.__notes__[0]


def test_a_worker_that_is_stopped_is_left_out(nannies, monkeypatch):
    monkeypatch.setattr("poolpart.workers.SILENT_S", 1.0)
    monkeypatch.setattr("poolpart.workers.MISSED_BEATS", 1)
    pid = nannies.run(os.getpid).popitem()[1]
    os.kill(pid, signal.SIGSTOP)
    try:
        assert len(Pool.from_client(nannies)) == 1
    finally:
        os.kill(pid, signal.SIGCONT)


def test_one_worker_for_each_gpu_of_a_host(start, monkeypatch):
    monkeypatch.setattr(probe, "visible_gpus", lambda: ("x", "y"))
    pool = Pool.from_client(start({name: {} for name in "abcde"}))
    assert repr(pool) == "<Pool: workers 5, hosts 1, GPUs 2>"
    gpu, rest = pool.partition("GPU", max_workers_per_gpu=1)
    assert (len(gpu), len(rest), gpu.note) == (2, 3, "")
    assert {worker.gpus for worker in rest} == {("x", "y")}


def test_without_gpus_the_fall_back_is_told_once(start, caplog):
    pool = Pool.from_client(start(PLAIN))
    with caplog.at_level(logging.WARNING, "poolpart"):
        gpu, _ = pool.partition("GPU", max_workers_per_gpu=1)
    assert gpu.note == "The pool has no GPU. The partition uses CPU workers instead."
    assert (caplog.text + repr(gpu)).count(gpu.note) == 1
    assert f"Partition 'GPU': {gpu.note}" in caplog.text
    assert len(gpu) == 1


def test_slots_that_are_missing_are_named_with_their_purpose(start):
    pool = Pool.from_client(start({"l": {"resources": {"IO": 2}}}))
    pool.require({"IO": 2})
    with pytest.raises(PoolError, match=r"'IO' has 2 of the 4 required slots \(four stages\)\. "):
        pool.require({"IO": 4}, {"IO": "four stages"})
    with pytest.raises(PoolError, match=r"'GPU' has 0 of the 1 required slot\. Start workers"):
        pool.require({"GPU": 1}, {"IO": "four stages"})


@pytest.mark.parametrize("slots", [0.5, -1, math.inf])
def test_slots_that_are_no_whole_number(slots):
    pool = Pool(None, [WorkerInfo("w", "tcp://w", "h", 1, resources={"GPU": slots})])
    pool.require({"IO": 0})
    with pytest.raises(
        PoolError, match=f"Worker w declares GPU={slots:g}, which is not a valid number of slots"
    ):
        pool.require({"GPU": 0})


def test_a_worker_in_two_partitions():
    pool = Pool(None, [WorkerInfo("w", "tcp://w", "h", 1, resources={"GPU": 1, "IO": 4})])
    pool.require({"GPU": 1})
    with pytest.raises(
        PoolError,
        match=r"Worker w declares the resources GPU and IO\. Start each worker with only one",
    ):
        pool.require({"GPU": 1, "IO": 1})
