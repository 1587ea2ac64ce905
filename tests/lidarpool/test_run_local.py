"""The cluster of a survey on this machine: how many workers each partition has."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarpool.run.checks import gpu_note
from lidarpool.run.connection import default_workers, local_cluster
from poolpart import PoolError, WorkerInfo


@given(cores=st.integers(1, 256), gpus=st.integers(0, 16))
def test_every_machine_gets_workers_and_no_more_than_cores_and_gpus(cores, gpus):
    workers = default_workers(cores, gpus)
    assert workers["GPU"] == gpus or gpus == 0
    assert all(count >= 1 for count in workers.values())
    # Every partition has a worker, also where that makes one more than there are cores.
    assert sum(workers.values()) <= max(cores + 1, gpus + 1)


@pytest.mark.parametrize("given", [{"gpu_workers": 0}, {"lidar_slots": 0}, {"other_workers": -1}])
def test_counts_that_cannot_be(given):
    (count,) = given.values()
    with pytest.raises(PoolError, match=f"is {count}; give a whole number"):
        local_cluster(**given)


@pytest.mark.parametrize(
    ("gpus", "backend", "says"),
    [
        (((), ()), "embree", ""),
        ((("GPU-1",), ()), "cuda", ""),
        ((("GPU-1",), ()), "embree", "the GPUs of partition GPU are not used"),
        (((), ("GPU-1",)), "embree", "no GPU in partition GPU: CPU workers cast the rays"),
    ],
)
def test_of_gpus_is_spoken_only_where_there_is_one_that_stays_idle(gpus, backend, says):
    casting, other = (WorkerInfo(str(i), str(i), "host", 1, gpus=g) for i, g in enumerate(gpus))
    note = gpu_note([casting, other], [casting], backend)
    assert note.startswith(says) and bool(note) == bool(says)
