"""Libraries that list workers, or submit by themselves, stay inside a partition."""

import gc
import math
import os
import pickle
import warnings

import dask
import pytest
from distributed import (
    Client,
    Event,
    as_completed,
    default_client,
    get_client,
    get_worker,
    wait,
    worker_client,
)
from distributed.diagnostics.plugin import SchedulerPlugin
from tests.daemons import wait_until
from tests.poolpart.helpers import LONG_S, addresses, worker_name

from poolpart import Partition, Pipe, Pool, PoolError, n_workers
from poolpart.internals.partition_client import PartitionClient

A_WORKERS = {"A-0", "A-1"}


class RanOn(SchedulerPlugin):
    """Names of the workers that have run tasks."""

    def __init__(self, scheduler):
        self.names = set()
        self.scheduler = scheduler

    def transition(self, key, start, finish, *args, worker=None, **kwargs):
        if finish == "memory" and start == "processing":
            self.names.add(str(self.scheduler.workers[worker].name))


@pytest.fixture
def ran_on(client):
    """Names of the workers that run tasks during a test."""
    scheduler = client.cluster.scheduler
    plugin = RanOn(scheduler)
    scheduler.add_plugin(plugin, name="ran-on")
    yield plugin.names
    scheduler.remove_plugin("ran-on")


def members(client):
    return {address for name, address in addresses(client).items() if name in A_WORKERS}


def test_only_the_workers_of_the_partition_are_shown(client, a):
    view = a.as_client()
    expected = members(client)
    info = view.scheduler_info()
    assert info["workers"].keys() == expected
    assert info.get("total_threads", 4) == 4
    assert view.scheduler_info(n_workers=1)["workers"].keys() < expected
    assert view.nthreads() == view.ncores() == dict.fromkeys(expected, 2)
    assert view.has_what().keys() == view.processing().keys() == expected
    assert view.run(worker_name_of).keys() == expected
    assert view.sync(view.scheduler.identity)["workers"].keys() == expected
    view.wait_for_workers(2, timeout=LONG_S)
    with pytest.raises(TimeoutError):
        view.wait_for_workers(3, timeout="100ms")
    assert view.cluster is None
    assert "PartitionClient 'A'" in repr(view)
    assert len(client.scheduler_info()["workers"]) == 4
    assert len(client.nthreads()) == 4


def worker_name_of(dask_worker):
    return dask_worker.name


def test_everything_it_submits_runs_in_the_partition(client, a, ran_on):
    view = a.as_client()
    futures = view.map(worker_name, range(20), pure=False)
    futures.append(view.submit(worker_name, -1, pure=False))
    assert {*view.gather(futures)} | {*client.gather(futures)} == ran_on == A_WORKERS
    values = [dask.delayed(worker_name)(number) for number in range(20)]
    assert {*view.gather(view.compute(values))} == A_WORKERS
    assert view.get({"x": (worker_name,)}, "x") in A_WORKERS
    (kept,) = dask.persist(values[0], scheduler=view)
    assert kept.compute(scheduler=view) in A_WORKERS
    assert view.get_executor().submit(worker_name).result(LONG_S) in A_WORKERS
    total = view.submit(sum, [view.submit(int, 1), client.submit(int, 2), view.scatter(3)])
    assert total.result(LONG_S) == 6
    [scattered] = view.scatter([1], broadcast=True)
    assert {*client.who_has([scattered])[scattered.key]} == members(client)
    name = view.submit(worker_name, workers=["A-1"], resources={"A": 2}, pure=False)
    assert name.result(LONG_S) == "A-1"


def test_a_block_makes_it_the_client_that_libraries_find(client, a, ran_on):
    with a.as_client() as view:
        assert get_client() is default_client() is Client.current() is view
        values = [dask.delayed(worker_name)(number) for number in range(20)]
        assert {*dask.compute(*values)} == A_WORKERS
        with Partition("B", client).as_client():
            assert dask.delayed(worker_name)().compute() == "B-0"
        assert get_client() is view
        futures = get_client().map(worker_name, range(4), pure=False)
        wait(futures)
        assert {future.result() for future in as_completed(futures)} <= A_WORKERS
    assert get_client() is client
    assert dask.config.get("scheduler", None) != view


