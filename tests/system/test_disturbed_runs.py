"""Whole runs in which workers die, tasks fail or the user interrupts."""

import time

import numpy as np
import pytest
from distributed import Client, Worker
from tests.clusters import thread_cluster

from lidarpool import LidarError, Planning, ScanFrame, Scene, Sensor, Survey, simulate
from lidarpool.run.pipeline.pipeline import Pipeline
from lidarpool.run.pipeline.task_records import placement_violations
from lidarpool.run.planning_trials import TrialRunner
from poolpart.workers import worker_identities

# Enough batches that the run is still under way when something happens to it.
SURVEY = Survey(
    Sensor.grid(rays_per_revolution=360, layers=8, step_deg=1), [(0, 0, 1), (1, 0, 2)], steps=90
)

pytestmark = pytest.mark.usefixtures("small_batches")


@pytest.fixture(scope="module")
def undisturbed(cluster_client):
    return simulate(Scene.seed(), SURVEY, client=cluster_client)


@pytest.mark.extended
def test_frames_come_in_order_and_every_scan_once(
    client, undisturbed, same_cloud, all_records, left_over
):
    frames: list[ScanFrame] = []
    cloud = undisturbed.cloud

    def on_frame(frame: ScanFrame) -> None:
        frames.append(frame)
        if frame.scan % 50 == 0:  # its points are in storage
            mine = cloud.scan == frame.scan
            assert np.array_equal(frame.points().positions, cloud.positions[mine])

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert [frame.scan for frame in frames] == list(range(SURVEY.scan_count))
    assert result.rays == sum(frame.rays for frame in frames) == SURVEY.ray_count
    assert (
        result.hit_count == result.hit_counts.sum() == sum(frame.hit_count for frame in frames) > 0
    )
    assert len(result.points) == sum(frame.count for frame in frames)
    assert same_cloud(result.cloud, cloud)
    assert (np.diff(result.cloud.scan.astype(np.int64)) >= 0).all()
    assert placement_violations(result.records) == []
    places = {(record.stage, record.partition) for record in result.records}
    long = {(stage, "LIDAR") for stage in ("generate", "sort", "collect")}
    assert places == {("intersect", "GPU"), *long}
    cast = [record.items for record in result.records if record.stage == "intersect"]
    assert len(cast) > 2 and sum(cast) == SURVEY.scan_count
    assert left_over(client) == ([], [], [])


@pytest.mark.slow
def test_a_partition_that_stays_empty_ends_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "lidarpool.run.pipeline.policies.MAX_BATCHES_PER_TASK", 1
    )  # or all would be under way

    def on_frame(frame: ScanFrame) -> None:
        if frame.scan == 10:
            gpu = [a for a, w in worker_identities(client).items() if "GPU" in w["resources"]]
            client.retire_workers(gpu, close_workers=True, remove=True)

    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 4}) as cluster,
        Client(cluster, set_as_default=False) as client,
        pytest.raises(
            LidarError, match="because partition 'GPU' has had no workers for 2 s"
        ) as end,
    ):
        simulate(
            Scene.seed(), SURVEY, client=client, on_frame=on_frame, folder=tmp_path / "run",
            worker_timeout_s=2.0,
        )  # fmt: skip
    assert '--resources "GPU=1"' in str(end.value)
    assert "of 180 scans are stored in" in end.value.__notes__[0]


def _pause(client: Client, name: str, *, on: bool) -> None:
    """Have Dask pause a worker as if its memory were full, or continue it; waits until it has."""

    def pause_at(fraction: float, dask_worker: Worker) -> None:
        dask_worker.memory_manager.memory_pause_fraction = fraction

    [address] = [a for a, w in worker_identities(client).items() if w["name"] == name]
    client.run(pause_at, 1e-9 if on else 0.8, workers=[address])
    wanted = "paused" if on else "running"
    while worker_identities(client)[address]["status"] != wanted:
        time.sleep(0.02)


@pytest.mark.extended
def test_a_worker_that_dask_has_paused_gets_no_batches(
    client, undisturbed, small_batches, same_cloud
):
    _pause(client, "GPU-0", on=True)
    try:
        result = simulate(Scene.seed(), SURVEY, client=client)
    finally:
        _pause(client, "GPU-0", on=False)
    assert any("Dask paused worker GPU-0" in note for note in result.notes)
    cast_by = {record.worker for record in result.records if record.stage == "intersect"}
    assert cast_by and "GPU-0" not in str(cast_by)
    assert same_cloud(result.cloud, undisturbed.cloud)
    assert placement_violations(result.records) == []


@pytest.mark.extended
@pytest.mark.slow(keep=("KeyboardInterrupt",))
@pytest.mark.parametrize("kind", [OSError, KeyboardInterrupt])
def test_an_error_in_the_callback_passes_through_and_stops_the_run(
    cluster_client, undisturbed, same_cloud, kind, left_over
):
    def on_frame(frame: ScanFrame) -> None:
        if frame.scan == 60:
            raise kind("mine")

    with pytest.raises(kind, match="mine"):
        simulate(Scene.seed(), SURVEY, client=cluster_client, on_frame=on_frame)
    assert left_over(cluster_client) == ([], [], [])
    if kind is KeyboardInterrupt:  # and the cluster can be used again
        again = simulate(Scene.seed(), SURVEY, client=cluster_client)
        assert same_cloud(again.cloud, undisturbed.cloud)


@pytest.mark.slow(keep=("Pipeline",))
@pytest.mark.parametrize("pump", [Pipeline, TrialRunner])
def test_an_interrupt_while_starting_leaves_nothing(cluster_client, monkeypatch, pump, left_over):
    method = "open" if pump is Pipeline else "step"
    original = getattr(pump, method)

    def interrupted(self) -> None:
        original(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(pump, method, interrupted)
    planning = Planning((25, 25), (-30, -20), trials=3, particles=50, iterations=20)
    with pytest.raises(KeyboardInterrupt):
        simulate(Scene.seed(), SURVEY, planning, client=cluster_client)
    assert left_over(cluster_client) == ([], [], [])
