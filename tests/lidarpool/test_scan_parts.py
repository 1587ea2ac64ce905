"""The pieces of the pipeline that need no cluster."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpool import Frame, Pose, ScanSpec, Sensor
from lidarpool.scan import stages
from lidarpool.scan.builder import CloudBuilder
from lidarpool.scan.casting import _same_pose
from lidarpool.scan.failures import naming_scans
from lidarpool.scan.messages import HIT, POINT, Attempt, Delivery, FrameRun, Part
from lidarpool.scan.setup import ray_directions
from poolpart import TaskRecord, WorkerLeft

SENSOR = Sensor(rays_per_revolution=12, layers=3, vertical_fov_deg=60, step_deg=60)
RECORD = TaskRecord("intersect", "GPU", "w", ("GPU",), 0.0, 1.0)


def frame(scan: int, triangles: int = 0) -> Frame:
    return Frame(
        scan,
        Pose((0, 0, 0)),
        10,
        triangles,
        np.arange(triangles, dtype=np.int32),
        np.ones(triangles, np.int32),
        np.zeros((0, 3), np.float32),
    )


def points(scan: int, count: int) -> np.ndarray:
    table = np.zeros(count, POINT)
    table["scan"], table["ray"] = scan, np.arange(count)
    table["cell"] = np.arange(count)[:, None] + scan
    return table


def part(*scans: int, count: int = 2) -> Part:
    return Part(scans, (count,) * len(scans), np.concatenate([points(s, count) for s in scans]))


class TestRayDirections:
    def test_rays_run_ring_by_ring_within_an_azimuth(self):
        spec = ScanSpec(0, Pose((0, 0, 0)), (2, 4))
        rays = np.arange(6)
        expected = SENSOR.directions[2:4].reshape(-1, 3)
        assert np.array_equal(ray_directions(SENSOR, spec, rays), expected)

    def test_azimuths_past_a_revolution_start_over(self):
        late, early = (ScanSpec(0, Pose((0, 0, 0)), (a, a + 2)) for a in (23, 11))
        rays = np.arange(6)
        assert np.array_equal(
            ray_directions(SENSOR, late, rays), ray_directions(SENSOR, early, rays)
        )

    def test_a_turned_pose_has_the_same_bits_for_any_number_of_rays(self):
        spec = ScanSpec(0, Pose((0, 0, 0), 12.3, 4.5, 6.7), (0, 12))
        rays = np.arange(36)
        whole = ray_directions(SENSOR, spec, rays)
        single = [ray_directions(SENSOR, spec, rays[i : i + 1])[0] for i in rays]
        assert np.array_equal(whole, single)
        expected = SENSOR.directions.reshape(-1, 3) @ spec.pose.rotation.T
        assert np.allclose(whole, expected, atol=1e-15)


class TestPoints:
    def test_positions_are_rounded_to_the_precision(self):
        spec = ScanSpec(5, Pose((1, 2, 3)), (0, 12))
        hits = np.zeros(3, HIT)
        hits["ray"], hits["distance"], hits["object"] = [1, 4, 10], [10.004, 2.0, 3.3], [7, 8, 9]
        table = stages.points_of(SENSOR, spec, hits, 0.01)
        exact = [1, 2, 3] + hits["distance"][:, None] * ray_directions(SENSOR, spec, hits["ray"])
        assert np.abs(table["cell"] * 0.01 - exact).max() <= 0.005 + 1e-12
        assert table["ring"].tolist() == [1, 1, 1]
        assert table["object"].tolist() == [7, 8, 9]
        assert set(table["scan"]) == {5}

    def test_no_hits_make_no_points(self):
        spec = ScanSpec(0, Pose((0, 0, 0)), (0, 12))
        assert len(stages.points_of(SENSOR, spec, np.zeros(0, HIT), 0.01)) == 0


class TestSamePose:
    @pytest.mark.parametrize(
        ("azimuths", "runs"),
        [
            ([(0, 2), (2, 4), (4, 6)], [3]),
            ([(0, 2), (4, 6)], [1, 1]),
            ([(0, 2), (0, 2)], [1, 1]),
            ([(10, 12), (12, 14)], [2]),
        ],
    )
    def test_neighbouring_sectors_are_cast_together(self, azimuths, runs):
        specs = [ScanSpec(i, Pose((0, 0, 0)), a) for i, a in enumerate(azimuths)]
        groups = list(_same_pose(specs))
        assert [len(group) for _, group in groups] == runs
        assert [spec for _, group in groups for spec in group] == specs

    def test_another_pose_starts_another_run(self):
        specs = [ScanSpec(i, Pose((i, 0, 0)), (2 * i, 2 * i + 2)) for i in range(3)]
        assert [len(group) for _, group in _same_pose(specs)] == [1, 1, 1]


class TestMessages:
    def test_deliveries_travel_as_bytes(self):
        delivery = Delivery(Attempt("1f3a", "collect-1", 7), part(3, 4))
        back = Delivery.from_wire(delivery.wire())
        assert back.attempt == delivery.attempt
        assert back.attempt.stage == "collect"
        assert back.content.scans == (3, 4)
        assert np.array_equal(back.content.points, delivery.content.points)

    def test_frames_are_divided_into_messages_of_bounded_size(self, monkeypatch):
        monkeypatch.setattr(stages, "DELIVERY_BYTES", 1000)
        frames = [frame(i, triangles=50) for i in range(10)]  # 400 bytes each
        runs = list(stages._frame_runs(frames, [RECORD]))
        assert [len(run.frames) for run in runs] == [3, 3, 3, 1]
        assert [f.scan for run in runs for f in run.frames] == list(range(10))
        assert [run.records for run in runs] == [(RECORD,), (), (), ()]

    def test_records_travel_even_without_frames(self):
        assert list(stages._frame_runs([], [RECORD])) == [FrameRun((), (RECORD,))]
        assert list(stages._frame_runs([], [])) == []

    def test_points_are_divided_into_messages_of_bounded_size(self, monkeypatch):
        monkeypatch.setattr(stages, "DELIVERY_BYTES", 10 * POINT.itemsize)
        parts = list(stages._parts([(scan, points(scan, 4)) for scan in range(5)]))
        assert [p.scans for p in parts] == [(0, 1, 2), (3, 4)]
        assert [p.counts for p in parts] == [(4, 4, 4), (4, 4)]
        assert list(stages._parts([])) == []


class TestCloudBuilder:
    def test_parts_in_any_order_give_points_in_scan_and_ray_order(self):
        builder = CloudBuilder(4)
        for p in (part(2), part(3, 0), part(1)):
            builder.add(p)
        cloud = builder.merge(0.5, np.array([100.0, 0, 0])).load()
        assert cloud.scan.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
        assert cloud.positions[:, 0].tolist() == [100, 100.5, 100.5, 101, 101, 101.5, 101.5, 102]

    def test_a_scan_that_comes_twice_counts_once(self):
        builder = CloudBuilder(3)
        assert builder.add(part(0, 1)) == [0, 1]
        assert builder.add(part(1, 2)) == [2]
        assert builder.ledger.complete
        assert builder.ledger.duplicates == 1
        assert builder.point_count == 6 == len(builder.merge(0.01, np.zeros(3)))

    def test_scans_without_points_are_delivered_too(self):
        builder = CloudBuilder(2)
        builder.add(part(0, 1, count=0))
        assert builder.ledger.complete
        assert len(builder.merge(0.01, np.zeros(3))) == 0

    def test_positions_are_the_short_decimals_that_are_meant(self):
        builder = CloudBuilder(1)
        table = points(0, 1000)
        table["cell"] = np.arange(1000)[:, None]
        builder.add(Part((0,), (1000,), table))
        cloud = builder.merge(0.01, np.zeros(3)).load()
        assert [repr(float(x)) for x in cloud.positions[:, 0]] == [
            repr(round(i * 0.01, 2)) for i in range(1000)
        ]


class TestNamingScans:
    def test_what_fails_is_told_with_its_scans(self):
        with (
            pytest.raises(RuntimeError, match=r"scans 3 to 5: ValueError: bad"),
            naming_scans(3, 5),
        ):
            raise ValueError("bad")

    def test_a_worker_that_leaves_is_not_a_failure_of_its_scans(self):
        """The driver casts those elsewhere, and would end the run at any other error."""
        with pytest.raises(WorkerLeft), naming_scans(3, 5):
            raise WorkerLeft("the worker has left")