def workers_of_current_clients():
    with worker_client() as client:
        listed = [get_client().scheduler_info()["workers"], client.nthreads()]
        nested = client.gather(client.map(worker_name, range(8), pure=False))
        deeper = client.submit(len_of_workers, pure=False).result()
    outside = Partition("B").submit(worker_name).result()
    return [*map(len, listed), deeper, set(nested), outside]


def len_of_workers():
    return len(get_client().scheduler_info()["workers"])


def in_a_block(partition):
    with partition.as_client():
        return len_of_workers()


def test_tasks_find_the_client_of_their_partition(client, a):
    view = a.as_client()
    *counts, nested, outside = view.submit(workers_of_current_clients, pure=False).result(LONG_S)
    assert counts == [2, 2, 2]
    assert nested <= A_WORKERS
    assert outside == "B-0"
    assert a.submit(len_of_workers).result(LONG_S) == 4  # as in other tasks
    assert a.submit(in_a_block, a).result(LONG_S) == 2
    assert isinstance(get_client(), Client)


def test_closing_it_leaves_the_connection_open(client, a):
    with a.as_client() as view:
        pass
    view.close()
    del view
    gc.collect()
    assert client.submit(os.getpid).result(LONG_S) == os.getpid()
    view = a.as_client()
    for call in (view.restart, view.shutdown):
        with pytest.raises(PoolError, match="client of partition 'A' cannot"):
            call()


def test_workers_that_leave_are_named(start):
    client = start({name: {"resources": {"A": 1}} for name in "abc"})
    view = Partition("A", client).as_client()
    with pytest.raises(PoolError, match="'A' cannot let the scheduler choose the workers"):
        view.retire_workers()
    view.retire_workers([addresses(client)["a"]])
    assert len(view.nthreads()) == 2


def test_partitions_and_pipes_use_the_whole_client(client, a, make_pipe):
    with a.as_client() as view:
        assert len(Pool.from_client(view).names) == 4
        assert Partition("B", view).submit(worker_name).result(LONG_S) == "B-0"
        assert Partition("B").client is client
        pipe = make_pipe(view)
        pipe.put(1)
        assert Pipe(pipe.name).get() == 1


def test_a_partition_without_workers_stores_nothing(start):
    client = start({"plain": {}})
    view = PartitionClient(client, "A")
    assert view.nthreads() == view.run(worker_name_of) == {}
    with pytest.raises(PoolError, match="'A' has no workers to store the data"):
        view.scatter(1)


def test_tasks_that_could_never_run_are_refused(start):
    client = start({name: {} for name in "abc"})
    parts = Pool.from_client(client).divide({"A": n_workers(1), "B": n_workers(2)})
    a, b = parts.values()
    view = b.as_client()
    [foreign] = a.workers
    for workers in (foreign.address, foreign.name, [foreign.address], "nobody"):
        with pytest.raises(PoolError, match="does not belong to partition 'B'"):
            view.submit(worker_name, workers=workers, pure=False).result(LONG_S)
    assert view.submit(worker_name, workers=b.workers[0].name).result(LONG_S) == b.workers[0].name
    anywhere = {"workers": [foreign.address], "allow_other_workers": True, "pure": False}
    ran = view.map(worker_name, range(8), **anywhere)
    assert {*view.gather(ran)} <= {worker.name for worker in b.workers}
    with pytest.raises(PoolError, match="slots in the partitions 'A' and 'B', but a worker belong"):
        view.submit(worker_name, resources={"A": 1}, pure=False).result(LONG_S)
    b.dissolve()
    for call in (
        lambda: view.submit(worker_name),
        lambda: view.map(worker_name, range(2)),
        lambda: view.compute(dask.delayed(worker_name)()),
        b.as_client,
    ):
        with pytest.raises(PoolError, match="Partition 'B' was dissolved"):
            call()


@pytest.mark.parametrize("slots", [0, -1, 0.5, math.nan, math.inf, True, "1", None])
def test_slots_must_be_a_number_of_slots(client, a, slots):
    with pytest.raises(PoolError, match=r"in partition 'A'\. Expected an integer"):
        a.as_client().submit(worker_name, resources={"A": slots}, pure=False)
    with pytest.raises(PoolError, match="value 5 for `resources`"):
        a.as_client().submit(worker_name, resources=5, pure=False)


