"""Whole runs in which workers die, tasks fail or the user interrupts."""

from __future__ import annotations

import numpy as np
import pytest

import lidarpool.scan.caster
from lidarpool import Frame, LidarpoolError, Scene, Sensor, Survey, simulate
from poolpart import placement_violations

# Enough scans that the run is still under way when something happens to it.
SURVEY = Survey(
    Sensor(rays_per_revolution=720, layers=16, step_deg=1), poses=[(0, 0, 1), (1, 0, 2)], steps=360
)


@pytest.fixture(scope="module")
def undisturbed(client):
    return simulate(Scene.seed(), SURVEY, client=client)


def test_frames_come_in_order_and_every_scan_once(client, undisturbed, same_cloud):
    seen = []
    result = simulate(
        Scene.seed(), SURVEY, client=client, on_frame=lambda frame: seen.append(frame.scan)
    )
    assert seen == list(range(SURVEY.scan_count))
    assert result.rays == SURVEY.ray_count
    assert result.hits == result.hit_counts.sum() > 0
    assert same_cloud(result.cloud, undisturbed.cloud)
    order = result.cloud.scan.astype(np.int64)
    assert (np.diff(order) >= 0).all()
    assert placement_violations(result.records) == []


@pytest.mark.parametrize("partition", ["GPU", "LIDAR"])
@pytest.mark.parametrize("at_scan", [0, 200, 650])
def test_a_killed_worker_changes_nothing(
    client, undisturbed, same_cloud, kill, wait_for_all, partition, at_scan
):
    seen = []

    def on_frame(frame: Frame) -> None:
        seen.append(frame.scan)
        if frame.scan == at_scan:
            kill(partition)

    result = simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert seen == list(range(SURVEY.scan_count))
    assert same_cloud(result.cloud, undisturbed.cloud)
    assert result.hits == undisturbed.hits
    assert placement_violations(result.records) == []
    wait_for_all(client, 4)  # one killed near the end is not back yet


def test_nothing_is_left_on_the_scheduler(client, left_over):
    simulate(Scene.seed(), SURVEY, client=client)
    assert left_over(client) == ([], [], [])


def test_a_failing_task_ends_the_run_with_stage_and_scan(client, monkeypatch, left_over):
    monkeypatch.setattr(lidarpool.scan.caster, "intersect", failing_intersect)
    message = r"stage intersect, scans \d+ to \d+ failed: .*the lens is dirty"
    with pytest.raises(LidarpoolError, match=message):
        simulate(Scene.seed(), SURVEY, client=client)
    assert left_over(client) == ([], [], [])


def failing_intersect(setup, wire, run):
    raise ValueError("the lens is dirty")


@pytest.mark.parametrize("kind", [ZeroDivisionError, OSError])
def test_an_error_in_the_callback_passes_through_and_stops_the_run(client, kind, left_over):
    def on_frame(frame: Frame) -> None:
        if frame.scan == 100:
            raise kind("mine")

    with pytest.raises(kind, match="mine"):
        simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert left_over(client) == ([], [], [])


def test_an_interrupt_stops_the_run_and_the_cluster_can_be_used_again(
    client, undisturbed, same_cloud
):
    def on_frame(frame: Frame) -> None:
        if frame.scan == 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(Scene.seed(), SURVEY, client=client, on_frame=on_frame)
    assert same_cloud(simulate(Scene.seed(), SURVEY, client=client).cloud, undisturbed.cloud)
