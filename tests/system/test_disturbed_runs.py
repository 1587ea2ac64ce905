"""Whole runs in which workers die, tasks fail or the user interrupts."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Worker, WorkerPlugin

import lidarpool.scan.driver
from lidarpool import Frame, LidarpoolError, Scene, Sensor, Survey, simulate
from poolpart import placement_violations, trace_to

# Enough batches that the run is still under way when something happens to it.
SURVEY = Survey(
    Sensor.grid(rays_per_revolution=360, layers=8, step_deg=1), [(0, 0, 1), (1, 0, 2)], steps=360
)

pytestmark = pytest.mark.usefixtures("small_batches")


@pytest.fixture(scope="module")
def undisturbed(cluster_client):
    return simulate(Scene.seed(), SURVEY, client=cluster_client)


def test_frames_come_in_order_and_every_scan_once(
    client, undisturbed, same_cloud, all_records, left_over
):
    frames: list[Frame] = []
    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=frames.append)
    assert [frame.scan for frame in frames] == list(range(SURVEY.scan_count))
    assert result.rays == sum(frame.rays for frame in frames) == SURVEY.ray_count
    assert result.hits == result.hit_counts.sum() == sum(frame.hits for frame in frames) > 0
    assert len(result.points) == sum(frame.count for frame in frames)
    assert same_cloud(result.cloud, undisturbed.cloud)
    assert (np.diff(result.cloud.scan.astype(np.int64)) >= 0).all()
    assert placement_violations(result.records) == []
    places = {(record.stage, record.partition) for record in result.records}
    long = {(stage, "LIDAR") for stage in ("generate", "sort", "collect")}
    assert places == {("intersect", "GPU"), *long}
    assert left_over(client) == ([], [], [])


def test_points_of_a_frame_are_in_storage_when_it_comes(client, undisturbed):
    cloud = undisturbed.cloud

    def on_frame(frame: Frame) -> None:
        if frame.scan % 100 == 0:
            points = frame.points()
            mine = cloud.scan == frame.scan
            assert len(points) == frame.count == mine.sum()
            assert np.array_equal(points.positions, cloud.positions[mine])

    simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)


@pytest.mark.parametrize("partition", ["GPU", "LIDAR"])
def test_a_killed_worker_changes_nothing(client, undisturbed, same_cloud, kill, partition):
    seen = []

    def on_frame(frame: Frame) -> None:
        seen.append(frame.scan)
        if frame.scan == 200:
            kill(partition)

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert seen == list(range(SURVEY.scan_count))
    assert same_cloud(result.cloud, undisturbed.cloud)
    assert result.hits == undisturbed.hits
    assert placement_violations(result.records) == []


def test_a_failing_task_ends_the_run_with_stage_and_scan(client, monkeypatch, left_over):
    monkeypatch.setattr(lidarpool.scan.driver, "intersect", failing_intersect)
    message = r"stage intersect, scan \d+ failed: the lens is dirty"
    with pytest.raises(LidarpoolError, match=message):
        simulate(Scene.seed(), SURVEY, client=client)
    assert left_over(client) == ([], [], [])


def failing_intersect(handle, first, stop, run):
    raise ValueError("the lens is dirty")


@pytest.mark.parametrize("kind", [ZeroDivisionError, OSError, KeyboardInterrupt])
def test_an_error_in_the_callback_passes_through_and_stops_the_run(
    client, undisturbed, same_cloud, kind, left_over
):
    def on_frame(frame: Frame) -> None:
        if frame.scan == 100:
            raise kind("mine")

    with pytest.raises(kind, match="mine"):
        simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert left_over(client) == ([], [], [])
    if kind is KeyboardInterrupt:  # and the cluster can be used again
        assert same_cloud(simulate(Scene.seed(), SURVEY, client=client).cloud, undisturbed.cloud)


class BuildCount(WorkerPlugin):
    """Notes in a file which process has built a tree."""

    name = "build-count"

    def __init__(self, file: str) -> None:
        self.file = file

    def setup(self, worker: Worker) -> None:
        trace_to(self._note)

    def teardown(self, worker: Worker) -> None:
        trace_to(None)

    def _note(self, point: str, fields: dict[str, Any]) -> None:
        if point == "intersect.built":
            with Path(self.file).open("a") as file:
                file.write(f"{os.getpid()}\n")


def test_a_tree_is_built_once_in_each_worker(client, tmp_path):
    """Also where workers idle and Dask's memory manager drops what nobody needs."""
    builds = tmp_path / "builds"
    builds.touch()
    client.register_plugin(BuildCount(str(builds)))
    try:
        survey = Survey(poses=[(0, 0, 1)])
        result = simulate(Scene.seed(), survey, client=client, scans_per_second=12)
    finally:
        client.unregister_worker_plugin(BuildCount.name)
    assert client.amm.running()
    assert result.seconds > 2.5
    built = builds.read_text().split()
    assert len(built) == 3
    assert len(set(built)) == 3
