"""What is submitted where it cannot run is an error; what only has to wait, waits."""

import asyncio
import pickle
import threading

import dask
import pytest
from distributed import Client, get_client
from tests.poolpart.helpers import LONG_S, addresses, join, kill, leave, twice, worker_name

from poolpart import Partition, Pool, PoolError, membership, n_workers, named, rest
from poolpart.features import names_with_features
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
            with pytest.raises(PoolError, match=r"Partition 'A' was dissolved\. Divide the pool"):
                call()
    pool.divide({"A": rest()})
    assert part.submit(worker_name).result(LONG_S) in ("a", "b")


def test_a_partition_of_a_scheduler_that_was_restarted(start):
    part = Pool.from_client(start({"a": {}})).divide({"A": rest()})["A"]
    client = start({"b": {}})  # like the new scheduler at the address of the former one
    lost = Partition("A", client, by_rule=part.by_rule)
    for call in calls(lost):
        with pytest.raises(
            PoolError, match="Partition 'A' was lost when the scheduler was restarted"
        ):
            call()
    Pool.from_client(client).divide({"A": rest()})
    assert lost.submit(worker_name).result(LONG_S) == "b"


def test_by_another_client(start, monkeypatch):
    """A client that submits without a request gets the error from its tasks."""
    client = start({"a": {}})
    part = Pool.from_client(client).divide({"A": rest()})["A"]
    assert part.submit(worker_name).result(LONG_S) == "a"
    # Clients of this process would know, and those of another process do not.
    monkeypatch.setattr("poolpart.division.forget_registrations", lambda: None)
    with Client(client.cluster) as other:
        Pool(other, []).dissolve()
    dissolved = "Partition 'A' was dissolved. Divide the pool"
    with pytest.raises(PoolError, match=dissolved):
        part.submit(worker_name).result(LONG_S)
    with part, pytest.raises(PoolError, match=dissolved):
        dask.delayed(worker_name)().compute()
    with pytest.raises(PoolError, match=dissolved):
        part.compute(dask.delayed(twice)(dask.delayed(worker_name)()), sync=True)
    # What asks for the resource without poolpart is left alone.
    with Client(client.cluster) as stranger:
        future = stranger.submit(worker_name, resources={"A": 1})
        join(client, "b", resources={"A": 1})
        assert future.result(LONG_S) == "b"
    assert part.submit(worker_name).result(LONG_S) == "b"


def test_more_slots_than_any_worker_has(start):
    client = start({"a": {"nthreads": 2}, "b": {"nthreads": 3}, "c": {"resources": {"C": 1}}})
    part, _ = Pool.from_client(client).partition("A", workers=["a", "b"])
    message = "A task requests 4 slots on one worker, but workers of partition 'A' have at most 3"
    for submit in (
        part.submit,  # asks at first
        lambda f, slots: part.submit(f, slots=3) and part.submit(f, slots=slots).result(LONG_S),
        lambda f, slots: part.map(f, [1], slots=slots),
    ):
        with pytest.raises(PoolError, match=f"{message}.* with `slots=4` in the rule"):
            submit(worker_name, slots=4)
    with pytest.raises(PoolError, match=r'have at most 1\. Request fewer.*--resources "C=2"'):
        Partition("C", client).compute(dask.delayed(1), slots=2)
    assert part.submit(worker_name, slots=3).result(LONG_S) == "b"
    join(client, "d", nthreads=1, resources={"A": 5})
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


def test_a_partition_that_no_worker_declares_is_reported_once(start, caplog):
    client = start({"a": {}, "b": {"resources": {"B": 1}}})
    Pool.from_client(client).divide({"A": named("a"), "EMPTY": n_workers(0, minimum=0)})
    caplog.set_level("WARNING")  # a cluster that is started silences it
    part = Partition("NOPE", client)
    waiting = [part.submit(twice, number) for number in range(2)]
    assert caplog.messages == [
        "Partition 'NOPE' has no workers. Its tasks wait until a worker with the resource 'NOPE' "
        "joins the cluster. Existing partitions: 'A', 'B', 'EMPTY'."
    ]
    join(client, "late", resources={"NOPE": 1})
    assert [future.result(LONG_S) for future in waiting] == [0, 2]


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
        with pytest.raises(PoolError, match=r"does not belong to partition 'A'. .* a, b, c\."):
            part.submit(worker_name, workers=["a", stranger]).result(LONG_S)
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


def test_many_tasks_take_one_request(start, monkeypatch):
    client = start({"a": {}})
    part = Pool.from_client(client).divide({"A": rest()})["A"]
    [address] = [worker.address for worker in part.workers]
    requests = []
    ask = Client.run_on_scheduler

    def count(*args, **kwargs):
        requests.append(args)
        return ask(*args, **kwargs)

    monkeypatch.setattr(Client, "run_on_scheduler", count)
    names = ["a", address, None]
    tasks = [part.submit(worker_name, workers=name) for name in names for _ in range(9)]
    assert client.gather(tasks) == ["a"] * 27
    assert len(requests) == 1


