"""Which CUDA device a worker uses: shared evenly, kept, and found free by whoever is restarted."""

import os
import shutil
import signal
import subprocess
from collections import Counter
from types import SimpleNamespace
from unittest.mock import patch

import dask
import pytest
from distributed import Client, Nanny, Scheduler, SpecCluster
from hypothesis import given
from hypothesis import strategies as st

from poolpart import Pool, assign_devices, devices, own_device, probe

# What a worker sees is in an environment variable: a letter for each device.
DRIVER = """
#include <stdlib.h>
#include <string.h>
int cuInit(unsigned flags) { return 0; }
int cuDeviceGetCount(int *count) { *count = strlen(getenv("FAKE_GPUS")); return 0; }
int cuDeviceGetUuid_v2(unsigned char *uuid, int device) {
  memset(uuid, getenv("FAKE_GPUS")[device], 16);
  return 0;
}
"""


# -- the choice, without a cluster -----------------------------------------------------


def cluster_of(**partitions):
    """What the choice needs of a scheduler; the workers' partitions by address."""
    workers = {
        address: SimpleNamespace(address=address, extra={}, resources=dict.fromkeys(names, 1))
        for address, names in partitions.items()
    }
    return SimpleNamespace(workers=workers)


def assign(scheduler, **visible):
    """Devices of workers by address; a letter in `visible` is a device that it sees."""
    return devices._assign(visible, dask_scheduler=scheduler)


def test_rotated_lists_all_use_their_first():
    """As those of dask-cuda, where each worker sees all devices, its own one first."""
    scheduler = cluster_of(a="P", b="P", c="P")
    assert assign(scheduler, a="xyz", b="yzx", c="zxy") == {"a": 0, "b": 0, "c": 0}
    assert assign(scheduler, a="xyz", gone="x") == {"a": 0}


def test_members_of_a_partition_spread_whatever_others_use():
    """One that has left the partition keeps the device, which counts less."""
    scheduler = cluster_of(other="Q", idle="", a="P", b="P", c="R")
    assign(scheduler, other="xy")
    assign(scheduler, idle="y")
    assert assign(scheduler, a="xy", b="xy") == {"a": 0, "b": 1}
    assert assign(scheduler, c="yx") == {"c": 0}


@given(st.integers(1, 5), st.integers(1, 20), st.data())
def test_shared_evenly_whatever_the_order_of_the_lists_and_whoever_is_restarted(gpus, n, data):
    names = "uvwxy"[:gpus]
    views = {f"w{i}": data.draw(st.permutations(names)) for i in range(n)}
    scheduler = cluster_of(**dict.fromkeys(views, "P"))
    asked = data.draw(st.permutations(list(views)))
    if data.draw(st.booleans()):
        assign(scheduler, **views)
    for address in asked:
        assign(scheduler, **{address: views[address]})
    for number, victim in enumerate(asked[: data.draw(st.integers(0, n))]):
        del scheduler.workers[victim]
        scheduler.workers |= cluster_of(**{f"again{number}": "P"}).workers
        views[f"again{number}"] = views.pop(victim)
        assign(scheduler, **{f"again{number}": views[f"again{number}"]})
    ordinals = assign(scheduler, **views)
    used = Counter(views[address][ordinal] for address, ordinal in ordinals.items())
    counts = [used[gpu] for gpu in names]
    assert sum(counts) == n
    assert max(counts) - min(counts) <= 1


# -- on clusters -----------------------------------------------------------------------


def test_without_a_driver_nobody_is_asked(start, monkeypatch):
    monkeypatch.setattr(probe, "has_driver", lambda: False)
    client = start({"a": {}})
    assert client.submit(own_device).result() is None
    assert assign_devices(client, Pool.from_client(client)) == {}
    assert client.cluster.scheduler.workers.popitem()[1].extra == {}


def test_two_clients_get_the_same_answer(start, monkeypatch):
    monkeypatch.setattr(probe, "has_driver", lambda: True)
    monkeypatch.setattr(probe, "visible_gpus", lambda: ("x", "y"))
    client = start({name: {} for name in "abc"})
    with Client(client.cluster) as other:
        given = assign_devices(client, Pool.from_client(client))
        assert sorted(given.values()) in ([0, 0, 1], [0, 1, 1])
        assert assign_devices(other, Pool.from_client(other)) == given
        own = {a: other.submit(own_device, workers=[a], pure=False).result() for a in given}
    assert own == given
    with pytest.raises(ValueError, match="worker"):
        own_device()


@pytest.fixture
def nameless(tmp_path):
    """Client of a cluster of two nannies without names, each of which sees two devices."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler to make a driver with")
    source = tmp_path / "driver.c"
    source.write_text(DRIVER)
    library = tmp_path / "libcuda.so.1"
    subprocess.run([compiler, "-w", "-shared", "-fPIC", "-o", library, source], check=True)
    # Where to look for libraries has to be known before the worker's process begins.
    environ = {"LD_LIBRARY_PATH": str(tmp_path), "FAKE_GPUS": "xy"}
    before = {f"distributed.nanny.pre-spawn-environ.{name}": environ[name] for name in environ}
    options = {"nthreads": 2, "host": "127.0.0.1", "dashboard": False, "silence_logs": 50}
    scheduler = {
        "cls": Scheduler,
        "options": {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "dashboard": False},
    }

    async def make(address):
        with dask.config.set(before):
            return [await Nanny(address, **options) for _ in range(2)]

    async def end(nannies):
        for nanny in nannies:
            await nanny.close()

    # Nannies leave the variables of their workers in this process as well.
    with (
        patch.dict(os.environ),
        dask.config.set({"distributed.worker.multiprocessing-method": "spawn"}),
        SpecCluster(scheduler=scheduler, silence_logs=50) as cluster,
        Client(cluster) as client,
    ):
        nannies = client.sync(make, client.scheduler.address)
        try:
            yield client
        finally:
            client.sync(end, nannies)


def test_a_worker_without_a_name_that_its_nanny_starts_again(nameless, wait_until):
    client = nameless
    part, _ = Pool.from_client(client).partition("GPU", max_workers_per_gpu=1)
    before = assign_devices(client, Pool.from_client(client))
    assert sorted(before.values()) == [0, 1]
    for device in (1, 0):
        now = assign_devices(client, Pool.from_client(client))
        victim = next(address for address, held in now.items() if held == device)
        os.kill(client.run(os.getpid, workers=[victim])[victim], signal.SIGKILL)
        wait_until(lambda victim=victim: victim not in client.cluster.scheduler.workers)
        wait_until(lambda: len(part) == 2)
        (newcomer,) = {worker.address for worker in part.workers} - now.keys()
        # Both of its slots at once, and by a task of its own rather than by the client.
        asked = [part.submit(own_device, workers=newcomer) for _ in range(4)]
        assert client.gather(asked) == [device] * 4
