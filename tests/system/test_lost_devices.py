"""GPUs that answer no call of a process any more, as after an illegal address."""

import os
from pathlib import Path
from typing import Any

import pytest
from distributed import Worker, WorkerPlugin

from lidarpool import LidarError, Scene, Sensor, Survey, simulate
from lidarpool.processes.tracing import trace_to
from lidarsim.simulator.rig import Rig

SURVEY = Survey(Sensor.grid(rays_per_revolution=360, layers=8, step_deg=2), [(0, 0, 1)], steps=60)
SCAN = 20

pytestmark = pytest.mark.usefixtures("small_batches")


class BreakDevice(WorkerPlugin):
    """Has the device of a worker fail at a scan, as often as the file `faults` has bytes."""

    name = "break-device"

    def __init__(self, faults: Path) -> None:
        self.faults = faults

    def setup(self, worker: Worker) -> None:
        self.lost = False
        self.answers = Rig.device_lost
        Rig.device_lost = property(lambda rig: self.lost)  # type: ignore[method-assign, assignment]
        trace_to(self.strike)

    def teardown(self, worker: Worker) -> None:
        Rig.device_lost = self.answers  # type: ignore[method-assign, assignment]
        trace_to(None)

    def strike(self, point: str, fields: dict[str, Any]) -> None:
        if point != "intersect.cast" or not (self.lost or SCAN in fields["scans"]):
            return
        if self.lost or (remaining := self.faults.stat().st_size):
            if not self.lost:
                os.truncate(self.faults, remaining - 1)
            self.lost = True
            raise RuntimeError("cudaErrorIllegalAddress")


@pytest.fixture
def break_device(request, tmp_path):
    """Return a function that has devices of a client's cluster fail a number of times."""
    clients = []

    def break_device(client, count):
        faults = tmp_path / "faults"
        faults.write_bytes(bytes(count))
        client.register_plugin(BreakDevice(faults))
        clients.append(client)
        return faults

    yield break_device
    for client in clients:
        client.unregister_worker_plugin(BreakDevice.name)


def test_without_a_nanny_the_run_ends_and_says_what_to_do(cluster_client, break_device):
    break_device(cluster_client, 1)
    with pytest.raises(LidarError, match=r"^The GPU of .*scan 20: .*Illegal.* no nanny"):
        simulate(Scene.seed(), SURVEY, client=cluster_client)


@pytest.mark.slow
def test_a_worker_whose_device_fails_is_replaced(client, break_device, same_cloud, cluster_client):
    undisturbed = simulate(Scene.seed(), SURVEY, client=cluster_client).cloud
    faults = break_device(client, 1)
    result = simulate(Scene.seed(), SURVEY, client=client)
    assert not faults.stat().st_size
    assert any("stopped responding" in note for note in result.notes)
    assert same_cloud(result.cloud, undisturbed)


@pytest.mark.slow
def test_devices_that_fail_again_and_again_end_the_run(client, break_device, left_over, tmp_path):
    break_device(client, 9)
    with pytest.raises(LidarError, match=r"^GPUs have failed 3 times.*nvidia-smi"):
        simulate(Scene.seed(), SURVEY, client=client, folder=tmp_path / "run")
    assert left_over(client) == ([], [], [])