@pytest.mark.parametrize("slots", [-1, math.nan, "1", None])
def test_slots_of_plain_tasks_are_refused_if_they_are_no_number(client, a, slots):
    """Dask would fail in the middle of a transition, and the rule of poolpart with it."""
    assert a.submit(worker_name).result(LONG_S) in A_WORKERS
    future = client.submit(worker_name, resources={"A": slots}, pure=False)
    with pytest.raises(PoolError, match=r"in partition 'A'\. Expected a number"):
        future.result(LONG_S)


def test_it_takes_precedence_over_the_block_of_another_partition(client, a, b):
    view = a.as_client()
    with b:
        assert {*view.gather(view.map(worker_name, range(8), pure=False))} <= A_WORKERS
        with dask.annotate(resources={"A": 2}):
            assert view.submit(worker_name, pure=False).result(LONG_S) in A_WORKERS
        assert client.submit(worker_name, pure=False).result(LONG_S) == "B-0"


def test_a_closed_client_and_a_pickled_one_are_explained(client, a):
    with Client(client.cluster) as other:
        view = Partition("A", other).as_client()
    assert repr(view) == "<PartitionClient 'A': scheduler=closed>"
    with pytest.raises(PoolError, match="The client is closed"):
        view.scheduler_info()
    with pytest.raises(PoolError, match="Pass the partition instead"):
        pickle.dumps(a.as_client())


@pytest.mark.parametrize("name", [None, "", 5, True, math.nan])
def test_names_of_partitions_are_strings(client, name):
    with pytest.raises(PoolError, match="Invalid partition name"):
        Partition(name, client).as_client()


def test_coroutines_use_it(client, a):
    view = a.as_client()

    async def use():
        [future] = await view.scatter([5])
        result = await view.submit(worker_name, future, pure=False)
        return result, await view.gather(future), {*(await view.nthreads())}

    result, value, workers = view.sync(use)
    assert result in A_WORKERS
    assert value == 5
    assert workers == members(client)


# -- results that computations share -------------------------------------------------------


def chain_of(name, count=8):
    """Return two lists of delayed values that depend on the same named values of their workers."""
    shared = [dask.delayed(worker_name)(n, dask_key_name=f"{name}-{n}") for n in range(count)]
    return [
        [dask.delayed(str)(x, dask_key_name=f"{name}-{end}-{n}") for n, x in enumerate(shared)]
        for end in ("first", "second")
    ]


def test_released_results_are_computed_again_in_the_partition(client, a, b):
    first, second = chain_of("shared")
    held = client.compute(first, optimize_graph=False)
    assert {*client.gather(held)} > A_WORKERS
    again = a.as_client().compute(second, optimize_graph=False)
    assert {*client.gather(again)} <= A_WORKERS
    del again
    wait_until(lambda: "shared-second-0" not in client.cluster.scheduler.tasks)
    again = b.as_client().compute(second, optimize_graph=False)
    assert {*client.gather(again)} == {"B-0"}
    del again
    wait_until(lambda: "shared-second-0" not in client.cluster.scheduler.tasks)
    again = client.compute(second, optimize_graph=False)  # and the other way around
    assert {*client.gather(again)} > A_WORKERS
    assert {*client.gather(held)} > A_WORKERS


def test_arrays_that_a_plain_client_holds_in_part(client, a, ran_on):
    da = pytest.importorskip("dask.array")
    numbers = da.random.default_rng(1).random((100, 4), chunks=(10, 4))
    total = numbers.sum(axis=1).persist()
    wait(total)
    ran_on.clear()
    with a.as_client():
        assert (numbers > 0.5).any().compute()
    assert ran_on
    assert ran_on <= A_WORKERS
    assert len(total) == 100


def wait_for(event):
    Event(event).wait()