def test_submitting_does_not_wait_for_a_scheduler_that_is_busy(start, monkeypatch):
    """The scheduler answers once the tasks have been submitted."""
    client = start({"a": {}})
    part = Pool.from_client(client).divide({"A": rest()})["A"]
    assert part.submit(worker_name).result(LONG_S) == "a"
    submitted = threading.Event()
    handlers = client.cluster.scheduler.handlers
    answer = handlers["run_function"]

    async def answer_late(comm, *args, **kwargs):
        while not submitted.is_set():
            await asyncio.sleep(0.001)
        reply = answer(comm, *args, **kwargs)
        return await reply if asyncio.iscoroutine(reply) else reply

    monkeypatch.setitem(handlers, "run_function", answer_late)
    futures = [part.submit(worker_name, workers="a") for _ in range(3)]
    submitted.set()
    assert client.gather(futures) == ["a"] * 3


def test_a_client_that_connects_again_registers_again(start, wait_until, monkeypatch):
    """The scheduler forgets a client whose connection breaks."""
    client = start({"a": {"resources": {"A": 1}}})
    part = Partition("A", client)
    assert part.submit(nested).result(LONG_S) == ["a"] * 9
    connection = client.scheduler_comm
    client.loop.add_callback(connection.comm.abort)
    wait_until(lambda: client.scheduler_comm not in (None, connection))
    assert part.submit(nested).result(LONG_S) == ["a"] * 9
    with pytest.raises(PoolError, match="have at most 1"):
        part.submit(worker_name, slots=2).result(LONG_S)


def submit_in_task(name):
    return Partition(name).submit(worker_name).result(LONG_S)


def test_registrations_end_with_the_clients_outside_tasks(start, wait_until):
    client = start({name: {"resources": {name: 1}} for name in "AB"})
    scheduler = client.cluster.scheduler

    def registered():
        found = names()
        assert ("_create_taskstate_from_graph" in vars(scheduler)) == bool(found)
        assert (membership.NAME in scheduler.plugins) == bool(found)
        return found

    def names():
        return set(names_with_features(scheduler))

    assert registered() == set()
    first, second = (Client(client.cluster, set_as_default=False) for _ in range(2))
    with first, second:
        for name in "AB":
            assert Partition(name, first).submit(submit_in_task, name).result(LONG_S) == name
        assert Partition("B", second).submit(worker_name).result(LONG_S) == "B"
        assert registered() == {"A", "B"}
        first.close()
        wait_until(lambda: names() == {"B"})
        assert registered() == {"B"}
        second.close()
        wait_until(lambda: names() == set())
        wait_until(lambda: registered() == set())
    # Without a client outside tasks, the registration of a task lasts.
    assert client.submit(submit_in_task, "A", resources={"A": 1}).result(LONG_S) == "A"
    assert registered() == {"A"}
    with Client(client.cluster, set_as_default=False) as third:
        assert Partition("A", third).submit(worker_name).result(LONG_S) == "A"
    wait_until(lambda: third.id not in scheduler.clients)
    assert registered() == {"A"}


def test_who_cannot_submit_is_not_registered(start, monkeypatch):
    client = start({"a": {"resources": {"A": 1}}})
    with pytest.raises(PoolError, match="requests 2 slots"):
        Partition("A", client).submit(worker_name, slots=2)
    # The last request of a client that was killed may arrive after it has left.
    monkeypatch.setattr(client, "id", "gone")
    assert membership.register(client, "A", 1, by_rule="") == ""
    assert membership.NAME not in client.cluster.scheduler.plugins


def test_only_a_partition_that_had_a_rule_was_dissolved(start, wait_until):
    client = start({"a": {}})
    scheduler = client.cluster.scheduler
    Pool.from_client(client).divide({"A": rest()})
    with Client(client.cluster, set_as_default=False) as other:
        for user in (client, other):
            assert Partition("A", user).submit(worker_name).result(LONG_S) == "a"
        Pool(client, []).dissolve()
        with Client(client.cluster, set_as_default=False) as third:
            with pytest.raises(PoolError, match="Partition 'A' was dissolved"):
                Partition("A", third).submit(worker_name)
            waiting = Partition("LATER", third).submit(worker_name)
            wait_until(lambda: scheduler.unrunnable)
            assert waiting.status == "pending"
    # Nobody remembers it.
    wait_until(lambda: membership.NAME not in scheduler.plugins)
    waiting = Partition("A", client).submit(worker_name)
    wait_until(lambda: scheduler.unrunnable)
    join(client, "b", resources={"A": 1})
    assert waiting.result(LONG_S) == "b"


def nested():
    """Names of the workers of tasks that this task submits."""
    client = get_client()
    return client.gather([client.submit(worker_name, n, pure=False) for n in range(9)])


async def submit_in_the_loop(part):
    return await part.submit(worker_name)


def test_a_coroutine_cannot_submit_in_the_event_loop(start):
    client = start({"a": {"nthreads": 2}})
    part, _ = Pool.from_client(client).partition("A", n_workers=1, slots=2)
    future = client.submit(submit_in_the_loop, part, resources={"A": 1})
    with pytest.raises(PoolError, match="does not support asynchronous clients"):
        future.result(LONG_S)


def test_fewer_workers_than_a_rule_asks_for_are_noted(start, caplog):
    client = start({name: {} for name in "abc"})
    caplog.set_level("WARNING")  # a cluster that is started silences it
    note = (
        "The partition has 3 of the 9 workers that its rule requests. Workers that join the "
        "cluster later are added to it."
    )
    part = Pool.from_client(client).divide({"A": n_workers(9)})["A"]
    assert part.note == note
    assert f"Partition 'A': {note}" in caplog.text
