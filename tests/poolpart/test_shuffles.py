"""Rechunking and shuffling by P2P stay in the partition of the tasks, and end."""

import warnings

import dask
import numpy as np
import pytest
from distributed import get_worker, worker_client
from tests.poolpart.helpers import LONG_S

from poolpart import Partition, Pool, n_workers, rest

da = pytest.importorskip("dask.array")

CLUSTER = {name: {"nthreads": 2} for name in "abcd"}


@pytest.fixture(autouse=True)
def by_p2p():
    ways = {"array.rechunk.method": "p2p", "dataframe.shuffle.method": "p2p"}
    with dask.config.set(ways):
        yield


def worker_name(block):
    return block * 0 + ord(get_worker().name)


def rechunked():
    array = da.ones((60, 60), chunks=(10, 60)).rechunk((60, 10))
    return array.map_blocks(worker_name, dtype=float)


def shuffled():
    frame = pytest.importorskip("dask.dataframe")
    import pandas as pd

    table = pd.DataFrame({"x": [n % 7 for n in range(200)], "y": range(200)})
    return (
        frame.from_pandas(table, npartitions=8)
        .shuffle("x")
        .map_partitions(worker_name, meta={"x": int, "y": int})["y"]
        .unique()
    )


def without_a_shuffle():
    frame = pytest.importorskip("dask.dataframe")
    import pandas as pd

    table = frame.from_pandas(pd.DataFrame({"x": range(16)}), npartitions=8)
    return table.map_partitions(worker_name, meta={"x": int})["x"].unique()


def names(values):
    return {chr(int(value)) for value in np.ravel(values)}


def compute(make):
    with worker_client():
        return names(make().compute())


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("exclusive", [False, True])
@pytest.mark.parametrize("make", [rechunked, shuffled])
def test_inside_a_task_of_a_partition(start, make, exclusive):
    if make is shuffled:
        pytest.importorskip("pyarrow")
    client = start(CLUSTER)
    pool = Pool.from_client(client)
    parts = pool.divide({"A": n_workers(2, exclusive=exclusive), "B": rest()})
    members = {worker.name for worker in parts["A"].workers}
    assert parts["A"].submit(compute, make).result(LONG_S) == members
    pool.dissolve(timeout_s=LONG_S)
    assert len(names(client.compute(rechunked()).result(LONG_S))) > 2


def test_of_a_collection_that_a_partition_computes(start):
    """Also of one whose workers were started so, which nobody has divided."""
    started = {"e": {"resources": {"E": 2}, "nthreads": 2}}
    client = start({**CLUSTER, **started})
    own = Partition("E", client)
    places = own.compute(rechunked()).result(LONG_S)
    assert names(places) == {"e"}
    parts = Pool.from_client(client).divide({"A": n_workers(1, exclusive=True), "B": rest()})
    with parts["B"]:
        places = rechunked().compute()
    assert names(places) == {w.name for w in parts["B"].workers}
    Pool.from_client(client).dissolve()
    assert "poolpart-inherit" not in client.cluster.scheduler.plugins


@pytest.mark.parametrize(
    "make", [pytest.param(shuffled, marks=pytest.mark.extended), without_a_shuffle]
)
def test_dataframes_stay_in_a_partition_without_a_false_alarm(start, monkeypatch, make):
    pytest.importorskip("pyarrow")
    collection = pytest.importorskip("dask.dataframe.dask_expr._collection")
    client = start(CLUSTER)
    part = Pool.from_client(client).divide({"A": n_workers(2), "B": rest()})["A"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        monkeypatch.setattr(collection, "_WARN_ANNOTATIONS", True)  # Dask warns once in a process
        with part:
            assert names(make().compute()) == {worker.name for worker in part.workers}
        assert not caught
        monkeypatch.setattr(collection, "_WARN_ANNOTATIONS", True)
        with dask.annotate(priority=3):
            make()
    assert ["{'priority': 3}" in str(warning.message) for warning in caught] == [True]