def test_queued_tasks_of_another_client_move_to_the_partition(client, a):
    """Waiting, queued and unplaced tasks, which have not started."""
    values = [dask.delayed(worker_name)(n, dask_key_name=f"queued-{n}") for n in range(30)]
    blockers = client.map(wait_for, ["queued"] * 60, pure=False)
    tasks = client.cluster.scheduler.tasks
    wait_until(lambda: any(task.state == "queued" for task in tasks.values()))
    late = dask.delayed(worker_name)(blockers[0], dask_key_name="late")
    nowhere = dask.delayed(worker_name)(dask_key_name="nowhere")
    futures = client.compute([*values, late], optimize_graph=False)
    missing = client.compute(nowhere, optimize_graph=False, resources={"MISSING": 1})
    wait_until(lambda: "nowhere" in tasks and tasks["nowhere"].state == "no-worker")
    assert {tasks[f"queued-{n}"].state for n in range(30)} == {"queued"}
    shared = a.as_client().compute([*values, late, nowhere], optimize_graph=False)
    keys = [future.key for future in shared]
    wait_until(lambda: all(tasks[key].resource_restrictions == {"A": 1} for key in keys))
    Event("queued", client).set()
    assert {*client.gather(shared)} <= A_WORKERS
    assert {*client.gather([*futures, missing])} <= A_WORKERS
    wait(blockers)


# -- libraries -----------------------------------------------------------------------------


def test_shuffles_of_arrays_and_dataframes(client, a, ran_on):
    da = pytest.importorskip("dask.array")
    pytest.importorskip("dask.dataframe")
    ways = {"array.rechunk.method": "p2p", "dataframe.shuffle.method": "p2p"}
    with dask.config.set(ways), warnings.catch_warnings():
        warnings.simplefilter("error")
        with a.as_client():
            numbers = da.random.default_rng(1).random((60, 60), chunks=(10, 60))
            assert numbers.rechunk((60, 10)).persist().sum().compute() > 0
            total, length = shuffle_a_table()
    assert total == sum(range(200))
    assert length == 200
    assert ran_on
    assert ran_on <= A_WORKERS


def shuffle_a_table():
    import dask.dataframe as dd
    import pandas as pd

    table = pd.DataFrame({"x": [n % 7 for n in range(200)], "y": range(200)})
    frame = dd.from_pandas(table, npartitions=8).shuffle("x").persist()
    return frame.groupby("x").y.sum().compute().sum(), len(frame)


class Trainer:
    """A library as they are written: one task for each worker that holds data, which must meet."""

    def __init__(self):
        self.client = get_client()

    def fit(self, parts):
        return self.client.sync(self._fit, parts)

    async def _fit(self, parts):
        client = self.client
        parts = await client.scatter(parts)
        await wait(parts)
        who_has = await client.scheduler.who_has(keys=[part.key for part in parts])
        info = await client.scheduler.identity()
        workers = {address for holders in who_has.values() for address in holders}
        assert workers <= info["workers"].keys()
        every = [
            client.submit(train, workers=[address], allow_other_workers=False, pure=False)
            for address in info["workers"]
        ]
        return await client.gather(every)


def train():
    return str(get_worker().name)


def test_a_library_that_sends_a_task_to_each_worker(client, a, ran_on):
    with a.as_client():
        assert {*Trainer().fit([1, 2, 3, 4])} == A_WORKERS
    assert ran_on == A_WORKERS


@pytest.mark.extended
def test_xgboost_trains_in_a_partition(processes):
    """Its tasks load a library of its own, so they run in processes."""
    xgboost = pytest.importorskip("xgboost")
    dxgb = pytest.importorskip("xgboost.dask")
    da = pytest.importorskip("dask.array")
    pool = Pool.from_client(processes)
    before = {name: pool[name].stats().done for name in ("GPU", "OTHER")}
    with pool["IO"].as_client() as io:
        numbers = da.random.default_rng(1).random((2000, 4), chunks=(500, 4))
        labels = (numbers[:, 0] > 0.5).astype(int)
        data = dxgb.DaskDMatrix(io, numbers, labels)
        output = dxgb.train(io, {"objective": "binary:logistic"}, data, num_boost_round=5)
        guesses = dxgb.predict(io, output["booster"], data).compute()
    assert isinstance(output["booster"], xgboost.Booster)
    assert ((guesses > 0.5) == labels.compute(scheduler="sync")).mean() > 0.95
    assert {name: pool[name].stats().done for name in ("GPU", "OTHER")} == before
