"""What is submitted where it cannot run is an error; what only has to wait, waits."""

import pickle

import dask
import pytest
from distributed import Client
from tests.poolpart.helpers import LONG_S, addresses, join, kill, leave, twice, worker_name

from poolpart import Partition, Pool, PoolError, n_workers, named, rest
from poolpart.workers import worker_identities


def calls(part):
    """All ways to submit to a partition."""

    def block():
        with part:
            pass

    return (
        lambda: part.submit(worker_name),
        lambda: part.map(twice, [1]),
        lambda: part.compute(dask.delayed(1)),
        block,
    )


def test_a_partition_that_was_dissolved(start):
    client = start({"a": {}, "b": {}})
    pool = Pool.from_client(client)
    part = pool.divide({"A": rest()})["A"]
    found = pool.partitions()["A"]  # learns that there is a rule when it submits
    assert found.submit(worker_name).result(LONG_S) in ("a", "b")
    copy = pickle.loads(pickle.dumps(part))
    pool.dissolve()
    for partition in (part, found, copy):
        for call in calls(partition):
            with pytest.raises(PoolError, match="Partition 'A' was dissolved: divide the pool"):
                call()
    pool.divide({"A": rest()})
    assert part.submit(worker_name).result(LONG_S) in ("a", "b")


def test_by_another_client(start, monkeypatch):
    monkeypatch.setattr("poolpart.membership.KEEP_S", 0.0)
    client = start({"a": {}})
    part = Pool.from_client(client).divide({"A": rest()})["A"]
    assert part.submit(worker_name).result(LONG_S) == "a"
    with Client(client.cluster) as other:
        Pool(other, []).dissolve()
    with pytest.raises(PoolError, match="was dissolved"):
        part.submit(worker_name)


def test_more_slots_than_any_worker_has(start):
    client = start({"a": {"nthreads": 2}, "b": {"nthreads": 3}, "c": {"resources": {"C": 1}}})
    part, _ = Pool.from_client(client).partition("A", workers=["a", "b"])
    message = "A task asks for 4 slots of one worker, and workers of partition 'A' have 3 at most"
    for submit in (part.submit, lambda f, slots: part.map(f, [1], slots=slots)):
        with pytest.raises(PoolError, match=f"{message}.* by slots=4 in its rule"):
            submit(worker_name, slots=4)
    with pytest.raises(PoolError, match=r'have 1 at most: ask for fewer.*--resources "C=2"'):
        Partition("C", client).compute(dask.delayed(1), slots=2)
    assert part.submit(worker_name, slots=3).result(LONG_S) == "b"
    join(client, "d", nthreads=1, resources={"A": 5})  # what was known is not long believed
    assert part.submit(worker_name, slots=5).result(LONG_S) == "d"


def test_without_workers_at_the_moment_it_waits(start):
    client = start({"a": {}})
    declared = Partition("LATER", client)
    by_rule, _ = Pool.from_client(client).partition("A", n_workers=1, minimum=0)
    by_rule.shrink()
    waiting = [part.submit(twice, 2, slots=2) for part in (declared, by_rule)]
    join(client, "later", resources={"LATER": 2})
    assert waiting[0].result(LONG_S) == 4
    join(client, "b", resources={"A": 2})
    assert waiting[1].result(LONG_S) == 4


def test_while_the_only_worker_is_started_again(nannies):
    part = Pool.from_client(nannies).divide({"A": named("0", slots=2)})["A"]
    assert part.submit(twice, 1).result(LONG_S) == 2
    kill(nannies, "0")
    assert part.submit(twice, 2, slots=2).result(LONG_S) == 4


def test_workers_by_name_address_or_both(start):
    client = start({"a": {}, "b": {}, "c": {}, "stranger": {}})
    part, _ = Pool.from_client(client).partition("A", workers=["a", "b", "c"])
    there = addresses(client)
    for workers, names in (("b", {"b"}), (there["c"], {"c"}), (["a", there["b"]], {"a", "b"})):
        assert {part.submit(worker_name, workers=workers).result(LONG_S) for _ in range(8)} <= names
    for stranger in ("stranger", "nobody", there["stranger"]):
        with pytest.raises(PoolError, match=r"does not belong to partition 'A': .* \(a, b, c\)"):
            part.submit(worker_name, workers=["a", stranger])
    join(client, "d", resources={"A": 1})
    assert part.submit(worker_name, workers="d").result(LONG_S) == "d"


def test_an_address_that_has_just_left_is_no_error(start, wait_until):
    client = start({"a": {}, "b": {}})
    part, _ = Pool.from_client(client).partition("A", n_workers=2)
    address = addresses(client)["b"]
    leave(client, "b")
    wait_until(lambda: address not in worker_identities(client))
    future = part.submit(worker_name, workers=address)
    wait_until(lambda: client.cluster.scheduler.unrunnable)
    assert future.status == "pending"


def test_many_tasks_take_few_requests(start, monkeypatch):
    client = start({"a": {}})
    part = Pool.from_client(client).divide({"A": rest()})["A"]
    [address] = [worker.address for worker in part.workers]
    asked = []
    ask = Client.run_on_scheduler

    def count(*args, **kwargs):
        asked.append(args)
        return ask(*args, **kwargs)

    monkeypatch.setattr(Client, "run_on_scheduler", count)
    monkeypatch.setattr("poolpart.membership.KEEP_S", LONG_S)
    client.gather([part.submit(worker_name, workers=address) for _ in range(50)])
    assert len(asked) == 1


async def submit_in_the_loop(part):
    return await part.submit(worker_name)


def test_a_coroutine_submits_without_asking(start):
    client = start({"a": {"nthreads": 2}})
    part, _ = Pool.from_client(client).partition("A", n_workers=1, slots=2)
    future = client.submit(submit_in_the_loop, part, resources={"A": 1})
    assert future.result(LONG_S) == "a"


def test_fewer_workers_than_a_rule_asks_for_are_noted(start, caplog):
    client = start({name: {} for name in "abc"})
    caplog.set_level("WARNING")  # a cluster that is started silences it
    note = "has 3 of the 9 workers that it asks for; later workers join it"
    part = Pool.from_client(client).divide({"A": n_workers(9)})["A"]
    assert part.note == note
    assert f"Partition 'A': {note}" in caplog.text
