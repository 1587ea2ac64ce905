"""Which CUDA device a worker uses: shared evenly, kept, and found free by whoever is restarted."""

import os
import signal
from collections import Counter
from types import SimpleNamespace

import pytest
from distributed import Client, Nanny
from hypothesis import given
from hypothesis import strategies as st
from tests.clusters import QUIET, cluster_of

from poolpart import Pool, devices, own_device, own_device_share, probe

# Each worker sees two devices.
PRELOAD = """
from poolpart import probe
probe.visible_gpus = lambda: ("x", "y")
"""


def scheduler_of(**partitions):
    """What the choice needs of a scheduler; the workers' partitions by address."""
    workers = {
        address: SimpleNamespace(
            address=address, host="here", extra={}, resources=dict.fromkeys(names, 1)
        )
        for address, names in partitions.items()
    }
    return SimpleNamespace(workers=workers)


def assign(scheduler, **visible):
    """Devices of workers by address; a letter in `visible` is a device that it sees."""
    return {
        a: devices.assign_device(a, gpus, dask_scheduler=scheduler) for a, gpus in visible.items()
    }


def test_rotated_lists_all_use_their_first():
    """As those of dask-cuda, where each worker sees all devices, its own one first."""
    scheduler = scheduler_of(a="P", b="P", c="P")
    assert assign(scheduler, a="xyz", b="yzx", c="zxy") == {"a": 0, "b": 0, "c": 0}
    assert assign(scheduler, a="xyz", gone="x") == {"a": 0, "gone": None}


def test_members_of_a_partition_spread_whatever_others_use():
    """One that has left the partition keeps the device, which counts less."""
    scheduler = scheduler_of(other="Q", idle="", a="P", b="P", c="R")
    assign(scheduler, other="xy")
    assign(scheduler, idle="y")
    assert assign(scheduler, a="xy", b="xy") == {"a": 0, "b": 1}
    assert assign(scheduler, c="yx") == {"c": 0}


@given(st.integers(1, 5), st.integers(1, 20), st.data())
def test_shared_evenly_whatever_the_order_of_the_lists_and_whoever_is_restarted(gpus, n, data):
    names = "uvwxy"[:gpus]
    views = {f"w{i}": data.draw(st.permutations(names)) for i in range(n)}
    scheduler = scheduler_of(**dict.fromkeys(views, "P"))
    asked = data.draw(st.permutations(list(views)))
    assign(scheduler, **{address: views[address] for address in asked})
    for number, victim in enumerate(asked[: data.draw(st.integers(0, n))]):
        del scheduler.workers[victim]
        scheduler.workers |= scheduler_of(**{f"again{number}": "P"}).workers
        views[f"again{number}"] = views.pop(victim)
        assign(scheduler, **{f"again{number}": views[f"again{number}"]})
    ordinals = assign(scheduler, **views)
    used = Counter(views[address][ordinal] for address, ordinal in ordinals.items())
    counts = [used[gpu] for gpu in names]
    assert sum(counts) == n
    assert max(counts) - min(counts) <= 1


@pytest.mark.parametrize(
    ("partitions", "visible", "sharers"),
    [
        ({"a": "P"}, "xy", 1),
        ({"a": "P", "b": "P"}, "xy", 1),
        ({"a": "P", "b": "P", "c": "P"}, "xy", 2),  # before the others have asked
        ({"a": "P", "b": "P", "c": "Q"}, "x", 2),
    ],
)
def test_workers_of_a_partition_and_host_share_the_memory(partitions, visible, sharers):
    scheduler = scheduler_of(**partitions)
    assign(scheduler, a=visible)
    counted = devices.count_sharers("a", visible, dask_scheduler=scheduler)
    assert counted == sharers
    assert devices.count_sharers("gone", visible, dask_scheduler=scheduler) == 1


def test_workers_of_several_partitions_on_a_device_share_its_memory():
    scheduler = scheduler_of(a="P", b="Q")
    assign(scheduler, a="x", b="x")
    assert devices.count_sharers("a", "x", dask_scheduler=scheduler) == 2


def test_without_a_driver_nobody_is_asked(start, monkeypatch):
    monkeypatch.setattr(probe, "visible_gpus", lambda: ())
    client = start({"a": {}})
    assert client.submit(own_device).result() is None
    assert client.submit(own_device_share).result() == 1
    assert client.cluster.scheduler.workers.popitem()[1].extra == {}
    with pytest.raises(ValueError, match="worker"):
        own_device()


@pytest.fixture
def nameless(tmp_path):
    """Client of a cluster of two nannies without names, each of which sees two devices."""
    (tmp_path / "devices.py").write_text(PRELOAD)
    options = {"nthreads": 2, "host": "127.0.0.1", "dashboard": False, "silence_logs": QUIET}

    async def make(address):
        preload = [str(tmp_path / "devices.py")]
        return [await Nanny(address, preload=preload, **options) for _ in range(2)]

    async def end(nannies):
        for nanny in nannies:
            await nanny.close()

    with cluster_of({}, {}, host="127.0.0.1") as cluster, Client(cluster) as client:
        nannies = client.sync(make, client.scheduler.address)
        try:
            yield client
        finally:
            client.sync(end, nannies)


@pytest.mark.extended
def test_a_worker_without_a_name_that_its_nanny_starts_again(nameless, wait_until):
    client = nameless
    part, _ = Pool.from_client(client).partition("GPU", max_workers_per_gpu=1)

    def ask(address):
        """Both of its slots at once."""
        return client.gather([part.submit(own_device, workers=address) for _ in range(4)])

    held = {worker.address: ask(worker.address)[0] for worker in part.workers}
    assert sorted(held.values()) == [0, 1]
    for device in (1, 0):
        victim = next(address for address, own in held.items() if own == device)
        os.kill(client.run(os.getpid, workers=[victim])[victim], signal.SIGKILL)
        wait_until(lambda victim=victim: victim not in client.cluster.scheduler.workers)
        wait_until(lambda: len(part) == 2)
        del held[victim]
        (newcomer,) = {worker.address for worker in part.workers} - held.keys()
        held[newcomer], *others = ask(newcomer)
        assert {held[newcomer], *others} == {device}
